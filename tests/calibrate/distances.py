"""Whether the errors of an adjustment are as large as its covariance says: squared Mahalanobis distances from the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibrate.networks import Simulated
from pixmetry.calibrate.bundle.network import Adjustment, Network, ScaleBars

NOTHING_KNOWN = 1e9  # uncertainty of a bar that says nothing; the points it joins come with their joint covariance


@dataclass(frozen=True)
class Pooled:
    """A sum of squared distances, and its degrees of freedom."""

    squared: float
    dof: int

    def __add__(self, other: Pooled) -> Pooled:
        return Pooled(self.squared + other.squared, self.dof + other.dof)

    @property
    def p(self) -> float:
        """Two-sided."""
        return float(2 * min(chi2.sf(self.squared, self.dof), chi2.cdf(self.squared, self.dof)))

    def caught(self, rate: float, missed: float = 1e-3) -> tuple[float, float]:
        """Factors on all standard deviations that a test at this rate of false failures misses with a probability of ``missed``.

        With covariances f² times what they should be, the sum is that of chi-squared over f².
        """
        low, high = chi2.isf(1 - rate / 2, self.dof), chi2.isf(rate / 2, self.dof)
        return float(np.sqrt(chi2.isf(1 - missed, self.dof) / high)), float(np.sqrt(chi2.isf(missed, self.dof) / low))


def jointly(network: Network) -> Network:
    """The same network with all its points in the joint covariance."""
    seen = np.flatnonzero(np.bincount(network.point, minlength=len(network.points)) > 1)
    b, more = network.bars, len(seen) - 1
    lengths, u = np.ones(more), np.full(more, NOTHING_KNOWN)
    bars = ScaleBars(*(np.concatenate(two) for two in ((b.start, seen[:-1]), (b.end, seen[1:]), (b.length, lengths), (b.u, u))))
    return replace(network, bars=bars)


def aligned_errors(found: Adjustment, simulated: Simulated) -> np.ndarray:
    """Errors of the points, shape (points, 3), after the rigid motion of the truth that inner constraints over all points mean."""
    there = np.isfinite(found.state.xyz).all(axis=1)
    out = np.full_like(found.state.xyz, np.nan)
    here, truth = found.state.xyz[there], simulated.truth.xyz[there]
    turn = Rotation.align_vectors(here - here.mean(axis=0), truth - truth.mean(axis=0))[0]
    out[there] = here - here.mean(axis=0) - turn.apply(truth - truth.mean(axis=0))
    return out


def interior_distance(found: Adjustment, simulated: Simulated) -> Pooled:
    """Of the interior parameters of all cameras."""
    total = Pooled(0.0, 0)
    for k, camera in enumerate(found.network.cameras):
        names, C = found.interior_covariance(k)
        off = (found.state.interior[k] - simulated.truth.interior[k])[camera.free]
        total += Pooled(float(off @ np.linalg.solve(C, off)), len(names))
    return total


def points_distance(found: Adjustment, simulated: Simulated) -> Pooled:
    """Of all points jointly; the network is one of `jointly`, free but for scale bars: six combinations have no variance."""
    error = aligned_errors(found, simulated)
    some = np.flatnonzero(np.isfinite(error).all(axis=1))
    place = {name: i for i, name in enumerate(found.free_columns)}
    rows = [place[f"{found.network.points[j]}:{axis}"] for j in some for axis in "XYZ"]
    values, vectors = np.linalg.eigh(found.covariance[np.ix_(rows, rows)])
    assert values[5] < 1e-6 * values[6]
    along = vectors[:, 6:].T @ error[some].ravel()
    return Pooled(float((along**2 / values[6:]).sum()), len(rows) - 6)


def each_point(found: Adjustment, simulated: Simulated) -> np.ndarray:
    """Squared distances of the points one by one, by their own 3 × 3 covariance; three on average, and correlated."""
    error = aligned_errors(found, simulated)
    some = np.isfinite(error).all(axis=1)
    solved = np.linalg.solve(found.point_covariance[some], error[some][:, :, None])[:, :, 0]
    return (error[some] * solved).sum(axis=1)
