"""The curves of a data sheet that the exposure series gives."""

from __future__ import annotations

import numpy as np

from pixmetry.emva.records import Series
from pixmetry.emva.series import light_of
from pixmetry.emva.temporal import dark_line, linearity_line

Curve = dict[str, np.ndarray]


def temporal_curves(
    series: Series, values: dict[str, np.ndarray], u_var_dn2: np.ndarray, dsnu2_e2: float = 0.0, prnu2_percent2: float = 0.0
) -> dict[str, Curve]:
    """Sensitivity, dark signal, photon transfer, signal-to-noise ratio and linearity.

    Parameters
    ----------
    series : Series
        As measured, without draws.
    values : dict
        ``temporal_values`` of it.
    u_var_dn2 : ndarray, shape (levels,)
        Standard uncertainty of the temporal variances.
    dsnu2_e2, prnu2_percent2 : float
        Squares of DSNU1288 and PRNU1288, for the total signal-to-noise ratio (R4.0 eq. 69); a negative one counts as zero.

    Returns
    -------
    dict
        Arrays of shape (levels,), the dark signal's of shape (dark levels,), reference values of shape (1,). The light stands under
        ``photons``, under ``exposure_s`` where only that is known, under ``mean_dn`` alone where neither tells it.
    """
    signal, excess = series.mean_dn - series.dark_mean_dn, series.var_dn2 - series.dark_var_dn2
    known = light_of(series)
    axis = "mean_dn" if known is None else {"photon": "photons", "s": "exposure_s"}[known[1]]
    light = signal if known is None else known[0]
    responsivity = 1.0 if known is None else float(values["R"])
    gain, sat, last = float(values["K"]), int(values["index_u_ysat"]), int(values["index_sensitivity_max"])
    used = np.arange(signal.size) <= last
    return {
        "sensitivity": {axis: light, "mean_dn": signal, "fit_dn": responsivity * light, "used": used},
        "dark_signal": dark_signal(series),
        "PTC": {
            "mean_dn": signal,
            "var_dn2": excess,
            "u_var_dn2": u_var_dn2,
            "fit_dn2": gain * signal,
            "used": used,
            "saturation": signal[[sat]],
        },
        "SNR": {axis: light, **_snr(series, signal, light, responsivity / gain, values, max(dsnu2_e2, 0.0), max(prnu2_percent2, 0.0))},
        "linearity": _linearity(axis, light, signal, values),
    }


def dark_signal(series: Series) -> Curve:
    """Mean and variance of the dark levels over their exposure, with their lines."""
    mean, mean_slope, var, var_slope = (float(v) for v in dark_line(series))
    t = series.dark_exposure_s
    dark = {"exposure_s": t, "mean_dn": series.own_dark_mean_dn, "var_dn2": series.own_dark_var_dn2}
    return dark | {"fit_dn": mean + np.nan_to_num(mean_slope) * t, "var_fit_dn2": var + np.nan_to_num(var_slope) * t}


def _snr(
    series: Series, signal: np.ndarray, light: np.ndarray, per_light_e: float, values: dict[str, np.ndarray], dsnu2: float, prnu2: float
) -> Curve:
    """Measured ratio (R4.0 eq. 20), the model's (eq. 21), its two limits (eq. 22), the ideal camera's (eq. 23), the total (eq. 69)."""
    electrons = np.maximum(per_light_e * light, 0.0)
    dark2 = float(values["sigma_y_dark"] / values["K"]) ** 2
    ideal = np.sqrt(light) if series.photons is not None else np.full(light.size, np.nan)
    return {
        "snr": np.divide(signal, np.sqrt(series.var_dn2), out=np.full(light.size, np.nan), where=series.var_dn2 > 0),
        "ideal": ideal,
        "shot_limit": np.sqrt(electrons),
        "dark_limit": electrons / np.sqrt(dark2),
        "model": electrons / np.sqrt(dark2 + electrons),
        "total": electrons / np.sqrt(dark2 + electrons + dsnu2 + prnu2 * 1e-4 * electrons**2),
    }


def _linearity(axis: str, light: np.ndarray, signal: np.ndarray, values: dict[str, np.ndarray]) -> Curve:
    line = linearity_line(light, signal, np.asarray(values["index_u_ysat"]), np.asarray(values["index_linearity_max"]))
    return {
        axis: light,
        "mean_dn": signal,
        "fit_dn": line["fit_offset"] + line["fit_slope"] * light,
        "used": line["used"],
        "relative_deviation": line["relative_deviation"],
        "fit_slope": np.atleast_1d(line["fit_slope"]),
        "fit_offset": np.atleast_1d(line["fit_offset"]),
        "linearity_error_min": np.atleast_1d(line["LE_min"]),
        "linearity_error_max": np.atleast_1d(line["LE_max"]),
    }
