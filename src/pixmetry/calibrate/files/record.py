"""All numbers of a calibration as one strict JSON text, and read back from it."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.checks.known_residuals import control_of
from pixmetry.calibrate.lines.plumb_line import LineCalibration
from pixmetry.calibrate.records import Calibration, ResidualGrid, Tests, read_record, record_of
from pixmetry.core.checksums import check_record, sealed
from pixmetry.core.config import read_text
from pixmetry.core.door import check_depth, inflated, one_sentence
from pixmetry.core.errors import InputError
from pixmetry.core.finding import Finding
from pixmetry.core.memory import check_memory
from pixmetry.files.strict_json import json_text, plain

RESULT_SCHEMA = "pixmetry/calibration-result/1"
LINES_SCHEMA = "pixmetry/line-calibration-result/1"
PIXELS = "pixel (0, 0) is the centre of the top-left pixel, x to the right, y down"
LOWER = "lower triangle by rows: XX, YX, YY, ZX, ZY, ZZ"
MOST_UNKNOWNS = 1_000_000  # of a stored covariance
T = TypeVar("T")


@dataclass(frozen=True)
class StoredCalibration:
    """What `read_calibration` gives back.

    Parameters
    ----------
    cameras : tuple of CameraModel
        Adjusted; ``free`` says which parameters were estimated.
    columns : tuple of str
        Names of the rows of ``covariance``, as in `pixmetry.calibrate.bundle.network.Adjustment`.
    covariance : ndarray, shape (m, m)
        Of interior parameters, poses, and points that bars join.
    images : tuple of str
    camera_of : ndarray of int, shape (images,)
    rotation : ndarray, shape (images, 3, 3)
    position : ndarray, shape (images, 3)
    points : tuple of str
    xyz : ndarray, shape (points, 3)
        NaN: not determined.
    point_covariance : ndarray, shape (points, 3, 3)
    unit : str
        Of the object.
    sigma0 : float
    dof : int
    datum : str
    findings : tuple of Finding
    tests : Tests
    grids, provenance : dict
        As in `pixmetry.calibrate.records.Calibration`.
    """

    cameras: tuple[CameraModel, ...]
    columns: tuple[str, ...]
    covariance: np.ndarray
    images: tuple[str, ...]
    camera_of: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    points: tuple[str, ...]
    xyz: np.ndarray
    point_covariance: np.ndarray
    unit: str
    sigma0: float
    dof: int
    datum: str
    findings: tuple[Finding, ...]
    tests: Tests
    grids: dict[str, ResidualGrid]
    provenance: dict[str, Any]

    def interior_covariance(self, index: int = 0) -> tuple[tuple[str, ...], np.ndarray]:
        """Names of the estimated parameters of a camera and their covariance."""
        own = {f"{self.cameras[index].name}:{name}": name for name in NAMES}
        rows = [i for i, column in enumerate(self.columns) if column in own]
        return tuple(own[self.columns[i]] for i in rows), self.covariance[np.ix_(rows, rows)]

    def interior_dof(self, index: int = 0) -> np.ndarray:
        """Degrees of freedom of their uncertainties."""
        shared = (self.tests.shared_errors or {}).get(self.cameras[index].name)
        return shared.dof if shared is not None else np.full(len(self.interior_covariance(index)[0]), float(self.dof))


def calibration_json(calibration: Calibration, folder: str | Path = "", beside: Iterable[str] = ()) -> str:
    """All numbers of a calibration as strict JSON; the joint covariance is packed, see `unpacked`.

    Parameters
    ----------
    calibration : Calibration
    folder : path
    beside : iterable of str
        Names of files in the folder whose digests it is to hold.
    """
    return json_text(sealed(plain(_record(calibration)), folder, beside))


def _record(calibration: Calibration) -> dict[str, Any]:
    a = calibration.adjustment
    network, state = a.network, a.state
    return {
        "schema": RESULT_SCHEMA,
        "conventions": f"{PIXELS}; a point X is imaged at R (X - X0), z forwards; covariances are a posteriori",
        "unit": network.unit,
        "datum": a.datum,
        "sigma0": a.sigma0,
        "dof": a.dof,
        "iterations": a.iterations,
        "cameras": [_camera_record(calibration, k) for k in range(len(network.cameras))],
        "images": {
            "name": network.images,
            "camera": network.camera_of,
            "time_s": network.time_s,
            "rotation": state.rotation.reshape(-1, 9),
            "position": state.position,
            "x_scale": state.x_scale if network.per_image else None,
            "x_shift_px": state.x_shift_px if network.per_image else None,
        },
        "points": {
            "name": network.points,
            "xyz": state.xyz,
            "covariance": a.point_covariance.reshape(-1, 9)[:, [0, 3, 4, 6, 7, 8]],
            "covariance_form": LOWER,
        },
        "control_points": _control_record(calibration),
        "covariance": {"columns": a.free_columns, **packed(a.covariance)},
        "findings": [finding.to_record() for finding in calibration.findings],
        "notes": a.notes,
        "tests": record_of(calibration.tests),
        "grids": {name: record_of(grid) for name, grid in calibration.grids.items()},
        "provenance": calibration.provenance,
    }


def _control_record(calibration: Calibration) -> dict[str, Any]:
    """Coordinates that were given with an uncertainty, given less adjusted, and that over the uncertainty that was stated."""
    control = control_of(calibration)
    names = calibration.adjustment.network.points
    return {
        "point": [names[k] for k in control.point],
        "axis": ["XYZ"[k] for k in control.axis],
        "given": control.given,
        "u": control.u,
        "residual": control.residual,
        "ratio": np.divide(control.residual, control.u, out=np.full(len(control), np.nan), where=control.u > 0),
    }


def _camera_record(calibration: Calibration, k: int) -> dict[str, Any]:
    a = calibration.adjustment
    record = camera_record(a.camera(k), *a.interior_covariance(k))
    if a.shared is not None and a.shared.found:
        dof = dict(zip(record["covariance"]["names"], a.interior_dof(k), strict=True))
        record["parameters"] = [{**one, **({"dof": dof[one["name"]]} if one["name"] in dof else {})} for one in record["parameters"]]
    return record


def lines_json(calibration: LineCalibration, folder: str | Path = "", beside: Iterable[str] = ()) -> str:
    """All numbers of a calibration from straight lines as strict JSON; parameters as of `calibration_json`."""
    result = calibration.result
    record = {
        "schema": LINES_SCHEMA,
        "conventions": f"{PIXELS}; residuals are across the lines; covariances are a posteriori; c is 0 where it was not given",
        "cameras": [camera_record(result.camera, result.free, result.estimates.covariance)],
        "sigma_px": result.sigma_px,
        "iterations": result.iterations,
        **result.to_record(),
        "curves": record_of(calibration.curves()),
        "findings": [finding.to_record() for finding in calibration.findings],
        "provenance": calibration.provenance,
    }
    return json_text(sealed(plain(record), folder, beside))


def camera_record(model: CameraModel, names: tuple[str, ...], covariance: np.ndarray) -> dict[str, Any]:
    """One camera with the covariance of what was estimated of it."""
    u = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    return {
        "name": model.name,
        **asdict(model.sensor),
        "direction": model.direction,
        "interface": model.interface,
        "projection": model.projection,
        "parameters": [
            {"name": name, "value": value, "u": u.get(name, 0.0), "unit": unit, "free": bool(free)}
            for name, value, unit, free in model.parameters
        ],
        "covariance": {"names": names, "rows": covariance},
    }


def packed(matrix: np.ndarray) -> dict[str, Any]:
    """A symmetric matrix as its lower triangle, row by row: float64, little-endian, zlib, base64."""
    lower = matrix[np.tril_indices(len(matrix))].astype("<f8")
    data = base64.b64encode(zlib.compress(lower.tobytes(), 1)).decode()
    return {"form": "lower triangle by rows: float64 little-endian, zlib, base64", "size": len(matrix), "data": data}


def unpacked(record: Mapping[str, Any]) -> np.ndarray:
    """The matrix that `packed` stored."""
    n = int(record["size"])
    if not 0 <= n <= MOST_UNKNOWNS:
        raise ValueError(f"a covariance of {n} unknowns")
    check_memory(16 * n * n, f"a covariance of {n} unknowns", remedy="check the file")
    lower = np.frombuffer(inflated(base64.b64decode(record["data"]), 4 * n * (n + 1)), "<f8")
    matrix = np.zeros((n, n))
    matrix[np.tril_indices(n)] = lower
    return matrix + np.tril(matrix, -1).T


def read_calibration(path: str | Path) -> StoredCalibration:
    """Read a calibration back.

    Parameters
    ----------
    path : path
        Its folder, or the file ``calibration.json`` in it.

    Raises
    ------
    InputError
        If there is no such file, or it is something else.

    Examples
    --------
    >>> from pixmetry import calibrate, read_calibration
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
    >>> made = calibrate("project.yaml", "result")
    >>> stored = read_calibration("result")
    >>> stored.images == made.adjustment.network.images, stored.sigma0 == made.adjustment.sigma0
    (True, True)
    """
    if not isinstance(path, str | Path):
        raise InputError("not the name of a folder or file", where="path", value=type(path).__name__, allowed="a path")
    return _read(path, (RESULT_SCHEMA,), _stored)


def check_calibration(given: object, where: str = "calibration") -> None:
    """Refuse what is not a calibration with points.

    Raises
    ------
    InputError
        If it is something else.
    """
    if not isinstance(given, (Calibration, StoredCalibration)):
        remedy = "give what `calibrate` or `read_calibration` returned"
        raise InputError(
            "not a calibration", where=where, value=type(given).__name__, allowed="Calibration, StoredCalibration", remedy=remedy
        )


def stored_cameras(path: str | Path) -> tuple[CameraModel, ...]:
    """Read the cameras alone, also of a calibration from straight lines (whose c is 0 unless it was given); raises likewise."""
    return _read(path, (RESULT_SCHEMA, LINES_SCHEMA), lambda record: tuple(_camera(camera) for camera in record["cameras"]))


def calibration_file(path: str | Path) -> Path:
    """The file with the numbers, of a folder of results or named itself."""
    return Path(path) / "calibration.json" if Path(path).is_dir() else Path(path)


def _read(path: str | Path, schemas: tuple[str, ...], made: Callable[[Mapping[str, Any]], T]) -> T:
    file = calibration_file(path)
    text = read_text(file)
    try:
        record = json.loads(text)
        schema = record["schema"]
    except (ValueError, KeyError, TypeError, RecursionError):
        schema = None
    if schema not in schemas:
        remedy = "name the calibration.json that `pixmetry calibrate` wrote, or its folder"
        if schema == LINES_SCHEMA:
            remedy = (
                "straight lines do not determine the whole camera: calibrate with a test field (its project can `start_from` this file)"
            )
        raise InputError("not a calibration", where=str(file), value=schema, allowed=" or ".join(schemas), remedy=remedy)
    check_depth(record, str(file))
    check_record(record, str(file))
    with one_sentence("a damaged calibration", str(file), remedy="calibrate again"):
        return made(record)


def _stored(record: Mapping[str, Any]) -> StoredCalibration:
    images, points = record["images"], record["points"]
    xyz, six = _array(points["xyz"], 3), _array(points["covariance"], 6)
    whole = [0, 1, 3, 1, 2, 4, 3, 4, 5] if "covariance_form" in points else [0, 1, 2, 1, 3, 4, 2, 4, 5]  # older files: the upper triangle
    return StoredCalibration(
        cameras=tuple(_camera(camera) for camera in record["cameras"]),
        columns=tuple(record["covariance"]["columns"]),
        covariance=unpacked(record["covariance"]),
        images=tuple(images["name"]),
        camera_of=np.array(images["camera"], dtype=np.int64),
        rotation=_array(images["rotation"], 9).reshape(-1, 3, 3),
        position=_array(images["position"], 3),
        points=tuple(points["name"]),
        xyz=xyz,
        point_covariance=six[:, whole].reshape(-1, 3, 3),
        findings=tuple(Finding.from_record(finding) for finding in record["findings"]),
        tests=read_record(Tests, record["tests"]),
        grids={name: read_record(ResidualGrid, grid) for name, grid in record["grids"].items()},
        **{name: record[name] for name in ("unit", "sigma0", "dof", "datum", "provenance")},
    )


def _camera(record: Mapping[str, Any]) -> CameraModel:
    parameters = record["parameters"]
    sensor = Sensor(*(record[name] for name in ("cols", "rows", "pitch_x_um", "pitch_y_um")))
    value = {parameter["name"]: float(parameter["value"]) for parameter in parameters}
    free = {parameter["name"] for parameter in parameters if parameter["free"]}
    return CameraModel(
        sensor,
        record["direction"],
        np.array([value.get(name, 0.0) for name in NAMES]),
        np.isin(NAMES, list(free)),
        record["name"],
        record.get("interface"),
        record.get("projection", "perspective"),
    )


def _array(rows: list[list[float | None]], width: int) -> np.ndarray:
    return np.array(rows, dtype=float).reshape(-1, width)


def cameras_text(calibration: Calibration | LineCalibration, report: str = "") -> str:
    """The cameras alone, with what was found, as strict JSON."""
    names: tuple[str, ...] = ("schema", "unit", "datum", "sigma0", "dof", "cameras", "findings")
    if isinstance(calibration, LineCalibration):
        record, names = json.loads(lines_json(calibration)), ("schema", "cameras", "axes", "f_test", "findings")
    else:
        record = _record(calibration)
    rig = {"rig": record["tests"]["rig"]} if record.get("tests", {}).get("rig") else {}
    return json_text({**{name: record[name] for name in names}, **rig, "report": report or None}).rstrip("\n")
