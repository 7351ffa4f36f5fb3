"""Sharpening: the overshoot of an edge and the gain of noise in closed form, and SciPy's Gaussian."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erfc

from pixmetry.sources.processing.sharpening import Sharpening, forward, propagate
from source_signals import Z, centroid_probe, spot_probe, stream
from sources.processing.code_frames import codes, disc, soft_centroid


def sharpened(rng: np.random.Generator, image: np.ndarray, **kw) -> np.ndarray:
    return forward(Sharpening(**kw), codes(image), stream(rng)).data[0].astype(float)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0])
def test_unsharp_mask_with_scipys_gaussian(sigma, rng: np.random.Generator):
    image = rng.integers(20_000, 40_000, (31, 26)).astype(float)
    want = image + 0.7 * (image - gaussian_filter(image, sigma, truncate=3.0, mode="mirror"))
    assert np.abs(sharpened(rng, image, amount=0.7, sigma_px=sigma, bits=16) - want).max() <= 0.5 + 1e-6


def test_overshoot_of_a_step_in_closed_form(rng: np.random.Generator):
    """Pixel d beside the step: a h Σ_(k > d) w_k; beside it a h (1 − w_0)/2. For a wide mask a h erfc((d + ½)/(σ√2))/2."""
    height, amount, sigma = 20_000.0, 0.5, 4.0
    image = 20_000 + height * (np.arange(60) >= 30) * np.ones((40, 1))
    row = sharpened(rng, image, amount=amount, sigma_px=sigma, bits=16)[20]
    k = np.arange(-12, 13)
    w = np.exp(-(k**2) / (2 * sigma**2))
    w /= w.sum()
    for d in range(8):
        tail = float(w[k > d].sum())
        assert row[30 + d] - 40_000 == pytest.approx(amount * height * tail, abs=0.51)
        assert 20_000 - row[29 - d] == pytest.approx(amount * height * tail, abs=0.51)
    assert row[30] - 40_000 == pytest.approx(amount * height * (1 - w[k == 0][0]) / 2, abs=0.51)
    assert row[30] - 40_000 == pytest.approx(amount * height * erfc(0.5 / (sigma * math.sqrt(2))) / 2, rel=0.01)


def test_white_noise_grows_by_the_sum_of_squares(rng: np.random.Generator):
    """σ'²/σ² = (1 + a)² − 2 a (1 + a) w_00 + a² Σ w²; 160 000 pixels, at 1e-6, the noise of neighbours being correlated: 2 %."""
    amount, sigma = 1.0, 1.0
    noise = np.rint(rng.normal(3000, 100, (400, 400)))
    k = np.arange(-3, 4)
    w = np.exp(-(k**2) / (2 * sigma**2))
    w2 = np.outer(w, w) / w.sum() ** 2
    want = (1 + amount) ** 2 - 2 * amount * (1 + amount) * w2[3, 3] + amount**2 * (w2**2).sum()
    got = sharpened(rng, noise, amount=amount, sigma_px=sigma, bits=16)[3:-3, 3:-3].var() / noise.var()
    assert got == pytest.approx(want, rel=2 * Z * math.sqrt(2 / noise.size))


def test_it_is_held_at_the_ends_of_the_range_and_does_not_wrap(rng: np.random.Generator):
    image = np.where(np.arange(30) < 15, 3, 250) * np.ones((10, 1))
    got = sharpened(rng, image, amount=3.0, bits=8)
    assert got.min() == 0 and got.max() == 255
    assert np.all(got[:, :15] <= 3) and np.all(got[:, 15:] >= 250)


def test_a_spot_within_the_range_has_no_bias():
    got = propagate(Sharpening(amount=0.0), spot_probe())
    assert (got.u_x_px, got.bias_x_px) == (0.0, 0.0)
    wide = propagate(Sharpening(amount=0.5), spot_probe(sigma=3.0))
    assert abs(wide.bias_x_px) < 1e-3


def test_predicted_shifts_are_those_of_sharpened_codes(rng: np.random.Generator):
    """Discs of 3 px on a background of 160 codes of 12 bits, whose undershoot is held at black; centroid above 320, at six places."""
    x, y = np.array([-0.4, -0.2, -0.1, 0.1, 0.3, 0.5]), np.array([0.2, -0.3, 0.4, 0.0, -0.1, 0.3])
    images = np.stack([160 + 16 * disc(a, b, 3.0) for a, b in zip(x, y, strict=True)])
    params = Sharpening(amount=2.0, sigma_px=1.5, bits=12)

    def located(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = np.array([soft_centroid(f, 320.0) for f in frames])
        return found[:, 0] + 12, found[:, 1] + 12

    probe = replace(centroid_probe(images, x + 12, y + 12), locate=located)
    probe = replace(probe, **dict(zip(("x_hat_px", "y_hat_px"), located(images), strict=True)), gx=0 * probe.gx, gy=0 * probe.gy)
    seen = located(forward(params, codes(np.rint(images)), stream(rng)).data.astype(float))
    dx, dy = (after - before for after, before in zip(seen, located(images), strict=True))
    got = propagate(params, probe)
    assert (got.u_x_px, got.u_y_px) == (pytest.approx(dx.std(), abs=3e-4), pytest.approx(dy.std(), abs=3e-4))
    assert (got.bias_x_px, got.bias_y_px) == (pytest.approx(dx.mean(), abs=3e-4), pytest.approx(dy.mean(), abs=3e-4))
    assert dx.std() > 0.003
