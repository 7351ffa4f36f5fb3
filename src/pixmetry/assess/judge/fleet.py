"""How far each camera lies from the middle of its fleet, in units of a spread that the odd ones do not move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pixmetry.assess.judge.differences import EQUAL_REL, Subject, is_there
from pixmetry.core.random import Grid, Stream
from pixmetry.emva.files.keys import plain_unit

THREE_QUARTERS = 1.1503493803760079  # so many standard deviations about the mean hold three quarters of a normal distribution
FLEET_DRAWS = 2_000_000


@dataclass(frozen=True)
class FleetRow:
    """One value over a fleet; ``values`` and ``scores`` have one entry a camera, NaN where it has no value."""

    channel: str
    key: str
    unit: str
    median: float
    spread: float  # standard deviation between cameras, from the nearest three quarters of them; at least the median of u
    u: float  # median of the uncertainties
    values: tuple[float, ...]
    scores: tuple[float, ...]  # distance from the median in units of the spread
    stands_out: tuple[bool, ...]


def fleet_row(place: tuple[str, str], subjects: Sequence[Subject]) -> FleetRow | None:
    """One value over the fleet, not yet judged; None where fewer than three cameras have it in one unit."""
    held = [s.values.get(place) for s in subjects]
    units = [plain_unit(v.unit) for v in held if v is not None]
    unit = max(units, key=units.count)
    judged = [v if is_there(v) and not v.is_limit and plain_unit(v.unit) == unit else None for v in held]
    if sum(v is not None for v in judged) < 3:
        return None
    values = np.array([math.nan if v is None else v.value for v in judged])
    u = np.array([math.nan if v is None else v.u for v in judged])
    usable = np.array([v is not None for v in judged])
    median = float(np.nanmedian(values))
    typical = float(np.nanmedian(u)) if np.isfinite(u).any() else 0.0
    spread = max(float(_spread(np.abs(values[usable] - median))), typical)
    own = np.sqrt(spread**2 + np.maximum(np.nan_to_num(u) ** 2 - typical**2, 0.0))
    far = np.where(np.abs(values - median) <= EQUAL_REL * np.maximum(np.abs(values), abs(median)), 0.0, values - median)
    scores = np.divide(far, own, out=np.where(far == 0, 0.0, np.copysign(math.inf, far)), where=own > 0)
    scores[~usable] = math.nan
    n = len(subjects)
    return FleetRow(*place, unit, median, spread, typical, tuple(values.tolist()), tuple(scores.tolist()), (False,) * n)


def _spread(distances: np.ndarray) -> np.ndarray:
    """Standard deviation of normal values from their distances to the median, shape (..., n), by the nearest three quarters."""
    n = distances.shape[-1]
    nearest = min(math.ceil(0.75 * n), n - 1) - 1
    return np.partition(distances, nearest, axis=-1)[..., nearest] / THREE_QUARTERS


def fleet_chance(n: int, score: float) -> float:
    """Chance that a camera of a normal fleet of ``n`` lies at least so many spreads from the median; NaN for NaN."""
    if math.isnan(score):
        return math.nan
    table = _distances(n)
    return (1 + len(table) - int(np.searchsorted(table, np.float32(abs(score))))) / (1 + len(table))


@lru_cache(8)
def _distances(n: int) -> np.ndarray:
    """Distances from the median in units of the spread, in normal fleets of ``n``, in order; drawn."""
    x = Stream(0, n, "emva.fleet").normal(Grid.whole([0], (max(FLEET_DRAWS // n, 1000), n)))[0]
    x = np.abs(x - np.median(x, axis=1, keepdims=True))
    return np.sort((x / _spread(x)[:, None]).ravel())
