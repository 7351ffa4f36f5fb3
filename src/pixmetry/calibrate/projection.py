"""A calibrated camera in the user's own sums: points to pixels and back with their covariance, and the difference of two calibrations.

A pixel is x = π(d, q), with the direction d and the interior parameters q of covariance C. So a projected point has the covariance J C Jᵀ
with J = ∂π/∂q, and a ray H C Hᵀ with H = −(∂π/∂d)⁻¹ J, both beside that of the point or of the pixel.

Two calibrations of one camera differ by a rotation that nobody can see, because each use of a camera finds its pose anew. So the rotation
that makes them most alike over the frame is taken out of their difference and of its uncertainty (the implied transformation of mrcal's
documentation, "differencing").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.bundle.network import Adjustment, State
from pixmetry.core.arrays import Array, given_array, given_count
from pixmetry.core.errors import InputError

if TYPE_CHECKING:
    from pixmetry.calibrate.files.record import StoredCalibration
    from pixmetry.calibrate.records import Calibration

ROTATIONS, SETTLED = 10, 1e-12  # steps of the implied rotation, and the last one, rad
MOST_PLACES = 1000  # along a side of the frame
RANK = 1e-6  # share of the largest singular value below which a direction counts as 0


@dataclass(frozen=True)
class Pixels:
    """Projected points.

    Parameters
    ----------
    px : ndarray, shape (n, 2)
        NaN: not before the camera, or the distortion has no inverse.
    covariance_px2 : ndarray, shape (n, 2, 2)
    """

    px: Array
    covariance_px2: Array


@dataclass(frozen=True)
class Rays:
    """Directions in which pixels look.

    Parameters
    ----------
    direction : ndarray, shape (n, 3)
        Unit vectors in the frame of the camera: x to the right, y down, z forwards.
    covariance : ndarray, shape (n, 3, 3)
        Of rank 2: nothing is uncertain along the ray.
    """

    direction: Array
    covariance: Array


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera with the covariance of what was estimated of it.

    Parameters
    ----------
    model : CameraModel
    names : tuple of str
        Estimated parameters.
    covariance : ndarray, shape (k, k)
    dof : float
        Degrees of freedom of the covariance, in the mean of the parameters; infinite: it is exact.
    """

    model: CameraModel
    names: tuple[str, ...]
    covariance: Array
    dof: float = np.inf

    def pack(self) -> Array:
        """Values of the estimated parameters, shape (k,), in the order of ``names`` and of ``covariance``."""
        packed: Array = self.model.values[self._places]
        return packed

    def unpack(self, values: Sequence[float] | Array) -> CalibratedCamera:
        """The camera with other values of the estimated parameters, such as a draw from their covariance."""
        row = self.model.values.copy()
        row[self._places] = given_array(values, "values", (len(self.names),), finite=True)
        return replace(self, model=replace(self.model, values=row))

    @property
    def _places(self) -> list[int]:
        return [NAMES.index(name) for name in self.names]

    def project(self, points: Array, covariance: Array | None = None) -> Pixels:
        """Pixels of points in the frame of the camera.

        Parameters
        ----------
        points : ndarray, shape (n, 3)
        covariance : ndarray, shape (n, 3, 3), optional
            Of the points, in that frame.

        Raises
        ------
        InputError
            If an argument is no array of numbers of its shape. A point that holds NaN has no pixel.

        Examples
        --------
        >>> from pixmetry.calibrate.bundle.model import CameraModel, Sensor
        >>> camera = CalibratedCamera(CameraModel.of(Sensor(640, 480), c=800.0), ("c",), np.array([[4.0]]))
        >>> seen = camera.project(np.array([[0.1, 0.0, 1.0]]))
        >>> seen.px.round(6).tolist(), seen.covariance_px2[0].round(6).tolist()  # u(c) = 2 px is 0.2 px at a tenth of the distance
        ([[399.5, 239.5]], [[0.04, 0.0], [0.0, 0.0]])
        """
        points = given_array(points, "points", ("n", 3))
        if covariance is not None:
            covariance = given_array(covariance, "covariance", (len(points), 3, 3))
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (np.where(points[:, 2] > 0, points[:, k] / points[:, 2], np.nan) for k in (0, 1))
        x, y, by_direction, by_interior = self.model.projected(u, v)
        slopes = by_interior[:, :, self._places]
        out = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        if covariance is not None:
            z = points[:, 2]
            by_point = np.concatenate([by_direction, -(by_direction @ np.stack([u, v], 1)[:, :, None])], axis=2) / z[:, None, None]
            out = out + by_point @ covariance @ np.swapaxes(by_point, 1, 2)
        out[~np.isfinite(x + y)] = np.nan
        return Pixels(np.stack([x, y], axis=1), out)

    def unproject(self, px: Array, covariance_px2: Array | None = None) -> Rays:
        """Rays of pixels.

        Parameters
        ----------
        px : ndarray, shape (n, 2)
        covariance_px2 : ndarray, shape (n, 2, 2), optional
            Of the pixels.

        Raises
        ------
        InputError
            If an argument is no array of numbers of its shape. A pixel that holds NaN has no ray.
        """
        px = given_array(px, "px", ("n", 2))
        if covariance_px2 is not None:
            covariance_px2 = given_array(covariance_px2, "covariance_px2", (len(px), 2, 2))
        u, v = self.model.direction_of(*px.T)
        _, _, by_direction, by_interior = self.model.projected(u, v)
        back = _inverse(by_direction)
        slopes = -back @ by_interior[:, :, self._places]
        plane = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        if covariance_px2 is not None:
            plane = plane + back @ covariance_px2 @ np.swapaxes(back, 1, 2)
        ray = np.stack([u, v, np.ones_like(u)], axis=1)
        length = np.linalg.norm(ray, axis=1)
        unit = ray / length[:, None]
        tangent = (np.eye(3) - unit[:, :, None] * unit[:, None, :])[:, :, :2] / length[:, None, None]
        return Rays(unit, tangent @ plane @ np.swapaxes(tangent, 1, 2))


