"""Many cameras on one page: distribution of every value, cameras that stand out, limits, and what drifts from one result to the next."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.assess.judge.compare import Fleet, check_limits, compare_fleet
from pixmetry.assess.judge.conformity import Checked, Judgement, Limits, judge
from pixmetry.assess.judge.differences import Subject, family, holm, is_there, upper_tail
from pixmetry.assess.judge.subjects import RESULT_FILES, load_subject
from pixmetry.core.errors import InputError
from pixmetry.core.number import Number
from pixmetry.core.progress import Progress, no_progress
from pixmetry.emva.files.json_format import SCHEMA as SHEET_SCHEMA

FLEET_SCHEMA = "pixmetry/fleet-page/1"
FAR_SPREADS = 3.0  # from the median: the band that an odd camera is held against, with its own u
YEAR_S = 365.25 * 86400
LEAST_SPAN_S = 60.0  # between the results of one camera: shorter is one measurement
VALUE_COLUMNS = (
    "camera", "file", "time_utc", "latest", "channel", "key", "unit",
    "value", "u", "dof", "kind", "median", "spread", "in_spreads", "stands_out",
)  # fmt: skip
DRIFT_COLUMNS = ("camera", "channel", "key", "unit", "results", "years", "per_year", "u_per_year", "p", "drifts")


@dataclass(frozen=True)
class Member:
    """One result of one camera; ``time_s`` is when it was made, seconds since 1970, NaN where it does not tell."""

    camera: str
    path: Path
    time_s: float
    subject: Subject


@dataclass(frozen=True)
class Odd:
    """A camera that stands out in a value, and whether that value lies beyond three spreads of the median, its u taken into account."""

    camera: str
    channel: str
    key: str
    value: Number
    median: float
    spread: float
    in_spreads: float
    judgement: Judgement

    @property
    def is_sure(self) -> bool:
        """Whether it is beyond the band with its guard band, too."""
        return self.judgement.verdict == "fail"


@dataclass(frozen=True)
class Drift:
    """Change of a value of one camera with time: a straight line through its results, weighted by their u."""

    camera: str
    channel: str
    key: str
    unit: str
    results: int
    years: float
    per_year: float
    u_per_year: float
    p: float
    drifts: bool = False


@dataclass(frozen=True)
class FleetReport:
    """A fleet of cameras.

    Parameters
    ----------
    members : tuple of Member
        All results, by camera and time.
    fleet : Fleet
        Of the latest result of each camera.
    odd : tuple of Odd
    drifts : tuple of Drift
        Of cameras with two dated results or more.
    limits : dict of tuple of Checked
        By camera, where limits were given.
    notes : tuple of str
    """

    members: tuple[Member, ...]
    fleet: Fleet
    odd: tuple[Odd, ...]
    drifts: tuple[Drift, ...]
    limits: dict[str, tuple[Checked, ...]]
    notes: tuple[str, ...]

    @property
    def latest(self) -> tuple[Member, ...]:
        """The latest result of each camera, in the order of the fleet."""
        found = {member.camera: member for member in self.members}
        return tuple(found[name] for name in self.fleet.names)

    @property
    def good(self) -> bool:
        """Whether no camera stands out or drifts, and all limits hold."""
        held = all(row.judgement.verdict == "pass" for rows in self.limits.values() for row in rows)
        return not self.odd and held and not any(d.drifts for d in self.drifts)

    def value_rows(self) -> list[tuple[Any, ...]]:
        """Rows of the table of values, of all results."""
        last = {id(member.subject) for member in self.latest}
        rows = {(row.channel, row.key): row for row in self.fleet.rows}
        at = {name: k for k, name in enumerate(self.fleet.names)}
        found: list[tuple[Any, ...]] = []
        for member in self.members:
            latest = id(member.subject) in last
            for (channel, key), number in member.subject.values.items():
                row = rows.get((channel, key))
                if not is_there(number):
                    continue
                judged = (row.median, row.spread) if row is not None else (math.nan, math.nan)
                own = (
                    (row.scores[at[member.camera]], row.stands_out[at[member.camera]]) if row is not None and latest else (math.nan, False)
                )
                head = (member.camera, str(member.path), _utc(member.time_s), latest, channel, key, number.unit)
                found.append((*head, number.value, number.u, number.dof, number.kind, *judged, *own))
        return found

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        odd = [
            {
                "camera": o.camera, "channel": o.channel, "key": o.key, "value": o.value.to_record(), "median": o.median,
                "spread": o.spread, "in_spreads": o.in_spreads if math.isfinite(o.in_spreads) else None,
                "beyond_the_band": o.judgement.verdict,
            }
            for o in self.odd
        ]  # fmt: skip
        limits = [
            {"camera": camera, "channel": c.channel, "key": c.key, "value": c.value.to_record(), "verdict": c.judgement.verdict}
            for camera, rows in self.limits.items()
            for c in rows
        ]
        drifts = [dict(zip(DRIFT_COLUMNS, drift_row(d), strict=True)) for d in self.drifts]
        fleet = {**self.fleet.to_record(), "notes": list(self.notes)}
        return {"schema": FLEET_SCHEMA, "results": len(self.members), "fleet": fleet, "odd": odd, "limits": limits, "drifts": drifts}


def fleet_report(
    sources: Iterable[str | Path], *, limits: Limits | str | Path | None = None, level: float = 0.95, progress: Progress = no_progress
) -> FleetReport:
    """Compare many cameras with their fleet, with limits, and each with itself over time.

    Parameters
    ----------
    sources : iterable of path
        Results of assessments, calibrations, series, or data sheets; their folders; or folders with such folders anywhere below.
    limits : Limits, str or Path, optional
        File of limits (YAML).
    level : float
        Confidence over all values and cameras together, once for those that stand out and once for those that drift.
    progress : callable, optional

    Returns
    -------
    FleetReport

    Raises
    ------
    InputError
        If there are fewer than three cameras, the kinds differ, or a file cannot be read.

    Notes
    -----
    Results with the same serial number are of one camera; of those without one, each name of the camera in a folder of its own is one.
    The fleet is judged by `compare_fleet` on the latest result of each camera. A camera that stands out is held against the median ± 3
    spreads once more, with guarded rejection by its own u (JCGM 106, 8.3.3). A drift is the slope of a straight line through the results
    of one camera over the time at which they were made, weighted by 1/u², judged by Holm over all values and cameras. Its u takes the
    results as independent: what they have in common (one lamp, one chart) makes it too large, and hides small drifts rather than inventing
    them.
    """
    paths = list(dict.fromkeys(path for source in sources for path in result_files(Path(source))))
    members = []
    for done, path in enumerate(paths, start=1):
        members.append(_member(path))
        progress("reading results", done, len(paths))
    members.sort(key=lambda m: (m.camera, not math.isnan(m.time_s), m.time_s if not math.isnan(m.time_s) else 0.0))
    latest = {member.camera: member for member in members}
    if len(latest) < 3:
        remedy = "name more of them; two results are compared by `pixmetry compare`"
        raise InputError("a fleet has three cameras or more", value=f"{len(latest)} in {len(members)} results", remedy=remedy)
    fleet = compare_fleet([m.path for m in latest.values()], level=level, names=list(latest))
    held = {name: check_limits(m.path, limits) for name, m in latest.items()} if limits is not None else {}
    undated = sum(math.isnan(m.time_s) for m in members)
    notes = (*fleet.notes, *([f"{undated} results do not tell when they were made, and are in no drift"] if undated else ()))
    return FleetReport(tuple(members), fleet, _odd(fleet, latest), drifts_of(members, level), held, notes)


def result_files(source: Path) -> list[Path]:
    """The results in a file or folder, and in the folders below."""
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise InputError("no such file or folder", where=str(source), remedy="name results, or folders that hold them")
    own = next((source / name for name in RESULT_FILES if (source / name).is_file()), None)
    if own is not None:
        return [own]
    found = sorted(path for path in source.rglob("*.json") if path.is_file())
    shown = (path for path in found if not any(part.startswith(".") for part in path.relative_to(source).parts))
    kept = [path for path in shown if path.name in RESULT_FILES or _is_sheet(path)]
    if not kept:
        raise InputError(
            "no results below this folder", where=str(source), allowed=", ".join(RESULT_FILES), remedy="assess the cameras first"
        )
    return kept


def _is_sheet(path: Path) -> bool:
    """Whether a file begins as a data sheet of pixmetry does."""
    with path.open("rb") as file:
        return f'"{SHEET_SCHEMA}"'.encode() in file.read(200)


def _member(path: Path) -> Member:
    subject = load_subject(path)
    serial, name = (str(subject.camera.get(key) or "") for key in ("serial_number", "name"))
    camera = f"{name} {serial}".strip() if serial else f"{path.parent.name}" if path.name in RESULT_FILES else path.stem
    return Member(camera, path, _made_s(path), subject)


def _made_s(path: Path) -> float:
    """When a result was made, by its own record; NaN where it does not tell."""
    try:
        record = json.loads(path.read_bytes())
        return datetime.fromisoformat(record["provenance"]["time_utc"]).timestamp()
    except (OSError, ValueError, KeyError, TypeError):
        return math.nan


def _odd(fleet: Fleet, latest: dict[str, Member]) -> tuple[Odd, ...]:
    found = []
    for row in fleet.rows:
        for name, out, score in zip(fleet.names, row.stands_out, row.scores, strict=True):
            if out:
                number = latest[name].subject.values[row.channel, row.key]
                low, high = (row.median + side * max(FAR_SPREADS * row.spread, 1e-300) for side in (-1, 1))
                dof = math.inf if math.isnan(number.dof) else number.dof
                judgement = judge(number.value, number.u, dof, low, high, "guarded_rejection") if low < high else Judgement(
                    "fail", 0.0, 0.0, (low, high), "guarded_rejection"
                )  # fmt: skip
                found.append(Odd(name, row.channel, row.key, number, row.median, row.spread, score, judgement))
    return tuple(sorted(found, key=lambda odd: -abs(odd.in_spreads)))


def drifts_of(members: Sequence[Member], level: float = 0.95) -> tuple[Drift, ...]:
    """Slopes over time of all values of all cameras that have two dated results or more, those that drift first."""
    rows: list[Drift] = []
    by_camera: dict[str, list[Member]] = {}
    for member in members:
        if not math.isnan(member.time_s):
            by_camera.setdefault(member.camera, []).append(member)
    for camera, own in by_camera.items():
        if max(m.time_s for m in own) - min(m.time_s for m in own) < LEAST_SPAN_S:
            continue
        for place in dict.fromkeys(place for m in own for place in m.subject.values):
            if place[1].startswith(("index_", "budget.target.")):
                continue
            held = [(m.time_s, m.subject.values[place]) for m in own if place in m.subject.values]
            row = _slope(camera, place, [(t, v) for t, v in held if is_there(v) and not v.is_limit and v.u > 0])
            rows += [] if row is None else [row]
    changed, _ = holm([row.p for row in rows], [(row.camera, *family(row.channel, row.key)) for row in rows], 1 - level)
    marked = [replace(row, drifts=k in changed) for k, row in enumerate(rows)]
    return tuple(sorted(marked, key=lambda d: (not d.drifts, d.p)))


def _slope(camera: str, place: tuple[str, str], held: Sequence[tuple[float, Number]]) -> Drift | None:
    """The weighted straight line through values over time; None through fewer than two times."""
    if len(held) < 2 or len({number.unit for _, number in held}) > 1:
        return None
    t = np.array([time_s for time_s, _ in held]) / YEAR_S
    y, u = np.array([number.value for _, number in held]), np.array([number.u for _, number in held])
    weight = 1 / u**2
    from_mean = t - np.average(t, weights=weight)
    square = float((weight * from_mean**2).sum())
    if np.ptp(t) * YEAR_S < LEAST_SPAN_S or not square > 0:
        return None
    slope, u_slope = float((weight * from_mean * y).sum()) / square, square**-0.5
    dof = min(math.inf if math.isnan(number.dof) else number.dof for _, number in held)
    p = 2 * upper_tail(abs(slope) / u_slope, dof)
    return Drift(camera, *place, held[0][1].unit, len(held), float(np.ptp(t)), slope, u_slope, p)


def drift_row(d: Drift) -> tuple[Any, ...]:
    return (d.camera, d.channel, d.key, d.unit, d.results, d.years, d.per_year, d.u_per_year, d.p, d.drifts)


def _utc(time_s: float) -> str:
    from datetime import UTC

    return "" if math.isnan(time_s) else datetime.fromtimestamp(time_s, UTC).isoformat(timespec="seconds")
