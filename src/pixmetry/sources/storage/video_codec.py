"""Video coding: transform, prediction from picture to picture and coarse rounding, by the real coders."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from types import ModuleType
from typing import Any, Literal

import numpy as np
from pydantic import model_validator

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import InputError, MeasureError, ParameterError
from pixmetry.core.extras import import_extra
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

BLOCK = 16  # px: coded pictures are whole macroblocks; what a frame lacks is completed by repeating its last row and column
# libx265 predicts wrongly from the corners of a picture that is a single coding tree unit (64 px) wide; so none is
LEAST_COLS = {"h264": 16, "hevc": 80, "ffv1": 16}
ENCODERS = {"h264": "libx264", "hevc": "libx265", "ffv1": "ffv1"}
DEPTHS = {"h264": (8, 10), "hevc": (8, 10, 12), "ffv1": (8, 10, 12, 16)}  # bits of a grey sample
FORMATS = {8: "gray", 10: "gray10le", 12: "gray12le", 16: "gray16le"}


class VideoCodec(Parameters):
    """Setting of the coder."""

    codec: Literal["h264", "hevc", "ffv1"] = quantity("h264", "1", "H.264, HEVC, or FFV1 (lossless)")
    control: Literal["crf", "qp"] = quantity(
        "crf", "1", "crf: quantiser depends on the content of picture and block; qp: one quantiser for all (not FFV1)"
    )
    quality: int = quantity(23, "1", "quantiser of crf or qp: plus 6 doubles the rounding steps (not FFV1)", ge=1, le=51)
    group: int = quantity(12, "1", "number of frames from one independently coded picture to the next; 1: no prediction", ge=1, le=1000)
    depth_bits: Literal[8, 10, 12, 16] = quantity(8, "bit", "bits of a stored sample: H.264 8 or 10, HEVC also 12, FFV1 also 16")

    @model_validator(mode="after")
    def _depth(self) -> VideoCodec:
        if self.depth_bits not in DEPTHS[self.codec]:
            raise InputError(
                f"{self.codec} does not store grey samples of this depth",
                value=self.depth_bits,
                allowed=", ".join(map(str, DEPTHS[self.codec])),
                remedy="choose another depth_bits or codec",
            )
        return self

    @property
    def lossless(self) -> bool:
        """Whether the decoded frames are the coded ones."""
        return self.codec == "ffv1"

    @property
    def by_itself(self) -> bool:
        """Whether each frame is coded without regard to those before it (a crf follows them, even where nothing is predicted)."""
        return self.lossless or (self.group == 1 and self.control == "qp")


class Coder:
    """A coder and a decoder that follow the frames of one sequence; opened at its first frame, whose size they take."""

    def __init__(self, params: VideoCodec) -> None:
        self.params = params
        self.count = 0
        self.stored_bytes = 0
        self._size = (0, 0)
        self._pair: tuple[Any, Any] | None = None

    def follow(self, frame: np.ndarray) -> np.ndarray:
        """Code and decode the next frame, shape (rows, cols); the result is of its dtype."""
        av = import_extra("av")
        rows, cols = frame.shape
        wide = max(cols + -cols % BLOCK, LEAST_COLS[self.params.codec])
        picture = np.pad(frame, ((0, -rows % BLOCK), (0, wide - cols)), mode="edge")
        if self._pair is None:
            self._size, self._pair = picture.shape, _open(av, self.params, picture.shape)
        if picture.shape != self._size:
            raise ParameterError("the frames of a sequence differ in size", where="storage.video_codec", allowed="one size for all frames")
        coder, decoder = self._pair
        packets = coder.encode(_to_picture(av, picture, self.params.depth_bits, self.count))
        decoded = [p for packet in packets for p in decoder.decode(packet)]
        if len(decoded) != 1:
            raise RuntimeError(f"{self.params.codec} gave {len(decoded)} pictures for frame {self.count}")
        self.count += 1
        self.stored_bytes += sum(packet.size for packet in packets)
        return np.ascontiguousarray(_luma(decoded[0])[:rows, :cols]).astype(frame.dtype)


def _open(av: ModuleType, params: VideoCodec, shape: tuple[int, int]) -> tuple[Any, Any]:
    """Open a coder without look-ahead and a decoder; one thread each, so that the bits depend on nothing but the frames."""
    name = ENCODERS[params.codec]
    try:
        coder = av.CodecContext.create(name, "w")
        coder.width, coder.height, coder.pix_fmt = shape[1], shape[0], FORMATS[params.depth_bits]
        coder.time_base, coder.framerate = Fraction(1, 25), 25
        coder.thread_count, coder.gop_size, coder.max_b_frames = 1, params.group, 0
        coder.options = _options(params)
        coder.open()
    except (ValueError, OSError) as problem:  # PyAV's errors are children of these
        raise InputError(
            f"the coder {name} cannot be opened ({str(problem).splitlines()[0]})",
            where="storage.video_codec",
            remedy="install another build of the package 'av'",
        ) from None
    decoder = av.CodecContext.create(params.codec, "r")
    decoder.width, decoder.height, decoder.thread_count = shape[1], shape[0], 1
    if params.lossless:
        decoder.pix_fmt = FORMATS[params.depth_bits]
    if coder.extradata:
        decoder.extradata = coder.extradata
    return coder, decoder


def _options(params: VideoCodec) -> dict[str, str]:
    """Settings of the library: no pictures from the future, no cut of the sequence but at the group's end."""
    if params.lossless:
        return {"level": "3", "slicecrc": "1"}
    quality = params.quality
    if params.codec == "h264" and params.control == "qp":
        quality += 6 * (params.depth_bits - 8)  # libx264 counts from the finest quantiser of the depth, libx265 from that of 8 bits
    options = {"preset": "medium", "tune": "zerolatency", params.control: str(quality)}
    common = f"keyint={params.group}:min-keyint={params.group}:scenecut=0:bframes=0"
    if params.codec == "h264":
        return options | {"x264-params": common}
    return options | {"x265-params": f"{common}:open-gop=0:pools=none:frame-threads=1:wpp=0:log-level=none"}


