"""Data snooping: each image point is tested, as a pair (x, y), for a gross error that the rest of the network does not share.

With the residual v of an image point, its a priori covariance Q (a factor sigma0² short) and the cofactors Qvv of the residual, the test is

    T = vᵀ Qvv⁻¹ v / sigma0²,   and the estimated error is Q Qvv⁻¹ v = R⁻¹ v   (R: its redundancy numbers as a matrix).

sigma0 comes from the same residuals, so that T/f of a good point has a beta distribution (Pope's τ, for two coordinates in closed form):
P(T > t) = (1 − t/f)^((f − 2)/2) with f the redundancy of the network. For a point that is already out, v is an error of prediction, sigma0
does not hold it, and P(T > t) = (1 + t/f)^(−f/2). In directions with almost no redundancy nothing can be found, and nothing is tested.

References
----------
W. Baarda, A testing procedure for use in geodetic networks (1968); A. J. Pope, The statistics of residuals and the detection of outliers
(1976); W. Förstner, B. Wrobel, Photogrammetric Computer Vision (2016), 4.6 (several observations at once).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.checks.few_rays import Mended, mend
from pixmetry.calibrate.records import GrossError
from pixmetry.core.arrays import Flags

LEAST_REDUNDANCY = 0.01  # below it, in a direction, an error of an image point would not show in its residual
FINEST_PX = 1e-4  # no image coordinate is better: what lies below is no error, and weights stay within what numbers hold
KEPT = 0.5  # part of the points of an image, and of the images of a point, that the robust pass leaves at least
ROBUST_SHARE = 0.6  # redundancy over observations from which on the spread of the middle half is taken for that of all
MEDIAN = 2 * np.log(2)  # of χ² with two degrees of freedom
SWAPPED_PX = 3.0  # as near, two image points lie where the other one should be, if their names are exchanged
PASSES = 30
RETURNS = 5
Adjust = Callable[..., Adjustment]


@dataclass(frozen=True)
class Rejected:
    """What image points were rejected for, at that time; NaN: not rejected, or back again. Written to as points go and come.

    Where a point is left with one ray, neither can be tested any more, and this is all that is known.

    Parameters
    ----------
    statistic, critical : ndarray, shape (n,)
    residual_px, error_px : ndarray, shape (n, 2)
    """

    statistic: np.ndarray
    critical: np.ndarray
    residual_px: np.ndarray
    error_px: np.ndarray

    @classmethod
    def none(cls, n: int) -> Rejected:
        """Nothing was rejected."""
        return cls(np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2), np.nan), np.full((n, 2), np.nan))

    def note(self, rows: np.ndarray, **values: Any) -> None:
        """Remember values of some rows; their names are those of the fields, and they are given for all rows."""
        for name, value in values.items():
            getattr(self, name)[rows] = np.broadcast_to(value, getattr(self, name).shape)[rows]

    def forget(self, rows: np.ndarray) -> None:
        """These rows take part again."""
        self.note(rows, **{f.name: np.nan for f in fields(self)})


@dataclass(frozen=True)
class Snooped:
    """An adjustment without the gross errors that were found.

    Parameters
    ----------
    adjustment : Adjustment
    alpha : float
        Level of each test.
    rejected : Rejected
    """

    adjustment: Adjustment
    alpha: float
    rejected: Rejected


def statistics(adjustment: Adjustment) -> tuple[np.ndarray, np.ndarray]:
    """Test statistics T and estimated errors of all image points.

    Returns
    -------
    statistic : ndarray, shape (n,)
        NaN: not determined. In units of ``sigma0``.
    error_px : ndarray, shape (n, 2)
        Of a point that took part R⁻¹ v, of another one its residual; 0 in directions without redundancy.
    """
    root = _roots(adjustment.network.covariance_px2)
    inverse = np.linalg.inv(root)
    white = (inverse @ adjustment.residual_px[:, :, None])[:, :, 0]
    cofactor = inverse @ _matrices(adjustment.residual_cofactors_px2) @ inverse.swapaxes(1, 2)
    good = np.isfinite(white).all(axis=1) & np.isfinite(cofactor).all(axis=(1, 2))
    share, axes = np.linalg.eigh(np.where(good[:, None, None], cofactor, np.eye(2)))
    along = np.einsum("nji,nj->ni", axes, np.where(good[:, None], white, 0.0))
    scaled = np.where(share > LEAST_REDUNDANCY, along / np.maximum(share, LEAST_REDUNDANCY), 0.0)
    variance = max(adjustment.sigma0**2, finest_factor(adjustment.network))
    statistic = np.where(good, (scaled * along).sum(axis=1) / variance, np.nan)
    error = (root @ np.einsum("nij,nj->ni", axes, scaled)[:, :, None])[:, :, 0]
    error = np.where(adjustment.used[:, None], error, adjustment.residual_px)
    return statistic, np.where(good[:, None], error, np.nan)


def critical_values(alpha: float, dof: int) -> tuple[float, float]:
    """Critical values of T for a point that takes part, and for one that does not (see the head of this module)."""
    if dof < 1:
        return np.inf, np.inf
    inside = dof * (1 - alpha ** (2 / (dof - 2))) if dof > 2 else np.inf
    return inside, dof * (alpha ** (-2 / dof) - 1)


def finest_factor(network: Network) -> float:
    """Variance factor of the best image coordinates that there can be."""
    return FINEST_PX**2 / float(network.covariance_px2[:, [0, 2]].mean())


def remove_gross_errors(
    network: Network,
    start: State,
    adjust: Adjust,
    *,
    used: np.ndarray | None = None,
    loss: str = "huber",
    loss_scale: float = 2.5,
    false_alarms: float = 0.01,
    rejected: Rejected | None = None,
) -> Snooped:
    """Adjust, and leave out image points with gross errors.

    First a robust adjustment shows the large ones. Then, by least squares, at most one of each image and one of each object point is
    rejected at a time, the worst first, until none is left to reject; in the end those come back that pass the test after all, and of
    points of few rays those that agree with each other (`pixmetry.calibrate.checks.few_rays`).

    Parameters
    ----------
    network : Network
    start : State
    adjust : callable
        `bundle.adjust`, or the same with some options chosen.
    used : ndarray of bool, shape (n,), optional
        Image points to begin with; the others can come back.
    loss, loss_scale
        Of the robust adjustment; ``"none"``: without it.
    false_alarms : float
        Good image points that may be expected to be rejected; the level of each test is this over their number.
    rejected : Rejected, optional
        Of earlier searches in the same image points; it is gone on with.
    """
    used = np.ones(len(network), bool) if used is None else used.copy()
    rejected = rejected or Rejected.none(len(network))
    rejected.forget(used)
    alpha = false_alarms / max(len(network), 1)
    state = start
    if loss != "none":
        robust = adjust(network, start, loss=loss, loss_scale=loss_scale, used=used, covariance=False)
        used, state = _without_large(robust, alpha, rejected), robust.state
    adjustment = _reject(network, state, adjust, used, alpha, rejected)
    barred, chosen = np.zeros(len(network), bool), np.zeros(len(network.points), bool)
    for _ in range(RETURNS):
        back = _passing(adjustment, alpha) & ~barred
        barred |= back  # whoever is rejected a second time stays out,
        rejected.forget(back)
        mended = _mended(adjustment, adjustment.used | back, ~chosen, alpha, rejected)
        chosen[mended.points] = True  # and no point's rays are chosen a second time
        if (mended.used == adjustment.used).all():
            break
        adjustment = _reject(network, replace(adjustment.state, xyz=mended.xyz), adjust, mended.used, alpha, rejected)
    return Snooped(adjustment, alpha, rejected)


def gross_error_records(adjustment: Adjustment, alpha: float, rejected: Rejected | None = None) -> tuple[GrossError, ...]:
    """The image points that are out, largest statistic first.

    Where nothing can be tested any more, for a point has too few rays left, the values are those of the time of rejection.
    """
    network = adjustment.network
    statistic, error = statistics(adjustment)
    residual, critical = adjustment.residual_px, np.full(len(network), critical_values(alpha, adjustment.dof)[1])
    if rejected is not None:
        then = ~np.isfinite(statistic)
        statistic, critical = np.where(then, rejected.statistic, statistic), np.where(then, rejected.critical, critical)
        residual, error = (np.where(then[:, None], old, new) for old, new in ((rejected.residual_px, residual), (rejected.error_px, error)))
    out = np.flatnonzero(~adjustment.used & np.isfinite(statistic))
    swapped = _swapped(network, out, residual)
    return tuple(
        GrossError(
            network.images[network.image[i]],
            network.points[network.point[i]],
            float(residual[i, 0]),
            float(residual[i, 1]),
            float(error[i, 0]),
            float(error[i, 1]),
            float(statistic[i]),
            float(critical[i]),
            network.points[network.point[swapped[i]]] if i in swapped else None,
        )
        for i in out[np.argsort(-statistic[out])]
    )


def _swapped(network: Network, out: np.ndarray, residual_px: np.ndarray) -> dict[int, int]:
    """Pairs of rejected rows, both ways, each of which was measured where the other one should be."""
    from scipy.spatial import KDTree

    measured, pairs = np.column_stack([network.x_px, network.y_px]), {}
    for image in np.unique(network.image[out]):
        rows = out[network.image[out] == image]
        nearest = KDTree((measured - residual_px)[rows]).query(measured[rows], distance_upper_bound=SWAPPED_PX)[1]
        for i, j in enumerate(nearest):
            if i != j < len(rows) and nearest[j] == i:
                pairs[int(rows[i])] = int(rows[j])
    return pairs


def _reject(network: Network, state: State, adjust: Adjust, used: np.ndarray, alpha: float, rejected: Rejected) -> Adjustment:
    done, worst = 0, np.zeros(1, int)
    while len(worst) and done < PASSES:
        done += 1
        adjustment = adjust(network, state, used=used, redundancy=True)
        statistic, error = statistics(adjustment)
        inside, _ = critical_values(alpha, adjustment.dof)
        worst = _one_each(network, np.where(adjustment.used, statistic, 0.0), inside)
        used, state = adjustment.used.copy(), adjustment.state
        if done < PASSES:
            used[worst] = False
            rejected.note(worst, statistic=statistic, critical=inside, residual_px=adjustment.residual_px, error_px=error)
    return adjustment


def _passing(adjustment: Adjustment, alpha: float) -> Flags:
    statistic, _ = statistics(adjustment)
    small: Flags = np.nan_to_num(statistic, nan=np.inf) <= critical_values(alpha, adjustment.dof)[1]
    return ~adjustment.used & small


def _mended(adjustment: Adjustment, used: np.ndarray, allowed: np.ndarray, alpha: float, rejected: Rejected) -> Mended:
    """Points of few rays that lost some, with those of their rays that agree, and what the others are rejected for."""
    network, critical = adjustment.network, critical_values(alpha, adjustment.dof)[1]
    variance = max(adjustment.sigma0**2, finest_factor(network))
    mended = mend(adjustment, used, allowed, variance, critical, alpha * len(network))
    rejected.forget(np.isin(network.point, mended.points))
    out = np.isfinite(mended.statistic)
    rejected.note(out, statistic=mended.statistic, critical=critical, residual_px=mended.residual_px, error_px=mended.residual_px)
    return mended


def _one_each(network: Network, statistic: np.ndarray, critical: float) -> np.ndarray:
    """Rows above the critical value, largest first, no two of one image or of one point."""
    images, points, rows = set(), set(), []
    above = np.flatnonzero(np.nan_to_num(statistic) > critical)
    for i in above[np.argsort(-statistic[above])]:
        if network.image[i] not in images and network.point[i] not in points:
            rows.append(i)
            images.add(network.image[i])
            points.add(network.point[i])
    return np.array(rows, int)


def _without_large(robust: Adjustment, alpha: float, rejected: Rejected) -> np.ndarray:
    """Which image points stay after a robust adjustment: those within the critical value."""
    network, used = robust.network, robust.used.copy()
    white = (np.linalg.inv(_roots(network.covariance_px2)) @ robust.residual_px[:, :, None])[:, :, 0]
    square = np.where(used, (white**2).sum(axis=1), 0.0)
    share = robust.dof / max(2 * used.sum(), 1)
    # the middle half tells nothing where a robust loss can satisfy half of the observations at the cost of the others
    variance = float(np.median(square[used])) / MEDIAN / share if share > ROBUST_SHARE else robust.sigma0**2
    left = np.bincount(network.image[used], minlength=len(network.images)), np.bincount(network.point[used], minlength=len(network.points))
    least = [np.ceil(KEPT * count) for count in left]
    variance, critical = max(variance, finest_factor(network)), -2 * np.log(alpha)
    above = np.flatnonzero(square > critical * variance)
    for i in above[np.argsort(-square[above])]:
        j, k = network.image[i], network.point[i]
        if left[0][j] > least[0][j] and left[1][k] > least[1][k]:
            used[i] = False
            left[0][j] -= 1
            left[1][k] -= 1
    out = robust.used & ~used
    rejected.note(out, statistic=square / variance, critical=critical, residual_px=robust.residual_px, error_px=robust.residual_px)
    return used


def _matrices(triples: np.ndarray) -> np.ndarray:
    """Symmetric matrices, shape (n, 2, 2), from var x, cov xy, var y."""
    return triples[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def _roots(triples: np.ndarray) -> np.ndarray:
    """Cholesky factors of covariances."""
    return np.linalg.cholesky(_matrices(triples))
