"""The video coders, against files written and read through a container, the standards' quantiser, and what prediction must do."""

from __future__ import annotations

import io
import sys
from itertools import pairwise

import av
import numpy as np
import pytest

from pixmetry.camera.signal import Kind, Signal
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.sources.storage.video_codec import Coder, VideoCodec, forward, start
from source_signals import signal, stream

LOSSY = [("h264", 8), ("h264", 10), ("hevc", 8), ("hevc", 12)]


def frames(count: int, shape: tuple[int, int], bits: int, noise_rel: float = 0.1, seed: int | None = None) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.5, noise_rel, (count, *shape))
    return np.rint(np.clip(noise, 0, 1) * (2**bits - 1)).astype(np.uint16)


def codes(images: np.ndarray) -> Signal:
    return signal(images, Kind.CODES).with_data(images)


def coded(rng: np.random.Generator, params: VideoCodec, images: np.ndarray) -> np.ndarray:
    return forward(params, codes(images), stream(rng), start(params))[0].data


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("shape", [(1, 1), (17, 31), (48, 64)])
def test_ffv1_gives_every_code_back(bits: int, shape: tuple[int, int], rng: np.random.Generator) -> None:
    images = rng.integers(0, 2**bits, (3, *shape)).astype(np.uint16)
    assert np.array_equal(coded(rng, VideoCodec(codec="ffv1", depth_bits=bits), images), images)


@pytest.mark.parametrize(("codec", "bits"), LOSSY)
@pytest.mark.parametrize("control", ["qp", "crf"])
def test_frames_are_those_of_a_file_written_and_read_through_a_container(
    codec: str, bits: int, control: str, rng: np.random.Generator
) -> None:
    """The oracle writes a Matroska file with the encoder's own pictures from arrays, then demultiplexes and decodes it."""
    images = frames(7, (48, 96), bits)
    library, kind = {"h264": "libx264", "hevc": "libx265"}[codec], {8: "gray", 10: "gray10le", 12: "gray12le"}[bits]
    private = "keyint=3:min-keyint=3:scenecut=0"
    options = {"preset": "medium", "tune": "zerolatency", "threads": "1"}
    if codec == "h264":
        options |= {"x264-params": private, control: str(20 + (12 if control == "qp" and bits == 10 else 0))}
    else:
        options |= {"x265-params": f"{private}:open-gop=0:pools=none:frame-threads=1:log-level=none", control: "20"}
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as container:
        video = container.add_stream(library, rate=25, options=options)
        video.width, video.height, video.pix_fmt = 96, 48, kind
        for image in images:
            picture = av.VideoFrame.from_ndarray(image.astype(np.uint8) if bits == 8 else image, format=kind)
            container.mux(video.encode(picture))
        container.mux(video.encode())
    file.seek(0)
    with av.open(file) as container:
        want = [f.to_ndarray()[:48, :96] for f in container.decode(video=0)]
    got = coded(rng, VideoCodec(codec=codec, control=control, quality=20, group=3, depth_bits=bits), images)
    assert len(want) == 7 and np.array_equal(got, want)
    assert not np.array_equal(got, images)


@pytest.mark.parametrize(("codec", "bits"), LOSSY)
def test_the_quantiser_has_the_standards_steps(codec: str, bits: int, rng: np.random.Generator) -> None:
    """White noise over many steps: between a uniform rounding, q²/12, and one that rounds down up to 5/6 of a step, q² (5³ + 1)/(3·6³).

    q = 2^((QP − 4)/6) at 8 bits; a picture that is coded by itself is finer by a factor of 1.4. 60 000 samples know the deviation to 0.3 %
    (1e-6: 1.5 %); the smallest error seen is about 20 %, and a QP counted from another depth would be a factor of 4.
    """
    images, scale = frames(10, (96, 64), bits, 0.12), 2.0 ** (bits - 8)
    error = {}
    for quality in (16, 22, 28):
        params = VideoCodec(codec=codec, control="qp", quality=quality, group=10, depth_bits=bits)
        e = (coded(rng, params, images).astype(float) - images) / scale
        step = 2 ** ((quality - 4) / 6)
        for part, q in ((e[1:], step), (e[:1], step / 1.4)):
            assert 0.8 * q / 12**0.5 < part.std() < 1.1 * q * (126 / 648) ** 0.5
        error[quality] = e[1:].std()
    for a, b in pairwise(sorted(error)):
        assert error[b] / error[a] == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize(("codec", "bits"), [("h264", 8), ("hevc", 10)])
