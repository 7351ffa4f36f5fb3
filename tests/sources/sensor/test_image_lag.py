"""Image lag: what stays in the photodiode comes later, and all of it comes."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.sensor.image_lag import SOURCE, ImageLag, forward, start
from source_signals import Z, quiet, signal, stream


def run(params: ImageLag, data: np.ndarray, draws: object = None) -> tuple[np.ndarray, np.ndarray]:
    out, state = forward(params, signal(data), draws or quiet(), start(params))
    return out.data.astype(float), state


def test_a_flash_decays_geometrically() -> None:
    flash = np.zeros((8, 3, 4), np.float32)
    flash[0] = 10_000.0
    out, _ = run(ImageLag(lag_rel=0.1), flash)
    assert out[:, 1, 2] == pytest.approx(9000 * 0.1 ** np.arange(8), rel=1e-5)


def test_conserves_charge_with_a_pocket_too(rng: np.random.Generator) -> None:
    data = rng.uniform(0, 3000, (12, 5, 6)).astype(np.float32)
    out, state = run(ImageLag(lag_rel=0.05, pocket_e=30.0), data)
    assert out.sum(axis=0) + state == pytest.approx(data.sum(axis=0), rel=1e-6)
    dim, _ = run(ImageLag(pocket_e=50.0), np.full((1, 2, 2), 10.0, np.float32))
    assert dim[0] == pytest.approx(10.0 - 50 * (1 - np.exp(-0.1)), rel=1e-5)


def test_a_moving_target_is_behind_by_lambda_v_over_one_minus_lambda() -> None:
    """The ghost k frames old has the weight (1 − λ) λ^k and lies k v behind: the mean is λ v/(1 − λ)."""
    lag, v = 0.2, 0.7
    x = np.arange(200)
    frames = np.exp(-0.5 * ((x - 40 - v * np.arange(60)[:, None]) / 2) ** 2)[:, None, :]
    out, _ = run(ImageLag(lag_rel=lag), 1000 * frames)
    centre = (out[-1, 0] * x).sum() / out[-1, 0].sum()
    assert centre == pytest.approx(40 + v * 59 - v * lag / (1 - lag), abs=1e-4)


def test_steady_light_keeps_its_shot_noise(rng: np.random.Generator) -> None:
    """Each electron stays for itself: Poisson's variance, and frames that do not know of each other, to 1 % (a share: −18 and +16 %)."""
    frames = rng.poisson(4000, (12, 300, 300)).astype(np.float32)
    out, state = run(ImageLag(lag_rel=0.1), frames, stream(rng))
    assert np.array_equal(out.sum(axis=0) + state, frames.astype(float).sum(axis=0))
    late = out[6:] - 4000
    n = late.size
    assert late.mean() == pytest.approx(0, abs=Z * np.sqrt(4000 / n) * 1.3)
    assert late.var() / 4000 == pytest.approx(1, abs=Z * np.sqrt(2 / n))
    assert (late[1:] * late[:-1]).mean() / 4000 == pytest.approx(0, abs=Z / np.sqrt(n * 5 / 6))


def test_no_memory_where_nothing_stays(rng: np.random.Generator) -> None:
    assert start(ImageLag()) is None
    data = signal(np.ones((2, 3, 3)))
    assert forward(ImageLag(), data, stream(rng), None)[0] is data
    assert SOURCE.neutral == ImageLag()
