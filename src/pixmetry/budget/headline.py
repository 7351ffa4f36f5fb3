"""The total: the sum of the contributions, or one Monte Carlo with all sources, and the reason for the choice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pixmetry.budget.combine import Combined, combine
from pixmetry.budget.monte_carlo import Axis, MonteCarlo
from pixmetry.budget.probe import ESTIMATOR_ITSELF
from pixmetry.budget.records import LEVEL, MONTE_CARLO, SUM, BudgetRow, Headline, Interval
from pixmetry.camera.contribution import UNSTEADY

COVERAGE = 2.0  # standard errors beyond which sum and Monte Carlo differ
LOST = 0.01  # share of windows without a target above which a Monte Carlo does not speak for all targets
ASKED = 3  # sources that are tried in the whole chain to find out which one makes the difference
MAIN_PART = 0.5  # of the difference of the squares: what one source must make of it to be named


def interval_of(total_px: tuple[float, float], dof: tuple[float, float], coverage: float = LEVEL) -> Interval:
    """Coverage interval of totals in x and y, by the quantile of Student's t (JCGM 100:2008, G.3.2).

    Examples
    --------
    >>> found = interval_of((0.01, 0.02), (9.0, float("inf")))
    >>> [round(k, 3) for k in found.k], [round(half, 4) for half in found.half_px]
    ([2.262, 1.96], [0.0226, 0.0392])
    """
    from scipy.special import ndtri, stdtrit

    k = tuple(float(stdtrit(n, (1 + coverage) / 2) if np.isfinite(n) else ndtri((1 + coverage) / 2)) for n in dof)
    return Interval((k[0] * total_px[0], k[1] * total_px[1]), (k[0], k[1]), dof, coverage)


def dof_of(rows: Sequence[BudgetRow], verdict: Combined, found: Headline) -> tuple[float, float]:
    """Effective degrees of freedom of a verdict in x and y.

    Notes
    -----
    Welch and Satterthwaite: ν = t⁴/Σ(tᵢ⁴/νᵢ), where a contribution tᵢ that is uncertain by Δᵢ has νᵢ = ½(tᵢ/Δᵢ)² (JCGM 100:2008, G.4.1 and
    G.4.2). Δᵢ holds what its parameters leave open, and half of the error that its formula declares. Of a Monte Carlo, Δ is its standard
    error.
    """
    if found.by == MONTE_CARLO:
        error = found.se_simulated_px / found.simulated_px if found.simulated_px else 0.0
        return (0.5 / error**2,) * 2 if error else (float("inf"),) * 2
    loose = np.zeros(2)
    for row in rows:
        c = row.part
        if c.total_px > 0:
            error_rel = float(np.hypot(row.u_of_total_px, 0.5 * max(c.model_error * c.total_px, c.floor_px))) / c.total_px
            loose += 2 * (np.square(c.u_px) + np.square(c.bias_px)) ** 2 * error_rel**2
    x, y = (t**4 / v if v > 0 else float("inf") for t, v in zip((verdict.total_x_px, verdict.total_y_px), loose, strict=True))
    return float(max(x, 1.0)), float(max(y, 1.0))


def headline(
    rows: Sequence[BudgetRow],
    together: MonteCarlo | None,
    frames: Sequence[int],
    in_chain: Callable[[str], MonteCarlo],
    unsteady_px: tuple[float, float] = (0.0, 0.0),
) -> tuple[Headline, tuple[Combined, ...]]:
    """Decide between the sum and the Monte Carlo, and combine for each number of frames.

    Parameters
    ----------
    rows : sequence of BudgetRow
        Those that the verdict rests on, all with a contribution.
    together : MonteCarlo, optional
        With all sources of the camera on.
    frames : sequence of int
    in_chain : callable
        Monte Carlo of what a source of this name does in the whole chain.
    unsteady_px : (float, float)
        What a calibration would take up of the Monte Carlo in x and y although the next image has it otherwise (`Interaction.unsteady_px`).

    Notes
    -----
    The sum is of first order and takes the sources for independent of each other; the Monte Carlo is neither, but it has an error of
    chance. Where both differ by more than two of their errors together, the Monte Carlo stands. Its error is that of the mean of squares
    over the places, Var(s²)/n = (κ − 1) s⁴/n: by the scatter that it shows, and by u and kurtosis κ that a contribution declares, for an
    error that few targets have may be missing from it altogether. What the simulated camera does not hold is added to it as squares.
    """
    sums = tuple(combine((r.part for r in rows), frames=n, signed=True) for n in frames)
    held = [r for r in rows if r.monte_carlo is not None]
    by_formula = combine((r.part for r in held), signed=True).total_px
    if together is None or not held:
        why = "The sum of the contributions; there is no Monte Carlo."
        return Headline(SUM, sums[0].total_px, float("nan"), float("nan"), 0.0, why), sums
    error, u_sum = _error(together, held), _model_error(held)
    found = Headline(SUM, by_formula, together.total_px, error, u_sum, "")
    difference, allowed = together.total_px - by_formula, COVERAGE * float(np.hypot(error, u_sum))
    if not np.isfinite(together.total_px) or together.lost > LOST * together.trials:
        why = f"The sum of the contributions: in {together.lost} of {together.trials} windows of the Monte Carlo no target was found."
        return replace(found, why=why), sums
    if abs(difference) <= allowed:
        why = "The sum of the contributions. One Monte Carlo with all sources at once agrees with it within the errors of both."
        return replace(found, why=why), sums
    others = [r for r in rows if r.monte_carlo is None]
    unsteady = (r.monte_carlo for r in held if r.part.gum_class in UNSTEADY)
    drifting = [m for m in unsteady if m is not None and np.isfinite(m.total_px)]
    of_others = (combine((r.part for r in others), frames=n, signed=True) for n in frames)
    simulated = tuple(_simulated(together, of_other, unsteady_px, drifting) for of_other in of_others)
    return replace(found, by=MONTE_CARLO, why=_why(found, held, in_chain)), simulated


def _error(together: MonteCarlo, rows: Sequence[BudgetRow]) -> float:
    """Standard error of the total of a Monte Carlo, with errors that only few targets have."""
    places = together.units * together.places
    parts = (r.part for r in rows)  # a bias has no chance in it
    # se_total_px holds the scatter of normal shifts, of a kurtosis of 3: what is beyond that is added
    squares = sum((0.5 * (c.u_x_px**2 + c.u_y_px**2)) ** 2 * max(c.kurtosis - 3, 0.0) for c in parts) / places
    rare = float(np.sqrt(squares)) / (2 * together.total_px) if together.total_px > 0 else float(np.sqrt(np.sqrt(squares)))
    return float(np.hypot(together.se_total_px, rare))


def _model_error(rows: Sequence[BudgetRow]) -> float:
    """Standard uncertainty of the sum from the model errors of its parts: of a half-width that the model declares, taken as k = 2."""
    total = combine((r.part for r in rows), signed=True).total_px
    parts = [(max(c.model_error * c.total_px, c.floor_px) * c.total_px) ** 2 for c in (r.part for r in rows)]
    return 0.5 * float(np.sqrt(sum(parts))) / total if total else 0.0


def _simulated(together: MonteCarlo, others: Combined, unsteady_px: tuple[float, float], drifting: Sequence[MonteCarlo]) -> Combined:
    """The mean over frames by the Monte Carlo, with contributions outside of it; drift and errors of the object do not average."""

    def axis(a: Axis, drifts: list[Axis], u_px: float, bias_px: float, left_px: float, unsteady_px: float) -> tuple[float, float, float]:
        stays2 = min(sum(d.temporal**2 for d in drifts), a.temporal**2)
        in_time2 = stays2 + (a.temporal**2 - stays2) / others.frames
        left2 = max(a.left**2 - a.temporal**2, 0.0) + in_time2 + left_px**2 + unsteady_px**2
        return float(np.sqrt(a.fixed**2 + in_time2 + u_px**2)), float(np.hypot(a.bias, bias_px)), float(np.sqrt(left2))

    u_x, bias_x, left_x = axis(together.x, [m.x for m in drifting], others.u_x_px, others.bias_x_px, others.left_x_px, unsteady_px[0])
    u_y, bias_y, left_y = axis(together.y, [m.y for m in drifting], others.u_y_px, others.bias_y_px, others.left_y_px, unsteady_px[1])
    return Combined(u_x, u_y, bias_x, bias_y, left_x, left_y, others.frames, others.targets)


def _why(found: Headline, rows: Sequence[BudgetRow], in_chain: Callable[[str], MonteCarlo]) -> str:
    """State that sum and Monte Carlo differ, and the source that causes most of the difference."""
    more = "larger" if found.sum_px > found.simulated_px else "smaller"
    text = (
        f"By one Monte Carlo with all sources at once: {found.simulated_px:.2g} ± {found.se_simulated_px:.1g} px. The sum of the "
        f"contributions, {found.sum_px:.2g} px, is {more} by more than the errors of both, because sources interact"
    )
    difference = found.simulated_px**2 - found.sum_px**2
    tried = sorted(rows, key=lambda r: -r.total_px)[:ASKED]
    in_whole = [(r, r.monte_carlo if r.source_id == ESTIMATOR_ITSELF else in_chain(r.name)) for r in tried]
    real = [(r, m.total_px) for r, m in in_whole if m is not None]
    row, in_px = max(real, key=lambda p: (p[1] ** 2 - p[0].total_px ** 2) * np.sign(difference))
    if np.isfinite(in_px) and (in_px**2 - row.total_px**2) / difference > MAIN_PART:
        return f"{text}: {row.title.lower()} alone is {row.total_px:.2g} px, in the whole chain {in_px:.2g} px."
    return f"{text}; no single source causes most of the difference."
