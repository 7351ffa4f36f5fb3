"""Blooming: excess charge of a full pixel of a CCD spills along its column.

A pixel that holds more than the full well gives its excess to the neighbours in the column, a part of it to the drain, until no pixel
holds too much. The end does not depend on the order of the spilling, and is found directly. Channel stops keep charge in its column.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import BrightSpots, Observations, SpotStreaks
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.sensor._readout_kernels import spill

UNLIMITED_E = 1e9
SIGNIFICANT = 3.3
NEEDED = 2.0  # times by which χ² grows without a parameter that the streaks need, whatever its u
WITHOUT = {"drained_share": 0.0, "drain_ratio": 1.0}  # what a parameter is that the streaks do not need
LEAST_STREAKS = 6  # columns and exposures with a streak
LEAST_WELLS = 0.5  # of charge that left a spot in a column, for a streak
METHOD = "charge above and below overexposed spots, fitted by the spilling of their light"


class Blooming(Parameters):
    """Capacity of a pixel, and the paths of its excess charge."""

    full_well_e: float = quantity(20_000.0, "e-", "most electrons that a pixel holds", gt=1, le=UNLIMITED_E)
    up_share: float = quantity(0.5, "1", "share of the spilled charge that goes to the row above (with the smaller number)", ge=0, le=1)
    drained_share: float = quantity(0.0, "1", "share of every spill that a lateral drain takes", ge=0, le=1)
    drain_ratio: float = quantity(
        1.0, "1", "over-exposure up to which an overflow drain takes all the excess of a pixel; 1: no drain", ge=1, le=1e6
    )
    knee_rel: float = quantity(0.0, "1", "share of the capacity, below the top, in which a pixel already spills charge", ge=0, lt=1)
    ends: Literal["drain", "barrier"] = quantity("drain", "1", "charge at the end of the column is lost, or goes back")


def forward(params: Blooming, signal: Signal, stream: Stream) -> Signal:
    """Spill the excess along the columns until no pixel holds more than the full well; electrons go up or down each for itself."""
    if params.full_well_e == UNLIMITED_E:
        return signal
    draws = None if stream.quiet else (stream.key("ways"), signal.grid.frame, signal.grid.col0)
    return signal.with_data(_spilled(params, signal.data, draws))


def _spilled(params: Blooming, electrons: np.ndarray, draws: tuple[np.uint64, np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    data = np.ascontiguousarray(electrons, np.float32)
    kept, barrier = 1.0 - params.drained_share, params.ends == "barrier"
    top = float(params.full_well_e)
    nowhere = np.zeros(len(data), np.int64)
    where = (np.uint64(0), nowhere, nowhere) if draws is None else draws
    ways = float(params.up_share), kept, barrier
    return spill(data, top, float(params.drain_ratio), float(params.knee_rel), *ways, draws is not None, *where)


def context(params: Blooming, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole column."""
    return windows.full_columns(frame_shape)


def propagate(params: Blooming, probe: Probe) -> Contribution:
    """Propagator P4: the estimator on the bloomed target; nothing while it stays below the knee."""
    gain = probe.gain_dn_per_e
    electrons = probe.signal_dn / gain
    if electrons.max() <= params.full_well_e * (1 - params.knee_rel):
        return probe.contribution((0.0, 0.0), "F", method="the target is below the full well")
    dx, dy = probe.moved(gain * _spilled(params, electrons).astype(np.float64))
    return probe.from_shifts(dx, dy, "F", model_error=0.5, method="the estimator on the target with the spilled charge within the window")


