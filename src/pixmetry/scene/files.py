"""Scenes from YAML files, schema ``pixmetry/scene/1``: keys, units and ranges of the file, and the scene that it describes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from pixmetry.core.config import Model, load_yaml, validate
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.scene import outlines
from pixmetry.scene.discs import Discs
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.motion import STILL, Motion
from pixmetry.scene.outlines import Outline
from pixmetry.scene.picture import Layer, Picture
from pixmetry.scene.plates import Pose, chessboard, dot_plate
from pixmetry.scene.shapes import Shapes, Sine
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

SHOWN = ("uniform", "discs", "targets", "plate", "spot", "photon_transfer")
Place = Annotated[float, Field(ge=-1e5, le=1e5)]
Angle = Annotated[float, Field(ge=-360, le=360)]
Size = Annotated[float, Field(gt=0, le=1e5)]
Peak = Annotated[float, Field(ge=-1e9, le=1e9)]
Pair = tuple[float, float]


class UniformModel(Model):
    """A uniform field."""

    level_photons: float = Field(ge=0, le=1e9)
    gradient_x_per_px: float = Field(default=0.0, ge=-0.01, le=0.01)
    gradient_y_per_px: float = Field(default=0.0, ge=-0.01, le=0.01)
    reference_exposure_s: float | None = Field(default=None, gt=0)


class DiscsModel(Model):
    """Discs, placed one by one or on a lattice whose rows and columns are not whole pixels apart."""

    x_px: list[float] = []
    y_px: list[float] = []
    lattice_px: float | None = Field(default=None, ge=4)
    diameter_px: float = Field(default=7.0, gt=0, le=1000)
    blur_px: float = Field(default=0.7, ge=0.05, le=100)
    peak_photons: float = Field(default=1000.0, ge=-1e9, le=1e9)


class SeriesModel(Model):
    """A photon-transfer campaign: exposure levels of a uniform field up to the brightest, dark frames, and two stacks."""

    levels: int = Field(default=50, ge=4, le=1000)
    frames_per_level: int = Field(default=2, ge=2, le=7)
    brightest_photons: float = Field(gt=0, le=1e9)
    longest_exposure_s: float = Field(default=0.01, gt=0, le=1e4)
    stack_frames: int = Field(default=50, ge=8, le=10000)
    stack_rel: float = Field(default=0.5, gt=0, lt=1)


class TargetModel(Model):
    """What every target has: ``still`` takes it out of the scene's motion."""

    x_px: Place
    y_px: Place
    still: bool = False


class HighTarget(TargetModel):
    """A target with a height above the background."""

    peak_photons: Peak = 1000.0


class DiscModel(HighTarget):
    kind: Literal["disc"]
    diameter_px: Size


class EllipseModel(HighTarget):
    kind: Literal["ellipse"]
    width_px: Size
    height_px: Size
    angle_deg: Angle = 0.0


class RingModel(HighTarget):
    kind: Literal["ring"]
    diameter_px: Size
    inner_px: Size


class CrossModel(HighTarget):
    kind: Literal["cross"]
    size_px: Size
    width_px: Size
    angle_deg: Angle = 0.0


class LineModel(HighTarget):
    kind: Literal["line", "wire"]
    length_px: Size
    width_px: Size
    angle_deg: Angle = 0.0


class EdgeModel(HighTarget):
    kind: Literal["edge"]
    angle_deg: Angle = 5.0


class StarModel(HighTarget):
    kind: Literal["star"]
    diameter_px: Size
    inner_px: float = Field(default=0.0, ge=0, le=1e5)
    sectors: int = Field(default=36, ge=2, le=720)
    angle_deg: Angle = 0.0


class BarsModel(HighTarget):
    kind: Literal["bars"]
    period_px: Size
    count: int = Field(ge=1, le=10000)
    length_px: Size
    duty_rel: float = Field(default=0.5, gt=0, lt=1)
    angle_deg: Angle = 0.0


class StepsModel(TargetModel):
    kind: Literal["steps"]
    patch_px: Size
    levels_photons: tuple[Peak, ...] = Field(min_length=1, max_length=10000)
    columns: int = Field(ge=1, le=10000)
    gap_px: float = Field(default=0.0, ge=0, le=1e5)
    angle_deg: Angle = 0.0


