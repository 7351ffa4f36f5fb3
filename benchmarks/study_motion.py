"""Moving targets in front of whole cameras: does the stated u hold?

``python benchmarks/study_motion.py [--cameras 20] [--seed 1] [--pulses]``

Random cameras with point spread, aperture, uneven response and dark current, shot noise, charge transfer, row noise, a converter of 8 to
12 bits; interlaced (of either order, some woven in the wrong order), with a rolling shutter (read from either side), or neither. Each
shows 16 discs at rest and in four motions; with ``--pulses`` interlaced cameras take the motions in two pulses of light too. Times are
measured blind. For each value: mean and standard deviation of z = (value − truth)/u, its largest, and the median of u over the truth; of a
limit, how often it holds.
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
from pixmetry.scene.discs import Discs
from pixmetry.scene.motion import Motion
from pixmetry.scene.picture import Picture
from pixmetry.scene.uniform import Uniform

SHAPE, PERIOD_S, FRAMES = (288, 304), 0.04, 10
PLACES = np.stack(np.meshgrid(90.0 + 42 * np.arange(4), 84.0 + 41 * np.arange(4)), axis=-1).reshape(-1, 2)
DIRECTIONS = ((0.0, 0.0), (1.0, 0.05), (-1.0, 0.0), (0.0, 1.0), (0.05, -1.0))


def camera_of(sources: dict[str, dict[str, Any]], exposure_s: float, unit: int) -> Camera:
    """A camera with these sources, of its own unit."""
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("moving", SHAPE, chain, exposure_s=exposure_s, unit_seed=unit, facts={"frame_period_s": PERIOD_S})


def run_of(
    camera: Camera, plate: np.ndarray, velocity: np.ndarray, rng: np.random.Generator, bits: int, pulsed: bool, stated: float
) -> Frames:
    """Frames of discs that pass the middle of the frame in the middle of the run."""
    places = plate + rng.uniform(-6, 6, 2) - velocity * PERIOD_S * (FRAMES - 1) / 2
    discs = Discs(*places.T, diameter_px=8.0, blur_px=0.6, peak_photons=9e3)
    scene = Picture((discs.layer(Motion(tuple(velocity))),), Uniform(900.0))
    seed = int(rng.integers(1 << 30))
    data = camera.expose(scene, FRAMES, seed, threads=1, frame_period_s=PERIOD_S).data
    dtype = np.uint8 if bits == 8 else np.uint16
    return Frames("motion", stated, data.astype(dtype), facts=GroupFacts(interval_s=PERIOD_S, pulsed=pulsed or None))


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pulses", action="store_true")
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    z, stated, holds, choices, refused = (defaultdict(list) for _ in range(5))
    for number in range(given.cameras):
        kind = "interlaced" if given.pulses else str(rng.choice(["interlaced", "rolling", "neither"]))
        plate = PLACES + rng.uniform(-0.5, 0.5, PLACES.shape)
        speed = float(rng.uniform(80, 260))
        exposure = float(rng.choice([2e-4, *rng.uniform(2e-3, 0.02, 3)]))
        length = float(rng.uniform(0.8, 1.2))
        bits = int(rng.choice([8, 10, 12]))
        truth: dict[str, float] = {"exposure_s": exposure * length, "jitter_s": float(rng.choice([0.0, 2e-4]))}
        sources: dict[str, dict[str, Any]] = {
            "optics.point_spread": {"sigma_px": 0.4},
            "sensor.pixel_aperture": {"width_x_px": float(rng.uniform(0.6, 1)), "width_y_px": 0.9},
            "sensor.exposure": {"nodes": 7, "length_rel": length},
            "sensor.trigger_jitter": {"jitter_s": truth["jitter_s"]},
            "sensor.quantum_efficiency": {"quantum_efficiency": 0.6},
            "sensor.prnu": {"pixel_std_rel": 0.01},
            "sensor.dsnu": {"pixel_std_e": 5.0},
            "sensor.shot_noise": {},
            "sensor.charge_transfer": {"serial_cti": 1e-5},
            "electronics.amplifier_noise": {"white_e": 12.0},
            "electronics.row_noise": {"row_e": 2.0},
            "electronics.gain": {"gain_dn_per_e": 0.033 * 2 ** (bits - 8)},
            "grabber.adc": {"bits": bits, "offset_dn": 4.0 * 2 ** (bits - 8)},
        }
        first = "even"
        if kind == "interlaced":
            first, swapped = str(rng.choice(["even", "odd"])), bool(rng.choice([False, True]))
            truth["field_period_s"] = 0.02
            sources["sensor.interlace"] = {"field_period_s": 0.02, "first_field": first}
            if swapped:
                sources["sensor.read_out"] = {"mode": "woven", "swapped": True}
        elif kind == "rolling":
            truth["row_time_s"] = float(rng.choice([10e-6, 30e-6, 60e-6]))
            sources["sensor.rolling_shutter"] = {"row_time_s": truth["row_time_s"], "first_row": str(rng.choice(["top", "bottom"]))}
        camera = camera_of(sources, exposure, number)
        groups = [run_of(camera, plate, speed * np.array(d), rng, bits, False, exposure) for d in DIRECTIONS]
        if given.pulses:
            truth |= {"separation_s": float(rng.uniform(0.5e-3, 3e-3)), "ambient_share": float(rng.uniform(0.03, 0.3))}
            sources["sensor.light_pulses"] = {n: truth[n] for n in ("separation_s", "ambient_share")} | {"first_field": first}
            pulsed = camera_of(sources, exposure, number)
            groups += [run_of(pulsed, plate, speed * np.array(d), rng, bits, True, exposure) for d in DIRECTIONS[1:4]]
        seen = observe_campaign(campaign_of_arrays(groups, bits=bits, name="moving", pitch_um=5.0), no_progress)[1]
        if seen.motion is None:
            refused[seen.failed["motion"]].append(number)
            continue
        fit = seen.motion.fit
        for name, value in truth.items():
            if name not in fit:
                refused[f"{name}: {fit.reasons[name]}"].append(number)
                continue
            e = fit[name]
            if e.is_limit or not value:
                holds[name].append(e.value >= value if e.is_limit else e.value < 4 * e.u)
            else:
                z[name].append((e.value - value) / e.u)
                stated[name].append(e.u / value)
                if abs(z[name][-1]) > 3:
                    print(number, kind, name, value, e, f"speed {speed:.0f}, bits {bits}, exposure {exposure:.3g}")
        found, why = measure_sources(seen)
        order = dict(found["sensor.read_out"].settings) if "sensor.read_out" in found else why["sensor.read_out"]
        choices["swapped"].append(isinstance(order, dict) and bool(order.get("swapped")) == ("sensor.read_out" in sources))
        if kind == "interlaced":
            choices["first field"].append(fit.settings.get("first_field") == first if "sensor.read_out" not in sources else True)
    print(f"{'value':16s}   n  mean z   std z  largest  u/truth | limits that hold")
    for name in sorted({*z, *holds}):
        s = np.array(z[name])
        told = f"{len(s):4d} {s.mean():+7.2f} {s.std():7.2f} {np.abs(s).max():8.1f} {np.median(stated[name]):8.2g}" if len(s) else " " * 37
        print(f"{name:16s} {told} | {sum(holds[name])} of {len(holds[name])}")
    for name, right in choices.items():
        print(f"{name}: {sum(right)} of {len(right)} right")
    for why, which in refused.items():
        print(f"refused: {why}: {len(which)}")


if __name__ == "__main__":
    main()
