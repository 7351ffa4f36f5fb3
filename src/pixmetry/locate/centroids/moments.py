"""Where targets are by moments of their grey values, with covariance and S-curve: five laws, windows that follow each target."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles, thread_count
from pixmetry.locate._noise_kernels import Noise, variances_dn2
from pixmetry.locate.centroids import _moment_kernels as k
from pixmetry.locate.centroids import _window_kernels as w
from pixmetry.locate.detect.targets import Positions, Targets
from pixmetry.locate.estimator import Method, Settings
from pixmetry.locate.noise import NoiseModel

LAWS = {
    "centroid": k.CENTROID, "squared_centroid": k.SQUARED, "soft_threshold": k.SOFT, "hard_threshold": k.HARD,
    "windowed_centroid": k.WINDOWED,
}  # fmt: skip
MARGINS = {"centroid": 3.6, "squared_centroid": 3.0, "soft_threshold": 3.5, "hard_threshold": 3.5, "windowed_centroid": 4.0}
MULTIPLES = np.array([2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0])  # thresholds to choose from, in standard deviations of the background's noise
STEP_PX = 0.125
LARGEST_PX = 40.0


def moment_positions(frame: np.ndarray, targets: Targets, noise: NoiseModel, name: str, *, threads: int | None = None) -> Positions:
    """Locate targets by x̂ = Σ f(I) x / Σ f(I), or by the iterated Gaussian window, over an ellipse about each that follows its estimate.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
        Rough centres, sizes, blur, sign and background; the plane of the background is fitted again around each target.
    noise : NoiseModel
    name : str
        ``centroid`` f = I; ``squared_centroid`` f = I² less its mean noise; ``soft_threshold`` f = max(I − T, 0); ``hard_threshold``
        f = I where I > T; ``windowed_centroid`` Σ w(x − x̂) I (x − x̂) = 0 with a round Gaussian w, whose standard deviation is that of a
        Gaussian with the target's half-flux diameter. I is the grey value over the background, positive towards the target.
    threads : int, optional

    Returns
    -------
    Positions
        ``more`` has amplitude_dn, background_dn, semi_major_px, semi_minor_px, angle_deg, blur_px, s_curve_px, threshold_dn (NaN without
        one). NOT_CONVERGED is flagged where no light is left or the estimate runs away; x and y are then NaN.

    Raises
    ------
    InputError
        If there is no such law.

    Notes
    -----
    The variance is Σ f'² σ² (x − x̂)² / (Σ f)² with each pixel's variance at its own grey value, and for thresholds what the noise of a
    rectified value differs from that first order. The plane of the background adds its own. The variance over the sub-pixel phase
    is computed for classes of targets of like size, blur and contrast (`best_thresholds` in the kernels), as the largest near that size;
    thresholds are chosen where both together are least. It is that of round discs on pixels that are sensitive on their whole square: on
    smaller apertures errors over the phase are several times as large as stated.

    References
    ----------
    M. R. Shortis, T. A. Clarke, T. Short, Proc. SPIE 2350, 239 (1994), compare these laws. H. C. van Assen, M. Egmont-Petersen,
    J. H. C. Reiber, IEEE Trans. Image Processing 11(12), 1379 (2002), for the variance. E. Bertin, S. Arnouts, A&AS 117, 393 (1996), and
    the manual of SExtractor (XWIN_IMAGE) for the windowed centroid.
    """
    if name not in LAWS:
        raise InputError("no such law of moments", value=name, allowed=", ".join(LAWS))
    law, n = LAWS[name], len(targets)
    work = prepare(frame, targets, noise, margin=MARGINS[name], threads=threads)
    multiple, phase, excess = choose_thresholds(work, law, threads)
    whole = frame.dtype.kind in "ui" and law in (k.SOFT, k.HARD)
    w.set_thresholds(work.record, 0, n, multiple, excess, whole, work.noise)
    result, at_rest = np.full((n, 6), np.nan), np.zeros(n, bool)
    work.over(lambda a, b: k.moments(frame, work.record, a, b, law, work.noise, result, at_rest), threads)
    return positions(work, targets, noise, result, at_rest, np.sqrt(phase), law in (k.SOFT, k.HARD))


class Prepared:
    """The input of the kernels for each target, and the common input."""

    def __init__(self, record: np.ndarray, noise: Noise, flags: np.ndarray, disc: np.ndarray) -> None:
        self.record, self.noise, self.flags = record, noise, flags
        self.radius, self.blur, self.usable = np.ascontiguousarray(disc.T)

    @property
    def amplitude(self) -> np.ndarray:
        """Height over the background, DN, above 0."""
        return self.record[:, k.AMPLITUDE]

    def over(self, function: Callable[[int, int], None], threads: int | None) -> None:
        """Call ``function(first, stop)`` for slices of the targets."""
        run_slices(function, len(self.record), threads)


def run_slices(function: Callable[[int, int], None], n: int, threads: int | None) -> None:
    """Call ``function(first, stop)`` for slices that cover 0 … n, on threads."""
    pieces = max(1, min(n // 16, 2 * (thread_count() if threads is None else threads)))
    ends = np.linspace(0, n, pieces + 1).astype(int)
    map_tiles(lambda span: function(int(span[0]), int(span[1])), list(zip(ends[:-1], ends[1:], strict=True)), threads)


def prepare(
    frame: np.ndarray, targets: Targets, noise: NoiseModel, *, margin: float, rim_px: float = 0.0, threads: int | None = None
) -> Prepared:
    """Lay out windows, and fit the background around each target; ``margin`` of the window in standard deviations of the edge.

    ``rim_px``: how far inside the frame's border windows end.
    """
    from pixmetry.locate.detect.detection import neighbours

    n = len(targets)
    record, disc, flags = np.zeros((n, k.COLUMNS)), np.zeros((n, 3)), targets.flags.astype(np.uint32)
    w.lay_out(sizes_of(targets), margin, _shapes(), record, disc)
    start, index = neighbours(targets, 2 * record[:, k.OUTER], record[:, k.REACH])  # lights that touch the ring, and windows that meet
    w.limit_windows(record, start, index, frame.shape[0], frame.shape[1], rim_px, flags)
    work = Prepared(record, noise.numbers(), flags, disc)
    work.over(lambda a, b: k.fit_grounds(frame, record, a, b, start, index, work.noise), threads)
    return work


def sizes_of(targets: Targets) -> np.ndarray:
    """Sizes of targets as the kernels read them, shape (n, SIZES)."""
    t = targets
    columns = (t.x_px, t.y_px, t.semi_major_px, t.semi_minor_px, t.angle_deg, t.blur_px, t.amplitude_dn, t.background_dn)
    return np.stack([*columns, t.background_x_dn_per_px, t.background_y_dn_per_px], axis=1).astype(float)


def positions(
    work: Prepared,
    targets: Targets,
    noise: NoiseModel,
    result: np.ndarray,
    at_rest: np.ndarray,
    s_curve_px: np.ndarray,
    thresholded: bool = False,
) -> Positions:
    """Combine the results of the kernels; ``result``: x, y, var x, cov, var y, relative standard deviation of the weights' sum."""
    record, flags = work.record, work.flags.copy()
    w.conclude(result, at_rest, work.usable, s_curve_px, row_shift_variance(targets, noise), flags)
    more = {
        "amplitude_dn": targets.amplitude_dn, "background_dn": record[:, k.LEVEL].copy(), "semi_major_px": targets.semi_major_px,
        "semi_minor_px": targets.semi_minor_px, "angle_deg": targets.angle_deg, "blur_px": targets.blur_px, "s_curve_px": s_curve_px,
        "threshold_dn": record[:, k.THRESHOLD].copy() if thresholded else np.full(len(record), np.nan),
    }  # fmt: skip
    return Positions(
        x_px=result[:, 0], y_px=result[:, 1], var_x_px2=result[:, 2], cov_xy_px2=result[:, 3], var_y_px2=result[:, 4], flags=flags,
        more=more,
    )  # fmt: skip


