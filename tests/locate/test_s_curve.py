"""S-curves against Poisson's sum with integrals done numerically, published values, and symmetry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from pixmetry.core.errors import InputError
from pixmetry.locate.bound.s_curve import SCurve, even_phases, s_curve
from pixmetry.locate.centroids.fixed import FixedCentroid


def line(sigma: float, peak: float):  # noqa: ANN201
    return lambda dx, dy: peak * np.exp(-(dx**2) / (2 * sigma**2)) + 0 * dy


def column_centroid(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plain centroid of one row, background zero."""
    row = images[:, images.shape[1] // 2]
    return (row * np.arange(row.shape[1])).sum(axis=1) / row.sum(axis=1), np.zeros(len(row))


def poisson_error(h, reach: float, phases: np.ndarray, orders: int = 40) -> np.ndarray:  # noqa: ANN001
    """e(c) = −2 Σ S_k sin(2πkc) / (∫h + 2 Σ C_k cos(2πkc)), with S_k and C_k by numerical integration."""
    area = 2 * quad(h, 0, reach)[0]
    top, bottom = np.zeros(len(phases)), np.full(len(phases), area)
    for k in range(1, orders):
        s = 2 * quad(lambda x: x * h(x), 0, reach, weight="sin", wvar=2 * math.pi * k)[0]
        c = 2 * quad(h, 0, reach, weight="cos", wvar=2 * math.pi * k)[0]
        top -= 2 * s * np.sin(2 * math.pi * k * phases)
        bottom += 2 * c * np.cos(2 * math.pi * k * phases)
    return top / bottom


@pytest.mark.parametrize("clip", [0.0, 4.0, 6.0, 10.0, 30.0])
def test_a_clipped_line_has_the_error_of_poissons_sum(clip: float) -> None:
    """A wrong sign or factor 2 changes the curves by at least 100 %; the sum's remainder is below 5e-5 px."""
    sigma, peak = (1.5, 150.0) if clip else (0.6, 150.0)
    reach = sigma * math.sqrt(2 * math.log(peak / clip)) if clip else 9 * sigma

    def h(x: float) -> float:
        return max(peak * math.exp(-(x**2) / (2 * sigma**2)) - clip, 0.0)

    phases = even_phases(24)
    got = s_curve(column_centroid, line(sigma, peak), phases_x=phases, phases_y=np.zeros(1), aperture_px=0, offset_dn=-clip, low_dn=0.0)
    assert np.abs(got.error_x_px[0] - poisson_error(h, reach, phases)).max() < 5e-5
    assert np.abs(got.error_x_px).max() > 1e-4


@pytest.mark.parametrize(
    ("sigma", "clip", "signed"),
    [
        (0.6, 0, {1: -0.00371}),
        (1.5, 6, {1: -0.00748, 2: -0.00113, 3: 0.00045}),
        (1.5, 10, {1: 0.00196}),
        (1.5, 15, {1: 0.01516}),
        (1.5, 30, {1: -0.02563}),
    ],
)
def test_signed_sines_of_a_clipped_line(sigma: float, clip: float, signed: dict[int, float]) -> None:
    """Values of the Poisson sum, −2 S_k/∫h, to the last digit given (and the second order of the division by the sum)."""
    got = s_curve(column_centroid, line(sigma, 150.0), phases_x=64, phases_y=np.zeros(1), aperture_px=0, offset_dn=-clip, low_dn=0.0)
    for order, value in signed.items():
        assert got.sine_px(order) == pytest.approx(value, abs=1.5e-5 + 2e-3 * abs(value))


def test_a_line_with_the_black_level_six_too_low() -> None:
    """Clarke's Fig 3.13: standard deviation 1.5, peak 150, offset −6: unrounded and rounded; without the offset, no error but rounding."""
    fine = np.linspace(-0.5, 0.5, 501)[:-1]
    settings = {"phases_x": fine, "phases_y": np.zeros(1), "aperture_px": 0, "window_px": 41, "low_dn": 0.0, "high_dn": 255.0}
    plain = s_curve(column_centroid, line(1.5, 150.0), offset_dn=-6, **settings)
    assert abs(plain.sine_px(1)) == pytest.approx(0.0075, abs=1e-4)
    assert plain.half_range_px[0] == pytest.approx(0.0092, abs=2e-4) and plain.rms_px[0] == pytest.approx(0.0054, abs=1e-4)
    rounded = s_curve(column_centroid, line(1.5, 150.0), offset_dn=-6, rounded=True, **settings)
    assert abs(rounded.sine_px(1)) == pytest.approx(0.0076, abs=3e-4)
    assert rounded.rms_px[0] == pytest.approx(0.0066, abs=3e-4) and rounded.half_range_px[0] == pytest.approx(0.0152, abs=1e-3)
    none = s_curve(column_centroid, line(1.5, 150.0), **settings)
    assert np.abs(none.error_x_px).max() < 1e-12
    only = s_curve(column_centroid, line(1.5, 150.0), rounded=True, **settings)
    assert only.rms_px[0] == pytest.approx(0.0051, abs=3e-4) and only.half_range_px[0] == pytest.approx(0.0143, abs=1e-3)


def test_a_hard_threshold_on_a_gaussian_without_noise() -> None:
    """Clarke's Fig 3.10 for a Gaussian of 1.5 and 150 averaged over the pixel, 21 × 21 window: a simulation of 800 phases, to 12 %."""
    spot = lambda dx, dy: 150 * np.exp(-(dx**2 + dy**2) / (2 * 1.5**2))  # noqa: E731
    for threshold, rms in ((10, 0.014), (20, 0.028), (30, 0.045), (50, 0.065), (70, 0.074), (90, 0.106)):
        law = FixedCentroid("hard_threshold", window=21, threshold_dn=threshold)
        got = s_curve(law, spot, phases_x=28, phases_y=28, window_px=23, rounded=True)
        assert math.hypot(*got.rms_px) / math.sqrt(2) == pytest.approx(rms, rel=0.12)


def test_a_disc_from_the_template_and_the_same_by_quadrature() -> None:
    """The kind's own image and a blurred disc by a function of place agree; soft threshold well inside the edge."""
    from scipy.special import chndtr

    parameters = {"radius_px": 3.0, "blur_px": 0.8, "amplitude_dn": 150.0, "background_dn": 0.0}
    disc = lambda dx, dy: 150 * chndtr((3 / 0.8) ** 2, 2, (dx**2 + dy**2) / 0.8**2)  # noqa: E731
    law = FixedCentroid("soft_threshold", window=21, threshold_dn=30.0)
    by_kind = s_curve(law, "disc", parameters, phases_x=8, phases_y=2)
    by_place = s_curve(law, disc, phases_x=8, phases_y=2)
    assert np.abs(by_kind.error_x_px - by_place.error_x_px).max() < 2e-4
    assert np.abs(by_kind.error_x_px).max() > 1e-3


@pytest.mark.parametrize("name", ["soft_threshold", "windowed_centroid", "forstner", "ellipse_edges", "gaussian", "perimeter"])
def test_named_estimators_have_an_odd_s_curve(name: str) -> None:
    """A target turned by half a turn about a pixel's centre has the opposite error."""
    parameters = {"radius_px": 2.3, "blur_px": 0.6, "amplitude_dn": 150.0, "background_dn": 10.0}
    got = s_curve(name, "disc", parameters, phases_x=np.array([-0.37, -0.1, 0.1, 0.37]), phases_y=np.array([-0.2, 0.2]), noise_dn=1.0)
    assert isinstance(got, SCurve) and np.isfinite(got.error_x_px).all()
    assert np.abs(got.error_x_px + got.error_x_px[::-1, ::-1]).max() < 2e-3 and np.abs(got.error_x_px).max() < 0.25


def test_refusals() -> None:
    with pytest.raises(InputError, match="central"):
        s_curve("centroid", window_px=24)
    with pytest.raises(InputError, match="disc"):
        s_curve("centroid", "disc", {"radius_px": 3.0})
    with pytest.raises(InputError, match="estimator"):
        s_curve("median", line(1.0, 100.0))
