"""A frame for the measurement: grey values for the kernels, and the ends of their scale."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.arguments import whole_number
from pixmetry.core.errors import InputError
from pixmetry.locate.noise import NoiseModel

MOSAIC_LEAST, MOSAIC_SIGMA = 0.02, 6.0  # difference of the two diagonals of 2 × 2 pixels: of the level, and of its standard error
MOSAIC_CELLS = 8_000  # of 2 × 2 pixels that are looked at
NEAR_END = 0.01  # of a float image's range: values that lie so near to its end
LEAST_SPAN, USUAL_SPAN, MOST_SPAN = 0.1, 1024.0, 1e6  # of the grey values of a float frame
PILED = 10  # pixels in 4 of one value at the end of an image before it is asked whether they were cut off there


def checked_frame(frame: np.ndarray, name: str = "frame") -> np.ndarray:
    """Return a frame as the kernels want it: C-contiguous uint8, uint16 or float32.

    Raises
    ------
    InputError
        If it is no grey image of finite real numbers.
    """
    array = np.asarray(frame)
    if array.ndim == 3 and array.shape[2] in (3, 4):
        remedy = "measure in one channel, such as frame[:, :, 1] (green)"
        raise InputError("a colour image", where=name, value=array.shape, allowed="one grey channel, two axes", remedy=remedy)
    if array.ndim != 2 or array.size == 0:
        raise InputError("not a grey image", where=name, value=array.shape, allowed="two axes (row, column), at least one pixel")
    if array.dtype.kind not in "buif":
        raise InputError("grey values are not real numbers", where=name, value=str(array.dtype), allowed="integers or floats")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = ~np.isfinite(array)
        row, col = np.argwhere(bad)[0]
        remedy = "replace them, for instance by the median of their neighbours"
        what = f"{int(bad.sum())} pixels are not finite, the first in row {row}, column {col}"
        raise InputError(what, where=name, allowed="finite grey values", remedy=remedy)
    if array.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(array, array.dtype.newbyteorder("="))
    if array.dtype.kind in "bui" and (array.dtype.kind == "b" or (array.min() >= 0 and array.max() < 1 << 16)):
        return np.ascontiguousarray(array, np.uint16)
    if array.dtype.kind == "f" and array.dtype.itemsize > 4 and np.abs(array).max() > np.finfo(np.float32).max:
        raise InputError("grey values are too large", where=name, value=float(np.abs(array).max()), allowed="up to 3e38 (single precision)")
    return np.ascontiguousarray(array, np.float32)


def unit_of(frame: np.ndarray) -> float:
    """Power of two by which a float frame is to be divided, so that its grey values are of a size that single precision squares well.

    1 for integers, and for floats that span 0.1 to 1e6. Frames in W/m² or in electrons per second may span 1e-9 or 1e20.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.frame import unit_of
    >>> unit_of(np.array([[0.0, 255.0]])), unit_of(np.array([[0.0, 1024.0 * 2.0**-40]])) == 2.0**-40
    (1.0, True)
    """
    if frame.dtype.kind != "f" or not frame.size:
        return 1.0
    span = float(frame.max()) - float(frame.min())  # NaN where a value is
    if not (0 < span < math.inf) or LEAST_SPAN <= span <= MOST_SPAN:
        return 1.0
    return 2.0 ** round(math.log2(span / USUAL_SPAN))


def scale_ends(frame: np.ndarray, bits: int | None, noise: NoiseModel | None) -> tuple[float, float]:
    """Tell at which grey values the scale ends: from the noise model, the bits, or the image itself.

    Without bits, an integer image is taken to end at the greatest value of 8, 10, 12, 14 or 16 bits if it reaches it. Any image is taken to
    end at its own greatest value if far more pixels have this one than values a little below: they were cut off there. A float image
    without negative values begins at 0 if pixels have it.

    Raises
    ------
    InputError
        If there are no such bits, or the image has more.
    """
    if frame.dtype.kind == "f":
        if noise is not None:
            return noise.low_dn, noise.high_dn
        high, black = float(frame.max()), np.count_nonzero(frame[::2, ::2] == 0) >= PILED
        low = 0.0 if frame.min() == 0 and black else -np.inf
        return low, high if _cut_off_at(frame, high, NEAR_END * (high - float(frame.min()))) else np.inf
    if bits is not None:
        bits = whole_number(bits, "bits", "the bits of a value cannot be used", least=1, most=16, allowed="1 to 16")
        high = float((1 << int(bits)) - 1)
        if frame.max() > high:
            raise InputError("grey values that have more bits", where="bits", value=int(frame.max()), allowed=f"up to {high:.0f}")
        return 0.0, high
    if noise is not None and np.isfinite(noise.high_dn):
        return max(0.0, noise.low_dn), noise.high_dn
    top = int(frame.max())
    if any(top == (1 << n) - 1 for n in (8, 10, 12, 14, 16)) or _cut_off_at(frame, top, 3):
        return 0.0, float(top)
    return 0.0, float("inf")


def _cut_off_at(frame: np.ndarray, top: float, near_dn: float) -> bool:
    """Whether far more pixels have the greatest value than lie little below it, in an image that has noise."""
    part = frame[::2, ::2]
    piled = int(np.count_nonzero(part == top))
    if piled < PILED or piled <= 3 * int(np.count_nonzero(part >= top - near_dn)) - 3 * piled:
        return False
    usual = float(np.median(part[::4, ::4]))
    without_noise = usual > 0 and np.count_nonzero(part[::4, ::4] == usual) > 0.5 * part[::4, ::4].size
    return bool(top > part.min()) and not without_noise


def looks_like_mosaic(frame: np.ndarray) -> bool:
    """Tell whether a frame is the raw frame of a colour camera: by the typical differences within cells of 2 × 2 pixels.

    Green lies on one diagonal of a cell (Bayer, US 3971065, 1976), red and blue on the other. So one diagonal is brighter, or, where green
    is the mean of the two, rows and columns alternate by the same amount. Rows alone alternate in interlaced frames, columns alone in
    frames of two taps; targets differ too, but do not fill most of the cells.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.locate.frame import looks_like_mosaic
    >>> grey = np.random.default_rng(1).normal(100, 2, (60, 80))
    >>> looks_like_mosaic(grey), looks_like_mosaic(grey * np.tile([[0.6, 1.0], [1.0, 0.7]], (30, 40)))
    (False, True)
    """
    high, wide = (side // 2 for side in frame.shape)
    if min(high, wide) < 8:
        return False
    step = max(int(np.sqrt(high * wide / MOSAIC_CELLS)), 1)
    a, b, c, d = (frame[i : 2 * high : 2, j : 2 * wide : 2][::step, ::step].astype(np.float32).ravel() for i in (0, 1) for j in (0, 1))
    least = MOSAIC_LEAST * abs(float(np.median(a + b + c + d))) / 4

    def typical(difference: np.ndarray) -> float:
        """Median, or 0 where it may be chance; 1.86 = 1.4826 · 1.2533 makes the standard error of a median of the MAD."""
        middle = float(np.median(difference))
        error = 1.86 * float(np.median(np.abs(difference - middle))) / np.sqrt(len(difference))
        return middle if abs(middle) > MOSAIC_SIGMA * error else 0.0

    diagonals, rows, cols = typical((a + d - b - c) / 2), typical((a + b - c - d) / 2), typical((a + c - b - d) / 2)
    both = min(abs(rows), abs(cols))
    return abs(diagonals) > least or (both > least and both > 0.8 * max(abs(rows), abs(cols)))
