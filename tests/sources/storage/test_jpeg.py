"""The real codec, against the standard's quantiser, Parseval's theorem and a cosine transform of its own."""

from __future__ import annotations

import imagecodecs
import numpy as np
import pytest
from scipy.fft import dctn

from pixmetry.camera.jpeg_tables import steps
from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.errors import ParameterError
from pixmetry.sources.storage.jpeg import Jpeg, block_error, forward, round_trip
from source_signals import signal, stream


def codes(image: np.ndarray, **place: object) -> Signal:
    plain = signal(np.asarray(image)[None], Kind.CODES, **place)
    return plain.with_data(np.asarray(image)[None].astype(np.uint16))


def coded(rng: np.random.Generator, image: np.ndarray, quality: int) -> np.ndarray:
    return forward(Jpeg(quality=quality), codes(image), stream(rng)).data[0]


@pytest.mark.parametrize("shape", [(8, 8), (64, 48), (21, 37), (5, 3), (1, 1), (9, 16)])
def test_a_frame_is_what_the_codec_makes_of_it_whatever_its_size(shape: tuple[int, int], rng: np.random.Generator) -> None:
    """The oracle hands the frame to the codec as it is, and lets it complete the last blocks itself."""
    image = rng.integers(0, 256, shape).astype(np.uint8)
    for quality in (5, 60, 95, 100):
        want = imagecodecs.jpeg8_decode(imagecodecs.jpeg8_encode(image, level=quality))
        assert np.array_equal(coded(rng, image, quality), want.reshape(shape))


@pytest.mark.parametrize("quality", [1, 20, 49, 50, 75, 90, 100])
def test_the_quantiser_is_the_one_that_the_file_holds(quality: int) -> None:
    """The table is read from the file's own DQT segment, in zigzag order."""
    stored = imagecodecs.jpeg8_encode(np.zeros((8, 8), np.uint8), level=quality)
    at = stored.index(b"\xff\xdb")
    table = np.frombuffer(stored[at + 5 : at + 69], np.uint8)
    order = sorted(((r, c) for r in range(8) for c in range(8)), key=lambda p: (sum(p), p[0] if sum(p) % 2 else p[1]))
    assert np.array_equal(table, [steps(quality)[p] for p in order])


def test_a_batch_equals_its_windows_one_by_one(rng: np.random.Generator) -> None:
    images = rng.integers(0, 256, (7, 13, 22)).astype(np.uint16)
    batch = signal(images, Kind.CODES).with_data(images)
    got = forward(Jpeg(quality=40), batch, stream(rng)).data
    assert np.array_equal(got, [coded(rng, i, 40) for i in images])


def test_coefficients_come_out_as_multiples_of_their_steps(rng: np.random.Generator) -> None:
    """As far as the rounding of the decoded pixels lets one see it: ½ DN a pixel is below half a coarse step."""
    image = rng.normal(128, 12, (64, 64)).clip(40, 215).round()
    out = coded(rng, image, 15).astype(float) - 128
    q = steps(15)
    for r in range(0, 64, 8):
        for c in range(0, 64, 8):
            ratio = dctn(out[r : r + 8, c : c + 8], norm="ortho") / q
            assert np.abs(ratio - np.rint(ratio)).max() < 0.1


@pytest.mark.parametrize("quality", [80, 90, 95])
def test_white_noise_loses_a_twelfth_of_the_squared_steps(quality: int, rng: np.random.Generator) -> None:
    """Parseval: variance Σ q²/12/64, and up to 1/12 for whole codes, if the coefficients are spread over several steps.

    1600 blocks of 64 coefficients know it to about 1 % (1e-6: 5 %, the largest steps carrying most); the smallest error that would be
    seen is 8 %, far below a slip in the scale of the transform (a factor of 2 at least) or of the table (200 − 2Q).
    """
    image = rng.normal(128, 30, (320, 320)).clip(20, 235).round()
    ideal = (steps(quality) ** 2).sum() / 12 / 64
    assert block_error(image[None], quality).var() == pytest.approx(ideal, rel=0.08)
    assert (coded(rng, image, quality) - image).var() == pytest.approx(ideal + 1 / 24, rel=0.08)


@pytest.mark.parametrize("quality", [20, 50, 80, 95])
def test_the_model_of_the_propagator_follows_the_real_codec(quality: int) -> None:
    """Smooth image: error of model and codec agree but for ties, where one rounds up and the other down (at most 10 % of the blocks)."""
    y, x = np.mgrid[:96, :96]
    image = np.rint(128 + 60 * np.sin(x / 9.3) * np.cos(y / 7.1) + 20 * np.exp(-((x - 50) ** 2 + (y - 41) ** 2) / 18))
    real = round_trip(image.astype(np.uint8), quality).astype(float)
    model = np.rint(image + block_error(image[None], quality)[0])
    off = np.abs(real - model).reshape(12, 8, 12, 8).max(axis=(1, 3)) > 1
    assert off.mean() < 0.1
    assert (model - image).std() == pytest.approx((real - image).std(), rel=0.05)


def test_higher_quality_errs_less_and_a_hundred_is_not_the_identity(rng: np.random.Generator) -> None:
    image = rng.integers(0, 256, (64, 64))
    errors = [(coded(rng, image, q).astype(float) - image).std() for q in (10, 40, 70, 90, 100)]
    assert errors == sorted(errors, reverse=True) and 0 < errors[-1] < 0.6


def test_more_than_eight_bits_are_refused_with_what_to_do(rng: np.random.Generator) -> None:
    with pytest.raises(ParameterError, match=r"8 bits.*found 300.*bits: 8"):
        coded(rng, np.full((8, 8), 300), 90)
