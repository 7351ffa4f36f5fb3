"""The answer of a table of error sources: their sum, the interval that ignorance leaves, what to measure and to change next."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.budget.calibration_noise import CALIBRATION
from pixmetry.budget.set_ups import FLAT, kind_of
from pixmetry.budget.table import AT_BOUND, COUNTED, TYPICAL, Pair, Parts, SourceRow
from pixmetry.camera.catalogue import sources

WORTH = 0.01  # gain over what is now, from which on something is worth doing
SIGNED = ("measured", "from the sheet", "described")  # their signs are this camera's; those of typical values are not known


@dataclass(frozen=True)
class Answer:
    """Standard uncertainty of a position in px, in x and y, for means over so many frames and targets.

    Parameters
    ----------
    before_px, after_px : (float, float)
        Without a calibration, and with that of the scenario.
    least_px, most_px : (float, float)
        After the calibration: with nothing but what is known of this camera, and with everything that is not measured at its bound.
    frames, targets : int
    """

    before_px: Pair
    after_px: Pair
    least_px: Pair
    most_px: Pair
    frames: int = 1
    targets: int = 1

    @property
    def after_rms_px(self) -> float:
        """Root mean square over x and y."""
        return rms(self.after_px)

    @property
    def most_rms_px(self) -> float:
        """Root mean square over x and y."""
        return rms(self.most_px)


@dataclass(frozen=True)
class Next:
    """One thing to do next: measure a source, or change something about it.

    ``now_px`` is the upper end of the interval (to measure) or the total (to change), ``then_px`` what it would be; rms over x and y.
    """

    name: str
    source_id: str
    title: str
    text: str
    now_px: float
    then_px: float

    @property
    def gain_px(self) -> float:
        """By how much it falls."""
        return self.now_px - self.then_px

    @property
    def is_worth_it(self) -> bool:
        """Whether it makes a difference of 1 % or more."""
        return self.gain_px >= WORTH * self.now_px


@dataclass(frozen=True)
class Goal:
    """What is wanted beside what is reached: standard uncertainties (k = 1), the larger of x and y.

    Parameters
    ----------
    wanted, reached, least, most : float
        In ``unit``: after the calibration, with nothing but what is known of this camera, and with everything else at its bound.
    unit : {"px", "mm"}
    next_title : str
        The source whose measurement lowers ``most`` most; empty where there is none.
    """

    wanted: float
    reached: float
    least: float
    most: float
    unit: str
    next_title: str = ""

    @property
    def verdict(self) -> str:
        """``met`` whatever is not measured; ``met as far as known``; ``not met as far as known``; ``not met``."""
        if self.reached <= self.wanted:
            return "met" if self.most <= self.wanted else "met as far as known"
        return "not met" if self.least > self.wanted else "not met as far as known"

    @property
    def text(self) -> str:
        """The same in a sentence or two."""
        wanted, reached, least, most = (f"{v:.2g} {self.unit}" for v in (self.wanted, self.reached, self.least, self.most))
        first = f" Measure first: {self.next_title}." if self.next_title else ""
        aim = f"{wanted} in x and y"
        return {
            "met": f"{aim} is met: {reached}, and no more than {most} whatever is not measured.",
            "met as far as known": f"{aim} is met as far as one knows: {reached}. What is not measured can raise it to {most}.{first}",
            "not met as far as known": f"{aim} is not met as far as one knows: {reached}. What is known alone leaves {least}.{first}",
            "not met": f"{aim} is not met: {reached}, and no less than {least} however good the rest is.",
        }[self.verdict]


def rms(pair: Pair) -> float:
    """Root mean square of two values."""
    return float(np.sqrt(0.5 * (pair[0] ** 2 + pair[1] ** 2)))


def sum_of(parts: Iterable[tuple[Parts, bool]], frames: int = 1, targets: int = 1) -> Pair:
    """Parts of several sources together, in x and y; what is constant adds with its sign where that is known, all else as squares.

    Notes
    -----
    u² = Σ place²/targets + Σ time²/(frames targets) + Σ smooth² + (Σ constant)², JCGM 100:2008, 5.1.2.
    """
    squares, constant = np.zeros(2), np.zeros(2)
    for part, sign_known in parts:
        fixed = np.array(part.constant_px)
        rest = np.square(replace(part, constant_px=(0.0, 0.0)).axes_px(frames, targets))
        squares += rest if sign_known else rest + fixed**2
        constant += fixed if sign_known else 0.0
    x, y = (float(v) for v in np.sqrt(squares + constant**2))
    return x, y


def together_of(constants: Iterable[tuple[Pair, bool]]) -> Pair:
    """Constants together: those whose signs are known with these, the others as squares."""
    return sum_of((Parts(constant_px=c), known) for c, known in constants)


def answer_of(rows: Sequence[SourceRow], frames: int = 1, targets: int = 1) -> Answer:
    """Put the rows together for means over so many frames and targets."""
    counted = [r for r in rows if r.status in COUNTED]
    known = [r for r in counted if r.status != TYPICAL]

    def together(of: Iterable[tuple[Parts | None, bool]]) -> Pair:
        return sum_of(((p, s) for p, s in of if p is not None), frames, targets)

    return Answer(
        before_px=together((r.before, r.status in SIGNED) for r in counted),
        after_px=together((r.after, r.status in SIGNED) for r in counted),
        least_px=together((r.after, True) for r in known),
        most_px=together((r.largest if r.largest is not None else r.after, r.status in SIGNED) for r in rows if _may_count(r)),
        frames=frames,
        targets=targets,
    )


def _may_count(row: SourceRow) -> bool:
    return row.status in (*COUNTED, AT_BOUND)


def with_shares(rows: Sequence[SourceRow]) -> list[SourceRow]:
    """The rows in the order in which they matter after the calibration, each with its share of the square of the whole."""
    whole = sum(r.after_px**2 for r in rows if r.counts)
    shared = [replace(r, share=r.after_px**2 / whole if whole and r.counts else 0.0) for r in rows]
    return sorted(shared, key=lambda r: (not r.counts, r.status not in COUNTED, -r.after_px, -r.largest_px, -r.before_px))


def to_measure(rows: Sequence[SourceRow], frames: int = 1, targets: int = 1) -> list[Next]:
    """What to measure next: by how much the upper end of the interval falls if a source is found to be as usual (or not there)."""
    now = answer_of(rows, frames, targets).most_rms_px
    found = []
    for row in rows:
        if row.largest is None or row.status not in (TYPICAL, AT_BOUND):
            continue
        then = answer_of([replace(r, largest=None) if r is row else r for r in rows], frames, targets).most_rms_px
        found.append(Next(row.name, row.source_id, row.title, how_to_measure(row.source_id), now, then))
    return sorted((n for n in found if n.gain_px > 0), key=lambda n: n.then_px)


def how_to_measure(source_id: str) -> str:
    """A sentence on how a source, or the calibration's noise, is measured; empty for what is neither."""
    if source_id == CALIBRATION:
        return "Give its calibration.json, or say how many images and targets it was made of."
    source = sources().get(source_id)
    if source is None:
        return ""
    if source.measure is not None:
        kind = kind_of(source_id)
        frames = {"": "", FLAT: "From dark and bright frames. "}.get(kind, f"From frames of kind {kind}. ")
        return f"{frames}`pixmetry assess` measures it."
    reason = source.reasons["measure"].removeprefix("not measured: ")
    return f"{reason[0].upper()}{reason[1:].rstrip('.')}."


def to_change(rows: Sequence[SourceRow], frames: int = 1, targets: int = 1) -> list[Next]:
    """What to change next: by how much the total falls without a source."""
    now = answer_of(rows, frames, targets).after_rms_px
    found = []
    for row in rows:
        if row.counts:
            then = answer_of([r for r in rows if r is not row], frames, targets).after_rms_px
            found.append(Next(row.name, row.source_id, row.title, row.advice, now, then))
    return sorted((n for n in found if n.gain_px > 0), key=lambda n: n.then_px)
