"""What a capture returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pixmetry.capture.plan import Step
from pixmetry.core.finding import Finding
from pixmetry.core.number import Number

CAPTURE_SCHEMA = "pixmetry/capture/1"


@dataclass(frozen=True)
class TakenStep:
    """One step: its good frames, the faults beside them, and what its levels say."""

    step: Step
    frames: int
    exposure_s: float
    faults: Mapping[str, int]
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class Reached:
    """The u of a value that the frames were to measure, against the wanted one; ``frames`` is how many told it."""

    number: Number
    wanted_rel: float
    frames: int

    @property
    def is_reached(self) -> bool:
        """Whether u is as small as wanted."""
        return self.number.u <= self.wanted_rel * abs(self.number.value)


@dataclass(frozen=True)
class Captured:
    """A shooting list taken with a camera.

    Parameters
    ----------
    manifest : Path
    steps : tuple of TakenStep
    reached : tuple of Reached
        Of the photon transfer, where it was taken.
    runs : int
        How often the capture was begun: more than once where it was killed or stopped.
    notes : tuple of str
    """

    manifest: Path
    steps: tuple[TakenStep, ...]
    reached: tuple[Reached, ...] = ()
    runs: int = 1
    notes: tuple[str, ...] = field(default=())

    @property
    def frames(self) -> int:
        """Good frames of all steps."""
        return sum(step.frames for step in self.steps)

    @property
    def faults(self) -> dict[str, int]:
        """Faults of all steps."""
        found: dict[str, int] = {}
        for step in self.steps:
            for kind, count in step.faults.items():
                found[kind] = found.get(kind, 0) + count
        return found

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        steps = [
            {
                "name": s.step.name,
                "kind": s.step.kind,
                "frames": s.frames,
                "exposure_s": s.exposure_s,
                "faults": dict(s.faults),
                "findings": [f.to_record() for f in s.findings],
            }
            for s in self.steps
        ]
        reached = [
            {"value": r.number.to_record(), "wanted_rel": r.wanted_rel, "reached": r.is_reached, "frames": r.frames} for r in self.reached
        ]
        head = {"schema": CAPTURE_SCHEMA, "manifest": str(self.manifest), "runs": self.runs, "frames": self.frames}
        return {**head, "faults": self.faults, "steps": steps, "reached": reached, "notes": list(self.notes)}
