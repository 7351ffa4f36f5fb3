"""Point spreads: transfer functions in closed form, the periodic error of a point, coma's centre, a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.special import ndtr

from light_scenes import Line, Spot, camera, centroids, first_harmonic, transfer
from pixmetry.camera.light import Points
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid
from pixmetry.sources.optics import point_spread
from pixmetry.sources.optics.point_spread import SOURCE, PointSpread
from pixmetry.sources.sensor.pixel_aperture import SOURCE as APERTURE
from pixmetry.sources.sensor.pixel_aperture import PixelAperture


def clear(f: np.ndarray, wavelength_um: float, f_number: float, pitch_um: float) -> np.ndarray:
    s = np.minimum(f * wavelength_um * f_number / pitch_um, 1)
    return 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))


@pytest.mark.parametrize("f", [0.1, 0.3, 0.5, 0.8])
def test_a_gaussian_has_a_gaussian_transfer(f):
    h = transfer(f, 0.0, (SOURCE, PointSpread(sigma_px=0.4)))
    assert h == pytest.approx(np.exp(-2 * (np.pi * 0.4 * f) ** 2) * np.sinc(f), abs=2e-5)


def test_the_transfer_of_a_clear_pupil_is_known():
    """f/4, 550 nm, 3.45 µm: 0.247 at one cycle per pixel."""
    f = np.linspace(0, 1.7, 18)
    got = point_spread.transfer(PointSpread(model="diffraction"), f * 0.6, f * 0.8)
    assert np.abs(got - clear(f, 0.55, 4.0, 3.45)).max() < 1e-10
    assert got[0] == pytest.approx(1)
    assert clear(np.array([1.0]), 0.55, 4.0, 3.45)[0] == pytest.approx(0.247, abs=5e-4)


def test_the_transfer_of_an_aberrated_pupil_is_that_of_a_brute_force_pupil():
    """Autocorrelation of the pupil function on a raster, by FFT: another way to the same integral."""
    even = {"defocus_waves": 0.2, "astigmatism_waves": 0.1, "oblique_astigmatism_waves": -0.07, "spherical_waves": 0.1}
    params = PointSpread(model="diffraction", coma_x_waves=0.15, **even)
    n = 256
    x = (np.arange(2 * n) - n + 0.5) / (n / 2)
    x, y = np.meshgrid(x, x)
    inside = np.clip((1 - np.hypot(x, y)) * n / 2 + 0.5, 0, 1)
    pupil = inside * np.exp(2j * np.pi * point_spread.wave_aberration(params, x, y))
    auto = np.fft.ifft2(np.abs(np.fft.fft2(pupil)) ** 2)
    auto /= auto[0, 0]
    for i, j in ((20, 0), (0, 50), (60, 30), (100, -20)):  # shifts in cells of 2/n radii
        s = np.array([i, j]) * 2 / n
        fx, fy = s * 3.45 / (2 * 0.55 * 4)
        assert point_spread.transfer(params, np.array(fx), np.array(fy)) == pytest.approx(auto[j, i].conj(), abs=2e-3)


@pytest.mark.parametrize(
    ("fx", "fy", "error"), [(2 / 8.25, 0.0, 3e-4), (0.0, 4 / 8.25, 3e-4), (5 / 8.25, 3 / 8.25, 3e-4), (0.3, 0.0, 6e-3), (0.9, 0.1, 4e-3)]
)
def test_an_image_shows_the_transfer_of_pupil_and_pixel(fx, fy, error):
    """Exact at multiples of one cycle per side of the table (33/4 px); between them the rings and aberrations beyond it show."""
    params = PointSpread(model="diffraction", coma_x_waves=0.1, defocus_waves=0.1)
    expected = point_spread.transfer(params, np.array(fx), np.array(fy)) * np.sinc(fx) * np.sinc(fy)
    assert transfer(fx, fy, (SOURCE, params)) == pytest.approx(expected, abs=error)


@pytest.mark.parametrize("f", [0.02, 0.05, 0.1, 0.3, 0.43])
def test_an_image_shows_coarse_waves_through_a_clear_pupil(f):
    """Also between multiples of one cycle per side of the table, where a folded tail shows: 0.019 at 0.05 cycles per pixel."""
    expected = clear(np.array(f), 0.55, 4.0, 3.45) * np.sinc(f)
    assert transfer(f, 0.0, (SOURCE, PointSpread(model="diffraction"))) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("f", [0.3, 0.7, 1.3])
def test_a_lens_sharper_than_the_raster_is_still_right_where_pixels_see(f):
    """f/2.8 on 8.6 µm passes 5.6 cycles per pixel, more than the raster has."""
    params = PointSpread(model="diffraction", f_number=2.8, pitch_x_um=8.6, pitch_y_um=8.6)
    expected = clear(np.array(f), 0.55, 2.8, 8.6) * np.sinc(f)
    assert transfer(f, 0.0, (SOURCE, params)) == pytest.approx(expected, abs=2e-3)


def test_a_point_or_line_under_full_pixels_errs_by_the_transfer_at_one_cycle_over_pi():
    """The sharp line does not beat with the lattice of the wide tail either; the sum is over all of the light."""
    phase = np.arange(8) / 8
    frames = camera((1, 241), (SOURCE, PointSpread(model="diffraction"))).expose(Line(120 + phase, 0.12), 8).data[:, 0].astype(float)
    x = (frames * (np.arange(241) - 120)).sum(axis=1) / frames.sum(axis=1)
    blunt = np.exp(-2 * (np.pi * 0.12) ** 2)
    assert abs(first_harmonic(x - phase, phase)) == pytest.approx(0.2473 / np.pi * blunt, rel=0.01)
    assert 0.2473 / np.pi == pytest.approx(0.079, abs=5e-4)


@dataclass(frozen=True)
class HalfPlane:
    """Unit light to the left of x0, or above it, through a Gaussian."""

    x0: float
    along_y: bool = False
    moving = False
    smooth_px = 0.3

    def radiance(self, at: Points) -> np.ndarray:
        place = np.broadcast_to(at.y_px, at.x_px.shape) if self.along_y else at.x_px
        return 1e4 * ndtr((self.x0 - place) / np.hypot(0.3, at.blur_px))


@pytest.mark.parametrize(("f_number", "pitch"), [(2.8, (3.45, 3.45)), (4.0, (3.45, 3.45)), (4.0, (8.6, 2.4)), (8.0, (3.45, 3.45))])
def test_the_veil_beside_an_edge_is_where_the_pupil_puts_it(f_number, pitch):
    """2λN/(π³ d) of an edge's light is farther than d; a table folded back into ±4 px lacks 0.0090 of 0.0105 at 4 px for f/4.

    The oracle is the line spread's integral by quadrature of the clear pupil's transfer function, rings and all; the closed form, without
    rings, agrees with it to a tenth.
    """
    params = PointSpread(model="diffraction", f_number=f_number, pitch_x_um=pitch[0], pitch_y_um=pitch[1])
    beyond = np.array([3, 4, 5, 7, 10, 14, 21, 33, 50, 80])
    for across, size in ((True, pitch[0]), (False, pitch[1])):
        f = (np.arange(400_000) + 0.5) / 400_000 * size / (0.55 * f_number)
        shape = (3, 301) if across else (301, 3)
        frame = camera(shape, (SOURCE, params)).expose(HalfPlane(150.0, not across)).data[0] / 1e4
        light = frame[1] if across else frame[:, 1]
        shown = clear(f, 0.55, f_number, size) * np.sinc(f) * np.exp(-2 * (np.pi * 0.3 * f) ** 2) / (np.pi * f) * f[0] * 2
        expected = np.array([0.5 - (shown * np.sin(2 * np.pi * f * d)).sum() for d in beyond])
        assert light[150 + beyond] == pytest.approx(expected, abs=6e-4)
        assert light[150 - beyond] == pytest.approx(1 - expected, abs=6e-4)
        assert expected == pytest.approx(2 * 0.55 * f_number / size / (np.pi**3 * beyond), rel=0.1, abs=2e-4)


def test_a_window_sees_the_veil_of_the_whole_frame():
    """To the last bit, wherever it begins; pixels twice as wide as high, so that the tail's Gaussians are not round in pixels."""
    params = PointSpread(model="diffraction", f_number=8, pitch_x_um=3.0, pitch_y_um=1.5)
    eye = camera((90, 120), (SOURCE, params))
    spot = Spot(np.array([40.2]), np.array([33.7]), sigma=0.7)
    whole = eye.expose(spot).data[0]
    corners = [(0, 0), (1, 3), (31, 57), (64, 97)]
    grid = Grid(np.zeros(4, np.int64), np.array([r for r, _ in corners]), np.array([c for _, c in corners]), (26, 23))
    for got, (r, c) in zip(eye.expose_windows(spot, grid), corners, strict=True):
        assert np.array_equal(got, whole[r : r + 26, c : c + 23])


