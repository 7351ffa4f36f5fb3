"""Chessboard corners: found by OpenCV, placed by a least-squares fit of two crossing, blurred edges."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.grids import Grid, eight_bit, images_through, no_grid
from pixmetry.locate.detect.targets import Flag, Positions
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template import _corner_kernels as kernels

REACH_PX = 10.0  # the blurred edges are straight over this length even through strongly distorting lenses
LEAST_REACH_PX = 4.0
CLEARANCE_PX = 3.0  # from the next edge of the board, for its blur
PLANES = {"never": kernels.NEVER, "always": kernels.ALWAYS, "auto": kernels.AUTO}
PLANES_SIGNIFICANT = 23.5  # fall of χ² with 4 unknowns more that noise alone causes once in 1e4
POOR_FIT_SIGMA = 6.0
OUTSIDE_PX = 1e6  # where a start that is not a number is put
LEAST_SQUARE_PX = 4
SLIP_PX, SLIP_SQUARES = 2.0, 0.1
SLIP_AROUND = 12
LEAST_ALTERNATION = 0.5  # of the squares' colours, agreeing less disagreeing
BESIDE, CLEAR_COLOUR = 0.3, 0.2  # squares, from a corner to where its four are looked at; of the contrast, between dark and bright there
RIM_SHARE = 0.5  # of the corners of an outermost row or column, at which four squares must meet
CHUNK = 64
OTHER_STARTS_PX = ((0.8, 0.0), (-0.8, 0.0), (0.0, 0.8), (0.0, -0.8))


def find_chessboard(frame: np.ndarray, inner_corners: tuple[int, int]) -> Grid:
    """Find the inner corners of a chessboard to about a pixel, with OpenCV.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    inner_corners : (int, int)
        Columns and rows of corners at which two dark squares meet (not of squares), each from 3 on.

    Returns
    -------
    Grid
        Row by row, numbered as by `numbered_by_colours`; empty with a message where no board of this size was seen.

    Raises
    ------
    InputError
        If fewer than 3 corners a side are asked for.

    Notes
    -----
    Of OpenCV's two finders the sector-based one is asked first (A. Duda, U. Frese, "Accurate detection and localization of checkerboard
    corners for calibration", BMVC 2018), then the older one, which follows quadrangles. Both want 8 bits: the frame is stretched between
    its 0.1 and 99.9 % quantiles for them and not changed itself.
    """
    cv2 = import_extra("cv2")

    cols, rows = (int(n) for n in inner_corners)
    if min(cols, rows) < 3:
        raise InputError("too few corners to identify a board", where="pattern", value=(cols, rows), allowed="3 × 3 inner corners or more")
    if min(frame.shape) < LEAST_SQUARE_PX * (min(cols, rows) + 1):  # OpenCV stops with an assertion
        return no_grid(f"the frame is too small for {cols} × {rows} inner corners", rows, cols)
    grey = eight_bit(frame)
    found, corners = cv2.findChessboardCornersSB(grey, (cols, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(grey, (cols, rows), flags=flags)
    if not found:
        return no_grid(f"no chessboard of {cols} × {rows} inner corners was found", rows, cols)
    place = without_slips(np.asarray(corners, float).reshape(rows, cols, 2)).reshape(-1, 2)
    row, col = np.divmod(np.arange(rows * cols), cols)
    return numbered_by_colours(frame, Grid(place[:, 0], place[:, 1], row, col, rows, cols))


def without_slips(place: np.ndarray) -> np.ndarray:
    """Rough places of corners, shape (rows, cols, 2), each that is far from where its neighbours expect it put there.

    The sector-based finder puts one corner in some thousands a third of a square away. A place counts as such a slip if it is off the
    homography through the 12 corners around it by more than 2 px and 0.1 squares, and by more than any of these is.
    """
    rows, cols = place.shape[:2]
    cells = np.stack(np.divmod(np.arange(rows * cols), cols), axis=1).astype(float)
    out = place.reshape(-1, 2).copy()
    near = np.argsort(((cells[:, None] - cells[None]) ** 2).sum(axis=2), axis=1, kind="stable")[:, 1 : SLIP_AROUND + 1]
    steps = np.stack([np.hypot(*np.moveaxis(np.gradient(place, axis=axis), 2, 0)) for axis in (0, 1)])
    limit = np.maximum(SLIP_PX, SLIP_SQUARES * steps.min(axis=0).ravel())
    for _ in range(len(out)):
        expected = np.array([images_through(cells[n] - cells[k], out[n], np.zeros((1, 2)))[0] for k, n in enumerate(near)])
        off = np.hypot(*(out - expected).T) / limit
        worst = (off > 1) & (off >= off[near].max(axis=1))
        if not worst.any():
            break
        out[worst] = expected[worst]
    return out.reshape(place.shape)


def numbered_by_colours(frame: np.ndarray, grid: Grid) -> Grid:
    """Number the corners of a whole chessboard so that the first square is dark.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    grid : Grid
        A whole board, row by row, counted from any corner and in any sense.

    Returns
    -------
    Grid
        Row by row. Columns turn to rows as x does to y, and the square between the first four corners is dark. A board with the same
        colours after a turn (`chessboard_turns`) is counted in that way in which its columns run most nearly towards x. Empty with a
        message where the colours do not alternate.

    Notes
    -----
    A square counts as dark or bright by the sign of its grey value less the mean of the squares beside it. At half of the corners of each
    outermost row and column four squares must meet: OpenCV's finders complete a board that the frame cuts with the outline of its squares,
    and would count from there.
    """
    rows, cols = grid.rows, grid.cols
    place = np.stack([grid.x_px, grid.y_px], axis=1).reshape(rows, cols, 2)
    across, down = np.diff(place, axis=1).mean(axis=(0, 1)), np.diff(place, axis=0).mean(axis=(0, 1))
    if across[0] * down[1] - across[1] * down[0] < 0:  # counted as in a mirror
        place = place[:, ::-1]
    turned = [np.rot90(place, k) for k in range(4)]
    shaped = [board for board in turned if board.shape[:2] == (rows, cols)]
    score = [float((square_colours(frame, board) * chessboard_colours(rows - 1, cols - 1)).mean()) for board in shaped]
    if max(score) < LEAST_ALTERNATION:
        return no_grid(f"the squares of what looks like {cols} × {rows} inner corners do not alternate between dark and bright", rows, cols)
    meet = crossing_corners(frame, place)
    if min(meet[0].mean(), meet[-1].mean(), meet[:, 0].mean(), meet[:, -1].mean()) < RIM_SHARE:
        what = f"part of a chessboard was found: {cols} × {rows} inner corners, but in an outermost row or column"
        return no_grid(f"{what} no four squares meet; part of a board cannot be numbered", rows, cols)
    steps = [np.diff(board, axis=1).mean(axis=(0, 1)) for board in shaped]
    # towards x, or towards y where x leaves a tie
    best = max(range(len(shaped)), key=lambda k: (score[k] > 0, round(steps[k][0] / np.hypot(*steps[k]), 6), steps[k][1]))
    x, y = shaped[best].reshape(-1, 2).T
    row, col = np.divmod(np.arange(rows * cols), cols)
    return Grid(x.copy(), y.copy(), row, col, rows, cols)


def square_colours(frame: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Colours of the squares between inner corners, 1 dark, −1 bright; shape (rows − 1, cols − 1) for ``place`` of (rows, cols, 2)."""
    middle = 0.25 * (place[:-1, :-1] + place[1:, :-1] + place[:-1, 1:] + place[1:, 1:])
    x, y = np.rint(middle[..., 0]).astype(int), np.rint(middle[..., 1]).astype(int)
    grey = frame[np.clip(y, 0, frame.shape[0] - 1), np.clip(x, 0, frame.shape[1] - 1)].astype(float)
    beside = np.pad(grey, 1, constant_values=np.nan)
    around = np.stack([beside[:-2, 1:-1], beside[2:, 1:-1], beside[1:-1, :-2], beside[1:-1, 2:]])
    colours: np.ndarray = np.sign(np.nanmean(around, axis=0) - grey)
    return colours


