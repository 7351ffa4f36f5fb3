"""A network without what was known of its object: the image coordinates are tested by themselves before bars and control points pull.

Control points are set free, and the datum is held by inner constraints: weights, however small, would leave it so soft beside many good
images that no factorisation tells it from a defect. Only where a network hangs on its control are they given weights, the smallest that
hold it. What only they had determined is brought back afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, ScaleBars, State
from pixmetry.calibrate.checks.snooping import Rejected
from pixmetry.calibrate.start.resection import fitted
from pixmetry.core.errors import MeasureError

LOOSE = (np.inf, 1e-2, 1e-4)  # uncertainties of control points, as parts of the field's extent: the first with which the network stands
LEAST_COMMON = 4  # points from which a frame is found again
Tried = TypeVar("Tried")
Result = TypeVar("Result")


def loosened(network: Network, control: np.ndarray) -> Iterator[Network]:
    """The network without bars, and with free control points; then, where there are any, with control points that weigh little.

    Parameters
    ----------
    network : Network
    control : ndarray of bool, shape (points, 3)
        Coordinates that are loosened; those that are held beside them stay.
    """
    u, xyz = np.where(control, np.inf, network.u_xyz), network.xyz
    free = replace(network, bars=ScaleBars.none(), u_xyz=u, xyz=np.where(np.isinf(u), np.nan, xyz))  # start values carry the datum
    yield free if control.any() else replace(network, bars=ScaleBars.none())
    known = xyz[np.isfinite(xyz).all(axis=1)]
    if control.any() and len(known):
        extent = float(np.ptp(known, axis=0).max())
        for part in LOOSE[1:]:
            u = np.where(control, np.maximum(network.u_xyz, part * extent), network.u_xyz)
            yield replace(network, bars=ScaleBars.none(), u_xyz=u)


def first_that_stands(tries: Iterable[Tried], adjusted: Callable[[Tried], Result]) -> tuple[Result | None, str]:
    """What the first of some networks, or of some start values, gives that is determined, or None; and why the first of all was not."""
    why = ""
    for one in tries:
        try:
            return adjusted(one), ""
        except MeasureError as error:
            why = why or error.what
    return None, why


def with_the_rest(network: Network, clean: Adjustment, start: State, used: np.ndarray, rejected: Rejected) -> tuple[State, np.ndarray]:
    """State and image points of a loosened network, in the frame of the start, and with what only known points had determined.

    Parameters
    ----------
    network : Network
        With its control points.
    clean : Adjustment
        Of the loosened one.
    start : State
        That it began with.
    used : ndarray of bool, shape (n,)
        Image points that it began with.
    rejected : Rejected
        Those that were rejected stay out.
    """
    state = clean.state if (clean.network.u_xyz == 0).any() else in_frame(clean.state, clean.state.xyz, start.xyz)
    lost_image, lost_point = ~state.posed, ~state.located
    known = np.isfinite(network.u_xyz)
    partly, wholly = np.any(known, axis=1), np.all(known, axis=1)
    untested = lost_image[network.image] | (lost_point & partly)[network.point]
    untested &= np.isnan(rejected.statistic)
    again = lost_point & np.isin(np.arange(len(lost_point)), network.point[untested])
    state = replace(
        state,
        rotation=np.where(lost_image[:, None, None], start.rotation, state.rotation),
        position=np.where(lost_image[:, None], start.position, state.position),
        xyz=np.where(again[:, None], np.where(wholly[:, None], network.xyz, start.xyz), state.xyz),
    )
    return state, clean.used | (used & untested)


def in_frame(state: State, points: np.ndarray, where: np.ndarray) -> State:
    """The state after the similarity that takes most of some of its points to where they are in another frame."""
    both = np.isfinite(points).all(axis=1) & np.isfinite(where).all(axis=1)
    if both.sum() < LEAST_COMMON:
        return state
    scale, rotation, shift, _ = fitted(points[both], where[both])
    return replace(
        state,
        rotation=state.rotation @ rotation.T,
        position=scale * state.position @ rotation.T + shift,
        xyz=scale * state.xyz @ rotation.T + shift,
    )
