"""Iterated generalised least squares with variance components, for the photon-transfer model.

Parameters by Gauss-Newton, wander of the black level and lamp noise by restricted maximum likelihood (Patterson & Thompson 1971,
Biometrika 58, 545) in the same loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.observe import photon_transfer_model as model
from pixmetry.observe.photon_transfer_levels import MINIMUM_LEVELS, NONLINEARITY_PRIOR
from pixmetry.observe.photon_transfer_model import (
    A1,
    A3,
    DARK_SLOPE,
    DARK_VAR,
    DARK_VAR_SLOPE,
    GAIN,
    LIGHT_OFFSET,
    OFFSET,
    Q_MEAN,
    Q_VAR,
    SLOPE,
)

UNDAMPED = 8  # iterations before the variance components move by half steps
LACK_OF_FIT_Z = 3.0902323  # normal quantile of a false alarm of 0.1 %


@dataclass
class Solution:
    """State of the fit: parameters, their covariance and the variance components."""

    p: np.ndarray
    free: np.ndarray
    components: np.ndarray  # wander of the level means (DN²), relative lamp variance, relative excess variance of the mean squares
    estimated: np.ndarray  # which of these are estimated
    covariance: np.ndarray = field(default_factory=lambda: np.zeros(0))  # of all parameters, zero where fixed
    components_cov: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance_by: np.ndarray = field(default_factory=lambda: np.zeros(0))  # derivative of the covariance by each component
    chi2: float = 0.0
    chi2_dof: int = 0
    top_z: float = 0.0  # residual of the variance at the brightest level over its standard deviation


def _free_parameters(d: model.Levels) -> np.ndarray:
    """Which parameters these levels can carry."""
    free = np.ones(len(model.PARAMETERS), bool)
    times = d.time[~d.bright]
    free[[Q_MEAN, Q_VAR]] = times.size > 0
    free[LIGHT_OFFSET] = times.size > 0
    free[[DARK_SLOPE, DARK_VAR_SLOPE]] = times.size >= 3 and np.ptp(times) > 0.2 * times.max()
    free[DARK_VAR_SLOPE] &= not model.is_hidden(d)
    return free


def _start(d: model.Levels, free: np.ndarray) -> tuple[np.ndarray, float]:
    """Values to start from, by linear least squares one after the other, and the wander of the dark means."""
    p = np.zeros(len(model.PARAMETERS))
    dark, h, y = ~d.bright, d.light[d.bright], d.mean[d.bright]
    wander = 1e-4
    if free[DARK_SLOPE]:
        p[DARK_SLOPE], p[OFFSET] = np.polyfit(d.time[dark], d.mean[dark], 1)
        wander = float(np.var(d.mean[dark] - p[OFFSET] - p[DARK_SLOPE] * d.time[dark])) + 1e-12
    else:
        low = h <= np.median(h)
        p[OFFSET] = d.mean[dark].mean() if dark.any() else np.polyfit(h[low], y[low], 1)[1]
    y = y - p[OFFSET] - p[DARK_SLOPE] * d.time[d.bright]
    weight = 1 / np.sqrt(d.ms[d.bright] / d.pixels + (1e-3 * y) ** 2 + wander)
    slope = np.sum(weight**2 * h * y) / np.sum(weight**2 * h**2)
    u = slope * h / d.x_ref
    design = np.stack([u, u**2, u**3, u**4], axis=1) * d.x_ref * weight[:, None]
    ridge = np.diag([0, *[1 / NONLINEARITY_PRIOR] * 3])
    c = np.linalg.lstsq(np.vstack([design, ridge]), np.concatenate([y * weight, np.zeros(4)]), rcond=None)[0]
    bend = c[1:] / c[0] ** np.arange(2, 5)
    p[SLOPE], p[A1 : A3 + 1] = (slope * c[0], bend) if np.abs(bend).max() < 0.5 else (slope, 0.0)
    x = p[SLOPE] * h
    bent = model.transfer(x, p[A1 : A3 + 1], d.x_ref)[1] ** 2
    ms = (d.ms[d.bright] - model.QUANTISATION_DN2) / bent
    gain, ms0 = np.polyfit(x, ms, 1, w=1 / np.maximum(ms, 0.1))
    p[DARK_VAR] = max((d.ms[dark].mean() - model.QUANTISATION_DN2) if dark.any() else ms0, 1e-4)
    p[GAIN] = max(gain, 1e-6)
    return p, wander


@dataclass
class _Step:
    """One linearisation with its weights: what both the parameters and the variance components need."""

    lin: model.Linearised
    jac: np.ndarray
    vi: np.ndarray
    vij: np.ndarray
    normal_inv: np.ndarray  # covariance of the free parameters
    shift: np.ndarray


def _unsettled() -> MeasureError:
    what = "the fit does not settle: the levels do not follow a camera with a smooth, nearly linear response"
    return MeasureError(what, where="photon transfer", remedy="leave out spoilt levels; raise the black level")


def _step(d: model.Levels, s: Solution, prior: np.ndarray) -> _Step:
    with np.errstate(all="ignore"):  # a trial step may lead anywhere
        lin = model.linearise(s.p, d)
        vi = model.inverse_blocks(lin, s.components)
    if not (np.isfinite(lin.residual).all() and np.isfinite(lin.jacobian).all() and np.isfinite(vi).all()):
        raise _unsettled()
    jac = lin.jacobian[:, s.free]
    vij = vi @ jac
    precision = prior[s.free]
    normal = jac.T @ vij + np.diag(precision)
    scale = 1 / np.sqrt(np.diag(normal))
    normal_inv = np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    shift = normal_inv @ (vij.T @ lin.residual - precision * s.p[s.free])
    return _Step(lin, jac, vi, vij, normal_inv, shift)


def _reml(step: _Step, s: Solution, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One Fisher-scoring step of the variance components, and their information matrix.

    Score −½[tr(PD) − rᵀPDPr] and information ½tr(PDPD'), P = V⁻¹ − V⁻¹J(JᵀV⁻¹J)⁻¹JᵀV⁻¹ (Patterson & Thompson 1971).
    """
    n = step.lin.g.size
    random = prior[s.free] > 0  # parameters with a prior are random effects of zero mean: they belong to the residual
    r = step.lin.residual + step.jac[:, random] @ s.p[s.free][random]
    big_p = step.vi - step.vij @ step.normal_inv @ step.vij.T
    pr = big_p @ r
    partner = np.r_[n : 2 * n, 0:n]
    pds, score = [], np.zeros(3)
    for k, (diag, off) in enumerate(model.component_shapes(step.lin)):
        pd = big_p * diag + big_p[:, partner] * off
        pds.append(pd)
        score[k] = -0.5 * (np.trace(pd) - pr @ (diag * pr + off * pr[partner]))
    info = 0.5 * np.array([[np.sum(a * b.T) for b in pds] for a in pds])
    return score, info


