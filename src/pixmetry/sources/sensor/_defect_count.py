"""Counting defect pixels in the stacks of dark and bright frames, and describing them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates, Number
from pixmetry.sources.sensor._defect_model import MOST

FOUND_95 = 1.645  # standard deviations above the limit at which 95 of 100 defects are found


def measure(observations: Observations) -> Estimates:
    """Count the defects found in the stacks, and describe them.

    The shares are those of this very unit: every pixel of it was looked at, so a count of none means none, without a limit for what a
    sample might have missed. What u remains is that of the good pixels called defect by chance, √(expected number)/pixels. A pixel whose
    error is below the limit of the search is not counted here: it stays among the good pixels, and their scatter (DSNU, PRNU) holds it.
    Where no hot pixel was found, ``hot_median_e`` is that limit: the excess with which 95 of 100 hot pixels would have been found.
    """
    found = observations.defects
    if found is None:
        raise MeasureError(
            "defects need a stack of dark frames", where="sensor.defects", remedy="take at least 16 dark and 16 bright frames"
        )
    kind = np.array(found.kind, dtype="U5")
    places = {
        "hot": kind == "hot",
        "dead": np.isin(kind, ("dead", "stuck")),
        "cold": kind == "cold",
        "gain": kind == "gain",
        "noisy": kind == "noisy",
    }
    lit = observations.bright_stack is not None or bool(np.isfinite(found.gain_rel).any())
    fit = observations.photon_transfer_fit
    gain = None if fit is None or "gain_dn_per_e" not in fit else fit["gain_dn_per_e"]
    pixels, rows, reasons, limits = found.shape[0] * found.shape[1], [], {}, set()
    for name, here in places.items():
        if name in ("dead", "gain") and not lit:
            continue
        count = int(here.sum())
        if count > MOST * pixels:
            raise MeasureError(
                f"so many pixels are {name} that it is not clear what the good ones are",
                where="sensor.defects",
                value=f"{100 * count / pixels:.3g} %",
                allowed=f"at most {100 * MOST:g} %",
                remedy="see whether light, exposure and temperature were the same in all frames of the stacks",
            )
        by_chance = float(np.sqrt(found.expected_false)) if count else 0.0
        rows.append((f"{name}_fraction", count / pixels, by_chance / pixels, np.inf, "1"))
        if not count:
            reasons[f"{name}_fraction"] = "all pixels were looked at, none was found; smaller errors are in the scatter of the good ones"
    if not places["hot"].any() and gain is not None and np.isfinite(found.dark_limit_dn):
        limit = (found.dark_limit_dn + FOUND_95 * found.dark_sigma_dn) / gain.value
        rows.append(("hot_median_e", min(limit, 1e6), limit * gain.u / gain.value, np.inf, "e-"))
        limits.add("hot_median_e")
        reasons["hot_median_e"] = "none was found; 95 of 100 with this excess would have been"
    rows += _errors(observations, places, gain)
    return Estimates.from_rows(
        rows,
        method="count of pixels beyond the Gaussian core of the others; moments of their errors",
        confounders=("a pixel stuck at the top of the scale counts as hot", "cosmic rays and blinking pixels"),
        limits=frozenset(limits),
        reasons=reasons,
    )


Row = tuple[str, float, float, float, str]


def _errors(observations: Observations, places: Mapping[str, np.ndarray], gain: Number | None) -> list[Row]:
    """How large the errors are of the kinds that were found; those in electrons only if the gain is known."""
    found = observations.defects
    rows: list[Row] = []
    dark_u, response_u = (float(np.nan_to_num(v)) for v in (found.dark_sigma_dn, found.gain_sigma_rel))

    def add_e(name: str, value_dn: float, u_dn: float, dof: float) -> None:
        if gain is not None:
            value = min(value_dn / gain.value, 1e6)
            rows.append((name, value, float(np.hypot(u_dn / gain.value, value * gain.u / gain.value)), dof, "e-"))

    n = {name: int(here.sum()) for name, here in places.items()}
    if n["hot"]:
        log = np.log(np.maximum(found.dark_excess_dn[places["hot"]], 1e-6))
        spread, dof = (float(log.std(ddof=1)), n["hot"] - 1.0) if n["hot"] > 1 else (0.0, np.inf)
        median = float(np.exp(log.mean()))
        own = dark_u / median  # relative, of a single excess: it stands on the pixel's own dark signal
        u_spread = float(np.hypot(spread / np.sqrt(2 * max(n["hot"] - 1, 1)), own / n["hot"] ** 0.5))
        rows.append(("hot_sigma_log", min(spread, 3.0), u_spread, dof, "1"))
        add_e("hot_median_e", median, median * float(np.hypot(spread, own)) / n["hot"] ** 0.5, dof)
    if n["dead"]:
        response = found.gain_rel[places["dead"]]
        u, dof = (float(response.std(ddof=1)), n["dead"] - 1.0) if n["dead"] > 1 else (response_u, np.inf)
        rows.append(("dead_gain_rel", float(np.clip(response.mean(), 0, 0.4999)), u / n["dead"] ** 0.5, dof, "1"))
    if n["cold"]:
        add_e("cold_e", float(np.sqrt((found.dark_excess_dn[places["cold"]] ** 2).mean())), dark_u / n["cold"] ** 0.5, np.inf)
    if n["gain"]:
        rms = float(np.sqrt(((found.gain_rel[places["gain"]] - 1) ** 2).mean()))
        rows.append(("gain_std_rel", min(rms, 10.0), response_u / n["gain"] ** 0.5, np.inf, "1"))
    stack = observations.dark_stack
    if n["noisy"] and stack is not None:
        at = found.row[places["noisy"]], found.col[places["noisy"]]
        std = float(np.sqrt(max(stack.var_map_dn2[at].mean() - np.median(stack.var_map_dn2), 0.0)))
        dof = n["noisy"] * (stack.n_frames - 1.0)
        add_e("noisy_std_e", std, std / np.sqrt(2 * dof), dof)
    return rows
