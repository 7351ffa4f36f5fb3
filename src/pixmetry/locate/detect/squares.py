"""Corners of separate squares on a plate: from straight fits to their edges, each corner being where two of them meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.detection import Regions, detect
from pixmetry.locate.detect.grids import Grid, images_through, no_grid, order_grid
from pixmetry.locate.detect.targets import Flag, Positions
from pixmetry.locate.lines.line_candidates import LineCandidates
from pixmetry.locate.lines.lines import PIXEL, line_positions
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel

LEAST_SIDE_PX = 12.0  # below it, the blur of opposite edges leaves no flat ground between them
SQUARE_FILL = (0.90, 0.975)  # area over that of the ellipse of the same moments: 3/π = 0.955, some noise, and rounded corners
LARGEST_RATIO = 3.5  # of the axes: a square seen at 70°
USUAL_AREA = 6.0  # factor to either side of the median within which the squares of one plate lie
AROUND = 12  # squares through which a homography is laid to expect the corners of one
MOST_OFF_PX = 3.0  # of a corner from where its neighbours expect it
AT_REST = 0.5  # of its standard uncertainty, by which a corner may still move between two passes
PASSES = 3  # each from the corners, and with the noise, of the one before
CORNERS = np.array([(0, 0), (0, 1), (1, 1), (1, 0)])  # (row, col) of a square's corners, round it as x turns to y


def find_squares(
    frame: np.ndarray, pattern: tuple[int, int], *, polarity: str = "auto", low_dn: float = -np.inf, high_dn: float = np.inf
) -> tuple[Grid, Regions]:
    """Find the squares of a plate and number them.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    pattern : (int, int)
        Columns and rows of squares.
    polarity : {"auto", "bright", "dark"}
        Of the squares on their ground; "auto" takes the one that gives more of the pattern.
    low_dn, high_dn : float
        Ends of the scale.

    Returns
    -------
    grid : Grid
        Rough centres; empty with a message where the pattern was not seen. Squares may be missing inside of it.
    squares : Regions
        What was detected, in the same order.

    Raises
    ------
    InputError
        If the pattern has fewer than 3 squares a side.
    """
    if min(pattern) < 3:
        raise InputError("too few squares to identify a plate", where="pattern", value=pattern, allowed="3 × 3 squares or more")
    best: tuple[Grid, Regions] | None = None
    found = detect(frame, polarity=polarity, low_dn=low_dn, high_dn=high_dn).targets
    for side in (found.amplitude_dn < 0, found.amplitude_dn > 0):
        squares = _like_squares(found[side])
        grid = order_grid(squares.x_px, squares.y_px, pattern=pattern)
        if best is None or (not grid.message, grid.placed.sum()) > (not best[0].message, best[0].placed.sum()):
            best = grid, squares
    assert best is not None
    grid, squares = best
    if not grid.message and grid.placed.sum() >= AROUND // 2:
        on = grid.placed
        return Grid(grid.x_px[on], grid.y_px[on], grid.row[on], grid.col[on], grid.rows, grid.cols), squares[on]
    seen = grid.message or f"{int(grid.placed.sum())} squares"
    return no_grid(f"no plate of {pattern[0]} × {pattern[1]} squares was found: {seen}"), squares[:0]


def _like_squares(found: Regions) -> Regions:
    """Regions whose shape and size can be those of the plate's squares."""
    full = (found.fill > SQUARE_FILL[0]) & (found.fill < SQUARE_FILL[1]) & (found.holes == 0) & ((found.flags & Flag.BORDER) == 0)
    slim = found.semi_major_px > LARGEST_RATIO * found.semi_minor_px
    found = found[full & ~slim & (found.area_px > LEAST_SIDE_PX**2 / 2)]
    if not len(found):
        return found
    size = found.area_px / np.median(found.area_px)
    return found[(size > 1 / USUAL_AREA) & (size < USUAL_AREA)]


def expected_corners(grid: Grid, side: tuple[float, float]) -> np.ndarray:
    """Where the corners of all squares of the pattern are expected, from the centres of those that were found.

    Parameters
    ----------
    grid : Grid
        From `find_squares`.
    side : (float, float)
        Of a square along columns and along rows, in units of the pitch.

    Returns
    -------
    ndarray, shape (rows, cols, 4, 2)
        x, y of the corners, row by row; round each square from its first one, at least row and column, as x turns to y.
    """
    cells = np.stack([grid.row, grid.col], axis=1).astype(float)
    places = np.stack([grid.x_px, grid.y_px], axis=1)
    corners = np.empty((grid.rows, grid.cols, 4, 2))
    for row in range(grid.rows):
        for col in range(grid.cols):
            near = np.argsort(((cells - (row, col)) ** 2).sum(axis=1), kind="stable")[:AROUND]
            corners[row, col] = images_through(cells[near] - (row, col), places[near], (CORNERS - 0.5) * side[::-1])
    return corners


