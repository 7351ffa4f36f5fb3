"""What changes from image to image, by reference positions in each: a shift, scales along the axes, or a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixmetry.assess.position_tables import Positions
from pixmetry.core.errors import InputError

MODELS = {"shift": "shift", "scale": "shift and scales", "pose": "shift and rotation"}
NAMES = ("point", "name", "label", "id", "target")  # columns that name targets


@dataclass(frozen=True)
class PerImage:
    """Displacements that were fitted image by image.

    Parameters
    ----------
    shift_px : ndarray, shape (n, 2)
        To be taken off each position; 0 in images without a fit.
    effects_px : ndarray, shape (k, n, 2)
        What each independent cause of uncertainty does to all positions, as far as the fits do not follow it.
    own_effects_px : ndarray, shape (p, n, 2)
        The same of the independent causes of each fit; those of two images are independent of each other.
    image_of : ndarray of int, shape (n,)
    targets, images : int
        Reference positions and images that were used.
    notes : tuple of str
    """

    shift_px: np.ndarray
    effects_px: np.ndarray
    own_effects_px: np.ndarray
    image_of: np.ndarray
    targets: int
    images: int
    notes: tuple[str, ...]


def fit_per_image(
    at_px: np.ndarray,
    covariance_px2: np.ndarray | None,
    effects_px: np.ndarray,
    table: Positions,
    reference: Positions,
    model: str,
    frame_shape: tuple[int, int],
    match: str | None = None,
) -> PerImage:
    """Fit what positions of an image have in common against a reference, by weighted least squares.

    Parameters
    ----------
    at_px : ndarray, shape (n, 2)
        Positions, corrected for all else.
    covariance_px2 : ndarray, shape (n, 3), or None
        Of each, without what they have in common. Without it the scatter of the residuals is taken, which then needs more targets than
        unknowns.
    effects_px : ndarray, shape (k, n, 2)
    table, reference : Positions
        With a column that names the targets; ``image`` of the table parts the images.
    model : {"shift", "scale", "pose"}
    frame_shape : (int, int)
    match : str, optional
        The column that names the targets.

    Raises
    ------
    InputError
        If the model is unknown, no column names the targets, or none of them is in both tables.

    Notes
    -----
    Residuals that are larger than the covariance says raise that of the fit by s₀², never lower it.
    """
    if model not in MODELS:
        raise InputError("no such model", where="per_image", value=model, allowed=", ".join(MODELS))
    aim, known = _aims(table, reference, match)
    names, image_of = np.unique([str(v) for v in table.columns.get("image", [""] * len(table))], return_inverse=True)
    basis = _basis(at_px, model, frame_shape)
    shift, effects = np.zeros_like(at_px), np.array(effects_px)
    own = np.zeros((len(basis), *at_px.shape))
    notes: list[str] = []
    used = fits = 0
    order = np.argsort(image_of, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(image_of[order])) + 1)
    usable = known & np.isfinite(at_px).all(axis=1)
    for image, mine in zip(names, parts, strict=True):
        by = mine[usable[mine]]
        a = basis[:, by].reshape(len(basis), -1).T
        count, needed = len(by), len(basis) + (covariance_px2 is None)
        named = f"image {image}: " if image else ""
        if 2 * count < needed or np.linalg.matrix_rank(a) < len(basis):
            notes.append(f"{named}{count} reference positions are too few for {MODELS[model]}: its positions are without it")
            continue
        used, fits = used + count, fits + 1
        solve, spread = _solver(a, None if covariance_px2 is None else covariance_px2[by])
        residual = (at_px[by] - aim[by]).ravel()
        found = solve @ residual
        left = residual - a @ found
        dof = a.shape[0] - a.shape[1]
        s2 = _s2(left, None if covariance_px2 is None else covariance_px2[by], dof)
        shift[mine] = np.tensordot(found, basis[:, mine], axes=1)
        for effect in effects:
            effect[mine] -= np.tensordot(solve @ effect[by].ravel(), basis[:, mine], axes=1)
        power, directions = np.linalg.eigh(spread * (s2 if covariance_px2 is None else max(s2, 1.0)))
        own[:, mine] = np.tensordot((directions * np.sqrt(np.maximum(power, 0.0))).T, basis[:, mine], axes=1)
        notes.append(f"{named}{MODELS[model]} by {count} reference positions, which fit to {np.sqrt(np.mean(left**2)):.2g} px")
    return PerImage(shift, effects, own, image_of.ravel(), used, fits, tuple(notes))


def _aims(table: Positions, reference: Positions, match: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Where targets of the table should be, shape (n, 2), and for which this is known."""
    wanted = (match,) if match else NAMES
    name = next((n for n in wanted if n in table.columns and n in reference.columns), None)
    if name is None:
        allowed = f"a column {' or '.join(wanted)} in both tables"
        raise InputError("no column names the targets", where=reference.source, value=", ".join(reference.columns), allowed=allowed)
    places = {_key(v): i for i, v in enumerate(reference.columns[name])}
    if len(places) < len(reference):
        raise InputError("a target has several reference positions", where=reference.source, allowed="each name once")
    index = np.array([places.get(_key(v), -1) for v in table.columns[name]], np.int64)
    at = np.stack([reference.x_px, reference.y_px], axis=1)[index]
    known = (index >= 0) & np.isfinite(at).all(axis=1)
    if not known.any():
        raise InputError("no target of the table has a reference position", where=reference.source, remedy="name targets alike in both")
    return at, known


def _key(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _basis(at_px: np.ndarray, model: str, frame_shape: tuple[int, int]) -> np.ndarray:
    """Displacements of every position by each unknown, in units of about a pixel at the frame's border, shape (p, n, 2)."""
    rows, cols = frame_shape
    half = max(rows, cols) / 2
    x, y = (at_px[:, 0] - (cols - 1) / 2) / half, (at_px[:, 1] - (rows - 1) / 2) / half
    zero, one = np.zeros_like(x), np.ones_like(x)
    terms: list[Sequence[np.ndarray]] = [(one, zero), (zero, one)]
    terms += {"shift": [], "scale": [(x, zero), (zero, y)], "pose": [(-y, x)]}[model]
    return np.array([np.stack(term, axis=1) for term in terms])


def _whitened(covariance_px2: np.ndarray) -> np.ndarray:
    """Block-diagonal L⁻¹ with L Lᵀ the covariance, shape (2 n, 2 n)."""
    n = len(covariance_px2)
    out = np.zeros((2 * n, 2 * n))
    for i, (var_x, cov, var_y) in enumerate(covariance_px2):
        out[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = np.linalg.inv(np.linalg.cholesky([[var_x, cov], [cov, var_y]]))
    return out


def _solver(a: np.ndarray, covariance_px2: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The matrix that makes the unknowns of residuals, and the covariance of the unknowns for a weight of 1."""
    weight = np.eye(len(a)) if covariance_px2 is None else _whitened(covariance_px2)
    spread = np.linalg.inv(a.T @ weight.T @ weight @ a)
    return spread @ a.T @ weight.T @ weight, spread


def _s2(left: np.ndarray, covariance_px2: np.ndarray | None, dof: int) -> float:
    """Variance of unit weight; 1 where nothing is left over to tell it."""
    if dof < 1:
        return 1.0
    scaled = left if covariance_px2 is None else _whitened(covariance_px2) @ left
    return float((scaled**2).sum() / dof)
