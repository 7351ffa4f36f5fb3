"""From the autocovariance of the noise to what filtered it, and to the variance that the shot noise had before.

The part of the noise that grows with light is white where it arises. Behind a linear filter h of unit sum its autocovariance is that of h,
and the sum over all lags is the variance before (the power at frequency zero passes unchanged). A median, a coder or a demosaicking has no
such law: then the noise does not tell the gain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from pixmetry.camera.noise_covariance import (
    CHARGE,
    LAGS,
    LINE,
    LINEAR,
    MEDIAN,
    MOSAIC,
    REACH,
    UNKNOWN,
    WHITE,
    NoiseCovariance,
    NoiseFilter,
    blur_kernel,
    charge_response,
    plane_of,
    response_to_white,
    sampling_covariance,
    unsharp_kernel,
)
from pixmetry.camera.observations import LevelMoments, PhotonTransfer, StackMoments
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates, effective_dof
from pixmetry.observe.mosaic import find_mosaic, shot_of_places
from pixmetry.observe.photon_transfer_fit import fit_photon_transfer
from pixmetry.observe.photon_transfer_levels import core_spread_dn2
from pixmetry.observe.photon_transfer_model import MINIMUM_DARK_VAR_DN2, QUANTISATION_DN2, rounding_error_vars, slope_error_var
from pixmetry.observe.sampled_line import sampled

MOST_CLIPPED = 0.002  # share of the pixels at the ends of the codes
LITTLE_MORE, FALLEN = 1.15, 0.75  # of light and variance from level to level: so much less where pixels are full
FOUND_Z, FOUND_PATTERN_Z = 4.2, 3.5  # of one of the twelve near lags; of the pattern of repelled charge: false in 1e-3 of cameras
PRESENT = 0.02  # chance, before anything is measured, that a camera has a filter or temporal noise reduction
REPELLED = 0.08  # the same of repelled charge that can be seen: most sensors have some, few so much
LARGEST_SHARE, LARGEST_LOSS, LARGEST_ALPHA = 0.2, 0.03, 0.9  # if there: all sizes up to this are equally likely
FIT_LEVEL = 1e-4  # chance of a worse fit below which a family is refused
NEAR = tuple(k for k, (j, i) in enumerate(LAGS) if 0 < max(abs(j), abs(i)) <= 2)
SHARPENING, BLUR, KERNEL, LOSS = (
    "unsharp mask",
    "Gaussian blur",
    "kernel of 3 × 3",
    "charge that repels charge",
)
BLUR_RADII = (1, 2, 3)
REACHES = (0.0, 0.4, 0.7, 1.0)  # px, of the repulsion that is looked for
SMALL = 0.05  # relative change of the gain up to which a correlation of unknown origin is taken as linear, at a u of its own size
WEAK = 0.03  # relative change of the gain up to which a filter stands back behind repelled charge that fits nearly as well
RIVAL = 5.0  # by how much of χ²/2 another family may fit worse that is not excluded
MOST_GROWTH = 0.2  # of the correlation, summed, from dark to bright: more than repelled charge does
# correlation of normal noise behind medians of 3 × 3 and of 5 × 5 pixels, by the smaller and the larger lag: from 2e7 simulated pixels
MEDIANS = {
    1: {(0, 1): 0.5715, (0, 2): 0.2708, (1, 1): 0.3665, (1, 2): 0.1783, (2, 2): 0.0882},
    2: {
        (0, 1): 0.7345, (0, 2): 0.5334, (0, 3): 0.3476, (0, 4): 0.1708, (1, 1): 0.5719, (1, 2): 0.4206, (1, 3): 0.2760, (1, 4): 0.1363,
        (2, 2): 0.3118, (2, 3): 0.2058, (2, 4): 0.1022, (3, 3): 0.1366, (3, 4): 0.0684, (4, 4): 0.0346,
    },
}  # fmt: skip
OF_MEDIAN = 0.02  # rounding and the skewness of the shot noise change these
ALONG_LINE_REL = 0.04  # of a fixed contrast: jitter of the rows in the mean of the frames, echoes later than the lags
RESOLVED = 10.0  # u of the shot variance of a level that counts
OF_PIXELS, OF_COLUMNS = ("prnu_pixel_rel", "dsnu_pixel_dn"), ("prnu_col_rel", "dsnu_col_dn")
OF_ROWS = ("prnu_row_rel", "dsnu_row_dn")
ASSUMED_DNL_LSB = 0.1  # standard deviation of the code widths of a grabber where they are not measured: a common limit of ±½ LSB is 5 of it
LEAST_DOUBT = 0.1  # of the gain's u: a smaller part adds less than 0.5 % to it


@dataclass(frozen=True)
class _ShotPart:
    """Autocovariance of the shot noise at all lags but (0, 0), fitted over the levels by its variance S: c = r S + q S²."""

    constant: np.ndarray  # r where q is taken as zero, shape (40,)
    constant_covariance: np.ndarray
    growing: np.ndarray  # q where r is taken as zero, 1/DN²
    growing_covariance: np.ndarray
    both: np.ndarray  # r, then q, shape (80,); r alone, shape (40,), with fewer than three levels
    both_covariance: np.ndarray
    gain: np.ndarray  # what makes r and q of the levels, shape (2, levels) or (1, levels)
    shot_dn2: np.ndarray  # S of the levels
    inside: tuple[np.ndarray, np.ndarray]  # means of the levels by rising size, and their variance in the margin over that of the frame
    inner: float  # shot variance inside of the margin over that of the whole frame, at equal light
    u_inner: float


def _shot_part(seen: NoiseCovariance) -> _ShotPart | None:
    pooled, pixels = seen.pooled_dn2(), float(np.prod(seen.frame_shape))
    used = seen.clipped <= MOST_CLIPPED
    bright, dark = used & seen.bright & ~_over_full(seen, pooled[:, 0]), used & ~seen.bright
    if not dark.any() and bright.sum() > 1:  # black is clipped: what the darkest of the light levels has more
        dark = bright & (seen.mean_dn == seen.mean_dn[bright].min())
        bright = bright & ~dark
    if not (bright.any() and dark.any()):
        return None
    pairs = seen.n_pairs.astype(float)
    black = np.average(pooled[dark], axis=0, weights=pairs[dark])
    black_covariance = sampling_covariance(black) / (pairs[dark].sum() * pixels)
    total, n = pooled[bright], pairs[bright] * pixels
    keep = total[:, 0] - black[0] > RESOLVED * np.sqrt(2 / n) * total[:, 0]
    total, n = total[keep], n[keep]
    shot = total - black
    s = shot[:, 0]
    if s.size == 0:
        return None
    noise = [sampling_covariance(c) / m for c, m in zip(total, n, strict=True)]
    weight = n / total[:, 0] ** 2

    def solve(design: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What makes the coefficients of the levels; these, by column of the design and lag; their covariance."""
        gain = np.linalg.solve(design.T @ (weight[:, None] * design), design.T * weight)
        values = gain @ shot[:, 1:]
        covariance = np.zeros((values.size, values.size))
        of_black = np.zeros((values.size, len(LAGS)))
        for level, own in enumerate(noise):
            # a variance of a level that is high by chance makes the ratios of all lags to it too low
            slope = np.hstack([-(design @ values)[level][:, None] / s[level], np.eye(len(LAGS) - 1)])
            covariance += np.kron(np.outer(gain[:, level], gain[:, level]), slope @ own @ slope.T)
            of_black += np.kron(gain[:, level][:, None], slope)
        return gain, values.ravel(), covariance + of_black @ black_covariance @ of_black.T

    constant, growing = solve(s[:, None])[1:], solve(s[:, None] ** 2)[1:]
    gain, both, both_covariance = solve(np.stack([s, s**2], axis=1) if s.size > 2 else s[:, None])
    frame, inside, var = (
        float((values[bright][keep] - np.average(values[dark], weights=pairs[dark])).sum())
        for values in (seen.mean_dn, seen.inner_mean_dn, seen.var_dn2)
    )
    inner = float(s.sum()) / var * frame / inside
    order = np.flatnonzero(used)[np.argsort(seen.mean_dn[used], kind="stable")]
    by_level = seen.mean_dn[order], pooled[order, 0] / np.maximum(seen.var_dn2[order], 1e-300)
    return _ShotPart(*constant, *growing, both, both_covariance, gain, s, by_level, inner, _u_of_border(seen, n.sum()))