def square_corners(
    frame: np.ndarray,
    corners_px: np.ndarray,
    noise: NoiseModel,
    *,
    blur_px: float = 0.8,
    amplitude_dn: float = 0.0,
    background_dn: float = 0.0,
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> Positions:
    """Place the corners of squares where straight fits to their sides meet.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    corners_px : ndarray, shape (n, 4, 2)
        x, y of rough corners (to about 2 px), round each square as x turns to y.
    noise : NoiseModel
    blur_px : float
        Rough standard deviation of the blur, without the pixel.
    amplitude_dn, background_dn : float
        Rough grey value of a square less that of its ground, and of its ground.
    aperture_px : float
        Side of the pixel's light-sensitive square.
    threads : int, optional

    Returns
    -------
    Positions
        4 n corners, square by square; NaN with the flag NOT_CONVERGED where a corner did not come to rest or lies farther than 3 px from
        where it was expected. In ``more``: chi2_per_dof (the larger of the two sides).

    Notes
    -----
    With n = (−sin θ, cos θ) and n·x = o for each of two sides, dx = N⁻¹ (do + l dθ), l being the place along the side; the covariances of
    o and θ are those of the fits, times χ²/dof of the side where that is above 1 and the noise was measured in the image: what lies on a
    plate, and the ringing of a camera's electronics, disturb some sides more than others. Sides are taken to be straight between their
    corners and bend in fact with the lens; the corner of a side of 30 px that bends by 0.02 px is 0.01 px off.
    """
    start = np.asarray(corners_px, float)
    corners = before = start
    for _ in range(PASSES):
        sides = _sides(corners, blur_px, amplitude_dn, background_dn)
        fit = line_positions(frame, sides, noise, "edge", "template", curvature=False, aperture_px=aperture_px, threads=threads)
        place, covariance = _intersections(fit, noise.origin == "image", start)
        before, corners = corners, np.where(np.isfinite(place), place, start)
        chi2 = fit.more["chi2_per_dof"]
        if noise.origin == "image" and np.isfinite(chi2).any():
            # beside the squares the picture may be cut off or smooth: the residuals of a first fit know better
            noise = replace(noise, constant_dn2=noise.constant_dn2 * float(np.nanmedian(chi2)))
    flags, worse = (_either(v) for v in (fit.flags, fit.more["chi2_per_dof"]))
    # a sharp edge along the pixels lets its blur creep, and the place with it by far less than it is uncertain
    moved = np.abs(place - before).max(axis=2) / np.sqrt(np.fmin(covariance[..., 0], covariance[..., 2]))
    lost = ~((moved < AT_REST) | ((flags & Flag.NOT_CONVERGED == 0) & np.isfinite(moved)))
    flags = np.where(lost, flags | Flag.NOT_CONVERGED, flags & ~np.uint32(Flag.NOT_CONVERGED)).astype(np.uint32)
    place[lost], covariance[lost] = np.nan, np.nan
    (x, y), (var_x, cov, var_y) = place.reshape(-1, 2).T, covariance.reshape(-1, 3).T
    return Positions(x, y, var_x, cov, var_y, flags.ravel(), {"chi2_per_dof": worse.ravel()})


def _either(by_side: np.ndarray) -> np.ndarray:
    """What a corner has of its two sides, shape (n, 4): all flags, the larger of two numbers."""
    here = by_side.reshape(-1, 4)
    there = np.roll(here, 1, axis=1)
    return np.fmax(here, there) if here.dtype.kind == "f" else here | there


def _sides(corners: np.ndarray, blur_px: float, amplitude_dn: float, background_dn: float) -> LineCandidates:
    """The four sides of each square, side k from corner k to the next, so that the square is on the side of (−sin, cos)."""
    first, last = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
    return LineCandidates.of(
        x1_px=first[:, 0], y1_px=first[:, 1], x2_px=last[:, 0], y2_px=last[:, 1],
        blur_px=blur_px, amplitude_dn=amplitude_dn, background_dn=background_dn,
    )  # fmt: skip


def _intersections(fit: Positions, scaled: bool, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 4, 2) where each side meets the one before it, and their covariances (n, 4, 3) of x, xy, y."""
    angle = np.radians(fit.more["angle_deg"]).reshape(-1, 4)
    offset = fit.more["offset_px"].reshape(-1, 4)
    sides = [offset, angle, *(_of(fit, name) for name in ("var_offset_px2", "cov_offset_angle_px_deg"))]
    sides.append(_of(fit, "var_angle_deg2"))
    factor = np.maximum(_of(fit, "chi2_per_dof"), 1.0) if scaled else np.ones_like(angle)
    both = [np.stack([np.roll(v, 1, axis=1), v], axis=2) for v in (*sides, factor)]
    o, theta, var_o, cov, var_theta, factor = both
    normal = np.stack([-np.sin(theta), np.cos(theta)], axis=3)
    det = normal[..., 0, 0] * normal[..., 1, 1] - normal[..., 0, 1] * normal[..., 1, 0]
    inverse = np.empty_like(normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse[..., 0, 0], inverse[..., 0, 1] = normal[..., 1, 1] / det, -normal[..., 0, 1] / det
        inverse[..., 1, 0], inverse[..., 1, 1] = -normal[..., 1, 0] / det, normal[..., 0, 0] / det
        place = (inverse * o[..., None, :]).sum(axis=3)
    far = ~(np.hypot(*np.moveaxis(place - expected, 2, 0)) < MOST_OFF_PX)
    place[far] = np.nan
    along = np.cos(theta) * place[..., :1] + np.sin(theta) * place[..., 1:]
    radian = np.pi / 180
    variance = (var_o + 2 * along * cov * radian + (along * radian) ** 2 * var_theta) * factor
    full = np.einsum("nkij,nkj,nklj->nkil", inverse, variance, inverse)
    return place, np.stack([full[..., 0, 0], full[..., 0, 1], full[..., 1, 1]], axis=2)


def _of(fit: Positions, name: str) -> np.ndarray:
    return fit.more[name].reshape(-1, 4)


def plate_corners(
    frame: np.ndarray,
    pattern: tuple[int, int],
    side: tuple[float, float],
    noise: NoiseModel | None = None,
    *,
    polarity: str = "auto",
    low_dn: float = -np.inf,
    high_dn: float = np.inf,
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> tuple[Grid, Positions]:
    """Find a plate of squares and place all corners of it.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    pattern : (int, int)
        Columns and rows of squares.
    side : (float, float)
        Of a square along columns and along rows, in units of the pitch.
    noise : NoiseModel, optional
        By default it is measured in the image.
    polarity, low_dn, high_dn, aperture_px, threads
        As in `find_squares` and `square_corners`.

    Returns
    -------
    grid : Grid
        Row and column of corners: those of square (i, j) are at 2 i, 2 i + 1 and 2 j, 2 j + 1. Empty with a message if nothing was found.
    positions : Positions
        In the same order.

    Raises
    ------
    InputError
        As `find_squares`, or if ``side`` is not between 0 and 1.
    """
    if not (min(side) > 0 and max(side) < 1):
        raise InputError("squares of a plate do not touch", where="side", value=side, allowed="between 0 and 1 pitch")
    centres, squares = find_squares(frame, pattern, polarity=polarity, low_dn=low_dn, high_dn=high_dn)
    corners = expected_corners(centres, side).reshape(-1, 4, 2) if len(centres) else np.empty((0, 4, 2))
    row, col = (np.repeat(v.ravel(), 4) for v in np.meshgrid(np.arange(pattern[1]), np.arange(pattern[0]), indexing="ij"))
    around = np.tile(CORNERS, (len(corners), 1))
    if not len(corners):
        none = np.empty(0)
        return centres, Positions(none, none, none, none, none, np.empty(0, np.uint32), {"chi2_per_dof": none})
    if noise is None:
        least = ROUNDING_DN2 if frame.dtype.kind == "u" else 1e-12
        noise = NoiseModel(max(float(np.median(squares.sigma_dn)) ** 2, least), low_dn=low_dn, high_dn=high_dn, origin="image")
    blur = float(np.sqrt(max(np.median(squares.blur_px) ** 2 - PIXEL**2, 0.09)))
    height, ground = float(np.median(squares.amplitude_dn)), float(np.median(squares.background_dn))
    found = square_corners(
        frame, corners, noise, blur_px=blur, amplitude_dn=height, background_dn=ground, aperture_px=aperture_px, threads=threads
    )
    return Grid(found.x_px, found.y_px, 2 * row + around[:, 0], 2 * col + around[:, 1], 2 * pattern[1], 2 * pattern[0]), found
