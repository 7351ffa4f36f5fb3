"""The steps of a capture: the groups of a shooting list in the order in which they are taken."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from pixmetry.budget.set_ups import FLAT, FLAT_STEPS, SetUp, set_up_of
from pixmetry.budget.shooting import scaled_set_up
from pixmetry.core.errors import InputError

DARKEST, BRIGHTEST, STACK = 0.03, 1.0, 0.5  # levels of the photon transfer, shares of saturation
LIGHT = {"chart": 0.9, "light_off": 0.5, "pattern": 0.5, "border": 0.5, "speckle": 0.1}  # of pictures; of all others
USUAL_LIGHT = 0.7
SPOT_LIGHT = (0.5, 2.0, 5.0, 10.0, 20.0)
LONGEST_S = {"sequence": 0.004}  # exposure times that a set-up limits
ASKED = re.compile(r"<(.+)>")
FROM_STAMPS = ("series", "motion", "sequence")  # their times are those of the frames
DARK_SCENE = "Cap the lens: no light may reach the sensor."
TO_THE_TOP = ("spots",)


@dataclass(frozen=True)
class Step:
    """One group of frames to take.

    Parameters
    ----------
    number : int
        From 1, in the order of taking.
    set_up : str
        Kind of its set-up.
    kind : str
        As in the manifest.
    scene : str
        What the operator is asked to show.
    place : str
        Steps of one place follow each other without asking the operator.
    frames : int
    role : str
        ``"level"``, ``"stack"``, or ``"target"``.
    light : float or None
        Wanted level, of saturation; None where the exposure time is asked.
    interval_s : float or None
        Time from one kept frame to the next; None for every frame.
    facts : dict
        What the manifest says besides.
    asked : dict of str
        Facts that only the operator knows: name, and the placeholder of the list.
    """

    number: int
    set_up: str
    kind: str
    scene: str
    place: str
    frames: int
    role: str = "target"
    light: float | None = None
    interval_s: float | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    asked: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """How its files begin."""
        return f"{self.kind}_{self.number:02d}"

    @property
    def to_the_top(self) -> bool:
        """Whether its frames may be saturated."""
        return self.kind in TO_THE_TOP or (self.role == "level" and self.light == BRIGHTEST)

    def to_record(self) -> dict[str, Any]:
        """Plain record of the log."""
        return asdict(self)


def steps_of(kinds: Sequence[str], factor: float = 1.0) -> tuple[Step, ...]:
    """The steps of set-ups: dark frames before bright ones, because what is light is told from them.

    Parameters
    ----------
    kinds : sequence of str
        Of set-ups, in the order in which they are wanted; ``"flat"`` for dark and bright frames.
    factor : float
        Wanted u over the usual one.

    Returns
    -------
    tuple of Step

    Raises
    ------
    InputError
        If there is no set-up of a kind.

    Examples
    --------
    >>> steps = steps_of(["flat", "edge"])
    >>> len(steps), steps[0].kind, steps[-1].kind, steps[-1].frames
    (27, 'dark', 'edge', 4)
    """
    found: list[Step] = []
    for kind in kinds:
        set_up = scaled_set_up(set_up_of(kind), factor)
        if kind != FLAT and set_up.title == f"Frames of kind {kind}":
            raise InputError("no such set-up", value=kind, allowed="a kind of `pixmetry shoot-list`", remedy="see docs/capture.md")
        for step in _flat(set_up) if kind == FLAT else _others(set_up):
            found.append(Step(**{**vars(step), "number": len(found) + 1}))
    return tuple(found)


def _flat(set_up: SetUp) -> list[Step]:
    counts = [entry["frames"] for entry in set_up.entries if entry["kind"] == "bright"]
    shares = [DARKEST + (BRIGHTEST - DARKEST) * k / (FLAT_STEPS - 1) for k in range(FLAT_STEPS)] + [STACK]
    steps = []
    for kind, scene in (("dark", DARK_SCENE), ("bright", set_up.scene.partition(";")[0] + ".")):
        for k, (frames, share) in enumerate(zip(counts, shares, strict=True)):
            role = "level" if k < FLAT_STEPS else "stack"
            steps.append(Step(0, FLAT, kind, scene, f"{FLAT} {kind}", frames, role, share))
    return steps


def _others(set_up: SetUp) -> list[Step]:
    steps = []
    for k, entry in enumerate(set_up.entries):
        facts = {key: value for key, value in entry.items() if key not in ("kind", "frames", "exposure_s", "role", "interval_s")}
        asked = {key: found[1] for key, value in facts.items() if isinstance(value, str) and (found := ASKED.fullmatch(value))}
        light: float | None = LIGHT.get(set_up.kind, USUAL_LIGHT)
        if set_up.kind == "spots":
            light = SPOT_LIGHT[k]
        elif entry["kind"] == "dark":
            light, asked = None, {**asked, "exposure_s": ASKED.sub(r"\1", str(entry["exposure_s"]))}
        interval = entry.get("interval_s")
        own = {key: value for key, value in facts.items() if key not in asked}
        other = {"white": "A white sheet in place of the chart, in the same light.", "recorded": "The same scene from the recorder."}
        more = [text for key, text in other.items() if facts.get(key)]
        more += [f"{key}: {word}." for key, word in asked.items() if key != "exposure_s"]
        scene = " ".join([set_up.scene, *more]) if len(set_up.entries) > 1 else set_up.scene
        if set_up.kind == "motion":
            scene += f" Run {k + 1} of {len(set_up.entries)}."
        place = set_up.kind if set_up.kind == "spots" else f"{set_up.kind} {sorted(facts.items())} {k if set_up.kind == 'motion' else ''}"
        kind = "dark_temperature" if "temperature_c" in facts else entry["kind"]
        every = interval if isinstance(interval, float) else None
        steps.append(Step(0, set_up.kind, kind, scene, place, entry["frames"], "target", light, every, own, asked))
    return steps
