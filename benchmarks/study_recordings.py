"""A tape and a video coder behind whole cameras: does the stated u hold?

``python benchmarks/study_recordings.py [--cameras 12] [--seed 1]``

Random analogue cameras (point spread, uneven response, shot noise, amplifier noise, half of them with a video amplifier of 6 to 12 MHz,
jitter of the grabber, a converter of 8 bits) show 16
frames of many discs directly and 16 from a tape of random bandwidth, noise, time base and step of the heads; random digital cameras show 12
frames directly and 24 through H.264 of a random quantiser and group, or through a lossless coder. For each value: mean and standard
deviation of z = (value − truth)/u, its largest, and the median of u over the truth; of a limit, how often it holds.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from typing import Any

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.progress import no_progress
from pixmetry.scene.outlines import disc
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

SHAPE, CLOCK_MHZ = (240, 320), 14.1875


def camera_of(more: dict[str, dict[str, Any]], unit: int) -> Camera:
    """A camera with its usual sources, of its own unit, and some more."""
    sources: dict[str, dict[str, Any]] = {
        "optics.point_spread": {"sigma_px": 0.5},
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": 0.01},
        "sensor.shot_noise": {},
        "electronics.amplifier_noise": {"white_e": 80.0},
        "electronics.gain": {"gain_dn_per_e": 0.01},
        "grabber.adc": {"bits": 8, "offset_dn": 10.0},
        **more,
    }
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.make(sources[s.id])) for s in in_order(found.values()))
    return Camera("recorded", SHAPE, chain, pixel_clock_hz=1e6 * CLOCK_MHZ, unit_seed=unit)


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    z, stated, holds, right = (defaultdict(list) for _ in range(4))
    for number in range(given.cameras):
        discs = [
            disc(x + rng.uniform(-3, 3), y + rng.uniform(-2, 2), float(rng.uniform(8, 14)), float(rng.uniform(6e3, 1.5e4)))
            for y in np.arange(8, SHAPE[0], 16.0)
            for x in np.arange(8, SHAPE[1], 18.0)
        ]
        scene = Picture((Shapes.of(discs),), Uniform(2000.0))
        taped = number % 2 == 0
        source = "storage.tape" if taped else "storage.video_codec"
        truth: dict[str, Any]
        if taped:
            truth = {
                "bandwidth_mhz": float(rng.uniform(2, 5)),
                "noise_dn": float(rng.choice([0.0, 2.0, 4.0])),
                "white_ns": float(rng.choice([0.0, 7.0, 15.0])),
                "wow_ns": float(rng.choice([0.0, 10.0])),
                "wow_rows": 10.0,
                "head_switch_ns": float(rng.choice([0.0, 100.0, -60.0])),
            }
            setting: dict[str, Any] = {"generations": 1, **truth}
            more = {"grabber.line_jitter": {"white_ns": 2.0}}
            if rng.choice([False, True]):
                more["electronics.video_amplifier"] = {"natural_mhz": float(rng.uniform(6, 12))}
            facts: dict[str, Any] = {"interface": "analogue", "pixel_clock_mhz": CLOCK_MHZ}
        else:
            lossless = bool(rng.choice([False, False, True]))
            truth = {} if lossless else {"quality": int(rng.integers(16, 32)), "group": int(rng.integers(1, 10))}
            setting = {"codec": "ffv1"} if lossless else {"control": "qp", **truth}
            more, facts = {}, {}
        direct, recorded = camera_of(more, number), camera_of({**more, source: setting}, number)
        frames = [
            camera.expose(scene, count, 2 * number + k, threads=1).data.astype(np.uint8)
            for k, (camera, count) in enumerate(((direct, 16 if taped else 12), (recorded, 16 if taped else 24)))
        ]
        groups = [Frames("recording", None, frames[0]), Frames("recording", None, frames[1], facts=GroupFacts(recorded=True))]
        seen = observe_campaign(campaign_of_arrays(groups, bits=8, name="recorded", **facts), no_progress)[1]
        found, why = measure_sources(seen)
        if source not in found:
            right["lossless coder not found" if not taped and not truth else f"refused: {why[source]} {truth}"].append(True)
            continue
        if not taped:
            right["lossless coder not found"] += [] if truth else [False]
            group = found[source].settings.get("group")
            if truth and group is not None:
                right["group"].append(group == truth["group"])
        if taped:
            right["bandwidth told"].append("bandwidth_mhz" in found[source])
        for name in (n for n in truth if n in found[source]):
            e = found[source][name]
            if e.is_limit or not truth[name]:
                holds[name].append(e.value >= truth[name] if e.is_limit else abs(e.value) < 4 * e.u)
            elif name != "wow_rows" or truth["wow_ns"]:
                z[name].append((e.value - truth[name]) / e.u)
                stated[name].append(e.u / abs(truth[name]))
    print(f"{'value':16s}   n  mean z   std z  largest  u/truth | limits that hold")
    for name in sorted({*z, *holds}):
        s = np.array(z[name])
        told = f"{len(s):4d} {s.mean():+7.2f} {s.std():7.2f} {np.abs(s).max():8.1f} {np.median(stated[name]):8.2g}" if len(s) else " " * 37
        print(f"{name:16s} {told} | {sum(holds[name])} of {len(holds[name])}")
    for name, told_right in right.items():
        print(f"{name}: {sum(told_right)} of {len(told_right)}")


if __name__ == "__main__":
    main()
