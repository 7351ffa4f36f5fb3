"""Correction grid for what no parameter explains: local means of the residuals over the sensor.

Two values at each node of a grid, bilinear in between, are fitted to the residuals by least squares with a penalty on second differences
(P. H. C. Eilers, B. D. Marx, Statistical Science 11 (1996) 89–121). How much is smoothed, and whether there is anything to correct, is
decided by images that were left out of the fit. `systematic_rest` says in one number how much the residuals have in common by place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.checks.quality import p_fall
from pixmetry.calibrate.records import ResidualGrid
from pixmetry.core.threads import single_threaded_blas

POINTS_PER_NODE = 12  # more nodes than the data carry alone: the penalty smooths, and bilinear cells stay small
MOST_NODES = (33, 25)
LEAST_POINTS = 400
PENALTIES = (1.0, 10.0, 100.0, 1000.0, 1e4)  # in image points
LEVEL = 0.01
CELLS = (10, 8)  # of the frame, in which residuals have something in common or not


def residual_grids(adjustment: Adjustment, nodes: tuple[int, int] | None = None, folds: int = 5, seed: int = 0) -> dict[str, ResidualGrid]:
    """Correction grids of the cameras whose left-out images get better by them.

    Parameters
    ----------
    adjustment : Adjustment
    nodes : tuple of int, optional
        Along x and y; by default as many as leave 12 image points to each, 33 by 25 at most.
    folds : int
        Of the images.
    seed : int
        Of their deal to the folds.

    Returns
    -------
    dict
        By camera; ``p`` is paired over images.
    """
    from pixmetry.core.random import generator

    network, out = adjustment.network, {}
    good = adjustment.used & np.isfinite(adjustment.residual_px).all(axis=1)
    for k, camera in enumerate(network.cameras):
        rows = np.flatnonzero(good & (network.camera_of[network.image] == k))
        images = np.unique(network.image[rows])
        if len(rows) < LEAST_POINTS or len(images) < 3:
            continue
        x, y, v, image = network.x_px[rows], network.y_px[rows], adjustment.residual_px[rows], network.image[rows]
        shape = nodes or _nodes(len(rows), camera.sensor.cols, camera.sensor.rows)
        axes = np.linspace(0, camera.sensor.cols - 1, shape[0]), np.linspace(0, camera.sensor.rows - 1, shape[1])
        hats, roughness = _hats(x, y, *axes), _roughness(shape)
        fold_of = generator(seed, f"residual grid {k}").permutation(len(images)) % min(folds, len(images))
        fold = fold_of[np.searchsorted(images, image)]
        with single_threaded_blas():
            left = {penalty: _left_out(hats, v, roughness, penalty, fold) for penalty in PENALTIES}
        penalty = min(PENALTIES, key=lambda value: float(np.sum(left[value] ** 2)))
        p = min(1.0, len(PENALTIES) * p_fall(v, left[penalty], image))  # over all smoothings tried (Bonferroni)
        if p < LEVEL:
            rms = float(np.sqrt(np.mean(v**2))), float(np.sqrt(np.mean(left[penalty] ** 2)))
            dx, dy, u, n = _fitted(hats, v, roughness, penalty, shape)
            out[camera.name] = ResidualGrid(axes[0], axes[1], dx, dy, u, n, *rms, p)
    return out


def _nodes(points: int, cols: int, rows: int) -> tuple[int, int]:
    across = np.sqrt(points / POINTS_PER_NODE * cols / rows)
    wanted = across, across * rows / cols
    return tuple(int(np.clip(np.floor(value), 3, most)) for value, most in zip(wanted, MOST_NODES, strict=True))  # type: ignore[return-value]


def _hats(x: np.ndarray, y: np.ndarray, x_px: np.ndarray, y_px: np.ndarray) -> Any:
    """Bilinear weights of the nodes, sparse, shape (n, rows · cols)."""
    from scipy import sparse

    i, s = _cell(x, x_px)
    j, t = _cell(y, y_px)
    weights = np.concatenate([(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t])
    columns = np.concatenate([j * len(x_px) + i, j * len(x_px) + i + 1, (j + 1) * len(x_px) + i, (j + 1) * len(x_px) + i + 1])
    return sparse.csr_matrix((weights, (np.tile(np.arange(len(x)), 4), columns)), shape=(len(x), len(x_px) * len(y_px)))


def _cell(values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the node before each value, and how far it is to the next, 0 … 1 (held at the ends)."""
    place = np.clip((np.asarray(values, float) - at[0]) / (at[1] - at[0]), 0, len(at) - 1)
    before = np.minimum(place.astype(int), len(at) - 2)
    return before, place - before


def _roughness(shape: tuple[int, int]) -> Any:
    """Sum of the squared second differences along both axes, and of the mixed ones, as a quadratic form."""
    from scipy import sparse

    first, second = ([sparse.csr_matrix(np.diff(np.eye(n), order, axis=0)) for n in shape] for order in (1, 2))
    eye = [sparse.identity(n) for n in shape]
    parts = (sparse.kron(eye[1], second[0]), sparse.kron(second[1], eye[0]), np.sqrt(2) * sparse.kron(first[1], first[0]))
    return sum(part.T @ part for part in parts).toarray()


