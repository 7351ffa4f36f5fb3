"""What a preflight keeps of the frames of one condition: moments, profiles and a few sums, in one pass."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.observe.moments import LevelAccumulator, MeanSquares, check_frame

BLOCK = 8  # pixels: side of a JPEG block


@dataclass(frozen=True)
class Group:
    """Frames of one condition, reduced."""

    exposure_s: float | None
    photons: float | None
    bits: int
    n_frames: int
    mean_map_dn: np.ndarray  # shape (rows, cols)
    squares: MeanSquares  # temporal
    counts: np.ndarray  # of each code, over all frames, shape (2**bits,)
    frame_means_dn: np.ndarray  # shape (frames,)
    row_profiles_dn: np.ndarray  # mean of each row of each frame, shape (frames, rows)
    repeated: int  # frames that are the same as an earlier one, bit for bit
    follow_ratio: float  # variance of differences of neighbours over that of frames two apart; nan with fewer than three frames
    steps_x_dn2: np.ndarray  # mean square step of the first frame difference from one column to the next, shape (cols - 1,)
    steps_y_dn2: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.mean_map_dn.shape

    @property
    def mean_dn(self) -> float:
        """Mean of all frames."""
        return float(self.frame_means_dn.mean())

    def share(self, code: int) -> float:
        """Share of the pixels with this code."""
        return float(self.counts[code] / self.counts.sum())

    @property
    def mean_noise_dn2(self) -> float:
        """Variance of a frame's mean from the noise of pixels, rows and columns alone."""
        rows, cols = self.shape
        return self.squares.row_dn2 / rows + self.squares.col_dn2 / cols - self.squares.pixel_dn2 / (rows * cols)


def reduce_frames(
    frames: Iterable[np.ndarray], bits: int, exposure_s: float | None = None, photons: float | None = None, what: str = "frames"
) -> Group:
    """Reduce the frames of one condition; three of them are in memory at a time.

    Raises
    ------
    InputError
        Fewer than two frames, frames of different shapes, or codes above the stated bits.
    """
    moments, seen, profiles = LevelAccumulator(bits), set(), []
    recent: list[np.ndarray] = []
    steps = (np.zeros(0), np.zeros(0))
    near, far = [], []
    for frame in frames:
        frame = check_frame(frame, bits)
        moments.add(frame)
        seen.add(hashlib.blake2b(frame.tobytes(), digest_size=16).digest())
        profiles.append(frame.mean(axis=1))
        signed = frame.astype(np.int32)
        if recent:
            near.append(_difference_var(signed, recent[-1]))
        if len(recent) == 1:
            steps = _steps(signed - recent[0])
        if len(recent) == 2:
            far.append(_difference_var(signed, recent[0]))
        recent = [*recent[-1:], signed]
    if len(profiles) < 2:
        raise InputError(
            "too few frames", where=what, value=len(profiles), allowed="2 or more, better 4", remedy="take more frames under one condition"
        )
    return Group(
        exposure_s=exposure_s,
        photons=photons,
        bits=bits,
        n_frames=moments.n_frames,
        mean_map_dn=moments.mean_map_dn(),
        squares=moments.mean_squares(),
        counts=moments.counts,
        frame_means_dn=moments.frame_means_dn(),
        row_profiles_dn=np.array(profiles),
        repeated=len(profiles) - len(seen),
        follow_ratio=float(np.mean(near) / np.mean(far)) if far and np.mean(far) > 0 else float("nan"),
        steps_x_dn2=steps[0],
        steps_y_dn2=steps[1],
    )


def _difference_var(one: np.ndarray, other: np.ndarray) -> float:
    return float((one - other).var())


def _steps(difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along_x, along_y = np.diff(difference, axis=1).astype(float), np.diff(difference, axis=0).astype(float)
    return (along_x**2).mean(axis=0), (along_y**2).mean(axis=1)
