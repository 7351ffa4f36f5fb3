"""A laser spot with speckle: light of a rough surface, filtered by the pupil."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.light import Points
from pixmetry.core.arrays import Array
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid, Stream
from pixmetry.scene.motion import STILL, Motion
from pixmetry.scene.shapes import pixel_points

OVERSAMPLING = 6  # raster steps per period of the finest detail of the intensity; splines of fifth order are good to 4e-5 of it
LARGEST_RASTER = 2048
MARGIN = 8.0  # periods of the finest detail around the spot
SMALL_RASTER = 512  # of which more realisations and boxes are kept
BOX_STEP = 0.02  # boxes whose sides differ by less (relative) are one: under a map that stretches, every pixel would have its own field


@dataclass(frozen=True)
class Speckle:
    """A laser spot on a rough surface.

    The amplitude √I exp(iφ), φ independent from place to place, passes a round pupil, which cuts it off at the frequency 1/(2 λN); the
    intensity is its square (fully developed speckle, contrast 1: Goodman, Speckle Phenomena in Optics, ch. 3). A smaller contrast is a sum
    of independent patterns, 1/C² of them.

    The field is made once for each realisation on a raster about the spot and belongs to the spot, so windows do not change it.

    Parameters
    ----------
    x_px, y_px : float
        Middle of the spot.
    radius_px : float
        Where the intensity of a Gaussian spot is exp(−2) of its peak, or the radius of a uniform one.
    peak_photons : float
        Mean of the intensity in the middle, over realisations, for a spot much larger than the speckle.
    lambda_n_px : float
        Wavelength times working f-number over the pixel pitch: the period of the finest detail of the intensity.
    profile : {"gaussian", "uniform"}
    contrast : float
        Standard deviation over mean of the light within the spot, before pixels average it; 0 for light without speckle.
    seed : int
    frames_each : int
        Frames in a row that see the same realisation; 0 if all do.
    motion : Motion
        Of spot and speckle together.
    """

    x_px: float
    y_px: float
    radius_px: float
    peak_photons: float
    lambda_n_px: float
    profile: Literal["gaussian", "uniform"] = "gaussian"
    contrast: float = 1.0
    seed: int = 0
    frames_each: int = 1
    motion: Motion = STILL
    own_light: ClassVar[bool] = True  # a laser does not need the scene's lamp

    def __post_init__(self) -> None:
        usable = np.isfinite([self.x_px, self.y_px]).all() and self.radius_px > 0 and 0.02 <= self.lambda_n_px <= 100
        usable = usable and self.peak_photons >= 0
        if not usable or self.frames_each < 0 or not (self.contrast == 0 or 0.1 <= self.contrast <= 1):
            raise ParameterError(
                "a laser spot cannot be used",
                where="spot",
                allowed="finite place, radius above 0 px, lambda_n 0.02 to 100 px, contrast 0 or 0.1 to 1, frames_each 0 or more",
            )
        if self.side > LARGEST_RASTER:
            raise ParameterError(
                "the spot is too large for its speckle",
                where="spot",
                value=self.side,
                allowed=f"{LARGEST_RASTER} raster points across",
                remedy="make the spot smaller, or the f-number larger",
            )

    @property
    def moving(self) -> bool:
        """Whether it changes from frame to frame or with time."""
        return (self.frames_each > 0 and self.contrast > 0) or not self.motion.still

    @property
    def smooth_px(self) -> float:
        """Scale of the finest detail, as a Gaussian's deviation."""
        return self.lambda_n_px / 8

    @property
    def step_px(self) -> float:
        """Spacing of the raster."""
        return self.lambda_n_px / OVERSAMPLING

    @property
    def half_px(self) -> float:
        """Half side of the region that has light."""
        return (2.5 if self.profile == "gaussian" else 1.0) * self.radius_px + MARGIN * self.lambda_n_px

    @cached_property
    def side(self) -> int:
        """Points across the raster: a fast length for the Fourier transform."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(int(np.ceil(2 * self.half_px / self.step_px))))

    def intensity(self, realisation: int) -> np.ndarray:
        """Photons per pixel at the points of the raster, shape (side, side), float64; its middle is at index side // 2."""
        from scipy.fft import fft2, fftfreq, ifft2

        across = (np.arange(self.side) - self.side // 2) * self.step_px
        r2 = across[:, None] ** 2 + across[None, :] ** 2
        if self.profile == "gaussian":
            spot = np.exp(-2 * r2 / self.radius_px**2)
        else:
            spot = np.clip((self.radius_px - np.sqrt(r2)) / self.step_px + 0.5, 0.0, 1.0)
        f = fftfreq(self.side, self.step_px)
        pupil = f[:, None] ** 2 + f[None, :] ** 2 <= (0.5 / self.lambda_n_px) ** 2
        share = pupil.mean()
        if self.contrast == 0:  # incoherent: the mean of all realisations
            spread = np.abs(ifft2(pupil.astype(float))) ** 2
            mean: Array = self.peak_photons * np.maximum(ifft2(fft2(spot) * fft2(spread)).real / share, 0.0)
            return mean
        out = np.zeros_like(spot)
        for k, weight in enumerate(_weights(self.contrast)):
            grid = Grid.whole([realisation], spot.shape)
            phase = 2 * np.pi * Stream(0, self.seed, "scene.speckle").uniform(grid, k)[0].astype(float)
            field = ifft2(fft2(np.sqrt(spot) * np.exp(1j * phase)) * pupil)
            out += weight * (field.real**2 + field.imag**2)
        speckles: Array = self.peak_photons * out / share
        return speckles

    def _splines(self, realisation: int, width_px: float, height_px: float, blur_px: float) -> np.ndarray:
        kept = _many if self.side <= SMALL_RASTER else _few
        return kept(_Frozen(self), realisation, width_px, height_px, blur_px)

    def sums(self, at: Points, width_px: ArrayLike, height_px: ArrayLike, lit: bool) -> np.ndarray:
        """Light averaged over a box about each point, shape (1 or 3, …); see `Shapes.sums`."""
        from scipy.ndimage import map_coordinates

        dx, dy = self.motion.offset(at.time_s, at.frame)
        row = (at.y_px - dy - self.y_px) / self.step_px + self.side // 2
        col = (at.x_px - dx - self.x_px) / self.step_px + self.side // 2
        frame, width, height = (np.broadcast_to(v, at.x_px.shape) for v in (at.frame, width_px, height_px))
        number = frame // self.frames_each if self.frames_each and self.contrast else np.zeros_like(frame)
        size = np.round(np.log(np.maximum(np.stack([width, height]), 1e-6)) / BOX_STEP)
        out = np.zeros((3 if lit else 1, *at.x_px.shape))
        margin = 3.0
        inside = (np.minimum(row, col) >= margin) & (np.maximum(row, col) <= self.side - 1 - margin)
        key = np.stack([number[inside], *size[:, inside]])
        kinds, which = np.unique(key, axis=1, return_inverse=True)
        value, row, col = np.zeros(key.shape[1]), row[inside], col[inside]
        for k, (realisation, w, h) in enumerate(kinds.T):
            here = which.ravel() == k
            across, down = np.exp(BOX_STEP * np.array([w, h]))
            table = self._splines(int(realisation), float(across), float(down), float(at.blur_px))
            value[here] = map_coordinates(table, [row[here], col[here]], order=5, prefilter=False, mode="constant")
        out[0, inside] = value
        return out

    def render(self, grid: Grid, frame_shape: tuple[int, int], time_s: np.ndarray, exposure_s: np.ndarray, lit: bool) -> np.ndarray:
        """Light of full pixels, shape (n, 1 or 3, rows, cols)."""
        return self.sums(pixel_points(grid, frame_shape, time_s, exposure_s), np.float64(1), np.float64(1), lit).swapaxes(0, 1)

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Where the spot has light."""
        dx, dy = self.motion.offset(at.time_s, at.frame)
        far = np.maximum(np.abs(at.x_px - dx - self.x_px), np.abs(at.y_px - dy - self.y_px))
        return np.broadcast_to(far <= self.half_px + np.asarray(reach_px) + self.step_px, at.x_px.shape)

    def targets(self, time_s: float, frame: int) -> list[dict[str, Any]]:
        """The middle of the spot."""
        dx, dy = self.motion.offset(np.float64(time_s), np.int64(frame))
        return [{"kind": "spot", "x_px": self.x_px + float(dx), "y_px": self.y_px + float(dy), "radius_px": self.radius_px}]


class _Frozen:
    """A spot as the key of a cache: equal if it makes the same field."""

    def __init__(self, spot: Speckle) -> None:
        self.spot = spot
        self.key = tuple(v for k, v in vars(spot).items() if k not in ("motion", "frames_each"))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Frozen) and self.key == other.key


def _splines(frozen: _Frozen, realisation: int, width_px: float, height_px: float, blur_px: float) -> np.ndarray:
    """Coefficients of the spline through the intensity, averaged over a box and a Gaussian on the Fourier side, where that is exact."""
    from scipy.fft import fft2, fftfreq, ifft2
    from scipy.ndimage import spline_filter

    spot = frozen.spot
    f = fftfreq(spot.side, spot.step_px)
    across, down = (np.sinc(f * size) * np.exp(-2 * (np.pi * f * blur_px) ** 2) for size in (width_px, height_px))
    seen = ifft2(fft2(spot.intensity(realisation)) * (down[:, None] * across[None, :])).real
    splines: Array = spline_filter(seen, order=5, mode="mirror")
    return splines


_many, _few = lru_cache(maxsize=24)(_splines), lru_cache(maxsize=3)(_splines)


def _weights(contrast: float) -> np.ndarray:
    """Weights of independent patterns with sum 1 and sum of squares C²: all equal but the last."""
    count = int(np.ceil(1 / contrast**2 - 1e-9))
    if count == 1:
        return np.ones(1)
    # (m − 1) a + b = 1, (m − 1) a² + b² = C²
    m = count - 1
    a = (m + np.sqrt(max(m * m - m * (m + 1) * (1 - contrast**2), 0.0))) / (m * (m + 1))
    return np.array([a] * m + [1 - m * a])
