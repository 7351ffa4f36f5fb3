"""A camera whose noise is known from an assessment: what its pixels share, and which of them are defect."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.core.errors import InputError
from pixmetry.files.assessment import load_assessment
from pixmetry.locate.noise import NoiseModel, camera_noise
from pixmetry.locate.noise_correlation import LAGS_PX, Correlation, lag_sums
from pixmetry.scene.uniform import Uniform

PAIRS = 40  # of frames whose differences tell what pixels share
SIDE = 96  # of the window of the camera that is looked at, px
STEPS = 40  # of the search for the light of a level
MOST_PHOTONS = 1e9


@dataclass(frozen=True)
class KnownCamera:
    """What is known of a camera before its frames are seen.

    Parameters
    ----------
    camera : Camera
    noise : NoiseModel
        Of a single frame: temporal noise, and the spread of offsets and sensitivities.
    pattern_dn : float
        Standard deviation of the pixels' own offsets, which is in it.
    lines_dn2 : (float, float)
        Variances of the offsets that rows share, and of those that columns share, which are in it too.
    bits : int or None
        Of a stored value.
    defects : ndarray of bool, shape (rows, cols), or None
    """

    camera: Camera
    noise: NoiseModel
    pattern_dn: float
    lines_dn2: tuple[float, float]
    bits: int | None
    defects: np.ndarray | None
    seen: dict[int, Correlation] = field(default_factory=dict, repr=False)  # correlations by tenths of the logarithm of the variance

    def correlation_at(self, level_dn: float) -> Correlation:
        """Autocovariance of the noise at a mean grey value, from frames of the camera; what rows and columns share is in it.

        It is that of the level at or below whose variance is a power of 1.1, so that it does not depend on which frames were seen before.
        """
        constant, slope, black = self.noise.constant_dn2, self.noise.slope_dn, self.noise.black_dn
        rise = slope * max(level_dn - black, 0.0) / constant
        key = math.floor(10 * math.log1p(rise))
        if key not in self.seen:
            self.seen[key] = self._correlation(black + (constant * math.expm1(key / 10) / slope if slope else 0.0))
        return self.seen[key]

    def _correlation(self, level_dn: float) -> Correlation:
        low, high = 0.01, MOST_PHOTONS
        for _ in range(STEPS):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if exposed(self.camera, middle, 1).mean() < level_dn else (low, middle)
        frames = exposed(self.camera, low, 2 * PAIRS)
        side = frames.shape[-1]
        differences = (frames[0::2] - frames[1::2]) / np.sqrt(2)
        lags = slice(side - 1 - LAGS_PX, side + LAGS_PX)
        products = sum(lag_sums(one[None])[0] for one in differences - differences.mean(axis=(1, 2), keepdims=True))
        pairs = PAIRS * np.rint(lag_sums(np.ones((1, side, side)))[0])
        covariance = (products / np.maximum(pairs, 1))[lags, lags]
        covariance[LAGS_PX, LAGS_PX] += self.pattern_dn**2
        covariance[LAGS_PX] += self.lines_dn2[0]
        covariance[:, LAGS_PX] += self.lines_dn2[1]
        return Correlation(covariance, pairs[lags, lags])

    def check_bits(self, frame: np.ndarray, bits: int | None, name: str) -> None:
        """Refuse grey values that are not those that the camera stores.

        Raises
        ------
        InputError
            If they are of other bits. Of floats, such as corrected frames, nothing is known.
        """
        if self.bits is None:
            return
        allowed, remedy = f"{self.bits} bits, as the camera stores them", "give the frames as they were stored, or the noise in DN"
        if bits is not None and bits != self.bits:
            raise InputError("other bits than the camera's", where="bits", value=bits, allowed=allowed, remedy="leave the bits out")
        if frame.dtype == np.uint8 and self.bits > 8:
            raise InputError("grey values of 8 bits", where=name, allowed=allowed, remedy=remedy)
        if frame.dtype.kind == "u" and frame.max() > 2**self.bits - 1:
            raise InputError("grey values that have more bits", where=name, value=int(frame.max()), allowed=allowed, remedy=remedy)

    def defects_of(self, shape: tuple[int, int], name: str) -> np.ndarray | None:
        """The map of defects for frames of this shape; None without any.

        Raises
        ------
        InputError
            If the map has another size.
        """
        if self.defects is None or not self.defects.any():
            return None
        if self.defects.shape != shape:
            what = "the map of defects has another size than the frame"
            raise InputError(what, where=name, value=shape, allowed=str(self.defects.shape), remedy="give frames of the whole sensor")
        return self.defects


def known_camera(with_: KnownCamera | Camera | str | Path) -> KnownCamera:
    """What is known of a camera: from the results of its assessment, or from a camera file or preset, which has no map of defects.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    if isinstance(with_, KnownCamera):
        return with_
    maps: dict[str, np.ndarray] = {}
    bits = None
    if not isinstance(with_, Camera | str | Path):
        allowed = "the folder of an assessment, a camera file or preset, a Camera"
        raise InputError("not a camera", where="with_", value=with_, allowed=allowed)
    if isinstance(with_, Camera):
        camera = with_
    elif Path(with_).is_dir() or Path(with_).suffix.lower() == ".json":
        bits, camera, maps = load_assessment(with_)
    else:
        camera = load_camera(with_)
    if bits is None:
        bits = next((e.params.bits for e in camera.active if e.source.id == "grabber.adc"), None)
    found = camera_noise(camera)
    lines = line_offsets_dn2(camera, found.pattern_dn)
    noise = found.model.with_constant(found.model.constant_dn2 + found.pattern_dn**2 + sum(lines))
    return KnownCamera(camera, noise, found.pattern_dn, lines, bits, maps["defects"] != 0 if "defects" in maps else None)


