"""Plumb-line calibration: straight lines in space are straight in the corrected image.

Each position (x, y) that was measured on a line is corrected (`pixmetry.calibrate.bundle.model`, image to object) and must fulfil

    a'(x, y) cos θ + b'(x, y) sin θ − ρ = 0

with the two parameters θ, ρ of its line. Only the component across the line counts; a line of n positions leaves n − 2 degrees of freedom
to the lens. An affinity keeps lines straight, and so does any change of scale: lines alone do not tell c, and B1, B2 only as far as a
strong distortion betrays in which pixels it is round. Lines of one direction do not tell the tangential parameter that acts along them:
combine an image with lines along x and one with lines along y.

References
----------
D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37 (1971) 855–866 (the method); E. M. Mikhail, Observations and
Least Squares (1976) (conditions with observations and parameters); W. Baarda, A testing procedure for use in geodetic networks (1968).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.lines.line_residuals import AxisResiduals, axis_residuals, compare_axes, correlation_inflation
from pixmetry.calibrate.lines.plumb_line_fit import LineFit, LineTable, adjust_lines, refuse
from pixmetry.calibrate.records import DistortionCurves, LineRecord, LinesFTest, record_of
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding
from pixmetry.core.number import Estimates

RADII = 101
TERMS = {"k1": 3, "k2": 5, "k3": 7, "k4": 9, "k5": 11}  # power of the radius
FREE = ("k1", "k2", "p1", "p2")
LOSSES = ("none", "huber", "cauchy")
LOST_REL = 0.002  # of the frame's diagonal: a parameter whose standard uncertainty moves a corner by more is lost (k: ten times as much,
# since they make up for each other; centre: likewise)
FRAME = 0.55  # of its size from the middle: places farther off are outside of the frame, where the polynomial means nothing
SUFFIX = {"p1": 1, "p2": 1, "k1": 2, "k2": 4, "k3": 6, "k4": 8, "k5": 10}


@dataclass(frozen=True)
class PlumbLineResult:
    """A lens calibrated from straight lines.

    Parameters
    ----------
    camera : CameraModel
        With the values found; its ``c`` is that of the start (0 without one): lines do not tell it.
    free : tuple of str
        Which parameters were estimated.
    estimates : Estimates
        Their values and covariance, a posteriori: variances along x and y are those of the residuals, and where these hang together along
        the lines, the covariance is enlarged by ``inflation``.
    lines : tuple of LineRecord
    line_of : ndarray of int, shape (n,)
        Which of them.
    along : ndarray, shape (n,)
        Place along the line in the corrected image, mm (px without a pitch).
    residual_px, residual_um : ndarray, shape (n,)
        Across the line in the image as measured, towards +x (lines of axis "x") or +y; ``residual_um`` is None without a pitch.
    used : ndarray of bool, shape (n,)
        The others are gross errors.
    redundancy : ndarray, shape (n,)
        Redundancy numbers; their sum over the used positions is the number of degrees of freedom.
    sigma_px : (float, float)
        Factors by which the stated standard deviations along x and y were multiplied (standard deviations, if none were stated).
    axes : dict of AxisResiduals
        By "x" and "y", as far as there are lines.
    f_test : LinesFTest, optional
        Of x against y, if there are both.
    inflation : float
    iterations : int
    findings : tuple of Finding
    """

    camera: CameraModel
    free: tuple[str, ...]
    estimates: Estimates
    lines: tuple[LineRecord, ...]
    line_of: np.ndarray
    along: np.ndarray
    residual_px: np.ndarray
    residual_um: np.ndarray | None
    used: np.ndarray
    redundancy: np.ndarray
    sigma_px: tuple[float, float]
    axes: dict[str, AxisResiduals]
    f_test: LinesFTest | None
    inflation: float
    iterations: int
    findings: tuple[Finding, ...]

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        return {
            "parameters": self.estimates.to_records(),
            "correlations": (self.estimates.covariance / np.outer(self.estimates.u, self.estimates.u)).tolist(),
            "lines": [record_of(line) for line in self.lines],
            "axes": {name: axis.to_record() for name, axis in self.axes.items()},
            "f_test": None if self.f_test is None else record_of(self.f_test),
            "gross_errors": np.flatnonzero(~self.used).tolist(),
            "inflation": self.inflation,
            "findings": [{"kind": f.kind, "text": f.text, "advice": f.advice, "level": f.level} for f in self.findings],
        }


@dataclass(frozen=True)
class LineCalibration:
    """Result of a calibration from straight lines.

    Parameters
    ----------
    result : PlumbLineResult
        Parameters, residuals, tests.
    image, line : ndarray of str, shape (n,)
        Of each position, in its order.
    x_px, y_px : ndarray, shape (n,)
        As measured.
    findings : tuple of Finding
        Most important first.
    provenance : mapping
        Inputs with their hashes, options, version.
    """

    result: PlumbLineResult
    image: np.ndarray
    line: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    findings: tuple[Finding, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def camera(self) -> CameraModel:
        """The camera; its c is 0 unless it was given, because lines do not determine it."""
        return self.result.camera

    def curves(self) -> DistortionCurves:
        """Radial and tangential correction against the radius with standard uncertainties, as of `calibration.curves`.

        Both are linear in K, and √(P1² + P2²) is taken to first order.
        """
        camera, free, covariance = self.camera(), self.result.free, self.result.estimates.covariance
        (mx, my), sensor = camera.sensor.per_px, camera.sensor
        x, y = camera["xp"], camera["yp"]
        reach = np.hypot(max(x + 0.5, sensor.cols - 0.5 - x) * mx, max(y + 0.5, sensor.rows - 0.5 - y) * my)
        radius = np.linspace(0.0, float(reach), RADII)
        size = float(np.hypot(camera["p1"], camera["p2"]))
        radial = {name: radius**power for name, power in TERMS.items()}
        tangential = {name: camera[name] / size * radius**2 for name in ("p1", "p2")} if size else {}
        made: dict[str, Any] = {}
        for kind, slopes in (("radial", radial), ("tangential", tangential)):
            if not any(name in slopes for name in free):
                continue
            rows = np.array([slopes.get(name, np.zeros_like(radius)) for name in free])
            value = sum((camera[name] * slope for name, slope in slopes.items()), np.zeros_like(radius))
            u = np.sqrt(np.maximum(np.einsum("ir,ij,jr->r", rows, covariance, rows), 0.0))
            made |= {kind: value, f"u_{kind}": u, f"{kind}_px": value / mx, f"u_{kind}_px": u / mx}
        return DistortionCurves(sensor.unit, radius, **made)


def calibrate_lines(
    x_px: ArrayLike,
    y_px: ArrayLike,
    line: ArrayLike,
    image: ArrayLike,
    sensor: Sensor,
    *,
    free: tuple[str, ...] = FREE,
    u_px: ArrayLike | None = None,
    start: CameraModel | None = None,
    loss: str = "huber",
    loss_scale: float = 2.5,
    reject: bool = True,
) -> PlumbLineResult:
    """Find the lens distortion that makes lines straight.

    Parameters
    ----------
    x_px, y_px : array_like, shape (n,)
        Positions on the lines, in pixels from the centre of the top-left one. Their place along the line does not matter.
    line, image : array_like of int or str, shape (n,)
        A line is a pair of both. All images are of one camera with one lens setting.
    sensor : Sensor
    free : tuple of str
        Out of k1 … k5, p1, p2, xp, yp, b1, b2.
    u_px : array_like, optional
        Standard uncertainties: a number, shape (n,), or covariances (var x, cov xy, var y in px²), shape (n, 3). Only ratios count: the
        level along x and y is taken from the residuals.
    start : CameraModel, optional
        Start values, and values of what is not free. Without it: no distortion, centre in the middle of the frame.
    loss : {"huber", "cauchy", "none"}
        Of the first pass, which must not be led astray by gross errors.
    loss_scale : float
        From how many standard deviations on a position loses weight in it.
    reject : bool
        Whether positions that cannot be explained (data snooping, a false alarm in one table of a thousand) are left out.

    Raises
    ------
    InputError
        If an argument cannot be used.
    MeasureError
        If the lines do not determine what is free.
    """
    model = _start(sensor, start, free, loss)
    table = LineTable.of(x_px, y_px, line, image, u_px)
    away = np.abs(np.column_stack([x_px, y_px]) - sensor.centre) / (sensor.cols, sensor.rows)
    table.keep_inside(np.all(away <= FRAME, axis=1))
    fit = LineFit(table, model, free)
    adjust_lines(fit, loss, loss_scale, reject)
    return _result(fit, model, free)


def _start(sensor: Sensor, start: CameraModel | None, free: tuple[str, ...], loss: str) -> CameraModel:
    allowed = [name for name in NAMES if name != "c"]
    wrong = [name for name in free if name not in allowed]
    if "c" in wrong:
        raise InputError(
            "lines have no scale: they do not determine c", where="free", value="c", remedy="calibrate with a test field for c"
        )
    if wrong or not free or len(set(free)) != len(free):
        raise InputError("these parameters cannot be estimated", where="free", value=tuple(wrong) or free, allowed=", ".join(allowed))
    if loss not in LOSSES:
        raise InputError("no such loss", where="loss", value=loss, allowed=", ".join(LOSSES))
    if start is None:
        return CameraModel.of(sensor, free=free)
    if start.direction != "image_to_object":
        remedy = "give a start of the direction image_to_object"
        raise InputError("plumb lines correct measured coordinates", where="start", value=start.direction, remedy=remedy)
    return replace(start, sensor=sensor, free=np.isin(NAMES, free))


def _result(fit: LineFit, model: CameraModel, free: tuple[str, ...]) -> PlumbLineResult:
    table, unit = fit.table, model.sensor.unit
    used, axis = table.used, fit.axis_of_line()
    redundancy = np.where(used, 1 - fit.leverage(), 0.0)
    residual_px = fit.f_left / fit.per_px_across
    residual_um = 1000 * fit.f_left / fit.per_unit_across if unit == "mm" else None
    axes = {}
    for k, name in enumerate("xy"):
        mine = used & (axis[table.line_of] == k)
        if mine.any():
            um = None if residual_um is None else residual_um[mine]
            axes[name] = axis_residuals(residual_px[mine], um, redundancy[mine], table.line_of[mine], fit.along[mine])
    inflation = max(correlation_inflation(a) for a in axes.values())
    camera = replace(model, values=fit.q.copy())
    estimates = _estimates(fit, free, unit, inflation, sum(a.dof_effective for a in axes.values()))
    lost = _lost(camera, estimates, free)
    if lost:
        refuse(lost)
    f_test = compare_axes(axes["x"], axes["y"]) if len(axes) == 2 else None
    findings = _findings(estimates, free, axes, used, f_test, inflation)
    lines = []
    for i, (image, line) in enumerate(table.keys):
        mine = used & (table.line_of == i)
        dof = float(redundancy[mine].sum())
        rms = float(np.sqrt(np.sum(residual_px[mine] ** 2) / dof)) if dof > 0 else float("nan")
        angle = float((np.degrees(fit.theta[i]) + 180.0) % 180.0 - 90.0)
        lines.append(LineRecord(image, line, "xy"[axis[i]], angle, int(mine.sum()), rms, dof))
    return PlumbLineResult(
        camera, free, estimates, tuple(lines), table.line_of, fit.along, residual_px, residual_um, used.copy(), redundancy,
        (float(fit.scale[0]), float(fit.scale[1])), axes, f_test, inflation, fit.iterations, findings,
    )  # fmt: skip


def _estimates(fit: LineFit, free: tuple[str, ...], unit: str, inflation: float, dof: float) -> Estimates:
    def named(name: str) -> tuple[str, str]:
        if name in ("xp", "yp"):
            return f"{name}_px", "px"
        power = SUFFIX.get(name, 0)
        if not power:
            return name, "1"
        digit = "" if power == 1 else str(power)
        return f"{name}_per_{unit}{digit}", f"1/{unit}" + digit.translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))

    names, units = zip(*(named(name) for name in free), strict=True)
    return Estimates(
        names, fit.q[fit.columns].copy(), inflation * fit.inverse(), np.full(len(free), dof), units,
        method="plumb lines: least squares on the conditions, variances along x and y from the residuals",
        confounders=("bent lines", "a sensor that is not flat"),
    )  # fmt: skip


def _lost(camera: CameraModel, estimates: Estimates, free: tuple[str, ...]) -> list[str]:
    """Parameters whose standard uncertainty would move the corner of the frame, or the centre, out of all bounds."""
    mx, my = camera.sensor.per_px
    corner = float(np.hypot(camera.sensor.cols * mx, camera.sensor.rows * my)) / 2
    pixel, lost = max(mx, my), []
    for name, u in zip(free, estimates.u, strict=True):
        moved = u if name in ("xp", "yp") else u * corner ** (SUFFIX.get(name, 0) + 1) / pixel
        if moved > (1 if name[0] in "pb" else 10) * LOST_REL * 2 * corner / pixel:
            lost.append(name)
    return lost


def _findings(
    estimates: Estimates,
    free: tuple[str, ...],
    axes: dict[str, AxisResiduals],
    used: np.ndarray,
    f_test: LinesFTest | None,
    inflation: float,
) -> tuple[Finding, ...]:
    found = []
    r = estimates.covariance / np.outer(estimates.u, estimates.u)
    for i, j in zip(*np.triu_indices(len(free), 1), strict=True):
        if abs(r[i, j]) > 0.95 and {free[i][0], free[j][0]} != {"k"}:
            text = f"{free[i]} and {free[j]} can hardly be separated (correlation {r[i, j]:+.3f})."
            found.append(Finding("correlation", text, "Use them together only, or hold one of them fixed.", "warning"))
    if len(axes) == 1:
        text = f"All lines determine {next(iter(axes))} only."
        found.append(Finding("direction", text, "Add an image with the camera rolled by 90°.", "warning"))
    if not used.all():
        text = f"{(~used).sum()} of {len(used)} positions do not lie on their lines and were left out."
        found.append(Finding("gross_error", text, "Check them in the image.", "warning"))
    if inflation > 1:
        text = (
            f"Errors of neighbours along the lines are correlated: the parameters' variances are {inflation:.1f} times those of "
            "independent positions."
        )
        advice = "Free more parameters, or check whether the lines are straight and the sensor flat."
        found.append(Finding("correlated_residuals", text, advice))
    if f_test is not None and f_test.p_px["lines"] < 0.05:
        found.append(Finding("line_jitter", f_test.text, "Check the line jitter of the frame grabber, or sample with the pixel clock."))
    return tuple(found)
