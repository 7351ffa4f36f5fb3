"""Which frames to take: u of a test by EMVA 1288 foretold from what is known of the camera, the cheapest plan that meets wishes, the plan
for people to read, and the manifest that waits for its frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError
from pixmetry.emva.files.keys import FIT_RANGE, KEYS, MINIMUM_DARK_VAR_DN2, QUANTISATION_DN2
from pixmetry.emva.planning.known_camera import KnownCamera, camera_from_results, number_in
from pixmetry.emva.records import MONO, DataSheet
from pixmetry.emva.spatial.high_pass import pattern_gains

TOP = 1.1  # signal of the brightest level over saturation: the standard wants the series to go through saturation
STACK_LEVEL = 0.5  # of saturation: signal of the bright stack (R4.0 8.2)
MIN_LEVELS, MIN_FRAMES, MIN_STACK, MIN_DARK_LEVELS = 50, 2, 16, 6  # least that is customary under the standard
MAX_LEVELS, MAX_FRAMES, MAX_STACK, MAX_DARK_LEVELS = 500, 64, 4000, 500  # beyond these no test is planned
ROOT_POINTS = 200  # of the normal distribution, for u of roots
_Record = TypeVar("_Record", KnownCamera, "Plan")
SERIES_KEYS = ("K", "sigma_d", "R", "QE")
SPATIAL_KEYS = tuple(f"{name}{part}" for name in ("DSNU1288", "PRNU1288") for part in ("", "_pixel", "_row", "_col"))


@dataclass(frozen=True)
class Plan:
    """Frames of a test: ``levels`` bright levels evenly spaced up to 1.1 times saturation and two stacks, bright at half of saturation.

    ``sweep`` is ``"exposure"``, with dark frames at the exposure of each bright level, or ``"light"``: one exposure for all bright
    levels, and ``dark_levels`` of dark frames, at this exposure and shorter ones. ``drivers`` names what each number follows from;
    ``unreachable`` the wishes that no plan meets, with the reason.
    """

    levels: int = MIN_LEVELS
    frames_per_level: int = MIN_FRAMES
    stack_frames: int = 100
    sweep: str = "exposure"
    dark_levels: int = MIN_DARK_LEVELS
    drivers: Mapping[str, str] = field(default_factory=dict)
    unreachable: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sweep not in ("exposure", "light"):
            raise InputError("unknown kind of sweep", where="plan", value=self.sweep, allowed="exposure or light")
        numbers = (self.levels, self.frames_per_level, self.stack_frames, self.dark_levels)
        if min(numbers) < 2:
            raise InputError("too few levels or frames", where="plan", value=numbers, allowed="2 or more of each")

    @property
    def fractions(self) -> Array:
        """Signal of the bright levels over saturation, shape (levels,)."""
        return TOP * np.arange(1, self.levels + 1) / self.levels

    @property
    def dark_fractions(self) -> Array:
        """Exposures of the dark levels over ``exposure_sat_s``."""
        return self.fractions if self.sweep == "exposure" else np.arange(1, self.dark_levels + 1) / self.dark_levels

    @property
    def bright_exposures(self) -> Array:
        """Exposures of the bright levels over ``exposure_sat_s``, shape (levels,)."""
        return self.fractions if self.sweep == "exposure" else np.ones(self.levels)

    @property
    def stack_exposure(self) -> float:
        """Exposure of both stacks over ``exposure_sat_s``."""
        return STACK_LEVEL if self.sweep == "exposure" else 1.0

    @property
    def n_frames(self) -> int:
        """Number of all frames."""
        return self.frames_per_level * (self.levels + self.dark_fractions.size) + 2 * self.stack_frames

    def duration_s(self, camera: KnownCamera) -> float | None:
        """Time that the frames take, without changes of the set-up; None where neither exposure nor frame rate is known."""
        if camera.exposure_sat_s is None and camera.frame_rate_hz is None:
            return None
        frame_s = 1 / camera.frame_rate_hz if camera.frame_rate_hz else 0.0
        levels = np.concatenate([self.bright_exposures, self.dark_fractions]) * (camera.exposure_sat_s or 0.0)
        stack_s = max(self.stack_exposure * (camera.exposure_sat_s or 0.0), frame_s)
        return float(self.frames_per_level * np.maximum(levels, frame_s).sum() + 2 * self.stack_frames * stack_s)


def predicted_u(camera: KnownCamera, plan: Plan) -> dict[str, float]:
    """Standard uncertainties that a test by this plan will have, analytically.

    Parameters
    ----------
    camera : KnownCamera
    plan : Plan

    Returns
    -------
    dict
        By key of the result format, in its unit (``PRNU1288*`` and ``QE`` in %): K, sigma_d, DSNU1288 and PRNU1288 with their parts;
        R and QE if the quantum efficiency is known, without what is common to all photon counts. ``inf`` where the standard gives a
        bound only (eq. 54).

    Notes
    -----
    A temporal variance from F frames of M rows and N columns scatters by 2 Σ ν E[MS]²/((NM)² (F − 1)), summed over the strata pixel, row
    and column of the analysis of variance (white noise: 2 σ⁴/(NM (F − 1))), and by ``var_excess_rel`` besides. These go to first order
    through the slope K = Σ x y/Σ x² (eq. 50), y the difference of bright and dark variance, and the intercept of the dark variance over
    exposure time (eq. 53), correlation included. Light that is off its value moves mean and variance along the line and leaves K alone.

    A stratum of the mean map of L frames with fixed mean square A and temporal mean square B = σ²/L has, the pattern being this
    sensor's, Var(MS − B) = (4 A B + 2 (B² + (c − 1) B_dark²) L/(L − 1))/ν, c the coherence (pixels only), ν what the high-pass of
    R4.0 8.1 leaves of its degrees of freedom by correlating neighbours. u of a root s is the root mean square of √max(s² + u z, 0) − s
    for normal z, so it stays finite where s vanishes.
    Neglected: terms of relative order 1/µ_e of Poisson noise, and what K shares with the stacks.
    """
    u = _series_u(camera, plan)
    return u | _spatial_u(camera, plan, u["K"])


def _strata_dof(rows: int, cols: int) -> Array:
    return np.array([(rows - 1) * (cols - 1), rows - 1, cols - 1], dtype=float)


def _temporal_strata(camera: KnownCamera, white_dn2: Array | float) -> Array:
    """Expected temporal mean squares of one frame (pixel, row, column), shape (3, …), DN²."""
    k2 = camera.gain_dn_per_e**2
    white = np.asarray(white_dn2, dtype=float)
    return np.stack([white, white + camera.cols * k2 * camera.row_noise_e**2, white + camera.rows * k2 * camera.col_noise_e**2])


def _variance_scatter(camera: KnownCamera, white_dn2: Array, n_frames: int) -> Array:
    """Variance of the temporal variance of levels, DN⁴."""
    squares, dof = _temporal_strata(camera, white_dn2), _strata_dof(camera.rows, camera.cols)
    size = camera.rows * camera.cols
    total = dof @ squares / size
    return 2 * (dof @ squares**2) / size**2 / (n_frames - 1) + (camera.var_excess_rel * total) ** 2


def _series_u(camera: KnownCamera, plan: Plan) -> dict[str, float]:
    k, time = camera.gain_dn_per_e, camera.exposure_sat_s or 0.0
    signal = k * camera.saturation_e * plan.fractions
    used = np.where(plan.fractions <= FIT_RANGE, signal, 0.0)
    gain_by_bright = used / (used @ used)
    dark_time = plan.dark_fractions
    bright = camera.dark_var_dn2(plan.bright_exposures * time) + k * signal
    bright_var = _variance_scatter(camera, bright, plan.frames_per_level)
    dark_var = _variance_scatter(camera, camera.dark_var_dn2(dark_time * time), plan.frames_per_level)
    gain_by_dark = -gain_by_bright if plan.sweep == "exposure" else -np.eye(dark_time.size)[-1] * gain_by_bright.sum()
    centred = dark_time - dark_time.mean()
    intercept = 1 / dark_time.size - dark_time.mean() * centred / (centred @ centred)
    u = {"K": math.sqrt(gain_by_bright**2 @ bright_var + gain_by_dark**2 @ dark_var)}
    noise = camera.values["sigma_d"]
    if (k * noise) ** 2 + QUANTISATION_DN2 < MINIMUM_DARK_VAR_DN2:
        u["sigma_d"] = math.inf
    else:
        by_dark = intercept / (2 * k**2 * noise) - noise / k * gain_by_dark
        u["sigma_d"] = math.sqrt((noise / k * gain_by_bright) ** 2 @ bright_var + by_dark**2 @ dark_var)
    if camera.quantum_efficiency is not None:
        light = camera.light_scatter_rel * float(np.sqrt((used**4).sum()) / (used @ used))
        u["R"] = light * k * camera.quantum_efficiency
        u["QE"] = 100 * camera.quantum_efficiency * math.hypot(light, u["K"] / k)
    return u


@lru_cache(maxsize=8)
def _filtered_dof(rows: int, cols: int) -> Array:
    return pattern_gains((rows, cols), filtered=True).dof


def _stack_strata(camera: KnownCamera, parts_dn2: Array, white_dn2: float, dark_white_dn2: float, n_frames: int) -> Array:
    """Variances of the three parts and of the total of the spatial variance (pixel, row, column, total), DN⁴.

    What scatters more than white noise in the dark (a wave on the signal) does so by as much in the light.
    """
    lines = np.array([1.0, camera.cols, camera.rows])
    fixed = parts_dn2[0] + np.array([0.0, parts_dn2[1], parts_dn2[2]]) * lines
    temporal = _temporal_strata(camera, white_dn2) / n_frames
    dof = _filtered_dof(camera.rows, camera.cols)
    wave = np.array([(camera.coherence - 1) * (dark_white_dn2 / n_frames) ** 2, 0.0, 0.0])
    left = 2 * (temporal**2 + wave) * n_frames / (n_frames - 1)
    scatter = (4 * fixed * temporal + left) / dof
    split = np.array([[1.0, 0, 0], [-1 / camera.cols, 1 / camera.cols, 0], [-1 / camera.rows, 0, 1 / camera.rows]])
    found: Array = np.vstack([split, split.sum(axis=0)]) ** 2 @ scatter
    return found


def _dark_strata(camera: KnownCamera, plan: Plan) -> tuple[Array, Array]:
    """Squares of the dark pattern's parts (pixel, row, column), DN², and the variances of what the dark stack tells of them, DN⁴."""
    parts = (camera.gain_dn_per_e * np.array([camera.dsnu_pixel_e, camera.dsnu_row_e, camera.dsnu_col_e])) ** 2
    white = float(camera.dark_var_dn2(plan.stack_exposure * (camera.exposure_sat_s or 0.0)))
    return parts, _stack_strata(camera, parts, white, white, plan.stack_frames)


