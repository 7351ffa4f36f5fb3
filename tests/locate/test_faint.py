"""Faint targets and crowded frames: recall, the stated rate of false alarms, and what coders and colour mosaics must not do."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.stats import binom, poisson

import pixmetry
from locate.test_detection import assert_exactly, discs, stored
from pixmetry.locate.detect.detection import Detection, detect, select
from pixmetry.locate.frame import looks_like_mosaic

SIDE = 256
SURE = 1e-7  # false alarms a frame, where the number of targets is asserted
NOISE_DN = 20.0
FRAMES, STATED = 60, 2.0  # of noise, and the rate that is asked for


def found_in(frame: np.ndarray, rate: float = SURE) -> Detection:
    return detect(frame, false_alarms=rate, threads=1)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("radius, blur, ratio", [(3.5, 2.0, 5.0), (3.5, 0.7, 4.0), (8.0, 0.7, 3.0)])
def test_finds_discs_that_no_pixel_shows(radius: float, blur: float, ratio: float, sign: int, rng: np.random.Generator) -> None:
    """Their height is 3 to 5 standard deviations of a pixel, less than its threshold; of the whole it is 15 or more."""
    light, truth = discs(rng, (420, 420), 30, radius, radius, blur)
    found = found_in(stored(rng, 1000 + sign * ratio * NOISE_DN * light, NOISE_DN, np.uint16))
    assert_exactly(found.targets, truth, within=1.5)
    assert select(found.targets, "disc").all()
    assert found.polarity == ("bright" if sign > 0 else "dark")


def test_finds_stars(rng: np.random.Generator) -> None:
    """Gaussian spots of 1 px and 6 standard deviations: 98 of 100 or more on average, at the rate that is the default."""
    places = np.stack(np.meshgrid(np.arange(15, 400, 20), np.arange(15, 400, 20)), axis=-1).reshape(-1, 2) + rng.uniform(-3, 3, (400, 2))
    y, x = np.indices((410, 410))
    light = np.zeros(x.shape)
    for a, b in places:
        box = slice(int(b) - 8, int(b) + 9), slice(int(a) - 8, int(a) + 9)
        light[box] += np.exp(-((x[box] - a) ** 2 + (y[box] - b) ** 2) / 2)
    found = detect(stored(rng, 1000 + 6 * NOISE_DN * light, NOISE_DN, np.uint16)).targets
    near = np.hypot(found.x_px[:, None] - places[:, 0], found.y_px[:, None] - places[:, 1]).min(axis=0) < 1.5
    assert near.sum() > binom.ppf(1e-6, len(places), 0.98)


def correlated(rng: np.random.Generator, over_px: float) -> np.ndarray:
    grain = gaussian_filter(rng.normal(size=(SIDE + 40, SIDE + 40)), over_px)[20:-20, 20:-20]
    return grain / grain.std()


def white(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(SIDE, SIDE))


NOISES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "white": lambda rng: 500 + NOISE_DN * white(rng),
    "small": lambda rng: 500.3 + 0.3 * white(rng),
    "correlated over 1 px": lambda rng: 500 + NOISE_DN * correlated(rng, 1.0),
    "correlated over 2 px, and white": lambda rng: 500 + NOISE_DN * (correlated(rng, 2.0) + white(rng)),
    "rows": lambda rng: 500 + NOISE_DN * (white(rng) + rng.normal(size=(SIDE, 1))),
    "columns": lambda rng: 500 + NOISE_DN * (white(rng) + rng.normal(size=(1, SIDE))),
    "hot pixels": lambda rng: 500 + NOISE_DN * white(rng) + 3000 * (rng.random((SIDE, SIDE)) < 1e-3),
    "shot noise": lambda rng: rng.poisson(200 * np.cos(np.arctan(np.hypot(*(np.indices((SIDE, SIDE)) - SIDE / 2)) / 250)) ** 4),
    "few electrons": lambda rng: rng.poisson(2.0, (SIDE, SIDE)),
    "uneven light": lambda rng: 500 + 800 * np.exp(-((np.indices((SIDE, SIDE)) - 90) ** 2).sum(0) / 2 / 100**2) + NOISE_DN * white(rng),
    "steps of a slope": lambda rng: 60 + rng.uniform(0, 0.03) * np.arange(SIDE) + 0.05 * white(rng),
}


@pytest.mark.parametrize("name", NOISES)
def test_false_alarms_are_no_more_than_stated(name: str, rng: np.random.Generator) -> None:
    """Of noise of any kind; and of white noise not much less than stated, else targets would be lost to it. Each fails 1e-6."""
    count = sum(len(found_in(np.clip(np.rint(NOISES[name](rng)), 0, 65535).astype(np.uint16), STATED).targets) for _ in range(FRAMES))
    assert count <= poisson.isf(1e-6, FRAMES * STATED)
    if name == "white":
        assert count >= poisson.ppf(1e-6, 0.04 * FRAMES * STATED) and count > 0


def plate(rng: np.random.Generator, radius: float, covered: float, hexagonal: bool, side: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Light of a lattice of discs that cover a share of the frame, and their places."""
    pitch = np.sqrt(np.pi * radius**2 / covered * (2 / np.sqrt(3) if hexagonal else 1.0))
    row = pitch * (np.sqrt(3) / 2 if hexagonal else 1.0)
    y, x = np.meshgrid(np.arange(pitch, side, row), np.arange(pitch, side, pitch), indexing="ij")
    x[1::2] += pitch / 2 if hexagonal else 0.0
    places = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-0.5, 0.5, 2)
    places = places[((places > radius + 2) & (places < side - radius - 3)).all(axis=1)]
    fine = (np.arange(4 * side) + 0.5) / 4 - 0.5
    light = np.zeros((4 * side, 4 * side), np.float32)
    for x, y in places:
        a, b = (slice(max(int(4 * (c - radius - 2)), 0), int(4 * (c + radius + 3))) for c in (y, x))
        light[a, b] = np.maximum(light[a, b], np.hypot(fine[b][None] - x, fine[a][:, None] - y) < radius)
    return gaussian_filter(light, 4 * 0.7).reshape(side, 4, side, 4).mean(axis=(1, 3)), places


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize(
    "radius, covered, hexagonal", [(8, 0.45, False), (8, 0.7, False), (8, 0.63, True), (5, 0.63, True), (20, 0.6, True)]
)
def test_finds_all_discs_of_a_frame_that_they_cover(
    radius: float, covered: float, hexagonal: bool, dark: bool, rng: np.random.Generator
) -> None:
    """In light that falls off by a third to a corner: which side is the ground is told from the targets that it leaves."""
    light, places = plate(rng, radius, covered, hexagonal)
    lit = 1 - 0.35 * np.hypot(*(np.indices(light.shape) / 300)) ** 2 / 2
    found = detect(stored(rng, lit * (190 - 150 * light if dark else 40 + 150 * light), 2.0))
    targets = found.targets[select(found.targets, "disc")]
    assert_exactly(targets, places)
    assert (targets.amplitude_dn < 0).all() == dark
    assert found.reading in ("", "bright" if dark else "dark")
    if covered > 0.5:
        assert found.reading


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("radius, side", [(30.0, 81), (20.0, 60), (45.0, 130)])
def test_finds_one_large_disc_in_a_small_frame(radius: float, side: int, sign: int, rng: np.random.Generator) -> None:
    y, x = np.indices((side, side))
    place = side / 2 + rng.uniform(-1, 1, 2)
    light = np.clip(radius + 0.5 - np.hypot(x - place[0], y - place[1]), 0, 1)
    table = pixmetry.locate(stored(rng, 110 + sign * 75 * light, 2.0))
    assert len(table) == 1 and np.hypot(table.x_px[0] - place[0], table.y_px[0] - place[1]) < 0.2


