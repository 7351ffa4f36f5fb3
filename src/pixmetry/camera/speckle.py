"""Laser speckle: how alike the light of two pixels is, and what frames of a spot on a surface that moves between them tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.number import Estimates

FINE = 8  # nodes along each half of the triangle for the average over two pixels


def correlation(shift_px: np.ndarray, lambda_n_px: float) -> np.ndarray:
    """Normalised covariance of the intensity at two places so far apart: (2 J₁(πr/λN)/(πr/λN))² of a round pupil."""
    from scipy.special import j1

    v = np.pi * np.asarray(shift_px, float) / lambda_n_px
    safe = np.where(v > 1e-6, v, 1.0)
    return np.asarray(np.where(v > 1e-6, (2 * j1(safe) / safe) ** 2, 1.0))


def _separations() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of the triangular density that the separation of two points of two pixels has about that of the pixels."""
    nodes, weights = np.polynomial.legendre.leggauss(FINE)
    part = np.concatenate([0.5 * nodes - 0.5, 0.5 * nodes + 0.5])
    return part, np.concatenate([0.5 * weights, 0.5 * weights]) * (1 - np.abs(part))


def pixel_covariance(lambda_n_px: float, reach_px: int) -> np.ndarray:
    """Covariance of the light of two pixels that lie up to ``reach_px`` apart in x and y, shape (2 reach + 1,) * 2, for contrast 1.

    The covariance at points, averaged over both pixels: the average over a square is one over the triangle of their separations.
    """
    part, weight = _separations()
    steps = np.arange(-reach_px, reach_px + 1.0)
    at = (steps[:, None] + part).ravel()
    values = correlation(np.hypot(at[:, None], at), lambda_n_px).reshape(len(steps), len(part), len(steps), len(part))
    return np.einsum("ipjq,p,q->ij", values, weight, weight)


def pixel_covariance_at(lags_px: np.ndarray, lambda_n_px: float) -> np.ndarray:
    """As `pixel_covariance`, for pixels that lie so far apart, shape (n, 2) in x and y; shape (n,)."""
    part, weight = _separations()
    lags = np.asarray(lags_px, float)
    x, y = (lags[:, k, None] + part for k in (0, 1))
    values = correlation(np.hypot(x[:, :, None], y[:, None, :]), lambda_n_px)
    return np.einsum("npq,p,q->n", values, weight, weight)


@dataclass(frozen=True)
class SpeckleSpot:
    """A laser spot in frames between which the surface moved.

    Parameters
    ----------
    x_px, y_px : ndarray, shape (frames,)
        Centre of the light in each frame.
    path_x_px, path_y_px : ndarray, shape (frames,)
        Where the spot as a whole was: the mean, or a polynomial in the number of the frame.
    degree : int
        Of that polynomial; 0 where the spot stays.
    u_located_px : float
        What the noise of the pixels adds to a coordinate, rms of x and y.
    radius_px : float
        Twice the standard deviation of the mean light along an axis; of a Gaussian spot the radius of exp(−2).
    scatter_px2 : ndarray, shape (2, 2)
        Covariance of the centre from grain pattern to grain pattern; the located noise is taken off.
    predicted_px2 : ndarray, shape (2, 2) or None
        What contrast and size of the grains make of it, and the mean spot; None where these are not told.
    dof : float
        Degrees of freedom of the scatter.
    pattern_correlation : ndarray, shape (lags + 1,)
        Of the grains of frames so many apart.
    stays_rel : float
        Share of the pattern that is the same in all frames.
    effective_frames : float
        So many independent patterns leave the mean as uncertain.
    lags_px, covariance_rel, model_rel : ndarray
        Distances, shape (n, 2); relative covariance of the light of two pixels, and its model (NaN without), shape (n,).
    noise_rel : float
        Variance of the pixels' noise over the mean square of the light, part of the covariance at distance 0.
    saturated_rel : float
        Share of the spot's light that lies in pixels that reach the end of the scale in some frame.
    wavelength_nm : float or None
    left_out : int
        Frames that show no such spot.
    fit : Estimates
        ``scatter_x_px``, ``scatter_y_px``, ``contrast_rel`` and ``airy_px`` (wavelength times f-number) as far as they are told;
        ``reasons`` for the others.
    notes : tuple of str
    """

    x_px: np.ndarray
    y_px: np.ndarray
    path_x_px: np.ndarray
    path_y_px: np.ndarray
    degree: int
    u_located_px: float
    radius_px: float
    scatter_px2: np.ndarray
    predicted_px2: np.ndarray | None
    dof: float
    pattern_correlation: np.ndarray
    stays_rel: float
    effective_frames: float
    lags_px: np.ndarray
    covariance_rel: np.ndarray
    model_rel: np.ndarray
    noise_rel: float
    saturated_rel: float
    wavelength_nm: float | None
    left_out: int
    fit: Estimates
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Number of frames that show the spot."""
        return len(self.x_px)


@dataclass(frozen=True)
class SpeckleFrames:
    """What the groups of frames of a laser spot tell.

    Parameters
    ----------
    spots : tuple of SpeckleSpot
        One for each group that could be measured.
    refused : tuple of str
        Why others could not.
    fit : Estimates
        Of the spot with the most effective frames.
    wavelength_nm : float or None
        Of that spot.
    """

    spots: tuple[SpeckleSpot, ...]
    refused: tuple[str, ...]
    fit: Estimates
    wavelength_nm: float | None = None
