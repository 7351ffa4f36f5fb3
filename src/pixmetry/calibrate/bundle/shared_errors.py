"""Errors that image points share: how large they are by the residuals, and what they add to the uncertainty of all that was estimated.

An adjustment takes its image coordinates as independent. On real pictures their errors have parts in common: in one image (focus, motion,
a board that flexes), at one place of the frame in all images (what the camera model lacks), in images from similar directions (edges that
move with the view). They are random effects here: displacements F a with independent a of variance θ, so that image coordinates have

    V = θ₀ W⁻¹ + Σ θₖ Fₖ Fₖᵀ.

- *image*: polynomials of degree 2 of the place in the frame, with new coefficients in each image;
- *frame*: a stationary process over the frame with the covariance exp(−d²/2ℓ²), the same in all images of a camera;
- *view*: the same polynomials times those of degree 1 and 2 of the target plane's tilt, the same in all images of a camera;
- *oblique*: a shift with the angle between ray and plane, as of the centres of circles, of one size for all targets.

In a rig, which ties the images of its cameras together, the cameras share the variances of *image* and of *view*: residuals hardly tell
whose they are.

With whitened residuals v = R e, R = I − J N⁻¹ Jᵀ, the quadratic forms |Fₖᵀ v|² have the expectations Σ θⱼ tr(R Vₖ R Vⱼ): equations for
the θ (MINQUE with equal weights), solved with θ ≥ 0. The estimates stay those of least squares; an error F a moves them by A a,
A = N⁻¹ Jᵀ F, and their covariance is θ₀ N⁻¹ + Σ θₖ Aₖ Aₖᵀ. Its degrees of freedom are those of Satterthwaite. Where no part is significant
(F-tests of the quadratic forms, with Bonferroni's factor), nothing is changed. The oblique shift has one coefficient, and moves the
principal distance by far more than it leaves in the residuals: it is taken in from a lower level on, and like an error that is known and
not corrected (GUM F.2.4.5) it costs no degrees of freedom.

References
----------
C. R. Rao, J. Kleffe, Estimation of Variance Components and Applications (1988), chapter 5 (MINQUE); F. E. Satterthwaite, Biometrics
Bulletin 2 (1946) 110–114; A. Hagemann, M. Knorr, H. Janssen, C. Stiller, Inferring bias and uncertainty in camera calibration, Int. J.
Comput. Vis. 130 (2022) 17–32 (why formal uncertainties of real calibrations are too small).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pixmetry.calibrate.bundle._bundle_kernels import ELIMINATED
from pixmetry.calibrate.bundle.bundle_layout import Layout, layout_of
from pixmetry.calibrate.bundle.bundle_system import Linearised, Loss, Solved, constraints_of, linearise, solve
from pixmetry.calibrate.bundle.datum import Datum, carried, datum_of, null_space
from pixmetry.calibrate.bundle.network import Adjustment, SharedErrors, State
from pixmetry.calibrate.start.resection import thickness
from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.threads import single_threaded_blas

LENGTH = 0.19  # ℓ of the process over the frame, in widths of the frame
BUMPS = 1.2  # distance of the bumps that the process is made of, in their standard deviations ℓ/√2: its covariance is met to 2 %
BEYOND = 1.5  # standard deviations by which bumps go over the frame
TOLD = 1e-4  # share of the largest eigenvalue below which a part of the process is left out
LEVEL = 0.01  # of the F-tests together
LEVEL_OBLIQUE = 0.1  # of that of the shift of oblique targets
PLANE = 0.2  # thickness over extent of an object whose targets are taken to lie in one plane
LEAST_IMAGES = 4  # of a camera whose images have anything in common that can be told from what is each image's own
LEAST_DOF = 20  # below, residuals tell nothing of this kind
LEAST_TILT = 0.02  # rms sine of the tilt below which images have one direction of view
MOST_IMAGES = 60  # whose own displacements make the estimate; of more, these are spread evenly


class Effect(NamedTuple):
    """One kind of displacements: its columns in the whitened observation equations."""

    kind: str
    camera: int  # -1: of several cameras together
    columns: Any  # (2 n, q), sparse of images, else an ndarray; rows x, y, x, y, …
    mean_square: float  # of the displacement of an image coordinate for θ = 1


class View(NamedTuple):
    """What of the images the effects are functions of; the same for parts of a network as for the whole."""

    tilt: Array  # (images, 2): sines of the tilt of the object's plane about the axes of the camera
    scale: Array  # (cameras,): rms of them
    normal: Array | None  # (points, 3) or (3,) of the targets; None: not known


@dataclass(frozen=True)
class System:
    """The solved normal equations of an adjustment, for any right sides."""

    layout: Layout
    datum: Datum
    now: Linearised
    solved: Solved
    jacobian: Any  # sparse, (2 n, m + 3 points)
    eliminated: Any  # sparse, (m, 3 points)

    def answers(self, columns: Any) -> tuple[Array, Array, Array]:
        """Jᵀ F of whitened displacements F, shape (m + 3 points, q), and A = N⁻¹ Jᵀ F of the reduced unknowns (m, q) and of the points
        (points, 3, q), in the datum that makes the system regular."""
        from scipy.linalg.lapack import dpotrs

        layout, solved, m = self.layout, self.solved, len(self.layout.columns)
        right = _dense(self.jacobian.T @ columns)
        by_point = solved.root @ right[m:].reshape(len(layout.point_col), 3, -1)
        scale, ties = solved.scale[:, None], solved.ties
        reduced = right[:m] - self.eliminated @ by_point.reshape(-1, right.shape[1])
        inner = dpotrs(solved.factor, (reduced if ties is None else ties.T.T @ reduced) * scale, lower=0)[0]
        if len(layout.constraints):
            C = constraints_of(layout, ties) * solved.scale
            away = dpotrs(solved.factor, C.T, lower=0)[0]
            inner -= away @ np.linalg.solve(C @ away, C @ inner)
        inner = inner * scale
        step = inner if ties is None else ties.expanded(inner)
        points = np.swapaxes(solved.root, 1, 2) @ (by_point - (self.eliminated.T @ step).reshape(by_point.shape))
        return right, step, points

    def in_datum(self, step: Array, points: Array) -> tuple[Array, Array]:
        """Answers in the stated datum: without what moves its carriers."""
        if self.datum.missing == 0:
            return step, points
        G, G_points, _ = null_space(self.layout, self.now.state, self.datum)
        B, B_points = carried(self.layout, G_points, self.datum)
        out = self.layout.point_col == ELIMINATED
        product = np.einsum("jad,jae->de", B_points, G_points)
        moved = np.linalg.solve(product, B.T @ step + np.einsum("jad,jaq->dq", B_points[out], points[out]))
        return step - G @ moved, points - np.einsum("jad,dq->jaq", G_points, moved)


def system_of(adjustment: Adjustment) -> System | None:
    """The normal equations of an adjustment at its state; None where they are singular."""
    layout = layout_of(adjustment.network, adjustment.state, adjustment.used)
    datum = datum_of(layout, adjustment.state)
    now = linearise(layout, adjustment.state, Loss())
    solved = solve(layout, datum, now, 0.0, np.empty((len(layout.columns), len(layout.columns))))
    if solved is None:
        return None
    return System(layout, datum, now, solved, _jacobian(layout, now), _eliminated(layout, solved))


def _jacobian(layout: Layout, now: Linearised) -> Any:
    from scipy.sparse import csr_matrix

    at, n, wide = layout.incidence, len(layout.x), now.jacobian.shape[2]
    m, each, camera = len(layout.columns), int(at.camera_count.max()), layout.camera_of[layout.image]
    column = np.full((n, wide), -1, np.int64)
    own = np.arange(each)
    column[:, :each] = np.where(own < at.camera_count[camera][:, None], at.camera_col[camera][:, None] + own, -1)
    column[:, each : wide - 3] = at.image_col[layout.image][:, None] + np.arange(wide - 3 - each)
    of_point, axes = at.point_col[layout.point][:, None], np.arange(3)
    eliminated = np.where(of_point == ELIMINATED, m + 3 * layout.point[:, None] + axes, -1)
    column[:, wide - 3 :] = np.where(of_point >= 0, of_point + axes, eliminated)
    values = now.jacobian * (now.weight > 0)[:, None, None]
    rows = np.broadcast_to(np.arange(2 * n).reshape(n, 2, 1), values.shape)
    columns = np.broadcast_to(column[:, None, :], values.shape)
    some = (columns >= 0) & (values != 0)
    return csr_matrix((values[some], (rows[some], columns[some])), shape=(2 * n, m + 3 * len(layout.point_col)))


def _eliminated(layout: Layout, solved: Solved) -> Any:
    from scipy.sparse import csr_matrix

    of_images, of_cameras = solved.Z
    count, axes = len(layout.point_col), np.arange(3)[:, None]
    first = layout.incidence.image_col[layout.image][:, None, None] + np.arange(of_images.shape[2])
    rows = [np.broadcast_to(first, of_images.shape), np.broadcast_to(np.arange(of_cameras.shape[2]), of_cameras.shape)]
    columns = [
        np.broadcast_to(3 * which[:, None, None] + axes, values.shape)
        for which, values in ((layout.point, of_images), (np.arange(count), of_cameras))
    ]
    values, row, column = (np.concatenate([part.ravel() for part in parts]) for parts in ((of_images, of_cameras), rows, columns))
    return csr_matrix((values, (row, column)), shape=(len(layout.columns), 3 * count))


def view_of(adjustment: Adjustment) -> View:
    """Directions from which a network's images see its object: the sines of the tilt of the plane that its points lie nearest to."""
    network, state = adjustment.network, adjustment.state
    points = state.xyz[state.located]
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][-1] if len(points) else np.array([0.0, 0.0, 1.0])
    along = state.rotation @ normal
    tilt = np.where(state.posed[:, None], (along * np.where(along[:, 2:] < 0, -1.0, 1.0))[:, :2], 0.0)
    scale = np.zeros(len(network.cameras))
    for k in range(len(scale)):
        mine = state.posed & (network.camera_of == k)
        scale[k] = np.sqrt(np.mean(tilt[mine] ** 2)) if mine.any() else 0.0
    return View(tilt, scale, network.normal if network.normal is not None else normal if thickness(points)[0] < PLANE else None)


