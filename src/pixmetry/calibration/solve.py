"""Calibrating cameras from image coordinates: from start values to an adjustment that stands, and what must be said about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from pixmetry.calibration.eccentric import Eccentricity, eccentricity, without_eccentricity
from pixmetry.calibration.model import NAMES
from pixmetry.calibration.network import Adjustment, Calibration, Finding, Network, State
from pixmetry.core.errors import InputError, MeasureError, ParameterError

Progress = Callable[[str], None]
FEW = ("c", "k1")  # estimated first where start values are rough
LOOPS = 12  # of gross errors, weights and eccentricity
CLOSE_PX = 1e-4  # an eccentricity that moves by less has converged
ALIKE = 1.3  # weights that change by less, x against y or camera against camera, need no new search for gross errors
CHOICES = {
    "field": ("auto", "fixed", "free"),
    "loss": ("none", "huber", "cauchy"),
    "target": ("circle", "square"),
}
PER_IMAGE_NAMES = ("x_scale", "x_shift")


@dataclass(frozen=True)
class Options:
    """How a calibration is done. Which interior parameters are estimated stands in the cameras of the network.

    Parameters
    ----------
    field : {"auto", "fixed", "free"}
        What becomes of the known coordinates of a test field that are said to be exact. ``"free"`` estimates them, with the known ones as
        start values and datum; ``"auto"`` does so where images left out of the fit show that it is better.
    loss : {"huber", "cauchy", "none"}
        Of the first pass, before gross errors are found.
    loss_scale : float
        Standard deviations beyond which this loss holds an observation down.
    snoop : bool
        Look for gross errors.
    false_alarms : float
        Number of good image points that may be expected to be rejected in one adjustment, above 0.
    variance_components : bool
        Estimate the standard deviations of x and of y of each camera, and weigh by them.
    eccentricity : bool
        Correct the images of targets whose size is known.
    target : {"circle", "square"}
        Their shape; the ``diameter`` of a square is its side.
    per_image : tuple of str, optional
        Out of ``"x_scale"`` and ``"x_shift"``; None keeps what the network says.
    folds : int
        Of the images, for the test with images left out of the fit; 0: no such test.
    residual_grid : bool
        Make a correction grid of what the parameters leave over.
    a_priori : bool
        Take the covariance of the image coordinates as true: do not scale uncertainties by sigma0.
    max_iterations : int
        Of one adjustment.

    Raises
    ------
    ParameterError
        If an option cannot be used.
    """

    field: Literal["auto", "fixed", "free"] = "auto"
    loss: Literal["huber", "cauchy", "none"] = "huber"
    loss_scale: float = 2.5
    snoop: bool = True
    false_alarms: float = 0.01
    variance_components: bool = True
    eccentricity: bool = True
    target: Literal["circle", "square"] = "circle"
    per_image: tuple[str, ...] | None = None
    folds: int = 5
    residual_grid: bool = False
    a_priori: bool = False
    max_iterations: int = 50

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ParameterError("no such choice", where=name, value=getattr(self, name), allowed=", ".join(allowed))
        if not set(self.per_image or ()) <= set(PER_IMAGE_NAMES):
            allowed = ", ".join(PER_IMAGE_NAMES)
            raise ParameterError("no such parameter of an image", where="per_image", value=self.per_image, allowed=allowed)
        if not self.loss_scale > 0:
            raise ParameterError("not a scale of a loss", where="loss_scale", value=self.loss_scale, allowed="above 0")
        if not 0 < self.false_alarms < 100:
            raise ParameterError("not a number of false alarms", where="false_alarms", value=self.false_alarms, allowed="0 … 100")
        if self.folds == 1 or self.folds < 0:
            raise ParameterError("not a number of folds", where="folds", value=self.folds, allowed="0, or 2 and more")


@dataclass(frozen=True)
class Settled:
    """A network whose gross errors, weights and eccentricities do not change any more.

    Parameters
    ----------
    measured : Network
        With its weights; its image coordinates are those measured, without correction.
    adjustment : Adjustment
        Of the corrected image coordinates.
    shift : Eccentricity
    factor : ndarray, shape (cameras, 2)
        By which the variances of x and y have been multiplied.
    components : dict
        Records of the variance components; empty if they were not estimated.
    gross_known : dict
        Bars and control points that were left out.
    """

    measured: Network
    adjustment: Adjustment
    shift: Eccentricity
    factor: np.ndarray
    components: dict[str, Any]
    gross_known: dict[str, Any]


def calibrate_network(
    network: Network, options: Options = Options(), start: State | None = None, progress: Progress | None = None
) -> Calibration:
    """Estimate cameras, poses and points of a network, and test the result.

    Parameters
    ----------
    network : Network
    options : Options
    start : State, optional
        Start values; by default they are found.
    progress : callable, optional
        Called with a few words before each step.

    Returns
    -------
    Calibration
        The image coordinates in the network of its adjustment are those of the targets' centres: without the eccentricity.

    Raises
    ------
    InputError
        If what was given cannot be a network.
    MeasureError
        If the network does not determine what was asked for.
    """
    from pixmetry.calibration.checks import check_network
    from pixmetry.calibration.findings import in_order
    from pixmetry.calibration.residual_grid import residual_grids

    say = progress or (lambda text: None)
    measured = _as_asked(network, options)
    say("checking the network")
    findings = list(check_network(measured))
    measured, state = _started(measured, start, options, say)
    settled = _settled(_released(measured) if options.field == "free" else measured, state, options, say)
    settled, tests, more = _checked_field(settled, options, say)
    say("testing the result")
    tests |= _records(settled, options)
    if options.residual_grid:
        tests["residual_grid"] = residual_grids(settled.adjustment)
    findings += [*more, *_findings(settled, tests)]
    grids = tests.get("residual_grid", {})
    return Calibration(settled.adjustment, in_order(findings), tests, grids, {"options": asdict(options)})


def _as_asked(network: Network, options: Options) -> Network:
    return network if options.per_image is None else replace(network, per_image=tuple(n for n in PER_IMAGE_NAMES if n in options.per_image))


def _adjust(options: Options) -> Callable[..., Adjustment]:
    from pixmetry.calibration.bundle import adjust

    return partial(adjust, max_iterations=options.max_iterations, a_priori=options.a_priori)


def _started(network: Network, start: State | None, options: Options, say: Progress) -> tuple[Network, State]:
    """Start values; where they had to be found, improved with few interior parameters and none of the images' own."""
    from pixmetry.calibration.initial import start_values

    if start is not None:
        return network, start
    say("finding start values")
    network, state = start_values(network)
    few = [replace(camera, free=camera.free & np.isin(NAMES, FEW)) for camera in network.cameras]
    loss = "huber" if options.loss == "none" and options.snoop else options.loss
    try:
        part = replace(network, cameras=tuple(few), per_image=())
        return network, _adjust(options)(part, state, loss=loss, loss_scale=options.loss_scale, covariance=False).state
    except MeasureError:
        return network, state  # the adjustment of all parameters says what is not determined


