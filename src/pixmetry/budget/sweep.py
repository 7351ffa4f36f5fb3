"""A budget over a range of one entry, as ``light.f_number=2.8:16``, or over values of it, as ``target.diameter_px=5,7,10``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pixmetry.budget.answer import Answer, rms
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.changes import changed
from pixmetry.budget.scenario import Scenario
from pixmetry.camera.camera import Camera
from pixmetry.camera.overrides import parse_override
from pixmetry.core.errors import InputError

STEPS, MOST = 5, 200
STEADY = 0.1  # relative change of the total that is none to speak of
WIDE = 3.0  # ratio of both ends from which on steps are in proportion


@dataclass(frozen=True)
class Step:
    """One value, what the budget comes to (on the object in mm, rms of x and y, where the scale is known), and its largest source."""

    value: float
    answer: Answer
    largest: str
    after_mm: float | None = None


@dataclass(frozen=True)
class Sweep:
    """Answers of one target in one frame over the values of one entry."""

    key: str
    steps: tuple[Step, ...]

    @property
    def steady_from(self) -> float | None:
        """Value from which on the total after the calibration stays within 10 % of the last; None if that is the first or the last one."""
        totals = [rms(s.answer.after_px) for s in self.steps]
        away = [k for k, total in enumerate(totals) if abs(total - totals[-1]) > STEADY * totals[-1]]
        return self.steps[away[-1] + 1].value if away and away[-1] + 2 < len(totals) else None

    @property
    def sentence(self) -> str:
        """From where on the total hardly changes any more; empty if there is nothing to say."""
        at = self.steady_from
        return "" if at is None else f"From {self.key} {at:g} on, the total changes by less than {100 * STEADY:.0f} %."

    def to_record(self) -> dict[str, Any]:
        """Return the plain record for JSON."""
        return asdict(self)


def parse_sweep(text: str) -> tuple[str, tuple[float, ...]]:
    """Read ``KEY=FROM:TO``, ``KEY=FROM:TO:STEPS`` or ``KEY=VALUE,VALUE,…``; steps are in proportion where the ends are far apart.

    Raises
    ------
    InputError

    Examples
    --------
    >>> parse_sweep("light.f_number=2:32:5")
    ('light.f_number', (2.0, 4.0, 8.0, 16.0, 32.0))
    >>> parse_sweep("target.diameter_px=5,7")
    ('target.diameter_px', (5.0, 7.0))
    """
    form = InputError(
        "not a range", value=text, allowed="KEY=FROM:TO, KEY=FROM:TO:STEPS or KEY=VALUE,VALUE, such as target.diameter_px=3:12"
    )
    key, _, value = (part.strip() for part in text.partition("="))
    parts = value.split(":") if ":" in value else value.split(",")
    numbers = [parse_override(f"x={part.strip()}")[1] for part in parts if part.strip()]
    if (
        not key
        or len(numbers) < 2
        or len(numbers) != len(parts)
        or any(isinstance(n, bool) or not isinstance(n, int | float) for n in numbers)
    ):
        raise form
    if ":" not in value:
        return key, tuple(float(n) for n in numbers)
    first, last, count = float(numbers[0]), float(numbers[1]), int(numbers[2]) if len(numbers) > 2 else STEPS
    if len(numbers) > 3 or not 2 <= count <= MOST or first == last:
        raise form
    wide = first > 0 and last > 0 and max(first, last) / min(first, last) >= WIDE
    values = np.geomspace(first, last, count) if wide else np.linspace(first, last, count)
    between = (float(f"{v:.3g}") for v in values[1:-1])  # whoever gives ends only wants round values between them
    return key, (first, *between, last)


def sweep_of(
    camera: Camera, scenario: Scenario, key: str, values: Sequence[float], budget_of: Callable[[Camera, Scenario], CameraBudget]
) -> Sweep:
    """Budget the camera with each of these values.

    Raises
    ------
    InputError
        If there is no such entry, or a value is out of its range.
    """
    settings = [changed(camera, scenario, {key: value}) for value in values]  # before the work
    steps = []
    for value, (one, asked) in zip(values, settings, strict=True):
        found = budget_of(one, asked)
        mm = found.mm(found.one.after_px)
        steps.append(Step(value, found.one, next((r.title for r in found.rows if r.counts), ""), None if mm is None else rms(mm)))
    return Sweep(key, tuple(steps))
