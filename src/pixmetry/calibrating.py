"""Calibrating: from a project, a network or pictures of a test field to calibrated cameras, with a folder of results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibration.model import NAMES
from pixmetry.calibration.network import Calibration, Network
from pixmetry.calibration_files import check_folder, write_results
from pixmetry.calibration_record import StoredCalibration, read_calibration
from pixmetry.campaign.provenance import InputHashes, provenance_record
from pixmetry.core.errors import InputError

if TYPE_CHECKING:
    from pixmetry.calibration_project import Project

__all__ = ["StoredCalibration", "calibrate", "read_calibration"]

Progress = Callable[[str, int, int], None]
PROJECT_ENDINGS = (".yaml", ".yml")
# What is said with pictures, and the keys of a project's ``cameras`` and ``pictures`` that mean the same.
CAMERA_KEYS = {"direction": "direction", "pixel_um": "pitch_um", "c_mm": "c_mm", "c_px": "c_px"}
PICTURE_KEYS = {
    **{name: name for name in ("kind", "grid", "polarity", "channel", "noise")},
    **{f"{name}_mm": name for name in ("pitch", "side", "diameter")},
}
LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless")


def calibrate(
    source: str | Path | Network | Sequence[str | Path],
    output: str | Path | None = None,
    *,
    free: Sequence[str] | str | None = None,
    per_image: Sequence[str] | str | None = None,
    options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    **pictures: Any,
) -> Calibration:
    """Calibrate one or several cameras.

    Parameters
    ----------
    source : path, Network, or sequence of paths
        A project file (YAML), a network that was put together in Python, or pictures of a test field (files, patterns, folders).
    output : path, optional
        Folder for ``report.html``, ``calibration.json``, ``points.csv``, ``poses.csv`` and ``residuals.csv``.
    free : sequence of str, optional
        Interior parameters to estimate, out of c, xp, yp, b1, b2, p1, p2, k1 … k5, in place of what the project says.
    per_image : sequence of str, optional
        Out of ``"x_scale"`` and ``"x_shift"``, likewise.
    options : mapping, optional
        Of `pixmetry.calibration.solve.Options`, likewise.
    progress : callable, optional
        Called with (what, done, of).
    **pictures
        For pictures: ``kind`` ("chessboard", "dots", "coded" or "squares"), ``grid`` ("9x6"), ``pitch_mm`` (spacing of the targets),
        ``side_mm``, ``diameter_mm`` (of squares and dots), ``polarity``, ``channel``, ``noise``; and of the camera: ``direction``,
        ``pixel_um`` (pitch of the pixels), ``c_mm`` or ``c_px``.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError, MeasureError
        If a file or an option cannot be used, or the images do not carry what was asked for; nothing is written then.
    """
    from pixmetry.calibration.solve import calibrate_network

    if output is not None:
        check_folder(output)  # before the work, not after it
    told = progress or (lambda what, done, of: None)
    project = None
    if isinstance(source, Network):
        _refuse_pictures(pictures, "a network")
        network, given = source, {}
    else:
        project = _project(source, pictures, told)
        network, given = project.network, project.options
        if output is not None:
            _refuse_inputs(Path(output), project)
    network = _changed(network, free, per_image)
    chosen = _options({**given, **(options or {})})
    step = _steps(told)
    calibration = _with_origin(calibrate_network(network, chosen, progress=step), project, chosen)
    if output is not None:
        step("writing the results")
        write_results(calibration, output)
    step("")
    return calibration


def _steps(told: Progress) -> Callable[[str], None]:
    """A callable that tells the begin of a step, and with it the end of the one before."""
    before = ""

    def step(what: str) -> None:
        nonlocal before
        if before:
            told(before, 1, 1)
        if what:
            told(what, 0, 1)
        before = what

    return step


def _project(source: str | Path | Sequence[str | Path], pictures: Mapping[str, Any], progress: Progress) -> Project:
    from pixmetry.calibration_project import load_project, project_of_pictures

    sources = [Path(source)] if isinstance(source, str | Path) else [Path(part) for part in source]
    projects = [path for path in sources if path.suffix.lower() in PROJECT_ENDINGS]
    if projects and len(sources) > 1:
        raise InputError("a project among other files", where=str(projects[0]), allowed="one project, or pictures", remedy="name it alone")
    if projects:
        _refuse_pictures(pictures, "a project file, which says it itself")
        return load_project(projects[0], progress)
    keys = (*PICTURE_KEYS, *CAMERA_KEYS)
    unknown = next((name for name in pictures if name not in keys), None)
    if unknown is not None:
        raise InputError(f"unknown option '{unknown}'", allowed=", ".join(keys), remedy="delete it")
    given = {name: value for name, value in pictures.items() if value is not None}
    camera = {key: given[name] for name, key in CAMERA_KEYS.items() if name in given}
    plate = {key: given[name] for name, key in PICTURE_KEYS.items() if name in given}
    return project_of_pictures(sources, camera, plate, progress)


def _refuse_inputs(output: Path, project: Project) -> None:
    """An earlier result in the folder would be replaced: none of the project's files may be in it."""
    inside = next((path for path in project.inputs if path.resolve().is_relative_to(output.resolve())), None)
    if inside is not None:
        remedy = "choose another folder for the results"
        raise InputError("the folder holds a file of the project", where=str(output), value=inside.name, remedy=remedy)


