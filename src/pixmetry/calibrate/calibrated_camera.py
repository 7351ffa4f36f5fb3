"""A calibration in use: a camera's geometry in the parameters of the error sources, and the preset that takes lens and affinity over.

The bundle's model (`pixmetry.calibrate.bundle.model`) adds the lens's polynomial and the sensor's affinity in one place. A camera has them
in a row: the lens draws the image, then the sensor or the sampling shears it. The one is fitted to the other all over the frame, which also
turns the direction of the distortion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, POWERS, CameraModel
from pixmetry.calibrate.checks.causes import STRONG
from pixmetry.calibrate.files.record import StoredCalibration, read_calibration
from pixmetry.calibrate.records import Calibration, FieldSources, HeightMap, ImageScales, Seams
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.geometry import corner_px
from pixmetry.camera.observations import AFFINITY, LENS, TAKEN_UP, CameraGeometry, Observations
from pixmetry.camera.provenance import MEASURED
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates

UNFLATNESS, PIXEL_GEOMETRY, CLOCK_WARM_UP = "sensor.unflatness", "sensor.pixel_geometry", "grabber.clock_warm_up"
HEIGHTS = {(2, 0): "bow_x_um", (0, 2): "bow_y_um", (1, 1): "twist_um", (3, 0): "skew_x_um", (0, 3): "skew_y_um"}
WITHOUT_LENS = "without what lens and poses take up, as all that depends on the radius alone"
RARE = 1e-3
MOST_U_TAU = 0.5  # relative uncertainty above which a decay is not told
GRID = 25  # places along each side of the frame
LARGEST_PX = 0.05  # two models that differ by more are not the same camera
POLYNOMIAL = ("p1_per_mm", "p2_per_mm", "k1_per_mm2", "k2_per_mm4", "k3_per_mm6", "k4_per_mm8", "k5_per_mm10")
HIGH = {"k4", "k5"}  # of a model without them they are 0
FITTED = ("principal_distance_mm", "centre_x_px", "centre_y_px", "b1", "b2", *POLYNOMIAL)
UNITS = ("mm", "px", "px", "1", "1", "1/mm", "1/mm", "1/mm²", "1/mm⁴", "1/mm⁶", "1/mm⁸", "1/mm¹⁰")


def calibrated_geometry(
    calibration: str | Path | StoredCalibration | Calibration | CameraGeometry,
    camera: str | None = None,
    pitch_um: tuple[float, float] | None = None,
) -> CameraGeometry:
    """What a calibration says of one camera, in the parameters of the error sources.

    What it leaves over is what its residuals have in common at one place of the frame
    (`pixmetry.calibrate.checks.residual_grid.systematic_rest`): the noise of the targets is no error of the camera.

    Parameters
    ----------
    calibration : path, StoredCalibration, Calibration or CameraGeometry
        A ``calibration.json`` or the folder that holds it, or what was read or calibrated.
    camera : str, optional
        Name of the camera; may be left out if there is one.
    pitch_um : (float, float), optional
        Of the pixels, for a calibration that was made in pixels.

    Returns
    -------
    CameraGeometry

    Raises
    ------
    InputError
        If the calibration cannot be read, has no such camera, or there is no pixel pitch.
    """
    if isinstance(calibration, CameraGeometry):
        return calibration
    if isinstance(calibration, str | Path):
        calibration = read_calibration(calibration)
    if isinstance(calibration, Calibration):
        adjusted = calibration.adjustment
        models = tuple(adjusted.camera(k) for k in range(len(adjusted.network.cameras)))
        dofs = [adjusted.interior_dof(k) for k in range(len(models))]
        covariances = [adjusted.interior_covariance(k) for k in range(len(models))]
    else:
        models = calibration.cameras
        dofs = [calibration.interior_dof(k) for k in range(len(models))]
        covariances = [calibration.interior_covariance(k) for k in range(len(models))]
    names = [m.name for m in models]
    if camera is None and len(names) > 1 or camera is not None and camera not in names:
        remedy = "name it from Python: assess(…, calibration=calibrated_geometry(file, NAME))"
        raise InputError("the calibration has several cameras", value=camera, allowed=", ".join(names), remedy=remedy)
    k = 0 if camera is None else names.index(camera)
    by_residuals = (calibration.tests.field_sources or {}).get(names[k])
    record, grid = (calibration.tests.residuals or {}).get(names[k]), (calibration.tests.projection or {}).get(names[k])
    if record is None or grid is None or not record.n:
        raise InputError("no image coordinate of this camera took part", where=names[k], remedy="calibrate it, or name another camera")
    left = record.systematic_x_px or 0.0, record.systematic_y_px or 0.0
    sensor = models[k].sensor
    origin = f"calibration of {names[k]}, {sensor.cols} × {sensor.rows} px"
    u = float(np.sqrt(np.nanmean(grid.u_px**2)))
    model, (estimated, covariance) = models[k], covariances[k]
    if by_residuals is not None and by_residuals.height is not None and by_residuals.height.found:
        model, covariance = beside_height(model, estimated, covariance, by_residuals.height)
    if sensor.pitch_x_um is None:
        if pitch_um is None:
            remedy = "calibrate with pitch_um, or state the pitch in the campaign"
            raise InputError("a calibration in pixels, and the pixel pitch is not known", where=model.name, remedy=remedy)
        model, covariance = with_pitch(model, estimated, covariance, pitch_um)
    dof = float(np.min(dofs[k], initial=np.inf))  # one number for all: the least
    geometry = geometry_of(model, estimated, covariance, dof=dof, u_px=(u, u), left_px=left, origin=origin)
    told, untold = told_by_residuals(by_residuals, geometry, model) if by_residuals is not None else ({}, {})
    return replace(geometry, told=told, untold=untold)


def beside_height(model: CameraModel, names: tuple[str, ...], covariance: np.ndarray, height: HeightMap) -> tuple[CameraModel, np.ndarray]:
    """The model, and the covariance of its parameters, of an adjustment that had estimated the height of the sensor too."""
    change = np.zeros((len(names), len(height.coefficients_px)))
    for row, name in zip(height.lens_change, height.lens_names, strict=True):
        if name in names:
            change[names.index(name)] = row
    step = change @ height.coefficients_px
    values = {name: model[name] + float(part) for name, part in zip(names, step, strict=True)}
    return model.with_values(**values), covariance + change @ height.covariance_px2 @ change.T


def with_pitch(
    model: CameraModel, names: tuple[str, ...], covariance: np.ndarray, pitch_um: tuple[float, float]
) -> tuple[CameraModel, np.ndarray]:
    """A model in pixels, and the covariance of some of its parameters, with lengths in mm; the images of points do not change.

    Raises
    ------
    InputError
        If the pixels are not square: radial distortion in pixels then is none in mm.
    """
    x, y = pitch_um
    if not np.isclose(x, y, rtol=1e-6):
        what, remedy = "a calibration in pixels that are not square", "calibrate with pitch_x_um and pitch_y_um"
        raise InputError(what, where=model.name, value=f"{x:g} × {y:g} µm", allowed="square pixels", remedy=remedy)
    power = np.where(np.isin(NAMES, ["c"]) | (model.direction == "image_to_object"), POWERS, 0)
    factor = (x / 1000) ** power.astype(float)
    own = factor[[NAMES.index(name) for name in names]]
    changed = replace(model, sensor=replace(model.sensor, pitch_x_um=x, pitch_y_um=y), values=model.values * factor)
    return changed, covariance * np.outer(own, own)


def geometry_of(
    model: CameraModel,
    names: tuple[str, ...],
    covariance: np.ndarray,
    *,
    dof: float = np.inf,
    u_px: tuple[float, float] = (0.0, 0.0),
    left_px: tuple[float, float] = (0.0, 0.0),
    origin: str = "calibration",
) -> CameraGeometry:
    """Turn a calibrated model into the parameters of the sources, with their covariance.

    Parameters
    ----------
    model : CameraModel
        With a pixel pitch.
    names, covariance : tuple of str, ndarray
        Estimated parameters (out of `pixmetry.calibrate.bundle.model.NAMES`) and their covariance.
    dof : float
    u_px, left_px : (float, float)
        See `CameraGeometry`.
    origin : str

    Returns
    -------
    CameraGeometry

    Raises
    ------
    InputError
        If there is no pitch, or five radial and two tangential coefficients cannot hold the model.
    """
    if model.sensor.pitch_x_um is None:
        raise InputError("the pixel pitch is not known", where=model.name, remedy="calibrate with pitch_um, so that lengths are in mm")
    high = bool(HIGH & set(names) or any(model[name] for name in HIGH))
    values, largest = _fitted(model, high)
    if not high and not largest < LARGEST_PX:  # the inverse of a polynomial may need more terms
        high = True
        values, largest = _fitted(model, high)
    if not largest < LARGEST_PX:
        what = "the lens of a camera file (K1 to K5, P1, P2, affinity and shear) cannot represent this model"
        raise InputError(what, where=model.name, value=f"up to {largest:.2g} px apart", allowed=f"up to {LARGEST_PX} px")
    slopes = np.zeros((len(FITTED), len(names)))
    for j, name in enumerate(names):
        step = float(np.sqrt(covariance[j, j]))
        if step:
            ends = [_fitted(model.with_values(**{name: model[name] + s * step}), high)[0] for s in (-1, 1)]
            slopes[:, j] = (ends[1] - ends[0]) / (2 * step)
    n = len(FITTED)
    full = np.zeros((n + 2, n + 2))
    full[:n, :n] = slopes @ covariance @ slopes.T
    lens = Estimates(
        (*FITTED, "pitch_x_um", "pitch_y_um"),
        np.array([*values, model.sensor.pitch_x_um, model.sensor.pitch_y_um]),
        full,
        np.array([*[float(dof)] * n, np.inf, np.inf]),
        (*UNITS, "µm", "µm"),
        method=f"calibration with targets ({origin})",
    )
    return CameraGeometry(lens, *u_px, *left_px, origin)


def _fitted(model: CameraModel, high: bool) -> tuple[np.ndarray, float]:
    """The sources' parameters that see directions as the model does, and the largest difference over the frame in px.

    ``high``: K4 and K5 are among them; else they stay 0.
    """
    from scipy.optimize import least_squares

    sensor = model.sensor
    mx, my = sensor.per_px
    x0, y0 = sensor.centre
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, sensor.cols - 1, GRID), np.linspace(0, sensor.rows - 1, GRID)))
    u, v = model.direction_of(x, y)
    if not np.isfinite(u + v).all():
        raise InputError("the distortion has no inverse in a part of the frame", where=model.name, remedy="use fewer radial parameters")
    reach = float(np.hypot(x0 * mx, y0 * my))
    scale = np.array([model["c"], 1, 1, 1e-3, 1e-3, 1 / reach, 1 / reach, *reach ** (-2.0 * np.arange(1, 6))])
    count = len(FITTED) if high else len(FITTED) - len(HIGH)

    def misses(scaled: np.ndarray) -> np.ndarray:
        c, cx, cy, b1, b2, p1, p2, k1, k2, k3, k4, k5 = np.concatenate([scaled, np.zeros(len(scale) - count)]) * scale
        a = (x - x0 - b2 * (y - y0)) / (1 + b1)
        a, b = (a - cx) * mx, (y - y0 - cy) * my
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * k5))))
        ideal_a = a * radial + p1 * (r2 + 2 * a * a) + 2 * p2 * a * b
        ideal_b = b * radial + p2 * (r2 + 2 * b * b) + 2 * p1 * a * b
        return np.concatenate([(ideal_a / c - u) * model["c"] / mx, (ideal_b / c - v) * model["c"] / my])

    sign = -1.0 if model.direction == "image_to_object" else 1.0
    start = np.zeros(len(FITTED))
    start[:5] = model["c"], model["xp"] - x0, model["yp"] - y0, sign * model["b1"], sign * model["b2"] * my / mx
    fit = least_squares(misses, (start / scale)[:count], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return np.concatenate([fit.x, np.zeros(len(scale) - count)]) * scale, float(np.hypot(*misses(fit.x).reshape(2, -1)).max())


def told_by_residuals(found: FieldSources, geometry: CameraGeometry, model: CameraModel) -> tuple[dict[str, Estimates], dict[str, str]]:
    """What the residuals tell, in the parameters of the sources, and why they do not tell the others.

    Parameters
    ----------
    found : FieldSources
    geometry : CameraGeometry
        With the pitch.
    model : CameraModel
    """
    told: dict[str, Estimates] = {}
    untold: dict[str, str] = {}
    for source, made in (
        (UNFLATNESS, lambda: _unflatness(found.height, geometry, model)),
        (PIXEL_GEOMETRY, lambda: _pixel_geometry(found.seams, geometry.origin)),
        (CLOCK_WARM_UP, lambda: _clock_warm_up(found.scales, model.interface, geometry.origin)),
    ):
        one = made()
        if isinstance(one, str):
            untold[source] = one
        else:
            told[source] = one
    return told, untold


def _unflatness(height: HeightMap | None, geometry: CameraGeometry, model: CameraModel) -> Estimates | str:
    """Bow, twist and skew in µm, for chief rays from the principal distance; a height that was not found is 0 with its uncertainty."""
    if height is None:
        return "lens and poses take up all of a height here; take images rolled by 90 degrees, at several angles"
    if not height.found and height.rivals:
        return f"something else may explain its residuals as well: {', '.join(height.rivals)}; two focal lengths tell them apart"
    if not height.found and height.gain > STRONG:
        return (
            "a height would explain residuals, but displacements that no height makes come with it, other patterns explain more, or the "
            "images are fewer than 8; look at the patterns in the residuals, and take more images, rolled by 90 degrees"
        )
    pitch = geometry.lens["pitch_x_um"].value
    aspect = geometry.lens["pitch_y_um"].value / pitch
    distance = geometry.lens["principal_distance_mm"]
    tangent = corner_px((model.sensor.rows, model.sensor.cols), aspect) * pitch / (1000 * distance.value)
    degrees = list(zip(height.across, height.down, strict=True))
    rows = [degrees.index(one) for one in HEIGHTS]
    values, covariance = pitch * height.coefficients_px, pitch**2 * height.covariance_px2
    settings: dict[str, Any] = {}
    if not height.found:
        covariance = covariance + np.outer(values, values)  # as far as the estimate lies from 0, which is taken
        values = np.zeros_like(values)
        reason = "no height was found: 0, with what the residuals allow; " + WITHOUT_LENS
    else:
        reason = WITHOUT_LENS
        if len(degrees) > len(HEIGHTS):
            more = np.zeros((5, 5))
            for (i, j), value in zip(degrees, values, strict=True):
                if (i, j) not in HEIGHTS:
                    more[j, i] = value
            settings["more_um"] = tuple(map(tuple, more.tolist()))
            reason += "; the uncertainty of the shapes of the third and fourth degree beside them is not held"
    n = len(rows)
    full = np.zeros((n + 3, n + 3))
    full[:n, :n] = covariance[np.ix_(rows, rows)]
    chief = float(np.degrees(np.arctan(tangent)))
    full[n, n] = (np.degrees(tangent / (1 + tangent**2)) * distance.u / distance.value) ** 2
    names = (*HEIGHTS.values(), "chief_ray_deg", "pitch_x_um", "pitch_y_um")
    dof = np.full(n + 3, np.inf)
    dof[:n] = height.dof
    return Estimates(
        names, np.array([*values[rows], chief, pitch, aspect * pitch]), full, dof, (*["µm"] * n, "deg", "µm", "µm"),
        method=f"residuals of the {geometry.origin}, {height.rank} shapes told", confounders=("optics.distortion",),
        reasons={**dict.fromkeys(HEIGHTS.values(), reason), "chief_ray_deg": "rays from the principal distance are assumed"},
        settings=settings,
    )  # fmt: skip


def _pixel_geometry(seams: Seams | None, origin: str) -> Estimates | str:
    if seams is None:
        return "lens and poses take up all steps between parts of the frame"
    if seams.gain > STRONG and not seams.found:
        return "steps between parts of the frame are seen, but other patterns explain them as well; take images rolled by 90 degrees"
    method = f"steps between {seams.fields_x} × {seams.fields_y} fields in the residuals of the {origin}"
    if seams.found:
        fields: dict[str, Any] = {"fields_x": seams.fields_x, "fields_y": seams.fields_y}
        row = ("field_std_px", seams.std_px, seams.u_std_px, seams.dof, "px")
        reason = f"of {seams.fields_x} × {seams.fields_y} fields, from their steps; targets average over the places of single pixels"
        return Estimates.from_rows([row], method=method, settings=fields, reasons={"field_std_px": reason})
    row = ("field_std_px", seams.limit_px, seams.limit_px / 2, seams.dof, "px")
    reason = "no step is seen, with up to eight fields; targets average over the places of single pixels"
    return Estimates.from_rows([row], method=method, limits=frozenset({"field_std_px"}), reasons={"field_std_px": reason})


def _clock_warm_up(scales: ImageScales | None, interface: str | None, origin: str) -> Estimates | str:
    """Scale error of the clock at the first image, and its time constant."""
    if interface == "digital":
        return "the camera is digital: no frame grabber samples its lines"
    if scales is None:
        return "too few images"
    if interface is None:
        return "it is not told whether a frame grabber samples the lines; calibrate with interface: analogue if so"
    if scales.time_s is None or scales.covariance is None:
        return "the images have no times (time_s in the table of images)"
    u = np.sqrt(np.diag(scales.covariance))
    if scales.gain <= STRONG:
        size = "differ from image to image, but do not decay: the synchronisation scatters" if scales.p_differ < RARE else "are all alike"
        return f"the x-scales {size}"
    if u[1] > MOST_U_TAU * scales.tau_s or u[0] > MOST_U_TAU * abs(scales.start):
        return "the images end long before the clock has settled; take some an hour and more after switching on"
    reasons = {"scale_error_rel": "at the first image, which is taken for the time of switching on"}
    if scales.p_left is not None and scales.p_left < RARE:
        reasons["scale_tau_s"] = "the x-scales scatter about the decay; its uncertainty holds that"
    return Estimates(
        ("scale_error_rel", "scale_tau_s"), np.array([scales.start, scales.tau_s]), scales.covariance, np.full(2, scales.dof), ("1", "s"),
        method=f"x-scales of the images of the {origin}", confounders=("sensor.affinity",), reasons=reasons,
    )  # fmt: skip


def calibrated_camera(camera: Camera, geometry: CameraGeometry) -> Camera:
    """The camera with the calibrated lens and affinity, and without the sources that the calibration includes.

    Parameters
    ----------
    camera : Camera
        With the pixel pitch of the calibration.
    geometry : CameraGeometry

    Returns
    -------
    Camera
        Its facts have ``calibration`` and ``principal_distance_mm``; lens and affinity have their uncertainties, each with its own
        covariance. That between the two is not kept.

    Raises
    ------
    InputError
        If the pitches differ, or a value is out of a source's range.
    """
    pitch = tuple(geometry.lens[n].value for n in ("pitch_x_um", "pitch_y_um"))
    if camera.pitch_um is None or not np.allclose(camera.pitch_um, pitch, rtol=1e-6):
        allowed, remedy = str(camera.pitch_um), "calibrate with the pitch of the camera, or name the right camera"
        raise InputError("a calibration with another pixel pitch", where=camera.name, value=pitch, allowed=allowed, remedy=remedy)
    seen = Observations(geometry=geometry)
    chain = [e for e in camera.chain if e.source.id not in TAKEN_UP]
    at = next((i for i, e in enumerate(chain) if e.source.stage not in ("scene", "optics")), len(chain))
    for name in (AFFINITY, LENS):
        source = get_source(name, "calibrated camera")
        assert source.measure is not None  # both can be read from a geometry
        found = source.measure(seen)
        params = source.make({e.name: e.value for e in found}, where=f"{geometry.origin}, {name}")
        chain.insert(at, Element(name, source, params, known_from=MEASURED, estimates=found))
    for name in geometry.told:
        chain = _with_told(chain, name, at + 2, seen, geometry.origin)
    facts = {"calibration": geometry.origin, "principal_distance_mm": geometry.lens["principal_distance_mm"].value}
    return replace(camera, chain=tuple(chain), facts={**camera.facts, **facts})


def _with_told(chain: list[Element], name: str, at: int, seen: Observations, origin: str) -> list[Element]:
    """The chain with what the residuals tell of a source; one that they only bound is not put into a camera without it."""
    found = seen.by_residuals(where=name)
    there = next((i for i, e in enumerate(chain) if e.source.id == name), None)
    source = get_source(name, "calibrated camera")
    if there is None and (name != UNFLATNESS or not found.values[: len(HEIGHTS)].any()):
        return chain
    values = {e.name: e.value for e in found if not e.is_limit} | dict(found.settings)
    before = {} if there is None else chain[there].params.model_dump()
    if name == UNFLATNESS:
        before |= {"more_um": ()}
    params = source.make({**before, **values}, where=f"{origin}, {name}")
    made = Element(name if there is None else chain[there].name, source, params, known_from=MEASURED, estimates=found)
    return [*chain[:at], made, *chain[at:]] if there is None else [*chain[:there], made, *chain[there + 1 :]]
