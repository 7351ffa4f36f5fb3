"""A lens that was calibrated from straight lines: what is handed to the user, the page and the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.lines.plumb_line import PlumbLineResult
from pixmetry.calibrate.records import DistortionCurves
from pixmetry.core.finding import Finding

RADII = 101
TERMS = {"k1": 3, "k2": 5, "k3": 7, "k4": 9, "k5": 11}  # power of the radius


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
        """The camera; its c is 0 unless it was given: lines do not tell it."""
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
