"""The conversions that a camera inserts into its chain: sampling of the scene by pixels, the video line, sampling of the line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pixmetry.camera.line import Line
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, run
from pixmetry.core.random import Grid, QuietStreams, Stream


@dataclass(frozen=True)
class Link:
    """One step of a running chain: an element that is on, or a conversion; ``shape`` is that of the frames that it takes."""

    name: str
    source: Source
    params: Any
    shape: tuple[int, int]

    @property
    def shape_out(self) -> tuple[int, int]:
        """Rows and columns of the frames that it makes."""
        return self.shape if self.source.reshape is None else self.source.reshape(self.params, self.shape)

    @property
    def far(self) -> bool:
        """Whether it looks farther than the mode ``frozen`` follows it; of the line's sources, only their sampling does."""
        return self.source.near is not None and Kind.VIDEO not in self.source.consumes or self.source is SAMPLE

    def nearby(self, windows: Windows) -> Windows:
        """The input windows of the mode ``frozen``."""
        if self.source.near is None:
            return windows
        seen: Windows = self.params.pixels_of(windows, self.shape) if self.source is SAMPLE else windows
        up, down, left, right = self.source.near(self.params)
        return seen.expand(up, down, left, right, self.shape)

    @property
    def remembers(self) -> bool:
        """Whether it has a memory with these parameters."""
        return self.source.start is not None and self.source.start(self.params) is not None


class Nothing(Parameters):
    """No parameters."""