def _spatial_u(camera: KnownCamera, plan: Plan, u_gain: float) -> dict[str, float]:
    k = camera.gain_dn_per_e
    signal = STACK_LEVEL * k * camera.saturation_e
    white = float(camera.dark_var_dn2(plan.stack_exposure * (camera.exposure_sat_s or 0.0)))
    dsnu2, dark = _dark_strata(camera, plan)
    prnu2 = (signal * np.array([camera.prnu_pixel_rel, camera.prnu_row_rel, camera.prnu_col_rel])) ** 2
    both = dark + _stack_strata(camera, dsnu2 + prnu2, white + k * signal, white, plan.stack_frames)
    u = {}
    for i, part in enumerate(("_pixel", "_row", "_col", "")):
        d2, p2 = (dsnu2[i], prnu2[i]) if part else (dsnu2.sum(), prnu2.sum())
        u[f"DSNU1288{part}"] = math.hypot(_root_u(d2, dark[i]) / k, math.sqrt(d2) / k * u_gain / k)
        u[f"PRNU1288{part}"] = 100 * _root_u(p2, both[i]) / signal
    return u


@lru_cache(maxsize=1)
def _normal_quantiles() -> Array:
    from scipy.special import ndtri

    z: Array = ndtri((np.arange(ROOT_POINTS) + 0.5) / ROOT_POINTS)
    return z / math.sqrt(np.mean(z**2))


