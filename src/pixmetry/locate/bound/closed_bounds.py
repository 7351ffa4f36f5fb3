"""Cramér–Rao bounds in closed form: limits of the exact sums over pixels for large or well sampled targets.

All are standard deviations of one coordinate in pixels. `blur_px` is the standard deviation of the target's edge or spot without the
pixel; the pixel of width a adds a²/12 to its square. Noise and amplitude are in the same unit.
"""

from __future__ import annotations

import numpy as np


def with_pixel(blur_px: float, aperture_px: float = 1.0) -> float:
    """Standard deviation of the blur and of the pixel's box together."""
    return float(np.sqrt(blur_px**2 + aperture_px**2 / 12))


def spot_shot(blur_px: float, electrons: float, aperture_px: float = 1.0) -> float:
    """A Gaussian spot in a dark surround, shot noise alone: s_a/√N."""
    return with_pixel(blur_px, aperture_px) / float(np.sqrt(electrons))


def spot_read(blur_px: float, amplitude: float, sigma: float, aperture_px: float = 1.0) -> float:
    """A Gaussian spot of peak A (before the pixel averages it), the same noise σ in every pixel: √(2/π) σ/A · (s_a/s)²."""
    return float(np.sqrt(2 / np.pi) * sigma / abs(amplitude)) * (with_pixel(blur_px, aperture_px) / blur_px) ** 2


def spot_mixed(blur_px: float, electrons: float, surround_e2: float, aperture_px: float = 1.0) -> float:
    """A Gaussian spot of N electrons on a background whose variance is ``surround_e2`` electrons² per pixel.

    Notes
    -----
    u² = s_a²/N · [1 + ∫₀¹ ln t/(1 + t/τ) dt]⁻¹ with τ = 2π s_a² B/N: K. I. Mortensen, L. S. Churchman, J. A. Spudich, H. Flyvbjerg,
    Nature Methods 7, 377 (2010), eq. 5 with B in the place of their background.
    """
    from scipy.integrate import quad

    s2 = with_pixel(blur_px, aperture_px) ** 2
    tau = 2 * np.pi * s2 * surround_e2 / electrons
    if tau == 0:
        return spot_shot(blur_px, electrons, aperture_px)
    # with t = e^(−v) the integrand is smooth
    loss = quad(lambda v: -v * np.exp(-v) / (1 + np.exp(-v) / tau), 0, np.inf, epsabs=1e-13, epsrel=1e-12)[0]
    return float(np.sqrt(s2 / electrons / (1 + loss)))


def disc_edge(radius_px: float, blur_px: float, amplitude: float, sigma_edge: float, aperture_px: float = 1.0) -> float:
    """A disc much larger than its blur, noise σ_e at half height: σ_e/A · √(4 s_a/(√π D))."""
    return float(sigma_edge / abs(amplitude) * np.sqrt(2 * with_pixel(blur_px, aperture_px) / (np.sqrt(np.pi) * radius_px)))


def ring_edge(inner_px: float, outer_px: float, blur_px: float, amplitude: float, sigma_edge: float, aperture_px: float = 1.0) -> float:
    """A ring whose edges are both far apart and large against the blur: the information of two discs."""
    return disc_edge(inner_px + outer_px, blur_px, amplitude, sigma_edge, aperture_px)


def ellipse_edge(
    semi_major_px: float,
    semi_minor_px: float,
    angle_deg: float,
    blur_px: float,
    amplitude: float,
    sigma_edge: float,
    aperture_px: float = 1.0,
) -> tuple[float, float]:
    """An ellipse much larger than its blur, for x and y: σ_e/A · √(2√π s_a) · diag((∮ n nᵀ dl)⁻¹)^½, n the contour's normal."""
    t = 2 * np.pi * (np.arange(720) + 0.5) / 720
    normal = np.stack([semi_minor_px * np.cos(t), semi_major_px * np.sin(t)])  # times dt: length dl
    length = np.hypot(semi_major_px * np.sin(t), semi_minor_px * np.cos(t))
    own = (normal[:, None] * normal[None] / length).mean(axis=-1) * 2 * np.pi
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    turn = np.array([[c, -s], [s, c]])
    inverse = np.linalg.inv(turn @ own @ turn.T)
    scale = sigma_edge / abs(amplitude) * np.sqrt(2 * np.sqrt(np.pi) * with_pixel(blur_px, aperture_px))
    return float(scale * np.sqrt(inverse[0, 0])), float(scale * np.sqrt(inverse[1, 1]))


def line_read(blur_px: float, amplitude: float, sigma: float, length_px: float, aperture_px: float = 1.0) -> float:
    """Offset of a Gaussian line of peak A (before the pixel averages it) over n rows, noise σ: σ/A · √(2s/(√π n)) · (s_a/s)^(3/2)."""
    wider = with_pixel(blur_px, aperture_px) / blur_px
    return float(sigma / abs(amplitude) * np.sqrt(2 * blur_px / (np.sqrt(np.pi) * length_px)) * wider**1.5)


def line_shot(blur_px: float, electrons_per_row: float, length_px: float, aperture_px: float = 1.0) -> float:
    """Offset of a Gaussian line in a dark surround, shot noise alone: s_a/√(N n)."""
    return with_pixel(blur_px, aperture_px) / float(np.sqrt(electrons_per_row * length_px))


def edge_read(blur_px: float, amplitude: float, sigma_edge: float, length_px: float, aperture_px: float = 1.0) -> float:
    """Offset of a straight edge of height A over n rows, noise σ_e at half height: σ_e/A · √(2√π s_a/n)."""
    return float(sigma_edge / abs(amplitude) * np.sqrt(2 * np.sqrt(np.pi) * with_pixel(blur_px, aperture_px) / length_px))
