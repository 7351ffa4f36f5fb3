"""Calibration targets in images drawn here by sampling a board through a pinhole: found, placed, and numbered alike in all images."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.images.images import ImageObservations, observations_of
from pixmetry.calibrate.images.numbering import Board, Marks, consistent, turned, turned_cells
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.locate.detect.coded import BITS, codes

COLS, ROWS, FOCAL = 480, 400, 600.0
SUB = 4  # samples a pixel and axis
SOFT = 0.006  # width of a sample on the board, in pitches
Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (x, y) on the board, pitch 1, to the light from 0 to 1


def rotation(roll_deg: float, tilt_x_deg: float, tilt_y_deg: float) -> np.ndarray:
    a, b, c = np.radians([tilt_x_deg, tilt_y_deg, roll_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


class View:
    """A camera over the middle (x, y) of a board at z = 0."""

    def __init__(self, middle: tuple[float, float], distance: float, roll: float = 0.0, tilt_x: float = 0.0, tilt_y: float = 0.0) -> None:
        r = rotation(roll, tilt_x, tilt_y)
        k = np.array([[FOCAL, 0, (COLS - 1) / 2], [0, FOCAL, (ROWS - 1) / 2], [0, 0, 1]])
        shift = np.array([0, 0, distance]) - r[:, :2] @ middle
        self.homography = k @ np.column_stack([r[:, :2], shift])

    def image(self, xy: np.ndarray) -> np.ndarray:
        h = np.column_stack([xy, np.ones(len(xy))]) @ self.homography.T
        return h[:, :2] / h[:, 2:]

    def frame(self, paint: Paint, rng: np.random.Generator, noise_dn: float = 1.5, blur_px: float = 0.7, sub: int = SUB) -> np.ndarray:
        """Mean of sub² samples a pixel, blurred, with noise, shape (ROWS, COLS), uint8."""
        at = (np.arange(sub) + 0.5) / sub - 0.5
        x, y = np.meshgrid((np.arange(COLS)[:, None] + at).ravel(), (np.arange(ROWS)[:, None] + at).ravel())
        ray = np.linalg.inv(self.homography) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        light = paint(ray[0] / ray[2], ray[1] / ray[2]).reshape(ROWS * sub, COLS * sub)
        fine = gaussian_filter(light, blur_px * sub, mode="nearest")
        grey = 40 + 160 * fine.reshape(ROWS, sub, COLS, sub).mean(axis=(1, 3))
        return np.clip(np.rint(grey + rng.normal(0, noise_dn, grey.shape)), 0, 255).astype(np.uint8)


def chessboard(cols: int, rows: int) -> Paint:
    """Inner corners from (0, 0) to (cols − 1, rows − 1); the square between the first four is dark, white beyond the board."""

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        dark = (np.floor(x) + np.floor(y)) % 2 == 0
        return np.where(dark & (x > -1) & (x < cols) & (y > -1) & (y < rows), 0.0, 1.0)

    return paint


def dots(cols: int, rows: int, radius: float = 0.17, marks: dict[tuple[int, int], float] | None = None) -> Paint:
    """Dark dots at (0, 0) to (cols − 1, rows − 1); ``marks``: radii of some (col, row)."""
    radii = np.full((cols, rows), radius)
    for place, value in (marks or {}).items():
        radii[place] = value

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = np.rint(x).astype(int), np.rint(y).astype(int)
        on = (i >= 0) & (i < cols) & (j >= 0) & (j < rows)
        size = np.where(on, radii[np.clip(i, 0, cols - 1), np.clip(j, 0, rows - 1)], -1.0)
        return np.clip(0.5 + (np.hypot(x - i, y - j) - size) / SOFT, 0, 1)

    return paint


def squares(cols: int, rows: int, side: float) -> Paint:
    """Dark squares from (i, j) to (i + side, j + side), their edges as soft as a sample is wide, so that samples make no steps."""

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = np.rint(x - side / 2), np.rint(y - side / 2)
        on = (i >= 0) & (i < cols) & (j >= 0) & (j < rows)
        outside = np.maximum(np.abs(x - i - side / 2), np.abs(y - j - side / 2)) - side / 2
        return np.where(on, np.clip(0.5 + outside / SOFT, 0, 1), 1.0)

    return paint


def coded(numbers: dict[tuple[int, int], int], radius: float = 0.1) -> Paint:
    """White targets on black at whole (x, y), as `code_svg` draws them: ring from 2 to 3 radii, segment k from k/12 of the turn on."""

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        light = np.zeros_like(x)
        for (i, j), number in numbers.items():
            r = np.hypot(x - i, y - j) / radius
            segment = np.floor((np.arctan2(y - j, x - i) / (2 * np.pi) % 1) * BITS).astype(int)
            light[(r < 1) | ((r >= 2) & (r < 3) & (number >> segment & 1 == 1))] = 1.0
        return light

    return paint


def differences(seen: ImageObservations, views: list[View]) -> np.ndarray:
    """Measured less true image coordinates, shape (n, 2), by the points' nominal coordinates."""
    out = np.empty((len(seen), 2))
    for i, view in enumerate(views):
        here = seen.image == i
        out[here] = np.column_stack([seen.x_px, seen.y_px])[here] - view.image(seen.xyz[seen.point[here], :2])
    return out


