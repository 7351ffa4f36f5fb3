"""The keys of a campaign's manifest, and their allowed values."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.config import Model
from pixmetry.core.errors import InputError
from pixmetry.files.raw_values import RawLayout
from pixmetry.files.records import FACTS, TARGETS

CAMPAIGN_SCHEMA = "pixmetry/campaign/1"

Positive = Annotated[float, Field(gt=0)]
Pitch = Annotated[float, Field(ge=0.1, le=1000)]  # µm
Side = Annotated[int, Field(ge=1, le=1_000_000)]
FromZero = Annotated[int, Field(ge=0, le=1_000_000)]


def _quoted(value: Any) -> Any:
    """A serial number of digits alone is a number for YAML, and zeros at its head are gone."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        raise InputError("a number in place of a text", value=value, allowed="a text in quotes", remedy="put it in quotes, as in '0815'")
    return value


Text = Annotated[str, Field(min_length=1), BeforeValidator(_quoted)]
Names = Annotated[
    tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1), BeforeValidator(lambda v: (v,) if isinstance(v, str) else v)
]


class CoveredModel(Model):
    """Columns and rows at the borders of the stored frames that no light reaches."""

    left: Annotated[int, Field(ge=0, le=10_000)] = 0
    right: Annotated[int, Field(ge=0, le=10_000)] = 0
    top: Annotated[int, Field(ge=0, le=10_000)] = 0
    bottom: Annotated[int, Field(ge=0, le=10_000)] = 0


class CameraModel(Model):
    """Facts of the camera."""

    name: str
    bits: Annotated[int, Field(ge=1, le=16)]
    pitch_um: Pitch | None = None
    pitch_x_um: Pitch | None = None
    pitch_y_um: Pitch | None = None
    interface: Literal["digital", "analogue"] = "digital"
    sensor: Literal["ccd", "cmos", "cid"] | None = None
    temperature_c: Annotated[float, Field(ge=-273.15)] | None = None
    pixel_clock_mhz: Positive | None = None
    sampling_clock_mhz: Positive | None = None
    line_time_us: Annotated[float, Field(gt=0, le=1e5)] | None = None
    cfa: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    vendor: Text | None = None
    model: Text | None = None
    serial_number: Text | None = None
    sensor_cols: Side | None = None
    sensor_rows: Side | None = None
    first_col: Annotated[int, Field(ge=0)] | None = None
    first_row: Annotated[int, Field(ge=0)] | None = None
    covered: CoveredModel | None = None
    lossless: bool | None = None

    @model_validator(mode="after")
    def _whole_sensor(self) -> CameraModel:
        for one, other in (("sensor_cols", "sensor_rows"), ("first_col", "first_row")):
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                raise InputError(f"{one} and {other} belong together", allowed="both or neither", remedy="add the one that is missing")
        if self.first_col is not None and self.sensor_cols is None:
            raise InputError("a window, but no size of the sensor", remedy="add sensor_cols and sensor_rows")
        return self

    @model_validator(mode="after")
    def _one_pitch(self) -> CameraModel:
        if self.pitch_um is not None and (self.pitch_x_um is not None or self.pitch_y_um is not None):
            raise InputError("pitch is given twice", allowed="pitch_um, or pitch_x_um with pitch_y_um", remedy="delete one of them")
        if (self.pitch_x_um is None) != (self.pitch_y_um is None):
            raise InputError(
                "pitch is known in one direction only", allowed="pitch_x_um and pitch_y_um", remedy="add the other, or use pitch_um"
            )
        return self


class OpticsModel(Model):
    """Facts of light and lens."""

    wavelength_nm: Annotated[float, Field(ge=10, le=20000)] | None = None
    f_number: Positive | None = None
    focal_length_mm: Positive | None = None
    irradiance_uw_per_cm2: Positive | None = None
    light_source: Text | None = None


