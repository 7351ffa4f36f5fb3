"""The digital twin: a camera that makes frames like those of an assessed one, and the test of it against that camera's own values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pixmetry.budget.parameters import applies
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.observations import Observations, PatternList, PhotonTransfer, StackMoments
from pixmetry.camera.provenance import DESCRIBED, MEASURED, TYPICAL
from pixmetry.camera.source import Source
from pixmetry.camera.unit_maps import MeasuredUnit
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.records import Measurement, Results
from pixmetry.emva.reduction import measure_frames
from pixmetry.files import Campaign
from pixmetry.observe.converter_bend import ConverterBend, converter_bend
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.one_pass import Group
from pixmetry.observe.unit_maps import UnitMaps, threshold_errors, unit_maps
from pixmetry.scene.uniform import Uniform

ASSUMED_RANGE_E = 5000.0  # electrons for a full range where the gain is not known: the shot noise of most cameras is less
ALWAYS = ("sensor.quantum_efficiency", "sensor.shot_noise", "grabber.adc")  # what every twin has, measured or not
SIGNIFICANT_U = 1.96  # below so many u from nothing a value is not simulated
CORRELATED = 0.5  # values with a larger correlation belong together: one alone may be small and yet needed
WAVES, NOISE = "grabber.phase_pattern", "electronics.amplifier_noise"
SOME_DITHER_DN2 = 0.5  # variance above which rounding adds 1/12 DN² (to 1e-4)
TEST_SEED = 1_000_000_007  # so that a campaign that was simulated with a small seed has other noise than its twin
TEST_PIXELS = 26_000_000  # of all frames of the self-test together, about
TEST_STACK, TEST_LEVELS = 16, 12  # fewest frames of a stack and levels of each kind that it takes, if the campaign has them
SMALLEST_WINDOW = 64


def digital_twin(campaign: Campaign, estimates: Mapping[str, Estimates], observations: Observations) -> Camera:
    """Build the simulated camera from the measured values: a camera of the type, with random fixed patterns.

    What the campaign only bounds, or what is not significant, is not simulated: it stands in the chain at 0, with what is known of it as
    the element's estimates. What is in it without being measured is marked as typical. Without a photon count the quantum efficiency is
    1, and the photons of a scene are electrons. `of_unit` makes the very camera of it.
    """
    facts = campaign.camera
    told = {"interface": facts.interface, **({} if facts.sensor is None else {"sensor": facts.sensor})}
    known: dict[str, Any] = {"bits": campaign.bits, "reference_dn": float(2**campaign.bits - 1), "quantum_efficiency": 1.0}
    if facts.temperature_c is not None:
        known["reference_temperature_c"] = facts.temperature_c
    elements = []
    for source in in_order(s for s in sources().values() if s.forward is not None and applies(s, told)):
        fields = source.parameters.model_fields
        if source.id not in estimates and source.id not in ALWAYS:
            continue
        found = replace(estimates.get(source.id, Estimates.empty()), confounders=())  # results.json holds these, once for all
        params = source.make({k: v for k, v in known.items() if k in fields} | best_values(source, found), f"digital twin, {source.id}")
        known_from = MEASURED if len(found) else TYPICAL if source.measure is not None else DESCRIBED
        elements.append(Element(source.id, source, params, known_from=known_from, estimates=found))
    pitch = None if facts.pitch_x_um is None else (facts.pitch_x_um, facts.pitch_y_um or facts.pitch_x_um)
    stack = observations.bright_stack
    if not any(element.name == "electronics.gain" for element in elements):
        elements = _with_assumed_gain(elements, campaign.bits)
    exposure = stack.exposure_s if stack is not None else _middle_exposure_s(observations.series)
    photons_known = "sensor.quantum_efficiency" in estimates
    return Camera(
        name=facts.name,
        frame_shape=campaign.frame_shape,
        chain=tuple(elements),
        pitch_um=pitch,
        exposure_s=exposure,
        temperature_c=20.0 if facts.temperature_c is None else facts.temperature_c,
        facts={
            **told,
            "bits": campaign.bits,
            **({} if facts.sensor_shape is None else {"sensor_rows": facts.sensor_rows, "sensor_cols": facts.sensor_cols}),
            **({} if observations.storage.lossless is None else {"lossless": observations.storage.lossless}),
            "source": f"assessed from {campaign.source_path.name}",
            "photons": "photons" if photons_known else "electrons: no photon count was given, the quantum efficiency is set to 1",
        },
    )


def _with_assumed_gain(elements: list[Element], bits: int) -> list[Element]:
    """The chain with a gain as if few electrons filled the range, so that the shot noise is bounded where the gain was not measured."""
    source = get_source("electronics.gain")
    gain = source.make({"gain_dn_per_e": (2**bits - 1) / ASSUMED_RANGE_E}, where="digital twin, assumed gain")
    by_name = {e.name: e for e in elements} | {source.id: Element(source.id, source, gain, known_from=TYPICAL)}
    return [by_name[s.id] for s in in_order([e.source for e in elements] + [source])]


def _middle_exposure_s(transfer: PhotonTransfer) -> float:
    exposures = transfer.bright.exposure_s if transfer.bright.exposure_s.size else transfer.dark.exposure_s
    return float(np.median(exposures))


def best_values(source: Source, estimates: Estimates) -> dict[str, float]:
    """Values for a simulation: the estimates; 0 for values that are not significant, except dark noise that rounding hides."""
    hidden = {"white_e"}  # the rms of an even spread up to its limit
    values = {}
    for e in estimates:
        may_be_none = source.neutral is not None and getattr(source.neutral, e.name) == 0 and _alone(estimates, e.name)
        nothing = e.kind == "upper_limit" or (may_be_none and abs(e.value) < SIGNIFICANT_U * e.u)
        values[e.name] = 0.0 if nothing and e.name not in hidden else e.representative
    return values


def _alone(estimates: Estimates, name: str) -> bool:
    """Whether a value is hardly correlated with the others of its set."""
    i = estimates.index(name)
    scale = estimates.u * estimates.u[i]
    correlation = np.divide(np.abs(estimates.covariance[i]), scale, out=np.zeros(len(estimates)), where=scale > 0)
    correlation[i] = 0.0
    return bool(correlation.max(initial=0.0) <= CORRELATED)


def of_unit(twin: Camera, observations: Observations) -> Camera:
    """The camera that was measured: the type with the maps, defects, waves and thresholds of this unit, as far as the frames tell them.

    With another ``unit_seed`` it is another camera of the type. All waves that were found are in it, each under its own name. The white
    noise is that of the stack of dark frames, less the waves. A full well that the converter hides, or that no level reached, is switched
    off. A twin without maps (no stacks of dark and bright frames), or without a photon transfer, is as it was.
    """
    bits = int(twin.facts["bits"])
    fit = observations.photon_transfer_fit
    if fit is None or "nonlinearity_a1" not in fit:
        return twin
    try:
        maps = unit_maps(observations, bits)
    except MeasureError:
        return twin
    bend = converter_bend(observations, bits)
    chain: list[Element] = []
    for element in twin.chain:
        if element.source.id == WAVES and observations.patterns is not None and len(observations.patterns):
            chain += _waves(element, observations.patterns, maps)
        elif element.source.id == "sensor.full_well" and ("saturation_dn" not in fit or fit["saturation_dn"].value > 2**bits - 1.5):
            chain.append(replace(element, on=False))
        else:
            chain.append(replace(element, maps=_own_maps(element, maps, bend, observations)))
    unit = replace(twin, chain=tuple(chain), measured=MeasuredUnit(twin.unit_seed, twin.frame_shape))
    white = _white_e(unit, bend, observations)
    if white is None:
        return unit
    noise = unit[NOISE].source.make({**unit[NOISE].params.model_dump(), "white_e": white}, where=f"digital twin, {NOISE}")
    # the estimates stay: they are of all frames, this value is that of the stack
    return replace(unit, chain=tuple(replace(e, params=noise) if e.name == NOISE else e for e in unit.chain))


def _own_maps(element: Element, maps: UnitMaps, bend: ConverterBend, seen: Observations) -> dict[str, np.ndarray]:
    """What the unit's maps say of one source; contrasts in front of the converter are larger where it is flat."""
    gain = seen.fit["gain_dn_per_e"].value
    dark, bright = (bend.gain_at(stack.mean_dn) for stack in seen.stacks)
    if element.source.id == "optics.shading":
        return {"light_rel": (1 + (maps.light_rel - 1) / bright).astype(np.float32)}
    if element.source.id == "sensor.prnu":
        return {"response_dev_rel": _half(maps.response_dev_rel / bright)}
    if element.source.id == "sensor.dsnu":
        return {"offset_e": _half(maps.offset_dn / (dark * gain))}
    if element.source.id == "sensor.defects":
        return {"pixels": maps.pixels / np.array([1, 1, 1, dark * gain, dark * gain])}
    if element.source.id == "grabber.adc":
        single = np.zeros(element.params.top) if seen.code_errors is None else threshold_errors(seen.code_errors, element.params.bits)
        moved = single + bend.displacement_lsb[1:]
        return {"threshold_lsb": moved} if moved.any() else {}
    return {}


