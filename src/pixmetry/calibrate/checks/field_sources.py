"""What the residuals of a calibration tell of error sources, as numbers with their uncertainty: height of the sensor, seams, x-scales.

Terms for these are estimated beside everything that the adjustment estimated, to first order exactly as an adjustment with them would
(`pixmetry.calibrate.checks.added_terms`). What lens and poses take up of a term is not told: of a height, its mean (principal distance),
its slope (principal point and poses) and all that depends on the radius alone (radial terms).

Residuals have something in common where a target, or a part of the frame, has an error of its own. The uncertainty holds both: the
covariance by images, with the scatter of the scores of the images (a jackknife over clusters: A. C. Cameron, D. L. Miller, J. Human
Resources 50 (2015) 317–372), and what residuals have in common in one cell of the frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.checks.added_terms import AddedTerms, Beside, Normals
from pixmetry.calibrate.checks.causes import STRONG, Candidate, Place
from pixmetry.calibrate.records import FieldSources, HeightMap, ImageScales, Seams
from pixmetry.core.arrays import Array

LAYOUTS = ((2, 1), (1, 2), (3, 1), (1, 3), (2, 2), (4, 1), (3, 2), (4, 2))  # fields side by side, one above the other
DEGREES = tuple((i, j) for j in range(5) for i in range(5) if 2 <= i + j <= 4)  # of P_i(x) P_j(y): shapes of a surface
PLAIN = ((2, 0), (0, 2), (1, 1), (3, 0), (0, 3))  # bow, twist and skew
TOLD = 0.1  # share of a term that must be left when the estimated parameters have taken theirs
CELLS = (10, 8)  # of the frame, in which residuals have something in common or not
TURNED = 1e-3  # level at which a pattern that turns is no height
SIDE = (33, 25)  # of the map that is drawn
FINER = 0.03  # of what a partition explains, which a finer one must explain more: terms are linear
LEAST_TOLD = 8  # images by which a fixed pattern of the camera is told from errors of single images
SINGULAR = 1e-12  # least eigenvalue of a covariance, over its trace
LEAST_IMAGES = 5  # whose scores show their own scatter


def height_terms(x: np.ndarray, y: np.ndarray, cols: int, rows: int, degrees: tuple[tuple[int, int], ...] = DEGREES) -> tuple[Array, Array]:
    """Displacement in x and y, shape (n, terms), by heights P_i(u) P_j(v) of the principal distance's size: along the radius."""
    x0, y0 = (cols - 1) / 2, (rows - 1) / 2
    across = np.polynomial.legendre.legvander((x - x0) / (x0 + 0.5), 6)
    down = np.polynomial.legendre.legvander((y - y0) / (y0 + 0.5), 6)
    height = np.stack([across[:, i] * down[:, j] for i, j in degrees], axis=1)
    return height * (x - x0)[:, None], height * (y - y0)[:, None]


def field_terms(x: np.ndarray, y: np.ndarray, cols: int, rows: int, layout: tuple[int, int]) -> tuple[Array, Array]:
    """Displacement in x and y, shape (n, 2 fields), of each field of the frame as a whole: first along x, then along y."""
    i = np.clip(np.floor((x + 0.5) * layout[0] / cols), 0, layout[0] - 1).astype(int)
    j = np.clip(np.floor((y + 0.5) * layout[1] / rows), 0, layout[1] - 1).astype(int)
    one = (np.arange(layout[0] * layout[1]) == (j * layout[0] + i)[:, None]).astype(float)
    return np.hstack([one, 0 * one]), np.hstack([0 * one, one])


