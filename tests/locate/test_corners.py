"""Chessboard corners drawn by brute force: no bias with the sub-pixel phase, errors at the Cramér–Rao bound, honest covariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.grids import Grid
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template.corners import (
    chessboard_reach_px,
    corner_positions,
    find_chessboard,
    numbered_by_colours,
    without_slips,
)

HALF = 12
SIDE = 2 * HALF + 1
FALSE_FAILURES = 1e-6


def drawn(x, y, first, second, blur, mean=110.0, contrast=60.0, light=(0, 0, 0, 0), fine=12) -> np.ndarray:
    """A corner in a SIDE × SIDE picture, drawn on a raster that is ``fine`` times finer: edges, light, blur, mean over each pixel."""
    margin = (int(6.5 * blur) + 2) * fine
    axis = (np.arange(-margin, SIDE * fine + margin) + 0.5) / fine - HALF - 0.5
    across, down = np.meshgrid(axis - x, axis - y)
    product = np.ones(across.shape)
    for angle in (first, second):
        c, s = np.cos(angle), np.sin(angle)
        product *= np.clip((c * across + s * down) * 2 * fine / max(abs(c), abs(s)), -1, 1)  # the cells that the edge cuts are mixed
    surface = mean + light[0] * across + light[1] * down + (contrast + light[2] * across + light[3] * down) * product
    soft = gaussian_filter(surface, blur * fine, truncate=6)[margin:-margin, margin:-margin]
    return soft.reshape(SIDE, fine, SIDE, fine).mean(axis=(1, 3))


def corners(rng: np.random.Generator, count: int, blur: float, **kw) -> tuple[np.ndarray, np.ndarray, list]:
    """Pictures, true places from each picture's middle, and what they were drawn with."""
    places, pictures, settings = rng.uniform(-0.5, 0.5, (count, 2)), [], []
    for x, y in places:
        first = rng.uniform(0, np.pi)
        settings.append((first, first + rng.uniform(0.9, np.pi - 0.9), blur, 110.0, float(rng.choice([-60, 60]))))
        pictures.append(drawn(x, y, *settings[-1], **kw))
    return np.array(pictures), places, settings


def fitted(rng, pictures: np.ndarray, places: np.ndarray, repeats: int, noise_dn, model: NoiseModel, **kw):
    """Fit every picture with different noise; errors (pictures, repeats, 2) in x and y, and the positions."""
    frame = np.concatenate([np.concatenate([p] * repeats, axis=1) for p in pictures])
    frame = frame + rng.normal(0, 1, frame.shape) * (noise_dn if np.isscalar(noise_dn) else noise_dn(frame))
    frame = np.clip(np.rint(frame), 0, 65535).astype(np.uint16)
    true = np.stack(np.broadcast_arrays(places[:, None, :]), 0)[0] + np.zeros((len(pictures), repeats, 1)) + HALF
    true = true + np.stack(np.meshgrid(np.arange(repeats) * SIDE, np.arange(len(pictures)) * SIDE), axis=2)
    start = true.reshape(-1, 2) + rng.uniform(-0.7, 0.7, (true.shape[0] * repeats, 2))
    found = corner_positions(frame, *start.T, model, reach_px=9.0, **kw)
    return np.stack([found.x_px, found.y_px], axis=1).reshape(true.shape) - true, found


@pytest.mark.parametrize("blur", [0.3, 0.7, 1.5])
def test_no_bias_at_any_phase_angle_or_sharpness(blur: float, rng: np.random.Generator) -> None:
    """Without noise, off by less than 0.001 px; the drawing itself is good to about 0.0003 px where it is sharp."""
    pictures, places, _ = corners(rng, 12, blur, fine=16)
    places[:4, 0] = [-0.5, -0.25, 0.0, 0.25]
    pictures[:4] = [drawn(x, y, 0.0, np.pi / 2, blur, fine=16) for x, y in places[:4]]
    frame = np.concatenate(pictures, axis=1).astype(np.float32)
    x, y = places[:, 0] + HALF + SIDE * np.arange(12), places[:, 1] + HALF
    found = corner_positions(frame, x + 0.6, y - 0.6, NoiseModel(1.0), reach_px=9.0)
    assert np.abs(found.x_px - x).max() < 1e-3 and np.abs(found.y_px - y).max() < 1e-3
    assert np.abs(found.more["blur_px"] - blur).max() < 5e-3
    assert np.abs(found.more["amplitude_dn"] - 120).max() < 0.05 and np.abs(found.more["background_dn"] - 50).max() < 0.05


