"""The noise of a frame from the frame itself: what is left of it where fitted templates are flat."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.background import scale_of
from pixmetry.locate.detect.targets import Targets
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel
from pixmetry.locate.template._template_kernels import ALIKE, residuals
from pixmetry.locate.template.template_fit import Fitted, Windows, run_fit, with_second_start

PIECES = 4  # of the work
LEAST_SLOPED_PX = 2.0
MOST_TARGETS = 64
EDGE_PX = 0.05  # misplacement of an edge that a template may have: where it would matter, a pixel says nothing about noise
LEVELS = 32
PASSES = 4  # each with better weights, and a better idea of which pixels are flat
SETTLED, AT_ONCE = 1.2, 1.1  # ratio of variances from which another pass is made; and after the first pass, which changes most
LEAST_PIXELS = 4
MANY_PIXELS = 30  # of a level, whose variance says whether a straight line holds
CLEAR_SIGMA = 4.0  # by which the variance must rise with the level for the slope to be certain (3e-5 by chance)
VAGUE = 0.08  # relative standard error of the variance at a target's top from which a slope counts that is not certain
FEW = 0.3  # the same from which steep pixels have to help
VAGUEST = 0.4  # the same from which edges that are not as the template has them cannot be told from noise
OUTLIER_SIGMA = 4.0
KEPT = 0.998872  # variance that a normal distribution keeps when values beyond 4 standard deviations are left out
SHIFTED_SIGMA = 4.5  # by which the scores of rows must vary more than noise for rows to be shifted
ROWS_ALONE = 0.5  # of the shifts of rows, above which those of columns say that there is no jitter
SHIFT_LIMIT = 5.0  # scores farther out than so many times the usual are left out


def noise_from_image(
    frame: np.ndarray,
    targets: Targets,
    kind: str = "disc",
    *,
    low_dn: float = -math.inf,
    high_dn: float = math.inf,
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> NoiseModel:
    """Measure variance against grey level from the residuals of a first fit.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
        All there are, for what belongs to a neighbour is left out; at most 64 of them, spread over
        the list, are fitted.
    kind : {"disc", "ellipse", "ring", "spot"}
    low_dn, high_dn : float
        Ends of the scale, where they are known.
    aperture_px : float
    threads : int, optional

    Returns
    -------
    NoiseModel
        Of origin "image". The slope is 0 unless it stands 4 standard deviations clear. Rounding is part of the measured variance, which
        is not below 1/12 DN² for integer frames. The scale ends where it was said to, at the latest where an integer type does.

    Raises
    ------
    MeasureError
        If there is no target to measure at.

    Notes
    -----
    The variance is a straight line in the level, fitted to squared residuals by maximum likelihood. A squared residual is divided by
    1 minus its leverage J (JᵀWJ)⁻¹Jᵀ W; values beyond 4 standard deviations are left out. Only pixels where the template is so flat that an
    edge misplaced by 0.05 px shifts them by less than half the noise are used, so that a blur or shape that the template does not have is
    not taken for noise. Where these are so few that the variance of the targets' own light would be uncertain by more than 0.3 (one
    disc or two), the steep ones count as well, with a term in proportion to the square of the slope for edges that are not as the template
    has them; where even this leaves it uncertain by 0.4, all that is left is taken for noise, whatever it is from.
    """
    if not len(targets):
        raise MeasureError("no target from which the noise could be estimated", where="noise_from_image", remedy="give a noise model")
    which = _some(targets)
    part = targets[which]
    whole = frame.dtype.kind == "u"
    least = ROUNDING_DN2 if whole else (1e-6 * float(np.median(np.abs(part.amplitude_dn)))) ** 2 + 1e-12
    first = max(float(np.median(part.sigma_dn)) ** 2, least)
    low, high, _ = scale_of(frame, low_dn, high_dn)
    guess = NoiseModel(first, low_dn=low, high_dn=high, origin="image")
    windows = Windows.of(frame, targets, guess, kind, aperture_px, True, False)
    start = None
    for step in range(PASSES):
        fits = _fits(windows, targets, which, guess, kind, threads, start)
        left = _leftovers(windows, fits, guess, threads, rows=False)
        before, guess, start = guess, _fitted(left, guess, least), fits.start
        if _alike(before, guess, left.level, SETTLED if step else AT_ONCE):
            return _with_row_shifts(guess, windows, targets, which, kind, threads, fits)
    return _with_row_shifts(guess, windows, targets, which, kind, threads, _fits(windows, targets, which, guess, kind, threads, start))


def row_shifts_from_image(
    frame: np.ndarray, targets: Targets, noise: NoiseModel, kind: str = "disc", *, aperture_px: float = 1.0, threads: int | None = None
) -> NoiseModel:
    """Return a noise model that is known with the shifts of rows against each other that the frame shows; arguments as above."""
    which = _some(targets)
    windows = Windows.of(frame, targets, noise, kind, aperture_px, True, False)
    return _with_row_shifts(noise, windows, targets, which, kind, threads, _fits(windows, targets, which, noise, kind, threads, None))


def _some(targets: Targets) -> np.ndarray:
    """At most 64 of the targets, spread over the list."""
    return np.unique(np.linspace(0, len(targets) - 1, min(len(targets), MOST_TARGETS)).round().astype(int))


def _with_row_shifts(
    noise: NoiseModel,
    windows: Windows,
    targets: Targets,
    which: np.ndarray,
    kind: str,
    threads: int | None,
    fits: _Fits,
) -> NoiseModel:
    """The noise with what rows are shifted against each other; where columns are so as well, it is the shape that does not fit."""
    rows = row_shifts(_leftovers(windows, fits, noise, threads, rows=True))
    if not any(rows):
        return noise
    turned = transposed(targets)
    frame = np.ascontiguousarray(windows.frame.T)
    aside = Windows.of(frame, turned, noise, kind, windows.aperture_px, True, False)
    fits = _fits(aside, turned, which, noise, kind, threads, None)
    columns = row_shifts(_leftovers(aside, fits, noise, threads, rows=True))
    if math.hypot(*columns) > ROWS_ALONE * math.hypot(*rows):
        return noise
    return replace(noise, row_shift_px=rows[0], field_shift_px=rows[1])


def transposed(targets: Targets) -> Targets:
    """The same targets in the frame with rows and columns exchanged."""
    angle = 90.0 - targets.angle_deg
    return replace(
        targets,
        x_px=targets.y_px,
        y_px=targets.x_px,
        angle_deg=np.where(angle > 90.0, angle - 180.0, angle),
        background_x_dn_per_px=targets.background_y_dn_per_px,
        background_y_dn_per_px=targets.background_x_dn_per_px,
        row_first=targets.col_first,
        row_stop=targets.col_stop,
        col_first=targets.row_first,
        col_stop=targets.row_stop,
    )


def _alike(one: NoiseModel, other: NoiseModel, level: np.ndarray, most: float) -> bool:
    """Whether two models say nearly the same, up to a ratio, at the ends of the levels that there are."""
    if not len(level):
        return True
    ends = np.array([level.min(), level.max()])
    ratio = one.variance_dn2(ends) / other.variance_dn2(ends)
    return bool((ratio < most).all() and (ratio > 1 / most).all())


@dataclass(frozen=True)
class Leftovers:
    """What fitted templates leave of the frame.

    Parameters
    ----------
    level, residual, steep : ndarray
        Of pixels: fitted grey value, residual over √(1 − leverage), slope of the fitted image in DN per pixel.
    score, spread : ndarray, shape (n, rows) and (n, rows, rows)
        Of the rows of targets: the score Σ w µ_x (d − µ) of a shift along x, and its covariance under the noise.
    """

    level: np.ndarray
    residual: np.ndarray
    steep: np.ndarray
    score: np.ndarray
    spread: np.ndarray


class _Fits(NamedTuple):
    """First fits of some targets."""

    fitted: Fitted
    slopes: int  # of planes, that were among the unknowns
    start: np.ndarray  # of the next fits: the parameters, or where there are none the start values that these had


def _fits(
    windows: Windows, targets: Targets, which: np.ndarray, noise: NoiseModel, kind: str, threads: int | None, start: np.ndarray | None
) -> _Fits:
    """Fit some of the targets."""
    windows = replace(windows, noise=noise)
    # planes, so that light or a ground that slopes is not taken for noise; small targets cannot tell them from the rest
    ground = bool(np.median(targets.semi_minor_px[which]) > LEAST_SLOPED_PX)
    light = ground and kind != "spot"
    fitted = run_fit(windows, which, windows.start if start is None else start, ground, light, False, threads)
    fitted = with_second_start(windows, targets, which, fitted, (ground, light, False), threads)
    return _Fits(fitted, 2 * ground + 2 * light, np.where(fitted.at_rest[:, None], fitted.parameters, windows.start))


def _leftovers(windows: Windows, fits: _Fits, noise: NoiseModel, threads: int | None, *, rows: bool) -> Leftovers:
    """Look at what fits leave: of pixels, or of rows."""
    model, fitted = replace(windows, noise=noise).model, fits.fitted

    def piece(good: np.ndarray) -> tuple[np.ndarray, ...]:
        return residuals(windows.frame, model, fitted.parameters, fits.slopes, good, windows.about, rows)

    pieces = map_tiles(piece, np.array_split(np.flatnonzero(fitted.at_rest), PIECES), threads)
    return Leftovers(*(np.concatenate(values) for values in zip(*pieces, strict=True)))


def _fitted(left: Leftovers, guess: NoiseModel, least: float) -> NoiseModel:
    """Constant, and slope if it is clear or could matter, of the variance of residuals against level."""
    level, residual = left.level, left.residual
    sigma = np.sqrt(guess.variance_dn2(level))
    inside = (level > guess.low_dn + 2.5 * sigma) & (level < guess.high_dn - 2.5 * sigma)  # else the scale cuts the noise
    flat = inside & (EDGE_PX * left.steep < 0.5 * sigma)
    if np.count_nonzero(inside) < LEAST_PIXELS:
        return guess
    ends = np.array([level[inside].min(), level[inside].max()])
    level_law = _law(level[flat], residual[flat], None, ends, least) if np.count_nonzero(flat) >= LEAST_PIXELS else None
    if level_law is not None and level_law.vague < FEW:
        certain, law = True, level_law
    else:
        certain, law = False, _law(level[inside], residual[inside], left.steep[inside], ends, least)
    if law.vague > VAGUEST:
        law = _law(level[inside], residual[inside], None, ends, least)
    if law.clear or (law.slope > 0.0 and law.vague > VAGUE):
        sure = certain and law.clear
        return replace(guess, constant_dn2=law.constant, slope_dn=law.slope, black_dn=float(ends[0]), slope_clear=sure)
    return replace(guess, constant_dn2=law.flat, slope_dn=0.0, black_dn=0.0, slope_clear=True)


@dataclass(frozen=True)
class _Law:
    """Variance = constant + slope · (level − lowest level), or the same everywhere."""

    constant: float
    slope: float
    flat: float
    clear: bool  # whether the slope is certain
    vague: float  # relative standard error of the variance at either end of the levels, the larger one


def _law(level: np.ndarray, residual: np.ndarray, steep: np.ndarray | None, ends: np.ndarray, least: float) -> _Law:
    """Fit the variance of residuals as a straight line in the level, by maximum likelihood; outliers are left out.

    With ``steep``, a term in proportion to its square is fitted beside: edges that are not where or as the template has them.
    """
    reach = float(ends[1] - ends[0]) + 1e-9 * (1 + abs(float(ends[1])))
    light, square = level - ends[0], residual**2
    bins, count = np.clip(LEVELS * light / reach, 0, LEVELS - 1).astype(np.intp), LEVELS
    columns = [np.ones_like(light), light]
    if steep is not None:
        columns.append(steep**2)
        bins += LEVELS * np.clip(LEVELS * steep / max(float(steep.max()), 1e-300), 0, LEVELS - 1).astype(np.intp)
        count *= LEVELS
    kept, share = np.ones(len(level), bool), 1.0
    for _ in range(5):
        n = np.bincount(bins[kept], minlength=count).astype(float)
        full = np.flatnonzero(n)
        n = n[full]
        design = np.stack([np.bincount(bins[kept], c[kept], count)[full] / n for c in columns])
        v = np.bincount(bins[kept], square[kept], count)[full] / n / share
        fitted, expected, covariance = _variances(n, v, design, least)
        inside = square <= OUTLIER_SIGMA**2 * sum(f * c for f, c in zip(fitted, columns, strict=True))
        if not inside.any() or (inside == kept).all():
            break
        kept, share = inside, KEPT
    plain, without, _ = _variances(n, v, np.delete(design, 1, axis=0), least)
    many = n >= MANY_PIXELS
    misfit = float((n * (v / expected - 1) ** 2 / 2)[many].sum()) / max(int(many.sum()) - len(design), 1)
    excess = max(1.0, misfit)  # the spread of the levels about the line counts too
    fall = float((n * (np.log(without / expected) + v / without - v / expected)).sum()) / excess
    at_ends = np.array([[1.0, 0.0], [1.0, reach]])
    error = np.sqrt(np.maximum(excess * np.einsum("ik,kl,il->i", at_ends, covariance[:2, :2], at_ends), 0.0))
    told = np.linalg.matrix_rank(design / np.maximum(design.max(axis=1, keepdims=True), 1e-300)) == len(design)  # else any split would do
    vague = float((error / (at_ends @ fitted[:2])).max()) if told else math.inf
    return _Law(float(fitted[0]), float(fitted[1]), float(plain[0]), told and fitted[1] > 0.0 and fall > CLEAR_SIGMA**2, vague)


def _variances(n: np.ndarray, v: np.ndarray, design: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maximum likelihood of v, mean squares of n normal values, as a sum of the rows of ``design``: coefficients, sum, covariance.

    Coefficients are 0 or more, the first not below its least. Fisher's scoring: least squares with the weights n / 2V².
    """
    expected = np.full(len(n), max(float(np.average(v, weights=n)), least))
    scale = np.maximum(design.max(axis=1), 1e-300)
    rows = design / scale[:, None]
    floor = np.zeros(len(rows))
    floor[0] = least
    for _ in range(20):
        w = n / (2 * expected**2)
        free = np.ones(len(rows), bool)
        while True:
            part = rows[free]
            covariance = np.zeros((len(rows), len(rows)))
            covariance[np.ix_(free, free)] = np.linalg.pinv((part * w) @ part.T)
            fitted = np.where(free, covariance @ (rows * w) @ (v - floor[~free] @ rows[~free]), floor)
            low = free & (fitted < floor)
            if not low.any():
                break
            free &= ~low
        before, expected = expected, np.maximum(fitted @ rows, least)
        if np.abs(expected / before - 1).max() < 1e-4:
            break
    # as uncertain as if no coefficient had come to its end
    whole = np.linalg.pinv((rows * w) @ rows.T)
    return fitted / scale, expected, whole / np.outer(scale, scale)


