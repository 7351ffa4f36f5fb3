"""Supply pick-up: a sinusoid of the mains or of a switching supply that gets in while the frame is read out pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.camera.waves import shift_per_dn, wave, without_wave
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream


class SupplyPickup(Parameters):
    """One sinusoid in time, and the clocks that turn time into places on the frame."""

    amplitude_dn: float = quantity(0.0, "DN", "amplitude of the sinusoid", ge=0, le=1e3)
    frequency_hz: float = quantity(235.01e3, "Hz", "frequency of mains or switching supply", ge=1, le=5e6)
    line_time_us: float = quantity(64.0, "µs", "from the first pixel of a row to that of the next", gt=0, le=1e5)
    pixel_time_ns: float = quantity(67.8, "ns", "from pixel to pixel within a row; 0 where a row is read at once", ge=0, le=1e6)
    scan: Literal["progressive", "interlaced"] = quantity("progressive", "1", "order of the rows; interlaced: even rows, then odd ones")
    field_lines: float = quantity(
        312.5, "1", "number of line times from the start of the first field to the start of the second", gt=0, le=1e6
    )


def turns_per_px(params: SupplyPickup) -> tuple[float, float]:
    """Turns of the phase from column to column and from row to row: ν_x = f t_pixel, ν_y = f t_line; not folded."""
    return params.frequency_hz * params.pixel_time_ns * 1e-9, params.frequency_hz * params.line_time_us * 1e-6


def seen_per_px(params: SupplyPickup) -> tuple[float, float]:
    """Cycles per pixel along x and y that the frame shows, −½ … ½: whole turns between neighbours cannot be seen (sampling theorem)."""
    nu_x, nu_y = turns_per_px(params)
    return nu_x - round(nu_x), nu_y - round(nu_y)


def fields(params: SupplyPickup, signal: Signal) -> list[tuple[slice, Signal, float]]:
    """Split windows into what is read without a jump: rows of the window, these as a signal numbered by field line, turns at its start.

    Of an interlaced frame, row R is line R // 2 of field R % 2. Windows that start on rows of different parity do not come here together.
    """
    if params.scan == "progressive":
        return [(slice(None), signal, 0.0)]
    out = []
    for first in range(min(2, signal.data.shape[1])):
        row = signal.grid.row0 + first
        data = signal.data[:, first::2]
        grid = Grid(signal.grid.frame, row // 2, signal.grid.col0, data.shape[1:])
        jump = params.frequency_hz * params.line_time_us * 1e-6 * params.field_lines * float(row[0] % 2)
        out.append((slice(first, None, 2), replace(signal, data=data, grid=grid), jump))
    return out


def split(params: SupplyPickup, signal: Signal) -> list[tuple[np.ndarray | slice, slice, Signal, float]]:
    """Split a batch into parts that are read without a jump: windows of the batch, and what `fields` gives for these."""
    if params.scan == "progressive":
        return [(slice(None), *part) for part in fields(params, signal)]
    odd = signal.grid.row0 % 2
    groups = [index for index in (np.flatnonzero(odd == parity) for parity in (0, 1)) if index.size]
    return [(index, *part) for index in groups for part in fields(params, signal.take(index))]


def forward(params: SupplyPickup, signal: Signal, stream: Stream) -> Signal:
    """Add A sin(2π f t + φ0) with t = t_frame + r t_line + c t_pixel, r the line of the field where the scan is interlaced.

    Whole turns are taken off in float64 before the sine: at 5 MHz, 10⁶ frames of 40 ms leave 3e-5 of a turn to rounding. The phase
    φ0 is the unit's. From frame to frame the wave moves on by the fraction of f × frame period: none, and it stands still.
    """
    if params.amplitude_dn == 0:
        return signal
    nu_x, nu_y = turns_per_px(params)
    added = np.empty(signal.data.shape, np.float32)
    phase = float(stream.uniform_unit(1)[0])
    for index, rows, field, jump in split(params, signal):
        added[index, rows] = wave(field, nu_x, nu_y, (params.frequency_hz * field.time_s) % 1.0 + phase + jump % 1.0)
    added *= np.float32(params.amplitude_dn)
    return signal.with_data(np.add(signal.data, added, out=added))


def measure(observations: Observations) -> Estimates:
    """Read a hum off the means of dark rows: amplitude, and with the stated line time its frequency.

    A wave that turns along the rows too is measured as `grabber.phase_pattern`, and is not counted here.
    """
    where, rows, stated = "electronics.supply_pickup", observations.dark_rows, observations.stated
    if rows is None:
        remedy = "take 16 or more dark frames, of 48 rows or more"
        raise MeasureError("needs the means of the rows of dark frames", where=where, remedy=remedy)
    if "amplitude_dn" not in rows.hum:
        raise MeasureError(rows.hum.reasons["amplitude_dn"], where=where)
    if rows.hum.limits:
        limit = rows.hum["amplitude_dn"]
        raise MeasureError(f"no hum is found in the rows of dark frames: below {limit.value:.2g} DN ({limit.reason})", where=where)
    if "frequency_hz" not in rows.hum or stated.line_time_us is None:
        raise MeasureError(rows.hum.reasons["frequency_hz"], where=where)
    found = rows.hum.select(("amplitude_dn", "frequency_hz"))
    pixel_ns = 0.0 if stated.pixel_clock_mhz is None else 1e3 / stated.pixel_clock_mhz
    clocks = [("line_time_us", stated.line_time_us, 0.0, np.inf, "µs"), ("pixel_time_ns", pixel_ns, 0.0, np.inf, "ns")]
    return found.join(Estimates.from_rows(clocks))


def correct(params: SupplyPickup, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Fit amplitude and phase at the known frequency to the background of every frame, and subtract what is significant of the sinusoid.

    Targets and uneven light are kept out of the fit (`without_wave`). Amplitude and phase are fitted, for neither is that of the frames
    to correct. A frame that shows less than a whole period cannot tell the sinusoid from a gradient of the light, and is refused.
    """
    if params.amplitude_dn == 0:
        return signal
    rows, cols = signal.data.shape[1:]
    nu_x, nu_y = seen_per_px(params)
    lines = rows if params.scan == "progressive" else rows // 2
    if abs(nu_x) * cols < 1 and abs(nu_y) * lines < 1:
        raise InputError(
            "the windows show less than one period of the supply's frequency",
            where="electronics.supply_pickup",
            value=f"{abs(nu_x) * cols:.2g} of a period in x, {abs(nu_y) * lines:.2g} in y",
            allowed="one period or more in x or in y",
            remedy="give whole frames, or average frames over a beat of supply and frame period",
        )
    out, changed = np.array(signal.data, np.float32), False
    for index, rows, field, _ in split(params, signal):
        data = without_wave(field, nu_x, nu_y)
        if data is not None:
            out[index, rows], changed = data, True
    return signal.with_data(out) if changed else signal


