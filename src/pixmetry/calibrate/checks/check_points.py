"""Check points: coordinates that were kept out of an adjustment, beside those that it found.

Given less found has the covariance Σ = C + diag(u²). C is the joint one of all check points: with the normal equations V x + Wᵀ y = h of a
point x and the reduced unknowns y, whose covariance is Q, that of points i and j is Vᵢ⁻¹ Wᵢᵀ Q Wⱼ Vⱼ⁻¹, and Vᵢ⁻¹ besides where i = j
(K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models, 1999, 3.2). Where neither control nor bars give the whole datum,
a similarity of the parameters that are missing first brings the network to the check points, by generalised least squares; what is left
has the covariance Σ − G (Gᵀ Σ⁻¹ G)⁻¹ Gᵀ, which does not depend on the datum of C. Along axes of which the network knows no coordinate, the
check points are shifted to it before: far from the origin, a shift and a rotation about the network's own middle could not be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.checks.quality import p_words, plain
from pixmetry.calibrate.records import Calibration, CheckedPoint, CheckRecord, WorstPoint
from pixmetry.core.arrays import Array, Ints
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding

if TYPE_CHECKING:
    from pixmetry.calibrate.bundle.bundle_layout import Layout
    from pixmetry.calibrate.bundle.datum import Datum

RARE = 0.001  # level of the tests: of all coordinates together, and of the worst one
LEAST_LEFT = 4  # coordinates over what the missing datum takes: with fewer nothing is said
SURE = 1e-9  # relative singular value above which check points determine a parameter of the datum
ROUNDS = 3  # of fitting: the first is not weighted, each further one squares what is left of a far turn
LOOSE = 100.0  # variance of what is fitted, in mean variances of a coordinate
NAMED = 5


@dataclass(frozen=True)
class CheckPoints:
    """Coordinates of points that are compared with an adjustment, and are not used in it.

    Parameters
    ----------
    names : tuple of str
    xyz : array_like, shape (points, 3)
        In the object's unit; NaN: not known.
    u_xyz : array_like, shape (points, 3), optional
        Standard uncertainties; without them the coordinates are exact.

    Raises
    ------
    InputError
        If names are given twice, shapes differ, or a value cannot be used.
    """

    names: tuple[str, ...]
    xyz: np.ndarray
    u_xyz: np.ndarray | None = None

    def __post_init__(self) -> None:
        names, good = tuple(self.names), False
        try:
            xyz = np.asarray(self.xyz, float)
            u = np.where(np.isfinite(xyz), np.asarray(0.0 if self.u_xyz is None else self.u_xyz, float), 0.0)
            good = xyz.shape == u.shape == (len(names), 3) and not np.isinf(xyz).any() and bool((np.isfinite(u) & (u >= 0)).all())
        except (TypeError, ValueError):  # no numbers, or rows of unequal length
            pass
        if not good or len(set(names)) < len(names):
            allowed = "different names, and for each name X, Y, Z (NaN: not known) with uncertainties of at least 0"
            raise InputError("these cannot be check points", where="check_points", allowed=allowed)
        for key, value in (("names", names), ("xyz", xyz), ("u_xyz", u)):
            object.__setattr__(self, key, value)


def refuse_known(network: Network, checks: CheckPoints) -> None:
    """Refuse check points that are known in the network, too.

    Raises
    ------
    InputError
        With the first one.
    """
    known = np.isfinite(network.xyz).any(axis=1) | np.isfinite(network.u_xyz).any(axis=1)
    both = set(checks.names) & {network.points[k] for k in np.flatnonzero(known)}
    name = next((name for name in checks.names if name in both), None)
    if name is not None:
        remedy = "delete it in one of the two: a check point takes no part in the adjustment, not even as a start value"
        raise InputError(f"point '{name}' is among the points and the check points", where="check_points", remedy=remedy)


def with_check_points(calibration: Calibration, checks: CheckPoints, *, a_priori: bool = False) -> Calibration:
    """The calibration with the record ``check_points`` among its tests, and with a finding where they contradict it.

    Parameters
    ----------
    calibration : Calibration
    checks : CheckPoints
    a_priori : bool
        Whether its covariances are a priori.
    """
    from pixmetry.calibrate.checks.findings import in_order

    record = check_record(calibration.adjustment, checks, a_priori=a_priori)
    findings = in_order([*calibration.findings, *check_findings(record)])
    return replace(calibration, findings=findings, tests=replace(calibration.tests, check_points=record))


def check_record(adjustment: Adjustment, checks: CheckPoints, *, a_priori: bool = False) -> CheckRecord:
    """Compare check points with an adjustment.

    If they test nothing, ratios are NaN and ``chi2``, ``p``, ``worst`` None.
    """
    from scipy import stats

    network = adjustment.network
    index = {name: k for k, name in enumerate(network.points)}
    at = np.array([index.get(name, -1) for name in checks.names], dtype=np.int64)
    there = (at >= 0) & np.isfinite(adjustment.point_covariance[at]).all(axis=(1, 2)) & np.isfinite(adjustment.state.xyz[at]).all(axis=1)
    known = np.isfinite(checks.xyz) & there[:, None]
    values = np.full((5, len(at), 3), np.nan)  # found, its u, difference, its u, ratio
    rank, chi2 = 0, np.nan
    if known.any():
        some = known.any(axis=1)
        assert checks.u_xyz is not None
        found, u_found, off, covariance, rank, chi2 = _compared(
            adjustment, at[some], checks.xyz[some], checks.u_xyz[some], known[some], a_priori
        )
        values[0, some], values[1, some] = found, u_found
        values[2][known], values[3][known] = off, np.sqrt(np.maximum(np.diag(covariance), 0.0))
    left, dof = int(known.sum()) - rank, max(adjustment.dof, 1)
    told = left >= (LEAST_LEFT if rank else 1)
    if told:
        values[4] = values[2] / np.where(values[3] > 0, values[3], np.nan)
    rays = np.bincount(network.point[adjustment.used], minlength=len(network.points))
    u_given = np.where(np.isfinite(checks.xyz), 0.0 if checks.u_xyz is None else checks.u_xyz, np.nan)
    points = tuple(
        CheckedPoint(name, checks.xyz[k], u_given[k], found, u_found, off, u_off, ratio, int(rays[at[k]]) if at[k] >= 0 else 0)
        for k, (name, found, u_found, off, u_off, ratio) in enumerate(zip(checks.names, *values, strict=True))
    )
    p, worst = None, None
    if told:
        p = float(stats.f.sf(chi2 / left, left, dof))
        row, axis = np.unravel_index(np.nanargmax(np.abs(values[4])), values[4].shape)
        critical = float(stats.t.isf(RARE / known.sum() / 2, dof))
        worst = WorstPoint(checks.names[row], "XYZ"[axis], float(values[2, row, axis]), float(values[4, row, axis]), critical)
    rms, expected = _rms(values[2]), _rms(values[3])
    record = CheckRecord(network.unit, rank, int(known.sum()), left, RARE, rms, expected, chi2 if told else None, p, worst, "", points)
    return replace(record, text=_text(record))


def _rms(values: np.ndarray) -> tuple[float, ...]:
    count = np.isfinite(values).sum(axis=0)
    return tuple(np.where(count > 0, np.sqrt(np.nansum(values**2, axis=0) / np.maximum(count, 1)), np.nan).tolist())


def _compared(
    adjustment: Adjustment, points: np.ndarray, given: np.ndarray, u: np.ndarray, known: np.ndarray, a_priori: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int, float]:
    """Found coordinates and their u, shape (points, 3); of the known ones given less found with its covariance; how many parameters of the
    datum were fitted; χ²."""
    from pixmetry.calibrate.bundle.bundle_layout import layout_of
    from pixmetry.calibrate.bundle.datum import datum_of, generators, null_space
    from pixmetry.calibrate.start.resection import similarity

    layout = layout_of(adjustment.network, adjustment.state, adjustment.used)
    state, turn, G = adjustment.state, np.eye(3), np.zeros((int(known.sum()), 0))
    own, datum = joint_covariance(adjustment, points, a_priori=a_priori), datum_of(layout, state)
    shift = _open_shift(layout, datum, given, known)
    given = given - shift
    found = given
    for _ in range(ROUNDS if datum.missing else 1):
        if datum.missing:
            state = _brought(layout, state, datum, points, found, known)
            there = layout.determined
            scale, rotation, _ = similarity(adjustment.state.xyz[there], state.xyz[there])
            datum = _about(datum, state.xyz[points])
            turn, G = scale * rotation, generators(state.xyz[points], datum)[known] @ null_space(layout, state, datum)[2]
        sigma = _turned(own, turn)[np.ix_(known.ravel(), known.ravel())] + np.diag(u[known] ** 2)
        off, covariance, rank, chi2 = _less_fitted((given - state.xyz[points])[known], sigma, G)
        found = state.xyz[points].copy()
        found[known] = given[known] - off
    u_found = np.sqrt(np.diagonal(turn @ adjustment.point_covariance[points] @ turn.T, axis1=1, axis2=2))
    return found + shift, u_found, off, covariance, rank, chi2


def _open_shift(layout: Layout, datum: Datum, given: np.ndarray, known: np.ndarray) -> np.ndarray:
    """From the network's middle to that of the check points, along the axes of which the network knows no coordinate, shape (3,)."""
    closed = np.isfinite(layout.network.u_xyz[layout.determined]).any(axis=0) | ~known.any(axis=0)
    middle = np.where(known, given, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(closed, 0.0, middle - datum.middle)


def _about(datum: Datum, points: np.ndarray) -> Datum:
    """The datum with generators about some points, of their size: so they are told apart in whatever units the network has been."""
    middle = points.mean(axis=0)
    return replace(datum, middle=middle, size=float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean())) or 1.0)


