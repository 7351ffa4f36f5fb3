"""Calibrating: from a project, a network or pictures of a test field or of lines to calibrated cameras, with a folder of results."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES, Network
from pixmetry.calibrate.checks.check_points import CheckPoints, refuse_known, with_check_points
from pixmetry.calibrate.files.record import StoredCalibration, read_calibration
from pixmetry.calibrate.files.write import check_folder, write_line_results, write_results
from pixmetry.calibrate.records import Calibration
from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError, PixmetryError
from pixmetry.core.extras import import_extra
from pixmetry.core.finding import Finding
from pixmetry.core.progress import Progress, no_progress
from pixmetry.files.provenance import InputHashes, provenance_record

if TYPE_CHECKING:
    from pixmetry.calibrate.lines.plumb_line import LineCalibration
    from pixmetry.calibrate.project import Project

__all__ = ["StoredCalibration", "calibrate", "read_calibration", "solve_again"]

PROJECT_ENDINGS = (".yaml", ".yml")
# What is said with pictures, and the keys of a project's ``cameras`` and ``pictures`` that mean the same.
CAMERA_KEYS = {name: name for name in ("camera", "interface", "direction", "projection", "c_mm", "c_px")} | {"pixel_um": "pitch_um"}
PICTURE_KEYS = {
    **{name: name for name in ("kind", "grid", "polarity", "channel", "raw", "noise", "dictionary")},
    **{f"{name}_mm": name for name in ("pitch", "side", "diameter")},
}
LINE_OPTIONS = {"loss": "loss", "loss_scale": "loss_scale", "snoop": "reject"}  # those of straight lines, and what they are called there
LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless")


def calibrate(
    source: str | Path | Network | Sequence[str | Path],
    output: str | Path | None = None,
    *,
    free: Sequence[str] | str | None = None,
    per_image: Sequence[str] | str | None = None,
    options: Mapping[str, Any] | None = None,
    check_points: CheckPoints | None = None,
    progress: Progress | None = None,
    **pictures: Any,
) -> Calibration | LineCalibration:
    """Calibrate one or several cameras.

    Parameters
    ----------
    source : path, Network, or sequence of paths
        A project file (YAML), a network that was put together in Python, or pictures of a test field (files, patterns, folders).
    output : path, optional
        Folder for ``report.html``, ``calibration.json``, ``points.csv``, ``poses.csv`` and ``residuals.csv`` (of straight lines without
        points and poses), and ``camera.yaml`` where a preset is named (``camera-NAME.yaml`` of several cameras).
    free : sequence of str, optional
        Interior parameters to estimate, out of c, xp, yp, b1, b2, p1, p2, k1 … k5, d1 … d3, s1 … s4, in place of what the project says.
    per_image : sequence of str, optional
        Out of ``"x_scale"`` and ``"x_shift"``, likewise.
    options : mapping, optional
        Of `pixmetry.calibrate.bundle.solve.Options`, likewise.
    check_points : CheckPoints, optional
        Coordinates that the result is compared with, in place of those of the project (`pixmetry.calibrate.checks.check_points`).
    progress : callable, optional
        Called with (what, done, of).
    **pictures
        For pictures: ``kind`` ("chessboard", "dots", "asymmetric", "coded", "squares", "charuco", "aprilgrid" or "lines"), ``grid``
        ("9x6"), ``pitch_mm`` (spacing of the targets), ``side_mm``, ``diameter_mm`` (of squares, markers and dots), ``dictionary``
        (of markers), ``polarity``, ``channel``, ``raw`` ("1920x1200:Mono12p", of files without a header), ``noise``; and of the
        camera: ``camera`` (a preset or camera file, which brings the pitch), ``interface`` ("digital" or "analogue": whether a
        frame grabber samples its lines), ``direction``, ``projection``, ``pixel_um`` (pitch of the pixels), ``c_mm`` or ``c_px``;
        ``rig=True``: the names tell several cameras that stand still against each other, and their instants (left01, right01).

    Returns
    -------
    Calibration or LineCalibration
        The latter from straight lines. Where targets in pictures do not fit any camera, its first finding, ``"misfit"``, is of level
        "error", and no ``camera.yaml`` is written.

    Raises
    ------
    InputError, MeasureError
        If a file or an option cannot be used, or the images do not carry what was asked for; nothing is written then.

    Examples
    --------
    A table of image coordinates, here of 30 points seen by a camera of c = 1500 px:

    >>> from pathlib import Path
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> rng = np.random.default_rng(1)
    >>> points = rng.uniform(-300, 300, (30, 3))
    >>> table = ["image,point,x_px,y_px"]
    >>> for image, (turn, roll) in enumerate([(0, 0), (40, 0), (-40, 0), (0, 90), (40, 90), (-40, 90)]):
    ...     at = Rotation.from_euler("yz", [turn, roll], degrees=True).apply(points) + [0, 0, 2000]
    ...     x, y = 1500 * at[:, :2].T / at[:, 2] + [[640], [480]] + rng.normal(0, 0.05, (2, 30))
    ...     table += [f"{image},P{k},{x[k]:.3f},{y[k]:.3f}" for k in range(30)]
    >>> written = Path("points.csv").write_text("\\n".join(table))
    >>> project = "schema: pixmetry/calibration/1\\ncameras: {cols: 1280, rows: 960, c_px: 1400, free: 'c, xp, yp'}\\n"
    >>> written = Path("project.yaml").write_text(project + "observations: {table: points.csv, u_px: 0.05}\\n")
    >>> found = calibrate("project.yaml", "result")
    >>> parameters = found.columns("parameters")
    >>> parameters["parameter"][0], bool(abs(parameters["value"][0] - 1500) < 5 * parameters["u"][0])
    ('c', True)
    """
    from pixmetry.calibrate.bundle.solve import calibrate_network
    from pixmetry.calibrate.checks.findings import misfit_findings

    import_extra("cv2")
    _check_arguments(source, output, options, check_points, progress)
    for names, allowed, where in ((free, NAMES, "free"), (per_image, PER_IMAGE_NAMES, "per_image")):
        if names is not None:
            _checked(names, allowed, where)
    _options(options or {})  # before pictures are looked at
    of = _sources(source)
    if output is not None:
        check_folder(output, of, [path for path in of if isinstance(path, Path)])  # before the work, not after it
    told = progress or no_progress
    project = None
    if isinstance(source, Network):
        _refuse_pictures(pictures, "a network")
        network, given = source, {}
    else:
        project = _project(source, pictures, told, free)
        network, given = project.network, project.options
        if output is not None:
            check_folder(output, of, project.inputs)
    if project is not None and project.lines is not None:
        if check_points is not None:
            raise InputError("has no meaning with straight lines", where="check_points", allowed="with points", remedy="leave it out")
        return _from_lines(project, output, of, free, per_image, {**given, **(options or {})}, _steps(told))
    network = _changed(network, free, per_image)
    chosen = _options({**given, **(options or {})})
    checks = check_points if check_points is not None or project is None else project.check_points
    if checks is not None:
        refuse_known(network, checks)
    step = _steps(told)
    calibration = calibrate_network(network, chosen, progress=step)
    if checks is not None:
        step("comparing with the check points")
        calibration = with_check_points(calibration, checks, a_priori=chosen.a_priori)
    misfit = []
    if project is not None and project.of_pictures:
        misfit = misfit_findings(calibration.adjustment, network.covariance_px2)
    cameras, missing = _camera_files(calibration, project) if not misfit else ({}, [])
    about = {field.name: getattr(chosen, field.name) for field in fields(chosen)}
    findings = (*misfit, *calibration.findings, *missing, *(project.findings if project is not None else ()))
    calibration = replace(calibration, findings=findings, provenance={**calibration.provenance, **_origin(project, about)})
    if output is not None:
        step("writing the results")
        write_results(calibration, output, cameras, of, project.inputs if project is not None else ())
    step("")
    return calibration


def solve_again(
    calibration: Calibration,
    *,
    free: Sequence[str] | str | None = None,
    per_image: Sequence[str] | str | None = None,
    options: Mapping[str, Any] | None = None,
    without: Sequence[str] = (),
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the same image coordinates once more, with a change.

    Parameters
    ----------
    calibration : Calibration
        As `calibrate` returned it: it holds what it was made from. One that was read from a folder does not.
    free, per_image, options
        As of `calibrate`, in place of those of the first time.
    without : sequence of str
        Images to leave out.
    progress : callable, optional

    Raises
    ------
    InputError, MeasureError
        As `calibrate` does, and if an image is unknown or nothing is held.
    """
    from pixmetry.calibrate.bundle.solve import calibrate_network
    from pixmetry.calibrate.checks.hold_out import subset

    if not isinstance(calibration, Calibration) or calibration.given is None:
        raise InputError("the calibration does not hold what it was made from", remedy="calibrate the project again")
    network, state = _changed(calibration.given, free, per_image), calibration.adjustment.state
    unknown = next((name for name in without if name not in network.images), None)
    if unknown is not None:
        raise InputError(f"no image '{unknown}'", where="without", allowed=", ".join(network.images[:5]) + " …", remedy="correct the name")
    if without:
        network, state, _ = subset(network, state, ~np.isin(network.images, list(without)))
    before = {key: value for key, value in calibration.provenance.get("options", {}).items() if key not in (options or {})}
    chosen = _options({**before, **(options or {})})
    held = np.stack([np.where(camera.free, row, camera.values) for camera, row in zip(network.cameras, state.interior, strict=True)])
    step = _steps(progress or no_progress)
    found = calibrate_network(network, chosen, start=replace(state, interior=held), progress=step)
    step("")
    about = {**calibration.provenance, "options": {field.name: getattr(chosen, field.name) for field in fields(chosen)}}
    return replace(found, provenance=about)


