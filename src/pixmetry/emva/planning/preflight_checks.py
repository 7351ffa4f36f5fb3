"""The checks of a preflight on levels, codes, light, noise and pixels, each a function of the reduced frames.

A check that rests on noise speaks only where the value is beyond its limit by more than chance brings about once in a million good cameras.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.finding import ERROR, NOTE, WARNING, Finding
from pixmetry.core.number import Number
from pixmetry.emva.files.keys import MINIMUM_DARK_VAR_DN2, SATURATED_FRACTION, UNDERFLOW_FRACTION
from pixmetry.observe.moments import LevelAccumulator, MeanSquares, check_frame
from pixmetry.observe.surface import Surface, cross_strata, fill, fit_surface

BLOCK = 8  # pixels: side of a JPEG block


@dataclass(frozen=True)
class Group:
    """Frames of one condition, reduced."""

    exposure_s: float | None
    photons: float | None
    bits: int
    n_frames: int
    mean_map_dn: np.ndarray  # shape (rows, cols)
    squares: MeanSquares  # temporal
    counts: np.ndarray  # of each code, over all frames, shape (2**bits,)
    frame_means_dn: np.ndarray  # shape (frames,)
    row_profiles_dn: np.ndarray  # mean of each row of each frame, shape (frames, rows)
    repeated: int  # frames that are the same as an earlier one, bit for bit
    follow_ratio: float  # variance of differences of neighbours over that of frames two apart; nan with fewer than three frames
    steps_x_dn2: np.ndarray  # mean square step of the first frame difference from one column to the next, shape (cols - 1,)
    steps_y_dn2: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.mean_map_dn.shape

    @property
    def mean_dn(self) -> float:
        """Mean of all frames."""
        return float(self.frame_means_dn.mean())

    def share(self, code: int) -> float:
        """Share of the pixels with this code."""
        return float(self.counts[code] / self.counts.sum())

    @property
    def mean_noise_dn2(self) -> float:
        """Variance of a frame's mean from the noise of pixels, rows and columns alone."""
        rows, cols = self.shape
        return self.squares.row_dn2 / rows + self.squares.col_dn2 / cols - self.squares.pixel_dn2 / (rows * cols)


def reduce_frames(
    frames: Iterable[np.ndarray], bits: int, exposure_s: float | None = None, photons: float | None = None, what: str = "frames"
) -> Group:
    """Reduce the frames of one condition; three of them are in memory at a time.

    Raises
    ------
    InputError
        Fewer than two frames, frames of different shapes, or codes above the stated bits.
    """
    moments, seen, profiles = LevelAccumulator(bits), set(), []
    recent: list[np.ndarray] = []
    steps = (np.zeros(0), np.zeros(0))
    near, far = [], []
    for frame in frames:
        frame = check_frame(frame, bits)
        moments.add(frame)
        seen.add(hashlib.blake2b(frame.tobytes(), digest_size=16).digest())
        profiles.append(frame.mean(axis=1))
        signed = frame.astype(np.int32)
        if recent:
            near.append(_difference_var(signed, recent[-1]))
        if len(recent) == 1:
            steps = _steps(signed - recent[0])
        if len(recent) == 2:
            far.append(_difference_var(signed, recent[0]))
        recent = [*recent[-1:], signed]
    if len(profiles) < 2:
        raise InputError(
            "too few frames", where=what, value=len(profiles), allowed="2 or more, better 4", remedy="take more frames under one condition"
        )
    return Group(
        exposure_s=exposure_s,
        photons=photons,
        bits=bits,
        n_frames=moments.n_frames,
        mean_map_dn=moments.mean_map_dn(),
        squares=moments.mean_squares(),
        counts=moments.counts,
        frame_means_dn=moments.frame_means_dn(),
        row_profiles_dn=np.array(profiles),
        repeated=len(profiles) - len(seen),
        follow_ratio=float(np.mean(near) / np.mean(far)) if far and np.mean(far) > 0 else float("nan"),
        steps_x_dn2=steps[0],
        steps_y_dn2=steps[1],
    )


