"""Measured targets as their templates draw them: pixel by pixel, with what they leave of the frame and the gains of the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.noise import NoiseModel


@dataclass(frozen=True)
class Spread:
    """What correlated noise makes of the covariance of a target: factors of its variances, and what is added to the correlation of x and y.

    Parameters
    ----------
    factor : ndarray, shape (parameters,)
        Of the variance of each parameter, those of x and y first.
    cross : float
        Covariance of x and y over the root of the product of their variances for independent pixels, which correlated noise adds.
    """

    factor: np.ndarray
    cross: float


@dataclass(frozen=True)
class Drawn:
    """A fitted target as its template draws it, in a window of its own.

    Parameters
    ----------
    mean : ndarray, shape (side, side)
        Grey values, DN.
    jacobian : ndarray, shape (parameters, side, side)
        Their derivatives; by x and y first.
    mask : ndarray of bool, shape (side, side)
        Pixels that are used.
    residual : ndarray, shape (side, side)
        What it leaves of the frame, DN; 0 outside of the mask.
    away_px : ndarray, shape (side, side)
        Distance from the outline along the line to the centre, of a spot from the centre.
    turn_rad : ndarray, shape (side, side)
        Direction from the centre, from x towards y.
    height_dn : float
    """

    mean: np.ndarray
    jacobian: np.ndarray
    mask: np.ndarray
    residual: np.ndarray
    away_px: np.ndarray
    turn_rad: np.ndarray
    height_dn: float

    def gains(self, noise: NoiseModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Noise of each pixel, DN; gains of the parameters, rows of (JᵀWJ)⁻¹JᵀW, times that noise; an orthonormal basis of W^½ J."""
        sigma = np.sqrt(noise.variance_dn2(self.mean))
        white = np.where(self.mask, self.jacobian / sigma, 0.0).reshape(len(self.jacobian), -1)
        scale = np.sqrt((white**2).sum(axis=1, keepdims=True))
        basis, triangle = np.linalg.qr((white / scale).T)
        shape = (-1, *self.mean.shape)
        return sigma, (np.linalg.pinv(triangle, rcond=1e-9) @ basis.T / scale).reshape(shape), basis.T.reshape(shape)


def drawn_target(frame: np.ndarray, targets: Targets, positions: Positions, i: int, kind: str, aperture_px: float) -> Drawn:
    """One measured target as its template draws it."""
    from pixmetry.locate.template.template import PARAMETERS, PLANES, model
    from pixmetry.locate.template.template_fit import REACH, start_values

    one = targets[i : i + 1]
    # an ellipse's own unknowns follow from its axes and direction, which stand in the table
    shape = {n: positions.more[n][i : i + 1] for n in ("semi_major_px", "semi_minor_px", "angle_deg", "blur_px") if n in positions.more}
    one = replace(one, **shape)
    start, outer, edge = start_values(one, kind, aperture_px)
    names = (*PARAMETERS[kind], *PLANES)
    given = {"x_px": positions.x_px[i], "y_px": positions.y_px[i]} | {n: v[i] for n, v in positions.more.items() if n in names}
    values = {n: float(given.get(n, v)) for n, v in zip(names, start[0], strict=True)}
    reach = float(outer[0] + REACH * edge[0] + 1)
    half = int(np.ceil(reach))
    row, col = round(values["y_px"]), round(values["x_px"])
    local = values | {"x_px": values["x_px"] - col + half, "y_px": values["y_px"] - row + half}
    side = 2 * half + 1
    mean, jacobian = model(kind, np.array(list(local.values())), side, side, aperture_px=aperture_px)
    base = len(PARAMETERS[kind])
    ground, light = ((positions.flags[i] & f) != 0 for f in (Flag.UNEVEN_BACKGROUND, Flag.GRADIENT))
    used = [*range(base), *([base, base + 1] if ground else []), *([base + 2, base + 3] if light else [])]
    y, x = np.ogrid[:side, :side]
    mask = np.hypot(x - local["x_px"], y - local["y_px"]) <= reach
    rows, cols = np.arange(row - half, row + half + 1), np.arange(col - half, col + half + 1)
    mask &= ((rows >= 0) & (rows < frame.shape[0]))[:, None] & ((cols >= 0) & (cols < frame.shape[1]))
    seen = frame[np.ix_(np.clip(rows, 0, frame.shape[0] - 1), np.clip(cols, 0, frame.shape[1] - 1))].astype(float)
    across, down = x - local["x_px"], y - local["y_px"]
    away = np.hypot(across, down)
    if kind == "ellipse":
        xx, yy, xy = (local[f"shape_{n}_px"] for n in ("xx", "yy", "xy"))
        # the outline is S(cos t, sin t): a place is |S⁻¹ d| times as far from the centre as the outline is there
        far = np.hypot(yy * across - xy * down, xx * down - xy * across) / (xx * yy - xy * xy)
        away = away - away / np.maximum(far, 1e-9)
    elif kind != "spot":
        away = away - local["radius_px"]
    height = abs(local["amplitude_dn"]) if kind != "spot" else float(np.abs(mean - local["background_dn"]).max())
    return Drawn(mean, jacobian[used], mask, np.where(mask, seen - mean, 0.0), away, np.arctan2(down, across), max(height, 1e-30))
