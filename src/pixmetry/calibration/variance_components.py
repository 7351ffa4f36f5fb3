"""Variance components: how large the errors of x and of y of each camera are, from the residuals and their redundancy numbers.

The variance factor of a group g of observations is the iterated almost unbiased estimate

    f_g = Σ v (P v) / Σ r   over the group (v residuals, P = Q⁻¹ a priori weights, r redundancy numbers),

the covariances are multiplied by it (x by √f_x, y by √f_y, so that the correlation of x and y stays), and the network is adjusted again
until the factors are 1. Then sigma0 is 1, and what bars and control points say stands beside the image coordinates with its right weight.
For normal errors the covariance of the f_g is 2 S⁻¹, with S_gh the sum of the squares of the elements of Qvv P between the groups. Each
of its rows sums up to r; what a row has beside its own diagonal element, r (1 − r), is dealt out to the groups by their numbers of
observations. Without shares u(σ)/σ were 1/√(2 Σ r).

References
----------
W. Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979) 446–453; S. D. Horn, R. A. Horn, D. B. Duncan,
J. Amer. Stat. Assoc. 70 (1975) 380–385 (almost unbiased); K. R. Koch, Parameter Estimation and Hypothesis Testing (1999), 3.6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.calibration.network import Adjustment, Network
from pixmetry.calibration.snooping import Adjust, finest_factor

LEAST_DOF = 10.0  # redundancy below which a group does not get a factor of its own
ITERATIONS = 10
CLOSE = 0.02  # of its standard uncertainty, that a factor may still move


@dataclass(frozen=True)
class Components:
    """Standard deviations of the groups, and the adjustment that has them as its weights.

    Parameters
    ----------
    adjustment : Adjustment
    factor : ndarray, shape (cameras, 2)
        On the a priori variances of x and y.
    dof : ndarray, shape (cameras, 2)
        Sums of redundancy numbers.
    u_factor : ndarray, shape (cameras, 2)
        Relative standard uncertainty of ``factor``.
    estimated : ndarray of bool, shape (cameras, 2)
        False: too little redundancy; the factor is that of all image points together.
    iterations : int
    """

    adjustment: Adjustment
    factor: np.ndarray
    dof: np.ndarray
    u_factor: np.ndarray
    estimated: np.ndarray
    iterations: int

    def records(self) -> dict[str, dict[str, Any]]:
        """By camera: ``sigma_x_px``, ``u_sigma_x_px``, ``sigma_y_px``, ``u_sigma_y_px`` (rms over its image points), ``dof_x`` …."""
        network, used = self.adjustment.network, self.adjustment.used
        out: dict[str, dict[str, Any]] = {}
        for k, camera in enumerate(network.cameras):
            rows = used & (network.camera_of[network.image] == k)
            record: dict[str, Any] = {"iterations": self.iterations}
            for axis, name, column in ((0, "x", 0), (1, "y", 2)):
                sigma = float(np.sqrt(network.covariance_px2[rows, column].mean())) if rows.any() else float("nan")
                record |= {
                    f"sigma_{name}_px": sigma,
                    f"u_sigma_{name}_px": sigma * float(self.u_factor[k, axis]) / 2,
                    f"factor_{name}": float(self.factor[k, axis]),
                    f"dof_{name}": float(self.dof[k, axis]),
                    f"estimated_{name}": bool(self.estimated[k, axis]),
                }
            out[camera.name] = record
        return out


def estimate_components(adjustment: Adjustment, adjust: Adjust, *, by_axis: bool = True) -> Components:
    """Estimate the components and adjust with them.

    Parameters
    ----------
    adjustment : Adjustment
        With redundancy numbers.
    adjust : callable
        `bundle.adjust`, or the same with some options chosen.
    by_axis : bool
        For x and y of each camera; else one factor for all image coordinates.
    """
    total = np.ones((len(adjustment.network.cameras), 2))
    factor, dof, estimated = factors(adjustment, by_axis=by_axis)
    iterations = 0
    while iterations < ITERATIONS and (np.abs(factor - 1) > CLOSE * np.sqrt(2 / np.maximum(dof, 1.0))).any():
        iterations += 1
        total *= factor
        network = scaled(adjustment.network, factor)
        adjustment = adjust(network, adjustment.state, used=adjustment.used, redundancy=True)
        factor, dof, estimated = factors(adjustment, by_axis=by_axis)
    return Components(adjustment, total, dof, relative_u(adjustment), estimated, iterations)


def relative_u(adjustment: Adjustment) -> np.ndarray:
    """Relative standard uncertainties of the factors, shape (cameras, 2); inf for a group that cannot be told from the others."""
    network, used = adjustment.network, adjustment.used
    group = (2 * network.camera_of[network.image[used]][:, None] + [0, 1]).ravel()
    r, size = np.clip(adjustment.redundancy[used], 0.0, 1.0).ravel(), 2 * len(network.cameras)
    dof, beside, count = (np.bincount(group, weights, minlength=size) for weights in (r, r * (1 - r), None))
    there = dof > 0
    shared = np.outer(beside[there], count[there]) / count.sum()
    shared = (shared + shared.T) / 2
    S = shared + np.diag(dof[there] - shared.sum(axis=1))
    u = np.full(size, np.inf)
    u[there] = np.sqrt(2 * np.diag(np.linalg.inv(S))) if np.linalg.eigvalsh(S)[0] > 0 else np.inf
    return u.reshape(-1, 2)


def factors(adjustment: Adjustment, *, by_axis: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One step: factors on the variances of x and y of each camera, sums of redundancy numbers, and which of them are estimated.

    A group with too little redundancy gets the factor of all image points.
    """
    network, used = adjustment.network, adjustment.used
    shape = (len(network.cameras), 2)
    part = np.where(used[:, None], weighted_squares(adjustment), 0.0)
    redundancy = np.where(used[:, None], np.nan_to_num(adjustment.redundancy), 0.0)
    camera = network.camera_of[network.image]
    squares, dof = (np.stack([np.bincount(camera, a[:, i], minlength=shape[0]) for i in (0, 1)], axis=1) for a in (part, redundancy))
    common = squares.sum() / dof.sum() if dof.sum() >= LEAST_DOF and squares.sum() > 0 else 1.0
    least = finest_factor(network)
    if not by_axis:
        return np.full(shape, max(common, least)), dof, np.zeros(shape, bool)
    estimated = (dof >= LEAST_DOF) & (squares > 0)
    return np.maximum(np.where(estimated, squares / np.maximum(dof, LEAST_DOF), common), least), dof, estimated


def weighted_squares(adjustment: Adjustment) -> np.ndarray:
    """v (P v) of x and y, shape (n, 2)."""
    v, (xx, xy, yy) = adjustment.residual_px, adjustment.network.covariance_px2.T
    det = xx * yy - xy**2
    return np.column_stack([v[:, 0] * (yy * v[:, 0] - xy * v[:, 1]), v[:, 1] * (xx * v[:, 1] - xy * v[:, 0])]) / det[:, None]


def scaled(network: Network, factor: np.ndarray) -> Network:
    """The network with variances of x and y multiplied by factors, shape (cameras, 2); their correlation stays."""
    f = factor[network.camera_of[network.image]]
    by = np.column_stack([f[:, 0], np.sqrt(f[:, 0] * f[:, 1]), f[:, 1]])
    return replace(network, covariance_px2=network.covariance_px2 * by)


def image_sigma0(adjustment: Adjustment) -> tuple[float, float]:
    """sigma0 and redundancy of the image coordinates alone, without bars and control points."""
    used = adjustment.used
    dof = float(np.nansum(adjustment.redundancy[used]))
    return float(np.sqrt(weighted_squares(adjustment)[used].sum() / max(dof, 1e-12))), dof
