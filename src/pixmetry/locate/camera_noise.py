"""What a camera adds to a grey value: read off its own forward model, so that it holds for every chain of sources."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel
from pixmetry.scene.uniform import Uniform

SIDE = 64  # pixels of the window that is looked at
FRAMES = 12  # a level: variances to 0.7 % with SIDE² pixels
LEVELS = 8
MOST_PHOTONS = 1e9


@dataclass(frozen=True)
class CameraNoise:
    """What a camera adds to a grey value.

    Parameters
    ----------
    model : NoiseModel
        Temporal noise of a pixel and the spread of the sensitivities; of origin "camera".
    pattern_dn : float
        Standard deviation of the fixed offsets from pixel to pixel (DSNU), without those common to a row or column; not in the model.
    aperture_px : float
        Side of the square that has the area of the pixel's sensitive part.
    pitch_um : (float, float) or None
    """

    model: NoiseModel
    pattern_dn: float
    aperture_px: float
    pitch_um: tuple[float, float] | None


def camera_noise(camera: Camera) -> CameraNoise:
    """Measure a simulated camera's variance against its mean grey value, its patterns, its black level and where its scale ends.

    Uniform fields of rising brightness are exposed at the middle of the frame; a straight line through mean and temporal variance
    (EMVA 1288, photon transfer) is fitted up to 80 % of the range, weighted by the sampling errors of the variances. Noise that is common
    to a row counts as if it were independent in every pixel. Good to about a hundredth.

    Parameters
    ----------
    camera : Camera

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
    low, up, wanted = 0.01, MOST_PHOTONS, black + 0.8 * (high - black)
    while up / low > 1.1:
        middle = float(np.sqrt(low * up))
        low, up = (middle, up) if exposed(middle, 1).mean() < wanted else (low, middle)
    stacks = [dark, *(exposed(low * k / LEVELS) for k in range(1, LEVELS + 1))]
    level = np.array([s.mean() for s in stacks]) - black
    variance = np.array([s.var(axis=0, ddof=1).mean() for s in stacks])
    slope, constant = np.polyfit(level, variance, 1, w=1 / np.maximum(variance, ROUNDING_DN2))
    offsets = _pattern_dn2(dark)
    sensitivities = max(_pattern_dn2(stacks[-1]) - offsets, 0.0) / level[-1] ** 2
    model = NoiseModel(
        max(float(constant), ROUNDING_DN2),
        max(float(slope), 0.0),
        float(np.sqrt(sensitivities)),
        black_dn=black,
        low_dn=float(dark.min()) if np.median(dark) == dark.min() else 0.0,
        high_dn=high,
        origin="camera",
    )
    return CameraNoise(model, float(np.sqrt(offsets)), _aperture_px(camera), camera.pitch_um)


def _pattern_dn2(stack: np.ndarray) -> float:
    """Variance of the mean image without the means of its rows and columns, less what the temporal noise leaves in it."""
    mean = stack.mean(axis=0)
    mean = mean - mean.mean(axis=1, keepdims=True) - mean.mean(axis=0, keepdims=True) + mean.mean()
    rows, cols = mean.shape
    spread = (mean**2).sum() / max((rows - 1) * (cols - 1), 1)
    return max(float(spread - stack.var(axis=0, ddof=1).mean() / len(stack)), 0.0)


def _aperture_px(camera: Camera) -> float:
    """Of the source that has it; 1 where the camera has none."""
    for element in camera.active:
        if element.source.id == "sensor.pixel_aperture":
            return float(np.sqrt(element.params.width_x_px * element.params.width_y_px))
    return 1.0