def row_shifts(left: Leftovers) -> tuple[float, float]:
    """Measure by how much rows are shifted along x against each other: standard deviations in px of each by itself, and of what
    neighbouring lines of a field share; 0 where it is not more than noise.

    Notes
    -----
    With d the derivative of the image by x on one row, its score is A = dᵀ W e, e the residuals. Under the noise alone its covariance over
    the rows of a target is M = dᵀ W R d (R = I − J N⁻¹ Jᵀ W); shifts of covariance θ₁ I + θ₂ K add M (θ₁ I + θ₂ K) M. θ follows from the
    quadratic forms AᵀA and AᵀKA by what is expected of them (MINQUE: C. R. Rao, J. Multivariate Analysis 1, 257 (1971)). K is
    ρ^(lines between) within a field of every other row, with a loop that forgets in five lines. What all rows of a target share cannot
    be seen: it is inferred from what they do not share.
    """
    spread = left.spread
    own = np.sqrt(np.maximum(np.diagonal(spread, axis1=1, axis2=2), 0.0))
    told = own > 0.1 * own.max(axis=1, initial=0.0, keepdims=True) + 1e-300
    if np.count_nonzero(told) < LEAST_PIXELS:
        return 0.0, 0.0
    ratio = np.where(told, np.abs(left.score) / np.where(told, own, 1.0), 0.0)
    score = np.where(ratio > SHIFT_LIMIT * max(1.0, float(np.median(ratio[told])) / 0.6745), 0.0, left.score)
    apart = np.abs(np.arange(spread.shape[1])[:, None] - np.arange(spread.shape[1]))
    alike = np.where(apart % 2 == 0, ALIKE ** (apart / 2), 0.0)
    turned = spread @ alike
    noise = np.array([np.trace(m, axis1=1, axis2=2).sum() for m in (spread, turned)])
    cross = (turned * spread.transpose(0, 2, 1)).sum()
    normal = np.array([[(spread**2).sum(), cross], [cross, (turned * turned.transpose(0, 2, 1)).sum()]])
    found = np.array([(score**2).sum(), np.einsum("nr,rq,nq->", score, alike, score)])
    if _beyond(found, noise, normal) < SHIFTED_SIGMA:
        return 0.0, 0.0
    theta = np.linalg.lstsq(normal, found - noise, rcond=None)[0]
    for k in (0, 1):
        if theta[k] < 0.0:
            theta = np.zeros(2)
            theta[1 - k] = max((found - noise)[1 - k] / normal[1 - k, 1 - k], 0.0)
    return float(np.sqrt(theta[0])), float(np.sqrt(theta[1]))


def _beyond(found: np.ndarray, noise: np.ndarray, normal: np.ndarray) -> float:
    """By how many standard deviations a quadratic form exceeds what noise makes it: that of the two that does more (Wilson–Hilferty)."""
    degrees = noise**2 / np.diagonal(normal)
    width = 2 / (9 * degrees)
    return float((((found / noise) ** (1 / 3) - (1 - width)) / np.sqrt(width)).max())
