"""Gross errors, weights and eccentricity hang together: they are found in turn until none of them changes anything."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pixmetry.calibrate.bundle.eccentric import Eccentricity, eccentricity, without_eccentricity
from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.checks.known_checks import KnownFaults, raised
from pixmetry.calibrate.checks.snooping import Rejected
from pixmetry.calibrate.records import CameraComponents

Progress = Callable[[str], None]
LOOPS = 12
CLOSE_PX = 1e-4  # an eccentricity that moves by less has converged
UNEQUAL = 2.0  # ratio of given variances from which on it matters what is added to them
ALIKE = 1.3  # weights that change by less, one image coordinate against another, need no new search for gross errors


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
    components : dict
        Variance components by camera; empty if they were not estimated.
    known_faults : KnownFaults
        Bars and control points that were left out or weigh less.
    given_px2 : ndarray, shape (n, 3)
        Covariances of the image coordinates before they were weighted.
    rejected : Rejected
        What image points that are out were rejected for.
    """

    measured: Network
    adjustment: Adjustment
    shift: Eccentricity
    components: dict[str, CameraComponents]
    known_faults: KnownFaults
    given_px2: np.ndarray
    rejected: Rejected


def adjust_with(options: Options) -> Callable[..., Adjustment]:
    """`bundle.adjust` with what the options say of every adjustment."""
    from pixmetry.calibrate.bundle.bundle import adjust

    return partial(adjust, max_iterations=options.max_iterations, a_priori=options.a_priori)


def settle(measured: Network, state: State, options: Options, say: Progress, before: Settled | None = None) -> Settled:
    """Repeat the search for gross errors, the variance components and the eccentricity until none of them changes anything.

    Parameters
    ----------
    measured : Network
    state : State
        Start values.
    options : Options
    say : callable
    before : Settled, optional
        The same image coordinates, settled already with other points: where to go on.
    """
    from pixmetry.calibrate.checks.known_checks import has_known, lost_records, set_free, where_seen, wrong_known

    given = measured
    loss: str = options.loss if before is None else "none"
    given_px2 = measured.covariance_px2 if before is None else before.given_px2
    rejected = Rejected.none(len(measured)) if before is None else before.rejected
    freed = np.zeros(0, int)
    components: dict[str, CameraComponents] = {}
    used = np.ones(len(measured), bool) if before is None else before.adjustment.used
    shift = _shift(measured, state, options)
    if before is None:
        measured = _first_weights(measured, shift, state, options)
    measured, state, used, loss, faults = _checked_known(measured, shift, state, used, loss, options, say, rejected)
    if (
        not _tests_known(options) and has_known(measured) and not faults.untested
    ):  # image points were tested without control, and do not go for it
        options = replace(options, snoop=False)
    for loop in range(1, LOOPS + 1):
        say(f"adjusting, round {loop}")
        adjustment = _without_gross_errors(without_eccentricity(measured, shift), state, used, loss, options, rejected)
        wrong = wrong_known(measured, adjustment) if _tests_known(options) else freed[:0]
        if len(wrong):
            state = where_seen(without_eccentricity(measured, shift), adjustment, wrong)
            measured, used, freed = set_free(measured, wrong), adjustment.used | np.isin(measured.point, wrong), np.append(freed, wrong)
            adjustment = _without_gross_errors(without_eccentricity(measured, shift), state, used, "none", options, rejected)
        adjustment, step, components = _weighted(adjustment, given_px2, options, components)
        measured = replace(measured, covariance_px2=adjustment.network.covariance_px2)
        again = _shift(measured, adjustment.state, options)
        moved = float(np.abs(again.shift_px - shift.shift_px).max(initial=0.0))
        still = (adjustment.used == used).all() and moved < CLOSE_PX and step.max() < ALIKE * step.min()
        used, state, loss = adjustment.used, adjustment.state, "none"
        if still:
            break
        shift = again
    faults += KnownFaults(control_points=lost_records(given, adjustment, freed))
    faults = replace(faults, raised=raised(given, measured))
    return Settled(measured, adjustment, shift, components, faults, given_px2, rejected)


def _tests_known(options: Options) -> bool:
    """Whether control points and bars may be left out."""
    return options.snoop and options.control == "tested"


def _as_given(network: Network, options: Options) -> bool:
    """Whether the covariances of the image coordinates stay as they came.

    Beside scale bars or control points, which stand as they were stated, they do not: sigma0² would scale the uncertainties of all alike.
    """
    from pixmetry.calibrate.checks.known_checks import has_stated

    estimated = options.variance_components or has_stated(network)
    return network.covariance_known and (options.a_priori or not estimated)


