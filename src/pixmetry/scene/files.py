"""Scenes from YAML files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.config import load_yaml, validate
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.scene import outlines
from pixmetry.scene.discs import Discs
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.motion import STILL, Motion
from pixmetry.scene.outlines import Outline
from pixmetry.scene.picture import Layer, Picture
from pixmetry.scene.plates import Pose, chessboard, dot_plate
from pixmetry.scene.schema import SceneModel, SeriesModel
from pixmetry.scene.shapes import Shapes, Sine
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

__all__ = ["SCHEMA", "SceneModel", "SeriesModel", "background_of", "build_scene", "read_scene"]

SCHEMA = "pixmetry/scene/1"
SHOWN = ("uniform", "discs", "targets", "plate", "spot", "photon_transfer")

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
        return background if model.discs is None else _discs(model, frame_shape, background)
    try:
        motion = STILL if model.motion is None else Motion(**model.motion.model_dump())
        layers = [*_targets(model, motion), *_plate(model, motion, frame_shape), *_spot(model, motion)]
        if model.discs is not None:
            layers += [_discs(model, frame_shape, Uniform()).layer(motion)]
        return Picture(tuple(layers), background, _lighting(model, frame_shape))
    except ParameterError as problem:
        place = ": ".join(part for part in (where, problem.where) if part)
        raise InputError(problem.what, where=place, value=problem.value, allowed=problem.allowed, remedy=problem.remedy) from None


def _discs(model: SceneModel, frame_shape: tuple[int, int], background: Uniform) -> Discs:
    discs = model.discs
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
        raise InputError("the scene shows nothing", where=where, allowed=", ".join(SHOWN), remedy="give one of them")
    if model.discs is not None and len(model.discs.x_px) != len(model.discs.y_px):
        raise InputError("x_px and y_px of the discs differ in number", where=where, remedy="give both for each disc")
    if model.photon_transfer is not None:
        other = [part for part in ("discs", "targets", "plate", "spot", "motion", "lighting") if getattr(model, part)]
        if other:
            raise InputError(f"a photon-transfer series has no {', '.join(other)}", where=where, remedy="make two scenes")
    return model