def _released(network: Network) -> Network:
    """The network with its fixed points free; their coordinates stay as start values and datum."""
    fixed = (network.u_xyz == 0).all(axis=1)
    return replace(network, u_xyz=np.where(fixed[:, None], np.inf, network.u_xyz))


def _settled(measured: Network, state: State, options: Options, say: Progress, used: np.ndarray | None = None) -> Settled:
    """Repeat the search for gross errors, the variance components and the eccentricity until none of them changes anything."""
    loss = options.loss if used is None else "none"
    used = np.ones(len(measured), bool) if used is None else used
    shift, factor = _shift(measured, state, options), np.ones((len(measured.cameras), 2))
    measured, state, used, loss, gross_known = _checked_known(measured, shift, state, used, loss, options, say)
    for loop in range(1, LOOPS + 1):
        say(f"adjusting, round {loop}")
        adjustment = _without_gross_errors(without_eccentricity(measured, shift), state, used, loss, options)
        adjustment, step, components = _weighted(adjustment, options)
        measured, factor = replace(measured, covariance_px2=adjustment.network.covariance_px2), factor * step
        again = _shift(measured, adjustment.state, options)
        moved = float(np.abs(again.shift_px - shift.shift_px).max(initial=0.0))
        still = (adjustment.used == used).all() and moved < CLOSE_PX and step.max() < ALIKE * step.min()
        used, state, loss = adjustment.used, adjustment.state, "none"
        if still:
            break
        shift = again
    return Settled(measured, adjustment, shift, factor, components, gross_known)


