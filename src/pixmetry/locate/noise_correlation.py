"""Noise that neighbouring pixels share: its autocovariance on the ground between the targets, and what it does to positions.

A position answers to the grey values by a gain g of each pixel, and its variance is Σ g_i g_j C(i − j), with C the autocovariance of the
noise. A covariance for independent pixels holds C(0) alone. Filters, demosaicing and coders make neighbours alike or opposite; rows and
columns with offsets of their own, and texture, reach farther. This is what empty apertures measure in photometry of faint galaxies
(I. Labbé et al., Astron. J. 125, 1107 (2003)), with the gain of the target in place of an aperture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.locate.coded_noise import coder_spread
from pixmetry.locate.detect.blocks import Coder, noise_before
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.drawn_targets import Drawn, Spread, drawn_target
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.shared_shape import SharedShape, shared_shape

BLOCK_PX = 64  # side of a block of ground that is looked at
BLOCKS = 12  # about so many
LAGS_PX = 24  # farther apart only rows and columns are alike
NEAR_PX = 3  # within which pixels are alike in proportion to their noise, as filters make them; farther on by so many DN²
FAR_PX = 12  # from here on what rows and columns share is the same at all distances
CLEAR_SIGMA = 4.0  # by which noise must differ from that of independent pixels (6e-5 by chance)
CLASSES = 5  # sizes of targets whose gains are computed
CODED = 20  # targets that are sent through a coder, of all sizes together
ALIKE = 1.1  # ratio of sizes that are one
UNLIKE = 1.5  # ratio of the variances of targets and ground from which their noise may be of another kind
SAMPLE, LARGE_SAMPLE = 24, 80  # targets whose residuals are looked at then; where they share a shape that is not the template's
MOST_POOR = 100  # poor fits whose own residuals are looked at
BY_NEIGHBOURS = "neighbouring pixels share noise"  # why uncertainties are others than those of independent pixels
BY_CODER = "a coder of blocks (JPEG) rounded the picture"
BY_SHAPE = "the shape that all targets share is not quite the template's, which is no noise"
HALVINGS = 6  # of the search for the noise before a coder
LEAST_SHARE = 0.01  # of the noise's variance: ground without noise tells nothing
LEAST_FACTOR = 0.05  # of a variance: opposite neighbours do not take more


Boxes = list[tuple[int, int, int, int]]  # first row, stop row, first column, stop column of each


@dataclass(frozen=True)
class Correlation:
    """Autocovariance of the ground's noise at lags −`LAGS_PX` … `LAGS_PX`, arrays of shape (lags along y, along x).

    Parameters
    ----------
    covariance_dn2 : ndarray
    pairs : ndarray
        Of pixels that it is from.
    """

    covariance_dn2: np.ndarray
    pairs: np.ndarray

    @property
    def variance_dn2(self) -> float:
        """Of a single pixel."""
        return float(self.covariance_dn2[LAGS_PX, LAGS_PX])

    def over(self, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Autocovariance and its number of pairs at all lags of a window of this side; 0 pairs where nothing is known and 0 is assumed."""
        wide, known = 2 * side - 1, self.covariance_dn2
        out, pairs = np.zeros((wide, wide)), np.zeros((wide, wide))
        n = min(LAGS_PX, side - 1)
        there, here = slice(side - 1 - n, side + n), slice(LAGS_PX - n, LAGS_PX + n + 1)
        out[there, there], pairs[there, there] = known[here, here], self.pairs[here, here]
        if side - 1 > LAGS_PX:
            for line, told in ((out[side - 1], known[LAGS_PX]), (out[:, side - 1], known[:, LAGS_PX])):
                level = told[: LAGS_PX - FAR_PX + 1].mean()
                line[: side - 1 - n], line[side + n :] = level, level
        return out, pairs