@pytest.mark.parametrize(("blur", "noise"), [(0.3, 1.0), (0.7, 8.0), (1.5, 2.0)])
def test_errors_are_at_the_bound_and_covariances_are_honest(blur: float, noise: float, rng: np.random.Generator) -> None:
    """χ² of 800 normalised errors fails once in 1e6 and catches a standard deviation that is off by 12 % (and any bound missed by more).

    The bound comes from derivatives of the drawn pictures by finite differences, not from the fitted template.
    """
    pictures, places, settings = corners(rng, 10, blur)
    variance = noise**2 + 1 / 12
    error, found = fitted(rng, pictures, places, 40, noise, NoiseModel(variance), planes="never")
    covariance = np.stack([found.var_x_px2, found.cov_xy_px2, found.cov_xy_px2, found.var_y_px2], 1).reshape(10, 40, 2, 2)
    rows, cols = np.indices((SIDE, SIDE)) - HALF
    bounds = np.empty((10, 2, 2))
    for k, ((x, y), given) in enumerate(zip(places, settings, strict=True)):
        inside = (cols - x) ** 2 + (rows - y) ** 2 <= 81
        whole = np.array([x, y, *given])
        derivatives = []
        for i, step in enumerate((0.02, 0.02, 0.01, 0.01, 0.02, 1.0, 1.0)):
            up, down = whole.copy(), whole.copy()
            up[i], down[i] = up[i] + step, down[i] - step
            derivatives.append((drawn(*up, fine=8) - drawn(*down, fine=8))[inside] / (2 * step))
        jacobian = np.array(derivatives)
        bounds[k] = np.linalg.inv(jacobian @ jacobian.T / variance)[:2, :2]
    assert np.trace(covariance.mean(axis=1), axis1=1, axis2=2).sum() == pytest.approx(np.trace(bounds, axis1=1, axis2=2).sum(), rel=0.03)
    chi2 = np.einsum("nki,nij,nkj->", error, np.linalg.inv(bounds), error)
    assert stats.chi2.sf(chi2, error.size) > FALSE_FAILURES / 2
    assert stats.chi2.cdf(chi2, error.size) > FALSE_FAILURES / 2
    z = np.einsum("nkij,nkj->nki", np.linalg.inv(np.linalg.cholesky(covariance)), error).ravel()
    assert stats.kstest(z, "norm").pvalue > FALSE_FAILURES


def test_shot_noise_is_weighted(rng: np.random.Generator) -> None:
    """Variance 1 + level: χ² of 400 normalised errors, as above (17 %), and χ² per degree of freedom 1 ± 1 %."""
    pictures, places, _ = corners(rng, 5, 0.8)
    error, found = fitted(rng, pictures, places, 40, lambda level: np.sqrt(1 + level), NoiseModel(1 + 1 / 12, slope_dn=1.0))
    z2 = (error.reshape(-1, 2) ** 2 / np.stack([found.var_x_px2, found.var_y_px2], 1)).sum()
    spread = np.sqrt(2 * error.size * 1.6)  # x and y are correlated by up to 0.6 … 0.8
    assert abs(z2 - error.size) < 5.5 * spread
    assert found.more["chi2_per_dof"].mean() == pytest.approx(1, abs=0.02)


