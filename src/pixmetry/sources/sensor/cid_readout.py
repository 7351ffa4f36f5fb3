"""Read-out of a charge injection device: non-destructive reads, cross-talk of row and column electrodes, charge left by clearing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError, ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

ITERATIONS = 6
NEAR_PX = 16  # about a window: the light of its target


class CidReadout(Parameters):
    """How often each pixel is read, and what electrodes and clearing add."""

    reads: int = quantity(1, "1", "number N of non-destructive reads that are averaged", ge=1, le=100_000)
    read_std_e: float = quantity(0.0, "e-", "noise of one read, independent from read to read", ge=0, le=1e5)
    floor_std_e: float = quantity(0.0, "e-", "slow (1/f) noise that all reads of a pixel share", ge=0, le=1e5)
    row_crosstalk: float = quantity(0.0, "1", "share of the row's mean that is added to a pixel", ge=0, le=0.2)
    col_crosstalk: float = quantity(0.0, "1", "share of the column's mean that is added to a pixel", ge=0, le=0.2)
    residual: float = quantity(0.0, "1", "share of the charge that remains after clearing and appears in the next frame", ge=0, le=0.5)


def noise_e(params: CidReadout) -> float:
    """Noise of the mean of N reads: σ/√N down to the floor."""
    return float(np.hypot(params.read_std_e / np.sqrt(params.reads), params.floor_std_e))


def start(params: CidReadout) -> np.ndarray | None:
    """Nothing is left before frame 0; no memory where the clearing is complete."""
    return np.zeros((1, 1), np.float32) if params.residual else None


def crosstalk(params: CidReadout, data: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Add the share of each pixel's row and column mean, in the dtype of the data; of a part of a frame, what its own light gives."""
    out, (rows, cols) = data, frame_shape
    for share, axis, size in ((params.row_crosstalk, 2, cols), (params.col_crosstalk, 1, rows)):
        if share:
            out = out + (share * (data.sum(axis=axis, keepdims=True, dtype=np.float64) / size)).astype(data.dtype)
    return out


def forward(params: CidReadout, signal: Signal, stream: Stream, state: np.ndarray | None) -> tuple[Signal, np.ndarray | None]:
    """Join what the frame before left, the cross-talk and the noise of the reads.

    Frames that follow each other come as whole frames or as one window each time; many windows at once belong to no sequence and see the
    state of the whole frame that they are given.
    """
    data = signal.data
    if state is not None and params.residual:
        data, state = _with_residual(params, signal, state, stream)
    data = crosstalk(params, data, signal.frame_shape)
    if noise_e(params):
        data = stream.add_normal(data, signal.grid, noise_e(params))
    return signal.with_data(data), state


