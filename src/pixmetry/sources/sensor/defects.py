"""Defect pixels: hot ones with far too much dark charge, dead ones with hardly any response, and other pixels that differ."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import NormalDist

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt
from scipy.ndimage import binary_dilation

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, cut_map, quantity
from pixmetry.core.arrays import Array, Singles
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates, Number
from pixmetry.core.random import Grid, Stream

MOST = 0.1  # share of defects beyond which it is not clear what the good pixels are
LOOK_BACK = (8, 256)  # frames looked at together for the last draw of a blinking pixel: at first, and at most
FOUND_95 = 1.645  # standard deviations above the limit at which 95 of 100 defects are found
PHASES = 4  # places within the pixel at which a defect is tried
ROUND_PX = 3  # about the pixels that matter at one place within the pixel, those that may at another
MOST_TRIED = 2500  # pixels of a window, or clusters, that are tried one by one
SMALL = 0.01  # of the largest shift: what is left out
NODES = 5  # of the Gauss–Hermite quadrature over the logarithm of the excess
NEIGHBOURS = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
Listed = tuple[NonNegativeInt, NonNegativeInt, NonNegativeFloat, float]
Row = tuple[str, float, float, float, str]


class Defects(Parameters):
    """How many pixels are defect in each way, and how much; which ones is fixed in the unit."""

    hot_fraction: float = quantity(0.0, "1", "share of hot pixels", ge=0, le=MOST)
    hot_median_e: float = quantity(500.0, "e-", "median dark excess of a hot pixel in one exposure", ge=0, le=1e6)
    hot_sigma_log: float = quantity(0.5, "1", "standard deviation of the natural logarithm of the excess", ge=0, le=3)
    dead_fraction: float = quantity(0.0, "1", "share of dead pixels", ge=0, le=MOST)
    dead_gain_rel: float = quantity(0.0, "1", "response of a dead pixel relative to a good pixel", ge=0, lt=0.5)
    cold_fraction: float = quantity(0.0, "1", "share of pixels whose dark value is too low", ge=0, le=MOST)
    cold_e: float = quantity(200.0, "e-", "deficit of a cold pixel", ge=0, le=1e6)
    gain_fraction: float = quantity(0.0, "1", "share of pixels whose response is wrong but not zero", ge=0, le=MOST)
    gain_std_rel: float = quantity(0.2, "1", "root mean square of their relative response error", ge=0, le=10)
    noisy_fraction: float = quantity(0.0, "1", "share of pixels with too much temporal noise", ge=0, le=MOST)
    noisy_std_e: float = quantity(100.0, "e-", "standard deviation of that noise", ge=0, le=1e6)
    blinking_fraction: float = quantity(0.0, "1", "share of pixels whose dark charge jumps between two levels", ge=0, le=MOST)
    blinking_e: float = quantity(100.0, "e-", "difference between the two levels of a blinking pixel", ge=0, le=1e6)
    blinking_on: float = quantity(0.5, "1", "share of the frames in which a blinking pixel is on its upper level", gt=0, lt=1)
    blinking_frames: float = quantity(
        10.0, "1", "mean number of frames from one draw of the level to the next: correlation (1 − 1/frames)^k", ge=1, le=1000
    )
    stuck_fraction: float = quantity(0.0, "1", "share of pixels whose charge does not depend on the light", ge=0, le=MOST)
    stuck_e: float = quantity(10_000.0, "e-", "charge of a stuck pixel", ge=0, le=1e7)
    column_fraction: float = quantity(0.0, "1", "share of defect columns", ge=0, le=MOST)
    column_gain_rel: float = quantity(0.0, "1", "response of a defect column relative to a good column", ge=0, le=2)
    column_e: float = quantity(0.0, "e-", "dark excess of a defect column", ge=0, le=1e6)
    cluster_fraction: float = quantity(0.0, "1", "share of pixels that are the centre of a cluster", ge=0, le=0.01)
    cluster_radius_px: float = quantity(1.5, "px", "radius of a cluster", ge=0, le=8)
    cluster_gain_rel: float = quantity(0.0, "1", "response within a cluster relative to good pixels", ge=0, le=2)
    listed: tuple[Listed, ...] = quantity(
        (), "px, px, 1, e-", "known defects: row, column, response, dark excess (response 0 and excess 0: a dead pixel)"
    )

    @property
    def shares(self) -> dict[str, float]:
        """Share of every kind of single defect pixels."""
        return {kind: getattr(self, f"{kind}_fraction") for kind in ("hot", "cold", "gain", "noisy", "blinking", "stuck", "dead")}

    @property
    def none(self) -> bool:
        """Whether there are no defects at all."""
        return not (any(self.shares.values()) or self.column_fraction or self.cluster_fraction or self.listed)


def forward(params: Defects, signal: Signal, stream: Stream) -> Signal:
    """Change the mean signal of the defects; an excess takes part in the shot noise that follows, and no charge falls below zero."""
    p = params
    known = stream.known_unit("pixels")
    if known is None and p.none:
        return signal
    data = signal.data.copy()
    if known is not None:
        data = _of_unit(known, data, signal, stream)
    elif any(p.shares.values()):
        lot = stream.uniform_fixed(signal.grid)
        for kind, (low, high) in _bands(p).items():
            if low == high:
                continue
            i, r, c = np.nonzero((lot >= low) & (lot < high))
            if len(i):
                single = Grid(signal.grid.frame[i], signal.rows[i, r], signal.cols[i, c], (1, 1))
                data[i, r, c] = CHANGES[kind](p, data[i, r, c], single, stream)
    if p.column_fraction:
        bad = _columns(p, signal.grid, stream)[:, None, :]
        data = np.where(bad, data * np.float32(p.column_gain_rel) + np.float32(p.column_e), data)
    if p.cluster_fraction:
        data = np.where(_clusters(p, signal.grid, stream), data * np.float32(p.cluster_gain_rel), data)
    for row, col, response, excess_e in p.listed:
        i, r, c = np.nonzero((signal.rows == row)[:, :, None] & (signal.cols == col)[:, None, :])
        data[i, r, c] = np.maximum(data[i, r, c] * np.float32(response) + np.float32(excess_e), 0)
    return signal.with_data(data)


def _of_unit(pixels: np.ndarray, data: np.ndarray, signal: Signal, stream: Stream) -> np.ndarray:
    """Change the defects of a measured unit: one row each with row, column, response, dark excess and temporal noise in electrons."""
    row0, col0, (rows, cols) = signal.grid.row0, signal.grid.col0, signal.grid.shape
    r, c = pixels[:, 0].astype(int) - row0[:, None], pixels[:, 1].astype(int) - col0[:, None]
    i, k = np.nonzero((r >= 0) & (r < rows) & (c >= 0) & (c < cols))
    if len(i):
        r, c = r[i, k], c[i, k]
        single = Grid(signal.grid.frame[i], row0[i] + r, col0[i] + c, (1, 1))
        response, excess_e, noise_e = pixels[k, 2:5].astype(np.float32).T
        data[i, r, c] = np.maximum(data[i, r, c] * response + excess_e + noise_e * stream.normal(single)[:, 0, 0], 0)
    return data


def truth(params: Defects, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Masks of the unit, by kind; ``listed`` are those given, or those that were measured in this unit."""
    one = signal.take(np.array([0]))
    lot = stream.uniform_fixed(one.grid)[0]
    known = stream.known_unit("pixels")
    masks = {kind: (lot >= low) & (lot < high) & (known is None) for kind, (low, high) in _bands(params).items()}
    masks["column"] = np.broadcast_to(_columns(params, one.grid, stream)[0], lot.shape).copy()
    masks["cluster"] = _clusters(params, one.grid, stream)[0]
    masks["listed"] = np.zeros(lot.shape, bool)
    for row, col in [*(entry[:2] for entry in params.listed), *([] if known is None else known[:, :2].astype(int).tolist())]:
        masks["listed"] |= (one.rows[0] == row)[:, None] & (one.cols[0] == col)
    return masks


