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
    reference_effects_px : ndarray, shape (r, n, 2)
        The same of the independent causes of the reference's uncertainty, which all images share.
    own_effects_px : ndarray, shape (p, n, 2)
        The same of the independent causes of each fit; those of two images are independent of each other.
    image_of : ndarray of int, shape (n,)
    targets, images : int
        Reference positions and images that were used.
    notes : tuple of str
    """

    shift_px: np.ndarray
    effects_px: np.ndarray
    reference_effects_px: np.ndarray
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
        With a column that names the targets; ``image`` and ``frame`` of the table part the images. The uncertainty of the reference counts
        where it is told.
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
    Residuals that are larger than the covariance says raise that of the fit by s₀², never lower it. Where one of them has a standard
    uncertainty of 0 in x or y, nothing tells its weight: all of the image weigh alike, and their scatter tells the covariance.
    """
    if model not in MODELS:
        raise InputError("no such model", where="per_image", value=model, allowed=", ".join(MODELS))
    aim, aim_px2, place = _aims(table, reference, match)
    known = place >= 0
    names, image_of = images_of(table)
    basis = _basis(at_px, model, frame_shape)
    shift, effects = np.zeros_like(at_px), np.array(effects_px)
    own = np.zeros((len(basis), *at_px.shape))
    by_reference: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    notes: list[str] = []
    used = fits = 0
    order = np.argsort(image_of, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(image_of[order])) + 1) if len(order) else []
    usable = known & np.isfinite(at_px).all(axis=1)
    for image, mine in zip(names, parts, strict=True):
        by = mine[usable[mine]]
        a = basis[:, by].reshape(len(basis), -1).T
        of_table = None if covariance_px2 is None else covariance_px2[by]
        total = None if of_table is None else of_table + (0.0 if aim_px2 is None else aim_px2[by])
        count, named = len(by), f"{image}: " if image else ""
        if total is not None and not _weighable(total):
            notes.append(f"{named}a standard uncertainty of 0 has no weight: all reference positions weigh alike")
            of_table = total = None
        needed = len(basis) + (total is None)
        if 2 * count < needed or np.linalg.matrix_rank(a) < len(basis):
            notes.append(f"{named}{count} reference positions are too few for {MODELS[model]}: its positions are without it")
            continue
        used, fits = used + count, fits + 1
        weight = np.tile(np.eye(2), (count, 1, 1)) if total is None else np.linalg.inv(_matrices(total))
        weighed = _times(weight, a)
        spread = np.linalg.inv(a.T @ weighed)
        solve = spread @ weighed.T
        residual = (at_px[by] - aim[by]).ravel()
        found = solve @ residual
        left = residual - a @ found
        dof = a.shape[0] - a.shape[1]
        s2 = float(left @ _times(weight, left[:, None])[:, 0] / dof) if dof else 1.0
        shift[mine] = np.tensordot(found, basis[:, mine], axes=1)
        for effect in effects:
            effect[mine] -= np.tensordot(solve @ effect[by].ravel(), basis[:, mine], axes=1)
        if of_table is None:
            spread = s2 * spread
        else:  # that of the reference is common to the images
            spread = solve @ _times(_matrices(of_table), solve.T) + (max(s2, 1.0) - 1.0) * spread
            if aim_px2 is not None:
                by_reference.append((mine, place[by], solve))
        power, directions = np.linalg.eigh(spread)
        own[:, mine] = np.tensordot((directions * np.sqrt(np.maximum(power, 0.0))).T, basis[:, mine], axes=1)
        notes.append(f"{named}{MODELS[model]} by {count} reference positions, which fit to {np.sqrt(np.mean(left**2)):.2g} px")
    shared = _of_reference(by_reference, basis, reference)
    return PerImage(shift, effects, shared, own, image_of, used, fits, tuple(notes))


def images_of(table: Positions) -> tuple[list[str], np.ndarray]:
    """How each image is called, and that of each position: by the columns ``image`` and ``frame``, as far as they are there."""
    columns = [(name, [_key(v) for v in table.columns[name]]) for name in ("image", "frame") if name in table.columns]
    if not columns:
        return [""] * min(len(table), 1), np.zeros(len(table), np.int64)
    number: dict[tuple[str, ...], int] = {}
    image_of = [number.setdefault(key, len(number)) for key in zip(*(keys for _, keys in columns), strict=True)]
    return [", ".join(f"{name} {v}" for (name, _), v in zip(columns, key, strict=True)) for key in number], np.array(image_of, np.int64)