@pytest.mark.parametrize("sizes", [(64, 2000, 0.1, 0.1), (64, 550, 0.5, 5.0), (22, 550, 50.0, 2.0), (0.7, 100, 100.0, 100.0)])
def test_a_spread_far_wider_than_its_table_keeps_the_light(sizes):
    f_number, wavelength, across, down = sizes
    params = PointSpread(model="diffraction", f_number=f_number, wavelength_nm=wavelength, pitch_x_um=across, pitch_y_um=down)
    near, far = point_spread.kernel(params)
    assert near.sum() + (0 if far is None else far[:, 0].sum()) == pytest.approx(1, abs=1e-9)
    assert transfer(1e-7, 0.0, (SOURCE, params)) == pytest.approx(1, abs=2e-3)


def test_two_tails_in_a_row_are_the_tail_of_both():
    """Two clear pupils with Gaussians between them: at a coarse wave the transfer functions multiply."""
    one, two = PointSpread(model="diffraction", f_number=4), PointSpread(model="diffraction", f_number=8)
    for f in (0.01, 0.03, 0.1):
        expected = clear(np.array(f), 0.55, 4, 3.45) * clear(np.array(f), 0.55, 8, 3.45) * np.sinc(f)
        assert transfer(f, 0.0, (SOURCE, one), (SOURCE, two)) == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize(("sigma", "expected"), [(0.6, -3.7e-3), (0.8, -2.6e-5)])
