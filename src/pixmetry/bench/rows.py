"""The budget of a state, row by row: what is known is told at once, and simulations follow and settle."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from pixmetry.bench.state import Layout
from pixmetry.budget.answer import rms, with_shares
from pixmetry.budget.calibration_noise import calibration_row
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.monte_carlo import Trials
from pixmetry.budget.probe import resolve
from pixmetry.budget.table import Parts, SourceRow, Table, told_apart
from pixmetry.locate.target_estimator import parse_estimator

SIMULATED = (64, 256, 1024)  # windows of the simulation of everything at once: few at first, more as time goes on


def rows_of(layout: Layout, go_on: Callable[[], None]) -> Iterator[dict[str, Any]]:
    """Records of the budget as they are known: ``row`` for each source, ``budget`` for what they come to, ``together`` by simulation.

    The last of each kind is that of `pixmetry.budget.budget` for the same camera and scenario.

    Parameters
    ----------
    layout : Layout
    go_on : callable
        Called ahead of each piece of work; raises to end it.
    """
    setting = layout.setting
    setting.check()
    law = parse_estimator(layout.state.estimator)
    table = Table(setting, law)
    elements = table.elements()
    order = sorted(range(len(elements)), key=lambda k: _place(layout, *elements[k]))
    found: dict[int, SourceRow] = {}
    yield {"kind": "begin", "rows": len(elements)}
    for k in order:
        go_on()
        found[k] = table.row(*elements[k])
        yield {"kind": "row", "row": row_record(found[k]), "shares": shares_of(found.values())}
    go_on()
    rows = told_apart([found[k] for k in range(len(elements))])
    rows = with_shares([*rows, calibration_row(rows, setting)])
    budget = CameraBudget(setting, resolve(law, setting.target, setting.facts), tuple(rows))
    yield {"kind": "budget", "budget": budget_record(budget)}
    for trials in SIMULATED:
        go_on()
        t = Trials(setting.camera, setting.target, law, setting.facts, trials).of()
        values = {n: getattr(t, n) for n in ("total_px", "se_total_px", "calibrated_px", "se_calibrated_px", "trials", "lost")}
        yield {"kind": "together", "together": values, "last": trials == SIMULATED[-1]}


def _place(layout: Layout, element: Any, in_camera: bool) -> tuple[bool, bool, bool]:
    """What was changed or chosen comes first, then the rest of the camera, then what only may be in it."""
    names = {key.rpartition(".")[0] for key in layout.state.set}
    return element.name != layout.state.chosen, element.name not in names, not in_camera


def shares_of(rows: Iterable[SourceRow]) -> dict[str, tuple[float, float]]:
    """Part of each row in the square of the whole of these rows, after the calibration and before it, by the rows' names."""
    there = list(rows)
    before = sum(r.before_px**2 for r in there if r.counts)
    return {r.name: (r.share, r.before_px**2 / before if before and r.counts else 0.0) for r in with_shares(there)}


def _kinds(parts: Parts) -> dict[str, float]:
    """Shares of what is constant, smooth, from place to place and from frame to frame in the square of a source's error."""
    squares = {n: float(np.square(getattr(parts, f"{n}_px")).sum()) for n in ("constant", "smooth", "place", "time")}
    whole = sum(squares.values())
    return {n: v / whole if whole else 0.0 for n, v in squares.items()}


def row_record(row: SourceRow) -> dict[str, Any]:
    """What the page shows of a row."""
    names: tuple[str, ...] = ("name", "source_id", "title", "number", "stars", "status", "gum_class", "how", "reason", "advice")
    names += ("in_camera", "share", "before_px", "after_px", "largest_px", "own_stars", "counts", "taken_up")
    parts = {n: None if p is None else asdict(p) | {"kinds": _kinds(p)} for n, p in (("before", row.before), ("after", row.after))}
    return {n: getattr(row, n) for n in names} | parts


def budget_record(found: CameraBudget) -> dict[str, Any]:
    """What the page shows of all rows together."""
    record = found.to_record()
    names = ("camera", "target", "estimator", "one_target_one_frame", "answer", "point", "left_out", "goal")
    steps = {n: [asdict(s) | {"worth": s.is_worth_it} for s in getattr(found, n)[:8]] for n in ("to_measure", "to_change")}
    goal = {} if found.goal is None else {"goal_text": found.goal.text}
    together = {n: rms(getattr(found.one, f"{n}_px")) for n in ("before", "after", "least", "most")}
    rows = {"rows": [row_record(r) for r in found.rows], "shares": shares_of(found.rows)}
    return {n: record[n] for n in names} | {"rms_px": together} | steps | goal | rows
