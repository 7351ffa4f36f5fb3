"""Defect pixels: hot ones with far too much dark charge, dead ones with hardly any response."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.core.contribution import Contribution, Probe
from pixmetry.core.errors import MeasureError
from pixmetry.core.estimates import Estimates
from pixmetry.core.observations import DefectList, Observations
from pixmetry.core.random import Grid, Stream
from pixmetry.core.signal import Kind, Signal
from pixmetry.core.source import Parameters, Source, cut_map, quantity

FEWEST = 10  # hot pixels, for the distribution of their excess
NEIGHBOURS = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]


class Defects(Parameters):
    """How many pixels are hot or dead, and how much; which ones is fixed in the unit."""

    hot_fraction: float = quantity(0.0, "1", "share of hot pixels", ge=0, le=0.1)
    hot_median_e: float = quantity(500.0, "e-", "median dark excess of a hot pixel in one exposure", gt=0, le=1e6)
    hot_sigma_log: float = quantity(0.5, "1", "standard deviation of the natural logarithm of the excess", ge=0, le=3)
    dead_fraction: float = quantity(0.0, "1", "share of dead pixels", ge=0, le=0.1)
    dead_gain_rel: float = quantity(0.0, "1", "response of a dead pixel over that of a good one", ge=0, lt=0.5)


def forward(params: Defects, signal: Signal, stream: Stream) -> Signal:
    """Lower the mean signal of dead pixels and add the excess of hot ones, which takes part in the shot noise that follows."""
    if params.hot_fraction == 0 and params.dead_fraction == 0:
        return signal
    lot = stream.uniform_fixed(signal.grid)
    data = np.where(lot > 1 - params.dead_fraction, signal.data * np.float32(params.dead_gain_rel), signal.data)
    i, r, c = np.nonzero(lot < params.hot_fraction)
    data[i, r, c] += excess_e(params, signal.rows[i, r], signal.cols[i, c], stream)
    return signal.with_data(data)


def excess_e(params: Defects, row: np.ndarray, col: np.ndarray, stream: Stream) -> np.ndarray:
    """Dark excess that each of these pixels has if it is hot, shape (k,), float32; a pixel always has the same one."""
    single = Grid(np.zeros_like(row), row, col, (1, 1))
    return np.float32(params.hot_median_e) * np.exp(np.float32(params.hot_sigma_log) * stream.normal_fixed(single)[:, 0, 0])


def measure(observations: Observations) -> Estimates:
    """Count the defects found in the stacks.

    Shares with u by Jeffreys' posterior, Beta(k + ½, n − k + ½); where none was found, its one-sided 95 % limit. A hot pixel whose excess
    is below the detection limit of the stack is not counted, so the share is that of detectable ones.
    """
    found = observations.defects
    if found is None:
        raise MeasureError(
            "defects need a stack of dark frames", where="sensor.defects", remedy="take at least 16 dark and 16 bright frames"
        )
    kind = np.array(found.kind, dtype="U5")
    fit = observations.photon_transfer_fit
    rows, limits, reasons = [], set(), {}

    def add_share(name: str, count: int) -> None:
        value, u, limit = _share(count, found.shape[0] * found.shape[1])
        rows.append((name, value, u, np.inf, "1"))
        if limit:
            limits.add(name)
            reasons[name] = "none was found; 95 % upper limit"

    hot = kind == "hot"
    add_share("hot_fraction", int(hot.sum()))
    if hot.sum() >= FEWEST:  # fewer tell a spread only to a factor, and not by Student's t
        rows += _excess_rows(found.dark_excess_dn[hot], None if fit is None or "gain_dn_per_e" not in fit else fit["gain_dn_per_e"])
    if observations.bright_stack is not None or np.isfinite(found.gain_rel).any():
        rows += _dead_rows(found, kind, add_share)
    return Estimates.from_rows(
        rows,
        method="count of pixels beyond the Gaussian core, Jeffreys interval (Brown, Cai & DasGupta 2001); moments of the logarithm",
        confounders=("hot pixels that saturate in the bright stack count as dead", "cosmic rays and blinking pixels"),
        limits=frozenset(limits),
        reasons=reasons,
    )


def _share(count: int, pixels: int) -> tuple[float, float, bool]:
    """Share, its u, and whether the share is a limit."""
    a, b = count + 0.5, pixels - count + 0.5
    u = float(np.sqrt(a * b / ((a + b) ** 2 * (a + b + 1))))
    if count:
        return count / pixels, u, False
    from scipy.stats import beta

    return float(beta.ppf(0.95, a, b)), u, True


def _excess_rows(excess_dn: np.ndarray, gain) -> list[tuple[str, float, float, float, str]]:
    """Median (in electrons, if the gain is known) and logarithmic spread of the dark excess of hot pixels."""
    log = np.log(np.maximum(excess_dn, 1e-6))
    n, spread = len(log), float(log.std(ddof=1))
    rows = [("hot_sigma_log", spread, spread / np.sqrt(2 * (n - 1)), n - 1.0, "1")]
    if gain is not None:
        median = float(np.exp(log.mean())) / gain.value
        rows.append(("hot_median_e", median, median * float(np.hypot(spread / np.sqrt(n), gain.u / gain.value)), n - 1.0, "e-"))
    return rows


def _dead_rows(found: DefectList, kind: np.ndarray, add_share) -> list[tuple[str, float, float, float, str]]:
    dead = np.isin(kind, ("dead", "stuck"))
    add_share("dead_fraction", int(dead.sum()))
    if dead.sum() < 2:
        return []
    gain, n = found.gain_rel[dead], int(dead.sum())
    return [("dead_gain_rel", float(np.clip(gain.mean(), 0, 0.4999)), float(gain.std(ddof=1) / np.sqrt(n)), n - 1.0, "1")]


def correct(params: Defects, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Replace every pixel that is set in the map ``defects`` by the median of its good neighbours (of eight) in the window."""
    bad = cut_map(maps, "defects", signal).astype(bool)
    i, r, c = np.nonzero(bad)
    if not len(i):
        return signal
    values = np.full((len(NEIGHBOURS), len(i)), np.nan)
    rows, cols = signal.data.shape[1:]
    for k, (dr, dc) in enumerate(NEIGHBOURS):
        inside = (r + dr >= 0) & (r + dr < rows) & (c + dc >= 0) & (c + dc < cols)
        at = (i[inside], r[inside] + dr, c[inside] + dc)
        values[k, inside] = np.where(bad[at], np.nan, signal.data[at])
    known = np.isfinite(values).any(axis=0)
    data = signal.data.astype(np.float32)
    data[i[known], r[known], c[known]] = np.nanmedian(values[:, known], axis=0)
    return signal.with_data(data)


