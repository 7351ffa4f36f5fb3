"""Options of the amplifier, the gamma curve and the supply's pick-up: heavy tails, clock, television's toe, interlaced read-out."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.signal import Kind
from pixmetry.sources.electronics import amplifier_noise, gamma, supply_pickup
from pixmetry.sources.electronics.amplifier_noise import AmplifierNoise
from pixmetry.sources.electronics.gamma import Gamma
from pixmetry.sources.electronics.supply_pickup import SupplyPickup
from source_signals import ALPHA, flat, signal, spot_probe, stream


def test_amplifier_noise_of_heavy_tails_is_the_mixture_and_keeps_its_deviation(rng: np.random.Generator):
    """Kolmogorov–Smirnov at 1e-6 over 400 000 pixels against the mixture's own law; 0.5 % in the wrong part would be caught."""
    share, sigma = 0.05, 8.0
    noise = amplifier_noise.forward(AmplifierNoise(white_e=sigma, tail_share=share), flat(0.0, (500, 800)), stream(rng)).data.ravel()
    narrow = sigma / math.sqrt((1 - share) + 9 * share)

    def law(x: np.ndarray) -> np.ndarray:
        return (1 - share) * stats.norm.cdf(x, scale=narrow) + share * stats.norm.cdf(x, scale=3 * narrow)

    assert stats.kstest(noise.astype(float), law).pvalue > ALPHA
    kurtosis = 3 * ((1 - share) + 81 * share) / ((1 - share) + 9 * share) ** 2
    x = noise.astype(float) / sigma
    eighth = 105 * ((1 - share) + 3**8 * share) / ((1 - share) + 9 * share) ** 4
    assert np.mean(x**4) == pytest.approx(kurtosis, abs=6 * math.sqrt((eighth - kurtosis**2) / x.size))


def test_amplifier_noise_grows_with_the_root_of_the_clock(rng: np.random.Generator):
    params = AmplifierNoise(white_e=5.0, clock_ratio=4.0)
    noise = amplifier_noise.forward(params, flat(0.0, (400, 500)), stream(rng)).data.ravel()
    assert stats.kstest(noise.astype(float) / 10, "norm").pvalue > ALPHA
    probe = spot_probe()
    same = amplifier_noise.propagate(AmplifierNoise(white_e=10.0), probe)
    assert amplifier_noise.propagate(params, probe).u_x_px == pytest.approx(same.u_x_px, rel=1e-12)


TV = Gamma(gamma=0.45, reference_dn=1000.0, toe="bt709")


def bent(rng: np.random.Generator, x) -> np.ndarray:
    return gamma.forward(TV, signal(np.reshape(x, (1, 1, -1)), Kind.DN), stream(rng)).data[0, 0].astype(float) / 1000


def test_gamma_with_a_toe_is_the_curve_of_bt_709(rng: np.random.Generator):
    """ITU-R BT.709-6, item 1.2 with its rounded constants: 1.099 L^0.45 − 0.099 from 0.018 on, 4.5 L below. They are up to 0.0003 off."""
    light = np.concatenate([np.linspace(0, 0.018, 50, endpoint=False), np.linspace(0.018, 1, 200)])
    want = np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    assert bent(rng, 1000 * light) == pytest.approx(want, abs=4e-4)


def test_gamma_with_a_toe_has_no_step_and_no_kink_where_they_join_and_is_odd(rng: np.random.Generator):
    near = np.array([17.998, 18.002, 17.0, 19.0])
    low, high, before, after = bent(rng, near)
    assert high - low == pytest.approx(0.004e-3 * 4.507, rel=0.1)
    assert (after - high) / (low - before) == pytest.approx(1.0, abs=0.04)
    assert np.array_equal(bent(rng, -near), -bent(rng, near))


def test_gamma_with_a_toe_is_undone(rng: np.random.Generator):
    x = signal(np.linspace(-300, 2000, 4000).reshape(1, 1, -1), Kind.DN)
    back = gamma.correct(TV, gamma.forward(TV, x, stream(rng)), {})
    assert back.data == pytest.approx(x.data, abs=2e-3)


MAINS = SupplyPickup(amplitude_dn=1.0, frequency_hz=100.0, pixel_time_ns=0.0, scan="interlaced")


