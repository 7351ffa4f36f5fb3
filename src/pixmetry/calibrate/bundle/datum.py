"""Origin, directions and scale of a network: which of the seven are given, and inner constraints for those that are not.

A similarity moves a point by t + θ × (X − m) + s (X − m) about a middle m. Control coordinates and scale bars hold some combinations of
the seven parameters; along the others the image coordinates say nothing, and the datum is chosen so that the points that carry it stay, in
the mean, where they were before (K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models, 1999, 3.3). A covariance in any
datum is brought to that one by Q' = S Q Sᵀ with S = I − G (Bᵀ G)⁻¹ Bᵀ: G is the null space and B the same restricted to the coordinates
that carry the datum (W. Baarda, S-transformations and criterion matrices, 1973).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle.bundle_layout import Layout, layout_of
from pixmetry.calibrate.bundle.network import Adjustment, State
from pixmetry.calibrate.start.resection import motions
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError

GIVEN = 1e-8  # relative singular value above which control holds a direction
ALIGN_STEPS, ALIGNED = 50, 1e-10  # at most; a last step, in sizes of the network
SOME_SCALE = 1e-6  # part of the scale in a motion of unit length that nothing holds


@dataclass(frozen=True)
class Datum:
    """The datum of a network.

    Parameters
    ----------
    middle : ndarray, shape (3,)
    size : float
        Root mean square distance of the points from their middle: the generators are made free of units by it.
    missing : int
        How many of the seven parameters nothing gives.
    carriers : ndarray of bool, shape (points, 3)
        Coordinates that carry the datum then.
    start : ndarray, shape (points, 3)
        Where they stay in the mean.
    text : str
    """

    middle: np.ndarray
    size: float
    missing: int
    carriers: np.ndarray
    start: np.ndarray
    text: str


def datum_of(layout: Layout, start: State) -> Datum:
    """Which parameters of the datum are missing, and who carries them: points of which nothing is known (where given, the coordinates that
    they have beforehand), or, where these are too few, all coordinates that are not known.

    Raises
    ------
    MeasureError
        Where neither carries it.
    """
    network = layout.network
    there = layout.determined
    middle = start.xyz[there].mean(axis=0)
    size = float(np.sqrt(((start.xyz[there] - middle) ** 2).sum(axis=1).mean())) or 1.0
    nobody = np.zeros(network.u_xyz.shape, bool)
    datum = Datum(middle, size, 0, nobody, start.xyz, "")
    directions = _held_directions(layout, start, datum)
    singular = np.linalg.svd(directions, compute_uv=False)
    missing = 7 - int((singular > GIVEN * max(1.0, singular.max(initial=0.0))).sum())
    named = False
    if missing:
        carriers, named = _carriers(layout, start, generators(start.xyz, datum) @ np.linalg.svd(directions)[2][7 - missing :].T)
        datum = replace(datum, missing=missing, carriers=carriers, start=network.xyz if named else start.xyz)
    return replace(datum, text=_text(layout, datum, named))


def scale_is_open(adjustment: Adjustment) -> bool:
    """Whether neither control nor bars of an adjusted network say how large it is."""
    layout = layout_of(adjustment.network, adjustment.state, adjustment.used)
    datum = datum_of(layout, adjustment.state)
    null = np.linalg.svd(_held_directions(layout, adjustment.state, datum))[2][7 - datum.missing :]
    return bool((np.abs(null[:, 6]) > SOME_SCALE).any())


def _carriers(layout: Layout, start: State, motion: np.ndarray) -> tuple[np.ndarray, bool]:
    """The coordinates that carry a datum whose missing parameters move the points by ``motion`` (points, 3, missing), and whether they stay
    where they are given rather than at their start."""
    network = layout.network
    unknown = layout.determined[:, None] & np.isinf(network.u_xyz)
    whole: Flags = np.all(unknown, axis=1)
    given = whole & np.all(np.isfinite(network.xyz), axis=1)
    # three points that are not in line carry any datum; fewer given ones do not
    if given.sum() >= 3 and _spread(network.xyz[given]) > GIVEN:
        return unknown & given[:, None], True
    for carriers in (unknown & whole[:, None], unknown):
        if _carry(motion[carriers]):
            return carriers, False
    raise MeasureError(
        f"what is known leaves {motion.shape[2]} of the seven parameters of the datum open, and there are no free coordinates for inner "
        "constraints",
        where="bundle adjustment",
        remedy="leave more coordinates free, or give control points that are not on one line",
    )


def _carry(motion: np.ndarray) -> bool:
    """Whether coordinates, moved by each missing parameter (coordinates, missing), tell all of those apart."""
    return bool(len(motion) >= motion.shape[1] and np.linalg.svd(motion, compute_uv=False)[-1] > GIVEN * np.abs(motion).max())


def generators(points: np.ndarray, datum: Datum) -> np.ndarray:
    """Motion of points (n, 3) by each of the seven parameters: shift, rotation, scale, shape (n, 3, 7)."""
    return motions((points - datum.middle) / datum.size)


def null_space(layout: Layout, state: State, datum: Datum) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motions that change no observation: of the reduced unknowns (m, d), of the points (points, 3, d), and as (7, d) parameters."""
    m, d = len(layout.columns), datum.missing
    if d == 0:
        return np.zeros((m, 0)), np.zeros((len(state.xyz), 3, 0)), np.zeros((7, 0))
    basis = np.linalg.svd(_held_directions(layout, state, datum))[2][7 - d :].T
    points = np.zeros((len(state.xyz), 3, d))
    there = layout.determined
    points[there] = generators(state.xyz[there], datum) @ basis
    points[layout.held] = 0.0
    reduced = np.zeros((m, d))
    posed = np.flatnonzero(layout.image_col >= 0)
    rows = layout.image_col[posed][:, None] + np.arange(3)
    reduced[rows] = -state.rotation[posed] @ basis[3:6] / datum.size
    reduced[rows + 3] = generators(state.position[posed], datum) @ basis
    for j in np.flatnonzero(layout.point_col >= 0):
        reduced[layout.point_col[j] : layout.point_col[j] + 3] = points[j]
    return reduced, points, basis


