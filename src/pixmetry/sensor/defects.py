"""Defect pixels: hot ones with far too much dark charge, dead ones with hardly any response, and what else is found off the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.core.contribution import Contribution, Probe
from pixmetry.core.errors import MeasureError
from pixmetry.core.estimates import Estimate, Estimates
from pixmetry.core.observations import Observations
from pixmetry.core.random import Grid, Stream
from pixmetry.core.signal import Kind, Signal
from pixmetry.core.source import Parameters, Source, cut_map, quantity

PHASES = 6  # places within the pixel at which a defect is tried
MOST = 0.1  # share of defects beyond which it is not clear what the good pixels are
FOUND_95 = 1.645  # standard deviations above the limit at which 95 of 100 defects are found
NODES = 7  # of the Gauss–Hermite quadrature over the logarithm of the excess
NEIGHBOURS = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]


class Defects(Parameters):
    """How many pixels are defect in each way, and how much; which ones is fixed in the unit."""

    hot_fraction: float = quantity(0.0, "1", "share of hot pixels", ge=0, le=MOST)
    hot_median_e: float = quantity(500.0, "e-", "median dark excess of a hot pixel in one exposure", ge=0, le=1e6)
    hot_sigma_log: float = quantity(0.5, "1", "standard deviation of the natural logarithm of the excess", ge=0, le=3)
    dead_fraction: float = quantity(0.0, "1", "share of dead pixels", ge=0, le=MOST)
    dead_gain_rel: float = quantity(0.0, "1", "response of a dead pixel over that of a good one", ge=0, lt=0.5)
    cold_fraction: float = quantity(0.0, "1", "share of pixels whose dark value is too low", ge=0, le=MOST)
    cold_e: float = quantity(200.0, "e-", "what a cold pixel lacks", ge=0, le=1e6)
    gain_fraction: float = quantity(0.0, "1", "share of pixels whose response is off, yet not dead", ge=0, le=MOST)
    gain_std_rel: float = quantity(0.2, "1", "root mean square of their relative response error", ge=0, le=10)
    noisy_fraction: float = quantity(0.0, "1", "share of pixels with too much temporal noise", ge=0, le=MOST)
    noisy_std_e: float = quantity(100.0, "e-", "standard deviation of that noise", ge=0, le=1e6)


def forward(params: Defects, signal: Signal, stream: Stream) -> Signal:
    """Change the mean signal of the defects; an excess takes part in the shot noise that follows, and no charge falls below zero."""
    p = params
    if not any((p.hot_fraction, p.dead_fraction, p.cold_fraction, p.gain_fraction, p.noisy_fraction)):
        return signal
    lot = stream.uniform_fixed(signal.grid)
    data = np.where(lot > 1 - p.dead_fraction, signal.data * np.float32(p.dead_gain_rel), signal.data)
    low = 0.0
    for share, change in ((p.hot_fraction, _heat), (p.cold_fraction, _cool), (p.gain_fraction, _respond), (p.noisy_fraction, _flicker)):
        i, r, c = np.nonzero((lot >= low) & (lot < low + share))
        if len(i):
            single = Grid(signal.grid.frame[i], signal.rows[i, r], signal.cols[i, c], (1, 1))
            data[i, r, c] = change(p, data[i, r, c], single, stream)
        low += share
    return signal.with_data(data)


def _heat(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value + np.float32(params.hot_median_e) * np.exp(np.float32(params.hot_sigma_log) * stream.normal_fixed(single)[:, 0, 0])


def _cool(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.maximum(value - np.float32(params.cold_e), 0)


def _respond(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value * np.maximum(1 + np.float32(params.gain_std_rel) * stream.normal_fixed(single)[:, 0, 0], 0)


def _flicker(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.maximum(value + np.float32(params.noisy_std_e) * stream.normal(single)[:, 0, 0], 0)


def measure(observations: Observations) -> Estimates:
    """Count the defects found in the stacks, and describe them.

    The shares are those of this very unit: every pixel of it was looked at, so a count of none means none, without a limit for what a
    sample might have missed. What u remains is that of the good pixels called defect by chance, √(expected number)/pixels. A pixel whose
    error is below the limit of the search is not counted here: it stays among the good pixels, and their scatter (DSNU, PRNU) holds it.
    Where no hot pixel was found, ``hot_median_e`` is that limit: the excess with which 95 of 100 hot pixels would have been found.
    """
    found = observations.defects
    if found is None:
        raise MeasureError(
            "defects need a stack of dark frames", where="sensor.defects", remedy="take at least 16 dark and 16 bright frames"
        )
    kind = np.array(found.kind, dtype="U5")
    places = {
        "hot": kind == "hot",
        "dead": np.isin(kind, ("dead", "stuck")),
        "cold": kind == "cold",
        "gain": kind == "gain",
        "noisy": kind == "noisy",
    }
    lit = observations.bright_stack is not None or bool(np.isfinite(found.gain_rel).any())
    fit = observations.photon_transfer_fit
    gain = None if fit is None or "gain_dn_per_e" not in fit else fit["gain_dn_per_e"]
    pixels, rows, reasons, limits = found.shape[0] * found.shape[1], [], {}, set()
    for name, here in places.items():
        if name in ("dead", "gain") and not lit:
            continue
        count = int(here.sum())
        if count > MOST * pixels:
            raise MeasureError(
                f"so many pixels are {name} that it is not clear what the good ones are",
                where="sensor.defects",
                value=f"{100 * count / pixels:.3g} %",
                allowed=f"at most {100 * MOST:g} %",
                remedy="see whether light, exposure and temperature were the same in all frames of the stacks",
            )
        by_chance = float(np.sqrt(found.expected_false)) if count else 0.0
        rows.append((f"{name}_fraction", count / pixels, by_chance / pixels, np.inf, "1"))
        if not count:
            reasons[f"{name}_fraction"] = "all pixels were looked at, none was found; smaller errors are in the scatter of the good ones"
    if not places["hot"].any() and gain is not None and np.isfinite(found.dark_limit_dn):
        limit = (found.dark_limit_dn + FOUND_95 * found.dark_sigma_dn) / gain.value
        rows.append(("hot_median_e", min(limit, 1e6), limit * gain.u / gain.value, np.inf, "e-"))
        limits.add("hot_median_e")
        reasons["hot_median_e"] = "none was found; 95 of 100 with this excess would have been"
    rows += _errors(observations, places, gain)
    return Estimates.from_rows(
        rows,
        method="count of pixels beyond the Gaussian core of the others; moments of their errors",
        confounders=("hot pixels that saturate in the bright stack count as dead", "cosmic rays and blinking pixels"),
        limits=frozenset(limits),
        reasons=reasons,
    )


Row = tuple[str, float, float, float, str]


def _errors(observations: Observations, places: Mapping[str, np.ndarray], gain: Estimate | None) -> list[Row]:
    """How large the errors are of the kinds that were found; those in electrons only if the gain is known."""
    found = observations.defects
    rows: list[Row] = []
    dark_u, response_u = (float(np.nan_to_num(v)) for v in (found.dark_sigma_dn, found.gain_sigma_rel))

    def add_e(name: str, value_dn: float, u_dn: float, dof: float) -> None:
        if gain is not None:
            value = min(value_dn / gain.value, 1e6)
            rows.append((name, value, float(np.hypot(u_dn / gain.value, value * gain.u / gain.value)), dof, "e-"))

    n = {name: int(here.sum()) for name, here in places.items()}
    if n["hot"]:
        log = np.log(np.maximum(found.dark_excess_dn[places["hot"]], 1e-6))
        spread, dof = (float(log.std(ddof=1)), n["hot"] - 1.0) if n["hot"] > 1 else (0.0, np.inf)
        median = float(np.exp(log.mean()))
        own = dark_u / median  # relative, of a single excess: it stands on the pixel's own dark signal
        u_spread = float(np.hypot(spread / np.sqrt(2 * max(n["hot"] - 1, 1)), own / n["hot"] ** 0.5))
        rows.append(("hot_sigma_log", min(spread, 3.0), u_spread, dof, "1"))
        add_e("hot_median_e", median, median * float(np.hypot(spread, own)) / n["hot"] ** 0.5, dof)
    if n["dead"]:
        response = found.gain_rel[places["dead"]]
        u, dof = (float(response.std(ddof=1)), n["dead"] - 1.0) if n["dead"] > 1 else (response_u, np.inf)
        rows.append(("dead_gain_rel", float(np.clip(response.mean(), 0, 0.4999)), u / n["dead"] ** 0.5, dof, "1"))
    if n["cold"]:
        add_e("cold_e", float(np.sqrt((found.dark_excess_dn[places["cold"]] ** 2).mean())), dark_u / n["cold"] ** 0.5, np.inf)
    if n["gain"]:
        rms = float(np.sqrt(((found.gain_rel[places["gain"]] - 1) ** 2).mean()))
        rows.append(("gain_std_rel", min(rms, 10.0), response_u / n["gain"] ** 0.5, np.inf, "1"))
    stack = observations.dark_stack
    if n["noisy"] and stack is not None:
        at = found.row[places["noisy"]], found.col[places["noisy"]]
        std = float(np.sqrt(max(stack.var_map_dn2[at].mean() - np.median(stack.var_map_dn2), 0.0)))
        dof = n["noisy"] * (stack.n_frames - 1.0)
        add_e("noisy_std_e", std, std / np.sqrt(2 * dof), dof)
    return rows


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
    """Propagator P4 over the population of targets: every pixel of the window has every kind of defect in turn.

    The mean square shift is Σ share · shift² over pixels and kinds, the shift found by the estimator itself: a threshold is blind to a
    small error of the background, not to a hot pixel that rises above it. The excess runs over a Gauss–Hermite quadrature of its
    log-normal law (without an estimator to ask, E[e²] = m² exp(2s²) to first order), response and noise over ± one standard deviation.
    Most targets have no defect at all and few have a large error, so u is a root mean square, not the width of a Gaussian; it counts
    defects one by one, so the share must be small against one defect a window. Noisy pixels are counted with what is fixed.
    """
    method = "mean square of the shifts by defects of single pixels, one at a time"
    if probe.locate is None:
        variance = sum(share * _mean_square_dn2(params, name, probe) for name, share in _shares(params))
        return probe.contribution(probe.white(np.sqrt(variance)), "F", model_error=0.05, method=method + ", first order")
    few = np.unique(np.linspace(0, len(probe.signal_dn) - 1, PHASES).round().astype(int))
    square = np.zeros(2)
    for phase in few:
        for name, share in _shares(params):
            for weight, changed in _cases(params, name, probe.signal_dn[phase], probe.gain_dn_per_e):
                square += share * weight * _sum_of_squares(probe, phase, changed)
    u_x, u_y = np.sqrt(square / len(few))
    return probe.contribution((float(u_x), float(u_y)), "F", model_error=0.05, method=method)


def _shares(params: Defects) -> list[tuple[str, float]]:
    """The kinds that there are, with their shares."""
    shares = {name: getattr(params, f"{name}_fraction") for name in ("hot", "dead", "cold", "gain", "noisy")}
    return [(name, share) for name, share in shares.items() if share > 0]


def _cases(params: Defects, name: str, signal_dn: np.ndarray, gain_dn_per_e: float) -> list[tuple[float, np.ndarray]]:
    """Weights and changed values of all pixels for a kind of defect."""
    p, k = params, gain_dn_per_e
    if name == "hot":
        z, w = np.polynomial.hermite_e.hermegauss(NODES)
        excess = k * p.hot_median_e * np.exp(p.hot_sigma_log * z)
        return [(weight, signal_dn + e) for weight, e in zip(w / w.sum(), excess, strict=True)]
    if name == "dead":
        return [(1.0, p.dead_gain_rel * signal_dn)]
    if name == "cold":
        return [(1.0, np.maximum(signal_dn - k * p.cold_e, 0))]
    if name == "gain":
        return [(0.5, signal_dn * max(1 + s * p.gain_std_rel, 0)) for s in (-1, 1)]
    return [(0.5, np.maximum(signal_dn + s * k * p.noisy_std_e, 0)) for s in (-1, 1)]


def _mean_square_dn2(params: Defects, name: str, probe: Probe) -> np.ndarray | float:
    if name == "hot":
        return (probe.gain_dn_per_e * params.hot_median_e) ** 2 * np.exp(2 * params.hot_sigma_log**2)
    return sum(w * (v - probe.signal_dn) ** 2 for w, v in _cases(params, name, probe.signal_dn, probe.gain_dn_per_e))


def _sum_of_squares(probe: Probe, phase: int, changed_dn: np.ndarray) -> np.ndarray:
    """Sum over pixels of the squared shift in x and y when one pixel alone has its changed value."""
    base = probe.signal_dn[phase]
    at = np.flatnonzero(changed_dn != base)
    windows = np.repeat(base.reshape(1, -1), len(at), axis=0)
    windows[np.arange(len(at)), at] = changed_dn.ravel()[at]
    x, y = probe.locate(windows.reshape(-1, *base.shape))
    shifts = np.array([x - probe.x_hat_px[phase], y - probe.y_hat_px[phase]])
    return np.nansum(shifts**2, axis=1)  # a target that is lost with its only pixel has no position


SOURCE = Source(
    id="sensor.defects",
    title="Defect pixels",
    description="A few pixels are hot (dark charge, log-normal), dead (little response), cold, off in response or noisy, at fixed places.",
    number=17,
    stars=2,
    parameters=Defects,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.quantum_efficiency",),
    before=("sensor.shot_noise",),
    neutral=Defects(),
    typical=Defects(hot_fraction=2e-4, dead_fraction=2e-5),
    bound=Defects(hot_fraction=1e-3, dead_fraction=1e-4, cold_fraction=1e-4, gain_fraction=5e-4, noisy_fraction=5e-4),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="hot: n' = n + m e^(s z);  dead: g n;  cold: n − c;  response: (1 + r z) n;  noisy: n + s z;  one pixel of error v: Δ = v d/S",
    typical_size="0.03 px for one pixel that is 50 DN off at the edge of a disc of 7 px",
    references=("EMVA 1288 R4.0 Linear, §8.4 (defect pixels)",),
    advice="List the defects and leave them out of the fit; or replace them by the median of their neighbours.",
)