def effects_of(layout: Layout, state: State, took: Flags, view: View, own: Sequence[int] | None = None) -> list[Effect]:
    """The kinds of displacements that the image points of a network may share.

    Parameters
    ----------
    layout : Layout
    state : State
    took : ndarray of bool, shape (n,)
        Image points that take part, in its order.
    view : View
    own : sequence of int, optional
        Cameras with effects of their own, of a part of a network; then the functions of the frame are the same in all its parts.
    """
    camera = layout.camera_of[layout.image]
    x, y, square = _places(layout, camera)
    shapes = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=1)
    images = [np.unique(layout.image[took & (camera == k)]) for k in range(len(layout.network.cameras))]
    whole = own is None
    own = [k for k, of in enumerate(images) if len(of) >= LEAST_IMAGES] if own is None else own
    rest = [k for k in range(len(images)) if k not in own and len(images[k])]
    groups = [[*own, *rest]] if layout.rig is not None else [*([k] for k in own), rest]
    found = []
    for group in groups:
        if group:
            of_group = np.sort(np.concatenate([images[k] for k in group]))
            found.append(_by_image(layout, took & np.isin(camera, group), of_group, shapes, group[0] if len(group) == 1 else -1))
    views: list[Effect] = []
    for k in own:
        rows = np.flatnonzero(took & (camera == k))
        found.append(_effect(layout, "frame", k, rows, _process(layout, k, square[rows], principal=whole), np.zeros(len(rows), int), 1))
        if view.scale[k] > LEAST_TILT:
            a, b = (view.tilt[layout.image[rows]] / view.scale[k]).T
            tilts = np.stack([a, b, a**2, a * b, b**2], axis=1)
            both = (tilts[:, :, None] * shapes[rows][:, None, :]).reshape(len(rows), -1)
            views.append(_effect(layout, "view", k, rows, both, np.zeros(len(rows), int), 1))
    found += views if layout.rig is None or len(views) < 2 else [_together(views)]
    straight = [k for k in own if layout.network.cameras[k].projection == "perspective"]  # the formula is of these
    if straight and view.normal is not None and view.scale[straight].max() > LEAST_TILT:
        rows = np.flatnonzero(took & np.isin(camera, straight))
        found.append(_oblique(layout, state, rows, view.normal, straight[0] if len(straight) == 1 else -1))
    return found