def _checked_known(
    measured: Network, shift: Eccentricity, state: State, used: np.ndarray, loss: str, options: Options, say: Progress
) -> tuple[Network, State, np.ndarray, str, dict[str, Any]]:
    """The network without bars and control points that it contradicts, and what its image points without them are worth."""
    from pixmetry.calibration.known_checks import CheckedKnown, check_known, has_known, loosened

    if not (options.snoop and has_known(measured)):
        return measured, state, used, loss, CheckedKnown(measured).gross
    say("testing scale bars and control points")
    try:
        clean = _without_gross_errors(without_eccentricity(loosened(measured), shift), state, used, loss, replace(options, a_priori=False))
    except MeasureError:  # the network hangs on them
        return measured, state, used, loss, CheckedKnown(measured).gross
    checked = check_known(without_eccentricity(measured, shift), clean, _adjust(replace(options, a_priori=False)))
    measured = replace(measured, bars=checked.network.bars, u_xyz=checked.network.u_xyz)
    return measured, clean.state, clean.used, "none", checked.gross


def _shift(measured: Network, state: State, options: Options) -> Eccentricity:
    return eccentricity(measured if options.eccentricity else replace(measured, diameter=None), state, options.target)


def _without_gross_errors(network: Network, state: State, used: np.ndarray, loss: str, options: Options) -> Adjustment:
    from pixmetry.calibration.snooping import remove_gross_errors

    adjust = _adjust(options)
    if not options.snoop:
        return adjust(network, state, used=used, redundancy=True)
    return remove_gross_errors(
        network, state, adjust, used=used, loss=loss, loss_scale=options.loss_scale, false_alarms=options.false_alarms
    ).adjustment


def _weighted(adjustment: Adjustment, options: Options) -> tuple[Adjustment, np.ndarray, dict[str, Any]]:
    """The adjustment with estimated weights; if they are not asked for, a guessed covariance still gets its size, for bars beside it."""
    from pixmetry.calibration.variance_components import estimate_components

    one = np.ones((len(adjustment.network.cameras), 2))
    if not options.variance_components and adjustment.network.covariance_known:
        return adjustment, one, {}
    found = estimate_components(adjustment, _adjust(options), by_axis=options.variance_components)
    return found.adjustment, found.factor, found.records() if options.variance_components else {}


def _checked_field(settled: Settled, options: Options, say: Progress) -> tuple[Settled, dict[str, Any], list[Finding]]:
    """Fixed points against free ones, with images left out of the fit; without fixed points to test, only images left out."""
    from pixmetry.calibration.field_check import check_field

    if options.folds == 0:
        return settled, {}, []
    say("leaving images out of the fit")
    fixed = (settled.measured.u_xyz == 0).all(axis=1).sum()
    if options.field != "auto" or fixed < 4:
        return settled, _held_out(settled, options), []
    check = check_field(settled.adjustment, options.folds)
    tests = {"field": check.field, **({"hold_out": check.hold_out} if check.hold_out else {})}
    if check.verdict == "free":
        say("adjusting with the points of the field free")
        again = _settled(_released(settled.measured), check.adjustment.state, options, say, check.adjustment.used)
        gross = {kind: [*settled.gross_known[kind], *again.gross_known[kind]] for kind in again.gross_known}
        settled = replace(again, factor=settled.factor * again.factor, gross_known=gross)
    return settled, tests, list(check.findings)


def _held_out(settled: Settled, options: Options) -> dict[str, Any]:
    from pixmetry.calibration.hold_out import hold_out_record, left_out

    try:
        held = left_out(settled.adjustment, options.folds)
    except (InputError, MeasureError):
        return {}  # too few images to leave some out
    free = not (settled.measured.u_xyz == 0).any()
    return {"hold_out": hold_out_record(None, held) if free else hold_out_record(held)}


def _records(settled: Settled, options: Options) -> dict[str, Any]:
    from pixmetry.calibration.records import all_records

    tests = all_records(
        settled.adjustment, options.false_alarms / len(settled.measured), settled.gross_known, a_priori=options.a_priori
    )
    if settled.components:
        tests["variance_components"] = settled.components
    if settled.shift.corrected.any() or settled.shift.possible_px:
        tests["eccentricity"] = {
            "corrected": int(settled.shift.corrected.sum()),
            "largest_px": settled.shift.largest_px,
            "possible_px": settled.shift.possible_px,
        }
    return tests


def _findings(settled: Settled, tests: dict[str, Any]) -> list[Finding]:
    from pixmetry.calibration.checks import check_determined
    from pixmetry.calibration.findings import eccentricity_findings, findings_of, hold_out_findings
    from pixmetry.calibration.patterns import pattern_findings

    adjustment = settled.adjustment
    found = [*check_determined(adjustment), *pattern_findings(tests["patterns"]), *findings_of(adjustment, tests)]
    found += eccentricity_findings(settled.measured, settled.shift)
    return found + hold_out_findings(tests.get("hold_out", {}))
