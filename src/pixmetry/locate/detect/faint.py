"""Faint targets: a matched filter at several scales, with a threshold that has a stated rate of false alarms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.background import Background, bands_of

SCALES = 4  # bins of 2, 4, 8 and 16 pixels
CLIP_SIGMA = 5.0  # further than this no pixel counts
LEAST_BINS = 8  # a side of the frame, for a scale to be used
BLANK = 1e-4  # a smoothed bin that is 0 but for rounding
SEEN = 6000  # bins from which a scale's noise is taken
SIZES_PX = (0.8, 1.2, 1.7)  # of Gaussian spots that are looked for at every pixel where the smallest bins show something
SHARE_TO_LOOK = 0.7  # of the threshold, at which they do
MANY = 20  # peaks from which the skewness is taken again, without them
LEAST_LIT = 0.6  # of the bins, beside known targets, for the noise of the rest to be known
OUTER = 0.05  # quantiles from which the skewness of the noise is taken
CHANCE_SKEW = 20.0  # twice the standard deviation of that skewness, times the root of the number of values
SKEW_LEFT = 0.46  # of the skewness of the bins, in their means with weights 1, 2, 1 along both: Σw³/(Σw²)^1.5
SKEW_SHARP = 2.0  # and in a spot's weights as much again
TAIL = 0.005  # share of bins on each side from which the tails of the noise are taken


def faint_peaks(
    frame: np.ndarray,
    ground: Background,
    known: np.ndarray,
    polarity: str,
    false_alarms: float,
    grain_dn: float,
    margin_px: int,
    threads: int | None,
) -> np.ndarray | None:
    """Find places where more light (or less) than the background's noise can make lies in a patch.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    ground : Background
    known : ndarray, shape (n, 5), int32
        Runs of pixels of targets that are known (`find_runs`): neither they nor ``margin_px`` around them count.
    polarity : {"auto", "bright", "dark"}
    false_alarms : float
        Greatest expected number of false places in a frame of noise.
    grain_dn : float
        Step of the grey values: half of it is no signal.
    threads : int, optional

    Returns
    -------
    ndarray, shape (n, 4)
        x, y, score (over the threshold of its scale, negative for dark) and side of the bin, px; the strongest first. None where
        known targets cover more than 40 % of the frame, so that the noise of the rest is not known.

    Notes
    -----
    Heights over the background, in units of the local noise and at most CLIP_SIGMA of it, are summed in bins of 2, 4, 8 and 16 pixels and
    smoothed with the weights 1, 2, 1 along rows and columns: a filter that matches a Gaussian spot of 0.76 bins standard deviation. For a
    spot of standard deviation s a Gaussian filter of t has 2 s t/(s² + t²) of the greatest possible ratio of signal to noise, at least
    0.94 between these scales.

    The noise of a scale is that of its own smoothed image: noise of every correlation is in it, and errors of the background's map. It is
    taken from the median of the absolute values, or from the less extended tail if this is longer. A false alarm is a local maximum of at
    least u; of N bins there are at most N Q(u), with Q the tail of the normal distribution, whatever their correlation. u makes the sum
    over the scales and both sides ``false_alarms``; it is enlarged by (u³ + u)/4ν, Student's t to first order (Fisher, Cornish 1960),
    because the noise is known from ν bins: as many as there are rows or columns, the fewer, because rows may have noise in common. Where
    the noise is skewed (few electrons, many warm pixels, black that is cut off), u grows by γ(u² − 1)/6 on the side of its longer tail.
    """
    from pixmetry.locate.detect import _faint_kernels as k
    from pixmetry.locate.detect._background_kernels import Map

    rows, cols = (side // 2 for side in frame.shape)
    if min(rows, cols) < LEAST_BINS:
        return np.empty((0, k.PEAK))
    level, reach = Map(ground.level_dn, *ground.scales), Map(CLIP_SIGMA * ground.tame_sigma_dn + 0.5 * grain_dn, *ground.scales)
    bins = np.empty((rows, cols), np.float32)
    map_tiles(lambda band: k.bin_heights(frame, level, reach, *band, CLIP_SIGMA, bins), bands_of(rows, threads), threads)
    k.blank_runs(bins, known, margin_px)
    lit = _lit_bins(bins)
    if len(lit) < LEAST_LIT * len(bins.ravel()[:: _step_of(bins)]):
        return None
    middle = float(lit[len(lit) // 2])  # the skirts of the known targets, and what the scale cuts off, are in the background's map
    if len(known):
        k.fill_blanks(bins, np.float32(middle))
    pyramid = [bins]
    while len(pyramid) < SCALES and min(pyramid[-1].shape) >= 2 * LEAST_BINS:
        pyramid.append(k.halved(pyramid[-1]))
    search = _Search(frame, ground, level, reach, pyramid, middle, polarity, false_alarms, grain_dn, threads)
    peaks = search.peaks(_skew_of(lit))
    if len(peaks) > MANY:  # what they add to one side is not the noise's
        rest = bins.copy()
        k.blank_runs(rest, _runs_about(peaks, frame.shape), 0)
        peaks = search.peaks(_skew_of(_lit_bins(rest)))
    return peaks


@dataclass(frozen=True)
class _Search:
    """The scales of a frame, and what is looked for in them."""

    frame: np.ndarray
    ground: Background
    level: Any  # Map
    reach: Any  # Map
    pyramid: list[np.ndarray]
    middle: float
    polarity: str
    false_alarms: float
    grain_dn: float
    threads: int | None

    def peaks(self, skew: float) -> np.ndarray:
        """Return the peaks of all scales, the strongest first, with the skewness of the noise in the smallest bins."""
        from pixmetry.locate.detect import _faint_kernels as k

        sides = 2 if self.polarity == "auto" else 1
        u = threshold_of(self.false_alarms / 2, sides * sum(bins.size for bins in self.pyramid))
        parts = []
        for s, bins in enumerate(self.pyramid):
            usual = self.middle * 2**s * 16 / 6
            step = max(math.isqrt(bins.size // SEEN), 1)
            noise = _noise_of(k.smooth_sample(bins, step, step) - usual)
            uneven = skew * SKEW_LEFT / 2**s
            up, down = (_enlarged(u, bins.shape, sign * uneven) * noise for sign in (1, -1))
            share = 1.0 if s else SHARE_TO_LOOK
            low = usual - share * down if self.polarity != "bright" else -math.inf
            high = usual + share * up if self.polarity != "dark" else math.inf
            bands = bands_of(len(bins), self.threads)
            found = np.concatenate(map_tiles(lambda band: k.find_peaks(bins, low, high, 2 << s, *band), bands, self.threads))  # noqa: B023
            if not len(found):
                continue
            found[:, 2] -= usual
            if s == 0:
                found = self._sharpened(found, uneven, max(noise, 1.0))
            else:
                found[:, 2] /= np.where(found[:, 2] > 0, up, down)
            found = found[_above_grain(found, self.ground, self.grain_dn, u * noise)]
            parts.append(found)
        if not parts:
            return np.empty((0, k.PEAK))
        table = np.concatenate(parts)
        order = np.argsort(-np.abs(table[:, 2]), kind="stable")
        keep = k.strongest_peaks(table, order)
        strongest: np.ndarray = table[order[keep[order]]]
        return strongest

    def _sharpened(self, found: np.ndarray, uneven: float, noise: float) -> np.ndarray:
        """Those that pixel by pixel are above the threshold too, which a defect is not; scores over that threshold."""
        from pixmetry.locate.detect import _faint_kernels as k

        sides = 2 if self.polarity == "auto" else 1
        u = threshold_of(self.false_alarms / 2, sides * self.frame.size * len(SIZES_PX))
        k.sharpen_peaks(self.frame, self.level, self.reach, found, CLIP_SIGMA, np.array(SIZES_PX), 2)
        up, down = (_enlarged(u, self.pyramid[0].shape, sign * SKEW_SHARP * uneven) * noise for sign in (1, -1))
        found[:, 2] /= np.where(found[:, 2] > 0, up, down)
        return found[np.abs(found[:, 2]) > 1]


def _enlarged(u: float, shape: tuple[int, ...], skew: float) -> float:
    """A threshold that allows for noise that is known from few rows or columns, and is skewed."""
    return u + (u**3 + u) / (4 * min(shape)) + max(skew, 0.0) * (u**2 - 1) / 6


def _step_of(bins: np.ndarray) -> int:
    return max(bins.size // (2 * SEEN), 1) | 1


def _lit_bins(bins: np.ndarray) -> np.ndarray:
    """A part of the bins, sorted, without what is blank."""
    part = bins.ravel()[:: _step_of(bins)]
    return np.sort(part[part != 0])


def _runs_about(peaks: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Runs of pixels that cover squares of three bins about peaks."""
    x, y, _, side = peaks.T
    first, stop = np.maximum(x - 1.5 * side, 0), np.minimum(x + 1.5 * side + 1, shape[1])
    rows = [np.arange(max(int(v - 1.5 * s), 0), min(int(v + 1.5 * s) + 1, shape[0])) for v, s in zip(y, side, strict=True)]
    count = np.array([len(r) for r in rows])
    runs = np.zeros((int(count.sum()), 5), np.int32)
    runs[:, 0], runs[:, 1], runs[:, 2] = np.concatenate(rows), np.repeat(first, count), np.repeat(stop, count)
    return runs