def _root_u(square: float, variance: float) -> float:
    """Root mean square distance of √max(s², 0) from s, s² being normal; u as a data sheet has it."""
    drawn = np.sqrt(np.maximum(square + math.sqrt(variance) * _normal_quantiles(), 0.0))
    return float(np.sqrt(np.mean((drawn - math.sqrt(square)) ** 2)))


def plan_for(camera: KnownCamera, wanted: Mapping[str, float], *, sweep: str = "exposure") -> Plan:
    """Find the cheapest plan that meets every wanted u: least time where exposure or frame rate are known, else fewest frames.

    Parameters
    ----------
    camera : KnownCamera
    wanted : mapping
        Standard uncertainty by key, in the key's unit.
    sweep : str
        ``"exposure"`` or ``"light"``.

    Returns
    -------
    Plan
        Never less than 50 levels of two frames and stacks of 16. A wish that no plan meets stands in ``unreachable`` and drives nothing.

    Raises
    ------
    InputError
        A key that cannot be planned for, or a wanted u that is not above 0.
    """
    most = Plan(MAX_LEVELS, MAX_FRAMES, MAX_STACK, sweep, MAX_DARK_LEVELS)
    possible = predicted_u(camera, most)
    for key, u in wanted.items():
        if key not in possible:
            remedy = "give the quantum efficiency too" if key in SERIES_KEYS else "choose one of these"
            raise InputError("u of this key cannot be planned", where="wanted u", value=key, allowed=", ".join(possible), remedy=remedy)
        if not u > 0:
            raise InputError("a wanted u must be above 0", where=f"wanted u of {key}", value=u)
    unreachable = {key: _why(camera, most, key, u) for key, u in wanted.items() if possible[key] > u}
    wishes = {key: u for key, u in wanted.items() if key not in unreachable}

    def meets(plan: Plan) -> bool:
        u = predicted_u(camera, plan)
        return all(u[key] <= limit for key, limit in wishes.items())

    best: Plan | None = None
    for frames in range(MIN_FRAMES, MAX_FRAMES + 1):
        plan = replace(most, frames_per_level=frames)
        if not meets(plan):
            continue
        for name, least in _least_numbers(sweep).items():
            plan = _reduced(plan, name, least, meets)
        if best is None or _cost(camera, plan) < _cost(camera, best):
            best = plan
        if all(getattr(plan, name) == least for name, least in _least_numbers(sweep).items()):
            break
    assert best is not None  # `most` meets all wishes that are left
    return replace(best, drivers=_drivers(camera, best, wishes), unreachable=unreachable)


