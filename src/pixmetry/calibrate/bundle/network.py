"""What a bundle adjustment takes (image coordinates, points, scale bars, cameras) and gives (all unknowns with their covariance)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.core.arrays import Array, Flags, Ints

SCALE, SHIFT = 6, 7  # places of the per-image x-scale and x-shift behind the six of the pose
PER_IMAGE = 8
PER_IMAGE_NAMES = ("x_scale", "x_shift")


@dataclass(frozen=True)
class ScaleBars:
    """Known distances between points.

    Parameters
    ----------
    start, end : ndarray of int, shape (b,)
        Indices of points.
    length, u : ndarray, shape (b,)
        In the unit of the object.
    """

    start: Ints
    end: Ints
    length: Array
    u: Array

    def __len__(self) -> int:
        return len(self.start)

    @classmethod
    def none(cls) -> ScaleBars:
        """No bar."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Poses:
    """Start values of the poses of images, as in `State`; NaN where there are none. Their frame need not be that of the points.

    Parameters
    ----------
    rotation : ndarray, shape (images, 3, 3)
    position : ndarray, shape (images, 3)
    """

    rotation: Array
    position: Array

    @property
    def given(self) -> Flags:
        """Which images have one."""
        return np.isfinite(self.position[:, 0]) & np.isfinite(self.rotation[:, 0, 0])


@dataclass(frozen=True)
class Network:
    """Everything that is known before an adjustment. Nothing in it is changed by one.

    Parameters
    ----------
    cameras : tuple of CameraModel
        Start values, and which parameters are free.
    images : tuple of str
        Names.
    camera_of : ndarray of int, shape (images,)
    points : tuple of str
        Names.
    x_px, y_px : ndarray, shape (n,)
        Measured image coordinates.
    image, point : ndarray of int, shape (n,)
        Which image, which point.
    covariance_px2 : ndarray, shape (n, 3)
        var x, cov xy, var y a priori.
    xyz : ndarray, shape (points, 3)
        Object coordinates known beforehand; NaN where there are none.
    u_xyz : ndarray, shape (points, 3)
        Their standard uncertainties: 0 is fixed, ``inf`` is free (the coordinates are start values and carry the datum).
    bars : ScaleBars
    per_image : tuple of str
        Out of ``"x_scale"`` and ``"x_shift"``: estimated for each image, by x = x₀ + (1 + s)(x_model − x₀) + d. Both have mean 0 over the
        images of a camera: what is common to them is affinity and principal point.
    scale_origin_px : float
        x₀, the column about which a frame grabber's clock stretches a line: its start.
    time_s : ndarray, shape (images,), optional
        When each image was taken.
    diameter : ndarray, shape (points,), optional
        Of circular targets, in the object's unit (NaN: none): the image coordinates are those of the centre of area of their images.
    normal : ndarray, shape (points, 3), optional
        Unit normals of the circles.
    unit : str
        Of the object.
    covariance_known : bool
        Whether ``covariance_px2`` came with the data, or is a guess (then only its ratios count).
    poses : Poses, optional
        Start values, where there are any; otherwise they are found.
    instant : ndarray of int, shape (images,), optional
        Images of one instant have one number: their cameras stand still against each other, as a rig (`pixmetry.calibrate.bundle.rig`).
        -1: of no instant.
    """

    cameras: tuple[CameraModel, ...]
    images: tuple[str, ...]
    camera_of: Ints
    points: tuple[str, ...]
    x_px: Array
    y_px: Array
    image: Ints
    point: Ints
    covariance_px2: Array
    xyz: Array
    u_xyz: Array
    bars: ScaleBars = field(default_factory=ScaleBars.none)
    per_image: tuple[str, ...] = ()
    scale_origin_px: float = 0.0
    time_s: Array | None = None
    diameter: Array | None = None
    normal: Array | None = None
    unit: str = "mm"
    covariance_known: bool = False
    poses: Poses | None = None
    instant: Ints | None = None

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def control(self) -> Flags:
        """Points of which all three coordinates are known, bool."""
        known: Flags = np.all(np.isfinite(self.xyz) & np.isfinite(self.u_xyz), axis=1)
        return known

    @property
    def given(self) -> Flags:
        """These, and points of which all three are roughly known; not those of which one or two are known: there somebody had to write
        something for the others."""
        roughly: Flags = np.all(np.isfinite(self.xyz) & np.isinf(self.u_xyz), axis=1)
        return self.control | roughly


@dataclass(frozen=True)
class State:
    """Values of all unknowns: start values of an adjustment, or its result.

    A point X is seen at R (X − X₀) in the frame of the camera, which looks along z, x to the right and y down.

    Parameters
    ----------
    interior : ndarray, shape (cameras, interior parameters)
        In the order of `pixmetry.calibrate.bundle.model.NAMES`.
    rotation : ndarray, shape (images, 3, 3)
    position : ndarray, shape (images, 3)
        X₀, the projection centres.
    x_scale, x_shift_px : ndarray, shape (images,)
    xyz : ndarray, shape (points, 3)
        NaN: not determined (seen too seldom); its image coordinates take no part.
    """

    interior: Array
    rotation: Array
    position: Array
    x_scale: Array
    x_shift_px: Array
    xyz: Array

    @property
    def posed(self) -> Flags:
        """Images that have a pose."""
        posed: Flags = np.all(np.isfinite(self.position), axis=1)
        return posed

    @property
    def located(self) -> Flags:
        """Points that have coordinates."""
        located: Flags = np.all(np.isfinite(self.xyz), axis=1)
        return located


