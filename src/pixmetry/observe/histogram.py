"""How often each code occurs, and what that tells of the converter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pixmetry.camera.observations import CodeErrors, CodeHistogram
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.observe._kernels import count_codes
from pixmetry.observe.moments import LevelSummary, check_frame

CLEAR_SIGMAS = 5.0  # from the mean of a level of the sweep to the brightest mean
CORE_SIGMAS = 2.0  # a level is used this many of its standard deviations around its mean
MIN_SIGMA_DN = 1.5  # a narrower level does not cover its codes evenly enough for a smooth expectation
MIN_TEMPORAL_SIGMA_DN = 2.5  # a fixed pattern makes structure of the width of the temporal noise, which the window must follow
HALF_WINDOW = 8  # codes on each side from which the smooth part of the expectation is taken
SIGNIFICANT = 3.0  # a variance below this many u is given as a limit
FALSE_ALARM = 1e-6  # that any code at all is wrongly called missing


class HistogramAccumulator:
    """Codes of all frames of a campaign; integer sums, independent of the order.

    Parameters
    ----------
    bits : int
        Bits per stored code.
    """

    def __init__(self, bits: int) -> None:
        self.bits = bits
        self._counts = np.zeros((2, 2**bits), np.int64)  # bright, dark
        self._levels: dict[object, np.ndarray] = {}

    def add(self, frame: np.ndarray, *, dark: bool = False, level: object = None) -> None:
        """Add one frame; frames of one light level share ``level``."""
        counts = np.zeros((4, 2**self.bits), np.int64)
        count_codes(check_frame(frame, self.bits), counts)
        self.add_counts(counts.sum(axis=0), dark=dark, level=level)

    def add_counts(self, counts: np.ndarray, *, dark: bool = False, level: object = None) -> None:
        """Add the counts of a whole group of frames, shape (2**bits,), int64 (``FrameMoments.counts``).

        For the differential non-linearity every group needs a ``level``: codes of unknown light are not expected.
        """
        self._counts[int(dark)] += counts
        if level is not None:
            n, codes = int(counts.sum()), np.arange(counts.size, dtype=np.int64)
            # exact sums: n, Σk, Σk²
            sums = np.array([n, int(counts @ codes), int(counts @ codes**2)], dtype=object)
            self._levels[level] = self._levels.get(level, 0) + sums

    def result(self) -> CodeHistogram:
        """The counts, and mean, variance and number of pixels of each light level."""
        sums = list(self._levels.values())
        n = np.array([int(s[0]) for s in sums], dtype=np.int64)
        mean = np.array([s[1] / s[0] for s in sums], dtype=float)
        variance = np.array([(s[0] * s[2] - s[1] * s[1]) / (s[0] * s[0]) for s in sums], dtype=float)
        order = np.argsort(mean)
        return CodeHistogram(
            counts=self._counts.sum(axis=0),
            dark_counts=self._counts[1].copy(),
            bits=self.bits,
            level_means_dn=mean[order] if sums else None,
            level_vars_dn2=variance[order] if sums else None,
            level_sizes=n[order] if sums else None,
        )


def sweep_histogram(levels: Sequence[LevelSummary], bits: int) -> CodeHistogram:
    """The counts of those bright levels of an exposure series that cover their codes smoothly.

    Left out are levels of little temporal noise, since their few thousand pixels stand at fixed places within the codes, and levels that
    reach up to the brightest mean, where a full well may pile pixels up. Dark frames and stacks show the same pixels at the same codes
    again and again, so they do not belong here.
    """
    accumulator = HistogramAccumulator(bits)
    codes = np.arange(2**bits)
    ceiling = max((level.mean_dn for level in levels), default=0.0)
    for number, level in enumerate(levels):
        share = level.counts / level.counts.sum()
        spread = math.sqrt(float(share @ (codes - level.mean_dn) ** 2))
        if level.squares.pixel_dn2 > MIN_TEMPORAL_SIGMA_DN**2 and level.mean_dn + CLEAR_SIGMAS * spread < ceiling:
            accumulator.add_counts(level.counts, level=number)
    return accumulator.result()


def expected_counts(histogram: CodeHistogram) -> tuple[np.ndarray, np.ndarray]:
    """Counts that an ideal converter would give for Gaussian light levels, and the codes near enough to a level to be tested.

    Returns
    -------
    expected : ndarray, shape (2**bits,), float64
        Sum over levels of n [Φ((k + ½ − µ)/σ) − Φ((k − ½ − µ)/σ)], with Sheppard's 1/12 taken off σ².
    usable : ndarray, shape (2**bits,), bool

    Raises
    ------
    MeasureError
        If the histogram was made without light levels.
    """
    from scipy.special import ndtr

    means, variances, sizes = histogram.level_means_dn, histogram.level_vars_dn2, histogram.level_sizes
    if means is None or variances is None or sizes is None:
        raise MeasureError(
            "no light level covers its codes evenly",
            allowed=f"bright levels with a temporal noise above {MIN_TEMPORAL_SIGMA_DN:g} DN, clear of saturation",
            remedy="add such levels; a camera with less noise has none, and only this value is missing",
        )
    edges = np.arange(2**histogram.bits + 1) - 0.5
    expected, usable = np.zeros(edges.size - 1), np.zeros(edges.size - 1, dtype=bool)
    top = edges[-1]
    for mean, variance, n in zip(means, variances, sizes, strict=True):
        sigma = math.sqrt(max(variance - 1 / 12, 1e-6))
        expected += n * np.diff(ndtr((edges - mean) / sigma))
        # clipped levels have no Gaussian shape
        if sigma >= MIN_SIGMA_DN and mean - 4 * sigma > 0 and mean + 4 * sigma < top:
            low, high = math.ceil(mean - CORE_SIGMAS * sigma), math.floor(mean + CORE_SIGMAS * sigma)
            usable[low : high + 1] = True
    return expected, usable


def code_errors(histogram: CodeHistogram, min_expected: float = 100.0) -> CodeErrors:
    """Differential non-linearity and missing codes from a light sweep.

    Parameters
    ----------
    histogram : CodeHistogram
        With light levels. A sweep of few levels with narrow noise does not cover all codes: only codes near a level are tested.
    min_expected : float
        Counts that a code must be expected to have; 100 give u(DNL) = 0.1 LSB.

    Returns
    -------
    CodeErrors
        With ``fit`` holding ``dnl_rms_lsb`` (a 95 % upper limit where it is not significant) if any code could be tested.

    Raises
    ------
    MeasureError
        If the histogram was made without light levels.

    Notes
    -----
    DNL_k = (n_k − e_k) / m_k (IEEE Std 1241, code density test), where e_k is the Gaussian expectation times what a polynomial of degree 4
    through the ratio of counts to it of the ``HALF_WINDOW`` neighbours on each side gives at k (Savitzky & Golay 1964, without the point
    itself): light that is not quite Gaussian changes that ratio slowly, and the polynomial follows it. Non-linearity that changes more
    slowly than the window is therefore not seen. m_k is the plain mean of the ratio over the window, times the expectation: it scatters
    less than e_k, by which a quotient would be biased. u(DNL_k)² = 1/m_k + Σ h_j²/m_(k+j) with the weights h_j.
    A code that never occurs is missing if its Poisson probability exp(−e_k), times the number of codes tested, is below 1e-6.
    """
    ideal, usable = expected_counts(histogram)
    weights = neighbour_weights()
    n = histogram.counts.astype(float)
    ratio = np.divide(n, ideal, out=np.zeros_like(n), where=ideal > 0)
    full = np.convolve(usable.astype(float), weights != 0, mode="same") == 2 * HALF_WINDOW
    expected = ideal * np.maximum(np.convolve(ratio, weights, mode="same"), 0.0)
    level = ideal * np.convolve(ratio, np.full(weights.size, 1 / weights.size), mode="same")
    of_neighbours = np.convolve(np.divide(1, level, out=np.zeros_like(n), where=level > 0), weights**2, mode="same")
    tested = np.flatnonzero(usable & full & (ideal >= min_expected) & (expected > 0))
    e = expected[tested]
    dnl = (n[tested] - e) / level[tested]
    variance = 1 / level[tested] + of_neighbours[tested]
    probability = np.minimum(np.exp(-e) * max(tested.size, 1), 1.0)
    missing = (n[tested] == 0) & (probability < FALSE_ALARM)
    return CodeErrors(
        codes=tested,
        dnl_lsb=dnl,
        u_dnl_lsb=np.sqrt(variance),
        missing_codes=tested[missing],
        missing_probability=probability[missing],
        fit=_rms_dnl(dnl, variance) if tested.size > 1 else Estimates.empty(),
    )


def neighbour_weights() -> np.ndarray:
    """Weights with which the neighbours of a code predict it: least squares of a polynomial of degree 4, shape (2·HALF_WINDOW + 1,)."""
    j = np.arange(-HALF_WINDOW, HALF_WINDOW + 1)
    design = np.stack([j**0, j**2, j**4], axis=1)[j != 0].astype(float)
    weights = np.zeros(j.size)
    weights[j != 0] = design @ np.linalg.inv(design.T @ design)[:, 0]
    return weights


def _rms_dnl(dnl: np.ndarray, variance: np.ndarray) -> Estimates:
    """RMS of the true DNL: the excess of the scatter over its counting noise, with chi-square sampling of both.

    The neighbours' own DNL adds to the scatter. Thresholds are taken as displaced one by one, so that a wide code has narrow neighbours:
    the widths have a correlation of −1/2 with the next.
    """
    h = neighbour_weights()
    response = -h + (np.arange(h.size) == HALF_WINDOW)
    window = float(response @ response - response[1:] @ response[:-1])
    weights = 1 / variance
    weights /= weights.sum()
    square = float(weights @ (dnl**2 - variance)) / window

    def u_square(true: float) -> float:
        # 1.5 = 1 + 2ρ² for widths that are correlated with the next by ρ = −1/2
        return math.sqrt(2 * float(weights**2 @ (math.sqrt(1.5) * true * window + variance) ** 2)) / window

    u = u_square(max(square, 0.0))
    name, method = "dnl_rms_lsb", "excess scatter of code counts over their expectation; IEEE Std 1241 code density test"
    dof = 1 / float((weights**2).sum())
    if square > SIGNIFICANT * u_square(0.0):
        rms = math.sqrt(square)
        return Estimates.from_rows(
            [(name, rms, u / (2 * rms), dof, "LSB")], method=method, confounders=("light with structure finer than the window",)
        )
    limit = math.sqrt(max(square, 0.0) + 1.645 * u)
    return Estimates.from_rows(
        [(name, limit, u / (2 * limit), dof, "LSB")],
        method=method,
        limits=frozenset({name}),
        reasons={name: "not significantly above the counting noise"},
    )