def crossing_corners(frame: np.ndarray, place: np.ndarray) -> np.ndarray:
    """At which corners two dark squares meet two bright ones crosswise, boolean, shape (rows, cols) as ``place`` of (rows, cols, 2)."""
    across, down = BESIDE * np.gradient(place, axis=1), BESIDE * np.gradient(place, axis=0)
    four = np.stack([place - across - down, place + across + down, place + across - down, place - across + down])
    x, y = np.rint(four[..., 0]).astype(int), np.rint(four[..., 1]).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < frame.shape[1]) & (y < frame.shape[0])
    grey = np.where(inside, frame[np.clip(y, 0, frame.shape[0] - 1), np.clip(x, 0, frame.shape[1] - 1)], np.nan).astype(float)
    gap = np.maximum(grey[:2].min(axis=0) - grey[2:].max(axis=0), grey[2:].min(axis=0) - grey[:2].max(axis=0))
    contrast = np.nanmedian(np.abs(grey[:2].mean(axis=0) - grey[2:].mean(axis=0)))
    crossing: np.ndarray = gap > CLEAR_COLOUR * contrast  # NaN is no crossing
    return crossing


def chessboard_colours(rows: int, cols: int) -> np.ndarray:
    """Colours of rows × cols squares of which the first one is dark: 1 dark, −1 bright."""
    return np.where(np.add.outer(np.arange(rows), np.arange(cols)) % 2 == 0, 1.0, -1.0)


