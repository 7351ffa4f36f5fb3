"""Operators on frames drawn independently: coverage, slopes by finite differences, the ellipse fit, and bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest

from locate import rendered
from locate.target_frames import half_height, rough_targets, z_scores
from pixmetry.core.errors import InputError
from pixmetry.locate.centroids import _operator_kernels as o
from pixmetry.locate.centroids import operators
from pixmetry.locate.centroids.moments import prepare
from pixmetry.locate.centroids.operators import MARGINS, OPERATORS, operator_positions
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.noise import NoiseModel

Z_TAIL = 4.9  # two-sided chance 1e-6
CASES = [(1.0, 0.8, 1.0), (2.0, 0.6, 0.5), (3.0, 0.3, 0.5), (3.0, 0.8, 1.5), (5.0, 1.0, 4.0), (8.0, 0.5, 1.0), (12.0, 1.5, 2.0)]


@pytest.mark.parametrize("name", OPERATORS)
def test_uncertainty_of_operators_covers(lattice, name: str, rng: np.random.Generator) -> None:
    """Mean square of z at most 1 but for chance (1e-6) and 15 %, and not below a tenth.

    The perimeter's error depends on the very radius; it may exceed the largest of four by a quarter.
    """
    for radius, blur, sigma in CASES:
        mean, x, y = lattice(radius, blur, side=11)
        frame = rendered.expose(mean, rng, read_dn=sigma)
        half, peak = half_height(radius, blur)
        found = operator_positions(frame, rough_targets(x, y, half, half, blur, 180 * peak, 20.0, rng), NoiseModel(sigma**2 + 1 / 12), name)
        z = z_scores(found, x, y)
        assert np.isfinite(z).mean() > 0.98, (radius, blur)
        allowed = 1.6 if name == "perimeter" else 1.15
        assert 0.1 < np.nanmean(z**2) < allowed + Z_TAIL * math.sqrt(2 / z.size), (radius, blur, sigma)


@pytest.mark.parametrize("name", ["forstner", "ellipse_edges", "gaussian"])
def test_ellipses_are_covered_too(lattice, name: str, rng: np.random.Generator) -> None:
    mean, x, y = lattice(7.0, 0.8, side=10, minor=4.0, angle_deg=-40.0)
    frame = rendered.expose(mean, rng, read_dn=1.0)
    targets = rough_targets(x, y, 7.0, 4.0, 0.8, 180.0, 20.0, rng, angle_deg=-40.0)
    found = operator_positions(frame, targets, NoiseModel(1 + 1 / 12), name)
    if name == "forstner":  # the normals of an ellipse do not meet in its centre; its symmetry keeps the point there
        assert np.abs(found.x_px - x).max() < 0.1
    assert np.nanmean(z_scores(found, x, y) ** 2) < 1.2 + Z_TAIL * math.sqrt(2 / 200)


@pytest.mark.parametrize("name", ["forstner", "ellipse_edges", "gaussian"])
def test_variance_is_that_of_the_slopes_by_finite_differences(name: str, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """σ² Σ (dx̂/dI)², every pixel of a small frame moved in turn, with the background's fit among the effects; 12 %."""
    monkeypatch.setattr(operators, "_phase_variance", lambda *_: np.zeros(1))
    mean = np.full((37, 37), 20.0)
    at = rendered.window(18.3, 17.8, 8)
    mean[at[0][0] : at[0][-1] + 1, at[1][0] : at[1][-1] + 1] += 150 * rendered.disc(18.3, 17.8, 2.5, 0.9, at)
    targets = rough_targets(np.array([18.3]), np.array([17.8]), 2.5, 2.5, 0.9, 150.0, 20.0, rng)
    noise = NoiseModel(1e-4)

    def place(image: np.ndarray) -> tuple[float, float, float, float]:
        found = operator_positions(image.astype(np.float32), targets, noise, name, threads=1)
        return found.x_px[0], found.y_px[0], found.var_x_px2[0], found.var_y_px2[0]

    _, _, var_x, var_y = place(mean)
    sum_x = sum_y = 0.0
    step = 2.0  # so large that the fixed point's tolerance of 1e-3 px does not matter
    for r in range(7, 30):
        for c in range(7, 30):
            mean[r, c] += step
            more = place(mean)
            mean[r, c] -= 2 * step
            less = place(mean)
            mean[r, c] += step
            sum_x, sum_y = sum_x + ((more[0] - less[0]) / (2 * step)) ** 2, sum_y + ((more[1] - less[1]) / (2 * step)) ** 2
    assert var_x == pytest.approx(1e-4 * sum_x, rel=0.12) and var_y == pytest.approx(1e-4 * sum_y, rel=0.12)


