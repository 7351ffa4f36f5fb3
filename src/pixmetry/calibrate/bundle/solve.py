"""Calibrating cameras from image coordinates: from start values to an adjustment that stands, and what must be said about it."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES, Adjustment, Network, State
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.bundle.rig import largest_turn, rig_of
from pixmetry.calibrate.bundle.settling import Progress, Settled, adjust_with, settle
from pixmetry.calibrate.checks.hold_out import LeftOut
from pixmetry.calibrate.records import Calibration, EccentricityRecord, FieldTest, HoldOut, Tests
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding
from pixmetry.core.threads import single_threaded_blas

__all__ = ["Options", "calibrate_network"]
DEFAULTS = Options()
FEW = ("c", "k1")  # estimated first where start values are rough
UNTESTED_FIELD = "a test field that is not as it is said to be, which was not tested (options: folds, field)"
LEAST_TURN_DEG = 2.0  # of an image against its rig, from which the rig is why there is no result
SIZED = 1.25  # by which lengths may differ from those of the start poses where these gave the size


@single_threaded_blas()
def calibrate_network(
    network: Network, options: Options = DEFAULTS, start: State | None = None, progress: Progress | None = None
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
    from pixmetry.calibrate.bundle.shared_errors import with_shared_errors
    from pixmetry.calibrate.checks.checks import check_network
    from pixmetry.calibrate.checks.findings import in_order
    from pixmetry.calibrate.checks.parts import halves_of, jackknife_of
    from pixmetry.calibrate.checks.residual_grid import residual_grids
    from pixmetry.calibrate.start.posed_start import pose_findings

    say = progress or (lambda text: None)
    measured = _as_asked(network, options)
    say("checking the network")
    findings = list(check_network(measured))
    settled = _of_rig(measured, start, options, say)
    settled, field, held, left, more = _checked_field(settled, options, say)
    say("testing the result")
    stated = with_shared_errors(settled.adjustment, a_priori=options.a_priori) if options.shared_errors else settled.adjustment
    tests = replace(_tests(settled, stated, network, options), field=field, hold_out=_with_expected(held, settled))
    if options.folds:
        tests = replace(tests, halves=halves_of(stated) or None, jackknife=jackknife_of(stated, left) if left is not None else None)
    if field is None and options.field != "fixed" and not _is_free(settled.measured):
        tests = _without_claims(tests)
    if options.residual_grid:
        tests = replace(tests, residual_grid=residual_grids(settled.adjustment))
    findings += [*more, *_findings(settled, tests)]
    findings += _no_scale(network, settled.adjustment) + pose_findings(network, settled.adjustment.state)
    return Calibration(stated, in_order(findings), tests, tests.residual_grid or {}, {"options": asdict(options)}, network)


def _no_scale(network: Network, adjustment: Adjustment) -> list[Finding]:
    """That nothing, or nothing but the start poses, says how large the object is."""
    from pixmetry.calibrate.bundle.datum import scale_is_open
    from pixmetry.calibrate.start.posed_start import to_their_frame

    if network.given.sum() >= 3 or not scale_is_open(adjustment):
        return []
    found = to_their_frame(network, adjustment.state)
    text = f"the scale of the object is not known: the unit of length is the mean distance between the images, not {network.unit}"
    if found is not None and 1 / SIZED < found[0] < SIZED:
        text = "only the start poses give the scale of the object: lengths are only as accurate as these"
    elif np.isfinite(network.u_xyz).any():
        text = f"the known coordinates do not give the scale of the object: lengths are not in {network.unit}"
    return [Finding("no_scale", text, "give a scale bar, or the coordinates of two points", "warning")]


def _of_rig(network: Network, start: State | None, options: Options, say: Progress) -> Settled:
    """A settled adjustment; where cameras that stand still against each other are why there is none, say so."""
    try:
        return _from_start(network, start, options, say)
    except MeasureError as error:
        if network.instant is None:
            raise
        say("adjusting each image with a pose of its own")
        try:
            alone = _from_start(replace(network, instant=None), start, options, say).adjustment.state
        except MeasureError:
            raise error from None  # the reason is another
        rig = rig_of(network, alone.posed)
        if rig is None:
            raise
        turn_deg, image = largest_turn(rig, alone)
        if turn_deg < LEAST_TURN_DEG:
            raise
    what = (
        "the images fit when each has a pose of its own, but not cameras that stand still against each other: "
        f"{network.images[image]} is turned by {turn_deg:.0f}° against its rig"
    )
    remedy = (
        "check which images were taken at the same instant; a board that looks the same after half a turn must be numbered alike in all "
        "cameras: use one with a mark"
    )
    raise MeasureError(what, where="rig", remedy=remedy)


def _from_start(network: Network, start: State | None, options: Options, say: Progress) -> Settled:
    """A settled adjustment; where poses that were given lead nowhere, without them."""
    try:
        measured, state = _started(network, start, options, say)
        measured = replace(measured, poses=None)  # they have done their part
        return _settled(_released(measured) if options.field == "free" else measured, state, options, say)
    except MeasureError as error:
        if start is not None or network.poses is None:
            raise
        say("starting again without the poses")
        try:
            return _from_start(replace(network, poses=None), None, options, say)
        except MeasureError:
            if error.where == "start values":
                error.remedy += (
                    "; the start poses do not fit either: check the viewing direction of the camera and the sense of the rotations"
                )
            raise error from None


def _as_asked(network: Network, options: Options) -> Network:
    return network if options.per_image is None else replace(network, per_image=tuple(n for n in PER_IMAGE_NAMES if n in options.per_image))


def _started(network: Network, start: State | None, options: Options, say: Progress) -> tuple[Network, State]:
    """Start values; where they had to be found, improved with few interior parameters and none of the images' own."""
    from pixmetry.calibrate.checks.known_checks import without_absurd_control
    from pixmetry.calibrate.start.initial import start_values
    from pixmetry.calibrate.start.posed_start import in_their_frame

    if start is not None:
        return network, start
    say("finding start values")
    given = network.cameras
    network, state = start_values(network)
    if all(_has_lens(camera, row) for camera, row in zip(given, state.interior, strict=True)):
        return network, in_their_frame(network, state)
    few = [replace(camera, free=camera.free & np.isin(NAMES, FEW)) for camera in network.cameras]
    loss = "huber" if options.loss == "none" and options.snoop else options.loss
    try:
        part = replace(without_absurd_control(network, state)[0], cameras=tuple(few), per_image=())
        state = adjust_with(options)(part, state, loss=loss, loss_scale=options.loss_scale, covariance=False).state
    except MeasureError:
        pass  # the adjustment of all parameters says what is not determined
    return network, in_their_frame(network, state)