def chessboard_turns(rows: int, cols: int) -> tuple[int, ...]:
    """Quarters of a turn after which a board of rows × cols inner corners looks the same.

    Examples
    --------
    >>> chessboard_turns(6, 9), chessboard_turns(5, 7), chessboard_turns(6, 6), chessboard_turns(7, 7)
    ((0,), (0, 2), (0, 1, 2, 3), (0, 2))
    """
    board = chessboard_colours(rows - 1, cols - 1)
    return tuple(k for k in range(4) if np.array_equal(np.rot90(board, k), board))


def chessboard_reach_px(grid: Grid, most_px: float = REACH_PX) -> np.ndarray:
    """How far around each corner the two edges alone are seen, shape (n,), pixels: up to `CLEARANCE_PX` before the next edge.

    Parameters
    ----------
    grid : Grid
        A whole board, corner by corner as from `find_chessboard`.
    most_px : float
        Farther than this a fit does not look.
    """
    place = np.stack([grid.x_px, grid.y_px], axis=1).reshape(grid.rows, grid.cols, 2)
    along_col, along_row = np.gradient(place, axis=1), np.gradient(place, axis=0)
    area = np.abs(along_col[..., 0] * along_row[..., 1] - along_col[..., 1] * along_row[..., 0])
    next_edge = area / np.maximum(np.hypot(*np.moveaxis(along_col, 2, 0)), np.hypot(*np.moveaxis(along_row, 2, 0)))
    reach: np.ndarray = np.clip(next_edge.ravel() - CLEARANCE_PX, LEAST_REACH_PX, most_px)
    return reach