def test_light_that_falls_off_is_noticed_and_moves_nothing(rng: np.random.Generator) -> None:
    """0.8 % a pixel on mean and contrast: 0.1 px without planes; with them mean errors below 5.5 standard errors (0.006 px)."""
    pictures, places, _ = corners(rng, 4, 0.8, light=(0.8, -0.6, 0.5, 0.4))
    error, found = fitted(rng, pictures, places, 20, 1.0, NoiseModel(1 + 1 / 12))
    assert (found.flags & Flag.GRADIENT > 0).all()
    standard_error = np.sqrt(np.maximum(found.var_x_px2, found.var_y_px2).max() / 20)
    assert np.abs(error.mean(axis=1)).max() < 5.5 * standard_error
    plain, _ = fitted(rng, pictures, places, 1, 0.1, NoiseModel(1.0), planes="never")
    assert np.abs(plain).max() > 0.02


def test_planes_are_seldom_taken_without_need(rng: np.random.Generator) -> None:
    pictures, places, _ = corners(rng, 5, 0.8)
    _, found = fitted(rng, pictures, places, 60, 2.0, NoiseModel(4 + 1 / 12))
    assert (found.flags & Flag.GRADIENT > 0).sum() <= 4  # once in 1e4: five of 300 happen by chance once in 4e9


def test_saturated_squares_leave_no_bias(rng: np.random.Generator) -> None:
    """White at 1.02 of full scale, noise 4: without the scale's end in the model the blur and contrast would be wrong."""
    picture = drawn(0.2, -0.3, 0.4, 1.8, 0.8, mean=160.0, contrast=100.0)
    frame = np.clip(np.rint(np.tile(picture, (8, 8)) + rng.normal(0, 4, (8 * SIDE, 8 * SIDE))), 0, 255).astype(np.uint8)
    cols, rows = np.meshgrid(np.arange(8) * SIDE + HALF, np.arange(8) * SIDE + HALF)
    found = corner_positions(frame, cols.ravel(), rows.ravel(), NoiseModel(16 + 1 / 12), reach_px=9.0)
    off_x, off_y = found.x_px - cols.ravel() - 0.2, found.y_px - rows.ravel() + 0.3
    z = np.concatenate([off_x / np.sqrt(found.var_x_px2), off_y / np.sqrt(found.var_y_px2)])
    assert (found.flags & Flag.SATURATED > 0).all() and abs(z.mean()) < 5 * np.sqrt(2 / 128) and 0.7 < z.std() < 1.35
    assert found.more["amplitude_dn"].mean() == pytest.approx(200, abs=1)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_finds_and_refines_a_chessboard_in_perspective(dtype: type, rng: np.random.Generator) -> None:
    """The board is drawn by mapping pixels back to it; corners are where its homography sends them, to 6 standard deviations."""
    rows, cols, fine, blur = 5, 7, 6, 0.8
    to_image = np.array([[24.0, 3.0, 50.0], [-2.0, 22.0, 60.0], [0.0004, 0.0009, 1.0]])
    to_image += rng.uniform(-0.5, 0.5, (3, 3)) * [[1, 1, 1], [1, 1, 1], [1e-4, 1e-4, 0]]
    axis_y, axis_x = (np.arange(200 * fine) + 0.5) / fine - 0.5, (np.arange(280 * fine) + 0.5) / fine - 0.5
    grid = np.stack([*np.meshgrid(axis_x, axis_y), np.ones((200 * fine, 280 * fine))])
    u, v, w = np.einsum("ij,jkl->ikl", np.linalg.inv(to_image), grid)
    u, v = u / w, v / w
    board = (np.floor(u) + np.floor(v)) % 2
    board = np.where((u > -1) & (u < cols) & (v > -1) & (v < rows), board, 1.0)
    clean = gaussian_filter(board, blur * fine).reshape(200, fine, 280, fine).mean(axis=(1, 3))
    scale = {np.uint8: 1.0, np.uint16: 40.0, np.float32: 0.01}[dtype]
    noisy = (30 + 180 * clean + rng.normal(0, 2, clean.shape)) * scale
    frame = noisy.astype(dtype) if dtype == np.float32 else np.rint(noisy).astype(dtype)
    kept = frame.copy()
    grid = find_chessboard(frame, (cols, rows))
    assert not grid.message and (frame == kept).all() and len(grid) == rows * cols
    noise = NoiseModel((2 * scale) ** 2 + (1 / 12 if dtype != np.float32 else 0))
    found = corner_positions(frame, grid.x_px, grid.y_px, noise, reach_px=chessboard_reach_px(grid))
    true = to_image @ np.stack([*np.meshgrid(np.arange(cols), np.arange(rows)), np.ones((rows, cols))]).reshape(3, -1)
    true = true[:2] / true[2]
    nearest = np.hypot(found.x_px[:, None] - true[0], found.y_px[:, None] - true[1]).argmin(axis=1)
    assert sorted(nearest) == list(range(rows * cols))
    off = np.stack([found.x_px, found.y_px]) - true[:, nearest]
    worst = np.hypot(*(off / np.sqrt([found.var_x_px2, found.var_y_px2]))).max()
    assert worst < 7.5  # 6.5 by chance once in 1e6 even if x and y were fully correlated; the rest is the drawing's raster (0.002 px)