@dataclass(frozen=True)
class SharedErrors:
    """Errors that image points have in common, as the residuals of an adjustment show them (`pixmetry.calibrate.bundle.shared_errors`).

    Parameters
    ----------
    kinds : tuple of (str, int)
        ``"image"``, ``"frame"``, ``"view"`` or ``"oblique"``, and the number of the camera; -1: of several cameras together.
    rms_px : ndarray, shape (kinds,)
        Of a coordinate over the image points.
    p : ndarray, shape (kinds,)
        Of an F-test against independent errors.
    variance_px2 : ndarray, shape (kinds,)
        Of the coefficients of each kind.
    white_variance : float
        Share of sigma0² (or of 1, a priori) that is left to independent errors.
    u_independent : ndarray, shape (free columns,)
        Standard uncertainties as if all errors were independent.
    dof : ndarray, shape (free columns,)
        Effective degrees of freedom of the stated uncertainties.
    found : bool
        Whether any kind is significant; else the covariances are those of independent errors.
    """

    kinds: tuple[tuple[str, int], ...]
    rms_px: Array
    p: Array
    variance_px2: Array
    white_variance: float
    u_independent: Array
    dof: Array
    found: bool


@dataclass(frozen=True)
class Adjustment:
    """Result of one bundle adjustment.

    Parameters
    ----------
    network : Network
    state : State
    used : ndarray of bool, shape (n,)
        Image coordinates that took part; the others were rejected or belong to an image or point that is not determined.
    residual_px : ndarray, shape (n, 2)
        Measured less computed, for all whose image and point are determined, else NaN.
    weight : ndarray, shape (n,)
        Factor on the weight by a robust loss; 1 in least squares.
    sigma0 : float
        A posteriori standard deviation of unit weight (of image coordinates with their a priori covariance).
    dof : int
        Redundancy: observations + constraints − unknowns.
    free_columns : tuple of str
        Names of the rows of ``covariance``: ``"camera:c"`` …; ``"image:rx"``, ``"image:ry"``, ``"image:rz"`` (rad, a small rotation about
        the camera's axes), ``"image:X0"``, ``"image:Y0"``, ``"image:Z0"``, ``"image:x_scale"``, ``"image:x_shift"``; then points that bars
        join, ``"point:X"`` ….
    covariance : ndarray, shape (m, m)
        Of these, a posteriori (sigma0² is in it unless ``a_priori`` was asked for), in the datum stated.
    point_covariance : ndarray, shape (points, 3, 3)
        In the same datum; 0 for fixed points, NaN where not determined.
    redundancy : ndarray, shape (n, 2), optional
        Redundancy numbers of x and y (0 … 1), and of
    residual_covariance_px2 : ndarray, shape (n, 3), optional
        Cofactors of the residuals (var x, cov xy, var y; for unit weight 1), which data snooping divides by. Both None unless asked for.
    datum : str
        In words: what fixes origin, directions and scale.
    iterations : int
    cost : tuple of float
        Weighted sum of squares of each iteration.
    notes : tuple of str
    shared : SharedErrors, optional
        Errors that image points have in common, and which the covariances hold then; None: not looked for.
    """

    network: Network
    state: State
    used: Flags
    residual_px: Array
    weight: Array
    sigma0: float
    dof: int
    free_columns: tuple[str, ...]
    covariance: Array
    point_covariance: Array
    redundancy: Array | None
    residual_covariance_px2: Array | None
    datum: str
    iterations: int
    cost: tuple[float, ...]
    notes: tuple[str, ...] = ()
    shared: SharedErrors | None = None

    def camera(self, index: int = 0) -> CameraModel:
        """The adjusted model of a camera."""
        from dataclasses import replace

        return replace(self.network.cameras[index], values=self.state.interior[index].copy())

    @property
    def redundancy_numbers(self) -> Array:
        """``redundancy``, of an adjustment that was asked for it; else ``ValueError``."""
        if self.redundancy is None:
            raise ValueError("an adjustment without redundancy numbers: adjust(…, redundancy=True)")
        return self.redundancy

    @property
    def residual_cofactors_px2(self) -> Array:
        """``residual_covariance_px2`` likewise."""
        if self.residual_covariance_px2 is None:
            raise ValueError("an adjustment without cofactors of its residuals: adjust(…, redundancy=True)")
        return self.residual_covariance_px2

    def interior_covariance(self, index: int = 0) -> tuple[tuple[str, ...], Array]:
        """Names of the estimated parameters of a camera and their covariance."""
        rows = self._interior_rows(index)
        return tuple(self.free_columns[i].rpartition(":")[2] for i in rows), self.covariance[np.ix_(rows, rows)]

    def interior_dof(self, index: int = 0) -> Array:
        """Degrees of freedom of the uncertainties of these parameters."""
        rows = self._interior_rows(index)
        return np.full(len(rows), float(self.dof)) if self.shared is None else self.shared.dof[rows]

    def interior_u_independent(self, index: int = 0) -> Array:
        """Their standard uncertainties as if all errors of image coordinates were independent."""
        rows = self._interior_rows(index)
        return np.sqrt(np.diag(self.covariance)[rows]) if self.shared is None else self.shared.u_independent[rows]

    def _interior_rows(self, index: int) -> list[int]:
        own = {f"{self.network.cameras[index].name}:{name}" for name in NAMES}  # an image or a point may have the camera's name
        return [i for i, name in enumerate(self.free_columns) if name in own]
