"""Brighter-fatter: conservation, the photon transfer of flat fields, the widening of a spot in closed form, and the inversion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.core.errors import ParameterError
from pixmetry.sources.sensor.brighter_fatter import SOURCE, BrighterFatter
from source_signals import Z, flat, signal, spots, stream


def moved(rng: np.random.Generator, params: BrighterFatter, data: np.ndarray) -> np.ndarray:
    return SOURCE.forward(params, signal(data), stream(rng)).data.astype(float)


def test_charge_is_kept_and_a_flat_field_stays_flat(rng: np.random.Generator):
    data = rng.uniform(0, 50_000, (2, 40, 50))
    out = moved(rng, BrighterFatter(area_loss_per_e=2e-6, field_px=0.7), data)
    assert np.abs(out - data).max() > 50
    assert out.sum() == pytest.approx(data.sum(), rel=1e-7)
    even = np.full((1, 10, 10), 30_000.0)
    assert np.array_equal(moved(rng, BrighterFatter(area_loss_per_e=2e-6, field_px=0.7), even), even)


@pytest.mark.parametrize("field", [0.0, 0.6])
def test_a_lonely_pixel_loses_area_as_stated(field, rng: np.random.Generator):
    """A little more charge in one pixel of an even field: its border gives A/2 · q · δ away, half of the final loss of area."""
    data = np.full((1, 15, 15), 20_000.0)
    data[0, 7, 7] += 100
    out = moved(rng, BrighterFatter(area_loss_per_e=1e-6, field_px=field), data)
    assert data[0, 7, 7] - out[0, 7, 7] == pytest.approx(0.5 * 1e-6 * 20_050 * 100, rel=0.01)


def test_gaussian_spot_grows_by_its_peak(rng: np.random.Generator):
    """Continuous limit: d⟨x²⟩ = ½ a ∫q²/∫q = a P/4 with a = A/4, so σ² grows by A P/16."""
    sigma, peak, loss = 4.0, 40_000.0, 1e-6
    image = spots(np.array([30.2]), np.array([29.7]), size=61, sigma=sigma, peak=peak)
    out = moved(rng, BrighterFatter(area_loss_per_e=loss), image)
    x = np.arange(61.0)
    for axis in (1, 2):
        profiles = [data.sum(axis=(0, 3 - axis)) for data in (image, out)]
        before, after = ((p * (x - (p * x).sum() / p.sum()) ** 2).sum() / p.sum() for p in profiles)
        assert after - before == pytest.approx(loss * peak / 16, rel=0.02)


def test_photon_transfer_bends_and_neighbours_are_correlated(rng: np.random.Generator):
    """Var = µ (1 − Aµ/2)² + …, covariance of neighbours Aµ²/4 (1 − Aµ/2), to first order µ − Aµ² and Aµ²/4; 1e-6, catches 10 % of A."""
    mean, loss, n = 30_000.0, 5e-6, 4_000_000
    noisy = rng.poisson(mean, (4, 1000, 1000))
    out = moved(rng, BrighterFatter(area_loss_per_e=loss), noisy) - mean
    a = loss / 4 * mean  # flux per electron of difference across a border is a/2
    own, side = 1 - 2 * a, a / 2
    assert abs(out.var() / (mean * (own**2 + 4 * side**2)) - 1) < Z * math.sqrt(2 / n) + 1e-3
    pair = (out[:, :, 1:] * out[:, :, :-1]).mean()
    assert abs(pair - mean * 2 * own * side) < Z * mean / math.sqrt(n) + 0.002 * pair
    assert out.var() == pytest.approx(mean - loss * mean**2, rel=0.013)  # 5 a² = 0.8 % beyond the first order, and Z √(2/n)


def test_inversion_brings_the_charge_back_in_electrons_only(rng: np.random.Generator):
    params = BrighterFatter(area_loss_per_e=2e-6, field_px=0.5)
    data = rng.uniform(1000, 30_000, (1, 40, 40))
    out = SOURCE.forward(params, signal(data), stream(rng))
    back = SOURCE.correct(params, out, {})
    assert np.abs(out.data - data).max() > 100 > 1 > np.abs(back.data - data).max()
    with pytest.raises(ParameterError, match="electrons"):
        SOURCE.correct(params, flat(1.0, (4, 4), kind=Kind.DN), {})


def test_no_border_moves_farther_than_half_a_pixel(rng: np.random.Generator):
    data = np.zeros((1, 5, 5))
    data[0, 2, 2] = 1e7
    out = moved(rng, BrighterFatter(area_loss_per_e=1e-5), data)
    assert out[0, 2, 3] == pytest.approx(0.5 * 0.5 * 0.5 * 1e7, rel=1e-6) and out.min() >= 0