class SineModel(Model):
    """A sinusoidal grating over the whole plane."""

    kind: Literal["sine"]
    period_px: float = Field(ge=0.1, le=1e6)
    angle_deg: Angle = 0.0
    phase_deg: float = 0.0
    mean_photons: float = Field(ge=0, le=1e9)
    contrast_rel: float = Field(default=1.0, ge=0, le=1)
    still: bool = False


KINDS: dict[str, type[Model]] = {
    "disc": DiscModel,
    "ellipse": EllipseModel,
    "ring": RingModel,
    "cross": CrossModel,
    "line": LineModel,
    "wire": LineModel,
    "edge": EdgeModel,
    "star": StarModel,
    "bars": BarsModel,
    "steps": StepsModel,
    "sine": SineModel,
}


def _of_kind(kinds: Mapping[str, type[Model]], data: Any, what: str) -> Model:
    """Check a record by its ``kind``, so that messages name the keys of that kind."""
    if isinstance(data, Model):
        return data
    if not isinstance(data, Mapping):
        raise InputError(
            f"a {what} has no keys", allowed="kind: … and its other keys", remedy=f"write `kind: {next(iter(kinds))}` and its keys"
        )
    if data.get("kind") not in kinds:
        problem = f"no such kind of {what}" if "kind" in data else f"a {what} lacks its kind"
        raise InputError(problem, value=data.get("kind"), allowed=", ".join(kinds), remedy="write `kind: …`")
    return validate(kinds[data["kind"]], data)


class PoseModel(Model):
    """Pose of a plate in front of a pinhole camera."""

    principal_distance_px: float = Field(gt=0, le=1e7)
    principal_x_px: float | None = Field(default=None, ge=-1e5, le=1e5)
    principal_y_px: float | None = Field(default=None, ge=-1e5, le=1e5)
    omega_deg: Angle = 0.0
    phi_deg: Angle = 0.0
    kappa_deg: Angle = 0.0
    x_mm: float = Field(default=0.0, ge=-1e6, le=1e6)
    y_mm: float = Field(default=0.0, ge=-1e6, le=1e6)
    z_mm: float = Field(gt=0, le=1e7)


class DotsModel(Model):
    kind: Literal["dots"]
    rows: int = Field(ge=1, le=1000)
    columns: int = Field(ge=1, le=1000)
    pitch_mm: float = Field(default=1.0, gt=0, le=1e5)
    diameter_mm: float = Field(gt=0, le=1e5)
    peak_photons: Peak = 1000.0
    still: bool = False
    pose: PoseModel


class ChessboardModel(Model):
    kind: Literal["chessboard"]
    rows: int = Field(ge=2, le=1000)
    columns: int = Field(ge=2, le=1000)
    square_mm: float = Field(gt=0, le=1e5)
    peak_photons: Peak = 1000.0
    still: bool = False
    pose: PoseModel


PLATES: dict[str, type[Model]] = {"dots": DotsModel, "chessboard": ChessboardModel}


class SpotModel(Model):
    """A laser spot with speckle."""

    x_px: Place
    y_px: Place
    radius_px: float = Field(gt=0, le=1e4)
    peak_photons: float = Field(ge=0, le=1e9)
    profile: Literal["gaussian", "uniform"] = "gaussian"
    wavelength_um: float = Field(gt=0, le=100)
    f_number: float = Field(gt=0, le=1000)
    pitch_um: float = Field(gt=0, le=1000)
    contrast_rel: float = Field(default=1.0, ge=0, le=1)
    seed: int = Field(default=0, ge=0)
    frames_each: int = Field(default=1, ge=0)
    still: bool = False


class MotionModel(Model):
    """How everything that is not still moves."""

    velocity_px_per_s: Pair = (0.0, 0.0)
    acceleration_px_per_s2: Pair = (0.0, 0.0)
    amplitude_px: Pair = (0.0, 0.0)
    frequency_hz: float = Field(default=0.0, ge=0, le=1e9)
    phase_deg: float = 0.0
    table_px: tuple[Pair, ...] | None = Field(default=None, min_length=1)