def _white_e(unit: Camera, bend: ConverterBend, seen: Observations) -> float | None:
    """White noise in electrons that makes the temporal variance of the dark stack, beside dark current, waves and rounding.

    None where it is not to be told from rounding, or stands for what is not known.
    """
    (stack, _), fit = seen.stacks, seen.fit
    linearity = Linearity.of(fit, int(unit.facts["bits"]))
    if NOISE not in unit or linearity is None or stack.ms_pixel_dn2 < SOME_DITHER_DN2 or "dark_noise_e" in fit.limits:
        return None
    waves = 0.0 if seen.patterns is None else 0.5 * float((seen.patterns.amplitude_dn[seen.patterns.moving] ** 2).sum())
    slope2 = stack.ms_pixel_dn2 / linearity.straight_stack(stack).ms_pixel_dn2  # of the response, squared
    gain = fit["gain_dn_per_e"].value * bend.gain_at(stack.mean_dn)
    square = (stack.var_stack_dn2 - 1 / 12 - waves) / (slope2 * gain**2)
    if "electronics.row_noise" in unit:
        square -= unit["electronics.row_noise"].params.row_e ** 2 + unit["electronics.row_noise"].params.column_e ** 2
    if "sensor.defects" in unit and "pixels" in unit["sensor.defects"].maps:
        excess_e, noise_e = unit["sensor.defects"].maps["pixels"][:, 3:5].T
        square -= (excess_e.sum() + (noise_e**2).sum()) / stack.mean_map_dn.size
    if "sensor.dark_current" in unit:
        square -= unit["sensor.dark_current"].params.rate_e_per_s * stack.exposure_s
    return math.sqrt(max(square, 0.0))


