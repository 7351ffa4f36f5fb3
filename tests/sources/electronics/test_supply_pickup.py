"""The sinusoid against exact arithmetic on the clocks, television's line count, its spectrum and a Dirichlet kernel; fitting it out."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.stats import chi2

from pixmetry.camera.observations import Observations, StackMoments
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import InputError
from pixmetry.core.random import Stream
from pixmetry.observe.patterns import find_phase_patterns
from pixmetry.sources.electronics.supply_pickup import SupplyPickup, correct, forward, propagate, seen_per_px
from pixmetry.sources.grabber.phase_pattern import measure as measure_pattern
from source_signals import ALPHA, Z, centroid_probe, flat, signal, spots, stream

SHAPE = (64, 96)
# 1 MHz: 12/96 of a turn from pixel to pixel after 3 whole ones, −5/64 from line to line after 400
ON_BINS = SupplyPickup(amplitude_dn=1.5, frequency_hz=1e6, pixel_time_ns=3125.0, line_time_us=400 - 5 / 64)


def wave(rng: np.random.Generator, params: SupplyPickup, shape=SHAPE, n: int = 1, unit: Stream | None = None, **kw) -> np.ndarray:
    return forward(params, flat(0.0, shape, n=n, kind=Kind.DN, **kw), unit or stream(rng)).data.astype(float)


def test_all_frames_are_one_sinusoid_of_time_with_one_phase(rng: np.random.Generator):
    """Time in exact fractions; one amplitude and one phase fitted to windows of four frames, the last after eleven hours at 5 MHz.

    Of float64, 3e-5 of a turn is left there: 2π · 3e-5 · 2 DN = 4e-4 DN.
    """
    params = SupplyPickup(amplitude_dn=2.0, frequency_hz=4_999_999.0, line_time_us=63.5, pixel_time_ns=62.5)
    starts = [Fraction(0), Fraction(1, 32), Fraction(5, 64), Fraction(40_000)]  # exact in float64 too
    frames = signal(
        np.zeros((4, 7, 9)), Kind.DN, row0=1000, col0=1300, frame_shape=(1100, 1400), time_s=np.array([float(t) for t in starts])
    )
    got = forward(params, frames, stream(rng)).data.astype(float).ravel()
    line, pixel = Fraction(635, 10**7), Fraction(625, 10**10)
    turns = [4_999_999 * (t + r * line + c * pixel) % 1 for t in starts for r in range(1000, 1007) for c in range(1300, 1309)]
    angle = 2 * np.pi * np.array([float(v) for v in turns])
    basis = np.stack((np.sin(angle), np.cos(angle)), axis=1)
    fitted = np.linalg.lstsq(basis, got, rcond=None)[0]
    assert np.hypot(*fitted) == pytest.approx(2.0, abs=4e-4)
    assert np.abs(got - basis @ fitted).max() < 6e-4


def test_european_mains_has_two_periods_in_625_television_lines(rng: np.random.Generator):
    """ITU-R BT.1700: 625 lines of 64 µs, 25 pictures a second; 50 Hz is the field rate."""
    mains = SupplyPickup(amplitude_dn=1.0, frequency_hz=50.0, line_time_us=64.0, pixel_time_ns=0.0)
    rows = wave(rng, mains, (1250, 2))[0, :, 0]
    assert rows[625:] == pytest.approx(rows[:625], abs=1e-5)
    assert np.count_nonzero(np.diff(np.sign(rows[:625])) != 0) in (3, 4)
    assert abs(np.fft.rfft(rows[:625]))[2] == pytest.approx(625 / 2, rel=1e-6)


@pytest.mark.parametrize(("hertz", "pictures"), [(50.0, 1), (60.0, 5), (51.0, 25)])
def test_it_stands_still_or_rolls_by_the_beat_with_the_frame_rate(hertz, pictures, rng: np.random.Generator):
    """At 25 pictures a second: 50 Hz makes two turns a picture, 60 Hz 2.4 (again the same after 5), 51 Hz 2.04 (after 25)."""
    params = SupplyPickup(amplitude_dn=1.0, frequency_hz=hertz)
    frames = wave(rng, params, (9, 5), n=52, time_s=np.arange(52) / 25)
    same = [np.abs(f - frames[0]).max() < 1e-5 for f in frames]
    assert [k for k in range(52) if same[k]] == list(range(0, 52, pictures))


def test_only_what_is_left_of_whole_turns_between_pixels_is_seen(rng: np.random.Generator):
    """One line of the spectrum, with the amplitude, and the signs that tell +5 bins from −5."""
    assert seen_per_px(ON_BINS) == pytest.approx((12 / 96, -5 / 64), abs=1e-9)
    frame = wave(rng, ON_BINS)[0]
    spectrum = np.fft.fft2(frame) / frame.size
    assert 2 * abs(spectrum[-5, 12]) == pytest.approx(1.5, abs=2e-4)
    assert np.mean(frame**2) == pytest.approx(1.5**2 / 2, rel=1e-4)


def test_the_phase_belongs_to_the_unit(rng: np.random.Generator):
    """400 uniform phases: 400 |mean of exp(iφ)|² is exponential with mean 1, above 13.8 once in 1e-6; a mean of 0.2 would be found."""
    phases = np.angle([np.fft.fft2(wave(rng, ON_BINS)[0])[-5, 12] for _ in range(400)])
    assert 400 * abs(np.exp(1j * phases).mean()) ** 2 < 13.8
    days = [wave(rng, ON_BINS, unit=Stream(7, exposure, "pick-up")) for exposure in (1, 2)]
    assert np.array_equal(*days)


def test_correct_needs_neither_the_amplitude_nor_the_phase_of_the_frames(rng: np.random.Generator):
    dirty = forward(ON_BINS, flat(100.0, SHAPE, n=5, kind=Kind.DN, time_s=np.arange(5) * 0.0123456789), stream(rng))
    nominal = ON_BINS.model_copy(update={"amplitude_dn": 0.1})
    assert np.abs(correct(nominal, dirty, {}).data - 100).max() < 2e-4


def test_correct_takes_out_a_sinusoid_that_changes_its_sign_from_row_to_row(rng: np.random.Generator):
    """At half a cycle per pixel sine and cosine are one and the same column of the fit, but for its sign."""
    half = SupplyPickup(amplitude_dn=1.5, frequency_hz=1e6, pixel_time_ns=0.0, line_time_us=64.5)
    dirty = forward(half, flat(100.0, SHAPE, kind=Kind.DN), stream(rng))
    assert np.abs(correct(half, dirty, {}).data - 100).max() < 2e-4


def test_correct_puts_in_no_more_noise_than_two_fitted_numbers(rng: np.random.Generator):
    """Two orthogonal columns: the power put in is σ²χ² of 2 degrees of freedom a frame.

    60 frames find 80 % more, or half as much, at a false rate of 1e-6.
    """
    n, sigma = 60, 0.1
    noise = rng.normal(0, sigma, (n, *SHAPE)).astype(np.float32)
    clean = forward(ON_BINS, flat(0.0, SHAPE, n=n, kind=Kind.DN), stream(rng))
    left = correct(ON_BINS, clean.with_data(clean.data + noise), {}).data.astype(float) - noise
    assert chi2.ppf(ALPHA / 2, 2 * n) < np.sum(left**2) / sigma**2 < chi2.isf(ALPHA / 2, 2 * n)


def test_less_than_a_period_is_not_told_from_a_gradient_and_is_refused(rng: np.random.Generator):
    mains = SupplyPickup(amplitude_dn=1.0, frequency_hz=50.0)
    with pytest.raises(InputError, match="less than one period"):
        correct(mains, flat(100.0, (300, 96), kind=Kind.DN), {})
    tall = flat(100.0, (320, 96), kind=Kind.DN)  # a period is 312.5 rows
    assert np.abs(correct(mains, forward(mains, tall, stream(rng)), {}).data - 100).max() < 1e-3


@pytest.mark.parametrize("cycles", [0.02, 0.1, 0.31, 1.1, -0.9])
def test_a_plain_centroid_answers_with_the_slope_of_the_dirichlet_kernel(cycles):
    """In N × N pixels about the centre, Σ k exp(iθk) = −i D'(θ), D(θ) = sin(Nθ/2)/sin(θ/2): u_x = A N |D'| / (√2 ΣI), u_y = 0.

    ΣI of a wide Gaussian spot is 2πσ² times its peak. The frequency may be off by whole turns a pixel.
    """
    size, sigma, peak, amplitude = 25, 2.0, 150.0, 3.0
    middle = np.array([12.0])
    probe = centroid_probe(spots(middle, middle, size=size, sigma=sigma, peak=peak), middle, middle)
    params = SupplyPickup(amplitude_dn=amplitude, frequency_hz=1e6, pixel_time_ns=1000 * (cycles + 1), line_time_us=64.0)
    half = np.pi * cycles
    slope = (size * np.cos(size * half) * np.sin(half) - np.sin(size * half) * np.cos(half)) / (2 * np.sin(half) ** 2)
    got = propagate(params, probe)
    assert got.u_x_px == pytest.approx(amplitude * size * abs(slope) / (np.sqrt(2) * 2 * np.pi * sigma**2 * peak), rel=1e-5)
    assert got.u_y_px < 1e-9
    assert (got.bias_x_px, got.bias_y_px, got.gum_class) == (0, 0, "F")


def test_a_line_in_dark_frames_is_found_as_a_phase_pattern_at_the_frequency_that_is_seen(rng: np.random.Generator):
    """Why there is no measure: what can be told from frames has its place already. Each within 4.9 u, missed once in 1e-6."""
    params = SupplyPickup(amplitude_dn=0.5, frequency_hz=1.3e6)
    shape = (128, 160)
    mean_map = wave(rng, params, shape)[0] + rng.normal(0, 0.1, shape)
    nothing = dict.fromkeys(StackMoments.__dataclass_fields__, 0.0)
    stack = StackMoments(**nothing | {"n_frames": 16, "mean_map_dn": mean_map})
    found = measure_pattern(Observations(patterns=find_phase_patterns(stack)))
    for name, expected in zip(("amplitude_dn", "frequency_x", "frequency_y"), (0.5, *seen_per_px(params)), strict=True):
        assert abs(found[name].value - expected) < Z * found[name].u
    assert found["amplitude_dn"].u < 0.01 and found["frequency_x"].u < 1e-3
