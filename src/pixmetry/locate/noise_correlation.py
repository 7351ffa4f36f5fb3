"""Noise that neighbouring pixels share: its autocovariance on the ground between the targets, and what it does to positions.

A position answers to the grey values by a gain g of each pixel, and its variance is Σ g_i g_j C(i − j), with C the autocovariance of the
noise. A covariance for independent pixels holds C(0) alone. Filters, demosaicing and coders make neighbours alike or opposite; rows and
columns with offsets of their own, and texture, reach farther. This is what empty apertures measure in photometry of faint galaxies
(I. Labbé et al., Astron. J. 125, 1107 (2003)), with the gain of the target in place of an aperture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.noise import NoiseModel

BLOCK_PX = 64  # side of a block of ground that is looked at
BLOCKS = 12  # about so many
LAGS_PX = 24  # farther apart only rows and columns are alike
LEAST_GROUND = 0.25  # of a block's pixels, without targets
OUTLIER_SIGMA = 4.0
NEAR_PX = 3  # within which pixels are alike in proportion to their noise, as filters make them; farther on by so many DN²
FAR_PX = 12  # from here on what rows and columns share is the same at all distances
CLEAR_SIGMA = 4.0  # by which noise must differ from that of independent pixels (6e-5 by chance)
CLASSES = 5  # sizes of targets whose gains are computed
ALIKE = 1.1  # ratio of sizes that are one
UNLIKE = 1.5  # ratio of the variances of targets and ground from which their noise may be of another kind
SAMPLE = 24  # targets whose residuals are looked at then
MOST_POOR = 100  # poor fits whose own residuals are looked at
LEAST_SHARE = 0.01  # of the noise's variance: ground without noise tells nothing
LEAST_FACTOR = 0.05  # of a variance: opposite neighbours do not take more


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


def correlation_of(frame: np.ndarray, targets: Targets, low_dn: float, high_dn: float) -> Correlation | None:
    """Measure the autocovariance of a frame's noise on blocks of ground without targets; None where there is too little.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    targets : Targets
        All regions that were found, whatever they are.
    low_dn, high_dn : float
        Ends of the scale; blocks in which it cuts the noise are left out.

    Notes
    -----
    Blocks of 64 × 64 pixels are spread over the frame. A plane is taken off each, values beyond 4 standard deviations are left out, and
    sums over pairs of pixels are correlations of the values and of the mask by Fourier transforms.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    rows, cols = frame.shape
    side = min(BLOCK_PX, rows, cols)
    if side < 2 * FAR_PX:
        return None
    most_y, most_x = rows // side, cols // side
    ny = min(most_y, max(1, round(np.sqrt(BLOCKS * rows / cols))))
    nx = min(most_x, max(1, BLOCKS // ny))
    tops = np.linspace(0, rows - side, ny).round().astype(int)
    lefts = np.linspace(0, cols - side, nx).round().astype(int)
    reach = np.ceil(4 * np.nan_to_num(targets.blur_px, nan=1.0) + 2).astype(int)
    box = np.stack([targets.row_first - reach, targets.row_stop + reach, targets.col_first - reach, targets.col_stop + reach])
    values, masks = [], []
    for top in tops:
        for left in lefts:
            block, mask = frame[top : top + side, left : left + side].astype(float), np.ones((side, side), bool)
            near = (box[0] < top + side) & (box[1] > top) & (box[2] < left + side) & (box[3] > left)
            for first, stop, begin, end in box[:, near].T:
                mask[max(first - top, 0) : stop - top, max(begin - left, 0) : end - left] = False
            ground = _noise_in(block, mask, low_dn, high_dn, 0.6 if frame.dtype.kind == "u" else 0.0)
            if ground is not None:
                values.append(ground)
                masks.append(mask)
    if not values:
        return None
    full = next_fast_len(side + LAGS_PX, real=True)
    seen, there = np.stack(values).astype(np.float32), np.stack(masks).astype(np.float32)
    products = irfft2((np.abs(rfft2(seen, (full, full))) ** 2).sum(axis=0), (full, full))
    pairs = irfft2((np.abs(rfft2(there, (full, full))) ** 2).sum(axis=0), (full, full))
    lags = np.arange(-LAGS_PX, LAGS_PX + 1)
    products, pairs = products[np.ix_(lags, lags)], np.rint(pairs[np.ix_(lags, lags)])
    return Correlation(np.where(pairs > 0.5, products / np.maximum(pairs, 1.0), 0.0), pairs)


def _noise_in(block: np.ndarray, mask: np.ndarray, low_dn: float, high_dn: float, grain_dn: float) -> np.ndarray | None:
    """A block less its plane, 0 outside of the mask, from which outliers are taken; None where it is no ground."""
    if mask.mean() < LEAST_GROUND:
        return None
    side = len(block)
    line = np.linspace(-1, 1, side)
    design = np.stack([np.ones(side * side), np.tile(line, side), np.repeat(line, side)])
    spread = 0.0
    for _ in range(2):
        here = mask.ravel()
        part = design[:, here]
        plane = np.linalg.solve(part @ part.T, part @ block.ravel()[here])
        left = block - (plane @ design).reshape(block.shape)
        spread = max(1.4826 * float(np.median(np.abs(left[mask]))), grain_dn)  # of rounded values the median may be 0
        level = float(plane[0])
        if spread <= 0 or level - 3 * spread < low_dn or level + 3 * spread > high_dn:
            return None
        mask &= np.abs(left) < OUTLIER_SIGMA * spread
        if mask.mean() < LEAST_GROUND:
            return None
    return np.where(mask, left, 0.0)


@dataclass(frozen=True)
class Spread:
    """What correlated noise makes of the covariance of a target: factors of its variances, and what is added to the correlation of x and y.

    Parameters
    ----------
    factor : ndarray, shape (parameters,)
        Of the variance of each parameter, those of x and y first.
    cross : float
        Covariance of x and y over the root of the product of their variances for independent pixels, which correlated noise adds.
    clear : bool
        Whether the noise differs from that of independent pixels for certain.
    """

    factor: np.ndarray
    cross: float
    clear: bool


@dataclass(frozen=True)
class Drawn:
    """A fitted target as its template draws it, in a window of its own.

    Parameters
    ----------
    mean : ndarray, shape (side, side)
        Grey values, DN.
    jacobian : ndarray, shape (parameters, side, side)
        Their derivatives; by x and y first.
    mask : ndarray of bool, shape (side, side)
        Pixels that are used.
    residual : ndarray, shape (side, side)
        What it leaves of the frame, DN; 0 outside of the mask.
    """

    mean: np.ndarray
    jacobian: np.ndarray
    mask: np.ndarray
    residual: np.ndarray

    def gains(self, noise: NoiseModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Noise of each pixel, DN; gains of the parameters, rows of (JᵀWJ)⁻¹JᵀW, times that noise; an orthonormal basis of W^½ J."""
        sigma = np.sqrt(noise.variance_dn2(self.mean))
        white = np.where(self.mask, self.jacobian / sigma, 0.0).reshape(len(self.jacobian), -1)
        scale = np.sqrt((white**2).sum(axis=1, keepdims=True))
        basis, triangle = np.linalg.qr((white / scale).T)
        shape = (-1, *self.mean.shape)
        return sigma, (np.linalg.pinv(triangle, rcond=1e-9) @ basis.T / scale).reshape(shape), basis.T.reshape(shape)


def lag_sums(one: np.ndarray, other: np.ndarray | None = None) -> np.ndarray:
    """Sums of products of pixels at all lags, over all images of a stack (…, side, side); shape (2 side − 1, 2 side − 1)."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    side = one.shape[-1]
    full = next_fast_len(2 * side - 1, real=True)
    first = rfft2(one, (full, full))
    both = first * np.conj(first if other is None else rfft2(other, (full, full)))
    order = np.arange(1 - side, side)
    return irfft2(both.reshape(-1, *both.shape[-2:]).sum(axis=0), (full, full))[np.ix_(order, order)]


def residual_correlation(drawn: list[Drawn], noise: NoiseModel) -> np.ndarray:
    """Autocorrelation of what templates leave, at lags up to `NEAR_PX`; shape (lags, lags), 1 in the middle.

    Residuals are those of all pixels less what the unknowns take: for independent pixels (I − H) in place of I, which is allowed for.
    """
    n = 2 * NEAR_PX + 1
    total, count = np.zeros((n, n)), np.zeros((n, n))
    for one in drawn:
        sigma, _, basis = one.gains(noise)
        side = len(one.mean)
        middle = slice(side - 1 - NEAR_PX, side + NEAR_PX)
        total += (lag_sums(one.residual / sigma) + lag_sums(basis))[middle, middle]
        count += lag_sums(one.mask.astype(float))[middle, middle]
    ratio: np.ndarray = total / np.maximum(count, 1.0)
    return ratio / max(float(ratio[NEAR_PX, NEAR_PX]), 1e-30)


def spread_of(one: Drawn, noise: NoiseModel, known: Correlation, near_alike: np.ndarray | None = None) -> Spread:
    """Compute what correlated noise does to a least-squares fit with the weights of independent pixels.

    ``near_alike``: the autocorrelation at the target itself, where it is not that of the ground (`residual_correlation`).
    """
    sigma, gain, basis = one.gains(noise)
    side = len(one.mean)
    covariance, pairs = known.over(side)
    lag = np.abs(np.arange(1 - side, side))
    near = np.maximum(lag[:, None], lag) <= NEAR_PX
    # the noise model's variance on the ground, and not that of the blocks: what rows share must cancel in x to the last percent
    variance = float(noise.variance_dn2(np.median(one.mean[[0, -1]])))
    here = np.where(near, covariance / known.variance_dn2, 0.0)
    around = np.where(near, 0.0, covariance * variance / known.variance_dn2)
    if near_alike is not None:
        middle = slice(side - 1 - NEAR_PX, side + NEAR_PX)
        here[middle, middle] = near_alike
    here[side - 1, side - 1] = 0.0  # the variance itself is that of the noise model
    ground = gain / sigma  # answers to DN, for what rows and columns share
    factor, clear = np.ones(len(gain)), 0.0
    for k in range(len(gain)):
        own, in_dn = lag_sums(gain[k]), lag_sums(ground[k])
        total = float((gain[k] ** 2).sum())
        excess = float((own * here).sum() + (in_dn * around).sum()) / total
        factor[k] = 1 + excess
        if k < 2:
            own[side - 1, side - 1] = 0.0
            by_chance = 2 * np.where(near, own, in_dn * variance) ** 2 / np.maximum(pairs, 1.0)
            clear = max(clear, abs(excess) * total / np.sqrt(by_chance[pairs > 0].sum()))
    x, y = gain[0], gain[1]
    cross = float((lag_sums(x, y) * here).sum() + (lag_sums(ground[0], ground[1]) * around).sum()) / np.sqrt((x**2).sum() * (y**2).sum())
    if noise.origin == "image":  # what the unknowns take of correlated noise is missing in the residuals that it was measured from
        taken = float((lag_sums(basis) * (here + around / variance)).sum())
        count = float(one.mask.sum())
        factor *= (count - len(gain)) / max(count - len(gain) - taken, 0.5 * count)
    return Spread(np.maximum(factor, LEAST_FACTOR), cross, clear > CLEAR_SIGMA)


def with_correlation(
    frame: np.ndarray, regions: Targets, targets: Targets, positions: Positions, noise: NoiseModel, kind: str, aperture_px: float
) -> tuple[Positions, float]:
    """Positions with a covariance that holds the correlation of the frame's noise; and the factor of their u, 1 where there is none.

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
    """
    from pixmetry.locate.template.template import PARAMETERS

    good = np.flatnonzero(
        np.isfinite(positions.var_x_px2) & ((positions.flags & (Flag.BORDER | Flag.OVERLAPPING | Flag.NOT_CONVERGED)) == 0)
    )
    known = correlation_of(frame, regions, noise.low_dn, noise.high_dn) if len(good) else None
    if known is None or known.variance_dn2 <= LEAST_SHARE * noise.constant_dn2:
        return positions, 1.0
    size = np.sqrt(targets.semi_major_px * targets.semi_minor_px)
    good = good[np.argsort(size[good], kind="stable")]
    count = 1 if size[good[-1]] < ALIKE * size[good[0]] else min(CLASSES, len(good))
    picked = good[np.rint((np.arange(count) + 0.5) / count * len(good) - 0.5).astype(int)]
    drawn = [_drawn(frame, targets, positions, i, kind, aperture_px) for i in picked]
    spreads = [spread_of(one, noise, known) for one in drawn]
    if not any(s.clear for s in spreads):
        return positions, 1.0
    level = float(np.median(noise.variance_dn2(targets.background_dn[good] + 0.5 * targets.amplitude_dn[good])))
    if not 1 / UNLIKE < level / known.variance_dn2 < UNLIKE:
        some = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), SAMPLE)).round().astype(int))]
        alike = residual_correlation([_drawn(frame, targets, positions, i, kind, aperture_px) for i in some], noise)
        spreads = [spread_of(one, noise, known, alike) for one in drawn]
    at = np.log(size[picked])

    def over_sizes(values: list[float]) -> np.ndarray:
        return np.interp(np.log(np.maximum(size, 1e-3)), at, values)

    factors = {name: over_sizes([float(s.factor[k]) for s in spreads]) for k, name in enumerate(PARAMETERS[kind])}
    fx, fy, cross = factors["x_px"], factors["y_px"], over_sizes([s.cross for s in spreads])
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
    return changed, float(np.median(np.sqrt(0.5 * (fx + fy))[good]))


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
        one = _drawn(frame, targets, positions, int(i), kind, aperture_px)
        factor[:, i] = np.maximum(spread_of(one, given, alone, residual_correlation([one], given)).factor[:2], 1.0)
    return replace(
        positions,
        var_x_px2=positions.var_x_px2 * factor[0],
        cov_xy_px2=positions.cov_xy_px2 * np.sqrt(factor[0] * factor[1]),
        var_y_px2=positions.var_y_px2 * factor[1],
    )