def _together(effects: Sequence[Effect]) -> Effect:
    """Effects of one kind in several cameras, with one variance."""
    sizes = [int(np.count_nonzero((effect.columns != 0).any(axis=1))) for effect in effects]
    mean_square = float(np.average([effect.mean_square for effect in effects], weights=sizes))
    return Effect(effects[0].kind, -1, np.hstack([effect.columns for effect in effects]), mean_square)


def _oblique(layout: Layout, state: State, rows: Ints, normal: Array, camera: int) -> Effect:
    """A shift across the ray, from or towards the normal, with the square of the image's size: c/Z² (n · d) (n_xy − n_z d_xy), with the
    direction d = (X/Z, Y/Z, 1) and the normal n in the camera's frame.

    It is the shift of the centre of a circle's image against the image of its centre, per square of its radius, in a camera that is turned
    towards the circle: the circle X + r (e cos t + f sin t) on the axis has the image a/(1 + b), where a, b are r/Z (e cos t + f sin t)
    along x or y and along z. The mean of −a b over t is n_z n_xy r²/(2 Z²), as e eᵀ + f fᵀ = 1 − n nᵀ; the centre of the ellipse is twice
    as far. Other laws of the obliqueness (relief, light from one side) are much like it when the poses have taken what they can.
    """
    image, point = layout.image[rows], layout.point[rows]
    rotation = state.rotation[image]
    seen = np.einsum("nij,nj->ni", rotation, state.xyz[point] - state.position[image])
    n = np.einsum("nij,nj->ni", rotation, np.broadcast_to(normal if normal.ndim == 1 else normal[point], seen.shape))
    d = seen / seen[:, 2:]
    at = layout.camera_of[image]
    c_px = state.interior[at, :1] / layout.per_px[at]
    shift = np.nan_to_num(c_px / seen[:, 2:] ** 2 * (n * d).sum(axis=1, keepdims=True) * (n[:, :2] - n[:, 2:] * d[:, :2]))
    whole, w = np.zeros((2 * len(layout.x), 1)), layout.whiten[rows]
    whole[2 * rows, 0], whole[2 * rows + 1, 0] = w[:, 0] * shift[:, 0], w[:, 1] * shift[:, 0] + w[:, 2] * shift[:, 1]
    return Effect("oblique", camera, whole, float((shift**2).sum() / max(1, 2 * len(rows))))


