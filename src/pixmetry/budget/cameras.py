"""The camera of a budget, from one description or several: what was measured goes before a data sheet, and both are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.chain_order import in_order
from pixmetry.core.errors import InputError

RANK = {"measured": 3, "sheet": 2, "": 1, "typical": 0}  # what goes before what
COVERAGE = 2.0  # expanded uncertainties beyond which two values contradict each other
SHEET_U_REL = 0.1  # of a value of a data sheet that states no uncertainty: assumed


@dataclass(frozen=True)
class Disagreement:
    """One parameter in two descriptions of the camera.

    Parameters
    ----------
    name, parameter, unit : str
        Of the source in the chain.
    first, second : float
        Values, in the order of the descriptions; ``first_from`` and ``second_from`` say whence.
    u : float
        Standard uncertainty of their difference; 10 % of a value that states none.
    """

    name: str
    parameter: str
    unit: str
    first: float
    second: float
    first_from: str
    second_from: str
    u: float

    @property
    def agree(self) -> bool:
        """Whether they lie within two standard uncertainties of their difference."""
        return abs(self.first - self.second) <= COVERAGE * self.u


def camera_of(given: str | Path | Camera | Sequence[str | Path | Camera]) -> tuple[Camera, tuple[Disagreement, ...]]:
    """One camera of one description or several.

    Parameters
    ----------
    given : path, name of a preset, Camera, or several of them
        Camera files, data sheets, presets.

    Returns
    -------
    Camera
        That of the first description; a source that another one knows better (measured before sheet before typical) is taken from there.
    tuple of Disagreement
        Every parameter that two descriptions know, from measurements or data sheets.

    Raises
    ------
    InputError
        If nothing is given, or two descriptions are of sensors of another size.
    """
    several = [given] if isinstance(given, str | Path | Camera) else list(given)
    if not several:
        raise InputError("no camera is given", allowed="a preset, a camera file or a data sheet")
    cameras = [c if isinstance(c, Camera) else load_camera(c) for c in several]
    camera, found = cameras[0], []
    for other in cameras[1:]:
        if other.frame_shape != camera.frame_shape:
            sizes = " and ".join(f"{c.frame_shape[1]} × {c.frame_shape[0]} px in {c.name}" for c in (camera, other))
            raise InputError("the descriptions are of different sensors", value=sizes, remedy="name descriptions of one camera")
        found += _compared(camera, other)
        camera = _joined(camera, other)
    return camera, tuple(found)


def _joined(one: Camera, other: Camera) -> Camera:
    """The first camera with what the other one knows better, all elements of a source together."""
    mine, theirs = _by_source(one), _by_source(other)
    for source_id, elements in theirs.items():
        if source_id not in mine or _rank(elements) > _rank(mine[source_id]):
            mine[source_id] = elements
    ordered = in_order(elements[0].source for elements in mine.values())
    facts = {**other.facts, **one.facts}
    chain = tuple(e for s in ordered for e in mine[s.id])
    return replace(one, chain=chain, pitch_um=one.pitch_um or other.pitch_um, facts=facts)


def _by_source(camera: Camera) -> dict[str, list[Element]]:
    found: dict[str, list[Element]] = {}
    for element in camera.chain:
        found.setdefault(element.source.id, []).append(element)
    return found


def _rank(elements: Sequence[Element]) -> int:
    return max(RANK[e.known_from] for e in elements)


def _compared(one: Camera, other: Camera) -> list[Disagreement]:
    theirs = _by_source(other)
    found = []
    for element in one.chain:
        there = theirs.get(element.source.id, [])
        second = there[0] if len(there) == 1 else next((e for e in there if e.name == element.name), None)
        if second is None or not {element.known_from, second.known_from} <= {"measured", "sheet"}:
            continue
        for name in type(element.params).model_fields:
            a, b = _value(element, name), _value(second, name)
            if a is None or b is None:
                continue
            u = float(np.hypot(a[1], b[1]))
            unit = element.source.units[name]
            found.append(Disagreement(element.name, name, unit, a[0], b[0], element.known_from, second.known_from, u))
    return found


def _value(element: Element, name: str) -> tuple[float, float] | None:
    """Value and standard uncertainty of a parameter; None where the description knows none."""
    if name in element.estimates.names:
        number = element.estimates[name]
        return None if number.kind != "value" else (number.value, number.u)
    value = getattr(element.params, name)
    if element.known_from != "sheet" or isinstance(value, bool | str) or value is None:
        return None
    if getattr(element.source.neutral, name, None) == value or value == type(element.params).model_fields[name].default:
        return None  # the sheet does not tell it
    return float(value), SHEET_U_REL * abs(float(value))
