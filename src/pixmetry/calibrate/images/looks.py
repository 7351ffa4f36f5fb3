"""What distinguishes the cells of a plate of dots: hollow or larger dots, coded rings, missing dots; and what turn and shift these tell.

Each cell of the grid (one pitch wide, about a dot's place) is taken from the picture as its neighbours place it, and compared with the
median of all cells. Cells that look otherwise are marks. Two pictures of one plate are laid upon each other so that their marks agree.
Part of a plate is numbered by three marks that are not in a line and that two other pictures show alike: dirt and clutter make marks too,
and between two pictures they may agree in the wrong place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.images.numbering import turned_cells

SAMPLES = 12  # a pitch, of a cell's look
FINER = 2  # samples that each of them is the mean of, along each axis
AROUND = 12  # dots by which a cell is placed
LEAST_RMS, LEAST_RATIO = 0.1, 3.0  # of a look against the median of all: in units of a dot's contrast, and of the median cell
LEAST_CONTRAST = 0.4  # of a cell, over the median of all, by which its look is divided at least
MOST_MARKS = 24  # of a picture, those that differ most
ALIKE = 0.6  # correlation from which two marks are the same
SAME_LOOK = 0.8  # the same for parts of a plate, where the strength counts too: clutter upon a dot resembles a hollow one
AGAINST = 0.5  # what a mark costs that the other picture has not where it shows the cell
FAINT = 0.3  # of a mark, below which the other picture has it not
CLEAR = 0.45  # by which the best way must be better than the second one
LEAST_MARKS = 3  # that a plate must have for parts of it to be numbered
LEAST_PARTS = 3  # pictures that must agree, of parts of a plate
MOST_REFERENCES = 12
ROUND = 1.3  # ratio of the axes of dots in units of the grid's steps, from which another pair of steps is looked for


@dataclass(frozen=True)
class Looks:
    """Marks on the cells of a grid.

    Parameters
    ----------
    seen : ndarray of bool, shape (rows, cols)
        Cells that the picture shows whole.
    row, col : ndarray of int, shape (m,)
        Of the marks.
    away : ndarray, shape (rows, cols, SAMPLES, SAMPLES)
        How the look of each cell differs from that of most of them, 0 where it is not seen; down its rows the row of the grid increases.
    """

    seen: np.ndarray
    row: np.ndarray
    col: np.ndarray
    away: np.ndarray

    def turned(self, quarters: int) -> Looks:
        """The same when the grid is counted from another corner, as by `turned_cells`."""
        rows, cols = self.seen.shape
        row, col = turned_cells(self.row, self.col, rows, cols, quarters)
        return Looks(np.rot90(self.seen, -quarters), row, col, np.rot90(np.rot90(self.away, -quarters), -quarters, axes=(2, 3)))


def looks_of(frame: np.ndarray, row: np.ndarray, col: np.ndarray, x_px: np.ndarray, y_px: np.ndarray, shape: tuple[int, int]) -> Looks:
    """The marks of a plate of dots in one picture.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    row, col : ndarray of int, shape (n,)
        Of the dots on the grid.
    x_px, y_px : ndarray, shape (n,)
    shape : (int, int)
        Rows and columns of the grid.
    """
    from scipy.ndimage import map_coordinates

    rows, cols = shape
    none = Looks(np.zeros(shape, bool), np.zeros(0, int), np.zeros(0, int), np.zeros((*shape, SAMPLES, SAMPLES), np.float32))
    if len(row) < AROUND:
        return none
    n, size = rows * cols, SAMPLES * FINER
    cells = np.stack(np.divmod(np.arange(n), cols), axis=1).astype(float)
    offset = (np.arange(size) + 0.5) / size - 0.5
    x, y = _placed(np.column_stack([row, col]).astype(float), np.column_stack([x_px, y_px]), cells, offset)
    inside = ((x >= 0) & (x <= frame.shape[1] - 1) & (y >= 0) & (y <= frame.shape[0] - 1)).all(axis=(1, 2))
    if inside.sum() < AROUND:
        return none
    values = map_coordinates(frame.astype(np.float32), [y[inside], x[inside]], order=1, mode="nearest")
    values = values.reshape(-1, SAMPLES, FINER, SAMPLES, FINER).mean(axis=(2, 4))
    low, high = np.quantile(values, (0.05, 0.95), axis=(1, 2))
    contrast = np.maximum(high - low, LEAST_CONTRAST * np.median(high - low))
    looks = (values - low[:, None, None]) / np.where(contrast > 0, contrast, 1.0)[:, None, None]
    away = looks - np.median(looks, axis=0)
    rms = np.sqrt((away**2).mean(axis=(1, 2)))
    marked = np.flatnonzero(rms > max(LEAST_RMS, LEAST_RATIO * float(np.median(rms))))
    marked = np.sort(marked[np.argsort(-rms[marked])][:MOST_MARKS])
    at = cells[inside][marked].astype(int)
    all_cells = none.away.reshape(n, SAMPLES, SAMPLES)
    all_cells[inside] = away
    return Looks(inside.reshape(shape), at[:, 0], at[:, 1], all_cells.reshape(*shape, SAMPLES, SAMPLES))


def _placed(known: np.ndarray, places: np.ndarray, cells: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates of samples about cells, shape (cells, samples, samples), by quadratics through the nearest known dots."""
    from scipy.spatial import cKDTree

    near = cKDTree(known).query(cells, k=AROUND)[1]
    r, c = (known[near] - cells[:, None]).transpose(2, 0, 1)
    design = np.stack([np.ones_like(r), r, c, r * r, r * c, c * c], axis=2)
    normal = design.transpose(0, 2, 1) @ design + np.diag([1e-9] * 3 + [1e-2] * 3)
    found = np.linalg.solve(normal, design.transpose(0, 2, 1) @ places[near])
    v, u = np.meshgrid(offset, offset, indexing="ij")
    terms = np.stack([np.ones_like(v), v, u, v * v, v * u, u * u])
    x, y = np.einsum("npk,pij->knij", found, terms)
    return x, y


