"""Load a campaign from a YAML manifest, an EMVA 1288 descriptor, a folder with one of these, or the example that comes along."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pixmetry.camera.covered import Covered
from pixmetry.core.door import MOST_SETTINGS_BYTES, open_file, read_bytes
from pixmetry.core.errors import InputError
from pixmetry.files.emva_descriptor import decode_descriptor, is_descriptor, parse_descriptor
from pixmetry.files.files import find_file, find_files
from pixmetry.files.formats import frames_of
from pixmetry.files.images import check_frame, load_frame
from pixmetry.files.raw_values import RawLayout
from pixmetry.files.records import LOSSY, STACK_FRAMES, TARGETS, CameraFacts, Campaign, FrameGroup, OpticsFacts, check_groups

if TYPE_CHECKING:
    from pixmetry.files.schema import CameraModel, GroupModel, ManifestModel, OpticsModel

EXAMPLE = Path(__file__).resolve().parents[1] / "data" / "emva1288-set-001-crop"

LEAST_ACTIVE = 8  # rows, and columns, between covered borders
_PLANCK_J_S = 6.62607015e-34  # exact, SI 2019
_LIGHT_M_PER_S = 299792458.0  # exact


def photons_from_irradiance(irradiance_uw_per_cm2: float, exposure_s: float, area_um2: float, wavelength_nm: float) -> float:
    """Mean number of photons that reach one pixel in one exposure.

    Notes
    -----
    µ_p = A t E λ / (h c), which is 50.34 · A[µm²] · t[ms] · λ[µm] · E[µW/cm²] (EMVA 1288 Release 4.0, section on the linear model).
    """
    energy_j = irradiance_uw_per_cm2 * 1e-2 * area_um2 * 1e-12 * exposure_s
    return energy_j * wavelength_nm * 1e-9 / (_PLANCK_J_S * _LIGHT_M_PER_S)


class NoCampaign(InputError):
    """A folder without manifest and descriptor; its frames may make a campaign all the same."""


def load_campaign(path: str | Path | None = None) -> Campaign:
    """Load a campaign and check all that can be checked without reading every frame.

    Parameters
    ----------
    path : str or Path, optional
        A YAML manifest, an EMVA 1288 descriptor, or a folder with one of them. Default: the example data of the package.

    Returns
    -------
    Campaign

    Raises
    ------
    InputError
        If anything in the manifest, or about the files it names, makes the campaign unusable.

    Examples
    --------
    >>> campaign = load_campaign()  # the packaged example
    >>> campaign.camera.bits, len(campaign.files) > 100
    (12, True)
    """
    if path is not None and not isinstance(path, str | Path):
        remedy = "give its path, or make a campaign of arrays with campaign_of_arrays([Frames(kind, exposure_s, data), …], bits=…)"
        allowed = "path of a manifest or descriptor, or Campaign"
        raise InputError("not a campaign", value=type(path).__name__, allowed=allowed, remedy=remedy)
    source = _find_source(EXAMPLE if path is None else Path(path))
    raw = read_bytes(source, remedy="check the permissions")
    if source.suffix.lower() not in (".yaml", ".yml") and is_descriptor(decode_descriptor(raw)):
        facts: dict[str, Any] = {"optics": OpticsFacts()}
        parts = _from_descriptor(source, raw, None, None)
    else:
        model, lines = _read_manifest(source)
        facts = {"optics": OpticsFacts(**model.optics.model_dump()), "notes": model.notes, "operator": model.operator}
        facts["raw"] = None if model.raw is None else RawLayout(**model.raw.model_dump())
        parts = _from_manifest(source, model, lines, facts["raw"])
    groups, findings = check_groups(parts["groups"], str(source))
    stored, dtype = _discover(groups[0].paths[0], parts, facts.get("raw"), of=groups[0])
    shape = active_shape(parts["camera"], stored, str(source))
    check_window(parts["camera"], shape, str(source))
    return Campaign(
        camera=parts["camera"],
        groups=groups,
        frame_shape=shape,
        frame_dtype=dtype,
        source_path=source,
        descriptor_path=parts.get("descriptor_path"),
        licence=parts["licence"],
        findings=(*parts.get("findings", ()), *findings),
        **facts,
    )


def _discover(path: Path, parts: Mapping[str, Any], raw: RawLayout | None, *, of: FrameGroup) -> tuple[tuple[int, int], str]:
    """Take size and depth from the first frame; the size must be the declared one where one was declared."""
    array = load_frame(path, raw=raw, lossy=of.kind in LOSSY, channel=of.facts.channel).array
    check_frame(array, str(path), bits=parts["camera"].bits, shape=parts.get("shape"))
    return (array.shape[0], array.shape[1]), array.dtype.name


def active_shape(camera: CameraFacts, stored: tuple[int, int], where: str) -> tuple[int, int]:
    """Rows and columns of stored frames without their covered borders; refused where these leave too little."""
    if camera.covered is None:
        return stored
    shape = camera.covered.active_shape(stored)
    if min(shape) < LEAST_ACTIVE:
        raise InputError(
            "the covered borders leave too little of the frames",
            where=where,
            value=f"{shape[1]} x {shape[0]} of {stored[1]} x {stored[0]} pixels",
            allowed=f"at least {LEAST_ACTIVE} rows and columns with light",
            remedy="correct covered under camera: left and right count columns, top and bottom rows",
        )
    return shape


def check_window(camera: CameraFacts, shape: tuple[int, int], where: str) -> None:
    """Refuse frames that do not lie on the sensor that was stated."""
    if camera.sensor_rows is None or camera.sensor_cols is None:
        return
    row, col = camera.first_row or 0, camera.first_col or 0
    if row + shape[0] > camera.sensor_rows or col + shape[1] > camera.sensor_cols:
        found = f"{shape[1]} x {shape[0]} pixels from ({col}, {row})"
        allowed = f"inside sensor_cols x sensor_rows = {camera.sensor_cols} x {camera.sensor_rows}"
        remedy = "correct sensor_cols, sensor_rows, first_col, first_row"
        raise InputError("the frames do not lie on the sensor", where=where, value=found, allowed=allowed, remedy=remedy)


def _head(path: Path) -> bytes:
    """The first MiB of a file, which tells what it is."""
    try:
        with open_file(path) as file:
            return file.read(1 << 20)
    except OSError as problem:
        raise InputError("file cannot be read", where=str(path), value=problem.strerror, remedy="check the permissions") from None


def _has_schema(path: Path, what: str) -> bool:
    return re.search(rb"^schema:\s*['\"]?pixmetry/" + what.encode(), _head(path), re.MULTILINE) is not None


def _find_source(path: Path) -> Path:
    if path.is_file():
        return path
    if not path.is_dir():
        raise InputError(
            "no such file or folder", where=str(path), remedy="give a manifest (YAML), an EMVA 1288 descriptor or a folder with one"
        )
    files = sorted(p for p in path.iterdir() if p.is_file())
    manifests = [p for p in files if p.suffix.lower() in (".yaml", ".yml")]
    cameras = [p for p in manifests if _has_schema(p, "camera")]
    if len(manifests) > 1 or cameras:
        manifests = [p for p in manifests if _has_schema(p, "campaign")]
    descriptors = [p for p in files if p.suffix.lower() == ".txt" and is_descriptor(decode_descriptor(_head(p)))]
    if len(manifests) == 1:  # a manifest may add the camera's facts to a descriptor beside it
        text = read_bytes(manifests[0], MOST_SETTINGS_BYTES).decode("utf-8", errors="replace")
        descriptors = [p for p in descriptors if p.name not in text]
    found = manifests + descriptors
    if len(found) == 1:
        return found[0]
    if cameras and not found:
        raise InputError(
            "folder holds a camera, but no campaign",
            where=str(path),
            allowed="dark and bright frames of a uniform field, with their manifest",
            remedy="simulate a scene with photon_transfer (docs/scenes.md), which writes campaign.yaml too",
        )
    allowed = "one manifest (*.yaml) or one EMVA 1288 descriptor (*.txt)"
    if not found:
        raise NoCampaign("folder holds no campaign", where=str(path), allowed=allowed, remedy=f"draft one with `pixmetry init {path}`")
    names = ", ".join(p.name for p in found)
    raise InputError(f"folder holds several campaigns ({names})", where=str(path), allowed=allowed, remedy="name the file itself")


def _read_manifest(source: Path) -> tuple[ManifestModel, Mapping[tuple[str | int, ...], int]]:
    from pixmetry.core.config import load_yaml, validate
    from pixmetry.files.schema import ManifestModel

    data = load_yaml(source)
    return validate(ManifestModel, data, str(source)), data.lines


def _from_manifest(source: Path, model: ManifestModel, lines: Mapping[tuple[str | int, ...], int], raw: RawLayout | None) -> dict[str, Any]:
    camera = camera_facts(model.camera)
    if model.emva_descriptor is not None:
        where = _place(source, lines, "emva_descriptor")
        descriptor = find_file(source.parent, model.emva_descriptor, where)
        parts = _from_descriptor(descriptor, read_bytes(descriptor), camera, raw)
        return {**parts, "descriptor_path": descriptor, "licence": model.licence or parts["licence"]}
    groups = []
    for i, group in enumerate(model.frames):
        paths = find_files(source.parent, group.files, _place(source, lines, "frames", i, "files"), raw)
        photons = photons_of(group, model.optics, camera, _place(source, lines, "frames", i))
        role = group.role or role_of(group.kind, paths)
        groups.append(FrameGroup(group.kind, group.exposure_s or 0.0, photons, paths, role, group.facts()))
    return {"camera": camera, "groups": tuple(groups), "licence": model.licence}


def camera_facts(model: CameraModel) -> CameraFacts:
    """The facts of the camera that a manifest states."""
    facts = model.model_dump(exclude={"pitch_um"})
    if model.pitch_um is not None:
        facts["pitch_x_um"] = facts["pitch_y_um"] = model.pitch_um
    if model.covered is not None:
        facts["covered"] = Covered(**model.covered.model_dump())
    return CameraFacts(**facts)


def _place(source: Path, lines: Mapping[tuple[str | int, ...], int], *loc: str | int) -> str:
    """Name file and line; a value that came through a YAML merge has no line of its own."""
    return f"{source}, line {lines[loc]}" if loc in lines else str(source)


def role_of(kind: str, paths: tuple[Path, ...]) -> str:
    """Whether a group is a target, a stack or a level, where nobody said."""
    if kind in TARGETS:
        return "target"
    return "stack" if len(paths) >= STACK_FRAMES else "level"


def photons_of(group: GroupModel, optics: OpticsModel, camera: CameraFacts, where: str) -> float | None:
    """Photons per pixel and exposure of a group: as stated, else from the irradiance; None where neither is known."""
    if group.kind == "dark":
        return 0.0
    if group.kind in TARGETS:
        return None
    irradiance = group.irradiance_uw_per_cm2 or optics.irradiance_uw_per_cm2
    if group.photons is not None or irradiance is None:
        return group.photons
    if camera.pitch_x_um is None or camera.pitch_y_um is None or optics.wavelength_nm is None:
        missing = "wavelength_nm under optics" if optics.wavelength_nm is None else "pitch_um under camera"
        raise InputError("photons do not follow from the irradiance alone", where=where, remedy=f"add {missing}, or give photons")
    return photons_from_irradiance(irradiance, group.exposure_s or 0.0, camera.pitch_x_um * camera.pitch_y_um, optics.wavelength_nm)


def _from_descriptor(source: Path, text: bytes, camera: CameraFacts | None, raw: RawLayout | None) -> dict[str, Any]:
    descriptor = parse_descriptor(source, text)
    if camera is not None and camera.bits != descriptor.bits:
        what = f"the manifest declares {camera.bits} bits, the descriptor {descriptor.bits}"
        raise InputError(what, where=str(source), remedy="correct the one that is wrong")
    groups = []
    for group in descriptor.groups:
        files = (find_file(source.parent, text, f"{source}, line {line}") for text, line in group.files)
        paths = tuple(frame for file in files for frame in frames_of(file, raw))
        groups.append(FrameGroup(group.kind, group.exposure_s, group.photons, paths, role_of(group.kind, paths)))
    return {
        "camera": camera or CameraFacts(name=source.parent.resolve().name or source.stem, bits=descriptor.bits),
        "groups": tuple(groups),
        "shape": (descriptor.height, descriptor.width),
        "licence": descriptor.header,
        "findings": tuple(descriptor.notes),
    }


def write_manifest(campaign: Campaign, path: str | Path) -> None:
    """Write a campaign as a YAML manifest; its frames must lie in or below the manifest's folder.

    Raises
    ------
    InputError
        If a frame lies elsewhere.
    """
    from dataclasses import asdict

    from pixmetry.core.config import dump_yaml
    from pixmetry.files.schema import CAMPAIGN_SCHEMA

    base = Path(path).parent
    frames = []
    for group in campaign.groups:
        outside = next((p for p in group.paths if not p.is_relative_to(base)), None)
        if outside is not None:
            raise InputError(
                "frame lies outside the manifest's folder",
                where=str(path),
                value=outside.name,
                remedy="write the manifest above the frames",
            )
        photons = group.photons if group.kind == "bright" else None
        files = [p.relative_to(base).as_posix() for p in group.paths]
        told: dict[str, Any] = {"kind": group.kind, "exposure_s": group.exposure_s, "photons": photons, "role": group.role}
        if group.kind in TARGETS:
            told |= {"exposure_s": group.exposure_s or None, "role": None}
        stated = {name: value for name, value in asdict(group.facts).items() if value is not None}
        facts = {name: list(value) if isinstance(value, tuple) else value for name, value in stated.items()}
        frames.append({**told, **facts, "files": files})
    manifest = {"schema": CAMPAIGN_SCHEMA, "camera": asdict(campaign.camera), "optics": asdict(campaign.optics), "frames": frames}
    texts = {name: getattr(campaign, name) or None for name in ("licence", "notes", "operator")}
    layout = None if campaign.raw is None else asdict(campaign.raw)
    dump_yaml({**manifest, "raw": layout, **texts}, path)
