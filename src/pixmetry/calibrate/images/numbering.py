"""Numbering of the points of a board over all its images; boards that look the same after a rotation are resolved if possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pixmetry.core.finding import Finding

CLEAR = 0.2  # of the marks, by which a turn must agree worse than the best one to be ruled out
MARKED_AREA = 1.35  # of a dot over that of those around it, from which it is a mark
NEAR_LIMIT = 0.6  # of the greatest rotation between neighbouring images that leaves the numbering sure
SAME_MARKS = 0.7  # of the images, that must show the same number of marks for these to be believed
MARK_AROUND = 9  # dots, itself among them


@dataclass(frozen=True)
class Marks:
    """Features that distinguish the rotations of a board: values at cells of a grid of ``rows`` × ``cols``; arrays of shape (m,)."""

    row: np.ndarray
    col: np.ndarray
    value: np.ndarray
    rows: int
    cols: int


@dataclass(frozen=True)
class Board:
    """A board in one image: places with a row and a column, arrays of shape (n,), and the marks on it."""

    row: np.ndarray
    col: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    rows: int
    cols: int
    marks: Marks | None = field(default=None)


def turned_cells(row: np.ndarray, col: np.ndarray, rows: int, cols: int, quarters: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the same places when a grid of ``rows`` × ``cols`` is counted from another corner, ``quarters`` of a turn on."""
    turns = ((row, col), (col, rows - 1 - row), (rows - 1 - row, cols - 1 - col), (cols - 1 - col, row))
    return turns[quarters % 4]


def turned(board: Board, quarters: int) -> Board:
    """The board numbered from another corner."""
    row, col = turned_cells(board.row, board.col, board.rows, board.cols, quarters)
    marks = board.marks
    if marks is not None:
        at = turned_cells(marks.row, marks.col, marks.rows, marks.cols, quarters)
        marks = replace(marks, row=at[0], col=at[1])
    return replace(board, row=row, col=col, marks=marks)


def quarters_between(before: Board, after: Board) -> int:
    """By how many quarters of a turn a board was numbered anew."""
    ways = [turned(before, k) for k in range(4)]
    return next(k for k, way in enumerate(ways) if np.array_equal(way.row, after.row) and np.array_equal(way.col, after.col))


def column_angle_deg(board: Board) -> float:
    """Direction in the image, from x towards y, in which the columns of a board are counted."""
    design = np.column_stack([board.col, board.row, np.ones(len(board.row))])
    step = np.linalg.lstsq(design, np.column_stack([board.x_px, board.y_px]), rcond=None)[0][0]
    return float(np.degrees(np.arctan2(step[1], step[0])))


def asymmetric_turns(rows: int) -> tuple[int, ...]:
    """Quarters of a turn after which a grid whose odd rows are shifted by half a step looks the same: 2, of an even number of rows."""
    return (0,) if rows % 2 else (0, 2)


def dot_marks(board: Board, area_px: np.ndarray) -> Marks:
    """Dots that are larger (1) or smaller (−1) than those around them."""
    from scipy.spatial import cKDTree

    cells = np.column_stack([board.row, board.col]).astype(float)
    near = cKDTree(cells).query(cells, k=min(MARK_AROUND, len(cells)))[1]
    ratio = area_px / np.median(area_px[near], axis=1)
    value = (ratio > MARKED_AREA).astype(float) - (ratio < 1 / MARKED_AREA)
    return Marks(board.row, board.col, value, board.rows, board.cols)


