"""What is known of an object beforehand: coordinates of points, sizes of targets, and scale bars, from tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle.network import ScaleBars
from pixmetry.calibrate.checks.check_points import CheckPoints
from pixmetry.calibrate.project.tables import Table, first_few, index_of_names
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError

OTHER_UNIT = 5.0  # a scale bar and the distance of its points that differ by this factor are in different units


@dataclass(frozen=True)
class Known:
    """What is known of the points beforehand, in the order of the network's points: as in `pixmetry.calibrate.bundle.network.Network`."""

    xyz: np.ndarray
    u_xyz: np.ndarray
    diameter: np.ndarray | None
    normal: np.ndarray | None
    unseen: tuple[str, ...] = ()


def known_points(table: Table | None, names: Sequence[str], known: str | None, u: float | None) -> Known:
    """What a table with ``point, X, Y, Z`` says about the points of a network.

    Parameters
    ----------
    table : Table, optional
    names : sequence of str
        Points of the network.
    known : {"nominal", "fixed", "free", "weighted"}, optional
        None: weighted, where the table or ``u`` says how well they are known.
    u : float, optional
        Standard uncertainty of all coordinates.

    Raises
    ------
    InputError
        If a column is missing, a value cannot be used, or no point of the table is seen.
    """
    n = len(names)
    if table is None:
        return Known(np.full((n, 3), np.nan), np.full((n, 3), np.inf), None, None)
    table, rows, here, row_of = _rows_of(table, names)
    xyz, u_xyz = np.full((n, 3), np.nan), np.full((n, 3), np.inf)
    xyz[here] = coordinates(table)[row_of]
    u_xyz[here] = _u_of_points(table, known, u)[row_of]
    u_xyz[np.isnan(xyz)] = np.inf
    diameter, normal = _targets(table, here, row_of)
    seen = set(names)
    return Known(xyz, u_xyz, diameter, normal, tuple(name for name in rows if name not in seen))


def _rows_of(table: Table, names: Sequence[str]) -> tuple[Table, dict[str, int], np.ndarray, np.ndarray]:
    """A table of points with its columns spelled as here, the row of each of its names, which points of the network it has, and where."""
    table = table.spelled("point", "X", "Y", "Z", "u_X", "u_Y", "u_Z", "diameter", "normal_x", "normal_y", "normal_z")
    table.need("point", "X", "Y", "Z")
    rows = index_of_names(table, "point")
    at = np.array([rows.get(name, -1) for name in names])
    if not (at >= 0).any():
        what = "no point of the table is measured in an image"
        remedy = "use the same names in both tables"
        raise InputError(what, where=table.source, value=first_few(rows), allowed=first_few(names), remedy=remedy)
    return table, rows, at >= 0, at[at >= 0]


