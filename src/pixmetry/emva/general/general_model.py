"""The smooth curves of EMVA 1288 R4.0 General: their levels, their stiffness, and the values that follow from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.random import generator
from pixmetry.emva.general.response import ResponseEnd, ResponseSpline, end_of, smooth_despite_setting, smooth_response
from pixmetry.emva.records import Series

MINIMUM_LEVELS, SEED = 8, 1288
LIGHT_SHARE = 0.1  # relative variance of the light over that of a pixel's noise, about as in a laboratory; sets weights only
OUTLYING, MANY_DRAWS = 4.0, 30  # standard deviations of the draws, where there are enough to tell them
MEASURED = ("mean_dn", "var_dn2", "spatial_var_dn2", "dark_mean_dn", "dark_var_dn2", "dark_spatial_var_dn2", "fraction_max")


@dataclass(frozen=True)
class Levels:
    """The lit levels that follow the response, by light; light in units of the largest; measured values have shape (..., levels)."""

    light: Array
    scale: Array  # light at one, shape (...,)
    has_photons: bool
    signal_dn: Array
    var_dn2: Array
    spatial_dn2: Array
    dark_var_dn2: Array
    dark_spatial_dn2: Array
    fraction_max: Array
    mean_dn: Array


@dataclass(frozen=True)
class Plan:
    """Choices that are made once from one series: its levels, and the smoothing of their curves."""

    order: Array  # of the levels
    end: ResponseEnd
    ratio: ResponseSpline
    growth: ResponseSpline  # of the variance above the dark one, per light
    levels: Levels  # of that one series
    slopes: Array  # matrix from response ratios to the slopes at the levels
    grown: Array  # matrix from growths of the variance to the smooth ones
    patterned: Array  # the same for the spatial variance


def mean_of_draws(series: Series) -> Series:
    light = {} if series.photons is None else {"photons": _nominal(series.photons)}
    return replace(series, **light, **{name: _nominal(np.asarray(getattr(series, name), dtype=float)) for name in MEASURED})


def _nominal(values: Array) -> Array:
    """Mean over the draws."""
    mean: Array = values.reshape(-1, values.shape[-1]).mean(axis=0)
    return mean


def light_axis(series: Series) -> Array:
    """What General counts the light by: photons, else the exposure; shape (levels,)."""
    return np.asarray(series.exposure_s if series.photons is None else series.photons, dtype=float)


def levels_of(series: Series, order: Array) -> Levels:
    def take(values: Array) -> Array:
        return np.asarray(values, dtype=float)[..., order]

    light = take(light_axis(series))
    nominal = light.reshape(-1, order.size)[0]
    mean = take(series.mean_dn)
    return Levels(
        light=nominal / nominal[-1],
        scale=light[..., -1],
        has_photons=series.photons is not None,
        signal_dn=mean - take(series.dark_mean_dn),
        var_dn2=take(series.var_dn2),
        spatial_dn2=take(series.spatial_var_dn2),
        dark_var_dn2=take(series.dark_var_dn2),
        dark_spatial_dn2=take(series.dark_spatial_var_dn2),
        fraction_max=take(series.fraction_max),
        mean_dn=mean,
    )


def make_plan(series: Series) -> Plan:
    """Choose levels and smoothing from one series (without draws)."""
    light = light_axis(series)
    order, end = end_of(series, light)
    order = order[: end.seen]
    different = np.unique(light[order]).size
    if different < MINIMUM_LEVELS:
        raise MeasureError(
            "too few bright levels below saturation for a characteristic curve",
            where="EMVA 1288 General",
            value=different,
            allowed=f"{MINIMUM_LEVELS} or more, 50 are better",
            remedy="add levels between black and saturation",
        )
    d = levels_of(series, order)
    signal, var = d.signal_dn, d.var_dn2
    if not signal[-1] > 0:
        raise MeasureError(
            "the brightest level is no brighter than the dark one", where="EMVA 1288 General", remedy="check the lamp and the exposure"
        )
    # a mean scatters with the noise of its pixels and with the light
    once, first = np.unique(d.light, return_index=True)
    local = np.interp(d.light, once, np.gradient(np.append(0.0, signal[first]), np.append(0.0, once))[1:])
    mean_weights = d.light**2 / np.maximum(var + LIGHT_SHARE * (local * d.light) ** 2, 1e-12 * signal[-1] ** 2)
    ratio = smooth_despite_setting(d.light, ratios(d), mean_weights)
    smooth, floor = var, 1e-6 * var.max()
    for _ in range(2):  # weights from scattered variances would prefer the low ones
        var_weights = d.light**2 / (np.maximum(smooth, floor) ** 2 + d.dark_var_dn2**2)
        growth = smooth_response(d.light, growths(d), var_weights).spline
        smooth = d.dark_var_dn2.mean() + d.light * (growth.rows(d.light) @ growths(d))
    pattern = smooth_response(d.light, patterns(d), d.light**2 * var_weights).spline
    return Plan(order, end, ratio, growth, d, slope_rows(ratio, d.light), growth.rows(d.light), pattern.rows(d.light))


def ratios(d: Levels) -> Array:
    return d.signal_dn / d.light


def growths(d: Levels) -> Array:
    return (d.var_dn2 - d.dark_var_dn2) / d.light


def patterns(d: Levels) -> Array:
    return (d.spatial_dn2 - d.dark_spatial_dn2) / d.light**2


def with_setting_errors(plan: Plan, d: Levels) -> Levels:
    """Draws in which levels that stand off the curve by more than all draws do are off by as much, to either side.

    What moved such a level, an exposure that was not what it was said to be, is not in the scatter of the others.
    """
    if d.signal_dn.ndim < 2 or d.signal_dn.shape[0] < MANY_DRAWS:
        return d
    measured = ratios(plan.levels)
    off = (measured - plan.ratio.rows(d.light) @ measured) * d.light
    far = np.flatnonzero(np.abs(off) > OUTLYING * d.signal_dn.std(axis=0))
    if not far.size:
        return d
    signal = d.signal_dn.copy()
    signal[:, far] += off[far] * generator(SEED, "levels away from the curve").choice([-1.0, 1.0], size=(signal.shape[0], far.size))
    return replace(d, signal_dn=signal)


def slope_rows(ratio: ResponseSpline, light: Array) -> Array:
    """Matrix from response ratios to the slope of the response, shape (light, levels)."""
    return ratio.rows(light) + light[:, None] * ratio.rows(light, 1)