def round_steps(cells: np.ndarray, places: np.ndarray, shapes: np.ndarray, pitch_ratio: float = 1.0) -> np.ndarray:
    """Change of the steps of a grid, integers of determinant 1, after which the images of its dots are round in units of the steps.

    Parameters
    ----------
    cells, places : ndarray, shape (n, 2)
        Row and column, and x and y in px.
    shapes : ndarray, shape (n, 2, 2)
        Of the dots' images: their covariance, in any unit common to all.
    pitch_ratio : float
        Distance of the rows over that of the columns.

    Notes
    -----
    Part of a plate may be seen so obliquely that steps along a diagonal look squarer than those along its rows. Its dots tell: an image
    of a circle has the shape of the grid's cell.
    """
    from scipy.spatial import cKDTree

    near = cKDTree(cells).query(cells, k=min(AROUND, len(cells)))[1]
    d = cells[near] - cells[near].mean(axis=1, keepdims=True)
    p = places[near] - places[near].mean(axis=1, keepdims=True)
    slope = np.linalg.solve(d.transpose(0, 2, 1) @ d + 1e-9 * np.eye(2), d.transpose(0, 2, 1) @ p)  # (n, 2 of the grid, 2 of the image)
    back = np.linalg.inv(slope.transpose(0, 2, 1))
    shape = back @ shapes @ back.transpose(0, 2, 1)
    mean = np.median(shape / np.sqrt(np.linalg.det(shape))[:, None, None], axis=0)
    scale = np.diag([pitch_ratio**0.5, pitch_ratio**-0.5])

    def ratio(change: np.ndarray) -> float:
        least, most = np.linalg.eigvalsh(scale @ change @ mean @ change.T @ scale)
        return float(np.sqrt(most / max(least, 1e-12)))

    same = np.eye(2, dtype=int)
    if not np.isfinite(mean).all() or ratio(same) < ROUND:
        return same
    entries = range(-2, 3)
    changes = [np.array([[a, b], [c, e]]) for a in entries for b in entries for c in entries for e in entries if a * e - b * c == 1]
    return min(changes, key=ratio)


