"""Joint estimate of gain, dark noise, non-linearity and their companions from a photon-transfer series.

All means and white mean squares are fitted together by iterated generalised least squares, with the non-linearity free, the additive
wander of the black level and the lamp noise as variance components by restricted maximum likelihood (REML; Patterson & Thompson 1971), and
effective degrees of freedom by Satterthwaite's rule (JCGM 100 G.4). The reference that it is compared with is the Cramér-Rao bound of the
same model with every weight and variance component known: no unbiased estimator that has to find the non-linearity does better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pixmetry.camera.observations import PhotonTransfer, StackMoments
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe import photon_transfer_model as model
from pixmetry.observe.defects import HotDoubt, without_hot_pixels
from pixmetry.observe.photon_transfer_levels import (
    CLIPPED_BLACK_FRACTION,
    MINIMUM_LEVELS,
    NONLINEARITY_PRIOR,
    clipped_black,
    core_spread_dn2,
    levels_from,
    light_scale,
    prior_precision,
    refuse_curved,
    refuse_dead_series,
    temporal_row_col_vars,
    uneven_codes,
    usable_levels,
    with_stacks,
)
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
from pixmetry.observe.stack import SATURATED_FRACTION

ALL_SATURATED = 0.999  # then the mean is the top code that the camera stores, which may lie below 2**bits − 1
NOT_SIGNIFICANT = 3.0  # a variance below this many u is given as a limit
ROW_VAR, COL_VAR, SATURATION, LAMP_VAR, DARK_LIMIT, HOT, EXTRAPOLATED, UNEVEN = range(12, 20)
METHOD = (
    "joint photon-transfer fit: Poisson electrons, gain and noise before a cubic non-linearity; iterated generalised least squares on "
    "level means and white mean squares, wander and lamp noise by REML, dof by Satterthwaite (EMVA 1288 R4.0 §6-7 for the quantities)"
)
CONFOUNDERS = (
    "gain: a filter in the camera, or the brighter-fatter effect, that correlates neighbours too little to be found; traps of a CCD that "
    "fill at once: these lower the variance and so the gain",
    "non-linearity: a lamp whose light is not proportional to exposure looks like a non-linear camera",
    "dark noise: includes the shot noise of dark current that does not grow with exposure",
    "black level: of stored values; where the converter's codes differ in width, the level in front of it is another",
    "row noise: mains flicker under a rolling shutter looks like row noise in bright frames; dark frames are used here; "
    "slow noise (1/f) of the output amplifier is mostly in it",
)
UNDAMPED = 8  # iterations before the variance components move by half steps
LACK_OF_FIT_Z = 3.0902323  # normal quantile of a false alarm of 0.1 %


@dataclass(frozen=True)
class _Axes:
    """How the scaled axes of the fit go back to physical ones."""

    light: float  # exposure (s) or photons at a scaled light of one
    time_s: float
    by_exposure: bool


def fit_photon_transfer(
    pt: PhotonTransfer, dark_stack: StackMoments | None = None, bright_stack: StackMoments | None = None, dnl_lsb: float = 0.0
) -> Estimates:
    """Gain, noise, linearity, dark current and saturation of a camera from a photon-transfer series.

    Parameters
    ----------
    pt : PhotonTransfer
        Bright and dark levels; the light is known from the exposure time or, at constant exposure, from the photons.
    dark_stack, bright_stack : StackMoments, optional
        Further frames, not contained in ``pt``; they enter as one more level each. The bright stack is used where light goes by exposure.
    dnl_lsb : float
        Standard deviation of the converter's code widths, if it is known: means and variances of narrow levels depend on the few codes
        that they touch.

    Returns
    -------
    Estimates
        ``gain_dn_per_e``, ``dark_noise_e`` (white, without quantisation), ``row_noise_e``, ``column_noise_e`` (temporal), ``offset_dn``,
        ``nonlinearity_a1``…``a3`` (y = b + x(1 + a₁w + a₂w² + a₃w³), w = x/(2**bits − 1)), ``illumination_noise_rel`` (of the light of
        a level's mean), and where the series carries them ``dark_current_e_per_s``, ``responsivity_dn_per_s``,
        ``quantum_efficiency``, ``saturation_dn``, ``full_well_e``.

    Notes
    -----
    The black level is that of a converter with equal steps that stores the same dark means: what dark subtraction takes, and what a
    twin with equal steps needs. Codes of unequal width move what is stored of black, by a standard deviation of s_DNL / √(4 √π σ) for
    noise of σ LSB (`rounding_error_vars`); they are no error of this black level, but one of the level in front of the converter. So
    the dark levels' common departure from the line of the bright ones is shared out: the part of the codes belongs to the black level,
    that of the rounding does not. What the second is not known of the first enters u.

    Raises
    ------
    MeasureError
        No dark level, no known light, fewer than four levels between black and saturation, or a response like that of a gamma setting.
    """
    refuse_dead_series(pt)
    scale, by_exposure = light_scale(pt.bright)
    series, hot = without_hot_pixels(with_stacks(pt, dark_stack, bright_stack if by_exposure else None), dark_stack)
    levels, time_scale = levels_from(series, scale, by_exposure, core_spread_dn2(dark_stack), dnl_lsb)
    refuse_curved(series, levels)
    try:
        solution, keep = fit_range(levels, usable_levels(series, levels), prior_precision(series, levels))
        if solution.p[GAIN] < 3 * np.sqrt(solution.covariance[GAIN, GAIN]):
            what = "the temporal variance does not grow with the mean, so the gain is not resolved"
            raise MeasureError(what, where="photon transfer", remedy="use a higher analogue gain, larger frames or more levels")
    except MeasureError:
        refuse_curved(series, levels, failed=True)  # the plainer reason, if there is one
        raise
    return _estimates(series, solution, levels.subset(keep), _Axes(scale, time_scale, by_exposure), hot)


@dataclass
class _Rows:
    """Collects results with their gradients over the parameters of the fit and the quantities estimated beside it."""

    covariance: np.ndarray
    names: list[str] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    gradients: list[np.ndarray] = field(default_factory=list)
    limits: set[str] = field(default_factory=set)
    lower_limits: set[str] = field(default_factory=set)
    reasons: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, value: float, unit: str, gradient: dict[int, float], reason: str = "", limit: bool = False) -> None:
        row = np.zeros(self.covariance.shape[0])
        for k, v in gradient.items():
            row[k] = v
        self.names.append(name)
        self.values.append(float(value))
        self.units.append(unit)
        self.gradients.append(row)
        if reason:
            self.reasons[name] = reason
        if limit:
            self.limits.add(name)

    def add_root(
        self, name: str, unit: str, square: float, index: int, gain: float | None, what: str, reason: str = "", dof: float = 1e6
    ) -> None:
        """A standard deviation from its square (parameter ``index``), in electrons if a gain is given; a limit if not significant."""
        u2 = float(np.sqrt(self.covariance[index, index]))
        limit = square < NOT_SIGNIFICANT * u2
        root = np.sqrt(max(square, 0.0) + _limit_factor(dof) * u2) if limit else np.sqrt(square)
        k = gain or 1.0
        root = max(root, 1e-12)
        gradient = {index: 0.5 / (root * k)}
        if gain:
            gradient[GAIN] = -root / k**2
        if limit:
            found = f"its square is {square:.3g} with a standard uncertainty of {u2:.3g}"
            reason = f"{what} is not significant: {found}; 95 % upper limit. {reason}".strip()
        self.add(name, root / k, unit, gradient, reason, limit)


def _augmented(pt: PhotonTransfer, s: Solution, d: model.Levels) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of the fit and the quantities beside it, with their covariance."""
    n = s.p.size
    values, cov = np.zeros(n + 8), np.zeros((n + 8, n + 8))
    dark = ~d.bright
    values[:n], cov[:n, :n] = s.p, s.covariance
    line, line_var = temporal_row_col_vars(pt)
    values[ROW_VAR : COL_VAR + 1] = line
    dither = float(d.dither[dark].mean()) if dark.any() else 0.0
    white = model.white_before_rounding(float(d.ms[dark].mean()) if dark.any() else 1.0, dither)
    # what rounding and code widths stretch in common is no scatter of the lines
    line_var = line_var + 4 * model.slope_error_var(white, dither, d.dnl_lsb) * line**2
    cov[ROW_VAR, ROW_VAR], cov[COL_VAR, COL_VAR] = line_var
    if s.free[DARK_SLOPE]:
        _add_converter_to_slopes(cov, s, d, white, dither)
    if model.is_hidden(d):  # the common part is in the fit; levels that pass through few codes do not average the rest
        cov[OFFSET, OFFSET] += (1 - d.coherence**2) * float(model.rounding_error_vars(np.array(white), dither)[0])
    values[LAMP_VAR], cov[LAMP_VAR, LAMP_VAR] = s.components[1], s.components_cov[1, 1]
    return values, cov


def _add_converter_to_slopes(cov: np.ndarray, s: Solution, d: model.Levels, white: float, dither: float) -> None:
    """Widen the slopes of the dark mean and variance by what the converter does to them while the mean moves over its codes.

    A slope is Σ c_i y_i. Rounding errors of equal steps are a wave of one code, of unknown phase: the slope's variance is theirs times
    |Σ c_i exp(2πi y_i)|². Those of uneven codes are thresholds' displacements, smoothed by the noise of variance σ²: of means y and y'
    they correlate as exp(−(y − y')²/4σ²), of variances (1 − (y − y')²/2σ²) times as much. What the fit took as the levels' own is in it.
    """
    dark = ~d.bright
    time = d.time[dark] - d.time[dark].mean()
    c = time / (time @ time)
    rise = s.p[DARK_SLOPE] * time
    wave = abs(c @ np.exp(2j * np.pi * rise)) ** 2
    apart2 = np.subtract.outer(rise, rise) ** 2 / max(white + dither, model.QUANTISATION_DN2)
    smooth = np.exp(-apart2 / 4)
    equal, both = (np.array(model.rounding_error_vars(np.array(white), dither, dnl)) for dnl in (0.0, d.dnl_lsb))
    total = equal * wave + (both - equal) * np.array([c @ smooth @ c, c @ (smooth * (1 - apart2 / 2)) @ c])
    change = np.sqrt(np.maximum(total - (1 - d.coherence**2) * both * (c @ c), 0.0))
    for at, extra in zip((DARK_SLOPE, DARK_VAR_SLOPE), change, strict=True):
        cov[at, at] += float(extra) ** 2
    cov[SLOPE, SLOPE] += float(change[0]) ** 2  # where the exposure was swept, what is not the one is the other
    cov[SLOPE, DARK_SLOPE] -= float(change[0]) ** 2
    cov[DARK_SLOPE, SLOPE] -= float(change[0]) ** 2


def _effective_dof(s: Solution, rows: np.ndarray, cov: np.ndarray, lamp_dof: float) -> np.ndarray:
    """Satterthwaite: dof = 2u⁴/Var(u²), where u² depends on the variance components.

    A component estimated as zero adds nothing to u, so its scatter is not counted.
    """
    n_par = s.p.size
    total = np.einsum("ki,ij,kj->k", rows, cov, rows)
    by = np.einsum("ki,cij,kj->kc", rows[:, :n_par], s.covariance_by, rows[:, :n_par]) * (s.components > 0)
    var_u2 = np.einsum("kc,cd,kd->k", by, s.components_cov, by)
    var_u2 = var_u2 + 2 * (rows[:, LAMP_VAR] ** 2 * cov[LAMP_VAR, LAMP_VAR]) ** 2 / lamp_dof
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = 2 * total**2 / var_u2
    return np.where((var_u2 > 0) & (dof < 1e6), np.maximum(dof, 1.0), np.inf)


def _limit_factor(dof: float) -> float:
    """How many u lie between a variance and its one-sided 95 % limit: √(ν/2)(ν/χ²₀.₀₅ − 1), 1.645 for many degrees of freedom."""
    q = 2 / (9 * dof)
    chi2 = dof * max(1 - q - ONE_SIDED_95 * np.sqrt(q), 0.1) ** 3
    return float(np.sqrt(dof / 2) * (dof / chi2 - 1))


def _estimates(pt: PhotonTransfer, s: Solution, d: model.Levels, axes: _Axes, hot: HotDoubt) -> Estimates:
    p = s.p
    values, cov = _augmented(pt, s, d)
    cov[HOT, HOT] = hot.mean_dn**2
    cov[DARK_VAR, DARK_VAR] += hot.var_dn2**2
    lamp_dof = float(max(d.bright.sum() - s.free[[SLOPE, A1, A1 + 1, A3, LIGHT_OFFSET]].sum(), 1))
    saturation = _saturation(pt, s, d, axes)
    if saturation:
        cov[SATURATION, SATURATION] = saturation[1] ** 2
    rows = _Rows(cov)
    extra = np.sqrt(s.components[2])
    wide = (
        f"the variances scatter by {100 * extra:.2g} % more than their sampling distribution; u is increased accordingly"
        if extra > 0
        else ""
    )
    rows.add("gain_dn_per_e", p[GAIN], "DN/e-", {GAIN: 1.0}, wide)
    _add_temporal_noise(rows, s, d, values, clipped_black(pt))
    one_time = "" if s.free[DARK_SLOPE] else "contains the dark signal: the dark frames have about one exposure time"
    share, cov[UNEVEN, UNEVEN] = uneven_codes(pt, d)
    rows.add("offset_dn", p[OFFSET] + share * p[Q_MEAN], "DN", {OFFSET: 1.0, Q_MEAN: share, UNEVEN: 1.0, HOT: 1.0}, one_time)
    if s.free[DARK_SLOPE]:
        _add_dark_current(rows, p, axes.time_s)
    for k in range(3):
        rows.add(f"nonlinearity_a{k + 1}", p[A1 + k], "1", {A1 + k: 1.0})
    _add_sensitivity(rows, pt, p, axes)
    rows.add_root("illumination_noise_rel", "1", s.components[1], LAMP_VAR, None, "noise of the light from level to level", dof=lamp_dof)
    if saturation:
        _add_saturation(rows, p, saturation, d.x_ref, float(d.mean[d.bright].max()))
    gradients = np.array(rows.gradients)
    return Estimates(
        names=tuple(rows.names),
        values=np.array(rows.values),
        covariance=gradients @ cov @ gradients.T,
        dof=_effective_dof(s, gradients, cov, lamp_dof),
        units=tuple(rows.units),
        method=METHOD,
        confounders=CONFOUNDERS,
        limits=frozenset(rows.limits),
        lower_limits=frozenset(rows.lower_limits),
        reasons=rows.reasons,
    )


def _add_sensitivity(rows: _Rows, pt: PhotonTransfer, p: np.ndarray, axes: _Axes) -> None:
    """Initial slope of the signal against exposure time, and electrons per photon."""
    if axes.by_exposure:
        rows.add("responsivity_dn_per_s", p[SLOPE] / axes.light, "DN/s", {SLOPE: 1 / axes.light})
    if pt.bright.photons is None:
        return
    known = np.isfinite(pt.bright.photons)
    light = pt.bright.exposure_s if axes.by_exposure else pt.bright.photons
    photons = axes.light * pt.bright.photons[known].sum() / light[known].sum()  # at a scaled light of one
    value = p[SLOPE] / (p[GAIN] * photons)
    gradient = {SLOPE: value / p[SLOPE], GAIN: -value / p[GAIN]}
    rows.add("quantum_efficiency", value, "1", gradient, "u does not include the calibration of the photon count")


def _add_temporal_noise(rows: _Rows, s: Solution, d: model.Levels, values: np.ndarray, clipped: float) -> None:
    """White, row and column noise, or the bound of EMVA 1288 R4.0 eq. 54 where quantisation hides them."""
    gain = s.p[GAIN]
    dark = ~d.bright
    if dark.any() and d.ms[dark].mean() < model.MINIMUM_DARK_VAR_DN2:
        bound = 0.40 / gain
        rows.covariance[DARK_LIMIT, DARK_LIMIT] = bound**2 / 12
        reason = (
            f"the dark variance is below {model.MINIMUM_DARK_VAR_DN2} DN², where rounding hides it: "
            "bound 0.40/K (EMVA 1288 R4.0 eq. 54); u is that of a uniform distribution below it"
        )
        for name in ("dark_noise_e", "row_noise_e", "column_noise_e"):
            rows.add(name, bound, "e-", {DARK_LIMIT: 1.0}, reason, limit=True)
        return
    reason = ""
    if clipped > CLIPPED_BLACK_FRACTION:
        reason = (
            f"{100 * clipped:.2g} % of the dark pixels are clipped at black: "
            "extrapolated to zero light from the levels that are not clipped; raise the black level"
        )
    elif not s.free[DARK_VAR_SLOPE]:
        reason = "contains the shot noise of the dark current at the exposure of the dark frames"
    rows.add_root("dark_noise_e", "e-", values[DARK_VAR], DARK_VAR, gain, "dark noise", reason)
    rows.add_root("row_noise_e", "e-", values[ROW_VAR], ROW_VAR, gain, "temporal row noise")
    rows.add_root("column_noise_e", "e-", values[COL_VAR], COL_VAR, gain, "temporal column noise")


def _add_dark_current(rows: _Rows, p: np.ndarray, time_scale: float) -> None:
    """Dark current from the mean, or from the variance where a clamp or a drifting black level spoils the mean (EMVA 1288 R4.0 §7)."""
    gain = p[GAIN]
    from_mean, from_var = p[DARK_SLOPE] / (gain * time_scale), p[DARK_VAR_SLOPE] / (gain**2 * time_scale)
    mean_row = {DARK_SLOPE: 1 / (gain * time_scale), GAIN: -from_mean / gain}
    var_row = {DARK_VAR_SLOPE: 1 / (gain**2 * time_scale), GAIN: -2 * from_var / gain}
    c = rows.covariance

    def u_of(row: Mapping[int, float]) -> float:
        k, g = list(row), np.array(list(row.values()))
        return float(np.sqrt(g @ c[np.ix_(k, k)] @ g))

    difference = {k: mean_row.get(k, 0.0) - var_row.get(k, 0.0) for k in {*mean_row, *var_row}}
    value, row, reason = from_mean, mean_row, ""
    if p[DARK_VAR_SLOPE] and abs(from_mean - from_var) > 4.5 * u_of(difference):  # 0: rounding hides the variance
        value, row = from_var, var_row
        reason = f"from the dark variance: the mean ({from_mean:.4g} e-/s) contradicts it; the black level is clamped or drifts"
    u = u_of(row)
    limit = value < 2 * u
    if limit:
        reason = f"not significant: {value:.3g} e-/s with a standard uncertainty of {u:.3g}; 95 % upper limit. {reason}".strip()
        value = max(value, 0.0) + ONE_SIDED_95 * u
    rows.add("dark_current_e_per_s", value, "e-/s", row, reason, limit)


def _saturation(pt: PhotonTransfer, s: Solution, d: model.Levels, axes: _Axes) -> tuple[float, float, str] | None:
    """Stored value of saturation, its standard uncertainty and what sets it; ``None`` where no level is saturated.

    Either the converter clips, or the brightest two levels stand still, less than a tenth of the growth that their light would give.
    """
    b = pt.bright
    if b.fraction_max.max() - pt.dark.fraction_max.max(initial=0.0) > SATURATED_FRACTION:
        full = b.fraction_max > ALL_SATURATED
        return (float(b.mean_dn[full].max()) if full.any() else d.x_ref), float(np.sqrt(model.QUANTISATION_DN2)), "converter"
    light = b.exposure_s if b.photons is None or axes.by_exposure else b.photons
    light = light / axes.light
    second, first = np.argsort(light, kind="stable")[-2:]
    growth, expected = abs(b.mean_dn[first] - b.mean_dn[second]), (light[first] - light[second]) * s.p[SLOPE]
    beyond = b.mean_dn[second] > d.mean[d.bright].max() and growth < 0.1 * expected
    return (float(b.mean_dn[first]), float(max(growth, 0.3)), "full well") if beyond else None


def _add_saturation(rows: _Rows, p: np.ndarray, saturation: tuple[float, float, str], x_ref: float, brightest_dn: float) -> None:
    """Saturation in stored DN and in electrons."""
    y, _, cause = saturation
    gain, a = p[GAIN], p[A1 : A3 + 1]
    x, brightest = model.signal_from_mean(np.array([y, brightest_dn]) - p[OFFSET], a, x_ref, np.zeros(1)).tolist()
    slope, last_slope = model.transfer(np.array([x, brightest]), a, x_ref)[1].tolist()
    # beyond the brightest level that was fitted the bend is extrapolated: known no better than to all of it
    bend = x - brightest - (y - brightest_dn) / last_slope
    rows.covariance[EXTRAPOLATED, EXTRAPOLATED] = (bend / gain) ** 2
    rows.add("saturation_dn", y, "DN", {SATURATION: 1.0}, f"set by the {cause}")
    gradient = {SATURATION: 1 / (slope * gain), OFFSET: -1 / (slope * gain), GAIN: -x / gain**2}
    gradient |= {EXTRAPOLATED: 1.0} | {A1 + k: -x * (x / x_ref) ** (k + 1) / (slope * gain) for k in range(3)}
    clips = cause == "converter"
    note = "lower bound of the pixel's full well: the converter clips first" if clips else "the pixels saturate below the top code"
    rows.add("full_well_e", x / gain, "e-", gradient, note)
    if clips:
        rows.lower_limits.add("full_well_e")


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
    what = "the fit does not converge: the levels do not agree with a camera with a smooth, nearly linear response"
    return MeasureError(what, where="photon transfer", remedy="leave out wrong levels; raise the black level")


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
    if not (np.diag(normal) > 0).all():  # covariances of the levels that cannot be
        raise _unsettled()
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
        sigma = np.sqrt(np.maximum(np.diag(step.normal_inv), 0.0))
        score, info = _reml(step, s, prior)
        new = _update_components(s, score, info) if iteration else s.components
        if iteration >= UNDAMPED:  # a component at its bound may go to and fro
            new = 0.5 * (new + s.components)
        still = iteration > 1 and np.all(np.abs(new - s.components) <= 2e-3 * s.components + 1e-12)
        s.components = new
        if still and np.all(np.abs(step.shift) < 1e-3 * sigma):
            break
    step = _step(d, s, prior)
    if not np.all(np.abs(step.shift) < 0.5 * np.sqrt(np.maximum(np.diag(step.normal_inv), 0.0))):
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
    return float(dof * (1 - 2 / (9 * dof) + LACK_OF_FIT_Z * np.sqrt(2 / (9 * dof))) ** 3)