def _half(deviation: np.ndarray) -> np.ndarray:
    """Deviations as 16-bit floats: to 0.05 % of each, in half of the bytes."""
    half: np.ndarray = np.clip(deviation, -65504, 65504).astype(np.float16)
    return half


def _waves(element: Element, found: PatternList, maps: UnitMaps) -> list[Element]:
    """One element for every wave that was found, the strongest under the plain name."""
    out = []
    for k in range(len(found)):
        nu_x, nu_y = float(np.clip(found.frequency_x[k], 0, 0.5)), float(np.clip(found.frequency_y[k], -0.5, 0.5))
        values = {"amplitude_dn": float(found.amplitude_dn[k]), "frequency_x": nu_x, "frequency_y": nu_y, "moving": bool(found.moving[k])}
        params = element.source.make(values, where=f"digital twin, wave {k + 1}")
        phase = {} if found.moving[k] else {"phase_turns": maps.wave_turns[k : k + 1]}
        wave = replace(element, params=params, maps=phase)
        # the estimates are of the strongest
        out.append(wave if k == 0 else replace(wave, name=f"{element.name}_{k + 1}", estimates=Estimates.empty()))
    return out


# ---- the test of the twin ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Exposure:
    """Frames of one condition that the twin is to make: as a group of the campaign, with the light that its bright frames saw."""

    kind: str
    role: str
    exposure_s: float
    photons: float | None
    frames: int


