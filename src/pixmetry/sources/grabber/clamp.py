"""Black clamp: the level that is taken for black is off, noisy from line to line, drifts, and sinks behind bright targets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line import alike_rows
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.grabber._kernels import droop, undroop

NEAR_PX = 64
NEAR_SHARE = 1e-3  # of a row's error, may come from rows above the near context


class Clamp(Parameters):
    """Restoring of black once in every line."""

    offset_dn: float = quantity(0.0, "DN", "level to which black is set; values below code 0 are cut off later", ge=-1e4, le=1e4)
    noise_dn: float = quantity(0.0, "DN", "standard deviation of this level from line to line", ge=0, le=1e3)
    drift_dn_per_k: float = quantity(0.0, "DN/K", "change of the level with temperature", ge=-100, le=100)
    reference_temperature_c: float = quantity(20.0, "°C", "temperature at which the stated level holds", ge=-60, le=100)
    droop_rel: float = quantity(0.0, "1", "share of a constant level that the AC coupling loses until the end of the line", ge=0, le=0.9)
    restored_rel: float = quantity(
        1.0, "1", "share of the error that the clamp removes at the start of each line; the rest remains", ge=0.05, le=1
    )
    interlaced: bool = quantity(True, "1", "whether the previous line is that of the same field, two rows above")

    def black(self, temperature_c: np.ndarray) -> np.ndarray:
        """Mean level of black in DN at some temperatures."""
        return self.offset_dn + self.drift_dn_per_k * (np.asarray(temperature_c, float) - self.reference_temperature_c)

    def losses(self, cols: int) -> tuple[float, float]:
        """Shares lost over a pixel and over half of one: (1 − droop)^(1/cols) is left after each of the line's pixels."""
        left = np.log1p(-self.droop_rel) / cols
        return float(-np.expm1(left)), float(-np.expm1(left / 2))

    @property
    def carry(self) -> tuple[float, int]:
        """Share of a line's error that the next one begins with, and rows from line to line."""
        return 1 - self.restored_rel, 2 if self.interlaced else 1

    @property
    def length_rows(self) -> float:
        """Lines over which the clamp's own noise falls to 1/e; 0 where each line has its own."""
        return float(-1 / np.log1p(-self.restored_rel)) if self.restored_rel < 1 else 0.0


def forward(params: Clamp, signal: Signal, stream: Stream) -> Signal:
    """Let the line droop from its first pixel on, and add the level of black with its noise.

    A clamp that makes good a share k of its error leaves 1 − k of the droop to the next line, and averages its own noise over lines:
    b_l = (1 − k) b_(l−1) + k n_l. The vertical interval is long enough to begin each field anew.
    """
    data = signal.data
    if params.droop_rel:
        data = droop(np.ascontiguousarray(data, np.float32), *params.losses(signal.frame_shape[1]), *params.carry)
    if params.offset_dn or params.drift_dn_per_k:
        data = data + params.black(signal.temperature_c).astype(np.float32)[:, None, None]
    if params.noise_dn:
        length = params.length_rows
        noise = alike_rows(stream, signal.grid, length, params.carry[1]) if length else stream.normal_rows(signal.grid)
        data = data + np.float32(params.noise_dn) * noise.astype(np.float32)[:, :, None]
    return signal.with_data(data)


