"""The noise model of a camera for locating: read off its own forward model, so that it holds for every chain of sources."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pixmetry.core.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.location.noise import NoiseModel
from pixmetry.scene.uniform import Uniform

SIDE = 64  # pixels of the window that is looked at
FRAMES = 12  # a level: variances to 0.7 % with SIDE² pixels
LEVELS = 8
MOST_PHOTONS = 1e9


def noise_of_camera(camera: Camera) -> NoiseModel:
    """Measure a simulated camera's temporal variance against its mean grey value, its black level and where its scale ends.

    Uniform fields of rising brightness are exposed; a straight line through mean and temporal variance (EMVA 1288, photon transfer) is
    fitted up to 80 % of the range, weighted by the sampling errors of the variances.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    NoiseModel
        With ``origin="camera"``; rounding is in the constant, fixed patterns are not in it.

    Raises
    ------
    InputError
        If the camera does not answer to light.
    """
    rows, cols = camera.output_shape
    side_r, side_c = min(SIDE, rows), min(SIDE, cols)
    window = ((rows - side_r) // 2, (cols - side_c) // 2, side_r, side_c)

    def exposed(photons: float, count: int = FRAMES) -> np.ndarray:
        frames = camera.iter_frames(Uniform(level_photons=photons), range(count), window=window)
        return np.stack([s.data[0].astype(float) for s in frames])

    dark, top = exposed(0.0), exposed(MOST_PHOTONS, 2)
    black, high = float(dark.mean()), float(np.median(top))
    if high - black < 1.0:
        raise InputError(f"camera {camera.name} does not answer to light", remedy="name another camera, or give the noise in DN")
    scale = _photons_for(exposed, black, high)
    stacks = [dark, *(exposed(scale * k / LEVELS) for k in range(1, LEVELS + 1))]
    level = np.array([s.mean() for s in stacks]) - black
    variance = np.array([s.var(axis=0, ddof=1).mean() for s in stacks])
    slope, constant = np.polyfit(level, variance, 1, w=1 / np.maximum(variance, 1e-12))
    slope = max(float(slope), 0.0)
    low = float(dark.min()) if np.median(dark) == dark.min() else 0.0
    return NoiseModel(max(float(constant), 1 / 12), slope, black_dn=black, low_dn=low, high_dn=high, origin="camera")


def _photons_for(exposed: Callable[..., np.ndarray], black: float, high: float) -> float:
    """Find the light that takes the mean grey value to 80 % of its range, to about a tenth."""
    low, up, wanted = 0.01, MOST_PHOTONS, black + 0.8 * (high - black)
    while up / low > 1.1:
        middle = float(np.sqrt(low * up))
        if exposed(middle, 1).mean() < wanted:
            low = middle
        else:
            up = middle
    return low
