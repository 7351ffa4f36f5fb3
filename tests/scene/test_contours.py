"""Shapes averaged over pixels against integrals done another way: chords, error functions, and 64 × 64 samples a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter
from scipy.special import erf, ndtr

from pixmetry.camera.light import Light, Points
from pixmetry.core.random import Grid
from pixmetry.scene import outlines
from pixmetry.scene.discs import Discs
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes, Sine
from pixmetry.scene.uniform import Uniform

SHAPE = (40, 40)
X0, Y0 = 19.3, 20.4


def points(x, y, blur: float = 0.0) -> Points:
    x, y = (np.array(v, float) for v in np.broadcast_arrays(x, y))
    zero = np.zeros(x.shape)
    return Points(x, y, zero, zero + 0.01, np.zeros(x.shape, np.int64), blur, SHAPE)


def image(*layers) -> np.ndarray:
    return sum(layer.render(Grid.whole([0], SHAPE), SHAPE, np.zeros(1), np.full(1, 0.01), False)[0, 0] for layer in layers)


def by_chords(spans, y_low: float, y_high: float, blur: float, r: int, c: int) -> float:
    """A shape over a pixel: the row's share of every horizontal chord, summed over the chords; ``spans(y)`` gives their ends."""

    def ramp(d: float) -> float:
        if blur == 0:
            return min(1.0, max(0.0, d + 0.5))
        a, b = (d + 0.5) / blur, (d - 0.5) / blur

        def area(z: float) -> float:
            return z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)

        return blur * (area(a) - area(b))

    def row(v: float) -> float:
        if blur == 0:
            return 1.0 if abs(v - r) < 0.5 else 0.0
        return 0.5 * (erf((v - r + 0.5) / (blur * 2**0.5)) - erf((v - r - 0.5) / (blur * 2**0.5)))

    low, high = max(y_low, r - 0.5 - 7 * blur), min(y_high, r + 0.5 + 7 * blur)
    if low >= high:
        return 0.0
    stops = sorted({min(high, max(low, v)) for v in (r - 0.5, r + 0.5, *np.linspace(low, high, 9))})
    parts = zip(stops[:-1], stops[1:], strict=True)
    total = 0.0
    for a, b in parts:
        if b > a:
            total += quad(lambda v: row(v) * sum(ramp(x2 - c) - ramp(x1 - c) for x1, x2 in spans(v)), a, b, epsabs=1e-9, limit=200)[0]
    return total


def circle_spans(radius: float):
    return lambda v: [(X0 - (radius**2 - (v - Y0) ** 2) ** 0.5, X0 + (radius**2 - (v - Y0) ** 2) ** 0.5)] if abs(v - Y0) < radius else []