def _first_weights(measured: Network, shift: Eccentricity, state: State, options: Options) -> Network:
    """The network with what its image coordinates scatter beyond covariances that differ from point to point, from the middle half of the
    residuals: else the best of them would weigh so much that gross errors are taken for good, and good points for gross errors."""
    from pixmetry.calibrate.bundle.loosened import first_that_stands, loosened
    from pixmetry.calibrate.checks.known_checks import loose_coordinates
    from pixmetry.calibrate.checks.variance_components import robust_sizes, same_weights

    variance = measured.covariance_px2[:, [0, 2]]
    unequal = measured.covariance_known and (np.ptp(np.log(variance), axis=0) > np.log(UNEQUAL)).any()
    if options.a_priori or not (options.variance_components and unequal):
        return measured
    adjust = partial(adjust_with(options), loss=options.loss, loss_scale=options.loss_scale, covariance=False)
    networks = loosened(without_eccentricity(measured, shift), loose_coordinates(measured))
    first, _ = first_that_stands(networks, lambda network: adjust(same_weights(network), state))
    if first is None:  # it hangs on bars or control points
        return measured
    return robust_sizes(first, measured.covariance_px2).of(measured, measured.covariance_px2)


def _checked_known(
    measured: Network,
    shift: Eccentricity,
    state: State,
    used: np.ndarray,
    loss: str,
    options: Options,
    say: Progress,
    rejected: Rejected,
) -> tuple[Network, State, np.ndarray, str, KnownFaults]:
    """The network without bars and control points that it contradicts, and what its image points without them are worth."""
    from pixmetry.calibrate.bundle.loosened import first_that_stands, loosened, with_the_rest
    from pixmetry.calibrate.checks.known_checks import (
        check_known,
        few_held,
        fixed_again,
        has_known,
        in_frame_of_control,
        loose_coordinates,
        weighted_instead,
        without_absurd_control,
    )

    if not (options.snoop and has_known(measured)):
        return measured, state, used, loss, KnownFaults()
    if _tests_known(options):
        measured, absurd = without_absurd_control(measured, state)
    else:
        absurd = ()
    say("testing scale bars and control points")
    alone = replace(options, a_priori=False)
    networks = loosened(without_eccentricity(measured, shift), loose_coordinates(measured))
    clean, why = first_that_stands(networks, lambda network: _without_gross_errors(network, state, used, loss, alone, rejected))
    if clean is None:
        return measured, state, used, loss, KnownFaults(control_points=absurd, untested=why)
    weighted = weighted_instead(measured, clean)
    begin, used = with_the_rest(weighted, clean, state, used, rejected)
    if not _tests_known(options):
        return measured, begin, used, "none", KnownFaults()
    near, begin, far = in_frame_of_control(weighted, begin)
    check = partial(check_known, without_eccentricity(near, shift), clean, adjust_with(alone), used=used, held=few_held(measured))
    tried, why = first_that_stands((begin, state), lambda start: check(state=start))
    if tried is None:
        return measured, state, used, loss, KnownFaults(control_points=absurd, untested=why)
    checked, state = tried
    measured = replace(measured, bars=checked.network.bars, u_xyz=fixed_again(checked.network, measured, weighted))
    if not _as_given(measured, options):
        measured = replace(measured, covariance_px2=checked.network.covariance_px2)
    return measured, state, used, "none", KnownFaults(control_points=absurd + far) + checked.faults


def _shift(measured: Network, state: State, options: Options) -> Eccentricity:
    return eccentricity(measured if options.eccentricity else replace(measured, diameter=None), state, options.target)


def _without_gross_errors(network: Network, state: State, used: np.ndarray, loss: str, options: Options, rejected: Rejected) -> Adjustment:
    from pixmetry.calibrate.checks.snooping import remove_gross_errors

    adjust = adjust_with(options)
    if not options.snoop:
        return adjust(network, state, used=used, redundancy=True)
    scale, alarms = options.loss_scale, options.false_alarms
    return remove_gross_errors(
        network, state, adjust, used=used, loss=loss, loss_scale=scale, false_alarms=alarms, rejected=rejected
    ).adjustment


def _weighted(
    adjustment: Adjustment, given_px2: np.ndarray, options: Options, before: dict[str, CameraComponents]
) -> tuple[Adjustment, np.ndarray, dict[str, CameraComponents]]:
    """The adjustment with estimated weights, by how much they changed, and records, whose iterations go on from those before.

    If weights are not to be estimated, all image coordinates together still get a factor, for bars beside them, or where they are guessed.
    """
    from pixmetry.calibrate.checks.variance_components import estimate_components

    if _as_given(adjustment.network, options):
        return adjustment, np.ones(1), {}
    found = estimate_components(adjustment, adjust_with(options), by_axis=options.variance_components, given_px2=given_px2)
    records = found.records() if options.variance_components or adjustment.network.covariance_known else {}
    so_far = {name: part.iterations for name, part in before.items()}
    records = {name: replace(part, iterations=part.iterations + so_far.get(name, 0)) for name, part in records.items()}
    step = found.adjustment.network.covariance_px2[:, [0, 2]] / adjustment.network.covariance_px2[:, [0, 2]]
    return found.adjustment, step, records