def _places(layout: Layout, camera: Ints) -> tuple[Array, Array, Array]:
    """Places in the frame, −1 … 1 along each axis; and (n, 2), both in half widths."""
    size = np.array([(one.sensor.cols, one.sensor.rows) for one in layout.network.cameras], float)[camera]
    off = np.stack([layout.x, layout.y], axis=1) - (size - 1) / 2
    x, y = (2 * off / size).T
    return x, y, 2 * off / size[:, :1]


def _process(layout: Layout, k: int, at: Array, *, principal: bool) -> Array:
    """The process over the frame of a camera as independent functions at places (n, 2) in half widths: bumps on a grid, or the principal
    parts of them at these places, which are fewer."""
    sensor = layout.network.cameras[k].sensor
    width = 2 * LENGTH / np.sqrt(2)
    step = BUMPS * width
    axes = []
    for half in (1.0, sensor.rows / sensor.cols):
        count = int(np.ceil((half + BEYOND * width) / step))
        axes.append(step * np.arange(-count, count + 1))
    grid_x, grid_y = (part.ravel() for part in np.meshgrid(*axes))
    size = np.sqrt(step**2 / (np.pi * width**2))
    bumps = size * np.exp(-((at[:, :1] - grid_x) ** 2 + (at[:, 1:] - grid_y) ** 2) / (2 * width**2))
    if not principal:
        return np.asarray(bumps)
    values, vectors = np.linalg.eigh(bumps.T @ bumps)
    parts: Array = bumps @ vectors[:, values > TOLD * values[-1]]
    return parts


