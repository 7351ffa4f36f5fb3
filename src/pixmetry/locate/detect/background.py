"""What a frame looks like without its targets: a smooth map of the background, and how noisy it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from pixmetry.core.threads import map_tiles, thread_count

TILE_PX = 32
GROUP = 4  # most tiles a side of a group, whose median the smooth surface goes through
DEGREE = 4  # of the smooth surface
JUMP = 5.0  # standard deviations of the noise, from one tile to the next, at which a target begins
BEND = 3.0  # times the usual change of slope from tile to tile, that is no jump either
SPREAD = 2.5  # times the usual spread: more is a tile with an edge in it
STEEPEST = 0.65  # least noise of a tile over its noisiest neighbour's: from 0.63 on the bilinear continuation stays above 0
GROUND_SHARE = {"": 0.5, "dark": 0.1, "bright": 0.9}  # of the pixels of a tile, in order, in the middle of which its ground is
KEPT_OF_COVERED = 0.08  # as KEPT_SHARE, of a frame that targets cover
FEW_TILES = 25  # of a frame that one target may cover
CLIMBED = 2.0  # spread over the noise from which a mean has grey of edges in it
DOUBTFUL_SHARE = 0.65  # of the pixels of most tiles, at the background's level, below which it may be another's
DOUBTFUL_SPREAD = 2.0  # of the background, over the differences of neighbours
DOUBTFUL_STEP = 20.0  # standard deviations of the noise from one tile to the next
KEPT_SHARE = 0.3  # of a tile's pixels, at least, that its mean is from
FLOAT_GRAIN = 1e-4  # of the frame's range: what a float frame resolves, for the purpose of detection
FEW = 0.02  # share of lone pixels that are lit below which it is asked whether they are all over the frame


@dataclass(frozen=True)
class Background:
    """Grey value and noise of the background at the middles of the tiles of a grid over the frame; straight lines in between.

    Parameters
    ----------
    level_dn : ndarray, shape (rows, cols), float64
        Where the scale cuts the background off, the level before that.
    sigma_dn : ndarray, shape (rows, cols), float64
        Standard deviation of the noise, rounding included.
    shape : tuple of int
        Rows and columns of the frame.
    doubtful : bool
        Whether so little of the frame is at this level that it may be the targets' or one in between.
    """

    level_dn: np.ndarray
    sigma_dn: np.ndarray
    shape: tuple[int, int]
    doubtful: bool = False

    @property
    def scales(self) -> tuple[float, float]:
        """Tiles per pixel along y and x."""
        return self.level_dn.shape[0] / self.shape[0], self.level_dn.shape[1] / self.shape[1]

    def at(self, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the level in DN and its slopes along x and y in DN per pixel, at given places; arrays of shape (n,)."""
        return self._map(self.level_dn, x_px, y_px)

    def sigma(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the noise in DN at given places; shape (n,)."""
        return self._map(self.sigma_dn, x_px, y_px)[0]

    @property
    def tame_sigma_dn(self) -> np.ndarray:
        """The noise, without steps so steep that it would fall below 0 where it is continued to the frame's border."""
        from scipy.ndimage import maximum_filter

        tame: np.ndarray = np.maximum(self.sigma_dn, STEEPEST * maximum_filter(self.sigma_dn, 3))
        return tame

    def bend(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        """Return how far straight lines between tiles may be from a curved background, in DN, at given places; shape (n,).

        A parabola is an eighth of its second difference from its chord; twice that, and the greatest nearby.
        """
        from scipy.ndimage import maximum_filter

        second = np.zeros_like(self.level_dn)
        for axis in (0, 1):
            if self.level_dn.shape[axis] > 2:
                inside = [slice(None), slice(None)]
                inside[axis] = slice(1, -1)
                second[tuple(inside)] += np.abs(np.diff(self.level_dn, 2, axis=axis))
        return self._map(maximum_filter(second, 3) / 4, x_px, y_px)[0]

    def image(self) -> np.ndarray:
        """Return the level at every pixel, shape of the frame, float64."""
        y, x = np.indices(self.shape, float)
        return self.at(x.ravel(), y.ravel())[0].reshape(self.shape)

    def _map(self, nodes: np.ndarray, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        from pixmetry.locate.detect._background_kernels import Map, map_values

        x, y = (np.atleast_1d(np.asarray(a, float)) for a in (x_px, y_px))
        value, slope_x, slope_y = map_values(Map(nodes, *self.scales), x, y)
        return value, slope_x, slope_y


def background(
    frame: np.ndarray, *, low_dn: float = -math.inf, high_dn: float = math.inf, ground: str = "", threads: int | None = None
) -> Background:
    """Map the background of a frame of which less than half is targets, or, where it is known on which side, less than 0.75.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
        Finite and C-contiguous.
    low_dn, high_dn : float
        Grey values at which the scale ends; never beyond the range of an integer type.
    ground : {"", "dark", "bright"}
        What the background is: what most pixels of a tile are, the dark parts, or the bright parts.
    threads : int, optional

    Notes
    -----
    Tiles are about 32 pixels a side. A clipped mean starts from a tile's median; clipping is about a plane with the slopes of a smooth
    surface through all tiles, so that neither targets nor slopes shift it. Tiles that a target fills are told by the jump at its edge
    (JUMP standard deviations or more from all neighbours that are background, also from these continued straight on) and are filled in
    from around it. The noise is all that is left about the plane: noise of every correlation length, and rounding.

    Where the background is the dark (the bright) parts, the quantile 0.1 (0.9) takes the place of the median, and the surface goes
    through the least (the greatest) of 3 × 3 tiles.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    from pixmetry.locate.detect._background_kernels import settle, tile_levels, tile_moments

    low, high, grain = scale_of(frame, low_dn, high_dn)
    edge_row, edge_col = (np.linspace(0, side, max(1, round(side / TILE_PX)) + 1).round().astype(np.int64) for side in frame.shape)
    bands = bands_of(len(edge_row) - 1, threads)
    share_of = GROUND_SHARE[ground]
    median, noise, end, lone, lit, light = _in_bands(
        tile_levels, bands, threads, frame, edge_row, edge_col, low, high, np.float32(grain / 4), share_of
    )
    floor = grain / math.sqrt(12)
    for side, at in ((-1, low), (1, high)):
        cut = end == side
        if cut.any():
            away, sigma = before_clipping(lone[cut], lit[cut], light[cut], grain / 2 if frame.dtype.kind == "u" else 0.0)
            median[cut], noise[cut] = at - side * away, sigma
    noise = np.maximum(noise, floor)
    typical = float(np.median(noise))
    around: np.ndarray = median if not ground else minimum_filter(median, 3) if ground == "dark" else maximum_filter(median, 3)
    rough = _surface(around, typical, DEGREE)
    offset = median - rough
    bend = _bend(around)
    settle(offset, noise < SPREAD * typical, JUMP * typical + BEND * bend)
    slopes = _slopes(rough + offset, frame.shape)
    near = noise / 2 if ground else noise  # the grey of edges lies on one side of such ground: less of it gets in
    level, spread, share = _in_bands(tile_moments, bands, threads, frame, edge_row, edge_col, median, *slopes, near)
    calm = spread
    if ground:  # and where a mean climbs it nevertheless, the quantile is nearer
        climbed = spread > CLIMBED * noise
        level, calm = np.where(climbed, median, level), np.where(climbed, CLIMBED * noise, spread)
    cut = end != 0
    level[cut], spread[cut], share[cut] = median[cut], noise[cut], 1.0
    usual = float(np.median(spread))
    plausible = (spread < SPREAD * usual + bend / 4) & (share > (KEPT_OF_COVERED if ground else KEPT_SHARE))
    offset = level - rough
    settle(offset, plausible, JUMP * usual + BEND * bend)
    doubtful = float(np.median(share)) < DOUBTFUL_SHARE or usual > DOUBTFUL_SPREAD * typical
    doubtful = doubtful or level.size <= FEW_TILES or _steepest(rough + offset) > DOUBTFUL_STEP * usual
    calmest = float(np.median(calm))
    noise = _noise(np.where(plausible, calm, calmest), calmest, floor, cut)
    return Background(rough + offset, noise, frame.shape, doubtful)


def scale_of(frame: np.ndarray, low_dn: float, high_dn: float) -> tuple[float, float, float]:
    """Return the ends of a frame's scale, as far as they are known, and its grain in DN."""
    if frame.dtype.kind == "u":
        return max(low_dn, 0.0), min(high_dn, float(np.iinfo(frame.dtype).max)), 1.0
    return low_dn, high_dn, FLOAT_GRAIN * float(np.ptp(frame))


def bands_of(rows: int, threads: int | None) -> list[tuple[int, int]]:
    """Split rows into bands: two a thread."""
    edges = np.linspace(0, rows, min(rows, 2 * (threads or thread_count())) + 1).round().astype(int).tolist()
    return list(zip(edges[:-1], edges[1:], strict=True))


def before_clipping(lone: np.ndarray, lit: np.ndarray, light: np.ndarray, least: float) -> tuple[float, float]:
    """Return level and noise, before clipping, of a background that lies mostly at an end of the scale; the level counts from the end.

    Parameters
    ----------
    lone, lit, light : ndarray, shape (tiles,)
        Of pixels whose four neighbours are at the end: how many, how many that are not, and the sum of the distances of these from it.
    least : float
        Distance from the end above which a value is stored as not at the end: half a DN of rounded values, 0 of others.

    Notes
    -----
    Of a normal distribution cut off at ``least``, the share that is left f and its mean m give z = Φ⁻¹(1 − f),
    σ = (m − least)/(φ(z)/f − z) and µ = least − σz (A. C. Cohen, Ann. Math. Stat. 21(4), 557 (1950), for the estimator by moments).
    A few lit pixels are noise only if they are all over the frame; else they are defects, and the noise is unknown: 0.
    """
    f = float(lit.sum() / max(lone.sum(), 1))
    if f < FEW:
        f = float(np.quantile(lit / np.maximum(lone, 1), 0.75))
    if f <= 0:
        return 0.0, 0.0
    mean = float(np.median(light[lit > 0] / lit[lit > 0]))
    normal = NormalDist()
    z = normal.inv_cdf(min(max(1 - f, 1e-6), 1 - 1e-6))
    sigma = max(mean - least, 0.0) / (normal.pdf(z) / f - z)
    return least - sigma * z, sigma


def _in_bands(
    kernel: Callable[..., np.ndarray],
    bands: list[tuple[int, int]],
    threads: int | None,
    frame: np.ndarray,
    rows: Any,
    cols: Any,
    *more: Any,
) -> np.ndarray:
    return np.concatenate(map_tiles(lambda band: kernel(frame, rows, cols, *band, *more), bands, threads), axis=1)


def _steepest(level: np.ndarray) -> float:
    """Return the greatest difference from tile to tile, along x and y."""
    return max((float(np.abs(np.diff(level, axis=k)).max()) for k in (0, 1) if level.shape[k] > 1), default=0.0)


def _bend(level: np.ndarray) -> float:
    """Return the median of the second differences from tile to tile, along x and y."""
    seconds = [np.abs(np.diff(level, 2, axis=k)).ravel() for k in (0, 1)]
    return float(np.median(np.concatenate(seconds))) if max(level.shape) > 2 else 0.0


def _slopes(level: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the slopes along x and y of a map, in DN per pixel."""
    return [np.gradient(level, axis=k) * level.shape[k] / shape[k] if level.shape[k] > 1 else np.zeros_like(level) for k in (1, 0)]


def _noise(spread: np.ndarray, usual: float, floor: float, cut: np.ndarray) -> np.ndarray:
    """Smooth the map of the noise; it is not smooth where the scale cuts off a part of the frame."""
    if not cut.any():
        spread = np.clip(_surface(spread, 0.1 * usual, 2, bendy=True), 0.5 * usual, 2 * usual)
    smooth: np.ndarray = np.maximum(spread, floor)
    return smooth


def _surface(level: np.ndarray, noise: float, degree: int, bendy: bool = False) -> np.ndarray:
    """Return a smooth surface through most of the tiles: a polynomial fitted to medians of groups of tiles, outliers without weight.

    Along each axis its degree is at most a fifth of the groups; 2 from six groups on if it is ``bendy``.

    Weights are those of least absolute values first, then Tukey's biweight (P. J. Huber, Robust Statistics, Wiley 1981).
    """
    from pixmetry.locate.detect._background_kernels import group_medians

    side = int(np.clip(max(level.shape) // 8, 1, GROUP))
    z = group_medians(level, side)
    powers = [np.linspace(-1, 1, n)[:, None] ** np.arange(degree + 1) if n > 1 else np.ones((1, degree + 1)) for n in level.shape]
    grouped = [np.add.reduceat(p, np.arange(0, len(p), side)) / np.diff([*range(0, len(p), side), len(p)])[:, None] for p in powers]
    most = [max((n - 1) // 5, 2 if bendy and n > 5 else int(n > 2)) for n in z.shape]
    terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i <= most[0] and j <= most[1]]
    design = np.stack([np.outer(grouped[0][:, i], grouped[1][:, j]).ravel() for i, j in terms], axis=1)
    fit = _robust_fit(design, z.ravel(), noise)
    table = np.zeros((degree + 1, degree + 1))
    for value, (i, j) in zip(fit, terms, strict=True):
        table[i, j] = value
    return powers[0] @ table @ powers[1].T


def _robust_fit(design: np.ndarray, z: np.ndarray, noise: float) -> np.ndarray:
    least = max(noise, 1e-6 * float(np.abs(z).max()), 1e-30)
    residual = np.abs(z - np.median(z))
    fit = np.zeros(design.shape[1])
    for step in range(12):
        if step < 6:
            weight = 1 / np.maximum(residual, least)
        else:
            scale = max(1.5 * float(np.median(residual)), least)
            weight = np.maximum(1 - (residual / (5 * scale)) ** 2, 1e-6) ** 2
        weighted = design.T * weight
        normal = weighted @ design
        fit = np.linalg.solve(normal + 1e-9 * np.trace(normal) / len(fit) * np.eye(len(fit)), weighted @ z)
        residual = np.abs(z - design @ fit)
    return fit
