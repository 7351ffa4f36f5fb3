"""What hot and noisy pixels add to the means and variances of a series: they are defects, not the camera's black level and noise."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pixmetry.camera.observations import LevelMoments, PhotonTransfer, StackMoments
from pixmetry.observe.surface import median

CODE_SIGMAS = 8.0  # of one frame's codes: no pixel of a normal core lies beyond, in any frame
MAP_SIGMAS = 6.0  # of a mean map
LEAST_CODES = 3.0  # a core narrower than a code is still this wide
QUARTILES_TO_SIGMA = 1.349  # between the quartiles of a normal distribution
QUANTISATION_DN2 = 1 / 12
SHOT_NOISE_REL = 0.2  # how near hot pixels' noise is taken to be to shot noise
FAR = 3.0  # standard uncertainties
MOST_HOT = 0.02  # of the pixels: what more of them share is a part of the sensor (a tap, a glowing corner), and belongs to its black level
NOISY_BY_CHANCE = 0.01  # good pixels of a frame whose sample variance is called too large


class HotTail(NamedTuple):
    """What pixels far above the core add, each per pixel of the frame: to the mean, to the spatial variance.

    ``below_dn`` is the share of the mean that lies beneath the limit of the search, taken to be spread as evenly as what lies just
    beyond it, and known no better than itself.
    """

    mean_dn: float
    square_dn2: float
    below_dn: float


def tail_of_counts(counts: np.ndarray) -> HotTail:
    """The tail of the codes of dark frames, shape (2**bits,): what lies ``CODE_SIGMAS`` above the median."""
    codes, total = np.arange(counts.size, dtype=float), float(counts.sum())
    low, middle, high = np.searchsorted(np.cumsum(counts), [0.25 * total, 0.5 * total, 0.75 * total])
    limit = max(CODE_SIGMAS * (float(high - low) + 0.5) / QUARTILES_TO_SIGMA, LEAST_CODES)
    return _tail(codes - middle, counts.astype(float), limit)


def tail_of_map(mean_map: np.ndarray) -> tuple[HotTail, np.ndarray]:
    """The tail of a mean dark map, and which pixels are in it."""
    deviation = mean_map - median(mean_map)
    low, high = np.percentile(deviation, [25, 75])
    limit = max(MAP_SIGMAS * float(high - low) / QUARTILES_TO_SIGMA, 1.0)
    return _tail(deviation.ravel(), np.ones(deviation.size), limit), deviation > limit


def _tail(deviation: np.ndarray, weight: np.ndarray, limit: float) -> HotTail:
    """Sums beyond a limit, if few pixels lie there; the core's mean, not its median, is what a hot pixel stands above."""
    hot = deviation > limit
    total, beyond = float(weight.sum()), weight[hot]
    if not 0.0 < float(beyond.sum()) <= MOST_HOT * total:
        return HotTail(0.0, 0.0, 0.0)
    core = float(weight[~hot] @ deviation[~hot]) / float(weight[~hot].sum())
    excess = deviation[hot] - core
    next_to_it = float(beyond[deviation[hot] < 2 * limit].sum())
    return HotTail(float(beyond @ excess) / total, float(beyond @ excess**2) / total, 0.5 * limit * next_to_it / total)


class HotDoubt(NamedTuple):
    """Standard uncertainties of what was taken out, common to all levels: of a mean, and of a temporal variance."""

    mean_dn: float = 0.0
    var_dn2: float = 0.0


