"""Aperture, pitch, affinity: sinc transfer, periodic errors in closed form, scales."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from light_scenes import MEAN, Flat, Line, Spot, camera, centroids, first_harmonic, mapped, signal_of, transfer
from pixmetry.sources.sensor.affinity import SOURCE as AFFINITY
from pixmetry.sources.sensor.affinity import Affinity
from pixmetry.sources.sensor.pixel_aperture import SOURCE as APERTURE
from pixmetry.sources.sensor.pixel_aperture import PixelAperture
from pixmetry.sources.sensor.pixel_pitch import SOURCE as PITCH
from pixmetry.sources.sensor.pixel_pitch import PixelPitch
from source_signals import stream


@pytest.mark.parametrize(("width", "f", "known"), [(1.0, 1.5, -0.21), (0.5, 1.0, 0.64), (0.5, 1.5, 0.3), (0.5, 2.0, 0.0), (0.8, 0.5, None)])
def test_the_transfer_of_an_aperture_is_a_sinc(width, f, known):
    along_x = transfer(f, 0.0, (APERTURE, PixelAperture(width_x_px=width, width_y_px=0.3)))
    along_y = transfer(0.0, f, (APERTURE, PixelAperture(width_x_px=0.3, width_y_px=width)))
    assert along_x == pytest.approx(np.sinc(width * f), abs=1e-4)
    assert along_y == pytest.approx(np.sinc(width * f), abs=1e-4)
    assert known is None or along_x.real == pytest.approx(known, abs=0.006)


@pytest.mark.parametrize(("sigma", "ratio"), [(0.2, 1.9), (0.3, 3.2), (0.4, 5.2), (0.5, 7.9), (0.6, 11.0)])
def test_a_narrow_aperture_multiplies_the_periodic_error(sigma, ratio):
    """Against pixels integrated by the error function: a = 0.4 over full fill. The light's quadrature errs by up to 2.5e-4 px."""
    phase = np.arange(16) / 16
    exact = {}
    for a in (0.4, 1.0):
        n = np.arange(21) - 10 - phase[:, None]
        pixels = stats.norm.cdf((n + a / 2) / sigma) - stats.norm.cdf((n - a / 2) / sigma)
        exact[a] = first_harmonic((pixels * n).sum(axis=1) / pixels.sum(axis=1), phase)
        assert scurve(sigma, a) == pytest.approx(exact[a], rel=0.005, abs=2.5e-4)
    assert exact[0.4] / exact[1.0] == pytest.approx(ratio, rel=0.03)


def scurve(sigma: float, width: float) -> float:
    phase = np.arange(16) / 16
    data = camera((1, 21), (APERTURE, PixelAperture(width_x_px=width))).expose(Line(10 + phase, sigma), 16).data
    return first_harmonic(centroids(data)[0] - 10 - phase, phase)


def test_an_offset_moves_the_image_the_other_way(rng: np.random.Generator):
    spot = Spot(np.array([8.0]), np.array([8.0]), sigma=1.2)
    params = PixelAperture(offset_x_px=0.2, offset_y_px=-0.1)
    x, y = centroids(camera((17, 17), (APERTURE, params)).expose(spot).data)
    assert (x[0], y[0]) == pytest.approx((7.8, 8.1), abs=1e-5)
    told = APERTURE.truth(params, signal_of(APERTURE, params, (5, 6)), stream(rng))
    assert told["shift_x_px"] == pytest.approx(np.full((5, 6), -0.2)) and told["shift_y_px"] == pytest.approx(np.full((5, 6), 0.1))


def test_the_aperture_only_costs_light_if_told_so():
    assert camera((4, 4), (APERTURE, PixelAperture(width_x_px=0.5))).expose(Flat()).data == pytest.approx(MEAN)
    assert camera((4, 4), (APERTURE, PixelAperture(width_x_px=0.5, collected_rel=0.5))).expose(Flat()).data == pytest.approx(MEAN / 2)


def test_a_scale_error_grows_with_the_distance_from_the_centre():
    """1e-4 at 376 px: 0.038 px, towards the centre where pixels are too large."""
    (x,), (y,) = mapped(PITCH, PixelPitch(error_x_rel=1e-4), [375.5 + 376], [100.0], (582, 752))
    assert x - 751.5 == pytest.approx(-0.0376, abs=1e-4)
    assert y == pytest.approx(100)


def test_rectangular_pixels_taken_as_square_squeeze_the_image():
    params = PixelPitch(error_y_rel=8.3 / 8.6 - 1)
    _, (top, bottom) = mapped(PITCH, params, [20.0, 20.0], [0.0, 82.0], (101, 41))
    assert bottom - top == pytest.approx(82 * 8.6 / 8.3)
    assert camera((8, 8), (PITCH, params)).expose(Flat()).data == pytest.approx(MEAN * 8.3 / 8.6)


def test_affinity_and_shear():
    x, y = mapped(AFFINITY, Affinity(b1=0.01, b2=0.002), [40.0, 40.0, 60.0], [30.0, 80.0, 80.0], (61, 81))
    assert x == pytest.approx([40, 40 + 0.1, 40 + 20 * 1.01 + 0.1]) and y == pytest.approx([30, 80, 80])