@dataclass(frozen=True)
class Laid:
    """How a picture's grid is laid on that of the plate: turned by quarters, then shifted by rows and columns."""

    quarters: int
    shift: tuple[int, int] = (0, 0)


def laid_on(whole: Looks, part: Looks, turns: Sequence[int], *, shifted: bool, confirmed: bool = False) -> Laid | None:
    """How the grid of one picture is laid on another's so that their marks agree; None where they do not decide.

    Parameters
    ----------
    whole, part : Looks
    turns : sequence of int
        Quarters by which it may be turned.
    shifted : bool
        Whether its first row and column may be any of the plate's; else they are the plate's.
    confirmed : bool
        Of parts: whether several pictures showed the marks of the whole, so that a plain dot in the place of one rules a way out.
    """
    ways = []
    for k in turns:
        other = part.turned(k)
        shifts = {(0, 0)}
        if shifted:
            away = np.stack([whole.row[:, None] - other.row, whole.col[:, None] - other.col], axis=2).reshape(-1, 2)
            shifts = {(int(a), int(b)) for a, b in away}
        ways += [(_agreement(whole, other, shift), Laid(k, shift)) for shift in shifts]
    if not ways:
        return None
    if shifted:  # clutter on one of the pictures is no mark of both, and does not speak against a way
        most = sorted((len(one.same) for one, _ in ways), reverse=True)[:2]
        best, way = max(ways, key=lambda one: len(one[0].same))
        return way if _in_plane(best.same) and (len(most) < 2 or most[0] > most[1]) and not (confirmed and best.denied) else None
    ways.sort(key=lambda way: -way[0].score)
    best, way = ways[0]
    clear = best.score - (ways[1][0].score if len(ways) > 1 else -np.inf) >= CLEAR
    return way if clear and best.alike and best.score >= ALIKE else None


def _in_plane(cells: np.ndarray) -> bool:
    return len(cells) >= LEAST_MARKS and bool(np.linalg.matrix_rank(cells - cells[0]) == 2)


@dataclass(frozen=True)
class _Agreement:
    """Correlations of marks at the same place, less what contradicts; of how many they are alike; the places of those that are the same,
    shape (m, 2); and whether the part shows a plain dot where the whole has a mark."""

    score: float
    alike: int
    same: np.ndarray
    denied: bool


def _agreement(whole: Looks, part: Looks, shift: tuple[int, int]) -> _Agreement:
    there = set(zip(whole.row.tolist(), whole.col.tolist(), strict=True))
    here = set(zip((part.row + shift[0]).tolist(), (part.col + shift[1]).tolist(), strict=True))
    score, alike, same, against, denied = 0.0, 0, [], 0, False
    for r, c in there | here:
        at = r - shift[0], c - shift[1]
        if not (_shows(whole.seen, r, c) and _shows(part.seen, *at)):
            continue
        a, b = whole.away[r, c], part.away[at]
        product, of_whole, of_part = float((a * b).sum()), float((a * a).sum()), float((b * b).sum())
        if (r, c) in there and (r, c) in here:
            correlation = product / np.sqrt(of_whole * of_part)
            score += correlation
            alike += correlation >= ALIKE
            if 2 * product >= SAME_LOOK * (of_whole + of_part):
                same.append((r, c))
        else:  # a mark that is too faint to be told does not contradict
            of_mark = of_whole if (r, c) in there else of_part
            against += product < FAINT * of_mark
            denied |= (r, c) in there and product < FAINT * of_mark and of_part < FAINT * of_mark
    return _Agreement(score - AGAINST * against, alike, np.array(same).reshape(-1, 2), denied)


def _shows(seen: np.ndarray, row: int, col: int) -> bool:
    return 0 <= row < seen.shape[0] and 0 <= col < seen.shape[1] and bool(seen[row, col])


