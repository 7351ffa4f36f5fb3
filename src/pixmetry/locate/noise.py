"""How noisy a grey value is: the variance that weights a fit, and the ends of the scale at which values pile up.

A model is given in words, or read off a simulated camera's own forward model, so that it holds for every chain of sources.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.core.errors import InputError
from pixmetry.locate._noise_kernels import Noise, variances_dn2
from pixmetry.scene.uniform import Uniform

ROUNDING_DN2 = 1 / 12  # variance of rounding to whole numbers
LEAST_DN2 = 1e-12  # a noise model without noise still weights all pixels alike
SIDE = 64  # pixels of the window of a camera that is looked at
FRAMES = 12  # a level: variances to 0.7 % with SIDE² pixels
LEVELS = 8
MOST_PHOTONS = 1e9
KEYS = {"read": "read_dn", "gain": "slope_dn", "prnu": "pattern_rel", "dsnu": "pattern_dn", "black": "black_dn", "bits": "bits"}


@dataclass(frozen=True)
class NoiseModel:
    """Temporal variance of a pixel as a function of its mean grey value, and the scale's ends.

    ``variance = constant_dn2 + slope_dn · s + (pattern_rel · s)²`` with ``s = max(level − black_dn, 0)``.

    Parameters
    ----------
    constant_dn2 : float
        Variance without light in DN², rounding (1/12) included.
    slope_dn : float
        Variance per DN of light: the gain K in DN per electron (EMVA 1288, photon transfer).
    pattern_rel : float
        Standard deviation of the pixels' sensitivity (PRNU), where it is to count as noise.
    black_dn : float
        Grey value without light.
    low_dn, high_dn : float
        Grey values at which the scale ends: what lies beyond is stored as this.
    origin : str
        Where it is from: "camera", "image", or "given".
    slope_clear : bool
        Whether the slope is shot noise for certain; False where an image had so few pixels to tell it that it may be a shape that does not
        fit.
    row_shift_px, field_shift_px : float
        Standard deviation of the shift of each row along x by itself (line jitter), and of what neighbouring rows of a field share.

    Raises
    ------
    InputError
        If a variance is negative or not finite, or the scale's ends are not in order.
    """

    constant_dn2: float
    slope_dn: float = 0.0
    pattern_rel: float = 0.0
    black_dn: float = 0.0
    low_dn: float = -np.inf
    high_dn: float = np.inf
    origin: str = "given"
    slope_clear: bool = True
    row_shift_px: float = 0.0
    field_shift_px: float = 0.0

    def __post_init__(self) -> None:
        for name in ("constant_dn2", "slope_dn", "pattern_rel", "row_shift_px", "field_shift_px"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"{name} cannot be used", where="noise", value=value, allowed="0 or more")
        if not np.isfinite(self.black_dn) or not self.low_dn < self.high_dn:
            raise InputError(
                "the scale of grey values is upside down", where="noise", value=(self.low_dn, self.high_dn), allowed="low_dn < high_dn"
            )

    def variance_dn2(self, level_dn: np.ndarray | float) -> np.ndarray:
        """Return the variance at given mean grey values; same shape, DN²."""
        return variances_dn2(np.maximum(np.asarray(level_dn, float) - self.black_dn, 0.0), self)

    def with_constant(self, constant_dn2: float) -> NoiseModel:
        """The same with another variance without light."""
        return replace(self, constant_dn2=constant_dn2)

    def times(self, factor: float) -> NoiseModel:
        """The same noise of grey values that are so many times as large."""
        if factor == 1:
            return self
        constant, slope = self.constant_dn2 * factor**2, self.slope_dn * factor
        black, low, high = (v * factor for v in (self.black_dn, self.low_dn, self.high_dn))
        return replace(self, constant_dn2=constant, slope_dn=slope, black_dn=black, low_dn=low, high_dn=high)

    def numbers(self, dtype: np.dtype | None = None) -> Noise:
        """Return the model as kernels read it; the range of an integer type, where one is given, ends the scale too."""
        low, high = float(self.low_dn), float(self.high_dn)
        if dtype is not None and np.issubdtype(dtype, np.integer):
            low, high = max(low, float(np.iinfo(dtype).min)), min(high, float(np.iinfo(dtype).max))
        law = max(float(self.constant_dn2), LEAST_DN2), float(self.slope_dn), float(self.pattern_rel), float(self.black_dn)
        return Noise(*law, low, high, float(self.row_shift_px) ** 2, float(self.field_shift_px) ** 2)

    def describe(self) -> str:
        """Say it in words."""
        text = f"{self.origin}: variance {self.constant_dn2:.4g} DN²"
        if self.slope_dn:
            text += f" + {self.slope_dn:.4g} DN per DN of light above {self.black_dn:.4g}"
        if self.pattern_rel:
            text += f", sensitivities ±{self.pattern_rel:.2%}"
        if self.row_shift_px or self.field_shift_px:
            text += f"; rows shifted against each other by {np.hypot(self.row_shift_px, self.field_shift_px):.2g} px"
        return text


def parse_noise(text: str, rounded: bool = True) -> tuple[NoiseModel, float]:
    """Read a noise model from ``key=number,…``, as in ``read=1.5,gain=0.01,black=16,bits=8``.

    ``read`` is the standard deviation without light in DN, without rounding; ``gain`` is K in DN per electron; ``prnu`` and ``dsnu`` are
    the spreads of sensitivities (relative) and offsets (DN); ``black`` is the grey value without light; ``bits`` say where the scale ends.

    Returns
    -------
    NoiseModel
        Rounding (1/12 DN²) added to the constant if the values are ``rounded``.
    float
        ``dsnu`` in DN, which is not in the model.

    Raises
    ------
    InputError
        If a key or number cannot be used.
    """
    _, values = split_text(":" + text, KEYS, "noise")
    read, pattern, bits = values.pop("read_dn", 0.0), values.pop("pattern_dn", 0.0), values.pop("bits", None)
    if read < 0:
        raise InputError("the read noise cannot be used", where="noise", value=read, allowed="0 or more")
    if bits is not None and (bits != int(bits) or not 1 <= bits <= 32):
        raise InputError("the bits cannot be used", where="noise", value=bits, allowed="1 to 32")
    if bits is not None:
        values |= {"low_dn": 0.0, "high_dn": 2.0 ** int(bits) - 1}
    told: dict[str, Any] = dict(values)
    return NoiseModel(read**2 + (ROUNDING_DN2 if rounded else 0.0), **told), pattern


def split_text(text: str, keys: dict[str, str], where: str) -> tuple[str, dict[str, float]]:
    """Split ``name:key=value,…`` into the name and the numbers under the names that ``keys`` gives them."""
    name, _, rest = text.partition(":")
    values: dict[str, float] = {}
    for part in filter(None, (p.strip() for p in rest.split(","))):
        key, equals, number = (p.strip() for p in part.partition("="))
        if key not in keys or not equals:
            raise InputError(f"{part!r} cannot be used", where=where, allowed=", ".join(f"{k}=number" for k in keys))
        if keys[key] in values:
            raise InputError(f"{key!r} is given twice", where=where, remedy="give each value once")
        try:
            values[keys[key]] = float(number)
        except ValueError:
            raise InputError(f"{key} is not a number", where=where, value=number, allowed="a number") from None
        if not np.isfinite(values[keys[key]]):
            raise InputError(f"{key} is not a finite number", where=where, value=number, allowed="a finite number")
    return name.strip(), values


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
        If the camera does not respond to light.
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
        raise InputError(f"camera {camera.name} does not respond to light", remedy="name another camera, or give the noise in DN")
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
    """Variance of the mean image without the means of its rows and columns, minus the remaining temporal noise."""
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


def noise_model(noise: NoiseModel | Camera | str | Path | None) -> NoiseModel | None:
    """Return the noise model that is meant: a model, a camera, the name of one, or ``"read=…,gain=…,black=…"``; None stays None.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    if noise is None or isinstance(noise, NoiseModel):
        return noise
    if not isinstance(noise, Camera):
        if not isinstance(noise, str | Path):
            allowed = "a NoiseModel, a Camera, the name of one, or read=…,gain=…,black=…"
            raise InputError("not a noise", where="noise", value=noise, allowed=allowed)
        text = str(noise)
        if "=" in text:
            return parse_noise(text)[0]
        noise = load_camera(text)
    return camera_noise(noise).model