def correlation_of(frame: np.ndarray, targets: Targets, low_dn: float, high_dn: float, boxes: Boxes | None = None) -> Correlation | None:
    """Measure the autocovariance of a frame's noise on blocks of ground without targets; None where there is too little.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    targets : Targets
        All regions that were found, whatever they are.
    low_dn, high_dn : float
        Ends of the scale; blocks in which it cuts the noise are left out.
    boxes : list of (int, int, int, int), optional
        Where targets were looked for: first row, stop row, first column, stop column. Elsewhere may be others.

    Notes
    -----
    Blocks of 64 × 64 pixels are spread over the frame. A plane is taken off each, values beyond 4 standard deviations are left out, and
    sums over pairs of pixels are correlations of the values and of the mask by Fourier transforms.
    """
    n = 2 * LAGS_PX + 1
    products, pairs = np.zeros((n, n)), np.zeros((n, n))
    reach = np.ceil(4 * np.nan_to_num(targets.blur_px, nan=1.0) + 2).astype(int)
    about = np.stack([targets.row_first - reach, targets.row_stop + reach, targets.col_first - reach, targets.col_stop + reach])
    for top, bottom, left, right in boxes or [(0, frame.shape[0], 0, frame.shape[1])]:
        _add_products(frame[top:bottom, left:right], about - np.array([[top], [top], [left], [left]]), (low_dn, high_dn), products, pairs)
    if not pairs.any():
        return None
    pairs = np.rint(pairs)
    return Correlation(np.where(pairs > 0.5, products / np.maximum(pairs, 1.0), 0.0), pairs)


def _add_products(frame: np.ndarray, box: np.ndarray, ends_dn: tuple[float, float], products: np.ndarray, pairs: np.ndarray) -> None:
    """Add the products of pixels at all lags, and their pairs, on ground outside of the boxes of targets."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    from pixmetry.locate._noise_kernels import noise_in_block

    rows, cols = frame.shape
    side = min(BLOCK_PX, rows, cols)
    if side < 2 * FAR_PX:
        return
    most_y, most_x = rows // side, cols // side
    ny = min(most_y, max(1, round(np.sqrt(BLOCKS * rows / cols))))
    nx = min(most_x, max(1, BLOCKS // ny))
    tops = np.linspace(0, rows - side, ny).round().astype(int)
    lefts = np.linspace(0, cols - side, nx).round().astype(int)
    values, masks = [], []
    for top in tops:
        for left in lefts:
            block, mask = frame[top : top + side, left : left + side].astype(float), np.ones((side, side), bool)
            near = (box[0] < top + side) & (box[1] > top) & (box[2] < left + side) & (box[3] > left)
            for first, stop, begin, end in box[:, near].T:
                mask[max(first - top, 0) : stop - top, max(begin - left, 0) : end - left] = False
            if noise_in_block(block, mask, *ends_dn, 0.6 if frame.dtype.kind == "u" else 0.0):
                values.append(block)
                masks.append(mask)
    if not values:
        return
    full = next_fast_len(side + LAGS_PX, real=True)
    seen, there = np.stack(values).astype(np.float32), np.stack(masks).astype(np.float32)
    lags = np.ix_(*[np.arange(-LAGS_PX, LAGS_PX + 1)] * 2)
    products += irfft2((np.abs(rfft2(seen, (full, full))) ** 2).sum(axis=0), (full, full))[lags]
    pairs += irfft2((np.abs(rfft2(there, (full, full))) ** 2).sum(axis=0), (full, full))[lags]


def lag_sums(stack: np.ndarray, other: np.ndarray | None = None) -> np.ndarray:
    """Sums of products of pixels at all lags, of each image of a stack (n, side, side); shape (n, 2 side − 1, 2 side − 1)."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    side = stack.shape[-1]
    full = next_fast_len(2 * side - 1, real=True)
    first = rfft2(stack, (full, full))
    both = first.real**2 + first.imag**2 if other is None else first * np.conj(rfft2(other, (full, full)))
    order = np.arange(1 - side, side)
    found: np.ndarray = irfft2(both, (full, full))[:, order[:, None], order]
    return found