def _update_components(s: Solution, score: np.ndarray, info: np.ndarray) -> np.ndarray:
    """Fisher scoring with the components kept at or above zero."""
    c = s.components
    active = s.estimated & ((c > 0) | (score > 0))
    new = np.zeros(3)
    while active.any():
        at = np.flatnonzero(active)
        new = np.zeros(3)
        new[at] = c[at] + _inverse(info[np.ix_(at, at)]) @ score[at]
        if (new >= 0).all():
            break
        active &= new > 0
        new = np.maximum(new, 0)
    return new


def _inverse(info: np.ndarray) -> np.ndarray:
    scale = 1 / np.sqrt(np.maximum(np.diag(info), 1e-300))
    return np.linalg.pinv(info * np.outer(scale, scale), rcond=1e-9, hermitian=True) * np.outer(scale, scale)


def _damping(s: Solution, shift: np.ndarray) -> float:
    """Share of a step that keeps the gain within a factor of two and the non-linearity within what the expansion carries."""
    change = np.zeros(s.p.size)
    change[s.free] = np.abs(shift)
    return float(min(1.0, 0.5 * s.p[GAIN] / max(change[GAIN], 1e-300), 0.2 / max(change[A1 : A3 + 1].max(), 1e-300)))


def _solve(d: model.Levels, prior: np.ndarray, start: np.ndarray | None = None, excess: bool = False) -> Solution:
    """Iterate parameters and variance components together until both stand still."""
    free = _free_parameters(d)
    p, wander = _start(d, free)
    components = np.array([wander, 1e-6, 1e-5 if excess else 0.0])
    s = Solution(np.where(free, p if start is None else start, 0.0), free, components, np.array([True, True, excess]))
    for iteration in range(40):
        step = _step(d, s, prior)
        s.p[free] += step.shift * _damping(s, step.shift)
        sigma = np.sqrt(np.diag(step.normal_inv))
        score, info = _reml(step, s, prior)
        new = _update_components(s, score, info) if iteration else s.components
        if iteration >= UNDAMPED:  # a component at its bound may go to and fro
            new = 0.5 * (new + s.components)
        still = iteration > 1 and np.all(np.abs(new - s.components) <= 2e-3 * s.components + 1e-12)
        s.components = new
        if still and np.all(np.abs(step.shift) < 1e-3 * sigma):
            break
    step = _step(d, s, prior)
    if not np.all(np.abs(step.shift) < 0.5 * np.sqrt(np.diag(step.normal_inv))):
        raise _unsettled()
    _, info = _reml(step, s, prior)
    return _finish(d, s, step, info)


