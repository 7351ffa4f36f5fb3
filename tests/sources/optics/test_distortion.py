"""Distortion: Brown's polynomial term by term, its inverse by bracketing, folds, and the shift of a target of finite size."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from light_scenes import Spot, camera, centroids, mapped, signal_of
from pixmetry.core.errors import ParameterError
from pixmetry.sources.optics.distortion import SOURCE, Distortion, pull_of
from source_signals import stream

SHAPE = (582, 752)
CENTRE = np.array([375.5, 290.5])


def brown(x: np.ndarray, y: np.ndarray, p: Distortion) -> tuple[np.ndarray, np.ndarray]:
    r = np.hypot(x, y)
    radial = p.k1_per_mm2 * r**2 + p.k2_per_mm4 * r**4 + p.k3_per_mm6 * r**6 + p.k4_per_mm8 * r**8 + p.k5_per_mm10 * r**10
    dx = x * radial + p.p1_per_mm * (r**2 + 2 * x**2) + 2 * p.p2_per_mm * x * y
    dy = y * radial + p.p2_per_mm * (r**2 + 2 * y**2) + 2 * p.p1_per_mm * x * y
    return x + dx, y + dy


ALL = dict(
    k1_per_mm2=-1e-3, k2_per_mm4=3e-5, k3_per_mm6=-1e-6, k4_per_mm8=2e-8, k5_per_mm10=-3e-10, p1_per_mm=5e-5, p2_per_mm=-8e-5,
    centre_x_px=12.0, centre_y_px=-7.0,
)  # fmt: skip


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
def test_the_map_is_the_polynomial_or_its_inverse(direction, rng: np.random.Generator):
    params = Distortion(direction=direction, **ALL)
    x, y = rng.uniform(0, 751, 500), rng.uniform(0, 581, 500)
    u, v = pull_of(params, SHAPE)(x, y)
    mm = np.array([[0.0086], [0.0083]])
    place, ideal = (np.array(q) - (CENTRE + [12, -7])[:, None] for q in ((x, y), (u, v)))
    if direction == "object_to_image":
        place, ideal = ideal, place
    assert np.array(brown(*(place * mm), params)) == pytest.approx(ideal * mm, abs=1e-10)


def test_a_purely_radial_inverse_by_bracketing():
    params = Distortion(direction="object_to_image", k1_per_mm2=-8e-3, pitch_x_um=8.0, pitch_y_um=8.0)
    u, v = pull_of(params, SHAPE)(np.array([700.0]), np.array([500.0]))
    seen = 0.008 * np.hypot(700 - 375.5, 500 - 290.5)
    root = brentq(lambda r: r - 8e-3 * r**3 - seen, 0, 5, xtol=1e-14)
    assert 0.008 * np.hypot(u - 375.5, v - 290.5) == pytest.approx(root, abs=1e-10)
    assert np.arctan2(v - 290.5, u - 375.5) == pytest.approx(np.arctan2(209.5, 324.5), abs=1e-12)


def test_the_two_directions_undo_each_other():
    there, back = (pull_of(Distortion(direction=d, **ALL), SHAPE) for d in ("image_to_object", "object_to_image"))
    x, y = np.meshgrid(np.linspace(0, 751, 20), np.linspace(0, 581, 20))
    for one, other in ((there, back), (back, there)):
        u, v = other(*one(x, y))
        assert np.abs([u - x, v - y]).max() < 1e-8


def test_barrel_distortion_moves_points_inwards_and_the_image_shows_it():
    """Ideal places go to the image by x (1 + K1 r²) with K1 < 0."""
    params = Distortion(direction="object_to_image", k1_per_mm2=-2e-3, pitch_x_um=10, pitch_y_um=10)
    shape = (201, 301)
    (x,), (y,) = mapped(SOURCE, params, [270.0], [100.0], shape)
    assert (x, y) == pytest.approx((150 + 120 * (1 - 2e-3 * 1.2**2), 100), abs=1e-9)
    spot = Spot(np.array([270.0]), np.array([100.0]), sigma=1.5)
    found_x, found_y = centroids(camera(shape, (SOURCE, params)).expose(spot).data)
    k = -2e-3 * 0.01**2  # 1/px²
    jacobian = 1.5**2 * (0.5 * 8 * k * 120 + 8 * k * 120)  # δ + ⟨x²⟩(½∇²δ_x + ∂_x∇·δ) of a moved image whose brightness is kept
    assert found_x[0] - x == pytest.approx(jacobian, rel=0.1, abs=2e-5)
    assert found_y[0] == pytest.approx(100, abs=1e-6)


@pytest.mark.parametrize("direction", ["image_to_object", "object_to_image"])
@pytest.mark.parametrize("bad", [{"k1_per_mm2": -0.05}, {"p1_per_mm": 0.01, "k1_per_mm2": -0.03}])
def test_a_map_that_folds_is_refused(direction, bad):
    with pytest.raises(ParameterError, match="folds"):
        pull_of(Distortion(direction=direction, **bad), SHAPE)


def test_truth_is_the_displacement_of_the_image(rng: np.random.Generator):
    params = Distortion(**ALL)
    told = SOURCE.truth(params, signal_of(SOURCE, params, (60, 80)), stream(rng))
    (x,), (y,) = mapped(SOURCE, params, [71.3], [52.8], (60, 80))
    col, row = int(round(x)), int(round(y))
    assert (told["shift_x_px"][row, col], told["shift_y_px"][row, col]) == pytest.approx((x - 71.3, y - 52.8), abs=2e-4)
