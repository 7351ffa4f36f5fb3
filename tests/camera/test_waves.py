"""Taking a wave out of frames that show targets: it is fitted to the background, and no more of it is taken out than is significant."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.signal import Kind, Signal
from pixmetry.sources.electronics.supply_pickup import SupplyPickup
from pixmetry.sources.electronics.supply_pickup import correct as correct_supply
from pixmetry.sources.grabber.phase_pattern import PhasePattern
from pixmetry.sources.grabber.phase_pattern import correct as correct_pattern
from source_signals import signal

ROWS, COLS, PITCH = 240, 360, 30
SIGMA = 2.0
# Targets and what is left out around them cover under half of a frame; of N pixels of white noise, the squared complex amplitude n² is
# exponential with mean 4σ²/N. It passes 18.4 times its mean once in 1e8, so that some hundred comparisons fail once in 1e6; the noise is
# estimated from 48 ordinates and the surface costs a few of N: a quarter more.
LIMIT_DN = 1.25 * np.sqrt(18.4 * 4 * SIGMA**2 / (ROWS * COLS / 2))


def targets(rng: np.random.Generator, dark: bool = False) -> np.ndarray:
    """A lattice of blurred discs of 150 DN on unevenly lit ground, with noise."""
    row, col = np.mgrid[:ROWS, :COLS].astype(float)
    image = 200.0 + 8 * (col / COLS) - 5 * ((row - 100) / ROWS) ** 2
    for y in np.arange(PITCH / 2, ROWS, PITCH):
        for x in np.arange(PITCH / 2, COLS, PITCH):
            near = np.s_[int(y) - 9 : int(y) + 10, int(x) - 9 : int(x) + 10]
            place = np.hypot(row[near] - y - rng.uniform(-0.5, 0.5), col[near] - x - rng.uniform(-0.5, 0.5))
            image[near] += (-150 if dark else 150) / (1 + np.exp((place - 3.5) / 0.4))
    return image + rng.normal(0, SIGMA, image.shape)


def wave(amplitude_dn: float, nu_x: float, nu_y: float, turns: float) -> np.ndarray:
    return amplitude_dn * np.sin(2 * np.pi * (nu_x * np.arange(COLS) + nu_y * np.arange(ROWS)[:, None] + turns))


def as_signal(image: np.ndarray) -> Signal:
    return signal(image[None].astype(np.float32), Kind.DN)


# away from the lattice's lines; on one; beside one; on the diagonal line of the highest frequency
@pytest.mark.parametrize("nu", [(0.11, 0.07), (2 / PITCH, 1 / PITCH), (2 / PITCH + 4e-4, 1 / PITCH), (0.5, 0.5)])
@pytest.mark.parametrize("amplitude_dn", [0.0, 0.05, 20.0])
@pytest.mark.parametrize("dark", [False, True])
def test_what_is_left_of_a_wave_among_targets_is_noise(nu, amplitude_dn, dark, rng: np.random.Generator):
    """Fitted through the targets, a wave near a line of the lattice came out wrong by 3 DN; here at most by the noise of the background."""
    image, pattern = targets(rng, dark), wave(amplitude_dn, *nu, rng.uniform())
    params = PhasePattern(amplitude_dn=max(amplitude_dn, 0.3), frequency_x=nu[0], frequency_y=nu[1])
    left = correct_pattern(params, as_signal(image + pattern), {}).data[0] - image.astype(np.float32)
    amplitude = np.sqrt(2 * np.mean(left.astype(float) ** 2))
    assert amplitude < max(LIMIT_DN, 3e-5 * amplitude_dn), (nu, amplitude)


def test_a_wave_that_is_not_there_is_seldom_taken_out_and_then_leaves_the_frame_alone(rng: np.random.Generator):
    """200 frames of noise: by chance alone 5 % are changed; 28 and more would be once in 1e6 (binomial)."""
    params = PhasePattern(amplitude_dn=1.0, frequency_x=0.11, frequency_y=0.07)
    frames = [signal(rng.normal(100, SIGMA, (1, 96, 128)).astype(np.float32), Kind.DN) for _ in range(200)]
    assert sum(correct_pattern(params, frame, {}) is not frame for frame in frames) < 28


def test_a_structure_far_stronger_than_the_measured_wave_is_the_scenes_own():
    grating = as_signal(100 + wave(40.0, 0.11, 0.07, 0.2))
    params = PhasePattern(amplitude_dn=0.1, frequency_x=0.11, frequency_y=0.07)
    assert correct_pattern(params, grating, {}) is grating


@pytest.mark.parametrize("scan", ["progressive", "interlaced"])
def test_supply_pick_up_is_fitted_beside_the_targets_too(scan, rng: np.random.Generator):
    """Its period along the row is that of every second target."""
    params = SupplyPickup(amplitude_dn=0.3, frequency_hz=1e6, line_time_us=64.0 + 1 / 12, pixel_time_ns=1e3 * 2 / PITCH, scan=scan)
    image = targets(rng)
    left = correct_supply(params, as_signal(image), {}).data[0] - image.astype(np.float32)
    assert np.sqrt(2 * np.mean(left.astype(float) ** 2)) < np.sqrt(2) * LIMIT_DN  # a field has half of the rows
