"""Test of the nominal coordinates of a test field: adjusted with fixed and with free coordinates, compared on images left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.checks.hold_out import LeftOut, hold_out_record, left_out
from pixmetry.calibrate.checks.quality import p_words
from pixmetry.calibrate.records import FieldComparison, FieldDeviations, FieldPoints, FieldTest, HoldOut, Moved
from pixmetry.calibrate.start.fit_to_control import brought_to
from pixmetry.calibrate.start.resection import similarity
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding

LEAST_FIELD = 6  # fixed points: with fewer there is little to tell of a field
FLAT = 1e-3  # nominal coordinates are those of a plane if their least extent is below this share of the largest
PLACES = {"c": 0, "xp": 1, "yp": 2}


@dataclass(frozen=True)
class FieldCheck:
    """The accepted adjustment, and the reason.

    Parameters
    ----------
    verdict : {"fixed", "free"}
    adjustment : Adjustment
        The accepted one.
    fixed : Adjustment
    free : Adjustment or None
        None: the images do not determine free points (the finding says why).
    field : FieldTest
    hold_out : HoldOut or None
        None where free points could not be tried or judged.
    findings : tuple of Finding
    left : LeftOut or None
        Of the accepted one.
    """

    verdict: str
    adjustment: Adjustment
    fixed: Adjustment
    free: Adjustment | None
    field: FieldTest
    hold_out: HoldOut | None
    findings: tuple[Finding, ...]
    left: LeftOut | None = None


def check_field(fixed: Adjustment, folds: int = 5, seed: int = 0, level: float = 0.01) -> FieldCheck:
    """Adjust once more with the points free that were fixed, and choose.

    Free points fit better in any case. They are accepted if images that were left out fit better as well (paired over images), and if
    the F-test of the given coordinates fails, both at the given level.

    Parameters
    ----------
    fixed : Adjustment
        With nominal coordinates as fixed points. What it rejected stays out.
    folds : int
    seed : int
        Of the deal of images to folds.
    level : float

    Raises
    ------
    InputError
        If no point is fixed.
    """
    from pixmetry.calibrate.bundle.bundle import adjust

    network = fixed.network
    nominal = (network.u_xyz == 0).any(axis=1) & np.isin(np.arange(len(network.points)), network.point)
    if nominal.sum() < 4:
        raise InputError("no test field with given coordinates", where="field", value=int(nominal.sum()), allowed="4 fixed points")
    if nominal.sum() < LEAST_FIELD:
        return _kept(fixed, f"{int(nominal.sum())} points are too few to contradict each other")
    released = replace(network, u_xyz=np.where(network.u_xyz == 0, np.inf, network.u_xyz))
    try:
        free = adjust(released, fixed.state, used=fixed.used, redundancy=fixed.redundancy is not None)
    except MeasureError as reason:
        return _kept(fixed, f"the images do not determine free points: {reason}")
    if fixed.dof - free.dof < 1:
        return _kept(fixed, "they give only origin, directions and scale")
    try:
        parts = left_out(fixed, folds, seed), left_out(free, folds, seed)
    except (InputError, MeasureError) as reason:
        return _kept(fixed, f"images left out cannot test free points: {reason}")
    held = hold_out_record(*parts)
    f, dof, p = _given_coordinates(fixed, free)
    assert held.fixed is not None and held.free is not None and held.p is not None  # both were asked for
    better = bool(held.p < level and held.free.left_out_rms_px < held.fixed.left_out_rms_px and p < level)
    verdict, moves = "free" if better else "fixed", _moves(fixed, free)
    compared = FieldComparison(f, dof, p, _deviations(network, free, nominal), moves[network.cameras[0].name], moves)
    text = _text(verdict, compared, held, level)
    advice = "Keep the points free, or have the field measured." if better else ""
    kind = "flatness" if compared.deviations.shape == "plane" else "field"
    finding = Finding(kind, text, advice, "warning" if better else "note")
    return FieldCheck(verdict, free if better else fixed, fixed, free, FieldTest(verdict, compared, text), held, (finding,), parts[better])


def _kept(fixed: Adjustment, text: str) -> FieldCheck:
    text = f"The given coordinates were not tested, and are used: {text}."
    return FieldCheck("fixed", fixed, fixed, None, FieldTest("fixed", None, text), None, (Finding("field", text),))


def _given_coordinates(fixed: Adjustment, free: Adjustment) -> tuple[float, tuple[int, int], float]:
    """F-test of the hypothesis that the points lie where they are said to be."""
    from scipy import stats

    squares = [part.sigma0**2 * part.dof for part in (fixed, free)]
    dof = (fixed.dof - free.dof, free.dof)
    f = max(squares[0] - squares[1], 0.0) / dof[0] / (squares[1] / dof[1])
    return float(f), dof, float(stats.f.sf(f, *dof))


def _axes(nominal: np.ndarray) -> tuple[np.ndarray, bool]:
    """Rows: axes in which deviations are given; of a plane the last is its normal and the first lies nearest to the object's x."""
    if not np.isfinite(nominal).all():  # points known in part: along the axes of the object
        return np.eye(3), False
    _, extent, directions = np.linalg.svd(nominal - nominal.mean(axis=0), full_matrices=False)
    if extent[2] > FLAT * extent[0]:
        return np.eye(3), False
    normal = directions[2] * np.sign(directions[2][np.argmax(np.abs(directions[2]))])
    x = np.eye(3)[0] - normal[0] * normal
    if np.linalg.norm(x) < 0.1:
        x = np.eye(3)[1] - normal[1] * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal]), True


