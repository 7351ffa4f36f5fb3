"""A camera in a scenario: how warm it is, at which scale it sees the object, how fast the image moves, by which light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pixmetry.budget.probe import Facts, Target, facts_of
from pixmetry.budget.scenario import GRADIENT_PER_PX, Scenario
from pixmetry.camera.camera import Camera, Element
from pixmetry.core.errors import InputError

DEFAULT_DIAMETER_PX = 7.0
DEFAULT_F_NUMBER = 8.0


def in_state(camera: Camera, camera_on_min: float, grabber_on_min: float, temperature_change_k: float = 0.0) -> Camera:
    """The camera so long after switching on, in surroundings that are warmer by so much; its frames no longer warm up."""
    on_s = {"grabber.clock_warm_up": 60.0 * grabber_on_min, "sensor.mount_drift": 60.0 * camera_on_min}
    chain = tuple(_on_longer(e, on_s.get(e.source.id, 0.0)) for e in camera.chain)
    colder = camera.warm_up_k * float(np.exp(-60.0 * camera_on_min / camera.warm_up_s))
    return replace(camera, chain=chain, temperature_c=camera.temperature_c - colder + temperature_change_k, warm_up_k=0.0)


def _on_longer(element: Element, by_s: float) -> Element:
    if not by_s:
        return element
    return replace(element, params=element.params.model_copy(update={"on_for_s": element.params.on_for_s + by_s}))


@dataclass(frozen=True)
class Setting:
    """A camera in a scenario.

    Parameters
    ----------
    described : Camera
        As it was given.
    scenario : Scenario

    Raises
    ------
    InputError
        If the scenario asks for a scale of the image (sizes or speeds in mm) that nothing tells.
    """

    described: Camera
    scenario: Scenario

    @cached_property
    def camera(self) -> Camera:
        """In the state of the measurement."""
        state = self.scenario.state
        return in_state(self._stored, state.camera_on_min, state.grabber_on_min, state.temperature_change_k)

    @cached_property
    def calibrated(self) -> Camera:
        """In the state in which it was calibrated."""
        then = self.scenario.calibration
        return in_state(self._stored, then.camera_on_min, then.grabber_on_min)

    @cached_property
    def _stored(self) -> Camera:
        facts = {**self.described.facts, "lossless": self.scenario.storage.format == "lossless"}
        return replace(self.described, facts=facts)

    @cached_property
    def target(self) -> Target:
        """What is measured, in pixels."""
        t = self.scenario.target
        diameter = t.diameter_px
        if t.diameter_mm is not None:
            diameter = t.diameter_mm * self.needed_scale("target.diameter_mm")
        return Target("disc", DEFAULT_DIAMETER_PX if diameter is None else diameter, t.blur_px, t.peak_rel, t.background_rel)

    @cached_property
    def facts(self) -> Facts:
        """The camera's numbers, for this target."""
        return facts_of(self.camera, self.target)

    @property
    def f_mm(self) -> float | None:
        """Focal length, from the scenario or the camera's lens."""
        told = self.scenario.object.f_mm
        return told if told is not None else self._lens("f_mm")

    @property
    def f_number(self) -> float:
        """Of the lens, from the scenario or the camera's lens."""
        told = self.scenario.light.f_number
        return (told if told is not None else self._lens("f_number")) or DEFAULT_F_NUMBER

    def _lens(self, name: str) -> float | None:
        """What the camera's facts tell of its lens."""
        lens = self.described.facts.get("lens")
        told = lens.get(name) if isinstance(lens, Mapping) else None
        return float(told) if isinstance(told, int | float) else None

    @cached_property
    def px_per_mm(self) -> float | None:
        """Pixels of the sensor for a millimetre on the object across the line of sight; None where nothing tells it.

        Notes
        -----
        A thin lens of focal length f images at the scale f/(Z − f); a field of view gives the same directly.
        """
        o = self.scenario.object
        if o.field_mm is not None:
            return self.described.frame_shape[1] / o.field_mm
        if o.distance_mm is None or self.f_mm is None or self.described.pitch_um is None:
            return None
        if o.distance_mm <= self.f_mm:
            raise InputError(
                "the object is nearer than the focal length",
                where="object.distance_mm",
                value=o.distance_mm,
                allowed=f"above {self.f_mm:g} mm",
            )
        return self.f_mm / (o.distance_mm - self.f_mm) * 1e3 / self.described.pitch_um[0]

    @cached_property
    def distance_mm(self) -> float | None:
        """From the lens to the object, given or from field and focal length."""
        o = self.scenario.object
        if o.distance_mm is not None or o.field_mm is None or self.f_mm is None or self.described.pitch_um is None:
            return o.distance_mm
        scale = self.described.frame_shape[1] * self.described.pitch_um[0] * 1e-3 / o.field_mm
        return self.f_mm * (1 + 1 / scale)

    def needed_scale(self, asked_by: str) -> float:
        """Pixels for a millimetre on the object, for an entry that cannot be used without."""
        if self.px_per_mm is None:
            raise InputError(
                "the scale of the image is not known",
                where=asked_by,
                allowed="object.field_mm; or object.distance_mm with a focal length and the camera's pixel pitch",
                remedy="give one of these in the scenario, or sizes and speeds in px",
            )
        return self.px_per_mm

    def _along(self, px: float | None, mm: float | None, name: str) -> np.ndarray:
        size = px if px is not None else 0.0 if mm is None else mm * self.needed_scale(f"motion.{name}")
        angle = np.radians(self.scenario.motion.direction_deg)
        return size * np.array([np.cos(angle), np.sin(angle)])

    @cached_property
    def velocity_px_per_s(self) -> np.ndarray:
        """Of the image, in x and y."""
        m = self.scenario.motion
        return self._along(m.speed_px_per_s, m.speed_mm_per_s, "speed_mm_per_s")

    @cached_property
    def acceleration_px_per_s2(self) -> np.ndarray:
        """Of the image, in x and y."""
        m = self.scenario.motion
        return self._along(m.acceleration_px_per_s2, m.acceleration_mm_per_s2, "acceleration_mm_per_s2")

    @property
    def moves(self) -> bool:
        """Whether the target moves while it is seen."""
        return bool(self.velocity_px_per_s.any() or self.acceleration_px_per_s2.any())

    @property
    def gradient_rel_per_px(self) -> float:
        """Of brightness over the target, by its surface unless it is given."""
        t = self.scenario.target
        return GRADIENT_PER_PX[t.surface] if t.gradient_rel_per_px is None else t.gradient_rel_per_px

    @cached_property
    def brought_in(self) -> dict[str, dict[str, Any]]:
        """Sources that the scenario brings in, by id, with the parameters that it tells."""
        light, storage = self.scenario.light, self.scenario.storage
        found: dict[str, dict[str, Any]] = {}
        contrast = light.speckle_contrast_rel if light.speckle_contrast_rel is not None else float(light.source == "laser")
        if contrast:
            found["scene.speckle"] = {"contrast_rel": contrast}
        if light.source == "lamp":
            found["optics.flicker"] = {"frequency_hz": 2 * light.mains_hz}
        if storage.format == "jpeg":
            found["storage.jpeg"] = {"quality": storage.quality}
        if storage.format == "tape":
            found["storage.tape"] = {}
        return found