def _least_numbers(sweep: str) -> dict[str, int]:
    """Numbers that a plan may lower, in this order, and how far."""
    dark = {"dark_levels": MIN_DARK_LEVELS} if sweep == "light" else {}
    return {"levels": MIN_LEVELS, **dark, "stack_frames": MIN_STACK}


def _reduced(plan: Plan, name: str, low: int, meets: Callable[[Plan], bool]) -> Plan:
    """The plan with one of its numbers as small as its wishes allow: one less misses them, unless it is ``low``."""
    if meets(_with(plan, name, low)):
        return _with(plan, name, low)
    high = getattr(plan, name)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if meets(_with(plan, name, middle)) else (middle, high)
    return _with(plan, name, high)


def _with(record: _Record, name: str, value: float) -> _Record:
    changes: dict[str, Any] = {name: value}
    return replace(record, **changes)


def _cost(camera: KnownCamera, plan: Plan) -> float:
    duration = plan.duration_s(camera)
    return float(plan.n_frames) if duration is None else duration


def _drivers(camera: KnownCamera, plan: Plan, wishes: Mapping[str, float]) -> dict[str, str]:
    drivers = {}
    for name, minimum in {"frames_per_level": MIN_FRAMES, **_least_numbers(plan.sweep)}.items():
        number = getattr(plan, name)
        if number == minimum:
            drivers[name] = "least number"
            continue
        fewer = predicted_u(camera, _with(plan, name, number - 1))
        missed = [key for key, limit in wishes.items() if fewer[key] > limit]
        drivers[name] = "u of " + ", ".join(missed) if missed else "cheapest together with the other numbers"
    return drivers


