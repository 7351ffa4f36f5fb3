"""Column noise: what a column has in common, how it wanders from frame to frame, and what it does to a centroid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.contribution import Probe
from pixmetry.camera.signal import Kind
from pixmetry.core.random import Grid
from pixmetry.sources.electronics.column_noise import ColumnNoise, forward, propagate, truth
from source_signals import ALPHA, Z, flat, stream


def columns(rng: np.random.Generator, params: ColumnNoise, n: int, cols: int = 4000, level: float = 0.0, unit=None) -> np.ndarray:
    out = forward(params, flat(level, (3, cols), n=n, kind=Kind.DN), unit or stream(rng)).data.astype(float)
    assert np.array_equal(out[:, 0], out[:, 2])
    return out[:, 0]


@pytest.mark.parametrize("frames", [1, 8])
def test_at_any_moment_the_offsets_are_normal_with_their_deviation(frames, rng: np.random.Generator):
    """Kolmogorov–Smirnov at 1e-6 on each of the moments between two states; 6 % of the deviation would be caught."""
    for row in columns(rng, ColumnNoise(offset_dn=2.0, wander_frames=frames), 5, cols=20_000):
        assert stats.kstest(row / 2, "norm").pvalue > ALPHA


def test_correlation_over_frames_is_a_cosine_up_to_the_next_state_and_ends_after_two(rng: np.random.Generator):
    """z_0 cos(πs/2) + z_1 sin(πs/2): between moments s and s' of one interval cos(π(s' − s)/2); between intervals sin(πs/2) cos(πs'/2)."""
    rows = columns(rng, ColumnNoise(offset_dn=1.0, wander_frames=8), 20, cols=20_000)

    def expected(a: int, b: int) -> float:
        s, t = (0.5 * math.pi * (v % 8) / 8 for v in (a, b))
        return {0: math.cos(t - s), 1: math.sin(s) * math.cos(t)}.get(b // 8 - a // 8, 0.0)

    for a, b in ((0, 1), (0, 4), (2, 7), (4, 8), (6, 10), (7, 8), (0, 8), (3, 19)):
        rho = expected(a, b)
        got = float(np.mean(rows[a] * rows[b]))
        assert got == pytest.approx(rho, abs=Z * math.sqrt((1 + rho**2) / 20_000)), (a, b)


def test_new_in_every_frame_unless_it_wanders(rng: np.random.Generator):
    rows = columns(rng, ColumnNoise(offset_dn=1.0), 2, cols=20_000)
    assert abs(np.mean(rows[0] * rows[1])) < Z / math.sqrt(20_000)


def test_gain_acts_on_the_signal_and_truth_tells_both(rng: np.random.Generator):
    params, unit = ColumnNoise(offset_dn=0.5, gain_rel=0.01, wander_frames=3), stream(rng)
    dark, light = (columns(rng, params, 4, level=v, unit=unit) for v in (0.0, 200.0))
    gain = (light - dark) / 200
    assert gain.std() == pytest.approx(0.01, rel=Z / math.sqrt(2 * 4000))
    assert np.corrcoef(gain[0], dark[0])[0, 1] == pytest.approx(0.0, abs=Z / math.sqrt(4000))
    told = truth(params, flat(0.0, (3, 4000), n=4, kind=Kind.DN), unit)
    assert told["column_offset_dn"] == pytest.approx(dark, abs=1e-6)
    assert told["column_gain"] == pytest.approx(gain, abs=1e-6)


def test_shift_per_dn_of_a_disc_in_a_round_window():
    """u_x = σ √(Σ x² n_c²)/S with n_c the pixels of column c in a window of radius 6 px, S = 5773 DN.

    With chords of a true circle Σ x² n_c² is 8 (2592 − 1555.2) = 8294 px⁴, hence 0.0158 px/DN; 0.0155 is on record.
    """
    axis = np.arange(-6, 7)
    inside = np.hypot(axis, axis[:, None]) <= 6
    g = (inside / 5773.0)[None]
    none = np.zeros(1)
    probe = Probe(150 * inside[None].astype(float), 0.0, none, none, none, none, g * axis, g * axis[:, None], 0.01, 0.01, 20.0, 8, (64, 64))
    chord = inside.sum(axis=0)
    got = propagate(ColumnNoise(offset_dn=1.0), probe)
    assert got.u_x_px == pytest.approx(math.sqrt(float((axis**2 * chord**2).sum())) / 5773, rel=1e-12)
    assert got.u_x_px == pytest.approx(0.0155, abs=0.0006)
    assert got.u_x_px == pytest.approx(math.sqrt(8294.4) / 5773, rel=0.02)
    assert got.u_y_px == pytest.approx(0.0, abs=1e-15)


def test_a_window_sees_the_columns_of_its_place(rng: np.random.Generator):
    params, unit = ColumnNoise(offset_dn=1.0, gain_rel=0.01, wander_frames=5), stream(rng)
    whole = flat(10.0, (6, 40), n=3, kind=Kind.DN)
    part = flat(10.0, (2, 9), n=3, kind=Kind.DN, row0=3, col0=17, frame_shape=(6, 40))
    assert isinstance(part.grid, Grid)
    assert np.array_equal(forward(params, part, unit).data, forward(params, whole, unit).data[:, 3:5, 17:26])