def measure(observations: Observations) -> Estimates:
    """Share up, drains and full well from the streaks of bright spots at many times the full well.

    The light of every column, from exposures that do not saturate, is spilled by ``forward`` itself, and its parameters are those for
    which as much charge lies above and below the spot as in the frames.
    """
    spots = observations.spots
    if spots is None:
        remedy = "take frames of bright spots on black, from half to many times the full well (kind: spots in the manifest)"
        raise MeasureError("not measured: needs bright spots on black", where="sensor.blooming", remedy=remedy)
    if not spots.saturated.any():
        why = next(iter(spots.fit.reasons.values()), "") if not spots.spots else "no spot is saturated"
        remedy = "add exposures of 2 to 20 times the full well" if spots.spots else ""
        raise MeasureError(why, where="sensor.blooming", remedy=remedy)
    if spots.streaks is None:
        what = "no streak of a spot that is alone in its columns ends within the frame"
        raise MeasureError(what, where="sensor.blooming", remedy="put the spots in the middle of the frame; add exposures of 2 to 5 times")
    found = _with_bend(_fitted(spots, spots.streaks), spots, observations.bend_rel(spots.plateau_dn))
    fit = observations.photon_transfer_fit
    if "full_well_dn" not in found:
        return found
    names = tuple("full_well_e" if n == "full_well_dn" else n for n in found.names)
    if fit is None or "gain_dn_per_e" not in fit:
        return found.select([n for n in found.names if n != "full_well_dn"])
    gain, at = fit["gain_dn_per_e"], found.index("full_well_dn")
    scale = np.ones(len(found))
    scale[at] = 1 / gain.value
    covariance = found.covariance * np.outer(scale, scale)
    covariance[at, at] += (found.values[at] * gain.u / gain.value**2) ** 2
    units = tuple("e-" if n == "full_well_e" else u for n, u in zip(names, found.units, strict=True))
    return replace(found, names=names, values=found.values * scale, covariance=covariance, units=units)


def _with_bend(found: Estimates, spots: BrightSpots, bend_rel: float) -> Estimates:
    """With what a bent response does in u: the light of far below saturation is then that of a full well so much higher or lower.

    What is not needed with another bend may be none at all.
    """
    if not bend_rel or spots.streaks is None:
        return found
    change = np.where([name in ("full_well_dn", "drain_ratio") for name in found.names], bend_rel, 0.0) * found.values
    for bend in (bend_rel, -bend_rel):
        other = spots if spots.clipped else replace(spots, plateau_dn=spots.plateau_dn * (1 + bend))
        light = replace(spots.streaks, light_dn=spots.streaks.light_dn * (1 + bend)) if spots.clipped else spots.streaks
        try:
            moved = _fitted(other, light)
        except MeasureError:
            continue
        there = [
            moved[name].value if name in moved else WITHOUT.get(name, value) for name, value in zip(found.names, found.values, strict=True)
        ]
        own = np.array(there) - found.values
        change = np.where(np.abs(own) > np.abs(change), own, change)
    return replace(found, covariance=found.covariance + np.outer(change, change))


def _spilled_sums(values: np.ndarray, spots: BrightSpots, streaks: SpotStreaks, factor: np.ndarray) -> np.ndarray:
    """Charge above and below each spot in DN, shape (entries, 2), of light times ``factor``, for (full well, up, drained, drain ratio)."""
    top, up, drained, ratio = values
    entries, height = streaks.light_dn.shape
    out = np.empty((entries, 2))
    for i in range(entries):
        first = int(streaks.first_row[i])
        column = np.zeros((1, spots.frame_rows, 1), np.float32)
        centre, (low, high) = int(streaks.centre_row[i]), streaks.window[i]
        end = min(first + height, spots.frame_rows)
        above, below = streaks.level_dn[i]
        column[0, :first, 0], column[0, end:, 0] = above, below
        passed = np.cumsum(streaks.light_dn[i, : end - first])
        column[0, first:end, 0] = above + (below - above) * passed / passed[-1]
        column[0, first:end, 0] += streaks.light_dn[i, : end - first] * factor[i]
        held = _spilled(Blooming(full_well_e=max(top, 1.01), up_share=up, drained_share=drained, drain_ratio=ratio), column)[0, :, 0]
        if spots.clipped:
            held = np.minimum(held, spots.plateau_dn)
        out[i] = held[low:centre].sum(), held[centre + 1 : high].sum()
    return out