def _difference_var(one: np.ndarray, other: np.ndarray) -> float:
    return float((one - other).var())


def _steps(difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along_x, along_y = np.diff(difference, axis=1).astype(float), np.diff(difference, axis=0).astype(float)
    return (along_x**2).mean(axis=0), (along_y**2).mean(axis=1)


FALSE_ALARM = 1e-6  # of one check
Z = 4.76  # the normal distribution is beyond it, on one side, with that probability
NAN = math.nan
LEVEL_OF = {"not judged": NOTE, "warn": WARNING, "fail": ERROR}


@dataclass(frozen=True)
class Check:
    """One thing looked at. ``verdict``: ok, warn (the test will be worse), fail (it will be wrong), or not judged, with the reason."""

    name: str
    title: str
    value: float
    u: float
    unit: str
    limit: str
    verdict: str
    reason: str = ""
    remedy: str = ""

    @property
    def finding(self) -> Finding | None:
        """What was found; None where all is well."""
        if self.verdict == "ok":
            return None
        number = Number(self.value, self.u, unit=self.unit or "1")
        return Finding(self.name, f"{self.title}: {self.reason}", self.remedy, LEVEL_OF[self.verdict], {self.name: number})


@dataclass(frozen=True)
class Frames:
    """The dark group and the bright ones by rising mean."""

    dark: Group
    bright: tuple[Group, ...]

    @property
    def top_dn(self) -> float:
        """Mean at saturation: the highest code, or the brightest level where the noise there tells that the pixels are full."""
        full = float(2**self.dark.bits - 1)
        return min(self.bright[-1].mean_dn, full) if self._quiet(self.bright[-1]) else full

    @property
    def unsaturated(self) -> tuple[Group, ...]:
        """Bright levels below saturation by their codes and by their noise."""
        levels = (g for g in self.bright if g.share(2**g.bits - 1) <= SATURATED_FRACTION and not self._quiet(g))
        return tuple(g for g in levels if g.mean_dn > self.dark.mean_dn)

    def _quiet(self, group: Group) -> bool:
        """Whether a level has lost more than half of the noise that a darker one has: its pixels are full."""
        noise = max(g.squares.pixel_dn2 for g in self.bright if g.mean_dn <= group.mean_dn)
        return group.squares.pixel_dn2 < 0.5 * noise


def new_check(name: str, title: str, unit: str, limit: str) -> Callable[..., Check]:
    """A maker of checks: value, u, verdict, and reason and remedy, which are left out where all is well."""

    def make(value: float, u: float = NAN, verdict: str = "ok", reason: str = "", remedy: str = "") -> Check:
        told = (reason, remedy) if verdict != "ok" else ("", "")
        return Check(name, title, float(value), float(u), unit, limit, verdict, *told)

    return make


def beyond(value: float, u: float, warn: float, fail: float) -> str:
    least = value - Z * u
    return "fail" if least > fail else "warn" if least > warn else "ok"


def level_text(group: Group) -> str:
    return f"at the level with mean {group.mean_dn:.4g} DN"


def check_underflow(frames: Frames) -> Check:
    """Pixels at the lowest code in the dark (R4.0 6.5)."""
    make = new_check("underflow", "dark pixels at the lowest code", "%", "at most 0.5 %")
    share = frames.dark.share(0)
    u = math.sqrt(share * (1 - share) / frames.dark.mean_map_dn.size)  # a pattern may hold the same pixels down in every frame
    reason = "the dark signal is cut off at the lowest code: dark mean, dark noise and DSNU would be wrong"
    return make(100 * share, 100 * u, "fail" if share - Z * u > UNDERFLOW_FRACTION else "ok", reason, "Raise the black level (offset)")


def check_exchanged(frames: Frames) -> Check:
    """Bright frames that are darker than the dark ones, by more than the noise of a pixel."""
    make = new_check("bright_above_dark", "brightest level above the dark mean", "DN", "above 0 DN")
    brightest, dark = frames.bright[-1], frames.dark
    value = brightest.mean_dn - dark.mean_dn
    u = math.sqrt(brightest.squares.frame_dn2 / brightest.n_frames + dark.squares.frame_dn2 / dark.n_frames)
    verdict = "fail" if value < -math.sqrt(dark.squares.total_dn2) else "ok"
    return make(value, u, verdict, "bright frames are darker than the dark ones", "Check whether bright and dark frames are exchanged")


def check_black_level(frames: Frames) -> Check:
    """Distance of the dark mean from the lowest code, in standard deviations of all dark values."""
    make = new_check("black_level", "dark mean above the lowest code", "σ", "at least 3 σ")
    image = frames.dark.mean_map_dn
    spread = 1.4826 * float(np.median(np.abs(image - np.median(image))))
    sigma = math.hypot(math.sqrt(frames.dark.squares.total_dn2), spread)
    if sigma == 0:
        return make(NAN, NAN, "not judged", "the dark frames have no noise")
    value = frames.dark.mean_dn / sigma
    reason = "noise and pattern reach the lowest code"
    return make(value, value / math.sqrt(2 * image.size), "warn" if value < 3 else "ok", reason, "Raise the black level (offset)")


def check_saturation(frames: Frames) -> Check:
    """Pixels at the highest code; of several levels the brightest may saturate (R4.0 6.6)."""
    make = new_check("saturation", "bright pixels at the highest code", "%", "at most 0.2 %")
    levels = frames.bright[:-1] or frames.bright
    worst = max(levels, key=lambda g: g.share(2**g.bits - 1))
    share = worst.share(2**worst.bits - 1)
    u = math.sqrt(share * (1 - share) / worst.mean_map_dn.size)
    verdict = "fail" if share - Z * u > SATURATED_FRACTION else "ok"
    return make(100 * share, 100 * u, verdict, f"pixels saturate {level_text(worst)}", "Shorten the exposure or reduce the light")


def check_range(frames: Frames) -> Check:
    """Does one level lie near half of the range, do several reach saturation?"""
    brightest, full = frames.bright[-1], 2**frames.dark.bits - 1
    share = (brightest.mean_dn - frames.dark.mean_dn) / max(full - frames.dark.mean_dn, 1.0)
    if len(frames.bright) == 1:
        make = new_check("range", "signal of the bright level over the range", "%", "20 to 80 %")
        reason = "the level is far from half of saturation, where the stack is taken"
        return make(100 * share, NAN, "ok" if 0.2 <= share <= 0.8 else "warn", reason, "Change exposure or light")
    make = new_check("range", "signal of the brightest level over the range", "%", "to saturation")
    full_well = frames.top_dn < full
    verdict = "ok" if brightest.share(full) > SATURATED_FRACTION or full_well else "warn"
    remedy = "Raise exposure or light until the brightest level saturates, and lower the camera's gain if it cannot"
    return make(100 * share, NAN, verdict, "the levels do not reach saturation, so capacity and linearity cannot be measured", remedy)


def check_code_step(frames: Frames) -> Check:
    """Common divisor of the distances of all codes that occur: more than 1 where data are shifted to the left."""
    make = new_check("code_step", "step between the codes that occur", "DN", "1 DN")
    codes = np.flatnonzero(frames.dark.counts + sum(g.counts for g in frames.bright))
    if codes.size < 4:
        return make(NAN, NAN, "not judged", "fewer than four codes occur")
    step = int(np.gcd.reduce(np.diff(codes)))
    shift = step.bit_length() - 1
    shifted = f"Shift the codes right by {shift} and state {frames.dark.bits - shift} bits"
    reason = f"only one of every {step} codes occurs: the stored bits are not those of the converter"
    return make(step, 0.0, "fail" if step > 1 else "ok", reason, shifted if step == 2**shift else "Switch digital gain off")


def check_top_code(frames: Frames) -> Check:
    """A heap at the largest code that occurs, below the highest code of the stated bits."""
    make = new_check("top_code", "largest code that occurs", "DN", "no pile-up below the highest code")
    group = frames.bright[-1]
    occupied = np.flatnonzero(group.counts)
    top, full = int(occupied[-1]), 2**group.bits - 1
    # noise of a standard deviation of a code or more thins out towards its largest value; a heap there means that codes end
    if occupied.size >= 6:
        heap = group.share(top) > SATURATED_FRACTION and group.counts[top] > 2 * group.counts[occupied[-2]]
    else:
        heap = group.share(top) > 0.5 and any(np.count_nonzero(g.counts) >= 6 for g in frames.bright[:-1])
    bits = (top + 1).bit_length() - (1 if (top + 1) & top == 0 else 0)
    reason = f"the codes end at {top}, not at {full}: fewer bits are used, or the camera clips before its converter does"
    return make(top, 0.0, "fail" if heap and top < full else "ok", reason, f"State {bits} bits if that is what the camera delivers")


def check_codes(frames: Frames) -> Check:
    """Codes left out, or much more frequent than both neighbours: noise alone makes one smooth heap in each frame of even light."""
    make = new_check("codes", "missing or doubled codes", "%", "none")
    odd, covered = 0, 0
    for g in (frames.dark, *frames.bright):
        step = max(int(np.gcd.reduce(np.diff(np.flatnonzero(g.counts)))) if np.count_nonzero(g.counts) > 1 else 1, 1)
        first = int(np.flatnonzero(g.counts)[0])
        n = g.counts[first::step][:-1].astype(float)  # the highest code holds what saturates
        if g.squares.pixel_dn2 < 1.0 * step**2 or n.size < 5:
            continue
        below, here, above = n[:-2], n[1:-1], n[2:]
        least, most = np.minimum(below, above), np.maximum(below, above)
        # a log-concave density has n ≥ min(neighbours); P(0 | 30) = 1e-13
        missing = (here == 0) & (least > 30)
        doubled = (here > 1.4 * most + 6 * np.sqrt(here + 2.0 * most)) & (most > 30)
        odd += int(missing.sum()) + max(int(doubled.sum()) - 1, 0)  # one may be the top of the heap
        covered += int((here + least > 30).sum())
    if covered == 0:
        return make(NAN, NAN, "not judged", "the noise is too small to cover neighbouring codes evenly")
    reason = (
        f"{odd} of {covered} codes are missing or doubled: a digital gain or a look-up table stretches them, or the converter has "
        "missing codes"
    )
    remedy = "Switch digital gain, gamma and look-up tables off; use all bits of the converter"
    return make(100 * odd / covered, NAN, "warn" if odd else "ok", reason, remedy)


def check_repeated(frames: Frames) -> Check:
    """Frames that are the same bit for bit."""
    make = new_check("repeated_frames", "frames that repeat another", "", "none")
    # frames that are saturated all over are the same by nature
    repeated = sum(g.repeated for g in (frames.dark, *frames.bright) if g.share(2**g.bits - 1) <= SATURATED_FRACTION)
    reason = "the same frame was stored more than once: a frame compared with itself has no noise"
    remedy = "Wait for a new frame before each one is stored; switch test patterns off"
    return make(repeated, 0.0, "fail" if repeated else "ok", reason, remedy)


def check_independent(frames: Frames) -> Check:
    """Noise of successive frames: alike where the camera or the grabber averages."""
    make = new_check("independent_frames", "noise of successive over distant frames", "", "1")
    groups = [g for g in (frames.dark, *frames.bright) if math.isfinite(g.follow_ratio)]
    if not groups:
        return make(NAN, NAN, "not judged", "three frames or more under one condition are needed")
    worst = min(groups, key=lambda g: g.follow_ratio)
    rows, cols = worst.shape
    s = worst.squares
    # relative scatter of a variance over its strata; four times for the difference of two that share frames
    scatter = 2 * (rows * cols * s.pixel_dn2**2 + rows * (cols * s.row_dn2) ** 2 + cols * (rows * s.col_dn2) ** 2) / (rows * cols) ** 2
    u = 2 * math.sqrt(scatter) / s.total_dn2 if s.total_dn2 > 0 else NAN
    verdict = "fail" if worst.follow_ratio < 0.98 - Z * u * math.sqrt(len(groups)) else "ok"
    return make(worst.follow_ratio, u, verdict, "frames are averaged with earlier frames", "Switch temporal filters and averaging off")


def check_dark_noise(frames: Frames) -> Check:
    """Temporal variance in the dark (R4.0 eq. 54)."""
    make = new_check("dark_noise", "temporal dark variance", "DN²", "at least 0.24 DN²")
    value = frames.dark.squares.total_dn2
    u = value * math.sqrt(2 / (frames.dark.mean_map_dn.size * (frames.dark.n_frames - 1)))
    if value == 0:
        return make(0.0, 0.0, "fail", "there is no temporal noise", "Raise the camera's gain or its bits; switch noise filters off")
    reason = "quantisation hides the dark noise: only σ_d < 0.40/K can be given"
    return make(value, u, "warn" if value < MINIMUM_DARK_VAR_DN2 else "ok", reason, "Raise the camera's gain, or use more bits")


CODE_CHECKS: tuple[Callable[[Frames], Check], ...] = (
    check_exchanged,
    check_underflow,
    check_black_level,
    check_saturation,
    check_range,
    check_code_step,
    check_top_code,
    check_codes,
    check_repeated,
    check_independent,
    check_dark_noise,
)


UNIFORMITY = 0.03  # (max − min)/mean of the light, as the standard allows
SURFACE_DEGREE = 4
FLICKER_FRAMES, DRIFT_FRAMES = 4, 6  # least numbers that tell of the light


@dataclass(frozen=True)
class Flattened:
    """The light of the brightest unsaturated level, dark image taken off: smooth surface and what is left."""

    group: Group
    signal_dn: float
    surface: Surface
    residual_dn: np.ndarray


def flattened(frames: Frames) -> Flattened | None:
    """The light and its smooth part; None where there is no light, or the frames are too small."""
    levels = frames.unsaturated
    if not levels or min(frames.dark.shape) < 2 * SURFACE_DEGREE + 4:
        return None
    light = levels[-1].mean_map_dn - frames.dark.mean_map_dn
    outliers = np.abs(light - np.median(light)) > 0.5 * np.median(light)
    light = fill(light, outliers) if outliers.mean() < 0.01 else light
    surface = fit_surface(light, SURFACE_DEGREE)
    return Flattened(levels[-1], float(light.mean()), surface, light - surface.values)


def flicker_rel(group: Group, dark: Group) -> float:
    """Scatter of the frame means beyond noise, over the signal."""
    excess = group.squares.frame_dn2 - group.mean_noise_dn2
    return math.sqrt(max(excess, 0.0)) / max(group.mean_dn - dark.mean_dn, 1e-9)


def check_flicker(frames: Frames) -> Check:
    """Scatter of the light from frame to frame: variance ratio against the noise of a mean."""
    make = new_check("flicker", "scatter of the light between frames", "%", "at most 0.2 %")
    groups = [g for g in frames.unsaturated if g.n_frames >= FLICKER_FRAMES and g.mean_noise_dn2 > 0]
    if not groups:
        return make(NAN, NAN, "not judged", "four bright frames or more at one unsaturated level are needed")
    from scipy.special import fdtri

    worst, verdict = max(groups, key=lambda g: flicker_rel(g, frames.dark)), "ok"
    value = flicker_rel(worst, frames.dark)
    dof = worst.n_frames - 1
    limit = fdtri(dof, min(worst.shape) - 1, 1 - FALSE_ALARM / len(groups))
    if worst.squares.frame_dn2 > limit * worst.mean_noise_dn2:
        verdict = "fail" if value > 0.02 else "warn" if value > 0.002 else "ok"
    reason = f"the light flickers or drifts {level_text(worst)}; responsivity, linearity and quantum efficiency will scatter by as much"
    remedy = (
        "Operate the light with direct current; use exposures that are multiples of the light's period (10 ms at 50 Hz mains); let "
        "the lamp warm up"
    )
    return make(100 * value, 100 * value / math.sqrt(2 * dof), verdict, reason, remedy)


def _drift(group: Group) -> tuple[float, float, bool]:
    """Change of the frame mean over the series along a line, its u, and whether it is more than chance."""
    from scipy.special import stdtrit

    n = group.n_frames
    time = np.arange(n) - (n - 1) / 2
    slope = float(time @ group.frame_means_dn / (time @ time))
    rest = group.frame_means_dn - group.mean_dn - slope * time
    u = math.sqrt(max(rest @ rest / (n - 2), group.mean_noise_dn2) / (time @ time))
    return abs(slope) * (n - 1), u * (n - 1), abs(slope) > -stdtrit(n - 2, FALSE_ALARM / 2) * u


def check_drift(frames: Frames) -> Check:
    """Trend of the light over the frames of a level."""
    make = new_check("drift", "drift of the light over the frames", "%", "at most 0.5 %")
    groups = [g for g in frames.unsaturated if g.n_frames >= DRIFT_FRAMES]
    if not groups:
        return make(NAN, NAN, "not judged", "six bright frames or more at one unsaturated level are needed")
    group = max(groups, key=lambda g: g.n_frames)
    signal = group.mean_dn - frames.dark.mean_dn
    change, u, real = _drift(group)
    verdict = "warn" if real and change > 0.005 * signal else "ok"
    return make(100 * change / signal, 100 * u / signal, verdict, f"the light drifts {level_text(group)}", "Let lamp and camera warm up")


def check_dark_drift(frames: Frames) -> Check:
    """Trend of the dark signal over the frames, against the dark noise."""
    make = new_check("dark_drift", "drift of the dark mean over the frames", "DN", "at most 0.1 σ of the dark noise")
    dark = frames.dark
    if dark.n_frames < DRIFT_FRAMES:
        return make(NAN, NAN, "not judged", "six dark frames or more are needed")
    change, u, real = _drift(dark)
    verdict = "warn" if real and change > 0.1 * math.sqrt(dark.squares.total_dn2) else "ok"
    return make(change, u, verdict, "the dark signal drifts", "Let the camera warm up until its temperature is stable")


def check_banding(frames: Frames) -> Check:
    """Waves down the rows that differ between frames: mains flicker under a rolling shutter."""
    make = new_check("banding", "bands down the rows, amplitude", "%", "at most 0.1 % of the signal")
    from scipy.special import gammainccinv, gammaincinv

    if not frames.unsaturated or frames.dark.shape[0] < 32:
        return make(NAN, NAN, "not judged", "no unsaturated bright level, or fewer than 32 rows")
    worst, found = 0.0, "ok"
    for g in frames.unsaturated:
        profiles, rows = g.row_profiles_dn, g.shape[0]
        pairs = profiles[1::2][: g.n_frames // 2] - profiles[0::2][: g.n_frames // 2]
        power = (np.abs(np.fft.rfft(pairs - pairs.mean(axis=1, keepdims=True), axis=1)) ** 2).mean(axis=0)[1:-1] / rows
        n = len(pairs)
        floor = float(np.median(power)) / (float(gammaincinv(n, 0.5)) / n)
        # the floor is a median over the frequencies: room for its scatter
        limit = gammainccinv(n, FALSE_ALARM / power.size / len(frames.bright)) / n * (1 + 6.5 / math.sqrt(power.size))
        peak = float(power.max())
        amplitude = math.sqrt(max(2 * (peak - floor) / rows, 0.0)) / (g.mean_dn - frames.dark.mean_dn)
        if peak > limit * floor and amplitude > worst:
            worst, found = amplitude, "fail" if amplitude > 0.01 else "warn" if amplitude > 0.001 else "ok"
    remedy = (
        "Operate the light with direct current, use exposures that are multiples of the light's period (10 ms at 50 Hz mains), or "
        "use a global shutter"
    )
    return make(
        100 * worst, NAN, found, "bands move through the image from frame to frame: flickering light with a rolling shutter", remedy
    )


def check_uniformity(frames: Frames) -> Check:
    """Largest less smallest light over its mean, of the smooth surface fitted to bright less dark."""
    make = new_check("uniformity", "(max − min)/mean of the light", "%", "at most 3 %")
    light = flattened(frames)
    if light is None:
        return make(NAN, NAN, "not judged", "no unsaturated bright level, or frames smaller than 12 x 12")
    s, residual = light.surface, light.residual_dn
    strata, (rows, cols) = cross_strata(residual, residual), residual.shape
    variances = s.coefficient_variances(strata.pixel / residual.size, strata.row / rows, strata.col / cols)
    high, low = (np.unravel_index(at, residual.shape) for at in (s.values.argmax(), s.values.argmin()))
    contrast = np.outer(s.basis_y[high[0]], s.basis_x[high[1]]) - np.outer(s.basis_y[low[0]], s.basis_x[low[1]])
    value, u = float(np.ptp(s.values)) / light.signal_dn, math.sqrt(float((contrast**2 * variances).sum())) / light.signal_dn
    remedy = "Move the light away, use an integrating sphere and no lens, and centre the camera"
    return make(
        100 * value, 100 * u, beyond(value, u, UNIFORMITY, UNIFORMITY), "the light is uneven; part of it will appear as PRNU", remedy
    )


def check_defects(frames: Frames) -> Check:
    """Pixels that are clearly hot in the dark, or respond to light by less than half or more than one and a half."""
    make = new_check("defects", "hot, dead and deviating pixels", "%", "at most 0.1 %")
    image, dark = frames.dark.mean_map_dn, frames.dark
    spread = 1.4826 * float(np.median(np.abs(image - np.median(image))))
    limit = 10 * max(spread, math.sqrt(dark.squares.total_dn2 / dark.n_frames)) + 1
    bad = np.abs(image - np.median(image)) > limit
    if frames.unsaturated:
        group = frames.unsaturated[-1]
        response = group.mean_map_dn - image
        noise = math.sqrt(group.squares.total_dn2 / group.n_frames + dark.squares.total_dn2 / dark.n_frames)
        middle = float(np.median(response))
        bad |= np.abs(response - middle) > max(0.5 * middle, 10 * noise)
    share = float(bad.mean())
    u = math.sqrt(share * (1 - share) / bad.size)
    remedy = "Check the cooling, clean the sensor, or leave these pixels out; say so in the data sheet"
    return make(100 * share, 100 * u, beyond(share, u, 0.001, 0.01), f"{int(bad.sum())} pixels deviate", remedy)


def _log_slope(x: np.ndarray, y: np.ndarray, u_log_y: np.ndarray) -> tuple[float, float]:
    """Exponent of y ∝ x^p by weighted least squares, and its u."""
    w, lx = u_log_y**-2.0, np.log(x)
    lx = lx - (w @ lx) / w.sum()
    return float(w * lx @ np.log(y) / (w * lx @ lx)), float(1 / math.sqrt(w * lx @ lx))


def check_transfer(frames: Frames) -> Check:
    """Exponent of variance per signal against signal: 0 for a linear camera, below −1 after gamma 0.45."""
    make = new_check("transfer", "x in variance/signal ~ signal^x", "", "0 ± 0.1")
    dark = frames.dark
    x = np.array([g.mean_dn - dark.mean_dn for g in frames.unsaturated])
    var = np.array([g.squares.pixel_dn2 for g in frames.unsaturated])
    pairs = np.array([g.n_frames - 1 for g in frames.unsaturated]) * dark.mean_map_dn.size
    y = var - dark.squares.pixel_dn2
    # the dark term is common to all levels; taken as independent it makes u larger
    u = np.sqrt(2 * var**2 / pairs + 2 * dark.squares.pixel_dn2**2 / (dark.mean_map_dn.size * (dark.n_frames - 1)) + 0.02**2)
    use = y > 5 * u
    if use.sum() < 2 or np.ptp(np.log(x[use])) < 0.4:
        return make(NAN, NAN, "not judged", "two unsaturated levels with a ratio of 1.5 or more and visible photon noise are needed")
    slope, u_slope = _log_slope(x[use], y[use] / x[use], (u / np.where(y > 0, y, 1))[use])
    reason = "the noise does not grow with the signal like photon noise: gamma, a look-up table, noise reduction or strong compression"
    remedy = "Switch gamma and filters off, or use the General values, which do not need a linear camera"
    return make(slope, u_slope, beyond(abs(slope), u_slope, 0.1, 0.3), reason, remedy)


def check_response(frames: Frames) -> Check:
    """Exponent of signal against photons, or exposure time where photons are not known."""
    make = new_check("response", "x in signal ~ light^x", "", "1 ± 0.05")
    levels = frames.unsaturated
    by_photons = all(g.photons for g in levels)
    light = [g.photons if by_photons else g.exposure_s for g in levels]
    known = np.array([v for v in light if v], dtype=float)
    if len(levels) < 2 or known.size < len(levels) or known.max() < 1.5 * known.min():
        return make(NAN, NAN, "not judged", "two unsaturated levels with known light and a ratio of 1.5 or more are needed")
    x = np.array([g.mean_dn - frames.dark.mean_dn for g in levels])
    noise = np.array([max(g.squares.frame_dn2 / g.n_frames, g.mean_noise_dn2 / g.n_frames) for g in levels])
    dark = frames.dark.squares.frame_dn2 / frames.dark.n_frames
    slope, u = _log_slope(known, x, np.sqrt(noise + dark + (1e-3 * x) ** 2) / x)
    reason = "the signal does not follow the light" + ("" if by_photons else " (or the light changed while the exposure was swept)")
    remedy = (
        "Switch gamma, automatic gain and automatic exposure off and check the light, or use the General values, which do not need "
        "a linear camera"
    )
    return make(slope, u, beyond(abs(slope - 1), u, 0.05, 0.2), reason, remedy)


def check_blocks(frames: Frames) -> Check:
    """Steps of the frame difference that are larger or smaller at every eighth column or row: JPEG."""
    make = new_check("blocks", "noise steps at every 8th row or column", "%", "by chance only")
    from scipy.special import stdtr

    groups = frames.unsaturated or (frames.dark,)
    worst, u_worst, chance = 0.0, NAN, 1.0
    tests = 2 * BLOCK * len(groups)
    for steps in (s for g in groups for s in (g.steps_x_dn2, g.steps_y_dn2)):
        if steps.size < 8 * BLOCK or steps.mean() == 0:
            continue
        for phase in range(BLOCK):
            own, rest = steps[phase::BLOCK], np.delete(steps, np.s_[phase::BLOCK])
            # neighbours share a column: of the others every second is independent at least
            u = math.sqrt(own.var(ddof=1) / own.size + 2 * rest.var(ddof=1) / rest.size)
            excess = own.mean() - rest.mean()
            p = 2 * stdtr(own.size - 1, -abs(excess) / u) if u > 0 else float(excess == 0)
            if p < chance:
                worst, u_worst, chance = excess / steps.mean(), u / steps.mean(), p
    if math.isnan(u_worst):
        return make(NAN, NAN, "not judged", "the frames are too small or have no noise")
    verdict = "warn" if chance < FALSE_ALARM / tests and abs(worst) > 0.02 else "ok"
    reason = "the noise has steps every 8 pixels, as after JPEG"
    return make(100 * worst, 100 * u_worst, verdict, reason, "Store frames without compression")


LIGHT_CHECKS: tuple[Callable[[Frames], Check], ...] = (
    check_flicker,
    check_drift,
    check_dark_drift,
    check_banding,
    check_uniformity,
    check_defects,
    check_transfer,
    check_response,
    check_blocks,
)