def _turned(covariance: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Covariance (3 points, 3 points) of points that are all multiplied by one matrix."""
    for _ in range(2):  # from the right, then what is turned over from the right, too
        covariance = (covariance.reshape(-1, 3) @ turn.T).reshape(covariance.shape).T
    return covariance


def _less_fitted(off: np.ndarray, sigma: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, np.ndarray, int, float]:
    """What generalised least squares leaves of differences by the columns of G, its covariance, how many of them it determines, and χ²."""
    left, size, _ = np.linalg.svd(G, full_matrices=False)
    G = left[:, size > SURE * max(1.0, size.max(initial=0.0))]
    sigma = sigma + LOOSE * np.trace(sigma) / len(sigma) * G @ G.T  # regular, whatever the datum; what is left is the same
    weight = np.linalg.inv(sigma)
    inner = np.linalg.inv(G.T @ weight @ G)
    off = off - G @ (inner @ (G.T @ weight @ off))
    return off, sigma - G @ inner @ G.T, G.shape[1], float(off @ weight @ off)


def _brought(layout: Layout, state: State, datum: Datum, points: np.ndarray, given: np.ndarray, known: np.ndarray) -> State:
    """The network moved to the check points along what nothing else gives."""
    from pixmetry.calibrate.bundle.datum import aligned
    from pixmetry.calibrate.start.resection import similarity

    whole = known.all(axis=1)
    if datum.missing >= 6 and whole.sum() >= 3:  # a far turn, at once
        scale, rotation, shift = similarity(state.xyz[points[whole]], given[whole], scaled=datum.missing == 7)
        move = {"xyz": scale * state.xyz @ rotation.T + shift, "position": scale * state.position @ rotation.T + shift}
        state = replace(state, **move, rotation=state.rotation @ rotation.T)
    carriers, start = np.zeros(state.xyz.shape, bool), state.xyz.copy()
    carriers[points] = known
    start[points] = np.where(known, given, start[points])
    return aligned(layout, state, replace(datum, carriers=carriers, start=start))


def joint_covariance(adjustment: Adjustment, points: Ints, *, a_priori: bool = False) -> Array:
    """Covariance of the coordinates of some free points together, shape (3 points, 3 points).

    Where the datum is missing, it holds for what does not depend on it.
    """
    from pixmetry.calibrate.bundle._bundle_kernels import ELIMINATED
    from pixmetry.calibrate.bundle.bundle_layout import layout_of
    from pixmetry.calibrate.bundle.bundle_system import Loss, condensed, equations, linearise, point_roots, rows_of
    from pixmetry.calibrate.bundle.shared_errors import shared_moves

    layout = layout_of(adjustment.network, adjustment.state, adjustment.used)
    now = linearise(layout, adjustment.state, Loss())
    m = len(layout.columns)
    root, _ = point_roots(layout, equations(layout, now, np.empty((m, m)))[1])
    slopes, own = np.zeros((len(points), 3, m)), np.zeros((len(points), 3, len(points), 3))
    out = layout.point_col[points] == ELIMINATED
    inverse = np.swapaxes(root[points], 1, 2)
    Z = rows_of(layout, condensed(layout, now, root), points[out])
    slopes[out] = -inverse[out] @ Z.reshape(-1, 3, m)
    for i, point in enumerate(points):
        if out[i]:
            own[i, :, i] = inverse[i] @ root[point]
        else:  # joined by a bar
            slopes[i, range(3), layout.point_col[point] + np.arange(3)] = 1.0
    factor = 1.0 if a_priori else adjustment.sigma0**2
    shared = adjustment.shared if adjustment.shared is not None and adjustment.shared.found else None
    rows = slopes.reshape(-1, m)[:, layout.estimated]
    joint: Array = factor * own.reshape(len(rows), len(rows))
    if shared is None:
        return joint + rows @ adjustment.covariance @ rows.T
    moved, by_points = shared_moves(adjustment, points)
    independent = adjustment.covariance - moved @ moved.T
    return shared.white_variance * joint + rows @ independent @ rows.T + by_points @ by_points.T


def _text(found: CheckRecord) -> str:
    if not found.n:
        return "no coordinate of a check point could be compared"
    rms, expected = (
        ", ".join(f"{axis} {_two_digits(v)}" for axis, v in zip("XYZ", values, strict=True) if np.isfinite(v))
        for values in (found.rms, found.expected_rms)
    )
    points, unit = sum(bool(np.isfinite(point.difference).any()) for point in found.points), found.unit
    noun = "check point" if points == 1 else "check points"
    text = f"{points} {noun} with {found.n} coordinates: given minus computed {rms} {unit} rms"
    if found.datum_parameters:
        text += f", after {found.datum_parameters} parameters of the datum, which nothing else determines, were fitted to them"
    if found.p is None:
        return f"{text}; so few check points cannot test a network without a datum of its own"
    return f"{text}, expected {expected} {unit}; {_chi2(found)}; largest: {_worst(found)}"


def _two_digits(value: float) -> str:
    """A length to two digits, a zero at the end among them: 0.40 mm."""
    return plain(value, 2) if abs(value) >= 10 else f"{value:#.2g}".rstrip(".")


def _chi2(found: CheckRecord) -> str:
    assert found.chi2 is not None and found.p is not None
    return f"χ² = {plain(found.chi2, 3)} with {found.dof} degrees of freedom ({p_words(found.p)})"


def _worst(found: CheckRecord, critical: str = "") -> str:
    worst = found.worst
    assert worst is not None
    return f"{worst.name} {worst.axis}, {worst.difference:+.3g} {found.unit} ({abs(worst.ratio):.1f} u{critical})"


def check_findings(record: CheckRecord) -> list[Finding]:
    """Which check points have no coordinates or are not determined, and a warning where they contradict the network."""
    found = []
    some = [(point, bool(np.isfinite(point.given).any())) for point in record.points]
    empty = [point.name for point, known in some if not known]
    lost = [point.name for point, known in some if known and not np.isfinite(point.found).all()]
    for names, what, advice in (
        (empty, "without coordinates", "Fill in X, Y or Z; a row without coordinates cannot be compared."),
        (lost, "not determined", "Measure them in two images or more, and compare their names with those of the image coordinates."),
    ):
        if names:
            named = ", ".join(names[:NAMED]) + (" …" if len(names) > NAMED else "")
            text = f"{len(names)} of {len(some)} check points {'is' if len(names) == 1 else 'are'} {what}: {named}."
            found.append(Finding("check_points", text, advice, "note" if record.n else "warning"))
    worst = record.worst
    if worst is None or record.p is None:
        return found
    single = abs(worst.ratio) > worst.critical
    if single or record.p < RARE:
        named = _worst(record, f", critical {worst.critical:.1f}")
        text = f"The check points contradict the network (level {RARE:g}): {_chi2(record)}; the worst, given minus computed: {named}."
        advice = "Check the coordinates, the name and the image points of this one." if single else "No single point stands out."
        advice += " If several are wrong, the given uncertainties or those of the network are too small."
        found.append(Finding("check_points", text, advice, "warning"))
    return found
