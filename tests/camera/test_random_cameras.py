"""Cameras put together by chance from the catalogue: however the work is cut, the numbers are the same, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from catalogue.support import Texture
from pixmetry.camera import bands
from pixmetry.camera.camera import Camera, Element, in_order
from pixmetry.camera.catalogue import sources
from pixmetry.camera.signal import Kind
from pixmetry.core.random import Grid
from pixmetry.scene.discs import Discs
from pixmetry.scene.motion import Motion
from pixmetry.scene.picture import Picture
from pixmetry.scene.uniform import Uniform

CASES = 48
CONVERSIONS = ("sensor.quantum_efficiency", "electronics.gain", "grabber.adc")


def draw_chain(rng: np.random.Generator) -> list[Element]:
    """Three to twelve sources with typical parameters, and the conversions that belong to every camera."""
    able = [s for s in sources().values() if s.forward is not None]
    drawn = rng.choice(len(able), rng.integers(3, 13), replace=False)
    ids = {able[i].id for i in drawn} | set(CONVERSIONS)
    if "sensor.log_response" in ids:  # it makes the step to DN itself, in the pixel
        ids -= {s.id for s in able if s.stage == "electronics" and s.consumes == (Kind.ELECTRONS,)}
    return [Element(s.id, s, s.typical) for s in in_order(s for s in able if s.id in ids)]


def draw_scene(rng: np.random.Generator, shape: tuple[int, int]) -> Any:
    """A scene that changes with the frame, one that stands still, one that drifts, or one with a place per frame."""
    rows, cols = shape
    x, y = rng.uniform(-1, cols, 3), rng.uniform(-1, rows, 3)
    still = Discs(x, y, 5.0, 0.6, 9000.0, Uniform(4000.0))
    places = Discs(rng.uniform(-1, cols, (4, 2)), rng.uniform(-1, rows, (4, 2)), 4.0, 0.8, 7000.0, Uniform(2000.0), per_frame=True)
    drifting = Picture([still.layer(Motion(velocity_px_per_s=(9.0, -4.0)))], Uniform(4000.0))
    return [Texture(), still, places, drifting][rng.integers(4)]


def draw_window(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    height, width = (int(rng.integers(1, n + 1)) for n in shape)
    return int(rng.integers(shape[0] - height + 1)), int(rng.integers(shape[1] - width + 1)), height, width


@pytest.mark.parametrize("seed", range(CASES))
def test_windows_batches_bands_and_threads_give_the_crops_of_whole_frames(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(int(v) for v in rng.integers(1, 45, 2))
    camera = Camera("random", shape, draw_chain(rng), (8.0, 8.0), unit_seed=seed, warm_up_k=float(rng.choice([0.0, 8.0])), warm_up_s=0.05)
    scene, frames = draw_scene(rng, shape), sorted(rng.choice(5, 2, replace=False).tolist())
    told = f"{shape}, {type(scene).__name__}: {', '.join(e.name for e in camera.chain)}"
    monkeypatch.setattr(bands, "TILE_PIXELS", 1 << 30)
    whole = camera.expose(scene, frames, seed=seed, threads=1).data
    assert whole.shape[1:] == camera.output_shape and np.isfinite(whole).all(), told

    monkeypatch.setattr(bands, "TILE_PIXELS", 1)
    assert np.array_equal(camera.expose(scene, frames, seed=seed, threads=2).data, whole), told
    r, c, h, w = draw_window(rng, camera.output_shape)
    crop = whole[:, r : r + h, c : c + w]
    assert np.array_equal(camera.expose(scene, frames, seed=seed, window=(r, c, h, w), threads=1).data, crop), told
    assert np.array_equal(camera.expose(scene, frames[1:], seed=seed, window=(r, c, h, w), threads=2).data, crop[1:]), told

    if any(link.remembers for link in camera.links):
        return
    _, _, h, w = draw_window(rng, camera.output_shape)
    at = rng.integers(2, size=7)
    rows, cols = (rng.integers(0, n - size + 1, 7) for n, size in zip(camera.output_shape, (h, w), strict=True))
    batch = camera.expose_windows(scene, Grid(np.array(frames)[at], rows, cols, (h, w)), seed=seed)
    for i in range(7):
        assert np.array_equal(batch[i], whole[at[i], rows[i] : rows[i] + h, cols[i] : cols[i] + w]), told