def test_the_direct_fit_finds_an_exact_ellipse_and_equals_opencvs(rng: np.random.Generator) -> None:
    """Points of an ellipse give its centre; scattered ones the same as cv2.fitEllipseDirect, another implementation."""
    cv2 = pytest.importorskip("cv2")
    t = np.linspace(0, 2 * np.pi, 41)[:-1]
    px, py = 0.3 + 1.4 * np.cos(t) * 0.8 - 0.7 * np.sin(t) * 0.6, -0.2 + 1.4 * np.cos(t) * 0.6 + 0.7 * np.sin(t) * 0.8

    def centre(points_x: np.ndarray, points_y: np.ndarray) -> np.ndarray:
        a, b, c, d, e, _ = o.fit_conic(points_x, points_y, len(points_x))
        return np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])

    assert centre(px, py) == pytest.approx([0.3, -0.2], abs=1e-6)
    for _ in range(5):
        qx, qy = px + rng.normal(0, 0.02, 40), py + rng.normal(0, 0.02, 40)
        theirs = cv2.fitEllipseDirect(np.stack([qx, qy], axis=1).astype(np.float32)[:, None])[0]
        assert centre(qx, qy) == pytest.approx(theirs, abs=2e-4)


def test_the_forstner_point_is_that_of_plain_numpy(rng: np.random.Generator) -> None:
    """The weighted intersection of normals over the operator's own window, without the noise's share, against np.linalg.lstsq."""
    from scipy.ndimage import correlate

    mean = np.full((41, 41), 20.0)
    at = rendered.window(20.37, 19.81, 10)
    mean[at[0][0] : at[0][-1] + 1, at[1][0] : at[1][-1] + 1] += 150 * rendered.disc(20.37, 19.81, 4.0, 0.9, at)
    targets = rough_targets(np.array([20.37]), np.array([19.81]), 4.0, 4.0, 0.9, 150.0, 20.0, rng)
    frame = mean.astype(np.float32)
    found = operator_positions(frame, targets, NoiseModel(1e-9), "forstner")
    work = prepare(frame, targets, NoiseModel(1e-9), margin=MARGINS["forstner"])
    reach = 4.0 + work.record[0, o.MARGIN]
    mask = np.array([[3, 10, 3]]) * np.array([[-1], [0], [1]]) / 32
    gy, gx = correlate(mean, mask), correlate(mean, mask.T)
    rows, cols = np.indices(mean.shape)
    use = np.hypot(rows - found.y_px[0], cols - found.x_px[0]) <= reach
    lines = np.stack([-gy[use], gx[use]], axis=1)
    point = np.linalg.lstsq(lines, -gy[use] * cols[use] + gx[use] * rows[use], rcond=None)[0]
    assert (found.x_px[0], found.y_px[0]) == pytest.approx(tuple(point), abs=1.5e-3)


@pytest.mark.parametrize("rough_blur_px", [0.6, 1.8])
@pytest.mark.parametrize("name", OPERATORS)
def test_a_disc_near_the_border_is_found(name: str, rough_blur_px: float, rng: np.random.Generator) -> None:
    """A rough blur may be three times too large; the window, which is then wider than the room beside the disc, ends before the border."""
    for side in range(4):
        for gap in (6.0, 7.5, 9.0):
            place = rng.uniform(24.0, 25.0), gap + rng.uniform(0.0, 0.5)
            y, x = (place, place[::-1], (place[0], 48.0 - place[1]), (48.0 - place[1], place[0]))[side]
            at = rendered.window(x, y, 6.0, (49, 49))
            image = rendered.expose(rendered.planted((49, 49), 10.0, 160.0, [(at, rendered.disc(x, y, 2.0, 0.5, at))]), rng, read_dn=4.0)
            targets = rough_targets(np.array([x]), np.array([y]), 2.1, 2.1, rough_blur_px, 160.0, 10.0, rng)
            found = operator_positions(image, targets, NoiseModel(16 + 1 / 12), name)
            assert math.hypot(found.x_px[0] - x, found.y_px[0] - y) < 6.0 * math.hypot(*np.sqrt([found.var_x_px2[0], found.var_y_px2[0]]))
            assert not found.flags[0] & Flag.NOT_CONVERGED


def test_bad_input(rng: np.random.Generator) -> None:
    targets = rough_targets(np.array([20.0, 1.0]), np.array([20.0, 20.0]), 3.0, 3.0, 0.8, 100.0, 10.0, rng)
    flat = np.full((40, 40), 10, np.uint8)
    for name in OPERATORS:
        assert len(operator_positions(flat, targets[:0], NoiseModel(1.0), name)) == 0
        found = operator_positions(flat, targets, NoiseModel(1.0), name)
        assert (found.flags & Flag.NOT_CONVERGED).all() and np.isnan(found.x_px).all(), name
    with pytest.raises(InputError, match="operator"):
        operator_positions(flat, targets, NoiseModel(1.0), "median")