def _bands(params: Defects) -> dict[str, tuple[float, float]]:
    """Which part of (0, 1) of the pixel's lot makes it a defect of each kind; the dead ones lie at the top."""
    bands, low = {}, 0.0
    for kind, share in params.shares.items():
        bands[kind] = (low, low + share) if kind != "dead" else (1 - share, 2.0) if share else (1.0, 1.0)
        low += share
    return bands


def _columns(params: Defects, grid: Grid, stream: Stream) -> np.ndarray:
    """Which columns are defect, shape (n, cols)."""
    if not params.column_fraction:
        return np.zeros((len(grid.frame), grid.shape[1]), bool)
    return stream.normal_cols_fixed(grid) > np.float32(NormalDist().inv_cdf(1 - params.column_fraction))


def _clusters(params: Defects, grid: Grid, stream: Stream) -> np.ndarray:
    """Which pixels lie within the radius of the centre of a cluster, shape (n, rows, cols)."""
    rows, cols = grid.shape
    reach = int(params.cluster_radius_px)
    if not params.cluster_fraction:
        return np.zeros(grid.size, bool)
    wide = Grid(grid.frame, grid.row0 - reach, grid.col0 - reach, (rows + 2 * reach, cols + 2 * reach))
    centre = stream.uniform_fixed(wide, draw=1) < params.cluster_fraction
    inside = np.zeros(grid.size, bool)
    for dr, dc in disc(params.cluster_radius_px):
        inside |= centre[:, reach + dr : reach + dr + rows, reach + dc : reach + dc + cols]
    return inside