class LightingModel(Model):
    """How brightly the surface looks from place to place."""

    surface: Literal["gradient", "lambert", "glossy", "retro"]
    x_px: Place | None = None
    y_px: Place | None = None
    gradient_x_per_px: float = Field(default=0.0, ge=-1, le=1)
    gradient_y_per_px: float = Field(default=0.0, ge=-1, le=1)
    lamp_px: tuple[float, float, float] = (0.0, 0.0, 1e5)
    camera_distance_px: float = Field(default=1e5, gt=0, le=1e9)
    tilt_x_deg: float = Field(default=0.0, gt=-89, lt=89)
    tilt_y_deg: float = Field(default=0.0, gt=-89, lt=89)
    lobe_gain: float = Field(default=1.0, ge=0, le=1e6)
    lobe_exponent: float = Field(default=20.0, gt=0, le=1e5)
    lobe_width_deg: float = Field(default=0.5, gt=0, le=90)
    relative_to: Literal["centre", "facing"] = "centre"


Target = Annotated[Any, BeforeValidator(lambda data: _of_kind(KINDS, data, "target"))]
Plate = Annotated[Any, BeforeValidator(lambda data: None if data is None else _of_kind(PLATES, data, "plate"))]


class SceneModel(Model):
    """A scene file, schema ``pixmetry/scene/1``."""

    schema_: Literal["pixmetry/scene/1"] = Field(alias="schema")
    uniform: UniformModel | None = None
    discs: DiscsModel | None = None
    photon_transfer: SeriesModel | None = None
    targets: tuple[Target, ...] = ()
    plate: Plate = None
    spot: SpotModel | None = None
    blur_px: float = Field(default=0.0, ge=0, le=100)
    motion: MotionModel | None = None
    lighting: LightingModel | None = None


DRAWN: dict[str, Callable[[Any], Outline | list[Outline]]] = {
    "disc": lambda t: outlines.disc(t.x_px, t.y_px, t.diameter_px, t.peak_photons),
    "ellipse": lambda t: outlines.ellipse(t.x_px, t.y_px, t.width_px, t.height_px, t.angle_deg, t.peak_photons),
    "ring": lambda t: outlines.ring(t.x_px, t.y_px, t.diameter_px, t.inner_px, t.peak_photons),
    "cross": lambda t: outlines.cross(t.x_px, t.y_px, t.size_px, t.width_px, t.angle_deg, t.peak_photons),
    "line": lambda t: outlines.line(t.x_px, t.y_px, t.length_px, t.width_px, t.angle_deg, t.peak_photons),
    "wire": lambda t: outlines.line(t.x_px, t.y_px, t.length_px, t.width_px, t.angle_deg, t.peak_photons, "wire"),
    "edge": lambda t: outlines.edge(t.x_px, t.y_px, t.angle_deg, t.peak_photons),
    "star": lambda t: outlines.star(t.x_px, t.y_px, t.diameter_px, t.sectors, t.inner_px, t.angle_deg, t.peak_photons),
    "bars": lambda t: outlines.bars(t.x_px, t.y_px, t.period_px, t.count, t.length_px, t.angle_deg, t.duty_rel, t.peak_photons),
    "steps": lambda t: outlines.step_chart(t.x_px, t.y_px, t.patch_px, t.levels_photons, t.columns, t.gap_px, t.angle_deg),
}


def background_of(model: SceneModel) -> Uniform:
    """The uniform field of a checked record; dark where it has none."""
    return Uniform(**model.uniform.model_dump()) if model.uniform is not None else Uniform()


def build_scene(model: SceneModel, frame_shape: tuple[int, int], where: str = "scene") -> Uniform | Discs | Picture:
    """Build the scene of a checked record for a frame of this size; ``where`` is its file, for messages.

    Raises
    ------
    InputError
        If parts of it do not fit together.
    """
    background = background_of(model)
    layered = bool(model.targets) or any(v is not None for v in (model.plate, model.spot, model.motion, model.lighting))
    if not layered:
        return background if model.discs is None else _discs(model.discs, frame_shape, background)
    try:
        motion = STILL if model.motion is None else Motion(**model.motion.model_dump())
        layers = [*_targets(model, motion), *_plate(model, motion, frame_shape), *_spot(model, motion)]
        if model.discs is not None:
            layers += [_discs(model.discs, frame_shape, Uniform()).layer(motion)]
        return Picture(tuple(layers), background, _lighting(model, frame_shape))
    except ParameterError as problem:
        place = ": ".join(part for part in (where, problem.where) if part)
        raise InputError(problem.what, where=place, value=problem.value, allowed=problem.allowed, remedy=problem.remedy) from None


