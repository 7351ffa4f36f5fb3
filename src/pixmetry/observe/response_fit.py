"""The response curve of a camera (OECF) from patches of known light.

Each curve is fitted to the means of all patches by least squares, with the light among the unknowns as far as it is not known: the error of
each patch's density, uneven light and glare, the brightness of the parts of a scene, the error of each exposure time. All of these have
standard deviations beforehand, or none. Curves are compared by BIC (G. Schwarz, Ann. Statist. 6 (1978) 461). The noise of the patches, over
the slope of the curve, then tells how many electrons a unit of light makes.

What the means do not tell: the scale of the light. So of a pure power y = b + A L^γ only b, A and γ are known. The gain K of the straight
signal x and the reference at which curve and straight line meet change the same frames in the same way, K ~ reference^(−(1 − γ)/γ); the
reference is set to the largest code, and K is stated for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.response import BENT, BT709, CUBIC, CURVES, KNEE, LINEAR, LOG, POWER, CurveFit, Patch, Response, toed_power
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.patches import CLIPPED_SHARE, LEAST_LEVELS, Found
from pixmetry.observe.photon_transfer_levels import unclipped_bright

U_CHART_REL, U_EXPOSURE_REL = 0.02, 0.002  # of the light of a patch and of an exposure, where nothing was stated
UNEVEN_REL = 0.05  # standard deviation of slopes and bow of the light over half of the chart
GLARE_REL = 0.003  # light that the lens scatters, of the brightest patch, and the standard deviation of that
BEND_REL = 0.01  # of a cubic non-linearity in front of a curve
CUBIC_REL = 0.1  # of its coefficients where it is the curve itself
HIGHER = 0.5  # of the bend of a noisy mean, times the relative variance of its light: what second order may be wrong by
LEAST_DOUBT = 0.1  # of the u of a mean: less adds 0.5 %
DISTANT = 100.0  # BIC by which a curve is so much worse that what it says of noise does not count
CLEARLY = 10.0  # BIC by which a curve must be better
MISFIT = 25.0  # χ² per degree of freedom: no curve describes the values
ITERATIONS, RESTING = 60, 1e-7
HELD_U = 1e-6  # of a parameter that is held
KNEE_AT, KNEES_LN, KNEE_PLACES = 2, (-3.0, -0.05), 40  # which parameter; logarithms of the light where a knee is put
KT_PER_Q_V, ZERO_C_K, ROOM_C = 8.617333262e-5, 273.15, 20.0
POINTS = 101
DARK_SHARE = 0.1  # of the noise in the dark, by which dark current may lift its mean behind a curve that is steep at black
MODEL_VAR = 1e-6  # relative, of a patch's variance beside its sampling
NOISY = 0.25  # of its light: a patch so noisy does not tell the electrons
METHOD = (
    "least squares of the patches' means with errors of the light among the unknowns; electrons from their noise over the curve's slope"
)
THROUGH_STRAIGHT_LINE = (  # what the photon transfer of a straight response states; wrong behind a curve
    *("gain_dn_per_e", "dark_noise_e", "row_noise_e", "column_noise_e", "quantum_efficiency", "responsivity_dn_per_s"),
    *("full_well_e", "dark_current_e_per_s", "nonlinearity_a1", "nonlinearity_a2", "nonlinearity_a3", "illumination_noise_rel"),
)
HINT = {
    POWER: "a power curve (gamma)",
    BT709: "a power curve with a straight toe, as in BT.709 and sRGB",
    LOG: "a logarithmic curve",
    KNEE: "two straight lines with a knee",
    CUBIC: "a straight line with a cubic bend",
    LINEAR: "a straight line",
}
NAMES: Mapping[str, tuple[str, ...]] = {  # black, scale, then the parameters of the shape
    LINEAR: (),
    CUBIC: ("a1", "a2", "a3"),
    POWER: ("gamma", "a1", "a2"),
    BT709: ("gamma", "reach", "a1", "a2"),
    LOG: ("foot",),
    KNEE: ("switch", "slope"),
}


def curve_dn(curve: str, theta: Array, light: Array, top_dn: float) -> Array:
    """Stored value for light (1: the brightest patch); ``theta`` is black, logarithm of the scale, shape.

    The scale is the signal at light 1, of curves with a toe their reference; ``reach`` is the logarithm of the share of the reference at
    light 1, ``foot`` and ``switch`` that of a light.
    """
    black, scale, shape = theta[0], np.exp(np.clip(theta[1], -30, 30)), theta[2:]
    light = np.asarray(light, float)
    if curve == LINEAR:
        return black + scale * light
    if curve == CUBIC:
        x = scale * light
        w = x / top_dn
        return black + x * (1 + w * (shape[0] + w * (shape[1] + w * shape[2])))
    if curve == LOG:
        return black + scale * np.log1p(np.maximum(light, 0) / np.exp(np.clip(shape[0], -40, 10)))
    if curve == KNEE:
        at = np.exp(np.clip(shape[0], -20, 5))
        return black + scale * np.where(light > at, at + shape[1] * (light - at), light)
    gamma = float(np.clip(shape[0], 0.05, 3.0))
    bent = np.maximum(light * (1 + light * (shape[-2] + light * shape[-1])), 0.0)
    if curve == POWER:
        return black + scale * bent**gamma
    return black + scale * toed_power(np.exp(np.clip(shape[1], -20, 5)) * bent, gamma, curve)


@dataclass(frozen=True)
class _Data:
    """Values, their light, and what may be wrong with it: columns of ln(light) with their standard deviations (inf: not known)."""

    y: Array
    u: Array
    spread: Array
    light: Array
    columns: Array
    prior: Array
    glare: bool
    white: Array  # of the white sheet at each patch; NaN without
    top_dn: float
    black: tuple[float, float, float] | None  # mean of the dark frames, its u, and their noise


def data_of(found: Found, bits: int, black: tuple[float, float, float] | None) -> _Data:
    """Set up the errors of the light."""
    patches = found.patches
    y, u, spread, light = (np.array([getattr(p, n) for p in patches], float) for n in ("mean_dn", "u_mean_dn", "spread_dn2", "light_rel"))
    place, picture = (np.array([getattr(p, n) for p in patches]) for n in ("place", "picture"))
    white = np.array([found.white_dn.get((p.x, p.y), (np.nan, 0))[0] for p in patches])
    columns: list[Array] = []
    prior: list[float] = []
    if found.scene:
        brightest = int(np.argmax(y))  # its light is 1
        anchor, light = place[brightest], light / light[brightest]
        u_rel = found.u_light_rel or U_EXPOSURE_REL
        for p in np.unique(place):
            if p != anchor:
                columns.append((place == p).astype(float))
                prior.append(np.inf)
        for k in np.unique(picture):
            columns.append((picture == k).astype(float))
            prior.append(u_rel)
        columns.append(light.min() / light)  # an offset of all exposure times
        prior.append(u_rel)
    else:
        u_rel = found.u_light_rel or U_CHART_REL
        for p in np.unique(place):
            columns.append((place == p).astype(float))
            prior.append(u_rel)
        if not np.isfinite(white).all():
            for values in _field([p.x + 0.5 * p.cols for p in patches], [p.y + 0.5 * p.rows for p in patches]):
                columns.append(values)
                prior.append(UNEVEN_REL)
    return _Data(
        y=y,
        u=np.maximum(u, 1e-3),
        spread=spread,
        light=light if found.scene else light / light.max(),
        columns=np.stack(columns, axis=1),
        prior=np.array(prior),
        glare=not found.scene,
        white=white,
        top_dn=2.0**bits - 1,
        black=black,
    )


def _field(x: list[float], y: list[float]) -> list[Array]:
    """Slopes and bow of uneven light over the patches, at most about 1."""
    out = []
    scaled = []
    for v in (np.array(x), np.array(y)):
        half = 0.5 * float(np.ptp(v))
        scaled.append((v - v.mean()) / half if half > 0 else np.zeros(len(v)))
    out += [s for s in scaled if s.any()]
    bow = scaled[0] ** 2 + scaled[1] ** 2
    return [*out, bow - bow.mean()] if np.ptp(bow) > 0 else out


@dataclass(frozen=True)
class _Fit:
    curve: str
    theta: Array
    covariance: Array  # of theta, black and shape; the errors of the light are marginalised
    chi2: float
    dof: int
    bic: float
    log_det: float  # of the inverse covariance of all unknowns


def _model(curve: str, d: _Data, theta: Array, glare: float, shift: Array) -> tuple[Array, Array]:
    """Expected means of noisy pixels, and their slopes by ln(light)."""
    light = d.light * np.exp(shift) + glare
    if np.isfinite(d.white).all():
        light = light * _relative_light(curve, theta, d.white, d.top_dn)
    value, slope, _ = _noisy_mean(curve, d, theta, light)
    return value, slope


def _noisy_mean(curve: str, d: _Data, theta: Array, light: Array) -> tuple[Array, Array, Array]:
    """Means of noisy pixels at these lights, by second order, slopes by ln(light), and what the higher orders may add.

    Of a power curve the fourth order is (γ − 2)(γ − 3)/4 times the second one times (σ/light)², about 1 for γ = 0.45, and the third order
    takes half of it or more off again.
    """
    h = 1e-3
    low, here, high = (curve_dn(curve, theta, light * f, d.top_dn) for f in (1 - h, 1.0, 1 + h))
    slope = (high - low) / (2 * h)
    second = (high - 2 * here + low) / h**2
    relative = d.spread / np.maximum(np.abs(slope), 1e-9) ** 2
    bend = np.zeros(len(here)) if curve == KNEE else np.clip(0.5 * second * relative, -0.3 * np.abs(here), 0.3 * np.abs(here))
    return here + bend, slope, np.abs(bend) * np.minimum(HIGHER * relative, 1.0)


def _relative_light(curve: str, theta: Array, white: Array, top_dn: float) -> Array:
    """Light at the patches over their mean, from a white sheet seen through the curve."""
    light = _light_at(curve, theta, white, top_dn)
    out: Array = light / light.mean()
    return out


def _fit_from(curve: str, d: _Data, theta: Array, held: int | None = None) -> _Fit | None:
    """Descent of Levenberg and Marquardt from one start; a parameter of the curve that is held stays as it is."""
    k, m = len(theta), d.columns.shape[1]
    extra = 1 if d.glare else 0
    p = np.concatenate([theta, np.zeros(extra), np.zeros(m)])
    names = NAMES[curve]
    weight = np.zeros(len(p))  # inverse variances beforehand
    prior_mean = np.zeros(len(p))
    if d.black is not None:
        steep = DARK_SHARE * d.black[2] if curve in (POWER, BT709) else 0.0
        weight[0], prior_mean[0] = 1 / (d.black[1] ** 2 + steep**2), d.black[0]
    for i, name in enumerate(names):
        if name in ("a1", "a2", "a3"):
            weight[2 + i] = (CUBIC_REL if curve == CUBIC else BEND_REL) ** -2
    if held is not None:
        weight[held], prior_mean[held] = HELD_U**-2, theta[held]
    if extra:
        weight[k], prior_mean[k] = GLARE_REL**-2, GLARE_REL
    known = np.isfinite(d.prior)
    weight[k + extra :][known] = d.prior[known] ** -2
    if not d.glare:  # parts of a scene begin where the curve puts them
        shift = np.log(np.maximum(_light_at(curve, theta, d.y, d.top_dn), 1e-9) / d.light)
        free = ~known
        for j in np.flatnonzero(free):
            own = d.columns[:, j] > 0
            p[k + extra + j] = np.median(shift[own])

    def state(p: Array) -> tuple[Array, Array, float]:
        glare = float(p[k]) if extra else 0.0
        value, slope = _model(curve, d, p[:k], glare, d.columns @ p[k + extra :])
        r = (d.y - value) / d.u
        return r, slope, float(r @ r + (weight * (p - prior_mean) ** 2).sum())

    r, slope, cost = state(p)
    damping = 1e-3
    with np.errstate(all="ignore"):
        for _ in range(ITERATIONS):
            jacobian = _jacobian(curve, d, p, k, extra, slope)
            normal = jacobian.T @ jacobian + np.diag(weight)
            gradient = jacobian.T @ r - weight * (p - prior_mean)
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-12))
            moved = False
            for _ in range(8):
                try:
                    step = np.linalg.solve(normal / np.outer(scale, scale) + damping * np.eye(len(p)), gradient / scale) / scale
                except np.linalg.LinAlgError:
                    damping *= 10
                    continue
                new = p + step
                r_new, slope_new, cost_new = state(new)
                if np.isfinite(cost_new) and cost_new <= cost:
                    moved = True
                    break
                damping = max(damping * 10, 1e-6)
            if not moved:
                break
            fall = cost - cost_new
            p, r, slope, cost, damping = new, r_new, slope_new, cost_new, max(damping / 10, 1e-9)
            if fall < RESTING * max(cost, 1.0):
                break
        jacobian = _jacobian(curve, d, p, k, extra, slope)
        normal = jacobian.T @ jacobian + np.diag(weight)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    if not np.isfinite(cost) or not np.isfinite(values).all() or values[0] < 1e-11:
        return None
    covariance = ((vectors / values) @ vectors.T) / np.outer(scale, scale)
    dof = len(d.y) - k - int((~known).sum()) + sum(1 for n in names if n in ("a1", "a2", "a3"))
    log_det = float(np.log(values).sum() + 2 * np.log(scale).sum())
    return _Fit(curve, p[:k], covariance[:k, :k], cost, max(dof, 1), cost + k * np.log(len(d.y)), log_det)


def _with_other_knees(best: _Fit, d: _Data) -> _Fit:
    """The fit, with the covariance about it of all knees that fit, by their probability.

    Between two patches, where no light was, the place of a knee is a matter of the slopes on both sides, and more than one place may fit.
    So the knee is put at many places, the rest is fitted, and each counts by likelihood × volume that is left to the rest (Laplace).
    """
    u = float(np.sqrt(best.covariance[KNEE_AT, KNEE_AT]))
    places = np.concatenate([np.linspace(*KNEES_LN, KNEE_PLACES), best.theta[KNEE_AT] + u * np.linspace(-3, 3, 13)])
    places = np.unique(places[(places >= KNEES_LN[0]) & (places <= KNEES_LN[1])])
    widths, tried = [], []
    for place, width in zip(places, np.gradient(places), strict=True):
        start = best.theta.copy()
        start[1] += np.log(_bent_light(best.theta)) - np.log(_bent_light(np.append(start[:KNEE_AT], [place, start[3]])))
        start[KNEE_AT] = place
        fit = _fit_from(KNEE, d, start, KNEE_AT)
        if fit is not None and _lawful(fit):
            widths.append(width)
            tried.append(fit)
    if not tried:
        return best
    ratio = max(best.chi2 / best.dof, 1.0)
    log_weight = np.array([-0.5 * (f.chi2 / ratio + f.log_det) for f in tried]) + np.log(widths)
    weights = np.exp(log_weight - log_weight.max())
    away = [f.theta - best.theta for f in tried]
    spread = sum(w * (f.covariance + np.outer(a, a) / ratio) for w, f, a in zip(weights, tried, away, strict=True)) / weights.sum()
    return replace(best, covariance=np.asarray(spread, float))


def _bent_light(theta: Array) -> float:
    """Signal at light 1 over the scale, behind a knee."""
    at = float(np.exp(theta[KNEE_AT]))
    return at + float(theta[3]) * (1 - at)


def _jacobian(curve: str, d: _Data, p: Array, k: int, extra: int, slope: Array) -> Array:
    glare, shift = (float(p[k]) if extra else 0.0), d.columns @ p[k + extra :]
    out = np.empty((len(d.y), len(p)))
    for i in range(k + extra):
        h = 1e-4 * max(abs(p[i]), 1.0) if i == 0 else 1e-5
        ends = []
        for sign in (1, -1):
            moved = p[: k + extra].copy()
            moved[i] += sign * h
            ends.append(_model(curve, d, moved[:k], float(moved[k]) if extra else glare, shift)[0])
        out[:, i] = (ends[0] - ends[1]) / (2 * h)
    out[:, k + extra :] = slope[:, None] * d.columns
    out /= d.u[:, None]
    return out


def _starts(curve: str, d: _Data) -> list[Array]:
    """Where the descents begin."""
    brightest = float(d.y.max())
    blacks = [d.black[0]] if d.black is not None else [0.0, 0.9 * float(d.y.min())]
    out = []
    for black in blacks:
        scale = float(np.log(max(brightest - black, 1.0)))
        if curve in (LINEAR, CUBIC):
            out.append([black, scale, *(0.0 for _ in NAMES[curve])])
        elif curve == POWER:
            out += [[black, scale, g, 0.0, 0.0] for g in (0.45, 0.8)]
        elif curve == BT709:
            reference = float(np.log(max(d.top_dn - black, 1.0)))
            out += [[black, reference, 0.45, 2.2 * (scale - reference), 0.0, 0.0]]
        elif curve == LOG:
            out += [[black, scale - np.log(np.log1p(1 / c)), np.log(c)] for c in (0.3, 0.01, 0.001)]
        else:
            out += [[black, scale - np.log(at + 0.4 * (1 - at)), np.log(at), 0.4] for at in (0.15, 0.3, 0.6)]
    return [np.array(v, float) for v in out]


def fit_curves(d: _Data) -> list[_Fit]:
    """All curves that can be fitted, the best first; a straight one unless another is clearly better.

    Where noise is a large part of the light, a mean is known no better than its bend: u is widened by what any likely curve says of that.
    """
    fits = _fits(d)
    near = [f for f in fits if f.bic < fits[0].bic + DISTANT]
    doubts = [_noisy_mean(f.curve, d, f.theta, _light_at(f.curve, f.theta, d.y, d.top_dn))[2] for f in near]
    if doubts and (np.max(doubts, axis=0) > LEAST_DOUBT * d.u).any():
        fits = _fits(replace(d, u=np.hypot(d.u, np.max(doubts, axis=0))))
    if not fits:
        return []
    fits = [_with_other_knees(f, d) if f.curve == KNEE and f.bic < fits[0].bic + CLEARLY else f for f in fits]
    close = [f for f in fits if f is fits[0] or (f.curve in (LINEAR, CUBIC) and f.bic < fits[0].bic + CLEARLY)]
    best = min(close, key=lambda f: CURVES.index(f.curve))
    return [best, *(f for f in fits if f is not best)]


def _fits(d: _Data) -> list[_Fit]:
    """All curves that can be fitted, by their BIC."""
    fits = []
    for curve in CURVES:
        if len(d.y) <= len(NAMES[curve]) + 2:
            continue
        found = [f for f in (_fit_from(curve, d, start) for start in _starts(curve, d)) if f is not None and _lawful(f)]
        if found:
            fits.append(min(found, key=lambda f: f.chi2))
    return sorted(fits, key=lambda f: f.bic)


def _lawful(f: _Fit) -> bool:
    """Whether a shape is one that a camera can have: a curve that is straight counts as the straight one."""
    if f.curve in (POWER, BT709):
        return 0.1 < f.theta[2] < 0.97 and (f.curve == POWER or -12 < f.theta[3] < 3)
    if f.curve == KNEE:
        return bool(-6 < f.theta[2] < -0.05 and 0.02 < f.theta[3] < 0.97)
    if f.curve == LOG:
        return bool(-14 < f.theta[2] < 0)
    return True


# ---- from the fit to results -----------------------------------------------------------------------------------------------------------


def fit_response(found: Found, bits: int, seen: Observations) -> Response:
    """The response of a camera from patches.

    Parameters
    ----------
    found : Found
    bits : int
        Bits of a stored value.
    seen : Observations
        What dark and bright frames told: black level, and noise at other levels.

    Returns
    -------
    Response
        Without a curve, with the reason, where the patches are too few or no curve describes them.
    """
    alone = Response(found.patches, found.refused)
    if not found.patches:
        return _refused(alone, found.refused[0] if found.refused else "no patches")
    levels = len(np.unique([round(p.mean_dn / max(3 * np.sqrt(p.spread_dn2), 1.0)) for p in found.patches]))
    if len(found.patches) < LEAST_LEVELS or levels < LEAST_LEVELS:
        what = f"{min(levels, len(found.patches))} levels that differ, and {LEAST_LEVELS} or more are needed"
        return _refused(alone, f"{what}{f' ({found.refused[0]})' if found.refused else ''}")
    lights = np.array([p.light_rel for p in found.patches])
    if found.scene and np.bincount([p.place for p in found.patches]).max() < 3:
        return _refused(alone, "no part of the scene is well exposed in three pictures: take more exposures, in steps of a factor of 2")
    if not found.scene and lights.max() < 4 * lights.min():
        return _refused(alone, "the patches differ by less than a factor of 4 in light: take a longer wedge")
    d = data_of(found, bits, black_of(seen))
    fits = fit_curves(d)
    if not fits:
        return _refused(alone, "no curve could be fitted")
    best = fits[0]
    tried = tuple(CurveFit(f.curve, f.chi2, f.dof, f.bic) for f in fits)
    ratio = best.chi2 / best.dof
    if ratio > MISFIT:
        misfit = f"χ² is {ratio:.0f} per degree of freedom"
        why = f"no known curve describes the patches ({misfit}): uneven light, a moving scene or wrong densities"
        return replace(_refused(alone, why), tried=tried)
    return _result(alone, d, fits, tried, seen, max(ratio, 1.0))


def _refused(response: Response, why: str) -> Response:
    return replace(response, fit=replace(Estimates.empty(), reasons={"gamma": why}))


def black_of(seen: Observations) -> tuple[float, float, float] | None:
    """Mean of the dark frames, its u, and the noise of a pixel in them; None without, or where they are clipped.

    Behind a curve that is steep at black, dark current lifts the mean of noisy codes by a share of their noise (`DARK_SHARE`).
    """
    transfer = seen.photon_transfer
    if transfer is None or not transfer.dark.mean_dn.size or transfer.dark.fraction_min.max() > CLIPPED_SHARE:
        return None
    dark = transfer.dark
    mean = float(np.average(dark.mean_dn, weights=dark.n_frames))
    scatter = float(dark.mean_dn.std(ddof=1)) if dark.mean_dn.size > 1 else 0.0
    noise = np.sqrt(float(dark.ms_pixel_dn2.mean()))
    rounding = np.sqrt(min(np.exp(-4 * np.pi**2 * noise**2) / (2 * np.pi**2), 1 / 12))
    return mean, float(np.linalg.norm([scatter, 0.02 * noise, rounding, 1e-3])), float(noise)


def _result(alone: Response, d: _Data, fits: list[_Fit], tried: tuple[CurveFit, ...], seen: Observations, widen: float) -> Response:
    best = fits[0]
    covariance = best.covariance * widen
    grid = np.geomspace(max(1e-4, 0.5 * d.light.min()), 1.0, POINTS)
    level = curve_dn(best.curve, best.theta, grid, d.top_dn)

    def light_at(theta: Array) -> Array:
        found = _light_at(best.curve, theta, level, d.top_dn)
        out: Array = np.log(found / found[-1])
        return out

    steps = _root(covariance)
    u_light = np.sqrt(sum((0.5 * (light_at(best.theta + s) - light_at(best.theta - s))) ** 2 for s in steps.T))
    names, units, functions = _named(best.curve)
    reasons: dict[str, str] = {}
    limits: set[str] = set()
    told = _electrons(best, d, alone.patches, seen, steps)
    values = [f(best.theta) for f in functions]
    gradients = np.array([[_slope_of(f, best.theta, i) for i in range(len(best.theta))] for f in functions])
    joint = gradients @ covariance @ gradients.T
    dof = [float(best.dof)] * len(names)
    gain = np.full(POINTS, np.nan)
    extra = None
    if isinstance(told, _Electrons):
        gain = np.gradient(level, grid) * told.values[0] / told.light_scale
        extra = _noise_rows(best, told, steps, seen.temperature_c, reasons, limits)
    else:
        reasons |= {"gain_dn_per_e": told, "foot_e": told}
    if best.curve == LOG and seen.temperature_c is None:
        reasons["gain_dn_per_v"] = f"at {ROOM_C:g} °C, for the temperature of the sensor was not stated; a slope factor of 1"
    if best.curve == LINEAR:
        power = next((f for f in fits if f.curve == POWER), None)
        gamma, u = straight_gamma(d, best, power)
        names, units, values, dof = (*names, "gamma"), (*units, "1"), [*values, 1.0], [*dof, float(best.dof)]
        joint = _extended(joint, [float(np.hypot(gamma - 1, u)) * np.sqrt(widen)])
        reasons["gamma"] = f"the patches follow a straight line; the exponent that fits best is {gamma:.3f} ± {u:.3f}"
    if extra is not None:
        across = gradients @ steps @ extra.changes.T
        joint = np.block([[joint, across], [across.T, extra.covariance + extra.changes @ extra.changes.T]])
        names, units = (*names, *extra.names), (*units, *extra.units)
        values, dof = [*values, *extra.values], [*dof, *(np.inf for _ in extra.names)]
    notes = []
    for f in fits[1:]:
        if f.bic < best.bic + (CLEARLY if best.curve in BENT and f.curve in BENT else 0.0):
            notes.append(f"{HINT[best.curve]} describes the patches, and {HINT[f.curve]} about as well: darker or more patches tell which")
            share = 1 / (1 + np.exp(np.clip(0.5 * (f.bic - best.bic), -30, 30)))
            others = dict(zip(_named(f.curve)[0], (g(f.theta) for g in _named(f.curve)[2]), strict=True))
            away = np.array([others.get(n, v) - v if n in ("gamma", "black_dn") else 0.0 for n, v in zip(names, values, strict=True)])
            joint = joint + share * np.outer(away, away)  # either curve may be the true one (mixture by BIC)
    if widen > 1.5:
        notes.append(f"the patches scatter about their curve {np.sqrt(widen):.1f} times as much as stated; u is widened by that")
    reasons |= _why_not(best.curve, values[names.index("gamma")] if "gamma" in names else 1.0)
    fit = Estimates(
        tuple(names),
        np.array(values, float),
        joint,
        np.array(dof),
        tuple(units),
        METHOD,
        ("uneven light, glare and wrong densities bend the curve", "noise behind the curve counts as noise of electrons"),
        limits=frozenset(limits),
        reasons=reasons,
    )
    return replace(
        alone,
        curve=best.curve,
        tried=tried,
        level_dn=level,
        light_rel=grid,
        u_light_rel=u_light,
        gain_dn_per_e=gain,
        fit=fit,
        choices=_choices(best.curve),
        notes=tuple(notes),
    )


def straight_gamma(d: _Data, best: _Fit, power: _Fit | None) -> tuple[float, float]:
    """Exponent that describes the patches best, and its u, where a straight line does too."""
    start = np.array([best.theta[0], best.theta[1], 1.0, 0.0, 0.0])
    found = _fit_from(POWER, d, start) or power
    if found is None:
        return 1.0, 0.1
    return float(found.theta[2]), float(np.sqrt(found.covariance[2, 2]))


def _choices(curve: str) -> dict[str, dict[str, str]]:
    if curve in (POWER, BT709):
        return {"electronics.gamma": {"toe": "none" if curve == POWER else curve}}
    if curve == KNEE:
        return {"electronics.hdr_gain": {"mode": "knee"}}
    return {"sensor.log_response": {"mode": "log"}} if curve == LOG else {}


def _why_not(curve: str, gamma: float) -> dict[str, str]:
    """Why the other curves' parameters are not there."""
    is_curve = f"the camera's response is {HINT[curve]}"
    out = {}
    if curve == POWER:
        out["reference_dn"] = "not separable from the gain behind a pure power curve: it is set to the largest code"
        if abs(gamma - 0.5) < 0.02:
            out["gamma"] = "an exponent of 0.5 is that of a square-root table (companding without expansion) too"
    if curve not in (POWER, BT709, LINEAR):
        out["gamma"] = is_curve
    if curve != KNEE:
        out["switch_dn"] = is_curve
    if curve != LOG:
        out["gain_dn_per_v"] = is_curve
    if curve != CUBIC:
        out["nonlinearity_a1"] = is_curve
    return out