def ellipse_spans(a: float, b: float, angle_deg: float):
    """Chords from the quadratic equation of the turned ellipse."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    qa, qc, qb = c * c / a**2 + s * s / b**2, s * s / a**2 + c * c / b**2, 2 * c * s * (1 / a**2 - 1 / b**2)

    def spans(v: float):
        h = v - Y0
        root = (qb * h) ** 2 - 4 * qa * (qc * h * h - 1)
        return [(X0 + (-qb * h - root**0.5) / (2 * qa), X0 + (-qb * h + root**0.5) / (2 * qa))] if root > 0 else []

    return spans, qc**-0.5 / (1 - qb**2 / (4 * qa * qc)) ** 0.5


PLACES = [(20, 19), (20, 16), (17, 19), (23, 22), (20, 23), (18, 17), (24, 19), (17, 16), (3, 3), (22, 26), (19, 12)]


@pytest.mark.parametrize("blur", [0.0, 0.02, 0.12, 0.4, 0.7, 1.5])
@pytest.mark.parametrize("name", ["disc", "small disc", "large disc", "ellipse", "ring"])
def test_round_shapes_are_exact_to_1e_4_of_the_height(name: str, blur: float) -> None:
    if name == "ellipse":
        shape = outlines.ellipse(X0, Y0, 16.0, 6.0, 20.0, 1.0)
        spans, high = ellipse_spans(8.0, 3.0, 20.0)
    elif name == "ring":
        shape, high = outlines.ring(X0, Y0, 16.0, 7.0, 1.0), 8.0

        def spans(v: float):
            (a, d), inner = circle_spans(8.0)(v)[0], circle_spans(3.5)(v)
            return [(a, inner[0][0]), (inner[0][1], d)] if inner else [(a, d)]
    else:
        radius = {"disc": 3.5, "small disc": 0.3, "large disc": 15.0}[name]
        shape, spans, high = outlines.disc(X0, Y0, 2 * radius, 1.0), circle_spans(radius), radius
    made = Shapes.of([shape], blur)
    seen = image(made)
    for r, c in PLACES:
        truth = by_chords(spans, Y0 - high, Y0 + high, blur, r, c)
        assert seen[r, c] == pytest.approx(truth, abs=1e-4), (r, c)
        if c == 19:
            scattered = made.sums(points(float(c), float(r)), np.float64(1), np.float64(1), False)[0]
            assert scattered == pytest.approx(truth, abs=1e-4)


@pytest.mark.parametrize("blur", [0.0, 0.05, 0.3, 0.7])
@pytest.mark.parametrize("angle", [0.0, 5.0, 45.0, 118.0])
def test_an_edge_is_the_integral_of_an_error_function(angle: float, blur: float) -> None:
    """Along its normal a pixel is a trapezium: the mean of a ramp over a box, with the blur a difference of its second integrals."""
    seen = image(Shapes.of([outlines.edge(X0, Y0, angle, 1.0)], blur))
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    y, x = np.indices(SHAPE)
    d = c * (x - X0) + s * (y - Y0)
    a, b = max(abs(c), 1e-3), max(abs(s), 1e-3)

    def second(z):  # of the edge spread
        if blur == 0:
            return 0.5 * np.maximum(z, 0) ** 2
        t = z / blur
        return 0.5 * blur**2 * ((t * t + 1) * ndtr(t) + t * np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi))

    truth = (second(d + (a + b) / 2) - second(d + (a - b) / 2) - second(d - (a - b) / 2) + second(d - (a + b) / 2)) / (a * b)
    np.testing.assert_allclose(seen, truth, atol=2e-6)


def sampled(inside, n: int = 64) -> np.ndarray:
    at = (np.arange(SHAPE[0] * n) + 0.5) / n - 0.5
    return inside(at[None, :], at[:, None]).astype(np.float32)


def turned(x, y, angle_deg: float):
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return c * (x - X0) + s * (y - Y0), -s * (x - X0) + c * (y - Y0)


def in_cross(x, y):
    u, v = turned(x, y, 20.0)
    return ((abs(u) <= 10) & (abs(v) <= 1.5)) | ((abs(v) <= 10) & (abs(u) <= 1.5))


def in_star(x, y):
    r, a = np.hypot(x - X0, y - Y0), (np.arctan2(y - Y0, x - X0) - np.deg2rad(3.0)) % (2 * np.pi)
    return (r <= 15) & (r >= 3) & ((a * 8 / np.pi).astype(int) % 2 == 0)


def in_bars(x, y):
    u, v = turned(x, y, 10.0)
    return (abs(v) <= 12) & (abs((u + 12.5) % 5.0 - 2.5) <= 0.75) & (abs(u) <= 12.5)


def in_disc(x, y):
    return (x - X0) ** 2 + (y - Y0) ** 2 <= 3.5**2


@pytest.mark.parametrize("blur", [0.0, 0.2])
@pytest.mark.parametrize(
    ("inside", "shapes"),
    [
        (in_disc, [outlines.disc(X0, Y0, 7.0, 1.0)]),
        (in_cross, [outlines.cross(X0, Y0, 20.0, 3.0, 20.0, 1.0)]),
        (in_star, outlines.star(X0, Y0, 30.0, 8, 6.0, 3.0, 1.0)),
        (in_bars, outlines.bars(X0, Y0, 5.0, 5, 24.0, 10.0, 0.3, 1.0)),
    ],
    ids=["disc", "cross", "star", "bars"],
)
def test_shapes_agree_with_64_samples_a_pixel_and_axis(inside, shapes, blur: float) -> None:
    """A straight side misses up to 1/128 px of a pixel's width by sampling, a few thousandths of the height."""
    fine = sampled(inside)
    fine = gaussian_filter(fine, 64 * blur, truncate=5.0) if blur else fine
    truth = fine.reshape(SHAPE[0], 64, SHAPE[1], 64).mean(axis=(1, 3))
    difference = image(Shapes.of(shapes, blur)) - truth
    assert np.abs(difference).max() < 4e-3
    assert difference.std() < 4e-4