def _discs(discs: DiscsModel, frame_shape: tuple[int, int], background: Uniform) -> Discs:
    x, y = list(discs.x_px), list(discs.y_px)
    if discs.lattice_px is not None:
        rows, cols = frame_shape
        half = 0.5 * discs.lattice_px
        for i in range(int(rows / discs.lattice_px)):
            for j in range(int(cols / discs.lattice_px)):
                # an irrational part of a pixel, so that all places within the pixel occur
                x.append(half + j * discs.lattice_px + (0.6180339887 * i) % 1 - 0.5)
                y.append(half + i * discs.lattice_px + (0.6180339887 * j) % 1 - 0.5)
    return Discs(np.array(x), np.array(y), discs.diameter_px, discs.blur_px, discs.peak_photons, background)


def _targets(model: SceneModel, motion: Motion) -> list[Layer]:
    layers: list[Layer] = []
    for still, group in groupby(model.targets, key=lambda t: bool(t.still)):  # the truth lists the targets in the order of the file
        moves, some = STILL if still else motion, list(group)
        drawn = [DRAWN[t.kind](t) for t in some if t.kind != "sine"]
        flat = [o for d in drawn for o in (d if isinstance(d, list) else [d])]
        if flat:
            layers.append(Shapes.of(flat, model.blur_px, moves))
        layers += [
            Sine(t.period_px, t.angle_deg, t.phase_deg, t.mean_photons, t.contrast_rel, model.blur_px, moves)
            for t in some
            if t.kind == "sine"
        ]
    return layers


def _plate(model: SceneModel, motion: Motion, frame_shape: tuple[int, int]) -> Sequence[Layer]:
    plate = model.plate
    if plate is None:
        return []
    given = {k: v for k, v in plate.pose.model_dump().items() if v is not None}
    middle = {"principal_x_px": 0.5 * (frame_shape[1] - 1), "principal_y_px": 0.5 * (frame_shape[0] - 1)}
    pose, moves = Pose(**(middle | given)), STILL if plate.still else motion
    if plate.kind == "dots":
        return [dot_plate(pose, plate.rows, plate.columns, plate.pitch_mm, plate.diameter_mm, plate.peak_photons, model.blur_px, moves)]
    return [chessboard(pose, plate.rows, plate.columns, plate.square_mm, plate.peak_photons, model.blur_px, moves)]


def _spot(model: SceneModel, motion: Motion) -> Sequence[Layer]:
    spot = model.spot
    if spot is None:
        return []
    finest = spot.wavelength_um * spot.f_number / spot.pitch_um
    same = spot.model_dump(include={"x_px", "y_px", "radius_px", "peak_photons", "profile", "seed", "frames_each"})
    return [Speckle(**same, lambda_n_px=finest, contrast=spot.contrast_rel, motion=STILL if spot.still else motion)]


def _lighting(model: SceneModel, frame_shape: tuple[int, int]) -> Lighting | None:
    if model.lighting is None:
        return None
    given = {k: v for k, v in model.lighting.model_dump().items() if v is not None}
    return Lighting(**({"x_px": 0.5 * (frame_shape[1] - 1), "y_px": 0.5 * (frame_shape[0] - 1)} | given))


def read_scene(source: str | Path | Mapping[str, Any]) -> SceneModel:
    """Read and check a scene file or record.

    Raises
    ------
    InputError
        If it cannot be read, or names nothing to show.
    """
    where = "scene" if isinstance(source, Mapping) else str(source)
    model = validate(SceneModel, source if isinstance(source, Mapping) else load_yaml(source), where)
    if not any(getattr(model, part) for part in SHOWN):
        raise InputError("the scene is empty", where=where, allowed=", ".join(SHOWN), remedy="give one of them")
    if model.discs is not None and len(model.discs.x_px) != len(model.discs.y_px):
        raise InputError("x_px and y_px of the discs differ in number", where=where, remedy="give both for each disc")
    if model.photon_transfer is not None:
        other = [part for part in ("discs", "targets", "plate", "spot", "motion", "lighting") if getattr(model, part)]
        if other:
            raise InputError(f"a photon-transfer series has no {', '.join(other)}", where=where, remedy="make two scenes")
    return model