@dataclass(frozen=True)
class Compared:
    """One value of the camera and of its twin."""

    name: str
    unit: str
    camera: float
    u_camera: float
    twin: float
    u_twin: float

    @property
    def difference_u(self) -> float:
        """Twin less camera, over the standard uncertainty of the difference."""
        return (self.twin - self.camera) / math.hypot(self.u_camera, self.u_twin)


@dataclass(frozen=True)
class SelfTest:
    """Values of camera and twin.

    Parameters
    ----------
    rows : tuple of Compared
    frames, of : int
        Frames of the twin that were reduced, and of the campaign.
    window : (int, int, int, int), optional
        First row and column, rows and columns of the part of the frames that was compared; None for all of them.
    reason : str
        Why there are no rows.
    """

    rows: tuple[Compared, ...] = ()
    frames: int = 0
    of: int = 0
    window: tuple[int, int, int, int] | None = None
    reason: str = ""

    @property
    def worst(self) -> Compared | None:
        """The value that differs by most u."""
        return max(self.rows, key=lambda row: abs(row.difference_u), default=None)

    def to_record(self) -> dict[str, Any]:
        """The plain record of ``results.json``."""
        rows = [
            {
                "name": r.name,
                "unit": r.unit,
                "camera": r.camera,
                "u_camera": r.u_camera,
                "twin": r.twin,
                "u_twin": r.u_twin,
                "difference_u": r.difference_u,
            }
            for r in self.rows
        ]
        return {"values": rows, "frames": self.frames, "frames_of_campaign": self.of, "window": self.window, "reason": self.reason}


def exposures_of(campaign: Campaign) -> list[Exposure]:
    """The exposures of a campaign."""
    return [Exposure(g.kind, g.role, g.exposure_s, g.photons, len(g.paths)) for g in campaign.groups]


def expose(
    twin: Camera, exposures: Sequence[Exposure], light: Sequence[float], seed: int, window: tuple[int, int, int, int] | None = None
) -> Iterator[Group]:
    """The groups of a campaign as the twin makes them; each frame is exposed when it is fetched.

    Parameters
    ----------
    twin : Camera
    exposures : sequence of Exposure
    light : sequence of float
        Photons per pixel of each, 0 in the dark.
    seed : int
        Of the exposures.
    window : (int, int, int, int), optional
        First row and column, rows and columns of the part of the frames that is made.
    """
    first = 0
    for exposure, photons in zip(exposures, light, strict=True):
        make = partial(_frame, twin, Uniform(photons), seed, exposure.exposure_s, window)
        frames = [partial(make, first + k) for k in range(exposure.frames)]
        first += exposure.frames
        yield Group(exposure.kind, exposure.role, exposure.exposure_s, exposure.photons, frames)


def _frame(twin: Camera, scene: Uniform, seed: int, exposure_s: float, window: Any, number: int) -> np.ndarray:
    frame: np.ndarray = twin.expose(scene, [number], seed, window, threads=1, exposure_s=exposure_s).data[0]
    return frame  # on one thread: the reduction fetches several at once


def light_of(exposures: Sequence[Exposure], seen: Observations) -> list[float]:
    """Photons (or electrons, where none were counted) per pixel of each exposure, 0 in the dark: as stated, and what all got beside.

    An exposure that lasts some microseconds longer than its number adds the same light to every level. It is the intercept of a straight
    line through the straightened means over the stated light, weighted as the light repeats, where it is significant.

    Raises
    ------
    MeasureError
        If neither photons nor the camera's response per second are known.
    """
    fit, bright = seen.fit, seen.series.bright
    stated_all = all(e.photons is not None for e in exposures if e.kind == "bright")
    photons = bright.photons if stated_all and "quantum_efficiency" in fit else None
    counted = photons is not None
    if not counted and "responsivity_dn_per_s" not in fit:
        raise MeasureError("the light of the levels is not known", where="digital twin", remedy="give the photons of each level")
    gain = fit["gain_dn_per_e"].value
    per_unit = 1.0 if counted else fit["responsivity_dn_per_s"].value / gain  # photons for a photon, or electrons for a second
    dn = gain * (fit["quantum_efficiency"].value if counted else 1.0)
    stated = per_unit * (bright.exposure_s if photons is None else photons)
    more = _more_light(seen, stated, dn)
    asked = [float(per_unit * (e.photons or 0.0 if counted else e.exposure_s)) for e in exposures]
    return [max(light + more, 0.0) if e.kind == "bright" else 0.0 for e, light in zip(exposures, asked, strict=True)]


