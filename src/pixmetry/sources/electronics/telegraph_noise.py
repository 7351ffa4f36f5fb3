"""Random telegraph noise: single traps in the first transistor of a pixel, which switch its signal between two or three levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.random import Grid, Stream

LEAST_FRAMES, LEAST_DN2, CLASSES = 48, 0.3, 240
FOUND = 14.0  # of the logarithm of the likelihood: false in 1e-6 of cameras for two parameters
TYPICAL_E = 30.0
METHOD = "variances in time of the pixels of a dark stack: a mixture of normal noise and exponential steps, by maximum likelihood"
CONFOUNDERS = ("blinking pixels: pixels that are noisy for another reason, such as a defect transistor or a source follower of 1/f noise",)


class TelegraphNoise(Parameters):
    """Which pixels have a trap, how much it moves their signal, and how often it switches."""

    share: float = quantity(0.0, "1", "share of the pixels that blink", ge=0, le=0.5)
    amplitude_e: float = quantity(10.0, "e-", "mean over these pixels of the step between neighbouring levels; exponential", ge=0, le=1e5)
    occupancy: float = quantity(0.5, "1", "share of the time in which a trap is filled", gt=0, lt=1)
    memory_frames: float = quantity(0.0, "1", "frames after which a state's correlation is 1/e; 0: new in every frame", ge=0, le=1000)
    levels: Literal["two", "three", "cds"] = quantity(
        "two", "1", "one trap; two traps alike; or the difference of two samples in a frame, correlated double sampling: −a, 0, a"
    )
    cds_correlation: float = quantity(0.5, "1", "correlation of the state between these two samples", ge=0, lt=1)


def affected(params: TelegraphNoise, grid: Grid, stream: Stream) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Window, row and column (in the window) of the pixels that have a trap."""
    i, r, c = np.nonzero(stream.uniform_fixed(grid) < np.float32(params.share))
    return i, r, c


def steps_e(params: TelegraphNoise, single: Grid, stream: Stream) -> np.ndarray:
    """Step of each pixel of a grid of single pixels, e-, exponential, fixed in the unit."""
    steps: Array = -params.amplitude_e * np.log(stream.uniform_fixed(single, 1)[:, 0, 0].astype(float))
    return steps


def filled(params: TelegraphNoise, single: Grid, stream: Stream, trap: int) -> np.ndarray:
    """Whether the trap of each pixel of a grid of single pixels is filled, bool.

    In every frame it is drawn anew with probability 1 − exp(−1/memory), otherwise it stays: a Markov chain of two states. The state is
    that of the last new draw, which is looked for backwards, so a frame needs no other frame's result; at frame 0 it is drawn.
    """
    frame = single.frame.copy()
    keep = math.exp(-1 / params.memory_frames) if params.memory_frames else 0.0
    open_ = np.flatnonzero(frame > 0) if keep else np.zeros(0, np.int64)
    while open_.size:
        at = Grid(frame[open_], single.row0[open_], single.col0[open_], (1, 1))
        open_ = open_[stream.uniform(at, 10 + trap)[:, 0, 0] < np.float32(keep)]
        frame[open_] -= 1
        open_ = open_[frame[open_] > 0]
    return stream.uniform(Grid(frame, single.row0, single.col0, (1, 1)), 20 + trap)[:, 0, 0] < np.float32(params.occupancy)


def level(params: TelegraphNoise, single: Grid, stream: Stream) -> np.ndarray:
    """Level of each pixel in steps, of mean 0."""
    now = filled(params, single, stream, 0).astype(float)
    if params.levels == "two":
        return now - params.occupancy
    if params.levels == "three":
        both: Array = now + filled(params, single, stream, 1) - 2 * params.occupancy
        return both
    stays = stream.uniform(single, 30)[:, 0, 0] < np.float32(params.cds_correlation)
    again = stream.uniform(single, 31)[:, 0, 0] < np.float32(params.occupancy)
    difference: Array = np.where(stays, now, again) - now
    return difference


def level_variance(params: TelegraphNoise) -> float:
    """Variance of the level in steps²: p (1 − p) for one trap, twice that for two, 2 (1 − ρ) p (1 − p) for a difference."""
    one = params.occupancy * (1 - params.occupancy)
    return {"two": one, "three": 2 * one, "cds": 2 * (1 - params.cds_correlation) * one}[params.levels]


def forward(params: TelegraphNoise, signal: Signal, stream: Stream) -> Signal:
    """Add each trap's level; their mean is 0, for a constant part is the dark signal's non-uniformity."""
    if params.share == 0 or params.amplitude_e == 0 or stream.quiet:
        return signal
    data = np.array(signal.data, np.float32)
    i, r, c = affected(params, signal.grid, stream)
    if i.size:
        single = Grid(signal.grid.frame[i], signal.rows[i, r], signal.cols[i, c], (1, 1))
        data[i, r, c] += (steps_e(params, single, stream) * level(params, single, stream)).astype(np.float32)
    return signal.with_data(data)


