"""Reasons in words why a value is missing, is a limit, or needs care; and notes on a whole measurement."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import ONE_SIDED_95, Number
from pixmetry.emva.dark_noise import DarkNoise
from pixmetry.emva.files.keys import EQUAL_EXPOSURE, KEYS, PTC_LIMIT_PERCENT, SATURATED_FRACTION, key_of
from pixmetry.emva.formulas import Formulas, Spread, Values
from pixmetry.emva.general.general import general_curve, general_notes
from pixmetry.emva.general.general_model import Plan
from pixmetry.emva.linear_model import FAILS
from pixmetry.emva.linear_model import REASON as CURVED
from pixmetry.emva.records import Measurement, Series
from pixmetry.emva.series import MINIMUM_EXPOSURES, count_exposures, exposure_varies, light_of, without_dark
from pixmetry.emva.temporal import dark_line
from pixmetry.observe.stack import same_exposure

SWEPT_SHARE = 0.01  # of the slope of the response
BROKEN = 5.0  # u below zero from which a square is no chance any more
CHANCE = 3e-7  # of that
WANTED_LEVELS, WANTED_DARK_LEVELS = 50, 6  # R4.0 §6.5, §7.1
BOUNDED_BY_DARK_NOISE = ("sigma_y_dark", "sigma_d", "u_p_min", "u_p_min_area", "u_e_min", "u_e_min_area")
DARK_PATTERN = ("DSNU1288", "DSNU1288_DN", "DSNU1288_row", "DSNU1288_col", "DSNU1288_pixel", "general_DSNU")
GENERAL_ON_DARK_NOISE = ("general_u_p_min", "general_DR", "general_DR_dB")
ON_DARK_LEVELS = (
    "K",
    "inverse_K",
    "R",
    "QE",
    "u_e_sat",
    "SNR_",
    "inverse_SNR",
    "DR",
    "PTC",
    "LE",
    "general_",
    "PRNU1288",
)  # how they begin
ON_DARK_VARIANCE = tuple(key for key in ON_DARK_LEVELS if key not in ("R", "LE"))
IN_PHOTONS = ("QE", "u_p_min", "u_p_min_area", "u_p_sat", "u_p_sat_area", "general_u_p_min", "general_u_p_sat", "general_DSNU")
NO_LIGHT = "neither photons nor exposure times give the light of the levels"


@dataclass(frozen=True)
class Case:
    """One measurement by one release: what was found, before it is put into words."""

    m: Measurement
    formulas: Formulas
    measured: Values
    squares: Values
    spread: Spread
    noise: DarkNoise


def is_bound(key: str) -> bool:
    """Whether a value is an upper limit where the dark noise is one."""
    return key in BOUNDED_BY_DARK_NOISE


def is_blind(key: str, case: Case) -> bool:
    """Whether dark frames clipped at black cannot show a value; the reference implementation gives it anyway."""
    dark = is_bound(key) or key.startswith("DR") or key in DARK_PATTERN + GENERAL_ON_DARK_NOISE or KEYS[key].section == "dark_current"
    return dark and case.noise.blind and case.formulas.release != "reference"


def lifted(key: str, formulas: Formulas, measured: Values) -> float:
    """What the square behind a root lacks because temporal row and column noise was taken for a pattern (in the square's unit).

    Before release 4.0 all temporal noise is taken off as if it were white: (σ²_row + σ²_col)/L too much goes off the pixels.
    """
    if formulas.release == "4.0" or not key.endswith("_pixel") or formulas.stacks is None:
        return 0.0
    dark, bright = (float(np.maximum(s.vector[6:], 0.0).sum()) / s.n_frames for s in formulas.stacks)
    if key.startswith("DSNU"):
        return dark / float(measured["K"]) ** 2
    light = float(formulas.stacks[1].vector[0] - formulas.stacks[0].vector[0])
    return max(bright - dark, 0.0) * (100 / light) ** 2


def breaks_the_split(key: str, case: Case) -> bool:
    """Whether the square behind a root lies so far below zero that what the split into parts rests on does not hold.

    It must be neither the noise that u holds nor the chance by which the pattern of independent pixels came out: the means of M lines of
    it have a mean square that is chi-square on M − 1, and PRNU has the product of dark pattern and response beside it.
    """
    if key not in case.squares or case.formulas.stacks is None:
        return False
    square = float(case.squares[key]) + lifted(key, case.formulas, case.measured)
    if not square < -BROKEN * case.spread.u_square.get(key, math.inf):
        return False
    rows, cols = case.formulas.stacks[0].shape
    base, _, part = key.partition("_")
    lines, length = {"row": (rows, cols), "col": (cols, rows)}.get(part, (rows * cols, 1))
    if base == "PRNU1288":
        dark = float(case.squares["DSNU1288_DN"]) * (100 / _light_dn(case)) ** 2
        if not square < -BROKEN * 2 * max(dark, 0.0) / (length * math.sqrt(lines)):
            return False
    if part in ("row", "col"):
        from scipy.special import chdtr

        pixel = float(case.squares.get(f"{base}_pixel", 0.0))
        share = max(1 + square * length / pixel, 0.0) if pixel > 0 else 0.0  # of what such pixels give
        return float(chdtr(lines - 1, share * (lines - 1))) < CHANCE
    return True


def reason_for(key: str, case: Case) -> str:
    """The reason of one value; empty if there is none."""
    return next((said for rule in RULES if (said := rule(key, case)) is not None), "")


def _lacking(key: str, case: Case) -> str | None:
    """The reason for a value that the measurement does not allow."""
    bright, formulas = case.m.transfer.bright, case.formulas
    if KEYS[key].section in formulas.missing:
        return formulas.missing[KEYS[key].section]
    if formulas.curved and key not in case.measured:
        return CURVED
    if key in IN_PHOTONS and bright.photons is None:
        return "the photons of the levels are not known"
    if key == "R" and light_of(formulas.series) is None:
        return NO_LIGHT
    if key == "R" and bright.photons is None:
        return "per second of exposure: the photons of the levels are not known"
    return "the pixel's area is not known" if key.endswith("_area") and case.m.pixel_area_um2 is None else None


def _clipped(key: str, case: Case) -> str | None:
    """Black is cut off: the dark frames are brighter and have less noise than the camera."""
    touched = is_bound(key) or key in DARK_PATTERN or KEYS[key].section == "dark_current" or key.startswith(ON_DARK_LEVELS)
    if not (case.noise.clipped and touched):
        return None
    what = f"{100 * case.noise.black:.3g} % of the dark pixels are at the lowest code"
    if is_blind(key, case):
        return f"{what}: they cut off noise and pattern; raise the offset"
    return f"{what}: the dark mean is too high, and dark noise and pattern are too small, by more than u; raise the offset"


def _dark_current(key: str, case: Case) -> str | None:
    if KEYS[key].section != "dark_current":
        return None
    value = _measured(key, case)
    if math.isnan(value):
        found = count_exposures(case.formulas.series.dark_exposure_s)
        return f"dark levels of three or more exposures are needed (found: {found})"
    if value < 0 and key.startswith("u_I_var"):
        return f"the dark variance falls with exposure, slope {value:.3g}, within its noise or by drift; 95 % upper limit".replace("-", "−")
    return "the dark mean falls with exposure: a clamp that follows the dark current, or drift" if value < 0 else ""


def _below_zero(key: str, case: Case) -> str | None:
    if breaks_the_split(key, case):
        return _broken(key, case)
    return _negative(key, case.formulas, float(case.squares[key])) if key in case.squares and float(case.squares[key]) < 0 else None


def _hidden_by_quantisation(key: str, case: Case) -> str | None:
    if case.noise.below and (is_bound(key) or key.startswith("DR")):
        return _hidden_noise(key, case)
    if case.noise.hidden and key in DARK_PATTERN:
        unlimited = case.formulas.curved and not key.endswith("_DN")
        return _hidden_pattern("reference" if unlimited else case.formulas.release)
    return None


def _too_few_levels(key: str, case: Case) -> str | None:
    if not math.isnan(_measured(key, case)):
        return None
    if KEYS[key].section == "linearity":
        few = "fewer than three levels between 5 and 95 % of saturation"
        return NO_LIGHT if light_of(case.formulas.series) is None else few
    return "too few levels for a local slope" if key == "PTC_linearity" else None


def _step_of_levels(key: str, case: Case) -> str | None:
    if key not in ("u_p_sat", "u_p_sat_area"):
        return None
    photons, at = case.formulas.series.photons, int(case.measured["index_u_ysat"])
    if photons is None or at + 1 >= photons.size:
        return "the last level of the series"
    step = float(f"{photons[at + 1] - photons[at]:.4g}")
    return f"a level of the series; the next is {step:.10g} photons brighter, which u does not include"


def _insignificant(key: str, case: Case) -> str | None:
    if key not in case.squares or not float(case.squares[key]) < ONE_SIDED_95 * case.spread.u_square[key]:
        return None
    return "its square is not significantly above zero: hardly any pattern is larger than the remaining temporal noise"


def _bent_by_quantisation(key: str, case: Case) -> str | None:
    if not (case.noise.hidden and key.startswith(ON_DARK_VARIANCE)):
        return None
    return (
        f"the dark variance ({case.noise.var_dn2:.2g} DN²) is hidden by quantisation, which distorts variance and mean of "
        "dark levels: it may be wrong by more than u; raise the camera's gain"
    )


def _without_own_dark_level(key: str, case: Case) -> str | None:
    bright_s, dark_s = case.formulas.series.exposure_s, case.formulas.series.dark_exposure_s
    if not key.startswith(ON_DARK_LEVELS) or KEYS[key].section == "spatial" or not without_dark(bright_s, dark_s).any():
        return None
    return (
        f"no dark level has the bright levels' exposure: that of {_nearest_text(bright_s, dark_s)} is used "
        "unchanged, with its dark current, which u does not include"
    )


def _moved_by_noise(key: str, case: Case) -> str | None:
    shift = case.spread.shift.get(key, 0.0)
    if key.startswith("index_") or not 2 * abs(shift) > case.spread.u.get(key, 0.0) > 0:
        return None
    moved = f"{shift:+.2g}".replace("-", "−")
    return f"noise alone moves it by {moved}: an extreme or absolute value of noisy levels; u includes this"


# In this order: the first rule that returns a text gives the reason; an empty text ("") means that there is none.
RULES: tuple[Callable[[str, Case], str | None], ...] = (
    _lacking,
    _clipped,
    _dark_current,
    _below_zero,
    _hidden_by_quantisation,
    _too_few_levels,
    _step_of_levels,
    _insignificant,
    _bent_by_quantisation,
    _without_own_dark_level,
    _moved_by_noise,
)


def _measured(key: str, case: Case) -> float:
    return float(case.measured[key]) if key in case.measured else math.nan


def _negative(key: str, formulas: Formulas, square: float) -> str:
    """The cause of a negative variance, from the temporal row and column noise that the stack shows."""
    behind = f"the variance behind it is negative ({square:.3g} in {key_of(key).unit} squared)".replace("-", "−")
    if formulas.release == "4.0" or not key.endswith("_pixel"):
        return f"{behind}: no pattern is larger than the remaining temporal noise; 95 % upper limit"
    assert formulas.stacks is not None
    stack = formulas.stacks[0 if key.startswith("DSNU") else 1]
    row, col = stack.vector[6:]
    return (
        f"{behind}: temporal noise common to a row ({row:.3g} DN²) or a column ({col:.3g} DN²) stays in the mean of "
        f"{stack.n_frames} frames, is taken for a fixed pattern of rows and columns, and is subtracted from the pixels; "
        "95 % upper limit without this subtraction"
    )


def _broken(key: str, case: Case) -> str:
    """Why a square is far below zero, which no square can be: an assumption of the split does not hold."""
    square = float(case.squares[key])
    in_u = f"{square / case.spread.u_square[key]:.0f} u" if case.spread.u_square[key] > 0 else "many u"
    behind = f"the variance behind it is far below zero ({square:.3g} in {key_of(key).unit} squared, {in_u})".replace("-", "−")
    if key.startswith("PRNU") and float(case.squares["PRNU1288"]) < 0:
        dark = float(case.squares["DSNU1288_DN"])
        if dark * (100 / _light_dn(case)) ** 2 > abs(square):  # the dark pattern is what was taken off
            at_top = case.m.bright_stack.fraction_max if case.m.bright_stack is not None else 0.0
            seen = f"{100 * at_top:.2g} % of the bright pixels are at the highest code; " if at_top > 0 else ""
            return (
                f"{behind}: the pixels differ less in the light than in the dark, as pixels do that are hot in the dark and clip in "
                f"the light ({seen}the standard subtracts the dark variance as if it were still there); no value and no limit: "
                "leave such pixels out"
            )
    line = "rows" if key.endswith("_row") else "columns" if key.endswith("_col") else ""
    if line:
        return (
            f"{behind}: the means of {line} differ less than those of independent pixels would, as under a wave that runs across the "
            "frame: it adds to the pixels and averages out along a line, while the split assumes independent pixels; no value and no "
            "limit"
        )
    return (
        f"{behind}: less noise remains after averaging than the temporal noise of single frames predicts, as if that noise were not "
        "independent from frame to frame (a moving wave, or a drifting mean); no value and no limit"
    )


def _light_dn(case: Case) -> float:
    assert case.formulas.stacks is not None
    return float(case.formulas.stacks[1].vector[0] - case.formulas.stacks[0].vector[0])


def _hidden_noise(key: str, case: Case) -> str:
    if case.formulas.release == "reference":
        return "the dark variance lies below 0.24 DN², where quantisation hides it; computed with 0.24 DN²"
    bound = "a lower bound" if key.startswith("DR") else "an upper limit"
    if case.noise.hidden:
        return f"the dark variance lies below 0.24 DN², where quantisation hides it: {bound} (eq. 54)"
    found = f"{case.noise.var_dn2:.2g} ± {case.noise.u_dn2:.2g} DN²".replace("-", "−")
    return f"the dark variance at zero exposure ({found}) is not significant against its u and the 0.24 DN² of quantisation: {bound}"


def _hidden_pattern(release: str) -> str:
    what = "the temporal dark noise is too small to dither the quantisation; the pattern appears too large or too small"
    return what if release == "reference" else f"{what}: 95 % upper limit"


def _nearest_text(bright_s: np.ndarray, dark_s: np.ndarray) -> str:
    at = int(np.argmax(without_dark(bright_s, dark_s)))
    return f"{dark_s[np.abs(dark_s - bright_s[at]).argmin()]:.4g} s beside {bright_s[at]:.4g} s"


def ends_early(formulas: Formulas, measured: Values) -> bool:
    """Whether the last level of the series, below saturation, takes its place."""
    at = int(measured.get("index_u_ysat", -1))
    return at == formulas.series.mean_dn.size - 1 and bool(formulas.series.fraction_max[at] < SATURATED_FRACTION / 2)


def notes_of(case: Case, values: dict[str, Number], linear: str) -> tuple[str, ...]:
    """Notes on the measurement as a whole; ``linear`` is the result of ``linear_model``."""
    m, formulas, measured = case.m, case.formulas, case.measured
    series, notes = formulas.series, []
    if linear == FAILS:
        departure = values["PTC_linearity"].value
        notes.append(
            f"the photon transfer's slope departs from K by {departure:.1f} % (more than {PTC_LIMIT_PERCENT:g} %): the Linear model does "
            "not hold for this camera; use the General values and those with the suffix _nonlinear"
        )
    if formulas.curved:
        notes.append(CURVED)
    sat = int(measured.get("index_u_ysat", -1))
    if ends_early(formulas, measured):
        given = "printed unchanged, and are lower bounds" if formulas.release == "reference" else "lower limits, from its last level"
        notes.append(f"the series ends before saturation: capacity, SNR_max and DR are {given}")
    if formulas.release == "4.0" and 0 <= sat < series.mean_dn.size - 1 and series.fraction_max[sat + 1] <= SATURATED_FRACTION:
        notes.append("the full well lies below the top code: saturation is taken at the maximum of the photon transfer curve")
    if case.noise.clipped:
        notes.append("more than 0.5 % of the dark pixels are at the lowest code: raise the offset (R4.0 §6.5)")
    if series.mean_dn.size < WANTED_LEVELS:
        notes.append(f"{series.mean_dn.size} bright levels, the standard asks for {WANTED_LEVELS} (R4.0 §6.5)")
    if exposure_varies(series.exposure_s) and count_exposures(series.dark_exposure_s) < WANTED_DARK_LEVELS:
        notes.append(f"dark levels of fewer than {WANTED_DARK_LEVELS} exposures (R4.0 §7.1)")
    if not _paired(series.exposure_s, series.dark_exposure_s):
        several = count_exposures(series.dark_exposure_s) >= MINIMUM_EXPOSURES
        taken = "from straight lines through" if several else "from"
        notes.append(f"not every bright level has a dark level of its exposure: dark values are taken {taken} the others")
    if formulas.stacks is not None and m.dark_stack is not None and m.bright_stack is not None:
        one, other = m.dark_stack.exposure_s, m.bright_stack.exposure_s
        if not same_exposure(m.dark_stack, m.bright_stack):
            notes.append(f"the stacks differ in exposure (dark {one:g} s, bright {other:g} s): their dark signals differ too")
    if formulas.release == "4.0" and "general" not in formulas.missing:
        notes += general_notes(formulas.plan)
        if formulas.curved and exposure_varies(series.exposure_s):
            notes += _swept_dark_current(series, formulas.plan)
    return tuple(notes)


def _swept_dark_current(series: Series, plan: Plan) -> tuple[str, ...]:
    """How far the dark current, which grows with a swept exposure, bends the response that a curved camera shows.

    Of y = f(N + D t) − f(D t) over the photons, the second term takes the slope of the dark mean off that of f at constant exposure.
    """
    curve, slope = general_curve(plan), float(dark_line(series)[1])
    if series.photons is None or math.isnan(slope):
        return ()
    last = int(np.argmax(series.photons))
    share = slope * series.exposure_s[last] / float(curve["photons"][-1]) / float(curve["slope"][-1])
    if not abs(share) > SWEPT_SHARE:
        return ()
    return (
        f"the exposure was swept, and the dark signal with it: a curved response makes the slope of the brightest level up to "
        f"{100 * abs(share):.2g} % too {'small' if share > 0 else 'large'}, and with it the General values; sweep the light instead",
    )


def _paired(bright_s: np.ndarray, dark_s: np.ndarray) -> bool:
    gap = np.abs(dark_s[None] - bright_s[:, None]).min(axis=1)
    return bool(np.all(gap <= EQUAL_EXPOSURE * np.maximum(bright_s, 1e-15)))
