"""The checks of a preflight on levels and codes, each a function of the reduced frames.

A check that rests on noise speaks only where the value is beyond its limit by more than chance brings about once in a million good cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pixmetry.emva.files.rules import MINIMUM_DARK_VAR_DN2, SATURATED_FRACTION, UNDERFLOW_FRACTION
from pixmetry.emva.planning.preflight_frames import Group

FALSE_ALARM = 1e-6  # of one check
Z = 4.76  # the normal distribution is beyond it, on one side, with that probability
NAN = math.nan


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
    reason = "the dark signal is cut off below: dark mean, dark noise and DSNU would come out wrong"
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
    return make(100 * share, 100 * u, verdict, f"pixels saturate {level_text(worst)}", "Shorten the exposure or dim the light")


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
    reason = f"one code of {step} occurs: the stored bits are not those of the converter"
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
    reason = f"{odd} of {covered} codes stand out: stretched by a digital gain or a table, or the converter has missing codes"
    remedy = "Switch digital gain, gamma and tables off; use the converter's full bits"
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
    make = new_check("independent_frames", "noise of successive to distant frames", "", "1")
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
    return make(worst.follow_ratio, u, verdict, "frames are averaged with those before them", "Switch temporal filters and averaging off")


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
