"""The order of a chain: which sources may follow each other, and how to sort them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pixmetry.camera.conversions import conversion
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.core.errors import ChainError
from pixmetry.core.number import Estimates

RANK = {Kind.LIGHT: 0, Kind.PHOTONS: 1, Kind.ELECTRONS: 2, Kind.DN: 3, Kind.VIDEO: 3, Kind.CODES: 4}  # in which a chain goes through them


@dataclass(frozen=True)
class Element:
    """One place in a chain: a source under a name of its own, with parameters; switched on or off.

    ``maps`` is what was measured of the unit that the camera speaks of, in place of what ``forward`` draws (see `Source.maps`).
    ``known_from`` says whence the parameters are known: ``"measured"``, ``"sheet"``, ``"typical"``, or ``""`` for the description of the
    camera; ``estimates`` how uncertain they are, where that is known (see ``camera.provenance``).
    """

    name: str
    source: Source
    params: Any
    on: bool = True
    maps: Mapping[str, np.ndarray] = field(default_factory=dict, compare=False, repr=False)
    known_from: str = ""
    estimates: Estimates = field(default_factory=Estimates.empty, compare=False, repr=False)

    def with_params(self, params: Any) -> Element:
        """The element with other parameters.

        Of those that change, a map that stands for one goes, and its pattern is drawn; their estimates go, and with them that all of
        the element is known from one place.
        """
        changed = {name for name in type(params).model_fields if getattr(params, name) != getattr(self.params, name)}
        if not changed:
            return replace(self, params=params)
        maps = {name: array for name, array in self.maps.items() if not changed & set(self.source.maps[name])}
        estimates = self.estimates.select([name for name in self.estimates.names if name not in changed])
        return replace(self, params=params, maps=maps, known_from="", estimates=estimates)


def check_chain(chain: Sequence[Element], where: str = "camera") -> None:
    """Check names, kinds and declared order of a chain.

    Raises
    ------
    ChainError
        Naming the first two elements that do not fit together.
    """
    names = [e.name for e in chain]
    for name in names:
        if names.count(name) > 1:
            raise ChainError(f"the name {name!r} is used twice", where=where, remedy="delete one, or give it another `name: …`")
    kind = Kind.LIGHT
    for i, element in enumerate(chain):
        source = element.source
        if not element.on:
            continue
        if source.forward is None:
            raise ChainError(f"{element.name} cannot stand in a camera: {source.reasons['forward']}", where=where, remedy="take it out")
        step = conversion(kind, source.consumes)
        if step is not None and step.produces is not None:
            kind = step.produces
        if kind not in source.consumes:
            given = Kind.PHOTONS if kind is Kind.LIGHT else kind
            raise ChainError(
                f"{element.name} cannot follow: it takes {', '.join(source.consumes)} and gets {given}",
                where=where,
                remedy="change the order",
            )
        kind = source.produces or kind
        for later in chain[i + 1 :]:
            if _named(later.source, source.after) and later.on and not _by_kind(source, later.source):
                raise ChainError(f"{element.name} must come after {later.name}", where=where, remedy="change the order")
        for earlier in chain[:i]:
            if _named(earlier.source, source.before) and earlier.on and not _by_kind(source, earlier.source):
                raise ChainError(f"{element.name} must come before {earlier.name}", where=where, remedy="change the order")
    _check_bits([e for e in chain if e.on], where)


def _check_bits(chain: Sequence[Element], where: str) -> None:
    """Refuse steps on codes that would cut off all codes but the lowest, because they assume fewer bits than the converter has."""
    converter: Element | None = None
    for element in chain:
        bits = getattr(element.params, "bits", None)
        if bits is None:
            continue
        if element.source.produces is Kind.CODES:
            converter = element
        elif converter is not None and bits < converter.params.bits:
            raise ChainError(
                f"{element.name} takes fewer bits than {converter.name} makes",
                value=bits,
                allowed=f"{converter.params.bits} or more",
                where=where,
                remedy=f"set {element.name}.bits",
            )


def in_order(sources: Iterable[Source]) -> list[Source]:
    """Sort sources into an order in which a camera takes them: by their kinds, their ``after`` and ``before``, and their stages.

    Raises
    ------
    ChainError
        If they have no such order.
    """
    from pixmetry.camera.catalogue import STAGES

    left, done = list(sources), []

    def must_wait(source: Source, other: Source) -> bool:
        """Whether ``source`` comes after ``other``: by what they take, else as they say, else by stage."""
        if _by_kind(source, other):
            return _by_kind(source, other) > 0
        if _named(other, source.after) or _named(source, other.before):
            return True
        if _named(source, other.after) or _named(other, source.before):
            return False
        if source.stage != other.stage:
            return STAGES.index(source.stage) > STAGES.index(other.stage)
        converts = other.produces is not None and other.produces in source.consumes and not set(source.consumes) & set(other.consumes)
        would_not_be_taken = source.produces is not None and source.produces not in other.consumes
        return converts or would_not_be_taken

    while left:
        free = next((s for s in left if not any(must_wait(s, o) for o in left if o is not s)), None)
        if free is None:
            raise ChainError("these sources have no order", value=[s.id for s in left], remedy="check their after and before")
        left.remove(free)
        done.append(free)
    return done


def _by_kind(source: Source, other: Source) -> int:
    """1 if what they take leaves ``source`` only places after ``other``, -1 before it, 0 if both ways are open."""
    mine, others = ([RANK[kind] for kind in s.consumes] for s in (source, other))
    return (min(mine) > max(others)) - (max(mine) < min(others))


def _named(source: Source, names: tuple[str, ...]) -> bool:
    return source.id in names or source.stage in names
