"""The keys of a calibration's project file, and what each may hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES
from pixmetry.core.config import Model
from pixmetry.core.errors import InputError
from pixmetry.files.raw_values import parse_raw

PROJECT_SCHEMA = "pixmetry/calibration/1"

_BALANCED = "`k1` to `k3` and `c_mm`: a balanced radial form is the same lens with another c"
_AFFINE, _CENTRE = "`b1` and `b2`", "`xp_px` and `yp_px`, in pixels from the centre of the top-left pixel, y down"
OTHER_NAMES = {  # of the same parameters in certificates and other programs, and what they are here
    **dict.fromkeys(("a0", "a1", "a2", "a3", "r0", "r0_mm"), _BALANCED),
    **dict.fromkeys(("c1", "c2"), _AFFINE),
    **dict.fromkeys([f"{name}{unit}" for name in ("x0", "y0", "xh", "yh", "cx", "cy") for unit in ("", "_mm", "_px")], _CENTRE),
    **dict.fromkeys(("xp_mm", "yp_mm"), _CENTRE),
}
CAPITALS = {
    name: f"`p{name[1]}` where it is decentring (beside A1, C1), `b{name[1]}` where it is affinity or shear" for name in ("B1", "B2")
}
CAPITALS |= {name.upper(): f"`{name}`" for name in NAMES if name[0] in "kp"}  # as formulas have them
LINE_OPTIONS = ("options.loss", "options.loss_scale", "options.snoop")  # those that mean something for straight lines

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Size = Annotated[int, Field(ge=1, le=1_000_000)]
Pitch = Annotated[float, Field(gt=0, lt=1000)]  # µm
# names of points and images may look like numbers
Name = Annotated[str, Field(min_length=1), BeforeValidator(lambda v: str(v) if isinstance(v, int) and not isinstance(v, bool) else v)]


def _listed(value: Any) -> Any:
    """``c, xp, yp`` as well as ``[c, xp, yp]``."""
    return tuple(part for part in value.replace(",", " ").split() if part != "none") if isinstance(value, str) else value


def _table(value: Any) -> Any:
    """``points.csv`` as well as ``{table: points.csv}``."""
    return {"table": value} if isinstance(value, str) else value


def _one(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


class CameraEntry(Model):
    """One camera: its pixel grid, start values, and what is estimated of it."""

    name: Name = "camera"
    camera: str | None = None
    interface: Literal["digital", "analogue"] | None = None
    start_from: str | None = None
    cols: Size | None = None
    rows: Size | None = None
    pitch_um: Pitch | None = None
    pitch_x_um: Pitch | None = None
    pitch_y_um: Pitch | None = None
    direction: Literal["image_to_object", "object_to_image"] = "image_to_object"
    c_mm: Positive | None = None
    c_px: Positive | None = None
    xp_px: float | None = None
    yp_px: float | None = None
    b1: float = 0.0
    b2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    d1: float = 0.0
    d2: float = 0.0
    d3: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    projection: Literal["perspective", "equidistant", "equisolid", "stereographic", "orthographic"] = "perspective"
    free: Annotated[tuple[Literal[NAMES], ...] | None, BeforeValidator(_listed)] = None  # type: ignore[valid-type]

    @model_validator(mode="before")
    @classmethod
    def _named_here(cls, data: Any) -> Any:
        for key in data if isinstance(data, Mapping) else ():
            meant = CAPITALS.get(key) or OTHER_NAMES.get(str(key).lower())
            if meant is not None:
                remedy = f"write {meant}; signs and factors stand under 'Values of another program' in docs/calibrating.md"
                raise InputError(f"unknown key '{key}', a name of another program", allowed=", ".join(cls.model_fields), remedy=remedy)
        return data

    @model_validator(mode="after")
    def _agrees(self) -> CameraEntry:
        if self.pitch_um is not None and (self.pitch_x_um is not None or self.pitch_y_um is not None):
            raise InputError("pitch is given twice", allowed="pitch_um, or pitch_x_um with pitch_y_um", remedy="delete one of them")
        if (self.pitch_x_um is None) != (self.pitch_y_um is None):
            what, allowed = "pitch is known in one direction only", "pitch_x_um and pitch_y_um"
            raise InputError(what, allowed=allowed, remedy="add the other, or use pitch_um")
        if self.c_mm is not None and self.c_px is not None:
            raise InputError("the principal distance is given twice", allowed="c_mm or c_px", remedy="delete one of them")
        pitched = self.camera is not None or self.start_from is not None or self.pitch_um is not None or self.pitch_x_um is not None
        if self.c_mm is not None and not pitched:
            remedy = "add `pitch_um: ...` (--pixel-um), or give c_px"
            raise InputError("c_mm, but no pitch", allowed="c_mm with pitch_um, or c_px", remedy=remedy)
        if (self.cols is None) != (self.rows is None):
            raise InputError("the size of the frame is incomplete", allowed="cols and rows", remedy="add the other")
        return self


class TableModel(Model):
    """A table in a file beside the project."""

    table: str
    columns: tuple[Name, ...] | dict[str, Name] | None = None


class ObservationsModel(TableModel):
    """Image coordinates: image, point, x, y."""

    u_px: Positive | None = None


class PointsModel(TableModel):
    """Object points: point, X, Y, Z."""

    known: Literal["nominal", "fixed", "free", "weighted"] | None = None
    u: Positive | None = None


class CheckPointsModel(TableModel):
    """Object points that are compared with the result: point, X, Y, Z; u 0: exact."""

    u: NotNegative | None = None


class LinesModel(TableModel):
    """Positions on straight lines: image, line, x, y."""

    u_px: Positive | None = None


Files = Annotated[tuple[str, ...], BeforeValidator(_one)]


class PicturesModel(Model):
    """Images in which targets are located; of several cameras the files of each, by its name."""

    files: Annotated[Files | dict[Name, Files], Field(min_length=1)]
    kind: Literal["chessboard", "dots", "asymmetric", "coded", "squares", "charuco", "aprilgrid", "lines"] = "chessboard"
    grid: str | None = None
    pitch: Positive | tuple[Positive, Positive] | None = None
    side: Positive | None = None
    diameter: Positive | None = None
    polarity: Literal["auto", "bright", "dark"] = "auto"
    channel: Literal["red", "green", "blue"] | None = None
    raw: str | None = None
    noise: str | None = None
    dictionary: str | None = None

    @model_validator(mode="after")
    def _layout(self) -> PicturesModel:
        if self.raw is not None:
            parse_raw(self.raw)
        return self

    @property
    def all_files(self) -> tuple[str, ...]:
        """Those of all cameras."""
        return tuple(name for own in self.files.values() for name in own) if isinstance(self.files, dict) else self.files

    @model_validator(mode="after")
    def _plate(self) -> PicturesModel:
        given = next((key for key in ("grid", "pitch", "side", "diameter") if getattr(self, key) is not None), None)
        if self.kind == "lines" and given is not None:
            what = f"`{given}` has no meaning with straight lines"
            raise InputError(what, allowed="files, kind, polarity, channel, raw, noise", remedy="delete it, or name another kind")
        return self


class ImageCoordinatesModel(Model):
    """Unit and origin of the image coordinates of the table."""

    unit: Literal["px", "mm", "um"] | None = None
    origin: Literal["first_pixel", "corner", "centre", "one"] | None = None
    y: Literal["down", "up"] | None = None


class TargetModel(Model):
    """Size and shape of targets whose centre of area was measured."""

    shape: Literal["circle", "square"] = "circle"
    diameter: Positive | None = None
    normal: tuple[float, float, float] | None = None

    @model_validator(mode="after")
    def _direction(self) -> TargetModel:
        if self.normal is not None and not any(self.normal):
            raise InputError("a normal without direction", allowed="three numbers, not all 0", remedy="write [0, 0, 1] for a plane z = 0")
        return self


class BarModel(Model):
    """A known distance."""

    from_: Annotated[Name, Field(alias="from")]
    to: Name
    length: Positive
    u: Positive


class OptionsModel(Model):
    """How the calibration is done."""

    field: Literal["auto", "fixed", "free"] | None = None
    loss: Literal["huber", "cauchy", "none"] | None = None
    loss_scale: Positive | None = None
    snoop: bool | None = None
    false_alarms: Annotated[float, Field(gt=0, lt=100)] | None = None
    control: Literal["tested", "as_stated"] | None = None
    variance_components: bool | None = None
    eccentricity: bool | None = None
    folds: Literal[0] | Annotated[int, Field(ge=2)] | None = None
    residual_grid: bool | None = None
    a_priori: bool | None = None
    shared_errors: bool | None = None
    patterns: bool | None = None
    max_iterations: Annotated[int, Field(ge=1)] | None = None


class ProjectModel(Model):
    """A calibration: cameras, image coordinates or pictures, and what is known of the object."""

    schema_: Annotated[Literal["pixmetry/calibration/1"], Field(alias="schema")]
    name: str = ""
    unit: Literal["mm", "cm", "m", "um", "inch"] = "mm"
    cameras: Annotated[tuple[CameraEntry, ...], Field(min_length=1)]
    observations: Annotated[ObservationsModel | None, BeforeValidator(_table)] = None
    pictures: PicturesModel | None = None
    lines: Annotated[LinesModel | None, BeforeValidator(_table)] = None
    image_coordinates: ImageCoordinatesModel = ImageCoordinatesModel()
    images: Annotated[TableModel | None, BeforeValidator(_table)] = None
    points: Annotated[PointsModel | None, BeforeValidator(_table)] = None
    check_points: Annotated[CheckPointsModel | None, BeforeValidator(_table)] = None
    target: TargetModel | None = None
    scale_bars: tuple[BarModel, ...] = ()
    scale_bars_table: Annotated[TableModel | None, BeforeValidator(_table)] = None
    per_image: Annotated[tuple[Literal[PER_IMAGE_NAMES], ...], BeforeValidator(_listed)] = ()  # type: ignore[valid-type]
    scale_origin_px: float = 0.0
    rig: Literal["names"] | tuple[tuple[Name, ...], ...] | None = None
    options: OptionsModel = OptionsModel()

    @model_validator(mode="before")
    @classmethod
    def _of_a_schema(cls, data: Any) -> Any:
        if not data:
            raise InputError("the project is empty", remedy=f"begin with `schema: {PROJECT_SCHEMA}`, then cameras and observations")
        if "schema" not in data:
            raise InputError("'schema' is missing", remedy=f"begin with `schema: {PROJECT_SCHEMA}`")
        return data

    @property
    def straight(self) -> bool:
        """Whether it is about straight lines, not about points."""
        return self.lines is not None or (self.pictures is not None and self.pictures.kind == "lines")

    @model_validator(mode="after")
    def _one_source(self) -> ProjectModel:
        given = [source for source in (self.observations, self.pictures, self.lines) if source is not None]
        if len(given) != 1:
            what = "image coordinates from two sources" if given else "no image coordinates"
            allowed = "observations (a table), lines (a table) or pictures (images of targets)"
            raise InputError(what, allowed=allowed, remedy="delete one of them" if given else "add one of them")
        if self.pictures is not None and not isinstance(self.pictures.files, dict) and len(self.cameras) > 1:
            allowed = "`files` with the pictures of each camera"
            remedy = f'write `files: {{{self.cameras[0].name}: "…", {self.cameras[1].name}: "…"}}`'
            raise InputError("pictures of several cameras", where="pictures.files", allowed=allowed, remedy=remedy)
        if self.pictures is not None and "image_coordinates" in self.model_fields_set:
            what = "image_coordinates have no meaning with pictures, whose coordinates are pixmetry's own"
            raise InputError(what, allowed="with observations or lines from a table", remedy="delete it")
        names = [camera.name for camera in self.cameras]
        if self.pictures is not None and isinstance(self.pictures.files, dict) and set(self.pictures.files) != set(names):
            what, value, allowed = "pictures are not of the cameras", ", ".join(self.pictures.files), ", ".join(names)
            raise InputError(what, where="pictures.files", value=value, allowed=allowed, remedy="name each camera once in both")
        if self.rig is not None and len(names) < 2:
            raise InputError("a rig of one camera", where="rig", allowed="two cameras and more", remedy="delete it, or add the others")
        if len(set(names)) < len(names):
            raise InputError("two cameras of one name", value=", ".join(names), allowed="each name once", remedy="name them")
        if self.pictures is None and any(c.cols is None and c.camera is None and c.start_from is None for c in self.cameras):
            raise InputError("the size of the frame is missing", where="cameras", allowed="cols and rows", remedy="add them to the camera")
        return self

    @model_validator(mode="after")
    def _held(self) -> ProjectModel:
        for camera in self.cameras:
            told = camera.c_mm is not None or camera.c_px is not None or camera.start_from is not None
            if not told and not self.straight and camera.free is not None and "c" not in camera.free:
                raise InputError("c is held fixed, but has no value", remedy="give c_mm or c_px, or add c to `free`")
        return self

    @model_validator(mode="after")
    def _lines_alone(self) -> ProjectModel:
        if not self.straight:
            return self
        if len(self.cameras) > 1:
            raise InputError("straight lines of several cameras", allowed="one camera", remedy="write one project for each camera")
        given = [*self.model_fields_set, *(f"options.{name}" for name in self.options.model_fields_set)]
        allowed = ("schema_", "name", "cameras", "lines", "pictures", "image_coordinates", "options", *LINE_OPTIONS)
        wrong = next((key for key in given if key not in allowed), None)
        if wrong is not None:
            what = f"`{wrong}` has no meaning with straight lines"
            raise InputError(what, allowed=", ".join(allowed[1:]), remedy="delete it")
        return self