def exposed(camera: Camera, photons: float, count: int) -> np.ndarray:
    """Frames of even light, of the middle of a camera; shape (count, side, side)."""
    rows, cols = camera.output_shape
    side = min(SIDE, rows, cols)
    window = ((rows - side) // 2, (cols - side) // 2, side, side)
    frames = camera.iter_frames(Uniform(level_photons=photons), range(count), window=window)
    return np.stack([s.data[0].astype(float) for s in frames])


def line_offsets_dn2(camera: Camera, pattern_dn: float) -> tuple[float, float]:
    """Variance of the offsets in the dark that rows share, and of those that columns share, DN²; slow changes over the frame are none.

    From products of the means of two sets of frames, whose noise is not the same; less what the pixels' own offsets leave in a mean.
    """
    frames = exposed(camera, 0.0, 2 * PAIRS)
    halves, n = (frames[0::2].mean(axis=0), frames[1::2].mean(axis=0)), frames.shape[-1]
    at = np.linspace(-1, 1, n)
    basis = np.linalg.qr(np.stack([at**0, at, at**2], axis=1))[0]
    found = []
    for axis in (1, 0):
        one, other = (v - basis @ (basis.T @ v) for v in (half.mean(axis=axis) for half in halves))
        found.append(max(float(one @ other) / max(n - 3, 1) - pattern_dn**2 / n, 0.0))
    return found[0], found[1]


def mended(frame: np.ndarray, defects: np.ndarray) -> np.ndarray:
    """A frame with the median of the good pixels beside them in place of its defect pixels."""
    out = frame.copy()
    rows, cols = frame.shape
    for row, col in np.argwhere(defects):
        for reach in (1, 2, 4, 8):
            near = slice(max(row - reach, 0), min(row + reach + 1, rows)), slice(max(col - reach, 0), min(col + reach + 1, cols))
            good = frame[near][~defects[near]]
            if len(good) >= 3:
                out[row, col] = np.median(good).astype(frame.dtype)
                break
    return out