@pytest.mark.parametrize(("cols", "rows"), [(8, 5), (7, 5), (6, 6), (7, 7)])
def test_a_chessboard_is_numbered_by_its_colours_from_whichever_corner_it_was_counted(cols: int, rows: int) -> None:
    """A finder may count from any corner and in a mirror; the picture may be turned. The first square is dark then, columns turn to rows as
    x does to y, and where the colours leave a choice the columns run towards x."""
    side = 12
    row, col = (v.ravel() for v in np.indices((rows, cols)))
    board = (np.indices((rows + 1, cols + 1)).sum(axis=0) % 2).repeat(side, 0).repeat(side, 1) * 200.0  # its first outer square is dark
    for quarters in range(4):
        frame = np.ascontiguousarray(np.rot90(board, quarters))
        place = np.stack(np.meshgrid(np.arange(1, frame.shape[1] // side), np.arange(1, frame.shape[0] // side)), axis=2) * side - 0.5
        ways = [np.rot90(place, k) for k in range(4)]
        ways = [one for way in ways for one in (way, way[:, ::-1], way[::-1]) if one.shape[:2] == (rows, cols)]
        found = {}
        for way in ways:
            grid = numbered_by_colours(frame, Grid(*way.reshape(-1, 2).T, row, col, rows, cols))
            assert not grid.message
            at = np.stack([grid.x_px, grid.y_px], axis=1).reshape(rows, cols, 2)
            across, down = at[0, 1] - at[0, 0], at[1, 0] - at[0, 0]
            assert across[0] * down[1] - across[1] * down[0] > 0
            x, y = np.rint(at[:2, :2].mean(axis=(0, 1))).astype(int)
            assert frame[y, x] == 0
            found[tuple(at.ravel())] = across
        (across,) = found.values()
        if rows + cols & 1 == 0 and rows % 2 == 0:
            assert across[0] > 0
    grey = numbered_by_colours(np.full_like(board, 90.0), Grid(*place.reshape(-1, 2).T, row, col, rows, cols)) if rows == cols else None
    assert grey is None or ("do not alternate" in grey.message and not len(grey))


def test_a_corner_that_the_finder_put_into_a_square_is_put_back(rng: np.random.Generator) -> None:
    """8 × 6 corners in perspective; two, one of them at the rim, are off by a quarter of a square."""
    row, col = np.indices((6, 8))
    w = 1 + 0.02 * col - 0.015 * row
    true = np.stack([(40 * col + 6 * row) / w + 50, (38 * row - 3 * col) / w + 60], axis=2)
    seen = true + rng.normal(0, 0.1, true.shape)
    slipped = seen.copy()
    slipped[2, 3] += (7.0, -7.0)
    slipped[0, 6] += (-8.0, 4.0)
    mended = without_slips(slipped)
    assert np.abs(mended - true).max() < 1.2
    assert (without_slips(seen) == seen).all()


def test_the_directions_of_the_edges_and_their_order() -> None:
    """Going from the first to the second, x towards y, one crosses bright squares."""
    first, second = np.radians(20.0), np.radians(95.0)  # normals
    frame = drawn(0, 0, first, second, 0.8).astype(np.float32)
    more = corner_positions(frame, np.array([12.0]), np.array([12.0]), NoiseModel(1.0), reach_px=9.0).more
    one, two = more["direction_1_deg"][0], more["direction_2_deg"][0]
    assert sorted([round(one, 2) % 180, round(two, 2) % 180]) == [5.0, 110.0]
    middle = np.radians(one + 0.5 * ((two - one) % 180))
    assert frame[round(12 + 6 * np.sin(middle)), round(12 + 6 * np.cos(middle))] > 160


def test_what_is_no_corner_has_an_outcome(rng: np.random.Generator) -> None:
    flat = np.full((40, 40), 100, np.uint8)
    found = corner_positions(flat, np.array([20.0, 1.0, 300.0, np.nan]), np.array([20.0, 1.0, 20.0, 3.0]), NoiseModel(1.0))
    assert (found.flags & Flag.NOT_CONVERGED > 0).all() and np.isnan(found.x_px).all() and np.isnan(found.var_x_px2).all()
    assert len(corner_positions(flat, np.empty(0), np.empty(0), NoiseModel(1.0))) == 0
    cut = drawn(0, 0, 0.3, 1.9, 0.8)[:, 8:] + rng.normal(0, 1, (SIDE, SIDE - 8))
    found = corner_positions(cut.astype(np.float32), np.array([4.0]), np.array([12.0]), NoiseModel(1.0), reach_px=9.0)
    assert found.flags[0] & Flag.BORDER and abs(found.x_px[0] - 4) < 6 * np.sqrt(found.var_x_px2[0])
    assert find_chessboard(flat, (7, 5)).message and not len(find_chessboard(flat, (7, 5)))
    assert find_chessboard(np.zeros((1, 1), np.float32), (7, 5)).message
    with pytest.raises(InputError, match="3 × 3"):
        find_chessboard(flat, (2, 5))
    with pytest.raises(InputError, match="planes"):
        corner_positions(flat, np.array([1.0]), np.array([1.0]), NoiseModel(1.0), planes="sometimes")


def test_the_result_does_not_depend_on_the_threads(rng: np.random.Generator) -> None:
    pictures, places, _ = corners(rng, 3, 0.8)
    frame = np.tile(np.concatenate(pictures), (1, 60)).astype(np.float32)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(60) * SIDE + HALF, np.arange(3) * SIDE + HALF))
    one, two = (corner_positions(frame, x, y, NoiseModel(1.0), threads=n) for n in (1, 2))
    assert (one.x_px == two.x_px).all() and (one.var_x_px2 == two.var_x_px2).all()


@pytest.mark.parametrize("shift", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_the_outline_of_the_squares_is_no_row_of_corners(shift: tuple[int, int], rng: np.random.Generator) -> None:
    """As a finder completes a board that the frame cuts: 9 × 6 places, one column or row of which lies on the outer edge of the squares."""
    row, col = np.indices((7, 10))
    board = np.pad(np.where((row + col) % 2 == 0, 30.0, 200.0).repeat(20, axis=0).repeat(20, axis=1), 40, constant_values=200.0)
    frame = np.clip(np.rint(board + rng.normal(0, 2, board.shape)), 0, 255).astype(np.uint8)
    r, c = np.divmod(np.arange(54), 9)
    right = numbered_by_colours(frame, Grid(59.5 + 20.0 * c, 59.5 + 20.0 * r, r, c, 6, 9))
    assert len(right) == 54 and not right.message
    wrong = numbered_by_colours(frame, Grid(59.5 + 20.0 * (c + shift[0]), 59.5 + 20.0 * (r + shift[1]), r, c, 6, 9))
    assert not len(wrong) and "part of a chessboard was found" in wrong.message
