"""Frames of a camera whose errors are known: single scenes, and whole campaigns that can be assessed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.overrides import changed_camera
from pixmetry.camera.signal import Kind
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError
from pixmetry.core.memory import check_memory
from pixmetry.core.progress import Progress, no_progress
from pixmetry.files import InputHashes, provenance_record, staged_output, write_json
from pixmetry.scene.files import SceneModel, SeriesModel, background_of, build_scene, read_scene
from pixmetry.scene.uniform import Uniform
from pixmetry.simulate.files import FORMATS, FrameWriter, TruthWriter

SERIES_SCHEMA = "pixmetry/campaign/1"
Window = tuple[int, int, int, int]
LOSSY = ("storage.jpeg", "storage.video_codec")  # sources that are lossy coders
RECORD_BYTES = 350  # what truth.json says of a frame, in memory


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
    scene = field_of(group, light or Uniform(), lamp_rel)
    numbers = range(group.first_frame, group.first_frame + group.count)
    for signal in camera.iter_frames(scene, numbers, seed, threads=threads, exposure_s=group.exposure_s):
        yield signal.data[0]


def field_of(group: SimulatedGroup, light: Uniform, lamp_rel: float = 0.0) -> Uniform:
    """The uniform field that one group of a series looks at."""
    return Uniform(group.photons * (1.0 + lamp_rel), light.gradient_x_per_px, light.gradient_y_per_px)


@dataclass(frozen=True)
class _Part:
    """Frames that are exposed one after the other under one condition; ``entry`` is what a manifest says of them."""

    scene: Any
    numbers: range
    stem: str
    schedule: Mapping[str, Any]
    entry: Mapping[str, Any] | None = None


@typed
def simulate(
    camera: str | Path | Camera,
    scene: str | Path | Mapping[str, Any],
    output: str | Path,
    *,
    frames: int = 1,
    seed: int = 0,
    image_format: str = "tiff",
    truth: bool = False,
    overrides: Mapping[str, Any] | None = None,
    off: Sequence[str] = (),
    window: Window | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write the frames that a camera makes of a scene, with the truth beside them.

    Parameters
    ----------
    camera : path, name of a preset, or Camera
    scene : path or mapping
        Schema ``pixmetry/scene/1``.
    output : path
        Folder; it gets the frames (image files, or ``frames.zarr``), ``truth.json``, ``camera.yaml`` (the camera that made them) and, for a
        photon-transfer series, ``campaign.yaml``. Only frames of the same camera and scene are replaced.
    frames : int
        How many frames of the scene (a series has its own counts).
    seed : int
        Of the exposures.
    image_format : {"tiff", "png", "zarr"}
    truth : bool
        Write ``truth.zarr`` too: what every source did in this unit and in every frame.
    overrides : mapping
        Changed values by ``NAME.PARAMETER``, or of the camera itself; see `changed_camera`.
    off : sequence of str
        Sources to switch off, by their names in the chain.
    window : (int, int, int, int), optional
        First row and column, rows and columns of a part of the frame to write; equals the crop bit for bit.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError, ChainError
        If camera or scene cannot be used.

    Examples
    --------
    >>> from pixmetry import read_frame, simulate
    >>> scene = {"schema": "pixmetry/scene/1", "discs": {"x_px": [620.3], "y_px": [510.6], "diameter_px": 7, "peak_photons": 9000}}
    >>> folder = simulate("imx264_like", scene, "frames", frames=2, seed=1, window=(490, 600, 40, 40))
    >>> sorted(path.name for path in folder.glob("*.tif"))
    ['frame_00000.tif', 'frame_00001.tif']
    >>> read_frame(folder / "frame_00000.tif").shape
    (40, 40)
    """
    device = camera if isinstance(camera, Camera) else load_camera(camera)
    device = changed_camera(device, overrides, off)
    model = read_scene(scene)
    told = progress or no_progress
    if image_format not in FORMATS:
        raise InputError("no such image format", value=image_format, allowed=", ".join(FORMATS))
    bits = stored_bits(device)
    parts = (
        _series(model, model.photon_transfer, frames, overrides)
        if model.photon_transfer is not None
        else _sequence(device, model, frames, scene)
    )
    shape = _checked_window(device, window)[2:]
    count = sum(len(p.numbers) for p in parts)
    check_memory(RECORD_BYTES * count, f"the record of {count} frames", remedy="make fewer frames at a time")
    of = (_origin(camera, device.name), _origin(scene, "scene"))
    with staged_output(output, "simulation", of, [path for path in of if isinstance(path, Path)]) as folder:
        writer = FrameWriter(folder, image_format, bits, count, shape)
        notes = TruthWriter(device, seed, count, window, folder / "truth.zarr" if truth else None)
        files: list[list[str]] = []
        for part in parts:
            files.append([])
            for i, signal in enumerate(device.iter_frames(part.scene, part.numbers, seed, window, **part.schedule)):
                files[-1].append(writer.write(f"{part.stem}_{i:05d}", signal.data[0]))
                notes.add(files[-1][-1], part.scene, signal, **part.schedule)
                told("exposing frames", len(notes.frames), count)
        if model.photon_transfer is not None:
            temperature_c = float(np.mean([f["temperature_c"] for f in notes.frames]))  # not the settled one while a camera warms up
            _write_manifest(device, bits, round(temperature_c, 3), parts, files, folder, window)
        changed = {"overrides": dict(overrides or {}), "off": list(off)}
        inputs = _hashes(camera, scene)
        write_json(folder / "truth.json", notes.record() | changed | {"provenance": provenance_record(inputs, seed=seed)})
        notes.close()
        device.save(folder / "camera.yaml")
    return Path(output)