def test_areas_and_centres_of_gravity_are_kept() -> None:
    cases = [
        (outlines.ellipse(X0, Y0, 16, 6, 20, 1.0), np.pi * 24),
        (outlines.ring(X0, Y0, 16, 7, 1.0), np.pi * (64 - 12.25)),
        (outlines.cross(X0, Y0, 20, 3, 20, 1.0), 2 * 60 - 9),
        (outlines.line(X0, Y0, 20, 0.7, 33, 1.0), 14.0),
    ]
    y, x = np.indices(SHAPE)
    for outline, area in cases:
        for blur in (0.0, 0.05, 0.8):
            seen = image(Shapes.of([outline], blur))
            assert seen.sum() == pytest.approx(area, rel=2e-6)
            if blur > 0.5:  # sharper ones are aliased by the pixels
                assert (seen * x).sum() / area == pytest.approx(X0, abs=2e-6)
                assert (seen * y).sum() / area == pytest.approx(Y0, abs=2e-6)
    star = image(Shapes.of(outlines.star(X0, Y0, 30.0, 9, 6.0, 3.0, 1.0)))
    assert star.sum() == pytest.approx(np.pi * (225 - 9) / 2, rel=1e-6)
    steps = image(Shapes.of(outlines.step_chart(X0, Y0, 5.5, [1.0, 2.0, 4.0], 2, 1.0, 7.0)))
    assert steps.sum() == pytest.approx(7 * 5.5**2, rel=1e-6)


@pytest.mark.parametrize(("period", "angle", "blur"), [(8.0, 0.0, 0.7), (5.0, 25.0, 0.4), (2.5, 70.0, 0.0)])
def test_a_sine_passes_pixel_and_blur_as_their_transfer_says(period: float, angle: float, blur: float) -> None:
    seen = image(Sine(period, angle, 40.0, 1000.0, 0.6, blur))
    n = 32
    at = (np.arange(SHAPE[0] * n) + 0.5) / n - 0.5
    u = np.cos(np.deg2rad(angle)) * at[None, :] + np.sin(np.deg2rad(angle)) * at[:, None]
    sharp = 1000 * (1 + 0.6 * np.cos(2 * np.pi * u / period + np.deg2rad(40)))
    boxed = sharp.reshape(SHAPE[0], n, SHAPE[1], n).mean(axis=(1, 3))
    truth = 1000 + (boxed - 1000) * np.exp(-2 * (np.pi * blur / period) ** 2)
    np.testing.assert_allclose(seen, truth, atol=0.3)
    nu = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))]) / period
    amplitude = 600 * np.prod(np.sinc(nu)) * np.exp(-2 * (np.pi * blur / period) ** 2)
    assert np.sqrt(2 * np.mean((seen - 1000) ** 2)) == pytest.approx(amplitude, rel=0.03)


def test_bars_have_the_fundamental_of_a_square_wave() -> None:
    seen = image(Shapes.of(outlines.bars(19.5, 19.5, 8.0, 9, 60.0, 0.0, 0.5, 1.0), 0.7))[20]
    found = 2 * abs(np.mean(seen * np.exp(-2j * np.pi * np.arange(40) / 8)))
    assert found == pytest.approx(2 / np.pi * np.sinc(1 / 8) * np.exp(-2 * (np.pi * 0.7 / 8) ** 2), rel=2e-4)


