"""The camera model behind the joint photon-transfer fit, and its generalised least squares.

Chain: electrons are Poisson, x = K·µ_e is the linear signal in DN above black, a stored mean is b + f(x) with
f(x) = x (1 + a₁w + a₂w² + a₃w³), w = x / x_ref, so that K and the dark noise refer to f'(0) = 1. Means and temporal variances are
expanded to second order in the noise and in the spatial spread of the signal (PRNU, shading). Every level gives two observations:
its mean and its white mean square.

The mean plays two parts. Against exposure it gives f; the light of one level is off by a relative ε that is unknown. Through f⁻¹ it tells
the signal that was really there, which the variance of the *same* level belongs to, so lamp noise does not enter the gain directly.
The shared additive error of the mean makes the two observations of a level correlated; the 2 × 2 blocks are kept exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.arrays import Array

PARAMETERS = ("offset", "slope", "gain", "dark_var", "a1", "a2", "a3", "light_offset", "dark_slope", "dark_var_slope", "q_mean", "q_var")
OFFSET, SLOPE, GAIN, DARK_VAR, A1, A2, A3, LIGHT_OFFSET, DARK_SLOPE, DARK_VAR_SLOPE, Q_MEAN, Q_VAR = range(12)
QUANTISATION_DN2 = 1.0 / 12.0
MINIMUM_DARK_VAR_DN2 = 0.24  # EMVA 1288 R4.0 eq. 54: below it the 1/12 rule for quantisation fails


@dataclass(frozen=True)
class Levels:
    """Levels as the model sees them; all arrays have shape (n,), dark levels among them with ``bright`` False.

    ``light`` and ``time`` are scaled to a largest value of one. ``mean_var`` is the sampling variance of a level's mean without wander
    and lamp noise, ``ms_dof`` the degrees of freedom of its white mean square, ``kurtosis`` the excess kurtosis of one pixel's noise
    where the measured one contradicts the Poisson model, else NaN.
    """

    bright: np.ndarray
    light: np.ndarray
    time: np.ndarray
    mean: np.ndarray
    ms: np.ndarray
    spatial: np.ndarray
    row_col_var: np.ndarray  # share of row and column noise in the variance of the level's mean, DN²
    n_frames: np.ndarray
    ms_dof: np.ndarray
    kurtosis: np.ndarray
    leak: np.ndarray  # bound on what lamp changes between the frames put into ms through the spatial pattern, DN²
    dither: np.ndarray  # variance over the pixels that, beside the noise, shares out the rounding, DN²
    dnl_lsb: float  # standard deviation of the converter's code widths
    coherence: float  # of the rounding errors of the dark levels: 1 where their means lie at one phase within a code
    pixels: int
    x_ref: float

    def subset(self, keep: np.ndarray) -> Levels:
        """The levels where ``keep`` is True."""
        per_level = (name for name in self.__dataclass_fields__ if name not in ("dnl_lsb", "coherence", "pixels", "x_ref"))
        return replace(self, **{name: getattr(self, name)[keep] for name in per_level})


@dataclass(frozen=True)
class Linearised:
    """Residuals (means, then mean squares), their Jacobian, and the parts of their covariance (2 × 2 per level)."""

    residual: np.ndarray  # shape (2n,)
    jacobian: np.ndarray  # shape (2n, 12)
    v_mean: np.ndarray  # shape (n,): variance of the mean, without lamp noise and wander
    v_ms: np.ndarray
    v_cross: np.ndarray
    g: np.ndarray  # shape (n,): how an additive error of the mean enters the residual of the mean square, −g
    lamp: np.ndarray  # shape (n,): variance of the mean per unit of relative lamp variance
    x: np.ndarray  # shape (n,): linear signal, DN above black
    ms_model: np.ndarray


def transfer(x: np.ndarray, a: np.ndarray, x_ref: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Non-linearity f and its first three derivatives at ``x`` (DN)."""
    w = x / x_ref
    f = x * (1 + w * (a[0] + w * (a[1] + w * a[2])))
    f1 = 1 + w * (2 * a[0] + w * (3 * a[1] + w * 4 * a[2]))
    f2 = (2 * a[0] + w * (6 * a[1] + w * 12 * a[2])) / x_ref
    f3 = (6 * a[1] + 24 * w * a[2]) / x_ref**2
    return f, f1, f2, f3


def stored_moments(x: Array, v: Array, gain: float, signal: Array, spread: Array, a: Array, x_ref: float) -> tuple[Array, Array]:
    """Mean above black and temporal variance of stored values, for a linear signal of mean ``x`` and variance ``v``.

    Second-order expansion: mean f + ½f''(v + s²); variance f'²v + f'f''m₃ + (½f''² + f'f''')v², averaged over a spatial spread s² of x,
    with the third moment of the Poisson part m₃ = K²·signal. Quantisation adds 1/12 DN² (EMVA 1288 R4.0 eq. 9).
    """
    f, f1, f2, f3 = transfer(x, a, x_ref)
    mean = f + 0.5 * f2 * (v + spread)
    var = f1**2 * v + f1 * f2 * gain**2 * signal + (0.5 * f2**2 + f1 * f3) * v**2
    var = var + 0.5 * spread * (2 * (f2**2 + f1 * f3) * v + 4 * f1 * f2 * gain)
    return mean, var + QUANTISATION_DN2


