"""A calibrated camera in the parameters of the error sources: the lens's polynomial and the sensor's affinity, one after the other.

The bundle's model (`pixmetry.calibrate.bundle.model`) adds both in one place. A camera has them in a row: the lens draws the image, then
the sensor or the sampling shears it. The one is fitted to the other all over the frame, which also turns the direction of the distortion.
"""

from __future__ import annotations

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.camera.observations import CameraGeometry
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates

CELLS = (10, 8)  # of the frame, in which residuals have something in common or not
GRID = 25  # places along each side of the frame
LARGEST_PX = 0.05  # two models that differ by more are not the same camera
LENS = ("p1_per_mm", "p2_per_mm", "k1_per_mm2", "k2_per_mm4", "k3_per_mm6")
FITTED = ("principal_distance_mm", "centre_x_px", "centre_y_px", "b1", "b2", *LENS)
UNITS = ("mm", "px", "px", "1", "1", "1/mm", "1/mm", "1/mm²", "1/mm⁴", "1/mm⁶")


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
        If there is no pitch, or three radial and two tangential coefficients cannot hold the model.
    """
    if model.sensor.pitch_x_um is None:
        raise InputError("the pixel pitch is not known", where=model.name, remedy="calibrate with pitch_um, so that lengths are in mm")
    values, largest = _fitted(model)
    if not largest < LARGEST_PX:
        what = "the sources' lens (K1 to K3, P1, P2, affinity and shear) cannot hold this model"
        raise InputError(what, where=model.name, value=f"up to {largest:.2g} px apart", allowed=f"up to {LARGEST_PX} px")
    slopes = np.zeros((len(FITTED), len(names)))
    for j, name in enumerate(names):
        step = float(np.sqrt(covariance[j, j]))
        if step:
            ends = [_fitted(model.with_values(**{name: model[name] + s * step}))[0] for s in (-1, 1)]
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


def _fitted(model: CameraModel) -> tuple[np.ndarray, float]:
    """The sources' parameters that see directions as the model does, and the largest difference over the frame in px."""
    from scipy.optimize import least_squares

    sensor = model.sensor
    mx, my = sensor.per_px
    x0, y0 = sensor.centre
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, sensor.cols - 1, GRID), np.linspace(0, sensor.rows - 1, GRID)))
    u, v = model.direction_of(x, y)
    if not np.isfinite(u + v).all():
        raise InputError("the distortion has no inverse in a part of the frame", where=model.name, remedy="use fewer radial parameters")
    reach = float(np.hypot(x0 * mx, y0 * my))
    scale = np.array([model["c"], 1, 1, 1e-3, 1e-3, 1 / reach, 1 / reach, reach**-2, reach**-4, reach**-6])

    def misses(scaled: np.ndarray) -> np.ndarray:
        c, cx, cy, b1, b2, p1, p2, k1, k2, k3 = scaled * scale
        a = (x - x0 - b2 * (y - y0)) / (1 + b1)
        a, b = (a - cx) * mx, (y - y0 - cy) * my
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        ideal_a = a * radial + p1 * (r2 + 2 * a * a) + 2 * p2 * a * b
        ideal_b = b * radial + p2 * (r2 + 2 * b * b) + 2 * p1 * a * b
        return np.concatenate([(ideal_a / c - u) * model["c"] / mx, (ideal_b / c - v) * model["c"] / my])

    sign = -1.0 if model.direction == "image_to_object" else 1.0
    start = np.zeros(len(FITTED))
    start[:5] = model["c"], model["xp"] - x0, model["yp"] - y0, sign * model["b1"], sign * model["b2"] * my / mx
    fit = least_squares(misses, start / scale, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return fit.x * scale, float(np.hypot(*misses(fit.x).reshape(2, -1)).max())


def systematic_rest(adjustment: Adjustment, index: int = 0) -> tuple[float, float]:
    """What the residuals of a camera have in common at one place of the frame, in x and y, px: a standard deviation over the frame.

    The component between cells of the frame in a one-way analysis of variance with random effects (Searle, Casella, McCulloch, Variance
    Components, 1992, 3.6); 0 where the cells differ no more than noise makes them. Noise of single points is no error of the camera.
    """
    network = adjustment.network
    sensor = network.cameras[index].sensor
    own = adjustment.used & (network.camera_of[network.image] == index)
    col = np.clip(network.x_px[own] / sensor.cols * CELLS[0], 0, CELLS[0] - 1).astype(int)
    row = np.clip(network.y_px[own] / sensor.rows * CELLS[1], 0, CELLS[1] - 1).astype(int)
    _, cell, counts = np.unique(row * CELLS[0] + col, return_inverse=True, return_counts=True)
    n, cells = len(cell), len(counts)
    if cells < 2 or n <= cells:
        return 0.0, 0.0
    per_cell = (n - (counts**2).sum() / n) / (cells - 1)
    rest = []
    for v in adjustment.residual_px[own].T:
        means = np.bincount(cell, v) / counts
        between = (counts * (means - v.mean()) ** 2).sum() / (cells - 1)
        within = ((v - means[cell]) ** 2).sum() / (n - cells)
        rest.append(float(np.sqrt(max(between - within, 0.0) / per_cell)))
    return rest[0], rest[1]
