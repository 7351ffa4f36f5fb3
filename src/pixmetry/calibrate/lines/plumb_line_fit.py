"""The adjustment behind plumb-line calibration: conditions with observations and parameters, two parameters eliminated for every line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.calibrate.bundle._model_kernels import IMAGE_TO_OBJECT, Lens, directions
from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.errors import InputError, MeasureError

ALARM = 1e-3  # chance that a table without gross errors loses a position
STEPS, PASSES = 50, 20
SINGULAR = 1e-13  # reciprocal condition of the scaled normal equations below which nothing is known
ONE_DIRECTION, ALONG_AXIS = 0.95, 0.97  # mean of e^(2iθ) of lines within some 13° of each other; cosine of the angle to an axis


class LineTable:
    """Positions, sorted out by lines."""

    def __init__(self, x: np.ndarray, y: np.ndarray, keys: list[tuple[Any, Any]], line_of: np.ndarray, covariance: np.ndarray) -> None:
        self.x, self.y, self.keys, self.line_of, self.covariance = x, y, keys, line_of, covariance
        self.inside = np.ones(len(x), bool)  # of the frame: what lies outside of it never takes part, where the polynomial means nothing
        self.used = self.inside.copy()

    @classmethod
    def of(cls, x_px: ArrayLike, y_px: ArrayLike, line: ArrayLike, image: ArrayLike, u_px: ArrayLike | None) -> LineTable:
        x, y = (np.asarray(v, float).ravel() for v in (x_px, y_px))
        labels = [np.asarray(v).ravel().tolist() for v in (image, line)]
        if not (len(x) == len(y) == len(labels[0]) == len(labels[1])):
            sizes = (len(x), len(y), len(labels[1]), len(labels[0]))
            raise InputError("x_px, y_px, line and image differ in length", where="plumb lines", value=sizes)
        if not (np.isfinite(x) & np.isfinite(y)).all():
            raise InputError("a position is not finite", where="plumb lines", remedy="leave out what was not measured")
        pairs = list(zip(*labels, strict=True))
        keys = list(dict.fromkeys(pairs))
        at = {key: i for i, key in enumerate(keys)}
        line_of = np.array([at[pair] for pair in pairs], np.int64)
        few = [key for key, n in zip(keys, np.bincount(line_of, minlength=len(keys)), strict=True) if n < 3]
        if not keys or few:
            remedy = "measure more positions, or leave the line out"
            raise InputError("a line has fewer than three positions", where="plumb lines", value=few[:3] or None, remedy=remedy)
        return cls(x, y, keys, line_of, _covariances(u_px, len(x)))

    def keep_inside(self, inside: np.ndarray) -> None:
        """Say which positions lie in the frame; raises where a line has fewer than three of them."""
        self.inside[:] = self.used[:] = inside
        self.check_lines()

    def check_lines(self) -> None:
        """Refuse a line of which fewer than three positions are used."""
        few = self.sums(self.used.astype(float)) < 3
        if few.any():
            image, line = self.keys[int(np.argmax(few))]
            remedy = "leave it out, or measure it again"
            raise MeasureError("almost no position lies on the line", where=f"image {image}, line {line}", remedy=remedy)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sum over each line, shape (lines,)."""
        return np.bincount(self.line_of, values, len(self.keys))


def _covariances(u_px: ArrayLike | None, n: int) -> np.ndarray:
    u = np.asarray(1.0 if u_px is None else u_px, float)
    if u.shape == (n, 3):
        found = u.copy()
    elif u.shape in ((), (n,)):
        found = np.zeros((n, 3))
        found[:, 0] = found[:, 2] = u**2
    else:
        raise InputError("uncertainties of another shape", where="u_px", value=u.shape, allowed=f"a number, ({n},) or ({n}, 3)")
    if not (np.isfinite(found).all() and (found[:, [0, 2]] > 0).all() and (found[:, 0] * found[:, 2] > found[:, 1] ** 2).all()):
        raise InputError("not standard uncertainties", where="u_px", allowed="finite, above 0")
    return found