def _with_residual(params: CidReadout, signal: Signal, state: np.ndarray, stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Add what clearing left of the frame before; each electron is left for itself."""
    share, first = np.float64(params.residual), signal.grid
    if len(signal) > 1 and signal.data.shape[1:] != tuple(signal.frame_shape):
        held = state if state.size == 1 else state[signal.rows[:, :, None], signal.cols[:, None, :]]
        return signal.data + stream.poisson(np.maximum(held, 0), first), state
    if state.size > 1 and state.shape != signal.data.shape[1:]:
        state = state[signal.rows[0][:, None], signal.cols[0][None, :]]
    data = np.empty_like(signal.data)
    for i, frame in enumerate(signal.data):
        grid = Grid(first.frame[i : i + 1], first.row0[i : i + 1], first.col0[i : i + 1], first.shape)
        np.add(frame, state, out=data[i])
        state = stream.binomial(data[i : i + 1], share, grid)[0]
    return data, state


def context(params: CidReadout, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole frame where rows and columns talk across."""
    return windows.full_frame(frame_shape) if params.row_crosstalk or params.col_crosstalk else windows


def near(params: CidReadout) -> tuple[int, int, int, int]:
    """Pixels about a window whose own light is followed; what the rest of the rows and columns adds is even."""
    reach = NEAR_PX if params.row_crosstalk or params.col_crosstalk else 0
    return reach, reach, reach, reach


def tail(params: CidReadout) -> float:
    """Share of a pixel's signal that goes to its row and its column together."""
    return params.row_crosstalk + params.col_crosstalk


def correct(params: CidReadout, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Take the cross-talk of whole frames off, by fixed-point steps x ← y − (F(x) − x).

    Raises
    ------
    ParameterError
        If the signal holds parts of frames.
    """
    if signal.data.shape[1:] != tuple(signal.frame_shape):
        raise ParameterError("cross-talk from whole rows needs whole frames", value=signal.data.shape[1:], allowed=str(signal.frame_shape))
    y = signal.data.astype(np.float64)
    x = y
    for _ in range(ITERATIONS):
        x = y - (crosstalk(params, x, signal.frame_shape) - x)
    return signal.with_data(x.astype(np.float32))


def propagate(params: CidReadout, probe: Probe) -> Contribution:
    """Propagator P1 for the noise of the reads; the cross-talk of the target with its own rows and columns by the estimator itself.

    What the rest of the rows and columns adds is even over the target. What the clearing leaves of a target at rest scales it.
    """
    u = np.array(probe.white(probe.gain_dn_per_e * noise_e(params)))
    above, (rows, cols) = probe.signal_dn - probe.background_dn, probe.frame_shape
    added = params.row_crosstalk * above.sum(axis=2, keepdims=True) / cols + params.col_crosstalk * above.sum(axis=1, keepdims=True) / rows
    shifts = np.array(probe.moved(probe.signal_dn + added))
    bias, fixed = shifts.mean(axis=1), shifts.std(axis=1)
    return Contribution(
        u_x_px=float(np.hypot(u[0], fixed[0])),
        u_y_px=float(np.hypot(u[1], fixed[1])),
        bias_x_px=float(bias[0]),
        bias_y_px=float(bias[1]),
        gum_class="T" if u.sum() >= fixed.sum() else "F",
        model_error=0.15,
        method="linear response of the estimator to white noise; the estimator on the target with its own cross-talk",
    )


def measure(observations: Observations) -> Estimates:
    """Cross-talk from bright spots, what clearing leaves from a light that goes off; only of a camera that is stated as CID."""
    if observations.sensor != "cid":
        what = "the camera is not stated to be a charge injection device"
        raise MeasureError(what, where="sensor.cid_readout", remedy="if it is one, write sensor: cid under camera")
    where, steps, spots = "sensor.cid_readout", observations.light_off, observations.spots
    parts, problems = [], []
    talk = {name: name for name in ("row_crosstalk", "col_crosstalk")}
    for seen, names, pictures, kind in (
        (spots, talk, "bright spots on black", "spots"),
        (steps, {"residual": "left_rel"}, "a light that goes off", "light_off"),
    ):
        try:
            parts.append(of_pictures(None if seen is None else seen.fit, names, where=where, pictures=pictures, kind=kind))
        except MeasureError as problem:
            problems.append(problem)
    if not parts:
        raise problems[0]
    return Estimates.empty().join(*parts)


SOURCE = Source(
    id="sensor.cid_readout",
    title="Read-out of a charge injection device",
    description="Pixels can be read several times without loss of charge. The long electrodes are noisy and cause cross-talk, and "
    "clearing leaves some charge.",
    note="Section 3.2",
    parameters=CidReadout,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise", "sensor.full_well"),
    before=("electronics",),
    neutral=CidReadout(),
    typical=CidReadout(reads=16, read_std_e=200.0, floor_std_e=20.0, row_crosstalk=5e-3, col_crosstalk=5e-3),
    bound=CidReadout(reads=16, read_std_e=600.0, floor_std_e=50.0, row_crosstalk=0.02, col_crosstalk=0.02, residual=0.01),
    forward=forward,
    start=start,
    context=context,
    near=near,
    tail=tail,
    measure=measure,
    correct=correct,
    propagate=propagate,
    option="a charge injection device",
    gum_class="T",
    equation="σ² = σ_read²/N + σ_floor²;  y = q + κ_r ⟨q⟩_row + κ_c ⟨q⟩_col;  q(t) joined by r q(t−1)",
    typical_size="0.003 px for 16 reads of 200 e- on a disc of 7 px at 15 000 electrons",
    references=("J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, ch. 6 (averaging of samples)",),
    leaves="the noise of the reset and of the lines",
    advice="Increase the number of reads until the noise falls no further. Clear twice after a bright frame.",
)
