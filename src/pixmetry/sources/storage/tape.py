"""Video tape between camera and grabber: less bandwidth, lines that come early or late, noise that rises with frequency, dropouts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe, smooth_part
from pixmetry.camera.line import Line, alike_rows, group_delay_s, reach_px
from pixmetry.camera.line_contribution import from_row_delays, from_steady_delays, held_of, through_line
from pixmetry.camera.observations import Observations
from pixmetry.camera.recordings import Recordings
from pixmetry.camera.row_delays import added_delays, delays_ns
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

SHARE_BEYOND = 1e-4  # of a step, beyond the near context
CONFOUNDERS = (
    "the number of copies: their errors grow with its root, and only what all of them add is told",
    "filters of the frame grabber behind the tape, which take part of its noise",
)
UNFILTERED_U_REL = 0.25  # of the shift of rows in the direct frames: that behind an amplifier of 8 MHz
PERIODS = 6  # of the bandwidth, to either side, over which the noise is alike
BESSEL_3 = np.array([-1.32267580, -1.04740916 + 0.99926444j, -1.04740916 - 0.99926444j])  # poles for −3 dB at 1 rad/s


class Tape(Parameters):
    """One recorder, and how often its picture was copied; times are those after a time-base corrector, if there is one."""

    generations: int = quantity(0, "1", "number of successive recordings; 0: no tape", ge=0, le=10)
    bandwidth_mhz: float = quantity(3.0, "MHz", "frequency of −3 dB of the luminance, 3 for VHS, 5 for S-VHS", ge=0.5, le=50)
    noise_dn: float = quantity(0.0, "DN", "standard deviation of the noise, which rises with frequency up to the bandwidth", ge=0, le=1e3)
    white_ns: float = quantity(0.0, "ns", "time-base error that is independent from line to line, standard deviation", ge=0, le=1000)
    wow_ns: float = quantity(0.0, "ns", "time-base error that is correlated from line to line, standard deviation", ge=0, le=1000)
    wow_rows: float = quantity(20.0, "rows", "number of lines of a field over which this correlation falls to 1/e", ge=0.2, le=60)
    head_switch_ns: float = quantity(0.0, "ns", "step of the time base where the heads switch", ge=-5000, le=5000)
    head_switch_rows: int = quantity(6, "rows", "number of lines from there to the end of the field", ge=0, le=100)
    dropouts: float = quantity(0.0, "1", "mean number of dropouts in a frame", ge=0, le=1e4)
    dropout_us: float = quantity(5.0, "µs", "duration of each", gt=0, le=50)
    compensated: bool = quantity(True, "1", "whether a dropout is filled from the previous line, or black")

    @property
    def poles(self) -> np.ndarray:
        """Of the luminance channel, in rad/s: a Bessel filter of third order for each generation."""
        return np.tile(2e6 * np.pi * self.bandwidth_mhz * BESSEL_3, self.generations)

    @property
    def grown(self) -> float:
        """What copying does to errors that are independent from generation to generation."""
        return float(np.sqrt(self.generations))


def delay_s(params: Tape, grid: Grid, frame_rows: int, stream: Stream) -> np.ndarray:
    """Time-base error of every row of a grid in s, shape (n, rows)."""
    total = steady_s(params, grid.row0[:, None] + np.arange(grid.shape[0]), frame_rows)
    if params.white_ns:
        total = total + 1e-9 * params.grown * params.white_ns * stream.normal_rows(grid)
    if params.wow_ns:
        total = total + 1e-9 * params.grown * params.wow_ns * alike_rows(stream, grid, params.wow_rows, 2, draw=1)
    return total


def steady_s(params: Tape, rows: np.ndarray, frame_rows: int) -> np.ndarray:
    """The step where the heads change, before the end of each field."""
    switched = np.asarray(rows) // 2 >= (frame_rows + 1) // 2 - params.head_switch_rows
    return 1e-9 * params.head_switch_ns * params.generations * switched


@lru_cache(maxsize=32)
def _taps(bandwidth_hz: float, sample_hz: float, filters: tuple[tuple[bytes, bytes], ...]) -> np.ndarray:
    """Weights of a moving sum over samples that gives white numbers the spectrum f |H(f)| up to the bandwidth.

    Their variance is 1 for H = 1: w_k ∝ ∫ f |H(f)| sin(2πfk/f_s) df, rounded off at the ends (von Hann).
    """
    f = (np.arange(2000) + 0.5) / 2000 * bandwidth_hz
    line = Line(1.0, 1.0, tuple((np.frombuffer(z, complex), np.frombuffer(p, complex)) for z, p in filters))
    most = int(np.ceil(PERIODS * sample_hz / bandwidth_hz))
    k = np.arange(-most, most + 1)
    wave = np.sin(2 * np.pi * f[:, None] * k / sample_hz) * np.cos(0.5 * np.pi * k / (most + 1)) ** 2
    plain, seen = (np.asarray(w @ wave) for w in (f, f * line.gain(f)))
    taps: Array = seen / np.sqrt((plain**2).sum())
    return taps


def noise_dn(params: Tape, grid: Grid, line: Line, behind: int, stream: Stream) -> np.ndarray:
    """FM noise in the samples of a grid, after the filters of the line that come behind the tape."""
    filters = tuple((z.tobytes(), p.tobytes()) for z, p in line.filters[behind:])
    taps = _taps(params.bandwidth_mhz * 1e6, line.sample_clock_hz, filters)
    rows, cols = grid.shape
    white = stream.normal(Grid(grid.frame, grid.row0, grid.col0 - len(taps) // 2, (rows, cols + len(taps) - 1)), draw=2)
    total = np.zeros(grid.size, np.float32)
    for j, weight in enumerate(params.noise_dn * params.grown * taps):
        if weight:
            total += np.float32(weight) * white[:, :, j : j + cols]
    return total


def dropout_mask(params: Tape, signal: Signal, stream: Stream) -> np.ndarray:
    """Where the signal was lost, shape (n, rows, cols), bool; at most one dropout a line."""
    grid = signal.grid
    at_zero = Grid(grid.frame, grid.row0, np.zeros_like(grid.col0), (signal.data.shape[1], 2))
    lot = stream.uniform(at_zero)
    hit = lot[:, :, 0] < -np.expm1(-params.dropouts * params.generations / signal.frame_shape[0])
    begin = lot[:, :, 1] * signal.frame_shape[1]
    end = begin + params.dropout_us * 1e-6 * signal.clock.pixel_hz
    cols = signal.cols[:, None, :]
    lost: Flags = hit[:, :, None] & (cols >= begin[:, :, None]) & (cols < end[:, :, None])
    return lost


def _with_dropouts(params: Tape, signal: Signal, stream: Stream) -> np.ndarray:
    """Pixels with those lost filled from two rows above, the line before in the field; black where there is none."""
    lost = dropout_mask(params, signal, stream)
    filled = np.zeros_like(signal.data)
    if params.compensated and signal.data.shape[1] > 2:
        filled[:, 2:] = signal.data[:, :-2]
    return np.where(lost, filled, signal.data)


def forward(params: Tape, signal: Signal, stream: Stream) -> Signal:
    """Record and play: dropouts, bandwidth, time base and noise. What delays picture and line pulses alike does not show."""
    if params.generations == 0:
        return signal
    frame_rows, line = signal.frame_shape[0], signal.own_line
    common = group_delay_s([], params.poles)
    behind = len(line.filters) + 1
    line = line.filtered([], params.poles).delayed(lambda grid: delay_s(params, grid, frame_rows, stream) - common)
    if params.noise_dn:
        line = line.with_noise(lambda grid, read: noise_dn(params, grid, read, behind, stream))
    if params.dropouts and not stream.quiet:
        signal = signal.with_data(_with_dropouts(params, signal, stream))
    return signal.with_line(line)


def truth(params: Tape, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Shift of every row in pixels, shape (n, rows), and the pixels lost, shape (n, rows, cols)."""
    shift = delay_s(params, signal.grid, signal.frame_shape[0], stream) * signal.clock.pixel_hz
    return {"row_shift_px": shift, "dropouts": dropout_mask(params, signal, stream)}


