"""Autocovariance of the temporal noise: what neighbouring pixels share, at every light level, with its sampling law."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates

ROUNDED_AWAY = 2.0
REACH = 4  # px; farthest lag to each side
LAGS = tuple((j, i) for j in range(REACH + 1) for i in range(-REACH, REACH + 1) if j > 0 or i >= 0)  # rows and columns; (0, 0) first
WHITE, LINEAR, CHARGE, MOSAIC, UNKNOWN = "white", "linear", "charge", "mosaic", "unknown"
MEDIAN = "median"
LINE = "filter along the row"


@dataclass(frozen=True)
class NoiseCovariance:
    """Autocovariance of the temporal noise of groups of frames, from the differences of frames 2k and 2k + 1.

    The means of rows and columns of every difference are taken out, so noise common to a line does not count.

    Parameters
    ----------
    bright : ndarray, shape (groups,), bool
        False: dark frames.
    stack : ndarray, shape (groups,), bool
        Whether the group is a stack of many frames.
    exposure_s, mean_dn, inner_mean_dn : ndarray, shape (groups,)
        The means of the frame, and inside of the margin.
    clipped : ndarray, shape (groups,)
        Share of the pixels at the lowest or the highest code.
    n_pairs : ndarray, shape (groups,)
    covariance_dn2 : ndarray, shape (groups, 2, 2, 5, 9), DN²
        ``[g, r, c, j, 4 + i]``: mean product of the noise at (y, x) and at (y + j, x + i) over the pixels of row parity r and column
        parity c, for one frame (half of that of a difference).
    var_dn2 : ndarray, shape (groups,), DN²
        White temporal variance over the whole frame; the other values are from inside of a margin, where filters see no border.
    successive_dn2 : ndarray, shape (groups, 2), DN²
        Half the mean square of the difference of each frame from the next, and from the next but one, without what rows and columns have
        in common; NaN where the frames are no stack.
    n_successive : ndarray, shape (groups,)
        Number of frames, one after the other, that this is from.
    frame_shape : (int, int)
        Without the margin.
    margin_px : int
    """

    bright: np.ndarray
    stack: np.ndarray
    exposure_s: np.ndarray
    mean_dn: np.ndarray
    inner_mean_dn: np.ndarray
    clipped: np.ndarray
    n_pairs: np.ndarray
    covariance_dn2: np.ndarray
    var_dn2: np.ndarray
    successive_dn2: np.ndarray
    n_successive: np.ndarray
    frame_shape: tuple[int, int]
    margin_px: int

    def pooled_dn2(self) -> np.ndarray:
        """Mean over the four places of the pattern at each of `LAGS`, shape (groups, 41), DN²."""
        mean = self.covariance_dn2.mean(axis=(1, 2))
        return np.stack([mean[:, j, REACH + i] for j, i in LAGS], axis=1)

    def spectrum_dn2(self, group: int, frequency_y: np.ndarray, frequency_x: np.ndarray) -> np.ndarray:
        """Power spectrum of one group's noise, Σ C(lag) cos 2π(lag·frequency), at frequencies in cycles per pixel of equal shapes, DN²."""
        spectrum = np.zeros(np.broadcast(frequency_y, frequency_x).shape)
        for (j, i), value in zip(LAGS, self.pooled_dn2()[group], strict=True):
            spectrum += (1 if (j, i) == (0, 0) else 2) * value * np.cos(2 * np.pi * (j * frequency_y + i * frequency_x))
        return spectrum


