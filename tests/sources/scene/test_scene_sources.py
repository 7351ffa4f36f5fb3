"""Speckle, view-point and sampling: their contributions against simulated scenes and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.budget.probe import Facts, Target, make_probe
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.contribution import Probe
from pixmetry.core.random import Grid
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.locate.circles.eccentricity import circle_seen
from pixmetry.scene.speckle import Speckle as Spot
from pixmetry.sources.scene.speckle import pixel_covariance

FACTS = Facts(1.0, 1.0, 1000.0, 1.0, 12, 0.01, 20.0, (400, 400))


def probe_of(target: Target, window: int = 31) -> Probe:
    return make_probe(FACTS, target, FixedCentroid(window=window), phases=4)


def centres_of_spots(spot: Spot, frames: int, side: int) -> np.ndarray:
    """Centroids of the light of realisations, less their truth, shape (frames, 2)."""
    zero = np.zeros(frames)
    grid = Grid(np.arange(frames), np.zeros(frames, int), np.zeros(frames, int), (side, side))
    light = spot.render(grid, (side, side), zero, zero, False)[:, 0]
    total = light.sum(axis=(1, 2))
    x = (light.sum(axis=1) @ np.arange(side)) / total - spot.x_px
    y = (light.sum(axis=2) @ np.arange(side)) / total - spot.y_px
    return np.stack([x, y], axis=1)


@pytest.mark.parametrize("lambda_n_px", [0.5, 1.0])
def test_speckle_of_a_uniform_spot_is_that_of_simulated_ones(lambda_n_px: float, seed: int) -> None:
    """120 spots of 14 px: the standard deviation over both axes is known to 4.6 %, 1e-6 lies at 4.9 of these.

    The window takes in what the pupil spreads; 25 % is declared as the error of the first order.
    """
    spot = Spot(31.0, 31.0, 7.0, 1000.0, lambda_n_px, profile="uniform", seed=seed)
    seen = np.sqrt(np.mean(centres_of_spots(spot, 120, 63) ** 2))
    source = get_source("scene.speckle")
    params = source.make({"contrast_rel": 1.0, "wavelength_nm": 550.0, "f_number": lambda_n_px / 0.55, "pitch_um": 1.0})
    assert params.lambda_n_px == pytest.approx(lambda_n_px)
    said = source.propagate(params, probe_of(Target(diameter_px=14.0, blur_px=0.4 * lambda_n_px, background_rel=0.0)))
    assert seen == pytest.approx(said.u_x_px, rel=said.model_error + 4.9 * 0.046)
    assert 0.7 < said.u_x_px / (lambda_n_px / np.pi) < 1.05  # Dorsch's law for a uniform disc much larger than the grains


def test_speckle_is_in_proportion_to_its_contrast_and_symmetrical() -> None:
    source, probe = get_source("scene.speckle"), probe_of(Target(background_rel=0.0))
    whole, half = (source.propagate(source.make({"contrast_rel": c}), probe) for c in (1.0, 0.5))
    assert half.u_x_px == pytest.approx(0.5 * whole.u_x_px)
    assert whole.u_x_px == pytest.approx(whole.u_y_px, rel=1e-6)


def test_the_covariance_of_pixels_sums_to_the_area_of_a_grain() -> None:
    """Σ C = ∫ (2 J₁(v)/v)² dA = (4/π)(λN)², Goodman's correlation area of a round pupil; what lies beyond 40 px is 2 % of it."""
    assert pixel_covariance(2.0, 40).sum() == pytest.approx(4 / np.pi * 4.0, rel=0.02)


def test_a_gradient_moves_a_centroid_by_its_mean_square_radius() -> None:
    """P3: Δ = g ⟨x²⟩, of a disc under a blur R²/4 + s², with that of the pixel, 1/12."""
    source = get_source("scene.view_point")
    said = source.propagate(source.make({"gradient_rel_per_px": 0.01}), probe_of(Target(background_rel=0.0)))
    assert said.u_x_px == pytest.approx(0.01 * (3.5**2 / 4 + 0.7**2 + 1 / 12), rel=0.02)


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, 70.0])
def test_the_eccentricity_is_that_of_a_projected_circle(angle_deg: float) -> None:
    """Against the exact ellipse of a circle that is tilted about x, seen in the middle of the image."""
    c, distance, radius, tilt = 2000.0, 100.0, 1.5, np.radians(angle_deg)
    plane = np.array([[1.0, 0, 0], [0, np.cos(tilt), 0], [0, np.sin(tilt), distance]])
    _, centres = circle_seen(np.diag([c, c, 1.0]) @ plane, 0.0, 0.0, radius)
    params = get_source("scene.view_point").make(
        {"view_angle_deg": angle_deg, "diameter_px": 2 * c * radius / distance, "principal_distance_px": c}
    )
    assert params.eccentricity_px == pytest.approx(float(np.hypot(centres.shift_x_px[0], centres.shift_y_px[0])), rel=2e-3)


@pytest.mark.parametrize("sigma_px", [0.3, 0.45])
def test_sampling_of_a_point_swings_with_its_phase(sigma_px: float) -> None:
    """A small disc under a Gaussian blur behind a pixel box: a₁ = OTF(1)/π, with the disc's own transform 2 J₁(v)/v."""
    from scipy.special import j1

    diameter = 0.5
    v = np.pi * diameter
    otf = np.exp(-2 * (np.pi * sigma_px) ** 2) * 2 * j1(v) / v
    source = get_source("sensor.sampling")
    found = source.propagate(source.typical, probe_of(Target(diameter_px=diameter, blur_px=sigma_px, background_rel=0.0)))
    assert found.u_x_px == pytest.approx(otf / np.pi / np.sqrt(2), rel=0.03)
