"""Lens, pixel and plate from slanted edges: what the camera's own sources put into frames is found blind, within the stated u."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from observe.edge_cameras import clean_squares, stored_picture
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.observations import Observations, SlantedEdges
from pixmetry.core.errors import MeasureError
from pixmetry.observe._edge_kernels import edge_table
from pixmetry.observe.edge_fit import fit_edges
from pixmetry.observe.edges import Picture, Search, responses_of, search_edges

LIMIT = 5.5  # u; beyond it once in 3e7
FULL: dict[str, object] = {"width_x_px": 0.9, "width_y_px": 0.9}
PLATE: dict[str, object] = {"separation_x_px": 1.0, "separation_y_px": 1.0}


def camera(sigma_px: float, plate_px: float = 0.0) -> dict[str, dict[str, object]]:
    """A Gaussian lens, pixels of 0.9 × 0.9, perhaps a plate."""
    plate: dict[str, object] = {"separation_x_px": plate_px, "separation_y_px": plate_px}
    out: dict[str, dict[str, object]] = {"optics.point_spread": {"sigma_px": sigma_px}, "sensor.pixel_aperture": FULL}
    return out | ({"optics.olpf": plate} if plate_px else {})


def found_in(picture: Picture) -> tuple[Search, SlantedEdges]:
    search = search_edges([picture])
    return search, responses_of(search, fit_edges(search.measured))


def test_lens_pixel_and_plate_are_found_together(rng: np.random.Generator):
    """20 edges of 100 px at σ/A = 0.01: plate to 0.003 px, aperture to 0.06 px, v to 0.003 px²; each source gets its own."""
    _, edges = found_in(stored_picture(rng, clean_squares(rng, camera(0.4, 1.0))))
    truth = {"spread_var_px2": 0.16 + 0.81 / 12 + 0.25, "sigma_px": 0.4, **FULL, **PLATE}
    assert len(edges.edges) == 20 and set(edges.optics.names) == set(truth) and not edges.optics.limits
    for e in edges.optics:
        assert abs(e.value - float(truth[e.name])) < LIMIT * e.u, e
    # u of the width, 0.06 px in the mean, grows steeply where chance makes the width small: 0.085 px was met in 2 of 8 draws
    most = {"spread_var_px2": 0.005, "width_x_px": 0.3, "separation_x_px": 0.004, "separation_y_px": 0.004, "sigma_px": 0.05}
    assert all(edges.optics[name].u < u for name, u in most.items())
    assert any("sigma_px" in words for words in edges.optics.confounders)
    seen = Observations(edges=edges)
    for source, names in (
        ("optics.point_spread", ["sigma_px"]),
        ("sensor.pixel_aperture", list(FULL)),
        ("optics.olpf", list(PLATE)),
    ):
        measure = get_source(source).measure
        assert measure is not None and list(measure(seen).names) == names
        with pytest.raises(MeasureError, match="slanted edges"):
            measure(Observations())


def test_a_plate_of_half_a_pixel_behind_a_soft_lens_is_only_bounded(rng: np.random.Generator):
    """It changes χ² by less than 1: no value, a limit of its size, and nothing else that excludes the truth."""
    _, edges = found_in(stored_picture(rng, clean_squares(rng, camera(0.5, 0.5))))
    optics = edges.optics
    assert {"separation_x_px", "separation_y_px"} <= optics.limits
    assert all(LIMIT * optics[name].u > 0.5 and optics[name].value < 1.0 for name in PLATE)  # a 95 % limit: one in 20 is lower
    assert abs(optics["spread_var_px2"].value - (0.25 + 0.81 / 12 + 0.0625)) < LIMIT * optics["spread_var_px2"].u
    assert all(abs(optics[name].value - 0.9) < LIMIT * optics[name].u for name in FULL if name in optics)
    assert abs(optics["sigma_px"].value - 0.5) < LIMIT * optics["sigma_px"].u < 0.25


def test_blur_hides_the_aperture(rng: np.random.Generator):
    _, edges = found_in(stored_picture(rng, clean_squares(rng, camera(0.9))))
    assert not set(FULL) & set(edges.optics.names)
    assert "hides the aperture" in edges.optics.reasons["width_x_px"]
    assert abs(edges.optics["sigma_px"].value - 0.9) < LIMIT * edges.optics["sigma_px"].u < LIMIT * 0.06
    measure = get_source("sensor.pixel_aperture").measure
    assert measure is not None
    with pytest.raises(MeasureError, match="hides the aperture"):
        measure(Observations(edges=edges))


def test_a_turned_frame_exchanges_x_and_y(rng: np.random.Generator):
    sources = camera(0.3, 1.0)
    sources["sensor.pixel_aperture"] = {"width_x_px": 0.95, "width_y_px": 0.6}
    picture = stored_picture(rng, clean_squares(rng, sources, (1, 3)))
    turned = Picture("edge", np.ascontiguousarray(picture.data.T), 1, 255.0)
    (_, one), (_, other) = found_in(picture), found_in(turned)
    assert one.optics["width_x_px"].value > one.optics["width_y_px"].value + 0.2
    for here, there in (("width_x_px", "width_y_px"), ("separation_x_px", "separation_y_px"), ("sigma_px", "sigma_px")):
        assert one.optics[here].value == pytest.approx(other.optics[there].value, abs=1e-3 * one.optics[here].u)


def test_edges_of_one_direction_tell_of_that_direction(rng: np.random.Generator):
    search = search_edges([stored_picture(rng, clean_squares(rng, camera(0.3, 1.0), (1, 3)))])
    optics = fit_edges([m for m in search.measured if m[0].across == "x"])
    assert set(optics.names) == {"spread_var_px2", "width_x_px", "separation_x_px", "sigma_px"}
    assert abs(optics["separation_x_px"].value - 1.0) < LIMIT * optics["separation_x_px"].u
    assert abs(optics["width_x_px"].value - 0.9) < LIMIT * optics["width_x_px"].u
    assert not len(fit_edges([]))


def test_another_lens_is_not_taken_for_a_gaussian(rng: np.random.Generator):
    """Diffraction at f/8 (λN = 1.28 px): v comes with the reason, and no source is said to be measured."""
    sources: dict[str, dict[str, object]] = {"optics.point_spread": {"model": "diffraction", "f_number": 8.0}}
    _, edges = found_in(stored_picture(rng, clean_squares(rng, sources, (1, 3))))
    assert edges.optics.names == ("spread_var_px2",)
    assert "diffraction" in edges.optics.reasons["spread_var_px2"]
    measure = get_source("optics.point_spread").measure
    assert measure is not None
    with pytest.raises(MeasureError, match="do not follow a Gaussian"):
        measure(Observations(edges=edges))


@pytest.mark.parametrize(("amount", "mask_px"), [(0.1, 1.0), (0.1, 0.7), (0.1, 2.0), (0.3, 1.5)])
def test_sharpening_is_not_taken_for_a_plate(amount: float, mask_px: float, rng: np.random.Generator):
    """Unsharp masking by a tenth, which looks like a plate behind pixels wider than their pitch: no source is said to be measured."""
    clean = clean_squares(rng, {"optics.point_spread": {"sigma_px": 0.5}}, (1, 3))
    noisy = clean + 1.5 * rng.standard_normal(clean.shape)
    sharpened = noisy + amount * (noisy - gaussian_filter(noisy, mask_px))
    _, edges = found_in(stored_picture(rng, sharpened, 0.0))
    v = edges.optics["spread_var_px2"]
    assert edges.optics.names == ("spread_var_px2",) and "sharpen" in v.reason
    assert abs(v.value - (0.25 + 1 / 12)) < LIMIT * v.u < LIMIT * 0.4


def test_the_spread_of_sharpened_edges_is_that_of_lens_and_pixel(rng: np.random.Generator):
    """The mask is fitted with the rest, so that v is what it was before: a Gaussian of 0.5 px and whole pixels."""
    clean = clean_squares(rng, {"optics.point_spread": {"sigma_px": 0.5}}, (1, 3))
    _, edges = found_in(stored_picture(rng, clean + 0.1 * (clean - gaussian_filter(clean, 1.0))))
    v = edges.optics["spread_var_px2"]
    assert abs(v.value - (0.25 + 1 / 12)) < LIMIT * v.u < LIMIT * 0.04


def test_the_table_is_the_convolution_and_its_derivatives_are_its_own():
    """Against the convolution written out as a mean over the boxes and images, and differences of it."""
    sigma, sides = 0.4, np.array([0.8, 0.07, 0.9, 0.1])
    out = np.empty((7, 161))
    edge_table(-4.0, 0.05, sigma, *sides, out)
    z = -4.0 + 0.05 * np.arange(161)

    def summed(sigma: float, sides: np.ndarray) -> np.ndarray:
        node, weight = np.polynomial.legendre.leggauss(24)
        total = np.zeros_like(z)
        for first in (-0.5, 0.5):
            for second in (-0.5, 0.5):
                at = z + first * sides[2] + second * sides[3]
                for n, w in zip(node, weight, strict=True):
                    for m, v in zip(node, weight, strict=True):
                        total += w * v / 16 * ndtr((at + 0.5 * n * sides[0] + 0.5 * m * sides[1]) / sigma)
        return total

    np.testing.assert_allclose(out[0], summed(sigma, sides), atol=1e-9)
    np.testing.assert_allclose(out[1][1:-1], (out[0][2:] - out[0][:-2]) / 0.1, atol=2e-3)
    step = 1e-4
    by_var = (summed(np.sqrt(sigma**2 + step), sides) - summed(np.sqrt(sigma**2 - step), sides)) / (2 * step)
    np.testing.assert_allclose(out[2], by_var, atol=1e-5)
    for k in range(4):
        change = np.zeros(4)
        change[k] = step
        np.testing.assert_allclose(out[3 + k], (summed(sigma, sides + change) - summed(sigma, sides - change)) / (2 * step), atol=1e-5)


def test_light_that_falls_to_the_corners_is_taken_off(rng: np.random.Generator):
    """12 % less in the corners: along the edges that is as large as the noise, and would look like noise that a filter correlates."""
    clean = clean_squares(rng, {"optics.point_spread": {"sigma_px": 0.4}, "sensor.pixel_aperture": {}}, cells=(2, 2))
    y, x = (np.linspace(-1, 1, n) for n in clean.shape)
    light = 1 + 0.02 * x - 0.06 * (x**2 + y[:, None] ** 2)
    search = search_edges([stored_picture(rng, clean * light)])
    assert np.median([abs(spread.along_rel) for _, spread in search.measured]) < 0.05
    found = fit_edges(search.measured)
    v = found["spread_var_px2"]
    assert "sigma_px" in found and abs(v.value - 0.4**2 - 1 / 12) < 5.5 * v.u and v.u < 0.004
