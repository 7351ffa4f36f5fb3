"""Image lag: charge that the transfer to the sense node leaves behind comes with the next frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import LightSteps, Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Singles
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates, Number
from pixmetry.core.random import Grid, Stream

LEAST_LEVELS, LEAST_RANGE = 5, 5.0  # levels of light, and their ratio, that tell a pocket from a share
POCKET_CHI2 = 25.0  # by which a pocket must improve the fit


class ImageLag(Parameters):
    """What stays in the photodiode."""

    lag_rel: float = quantity(0.0, "1", "share of the charge that stays behind", ge=0, le=0.9)
    pocket_e: float = quantity(0.0, "e-", "largest charge that a potential pocket holds back in addition", ge=0, le=1e6)
    pocket_fill_e: float = quantity(100.0, "e-", "signal charge at which the pocket is 63 % full", gt=0, le=1e6)


def left_behind(params: ImageLag, charge: np.ndarray) -> np.ndarray:
    """Mean charge that stays, in electrons: the charge of the pocket, at most all charge, and a share of the rest."""
    left: Singles = _left(params, charge).astype(np.float32)
    return left


def _left(params: ImageLag, charge: np.ndarray) -> np.ndarray:
    above = np.maximum(charge, 0)
    pocket = np.minimum(-params.pocket_e * np.expm1(-above / params.pocket_fill_e), above)
    left: np.ndarray = pocket + params.lag_rel * (charge - pocket)
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


def measure(observations: Observations) -> Estimates:
    """Share that stays behind, from frames in which the light goes off; with several levels of light and a known gain, the pocket too.

    Of a charge that was read as S, the share λ stays, h, and (1 − λ) h comes with the first dark frame: that is λ S, whatever was held
    before. A pocket adds a charge that hardly depends on S.
    """
    if observations.sensor == "cid":
        what = "a charge injection device leaves charge when it is cleared: see sensor.cid_readout, residual"
        raise MeasureError(what, where="sensor.image_lag")
    steps = observations.light_off
    fit = of_pictures(
        None if steps is None else steps.fit,
        {"lag_rel": "left_rel"},
        where="sensor.image_lag",
        pictures="a light that goes off",
        kind="light_off",
    )
    gain = observations.photon_transfer_fit
    known = gain is not None and "gain_dn_per_e" in gain
    pocket = _with_pocket(steps, gain["gain_dn_per_e"]) if known and steps is not None and gain is not None else None
    if pocket is not None:
        return pocket
    if not fit.limits:
        one = "one level of light, or a gain that is not known, does not tell a pocket from a share: take sequences at 5 levels, 1 : 10"
        levels = np.concatenate([s.levels_dn for s in steps.steps]) if steps is not None else np.ones(1)
        if not known or levels.size < LEAST_LEVELS or np.ptp(np.log(levels)) < np.log(LEAST_RANGE):
            return replace(fit, confounders=(*fit.confounders, one))
    return fit


def _with_pocket(steps: LightSteps, gain: Number) -> Estimates | None:
    """Share and pocket fitted together; None where the frames need no pocket, or have too few levels of light.

    Both charges of the pocket go as one over the gain: u holds that of the gain in DN/e-.
    """
    from scipy.linalg import block_diag
    from scipy.optimize import least_squares

    signal = np.concatenate([s.levels_dn for s in steps.steps]) / gain.value
    left = np.concatenate([s.left_dn for s in steps.steps]) / gain.value
    if "left_rel" not in steps.fit or signal.size < LEAST_LEVELS or np.ptp(np.log(signal)) < np.log(LEAST_RANGE):
        return None
    root = np.linalg.cholesky(block_diag(*(s.left_covariance_dn2 for s in steps.steps)) / gain.value**2)

    def residuals(values: np.ndarray) -> np.ndarray:
        share, filled, fill = values  # a pocket cannot hold more than the charge that comes: p ≤ p0
        params = ImageLag(lag_rel=share, pocket_e=filled * fill, pocket_fill_e=fill)
        return np.linalg.solve(root, first_dark_frame(params, signal) - left)

    share = float(np.clip(steps.fit["left_rel"].value, 1e-9, 0.8))
    plain = least_squares(lambda v: residuals(np.array([v[0], 0.0, 100.0])), [share], bounds=([0], [0.9]))
    top = float(max(left.max(), 1e-3))
    fills = np.geomspace(max(signal.min() / 3, 1.0), signal.max(), 4)
    starts = [[share / 2, min(0.5 * top / fill, 0.9), fill] for fill in fills]
    bounds = [0, 0, 0.1], [0.9, 1, 1e6]
    found = min((least_squares(residuals, s, bounds=bounds, x_scale=[0.01, 0.1, 100]) for s in starts), key=lambda f: f.cost)
    if 2 * (plain.cost - found.cost) < POCKET_CHI2:
        return None
    try:
        covariance = np.linalg.inv(found.jac.T @ found.jac) * max(2 * found.cost / max(signal.size - 3, 1), 1.0)
    except np.linalg.LinAlgError:
        return None
    share, filled, fill = found.x
    slopes = np.array([[1.0, 0, 0], [0, fill, filled], [0, 0, 1]])
    names, units = ("lag_rel", "pocket_e", "pocket_fill_e"), ("1", "e-", "e-")
    dof = np.full(3, float(max(signal.size - 3, 1)))
    method = f"{steps.fit.method}; share and pocket fitted to {signal.size} levels of light"
    by_gain = np.array([0.0, filled * fill, fill]) * gain.u / gain.value
    values, covariance = np.array([share, filled * fill, fill]), slopes @ covariance @ slopes.T + np.outer(by_gain, by_gain)
    return Estimates(names, values, covariance, dof, units, method=method, confounders=steps.fit.confounders)


def correct(params: ImageLag, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Give each frame the charge that it left behind, and take off what the frame before left: both follow from the values read.

    Raises
    ------
    InputError
        If the signal holds no successive frames.
    """
    signal.need_frame_before()
    if params.pocket_e and signal.kind is not Kind.ELECTRONS:
        raise InputError("a pocket is known in electrons, and the gain is not", remedy="add electronics.gain")
    held = _held_after(params, signal.data.astype(float))
    before = np.concatenate([held[:1], held[:-1]])
    if signal.grid.frame[0] == 0:
        before[0] = 0.0  # as `start` has it; of another first frame the one before is not known: it stays as it is
    return signal.with_data((signal.data + held - before).astype(np.float32))


