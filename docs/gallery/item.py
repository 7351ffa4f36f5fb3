"""A statement of the chapter beside what is found here: one line of ``gallery.json`` and of the pages' tables."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gallery.page import table
from pixmetry.core.errors import InputError
from pixmetry.report.numbers import MINUS

KINDS = {"E": "arithmetic", "S": "simulation", "V": "simulated camera, measured blind", "D": "drawing"}
AGREE = "agree"
REASONS = ("chapter inconsistent:", "differs because")


@dataclass(frozen=True)
class Item:
    """A figure's value, an entry of a table, or a number in the chapter's text.

    Parameters
    ----------
    id : str
        Where it stands: a figure, a table, or a note with a letter.
    what : str
        The quantity, with its unit.
    kind : str
        One of `KINDS`.
    expected : float
        As the chapter prints it, or as it follows from what it prints.
    ours, u : float
        Found here, with its standard uncertainty (0: no random part).
    tolerance : float
        Largest difference at which both agree.
    verdict : str
        "agree", "chapter inconsistent" or "differs because …".
    why : str
        The reason, with its computation; may be empty where both agree.
    """

    id: str
    what: str
    kind: str
    expected: float
    ours: float
    u: float
    tolerance: float
    verdict: str
    why: str

    @classmethod
    def judged(
        cls, id: str, what: str, kind: str, expected: float, ours: float, tolerance: float, u: float = 0.0, why: str = "",
        otherwise: str = "",
    ) -> Item:  # fmt: skip
        """Compare, and hold the numbers against the reason.

        Parameters
        ----------
        otherwise : str
            Why both should differ: one of `REASONS`, and the sentence; empty if they should agree.

        Raises
        ------
        InputError
            If they differ and no reason is given, or agree although one is given.
        """
        agrees = abs(ours - expected) <= tolerance
        head = next((h for h in REASONS if otherwise.startswith(h)), "")
        reason = otherwise[len(head) :].strip()
        if kind not in KINDS or bool(otherwise) != bool(head and reason):
            allowed = f"{', '.join(KINDS)}; {' …, '.join(REASONS)} …"
            raise InputError("no such kind or reason", where=f"item {id}", value=f"{kind}; {otherwise}", allowed=allowed)
        if agrees == bool(otherwise):
            raise InputError(
                "the verdict does not follow from the numbers", where=f"item {id}", value=ours,
                allowed=f"{'beyond' if otherwise else 'within'} {expected:g} ± {tolerance:g}",
            )  # fmt: skip
        verdict = AGREE if agrees else head.rstrip(":") if head == REASONS[0] else f"{head} {reason}"
        return cls(id, what, kind, float(expected), float(f"{ours:.6g}"), float(f"{u:.3g}"), float(tolerance), verdict, reason or why)

    @property
    def verdict_head(self) -> str:
        """One of "agree", "chapter inconsistent" and "differs"."""
        return self.verdict.split(" because")[0]

    @property
    def numbers(self) -> tuple[str, str, str]:
        """Expected, ours and u, for a table."""
        return number(self.expected), number(self.ours), number(self.u, 2) if self.u else ""


def comparison(items: Iterable[Item]) -> str:
    """The table of a page, chapter against ours, and below it the reasons."""
    items = list(items)
    rows = [[i.id, i.what, *i.numbers, number(i.tolerance), i.verdict_head] for i in items]
    head = ["item", "quantity", "expected", "ours", "u", "tolerance", "verdict"]
    lines = table(head, rows, 2).split("\n")
    lines[1] = "| --- | --- | ---: | ---: | ---: | ---: | --- |"
    reasons = [f"- {i.id}{'' if i.verdict == AGREE else f', {i.verdict_head}'}: {i.why}." for i in items if i.why]
    return "\n".join([*lines, *(["What is expected, and why they differ:", "", *reasons, ""] if reasons else [])])


def number(value: float, digits: int = 6) -> str:
    """So many digits at most, without an exponent and without zeros at the end."""
    plain = np.format_float_positional(float(f"{value:.{digits}g}"), trim="-")
    return plain.replace("-", MINUS)