def context(params: Clamp, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole row if it droops, and all rows above if they carry over."""
    if not params.droop_rel:
        return windows
    rows = windows.full_rows(frame_shape)
    return rows if params.restored_rel == 1 else rows.expand(frame_shape[0], 0, 0, 0, frame_shape)


def near(params: Clamp) -> tuple[int, int, int, int]:
    """Pixels to the left that are followed one by one, and rows above of which more than `NEAR_SHARE` carries over."""
    if not params.droop_rel:
        return 0, 0, 0, 0
    return params.carry[1] * int(np.ceil(params.length_rows * -np.log(NEAR_SHARE))), 0, NEAR_PX, 0


def tail(params: Clamp) -> float:
    """What the whole line, and those before it, can take from a pixel."""
    return min(params.droop_rel / params.restored_rel, 1.0)


def correct(params: Clamp, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Take out the mean level of black and the droop, from left to right and, where it carries over, from the top of the frame.

    The noise of the lines stays. Parts of frames must begin with row 0 for the latter.
    """
    data = signal.data - params.black(signal.temperature_c).astype(np.float32)[:, None, None]
    if params.droop_rel:
        data = undroop(np.ascontiguousarray(data, np.float32), *params.losses(signal.frame_shape[1]), *params.carry)
    return signal.with_data(data)


def measure(observations: Observations) -> Estimates:
    """Read the droop from covered columns at both ends of the line.

    The level of black is in ``grabber.adc``, its noise in ``electronics.row_noise``: one gain does not tell them apart.
    """
    return observations.by_covered(
        {"droop_rel": "droop_rel"}, where="grabber.clamp", method="end of the line against its start, over levels of light"
    )


def propagate(params: Clamp, probe: Probe) -> Contribution:
    """Noise common to each row (P7 for offsets), and the streak behind the target on the slope that the background gets (P2)."""
    u = _noise(params, probe)
    loss, half = params.losses(probe.frame_shape[1])
    target = np.ascontiguousarray(probe.signal_dn - probe.background_dn, np.float32)
    slope = -loss * probe.background_dn * (np.arange(target.shape[2]) - probe.x_px[:, None])
    dx, dy = probe.field(droop(target, loss, half, *params.carry) - target.astype(float) + slope[:, None, :])
    black = float(params.black(np.array(probe.temperature_c)))
    with_it, without = (probe.moved(_cut_off(probe, pedestal)) for pedestal in (probe.pedestal_dn + black, probe.pedestal_dn))
    dx, dy = (d + a - b for d, a, b in zip((dx, dy), with_it, without, strict=True))
    method = "offsets that are common to a row, the field of the droop, and what is cut off at code 0"
    floor_px = 4e-4 if params.droop_rel and params.restored_rel < 1 else 2e-4  # the background settles over the first lines
    return probe.from_shifts(dx, dy, "Tr", beside=u, model_error=0.2, floor_px=floor_px, method=method)


def _cut_off(probe: Probe, pedestal_dn: float) -> np.ndarray:
    """The signal without what lies below code 0, where black is so much above it; the ground keeps its level."""
    cut: np.ndarray = np.maximum(probe.signal_dn, -pedestal_dn)
    return cut + min(probe.background_dn + pedestal_dn, 0.0)


def _noise(params: Clamp, probe: Probe) -> tuple[float, float]:
    """u of x and y from the clamp's noise: gᵀ C g with the response g to each row's level and the lines' covariance C."""
    if not params.length_rows:
        return probe.rows(params.noise_dn)
    apart = np.abs(np.arange(probe.gx.shape[1])[:, None] - np.arange(probe.gx.shape[1]))
    stride = params.carry[1]
    alike = np.where(apart % stride == 0, np.exp(-apart / stride / params.length_rows), 0.0)
    each = (g.sum(axis=2) for g in (probe.gx, probe.gy))
    u = [params.noise_dn * float(np.sqrt(np.einsum("pr,rs,ps->p", g, alike, g).mean())) for g in each]
    return u[0], u[1]


SOURCE = Source(
    id="grabber.clamp",
    title="Black clamp and offset",
    description="The black level of the clamp has an error that varies from line to line and with temperature. To the right of bright "
    "areas it sinks.",
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
    measure=measure,
    correct=correct,
    propagate=propagate,
    context=context,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="Tr",
    equation="y' = y − s + b + d (T − T_0) + s_n n_r,  ds/dt = (y − s)/τ,  s at a line's start: (1 − k) of the line before",
    typical_size="with black 6 DN below the first code a Gaussian spot (σ = 1.5 px, 150 DN) swings by 0.0075 px over the pixel",
    references=("EMVA 1288 R4.0 Linear, §6.1 (black level: at most 0.5 % of the pixels at code 0)",),
    leaves="the noise of the lines' black level",
    advice="Set black at least three standard deviations of the noise above code 0. Subtract it, and use a soft threshold.",
)
