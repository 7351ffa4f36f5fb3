"""The budget of a camera in a scenario: every error source before and after calibration, the answer, and what to do next."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from html import escape
from typing import Any

import numpy as np

from pixmetry.budget.answer import Answer, Goal, Next, answer_of, rms, to_change, to_measure
from pixmetry.budget.cameras import Disagreement
from pixmetry.budget.monte_carlo import MonteCarlo
from pixmetry.budget.object_space import SpacePoint, point_of
from pixmetry.budget.scenario import Scenario
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import COUNTED, SourceRow
from pixmetry.core.data_frame import data_frame
from pixmetry.locate.estimator import Estimator

SCHEMA = "pixmetry/camera_budget/1"
SHOWN = 12  # rows in a notebook


@dataclass(frozen=True, eq=False)
class CameraBudget:
    """Every error source of a camera in a scenario, and what they come to.

    Parameters
    ----------
    setting : Setting
        Camera and scenario.
    estimator : Estimator
        As it was resolved for this target.
    rows : tuple of SourceRow
        What counts first, largest after the calibration first.
    disagreements : tuple of Disagreement
        Where several descriptions of the camera were given: every parameter that two of them know.
    together : MonteCarlo, optional
        All sources of the camera's chain at once, with the target at rest.
    """

    setting: Setting
    estimator: Estimator
    rows: tuple[SourceRow, ...]
    disagreements: tuple[Disagreement, ...] = ()
    together: MonteCarlo | None = None

    @property
    def camera(self) -> str:
        """Its name."""
        return self.setting.described.name

    @property
    def scenario(self) -> Scenario:
        """What is measured and how."""
        return self.setting.scenario

    @cached_property
    def one(self) -> Answer:
        """One target in one frame."""
        return answer_of(self.rows)

    @cached_property
    def answer(self) -> Answer:
        """The mean over the frames and targets of the scenario."""
        return answer_of(self.rows, self.scenario.count.frames, self.scenario.count.targets)

    @property
    def left_out(self) -> tuple[SourceRow, ...]:
        """Sources of this camera that could not be computed: the answer lacks them."""
        return tuple(r for r in self.rows if r.status in COUNTED and r.after is None)

    @cached_property
    def goal(self) -> Goal | None:
        """What the scenario wants beside what is reached; None where it wants nothing."""
        wanted, a = self.scenario.goal, self.answer
        pairs = (a.after_px, a.least_px, a.most_px)
        if wanted.u_px is not None:
            unit, aim, (reached, least, most) = "px", wanted.u_px, (max(p) for p in pairs)
        elif wanted.u_mm is not None:
            unit, aim, (reached, least, most) = "mm", wanted.u_mm, (max(self.mm(p) or p) for p in pairs)
        else:
            return None
        return Goal(aim, reached, least, most, unit, self.to_measure[0].title if self.to_measure else "")

    @cached_property
    def to_measure(self) -> tuple[Next, ...]:
        """What to measure next, by how much it narrows the interval of the mean over the scenario's frames and targets."""
        return tuple(to_measure(self.rows, self.scenario.count.frames, self.scenario.count.targets))

    @cached_property
    def to_change(self) -> tuple[Next, ...]:
        """What to change next, by how much it lowers the total of that mean."""
        return tuple(to_change(self.rows, self.scenario.count.frames, self.scenario.count.targets))

    def um(self, pair_px: tuple[float, float]) -> tuple[float, float] | None:
        """A pair of lengths in µm on the sensor; None where the pitch is not known."""
        pitch = self.setting.described.pitch_um
        return None if pitch is None else (pair_px[0] * pitch[0], pair_px[1] * pitch[1])

    def mm(self, pair_px: tuple[float, float]) -> tuple[float, float] | None:
        """A pair of lengths in mm on the object, across the line of sight; None where the scale is not known."""
        scale, pitch = self.setting.px_per_mm, self.setting.described.pitch_um
        if scale is None:
            return None
        return pair_px[0] / scale, pair_px[1] / scale * (pitch[1] / pitch[0] if pitch else 1.0)

    @cached_property
    def point(self) -> SpacePoint | None:
        """Points in space by the scenario's rays, means over its frames and targets; None where the scale is not known, or of one ray."""
        return point_of(self.rows, self.setting, self.scenario.count.frames, self.scenario.count.targets)

    def __repr__(self) -> str:
        one = self.one
        return (
            f"CameraBudget({self.camera!r}: {rms(one.before_px):.2g} px before, {rms(one.after_px):.2g} px after calibration "
            f"[{rms(one.least_px):.2g} to {rms(one.most_px):.2g}], {sum(r.counts for r in self.rows)} of {len(self.rows)} sources count)"
        )

    def _repr_html_(self) -> str:
        rows = [r for r in self.rows if r.counts][:SHOWN]
        cells = ((escape(r.title), r.status, *(f"{1e3 * v:.2g}" for v in (r.before_px, r.after_px, r.largest_px))) for r in rows)
        body = "".join(f"<tr>{''.join(f'<td>{c}</td>' for c in row)}</tr>" for row in cells)
        head = "".join(f"<th>{h}</th>" for h in ("source", "known", "before / mpx", "after / mpx", "at most / mpx"))
        return f"<p>{escape(repr(self))}</p><table><tr>{head}</tr>{body}</table>"

    def to_dataframe(self) -> Any:
        """Return the rows as a ``pandas.DataFrame``: totals in px, one target in one frame.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        names = [
            "name",
            "number",
            "stars",
            "own_stars",
            "title",
            "status",
            "gum_class",
            "before_px",
            "after_px",
            "largest_px",
            "share",
            "how",
        ]
        return data_frame({n: [getattr(r, n) for r in self.rows] for n in names})

    def to_record(self) -> dict[str, Any]:
        """Return the plain record for JSON."""
        return {
            "schema": SCHEMA,
            "camera": self.camera,
            "scenario": {name: {"value": value, "given": given} for name, (value, given) in self.scenario.told.items()},
            "target": asdict(self.setting.target),
            "estimator": {"name": self.estimator.name} | asdict(self.estimator),
            "frame_shape": self.setting.described.frame_shape,
            "pitch_um": self.setting.described.pitch_um,
            "exposure_s": self.setting.described.exposure_s,
            "px_per_mm": self.setting.px_per_mm,
            "lens": self.setting.lens,
            "one_target_one_frame": self._answer_record(self.one),
            "answer": self._answer_record(self.answer),
            "point": None if self.point is None else {n: v.tolist() for n, v in vars(self.point).items()},
            "left_out": [r.name for r in self.left_out],
            "together": None if self.together is None else _together_record(self.together),
            "rows": [_row_record(r) for r in self.rows],
            "goal": None if self.goal is None else asdict(self.goal) | {"verdict": self.goal.verdict},
            "to_measure": [asdict(n) for n in self.to_measure],
            "to_change": [asdict(n) for n in self.to_change],
            "descriptions": [asdict(d) | {"agree": d.agree} for d in self.disagreements],
        }

    def _answer_record(self, answer: Answer) -> dict[str, Any]:
        record = asdict(answer)
        for name in ("before", "after", "least", "most"):
            pair = record[f"{name}_px"]
            record[f"{name}_um"], record[f"{name}_mm"] = self.um(pair), self.mm(pair)
        return record


def _together_record(found: MonteCarlo) -> dict[str, Any]:
    names = ("total_px", "se_total_px", "calibrated_px", "se_calibrated_px", "trials", "lost")
    values = {n: getattr(found, n) for n in names}
    return {n: v if np.isfinite(v) else None for n, v in values.items()}


def _row_record(row: SourceRow) -> dict[str, Any]:
    values = {n: v for n, v in asdict(replace(row, fields_px=None)).items() if n != "fields_px"}
    return values | {n: getattr(row, n) for n in ("before_px", "after_px", "largest_px", "own_stars", "counts", "taken_up")}