def _over_full(seen: NoiseCovariance, var_dn2: Array) -> Flags:
    """Levels from the last before the variance breaks down while the mean hardly rises: pixels are full there, below the last code."""
    over = np.zeros(len(seen.mean_dn), bool)
    if seen.bright.all() or not seen.bright.any():
        return over
    light, order = seen.mean_dn - seen.mean_dn[~seen.bright].mean(), np.flatnonzero(seen.bright)
    order = order[np.argsort(light[order])]
    for low, high in zip(order[:-1], order[1:], strict=True):
        if light[high] < LITTLE_MORE * light[low] and var_dn2[high] < FALLEN * var_dn2[low]:
            over = seen.bright & (light >= light[low])
            break
    return over


def _u_of_border(seen: NoiseCovariance, products: float) -> float:
    """Scatter of a variance inside of the margin over that of the whole frame, from the share of the pixels that are left out."""
    rows, cols = seen.frame_shape
    left_out = 1 - rows * cols / ((rows + 2 * seen.margin_px) * (cols + 2 * seen.margin_px))
    return float(np.sqrt(2 * left_out / products))


@dataclass(frozen=True)
class _Family:
    """A set of ways of the shot noise through the camera."""

    kind: str
    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    starts: tuple[tuple[float, ...], ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    law: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]  # parameters, S -> variance before, autocovariance behind