def _refuse_pictures(pictures: Mapping[str, Any], what: str) -> None:
    given = [name for name, value in pictures.items() if value is not None]
    if given:
        raise InputError(f"has no meaning with {what}", where=given[0], allowed="with pictures of a test field", remedy="leave it away")


def _listed(names: Sequence[str] | str) -> tuple[str, ...]:
    return tuple(names.replace(",", " ").split()) if isinstance(names, str) else tuple(names)


def _changed(network: Network, free: Sequence[str] | str | None, per_image: Sequence[str] | str | None) -> Network:
    """The network with other parameters to estimate."""
    if free is not None:
        wanted = _checked(free, NAMES, "free")
        held = next((model.name for model in network.cameras if "c" not in wanted and not model["c"] > 0), None)
        if held is not None:
            what, remedy = f"c of camera '{held}' is to be held, but has no value", "give c_mm or c_px, or add c"
            raise InputError(what, where="free", value=", ".join(wanted), remedy=remedy)
        mask = np.isin(NAMES, wanted)
        network = replace(network, cameras=tuple(replace(model, free=mask.copy()) for model in network.cameras))
    if per_image is not None:
        network = replace(network, per_image=_checked(per_image, ("x_scale", "x_shift"), "per_image"))
    return network


def _checked(names: Sequence[str] | str, allowed: Sequence[str], where: str) -> tuple[str, ...]:
    wanted = _listed(names)
    unknown = next((name for name in wanted if name not in allowed), None)
    if unknown is not None:
        raise InputError("no such parameter", where=where, value=unknown, allowed=", ".join(allowed))
    return wanted


def _options(given: Mapping[str, Any]) -> Any:
    from pixmetry.calibration.solve import Options

    known = [field.name for field in fields(Options)]
    unknown = next((name for name in given if name not in known), None)
    if unknown is not None:
        raise InputError(f"unknown option '{unknown}'", where="options", allowed=", ".join(known), remedy="delete it")
    return Options(**given)


def _with_origin(calibration: Calibration, project: Project | None, options: Any) -> Calibration:
    """The calibration with the digests of its inputs, versions and options."""
    hashes, findings = None, calibration.findings
    about: dict[str, Any] = {"options": {field.name: getattr(options, field.name) for field in fields(options)}}
    if project is not None:
        hashes = InputHashes(project.folder)
        for path in project.inputs:
            hashes.add_file(path)
        findings = (*findings, *project.findings)
        about |= {"name": project.name, "project": project.source.name if project.source is not None else None}
    record = provenance_record(hashes, libraries=LIBRARIES)
    return replace(calibration, findings=findings, provenance={**calibration.provenance, **record, **about})