def propagate(params: Defects, probe: Probe) -> Contribution:
    """Propagator P1 over the population of targets: a pixel's mean square error is the share times that of one defect.

    The excess is log-normal, E[e²] = m² exp(2s²); a dead pixel lacks (1 − g) of its signal. Most targets have no defect at all and few
    have a large error, so u is a root mean square, not the width of a Gaussian.
    """
    hot = params.hot_fraction * (probe.gain_dn_per_e * params.hot_median_e) ** 2 * np.exp(2 * params.hot_sigma_log**2)
    dead = params.dead_fraction * ((1 - params.dead_gain_rel) * probe.signal_dn) ** 2
    return probe.contribution(
        probe.white(np.sqrt(hot + dead)), "F", model_error=0.5, method="linear response of the estimator to rare errors of single pixels"
    )


SOURCE = Source(
    id="sensor.defects",
    title="Defect pixels",
    description="A few pixels are hot (dark charge, log-normal) or dead (little response), at fixed places.",
    number=17,
    stars=2,
    parameters=Defects,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.quantum_efficiency",),
    before=("sensor.shot_noise",),
    neutral=Defects(),
    typical=Defects(hot_fraction=2e-4, dead_fraction=2e-5),
    bound=Defects(hot_fraction=1e-3, dead_fraction=1e-4),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="hot: n' = n + m e^(s z);  dead: n' = g n;  one pixel of error v at distance d: Δ = v d/S",
    typical_size="0.03 px for one pixel that is 50 DN off at the edge of a disc of 7 px",
    references=("EMVA 1288 R4.0 Linear, §8.4 (defect pixels)", "L. D. Brown, T. T. Cai, A. DasGupta, Statistical Science 16(2), 2001"),
    advice="List the defects and leave them out of the fit; or replace them by the median of their neighbours.",
)
