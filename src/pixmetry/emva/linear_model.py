"""Whether a camera may be described by the Linear model of EMVA 1288 R4.0: is its photon transfer straight enough?"""

from __future__ import annotations

import math

import numpy as np

from pixmetry.emva.files.keys import PTC_LIMIT_PERCENT
from pixmetry.emva.general.curved import REASON as NOT_LINEAR
from pixmetry.emva.records import Results

HOLDS, FAILS, OPEN, UNKNOWN, CURVED = "holds", "fails", "open", "unknown", "curved"


def linear_model(results: Results) -> str:
    """What the frames say of the Linear model.

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
    if value is not None and value.reason == NOT_LINEAR:
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