def carried(layout: Layout, points: np.ndarray, datum: Datum) -> tuple[np.ndarray, np.ndarray]:
    """B: the null space of the coordinates carrying the datum, as parts of the reduced unknowns (m, d) and of all points (points, 3, d)."""
    of_points = np.where(datum.carriers[:, :, None], points, 0.0)
    reduced = np.zeros((len(layout.columns), points.shape[2]))
    for j in np.flatnonzero(layout.point_col >= 0):
        reduced[layout.point_col[j] : layout.point_col[j] + 3] = of_points[j]
    return reduced, of_points


def aligned(layout: Layout, state: State, datum: Datum) -> State:
    """The state moved along the null space so that its carriers stay, in the mean, at their start."""
    if datum.missing == 0:
        return state
    control = _control(layout)
    held = state.xyz[control]

    def step_from(now: State) -> np.ndarray:
        basis = np.linalg.svd(_held_directions(layout, now, datum))[2][7 - datum.missing :].T
        G = generators(now.xyz, datum)[datum.carriers] @ basis
        gap = (datum.start - now.xyz)[datum.carriers]
        step = _limited(basis @ np.linalg.lstsq(G, gap, rcond=None)[0], datum)
        if len(held):  # the last motion left them at rest to first order only
            back = np.concatenate([held - now.xyz[control], np.zeros(min(1, len(layout.bars)))])
            step += np.linalg.lstsq(np.concatenate(_held_rows(layout, now, datum)), back, rcond=GIVEN)[0]
        return step

    return _settled(state, datum, step_from)


def nearest_to_control(layout: Layout, state: State, datum: Datum) -> State:
    """The state after the similarity that brings it to weighted control, where nothing is held.

    An adjustment turns the whole to first order only; where control is weak beside the images it would creep.
    """
    weight = np.sqrt(layout.prior)
    some = weight > 0
    if not some.any() or (layout.held & layout.determined[:, None]).any():
        return state
    free = 6 if len(layout.bars) else 7

    def step_from(now: State) -> np.ndarray:
        rows = (weight[:, :, None] * generators(now.xyz, datum))[some][:, :free]
        gap = (weight * (layout.network.xyz - now.xyz))[some]
        return _limited(np.pad(np.linalg.lstsq(rows, gap, rcond=GIVEN)[0], (0, 7 - free)), datum)

    return _settled(state, datum, step_from)


def _settled(state: State, datum: Datum, step_from: Callable[[State], np.ndarray]) -> State:
    """The state after similarities, one after the other, until they move nothing."""
    from scipy.linalg import expm

    for _ in range(ALIGN_STEPS):
        step = step_from(state)
        state = _moved(state, step, datum, expm)
        if np.abs(step).max() < ALIGNED * datum.size:
            break
    return state


