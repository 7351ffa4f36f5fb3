"""The offset experiment against quadrature, closed forms and plain code.

Statistical bounds: false-failure rate 1e-6 a test.
"""

from __future__ import annotations

import numpy as np
import pytest
from gallery import offset as experiment
from gallery.offset import BLACK_DN, MIDDLE, NOISE_DN, OFFSET_DN, PEAK_DN, PIECE_ROWS, ROWS, SAMPLES, SIGMA_PX, predicted, swing
from scipy.integrate import quad
from scipy.stats import chi2, norm

RATE = 1e-6
# amplitude, half range and rms in px by another program, to the digits that are told; None where they are not
TOLD = [
    (6.0, "unquantised", False, 0.0075, 0.0092, 0.0054),
    (6.0, "rounded", False, 0.0076, 0.0152, 0.0066),
    (6.0, "truncated", False, 0.0082, 0.018, None),
    (6.0, "unquantised", True, 0.0064, 0.0079, None),
    (0.0, "rounded", False, 0.0027, 0.0143, 0.0051),
]


def bound(tests: int = 1) -> float:
    """In standard deviations, for so many two-sided tests together."""
    return float(norm.isf(RATE / 2 / tests))


def plain_errors(offset: float, conversion: str, power: int, integrated: bool) -> list[float]:
    """Every row's error, written once more in the plainest way."""
    errors = []
    for row in range(ROWS):
        c = 3.0 * row / ROWS - 1.5
        total = first = 0.0
        for x in range(-20, 21):
            if integrated:
                level = quad(lambda u, c=c: 150 * np.exp(-((u - c) ** 2) / 4.5), x - 0.5, x + 0.5, epsabs=1e-12)[0] - offset
            else:
                level = 150 * np.exp(-((x - c) ** 2) / 4.5) - offset
            level = {"unquantised": level, "rounded": round(level), "truncated": np.floor(level)}[conversion]
            weight = min(max(level, 0.0), 255.0) ** power
            total, first = total + weight, first + weight * x
        errors.append(first / total - c)
    return errors


def wave(k: int, offset: float, power: int, sigma: float = SIGMA_PX) -> float:
    """−2 ∫ x h sin(2πkx) dx / ∫ h dx by adaptive quadrature between the places where the line ends."""
    end = sigma * np.sqrt(2 * np.log(PEAK_DN / offset))

    def h(x: float) -> float:
        return max(PEAK_DN * np.exp(-0.5 * (x / sigma) ** 2) - offset, 0.0) ** power

    area = quad(h, 0, end)[0]
    return -2 * quad(lambda x: x * h(x) * np.sin(2 * np.pi * k * x), 0, end, limit=400, epsabs=1e-10 * area)[0] / area


@pytest.mark.parametrize(("conversion", "power", "integrated"), [("unquantised", 1, False), ("truncated", 1, False), ("rounded", 2, False)])
@pytest.mark.parametrize("offset", [0.0, 6.0])
def test_errors_are_those_of_plain_code(offset: float, conversion: str, power: int, integrated: bool) -> None:
    found = swing(offset, conversion, power, integrated)
    np.testing.assert_allclose(found.error_px, plain_errors(offset, conversion, power, integrated), atol=1e-11)


def test_light_over_the_pixel_is_its_integral() -> None:
    np.testing.assert_allclose(swing(6.0, integrated=True).error_px, plain_errors(6.0, "unquantised", 1, True), atol=1e-9)


@pytest.mark.parametrize(("offset", "conversion", "integrated", "first", "half", "rms"), TOLD)
def test_sizes_are_the_known_ones(offset: float, conversion: str, integrated: bool, first: float, half: float, rms: float | None) -> None:
    found = swing(offset, conversion, 1, integrated)
    assert abs(found.first_px) == pytest.approx(first, abs=0.51e-4)
    assert found.half_range_px == pytest.approx(half, abs=0.51e-4 if half != 0.018 else 0.51e-3)
    if rms is not None:
        assert found.rms_px == pytest.approx(rms, abs=0.51e-4)


def test_without_offset_and_rounding_there_is_hardly_an_error() -> None:
    """A Gaussian of variance s² errs by 4π s² exp(−2π² s²): 1e-18 px, and 3.2e-9 px with squared grey values."""
    assert swing(0.0).half_range_px < 1e-12
    s2 = SIGMA_PX**2 / 2
    assert swing(0.0, power=2).first_px == pytest.approx(-4 * np.pi * s2 * np.exp(-2 * np.pi**2 * s2), rel=1e-4)


