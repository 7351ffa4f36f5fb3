"""Random telegraph noise: single traps in the first transistor of a pixel, which switch its signal between two or three levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.random import Grid, Stream


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
        "measure": "not measured: needs the kurtosis in time of each pixel of a dark stack of a hundred frames or more",
        "correct": "the state of the trap in a single frame is unknown; mask the pixel",
    },
)