def corner_positions(
    frame: np.ndarray,
    x_px: np.ndarray,
    y_px: np.ndarray,
    noise: NoiseModel,
    *,
    reach_px: np.ndarray | float | None = None,
    planes: str = "auto",
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> Positions:
    """Place corners at which two straight edges cross, black and white meeting crosswise, from rough places (to about 2 px).

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32, DN
    x_px, y_px : ndarray, shape (n,)
        Rough places.
    noise : NoiseModel
        Weights of the pixels; the ends of the scale, where values are cut off.
    reach_px : float or ndarray, shape (n,), optional
        Radius of the window. It must not hold a third edge. By default 10 px, or less where the next corner is near.
    planes : {"auto", "never", "always"}
        Whether mean and contrast may vary linearly over the window (light that falls off, four unknowns more): "auto" takes them where χ²
        falls by more than 23.5 (times χ² per degree of freedom, where that is above 1), which noise causes once in 10 000 corners.
    aperture_px : float
        Side of the pixel's light-sensitive square.
    threads : int, optional
        Default: all.

    Returns
    -------
    Positions
        The covariance is (JᵀWJ)⁻¹. In ``more``: amplitude_dn (bright minus dark), background_dn (dark), blur_px, direction_1_deg and
        direction_2_deg of the two edges (from x towards y, −90 … 90; from the first towards the second the squares are bright),
        chi2_per_dof, dof, reach_px.

    Raises
    ------
    InputError
        If ``planes`` is none of the three.

    Notes
    -----
    The model (see `_corner_kernels`) is symmetric under half a turn about the corner, as the picture is, and a shift is not; so a blur that
    is not quite Gaussian, or a wrong aperture, moves no corner.
    """
    if planes not in PLANES:
        raise InputError("no such choice of planes", value=planes, allowed=", ".join(PLANES))
    x, y = (np.clip(np.nan_to_num(np.ascontiguousarray(v, float).ravel(), nan=-OUTSIDE_PX), -OUTSIDE_PX, OUTSIDE_PX) for v in (x_px, y_px))
    reach = default_reach_px(x, y) if reach_px is None else np.broadcast_to(np.asarray(reach_px, float), x.shape).copy()
    how = kernels.How(PLANES[planes], PLANES_SIGNIFICANT, float(aperture_px), noise.numbers(frame.dtype))

    def fit(part: np.ndarray, dx: float, dy: float) -> None:
        own = _empty(len(part))
        kernels.fit_corners(frame, x[part] + dx, y[part] + dy, reach[part], how, own)
        for whole, values in zip(fits, own, strict=True):
            whole[part] = values

    fits = _empty(len(x))
    for dx, dy in ((0.0, 0.0), *OTHER_STARTS_PX):  # one fit in a thousand does not come to rest from where it began
        lost = np.flatnonzero((fits.states & 1) == 0)
        map_tiles(partial(fit, dx=dx, dy=dy), [lost[i : i + CHUNK] for i in range(0, len(lost), CHUNK)], threads)
    return _positions(reach, fits)


def measured_corners(
    frame: np.ndarray, grid: Grid, reach_px: np.ndarray | float, noise: NoiseModel, *, aperture_px: float = 1.0, threads: int | None = None
) -> tuple[Positions, NoiseModel]:
    """Place the corners of a board; where the noise is that of the image, with what the residuals of a first fit tell of it."""

    def place() -> Positions:
        return corner_positions(frame, grid.x_px, grid.y_px, noise, reach_px=reach_px, aperture_px=aperture_px, threads=threads)

    positions = place()
    chi2 = positions.more["chi2_per_dof"]
    if noise.origin == "image" and np.isfinite(chi2).any():
        # the background's noise has the board's edges in it: the residuals of a first fit know better
        noise = replace(noise, constant_dn2=noise.constant_dn2 * float(np.nanmedian(chi2)))
        positions = place()
    return positions, noise


def _empty(n: int) -> kernels.Fits:
    """Room for the fits of n corners."""
    integers = np.zeros(n, np.int64), np.zeros(n, np.int64)
    return kernels.Fits(np.full((n, kernels.ALL), np.nan), np.full((n, 3), np.nan), np.full(n, np.nan), *integers)


def default_reach_px(x_px: np.ndarray, y_px: np.ndarray, share: float = 0.85, clearance_px: float = CLEARANCE_PX) -> np.ndarray:
    """Radius of the windows, shape (n,): a share of the distance of the nearest other corner, less a clearance for the next edge's blur."""
    from scipy.spatial import cKDTree

    if len(x_px) < 2:
        return np.full(len(x_px), REACH_PX)
    place = np.stack([x_px, y_px], axis=1)
    nearest = cKDTree(place).query(place, k=2)[0][:, 1]
    reach: np.ndarray = np.clip(share * nearest - clearance_px, LEAST_REACH_PX, REACH_PX)
    return reach


def _positions(reach: np.ndarray, fits: kernels.Fits) -> Positions:
    dof, states = fits.dof, fits.states
    rest = (states & 1) > 0
    per_dof = np.where(dof > 0, fits.chi2 / np.maximum(dof, 1), np.nan)
    flags = np.zeros(len(dof), np.uint32)
    marks = (
        (~rest, Flag.NOT_CONVERGED),
        (states & 2 > 0, Flag.BORDER),
        (states & 4 > 0, Flag.GRADIENT),
        (states & 8 > 0, Flag.SATURATED),
        (states & 16 > 0, Flag.CLIPPED_AT_BLACK),
        (per_dof > 1 + POOR_FIT_SIGMA * np.sqrt(2 / np.maximum(dof, 1)), Flag.POOR_FIT),
    )
    for mark, flag in marks:
        flags[mark] |= np.uint32(flag)
    found, covariance = (np.where(rest[:, None], values, np.nan) for values in (fits.found, fits.covariance))
    more: dict[str, Any] = {
        "amplitude_dn": 2 * np.abs(found[:, 6]),
        "background_dn": found[:, 5] - np.abs(found[:, 6]),
        "blur_px": found[:, 4],
        **dict(zip(("direction_1_deg", "direction_2_deg"), _directions_deg(found), strict=True)),
        "chi2_per_dof": np.where(rest, per_dof, np.nan),
        "dof": dof,
        "reach_px": reach,
    }
    return Positions(found[:, 0], found[:, 1], covariance[:, 0], covariance[:, 1], covariance[:, 2], flags, more)


def _directions_deg(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the two edges in the order in which the squares from the first to the second, turning x to y, are bright."""
    first, second = np.degrees(found[:, 2]) - 90, np.degrees(found[:, 3]) - 90
    # half-way from the first to the second, the product of the distances has the sign of −sin² of half the span: dark for contrast > 0
    swap = found[:, 6] > 0
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    return (first + 90) % 180 - 90, (second + 90) % 180 - 90
