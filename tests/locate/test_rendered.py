"""The images of the tests are right: against the law of a blurred disc, dense sub-sampling, and conservation of light."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import ncx2

from locate import rendered


@pytest.mark.parametrize(("radius", "blur"), [(1.0, 0.3), (1.0, 2.0), (3.3, 0.7), (8.0, 0.3), (12.0, 0.5), (12.0, 2.0)])
def test_disc_at_points_is_the_noncentral_chi2_law(radius, blur):
    """|x + s·n| < R for a Gaussian n has the probability F((R/s)²; 2, (|x|/s)²)."""
    at = rendered.window(0.3, -0.4, radius + 5 * blur + 2)
    rho = np.hypot(at[1][None, :] - 0.3, at[0][:, None] + 0.4)
    expected = ncx2.cdf((radius / blur) ** 2, 2, (rho / blur) ** 2)
    assert np.abs(rendered.disc(0.3, -0.4, radius, blur, at, aperture=0.0) - expected).max() < 1e-9


@pytest.mark.parametrize("aperture", [1.0, 0.6])
@pytest.mark.parametrize(("radius", "blur"), [(1.0, 0.1), (3.3, 0.7), (8.0, 0.3)])
def test_disc_over_pixels_is_the_mean_of_points(radius, blur, aperture):
    """Simpson's rule with 65 × 65 points a pixel."""
    at = rendered.window(0.2, 0.1, radius + 3)
    fine = np.linspace(-aperture / 2, aperture / 2, 65)
    weight = np.r_[1, np.tile([4, 2], 31), 4, 1] / 192
    xs, ys = (at[1][:, None] + fine).ravel(), (at[0][:, None] + fine).ravel()
    rho = np.hypot(xs[None, :] - 0.2, ys[:, None] - 0.1)
    law = np.linspace(0, rho.max() + 0.01, 20001)
    points = np.interp(rho, law, ncx2.cdf((radius / blur) ** 2, 2, (law / blur) ** 2))
    expected = np.einsum("risj,i,j->rs", points.reshape(len(at[0]), 65, len(at[1]), 65), weight, weight)
    assert np.abs(rendered.disc(0.2, 0.1, radius, blur, at, aperture=aperture) - expected).max() < 1e-5


@pytest.mark.parametrize("light_on", ["surface", "image"])
def test_turned_ellipse_under_a_light_plane_is_the_blurred_drawing(light_on):
    """A drawing with 41 points a pixel, blurred by scipy: its own error is about .001, a plane on the wrong side of the blur makes .016."""
    at, fold, blur = rendered.window(0.0, 0.0, 9), 41, 0.8
    n = len(at[0]) * fold
    grid = (np.arange(n) + 0.5) / fold - 0.5 + at[0][0]
    gx, gy = 0.03, -0.05
    u, v = grid[None, :] - 0.2, grid[:, None] + 0.3
    c, s = np.cos(np.deg2rad(25)), np.sin(np.deg2rad(25))
    drawn = (((u * c + v * s) / 5) ** 2 + ((v * c - u * s) / 2.5) ** 2 < 1).astype(float)
    plane = 1 + gx * u + gy * v

    def in_pixels(image: np.ndarray) -> np.ndarray:
        return image.reshape(len(at[0]), fold, len(at[1]), fold).mean(axis=(1, 3))

    seen = in_pixels(gaussian_filter(drawn * plane if light_on == "surface" else drawn, blur * fold, truncate=7))
    expected = seen if light_on == "surface" else seen * in_pixels(plane)
    got = rendered.ellipse(0.2, -0.3, 5, 2.5, 25, blur, at, light=(gx, gy), light_on=light_on)
    assert np.abs(got - expected).max() < 3e-3
    other = rendered.ellipse(0.2, -0.3, 5, 2.5, -25, blur, at, light=(gx, gy), light_on=light_on)
    assert np.abs(other - expected).max() > 0.3