def _inverse(matrices: Array) -> Array:
    """Inverses of 2 × 2 matrices; NaN stays."""
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    out: Array = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2) / (a * d - b * c)[:, None, None]
    return out


def calibrated_cameras(calibration: Calibration | StoredCalibration) -> dict[str, CalibratedCamera]:
    """The cameras of a calibration by their names.

    Parameters
    ----------
    calibration : Calibration or StoredCalibration

    Raises
    ------
    InputError
        If it is something else.
    """
    from pixmetry.calibrate.files.record import StoredCalibration, check_calibration

    check_calibration(calibration)
    if isinstance(calibration, StoredCalibration):
        told: StoredCalibration | Adjustment = calibration
        models = calibration.cameras
    else:
        told = calibration.adjustment
        models = tuple(told.camera(k) for k in range(len(told.network.cameras)))
    found = {}
    for k, model in enumerate(models):
        names, covariance = told.interior_covariance(k)
        found[model.name] = CalibratedCamera(model, names, covariance, float(np.mean(told.interior_dof(k))) if names else np.inf)
    return found


@dataclass(frozen=True)
class Difference:
    """How two calibrations of one camera differ, over its frame.

    Parameters
    ----------
    x_px : ndarray, shape (cols,)
    y_px : ndarray, shape (rows,)
    shift_px : ndarray, shape (rows, cols, 2)
        Where the second sees the direction of a pixel of the first, less that pixel; NaN where either has none.
    u_px : ndarray, shape (rows, cols, 2)
        Its standard uncertainty, by both covariances, as independent.
    rotation : ndarray, shape (3, 3)
        From the frame of the first to that of the second, which was taken out.
    rms_px, expected_rms_px : float
        Over the frame, and what the uncertainties let expect.
    chi2 : float
    dof : int
        Of the shifts that both covariances can explain.
    p : float
        Of a difference so large by chance: by an F-test, where the covariances have finite degrees of freedom.
    """

    x_px: Array
    y_px: Array
    shift_px: Array
    u_px: Array
    rotation: Array
    rms_px: float
    expected_rms_px: float
    chi2: float
    dof: int
    p: float