class LineFit:
    """Gauss–Newton on the conditions, the two parameters of every line eliminated."""

    def __init__(self, table: LineTable, model: CameraModel, free: tuple[str, ...]) -> None:
        self.table, self.names, self.per_px = table, list(free), model.sensor.per_px
        self.columns = [NAMES.index(name) for name in free]
        self.q = model.values.copy()
        self.factor = np.ones(len(table.x))  # of a robust loss
        self.scale = np.ones(2)  # of the standard deviations along x and y
        self.iterations = 0
        self.x, self.y = table.x.copy(), table.y.copy()  # adjusted: the places on the lines that belong to what was measured
        a, b, _ = self.corrected()
        used = table.used.astype(float)
        n = table.sums(used)
        da, db = (used * (v - (table.sums(used * v) / n)[table.line_of]) for v in (a, b))
        along = 0.5 * np.arctan2(2 * table.sums(da * db), table.sums(da * da) - table.sums(db * db))
        theta = along + np.pi / 2
        flip = np.where(np.abs(np.cos(theta)) >= np.abs(np.sin(theta)), np.cos(theta), np.sin(theta)) < 0
        self.theta = theta + np.pi * flip  # the normal points towards +x, or +y
        self.rho = (np.cos(self.theta) * table.sums(used * a) + np.sin(self.theta) * table.sums(used * b)) / n

    def corrected(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corrected adjusted positions about the centre, and their derivatives by those in the image, shape (n, 2, 2)."""
        q = self.q.copy()
        q[0] = 1.0
        return directions(self.x, self.y, Lens(q, IMAGE_TO_OBJECT, *self.per_px))

    def by_parameter(self, slopes: np.ndarray) -> np.ndarray:
        """Derivatives of the corrected positions by the free parameters, shape (n, 2, p)."""
        a, b = ((v - o) * m for v, o, m in zip((self.x, self.y), self.q[1:3], self.per_px, strict=True))
        r2, zero = a * a + b * b, np.zeros_like(a)
        known: dict[str, Any] = {
            "xp": -slopes[:, :, 0].T,
            "yp": -slopes[:, :, 1].T,
            "b1": (a, zero),
            "b2": (b, zero),
            "p1": (r2 + 2 * a * a, 2 * a * b),
            "p2": (2 * a * b, r2 + 2 * b * b),
        }
        known |= {f"k{k}": (a * r2**k, b * r2**k) for k in range(1, 6)}
        return np.stack([np.stack(known[name], axis=1) for name in self.names], axis=2)

    def linear(self) -> None:
        """Conditions at the adjusted positions, their weights, and what the lines leave of them and of the parameters' columns."""
        a, b, slopes = self.corrected()
        c, s = np.cos(self.theta)[self.table.line_of], np.sin(self.theta)[self.table.line_of]
        self.along = -s * a + c * b
        bx, by = c * slopes[:, 0, 0] + s * slopes[:, 1, 0], c * slopes[:, 0, 1] + s * slopes[:, 1, 1]
        f = c * a + s * b - self.rho[self.table.line_of] + bx * (self.table.x - self.x) + by * (self.table.y - self.y)
        sx, sy = self.scale
        cov = self.table.covariance
        self.per_px_across = np.hypot(bx, by)
        self.per_unit_across = np.hypot(bx / self.per_px[0], by / self.per_px[1])
        pull_x, pull_y = sx * (sx * bx * cov[:, 0] + sy * by * cov[:, 1]), sy * (sx * bx * cov[:, 1] + sy * by * cov[:, 2])
        self.variance = bx * pull_x + by * pull_y
        self.pull = pull_x / self.variance, pull_y / self.variance  # from a condition to its residuals in x and y
        self.weight = np.where(self.table.used, self.factor, 0.0) / self.variance
        total = self.table.sums(self.weight)
        self.middle = self.table.sums(self.weight * self.along) / total
        self.t = self.along - self.middle[self.table.line_of]
        self.moment = self.table.sums(self.weight * self.t**2)
        self.total = total
        columns = np.einsum("ni,nip->np", np.stack([c, s], axis=1), self.by_parameter(slopes))
        self.f_left, self.f_mean, self.f_slope = self._eliminated(f)
        self.columns_whole = columns
        parts = [self._eliminated(column) for column in columns.T]
        self.a_left = np.stack([p[0] for p in parts], axis=1)
        self.a_mean, self.a_slope = np.stack([p[1] for p in parts], axis=1), np.stack([p[2] for p in parts], axis=1)
        self.normal = self.a_left.T @ (self.weight[:, None] * self.a_left)

    def _eliminated(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        mean = self.table.sums(self.weight * z) / self.total
        slope = self.table.sums(self.weight * self.t * z) / self.moment
        return z - mean[self.table.line_of] - slope[self.table.line_of] * self.t, mean, slope

    def inverse(self) -> Array:
        """Inverse of the normal equations; raises where they are singular."""
        size = np.sqrt(np.diag(self.normal))
        if not (np.isfinite(self.normal).all() and (size > 0).all()):
            refuse(self.weakest())
        values, vectors = np.linalg.eigh(self.normal / np.outer(size, size))
        if values[0] < SINGULAR * values[-1]:
            refuse([name for name, v in zip(self.names, vectors[:, 0], strict=True) if abs(v) > 0.3])
        inverse: Array = (vectors / values @ vectors.T) / np.outer(size, size)
        return inverse

    def weakest(self) -> list[str]:
        """The parameter of whose effect the least is left when the lines are eliminated."""
        whole = np.nansum(self.columns_whole**2, axis=0)
        left = np.nansum(self.a_left**2, axis=0)
        return [self.names[int(np.argmin(left / np.maximum(whole, 1e-300)))]]

    def solve(self) -> None:
        """Iterate until the conditions converge."""
        cost = np.inf
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # where the lines do not tell; that is said below
            for _ in range(STEPS):
                self.linear()
                self.iterations += 1
                before, cost = cost, self._step()
                if abs(before - cost) <= 1e-12 * cost + 1e-300:
                    break
            self.linear()

    def _step(self) -> float:
        """One step of Gauss and Newton; returns the sum of squares that it promises."""
        step = -self.inverse() @ (self.a_left.T @ (self.weight * self.f_left))
        turn = -(self.f_slope + self.a_slope @ step)
        self.q[self.columns] += step
        self.theta += turn
        self.rho += self.f_mean + self.a_mean @ step + self.middle * turn
        left = self.f_left + self.a_left @ step
        left_inside = np.where(self.table.inside, left, 0.0)  # outside there is no place on the line to adjust to
        self.x, self.y = self.table.x - self.pull[0] * left_inside, self.table.y - self.pull[1] * left_inside
        if not np.isfinite(self.corrected()[0]).all():
            refuse(self.weakest())
        return float(self.weight @ left**2)

    def leverage(self) -> Array:
        """Leverage of each position: share of its variance that the fit absorbs, with the weight of a used position; shape (n,)."""
        inverse, line = self.inverse(), self.table.line_of
        own = 1.0 / self.variance
        of_parameters = np.einsum("np,pq,nq->n", self.a_left, inverse, self.a_left)
        share: Array = own * (1 / self.total[line] + self.t**2 / self.moment[line] + of_parameters)
        return share

    def statistics(self) -> Array:
        """Residuals over their standard deviations; of those left out, over that of their prediction."""
        h = self.leverage()
        q = np.where(self.table.used, np.maximum(1 - h, 1e-9), 1 + h)
        statistic: Array = self.f_left / np.sqrt(self.variance * q)
        return statistic

    def axis_of_line(self) -> Ints:
        """0 for lines that determine x, 1 for those that determine y."""
        steep: Flags = np.abs(np.cos(self.theta)) < np.abs(np.sin(self.theta))
        return steep.astype(np.int64)

    def rescale(self, robust: bool = False) -> float:
        """Bring the variances along x and y to the residuals' level; returns by how much they changed."""
        axis, ratio = self.axis_of_line()[self.table.line_of], np.ones(2)
        h, used = self.leverage(), self.table.used
        for k in (0, 1):
            mine = used & (axis == k)
            if not mine.any():
                continue
            z = self.f_left[mine] / np.sqrt(self.variance[mine])
            dof = np.sum(1 - h[mine])
            ratio[k] = 1.4826 * np.median(np.abs(z)) * np.sqrt(mine.sum() / dof) if robust else np.sqrt(z @ z / dof)
        only = np.unique(axis[used])
        if len(only) == 1:
            ratio[:] = ratio[only[0]]
        ratio = np.maximum(ratio, 1e-12)
        self.scale *= ratio
        return float(np.abs(np.log(ratio)).max())


def adjust_lines(fit: LineFit, loss: str, loss_scale: float, reject: bool) -> None:
    """Robust first pass, then least squares with variance components and data snooping."""
    _check_directions(fit.theta, fit.names)
    if loss != "none":
        _robust(fit, loss, loss_scale)
    fit.table.used[:] = fit.table.inside
    if reject and loss != "none":
        fit.table.used[:] = fit.table.inside & (np.abs(fit.statistics()) < critical_value(len(fit.table.x)))
        fit.table.check_lines()
    fit.factor[:] = 1.0
    _snoop(fit, reject)


def _check_directions(theta: np.ndarray, free: list[str]) -> None:
    """Refuse the tangential parameter that lines of one direction do not determine: it moves points along these lines."""
    mean = np.mean(np.exp(2j * theta))
    if abs(mean) < ONE_DIRECTION:
        return
    normal = np.angle(mean) / 2
    told = {"p1"} if abs(np.cos(normal)) > ALONG_AXIS else {"p2"} if abs(np.sin(normal)) > ALONG_AXIS else set()
    lost = [name for name in ("p1", "p2") if name in free and name not in told]
    if lost:
        refuse(lost)


def refuse(names: Sequence[str]) -> None:
    """Say which parameters the lines do not determine."""
    raise MeasureError(
        "the lines do not determine the parameters",
        where="plumb lines",
        value=", ".join(names),
        remedy="combine lines along x and along y all over the frame, free fewer parameters, or use a test field (for b1, b2)",
    )


def critical_value(n: int) -> float:
    from scipy.stats import norm

    return float(norm.isf(ALARM / (2 * n)))


def _robust(fit: LineFit, loss: str, loss_scale: float) -> None:
    for _ in range(PASSES):
        fit.solve()
        changed = fit.rescale(robust=True)
        fit.linear()
        z = np.abs(fit.f_left) / np.sqrt(fit.variance) / loss_scale
        fit.factor = 1 / np.maximum(z, 1.0) if loss == "huber" else 1 / (1 + z**2)
        if changed < 1e-3:
            break
    fit.solve()


def _snoop(fit: LineFit, reject: bool) -> None:
    """Least squares with variance components; the worst position of each line leaves until none is beyond the critical value."""
    table, critical = fit.table, critical_value(len(fit.table.x))
    for turn in range(PASSES):
        for _ in range(PASSES):
            fit.solve()
            if fit.rescale() < 1e-6:
                break
        fit.linear()
        if not reject:
            return
        z = np.abs(fit.statistics())
        back = ~table.used & table.inside & (z < critical) & (turn < PASSES // 2)
        worst = np.zeros(len(table.keys))
        np.maximum.at(worst, table.line_of[table.used], z[table.used])
        out = table.used & (z > critical) & (z == worst[table.line_of])
        if not (back | out).any():
            return
        table.used[:] = (table.used | back) & ~out
        table.check_lines()
    fit.solve()
