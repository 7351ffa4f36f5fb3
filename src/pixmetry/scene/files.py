"""Scenes from YAML files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pixmetry.core.config import Model, load_yaml, validate
from pixmetry.core.errors import InputError
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SCHEMA = "pixmetry/scene/1"


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


class SceneModel(Model):
    """A scene file, schema ``pixmetry/scene/1``."""

    schema_: Literal["pixmetry/scene/1"] = Field(alias="schema")
    uniform: UniformModel | None = None
    discs: DiscsModel | None = None
    photon_transfer: SeriesModel | None = None


def background_of(model: SceneModel) -> Uniform:
    """The uniform field of a checked record; dark where it has none."""
    return Uniform(**model.uniform.model_dump()) if model.uniform is not None else Uniform()


def build_scene(model: SceneModel, frame_shape: tuple[int, int]) -> Uniform | Discs:
    """Build the scene of a checked record for a frame of this size."""
    background = background_of(model)
    if model.discs is None:
        return background
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


def read_scene(source: str | Path | Mapping[str, Any]) -> SceneModel:
    """Read and check a scene file or record.

    Raises
    ------
    InputError
        If it cannot be read, or names nothing to show.
    """
    where = "scene" if isinstance(source, Mapping) else str(source)
    model = validate(SceneModel, source if isinstance(source, Mapping) else load_yaml(source), where)
    if model.uniform is None and model.discs is None and model.photon_transfer is None:
        raise InputError("the scene shows nothing", where=where, allowed="uniform, discs or photon_transfer", remedy="give one of them")
    if model.discs is not None and len(model.discs.x_px) != len(model.discs.y_px):
        raise InputError("x_px and y_px of the discs differ in number", where=where, remedy="give both for each disc")
    if model.photon_transfer is not None and model.discs is not None:
        raise InputError("a photon-transfer series has no discs", where=where, remedy="make two scenes")
    return model
