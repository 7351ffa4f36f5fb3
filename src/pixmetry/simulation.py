"""Frames of a camera whose errors are known: single scenes, and whole campaigns that can be assessed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.campaign import provenance_record, staged_output, write_frame, write_json
from pixmetry.core.camera import Camera, load_camera
from pixmetry.core.errors import InputError
from pixmetry.core.signal import Kind
from pixmetry.scene.discs import Discs
from pixmetry.scene.files import SceneModel, SeriesModel, background_of, build_scene, read_scene
from pixmetry.scene.uniform import Uniform

FORMATS = ("tiff", "png")
SERIES_SCHEMA = "pixmetry/campaign/1"


@dataclass(frozen=True)
class SimulatedGroup:
    """Frames of one condition of a simulated campaign."""

    kind: str
    role: str
    exposure_s: float
    photons: float
    first_frame: int
    count: int


def plan_series(series: SeriesModel) -> list[SimulatedGroup]:
    """Return the groups of a photon-transfer series: equidistant exposures, the same dark, two stacks; frame numbers run through."""
    groups, at = [], 0

    def add(kind: str, role: str, exposure_s: float, photons: float, count: int) -> None:
        nonlocal at
        groups.append(SimulatedGroup(kind, role, exposure_s, photons, at, count))
        at += count

    for k in range(1, series.levels + 1):
        share = k / series.levels
        add("dark", "level", share * series.longest_exposure_s, 0.0, series.frames_per_level)
        add("bright", "level", share * series.longest_exposure_s, share * series.brightest_photons, series.frames_per_level)
    exposure = series.stack_rel * series.longest_exposure_s
    add("dark", "stack", exposure, 0.0, series.stack_frames)
    add("bright", "stack", exposure, series.stack_rel * series.brightest_photons, series.stack_frames)
    return groups


def expose_group(
    camera: Camera, group: SimulatedGroup, seed: int, light: Uniform | None = None, lamp_rel: float = 0.0, threads: int | None = None
) -> Iterator[np.ndarray]:
    """Expose the frames of one group, one after the other; ``lamp_rel`` scales the light of this group."""
    light = light or Uniform()
    scene = Uniform(group.photons * (1.0 + lamp_rel), light.gradient_x_per_px, light.gradient_y_per_px)
    numbers = range(group.first_frame, group.first_frame + group.count)
    for signal in camera.iter_frames(scene, numbers, seed, threads=threads, exposure_s=group.exposure_s):
        yield signal.data[0]


def simulate(
    camera: str | Path | Camera,
    scene: str | Path | Mapping[str, Any],
    output: str | Path,
    *,
    frames: int = 1,
    seed: int = 0,
    image_format: str = "tiff",
    progress: Callable[[str, int, int], None] | None = None,
) -> Path:
    """Write the frames that a camera makes of a scene, with the truth beside them.

    Parameters
    ----------
    camera : path, name of a preset, or Camera
    scene : path or mapping
        Schema ``pixmetry/scene/1``: a uniform field, discs, or a photon-transfer series.
    output : path
        Folder; it gets ``frames/``, ``truth.json``, ``camera.yaml`` and, for a series, ``campaign.yaml``.
    frames : int
        How many frames of the scene (a series has its own counts).
    seed : int
        Of the exposures.
    image_format : {"tiff", "png"}

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError, ChainError
        If camera or scene cannot be used.
    """
    camera = camera if isinstance(camera, Camera) else load_camera(camera)
    model = read_scene(scene)
    told = progress or (lambda what, done, of: None)
    if image_format not in FORMATS:
        raise InputError("no such image format", value=image_format, allowed=", ".join(FORMATS))
    if frames < 1:
        raise InputError("no frame is asked for", value=frames, allowed="1 or more")
    kinds = [e.source.produces for e in camera.active if e.source.produces is not None]
    if not kinds or kinds[-1] is not Kind.CODES:
        raise InputError(f"{camera.name} makes no codes", remedy="add grabber.adc to its chain")
    with staged_output(output, "simulation") as folder:
        (folder / "frames").mkdir()
        bits = next(e.params.bits for e in camera.active if e.source.id == "grabber.adc")
        truth: dict[str, Any] = {"schema": "pixmetry/truth/1", "seed": seed, "unit_seed": camera.unit_seed}
        if model.photon_transfer is not None:
            _write_series(camera, model, folder, seed, bits, image_format, told)
        else:
            picture = build_scene(model, camera.frame_shape)
            for i, signal in enumerate(camera.iter_frames(picture, range(frames), seed)):
                write_frame(folder / "frames" / f"frame_{i:05d}.{_suffix(image_format)}", signal.data[0], bits)
                told("exposing frames", i + 1, frames)
            if isinstance(picture, Discs):
                truth["targets"] = [{"x_px": float(x), "y_px": float(y)} for x, y in zip(picture.x_px, picture.y_px, strict=True)]
        truth["provenance"] = provenance_record(seed=seed)
        camera.save(folder / "camera.yaml")
        write_json(folder / "truth.json", truth)
    return Path(output)


def _suffix(image_format: str) -> str:
    return {"tiff": "tif", "png": "png"}[image_format]


def _write_series(
    camera: Camera, model: SceneModel, folder: Path, seed: int, bits: int, image_format: str, told: Callable[[str, int, int], None]
) -> None:
    from pixmetry.core.config import dump_yaml

    assert model.photon_transfer is not None
    groups = plan_series(model.photon_transfer)
    light = background_of(model)
    total, done, entries = sum(g.count for g in groups), 0, []
    for g in groups:
        files = []
        for i, frame in enumerate(expose_group(camera, g, seed, light)):
            files.append(f"frames/{g.kind}_{g.role}_{g.first_frame:05d}_{i:03d}.{_suffix(image_format)}")
            write_frame(folder / files[-1], frame, bits)
            done += 1
            told("exposing frames", done, total)
        entry = {"kind": g.kind, "role": g.role, "exposure_s": g.exposure_s, "files": files}
        entries.append(entry | ({"photons": g.photons} if g.kind == "bright" else {}))
    facts: dict[str, Any] = {"name": camera.name, "bits": bits, "interface": camera.facts.get("interface", "digital")}
    facts |= {"temperature_c": camera.temperature_c} | ({"sensor": camera.facts["sensor"]} if "sensor" in camera.facts else {})
    if camera.pitch_um is not None:
        facts |= {"pitch_x_um": camera.pitch_um[0], "pitch_y_um": camera.pitch_um[1]}
    dump_yaml({"schema": SERIES_SCHEMA, "camera": facts, "frames": entries}, folder / "campaign.yaml")
