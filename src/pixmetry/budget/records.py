"""Records of a budget: rows, totals, the answer with its interval, advice; and the plain record for JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pixmetry.budget.combine import Combined, combine
from pixmetry.budget.monte_carlo import MonteCarlo
from pixmetry.budget.probe import Facts, Target
from pixmetry.camera.catalogue import STAGES, get_source
from pixmetry.camera.contribution import Contribution
from pixmetry.core.finding import Finding
from pixmetry.locate.estimator import Estimator
from pixmetry.report.numbers import NONE, length_px, percent

SCHEMA = "pixmetry/budget/1"
DECIDED = ("measured", "modelled", "calibrated")
SUM, MONTE_CARLO = "sum", "Monte Carlo"
LEVEL = 0.95  # coverage of the interval that is the answer


@dataclass(frozen=True)
class BudgetRow:
    """One source in the budget.

    Parameters
    ----------
    name, source_id, title : str
        Name in the camera's chain (or the source's id), and the source.
    status : {"measured", "modelled", "calibrated", "accepted", "not applicable", "left to calibration"}
        Its parameters were estimated in this campaign; it is known without (from the camera's description, or it has no parameters);
        positions are corrected for it by a calibration, and what that leaves counts; the campaign could not tell, and it is taken at the
        largest to expect of a sound camera; such a camera cannot have it, or it acts on moving targets only; only a calibration with
        targets can tell.
    contribution : Contribution, optional
    u_of_total_px : float
        Uncertainty of the contribution's total that comes of its parameters' uncertainty.
    monte_carlo : MonteCarlo, optional
        The same by simulation.
    share : float
        Part of the square of the combined total that it belongs to (with everything accepted, for what is accepted).
    without_px : float
        Combined total if it were gone.
    reason : str
        Why there is no contribution, or how its status came about.
    in_camera : bool
        Whether it stands in the camera's chain, switched on.
    """

    name: str
    source_id: str
    title: str
    status: str
    contribution: Contribution | None = None
    u_of_total_px: float = 0.0
    monte_carlo: MonteCarlo | None = None
    share: float = 0.0
    without_px: float = 0.0
    reason: str = ""
    in_camera: bool = False

    @property
    def part(self) -> Contribution:
        """The contribution of a row that is known to have one."""
        assert self.contribution is not None, self.name
        return self.contribution

    @property
    def counts(self) -> bool:
        """Whether it is part of the verdict, or of that with everything accepted; the rows that do not count come last."""
        return self.status in (*DECIDED, "accepted") and self.total_px > 0

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of random part and bias."""
        return 0.0 if self.contribution is None else self.contribution.total_px

    @property
    def calibrated_px(self) -> float:
        """Remaining error after a calibration, without the constant and the smooth part."""
        return 0.0 if self.contribution is None else self.contribution.calibrated_px


@dataclass(frozen=True)
class StageSum:
    """What the sources of one link of the chain come to together: those of the verdict, and what was accepted beside them.

    ``share`` is the stage's part of the square of the verdict's sum; those of all stages add up to 1.
    """

    stage: str
    total_px: float
    calibrated_px: float
    share: float
    accepted_px: float


@dataclass(frozen=True)
class Interaction:
    """Everything at once against the sum of everything alone (u as squares, biases as they are), both by Monte Carlo, in px.

    ``unsteady_px`` is, in x and y, the part of the sources that drift or belong to the object: the frames of a Monte Carlo hold it still.
    """

    together: MonteCarlo
    sum_px: float
    se_sum_px: float
    unsteady_px: tuple[float, float] = (0.0, 0.0)

    @property
    def calibrated_px(self) -> float:
        """What a calibration leaves of everything at once: all of what is unsteady, and of the rest what is neither constant nor smooth."""
        return float(np.sqrt(self.together.calibrated_px**2 + 0.5 * sum(v**2 for v in self.unsteady_px)))

    @property
    def difference_px(self) -> float:
        """Effect of all sources together minus the sum of each source alone."""
        return self.together.total_px - self.sum_px

    @property
    def se_px(self) -> float:
        """Standard error of the difference; the two are taken as independent."""
        return float(np.hypot(self.together.se_total_px, self.se_sum_px))


@dataclass(frozen=True)
class Headline:
    """Where the verdict is from.

    Parameters
    ----------
    by : {"sum", "Monte Carlo"}
    sum_px : float
        Total of the contributions that the simulated camera holds, by their formulas, for one target in one frame.
    simulated_px, se_simulated_px : float
        The same by one Monte Carlo with all of them on, and its standard error; NaN without one.
    u_sum_px : float
        What the formulas leave open: the model errors that the contributions declare.
    why : str
        A sentence for the reader.
    """

    by: str
    sum_px: float
    simulated_px: float
    se_simulated_px: float
    u_sum_px: float
    why: str


@dataclass(frozen=True)
class Interval:
    """The answer in two numbers: within ± ``half_px`` (x and y) of its true place a position lies, with this coverage.

    ``k`` is the coverage factor that the effective degrees of freedom ``dof`` ask for, in x and y.
    """

    half_px: tuple[float, float]
    k: tuple[float, float]
    dof: tuple[float, float]
    coverage: float = LEVEL


@dataclass(frozen=True)
class Advice:
    """What one source is worth: to be measured if it was only accepted, else to be lowered.

    ``combined_px`` is the combined total now, ``removed_px`` and ``halved_px`` what it would be without this contribution and with half
    of it; for an accepted source all three are totals with everything accepted.
    """

    name: str
    source_id: str
    title: str
    status: str
    total_px: float
    combined_px: float
    removed_px: float
    halved_px: float

    @property
    def finding(self) -> Finding:
        """The same in words; its kind is ``to_measure`` or ``to_lower``."""
        accepted = self.status == "accepted"
        whole = "the total with all accepted sources" if accepted else "the total"
        now, gone, half = (length_px(v, 3) for v in (self.combined_px, self.removed_px, self.halved_px))
        less = percent(1 - self.removed_px / self.combined_px) if self.combined_px else NONE
        size = length_px(self.total_px)
        made = f"contributes {size} px"
        if accepted:
            made = f"is not measured: taken at the largest value to be expected of a sound camera, it contributes {size} px"
        return Finding(
            "to_measure" if accepted else "to_lower",
            f"{self.title} {made}. Without this source {whole} would fall from {now} to {gone} px ({less} % less); with half of it, to "
            f"{half} px (rms of x and y).",
            get_source(self.source_id).advice,
            numbers={name: getattr(self, name) for name in ("total_px", "combined_px", "removed_px", "halved_px")},
        )

    def to_record(self) -> dict[str, Any]:
        """Return a plain record for JSON: the source, its numbers, and the finding's words."""
        words = self.finding.to_record()
        return asdict(self) | {name: words[name] for name in ("kind", "text", "advice", "level")}


@dataclass(frozen=True)
class Budget:
    """All rows and what they come to.

    The rows come in one order for all who show them: what is measured, modelled or calibrated, largest first; then what was accepted,
    largest bound first; then what does not count (`BudgetRow.counts`). ``verdicts`` are for what is measured and modelled, for one frame
    and for means over several, by the sum of the contributions or by Monte Carlo as ``headline`` says; ``with_accepted`` adds everything
    that was accepted, at its bound. ``sums`` are always the analytic ones. ``interval`` is the verdict for one frame in the form of an
    answer, a coverage interval; ``stages`` says which links of the chain it is from, in the order of the light. Totals are k = 1, as the
    camera is and (``calibrated_px``) as a calibration leaves it.
    """

    camera: str
    target: Target
    estimator: Estimator
    facts: Facts
    pitch_um: tuple[float, float] | None
    rows: tuple[BudgetRow, ...]
    verdicts: tuple[Combined, ...]
    with_accepted: tuple[Combined, ...]
    advice: tuple[Advice, ...]
    interaction: Interaction | None = None
    headline: Headline | None = None
    sums: tuple[Combined, ...] = ()
    interval: Interval | None = None

    @property
    def stages(self) -> tuple[StageSum, ...]:
        """Sums over each link of the chain that has a row that counts, in the order of the light."""
        found = []
        for stage in STAGES:
            rows = [r for r in self.rows if r.counts and r.source_id.split(".")[0] == stage]
            known, accepted = ([r for r in rows if (r.status == "accepted") == bound] for bound in (False, True))
            whole = combine([r.part for r in known], signed=True)
            at_bound = combine([r.part for r in accepted]).total_px
            if rows:
                found.append(StageSum(stage, whole.total_px, whole.calibrated_px, sum(r.share for r in known), at_bound))
        return tuple(found)

    @property
    def verdict(self) -> Combined:
        """One target in one frame, with the measured and modelled sources."""
        return self.verdicts[0]

    def of_status(self, *status: str) -> tuple[BudgetRow, ...]:
        """The rows of a status, largest first."""
        return tuple(r for r in self.rows if r.status in status)

    @property
    def largest(self) -> tuple[BudgetRow, ...]:
        """The contributions of the verdict, largest first."""
        return tuple(r for r in self.of_status(*DECIDED) if r.total_px > 0)

    @property
    def accepted(self) -> tuple[BudgetRow, ...]:
        """What was accepted and counts, largest bound first."""
        return tuple(r for r in self.of_status("accepted") if r.total_px > 0)

    def um(self, combined: Combined) -> tuple[float, float] | None:
        """Totals in x and y in µm on the sensor, if the pitch is known."""
        if self.pitch_um is None:
            return None
        return combined.total_x_px * self.pitch_um[0], combined.total_y_px * self.pitch_um[1]

    def to_record(self) -> dict[str, Any]:
        """Return a plain record for JSON; numbers that do not exist are None."""
        return {
            "schema": SCHEMA,
            "camera": self.camera,
            "target": asdict(self.target),
            "estimator": {"name": self.estimator.name} | asdict(self.estimator),
            "facts": asdict(self.facts),
            "pitch_um": None if self.pitch_um is None else list(self.pitch_um),
            "rows": [_row_record(r) for r in self.rows],
            "verdicts": [_combined_record(self, c) for c in self.verdicts],
            "with_accepted": [_combined_record(self, c) for c in self.with_accepted],
            "sums": [_combined_record(self, c) for c in self.sums],
            "headline": None if self.headline is None else _finite(asdict(self.headline)),
            "interval": None if self.interval is None else asdict(self.interval) | {"dof": [_or_none(v) for v in self.interval.dof]},
            "stages": [asdict(s) for s in self.stages],
            "advice": [a.to_record() for a in self.advice],
            "interaction": None
            if self.interaction is None
            else {
                "together": _monte_carlo_record(self.interaction.together),
                "sum_px": self.interaction.sum_px,
                "se_sum_px": self.interaction.se_sum_px,
                "difference_px": self.interaction.difference_px,
                "se_px": self.interaction.se_px,
                "calibrated_px": self.interaction.calibrated_px,
            },
        }


def _row_record(row: BudgetRow) -> dict[str, Any]:
    names: tuple[str, ...] = ("name", "source_id", "title", "status", "u_of_total_px", "share", "without_px", "reason")
    names += ("in_camera", "counts", "total_px", "calibrated_px")
    record = {k: getattr(row, k) for k in names}
    c = row.contribution
    parts = {} if c is None else {k: list(getattr(c, k)) for k in ("time_px", "smooth_px", "place_px")}
    record["contribution"] = None if c is None else asdict(c) | parts
    record["monte_carlo"] = None if row.monte_carlo is None else _monte_carlo_record(row.monte_carlo)
    return record


def _monte_carlo_record(result: MonteCarlo) -> dict[str, Any]:
    totals = {k: getattr(result, k) for k in ("total_px", "se_total_px", "calibrated_px", "se_calibrated_px")}
    record = asdict(result) | totals | {"names": list(result.names)}
    for axis in ("x", "y"):
        record[axis] = {k: (v if np.isfinite(v) else None) for k, v in record[axis].items()}
    return _finite(record)


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    return {k: (None if isinstance(v, float) and not np.isfinite(v) else v) for k, v in record.items()}


def _combined_record(budget: Budget, combined: Combined) -> dict[str, Any]:
    um = budget.um(combined)
    totals = {"total_px": combined.total_px, "calibrated_px": combined.calibrated_px}
    return asdict(combined) | totals | {"total_um": None if um is None else list(um)}
