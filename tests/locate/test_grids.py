"""Rows and columns of dots on plates seen in perspective and through distorting lenses, with dots missing and others between."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.detection import detect
from pixmetry.locate.detect.grids import eight_bit, order_grid
from pixmetry.locate.job import locate


def plate(rng, rows: int, cols: int, *, asymmetric=False, tilt_deg=40.0, turn=None, distortion=0.1, missing=0.0, clutter=0):
    """Places of dots and their rows and columns in random order; row −1 for clutter."""
    j, i = (a.ravel() for a in np.meshgrid(np.arange(cols), np.arange(rows)))
    plane = np.stack([2.0 * j + i % 2 if asymmetric else 1.0 * j, 1.0 * i])
    plane = (plane - plane.mean(axis=1, keepdims=True)) / np.ptp(plane, axis=1).max()

    def turned(angle: float) -> np.ndarray:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    towards, tilt = rng.uniform(0, 2 * np.pi), np.radians(tilt_deg)
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    about = rng.uniform(-np.pi, np.pi) if turn is None else turn
    x, y, z = turned(-towards) @ lean @ turned(towards) @ turned(about) @ np.stack([*plane, np.zeros(rows * cols)])
    x, y = x / (z + 1.4), y / (z + 1.4)
    factor = 1 + distortion * (x * x + y * y)
    keep = rng.random(rows * cols) >= missing
    x, y, i, j = 1500 * (x * factor)[keep] + 1000, 1500 * (y * factor)[keep] + 1000, i[keep], j[keep]
    x, y = (np.concatenate([v, rng.uniform(v.min(), v.max(), clutter)]) for v in (x, y))
    i, j = (np.concatenate([v, np.full(clutter, -1)]) for v in (i, j))
    order = rng.permutation(len(x))
    return x[order], y[order], i[order], j[order]


def agreeing(grid, i: np.ndarray, j: np.ndarray, asymmetric=False) -> int:
    """How many dots have the right row and column, up to a turn of the plate by quarters and a shift."""
    both = grid.placed & (i >= 0)
    true = np.stack([i, 2 * j + i % 2 if asymmetric else j], axis=1)[both]
    found = np.stack([grid.row, 2 * grid.col + grid.row % 2 if asymmetric else grid.col], axis=1)[both]
    turns = ([[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]])
    return max(np.unique(true - found @ np.array(t).T, axis=0, return_counts=True)[1].max(initial=0) for t in turns)


@pytest.mark.parametrize("asymmetric", [False, True])
def test_orders_plates_in_any_pose(asymmetric: bool, rng: np.random.Generator) -> None:
    """30 plates of 5 × 5 to 30 × 30 dots, tilted up to 55°, distorted by −30 … +20 % at the corner, 3 % missing, 8 dots of clutter.

    One plate in a thousand is so oblique that it is numbered along a diagonal: four of 30 are by chance once in 10⁷ runs; a share of 30 %
    would be caught with 99 %. Of the others some 1 in 20 000 dots is left out.
    """
    right = total = wrong_plates = 0
    for _ in range(30):
        rows, cols = rng.integers(5, 31, 2)
        x, y, i, j = plate(
            rng, rows, cols, asymmetric=asymmetric, tilt_deg=rng.uniform(0, 55), distortion=rng.uniform(-0.3, 0.2), missing=0.03, clutter=8
        )
        grid = order_grid(x, y, asymmetric=asymmetric)
        cells = np.stack([grid.row, grid.col], axis=1)[grid.placed]
        assert len(np.unique(cells, axis=0)) == len(cells) and len(grid) == len(x)
        agree, dots = agreeing(grid, i, j, asymmetric), (i >= 0).sum()
        if agree < 0.6 * dots:
            wrong_plates += 1
        else:
            right, total = right + agree, total + dots
    assert wrong_plates <= 3
    assert right > 0.99 * total


def test_every_dot_of_a_whole_plate_has_its_own_cell(rng: np.random.Generator) -> None:
    x, y, i, j = plate(rng, 40, 60, tilt_deg=30, turn=0.2)
    grid = order_grid(x, y)
    assert (grid.rows, grid.cols) == (40, 60) and grid.placed.all()
    assert (grid.row == i).all() and (grid.col == j).all()  # rows down, columns to the right
    turned = order_grid(-y, x)
    assert (turned.rows, turned.cols) == (60, 40) and (turned.row == j).all() and (turned.col == 39 - i).all()


def test_clutter_between_the_dots_is_left_out(rng: np.random.Generator) -> None:
    x, y, i, j = plate(rng, 20, 25, tilt_deg=20, turn=0.0)
    between = 0.5 * (x[(i == 7) & (j == 9)] + x[(i == 8) & (j == 10)]), 0.5 * (y[(i == 7) & (j == 9)] + y[(i == 8) & (j == 10)])
    grid = order_grid(np.append(x, between[0]), np.append(y, between[1]))
    assert grid.placed[:-1].all() and not grid.placed[-1] and grid.row[-1] == grid.col[-1] == -1


def test_a_dot_that_is_out_of_place_is_an_outlier(rng: np.random.Generator) -> None:
    x, y, i, j = plate(rng, 15, 15, tilt_deg=10, turn=0.0, distortion=0.0)
    wrong = np.flatnonzero((i == 7) & (j == 7))[0]
    step = np.hypot(x[(i == 7) & (j == 8)] - x[wrong], y[(i == 7) & (j == 8)] - y[wrong])[0]
    x[wrong] += 0.25 * step
    grid = order_grid(x, y)
    assert not grid.placed[wrong] and grid.placed.sum() == 224


def test_gaps_are_counted(rng: np.random.Generator) -> None:
    """A missing row and column do not shift the numbers beyond them."""
    x, y, i, j = plate(rng, 16, 20, tilt_deg=35, turn=0.1)
    keep = (i != 6) & (j != 12)
    grid = order_grid(x[keep], y[keep])
    assert grid.placed.all() and (grid.row == i[keep]).all() and (grid.col == j[keep]).all() and (grid.rows, grid.cols) == (16, 20)


def test_the_pattern_settles_what_the_dots_leave_open(rng: np.random.Generator) -> None:
    x, y, i, j = plate(rng, 6, 9, tilt_deg=0, turn=np.pi / 2 - 0.1)
    free, named = order_grid(x, y), order_grid(x, y, pattern=(9, 6))
    assert (free.rows, free.cols) == (9, 6) and (named.rows, named.cols) == (6, 9) and not named.message
    assert "9 × 6" not in free.message and "not 5 × 5" in order_grid(x, y, pattern=(5, 5)).message
    x, y, i, j = plate(rng, 11, 4, asymmetric=True, tilt_deg=20, turn=rng.uniform(-3, 3))
    grid = order_grid(x, y, asymmetric=True)  # an odd number of rows tells the top from the bottom
    assert (grid.row == i).all() and (grid.col == j).all() and (grid.rows, grid.cols) == (11, 4)


def test_twenty_thousand_dots(rng: np.random.Generator) -> None:
    x, y, i, j = plate(rng, 125, 160, tilt_deg=30, turn=0.05, missing=0.02, clutter=20)
    assert agreeing(order_grid(x, y), i, j) > 0.999 * (i >= 0).sum()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_too_few_dots_are_said_to_be_too_few(count: int) -> None:
    grid = order_grid(np.arange(count) * 7.0, np.arange(count) ** 2 * 1.0)
    assert grid.message and not grid.placed.any() and len(grid) == count


def test_odd_inputs_have_an_outcome(rng: np.random.Generator) -> None:
    for x, y in (
        (np.zeros(9), np.zeros(9)),  # all in one place
        (np.arange(9.0), np.zeros(9)),  # a line
        (rng.uniform(0, 100, 5), rng.uniform(0, 100, 5)),
        (np.full(6, np.nan), np.full(6, np.nan)),
    ):
        grid = order_grid(x, y)
        assert len(grid) == len(x) and grid.row.shape == grid.col.shape == x.shape
    square = order_grid(np.array([0, 10, 0, 10.0]), np.array([0, 0, 10, 10.0]))
    assert square.row.tolist() == [0, 0, 1, 1] and square.col.tolist() == [0, 1, 0, 1]
    x, y, i, j = plate(rng, 5, 6, tilt_deg=10, turn=0.0)
    grid = order_grid(np.append(x, np.nan), np.append(y, 3.0))
    assert (grid.row[:-1] == i).all() and grid.row[-1] == -1
    with pytest.raises(InputError, match="one length"):
        order_grid(np.zeros(3), np.zeros(4))


def drawn_circles(rng, rows: int, cols: int, asymmetric: bool, bright: bool) -> tuple[np.ndarray, np.ndarray]:
    fine = 4
    i, j = (a.ravel() for a in np.indices((rows, cols)))
    true = 30 + 12.0 * np.stack([2 * j + i % 2 * asymmetric, i * (1 if asymmetric else 2)], axis=1)
    true += [1.5, 0.5] + true[:, ::-1] * [0.05, -0.04] + [0, 20]
    height, width = (np.ceil(true.max(axis=0)).astype(int) + 30)[::-1]
    down, across = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in (height, width))
    disc = np.zeros((height * fine, width * fine))
    for x, y in true:
        disc = np.maximum(disc, (across - x) ** 2 + (down[:, None] - y) ** 2 < 36)
    clean = gaussian_filter(disc, 0.8 * fine).reshape(height, fine, width, fine).mean(axis=(1, 3))
    return (40 + 150 * (clean if bright else 1 - clean) + rng.normal(0, 1.5, clean.shape)), true


@pytest.mark.parametrize("asymmetric", [False, True])
@pytest.mark.parametrize("bright", [False, True])
def test_a_named_pattern_is_found_in_the_frame_and_ordered_alike_among_targets(
    asymmetric: bool, bright: bool, rng: np.random.Generator
) -> None:
    rows, cols = (11, 4) if asymmetric else (5, 7)
    picture, true = drawn_circles(rng, rows, cols, asymmetric, bright)
    for frame in (np.rint(picture).astype(np.uint8), np.rint(picture * 100).astype(np.uint16), (picture / 300).astype(np.float32)):
        targets = detect(frame).targets
        grid = order_grid(targets.x_px, targets.y_px, pattern=(cols, rows), asymmetric=asymmetric)
        assert not grid.message and grid.placed.all() and (grid.rows, grid.cols) == (rows, cols)
        order = np.argsort(grid.row * cols + grid.col)
        assert np.hypot(grid.x_px[order] - true[:, 0], grid.y_px[order] - true[:, 1]).max() < 0.5
    among = order_grid(*true[::-1].T, pattern=(cols, rows), asymmetric=asymmetric)
    assert not among.message and (among.row * cols + among.col == np.arange(rows * cols)[::-1]).all()


def test_eight_bits_keep_what_matters(rng: np.random.Generator) -> None:
    frame = rng.integers(0, 256, (50, 60)).astype(np.uint8)
    assert eight_bit(frame) is frame
    wide = (frame.astype(np.uint16) + 20) * 200
    assert np.abs(eight_bit(wide).astype(int) - frame).max() <= 2
    assert np.abs(eight_bit(frame.astype(np.float32) * 1e-6 - 1e-4).astype(int) - frame).max() <= 2
    assert eight_bit(np.full((5, 5), 7.5, np.float32)).dtype == np.uint8
    assert np.ptp(eight_bit(np.where(np.arange(5000).reshape(50, 100) == 77, 4000, 12).astype(np.uint16))) > 200


def test_a_plate_of_known_size_is_numbered_whole_or_refused(rng: np.random.Generator) -> None:
    """A plate of 10 × 8: with dots of something else in the next row it is numbered right; one with a real row more, with a row or a column
    less, or with a row that only a stray dot stands for, is refused by name. 20 plates of each."""

    def rows_of(first: int, stop: int, keep: int = 10) -> tuple[np.ndarray, ...]:
        x, y, i, j = plate(rng, 10, 10, tilt_deg=rng.uniform(0, 40), distortion=rng.uniform(-0.1, 0.1))
        use = (i >= first) & (i < stop) & ((i < stop - 1) | (j < keep))
        return x[use], y[use], i[use] - first, j[use]

    for _ in range(20):
        x, y, i, j = rows_of(0, 9, keep=2)
        grid = order_grid(x, y, pattern=(10, 8))
        inside = i < 8
        assert not grid.message and (grid.placed == inside).all() and agreeing(grid, i, j) == 80
        x, y, i, j = rows_of(0, 9)
        assert "not 10 × 8" in order_grid(x, y, pattern=(10, 8)).message
        x, y, i, j = rows_of(0, 8, keep=1)
        message = order_grid(x, y, pattern=(10, 8)).message
        assert "hardly there" in message or "not 10 × 8" in message
        x, y, i, j = rows_of(0, 7)
        assert order_grid(x, y, pattern=(10, 8)).message


@pytest.mark.parametrize("drop", [0.0, 0.05])
def test_hexagonal_plates_are_numbered(drop: float, rng: np.random.Generator) -> None:
    """Turned up to 25°, tilted and distorted: every dot has the number that it was printed with."""
    for cols, rows in ((7, 9), (20, 12)):
        row, col = (a.ravel() for a in np.mgrid[:rows, :cols])
        place = np.stack([2.0 * col + row % 2, np.sqrt(3) * row], axis=1) - (cols, rows)
        turn = np.deg2rad(rng.uniform(-25, 25))
        place = place @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        place = place * (1, 0.85) / (1 + place @ rng.normal(0, 0.003, 2))[:, None]
        place = 400 + 9 * place * (1 - 0.05 * (place**2).sum(axis=1, keepdims=True) / cols**2)
        seen = rng.permutation(np.flatnonzero(rng.random(len(col)) >= drop))
        grid = order_grid(*(place[seen] + rng.normal(0, 0.05, (len(seen), 2))).T, hexagonal=True)
        np.testing.assert_array_equal(grid.row, row[seen] - row[seen].min())
        np.testing.assert_array_equal(grid.col, col[seen])


def test_a_hexagonal_plate_in_a_frame() -> None:
    """Dots that cover half of the frame are all found and numbered; the size decides nothing else."""
    y, x = np.indices((150, 160))
    frame = np.full(x.shape, 200.0)
    for row in range(8):
        for col in range(9):
            away = np.hypot(x - 14 - 15 * col - 7.5 * (row % 2), y - 15 - 15 * np.sqrt(0.75) * row)
            frame -= 150 / (1 + np.exp(np.clip(4 * (away - 5.5), -50, 50)))
    for grid in ("hexagonal", "9x8:hexagonal"):
        table = locate(np.rint(frame).astype(np.uint8), grid=grid)
        assert len(table) == 72 and (table.grid_row >= 0).all() and not set(table.grid_col) ^ set(range(9))
        np.testing.assert_allclose(table.x_px, 14 + 15 * table.grid_col + 7.5 * (table.grid_row % 2), atol=0.1)
    with pytest.raises(InputError, match="not the size of a grid"):
        locate(np.rint(frame).astype(np.uint8), grid="9x8:round")