def _named(curve: str) -> tuple[tuple[str, ...], tuple[str, ...], list[Callable[[Array], float]]]:
    """Names and units of a curve's results, and how they follow from its parameters."""
    names: list[str] = ["black_dn"]
    units = ["DN"]
    functions: list[Callable[[Array], float]] = [lambda t: float(t[0])]
    if curve in (POWER, BT709):
        names.append("gamma")
        units.append("1")
        functions.append(lambda t: float(t[2]))
    if curve == BT709:
        names.append("reference_dn")
        units.append("DN")
        functions.append(lambda t: float(np.exp(t[1])))
    if curve == KNEE:
        names += ["switch_dn", "mismatch_rel"]
        units += ["DN", "1"]
        functions += [lambda t: float(np.exp(t[1] + t[2])), lambda t: float(t[3] - 1)]
    if curve == CUBIC:
        names += [f"nonlinearity_a{i}" for i in (1, 2, 3)]
        units += ["1"] * 3
        functions += [lambda t, i=i: float(t[1 + i]) for i in (1, 2, 3)]  # type: ignore[misc]
    return tuple(names), tuple(units), functions


def _slope_of(function: Callable[[Array], float], theta: Array, i: int) -> float:
    h = 1e-5 * max(abs(float(theta[i])), 1.0)
    low, high = theta.copy(), theta.copy()
    low[i] -= h
    high[i] += h
    return (function(high) - function(low)) / (2 * h)


