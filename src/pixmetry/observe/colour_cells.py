"""Means of a flat field at the four places of a colour mosaic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import ColourCells, StackMoments
from pixmetry.observe.stack import SATURATED_FRACTION

TILES = 6  # to each side; the scatter of their ratios is the uncertainty
LEAST_PX, FOUND_Z, LEAST_REL = 48, 6.0, 0.005


def find_colour_cells(dark: StackMoments, bright: StackMoments) -> ColourCells | None:
    """The four means of bright less dark, if they differ as those of a colour mosaic do; None of a sensor without one.

    Parameters
    ----------
    dark, bright : StackMoments

    Notes
    -----
    Stripes of rows or of columns alone are no mosaic: it takes a difference of the two diagonals, or of rows and columns both. Ratios are
    taken in each of 6 × 6 tiles, in logarithms, after a plane in each, so that shading does not enter.
    """
    light = bright.mean_map_dn - dark.mean_map_dn
    if min(light.shape) < LEAST_PX or bright.fraction_max > SATURATED_FRACTION:
        return None
    rows, cols = (n // TILES // 2 * 2 for n in light.shape)
    logs = np.array([_logs(light[i * rows : (i + 1) * rows, k * cols : (k + 1) * cols]) for i in range(TILES) for k in range(TILES)])
    if not np.isfinite(logs).all():
        return None
    mean, covariance = logs.mean(axis=0), np.cov(logs.reshape(len(logs), 4).T) / len(logs)
    row, column, diagonal = (float(np.abs((mean * sign).sum()) / 4) for sign in SIGNS)
    u_row, u_column, u_diagonal = (float((logs * sign).sum(axis=(1, 2)).std(ddof=1)) / 4 / TILES for sign in SIGNS)
    stripes = row > max(FOUND_Z * u_row, LEAST_REL) and column > max(FOUND_Z * u_column, LEAST_REL)
    if not (stripes or diagonal > max(FOUND_Z * u_diagonal, LEAST_REL)):
        return None
    return ColourCells(np.exp(mean), covariance, TILES**2 - 1)


SIGNS = (np.array([[1, 1], [-1, -1]]), np.array([[1, -1], [1, -1]]), np.array([[1, -1], [-1, 1]]))


def _logs(tile: np.ndarray) -> np.ndarray:
    """Logarithms of the medians of the four places, less their mean, as if all were at the tile's middle; shape (2, 2)."""
    cells = np.array([[np.median(tile[r::2, c::2]) for c in (0, 1)] for r in (0, 1)])
    blocks = tile.reshape(tile.shape[0] // 2, 2, tile.shape[1] // 2, 2).sum(axis=(1, 3))
    half_y, half_x = blocks.shape[0] // 2, blocks.shape[1] // 2
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_y = np.log(np.median(blocks[-half_y:]) / np.median(blocks[:half_y])) / (2 * (blocks.shape[0] - half_y))
        slope_x = np.log(np.median(blocks[:, -half_x:]) / np.median(blocks[:, :half_x])) / (2 * (blocks.shape[1] - half_x))
        logs = np.log(cells) - slope_y * np.array([[-0.5], [0.5]]) - slope_x * np.array([-0.5, 0.5])
        centred: np.ndarray = logs - logs.mean()  # NaN where there is no light
    return centred


def balanced(dark: StackMoments, bright: StackMoments, cells: ColourCells) -> StackMoments:
    """The bright stack with the light of each colour brought to their mean; noise is left as it is."""
    row, col = np.indices(bright.shape) % 2
    factor = (cells.mean / cells.mean.mean())[row, col]
    light = (bright.mean_map_dn - dark.mean_map_dn) / factor
    return replace(bright, mean_map_dn=dark.mean_map_dn + light)
