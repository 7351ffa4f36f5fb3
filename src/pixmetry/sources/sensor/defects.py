"""Defect pixels: hot ones with far too much dark charge, dead ones with hardly any response, and what else is found off the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Source, cut_map
from pixmetry.sources.sensor._defect_count import measure
from pixmetry.sources.sensor._defect_model import Defects, disc, forward, truth

PHASES = 6  # places within the pixel at which a defect is tried
NODES = 7  # of the Gauss–Hermite quadrature over the logarithm of the excess
NEIGHBOURS = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]

# what describes the single pixels that are drawn, and not those of a measured unit
DRAWN = tuple(name for name in Defects.model_fields if not name.startswith(("column", "cluster", "listed")))


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
    for phase in few:
        cases = [(s * w, c) for name, s in _shares(params) for w, c in _cases(params, name, probe.signal_dn[phase], probe.gain_dn_per_e)]
        moments += _of_singles(probe, phase, cases)
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
        centres = [(r, c) for r in range(-reach, rows + reach) for c in range(-reach, cols + reach)]
        groups = np.zeros((len(centres), rows + 4 * reach, cols + 4 * reach), bool)
        for dr, dc in disc(params.cluster_radius_px):
            groups[np.arange(len(centres)), [r + dr + 2 * reach for r, _ in centres], [c + dc + 2 * reach for _, c in centres]] = True
        inner = np.ascontiguousarray(groups[:, 2 * reach : 2 * reach + rows, 2 * reach : 2 * reach + cols])
        moments += params.cluster_fraction * _powers(probe, phase, inner, params.cluster_gain_rel * base)
    return moments


def _powers(probe: Probe, phase: int, groups: np.ndarray, changed_dn: np.ndarray) -> np.ndarray:
    """Sum over groups of pixels, masks (groups, rows, cols), of the second and fourth power of the shift when one has changed values."""
    base, changed_dn = probe.signal_dn[phase], np.minimum(changed_dn, probe.saturation_dn)
    shifts = np.array(probe.moved(np.where(groups, changed_dn, base), phase))
    return np.nansum([shifts**2, shifts**4], axis=2)  # a target that is lost with the group has no position


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
        return (probe.gain_dn_per_e * params.hot_median_e) ** 2 * np.exp(2 * params.hot_sigma_log**2)
    return sum(w * (v - probe.signal_dn) ** 2 for w, v in _cases(params, name, probe.signal_dn, probe.gain_dn_per_e))


def _of_singles(probe: Probe, phase: int, cases: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Sum over pixels and cases, each with its weight, of the second and fourth power of the shift when one pixel has its changed value.

    Pixels that the estimator does not read are found once, by their largest change in any case, which then does not move it at all.
    """
    base = probe.signal_dn[phase].ravel()
    changed = [(weight, np.minimum(values.ravel(), probe.saturation_dn)) for weight, values in cases]

    def shifts(at: np.ndarray, values: np.ndarray) -> np.ndarray:
        windows = np.repeat(base[None, :], len(at), axis=0)
        windows[np.arange(len(at)), at] = values[at]
        return np.array(probe.moved(windows.reshape(-1, *probe.signal_dn.shape[1:]), phase))

    if not changed:
        return np.zeros((2, 2))
    values = np.stack([v for _, v in changed])
    largest = values[np.abs(values - base).argmax(axis=0), np.arange(base.size)]
    read = np.flatnonzero(largest != base)
    read = read[(shifts(read, largest) != 0).any(axis=0)] if len(read) and len(changed) > 1 else read
    moments = np.zeros((2, 2))
    for weight, one in changed:
        at = read[one[read] != base[read]]
        if len(at):
            moved = shifts(at, one)
            moments += weight * np.nansum([moved**2, moved**4], axis=2)  # a target that is lost with its only pixel has no position
    return moments


SOURCE = Source(
    id="sensor.defects",
    title="Defect pixels",
    description="A few pixels, columns and clusters are hot, dead, cold, stuck, noisy or blinking, always in the same places.",
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
    advice="List the defects and leave them out of the fit; or replace them by the median of their neighbours.",
)
