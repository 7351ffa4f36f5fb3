"""Smear: the streak of frame transfer, flushed and continuous, and of a leak under an interline shield."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.sources.sensor.full_well import SOURCE as FULL_WELL
from pixmetry.sources.sensor.full_well import FullWell
from pixmetry.sources.sensor.smear import SOURCE, Smear, correct, forward, truth
from source_signals import signal, spots, stream


def random_field(rng: np.random.Generator, rows: int = 37, cols: int = 9, n: int = 2) -> np.ndarray:
    return rng.uniform(0, 5000, (n, rows, cols)).astype(np.float32)


@pytest.mark.parametrize(("rows", "store"), [("all", "below"), ("passed", "below"), ("passed", "above")])
def test_it_is_the_matrix_of_the_rows_passed_and_correct_its_inverse(rows: str, store: str, rng: np.random.Generator) -> None:
    """I' = (1 + ε L) I with L of ones where a row's charge passes another; each frame with its own exposure."""
    data = random_field(rng)
    exposure = np.array([0.01, 0.002])
    params = Smear(transfer_s=1e-3, rows=rows, store=store)
    n = data.shape[1]
    passes = {"all": np.ones((n, n)), "below": np.triu(np.ones((n, n)), 1), "above": np.tril(np.ones((n, n)), -1)}
    matrix = passes["all" if rows == "all" else store]
    given = signal(data, exposure_s=exposure)
    out = forward(params, given, stream(rng))
    for i, t in enumerate(exposure):
        assert out.data[i] == pytest.approx(data[i] + 1e-3 / (n * t) * matrix @ data[i].astype(float), rel=1e-6)
    assert correct(params, out, {}).data == pytest.approx(data, rel=2e-6, abs=2e-3)
    assert np.array_equal(truth(params, given, stream(rng))["rows_passed"], matrix.sum(axis=1))


def test_scales_a_timing_ratio_of_0_16_percent(rng: np.random.Generator) -> None:
    """64 µs of transfer over 40 ms: even light grows by 0.16 %; 0.32 % over 20 ms."""
    even = np.full((2, 582, 3), 1000.0)
    out = forward(Smear(transfer_s=64e-6), signal(even, exposure_s=np.array([0.04, 0.02])), stream(rng)).data
    assert out[0] == pytest.approx(1001.6, abs=0.01)
    assert out[1] == pytest.approx(1003.2, abs=0.01)


def test_a_leak_of_an_interline_sensor_is_below_1e_4_of_the_columns_light(rng: np.random.Generator) -> None:
    """Leak 1e-4, 20 ms of read-out over 20 ms of exposure: a tenth of the height lit gives 1e-5 of the light in the dark rows."""
    data = np.zeros((1, 500, 2))
    data[0, 200:250, 0] = 10_000.0
    out = forward(Smear(transfer_s=0.02, leak_rel=1e-4), signal(data, exposure_s=0.02), stream(rng)).data[0]
    assert out[:100, 0] == pytest.approx(1e-4 * 0.1 * 10_000, rel=1e-5)
    assert (out[:, 1] == 0).all()


@pytest.mark.parametrize("store", ["below", "above"])
def test_a_target_moves_away_from_the_store_by_the_closed_form(store: str, rng: np.random.Generator) -> None:
    """Δy = ε (h² − ⟨y²⟩)/2 with h from the centre to the window's edge and ⟨y²⟩ that of the pixels' sum, to first order in ε."""
    h, eps = 12.5, 1e-4
    image = spots(np.array([12.0]), np.array([12.0]), 25, 2.0, 1000.0)
    params = Smear(transfer_s=eps * 25 * 0.01, rows="passed", store=store)
    out = forward(params, signal(image), stream(rng)).data.astype(float)[0]
    rows = np.arange(25) - 12.0
    square = (image[0].sum(axis=1) * rows**2).sum() / image[0].sum()
    shift = (out.sum(axis=1) * rows).sum() / out.sum()
    # over whole rows Σ_{−12 ≤ y < k} y = (k² − k)/2 − 78: a quarter less than h² stands for the sum
    expected = 0.5 * eps * ((h**2 - 0.25) - square)
    assert shift == pytest.approx(-expected if store == "below" else expected, rel=0.003)


def test_the_streak_knows_the_light_before_the_wells_are_full(rng: np.random.Generator) -> None:
    """A target 20 times over the full well makes 20 times the streak, although its image is clipped."""
    assert Kind.PHOTONS in SOURCE.consumes and "sensor.shot_noise" in SOURCE.before and "sensor.shot_noise" in FULL_WELL.after
    data = np.zeros((1, 50, 1))
    data[0, 20:25] = 200_000.0
    smeared = forward(Smear(transfer_s=1e-4), signal(data), stream(rng))
    clipped = FULL_WELL.forward(FullWell(full_well_e=10_000.0), smeared, stream(rng)).data[0, :, 0]
    assert clipped.max() == 10_000.0
    assert clipped[0] == pytest.approx(1e-4 / (50 * 0.01) * 1e6, rel=1e-6)


def test_columns_do_not_depend_on_how_the_frame_is_cut(rng: np.random.Generator) -> None:
    data = random_field(rng, 64, 40, 1)
    for rows in ("all", "passed"):
        params = Smear(transfer_s=1e-3, rows=rows)
        whole = forward(params, signal(data), stream(rng)).data
        assert np.array_equal(forward(params, signal(data[:, :, 13:29]), stream(rng)).data, whole[:, :, 13:29])
