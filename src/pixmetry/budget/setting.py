"""A camera in a scenario: how warm it is, at which scale it sees the object, how fast the image moves, by which light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pixmetry.budget.measured_calibration import MeasuredCalibration
from pixmetry.budget.networks import DEPTH, Images, calibrating, measuring
from pixmetry.budget.probe import Facts, Target, facts_of
from pixmetry.budget.scenario import GRADIENT_PER_PX, Scenario
from pixmetry.camera.camera import Camera, Element
from pixmetry.core.errors import InputError

DEFAULT_DIAMETER_PX = 7.0
DEFAULT_F_NUMBER = 8.0
LARGEST_PX = 80.0  # diameter of a target: what each of its pixels does is computed
FRAME_PERIOD_S = 0.04  # of a camera that tells none, unless it exposes longer
MOST_RAYS, MOST_POINTS = 12, 50  # of a network that is adjusted
SAME_SCALE = 0.1  # relative difference of two statements of the scale that may stand beside each other


def in_state(
    camera: Camera, camera_on_min: float, grabber_on_min: float, temperature_change_k: float = 0.0, warm_up_k: float = 0.0
) -> Camera:
    """The camera so long after switching on, in surroundings that are warmer by so much; its frames no longer warm up.

    ``warm_up_k`` is by how much a camera that does not tell it warms itself.
    """
    chain = tuple(_on_longer(e, camera_on_min, grabber_on_min) for e in camera.chain)
    colder = (camera.warm_up_k or warm_up_k) * float(np.exp(-60.0 * camera_on_min / camera.warm_up_s))
    return replace(camera, chain=chain, temperature_c=camera.temperature_c - colder + temperature_change_k, warm_up_k=0.0)


def _on_longer(element: Element, camera_on_min: float, grabber_on_min: float) -> Element:
    """The element as old as camera and grabber are."""
    by_s = {"grabber.clock_warm_up": 60.0 * grabber_on_min, "sensor.mount_drift": 60.0 * camera_on_min}.get(element.source.id, 0.0)
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
    made : MeasuredCalibration, optional
        The calibration that was made; without one, the scenario's.

    Raises
    ------
    InputError
        If the scenario asks for a scale of the image (sizes or speeds in mm) that nothing tells.
    """

    described: Camera
    scenario: Scenario
    made: MeasuredCalibration | None = None

    def check(self) -> None:
        """Refuse a scenario that cannot be used with this camera.

        Raises
        ------
        InputError
        """
        for name in ("camera", "target", "px_per_mm", "velocity_px_per_s", "acceleration_px_per_s2"):
            getattr(self, name)
        if self.scenario.goal.u_mm is not None:
            self.needed_scale("goal.u_mm")

    @cached_property
    def camera(self) -> Camera:
        """In the state of the measurement."""
        state = self.scenario.state
        return in_state(self._stored, state.camera_on_min, state.grabber_on_min, state.temperature_change_k, state.warm_up_k)

    @cached_property
    def calibrated(self) -> Camera:
        """In the state in which it was calibrated."""
        then = self.scenario.calibration
        return in_state(self._stored, then.camera_on_min, then.grabber_on_min, warm_up_k=self.scenario.state.warm_up_k)

    def aged(self, element: Element, camera: Camera) -> Element:
        """A source that the chain does not hold like that, as old as `camera` or `calibrated` is."""
        age = self.scenario.calibration if camera is self.calibrated else self.scenario.state
        return _on_longer(element, age.camera_on_min, age.grabber_on_min)

    @cached_property
    def _stored(self) -> Camera:
        """As described, with the aperture and the storage of the scenario."""
        asked = self.scenario.storage
        if asked.format == "tape" and self.described.facts.get("interface") == "digital":
            raise InputError("a digital camera is not stored on tape", where="storage.format", value="tape", allowed="lossless or jpeg")
        chain = tuple(self._with_aperture(e) for e in self.described.chain)
        if "format" in asked.model_fields_set:
            chain = tuple(self._as_stored(e) for e in chain)
        lossless = asked.format == "lossless" and not any(e.on and e.source.stage == "storage" for e in chain)
        return replace(self.described, chain=chain, facts={**self.described.facts, "lossless": lossless})

    def _with_aperture(self, element: Element) -> Element:
        """The element at the f-number that the scenario gives, if it has one."""
        told = self.scenario.light.f_number
        if told is None or "f_number" not in type(element.params).model_fields:
            return element
        return replace(element, params=element.source.make({**element.params.model_dump(), "f_number": told}, where="light.f_number"))

    def _as_stored(self, element: Element) -> Element:
        asked = self.scenario.storage
        if element.source.stage != "storage":
            return element
        if element.source.id != f"storage.{asked.format}":
            return replace(element, on=False)
        return replace(element, on=True, params=element.source.make({**element.params.model_dump(), **self.brought_in[element.source.id]}))

    @cached_property
    def target(self) -> Target:
        """What is measured, in pixels."""
        t = self.scenario.target
        diameter = t.diameter_px
        if t.diameter_mm is not None:
            diameter = t.diameter_mm * self.needed_scale("target.diameter_mm")
        most = min(LARGEST_PX, min(self.described.frame_shape) / 3)
        if diameter is not None and diameter > most:
            raise InputError(
                "the target is too large for a budget",
                where="target.diameter_px" if t.diameter_mm is None else "target.diameter_mm",
                value=f"{diameter:.3g} px",
                allowed=f"up to {most:.3g} px: a third of the frame, and {LARGEST_PX:g} px",
            )
        return Target("disc", DEFAULT_DIAMETER_PX if diameter is None else diameter, t.blur_px, t.peak_rel, t.background_rel)

    @cached_property
    def facts(self) -> Facts:
        """The camera's numbers, for this target."""
        return facts_of(self.camera, self.target)

    @property
    def full_well_e(self) -> float:
        """Electrons of a full pixel: what the camera's chain tells, else those of its saturation."""
        told = (getattr(e.params, "full_well_e", None) for e in self.camera.active)
        return float(next((v for v in told if v is not None), self.facts.saturation_dn / self.facts.gain_dn_per_e))

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

    @property
    def lens(self) -> dict[str, Any]:
        """Focal length and the description of the optics, whatever its aperture is set to: what another lens has otherwise."""
        optics = [e for e in self.described.chain if e.source.stage == "optics"]
        return {"f_mm": self.f_mm, "optics": {e.name: {"source": e.source.id} | e.params.model_dump(mode="json") for e in optics}}

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
        by_field = None if o.field_mm is None else self.described.frame_shape[1] / o.field_mm
        if o.distance_mm is None or self.f_mm is None or self.described.pitch_um is None:
            return by_field
        if o.distance_mm <= self.f_mm:
            raise InputError(
                "the object is nearer than the focal length",
                where="object.distance_mm",
                value=o.distance_mm,
                allowed=f"above {self.f_mm:g} mm",
            )
        by_lens = self.f_mm / (o.distance_mm - self.f_mm) * 1e3 / self.described.pitch_um[0]
        if by_field is not None and abs(by_field / by_lens - 1) > SAME_SCALE:
            raise InputError(
                "field, distance and focal length contradict each other",
                where="object.field_mm",
                value=f"{by_field:.3g} px/mm by the field, {by_lens:.3g} px/mm by distance and lens",
                remedy="leave one of the three out",
            )
        return by_lens if by_field is None else by_field

    @property
    def aspect(self) -> float:
        """Pitch in y over that in x; 1 where it is not known."""
        pitch = self.described.pitch_um
        return 1.0 if pitch is None else pitch[1] / pitch[0]

    def from_middle(self, x_px: np.ndarray, y_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places from the middle of the frame, in pixels along x."""
        rows, cols = self.described.frame_shape
        return x_px - (cols - 1) / 2, self.aspect * (y_px - (rows - 1) / 2)

    @property
    def c_px(self) -> float:
        """Principal distance over the pitch along x; of a lens that nothing tells, twice the longer side of the frame."""
        o, pitch = self.scenario.object, self.described.pitch_um
        if o.distance_mm is not None and self.px_per_mm is not None:
            return self.px_per_mm * o.distance_mm
        if self.f_mm is None or pitch is None:
            return 2.0 * max(self.described.frame_shape)
        return 1e3 * self.f_mm / pitch[0] + self.f_mm * (self.px_per_mm or 0.0)  # f (1 + magnification)

    @cached_property
    def network(self) -> Images | None:
        """Images of the scenario's points; None where one ray tells no depth."""
        count = self.scenario.count
        if count.rays < 2:
            return None
        return measuring(
            self.c_px,
            self.described.frame_shape,
            self.aspect,
            min(count.rays, MOST_RAYS),
            count.base_to_height,
            count.arrangement,
            min(count.points or MOST_POINTS, MOST_POINTS),
            self.scenario.object.filled_rel,
        )

    @cached_property
    def calibrating(self) -> Images | None:
        """Images of the scenario's calibration; None without points in space, without a calibration, or of one that was made."""
        told = self.scenario.calibration
        if self.network is None or told.model == "none" or self.made is not None:
            return None
        depth = DEPTH if told.field == "deep" else 0.0
        return calibrating(self.c_px, self.described.frame_shape, self.aspect, told.images, told.targets, depth)[0]

    @property
    def chief_ray_deg(self) -> float | None:
        """Angle of the light in the frame's corners, with the exit pupil at the focal length; None where that is unknown."""
        pitch = self.described.pitch_um
        if self.f_mm is None or pitch is None:
            return None
        rows, cols = self.described.frame_shape
        return float(np.degrees(np.arctan(0.5e-3 * np.hypot(cols * pitch[0], rows * pitch[1]) / self.f_mm)))

    @property
    def frame_period_s(self) -> float:
        """From frame to frame."""
        told = self.scenario.motion.frame_period_s or self.described.facts.get("frame_period_s")
        return float(told or max(self.described.exposure_s, FRAME_PERIOD_S))

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
        angle = np.radians(self.scenario.motion.direction_deg)
        along = np.array([np.cos(angle), np.sin(angle)])
        if px is not None or mm is None:
            return (px or 0.0) * along
        pitch = self.described.pitch_um or (1.0, 1.0)
        return mm * self.needed_scale(f"motion.{name}") * along * np.array([1.0, pitch[0] / pitch[1]])

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
        if self.scenario.target.model_fields_set & {"gradient_rel_per_px", "view_angle_deg"}:
            t = self.scenario.target
            found["scene.view_point"] = {"gradient_rel_per_px": self.gradient_rel_per_px, "view_angle_deg": t.view_angle_deg}
        return found

    @property
    def told_by_scenario(self) -> set[str]:
        """Those of them whose size it tells; of the others it only tells that they are there."""
        return set(self.brought_in) & {"storage.jpeg", "scene.view_point"}