def _drawn(frame: np.ndarray, targets: Targets, positions: Positions, i: int, kind: str, aperture_px: float) -> Drawn:
    """One measured target as its template draws it."""
    from pixmetry.locate.template.template import PARAMETERS, PLANES, model
    from pixmetry.locate.template.template_fit import REACH, start_values

    one = targets[i : i + 1]
    # an ellipse's own unknowns follow from its axes and direction, which stand in the table
    shape = {n: positions.more[n][i : i + 1] for n in ("semi_major_px", "semi_minor_px", "angle_deg", "blur_px") if n in positions.more}
    one = replace(one, **shape)
    start, outer, edge = start_values(one, kind, aperture_px)
    names = (*PARAMETERS[kind], *PLANES)
    given = {"x_px": positions.x_px[i], "y_px": positions.y_px[i]} | {n: v[i] for n, v in positions.more.items() if n in names}
    values = {n: float(given.get(n, v)) for n, v in zip(names, start[0], strict=True)}
    reach = float(outer[0] + REACH * edge[0] + 1)
    half = int(np.ceil(reach))
    row, col = round(values["y_px"]), round(values["x_px"])
    local = values | {"x_px": values["x_px"] - col + half, "y_px": values["y_px"] - row + half}
    side = 2 * half + 1
    mean, jacobian = model(kind, np.array(list(local.values())), side, side, aperture_px=aperture_px)
    base = len(PARAMETERS[kind])
    ground, light = ((positions.flags[i] & f) != 0 for f in (Flag.UNEVEN_BACKGROUND, Flag.GRADIENT))
    used = [*range(base), *([base, base + 1] if ground else []), *([base + 2, base + 3] if light else [])]
    y, x = np.ogrid[:side, :side]
    mask = np.hypot(x - local["x_px"], y - local["y_px"]) <= reach
    rows, cols = np.arange(row - half, row + half + 1), np.arange(col - half, col + half + 1)
    mask &= ((rows >= 0) & (rows < frame.shape[0]))[:, None] & ((cols >= 0) & (cols < frame.shape[1]))
    seen = frame[np.ix_(np.clip(rows, 0, frame.shape[0] - 1), np.clip(cols, 0, frame.shape[1] - 1))].astype(float)
    return Drawn(mean, jacobian[used], mask, np.where(mask, seen - mean, 0.0))
