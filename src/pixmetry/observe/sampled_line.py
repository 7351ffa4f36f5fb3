"""The noise of a video line that a grabber samples by a clock of its own.

The line holds each pixel for one period, so its noise has a power spectrum P(f) = sinc²(f) |H(f)|², f in cycles per pixel, and P(0) is the
variance of a pixel before the line. Samples at s times the pixel clock have s Σ P(m s) at frequency zero, over all whole m: that is their
autocovariance summed over all lags. At s = 1 every term but the first is a zero of the sinc, and the sum is the variance before. At any
other rate it is s (1 + a) times that, with the share a that sampling folds back to frequency zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.camera.noise_covariance import LAGS, LINE, LINEAR, REACH, UNKNOWN, NoiseFilter

FOLDED = 8  # multiples of the sampling frequency that are summed
LEAST_CORNER, LARGEST_CORNER = 1e-2, 1e3  # of the pole, cycles per pixel


def sampled(found: NoiseFilter, samples_per_pixel: float) -> NoiseFilter:
    """What is known of the filter when the samples are not one to a pixel.

    Parameters
    ----------
    found : NoiseFilter
        As if they were.
    samples_per_pixel : float
        Sampling clock over pixel clock.

    Notes
    -----
    Of the share a that is folded back, samples tell no more than a bound: that of the single pole with the power that they have at half
    their frequency, because every line falls as steeply beyond that. It is taken as likelier the smaller it is, from none to this bound
    (a triangle): a mean of a third of it, and u = 1/√18 of it.
    """
    if found.kind == UNKNOWN and not np.isfinite(found.factor):
        return found
    along = np.array([found.correlation[LAGS.index((0, k))] for k in range(1, REACH + 1)])
    whole = 1 + 2 * float(along.sum())
    at_half = 1 + 2 * float((along * (-1.0) ** np.arange(1, REACH + 1)).sum())
    most = folded_share(max(at_half, 0.0) / max(whole, 1e-3), samples_per_pixel)
    scale, u_scale = 1 / (samples_per_pixel * (1 + most / 3)), most / np.sqrt(18) / (1 + most / 3)
    linear = found.kind != UNKNOWN
    unseen = 0.0 if found.kind in (LINEAR, UNKNOWN) else found.factor - 1  # repelled charge cannot be told from the line here
    before = 1.0 if unseen else found.factor
    return replace(
        found,
        kind=LINEAR if linear else UNKNOWN,
        name=f"{LINE}, of {samples_per_pixel:.4g} samples a pixel" if linear else found.name,
        factor=before * scale,
        u_factor=scale * float(np.hypot(np.hypot(found.u_factor, unseen), before * u_scale)),
        clock_factor=scale,
        rival=None if found.rival is None else sampled(found.rival, samples_per_pixel),
    )


def folded_share(at_half: float, samples_per_pixel: float) -> float:
    """Power that sampling folds to frequency zero, over what is there without, of held pixels behind a single pole.

    Parameters
    ----------
    at_half : float
        Power of the samples at half their frequency over that at frequency zero; it tells the pole.
    samples_per_pixel : float

    Examples
    --------
    >>> round(folded_share(0.2, 0.7048), 3), round(folded_share(0.2, 1.0), 4)
    (0.013, 0.0)
    """
    from scipy.optimize import brentq

    multiples = np.arange(FOLDED)

    def power(frequency: np.ndarray, log_corner: float) -> np.ndarray:
        held: np.ndarray = np.sinc(frequency) ** 2 / (1 + (frequency * np.exp(-log_corner)) ** 2)
        return held

    def folded(log_corner: float) -> float:
        return 2 * float(power(samples_per_pixel * (multiples + 1), log_corner).sum())

    def too_much(log_corner: float) -> float:
        return 2 * float(power(samples_per_pixel * (multiples + 0.5), log_corner).sum()) / (1 + folded(log_corner)) - at_half

    low, high = np.log(LEAST_CORNER), np.log(LARGEST_CORNER)
    if too_much(low) > 0:
        return folded(low)
    return folded(high if too_much(high) < 0 else float(brentq(too_much, low, high)))
