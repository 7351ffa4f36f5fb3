"""Whether a value lies within its limits, its uncertainty taken into account: decision rules of JCGM 106:2012.

What is known of the quantity after the measurement is a normal distribution about the value with standard deviation ``u``, or with
``dof`` degrees of freedom Student's distribution scaled by ``u``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

from pydantic import Field, PrivateAttr, field_validator, model_validator

from pixmetry.assess.judge.differences import upper_tail
from pixmetry.core.config import Model, load_yaml, validate
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.core.finding import ERROR, NOTE, WARNING, Finding
from pixmetry.core.number import Number
from pixmetry.emva.files.keys import KEYS, NONLINEAR, plain_unit
from pixmetry.emva.records import MONO

Rule = Literal["guarded_acceptance", "simple_acceptance", "guarded_rejection"]


@dataclass(frozen=True)
class Judgement:
    """Decision of a rule on one value; ``acceptance`` is NaN where no value at all would be accepted."""

    verdict: str  # "pass", "fail" or "undecided"
    probability: float  # that the quantity lies within the limits; NaN where nothing is known of it
    guard_band: float  # distance of the acceptance limit from the limit, inwards positive
    acceptance: tuple[float, float]
    rule: str
    reason: str = ""


class Limit(Model):
    """What one value is held against."""

    min: float | None = None
    max: float | None = None
    unit: str = ""
    rule: Rule | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Limit:
        if self.min is None and self.max is None:
            raise ValueError("neither min nor max is given")
        if self.min is not None and self.max is not None and self.min >= self.max:
            raise ValueError(f"min {self.min:g} is not below max {self.max:g}")
        return self


class Limits(Model):
    """A file of limits."""

    schema_: Literal["pixmetry/limits/1"] = Field(alias="schema")
    confidence: float = 0.95
    rule: Rule = "guarded_acceptance"
    limits: dict[str, Limit] = Field(min_length=1)
    _places: dict[str, str] = PrivateAttr(default_factory=dict)  # file and line of each key

    @field_validator("confidence")
    @classmethod
    def _can_be(cls, found: float) -> float:
        if not 0.5 < found < 1:
            remedy = "write 0.95 for 95 %"
            raise InputError("no such confidence", value=found, allowed="above 0.5 and below 1", remedy=remedy)
        return found

    def place(self, key: str) -> str:
        """File and line of the limit of a key, as far as they are known."""
        return f"{self._places.get(key, 'limits')}: {key}"


@dataclass(frozen=True)
class Checked:
    """One value with its limit and the decision."""

    key: str
    channel: str
    value: Number
    lower: float
    upper: float
    judgement: Judgement

    @property
    def finding(self) -> Finding:
        """The same in words: a warning where it is undecided, an error where the value fails."""
        verdict = self.judgement.verdict
        text, level, advice = {
            "pass": ("keeps its limits", NOTE, ""),
            "fail": ("does not keep its limits", ERROR, "Reject the camera for this use, or find what changed and measure again."),
            "undecided": ("may keep its limits or not", WARNING, "Measure with a smaller uncertainty, or agree on wider limits."),
        }[verdict]
        channel = "" if self.channel == MONO else f" [{self.channel}]"
        why = f": {self.judgement.reason}" if self.judgement.reason else ""
        numbers = {"value": self.value} | {n: v for n, v in (("min", self.lower), ("max", self.upper)) if math.isfinite(v)}
        return Finding(f"limit_{verdict}", f"{self.key}{channel} {text}{why}.", advice, level, numbers)


def load_limits(path: str | Path) -> Limits:
    """Read a file of limits (YAML).

    Raises
    ------
    InputError
        If it cannot be read, or something in it cannot be used.
    """
    settings = load_yaml(path)
    found = validate(Limits, settings, str(path))
    lines = {key: settings.lines.get(("limits", key)) for key in found.limits}
    found._places = {key: f"{path}, line {line}" for key, line in lines.items() if line}
    return found


def judge(
    value: float,
    u: float,
    dof: float = math.inf,
    lower: float = -math.inf,
    upper: float = math.inf,
    rule: str = "guarded_acceptance",
    confidence: float = 0.95,
) -> Judgement:
    """Say whether a quantity conforms.

    Parameters
    ----------
    value, u : float
        Measured value and its standard uncertainty, in the unit of the limits; NaN where they are not known.
    dof : float
        Degrees of freedom of ``u``.
    lower, upper : float
        The limits; infinite where there is none.
    rule : str
        ``"guarded_acceptance"`` (JCGM 106, 8.3.2): *pass* if the quantity lies within the limits with the probability ``confidence``;
        *fail* if the value is beyond a limit by k u, with k the quantile of ``confidence`` (1.645 for 0.95); *undecided* between.
        ``"simple_acceptance"`` (8.2): *pass* if the value lies within the limits, else *fail*.
        ``"guarded_rejection"`` (8.3.3): *fail* only if the value is beyond a limit by k u, else *pass*.
    confidence : float

    Returns
    -------
    Judgement

    Raises
    ------
    ParameterError
        If the limits are in the wrong order, ``u`` or ``dof`` cannot be such, or the rule is unknown.

    Notes
    -----
    With one limit the guard band of the guarded acceptance is k u. With two it is so much wider that the probability of conformance at
    the acceptance limit, both tails counted, is ``confidence``; where it is below that even midway, nothing can be accepted.
    """
    if rule not in ("guarded_acceptance", "simple_acceptance", "guarded_rejection"):
        raise ParameterError("unknown rule", where="rule", value=rule, allowed="guarded_acceptance, simple_acceptance, guarded_rejection")
    if not lower < upper or u < 0 or dof <= 0:
        raise ParameterError(
            "needed: lower limit below upper limit, u of at least 0, positive degrees of freedom", value=(lower, upper, u, dof)
        )
    inside = lower <= value <= upper
    if math.isnan(value):
        return Judgement("undecided", math.nan, math.nan, (math.nan, math.nan), rule, "there is no value")
    if rule == "simple_acceptance":
        probability = _within(value, u, dof, lower, upper)
        return Judgement("pass" if inside else "fail", probability, 0.0, (lower, upper), rule)
    if math.isnan(u):
        return Judgement("undecided", math.nan, math.nan, (math.nan, math.nan), rule, "the value has no uncertainty")
    probability = _within(value, u, dof, lower, upper)
    one_sided = _quantile(confidence, dof) * u
    fails = value < lower - one_sided or value > upper + one_sided
    if rule == "guarded_rejection":
        return Judgement("fail" if fails else "pass", probability, -one_sided, (lower - one_sided, upper + one_sided), rule)
    band = _guard_band(u, dof, lower, upper, confidence, one_sided)
    if math.isnan(band):
        reason = "u is too large for these limits: no value would be accepted"
        return Judgement("fail" if fails else "undecided", probability, band, (band, band), rule, reason)
    accepted = lower + band <= value <= upper - band
    verdict = "pass" if accepted else "fail" if fails else "undecided"
    return Judgement(verdict, probability, band, (lower + band, upper - band), rule)


def _within(value: float, u: float, dof: float, lower: float, upper: float) -> float:
    """Probability that the quantity lies within the limits (JCGM 106, 7.4 and 7.5); NaN without ``u``."""
    if u == 0:
        return float(lower <= value <= upper)
    if math.isnan(u):
        return math.nan
    return upper_tail((lower - value) / u, dof) - upper_tail((upper - value) / u, dof)


def _quantile(p: float, dof: float) -> float:
    from scipy.special import ndtri, stdtrit

    return float(ndtri(p) if math.isinf(dof) else stdtrit(dof, p))


def _guard_band(u: float, dof: float, lower: float, upper: float, confidence: float, one_sided: float) -> float:
    """Distance from a limit at which the probability of conformance is ``confidence``; NaN where it is so nowhere."""
    middle = 0.5 * (lower + upper)
    if not math.isfinite(middle) or u == 0:
        return one_sided
    if _within(middle, u, dof, lower, upper) < confidence:
        return math.nan
    from scipy.optimize import brentq

    return float(brentq(lambda y: _within(y, u, dof, lower, upper) - confidence, lower, middle, xtol=1e-12 * u)) - lower


def judge_value(value: Number, limit: Limit, rule: str, confidence: float) -> Judgement:
    """Say whether one value of a data sheet conforms; where only a limit is known, that limit is held against the others."""
    lower = -math.inf if limit.min is None else limit.min
    upper = math.inf if limit.max is None else limit.max
    if value.is_lower_limit:
        verdict, reason = "undecided", "only a lower limit is known"
        if value.value > upper:
            verdict, reason = "fail", "even the lower limit lies above"
        elif value.value >= lower and limit.max is None and confidence <= 0.95:
            verdict, reason = "pass", "the lower limit (95 %) lies above"
        return Judgement(verdict, math.nan, 0.0, (lower, upper), rule, reason)
    if not value.is_upper_limit:
        dof = math.inf if math.isnan(value.dof) else value.dof
        return judge(value.value, value.u, dof, lower, upper, rule, confidence)
    verdict, reason = "undecided", "only an upper limit is known"
    if value.value < lower:
        verdict, reason = "fail", "even the upper limit lies below"
    elif value.value <= upper and limit.min is None and confidence <= 0.95:
        verdict, reason = "pass", "the upper limit (95 %) lies below"
    return Judgement(verdict, math.nan, 0.0, (lower, upper), rule, reason)


def check(values: Mapping[tuple[str, str], Number], limits: Limits) -> tuple[Checked, ...]:
    """Check values against a file of limits, each key in every channel.

    Parameters
    ----------
    values : mapping
        Values by (channel, key), as `pixmetry.assess.judge.subjects.load_subject` reads them.
    limits : Limits

    Returns
    -------
    tuple of Checked

    Raises
    ------
    InputError
        If a key does not exist, or a unit is missing or another one.
    """
    found = []
    for key, limit in limits.limits.items():
        here = {channel: value for (channel, name), value in values.items() if name == key}
        rule = limit.rule or limits.rule
        if not here:
            _refuse_unknown(key, (name for _, name in values), limits.place(key))
            nothing = Number.not_available(limit.unit, "")
            here = {channel: nothing for channel in dict.fromkeys(channel for channel, _ in values)}
        for channel, value in here.items():
            _check_unit(limit, value, limits.place(key))
            lower = -math.inf if limit.min is None else limit.min
            upper = math.inf if limit.max is None else limit.max
            found.append(Checked(key, channel, value, lower, upper, judge_value(value, limit, rule, limits.confidence)))
    return tuple(found)


def _refuse_unknown(key: str, names: Iterable[str], where: str) -> None:
    known = {*KEYS, *names}
    if key not in known and key.removesuffix(NONLINEAR) not in known:
        near = get_close_matches(key, known, n=1)
        remedy = f"did you mean `{near[0]}`?" if near else "take the key from the data sheet"
        raise InputError("no such key", where=where, remedy=remedy)


def _check_unit(limit: Limit, value: Number, where: str) -> None:
    given, unit = plain_unit(limit.unit), plain_unit(value.unit)
    if given != unit:
        what = "the limit lacks its unit" if not limit.unit else "the limit has another unit than the value"
        found = limit.unit or None
        raise InputError(what, where=where, value=found, allowed=unit, remedy=f"give the limit with `unit: {unit}`")