@dataclass(frozen=True)
class _Camera:
    """The observations of one camera among the rows of the terms."""

    terms: AddedTerms
    index: int
    mine: np.ndarray
    x: np.ndarray
    y: np.ndarray
    image: np.ndarray

    @cached_property
    def cells(self) -> _Cells:
        """Those in which residuals have something in common or not."""
        from scipy import sparse

        cols, rows = self.size
        col = np.clip((self.x + 0.5) / cols * CELLS[0], 0, CELLS[0] - 1).astype(int)
        row = np.clip((self.y + 0.5) / rows * CELLS[1], 0, CELLS[1] - 1).astype(int)
        _, cell = np.unique(row * CELLS[0] + col, return_inverse=True)
        at = 2 * np.flatnonzero(self.mine)
        lines, columns = np.concatenate([at, at + 1]), np.concatenate([2 * cell, 2 * cell + 1])
        terms = sparse.csr_matrix((np.ones(len(lines)), (lines, columns)), shape=(2 * len(self.mine), 2 * (cell.max() + 1)))
        return _Cells(self.terms.whitened(terms), self.terms.normals(terms))

    @property
    def size(self) -> tuple[int, int]:
        sensor = self.terms.adjustment.network.cameras[self.index].sensor
        return sensor.cols, sensor.rows

    def along(self, parts: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        out = np.zeros((len(self.mine), 2, parts[0].shape[1]))
        out[self.mine, 0], out[self.mine, 1] = parts
        return out


def field_sources(
    terms: AddedTerms,
    index: int,
    mine: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
    chosen: Mapping[str, tuple[Candidate, Place]],
    *,
    left: bool = False,
) -> FieldSources:
    """What the residuals of one camera tell of its error sources.

    Parameters
    ----------
    terms : AddedTerms
    index : int
        Of the camera.
    mine : ndarray of bool, shape (m,)
        Which of the rows are of this camera.
    x, y : ndarray, shape (n,)
        Computed places, px.
    image : ndarray of int, shape (n,)
    chosen : mapping
        Patterns that explain the residuals, with their terms: those of other sources are estimated along.
    left : bool
        Whether residuals depend on the place in the frame beyond these: then no height is named as what explains them.

    Returns
    -------
    FieldSources
    """
    camera = _Camera(terms, index, mine, x, y, image)
    beside = {name: candidate for name, (candidate, _) in chosen.items()}
    place = {name: place for name, (_, place) in chosen.items()}
    return FieldSources(
        height=_height(camera, _others(beside, "unflatness", "radius"), place.get("unflatness"), left=left),
        seams=_seams(camera, _others(beside, "seams", "field"), place.get("seams")),
        scales=_scales(camera, _others(beside, "x_scale_trend", "x_scale_by_image")),
    )


def _others(chosen: Mapping[str, Candidate], *own: str) -> list[Candidate]:
    """Those that few terms make, of which the radial ones stand for the lens."""
    return [one for name, one in chosen.items() if name not in (*own, "field", "image_rms")]


# ---- height ---------------------------------------------------------------------------------------------------------------------------


def _height(camera: _Camera, others: list[Candidate], place: Place | None, *, left: bool) -> HeightMap | None:
    """The height by the few plain shapes, or by all of the fourth degree where these explain more."""
    few, more = (_height_of(camera, others, degrees) for degrees in (PLAIN, DEGREES))
    if few is None or more is None:
        return few
    found = more if more.gain > few.gain + STRONG else few
    enough = len(np.unique(camera.image)) >= LEAST_TOLD
    named = bool(enough and not left and place is not None and not place.rivals and found.gain > STRONG and found.p_turned > TURNED)
    return replace(found, found=named, rivals=place.rivals if place is not None else ())


def _height_of(camera: _Camera, others: list[Candidate], degrees: tuple[tuple[int, int], ...]) -> HeightMap | None:
    terms = camera.terms
    shift = height_terms(camera.x, camera.y, *camera.size, degrees)
    turned = (-shift[1], shift[0])
    with_others = [_dense(terms, one) for one in others]
    own = len(degrees)
    heights = terms.as_rows(camera.along(shift))
    beside = terms.beside(np.hstack([heights, *with_others]))
    fit = _fit(camera, beside, own)
    if fit is None:
        return None
    curl = _fit(camera, terms.beside(np.hstack([terms.as_rows(camera.along(turned)), heights, *with_others])), own)
    c, names, change = _interior(camera, beside.change[:, :own])
    x = np.linspace(0, camera.size[0] - 1, SIDE[0])
    y = np.linspace(0, camera.size[1] - 1, SIDE[1])
    at_x, at_y = (part.ravel() for part in np.meshgrid(x, y))
    shape = _heights(at_x, at_y, camera.size, degrees)
    u = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", shape, fit.covariance, shape), 0))
    return HeightMap(
        across=tuple(i for i, _ in degrees),
        down=tuple(j for _, j in degrees),
        coefficients_px=c * fit.values,
        covariance_px2=c**2 * fit.covariance,
        told=fit.told,
        rank=fit.rank,
        dof=fit.dof,
        gain=fit.gain,
        p=fit.p,
        p_turned=1.0 if curl is None else curl.p,
        scatter_factor=fit.factor,
        common_px=fit.common_px,
        effective=fit.effective,
        lens_names=names,
        lens_change=change / c,
        x_px=x,
        y_px=y,
        height_px=(shape @ fit.values * c).reshape(len(y), len(x)),
        u_px=(u * c).reshape(len(y), len(x)),
    )


def _dense(terms: AddedTerms, one: Candidate) -> np.ndarray:
    from scipy import sparse

    rows = terms.as_rows(one.columns)
    return rows.toarray() if sparse.issparse(rows) else rows


def _heights(x: np.ndarray, y: np.ndarray, size: tuple[int, int], degrees: tuple[tuple[int, int], ...]) -> Array:
    x0, y0 = (size[0] - 1) / 2, (size[1] - 1) / 2
    u = np.polynomial.legendre.legvander((x - x0) / (x0 + 0.5), 6)
    v = np.polynomial.legendre.legvander((y - y0) / (y0 + 0.5), 6)
    return np.stack([u[:, i] * v[:, j] for i, j in degrees], axis=1)


def _interior(camera: _Camera, change: np.ndarray) -> tuple[float, tuple[str, ...], np.ndarray]:
    """Principal distance in px along x; names of the camera's estimated parameters, and their changes with the terms."""
    adjustment = camera.terms.adjustment
    first = 0
    for model in adjustment.network.cameras[: camera.index]:
        first += int(model.free.sum())
    model = adjustment.camera(camera.index)
    names = tuple(name for name, free in zip(NAMES, model.free, strict=True) if free)
    return model["c"] / model.sensor.per_px[0], names, change[first : first + len(names)]


@dataclass(frozen=True)
class _Fit:
    """Terms of one source, of those combinations that are told."""

    values: np.ndarray
    covariance: np.ndarray
    told: np.ndarray
    rank: int
    dof: float
    gain: float
    p: float
    factor: float
    common_px: float
    effective: float


@dataclass(frozen=True)
class _Told:
    """Those combinations of terms of one source that are told, as if residuals were independent."""

    beside: Beside
    size: np.ndarray
    vectors: np.ndarray  # of the combinations
    g: np.ndarray  # what is left of them, row by row
    normal: np.ndarray
    found: np.ndarray
    before: float  # sum of squares without them
    fall: float
    dof: float
    after: np.ndarray

    @property
    def rank(self) -> int:
        return len(self.found)

    @property
    def gain(self) -> float:
        return float(self.dof * np.log(max(self.before, 1e-300) / max(self.before - self.fall, 1e-300)))

    @property
    def cost(self) -> float:
        return float(self.rank * np.log(self.dof))


def _told(camera: _Camera, beside: Beside, own: int) -> _Told | None:
    """Estimate the first ``own`` terms beside the others; None where nothing of them is told.

    The others are taken out of them first; then the combinations of which the estimated parameters leave little are left at 0.
    """
    adjustment = camera.terms.adjustment
    rest, v = beside.rest[:, :own], beside.residual
    if beside.rest.shape[1] > own:
        more = beside.rest[:, own:]
        inverse = np.linalg.pinv(more.T @ more, rcond=1e-6, hermitian=True)
        rest, v = rest - more @ (inverse @ (more.T @ rest)), v - more @ (inverse @ (more.T @ v))
    left = rest.T @ rest
    size = np.where(beside.length[:own] > 0, beside.length[:own], 1.0)  # a part of the frame may have no image points
    values, vectors = np.linalg.eigh(left / np.outer(size, size))
    good = values > TOLD**2
    if not good.any():
        return None
    g = rest @ (vectors[:, good] / size[:, None])
    normal = g.T @ g
    found = np.linalg.solve(normal, g.T @ v)
    squares = float(adjustment.sigma0**2 * adjustment.dof)
    before = squares - (float(beside.residual @ beside.residual) - float(v @ v))
    dof = float(adjustment.dof - good.sum() - (beside.rest.shape[1] - own))
    if dof < 1:
        return None
    return _Told(beside, size, vectors[:, good], g, normal, found, before, float(found @ normal @ found), dof, v - g @ found)


def _fit(camera: _Camera, beside: Beside, own: int) -> _Fit | None:
    """The first ``own`` terms beside the others, with the uncertainty that holds what residuals have in common; None where nothing of them
    is told."""
    told = _told(camera, beside, own)
    return None if told is None else _with_scatter(camera, told)


def _with_scatter(camera: _Camera, one: _Told) -> _Fit:
    from scipy import stats

    directions = one.vectors / one.size[:, None]  # terms = directions @ told ones
    inverse = np.linalg.inv(one.normal)
    variance = max((one.before - one.fall) / one.dof, 1e-300)
    covariance = variance * inverse
    factor, clusters = _scatter_by_image(camera, one.g, one.after, covariance, one.normal)
    own_cells = np.asarray(camera.cells.white.T @ one.beside.rest)
    common_px, effective = _common(camera, camera.cells.normals, own_cells, one.beside, one.after, variance)
    by_cell = np.asarray(camera.cells.white.T @ one.g)
    full = max(factor, 1.0) ** 2 * covariance + common_px**2 * inverse @ (by_cell.T @ by_cell) @ inverse
    inflated = float(np.trace(full @ np.linalg.inv(covariance)) / one.rank)
    f = float(one.found @ np.linalg.inv(full) @ one.found) / one.rank
    return _Fit(
        values=directions @ one.found,
        covariance=directions @ full @ directions.T,
        told=directions @ (one.vectors.T * one.size),
        rank=one.rank,
        dof=clusters if factor > 1 else one.dof,
        gain=one.gain / inflated - one.cost,
        p=float(stats.f.sf(f, one.rank, one.dof)),
        factor=factor,
        common_px=common_px,
        effective=effective,
    )


def _image_of_rows(camera: _Camera) -> tuple[np.ndarray, int]:
    """Of each of the 2 m rows the number of its image among those of the camera, and how many there are; other cameras: −1."""
    images, number = np.unique(camera.image, return_inverse=True)
    out = np.full(len(camera.mine), -1)
    out[camera.mine] = number
    return np.repeat(out, 2), len(images)


def _scatter_by_image(camera: _Camera, g: np.ndarray, after: np.ndarray, covariance: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """Scatter of the images' scores over what independent residuals would give (rms over the terms), and its degrees of freedom."""
    image, count = _image_of_rows(camera)
    rank = g.shape[1]
    if count < LEAST_IMAGES:
        return 1.0, float("inf")
    order = np.argsort(image, kind="stable")[np.count_nonzero(image < 0) :]
    first = np.searchsorted(image[order], np.arange(count))
    g = g[order]
    scores = np.add.reduceat(g * after[order][:, None], first)
    own = np.stack([part.T @ part for part in np.split(g, first[1:])])
    moved = np.einsum("iab,ib->ia", np.linalg.pinv(normal - own, hermitian=True), scores)  # a jackknife: were the image left out
    by_image = (count - 1) / count * moved.T @ moved
    ratio = float(np.trace(by_image @ np.linalg.inv(covariance)) / rank)
    return float(np.sqrt(ratio)), float(rank * (count - 1))


@dataclass(frozen=True)
class _Cells:
    """Displacements of the cells of a frame, each as a whole along x and along y.

    Parameters
    ----------
    white : sparse matrix, shape (2 m, 2 cells)
        Whitened.
    normals : Normals
        Beside the estimated parameters.
    """

    white: Any
    normals: Normals


def _common(camera: _Camera, whole: Normals, across: np.ndarray, beside: Beside, after: np.ndarray, variance: float) -> tuple[float, float]:
    """What residuals have in common in one cell, px, and the effective number of residuals.

    By moments of the cells' sums q with the normal matrix L that all estimates leave of the cells, E qᵀq = σ² tr L + σ_c² tr L² (Searle,
    Casella, McCulloch, Variance Components, 1992, 5.5); nothing where chance makes as much in 1 %.
    """
    inverse = np.linalg.pinv(beside.rest.T @ beside.rest, rcond=1e-9, hermitian=True)
    left = whole.left - across @ inverse @ across.T
    q = np.asarray(camera.cells.white.T @ after)
    n = 2.0 * float(camera.mine.sum())
    square, trace = float((left * left).sum()), float(np.trace(left))
    excess = float(q @ q) - variance * trace
    if square <= 0 or excess < 2.33 * variance * np.sqrt(2 * square):
        return 0.0, n
    common2 = excess / square
    network, rows = camera.terms.adjustment.network, camera.terms.rows[camera.mine]
    px2 = network.covariance_px2[rows][:, [0, 2]].mean()
    counts = px2 * np.diag(whole.full)
    rho = common2 / (common2 + px2 * variance)
    return float(np.sqrt(common2)), n / (1 + ((counts**2).sum() / counts.sum() - 1) * rho)


# ---- seams ----------------------------------------------------------------------------------------------------------------------------


def _seams(camera: _Camera, others: list[Candidate], place: Place | None) -> Seams | None:
    """Steps of the best partition of the frame."""
    terms = camera.terms
    with_others = [_dense(terms, one) for one in others]
    best: tuple[tuple[int, int], _Told] | None = None
    least = -np.inf
    for layout in LAYOUTS:
        shift = field_terms(camera.x, camera.y, *camera.size, layout)
        beside = terms.beside(np.hstack([terms.as_rows(camera.along(shift)), *with_others]))
        told = _told(camera, beside, shift[0].shape[1])
        evidence = -np.inf if told is None else told.gain - told.cost
        if told is not None and (best is None or evidence > FINER * abs(least) + least + STRONG):
            best, least = (layout, told), evidence
    if best is None:
        return None
    layout, fit = best[0], _with_scatter(camera, best[1])
    gain = fit.gain
    fields = layout[0] * layout[1]
    enough = len(np.unique(camera.image)) >= LEAST_TOLD
    named = enough and place is not None and not place.rivals and gain > STRONG
    # steps less their mean, of draws of one standard deviation: their squares over what is told of them
    weight, square = float(np.trace(fit.told @ fit.told.T)), float(fit.values @ fit.values)
    std = float(np.sqrt(max(square - np.trace(fit.covariance), 0.0) / weight))
    of_draws = std / np.sqrt(2 * fit.rank)
    of_noise = float(np.sqrt(fit.values @ fit.covariance @ fit.values)) / (weight * std) if std else 0.0
    limit = float(np.sqrt(square / weight)) + 1.645 * float(np.sqrt(np.trace(fit.covariance) / weight))
    return Seams(
        layout[0], layout[1], std, float(np.hypot(of_draws, of_noise)), float(fit.rank), limit, gain, bool(named),
        fit.values.reshape(2, fields).T, np.sqrt(np.diag(fit.covariance)).reshape(2, fields).T,
    )  # fmt: skip


# ---- scales of images -----------------------------------------------------------------------------------------------------------------


def _scales(camera: _Camera, others: list[Candidate]) -> ImageScales | None:
    """Whether the scale of x differs from image to image, and whether it decays with time."""
    from scipy import stats

    adjustment = camera.terms.adjustment
    network = adjustment.network
    images = np.unique(camera.image)
    if len(images) < LEAST_IMAGES:
        return None
    contrasts = np.linalg.svd(np.eye(len(images)) - 1 / len(images))[0][:, :-1]
    if "x_scale" in network.per_image:
        rows = [adjustment.free_columns.index(f"{network.images[i]}:x_scale") for i in images]
        y = contrasts.T @ adjustment.state.x_scale[images]
        v = contrasts.T @ adjustment.covariance[np.ix_(rows, rows)] @ contrasts
    else:
        columns = np.zeros((len(camera.x), len(images)))
        columns[np.arange(len(camera.x)), np.searchsorted(images, camera.image)] = camera.x - network.scale_origin_px
        terms = [camera.terms.as_rows(camera.along((columns, 0 * columns))), *(_dense(camera.terms, one) for one in others)]
        own = np.zeros((sum(part.shape[1] for part in terms), len(contrasts.T)))
        own[: len(images)] = contrasts
        rest = np.eye(len(own))[:, len(images) :]
        found = camera.terms.test(np.hstack(terms), np.hstack([own, rest]))
        k = contrasts.shape[1]
        y, v = found.values[:k], found.covariance[:k, :k]
    if not np.isfinite(v).all() or np.linalg.eigvalsh(v)[0] <= SINGULAR * np.trace(v):
        return None  # of an image that does not tell its scale
    weight = np.linalg.inv(v)
    chi2 = float(y @ weight @ y)
    p_differ = float(stats.f.sf(chi2 / len(y), len(y), adjustment.dof))
    values, u = contrasts @ y, np.sqrt(np.einsum("ij,jk,ik->i", contrasts, v, contrasts))
    known = network.time_s is not None and np.isfinite(network.time_s[images]).all() and np.ptp(network.time_s[images]) > 0
    scales = ImageScales(tuple(network.images[i] for i in images), values, u, None, p_differ, None)
    if not known or len(images) < LEAST_IMAGES + 1:
        return scales
    time_s = network.time_s[images] - network.time_s[images].min()  # type: ignore[index]
    return _decaying(replace(scales, time_s=time_s), y, weight, contrasts, chi2, adjustment.dof)


def _decaying(scales: ImageScales, y: np.ndarray, weight: np.ndarray, contrasts: np.ndarray, chi2: float, dof: float) -> ImageScales:
    """A decay δ exp(−t/τ) from the first image on; what is common to all images belongs to the affinity."""
    from scipy import optimize, stats

    time_s = scales.time_s
    assert time_s is not None
    span = float(np.ptp(time_s))

    def shape(tau: float) -> Array:
        return np.asarray(contrasts.T @ np.exp(-time_s / tau))

    def fall(log_tau: float) -> float:
        a = shape(float(np.exp(log_tau)))
        return -(float(a @ weight @ y) ** 2) / max(float(a @ weight @ a), 1e-300)

    tries = np.linspace(np.log(span / (3 * len(time_s))), np.log(5 * span), 60)
    best = int(np.argmin([fall(one) for one in tries]))
    low, high = tries[max(best - 1, 0)], tries[min(best + 1, len(tries) - 1)]
    tau = float(np.exp(optimize.minimize_scalar(fall, bounds=(low, high), method="bounded", options={"xatol": 1e-6}).x))
    a = shape(tau)
    size = float(a @ weight @ y) / float(a @ weight @ a)
    slope = size * (contrasts.T @ (time_s / tau * np.exp(-time_s / tau)))  # by ln τ
    jacobian = np.stack([a, slope], axis=1)
    left = y - size * a
    rest, free = float(left @ weight @ left), len(y) - 2
    p_left = float(stats.f.sf(rest / free, free, dof))
    covariance = np.linalg.pinv(jacobian.T @ weight @ jacobian, hermitian=True) * max(rest / free, 1.0)
    gain = (chi2 - rest) / max(rest / free, 1.0) - 2 * np.log(dof)
    to_tau = np.diag([1.0, tau])
    return replace(
        scales, p_left=p_left, gain=gain, start=size, tau_s=tau, covariance=to_tau @ covariance @ to_tau,
        dof=float(free if rest > free else dof),
    )  # fmt: skip


def without_claims(found: FieldSources, rival: str) -> FieldSources:
    """The same where something else, in words, may look like each of them: nothing is named."""
    height = None if found.height is None or not found.height.found else replace(found.height, found=False, rivals=(rival,))
    seams = None if found.seams is None else replace(found.seams, found=False)
    return replace(found, height=height or found.height, seams=seams)
