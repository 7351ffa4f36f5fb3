"""Charge diffusion against a random walk and against depth-by-depth integration; Snell's law; microlenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import integrate
from scipy.special import ndtr

from light_scenes import Spot, camera, centroids, mapped, transfer
from pixmetry.camera.signal import Kind
from pixmetry.camera.silicon import absorption_per_um, refractive_index
from pixmetry.sources.sensor import infrared_diffusion
from pixmetry.sources.sensor.infrared_diffusion import SOURCE, InfraredDiffusion
from pixmetry.sources.sensor.microlens import SOURCE as LENS
from pixmetry.sources.sensor.microlens import Microlens
from source_signals import flat, stream


def test_silicon_lets_infrared_deep_in():
    depth = 1 / absorption_per_um(np.array([600, 800, 900, 950]))
    assert depth == pytest.approx([2.4, 11.8, 33.0, 64.1], rel=0.01)


def test_the_spread_from_one_depth_is_that_of_a_random_walk():
    """Without loss, charge set free at depth d under an absorbing plane arrives with the transfer exp(−2πk d) (Poisson's kernel).

    Walk on spheres: from each place a step to a random point of the sphere that touches the plane, until it is near it. With L → ∞ the
    model's share from depth d is that exponential; its integral over depths is compared in the next test. 20 000 walks: u = 0.007.
    """
    rng, n, d, k = np.random.default_rng(3), 20000, 5.0, 0.03
    x, z = np.zeros(n), np.full(n, d)
    for _ in range(400):
        cos = rng.uniform(-1, 1, n)
        angle = rng.uniform(0, 2 * np.pi, n)
        x, z = x + z * np.sqrt(1 - cos**2) * np.cos(angle), z + z * cos * (z > 1e-4)
    arrived = np.mean(np.cos(2 * np.pi * k * x))
    assert arrived == pytest.approx(np.exp(-2 * np.pi * k * d), abs=0.035)


@pytest.mark.parametrize(("wavelength", "w", "length"), [(850.0, 3.0, 20.0), (940.0, 0.0, 50.0), (600.0, 5.0, 100.0)])
def test_the_transfer_is_the_integral_over_all_depths(wavelength, w, length):
    params = InfraredDiffusion(wavelength_nm=wavelength, depletion_um=w, diffusion_length_um=length, pitch_x_um=10, pitch_y_um=10)
    a = float(absorption_per_um(wavelength))

    def charge(k):
        rate = np.sqrt(1 / length**2 + (2 * np.pi * k) ** 2)
        return (1 - np.exp(-a * w)) + integrate.quad(lambda z: a * np.exp(-a * z - (z - w) * rate), w, np.inf)[0]

    for f in (0.0, 0.1, 0.5, 1.0):
        got = infrared_diffusion.transfer(params, np.array(f), np.array(0.0))
        assert got == pytest.approx(charge(f / 10) / charge(0.0), rel=1e-6)
    depth = integrate.quad(lambda z: z * a * np.exp(-a * z), 0, w)[0]
    depth += integrate.quad(lambda z: z * a * np.exp(-a * z - (z - w) / length), w, np.inf)[0]
    assert infrared_diffusion.mean_depth_um(params) == pytest.approx(depth / charge(0.0), rel=1e-6)


def test_an_image_is_blurred_by_it():
    params = InfraredDiffusion(wavelength_nm=850, diffusion_length_um=15)
    for f in (0.03, 0.1, 2 / 8.25, 0.35, 4 / 8.25):
        expected = infrared_diffusion.transfer(params, np.array(f), np.array(0.0)) * np.sinc(f)
        assert transfer(f, 0.0, (SOURCE, params)) == pytest.approx(expected, abs=5e-4)


@pytest.mark.parametrize("length", [20.0, 60.0, 200.0])
def test_charge_goes_as_far_as_it_diffuses(length):
    """The edge spread is the sine transform of the transfer function; a table folded into ±4 px lacks 0.010, 0.046 and 0.080 at 4 px."""
    params = InfraredDiffusion(wavelength_nm=850, diffusion_length_um=length)
    level = float(infrared_diffusion.transfer(params, np.array(1e9), np.array(0.0)))  # of what is set free where it is collected
    f = (np.arange(400_000) + 0.5) * 1e-4
    h = infrared_diffusion.transfer(params, f, 0 * f) - level
    h *= np.sinc(f) * np.exp(-2 * (np.pi * 0.3 * f) ** 2) / (np.pi * f) * 1e-4
    frame = camera((3, 401), (SOURCE, params)).expose(_Edge(200.0)).data[0, 1].astype(float) / 1e4
    for d in (2, 3, 4, 6, 9, 13, 20, 40):
        expected = 0.5 * (1 - level) - (h * np.sin(2 * np.pi * f * d)).sum()
        assert frame[200 + d] == pytest.approx(expected, abs=1e-3), d


@dataclass(frozen=True)
class _Edge:
    """Light to the left of x0, through a Gaussian of 0.3 px."""

    x0: float
    moving = False
    smooth_px = 0.3

    def radiance(self, at):
        return 1e4 * ndtr((self.x0 - at.x_px) / np.hypot(0.3, at.blur_px))


def test_slanting_rays_shift_the_image_outwards():
    """Ten micrometres of depth under 5° in silicon are 0.87 µm; the angle in air follows from the law of refraction."""
    n = float(refractive_index(800))
    air = np.degrees(np.arcsin(n * np.sin(np.radians(5))))
    params = InfraredDiffusion(wavelength_nm=800, depletion_um=100, chief_ray_deg=air, pitch_x_um=8.6, pitch_y_um=8.6)
    depth = infrared_diffusion.mean_depth_um(params)
    (x,), (y,) = mapped(SOURCE, params, [1000.0], [0.0], (1, 1001))
    assert (x - 1000) * 8.6 / depth == pytest.approx(np.tan(np.radians(5)), rel=1e-3)
    assert y == 0
    spot = Spot(np.array([85.0]), np.array([45.0]), sigma=1.5)
    moved = SOURCE.make({**params.model_dump(), "pitch_x_um": 2.0, "pitch_y_um": 2.0})
    found_x, found_y = centroids(camera((91, 101), (SOURCE, moved)).expose(spot).data)
    true_x, _ = mapped(SOURCE, moved, [85.0], [45.0], (91, 101))
    assert found_x[0] == pytest.approx(true_x[0], abs=0.03)
    assert found_x[0] > 85.2 and found_y[0] == pytest.approx(45, abs=1e-3)


def test_microlenses_answer_by_the_angle_from_their_design(rng: np.random.Generator):
    params = Microlens(chief_ray_deg=25, design_ray_deg=10, acceptance_deg=12)
    light = LENS.forward(params, flat(1.0, (1, 201), kind=Kind.PHOTONS), stream(rng)).data[0, 0]
    assert light[100] == 1
    assert light[200] == pytest.approx(np.exp(-0.5 * (15 / 12) ** 2), rel=1e-6)
    half = np.degrees(np.arctan(0.5 * np.tan(np.radians([25, 10]))))
    assert light[150] == pytest.approx(np.exp(-0.5 * ((half[0] - half[1]) / 12) ** 2), rel=1e-6)


def test_microlenses_as_designed_lose_nothing(rng: np.random.Generator):
    params = Microlens(chief_ray_deg=20, design_ray_deg=20)
    assert (LENS.forward(params, flat(7.0, (9, 11), kind=Kind.PHOTONS), stream(rng)).data == 7).all()