def consistent(
    boards: Sequence[Board],
    alike: tuple[int, ...] | None = None,
    decided: Sequence[int | None] | None = None,
    common: int | None = None,
) -> tuple[list[Board], tuple[Finding, ...]]:
    """Number a board in all of its images from the same corner.

    Parameters
    ----------
    boards : sequence of Board
        Of one pattern, in the order in which the images were taken; columns turn to rows as x does to y.
    alike : tuple of int, optional
        Quarters of a turn after which the board looks the same, where each image alone rules out the others; by default those that map
        its rows and columns onto themselves, and marks decide: those of the images before, if most images show equally many.
    decided : sequence of int, optional
        Quarters by which each board is turned against one that all have in common; None where that is not known.
    common : int, optional
        Quarters by which that one is turned; by default so that the first of these boards stands upright.

    Returns
    -------
    boards : list of Board
    findings : tuple of Finding
        What the numbering rests on where marks do not settle it.

    Notes
    -----
    A board of as many rows as columns can be counted from four corners, any other one from two. Turns with which the marks agree worse
    are ruled out; of the rest the one is taken that rotates the board least against the image before, or, in the first image, against
    upright.
    """
    known: np.ndarray | None = None
    boards = _with_trusted_marks(boards)
    out: list[Board] = []
    open_turns, widest, previous = 1, 0.0, 0.0
    for board, way in zip(boards, [None] * len(boards) if decided is None else decided, strict=True):
        turns = alike or ((0, 1, 2, 3) if board.rows == board.cols else (0, 2))
        if way is not None and common is not None:
            turns = ((way + common) % 4,)
        kept = _agreeing(board, turns, known)
        choices = [turned(board, k) for k in kept]
        off = [abs(_wrapped(column_angle_deg(b) - previous)) for b in choices]
        best = choices[int(np.argmin(off))]
        if way is not None and common is None:
            common = kept[int(np.argmin(off))] - way
        elif out and len(choices) > 1:
            open_turns = max(open_turns, len(choices))
            widest = max(widest, min(off) * len(choices))
        previous = column_angle_deg(best)
        if best.marks is not None:
            known = _laid_down(best.marks) + (0.0 if known is None else known)
        out.append(best)
    return out, _findings(open_turns, widest, len(out))


def _with_trusted_marks(boards: Sequence[Board]) -> list[Board]:
    """The boards, with marks only where they are as many as in most images: dirt and shadows make marks too, but not always the same."""
    counts = [0 if b.marks is None else int(np.count_nonzero(b.marks.value)) for b in boards]
    usual = max(set(counts), key=counts.count, default=0)
    trusted = usual > 0 and counts.count(usual) >= SAME_MARKS * len(boards)
    return [b if trusted and count == usual else replace(b, marks=None) for b, count in zip(boards, counts, strict=True)]


def _agreeing(board: Board, turns: tuple[int, ...], reference: np.ndarray | None) -> tuple[int, ...]:
    """Turns that the marks do not rule out."""
    if board.marks is None or reference is None:
        return turns
    scores = [float((_laid_down(turned(board, k).marks) * np.sign(reference)).sum()) for k in turns]
    marked = min(float(np.abs(board.marks.value).sum()), float(np.abs(np.sign(reference)).sum()))
    return tuple(k for k, score in zip(turns, scores, strict=True) if score >= max(scores) - CLEAR * marked)


def _laid_down(marks: Marks | None) -> np.ndarray:
    assert marks is not None
    grid = np.zeros((max(marks.rows, marks.row.max(initial=0) + 1), max(marks.cols, marks.col.max(initial=0) + 1)))
    grid[marks.row, marks.col] = marks.value
    return grid


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180) % 360 - 180


def _findings(open_turns: int, widest: float, images: int) -> tuple[Finding, ...]:
    if open_turns == 1 or images < 2:
        return ()
    limit = 360 / open_turns / 2
    greatest = widest / open_turns
    what = {2: "half a turn", 4: "a quarter of a turn"}.get(open_turns, "a turn")
    text = (
        f"The board looks the same after {what}. Its points were numbered with the smallest rotation from each image to the next, "
        f"{greatest:.0f}° at most where {limit:.0f}° would be undecided."
    )
    unsure = greatest > NEAR_LIMIT * limit
    advice = (
        "Check the numbering in images that were taken with the camera rolled, or use a board with a mark; "
        "with the board's coordinates held fixed a wrong turn does no harm."
    )
    return (Finding("numbering", text, advice, "warning" if unsure else "note"),)
