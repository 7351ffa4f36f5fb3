"""Supply pick-up: a sinusoid of the mains or of a switching supply that gets in while the frame is read out pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.core.contribution import Contribution, Probe
from pixmetry.core.errors import InputError
from pixmetry.core.random import Stream
from pixmetry.core.signal import Kind, Signal
from pixmetry.core.source import Parameters, Source, quantity
from pixmetry.core.waves import shift_per_dn, wave, without_wave


class SupplyPickup(Parameters):
    """One sinusoid in time, and the clocks that turn time into places on the frame."""

    amplitude_dn: float = quantity(0.0, "DN", "amplitude of the sinusoid", ge=0, le=1e3)
    frequency_hz: float = quantity(235.01e3, "Hz", "frequency of mains or switching supply", ge=1, le=5e6)
    line_time_us: float = quantity(64.0, "µs", "from the first pixel of a row to that of the next", gt=0, le=1e5)
    pixel_time_ns: float = quantity(67.8, "ns", "from pixel to pixel within a row; 0 where a row is read at once", ge=0, le=1e6)


def turns_per_px(params: SupplyPickup) -> tuple[float, float]:
    """Turns of the phase from column to column and from row to row: ν_x = f t_pixel, ν_y = f t_line; not folded."""
    return params.frequency_hz * params.pixel_time_ns * 1e-9, params.frequency_hz * params.line_time_us * 1e-6


def seen_per_px(params: SupplyPickup) -> tuple[float, float]:
    """Cycles per pixel along x and y that the frame shows, −½ … ½: whole turns between neighbours cannot be seen (sampling theorem)."""
    nu_x, nu_y = turns_per_px(params)
    return nu_x - round(nu_x), nu_y - round(nu_y)


def forward(params: SupplyPickup, signal: Signal, stream: Stream) -> Signal:
    """Add A sin(2π f t + φ0) with t = t_frame + r t_line + c t_pixel.

    Whole turns are taken off in float64 before the sine: at 5 MHz, 10⁶ frames of 40 ms leave 3e-5 of a turn to rounding. The phase
    φ0 is the unit's. From frame to frame the wave moves on by the fraction of f × frame period: none, and it stands still.
    """
    if params.amplitude_dn == 0:
        return signal
    nu_x, nu_y = turns_per_px(params)
    start = (params.frequency_hz * signal.time_s) % 1.0 + float(stream.uniform_unit(1)[0])
    added = wave(signal, nu_x, nu_y, start)
    added *= np.float32(params.amplitude_dn)
    return signal.with_data(np.add(signal.data, added, out=added))


def correct(params: SupplyPickup, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Fit amplitude and phase at the known frequency to every frame, beside a constant, and subtract the sinusoid.

    Amplitude and phase are fitted, for neither is that of the frames to correct. A frame that shows less than a whole period cannot
    tell the sinusoid from a gradient of the light, and is refused.
    """
    if params.amplitude_dn == 0:
        return signal
    rows, cols = signal.data.shape[1:]
    nu_x, nu_y = seen_per_px(params)
    if abs(nu_x) * cols < 1 and abs(nu_y) * rows < 1:
        raise InputError(
            "these windows show less than one period of the supply's frequency",
            where="electronics.supply_pickup",
            value=f"{abs(nu_x) * cols:.2g} of a period in x, {abs(nu_y) * rows:.2g} in y",
            allowed="one period or more in x or in y",
            remedy="give whole frames, or average frames over a beat of supply and frame period",
        )
    return signal.with_data(without_wave(signal, nu_x, nu_y))


def propagate(params: SupplyPickup, probe: Probe) -> Contribution:
    """Propagator P2 for a sinusoid, averaged over its phase: u = A |Σ g exp(2πi(ν_x c + ν_y r))| / √2, no bias.

    The phase at a target is arbitrary, by φ0 and by the target's place. Whether it is a new one in the next frame depends on the
    fraction of f × frame period, to 1/(number of frames); one that stands still does not average, so the class is F.
    """
    ux, uy = (params.amplitude_dn * u for u in shift_per_dn(probe, *seen_per_px(params)))
    return probe.contribution((ux, uy), "F", model_error=0.12, method="response of the estimator to a sinusoid of any phase")


SOURCE = Source(
    id="electronics.supply_pickup",
    title="Supply pick-up",
    description=(
        "A sinusoid of the mains or of a switching supply gets into the signal while the frame is read out pixel by pixel, and lies over "
        "it as stripes that stand still or roll, as the supply beats with the frame rate."
    ),
    number=21,
    parameters=SupplyPickup,
    consumes=(Kind.DN,),
    after=("sensor",),
    before=("cable", "grabber", "storage"),
    neutral=SupplyPickup(),
    typical=SupplyPickup(amplitude_dn=0.3),
    bound=SupplyPickup(amplitude_dn=1.0, frequency_hz=1.001e6),
    forward=forward,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="y' = y + A sin(2π f (t_frame + r t_line + c t_pixel) + φ0)",
    typical_size="0.013 px per DN at 0.05 cycles per pixel in x and in y, 0.0011 px at 0.42, on a disc of 7 px of 150 DN (soft threshold)",
    references=(
        "EMVA 1288 R4.0 Linear, §8.4 (spectrograms show periodic disturbances)",
        "C. E. Shannon, Proc. IRE 37, 1949, 10 (sampling: the frequency that is seen)",
    ),
    advice=(
        "Filter and shield the supply. Against mains, choose a frame rate with which the stripes roll, and average over a "
        "beat. A known frequency can be fitted and subtracted in every frame."
    ),
    reasons={
        "measure": (
            "frames show only what is left of the frequency in cycles per pixel after whole turns between pixels and lines, not the hertz "
            "nor the clocks; a line of the spectrum is measured as grabber.phase_pattern, and would count twice"
        ),
    },
)