def _limited(step: Array, datum: Datum) -> Array:
    """What of a step turns by no more than half a radian, and scales by no more than a half."""
    return step * min(1.0, 0.5 / max(float(np.abs(step[3:]).max()) / datum.size, 1e-300))


def _moved(state: State, step: Array, datum: Datum, expm: Callable[[Array], Array]) -> State:
    """The state after the similarity whose generator is ``step``."""
    t, turn, scale = step[:3], step[3:6] / datum.size, step[6] / datum.size
    field = np.zeros((4, 4))
    field[:3, :3] = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]]) + scale * np.eye(3)
    field[:3, 3] = t
    whole = expm(field)
    A, shift = whole[:3, :3], whole[:3, 3] + datum.middle
    R = A / np.cbrt(np.linalg.det(A))
    return replace(
        state,
        xyz=(state.xyz - datum.middle) @ A.T + shift,
        position=(state.position - datum.middle) @ A.T + shift,
        rotation=state.rotation @ R.T,
    )


def _held_directions(layout: Layout, state: State, datum: Datum) -> np.ndarray:
    """What the seven parameters do to control coordinates and bars, shape (held, 7); its null space is what is missing."""
    held = np.concatenate([np.zeros((1, 7)), *_held_rows(layout, state, datum)])
    return held if len(held) <= 7 else np.asarray(np.linalg.qr(held, mode="r"))


def _held_rows(layout: Layout, state: State, datum: Datum) -> tuple[np.ndarray, np.ndarray]:
    """Of the control coordinates, and of the scale if there are bars."""
    return generators(state.xyz, datum)[_control(layout)], np.eye(7)[6:][: len(layout.bars)]


def _control(layout: Layout) -> Flags:
    """Coordinates of points that take part of which something is known, bool."""
    return layout.determined[:, None] & ~np.isinf(layout.network.u_xyz)


def _spread(points: np.ndarray) -> float:
    """Second singular value over the first: 0 where points are in line."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(singular[1] / singular[0]) if singular[0] > 0 else 0.0


def _text(layout: Layout, datum: Datum, named: bool) -> str:
    u = layout.network.u_xyz[layout.determined]
    fixed, weighted = _known_text(u == 0, u), _known_text((u > 0) & np.isfinite(u), u)
    parts = [fixed.format("fixed "), f"{weighted.format('')} with weights" if weighted else ""]
    if len(layout.bars):
        parts.append(f"{len(layout.bars)} scale bar{'s' if len(layout.bars) > 1 else ''}")
    if datum.missing:
        scale = " and the scale" if datum.missing == 7 else ""
        what = "the origin, the directions" + scale if datum.missing >= 6 else f"{datum.missing} of the seven parameters of the datum"
        what = _arbitrary(~np.all(np.isinf(u), axis=0), datum.missing) or what
        start = "given" if named else "start"
        parts.append(f"inner constraints on the {start} coordinates of {datum.carriers.any(axis=1).sum()} points for {what}")
    return "; ".join(part for part in parts if part)


def _known_text(which: np.ndarray, u: np.ndarray) -> str:
    """Known coordinates (points, 3): how many points, where all of theirs are known like this; else coordinates, and how many of the points
    are known in all three. A place is left for how."""
    some = which.any(axis=1)
    points, count, whole = int(some.sum()), int(which.sum()), int(np.isfinite(u[some]).all(axis=1).sum())
    if 3 * points == count:
        return f"{points} {{}}point{'s' if points > 1 else ''}" if points else ""
    return f"{count} {{}}coordinate{'s' if count > 1 else ''} of {points} point{'s' if points > 1 else ''} ({whole or 'none'} complete)"


def _arbitrary(known: np.ndarray, missing: int) -> str:
    """What is open where one or two axes (3,) have no known coordinate and everything else is held; empty in other cases."""
    open_axes = ["XYZ"[k] for k in np.flatnonzero(~known)]
    if len(open_axes) == 1 and missing == 1:
        return f"{open_axes[0]}, which is arbitrary"
    if len(open_axes) == 2 and missing == 3:
        return f"{', '.join(open_axes)} and the direction about {'XYZ'[int(np.argmax(known))]}, which are arbitrary"
    return ""