def _by_image(layout: Layout, some: Flags, images: Ints, shapes: Array, camera: int) -> Effect:
    if len(images) > MOST_IMAGES:
        images = images[np.linspace(0, len(images) - 1, MOST_IMAGES).round().astype(int)]
        some = some & np.isin(layout.image, images)
    rows = np.flatnonzero(some)
    return _effect(layout, "image", camera, rows, shapes[rows], np.searchsorted(images, layout.image[rows]), len(images))


def _effect(layout: Layout, kind: str, camera: int, rows: Ints, basis: Array, group: Ints, groups: int) -> Effect:
    """Displacements along x, then along y, by the functions ``basis`` (rows, b) of each group; whitened."""
    from scipy.sparse import csr_matrix

    b, mean_square = basis.shape[1], float((basis**2).sum() / max(1, len(rows)))
    if groups == 1:
        whole, w = np.zeros((2 * len(layout.x), 2 * b)), layout.whiten[rows]
        whole[2 * rows, :b], whole[2 * rows + 1, :b], whole[2 * rows + 1, b:] = w[:, :1] * basis, w[:, 1:2] * basis, w[:, 2:] * basis
        return Effect(kind, camera, whole, mean_square)
    first = 2 * b * group[:, None] + np.arange(b)
    w = layout.whiten[rows]
    parts = ((0, 0, w[:, :1]), (1, 0, w[:, 1:2]), (1, b, w[:, 2:]))
    values = np.concatenate([(weight * basis).ravel() for _, _, weight in parts])
    row = np.concatenate([np.repeat(2 * rows + axis, b) for axis, _, _ in parts])
    column = np.concatenate([(first + shift).ravel() for _, shift, _ in parts])
    columns = csr_matrix((values, (row, column)), shape=(2 * len(layout.x), 2 * b * groups))
    return Effect(kind, camera, columns, mean_square)


def _other_images(layout: Layout, took: Flags, effects: Sequence[Effect]) -> Iterator[tuple[int, Effect]]:
    """The displacements of those images that the estimate went without, some images at a time, with the number of their effect."""
    camera = layout.camera_of[layout.image]
    x, y, _ = _places(layout, camera)
    shapes = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=1)
    several = [e.camera for e in effects if e.kind == "image"]
    for i, effect in enumerate(effects):
        if effect.kind != "image":
            continue
        mine = took & ((camera == effect.camera) if effect.camera >= 0 else ~np.isin(camera, several))
        images = np.unique(layout.image[mine])
        if len(images) > MOST_IMAGES:
            images = np.delete(images, np.linspace(0, len(images) - 1, MOST_IMAGES).round().astype(int))
            for at in range(0, len(images), MOST_IMAGES):
                part = images[at : at + MOST_IMAGES]
                yield i, _by_image(layout, mine & np.isin(layout.image, part), part, shapes, effect.camera)


class Estimate(NamedTuple):
    """Variances of the effects: θ₀ first."""

    theta: Array  # (k + 1,)
    covariance: Array  # (k + 1, k + 1), of normal errors; 0 where nothing was found
    p: Array  # (k,)
    found: bool  # whether any is significant


