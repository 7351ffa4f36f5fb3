"""Values of which only a limit is known, because the series ends before saturation or quantisation hides the dark noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pixmetry.core.number import LOWER_LIMIT, ONE_SIDED_95, UPPER_LIMIT, Number
from pixmetry.emva.general.general import general_curve, general_evaluation
from pixmetry.emva.general.general_model import light_axis
from pixmetry.emva.general.response import end_of
from pixmetry.emva.reasons import Case, ends_early

ENDS_EARLY = "the series ends before saturation"
FROM_ITS_END = (
    "u_p_sat",
    "u_p_sat_area",
    "u_e_sat",
    "u_e_sat_area",
    "SNR_max",
    "SNR_max_dB",
    "SNR_max_bit",
    "inverse_SNR_max",
    "SNR_total_max",
)
GENERAL_FROM_ITS_END = ("general_u_p_sat", "general_SNR_max", "general_SNR_max_dB", "general_SNR_total_max")
OF_ITS_RANGE = ("LE", "LE_min", "LE_max")
FALLING = ("inverse_SNR_max",)
FAR = 0.5  # of the darkest level: a threshold below that is extrapolated
# of a ratio: what the number is of it
SCALES: dict[str, Callable[[float], float]] = {"": float, "_dB": lambda r: 20 * math.log10(r), "_bit": math.log2}


def with_lower_limits(values: dict[str, Number], case: Case) -> dict[str, Number]:
    """The values with limits in place of those that a longer series, or a camera of higher gain, would show to be larger.

    One-sided 95 % limits, from the value and its u: the camera holds at least what the last level of the series held. A dynamic range is
    that of the lower limit of its capacity over the upper limit of its threshold. What the reference implementation prints stays, with
    the reason.
    """
    out, reference = dict(values), case.formulas.release == "reference"
    early, general_early = ends_early(case.formulas, case.measured), _general_ends_early(case)
    for keys, ends in ((FROM_ITS_END, early), (GENERAL_FROM_ITS_END, general_early)):
        for key in filter(out.get, keys if ends else ()):
            out[key] = _told(out[key], "a lower bound") if reference else _limit(out[key], key)
    if general_early and not reference:
        out |= _last_light(out, case)
    for key in filter(out.get, (*(OF_ITS_RANGE if early else ()), *(("general_PRNU",) if general_early else ()))):
        out[key] = _told(out[key], "the last level is used instead")
    if not reference:
        out |= _hidden_threshold(out, case) | _extrapolated_threshold(out, case)
    for ratio, capacity, threshold, ends in (
        ("DR", "u_e_sat", "u_e_min", early),
        ("general_DR", "general_u_p_sat", "general_u_p_min", general_early),
    ):
        if reference:
            out |= {key: _told(out[key], "a lower bound") for key in _family(ratio, out) if ends}
        elif threshold in out and (ends or out[threshold].is_upper_limit):
            out |= _ratio(out, ratio, capacity, threshold)
    return out


def _limit(value: Number, key: str) -> Number:
    """The value as a one-sided limit."""
    if not math.isfinite(value.value):
        return value
    if key in FALLING:
        limit = replace(value, value=value.value + ONE_SIDED_95 * value.u, kind=UPPER_LIMIT)
        return _told(limit, "95 % upper limit, from its last level")
    limit = replace(value, value=value.value - ONE_SIDED_95 * value.u, kind=LOWER_LIMIT)
    return _told(limit, "95 % lower limit, from its last level")


def _told(value: Number, what: str) -> Number:
    if not math.isfinite(value.value):
        return value
    other = value.reason if value.reason != "the last level of the series" else ""
    return replace(value, reason="; ".join(filter(None, (f"{ENDS_EARLY}: {what}", other))))


def _family(ratio: str, values: dict[str, Number]) -> list[str]:
    return [ratio + scale for scale in SCALES if ratio + scale in values]


def _ratio(values: dict[str, Number], ratio: str, capacity: str, threshold: str) -> dict[str, Number]:
    """Lower limit of a dynamic range, on every scale."""
    top, least, found = values[capacity], values[threshold], values[ratio]
    if least.is_upper_limit:
        lower = top.value - (0.0 if top.is_lower_limit else ONE_SIDED_95 * top.u)
        lower /= least.value
    else:
        lower = found.value - ONE_SIDED_95 * found.u
    if not lower > 0:
        return {}
    out = {}
    for key in _family(ratio, values):
        held = values[key]
        if not held.is_available:
            continue
        told = _told(held, "95 % lower limit, from its last level") if top.is_lower_limit else held
        if not told.reason:
            told = replace(told, reason=f"its threshold is an upper limit: 95 % lower limit ({least.reason})")
        out[key] = replace(told, value=SCALES[key.removeprefix(ratio)](lower), kind=LOWER_LIMIT)
    return out


def _general_ends_early(case: Case) -> bool:
    """Whether the series reaches neither the top code nor a plateau."""
    series = case.formulas.series
    return "general_u_p_sat" in case.measured and not end_of(series, light_axis(series))[1].found


def _last_light(values: dict[str, Number], case: Case) -> dict[str, Number]:
    """The light of the last level, which the camera still follows, as the lower limit of General's capacity."""
    value, m = values["general_u_p_sat"], case.m
    if not math.isfinite(value.value):
        return {}
    light = float(light_axis(case.formulas.series).max())
    return {"general_u_p_sat": replace(value, value=light * (1 - ONE_SIDED_95 * m.photons_u_rel), u=light * m.photons_u_rel, dof=math.inf)}


def _extrapolated_threshold(values: dict[str, Number], case: Case) -> dict[str, Number]:
    """Upper limit of the threshold of a curved camera whose darkest level lies far above it: the noise at the input of that level.

    How the response goes on below is not known; that its noise at the input is not larger there is.
    """
    value, pattern = (values.get(key) for key in ("general_u_p_min", "general_DSNU"))
    if not case.formulas.curved or value is None or pattern is None or not math.isfinite(value.value):
        return {}
    curve = general_curve(case.formulas.plan)
    lowest, ratio = float(curve["photons"][0]), float(curve["snr_p"][0])
    if value.value > FAR * lowest or not ratio > 0:
        return {}
    what = "extrapolated: the response below the darkest level is not known"
    limit = lowest / ratio * (1 + ONE_SIDED_95 * value.u / value.value)
    return {
        "general_u_p_min": replace(
            value, value=max(limit, value.value), reason=f"{what}; 95 % upper limit: the noise at the input of that level", kind=UPPER_LIMIT
        ),
        "general_DSNU": replace(pattern, reason="; ".join(filter(None, (f"{what}, which u does not include", pattern.reason)))),
    }


def _hidden_threshold(values: dict[str, Number], case: Case) -> dict[str, Number]:
    """Upper limit of General's threshold where quantisation hides the dark noise: that of the largest dark noise that may be hidden."""
    value, series = values.get("general_u_p_min"), case.formulas.series
    if value is None or not math.isfinite(value.value) or not case.noise.hidden or case.noise.blind:
        return {}
    noisy = replace(series, dark_var_dn2=np.maximum(series.dark_var_dn2, case.noise.limit_dn2))
    limit = float(general_evaluation(noisy, case.formulas.plan)[0]["general_u_p_min"]) + ONE_SIDED_95 * value.u
    if not math.isfinite(limit):
        return {}
    reason = f"the dark variance lies below {case.noise.limit_dn2:.2g} DN², where quantisation hides it: 95 % upper limit (eq. 54)"
    return {"general_u_p_min": replace(value, value=limit, reason=reason, kind=UPPER_LIMIT)}