def _held_after(params: ImageLag, read: np.ndarray) -> np.ndarray:
    """Charge left behind by frames that were read so, same shape; by fixed-point steps, which shrink as the share."""
    held = np.zeros_like(read, dtype=float)
    for _ in range(60):
        held = _left(params, np.maximum(read + held, 0.0))
    return held


def first_dark_frame(params: ImageLag, last_e: np.ndarray) -> np.ndarray:
    """Charge of the first dark frame after frames whose last was read as ``last_e``, same shape.

    Of the charge q, h(q) stays and q − h(q) is read; in the dark h stays alone, and h − h(h) is read.
    """
    held = _held_after(params, last_e)
    return held - _left(params, held)


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
    measure=measure,
    correct=correct,
    gum_class="O",
    equation="q_out(t) = q(t) + h(t−1) − h(t);  h(t) ~ Binomial(q(t) + h(t−1) − pocket, λ) + pocket,  pocket = p (1 − e^(−q/p0))",
    typical_size="a target that moves v px a frame is λ v/(1 − λ) behind while its ghost lies in the window: 0.01 px at 1 % and 1 px",
    references=("E. R. Fossum, D. B. Hondongwa, IEEE J. Electron Devices Soc. 2(3), 33, 2014 (pinned photodiodes, lag)",),
    leaves="the noise of the charge that stays, and the first frame of a sequence",
    advice="Read a dark frame between exposures, or keep the motion per frame small against the size of the target.",
    reasons={
        "propagate": "needs the target's speed, which the probe does not contain; a target at rest is not shifted",
    },
)
