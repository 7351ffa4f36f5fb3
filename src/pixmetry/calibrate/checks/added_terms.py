"""Would one more parameter explain something? Score tests of terms that an adjustment did not estimate, without adjusting again.

With whitened residuals v, the whitened derivatives A by all that was estimated and G by the terms in question, the part of G that the
estimated ones cannot take over gives, for Gaussian noise, exactly what an adjustment with the terms would find to first order:

    H = Gᵀ G − Gᵀ A (Aᵀ A)⁻ Aᵀ G,  b = Gᵀ v,  terms = H⁻ b,  fall of the sum of squares = bᵀ H⁻ b.

References
----------
W. Förstner, B. Wrobel, Photogrammetric Computer Vision (2016), section 4.6; C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50–57.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import PER_IMAGE, SCALE, SHIFT, Adjustment, Network, State
from pixmetry.calibrate.bundle.rig import Ties, rig_of
from pixmetry.core.arrays import Array

RIDGE = 1e-11  # on a unit diagonal: carries the directions that no observation sees (the datum), moves no other
OFTEN = 0.1  # share of the images that see a point above which dense products are faster
SMALL = 400_000  # entries of the design up to which its product with the inverse root of the normal matrix is kept
WEAKEST = 1e-6  # share of a term that must be left when the estimated parameters have taken theirs


@dataclass(frozen=True)
class Derivatives:
    """Computed image coordinates, px, shape (n, 2), and their derivatives.

    Parameters
    ----------
    computed : ndarray, shape (n, 2)
    by_interior : ndarray, shape (n, 2, interior parameters)
    by_image : ndarray, shape (n, 2, 8)
        A small rotation about the camera's axes, the projection centre, x-scale, x-shift.
    by_point : ndarray, shape (n, 2, 3)
    """

    computed: np.ndarray
    by_interior: np.ndarray
    by_image: np.ndarray
    by_point: np.ndarray


def derivatives(network: Network, state: State) -> Derivatives:
    """Of every observation; NaN where the point has no coordinates."""
    n, image = len(network), network.image
    rotation = state.rotation[image]
    inside = np.einsum("nij,nj->ni", rotation, state.xyz[network.point] - state.position[image])
    u, v, depth = inside[:, 0] / inside[:, 2], inside[:, 1] / inside[:, 2], inside[:, 2]
    computed, by_direction, by_interior = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 2, len(NAMES)))
    for k, camera in enumerate(network.cameras):
        rows = network.camera_of[image] == k
        x, y, by_direction[rows], by_interior[rows] = replace(camera, values=state.interior[k]).projected(u[rows], v[rows])
        computed[rows, 0], computed[rows, 1] = x, y
    by_inside = np.empty((n, 2, 3))
    by_inside[:, :, :2] = by_direction / depth[:, None, None]
    by_inside[:, :, 2] = -(by_direction[:, :, 0] * u[:, None] + by_direction[:, :, 1] * v[:, None]) / depth[:, None]
    by_image = np.zeros((n, 2, PER_IMAGE))
    by_image[:, :, :3] = -np.cross(by_inside, inside[:, None, :])  # f · (w × X) = w · (X × f)
    by_point = np.einsum("nai,nij->naj", by_inside, rotation)
    by_image[:, :, 3:6] = -by_point
    stretch = 1.0 + state.x_scale[image]
    for part in (by_interior, by_image, by_point):
        part[:, 0] *= stretch[:, None]
    from_origin = computed[:, 0] - network.scale_origin_px
    by_image[:, 0, SCALE], by_image[:, 0, SHIFT] = from_origin, 1.0
    computed[:, 0] = network.scale_origin_px + stretch * from_origin + state.x_shift_px[image]
    return Derivatives(computed, by_interior, by_image, by_point)


def whitening(covariance_px2: np.ndarray) -> np.ndarray:
    """Factors, shape (n, 2, 2), that make errors of these covariances uncorrelated and of unit size."""
    var_x, cov, var_y = covariance_px2.T
    out = np.zeros((len(covariance_px2), 2, 2))
    out[:, 0, 0] = 1 / np.sqrt(var_x)
    left = np.sqrt(var_y - cov**2 / var_x)
    out[:, 1, 0], out[:, 1, 1] = -cov / var_x / left, 1 / left
    return out


@dataclass(frozen=True)
class Terms:
    """Outcome of a test.

    Parameters
    ----------
    values : ndarray, shape (k,)
        As an adjustment with these terms would find them.
    covariance : ndarray, shape (k, k)
        A posteriori.
    f, p : float
        F-test against none of them, with `k` (those that can be told from the estimated parameters) and `dof` degrees of freedom.
    k : int
    dof : float
    fall, variance : float
        What the terms take from the weighted sum of squares, and the variance of unit weight with them.
    """

    values: np.ndarray
    covariance: np.ndarray
    f: float
    p: float
    k: int
    dof: float
    fall: float
    variance: float


@dataclass(frozen=True)
class Solved:
    """Values of terms of least length where they are not determined, their cofactors, what they take from the sum of squares, and how
    many combinations of them are determined."""

    values: np.ndarray
    inverse: np.ndarray
    fall: float
    rank: int


@dataclass(frozen=True)
class Normals:
    """Normal equations of terms, whitened.

    Parameters
    ----------
    full, left : ndarray, shape (k, k)
        Gᵀ G of the terms as they are, and of what the estimated parameters leave of them.
    right : ndarray, shape (k,)
        Gᵀ v.
    """

    full: np.ndarray
    left: np.ndarray
    right: np.ndarray

    def of(self, which: np.ndarray) -> Normals:
        """Those of some of the terms alone."""
        return Normals(self.full[np.ix_(which, which)], self.left[np.ix_(which, which)], self.right[which])

    def combined(self, by: np.ndarray) -> Normals:
        """Those of combinations of the terms, ``by`` of shape (k, j)."""
        return Normals(by.T @ self.full @ by, by.T @ self.left @ by, by.T @ self.right)

    def solved(self, weakest: float = WEAKEST) -> Solved:
        """Solve for the combinations of which the estimated parameters leave at least the share ``weakest``."""
        lengths = np.sqrt(np.diag(self.full))
        lengths[lengths == 0] = 1.0  # a term that no observation sees is dropped below
        values, vectors = np.linalg.eigh(self.left / np.outer(lengths, lengths))
        good = values > weakest
        inverse = (vectors[:, good] / values[good]) @ vectors[:, good].T / np.outer(lengths, lengths)
        found = inverse @ self.right
        return Solved(found, inverse, float(self.right @ found), int(good.sum()))


@dataclass(frozen=True)
class Beside:
    """Terms beside the estimated parameters.

    Parameters
    ----------
    rest : ndarray, shape (2 m, k)
        What these leave of the terms, whitened; x, y, x, y, ….
    length : ndarray, shape (k,)
        Of the terms before.
    change : ndarray, shape (estimated interior parameters, k)
        By how much the cameras' parameters change with a term of size 1, camera by camera in the order of their names.
    residual : ndarray, shape (2 m,)
        Whitened.
    """

    rest: np.ndarray
    length: np.ndarray
    change: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True)
class _Root:
    """With a root L of the normal matrix, N = L Lᵀ.

    Parameters
    ----------
    design : ndarray, shape (unknowns, 2 m)
        L⁻¹ Aᵀ.
    interior : ndarray, shape (interior parameters, unknowns)
        Rows of L⁻ᵀ.
    """

    design: np.ndarray
    interior: np.ndarray


class AddedTerms:
    """The estimated parameters of an adjustment, ready to be held against terms that it did not estimate.

    Parameters
    ----------
    adjustment : Adjustment

    Attributes
    ----------
    rows : ndarray of int, shape (m,)
        Observations that took part; terms are given for these.
    """

    def __init__(self, adjustment: Adjustment) -> None:
        network, state = adjustment.network, adjustment.state
        self.adjustment = adjustment
        d = derivatives(network, state)
        known = np.isfinite(adjustment.residual_px).all(axis=1)
        for part in (d.by_interior, d.by_image, d.by_point):  # at the edge of a lens it may have no inverse
            known &= np.isfinite(part).all(axis=(1, 2))
        self.rows = np.flatnonzero(adjustment.used & known)
        self._white = whitening(network.covariance_px2[self.rows]) * np.sqrt(adjustment.weight[self.rows])[:, None, None]
        self._residual = self._whitened(adjustment.residual_px[self.rows])
        self._cameras, self._points = self._designs(network, d)
        self._root: _Root | None = None
        if np.prod(self._cameras.shape) + np.prod(self._points.shape) <= SMALL:
            self._root = self._root_of(network, state)
        else:
            self._factorise(network, state)

    def test(self, terms: Any, combinations: np.ndarray | None = None) -> Terms:
        """Test terms, given by their derivatives.

        Parameters
        ----------
        terms : ndarray, shape (m, 2, k), or sparse matrix, shape (2 m, k)
            Rows of the latter: x, y, x, y, ….
        combinations : ndarray, shape (k, j), optional
            Test and estimate only these combinations of them.

        Raises
        ------
        ValueError
            If the shape does not fit.
        """
        from scipy import stats

        normals = self.normals(terms)
        if combinations is not None:
            normals = normals.combined(combinations)
        solved = normals.solved()
        k, fall = solved.rank, solved.fall
        dof = self.adjustment.dof - k
        if k == 0 or dof < 1:
            return Terms(np.zeros(len(solved.values)), np.full(solved.inverse.shape, np.nan), 0.0, 1.0, 0, float(dof), 0.0, np.nan)
        variance = max((self.adjustment.sigma0**2 * self.adjustment.dof - fall) / dof, 1e-300)
        f = fall / k / variance
        return Terms(solved.values, solved.inverse * variance, f, float(stats.f.sf(f, k, dof)), k, float(dof), fall, variance)

    def as_rows(self, terms: Any) -> Any:
        """Terms as a matrix of 2 m rows."""
        from scipy import sparse

        return terms if sparse.issparse(terms) else np.asarray(terms, float).reshape(2 * len(self.rows), -1)

    def whitened(self, terms: Any) -> Any:
        """The same, whitened."""
        from scipy import sparse

        rows = self.as_rows(terms)
        if sparse.issparse(rows):
            return self._blocks @ rows
        white = self._white
        pairs = rows.reshape(len(white), 2, -1)
        if not (white[:, 1, 0].any() or white[:, 0, 1].any()):
            return (np.einsum("nii->ni", white)[:, :, None] * pairs).reshape(rows.shape)
        return (white @ pairs).reshape(rows.shape)

    def normals(self, terms: Any) -> Normals:
        """The normal equations of terms when the estimated parameters have taken what they can; terms as of `test`."""
        white = self.whitened(terms)
        full = _dense(white.T @ white)
        return Normals(full, full - self._taken(white), np.asarray(white.T @ self._residual))

    def beside(self, terms: np.ndarray) -> Beside:
        """What the estimated parameters leave of terms, row by row, and by how much the terms change the cameras' parameters."""
        from scipy import linalg

        white = self.whitened(terms)
        if self._root is not None:
            root, white = self._root, _dense(white)
            along = root.design @ white
            return Beside(white - root.design.T @ along, np.linalg.norm(white, axis=0), -root.interior @ along, self._residual)
        by_point = self._alone_design.T @ white
        over_points = self._point_inverse @ by_point
        right = _dense(self._kept.T @ white - self._cross.T @ over_points) * self._scale[:, None]
        kept = linalg.cho_solve(self._factor, right) * self._scale[:, None]
        points = over_points - self._point_inverse @ (self._cross @ kept)
        rest = _dense(white) - self._kept @ kept - self._alone_design @ points
        return Beside(np.asarray(rest), np.linalg.norm(_dense(white), axis=0), -kept[: self._interior], np.asarray(self._residual))

    def whitened_squares(self) -> Array:
        """Weighted square of the residual of each of the rows, shape (m,)."""
        squares: Array = (self._residual.reshape(-1, 2) ** 2).sum(axis=1)
        return squares

    def _whitened(self, values: Array) -> Array:
        white: Array = np.einsum("nij,nj->ni", self._white, values)
        return white.ravel()

    def _designs(self, network: Network, d: Derivatives) -> tuple[Any, Any]:
        """Whitened derivatives by cameras and images (or the poses of a rig), and by points, as sparse matrices of 2 m rows."""
        from scipy import sparse

        rows, m = self.rows, len(self.rows)
        image, point = network.image[rows], network.point[rows]
        camera = network.camera_of[image]
        pair = 2 * np.arange(m)[:, None] + np.arange(2)  # row numbers of x and y
        self._blocks = sparse.bsr_matrix((self._white, np.arange(m), np.arange(m + 1)), shape=(2 * m, 2 * m)).tocsr()
        entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        column = 0
        for k, model in enumerate(network.cameras):
            mine = np.flatnonzero(camera == k)
            for q in np.flatnonzero(model.free):
                entries.append((pair[mine].ravel(), np.full(2 * len(mine), column), d.by_interior[rows[mine], :, q].ravel()))
                column += 1
        self._interior = column
        kinds = [*range(6), *((SCALE,) if "x_scale" in network.per_image else ()), *((SHIFT,) if "x_shift" in network.per_image else ())]
        for place, kind in enumerate(kinds):
            columns = np.repeat(column + image * len(kinds) + place, 2)
            entries.append((pair.ravel(), columns, d.by_image[rows, :, kind].ravel()))
        total = column + len(network.images) * len(kinds)
        # x-scales and x-shifts of a camera were estimated with mean 0: as observations of their sum
        seen = np.isin(np.arange(len(network.images)), image)
        by_owner = [np.flatnonzero(seen & (network.camera_of == k)) for k in range(len(network.cameras))]
        places = [place for place, kind in enumerate(kinds) if kind in (SCALE, SHIFT)]
        self._summing_to_zero = [column + images * len(kinds) + place for images in by_owner for place in places if len(images)]
        by_camera = sparse.csr_matrix(_stacked(entries), shape=(2 * m, total))
        rig = rig_of(network, self.adjustment.state.posed)
        if rig is not None:
            ties = Ties(rig, self.adjustment.state, column + np.arange(len(network.images)) * len(kinds), total)
            by_camera = (by_camera @ ties.T).tocsr()
            self._summing_to_zero = [np.searchsorted(ties.own, one) for one in self._summing_to_zero]
        by_point = np.where((network.u_xyz[point] > 0)[:, None, :], d.by_point[rows], 0.0)
        columns = np.broadcast_to(3 * point[:, None, None] + np.arange(3), by_point.shape)
        lines = np.broadcast_to(pair[:, :, None], by_point.shape)
        points = sparse.csr_matrix((by_point.ravel(), (lines.ravel(), columns.ravel())), shape=(2 * m, 3 * len(network.points)))
        return self._blocks @ by_camera, self._blocks @ points

    def _root_of(self, network: Network, state: State) -> _Root:
        """The whole system at once, of a small network."""
        from scipy import linalg

        first = self._cameras.shape[1]
        design = np.hstack([self._cameras.toarray(), self._points.toarray()])
        normal = design.T @ design
        known = np.where((network.u_xyz > 0) & np.isfinite(network.u_xyz), network.u_xyz, np.inf).ravel()
        normal[first:, first:] += np.diag(known**-2.0)
        if len(network.bars):
            normal[first:, first:] += _bar_rows(network, state, len(known)).toarray()
        diagonal = np.diag(normal).copy()
        for columns in self._summing_to_zero:
            normal[np.ix_(columns, columns)] += diagonal[columns].mean()
        seen = diagonal > 0  # not fixed points, nor images and points without observations
        scale = 1 / np.sqrt(diagonal[seen])
        normal = normal[np.ix_(seen, seen)] * np.outer(scale, scale)
        normal[np.diag_indices(len(normal))] += RIDGE
        inverse = linalg.solve_triangular(linalg.cholesky(normal, lower=True), np.diag(scale), lower=True)
        interior = np.zeros((self._interior, len(normal)))
        interior[seen[: self._interior]] = inverse[:, : int(seen[: self._interior].sum())].T
        return _Root(inverse @ design[:, seen].T, interior)

    def _factorise(self, network: Network, state: State) -> None:
        """Eliminate the points without scale bars, and factorise the reduced system."""
        from scipy import linalg, sparse

        count = 3 * len(network.points)
        known = np.where((network.u_xyz > 0) & np.isfinite(network.u_xyz), network.u_xyz, np.inf).ravel()
        in_points = (self._points.T @ self._points + sparse.diags(known**-2.0)).tocsr()
        bars = network.bars
        joined = np.repeat(np.isin(np.arange(len(network.points)), np.concatenate([bars.start, bars.end])), 3)
        if len(bars):
            in_points = in_points + _bar_rows(network, state, count)
        self._alone, self._joined = np.flatnonzero(~joined), np.flatnonzero(joined)
        alone = self._points[:, self._alone]
        self._kept = sparse.hstack([self._cameras, self._points[:, self._joined]]).tocsr()
        self._point_inverse = _inverse_of_blocks(in_points[self._alone][:, self._alone])
        self._cross = (alone.T @ self._kept).tocsr()
        self._alone_design = alone
        cross = self._cross.toarray() if self._cross.nnz > OFTEN * np.prod(self._cross.shape) else self._cross
        reduced = (self._kept.T @ self._kept).toarray() - _dense(cross.T @ (self._point_inverse @ cross))
        first = self._cameras.shape[1]
        known_joined = (in_points - self._points.T @ self._points)[self._joined][:, self._joined]
        reduced[first:, first:] += known_joined.toarray()
        for columns in self._summing_to_zero:
            reduced[np.ix_(columns, columns)] += np.diag(reduced)[columns].mean()
        diagonal = np.asarray(self._kept.multiply(self._kept).sum(axis=0)).ravel()
        diagonal[first:] += known_joined.diagonal()
        diagonal[diagonal == 0] = 1.0  # of images and points without observations
        self._scale = 1 / np.sqrt(diagonal)
        reduced *= np.outer(self._scale, self._scale)
        reduced[np.diag_indices(len(reduced))] += RIDGE
        self._factor = linalg.cho_factor(reduced, lower=True, overwrite_a=True)

    def _taken(self, white: Any) -> Array:
        """Gᵀ A (Aᵀ A)⁻ Aᵀ G."""
        from scipy import linalg

        if self._root is not None:
            along = self._root.design @ white
            return np.asarray(along.T @ along)
        by_point = self._alone_design.T @ white
        over_points = self._point_inverse @ by_point
        right = _dense(self._kept.T @ white - self._cross.T @ over_points) * self._scale[:, None]
        half = linalg.solve_triangular(self._factor[0], right, lower=True)
        taken: Array = _dense(by_point.T @ over_points) + half.T @ half
        return taken