def test_periodic_error_of_a_gaussian_spot_sampled_at_points(sigma, expected):
    assert scurve(sigma, 0.05) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("sigma", "expected"), [(0.4, -1.35e-2), (0.6, -2.6e-4), (0.8, -1.0e-6)])
def test_periodic_error_of_a_gaussian_spot_under_full_pixels(sigma, expected):
    """|H'(1)|/(πH(0)) = exp(−2π²σ²)/π; the light's quadrature over a pixel adds up to 6e-5 px of its own."""
    assert expected == pytest.approx(-np.exp(-2 * (np.pi * sigma) ** 2) / np.pi, rel=0.05)
    assert scurve(sigma, 1.0) == pytest.approx(-np.exp(-2 * (np.pi * sigma) ** 2) / np.pi, rel=0.01, abs=6e-5)


def scurve(sigma: float, width: float) -> float:
    """Amplitude of the periodic error of a spot, half of whose variance is the lens's."""
    phase = np.arange(8) / 8
    spot = Spot(10 + phase, np.full(8, 10.0), sigma=sigma / np.sqrt(2))
    chain = ((SOURCE, PointSpread(sigma_px=sigma / np.sqrt(2))), (APERTURE, PixelAperture(width_x_px=width, width_y_px=width)))
    x, _ = centroids(camera((21, 21), *chain).expose(spot, 8).data)
    return first_harmonic(x - 10 - phase, phase)


