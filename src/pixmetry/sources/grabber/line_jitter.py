"""Line jitter: the sampling clock is locked again in every line, each time slightly early or late."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe, smooth_part
from pixmetry.camera.line import alike_rows
from pixmetry.camera.line_contribution import from_row_delays, from_steady_delays
from pixmetry.camera.observations import Observations
from pixmetry.camera.row_delays import UNKNOWN_GAIN_REL, delays_ns
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

UNTOLD_GAIN = (
    "u holds a tenth of it: what the line keeps at the pixel clock makes a row move by more or less than its delay; slanted edges tell by "
    "how much (kind: edge)"
)
BEAT = "not separable from the beat of the grabber's clock with the pixels: sample by the pixel clock"
OWN_CLOCK = (
    "grabber.sampling_clock: delays and periods are in the time of the pixel clock; of a grabber that samples by a clock of its own they "
    "are wrong by the ratio of the two, and its beat with the pixels looks like a settling: state camera.sampling_clock_mhz"
)


class LineJitter(Parameters):
    """Delays of the rows against each other; rows of a field follow each other in time."""

    white_ns: float = quantity(0.0, "ns", "standard deviation of the part that is independent from line to line", ge=0, le=1000)
    loop_ns: float = quantity(0.0, "ns", "standard deviation of the part that is correlated from line to line", ge=0, le=1000)
    loop_rows: float = quantity(5.0, "rows", "number of lines of a field over which this correlation falls to 1/e", ge=0.2, le=60)
    settling_ns: float = quantity(0.0, "ns", "phase error of the first line after the vertical interval", ge=-5000, le=5000)
    settling_rows: float = quantity(15.0, "rows", "number of lines of a field over which this error falls to 1/e", gt=0.1, le=300)
    shear_ns: float = quantity(0.0, "ns", "delay of the last row against the first, linear from row to row", ge=-5000, le=5000)
    interlaced: bool = quantity(True, "1", "whether even and odd rows are two fields, each with its own loop")

    @property
    def stride(self) -> int:
        """Rows of the frame from line to line of a field."""
        return 2 if self.interlaced else 1


def systematic_s(params: LineJitter, rows: np.ndarray, frame_rows: int) -> np.ndarray:
    """What is the same in every frame, at absolute rows: A e^(−line/r_s) + shear."""
    line = np.asarray(rows) // params.stride
    shear = params.shear_ns * (np.asarray(rows) / max(frame_rows - 1, 1) - 0.5)
    return 1e-9 * (params.settling_ns * np.exp(-line / params.settling_rows) + shear)


def delay_s(params: LineJitter, grid: Grid, frame_rows: int, stream: Stream) -> np.ndarray:
    """Delay of every row of a grid in s, shape (n, rows)."""
    total = systematic_s(params, grid.row0[:, None] + np.arange(grid.shape[0]), frame_rows)
    if params.white_ns:
        total = total + 1e-9 * params.white_ns * stream.normal_rows(grid)
    if params.loop_ns:
        total = total + 1e-9 * params.loop_ns * alike_rows(stream, grid, params.loop_rows, params.stride, draw=1)
    return total


def forward(params: LineJitter, signal: Signal, stream: Stream) -> Signal:
    """Delay every row."""
    if not (params.white_ns or params.loop_ns or params.settling_ns or params.shear_ns):
        return signal
    frame_rows = signal.frame_shape[0]
    return signal.with_line(signal.own_line.delayed(lambda grid: delay_s(params, grid, frame_rows, stream)))


def truth(params: LineJitter, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Shift of every row in pixels, shape (n, rows)."""
    return {"row_shift_px": delay_s(params, signal.grid, signal.frame_shape[0], stream) * signal.clock.pixel_hz}


