"""A joint set of measured values with their covariance, as the GUM (JCGM 100 and 102) has it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixmetry.core.errors import MeasureError


@dataclass(frozen=True)
class Estimate:
    """One measured value.

    ``kind`` is ``"value"``, or ``"upper_limit"`` where the data only bound the quantity: then ``value`` is the one-sided 95 %
    limit and ``u`` is the standard uncertainty of the best estimate behind it. ``"lower_limit"``: the quantity is ``value`` ± ``u``
    or more.
    """

    name: str
    value: float
    u: float
    dof: float
    unit: str
    method: str
    kind: str = "value"
    reason: str = ""

    @property
    def representative(self) -> float:
        """The value to calculate with: of an upper limit L the root mean square L/√3 of an even spread between 0 and L."""
        return self.value / 3**0.5 if self.kind == "upper_limit" else self.value


@dataclass(frozen=True)
class Estimates:
    """A joint set of estimates.

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

    def __iter__(self):
        return (self[name] for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Position of a name in the set; raises ``MeasureError`` if it is not there."""
        try:
            return self.names.index(name)
        except ValueError:
            raise MeasureError("no such estimate", where=name, allowed=", ".join(self.names)) from None

    def __getitem__(self, name: str) -> Estimate:
        i = self.index(name)
        return Estimate(
            name=name,
            value=float(self.values[i]),
            u=float(np.sqrt(self.covariance[i, i])),
            dof=float(self.dof[i]),
            unit=self.units[i],
            method=self.method,
            kind="upper_limit" if name in self.limits else "lower_limit" if name in self.lower_limits else "value",
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
        )

    def join(self, *others: Estimates) -> Estimates:
        """Put sets from independent data together (zero covariance between them)."""
        sets = [s for s in (self, *others) if len(s)]
        if not sets:
            return self
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
            reasons={k: v for s in sets for k, v in s.reasons.items()},
        )

    @classmethod
    def empty(cls) -> Estimates:
        """A set with nothing in it."""
        return cls((), np.zeros(0), np.zeros((0, 0)), np.zeros(0), ())

    def to_records(self) -> list[dict[str, Any]]:
        """Plain records for JSON, one per value (``dof`` is ``None`` where it is infinite)."""
        return [
            {
                "name": e.name,
                "value": e.value,
                "u": e.u,
                "dof": e.dof if np.isfinite(e.dof) else None,
                "unit": e.unit,
                "kind": e.kind,
                "method": e.method,
                "reason": e.reason,
            }
            for e in self
        ]
