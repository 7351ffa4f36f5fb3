"""Column noise: offset and gain of every column amplifier wander from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.noise_covariance import CHARGE, WHITE
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, cut_rows, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.random import Grid, Stream

LEAST_LEVELS, MOST_CLIPPED, NOT_SIGNIFICANT = 5, 0.002, 3.0
MOST_FULL = 0.9  # of the level at which pixels are full below the last code
METHOD = "temporal variance of the column means of flat fields, less that of white noise, against the square of the signal"
CONFOUNDERS = ("gain of the columns: light that changes its distribution over the frame from frame to frame",)


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


def measure(observations: Observations) -> Estimates:
    """Read how the temporal variance of the column means grows with the square of the light: that part is the gain's.

    The constant part is the offsets', which noise of the columns before the gain (``electronics.row_noise``) cannot be told from. A change
    of the light from frame to frame moves the columns too, in proportion to their own share of the light: that is taken off.
    """
    where, series, found = "electronics.column_noise", observations.series, observations.noise_filter
    remedy = "take pairs of dark frames and of flat fields at five levels or more"
    if found is not None and found.kind not in (WHITE, CHARGE):
        what = f"what correlates neighbouring pixels ({found.name}) changes the noise of the columns"
        raise MeasureError(what, where=where, remedy="switch off every filter in the camera, and take raw frames")
    dark, light = series.dark, series.bright
    open_ = light.fraction_max < MOST_CLIPPED if light.mean_dn.size else np.zeros(0, bool)
    if dark.mean_dn.size and np.isfinite(series.full_dn):  # the noise of charge that spills along the columns is theirs, too
        open_ &= light.mean_dn - dark.mean_dn.mean() < MOST_FULL * (series.full_dn - dark.mean_dn.mean())
    if dark.mean_dn.size == 0 or np.count_nonzero(open_) < LEAST_LEVELS:
        raise MeasureError("the growth of column noise with the light is not told", where=where, value=int(open_.sum()), remedy=remedy)
    rows, cols = series.frame_shape
    black, black_var = float(dark.mean_dn.mean()), float(dark.ms_pixel_dn2.mean())

    def of_levels(name: str) -> np.ndarray:
        return np.concatenate([getattr(dark, name), getattr(light, name)[open_]])

    white, columns = of_levels("ms_pixel_dn2"), of_levels("ms_col_dn2")
    if not (white > 0).all():
        raise MeasureError("frames without noise do not tell the noise of the columns", where=where, remedy=remedy)
    dof = (of_levels("n_frames") - 1) * (cols - 1)
    signal = np.concatenate([np.zeros(dark.mean_dn.size), light.mean_dn[open_] - black])
    if found is not None and found.kind == CHARGE:  # half of what was repelled stays in the column, and so in its mean
        shot = np.maximum(white - black_var, 0)
        white = white + np.where(signal > 0, 0.5 * (found.variance_before(shot) - shot), 0.0)
    lamp = np.where(signal > 0, of_levels("ms_frame_dn2") * _column_spread(observations) ** 2, 0.0)
    excess = columns - white / rows - lamp
    design = np.stack([np.ones(signal.size), (signal / signal.max()) ** 2], axis=1)
    expected = np.maximum(columns, 1e-3 * white / rows)
    for _ in range(4):
        weight = dof / (2 * expected**2)
        covariance = np.linalg.inv(design.T @ (weight[:, None] * design))
        fitted = covariance @ (design.T @ (weight * excess))
        expected = white / rows + lamp + np.maximum(design @ fitted, 0)
    square, u = float(fitted[1]) / signal.max() ** 2, float(np.sqrt(covariance[1, 1])) / signal.max() ** 2
    limits, reasons = set(), {"gain_rel": "as new in every frame; what changes more slowly needs stacks taken hours apart"}
    if square > NOT_SIGNIFICANT * u:
        gain, u_gain = math.sqrt(square), u / (2 * math.sqrt(square))
    else:
        gain = math.sqrt(max(square, 0.0) + ONE_SIDED_95 * u)
        u_gain, limits = u / (2 * gain), {"gain_rel"}
        reasons["gain_rel"] = "the noise of the columns does not grow with the light; 95 % upper limit"
    row = ("gain_rel", gain, u_gain, math.inf, "1")
    return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS, limits=frozenset(limits), reasons=reasons)


def _column_spread(observations: Observations) -> float:
    """Relative standard deviation of the light of the columns; 0 where there are no stacks to see it by."""
    if observations.dark_stack is None or observations.bright_stack is None:
        return 0.0
    light = (observations.bright_stack.mean_map_dn - observations.dark_stack.mean_map_dn).mean(axis=0)
    return float(light.std() / light.mean()) if light.mean() > 0 else 0.0


def correct(params: ColumnNoise, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Subtract the offset of each column that the covered rows above and below it tell, as far as it is not their own noise.

    ``maps["column_offset_dn"]`` has shape (n, columns of the frame): the offsets of these frames.
    """
    return signal.with_data(signal.data - cut_rows(maps, "column_offset_dn", signal, along="cols")[:, None, :])


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
    measure=measure,
    correct=correct,
    propagate=propagate,
    truth=truth,
    gum_class="Tr",
    equation="y' = y (1 + σ_g g_c(t)) + σ_o o_c(t)",
    typical_size="0.0155 px per DN in x on a disc of 7 px in a window of radius 6 px",
    references=("EMVA 1288 R4.0 Linear, §8.2 (row and column split)",),
    advice="Subtract each column's mean over optically black rows of the same frame; renew dark frames often.",
    leaves="the gains of the columns, and the noise of the covered pixels' mean, as far as the weight of the offsets lets it through",
)