def stored_bits(camera: Camera) -> int:
    """Bits of the codes that a camera puts out: those of its last source that says so.

    Raises
    ------
    InputError
        If it makes no codes.
    """
    kinds = [e.source.produces for e in camera.active if e.source.produces is not None]
    if not kinds or kinds[-1] is not Kind.CODES:
        raise InputError(f"{camera.name} makes no codes", remedy="add grabber.adc to its chain, or switch it on")
    converter = max(i for i, e in enumerate(camera.active) if e.source.produces is Kind.CODES)
    told = [e.params.bits for e in camera.active[converter:] if hasattr(e.params, "bits")]
    if not told:
        raise InputError(f"{camera.active[converter].name} does not state the bits of its codes", remedy="use grabber.adc")
    return int(told[-1])


def parse_window(text: str) -> Window:
    """Read ``ROW,COL,ROWS,COLS``.

    Raises
    ------
    InputError
        If these are not four whole numbers.
    """
    try:
        row0, col0, rows, cols = (int(part) for part in text.split(","))
    except ValueError:
        raise InputError("not a window", value=text, allowed="ROW,COL,ROWS,COLS: four whole numbers, such as 100,200,64,96") from None
    return row0, col0, rows, cols


def _checked_window(camera: Camera, window: Window | None) -> Window:
    rows, cols = camera.output_shape
    row0, col0, h, w = window or (0, 0, rows, cols)
    if not (row0 >= 0 and col0 >= 0 and h > 0 and w > 0 and row0 + h <= rows and col0 + w <= cols):
        raise InputError("the window does not lie in the frame", value=window, allowed=f"within {rows} rows and {cols} columns")
    return row0, col0, h, w


def _sequence(camera: Camera, model: SceneModel, frames: int, source: Any) -> list[_Part]:
    if frames < 1:
        raise InputError("the number of frames is not positive", value=frames, allowed="1 or more")
    where = str(source) if isinstance(source, str | Path) else "scene"
    return [_Part(build_scene(model, camera.frame_shape, where), range(frames), "frame", {})]


def _series(model: SceneModel, series: SeriesModel, frames: int, overrides: Mapping[str, Any] | None) -> list[_Part]:
    if "exposure_s" in (overrides or {}):
        raise InputError(
            "a photon-transfer series sets its own exposures", value="exposure_s", remedy="set longest_exposure_s in the scene"
        )
    if frames != 1:
        raise InputError("a photon-transfer series has its own number of frames", value=frames, remedy="set frames_per_level in the scene")
    light, parts = background_of(model), []
    for g in plan_series(series):
        entry = {"kind": g.kind, "role": g.role, "exposure_s": g.exposure_s} | ({"photons": g.photons} if g.kind == "bright" else {})
        numbers = range(g.first_frame, g.first_frame + g.count)
        parts.append(_Part(field_of(g, light), numbers, f"{g.kind}_{g.role}_{g.first_frame:05d}", {"exposure_s": g.exposure_s}, entry))
    return parts


def _write_manifest(
    camera: Camera,
    bits: int,
    temperature_c: float,
    parts: Sequence[_Part],
    files: Sequence[Sequence[str]],
    folder: Path,
    window: Window | None,
) -> None:
    """Write the manifest of a series; the files do not show that a source of the camera coded their frames before."""
    from pixmetry.core.config import dump_yaml

    facts: dict[str, Any] = {"name": camera.name, "bits": bits, "interface": camera.facts.get("interface", "digital")}
    facts |= {"temperature_c": temperature_c} | ({"sensor": camera.facts["sensor"]} if "sensor" in camera.facts else {})
    if camera.pitch_um is not None:
        facts |= {"pitch_x_um": camera.pitch_um[0], "pitch_y_um": camera.pitch_um[1]}
    facts["lossless"] = not any(e.source.id in LOSSY for e in camera.active)
    if window is not None:
        facts |= dict(zip(("sensor_rows", "sensor_cols", "first_row", "first_col"), (*camera.output_shape, *window[:2]), strict=True))
    entries = [dict(p.entry or {}) | {"files": list(names)} for p, names in zip(parts, files, strict=True)]
    dump_yaml({"schema": SERIES_SCHEMA, "camera": facts, "frames": entries}, folder / "campaign.yaml")


def _origin(given: Any, name: str) -> str | Path:
    """What a camera or scene came from: a file, else its name."""
    if not isinstance(given, str | Path):
        return name
    return Path(given) if Path(given).is_file() else str(given)


def _hashes(*given: Any) -> InputHashes:
    """Digests of the files that went in (a preset is named by the camera, and its values stand in camera.yaml)."""
    files = [Path(g) for g in given if isinstance(g, str | Path) and Path(g).is_file()]
    hashes = InputHashes(files[0].resolve().parent if files else Path())
    for file in files:
        hashes.add_file(file.resolve())
    return hashes