def estimate_of(effects: Sequence[Effect], left: Array, forms: Array, squares: float, dof: int, *, a_priori: bool = False) -> Estimate:
    """Variances from the residuals.

    Parameters
    ----------
    effects : sequence of Effect
    left : ndarray, shape (q, q)
        Fᵀ R F of the columns of all of them side by side.
    forms : ndarray, shape (q,)
        Fᵀ v.
    squares : float
        Weighted sum of squares of the residuals.
    dof : int
    a_priori : bool
        θ₀ is 1 and not estimated.
    """
    from scipy import stats
    from scipy.optimize import nnls

    ends = np.cumsum([0, *(effect.columns.shape[1] for effect in effects)])
    parts = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    k = len(effects)
    T, y = np.zeros((k + 1, k + 1)), np.zeros(k + 1)
    T[0, 0], y[0] = dof, squares
    for i, rows in enumerate(parts):
        T[0, i + 1] = T[i + 1, 0] = np.trace(left[rows, rows])
        T[i + 1, 1:] = [(left[rows, columns] ** 2).sum() for columns in parts]
        y[i + 1] = (forms[rows] ** 2).sum()
    size = np.sqrt(np.diag(T))
    size[size == 0] = 1.0
    unit = 1.0 if a_priori else squares / dof
    with np.errstate(divide="ignore", invalid="ignore"):
        p = stats.f.sf(y[1:] / (unit * T[0, 1:]), T[0, 1:] ** 2 / np.diag(T)[1:], dof)
    p = np.nan_to_num(p, nan=1.0)
    oblique = np.array([effect.kind == "oblique" for effect in effects], bool)
    significant = p[~oblique].min(initial=1.0) * np.count_nonzero(~oblique) < LEVEL
    taken = 1 + np.flatnonzero(np.where(oblique, p < LEVEL_OBLIQUE, significant))
    theta = np.append(unit, np.zeros(k))
    if not len(taken) and a_priori:  # nothing to solve: SciPy's nnls of no column frees memory twice
        return Estimate(theta, np.zeros_like(T), p, False)
    if a_priori:
        theta[taken] = nnls(T[np.ix_(taken, taken)] / size[taken, None], (y - T[:, 0])[taken] / size[taken])[0]
    else:
        taken = np.append(0, taken)
        theta[taken] = nnls(T[np.ix_(taken, taken)] / size[taken, None], y[taken] / size[taken])[0]
    if not theta[1:].any():
        return Estimate(theta, np.zeros_like(T), p, False)
    found = (theta > 0) & np.append(False, oblique)
    theta[found] += theta[0] / T[0, found]  # the square of the shift as it was found, noise and all
    estimated = np.flatnonzero((theta > 0) & ~np.append(a_priori, oblique))
    return Estimate(theta, _scatter(theta, T, left, parts, dof, estimated), p, True)


def _scatter(theta: Array, T: Array, left: Array, parts: Sequence[slice], dof: int, active: Ints) -> Array:
    """Covariance of the ``active`` variances: T⁻¹ [2 tr(Vᵢ S Vⱼ S)] T⁻¹, S = Σ θ R V R, for normal errors."""
    k = len(parts)
    weight = np.concatenate([np.full(part.stop - part.start, t) for part, t in zip(parts, theta[1:], strict=True)])
    weighted = left * weight
    once = theta[0] * left + weighted @ left  # Fᵀ S F
    twice = theta[0] * once + weighted @ once  # Fᵀ S S F
    E = np.zeros((k + 1, k + 1))
    E[0, 0] = theta[0] ** 2 * dof + 2 * theta[0] * np.trace(weighted) + (weighted * weighted.T).sum()
    for i, rows in enumerate(parts):
        E[0, i + 1] = E[i + 1, 0] = np.trace(twice[rows, rows])
        E[i + 1, 1:] = [(once[rows, columns] ** 2).sum() for columns in parts]
    inverse = np.zeros_like(T)
    inverse[np.ix_(active, active)] = np.linalg.pinv(T[np.ix_(active, active)], hermitian=True)
    covariance: Array = 2 * inverse @ E @ inverse
    return covariance