def test_a_group_begins_with_a_picture_that_knows_nothing_of_the_past(codec: str, bits: int, rng: np.random.Generator) -> None:
    """At a constant quantiser it equals the picture coded by itself; the others do not."""
    images = frames(7, (32, 48), bits, 0.05)
    alone = coded(rng, VideoCodec(codec=codec, control="qp", group=1, depth_bits=bits), images)
    together = coded(rng, VideoCodec(codec=codec, control="qp", group=3, depth_bits=bits), images)
    assert [np.array_equal(a, t) for a, t in zip(alone, together, strict=True)] == [True, False, False, True, False, False, True]


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_pictures_coded_by_themselves_at_one_quantiser_have_no_memory(codec: str, rng: np.random.Generator) -> None:
    params = VideoCodec(codec=codec, control="qp", group=1)
    images = frames(4, (32, 48), 8, 0.05)
    one = Coder(params)
    assert start(params) is None
    assert np.array_equal(coded(rng, params, images), [one.follow(f) for f in images])


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_prediction_freezes_the_noise_of_a_still_scene(codec: str, rng: np.random.Generator) -> None:
    """Noise of 1 DN under a step of 13 DN: predicted pictures repeat the first one, where each frame's own would be new every time."""
    images = np.rint(rng.normal(120, 1, (6, 64, 64))).astype(np.uint16)
    images[:, 20:40, 20:40] += 60
    still = coded(rng, VideoCodec(codec=codec, control="qp", quality=26, group=6), images).astype(float)
    assert np.abs(np.diff(still, axis=0)).mean() < 0.02 * np.abs(np.diff(images.astype(float), axis=0)).mean()


@pytest.mark.parametrize(("codec", "control"), [("h264", "crf"), ("h264", "qp"), ("hevc", "crf")])
def test_the_first_frames_do_not_know_the_later_ones_and_the_caller_owns_nothing(
    codec: str, control: str, rng: np.random.Generator
) -> None:
    params = VideoCodec(codec=codec, control=control, group=4)
    images = frames(6, (33, 47), 8)
    whole = coded(rng, params, images)
    assert np.array_equal(coded(rng, params, images[:4]), whole[:4])
    state = start(params)
    parts = []
    for image in images:  # one by one with the state handed on
        out, state = forward(params, codes(image[None]), stream(rng), state)
        parts.append(out.data[0])
    assert np.array_equal(parts, whole)
    assert np.array_equal(coded(rng, params, images), whole)  # another start knows nothing of the first


@pytest.mark.parametrize("shape", [(96, 64), (48, 40), (16, 16), (64, 130)])
@pytest.mark.parametrize(("codec", "bits"), LOSSY)
def test_no_pixel_errs_by_many_steps(codec: str, bits: int, shape: tuple[int, int], rng: np.random.Generator) -> None:
    """A decoder that predicts from other pixels than the coder would show errors as large as the picture, growing from frame to frame."""
    images, step = frames(9, shape, bits, 0.12), 2.0 ** ((16 - 4) / 6 + bits - 8)
    for _ in range(3):
        out = coded(rng, VideoCodec(codec=codec, control="qp", quality=16, group=9, depth_bits=bits), images)
        assert np.abs(out.astype(float) - images).max() < 8 * step  # 4.7 steps once in some thousand runs; the picture has 64
        images = images[:, ::-1].copy()


def test_a_coarser_quantiser_errs_more_and_stores_less() -> None:
    images = frames(5, (64, 64), 8)
    errors, sizes = [], []
    for quality in (5, 12, 19, 26, 33):
        coder = Coder(VideoCodec(control="qp", quality=quality))
        errors.append(np.std([coder.follow(f).astype(float) - f for f in images]))
        sizes.append(coder.stored_bytes)
    assert errors == sorted(errors) and sizes == sorted(sizes, reverse=True)


def test_what_cannot_be_stored_is_refused_with_what_to_do(rng: np.random.Generator) -> None:
    with pytest.raises(ParameterError, match=r"8 bits.*found 300.*depth_bits"):
        coded(rng, VideoCodec(), np.full((1, 8, 8), 300, np.uint16))
    with pytest.raises(ValueError, match=r"h264 does not store"):
        VideoCodec(codec="h264", depth_bits=12)
    coder = Coder(VideoCodec())
    coder.follow(np.zeros((16, 16), np.uint16))
    with pytest.raises(ParameterError, match="differ in size"):
        coder.follow(np.zeros((32, 16), np.uint16))


def test_without_the_library_the_message_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"\.\[video\]"):
        coded(rng, VideoCodec(), np.zeros((1, 8, 8), np.uint16))