def _has_lens(camera: CameraModel, found: Array) -> bool:
    """Whether start values hold a lens that was estimated on the way to them."""
    return bool((found != camera.values)[NAMES.index("k1") :].any())


def _released(network: Network) -> Network:
    """The network with its fixed coordinates free; they stay as start values and datum."""
    return replace(network, u_xyz=np.where(network.u_xyz == 0, np.inf, network.u_xyz))


def _settled(measured: Network, state: State, options: Options, say: Progress) -> Settled:
    """`settle`; where x-shifts of images are why there is no result, say so."""
    from pixmetry.calibrate.bundle.bundle import adjust

    try:
        return settle(measured, state, options, say)
    except MeasureError:
        if "x_shift" not in measured.per_image:
            raise
        rest = replace(measured, per_image=tuple(name for name in measured.per_image if name != "x_shift"))
        adjust(rest, state, loss="huber")  # raises where the reason is another
    image = _least_tilted(measured, state)
    what = "the x-shifts of the images cannot be separated from the poses of the cameras"
    where = f"x_shift of image {image}" if image else "x_shift"
    remedy = "leave x_shift out of per_image (x_scale may stay), or use only tilted images of a test field with depth"
    raise MeasureError(what, where=where, remedy=remedy) from None


def _least_tilted(network: Network, state: State) -> str:
    """Name of the image that looks most nearly across a flat field; empty if the field has depth."""
    from pixmetry.calibrate.bundle.eccentric import normals

    normal = normals(replace(network, normal=None), state)[0]
    if not np.isfinite(normal).all():
        return ""
    return network.images[int(np.nanargmax(np.abs(state.rotation[:, 2] @ normal)))]


