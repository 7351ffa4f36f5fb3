"""The budget: every source's contribution to a target's position, ranked, combined, and checked by Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pixmetry.budget.advice import Advice, advise
from pixmetry.budget.combine import Combined, combine, together_with
from pixmetry.budget.headline import Headline, Interval, dof_of, headline, interval_of
from pixmetry.budget.monte_carlo import MonteCarlo, Trials, missed
from pixmetry.budget.parameters import applies, base_of, u_of_total, with_estimates
from pixmetry.budget.probe import ESTIMATOR_ITSELF, AnyEstimator, Facts, Probes, Target, facts_of, perfect, resolve
from pixmetry.camera.camera import Camera
from pixmetry.camera.catalogue import STAGES, catalogue
from pixmetry.camera.contribution import UNSTEADY, Contribution
from pixmetry.camera.observations import LENS, TAKEN_UP, CameraGeometry
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates
from pixmetry.locate.target_estimator import TargetEstimator

SCHEMA = "pixmetry/budget/1"
DECIDED = ("measured", "modelled", "calibrated")
FRAMES = (1, 4, 16, 64)


@dataclass(frozen=True)
class BudgetRow:
    """One source in the budget.

    Parameters
    ----------
    name, source_id, title : str
        Name in the camera's chain (or the source's id), and the source.
    status : {"measured", "modelled", "calibrated", "accepted", "not applicable", "left to calibration"}
        Its parameters were estimated in this campaign; it is known without (from the camera's description, or it has no parameters);
        positions are corrected for it by a calibration, and what that leaves counts; the campaign could not tell, and it is taken at the
        largest to expect of a sound camera; such a camera cannot have it; only a calibration with targets can tell.
    contribution : Contribution, optional
    u_of_total_px : float
        Uncertainty of the contribution's total that comes of its parameters' uncertainty.
    monte_carlo : MonteCarlo, optional
        The same by simulation.
    share : float
        Part of the square of the combined total that it belongs to (with everything accepted, for what is accepted).
    without_px : float
        Combined total if it were gone.
    reason : str
        Why there is no contribution, or how its status came about.
    in_camera : bool
        Whether it stands in the camera's chain, switched on.
    """

    name: str
    source_id: str
    title: str
    status: str
    contribution: Contribution | None = None
    u_of_total_px: float = 0.0
    monte_carlo: MonteCarlo | None = None
    share: float = 0.0
    without_px: float = 0.0
    reason: str = ""
    in_camera: bool = False

    @property
    def counts(self) -> bool:
        """Whether it is part of the verdict, or of that with everything accepted; the rows that do not count come last."""
        return self.status in (*DECIDED, "accepted") and self.total_px > 0

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of random part and bias."""
        return 0.0 if self.contribution is None else self.contribution.total_px

    @property
    def calibrated_px(self) -> float:
        """What of it stays once a calibration has taken up what is constant and what is smooth."""
        return 0.0 if self.contribution is None else self.contribution.calibrated_px


@dataclass(frozen=True)
class StageSum:
    """What the sources of one link of the chain come to together: those of the verdict, and what was accepted beside them.

    ``share`` is the stage's part of the square of the verdict's sum; those of all stages add up to 1.
    """

    stage: str
    total_px: float
    calibrated_px: float
    share: float
    accepted_px: float


@dataclass(frozen=True)
class Interaction:
    """Everything at once against the sum of everything alone (u as squares, biases as they are), both by Monte Carlo, in px.

    ``unsteady_px`` is, in x and y, the part of the sources that drift or belong to the object: the frames of a Monte Carlo hold it still.
    """

    together: MonteCarlo
    sum_px: float
    se_sum_px: float
    unsteady_px: tuple[float, float] = (0.0, 0.0)

    @property
    def calibrated_px(self) -> float:
        """What a calibration leaves of everything at once: all of what is unsteady, and of the rest what is neither constant nor smooth."""
        return float(np.sqrt(self.together.calibrated_px**2 + 0.5 * sum(v**2 for v in self.unsteady_px)))

    @property
    def difference_px(self) -> float:
        """What the sources do together beyond what they do alone."""
        return self.together.total_px - self.sum_px

    @property
    def se_px(self) -> float:
        """Standard error of the difference; the two are taken as independent."""
        return float(np.hypot(self.together.se_total_px, self.se_sum_px))


@dataclass(frozen=True)
class Budget:
    """All rows and what they come to.

    The rows come in one order for all who show them: what is measured, modelled or calibrated, largest first; then what was accepted,
    largest bound first; then what does not count (`BudgetRow.counts`). ``verdicts`` are for what is measured and modelled, for one frame
    and for means over several, by the sum of the contributions or by Monte Carlo as ``headline`` says; ``with_accepted`` adds everything
    that was accepted, at its bound. ``sums`` are always the analytic ones. ``interval`` is the verdict for one frame in the form of an
    answer, a coverage interval; ``stages`` says which links of the chain it is from, in the order of the light. Totals are k = 1, as the
    camera is and (``calibrated_px``) as a calibration leaves it.
    """

    camera: str
    target: Target
    estimator: AnyEstimator
    facts: Facts
    pitch_um: tuple[float, float] | None
    rows: tuple[BudgetRow, ...]
    verdicts: tuple[Combined, ...]
    with_accepted: tuple[Combined, ...]
    advice: tuple[Advice, ...]
    interaction: Interaction | None = None
    headline: Headline | None = None
    sums: tuple[Combined, ...] = ()
    interval: Interval | None = None

    @property
    def stages(self) -> tuple[StageSum, ...]:
        """Sums over each link of the chain that has a row that counts, in the order of the light."""
        found = []
        for stage in STAGES:
            rows = [r for r in self.rows if r.counts and r.source_id.split(".")[0] == stage]
            known, accepted = ([r for r in rows if (r.status == "accepted") == bound] for bound in (False, True))
            whole = combine([r.contribution for r in known], signed=True)
            at_bound = combine([r.contribution for r in accepted]).total_px
            if rows:
                found.append(StageSum(stage, whole.total_px, whole.calibrated_px, sum(r.share for r in known), at_bound))
        return tuple(found)

    @property
    def verdict(self) -> Combined:
        """One target in one frame, from what is measured and modelled."""
        return self.verdicts[0]

    def of_status(self, *status: str) -> tuple[BudgetRow, ...]:
        """The rows of a status, largest first."""
        return tuple(r for r in self.rows if r.status in status)

    @property
    def largest(self) -> tuple[BudgetRow, ...]:
        """What the verdict rests on, largest first."""
        return tuple(r for r in self.of_status(*DECIDED) if r.total_px > 0)

    @property
    def accepted(self) -> tuple[BudgetRow, ...]:
        """What was accepted and counts, largest bound first."""
        return tuple(r for r in self.of_status("accepted") if r.total_px > 0)

    def um(self, combined: Combined) -> tuple[float, float] | None:
        """Totals in x and y in µm on the sensor, if the pitch is known."""
        if self.pitch_um is None:
            return None
        return combined.total_x_px * self.pitch_um[0], combined.total_y_px * self.pitch_um[1]

    def to_record(self) -> dict[str, Any]:
        """Return a plain record for JSON; numbers that do not exist are None."""
        return {
            "schema": SCHEMA,
            "camera": self.camera,
            "target": asdict(self.target),
            "estimator": {"name": self.estimator.name} | asdict(self.estimator),
            "facts": asdict(self.facts),
            "pitch_um": None if self.pitch_um is None else list(self.pitch_um),
            "rows": [_row_record(r) for r in self.rows],
            "verdicts": [_combined_record(self, c) for c in self.verdicts],
            "with_accepted": [_combined_record(self, c) for c in self.with_accepted],
            "sums": [_combined_record(self, c) for c in self.sums],
            "headline": None if self.headline is None else _finite(asdict(self.headline)),
            "interval": None if self.interval is None else asdict(self.interval) | {"dof": [_or_none(v) for v in self.interval.dof]},
            "stages": [asdict(s) for s in self.stages],
            "advice": [asdict(a) for a in self.advice],
            "interaction": None
            if self.interaction is None
            else {
                "together": _monte_carlo_record(self.interaction.together),
                "sum_px": self.interaction.sum_px,
                "se_sum_px": self.interaction.se_sum_px,
                "difference_px": self.interaction.difference_px,
                "se_px": self.interaction.se_px,
                "calibrated_px": self.interaction.calibrated_px,
            },
        }


def compute_budget(
    camera: Camera,
    estimates_by_source: Mapping[str, Estimates] | None = None,
    known_facts: Mapping[str, Any] | None = None,
    target: Target | None = None,
    estimator: AnyEstimator | None = None,
    *,
    geometry: CameraGeometry | None = None,
    sensor_shape: tuple[int, int] | None = None,
    accepted: Collection[str] = (),
    frames: Sequence[int] = FRAMES,
    trials: int = 2048,
    units: int = 8,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Budget:
    """Budget of a target's position in one camera.

    Parameters
    ----------
    camera : Camera
        Its chain is what is known of it: a source in the chain counts as modelled with the parameters it has there.
    estimates_by_source : mapping of str to Estimates, optional
        By name in the chain or id of the source: what the campaign measured; it replaces parameters of the chain.
    known_facts : mapping, optional
        Fields of `Facts` that go before what the chain tells.
    target : Target, optional
        By default a disc of 7 px.
    estimator : Estimator or TargetEstimator, optional
        By default what `pixmetry.locate` takes for such a target: the template.
    geometry : CameraGeometry, optional
        Of a calibration with which positions are corrected: in place of the displacements that it takes up stands what it leaves.
    sensor_shape : (int, int), optional
        Rows and columns of the sensor, where the camera's frames are a window of it: what is accepted at its bound is taken for the whole.
    accepted : collection of str
        Names in the chain that are there without being known: taken at their bound.
    frames : sequence of int
        Numbers of frames to combine for; the first is the verdict's.
    trials, units, seed : int
        Of each Monte Carlo; ``trials=0`` leaves them out.
    progress : callable, optional
        Called with the name of what is being done.

    Returns
    -------
    Budget
    """
    target, estimator = target or Target(), estimator or TargetEstimator()
    estimates_by_source = dict(estimates_by_source or {})
    say = progress or (lambda text: None)
    say("camera")
    camera = _as_measured(camera, estimates_by_source)
    if geometry is not None:
        camera = camera.switched(off=[e.name for e in camera.active if e.source.id in TAKEN_UP])
    facts = facts_of(camera, target, known_facts)
    probes = Probes(camera, facts, target, estimator)
    rows = []
    measured_ids = [name for name, found in estimates_by_source.items() if len(found)]
    for name, source in _sources(camera):
        say(name)
        if geometry is not None and source.id in TAKEN_UP:
            rows.append(_calibrated(name, source, geometry))
        else:
            probe = probes.of(name, source)
            whole = probe if sensor_shape is None else replace(probe, frame_shape=sensor_shape)
            rows.append(_row(name, source, camera, estimates_by_source.get(name), name in accepted, probe, whole, measured_ids))
    interaction = design = None
    if trials:
        known = missed(camera, [r.name for r in rows if r.status == "accepted" and r.name in camera])  # what is accepted is no part of it
        design = Trials(known, target, estimator, facts, trials, units, seed=seed)
        rows = [_simulated(row, design, camera, say) for row in rows]
        say("all sources together")
        interaction = _interaction(rows, design)
    decided = [r for r in rows if r.status in DECIDED and r.contribution is not None]
    together, unsteady = (None, (0.0, 0.0)) if interaction is None else (interaction.together, interaction.unsteady_px)
    found, verdicts = headline(decided, together, frames, lambda name: design.of(off=[name]), unsteady)
    accepted_rows = [r.contribution for r in rows if r.status == "accepted" and r.contribution is not None]
    everything = tuple(together_with(v, combine(accepted_rows, frames=v.frames)) for v in verdicts)
    rows = _ranked(rows, decided, verdicts[0], everything[0])
    one = verdicts[0]
    interval = interval_of((one.total_x_px, one.total_y_px), dof_of(decided, one, found))
    return Budget(
        camera.name,
        target,
        resolve(estimator, target, facts),
        facts,
        camera.pitch_um,
        tuple(rows),
        verdicts,
        everything,
        advise(rows, verdicts[0], everything[0]),
        interaction,
        found,
        tuple(combine([r.contribution for r in decided], frames=n, signed=True) for n in frames),
        interval,
    )


CALIBRATED = "in front of the pixels: frames without targets do not carry it; a calibration with targets does"


def _sources(camera: Camera) -> list[tuple[str, Source]]:
    """What has a row: the chain, then what the catalogue has beyond it."""
    named = [(e.name, e.source) for e in camera.active]
    there = {source.id for _, source in named}
    return named + [(i, s) for i, s in catalogue().items() if i not in there]


def _as_measured(camera: Camera, estimates_by_source: dict[str, Estimates]) -> Camera:
    """Put the estimates into the chain; the mapping is keyed by name in the chain afterwards."""
    chain = []
    for element in camera.chain:
        estimates = estimates_by_source.get(element.name, estimates_by_source.get(element.source.id))
        if estimates is not None and len(estimates):
            estimates_by_source[element.name] = estimates
            element = replace(element, params=with_estimates(element.source, element.params, estimates))
        chain.append(element)
    return replace(camera, chain=tuple(chain))


def _row(
    name: str,
    source: Source,
    camera: Camera,
    estimates: Estimates | None,
    at_bound: bool,
    probe: Any,
    whole: Any,
    measured_ids: Collection[str] = (),
) -> BudgetRow:
    present = any(e.name == name for e in camera.active)
    head = BudgetRow(name, source.id, source.title, "", in_camera=present)
    if not applies(source, camera.facts):
        return replace(head, status="not applicable", reason=f"only in a camera that is {' or '.join(source.applies_to)}")
    measured = estimates is not None and len(estimates) > 0
    if source.option and not (present or measured):
        return replace(head, status="not applicable", reason=f"only in a camera with {source.option}")
    if source.stage == "storage" and camera.facts.get("lossless") and not (present or measured):
        return replace(head, status="not applicable", reason="only in frames that were stored with loss; these were not")
    if source.held_by and not (present or measured) and all(h in measured_ids for h in source.held_by):
        where = ", ".join(catalogue()[h].title for h in source.held_by)
        return replace(head, status="not applicable", reason=f"what of it is in these frames was measured, and counts, as: {where}")
    if Kind.LIGHT in source.consumes and not (present or measured):
        return replace(head, status="left to calibration", reason=CALIBRATED)
    if measured:
        status, params = "measured", base_of(source, camera, name)
        params = params if present else with_estimates(source, params, estimates)
        reason = estimates.method
    elif (present and not at_bound) or not source.parameters.model_fields:
        status, params, reason = "modelled", base_of(source, camera, name), "from the description of the camera" if present else ""
    else:
        status, params = "accepted", source.bound_of(whole.frame_shape)
        reason = source.reasons.get("measure", "not measured in this campaign")
    if source.propagate is None:
        return replace(head, status=status, reason=source.reasons["propagate"])
    contribution = source.propagate(params, whole if status == "accepted" else probe)
    u = u_of_total(source, params, estimates, probe) if measured else 0.0
    return replace(head, status=status, contribution=contribution, u_of_total_px=u, reason=reason)


def _calibrated(name: str, source: Source, geometry: CameraGeometry) -> BudgetRow:
    """What a calibration leaves, in the row of the lens; the other sources that it takes up are in there."""
    head = BudgetRow(name, source.id, source.title, "calibrated")
    if source.id != LENS:
        return replace(head, reason=f"taken up by the {geometry.origin}; what is left stands in the row of {catalogue()[LENS].title}")
    u_x, u_y = np.hypot(geometry.u_x_px, geometry.left_x_px), np.hypot(geometry.u_y_px, geometry.left_y_px)
    method = f"what the {geometry.origin} leaves: the uncertainty of a corrected place over the frame, and systematic residuals"
    # no further calibration takes it up: nothing of it counts as smooth
    found = Contribution(float(u_x), float(u_y), "G", model_error=0.2, method=method, smooth_px=(0.0, 0.0))
    return replace(head, contribution=found, reason=method)


def _simulated(row: BudgetRow, design: Trials, camera: Camera, say: Callable[[str], None]) -> BudgetRow:
    """Add the Monte Carlo to a row that the chain can simulate with its parameters; without a propagator it is the contribution."""
    if row.status not in DECIDED:
        return row
    if row.source_id == ESTIMATOR_ITSELF:
        return replace(row, monte_carlo=design.compare([row.name], perfect(camera), None))
    if row.name not in camera or not camera[row.name].on or camera[row.name].source.essential and row.contribution is None:
        return row
    say(f"Monte Carlo: {row.name}")
    try:
        found = design.of(only=[row.name])
    except InputError as problem:
        return replace(row, reason=f"{row.reason}; no Monte Carlo: {problem}")
    if row.contribution is not None:
        return replace(row, monte_carlo=found)
    contribution = found.contribution(camera[row.name].source.gum_class)
    if contribution is None:
        return replace(row, monte_carlo=found, reason="Monte Carlo: no target was found behind it")
    return replace(row, monte_carlo=found, contribution=contribution, reason=contribution.method)


def _interaction(rows: Sequence[BudgetRow], design: Trials) -> Interaction:
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


def _ranked(rows: Sequence[BudgetRow], decided: Sequence[BudgetRow], verdict: Combined, everything: Combined) -> list[BudgetRow]:
    """Give each row its share and what is left without it, and put all in the order of `Budget.rows`.

    The share of a decided row is that of the square of the sum of all of these; that of an accepted one of the square of the total with
    everything accepted. Without a row, the total is less by its share.
    """
    whole2 = combine([r.contribution for r in decided]).total_px ** 2
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


def _row_record(row: BudgetRow) -> dict[str, Any]:
    names: tuple[str, ...] = ("name", "source_id", "title", "status", "u_of_total_px", "share", "without_px", "reason")
    names += ("in_camera", "counts", "total_px", "calibrated_px")
    record = {k: getattr(row, k) for k in names}
    c = row.contribution
    parts = {} if c is None else {k: list(getattr(c, k)) for k in ("time_px", "smooth_px", "place_px")}
    record["contribution"] = None if c is None else asdict(c) | parts
    record["monte_carlo"] = None if row.monte_carlo is None else _monte_carlo_record(row.monte_carlo)
    return record


def _monte_carlo_record(result: MonteCarlo) -> dict[str, Any]:
    totals = {k: getattr(result, k) for k in ("total_px", "se_total_px", "calibrated_px", "se_calibrated_px")}
    record = asdict(result) | totals | {"names": list(result.names)}
    for axis in ("x", "y"):
        record[axis] = {k: (v if np.isfinite(v) else None) for k, v in record[axis].items()}
    return _finite(record)


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    return {k: (None if isinstance(v, float) and not np.isfinite(v) else v) for k, v in record.items()}


def _combined_record(budget: Budget, combined: Combined) -> dict[str, Any]:
    um = budget.um(combined)
    totals = {"total_px": combined.total_px, "calibrated_px": combined.calibrated_px}
    return asdict(combined) | totals | {"total_um": None if um is None else list(um)}