def of_board(cols: int, rows: int, distance: float, turns: tuple[float, ...]) -> list[View]:
    """Views over the middle of a board, rolled by ``turns`` and tilted in different directions."""
    middle = (cols - 1) / 2, (rows - 1) / 2
    tilts = [(18, -6), (-14, 12), (8, 16), (-18, -10)]
    return [View(middle, distance, roll, *tilts[k % 4]) for k, roll in enumerate(turns)]


@pytest.mark.parametrize("quarters", range(4))
def test_turned_cells_are_those_of_a_turned_array(quarters: int) -> None:
    row, col = (v.ravel() for v in np.indices((3, 5)))
    new = turned_cells(row, col, 3, 5, quarters)
    turned = np.empty((3, 5) if quarters % 2 == 0 else (5, 3), int)
    turned[new] = np.arange(15)
    assert (turned == np.rot90(np.arange(15).reshape(3, 5), quarters)).all() or (
        turned == np.rot90(np.arange(15).reshape(3, 5), -quarters)
    ).all()


def seen_board(cols: int, rows: int, turn_deg: float, marked: tuple[tuple[int, int], ...] = ()) -> Board:
    """A flat board turned in the image, numbered as nearly upright as it allows, with marks at some true (row, col)."""
    row, col = (v.ravel() for v in np.indices((rows, cols)))
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    value = np.array([float((r, k) in marked) for r, k in zip(row, col, strict=True)])
    board = Board(row, col, c * col - s * row, s * col + c * row, rows, cols, Marks(row, col, value, rows, cols))
    quarters = round(-turn_deg / 90) if rows == cols else 2 * round(turn_deg / 180)
    return turned(board, quarters % 4)


def same_names(boards: list[Board], turns_deg: tuple[float, ...]) -> bool:
    """Whether one row and column is one place of the board in all images."""
    names = []
    for board, turn in zip(boards, turns_deg, strict=True):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        true = np.rint(np.column_stack([c * board.x_px + s * board.y_px, c * board.y_px - s * board.x_px])).astype(int)
        names.append({(r, k): tuple(place) for r, k, place in zip(board.row, board.col, true, strict=True)})
    return all(other == names[0] for other in names)


@pytest.mark.parametrize(
    ("cols", "rows", "marked", "turns_deg", "same", "findings"),
    [
        (6, 6, (), (0, 30, 60, 90, 130), True, 1),  # followed by the smallest rotation
        (6, 6, (), (0, 80), False, 1),  # too far for that, and no mark
        (7, 5, (), (10, 95, 170, 250), True, 1),
        (6, 6, ((1, 2),), (0, 170, 80, 260), True, 0),  # told by a mark
        (6, 6, ((1, 2), (4, 3)), (0, 30, 50), True, 1),  # marks that look the same after half a turn
        (6, 6, ((1, 2), (1, 3), (4, 4)), (5, 185, 95), True, 0),
    ],
)
def test_numbers_of_a_board_are_the_same_in_all_images(
    cols: int, rows: int, marked: tuple[tuple[int, int], ...], turns_deg: tuple[float, ...], same: bool, findings: int
) -> None:
    boards, said = consistent([seen_board(cols, rows, turn, marked) for turn in turns_deg])
    assert same_names(boards, turns_deg) is same and len(said) == findings


def test_dirt_in_one_image_does_not_turn_the_board() -> None:
    """A dark speck where the true mark of no image is: marks are not believed unless most images have equally many."""
    turns = (0, 20, 40, 10)
    boards, _ = consistent([seen_board(6, 6, t, ((0, 1),) if t == 0 else ((1, 5),) if t == 40 else ()) for t in turns])
    assert same_names(boards, turns)


def test_chessboard_is_numbered_by_its_colours_however_it_is_turned(rng: np.random.Generator) -> None:
    """7 × 6 inner corners: rolled by 10, 170 and 95 degrees, each corner still has its own name. Largest error of 126 corners < 0.1 px,
    where a wrong name is a square's side, 40 px."""
    views = of_board(7, 6, 15.0, (10.0, 170.0, 95.0))
    frames = [view.frame(chessboard(7, 6), rng) for view in views]
    seen = observations_of(frames, "chessboard", grid="7x6", pitch=1.0)
    assert len(seen) == 3 * 42 and len(seen.points) == 42 and not seen.left_out and not seen.findings
    assert np.abs(differences(seen, views)).max() < 0.1
    assert seen.points[0] == "0/0" and (seen.xyz[0] == 0).all() and seen.sizes == ((COLS, ROWS),) * 3