def residual_correlation(drawn: list[Drawn], noise: NoiseModel, sigmas_dn: list[np.ndarray] | None = None) -> np.ndarray:
    """Autocorrelation of what templates leave, at lags up to `NEAR_PX`; shape (lags, lags), 1 in the middle.

    Residuals are those of all pixels less what the unknowns take: for independent pixels (I − H) in place of I, which is allowed for.
    ``sigmas_dn``: noise of the pixels of each, where it is not that of the noise model.
    """
    n = 2 * NEAR_PX + 1
    total, count = np.zeros((n, n)), np.zeros((n, n))
    for k, one in enumerate(drawn):
        sigma, _, basis = one.gains(noise)
        sigma = sigma if sigmas_dn is None else sigmas_dn[k]
        side = len(one.mean)
        middle = slice(side - 1 - NEAR_PX, side + NEAR_PX)
        sums = lag_sums(np.concatenate([[one.mask, one.residual / sigma], basis]))[:, middle, middle]
        total += sums[1:].sum(axis=0)
        count += sums[0]
    ratio: np.ndarray = total / np.maximum(count, 1.0)
    return ratio / max(float(ratio[NEAR_PX, NEAR_PX]), 1e-30)


@dataclass(frozen=True)
class Shared:
    """Autocovariance of the noise at the lags of a target's window.

    Parameters
    ----------
    here : ndarray, shape (2 side − 1, 2 side − 1)
        Correlation at the lags that go with the noise of the pixels.
    around : ndarray, shape (2 side − 1, 2 side − 1)
        Covariance at the others, DN².
    pairs : ndarray, shape (2 side − 1, 2 side − 1)
        Of pixels that they are from.
    variance_dn2 : float
        Of a pixel of the ground.
    """

    here: np.ndarray
    around: np.ndarray
    pairs: np.ndarray
    variance_dn2: float


def _shared(one: Drawn, noise: NoiseModel, known: Correlation, near_alike: np.ndarray | None = None, ratio: float = 1.0) -> Shared:
    """What the pixels of a target share, the variances themselves left out; ``ratio`` of its noise to that of the noise model, squared."""
    side = len(one.mean)
    covariance, pairs = known.over(side)
    lag = np.abs(np.arange(1 - side, side))
    near = np.maximum(lag[:, None], lag) <= NEAR_PX
    # the noise model's variance on the ground, and not that of the blocks: what rows share must cancel in x to the last percent
    variance = ratio * float(noise.variance_dn2(np.median(one.mean[[0, -1]])))
    alike = covariance / known.variance_dn2
    here, around = np.where(near, alike, 0.0), np.where(near, 0.0, alike * variance)
    if near_alike is not None:
        middle = slice(side - 1 - NEAR_PX, side + NEAR_PX)
        here[middle, middle] = near_alike
    here[side - 1, side - 1] = 0.0  # the variance itself is that of the noise model
    return Shared(here, around, pairs, variance)


def differs_clearly(one: Drawn, noise: NoiseModel, known: Correlation) -> bool:
    """Whether the noise differs from that of independent pixels for certain, in what it does to x or y."""
    sigma, gain, _ = one.gains(noise)
    shared, place, side = _shared(one, noise, known), gain[:2], len(one.mean)
    own, in_dn = np.split(lag_sums(np.concatenate([place, place / sigma])), 2)
    excess = (own * shared.here + in_dn * shared.around).sum(axis=(1, 2))
    own[:, side - 1, side - 1] = 0.0
    lag = np.abs(np.arange(1 - side, side))
    near = np.maximum(lag[:, None], lag) <= NEAR_PX
    by_chance = 2 * np.where(near, own, in_dn * shared.variance_dn2) ** 2 / np.maximum(shared.pairs, 1.0)
    return bool((np.abs(excess) > CLEAR_SIGMA * np.sqrt(by_chance[:, shared.pairs > 0].sum(axis=1))).any())