def _finish(d: model.Levels, s: Solution, step: _Step, info: np.ndarray) -> Solution:
    """Covariances, their derivatives by the components, and the lack-of-fit sum of the variances."""
    n_par, index = s.p.size, np.ix_(np.flatnonzero(s.free), np.flatnonzero(s.free))
    s.covariance = np.zeros((n_par, n_par))
    s.covariance[index] = step.normal_inv
    s.components_cov = np.zeros((3, 3))
    known = np.ix_(s.estimated, s.estimated)
    s.components_cov[known] = _inverse(info[known])
    s.covariance_by = np.zeros((3, n_par, n_par))
    n = d.mean.size
    partner = np.r_[n : 2 * n, 0:n]
    for k, (diag, off) in enumerate(model.component_shapes(step.lin)):
        inner = step.vij.T @ (diag[:, None] * step.vij + off[:, None] * step.vij[partner])
        s.covariance_by[k][index] = step.normal_inv @ inner @ step.normal_inv
    r = step.lin.residual
    v_ms = step.lin.v_ms + step.lin.g**2 * s.components[0]
    s.chi2 = float(np.sum(r[n:] ** 2 / v_ms))
    top = int(np.argmax(d.light))
    s.top_z = float(r[n + top] / np.sqrt(v_ms[top]))
    s.chi2_dof = max(n - int(s.free[[GAIN, DARK_VAR, DARK_VAR_SLOPE]].sum()), 1)
    return s


def fit_range(levels: model.Levels, keep: np.ndarray, prior: np.ndarray) -> tuple[Solution, np.ndarray]:
    """Fit; where the variances contradict the model, leave out the brightest level while it falls below, else widen.

    A tenth of the levels at most is left out: a knee bends few levels below the peak of the variance. What remains is taken as a
    relative scatter of the variances beyond their sampling law, a third variance component.

    Returns the solution and which levels it used.
    """
    trial, start = keep.copy(), None
    for _ in range(1 + max(1, int((keep & levels.bright).sum()) // 10)):
        s = _solve(levels.subset(trial), prior, start)
        if s.chi2 < _chi2_limit(s.chi2_dof):
            return s, trial
        bright = np.flatnonzero(trial & levels.bright)
        knee = s.top_z < -LACK_OF_FIT_Z and s.top_z**2 > 0.1 * (s.chi2 - s.chi2_dof)  # not one of many that scatter
        if bright.size <= MINIMUM_LEVELS or not knee:
            break
        trial[bright[np.argmax(levels.light[bright])]] = False
        start = s.p
    return _solve(levels.subset(keep), prior, s.p if trial[keep].all() else None, excess=True), keep


def _chi2_limit(dof: int) -> float:
    """Upper 0.1 % point of chi-squared (Wilson & Hilferty 1931)."""
    return dof * (1 - 2 / (9 * dof) + LACK_OF_FIT_Z * np.sqrt(2 / (9 * dof))) ** 3
