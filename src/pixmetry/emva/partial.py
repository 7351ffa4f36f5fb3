"""What can be said by EMVA 1288 where there is no exposure series to speak of: of dark frames alone, of one light level, of two stacks."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.errors import MeasureError, PixmetryError
from pixmetry.core.number import ONE_SIDED_95, UPPER_LIMIT, VALUE, Number
from pixmetry.core.random import generator
from pixmetry.emva.files.keys import KEYS, MINIMUM_DARK_VAR_DN2
from pixmetry.emva.formulas import keys_of
from pixmetry.emva.reasons import BROKEN
from pixmetry.emva.records import Measurement, Results
from pixmetry.emva.scatter import sampling_u
from pixmetry.emva.series import MINIMUM_EXPOSURES, count_exposures, dark_order, first_of_equal
from pixmetry.emva.spatial.spatial import PARTS, spatial_variances
from pixmetry.emva.spatial.spatial_inputs import SpatialInputs

DRAWS = 2000
SEED = 1288


def partial_results(m: Measurement, release: str, problem: MeasureError) -> Results:
    """All keys of a release: values that need no series, and for the others the reason.

    Parameters
    ----------
    m : Measurement
    release : {"4.0", "3.1", "reference"}
    problem : MeasureError
        Why there is no series.
    """
    found = _dark_levels(m, release) | _stacks(m, release)
    why = str(problem).removeprefix("exposure series: ")
    values = {}
    for key in keys_of(release):
        method = f"EMVA 1288 R{release} {KEYS[key].clause}".strip() if release != "reference" else "reference implementation 1.0.2"
        nothing = Number.not_available(KEYS[key].unit, f"needs an exposure series: {why}", method)
        values[key] = found.get(key, nothing)
    note = f"no exposure series: {why}; only values without such a series are given"
    return Results(release, values, notes=(*m.notes, note), channel=m.channel)


def _value(key: str, value: float, u: float, dof: float = math.inf, reason: str = "", kind: str = VALUE) -> Number:
    return Number(value, u, dof, KEYS[key].unit, f"EMVA 1288 {KEYS[key].clause}".strip(), reason, kind)


def _dark_levels(m: Measurement, release: str) -> dict[str, Number]:
    """Dark noise in codes, and with three exposures or more the dark current in codes."""
    if m.transfer.dark.mean_dn.size == 0:
        return {}
    dark, order = m.transfer.dark, dark_order(m.transfer.dark)
    exposure, mean, var = dark.exposure_s[order], dark.mean_dn[order], dark.var_total_dn2[order]
    shortest = first_of_equal(exposure) == 0
    middle = float(var[shortest].mean())
    u = float(np.linalg.norm(sampling_u(dark, m.transfer.frame_shape)[order][shortest]) / shortest.sum())
    hidden = middle < MINIMUM_DARK_VAR_DN2
    reason = "the dark variance lies below 0.24 DN², where quantisation hides it: an upper limit (eq. 54)" if hidden else ""
    root = math.sqrt(max(middle, MINIMUM_DARK_VAR_DN2))
    kind = UPPER_LIMIT if hidden and release != "reference" else VALUE
    out = {"sigma_y_dark": _value("sigma_y_dark", root, u / (2 * root), math.inf, reason, kind)}
    if count_exposures(exposure) >= MINIMUM_EXPOSURES:
        line, covariance = np.polyfit(exposure, mean, 1, cov="unscaled")
        dof = exposure.size - 2
        least = 1 / float(dark.n_frames.max() * np.prod(m.transfer.frame_shape))  # one pixel that toggled once
        wander2 = float(((mean - np.polyval(line, exposure)) ** 2).sum()) / dof + least**2
        out["u_I_mean_DN"] = _value("u_I_mean_DN", float(line[0]), math.sqrt(wander2 * covariance[0, 0]), dof)
    return out


def _stacks(m: Measurement, release: str) -> dict[str, Number]:
    """Variances of each stack, the dark pattern in codes, and of both stacks the non-uniformity of the response."""
    rng = generator(SEED, "partial")
    inputs: dict[str, SpatialInputs] = {}
    variances: dict[str, np.ndarray] = {}
    draws: dict[str, np.ndarray] = {}
    for tag, stack in (("_dark", m.dark_stack), ("", m.bright_stack)):
        if stack is None:
            continue
        try:
            inputs[tag] = SpatialInputs.of(stack, release == "4.0")
        except PixmetryError:
            continue
        drawn = inputs[tag].draws(DRAWS, rng)
        variances |= spatial_variances(inputs[tag], inputs[tag].vector, release, tag)
        draws |= spatial_variances(inputs[tag], drawn, release, tag)
    out = {key: _value(key, float(variances[key]), float(np.std(draws[key]))) for key in variances}
    if "_dark" in inputs:
        out["DSNU1288_DN"] = _root("DSNU1288_DN", float(variances["s_2_y_dark"]), float(np.std(draws["s_2_y_dark"])))
    if len(inputs) == 2 and inputs[""].vector[0] > inputs["_dark"].vector[0]:
        rows, cols = inputs[""].shape
        scale = (100.0 / float(inputs[""].vector[0] - inputs["_dark"].vector[0])) ** 2
        for part in PARTS:
            bright, dark = f"s_2_y{part}", f"s_2_y{part}_dark"
            u = scale * float(np.hypot(np.std(draws[bright]), np.std(draws[dark])))
            lines, length = {"_row": (rows, cols), "_col": (cols, rows)}.get(part, (rows * cols, 1))
            chance = 2 * scale * float(variances["s_2_y"] + variances["s_2_y_dark"]) / (length * math.sqrt(lines))
            out[f"PRNU1288{part}"] = _root(f"PRNU1288{part}", scale * float(variances[bright] - variances[dark]), u, chance)
    return out


def _root(key: str, square: float, u_square: float, chance: float = 0.0) -> Number:
    """A root of a square with its u, a limit, or nothing where the square is far below zero; ``chance``: scatter from sensor to sensor."""
    if square < -BROKEN * math.hypot(u_square, chance):
        reason = f"the variance behind it is far below zero ({square:.3g} in {KEYS[key].unit} squared): no value and no limit"
        return _value(key, math.nan, math.nan, math.nan, reason)
    if square < ONE_SIDED_95 * u_square:
        limit = math.sqrt(max(square, 0.0) + ONE_SIDED_95 * u_square)
        u, reason = u_square / (2 * limit) if limit > 0 else 0.0, "not significantly above zero; 95 % upper limit"
        return _value(key, limit, u, reason=reason, kind=UPPER_LIMIT)
    return _value(key, math.sqrt(square), u_square / (2 * math.sqrt(square)))