@dataclass(frozen=True)
class NoiseFilter:
    """What the autocovariance says of the way of the shot noise to the stored numbers.

    Parameters
    ----------
    kind : str
        ``"white"``: neighbours are not correlated; ``"linear"``: a linear filter of unit sum smoothed or sharpened all noise;
        ``"charge"``: the correlation grows in proportion to the signal, as the brighter-fatter effect does; ``"mosaic"``: a demosaicking,
        whose original pixels are as the converter gave them; ``"unknown"``: a correlation of no such kind, as behind a median or a coder.
    name : str
        The family of filters that fits, in words; of ``"unknown"`` what speaks against the others.
    fit : Estimates
        Parameters of that family, as the module that found it names them; of a demosaicking the settings.
    factor, u_factor : float
        Variance of the shot noise before the filter over that of one pixel of the frame behind it, in the mean of the levels. Of
        ``"white"`` 1, and what a correlation that may be there would change.
    row_factor, column_factor : float
        Variance of the means of rows and of columns behind the filter, over that of independent pixels with the variance behind it.
    dark_factor : float or None
        The same of the noise in the dark, where it is not ``factor``.
    clock_factor : float
        What of ``factor`` comes from sampling at another rate than that of the pixels: it changes no noise that a row has in common.
    growth : float
        What the factor gains, beside that, from dark to the brightest level.
    correlation : ndarray, shape (41,)
        Of the shot noise, at each of `LAGS`; the first is 1.
    covariance : ndarray, shape (40, 40)
        Of the correlations at all lags but the first.
    growth_per_dn2 : ndarray, shape (41,)
        What the correlation gains for each DN² of shot variance where it has no constant part; the first is 0.
    growth_covariance : ndarray, shape (40, 40)
    shot_dn2 : ndarray, shape (levels,)
        Shot variance of the levels that were used, DN².
    rival : NoiseFilter or None
        Another kind that fits nearly as well.
    inside : tuple of two ndarray of shape (levels,), or None
        Of a filter along the row: means of the levels, and variance away from the borders of the frame over that of the whole frame. A line
        that jitters adds noise where it rises from black, more than in proportion to the light; ``factor`` is then that away from them.
    """

    kind: str = WHITE
    name: str = ""
    fit: Estimates = field(default_factory=Estimates.empty)
    factor: float = 1.0
    u_factor: float = 0.0
    row_factor: float = 1.0
    column_factor: float = 1.0
    dark_factor: float | None = None
    clock_factor: float = 1.0
    growth: float = 0.0
    correlation: np.ndarray = field(default_factory=lambda: np.eye(1, len(LAGS))[0])
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((len(LAGS) - 1, len(LAGS) - 1)))
    growth_per_dn2: np.ndarray = field(default_factory=lambda: np.zeros(len(LAGS)))
    growth_covariance: np.ndarray = field(default_factory=lambda: np.zeros((len(LAGS) - 1, len(LAGS) - 1)))
    shot_dn2: np.ndarray = field(default_factory=lambda: np.zeros(0))
    rival: NoiseFilter | None = None
    inside: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def along_row(self) -> bool:
        """Whether it is a filter along the row, as of an analogue line."""
        return self.kind == LINEAR and self.name.startswith(LINE)

    def variance_before(self, shot_dn2: np.ndarray, shift: float = 0.0) -> np.ndarray:
        """Shot variance before the filter from that behind it, DN², any shape; with ``shift`` added to the factor."""
        if self.kind == CHARGE:
            loss, reach = self.fit["loss"].value / self.shot_dn2.max(), self.fit["field_px"].value
            before = charge_response(loss, reach, np.ravel(shot_dn2))[0].reshape(np.shape(shot_dn2))
            moved: Array = before + shift * shot_dn2**2 * self.shot_dn2.sum() / (self.shot_dn2**2).sum()
            return moved
        growth = self.clock_factor * self.growth * shot_dn2 / self.shot_dn2.max() if self.growth else 0.0
        scaled: Array = shot_dn2 * (self.factor + shift + growth)
        return scaled