def _extended(covariance: Array, u: list[float]) -> Array:
    n, m = len(covariance), len(u)
    out = np.zeros((n + m, n + m))
    out[:n, :n] = covariance
    out[n:, n:] = np.diag(np.square(u))
    return out


def _root(covariance: Array) -> Array:
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    lengths, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    out: Array = scale[:, None] * directions * np.sqrt(np.maximum(lengths, 0.0))
    return out


@dataclass(frozen=True)
class _Electrons:
    """Noise behind the curve: variance of the straight signal x is ``gain_dn`` x + ``dark_dn2``, with the covariance of both.

    ``changes`` are the steps of both for each step of the curve's parameters, shape (2, steps); ``light_scale`` is x at light 1.
    """

    values: Array
    covariance: Array
    changes: Array
    light_scale: float


def _electrons(best: _Fit, d: _Data, patches: tuple[Patch, ...], seen: Observations, steps: Array) -> _Electrons | str:
    """From the temporal noise of patches and bright levels; or why not.

    A variance V of the values is a variance V/(dy/dx)² of the straight signal x, which is K x + σ² (EMVA 1288 R4.0 eq. 13). Behind a
    logarithm x is the light itself, K one over the electrons at light 1, and σ² is that of the values.
    """
    points = [(p.mean_dn, p.var_dn2, (p.frames - 1) * p.cols * p.rows) for p in patches if np.isfinite(p.var_dn2) and p.var_dn2 > 0]
    transfer = seen.photon_transfer
    if transfer is not None and transfer.bright.mean_dn.size:
        b, ok = transfer.bright, unclipped_bright(transfer)
        pixels = int(np.prod(transfer.frame_shape))
        points += list(zip(b.mean_dn[ok], b.ms_pixel_dn2[ok], (b.n_frames[ok] - 1) * pixels, strict=True))
    if not points:
        return "a single frame has no temporal noise: take two frames or more of each picture"
    y, v, dof = (np.array(c, float) for c in zip(*points, strict=True))

    def solved(theta: Array) -> tuple[Array, Array] | None:
        scale = 1.0 if best.curve == LOG else straight_scale(best.curve, theta, d.top_dn)
        light = _light_at(best.curve, theta, y, d.top_dn)
        h = 1e-3
        ends = [curve_dn(best.curve, theta, light * f, d.top_dn) for f in (1 + h, 1 - h)]
        slope = np.maximum((ends[0] - ends[1]) / (2 * h * light * scale), 1e-9)
        x, squares = scale * light, np.maximum(v - 1 / 12, 1e-9) / slope**2
        use = np.sqrt(squares) < NOISY * x
        if use.sum() < 3 or x[use].max() < 2 * x[use].min():
            return None
        second = slope[use] ** -2 if best.curve == LOG else np.ones(int(use.sum()))  # noise of a logarithmic pixel comes behind the curve
        design = np.stack([x[use], second], axis=1)
        expected = squares[use]
        for _ in range(4):
            weight = 1 / (expected**2 * (2 / dof[use] + MODEL_VAR))
            normal = design.T @ (weight[:, None] * design)
            p = np.linalg.solve(normal, design.T @ (weight * squares[use]))
            expected = np.maximum(design @ p, 0.2 * squares[use])
        chi2 = float((weight * (squares[use] - design @ p) ** 2).sum()) / max(int(use.sum()) - 2, 1)
        return p, np.linalg.inv(normal) * max(chi2, 1.0)

    here = solved(best.theta)
    if here is None or here[0][0] <= 3 * np.sqrt(here[1][0, 0]):
        return "the noise of the patches does not tell the electrons: take larger patches, more frames or less noisy ones"
    changes = np.zeros((2, steps.shape[1]))
    for i, s in enumerate(steps.T):
        ends = [solved(best.theta + sign * s) for sign in (1, -1)]
        if ends[0] is not None and ends[1] is not None:
            changes[:, i] = 0.5 * (ends[0][0] - ends[1][0])
    scale = 1.0 if best.curve == LOG else straight_scale(best.curve, best.theta, d.top_dn)
    return _Electrons(here[0], here[1], changes, scale)


