"""Sensitivity, linearity and dark current of a release, from the exposure series. All functions take leading axes of draws."""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError
from pixmetry.emva.files.keys import FIT_RANGE, MINIMUM_DARK_VAR_DN2, QUANTISATION_DN2, SATURATED_FRACTION
from pixmetry.emva.general.response import slope_matrix
from pixmetry.emva.records import Series
from pixmetry.emva.series import MINIMUM_EXPOSURES, count_exposures, first_of_equal, light_of

LINEAR_RANGE = (0.05, 0.95)  # of saturation, for linearity (R4.0 §6.7)
KNEE = 0.8  # a variance below this share of a darker level's has passed the full well
SLOPE_DOF = 4.0  # equivalent degrees of freedom of the spline behind PTC_linearity: those of a cubic
MINIMUM_LINE = 3  # levels that a straight line can leave something of


@np.errstate(divide="ignore", invalid="ignore")  # draws of too few levels, or without light, are NaN
def temporal_values(
    series: Series, release: str, pixel_area_um2: float | None = None, least_dark_var_dn2: float = MINIMUM_DARK_VAR_DN2
) -> dict[str, Array]:
    """All values that the exposure series carries.

    Parameters
    ----------
    series : Series
        Its measured values of shape (..., levels).
    release : {"4.0", "3.1", "reference"}
    pixel_area_um2 : float, optional
    least_dark_var_dn2 : float
        What stands for a smaller dark variance (R4.0 eq. 54).

    Returns
    -------
    dict of ndarray, shape (...)
        By the keys of ``pixmetry.emva.files.keys``; NaN where the series does not carry a value (no photons, no area, one exposure).
        ``sigma_y_dark`` and what follows from it rest on ``least_dark_var_dn2`` at least.

    Raises
    ------
    MeasureError
        Fewer than two levels between dark and 70 % of saturation.

    Notes
    -----
    EMVA 1288 R4.0 Linear eq. 49 to 55 (sensitivity), 24 to 28 (capacity, threshold, dynamic range), 58 to 63 (linearity), 29 and 30
    (dark current). 3.1 and ``reference`` take saturation at the maximum of the variance and µ_p.min = (σ_y.dark/K + ½)/η.
    """
    signal = series.mean_dn - series.dark_mean_dn
    excess = series.var_dn2 - series.dark_var_dn2
    sat = saturation_index(series, release)
    # what comes after saturation counts as more than it; the reference implementation looks there too
    reach = signal if release == "reference" else np.where(np.arange(signal.shape[-1]) <= sat[..., None], signal, np.inf)
    last_fit = _last(reach <= FIT_RANGE * _at(signal, sat)[..., None])
    if not (last_fit >= 1).any():
        raise MeasureError(
            "fewer than two levels lie between dark and 70 % of saturation",
            where="exposure series",
            remedy="take levels from dark to saturation in about equal steps (EMVA 1288 R4.0 §6.5)",
        )
    fit = np.arange(signal.shape[-1]) <= last_fit[..., None]
    y = np.where(fit, signal, 0.0)
    gain = _dot(y, excess) / _dot(y, y)
    known = light_of(series)
    light = signal if known is None else known[0]
    responsivity = _dot(y, light) / _dot(np.where(fit, light, 0.0), light)
    values = {
        "index_start": np.zeros_like(sat),
        "index_u_ysat": sat,
        "index_sensitivity_min": np.zeros_like(sat),
        "index_sensitivity_max": last_fit,
        "R": responsivity if known else np.full_like(gain, np.nan),
        "K": gain,
        "inverse_K": 1 / gain,
    }
    dark_var = np.maximum(dark_line(series)[2], least_dark_var_dn2)
    values |= _capacity(release, dark_var, gain, responsivity, _at(light, sat), known is not None and known[1] == "photon")
    values |= {f"{key}_area": values[key] / (pixel_area_um2 or np.nan) for key in ("u_p_min", "u_e_min", "u_p_sat", "u_e_sat")}
    line = linearity_line(light, signal, sat, _last(reach <= LINEAR_RANGE[1] * _at(signal, sat)[..., None]))
    values |= {key: line[key] for key in ("index_linearity_min", "index_linearity_max")}
    errors = ("LE_min", "LE_max", "LE") if release == "4.0" else ("LE_min", "LE_max")
    values |= {key: line[key] if known else np.full_like(gain, np.nan) for key in errors}
    if release == "4.0":
        departures = slope_departures(series, gain, last_fit)
        values |= {"PTC_linearity": np.abs(departures).max(axis=-1) if departures.shape[-1] else np.full_like(gain, np.nan)}
    mean_slope, var_slope = dark_line(series)[1::2]
    values |= {"u_I_mean": mean_slope / gain, "u_I_mean_DN": mean_slope, "u_I_var": var_slope / gain**2, "u_I_var_DN": var_slope / gain}
    return values


