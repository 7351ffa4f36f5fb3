"""Frames in a row and rows of dark frames, by whole cameras: does the stated u hold?

``python benchmarks/study_sequence.py [--cameras 20] [--seed 1]``

Random digital cameras of 12 bits with every usual source on: point spread, shading, uneven response and dark current, shot noise, row
noise, amplifier noise, 1/f noise, hum, a response that bends a little, and a gain that follows the scene (in every other camera it is
locked). A bright patch comes and goes; the lamp flickers in two of three cameras. Measured blind are the loop, the lamp, hum and 1/f noise,
and the gain from flat frames taken with the loop off. For each value: mean and rms of z = (value − truth)/u, its largest, and the mean u.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.progress import no_progress
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SHAPE, GAIN, LINE_US, CLOCK_MHZ = (144, 160), 0.2, 24.0, 8.0


def camera_of(sources: dict[str, dict[str, object]], unit: int, without: tuple[str, ...] = ()) -> Camera:
    """A camera with these sources, of its own unit."""
    found = {name: get_source(name) for name in sources if name not in without}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("in a row", SHAPE, chain, unit_seed=unit)


def scene_of(frames: int, period: int, light: float, patch: float) -> Discs:
    """Three discs that stay and one, a sixth of the frame, that comes and goes."""
    x, y = np.tile([30.0, 60.0, 130.0, 110.0], (frames, 1)), np.tile([30.0, 120.0, 40.0, 100.0], (frames, 1))
    x[(np.arange(frames) // (period // 2)) % 2 == 0, 3] = 1e5
    peaks = np.array([-0.5, 0.6, 0.3, patch - 1]) * light
    return Discs(x, y, 70.0, blur_px=1.0, peak_photons=peaks, background=Uniform(light), per_frame=True)


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    z, stated, counts = defaultdict(list), defaultdict(list), Counter()
    for number in range(given.cameras):
        kappa = 0.0 if number % 2 else float(np.exp(rng.uniform(np.log(0.05), np.log(0.8))))
        depth, hertz, target = float(rng.choice([0.0, 0.02, 0.1])), float(rng.uniform(110, 190)), float(rng.uniform(500, 900))
        hum, hum_hertz, flicker_e = float(rng.choice([0.0, 1.0])), float(rng.uniform(3000, 18000)), float(rng.choice([0.0, 8.0]))
        exposure_s = float(rng.uniform(0.001, 0.003))
        sources: dict[str, dict[str, object]] = {
            "optics.point_spread": {"sigma_px": 1.0},
            "optics.flicker": {"depth_rel": depth, "frequency_hz": hertz},
            "sensor.rolling_shutter": {"row_time_s": LINE_US * 1e-6},
            "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
            "sensor.prnu": {"pixel_std_rel": 0.008, "col_std_rel": 0.001},
            "sensor.dsnu": {"pixel_std_e": 3.0, "col_std_e": 1.0},
            "sensor.dark_current": {"rate_e_per_s": 30.0, "spread_log": 0.3},
            "sensor.shot_noise": {},
            "electronics.amplifier_noise": {"white_e": 8.0},
            "electronics.row_noise": {"row_e": 1.0},
            "electronics.flicker_noise": {"rms_e": flicker_e, "corner_rel": 0.1, "octaves": 12, "line_px": LINE_US * CLOCK_MHZ},
            "electronics.gain": {"gain_dn_per_e": GAIN},
            "electronics.nonlinearity": {"a1": float(rng.uniform(-0.002, 0.002)), "reference_dn": 4095.0},
            "electronics.agc": {"kappa": kappa, "target_dn": target, "lowest_db": -20.0, "highest_db": 20.0},
            "electronics.supply_pickup": {
                "amplitude_dn": hum,
                "frequency_hz": hum_hertz,
                "line_time_us": LINE_US,
                "pixel_time_ns": 1e3 / CLOCK_MHZ,
            },
            "grabber.adc": {"bits": 12, "offset_dn": 60.0},
        }
        camera = camera_of(sources, number)
        locked = camera_of(sources, number, without=("electronics.agc", "optics.flicker"))
        scene = scene_of(60, 2 * int(rng.integers(4, 9)), 5500.0, float(rng.uniform(1.3, 1.9)))
        taken = camera.expose(scene, 60, seed=1000 * number, exposure_s=exposure_s).data
        groups = [Frames("sequence", exposure_s, taken.astype(np.uint16), facts=GroupFacts(interval_s=0.04))]
        stack = locked.expose(Uniform(0.0), 24, seed=1000 * number + 1, exposure_s=0.002).data
        groups.append(Frames("dark", 0.002, stack.astype(np.uint16), role="stack"))
        for k in range(1, 9):
            for kind, light in (("dark", 0.0), ("bright", 2200.0 * k)):
                level = locked.expose(Uniform(light), 2, seed=1000 * number + 10 * k + (kind == "dark"), exposure_s=0.001 * k).data
                groups.append(Frames(kind, 0.001 * k, level.astype(np.uint16)))
        clocks = {"line_time_us": LINE_US, "pixel_clock_mhz": CLOCK_MHZ}
        _, seen = observe_campaign(campaign_of_arrays(groups, bits=12, **clocks), no_progress)
        told, refused = measure_sources(seen)
        truth = {
            "electronics.agc": {"kappa": kappa, "target_dn": target},
            "optics.flicker": {"depth_rel": depth, "frequency_hz": hertz},
            "electronics.supply_pickup": {"amplitude_dn": hum, "frequency_hz": hum_hertz},
            "electronics.flicker_noise": {"rms_e": flicker_e},
            "electronics.row_noise": {"row_e": 1.0},
            "electronics.amplifier_noise": {"white_e": 8.0},
            "electronics.gain": {"gain_dn_per_e": GAIN},
        }
        for source, values in truth.items():
            absent = not next(iter(values.values()))
            if source not in told:
                counts[f"{source}: {'absent' if absent else 'there'}, not told: {refused[source][:110]}"] += 1
                continue
            for name, value in values.items():
                if name not in told[source]:
                    continue
                found = told[source][name]
                if absent:
                    counts[f"{source}: absent, {'limit' if found.is_limit else 'locked' if found.value == 0 else 'FALSE'}"] += 1
                    break
                if found.is_limit or found.u == 0:
                    counts[f"{source}.{name}: there, limit {'holds' if found.value >= value else 'MISSES'}"] += 1
                    continue
                z[f"{source}.{name}"].append((found.value - value) / found.u)
                stated[f"{source}.{name}"].append(found.u / value)
    for name, values in sorted(z.items()):
        line = f"{name}: {len(values)} values, z {np.mean(values):+.2f} ± {np.std(values):.2f}, largest {np.max(np.abs(values)):.1f}"
        print(f"{line}, u {100 * np.median(stated[name]):.2g} %")
    for name, count in sorted(counts.items()):
        print(f"{count} × {name}")


if __name__ == "__main__":
    main()
