"""The budget: every source's contribution to a target's position, ranked, combined, and checked by Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pixmetry.budget.advice import advise
from pixmetry.budget.answer import with_shares
from pixmetry.budget.calibration_noise import calibration_row
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.cameras import camera_of
from pixmetry.budget.combine import combine, together_with
from pixmetry.budget.headline import dof_of, headline, interval_of
from pixmetry.budget.measured_calibration import as_calibrated, measured_calibration, with_lens
from pixmetry.budget.monte_carlo import Trials
from pixmetry.budget.probe import Probes, Target, facts_of, resolve
from pixmetry.budget.records import DECIDED, Budget, BudgetRow, Interaction
from pixmetry.budget.rows import (
    Known,
    as_measured,
    beside_formula,
    in_place_of_formulas,
    interaction_of,
    rank_rows,
    rows_by_formula,
    without_accepted,
)
from pixmetry.budget.scenario import Scenario, read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import Table
from pixmetry.calibrate.files.record import StoredCalibration
from pixmetry.calibrate.records import Calibration
from pixmetry.camera.camera import Camera
from pixmetry.camera.observations import TAKEN_UP, CameraGeometry
from pixmetry.core.arguments import typed
from pixmetry.core.number import Estimates
from pixmetry.locate.estimator import Estimator
from pixmetry.locate.target_estimator import TargetEstimator

FRAMES = (1, 4, 16, 64)


def compute_budget(
    camera: Camera,
    estimates_by_source: Mapping[str, Estimates] | None = None,
    known_facts: Mapping[str, Any] | None = None,
    target: Target | None = None,
    estimator: Estimator | None = None,
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
    estimator : Estimator, optional
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
        Of each Monte Carlo; ``trials=0`` leaves out those beside a formula and that of all sources at once. A source without a formula is
        simulated in any case, with 256 windows, or 1024 where those leave open more than 5 % of the total.
    progress : callable, optional
        Called with the name of what is being done.

    Returns
    -------
    Budget

    Examples
    --------
    >>> from dataclasses import replace
    >>> from pixmetry.budget import compute_budget
    >>> from pixmetry.camera.camera import load_camera
    >>> camera = replace(load_camera("dcs420_like"), frame_shape=(96, 128))
    >>> budget = compute_budget(camera, trials=0)
    >>> budget.rows[0].counts, budget.headline.by
    (True, 'sum')
    >>> bool(budget.interval.half_px[0] > budget.verdict.total_x_px > 0)
    True
    >>> round(sum(stage.share for stage in budget.stages), 6)
    1.0
    """
    target, estimator = target or Target(), estimator or TargetEstimator()
    estimates = dict(estimates_by_source or {})
    say = progress or (lambda text: None)
    say("camera")
    camera = as_measured(camera, estimates)
    if geometry is not None:
        camera = camera.switched(off=[e.name for e in camera.active if e.source.id in TAKEN_UP])
    facts = facts_of(camera, target, known_facts)
    known = Known(camera, estimates, accepted, geometry, sensor_shape or camera.frame_shape)
    rows = list(rows_by_formula(known, Probes(camera, facts, target, estimator), say))
    design = Trials(without_accepted(rows, camera), target, estimator, facts, trials or 1, units, seed=seed)
    interaction = None
    if trials:
        rows = [beside_formula(row, design, say) for row in rows]
    rows = in_place_of_formulas(rows, known, design, say)
    if trials:
        say("all sources together")
        interaction = interaction_of(rows, design)
    decided = [r for r in rows if r.status in DECIDED and r.contribution is not None]
    bounds = [r.contribution for r in rows if r.status == "accepted" and r.contribution is not None]
    together, unsteady_px = (None, (0.0, 0.0)) if interaction is None else (interaction.together, interaction.unsteady_px)
    found, verdicts = headline(decided, together, frames, lambda name: design.of(off=[name]), unsteady_px)
    everything = tuple(together_with(v, combine(bounds, frames=v.frames)) for v in verdicts)
    rows, one = rank_rows(rows, decided, verdicts[0], everything[0]), verdicts[0]
    return Budget(
        camera=camera.name,
        target=target,
        estimator=resolve(estimator, target, facts),
        facts=facts,
        pitch_um=camera.pitch_um,
        rows=tuple(rows),
        verdicts=verdicts,
        with_accepted=everything,
        advice=advise(rows, one, everything[0]),
        interaction=interaction,
        headline=found,
        sums=tuple(combine([r.part for r in decided], frames=n, signed=True) for n in frames),
        interval=interval_of((one.total_x_px, one.total_y_px), dof_of(decided, one, found)),
    )


@typed
def budget(
    camera: str | Path | Camera | Sequence[str | Path | Camera],
    scenario: str | Path | Mapping[str, Any] | Scenario | None = None,
    *,
    calibration: str | Path | StoredCalibration | Calibration | None = None,
    estimator: Estimator | str | None = None,
    trials: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> CameraBudget:
    """Budget every error source of a camera for a measurement, on paper: before and after calibration.

    Parameters
    ----------
    camera : path, name of a preset, Camera, or several
        A preset, a camera file, a data sheet, the ``camera.yaml`` of an assessment, the result of a test by EMVA 1288; of several, what
        was measured replaces what a sheet says, and both are compared.
    scenario : path, mapping or Scenario, optional
        What is measured and how, schema ``pixmetry/scenario/1``; whatever it leaves open has a default.
    calibration : path, StoredCalibration or Calibration, optional
        A ``calibration.json`` of `pixmetry.calibrate` or its folder, or what that returned: its lens takes the place of the camera's, the
        scenario takes over what was calibrated, and the covariance of its parameters is the calibration's noise.
    estimator : Estimator or str, optional
        By default what `pixmetry.locate` takes for such a target.
    trials : int
        Windows of a Monte Carlo with all sources of the chain at once; 0 for none.
    seed : int
    progress : callable, optional
        Called with the name of what is being done.

    Returns
    -------
    CameraBudget

    Raises
    ------
    InputError
        If camera, scenario or calibration cannot be used, the calibration is of a sensor of another format, or the target is not seen.

    Examples
    --------
    >>> import pixmetry
    >>> found = pixmetry.budget("imx264_like", {"calibration": {"model": "lens"}})
    >>> found.one.after_px[0] < found.one.before_px[0]
    True
    """
    known, disagreements = camera_of(camera)
    asked, made = read_scenario(scenario), None
    if calibration is not None:
        made = measured_calibration(calibration, known)
        known, made = with_lens(known, calibration, made)
        asked = as_calibrated(asked, made)
    setting = Setting(known, asked, made)
    setting.check()  # before the work
    law = TargetEstimator(estimator) if isinstance(estimator, str) else estimator or TargetEstimator()
    table = Table(setting, law, seed, progress or (lambda text: None))
    rows = table.rows()
    rows = with_shares([*rows, calibration_row(rows, setting)])
    together = None
    if trials:
        together = Trials(setting.camera, setting.target, law, setting.facts, trials, seed=seed).of()
    return CameraBudget(setting, resolve(law, setting.target, setting.facts), tuple(rows), disagreements, together)


__all__ = ["DECIDED", "Budget", "BudgetRow", "Interaction", "budget", "compute_budget"]
