"""Read-out of a charge injection device: averaging down to the floor, cross-talk conserving means, and what clearing leaves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.camera.signal import Windows
from pixmetry.sources.sensor.cid_readout import SOURCE, CidReadout, start
from source_signals import Z, flat, quiet, signal, stream


def read(rng: np.random.Generator, params: CidReadout, frames, one=None):
    return SOURCE.forward(params, frames, one or stream(rng), start(params))


@pytest.mark.parametrize(("reads", "sigma"), [(1, math.hypot(200, 15)), (100, 25.0), (100_000, math.hypot(200 / 316.2278, 15))])
def test_noise_falls_as_the_root_of_the_reads_until_the_floor(reads, sigma, rng: np.random.Generator):
    """Standard deviation at 1e-6 over 360 000 pixels; catches 1 %."""
    out, _ = read(rng, CidReadout(reads=reads, read_std_e=200.0, floor_std_e=15.0), flat(5000.0, (600, 600)))
    assert abs(out.data.astype(float).std() / sigma - 1) < Z / math.sqrt(2 * out.data.size) + 1e-5


def test_mean_of_single_reads_has_the_noise_of_many(rng: np.random.Generator):
    """Sixteen single reads averaged by hand and one of sixteen: variances agree at 1e-6 (ratio of two, 90 000 pixels each)."""
    single, _ = read(rng, CidReadout(read_std_e=80.0), flat(100.0, (300, 300), n=16))
    many, _ = read(rng, CidReadout(reads=16, read_std_e=80.0), flat(100.0, (300, 300)))
    by_hand = single.data.astype(float).mean(axis=0).var()
    assert abs(math.log(by_hand / many.data.astype(float).var())) < Z * math.sqrt(4 / 90_000)


def test_bright_pixel_draws_a_cross(rng: np.random.Generator):
    data = np.zeros((1, 20, 40))
    data[0, 7, 11] = 40_000.0
    out, _ = read(rng, CidReadout(row_crosstalk=0.02, col_crosstalk=0.01), signal(data))
    assert out.data[0, 7, 30] == pytest.approx(0.02 * 40_000 / 40)
    assert out.data[0, 2, 11] == pytest.approx(0.01 * 40_000 / 20)
    assert out.data[0, 7, 11] == pytest.approx(40_000 + 20 + 20)
    assert out.data[0, 2, 30] == 0
    assert out.data.sum() == pytest.approx(40_000 * 1.03, rel=1e-6)


def test_cross_talk_comes_off_again(rng: np.random.Generator):
    frames = signal(rng.uniform(0, 20_000, (2, 30, 40)))
    params = CidReadout(row_crosstalk=0.05, col_crosstalk=0.03)
    out, _ = read(rng, params, frames)
    back = SOURCE.correct(params, out, {})
    assert np.abs(out.data - frames.data).max() > 500
    assert np.abs(back.data - frames.data).max() < 0.05


def test_residual_of_a_flash_fades_as_powers(rng: np.random.Generator):
    data = np.zeros((4, 3, 5))
    data[0] = 10_000.0
    out, state = read(rng, CidReadout(residual=0.1), signal(data), quiet())
    assert out.data[:, 0, 0] == pytest.approx([10_000, 1000, 100, 10], rel=1e-5)
    assert state == pytest.approx(np.full((3, 5), 1.0), rel=1e-5)
    steady, _ = read(rng, CidReadout(residual=0.1), signal(np.full((30, 3, 5), 9000.0)), quiet())
    assert steady.data[-1] == pytest.approx(np.full((3, 5), 10_000.0), rel=1e-5)  # geometric series: 1/(1 − r)


def test_context_is_the_frame_where_electrodes_talk():
    windows = Windows.one(3, 4, 5, 6)
    assert SOURCE.window_needed(CidReadout(reads=4, read_std_e=10.0), windows, (40, 50)).equals(windows)
    assert SOURCE.window_needed(CidReadout(row_crosstalk=0.01), windows, (40, 50)).equals(Windows.one(0, 0, 40, 50))


def test_what_is_left_of_a_steady_flat_field_is_poisson_too(rng: np.random.Generator):
    """Whole electrons, of which each stays for itself: the variance is the mean, to 1.5 % (a share: −9 %)."""
    frames = rng.poisson(4000, (8, 300, 300))
    out, _ = read(rng, CidReadout(residual=0.2), signal(frames))
    late = out.data[5:].astype(float)
    assert np.array_equal(late, np.rint(late))
    assert abs(late.var() / late.mean() - 1) < Z * np.sqrt(2 / late.size) + 1e-4