def spread_of(
    one: Drawn, noise: NoiseModel, known: Correlation, near_alike: np.ndarray | None = None, sigma_dn: np.ndarray | None = None
) -> Spread:
    """Compute what correlated noise does to a least-squares fit with the weights of independent pixels.

    ``near_alike``: the autocorrelation at the target itself, where it is not that of the ground (`residual_correlation`). ``sigma_dn``:
    the noise of its pixels, where it is not that of the weights.
    """
    sigma, gain, basis = one.gains(noise)
    expected = (gain**2).sum(axis=(1, 2))
    ratio = 1.0
    if sigma_dn is not None:
        ratio = float(np.median((sigma_dn / sigma)[one.mask])) ** 2
        gain, sigma = gain * (sigma_dn / sigma), sigma_dn
    shared = _shared(one, noise, known, near_alike, ratio)
    ground = gain / sigma  # answers to DN, for what rows and columns share
    own, in_dn, of_basis = np.split(lag_sums(np.concatenate([gain, ground, basis])), 3)
    factor = ((gain**2).sum(axis=(1, 2)) + (own * shared.here + in_dn * shared.around).sum(axis=(1, 2))) / expected
    both = lag_sums(np.stack([gain[0], ground[0]]), np.stack([gain[1], ground[1]]))
    cross = float((both[0] * shared.here + both[1] * shared.around).sum()) / np.sqrt(expected[0] * expected[1])
    if noise.origin == "image" and sigma_dn is None:
        # what the unknowns take of correlated noise is missing in the residuals that it was measured from
        taken = float((of_basis * (shared.here + shared.around / shared.variance_dn2)).sum())
        count = float(one.mask.sum())
        factor *= (count - len(gain)) / max(count - len(gain) - taken, 0.5 * count)
    return Spread(np.maximum(factor, LEAST_FACTOR), cross)


