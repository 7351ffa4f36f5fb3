"""Scenes against integrals done another way, and the reading of scene files."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.special import erf

from pixmetry.core.errors import InputError, ParameterError
from pixmetry.core.random import Grid
from pixmetry.scene.discs import Discs
from pixmetry.scene.files import build_scene, read_scene
from pixmetry.scene.uniform import Uniform

ONE = np.array([0.01])


def render(scene, shape=(24, 24), frames=(0,)):
    n = len(frames)
    return scene.photons(Grid.whole(frames, shape), shape, np.full(n, 0.01), np.zeros(n))


def disc_by_chords(x0: float, y0: float, diameter: float, blur: float, r: int, c: int) -> float:
    """Blurred disc over one pixel, as a double integral over the sharp disc of a Gaussian integrated over the pixel."""

    def box(distance: float) -> float:
        return 0.5 * (erf((distance + 0.5) / (blur * 2**0.5)) - erf((distance - 0.5) / (blur * 2**0.5)))

    radius = diameter / 2
    value, _ = dblquad(
        lambda v, u: box(c - x0 - u) * box(r - y0 - v),
        -radius,
        radius,
        lambda u: -((radius**2 - u**2) ** 0.5),
        lambda u: (radius**2 - u**2) ** 0.5,
        epsabs=1e-8,
    )
    return value


@pytest.mark.parametrize(("diameter", "blur"), [(7.0, 0.7), (3.0, 0.3), (12.0, 1.5), (5.0, 0.1)])
def test_a_disc_is_exact_to_1e_4_of_its_peak(diameter: float, blur: float) -> None:
    image = render(Discs([11.3], [12.4], diameter, blur, 1.0))[0]
    edge = diameter / 2
    places = [(12, 11), (12, round(11.3 + edge)), (round(12.4 - edge), 11), (round(12.4 + 0.7 * edge), round(11.3 - 0.7 * edge)), (1, 1)]
    for r, c in places:
        assert image[r, c] == pytest.approx(disc_by_chords(11.3, 12.4, diameter, blur, r, c), abs=1e-4)


def test_a_disc_keeps_its_light_and_its_centre() -> None:
    image = render(Discs([11.3], [12.4], 7.0, 0.7, 1000.0))[0].astype(float)
    assert image.sum() == pytest.approx(1000 * np.pi * 3.5**2, rel=1e-5)
    y, x = np.indices(image.shape)
    assert (image * x).sum() / image.sum() == pytest.approx(11.3, abs=1e-5)
    assert (image * y).sum() / image.sum() == pytest.approx(12.4, abs=1e-5)


def test_a_window_equals_the_crop_of_the_frame() -> None:
    scene = Discs([11.3, 3.0], [12.4, 20.0], 7.0, 0.7, [500.0, 900.0], Uniform(10.0, 1e-3, -2e-3))
    whole = render(scene)[0]
    window = scene.photons(Grid([0], [5], [7], (9, 11)), (24, 24), ONE, ONE)[0]
    np.testing.assert_array_equal(window, whole[5:14, 7:18])


def test_each_frame_has_its_own_target() -> None:
    x, y = np.array([8.0, 15.25]), np.array([12.0, 10.5])
    images = render(Discs(x, y, per_frame=True), frames=(0, 1)).astype(float)
    columns = np.arange(24)
    found = (images.sum(axis=1) * columns).sum(axis=1) / images.sum(axis=(1, 2))
    np.testing.assert_allclose(found, x, atol=1e-5)


def test_light_scales_with_the_exposure_where_it_is_asked_to() -> None:
    scene = Uniform(100.0, reference_exposure_s=0.02)
    assert scene.photons(Grid.whole([0], (2, 2)), (2, 2), ONE, ONE)[0, 0, 0] == pytest.approx(50.0)
    assert Uniform(100.0).photons(Grid.whole([0], (2, 2)), (2, 2), ONE, ONE)[0, 0, 0] == pytest.approx(100.0)


def test_a_gradient_turns_about_the_middle_of_the_frame() -> None:
    image = render(Uniform(100.0, gradient_x_per_px=0.01), shape=(5, 5))[0]
    np.testing.assert_allclose(image[0], [98, 99, 100, 101, 102], rtol=1e-6)


@pytest.mark.parametrize(
    "bad", [{"diameter_px": 0.0}, {"blur_px": 0.01}, {"diameter_px": np.nan}, {"x_px": [np.nan]}, {"x_px": [1.0, 2.0]}], ids=str
)
def test_what_cannot_be_rendered_is_refused(bad) -> None:
    with pytest.raises(ParameterError, match="allowed"):
        Discs(**({"x_px": [1.0], "y_px": [1.0]} | bad))


@pytest.mark.parametrize(
    ("record", "words"),
    [
        ({}, "is empty"),
        ({"uniform": {"level_photons": -1}}, "level_photons"),
        ({"uniform": {"level": 1}}, "level_photons"),
        ({"discs": {"x_px": [1.0]}}, "differ in number"),
        ({"photon_transfer": {"brightest_photons": 10}, "discs": {"lattice_px": 40}}, "no discs"),
    ],
    ids=str,
)
def test_a_scene_that_cannot_be_used_is_refused(record, words) -> None:
    with pytest.raises(InputError, match=words):
        read_scene({"schema": "pixmetry/scene/1", **record})


def test_a_lattice_holds_all_places_within_the_pixel() -> None:
    model = read_scene({"schema": "pixmetry/scene/1", "discs": {"lattice_px": 20}})
    scene = build_scene(model, (480, 640))
    assert isinstance(scene, Discs)
    counts, _ = np.histogram(scene.x_px % 1, bins=10, range=(0, 1))
    assert scene.x_px.size == 24 * 32
    assert counts.min() > 0.05 * scene.x_px.size
