"""Frames of lines at known places, and the least variance of their offsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from locate import rendered


@dataclass(frozen=True)
class Bars:
    """Bright bars of one length, width and blur, in DN and pixels."""

    length: float = 60.0
    width: float = 3.0
    blur: float = 0.7
    amplitude: float = 170.0
    background: float = 10.0
    read_dn: float = 1.5

    def least_offset_var(self, angle_deg: float) -> float:
        """Cramér–Rao bound of the offset across the bar, px²; unknown: offset, angle, height, background, width, blur."""
        turn = np.deg2rad(angle_deg)
        at = rendered.window(0, 0, self.length / 2 + 5 * self.blur)

        def mean(p: np.ndarray) -> np.ndarray:
            x, y = -np.sin(turn) * p[0], np.cos(turn) * p[0]
            return p[3] + p[2] * rendered.bar(x, y, angle_deg + p[1], self.length, p[4], p[5], at)

        start = (0.2, 0.0, self.amplitude, self.background, self.width, self.blur)
        return rendered.bound(mean, start, self.read_dn**2 + 1 / 12)[0, 0]


@dataclass
class LineFrame:
    """An image of bars, their middles and angles."""

    bars: Bars
    image: np.ndarray
    x: np.ndarray
    y: np.ndarray
    angle_deg: np.ndarray


def make_lines(
    rng: np.random.Generator, count: int, shape: tuple[int, int], bars: Bars | None = None, angles: tuple[float, float] = (-90, 90)
) -> LineFrame:
    """Bars that do not touch, at random places and angles."""
    b = bars or Bars()
    x, y = rendered.scatter(rng, shape, np.full(count, b.length / 2), gap=3 + 8 * b.blur, margin=6 + 5 * b.blur)
    angle = rng.uniform(*angles, count)
    images = []
    for px, py, turn in zip(x, y, angle, strict=True):
        at = rendered.window(px, py, b.length / 2 + 5.5 * b.blur, shape)
        images.append((at, rendered.bar(px, py, turn, b.length, b.width, b.blur, at)))
    mean = rendered.planted(shape, b.background, b.amplitude, images)
    return LineFrame(b, rendered.expose(mean, rng, read_dn=b.read_dn), x, y, angle)


def offsets(frame: LineFrame, table) -> tuple[np.ndarray, np.ndarray, int]:
    """Errors across the true lines of the places found, their stated variances there, and how many places are no line's.

    A place counts if it lies within half the length of a line's middle along it and 2 px across.
    """
    from scipy.spatial import cKDTree

    good = np.isfinite(table.x_px) & np.isfinite(table.y_px)
    x, y = table.x_px[good], table.y_px[good]
    _, index = cKDTree(np.stack([frame.x, frame.y], axis=1)).query(np.stack([x, y], axis=1))
    turn = np.deg2rad(frame.angle_deg[index])
    nx, ny = -np.sin(turn), np.cos(turn)
    across = (x - frame.x[index]) * nx + (y - frame.y[index]) * ny
    along = (x - frame.x[index]) * ny - (y - frame.y[index]) * nx
    hit = np.flatnonzero((np.abs(across) < 2) & (np.abs(along) < frame.bars.length / 2))
    hit = hit[np.unique(index[hit], return_index=True)[1]]
    vx, c, vy = (np.asarray(v)[good] for v in (table.var_x_px2, table.cov_xy_px2, table.var_y_px2))
    var = nx**2 * vx + 2 * nx * ny * c + ny**2 * vy
    return across[hit], var[hit], int(good.sum() - len(hit))
