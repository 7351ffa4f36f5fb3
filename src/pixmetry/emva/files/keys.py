"""Keys of the public result format of EMVA 1288 with their units, one spelling of each unit, and the limits that the standard sets."""

from __future__ import annotations

import re
from typing import NamedTuple

from pixmetry.observe.photon_transfer_model import MINIMUM_DARK_VAR_DN2, QUANTISATION_DN2
from pixmetry.observe.stack import EQUAL_EXPOSURE, SATURATED_FRACTION


class Key(NamedTuple):
    """Meaning of a key; ``unit`` in plain text, ``clause`` of EMVA 1288 R4.0 Linear."""

    section: str
    title: str
    symbol: str
    unit: str
    clause: str = ""


OVER_TEMPERATURES = ("u_I_ref", "T_d")  # keys that only several campaigns at different temperatures give
NONLINEAR = "_nonlinear"  # suffix: the same quantity, with the camera's non-linearity taken into account

KEYS: dict[str, Key] = {
    "index_start": Key("info", "First level of the series", "", "1"),
    "index_u_ysat": Key("sensitivity", "Level of saturation", "", "1", "6.6"),
    "index_sensitivity_min": Key("sensitivity", "First level of the fits for gain and responsivity", "", "1", "6.6"),
    "index_sensitivity_max": Key("sensitivity", "Last level of the fits for gain and responsivity", "", "1", "6.6"),
    "R": Key("sensitivity", "Responsivity", "R", "DN/photon", "eq. 49"),
    "K": Key("sensitivity", "System gain", "K", "DN/e⁻", "eq. 50"),
    "inverse_K": Key("sensitivity", "Electrons per grey value", "1/K", "e⁻/DN", "eq. 50"),
    "QE": Key("sensitivity", "Quantum efficiency", "η", "%", "eq. 52"),
    "sigma_y_dark": Key("sensitivity", "Temporal dark noise", "σ_y.dark", "DN", "eq. 53"),
    "sigma_d": Key("sensitivity", "Temporal dark noise", "σ_d", "e⁻", "eq. 53"),
    "u_p_min": Key("sensitivity", "Absolute sensitivity threshold", "µ_p.min", "photon", "eq. 26"),
    "u_p_min_area": Key("sensitivity", "Absolute sensitivity threshold over the pixel's area", "µ_p.min.area", "photon/µm²", "eq. 26"),
    "u_e_min": Key("sensitivity", "Absolute sensitivity threshold", "µ_e.min", "e⁻", "eq. 27"),
    "u_e_min_area": Key("sensitivity", "Absolute sensitivity threshold over the pixel's area", "µ_e.min.area", "e⁻/µm²", "eq. 27"),
    "u_p_sat": Key("sensitivity", "Saturation capacity", "µ_p.sat", "photon", "6.6"),
    "u_p_sat_area": Key("sensitivity", "Saturation capacity over the pixel's area", "µ_p.sat.area", "photon/µm²", "6.6"),
    "u_e_sat": Key("sensitivity", "Saturation capacity", "µ_e.sat", "e⁻", "eq. 24"),
    "u_e_sat_area": Key("sensitivity", "Saturation capacity over the pixel's area", "µ_e.sat.area", "e⁻/µm²", "eq. 24"),
    "SNR_max": Key("sensitivity", "Largest signal-to-noise ratio", "SNR_max", "1", "eq. 55"),
    "SNR_max_dB": Key("sensitivity", "Largest signal-to-noise ratio", "SNR_max", "dB", "eq. 55"),
    "SNR_max_bit": Key("sensitivity", "Largest signal-to-noise ratio", "SNR_max", "bit", "eq. 55"),
    "inverse_SNR_max": Key("sensitivity", "Smallest relative noise", "1/SNR_max", "%", "eq. 55"),
    "DR": Key("sensitivity", "Dynamic range", "DR", "1", "eq. 28"),
    "DR_dB": Key("sensitivity", "Dynamic range", "DR", "dB", "eq. 28"),
    "DR_bit": Key("sensitivity", "Dynamic range", "DR", "bit", "eq. 28"),
    "PTC_linearity": Key("sensitivity", "Largest deviation of the photon transfer's local slope", "δ_PTC", "%", "eq. 51"),
    "index_linearity_min": Key("linearity", "First level of the linearity fit", "", "1", "6.7"),
    "index_linearity_max": Key("linearity", "Last level of the linearity fit", "", "1", "6.7"),
    "LE": Key("linearity", "Linearity error", "LE", "%", "eq. 63"),
    "LE_min": Key("linearity", "Lowest deviation from linearity", "LE_min", "%", "R3.1"),
    "LE_max": Key("linearity", "Highest deviation from linearity", "LE_max", "%", "R3.1"),
    "u_I_mean": Key("dark_current", "Dark current from the mean", "µ_I.mean", "e⁻/s", "eq. 29"),
    "u_I_mean_DN": Key("dark_current", "Dark current from the mean", "µ_I.mean", "DN/s", "eq. 29"),
    "u_I_var": Key("dark_current", "Dark current from the variance", "µ_I.var", "e⁻/s", "eq. 30"),
    "u_I_var_DN": Key("dark_current", "Dark current from the variance", "µ_I.var", "DN/s", "eq. 30"),
    "u_I_ref": Key("dark_current", "Dark current at the temperature of the sheet, from all temperatures", "µ_I.ref", "e⁻/s", "eq. 31"),
    "T_d": Key("dark_current", "Temperature rise that doubles the dark current", "T_d", "K", "eq. 31"),
    "sigma_2_y_stack": Key("spatial", "Temporal variance of the bright stack", "σ²_y.stack", "DN²", "eq. 65"),
    "sigma_2_y_stack_dark": Key("spatial", "Temporal variance of the dark stack", "σ²_y.stack.dark", "DN²", "eq. 65"),
    **{
        f"{key}{tag}": Key("spatial", f"{title}, {'dark' if tag else 'bright'}", f"{symbol}{'.dark' if tag else ''}", "DN²", clause)
        for key, title, symbol, clause in (
            ("s_2_y_measured", "Spatial variance of the mean image", "s²_y.measured", "eq. 35"),
            ("s_2_y", "Spatial variance", "s²_y", "eq. 36"),
            ("s_2_y_cav", "Spatial variance of the column means", "s²_y.cav", "eq. 41"),
            ("s_2_y_rav", "Spatial variance of the row means", "s²_y.rav", "eq. 41"),
            ("s_2_y_col", "Spatial variance of columns", "s²_y.col", "eq. 42"),
            ("s_2_y_row", "Spatial variance of rows", "s²_y.row", "eq. 42"),
            ("s_2_y_pixel", "Spatial variance of pixels", "s²_y.pixel", "eq. 42"),
        )
        for tag in ("", "_dark")
    },
    "DSNU1288": Key("spatial", "Dark-signal non-uniformity", "DSNU₁₂₈₈", "e⁻", "eq. 66"),
    "DSNU1288_DN": Key("spatial", "Dark-signal non-uniformity", "DSNU₁₂₈₈", "DN", "eq. 66"),
    "DSNU1288_row": Key("spatial", "Dark-signal non-uniformity of rows", "DSNU₁₂₈₈.row", "e⁻", "eq. 66"),
    "DSNU1288_col": Key("spatial", "Dark-signal non-uniformity of columns", "DSNU₁₂₈₈.col", "e⁻", "eq. 66"),
    "DSNU1288_pixel": Key("spatial", "Dark-signal non-uniformity of pixels", "DSNU₁₂₈₈.pixel", "e⁻", "eq. 66"),
    "PRNU1288": Key("spatial", "Photo-response non-uniformity", "PRNU₁₂₈₈", "%", "eq. 67"),
    "PRNU1288_row": Key("spatial", "Photo-response non-uniformity of rows", "PRNU₁₂₈₈.row", "%", "eq. 67"),
    "PRNU1288_col": Key("spatial", "Photo-response non-uniformity of columns", "PRNU₁₂₈₈.col", "%", "eq. 67"),
    "PRNU1288_pixel": Key("spatial", "Photo-response non-uniformity of pixels", "PRNU₁₂₈₈.pixel", "%", "eq. 67"),
    "SNR_total_max": Key("spatial", "Largest signal-to-noise ratio with non-uniformity", "SNR_total.max", "1", "eq. 69"),
    # EMVA 1288 R4.0 General: no model of the camera
    "general_u_p_min": Key("general", "Absolute sensitivity threshold, no model", "µ_p.min", "photon", "General"),
    "general_u_p_sat": Key("general", "Saturation capacity, no model", "µ_p.sat", "photon", "General"),
    "general_SNR_max": Key("general", "Largest signal-to-noise ratio at the input", "SNR_p.max", "1", "General"),
    "general_SNR_max_dB": Key("general", "Largest signal-to-noise ratio at the input", "SNR_p.max", "dB", "General"),
    "general_SNR_total_max": Key("general", "The same with non-uniformity", "SNR_p.total.max", "1", "General"),
    "general_DR": Key("general", "Dynamic range, no model", "DR", "1", "General"),
    "general_DR_dB": Key("general", "Dynamic range, no model", "DR", "dB", "General"),
    "general_DSNU": Key("general", "Dark non-uniformity at the input, from pairs of frames", "s_p.dark", "photon", "General"),
    "general_PRNU": Key("general", "Non-uniformity at half of saturation, at the input, from pairs", "s_p.50", "%", "General"),
}