def _check_arguments(source: object, output: object, options: object, check_points: object, progress: object) -> None:
    """Refuse arguments of a wrong type."""
    many = isinstance(source, Sequence) and not isinstance(source, (str, bytes)) and all(isinstance(one, str | Path) for one in source)
    for where, value, fits, allowed in (
        ("source", source, many or isinstance(source, (str, Path, Network)), "a path, a sequence of paths, or a Network"),
        ("output", output, output is None or isinstance(output, str | Path), "a path"),
        ("options", options, options is None or isinstance(options, Mapping), "names with their values"),
        ("check_points", check_points, check_points is None or isinstance(check_points, CheckPoints), "CheckPoints"),
        ("progress", progress, progress is None or callable(progress), "a function (what, done, of)"),
    ):
        if not fits:
            raise InputError("cannot be used", where=where, value=type(value).__name__, allowed=allowed)


def _from_lines(
    project: Project,
    output: str | Path | None,
    of: Sequence[str | Path],
    free: Sequence[str] | str | None,
    per_image: Sequence[str] | str | None,
    options: Mapping[str, Any],
    step: Callable[[str], None],
) -> LineCalibration:
    """Calibrate from straight lines."""
    from pixmetry.calibrate.lines.plumb_line import LineCalibration, calibrate_lines

    wrong = "per_image" if per_image else next((name for name in options if name not in LINE_OPTIONS), None)
    if wrong is not None:
        remedy = "leave it out"
        raise InputError("has no meaning with straight lines", where=wrong, allowed=", ".join(("free", *LINE_OPTIONS)), remedy=remedy)
    seen, (model,) = project.lines, project.network.cameras
    assert seen is not None
    wanted = _listed(free) if free is not None else tuple(name for name, used in zip(NAMES, model.free, strict=True) if used)
    settings = {LINE_OPTIONS[name]: value for name, value in options.items()}
    step("adjusting the lines")
    found = calibrate_lines(
        seen.x_px, seen.y_px, seen.line, seen.image, model.sensor, free=wanted, u_px=seen.covariance_px2, start=model, **settings
    )
    told = tuple(
        Finding("camera_file", f"No camera.yaml is written for '{name}': straight lines do not determine the principal distance.", advice)
        for name, advice in ((model.name, "Calibrate with a test field; its project can start from this calibration.json."),)
        if name in project.presets
    )
    calibration = LineCalibration(
        result=found, **{name: getattr(seen, name) for name in ("image", "line", "x_px", "y_px")},
        findings=(*found.findings, *project.findings, *told), provenance=_origin(project, {**dict(options), "free": ", ".join(wanted)}),
    )  # fmt: skip
    if output is not None:
        step("writing the results")
        write_line_results(calibration, output, of, project.inputs)
    step("")
    return calibration


