"""The wave, against its formula and its Fourier transform; finding and removing it."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.observations import Observations, PatternList
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import MeasureError
from pixmetry.sources.grabber.phase_pattern import PhasePattern, correct, forward, measure
from source_signals import flat, signal, stream

SHAPE = (64, 96)
PARAMS = PhasePattern(amplitude_dn=1.5, frequency_x=12 / 96, frequency_y=-5 / 64)


def wave(rng: np.random.Generator, params: PhasePattern, n: int = 6) -> np.ndarray:
    return forward(params, flat(100.0, SHAPE, n=n, kind=Kind.DN), stream(rng)).data.astype(float) - 100


def test_it_is_one_line_of_the_spectrum_with_the_amplitude_and_the_sign_of_its_frequencies(rng: np.random.Generator) -> None:
    for frame in wave(rng, PARAMS):
        spectrum = np.fft.fft2(frame) / frame.size
        assert 2 * abs(spectrum[-5, 12]) == pytest.approx(1.5, abs=2e-4)
        assert np.mean(frame**2) == pytest.approx(1.5**2 / 2, rel=1e-4)


def test_the_phase_moves_from_frame_to_frame_or_is_that_of_the_unit(rng: np.random.Generator) -> None:
    phases = np.angle([np.fft.fft2(f)[-5, 12] for f in wave(rng, PARAMS, 400)])
    # 400 uniform phases: |mean of exp(iφ)|² · 400 is exponential with mean 1; 13.8 is passed once in 1e-6
    assert 400 * abs(np.exp(1j * phases).mean()) ** 2 < 13.8
    still = wave(rng, PARAMS.model_copy(update={"moving": False}))
    assert all(np.array_equal(still[0], frame) for frame in still)


def test_absolute_pixels_count() -> None:
    fixed = PARAMS.model_copy(update={"moving": False})
    unit = stream(1)
    whole = forward(fixed, flat(0.0, SHAPE, kind=Kind.DN), unit).data
    part = forward(fixed, signal(np.zeros((1, 8, 9)), Kind.DN, row0=7, col0=11, frame_shape=SHAPE), unit).data
    assert np.array_equal(part, whole[:, 7:15, 11:20])


def test_correct_takes_the_wave_out_to_rounding_on_a_flat_field_and_by_far_the_most_under_noise(rng: np.random.Generator) -> None:
    """With noise σ over N pixels the fitted wave is off by σ/√N rms; 0.1 DN over 6144 pixels leaves 0.0013 DN."""
    dirty = forward(PARAMS, flat(100.0, SHAPE, n=5, kind=Kind.DN), stream(rng))
    assert np.abs(correct(PARAMS, dirty, {}).data - 100).max() < 2e-4
    noise = rng.normal(0, 0.1, dirty.data.shape).astype(np.float32)
    cleaned = correct(PARAMS, dirty.with_data(dirty.data + noise), {}).data - noise - 100
    assert np.sqrt(np.mean(cleaned**2)) < 5 * 0.1 / np.sqrt(64 * 96)


def patterns(n: int) -> PatternList:
    values = np.array([1.5, 0.4])[:n]
    return PatternList(
        moving=np.array([True, False])[:n],
        frequency_x=np.array([0.1, 0.2])[:n],
        frequency_y=np.array([-0.3, 0.1])[:n],
        u_frequency_x=np.full(n, 1e-4),
        u_frequency_y=np.full(n, 2e-4),
        amplitude_dn=values,
        u_amplitude_dn=np.full(n, 0.02),
        false_alarm_rate=1e-6,
        n_searched=10_000,
        fixed_limit_dn=0.05,
        moving_limit_dn=np.nan,
    )


def test_measure_gives_the_strongest_line_as_parameters() -> None:
    found = measure(Observations(patterns=patterns(2)))
    assert dict(zip(found.names, found.values, strict=True)) == {
        "amplitude_dn": 1.5,
        "frequency_x": 0.1,
        "frequency_y": -0.3,
        "moving": 1.0,
    }
    assert PhasePattern(**{e.name: e.value for e in found}).moving is True
    assert found["frequency_y"].u == pytest.approx(2e-4)


def test_without_a_line_there_is_a_limit_above_what_would_be_found_in_half_of_all_cases() -> None:
    found = measure(Observations(patterns=patterns(0)))
    assert found.limits == {"amplitude_dn"}
    assert 0.05 < found["amplitude_dn"].value < 0.08  # 0.05 (1 + 1.645/√(2 ln 10^10)) = 0.0621
    with pytest.raises(MeasureError, match="dark frames"):
        measure(Observations())


def test_a_steady_advance_tells_the_absolute_frequency(rng: np.random.Generator) -> None:
    """Fixed in the unit, and a quarter of a turn on from frame to frame."""
    params = PARAMS.model_copy(update={"moving": False, "turns_per_frame": 0.25})
    phases = np.angle([np.fft.fft2(f)[-5, 12] for f in wave(rng, params, 5)]) / (2 * np.pi)
    np.testing.assert_allclose(np.diff(phases) % 1, 0.25, atol=1e-4)