def test_rows_of_an_interlaced_frame_follow_the_time_of_their_field_line(rng: np.random.Generator):
    """Times in exact fractions: row R at (312.5 (R mod 2) + R div 2) · 64 µs; one phase, fitted."""
    params = SupplyPickup(amplitude_dn=2.0, frequency_hz=12345.0, pixel_time_ns=62.5, scan="interlaced")
    got = supply_pickup.forward(params, signal(np.zeros((1, 9, 7)), Kind.DN, row0=101, col0=50, frame_shape=(600, 800)), stream(rng))
    line, pixel = Fraction(64, 10**6), Fraction(625, 10**10)
    time = [line * (Fraction(625, 2) * (r % 2) + r // 2) + c * pixel for r in range(101, 110) for c in range(50, 57)]
    angle = 2 * np.pi * np.array([float(12345 * t % 1) for t in time])
    basis = np.stack((np.sin(angle), np.cos(angle)), axis=1)
    data = got.data.astype(float).ravel()
    fit = np.linalg.lstsq(basis, data, rcond=None)[0]
    assert np.hypot(*fit) == pytest.approx(2.0, abs=1e-4)
    assert np.abs(data - basis @ fit).max() < 2e-4


def test_hum_of_100_hz_climbs_half_as_much_per_row_of_an_interlaced_frame(rng: np.random.Generator):
    """156.25 lines of a field are one period: at most 2π/156.25 DN per line of the field, 0.0201 DN per row of the frame, for 1 DN.

    In a disc window of radius 6 px such a ramp shifts a target of sum S = 5773 DN by g π ρ⁴/(4 S) = 0.0035 px.
    """
    rows = supply_pickup.forward(MAINS, flat(0.0, (400, 1), kind=Kind.DN), stream(rng)).data[0, :, 0].astype(float)
    steepest = np.abs(rows[2:] - rows[:-2]).max() / 2  # both fields start at the same phase: 312.5 lines are two periods
    assert steepest == pytest.approx(math.pi / 156.25, rel=1e-3)  # 0.0201 DN
    assert steepest * math.pi * 6**4 / (4 * 5773) == pytest.approx(0.0035, abs=5e-5)


@pytest.mark.parametrize("row0", [0, 1, 6, 7])
def test_interlaced_windows_are_crops_and_may_stand_on_any_row(row0, rng: np.random.Generator):
    params = SupplyPickup(amplitude_dn=2.0, frequency_hz=50_000.0, scan="interlaced")
    unit = stream(rng)
    whole = supply_pickup.forward(params, flat(0.0, (20, 30), kind=Kind.DN), unit).data
    part = supply_pickup.forward(params, flat(0.0, (5, 9), kind=Kind.DN, row0=row0, col0=4, frame_shape=(20, 30)), unit).data
    assert np.array_equal(part[0], whole[0, row0 : row0 + 5, 4:13])


def test_interlaced_pick_up_is_fitted_out_of_each_field(rng: np.random.Generator):
    params = SupplyPickup(amplitude_dn=3.0, frequency_hz=20_250.0, scan="interlaced", field_lines=312.37)
    clean = flat(100.0, (120, 160), kind=Kind.DN)
    assert supply_pickup.correct(params, supply_pickup.forward(params, clean, stream(rng)), {}).data == pytest.approx(clean.data, abs=2e-3)


def test_interlaced_shift_of_a_centroid_against_many_phases_by_brute_force(rng: np.random.Generator):
    params = SupplyPickup(amplitude_dn=0.5, frequency_hz=3_000.0, scan="interlaced")
    probe = spot_probe(n=4)
    squares = []
    for row0 in (40, 41):
        for _ in range(100):
            error = supply_pickup.forward(params, flat(0.0, (25, 25), kind=Kind.DN, row0=row0, frame_shape=(500, 25)), stream(rng)).data[0]
            squares.append(np.stack(probe.field(error.astype(float))) ** 2)
    found = np.sqrt(np.mean(squares, axis=(0, 2)))
    got = supply_pickup.propagate(params, probe)
    # the square of a sinusoid of any phase scatters by 1/√2 of its mean: over 100 phases and 2 places by 7 %, its root by 3.5 %; 5 of these
    assert (got.u_x_px, got.u_y_px) == (pytest.approx(found[0], rel=0.18), pytest.approx(found[1], rel=0.18))