def row_shift_variance(targets: Targets, noise: NoiseModel) -> np.ndarray:
    """Variance of x from rows that are shifted against each other, px², shape (n,).

    An operator answers to the shift of a row by the row's share of what it looks at: of the target's area, of its edges' steepness along x,
    or of its perimeter's. All three go with the length of the row inside the target.
    """
    if not (noise.row_shift_px or noise.field_shift_px):
        return np.zeros(len(targets))
    from pixmetry.locate.template._template_kernels import ALIKE

    turn = np.deg2rad(targets.angle_deg)
    height = np.hypot(targets.semi_major_px * np.sin(turn), targets.semi_minor_px * np.cos(turn))
    height = np.nan_to_num(np.maximum(np.hypot(height, targets.blur_px), 1.0), nan=1.0)
    size, of = np.unique(np.round(8 * np.log(height)).astype(int), return_inverse=True)
    variance = np.empty(len(size))
    for i, h in enumerate(np.exp(size / 8)):
        row = np.arange(-math.ceil(h), math.ceil(h) + 1)
        share = np.sqrt(np.maximum(1 - (row / h) ** 2, 0.0))
        share /= share.sum()
        alike = share.copy()  # K · share: within a field, falling off from line to line to both sides
        for shares, out in ((share, alike), (share[::-1], alike[::-1])):
            before = np.zeros(2)
            for j, own in enumerate(shares):
                out[j] += before[j % 2]
                before[j % 2] = ALIKE * (before[j % 2] + own)
        variance[i] = noise.row_shift_px**2 * (share @ share) + noise.field_shift_px**2 * (share @ alike)
    return variance[of]