def test_a_star_has_the_local_contrast_of_its_frequency() -> None:
    """Round a circle of radius r, N sectors are ν = N / 2πr; the blur takes exp(−2π²s²ν²) of the fundamental, curvature (s/r)²."""
    star = Shapes.of(outlines.star(0.0, 0.0, 300.0, 36, 0.0, 0.0, 1.0), 1.0)
    turn = 2 * np.pi * np.arange(3600) / 3600
    for radius in (25.0, 40.0, 80.0):
        seen = star.sums(points(radius * np.cos(turn), radius * np.sin(turn)), np.float64(0), np.float64(0), False)[0]
        found = 2 * abs(np.mean(seen * np.exp(-36j * turn)))
        nu = 36 / (2 * np.pi * radius)
        assert found == pytest.approx(2 / np.pi * np.exp(-2 * (np.pi * nu) ** 2), rel=3 / radius**2 + 2e-4)


def test_a_chessboard_of_two_halves_is_an_edge_of_the_whole() -> None:
    """Neighbours meet without a seam."""
    left, right = outlines.line(10.0, 19.5, 20.0, 80.0, 0.0, 1.0), outlines.line(30.0, 19.5, 20.0, 80.0, 0.0, 1.0)
    both, one = image(Shapes.of([left, right], 0.3)), image(Shapes.of([outlines.line(20.0, 19.5, 40.0, 80.0, 0.0, 1.0)], 0.3))
    np.testing.assert_allclose(both, one, atol=1e-6)


def test_windows_and_points_equal_the_frame() -> None:
    shapes = [
        outlines.disc(11.3, 12.4, 7.0),
        outlines.edge(20.0, 20.0),
        *outlines.star(25.0, 25.0, 20.0, 9),
        outlines.cross(X0, Y0, 20, 3, 20),
    ]
    for blur in (0.0, 0.1, 0.7):
        scene = Picture((Shapes.of(shapes, blur), Sine(7.0, 30.0)), Uniform(10.0, 1e-3))
        zero, exposure = np.zeros(1), np.full(1, 0.01)
        whole = scene.photons(Grid.whole([0], SHAPE), SHAPE, exposure, zero)[0]
        window = scene.photons(Grid([0, 0], [5, 13], [7, 22], (9, 11)), SHAPE, exposure.repeat(2), zero.repeat(2))
        np.testing.assert_array_equal(window[0], whole[5:14, 7:18])
        np.testing.assert_array_equal(window[1], whole[13:22, 22:33])
        y, x = np.indices(SHAPE)
        np.testing.assert_allclose(scene.averaged(points(x, y), np.float64(1), np.float64(1)), whole, rtol=2e-6, atol=1e-3)
        some = scene.averaged(points(x[3:9, 4:7], y[3:9, 4:7]), np.float64(1), np.float64(1))
        np.testing.assert_array_equal(some, scene.averaged(points(x, y), np.float64(1), np.float64(1))[3:9, 4:7])


def test_blur_of_the_optics_adds_to_the_own() -> None:
    y, x = np.indices(SHAPE)
    shapes = [outlines.ellipse(X0, Y0, 12.0, 6.0, 20.0), outlines.cross(10.0, 30.0, 10.0, 2.0)]
    together = Shapes.of(shapes, 0.5).sums(points(x, y), np.float64(0), np.float64(0), False)
    apart = Shapes.of(shapes, 0.3).sums(points(x, y, 0.4), np.float64(0), np.float64(0), False)
    np.testing.assert_allclose(together, apart, atol=1e-9)


def test_where_nothing_is_detailed_the_light_is_constant() -> None:
    shapes = Shapes.of([outlines.ellipse(X0, Y0, 26.0, 20.0, 20.0), outlines.line(8.0, 8.0, 9.0, 2.0, 30.0)], 0.4)
    y, x = (v.astype(float) for v in np.indices(SHAPE))
    calm = ~shapes.detailed(points(x, y), np.float64(1.5))
    assert 0.2 < calm.mean() < 0.9
    middle = shapes.sums(points(x, y), np.float64(0), np.float64(0), False)[0]
    for turn in np.arange(0, 2 * np.pi, 0.7):
        near = shapes.sums(points(x + 1.5 * np.cos(turn), y + 1.5 * np.sin(turn)), np.float64(0), np.float64(0), False)[0]
        np.testing.assert_allclose(near[calm], middle[calm], atol=1e-3)  # 1e-6 of the height


