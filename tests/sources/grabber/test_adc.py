"""Conversion to codes, against transition levels found by a sweep and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import CodeErrors, Observations
from pixmetry.camera.signal import Kind, Windows
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.grabber.adc import SOURCE, Adc, correct, forward, measure, thresholds
from source_signals import Z, signal, stream


def convert(rng: np.random.Generator, params: Adc, values: np.ndarray, unit: Stream | None = None) -> np.ndarray:
    return forward(params, signal(np.asarray(values, np.float32)[None, None, :], Kind.DN), unit or stream(rng)).data[0, 0]


def test_ideal_codes_are_those_of_halves_rounded_up_and_clamped(rng: np.random.Generator) -> None:
    values = np.array([-1e9, -0.6, -0.5, 0.0, 0.499, 0.5, 1.5, 2.5, 254.4, 254.5, 255.6, 1e9])
    assert convert(rng, Adc(bits=8), values).tolist() == [0, 0, 0, 0, 0, 1, 2, 3, 254, 255, 255, 255]
    assert convert(rng, Adc(bits=8), values).dtype == np.uint16
    values = rng.uniform(-100, 5000, 10_000).astype(np.float32)
    want = np.clip(np.floor(values.astype(float) * 1.02 + 16.25 + 0.5), 0, 4095)
    assert np.array_equal(convert(rng, Adc(bits=12, offset_dn=16.25, gain_error_rel=0.02), values), want)
    assert convert(rng, Adc(bits=16), [65535.4]).tolist() == [65535]


@pytest.mark.parametrize(
    "params",
    [Adc(bits=6, dnl_std_lsb=0.4), Adc(bits=6, inl_amplitude_lsb=3.0, inl_cycles=2.0), Adc(bits=6, dnl_std_lsb=1.5, missing_every=8)],
)
def test_codes_count_the_thresholds_that_are_reached(params: Adc, rng: np.random.Generator) -> None:
    unit = stream(rng)
    values = np.linspace(-5, 70, 20_001).astype(np.float32)
    want = np.searchsorted(thresholds(params, unit), values.astype(float), side="right")
    codes = convert(rng, params, values, unit)
    assert np.array_equal(codes, want)
    assert (np.diff(codes.astype(int)) >= 0).all()


def test_missing_codes_never_occur_and_their_neighbours_share_their_width(rng: np.random.Generator) -> None:
    values = np.linspace(-1, 256, 257_001)
    codes, counts = np.unique(convert(rng, Adc(bits=8, missing_every=32), values), return_counts=True)
    assert sorted(set(range(256)) - set(codes.tolist())) == [32, 64, 96, 128, 160, 192, 224]
    widths = dict(zip(codes.tolist(), counts / 1000, strict=True))
    assert widths[31] == pytest.approx(1.5, abs=0.003) and widths[33] == pytest.approx(1.5, abs=0.003)
    assert widths[100] == pytest.approx(1.0, abs=0.003)


def test_code_widths_scatter_by_dnl_and_do_not_add_up(rng: np.random.Generator) -> None:
    """4094 widths, whose neighbours are correlated by −1/2: u(s)/s = √(3/2)/√(2·4094); a factor of 1.08 would be seen for certain."""
    level = thresholds(Adc(bits=12, dnl_std_lsb=0.2), stream(rng))
    widths = np.diff(level)
    assert widths.std() == pytest.approx(0.2, rel=Z * np.sqrt(1.5 / (2 * 4094)))
    assert widths.mean() == pytest.approx(1.0, abs=2 * Z * 0.2 / 4094)
    assert np.abs(level - np.arange(1, 4096) + 0.5).max() < 6.8 * 0.2 / np.sqrt(2)


def test_the_bend_is_that_of_the_transition_levels(rng: np.random.Generator) -> None:
    values = np.arange(0, 256, 1e-3)
    codes = convert(rng, Adc(bits=8, inl_amplitude_lsb=2.0, inl_cycles=3.0), values)
    transition = values[np.searchsorted(codes, np.arange(1, 256), side="left")]
    k = np.arange(1, 256)
    assert np.abs(transition - (k - 0.5) - 2.0 * np.sin(2 * np.pi * 3 * k / 256)).max() < 2e-3


@pytest.mark.parametrize(
    ("params", "extra"), [(Adc(bits=10), 0.0), (Adc(bits=10, dnl_std_lsb=0.4), 0.4**2 / 2), (Adc(bits=10, missing_every=4), 0.5 / 4)]
)
def test_mean_square_error_is_that_of_the_propagator(params: Adc, extra: float, rng: np.random.Generator) -> None:
    """Values spread evenly over 1000 codes: 1/12 + DNL²/2 + 1/(2m). The DNL part scatters by √(2/1000) of itself from unit to unit."""
    values = np.linspace(10, 1010, 400_001)[:-1]
    error = convert(rng, params, values) - values
    u = extra * np.sqrt(2 / 1000) if params.dnl_std_lsb else 0.0
    assert np.mean(error**2) == pytest.approx(1 / 12 + extra, abs=Z * u + 1e-3)


def test_correct_returns_dn_above_black(rng: np.random.Generator) -> None:
    params = Adc(bits=8, offset_dn=20.0, gain_error_rel=0.1)
    values = np.linspace(0, 200, 1001)
    back = correct(params, signal(convert(rng, params, values)[None, None, :], Kind.CODES), {})
    assert back.kind is Kind.DN and back.data.dtype == np.float32
    assert np.abs(back.data[0, 0] - values).max() <= 0.5 / 1.1 + 1e-4


def test_another_unit_has_other_code_widths() -> None:
    params = Adc(bits=8, dnl_std_lsb=0.5)
    one = thresholds(params, Stream(1, 1, "a"))
    assert np.array_equal(one, thresholds(params, Stream(1, 2, "a")))
    assert not np.array_equal(one, thresholds(params, Stream(2, 1, "a")))


def test_measure_takes_black_level_and_code_widths_where_they_are() -> None:
    black = Estimates.from_rows([("gain_dn_per_e", 0.1, 0.01, 9, "DN/e"), ("offset_dn", 5.0, 0.1, 9, "DN")])
    widths = Estimates.from_rows([("dnl_rms_lsb", 0.3, 0.02, 50, "LSB")])
    none = np.zeros(0)
    codes = CodeErrors(none.astype(int), none, none, none.astype(int), none, widths)
    found = measure(Observations(photon_transfer_fit=black, code_errors=codes))
    assert found.names == ("offset_dn", "dnl_std_lsb") and found.values.tolist() == [5.0, 0.3]
    assert found["dnl_std_lsb"].u == pytest.approx(0.02) and found.covariance[0, 1] == 0
    assert measure(Observations(code_errors=codes)).names == ("dnl_std_lsb",)
    with pytest.raises(MeasureError, match="dark frames"):
        measure(Observations())


def test_a_converter_without_any_code_is_refused() -> None:
    with pytest.raises((InputError, ValueError), match="every code would be missing"):
        Adc(missing_every=1)


def test_hysteresis_puts_the_thresholds_higher_while_the_line_rises(rng: np.random.Generator) -> None:
    """A triangle: the same level gives a lower code on the way up than on the way down, by the hysteresis."""
    up = np.arange(0, 100, 0.25)
    both = np.concatenate([up, up[::-1]])
    codes = convert(rng, Adc(hysteresis_lsb=3.0), both).astype(float)
    rising, falling = codes[1 : len(up)], codes[len(up) + 1 :][::-1]
    assert (falling[20:-20] - rising[20 : len(falling) - 20]).mean() == pytest.approx(3.0, abs=0.3)
    assert np.array_equal(convert(rng, Adc(hysteresis_lsb=3.0), np.full(9, 80.25))[1:], np.full(8, 80))


def test_black_and_slope_drift_with_temperature(rng: np.random.Generator) -> None:
    drift = {"offset_drift_dn_per_k": 0.5, "gain_drift_per_k": 1e-3, "reference_temperature_c": 30.0}
    params = Adc(bits=12, offset_dn=50.0, gain_error_rel=0.1, **drift)
    data = np.full((2, 1, 3), [0.0, 1000.0, 2000.0])
    codes = forward(params, signal(data, Kind.DN, temperature_c=[30.0, 40.0]), stream(rng)).data[:, 0]
    assert codes.tolist() == [[50, 1150, 2250], [55, 1166, 2277]]


def test_a_jittering_moment_of_sampling_is_noise_on_slopes_only(rng: np.random.Generator) -> None:
    """A sine of 0.02 cycles a sample, read from the function itself at moments that scatter by 3 % of a sample: the same spread everywhere.

    Two times 4000 rows know a ratio to 1.6 %, at 40 places; a factor of 1.2 would be seen. Level parts have no noise.
    """
    params, rows, x = Adc(bits=16, offset_dn=30_000.0, aperture_jitter_rel=0.03), 4000, np.arange(50)
    wave = 20_000 * np.sin(2 * np.pi * 0.02 * x)
    out = forward(params, signal(np.broadcast_to(wave, (1, rows, 50)), Kind.DN), stream(rng)).data[0].astype(float)
    moments = x + 0.03 * rng.standard_normal((rows, 50))
    want = 20_000 * np.sin(2 * np.pi * 0.02 * moments)
    steep = (np.abs(np.cos(2 * np.pi * 0.02 * x)) > 0.2) & (x > 0) & (x < 49)
    assert (out.std(axis=0) / want.std(axis=0))[steep] == pytest.approx(np.ones(steep.sum()), abs=1.3 * Z / np.sqrt(rows))
    flat_part = forward(params, signal(np.full((1, 50, 50), 7.0), Kind.DN), stream(rng)).data
    assert (flat_part == 30_007).all()


def test_a_window_of_jittered_samples_is_the_crop(rng: np.random.Generator) -> None:
    params, unit = Adc(bits=16, offset_dn=1000.0, aperture_jitter_rel=0.05, hysteresis_lsb=1.0), stream(rng)
    frame = np.random.default_rng(6).uniform(0, 5000, (1, 6, 30)).astype(np.float32)
    whole = forward(params, signal(frame, Kind.DN), unit).data
    for col0, cols in ((0, 1), (7, 5), (29, 1)):
        need = SOURCE.window_needed(params, Windows.one(2, col0, 3, cols), (6, 30))
        left, right = int(need.col0[0]), int(need.col0[0] + need.cols[0])
        part = forward(params, signal(frame[:, 2:5, left:right], Kind.DN, row0=2, col0=left, frame_shape=(6, 30)), unit).data
        assert np.array_equal(part[:, :, col0 - left : col0 - left + cols], whole[:, 2:5, col0 : col0 + cols])
