"""The linear rule of EMVA 1288 R4.0 for gain, noise, efficiency and saturation, to compare with other implementations."""

from __future__ import annotations

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import PhotonTransfer
from pixmetry.experiment.photon_transfer_model import MINIMUM_DARK_VAR_DN2, QUANTISATION_DN2


def fit_emva_linear(pt: PhotonTransfer) -> Estimates:
    """Gain, dark noise, efficiency and saturation by the linear rule of EMVA 1288 R4.0, for comparison with other implementations.

    K is the slope through the origin of σ²_y − σ²_y.dark against µ_y − µ_y.dark and R that of µ_y − µ_y.dark against the photons, both by
    ordinary least squares up to 70 % of saturation (eq. 49, 50), saturation being the maximum of the variance curve. σ²_y.dark
    is the intercept of the dark variance against exposure time, or the mean where there is one exposure.

    Raises
    ------
    MeasureError
        Fewer than two levels in the range, or no dark level.
    """
    order = np.argsort(pt.bright.mean_dn, kind="stable")
    dark = _dark_for(pt)
    mean = pt.bright.mean_dn[order] - dark[0][order]
    var = pt.bright.var_total_dn2[order] - dark[1][order]
    sat = int(np.argmax(pt.bright.var_total_dn2[order]))
    use = (np.arange(mean.size) <= sat) & (mean <= 0.7 * mean[sat]) & (mean > 0)
    if use.sum() < 2:
        what = "fewer than two levels below 70 % of saturation"
        raise MeasureError(what, where="photon transfer", value=int(use.sum()), remedy="add levels below saturation")
    x, y = mean[use], var[use]
    gain = float(x @ y / (x @ x))
    if gain <= 0:
        raise MeasureError("the variance does not grow with the mean", where="photon transfer", remedy="check lamp and saturation")
    n = pt.frame_shape[0] * pt.frame_shape[1]
    f = pt.bright.n_frames[order][use] - 1
    u_y = np.sqrt(2 / (n * f)) * np.hypot(pt.bright.var_total_dn2[order][use], dark[1][order][use])
    u_gain = float(np.sqrt(np.sum((x * u_y) ** 2)) / (x @ x))
    dark_var, u_dark_var = _dark_variance(pt, n)
    hidden = dark_var < MINIMUM_DARK_VAR_DN2
    noise = 0.40 / gain if hidden else np.sqrt(dark_var - QUANTISATION_DN2) / gain
    u_noise = np.hypot(noise * u_gain / gain, 0.0 if hidden else u_dark_var / (2 * noise * gain**2))
    rows = [
        ("gain_dn_per_e", gain, u_gain, np.inf, "DN/e-"),
        ("dark_noise_dn", np.sqrt(max(dark_var, 0)), u_dark_var / (2 * np.sqrt(max(dark_var, 1e-12))), np.inf, "DN"),
        ("dark_noise_e", noise, u_noise, np.inf, "e-"),
        ("saturation_dn", float(pt.bright.mean_dn[order][sat]), 0.0, np.inf, "DN"),
    ]
    reasons = {"saturation_dn": "mean of the level with the largest variance; no uncertainty in the standard"}
    if hidden:
        reasons["dark_noise_e"] = "dark variance below 0.24 DN²: bound 0.40/K (eq. 54)"
    if pt.bright.photons is not None:
        rows += _photon_rows(pt, order, use, sat, mean, gain, u_gain, dark_var)
    return Estimates.from_rows(
        rows,
        method="EMVA 1288 R4.0 linear rule: least squares through the origin up to 70 % of saturation",
        limits=frozenset({"dark_noise_e"} if hidden else ()),
        reasons=reasons,
    )


def _dark_for(pt: PhotonTransfer) -> tuple[np.ndarray, np.ndarray]:
    """Dark mean and variance that go with each bright level: at the nearest exposure, averaged over equal ones."""
    dark, t = pt.dark, pt.bright.exposure_s
    if dark.mean_dn.size == 0:
        raise MeasureError("no dark level", where="photon transfer", remedy="take dark frames at the same exposures")
    distance = np.abs(dark.exposure_s[None, :] - t[:, None])
    near = distance <= distance.min(axis=1, keepdims=True) * (1 + 1e-9) + 1e-15
    weight = near / near.sum(axis=1, keepdims=True)
    return weight @ dark.mean_dn, weight @ dark.var_total_dn2


def _dark_variance(pt: PhotonTransfer, n: int) -> tuple[float, float]:
    """Total dark variance at zero exposure (intercept over time), DN², and its standard uncertainty."""
    t, v = pt.dark.exposure_s, pt.dark.var_total_dn2
    if t.size < 3 or np.ptp(t) <= 0.2 * t.max():
        return float(v.mean()), float(v.mean() * np.sqrt(2 / (n * np.sum(pt.dark.n_frames - 1))))
    design = np.stack([np.ones_like(t), t / t.max()], axis=1)
    inverse = np.linalg.inv(design.T @ design)
    coefficient = inverse @ design.T @ v
    return float(coefficient[0]), float(np.sqrt(inverse[0, 0] * 2 / n) * v.mean())


def _photon_rows(pt, order, use, sat, mean, gain, u_gain, dark_var) -> list[tuple[str, float, float, float, str]]:
    """Responsivity, efficiency, saturation, threshold and dynamic range (EMVA 1288 R4.0 eq. 24-27, 49, 52)."""
    photons = pt.bright.photons[order]
    h, x = photons[use], mean[use]
    responsivity = float(h @ x / (h @ h))
    scatter = float(np.sqrt(np.sum((x - responsivity * h) ** 2) / (use.sum() - 1) / (h @ h)))
    efficiency = responsivity / gain
    u_eff = efficiency * np.hypot(u_gain / gain, scatter / responsivity)
    dof = float(use.sum() - 1)
    threshold = (np.sqrt(max(dark_var, 0)) / gain + 0.5) / efficiency
    top = float(photons[sat])
    inf = np.inf
    return [
        ("responsivity_dn_per_photon", responsivity, scatter, dof, "DN/photon"),
        ("quantum_efficiency", efficiency, u_eff, dof, "1"),
        ("saturation_photons", top, 0.0, inf, "photon"),
        ("saturation_e", top * efficiency, top * u_eff, dof, "e-"),
        ("threshold_photons", threshold, threshold * u_eff / efficiency, dof, "photon"),
        ("threshold_e", threshold * efficiency, u_gain / gain * threshold * efficiency, inf, "e-"),
        ("dynamic_range", top / threshold, top / threshold * u_eff / efficiency, dof, "1"),
        ("snr_max", np.sqrt(top * efficiency), 0.5 * np.sqrt(top / efficiency) * u_eff, dof, "1"),
    ]