def sampling_covariance(autocovariance: np.ndarray) -> np.ndarray:
    """Covariance of mean lag products of normal noise, times the number of products (Bartlett's formula).

    Parameters
    ----------
    autocovariance : ndarray, shape (41,)
        At each of `LAGS`; taken as 0 beyond.

    Returns
    -------
    ndarray, shape (41, 41)
        P(k − l) + P(k + l), where P is the autocovariance folded with itself (M. S. Bartlett, Suppl. J. R. Stat. Soc. 8, 27, 1946).
    """
    from scipy.signal import fftconvolve

    plane = plane_of(autocovariance)
    folded = fftconvolve(plane, plane)  # lags up to ± 2 REACH
    lags = np.array(LAGS)
    minus, plus = lags[:, None] - lags, lags[:, None] + lags
    covariance: Array = (
        folded[minus[..., 0] + 2 * REACH, minus[..., 1] + 2 * REACH] + folded[plus[..., 0] + 2 * REACH, plus[..., 1] + 2 * REACH]
    )
    return covariance


def frame_correlation(seen: NoiseCovariance, group: int) -> tuple[float, float]:
    """Correlation α of the noise of successive frames of one stack, and its u; pixels that neighbours correlate count for fewer."""
    pooled = seen.pooled_dn2()[group]
    fewer = float((plane_of(pooled) ** 2).sum() / pooled[0] ** 2)
    one, two = seen.successive_dn2[group]
    return successive_correlation(float(one), float(two), int(seen.n_successive[group]), float(np.prod(seen.frame_shape)) / fewer)


def successive_correlation(one_dn2: float, two_dn2: float, frames: int, pixels: float) -> tuple[float, float]:
    """Correlation α of the noise of successive frames, if each frame holds a share α of the one before; and its u.

    Parameters
    ----------
    one_dn2, two_dn2 : float
        Half the mean square of the differences of frames one and two apart.
    frames : int
    pixels : float
        Independent ones.

    Notes
    -----
    With D_j half the mean square of differences j frames apart, D₂/D₁ = (1 − α²)/(1 − α) = 1 + α. The rounding of every frame, 1/12, is
    no part of that. u is that of the ratio of two quadratic forms of normal noise, Var xᵀAx = 2 tr(AΣAΣ), for independent pixels.
    A share too small to move a code is rounded away: that may take up to twice the rounding's share of the noise from α, and enters u.
    """
    one, two = np.maximum(np.array([one_dn2, two_dn2]) - 1 / 12, 1e-9)
    alpha = two / one - 1
    held = float(np.clip(alpha, -0.9, 0.98))
    scale = one / (1 - held)  # variance of the noise
    sigma = scale * held ** np.abs(np.subtract.outer(np.arange(frames), np.arange(frames))) + np.eye(frames) / 12
    forms = []
    for lag in (1, 2):
        steps = np.eye(frames - lag, frames, lag) - np.eye(frames - lag, frames)
        forms.append(steps.T @ steps / (2 * (frames - lag)))
    ratio = (forms[1] - (1 + alpha) * forms[0]) / one @ sigma
    scatter = float(np.sqrt(2 * np.trace(ratio @ ratio) / pixels))
    return float(alpha), float(np.hypot(scatter, ROUNDED_AWAY / 12 / one))


SHARED_Z, LEAST_SHARED = 5.0, 0.005


def shared_by_frames(seen: NoiseCovariance) -> tuple[float, float]:
    """Correlation of the noise of successive bright frames, and its u: of the stack in which it stands out most; (0, ∞) without a stack."""
    groups = np.flatnonzero(seen.bright & (seen.n_successive > 3) & (seen.clipped <= 0.002))
    return max((frame_correlation(seen, int(g)) for g in groups), key=lambda found: found[0] / found[1], default=(0.0, np.inf))


def frames_share_noise(seen: NoiseCovariance) -> bool:
    """Whether the noise of successive bright frames is so correlated that the mean squares of their differences are too small."""
    alpha, u = shared_by_frames(seen)
    return alpha > max(SHARED_Z * u, LEAST_SHARED)


def plane_of(values: np.ndarray) -> np.ndarray:
    """Values at `LAGS` as a symmetric array of all lags, shape (9, 9), lag (0, 0) in the middle."""
    plane = np.zeros((2 * REACH + 1, 2 * REACH + 1))
    for (j, i), value in zip(LAGS, values, strict=True):
        plane[REACH + j, REACH + i] = plane[REACH - j, REACH - i] = value
    return plane


