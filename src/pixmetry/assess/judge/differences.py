"""How far a value lies from another, or from the median of its fleet, in units of its uncertainty; and what of it is chance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeGuard

import numpy as np

from pixmetry.core.number import Number, effective_dof
from pixmetry.core.random import Grid, Stream
from pixmetry.emva.files.keys import NONLINEAR, goes_with_photons, plain_unit

EQUAL_REL = 1e-9  # numbers without uncertainty that agree so well are equal
ROUNDING = 1e-9  # of a square of u: the light's part was all of it
EQUAL_U = 1e-6  # and those that agree to so much of the one uncertainty that is known
SAME_THING = {
    "inverse_K": "K",
    **{f"SNR_max{unit}": "SNR_max" for unit in ("_dB", "_bit")},
    "inverse_SNR_max": "SNR_max",
    **{f"DR{unit}": "DR" for unit in ("_dB", "_bit")},
    "general_SNR_max_dB": "general_SNR_max",
    "general_DR_dB": "general_DR",
}
THREE_QUARTERS = 1.1503493803760079  # so many standard deviations about the mean hold three quarters of a normal distribution
FLEET_DRAWS = 2_000_000


@dataclass(frozen=True)
class Subject:
    """What one file says, whatever its kind: values by (channel, key)."""

    name: str
    kind: str  # "data sheet", "assessment" …
    release: str
    camera: Mapping[str, Any]
    values: Mapping[tuple[str, str], Number]
    absent: Mapping[str, str]  # by value, or by source of an assessment: why it was not measured
    photons_u_rel: float = 0.0
    worth: tuple[Any, Mapping[str, float]] | None = None  # of an assessment: target and estimator; u of a place, px, by end of the key
    how: Mapping[str, str] = field(default_factory=dict)  # of an assessment: what is no number, such as the estimator


@dataclass(frozen=True)
class Difference:
    """One value in both.

    ``verdict`` is ``same`` or ``changed`` where the uncertainties decide; ``equal`` or ``differs`` where there are none and the numbers
    are compared; ``undecided`` where the numbers differ and one has no uncertainty, or where the units differ; ``only A`` or ``only B``
    where the other has no value; ``setting`` for the number of a level in its series, which is no property of the camera.
    """

    channel: str
    key: str
    unit: str
    a: Number | None
    b: Number | None
    difference: float = math.nan  # b - a
    u: float = math.nan  # of the difference; where one has none, of the other
    dof: float = math.nan
    p: float = math.nan  # chance of such a difference, or a larger one, where nothing changed
    verdict: str = "undecided"
    reason: str = ""

    @property
    def in_u(self) -> float:
        """The difference in units of its uncertainty; NaN without one."""
        return self.difference / self.u if self.u > 0 else math.nan


def difference_of(place: tuple[str, str], one: Subject, two: Subject, same_light: bool) -> Difference:
    """Difference with its uncertainty and the chance of it, not yet judged."""
    channel, key = place
    a, b = one.values.get(place), two.values.get(place)
    row = Difference(channel, key, plain_unit(next(v.unit for v in (a, b) if v is not None)), a, b)
    if not is_there(a) or not is_there(b):
        if not is_there(a) and not is_there(b):
            return replace(row, verdict="same", reason="no value in both")
        lacks, value = (two, b) if is_there(a) else (one, a)
        reason = value.reason if value else lacks.absent.get(key, lacks.absent.get(key.rpartition(".")[0], ""))
        return replace(row, verdict="only A" if is_there(a) else "only B", reason=reason)
    if plain_unit(a.unit) != plain_unit(b.unit):
        return replace(row, reason=f"units differ: {plain_unit(a.unit)}, {plain_unit(b.unit)}")
    row = replace(row, difference=b.value - a.value)
    equal = abs(row.difference) <= EQUAL_REL * max(abs(a.value), abs(b.value))
    if key.startswith("index_"):
        foreign = not (one.release or two.release)
        verdict = "equal" if equal else "differs" if foreign else "setting"
        return replace(
            row, verdict=verdict, reason="" if verdict != "setting" else "number of a level in the series, not a property of the camera"
        )
    sides, limits = _sides(a, b), _limits_text(a, b)
    if len(sides) > 1:
        return replace(row, verdict="same", reason=limits)
    toward = next(iter(sides), 0)
    if toward * row.difference < 0 or toward and row.difference == 0:
        return replace(row, verdict="same", p=1.0, reason=limits)
    u_a, u_b = (_u(value, key, subject if same_light else None) for value, subject in ((a, one), (b, two)))
    if math.isnan(u_a) and math.isnan(u_b) or u_a == u_b == 0:
        return replace(row, verdict="equal" if equal else "differs")
    if math.isnan(u_a + u_b):
        row = replace(row, u=u_b if math.isnan(u_a) else u_a)
        equal = equal or abs(row.difference) <= EQUAL_U * row.u
        reason = "" if equal else f"no uncertainty in {'A' if math.isnan(u_a) else 'B'}"
        return replace(row, verdict="equal" if equal else "undecided", reason=reason)
    row = replace(row, u=math.hypot(u_a, u_b), dof=float(effective_dof([u_a**2, u_b**2], [_known(a.dof), _known(b.dof)])))
    return replace(row, p=_chance(row, toward), reason=limits)


def is_there(value: Number | None) -> TypeGuard[Number]:
    """Whether there is a number."""
    return value is not None and math.isfinite(value.value)


def _u(value: Number, key: str, light: Subject | None) -> float:
    """Uncertainty of a value, without the part of the light's calibration if that is common (``light`` given).

    A limit whose uncertainty is not known is a number without one.
    """
    if value.is_limit and math.isnan(value.u):
        return 0.0
    if light is None or not goes_with_photons(key):
        return value.u
    own = value.u**2 - (value.value * light.photons_u_rel) ** 2
    if abs(own) <= ROUNDING * value.u**2:
        return 0.0
    return math.sqrt(own) if own > 0 else value.u  # a u that never held the light's part


def _known(dof: float) -> float:
    """Degrees of freedom that nobody stated count as infinite."""
    return math.inf if math.isnan(dof) else dof


def _sides(a: Number, b: Number) -> set[int]:
    """Signs of b − a that show a change: only upwards from an upper limit or to a lower limit; both if neither is a limit."""
    own = {1 if a.is_upper_limit else -1 if a.is_lower_limit else 0, -1 if b.is_upper_limit else 1 if b.is_lower_limit else 0}
    return own - {0}


def _limits_text(a: Number, b: Number) -> str:
    kinds = ["an upper limit" if v.is_upper_limit else "a lower limit" if v.is_lower_limit else "" for v in (a, b)]
    if kinds[0] and kinds[0] == kinds[1]:
        return f"{kinds[0].split()[1]} limits both"
    return ", ".join(f"{name} is {kind}" for name, kind in zip("AB", kinds, strict=True) if kind)


def _chance(row: Difference, toward: int) -> float:
    """Probability of such a difference without a change; next to a limit only the part beyond it, with the sign ``toward``, counts."""
    if toward:
        return upper_tail(toward * row.in_u, row.dof)
    return 2 * upper_tail(abs(row.in_u), row.dof)


def family(channel: str, key: str) -> tuple[str, str]:
    """Rows of one family say the same thing."""
    base = key.removesuffix(NONLINEAR)
    return channel, SAME_THING.get(base, base) + key[len(base) :]


def holm(p: Sequence[float], families: Sequence[Any], alpha: float) -> tuple[set[int], int]:
    """Which differences are significant with a chance of at most ``alpha`` for any false one (Holm 1979), and the number of decisions.

    The first of a family decides for all of it. Entries with NaN are not judged.
    """
    heads: dict[Any, float] = {}
    for chance, name in zip(p, families, strict=True):
        if not math.isnan(chance):
            heads.setdefault(name, chance)
    rejected = set()
    for i, name in enumerate(sorted(heads, key=heads.__getitem__)):
        if heads[name] > alpha / (len(heads) - i):
            break
        rejected.add(name)
    judged = (i for i, chance in enumerate(p) if not math.isnan(chance))
    return {i for i in judged if families[i] in rejected}, len(heads)


def decided(row: Difference, changed: bool) -> Difference:
    """The row with its verdict, if it was judged by uncertainties."""
    return row if math.isnan(row.p) else replace(row, verdict="changed" if changed else "same")


def upper_tail(x: float, dof: float = math.inf) -> float:
    """Probability above ``x`` of Student's distribution, with infinite ``dof`` of the normal one."""
    from scipy.special import ndtr, stdtr

    return float(ndtr(-x) if math.isinf(dof) or math.isinf(x) else stdtr(dof, -x))


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