def signal_from_mean(stored: Array, a: Array, x_ref: float, correction: Array) -> Array:
    """Linear signal x of f(x) + correction = stored, by Newton's method."""
    x = stored - correction
    for _ in range(6):
        f, f1, _, _ = transfer(x, a, x_ref)
        x = x - (f + correction - stored) / np.maximum(f1, 0.2)
    return x


def rounding_error_vars(var: np.ndarray, dither: np.ndarray | float = 0.0, dnl_lsb: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Variance, over what is not known of the converter, of its error of a mean and of a variance beyond the 1/12 rule.

    ``var`` is the temporal variance, ``dither`` that over the pixels. With equal steps the sub-code phase is unknown: first harmonic of
    the rounding error of a normal value (Widrow and Kollár, Quantization Noise, ch. 5). Thresholds that are displaced one by one, by a
    variance dnl²/2, move a mean by Σ e_k φ(u_k)/σ and a variance by Σ 2 e_k u_k φ(u_k), u_k = (T_k − µ)/σ; over many thresholds Σ φ²
    and Σ u²φ² are σ/(2√π) and σ/(4√π).
    """
    total = np.maximum(var, 0) + dither
    damp = np.exp(-2 * np.pi**2 * total)
    sigma = np.sqrt(np.maximum(total, QUANTISATION_DN2))
    displaced = 0.5 * dnl_lsb**2 / np.sqrt(np.pi)
    mean = 0.5 * (damp / np.pi) ** 2 + displaced / (2 * sigma)
    return mean, 0.5 * ((4 * total + 1 / np.pi**2) * damp) ** 2 + displaced * np.maximum(var, 0) / sigma


def slope_error_var(var: float, dither: float = 0.0, dnl_lsb: float = 0.0) -> float:
    """Variance of the converter's local slope for values of this variance, about 1: the derivative of its error of a mean."""
    total = max(var, 0.0) + dither
    sigma = np.sqrt(max(total, QUANTISATION_DN2))
    return float(2 * np.exp(-4 * np.pi**2 * total) + 0.5 * dnl_lsb**2 / (4 * np.sqrt(np.pi) * sigma**3))


def is_hidden(d: Levels) -> bool:
    """Whether rounding hides the noise of the dark levels (EMVA 1288 R4.0 eq. 54)."""
    dark = ~d.bright
    return bool(dark.any() and d.ms[dark].mean() < MINIMUM_DARK_VAR_DN2)


def least_var_before_rounding(var_dn2: float) -> float:
    """Smallest variance before rounding that can look like ``var_dn2`` after it, at the worst sub-code phase.

    Two codes that toggle show up to 0.25 DN² however small the noise, so the 1/12 rule is not safe near the bound of EMVA 1288 eq. 54.
    """
    return float(bounds_before_rounding(np.array([var_dn2]))[0][0])


def bounds_before_rounding(var_dn2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest variance before rounding that can look like each of ``var_dn2`` after it, at any sub-code phase, shape (n,).

    By the first harmonic (4v + 1/π²) e^(−2π²v) of the rounded variance (Widrow and Kollár, Quantization Noise, ch. 5), which is enough
    above v = 0.05 DN²; a smaller noise shows 0 within a code and up to ¼ DN² more than itself at its edge.
    """
    v = np.linspace(0, 1, 501)
    excess = (4 * v + 1 / np.pi**2) * np.exp(-2 * np.pi**2 * v)
    at_most = v + QUANTISATION_DN2 + np.where(v < 0.05, 0.25 - QUANTISATION_DN2, excess)
    at_least = np.where(v < 0.05, 0.0, np.maximum(v + QUANTISATION_DN2 - excess, 0.0))
    seen = np.asarray(var_dn2, float)[:, None]
    wide = np.maximum(seen[:, 0] - QUANTISATION_DN2, 0.0)
    low = np.where(seen[:, 0] < 1, v[np.argmax(at_most >= seen, axis=1)], wide)
    high = np.where(seen[:, 0] < 1, v[v.size - 1 - np.argmax((at_least <= seen)[:, ::-1], axis=1)], wide)
    return low, high


def white_before_rounding(ms_dn2: float, dither_dn2: float) -> float:
    """Smallest temporal variance that can lie behind a mean square, where the pixels lie spread over the codes by ``dither_dn2``."""
    return max(least_var_before_rounding(ms_dn2 + dither_dn2) - dither_dn2, 0.0)


def linearise(p: np.ndarray, d: Levels) -> Linearised:
    """Residuals, Jacobian (leading order) and covariance parts at the parameters ``p``.

    Where rounding hides the dark noise, the dark variances do not tell how that of the dark current grows: it is taken as shot noise.
    """
    a, x_ref = p[A1 : A3 + 1], d.x_ref
    bright = d.bright.astype(float)
    dark_x = p[DARK_SLOPE] * d.time
    light = bright * (d.light + p[LIGHT_OFFSET])
    x_pred = p[SLOPE] * light + dark_x

    shown_x = 0.0 if is_hidden(d) else dark_x  # of the dark signal: that part whose noise the dark frames show

    def noise(x: Array) -> Array:
        variance: Array = p[DARK_VAR] + p[GAIN] * (x - shown_x) + p[DARK_VAR_SLOPE] * d.time
        return variance

    _, f1_pred, _, _ = transfer(x_pred, a, x_ref)
    spread = d.spatial / f1_pred**2
    mean_pred, _ = stored_moments(x_pred, noise(x_pred), p[GAIN], x_pred, spread, a, x_ref)
    correction = mean_pred - transfer(x_pred, a, x_ref)[0]
    x = np.where(d.bright, signal_from_mean(d.mean - p[OFFSET], a, x_ref, correction), x_pred)
    v = noise(x)
    _, f1, f2, _ = transfer(x, a, x_ref)
    _, ms_pred = stored_moments(x, v, p[GAIN], x, spread, a, x_ref)
    dark = 1 - bright
    residual = np.concatenate([d.mean - p[OFFSET] - mean_pred - dark * p[Q_MEAN], d.ms - ms_pred - dark * p[Q_VAR] - 0.5 * d.leak])

    n = d.mean.size
    g = bright * (f1 * p[GAIN] + 2 * f2 * v)  # d(ms)/dx · dx/d(mean)
    jac = np.zeros((2 * n, len(PARAMETERS)))
    top, low = jac[:n], jac[n:]
    top[:, OFFSET], low[:, OFFSET] = 1, -g
    top[:, SLOPE] = f1_pred * light
    top[:, LIGHT_OFFSET] = f1_pred * bright * p[SLOPE]
    top[:, DARK_SLOPE] = f1_pred * d.time
    low[:, DARK_SLOPE] = 0.0 if is_hidden(d) else -(f1**2) * p[GAIN] * d.time * bright
    low[:, GAIN] = f1**2 * (x - shown_x)
    low[:, DARK_VAR] = f1**2
    low[:, DARK_VAR_SLOPE] = f1**2 * d.time
    for k in (1, 2, 3):
        top[:, A1 + k - 1] = x_pred * (x_pred / x_ref) ** k
        w = x / x_ref
        low[:, A1 + k - 1] = 2 * f1 * (k + 1) * w**k * v - g * x * w**k
    top[:, Q_MEAN] = low[:, Q_VAR] = dark

    poisson = np.maximum(x - dark_x, 0)
    safe = np.maximum(ms_pred, 1e-3)
    kurt = np.where(np.isnan(d.kurtosis), f1**4 * p[GAIN] ** 3 * poisson / safe**2, d.kurtosis)
    q_mean, q_ms = rounding_error_vars(safe - QUANTISATION_DN2, d.dither, d.dnl_lsb)
    own = bright + dark * (1 - d.coherence**2)  # the rest of the dark levels' rounding is common: Q_MEAN, Q_VAR
    v_mean = d.row_col_var + safe / (d.n_frames * d.pixels) + own * q_mean
    skew = f1**3 * p[GAIN] ** 2 * poisson / (d.n_frames * d.pixels)  # covariance of a sample mean and variance: µ₃/n
    v_ms = safe**2 * (2 + kurt * (d.n_frames - 1) / d.n_frames) / d.ms_dof + own * q_ms + d.leak**2 / 12
    v_ms = v_ms + g**2 * v_mean - 2 * g * skew
    return Linearised(residual, jac, v_mean, v_ms, skew - g * v_mean, g, bright * (f1 * poisson) ** 2, x, ms_pred)


def inverse_blocks(lin: Linearised, components: np.ndarray) -> np.ndarray:
    """Inverse of the covariance of all residuals, shape (2n, 2n), in closed form from its 2 × 2 blocks.

    ``components``: wander of the level means (DN²), relative lamp variance, relative excess variance of the mean squares.
    """
    n = lin.g.size
    wander, lamp, excess = components
    a = lin.v_mean + wander + lamp * lin.lamp
    b = lin.v_cross - lin.g * wander
    c = lin.v_ms + lin.g**2 * wander + excess * lin.ms_model**2
    det = a * c - b**2
    out = np.zeros((2 * n, 2 * n))
    i = np.arange(n)
    out[i, i], out[i + n, i + n] = c / det, a / det
    out[i, i + n] = out[i + n, i] = -b / det
    return out


def component_shapes(lin: Linearised) -> list[tuple[np.ndarray, np.ndarray]]:
    """Derivatives of the covariance by each variance component.

    Each as its diagonal and the entries that tie a mean to the mean square of the same level, both of shape (2n,).
    """
    zero, one = np.zeros_like(lin.g), np.ones_like(lin.g)
    none = np.zeros(2 * lin.g.size)
    wander = np.concatenate([one, lin.g**2]), np.concatenate([-lin.g, -lin.g])
    return [wander, (np.concatenate([lin.lamp, zero]), none), (np.concatenate([zero, lin.ms_model**2]), none)]
