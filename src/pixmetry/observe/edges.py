"""Slanted edges found in pictures by themselves, and their spatial frequency response (ISO 12233:2023, e-SFR).

An edge that crosses the columns at a few degrees is sampled at all parts of a pixel. Steep steps are found row by row and linked to chains;
a polynomial through each chain is refined against the mean of the edge's own rows; the pixels then make one finely sampled curve. Nearly
horizontal edges are measured in the transposed picture.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from pixmetry.camera.observations import EdgeResponse, RefusedEdge, SlantedEdge, SlantedEdges
from pixmetry.core.arrays import Array, Flags, Ints, Singles
from pixmetry.core.number import Estimates
from pixmetry.core.threads import map_tiles
from pixmetry.observe._edge_kernels import bin_edge, find_steps, link_steps, row_shifts
from pixmetry.observe.stack import StackAccumulator

TURNED_PX = 256  # side of a part of a frame that is turned at once
STEP_PX = 0.25  # of the bins, as in ISO 12233
FREQUENCY = np.linspace(0.0, 2.0, 101)  # cycles/px
LEAST_ROWS, LEAST_CHAIN = 30, 12  # of an edge that is measured; of one that is mentioned
LEAST_HALF_PX, MOST_HALF_PX = 12.0, 20.0
MOST_RIGHT_PX = 40.0  # to the right of an edge, as far as another allows: echoes of a video line come so late
LINE_START_PX = 30  # columns at the left of an analogue picture that are left out: the line comes from black there
GHOST_SHARE = 0.35  # of an edge's slope: weaker steps behind it, on a video line, are its own echo or ringing
LEAST_ANGLE_DEG, MOST_ANGLE_DEG = 1.5, 12.0
LEAST_SNR = 20.0  # height over noise
CLIPPED_SHARE = 0.002
UNEVEN_ACROSS, UNEVEN_ALONG = 0.03, 0.10  # of the height: over 10 px across the edge, over its length
ADJUSTED_PX = 10.0
FLAT_FROM_PX = 8.0  # from the edge, where the sides should be flat
BENT_PX = 2.0  # farthest that a measured edge may leave a straight line
SMOOTH_PX = 0.2  # scatter of the rows' places about the polynomial, beyond noise
MOST_ORDER, F_LEVEL = 5, 1e-3
PHASES, PHASE_SHARE = 6, 0.05  # of the rows in each sixth of a pixel
NEIGHBOUR_SHARE = 0.03  # of the rows with another step, from which on it is another edge
TILE_ROWS = 256
LIGHT_TERMS, LIGHT_U = ("x", "y", "xx", "xy", "yy"), 0.2  # of the light over a picture; how large each is before anything is measured
FAR_PX = 3.0  # from the edge, from which on pixels tell the light
UNEVEN_CHI2, LEAST_LIGHT = 40.0, 0.3  # from which on a picture is divided by its light; and its least part of that of the middle
STEP_SIGMAS, LEAST_STEP_DN, LEAST_STEP_REL = 8.0, 2.0, 0.02  # of noise; absolute; of the range of values
# u of an asymmetry that comes of the bins of 1/4 px, over the width of the edge from 10 to 90 % in px: a × exp(−b × width). Of symmetric
# edges without noise behind Gaussians of 0.2, 0.4, 0.7 and 1.0 px the scatter over places and angles is .014, .0052, .0010 and .0002.
OF_SAMPLING = (0.12, 2.5)
MOVED_PX = 0.05  # rms, from which on a motion between frames is told
ALPHA = 0.5  # of the Tukey window: this share of its length is tapered
MOST_STEPS = 20  # places a row, on average, that are kept
FITTED = "e-SFR: edge spread in bins of 1/4 px, ISO 12233:2023"


@dataclass(frozen=True)
class Picture:
    """The mean of the frames of one group in which nothing moved: ``data``, shape (rows, cols), float32, DN."""

    kind: str
    data: Singles
    n_frames: int
    top_dn: float
    var_dn2: Singles | None = None  # temporal variance of each pixel, of two frames or more

    @classmethod
    def of(cls, kind: str, moments: object, bits: int) -> Picture:
        """From the sums of a group."""
        assert isinstance(moments, StackAccumulator)
        frames = moments.n_frames
        variance = (moments.deviation_map_dn2() / (frames - 1)).astype(np.float32) if frames > 1 else None
        return cls(kind, moments.mean_map_dn().astype(np.float32), frames, 2.0**bits - 1, variance)


@dataclass(frozen=True)
class Region:
    """The pixels of one edge in a picture in which it is nearly vertical.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), float32
        The picture, transposed where the edge is nearly horizontal.
    picture : int
    across : {"x", "y"}
    first : int
        First row.
    line : ndarray, shape (order + 1,)
        Column of the edge over t = (row − middle)/half the number of rows, by rising powers.
    rows : int
    half_px : float
        Half width, along the normal.
    slope, u_slope : float
        Columns per row in the middle.
    right_px : float
        How far to the right, along the normal, there is no other edge, up to `MOST_RIGHT_PX`.
    scatter_px : float
        Standard deviation of the rows' places about the polynomial.
    """

    frame: Singles
    picture: int
    across: str
    first: int
    line: Array
    rows: int
    half_px: float
    slope: float
    u_slope: float
    right_px: float = LEAST_HALF_PX
    scatter_px: float = 0.0

    @property
    def centre(self) -> Array:
        """Column of the edge in each row, shape (rows,)."""
        return line_at(self.line, self.rows)

    @property
    def cosine(self) -> float:
        """Of the angle between edge and columns."""
        return float(1 / np.hypot(1, self.slope))


class _Refused(Exception):
    """Why an edge cannot be measured."""


def line_at(line: Array, rows: int) -> Array:
    """Columns of a polynomial over the rows of an edge."""
    t = (np.arange(rows) - 0.5 * (rows - 1)) / (0.5 * (rows - 1))
    return np.asarray(np.polynomial.polynomial.polyval(t, line), float)


@dataclass(frozen=True)
class Search:
    """Edges that can be measured, each with its fine curve, and those that cannot."""

    measured: tuple[tuple[Region, Spread], ...]
    refused: tuple[RefusedEdge, ...]


def search_edges(pictures: Sequence[Picture], analogue: bool = False) -> Search:
    """Find the slanted edges of pictures.

    Parameters
    ----------
    pictures : sequence of Picture
    analogue : bool
        Whether they came over a video line: then the first 30 columns are left out, and weak steps behind an edge are its echoes.

    Returns
    -------
    Search

    Notes
    -----
    Edges are found at up to 45 degrees, and those that cannot be measured come back with the reason. Bins of 1/4 px are corrected for
    their uneven filling (with the curve's own slope), for their width and for the difference of neighbours (both sinc(ν/4)). The window
    is Tukey's. u comes from the scatter of the pixels about the mean curve, with the correlation of neighbours, carried on linearly. The
    place of an edge moves only the phase; an error δ of its slope adds (δ rows)²/12 to the variance of its spread, which is left out.
    """
    measured: list[tuple[Region, Spread]] = []
    refused: list[RefusedEdge] = []
    for number, picture in enumerate(pictures):
        found = _edges_in(picture, number, analogue)
        even = _in_even_light(picture, found.measured)
        if even is not picture:
            found = _edges_in(even, number, analogue)
        measured += found.measured
        refused += found.refused
    return Search(tuple(measured), tuple(refused))


def _edges_in(picture: Picture, number: int, analogue: bool) -> Search:
    """The edges of one picture."""
    measured: list[tuple[Region, Spread]] = []
    refused: list[RefusedEdge] = []
    for across in ("x", "y"):
        frame = picture.data if across == "x" else _turned(picture.data)
        chains = step_chains(frame)
        for result in map_tiles(partial(_measured, frame, picture, number, across, chains, analogue), chains.long):
            if isinstance(result, RefusedEdge):
                refused.append(result)
            else:
                measured.append(result)
    return Search(tuple(measured), tuple(refused))


def _turned(frame: np.ndarray) -> np.ndarray:
    """The frame with rows and columns exchanged, copied part by part, each of which stays in the cache: twice as fast as all at once."""
    out = np.empty(frame.shape[::-1], frame.dtype)
    for row in range(0, frame.shape[0], TURNED_PX):
        for col in range(0, frame.shape[1], TURNED_PX):
            out[col : col + TURNED_PX, row : row + TURNED_PX] = frame[row : row + TURNED_PX, col : col + TURNED_PX].T
    return out


def _in_even_light(picture: Picture, measured: Sequence[tuple[Region, Spread]]) -> Picture:
    """The picture over the slow part of its light, a polynomial of second order; itself where the edges show none.

    Only how the light changes along the edges counts, at each distance from them: across an edge, the lens spreads light too. So the
    slope along x is that of the edges along x, and without such edges it is left alone.
    """
    normal, right = np.eye(len(LIGHT_TERMS)) / LIGHT_U**2, np.zeros(len(LIGHT_TERMS))
    centre, half = _centre_of(picture.data.shape)
    for region, spread in measured:
        value, distance = pixels_of(region)
        residual = value - _along(spread.value_dn, distance)
        known = np.isfinite(residual) & (np.abs(distance) > FAR_PX)
        column = np.broadcast_to(np.arange(known.shape[1]), known.shape)[known]
        row = np.broadcast_to(region.first + np.arange(region.rows, dtype=float)[:, None], known.shape)[known]
        col = (distance / region.cosine + region.centre[:, None])[known]
        x, y = (col, row) if region.across == "x" else (row, col)
        terms = _light_terms((x - centre[0]) / half, (y - centre[1]) / half)
        count = np.maximum(np.bincount(column, minlength=known.shape[1]), 1)
        terms -= np.array([(np.bincount(column, term, known.shape[1]) / count)[column] for term in terms])
        level, left = (value - residual)[known], residual[known]
        scale = 1 / spread.noise_dn**2 / (1 + 2 * max(spread.along_rel, 0.0))
        weighted = terms * level
        normal += scale * (weighted @ weighted.T)
        right += scale * (weighted @ left)
    found = np.linalg.solve(normal, right)
    if float(right @ found) < UNEVEN_CHI2:
        return picture
    x, y = ((np.arange(n) - middle) / half for n, middle in zip(picture.data.shape[::-1], centre, strict=True))
    light = 1 + np.tensordot(found, _light_terms(*np.meshgrid(x, y)), 1)
    if light.min() < LEAST_LIGHT:
        return picture
    return replace(picture, data=(picture.data / light).astype(np.float32))


def _centre_of(shape: tuple[int, int]) -> tuple[tuple[float, float], float]:
    """The middle of a frame (x, y), and half of its longer side."""
    rows, cols = shape
    return (0.5 * (cols - 1), 0.5 * (rows - 1)), 0.5 * max(rows, cols)


def _light_terms(x: Array, y: Array) -> Array:
    """x, y, x², xy, y², shape (5, …)."""
    return np.stack([x, y, x * x, x * y, y * y])


def motion_notes(pictures: Sequence[Picture], found: Search) -> list[str]:
    """A note for each picture whose edges moved between its frames: their mean is blurred by that.

    A shift of variance s² between frames adds s² (dI/dx)² to the temporal variance at the edge; what noise has there is the mean of both
    sides. The root mean square shift is taken over all edges of a picture.
    """
    notes = []
    for number, picture in enumerate(pictures):
        if picture.var_dn2 is None:
            continue
        excess, steep, weight = 0.0, 0.0, 0.0
        for region, spread in found.measured:
            if region.picture != number:
                continue
            var = picture.var_dn2 if region.across == "x" else picture.var_dn2.T
            own, distance = pixels_of(replace(region, frame=var))
            slope = np.interp(distance, spread.distance_px[1:], np.diff(spread.value_dn) / STEP_PX)
            near, far = np.abs(distance) < 1.5, np.abs(distance) > 4
            noise = float(np.nanmean(own[far]))
            square = slope[near] ** 2
            excess += float((square * (own[near] - noise)).sum())
            steep += float((square**2).sum())
            weight += float((square**2).sum()) * 2 * noise**2 / (picture.n_frames - 1)
        shift2 = excess / steep if steep else 0.0
        if shift2 > MOVED_PX**2 and excess > 5 * np.sqrt(weight):
            notes.append(
                f"the edges of picture {number + 1} moved by about {np.sqrt(shift2):.2f} px (rms) between its frames: the mean is blurred "
                "by that; mount camera and chart firmly, or list each frame as a group of its own"
            )
    return notes


def responses_of(found: Search, optics: Estimates | None = None, line: Estimates | None = None) -> SlantedEdges:
    """The e-SFR of every edge and of both directions, with what was fitted to all edges together."""
    edges = tuple(_edge_of(region, spread) for region, spread in found.measured)
    of_x, of_y = (_mean_response([s for r, s in found.measured if r.across == axis]) for axis in "xy")
    summary = _summary(edges, {"x": of_x, "y": of_y})
    return SlantedEdges(FREQUENCY, edges, found.refused, of_x, of_y, summary, Estimates.empty() if optics is None else optics, line)


# ---- finding --------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StepChains:
    """Steps by row; of each its chain. ``long`` numbers the chains that are worth a word."""

    row: Ints
    col: Array
    size: Array
    chain: Ints
    order: Ints  # of the steps by chain, then row
    start: Ints  # first of each chain in that order, and the end
    long: Ints

    def steps(self, number: int) -> tuple[Ints, Array]:
        """Rows and columns of a chain."""
        own = self.order[self.start[number] : self.start[number + 1]]
        return self.row[own], self.col[own]


def step_chains(frame: Singles) -> StepChains:
    """Steep steps along the rows, linked from row to row."""
    threshold = _threshold(frame)
    tiles = range(0, frame.shape[0], TILE_ROWS)

    def searched(first: int) -> tuple[Ints, Array, Array]:
        most = MOST_STEPS * TILE_ROWS + frame.shape[1]
        row, col, size = np.empty(most, np.int64), np.empty(most), np.empty(most)
        n = find_steps(frame, first, first + TILE_ROWS, threshold, row, col, size)
        return row[:n].copy(), col[:n].copy(), size[:n].copy()

    parts = map_tiles(searched, tiles)
    row, col, size = (np.concatenate([part[k] for part in parts]) for k in range(3))
    chain = np.zeros(row.size, np.int64)
    count = link_steps(row, col, size, chain)
    order = np.argsort(chain, kind="stable")
    start = np.searchsorted(chain[order], np.arange(count + 1))
    return StepChains(row, col, size, chain, order, start, np.flatnonzero(np.diff(start) >= LEAST_CHAIN))


def _threshold(frame: Singles) -> float:
    """Height from which a step is told from noise, DN: from the median size of the slopes in a few rows."""
    if frame.shape[0] < 3:
        return LEAST_STEP_DN
    rows = np.linspace(1, frame.shape[0] - 2, min(61, frame.shape[0] - 2)).astype(int)
    total = frame[rows - 1].astype(float) + frame[rows] + frame[rows + 1]
    slope = (total[:, 3:-1] + total[:, 4:] - total[:, :-4] - total[:, 1:-3]) / 6
    noise = np.abs(slope[slope != 0])  # a clipped side has none
    median = float(np.median(noise)) if noise.size else 0.0
    return max(STEP_SIGMAS * median / 0.6745, LEAST_STEP_DN, LEAST_STEP_REL * float(np.ptp(frame[rows])))


def _measured(
    frame: Singles, picture: Picture, number: int, across: str, chains: StepChains, analogue: bool, chain: int
) -> tuple[Region, Spread] | RefusedEdge:
    """Measure the edge of one chain, or say why not."""
    row, col = chains.steps(chain)
    slope = robust_slope(row, col)
    try:
        region = _region(frame, number, across, chain, chains, analogue)
        _check_light(region, picture)
        spread = _spread_of(region)
        if abs(spread.height) < LEAST_SNR * spread.noise_dn:
            raise _Refused(f"the step is only {abs(spread.height) / spread.noise_dn:.0f} times the noise (at least {LEAST_SNR:g})")
        return region, spread
    except _Refused as why:
        x, y = float(np.median(col)), float(np.median(row))
        place = (x, y) if across == "x" else (y, x)
        return RefusedEdge(number, across, *place, float(np.degrees(np.arctan(slope))), len(row), str(why))


def robust_slope(row: Ints, col: Array) -> float:
    """Columns per row: the median over pairs half the chain apart (Theil)."""
    half = len(row) // 2
    return float(np.median((col[half:] - col[: len(col) - half]) / np.maximum(row[half:] - row[: len(row) - half], 1)))


def _region(frame: Singles, number: int, across: str, chain: int, chains: StepChains, analogue: bool) -> Region:
    """Rows, width and line of an edge, after the checks that need no light."""
    row, col = chains.steps(chain)
    slope = robust_slope(row, col)
    angle = abs(float(np.degrees(np.arctan(slope))))
    if angle < LEAST_ANGLE_DEG or angle > MOST_ANGLE_DEG:
        raise _Refused(f"the angle is {angle:.1f} degrees (allowed: {LEAST_ANGLE_DEG:g} to {MOST_ANGLE_DEG:g})")
    half, right = _free_reach(frame, chain, chains, slope, analogue and across == "x")
    first, end = int(row[0]), int(row[-1]) + 1
    trim = 4 + int(np.ceil(0.25 * half))
    first = first + trim if first > 2 else first - 1
    end = end - trim if end < frame.shape[0] - 2 else end + 1
    if analogue and across == "y":
        first = max(first, LINE_START_PX)
    rows = end - first
    if rows < LEAST_ROWS:
        raise _Refused(f"it is too short: {max(rows, 0)} rows without its ends (at least {LEAST_ROWS})")
    line = np.zeros(2)
    t = (row - (first + 0.5 * (rows - 1))) / (0.5 * (rows - 1))
    line[1] = slope * 0.5 * (rows - 1)
    line[0] = float(np.median(col - line[1] * t))
    region = Region(frame, number, across, first, line, rows, half, slope, 0.0, right)
    return _refined(region)


def _free_reach(frame: Singles, chain: int, chains: StepChains, slope: float, on_line: bool) -> tuple[float, float]:
    """How far from the edge there is no other edge and no border of the frame: to both sides, and to the right."""
    row, col = chains.steps(chain)
    a, b = np.searchsorted(chains.row, [row[0] + 8, row[-1] - 7])
    cosine = 1 / np.hypot(1, slope)
    offset = float(np.median(col - slope * row))
    others = chains.chain[a:b] != chain
    away = (chains.col[a:b] - offset - slope * chains.row[a:b])[others] * cosine
    if on_line:
        own = float(np.median(np.abs(chains.size[chains.chain == chain])))
        away = away[(away < 0) | (np.abs(chains.size[a:b][others]) > GHOST_SHARE * own)]
    few = max(3, int(NEIGHBOUR_SHARE * len(row)))

    def free(distances: Array, most: float) -> float:
        near = np.sort(distances[(distances > 2) & (distances < most + 6)])
        return most if len(near) < few else min(most, float(near[few - 1]) - 4)

    start = LINE_START_PX if on_line else 0
    half = free(np.abs(away), MOST_HALF_PX)
    to_right = (frame.shape[1] - 1 - float(col.max())) * cosine - 0.5
    border = min((float(col.min()) - start) * cosine - 0.5, to_right)
    if border < LEAST_HALF_PX:
        raise _Refused(f"the border of the frame is {max(border, 0):.0f} px away (at least {LEAST_HALF_PX:g})")
    if half < LEAST_HALF_PX:
        raise _Refused(f"another edge is {half + 4:.0f} px away (at least {LEAST_HALF_PX + 4:g})")
    return float(min(half, border)), float(min(free(away, MOST_RIGHT_PX), to_right))


def _refined(region: Region) -> Region:
    """The polynomial through the places of the rows, found against the mean of all rows; its order by F tests."""
    t = np.linspace(-1, 1, region.rows)
    for most in (1, MOST_ORDER, MOST_ORDER):
        shift, good = _shifts(region)
        places = region.centre + shift
        line, residual, order = _polynomial(t[good], places[good], most)
        slope = float(line[1] / (0.5 * (region.rows - 1)))
        scatter = float(residual.std(ddof=order + 1))
        basis = np.polynomial.polynomial.polyvander(t[good], len(line) - 1)
        u_slope = scatter * float(np.sqrt(np.linalg.inv(basis.T @ basis)[1, 1])) / (0.5 * (region.rows - 1))
        region = replace(region, line=line, slope=slope, u_slope=u_slope, scatter_px=scatter)
        if not np.isfinite(line).all() or np.abs(places - region.centre).max(initial=0.0) > 8:
            raise _Refused("its rows do not follow a line")
    if scatter > SMOOTH_PX:
        raise _Refused(f"its rows scatter by {scatter:.2f} px about a smooth line (allowed: {SMOOTH_PX:g})")
    straight = line_at(region.line[:2], region.rows)
    bend = float(np.ptp(region.centre - straight))
    if bend > BENT_PX:
        raise _Refused(f"it is bent by {bend:.1f} px (allowed: {BENT_PX:g})")
    angle = abs(float(np.degrees(np.arctan(region.slope))))
    if angle < LEAST_ANGLE_DEG or angle > MOST_ANGLE_DEG:
        raise _Refused(f"the angle is {angle:.1f} degrees (allowed: {LEAST_ANGLE_DEG:g} to {MOST_ANGLE_DEG:g})")
    filled = np.bincount((PHASES * (region.centre % 1)).astype(int) % PHASES, minlength=PHASES) / region.rows
    if filled.min() < PHASE_SHARE:
        raise _Refused("its rows do not meet all parts of a pixel alike: take a longer edge, or another angle")
    return region


def _shifts(region: Region) -> tuple[Array, Flags]:
    """Shift of each row against the mean curve, and which rows are no outliers."""
    sums = _binned(region)
    curve = _curve(sums)
    slope = np.gradient(curve, STEP_PX)
    shift = np.zeros(region.rows)
    row_shifts(region.frame, region.first, region.centre, region.half_px, region.cosine, STEP_PX, curve, slope, shift)
    middle = np.median(shift)
    deviation = np.abs(shift - middle)
    return shift, deviation <= 6 * max(float(np.median(deviation)) / 0.6745, 1e-3)


def _polynomial(t: Array, places: Array, most: int) -> tuple[Array, Array, int]:
    """Coefficients by rising powers, residuals, and the order: the lowest that no higher one beats (F test)."""
    from scipy.special import fdtrc

    powers = np.vander(t, most + 1, increasing=True)
    q, triangle = np.linalg.qr(powers)
    part = q.T @ places
    squares = float(((places - q @ part) ** 2).sum()) + np.append(np.cumsum(part[::-1] ** 2)[::-1], 0.0)[1:]  # left by order 0, 1, …
    order = 1
    for k in range(2, most + 1):
        dof = len(t) - k - 1
        ratio = (squares[order] - squares[k]) / (k - order) / max(squares[k] / max(dof, 1), 1e-300)
        if dof > 0 and fdtrc(k - order, dof, max(ratio, 0.0)) < F_LEVEL:
            order = k
    line = np.linalg.solve(triangle[: order + 1, : order + 1], part[: order + 1])
    return np.asarray(line, float), np.asarray(places - powers[:, : order + 1] @ line, float), order


# ---- edge spread and frequency response -----------------------------------------------------------------------------------------------


def _bins(half: float) -> int:
    return 2 * int(half / STEP_PX) + 1


def _binned(region: Region) -> Array:
    sums = np.zeros((4, _bins(region.half_px)))
    bin_edge(region.frame, region.first, region.centre, region.half_px, region.cosine, STEP_PX, sums)
    return sums


def _curve(sums: Array) -> Array:
    """The mean curve at the middles of the bins: bin means, moved there with the curve's own slope."""
    n = np.maximum(sums[0], 1)
    mean, away = sums[1] / n, sums[2] / n
    if (sums[0] == 0).any():
        at = np.arange(len(n))
        mean, away = np.interp(at, at[sums[0] > 0], mean[sums[0] > 0]), np.where(sums[0] > 0, away, 0.0)
    curve = mean
    for _ in range(2):
        curve = mean - away * np.gradient(curve, STEP_PX)
    return curve


@dataclass(frozen=True)
class Spread:
    """The finely sampled edge: values in DN at distances (px), with the variance of each, and its frequency response."""

    distance_px: Array
    value_dn: Array
    low_dn: float
    height: float  # of the step, with the sign it has along x or y
    noise_dn: float
    jacobian: np.ndarray  # shape (frequencies, bins), complex: response over values
    response: np.ndarray  # shape (frequencies,), complex
    variance_dn2: Array  # of the values
    neighbour_rel: float  # covariance of values four bins apart over their variance
    along_rel: float  # correlation of pixels that follow each other along the edge
    variances_dn2: tuple[float, float]  # of a pixel on either side

    @cached_property
    def modulus(self) -> Array:
        """e-SFR, less what noise adds to a modulus (in quadrature)."""
        square = np.abs(self.response) ** 2 - self.u_complex**2
        return np.asarray(np.sqrt(np.maximum(square, 0.0)), float)

    @cached_property
    def u_complex(self) -> Array:
        """Standard uncertainty of the complex response, of one part."""
        square = self.jacobian.real**2 + self.jacobian.imag**2
        return np.asarray(np.sqrt(0.5 * square @ self.variance_dn2), float)

    @cached_property
    def covariance(self) -> Array:
        """Of the modulus, shape (frequencies, frequencies)."""
        phase = np.where(np.abs(self.response) > 0, self.response / np.maximum(np.abs(self.response), 1e-12), 1.0)
        along = (self.jacobian * phase.conj()[:, None]).real  # the change along the response changes its modulus
        root = along * np.sqrt(self.variance_dn2)
        own = root @ root.T
        if self.neighbour_rel > 0:
            lag = int(round(1 / STEP_PX))
            cross = root[:, :-lag] @ root[:, lag:].T
            own = own + self.neighbour_rel * (cross + cross.T)
        return np.asarray(own, float)


def _spread_of(region: Region) -> Spread:
    sums = _binned(region)
    if (sums[0, 4:-4] < 1).any():
        raise _Refused("its rows do not meet all parts of a pixel alike: take a longer edge, or another angle")
    bins = sums.shape[1]
    curve, n = _curve(sums), np.maximum(sums[0], 1)
    distance = (np.arange(bins) - 0.5 * (bins - 1)) * STEP_PX
    tail = int(4 / STEP_PX)
    left, right = float(np.average(curve[:tail], weights=n[:tail])), float(np.average(curve[-tail:], weights=n[-tail:]))
    height = right - left
    variances, along, beside = _noise(region, curve)
    share = np.clip((curve - left) / height, 0, 1)
    variance = ((1 - share) * variances[0] + share * variances[1]) / n * (1 + 2 * max(along, 0.0))
    centre = float(np.interp(0.5, *_rising(share, distance)))
    reach = region.half_px - abs(centre) - 0.5
    middle = 0.5 * (distance[1:] + distance[:-1]) - centre
    window = _tukey(middle / reach)
    kernel = window * _waves(bins) * np.exp(2j * np.pi * FREQUENCY * centre)[:, None]
    steps = np.diff(curve)
    area = float((window * steps).sum())
    response = kernel @ steps / area
    by_step = (kernel - response[:, None] * window) / area
    jacobian = np.zeros((len(FREQUENCY), bins), complex)
    jacobian[:, 1:] += by_step
    jacobian[:, :-1] -= by_step
    noise = float(np.sqrt(0.5 * (variances[0] + variances[1])))
    return Spread(distance - centre, curve, left, height, noise, jacobian, response, variance, beside, along, variances)


@lru_cache(maxsize=32)
def _waves(bins: int) -> np.ndarray:
    """Waves at the middles between bins, shape (frequencies, bins − 1); corrected for the bin's width and the difference of neighbours."""
    between = (np.arange(bins - 1) - 0.5 * (bins - 2)) * STEP_PX
    waves: np.ndarray = np.exp(-2j * np.pi * FREQUENCY[:, None] * between) / np.sinc(FREQUENCY * STEP_PX)[:, None] ** 2
    return waves


def _rising(share: Array, distance: Array) -> tuple[Array, Array]:
    """The curve about its half, made monotone for inverse interpolation."""
    return np.maximum.accumulate(share), distance


def _tukey(place: Array) -> Array:
    """Tukey's window over (−1, 1)."""
    taper = np.clip((np.abs(place) - (1 - ALPHA)) / ALPHA, 0, 1)
    return np.asarray(0.5 * (1 + np.cos(np.pi * taper)), float)


def _noise(region: Region, curve: Array) -> tuple[tuple[float, float], float, float]:
    """Variance of the pixels on the low-column and high-column side (DN²), correlation of neighbours along and across the edge."""
    residual, distance = residuals_of(region, curve)
    sides = []
    for side in (distance < -3, distance > 3):
        own = residual[side & np.isfinite(residual)]
        sides.append(float((own * own).mean()) if own.size else 0.0)
    floor = 1 / 12 / 64
    far = np.where(np.abs(distance) > 3, residual, np.nan)
    along, beside = (_correlation(a, b) for a, b in ((far[1:], far[:-1]), (far[:, 1:], far[:, :-1])))
    return (max(sides[0], floor), max(sides[1], floor)), along, beside


def _correlation(a: Array, b: Array) -> float:
    """Correlation of neighbours; 0 where it is not significant."""
    both = np.isfinite(a) & np.isfinite(b)
    n = int(both.sum())
    if n < 30:
        return 0.0
    scale = float(np.sqrt((a[both] ** 2).mean() * (b[both] ** 2).mean()))
    r = float((a[both] * b[both]).mean()) / scale if scale > 0 else 0.0
    return r if abs(r) > 3 / np.sqrt(n) else 0.0


def pixels_of(region: Region, half_px: float | None = None) -> tuple[Array, Array]:
    """Values (DN) and distances along the normal (px) of the pixels about an edge, shape (rows, width) each; NaN outside of the frame."""
    half = region.half_px if half_px is None else half_px
    reach = int(np.floor(half / region.cosine))
    nearest = np.rint(region.centre).astype(int)
    col = nearest[:, None] + np.arange(-reach, reach + 1)
    row = np.arange(region.first, region.first + region.rows)[:, None]
    inside = (col >= 0) & (col < region.frame.shape[1])
    value = np.where(inside, region.frame[row, np.clip(col, 0, region.frame.shape[1] - 1)], np.nan).astype(float)
    return value, (col - region.centre[:, None]) * region.cosine


def residuals_of(region: Region, curve: Array) -> tuple[Array, Array]:
    """Pixels less the mean curve, and their distances."""
    value, distance = pixels_of(region)
    return value - _along(curve, distance), distance


def _along(curve: Array, distance: Array) -> Array:
    """The mean curve at distances; NaN beyond its ends."""
    at = (np.arange(len(curve)) - 0.5 * (len(curve) - 1)) * STEP_PX
    return np.asarray(np.interp(distance, at, curve, left=np.nan, right=np.nan), float)


def _check_light(region: Region, picture: Picture) -> None:
    """Refuse clipped sides, and sides whose light changes too much across or along the edge."""
    value, distance = pixels_of(region)
    known = np.isfinite(value)
    clipped = float(((value <= 0) | (value >= picture.top_dn))[known].mean())
    if clipped > CLIPPED_SHARE:
        raise _Refused(f"{100 * clipped:.0f} % of its pixels are clipped at an end of the scale")
    t = np.broadcast_to(np.linspace(-0.5, 0.5, region.rows)[:, None], value.shape)
    planes = []
    for side in (distance < -FLAT_FROM_PX, distance > FLAT_FROM_PX):
        at = side & known
        matrix = np.stack([np.ones(int(at.sum())), distance[at], t[at]], axis=1)
        inverse = np.linalg.inv(matrix.T @ matrix)  # there are LEAST_ROWS rows, and some pixels of each: it has full rank
        plane = inverse @ (matrix.T @ value[at])
        noise = float((value[at] - matrix @ plane).std(ddof=3))
        planes.append((float(value[at].mean()), plane, noise * np.sqrt(np.diag(inverse))))
    height = abs(planes[1][0] - planes[0][0])
    for _, plane, u in planes:
        across, u_across = ADJUSTED_PX * abs(float(plane[1])), ADJUSTED_PX * float(u[1])
        if across > UNEVEN_ACROSS * height + 4 * u_across:
            share = 100 * across / height
            raise _Refused(f"the light of a side changes by {share:.0f} % of the step over 10 px (at most {100 * UNEVEN_ACROSS:g} %)")
        if abs(plane[2]) > UNEVEN_ALONG * height + 4 * u[2]:
            raise _Refused(
                f"the light changes by {100 * abs(plane[2]) / height:.0f} % of the step along the edge (at most {100 * UNEVEN_ALONG:g} %)"
            )


# ---- results --------------------------------------------------------------------------------------------------------------------------


def _edge_of(region: Region, spread: Spread) -> SlantedEdge:
    middle_row, middle_col = region.first + 0.5 * (region.rows - 1), float(region.line[0])
    x, y = (middle_col, middle_row) if region.across == "x" else (middle_row, middle_col)
    modulus, covariance = spread.modulus, spread.covariance
    sfr50, u50 = frequency_of(0.5, modulus, covariance)
    skew, u_skew = _asymmetry(spread)
    rising = spread.height > 0
    low, high = sorted((spread.low_dn, spread.low_dn + spread.height))
    relative = (spread.value_dn - low) / (high - low)
    return SlantedEdge(
        picture=region.picture,
        across=region.across,
        x_px=x,
        y_px=y,
        angle_deg=float(np.degrees(np.arctan(region.slope))),
        u_angle_deg=float(np.degrees(region.u_slope * region.cosine**2)),
        order=len(region.line) - 1,
        rows=region.rows,
        half_px=region.half_px,
        low_dn=low,
        high_dn=high,
        rising=rising,
        noise_dn=spread.noise_dn,
        distance_px=spread.distance_px,
        spread_rel=relative,
        sfr=modulus,
        u_sfr=np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        sfr50=sfr50,
        u_sfr50=u50,
        asymmetry=skew,
        u_asymmetry=u_skew,
    )


def frequency_of(level: float, modulus: Array, covariance: Array) -> tuple[float, float]:
    """Where a response falls to a level the first time, by a straight line between two frequencies, and its u; NaN where it does not."""
    below = np.flatnonzero(modulus < level)
    if not len(below) or below[0] == 0:
        return float("nan"), float("nan")
    k = int(below[0])
    part = (modulus[k - 1] - level) / (modulus[k - 1] - modulus[k])
    step = FREQUENCY[k] - FREQUENCY[k - 1]
    low, high = max(k - 2, 0), min(k + 1, len(modulus) - 1)
    steep = (modulus[high] - modulus[low]) / (FREQUENCY[high] - FREQUENCY[low])
    weight = np.array([1 - part, part])
    variance = float(weight @ covariance[np.ix_([k - 1, k], [k - 1, k])] @ weight)
    return float(FREQUENCY[k - 1] + part * step), float(np.sqrt(max(variance, 0.0)) / abs(steep)) if steep else float("nan")


def _asymmetry(spread: Spread) -> tuple[float, float]:
    """Asymmetry of the line spread from three distances, with u from the noise there and the slope."""
    share = (spread.value_dn - spread.low_dn) / spread.height
    rising = np.maximum.accumulate(share)
    places, variances = [], []
    for level in (0.1, 0.5, 0.9):
        k = int(np.clip(np.searchsorted(rising, level), 4, len(share) - 4))
        about = slice(k - 4, k + 4)
        near = float(np.interp(level, rising[about], spread.distance_px[about]))
        powers = np.vander(spread.distance_px[about] - near, 4, increasing=True)
        inverse = np.linalg.pinv(powers)
        cubic = inverse @ share[about]
        places.append(near + (level - cubic[0]) / cubic[1])
        variances.append(float(inverse[0] ** 2 @ spread.variance_dn2[about]) / (spread.height * cubic[1]) ** 2)
    d10, d50, d90 = places
    width = d90 - d10
    skew = (d90 + d10 - 2 * d50) / width
    by = np.array([(1 + skew) / width, -2 / width, (1 - skew) / width])
    sampled = OF_SAMPLING[0] * np.exp(-OF_SAMPLING[1] * abs(width))
    return float(skew), float(np.sqrt(by**2 @ np.array(variances) + sampled**2))


def _mean_response(spreads: Sequence[Spread]) -> EdgeResponse | None:
    """Mean of the complex responses, weighted by their noise; the covariance is at least that of their scatter."""
    if not spreads:
        return None
    weight = np.array([(s.height / s.noise_dn) ** 2 for s in spreads])
    weight /= weight.sum()
    response = np.einsum("e,ef->f", weight, np.array([s.response for s in spreads]))
    noise = np.einsum("e,ef->f", weight**2, np.array([2 * s.u_complex**2 for s in spreads]))
    modulus = np.sqrt(np.maximum(np.abs(response) ** 2 - noise / 2, 0.0))
    covariance = np.einsum("e,efg->fg", weight**2, np.array([s.covariance for s in spreads]))
    if len(spreads) > 2:
        away = np.array([s.modulus for s in spreads]) - modulus
        expected = np.array([np.diag(s.covariance) for s in spreads])
        low = (FREQUENCY > 0.03) & (modulus > 0.2)
        if low.any():
            ratio = float((away[:, low] ** 2 / expected[:, low]).sum() / (low.sum() * (len(spreads) - 1)))
            covariance = covariance * max(ratio, 1.0)
    return EdgeResponse(np.asarray(modulus, float), np.asarray(covariance, float), len(spreads))


def _summary(edges: Iterable[SlantedEdge], responses: dict[str, EdgeResponse | None]) -> Estimates:
    rows = []
    for axis, response in responses.items():
        if response is None:
            continue
        own = [e for e in edges if e.across == axis]
        dof = float(max(sum(e.rows for e in own) - 4 * len(own), 1))
        value, u = frequency_of(0.5, response.sfr, response.covariance)
        if np.isfinite(value) and np.isfinite(u):
            rows.append((f"sfr50_{axis}", value, u, dof, "cycles/px"))
        value, u = frequency_of(0.1, response.sfr, response.covariance)
        if np.isfinite(value) and np.isfinite(u):  # over the limit of sampling; detail above it is aliased, and does not count
            rows.append((f"sampling_efficiency_{axis}", min(2 * value, 1.0), 2 * u, dof, "1"))
        weight = np.array([1 / max(e.u_asymmetry, 1e-9) ** 2 for e in own])
        skew = np.array([e.asymmetry for e in own])
        mean = float((weight * skew).sum() / weight.sum())
        ratio = float((weight * (skew - mean) ** 2).sum() / max(len(own) - 1, 1))
        rows.append((f"asymmetry_{axis}", mean, float(np.sqrt(max(ratio if len(own) > 2 else 1.0, 1.0) / weight.sum())), dof, "1"))
    return Estimates.from_rows(rows, method=FITTED)


def edge_notes(found: SlantedEdges | None) -> list[str]:
    """A note where pictures of edges hold none that can be measured."""
    if found is None or found.edges:
        return []
    if not found.refused:
        return ["no edge was found in the frames of edges: they need straight steps of brightness, 1.5 to 12 degrees off columns or rows"]
    longest = max(found.refused, key=lambda r: r.rows)
    return [f"none of {len(found.refused)} edges that were found can be measured; of the longest, {longest.reason}"]
