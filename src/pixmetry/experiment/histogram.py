"""How often each code occurs, and what that tells of the converter."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import CodeErrors, CodeHistogram
from pixmetry.experiment._kernels import count_codes
from pixmetry.experiment.moments import check_frame

CORE_SIGMAS = 2.0  # a level is used this many of its standard deviations around its mean
MIN_SIGMA_DN = 1.5  # a narrower level does not cover its codes evenly enough for a smooth expectation
HALF_WINDOW = 6  # codes on each side from which the smooth part of the expectation is taken
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

    def merge(self, other: HistogramAccumulator) -> None:
        """Add what another accumulator has gathered."""
        self._counts += other._counts
        for level, sums in other._levels.items():
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
        raise MeasureError("the histogram holds no light levels", remedy="add frames with their level")
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
    DNL_k = n_k / e_k − 1 (IEEE Std 1241, code density test), where e_k is the Gaussian expectation times the mean of n/e over the
    ``HALF_WINDOW`` neighbours on each side: light that is not quite Gaussian changes n/e slowly, and a symmetric mean follows it up to
    its curvature. Non-linearity that changes more slowly than the window is therefore not seen. u(DNL_k)² = (1 + 1/W)/e_k.
    A code that never occurs is missing if its Poisson probability exp(−e_k), times the number of codes tested, is below 1e-6.
    """
    ideal, usable = expected_counts(histogram)
    window = np.r_[np.ones(HALF_WINDOW), 0.0, np.ones(HALF_WINDOW)]
    n = histogram.counts.astype(float)
    around_n = np.convolve(n, window, mode="same")
    around_ideal = np.convolve(ideal, window, mode="same")
    full = np.convolve(usable.astype(float), window, mode="same") == 2 * HALF_WINDOW
    expected = ideal * np.divide(around_n, around_ideal, out=np.zeros_like(n), where=around_ideal > 0)
    tested = np.flatnonzero(usable & full & (expected >= min_expected))
    e = expected[tested]
    dnl = n[tested] / e - 1.0 if tested.size else np.zeros(0)
    variance = (1 + 1 / (2 * HALF_WINDOW)) / e
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


def _rms_dnl(dnl: np.ndarray, variance: np.ndarray) -> Estimates:
    """RMS of the true DNL: the excess of the scatter over its counting noise, with chi-square sampling of both."""
    window = 1 + 1 / (2 * HALF_WINDOW)  # the neighbours' own DNL adds to the scatter
    weights = 1 / variance
    weights /= weights.sum()
    square = float(weights @ (dnl**2 - variance)) / window

    def u_square(true: float) -> float:
        # the neighbours share windows: the scatter is correlated only at second order in 1/W, which is left out
        return math.sqrt(2 * float(weights**2 @ (true * window + variance) ** 2)) / window

    u = u_square(max(square, 0.0))
    name, method = "dnl_rms_lsb", "excess scatter of code counts over their expectation; IEEE Std 1241 code density test"
    dof = 1 / float((weights**2).sum())
    if square > 1.645 * u_square(0.0):
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