def _to_picture(av: ModuleType, picture: np.ndarray, depth_bits: int, number: int) -> Any:
    frame = av.VideoFrame(picture.shape[1], picture.shape[0], FORMATS[depth_bits])
    plane, dtype = frame.planes[0], np.dtype(np.uint8 if depth_bits == 8 else "<u2")
    padded = np.zeros(plane.buffer_size // dtype.itemsize, dtype)
    padded.reshape(-1, plane.line_size // dtype.itemsize)[: picture.shape[0], : picture.shape[1]] = picture
    plane.update(padded.tobytes())
    frame.pts, frame.time_base = number, Fraction(1, 25)
    return frame


def _luma(frame: Any) -> np.ndarray:
    """The grey plane of a decoded picture (some decoders add empty colour planes)."""
    plane, dtype = frame.planes[0], np.dtype(np.uint8 if frame.format.components[0].bits == 8 else "<u2")
    return np.frombuffer(plane, dtype).reshape(-1, plane.line_size // dtype.itemsize)[: frame.height, : frame.width]


def start(params: VideoCodec) -> Coder | None:
    """A coder that has seen nothing yet; none where each frame is coded by itself."""
    return None if params.by_itself else Coder(params)


def forward(params: VideoCodec, signal: Signal, stream: Stream, state: Coder | None) -> tuple[Signal, Coder | None]:
    """Code and decode frame by frame as grey pictures; frame k is what a decoder shows that has been given frames 0 to k."""
    highest = (1 << params.depth_bits) - 1
    if signal.data.size and int(signal.data.max()) > highest:
        raise ParameterError(
            f"the video stores {params.depth_bits} bits",
            where="storage.video_codec",
            value=int(signal.data.max()),
            allowed=f"codes 0 to {highest}",
            remedy="set depth_bits to the converter's bits (H.264 to 10, HEVC to 12, FFV1 to 16), or use a converter of fewer bits",
        )
    data = np.empty_like(signal.data)
    for i, frame in enumerate(signal.data):
        data[i] = (Coder(params) if state is None else state).follow(frame)
    return signal.with_data(data), state


def context(params: VideoCodec, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole frame: prediction and rate reach everywhere in it."""
    return windows.full_frame(frame_shape)


def measure(observations: Observations) -> Estimates:
    """Coder, quantiser and group of frames that were recorded, against the same scene seen directly."""
    where = "storage.video_codec"
    recorded = observations.recordings
    group = 0 if recorded is None or "group" not in recorded.fit else int(recorded.fit["group"].value)
    found = observations.recorder({"quality": "quality"}, where=where, settings=["codec", "control", "depth_bits"])
    if found["quality"].is_limit:
        raise MeasureError(f"finer than a quantiser of {found['quality'].value:.0f}: {found.reasons['quality']}", where=where)
    return replace(found, settings={**found.settings, **({"group": group} if group else {})})


SOURCE = Source(
    id="storage.video_codec",
    title="Video compression",
    description="Each frame is predicted from earlier frames, and only a coarsely rounded difference is stored. Noise freezes, and fine "
    "changes lag.",
    parameters=VideoCodec,
    consumes=(Kind.CODES,),
    after=("sensor", "electronics", "cable", "grabber"),
    neutral=VideoCodec(codec="ffv1", depth_bits=16),
    typical=VideoCodec(),
    bound=VideoCodec(quality=32, group=50),
    forward=forward,
    measure=measure,
    context=context,
    start=start,
    option="compressed video",
    gum_class="F",
    equation="F' = q round((F − P)/q) + P of every coefficient of the difference to the prediction P;  q = 2^((QP − 4)/6) DN at 8 bits",
    typical_size="errors of q/√12 = 2.6 DN at QP 23; a change below about q from frame to frame is not stored at all",
    references=(
        "ITU-T H.264 | ISO/IEC 14496-10, clause 8.5 (transform and scaling)",
        "ITU-T H.265 | ISO/IEC 23008-2, clause 8.6",
        "IETF RFC 9043 (FFV1)",
        "G. J. Sullivan, T. Wiegand, Proc. IEEE 93 (2005) 18 (quantiser: a factor of 2 every 6 steps)",
    ),
    advice="Record without loss (raw, FFV1). If there is no choice: independently coded pictures (group 1), and a quantiser below 12.",
    reasons={
        "correct": "all pictures whose coefficients round to the same multiples give the same stream. What was rounded off is lost; "
        "store without loss",
        "propagate": "blocks and predictions depend on the whole picture and earlier ones; simulate sequences and locate targets in them",
    },
)
