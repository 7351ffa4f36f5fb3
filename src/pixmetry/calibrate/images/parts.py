"""Pictures that show parts of a plate of dots, numbered alike by the marks among its dots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.calibrate.images.looks import LEAST_MARKS, LEAST_PARTS, Laid, Looks, by_marks, together
from pixmetry.calibrate.images.numbering import column_angle_deg, turned_cells
from pixmetry.calibrate.images.targets import Seen, Wanted
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding

NO_MARKS = (
    f"parts of a plate are numbered only where {LEAST_MARKS} marks among its dots (hollow, larger or coded ones), alike in {LEAST_PARTS} "
    "images or more, tell which part"
)
UNSURE = "its marks do not tell which part of the plate it shows"
TEXT = "{} images show parts of the plate. They were numbered alike by the marks among its dots; row 0, column 0 is the first seen."


def numbered_parts(
    seen: Sequence[Seen], wanted: Wanted, plate: Looks | None = None
) -> tuple[list[Seen], Looks | None, tuple[Finding, ...]]:
    """Number what pictures show of a plate that is larger than they are.

    Parameters
    ----------
    seen : sequence of Seen
        Pictures of dots; of those with a reason and keys, each counts its part of the plate from the first row and column that it shows.
    wanted : Wanted
    plate : Looks, optional
        As another camera's pictures were numbered.

    Returns
    -------
    seen : list of Seen
        With numbers of the plate, where more pictures can be numbered so than by showing all of it.
    plate : Looks or None
        The marks by which they were numbered; None if nothing was numbered here.
    findings : tuple of Finding
        What the numbers rest on.

    Raises
    ------
    InputError
        If the size of the plate was said to be any, and several pictures have no marks in common.
    """
    shown = [k for k, one in enumerate(seen) if one.looks is not None and len(one.keys)]
    whole = [] if wanted.grid is None else [k for k in shown if not seen[k].reason]
    if plate is None and (len(seen) < 2 or len(whole) == len(shown)):
        return list(seen), None, ()
    looks = [seen[k].looks for k in shown]
    laid = by_marks(looks, range(4), shifted=True, plate=plate)  # type: ignore[arg-type]
    on = {k: way for k, way in zip(shown, laid, strict=True) if way is not None}
    if wanted.grid is None and len(shown) > 1 and not on:
        what = f"several images of any part of a plate cannot be numbered alike: {NO_MARKS}"
        raise InputError(what, where="grid", value="any", allowed="COLSxROWS of the whole plate; any for one image, or with marks")
    if len(on) <= len(whole):
        return list(seen), None, ()
    keys, problem = {k: _on_plate(seen[k], way) for k, way in on.items()}, ""
    if plate is None:
        plate, first = together(looks, laid)  # type: ignore[arg-type]
        keys = {k: one - first for k, one in keys.items()}
        rows, cols = plate.seen.shape
        quarters = _standing(keys, (rows, cols), seen, wanted)
        if quarters is None:
            assert wanted.grid is not None
            problem = f"by the marks, the images show {cols} × {rows} dots together, not {wanted.grid[0]} × {wanted.grid[1]}"
        else:
            keys = {k: np.column_stack(turned_cells(one[:, 0], one[:, 1], rows, cols, quarters)) for k, one in keys.items()}
            plate = plate.turned(quarters)
    out = []
    for k, one in enumerate(seen):
        if k in keys and not problem:
            extent = (int(keys[k][:, 0].max()) + 1, int(keys[k][:, 1].max()) + 1)
            out.append(replace(one, keys=keys[k], extent=extent, marks=None, reason=""))
        elif k in shown:
            out.append(replace(one, reason=problem or "; ".join(filter(None, (one.reason, UNSURE)))))
        else:
            out.append(one)
    return out, None if problem else plate, () if problem else (Finding("numbering", TEXT.format(len(on))),)


def _on_plate(one: Seen, way: Laid) -> np.ndarray:
    row, col = turned_cells(one.keys[:, 0], one.keys[:, 1], *one.extent, way.quarters)
    return np.column_stack([row, col]) + way.shift


def _standing(keys: dict[int, np.ndarray], shape: tuple[int, int], seen: Sequence[Seen], wanted: Wanted) -> int | None:
    """Quarters of a turn after which the plate has the size that was asked for, and stands most upright in the first picture."""
    rows, cols = shape
    first, ways = min(keys), []
    for quarters in range(4):
        extent = (rows, cols) if quarters % 2 == 0 else (cols, rows)
        if wanted.grid is None or (extent[0] <= wanted.grid[1] and extent[1] <= wanted.grid[0]):
            at = np.column_stack(turned_cells(keys[first][:, 0], keys[first][:, 1], rows, cols, quarters))
            board = replace(seen[first], keys=at, extent=extent).board
            ways.append((abs((column_angle_deg(board) + 180) % 360 - 180), quarters))
    return min(ways)[1] if ways else None