def _skew_of(values: np.ndarray) -> float:
    """Skewness of sorted values from three quantiles, 0 where it may be chance.

    By Cornish and Fisher the quantile of z is z + γ(z² − 1)/6, so that q(z) + q(−z) − 2 q(0) is γ(z² − 1)/3, and q(z) − q(−z) is 2z.
    """
    z, far = -NormalDist().inv_cdf(OUTER), int(OUTER * len(values))
    low, middle, high = float(values[far]), float(values[len(values) // 2]), float(values[-1 - far])
    skew = 6 * z / (z**2 - 1) * (high + low - 2 * middle) / max(high - low, 1e-9)
    return skew if abs(skew) > CHANCE_SKEW / math.sqrt(len(values)) else 0.0


def _noise_of(smooth: np.ndarray) -> float:
    """Standard deviation of the noise of some smoothed bins, of which few are targets; what is blank is 0."""
    values = np.sort(smooth[np.abs(smooth) > BLANK])
    if len(values) < 2:
        return 1.0
    normal, far = NormalDist(), int(TAIL * len(values))
    tail = min(float(values[-1 - far]), -float(values[far])) / -normal.inv_cdf(TAIL)
    return max(float(np.median(np.abs(values))) / normal.inv_cdf(0.75), tail, 1e-3)


def threshold_of(false_alarms: float, trials: float) -> float:
    """Standard deviations that so many normally distributed values exceed so many times on average.

    Examples
    --------
    >>> from pixmetry.locate.detect.faint import threshold_of
    >>> round(threshold_of(0.01, 1e6), 2)
    5.61
    """
    return -NormalDist().inv_cdf(min(false_alarms / trials, 0.4))


def _above_grain(peaks: np.ndarray, ground: Background, grain_dn: float, threshold: float) -> np.ndarray:
    """Whether the light of a peak is more than the steps of the grey values and the bends between the background's tiles can make."""
    sigma, bend = ground.sigma(peaks[:, 0], peaks[:, 1]), ground.bend(peaks[:, 0], peaks[:, 1])
    mean_dn = threshold * np.abs(peaks[:, 2]) * sigma * 0.375 / peaks[:, 3]  # weights 1, 2, 1: white noise is √(6 · 6)/16 of a bin's
    above: np.ndarray = mean_dn > 0.5 * grain_dn + bend
    return above
