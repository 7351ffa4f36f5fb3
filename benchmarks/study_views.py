"""Targets from several sides, in front of whole cameras: does the stated u hold?

``python benchmarks/study_views.py [--cameras 30] [--seed 1]``

Random digital cameras with lens, uneven response and dark current, shot noise, row noise, a bent response and a converter of 8 to 12 bits
see twelve discs from 6 to 12 sides, in light that slopes over each target, otherwise in each view. For each value: mean and standard
deviation of z = (value − truth)/u, its largest, and the mean u over the value; without slopes, how often the limit holds.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import observe_campaign
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.core.progress import no_progress
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.outlines import ellipse
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

SHAPE = (150, 200)
PLACES = [(30.0 + 46 * i, 30.0 + 45 * j) for i in range(4) for j in range(3)]


def camera_of(rng: np.random.Generator, bits: int, gain: float, unit: int) -> Camera:
    """A camera with the usual sources, of its own unit."""
    sources: dict[str, dict[str, object]] = {
        "optics.point_spread": {"sigma_px": float(rng.uniform(0.4, 0.9))},
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": float(rng.uniform(0.002, 0.01))},
        "sensor.dsnu": {"pixel_std_e": float(rng.uniform(2, 10))},
        "sensor.shot_noise": {},
        "electronics.amplifier_noise": {"white_e": float(rng.uniform(5, 20))},
        "electronics.row_noise": {"row_e": float(rng.uniform(0, 3))},
        "electronics.gain": {"gain_dn_per_e": gain},
        "electronics.nonlinearity": {"a1": float(rng.uniform(-0.02, 0.02)), "reference_dn": float(2**bits - 1)},
        "grabber.adc": {"bits": bits, "offset_dn": 0.04 * 2**bits},
    }
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("views", SHAPE, chain, unit_seed=unit)


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    scores: dict[str, list[tuple[float, float]]] = defaultdict(list)
    held = []
    for number in range(given.cameras):
        bits = int(rng.choice([8, 10, 12]))
        full_e = float(rng.uniform(5000, 20000))
        camera = camera_of(rng, bits, 0.9 * 2**bits / full_e, number)
        views, std = int(rng.integers(6, 13)), float(rng.choice([0.0, rng.uniform(0.003, 0.02)]))
        diameter, tilts = float(rng.uniform(6, 12)), rng.uniform(0, 50, views)
        frames, slopes = [], rng.normal(0, std, (views, 2))
        for k, (tilt, slope) in enumerate(zip(tilts, slopes, strict=True)):
            turn = float(rng.uniform(0, 180))
            discs = []
            for x, y in PLACES:  # the light of each disc slopes by as much, about its own centre
                at_x, at_y = x + rng.uniform(-0.5, 0.5), y + rng.uniform(-0.5, 0.5)
                discs.append((at_x, at_y))
            parts = [
                camera.expose(
                    Picture(
                        (Shapes.of([ellipse(x, y, diameter, diameter * np.cos(np.radians(tilt)), turn, 0.6 * full_e)]),),
                        Uniform(0.0),
                        Lighting("gradient", x, y, slope[0], slope[1]),
                    ),
                    1,
                    seed=1000 * number + 20 * k + n,
                ).data[0]
                for n, (x, y) in enumerate(discs)
            ]
            frame = parts[0].copy()
            for n, (x, y) in enumerate(discs):
                box = slice(int(y) - 18, int(y) + 19), slice(int(x) - 18, int(x) + 19)
                frame[box] = parts[n][box]
            frames.append(frame.astype(np.uint16))
        campaign = campaign_of_arrays([Frames("views", 0.01, np.array(frames))], bits=bits, name="camera")
        found = observe_campaign(campaign, no_progress)[1].views
        assert found is not None
        slope = found.fit["gradient_rel_per_px"]
        if std == 0:
            held.append(slope.value > 0 and slope.is_limit)
        else:
            scores["gradient, of all such views"].append(((np.log(slope.value / std)) * slope.value / slope.u, slope.u / std))
        for name, values, truth, u in (
            ("slope of one target along x", found.gradient_x_per_px, slopes[found.view, 0], found.u_gradient_x_per_px),
            ("slope of one target along y", found.gradient_y_per_px, slopes[found.view, 1], found.u_gradient_y_per_px),
        ):
            scores[name] += [(float(z), float(one)) for z, one in zip((values - truth) / u, u, strict=True)]
        steep = tilts > 15
        for z, one in zip(((found.angle_deg - tilts) / found.u_angle_deg)[steep], found.u_angle_deg[steep], strict=True):
            scores["angle of a view above 15 deg"].append((float(z), float(one)))
    for name, values in scores.items():
        z, u = np.array(values).T
        print(f"{name:30s} n {len(z):4d}  mean z {z.mean():+.2f}  std z {z.std():.2f}  largest {np.abs(z).max():.1f}  u {u.mean():.3g}")
    print(f"no slope: a limit in {sum(held)} of {len(held)}")


if __name__ == "__main__":
    main()
