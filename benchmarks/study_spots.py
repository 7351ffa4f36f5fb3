"""Bright spots and a light that goes off, in front of whole cameras: does the stated u hold?

``python benchmarks/study_spots.py [--cameras 20] [--seed 1]``

Random CCD cameras with every usual source on: point spread, uneven response and dark current, shot noise, charge transfer, lag, row and
column noise, a bent response, a converter of 12 bits. Each takes four frames of three discs at six exposures, and a sequence in which the
light goes off. Smear, blooming, cross-talk and lag are measured blind. For each value: mean and rms of z = (value − truth)/u, its largest,
and the mean u; of a limit, how often it holds; of what is absent, how often it is found.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.core.progress import no_progress
from pixmetry.scene.discs import Discs
from pixmetry.scene.outlines import disc
from pixmetry.scene.picture import Picture as Scene
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

SHAPE, WELL_E, GAIN = (288, 224), 16_000.0, 0.2
TIMES_S = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032)
PEAK_E_PER_S = 0.45 * WELL_E / TIMES_S[0]
PLACES = ((50.0, 140.0), (112.0, 150.0), (170.0, 146.0))


def camera_of(sources: dict[str, dict[str, object]], unit: int) -> Camera:
    """A camera with these sources, of its own unit."""
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("spotted", SHAPE, chain, unit_seed=unit)


def spots_of(exposure_s: float, places: list[tuple[float, float]]) -> Scene:
    """Discs of 6 px, as photons of one exposure."""
    discs = [disc(x, y, 6.0, PEAK_E_PER_S * exposure_s) for x, y in places]
    return Scene((Shapes.of(discs),), Uniform(0.0))


def lamp(bright: int, frames: int) -> Discs:
    """A wide disc that is far away after some frames: a light that goes off."""
    x = np.where(np.arange(frames) < bright, SHAPE[1] / 2, 1e5)[:, None]
    return Discs(x, np.full((frames, 1), SHAPE[0] / 2), 500.0, peak_photons=0.5 * WELL_E, per_frame=True)


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    z, stated, holds, false = (defaultdict(list) for _ in range(4))
    for number in range(given.cameras):
        truth = {
            "smear": float(rng.choice([0.0, 2e-5, 1e-4])),
            "up": float(rng.uniform(0.4, 0.6)),
            "ratio": float(rng.choice([1.0, 1.0, 1.5])),
            "lag": float(rng.choice([0.0, 0.002, 0.02])),
        }
        rows, store = str(rng.choice(["all", "passed"])), str(rng.choice(["below", "above"]))
        sources: dict[str, dict[str, object]] = {
            "optics.point_spread": {"sigma_px": 1.0},
            "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
            "sensor.prnu": {"pixel_std_rel": 0.008, "col_std_rel": 0.001},
            "sensor.dsnu": {"pixel_std_e": 3.0, "col_std_e": 1.0},
            "sensor.dark_current": {"rate_e_per_s": 30.0, "spread_log": 0.3},
            "sensor.smear": {"transfer_s": truth["smear"], "rows": rows, "store": store},
            "sensor.shot_noise": {},
            "sensor.blooming": {"full_well_e": WELL_E, "up_share": truth["up"], "drain_ratio": truth["ratio"]},
            "sensor.image_lag": {"lag_rel": truth["lag"]},
            "sensor.charge_transfer": {"parallel_cti": 1e-5, "serial_cti": 1e-5},
            "electronics.amplifier_noise": {"white_e": 8.0},
            "electronics.row_noise": {"row_e": 1.5},
            "electronics.gain": {"gain_dn_per_e": GAIN},
            "electronics.nonlinearity": {"a1": float(rng.uniform(-0.002, 0.002)), "reference_dn": 4095.0},
            "grabber.adc": {"bits": 12, "offset_dn": 100.0},
        }
        camera = camera_of(sources, number)
        places = [(x + rng.uniform(-4, 4), y + rng.uniform(-4, 4)) for x, y in PLACES]
        groups = []
        for k, time in enumerate(TIMES_S):
            taken = camera.expose(spots_of(time, places), 5, seed=1000 * number + k, exposure_s=time).data[1:]  # lag has settled
            groups.append(Frames("spots", time, taken.astype(np.uint16)))
        lit = camera.expose(lamp(4, 20), 20, seed=1000 * number + 99, exposure_s=0.002).data
        groups.append(Frames("light_off", 0.002, lit.astype(np.uint16)))
        _, seen = observe_campaign(campaign_of_arrays(groups, bits=12, sensor="ccd"), no_progress)
        estimates, unmeasured = measure_sources(seen)
        names = {
            "sensor.smear": {"transfer_s": truth["smear"]},
            "sensor.blooming": {"up_share": truth["up"], "drain_ratio": truth["ratio"], "drained_share": 0.0},
            "sensor.image_lag": {"lag_rel": truth["lag"]},
        }
        for source, values in names.items():
            if source not in estimates:
                print(f"camera {number}: {unmeasured[source]}")
                continue
            for name, value in values.items():
                if name not in estimates[source]:
                    continue
                found = estimates[source][name]
                absent = value == (1.0 if name == "drain_ratio" else 0.0)
                if found.is_limit:
                    holds[name].append(found.value >= value)
                elif absent:
                    false[name].append(found.value)
                else:
                    z[name].append((found.value - value) / found.u)
                    stated[name].append(found.u)
        if truth["smear"] and "sensor.smear" in estimates and not estimates["sensor.smear"].limits and seen.spots is not None:
            holds["rows of smear"].append((seen.spots.smear_rows, seen.spots.smear_store) == (rows, store if rows == "passed" else "below"))
    for name in sorted({*z, *holds, *false}):
        line = f"{name}: "
        if z[name]:
            line += f"{len(z[name])} values, z {np.mean(z[name]):.2f} ± {np.std(z[name]):.2f}, largest {np.max(np.abs(z[name])):.1f}, "
            line += f"u {np.mean(stated[name]):.2g}; "
        print(line + f"{sum(holds[name])} of {len(holds[name])} hold; found though absent {len(false[name])}")


if __name__ == "__main__":
    main()