def disc(radius_px: float) -> list[tuple[int, int]]:
    """Row and column steps to the pixels within a radius."""
    reach = range(-int(radius_px), int(radius_px) + 1)
    return [(dr, dc) for dr in reach for dc in reach if dr * dr + dc * dc <= radius_px**2]


def blinking_level(params: Defects, single: Grid, stream: Stream) -> np.ndarray:
    """Level, 0 or 1, of blinking pixels given one by one with their frames, shape (n,); its mean where the stream is quiet.

    In each frame a pixel draws its level anew with probability 1/``blinking_frames``, else it keeps it: a stationary Markov chain, which
    for any frame is found by looking back for the last draw.
    """
    if stream.quiet:
        return np.full(len(single.frame), params.blinking_on, np.float32)
    drawn = np.zeros_like(single.frame)
    open_, back, step = np.arange(len(drawn)), 0, LOOK_BACK[0]
    while len(open_):
        frames = np.maximum(single.frame[open_, None] - back - np.arange(step), 0)
        there = Grid(frames.ravel(), np.repeat(single.row0[open_], step), np.repeat(single.col0[open_], step), (1, 1))
        anew = (stream.uniform(there)[:, 0, 0].reshape(frames.shape) < 1 / params.blinking_frames) | (frames == 0)
        hit = anew.any(axis=1)
        drawn[open_[hit]] = frames[hit, anew[hit].argmax(axis=1)]
        open_, back, step = open_[~hit], back + step, min(2 * step, LOOK_BACK[1])
    at = Grid(drawn, single.row0, single.col0, (1, 1))
    return (stream.uniform(at, draw=1)[:, 0, 0] < params.blinking_on).astype(np.float32)