def _more_light(seen: Observations, stated: np.ndarray, dn_per_unit: float) -> float:
    """What the bright levels got beside the stated light, in its unit; 0 where it is not significant, or few levels tell no response."""
    fit, bright = seen.fit, seen.series.bright
    linearity = Linearity.of(fit, seen.series.bits)
    use = bright.mean_dn < (0.9 * fit["saturation_dn"].value if "saturation_dn" in fit else math.inf)
    if use.sum() < 4 or linearity is None:
        return 0.0
    lamp = fit["illumination_noise_rel"].value if "illumination_noise_rel" in fit else 1e-3
    above = linearity.straight(bright.mean_dn[use])
    if "dark_current_e_per_s" in fit and "dark_current_e_per_s" not in fit.limits:
        above = above - fit["gain_dn_per_e"].value * fit["dark_current_e_per_s"].value * bright.exposure_s[use]
    weight = 1 / np.hypot(lamp * above, fit["offset_dn"].u)
    design = np.column_stack([stated[use], np.ones(use.sum())]) * weight[:, None]
    inverse = np.linalg.inv(design.T @ design)
    slope, offset = inverse @ design.T @ (weight * above)
    left = weight * above - design @ np.array([slope, offset])
    u = math.sqrt(inverse[1, 1] * max(float(left @ left) / (use.sum() - 2), 1.0))
    return float(offset / dn_per_unit) if abs(offset) > 3 * u else 0.0


