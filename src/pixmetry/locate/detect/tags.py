"""Boards of markers that carry numbers, found and identified by OpenCV (ArUco, AprilTag), their corners placed by ourselves.

Sources: S. Garrido-Jurado, R. Muñoz-Salinas, F. J. Madrid-Cuevas, M. J. Marín-Jiménez, Pattern Recognition 47, 2280 (2014), for ArUco
and the chessboard with markers; E. Olson, "AprilTag: a robust and flexible visual fiducial system", ICRA 2011; J. Maye, P. Furgale, R.
Siegwart, "Self-supervised calibration for robotic systems", IV 2013, for the AprilGrid of Kalibr, whose tags are joined by squares at
their corners.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra
from pixmetry.locate.detect.grids import Grid, eight_bit, images_through, no_grid

DICTIONARIES = (
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000", "6X6_50", "6X6_100", "6X6_250", "6X6_1000",
    "7X7_50", "7X7_100", "7X7_250", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
)  # fmt: skip
GRID_BORDERS = (2, 1)  # bits of the black border of a tag: Kalibr prints two, everyone else one
LEAST_TAGS = 4
LEAST_CORNERS, LEAST_TWICE = 6, 2
AROUND = 8  # corners or tags through which the place of one is expected
MOST_OFF = 0.25  # of the pitch, from there
TAG_CORNERS = np.array([(0, 0), (0, 1), (1, 1), (1, 0)])  # (row, col), round a tag as x turns to y


def dictionary_of(name: str) -> Any:
    """OpenCV's dictionary of markers.

    Raises
    ------
    InputError
        If there is none of this name.
    """
    cv2 = import_extra("cv2")
    if name not in DICTIONARIES:
        raise InputError("no such dictionary of markers", where="dictionary", value=name, allowed=", ".join(DICTIONARIES))
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def marker_cells(name: str, number: int, border: int = 1) -> np.ndarray:
    """Cells of a marker with its black border, True where black, square.

    Raises
    ------
    InputError
        If the dictionary has no such number.
    """
    dictionary = dictionary_of(name)
    count = len(dictionary.bytesList)
    if not 0 <= number < count:
        raise InputError(
            "the dictionary has too few markers", where="dictionary", value=f"{name}, marker {number}", allowed=f"0 to {count - 1}"
        )
    side = dictionary.markerSize + 2 * border
    cells: np.ndarray = np.asarray(dictionary.generateImageMarker(int(number), side, borderBits=border)) < 128
    return cells


def find_charuco(frame: np.ndarray, squares: tuple[int, int], marker: float, dictionary: str) -> Grid:
    """Find the inner corners of a chessboard whose bright squares hold markers; part of the board suffices.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    squares : (int, int)
        Columns and rows of squares.
    marker : float
        Side of a marker over that of a square.
    dictionary : str
        One of `DICTIONARIES`.

    Returns
    -------
    Grid
        Corners to about a pixel, with row and column from 0 to rows − 2 and cols − 2; empty with a message where fewer than six were
        identified, or their numbers contradict each other.

    Raises
    ------
    InputError
        If the board cannot be such a one.

    Notes
    -----
    Boards of an even number of rows that OpenCV printed before version 4.6 begin with a bright square; they are tried too.
    """
    cv2 = import_extra("cv2")
    cols, rows = squares
    table = dictionary_of(dictionary)
    if min(squares) < 3 or cols * rows // 2 > len(table.bytesList):
        allowed = f"3 × 3 or more, with at most {len(table.bytesList)} markers"
        raise InputError("no such board with markers", where="grid", value=squares, allowed=allowed)
    if not 0 < marker < 1:
        raise InputError("markers do not fit into the squares", where="side", value=marker, allowed="between 0 and 1 square")
    grey, best = (
        eight_bit(frame),
        no_grid(f"no chessboard of {cols} × {rows} squares with markers {dictionary} was found", rows - 1, cols - 1),
    )
    for legacy in (False, True) if rows % 2 == 0 else (False,):
        board = cv2.aruco.CharucoBoard((cols, rows), 1.0, float(marker), table)
        board.setLegacyPattern(legacy)
        how = cv2.aruco.CharucoParameters()
        how.minMarkers = 1  # one of the two at a corner identifies it; whether it lies right is looked at below
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board, how).detectBoard(grey)
        if numbers is None or len(numbers) <= len(best):
            continue
        place, (row, col) = np.asarray(corners, float).reshape(-1, 2), np.divmod(np.asarray(numbers).ravel(), cols - 1)
        best = Grid(place[:, 0], place[:, 1], row, col, rows - 1, cols - 1)
    if best.message:
        return with_reason(best, grey, table, GRID_BORDERS[1:])
    good = on_one_board(np.stack([best.row, best.col], axis=1), np.stack([best.x_px, best.y_px], axis=1))
    if good.sum() < LEAST_CORNERS:
        return no_grid(
            f"{int(good.sum())} of {len(best)} corners with numbers lie as on one board, {LEAST_CORNERS} are needed", rows - 1, cols - 1
        )
    return Grid(best.x_px[good], best.y_px[good], best.row[good], best.col[good], rows - 1, cols - 1)


def with_reason(nothing: Grid, grey: np.ndarray, table: Any, borders: tuple[int, ...]) -> Grid:
    """An empty grid, whose message says so where markers are seen twice, or can be read in the mirror image of the frame."""
    cv2 = import_extra("cv2")
    for border in borders:
        how = cv2.aruco.DetectorParameters()
        how.markerBorderBits = border
        detector = cv2.aruco.ArucoDetector(table, how)
        _, numbers, _ = detector.detectMarkers(grey)
        twice = 0 if numbers is None else len(numbers) - len(np.unique(numbers))
        _, mirrored, _ = detector.detectMarkers(np.ascontiguousarray(grey[:, ::-1]))
        what = ""
        if twice >= LEAST_TWICE:
            what = f"{twice} of its markers are seen twice: a second board is in view"
        elif mirrored is not None and len(mirrored) >= LEAST_TAGS:
            what = f"{len(mirrored)} of its markers in the mirror image: the picture is mirrored"
        if what:
            return no_grid(f"{nothing.message}, but {what}", nothing.rows, nothing.cols)
    return nothing


def find_tag_grid(frame: np.ndarray, tags: tuple[int, int], side: tuple[float, float], dictionary: str) -> tuple[Grid, bool]:
    """Find the corners of the tags of a grid whose numbers rise along its rows; part of the grid suffices.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    tags : (int, int)
        Columns and rows of tags.
    side : (float, float)
        Of a tag along columns and along rows, in units of the pitch.
    dictionary : str
        One of `DICTIONARIES`.

    Returns
    -------
    grid : Grid
        Corners to about a pixel, four a tag: row 2 i and 2 i + 1, column 2 j and 2 j + 1 of tag (i, j), row 0 at the top; empty with a
        message where the grid was not identified.
    joined : bool
        Whether the tags have the two-bit border of Kalibr's grids, whose corners small squares touch.

    Notes
    -----
    The first number stands at the bottom left in Kalibr's grids, at the top left in OpenCV's: which of both follows from the sense in which
    rows turn to columns, for a marker that can be read is not mirrored. Which corner of a tag is which follows from its neighbours, not
    from the upright position of its code. A number that is seen twice is not used.
    """
    cv2 = import_extra("cv2")
    cols, rows = tags
    table, grey = dictionary_of(dictionary), eight_bit(frame)
    nothing = no_grid(f"no grid of {cols} × {rows} tags {dictionary} was found", 2 * rows, 2 * cols)
    best: tuple[np.ndarray, np.ndarray, int] = np.zeros(0, int), np.zeros((0, 4, 2)), 1
    for border in GRID_BORDERS:
        how = cv2.aruco.DetectorParameters()
        how.markerBorderBits = border
        corners, numbers, _ = cv2.aruco.ArucoDetector(table, how).detectMarkers(grey)
        if numbers is not None and len(numbers) > len(best[0]):
            best = np.asarray(numbers).ravel(), np.asarray(corners, float).reshape(-1, 4, 2), border
    number, corner, border = best
    unique, count = np.unique(number, return_counts=True)
    use = np.isin(number, unique[count == 1]) & (number < cols * rows)
    number, corner = number[use], corner[use]
    if len(number) < LEAST_TAGS:
        return with_reason(nothing, grey, table, GRID_BORDERS), False
    cells, centre = np.stack(np.divmod(number, cols), axis=1).astype(float), corner.mean(axis=1)
    design = np.column_stack([cells, np.ones(len(cells))])
    if np.linalg.matrix_rank(design) < 3:
        return no_grid(f"{len(number)} tags in one line do not tell how the grid lies", 2 * rows, 2 * cols), False
    by_row, by_col = np.linalg.lstsq(design, centre, rcond=None)[0][:2]
    if by_col[0] * by_row[1] - by_col[1] * by_row[0] < 0:  # rows are counted upwards
        cells[:, 0] = rows - 1 - cells[:, 0]
    good = on_one_board(cells, centre)
    if good.sum() < LEAST_TAGS:
        return no_grid(f"{int(good.sum())} of {len(good)} tags lie as on one grid, {LEAST_TAGS} are needed", 2 * rows, 2 * cols), False
    cells, corner, centre = cells[good], corner[good], centre[good]
    x, y, row, col = [], [], [], []
    for own, four in zip(cells, corner, strict=True):
        near = np.argsort(((cells - own) ** 2).sum(axis=1), kind="stable")[: AROUND + 1]
        expected = _expected(cells[near] - own, centre[near], (TAG_CORNERS - 0.5) * side[::-1])
        turns = [np.roll(four, k, axis=0) for k in range(4)]
        off = [float(np.hypot(*(turn - expected).T).max()) for turn in turns]
        if min(off) > MOST_OFF * float(np.hypot(*(expected[0] - expected[2]))):
            continue
        # the finder's quadrangle swallows part of the squares that touch a tag
        seen = expected if border == GRID_BORDERS[0] else turns[int(np.argmin(off))]
        for (r, c), (px, py) in zip(TAG_CORNERS, seen, strict=True):
            x.append(px)
            y.append(py)
            row.append(int(2 * own[0] + r))
            col.append(int(2 * own[1] + c))
    if len(x) < 4 * LEAST_TAGS:
        return nothing, False
    return Grid(np.array(x), np.array(y), np.array(row), np.array(col), 2 * rows, 2 * cols), border == GRID_BORDERS[0]


def _expected(cells: np.ndarray, places: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Where some cells are expected from others: by a homography, or by an affinity where these are few or in a line but one."""
    spread = np.linalg.matrix_rank(np.column_stack([cells, np.ones(len(cells))]))
    if len(cells) >= 6 and spread == 3:
        return images_through(cells, places, asked)
    design = np.column_stack([cells, np.ones(len(cells))])
    expected: np.ndarray = np.column_stack([asked, np.ones(len(asked))]) @ np.linalg.lstsq(design, places, rcond=None)[0]
    return expected


def on_one_board(cells: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Which numbered places lie where those around them expect them on one flat, regular board; bool, shape (n,).

    The worst of each neighbourhood is left out first, until the rest agrees to a quarter of the pitch.
    """
    good = np.ones(len(cells), bool)
    cells = cells.astype(float)
    for _ in range(len(cells)):
        index = np.flatnonzero(good)
        if len(index) < 4:
            break
        off = np.zeros(len(index))
        for k, one in enumerate(index):
            others = index[index != one]
            near = others[np.argsort(((cells[others] - cells[one]) ** 2).sum(axis=1), kind="stable")[:AROUND]]
            at = _expected(cells[near] - cells[one], place[near], np.array([(0.0, 0.0), (0.0, 1.0), (1.0, 0.0)]))
            pitch = min(np.hypot(*(at[1] - at[0])), np.hypot(*(at[2] - at[0])))
            off[k] = np.hypot(*(place[one] - at[0])) / max(pitch, 1e-9)
        if off.max() <= MOST_OFF:
            break
        good[index[int(np.argmax(off))]] = False
    return good