def test_coma_moves_the_centre_by_the_mean_slope_of_the_wave():
    """⟨∂W/∂p⟩ over the pupil is √8 c for Noll's coma, and a ray of slope ∂W/∂p lands at 2λN ∂W/∂p."""
    c, wide = 0.05, PointSpread(model="diffraction", coma_x_waves=0.05, coma_y_waves=-0.03)
    f = 1e-4
    for axis, coefficient in ((0, c), (1, -0.03)):
        h = point_spread.transfer(wide, np.array(f * (axis == 0)), np.array(f * (axis == 1)))
        assert -np.angle(h) / (2 * np.pi * f) == pytest.approx(2 * 0.55 * 4 / 3.45 * np.sqrt(8) * coefficient, rel=1e-3)
    spot = Spot(np.array([12.0]), np.array([12.0]), sigma=0.8)
    frame = camera((25, 25), (SOURCE, PointSpread(model="diffraction", coma_x_waves=0.1, reach_px=6))).expose(spot).data
    x, y = centroids(frame)
    assert 0.1 < x[0] - 12 < 2 * 0.55 * 4 / 3.45 * np.sqrt(8) * 0.1  # the fold of the far tail takes some of it back
    assert y[0] == pytest.approx(12, abs=1e-6)


def test_a_table_of_a_gaussian_is_that_gaussian():
    step, sigma = 0.1, 0.7
    at = (np.arange(81) - 40) * step
    line = np.exp(-0.5 * (at / sigma) ** 2)
    table = tuple(tuple(row) for row in np.outer(line, line))
    params = PointSpread(model="measured", table=table, table_step_px=step)
    for f in (0.2, 0.5, 0.9):
        expected = np.exp(-2 * (np.pi * sigma * f) ** 2) * np.sinc(f) * np.sinc(f * step)
        assert transfer(f, 0.0, (SOURCE, params)) == pytest.approx(expected, abs=1e-3)


def test_a_table_off_its_middle_shifts_the_image():
    table = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    spot = Spot(np.array([8.0]), np.array([8.0]), sigma=1.0)
    x, y = centroids(camera((17, 17), (SOURCE, PointSpread(model="measured", table=table, table_step_px=0.5))).expose(spot).data)
    assert (x[0], y[0]) == pytest.approx((8.5, 8.0), abs=2e-3)


def test_light_is_kept():
    spot = Spot(np.array([200.3]), np.array([199.6]), sigma=1.0)
    for params in (PointSpread(sigma_px=0.7), PointSpread(model="diffraction", spherical_waves=0.2)):
        assert camera((401, 401), (SOURCE, params)).expose(spot).data.sum() == pytest.approx(1e4, rel=1e-4)


@pytest.mark.parametrize("table", [(), ((1.0, 2.0),), ((1.0,), (1.0, 2.0, 3.0), (1.0,)), ((0.0,),)])
def test_a_useless_table_is_refused(table):
    with pytest.raises(ParameterError, match="table"):
        camera((9, 9), (SOURCE, PointSpread(model="measured", table=table))).expose(Spot(np.array([4.0]), np.array([4.0]), 1.0))


EACH = [name for name in PointSpread.model_fields if name.endswith("_waves")]


@pytest.mark.parametrize("name", EACH)
def test_a_coefficient_is_the_root_mean_square_over_the_pupil(name):
    """Noll (1976): the polynomials are orthonormal on the unit disc. Integrals by Gauss and by equal steps, exact for their degrees."""
    node, weight = np.polynomial.legendre.leggauss(12)
    r, w = np.sqrt(0.5 + 0.5 * node)[:, None], 0.5 * weight[:, None] / 32  # equal areas in r²
    angle = 2 * np.pi * np.arange(32) / 32

    def waves(one):
        return point_spread.wave_aberration(PointSpread(model="diffraction", **{one: 1.0}), r * np.cos(angle), r * np.sin(angle))

    assert len(EACH) == 6
    assert (w * waves(name)).sum() == pytest.approx(0, abs=1e-12)
    for other in EACH:
        assert (w * waves(name) * waves(other)).sum() == pytest.approx(float(name == other), abs=1e-12)
