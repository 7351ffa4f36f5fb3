"""What all targets of a frame differ by from their template: the halo of a sharpening filter, rings of a lens. It is no noise.

The residuals of one target do not tell misfit from noise, and a misfit that counts as noise makes uncertainties too large. But a misfit is
alike in all targets, over the distance from their outlines, and noise is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.locate.drawn_targets import Drawn
from pixmetry.locate.noise import NoiseModel

LEAST_TARGETS = 8
STEP_PX, WIDE_PX = 0.5, 0.5  # from knot to knot of the profile, and of the noise about it
CLEAR_SIGMA = 6.0  # by which the profile's χ² must exceed that of chance
LEAST_PIXELS = 2.0  # of the usual noise, that each knot of it begins with


@dataclass(frozen=True)
class SharedShape:
    """What templates leave alike at all targets, over the distance from the outline.

    Parameters
    ----------
    knots_px, profile : ndarray
        Residual over the target's height.
    wide_px, ratio : ndarray
        Variance of what is left then, over that of the noise model.
    """

    knots_px: np.ndarray
    profile: np.ndarray
    wide_px: np.ndarray
    ratio: np.ndarray

    def without(self, one: Drawn) -> Drawn:
        """A target whose residual holds no shared part."""
        shared = one.height_dn * np.interp(one.away_px, self.knots_px, self.profile)
        return replace(one, residual=np.where(one.mask, one.residual - shared, 0.0))

    def sigma_dn(self, one: Drawn, noise: NoiseModel) -> np.ndarray:
        """Noise of each pixel of a target; shape (side, side)."""
        return np.sqrt(noise.variance_dn2(one.mean) * np.interp(one.away_px, self.wide_px, self.ratio))

    def moved(self, one: Drawn, noise: NoiseModel) -> np.ndarray:
        """By how much the shared shape moves a target at its place in the pixels: of each parameter."""
        sigma, gain, _ = one.gains(noise)
        shared = np.where(one.mask, one.height_dn * np.interp(one.away_px, self.knots_px, self.profile), 0.0)
        moved: np.ndarray = (gain * (shared / sigma)).sum(axis=(1, 2))
        return moved


def shared_shape(drawn: list[Drawn], noise: NoiseModel) -> SharedShape | None:
    """Find what templates leave alike at all targets; None with too few of them, or where it is no more than noise."""
    if len(drawn) < LEAST_TARGETS:
        return None
    away = np.concatenate([one.away_px[one.mask] for one in drawn])
    height = np.concatenate([np.full(int(one.mask.sum()), one.height_dn) for one in drawn])
    residual = np.concatenate([one.residual[one.mask] for one in drawn])
    variance = np.concatenate([noise.variance_dn2(one.mean[one.mask]) for one in drawn])
    leverage = np.concatenate([(one.gains(noise)[2] ** 2).sum(axis=0)[one.mask] for one in drawn])
    knots, basis = _hats(away, STEP_PX)
    weight = height**2 / variance
    normal = (basis.T * weight) @ basis
    normal += 1e-6 * np.trace(normal) / len(knots) * np.eye(len(knots))
    score = (basis.T * weight) @ (residual / height)
    profile = np.linalg.solve(normal, score)
    left = residual - height * (basis @ profile)
    scale = float((left**2 / variance).mean())
    if float(score @ profile) / scale < len(knots) + CLEAR_SIGMA * np.sqrt(2 * len(knots)):
        return None
    wide, coarse = _hats(away, WIDE_PX)
    weight = coarse.sum(axis=0)
    square = coarse.T @ (left**2 / variance / np.maximum(1 - leverage, 0.2))
    ratio = (square + LEAST_PIXELS * scale) / (weight + LEAST_PIXELS)
    return SharedShape(knots, profile, wide, ratio * len(away) / max(len(away) - len(knots), 1))


def _hats(away: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Knots, and the values of the piecewise linear functions that are 1 at one of them; shape (pixels, knots)."""
    knots = np.arange(np.floor(away.min() / step), np.floor(away.max() / step) + 2) * step
    at = (away - knots[0]) / step
    first = np.clip(at.astype(int), 0, len(knots) - 2)
    basis, each = np.zeros((len(away), len(knots))), np.arange(len(away))
    basis[each, first], basis[each, first + 1] = 1 - (at - first), at - first
    return knots, basis
