"""Start values in the making: images posed one after the other, points intersected, and small adjustments in between."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, TEN
from pixmetry.calibrate.bundle.network import Network, ScaleBars, State
from pixmetry.calibrate.start.resection import FEWEST, RIGHT_SHARE, intersect, pose, rays
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import MeasureError

COARSE = 0.03  # of the frame's width: what may count as the same place while neither principal distance nor distortion are known
FINE = 0.008  # the same once they are: of distortion that a radial term does not hold
SMALLEST_PX = 0.02  # residuals are not taken for smaller than this
WRONG = 30.0  # residuals beyond so many of their spreads (and FINE) take no part until the next round
CENTRED = ("c", "k1", "k2", "xp", "yp")
BY_IMAGES = (  # what may be free with so many images and image points of them
    (5, 40, ("c",)), (3, 90, ("c",)), (6, 60, ("c", "k1")), (4, 140, ("c", "k1")), (7, 240, CENTRED), (5, 300, CENTRED), (7, 350, TEN),
)  # fmt: skip
BY_KNOWN = ((1, 16, ("c",)), (1, 40, ("c", "k1")), (2, 100, CENTRED), (5, 240, TEN))  # the same with known points
MANY_IMAGES = 24  # that determine the interior parameters well enough to go on with
NEARLY_ALL = 1.1  # times the images of the last adjustment that may have a pose without another one
MOST, QUANTILE = 0.93, 1.81  # share of the residuals that are taken for right, and the normal distribution's quantile of it
PULLING = 0.001  # of the frame's width: largest scale of residuals that comes from those beyond the median
OUTSTANDING = 8.0  # median residual of an image, in spreads, at which its pose is doubted
MENDING = 2  # rounds of posing anew
SETTLING, SETTLED_PX = 5, 0.2  # rounds of adjustment while residuals are larger
FARTHEST = 0.25  # of the frame: how far a principal point may move off its middle
PLAUSIBLE = (0.15, 60.0)  # principal distances, in widths of the frame


class Reconstruction:
    """Poses and points of a network, as far as they are known yet (NaN: not).

    Parameters
    ----------
    network : Network
    interior : ndarray, shape (cameras, interior parameters)
    control : ndarray of bool, shape (points,)
        Points whose coordinates stand; the others are intersected.
    """

    def __init__(self, network: Network, interior: Array, control: Flags) -> None:
        self.network, self.interior, self.control = network, interior.copy(), control
        images = len(network.images)
        self.rotation, self.position = np.full((images, 3, 3), np.nan), np.full((images, 3), np.nan)
        self.xyz = np.where(control[:, None], network.xyz, np.nan)
        self.good = np.isfinite(network.x_px) & np.isfinite(network.y_px)
        order = np.argsort(network.image, kind="stable")
        self.rows = np.split(order, np.searchsorted(network.image[order], np.arange(1, images)))
        self.camera = network.camera_of[network.image]
        self.width = float(max(camera.sensor.cols for camera in network.cameras))
        self.spread_px = self.scale_px = COARSE * self.width / 8
        self.allowed = np.ones(images, bool)  # which images are posed
        self.adjusted = 0  # images that had a pose when it was last adjusted
        self.look()

    def copy(self) -> Reconstruction:
        """One that can go its own way."""
        new = object.__new__(Reconstruction)
        new.__dict__.update(self.__dict__)
        for name in ("interior", "rotation", "position", "xyz", "good", "uv", "allowed"):
            setattr(new, name, getattr(self, name).copy())
        return new

    @property
    def posed(self) -> Flags:
        """Which images have a pose."""
        posed: Flags = np.isfinite(self.position[:, 0])
        return posed

    def c_px(self, camera: int) -> float:
        """Principal distance of a camera, px."""
        return float(self.interior[camera, 0] / self.network.cameras[camera].sensor.per_px[0])

    def look(self) -> None:
        """Directions of all image points by the present interior parameters."""
        self.uv = np.full((len(self.network), 2), np.nan)
        for k, camera in enumerate(self.network.cameras):
            rows = np.flatnonzero(self.camera == k)
            if self.interior[k, 0] > 0:
                model = replace(camera, values=self.interior[k])
                self.uv[rows] = np.column_stack(model.direction_of(self.network.x_px[rows], self.network.y_px[rows]))

    def tolerance_px(self) -> float:
        """Error beyond which an image point is taken for wrong at present."""
        return min(COARSE * self.width, max(10 * self.spread_px, FINE * self.width))

    def resect(self, image: int, fewest: int = FEWEST) -> float:
        """Pose an image from the points that are known; its mean squared error as in `pose` (in px²), infinite if it fails."""
        rows = self.rows[image]
        rows = rows[np.isfinite(self.xyz[self.network.point[rows], 0]) & np.isfinite(self.uv[rows, 0])]
        c_px = self.c_px(self.network.camera_of[image])
        found = pose(self.uv[rows], self.xyz[self.network.point[rows]], self.tolerance_px() / c_px) if len(rows) >= fewest else None
        if found is None or found.fits.sum() < fewest:
            return np.inf
        self.rotation[image], self.position[image] = found.rotation, found.position
        self.good[rows] = found.fits
        return found.cost * c_px**2

    def triangulate(self, tolerance: float | None = None) -> None:
        """Intersect all points that do not stand, and judge their rays; they may miss each other by ``tolerance`` (rad)."""
        free = ~self.control[self.network.point]
        image = self.network.image[free]
        ray = rays(self.uv[free], self.rotation[image])
        if tolerance is None:
            tolerance = self.tolerance_px() / 3 / min(self.c_px(k) for k in np.unique(self.camera) if self.interior[k, 0] > 0)
        xyz, fits = intersect(self.position[image], ray, self.network.point[free], len(self.xyz), tolerance)
        self.xyz = np.where(self.control[:, None], self.xyz, xyz)
        posed = self.posed[image]
        self.good[np.flatnonzero(free)[posed]] = fits[posed]

    def residuals(self) -> np.ndarray:
        """Measured less computed, px, shape (n, 2); NaN where image or point are not known."""
        away = self.xyz[self.network.point] - self.position[self.network.image]
        camera = np.einsum("nij,nj->ni", self.rotation[self.network.image], away)
        out = np.full((len(self.network), 2), np.nan)
        with np.errstate(all="ignore"):
            u, v = camera[:, 0] / camera[:, 2], camera[:, 1] / camera[:, 2]
        for k, model in enumerate(self.network.cameras):
            rows = np.flatnonzero((self.camera == k) & (camera[:, 2] > 0))
            x, y = replace(model, values=self.interior[k]).project(u[rows], v[rows])
            out[rows] = np.column_stack([self.network.x_px[rows] - x, self.network.y_px[rows] - y])
        return out

    def judge(self) -> None:
        """Spread of the residuals, and which image points stand."""
        error = self.residuals()
        known = self.posed[self.network.image] & np.isfinite(self.xyz[self.network.point, 0])
        size = np.abs(error[known & self.good])
        if len(size):
            self.spread_px = max(SMALLEST_PX, 1.4826 * float(np.nanmedian(size)))
            # parts that do not fit each other yet are many small groups of large residuals: they must go on pulling
            rest = float(np.quantile(np.nan_to_num(np.abs(error[known]), nan=self.width), MOST))
            self.scale_px = max(self.spread_px, min(rest / QUANTILE, PULLING * self.width))
        misfit = self.scale_px > 3 * self.spread_px
        limit = max(WRONG * self.spread_px, COARSE * self.width if misfit else FINE * self.width / 2)
        with np.errstate(invalid="ignore"):
            self.good[known] = np.max(np.abs(error[known]), axis=1) < limit  # NaN: behind the camera, or beyond the lens

    def cost(self, images: np.ndarray) -> float:
        """Mean of min(residual, FINE)², px², over the image points of some images; those without pose or point count as wrong.

        Points that no second image sees say nothing.
        """
        squares = self._squares(images)
        return float(np.mean(squares)) if len(squares) else (FINE * self.width) ** 2

    def least_cost(self, done: np.ndarray, images: np.ndarray) -> float:
        """What `cost` of ``images`` is at least, when those ``done`` of them have their poses."""
        return float(np.sum(self._squares(done))) / max(1, int(np.isin(self.network.image, images).sum()))

    def _squares(self, images: np.ndarray) -> Array:
        worst = FINE * self.width
        mine = np.isin(self.network.image, images)
        often = np.bincount(self.network.point[mine & self.posed[self.network.image]], minlength=len(self.xyz)) >= 2
        error = np.hypot(*self.residuals()[mine & (often | self.control)[self.network.point]].T)
        squares: Array = np.minimum(np.where(np.isnan(error), worst, error), worst) ** 2
        return squares

    def fits(self, images: np.ndarray, share: float) -> bool:
        """Whether the root of `cost` is below a share of FINE."""
        return bool(len(images) and np.sqrt(self.cost(images)) < share * FINE * self.width)

    def adjust(self, rounds: int = 2, iterations: int = 8) -> None:
        """Bundle adjustment of what is known, with as many interior parameters free as the images carry."""
        for _ in range(rounds):
            before = self.spread_px
            rows = self._rows()
            if len(rows) == 0:
                return
            for names in self._free_names(rows):
                if self._adjust_once(rows, names, iterations):
                    break
            if self.spread_px > 0.7 * before:
                return

    def _rows(self) -> np.ndarray:
        """Image points that take part in an adjustment."""
        there = self.good & self.posed[self.network.image]
        rays_of = np.bincount(self.network.point[there], minlength=len(self.xyz))
        known = np.isfinite(self.xyz[:, 0]) & (self.control | (rays_of >= 2))
        return np.flatnonzero(there & known[self.network.point])

    def _free_names(self, rows: np.ndarray) -> list[tuple[str, ...]]:
        """Sets of interior parameters that may be free, the largest first; the worst supplied camera decides."""
        stages = BY_KNOWN if self.control.sum() > 3 else BY_IMAGES
        cameras = np.unique(self.camera[rows])
        images = min(len(np.unique(self.network.image[rows[self.camera[rows] == k]])) for k in cameras)
        points = min(np.count_nonzero(self.camera[rows] == k) for k in cameras)
        return [names for enough, many, names in reversed(stages) if images >= enough and points >= many] + [()]

    def _adjust_once(self, rows: np.ndarray, names: tuple[str, ...], iterations: int) -> bool:
        from pixmetry.calibrate.bundle.bundle import adjust

        images, image = np.unique(self.network.image[rows], return_inverse=True)
        points, point = np.unique(self.network.point[rows], return_inverse=True)
        cameras, camera_of = np.unique(self.network.camera_of[images], return_inverse=True)
        models = tuple(replace(self.network.cameras[k], free=self.network.cameras[k].free & np.isin(NAMES, names)) for k in cameras)
        control = self.control[points][:, None]
        variance = self.scale_px**2
        part = replace(
            self.network, cameras=models, images=tuple(self.network.images[i] for i in images), camera_of=camera_of,
            points=tuple(self.network.points[j] for j in points), x_px=self.network.x_px[rows], y_px=self.network.y_px[rows],
            image=image, point=point, covariance_px2=np.tile([variance, 0.0, variance], (len(rows), 1)),
            xyz=np.where(control, self.network.xyz[points], np.nan), u_xyz=np.where(control, self.network.u_xyz[points], np.inf),
            bars=ScaleBars.none(), per_image=(), time_s=None, diameter=None, normal=None, poses=None, instant=None,
        )  # fmt: skip
        zero = np.zeros(len(images))
        start = State(self.interior[cameras], self.rotation[images], self.position[images], zero, zero, self.xyz[points])
        try:
            result = adjust(part, start, loss="cauchy", covariance=False, max_iterations=iterations).state
        except (MeasureError, np.linalg.LinAlgError):
            return False  # not determined yet, or not with so many parameters
        if not self._plausible(cameras, result):
            return False
        kept = self.copy()
        self.interior[cameras], self.rotation[images], self.position[images] = result.interior, result.rotation, result.position
        self.xyz[points] = result.xyz
        self.look()
        self.judge()
        if self.spread_px > 1.2 * kept.spread_px:
            self.__dict__.update(kept.__dict__)
            return False
        return True

    def _plausible(self, cameras: np.ndarray, state: State) -> bool:
        posed = state.posed  # an image that its points do not determine loses its pose, no more
        if posed.sum() < min(2, len(posed)) or not (np.isfinite(state.interior).all() and np.isfinite(state.rotation[posed]).all()):
            return False
        for k, values in zip(cameras, state.interior, strict=True):
            sensor = self.network.cameras[k].sensor
            c = values[0] / sensor.per_px[0] / sensor.cols
            off = np.abs(values[1:3] - sensor.centre) / (sensor.cols, sensor.rows)
            if not (PLAUSIBLE[0] < c < PLAUSIBLE[1] and (off < FARTHEST).all()):
                return False
        return True

    def grow(self, limit: int | None = None) -> None:
        """Pose image after image, those with the most known points first, until no more can be or ``limit`` have a pose."""
        limit = len(self.posed) if limit is None else limit
        for fewest in (8, 6, 5, FEWEST):
            failed: set[int] = set()
            while self.posed.sum() < limit:
                if self._add(fewest, limit, failed):
                    self.triangulate()
                    self.judge()
                    if self.posed.sum() >= self._next_adjustment() or self.posed.sum() <= 6:
                        self._adjust_and_judge()
                elif failed and self.adjusted < self.posed.sum():
                    self._adjust_and_judge()
                    failed = set()
                else:
                    break
        if self.adjusted * NEARLY_ALL < self.posed.sum():
            self._adjust_and_judge()

    def mend(self) -> None:
        """Pose images anew in which many points do not fit, once the others stand: in a long lens a pose can be the mirrored one."""
        for _ in range(MENDING):
            known = self.posed[self.network.image] & np.isfinite(self.uv[:, 0])
            number = np.bincount(self.network.image[known], minlength=len(self.posed))
            fitting = np.bincount(self.network.image[known & self.good], minlength=len(self.posed))
            poor = self.posed & ((fitting < RIGHT_SHARE * number) | (self.typical_errors() > OUTSTANDING * self.spread_px))
            if not poor.any() or poor.sum() > 0.5 * self.posed.sum():
                return
            self.rotation[poor], self.position[poor] = np.nan, np.nan
            self.good[poor[self.network.image]] = True
            self.adjusted = 0
            self.triangulate()
            self.judge()
            self.grow()

    def typical_errors(self) -> np.ndarray:
        """Median residual of each image, px."""
        error = np.hypot(*self.residuals().T)
        inside = [error[rows][np.isfinite(error[rows])] for rows in self.rows]
        return np.array([np.median(values) if len(values) else 0.0 for values in inside])

    def settle(self) -> None:
        """Adjust on while residuals fall: long lenses and shallow networks come down slowly."""
        for _ in range(SETTLING):
            before = self.spread_px
            if before < SETTLED_PX:
                return
            self.adjust(rounds=1, iterations=40)
            self.triangulate()
            self.judge()
            if self.spread_px > 0.95 * before:
                return

    def _next_adjustment(self) -> float:
        """Number of images at which to adjust again: seldom once there are enough of them for the interior parameters."""
        return (1.4 if self.adjusted < MANY_IMAGES else 3.0) * self.adjusted

    def _adjust_and_judge(self) -> None:
        many = self.posed.sum() > 2 * MANY_IMAGES
        self.adjust(rounds=1 if many else 2, iterations=5 if many else 8)
        self.triangulate()
        self.judge()
        self.adjusted = int(self.posed.sum())

    def _add(self, fewest: int, limit: int, failed: set[int]) -> int:
        """Pose the images that see most of the known points; how many could be."""
        known = np.isfinite(self.xyz[self.network.point, 0]) & np.isfinite(self.uv[:, 0])
        count = np.bincount(self.network.image[known], minlength=len(self.posed))
        count[self.posed | ~self.allowed] = 0
        count[list(failed)] = 0
        count[self.interior[self.network.camera_of, 0] <= 0] = 0
        order = [int(i) for i in np.argsort(-count, kind="stable") if count[i] >= max(fewest, 0.5 * count.max())]
        new = 0
        for image in order[: max(1, min(limit, 2 * self.posed.sum()) - self.posed.sum())]:
            if np.isfinite(self.resect(image, fewest)):
                new += 1
            else:
                failed.add(image)
        return new

    def state(self) -> State:
        """All that is known; of the points, those that two rays agree on."""
        rays_of = np.bincount(self.network.point[self.good & self.posed[self.network.image]], minlength=len(self.xyz))
        self.xyz[~self.control & (rays_of < 2)] = np.nan
        zero = np.zeros(len(self.posed))
        return State(self.interior, self.rotation, self.position, zero, zero.copy(), self.xyz)