class GroupModel(Model):
    """Frames under one condition."""

    # records.KINDS and TARGETS
    kind: Literal[
        "dark",
        "bright",
        "edge",
        "light_off",
        "chart",
        "line",
        "covered",
        "spots",
        "pattern",
        "dark_temperature",
        "border",
        "series",
        "motion",
        "speckle",
        "sequence",
        "views",
        "bands",
        "recording",
    ]
    exposure_s: Annotated[float, Field(ge=0)] | None = None
    photons: Annotated[float, Field(ge=0)] | None = None
    irradiance_uw_per_cm2: Positive | None = None
    role: Literal["level", "stack"] | None = None
    wavelength_nm: Positive | None = None
    focus_um: Annotated[float, Field(ge=-1e5, le=1e5)] | None = None
    temperature_c: Annotated[float, Field(ge=-273.15)] | None = None
    densities: Annotated[tuple[Annotated[float, Field(ge=0, le=8)], ...], Field(min_length=1)] | None = None
    luminances: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    u_light_rel: Annotated[float, Field(gt=0, le=1)] | None = None
    regions: Annotated[tuple[tuple[FromZero, FromZero, Side, Side], ...], Field(min_length=1)] | None = None
    white: bool | None = None
    times_s: Annotated[tuple[float, ...], Field(min_length=1)] | None = None
    temperatures_c: Annotated[tuple[Annotated[float, Field(ge=-273.15)], ...], Field(min_length=1)] | None = None
    interval_s: Positive | None = None
    on_for_s: Annotated[float, Field(ge=0)] | None = None
    recorded: bool | None = None
    pulsed: bool | None = None
    band: Text | None = None
    filtered: bool | None = None
    refocused: bool | None = None
    channel: Literal["red", "green", "blue"] | None = None
    files: Names

    @model_validator(mode="before")
    @classmethod
    def _of_a_temperature(cls, data: Any) -> Any:
        """Dark frames that state a temperature are no part of the photon transfer, which has that of the campaign."""
        if isinstance(data, dict) and data.get("kind") == "dark" and data.get("temperature_c") is not None:
            return {**data, "kind": "dark_temperature", "role": None}
        return data

    @model_validator(mode="after")
    def _target(self) -> GroupModel:
        allowed = ("kind", "exposure_s", *FACTS.get(self.kind, ()), "files")
        for name in (f.name for f in fields(GroupFacts)):
            if name not in allowed and getattr(self, name) is not None:
                raise InputError(f"{name} is not said of {self.kind} frames", allowed=", ".join(allowed), remedy="delete it")
        if self.kind not in TARGETS:
            if self.exposure_s is None:
                raise InputError(f"a {self.kind} group without exposure time", allowed="0 or more seconds", remedy="add exposure_s")
            return self
        wrong = [name for name in ("photons", "irradiance_uw_per_cm2", "role") if getattr(self, name) is not None]
        if wrong:
            what = f"{wrong[0]} belongs to dark and bright frames, not to pictures of a target"
            raise InputError(what, allowed=", ".join(allowed), remedy="delete it")
        return self

    @model_validator(mode="after")
    def _temperature(self) -> GroupModel:
        if self.kind == "dark_temperature" and (self.temperature_c is None or self.exposure_s is None):
            missing = "temperature_c" if self.temperature_c is None else "exposure_s"
            what = f"dark frames at another temperature without {missing}"
            raise InputError(what, allowed="temperature_c and exposure_s", remedy=f"add {missing}")
        return self

    @model_validator(mode="after")
    def _chart(self) -> GroupModel:
        if self.kind != "chart":
            return self
        light = self.densities or self.luminances
        if self.densities and self.luminances:
            raise InputError("the light of the patches is given twice", allowed="densities or luminances", remedy="delete one of them")
        if self.white and (light or self.regions):
            raise InputError(
                "a white sheet has no patches", allowed="white without densities, luminances and regions", remedy="delete them"
            )
        if self.regions and (light is None or len(light) != len(self.regions)):
            count = 0 if light is None else len(light)
            what = f"{len(self.regions)} regions and {count} patches"
            raise InputError(what, allowed="one density or luminance for each region", remedy="list them in the order of the regions")
        if light is None and not self.white and not self.exposure_s:
            allowed = "densities or luminances of its patches; or exposure_s, of one scene at several exposures"
            raise InputError("nothing is known of the light of a chart", allowed=allowed, remedy="add one of them")
        return self

    @model_validator(mode="after")
    def _times(self) -> GroupModel:
        if self.kind in ("series", "motion") and (self.times_s is None) == (self.interval_s is None):
            what = f"frames of kind {self.kind} without times" if self.times_s is None else "times are given twice"
            raise InputError(what, allowed="times_s (one for each frame) or interval_s", remedy="give one of them")
        if self.kind == "sequence" and self.times_s is not None and self.interval_s is not None:
            raise InputError("times are given twice", allowed="times_s or interval_s", remedy="delete one of them")
        return self

    @model_validator(mode="after")
    def _band(self) -> GroupModel:
        if self.kind == "bands" and self.wavelength_nm is None:
            raise InputError(
                "frames of kind bands without wavelength", allowed="wavelength_nm of the band's light", remedy="add wavelength_nm"
            )
        return self

    def facts(self) -> GroupFacts:
        """What it says beside kind, exposure and light."""
        return GroupFacts(**{f.name: getattr(self, f.name) for f in fields(GroupFacts)})

    @model_validator(mode="after")
    def _light(self) -> GroupModel:
        if self.kind == "dark" and (self.photons or self.irradiance_uw_per_cm2):
            raise InputError("a dark group has light", allowed="no photons and no irradiance", remedy="write kind: bright, or delete them")
        if self.kind == "bright" and (self.photons == 0 or self.exposure_s == 0 and self.photons is None):
            raise InputError(
                "a bright group without exposure or photons", allowed="values above 0", remedy="write kind: dark, or correct them"
            )
        if self.photons is not None and self.irradiance_uw_per_cm2 is not None:
            raise InputError("light is given twice", allowed="photons or irradiance_uw_per_cm2", remedy="delete one of them")
        return self


class RawModel(Model):
    """Layout of frames in files without a header."""

    width: Side
    height: Side
    pixel_format: str
    skip_bytes: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _known(self) -> RawModel:
        RawLayout(**self.model_dump())
        return self


class ManifestModel(Model):
    """A campaign: facts, and frames listed here or in an EMVA 1288 descriptor."""

    schema_: Annotated[Literal["pixmetry/campaign/1"], Field(alias="schema")]
    camera: CameraModel
    optics: Annotated[OpticsModel, BeforeValidator(lambda v: v or {})] = OpticsModel()
    frames: Annotated[tuple[GroupModel, ...], BeforeValidator(lambda v: v or ())] = ()
    emva_descriptor: str | None = None
    raw: RawModel | None = None
    licence: str = ""
    notes: str = ""
    operator: str = ""

    @model_validator(mode="before")
    @classmethod
    def _not_empty(cls, data: Any) -> Any:
        if not data:
            raise InputError("the manifest is empty", remedy=f"begin with `schema: {CAMPAIGN_SCHEMA}`, then camera and frames")
        return data

    @model_validator(mode="after")
    def _one_list(self) -> ManifestModel:
        if self.frames and self.emva_descriptor:
            raise InputError("frames are listed twice", allowed="frames or emva_descriptor", remedy="delete one of them")
        return self
