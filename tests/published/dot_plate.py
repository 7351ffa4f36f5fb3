"""A real dot plate: dots located and ordered, a homography with distortion fitted to half of them, and what it leaves on the other half.

The picture (1280 × 800, 8-bit JPEG, about 4415 whole dots of 4 px radius at 15 px pitch) and the coefficients published with it are of the
Discorpy project (N. T. Vo et al., Optics Express 23, 32859 (2015)); Apache-2 licence.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial.legendre import legvander2d
from scipy.optimize import least_squares

from pixmetry.locate.detect.grids import Grid, order_grid
from pixmetry.locate.detect.targets import Flag, Positions, Targets

PICTURE, COEFFICIENTS = "dot_pattern_05.jpg", "coef_dot_05.txt"
UNIT_PX = 1000.0  # radius at which a radial term is its own coefficient
DEGREE = 10  # of the smooth field that is taken off before residuals are sorted by sub-pixel phase
BINS = 10


def read_picture(folder: Path) -> np.ndarray:
    """The plate, shape (800, 1280), uint8."""
    import imagecodecs

    return np.ascontiguousarray(imagecodecs.imread(str(folder / PICTURE)))


def whole_dots(targets: Targets, grid: Grid) -> np.ndarray:
    """Dots that are on the grid and not cut off by the frame's border."""
    return grid.placed & (targets.flags & Flag.BORDER == 0)


def order(targets: Targets) -> Grid:
    return order_grid(targets.x_px, targets.y_px)


@dataclass(frozen=True)
class Lens:
    """Homography (8), centre (2) and coefficients of r², r⁴, r⁶ (3) that take (column, row) of the plate to the image."""

    values: np.ndarray

    def image(self, col: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        h, (cx, cy), k = self.values[:8], self.values[8:10], self.values[10:]
        w = h[6] * col + h[7] * row + 1
        x, y = (h[0] * col + h[1] * row + h[2]) / w, (h[3] * col + h[4] * row + h[5]) / w
        r2 = ((x - cx) ** 2 + (y - cy) ** 2) / UNIT_PX**2
        factor = r2 * (k[0] + r2 * (k[1] + r2 * k[2]))
        return x + (x - cx) * factor, y + (y - cy) * factor


def fit_lens(col: np.ndarray, row: np.ndarray, x: np.ndarray, y: np.ndarray) -> Lens:
    """Least squares over all 13 unknowns."""
    scale = np.array([15, 1, 1, 1, 15, 1, 1e-4, 1e-4, 100, 100, 0.01, 0.01, 0.01])
    design = np.column_stack([col, row, np.ones_like(col)])
    start = np.concatenate([*np.linalg.lstsq(design, np.column_stack([x, y]), rcond=None)[0].T, [0, 0], [x.mean(), y.mean()], [0, 0, 0]])

    def residual(values: np.ndarray) -> np.ndarray:
        at = Lens(values).image(col, row)
        return np.concatenate([at[0] - x, at[1] - y])

    return Lens(least_squares(residual, start, x_scale=scale).x)


def held_out(positions: Positions | Targets, grid: Grid, use: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Residuals x, y of all usable dots, shape (n, 2), from the fit to a random half of them, and the mask of the other half."""
    x, y = positions.x_px[use], positions.y_px[use]
    col, row = grid.col[use] - 42.0, grid.row[use] - 27.0
    half = rng.permutation(len(x)) < len(x) // 2
    at = fit_lens(col[half], row[half], x[half], y[half]).image(col, row)
    return np.stack([x - at[0], y - at[1]], axis=1), ~half


def published_residuals(folder: Path, positions: Positions | Targets, grid: Grid, use: np.ndarray) -> np.ndarray:
    """Residuals x, y with the published coefficients, x = c + u Σ k_i |u|^i, u being a homography of (column, row) fitted to all dots."""
    numbers = [float(line.split(":")[1]) for line in (folder / COEFFICIENTS).read_text().splitlines() if ":" in line]
    (cx, cy), k = numbers[:2], numbers[2:]
    x, y, col, row = positions.x_px[use], positions.y_px[use], grid.col[use] - 42.0, grid.row[use] - 27.0
    design = np.column_stack([col, row, np.ones_like(col)])
    start = np.concatenate([*np.linalg.lstsq(design, np.column_stack([x - cx, y - cy]), rcond=None)[0].T, [0, 0]])

    def residual(h: np.ndarray) -> np.ndarray:
        w = h[6] * col + h[7] * row + 1
        u, v = (h[0] * col + h[1] * row + h[2]) / w, (h[3] * col + h[4] * row + h[5]) / w
        factor = np.polyval(k[::-1], np.hypot(u, v))
        return np.concatenate([cx + u * factor - x, cy + v * factor - y])

    return least_squares(residual, start, x_scale=[15, 1, 1, 1, 15, 1, 1e-4, 1e-4]).fun.reshape(2, -1).T


def phase_means(places: np.ndarray, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean residual in bins of the sub-pixel phase, shape (2, BINS) for x and y, their standard errors, and the scatter of one dot.

    Plate and lens leave a smooth field which, the dots being nearly one pixel's multiple apart, looks like a dependence on phase. A
    polynomial of degree 10 in x and y takes it off; the phase runs through its cycle every 8 to 15 dots, which such a field cannot follow.
    """
    u, v = (2 * p / np.ptp(p) - 1 for p in (places - places.min(axis=0)).T)
    low = np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)).ravel() <= DEGREE
    field = legvander2d(u, v, [DEGREE, DEGREE])[:, low]
    means, errors, scatter = np.empty((2, BINS)), np.empty((2, BINS)), []
    for axis in (0, 1):
        r = residuals[:, axis]
        good = np.ones(len(r), bool)
        for _ in range(3):  # dots under dirt
            rest = r - field @ np.linalg.lstsq(field[good], r[good], rcond=None)[0]
            good = np.abs(rest) < 6 * 1.4826 * np.median(np.abs(rest))
        scatter.append(rest[good].std())
        place = np.floor(places[:, axis] % 1 * BINS).astype(int)
        for k in range(BINS):
            inside = rest[good & (place == k)]
            means[axis, k], errors[axis, k] = inside.mean(), inside.std() / np.sqrt(len(inside))
    return means, errors, float(np.sqrt(np.mean(np.square(scatter))))