def _checked_field(
    settled: Settled, options: Options, say: Progress
) -> tuple[Settled, FieldTest | None, HoldOut | None, LeftOut | None, tuple[Finding, ...]]:
    """Fixed points against free ones, with images left out of the fit; without fixed points to test, only images left out."""
    from pixmetry.calibrate.checks.field_check import LEAST_FIELD, check_field

    if options.folds == 0:
        return settled, None, None, None, ()
    say("leaving images out of the fit")
    fixed = (settled.measured.u_xyz == 0).any(axis=1).sum()
    if options.field != "auto" or fixed < LEAST_FIELD:
        return settled, None, *_held_out(settled, options), ()
    check = check_field(settled.adjustment, options.folds)
    if check.verdict == "free":
        say("adjusting with the points of the field free")
        before = replace(settled, adjustment=check.adjustment)
        again = settle(_released(settled.measured), check.adjustment.state, options, say, before)
        settled = replace(again, known_faults=settled.known_faults + again.known_faults)
    return settled, check.field, check.hold_out, check.left, check.findings


def _held_out(settled: Settled, options: Options) -> tuple[HoldOut | None, LeftOut | None]:
    from pixmetry.calibrate.checks.hold_out import hold_out_record, left_out

    try:
        held = left_out(settled.adjustment, options.folds)
    except (InputError, MeasureError):
        return None, None  # too few images to leave some out
    return hold_out_record(None, held) if _is_free(settled.measured) else hold_out_record(held), held


def _with_expected(record: HoldOut | None, settled: Settled) -> HoldOut | None:
    """The record of images left out; where these fit much worse, with what noise alone would show."""
    from pixmetry.calibrate.checks.hold_out import WORSE, expected_median_px

    one = None if record is None else record.free if _is_free(settled.measured) else record.fixed
    if record is None or one is None or one.left_out_rms_px < WORSE * one.fit_rms_px:
        return record
    try:
        return replace(record, expected_median_px=expected_median_px(settled.adjustment, record.folds))
    except MeasureError:  # hardly determined without these images: noise may do anything
        return record


def _is_free(network: Network) -> bool:
    return not (network.u_xyz == 0).any()


def _tests(settled: Settled, stated: Adjustment, given: Network, options: Options) -> Tests:
    from pixmetry.calibrate.checks.tests import tests_of

    alpha, shift = options.false_alarms / len(settled.measured), settled.shift
    tests = tests_of(
        settled.adjustment, given, alpha, settled.known_faults, settled.rejected, stated=stated,
        a_priori=options.a_priori, patterns=options.patterns,
    )  # fmt: skip
    if shift.corrected.any() or shift.possible_px:
        tests = replace(tests, eccentricity=EccentricityRecord(int(shift.corrected.sum()), shift.largest_px, shift.possible_px))
    return replace(tests, variance_components=settled.components or None)


def _without_claims(tests: Tests) -> Tests:
    """The tests with no error source named by the residuals: a field that was taken as exact, and was not tested, may bend alike."""
    from pixmetry.calibrate.checks.field_sources import without_claims

    sources = {name: without_claims(one, UNTESTED_FIELD) for name, one in (tests.field_sources or {}).items()}
    patterns = None if tests.patterns is None else tuple(replace(p, confirmed=False) for p in tests.patterns)
    return replace(tests, field_sources=sources or None, patterns=patterns)


def _findings(settled: Settled, tests: Tests) -> list[Finding]:
    from pixmetry.calibrate.checks.checks import check_determined
    from pixmetry.calibrate.checks.findings import eccentricity_findings, findings_of, hold_out_findings, in_the_shadow
    from pixmetry.calibrate.checks.patterns import pattern_findings
    from pixmetry.calibrate.checks.rig_check import rig_findings

    adjustment = settled.adjustment
    rig = rig_findings(tests.rig, instants_given=adjustment.network.instant is not None)
    found = [*check_determined(adjustment), *rig, *in_the_shadow(pattern_findings(tests.patterns or ())), *findings_of(adjustment, tests)]
    found += eccentricity_findings(settled.measured, settled.shift)
    return found + hold_out_findings(tests.hold_out, free=_is_free(settled.measured))