def fewer(exposures: Sequence[Exposure], frame_pixels: int, most_pixels: int = TEST_PIXELS) -> list[Exposure]:
    """As many of a campaign's exposures as fit into a number of pixels: stacks of fewer frames, and levels spread evenly over the series.

    Never fewer than `TEST_STACK` frames a stack (or all), nor than `TEST_LEVELS` levels of each kind.
    """
    stacks = [e for e in exposures if e.role == "stack"]
    levels = [sorted((e for e in exposures if e.role == "level" and e.kind == kind), key=_light_key) for kind in ("dark", "bright")]
    if sum(e.frames for e in exposures) * frame_pixels <= most_pixels:
        return list(exposures)
    room = max(most_pixels // frame_pixels, 1)
    each = max(TEST_STACK, room // (2 * max(len(stacks), 1)))
    kept = [replace(e, frames=min(e.frames, each)) for e in stacks]
    count = max(TEST_LEVELS, (room - sum(e.frames for e in kept)) // 4)
    for of_kind in levels:
        if of_kind:
            at = np.unique(np.linspace(0, len(of_kind) - 1, min(count, len(of_kind))).round().astype(int))
            kept += [replace(of_kind[i], frames=min(of_kind[i].frames, 2)) for i in at]
    return kept


def middle_window(frame_shape: tuple[int, int], most_pixels: int = TEST_PIXELS) -> tuple[int, int, int, int] | None:
    """The part of a frame of which the fewest frames of a test fit into a number of pixels, in its middle; None if all of it does."""
    share = math.sqrt(most_pixels / ((2 * TEST_STACK + 4 * TEST_LEVELS) * frame_shape[0] * frame_shape[1]))
    if share >= 1:
        return None
    rows, cols = (min(max(int(share * side), SMALLEST_WINDOW), side) for side in frame_shape)
    return (frame_shape[0] - rows) // 2, (frame_shape[1] - cols) // 2, rows, cols


def _cropped(stack: StackMoments | None, window: tuple[int, int, int, int]) -> StackMoments | None:
    """A stack as if only a window of its frames had been taken; means of rows and columns then hold more of the white noise."""
    if stack is None:
        return None
    row0, col0, rows, cols = window
    part = np.s_[row0 : row0 + rows, col0 : col0 + cols]
    mean, variance, white = stack.mean_map_dn[part], stack.var_map_dn2[part], stack.ms_pixel_dn2
    return replace(
        stack,
        mean_map_dn=mean,
        var_map_dn2=variance,
        mean_dn=float(mean.mean()),
        var_stack_dn2=float(variance.mean(dtype=float)),
        ms_row_dn2=stack.ms_row_dn2 + white * (1 / cols - 1 / stack.shape[1]),
        ms_col_dn2=stack.ms_col_dn2 + white * (1 / rows - 1 / stack.shape[0]),
    )


def _light_key(exposure: Exposure) -> tuple[float, float]:
    return exposure.exposure_s, exposure.photons or 0.0


COMPARED = (
    *("R", "K", "QE", "sigma_y_dark", "sigma_d", "u_p_min", "u_e_sat", "SNR_max", "DR", "LE_min", "LE_max", "u_I_mean", "u_I_var"),
    *("sigma_2_y_stack_dark", "s_2_y_dark", "s_2_y_row_dark", "s_2_y_col_dark", "s_2_y_pixel_dark"),
    *("sigma_2_y_stack", "s_2_y", "s_2_y_row", "s_2_y_col", "s_2_y_pixel", "DSNU1288", "PRNU1288"),
)
# compared only if the twin takes all frames, and the whole of them
BY_LEVEL = ("R", "u_e_sat", "SNR_max", "DR", "LE_min", "LE_max")  # hang on which levels a series has
BY_PLACE = ("R", "QE", "u_p_min", "u_e_sat", "SNR_max", "DR")  # hang on the light, which at one place is not the mean over the frame
BY_FRAME = tuple(f"s_2_y_{part}{kind}" for part in ("row", "col", "pixel") for kind in ("", "_dark"))  # hold row noise over L


def self_test(
    twin: Camera, campaign: Campaign, observations: Observations, standard: Results, seed: int = 1, most_pixels: int = TEST_PIXELS
) -> SelfTest:
    """Simulate the campaign with the twin, reduce the frames like those of the camera, and compare the values of EMVA 1288.

    u of a difference is that of the two values, each of which tells how it would come out of another series of the same camera. Of a large
    campaign the twin takes fewer frames, of large frames a window; what hangs on the number of levels or frames, or on the place, is then
    not compared.
    """
    window = middle_window(campaign.frame_shape, most_pixels)
    wanted = exposures_of(campaign)
    pixels = math.prod(campaign.frame_shape if window is None else window[2:])
    chosen = fewer(wanted, pixels, most_pixels)
    frames, of = sum(e.frames for e in chosen), sum(e.frames for e in wanted)
    left_out = (BY_LEVEL if len(chosen) < len(wanted) else ()) + (BY_FRAME if frames < of else ()) + (BY_PLACE if window else ())
    try:
        light = light_of(chosen, observations)
        (measured,) = measure_frames(expose(twin, chosen, light, seed + TEST_SEED, window), campaign.bits)
        found = standard_values(measured_like(measured, twin), standard.release)
        if window is not None:
            dark, bright = _cropped(observations.dark_stack, window), _cropped(observations.bright_stack, window)
            standard = standard_values(Measurement(observations.series, dark, bright), standard.release)
    except (MeasureError, InputError) as problem:
        return SelfTest(frames=frames, of=of, window=window, reason=str(problem))
    rows = []
    for key in COMPARED:
        ours, theirs = standard.values[key], found.values[key]
        numbers = (ours.value, ours.u, theirs.value, theirs.u)
        limit = any(v.is_limit for v in (ours, theirs))
        if np.isfinite(numbers).all() and ours.u > 0 and not limit and key not in left_out:
            rows.append(Compared(key, ours.unit, *numbers))
    return SelfTest(tuple(rows), frames, of, window)


def measured_like(measured: Measurement, twin: Camera) -> Measurement:
    """The twin's measurement with its pixel area."""
    return measured if twin.pitch_um is None else replace(measured, pixel_area_um2=twin.pitch_um[0] * twin.pitch_um[1])
