"""Charge transfer inefficiency of a CCD: each transfer leaves a little behind, which arrives with the pixels that follow.

The register lies before row 0 and its output before column 0, at the top left corner: row r takes r + 1 steps down its column, and after
that column c takes c + 1 steps along the register, each of so many phases. Deferred charge appears farther from the output, at higher
rows and columns; what trails beyond the last of them leaves the frame. Of an interlaced frame each field does so by itself: row r takes
r div 2 + 1 steps, and what it leaves behind comes two rows farther on.

Two models may act together: a fixed share left behind in every transfer, and traps, of which a packet fills those in its own volume, so
that the loss depends on the signal and on the packets that went before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import STATED_FRAME, Parameters, Source, quantity
from pixmetry.core.errors import ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.sensor._charge_kernels import pass_traps, scatter, share_table, transfer_columns, transfer_packets, transfer_rows

ITERATIONS = 5
LONGEST_STEPS = 4096  # pixels to the output that the stated tail allows for
NEAR_SHARE = 1e-3  # of the deferred charge, may come from beyond the near context
SMALL_E = 1000.0  # packet for which the stated tail of traps holds


class ChargeTransfer(Parameters):
    """Inefficiency per transfer, in columns and in the register, and the release of the deferred charge."""

    parallel_cti: float = quantity(0.0, "1", "share left behind per transfer down a column", ge=0, le=0.01)
    serial_cti: float = quantity(0.0, "1", "share left behind per transfer along the register", ge=0, le=0.01)
    phases: int = quantity(1, "1", "transfers per pixel (1 where the inefficiency is given per pixel)", ge=1, le=4)
    trail_px: float = quantity(1.0, "px", "mean distance by which deferred charge is late", ge=1, le=50)
    beta: float = quantity(1.0, "1", "lost charge grows with the packet to this power; below 1 small packets lose more", gt=0, le=1)
    reference_e: float = quantity(10_000.0, "e-", "packet for which the stated inefficiency holds", gt=0, le=1e7)
    fast_traps_per_px: float = quantity(0.0, "1", "number of fast traps in the whole volume of a pixel", ge=0, le=1000)
    fast_release_px: float = quantity(1.0, "px", "time constant of their release, in steps of one pixel", ge=0.1, le=1000)
    slow_traps_per_px: float = quantity(0.0, "1", "number of slow traps in the whole volume of a pixel", ge=0, le=1000)
    slow_release_px: float = quantity(10.0, "px", "time constant of their release, in steps of one pixel", ge=0.1, le=1000)
    fill_beta: float = quantity(0.5, "1", "a packet fills the share (x / trap_well_e)^fill_beta of a pixel's volume", gt=0, le=1)
    trap_well_e: float = quantity(100_000.0, "e-", "packet that fills the whole volume", gt=0, le=1e7)
    interlaced: bool = quantity(False, "1", "whether even and odd rows are two fields that are transferred separately")
    traps_along: Literal["columns", "register", "both"] = quantity("columns", "1", "number of transfers in which the traps act")

    @property
    def traps(self) -> bool:
        """Whether there are any."""
        return self.fast_traps_per_px + self.slow_traps_per_px > 0

    @property
    def rows_per_line(self) -> int:
        """Rows of the frame from one line to the next that follows it down the column."""
        return 2 if self.interlaced else 1

    @property
    def in_columns(self) -> bool:
        """Whether charge is lost down the columns."""
        return self.parallel_cti > 0 or (self.traps and self.traps_along != "register")

    @property
    def in_register(self) -> bool:
        """Whether charge is lost along the register."""
        return self.serial_cti > 0 or (self.traps and self.traps_along != "columns")


@dataclass(frozen=True)
class _Draws:
    """Where and from what electrons draw for themselves; none where they move by their shares."""

    stream: Stream
    frame: np.ndarray


def _move(params: ChargeTransfer, data: np.ndarray, row0: np.ndarray, col0: np.ndarray, draws: _Draws | None = None) -> np.ndarray:
    """Parallel transfer first, line by line of a field; then serial. In each the fixed share, then the traps."""
    data = np.ascontiguousarray(data, np.float32)
    if params.in_columns:
        data = _down_columns(params, data, row0, col0, draws) if not params.interlaced else _by_fields(params, data, row0, col0, draws)
    if params.in_register:
        if params.serial_cti and params.beta == 1:
            if draws is None:
                data = transfer_rows(data, col0, params.phases, params.serial_cti, params.trail_px)
            else:
                table = _further(int((col0 + data.shape[2]).max()), params.phases, params.serial_cti, params.trail_px)
                data = _scattered(data, draws.stream.key("along the register"), draws.frame, row0, 1, col0, col0, table, True)
        packets = params.serial_cti > 0 and params.beta != 1
        traps = params.traps and params.traps_along != "columns"
        data = _by_packet(params, data, "register", col0, params.serial_cti if packets else 0.0, traps, draws, row0, col0, 1)
    return data


def _by_fields(params: ChargeTransfer, data: np.ndarray, row0: np.ndarray, col0: np.ndarray, draws: _Draws | None) -> np.ndarray:
    """Row R of the woven frame is line R div 2 of field R mod 2; each field goes down the columns by itself."""
    out = np.empty_like(data)
    for first in range(min(2, data.shape[1])):
        out[:, first::2] = _down_columns(params, np.ascontiguousarray(data[:, first::2]), row0 + first, col0, draws)
    return out


def _down_columns(params: ChargeTransfer, data: np.ndarray, row0: np.ndarray, col0: np.ndarray, draws: _Draws | None) -> np.ndarray:
    """The lines of a field, or of a whole frame; ``row0`` are their first rows."""
    step = params.rows_per_line
    line0 = row0 // step
    if params.parallel_cti and params.beta == 1:
        if draws is None:
            data = transfer_columns(data, line0, params.phases, params.parallel_cti, params.trail_px)
        else:
            table = _further(int((line0 + data.shape[1]).max()), params.phases, params.parallel_cti, params.trail_px)
            data = _scattered(data, draws.stream.key("down the columns"), draws.frame, row0, step, col0, line0, table, False)
    packets, traps = params.parallel_cti > 0 and params.beta != 1, params.traps and params.traps_along != "register"
    if packets or traps:
        turned = np.ascontiguousarray(data.swapaxes(1, 2))
        turned = _by_packet(params, turned, "columns", line0, params.parallel_cti if packets else 0.0, traps, draws, col0, row0, step)
        data = np.ascontiguousarray(turned.swapaxes(1, 2))
    return data


@lru_cache(maxsize=16)
def _further(lines: int, phases: int, loss: float, trail_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Of the electrons of each line that are j pixels late, the share that falls behind more, and log(1 − share); shape (lags, lines)."""
    table, _ = share_table(0, lines, phases, loss, trail_px)
    beyond = np.maximum(1.0 - table.sum(axis=1), 0.0)  # later than there are lines
    beyond[beyond < 1e-7] = 0.0
    reached = np.cumsum(table[:, ::-1], axis=1)[:, ::-1] + beyond[:, None]
    after = np.concatenate([reached[:, 1:], beyond[:, None]], axis=1)
    share = np.clip(np.divide(after, reached, out=np.zeros_like(after), where=reached > 0), 0.0, 1.0).T
    with np.errstate(divide="ignore"):
        return np.ascontiguousarray(share), np.ascontiguousarray(np.log1p(-share))