def _fitted(spots: BrightSpots, streaks: SpotStreaks) -> Estimates:
    """The parameters in DN; those that the streaks do not need are left out, with the reason.

    Raises
    ------
    MeasureError
        If there are too few streaks.
    """
    plateau = spots.plateau_dn
    over = streaks.light_dn.max(axis=1) / plateau
    one = np.ones(len(streaks))
    unspilled = _spilled_sums(np.array([plateau, 0.5, 0.0, 1e6]), spots, streaks, one).sum(axis=1)
    spilled, lost = streaks.up_dn + streaks.down_dn - unspilled, np.maximum(streaks.light_dn - plateau, 0).sum(axis=1)
    streaked = spilled > LEAST_WELLS * plateau
    if streaked.sum() < LEAST_STREAKS:
        expected = lost > LEAST_WELLS * plateau
        if expected.sum() >= LEAST_STREAKS and not spots.clipped and not streaked.any():
            ratio, u = float(np.max(over[expected])), float(streaks.u_light_rel[np.argmax(over)])
            return Estimates.from_rows(
                [("drain_ratio", ratio, u * ratio, np.inf, "1"), ("full_well_dn", plateau, spots.fit["plateau_dn"].u, np.inf, "DN")],
                method=METHOD,
                lower_limits=frozenset({"drain_ratio"}),
                reasons={"drain_ratio": "no charge left the spots: the drain took all of it up to this over-exposure"},
            )
        what = f"{int(streaked.sum())} columns have a streak, {LEAST_STREAKS} are needed"
        raise MeasureError(what, where="sensor.blooming", remedy="add exposures of 2 to 20 times the full well, or larger spots")
    return _least_squares(spots, streaks)


