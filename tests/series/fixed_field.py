"""A fixed field of targets that moves as warm cameras make it move: written from the formulas, without the package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SHAPE = (582, 752)
CENTRE = np.array([375.5, 290.5])
PLACES = np.stack(np.meshgrid(np.linspace(76, 676, 4), np.linspace(60, 520, 4)), axis=-1).reshape(-1, 2)
TIME_S = np.arange(90) * 60.0
CLOCK_MHZ = 14.19


@dataclass(frozen=True)
class Warming:
    """What moves: camera, clock of the frame grabber, delay of its lines, and the whole image from frame to frame."""

    shift_x_px: float = 0.0
    shift_y_px: float = 0.0
    scale_rel: float = 0.0
    rotation_rad: float = 0.0
    fast_share: float = 0.3
    fast_s: float = 120.0
    slow_s: float = 1800.0
    scale_error_rel: float = 0.0
    scale_tau_s: float = 820.0
    delay_ns: float = 0.0
    delay_tau_s: float = 820.0
    lock_us: float = 10.5
    shift_std_px: float = 0.0

    def moved(self, time_s: float, places: np.ndarray = PLACES) -> np.ndarray:
        """Places at a time after switching on, shape (targets, 2)."""
        p = 1 - self.fast_share * np.exp(-time_s / self.fast_s) - (1 - self.fast_share) * np.exp(-time_s / self.slow_s)
        v, grown, turn = places - CENTRE, 1 + self.scale_rel * p, self.rotation_rad * p
        x = grown * (np.cos(turn) * v[:, 0] - np.sin(turn) * v[:, 1]) + self.shift_x_px * p + CENTRE[0]
        y = grown * (np.sin(turn) * v[:, 0] + np.cos(turn) * v[:, 1]) + self.shift_y_px * p + CENTRE[1]
        late = (x + 0.5 + self.lock_us * CLOCK_MHZ) * self.scale_error_rel * np.exp(-time_s / self.scale_tau_s)
        late = late + self.delay_ns * 1e-3 * CLOCK_MHZ * np.exp(-time_s / self.delay_tau_s)
        return np.column_stack([x + late, y])

    def positions(self, rng: np.random.Generator, u_px: float = 0.01, time_s: np.ndarray = TIME_S) -> tuple[np.ndarray, np.ndarray]:
        """Measured positions in every frame and their covariances."""
        made = [self.moved(t) + rng.normal(0, self.shift_std_px, 2) + rng.normal(0, u_px, PLACES.shape) for t in time_s]
        return np.array(made), np.broadcast_to(np.eye(2) * u_px**2, (len(time_s), len(PLACES), 2, 2))


def camera_of(rng: np.random.Generator) -> Warming:
    """A camera without a frame grabber."""
    return Warming(
        *rng.normal(0, 0.15, 2),
        scale_rel=rng.normal(0, 3e-4),
        rotation_rad=rng.normal(0, 5e-5),
        fast_share=rng.uniform(0.1, 0.6),
        fast_s=rng.uniform(60, 300),
        slow_s=rng.uniform(900, 2400),
        shift_std_px=rng.choice([0.0, 0.02]),
    )


def rendered(places: np.ndarray, shape: tuple[int, int], rng: np.random.Generator, radius_px: float = 4.0) -> np.ndarray:
    """A frame of soft bright discs with noise, 8 bits; each pixel is the mean over its square."""
    grey = np.full(shape, 20.0)
    fine = (np.arange(5) - 2) / 5
    reach = int(radius_px + 5)
    for px, py in places:
        col, row = (max(int(v) - reach, 0) for v in (px, py))
        y, x = (np.arange(first, first + 2 * reach + 1)[:, None] + fine for first in (row, col))
        apart = np.hypot(x[None, :, None, :] - px, y[:, None, :, None] - py)
        part = (150 / (1 + np.exp(4 * (apart - radius_px)))).mean(axis=(2, 3))
        seen = grey[row : row + len(y), col : col + len(x)]
        seen += part[: seen.shape[0], : seen.shape[1]]
    return np.clip(np.rint(grey + rng.normal(0, 1.2, shape)), 0, 255).astype(np.uint8)