@dataclass(frozen=True)
class LineSources:
    """Parameters of the sampling: the sources of the line signal before it, and the camera's pixel clock and row."""

    links: tuple[Link, ...]
    pixel_hz: float
    row_px: int = 0  # of a row of pixels, for how far the line is followed

    @cached_property
    def line(self) -> Line:
        """The line without random draws, for its geometry; made once for any number of windows."""
        zero = np.zeros(1)
        return self.line_at(Signal(np.zeros((1, 1, 1), np.float32), Kind.DN, Grid.whole([0], (1, 1)), (1, 1), zero, zero, zero))

    def line_at(self, signal: Signal) -> Line:
        """The line at the time and temperature of a signal, every draw at its mean."""
        line = Line(self.pixel_hz, self.pixel_hz)
        signal = replace(signal, kind=Kind.VIDEO, clock=replace(signal.clock, pixel_hz=self.pixel_hz), line=line)
        for link in self.links:
            signal, _ = run(link.source, link.params, replace(signal, frame_shape=link.shape), QuietStreams(0, 0).of(link.name))
        return signal.own_line

    def pixels_of(self, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
        """The pixels at which the samples of some windows look."""
        first = np.floor(self.line.pixels(windows.col0.astype(float))).astype(np.int64)
        last = np.ceil(self.line.pixels((windows.col0 + windows.cols - 1).astype(float))).astype(np.int64)
        first, last = np.clip(first, 0, frame_shape[1] - 1), np.clip(last, 0, frame_shape[1] - 1)
        return Windows(windows.row0, first, windows.rows, last - first + 1)

    def samples_at(self, grid: Grid, frame_shape: tuple[int, int]) -> Grid:
        """The samples that look at a batch of windows of pixels; at the ends of the row, all that look beyond.

        Windows of one size may be seen by different numbers of samples: all get as many as the one with most.
        """
        line, cols = self.line, grid.shape[1]
        samples = line.samples or frame_shape[1]
        first = np.ceil(line.placed(grid.col0.astype(float)) - 1e-9).astype(np.int64)
        last = np.floor(line.placed((grid.col0 + cols - 1).astype(float)) + 1e-9).astype(np.int64)
        first = np.clip(np.where(grid.col0 == 0, 0, first), 0, samples - 1)
        last = np.clip(np.where(grid.col0 + cols == frame_shape[1], samples - 1, last), first, samples - 1)
        count = int((last - first).max(initial=0)) + 1
        return Grid(grid.frame, grid.row0, np.minimum(first, samples - count), (grid.shape[0], count))


def look(signal: Signal, photons: np.ndarray | None = None) -> Signal:
    """The light as numbers: sampled, or given by somebody who has sampled it."""
    return replace(signal, data=signal.own_light.photons() if photons is None else photons, kind=Kind.PHOTONS, light=None)


def _look(params: Nothing, signal: Signal, stream: Stream) -> Signal:
    return look(signal)


def _hold(params: Nothing, signal: Signal, stream: Stream) -> Signal:
    return replace(signal, kind=Kind.VIDEO, line=Line(signal.clock.pixel_hz, signal.clock.pixel_hz))


def _sample(params: LineSources, signal: Signal, stream: Stream) -> Signal:
    line = signal.own_line
    if line.plain:
        return replace(signal, kind=Kind.DN, line=None)
    line = line.limited()
    grid = params.samples_at(signal.grid, signal.frame_shape)
    data = line.read(signal.data, signal.grid.col0, grid)
    shape = (signal.frame_shape[0], line.samples or signal.frame_shape[1])
    return replace(signal, data=data, kind=Kind.DN, line=None, grid=grid, frame_shape=shape)


def _sample_context(params: LineSources, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """Whole rows, unless the samples are the pixels; anything to the left may still be on the line."""
    return windows if params.line.plain else windows.full_rows(frame_shape)


def _sample_near(params: LineSources) -> tuple[int, int, int, int]:
    clock = params.pixel_hz, params.row_px
    reaches = [link.source.near(link.params, *clock) for link in params.links if link.source.near is not None]
    left, right = (sum(r[i] for r in reaches) for i in (2, 3))
    return 0, 0, left + 1, right + 1


def _sample_tail(params: LineSources) -> float:
    clock = params.pixel_hz, params.row_px
    return float(sum(link.source.tail(link.params, *clock) for link in params.links if link.source.tail is not None))


def _sample_reshape(params: LineSources, frame_shape: tuple[int, int]) -> tuple[int, int]:
    return frame_shape[0], params.line.samples or frame_shape[1]


def _sample_place(
    params: LineSources, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int], frame: int
) -> tuple[np.ndarray, np.ndarray]:
    return params.line.placed(x), y


def _conversion(id: str, title: str, consumes: Kind, produces: Kind, forward: Any, **kw: Any) -> Source:
    why = dict.fromkeys(("measure", "correct", "propagate", "neutral"), "a conversion that belongs to every chain")
    return Source(
        id=id,
        title=title,
        description=title,
        parameters=Nothing,
        consumes=(consumes,),
        produces=produces,
        typical=Nothing(),
        bound=Nothing(),
        gum_class="F",
        equation="",
        typical_size="",
        references=(),
        advice="",
        essential=True,
        forward=forward,
        reasons=why,
        **kw,
    )


LOOK = _conversion("core.look", "pixels sample the scene", Kind.LIGHT, Kind.PHOTONS, _look)
HOLD = _conversion("core.hold", "pixels are held on the video line", Kind.DN, Kind.VIDEO, _hold)
SAMPLE = _conversion(
    "core.sample",
    "the video line is sampled",
    Kind.VIDEO,
    Kind.DN,
    _sample,
    context=_sample_context,
    near=_sample_near,
    tail=_sample_tail,
    reshape=_sample_reshape,
    place=_sample_place,
)
STEPS = {(Kind.LIGHT, Kind.PHOTONS): LOOK, (Kind.DN, Kind.VIDEO): HOLD, (Kind.VIDEO, Kind.DN): SAMPLE}


def conversion(kind: Kind, consumes: tuple[Kind, ...]) -> Source | None:
    """The conversion that a chain needs between a kind and a source; None if it needs none, or there is none."""
    if kind in consumes:
        return None
    return next((STEPS[kind, k] for k in consumes if (kind, k) in STEPS), None)


def linked(elements: Any, frame_shape: tuple[int, int], pixel_hz: float) -> tuple[Link, ...]:
    """The running chain of a checked camera: the elements that are on, with the conversions between them; it ends with numbers."""
    links: list[Link] = []
    kind: Kind = Kind.LIGHT
    shape, on_line = frame_shape, []

    def add(name: str, source: Source, params: Any) -> None:
        nonlocal kind, shape
        link = Link(name, source, params, shape)
        links.append(link)
        if source.consumes == (Kind.VIDEO,) and source is not SAMPLE:
            on_line.append(link)
        kind, shape = source.produces or kind, link.shape_out

    def convert(source: Source) -> None:
        params = LineSources(tuple(on_line), pixel_hz, shape[1]) if source is SAMPLE else Nothing()
        on_line.clear()
        add(f"{source.id} {len(links)}", source, params)

    for element in elements:
        step = conversion(kind, element.source.consumes)
        if step is not None:
            convert(step)
        add(element.name, element.source, element.params)
    if kind in (Kind.LIGHT, Kind.VIDEO):
        convert(LOOK if kind is Kind.LIGHT else SAMPLE)
    return tuple(links)
