"""What all targets of a frame differ by from their template: the halo of a sharpening filter, rings of a lens, an echo. It is no noise.

The residuals of one target do not tell misfit from noise, and a misfit that counts as noise makes uncertainties too large. But a misfit is
alike in all targets, over the distance from their outlines and the direction, and noise is not: what half of the targets have in common
predicts the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.locate.drawn_targets import Drawn
from pixmetry.locate.noise import NoiseModel

LEAST_TARGETS = 8
STEP_PX, WIDE_PX = 0.5, 0.5  # from knot to knot of the profiles, and of the noise about them
MOST_ORDER = 4  # of the harmonics over the direction: 0 a halo, 1 an echo on one side, 2 and 4 blur along rows only
CLEAR_SIGMA = 6.0  # by which the profile's χ² must exceed that of chance
LEAST_PIXELS = 2.0  # of the usual noise, that each knot of it begins with


@dataclass(frozen=True)
class SharedShape:
    """What templates leave alike at all targets, over the distance from the outline and the direction from the centre.

    Parameters
    ----------
    knots_px : ndarray
    orders : tuple of int
        Harmonics over the direction that are there.
    profiles : ndarray
        Residual over the target's height at the knots, of the cosine and the sine of each order; of order 0 one alone.
    wide_px, ratio : ndarray
        Variance of what is left then, over that of the noise model.
    rest : list of Drawn
        The targets without what the other half of them share: what is left is nothing that they shared themselves.
    """

    knots_px: np.ndarray
    orders: tuple[int, ...]
    profiles: np.ndarray
    wide_px: np.ndarray
    ratio: np.ndarray
    rest: list[Drawn]

    def sigma_dn(self, one: Drawn, noise: NoiseModel) -> np.ndarray:
        """Noise of each pixel of a target; shape (side, side)."""
        return np.sqrt(noise.variance_dn2(one.mean) * np.interp(one.away_px, self.wide_px, self.ratio))

    def moved(self, one: Drawn, noise: NoiseModel) -> np.ndarray:
        """By how much the shared shape moves a target at its place in the pixels: of each parameter."""
        sigma, gain, _ = one.gains(noise)
        moved: np.ndarray = (gain * (_drawn_shape(one, self.knots_px, self.orders, self.profiles) / sigma)).sum(axis=(1, 2))
        return moved


def shared_shape(drawn: list[Drawn], noise: NoiseModel) -> SharedShape | None:
    """Find what templates leave alike at all targets; None with too few of them, or where it is no more than noise.

    Order by order, a harmonic is taken where its χ² is beyond chance, and where the profile of either half of the targets makes the
    residuals of the other half smaller: noise that neighbouring pixels share may pass for a profile, but not for the same one twice.
    """
    if len(drawn) < LEAST_TARGETS:
        return None
    away, turn = (np.concatenate([getattr(one, n)[one.mask] for one in drawn]) for n in ("away_px", "turn_rad"))
    height = np.concatenate([np.full(int(one.mask.sum()), one.height_dn) for one in drawn])
    residual = np.concatenate([one.residual[one.mask] for one in drawn])
    variance = np.concatenate([noise.variance_dn2(one.mean[one.mask]) for one in drawn])
    half = np.concatenate([np.full(int(one.mask.sum()), i % 2) for i, one in enumerate(drawn)])
    weight, relative = height**2 / variance, residual / height
    knots, hats = _hats(away, STEP_PX)
    orders: list[int] = []
    left = relative
    for order in range(MOST_ORDER + 1):
        basis = _waves(hats, turn, (order,))
        profile, chi2 = _fitted(basis, left, weight)
        after = left - basis @ profile
        scale = float((weight * after**2).mean())
        count = basis.shape[1]
        if chi2 / scale > count + CLEAR_SIGMA * np.sqrt(2 * count) and _predicts(basis, left, weight, half):
            orders.append(order)
            left = after
    if not orders:
        return None
    taken = tuple(orders)
    basis = _waves(hats, turn, taken)
    profiles = _fitted(basis, relative, weight)[0]
    other = [_fitted(basis[half != k], relative[half != k], weight[half != k])[0] for k in (0, 1)]
    rest = [
        replace(one, residual=np.where(one.mask, one.residual - _drawn_shape(one, knots, taken, other[i % 2]), 0.0))
        for i, one in enumerate(drawn)
    ]
    leverage = np.concatenate([(one.gains(noise)[2] ** 2).sum(axis=0)[one.mask] for one in drawn])
    square = np.concatenate([one.residual[one.mask] ** 2 for one in rest]) / variance
    wide, coarse = _hats(away, WIDE_PX)
    ratio = (coarse.T @ (square / np.maximum(1 - leverage, 0.2)) + LEAST_PIXELS * square.mean()) / (coarse.sum(axis=0) + LEAST_PIXELS)
    return SharedShape(knots, taken, profiles, wide, ratio, rest)


def _predicts(basis: np.ndarray, values: np.ndarray, weight: np.ndarray, half: np.ndarray) -> bool:
    """Whether the profile of either half makes what is left of the other half smaller."""
    for k in (0, 1):
        here, there = half == k, half != k
        shape = basis[here] @ _fitted(basis[there], values[there], weight[there])[0]
        if (weight[here] * (values[here] - shape) ** 2).sum() >= (weight[here] * values[here] ** 2).sum():
            return False
    return True


def _fitted(basis: np.ndarray, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Weighted least squares of the values by the columns of a basis, and by how much it makes χ² smaller."""
    weighted = basis * weight[:, None]
    normal = weighted.T @ basis
    normal += 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
    score = weighted.T @ values
    found = np.linalg.solve(normal, score)
    return found, float(score @ found)


def _drawn_shape(one: Drawn, knots: np.ndarray, orders: tuple[int, ...], profiles: np.ndarray) -> np.ndarray:
    """What is shared, in the pixels of one target, DN; 0 outside of its mask."""
    away, turn = one.away_px[one.mask], one.turn_rad[one.mask]
    shared = np.zeros(one.mask.shape)
    shared[one.mask] = one.height_dn * (_waves(_hats(away, STEP_PX, knots)[1], turn, orders) @ profiles)
    return shared


def _waves(hats: np.ndarray, turn: np.ndarray, orders: tuple[int, ...]) -> np.ndarray:
    """Functions of distance times the cosine and the sine of each order; of order 0 the functions alone."""
    parts = [hats * np.cos(m * turn)[:, None] for m in orders]
    parts += [hats * np.sin(m * turn)[:, None] for m in orders if m]
    return np.concatenate(parts, axis=1)


def _hats(away: np.ndarray, step: float, knots: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Knots, and the values of the piecewise linear functions that are 1 at one of them; shape (pixels, knots)."""
    if knots is None:
        knots = np.arange(np.floor(away.min() / step), np.floor(away.max() / step) + 2) * step
    at = np.clip((away - knots[0]) / step, 0, len(knots) - 1)
    first = np.minimum(at.astype(int), len(knots) - 2)
    basis, each = np.zeros((len(away), len(knots))), np.arange(len(away))
    basis[each, first], basis[each, first + 1] = 1 - (at - first), at - first
    return knots, basis
