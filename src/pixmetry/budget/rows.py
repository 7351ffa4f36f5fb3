"""The rows of a budget: which sources count, with which parameters; what each contributes, by formula or by simulation; their order."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from pixmetry.budget.combine import Combined, combine
from pixmetry.budget.monte_carlo import MonteCarlo, Trials, hangs_on_picture, missed
from pixmetry.budget.parameters import applies, base_of, u_of_total, with_estimates
from pixmetry.budget.probe import ESTIMATOR_ITSELF, Probes, perfect
from pixmetry.budget.records import DECIDED, BudgetRow, Interaction
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import sources
from pixmetry.camera.contribution import UNSTEADY, Contribution
from pixmetry.camera.observations import LENS, TAKEN_UP, CameraGeometry
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates

CALIBRATED = "in front of the pixels: frames without targets do not show it; a calibration with targets does"
FEW, MORE, FEW_UNITS = 256, 1024, 4  # windows and cameras for a source without a formula: more where few leave too much open
SMALL = 0.05  # of the total with it: what its standard error may be before more are drawn


@dataclass(frozen=True)
class Known:
    """Known parameters and estimates of the sources of one camera.

    Parameters
    ----------
    camera : Camera
        With the estimates in its chain.
    estimates : mapping of str to Estimates
        By name in the chain, or id of a source that is not in it.
    accepted : collection of str
        Names in the chain that are taken at their bound.
    geometry : CameraGeometry, optional
        With which positions are corrected.
    sensor_shape : (int, int)
        Rows and columns for which bounds are taken.
    """

    camera: Camera
    estimates: Mapping[str, Estimates]
    accepted: Collection[str]
    geometry: CameraGeometry | None
    sensor_shape: tuple[int, int]

    @property
    def sources(self) -> list[tuple[str, Source]]:
        """The sources with a row: those of the chain, then the others of the catalogue."""
        named = [(e.name, e.source) for e in self.camera.active]
        there = {source.id for _, source in named}
        return named + [(i, s) for i, s in sources().items() if i not in there]

    def has(self, name: str) -> bool:
        """Whether it is in the chain and switched on."""
        return any(e.name == name for e in self.camera.active)

    def estimates_of(self, name: str) -> Estimates | None:
        """What was measured of it, if anything was."""
        found = self.estimates.get(name)
        return found if found is not None and len(found) else None

    def parameters_of(self, row: BudgetRow) -> Any:
        """The parameters with which a row counts."""
        source, measured = catalogue_source(row), self.estimates_of(row.name)
        if row.status == "accepted":
            return source.bound_of(self.sensor_shape)
        base = base_of(source, self.camera, row.name)
        return base if measured is None or row.in_camera else with_estimates(source, base, measured)


def catalogue_source(row: BudgetRow) -> Source:
    """The source of a row."""
    return sources()[row.source_id]


def as_measured(camera: Camera, estimates_by_source: dict[str, Estimates]) -> Camera:
    """Put the estimates into the chain; the mapping is keyed by name in the chain afterwards."""
    chain = []
    for element in camera.chain:
        estimates = estimates_by_source.get(element.name, estimates_by_source.get(element.source.id))
        if estimates is not None and len(estimates):
            estimates_by_source[element.name] = estimates
            element = replace(element, params=with_estimates(element.source, element.params, estimates))
        chain.append(element)
    return replace(camera, chain=tuple(chain))


# ---- by formula --------------------------------------------------------------------------------------------------------------------


def rows_by_formula(known: Known, probes: Probes, say: Callable[[str], None]) -> Iterator[BudgetRow]:
    """A row for every source, with its status, and its contribution if there is a formula."""
    for name, source in known.sources:
        say(name)
        if known.geometry is not None and source.id in TAKEN_UP:
            yield _calibrated(name, source, known.geometry)
            continue
        row = _with_status(BudgetRow(name, source.id, source.title, "", in_camera=known.has(name)), source, known)
        yield _with_formula(row, source, known, probes) if row.status in (*DECIDED, "accepted") else row


def _with_status(row: BudgetRow, source: Source, known: Known) -> BudgetRow:
    measured = known.estimates_of(row.name)
    beyond = "" if row.in_camera or measured is not None else _beyond(source, known)
    facts = known.camera.facts
    if not applies(source, facts):
        return replace(row, status="not applicable", reason=f"only in a camera that is {' or '.join(source.applies_to)}")
    if beyond:
        return replace(row, status="not applicable", reason=beyond)
    of_motion = Kind.LIGHT in source.consumes and source.gum_class == "O" and source.propagate is None
    if of_motion:  # a calibration takes nothing up of how an object moves
        reason = f"a target at rest is not moved by it; for a moving one: {source.reasons['propagate']}"
        return replace(row, status="not applicable", reason=reason)
    if Kind.LIGHT in source.consumes and not (row.in_camera or measured is not None):
        return replace(row, status="left to calibration", reason=CALIBRATED)
    if measured is not None:
        return replace(row, status="measured", reason=measured.method)
    if (row.in_camera and row.name not in known.accepted) or not source.parameters.model_fields:
        return replace(row, status="modelled", reason="from the description of the camera" if row.in_camera else "")
    return replace(row, status="accepted", reason=source.reasons.get("measure", "not measured in this campaign"))


def _beyond(source: Source, known: Known) -> str:
    """Why a camera does not have this source, if nothing says that it has; empty if it may have it."""
    if source.part_of:
        return f"it counts in the row of {sources()[source.part_of].title}"
    if source.option:
        return f"only in a camera with {source.option}"
    if source.stage == "storage" and known.camera.facts.get("lossless"):
        return "only in frames that were stored with loss; these were not"
    if source.held_by and all(known.estimates_of(h) is not None for h in source.held_by):
        where = ", ".join(sources()[h].title for h in source.held_by)
        return f"its part in these frames was measured, and counts, as: {where}"
    return ""


def _with_formula(row: BudgetRow, source: Source, known: Known, probes: Probes) -> BudgetRow:
    if source.propagate is None:
        return replace(row, reason=source.reasons["propagate"])
    if hangs_on_picture(source, known.camera):
        return replace(row, reason="simulated: a closed form does not see what lens, line and mosaic make of the target")
    probe, params = probes.of(row.name, source), known.parameters_of(row)
    if row.status == "accepted":
        probe = replace(probe, frame_shape=known.sensor_shape) if known.sensor_shape != known.camera.frame_shape else probe
    contribution = source.propagate(params, probe)
    if not np.isfinite(contribution.total_px):
        return replace(row, reason="no target is found after this source")
    measured = known.estimates_of(row.name)
    u = 0.0 if measured is None else u_of_total(source, params, measured, probe)
    return replace(row, contribution=contribution, u_of_total_px=u)


def _calibrated(name: str, source: Source, geometry: CameraGeometry) -> BudgetRow:
    """The remaining error after a calibration, in the row of the lens; the other sources that it includes point to that row."""
    head = BudgetRow(name, source.id, source.title, "calibrated")
    if source.id != LENS:
        return replace(head, reason=f"included in the {geometry.origin}; the remaining error is in the row of {sources()[LENS].title}")
    u_x, u_y = np.hypot(geometry.u_x_px, geometry.left_x_px), np.hypot(geometry.u_y_px, geometry.left_y_px)
    method = f"remaining error after the {geometry.origin}: uncertainty of a corrected position over the frame, and systematic residuals"
    # no further calibration takes it up: nothing of it counts as smooth
    found = Contribution(float(u_x), float(u_y), "G", model_error=0.2, method=method, smooth_px=(0.0, 0.0))
    return replace(head, contribution=found, reason=method)


# ---- by simulation -----------------------------------------------------------------------------------------------------------------


def without_accepted(rows: Sequence[BudgetRow], camera: Camera) -> Camera:
    """The camera of the verdict: its chain without the sources that are only accepted."""
    return missed(camera, [r.name for r in rows if r.status == "accepted" and r.in_camera])


def beside_formula(row: BudgetRow, design: Trials, say: Callable[[str], None]) -> BudgetRow:
    """Add the Monte Carlo to a row that the chain can simulate with its parameters; without a formula it is the contribution."""
    camera = design.camera
    if row.status not in DECIDED:
        return row
    if row.source_id == ESTIMATOR_ITSELF:
        return replace(row, monte_carlo=design.compare([row.name], perfect(camera), None))
    if row.name not in camera or not camera[row.name].on or _needs_no_simulation(row):
        return row
    say(f"Monte Carlo: {row.name}")
    try:
        found = design.of(only=[row.name])
    except InputError as problem:
        return replace(row, reason=f"{row.reason}; no Monte Carlo: {problem}")
    return replace(_drawn(row, found, camera[row.name]), monte_carlo=found)


def in_place_of_formulas(rows: Sequence[BudgetRow], known: Known, design: Trials, say: Callable[[str], None]) -> list[BudgetRow]:
    """Simulate what counts and has no contribution yet, each source in the camera's own chain, with few windows or some more.

    A source that the chain does not hold is put into it at its bound.
    """

    @cache
    def of_size(trials: int) -> Trials:
        return Trials(design.camera, design.target, design.estimator, design.facts, trials, FEW_UNITS, seed=design.seed)

    total_px = combine(r.contribution for r in rows if r.status in DECIDED and r.contribution is not None).total_px
    done = []
    for row in rows:
        lacks_one = row.contribution is None and row.monte_carlo is None  # what a calibration takes up stands in the row of the lens
        if lacks_one and row.status in ("measured", "modelled", "accepted") and not _needs_no_simulation(row):
            say(f"Monte Carlo: {row.name}")
            element = Element(row.name, catalogue_source(row), known.parameters_of(row))
            try:
                found = of_size(FEW).alone(element)
                if found.se_total_px > SMALL * np.hypot(total_px, found.total_px):
                    found = of_size(MORE).alone(element)
                row = _drawn(row, found, element)
            except InputError as problem:
                row = replace(row, reason=f"{row.reason}; no Monte Carlo: {problem}")
        done.append(row)
    return done


def _needs_no_simulation(row: BudgetRow) -> bool:
    """Whether a source cannot be put into a camera or left out of one, so that no simulation shows its effect."""
    source = catalogue_source(row)
    return source.forward is None or source.essential and source.ideal is None


def _drawn(row: BudgetRow, found: MonteCarlo, element: Element) -> BudgetRow:
    """The row with the result of a Monte Carlo as its contribution, if it has none."""
    if row.contribution is not None:
        return row
    contribution = found.contribution(element.source.gum_class)
    if contribution is None:
        return replace(row, reason="Monte Carlo: no target was found after this source")
    return replace(row, contribution=contribution, reason=row.reason if row.status == "accepted" else contribution.method)


def interaction_of(rows: Sequence[BudgetRow], design: Trials) -> Interaction:
    """All sources at once compared with each source alone, both by Monte Carlo."""
    alone = [r.monte_carlo for r in rows if r.monte_carlo is not None]
    square, varies = 0.0, 0.0  # biases add with their signs
    for axes in ([m.x for m in alone], [m.y for m in alone]):
        bias = sum(a.bias for a in axes)
        square += 0.5 * (sum(a.u**2 for a in axes) + bias**2)
        varies += 0.25 * sum((a.u * a.se_u) ** 2 + (bias * a.se_bias) ** 2 for a in axes)
    total = float(np.sqrt(square))
    error = float(np.sqrt(varies)) / total if total else 0.0
    drifting = [r.monte_carlo for r in rows if r.monte_carlo and r.contribution and r.contribution.gum_class in UNSTEADY]
    drifting = [m for m in drifting if np.isfinite(m.total_px)]  # one behind which no target was found says nothing
    of_axes = ([m.x for m in drifting], [m.y for m in drifting])
    x, y = (float(np.sqrt(sum(max(a.u**2 + a.bias**2 - a.left**2, 0.0) for a in axes))) for axes in of_axes)
    return Interaction(design.of(), total, error, (x, y))


# ---- order -------------------------------------------------------------------------------------------------------------------------


def rank_rows(rows: Sequence[BudgetRow], decided: Sequence[BudgetRow], verdict: Combined, everything: Combined) -> list[BudgetRow]:
    """Give each row its share and what is left without it, and put all in the order of `Budget.rows`.

    The share of a decided row is that of the square of the sum of all of these; that of an accepted one of the square of the total with
    everything accepted. Without a row, the total is less by its share.
    """
    whole2 = combine([r.part for r in decided]).total_px ** 2
    done = []
    for row in rows:
        if row.contribution is not None and row.status in (*DECIDED, "accepted"):
            known = row.status in DECIDED
            base2, total = (whole2, verdict.total_px) if known else (everything.total_px**2, everything.total_px)
            share = min(row.total_px**2 / base2, 1.0) if base2 else 0.0
            row = replace(row, share=share, without_px=total * float(np.sqrt(1 - share)))
        done.append(row)

    def place(row: BudgetRow) -> int:
        return 2 if not row.counts else 1 if row.status == "accepted" else 0

    return sorted(done, key=lambda r: (place(r), -r.total_px))
