"""What moves single rows of a frame sideways, by a straight reference line that was measured in the same rows: jitter, time-base errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.assess.per_image import images_of
from pixmetry.assess.position_tables import Positions
from pixmetry.core.errors import InputError

LEAST_COVERED = 0.9  # of a target's rows, by their weights, that the line must have been measured in
FEWEST_ROWS = 3


@dataclass(frozen=True)
class PerRow:
    """Sideways displacements of targets by those of their rows.

    Parameters
    ----------
    shift_px : ndarray, shape (n,)
        To be taken off x; 0 where the line was not measured.
    own_effects_px : ndarray, shape (p, n)
        What each independent error of the line does to targets of the same image, as large as its standard uncertainty.
    shared_effects_px : ndarray, shape (2, n)
        The same of where the line itself lies, which all images share.
    image_of : ndarray of int, shape (n,)
    corrected, rows : int
        Targets that were corrected, and rows in which the line was measured.
    scatter_px : float
        Standard deviation of the rows about the line.
    notes : tuple of str
    """

    shift_px: np.ndarray
    own_effects_px: np.ndarray
    shared_effects_px: np.ndarray
    image_of: np.ndarray
    corrected: int
    rows: int
    scatter_px: float
    notes: tuple[str, ...]


def fit_per_row(table: Positions, line: Positions) -> PerRow:
    """Find by how much the rows of each target were displaced against a straight line.

    Parameters
    ----------
    table : Positions
        Targets, with their size: columns ``semi_major_px`` and ``semi_minor_px``, or ``diameter_px``. ``image`` and ``frame`` part images.
    line : Positions
        Places of a straight, steep line: x in each row y. One line for all images, which stand still against it.

    Raises
    ------
    InputError
        If no size of the targets is told, the line has fewer than three rows, or does not say in which image it was measured.

    Notes
    -----
    A disc of radius R is displaced by the mean over its rows, weighted by √(R² − (row − y)²): the light of a row, for a centroid; and for
    a least-squares template the sum of the squared slopes along the row, as an edge that is inclined by θ has a squared slope in
    proportion to cos θ. The line x = a + b y is fitted to the rows of all images. A displacement that all rows of all images have is taken
    for that of the line: its uncertainty is that of the mean of so many displaced rows.
    """
    radius = _radius_px(table)
    (names, image_of), (line_names, line_of) = images_of(table), images_of(line)
    if len(names) > 1 and not set(names) & set(line_names):
        allowed = "columns image or frame, as in the table of targets"
        raise InputError("the line does not say in which image it was measured", where=line.source, allowed=allowed)
    known = np.isfinite(line.x_px) & np.isfinite(line.y_px)
    if known.sum() < FEWEST_ROWS:
        what = "the line was measured in too few rows"
        raise InputError(what, where=line.source, value=int(known.sum()), allowed=f"{FEWEST_ROWS} or more")
    middle = line.y_px[known].mean()
    design = np.stack([np.ones(int(known.sum())), line.y_px[known] - middle], axis=1)
    found, *_ = np.linalg.lstsq(design, line.x_px[known], rcond=None)
    away = line.x_px - found[0] - found[1] * (line.y_px - middle)
    scatter = float(np.sqrt((away[known] ** 2).sum() / max(int(known.sum()) - 2, 1)))
    u = np.zeros(len(line)) if line.covariance_px2 is None else np.sqrt(line.covariance_px2[:, 0])
    n = len(table)
    shift, good = np.zeros(n), np.zeros(n, bool)
    weights: list[np.ndarray] = [np.zeros(0)] * n
    for i in np.flatnonzero(np.isfinite(table.x_px) & np.isfinite(table.y_px) & (radius > 0)):
        name = names[image_of[i]]
        there = line_names.index(name) if name in line_names else 0 if line_names == [""] else -1
        mine = np.flatnonzero(known & (line_of == there))
        rows, of_row = np.unique(np.round(line.y_px[mine]), return_inverse=True)
        own = _weights(np.asarray(rows, float), float(table.y_px[i]), float(radius[i]))
        every = np.arange(np.floor(table.y_px[i] - radius[i]) - 1, table.y_px[i] + radius[i] + 2)
        whole = _weights(every, float(table.y_px[i]), float(radius[i])).sum()
        if own.sum() < LEAST_COVERED * whole:
            continue
        good[i] = True
        weight = (own / own.sum() / np.bincount(of_row, minlength=len(rows)))[of_row]
        shift[i] = weight @ away[mine]
        weights[i] = np.zeros(len(line))
        weights[i][mine] = weight * u[mine]
    used = np.flatnonzero(good)
    several = np.array([weights[i] for i in used]).reshape(len(used), len(line))
    slots = _slots(line_of)
    own_effects = np.zeros((int(slots.max(initial=-1)) + 1, n))
    for column in np.flatnonzero(several.any(axis=0)):
        own_effects[slots[column], used] += several[:, column]
    root = scatter * np.linalg.cholesky(np.linalg.inv(design.T @ design))
    shared = np.where(good, -(root.T @ np.stack([np.ones(n), np.nan_to_num(table.y_px) - middle])), 0.0)
    notes = [f"the rows scatter by {scatter:.2g} px about a line that was measured in {int(known.sum())} rows"]
    if line.covariance_px2 is None:
        notes.append("the line has no uncertainties: the covariance lacks its noise")
    left = int(np.isfinite(table.x_px).sum()) - len(used)
    if left:
        notes.append(f"{left} targets are not corrected: the line was not measured in their rows")
    return PerRow(shift, own_effects, shared, image_of, len(used), int(known.sum()), scatter, tuple(notes))


def _radius_px(table: Positions) -> np.ndarray:
    axes = [table.numbers(name) for name in ("semi_major_px", "semi_minor_px")]
    if axes[0] is not None and axes[1] is not None:
        return np.asarray(0.5 * (axes[0] + axes[1]))
    diameter = table.numbers("diameter_px")
    if diameter is None:
        allowed = "columns semi_major_px and semi_minor_px (as of pixmetry locate), or diameter_px"
        raise InputError("the size of the targets is not told", where=table.source, value=", ".join(table.columns), allowed=allowed)
    return 0.5 * diameter


def _weights(rows: np.ndarray, y: float, radius: float) -> np.ndarray:
    """Share of the rows in a disc's place: half its chord, the mean over nine heights of a row."""
    heights = rows[:, None] + (np.arange(9) - 4) / 9 - y
    return np.asarray(np.sqrt(np.maximum(radius**2 - heights**2, 0.0)).mean(axis=1))


def _slots(image_of: np.ndarray) -> np.ndarray:
    """A number for each row of an image, from 0 in every image: errors of two images are independent of each other."""
    slots = np.zeros(len(image_of), np.int64)
    for image in np.unique(image_of):
        mine = image_of == image
        slots[mine] = np.arange(int(mine.sum()))
    return slots
