"""A laser spot on a surface that moves between frames, in front of whole cameras: does the stated u hold?

``python benchmarks/study_laser_spots.py [--cameras 40] [--frames 40] [--seed 1]``

Random digital cameras with uneven response and dark current, shot noise, row and column noise, a slightly bent response and a converter
of 8 to 14 bits. The spot has a random size, f-number and contrast. In a third of the campaigns every grain pattern is seen in two frames
(the surface moved too little); a third come with dark and bright frames. For each value: mean and standard deviation of
z = (value − truth)/u, its largest, and the mean u over the value. The truth of the scatter is C λN/(√2 π); spots of few grains scatter up
to a tenth less.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np

from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.progress import no_progress
from pixmetry.scene.picture import Picture
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

SHAPE, WAVELENGTH_NM, PITCH_UM = (120, 140), 660.0, 5.0


def camera_of(rng: np.random.Generator, bits: int, gain: float, unit: int) -> Camera:
    """A camera with the usual sources, of its own unit."""
    sources: dict[str, dict[str, object]] = {
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": float(rng.uniform(0.003, 0.015))},
        "sensor.dsnu": {"pixel_std_e": float(rng.uniform(2, 10))},
        "sensor.shot_noise": {},
        "electronics.amplifier_noise": {"white_e": float(rng.uniform(3, 15))},
        "electronics.row_noise": {"row_e": float(rng.uniform(0, 3))},
        "electronics.gain": {"gain_dn_per_e": gain},
        "electronics.nonlinearity": {"a1": float(rng.uniform(-0.02, 0.02)), "reference_dn": float(2**bits - 1)},
        "grabber.adc": {"bits": bits, "offset_dn": 0.02 * 2**bits},
    }
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("lasers", SHAPE, chain, unit_seed=unit)


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=40)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    scores: dict[str, list[tuple[float, float]]] = defaultdict(list)
    untold: dict[str, int] = defaultdict(int)
    for number in range(given.cameras):
        bits = int(rng.choice([8, 10, 12, 14]))
        lambda_n = float(np.exp(rng.uniform(np.log(1.2), np.log(3.5))))
        contrast = float(rng.uniform(0.3, 1.0))
        radius = float(rng.uniform(6, 9)) * lambda_n
        radius = min(max(radius, 8.0), 22.0)
        peak_e = float(rng.uniform(2000, 10000))
        gain = 0.2 * 2**bits / peak_e
        each = int(rng.choice([1, 1, 2]))
        spot = Speckle(70.3, 58.7, radius, peak_e, lambda_n, contrast=contrast, seed=int(rng.integers(1e9)), frames_each=each)
        camera = camera_of(rng, bits, gain, number)
        frames = camera.expose(Picture((spot,), Uniform(0.002 * peak_e)), given.frames, seed=number).data.astype(np.uint16)
        groups = [Frames("speckle", 0.01, frames, facts=GroupFacts(wavelength_nm=WAVELENGTH_NM))]
        if number % 3 == 0:
            for k, level in enumerate(np.linspace(0.05, 0.8, 5) * 2**bits / gain):
                lit = camera.expose(Uniform(float(level)), 2, seed=10_000 + 100 * number + 2 * k).data.astype(np.uint16)
                dark = camera.expose(Uniform(0.0), 2, seed=10_001 + 100 * number + 2 * k).data.astype(np.uint16)
                groups += [Frames("bright", 0.001 * (k + 1), lit), Frames("dark", 0.001 * (k + 1), dark)]
        seen = observe_campaign(campaign_of_arrays(groups, bits=bits, pitch_um=PITCH_UM, name="camera"), no_progress)[1]
        estimates, unmeasured = measure_sources(seen)
        law = contrast * lambda_n / (np.sqrt(2) * np.pi)
        truth = {"contrast_rel": contrast, "airy_px": lambda_n, "scatter_x_px": law, "scatter_y_px": law}
        fit = seen.speckle.fit
        for name, value in truth.items():
            if name not in fit:
                untold[name] += 1
                continue
            found = fit[name]
            u = found.u * value / found.value if name.startswith("scatter") else found.u  # χ² of the truth's size
            scores[name].append(((found.value - value) / u, u / value))
        if "scene.speckle" in estimates:
            if "f_number" in fit or "airy_px" in fit:
                n = estimates["scene.speckle"]["f_number"]
                scores["scene.speckle f_number"].append(((n.value - 1e3 * lambda_n * PITCH_UM / WAVELENGTH_NM) / n.u, n.u / n.value))
        else:
            untold[unmeasured["scene.speckle"][:60]] += 1
    for name, values in scores.items():
        z, u = np.array(values).T
        print(f"{name:24s} n {len(z):3d}  mean z {z.mean():+.2f}  std z {z.std():.2f}  largest {np.abs(z).max():.1f}  u {u.mean():.3f}")
    for name, count in untold.items():
        print(f"not told: {name} ({count})")


if __name__ == "__main__":
    main()
