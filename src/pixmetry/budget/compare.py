"""Budgets side by side: which camera measures better, how sure that is, and which sources make the difference.

Every budget leaves an interval, because not everything about a camera is known. A camera is surely the better one if it stays so whatever
the sources that are not measured are, up to their bounds. What two budgets of one camera do not know of it is the same in both.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.budget.answer import Answer, answer_of, rms
from pixmetry.budget.camera_budget import SCHEMA, CameraBudget
from pixmetry.budget.table import AT_BOUND, TYPICAL, Pair, Parts, SourceRow
from pixmetry.core.arguments import typed
from pixmetry.core.checksums import check_record
from pixmetry.core.door import read_bytes
from pixmetry.core.errors import InputError
from pixmetry.core.plain_text import ends_of_paths
from pixmetry.files.strict_json import parse_json, plain, starts_with

COMPARED_SCHEMA = "pixmetry/budget_comparison/1"
SURE, LIKELY, OPEN, SAME = "sure", "likely", "open", "the same"
ALIKE = 0.01  # relative difference of two totals that nobody would notice
PARTS = ("before", "after", "largest")
OF_THE_LENS = ("optics.", "sensor.tilt", "calibration")  # what another lens on the same camera has anew
REMEDY = "name a file that `pixmetry budget --json` wrote"


@dataclass(frozen=True)
class BudgetSide:
    """One budget of a comparison.

    Parameters
    ----------
    name : str
        What it is called here.
    camera, estimator : str
    rows : tuple of SourceRow
    scenario : mapping
        Every entry with its value.
    frames, targets : int
        Of the mean that is compared.
    um_per_px, mm_per_px : (float, float), optional
        On the sensor and on the object, in x and y; None where they are not known.
    depth_mm : float, optional
        Standard uncertainty along the line of sight of a point in space.
    frame_shape : (int, int)
        Rows and columns.
    lens : mapping
        Focal length and description of the optics, by which lenses are told apart.
    exposure_s : float, optional
        None in a budget of an earlier version.
    """

    name: str
    camera: str
    estimator: str
    rows: tuple[SourceRow, ...]
    scenario: Mapping[str, Any]
    frames: int
    targets: int
    um_per_px: Pair | None
    mm_per_px: Pair | None
    depth_mm: float | None
    frame_shape: tuple[int, int]
    lens: Mapping[str, Any]
    exposure_s: float | None = None

    @property
    def field_mm(self) -> Pair | None:
        """Width and height of the object that fill the frame."""
        if self.mm_per_px is None:
            return None
        return self.frame_shape[1] * self.mm_per_px[0], self.frame_shape[0] * self.mm_per_px[1]

    @property
    def answer(self) -> Answer:
        """In px, for the mean over frames and targets."""
        return answer_of(self.rows, self.frames, self.targets)

    def size(self, pair_px: Pair, unit: str) -> float:
        """Root mean square over x and y in ``px``, ``um`` or ``mm``; NaN where that scale is not known."""
        scale = {"px": (1.0, 1.0), "um": self.um_per_px, "mm": self.mm_per_px}[unit]
        return float("nan") if scale is None else rms((pair_px[0] * scale[0], pair_px[1] * scale[1]))


@dataclass(frozen=True)
class SourceDifference:
    """What one source does in every budget, after the calibration.

    Parameters
    ----------
    source_id, title : str
    sizes : tuple of float
        In the unit of the comparison; 0 where it does not count.
    statuses : tuple of str
        How each budget knows it.
    shares : tuple of float
        Its part of the difference of the squares between each budget and the best one; NaN for the best, and where they are the same.
    """

    source_id: str
    title: str
    sizes: tuple[float, ...]
    statuses: tuple[str, ...]
    shares: tuple[float, ...]


@dataclass(frozen=True)
class Rank:
    """How one budget stands beside the best one.

    Parameters
    ----------
    side : int
        Number of the budget.
    ratio : float
        Its total after the calibration over the best one's.
    verdict : {"sure", "likely", "open", "the same"}
        It is worse whatever is not measured; it is worse as far as one knows, but the intervals overlap; what is not measured decides;
        the totals and both ends differ by less than 1 %.
    overlaps : bool
        Whether the intervals overlap; the order may be sure all the same, if what is not known is the same in both.
    open_sources : tuple of str
        Titles of the sources that leave the order open, the widest first.
    """

    side: int
    ratio: float
    verdict: str
    overlaps: bool = True
    open_sources: tuple[str, ...] = ()


@dataclass(frozen=True)
class BudgetComparison:
    """Budgets side by side.

    Parameters
    ----------
    sides : tuple of BudgetSide
        In the order in which they were given.
    unit : {"mm", "px"}
        In which they are compared: on the object if all budgets know the scale.
    ranks : tuple of Rank
        The best first.
    rows : tuple of SourceDifference
        What differs most first.
    settings : mapping of str to tuple
        What was not the same: camera, estimator and entries of the scenario, with the value in every budget.
    """

    sides: tuple[BudgetSide, ...]
    unit: str
    ranks: tuple[Rank, ...]
    rows: tuple[SourceDifference, ...]
    settings: Mapping[str, tuple[Any, ...]]

    @property
    def best(self) -> BudgetSide:
        """The one with the smallest total after the calibration."""
        return self.sides[self.ranks[0].side]

    def to_record(self) -> dict[str, Any]:
        """Return the plain record for JSON."""
        sides = []
        for side in self.sides:
            answer = {n.removesuffix("_px"): getattr(side.answer, n) for n in ("before_px", "after_px", "least_px", "most_px")}
            lengths = {f"{n}_{unit}": side.size(pair, unit) for unit in ("px", "um", "mm") for n, pair in answer.items()}
            head = {n: getattr(side, n) for n in ("name", "camera", "estimator", "frames", "targets", "depth_mm", "field_mm", "exposure_s")}
            sides.append(head | lengths)
        rest = {n: [asdict(one) for one in getattr(self, n)] for n in ("ranks", "rows")}
        head = {"schema": COMPARED_SCHEMA, "unit": self.unit, "best": self.best.name}
        return plain(head | {"sides": sides} | rest | {"settings": self.settings})


# ---- reading -----------------------------------------------------------------------------------------------------------------------


def is_budget_file(path: str | Path) -> bool:
    """Whether a file is a budget by `pixmetry budget`, as far as its beginning tells."""
    try:
        with Path(path).open("rb") as file:
            raw = file.read(200)
    except OSError:
        return False
    return starts_with(raw, b"{") and SCHEMA.rpartition("/")[0].encode() in raw


def side_of(source: CameraBudget | str | Path, name: str = "") -> BudgetSide:
    """Read one budget of a comparison.

    Raises
    ------
    InputError
        If the file is no budget, or a damaged one.
    """
    if isinstance(source, CameraBudget):
        return _side(plain(source.to_record()), name or source.camera, name or source.camera)
    path = Path(source)
    raw = read_bytes(path, remedy=REMEDY)
    record = parse_json(raw, str(path), REMEDY)
    check_record(record, str(path))
    if record.get("schema") != SCHEMA:
        raise InputError("not an error budget", where=str(path), value=record.get("schema", "no schema"), allowed=SCHEMA, remedy=REMEDY)
    return _side(record, name or str(path), str(path))


def _side(record: Mapping[str, Any], name: str, where: str) -> BudgetSide:
    try:
        answer, scale, pitch = record["answer"], record["px_per_mm"], record["pitch_um"]
        mm = None if scale is None else (1 / scale, 1 / scale * (pitch[1] / pitch[0] if pitch else 1.0))
        point = record["point"]
        side = BudgetSide(
            name=name,
            camera=str(record["camera"]),
            estimator=str(record["estimator"]["name"]),
            rows=tuple(_row(r) for r in record["rows"]),
            scenario={key: entry["value"] for key, entry in record["scenario"].items()},
            frames=int(answer["frames"]),
            targets=int(answer["targets"]),
            um_per_px=None if pitch is None else (float(pitch[0]), float(pitch[1])),
            mm_per_px=mm,
            depth_mm=None if point is None else float(point["covariance_mm2"][2][2]) ** 0.5,
            frame_shape=(int(record["frame_shape"][0]), int(record["frame_shape"][1])),
            lens=dict(record["lens"]),
            exposure_s=None if record.get("exposure_s") is None else float(record["exposure_s"]),
        )
        told, found = answer["after_px"], side.answer.after_px
        if not np.allclose(told, found, rtol=1e-6, atol=1e-12):
            raise ValueError
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, ZeroDivisionError):
        raise InputError("a damaged budget", where=where, remedy="make it again with `pixmetry budget --json`") from None
    return side


def _row(record: Mapping[str, Any]) -> SourceRow:
    fields: dict[str, Any] = {name: record[name] for name in SourceRow.__dataclass_fields__ if name != "fields_px"}
    fields |= {name: _parts(fields[name]) for name in PARTS}
    return SourceRow(**fields)


def _parts(record: Mapping[str, Any] | None) -> Parts | None:
    return None if record is None else Parts(**{name: (float(v[0]), float(v[1])) for name, v in record.items()})


# ---- comparing ---------------------------------------------------------------------------------------------------------------------


@typed
def compare_budgets(sources: Iterable[CameraBudget | str | Path], names: Sequence[str] | None = None) -> BudgetComparison:
    """Compare budgets: two cameras, three lenses, one camera before and after a change.

    Parameters
    ----------
    sources : iterable of CameraBudget, str or Path
        Two or more, or their files (`pixmetry budget --json`).
    names : sequence of str, optional
        What to call them; by default their files, as short as they still differ, or their cameras.

    Returns
    -------
    BudgetComparison
        ``best``, ``ranks`` with how sure that is, and ``rows`` with each source's share of the difference.

    Raises
    ------
    InputError
        If a file is no budget, or there is only one.

    Notes
    -----
    The total after the calibration is compared, for the mean over the frames and targets of the scenario: in mm on the object where all
    budgets know the scale, else in px. The verdict is "sure" where the upper end of the better one lies below the lower end of the
    other; at the lower end, what is measured or stated with an uncertainty is as much smaller as it is larger at the upper one. Two
    budgets of one camera (by its name, format and pitch) share what is not known of it, but for that of another lens; those of two
    cameras what is not known of the object: a source that both know alike, and not by measurement, is put at the same end in both, the
    one that speaks more for the worse budget.

    Examples
    --------
    >>> import pixmetry
    >>> lenses = [{"object": {"distance_mm": 2000, "f_mm": f}} for f in (16, 50)]
    >>> found = pixmetry.compare_budgets([pixmetry.budget("imx264_like", lens) for lens in lenses], names=["16 mm", "50 mm"])
    >>> found.best.name, found.ranks[1].verdict, found.settings["object.f_mm"]
    ('50 mm', 'likely', (16.0, 50.0))
    """
    given = list(sources)
    if len(given) < 2:
        raise InputError("one budget cannot be compared", value=len(given), remedy="name two budgets or more")
    told = list(names) if names is not None else _names_of(given)
    sides = tuple(side_of(source, name) for source, name in zip(given, told, strict=True))
    unit = "mm" if all(s.mm_per_px is not None for s in sides) else "px"
    totals = [s.size(s.answer.after_px, unit) for s in sides]
    order = [int(i) for i in np.argsort(totals, kind="stable")]
    best = order[0]
    ranks = [Rank(best, 1.0, SAME)] + [_rank(sides, best, i, totals, unit) for i in order[1:]]
    return BudgetComparison(sides, unit, tuple(ranks), _rows(sides, best, totals, unit), _settings(sides))


def _names_of(sources: Sequence[CameraBudget | str | Path]) -> list[str]:
    files = [str(s) for s in sources if not isinstance(s, CameraBudget)]
    short = {file: end.removesuffix(".json") for file, end in zip(files, ends_of_paths(files), strict=True)}
    names = [s.camera if isinstance(s, CameraBudget) else short[str(s)] for s in sources]
    return [name if names.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(names)]


def _rank(sides: Sequence[BudgetSide], best: int, other: int, totals: Sequence[float], unit: str) -> Rank:
    """How sure it is that one budget is worse than the best one."""
    better, worse = sides[best], sides[other]
    ratio = totals[other] / totals[best] if totals[best] else float("inf") if totals[other] else 1.0
    ends = [[s.size(getattr(s.answer, end), unit) for s in (better, worse)] for end in ("least_px", "most_px")]
    if ratio <= 1 + ALIKE and all(b <= a * (1 + ALIKE) and a <= b * (1 + ALIKE) for a, b in ends):
        return Rank(other, ratio, SAME)
    common = _common(better, worse)
    largest = [_by_source(replace(side, rows=_at_bounds(side.rows)), unit) for side in (better, worse)]
    turning = {name for name in common if largest[0].get(name, 0.0) > largest[1].get(name, 0.0)}  # what would help the worse one most
    if better.size(_total(better, common - turning), unit) < worse.size(_total(worse, _ids(worse) - turning), unit):
        return Rank(other, ratio, SURE, overlaps=ends[1][0] >= ends[0][1])
    likely = ratio > 1 + ALIKE and all(a < b for a, b in ends)
    return Rank(other, ratio, LIKELY if likely else OPEN, open_sources=_widest(sides, common) or _widest(sides, frozenset()))


def _widest(sides: Iterable[BudgetSide], but: frozenset[str]) -> tuple[str, ...]:
    """Titles of the sources whose size is least known, but for some; the widest first."""
    widths: dict[str, float] = {}
    for side in sides:
        for row in side.rows:
            if row.largest is not None and row.source_id not in but:
                known = 0.0 if row.status == AT_BOUND else row.after_px
                widths[row.title] = max(widths.get(row.title, 0.0), row.largest_px**2 - known**2)
    return tuple(sorted((title for title, width in widths.items() if width > 0), key=lambda t: -widths[t])[:3])


def _common(one: BudgetSide, two: BudgetSide) -> frozenset[str]:
    """Ids of the sources that two budgets know alike, and not by measurement, and that are the same in both.

    In one camera these are all, with two lenses all but those of the lens; in two cameras those of the object, if it is the same in both
    scenarios.
    """
    known = [{r.source_id: r.status for r in side.rows if r.status in (TYPICAL, AT_BOUND)} for side in (one, two)]
    alike = frozenset(name for name, status in known[0].items() if known[1].get(name) == status)
    if (one.camera, one.frame_shape, one.um_per_px) == (two.camera, two.frame_shape, two.um_per_px):
        return alike if one.lens == two.lens else frozenset(name for name in alike if not name.startswith(OF_THE_LENS))
    same_object = all(two.scenario.get(key) == value for key, value in one.scenario.items() if key.startswith(("target.", "light.")))
    return frozenset(name for name in alike if same_object and name.startswith("scene."))


def _ids(side: BudgetSide) -> frozenset[str]:
    return frozenset(r.source_id for r in side.rows)


def _at_bounds(rows: Iterable[SourceRow]) -> tuple[SourceRow, ...]:
    """The rows with everything that is not measured at its bound."""
    return tuple(replace(r, after=r.largest or r.after, status=TYPICAL if r.status == AT_BOUND else r.status) for r in rows)


def _total(side: BudgetSide, at_least: Collection[str]) -> Pair:
    """Total after the calibration with everything at its bound, but these sources at the lower end: without what is not known."""
    low = [_lowered(r) for r in side.rows if r.source_id in at_least and r.status != TYPICAL]
    return answer_of([*low, *_at_bounds(r for r in side.rows if r.source_id not in at_least)], side.frames, side.targets).after_px


def _lowered(row: SourceRow) -> SourceRow:
    """What is known with an uncertainty as far below as it may lie above."""
    if row.after is None or row.largest is None or row.status == AT_BOUND:
        return row
    lower = [2 * abs(a) - abs(most) for a, most in zip(row.after.values_px, row.largest.values_px, strict=True)]
    return replace(row, after=Parts.of([max(v, 0.0) * (1 if a >= 0 else -1) for v, a in zip(lower, row.after.values_px, strict=True)]))


def _rows(sides: Sequence[BudgetSide], best: int, totals: Sequence[float], unit: str) -> tuple[SourceDifference, ...]:
    """Every source that counts anywhere; what differs most first."""
    tables = [_by_source(side, unit) for side in sides]
    titles = {r.source_id: r.title for side in sides for r in side.rows}
    statuses = [{r.source_id: r.status for r in side.rows} for side in sides]
    whole = [sum(v**2 for v in table.values()) for table in tables]
    found = []
    for source_id in dict.fromkeys(name for table in tables for name, size in table.items() if size > 0):
        sizes = [table.get(source_id, 0.0) for table in tables]
        shares = [
            (size**2 - sizes[best] ** 2) / (all_of_it - whole[best])
            if i != best and totals[i] > totals[best] * (1 + ALIKE) and all_of_it > whole[best]
            else float("nan")
            for i, (size, all_of_it) in enumerate(zip(sizes, whole, strict=True))
        ]
        told = tuple(s.get(source_id, "") for s in statuses)
        found.append(SourceDifference(source_id, titles[source_id], tuple(sizes), told, tuple(shares)))
    return tuple(sorted(found, key=lambda r: -(max(r.sizes) ** 2 - min(r.sizes) ** 2)))


def _by_source(side: BudgetSide, unit: str) -> dict[str, float]:
    squares: dict[str, float] = {}
    for row in side.rows:
        if row.counts and row.after is not None:
            size = side.size(row.after.axes_px(side.frames, side.targets), unit)
            squares[row.source_id] = squares.get(row.source_id, 0.0) + size**2
    return {name: square**0.5 for name, square in squares.items()}


def _settings(sides: Sequence[BudgetSide]) -> dict[str, tuple[Any, ...]]:
    """What was not the same in all budgets."""
    told = [{"camera": s.camera, "estimator": s.estimator, "exposure_s": s.exposure_s} | dict(s.scenario) for s in sides]
    keys = dict.fromkeys(key for one in told for key in one)
    found = {key: tuple(one.get(key) for one in told) for key in keys}
    return {key: values for key, values in found.items() if any(v != values[0] for v in values)}