def _targets(table: Table, here: np.ndarray, row_of: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Diameters and normals of the network's points, as far as the table has them."""
    diameter, normal = None, None
    if "diameter" in table:
        diameter = np.full(len(here), np.nan)
        diameter[here] = table.numbers("diameter", empty=np.nan, above=0)[row_of]
    if any(f"normal_{axis}" in table for axis in "xyz"):
        table.need("normal_x", "normal_y", "normal_z")
        normal = np.full((len(here), 3), np.nan)
        normal[here] = _unit_normals(table)[row_of]
    return diameter, normal


def with_check_points(known: Known, table: Table | None, names: Sequence[str], u: float | None) -> tuple[Known, CheckPoints | None]:
    """The check points of a table, and what it says about the size of their targets; none of their coordinates become known.

    Raises
    ------
    InputError
        As from `known_points`, and if a point has coordinates in both tables.
    """
    if table is None:
        return known, None
    table, rows, here, row_of = _rows_of(table, names)
    both = here & (np.isfinite(known.xyz) | np.isfinite(known.u_xyz)).any(axis=1)
    if both.any():
        name = names[int(np.flatnonzero(both)[0])]
        what = f"point '{name}' is known and a check point"
        raise InputError(
            what, where=table.where(rows[name]), allowed="coordinates in one of the two tables", remedy="delete it in the other"
        )
    xyz, u_xyz = coordinates(table), np.full((len(table), 3), u or 0.0)
    for k, axis in enumerate("XYZ"):
        if f"u_{axis}" in table:
            u_xyz[:, k] = table.numbers(f"u_{axis}", empty=u or 0.0, least=0)
    targets = zip((known.diameter, known.normal), _targets(table, here, row_of), strict=True)
    diameter, normal = (old if new is None else new if old is None else np.where(np.isfinite(new), new, old) for old, new in targets)
    return replace(known, diameter=diameter, normal=normal), CheckPoints(tuple(rows), xyz, u_xyz)


def coordinates(table: Table) -> np.ndarray:
    """X, Y, Z of each row; NaN where one is empty: it is not known.

    Raises
    ------
    InputError
        If a value cannot be used, or an uncertainty stands beside an empty coordinate.
    """
    for axis in "XYZ":
        for row, (value, u) in enumerate(zip(table.columns[axis], table.columns.get(f"u_{axis}", ()), strict=False)):
            if u and not value:
                remedy = f"add {axis}, or leave u_{axis} empty, too: a coordinate that is not known has none"
                what, allowed = f"u_{axis} of a coordinate that is empty", "both, neither, or the coordinate alone"
                raise InputError(what, where=table.where(row), value=u, allowed=allowed, remedy=remedy)
    return np.stack([table.numbers(axis, empty=np.nan) for axis in "XYZ"], axis=1)


def _u_of_points(table: Table, known: str | None, u: float | None) -> np.ndarray:
    """Standard uncertainties of the points' coordinates: 0 exact, inf nothing known."""
    columns = [name for name in ("u_X", "u_Y", "u_Z") if name in table]
    if known in ("nominal", "fixed", "free") and u is not None:
        what = f"`known: {known}` and an uncertainty u"
        raise InputError(what, where=table.source, allowed="u with `known: weighted`", remedy="write `known: weighted`, or delete u")
    if known == "free":
        return np.full((len(table), 3), np.inf)
    if known in ("nominal", "fixed"):
        return np.zeros((len(table), 3))
    if known is None and not columns and u is None:
        allowed = "known: fixed (exact), nominal (stated as exact, to be tested), weighted (with u), or free (start values)"
        remedy = "add `known: ...` below `points:`, or columns u_X, u_Y, u_Z"
        raise InputError("the accuracy of the points is not stated", where=table.source, allowed=allowed, remedy=remedy)
    if not columns:
        if u is None:
            what = "weighted points, but no uncertainty"
            raise InputError(what, where=table.source, allowed="columns u_X, u_Y, u_Z, or `u:` for all of them", remedy="add one of them")
        return np.full((len(table), 3), u)
    table.need("u_X", "u_Y", "u_Z")
    empty = np.inf if u is None else u
    return np.stack([table.numbers(name, empty=empty, least=0) for name in columns], axis=1)


def _unit_normals(table: Table) -> Array:
    normals: Array = np.stack([table.numbers(f"normal_{axis}", empty=np.nan) for axis in "xyz"], axis=1)
    length = np.linalg.norm(normals, axis=1)
    if (length == 0).any():
        raise InputError("a normal without direction", where=table.where(int(np.flatnonzero(length == 0)[0])), remedy="correct it")
    of_unit_length: Array = normals / length[:, None]
    return of_unit_length


def scale_bars(tables: Sequence[Table], names: Sequence[str], known: Known | None = None) -> ScaleBars:
    """Scale bars from tables with ``from, to, length, u``.

    Raises
    ------
    InputError
        If a column is missing, a value cannot be used, a point is in no image, or lengths and points have different units.
    """
    index = {name: k for k, name in enumerate(names)}
    parts: list[Mapping[str, np.ndarray]] = []
    for table in tables:
        table = table.spelled("from", "to", "length", "u")
        table.need("from", "to", "length", "u")
        ends = {}
        for end in ("from", "to"):
            told = table.texts(end)
            wrong = next((row for row, name in enumerate(told) if name not in index), None)
            if wrong is not None:
                what = f"a scale bar at point '{told[wrong]}', which no image shows"
                raise InputError(what, where=table.where(wrong), allowed=first_few(names), remedy="correct its name, or delete the bar")
            ends[end] = np.array([index[name] for name in told], dtype=np.int64)
        same = np.flatnonzero(ends["from"] == ends["to"])
        if len(same):
            raise InputError("a scale bar from a point to itself", where=table.where(int(same[0])), remedy="correct its ends")
        lengths = table.numbers("length", above=0)
        if known is not None:
            _refuse_other_unit(table, ends, lengths, known)
        parts.append({**ends, "length": lengths, "u": table.numbers("u", above=0)})
    if not parts:
        return ScaleBars.none()
    return ScaleBars(*(np.concatenate([part[key] for part in parts]) for key in ("from", "to", "length", "u")))


def _refuse_other_unit(table: Table, ends: Mapping[str, np.ndarray], lengths: np.ndarray, known: Known) -> None:
    """Lengths that do not fit the points' coordinates, where these are known and not mere start values."""
    sure = np.isfinite(known.u_xyz).all(axis=1)
    distance = np.linalg.norm(known.xyz[ends["from"]] - known.xyz[ends["to"]], axis=1)
    ratio = np.where(sure[ends["from"]] & sure[ends["to"]], lengths / np.maximum(distance, 1e-300), 1.0)
    bad = (ratio > OTHER_UNIT) | (ratio < 1 / OTHER_UNIT)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        what = f"a scale bar of {lengths[row]:g} between points that are {distance[row]:g} apart"
        raise InputError(what, where=table.where(row), allowed="lengths in the unit of the points", remedy="convert one of them")
