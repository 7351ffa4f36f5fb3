"""What the rows of dark frames share: hum, 1/f noise along the read-out, and offsets of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import ONE_SIDED_95, Estimates

LEAST_VARIANCE = 3.0  # u from which a variance counts


def octave_periods(corner_rel: float, octaves: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the nodes in pixel clocks, and share of the variance, of every octave of 1/f noise below a corner.

    Straight lines between independent nodes P apart have the density P sinc⁴(f P), up to a factor; its sum over octaves of P is 1/f
    within 0.4 %, as far as there are octaves on both sides. The fastest counts twice: to low frequencies it is what all faster ones
    would be together, P/2 + P/4 + … = P. So the density is right within 0.1 dB up to a quarter of the corner, 1 dB at half of it.
    """
    shares = np.ones(octaves)
    shares[0] = 2.0
    return 0.5 / corner_rel * 2.0 ** np.arange(octaves), shares / shares.sum()


def octave_covariance(corner_rel: float, octaves: int, lag_px: np.ndarray) -> Array:
    """Covariance at lags in pixel clocks for a variance of 1: per octave the cubic B-spline, a triangle with itself, over its peak."""
    u = np.abs(np.asarray(lag_px, float))
    out = np.zeros_like(u)
    for period, share in zip(*octave_periods(corner_rel, octaves), strict=True):
        v = np.minimum(u / period, 2.0)
        out += share * np.where(v < 1, 1 - 1.5 * v**2 + 0.75 * v**3, 0.25 * (2 - v) ** 3)
    return out


@dataclass(frozen=True)
class DarkRows:
    """The rows of a stack of dark frames.

    Parameters
    ----------
    frames, rows, cols : int
    frequency, power_dn2, fitted_dn2 : ndarray, shape (frequencies,)
        Periodogram of what the means of the rows do from frame to frame, cycles a row; white row noise of variance s² has power s²; and
        the fit of white noise and 1/f noise to it.
    hum : Estimates
        ``amplitude_dn``, ``per_row``, ``per_col`` (cycles), ``frequency_hz`` where the clocks were stated; or the reasons.
    flicker : Estimates
        ``rms_dn``, ``corner_rel`` with the octaves among the settings; or the reason.
    line_px, u_line_px : float
        Pixel clocks from line to line that the fit rests on; their u, 0 where the clocks were stated.
    taken : mapping
        Variance in DN² and its u: by ``hum`` what that gives to the means of the rows, by ``row`` what 1/f noise gives to them, by
        ``pixel`` what both give to the pixels within them.
    """

    frames: int
    rows: int
    cols: int
    frequency: np.ndarray
    power_dn2: np.ndarray
    fitted_dn2: np.ndarray
    hum: Estimates
    flicker: Estimates
    line_px: float
    u_line_px: float
    taken: Mapping[str, tuple[float, float]]


def without_variance(noise: Estimates, name: str, square: float, u_square: float, why: str) -> Estimates:
    """Estimates in which a standard deviation is without a part whose square is known; a limit where nothing significant is left."""
    if name not in noise or name in noise.limits or not square:
        return noise
    i = noise.index(name)
    values, covariance, old = noise.values.copy(), noise.covariance.copy(), float(noise.values[i])
    left = old**2 - square
    u_left = float(np.hypot(2 * old * np.sqrt(covariance[i, i]), u_square))
    if left < LEAST_VARIANCE * u_left:
        values[i] = float(np.sqrt(max(left, 0.0) + ONE_SIDED_95 * u_left))
        covariance[i, :] = covariance[:, i] = 0.0
        covariance[i, i] = (u_left / (2 * values[i])) ** 2
        reasons = {**noise.reasons, name: f"{why} explains it; 95 % upper limit"}
        return replace(noise, values=values, covariance=covariance, limits=noise.limits | {name}, reasons=reasons)
    values[i] = float(np.sqrt(left))
    covariance[i, :] *= old / values[i]
    covariance[:, i] *= old / values[i]
    covariance[i, i] = (u_left / (2 * values[i])) ** 2
    return replace(noise, values=values, covariance=covariance, reasons={**noise.reasons, name: f"without {why}"})