def difference(first: CalibratedCamera, second: CalibratedCamera, cols: int = 25, rows: int = 19, *, rotate: bool = True) -> Difference:
    """Compare two calibrations of one camera.

    Parameters
    ----------
    first, second : CalibratedCamera
        Of frames of the same size; the lens models may be different ones.
    cols, rows : int
        Places along the sides of the frame.
    rotate : bool
        Whether to take out the rotation that makes them most alike.

    Raises
    ------
    InputError
        If one of them is something else, the frames have different sizes, or the lenses have no inverse in most of the frame.
    """
    from scipy import stats
    from scipy.spatial.transform import Rotation

    for name, camera in (("first", first), ("second", second)):
        if not isinstance(camera, CalibratedCamera):
            remedy = "take the camera out of a calibration: calibrated_cameras(calibration)[NAME]"
            raise InputError("not a calibrated camera", where=name, value=type(camera).__name__, allowed="CalibratedCamera", remedy=remedy)
    cols, rows = given_count(cols, "cols", 2, MOST_PLACES), given_count(rows, "rows", 2, MOST_PLACES)
    sensor, other = first.model.sensor, second.model.sensor
    if (sensor.cols, sensor.rows) != (other.cols, other.rows):
        found, allowed = f"{other.cols} x {other.rows} pixels", f"{sensor.cols} x {sensor.rows} pixels"
        raise InputError("calibrations of different frames", where=second.model.name, value=found, allowed=allowed)
    x, y = np.linspace(0, sensor.cols - 1, cols), np.linspace(0, sensor.rows - 1, rows)
    px = np.stack([part.ravel() for part in np.meshgrid(x, y)], axis=1)
    u, v = first.model.direction_of(*px.T)
    good = np.isfinite(u + v) & np.isfinite(second.project(np.stack([u, v, np.ones_like(u)], axis=1)).px).all(axis=1)
    if good.mean() < 0.5:
        raise InputError("the distortion has no inverse in most of the frame", where=first.model.name, remedy="compare a part of the frame")
    ray, turn = np.stack([u[good], v[good], np.ones(int(good.sum()))], axis=1), np.eye(3)
    for _ in range(ROTATIONS if rotate else 0):
        shift, by_turn, _ = _shift(second.model, ray @ turn.T, px[good])
        step = np.linalg.lstsq(by_turn.reshape(-1, 3), -shift.ravel(), rcond=None)[0]
        turn = Rotation.from_rotvec(step).as_matrix() @ turn
        if np.abs(step).max() < SETTLED:
            break
    shift, by_turn, by_direction = _shift(second.model, ray @ turn.T, px[good])
    roots = _root(first, second, ray, turn, by_direction)
    if rotate:
        q = np.linalg.qr(by_turn.reshape(-1, 3))[0]
        roots = roots - q @ (q.T @ roots)
    left, singular, _ = np.linalg.svd(roots, full_matrices=False)
    rank = int((singular > RANK * singular.max(initial=0.0)).sum()) if roots.size else 0
    rank = min(rank, max(len(first.names), len(second.names)))  # what one lens can differ in; the rest is of second order
    statistic = float((((left[:, :rank].T @ shift.ravel()) / singular[:rank]) ** 2).sum())
    known = _dof(first, second, roots)
    p = float(stats.f.sf(statistic / rank, rank, known) if np.isfinite(known) else stats.chi2.sf(statistic, rank)) if rank else float("nan")
    shifts, u_shifts = np.full((rows * cols, 2), np.nan), np.full((rows * cols, 2), np.nan)
    shifts[good], u_shifts[good] = shift, np.sqrt((roots**2).sum(axis=1)).reshape(-1, 2)
    return Difference(
        x, y, shifts.reshape(rows, cols, 2), u_shifts.reshape(rows, cols, 2), turn,
        rms_px=float(np.sqrt((shift**2).sum(axis=1).mean())),
        expected_rms_px=float(np.sqrt((u_shifts[good] ** 2).sum(axis=1).mean())),
        chi2=statistic, dof=rank, p=p,
    )  # fmt: skip


def _shift(model: CameraModel, ray: Array, px: Array) -> tuple[Array, Array, Array]:
    """Pixels of rays less given ones, with their derivatives by a small rotation of the rays, and by (u, v)."""
    u, v = ray[:, 0] / ray[:, 2], ray[:, 1] / ray[:, 2]
    x, y, by_direction, _ = model.projected(u, v)
    turned = np.stack([np.stack([-u * v, 1 + u * u, -v], axis=1), np.stack([-(1 + v * v), u * v, u], axis=1)], axis=1)
    return np.stack([x, y], axis=1) - px, by_direction @ turned, by_direction


