"""Whole scenes: layers that add up, windows through every kind of optics, and the light of an exposure."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.light import Light
from pixmetry.core.random import Grid
from pixmetry.scene.discs import Discs
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.motion import Motion
from pixmetry.scene.outlines import cross, disc, edge, ring, star
from pixmetry.scene.picture import Picture
from pixmetry.scene.plates import Pose, dot_plate
from pixmetry.scene.shapes import Shapes, Sine
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

SHAPE = (60, 70)
EXPOSURE, START = np.full(1, 0.01), np.full(1, 0.08)

SHAPES = Shapes.of([edge(30.3, 20.0), disc(20.0, 40.0, 9.0), cross(50.0, 30.0, 20.0, 3.0, 11.0)], 0.1, Motion((30.0, 4.0)))
SCENES = {
    "lit and moving": Picture(
        (SHAPES, Sine(7.0, 20.0)), Uniform(50.0, 1e-3), Lighting("lambert", 30.0, 30.0, lamp_px=(300.0, 0.0, 1000.0))
    ),
    "speckle": Picture((Speckle(33.0, 28.0, 9.0, 1000.0, 1.2), Shapes.of([ring(40.0, 40.0, 20.0, 10.0)])), Uniform(5.0)),
    "star": Picture((Shapes.of(star(30.0, 30.0, 40.0, 13)),)),
    "plate": Picture((dot_plate(Pose(900.0, 34.5, 29.5, phi_deg=30.0), 5, 5, 12.0, 7.0, 1000.0, 0.6),)),
    "discs": Discs(np.array([20.2, 43.0]), np.array([20.9, 30.0])),
}
OPTICS = {
    "nothing": lambda light: light,
    "map": lambda light: light.moved(lambda x, y: (x + 0.01 * y + 1e-4 * x * x, y - 0.02 * x)),
    "blur": lambda light: light.blurred(0.2),
    "dots": lambda light: light.spread([-0.3, 0.3], [0.0, 0.2], [0.5, 0.5]),
    "kernel": lambda light: light.convolved(np.outer([1, 2, 1], [1, 3, 1])),
    "uneven blur": lambda light: light.blurred_by_place(lambda x, y: 0.01 + 1e-4 * x),
}


@pytest.mark.parametrize("optics", OPTICS)
@pytest.mark.parametrize("scene", SCENES)
def test_a_window_equals_the_crop_through_all_optics(scene: str, optics: str) -> None:
    def seen(grid: Grid) -> np.ndarray:
        return OPTICS[optics](Light(SCENES[scene], grid, SHAPE, EXPOSURE, START)).photons()[0]

    whole = seen(Grid.whole([2], SHAPE))
    np.testing.assert_array_equal(seen(Grid([2], [11], [23], (20, 31))), whole[11:31, 23:54])
    assert np.ptp(whole) > 100


@pytest.mark.parametrize("scene", SCENES)
def test_blurred_light_is_the_sharp_light_blurred(scene: str) -> None:
    """Moments of the whole: the sum stays, the variance grows by that of the blur; here on targets well inside a dark frame."""
    if scene in ("lit and moving", "discs", "plate"):
        made = Picture((Shapes.of([disc(30.0, 30.0, 9.0), cross(40.0, 28.0, 12.0, 3.0, 11.0)], 0.3),))
    else:
        made = Picture((SCENES[scene].layers[0],))
    y, x = np.indices(SHAPE)
    light = Light(made, Grid.whole([2], SHAPE), SHAPE, EXPOSURE, START)
    sharp, soft = (v.photons()[0].astype(float) for v in (light, light.blurred(0.8)))
    assert soft.sum() == pytest.approx(sharp.sum(), rel=2e-4)
    for axis in (x, y):
        middle = [(v * axis).sum() / v.sum() for v in (sharp, soft)]
        spread = [(v * (axis - m) ** 2).sum() / v.sum() for v, m in zip((sharp, soft), middle, strict=True)]
        assert middle[1] == pytest.approx(middle[0], abs=3e-3)
        assert spread[1] - spread[0] == pytest.approx(0.8, abs=0.03)


def test_layers_add_up_on_their_background() -> None:
    one, two = Shapes.of([disc(20.0, 20.0, 9.0)], 0.5), Shapes.of([disc(23.0, 20.0, 9.0, -300.0)], 0.5)
    field = Uniform(500.0, 1e-3)
    grid = Grid.whole([0], SHAPE)
    both, a, b, empty = (Picture(layers, field).photons(grid, SHAPE, EXPOSURE, START) for layers in ((one, two), (one,), (two,), ()))
    np.testing.assert_allclose(both, a + b - empty, atol=1e-3)
    np.testing.assert_array_equal(empty, field.photons(grid, SHAPE, EXPOSURE, START))
    dark = Picture((Shapes.of([disc(23.0, 20.0, 9.0, -300.0)], 0.5),), Uniform(100.0)).photons(grid, SHAPE, EXPOSURE, START)
    assert dark.min() == 0.0


def test_light_grows_with_the_exposure_where_the_field_does() -> None:
    scene = Picture((Shapes.of([disc(20.0, 20.0, 9.0)], 0.5), Sine(9.0)), Uniform(100.0, reference_exposure_s=0.01))
    grid = Grid.whole([0], SHAPE)
    short, long = (scene.photons(grid, SHAPE, EXPOSURE * k, START) for k in (1.0, 3.0))
    np.testing.assert_allclose(long, 3 * short, rtol=1e-5)
    light = Light(scene, grid, SHAPE, 3 * EXPOSURE, START).moved(lambda x, y: (x + 0.0, y + 0.0))
    np.testing.assert_allclose(light.photons(), long, rtol=1e-5, atol=1e-2)
