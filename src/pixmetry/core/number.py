"""Measured values: one number, and a joint set of numbers with their covariance, as the GUM (JCGM 100 and 102) has them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError

ONE_SIDED_95, TWO_SIDED_95 = 1.6448536, 1.959964  # coverage factors of the normal distribution
VALUE, UPPER_LIMIT, LOWER_LIMIT, NOT_AVAILABLE = KINDS = ("value", "upper_limit", "lower_limit", "not_available")


def effective_dof(variances: ArrayLike, dof: ArrayLike, total: ArrayLike | None = None) -> np.ndarray:
    """Effective degrees of freedom of a sum of variances (Welch and Satterthwaite, JCGM 100 eq. G.2b): ν = u⁴/Σ(uᵢ⁴/νᵢ).

    Parameters
    ----------
    variances, dof : array_like, shape (..., parts)
        uᵢ² and their νᵢ; an infinite one is of a part that is known.
    total : array_like, shape (...), optional
        u², where it is not the sum of the parts.

    Returns
    -------
    ndarray, shape (...)
        ``inf`` where every part that counts is known.

    Examples
    --------
    >>> dof = effective_dof([0.04, 0.01], [9.0, float("inf")])  # u of 0.2 with 9 degrees of freedom, and of 0.1 that is known
    >>> round(float(dof), 4)
    14.0625
    """
    variances, dof = np.asarray(variances, dtype=float), np.asarray(dof, dtype=float)
    whole = variances.sum(axis=-1) if total is None else np.asarray(total, dtype=float)
    # in shares of the total, so that no power of a small u is lost
    shares = np.divide(variances, whole[..., None], out=np.zeros(variances.shape), where=whole[..., None] > 0)
    weight = (shares**2 / dof).sum(axis=-1)
    effective: Array = np.divide(1.0, weight, out=np.full(np.shape(weight), np.inf), where=weight > 0)
    return effective


@dataclass(frozen=True)
class Number:
    """One number with its standard uncertainty, or the limit or the reason that stands for it.

    Parameters
    ----------
    value : float
        The best estimate; of a limit the one-sided 95 % limit. NaN where nothing can be said: then the kind is ``"not_available"``,
        whatever was asked for, and ``reason`` says why.
    u : float
        Standard uncertainty (k = 1); of a limit that of the best estimate behind it. NaN where it is not known.
    dof : float
        Degrees of freedom of ``u``; ``inf`` where it is known.
    unit : str
    method : str
        How the value was obtained, with the clause or reference.
    reason : str
        Why it is a limit or not there, or what the reader should know about it.
    kind : {"value", "upper_limit", "lower_limit", "not_available"}
    name : str
        What it is a number of, where what holds it does not say so.

    Examples
    --------
    >>> from pixmetry import Number
    >>> noise = Number(2.4, 0.3, 9.0, "e⁻", kind="upper_limit", reason="quantisation covers it")
    >>> noise.is_limit, round(noise.representative, 2)
    (True, 1.39)
    """

    value: float
    u: float = math.nan
    dof: float = math.inf
    unit: str = "1"
    method: str = ""
    reason: str = ""
    kind: str = VALUE
    name: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind of a number: {self.kind!r}, not one of {', '.join(KINDS)}")
        if math.isnan(self.value):
            object.__setattr__(self, "kind", NOT_AVAILABLE)
        elif self.kind == NOT_AVAILABLE:
            raise ValueError(f"a number that is not available has no value, and not {self.value}")

    @classmethod
    def not_available(cls, unit: str, reason: str, method: str = "", name: str = "") -> Number:
        """Text in place of a number that is not available."""
        return cls(math.nan, math.nan, math.nan, unit, method, reason, NOT_AVAILABLE, name)

    @property
    def is_available(self) -> bool:
        """Whether there is a value or a limit."""
        return self.kind != NOT_AVAILABLE

    @property
    def is_upper_limit(self) -> bool:
        """Whether the quantity is at most ``value``."""
        return self.kind == UPPER_LIMIT

    @property
    def is_lower_limit(self) -> bool:
        """Whether the quantity is at least ``value``."""
        return self.kind == LOWER_LIMIT

    @property
    def is_limit(self) -> bool:
        """Whether the data only bound the quantity, on one side."""
        return self.kind in (UPPER_LIMIT, LOWER_LIMIT)

    @property
    def representative(self) -> float:
        """The value to calculate with: of an upper limit L the root mean square L/√3 of an even spread between 0 and L."""
        return self.value / 3**0.5 if self.is_upper_limit else self.value

    def interval(self, coverage: float = 0.95) -> tuple[float, float]:
        """Coverage interval: value ∓ t u, with the quantile t of Student's distribution for ``dof`` (JCGM 100, G.3).

        Of a limit, which is one-sided and of 95 % whatever ``coverage`` is, the half line; NaN where there is no value or no u.
        """
        if self.is_limit:
            return (-math.inf, self.value) if self.is_upper_limit else (self.value, math.inf)
        from scipy.special import ndtri, stdtrit

        p = 0.5 + coverage / 2
        half = self.u * float(stdtrit(self.dof, p) if math.isfinite(self.dof) else ndtri(p))
        return self.value - half, self.value + half

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON: ``None`` for NaN, and for infinite degrees of freedom."""
        value, u, dof = (float(x) if math.isfinite(x) else None for x in (self.value, self.u, self.dof))
        head = {"name": self.name} if self.name else {}
        return head | {
            "value": value,
            "u": u,
            "dof": dof,
            "unit": self.unit,
            "kind": self.kind,
            "method": self.method,
            "reason": self.reason,
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Number:
        """The number of its record; ``KeyError``, ``TypeError`` or ``ValueError`` where the record is none."""
        value, u = (math.nan if record[name] is None else float(record[name]) for name in ("value", "u"))
        dof = math.inf if record["dof"] is None else float(record["dof"])
        return cls(value, u, dof, record["unit"], record["method"], record["reason"], record["kind"], record.get("name", ""))


@dataclass(frozen=True)
class Estimates:
    """A joint set of numbers: best estimates with their covariance.

    Parameters
    ----------
    names : tuple of str
        Parameter names; a name is unique within the set and carries its unit as a suffix.
    values : ndarray, shape (n,), float64
        Best estimates (for an upper limit: the limit).
    covariance : ndarray, shape (n, n), float64
        Covariance of the estimates, in the product of their units.
    dof : ndarray, shape (n,), float64
        Effective degrees of freedom of each standard uncertainty; ``inf`` where it is known.
    units : tuple of str
    method : str
        How the values were obtained, with the clause or reference.
    confounders : tuple of str
        What the same observations could be mistaken for.
    limits : frozenset of str
        Names whose value is a one-sided 95 % upper limit.
    lower_limits : frozenset of str
        Names whose value is what the quantity is at least.
    reasons : mapping
        By name: why it is a limit, or what the reader should know about it.
    settings : mapping
        Parameters that are no measured numbers, such as a method or the kind of a filter: those that the data chose.

    Examples
    --------
    >>> gain = Estimates.from_rows([("gain_dn_per_e", 0.21, 0.002, 40.0, "DN/e-")])
    >>> gain["gain_dn_per_e"].value, gain.u
    (0.21, array([0.002]))
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    dof: np.ndarray
    units: tuple[str, ...]
    method: str = ""
    confounders: tuple[str, ...] = ()
    limits: frozenset[str] = frozenset()
    lower_limits: frozenset[str] = frozenset()
    reasons: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, str | int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(set(self.names)) != n:
            raise ValueError(f"names are not unique: {self.names}")
        if self.values.shape != (n,) or self.covariance.shape != (n, n) or self.dof.shape != (n,) or len(self.units) != n:
            raise ValueError(f"shapes do not agree for {self.names}")
        if not (np.isfinite(self.values).all() and np.isfinite(self.covariance).all()):
            raise ValueError(f"estimates must be finite: {self.names} {self.values}")

    @classmethod
    def from_rows(cls, rows: Iterable[tuple[str, float, float, float, str]], **kw: Any) -> Estimates:
        """Make an uncorrelated set from rows ``(name, value, u, dof, unit)``."""
        rows = list(rows)
        return cls(
            names=tuple(r[0] for r in rows),
            values=np.array([r[1] for r in rows], dtype=float),
            covariance=np.diag([float(r[2]) ** 2 for r in rows]).reshape(len(rows), len(rows)),
            dof=np.array([r[3] for r in rows], dtype=float),
            units=tuple(r[4] for r in rows),
            **kw,
        )

    @property
    def u(self) -> np.ndarray:
        """Standard uncertainties, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[Number]:
        return (self[name] for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Position of a name in the set; raises ``MeasureError`` if it is not there."""
        try:
            return self.names.index(name)
        except ValueError:
            raise MeasureError("no such estimate", where=name, allowed=", ".join(self.names)) from None

    def __getitem__(self, name: str) -> Number:
        i = self.index(name)
        return Number(
            name=name,
            value=float(self.values[i]),
            u=float(np.sqrt(self.covariance[i, i])),
            dof=float(self.dof[i]),
            unit=self.units[i],
            method=self.method,
            kind=UPPER_LIMIT if name in self.limits else LOWER_LIMIT if name in self.lower_limits else VALUE,
            reason=self.reasons.get(name, ""),
        )

    def select(self, names: Mapping[str, str] | Iterable[str]) -> Estimates:
        """Take a subset with its covariance; a mapping ``{new: old}`` renames."""
        mapping = dict(names) if isinstance(names, Mapping) else {n: n for n in names}
        i = [self.index(old) for old in mapping.values()]
        return Estimates(
            names=tuple(mapping),
            values=self.values[i],
            covariance=self.covariance[np.ix_(i, i)],
            dof=self.dof[i],
            units=tuple(self.units[k] for k in i),
            method=self.method,
            confounders=self.confounders,
            limits=frozenset(new for new, old in mapping.items() if old in self.limits),
            lower_limits=frozenset(new for new, old in mapping.items() if old in self.lower_limits),
            reasons={new: self.reasons[old] for new, old in mapping.items() if old in self.reasons},
            settings=self.settings,
        )

    def scaled(self, factors: Mapping[str, tuple[float, str]]) -> Estimates:
        """The same set in other units: by name a factor and the new unit.

        Examples
        --------
        >>> delay = Estimates.from_rows([("delay", 0.5, 0.01, 40.0, "px")])
        >>> delay.scaled({"delay": (70.0, "ns")})["delay"].value
        35.0
        """
        by = np.array([factors.get(name, (1.0, ""))[0] for name in self.names])
        units = tuple(factors.get(name, (1.0, unit))[1] for name, unit in zip(self.names, self.units, strict=True))
        return replace(self, values=self.values * by, covariance=self.covariance * np.outer(by, by), units=units)

    def join(self, *others: Estimates) -> Estimates:
        """Put sets from independent data together (zero covariance between them)."""
        sets = [s for s in (self, *others) if len(s)]
        if not sets:
            return replace(self, reasons={k: v for s in (self, *others) for k, v in s.reasons.items()})
        n = sum(len(s) for s in sets)
        covariance = np.zeros((n, n))
        at = 0
        for s in sets:
            covariance[at : at + len(s), at : at + len(s)] = s.covariance
            at += len(s)
        return Estimates(
            names=tuple(name for s in sets for name in s.names),
            values=np.concatenate([s.values for s in sets]),
            covariance=covariance,
            dof=np.concatenate([s.dof for s in sets]),
            units=tuple(unit for s in sets for unit in s.units),
            method="; ".join(dict.fromkeys(s.method for s in sets if s.method)),
            confounders=tuple(dict.fromkeys(c for s in sets for c in s.confounders)),
            limits=frozenset().union(*(s.limits for s in sets)),
            lower_limits=frozenset().union(*(s.lower_limits for s in sets)),
            reasons={k: v for s in (self, *others) for k, v in s.reasons.items()},
            settings={k: v for s in sets for k, v in s.settings.items()},
        )

    @classmethod
    def empty(cls) -> Estimates:
        """An empty set."""
        return cls((), np.zeros(0), np.zeros((0, 0)), np.zeros(0), ())

    def to_records(self) -> list[dict[str, Any]]:
        """Plain records for JSON, one per value (``dof`` is ``None`` where it is infinite)."""
        return [e.to_record() for e in self]
