"""Image lag: charge that the transfer to the sense node leaves behind comes with the next frame."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Singles
from pixmetry.core.random import Grid, Stream


class ImageLag(Parameters):
    """What stays in the photodiode."""

    lag_rel: float = quantity(0.0, "1", "share of the charge that stays behind", ge=0, le=0.9)
    pocket_e: float = quantity(0.0, "e-", "largest charge that a potential pocket holds back in addition", ge=0, le=1e6)
    pocket_fill_e: float = quantity(100.0, "e-", "signal charge at which the pocket is 63 % full", gt=0, le=1e6)


def left_behind(params: ImageLag, charge: np.ndarray) -> np.ndarray:
    """Mean charge that stays, in electrons: the charge of the pocket, at most all charge, and a share of the rest."""
    above = np.maximum(charge, 0)
    pocket = np.minimum(-params.pocket_e * np.expm1(-above / params.pocket_fill_e), above)
    left: Singles = (pocket + params.lag_rel * (charge - pocket)).astype(np.float32)
    return left


def start(params: ImageLag) -> np.ndarray | None:
    """Nothing is held before frame 0; no memory where nothing stays behind."""
    return np.zeros((1, 1), np.float32) if params.lag_rel or params.pocket_e else None


def _stays(params: ImageLag, charge: np.ndarray, grid: Grid, stream: Stream) -> np.ndarray:
    """Charge that stays behind, drawn: of the share every electron for itself (binomial), of the pocket its mean: it holds what it can."""
    if not params.lag_rel:
        return left_behind(params, charge)
    pocket = left_behind(params.model_copy(update={"lag_rel": 0.0}), charge)
    return pocket + stream.binomial(charge - pocket, np.float64(params.lag_rel), grid)


def forward(params: ImageLag, signal: Signal, stream: Stream, state: np.ndarray | None) -> tuple[Signal, np.ndarray | None]:
    """Add what the frame before left, and keep what this one leaves.

    Each electron stays for itself, so a steady flat field keeps Poisson's law, and its frames stay independent (see
    `sensor.charge_transfer`). Frames that follow each other come as whole frames or as one window each time; many windows at once belong to
    no sequence: what was left before is drawn about the state of the whole frame that they are given.
    """
    if state is None or not (params.lag_rel or params.pocket_e):
        return signal, state
    if len(signal) > 1 and signal.data.shape[1:] != tuple(signal.frame_shape):
        held = state if state.size == 1 else state[signal.rows[:, :, None], signal.cols[:, None, :]]
        charge = signal.data + (stream.poisson(np.maximum(held, 0), signal.grid) if params.lag_rel else held)
        return signal.with_data(charge - _stays(params, charge, signal.grid, stream)), state
    if len(signal) == 1 and state.size > 1 and state.shape != signal.data.shape[1:]:
        state = state[signal.rows[0][:, None], signal.cols[0][None, :]]
    out = np.empty_like(signal.data)
    for i, frame in enumerate(signal.data):
        grid = Grid(signal.grid.frame[i : i + 1], signal.grid.row0[i : i + 1], signal.grid.col0[i : i + 1], signal.grid.shape)
        charge = frame + state
        state = _stays(params, charge[None], grid, stream)[0]
        np.subtract(charge, state, out=out[i])
    return signal.with_data(out), state


SOURCE = Source(
    id="sensor.image_lag",
    title="Image lag",
    description="Part of the charge stays in the photodiode and appears in the next frame. A moving target has a ghost behind it.",
    note="Note 16",
    parameters=ImageLag,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise", "sensor.full_well", "sensor.blooming"),
    before=("sensor.charge_transfer", "sensor.read_out", "electronics"),
    neutral=ImageLag(),
    typical=ImageLag(lag_rel=0.01),
    bound=ImageLag(lag_rel=0.05, pocket_e=20.0),
    forward=forward,
    start=start,
    gum_class="O",
    equation="q_out(t) = q(t) + h(t−1) − h(t);  h(t) ~ Binomial(q(t) + h(t−1) − pocket, λ) + pocket,  pocket = p (1 − e^(−q/p0))",
    typical_size="a target that moves v px a frame is λ v/(1 − λ) behind while its ghost lies in the window: 0.01 px at 1 % and 1 px",
    references=("E. R. Fossum, D. B. Hondongwa, IEEE J. Electron Devices Soc. 2(3), 33, 2014 (pinned photodiodes, lag)",),
    advice="Read a dark frame between exposures, or keep the motion per frame small against the size of the target.",
    reasons={
        "measure": "needs dark frames directly after bright frames: the first dark frame shows the lag",
        "correct": "needs the whole sequence from its first frame on",
        "propagate": "needs the target's speed, which the probe does not contain; a target at rest is not shifted",
    },
)