def test_marked_dot_tells_the_turn(rng: np.random.Generator) -> None:
    """A plate of 6 × 6 dots with one larger one, rolled by 0, 100, 185 and 260 degrees. The plate may be named from the corner that is
    first in the first image; there it is the true one. 0.02 px of eccentricity are in the tolerance of 0.1 px."""
    views = of_board(6, 6, 13.0, (0.0, 100.0, 185.0, 260.0))
    frames = [view.frame(dots(6, 6, marks={(1, 2): 0.24}), rng) for view in views]
    seen = observations_of(frames, "dots", grid=(6, 6), pitch=1.0, diameter=0.34)
    assert len(seen) == 4 * 36 and not seen.findings
    assert np.abs(differences(seen, views)).max() < 0.1
    network = seen.network(CameraModel.of(Sensor(COLS, ROWS)))
    assert (network.diameter == 0.34).all() and (network.normal[:, 2] == 1).all() and (network.u_xyz == 0).all()


def test_plate_without_a_mark_is_followed_by_the_smallest_rotation(rng: np.random.Generator) -> None:
    """Rolled by 0, 40, 80, 120 degrees: the last would be numbered from another corner if each image stood alone. A finding says it."""
    views = of_board(6, 6, 13.0, (0.0, 40.0, 80.0, 120.0))
    seen = observations_of([view.frame(dots(6, 6), rng) for view in views], "dots", grid=(6, 6), pitch=1.0)
    assert np.abs(differences(seen, views)).max() < 0.1
    assert [finding.kind for finding in seen.findings] == ["numbering"]
    assert seen.findings[0].level == "warning" and "quarter of a turn" in seen.findings[0].text
    calm = observations_of([v.frame(dots(6, 6), rng) for v in of_board(6, 6, 13.0, (0.0, 9.0, -8.0))], "dots", grid=(6, 6), pitch=1.0)
    assert calm.findings[0].level == "note"


def test_an_asymmetric_grid_of_an_odd_number_of_rows_is_numbered_however_it_is_turned(rng: np.random.Generator) -> None:
    """4 × 7 dots as OpenCV counts them, (2 col + row % 2, row) half steps, rolled by 0, 100, 190, 275 degrees; a column more is refused."""
    gone = {(c, r): -1.0 for c in range(8) for r in range(7) if (c + r) % 2}
    views = of_board(8, 7, 14.0, (0.0, 100.0, 190.0, 275.0))
    frames = [view.frame(dots(8, 7, 0.3, gone), rng) for view in views]
    seen = observations_of(frames, "asymmetric", grid="4x7", pitch=2.0)
    assert len(seen) == 4 * 28 and not [f for f in seen.findings if f.kind == "numbering"]
    assert np.abs(differences(seen, views)).max() < 0.2  # with 0.1 px of eccentricity
    assert tuple(seen.xyz[seen.points.index("1/3")]) == (7.0, 1.0, 0.0)
    with pytest.raises(MeasureError, match="dots were seen"):
        observations_of(frames[:1], "asymmetric", grid="3x7", pitch=2.0, least_images=1)


def test_corners_of_squares_cover_their_truth(rng: np.random.Generator) -> None:
    """The mean of dᵀ C⁻¹ d / 2 over 432 corners, of which two share a side, is 1 ± 0.07: 5 standard deviations are 0.66 … 1.34,
    which catches a wrong factor of 1.2 in standard deviations; the largest error is 8 standard uncertainties of 0.03 px at most."""
    views = [View((2.8, 2.8), 13.0, roll, *tilt) for roll, tilt in ((3.0, (18, -6)), (12.0, (-14, 12)), (-20.0, (8, 16)))]
    frames = [view.frame(squares(6, 6, 0.6), rng) for view in views]
    seen = observations_of(frames, "squares", grid="6x6", pitch=1.0, side=0.6, noise=None)
    assert len(seen) == 3 * 144 and seen.points[:2] == ("0/0.0", "0/0.1")
    d = differences(seen, views)
    assert np.abs(d).max() < 0.3
    var_x, cov, var_y = seen.covariance_px2.T
    mahalanobis = (var_y * d[:, 0] ** 2 - 2 * cov * d[:, 0] * d[:, 1] + var_x * d[:, 1] ** 2) / (var_x * var_y - cov**2)
    assert 0.66 < mahalanobis.mean() / 2 < 1.34