def by_marks(looks: Sequence[Looks], turns: Sequence[int], *, shifted: bool, plate: Looks | None = None) -> list[Laid | None]:
    """How each picture's grid is laid on a plate; None where marks do not decide.

    Parameters
    ----------
    looks : sequence of Looks
    turns : sequence of int
        Quarters of a turn by which pictures may differ.
    shifted : bool
        Whether they show parts of the plate.
    plate : Looks, optional
        On which they are laid; by default that picture on which most of the others can be laid. Parts must then be confirmed by others.
    """
    if plate is not None:
        return [laid_on(plate, one, turns, shifted=shifted, confirmed=True) for one in looks]
    least = LEAST_MARKS if shifted else 1
    marked = [k for k, one in enumerate(looks) if len(one.row) >= least]
    nothing: list[Laid | None] = [None] * len(looks)
    drawn = np.unique(np.linspace(0, len(marked) - 1, min(MOST_REFERENCES, len(marked))).astype(int))
    references = [marked[k] for k in drawn]
    found = [
        [Laid(0) if k == one else laid_on(looks[one], part, turns, shifted=shifted) for k, part in enumerate(looks)] for one in references
    ]
    found.sort(key=_laid_count, reverse=True)
    if not shifted:
        return found[0] if found and _laid_count(found[0]) > 1 else nothing
    best = nothing
    for one in found:
        sure = _confirmed(looks, one, turns)
        best = max(best, sure, key=_laid_count)
        if _laid_count(best) >= _laid_count(one):  # and the next ones have no more
            break
    return best


def _laid_count(laid: Sequence[Laid | None]) -> int:
    return sum(way is not None for way in laid)


def _confirmed(looks: Sequence[Looks], found: Sequence[Laid | None], turns: Sequence[int]) -> list[Laid | None]:
    """Those pictures that the marks of the others place alike, each of these shown by two of them; and the rest where such marks tell."""
    laid = list(found)
    while _laid_count(laid) >= LEAST_PARTS:
        off = [k for k, way in enumerate(laid) if way is not None and _on_others(looks, laid, k, turns) != way]
        if not off:
            break
        laid[off[-1]] = None
    else:
        return [None] * len(laid)
    return [_on_others(looks, laid, k, turns) if way is None else way for k, way in enumerate(laid)]


def _on_others(looks: Sequence[Looks], laid: Sequence[Laid | None], k: int, turns: Sequence[int]) -> Laid | None:
    """How a picture is laid on the plate as the others show it."""
    whole, (row, col) = together(looks, [None if k == i else way for i, way in enumerate(laid)])
    way = laid_on(whole, looks[k], turns, shifted=True, confirmed=True)
    return None if way is None else replace(way, shift=(way.shift[0] + row, way.shift[1] + col))


def together(looks: Sequence[Looks], laid: Sequence[Laid | None]) -> tuple[Looks, tuple[int, int]]:
    """The plate as all pictures show it that are laid on it: marks that half of them have, two at least, and the row and column of its
    first cell."""
    parts = [(one.turned(way.quarters), way.shift) for one, way in zip(looks, laid, strict=True) if way is not None]
    least = np.min([shift for _, shift in parts], axis=0)
    extent = np.max([np.array(one.seen.shape) + shift for one, shift in parts], axis=0) - least
    seen, found = np.zeros(extent, int), np.zeros(extent, int)
    away = np.zeros((*extent, SAMPLES, SAMPLES))
    for one, shift in parts:
        row, col = np.array(shift) - least
        rows, cols = one.seen.shape
        seen[row : row + rows, col : col + cols] += one.seen
        away[row : row + rows, col : col + cols] += one.away
        found[one.row + row, one.col + col] += 1
    r, c = np.nonzero((found > 1) & (2 * found >= seen))
    return Looks(seen > 0, r, c, away / np.maximum(seen, 1)[..., None, None]), (int(least[0]), int(least[1]))
