"""A scenario: what is measured, and how. It says what no camera says of itself: target, distance, light, motion, warm-up, calibration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from pixmetry.core.config import Model, load_yaml, validate
from pixmetry.core.errors import InputError

Surface = Literal["retro", "diffuse", "glossy"]
# Relative change of brightness across a target, per pixel, by its surface: a retro-reflective target looks the same from everywhere, a
# glossy one not. Assumed values, to be replaced by what a plane fitted to the target's own pixels shows.
GRADIENT_PER_PX = {"retro": 0.0005, "diffuse": 0.002, "glossy": 0.01}
LEAST_POINTS = 8  # that orient images


class TargetModel(Model):
    """What is measured: a round target, its size in the image or on the object, and what it looks like."""

    diameter_px: float | None = Field(default=None, ge=0.5, le=200, description="diameter in the image")
    diameter_mm: float | None = Field(default=None, gt=0, le=1e5, description="diameter on the object, in place of diameter_px")
    blur_px: float = Field(default=0.7, ge=0.05, le=20, description="standard deviation of the blur by the lens")
    peak_rel: float = Field(default=0.6, gt=0, le=1, description="height above the background, as a part of saturation")
    background_rel: float = Field(default=0.02, ge=0, lt=1, description="background, as a part of saturation")
    surface: Surface = Field(default="diffuse", description="how it reflects: sets the gradient of brightness over the target")
    gradient_rel_per_px: float | None = Field(default=None, ge=0, le=0.2, description="gradient of brightness, in place of the surface's")
    view_angle_deg: float = Field(default=0.0, ge=0, lt=85, description="largest angle between the line of sight and the target's normal")


class ObjectModel(Model):
    """Where it is: distance, and the lens or the field of view that gives the scale of the image."""

    distance_mm: float | None = Field(default=None, gt=0, le=1e8, description="from the lens to the object")
    field_mm: float | None = Field(default=None, gt=0, le=1e8, description="width of the object that fills a row of the frame")
    f_mm: float | None = Field(default=None, gt=0, le=1e5, description="principal distance, where the camera does not tell its lens")
    filled_rel: float = Field(default=0.8, gt=0.01, le=0.95, description="part of the frame's width and height that its points fill")


class LightModel(Model):
    """What lights it."""

    source: Literal["lamp", "led", "laser"] = Field(default="led", description="a laser makes speckle; a lamp on mains flickers")
    wavelength_nm: float = Field(default=550.0, ge=200, le=1100, description="mean wavelength")
    f_number: float | None = Field(default=None, ge=0.7, le=64, description="of the lens, in place of what the camera tells")
    speckle_contrast_rel: float | None = Field(default=None, ge=0, le=1, description="of a laser spot; 1 for a rough surface at rest")
    mains_hz: float = Field(default=50.0, gt=0, le=1000, description="of the supply; a lamp flickers at twice this frequency")


class MotionModel(Model):
    """How it moves while it is seen, in the image or on the object."""

    speed_px_per_s: float | None = Field(default=None, ge=0, le=1e7)
    speed_mm_per_s: float | None = Field(default=None, ge=0, le=1e8, description="on the object, in place of speed_px_per_s")
    acceleration_px_per_s2: float | None = Field(default=None, ge=0, le=1e9)
    acceleration_mm_per_s2: float | None = Field(default=None, ge=0, le=1e10, description="on the object")
    direction_deg: float = Field(default=0.0, ge=-360, le=360, description="0: along the rows; 90: down the columns")
    frame_period_s: float | None = Field(default=None, gt=0, le=1e6, description="from frame to frame, where the camera does not tell it")


class StateModel(Model):
    """How warm it all is."""

    camera_on_min: float = Field(default=120.0, ge=0, le=1e6, description="time since the camera was switched on")
    grabber_on_min: float = Field(default=120.0, ge=0, le=1e6, description="time since the frame grabber was switched on")
    temperature_change_k: float = Field(default=0.0, ge=-100, le=100, description="of the surroundings, since the calibration")
    warm_up_k: float = Field(default=10.0, ge=0, le=100, description="by which a camera that does not tell it warms itself (assumed)")


class CountModel(Model):
    """How much is averaged, and by how many rays a point is found."""

    frames: int = Field(default=1, ge=1, le=1_000_000, description="frames of which the mean is taken")
    targets: int = Field(default=1, ge=1, le=1_000_000, description="targets of which the mean is taken")
    rays: int = Field(default=2, ge=1, le=10_000, description="images in which a point is seen; 1: no depth")
    base_to_height: float = Field(default=0.5, gt=0, le=10, description="distance of the outermost cameras over that of the object")
    arrangement: Literal["circle", "row"] = Field(default="circle", description="of the cameras, with the base as its diameter or length")
    points: int = Field(
        default=50, ge=0, le=10_000, description="that all images see, and by which these are oriented; 0: orientations are known"
    )


class CalibrationModel(Model):
    """What of the camera's geometry was calibrated, and in which state the camera was then."""

    model: Literal["none", "principal_point_and_scale", "lens", "residual_grid"] = Field(
        default="lens",
        description="what positions are corrected for: nothing; shift and scales; these and a polynomial of the lens; these and a grid",
    )
    grid_px: float = Field(default=100.0, ge=4, le=1e5, description="spacing of the residual grid")
    every_image: bool = Field(default=False, description="shift and scales are determined anew in every image")
    images: int = Field(default=20, ge=3, le=100_000, description="oblique images, rolled by quarters, from which it was made")
    targets: int = Field(default=100, ge=8, le=1_000_000, description="of each of them, all over the frame")
    field: Literal["flat", "deep"] = Field(default="flat", description="its targets lie in a plane, or also a quarter of its width deep")
    noise_px: float | None = Field(
        default=None, ge=0, le=10, description="standard deviation of their image coordinates; not given: as in the measurement"
    )
    camera_on_min: float = Field(default=120.0, ge=0, le=1e6, description="time since switching on at which it was made")
    grabber_on_min: float = Field(default=120.0, ge=0, le=1e6)