def truth(params: TelegraphNoise, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Step in e- of every pixel of the frame, 0 where there is no trap."""
    steps = np.zeros(signal.frame_shape, np.float32)
    grid = Grid.whole([0], signal.frame_shape)
    _, r, c = affected(params, grid, stream)
    if r.size:
        steps[r, c] = steps_e(params, Grid(np.zeros_like(r), r, c, (1, 1)), stream)
    return {"telegraph_step_e": steps, "telegraph_pixels": steps > 0}


def measure(observations: Observations) -> Estimates:
    """Fit the variances in time of the pixels of a dark stack: most scatter as those of normal noise, those of blinking pixels lie higher.

    The variance of a pixel with a step a is that of the others and a² p (1 − p); a is exponential. The share of the time p is not told
    apart from the size of the steps, and the memory not at all: the step stands for p = ½. Pixels of a high dark value are left out, whose
    dark current has a shot noise of its own.
    """
    where, stack, fit = "electronics.telegraph_noise", observations.dark_stack, observations.photon_transfer_fit
    if stack is None or stack.n_frames < LEAST_FRAMES:
        frames = 0 if stack is None else stack.n_frames
        what = "the variances of single pixels are not known well enough"
        remedy = "take 200 dark frames, one after the other"
        raise MeasureError(what, where=where, value=f"{frames} dark frames", allowed=f"{LEAST_FRAMES} or more", remedy=remedy)
    if fit is None or "gain_dn_per_e" not in fit:
        raise MeasureError("needs the gain", where=where, remedy="take pairs of flat fields at several levels")
    gain, mean = fit["gain_dn_per_e"], stack.mean_map_dn
    middle = float(np.median(mean))
    spread = 1.4826 * float(np.median(np.abs(mean - middle)))
    scatter = np.sqrt(spread**2 + stack.var_map_dn2 / stack.n_frames)  # the mean of a blinking pixel is not known well either
    variances = stack.var_map_dn2[mean < middle + 4 * scatter].astype(float)
    noise = math.sqrt(float(np.median(variances)))
    cap = max(middle - 2 * noise, 0.0) ** 2  # larger steps would end below code 0
    if cap < 4 * noise**2:
        raise MeasureError("blinking pixels are cut off at code 0", where=where, value=f"{middle:.3g} DN", remedy="raise the black level")
    if np.median(variances) < LEAST_DN2:
        raise MeasureError("rounding hides the noise of single pixels", where=where, remedy="set a higher analogue gain")
    found = _mixture(variances, stack.n_frames - 1, cap)
    if found is None:
        at = TYPICAL_E * gain.value
        share, u = _share_of(variances, stack.n_frames - 1, at**2 / 4)
        limit = max(share, 0.0) + ONE_SIDED_95 * u
        why = {"share": f"no pixels stand out by their noise; 95 % upper limit for steps of {TYPICAL_E:g} e-"}
        row = ("share", min(limit, 0.5), u, math.inf, "1")
        return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS, limits=frozenset({"share"}), reasons=why)
    (share, square), covariance = found
    step = 2 * math.sqrt(square) / gain.value
    slopes = np.diag([1.0, step / (2 * square)])
    covariance = slopes @ covariance @ slopes
    covariance[1, 1] += (step * gain.u / gain.value) ** 2
    reasons = {"amplitude_e": "as if the traps were filled half of the time: frames tell the step times √(p (1 − p))"}
    names, units = ("share", "amplitude_e"), ("1", "e-")
    return Estimates(names, np.array([share, step]), covariance, np.full(2, np.inf), units, METHOD, CONFOUNDERS, reasons=reasons)


def _densities(variances: np.ndarray, dof: int, base: float, square: float, law: str = "pdf") -> tuple[np.ndarray, np.ndarray]:
    """Densities (chances of more, with the law ``"sf"``) of sample variances of quiet pixels, and of those with exponential steps."""
    from scipy.stats import gamma

    def of(true: np.ndarray) -> np.ndarray:
        density: np.ndarray = getattr(gamma, law)(variances[..., None], dof / 2, scale=2 * true / dof)
        return density

    # ∫ e^(−x) f(x²) dx over the steps in units of their mean; in steps of the logarithm, for f is narrow
    x = np.geomspace(1e-3, 30, 241)
    weights = np.exp(-x) * x * np.log(x[1] / x[0])
    weights /= weights.sum()
    return of(np.array([base]))[..., 0], of(base + square * x**2) @ weights


def _binned(variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and number of the variances in narrow classes of equal ratio."""
    positive = variances[variances > 0]
    edges = np.geomspace(positive.min() * 0.999, positive.max() * 1.001, CLASSES + 1)
    counts = np.histogram(positive, edges)[0].astype(float)
    return np.sqrt(edges[1:] * edges[:-1])[counts > 0], counts[counts > 0]


def _mixture(variances: np.ndarray, dof: int, cap: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Share and mean a² p (1 − p) in DN² by maximum likelihood, with their covariance; None if none is found.

    Variances above the cap are only counted.
    """
    from scipy.optimize import minimize

    middles, counts = _binned(variances[variances < cap])
    beyond = int(np.count_nonzero(variances >= cap))
    base = float(np.median(variances)) / (1 - 2 / (9 * dof)) ** 3

    def cost(p: np.ndarray) -> float:
        share = 0.5 / (1 + math.exp(-float(np.clip(p[0], -40, 40))))
        sizes = base * math.exp(float(p[1])), base * math.exp(float(np.clip(p[2], -20, 20)))
        quiet, blinking = _densities(middles, dof, *sizes)
        told = float(counts @ np.log(np.maximum((1 - share) * quiet + share * blinking, 1e-300)))
        quiet, blinking = _densities(np.array([cap]), dof, *sizes, law="sf")
        return -told - beyond * math.log(max(float((1 - share) * quiet[0] + share * blinking[0]), 1e-300))

    options = {"xatol": 1e-4, "fatol": 1e-3, "maxiter": 600}
    starts = ((-4.0, 0.0, 0.0), (-3.0, 0.0, 2.0), (-5.0, 0.0, 4.0))
    found = min((minimize(cost, x0, method="Nelder-Mead", options=options) for x0 in starts), key=lambda f: float(f.fun))
    alone = minimize(lambda p: cost(np.array([-40.0, p[0], 0.0])), [0.0], method="Nelder-Mead")
    if alone.fun - found.fun < FOUND:
        return None
    h = np.diag([0.05, 1e-3, 0.05])
    hessian = np.array(
        [
            [
                (cost(found.x + a + b) - cost(found.x + a - b) - cost(found.x - a + b) + cost(found.x - a - b)) / (4 * a.sum() * b.sum())
                for b in h
            ]
            for a in h
        ]
    )
    covariance = np.linalg.inv(hessian)[np.ix_([0, 2], [0, 2])]
    share = 0.5 / (1 + math.exp(-found.x[0]))
    square = base * math.exp(found.x[2])
    slopes = np.diag([share * (1 - 2 * share), square])
    if not (np.diag(covariance) > 0).all() or covariance[0, 0] ** 0.5 * (1 - 2 * share) > 1 / 3:
        return None
    return np.array([share, square]), slopes @ covariance @ slopes


def _share_of(variances: np.ndarray, dof: int, square: float) -> tuple[float, float]:
    """Share of pixels whose steps have this mean a² p (1 − p), with u: one step of maximum likelihood from zero."""
    middles, counts = _binned(variances)
    base = float(np.median(variances)) / (1 - 2 / (9 * dof)) ** 3
    quiet, blinking = _densities(middles, dof, base, square)
    score = np.minimum(blinking / np.maximum(quiet, 1e-300), 1e6) - 1
    power = float(counts @ score**2)
    return float(counts @ score) / power, power**-0.5


def propagate(params: TelegraphNoise, probe: Probe) -> Contribution:
    """Propagator P1 with the mean variance of a pixel, share · 2 amplitude² · variance of the level; few pixels bear it all."""
    sigma_e = params.amplitude_e * math.sqrt(2 * params.share * level_variance(params))
    method = "linear response of the estimator to the mean variance of all pixels; a target without such a pixel has no such error"
    return probe.contribution(probe.white(probe.gain_dn_per_e * sigma_e), "T", model_error=0.12, method=method)


SOURCE = Source(
    id="electronics.telegraph_noise",
    title="Random telegraph noise",
    description="A single trap in the first transistor of a pixel catches and releases one electron: the pixel blinks between a few "
    "levels.",
    parameters=TelegraphNoise,
    consumes=(Kind.ELECTRONS,),
    after=("sensor",),
    applies_to=("cmos",),
    neutral=TelegraphNoise(),
    typical=TelegraphNoise(share=0.01, amplitude_e=30.0, memory_frames=2.0),
    bound=TelegraphNoise(share=0.05, amplitude_e=60.0, levels="cds"),
    forward=forward,
    measure=measure,
    propagate=propagate,
    truth=truth,
    gum_class="T",
    equation="n' = n + a (s − p),  s = 0 or 1,  corr s(t), s(t + k) = e^(−k/τ);  with double sampling n' = n + a (s2 − s1)",
    typical_size="v d/S: 0.00005 px for a step of 10 e- 3 px from the centre of a disc of 7 px at 15 000 electrons",
    references=(
        "M. J. Kirton, M. J. Uren, Advances in Physics 38(4), 1989 (one trap: two states, exponential dwell times)",
        "C. Leyris et al., ESSCIRC 2006 (telegraph noise of CMOS pixels: three levels after correlated double sampling)",
    ),
    advice="Mask the pixels whose temporal histogram has two or three peaks, or weight them by their own variance.",
    reasons={
        "correct": "a value that blinks up and light that is brighter look the same in a single frame. Mask the pixel; in a sequence of "
        "a scene at rest the median over the frames is free of it",
    },
)
