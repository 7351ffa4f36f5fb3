"""How the image follows the temperature of the sensor, from a series in which it goes up and down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.series.modes import FieldMotion

MODES = {"scale_rel": ("scale_per_k", "1/K"), "shift_x_px": ("shift_x_px_per_k", "px/K"), "shift_y_px": ("shift_y_px_per_k", "px/K")}
SETTLING = (0.02, 0.05, 0.1, 0.17, 0.3)  # time constants over the length of the series, by which the image may settle besides
LEAST_FRAMES = 20
LEAST_K, LEAST_SHARE = 0.3, 0.08  # rms of what the time does not explain of the temperature, and over its standard deviation
METHOD = "regression of the image's motion on the temperature of the sensor, beside a drift with time"
CONFOUNDERS = ("sensor.mount_drift",)


def thermal_of(motion: FieldMotion, time_s: Array, temperature_c: Array) -> tuple[Estimates, FieldMotion]:
    """Scale and shift of the image over the temperature, and the motion without them.

    Parameters
    ----------
    motion : FieldMotion
    time_s, temperature_c : ndarray, shape (frames,)

    Returns
    -------
    Estimates
        ``scale_per_k`` (mount less sensor: both move the image alike), ``shift_x_px_per_k``, ``shift_y_px_per_k``, ``reference_c`` (mean of
        the series); or ``reasons`` why they are not told.
    FieldMotion

    Notes
    -----
    All modes have one design (constant, temperature, time, five exponentials), so that least squares of each is that of all together, with
    the covariance of the residuals between them (A. Zellner, J. Am. Stat. Assoc. 57 (1962) 348–368). Where residuals are correlated from
    frame to frame all u grow by √((1 + ρ)/(1 − ρ)). What drifts with time in another shape than these is no part of the temperature's.
    """
    used = motion.used & np.isfinite(temperature_c)
    time, temperature = time_s[used], temperature_c[used]
    reason = _refused(time, temperature)
    if reason:
        return replace(Estimates.empty(), reasons={name: reason for name, _ in MODES.values()}), motion
    middle = float(temperature.mean())
    design = np.column_stack([temperature - middle, _drifts(time)])
    which = [motion.modes.index(mode) for mode in MODES]
    seen = motion.values[used][:, which]
    inverse = np.linalg.pinv(design.T @ design)
    slopes = inverse @ design.T @ seen
    left = seen - design @ slopes
    dof = len(left) - np.linalg.matrix_rank(design)
    order = np.argsort(time)
    rho = float((left[order][1:] * left[order][:-1]).sum(axis=0).mean() / (left**2).sum(axis=0).mean()) if (left**2).any() else 0.0
    longer = (1 + max(rho, 0.0)) / (1 - min(max(rho, 0.0), 0.95))
    covariance = inverse[0, 0] * (left.T @ left) / dof * longer
    full = np.zeros((4, 4))
    full[:3, :3] = covariance
    found = Estimates(
        (*(name for name, _ in MODES.values()), "reference_c"),
        np.array([*slopes[0], middle]),
        full,
        np.array([*[dof / longer] * 3, np.inf]),
        (*(unit for _, unit in MODES.values()), "°C"),
        method=METHOD,
        confounders=CONFOUNDERS,
        reasons={
            "scale_per_k": "mount less sensor, which move the image alike; silicon has 2.6e-6 1/K. The field must keep its temperature"
        },
    )
    values = motion.values.copy()
    values[:, which] -= np.where(used, temperature_c - middle, 0.0)[:, None] * slopes[0]
    return found, replace(motion, values=values)


def _drifts(time_s: Array) -> Array:
    """Constant, time, and five exponentials, shape (frames, 7), each of unit length."""
    t = (time_s - time_s.min()) / max(float(np.ptp(time_s)), 1e-9)
    columns = np.column_stack([np.ones_like(t), t - t.mean(), *(np.exp(-t / tau) for tau in SETTLING)])
    return np.asarray(columns / np.linalg.norm(columns, axis=0))


def _refused(time_s: Array, temperature_c: Array) -> str:
    """Why the temperature tells nothing; empty if it does."""
    if len(time_s) < LEAST_FRAMES:
        return f"{len(time_s)} frames with a temperature; {LEAST_FRAMES} or more are needed"
    rest = _drifts(time_s)
    own = temperature_c - rest @ np.linalg.lstsq(rest, temperature_c, rcond=None)[0]
    size, of_all = float(np.sqrt(np.mean(own**2))), float(temperature_c.std())
    if of_all < LEAST_K:
        return f"the temperature changes by {of_all:.2g} K only (standard deviation); let it change by some kelvin"
    if size < max(LEAST_K, LEAST_SHARE * of_all):
        return (
            "the temperature only follows the time, as the drift of the mount does, and the two are not told apart; let it go up and down "
            "after the camera has settled"
        )
    return ""
