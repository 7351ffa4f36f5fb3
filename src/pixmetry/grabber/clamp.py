"""Black clamp: the level that is taken for black is off, noisy from line to line, drifts, and sinks behind bright targets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.core.contribution import Contribution, Probe
from pixmetry.core.random import Stream
from pixmetry.core.signal import Kind, Signal, Windows
from pixmetry.core.source import Parameters, Source, quantity
from pixmetry.grabber._clamp_kernels import droop, undroop

NEAR_PX = 64


class Clamp(Parameters):
    """Restoring of black once in every line."""

    offset_dn: float = quantity(0.0, "DN", "level that black is brought to; what is below code 0 is cut off later", ge=-1e4, le=1e4)
    noise_dn: float = quantity(0.0, "DN", "standard deviation of that level from line to line", ge=0, le=1e3)
    drift_dn_per_k: float = quantity(0.0, "DN/K", "how it changes with temperature", ge=-100, le=100)
    reference_temperature_c: float = quantity(20.0, "°C", "temperature at which it is the offset", ge=-60, le=100)
    droop_rel: float = quantity(0.0, "1", "share of a constant level that the AC coupling has lost at the end of the line", ge=0, le=0.9)

    def black(self, temperature_c: np.ndarray) -> np.ndarray:
        """Mean level of black in DN at some temperatures."""
        return self.offset_dn + self.drift_dn_per_k * (np.asarray(temperature_c, float) - self.reference_temperature_c)

    def losses(self, cols: int) -> tuple[float, float]:
        """Shares lost over a pixel and over half of one: (1 − droop)^(1/cols) is left after each of the line's pixels."""
        left = np.log1p(-self.droop_rel) / cols
        return float(-np.expm1(left)), float(-np.expm1(left / 2))


def forward(params: Clamp, signal: Signal, stream: Stream) -> Signal:
    """Let the line droop from its first pixel on, and add the level of black with its noise."""
    data = signal.data
    if params.droop_rel:
        data = droop(np.ascontiguousarray(data, np.float32), *params.losses(signal.frame_shape[1]))
    if params.offset_dn or params.drift_dn_per_k:
        data = data + params.black(signal.temperature_c).astype(np.float32)[:, None, None]
    if params.noise_dn:
        data = data + np.float32(params.noise_dn) * stream.normal_rows(signal.grid)[:, :, None]
    return signal.with_data(data)


def context(params: Clamp, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole row if it droops."""
    return windows.full_rows(frame_shape) if params.droop_rel else windows


def near(params: Clamp) -> tuple[int, int, int, int]:
    """Pixels to the left that are followed one by one."""
    return 0, 0, NEAR_PX if params.droop_rel else 0, 0


def tail(params: Clamp) -> float:
    """What the whole line can take from a pixel."""
    return params.droop_rel


def correct(params: Clamp, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Take out the mean level of black and the droop, from left to right; the noise of the lines stays."""
    data = signal.data - params.black(signal.temperature_c).astype(np.float32)[:, None, None]
    if params.droop_rel:
        data = undroop(np.ascontiguousarray(data, np.float32), *params.losses(signal.frame_shape[1]))
    return signal.with_data(data)


def propagate(params: Clamp, probe: Probe) -> Contribution:
    """Noise common to each row (P7 for offsets), and the streak behind the target on the slope that the background gets (P2)."""
    u = probe.rows(params.noise_dn)
    loss, half = params.losses(probe.frame_shape[1])
    target = np.ascontiguousarray(probe.signal_dn - probe.background_dn, np.float32)
    slope = -loss * probe.background_dn * (np.arange(target.shape[2]) - probe.x_px[:, None])
    dx, dy = probe.field(droop(target, loss, half) - target.astype(float) + slope[:, None, :])
    return Contribution(
        u_x_px=float(np.hypot(u[0], dx.std())), u_y_px=float(np.hypot(u[1], dy.std())), bias_x_px=float(dx.mean()),
        bias_y_px=float(dy.mean()), gum_class="Tr", model_error=0.2, method="offsets common to a row, and the field of the droop",
    )  # fmt: skip


SOURCE = Source(
    id="grabber.clamp",
    title="Black clamp and offset",
    description="The clamp's black is off, differs from line to line and with temperature, and sinks to the right of what is bright.",
    number=30,
    stars=2,
    note="Note 13",
    parameters=Clamp,
    consumes=(Kind.DN,),
    after=("sensor", "electronics", "cable"),
    before=("grabber.adc", "processing"),
    neutral=Clamp(),
    typical=Clamp(offset_dn=-3.0, noise_dn=0.3, drift_dn_per_k=0.05, droop_rel=0.01),
    bound=Clamp(offset_dn=-6.0, noise_dn=1.0, drift_dn_per_k=0.2, droop_rel=0.03),
    forward=forward,
    correct=correct,
    propagate=propagate,
    context=context,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="Tr",
    equation="y' = y − s + b + k (T − T_0) + s_n n_r,  ds/dt = (y − s)/τ,  s = 0 at the line's start",
    typical_size="with black 6 DN below the first code a Gaussian spot (σ = 1.5 px, 150 DN) swings by 0.0075 px over the pixel",
    references=("EMVA 1288 R4.0 Linear, §6.1 (black level: at most 0.5 % of the pixels at code 0)",),
    advice="Set black to at least three standard deviations of the noise above code 0, subtract it, and use a soft threshold.",
    reasons={"measure": "dark frames show it in grabber.adc's black level and in electronics.row_noise, and do not part them"},
)