def _solved(hats: Any, v: np.ndarray, roughness: np.ndarray, penalty: float) -> tuple[np.ndarray, Any]:
    """Values at the nodes, shape (nodes, 2), and the Cholesky factor of the penalised normal matrix."""
    from scipy import linalg

    # the part of 1e-6 keeps nodes defined that no point comes near, at 0
    normal = (hats.T @ hats).toarray() + penalty * roughness + 1e-6 * np.eye(len(roughness))
    factor = linalg.cho_factor(normal, lower=True, overwrite_a=True)
    return linalg.cho_solve(factor, hats.T @ v), factor


def _left_out(hats: Any, v: np.ndarray, roughness: np.ndarray, penalty: float, fold: np.ndarray) -> np.ndarray:
    """Residuals less a grid from the images of the other folds."""
    out = np.empty_like(v)
    for number in np.unique(fold):
        mine = fold == number
        values, _ = _solved(hats[~mine], v[~mine], roughness, penalty)
        out[mine] = v[mine] - hats[mine] @ values
    return out


def _fitted(hats: Any, v: np.ndarray, roughness: np.ndarray, penalty: float, shape: tuple[int, int]) -> list[np.ndarray]:
    """Values of a `ResidualGrid` at its nodes: dx, dy, u and n, shape (rows, cols) each."""
    from scipy import linalg

    values, factor = _solved(hats, v, roughness, penalty)
    inverse = linalg.cho_solve(factor, np.eye(len(values)))
    taken = np.einsum("ij,ji->", inverse, (hats.T @ hats).toarray())  # effective number of values an axis
    sigma2 = np.sum((v - hats @ values) ** 2) / max(2 * (len(v) - taken), 1.0)
    grid = (shape[1], shape[0])
    # with the prior that the penalty stands for, the inverse is the covariance, smoothing included (G. Wahba, J. R. Stat. Soc. B 45, 1983)
    u = np.sqrt(sigma2 * np.diag(inverse))
    count = np.rint(np.asarray(hats.sum(axis=0)).ravel()).astype(int)
    return [part.reshape(grid) for part in (values[:, 0], values[:, 1], u, count)]


def at(grid: ResidualGrid, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residual (measured minus computed) by the grid at some positions, px; beyond the edge, the value at the edge.

    Parameters
    ----------
    grid : ResidualGrid
    x_px, y_px : ndarray
        Of one shape.
    """
    x, y = np.broadcast_arrays(np.asarray(x_px, float), np.asarray(y_px, float))
    hats = _hats(x.ravel(), y.ravel(), grid.x_px, grid.y_px)
    dx, dy = (np.asarray(hats @ np.ravel(part)).reshape(x.shape) for part in (grid.dx_px, grid.dy_px))
    return dx, dy


def corrected(grid: ResidualGrid, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates minus the correction grid of their camera; the parameters of the camera describe the corrected coordinates.

    Parameters
    ----------
    grid : ResidualGrid
        Out of ``grids`` of a calibration, stored or not.
    x_px, y_px : ndarray
        Of one shape.
    """
    dx, dy = at(grid, x_px, y_px)
    return np.asarray(x_px, float) - dx, np.asarray(y_px, float) - dy


def systematic_rest(adjustment: Adjustment, index: int = 0) -> tuple[float, float]:
    """What the residuals of a camera have in common at one place of the frame, in x and y, px: a standard deviation over the frame.

    The component between cells of the frame in a one-way analysis of variance with random effects (Searle, Casella, McCulloch, Variance
    Components, 1992, 3.6); 0 where the cells differ no more than noise makes them. Noise of single points is no error of the camera.
    """
    network = adjustment.network
    sensor = network.cameras[index].sensor
    own = adjustment.used & (network.camera_of[network.image] == index)
    col = np.clip(network.x_px[own] / sensor.cols * CELLS[0], 0, CELLS[0] - 1).astype(int)
    row = np.clip(network.y_px[own] / sensor.rows * CELLS[1], 0, CELLS[1] - 1).astype(int)
    _, cell, counts = np.unique(row * CELLS[0] + col, return_inverse=True, return_counts=True)
    n, cells = len(cell), len(counts)
    if cells < 2 or n <= cells:
        return 0.0, 0.0
    per_cell = (n - (counts**2).sum() / n) / (cells - 1)
    rest = []
    for v in adjustment.residual_px[own].T:
        means = np.bincount(cell, v) / counts
        between = (counts * (means - v.mean()) ** 2).sum() / (cells - 1)
        within = ((v - means[cell]) ** 2).sum() / (n - cells)
        rest.append(float(np.sqrt(max(between - within, 0.0) / per_cell)))
    return rest[0], rest[1]