def _heat(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    hot: Singles = value + np.float32(params.hot_median_e) * np.exp(np.float32(params.hot_sigma_log) * stream.normal_fixed(single)[:, 0, 0])
    return hot


def _cool(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.maximum(value - np.float32(params.cold_e), 0)


def _respond(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    weakened: Singles = value * np.maximum(1 + np.float32(params.gain_std_rel) * stream.normal_fixed(single)[:, 0, 0], 0)
    return weakened


def _flicker(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    flickering: Singles = np.maximum(value + np.float32(params.noisy_std_e) * stream.normal(single)[:, 0, 0], 0)
    return flickering


def _blink(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value + np.float32(params.blinking_e) * blinking_level(params, single, stream)


def _stick(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return np.full_like(value, params.stuck_e)


def _deaden(params: Defects, value: np.ndarray, single: Grid, stream: Stream) -> np.ndarray:
    return value * np.float32(params.dead_gain_rel)


CHANGES = {"hot": _heat, "cold": _cool, "gain": _respond, "noisy": _flicker, "blinking": _blink, "stuck": _stick, "dead": _deaden}


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
                f"too many pixels are {name}: the good pixels cannot be identified",
                where="sensor.defects",
                value=f"{100 * count / pixels:.3g} %",
                allowed=f"at most {100 * MOST:g} %",
                remedy="check whether light, exposure and temperature were the same in all frames of the stacks",
            )
        by_chance = float(np.sqrt(found.expected_false)) if count else 0.0
        rows.append((f"{name}_fraction", count / pixels, by_chance / pixels, np.inf, "1"))
        if not count:
            reasons[f"{name}_fraction"] = "none found among all pixels; smaller errors are part of the scatter of the good pixels"
    if not places["hot"].any() and gain is not None and np.isfinite(found.dark_limit_dn):
        limit = (found.dark_limit_dn + FOUND_95 * found.dark_sigma_dn) / gain.value
        rows.append(("hot_median_e", min(limit, 1e6), limit * gain.u / gain.value, np.inf, "e-"))
        limits.add("hot_median_e")
        reasons["hot_median_e"] = "none found; of 100 pixels with this excess, 95 would have been found"
    rows += _errors(observations, places, gain)
    return Estimates.from_rows(
        rows,
        method="number of pixels outside the Gaussian distribution of the others; moments of their errors",
        confounders=("a pixel stuck at the top of the scale counts as hot", "cosmic rays and blinking pixels"),
        limits=frozenset(limits),
        reasons=reasons,
    )


def _errors(observations: Observations, places: Mapping[str, np.ndarray], gain: Number | None) -> list[Row]:
    """How large the errors are of the kinds that were found; those in electrons only if the gain is known."""
    found = observations.defects
    rows: list[Row] = []
    if found is None:
        return rows
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
    Most targets have no defect at all and few have a large error, so u is a root mean square, not the width of a Gaussian (the kurtosis
    says how rare they are); it counts defects one by one, so the share must be small against one defect a window. Noisy and blinking
    pixels are counted with what is fixed; columns and clusters are changed as a whole. No pixel is brighter than the scale's end. What
    the user has listed is not in it: those pixels are known.
    """
    method = "mean square of the shifts by defects of single pixels, one at a time"
    if probe.locate is None:
        variance = sum(share * _mean_square_dn2(params, name, probe) for name, share in _shares(params))
        u = np.array(probe.white(np.sqrt(variance)))
        square = np.mean([_of_groups(params, probe, phase)[0] for phase in range(len(probe.signal_dn))], axis=0)
        u_x, u_y = np.sqrt(u**2 + square)
        return probe.contribution((float(u_x), float(u_y)), "F", model_error=0.05, method=method + ", first order")
    few = np.unique(np.linspace(0, len(probe.signal_dn) - 1, PHASES).round().astype(int))
    moments = np.zeros((2, 2))  # second and fourth; x and y
    near: Array | None = None  # pixels about the target that the estimator reads, as found in the first phase
    for phase in few:
        cases = [(s * w, c) for name, s in _shares(params) for w, c in _cases(params, name, probe.signal_dn[phase], probe.gain_dn_per_e)]
        singles, read = _of_singles(probe, phase, cases, None if near is None else _about(probe, phase, near, -1))
        if near is None and read.size <= MOST_TRIED:
            near = _about(probe, phase, binary_dilation(read, iterations=ROUND_PX), 1)
        moments += singles
        moments += _of_groups(params, probe, phase)
    second, fourth = moments / len(few)
    u_x, u_y = np.sqrt(second)
    # of a compound Poisson variable: the sum of the fourth powers is its fourth cumulant
    kurtosis = 3.0 + float(fourth.mean() / second.mean() ** 2) if second.any() else 3.0
    return probe.contribution((float(u_x), float(u_y)), "F", model_error=0.05, method=method, kurtosis=kurtosis)


def _shares(params: Defects) -> list[tuple[str, float]]:
    """The kinds of single pixels that there are, with their shares."""
    return [(name, share) for name, share in params.shares.items() if share > 0]


def _of_groups(params: Defects, probe: Probe, phase: int) -> np.ndarray:
    """Sum over columns and clusters of their share times the second and fourth power of the shift in x and y by each of them."""
    base, k = probe.signal_dn[phase], probe.gain_dn_per_e
    rows, cols = base.shape
    moments = np.zeros((2, 2))
    if params.column_fraction:
        groups = np.repeat(np.eye(cols, dtype=bool)[:, None, :], rows, axis=1)
        moments += params.column_fraction * _powers(probe, phase, groups, params.column_gain_rel * base + k * params.column_e)
    if params.cluster_fraction:
        reach = int(params.cluster_radius_px)
        every = [(r, c) for r in range(-reach, rows + reach) for c in range(-reach, cols + reach)]
        centres = [every[i] for i in _thinned(np.arange(len(every)))]
        groups = np.zeros((len(centres), rows + 4 * reach, cols + 4 * reach), bool)
        for dr, dc in disc(params.cluster_radius_px):
            groups[np.arange(len(centres)), [r + dr + 2 * reach for r, _ in centres], [c + dc + 2 * reach for _, c in centres]] = True
        inner = np.ascontiguousarray(groups[:, 2 * reach : 2 * reach + rows, 2 * reach : 2 * reach + cols])
        share = params.cluster_fraction * len(every) / len(centres)
        moments += share * _powers(probe, phase, inner, params.cluster_gain_rel * base)
    return moments


def _powers(probe: Probe, phase: int, groups: np.ndarray, changed_dn: np.ndarray) -> np.ndarray:
    """Sum over groups of pixels, masks (groups, rows, cols), of the second and fourth power of the shift when one has changed values."""
    base, changed_dn = probe.signal_dn[phase], np.minimum(changed_dn, probe.saturation_dn)
    shifts = np.array(probe.moved(np.where(groups, changed_dn, base), phase))
    powers: Array = np.nansum([shifts**2, shifts**4], axis=2)  # a target that is lost with the group has no position
    return powers


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
    if name == "blinking":
        return [(p.blinking_on, signal_dn + k * p.blinking_e)]
    if name == "stuck":
        return [(1.0, np.full_like(signal_dn, k * p.stuck_e))]
    return [(0.5, np.maximum(signal_dn + s * k * p.noisy_std_e, 0)) for s in (-1, 1)]


def _mean_square_dn2(params: Defects, name: str, probe: Probe) -> np.ndarray | float:
    if name == "hot":
        square_dn2: np.ndarray = (probe.gain_dn_per_e * params.hot_median_e) ** 2 * np.exp(2 * params.hot_sigma_log**2)
        return square_dn2
    others: np.ndarray = sum(w * (v - probe.signal_dn) ** 2 for w, v in _cases(params, name, probe.signal_dn, probe.gain_dn_per_e))
    return others


def _about(probe: Probe, phase: int, mask: Array, sign: int) -> Array:
    """A mask of pixels moved so that the target of a phase comes to pixel (0, 0) (sign 1), or from there to the target (sign −1)."""
    row, col = (int(np.rint(at[phase])) for at in (probe.y_px, probe.x_px))
    return np.roll(mask, (-sign * row, -sign * col), axis=(0, 1))


def _of_singles(probe: Probe, phase: int, cases: list[tuple[float, np.ndarray]], tried: Array | None = None) -> tuple[Array, Array]:
    """Sum over pixels and cases, each with its weight, of the second and fourth power of the shift when one pixel has its changed value.

    Pixels that the estimator hardly reads are found once, by their largest change in any case, and left out: a shift of 1 % of the
    largest is 1e-4 of its square. With ``tried`` only these pixels are. Also returns a mask of those that were not left out.
    """
    base = probe.signal_dn[phase].ravel()
    changed = [(weight, np.minimum(values.ravel(), probe.saturation_dn)) for weight, values in cases]

    def shifts(at: np.ndarray, values: np.ndarray) -> np.ndarray:
        windows = np.repeat(base[None, :], len(at), axis=0)
        windows[np.arange(len(at)), at] = values[at]
        return np.array(probe.moved(windows.reshape(-1, *probe.signal_dn.shape[1:]), phase))

    if not changed:
        return np.zeros((2, 2)), np.zeros(probe.signal_dn.shape[1:], bool)
    values = np.stack([v for _, v in changed])
    largest = values[np.abs(values - base).argmax(axis=0), np.arange(base.size)]
    every = np.flatnonzero((largest != base) & (True if tried is None else tried.ravel()))
    read = _thinned(every)
    share = len(read) / max(len(every), 1)
    if len(read) and len(changed) > 1:
        most = np.abs(shifts(read, largest)).max(axis=0)
        read = read[~(most <= SMALL * np.nanmax(most))]  # a lost target stays in
    moments = np.zeros((2, 2))
    for weight, one in changed:
        at = read[one[read] != base[read]]
        if len(at):
            moved = shifts(at, one)
            moments += weight * np.nansum([moved**2, moved**4], axis=2)  # a target that is lost with its only pixel has no position
    kept = np.zeros(base.shape, bool)
    kept[read] = True
    return moments / share if share else moments, kept.reshape(probe.signal_dn.shape[1:])


def _thinned(at: np.ndarray) -> np.ndarray:
    """At most `MOST_TRIED` of these indices, spread evenly over them without a period: of a large window, some pixels stand for all."""
    if len(at) <= MOST_TRIED:
        return at
    order = np.argsort((np.arange(len(at)) * 0.6180339887498949) % 1)
    return np.asarray(np.sort(at[order[:MOST_TRIED]]))


# what describes the single pixels that are drawn, and not those of a measured unit
DRAWN = tuple(name for name in Defects.model_fields if not name.startswith(("column", "cluster", "listed")))

SOURCE = Source(
    id="sensor.defects",
    title="Defect pixels",
    description="A few pixels, columns and clusters are hot, dead, cold, stuck, noisy or blinking, always at the same positions.",
    number=17,
    stars=2,
    parameters=Defects,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.quantum_efficiency",),
    before=("sensor.shot_noise",),
    neutral=Defects(),
    typical=Defects(hot_fraction=2e-4, dead_fraction=2e-5),
    bound=Defects(hot_fraction=1e-3, dead_fraction=1e-4, cold_fraction=1e-4, gain_fraction=5e-4, noisy_fraction=5e-4),
    maps={"pixels": DRAWN},
    forward=forward,
    truth=truth,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="hot: n + m e^(s z);  dead: g n;  cold: n − c;  response: (1 + r z) n;  noisy: n + s z;  one pixel of error v: Δ = v d/S",
    typical_size="0.03 px for one pixel that is 50 DN off at the edge of a disc of 7 px",
    references=("EMVA 1288 R4.0 Linear, §8.4 (defect pixels)",),
    leaves="detail of the scene at the replaced pixels",
    advice="List the defects and leave them out of the fit, or replace them by the median of their neighbours.",
)
