"""The high-pass filter of EMVA 1288 R4.0 §8.1, and what it leaves of pixel, row and column patterns.

The mean image less its mean over a smooth neighbourhood: box of 7 x 7, box of 11 x 11 and binomial filter of 3 x 3, one after the other.
Only pixels whose whole neighbourhood lies in the frame are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.emva.spatial._kernels import subtract_low_pass

MARGIN = 9  # pixels lost on each side
MINIMUM_SIDE = 24  # leaves 6 x 6 pixels; below that rows, columns and pixels cannot be told apart
LOW_PASS = np.convolve(np.convolve(np.ones(7) / 7, np.ones(11) / 11), [0.25, 0.5, 0.25])  # along one axis, shape (19,)


def high_pass(image: Array) -> Array:
    """The image less its smoothed self.

    Parameters
    ----------
    image : ndarray, shape (rows, cols)

    Returns
    -------
    ndarray, shape (rows - 18, cols - 18), float64

    Raises
    ------
    MeasureError
        If a side has fewer than 24 pixels.
    """
    check_size(image.shape)
    out = np.empty((image.shape[0] - 2 * MARGIN, image.shape[1] - 2 * MARGIN))
    subtract_low_pass(np.asarray(image, dtype=float), LOW_PASS, np.empty(out.shape[1] + 2 * MARGIN), out)
    return out


def passed_power(frequency: Array) -> Array:
    """Share of the power of white noise that passes, against the frequency (1/px) along one axis and averaged over that along the other.

    The transfer function is 1 − G(f) G(f'), with G of the low-pass g along one axis; the mean of its square over f' is
    1 − 2 g₀ G(f) + G²(f) Σg².
    """
    transfer: Array = np.cos(2 * np.pi * np.outer(frequency, np.arange(-MARGIN, MARGIN + 1))) @ LOW_PASS
    power: Array = 1 - 2 * LOW_PASS[MARGIN] * transfer + transfer**2 * (LOW_PASS @ LOW_PASS)
    return power


def check_size(shape: tuple[int, ...]) -> None:
    """Refuse frames that the filter would use up."""
    if min(shape) < MINIMUM_SIDE:
        raise MeasureError(
            "the frames are too small for the high-pass filter of EMVA 1288 R4.0",
            where="spatial stack",
            value=tuple(shape),
            allowed=f"{MINIMUM_SIDE} rows and columns or more",
            remedy="use release 3.1, which has no filter, or take larger frames",
        )


@dataclass(frozen=True)
class PatternGains:
    """How white pixel, row and column patterns show in the variances of an image.

    ``matrix``, shape (3, 3): rows are the variance of all pixels, of the column means (cav) and of the row means (rav), each about the
    image's mean and with its own number in the denominator; columns are the variances of the pixel, row and column pattern.
    ``dof``, shape (3,): effective degrees of freedom of white noise in the strata pixel, row, column.
    """

    matrix: Array
    dof: Array


def pattern_gains(shape: tuple[int, int], filtered: bool) -> PatternGains:
    """Expectation of an image's variances for white patterns of variance 1, with or without the filter; exact for every frame size.

    Parameters
    ----------
    shape : (rows, cols)
        Of the frame, before the filter.
    filtered : bool

    Notes
    -----
    With the low-pass g(i) g(j) the filter is h = δ(i) δ(j) − g(i) g(j). A white pixel pattern of variance 1 comes out with the
    autocovariance

        ρ(i, j) = δ(i) δ(j) − 2 g(i) g(j) + q(i) q(j),    q = g ⋆ g,

    and, as g sums to 1, a row pattern with ρ₁(i) = δ(i) − 2 g(i) + q(i), the same in every column. The mean of n correlated values has
    the variance Σ_i w_n(i) ρ(i), w_n(i) = (n − |i|)/n². With V₀ = Σ_ij w_M(i) w_N(j) ρ(i, j) for the mean of all M x N kept pixels,

        variance of all pixels    ρ(0, 0) − V₀
        of the column means       Σ_i w_M(i) ρ(i, 0) − V₀
        of the row means          Σ_j w_N(j) ρ(0, j) − V₀

    and for a row pattern ρ₁(0) − Σ_i w_M(i) ρ₁(i) in the first and third, nothing in the second. In a large frame these are 0.98850,
    0.88906/M, 0.88906/N and 0.88906: the filter takes from a white field mostly what is common to a column or a row, so its column
    means keep 0.88906 σ²/M and not 0.98850 σ²/M, which eq. 41 and 42 would need.

    A sum of squares of Gaussian noise has the variance 2 Σ (covariances)², hence dof = 2 (expectation)²/variance with ρ² in place of ρ.
    """
    lag, rho, rho_line = _autocovariance(filtered)
    if filtered:
        check_size(shape)
    margin = MARGIN if filtered else 0
    m, n = shape[0] - 2 * margin, shape[1] - 2 * margin
    weight_y, weight_x = _mean_weights(m, lag), _mean_weights(n, lag)
    middle = lag.size // 2
    whole = weight_y @ rho @ weight_x
    pixel = np.array([rho[middle, middle] - whole, weight_y @ rho[:, middle] - whole, rho[middle] @ weight_x - whole])
    row = rho_line[middle] - weight_y @ rho_line
    col = rho_line[middle] - weight_x @ rho_line
    matrix = np.array([[pixel[0], row, col], [pixel[1], 0.0, col], [pixel[2], row, 0.0]])
    dof = np.array(
        [
            (pixel[0] - pixel[1] - pixel[2]) ** 2 / ((weight_y @ rho**2 @ weight_x) * (1 - 1 / m) * (1 - 1 / n)),
            row**2 / ((weight_y @ rho_line**2) * (1 - 1 / m)),
            col**2 / ((weight_x @ rho_line**2) * (1 - 1 / n)),
        ]
    )
    return PatternGains(matrix, dof)


def _autocovariance(filtered: bool) -> tuple[Array, Array, Array]:
    """Lags, ρ(i, j) of a white field and ρ₁(i) of a white line; without the filter a delta."""
    if not filtered:
        return np.zeros(1), np.ones((1, 1)), np.ones(1)
    reach = LOW_PASS.size - 1
    delta = np.zeros(2 * reach + 1)
    delta[reach] = 1.0
    low = np.pad(LOW_PASS, reach // 2)
    twice = np.convolve(LOW_PASS, LOW_PASS)
    rho = np.outer(delta, delta) - 2 * np.outer(low, low) + np.outer(twice, twice)
    return np.arange(-reach, reach + 1.0), rho, delta - 2 * low + twice


def _mean_weights(n: int, lag: Array) -> Array:
    left: Array = np.maximum(n - np.abs(lag), 0.0)
    return left / n**2
