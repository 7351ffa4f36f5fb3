"""Flicker noise: its spectrum by periodogram, its covariance along and across the rows, and its scale."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.electronics.flicker_noise import FlickerNoise, covariance, forward
from source_signals import Z, flat, stream


def test_density_goes_as_one_over_f(rng: np.random.Generator):
    """Periodogram (SciPy) of 48 read-outs of 65 536 pixels: −10 dB per decade within 0.5 dB, over 2.1 decades.

    At 1e-6 the fit is known to 0.2 dB. No band of an octave departs from the line by more than its own scatter and 0.1 dB: a
    construction with steps of 2^k pixels that are held, not joined by lines, has ripples of 0.4 dB.
    """
    from scipy.signal import periodogram

    params = FlickerNoise(rms_e=10.0, corner_rel=0.25, octaves=16, line_px=1024)
    frames = forward(params, flat(0.0, (64, 1024), n=48), stream(rng)).data.reshape(48, -1).astype(float)
    f, density = periodogram(frames, detrend=False, axis=1)
    centre, level, weight = [], [], []
    for octave in range(5, 12):
        band = (f >= 2.0 ** -(octave + 1)) & (f < 2.0**-octave)
        product = density[:, band] * f[band]  # level where the density goes as 1/f
        centre.append(-(octave + 0.5) * np.log10(2))
        level.append(10 * np.log10(product.mean()))
        weight.append(np.sqrt(product.size) / (10 / np.log(10)))
    centre, level, weight = map(np.array, (centre, level, weight))
    design = np.stack([np.ones_like(centre), centre], axis=1) * weight[:, None]
    fit = np.linalg.lstsq(design, level * weight, rcond=None)[0]
    u = float(np.sqrt(np.linalg.inv(design.T @ design)[1, 1]))
    assert Z * u < 0.25
    assert abs(fit[1]) < 0.25 + Z * u
    assert np.all(np.abs(level - (fit[0] + fit[1] * centre)) < 0.1 + 1.2 * Z / weight)


def many(rng: np.random.Generator, params: FlickerNoise, shape: tuple[int, int], n: int, **place) -> np.ndarray:
    return forward(params, flat(0.0, shape, n=n, **place), stream(rng)).data.astype(float)


def triangles(lag: float, period: float) -> float:
    """Overlap of two triangles of half width 1 that are lag/period apart over that of one with itself, by a sum."""
    t = np.linspace(-3, 3, 60_001)
    one, two = (np.maximum(1 - np.abs(t - s), 0) for s in (0, lag / period))
    return float((one * two).sum() / (one * one).sum())


def test_covariance_is_that_of_straight_lines_between_independent_nodes(rng: np.random.Generator):
    """Twelve thousand frames, six pixels at lags from 1 to 2 rows; covariances known to 1 %, at 1e-6 to 5 %."""
    params = FlickerNoise(rms_e=7.0, corner_rel=0.1, octaves=9, line_px=100)
    n = 12_000
    window = many(rng, params, (3, 6), n, row0=50, col0=30, frame_shape=(200, 90))
    picked = np.stack([window[:, r, c] for r, c in ((0, 0), (0, 1), (0, 5), (1, 0), (2, 0), (2, 5))])
    time = np.array([0, 1, 5, 100, 200, 205])
    periods = [5, *(5 * 2**k for k in range(9))]  # the fastest counts twice
    want = 49 / 10 * np.array([[sum(triangles(abs(a - b), p) for p in periods) for a in time] for b in time])
    got = picked @ picked.T / n
    # nodes are normal, the place between them is not: the fourth moment of a pixel exceeds that of a normal by up to 20 % / octaves
    tolerance = 1.05 * Z * np.sqrt((want**2 + np.outer(np.diag(want), np.diag(want))) / n)
    assert np.all(np.abs(got - want) < tolerance)
    assert covariance(params, time[:, None] - time) == pytest.approx(want, rel=1e-6)
    assert want[0, 0] == pytest.approx(49.0)


def test_rows_narrower_than_the_line_leave_the_blanking_out(rng: np.random.Generator):
    """A camera whose rows are longer than ``line_px`` reads them without a gap: the last pixel of a row is the next one's neighbour."""
    params = FlickerNoise(rms_e=1.0, corner_rel=0.05, octaves=3, line_px=0)
    noise = many(rng, params, (2, 40), 2000)
    across = np.mean((noise[:, 0, -1] - noise[:, 1, 0]) ** 2)
    within = np.mean((noise[:, 0, 10] - noise[:, 0, 11]) ** 2)
    assert across / within == pytest.approx(1.0, abs=2 * Z * np.sqrt(4 / 2000))
    assert np.mean((noise[:, 0, 0] - noise[:, 1, 0]) ** 2) > 5 * within


def test_frames_are_independent_of_each_other(rng: np.random.Generator):
    noise = many(rng, FlickerNoise(rms_e=1.0, octaves=12), (1, 1), 20_000)[:, 0, 0]
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 1.1 * Z / np.sqrt(len(noise))


def test_follows_the_fields_in_time(rng: np.random.Generator):
    """Row 2l of the woven frame is as near to row 2l + 2 as rows that are read one after the other are; to row 2l + 1 it is 312 lines.

    At 1e-6, correlations are known to 0.04 from 16 000 frames; rows in the order of the frame would show 0.74 between neighbours.
    """
    params = FlickerNoise(rms_e=7.0, octaves=16, line_px=100, interlaced=True, field_lines=12.5)
    n = 16_000
    rows = many(rng, params, (5, 2), n, row0=7, col0=30, frame_shape=(24, 90))[:, :, 0]
    got = np.corrcoef(rows.T)
    times = np.array([r // 2 + 12.5 * (r % 2) for r in range(7, 12)]) * 100
    want = covariance(params, times[:, None] - times) / 49
    assert np.abs(got - want).max() < 5 * np.sqrt(1.3 / n)
    assert got[1, 3] > got[1, 2] + 0.1