@single_threaded_blas()
def with_shared_errors(adjustment: Adjustment, *, a_priori: bool = False) -> Adjustment:
    """An adjustment whose covariances hold what its image points have in common, as its residuals show it.

    Parameters
    ----------
    adjustment : Adjustment
        With its covariances.
    a_priori : bool
        Whether its covariances are without sigma0².

    Returns
    -------
    Adjustment
        With ``shared``; the same covariances, bit for bit, where nothing in common is significant.
    """
    system = system_of(adjustment) if adjustment.dof >= LEAST_DOF and adjustment.sigma0 > 0 else None
    if system is None:
        return adjustment
    layout, now, took = system.layout, system.now, system.now.weight > 0
    effects = effects_of(layout, now.state, took, view_of(adjustment))
    m, residual = len(layout.columns), np.where(took[:, None], now.residual, 0.0).ravel()
    answers = [system.answers(effect.columns) for effect in effects]
    right, step = (np.concatenate([answer[k] for answer in answers], axis=1) for k in (0, 1))
    points = np.concatenate([answer[2] for answer in answers], axis=2)
    full = np.block([[_product(one.columns, other.columns) for other in effects] for one in effects])
    some = layout.eliminated
    of_points = right[m:].reshape(points.shape)[some].reshape(-1, right.shape[1])
    left = full - right[:m].T @ step - of_points.T @ points[some].reshape(of_points.shape)
    forms = np.concatenate([effect.columns.T @ residual for effect in effects])
    found = estimate_of(effects, left, forms, now.cost, adjustment.dof, a_priori=a_priori)
    kinds = tuple((effect.kind, effect.camera) for effect in effects)
    rms = np.sqrt(found.theta[1:] * [effect.mean_square for effect in effects])
    variances = np.diag(adjustment.covariance)
    u, dof = np.sqrt(np.maximum(variances, 0.0)), np.full(len(variances), float(adjustment.dof))
    shared = SharedErrors(kinds, rms, found.p, found.theta[1:], 1.0, u, dof, False)
    if not found.found:
        return replace(adjustment, shared=replace(shared, rms_px=0.0 * rms, variance_px2=0.0 * found.theta[1:]))
    return _widened(adjustment, system, effects, found, (step, points), shared, a_priori)


def _widened(
    adjustment: Adjustment, system: System, effects: Sequence[Effect], found: Estimate, answers: tuple[Array, Array],
    shared: SharedErrors, a_priori: bool,
) -> Adjustment:  # fmt: skip
    layout, some = system.layout, system.layout.estimated
    unit = 1.0 if a_priori else adjustment.sigma0**2
    share = found.theta[0] / unit
    reduced, of_points = share * adjustment.covariance, share * adjustment.point_covariance
    parts = np.zeros((len(effects) + 1, len(reduced)))
    parts[0] = np.diag(adjustment.covariance) / unit

    def add(i: int, step: Array, points: Array) -> None:
        step, points = system.in_datum(step, points)
        step = step[some]
        parts[i + 1] += (step**2).sum(axis=1)
        nonlocal reduced, of_points
        reduced += found.theta[i + 1] * (step @ step.T)
        there = ~layout.held & layout.determined[:, None]
        moved = np.where(there[:, :, None], points, 0.0)
        moved[layout.point_col >= 0] = 0.0
        of_points = of_points + found.theta[i + 1] * (moved @ np.swapaxes(moved, 1, 2))

    ends = np.cumsum([0, *(effect.columns.shape[1] for effect in effects)])
    for i, (a, b) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        add(i, answers[0][:, a:b], answers[1][:, :, a:b])
    for i, effect in _other_images(layout, system.now.weight > 0, effects):
        add(i, *system.answers(effect.columns)[1:])
    for j in np.flatnonzero(layout.point_col >= 0):
        rows = [k for k, name in enumerate(adjustment.free_columns) if name.rpartition(":")[0] == layout.network.points[j]]
        free = np.flatnonzero(~layout.held[j])
        of_points[np.ix_([j], free, free)] = reduced[np.ix_(rows, rows)]
    variance = found.theta @ parts
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = 2 * variance**2 / np.einsum("ip,ij,jp->p", parts, found.covariance, parts)
    dof = np.where(np.isfinite(dof), np.minimum(dof, adjustment.dof), adjustment.dof)
    shared = replace(shared, white_variance=share, dof=dof, found=True)
    return replace(adjustment, covariance=reduced, point_covariance=of_points, shared=shared)


