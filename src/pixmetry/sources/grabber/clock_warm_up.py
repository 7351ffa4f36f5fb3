"""Warm-up of the grabber's clock: until it is stable, samples are too close or too far apart, and lines start late."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.line_contribution import held_of
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class ClockWarmUp(Parameters):
    """Errors of a phase-locked sampling clock that die away after it was switched on."""

    scale_error_rel: float = quantity(0.0, "1", "relative error of the frequency when switched on", ge=-0.05, le=0.05)
    scale_tau_s: float = quantity(820.0, "s", "time constant with which this error decreases", gt=1, le=1e6)
    delay_ns: float = quantity(0.0, "ns", "delay of the lines when switched on", ge=-1e4, le=1e4)
    delay_tau_s: float = quantity(820.0, "s", "time constant with which this delay decreases", gt=1, le=1e6)
    lock_us: float = quantity(10.5, "µs", "distance from the point where the clock is locked in each line to the first pixel", ge=0, le=60)
    on_for_s: float = quantity(0.0, "s", "time between switching on and frame 0", ge=0, le=1e8)

    def scale(self, time_s: np.ndarray) -> np.ndarray:
        """Relative error of the frequency at times of the sequence, δ0 e^(−t/τ)."""
        return self.scale_error_rel * np.exp(-(np.asarray(time_s, float) + self.on_for_s) / self.scale_tau_s)

    def late_s(self, time_s: np.ndarray) -> np.ndarray:
        """Delay at times of the sequence, d0 e^(−t/τ2)."""
        return self.delay_ns * 1e-9 * np.exp(-(np.asarray(time_s, float) + self.on_for_s) / self.delay_tau_s)


def shift_s(params: ClockWarmUp, at_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """How much later than they should the contents of a line are seen at a time within it, counted from its first pixel.

    A clock of frequency f(1 + δ), locked at −c0, takes the sample meant for t at (t + c0)/(1 + δ) − c0; so what is seen there comes
    (t + c0) δ/(1 + δ) late.
    """
    scale = params.scale(time_s)
    shift: Array = (at_s + params.lock_us * 1e-6) * scale / (1 + scale) + params.late_s(time_s)
    return shift


def forward(params: ClockWarmUp, signal: Signal, stream: Stream) -> Signal:
    """Sample at the times of the clock as it is then."""
    if params.scale_error_rel == 0 and params.delay_ns == 0:
        return signal
    time_s = signal.time_s[:, None, None]
    return signal.with_line(signal.own_line.warped(lambda at_s: shift_s(params, at_s, time_s)))


def truth(params: ClockWarmUp, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Shift of every column in pixels, shape (n, cols), and that of the rows in their middle, shape (n, rows)."""
    at_s = (np.arange(signal.frame_shape[1]) + 0.5) / signal.clock.pixel_hz
    columns = shift_s(params, at_s, signal.time_s[:, None]) * signal.clock.pixel_hz
    rows = np.repeat(0.5 * (columns[:, :1] + columns[:, -1:]), signal.frame_shape[0], axis=1)
    return {"col_shift_px": columns, "row_shift_px": rows}


def near(params: ClockWarmUp, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels by which a sample at the end of the row may look elsewhere, to either side."""
    late, scale = params.lock_us * 1e-6 + row_px / pixel_hz, abs(params.scale_error_rel)
    reach = int(np.ceil((late * scale / (1 - scale) + abs(params.delay_ns) * 1e-9) * pixel_hz))
    return 0, 0, reach, reach


def tail(params: ClockWarmUp, pixel_hz: float, row_px: int) -> float:
    """Nothing comes from farther away."""
    return 0.0


def propagate(params: ClockWarmUp, probe: Probe) -> Contribution:
    """The shift in frame 0: its mean over all samples of a row, and its scatter over them."""
    line, cols = held_of(probe).line, probe.frame_shape[1]
    at_s = line.start_s + (np.arange(line.samples or cols) + 0.5) / line.sample_clock_hz
    shift = shift_s(params, at_s[(at_s > 0) & (at_s < cols / probe.pixel_clock_hz)], np.zeros(1)) * probe.pixel_clock_hz
    return Contribution(
        u_x_px=float(shift.std()), u_y_px=0.0, bias_x_px=float(shift.mean()), gum_class="D", model_error=0.15, floor_px=0.01,
        method="shift of the samples in frame 0 over all columns",
    )  # fmt: skip


def measure(observations: Observations) -> Estimates:
    """Error and delay of the clock when switched on: from a series of a fixed field, in which camera and grabber warm up together; without
    one, from the x-scales of the images of a calibration, whose poses take up the delay."""
    if observations.drift is None and observations.geometry is not None and not observations.failed.get("series"):
        return observations.by_residuals(where="grabber.clock_warm_up")
    names = ("scale_error_rel", "scale_tau_s", "delay_ns", "delay_tau_s")
    fit, names_of = None if observations.drift is None else observations.drift.fit, {name: name for name in names}
    return of_pictures(
        fit,
        names_of,
        where="grabber.clock_warm_up",
        pictures="a series of a fixed field",
        kind="series",
        failed=observations.failed.get("series", ""),
    )


SOURCE = Source(
    id="grabber.clock_warm_up",
    title="Warm-up of the frame grabber",
    description="Until it is warm, the sampling clock has another frequency and starts late: rows are stretched and shifted.",
    number=31,
    stars=5,
    note="Note 1",
    parameters=ClockWarmUp,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics", "cable", "grabber.low_pass"),
    before=("grabber.clamp", "grabber.fixed_pattern", "grabber.phase_pattern", "grabber.window_offset", "grabber.adc", "processing"),
    neutral=ClockWarmUp(),
    typical=ClockWarmUp(scale_error_rel=0.0071),
    bound=ClockWarmUp(scale_error_rel=0.0071, delay_ns=20.0),
    forward=forward,
    measure=measure,
    truth=truth,
    propagate=propagate,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    gum_class="D",
    equation="Δx = (x + c0) δ/(1 + δ) + d f_pixel,  δ = δ0 e^(−t/τ),  d = d0 e^(−t/τ2)",
    typical_size="4 px RMS when switched on, for δ0 = 0.71 % locked 149 px before the first pixel; 0.05 px after 60 min at τ = 13.7 min",
    references=("H. A. Beyer, IAPRS XXIX-B5, 1992, 561 (line-start lock of frame grabbers)",),
    advice="Wait 90 minutes, or sample with the camera's pixel clock. Otherwise estimate a scale along the row for every image.",
    reasons={
        "correct": "it moves points along the rows, and resampling frames would correlate the noise of neighbours. The targets of an "
        "image give its scale: coordinates are corrected instead (`pixmetry corrected --per-image scale`)",
    },
)
