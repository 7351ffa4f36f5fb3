"""The record of a camera file."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from pixmetry.core.config import Model
from pixmetry.core.errors import InputError


class UncertaintyRecord(Model):
    """How uncertain a parameter is, as the parameter's value stands or with the best estimate or the limit in place of it."""

    u: float = Field(default=0.0, ge=0)
    dof: float | None = Field(default=None, gt=0)
    value: float | None = None
    upper_limit: float | None = None
    lower_limit: float | None = None
    unit: str = ""
    reason: str = ""

    @model_validator(mode="before")
    @classmethod
    def _u_alone(cls, data: Any) -> Any:
        return {"u": data} if isinstance(data, int | float | str) else data

    @model_validator(mode="after")
    def _one_value(self) -> UncertaintyRecord:
        if sum(v is not None for v in (self.value, self.upper_limit, self.lower_limit)) > 1:
            raise InputError("two values of one parameter", allowed="one of value, upper_limit and lower_limit", remedy="delete the others")
        return self


class ElementRecord(Model):
    """One entry of a camera's chain; what it says of uncertainties is explained in ``camera.provenance``."""

    source: str
    name: str | None = None
    enabled: bool = True
    parameters: dict[str, Any] = {}
    known_from: Literal["measured", "sheet", "typical", ""] = ""
    uncertainties: dict[str, UncertaintyRecord] = {}
    covariance: dict[str, dict[str, float]] = {}
    method: str = ""
    confounders: tuple[str, ...] = ()
    maps: dict[str, str] = {}


class MeasuredRecord(Model):
    """The unit whose maps stand in the archive beside the camera file, and their size."""

    unit_seed: int = Field(ge=0)
    rows: int = Field(ge=1)
    cols: int = Field(ge=1)
    file: str | None = Field(default=None, pattern=r"^[^/\\]+$")  # name of the archive in the folder of the camera file


class CameraRecord(Model):
    """A camera file, schema ``pixmetry/camera/1``."""

    schema_: Literal["pixmetry/camera/1"] = Field(alias="schema")
    name: str
    rows: int = Field(ge=1, le=100_000)
    cols: int = Field(ge=1, le=100_000)
    pitch_x_um: float | None = Field(default=None, gt=0)
    pitch_y_um: float | None = Field(default=None, gt=0)
    exposure_s: float = Field(default=0.01, gt=0)
    temperature_c: float = Field(default=20.0, gt=-273.15)
    warm_up_k: float = Field(default=0.0, ge=-200, le=200)
    warm_up_s: float = Field(default=1800.0, gt=0)
    pixel_clock_hz: float = Field(default=14.1875e6, gt=0, le=1e12)
    line_period_s: float = Field(default=64e-6, gt=0)
    unit_seed: int = Field(default=0, ge=0)
    measured: MeasuredRecord | None = None
    facts: dict[str, Any] = {}
    chain: list[ElementRecord]