def _of_kernel(kernel_of: Callable[..., np.ndarray]) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    def law(p: np.ndarray, shot_dn2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        correlation, power = response_to_white(kernel_of(*p.tolist()))
        return shot_dn2 / power, np.outer(shot_dn2, correlation[1:])

    return law


def _small_kernel(edge: float, corner: float) -> np.ndarray:
    """Kernel of 3 × 3 of unit sum, by its weights beside the middle and at the corners."""
    return np.array([[corner, edge, corner], [edge, 1 - 4 * edge - 4 * corner, edge], [corner, edge, corner]])


def _along_row(p: np.ndarray, shot_dn2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Any correlation along the row and none between rows, as behind an analogue line."""
    correlation = np.zeros(len(LAGS) - 1)
    correlation[:REACH] = p
    return shot_dn2 * (1 + 2 * p.sum()), np.outer(shot_dn2, correlation)


def _blur(radius_px: int) -> _Family:
    law = _of_kernel(lambda sigma_px: blur_kernel(sigma_px, radius_px))
    return _Family(LINEAR, f"{BLUR} of radius {radius_px} px", ("sigma_px",), ("px",), ((0.4,), (1.0,)), (0.15,), (16.0,), law)


def _families(largest_shot_dn2: float) -> tuple[_Family, ...]:
    def charge(p: np.ndarray, shot_dn2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return charge_response(p[0] / largest_shot_dn2, p[1], shot_dn2)

    three, four = ("amount", "sigma_px"), tuple(f"correlation_{k}" for k in range(1, REACH + 1))
    sharpening = _of_kernel(unsharp_kernel)
    return (
        _Family(CHARGE, LOSS, ("loss", "field_px"), ("1", "px"), ((0.03, 0.1), (0.03, 0.6)), (-0.5, 0.0), (0.5, 1.0), charge),
        _Family(LINEAR, SHARPENING, three, ("1", "px"), ((0.3, 0.7), (0.5, 1.2), (1.0, 2.0)), (1e-4, 0.3), (10.0, 2.6), sharpening),
        *(_blur(radius) for radius in BLUR_RADII),
        _Family(
            LINEAR, KERNEL, ("edge", "corner"), ("1", "1"), ((0.1, 0.05), (-0.1, -0.05)), (-1, -1), (0.3, 0.3), _of_kernel(_small_kernel)
        ),
        _Family(LINEAR, LINE, four, ("1",) * REACH, ((0.0,) * REACH,), (-1.0,) * REACH, (1.0,) * REACH, _along_row),
    )


@dataclass(frozen=True)
class _Match:
    """A family with its best parameters."""

    family: _Family
    values: np.ndarray
    covariance: np.ndarray
    cost: float  # χ²/2
    chance: float  # of a worse fit
    correlation: np.ndarray  # of the family in the dark, shape (40,)
    factor: float  # variance before over variance behind, in the mean of the levels
    u_factor: float


def _derivatives(law: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> Array:
    """Central differences, shape (values, parameters)."""
    steps = 1e-4 * np.maximum(np.abs(at), 0.1)
    return np.stack([(law(at + h) - law(at - h)) / (2 * h.sum()) for h in np.diag(steps)], axis=1)


def _match(family: _Family, part: _ShotPart, constant_alone: bool = False) -> _Match:
    """Generalised least squares on r and q; or on r, with q free, for a filter behind something that grows with the signal."""
    from scipy.optimize import least_squares
    from scipy.special import gammaincc

    n = len(LAGS) - 1 if constant_alone else part.both.size
    values, covariance, gain = part.both[:n], part.both_covariance[:n, :n], part.gain[: n // (len(LAGS) - 1)]
    root = np.linalg.inv(np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance))))

    def predicted(p: np.ndarray) -> Array:
        return (gain @ family.law(p, part.shot_dn2)[1]).ravel()

    def factor(p: np.ndarray) -> Array:
        return np.array([family.law(p, part.shot_dn2)[0].sum() / part.shot_dn2.sum()])

    bounds = (family.low, family.high)
    found = min((least_squares(lambda p: root @ (values - predicted(p)), x0, bounds=bounds) for x0 in family.starts), key=lambda f: f.cost)
    slopes = root @ _derivatives(predicted, found.x)
    own = np.linalg.pinv(slopes.T @ slopes, rcond=1e-10)
    change = _derivatives(factor, found.x)[0]
    chance = float(gammaincc((n - found.x.size) / 2, found.cost))
    correlation = family.law(found.x, np.full(1, 1e-9))[1][0] / 1e-9
    return _Match(
        family, found.x, own, float(found.cost), chance, correlation, float(factor(found.x)[0]), float(np.sqrt(change @ own @ change))
    )


def find_noise_filter(seen: NoiseCovariance | None, samples_per_pixel: float = 1.0) -> NoiseFilter | None:
    """What filtered the noise of a campaign; None where it holds no shot noise to tell it by.

    Parameters
    ----------
    seen : NoiseCovariance or None
    samples_per_pixel : float
        Of a frame grabber: its sampling clock over the pixel clock.

    Returns
    -------
    NoiseFilter or None

    Notes
    -----
    Nothing is said to be found unless a lag of up to two pixels, or the pattern of repelled charge, stands out by `FOUND_Z` u. Families
    are fitted by generalised least squares with Bartlett's covariance; one that fits worse than by a chance of `FIT_LEVEL` is refused. Of
    those that are left the best fit counts, and what another that fits nearly as well would make of the gain adds to u.
    """
    part = None if seen is None else _shot_part(seen)
    if seen is None or part is None:
        return None
    found = _at_pixel_rate(seen, part)
    return found if samples_per_pixel == 1 else sampled(found, samples_per_pixel)


def _at_pixel_rate(seen: NoiseCovariance, part: _ShotPart) -> NoiseFilter:
    """What filtered the noise, of one sample to a pixel."""
    plain = NoiseFilter(
        kind=WHITE,
        name="neighbours are not correlated",
        correlation=np.concatenate([[1.0], part.constant]),
        covariance=part.constant_covariance,
        growth_per_dn2=np.concatenate([[0.0], part.growing]),
        growth_covariance=part.growing_covariance,
        shot_dn2=part.shot_dn2,
    )
    if (mosaic := _of_mosaic(plain, seen, part)) is not None:
        return mosaic
    stands_out, doubt = _largest_z(part)
    return _explained(plain, part) if stands_out > 1 else replace(plain, u_factor=doubt)


def _of_mosaic(plain: NoiseFilter, seen: NoiseCovariance, part: _ShotPart) -> NoiseFilter | None:
    """A demosaicking: the variance of the original pixels over the mean of all; of the luminance no pixel is original."""
    used = seen.clipped <= MOST_CLIPPED
    bright, dark = used & seen.bright, used & ~seen.bright
    if not (bright.any() and dark.any()):
        return None
    shot, black, pixels = shot_of_places(seen, bright, dark)
    found = find_mosaic(shot, black, pixels)
    if found is None:
        return None
    settings = {"method": found.method, "output": found.output} | ({} if found.output == "luma" else {"pattern": found.pattern})
    kept = replace(
        plain, kind=UNKNOWN, name=f"demosaicking, {found.method}, stored colour {found.output}", fit=replace(plain.fit, settings=settings)
    )
    if not found.original.any():
        return replace(kept, factor=np.inf)
    of_shot, of_dark = (values[:, :, 0, REACH] for values in (shot, np.maximum(black, 0)))
    factor = float(of_shot[found.original].mean() / of_shot.mean())
    rounding = np.where(found.original, 0.0, QUANTISATION_DN2)  # interpolated values were rounded once more
    dark_factor = float(of_dark[found.original].mean() / max((of_dark - rounding).mean(), 1e-9))
    share = float(found.original.mean())
    u_factor = factor * float(np.hypot(np.sqrt(2 / (share * pixels)), part.u_inner))
    return replace(kept, kind=MOSAIC, factor=factor * part.inner, u_factor=u_factor, dark_factor=dark_factor * part.inner)


def _largest_z(part: _ShotPart) -> tuple[float, float]:
    """How far correlation stands out, and what a correlation that is too weak to be found would make of the variance.

    Returns
    -------
    float
        Over `FOUND_Z` for a single near lag, or over `FOUND_PATTERN_Z` for the pattern that repelled charge of any reach makes: the largest
        of these quotients.
    float
        Change of the factor by the nearest neighbours' correlation, or by that pattern, in the root mean square of what may be there; see
        `unseen_rms`.
    """
    near = [k - 1 for k in NEAR]
    single = np.abs(part.constant[near]) / np.sqrt(np.diag(part.constant_covariance)[near])
    weak, largest = 1e-3, float(part.shot_dn2.max())
    responses = [charge_response(weak / largest, reach, np.array([largest]))[1][0] for reach in REACHES]
    patterns = np.stack(responses, axis=1) / (weak * largest**2)
    weighed = np.linalg.solve(part.growing_covariance, patterns)
    power = (weighed * patterns).sum(axis=0)
    losses = (weighed * part.growing[:, None]).sum(axis=0) / power
    together = losses * np.sqrt(power)
    beside = [LAGS.index((0, 1)) - 1, LAGS.index((1, 0)) - 1]
    share = 2 * float(part.constant[beside].sum())
    u_share = 2 * float(np.sqrt(part.constant_covariance[np.ix_(beside, beside)].sum()))
    mean = float((part.shot_dn2**2).sum() / part.shot_dn2.sum() / largest)
    unseen = [unseen_rms(loss, root, LARGEST_LOSS, present=REPELLED) * mean for loss, root in zip(losses, power**-0.5, strict=True)]
    doubt = max(*unseen, unseen_rms(share, u_share, LARGEST_SHARE, both_signs=True))
    return max(float(single.max()) / FOUND_Z, float(together.max()) / FOUND_PATTERN_Z), doubt


def unseen_rms(estimate: float, u: float, largest: float, *, both_signs: bool = False, present: float = PRESENT) -> float:
    """Root mean square of an effect that does not stand out of its uncertainty.

    Parameters
    ----------
    estimate, u : float
        Of its size, where it is there.
    largest : float
        If it is there, all sizes up to this are equally likely, before anything is measured.
    both_signs : bool
        Whether it may be negative.
    present : float
        Chance, before anything is measured, that it is there.

    Notes
    -----
    With the chance ``present`` that the effect is there, and the likelihoods of the estimate with and without it, Bayes' rule gives the
    chance P of it; the root mean square is √(P ⟨x²⟩) over the posterior of its size x. An estimate of zero leaves next to nothing, one of
    two u a part, and one of four u all of it: what one camera in fifty has is not taken for what every one has.

    Examples
    --------
    >>> [round(unseen_rms(z * 0.004, 0.004, 0.9), 4) for z in (0, 2, 3, 4)]
    [0.0, 0.0004, 0.0018, 0.0105]
    """
    low = -largest if both_signs else 0.0
    x = np.linspace(max(low, estimate - 8 * u), max(min(largest, estimate + 8 * u), low), 801)
    likely = np.exp(-0.5 * ((x - estimate) / u) ** 2)
    step = x[1] - x[0]
    odds = present / (1 - present) * float(likely.sum()) * step / (largest - low) / max(float(np.exp(-0.5 * (estimate / u) ** 2)), 1e-300)
    square = float((likely * x**2).sum() / max(float(likely.sum()), 1e-300))
    return float(np.sqrt(odds / (1 + odds) * square))


def _explained(plain: NoiseFilter, part: _ShotPart) -> NoiseFilter:
    """The family that explains the correlation, or what is known without one."""
    families = _families(float(part.shot_dn2.max()))
    matches = [m for m in (_match(family, part) for family in families) if m.chance > FIT_LEVEL]
    if matches:
        best = min(matches, key=_price)
        rivals = [m for m in matches if _price(m) < _price(best) + RIVAL]
        if abs(best.factor - 1) < WEAK:  # every sensor repels charge, and nobody makes a filter that changes so little
            best = min((m for m in rivals if m.family.kind == CHARGE), key=_price, default=best)
        doubt = max(abs(m.factor - best.factor) for m in rivals if m.family.kind == best.family.kind)
        others = [m for m in rivals if m.family.kind != best.family.kind]
        other = _as_found(plain, min(others, key=_price), part, 0.0) if others else None
        return replace(_as_found(plain, best, part, doubt), rival=other)
    growth = _growth(part)
    if part.both.size > len(LAGS) and -3 * growth[1] < growth[0] < MOST_GROWTH:
        filters = [m for m in (_match(f, part, constant_alone=True) for f in families if f.kind == LINEAR) if m.chance > FIT_LEVEL]
        if filters:
            best = min(filters, key=_price)
            name = f"{best.family.name}, behind something that grows with the signal"
            return replace(_as_found(plain, best, part, growth[1]), name=name, growth=growth[0])
    if (radius := _median_radius(part)) is not None:
        fit = Estimates.from_rows([("radius_px", float(radius), 0.0, np.inf, "px")])
        return replace(plain, kind=UNKNOWN, name=f"{MEDIAN} of radius {radius} px", fit=fit, factor=np.inf)
    near = np.array([max(abs(j), abs(i)) <= 2 for j, i in LAGS[1:]])
    share = 2 * float(part.constant[near].sum())
    u_share = 2 * float(np.sqrt(part.constant_covariance[np.ix_(near, near)].sum()))
    return replace(plain, kind=UNKNOWN, name="no linear filter fits", factor=1 + share, u_factor=float(np.hypot(share, u_share)))


def _median_radius(part: _ShotPart) -> int | None:
    """Radius of the median whose correlation this is, within `OF_MEDIAN`; None of none."""
    for radius, table in MEDIANS.items():
        expected = np.array([table.get((min(j, abs(i)), max(j, abs(i))), 0.0) for j, i in LAGS[1:]])
        if np.abs(part.constant - expected).max() < OF_MEDIAN + 5 * float(np.sqrt(np.diag(part.constant_covariance).max())):
            return radius
    return None


def _price(match: _Match) -> float:
    """χ²/2 and the number of parameters (Akaike); a filter without a name only counts where it fits far better."""
    return match.cost + match.values.size + 3.0 * (match.family.name in (KERNEL, LINE))


def _as_found(plain: NoiseFilter, best: _Match, part: _ShotPart, doubt: float) -> NoiseFilter:
    """What is known with the family that fits best; repelled charge sees no border."""
    if best.family.kind == CHARGE:
        best = _over_reaches(best, part)
        inner, u_inner = 1.0, 0.0
    else:
        inner, u_inner = part.inner, part.u_inner
    on_line = best.family.name == LINE
    if on_line:
        inner = 1.0
    fit = Estimates(best.family.names, best.values, best.covariance, np.full(best.values.size, np.inf), best.family.units)
    return replace(
        plain,
        inside=part.inside if on_line else None,
        kind=best.family.kind,
        name=best.family.name,
        fit=fit,
        factor=best.factor * inner,
        u_factor=float(np.linalg.norm([best.u_factor, doubt, u_inner])),
        row_factor=_line_factor(best.correlation, axis=0),
        column_factor=_line_factor(best.correlation, axis=1),
    )


def _over_reaches(best: _Match, part: _ShotPart) -> _Match:
    """The same with the u of loss and factor over all reaches of the repulsion, each with its likelihood: far from a parabola."""
    largest = float(part.shot_dn2.max())

    def at(reach: float) -> _Match:
        def law(p: np.ndarray, shot_dn2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return charge_response(p[0] / largest, reach, shot_dn2)

        return _match(_Family(CHARGE, LOSS, ("loss",), ("1",), ((float(best.values[0]),),), (-0.5,), (0.5,), law), part)

    fixed = [at(reach) for reach in np.linspace(0.0, 1.0, 11).tolist()]
    u_loss = np.array([m.covariance[0, 0] for m in fixed]) ** 0.5
    weight = u_loss * np.exp(best.cost - np.array([m.cost for m in fixed]))
    loss, factor = (np.average(squares, weights=weight) for squares in (
        [(m.values[0] - best.values[0]) ** 2 + m.covariance[0, 0] for m in fixed],
        [(m.factor - best.factor) ** 2 + m.u_factor**2 for m in fixed],
    ))  # fmt: skip
    covariance = best.covariance.copy()
    covariance[0] *= np.sqrt(loss / covariance[0, 0])
    covariance[:, 0] = covariance[0]
    covariance[0, 0] = loss
    return replace(best, covariance=covariance, u_factor=float(np.sqrt(factor)))


def _line_factor(correlation: np.ndarray, axis: int) -> float:
    """1 + the correlations along a row (axis 0: lags of no row) or a column, on both sides."""
    return 1 + 2 * float(sum(value for lag, value in zip(LAGS[1:], correlation, strict=True) if lag[axis] == 0))


def _growth(part: _ShotPart) -> tuple[float, float]:
    """What the sum over the near lags gains from the dark to the brightest level, over the variance; with u."""
    if part.both.size == len(LAGS) - 1:
        return 0.0, 0.0
    near = np.concatenate([np.zeros(len(LAGS) - 1, bool), [max(abs(j), abs(i)) <= 2 for j, i in LAGS[1:]]])
    scale = 2 * float(part.shot_dn2.max())
    return scale * float(part.both[near].sum()), scale * float(np.sqrt(part.both_covariance[np.ix_(near, near)].sum()))


def before_correlation(spatial: Estimates, found: NoiseFilter, shot_dn2: float) -> Estimates:
    """The contrasts of single pixels as they were before what correlates neighbours evened them out as it does shot noise.

    Charge that repels charge evens out the response alone, a filter the offsets too.

    Parameters
    ----------
    spatial : Estimates
        Of `pixmetry.observe.spatial_fit.fit_spatial`.
    found : NoiseFilter
        Where nothing was found, what may be there adds to u.
    shot_dn2 : float
        Shot variance of the stack of bright frames.
    """
    if found.kind == UNKNOWN and not found.name.startswith(("demosaicking", MEDIAN)):
        why = f"what correlates neighbouring pixels ({found.name}) changes the pattern too, and by how much is not told"
        across = np.array([j > 0 for j, _ in LAGS[1:]])  # a filter along the rows leaves the means of rows as they are
        u_each = np.sqrt(np.diag(found.covariance))
        rows = () if (np.abs(found.correlation[1:]) <= FOUND_Z * u_each)[across].all() and u_each.any() else OF_ROWS
        lost = [n for n in (*OF_PIXELS, *OF_COLUMNS, *rows) if n in spatial]
        kept = spatial.select([n for n in spatial.names if n not in lost])
        return replace(kept, reasons={**kept.reasons, **dict.fromkeys(lost, why)})
    if found.kind not in (CHARGE, WHITE, LINEAR) or shot_dn2 <= 0:
        return spatial
    scale, u = 1.0, 0.5 * found.u_factor
    if found.kind == CHARGE:
        loss, reach = found.fit["loss"], found.fit["field_px"]
        before = charge_response(loss.value / float(found.shot_dn2.max()), reach.value, np.array([shot_dn2]))[0][0] / shot_dn2
        scale, u = float(np.sqrt(before)), 0.5 * loss.u * shot_dn2 / float(found.shot_dn2.max())
    evened = ["prnu_pixel_rel"]
    if found.kind == LINEAR:
        scale, u = float(np.sqrt(found.factor)), 0.5 * found.u_factor / found.factor
        if found.along_row:
            u = float(np.hypot(u, ALONG_LINE_REL))
        evened += ["dsnu_pixel_dn", *(OF_COLUMNS if found.along_row else ())]
    own = np.array([name in evened for name in spatial.names])
    factor = np.where(own, scale, 1.0)
    more = np.where(own, spatial.values * factor * u, 0.0)
    return replace(
        spatial,
        values=spatial.values * factor,
        covariance=spatial.covariance * np.outer(factor, factor) + np.outer(more, more),
    )


L = TypeVar("L", LevelMoments, StackMoments)


def before_filter(
    series: PhotonTransfer, dark: StackMoments | None, bright: StackMoments | None, found: NoiseFilter, shift: float = 0.0
) -> tuple[PhotonTransfer, StackMoments | None, StackMoments | None]:
    """The white mean squares of levels and stacks as they were before the filter; nothing else is changed.

    A filter of codes has smoothed the noise in the dark and the rounding of the converter with it, and rounds once more; one in front of
    the converter has not. ``shift`` is added to the factor.
    """
    levels = series.dark.ms_pixel_dn2 if series.dark.ms_pixel_dn2.size else np.array([np.nan if dark is None else dark.ms_pixel_dn2])
    black = float(np.average(levels, weights=series.dark.n_frames - 1.0 if series.dark.ms_pixel_dn2.size else None))
    after = QUANTISATION_DN2 if found.along_row else 0.0
    again = QUANTISATION_DN2 * (0.5 if found.kind == MOSAIC else 1.0)  # one half of the pixels is original

    def unfiltered_lines(ms_dn2: Any, var_dn2: Any, before_dn2: Any, of_line: float, pixels: int) -> Any:
        """Mean squares of rows or columns: the white noise before, and what lines have in common before the filter across them."""
        if found.kind in (CHARGE, WHITE):
            return ms_dn2
        in_common = ms_dn2 - var_dn2 * of_line / pixels
        return before_dn2 / pixels + in_common * (found.factor + shift) / found.clock_factor / of_line

    def unfiltered_level(level: L, white_dn2: Any) -> L:
        rows, cols = series.frame_shape
        return replace(
            level,
            ms_pixel_dn2=white_dn2,
            ms_row_dn2=unfiltered_lines(level.ms_row_dn2, level.ms_pixel_dn2, white_dn2, found.row_factor, cols),
            ms_col_dn2=unfiltered_lines(level.ms_col_dn2, level.ms_pixel_dn2, white_dn2, found.column_factor, rows),
        )

    def away_from_borders(level: LevelMoments | StackMoments) -> Any:
        if found.inside is None:
            return level.ms_pixel_dn2
        return level.ms_pixel_dn2 * np.interp(level.mean_dn, *found.inside)

    def unfiltered_dark(var_dn2: np.ndarray) -> np.ndarray:
        if found.kind in (CHARGE, WHITE):
            return var_dn2
        factor = found.factor if found.dark_factor is None else found.dark_factor
        unfiltered: Array = np.maximum(var_dn2 - again, 0.0) * (factor + shift) + after
        return unfiltered

    def unfiltered(var_dn2: np.ndarray) -> np.ndarray:
        shot = np.asarray(var_dn2 - black)
        return unfiltered_dark(np.asarray(black)) + np.where(shot > 0, found.variance_before(np.maximum(shot, 0.0), shift), shot)

    before = replace(
        series,
        dark=unfiltered_level(series.dark, unfiltered_dark(away_from_borders(series.dark))),
        bright=unfiltered_level(series.bright, unfiltered(away_from_borders(series.bright))),
    )
    stacks = [
        None if stack is None else unfiltered_level(stack, float(law(np.asarray(away_from_borders(stack)))))
        for stack, law in ((dark, unfiltered_dark), (bright, unfiltered))
    ]
    return before, stacks[0], stacks[1]


def fit_unfiltered(
    series: PhotonTransfer,
    dark: StackMoments | None,
    bright: StackMoments | None,
    dnl_lsb: float,
    found: NoiseFilter | None,
    alpha_rms: float = 0.0,
) -> Estimates:
    """The joint fit of `fit_photon_transfer` to the variances before the filter, with the filter's u.

    Parameters
    ----------
    series : PhotonTransfer
    dark, bright : StackMoments or None
    dnl_lsb : float
    found : NoiseFilter or None
    alpha_rms : float
        Share α of the frame before that may be in each frame unseen: the mean squares of differences are then (1 − α)²/(1 + α) ≈ 1 − 3α of
        those of the camera.

    Raises
    ------
    MeasureError
        As there; and behind a filter that is not linear, where no variance tells the gain.
    """
    if found is None:
        found = NoiseFilter()
    if found.kind == UNKNOWN and abs(found.factor - 1) > SMALL:
        what = "a median or another noise reduction, a correction of defects, a coder such as JPEG, or a demosaicking changed it"
        named = np.isinf(found.factor)
        raise MeasureError(
            "the noise of neighbouring pixels is correlated, and not as behind a linear filter: "
            f"{f'this is a {found.name}' if named else what}, and its variance does not tell the gain",
            where="photon transfer",
            value=f"correlation of neighbours {found.correlation[1]:.2g}",
            allowed="none, or that of a linear filter",
            remedy="take raw frames without noise reduction, sharpening, demosaicking and compression",
        )
    white = found.kind == WHITE
    frames = (series, dark, bright)
    unfiltered = frames if white else before_filter(*frames, found)
    here = fit_photon_transfer(*unfiltered, dnl_lsb)
    reasons, changes = [], []
    if not white:
        times = f"the shot variance before it is {found.factor:.4g} ± {found.u_factor:.2g} times that behind it"
        reasons.append(f"corrected for what correlates neighbouring pixels ({found.name}): {times}")
    u_gain = here["gain_dn_per_e"].u / here["gain_dn_per_e"].value
    if not white or found.u_factor > LEAST_DOUBT * u_gain:
        changes.append(_change(here, fit_photon_transfer(*before_filter(*frames, found, found.u_factor), dnl_lsb)))
        if white:
            what = "a correlation of neighbours that is too weak to be told from none"
            reasons.append(f"u contains {found.u_factor:.2g} of the shot variance for {what}")
    if found.rival is not None:
        changes.append(_change(here, fit_photon_transfer(*before_filter(*frames, found.rival), dnl_lsb)))
        reasons.append(f"u contains what it would be with another cause that is not excluded ({found.rival.name})")
    if 3 * alpha_rms > LEAST_DOUBT * u_gain:
        changes.append(_change(here, fit_photon_transfer(*_scaled(*unfiltered, 1 + 3 * alpha_rms), dnl_lsb)))
        what = "a correlation of successive frames that is too weak to be told from none (temporal noise reduction)"
        reasons.append(f"u contains {3 * alpha_rms:.2g} of all variances for {what}")
    here = _with_hidden_noise(here, series, found)
    if found.along_row:
        stretched, why = _by_code_widths(here, series, dark, dnl_lsb)
        changes += stretched
        here = replace(here, reasons={**here.reasons, **{n: "; ".join(filter(None, (here.reasons.get(n, ""), t))) for n, t in why.items()}})
    if not changes:
        return here
    # variances of correlated pixels scatter like those of fewer pixels (Bartlett)
    fewer = float((plane_of(found.correlation) ** 2).sum()) if found.kind == LINEAR else 1.0
    parts = np.stack([fewer * here.u**2, *(c**2 for c in changes)], axis=1)
    dof = effective_dof(parts, np.stack([here.dof, *(np.full(len(here), np.inf) for _ in changes)], axis=1))
    covariance = fewer * here.covariance + sum(np.outer(c, c) for c in changes)
    reason = "; ".join(filter(None, (*reasons, here.reasons.get("gain_dn_per_e", ""))))
    return replace(here, covariance=covariance, dof=dof, reasons={**here.reasons, "gain_dn_per_e": reason})


def _by_code_widths(
    here: Estimates, series: PhotonTransfer, dark: StackMoments | None, dnl_lsb: float
) -> tuple[list[Array], dict[str, str]]:
    """What unequal codes do to the noise in the dark, which a line made small before it came to the converter; and its reason."""
    levels = series.dark
    if not levels.ms_pixel_dn2.size:
        return [], {}
    var = max(float(levels.ms_pixel_dn2.mean()) - QUANTISATION_DN2, QUANTISATION_DN2)
    dither = float(levels.ms_row_dn2.mean() + levels.ms_col_dn2.mean()) + core_spread_dn2(dark)
    dnl = dnl_lsb or ASSUMED_DNL_LSB
    of_lines = float(np.sqrt(slope_error_var(var, dither, dnl)))
    of_pixels = 0.5 * float(np.sqrt(rounding_error_vars(np.array(var), dither, dnl)[1])) / var
    shares = {"dark_noise_e": of_pixels, "row_noise_e": of_lines, "column_noise_e": of_lines}
    shares = {n: share for n, share in shares.items() if n in here and n not in here.limits}
    changes = [np.where(np.array(here.names) == n, share * here.values, 0.0) for n, share in shares.items()]
    what = "as measured" if dnl_lsb else "assumed, for they are not measured"
    why = {n: f"u contains {share:.2g} of it for codes of unequal width ({dnl:.2g} LSB, {what})" for n, share in shares.items()}
    return changes, why


def _change(here: Estimates, there: Estimates) -> Array:
    """What another assumption makes of the values; 0 where it makes a limit of them."""
    same = (there[n].value - here[n].value if n in there and there[n].kind == here[n].kind else 0.0 for n in here.names)
    return np.array(list(same))


def _scaled(
    series: PhotonTransfer, dark: StackMoments | None, bright: StackMoments | None, factor: float
) -> tuple[PhotonTransfer, StackMoments | None, StackMoments | None]:
    """All temporal mean squares of pixels, rows and columns times a factor."""

    def scaled(level: L) -> L:
        return replace(
            level,
            ms_pixel_dn2=level.ms_pixel_dn2 * factor,
            ms_row_dn2=level.ms_row_dn2 * factor,
            ms_col_dn2=level.ms_col_dn2 * factor,
        )

    stacks = [None if stack is None else scaled(stack) for stack in (dark, bright)]
    return replace(series, dark=scaled(series.dark), bright=scaled(series.bright)), stacks[0], stacks[1]


def _with_hidden_noise(fit: Estimates, series: PhotonTransfer, found: NoiseFilter) -> Estimates:
    """The noise in the dark as a limit where the filter made it smaller than rounding shows: 0.40/K behind it (EMVA 1288 R4.0 eq. 54)."""
    levels = series.dark.ms_pixel_dn2
    if found.kind != LINEAR or not levels.size or levels.mean() >= MINIMUM_DARK_VAR_DN2:
        return fit
    bound = 0.40 * float(np.sqrt(found.factor)) / fit["gain_dn_per_e"].value
    names = [n for n in ("dark_noise_e", "row_noise_e", "column_noise_e") if n in fit]
    values, covariance = fit.values.copy(), fit.covariance.copy()
    for i in map(fit.index, names):
        values[i] = bound
        covariance[i], covariance[:, i] = 0.0, 0.0
        covariance[i, i] = bound**2 / 12
    why = f"behind the filter the dark variance is below {MINIMUM_DARK_VAR_DN2} DN², where rounding hides it: bound 0.40 DN there"
    return replace(
        fit, values=values, covariance=covariance, limits=fit.limits | set(names), reasons={**fit.reasons, **dict.fromkeys(names, why)}
    )
