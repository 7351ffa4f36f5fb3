"""How much one value differs from another, in units of the uncertainty of the difference, and what of it is chance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeGuard

from pixmetry.core.number import Number, effective_dof
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


@dataclass(frozen=True)
class Subject:
    """What one file says, whatever its kind: values by (channel, key)."""

    name: str
    kind: str  # "data sheet" or "assessment"
    release: str
    camera: Mapping[str, Any]
    values: Mapping[tuple[str, str], Number]
    absent: Mapping[str, str]  # by source of an assessment: why it was not measured
    photons_u_rel: float = 0.0
    worth: tuple[Any, float] | None = None  # of an assessment: target and estimator, and u of its place, px
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
            return replace(row, verdict="same", reason="without a value in both")
        lacks, value = (two, b) if is_there(a) else (one, a)
        reason = value.reason if value else lacks.absent.get(key.rpartition(".")[0], "")
        return replace(row, verdict="only A" if is_there(a) else "only B", reason=reason)
    if plain_unit(a.unit) != plain_unit(b.unit):
        return replace(row, reason=f"units differ: {plain_unit(a.unit)}, {plain_unit(b.unit)}")
    row = replace(row, difference=b.value - a.value)
    equal = abs(row.difference) <= EQUAL_REL * max(abs(a.value), abs(b.value))
    if key.startswith("index_"):
        foreign = not (one.release or two.release)
        verdict = "equal" if equal else "differs" if foreign else "setting"
        return replace(row, verdict=verdict, reason="" if verdict != "setting" else "place in the series, no property of the camera")
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
    """Signs of b − a that tell of a change: upwards only from an upper limit, or to a lower one; both where no sign does."""
    own = {1 if a.is_upper_limit else -1 if a.is_lower_limit else 0, -1 if b.is_upper_limit else 1 if b.is_lower_limit else 0}
    return own - {0}


def _limits_text(a: Number, b: Number) -> str:
    kinds = ["an upper limit" if v.is_upper_limit else "a lower limit" if v.is_lower_limit else "" for v in (a, b)]
    if kinds[0] and kinds[0] == kinds[1]:
        return f"{kinds[0].split()[1]} limits both"
    return ", ".join(f"{name} is {kind}" for name, kind in zip("AB", kinds, strict=True) if kind)


def _chance(row: Difference, toward: int) -> float:
    """Chance of such a difference where nothing changed; beside a limit only what lies beyond it, with the sign ``toward``, counts."""
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