def test_coded_targets_are_known_by_their_numbers(rng: np.random.Generator) -> None:
    """Twelve targets in three images; one code stands on the board twice, and a target that is hidden in two images falls out."""
    numbers = {(i, j): codes()[5 * (4 * j + i) + 3] for i in range(4) for j in range(3)}
    twice = dict(numbers)
    twice[(3, 2)] = twice[(0, 0)]
    hidden = {place: number for place, number in numbers.items() if place != (1, 1)}
    views = [View((1.5, 1.0), 7.0, roll, *tilt) for roll, tilt in ((0.0, (12, 0)), (75.0, (-10, 8)), (200.0, (6, -12)))]
    shown = numbers, hidden, {**twice, (1, 1): codes()[80]}
    frames = [view.frame(coded(these), rng) for view, these in zip(views, shown, strict=True)]
    seen = observations_of(frames, "coded")
    place_of = {str(number): place for place, number in numbers.items()}
    gone = {str(numbers[1, 1]), str(codes()[80])}
    assert set(seen.points) == set(place_of) - gone
    assert np.isnan(seen.xyz).all() and seen.normal is None
    for i, view in enumerate(views):
        here = np.flatnonzero(seen.image == i)
        true = view.image(np.array([place_of[seen.points[k]] for k in seen.point[here]], float))
        assert np.abs(np.column_stack([seen.x_px, seen.y_px])[here] - true).max() < 0.1
    assert (seen.image == 2).sum() == 9  # without the code seen twice, its twin's own, and the hidden one
    texts = " ".join(finding.text for finding in seen.findings)
    assert "more than once" in texts and all(number in texts for number in gone)


def test_images_that_fail_are_named_with_a_reason(rng: np.random.Generator) -> None:
    views = of_board(7, 6, 15.0, (0.0, 10.0, -10.0))
    frames = [view.frame(chessboard(7, 6), rng) for view in views]
    empty = np.full((ROWS, COLS), 120, np.uint8)
    seen = observations_of([frames[0], empty, frames[1], frames[2], frames[0][:, :-4]], "chessboard", grid="7x6", pitch=1.0)
    assert seen.images == ("image 1", "image 3", "image 4")
    assert [name for name, _ in seen.left_out] == ["image 2", "image 5"]
    assert "no chessboard of 7 × 6" in seen.left_out[0][1] and "476 x 400" in seen.left_out[1][1]
    assert [f.level for f in seen.findings if f.kind == "image_left_out"] == ["warning", "warning"]
    with pytest.raises(MeasureError, match=r"2 of 3 images.*image 2: no chessboard.*image 3: 42 points"):
        observations_of([frames[0], empty, frames[1]], "chessboard", grid="7x6", pitch=1.0)


def test_a_field_that_few_images_show_is_refused(rng: np.random.Generator) -> None:
    """Three of ten: they may show something else."""
    frames = [view.frame(dots(6, 5), rng) for view in of_board(6, 5, 13.0, (0.0, 10.0, -10.0))]
    larger = of_board(7, 5, 13.0, (0.0,))[0].frame(dots(7, 5), rng)
    with pytest.raises(MeasureError, match=r"3 of 10 images only.*7 × 5, not 6 × 5 \(7 images\)"):
        observations_of([*frames, *[larger] * 7], "dots", grid="6x5", pitch=1.0)


def test_each_dot_has_its_coordinates_and_their_covariance(rng: np.random.Generator) -> None:
    views = of_board(5, 4, 11.0, (0.0,))
    seen = observations_of([views[0].frame(dots(5, 4), rng)], "dots", grid="any", pitch=(2.0, 3.0), least_images=1)
    assert len(seen.x_px) == 20 and (seen.covariance_px2[:, [0, 2]] > 0).all()
    assert tuple(seen.xyz[seen.points.index("3/4")]) == (8.0, 9.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "options", "what"),
    [
        ("rings", {}, "no such kind"),
        ("chessboard", {"grid": "9", "pitch": 1.0}, "size of a board"),
        ("chessboard", {"grid": "any", "pitch": 1.0}, "size of a board"),
        ("chessboard", {"grid": "9x6"}, "spacing of the points"),
        ("dots", {"grid": "9x6", "pitch": -1.0}, "spacing of the points"),
        ("squares", {"grid": "8x8", "pitch": 1.0}, "side of the squares"),
        ("squares", {"grid": "8x8", "pitch": 1.0, "side": 1.0}, "side of the squares"),
        ("coded", {"grid": "8x8"}, "no grid"),
        ("dots", {"grid": "8x8", "pitch": 1.0, "diameter": 0.0}, "diameter"),
        ("dots", {"grid": "8x8", "pitch": 1.0, "polarity": "grey"}, "polarity"),
    ],
)
def test_options_that_cannot_be_used_are_refused(kind: str, options: dict, what: str) -> None:
    with pytest.raises(InputError, match=what):
        observations_of([np.zeros((50, 50), np.uint8)] * 3, kind, **options)
