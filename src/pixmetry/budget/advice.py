"""Which contributions to lower and which to measure first, and what that would bring; `Advice.finding` says it in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pixmetry.budget.combine import Combined
from pixmetry.budget.records import Advice, BudgetRow

MOST = 5
MOST_ACCEPTED = 3


def advise(
    rows: Sequence[BudgetRow], verdict: Combined, everything: Combined, most: int = MOST, most_accepted: int = MOST_ACCEPTED
) -> tuple[Advice, ...]:
    """Advice for the largest rows of the verdict; after them, for the largest accepted sources.

    The gain is told within the total that the row belongs to: for an accepted source, the one with everything accepted at its bound.
    """
    there = sorted((r for r in rows if r.contribution is not None and r.total_px > 0), key=lambda r: -r.total_px)
    known = [r for r in there if r.status != "accepted"][:most]
    accepted = [r for r in there if r.status == "accepted"][:most_accepted]
    return (*(_advice(r, verdict.total_px) for r in known), *(_advice(r, everything.total_px) for r in accepted))


def _advice(row: BudgetRow, combined_px: float) -> Advice:
    removed = row.without_px
    halved = float(np.sqrt(removed**2 + 0.25 * (combined_px**2 - removed**2)))
    return Advice(row.name, row.source_id, row.title, row.status, row.total_px, combined_px, removed, halved)
