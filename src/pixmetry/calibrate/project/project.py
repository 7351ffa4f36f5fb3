"""Read a project: the YAML file, the tables and pictures that it names, and all that can be checked before an adjustment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.checks.check_points import CheckPoints
from pixmetry.calibrate.images.looks import Looks
from pixmetry.calibrate.project.cameras import Described, described
from pixmetry.calibrate.project.coordinates import ImageCoordinates, Measured, image_facts, measured, upwards
from pixmetry.calibrate.project.points import Known, known_points, scale_bars, with_check_points
from pixmetry.calibrate.project.reader import Reader
from pixmetry.calibrate.project.rig_names import (
    cameras_of_files,
    check_instants,
    instants_of_lists,
    instants_of_names,
    instants_of_table,
)
from pixmetry.calibrate.project.schema import PROJECT_SCHEMA, PicturesModel, ProjectModel
from pixmetry.calibrate.project.straight_lines import LinePositions, lines_of_pictures, lines_of_table
from pixmetry.calibrate.project.tables import Table, first_few
from pixmetry.camera.camera import Camera
from pixmetry.core.config import Settings, load_yaml, validate
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding
from pixmetry.core.progress import Progress

FIELD_OF = {"fixed": "fixed", "weighted": "fixed", "free": "free"}  # what `known` says; of nominal points images left out decide


@dataclass(frozen=True)
class Project:
    """A project as it was read.

    Parameters
    ----------
    name : str
    source : Path or None
        None: pictures alone.
    network : Network
        Without observations where it is about straight lines.
    options : dict
        What was given of `pixmetry.calibrate.bundle.solve.Options`.
    inputs : tuple of Path
        All files that were read.
    findings : tuple of Finding
        What was noticed in the tables.
    presets : dict
        By the names of cameras that have one.
    lines : LinePositions or None
        Positions on straight lines, where there are no points.
    check_points : CheckPoints or None
        What the result is compared with.
    of_pictures : bool
        Whether the image coordinates are those of a test field that was identified in pictures.
    """

    name: str
    source: Path | None
    network: Network
    options: dict[str, Any]
    inputs: tuple[Path, ...]
    findings: tuple[Finding, ...] = ()
    presets: Mapping[str, Camera] = field(default_factory=dict)
    lines: LinePositions | None = None
    check_points: CheckPoints | None = None
    of_pictures: bool = False

    @property
    def folder(self) -> Path:
        """What file names count from."""
        return Path() if self.source is None else self.source.parent


def load_project(path: str | Path, progress: Progress | None = None) -> Project:
    """Read a project file and everything that it names.

    Parameters
    ----------
    path : path
        A YAML file of the schema ``pixmetry/calibration/1``.
    progress : callable, optional
        Called with (what, done, of) while targets are located in pictures.

    Raises
    ------
    InputError
        If a file is missing, or anything in one of them cannot be used.
    """
    source = Path(path)
    settings = _one_camera_or_many(load_yaml(source))
    return _project(validate(ProjectModel, settings, str(source)), Reader(source, settings.lines), progress)


def project_of_pictures(
    files: Sequence[str | Path],
    camera: Mapping[str, Any],
    plate: Mapping[str, Any],
    progress: Progress | None = None,
    *,
    rig: bool = False,
) -> Project:
    """A project of pictures alone, of one camera, or of the cameras of a rig.

    Parameters
    ----------
    files : sequence of path
        Names, patterns or folders.
    camera, plate : mapping
        Keys of the project's ``cameras`` and ``pictures``.
    progress : callable, optional
    rig : bool
        Whether the names of the pictures tell several cameras, and the instants.

    Raises
    ------
    InputError
        As from `load_project`.
    """
    pictures: dict[str, Any] = {"files": [str(file) for file in files], **plate}
    settings: dict[str, Any] = {"schema": PROJECT_SCHEMA, "cameras": [camera], "pictures": pictures}
    if rig:
        pictures["files"] = cameras_of_files(Reader(None, {}).pictures(pictures["files"], plate.get("raw")))
        settings |= {"cameras": [{**camera, "name": name} for name in pictures["files"]], "rig": "names"}
    model = validate(ProjectModel, settings)
    return _project(model, Reader(None, {}), progress)


def _project(model: ProjectModel, reader: Reader, progress: Progress | None) -> Project:
    given = ImageCoordinates(**model.image_coordinates.model_dump())
    table = reader.table("lines", model.lines) if model.straight else reader.table("observations", model.observations)
    up = given.y == "up" if table is None else upwards(table, given)
    told = tuple(described(entry, reader, k, straight=model.straight, upwards=up) for k, entry in enumerate(model.cameras))
    presets = {one.model.name: one.preset for one in told if one.preset is not None}
    about: dict[str, Any] = {"name": model.name, "source": reader.source, "presets": presets}
    if model.straight:
        camera, lines, findings = _lines(model, reader, table, given, told[0], progress)
        options = {name: value for name, value in model.options.model_dump().items() if value is not None}
        network = _no_points(camera)
        return Project(network=network, options=options, inputs=tuple(reader.files), findings=findings, lines=lines, **about)
    cameras = tuple(one.model for one in told)
    images, points = reader.table("images", model.images), reader.table("points", model.points)
    plate, findings = None, ()
    if model.pictures is not None:
        cameras, seen, plate, findings = _located(model.pictures, reader, told, images, progress)
    else:
        assert table is not None and model.observations is not None
        seen = measured(table, images, cameras, given, model.observations.u_px)
    seen = replace(seen, instant=_instants(model, images, seen, reader))
    known = plate if points is None and plate is not None else known_points(points, seen.points, *_trust(model))
    compared = reader.table("check_points", model.check_points)
    u_compared = None if model.check_points is None else model.check_points.u
    known, checks = with_check_points(known, compared, seen.points, u_compared)
    known = _with_target(known, model)
    bars = scale_bars(reader.bars(model), seen.points, known)
    network = network_of(cameras, seen, known, bars=bars, per_image=model.per_image, scale_origin_px=model.scale_origin_px, unit=model.unit)
    findings = (*findings, *_unseen(known, points), *_without_images(network))
    about |= {"options": _options(model), "inputs": tuple(reader.files), "findings": findings, "check_points": checks}
    about["of_pictures"] = model.pictures is not None
    return Project(network=network, **about)


def _lines(
    model: ProjectModel, reader: Reader, table: Table | None, given: ImageCoordinates, told: Described, progress: Progress | None
) -> tuple[CameraModel, LinePositions, tuple[Finding, ...]]:
    """Positions on straight lines, and the camera with the size of its frame."""
    if model.pictures is not None:
        lines, size, findings = lines_of_pictures(model.pictures, reader.pictures(model.pictures.all_files, model.pictures.raw), progress)
        told.check(size)
        return _of_size(told.model, *size), lines, findings
    assert table is not None and model.lines is not None
    lines = lines_of_table(table, told.model, given, model.lines.u_px)
    return told.model, lines, _outside(lines, told.model.sensor)


def _outside(lines: LinePositions, sensor: Sensor) -> tuple[Finding, ...]:
    (x0, y0), half = sensor.centre, (sensor.cols / 2, sensor.rows / 2)
    bad = np.flatnonzero((np.abs(lines.x_px - x0) > half[0]) | (np.abs(lines.y_px - y0) > half[1]))
    if not len(bad):
        return ()
    first = f"({lines.x_px[bad[0]]:.1f}, {lines.y_px[bad[0]]:.1f}) of line {lines.line[bad[0]]} in {lines.image[bad[0]]}"
    text = f"{len(bad)} of {len(lines)} positions lie outside of the frame of {sensor.cols} × {sensor.rows} px, such as {first}."
    return (Finding("outside_frame", text, "Check the size of the frame and these positions.", "warning"),)


def _no_points(camera: CameraModel) -> Network:
    none, index = np.zeros(0), np.zeros(0, np.int64)
    return Network((camera,), (), index, (), none, none, index, index, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))


def _trust(model: ProjectModel) -> tuple[str | None, float | None]:
    return (None, None) if model.points is None else (model.points.known, model.points.u)


def network_of(cameras: Sequence[CameraModel], seen: Measured, known: Known, **more: Any) -> Network:
    """Put together what was measured and what is known."""
    return Network(
        cameras=tuple(cameras),
        images=seen.images,
        camera_of=seen.camera_of,
        points=seen.points,
        x_px=seen.x_px,
        y_px=seen.y_px,
        image=seen.image,
        point=seen.point,
        covariance_px2=seen.covariance_px2,
        xyz=known.xyz,
        u_xyz=known.u_xyz,
        time_s=seen.time_s,
        diameter=known.diameter,
        normal=known.normal,
        covariance_known=seen.covariance_known,
        poses=seen.poses,
        instant=seen.instant,
        **more,
    )


def _one_camera_or_many(settings: Settings) -> Settings:
    """`cameras: {...}` as a list of one, with its lines."""
    if isinstance(settings.get("cameras"), dict):
        settings["cameras"] = [settings["cameras"]]
        settings.lines = {
            ("cameras", 0, *loc[1:]) if loc[0] == "cameras" and len(loc) > 1 else loc: line for loc, line in settings.lines.items()
        }
    return settings


def _with_target(known: Known, model: ProjectModel) -> Known:
    """Size and normal of all targets where the table of points does not say them."""
    target = model.target
    if target is None:
        return known
    n = len(known.xyz)
    diameter, normal = known.diameter, known.normal
    if target.diameter is not None:
        own = np.full(n, np.nan) if diameter is None else diameter
        diameter = np.where(np.isfinite(own), own, target.diameter)
    if target.normal is not None:
        wanted = np.array(target.normal) / np.linalg.norm(target.normal)
        own = np.full((n, 3), np.nan) if normal is None else normal
        normal = np.where(np.isfinite(own), own, wanted)
    return replace(known, diameter=diameter, normal=normal)


def _options(model: ProjectModel) -> dict[str, Any]:
    given = {name: value for name, value in model.options.model_dump().items() if value is not None}
    known = None if model.points is None else model.points.known or "weighted"
    if known in FIELD_OF:
        given = {"field": FIELD_OF[known], **given}
    if model.target is not None:
        given["target"] = model.target.shape
    return given


def _without_images(network: Network) -> tuple[Finding, ...]:
    names = [camera.name for k, camera in enumerate(network.cameras) if not np.any(network.camera_of == k)]
    text = "has no image: its values are the given ones."
    advice = "Name it in the table of images, or delete it."
    return tuple(Finding("camera_without_images", f"Camera '{name}' {text}", advice, "warning") for name in names)


def _unseen(known: Known, points: Table | None) -> tuple[Finding, ...]:
    if points is None or not known.unseen:
        return ()
    n = len(known.unseen)
    text = f"{n} of {len(points)} object points {'is' if n == 1 else 'are'} measured in no image: {first_few(known.unseen)}."
    return (Finding("unseen_points", text, "If they should be, compare their names in both tables."),)


def _locate_targets(
    wanted: PicturesModel,
    files: Sequence[Path],
    camera: CameraModel,
    images: Table | None,
    progress: Progress | None,
    check: Callable[[tuple[int, int]], None],
    plate: Looks | None = None,
) -> tuple[CameraModel, Measured, Known, tuple[Finding, ...], Looks | None]:
    """Locate the targets of a test field in pictures.

    Parameters
    ----------
    wanted : PicturesModel
    files : sequence of Path
    camera : CameraModel
        Its frame takes the size of the pictures.
    images : Table, optional
        Time and start pose of each picture, by the name of its file.
    progress : callable, optional
    check : callable
        Called with (cols, rows) of the pictures; refuses what is not the size that was expected.
    plate : Looks, optional
        Marks of the test field as another camera's pictures were numbered by them.

    Returns
    -------
    tuple
        The camera, what was measured, what the test field's description says of its points, what was found on the way, and the marks.

    Raises
    ------
    InputError, MeasureError
        If pictures cannot be read, or too few of them show the test field.
    """
    from pixmetry.calibrate.images.images import LEAST_IMAGES, observations_of

    least = LEAST_IMAGES if camera.free.any() else 1  # one image suffices for a pose
    told = wanted.model_dump(exclude={"files", "kind"})
    found = observations_of(files, wanted.kind, **told, least_images=least, plate=plate, progress=progress)
    check(found.sizes[0])
    camera_of, time_s, poses = image_facts(images, found.images, [camera], lambda name: name)
    network = found.network(_of_size(camera, *found.sizes[0]))
    seen = Measured(
        images=found.images,
        points=found.points,
        camera_of=camera_of,
        time_s=time_s,
        poses=poses,
        **{name: getattr(network, name) for name in ("image", "point", "x_px", "y_px", "covariance_px2", "covariance_known")},
    )
    return network.cameras[0], seen, Known(network.xyz, network.u_xyz, network.diameter, network.normal), found.findings, found.plate


def _located(
    wanted: PicturesModel, reader: Reader, told: Sequence[Described], images: Table | None, progress: Progress | None
) -> tuple[tuple[CameraModel, ...], Measured, Known, tuple[Finding, ...]]:
    """Locate the targets in the pictures of all cameras."""
    if not isinstance(wanted.files, dict):
        files = reader.pictures(wanted.files, wanted.raw)
        camera, seen, plate, findings, _ = _locate_targets(wanted, files, told[0].model, images, progress, told[0].check)
        return (camera,), seen, plate, findings
    parts, marks = [], None
    for one in told:
        files = reader.pictures(wanted.files[one.model.name], wanted.raw)
        try:
            part = _locate_targets(wanted, files, one.model, None, progress, one.check, marks)
        except MeasureError as error:
            error.where = f"{error.where} of {one.model.name}"
            raise
        marks = part[4] if marks is None else marks
        parts.append((*part[:3], tuple(replace(said, text=f"{one.model.name}: {said.text}") for said in part[3])))
    names = [name for _, seen, _, _ in parts for name in seen.images]
    own = [f"{camera.name}/" if len(set(names)) < len(names) else "" for camera, _, _, _ in parts]
    images_of = tuple(f"{head}{name}" for head, (_, seen, _, _) in zip(own, parts, strict=True) for name in seen.images)
    index: dict[str, int] = {}
    point = [np.array([index.setdefault(name, len(index)) for name in seen.points], np.int64)[seen.point] for _, seen, _, _ in parts]
    first = np.cumsum([0, *(len(seen.images) for _, seen, _, _ in parts)])
    _, time_s, poses = (None, None, None) if images is None else image_facts(images, images_of, [told[0].model], lambda name: name)
    seen = Measured(
        images=images_of,
        points=tuple(index),
        camera_of=np.repeat(np.arange(len(parts)), np.diff(first)),
        time_s=time_s,
        poses=poses,
        image=np.concatenate([part.image + at for (_, part, _, _), at in zip(parts, first[:-1], strict=True)]),
        point=np.concatenate(point),
        x_px=np.concatenate([part.x_px for _, part, _, _ in parts]),
        y_px=np.concatenate([part.y_px for _, part, _, _ in parts]),
        covariance_px2=np.concatenate([part.covariance_px2 for _, part, _, _ in parts]),
        covariance_known=all(part.covariance_known for _, part, _, _ in parts),
    )
    known = _joined([(part, own) for _, part, own, _ in parts], index)
    return tuple(camera for camera, _, _, _ in parts), seen, known, tuple(one for _, _, _, findings in parts for one in findings)


def _joined(parts: Sequence[tuple[Measured, Known]], index: Mapping[str, int]) -> Known:
    """What is known of the points of all cameras: a board that each of them saw."""
    n, (_, first) = len(index), parts[0]
    xyz, u_xyz = np.full((n, 3), np.nan), np.full((n, 3), np.inf)
    diameter = None if first.diameter is None else np.full(n, np.nan)
    normal = None if first.normal is None else np.full((n, 3), np.nan)
    for seen, known in parts:
        rows = [index[name] for name in seen.points]
        for to, of in ((xyz, known.xyz), (u_xyz, known.u_xyz), (diameter, known.diameter), (normal, known.normal)):
            if to is not None and of is not None:
                to[rows] = of
    return Known(xyz, u_xyz, diameter, normal)


def _instants(model: ProjectModel, images: Table | None, seen: Measured, reader: Reader) -> np.ndarray | None:
    """Which images were taken together by a rig; None without one."""
    where = reader.where("rig")
    told = None if images is None or len(model.cameras) < 2 else instants_of_table(images.spelled("image", "instant"), seen.images)
    if told is not None and model.rig is not None:
        raise InputError("instants are given twice", where=where, allowed="`rig`, or the column instant", remedy="delete one of them")
    if model.rig == "names":
        told = instants_of_names(seen.images, seen.camera_of, where)
    elif model.rig is not None:
        told = instants_of_lists(model.rig, seen.images, where)
    return None if told is None else check_instants(told, seen.camera_of, seen.images, where)


def _of_size(camera: CameraModel, cols: int, rows: int) -> CameraModel:
    """The camera with the size of its pictures; a principal point that was not given stays in the middle of the frame."""
    before, sensor = camera.sensor.centre, replace(camera.sensor, cols=cols, rows=rows)
    middle = {name: new for name, old, new in zip(("xp", "yp"), before, sensor.centre, strict=True) if camera[name] == old}
    return replace(camera, sensor=sensor).with_values(**middle)
