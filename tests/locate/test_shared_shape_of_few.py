"""What targets share is told by a sample of them; a larger sample that tells nothing leaves the smaller one as it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.locate import noise_correlation
from pixmetry.locate.job import locate

SUB, SIDE = 3, 320


def discs(rng: np.random.Generator) -> np.ndarray:
    """36 dark discs, ever larger from left to right, sharpened and with noise."""
    at = (np.arange(SIDE * SUB) + 0.5) / SUB - 0.5
    light = np.ones((SIDE * SUB, SIDE * SUB), np.float32)
    for i in range(6):
        for j in range(6):
            x, y = 30 + 50 * i + rng.uniform(-1, 1), 30 + 50 * j + rng.uniform(-1, 1)
            light[np.hypot(at[None, :] - x, at[:, None] - y) < 6 + 1.1 * i] = 0.0
    soft = gaussian_filter(light, 0.9 * SUB).reshape(SIDE, SUB, SIDE, SUB).mean(axis=(1, 3))
    sharp = soft + 0.8 * (soft - gaussian_filter(soft, 1.5))
    noise = gaussian_filter(rng.normal(size=soft.shape), 0.8)
    return np.clip(np.rint(50 + 140 * sharp + 0.8 * noise / noise.std()), 0, 255).astype(np.uint8)


def test_a_larger_sample_that_shows_nothing_leaves_the_smaller_one(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets of many sizes, so that their windows differ: what is left of one is never taken with the noise of another."""
    real, asked = noise_correlation.shared_shape, []

    def of_few(drawn, noise):
        asked.append(len(drawn))
        return None if len(asked) > 1 else real(drawn, noise)

    monkeypatch.setattr(noise_correlation, "shared_shape", of_few)
    found = locate(discs(rng), kind="disc")
    assert len(asked) == 2 and asked[1] > asked[0]
    assert len(found) == 36 and np.isfinite(found.var_x_px2).all()