class StorageModel(Model):
    """How frames are stored."""

    format: Literal["lossless", "jpeg", "tape"] = "lossless"
    quality: int = Field(default=90, ge=1, le=100, description="of JPEG")


class GoalModel(Model):
    """What is wanted: the standard uncertainty (k = 1) of a position in x and in y, of the mean over frames and targets."""

    u_px: float | None = Field(default=None, gt=0, le=1e3)
    u_mm: float | None = Field(default=None, gt=0, le=1e5, description="on the object, in place of u_px")


class Scenario(Model):
    """What is measured and how; every entry has a default that is printed with the result.

    Examples
    --------
    >>> from pixmetry.budget.scenario import Scenario
    >>> Scenario(motion={"speed_px_per_s": 50}).motion.speed_px_per_s
    50.0
    """

    schema_: Literal["pixmetry/scenario/1"] = Field(default="pixmetry/scenario/1", alias="schema")
    target: TargetModel = TargetModel()
    object: ObjectModel = ObjectModel()
    light: LightModel = LightModel()
    motion: MotionModel = MotionModel()
    state: StateModel = StateModel()
    count: CountModel = CountModel()
    calibration: CalibrationModel = CalibrationModel()
    storage: StorageModel = StorageModel()
    goal: GoalModel = GoalModel()

    @model_validator(mode="after")
    def _one_unit_each(self) -> Scenario:
        if 0 < self.count.points < LEAST_POINTS:
            raise ValueError(f"count.points: at least {LEAST_POINTS} orient images; 0 where orientations are known")
        pairs = (
            (self.target, "diameter_px", "diameter_mm"),
            (self.goal, "u_px", "u_mm"),
            (self.motion, "speed_px_per_s", "speed_mm_per_s"),
            (self.motion, "acceleration_px_per_s2", "acceleration_mm_per_s2"),
        )
        for part, one, other in pairs:
            if getattr(part, one) is not None and getattr(part, other) is not None:
                raise ValueError(f"{one} and {other} say the same: give one of them")
        if self.object.field_mm is not None and self.object.f_mm is not None and self.object.distance_mm is not None:
            raise ValueError("field_mm, f_mm and distance_mm: two of them give the third")
        return self

    @property
    def told(self) -> dict[str, tuple[Any, bool]]:
        """Every entry by its name, as ``motion.direction_deg``: its value (None if not given), and whether the user gave it."""
        found: dict[str, tuple[Any, bool]] = {}
        for part in type(self).model_fields:
            if part == "schema_":
                continue
            model = getattr(self, part)
            for name in type(model).model_fields:
                found[f"{part}.{name}"] = getattr(model, name), name in model.model_fields_set
        return found


def read_scenario(source: str | Path | Mapping[str, Any] | Scenario | None = None) -> Scenario:
    """Read a scenario from a YAML file (schema ``pixmetry/scenario/1``) or a mapping; without one, the defaults.

    Raises
    ------
    InputError
        With the file, the line, and what is allowed there.
    """
    if isinstance(source, Scenario):
        return source
    if source is None:
        return Scenario()
    if isinstance(source, Mapping):
        return validate(Scenario, source, "scenario")
    if not Path(source).is_file():
        raise InputError(
            "no such scenario file", value=str(source), remedy="give a YAML file that begins with `schema: pixmetry/scenario/1`"
        )
    return validate(Scenario, load_yaml(source), str(source))
