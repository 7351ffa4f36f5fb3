"""Defect pixels: those that stand out from the others in the dark, in their response, or in their noise."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pixmetry.camera.observations import DefectList, LevelMoments, PhotonTransfer, StackMoments
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError
from pixmetry.observe.photon_transfer_levels import core_spread_dn2
from pixmetry.observe.photon_transfer_model import QUANTISATION_DN2, white_before_rounding
from pixmetry.observe.surface import fill, fit_surface, median

KINDS = ("stuck", "dead", "hot", "cold", "gain", "noisy")  # worst first
COARSE_DN = 0.02  # largest error of a mean code above which a converter counts as coarse for its noise
COARSE_CLIP_DN = 2.0  # codes that lie about by rounding are good ones
MAD_TO_SIGMA = 1.482602218505602  # 1/Φ⁻¹(¾)
CODE_SIGMAS = 8.0  # of one frame's codes: no pixel of a normal core lies beyond, in any frame
MAP_SIGMAS = 6.0  # of a mean map
LEAST_CODES = 3.0  # a core narrower than a code is still this wide
QUARTILES_TO_SIGMA = 1.349  # between the quartiles of a normal distribution
SHOT_NOISE_REL = 0.2  # how near hot pixels' noise is taken to be to shot noise
FAR = 3.0  # standard uncertainties
MOST_HOT = 0.02  # of the pixels: what more of them share is a part of the sensor (a tap, a glowing corner), and belongs to its black level
NOISY_BY_CHANCE = 0.01  # good pixels of a frame whose sample variance is called too large


def robust_sigma(values: np.ndarray, floor: float = 0.0) -> float:
    """Standard deviation of the Gaussian core, from the median absolute deviation."""
    return max(MAD_TO_SIGMA * float(median(np.abs(values - median(values)))), floor)


def _without_lines(image: np.ndarray, least_clip: float = 0.0) -> np.ndarray:
    """The image less the means of its columns and rows, deviations clipped at four robust σ (``least_clip`` at least) for that.

    Medians alone would do less well: pixels near the middle draw them along, so that the core looks narrower than the tails are, and
    the median of coarse codes is itself a code. A defect moves a clipped mean by no more than the clip over the number of pixels.
    """
    residual: Array = image - median(image, axis=0)[None, :]
    residual -= median(residual, axis=1)[:, None]
    clip = max(4 * robust_sigma(residual), least_clip)
    for axis in (0, 1):
        residual -= np.clip(residual, -clip, clip).mean(axis=axis, keepdims=True)
    return residual


def find_defects(
    dark_stack: StackMoments, bright_stack: StackMoments | None = None, *, expected_false: float = 0.01, surface_degree: int = 4
) -> DefectList:
    """Find pixels that do not belong to the core of the others.

    Parameters
    ----------
    dark_stack : StackMoments
    bright_stack : StackMoments, optional
        Evenly lit; without it response is not judged.
    expected_false : float
        Mean number of good pixels called defect in one frame, over all tests together, if good pixels are Gaussian.
    surface_degree : int
        Degree of the polynomial that follows the illumination.

    Returns
    -------
    DefectList

    Raises
    ------
    InputError
        If the stacks differ in shape, or the light is missing in the bright one.

    Notes
    -----
    Each map is taken less the clipped means of its rows and columns, so that row and column patterns are not called defects, and divided
    by 1.4826 × the median absolute deviation. Noise is tested on the cube root of the sample variance, which is close to Gaussian for any
    number of frames (Wilson & Hilferty 1931). A map averaged over L frames has steps of 1/L: its σ is not taken below 1/(L√12).

    Where the temporal noise is small against a code (σ below about 0.4 DN), mean codes do not follow the signal: two pixels of the
    same signal can lie up to one code apart. What rounding can do at the worst phase is then taken off every deviation first, and the
    width of the core is read from the shares of pixels half a code above and below the commonest one.

    A hot pixel that stands above all good ones in the light although it seems to answer too little has met the end of the scale: it is
    hot, and its response is not known (``gain_rel`` is NaN).
    """
    from scipy.special import ndtri

    shape = dark_stack.shape
    if bright_stack is not None and bright_stack.shape != shape:
        raise InputError("dark and bright stack differ in shape", value=bright_stack.shape, allowed=str(shape))
    tests = 5 if bright_stack is not None else 3  # tails: dark and response have two, noise one
    threshold = -float(ndtri(expected_false / (tests * shape[0] * shape[1])))
    rounding = rounding_error_dn(dark_stack)
    coarse = rounding > COARSE_DN
    dark = _without_lines(dark_stack.mean_map_dn, COARSE_CLIP_DN if coarse else 0.0)
    sigma = robust_sigma(dark, 1 / (dark_stack.n_frames * np.sqrt(12)))
    if coarse:
        sigma = max(sigma, _core_of_codes_dn(dark_stack.mean_map_dn))
    noisy = _noise_z(dark_stack, coarse) > threshold
    # the mean of a noisy pixel scatters by its own noise, which does not make it hot or cold
    own = np.where(noisy, np.sqrt(dark_stack.var_map_dn2 / dark_stack.n_frames), 0.0)
    dark_z = _beyond(dark, 2 * rounding) / np.maximum(sigma, own)
    found = {"hot": dark_z > threshold, "cold": dark_z < -threshold, "noisy": noisy}
    gain, gain_sigma = np.full(shape, np.nan), float("nan")
    if bright_stack is not None:
        own = np.where(noisy, np.hypot(own, np.sqrt(bright_stack.var_map_dn2 / bright_stack.n_frames)), 0.0)
        gain, gain_z, gain_sigma, surface = _response(dark_stack, bright_stack, surface_degree, threshold, own, rounding)
        brightest_good = float(median(dark_stack.mean_map_dn)) + threshold * sigma + surface * (1 + threshold * gain_sigma)
        clipped = found["hot"] & (gain_z < -threshold) & (bright_stack.mean_map_dn > brightest_good)
        gain[clipped] = np.nan  # how they answer cannot be seen
        found["dead"] = (gain < 0.5) & (gain_z < -threshold)
        found["gain"] = (np.abs(gain_z) > threshold) & ~found["dead"] & ~clipped
        still = (dark_stack.var_map_dn2 == 0) & (bright_stack.var_map_dn2 == 0)
        found["stuck"] = found["dead"] & still & (np.abs(gain) < 0.01)
    kind = np.full(shape, "", dtype="U5")
    for name in reversed(KINDS):
        if name in found:
            kind[found[name]] = name
    row, col = np.nonzero(kind != "")
    return DefectList(
        row,
        col,
        tuple(kind[row, col].tolist()),
        dark[row, col],
        gain[row, col],
        expected_false,
        shape,
        dark_limit_dn=threshold * sigma + 2 * rounding,
        dark_sigma_dn=sigma,
        gain_sigma_rel=gain_sigma,
    )


def _white_dn2(stack: StackMoments) -> float:
    """Smallest temporal variance before rounding that can lie behind a stack; variances above 1 DN² only say that it is enough."""
    return white_before_rounding(float(np.minimum(stack.var_map_dn2, 1.0).mean()), core_spread_dn2(stack))


def rounding_error_dn(stack: StackMoments) -> float:
    """Most that the mean code of a pixel can be off its signal for rounding, in DN, ½ without any noise.

    Bound of the Fourier series Σ (−1)ᵏ/(πk) e^(−2π²k²σ²) sin 2πkx (Widrow and Kollár, Quantization Noise, ch. 5).
    """
    k = np.arange(1, 40)
    return min(float((np.exp(-2 * (np.pi * k) ** 2 * _white_dn2(stack)) / (np.pi * k)).sum()), 0.5)


def _core_of_codes_dn(mean_map: np.ndarray) -> float:
    """Width of a Gaussian of which the pixels half a code above and half a code below the commonest one are these shares."""
    from scipy.special import ndtri

    code = np.rint(median(mean_map))
    # half a pixel at least, for a share of which there is none
    shares = [max(float(np.mean(beyond > 0.5)), 0.5 / mean_map.size) for beyond in (mean_map - code, code - mean_map)]
    return 1.0 / float(max(-ndtri(shares).sum(), 0.5))


def _beyond(deviation: np.ndarray, slack: float) -> np.ndarray:
    """What of the deviations goes beyond ``slack``, with their sign."""
    rest: Array = np.sign(deviation) * np.maximum(np.abs(deviation) - slack, 0.0)
    return rest


def _noise_z(stack: StackMoments, coarse: bool) -> np.ndarray:
    root = np.cbrt(stack.var_map_dn2.astype(float))
    middle = float(median(root))
    if coarse:  # a pixel at the edge of a code toggles: up to ¼ DN² without any noise, else by the first harmonic
        white = _white_dn2(stack)
        edge = 0.25 + white if white < 0.05 else white + QUANTISATION_DN2 + (4 * white + 1 / np.pi**2) * np.exp(-2 * np.pi**2 * white)
        middle = max(middle, float(np.cbrt(edge)))
    # never narrower than the sampling of a variance on L − 1 degrees of freedom
    theory = middle * np.sqrt(2 / (9 * (stack.n_frames - 1)))
    sigma = max(robust_sigma(root), theory)
    return (root - middle) / sigma if sigma > 0 else np.zeros(stack.shape)


def _response(
    dark: StackMoments, bright: StackMoments, degree: int, threshold: float, own_dn: np.ndarray, rounding_dn: float
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Response over that of the smooth surface, how many robust σ it is off 1, that σ, and the surface (DN).

    Fitted again without what stood out.
    """
    light = bright.mean_map_dn - dark.mean_map_dn
    level = float(median(light))
    if level <= 0:
        raise InputError("the bright stack is not brighter than the dark one", value=level, allowed="a median difference above 0 DN")
    floor = np.hypot(1 / dark.n_frames, 1 / bright.n_frames) / np.sqrt(12) / level
    slack = 2 * (rounding_dn + rounding_error_dn(bright)) / level
    mask = np.zeros(light.shape, dtype=bool)
    for _ in range(2):
        surface = fit_surface(fill(light, mask), degree).values
        relative = light / surface
        flat = _without_lines(relative)
        sigma = robust_sigma(flat, floor)
        z = _beyond(flat, slack) / np.maximum(sigma, own_dn / level)
        mask = np.abs(z) > threshold
    return 1.0 + flat, z, sigma, surface


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
        between: Array = np.interp(series.bright.exposure_s, series.dark.exposure_s[order], values[order])
        return between

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
