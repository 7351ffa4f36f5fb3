"""Whether a camera is linear: whether its variance grows with the signal at all, and whether the Linear model of EMVA 1288 R4.0 fits."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.emva.files.keys import FIT_RANGE, KEYS, MINIMUM_DARK_VAR_DN2, PTC_LIMIT_PERCENT
from pixmetry.emva.general.response import end_of
from pixmetry.emva.records import Results, Series
from pixmetry.emva.series import light_of
from pixmetry.emva.temporal import dark_line

HOLDS, FAILS, OPEN, UNKNOWN, CURVED = "holds", "fails", "open", "unknown", "curved"
REASON = (
    "the photon transfer is not that of a linear camera: the temporal variance does not grow with the signal, as with a logarithmic "
    "response or gamma; use the General values, which do not need a linear camera"
)
LEAST_LEVELS = 4  # a line, and what is left of it
TELLING_LEVELS = 8  # with fewer, the scatter about a line is not known well enough to say much
FALSE_ALARM = 1e-3
BELOW_DARK = 0.2  # of the dark variance, which all levels may share with its error
LEAST_GROWTH = 0.1  # of the slope that a line through black has
IN_CODES = ("DN", "DN/s", "DN²")


def following(series: Series) -> np.ndarray:
    """Levels at which the camera still follows the light, whatever its response, shape (levels,), bool."""
    known = light_of(series)
    order, end = end_of(series, series.mean_dn - series.dark_mean_dn if known is None else known[0])
    found = np.zeros(series.mean_dn.size, dtype=bool)
    found[order[: end.seen]] = True
    return found


def is_curved(series: Series) -> bool:
    """Whether the variance of one series (no draws) plainly does not grow with the signal.

    Levels up to 70 % of the largest signal are looked at; all, where these are too few. A linear camera's variance above that in the dark
    is K times its signal. Here the line with a free offset is less than a tenth as steep as that through black, or that one falls and
    the variances are lower than in the dark by more than a fifth; each but for one chance in a thousand by the scatter of the levels.
    """
    used = following(series)
    signal, excess = series.mean_dn - series.dark_mean_dn, series.var_dn2 - series.dark_var_dn2
    if not used.any():
        return False
    darker = used & (signal <= FIT_RANGE * signal[used].max())
    used = darker if darker.sum() >= TELLING_LEVELS else used
    y, v = signal[used], excess[used]
    if y.size < LEAST_LEVELS or not np.ptp(y) > 0:
        return False
    from_mean = (y - y.mean()) / ((y - y.mean()) @ (y - y.mean()))
    slope, through_black = float(from_mean @ v), float(y @ v / (y @ y))
    left, left_black = v - v.mean() - slope * (y - y.mean()), v - through_black * y
    u = float(np.sqrt(left @ left / (y.size - 2) * (from_mean @ from_mean)))
    u_black = float(np.sqrt(left_black @ left_black / (y.size - 1) / (y @ y)))
    from scipy.special import stdtrit

    falls = slope + float(stdtrit(y.size - 2, 1 - FALSE_ALARM)) * u < LEAST_GROWTH * max(through_black, 0.0)
    below = through_black + float(stdtrit(y.size - 1, 1 - FALSE_ALARM)) * u_black < 0
    return falls or below and bool(v.mean() < -BELOW_DARK * series.dark_var_dn2[used].mean())


def level_free_values(series: Series, least_dark_var_dn2: float = MINIMUM_DARK_VAR_DN2) -> dict[str, np.ndarray]:
    """Values that hold for any response: dark noise and dark current in codes; arguments and shapes as of ``temporal_values``."""
    _, mean_slope, var, _ = dark_line(series)
    return {
        "index_start": np.zeros(np.shape(var), dtype=int),
        "sigma_y_dark": np.sqrt(np.maximum(var, least_dark_var_dn2)),
        "u_I_mean_DN": mean_slope,
    }


def is_level_free(key: str) -> bool:
    """Whether a spatial value holds for any response: variances, and the pattern in the dark, in codes."""
    return KEYS[key].unit in IN_CODES


def linear_model(results: Results) -> str:
    """Verdict of the frames on the Linear model.

    Returns
    -------
    str
        ``"holds"``; ``"fails"``: the General model is to be used; ``"open"``: the frames do not tell; ``"unknown"``: not judged;
        ``"curved"``: there is no such line at all, and only General has values.

    Notes
    -----
    The largest of many noisy departures is never zero, so the value and its u are no test. What counts is what frames of a camera just at
    the limit would show (:func:`departure_bounds`): above the 95 % quantile of that the model fails, below the 5 % quantile it holds.
    """
    value, curve = results.values.get("PTC_linearity"), results.curves.get("PTC", {})
    if value is not None and value.reason == REASON:
        return CURVED
    if value is None or not math.isfinite(value.value) or not {"departure_low", "departure_high"} <= set(curve):
        return UNKNOWN
    low, high = (float(np.ravel(curve[name])[0]) for name in ("departure_low", "departure_high"))
    if not math.isfinite(low + high):
        return UNKNOWN
    return FAILS if value.value > high else HOLDS if value.value < low else OPEN


def departure_bounds(departures: np.ndarray) -> tuple[float, float]:
    """The 5 and the 95 % quantile of the largest departure, %, for a camera bent like this one, but just up to the limit.

    Parameters
    ----------
    departures : ndarray, shape (draws, levels)
        Departures of the photon transfer's local slope from K, %, in draws of the series.
    """
    if not departures.shape[-1]:
        return math.nan, math.nan
    middle = departures.mean(axis=0)
    largest = float(np.abs(middle).max())
    shape = middle / largest if largest > 1e-9 else np.ones_like(middle)
    low, high = np.quantile(np.abs(PTC_LIMIT_PERCENT * shape + departures - middle).max(axis=-1), [0.05, 0.95])
    return float(low), float(high)
