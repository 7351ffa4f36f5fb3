"""How far the image is displaced from frame to frame, by parts of a pixel, found in the frames themselves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pixmetry.core.errors import MeasureError

MOST_CYCLES = 0.2  # per pixel: below this little of what lies beyond half a cycle is folded
BORDER = 0.15  # of each side, over which a frame is faded out
BLOCK_PX = 8  # of which each tells the shift on its own
ROUNDS, SETTLED_PX = 30, 1e-6
MOST_U_PX = 0.1  # of a shift that is of use


class FrameShifts(NamedTuple):
    """Displacement of the image in each frame against the first, along x and y, and its standard uncertainty; float64, shape (n, 2)."""

    shifts_px: np.ndarray
    u_px: np.ndarray


def frame_shifts(frames: np.ndarray) -> FrameShifts:
    """Compare each frame with the first at frequencies up to `MOST_CYCLES`, by least squares.

    The first guess is the peak of the phase correlation. The window that fades a frame out follows the image, so that it does not hold
    the shift back. The uncertainty is by the scatter of what blocks of the frame tell, which holds noise, and detail of an undersampled
    image that is folded down and follows the phase of each target on the pixels.

    Parameters
    ----------
    frames : ndarray, shape (n, rows, cols)

    Raises
    ------
    MeasureError
        If a frame does not tell its shift to `MOST_U_PX`.

    Examples
    --------
    >>> import numpy as np
    >>> x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    >>> blobs = [np.exp(-((x - 30 - s) ** 2 + (y - 20) ** 2) / 18) for s in (0.0, 0.25)]
    >>> print(np.abs(frame_shifts(np.array(blobs)).shifts_px[1]).round(4))
    [0.25 0.  ]
    """
    frames = np.asarray(frames, float)
    found = [_shift(frames[0], frame) for frame in frames[1:]]
    for k, (_, u) in enumerate(found, 1):
        if not (u < MOST_U_PX).all():
            remedy = "take a scene with detail along x and y, or give the shifts as a table"
            raise MeasureError(f"frame {k} does not tell its shift: u {u.max():.2g} px", where="shifts", remedy=remedy)
    zero = np.zeros((1, 2))
    return FrameShifts(np.concatenate([zero, *(s[None] for s, _ in found)]), np.concatenate([zero, *(u[None] for _, u in found)]))


def _shift(first: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = first.shape
    level, fade = first.mean(), _window(rows, cols, np.zeros(2))
    still, moving = np.fft.fft2((first - level) * fade), frame - level
    fy, fx = np.fft.fftfreq(rows)[:, None] + np.zeros(cols), np.fft.fftfreq(cols) + np.zeros((rows, 1))
    low = np.hypot(fx, fy) <= MOST_CYCLES
    s, nothing = _peak(still * low, np.fft.fft2(moving * fade) * low), np.full(2, np.inf)
    for _ in range(ROUNDS):
        moved = np.fft.fft2(moving * _window(rows, cols, s)) * np.exp(2j * np.pi * (fx * s[0] + fy * s[1])) * low
        power = float((np.abs(moved) ** 2).sum())
        if not power:
            return s, nothing
        moved *= float((np.conj(moved) * still).real.sum()) / power  # the light may differ
        rest = np.fft.ifft2(still * low - moved).real
        slopes = np.fft.ifft2(2j * np.pi * np.stack([fx, fy]) * moved).real
        normal = np.einsum("iyx,jyx->ij", slopes, slopes)
        if not np.linalg.cond(normal) < 1e6:
            return s, nothing
        step = np.linalg.solve(normal, np.einsum("iyx,yx->i", slopes, rest))
        s = s + step
        if np.abs(step).max() < SETTLED_PX:
            inverse = np.linalg.inv(normal)
            told = _block_sums(slopes * rest)  # of each block, shape (2, blocks); all together they are 0
            return s, np.sqrt(np.diag(inverse @ (told @ told.T) @ inverse))
    return s, nothing


def _block_sums(values: np.ndarray) -> np.ndarray:
    rows, cols = values.shape[1:]
    down, across = np.arange(0, rows, BLOCK_PX), np.arange(0, cols, BLOCK_PX)
    return np.asarray(np.add.reduceat(np.add.reduceat(values, down, axis=1), across, axis=2).reshape(2, -1))


def _peak(still: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Whole pixels by which the second is displaced against the first."""
    cross = moved * np.conj(still)
    size = np.abs(cross)
    surface = np.fft.ifft2(cross / np.sqrt(np.maximum(size, 1e-12 * max(size.max(), 1e-300)))).real
    place = np.unravel_index(int(np.argmax(surface)), surface.shape)
    y, x = (p if p <= n // 2 else p - n for p, n in zip(place, surface.shape, strict=True))
    return np.array([x, y], float)


def _window(rows: int, cols: int, shift_px: np.ndarray) -> np.ndarray:
    """Weight of the pixels, at the places of the image that they hold."""

    def along(n: int, shift: float) -> np.ndarray:
        places = np.arange(n) - shift
        inward = np.clip(np.minimum(places, n - 1 - places) / (BORDER * n), 0, 1)
        return np.asarray(np.sin(0.5 * np.pi * inward) ** 2)

    return np.outer(along(rows, shift_px[1]), along(cols, shift_px[0]))