def propagate(params: SupplyPickup, probe: Probe) -> Contribution:
    """Propagator P2 for a sinusoid, averaged over its phase: u = A |Σ g exp(2πi(ν_x c + ν_y r))| / √2, no bias.

    The phase at a target is arbitrary, by φ0 and by the target's place. Whether it is a new one in the next frame depends on the
    fraction of f × frame period, to 1/(number of frames); one that stands still does not average, so the class is F.
    """
    if params.scan == "interlaced":
        ux, uy = (params.amplitude_dn * u for u in interlaced_shift_per_dn(params, probe))
    else:
        ux, uy = (params.amplitude_dn * u for u in shift_per_dn(probe, *seen_per_px(params)))
    return probe.contribution((ux, uy), "F", model_error=0.12, method="response of the estimator to a sinusoid of any phase")


def interlaced_shift_per_dn(params: SupplyPickup, probe: Probe) -> tuple[float, float]:
    """The same with the phases of two interlaced fields, for windows that start on even and on odd rows alike."""
    nu_x, nu_y = turns_per_px(params)
    rows, cols = probe.gx.shape[1:]
    squares = np.zeros(2)
    for parity in (0, 1):
        row = np.arange(rows) + parity
        phase = nu_y * (row // 2 + params.field_lines * (row % 2))
        z = np.exp(2j * np.pi * (phase[:, None] + nu_x * np.arange(cols)))
        squares += [np.mean(np.abs((g * z).sum(axis=(1, 2))) ** 2) / 4 for g in (probe.gx, probe.gy)]
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


SOURCE = Source(
    id="electronics.supply_pickup",
    title="Supply pick-up",
    description=(
        "The mains or a switching supply adds a sinusoid to the signal while the frame is read out pixel by pixel. It lies over "
        "the frame as stripes that stand still or roll, as the supply beats with the frame rate."
    ),
    number=21,
    held_by=("grabber.phase_pattern",),
    parameters=SupplyPickup,
    consumes=(Kind.DN,),
    after=("sensor",),
    before=("cable", "grabber", "storage"),
    neutral=SupplyPickup(),
    typical=SupplyPickup(amplitude_dn=0.3),
    bound=SupplyPickup(amplitude_dn=1.0, frequency_hz=1.001e6),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="y' = y + A sin(2π f (t_frame + r t_line + c t_pixel) + φ0);  interlaced: row R is line r = R div 2 of field R mod 2",
    typical_size="0.013 px per DN at 0.05 cycles per pixel in x and in y, 0.0011 px at 0.42, on a disc of 7 px of 150 DN (soft threshold)",
    references=(
        "EMVA 1288 R4.0 Linear, §8.4 (spectrograms show periodic disturbances)",
        "C. E. Shannon, Proc. IRE 37, 1949, 10 (sampling: the frequency that is seen)",
    ),
    leaves="what is below the noise of the background, and the same wave in the scene itself",
    advice=(
        "Filter and shield the supply. Against mains, choose a frame rate at which the stripes roll, and average over a "
        "beat. A known frequency can be fitted and subtracted in every frame."
    ),
)
