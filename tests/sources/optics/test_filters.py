"""Plates and filters before the sensor: cosine transfer, quartz, transmittance against quadrature, refocus, lateral colour."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from light_scenes import MEAN, Flat, Wave, camera, mapped, transfer
from pixmetry.camera.silicon import absorption_per_um
from pixmetry.sources.optics import spectral_filter
from pixmetry.sources.optics.lateral_colour import SOURCE as COLOUR
from pixmetry.sources.optics.lateral_colour import LateralColour
from pixmetry.sources.optics.olpf import SOURCE as OLPF
from pixmetry.sources.optics.olpf import OpticalLowPass
from pixmetry.sources.optics.spectral_filter import SOURCE as FILTER
from pixmetry.sources.optics.spectral_filter import SpectralFilter


@pytest.mark.parametrize(("fx", "fy"), [(0.2, 0.0), (0.4, 0.0), (0.0, 0.6), (0.3, 0.45)])
def test_the_transfer_of_birefringent_plates_is_a_cosine(fx, fy):
    params = OpticalLowPass(separation_x_px=1.2, separation_y_px=0.7)
    expected = np.cos(np.pi * 1.2 * fx) * np.cos(np.pi * 0.7 * fy) * np.sinc(fx) * np.sinc(fy)
    assert transfer(fx, fy, (OLPF, params)) == pytest.approx(expected, abs=2e-5)


def test_a_frosted_plate_is_a_gaussian():
    expected = np.exp(-2 * (np.pi * 0.5 * 0.4) ** 2) * np.sinc(0.4)
    assert transfer(0.4, 0.0, (OLPF, OpticalLowPass(model="frosted", sigma_px=0.5))) == pytest.approx(expected, abs=1e-4)


def test_what_passes_is_the_integral_over_the_spectrum():
    """The same integral by Simpson's rule in SI units with Planck's law in full."""
    params = SpectralFilter(band="short_pass", cut_nm=650, edge_nm=40, peak_rel=0.9, temperature_k=3200, collecting_depth_um=4)
    h, c, k = 6.62607015e-34, 299792458.0, 1.380649e-23

    def seen(nm):
        wavelength = nm * 1e-9
        photons = 2 * c / wavelength**4 / np.expm1(h * c / (wavelength * k * 3200))
        return photons * (1 - np.exp(-4 * absorption_per_um(nm)))

    def passed(nm):
        return seen(nm) * 0.9 / (1 + 9 ** ((nm - 650) / 20))  # 10 % lie 20 nm from the middle

    total, through = (integrate.simpson(f(np.linspace(300, 1200, 36001)), dx=0.025) for f in (seen, passed))
    assert spectral_filter.passed(params) == pytest.approx(through / total, rel=1e-4)
    assert camera((4, 4), (FILTER, params)).expose(Flat()).data == pytest.approx(MEAN * through / total, rel=1e-4)


def test_an_infrared_filter_takes_most_of_a_red_laser_but_not_of_a_green_diode():
    laser = SpectralFilter(band="short_pass", cut_nm=650, light="laser", light_nm=670)
    diode = SpectralFilter(band="short_pass", cut_nm=650, light="led", light_nm=530, light_width_nm=30)
    assert spectral_filter.passed(laser) == pytest.approx(0.95 / (1 + 9**4), rel=0.1)
    assert spectral_filter.passed(diode) == pytest.approx(0.95, rel=1e-3)


def test_a_narrow_band_passes_its_share_of_a_wide_line():
    params = SpectralFilter(band="band_pass", cut_nm=600, width_nm=30, edge_nm=2, peak_rel=1, light="led", light_nm=600, light_width_nm=60)
    share = 2 * stats.norm.cdf(15 / (60 / 2.3548)) - 1
    assert spectral_filter.passed(params) == pytest.approx(share, abs=0.01)  # silicon's slope over the line is left


def test_a_plate_defocuses_by_its_thickness():
    """1 mm of glass of index 1.5 shifts the focus by 1/3 mm; at f/8 the disc is 41.7 µm wide, its standard deviation 10.4 µm."""
    params = SpectralFilter(plate_um=1000.0, plate_index=1.5, f_number=8.0, pitch_um=8.6)
    disc = 1000 / 3 / 8
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 64, endpoint=False), (np.arange(500) + 0.5) / 500)
    variance = np.average((radius * np.cos(angle)) ** 2, weights=radius) * (disc / 2) ** 2
    assert spectral_filter.defocus_px2(params) * 8.6**2 == pytest.approx(variance, rel=1e-4)


def test_another_light_moves_the_image_in_proportion_to_the_radius():
    """1 µm at 3.2 mm between 550 and 650 nm: 0.12 px of 8.6 µm."""
    per_nm = 1 / 3200 / 100
    x, y = mapped(COLOUR, LateralColour(scale_per_nm=per_nm, mean_nm=650), [50.0 + 372.1, 50.0], [40.0, 40.0 - 100], (81, 101))
    assert x - [422.1, 50] == pytest.approx([0.1163, 0], abs=1e-3)
    assert y - [40, -60] == pytest.approx([0, -100 * per_nm * 100], abs=1e-6)


def test_a_wide_spectrum_smears_by_half_the_radial_variance_along_each_axis():
    params = LateralColour(scale_per_nm=1e-5, std_nm=100.0)
    shape, f = (3, 801), 0.3
    seen = camera(shape, (COLOUR, params)).expose(Wave(f, 0.0, 800.0, 1.0), 1).data[0, 1, 800] / MEAN - 1
    variance = 0.5 * (400 * 1e-5 * 100) ** 2
    assert seen == pytest.approx(np.exp(-2 * np.pi**2 * variance * f**2) * np.sinc(f), abs=1e-3)
