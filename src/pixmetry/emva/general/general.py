"""EMVA 1288 R4.0 General: no model of the camera, its noise is seen at the input. The response may have any smooth form.

The characteristic curve is taken as y − y_dark = p r(p): the response ratio r is constant for a linear camera and smooth for others, and
the curve passes through the origin by itself. r is a cubic smoothing spline (``response_spline``). Noise at the output over the slope
dy/dp = r + p r' is noise at the input (first-order propagation). Levels, weights and stiffness are chosen once, from one series; with
these the spline is linear in the data, and all draws about that series are one product.
"""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.emva.general.general_model import (
    Levels,
    Plan,
    growths,
    levels_of,
    make_plan,
    mean_of_draws,
    patterns,
    ratios,
    slope_rows,
    with_setting_errors,
)
from pixmetry.emva.records import Series

SMALLEST_THRESHOLD, GRID = 1e-7, 500  # of the largest light; where the threshold is looked for
OFF_THE_CURVE = 0.01  # relative


def _threshold(plan: Plan, d: Levels) -> Array:
    """Light at which noise and signal at the input are equal, shape (...,).

    p² s² = σ²_dark + p q with the slope s and the growth q of the variance, both at p: for constant s and q the positive root of a
    quadratic, (q + √(q² + 4 s² σ²_dark))/(2 s²), which is EMVA 1288 R4.0 eq. 26 for a linear camera. The lowest root of the curves that
    the plan was made from is bracketed, then iterated; each draw goes on from there with s and q to first order in p.
    """

    def at(light: float) -> tuple[Array, Array]:
        p = np.array([light])
        return slope_rows(plan.ratio, p)[0], plan.growth.rows(p)[0]

    def change_at(light: float) -> tuple[Array, Array]:
        h = 1e-3 * max(light, 1e-9)
        around = np.array([max(light - h, 0.0), light + h])
        return np.diff(slope_rows(plan.ratio, around), axis=0)[0] / np.ptp(around), plan.growth.rows(np.array([light]), 1)[0]

    def root(slope: Array, growth: Array, dark: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            found = (growth + np.sqrt(growth**2 + 4 * slope**2 * dark)) / (2 * slope**2)
        return np.where((slope > 0) & (found > 0), found, np.nan)

    middle_ratios, middle_growths, dark = ratios(plan.levels), growths(plan.levels), np.maximum(plan.levels.dark_var_dn2[0], 0.0)
    grid = np.geomspace(SMALLEST_THRESHOLD, 1.0, GRID)
    slopes = slope_rows(plan.ratio, grid) @ middle_ratios
    above = np.flatnonzero((slopes > 0) & ((grid * slopes) ** 2 >= dark + grid * (plan.growth.rows(grid) @ middle_growths)))
    if not above.size:
        raise MeasureError(
            "the signal does not rise above the noise within the series", where="EMVA 1288 General", remedy="take brighter levels"
        )
    low, high = grid[max(above[0] - 1, 0)], grid[above[0]]
    middle = float(high)
    for _ in range(20):
        slope, growth = at(middle)
        found = np.nan_to_num(root(slope @ middle_ratios, growth @ middle_growths, dark), nan=high)
        before, middle = middle, float(np.clip(found, low, high))
        if middle == before:
            break
    slope, growth = (values @ row for values, row in zip((ratios(d), growths(d)), at(middle), strict=True))
    slope_by, growth_by = (values @ row for values, row in zip((ratios(d), growths(d)), change_at(middle), strict=True))
    dark = np.maximum(d.dark_var_dn2[..., 0], 0.0)
    p = np.full(np.shape(slope), middle)
    for _ in range(6):
        p = root(slope + slope_by * (p - middle), growth + growth_by * (p - middle), dark)
    return p


def general_evaluation(series: Series, plan: Plan | None = None) -> tuple[dict[str, Array], dict[str, Array]]:
    """The values of the General model, and for those that are roots of a variance that may be negative that variance.

    Parameters
    ----------
    series : Series
        Measured values of shape (..., levels). Draws of the photons may differ by a common factor only.
    plan : Plan, optional
        Levels, weights and stiffness of the smooth curves: those of the measured series, so that its draws are smoothed as it is. By
        default those of the mean of the draws.

    Returns
    -------
    values : dict of ndarray, shape (...,)
        The keys ``general_*``; NaN where the variance behind a root is negative, and for quantities in photons where only exposures
        are known.
    square_of : dict of ndarray, shape (...,)
        For ``general_DSNU`` (photon²) and ``general_PRNU`` (%²) the variances themselves.

    Raises
    ------
    MeasureError
        Fewer than eight lit levels below saturation, no signal, or none above the noise.

    Notes
    -----
    Saturation is the highest level with at most 0.2 % of the pixels at the top code, or the last one before the noise reaches a plateau
    below it (``response_end``); where the series reaches neither, the level of the largest SNR_p. SNR_p = p/σ_p is taken from smooth
    curves of slope, variance and pattern, so that its maximum is not that of the scatter. The threshold is where it is one. Dark
    non-uniformity is the mean of the dark levels up to half of saturation over the slope at zero light; that at half of saturation is of
    all there is at that level, light included, between the two nearest levels.
    """
    plan = make_plan(mean_of_draws(series)) if plan is None else plan
    d = with_setting_errors(plan, levels_of(series, plan.order))
    slope = ratios(d) @ plan.slopes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        signal = np.where(slope > 0, d.light * slope, np.nan)
        var = d.dark_var_dn2 + d.light * (growths(d) @ plan.grown.T)
        snr = signal / np.sqrt(var)
        total = signal / np.sqrt(var + d.dark_spatial_dn2 + d.light**2 * (patterns(d) @ plan.patterned.T))
    snr, total = (np.where(np.isfinite(values), values, -np.inf) for values in (snr, total))
    top = plan.end.saturation(d.mean_dn, d.fraction_max) if plan.end.found else np.argmax(snr, axis=-1)
    below = np.arange(d.light.size) <= top[..., None]
    largest, largest_total = (np.max(np.where(below, values, -np.inf), axis=-1) for values in (snr, total))
    saturation, threshold = d.light[top], _threshold(plan, d)
    photons = d.scale if d.has_photons else np.nan
    dark2 = _dark_square(plan, d, 0.5 * saturation) * photons**2
    with np.errstate(divide="ignore", invalid="ignore"):
        light2 = 1e4 * _interpolated(d.spatial_dn2 / (d.light * slope) ** 2, d.light, 0.5 * saturation)
        values = {
            "general_u_p_min": threshold * photons,
            "general_u_p_sat": saturation * photons,
            "general_SNR_max": largest,
            "general_SNR_max_dB": 20 * np.log10(largest),
            "general_SNR_total_max": largest_total,
            "general_DR": saturation / threshold,
            "general_DR_dB": 20 * np.log10(saturation / threshold),
            "general_DSNU": np.sqrt(dark2),
            "general_PRNU": np.sqrt(light2),
        }
    finite = {key: np.where(np.isfinite(value), value, np.nan) for key, value in values.items()}
    return finite, {"general_DSNU": dark2, "general_PRNU": light2}


def general_notes(plan: Plan) -> tuple[str, ...]:
    """Notes on the values of one series: extrapolations, and the reason for the end of the series.

    Raises
    ------
    MeasureError
        No signal above the noise.
    """
    d = plan.levels
    least, lowest = float(_threshold(plan, d)), float(d.light[0])
    notes = []
    if least < 0.5 * lowest:
        at = f"{lowest / least:.2g} times the threshold"
        notes.append(
            f"general_u_p_min and general_DSNU are extrapolated: the darkest level has {at}; the response between it and black is "
            "assumed smooth; a curve with a steep start (gamma) is not"
        )
    fitted, measured = float(plan.ratio.rows(d.light[:1])[0] @ ratios(d)), float(ratios(d)[0])
    off = measured / fitted - 1
    if abs(off) > OFF_THE_CURVE:
        notes.append(
            f"the darkest level lies {100 * abs(off):.1f} % {'above' if off > 0 else 'below'} the curve through "
            "the levels: its light differs from the stated value, or the response is curved there; u of general_u_p_min includes this"
        )
    if np.isfinite(plan.end.plateau_dn):
        notes.append(
            f"the response ends below the top code, on a plateau at {plan.end.plateau_dn:.5g} DN: general_u_p_sat is the last level before "
            "the noise reaches it"
        )
    elif not plan.end.clips:
        notes.append("no level reaches the top code: the light of the last one is a lower limit of general_u_p_sat")
    if not d.has_photons:
        notes.append("the photons are not known: general_u_p_min, general_u_p_sat and general_DSNU have no value")
    return tuple(notes)


def _dark_square(plan: Plan, d: Levels, half: Array) -> Array:
    """Variance of the dark pattern at the input, in units of the largest light."""
    slope_at_zero = ratios(d) @ plan.ratio.rows(np.zeros(1))[0]
    used = (d.light <= half[..., None]) | (np.arange(d.light.size) == 0)
    square: Array = np.sum(np.where(used, d.dark_spatial_dn2, 0.0), axis=-1) / used.sum(axis=-1) / slope_at_zero**2
    return square


def _interpolated(values: Array, light: Array, at: Array) -> Array:
    """Values at a light of each draw, on the straight line between the two nearest levels."""
    shape = np.broadcast_shapes(values.shape[:-1], at.shape)
    values, at = np.broadcast_to(values, (*shape, light.size)), np.broadcast_to(at, shape)
    i = np.clip(np.searchsorted(light, at, side="right") - 1, 0, light.size - 2)
    share = (at - light[i]) / np.maximum(light[i + 1] - light[i], 1e-300)
    lower = np.take_along_axis(values, i[..., None], axis=-1)[..., 0]
    upper = np.take_along_axis(values, i[..., None] + 1, axis=-1)[..., 0]
    return lower + share * (upper - lower)


def general_curve(plan: Plan) -> dict[str, Array]:
    """The characteristic curve of one series and the noise that it sees at the input.

    Returns
    -------
    dict of ndarray, shape (levels up to saturation,)
        ``photons`` (or ``exposure_s``, where photons are not known), ``mean_dn`` above the dark one, ``var_dn2``, ``slope`` (DN per
        photon), ``sigma_p`` and ``s_p`` (photons; zero where the spatial variance came out negative), ``snr_p``, ``snr_p_total``.

    """
    d = plan.levels
    count = int(plan.end.saturation(d.mean_dn, d.fraction_max)) + 1 if plan.end.found else d.light.size
    light, slope = d.light * d.scale, plan.slopes @ ratios(d) / d.scale
    steep = np.where(slope > 0, slope, np.nan)
    sigma = np.sqrt(d.var_dn2) / steep
    fixed2 = d.spatial_dn2 / steep**2
    curve = {
        "photons" if d.has_photons else "exposure_s": light,
        "mean_dn": d.signal_dn,
        "var_dn2": d.var_dn2,
        "slope": slope,
        "sigma_p": sigma,
        "s_p": np.sqrt(np.maximum(fixed2, 0.0)),
        "snr_p": light / sigma,
        "snr_p_total": light / np.sqrt(sigma**2 + np.maximum(fixed2, 0.0)),
    }
    return {name: values[:count] for name, values in curve.items()}
