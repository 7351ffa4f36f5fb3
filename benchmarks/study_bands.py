"""The same targets in light of several wavelengths, in front of whole cameras: does the stated u hold?

``python benchmarks/study_bands.py [--cameras 20] [--seed 1]``

Random digital cameras with a lens whose scale and focus change with the wavelength, charge that diffuses in the infrared, distortion,
uneven response and dark current, shot noise, row noise, a bent response and a converter of 8 to 12 bits see 24 discs in 3 to 6 bands, four
frames of each; between the bands the camera moves a little. In half of the campaigns the lens is focused anew in each band, which tells
the diffusion length in place of the lateral colour. For each value: mean and standard deviation of z = (value − truth)/u, its largest, and
the mean u; of limits, how often they hold.
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
from pixmetry.scene.outlines import disc
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

SHAPE, PITCH_UM = (200, 280), 5.0
PLACES = [(26.0 + 46 * i, 26.0 + 48 * j) for i in range(6) for j in range(4)]
REFERENCE_NM = 550.0


def camera_of(rng: np.random.Generator, bits: int, gain: float, unit: int, own: dict[str, dict[str, object]]) -> Camera:
    """A camera with the usual sources and those of a band, of its own unit."""
    sources: dict[str, dict[str, object]] = {
        **own,
        "sensor.quantum_efficiency": {"quantum_efficiency": 1.0},
        "sensor.prnu": {"pixel_std_rel": 0.006},
        "sensor.dsnu": {"pixel_std_e": 6.0},
        "sensor.shot_noise": {},
        "electronics.amplifier_noise": {"white_e": 12.0},
        "electronics.row_noise": {"row_e": 2.0},
        "electronics.gain": {"gain_dn_per_e": gain},
        "electronics.nonlinearity": {"a1": 0.01, "reference_dn": float(2**bits - 1)},
        "grabber.adc": {"bits": bits, "offset_dn": 0.04 * 2**bits},
    }
    found = {name: get_source(name) for name in sources}
    chain = tuple(Element(s.id, s, s.parameters(**sources[s.id])) for s in in_order(found.values()))
    return Camera("bands", SHAPE, chain, unit_seed=unit)


def main() -> None:
    """Print one line for each value."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    scores: dict[str, list[tuple[float, float]]] = defaultdict(list)
    limits: dict[str, list[bool]] = defaultdict(list)
    untold: dict[str, int] = defaultdict(int)
    for number in range(given.cameras):
        bits, full_e = int(rng.choice([8, 10, 12])), float(rng.uniform(5000, 20000))
        slope = float(rng.choice([0.0, rng.uniform(-5e-6, 5e-6)]))
        length = float(rng.choice([0.0, rng.uniform(5, 20)]))
        anew = bool(number % 2)
        visible = rng.choice([450.0, 500.0, 530.0, 590.0, 630.0, 660.0], int(rng.integers(2, 5)), replace=False)
        sharp, diameter = float(rng.uniform(0.4, 0.7)), float(rng.uniform(7, 12))
        groups = []
        for k, nm in enumerate([*visible, 850.0]):
            colour = 0.0 if anew else abs(float(nm) - 560.0) / 600.0  # of the focus, in px of blur
            own: dict[str, dict[str, object]] = {
                "optics.point_spread": {"sigma_px": float(np.hypot(sharp, colour))},
                "optics.distortion": {"k1_per_mm2": 1e-3, "pitch_x_um": PITCH_UM, "pitch_y_um": PITCH_UM},
                "optics.lateral_colour": {"scale_per_nm": slope, "mean_nm": float(nm), "reference_nm": REFERENCE_NM},
            }
            if length and nm > 700:
                both = {"pitch_x_um": PITCH_UM, "pitch_y_um": PITCH_UM, "reach_px": 12.0}
                own["sensor.infrared_diffusion"] = {"wavelength_nm": 850.0, "diffusion_length_um": length, **both}
            camera = camera_of(rng, bits, 0.9 * 2**bits / full_e, number, own)
            dx, dy = rng.uniform(-0.5, 0.5, 2)
            discs = [disc(x + dx, y + dy, diameter, rng.uniform(0.4, 0.6) * full_e) for x, y in PLACES]
            taken = camera.expose(Picture((Shapes.of(discs),), Uniform(0.01 * full_e)), 4, seed=100 * number + k).data
            facts = GroupFacts(wavelength_nm=float(nm), refocused=anew or None)
            groups.append(Frames("bands", float(rng.uniform(0.01, 0.04)), taken.astype(np.uint16), facts=facts))
        campaign = campaign_of_arrays(groups, bits=bits, name="camera", pitch_um=PITCH_UM, optics={"f_number": 4.0})
        estimates, unmeasured = measure_sources(observe_campaign(campaign, no_progress)[1])
        for source, name, truth in (
            ("optics.lateral_colour", "scale_per_nm", slope),
            ("sensor.infrared_diffusion", "diffusion_length_um", length),
        ):
            if source not in estimates:
                untold[unmeasured[source][:90]] += 1
                continue
            found = estimates[source][name]
            if found.is_limit:
                limits[name].append(found.value >= truth)
            else:
                scores[name].append(((found.value - truth) / found.u, found.u))
    for name, values in scores.items():
        z, u = np.array(values).T
        print(f"{name:24s} n {len(z):3d}  mean z {z.mean():+.2f}  std z {z.std():.2f}  largest {np.abs(z).max():.1f}  u {u.mean():.2g}")
    for name, held in limits.items():
        print(f"{name:24s} {sum(held)} of {len(held)} limits hold")
    for why, count in untold.items():
        print(f"not told: {why} ({count})")


if __name__ == "__main__":
    main()