def _camera_files(calibration: Calibration, project: Project | None) -> tuple[dict[str, Camera], list[Finding]]:
    """Presets with what was calibrated, by the names of their files; and why one is missing."""
    from pixmetry.calibrate.calibrated_camera import calibrated_camera, calibrated_geometry
    from pixmetry.calibrate.project.cameras import stored_grid

    made: dict[str, Camera] = {}
    findings = []
    presets = {} if project is None else project.presets
    for name, preset in presets.items():
        file = "camera.yaml"
        if len(calibration.adjustment.network.cameras) > 1:
            file = f"camera-{re.sub(r'[^A-Za-z0-9._-]+', '_', name)}.yaml"
        try:
            changed = stored_grid(preset).changed
            if changed:
                what = f"the calibrated pixels are not those of the sensor: {changed}"
                remedy = "use calibration.json directly: the lens of a camera file comes before the grabber, on the sensor's pixels"
                raise InputError(what, remedy=remedy)
            if file in made:
                raise InputError(f"{file} is the name of two files", remedy="give the cameras names that differ in letters and digits")
            made[file] = calibrated_camera(preset, calibrated_geometry(calibration, name))
        except PixmetryError as problem:
            found = f" ({problem.value})" if problem.value is not None else ""
            text = f"No {file} is written for '{name}': {problem.what}{found}."
            findings.append(Finding("camera_file", text, f"{problem.remedy[:1].upper()}{problem.remedy[1:]}."))
    return made, findings


def _steps(told: Progress) -> Callable[[str], None]:
    """A callable that reports the start of a step, and so the end of the previous one."""
    before = ""

    def step(what: str) -> None:
        nonlocal before
        if before:
            told(before, 1, 1)
        if what:
            told(what, 0, 1)
        before = what

    return step