def _root(first: CalibratedCamera, second: CalibratedCamera, ray: Array, turn: Array, by_direction: Array) -> Array:
    """L of the covariance L Lᵀ of the shifts, by the parameters of both calibrations, shape (2 n, k + k')."""
    _, _, own, by_own = first.model.projected(ray[:, 0], ray[:, 1])
    turned = ray @ turn.T
    w = turned / turned[:, 2:]
    # d(u', v')/d(u, v) of the rotated direction
    across = (turn[None, :2, :2] - w[:, :2, None] * turn[None, 2:, :2]) / turned[:, 2, None, None]
    by_first = by_direction @ across @ (-_inverse(own) @ by_own[:, :, first._places])
    by_second = second.model.projected(w[:, 0], w[:, 1])[3][:, :, second._places]
    parts = [(by_first, first.covariance), (by_second, second.covariance)]
    return np.hstack([slopes.reshape(2 * len(ray), -1) @ _factor(covariance) for slopes, covariance in parts])


def _dof(first: CalibratedCamera, second: CalibratedCamera, roots: Array) -> float:
    """Degrees of freedom of both covariances together, by their shares in the variance of the shifts (Satterthwaite)."""
    k = len(first.names)
    own, other = float((roots[:, :k] ** 2).sum()), float((roots[:, k:] ** 2).sum())
    doubt = own**2 / first.dof + other**2 / second.dof
    return (own + other) ** 2 / doubt if doubt > 0 else np.inf


def _factor(covariance: Array) -> Array:
    """A with A Aᵀ the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    factor: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return factor


def pack_state(adjustment: Adjustment) -> tuple[tuple[str, ...], Array]:
    """All unknowns of an adjustment in the order of ``free_columns`` and ``covariance``, as one vector; rotations are 0.

    Points that no scale bar joins are not among them: they and their covariances are ``state.xyz`` and ``point_covariance``.
    """
    network, state = adjustment.network, adjustment.state
    of: dict[str, float] = {}
    for k, camera in enumerate(network.cameras):
        of |= {f"{camera.name}:{name}": float(value) for name, value in zip(NAMES, state.interior[k], strict=True)}
    for i, image in enumerate(network.images):
        of |= {f"{image}:{name}": 0.0 for name in ("rx", "ry", "rz")}
        of |= {f"{image}:{name}": float(value) for name, value in zip(("X0", "Y0", "Z0"), state.position[i], strict=True)}
        of |= {f"{image}:x_scale": float(state.x_scale[i]), f"{image}:x_shift": float(state.x_shift_px[i])}
    for j, point in enumerate(network.points):
        of |= {f"{point}:{axis}": float(value) for axis, value in zip("XYZ", state.xyz[j], strict=True)}
    return adjustment.free_columns, np.array([of[name] for name in adjustment.free_columns])


def unpack_state(adjustment: Adjustment, values: Array) -> State:
    """The state of a vector as of `pack_state`; rotations in it turn those of the adjustment about the axes of the camera."""
    from scipy.spatial.transform import Rotation

    network, state = adjustment.network, adjustment.state
    new = {name: float(value) for name, value in zip(adjustment.free_columns, values, strict=True)}
    interior, rotation, position = state.interior.copy(), state.rotation.copy(), state.position.copy()
    x_scale, x_shift, xyz = state.x_scale.copy(), state.x_shift_px.copy(), state.xyz.copy()

    def put(to: Any, place: Any, name: str) -> None:
        if name in new:
            to[place] = new[name]

    for k, camera in enumerate(network.cameras):
        for place, name in enumerate(NAMES):
            put(interior, (k, place), f"{camera.name}:{name}")
    for i, image in enumerate(network.images):
        turn = [new.get(f"{image}:{name}", 0.0) for name in ("rx", "ry", "rz")]
        if any(turn):
            rotation[i] = Rotation.from_rotvec(turn).as_matrix() @ rotation[i]
        for place, name in enumerate(("X0", "Y0", "Z0")):
            put(position, (i, place), f"{image}:{name}")
        put(x_scale, i, f"{image}:x_scale")
        put(x_shift, i, f"{image}:x_shift")
    for j, point in enumerate(network.points):
        for place, axis in enumerate("XYZ"):
            put(xyz, (j, place), f"{point}:{axis}")
    return State(interior, rotation, position, x_scale, x_shift, xyz)