def _light_at(curve: str, theta: Array, values_dn: Array, top_dn: float) -> Array:
    """Light of stored values, by the curve's inverse."""
    grid = np.geomspace(1e-6, 1e3, 8000)
    values = np.maximum.accumulate(curve_dn(curve, theta, grid, top_dn))
    return np.interp(values_dn, values, grid)


@dataclass(frozen=True)
class _Rows:
    """Values beside those of the curve: their own covariance, and their change with each step of the curve's parameters."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    covariance: Array
    changes: Array


def _noise_rows(
    best: _Fit, told: _Electrons, steps: Array, temperature_c: float | None, reasons: dict[str, str], limits: set[str]
) -> _Rows | None:
    """Gain and dark noise in electrons behind a power curve or a knee; foot and slope of a logarithm."""
    gain, dark = told.values
    if best.curve == LOG:
        kt = KT_PER_Q_V * ((ROOM_C if temperature_c is None else temperature_c) + ZERO_C_K)
        slope, foot = float(np.exp(best.theta[1])) / kt, float(np.exp(best.theta[2])) / gain
        jacobian = np.array([[0.0, 0.0], [-foot / gain, 0.0]])
        changes = jacobian @ told.changes + np.array([slope * steps[1], foot * steps[2]])
        return _Rows(("gain_dn_per_v", "foot_e"), ("DN/V", "e-"), np.array([slope, foot]), jacobian @ told.covariance @ jacobian.T, changes)
    if best.curve not in BENT:
        return None
    if best.curve == POWER:
        reasons["gain_dn_per_e"] = "for a curve that meets the straight line at the largest code; gain and that code are not separable"
    total = told.covariance + told.changes @ told.changes.T
    u_dark = float(np.sqrt(total[1, 1]))
    hidden = dark < 3 * u_dark
    square = max(dark, 0.0) + ONE_SIDED_95 * u_dark if hidden else dark
    noise = float(np.sqrt(square)) / gain
    if hidden:
        reasons["dark_noise_e"] = "not significantly above zero behind the curve; 95 % upper limit"
        limits.add("dark_noise_e")
    jacobian = np.array([[1.0, 0.0], [-noise / gain, 0.5 * noise / square]])
    covariance = jacobian @ told.covariance @ jacobian.T
    return _Rows(("gain_dn_per_e", "dark_noise_e"), ("DN/e-", "e-"), np.array([gain, noise]), covariance, jacobian @ told.changes)


def straight_scale(curve: str, theta: Array, top_dn: float) -> float:
    """Straight signal above black, DN, at light 1."""
    if curve == POWER:
        return float(top_dn * (np.exp(theta[1]) / top_dn) ** (1 / theta[2]))
    if curve == BT709:
        return float(np.exp(theta[1] + theta[3]))
    return float(np.exp(theta[1]))


def with_response(seen: Observations, response: Response) -> Observations:
    """Observations with a response; behind a curve, gain and dark noise of the photon transfer are those through the curve."""
    notes = tuple(f"chart: {n}" for n in response.notes)
    if not response.curve:
        why = next(iter(response.fit.reasons.values()), "")
        notes = (f"the response is not measured from the chart: {why}",)
    out = replace(seen, response=response, notes=(*seen.notes, *notes))
    if not response.is_bent or seen.photon_transfer_fit is None:
        return out
    fit, own = seen.photon_transfer_fit, response.fit
    taken = {name: name for name in ("gain_dn_per_e", "dark_noise_e") if name in own}
    black = own["black_dn"]
    if "offset_dn" not in fit or abs(fit["offset_dn"].value - black.value) > 3 * black.u:
        taken["offset_dn"] = "black_dn"
    kept = fit.select([n for n in fit.names if n not in (*THROUGH_STRAIGHT_LINE, *taken)])
    told = "gain and dark noise in electrons follow from the noise of patches and bright frames through the camera's curve"
    if "gain_dn_per_e" not in own:
        told = "a gain read off a straight line is wrong behind the camera's curve, and is left out"
    notes = tuple(n for n in out.notes if not n.startswith("gain, "))
    return replace(out, photon_transfer_fit=kept.join(own.select(taken)), notes=(*notes, f"{told}; values in DN are those of the codes"))


def response_of(found: Found, bits: int, seen: Observations) -> Response:
    """As `fit_response`; a fit that fails is a reason."""
    try:
        return fit_response(found, bits, seen)
    except (MeasureError, np.linalg.LinAlgError) as problem:
        return _refused(Response(found.patches, found.refused), str(problem))