def saturation_index(series: Series, release: str) -> np.ndarray:
    """Level of saturation, shape (...), int.

    4.0: the highest level with at most 0.2 % of the pixels at the top code; where the variance has fallen by a fifth before that (full
    well below the top code), the maximum of the variance. 3.1: the maximum of the variance. ``reference``: the walk described in
    ``_walk_back``.
    """
    var = np.asarray(series.var_dn2)
    if release == "reference":
        return _walk_back(var)
    if release == "3.1":
        highest: np.ndarray = np.argmax(var, axis=-1)
        return highest
    below = series.fraction_max <= SATURATED_FRACTION
    top = np.where(below.any(axis=-1), _last(below), 0)
    reached = np.arange(var.shape[-1]) <= top[..., None]
    var = np.where(reached, var, -np.inf)
    peak = np.argmax(var, axis=-1)
    return np.where(_at(var, top) < KNEE * _at(var, peak), peak, top)


def _walk_back(var: Array) -> np.ndarray:
    """Saturation as the public implementation 1.0.2 finds it.

    From the last level backwards each level takes over as long as its variance, or that of the next darker one, is not below that of
    the level kept; the first pair that lies below ends the search. (The darker neighbour of the first level is the second.)
    """
    n = var.shape[-1]
    kept, index = np.zeros(var.shape[:-1]), np.zeros(var.shape[:-1], dtype=np.int64)
    walking = np.ones(var.shape[:-1], dtype=bool)
    for i in range(n - 1, -1, -1):
        walking &= (var[..., i] >= kept) | (var[..., abs(i - 1)] >= kept)
        kept = np.where(walking, var[..., i], kept)
        index = np.where(walking, i, index)
    return index


def _capacity(release: str, dark_var: Array, gain: Array, responsivity: Array, light_sat: Array, photons: bool) -> dict[str, Array]:
    """Dark noise, threshold, capacity and what follows from them; in photons only where these are known."""
    noise_e = np.sqrt(dark_var) / gain  # with that of quantisation
    e_min = np.sqrt(noise_e**2 + 0.25) + 0.5 if release == "4.0" else noise_e + 0.5
    efficiency = responsivity / gain if photons else np.full_like(gain, np.nan)
    e_sat = responsivity * light_sat / gain
    snr, ratio = np.sqrt(e_sat), e_sat / e_min
    return {
        "QE": 100 * efficiency,
        "sigma_y_dark": np.sqrt(dark_var),
        "sigma_d": np.sqrt(dark_var - QUANTISATION_DN2) / gain,
        "u_p_min": e_min / efficiency,
        "u_e_min": e_min,
        "u_p_sat": light_sat * np.ones_like(gain) if photons else np.full_like(gain, np.nan),
        "u_e_sat": e_sat,
        "SNR_max": snr,
        "SNR_max_dB": 20 * np.log10(snr),
        "SNR_max_bit": np.log2(snr),
        "inverse_SNR_max": 100 / snr,
        "DR": ratio,
        "DR_dB": 20 * np.log10(ratio),
        "DR_bit": np.log2(ratio),
    }


@np.errstate(divide="ignore", invalid="ignore")  # as above
def linearity_line(light: Array, signal: Array, sat: Array, last: Array) -> dict[str, Array]:
    """Straight line of the signal over the light from 5 to 95 % of saturation with weights 1/y² (R4.0 eq. 58 to 63), and what is left.

    ``sat`` and ``last`` are the levels of saturation and of 95 % of it.

    ``fit_slope``, ``fit_offset``, ``LE``, ``LE_min``, ``LE_max`` and the two indices have shape (...), ``relative_deviation`` (%) and
    ``used`` (..., levels).
    """
    top = _at(signal, sat)[..., None]
    first = np.argmax(signal >= LINEAR_RANGE[0] * top, axis=-1)
    place = np.arange(signal.shape[-1])
    used = (place >= first[..., None]) & (place <= last[..., None])
    w = np.where(used, 1 / np.where(used, signal, 1.0), 0.0)
    hw = light * w
    # (sums of h/y, 1/y, h/y², h²/y², 1/y²)
    h_y, one_y, h_y2, h2_y2, one_y2 = hw.sum(axis=-1), w.sum(axis=-1), _dot(hw, w), _dot(hw, hw), _dot(w, w)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (h_y * h_y2 - h2_y2 * one_y) / (h_y2**2 - h2_y2 * one_y2)
        slope = (h_y - offset * h_y2) / h2_y2
        line = offset[..., None] + slope[..., None] * light
        deviation = 100 * (signal - line) / line
    enough = used.sum(axis=-1) >= MINIMUM_LINE
    inside = np.where(used, deviation, 0.0)

    def checked(values: Array) -> Array:
        return np.where(enough, values, np.nan)

    return {
        "index_linearity_min": first,
        "index_linearity_max": last,
        "fit_slope": slope,
        "fit_offset": offset,
        "LE": checked(np.abs(inside).sum(axis=-1) / np.maximum(used.sum(axis=-1), 1)),
        "LE_min": checked(np.where(used, deviation, np.inf).min(axis=-1)),
        "LE_max": checked(np.where(used, deviation, -np.inf).max(axis=-1)),
        "relative_deviation": deviation,
        "used": used,
    }