def _why(camera: KnownCamera, most: Plan, key: str, wanted: float) -> str:
    """Say what keeps the largest plan from meeting a wish."""
    best = predicted_u(camera, most)[key]
    if math.isinf(best):
        return "quantisation hides the dark noise (σ²_y.dark < 0.24 DN²): only a bound 0.40/K can be given; raise the camera's gain"
    size = f"{MAX_LEVELS} levels of {MAX_FRAMES} frames and stacks of {MAX_STACK} give {best:.2g} {KEYS[key].unit}"
    for fact, cause, remedy in (
        ("var_excess_rel", "the scatter of the variances between levels", "stabilise the light and the camera, or repeat the test"),
        ("light_scatter_rel", "the scatter of the light between levels", "stabilise the light, or measure it with each level"),
    ):
        if predicted_u(_with(camera, fact, 0.0), most)[key] <= wanted:
            return f"{size}: {cause}, {100 * getattr(camera, fact):.2g} %, stays; {remedy}"
    if key.startswith("DSNU") and camera.values[key] * predicted_u(camera, most)["K"] / camera.gain_dn_per_e > wanted:
        return f"{size}: u of K, which converts grey values to electrons, is too large; stabilise the light"
    if key in SPATIAL_KEYS and camera.values[key] ** 2 < best**2:
        return f"{size}: the pattern is smaller than the remaining noise of the stack's mean; larger frames or cooling would help"
    return f"{size}: the frames have too few pixels for this u; use larger frames, or accept a larger u"


def with_scatter(camera: KnownCamera, values: Mapping[str, Any], plan: Plan) -> KnownCamera:
    """Add the scatter that explains the u which a test by ``plan`` found: of variances (K), of light (R), and in the mean dark image.

    Parameters
    ----------
    camera : KnownCamera
    values : mapping
        Results of that test by key, as in ``camera_from_results``.
    plan : Plan
        How many levels and frames it had.
    """
    for key, fact in (("K", "var_excess_rel"), ("R", "light_scatter_rel")):
        found = number_in(values.get(key), "u")
        if not found > 0 or (key == "R" and camera.quantum_efficiency is None):
            continue
        none, unit = (predicted_u(_with(camera, fact, size), plan)[key] for size in (0.0, 1.0))  # u² grows with the square of each
        camera = _with(camera, fact, math.sqrt(max(found**2 - none**2, 0.0) / (unit**2 - none**2)))
    found = number_in(values.get("s_2_y_pixel_dark"), "u")
    if found > 0:
        white, twice = (_dark_strata(_with(camera, "coherence", c), plan)[1][0] for c in (1.0, 2.0))
        camera = _with(camera, "coherence", float(1 + max(found**2 - white, 0.0) / (twice - white)))
    return camera


