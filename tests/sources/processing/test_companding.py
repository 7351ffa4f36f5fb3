"""Companding: the gaps of the histogram, the steps of each law, and the noise that the wider steps add."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.processing.companding import Companding, code_table, forward, propagate
from source_signals import spot_probe, stream
from sources.processing.code_frames import codes

ALL = np.arange(4096)


@pytest.mark.parametrize("law", ["truncated", "linear", "root"])
def test_256_of_4096_codes_remain_and_a_second_round_trip_changes_nothing(law):
    out = code_table(Companding(law=law, bits=12)).entries()
    kept = np.unique(out)
    assert kept.size == 256 or (law == "root" and 240 <= kept.size <= 256)  # near black, steps below one code coincide
    assert np.all(np.diff(out.astype(int)) >= 0)
    assert np.array_equal(out[out], out)
    assert out[0] == 0 and (law == "truncated" or out[-1] == 4095)


def test_laws_by_their_definition():
    assert np.array_equal(code_table(Companding(law="truncated", bits=12)).entries(), ALL // 16 * 16)
    linear = code_table(Companding(law="linear", bits=12)).entries().astype(float)
    assert np.abs(linear - ALL).max() <= 4095 / 255 / 2 + 0.5
    root = code_table(Companding(law="root", bits=12)).entries().astype(float)
    half = np.sqrt(ALL * 4095.0) / 255  # half the distance to the next code: (x'^(1/2) + 1/510 …)²
    assert np.all(np.abs(root - ALL) <= half + 4095 / 510**2 + 0.5)
    assert np.abs(root - ALL)[3000:].max() > 0.8 * half[3000]


def test_the_steps_of_the_root_law_follow_the_shot_noise():
    """Step 2 √(x x_max)/255 against a noise that goes as √x: one ratio at all levels; whole codes leave it ±1 in 11 or more."""
    kept = np.unique(code_table(Companding(law="root", bits=12)).entries()).astype(float)
    step, level = np.diff(kept), 0.5 * (kept[1:] + kept[:-1])
    bright = level > 500
    ratio = step[bright] / np.sqrt(level[bright])
    assert np.abs(ratio / (2 * np.sqrt(4095) / 255) - 1).max() < 0.1
    assert ratio.mean() == pytest.approx(2 * np.sqrt(4095) / 255, rel=0.01)


def test_codes_beyond_the_range_count_as_the_highest(rng: np.random.Generator):
    out = forward(Companding(law="linear", bits=12), codes(np.full((2, 2), 65535)), stream(rng)).data
    assert (out == 4095).all()


def test_as_many_bits_on_the_way_change_nothing():
    assert np.array_equal(code_table(Companding(law="linear", bits=10, transport_bits=12)).entries(), np.arange(1024))
    assert np.array_equal(code_table(Companding(bits=12)).entries(), ALL)


def test_predicted_noise_is_that_of_a_signal_spread_over_all_codes():
    """Mean square of the error less its mean, over codes that occur equally often: (16² − 1)/12 for four bits cut off."""
    error = code_table(Companding(law="truncated", bits=12)).entries().astype(float) - ALL
    probe = spot_probe()
    got = propagate(Companding(law="truncated", bits=12), probe)
    assert got.u_x_px == pytest.approx(probe.white(error.std())[0], rel=1e-9)