@pytest.mark.parametrize("scene", ["discs", "one disc a frame", "two discs a frame"])
def test_discs_seen_at_points_are_the_discs_of_the_frames(scene: str) -> None:
    x, y = {"discs": ([11.3, 25.0], [12.4, 20.2]), "one disc a frame": ([11.3, 25.0], [12.4, 20.2])}.get(
        scene, ([[11.3, 25.0], [14.1, 9.0]], [[12.4, 20.2], [30.0, 8.0]])
    )
    discs = Discs(np.array(x), np.array(y), 7.0, 0.7, 1000.0, Uniform(50.0, 1e-3), per_frame=scene != "discs")
    grid = Grid.whole([0, 1], SHAPE)
    direct = discs.photons(grid, SHAPE, np.full(2, 0.01), np.zeros(2))
    light = Light(discs, grid, SHAPE, np.full(2, 0.01), np.zeros(2))
    # a pull that leaves everything in place makes the light ask for averages over pixels
    np.testing.assert_allclose(light.moved(lambda a, b: (a + 0.0, b + 0.0)).photons(), direct, atol=0.02)
    # and by Gauss–Legendre nodes of the point values, for a pixel
    nodes, weights = np.polynomial.legendre.leggauss(8)
    at = points(np.add.outer(nodes / 2, np.zeros(8)) + 14, np.add.outer(np.zeros(8), nodes / 2) + 12)
    mean = (discs.radiance(at) * np.outer(weights, weights)).sum() / 4
    assert mean == pytest.approx(float(direct[0, 12, 14]), abs=0.05)
    assert [t["x_px"] for t in discs.targets(0.0, 0)] == pytest.approx(np.ravel(discs.centres(np.zeros(1, int))[0]))


@pytest.mark.parametrize("blur", [0.0, 0.3])
@pytest.mark.parametrize(
    "pull",
    [
        lambda x, y: (x + 0.3, y - 0.2),
        lambda x, y: (1.03 * x, 0.97 * y),
        lambda x, y: (x - 0.01 * y, y + 0.01 * x),
        lambda x, y: (x + 1e-4 * (x - 20) ** 2, y + 1e-4 * (x - 20) * (y - 20)),
    ],
    ids=["shift", "scale", "turn", "bend"],
)
def test_sharp_shapes_through_a_coordinate_map_are_integrated_over_the_moved_pixel(pull, blur: float) -> None:
    scene = Picture((Shapes.of([outlines.edge(X0, Y0, 5.0), outlines.disc(10.2, 9.7, 7.0)], blur),), Uniform(50.0))
    light = Light(scene, Grid.whole([0], SHAPE), SHAPE, np.full(1, 0.01), np.zeros(1)).moved(pull)
    y, x = (v.astype(float) for v in np.indices(SHAPE))
    truth, n = np.zeros(SHAPE), 12
    for i in range(n):
        for j in range(n):
            u, v, half = x + (i + 0.5) / n - 0.5, y + (j + 0.5) / n - 0.5, 0.5 / n
            width, height = pull(u + half, v)[0] - pull(u - half, v)[0], pull(u, v + half)[1] - pull(u, v - half)[1]
            truth += scene.averaged(points(*pull(u, v)), width, height) / n**2
    np.testing.assert_allclose(light.photons()[0], truth, atol=0.15)


@pytest.mark.parametrize("size", [0.02, 0.25, 0.5, 1.0, 1.39, 1.6])
def test_a_few_discs_by_their_profile_are_the_discs_by_their_outline(size: float) -> None:
    """Every number of nodes, and the outline itself for boxes wider than twice the blur."""
    discs, shapes = Discs([X0], [Y0], 7.0, 0.7, 1.0), Shapes.of([outlines.disc(X0, Y0, 7.0, 1.0)], 0.7)
    y, x = np.indices(SHAPE)
    at = points(x, y)
    np.testing.assert_allclose(discs.averaged(at, size, size), shapes.sums(at, size, size, False)[0], atol=1e-4 if size > 0.6 else 4e-5)