def _least_squares(spots: BrightSpots, streaks: SpotStreaks) -> Estimates:
    """Gauss-Newton on (full well, up, drained, drain ratio), as far as they are free, with one factor for the light of each column."""
    observed = np.stack([streaks.up_dn, streaks.down_dn], axis=1)
    weight = 1 / streaks.var_dn2[:, None]
    _, place = np.unique(streaks.column, return_inverse=True)
    columns = int(place.max()) + 1
    prior = np.array([streaks.u_light_rel[place == c].min() for c in range(columns)])
    # full well, up, drained, drain ratio: their steps, and their smallest and largest values
    steps, low, high = np.array([0.002 * spots.plateau_dn, 0.002, 0.002, 0.01]), np.array([2.0, 0, 0, 1]), np.array([1e6, 1, 0.99, 1e6])

    def chi2_of(values: np.ndarray, factor: np.ndarray) -> float:
        off = observed - _spilled_sums(values, spots, streaks, factor[place])
        return float((weight * off**2).sum() + (((factor - 1) / prior) ** 2).sum())

    def solved(values: np.ndarray, free: list[int]) -> tuple[np.ndarray, np.ndarray, float, float]:
        factor, best = np.ones(columns), np.inf
        covariance, dof = np.eye(len(free)), 1.0
        best = chi2_of(values, factor)
        for _ in range(25):
            here = _spilled_sums(values, spots, streaks, factor[place])
            own = (_spilled_sums(values, spots, streaks, factor[place] * 1.002) - here) / 0.002 / factor[place][:, None]
            common = []
            for i in free:
                moved = values.copy()
                moved[i] += steps[i] if values[i] + steps[i] <= high[i] else -steps[i]
                common.append((_spilled_sums(moved, spots, streaks, factor[place]) - here) / (moved[i] - values[i]))
            jac, off = np.array(common), observed - here
            g_oo = np.bincount(place, (weight * own**2).sum(axis=1), columns) + prior**-2.0
            g_co = np.array([np.bincount(place, (weight * j * own).sum(axis=1), columns) for j in jac])
            r_o = np.bincount(place, (weight * own * off).sum(axis=1), columns) - (factor - 1) / prior**2
            normal = np.einsum("inm,jnm,nm->ij", jac, jac, np.broadcast_to(weight, off.shape)) - (g_co / g_oo) @ g_co.T
            right = np.einsum("inm,nm->i", jac, weight * off) - g_co @ (r_o / g_oo)
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
            inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-10) / np.outer(scale, scale)
            step = inverse @ right
            # The light of a column's pixels is uncertain one by one, so its exposures err together: u is the jackknife's over columns,
            # to first order (MacKinnon and White 1985).
            alone = np.array([np.bincount(place, (weight * j * off).sum(axis=1), columns) for j in jac]) - g_co / g_oo * r_o
            share = np.array([[np.bincount(place, (weight * j * k).sum(axis=1), columns) for j in jac] for k in jac])
            share -= g_co[:, None] * g_co[None] / g_oo
            pulls = np.array(
                [inverse @ np.linalg.lstsq(np.eye(len(free)) - share[..., c] @ inverse, alone[:, c])[0] for c in range(columns)]
            )
            covariance = pulls.T @ pulls * (columns - 1) / columns
            dof = float(((pulls**2).sum(axis=0) ** 2 / (pulls**4).sum(axis=0)).min())
            step_o = (r_o - g_co.T @ step) / g_oo
            size = 1.0
            while size > 1e-3:
                trial = values.copy()
                trial[free] = np.clip(values[free] + size * step, low[free], high[free])
                new = chi2_of(trial, factor + size * step_o)
                if new <= best:
                    break
                size /= 2
            else:
                break
            done = best - new < 1e-3
            values, factor, best = trial, factor + size * step_o, new
            if done:
                break
        return values, covariance, dof, best

    ups = np.linspace(0.05, 0.95, 19)
    one = np.ones(columns)
    ratios = (1.0,) if spots.clipped else (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
    start = min(((u, r) for u in ups for r in ratios), key=lambda p: chi2_of(np.array([spots.plateau_dn, p[0], 0.0, p[1]]), one))
    values = np.array([spots.plateau_dn, start[0], 0.0, start[1]])
    free = [0, 1] if spots.clipped else [1, 2, 3]
    names = ("full_well_dn", "up_share", "drained_share", "drain_ratio")
    neutral = np.array([np.nan, np.nan, 0.0, 1.0])
    reasons: dict[str, str] = {}
    widest = np.zeros(4)  # what is left out as not needed is not known to be none: the others keep the u that they have beside it
    found, covariance, dof, least = solved(values, free)
    while True:
        u = np.sqrt(np.diag(covariance))
        widest[free] = np.maximum(widest[free], u)
        small = [i for i in free if np.isfinite(neutral[i]) and abs(found[i] - neutral[i]) < SIGNIFICANT * widest[i]]
        for gone in sorted(small, key=lambda i: abs(found[i] - neutral[i]) / widest[i]):
            values = found.copy()
            values[gone] = neutral[gone]
            fewer = solved(values, [i for i in free if i != gone])
            if fewer[3] < NEEDED * max(least, observed.size):  # two that hide each other are not both left out
                reasons[names[gone]] = f"none is needed: {found[gone]:.3g} ± {widest[gone]:.2g}"
                free = [i for i in free if i != gone]
                found, covariance, dof, least = fewer
                break
        else:
            break
    wider = widest[free] / np.maximum(u, 1e-30)
    covariance = covariance * np.outer(wider, wider)
    used = [0, *free] if 0 not in free else free
    whole = np.zeros((len(used), len(used)))
    at = [used.index(i) for i in free]
    whole[np.ix_(at, at)] = covariance
    if 0 not in free:
        whole[0, 0] = spots.fit["plateau_dn"].u ** 2
    drain = "a drain: the converter ends below the full well, and the streaks tell the full well only without a drain"
    confounders = (drain,) if spots.clipped else ()
    units = {"full_well_dn": "DN"}
    return Estimates(
        tuple(names[i] for i in used),
        found[used],
        whole,
        np.full(len(used), max(dof, 1.0)),
        tuple(units.get(names[i], "1") for i in used),
        method=METHOD,
        confounders=confounders,
        reasons={n: why for n, why in reasons.items() if n in [names[i] for i in used]},
    )


SOURCE = Source(
    id="sensor.blooming",
    title="Blooming",
    description="Charge beyond the full well spills along the column. If it spills more in one direction, the target's centre moves.",
    number=11,
    stars=2,
    parameters=Blooming,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise",),
    before=("sensor.full_well", "sensor.charge_transfer"),
    neutral=Blooming(full_well_e=UNLIMITED_E),
    typical=Blooming(up_share=0.4),
    bound=Blooming(up_share=0.4, knee_rel=0.2),
    forward=forward,
    measure=measure,
    propagate=propagate,
    context=context,
    applies_to=("ccd",),
    gum_class="F",
    equation="q ← F,  (q − F)(1 − β) α to the row above, (q − F)(1 − β)(1 − α) to the row below, until q ≤ F everywhere",
    typical_size="α = 0.4: 0.19, 1.5 and 11.5 px on a disc of 5 px exposed 1.5, 3 and 10 times over the full well",
    references=(
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, (full well and blooming)",
        "R. W. Cottle, J.-S. Pang, R. E. Stone, The Linear Complementarity Problem, Academic Press 1992 (uniqueness for M-matrices)",
    ),
    advice="Lower the exposure until the target peaks at 80 % of the full well; drop targets with streaks.",
    reasons={
        "correct": "charges that left a pixel and those that a neighbour gave it add to one value: any two original images with the same "
        "sums along a column give this frame. Flag the columns, or fit full pixels as 'at least the full well'",
    },
)