def _scattered(
    data: np.ndarray, key: np.uint64, frame: np.ndarray, row0: np.ndarray, step: int, col0: np.ndarray, line0: np.ndarray,
    table: tuple[np.ndarray, np.ndarray], along: bool,
) -> np.ndarray:  # fmt: skip
    out = np.zeros_like(data)
    scatter(data, key, frame, row0, step, col0, line0, *table, along, out)
    return out


def _by_packet(
    params: ChargeTransfer, data: np.ndarray, where: str, first: np.ndarray, loss: float, traps: bool, draws: _Draws | None,
    row0: np.ndarray, at0: np.ndarray, step: int,
) -> np.ndarray:  # fmt: skip
    """What depends on the size of the packets, along the last axis; ``row0`` and ``at0 + step c`` are places for the draws."""
    noisy = draws is not None
    frame = np.zeros_like(first) if draws is None else draws.frame
    if loss:
        key = np.uint64(0) if draws is None else draws.stream.key(f"packets, {where}")
        data = transfer_packets(
            data, first, params.phases, loss, params.trail_px, params.beta, params.reference_e, noisy, key, frame, row0, at0, step
        )
    if traps:
        key = np.uint64(0) if draws is None else draws.stream.key(f"traps, {where}")
        species = ((params.fast_traps_per_px, params.fast_release_px), (params.slow_traps_per_px, params.slow_release_px))
        density, release = np.ascontiguousarray(np.array([s for s in species if s[0] > 0]).T)
        data = pass_traps(data, first, density, release, params.fill_beta, params.trap_well_e, noisy, key, frame, row0, at0, step)
    return data