def _deviations(network: Network, free: Adjustment, nominal: np.ndarray) -> FieldDeviations:
    """How far the points lie from their nominal places after the best similarity, and from the best plane."""
    from scipy import stats

    which = np.flatnonzero(nominal & free.state.located)
    given = np.where(network.u_xyz[which] == 0, network.xyz[which], np.nan)
    moved = brought_to(free.state.xyz[which], given, np.isfinite(given))
    scale, rotation, _ = similarity(free.state.xyz[which], moved)
    axes, plane = _axes(given)
    off = (moved - given) @ axes.T if plane else moved - given
    turn = axes @ rotation * scale
    u = np.sqrt(np.maximum(np.einsum("ij,njk,ik->ni", turn, free.point_covariance[which], turn), 0.0))
    p_flat = rms_inside = peak_inside = None
    if plane:
        flat = np.column_stack([np.ones(len(which)), given @ axes[:2].T])
        length, u_length = np.abs(off[:, 2] - flat @ np.linalg.lstsq(flat, off[:, 2], rcond=None)[0]), u[:, 2]
        inside = np.hypot(off[:, 0], off[:, 1])
        f_flat = float(np.sum((length / u_length) ** 2)) / (len(which) - 3)
        p_flat = float(stats.f.sf(f_flat, len(which) - 3, free.dof))
        rms_inside, peak_inside = float(np.sqrt(np.mean(inside**2))), float(inside.max())
    else:
        u[np.isnan(off)] = np.nan
        length, u_length = (np.sqrt(np.nansum(v**2, axis=1)) for v in (off, u))
    size = float(np.sqrt(np.mean(length**2))), float(length.max()), float(np.sqrt(np.mean(u_length**2)))
    points = FieldPoints(
        tuple(network.points[i] for i in which), given, axes, off[:, 0], u[:, 0], off[:, 1], u[:, 1], off[:, 2], u[:, 2]
    )  # fmt: skip
    return FieldDeviations("plane" if plane else "volume", network.unit, p_flat, rms_inside, peak_inside, *size, points)


def _moves(fixed: Adjustment, free: Adjustment) -> dict[str, Moved]:
    """What freeing the points does to principal point and distance, by camera."""
    cameras = {}
    for k, camera in enumerate(fixed.network.cameras):
        names, covariance = fixed.interior_covariance(k)
        moves: dict[str, float] = {}
        formal: dict[str, float | None] = {}
        for name, place in PLACES.items():
            per_px = camera.sensor.per_px[0] if name == "c" else 1.0
            moves[name] = float(free.state.interior[k, place] - fixed.state.interior[k, place]) / per_px
            known = name in names
            formal[name] = float(np.sqrt(covariance[names.index(name), names.index(name)])) / per_px if known else None
        cameras[camera.name] = Moved(moves["c"], formal["c"], moves["xp"], formal["xp"], moves["yp"], formal["yp"])
    return cameras


def _text(verdict: str, compared: FieldComparison, held: HoldOut, level: float) -> str:
    off, (fixed, free) = compared.deviations, held.parts.values()
    unit, plane = off.unit, off.shape == "plane"
    numbers = f"rms {off.rms:.3g} {unit} (of which {off.u:.2g} may be noise), peak {off.peak:.3g} {unit}"
    left = f"{fixed.left_out_rms_px:.4f} px with the points as given and {free.left_out_rms_px:.4f} px with them free"
    p_held = "" if held.p is None else p_words(held.p)
    judged = f"images left out of the fit show {left} ({p_held}); F = {compared.f:.3g}, {p_words(compared.p)}"
    if verdict == "fixed":
        return f"The given coordinates of the test field are accepted: {judged}, not both below {level:g}."
    if plane:
        inside = f"in its plane, points deviate by rms {off.rms_in_plane:.3g} {unit}, peak {off.peak_in_plane:.3g} {unit}"
        what = f"The board is not flat: it deviates from its best plane by {numbers}; {inside}"
        if off.p_flat is not None and off.p_flat > level:
            what = f"The board differs from the given coordinates: {inside}; it deviates from its best plane by {numbers}"
    else:
        what = f"The test field differs from the given coordinates: its points deviate by {numbers}"
    return f"{what}. {judged[0].upper()}{judged[1:]}. Free points moved {_moved_words(compared.first)}."


def _moved_words(found: Moved) -> str:
    words = []
    for name, what in (("xp", "the principal point by {} px in x"), ("yp", "{} px in y"), ("c", "the principal distance by {} px")):
        by_px, u = found.by_name[name]
        moved = what.format(f"{round(by_px, 2) + 0.0:+.2f}")  # + 0.0: no minus before nought
        words.append(moved if u is None else f"{moved} (formal u {u:.2f} px)")
    return ", ".join(words)
