"""Column noise: offset and gain of every column amplifier wander from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.random import Grid, Stream


class ColumnNoise(Parameters):
    """Standard deviations of what a column's amplifier and converter add, and how slowly they change.

    What never changes is ``sensor.dsnu`` and ``sensor.prnu``; what is new in every frame before the gain is ``electronics.row_noise``.
    """

    offset_dn: float = quantity(0.0, "DN", "offset common to a column", ge=0, le=1e4)
    gain_rel: float = quantity(0.0, "1", "relative gain common to a column", ge=0, le=0.3)
    wander_frames: int = quantity(
        1, "1", "number of frames from one independent state to the next; 1: new in every frame", ge=1, le=1_000_000
    )


def wander(params: ColumnNoise, grid: Grid, stream: Stream, draw: int) -> np.ndarray:
    """Return one standard normal number a column, shape (n, cols), that turns into an independent one over ``wander_frames`` frames.

    Between the states z_k and z_(k+1) it is cos(πs/2) z_k + sin(πs/2) z_(k+1): of variance 1 at any moment s.
    """
    node = grid.frame // params.wander_frames
    angle = 0.5 * np.pi * ((grid.frame % params.wander_frames) / params.wander_frames)
    now = Grid(node, grid.row0, grid.col0, grid.shape)
    if params.wander_frames == 1:
        return stream.normal_cols(now, draw)
    then = Grid(node + 1, grid.row0, grid.col0, grid.shape)
    near, far = (f(angle).astype(np.float32)[:, None] for f in (np.cos, np.sin))
    return near * stream.normal_cols(now, draw) + far * stream.normal_cols(then, draw)


def forward(params: ColumnNoise, signal: Signal, stream: Stream) -> Signal:
    """Multiply by each column's gain and add its offset."""
    if params.offset_dn == 0 and params.gain_rel == 0:
        return signal
    offset, gain = columns(params, signal.grid, stream)
    return signal.with_data(signal.data * gain[:, None, :] + offset[:, None, :])


def columns(params: ColumnNoise, grid: Grid, stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Offset in DN and gain of every column, float32, shape (n, cols)."""
    zero = np.zeros((len(grid.frame), grid.shape[1]), np.float32)
    offset = np.float32(params.offset_dn) * wander(params, grid, stream, 0) if params.offset_dn else zero
    gain = np.float32(params.gain_rel) * wander(params, grid, stream, 1) if params.gain_rel else zero
    return offset, 1 + gain


def truth(params: ColumnNoise, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Offset and gain of the columns, shape (n, cols)."""
    offset, gain = columns(params, signal.grid, stream)
    return {"column_offset_dn": offset, "column_gain": gain}


def propagate(params: ColumnNoise, probe: Probe) -> Contribution:
    """Propagator P1 with the errors of each column in common: a constant one, and one that grows with the signal.

    A state that outlasts the series does not average: then it is fixed for all its frames.
    """
    parts = probe.columns(params.offset_dn), probe.columns(params.gain_rel * probe.signal_dn)
    u = math.hypot(parts[0][0], parts[1][0]), math.hypot(parts[0][1], parts[1][1])
    gum_class = "Tr" if params.wander_frames == 1 else "F"
    return probe.contribution(u, gum_class, model_error=0.12, method="linear response of the estimator to offsets and gains of columns")


SOURCE = Source(
    id="electronics.column_noise",
    title="Column noise",
    description="The amplifiers and converters of the columns drift. An old dark frame then leaves vertical stripes.",
    parameters=ColumnNoise,
    consumes=(Kind.DN,),
    after=("sensor", "electronics.gain"),
    before=("cable", "grabber", "processing", "storage", "electronics.gamma"),
    applies_to=("cmos",),
    neutral=ColumnNoise(),
    typical=ColumnNoise(offset_dn=0.1, gain_rel=0.0005, wander_frames=100),
    bound=ColumnNoise(offset_dn=0.5, gain_rel=0.002),
    forward=forward,
    propagate=propagate,
    truth=truth,
    gum_class="Tr",
    equation="y' = y (1 + σ_g g_c(t)) + σ_o o_c(t)",
    typical_size="0.0155 px per DN in x on a disc of 7 px in a window of radius 6 px",
    references=("EMVA 1288 R4.0 Linear, §8.2 (row and column split)",),
    advice="Subtract each column's mean over optically black rows of the same frame; renew dark frames often.",
    reasons={
        "measure": "electronics.row_noise measures the part that is new in every frame; the slow part needs dark stacks taken hours apart",
        "correct": "needs optically black rows above the image, which give each column's offset",
    },
)
