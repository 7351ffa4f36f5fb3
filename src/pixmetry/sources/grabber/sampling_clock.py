"""Sampling by a clock of the grabber's own: columns of the stored image are not the camera's pixels."""

from __future__ import annotations

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class SamplingClock(Parameters):
    """When the grabber samples the line."""

    clock_mhz: float = quantity(0.0, "MHz", "sampling clock; 0: the camera's pixel clock", ge=0, le=1000)
    start_ns: float = quantity(
        0.0, "ns", "delay from the start of the first pixel to the start of the first sampling period", ge=-1e5, le=1e5
    )
    samples: int = quantity(0, "1", "samples per row; 0: as many as the row has pixels", ge=0, le=65536)


def forward(params: SamplingClock, signal: Signal, stream: Stream) -> Signal:
    """Take sample k at start + (k + ½)/f_s of the line."""
    if params == SamplingClock():
        return signal
    clock_hz = params.clock_mhz * 1e6 or signal.clock.pixel_hz
    return signal.with_line(signal.own_line.clocked(clock_hz, params.start_ns * 1e-9, params.samples or signal.frame_shape[1]))


def measure(observations: Observations) -> Estimates:
    """Sampling clock and start, from the width of the active area in samples and the beat of the fixed pattern."""
    return observations.border(("clock_mhz", "start_ns"), where="grabber.sampling_clock")


SOURCE = Source(
    id="grabber.sampling_clock",
    title="Sampling clock",
    description="The grabber samples with a clock of its own. The image is scaled along the row, and its first and last sample may lie "
    "anywhere in the line.",
    number=32,
    stars=5,
    note="Note 2",
    parameters=SamplingClock,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics", "cable", "grabber.low_pass"),
    before=("grabber.clamp", "grabber.fixed_pattern", "grabber.phase_pattern", "grabber.window_offset", "grabber.adc", "processing"),
    neutral=SamplingClock(),
    typical=SamplingClock(clock_mhz=10.0),
    bound=SamplingClock(clock_mhz=10.0, start_ns=500.0),
    forward=forward,
    measure=measure,
    applies_to=("analogue",),
    gum_class="G",
    equation="t_k = t_0 + (k + ½)/f_s;  x_image = ((x + ½)/f_pixel − t_0) f_s − ½",
    typical_size="ratio 1.41875 for 10 MHz and 14.1875 MHz: 512 samples span 726.4 pixels; pixel pitch × 1.41875 along the row",
    references=("R. Lenz, D. Fritsch, ISPRS J. Photogramm. 45, 1990, 90 (accuracy of videometry with CCD sensors)",),
    advice="Sample with the camera's pixel clock, or take a digital camera. Otherwise multiply the pitch by f_pixel/f_s, and do not "
    "resample.",
    reasons={
        "correct": "it moves points along the rows, and resampling frames would correlate the noise of neighbours. The camera's geometry "
        "gives the true position: coordinates are scaled instead",
        "propagate": "a known change of coordinates is not an error; the error by aliasing depends on all filters before it",
    },
)