def interior_parts(part: Adjustment, whole: Adjustment) -> tuple[Array, Array]:
    """What an adjustment of some of the images says of the interior parameters, by the variances that all images tell.

    Parameters
    ----------
    part, whole : Adjustment
        The latter with ``shared``; its first images need not be those of the part.

    Returns
    -------
    own : ndarray, shape (interior, interior)
        Covariance by independent errors and by those of each image.
    common : ndarray, shape (interior, q)
        A root of the covariance by errors that other images share; the same columns for any part.
    """
    m = sum(len(part.interior_covariance(k)[0]) for k in range(len(part.network.cameras)))
    own = part.covariance[:m, :m] * (whole.sigma0 / part.sigma0) ** 2
    shared = whole.shared
    if shared is None or not shared.found:
        return own, np.zeros((m, 0))
    system = system_of(part)
    assert system is not None  # its covariance is there
    view, took = view_of(whole), system.now.weight > 0
    names = {name: i for i, name in enumerate(whole.network.images)}
    view = view._replace(tilt=view.tilt[[names[name] for name in part.network.images]])
    sizes = dict(zip(shared.kinds, shared.variance_px2, strict=True))
    effects = effects_of(system.layout, system.now.state, took, view, [k for kind, k in shared.kinds if kind == "frame"])
    own = own * shared.white_variance
    common = []
    for effect in [*effects, *(effect for _, effect in _other_images(system.layout, took, effects))]:
        size = sizes.get((effect.kind, effect.camera), 0.0)
        step = np.sqrt(size) * system.answers(effect.columns)[1][:m]
        if effect.kind == "image":
            own = own + step @ step.T
        else:
            common.append(step)
    return own, np.hstack(common) if common else np.zeros((m, 0))


def shared_moves(adjustment: Adjustment, points: Ints) -> tuple[Array, Array]:
    """Roots of what shared errors added to the covariances of an adjustment: of its free columns (columns, q), and of the coordinates of
    some points (3 points, q)."""
    system, shared = system_of(adjustment), adjustment.shared
    assert system is not None and shared is not None  # its covariance is there
    took = system.now.weight > 0
    effects = effects_of(system.layout, system.now.state, took, view_of(adjustment))
    found = []
    for i, effect in [*enumerate(effects), *_other_images(system.layout, took, effects)]:
        step, by_point = system.in_datum(*system.answers(effect.columns)[1:])
        size = np.sqrt(shared.variance_px2[i])
        joined = system.layout.point_col[points]
        moved = np.where((joined >= 0)[:, None, None], step[np.maximum(joined, 0)[:, None] + np.arange(3)], by_point[points])
        found.append((size * step[system.layout.estimated], size * moved.reshape(3 * len(points), -1)))
    return np.hstack([one for one, _ in found]), np.hstack([one for _, one in found])


def _product(one: Any, other: Any) -> Array:
    """Fᵀ G of columns that are sparse or not."""
    from scipy.sparse import issparse

    if issparse(other) and not issparse(one):
        return np.asarray(_dense(other.T @ one).T)
    return _dense(one.T @ other)


def _dense(matrix: Any) -> Array:
    dense: Array = matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
    return dense
