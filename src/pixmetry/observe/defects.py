"""Defect pixels: those that stand out from the others in the dark, in their response, or in their noise."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.observations import DefectList, StackMoments
from pixmetry.core.errors import InputError
from pixmetry.observe.photon_transfer_levels import core_spread_dn2
from pixmetry.observe.photon_transfer_model import QUANTISATION_DN2, white_before_rounding
from pixmetry.observe.surface import fill, fit_surface, median

KINDS = ("stuck", "dead", "hot", "cold", "gain", "noisy")  # worst first
COARSE_DN = 0.02  # largest error of a mean code above which a converter counts as coarse for its noise
COARSE_CLIP_DN = 2.0  # codes that lie about by rounding are good ones
MAD_TO_SIGMA = 1.482602218505602  # 1/Φ⁻¹(¾)


def robust_sigma(values: np.ndarray, floor: float = 0.0) -> float:
    """Standard deviation of the Gaussian core, from the median absolute deviation."""
    return max(MAD_TO_SIGMA * float(median(np.abs(values - median(values)))), floor)


def _without_lines(image: np.ndarray, least_clip: float = 0.0) -> np.ndarray:
    """The image less the means of its columns and rows, deviations clipped at four robust σ (``least_clip`` at least) for that.

    Medians alone would do less well: pixels near the middle draw them along, so that the core looks narrower than the tails are, and
    the median of coarse codes is itself a code. A defect moves a clipped mean by no more than the clip over the number of pixels.
    """
    residual = image - median(image, axis=0)[None, :]
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
    return np.sign(deviation) * np.maximum(np.abs(deviation) - slack, 0.0)


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