def forward(params: ChargeTransfer, signal: Signal, stream: Stream) -> Signal:
    """Transfer all packets to the output, every electron for itself; charge is kept, but for what trails beyond the last row and column.

    In each transfer an electron stays behind with the probability ε, whatever the others do: the number that does is binomial. So the
    electrons of a flat field, Poisson before, are Poisson and independent of their neighbours after it (thinning and superposition of
    Poisson processes; J. F. C. Kingman, Poisson Processes, 1993, ch. 2 and 5): transfer noise 2 n ε S between a packet and what it leaves.
    Traps that fill at once do not act like that: see `pass_traps`.
    """
    if not params.in_columns and not params.in_register:
        return signal
    draws = None if stream.quiet else _Draws(stream, signal.grid.frame)
    return signal.with_data(_move(params, signal.data, signal.grid.row0, signal.grid.col0, draws))


def correct(params: ChargeTransfer, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Invert the forward model by five fixed-point steps x ← x + (y − F(x)), on whole frames (Massey et al. 2010).

    The noise of the transfer stays.

    Raises
    ------
    ParameterError
        If the loss depends on the packet and the signal is not in electrons.
    """
    if (params.beta != 1 or params.traps) and signal.kind != Kind.ELECTRONS:
        raise ParameterError(
            "a loss that depends on the packet needs a signal in electrons", value=str(signal.kind), remedy="divide by the gain"
        )
    y = signal.data.astype(np.float32)
    if not params.in_columns and not params.in_register:
        return signal.with_data(y)
    x = y
    for _ in range(ITERATIONS):
        x = x + (y - _move(params, x, signal.grid.row0, signal.grid.col0))
    return signal.with_data(x)


def measure(observations: Observations) -> Estimates:
    """Read what covered columns and rows show behind the lit area of bright frames, per pixel; a trail in px for both directions."""
    names = ("serial_cti", "parallel_cti", "trail_px")
    return observations.by_covered({name: name for name in names}, where="sensor.charge_transfer")


def context(params: ChargeTransfer, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole column, and the whole row if the register loses charge."""
    if params.in_columns:
        windows = windows.full_columns(frame_shape)
    return windows.full_rows(frame_shape) if params.in_register else windows


def _deferred_share(params: ChargeTransfer, loss: float) -> float:
    """Share of a packet that falls behind on the longest way to the output."""
    return -math.expm1(LONGEST_STEPS * params.phases * math.log1p(-loss))


def _reach_px(params: ChargeTransfer) -> int:
    """Lines and columns after which less than `NEAR_SHARE` of deferred charge is still under way, with the trail of the longest way."""
    loss = max(params.parallel_cti, params.serial_cti)
    reach = 0.0
    if loss:
        stay = 1 - _deferred_share(params, loss) / (LONGEST_STEPS * params.phases * loss * params.trail_px)
        reach = math.log(NEAR_SHARE) / math.log(stay) if stay > 0 else 1.0
    slowest = [t for n, t in ((params.fast_traps_per_px, params.fast_release_px), (params.slow_traps_per_px, params.slow_release_px)) if n]
    return math.ceil(max([reach, *(-t * math.log(NEAR_SHARE) for t in slowest)]))


def near(params: ChargeTransfer) -> tuple[int, int, int, int]:
    """Pixels above and to the left from which trails come; a line of a field is two rows."""
    reach = _reach_px(params)
    return (params.rows_per_line * reach if params.in_columns else 0, 0, reach if params.in_register else 0, 0)


def tail(params: ChargeTransfer) -> float:
    """Share of a packet far from the output that trails beyond `near`; of traps, for a packet of `SMALL_E` after empty pixels."""
    filled = (SMALL_E / params.trap_well_e) ** params.fill_beta if params.trap_well_e > SMALL_E else 1.0
    density = params.fast_traps_per_px + params.slow_traps_per_px
    trapped = min(LONGEST_STEPS * density * filled / SMALL_E, 1.0) * (2 if params.traps_along == "both" else 1)
    return NEAR_SHARE * (_deferred_share(params, params.parallel_cti) + _deferred_share(params, params.serial_cti) + trapped)


def propagate(params: ChargeTransfer, probe: Probe) -> Contribution:
    """Propagator P5: the mean shift is transfers × loss × trail for a whole target; here, the field that the transfer adds to the window.

    It is taken at the centre of the frame. It grows with the distance from the output from zero to twice that, so over the frame its
    standard deviation is 1/√3 of its mean.
    """
    shifts = []
    for serial in (False, True):
        one = _only(params, serial)
        shifts.append(probe.moved(probe.signal_dn + _added_dn(one, probe)))
    (px, py), (sx, sy) = shifts
    u = [float(np.sqrt(np.var(p + s) + (p.mean() ** 2 + s.mean() ** 2) / 3)) for p, s in ((px, sx), (py, sy))]
    return Contribution(
        u_x_px=u[0],
        u_y_px=u[1],
        bias_x_px=float(np.mean(px + sx)),
        bias_y_px=float(np.mean(py + sy)),
        gum_class="G",
        model_error=0.15,
        method="the estimator on the target with its deferred charge, for a target anywhere on the frame",
    )


def _only(params: ChargeTransfer, serial: bool) -> ChargeTransfer:
    """The losses along the register alone, or down the columns alone."""
    change: dict[str, float | str] = {"parallel_cti": 0.0} if serial else {"serial_cti": 0.0}
    here, there = ("register", "columns") if serial else ("columns", "register")
    if params.traps_along == there:
        change |= {"fast_traps_per_px": 0.0, "slow_traps_per_px": 0.0}
    return params.model_copy(update=change | {"traps_along": here})


def _added_dn(params: ChargeTransfer, probe: Probe) -> np.ndarray:
    """Signal that the transfer adds to a target at the centre of the frame; the uniform background keeps its level."""
    left = _reach_px(params)
    up = params.rows_per_line * left
    phases, rows, cols = probe.signal_dn.shape
    row0, col0 = (max((size - length) // 2, 0) for size, length in zip(probe.frame_shape, (rows, cols), strict=True))
    electrons = np.full((phases + 1, rows + up, cols + left), probe.background_dn / probe.gain_dn_per_e, np.float32)
    electrons[1:, up:, left:] = probe.signal_dn / probe.gain_dn_per_e
    corner = [np.full(phases + 1, max(at - reach, 0), np.int64) for at, reach in ((row0, up), (col0, left))]
    added = (_move(params, electrons, corner[0], corner[1]) - electrons)[:, up:, left:].astype(np.float64)
    added_dn: np.ndarray = probe.gain_dn_per_e * (added[1:] - added[0])
    return added_dn


MOST_CTI, WHOLE_WAY = 5e-5, 0.03  # of a sound camera: in one transfer, and over all rows or columns


def bound_over(frame_shape: tuple[int, int]) -> ChargeTransfer:
    """A charge leaves 3 % behind on its way across the whole frame, along either axis, and never more than 5e-5 in one transfer."""
    parallel, serial = (min(MOST_CTI, WHOLE_WAY / side) for side in frame_shape)
    return ChargeTransfer(parallel_cti=parallel, serial_cti=serial, trail_px=2.0)


SOURCE = Source(
    id="sensor.charge_transfer",
    title="Charge transfer inefficiency",
    description="Every transfer leaves a share of the charge behind. This charge trails behind the target and shifts its centre away "
    "from the output.",
    number=12,
    stars=1,
    note="Note 16",
    parameters=ChargeTransfer,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise",),
    before=("electronics",),
    neutral=ChargeTransfer(),
    typical=ChargeTransfer(parallel_cti=1e-5, serial_cti=1e-5),
    bound=bound_over(STATED_FRAME),
    bound_over=bound_over,
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    context=context,
    near=near,
    tail=tail,
    applies_to=("ccd",),
    gum_class="G",
    equation="electrons are j px late by (1 − ε)^n (1, nε, n(n + 1)ε²/2, …), mean nε⟨k⟩;  traps: caught n ρ (x/w)^β, released as e^(−k/τ)",
    typical_size="0.0075 px after 752 transfers at 1e-5; 92 % of the charge is left after 8192",
    references=(
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, ch. 5",
        "R. Massey et al., MNRAS 401, 371, 2010 (trails and their iterative removal)",
        "R. Massey et al., MNRAS 439, 887, 2014 (traps filled up to the height of the packet)",
    ),
    leaves="the noise of the transfer, and traps that the model does not hold",
    advice="Clock more slowly, keep a background of some hundred electrons, and correct with the measured inefficiency.",
)
