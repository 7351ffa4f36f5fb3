"""Whence the parameters of a camera's elements are known, how uncertain they are, and how a camera file says so.

An element of a camera file may hold beside its ``parameters``:

``known_from``
    ``measured``, ``sheet`` (stated by a data sheet), ``typical`` (usual for such a camera, or assumed); without it the parameters are the
    description of the camera, as in a preset.
``uncertainties``
    By the parameter's name: its standard uncertainty alone; or ``{u, dof, value, upper_limit, lower_limit, unit, reason}``, of which
    ``value`` is the best estimate where the camera is simulated with another one, and a limit is the one-sided 95 % limit.
``covariance``
    By pairs of names, each pair once, where it is not 0.
``method``, ``confounders``
    How the values were obtained, and what the same observations could be mistaken for.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates, Number

if TYPE_CHECKING:
    from pixmetry.camera.camera_schema import ElementRecord, UncertaintyRecord
    from pixmetry.camera.chain_order import Element
    from pixmetry.camera.source import Source

MEASURED, SHEET, TYPICAL, DESCRIBED = KNOWN_FROM = ("measured", "sheet", "typical", "")
ROUNDING = 1e-6  # of a correlation matrix whose values depend on each other


def check_provenance(element: Element, where: str) -> None:
    """Refuse an element that is known from nowhere, or with estimates of what is none of its parameters.

    Raises
    ------
    InputError
    """
    if element.known_from not in KNOWN_FROM:
        allowed = ", ".join(name or "nothing" for name in KNOWN_FROM)
        raise InputError("known from nowhere", where=where, value=element.known_from, allowed=allowed)
    for name in element.estimates.names:
        if name not in element.source.parameters.model_fields:
            allowed = ", ".join(element.source.parameters.model_fields) or "none: it has no parameters"
            raise InputError(f"an estimate of {name}, no parameter of {element.source.id}", where=where, allowed=allowed)


def provenance_record(element: Element) -> dict[str, Any]:
    """What a camera file says beside the parameters of an element; empty where nothing is to say."""
    estimates, units = element.estimates, element.source.units
    record: dict[str, Any] = {"known_from": element.known_from} if element.known_from else {}
    if not len(estimates):
        return record
    own = element.params.model_dump()
    record["uncertainties"] = {e.name: _uncertainty_record(e, own[e.name], units[e.name]) for e in estimates}
    pairs: dict[str, dict[str, float]] = {}
    for i, row in enumerate(estimates.covariance):
        for j in np.flatnonzero(row[i + 1 :]) + i + 1:
            pairs.setdefault(estimates.names[i], {})[estimates.names[j]] = float(row[j])
    more = {"covariance": pairs, "method": estimates.method, "confounders": list(estimates.confounders)}
    return record | {name: value for name, value in more.items() if value}


def _uncertainty_record(number: Number, parameter: float, unit: str) -> float | dict[str, Any]:
    """The standard uncertainty alone, where that is all there is to say beside the parameter."""
    more: dict[str, Any] = {number.kind: number.value} if number.is_limit or number.value != parameter else {}
    if math.isfinite(number.dof):
        more["dof"] = number.dof
    if number.unit != unit:
        more["unit"] = number.unit
    if number.reason:
        more["reason"] = number.reason
    return {"u": number.u} | more if more else number.u


def estimates_of(entry: ElementRecord, source: Source, params: Any, where: str) -> Estimates:
    """The estimates that an entry of a camera file holds of its parameters.

    Raises
    ------
    InputError
        With the entry's place in the file.
    """
    names, stated = tuple(entry.uncertainties), list(entry.uncertainties.values())
    own = params.model_dump()
    for name in names:
        if not isinstance(own.get(name), int | float):
            allowed = ", ".join(n for n, value in own.items() if isinstance(value, int | float)) or "none: it has no numbers"
            raise InputError(f"an uncertainty of {name}, no number of {source.id}", where=where, allowed=allowed, remedy="delete it")
    estimates = Estimates(
        names=names,
        values=np.array([_value_of(number, own[name]) for name, number in entry.uncertainties.items()], float),
        covariance=_covariance(entry, where),
        dof=np.array([math.inf if number.dof is None else number.dof for number in stated], float),
        units=tuple(number.unit or source.units[name] for name, number in entry.uncertainties.items()),
        method=entry.method,
        confounders=entry.confounders,
        limits=frozenset(name for name, number in entry.uncertainties.items() if number.upper_limit is not None),
        lower_limits=frozenset(name for name, number in entry.uncertainties.items() if number.lower_limit is not None),
        reasons={name: number.reason for name, number in entry.uncertainties.items() if number.reason},
    )
    source.make({**own, **{e.name: e.representative for e in estimates}}, where=f"{where}, uncertainties")
    return estimates


def _value_of(number: UncertaintyRecord, parameter: float) -> float:
    return next((v for v in (number.value, number.upper_limit, number.lower_limit) if v is not None), float(parameter))


def _covariance(entry: ElementRecord, where: str) -> np.ndarray:
    """Covariance from the standard uncertainties and the pairs that are given; refused where no joint set can have it."""
    names = list(entry.uncertainties)
    u = np.array([number.u for number in entry.uncertainties.values()], float)
    covariance = np.diag(u**2).reshape(len(names), len(names))
    for first, others in entry.covariance.items():
        for second, value in others.items():
            if first == second or not {first, second} <= set(names):
                allowed = ", ".join(names) or "none: there are no uncertainties"
                raise InputError(f"a covariance of {first} and {second}", where=where, allowed=f"two of {allowed}")
            i, j = names.index(first), names.index(second)
            if covariance[i, j]:
                raise InputError(f"the covariance of {first} and {second} is given twice", where=where, remedy="delete one of the two")
            covariance[i, j] = covariance[j, i] = value
    certain = (u == 0) & (covariance != 0).any(axis=0)
    correlation = covariance / np.where(np.outer(u, u) > 0, np.outer(u, u), 1.0)
    if certain.any() or np.linalg.eigvalsh(correlation).min(initial=0.0) < -ROUNDING:
        allowed = "pairs with correlations from -1 to 1 that go together"
        raise InputError("a covariance that values with these uncertainties cannot have", where=where, allowed=allowed)
    return covariance
