"""Moving targets and uneven lighting against closed forms and samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.camera.light import Light, Points
from pixmetry.core.random import Grid
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.motion import Motion
from pixmetry.scene.outlines import cross, disc, edge, ellipse, line
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes, Sine
from pixmetry.scene.uniform import Uniform

SHAPE = (40, 40)
Y, X = np.indices(SHAPE)


def frames(scene, numbers=(0,), period_s: float = 0.04, exposure_s: float = 0.01) -> np.ndarray:
    n = len(numbers)
    return scene.photons(Grid.whole(numbers, SHAPE), SHAPE, np.full(n, exposure_s), period_s * np.asarray(numbers, float)).astype(float)


def centres(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    total = images.sum(axis=(1, 2))
    return (images * X).sum(axis=(1, 2)) / total, (images * Y).sum(axis=(1, 2)) / total


@pytest.mark.parametrize(
    ("motion", "path"),
    [
        (Motion((30.0, -10.0)), lambda t, f: (30 * t, -10 * t)),
        (Motion((0.0, 5.0), (40.0, 20.0)), lambda t, f: (20 * t**2, 5 * t + 10 * t**2)),
        (Motion(amplitude_px=(1.5, 0.5), frequency_hz=7.0, phase_deg=30.0), lambda t, f: (1.5 * np.sin(14 * np.pi * t + np.pi / 6), None)),
        (Motion(table_px=np.array([[0.0, 0.0], [0.25, -0.5], [3.0, 1.0]])), lambda t, f: ([0, 0.25, 3.0][f % 3], [0, -0.5, 1.0][f % 3])),
    ],
    ids=["velocity", "acceleration", "vibration", "table"],
)
def test_a_moving_target_is_where_its_law_says_in_the_middle_of_the_exposure(motion: Motion, path) -> None:
    scene = Picture((Shapes.of([disc(17.3, 20.4, 7.0)], 0.7, motion),))
    assert scene.moving
    numbers = [0, 1, 2, 5]
    x, y = centres(frames(scene, numbers))
    for i, f in enumerate(numbers):
        t = 0.04 * f + 0.005
        dx, dy = path(t, f)
        assert x[i] == pytest.approx(17.3 + dx, abs=1e-5)
        if dy is not None:
            assert y[i] == pytest.approx(20.4 + dy, abs=1e-5)
        (told,) = scene.targets(t, f)
        assert (told["x_px"], told["y_px"]) == pytest.approx((x[i], y[i]), abs=1e-5)


def test_what_stands_still_stays() -> None:
    scene = Picture((Shapes.of([disc(10.0, 10.0, 5.0)], 0.5), Shapes.of([disc(20.0, 25.0, 5.0)], 0.5, Motion((100.0, 0.0)))))
    a, b = frames(scene, [0, 1])
    np.testing.assert_array_equal(a[:18, :18], b[:18, :18])
    assert np.abs(a - b).max() > 100


def test_an_exposure_smears_motion_to_a_box_of_variance_b2_over_12() -> None:
    speed, exposure = 200.0, 0.02
    scene = Picture((Shapes.of([disc(17.3, 20.4, 7.0)], 0.7, Motion((speed, 0.0))),))
    light = Light(scene, Grid.whole([0], SHAPE), SHAPE, np.full(1, exposure), np.zeros(1))
    nodes, weights = np.polynomial.legendre.leggauss(16)
    moments, shares = (0.5 * exposure * (1 + nodes))[None, None], (0.5 * weights)[None, None]
    smeared, sharp = light.seen_at(moments, shares).photons()[0].astype(float), light.photons()[0].astype(float)

    def spread(image: np.ndarray, axis: np.ndarray) -> float:
        middle = (image * axis).sum() / image.sum()
        return float((image * (axis - middle) ** 2).sum() / image.sum())

    b = speed * exposure
    assert spread(smeared, X) - spread(sharp, X) == pytest.approx(b**2 / 12, rel=1e-3)
    assert spread(smeared, Y) - spread(sharp, Y) == pytest.approx(0.0, abs=1e-4)
    assert centres(smeared[None])[0][0] == pytest.approx(centres(sharp[None])[0][0], abs=1e-5)


def test_a_sine_that_moves_keeps_its_phase_to_the_place() -> None:
    grating = Picture((Sine(8.0, 30.0, 10.0, 100.0, 0.5, 0.0, Motion((3.0, 4.0))),))
    moved, still = (grating.radiance(_points(X + dx, Y + dy, t)) for dx, dy, t in ((0.6, 0.8, 0.2), (0.0, 0.0, 0.0)))
    np.testing.assert_allclose(moved, still, atol=1e-9)


def _points(x, y, time_s: float) -> Points:
    x, y = np.asarray(x, float), np.asarray(y, float)
    zero = np.zeros(x.shape)
    return Points(x, y, zero + time_s, zero + 0.01, np.zeros(x.shape, np.int64), 0.0, SHAPE)


# ---- lighting -----------------------------------------------------------------------------------------------------------------------


def test_a_gradient_across_a_disc_moves_its_centre() -> None:
    """On the surface, before the blur: g R²/4. A factor on the blurred image acts on g (R²/4 + s² + 1/12): .0364 px for g = 1 %/px."""
    g, radius, blur = 0.01, 3.5, 0.7
    plain = Picture((Shapes.of([disc(20.0, 20.0, 2 * radius)], blur),))
    lit = Picture(plain.layers, lighting=Lighting("gradient", 20.0, 20.0, g))
    assert centres(frames(lit))[0][0] - 20 == pytest.approx(g * radius**2 / 4, abs=1e-5)
    assert centres(frames(plain) * (1 + g * (X - 20)))[0][0] - 20 == pytest.approx(0.03636, abs=1e-5)


def test_a_gradient_moves_a_blurred_edge_by_its_variance() -> None:
    """(1 + g x) under a blur of variance s² passes half its height where x = −g s², to first order."""
    g, blur = 0.01, 1.2
    scene = Picture((Shapes.of([edge(20.0, 20.0, 0.0, 1.0)], blur),), lighting=Lighting("gradient", 20.0, 20.0, g))
    x = 20 + np.linspace(-0.1, 0.1, 401)
    light = scene.radiance(_points(x, np.full(401, 20.0), 0.0))
    assert np.interp(0.5, light, x) - 20 == pytest.approx(-g * blur**2 / (1 + g * blur * np.sqrt(np.pi / 2)), rel=1e-3)


@pytest.mark.parametrize("blur", [0.05, 0.6])
@pytest.mark.parametrize(
    "lighting",
    [
        Lighting("gradient", 20.0, 20.0, 0.02, -0.01),
        Lighting("lambert", 18.0, 22.0, lamp_px=(60.0, -30.0, 80.0), camera_distance_px=300.0, tilt_x_deg=10.0),
        Lighting(
            "glossy",
            20.0,
            20.0,
            lamp_px=(300.0, 100.0, 500.0),
            camera_distance_px=900.0,
            tilt_x_deg=10.0,
            lobe_gain=2.0,
            lobe_exponent=30.0,
        ),
    ],
    ids=["gradient", "lambert", "glossy"],
)
def test_lit_shapes_are_the_product_on_the_surface_then_blurred_and_averaged(lighting: Lighting, blur: float) -> None:
    shapes = [ellipse(20.0, 20.0, 16.0, 9.0, 30.0, 1.0), line(9.0, 20.0, 25.0, 3.0, 100.0, 0.5), cross(30.0, 30.0, 12.0, 4.0, 10.0, 0.7)]
    scene = Picture((Shapes.of(shapes, blur), Sine(9.0, 20.0, 0.0, 0.5, 0.7, blur)), Uniform(0.2), lighting)
    sharp = Picture((Shapes.of(shapes, 0.0), Sine(9.0, 20.0, 0.0, 0.5, 0.7, 0.0)), Uniform(0.2))
    n = 20
    at = (np.arange(40 * n) + 0.5) / n - 0.5
    y, x = np.meshgrid(at, at, indexing="ij")
    fine = sharp.averaged(_points(x, y, 0.0), np.float64(1 / n), np.float64(1 / n)) * lighting.factor(x, y)
    truth = gaussian_filter(fine, blur * n, truncate=6.0).reshape(40, n, 40, n).mean(axis=(1, 3))
    inner = slice(5, -5)
    difference = (frames(scene)[0] - truth)[inner, inner]
    assert np.abs(difference).max() < 4e-4  # the factor bends a little over the blur, and the samples are 1/20 px
    assert np.abs(frames(sharp)[0] - truth)[inner, inner].max() > 0.02
    np.testing.assert_allclose(scene.averaged(_points(X, Y, 0.005), np.float64(1), np.float64(1)), frames(scene)[0], atol=1e-6)


def test_a_matt_surface_follows_the_inverse_squares() -> None:
    """A lamp at (a, 0, h) gives h / ((a − x)² + h²)^{3/2}: a relative slope of 3 a / (a² + h²) in the middle."""
    a, h = 300.0, 700.0
    lighting = Lighting("lambert", 5.0, 6.0, lamp_px=(a, 0.0, h), camera_distance_px=1e9)
    value, slope_x, slope_y = lighting.with_slopes(np.array([5.0]), np.array([6.0]))
    assert value[0] == pytest.approx(1.0)
    assert slope_x[0] == pytest.approx(3 * a / (a**2 + h**2), rel=1e-5)
    assert slope_y[0] == pytest.approx(0.0, abs=1e-9)
    facing = Lighting("lambert", lamp_px=(a, 0.0, h), camera_distance_px=1e9, relative_to="facing")
    assert facing.factor(np.zeros(1), np.zeros(1))[0] == pytest.approx(h / np.hypot(a, h))
    tilted = Lighting("lambert", lamp_px=(0.0, 0.0, h), camera_distance_px=1e9, tilt_x_deg=60.0, relative_to="facing")
    assert tilted.factor(np.zeros(1), np.zeros(1))[0] == pytest.approx(0.5)


def test_a_highlight_lies_where_the_mirror_would_show_the_lamp() -> None:
    """Lamp and camera at one height, a apart: half way between them. The lobe alone, for the matt part has its own slope."""
    a, h = 200.0, 800.0
    shiny = Lighting("glossy", lamp_px=(a, 0.0, h), camera_distance_px=h, lobe_gain=1e6, lobe_exponent=3000.0)
    x = np.linspace(50, 150, 2001)
    assert x[np.argmax(shiny.factor(x, np.zeros_like(x)))] == pytest.approx(a / 2, abs=1.0)


def test_a_retro_reflector_sends_light_back_to_the_lamp() -> None:
    """With lamp and camera an angle apart, its lobe falls as exp(−α²/2σ²), however it is tilted."""
    h, width = 2000.0, 0.5
    for tilt in (0.0, 30.0):
        for apart in (0.0, 10.0, 25.0):
            made = [
                Lighting(
                    "retro",
                    lamp_px=(0.0, apart, h),
                    camera_distance_px=h,
                    tilt_x_deg=tilt,
                    lobe_gain=gain,
                    lobe_width_deg=width,
                    relative_to="facing",
                )
                for gain in (100.0, 0.0)
            ]
            lobe, matt = (m.factor(np.zeros(1), np.zeros(1))[0] for m in made)
            alpha = np.rad2deg(np.arctan(apart / h))
            assert lobe / matt - 1 == pytest.approx(100 * np.exp(-0.5 * (alpha / width) ** 2), rel=1e-6)