def gaussian_half(sigma_px: float, reach: int) -> np.ndarray:
    """Sampled Gaussian from its middle to `reach` pixels, shape (reach + 1,), of sum 1 over both sides."""
    half = np.exp(-0.5 * (np.arange(reach + 1) / sigma_px) ** 2)
    weights: Array = half / (2 * half.sum() - half[0])
    return weights


def blur_kernel(sigma_px: float, reach: int) -> np.ndarray:
    """Gaussian weights of a square, shape (2 reach + 1, 2 reach + 1), of sum 1."""
    half = gaussian_half(sigma_px, reach)
    line = np.concatenate([half[:0:-1], half])
    return np.outer(line, line)


def unsharp_kernel(amount: float, sigma_px: float) -> np.ndarray:
    """δ + amount (δ − Gaussian), which reaches to three standard deviations."""
    reach = int(np.ceil(3 * sigma_px))
    kernel = -amount * blur_kernel(sigma_px, reach)
    kernel[reach, reach] += 1 + amount
    return kernel


def response_to_white(kernel: np.ndarray) -> tuple[np.ndarray, float]:
    """Autocovariance at `LAGS` of white noise of variance 1 behind a filter, over that at lag (0, 0); and the variance there."""
    from scipy.signal import fftconvolve

    full = fftconvolve(kernel, kernel[::-1, ::-1])
    middle = kernel.shape[0] - 1
    power = float((kernel**2).sum())
    values = [full[middle + j, middle + i] if max(abs(j), abs(i)) <= middle else 0.0 for j, i in LAGS]
    return np.array(values) / power, power


def charge_response(loss_per_dn2: float, field_px: float, shot_dn2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What repelled charge does to shot noise: its variance before, and the autocovariance behind, from the variance behind.

    Parameters
    ----------
    loss_per_dn2 : float
        Relative loss of variance for each DN² of it before, to first order.
    field_px : float
        Reach s of the repulsion e^(−d²/2s²), felt up to two pixels; 0: only the pixel's own charge acts.
    shot_dn2 : ndarray, shape (levels,)
        Variance of the shot noise behind, DN².

    Returns
    -------
    ndarray, shape (levels,)
        The variance before, T, DN².
    ndarray, shape (levels, 40)
        The autocovariance behind at all `LAGS` but (0, 0), DN².

    Notes
    -----
    Each border moves by half the difference of the fields φ = w ∗ q of its two pixels (P. Antilogus et al., JINST 9, C03048, 2014), so
    noise on a flat field goes through h = δ − (x/2) L w, where L is the difference to the four neighbours and x = b T/(4 (1 − w₁)).
    Behind it is T h ⋆ h: T (1 − b T + …) at lag 0, and the sum over all lags is T.
    """
    from scipy.signal import fftconvolve

    reach = 4
    d = np.abs(np.arange(-reach, reach + 1))
    line = np.exp(-0.5 * (d / field_px) ** 2) * (d <= 2) if field_px > 0.05 else (d == 0).astype(float)
    weights = np.outer(line, line)
    spread = 4 * weights - sum(np.roll(weights, shift, axis) for axis in (0, 1) for shift in (-1, 1))
    square = fftconvolve(spread, spread)
    first = np.array([spread[reach + j, reach + i] for j, i in LAGS])
    second = np.array([square[2 * reach + j, 2 * reach + i] for j, i in LAGS])
    per_dn2 = loss_per_dn2 / (4 * (1 - line[reach + 1]))
    before = np.array(shot_dn2, float)
    for _ in range(8):
        x = per_dn2 * before
        before = shot_dn2 / np.maximum(1 - x * first[0] + 0.25 * x**2 * second[0], 0.2)
    x = (per_dn2 * before)[:, None]
    return before, before[:, None] * (-x * first[1:] + 0.25 * x**2 * second[1:])
