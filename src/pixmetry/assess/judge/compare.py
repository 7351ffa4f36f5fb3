"""What changed between two measurements of one camera, in units of its uncertainty; and which camera of a fleet stands out.

Differences are judged together: with the confidence ``level`` (0.95), the chance that anything at all is called changed where nothing
has changed is 1 - level (5 %), by Holm's procedure (1979), which holds whatever the correlation of the values. Keys that say the same
thing in another unit (K and 1/K, DR in dB) are one decision.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pixmetry.assess.judge.differences import Difference, FleetRow, Subject, decided, difference_of, family, fleet_chance, fleet_row, holm
from pixmetry.assess.judge.subjects import CALIBRATED, load_subject
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError
from pixmetry.emva.files.json_format import value_record
from pixmetry.emva.records import MONO, DataSheet
from pixmetry.files.strict_json import plain

if TYPE_CHECKING:
    from pixmetry.assess.judge.conformity import Checked, Limits

JUDGED_FLEET = 5  # cameras; among 4 it takes 50 spreads to stand out of 35 values, among 3 more than 1000


@dataclass(frozen=True)
class Comparison:
    """Comparison of two files."""

    names: tuple[str, str]
    kind: str
    level: float
    rows: tuple[Difference, ...]
    decisions: int  # how many were judged together
    notes: tuple[str, ...] = ()

    def of(self, *verdicts: str) -> tuple[Difference, ...]:
        """Rows with one of these verdicts."""
        return tuple(row for row in self.rows if row.verdict in verdicts)

    @property
    def same(self) -> bool:
        """Whether nothing changed and nothing was left open."""
        return not self.of("changed", "differs", "undecided", "only A", "only B")

    def to_record(self) -> dict[str, Any]:
        """Return the plain record for JSON."""
        rows = []
        for row in self.rows:
            numbers = {"difference": row.difference, "u": row.u, "dof": row.dof, "in_u": row.in_u, "p": row.p}
            sides = {side: value_record(value) if value else None for side, value in (("a", row.a), ("b", row.b))}
            head = {"channel": row.channel, "key": row.key, "unit": row.unit, "verdict": row.verdict, "reason": row.reason}
            rows.append(head | {name: plain(float(number)) for name, number in numbers.items()} | sides)
        return _head("pixmetry/comparison/1", self) | {"decisions": self.decisions, "rows": rows}


@dataclass(frozen=True)
class Fleet:
    """Comparison of three or more cameras."""

    names: tuple[str, ...]
    kind: str
    level: float
    rows: tuple[FleetRow, ...]
    notes: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        """Whether no camera stands out."""
        return not any(any(row.stands_out) for row in self.rows)

    def to_record(self) -> dict[str, Any]:
        """Return the plain record for JSON."""
        rows = [plain({name: getattr(row, name) for name in FleetRow.__dataclass_fields__}) for row in self.rows]
        return _head("pixmetry/fleet/1", self) | {"rows": rows}


def _head(schema: str, result: Comparison | Fleet) -> dict[str, Any]:
    names, notes = list(result.names), list(result.notes)
    return {"schema": schema, "names": names, "kind": result.kind, "level": result.level, "same": result.same, "notes": notes}


@typed
def compare(
    a: DataSheet | str | Path, b: DataSheet | str | Path, *, level: float = 0.95, same_light: bool = False, names: Sequence[str] = ("", "")
) -> Comparison:
    """Say what changed between two measurements, in units of its uncertainty.

    Parameters
    ----------
    a, b : DataSheet, str or Path
        Two data sheets (or their JSON or XML files), or the results of two assessments or of two calibrations (``results.json`` or
        ``calibration.json``, or their folder).
        The two measurements are taken as independent.
    level : float
        Confidence over all values together: with 0.95 there is a chance of at most 5 % that anything is called changed if nothing did.
    same_light : bool
        Both were measured with one calibration of the light: what its uncertainty ``photons_u_rel`` adds to the values that are counted
        in photons is common to both and is taken off.
    names : two str
        What to call them.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If a file cannot be read, or the two have nothing in common.

    Notes
    -----
    The difference over its uncertainty is compared with Student's distribution, its degrees of freedom by Welch and Satterthwaite
    (JCGM 100, G.4). Where one side is a one-sided upper limit, only a value above that limit counts, by as much as it is above.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from pixmetry import compare, emva1288
    >>> before = emva1288()  # the packaged example
    >>> (results,) = before.results
    >>> gain = replace(results.values["K"], value=1.1 * results.values["K"].value)
    >>> after = replace(before, results=(replace(results, values={**results.values, "K": gain}),))
    >>> found = compare(before, after)
    >>> found.same, [row.key for row in found.of("changed")]  # the two say the same thing, and are one decision
    (False, ['K', 'inverse_K'])
    """
    _check_level(level)
    if len(names) != 2:
        raise InputError("not the names of two", where="names", value=len(names), allowed="two texts")
    one, two = load_subject(a, names[0]), load_subject(b, names[1])
    if one.kind != two.kind:
        raise InputError(f"{one.name} is a {one.kind} and {two.name} a {two.kind}", remedy="compare two of one kind")
    channels = {channel for channel, _ in one.values} & {channel for channel, _ in two.values}
    if not channels:
        remedy = "compare sheets with the same colours, or calibrations of the same cameras"
        raise InputError("no channel in common", where=f"{one.name}, {two.name}", remedy=remedy)
    keys = [place for place in {**one.values, **two.values} if place[0] in channels]
    rows = [difference_of(place, one, two, same_light) for place in keys]
    changed, decisions = holm([row.p for row in rows], _families(rows), 1 - level)
    rows = [decided(row, place in changed) for place, row in enumerate(rows)]
    rows += [_how(key, one.how[key], two.how[key]) for key in one.how if key in two.how]
    notes = _notes((one, two))
    if all(row.verdict in ("same", "equal") and not row.difference > 0 and not row.difference < 0 for row in rows):
        notes.append("all values are identical: two copies of one measurement")
    return Comparison((one.name, two.name), one.kind, level, tuple(rows), decisions, tuple(notes))


def _families(rows: Sequence[Difference]) -> list[Any]:
    """Rows that state the same quantity: by their keys, or by their numbers if several parts of an assessment have the same value."""
    first: dict[Any, Any] = {}
    found = []
    for row in rows:
        numbers = (row.unit, *((v.value, v.u) if v else None for v in (row.a, row.b)))
        found.append(first.setdefault(numbers, family(row.channel, row.key)) if row.p == row.p else family(row.channel, row.key))
    return found


def _how(key: str, a: str, b: str) -> Difference:
    """A row for an entry that is not a number."""
    verdict, reason = ("equal", a) if a == b else ("differs", f"{a} in A, {b} in B")
    return Difference(MONO, f"budget.{key}", "", None, None, verdict=verdict, reason=reason)


def _check_level(level: float) -> None:
    if not 0.5 <= level < 1:
        raise InputError("not a confidence level", where="level", value=level, allowed="0.5 up to below 1", remedy="take 0.95")


def _notes(subjects: Sequence[Subject], passed_over: frozenset[str] = frozenset()) -> list[str]:
    """Notes on differences between the files that affect the comparison."""
    notes = []
    releases = list(dict.fromkeys(s.release or "not stated" for s in subjects))
    if len(releases) > 1:
        notes.append(f"releases differ ({', '.join(releases)}): differences of definition count as changes")
    for field in sorted({name for s in subjects for name in s.camera} - passed_over):
        values = [str(s.camera[field]) for s in subjects if s.camera.get(field) is not None]
        if len(values) == len(subjects) and len(set(values)) > 1:
            notes.append(f"{field} differs: {', '.join(dict.fromkeys(values))}")
    channels = [{channel for channel, _ in s.values} for s in subjects]
    rest = sorted(set().union(*channels) - channels[0].intersection(*channels))
    if rest:
        notes.append(f"left out, because not all files have them: channels {', '.join(rest)}")
    told = [s.worth for s in subjects if s.worth is not None]
    if len(told) == len(subjects) and len({str(task) for task, _ in told}) == 1:
        before, after = ([px[state] for _, px in told if state in px] for state in ("", CALIBRATED))
        worth = f"the standard uncertainty of one coordinate of a target in one frame is {_listed(before)} px"
        notes.append(f"{worth}{f', {_listed(after)} px after a calibration' if len(after) == len(told) else ''} (k = 1)")
    elif len(told) == len(subjects):
        notes.append("target or estimator differ: the uncertainties of a coordinate belong to different tasks")
    return notes


def _listed(sizes: Sequence[float]) -> str:
    return ", ".join(f"{size:.3g}" for size in sizes)


@typed
def compare_fleet(sources: Iterable[DataSheet | str | Path], *, level: float = 0.95, names: Sequence[str] | None = None) -> Fleet:
    """Compare each camera of a fleet with the fleet.

    Parameters
    ----------
    sources : iterable of DataSheet, str or Path
        At least three; as for `compare`.
    level : float
        Confidence over all values and cameras together: with 0.95 there is a chance of at most 5 % that any camera is said to stand out
        from a fleet whose values are normally distributed.
    names : sequence of str, optional

    Returns
    -------
    Fleet

    Raises
    ------
    InputError
        If a file cannot be read, the kinds differ, there are fewer than three, or they have no channel in common.

    Notes
    -----
    The spread is the distance from the median within which three quarters of the cameras lie, over 1.15 as for a normal distribution:
    up to a quarter of them may be odd without hiding each other. It is at least the median of the uncertainties; a camera whose own
    uncertainty is larger than that is judged with the difference added. How far a camera of a normal fleet of this size lies from the
    median in units of such a spread is drawn once, from a keyed stream; then Holm over all values and cameras.

    Examples
    --------
    >>> from pixmetry import compare_fleet, emva1288
    >>> sheet = emva1288()  # the packaged example
    >>> fleet = compare_fleet([sheet] * 5, names=["A", "B", "C", "D", "E"])
    >>> fleet.same, fleet.names[0], any(row.key == "K" for row in fleet.rows)
    (True, 'A', True)
    """
    _check_level(level)
    sources = list(sources)
    if len(sources) < 3:
        raise InputError("a fleet has three cameras or more", value=len(sources), remedy="compare two of them with each other")
    subjects = [load_subject(source, name) for source, name in zip(sources, names or [""] * len(sources), strict=True)]
    kinds = list(dict.fromkeys(s.kind for s in subjects))
    if len(kinds) > 1:
        raise InputError(f"files of several kinds: {', '.join(kinds)}", remedy="compare files of one kind")
    channels = [{channel for channel, _ in s.values} for s in subjects]
    common = channels[0].intersection(*channels)
    if not common:
        raise InputError("no channel in common", remedy="compare sheets with the same colours, or calibrations of the same cameras")
    # settings, and what is there under another name
    passed_over = ("index_", "budget.target.", "photon_transfer.", "spatial.", "emva1288.")
    places = dict.fromkeys(place for s in subjects for place in s.values if place[0] in common and not place[1].startswith(passed_over))
    rows = [row for place in places if (row := fleet_row(place, subjects)) is not None]
    flat = [(i, j, score) for i, row in enumerate(rows) for j, score in enumerate(row.scores)]
    p = [fleet_chance(sum(map(math.isfinite, rows[i].values)), score) for i, _, score in flat]
    families = [(*family(rows[i].channel, rows[i].key), j) for i, j, _ in flat]
    found, _ = holm(p, families, 1 - level)
    out = {(flat[at][0], flat[at][1]) for at in found}
    rows = [replace(row, stands_out=tuple((i, j) in out for j in range(len(subjects)))) for i, row in enumerate(rows)]
    notes = _notes(subjects, frozenset({"name", "serial_number"}))
    if len(subjects) < JUDGED_FLEET:
        few = f"{len(subjects)} cameras hardly determine their spread, so that only a gross outlier stands out"
        notes.append(f"{few}: name {JUDGED_FLEET} or more")
    return Fleet(tuple(s.name for s in subjects), kinds[0], level, tuple(rows), tuple(notes))


@typed
def check_limits(source: DataSheet | str | Path, limits: Limits | str | Path) -> tuple[Checked, ...]:
    """Check the values of one camera against limits, each key in every channel.

    Parameters
    ----------
    source : DataSheet, str or Path
        As for `compare`.
    limits : Limits, str or Path
        A file of limits (YAML), or what `pixmetry.assess.judge.conformity.load_limits` read of it.

    Returns
    -------
    tuple of Checked
        ``key``, ``channel``, ``value``, and in ``judgement`` the ``verdict``: ``"pass"``, ``"fail"`` or ``"undecided"``.

    Raises
    ------
    InputError
        If a file cannot be read, a key does not exist, or a unit is missing or another one.

    Examples
    --------
    >>> from pathlib import Path
    >>> from pixmetry import check_limits, emva1288
    >>> written = Path("limits.yaml").write_text("schema: pixmetry/limits/1\\nlimits: {K: {min: 0.2, max: 0.25, unit: DN/e-}}")
    >>> (row,) = check_limits(emva1288(), "limits.yaml")  # the packaged example
    >>> row.judgement.verdict, row.finding.level
    ('fail', 'error')
    """
    from pixmetry.assess.judge.conformity import Limits, check, load_limits

    given = limits if isinstance(limits, Limits) else load_limits(limits)
    return check(load_subject(source).values, given)