def _of_reference(fits: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], basis: np.ndarray, reference: Positions) -> np.ndarray:
    """What the independent causes of the reference's uncertainty do to all positions, shape (r, n, 2).

    The unknowns of all fits are linear in the reference positions, of which the same ones serve many images.
    """
    if not fits or reference.covariance_px2 is None:
        return np.zeros((0, *basis.shape[1:]))
    targets = np.unique(np.concatenate([rows for _, rows, _ in fits]))
    linear = np.zeros((len(fits), len(basis), len(targets), 2))
    for of_image, (_, rows, solve) in zip(linear, fits, strict=True):
        is_target = rows[:, None] == targets
        of_image[:] = np.einsum("pma,mt->pta", solve.reshape(len(basis), len(rows), 2), is_target)
    power, axes = np.linalg.eigh(_matrices(reference.covariance_px2[targets]))
    root = axes * np.sqrt(np.maximum(power, 0.0))[:, None, :]
    by_cause = np.einsum("ipta,tab->iptb", linear, root).reshape(len(fits) * len(basis), -1)
    directions, sizes, _ = np.linalg.svd(by_cause, full_matrices=False)
    unknowns = (directions * sizes).T.reshape(-1, len(fits), len(basis))
    effects = np.zeros((len(unknowns), *basis.shape[1:]))
    for k, (mine, _, _) in enumerate(fits):
        effects[:, mine] = np.tensordot(unknowns[:, k], basis[:, mine], axes=1)
    return effects


def _aims(table: Positions, reference: Positions, match: str | None) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Where targets of the table should be, shape (n, 2), the covariance of this, and its row in the reference; −1 if it has none."""
    wanted = (match,) if match else NAMES
    name = next((n for n in wanted if n in table.columns and n in reference.columns), None)
    if name is None:
        allowed = f"a column {' or '.join(wanted)} in both tables"
        raise InputError("no column names the targets", where=reference.source, value=", ".join(reference.columns), allowed=allowed)
    places = {_key(v): i for i, v in enumerate(reference.columns[name])}
    if len(places) < len(reference):
        raise InputError("a target has several reference positions", where=reference.source, allowed="each name once")
    index = np.array([places.get(_key(v), -1) for v in table.columns[name]], np.int64)
    if not len(table):
        return np.zeros((0, 2)), None, index
    at = np.stack([reference.x_px, reference.y_px], axis=1)[index]
    index = np.where(np.isfinite(at).all(axis=1), index, -1)
    if not (index >= 0).any():
        raise InputError("no target of the table has a reference position", where=reference.source, remedy="name targets alike in both")
    return at, None if reference.covariance_px2 is None else reference.covariance_px2[index], index


def _key(value: object) -> str:
    """A name as text; whole numbers alike whether they were read as text, whole or not."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _basis(at_px: np.ndarray, model: str, frame_shape: tuple[int, int]) -> np.ndarray:
    """Displacements of every position by each unknown, in units of about a pixel at the frame's border, shape (p, n, 2)."""
    rows, cols = frame_shape
    half = max(rows, cols) / 2
    x, y = (at_px[:, 0] - (cols - 1) / 2) / half, (at_px[:, 1] - (rows - 1) / 2) / half
    zero, one = np.zeros_like(x), np.ones_like(x)
    terms: list[Sequence[np.ndarray]] = [(one, zero), (zero, one)]
    terms += {"shift": [], "scale": [(x, zero), (zero, y)], "pose": [(-y, x)]}[model]
    return np.array([np.stack(term, axis=1) for term in terms])


def _matrices(covariance_px2: np.ndarray) -> np.ndarray:
    """Covariances of x and y as matrices, shape (n, 2, 2)."""
    var_x, cov, var_y = covariance_px2.T
    return np.stack([np.stack([var_x, cov], 1), np.stack([cov, var_y], 1)], axis=1)


def _weighable(covariance_px2: np.ndarray) -> bool:
    """Whether each position has a weight."""
    var_x, cov, var_y = covariance_px2.T
    return bool((var_x * var_y * (1 - 1e-9) > cov**2).all())


def _times(blocks: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A block-diagonal matrix of 2 × 2 blocks, times columns of shape (2 n, p)."""
    return np.asarray((blocks @ columns.reshape(len(blocks), 2, -1)).reshape(columns.shape))