def with_correlation(
    frame: np.ndarray,
    regions: Targets,
    targets: Targets,
    positions: Positions,
    noise: NoiseModel,
    kind: str,
    aperture_px: float,
    coder: Coder | None = None,
    known: Correlation | None = None,
    boxes: Boxes | None = None,
    *,
    fitted: bool = True,
) -> tuple[Positions, float, str]:
    """Positions with a covariance that holds the correlation of the frame's noise; the factor of their u, and why: 1 and "" without it.

    The factors are those of the template, computed for a few sizes of targets. Other estimators answer to the same pixels in much the same
    way.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    regions : Targets
        All that was found in the frame.
    targets : Targets
        Those that were measured.
    positions : Positions
    noise : NoiseModel
    kind : {"disc", "ellipse", "ring", "spot"}
        Of the template.
    aperture_px : float
    coder : Coder, optional
        That the frame went through. Where its steps are known, what it does to templates takes the place of the correlation.
    known : Correlation, optional
        What is known of the camera; by default what the ground between the targets tells.
    boxes : list of (int, int, int, int), optional
        Where targets were looked for, if not in the whole frame: only there is it known what is ground.
    fitted : bool
        Whether the positions are those of the template. What it leaves at others is their own error and its rough shape: no sign of a shape
        that all targets share, or of more noise than the coder makes.
    """
    from pixmetry.locate.template.template import PARAMETERS

    good = np.flatnonzero(
        np.isfinite(positions.var_x_px2) & ((positions.flags & (Flag.BORDER | Flag.OVERLAPPING | Flag.NOT_CONVERGED)) == 0)
    )
    if not len(good):
        return positions, 1.0, ""
    by_coder = coder is not None and coder.steps is not None
    if by_coder:
        known = None
    elif known is None:
        known = correlation_of(frame, regions, noise.low_dn, noise.high_dn, boxes)
    if not by_coder and (known is None or known.variance_dn2 <= LEAST_SHARE * noise.constant_dn2):
        return positions, 1.0, ""
    size = np.sqrt(targets.semi_major_px * targets.semi_minor_px)
    good = good[np.argsort(size[good], kind="stable")]
    count = 1 if size[good[-1]] < ALIKE * size[good[0]] else min(CLASSES, len(good))
    picked = good[np.rint((np.arange(count) + 0.5) / count * len(good) - 0.5).astype(int)]

    def drawn_of(chosen: np.ndarray) -> list[Drawn]:
        return [drawn_target(frame, targets, positions, i, kind, aperture_px) for i in chosen]

    def sample(most: int) -> list[Drawn]:
        some = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), most)).round().astype(int))]
        return drawn_of(some)

    relief: np.ndarray | float = 1.0
    if known is None:
        assert coder is not None
        before = noise_before(frame, coder, regions, boxes)
        groups = [drawn_of(part[:: -(-len(part) * count // CODED)]) for part in np.array_split(good, count)]
        spreads, why = _of_coder(before, coder, noise, groups, sample(SAMPLE), fitted), BY_CODER
    else:
        drawn = drawn_of(picked)
        level = float(np.median(noise.variance_dn2(targets.background_dn[good] + 0.5 * targets.amplitude_dn[good])))
        some = [] if 1 / UNLIKE < level / known.variance_dn2 < UNLIKE else sample(SAMPLE)
        shared = shared_shape(some, noise) if fitted and noise.origin == "image" else None
        if shared is not None:
            more_targets = sample(LARGE_SAMPLE)
            if (larger := shared_shape(more_targets, noise)) is not None:  # else each target stays with what is left of itself
                shared, some = larger, more_targets
            spreads, why = _of_shared_shape(noise, known, shared, drawn, some), BY_SHAPE
            relief = _relief(positions, good, noise)
        elif any(differs_clearly(one, noise, known) for one in drawn):
            alike = residual_correlation(some, noise) if some else None
            spreads, why = [spread_of(one, noise, known, alike) for one in drawn], BY_NEIGHBOURS
        else:
            return positions, 1.0, ""
    at = np.log(size[picked])

    def over_sizes(values: list[float]) -> np.ndarray:
        return np.interp(np.log(np.maximum(size, 1e-3)), at, values)

    factors = {name: relief * over_sizes([float(s.factor[k]) for s in spreads]) for k, name in enumerate(PARAMETERS[kind])}
    fx, fy, cross = factors["x_px"], factors["y_px"], relief * over_sizes([s.cross for s in spreads])
    phase = np.nan_to_num(positions.more.get("s_curve_px", np.zeros(len(size)))) ** 2
    vx, vy = positions.var_x_px2 - phase, positions.var_y_px2 - phase
    both = positions.cov_xy_px2 * np.sqrt(fx * fy) + cross * np.sqrt(vx * vy)
    limit = 0.99 * np.sqrt(vx * fx * vy * fy)
    more = {f"u_{n}": positions.more[f"u_{n}"] * np.sqrt(f) for n, f in factors.items() if f"u_{n}" in positions.more}
    changed = replace(
        positions,
        var_x_px2=vx * fx + phase,
        cov_xy_px2=np.clip(both, -limit, limit),
        var_y_px2=vy * fy + phase,
        more={**positions.more, **more},
    )
    return changed, float(np.median(np.sqrt(0.5 * (fx + fy))[good])), why


def _relief(positions: Positions, good: np.ndarray, noise: NoiseModel) -> np.ndarray:
    """What the variances of poor fits, which hold the residuals, are to be multiplied by where all targets share their usual χ²."""
    chi2 = positions.more["chi2_per_dof"]
    usual = max(1.0, float(np.median(chi2[good])))
    widened = (positions.flags & Flag.POOR_FIT != 0) & (noise.row_shift_px == 0) & (noise.field_shift_px == 0)
    relief: np.ndarray = np.where(widened, np.maximum(chi2 / usual, 1.0) / np.maximum(chi2, 1.0), 1.0)
    return relief


def _of_coder(before: float, coder: Coder, noise: NoiseModel, groups: list[list[Drawn]], some: list[Drawn], fitted: bool) -> list[Spread]:
    """Spreads of groups of templates that went through the coder after the noise ``before``; wider where more is left than it leaves."""
    if not fitted and np.isfinite(before):
        return [_through_coder(group, noise, coder, before)[0] for group in groups]
    shared = shared_shape(some, noise)
    seen = some if shared is None else shared.rest
    left = sum(float((one.residual**2 / noise.variance_dn2(one.mean)).sum()) for one in seen)
    left /= sum(max(float(one.mask.sum()) - len(one.jacobian), 1.0) for one in seen)
    if not np.isfinite(before):  # no ground: as much as leaves what is left at the targets
        middle, low, before = groups[len(groups) // 2][0], 0.0, float(np.sqrt(left * noise.constant_dn2))
        for _ in range(HALVINGS):
            half = 0.5 * (low + before)
            low, before = (half, before) if coder_spread(middle, noise, coder, half)[1] < left else (low, half)
    through = [_through_coder(group, noise, coder, before) for group in groups]
    beyond = max(1.0, left / float(np.mean([residual for _, residual in through])))
    return [replace(spread, factor=spread.factor * beyond) for spread, _ in through]


def _through_coder(group: list[Drawn], noise: NoiseModel, coder: Coder, before: float) -> tuple[Spread, float]:
    """What `coder_spread` tells of like templates: medians, for by its few draws and its place in the pixel one tells it to 10 to 30 %."""
    each = [coder_spread(one, noise, coder, before) for one in group]
    count = min(len(spread.factor) for spread, _ in each)  # slopes are unknowns of some only
    factor: np.ndarray = np.median([spread.factor[:count] for spread, _ in each], axis=0)
    return replace(each[0][0], factor=factor), float(np.median([residual for _, residual in each]))


def _of_shared_shape(noise: NoiseModel, known: Correlation, shared: SharedShape, drawn: list[Drawn], some: list[Drawn]) -> list[Spread]:
    """Spreads by the noise that is left beside what all targets share, and by how that moves them at their places in the pixels."""
    rest, sigmas = shared.rest, [shared.sigma_dn(one, noise) for one in some]
    level = float(np.mean([np.median(s[one.mask]) for s, one in zip(sigmas, some, strict=True)])) ** 2
    alike = None if 1 / UNLIKE < level / known.variance_dn2 < UNLIKE else residual_correlation(rest, noise, sigmas)
    count = min(len(one.jacobian) for one in (*some, *drawn))  # slopes are unknowns of some only
    moved = np.square([shared.moved(one, noise)[:count] for one in some]).mean(axis=0)
    variance = np.mean([(one.gains(noise)[1] ** 2).sum(axis=(1, 2))[:count] for one in some], axis=0)
    spreads = [spread_of(one, noise, known, alike, shared.sigma_dn(one, noise)) for one in drawn]
    return [replace(s, factor=s.factor[:count] + moved / variance) for s in spreads]


def with_own_residuals(
    frame: np.ndarray, targets: Targets, positions: Positions, noise: NoiseModel, kind: str, aperture_px: float
) -> Positions:
    """Positions whose poor fits have a covariance that holds how alike neighbouring residuals are: dirt and glints are no noise of pixels.

    Only the worst, up to `MOST_POOR` with more than twice the usual χ², are looked at.
    """
    chi2 = positions.more.get("chi2_per_dof", np.zeros(0))
    poor = np.flatnonzero((positions.flags & (Flag.POOR_FIT | Flag.NOT_CONVERGED) == Flag.POOR_FIT) & np.isfinite(positions.var_x_px2))
    if not len(chi2) or not len(poor):
        return positions
    poor = poor[chi2[poor] > 2 * max(1.0, float(np.nanmedian(chi2)))]
    poor = poor[np.argsort(-chi2[poor])][:MOST_POOR]
    wide = np.zeros((2 * LAGS_PX + 1,) * 2)
    wide[LAGS_PX, LAGS_PX] = 1.0
    alone, factor = Correlation(wide, np.ones_like(wide)), np.ones((2, len(positions)))
    given = replace(noise, origin="given")
    for i in poor:
        one = drawn_target(frame, targets, positions, int(i), kind, aperture_px)
        factor[:, i] = np.maximum(spread_of(one, given, alone, residual_correlation([one], given)).factor[:2], 1.0)
    return replace(
        positions,
        var_x_px2=positions.var_x_px2 * factor[0],
        cov_xy_px2=positions.cov_xy_px2 * np.sqrt(factor[0] * factor[1]),
        var_y_px2=positions.var_y_px2 * factor[1],
    )