def dark_line(series: Series) -> tuple[Array, Array, Array, Array]:
    """Dark mean and its slope, dark variance and its slope: at zero exposure (DN, DN/s, DN², DN²/s), each of shape (...).

    With fewer than three exposures the mean of the shortest, and NaN for the slopes.
    """
    t = series.dark_exposure_s
    if count_exposures(t) < MINIMUM_EXPOSURES:
        shortest = first_of_equal(t) == 0
        mean, var = (v[..., shortest].mean(axis=-1) for v in (series.own_dark_mean_dn, series.own_dark_var_dn2))
        return mean, np.full_like(mean, np.nan), var, np.full_like(var, np.nan)
    from_mean = (t - t.mean()) / ((t - t.mean()) @ (t - t.mean()))
    out = []
    for values in (series.own_dark_mean_dn, series.own_dark_var_dn2):
        slope = values @ from_mean
        out += [values.mean(axis=-1) - slope * t.mean(), slope]
    return out[0], out[1], out[2], out[3]


def slope_departures(series: Series, gain: Array, last_fit: Array) -> Array:
    """Deviations of the photon transfer's local slope from K over the range of the fit, % (R4.0 eq. 51), shape (..., levels).

    ``last_fit`` is the last level of the range. With too few levels the last axis is empty.

    The spline runs through what the straight line leaves, so that it does not matter that its abscissae, and which levels it uses, are
    those of the mean of the draws. Weights 1/σ⁴, as the sampling noise of a variance has it. Being straight at its ends, it shows about
    0.6 of the departure of a parabolic photon transfer there, in exchange for half of the noise that a free cubic has.
    """
    signal, excess = series.mean_dn - series.dark_mean_dn, series.var_dn2 - series.dark_var_dn2
    levels = signal.shape[-1]
    fit = np.arange(levels) <= last_fit[..., None]
    middle, used = (np.reshape(a, (-1, levels)).mean(axis=0) for a in (signal, fit))
    at = np.flatnonzero(used > 0.5)
    at = at[np.argsort(middle[at], kind="stable")]
    at = at[np.r_[True, np.diff(middle[at]) > 1e-9 * np.ptp(middle[at])]]
    if at.size <= SLOPE_DOF:
        return np.empty((*np.shape(gain), 0))
    weights = 1 / np.maximum(np.reshape(series.var_dn2, (-1, levels)).mean(axis=0)[at], QUANTISATION_DN2) ** 2
    left = (excess - gain[..., None] * signal)[..., at]
    slopes = left @ slope_matrix(middle[at], weights, SLOPE_DOF).T
    return 100 * slopes / np.asarray(gain)[..., None]


def _at(values: Array, index: np.ndarray) -> Array:
    """Values at one level each, shape (...)."""
    shape = np.broadcast_shapes(values.shape[:-1], index.shape)
    values, index = np.broadcast_to(values, (*shape, values.shape[-1])), np.broadcast_to(index, shape)
    return np.take_along_axis(values, index[..., None], axis=-1)[..., 0]


def _last(flags: Flags) -> np.ndarray:
    """Index of the last level that is True; -1 where none is."""
    backwards = np.argmax(flags[..., ::-1], axis=-1)
    return np.where(flags.any(axis=-1), flags.shape[-1] - 1 - backwards, -1)


def _dot(a: Array, b: Array) -> Array:
    found: Array = np.einsum("...i,...i->...", *np.broadcast_arrays(a, b))
    return found