def context(params: Tape, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Two rows above, where dropouts are filled from."""
    fills = params.generations and params.dropouts and params.compensated
    return windows.expand(2, 0, 0, 0, frame_shape) if fills else windows


def near(params: Tape, pixel_hz: float, row_px: int) -> tuple[int, int, int, int]:
    """Pixels that reach a sample, with the time-base error to either side."""
    if params.generations == 0:
        return 0, 0, 0, 0
    spread = 7 * params.grown * np.hypot(params.white_ns, params.wow_ns) + params.generations * abs(params.head_switch_ns)
    moved = int(np.ceil((spread * 1e-9 + group_delay_s([], params.poles)) * pixel_hz))
    return 2, 0, reach_px([], params.poles, SHARE_BEYOND, pixel_hz) + moved, moved


def tail(params: Tape, pixel_hz: float, row_px: int) -> float:
    """What is left of a step there."""
    return SHARE_BEYOND if params.generations else 0.0


def measure(observations: Observations) -> Estimates:
    """What one scene, or the rows of upright lines, show more when they were played from tape than when they came directly.

    Of one recording: copies of copies add to it, and what is told stands for all of them.
    """
    if observations.recordings is not None:
        return _by_recordings(observations, observations.recordings)
    names = {"white_px": "white_px", "loop_px": "loop_px", "loop_rows": "loop_rows"}
    played = observations.row_jitter(names, where="storage.tape", taped=True)
    if observations.lines is None or not len(observations.lines.jitter):
        remedy = "take the same lines directly, without the recorder"
        raise MeasureError(
            "not separable from grabber.line_jitter: the lines were played from tape only", where="storage.tape", remedy=remedy
        )
    added = added_delays(played, observations.lines.jitter, where="storage.tape")
    return delays_ns(
        added, {"white": "white_ns", "loop": "wow_ns", "loop_rows": "wow_rows"}, observations.sample_clock_mhz, where="storage.tape"
    )


def _by_recordings(observations: Observations, seen: Recordings) -> Estimates:
    """Bandwidth, noise, time base and step of the heads, by a scene seen directly and recorded."""
    where, clock = "storage.tape", observations.sample_clock_mhz
    found = observations.recorder(
        {"bandwidth_mhz": "bandwidth_rel", "noise_dn": "noise_dn", "head_switch_ns": "head_switch_px"},
        where=where,
        settings=["head_switch_rows"],
    )
    if clock is None:
        raise MeasureError("told in pixels; a tape needs the clock", where=where, remedy="state pixel_clock_mhz in the manifest")
    factors = {"bandwidth_mhz": (clock, "MHz"), "head_switch_ns": (1e3 / clock, "ns")}
    found = found.scaled({name: factor for name, factor in factors.items() if name in found})
    jitter = Estimates.empty()
    if "white_px" in seen.played and "white_px" in seen.direct:
        # direct rows are moved by a quarter more or less than their delay (row_delays.GAIN_REL)
        doubt = np.diag([(UNFILTERED_U_REL * n.value) ** 2 if n.unit == "px" else 0.0 for n in seen.direct])
        added = added_delays(seen.played, replace(seen.direct, covariance=seen.direct.covariance + doubt), where=where)
        jitter = delays_ns(added, {"white": "white_ns", "loop": "wow_ns", "loop_rows": "wow_rows"}, clock, where=where)
    return replace(found.join(jitter), settings={**found.settings, "generations": 1}, confounders=CONFOUNDERS)


def propagate(params: Tape, probe: Probe) -> Contribution:
    """Noise with its spectrum (P1), delays of the rows behind the bandwidth, and its smear; the heads' step at places down the frame."""
    if params.generations == 0:
        return Contribution(u_x_px=0.0, u_y_px=0.0, gum_class="Tr", method="no tape")
    held = held_of(probe)
    common = group_delay_s([], params.poles)

    def band(line: Line) -> Line:
        return line.filtered([], params.poles).delayed(np.full((1, 1), -common))

    smear = through_line(probe, band)
    behind = tuple((z.tobytes(), p.tobytes()) for z, p in held.line.filters[held.ahead :])
    taps = _taps(params.bandwidth_mhz * 1e6, held.line.sample_clock_hz, behind) * params.noise_dn * params.grown
    noise = [float(np.sqrt((np.apply_along_axis(np.convolve, 2, g, taps) ** 2).sum(axis=(1, 2)).mean())) for g in (held.gx, held.gy)]
    played = replace(probe, held=replace(held, line=band(held.line)))
    late = 1e-9 * params.grown
    rows, late_px = from_row_delays(played, late * params.white_ns, late * params.wow_ns, params.wow_rows, 2)
    step, _, first = from_steady_delays(played, lambda rows: steady_s(params, rows, probe.frame_shape[0]))
    smooth = smooth_part(step, first)
    time = float(np.hypot(noise[0], rows[0])), float(np.hypot(noise[1], rows[1]))
    return Contribution(
        u_x_px=float(np.sqrt(time[0] ** 2 + step.var() + smear.u_x_px**2)), u_y_px=float(np.hypot(time[1], smear.u_y_px)),
        bias_x_px=smear.bias_x_px + float(step.mean()) + late_px[0], bias_y_px=smear.bias_y_px + late_px[1],
        gum_class="Tr", model_error=0.4, time_px=time,
        smooth_px=(float(smooth.std()), 0.0),
        method="noise with the tape's spectrum, delays of the rows, and the target with limited bandwidth; dropouts are outliers and "
        "not included",
    )  # fmt: skip


SOURCE = Source(
    id="storage.tape",
    title="Video tape",
    description="A video recorder in front of the grabber limits the bandwidth, shifts lines in time, adds noise, and loses parts of "
    "lines.",
    number=36,
    stars=3,
    note="Note 7",
    parameters=Tape,
    consumes=(Kind.VIDEO,),
    after=("sensor", "electronics", "cable"),
    before=("grabber", "processing"),
    neutral=Tape(),
    typical=Tape(generations=1, bandwidth_mhz=3.0, noise_dn=3.0, white_ns=7.0, wow_ns=5.0, head_switch_ns=100.0),
    bound=Tape(generations=2, bandwidth_mhz=3.0, noise_dn=4.0, white_ns=14.0, wow_ns=14.0, head_switch_ns=100.0),
    forward=forward,
    measure=measure,
    truth=truth,
    propagate=propagate,
    context=context,
    near=near,
    tail=tail,
    applies_to=("analogue",),
    option="a video tape recorder",
    gum_class="Tr",
    equation="y' = (h ∗ y)(t − δ_r) + n,  S_n(f) ∝ f² up to B,  δ_r = s_w n_r + s_l a_l + step;  variances × generations",
    typical_size="errors of 0.04 px grow by 1.4 (3 DN, 0.1 px) to 2.2 times (4 DN, 0.2 px); correlated errors of neighbouring lines are "
    "worse",
    references=(
        "M. R. Shortis, W. L. Snow, B. A. Childers, W. K. Goad, SPIE 2067, 1993 (storage media in digital photogrammetry)",
        "J. Chen, S. Robson et al., IAPRS XXXI-B5, 1996, 84 (S-VHS: up to 0.5 px, four times the direct error)",
    ),
    advice="Digitise directly, not from tape. Otherwise play the tape on the recorder that recorded it, through a time-base corrector.",
    reasons={
        "correct": "a line that the tape shifted and a scene that is shifted there look the same: the correction needs a reference in "
        "every line of the same frame. With a straight line beside the targets, `pixmetry corrected --per-image rows` takes the jitter off",
    },
)