def test_light_is_conserved_and_centred():
    at = rendered.window(0.3, 0.7, 20)
    x, y = at[1][None, :], at[0][:, None]
    for image, light in (
        (rendered.disc(0.3, 0.7, 4.2, 0.9, at), np.pi * 4.2**2),
        (rendered.ellipse(0.3, 0.7, 5.0, 2.0, 70, 0.9, at), np.pi * 10),
        (rendered.ring(0.3, 0.7, 5.0, 2.0, 0.9, at), np.pi * 21),
        (rendered.spot(0.3, 0.7, 1.3, at), 2 * np.pi * 1.3**2),
        (rendered.bar(0.3, 0.7, 33, 8, 3, 0.9, at), 24),
        (rendered.cross(0.3, 0.7, 33, 12, 3, 0.9, at), 63),
    ):
        assert image.sum() == pytest.approx(light, rel=1e-7)
        assert (image * x).sum() / light == pytest.approx(0.3, abs=1e-6)
        assert (image * y).sum() / light == pytest.approx(0.7, abs=1e-6)
    edge = rendered.edge(0.0, 0.0, 0.0, 0.8, rendered.window(0, 0, 9))
    assert edge[0].max() < 1e-6 and edge[-1].min() > 1 - 1e-6


def test_long_bar_is_the_line_of_the_same_light():
    """A narrow bar of width w and light 1 is w times the Gaussian line, over √(2π) s."""
    at = rendered.window(0, 0, 6)
    thin = rendered.bar(0.1, 0.2, 20, np.inf, 0.01, 0.8, at) / 0.01 * np.sqrt(2 * np.pi) * 0.8
    assert np.abs(thin - rendered.gaussian_line(0.1, 0.2, 20, 0.8, at)).max() < 1e-4


def test_light_on_the_image_shifts_the_centroid_by_the_blur_more():
    """⟨x²⟩ of the disc is R²/4, of its blurred image in pixels R²/4 + s² + 1/12."""
    at = rendered.window(0, 0, 15)
    for light_on, expected in (("surface", 4.0), ("image", 4.0 + 0.81 + 1 / 12)):
        image = rendered.disc(0, 0, 4.0, 0.9, at, light=(0.02, 0.0), light_on=light_on)
        assert (image * at[1]).sum() / image.sum() == pytest.approx(0.02 * expected, rel=1e-3)


def test_places_keep_their_distance(rng: np.random.Generator):
    radii = rng.uniform(3, 8, 500)
    x, y = rendered.scatter(rng, (900, 1100), radii, gap=4.0, margin=5.0)
    apart = np.hypot(x[:, None] - x, y[:, None] - y) - radii[:, None] - radii + 1e9 * np.eye(500)
    assert apart.min() >= 4.0
    assert (x - radii).min() >= 4.5 and (1099 - x - radii).min() >= 4.5 and (899 - y - radii).min() >= 4.5


def test_bound_of_a_spot_is_the_closed_form():
    """Gaussian spot in additive noise: u_x = √(2/π) σ/A for a point-sampled spot that is not too narrow."""
    at = rendered.window(0, 0, 14)
    covariance = rendered.bound(lambda p: p[2] * rendered.spot(p[0], p[1], 2.0, at, aperture=0.0), (0.1, 0.2, 100.0), 4.0)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(np.sqrt(2 / np.pi) * 2 / 100, rel=1e-4)


def test_exposure_has_the_stated_variance(rng: np.random.Generator):
    """Read noise, shot noise and rounding: 4 + .5·100 + 1/12, within 5 standard errors of a variance of 10⁵ values (2.2 %)."""
    values = rendered.expose(np.full((250, 400), 120.0), rng, read_dn=2.0, gain_dn_per_e=0.5, black_dn=20.0)
    assert values.var() == pytest.approx(54.083, rel=5 * np.sqrt(2 / 1e5))
