"""Defect pixels: those that stand out from the others in the dark, in their response, or in their noise."""

from __future__ import annotations

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.observations import DefectList, StackMoments
from pixmetry.experiment.surface import fill, fit_surface

KINDS = ("stuck", "dead", "hot", "cold", "gain", "noisy")  # worst first
MAD_TO_SIGMA = 1.482602218505602  # 1/Φ⁻¹(¾)


def robust_sigma(values: np.ndarray, floor: float = 0.0) -> float:
    """Standard deviation of the Gaussian core, from the median absolute deviation."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values)))), floor)


def _without_lines(image: np.ndarray) -> np.ndarray:
    """The image less the medians of its columns and rows, which defects hardly move."""
    residual = image - np.median(image, axis=0)[None, :]
    return residual - np.median(residual, axis=1)[:, None]


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
    Each map is taken less the medians of its rows and columns and divided by 1.4826 × the median absolute deviation, so that row and
    column patterns are not called defects. Noise is tested on the cube root of the sample variance, which is close to Gaussian for any
    number of frames (Wilson & Hilferty 1931). A map averaged over L frames has steps of 1/L: its σ is not taken below 1/(L√12).
    """
    from scipy.stats import norm

    shape = dark_stack.shape
    if bright_stack is not None and bright_stack.shape != shape:
        raise InputError("dark and bright stack differ in shape", value=bright_stack.shape, allowed=str(shape))
    tests = 5 if bright_stack is not None else 3  # tails: dark and response have two, noise one
    threshold = float(norm.isf(expected_false / (tests * shape[0] * shape[1])))
    dark = _without_lines(dark_stack.mean_map_dn)
    noisy = _noise_z(dark_stack) > threshold
    # the mean of a noisy pixel scatters by its own noise, which does not make it hot or cold
    own = np.where(noisy, np.sqrt(dark_stack.var_map_dn2 / dark_stack.n_frames), 0.0)
    dark_z = dark / np.maximum(robust_sigma(dark, 1 / (dark_stack.n_frames * np.sqrt(12))), own)
    found = {"hot": dark_z > threshold, "cold": dark_z < -threshold, "noisy": noisy}
    gain = np.full(shape, np.nan)
    if bright_stack is not None:
        own = np.where(noisy, np.hypot(own, np.sqrt(bright_stack.var_map_dn2 / bright_stack.n_frames)), 0.0)
        gain, gain_z = _response(dark_stack, bright_stack, surface_degree, threshold, own)
        found["dead"] = (gain < 0.5) & (gain_z < -threshold)
        found["gain"] = (np.abs(gain_z) > threshold) & ~found["dead"]
        still = (dark_stack.var_map_dn2 == 0) & (bright_stack.var_map_dn2 == 0)
        found["stuck"] = found["dead"] & still & (np.abs(gain) < 0.01)
    kind = np.full(shape, "", dtype="U5")
    for name in reversed(KINDS):
        if name in found:
            kind[found[name]] = name
    row, col = np.nonzero(kind != "")
    return DefectList(row, col, tuple(kind[row, col].tolist()), dark[row, col], gain[row, col], expected_false, shape)


def _noise_z(stack: StackMoments) -> np.ndarray:
    root = np.cbrt(stack.var_map_dn2.astype(float))
    median = float(np.median(root))
    # never narrower than the sampling of a variance on L − 1 degrees of freedom
    theory = median * np.sqrt(2 / (9 * (stack.n_frames - 1)))
    sigma = robust_sigma(root, theory)
    return (root - median) / sigma if sigma > 0 else np.zeros(stack.shape)


def _response(dark: StackMoments, bright: StackMoments, degree: int, threshold: float, own_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Response over that of the smooth surface, and how many robust σ it is off 1; fitted again without what stood out."""
    light = bright.mean_map_dn - dark.mean_map_dn
    level = float(np.median(light))
    if level <= 0:
        raise InputError("the bright stack is not brighter than the dark one", value=level, allowed="a median difference above 0 DN")
    floor = np.hypot(1 / dark.n_frames, 1 / bright.n_frames) / np.sqrt(12) / level
    mask = np.zeros(light.shape, dtype=bool)
    for _ in range(2):
        relative = light / fit_surface(fill(light, mask), degree).values
        flat = _without_lines(relative)
        z = flat / np.maximum(robust_sigma(flat, floor), own_dn / level)
        mask = np.abs(z) > threshold
    return 1.0 + flat, z