def near(params: LineJitter, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels by which a row may be shifted, to either side."""
    worst = 7 * np.hypot(params.white_ns, params.loop_ns) + abs(params.settling_ns) + abs(params.shear_ns)
    reach = int(np.ceil(worst * 1e-9 * pixel_hz))
    return 0, 0, reach, reach


def tail(params: LineJitter, pixel_hz: float, row_px: int) -> float:
    """Nothing comes from farther away (a normal number beyond 6.8 standard deviations is not drawn)."""
    return 0.0


def measure(observations: Observations) -> Estimates:
    """Read what all upright lines of a row have in common: independent part, loop and settling, from px to ns by the pixel clock."""
    if observations.stated.interface == "digital":
        raise MeasureError("the camera is digital: no frame grabber samples its lines", where="grabber.line_jitter")
    names = {"white": "white_ns", "loop": "loop_ns", "settling": "settling_ns"}
    kept = ("loop_rows", "settling_rows", "interlaced")
    found = observations.row_jitter({f"{n}_px": f"{n}_px" for n in names} | {n: n for n in kept}, where="grabber.line_jitter")
    clock = observations.sample_clock_mhz
    line = None if observations.edges is None else observations.edges.line
    gain, why = (1.0, UNKNOWN_GAIN_REL), UNTOLD_GAIN
    if line is not None and "row_gain" in line:
        gain, why = (line["row_gain"].value, line["row_gain"].u), f"rows move by {line['row_gain'].value:.2f} of their delay, by the edges"
    told = delays_ns(found, names, clock, where="grabber.line_jitter", gain=gain)
    if "white_ns" in told:
        told = replace(told, reasons={**told.reasons, "white_ns": "; ".join(filter(None, (told.reasons.get("white_ns", ""), why)))})
    if clock != observations.stated.pixel_clock_mhz:
        left = told.select([name for name in told.names if not name.startswith("settling")])
        return replace(left, reasons={**left.reasons, "settling_ns": BEAT})
    known = observations.stated.sampling_clock_mhz is not None or observations.area is not None
    return told if known else replace(told, confounders=(*told.confounders, OWN_CLOCK))


def propagate(params: LineJitter, probe: Probe) -> Contribution:
    """Independent and carried-on delays by the answer of the camera's line and of the estimator to the delay of each row.

    The steady part is seen at places down the frame; what a cubic of the row follows of it is smooth.
    """
    (u_x, u_y), (bias_x, bias_y) = from_row_delays(probe, 1e-9 * params.white_ns, 1e-9 * params.loop_ns, params.loop_rows, params.stride)
    dx = dy = smooth_x = np.zeros(1)
    if params.settling_ns or params.shear_ns:
        dx, dy, first = from_steady_delays(probe, lambda rows: systematic_s(params, rows, probe.frame_shape[0]))
        smooth_x = smooth_part(dx, first)
    return Contribution(
        u_x_px=float(np.hypot(u_x, dx.std())), u_y_px=float(np.hypot(u_y, dy.std())), bias_x_px=float(bias_x + dx.mean()),
        bias_y_px=float(bias_y + dy.mean()), gum_class="Tr", model_error=0.15, time_px=(u_x, u_y), smooth_px=(float(smooth_x.std()), 0.0),
        method="response of the estimator, behind the camera's line, to the delay of each row",
    )  # fmt: skip


SOURCE = Source(
    id="grabber.line_jitter",
    title="Line jitter",
    description="The phase-locked loop that follows the line pulses starts each row slightly early or late, most of all after the "
    "vertical interval.",
    number=29,
    stars=1,
    note="Note 19",
    parameters=LineJitter,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics", "cable", "grabber.low_pass"),
    before=("grabber.clamp", "grabber.fixed_pattern", "grabber.phase_pattern", "grabber.window_offset", "grabber.adc", "processing"),
    neutral=LineJitter(),
    typical=LineJitter(white_ns=20.0),
    bound=LineJitter(white_ns=20.0, loop_ns=20.0),
    forward=forward,
    measure=measure,
    truth=truth,
    propagate=propagate,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="Tr",
    equation="δ_r = s_w n_r + s_l a_l + A e^(−l/r_s) + shear,  a_l = ρ a_(l−1) + √(1 − ρ²) n_l,  l the line of the field",
    typical_size="20 ns are 0.284 px at 14.19 MHz; a disc of 7 px moves by 0.376 of the jitter of a row: 0.107 px",
    references=("H. A. Beyer, IAPRS XXIX-B5, 1992, 561 (shear and jitter of line-locked grabbers; below 0.005 px with the pixel clock)",),
    advice="Sample with the camera's pixel clock, or average frames. A digital camera has no line jitter.",
    reasons={
        "correct": "a row that is shifted and a scene that is shifted there look the same: the correction needs a reference in every row "
        "of the same frame. With a straight line beside the targets, `pixmetry corrected --per-image rows` takes the jitter off",
    },
)