@pytest.mark.parametrize("quality", [50, 75, 90])
@pytest.mark.parametrize("ratio, noise", [(10.0, 4.0), (50.0, 3.0), (150.0, 1.0)])
def test_what_a_coder_draws_is_no_target(quality: int, ratio: float, noise: float, rng: np.random.Generator) -> None:
    """At quality 50 the thresholds of pixels alone would find a dozen patterns for each disc. What is left out is told."""
    light, truth = discs(rng, (400, 400), 30, 5, 5)
    raw = io.BytesIO()
    Image.fromarray(stored(rng, 40 + ratio * noise * light, noise)).save(raw, "JPEG", quality=quality)
    found = found_in(np.array(Image.open(io.BytesIO(raw.getvalue()))))
    targets = found.targets[select(found.targets, "disc")]
    away = np.hypot(targets.x_px[:, None] - truth[:, 0], targets.y_px[:, None] - truth[:, 1])
    assert (away.min(axis=0) < 1).all()
    assert len(targets) <= len(truth) + (3 if quality < 90 else 0)


def test_a_colour_mosaic_is_told(rng: np.random.Generator) -> None:
    light, _ = discs(rng, (200, 200), 12, 4, 7)
    grey = 60 + 120 * light
    for colours in ([[0.5, 1.0], [1.0, 0.7]], [[1.0, 0.6], [0.8, 1.0]], [[0.8, 1.0], [1.0, 1.2]]):
        frame = stored(rng, grey * np.tile(colours, (100, 100)), 2.0)
        assert looks_like_mosaic(frame)
        assert "colour camera" in pixmetry.locate(frame, name="raw").images[0]["caution"]
    for plain in (grey, grey + 6 * (np.arange(200) % 2)[:, None], grey * (1 + 0.05 * (np.arange(200) % 2)), grey.round()):
        frame = stored(rng, plain, 2.0)
        assert not looks_like_mosaic(frame) and "caution" not in pixmetry.locate(frame).images[0]