def classes(radius: np.ndarray, blur: np.ndarray, contrast: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort targets into classes of like radius (15 %), blur (20 %) and contrast (50 %); return the class of each and one of each."""
    cell = np.zeros(len(radius), np.int64)
    for values, ratio in ((radius, 1.15), (blur, 1.2), (contrast, 1.5)):
        cell = cell * 512 + np.floor(np.log(np.maximum(values, 1e-6)) / math.log(ratio)).astype(np.int64)
    _, one, of = np.unique(cell, return_index=True, return_inverse=True)
    return of, one


def class_means(of: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Return the mean of each column over each class, shape (classes, columns)."""
    count = np.bincount(of)
    return np.stack([np.bincount(of, weights=c) / count for c in columns], axis=1)


def choose_thresholds(work: Prepared, law: int, threads: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each target the threshold in standard deviations of the background's noise, the variance over the sub-pixel phase in px², and the
    excess of the threshold's noise; arrays of shape (n,)."""
    record, n = work.record, len(work.record)
    if n == 0:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    if law == k.CENTROID:
        return np.zeros(n), _centroid_phase_variance(work.radius, work.blur), np.zeros(n)
    deviation = np.sqrt(np.maximum(variances_dn2(record[:, k.LEVEL] - work.noise.black_dn, work.noise), 1e-12))
    of, _ = classes(work.radius, work.blur, work.amplitude / deviation)
    radius = np.minimum(work.radius, LARGEST_PX - 12)
    window = np.sqrt(record[:, k.MAJOR] * record[:, k.MINOR]) + record[:, k.MARGIN] - (work.radius - radius)
    shape = class_means(of, radius, work.blur, work.amplitude, record[:, k.SIGN], record[:, k.LEVEL], window, record[:, k.SPREAD])
    shape[:, 3] = np.sign(shape[:, 3])
    out = np.zeros((len(shape), 3))
    multiples = MULTIPLES if law in (k.SOFT, k.HARD) else np.zeros(1)
    tables = _tables()
    run_slices(lambda a, b: k.best_thresholds(shape, a, b, law, multiples, work.noise, tables, out), len(shape), threads)
    multiple, phase, excess = out[of].T.copy()
    return multiple, phase, excess


def _centroid_phase_variance(radius: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Plain centroid: a square pixel's transfer function is zero at 1, 2, … cycles a pixel, but its slope is not: a_k = |H(k)|/(πk).

    H is what disc and blur without the pixel let pass, the disc's 2 J1(z)/z taken at the envelope of its swings.
    """
    optical = np.maximum(blur**2 - 1 / 12, 0.0)
    total = np.zeros(len(radius))
    for order in (1, 2, 3):
        z = 2 * math.pi * order * radius
        disc = np.minimum(1.0, 2 * np.sqrt(2 / (math.pi * z)) / z)
        # the mean over the swings with the radius is half of the envelope
        total += 0.25 * (disc * np.exp(-2 * math.pi**2 * order**2 * optical) / (math.pi * order)) ** 2
    return total


@lru_cache(1)
def _tables() -> k.Tables:
    """Quadrature nodes, step, the lattice's frequencies by distance with their number, and J2, Y2 between the steps."""
    from scipy.special import jv, yn

    nodes, weights = np.polynomial.legendre.leggauss(12)
    grid = np.arange(-4, 5)
    squares, many = np.unique(np.add.outer(grid**2, grid**2), return_counts=True)
    keep = (squares > 0) & (squares <= 16)
    shells, count = np.sqrt(squares[keep]), many[keep].astype(float)
    z = 2 * math.pi * shells[:, None] * (np.arange(int(LARGEST_PX / STEP_PX)) + 1) * STEP_PX
    return k.Tables(nodes, weights, STEP_PX, shells, count, jv(2, z), yn(2, z))


def equivalent_disc(half_height_px: np.ndarray, blur_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return radius and blur of the blurred disc whose contour at half its height has this radius, and the spread of its Gaussian window.

    That is the standard deviation of the Gaussian with the same half-flux diameter. Where the contour is narrower than that of the blur
    alone, the disc is a point and the blur follows from the contour.
    """
    half, blur = np.broadcast_arrays(np.asarray(half_height_px, float), np.asarray(blur_px, float))
    radius, width, spread = w.discs_of(half, blur, _shapes())
    return radius, width, spread


def half_height_radius(radius_px: np.ndarray | float, blur_px: np.ndarray | float) -> np.ndarray:
    """Return the radius of the contour at half height of a disc that is blurred by a Gaussian: the inverse of `equivalent_disc`."""
    ratio, contour, _ = _shapes()
    asked = np.asarray(radius_px, float) / blur_px
    return np.where(asked <= ratio[-1], np.interp(asked, ratio, contour), asked) * blur_px


@lru_cache(1)
def _shapes() -> w.Shapes:
    """For R/s of a blurred disc: radius at half height over s, and half-flux radius over s and √(2 ln 2)."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    ratio = np.geomspace(0.05, 30.0, 48)
    contour, window = np.empty(48), np.empty(48)
    for i, radius in enumerate(ratio):
        step = (radius + 7.0) / 1500
        profile = np.empty(1500)
        k.disc_profile(radius, 1.0, nodes, weights, step, profile)
        r = (np.arange(1500) + 0.5) * step
        contour[i] = np.interp(-0.5 * profile[0], -profile, r)
        flux = np.cumsum(profile * r)
        window[i] = np.interp(0.5 * flux[-1], flux, r + step / 2)
    return w.Shapes(ratio, contour, window / math.sqrt(2 * math.log(2)))


def reach_px(radius_px: float, edge_px: float) -> float:
    """How far beyond a disc's radius the plane of the background is fitted; ``edge_px``: standard deviation of the edge."""
    return max(4 * edge_px, 1.0) + 5 + 0.5 * radius_px


def _measure(name: str, frame: np.ndarray, targets: Targets, noise: NoiseModel, how: Settings) -> Positions:
    return moment_positions(frame, targets, noise, name, threads=how.threads)


METHODS = tuple(
    Method(name, text, partial(_measure, name), reach_px)
    for name, text in {
        "soft_threshold": "centroid of the part above a threshold; fast, and nearly as good with white noise",
        "squared_centroid": "centroid of squared grey values; good for small targets with read noise",
        "centroid": "centroid of grey values above the background; best for small targets with shot noise",
        "hard_threshold": "centroid of grey values where they exceed a threshold; depends on the sub-pixel phase",
        "windowed_centroid": "centroid with a Gaussian window that follows the target",
    }.items()
)