def _project(
    source: str | Path | Sequence[str | Path], pictures: Mapping[str, Any], progress: Progress, free: Sequence[str] | str | None
) -> Project:
    from pixmetry.calibrate.project import load_project, project_of_pictures

    sources = [Path(source)] if isinstance(source, str | Path) else [Path(part) for part in source]
    projects = [path for path in sources if path.suffix.lower() in PROJECT_ENDINGS]
    if projects and len(sources) > 1:
        raise InputError("a project among other files", where=str(projects[0]), allowed="one project, or pictures", remedy="name it alone")
    if projects:
        _refuse_pictures(pictures, "a project file, which states it itself")
        return load_project(projects[0], progress)
    keys = (*PICTURE_KEYS, *CAMERA_KEYS, "rig")
    unknown = next((name for name in pictures if name not in keys), None)
    if unknown is not None:
        raise InputError(f"unknown option '{unknown}'", allowed=", ".join(keys), remedy="delete it")
    given = {name: value for name, value in pictures.items() if value is not None}
    if isinstance(given.get("grid"), (tuple, list)):
        given["grid"] = "x".join(str(n) for n in given["grid"])
    camera = {key: given[name] for name, key in CAMERA_KEYS.items() if name in given}
    if free is not None and not _listed(free) and ("c_mm" in camera or "c_px" in camera):
        camera["free"] = []  # where nothing is to be estimated, a single picture suffices
    plate = {key: given[name] for name, key in PICTURE_KEYS.items() if name in given}
    return project_of_pictures(sources, camera, plate, progress, rig=bool(given.get("rig")))


def _sources(source: str | Path | Network | Sequence[str | Path]) -> list[str | Path]:
    """Inputs that identify a calibration: the project file, the folders of pictures, or the names of a network's cameras."""
    if isinstance(source, Network):
        return [model.name for model in source.cameras]
    given = [Path(source)] if isinstance(source, str | Path) else [Path(part) for part in source]
    return [*dict.fromkeys(path if path.suffix.lower() in PROJECT_ENDINGS or path.is_dir() else path.parent for path in given)]


def _refuse_pictures(pictures: Mapping[str, Any], what: str) -> None:
    given = [name for name, value in pictures.items() if value not in (None, False)]
    if given:
        raise InputError(f"has no meaning with {what}", where=given[0], allowed="with pictures of a test field", remedy="leave it out")


def _listed(names: Sequence[str] | str) -> tuple[str, ...]:
    listed = tuple(names.replace(",", " ").split()) if isinstance(names, str) else tuple(names)
    return tuple(name for name in listed if name != "none")


def _changed(network: Network, free: Sequence[str] | str | None, per_image: Sequence[str] | str | None) -> Network:
    """The network with other parameters to estimate."""
    if free is not None:
        wanted = _checked(free, NAMES, "free")
        held = next((model.name for model in network.cameras if "c" not in wanted and not model["c"] > 0), None)
        if held is not None:
            what, remedy = f"c of camera '{held}' is held fixed, but has no value", "give c_mm or c_px, or add c"
            raise InputError(what, where="free", value=", ".join(wanted), remedy=remedy)
        mask = np.isin(NAMES, wanted)
        network = replace(network, cameras=tuple(replace(model, free=mask.copy()) for model in network.cameras))
    if per_image is not None:
        network = replace(network, per_image=_checked(per_image, PER_IMAGE_NAMES, "per_image"))
    return network


def _checked(names: Sequence[str] | str, allowed: Sequence[str], where: str) -> tuple[str, ...]:
    if not isinstance(names, str) and not (isinstance(names, Sequence) and all(isinstance(name, str) for name in names)):
        raise InputError("not names of parameters", where=where, value=type(names).__name__, allowed=", ".join(allowed))
    wanted = _listed(names)
    unknown = next((name for name in wanted if name not in allowed), None)
    if unknown is not None:
        raise InputError("no such parameter", where=where, value=unknown, allowed=", ".join(allowed))
    return wanted


def _options(given: Mapping[str, Any]) -> Any:
    from pixmetry.calibrate.bundle.solve import Options

    known = [field.name for field in fields(Options)]
    unknown = next((name for name in given if name not in known), None)
    if unknown is not None:
        raise InputError(f"unknown option '{unknown}'", where="options", allowed=", ".join(known), remedy="delete it")
    return Options(**given)


def _origin(project: Project | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """Digests of the inputs, versions and options."""
    hashes, about = None, dict[str, Any](options=dict(options))
    if project is not None:
        hashes = InputHashes(project.folder)
        for path in project.inputs:
            hashes.add_file(path)
        about |= {"name": project.name, "project": project.source.name if project.source is not None else None}
        about |= {"presets": {name: camera.name for name, camera in project.presets.items()}} if project.presets else {}
    return {**provenance_record(hashes, libraries=LIBRARIES), **about}
