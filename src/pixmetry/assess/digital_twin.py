"""The digital twin: a camera that makes frames like those of an assessed one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from pixmetry.budget.parameters import applies
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.observations import Observations, PatternList
from pixmetry.camera.provenance import DESCRIBED, MEASURED, TYPICAL
from pixmetry.camera.source import Source
from pixmetry.camera.unit_maps import MeasuredUnit
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.files import Campaign
from pixmetry.observe.converter_bend import ConverterBend, converter_bend
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.unit_maps import UnitMaps, threshold_errors, unit_maps

ASSUMED_EXPOSURE_S = 0.01
ASSUMED_RANGE_E = 5000.0  # electrons for a full range where the gain is not known: the shot noise of most cameras is less
ALWAYS = ("sensor.quantum_efficiency", "sensor.shot_noise", "grabber.adc")  # what every twin has, measured or not
OF_STORED_FRAME = ("grabber.window_offset", "grabber.sampling_clock")  # the twin's frame is the stored one: these lie behind it
SIGNIFICANT_U = 1.96  # below so many u from nothing a value is not simulated
CORRELATED = 0.5  # values with a larger correlation belong together: one alone may be small and yet needed
WAVES, NOISE = "grabber.phase_pattern", "electronics.amplifier_noise"
SOME_DITHER_DN2 = 0.5  # variance above which rounding adds 1/12 DN² (to 1e-4)


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
        if (source.id not in estimates and source.id not in ALWAYS) or source.id in OF_STORED_FRAME:
            continue
        if source.id in estimates and estimates[source.id].settings.get("mode") == "field":
            continue  # the twin's frames are these fields
        found = replace(estimates.get(source.id, Estimates.empty()), confounders=())  # results.json holds these, once for all
        values = {k: v for k, v in known.items() if k in fields} | best_values(source, found) | dict(observations.choices(source.id))
        params = source.make(values, f"digital twin, {source.id}")
        known_from = MEASURED if len(found) or found.settings else TYPICAL if source.measure is not None else DESCRIBED
        elements.append(Element(source.id, source, params, known_from=known_from, estimates=found))
    pitch = None if facts.pitch_x_um is None else (facts.pitch_x_um, facts.pitch_y_um or facts.pitch_x_um)
    stack = observations.bright_stack
    if not any(element.name in ("electronics.gain", "sensor.log_response") for element in elements):
        elements = _with_assumed_gain(elements, campaign.bits)
    exposure = stack.exposure_s if stack is not None else _middle_exposure_s(campaign)
    photons_known = "sensor.quantum_efficiency" in estimates
    twin = Camera(
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
            **({} if facts.covered is None else {"covered": asdict(facts.covered)}),
            "source": f"assessed from {campaign.source_path.name}",
            "photons": "photons" if photons_known else "electrons: no photon count was given, the quantum efficiency is set to 1",
        },
    )
    return twin if facts.pixel_clock_mhz is None else replace(twin, pixel_clock_hz=1e6 * facts.pixel_clock_mhz)


def _with_assumed_gain(elements: list[Element], bits: int) -> list[Element]:
    """The chain with a gain as if few electrons filled the range, so that the shot noise is bounded where the gain was not measured."""
    source = get_source("electronics.gain")
    gain = source.make({"gain_dn_per_e": (2**bits - 1) / ASSUMED_RANGE_E}, where="digital twin, assumed gain")
    by_name = {e.name: e for e in elements} | {source.id: Element(source.id, source, gain, known_from=TYPICAL)}
    return [by_name[s.id] for s in in_order([e.source for e in elements] + [source])]


def _middle_exposure_s(campaign: Campaign) -> float:
    """The median exposure of the brightest kind of frames; an assumed one where none was said, as of pictures of targets."""
    known = [[g.exposure_s for g in groups] for groups in (campaign.levels("bright"), campaign.levels("dark"))]
    targets = [g.exposure_s for g in campaign.groups if g.exposure_s > 0]
    return float(np.median(next(filter(None, [*known, targets]), [ASSUMED_EXPOSURE_S])))


def best_values(source: Source, estimates: Estimates) -> dict[str, float | str | int]:
    """Values for a simulation: the estimates and settings; 0 for values that are not significant, except dark noise that rounding hides."""
    hidden = {"white_e"}  # the rms of an even spread up to its limit
    values: dict[str, float | str | int] = dict(estimates.settings)
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
            chain.append(_with_true_black(replace(element, maps=_own_maps(element, maps, bend, observations)), observations))
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


def _with_true_black(element: Element, seen: Observations) -> Element:
    """The converter with the black level in front of its own uneven thresholds; measured is that of equal steps that store the same.

    Over the stack's pixels, normal noise stores the mean Σ_k Φ((level - T_k) / σ): the level moves until it is that of equal steps.
    """
    moved, dark = element.maps.get("threshold_lsb"), seen.dark_stack
    if moved is None or dark is None:
        return element
    std = np.sqrt(max(dark.ms_pixel_dn2 - 1 / 12, 1 / 12))
    places = np.quantile(dark.mean_map_dn, (np.arange(200) + 0.5) / 200)
    codes = np.arange(1, moved.size + 1)
    reach = np.ptp(places) + 8 * std + 2
    near = np.abs(codes - places.mean()) < reach
    level = (places[:, None] - codes[near] + 0.5) / std
    equal = ndtr(level).sum()

    def excess(shift_lsb: float) -> float:
        return float(ndtr(level + (shift_lsb - moved[near]) / std).sum() - equal)

    most = float(np.abs(moved[near]).max(initial=0.0))
    black = element.params.model_dump()
    black["offset_dn"] += float(brentq(excess, -most, most, xtol=1e-6)) if most > 0 else 0.0
    return replace(element, params=element.source.make(black, where="digital twin, black level"))


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
