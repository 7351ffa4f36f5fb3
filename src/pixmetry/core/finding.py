"""What was found and what to do about it: one record for the findings of every job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pixmetry.core.number import Number

NOTE, WARNING, ERROR = LEVELS = ("note", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """One sentence on what was found and one on what to do.

    Parameters
    ----------
    kind : str
        A short name, such as ``"flatness"``, ``"gross_error"``, ``"x_scale_drift"``, ``"correlation"``.
    text, advice : str
    level : {"note", "warning", "error"}
        Whether it is there to be known, may spoil the result, or does spoil it.
    numbers : mapping
        What it rests on, by name: numbers with their uncertainties, plain ones, and words such as the name of a parameter.

    Examples
    --------
    >>> from pixmetry.core.finding import Finding
    >>> Finding("few_levels", "12 bright levels; 50 are asked for.", "Take more levels.", "warning", {"levels": 12}).to_record()["numbers"]
    {'levels': 12}
    """

    kind: str
    text: str
    advice: str = ""
    level: str = NOTE
    numbers: Mapping[str, Number | float | str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise ValueError(f"level of a finding: {self.level!r}, not one of {', '.join(LEVELS)}")

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON; without ``numbers`` where there are none."""
        record: dict[str, Any] = {"kind": self.kind, "text": self.text, "advice": self.advice, "level": self.level}
        if self.numbers:
            record["numbers"] = {name: v.to_record() if isinstance(v, Number) else v for name, v in self.numbers.items()}
        return record

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Finding:
        """The finding of its record; ``KeyError``, ``TypeError`` or ``ValueError`` where the record is none."""
        numbers = {name: Number.from_record(v) if isinstance(v, Mapping) else v for name, v in record.get("numbers", {}).items()}
        return cls(record["kind"], record["text"], record["advice"], record["level"], numbers)


def sentence(text: str) -> str:
    """A text with a capital at its beginning, unless that is a symbol or a name, and a full stop at its end.

    Examples
    --------
    >>> sentence("the light drifts")
    'The light drifts.'
    """
    if not text:
        return ""
    first = text[0] if text[1:2] == " " or text.split()[0].endswith(":") else text[0].upper()
    return f"{first}{text[1:].rstrip('.')}."


def finding_lines(finding: Finding) -> list[str]:
    """A finding for a terminal: what was found, and below it what to do.

    Examples
    --------
    >>> finding_lines(Finding("drift", "the light drifts", "Let the lamp warm up.", "warning"))
    ['Warning: The light drifts.', '  To do: Let the lamp warm up.']
    """
    lines = [f"{finding.level.capitalize()}: {sentence(finding.text)}"]
    return [*lines, f"  To do: {sentence(finding.advice)}"] if finding.advice else lines
