"""Variance components: how large the errors of x and of y of each camera are, from the residuals and their redundancy numbers.

Where image coordinates came with covariances, what they scatter beyond their own noise (aliasing, blooming, printing, compression) does not
know of that noise: it is added. The variance of an observation of a group g (an axis of a camera) with the given variance s is s + τ_g²,
with τ_g² the root of

    Σ v (P v) = Σ r   over the group (v residuals, P weights, r redundancy numbers),

which is the estimate of R. C. Paule and J. Mandel. Where residuals are smaller than the given covariances say, and where those are only
guessed, they are multiplied instead by the iterated almost unbiased estimate f_g = Σ v (P v) / Σ r (x by √f_x, y by √f_y, so that the
correlation of x and y stays). The network is adjusted again until the sums agree. Then sigma0 is 1, and what bars and control points say
stands beside the image coordinates with its right weight.

Errors that are not noise are alike within an image, so that many points tell less than their number. x and y of a camera therefore get
sizes of their own only where its images, each taken for one observation of their ratio, agree that they differ.

For normal errors the covariance of the sums over Σ r is 2 S⁻¹, with S_gh the sum of the squares of the elements of Qvv P between the
groups. Each of its rows sums up to r; what a row has beside its own diagonal element, r (1 − r), is dealt out to the groups by their
numbers of observations. Without shares u(σ)/σ were 1/√(2 Σ r).

References
----------
W. Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, AVN 86 (1979) 446–453; S. D. Horn, R. A. Horn, D. B. Duncan,
J. Amer. Stat. Assoc. 70 (1975) 380–385 (almost unbiased); R. C. Paule, J. Mandel, J. Res. Nat. Bur. Stand. 87 (1982) 377–385 (additive);
K. R. Koch, Parameter Estimation and Hypothesis Testing (1999), 3.6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.checks.snooping import Adjust, finest_factor
from pixmetry.calibrate.records import AxisComponent, CameraComponents
from pixmetry.core.arrays import Array, Ints

LEAST_DOF = 10.0  # redundancy below which a group does not get a factor of its own
LEAST_IN_IMAGE = 5.0  # redundancy of an axis in an image, for a ratio
RARE = 0.001  # level at which x and y differ
INDEPENDENT = 1e-4  # level at which ratios scatter more between images than errors do that know nothing of each other
ITERATIONS = 10
MEDIAN_SQUARE = 0.45494  # of a standard normal variable
CLOSE = 0.02  # of its standard uncertainty, that a factor may still move


@dataclass(frozen=True)
class Components:
    """Standard deviations of the groups, and the adjustment that has them as its weights.

    Parameters
    ----------
    adjustment : Adjustment
    given_px2 : ndarray, shape (n, 3)
        Covariances of the image coordinates before.
    sizes : Sizes
    group : ndarray of int, shape (cameras, 2)
        Which of x and y of the cameras have a size in common.
    dof : ndarray, shape (cameras, 2)
        Sums of redundancy numbers.
    u_factor : ndarray, shape (cameras, 2)
        Relative standard uncertainty of Σ v (P v) / Σ r.
    iterations : int
    by_axis : bool
        Whether x and y were asked for by themselves.
    """

    adjustment: Adjustment
    given_px2: np.ndarray
    sizes: Sizes
    group: np.ndarray
    dof: np.ndarray
    u_factor: np.ndarray
    iterations: int
    by_axis: bool = True

    def records(self) -> dict[str, CameraComponents]:
        """By camera."""
        network, used = self.adjustment.network, self.adjustment.used
        out = {}
        for k, camera in enumerate(network.cameras):
            rows = used & (network.camera_of[network.image] == k)
            x, y = (_record(network.covariance_px2[rows, 2 * i], self.given_px2[rows, 2 * i], self, (k, i)) for i in (0, 1))
            out[camera.name] = CameraComponents(self.iterations, bool(self.group[k, 0] == self.group[k, 1]), self.by_axis, x, y)
        return out


def _record(variance: np.ndarray, given: np.ndarray, found: Components, group: tuple[int, int]) -> AxisComponent:
    factor, added, u = float(found.sizes.factor[group]), float(found.sizes.added_px2[group]), float(found.u_factor[group])
    sigma = float(np.sqrt(np.median(variance))) if len(variance) else float("nan")
    u_added = u / float(np.mean(1 / variance)) if len(variance) else float("nan")  # what moves Σ v²/(s + τ²) by u of itself
    beyond = u_beyond = None
    if found.sizes.adds[group]:
        beyond, u_beyond = np.sqrt(added), u_added / max(2 * np.sqrt(added), np.sqrt(u_added)) if np.isfinite(u_added) else float("inf")
    return AxisComponent(
        sigma_px=sigma,
        u_sigma_px=u_added / (2 * sigma) if found.sizes.adds[group] else sigma * u / 2,
        given_px=float(np.sqrt(np.median(given))) if len(given) else float("nan"),
        beyond_px=None if beyond is None else float(beyond),
        u_beyond_px=None if u_beyond is None else float(u_beyond),
        factor=factor,
        dof=float(found.dof[group]),
        estimated=bool(found.sizes.estimated[group]),
    )


@dataclass(frozen=True)
class Sizes:
    """What makes variances of the given ones: factor × given + added, for x and y of each camera; all of shape (cameras, 2).

    Parameters
    ----------
    factor, added_px2 : ndarray
    adds : ndarray of bool
        Whether something is added; else given variances are multiplied.
    estimated : ndarray of bool
        False: too little redundancy; the size is that of all image points together.
    """

    factor: np.ndarray
    added_px2: np.ndarray
    adds: np.ndarray
    estimated: np.ndarray

    def of(self, network: Network, given_px2: np.ndarray) -> Network:
        """The network with these variances."""
        out = scaled(replace(network, covariance_px2=given_px2), self.factor)
        added = self.added_px2[network.camera_of[network.image]]
        return replace(out, covariance_px2=out.covariance_px2 + np.column_stack([added[:, 0], 0 * added[:, 0], added[:, 1]]))


def estimate_components(adjustment: Adjustment, adjust: Adjust, *, by_axis: bool = True, given_px2: np.ndarray | None = None) -> Components:
    """Estimate the components and adjust with them.

    Parameters
    ----------
    adjustment : Adjustment
        With redundancy numbers.
    adjust : callable
        `bundle.adjust`, or the same with some options chosen.
    by_axis : bool
        For x and y of each camera; else one factor for all image coordinates, whose ratios stay as they were given.
    given_px2 : ndarray, shape (n, 3), optional
        Covariances that the image coordinates came with; default: those of the adjustment.
    """
    given = adjustment.network.covariance_px2 if given_px2 is None else given_px2
    group = groups(adjustment, given) if by_axis else np.zeros((len(adjustment.network.cameras), 2), int)
    sizes, factor, dof = estimated_sizes(adjustment, given, group, adds=by_axis)
    iterations = 0
    while iterations < ITERATIONS and (np.abs(factor - 1) > CLOSE * np.sqrt(2 / np.maximum(dof, 1.0))).any():
        iterations += 1
        network = sizes.of(adjustment.network, given)
        adjustment = adjust(network, adjustment.state, used=adjustment.used, redundancy=True)
        sizes, factor, dof = estimated_sizes(adjustment, given, group, adds=by_axis)
    return Components(adjustment, given, sizes, group, dof, relative_u(adjustment, group), iterations, by_axis)


def groups(adjustment: Adjustment, given_px2: np.ndarray) -> np.ndarray:
    """Numbers of the groups that x and y of each camera belong to, shape (cameras, 2)."""
    cameras = len(adjustment.network.cameras)
    group = np.arange(2 * cameras).reshape(cameras, 2)
    common = group // 2
    variance = estimated_sizes(adjustment, given_px2, common)[0].of(adjustment.network, given_px2).covariance_px2
    differ = [_axes_differ(adjustment, variance, k) for k in range(cameras)]
    return np.where(np.array(differ)[:, None], group, group[:, :1])


def _axes_differ(adjustment: Adjustment, variance_px2: np.ndarray, camera: int) -> bool:
    """Whether x and y of a camera differ by more than these variances do, from the logarithms of their ratios, image by image.

    Where these scatter as those of independent errors do, the test takes every residual for itself; else every image (t-test).
    """
    from scipy import stats

    network, images = adjustment.network, len(adjustment.network.images)
    rows = adjustment.used & (network.camera_of[network.image] == camera)
    own = weighted_squares(adjustment)[rows] * network.covariance_px2[rows][:, [0, 2]] / variance_px2[rows][:, [0, 2]]
    r = np.nan_to_num(adjustment.redundancy_numbers[rows])
    squares, dof = (np.stack([np.bincount(network.image[rows], a[:, i], images) for i in (0, 1)], axis=1) for a in (own, r))
    good = (dof > LEAST_IN_IMAGE).all(axis=1) & (squares > 0).all(axis=1)
    if not good.any():
        return True
    ratio = np.log(squares[good, 0] / dof[good, 0] * dof[good, 1] / squares[good, 1])
    weight = 1 / (2 / dof[good]).sum(axis=1)
    mean = weight @ ratio / weight.sum()
    if good.sum() == 1 or stats.chi2.sf(weight @ (ratio - mean) ** 2, good.sum() - 1) > INDEPENDENT:
        return bool(2 * stats.norm.sf(abs(mean) * np.sqrt(weight.sum())) < RARE)
    return bool(stats.ttest_1samp(ratio, 0.0).pvalue < RARE)


def estimated_sizes(
    adjustment: Adjustment, given_px2: np.ndarray, group: np.ndarray, *, adds: bool = True
) -> tuple[Sizes, np.ndarray, np.ndarray]:
    """One step: the sizes with which the residuals, if they stayed as they are, would agree with their redundancy numbers.

    Parameters
    ----------
    adjustment : Adjustment
    given_px2 : ndarray, shape (n, 3)
    group : ndarray of int, shape (cameras, 2)
        A group with too little redundancy gets the size of all image points.
    adds : bool
        Whether anything may be added to given variances; else they are multiplied.

    Returns
    -------
    sizes : Sizes
    factor, dof : ndarray, shape (cameras, 2)
        Σ v (P v) / Σ r of the group at the weights that there are, and sums of redundancy numbers of each axis.
    """
    network, used = adjustment.network, adjustment.used
    of = group[network.camera_of[network.image[used]]]
    now, given = network.covariance_px2[used][:, [0, 2]], given_px2[used][:, [0, 2]]
    squares, r = weighted_squares(adjustment)[used] * now, np.nan_to_num(adjustment.redundancy_numbers[used])
    least, least_now = finest_factor(replace(network, covariance_px2=given_px2)), finest_factor(network)

    def size(mine: np.ndarray) -> tuple[float, float, bool, float]:
        v, s, dof = squares[mine], given[mine], float(r[mine].sum())
        if dof < LEAST_DOF or not v.sum() > 0:
            return 1.0, 0.0, False, 1.0
        ratio = max(float((v / now[mine]).sum()) / dof, least_now)
        factor = float((v / s).sum()) / dof
        if adds and network.covariance_known and factor > 1:
            return 1.0, added_variance(v, s, dof), True, ratio
        return max(factor, least), 0.0, False, ratio

    common = size(np.ones(of.shape, bool))
    found = {int(g): (mine, *size(mine)) for g in np.unique(group) for mine in [of == g]}
    enough = {g: r[mine].sum() >= LEAST_DOF and squares[mine].sum() > 0 for g, (mine, *_) in found.items()}
    chosen = [[found[g][1:] if enough[g] else common for g in row] for row in group.tolist()]
    factor, added, summed, ratio = (np.array([[one[i] for one in row] for row in chosen]) for i in range(4))
    estimated = np.array([[bool(enough[g]) for g in row] for row in group.tolist()])
    camera = network.camera_of[network.image[used]]
    dof = np.stack([np.bincount(camera, r[:, axis], minlength=len(group)) for axis in (0, 1)], axis=1)
    return Sizes(factor, added, summed.astype(bool), estimated), ratio, dof


def robust_sizes(adjustment: Adjustment, given_px2: np.ndarray) -> Sizes:
    """Variances to be added by the median of the residuals of each group, which gross errors hardly move."""
    from scipy import optimize

    network, shape = adjustment.network, (len(adjustment.network.cameras), 2)
    added = np.zeros(shape)
    share = max(adjustment.dof, 1) / max(2 * adjustment.used.sum(), 1)
    for k in range(shape[0]):
        rows = adjustment.used & (network.camera_of[network.image] == k)
        for axis in (0, 1) if rows.any() else ():
            squares, given = adjustment.residual_px[rows, axis] ** 2, given_px2[rows, 2 * axis]

            def excess(size: float, squares: Array = squares, given: Array = given) -> float:
                return float(np.median(squares / (given + size)) - share * MEDIAN_SQUARE)

            if excess(0.0) > 0:
                added[k, axis] = optimize.brentq(excess, 0.0, squares.max() / share / MEDIAN_SQUARE)
    return Sizes(np.ones(shape), added, added > 0, np.ones(shape, bool))


def same_weights(network: Network) -> Network:
    """The network with the median covariance for all image coordinates."""
    return replace(network, covariance_px2=np.broadcast_to(np.median(network.covariance_px2, axis=0), (len(network), 3)).copy())


def added_variance(squares: np.ndarray, given: np.ndarray, dof: float) -> float:
    """τ² with Σ v²/(s + τ²) = dof; 0 if what was given is enough."""
    from scipy import optimize

    def excess(added: float) -> float:
        return float((squares / (given + added)).sum()) - dof

    most = float(np.maximum(squares, 0.0).sum()) / dof
    return float(optimize.brentq(excess, 0.0, most, xtol=1e-9 * most)) if excess(0.0) > 0 else 0.0


def relative_u(adjustment: Adjustment, group: Ints) -> Array:
    """Relative standard uncertainties of Σ v (P v) / Σ r, shape (cameras, 2); inf for a group that cannot be told from the others."""
    network, used = adjustment.network, adjustment.used
    of, size = group[network.camera_of[network.image[used]]].ravel(), int(group.max()) + 1
    r = np.clip(adjustment.redundancy_numbers[used], 0.0, 1.0).ravel()
    dof, beside, count = (np.bincount(of, weights, minlength=size) for weights in (r, r * (1 - r), None))
    there = dof > 0
    shared = np.outer(beside[there], count[there]) / count.sum()
    shared = (shared + shared.T) / 2
    S = shared + np.diag(dof[there] - shared.sum(axis=1))
    u: Array = np.full(size, np.inf)
    u[there] = np.sqrt(2 * np.diag(np.linalg.inv(S))) if np.linalg.eigvalsh(S)[0] > 0 else np.inf
    return u[group]


def weighted_squares(adjustment: Adjustment) -> Array:
    """v (P v) of x and y, shape (n, 2)."""
    v, (xx, xy, yy) = adjustment.residual_px, adjustment.network.covariance_px2.T
    det = xx * yy - xy**2
    squares: Array = np.column_stack([v[:, 0] * (yy * v[:, 0] - xy * v[:, 1]), v[:, 1] * (xx * v[:, 1] - xy * v[:, 0])]) / det[:, None]
    return squares


def scaled(network: Network, factor: np.ndarray) -> Network:
    """The network with variances of x and y multiplied by factors, shape (cameras, 2); their correlation stays."""
    f = factor[network.camera_of[network.image]]
    by = np.column_stack([f[:, 0], np.sqrt(f[:, 0] * f[:, 1]), f[:, 1]])
    return replace(network, covariance_px2=network.covariance_px2 * by)


def image_sigma0(adjustment: Adjustment) -> tuple[float, float]:
    """sigma0 and redundancy of the image coordinates alone, without bars and control points."""
    used = adjustment.used
    dof = float(np.nansum(adjustment.redundancy_numbers[used]))
    return float(np.sqrt(weighted_squares(adjustment)[used].sum() / max(dof, 1e-12))), dof