def _dense(matrix: Any) -> np.ndarray:
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def _stacked(entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    return values, (rows, columns)


def _bar_rows(network: Network, state: State, count: int) -> Any:
    """Normal matrix of the scale bars."""
    from scipy import sparse

    bars = network.bars
    between = state.xyz[bars.end] - state.xyz[bars.start]
    unit = between / np.linalg.norm(between, axis=1, keepdims=True) / bars.u[:, None]
    good = np.isfinite(unit).all(axis=1)
    numbers = np.broadcast_to(np.arange(len(bars))[:, None], unit.shape)[good].ravel()
    design = sparse.csr_matrix((len(bars), count))
    for ends, sign in ((bars.start, -1.0), (bars.end, 1.0)):
        free = np.where(network.u_xyz[ends] > 0, sign * unit, 0.0)[good]
        design = design + sparse.csr_matrix((free.ravel(), (numbers, (3 * ends[good, None] + np.arange(3)).ravel())), shape=design.shape)
    return design.T @ design


def _inverse_of_blocks(matrix: Any) -> Any:
    """Inverse of a block-diagonal matrix of 3 × 3 blocks; fixed coordinates (zero rows) stay zero."""
    from scipy import sparse

    count = matrix.shape[0] // 3
    if count == 0:
        return matrix
    dense = np.zeros((count, 3, 3))
    entries = matrix.tocoo()
    np.add.at(dense, (entries.row // 3, entries.row % 3, entries.col % 3), entries.data)
    length = np.sqrt(np.einsum("nii->ni", dense))
    length[length == 0] = 1.0
    unit = dense / length[:, :, None] / length[:, None, :]
    inverse = np.linalg.pinv(unit, rcond=1e-12, hermitian=True) / length[:, :, None] / length[:, None, :]
    return sparse.bsr_matrix((inverse, np.arange(count), np.arange(count + 1)), shape=matrix.shape).tocsr()