@pytest.mark.parametrize("conversion", ["unquantised", "rounded", "truncated"])
def test_the_error_is_odd_and_repeats_in_every_pixel(conversion: str) -> None:
    error = swing(OFFSET_DN, conversion).error_px
    np.testing.assert_allclose(error[1:], -error[:0:-1], atol=1e-12)
    assert abs(error[ROWS // 2]) < 1e-13  # in the middle of a pixel
    c = np.linspace(-0.5, 0.5, 41)
    here, there = (
        experiment.row_positions(experiment.stored(experiment.levels(6.0, centre_px=c + shift), conversion), experiment.CENTROID)
        - c
        - shift
        for shift in (0, 1)
    )
    same = np.isclose(here, there, atol=1e-9)
    assert same.all() if conversion == "unquantised" else same.mean() > 0.9  # a tie of rounding may fall on either side


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("offset", [1.0, 3.0, 6.0, 10.0, 15.0, 30.0])
def test_predictions_are_the_integrals(offset: float, power: int) -> None:
    found = predicted(offset, power)
    np.testing.assert_allclose(found[:4], [wave(k, offset, power) for k in range(1, 5)], atol=1e-9)


@pytest.mark.parametrize(
    ("offset", "told"), [(6.0, (-0.00748, -0.00113, 0.00045)), (10.0, (0.00196,)), (15.0, (0.01516,)), (30.0, (-0.02563,))]
)
def test_predictions_are_the_known_ones_with_their_signs(offset: float, told: tuple[float, ...]) -> None:
    """To first order in the sums over the pixels, which the told values do without."""
    np.testing.assert_allclose(predicted(offset)[: len(told)], told, atol=5e-5)


def test_rows_do_as_the_integral_says() -> None:
    """Signed amplitudes from rows against integrals; what is left is of second order in the wave."""
    for power in (1, 2):
        found, said = experiment.against_offset(np.array([2.0, 6.0, 10.0, 15.0, 30.0]), power)
        np.testing.assert_allclose(found, said, rtol=0.004, atol=1e-7)
    six = swing(OFFSET_DN)
    assert six.rms_px == pytest.approx(experiment.predicted_rms(predicted(OFFSET_DN)), rel=0.005)


@pytest.mark.parametrize("offset", [6.0, 30.0])
def test_the_slope_of_the_feet_sets_the_amplitude(offset: float) -> None:
    """Leading term x_c |I'(x_c)| |sin 2πx_c|/(π² ∫h), x_c being where the line ends: good to 5 % near its greatest values."""
    end = SIGMA_PX * np.sqrt(2 * np.log(PEAK_DN / offset))
    area = quad(lambda x: PEAK_DN * np.exp(-0.5 * (x / SIGMA_PX) ** 2) - offset, -end, end)[0]
    leading = end * offset * end / SIGMA_PX**2 * abs(np.sin(2 * np.pi * end)) / (np.pi**2 * area)
    assert abs(swing(offset).first_px) == pytest.approx(leading, rel=0.05)


def test_a_stray_value_pulls_by_its_moment() -> None:
    found, rule = experiment.outlier_shift()
    assert rule == pytest.approx(10 / (PEAK_DN * SIGMA_PX * np.sqrt(2 * np.pi)), rel=1e-9)
    assert found == pytest.approx(rule / (1 + 1 / (PEAK_DN * SIGMA_PX * np.sqrt(2 * np.pi))), rel=1e-9)


def test_deep_offsets_reach_the_swing_of_real_lines() -> None:
    """0.1 to 0.3 px for narrow lines, and several depths with the same amplitude."""
    depth = np.linspace(0.5, 0.8, 13)
    amplitude = np.array([[swing(d * PEAK_DN, sigma_px=s).first_px for d in depth] for s in (0.8, 1.0, 1.2, 1.5)])
    wanted = np.array([[wave(1, d * PEAK_DN, 1, s) for d in depth] for s in (0.8, 1.0, 1.2, 1.5)])
    np.testing.assert_allclose(amplitude, wanted, rtol=0.12, atol=0.002)
    assert 0.25 < np.abs(amplitude).max() < 0.35
    assert (np.diff(np.sign(amplitude), axis=1) != 0).any()


def test_exposures_agree_with_other_noise(rng: np.random.Generator) -> None:
    """Means over 800 frames on either side; catches 0.0025 px at the deep cut of the brighter three."""
    found = experiment.exposures()
    x = np.arange(21) - 10.0
    edge = [[quad(lambda u, c=c: np.exp(-((u - c) ** 2) / 2), v - 0.5, v + 0.5, epsabs=1e-12)[0] for v in x] for c in (0.0, 0.35)]
    shape = np.outer(edge[0], edge[1])
    for offset in (40.0, 6.0):
        for j, peak in enumerate(found.peak_dn):
            noise = rng.standard_normal((800, 21, 21)) * np.sqrt(0.81 + 0.0097 * peak * shape)
            codes = np.clip(np.rint(peak * shape - offset + noise), 0, 255)
            error = (codes.sum(axis=1) @ x) / codes.sum(axis=(1, 2)) - 0.35
            u = np.hypot(found.u_px[offset][j], error.std(ddof=1) / np.sqrt(len(error)))
            assert abs(found.error_px[offset][j] - error.mean()) < bound(8) * u
    # told by another program with noise of its own, 75 frames each
    told, spread = np.array([-0.026, 0.004, 0.050, -0.037]), np.array([0.006, 0.008, 0.014, 0.050]) / np.sqrt(75)
    assert (np.abs(found.error_px[40.0] - told) < bound(4) * np.hypot(spread, found.u_px[40.0]) + 0.003).all()


def test_with_black_far_above_zero_the_centroid_is_pulled_and_noisy() -> None:
    """Nothing is cut off at +12: pull b n/(S + b n) and σ √Σ(x − x̂)²/(S + b n) in closed form. Catches 5 % of the noise."""
    found = experiment.cures()["centroid"]
    area = PEAK_DN * SIGMA_PX * np.sqrt(2 * np.pi)
    total = area + 12 * SAMPLES
    c = experiment.centres()
    pull = 12 * SAMPLES / total
    pieces = (pull * c).reshape(-1, PIECE_ROWS).mean(axis=1)
    assert found.lasting_px[-1] == pytest.approx(np.sqrt(np.mean(pieces**2)), rel=0.01)
    lever = np.mean([((np.arange(SAMPLES) - MIDDLE - at * area / total) ** 2).sum() for at in c])
    sigma = np.sqrt((NOISE_DN**2 + 1 / 12) * lever / PIECE_ROWS) / total
    dof = 19 * ROWS // PIECE_ROWS
    low, high = np.sqrt(chi2.ppf([RATE / 2, 1 - RATE / 2], dof) / dof)
    assert 0.99 * low < found.random_px[-1] / sigma < 1.01 * high


def test_the_fit_does_not_care_where_black_is() -> None:
    """Near the bound σ/A √(2s/(√π n)) (s_a/s)^(3/2) and true to its own statement at every level; catches 20 % of the variance's root.

    What lasts is below what 20 frames of noise can tell: the debiased mean square over 25 pieces has a standard error of σ²/20 · √(2/25).
    """
    found = experiment.cures()
    fit = found["fit"]
    wider = np.sqrt(1 + 1 / 12 / SIGMA_PX**2)
    sigma = np.sqrt(NOISE_DN**2 + 1 / 12) / PEAK_DN * np.sqrt(2 * SIGMA_PX / (np.sqrt(np.pi) * PIECE_ROWS)) * wider**1.5
    dof = 20 * ROWS // PIECE_ROWS
    low, high = np.sqrt(chi2.ppf([RATE / 2 / len(BLACK_DN), 1 - RATE / 2 / len(BLACK_DN)], dof) / dof)
    ratio = fit.total_px / fit.stated_px
    assert (low < ratio).all() and (ratio < high).all()
    assert (0.98 * sigma < fit.stated_px).all() and (fit.stated_px < 1.06 * sigma).all()
    assert (fit.lasting_px**2 < chi2.isf(RATE / len(BLACK_DN), 25) / 25 * sigma**2 / 20 - sigma**2 / 20).all()
    # the others leave something behind, each at its own black level
    assert found["centroid"].lasting_px[0] > 0.003 and found["soft threshold"].lasting_px[0] > 0.008
    safe = BLACK_DN >= 4.5
    assert (found["soft threshold"].lasting_px[safe] < 0.002).all() and (found["squared centroid"].lasting_px[safe] > 0.01).all()