def goes_with_photons(name: str) -> bool:
    """Whether a value is proportional to the number of photons or to its inverse, so that an error of the light's scale is its own."""
    base = name.removesuffix(NONLINEAR)
    return base == "QE" or (base in KEYS and "photon" in KEYS[base].unit)


def key_of(name: str) -> Key:
    """Meaning of a key, with or without the suffix ``_nonlinear``."""
    if name in KEYS:
        return KEYS[name]
    base = KEYS[name.removesuffix(NONLINEAR)]
    return base._replace(title=f"{base.title}, non-linearity taken into account", clause="")


def plain_unit(text: str | None) -> str:
    """Return a unit in plain letters: ``$e^-/\\mu m^2$`` and ``e-/um2`` become ``e⁻/µm²``; an empty one is ``1``.

    Examples
    --------
    >>> plain_unit("$DN/e^-$"), plain_unit("DN2"), plain_unit("p"), plain_unit("")
    ('DN/e⁻', 'DN²', 'photon', '1')
    """
    unit = re.sub(r"\\mu\s*|μ", "µ", text or "")  # the Greek letter becomes the micro sign
    unit = re.sub(r"[$\\{}\s]", "", unit).replace("^", "").replace("e-", "e⁻")
    unit = re.sub(r"\bum", "µm", unit)
    unit = re.sub(r"(?<=DN|µm)2\b", "²", unit)
    return re.sub(r"\bp\b|\bphotons\b", "photon", unit) or "1"


__all__ = [
    "EQUAL_EXPOSURE",
    "FIT_RANGE",
    "MINIMUM_DARK_VAR_DN2",
    "PTC_LIMIT_PERCENT",
    "QUANTISATION_DN2",
    "SATURATED_FRACTION",
    "UNDERFLOW_FRACTION",
]

FIT_RANGE = 0.7  # of saturation, for responsivity and gain (R4.0 §6.6)
UNDERFLOW_FRACTION = 0.005  # of the dark pixels at the lowest code (R4.0 §6.5)
PTC_LIMIT_PERCENT = 3.0  # departure of the photon transfer's local slope up to which the Linear model is used (R4.0 eq. 51)