def without_hot_pixels(series: PhotonTransfer, stack: StackMoments | None) -> tuple[PhotonTransfer, HotDoubt]:
    """Take what hot and noisy pixels add out of the means and variances of all levels.

    Parameters
    ----------
    series : PhotonTransfer
        With the dark stack, if there is one, as its last dark level.
    stack : StackMoments, optional
        Dark frames; with it the search reaches deeper, and the noise of hot and noisy pixels is seen.

    Returns
    -------
    tuple
        The series, and the uncertainty: of hot pixels below the limit of the search, and of the noise of the few that were found.

    Notes
    -----
    Of a level with the mean excess m its hot pixels' noise is c m. They are taken to have shot noise, c being the gain within 20 %; what
    the stack shows of c, whose few hot pixels scatter, is joined with that by weights. Bright levels have the hot pixels of the dark
    level of their exposure.

    A mean square that few pixels of variances v make scatters by 2 Σ v²/N² for each frame beyond the first, which is the kurtosis given
    to the dark levels: the measured one goes with the mean square itself, so that levels that come out low by chance would count for more.
    """
    tails = series.dark_tails
    if tails is None or not series.dark.mean_dn.size:
        return series, HotDoubt()
    gain = _gain(series)
    per_excess, doubt = gain, SHOT_NOISE_REL
    noise = np.zeros(len(tails))
    if stack is not None:
        tail, hot = tail_of_map(stack.mean_map_dn)
        at = int(np.argmin(np.abs(series.dark.exposure_s[: len(tails)] - stack.exposure_s)))
        deeper = (tail.mean_dn + tail.below_dn) / tails[at, 0] if tails[at, 0] > 0 else 0.0
        if deeper:  # the same pixels at other exposures
            tails = np.column_stack([tails[:, 0] * deeper, tails[:, 1], tails[:, 0] * tail.below_dn / tails[at, 0]])
        of_stack = tail.mean_dn + tail.below_dn
        of_hot, of_noisy, u_rel = _noise_of_defects(stack, hot)
        if tail.mean_dn > 0 and of_hot > 0:
            shot = (SHOT_NOISE_REL * gain) ** -2 if gain > 0 else 0.0  # without light it is not known: the stack alone tells
            own = np.array([shot, (tail.mean_dn / (of_hot * u_rel)) ** 2])
            if gain > 0 and abs(of_hot / tail.mean_dn - gain) > FAR * float(np.sqrt((1 / own).sum())):
                own[0] = 0.0  # noisier than shot noise, or clipped
            per_excess = float(own @ [gain, of_hot / tail.mean_dn] / own.sum())
            doubt = float(own.sum() ** -0.5) / per_excess
        tails, noise = np.vstack([tails, [of_stack, tail.square_dn2, tail.below_dn]]), np.full(len(tails) + 1, of_noisy)
    else:
        tails = np.column_stack([tails[:, 0] + tails[:, 2], tails[:, 1:]])
    noise = noise + per_excess * tails[:, 0]
    if not (tails.any() or noise.any()):
        return series, HotDoubt()
    tails = tails[: series.dark.mean_dn.size]
    noise = noise[: series.dark.mean_dn.size]
    order = np.argsort(series.dark.exposure_s, kind="stable")

    def beside(values: np.ndarray) -> np.ndarray:
        return np.interp(series.bright.exposure_s, series.dark.exposure_s[order], values[order])

    shape = series.frame_shape
    dark = _less(series.dark, shape, tails[:, 0], tails[:, 1], noise)
    few = 2 * per_excess**2 * tails[:, 1] / max(float(dark.ms_pixel_dn2.mean()), QUANTISATION_DN2) ** 2
    dark = replace(dark, kurtosis_excess=np.where(tails[:, 0] > 0, few, dark.kurtosis_excess))
    bright = _less(series.bright, shape, beside(tails[:, 0]), beside(tails[:, 1]), beside(noise))
    doubts = HotDoubt(float(tails[:, 2].max()), float(doubt * per_excess * tails[:, 0].max()))
    return PhotonTransfer(bright, dark, series.frame_shape, series.bits), doubts


def _less(levels: LevelMoments, shape: tuple[int, int], mean: np.ndarray, square: np.ndarray, noise: np.ndarray) -> LevelMoments:
    """Levels less what hot pixels add; of a clipped or narrow level no more than there is."""
    white = np.minimum(noise, 0.5 * levels.ms_pixel_dn2)
    return replace(
        levels,
        mean_dn=levels.mean_dn - mean,
        ms_pixel_dn2=levels.ms_pixel_dn2 - white,
        ms_row_dn2=levels.ms_row_dn2 - white / shape[1],
        ms_col_dn2=levels.ms_col_dn2 - white / shape[0],
        var_total_dn2=levels.var_total_dn2 - white,
        spatial_cov_dn2=levels.spatial_cov_dn2 - square,
    )


def _noise_of_defects(stack: StackMoments, hot: np.ndarray) -> tuple[float, float, float]:
    """What the noise of hot pixels, and of the other noisy ones, adds to the mean temporal variance, DN², and the relative u of the first.

    The sample variances of few pixels scatter by √(2/(L − 1)) each.
    """
    from scipy.special import chdtri

    var = stack.var_map_dn2.astype(float)
    dof = stack.n_frames - 1
    core = float(var[~hot].mean())
    for _ in range(3):
        noisy = ~hot & (var > max(core, 0.25) * chdtri(dof, NOISY_BY_CHANCE / var.size) / dof)
        core = float(var[~(hot | noisy)].mean())
    of_hot, of_noisy = (float((var[part] - core).sum()) / var.size for part in (hot, noisy))
    above = np.maximum(var[hot] - core, 0.0)
    u_rel = float(np.sqrt(2 / dof * (above**2).sum()) / above.sum()) if above.any() else 1.0
    return of_hot, of_noisy, u_rel


def _gain(series: PhotonTransfer) -> float:
    """Slope of variance over mean, DN per electron, of the darker half of the levels."""
    bright = series.bright
    signal, noise = bright.mean_dn - series.dark.mean_dn.mean(), bright.ms_pixel_dn2 - series.dark.ms_pixel_dn2.mean()
    low = (signal > 0) & (signal < 0.5 * signal.max(initial=0.0))
    return max(float(np.median(noise[low] / signal[low])), 0.0) if low.any() else 0.0