def camera_from_sheet(sheet: DataSheet, channel: str = MONO, **more: Any) -> KnownCamera:
    """Take what a data sheet says of one channel; ``more`` are further fields of ``KnownCamera``, which come first.

    Where the sheet says how many frames there were, the u that it found tells of scatter beyond sampling; where it knows exposures and
    photons, of the exposure at saturation.

    Raises
    ------
    InputError
        If the sheet has no such channel, or lacks what is needed.
    """
    results = {r.channel: r for r in sheet.results}
    if channel not in results:
        raise InputError("the data sheet has no such channel", value=channel, allowed=", ".join(results))
    values, conditions = results[channel].values, sheet.conditions
    cell = 1 if channel == MONO else 2  # a channel of a mosaic has one pixel of each cell of 2 x 2
    facts = {"rows": int(sheet.camera["rows"]) // cell, "cols": int(sheet.camera["cols"]) // cell, "bits": int(sheet.camera["bits"])}
    camera = camera_from_results(values, **facts, **{"exposure_sat_s": _exposure_sat_s(values, conditions), **more})
    if not {"bright_levels", "frames_per_level", "dark_stack_frames", "sweep"} <= conditions.keys():
        return camera
    sweep = "exposure" if str(conditions["sweep"]).startswith("exposure") else "light"
    stack, dark_levels = conditions["dark_stack_frames"] or 2, max(int(conditions.get("dark_levels") or 2), 2)
    plan = Plan(int(conditions["bright_levels"]), int(np.min(conditions["frames_per_level"])), int(stack), sweep, dark_levels)
    return replace(with_scatter(camera, values, plan), **more)


def _exposure_sat_s(values: Mapping[str, Any], conditions: Mapping[str, Any]) -> float | None:
    """Exposure at saturation, where the exposure was swept and photons are known."""
    exposures, photons = conditions.get("exposures_s") or (), conditions.get("photons") or ()
    saturation = number_in(values.get("u_p_sat"))
    if len(exposures) < 2 or len(photons) < 2 or not saturation > 0 or not max(photons) > 0:
        return None
    return float(saturation * max(exposures) / max(photons))


CAMPAIGN_SCHEMA = "pixmetry/campaign/1"
_NAMES = {
    "levels": "bright levels",
    "dark_levels": "dark levels",
    "frames_per_level": "frames per level",
    "stack_frames": "frames per stack",
}


def parse_wanted(camera: KnownCamera, texts: Sequence[str]) -> dict[str, float]:
    """Read wishes such as ``K=0.2%`` (of the expected value), ``sigma_d=0.05`` or ``PRNU1288=0.01%`` (its own unit is %).

    Returns
    -------
    dict
        Wanted u by key, in the key's unit.

    Raises
    ------
    InputError
        If one cannot be read, or is relative to a value that is not known.
    """
    wanted = {}
    for text in texts:
        key, _, number = (part.strip() for part in text.partition("="))
        try:
            value = float(number.removesuffix("%"))
        except ValueError:
            raise InputError("a wanted u cannot be read", value=text, allowed="KEY=NUMBER or KEY=NUMBER%", remedy="e.g. K=0.2%") from None
        if number.endswith("%") and key in KEYS and KEYS[key].unit != "%":
            expected = camera.values.get(key, 0.0)
            if not expected > 0:
                remedy = f"give it in {KEYS[key].unit}"
                raise InputError("a relative u of a value that is unknown or zero", where="wanted u", value=text, remedy=remedy)
            value *= expected / 100
        wanted[key] = value
    return wanted


def plan_text(camera: KnownCamera, plan: Plan, wanted: Mapping[str, float] | None = None) -> str:
    """What to take, why as much, and the uncertainties to expect."""
    wanted = wanted or {}
    what = "exposure swept at constant light" if plan.sweep == "exposure" else "light swept at constant exposure"
    lines = [f"Test by EMVA 1288, {what}", ""]
    for name, title in _NAMES.items():
        if name != "dark_levels" or plan.sweep == "light":
            lines.append(f"  {title:<18}{getattr(plan, name):>6}   {plan.drivers.get(name, 'as given')}")
    duration = plan.duration_s(camera)
    pace = "at this frame rate, without the time for changes of the set-up" if camera.frame_rate_hz else "of exposure"
    time = "" if duration is None else f", {_time(duration)} {pace}"
    lines += ["", f"  {plan.n_frames} frames in all{time}", "", *_where(camera, plan), ""]
    lines += [*_table(camera, plan, wanted), *_taken_as(camera)]
    if plan.stack_frames < 100:
        lines += ["", "Stacks of 100 to 400 frames are customary; the wanted u that can be reached need fewer."]
    for key, why in plan.unreachable.items():
        lines += ["", f"Cannot be reached: u({key}) = {wanted.get(key, math.nan):.3g} {KEYS[key].unit}: {why}."]
    return "\n".join(lines) + "\n"


def _where(camera: KnownCamera, plan: Plan) -> list[str]:
    """Exposures in words; as shares of saturation where the time is not known."""
    scale, unit = (camera.exposure_sat_s, " s") if camera.exposure_sat_s else (1.0, " of the saturation exposure")
    dark, stack = plan.dark_fractions * scale, plan.stack_exposure * scale
    bright = f"at signals from {100 * plan.fractions[0]:.2g} % to {100 * TOP:g} % of saturation, evenly spaced"
    fitted = int((plan.fractions <= FIT_RANGE).sum())
    return [
        f"  bright levels {bright} ({fitted} of them up to {100 * FIT_RANGE:g} %, for K)",
        f"  dark levels   at {dark.size} exposures from {dark[0]:.4g} to {dark[-1]:.4g}{unit}",
        f"  stacks        bright at half of saturation, dark, both at {stack:.4g}{unit}",
    ]


def _table(camera: KnownCamera, plan: Plan, wanted: Mapping[str, float]) -> list[str]:
    values = camera.values
    rows = [f"  {'value':<16}{'expected':>10}{'u':>10}{'wanted u':>10}  unit"]
    for key, u in predicted_u(camera, plan).items():
        wish = f"{wanted[key]:.3g}" if key in wanted else ""
        found = "bound only" if math.isinf(u) else f"{u:.2g}"
        missed = "   not reached" if u > wanted.get(key, math.inf) else ""
        rows.append(f"  {key:<16}{values[key]:>10.4g}{found:>10}{wish:>10}  {KEYS[key].unit:<10}{missed}".rstrip())
    return rows


def _taken_as(camera: KnownCamera) -> list[str]:
    """What beyond noise the prediction counts with."""
    taken = []
    if camera.var_excess_rel > 0:
        taken.append(f"variances that scatter by {100 * camera.var_excess_rel:.2g} % beyond sampling")
    if camera.light_scatter_rel > 0:
        taken.append(f"light that scatters by {100 * camera.light_scatter_rel:.2g} %")
    if camera.coherence > 1:
        taken.append(f"noise in mean images that scatters {math.sqrt(camera.coherence):.2g} times as much as white noise")
    return ["", "u counts with " + ", ".join(taken) + "."] if taken else []


def _time(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 100 else f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"


def write_campaign(
    camera: KnownCamera, plan: Plan, path: str | Path, *, name: str = "camera", cfa: str | None = None, suffix: str = ".tif"
) -> None:
    """Write the manifest of the campaign to be taken: it loads as soon as the frames lie beside it under the names it gives.

    Parameters
    ----------
    camera : KnownCamera
        Of a mosaic, the channel that was planned for.
    plan : Plan
    path : path
    name, cfa : str
        Name and colour filter of the camera.
    suffix : str
        Ending of the frames' names.

    Raises
    ------
    InputError
        If the exposure at saturation is not known, or, in a sweep of the light, the quantum efficiency.
    """
    from pixmetry.core.config import dump_yaml

    dump_yaml(manifest(camera, plan, name=name, cfa=cfa, suffix=suffix), path)


def manifest(camera: KnownCamera, plan: Plan, *, name: str = "camera", cfa: str | None = None, suffix: str = ".tif") -> dict[str, Any]:
    """The manifest as plain data; raises as ``write_campaign`` does."""
    if camera.exposure_sat_s is None:
        raise InputError("exposures are not known", where="plan", remedy="give the exposure time at which the light saturates the camera")
    light_swept = plan.sweep == "light"
    if light_swept and camera.quantum_efficiency is None:
        raise InputError("levels of a light sweep are identified by their photons", where="plan", remedy="give the quantum efficiency")
    photons_sat = camera.saturation_e / camera.quantum_efficiency if light_swept and camera.quantum_efficiency else math.nan
    stack_s = plan.stack_exposure * camera.exposure_sat_s
    groups = [_group("dark", "level", i, float(t) * camera.exposure_sat_s, math.nan, suffix) for i, t in enumerate(plan.dark_fractions, 1)]
    groups.append(_group("dark", "stack", None, stack_s, math.nan, suffix))
    groups += [
        _group("bright", "level", i, float(t) * camera.exposure_sat_s, float(p), suffix)
        for i, (t, p) in enumerate(zip(plan.bright_exposures, photons_sat * plan.fractions, strict=True), 1)
    ]
    groups.append(_group("bright", "stack", None, stack_s, STACK_LEVEL * photons_sat, suffix))
    notes = (
        f"Planned: {plan.frames_per_level} frames in each level, {plan.stack_frames} in each stack; * in a name stands for their numbers. "
        "Write the exposures that the camera really took, and the photons per pixel (or irradiance_uw_per_cm2) that were measured"
        + (": those given here are expectations." if light_swept else ".")
    )
    facts = {"name": name, "bits": camera.bits} | ({} if cfa is None else {"cfa": cfa})
    return {"schema": CAMPAIGN_SCHEMA, "camera": facts, "frames": groups, "notes": notes}


def _group(kind: str, role: str, index: int | None, exposure_s: float, photons: float, suffix: str) -> dict[str, Any]:
    stem = f"{kind}_{role}" if index is None else f"{kind}_{role}_{index:03d}"
    group: dict[str, Any] = {"kind": kind, "role": role, "exposure_s": float(f"{exposure_s:.9g}"), "files": f"frames/{stem}_*{suffix}"}
    if math.isfinite(photons):
        group["photons"] = float(f"{photons:.6g}")
    return group
