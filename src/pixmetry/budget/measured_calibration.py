"""A calibration that was made, in a budget: its lens, what it determined, and how well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pixmetry.budget.scenario import Scenario
from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.calibrated_camera import calibrated_camera, calibrated_geometry
from pixmetry.calibrate.files.record import StoredCalibration, read_calibration
from pixmetry.calibrate.records import Calibration
from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding

OF_LENS = {"b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5"}  # a calibration that has one of them is of a lens
SAME_PITCH = 0.01  # relative difference of pitches that are meant to be one


@dataclass(frozen=True)
class MeasuredCalibration:
    """What `pixmetry calibrate` found of a camera.

    Parameters
    ----------
    camera : CameraModel
        Adjusted.
    names, covariance : tuple of str, ndarray
        Estimated parameters and their covariance.
    model : str
        As of a scenario: what was determined.
    grid_px : float, optional
        Spacing of its residual grid.
    left_px : (float, float)
        What its residuals have in common at one place of the frame.
    images : int
    finding : Finding, optional
        Why its lens is not that of the budget's camera.
    """

    camera: CameraModel
    names: tuple[str, ...]
    covariance: np.ndarray
    model: str
    grid_px: float | None
    left_px: tuple[float, float]
    images: int
    finding: Finding | None = None

    @property
    def radial(self) -> int:
        """How many radial terms it has, at least 3: those that were estimated, or held at a value."""
        return max([3, *(int(n[1]) for n in ("k4", "k5") if n in self.names or self.camera[n])])

    def displacements(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        """Independent displacements of places by the noise of the parameters, shape (k, 2, n), px."""
        from pixmetry.calibrate.bundle.model import NAMES

        if not self.names:
            return np.zeros((0, 2, len(x_px)))
        u, v = self.camera.direction_of(x_px, y_px)
        by_parameter = np.nan_to_num(self.camera.projected(u, v)[3])[..., [NAMES.index(n) for n in self.names]]
        values, vectors = np.linalg.eigh(self.covariance)
        return np.einsum("naj,jk->kan", by_parameter, vectors * np.sqrt(np.maximum(values, 0.0)))


def measured_calibration(given: str | Path | StoredCalibration | Calibration, camera: Camera) -> MeasuredCalibration:
    """Read a calibration of this camera.

    Parameters
    ----------
    given : path, StoredCalibration or Calibration
        A ``calibration.json`` or its folder, or what was read or calibrated. Of several cameras, the one with the budget's name.
    camera : Camera

    Raises
    ------
    InputError
        If it cannot be read, or is of another camera: another name among several, format or pitch.
    """
    found = read_calibration(given) if isinstance(given, str | Path) else given
    if isinstance(found, Calibration):
        adjusted = found.adjustment
        models = tuple(adjusted.camera(k) for k in range(len(adjusted.network.cameras)))
        camera_of = adjusted.network.camera_of
        covariances = [adjusted.interior_covariance(k) for k in range(len(models))]
    else:
        models, camera_of = found.cameras, found.camera_of
        covariances = [found.interior_covariance(k) for k in range(len(models))]
    names = [m.name for m in models]
    if len(models) > 1 and camera.name not in names:
        remedy = "give the budget's camera the name that it has in the calibration"
        raise InputError("the calibration has several cameras", value=camera.name, allowed=", ".join(names), remedy=remedy)
    k = names.index(camera.name) if len(models) > 1 else 0
    model, (free, covariance) = models[k], covariances[k]
    check_same(model, camera)
    record, grid = (found.tests.residuals or {}).get(model.name), found.grids.get(model.name)
    left = (0.0, 0.0) if record is None else (record.systematic_x_px or 0.0, record.systematic_y_px or 0.0)
    state = "lens" if OF_LENS & set(free) or any(model[n] for n in OF_LENS) else "principal_point_and_scale"
    spacing = None if grid is None else float(max(np.diff(grid.x_px).max(), np.diff(grid.y_px).max()))
    return MeasuredCalibration(
        model, free, covariance, "residual_grid" if grid is not None else state, spacing, left, int(np.sum(np.asarray(camera_of) == k))
    )


def check_same(model: CameraModel, camera: Camera) -> None:
    """Refuse a calibration of another format or pitch.

    Raises
    ------
    InputError
    """
    sensor, (rows, cols) = model.sensor, camera.frame_shape
    if (sensor.rows, sensor.cols) != (rows, cols):
        raise InputError(
            "a calibration of frames of another size",
            where=model.name,
            value=f"{sensor.cols} × {sensor.rows} px",
            allowed=f"{cols} × {rows} px, as {camera.name} has",
            remedy="name the calibration of this camera, in this mode",
        )
    x, y = sensor.pitch_x_um, sensor.pitch_y_um
    if camera.pitch_um is None or x is None or y is None:
        return
    if not np.allclose((x, y), camera.pitch_um, rtol=SAME_PITCH):
        raise InputError(
            "a calibration with another pixel pitch",
            where=model.name,
            value=f"{x:g} × {y:g} µm",
            allowed=f"{camera.pitch_um[0]:g} × {camera.pitch_um[1]:g} µm, as {camera.name} has",
            remedy="name the calibration of this camera, or calibrate with its pitch",
        )


def with_lens(
    camera: Camera, given: str | Path | StoredCalibration | Calibration, made: MeasuredCalibration
) -> tuple[Camera, MeasuredCalibration]:
    """The camera with the measured lens and affinity; where these cannot be put into a camera, as it is, and the finding says so."""
    pitch = (made.camera.sensor.pitch_x_um, made.camera.sensor.pitch_y_um)
    mm = made.camera["c"] * (1.0 if pitch[0] is not None else 1e-3 * (camera.pitch_um or (0.0, 0.0))[0])
    lens = camera.facts.get("lens")
    told = dict(lens) if isinstance(lens, Mapping) else {}
    facts = {**camera.facts, "lens": {"f_mm": mm, **told}} if mm > 0 else camera.facts
    try:
        name = made.camera.name
        geometry = calibrated_geometry(given, name, camera.pitch_um)
        own = tuple(geometry.lens[n].value for n in ("pitch_x_um", "pitch_y_um"))
        measured = calibrated_camera(replace(camera, pitch_um=(own[0], own[1])), geometry)
        return replace(
            measured, pitch_um=camera.pitch_um or (own[0], own[1]), facts={**facts, **measured.facts, "lens": facts.get("lens")}
        ), made
    except InputError as problem:
        text = f"the lens of the budget is not that of the calibration: {problem.what}"
        return replace(camera, facts=facts), replace(made, finding=Finding("calibration_lens", text, problem.remedy))


def as_calibrated(scenario: Scenario, made: MeasuredCalibration) -> Scenario:
    """The scenario with what was calibrated, where it does not say it itself."""
    told = scenario.calibration
    changes = {"model": made.model} if "model" not in told.model_fields_set else {}
    if made.grid_px is not None and "grid_px" not in told.model_fields_set:
        changes["grid_px"] = made.grid_px  # type: ignore[assignment]
    return scenario.model_copy(update={"calibration": told.model_copy(update=changes)})
