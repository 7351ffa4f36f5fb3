"""A camera: an ordered chain of error sources with parameters, checked when it is built, and run over frames or windows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.bands import cut_bands, find_segment, stitch
from pixmetry.camera.chain_order import Element, check_chain, in_order
from pixmetry.camera.conversions import LOOK, SAMPLE, Link, linked, look
from pixmetry.camera.frozen import Frozen, one_value, settled_state
from pixmetry.camera.light import Light, Scene
from pixmetry.camera.provenance import check_provenance, estimates_of, provenance_record
from pixmetry.camera.signal import Clock, Kind, Signal, Windows
from pixmetry.camera.source import run
from pixmetry.camera.unit_maps import MeasuredUnit, check_frame, check_maps, listing, maps_file, read_unit_maps, write_unit_maps
from pixmetry.core.arguments import typed
from pixmetry.core.checksums import check_file
from pixmetry.core.door import MOST_OF_CAMERA, check_pixels
from pixmetry.core.errors import ChainError, InputError
from pixmetry.core.memory import check_memory
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, QuietStreams, Streams
from pixmetry.core.threads import imap_tiles, map_tiles

SCHEMA, SHEET_SCHEMA = "pixmetry/camera/1", "pixmetry/data_sheet/1"
BATCH_PIXELS = 1 << 18  # of the small windows that are run as one batch: enough that the calls cost little beside the work
MOST_PIXELS = 1 << 22  # that a batch needs of its frames: windows that need whole frames are run a few at a time, so that memory is bounded


@dataclass(frozen=True)
class Camera:
    """An ordered set of sources with parameters.

    Parameters
    ----------
    name : str
    frame_shape : (int, int)
        Rows and columns.
    chain : sequence of Element
        In the order in which the light meets them.
    pitch_um : (float, float), optional
        Pixel pitch in x and y.
    exposure_s, temperature_c : float
        The default schedule; the temperature is that of the sensor when it has settled.
    warm_up_k, warm_up_s : float
        How much colder the sensor is at time 0, and the time constant with which it warms up.
    pixel_clock_hz, line_period_s : float
        Of the read-out; CCIR unless told otherwise.
    measured : MeasuredUnit, optional
        The unit that the elements' maps were measured in. With its seed they take the place of drawn patterns; with another seed the camera
        is another one of the type, and its patterns are drawn.
    unit_seed : int
        What this unit's fixed patterns are drawn from: another seed is another camera of the same type.
    facts : mapping
        Anything else that is known of it: ``interface``, ``sensor``, ``bits``, where the numbers come from.

    Raises
    ------
    ChainError
        If names repeat, kinds do not fit, or a declared order is broken.

    Examples
    --------
    >>> from pixmetry.camera.camera import load_camera
    >>> from pixmetry.scene.uniform import Uniform
    >>> camera = load_camera("imx264_like").with_parameters("sensor.prnu", pixel_std_rel=0.02)
    >>> frames = camera.expose(Uniform(2000.0), frames=2, seed=1, window=(100, 200, 32, 48))
    >>> frames.data.shape, frames.data.dtype.name
    ((2, 32, 48), 'uint16')
    >>> quiet = camera.switched(off=["sensor.prnu"]).expose(Uniform(2000.0), window=(100, 200, 32, 48), quiet=True)
    >>> bool(quiet.data.std() < frames.data.std())
    True
    """

    name: str
    frame_shape: tuple[int, int]
    chain: tuple[Element, ...]
    pitch_um: tuple[float, float] | None = None
    exposure_s: float = 0.01
    temperature_c: float = 20.0
    unit_seed: int = 0
    facts: Mapping[str, Any] = field(default_factory=dict)
    warm_up_k: float = 0.0
    warm_up_s: float = 1800.0
    pixel_clock_hz: float = 14.1875e6
    line_period_s: float = 64e-6
    measured: MeasuredUnit | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "chain", tuple(self.chain))
        check_chain(self.chain, self.name)
        if min(self.frame_shape) < 1:
            raise ChainError("a frame has no pixels", where=self.name, value=self.frame_shape)
        check_pixels(self.frame_shape[1], self.frame_shape[0], self.name, MOST_OF_CAMERA)
        for element in self.chain:
            check_maps(element, f"{self.name}, {element.name}")
            check_provenance(element, f"{self.name}, {element.name}")

    # ---- variants -------------------------------------------------------------------------------------------------------------

    def __getitem__(self, name: str) -> Element:
        for element in self.chain:
            if element.name == name:
                return element
        raise InputError(f"{self.name} has no source named {name!r}", allowed=", ".join(e.name for e in self.chain))

    def __contains__(self, name: str) -> bool:
        return any(e.name == name for e in self.chain)

    def switched(self, **kw: Any) -> Camera:
        """Return the same camera with some sources off: ``off=names``, or all but ``on=names`` and the essential conversions."""
        off, on = kw.get("off", ()), kw.get("on")
        for name in (*off, *(on or ())):
            self[name]

        def keeps(element: Element) -> bool:
            return element.name not in off if on is None else element.source.essential or element.name in on

        return replace(self, chain=tuple(replace(e, on=e.on and keeps(e)) for e in self.chain))

    def with_parameters(self, name: str, **values: Any) -> Camera:
        """Return the same camera with some parameters of one source changed (validated)."""
        element = self[name]
        params = element.source.make({**element.params.model_dump(), **values}, where=f"{self.name}.{name}")
        return replace(self, chain=tuple(e.with_params(params) if e.name == name else e for e in self.chain))

    @property
    def estimates(self) -> dict[str, Estimates]:
        """How uncertain the parameters are, by the names of the elements that say so, switched on or off."""
        return {e.name: e.estimates for e in self.chain if len(e.estimates)}

    @property
    def active(self) -> tuple[Element, ...]:
        """The elements that are on."""
        return tuple(e for e in self.chain if e.on)

    @cached_property
    def links(self) -> tuple[Link, ...]:
        """The running chain: the elements that are on, and the conversions between them."""
        return linked(self.active, self.frame_shape, self.pixel_clock_hz)

    @property
    def output_shape(self) -> tuple[int, int]:
        """Rows and columns of the frames that it puts out; a grabber's may differ from the sensor's."""
        return self.links[-1].shape_out if self.links else self.frame_shape

    # ---- running --------------------------------------------------------------------------------------------------------------

    def streams(self, seed: int, quiet: bool = False) -> Streams:
        """Return the keyed randomness of one series of exposures; ``quiet``: every temporal draw at its mean."""
        known = {}
        if self.measured is not None and self.unit_seed == self.measured.unit_seed:
            known = {e.name: e.maps for e in self.active if e.maps}
            if known:
                check_frame(self.measured, self.frame_shape, self.name)
        return (QuietStreams if quiet else Streams)(self.unit_seed, seed, known)

    def signal(
        self, scene: Scene, grid: Grid, exposure_s: Any = None, frame_period_s: float | None = None, temperature_c: Any = None
    ) -> Signal:
        """Return the scene as the camera's pixels would look at it in these windows: the signal at the head of the chain."""
        n = len(grid.frame)
        exposure = np.broadcast_to(np.asarray(self.exposure_s if exposure_s is None else exposure_s, float), (n,))
        if not (np.isfinite(exposure) & (exposure >= 0)).all():
            raise InputError("the exposure time cannot be used", where="exposure_s", value=exposure_s, allowed="0 or more, in s")
        period = self.facts.get("frame_period_s", 0.04) if frame_period_s is None else frame_period_s
        time = grid.frame * float(period)
        if temperature_c is None:
            temperature = self.temperature_c - self.warm_up_k * np.exp(-time / self.warm_up_s)
        else:
            temperature = np.broadcast_to(np.asarray(temperature_c(time) if callable(temperature_c) else temperature_c, float), (n,))
        light = Light(scene, grid, self.frame_shape, exposure, time)
        nothing = np.broadcast_to(np.float32(0), grid.size)
        clock = Clock(self.pixel_clock_hz, self.line_period_s)
        return Signal(nothing, Kind.LIGHT, grid, self.frame_shape, exposure, time, temperature, clock, light)

    def expose(
        self,
        scene: Scene,
        frames: int | Sequence[int] = 1,
        seed: int = 0,
        window: tuple[int, int, int, int] | None = None,
        threads: int | None = None,
        quiet: bool = False,
        **schedule: Any,
    ) -> Signal:
        """Expose frames, or one window ``(row0, col0, rows, cols)`` of them.

        Parameters
        ----------
        scene : Scene
        frames : int or sequence of int
            How many frames from number 0, or which frame numbers.
        seed : int
            Of the exposures; with another one only what is temporal changes.
        window : (int, int, int, int), optional
            Equals the crop of the whole frame bit for bit.
        quiet : bool
            Every temporal draw at its mean: the expected frame of this unit.
        **schedule
            ``exposure_s``, ``temperature_c`` (a number, or a function of time), ``frame_period_s``.

        Returns
        -------
        Signal
            With ``data`` of shape (frames, rows, cols).
        """
        wanted: Sequence[int] = range(frames) if isinstance(frames, int | np.integer) else frames
        if not len(wanted):
            raise InputError("the number of frames is not positive", remedy="give a number of frames of at least 1")
        rows, cols = self.output_shape if window is None else window[2:]
        _check_size(self.name, rows, cols, len(wanted))
        numbers = [int(f) for f in wanted]
        parts = list(self.iter_frames(scene, numbers, seed, window, threads, quiet, **schedule))
        return _concatenate(parts)

    def iter_frames(
        self,
        scene: Scene,
        frames: Iterable[int],
        seed: int = 0,
        window: tuple[int, int, int, int] | None = None,
        threads: int | None = None,
        quiet: bool = False,
        **schedule: Any,
    ) -> Iterator[Signal]:
        """Expose frames one after the other, in order, with only a few in flight; see `expose`."""
        rows, cols = self.output_shape
        r0, c0, h, w = (0, 0, rows, cols) if window is None else window
        if not (r0 >= 0 and c0 >= 0 and h > 0 and w > 0 and r0 + h <= rows and c0 + w <= cols):
            raise InputError("the window does not lie in the frame", value=window, allowed=f"within {rows} rows and {cols} columns")
        _check_size(self.name, h, w)
        numbers = frames if isinstance(frames, range) else [int(f) for f in frames]
        if any(np.size(v) > 1 for v in schedule.values()):
            raise InputError("a series has one schedule for all its frames", value=", ".join(schedule), remedy="expose frame by frame")
        last_memory = max((i for i, e in enumerate(self.links) if e.remembers), default=-1)
        task = _Task(scene, self.streams(seed, quiet), schedule, threads, rendered={} if len(numbers) > 1 or last_memory >= 0 else None)

        def grid_of(number: int) -> Grid:
            return Grid(np.array([number]), np.array([r0]), np.array([c0]), (h, w))

        def whole(number: int) -> Signal:
            return self._run(task, grid_of(number), self.links)

        if last_memory >= 0:
            yield from self._with_memory(task, numbers, grid_of, last_memory)
        elif len(numbers) == 1:  # the threads share the bands of the frame
            yield whole(numbers[0])
        else:
            yield from imap_tiles(whole, numbers, threads)

    def _with_memory(self, task: _Task, numbers: Sequence[int], grid_of: Callable[[int], Grid], last_memory: int) -> Iterator[Signal]:
        """Run frames 0, 1, 2 … in order through all sources up to the last one with a memory; run the others only for the wanted frames."""
        rising = numbers.step > 0 if isinstance(numbers, range) else numbers == sorted(set(numbers))
        if numbers and (not rising or numbers[0] < 0):
            raise InputError("a camera with a memory needs frame numbers that rise from 0", value=list(numbers[:5]))
        head, tail = self.links[: last_memory + 1], self.links[last_memory + 1 :]
        first = next(i for i, e in enumerate(head) if e.remembers)
        wanted = numbers if isinstance(numbers, range) else set(numbers)
        before = head[:first]

        def prepared(number: int) -> tuple[int, list[Windows], Signal]:
            needs = self._needs(self.links, Windows.of(grid_of(number)))
            window = needs[first]
            grid = Grid(np.array([number]), window.row0, window.col0, (int(window.rows[0]), int(window.cols[0])))
            return number, needs, self._run(task, grid, before)

        state: dict[str, Any] = {}
        sequence = range(numbers[-1] + 1) if numbers else range(0)
        for number, needs, signal in imap_tiles(prepared, sequence, task.threads):
            for element, needed in zip(head[first:], needs[first:], strict=False):
                name, stream = element.name, task.streams.of(element.name)
                signal, state[name] = run(element.source, element.params, signal.crop(needed), stream, state.get(name))
            if number in wanted:
                yield self._walk(task, signal, tail, needs[len(head) :])

    def expose_windows(
        self,
        scene: Scene,
        grid: Grid,
        seed: int = 0,
        mode: str = "exact",
        background: Scene | Frozen | None = None,
        threads: int | None = None,
        quiet: bool = False,
        **schedule: Any,
    ) -> np.ndarray:
        """Expose many small windows, each of another frame, in one batch.

        Parameters
        ----------
        scene : Scene
            May differ from frame to frame: one frame number per trial.
        grid : Grid
        mode : {"exact", "frozen"}
            ``exact``: every source gets all the context it needs, so that each window equals the crop of its frame. ``frozen``: what
            lies farther away than a source's ``near`` comes from the noise-free frame of ``background``, and so do frame-wide
            quantities; far cheaper, with the truncation error that `frozen_tail` states.
        background : Scene or Frozen, optional
            The scene far from the windows; needed by the mode ``frozen`` when a source looks beyond its window. What `freeze` made of it
            does for several batches.

        Returns
        -------
        ndarray, shape (n, rows, cols)
        """
        if mode not in ("exact", "frozen"):
            raise InputError("no such mode", value=mode, allowed="exact, frozen")
        rows, cols = self.output_shape
        last_row, last_col = grid.row0 + grid.shape[0], grid.col0 + grid.shape[1]
        if min(grid.shape) < 1 or (grid.row0 < 0).any() or (grid.col0 < 0).any() or (last_row > rows).any() or (last_col > cols).any():
            raise InputError("a window does not lie in the frame", value=grid.shape, allowed=f"within {rows} rows and {cols} columns")
        frozen = None
        if mode == "frozen":
            frozen = background if isinstance(background, Frozen) else self.freeze(background, **schedule)
        if frozen is None and any(e.remembers for e in self.links):
            raise InputError("a source with a memory cannot be run on single windows exactly", remedy="use iter_frames, or mode='frozen'")
        task = _Task(scene, self.streams(seed, quiet), schedule, threads, frozen)
        needs = self._needs(self.links, Windows.of(grid), frozen is not None)
        groups = _equal_sizes(needs)
        spans = []
        for group in groups:
            most = max([int(w.rows[group[0]]) * int(w.cols[group[0]]) for w in needs])
            step = max(1, min(BATCH_PIXELS // max(1, grid.shape[0] * grid.shape[1]), MOST_PIXELS // max(1, most)))
            spans += [group[a : a + step] for a in range(0, len(group), step)]

        def part(index: np.ndarray) -> np.ndarray:
            return self._run(task.take(index), _sub_grid(grid, index), self.links).data

        parts = map_tiles(part, spans, threads)
        if not parts:
            return np.zeros((0, *grid.shape), np.float32)
        return np.concatenate(parts)[np.argsort(np.concatenate(spans))] if len(groups) > 1 else np.concatenate(parts)

    def frozen_tail(self) -> float:
        """Largest share of a pixel's signal that the mode ``frozen`` takes from the noise-free frame, over all sources."""
        return float(sum(e.source.tail(e.params) for e in self.links if e.far and e.source.tail is not None))

    def freeze(self, background: Scene | None, **schedule: Any) -> Frozen:
        """Run the noise-free background frame once and keep what sources with a far context need of it."""
        far = [e.name for e in self.links if e.far or e.remembers]
        if not far:
            return Frozen({}, self.streams(0, quiet=True))
        if background is None:
            raise InputError("the mode 'frozen' needs the background scene", value=", ".join(far), remedy="give it as background=")
        streams = self.streams(0, quiet=True)
        rows, cols = self.frame_shape
        _check_size(self.name, rows, cols, frames=3)  # of this frame: input and output of a source, and what is kept
        grid = Grid.whole([0], (rows, cols))
        signal = self.signal(background, grid, **{name: one_value(name, value) for name, value in schedule.items()})
        kept: dict[str, tuple[Signal, Signal, Any]] = {}
        for element in self.links:
            stream = streams.of(element.name)
            before, state = signal, None
            if element.remembers:
                state = settled_state(element, signal, stream)
            signal, _ = run(element.source, element.params, signal, stream, state)
            if element.name in far:
                kept[element.name] = (before, signal, state)
        return Frozen(kept, streams)

    # ---- the walk -------------------------------------------------------------------------------------------------------------

    def _needs(self, elements: Sequence[Link], windows: Windows, frozen: bool = False) -> list[Windows]:
        """Return the input windows of every element, and the output windows as the last entry."""
        needs = [windows]
        for element in reversed(elements):
            source, params = element.source, element.params
            if frozen and element.remembers:
                needs.append(needs[-1])
            elif frozen and element.far:
                needs.append(element.nearby(needs[-1]))
            else:
                needs.append(source.window_needed(params, needs[-1], element.shape))
        return needs[::-1]

    def _run(self, task: _Task, grid: Grid, elements: Sequence[Link]) -> Signal:
        """Render and run a batch; entries whose context has another size (at the frame's border) are run apart."""
        needs = self._needs(elements, Windows.of(grid), task.frozen is not None)
        order = _equal_sizes(needs)
        if len(order) == 1:
            return self._run_equal(task, grid, elements, needs)
        parts = [self._run_equal(task.take(i), _sub_grid(grid, i), elements, [w.take(i) for w in needs]) for i in order]
        return _concatenate(parts).take(np.argsort(np.concatenate(order)))

    def _run_equal(self, task: _Task, grid: Grid, elements: Sequence[Link], needs: list[Windows]) -> Signal:
        if len(grid.frame) == 1 and task.frozen is None:
            return self._run_bands(task, grid, elements, needs)
        return self._walk(task, self.signal(task.scene, _grid_at(grid, needs[0]), **task.schedule), elements, needs)

    def _walk(self, task: _Task, signal: Signal, elements: Sequence[Link], needs: list[Windows]) -> Signal:
        """Run the elements over the windows of ``needs`` one after the other."""
        for element, needed in zip(elements, needs, strict=False):
            stream = task.streams.of(element.name)
            if element.source is LOOK:
                signal = task.look(signal)
            elif task.frozen is not None and element.name in task.frozen.elements:
                signal = task.frozen.apply(element, signal.crop(needed), stream)
            else:
                signal, _ = run(element.source, element.params, signal.crop(needed), stream)
        return signal.crop(needs[-1])

    def _run_bands(self, task: _Task, grid: Grid, elements: Sequence[Link], needs: list[Windows], signal: Signal | None = None) -> Signal:
        """Run one large window in bands that stay in the cache, as far as the sources allow: by rows, by columns, or whole.

        Sources that follow each other and allow the same kind of band are run together, band by band; ``signal``, if given, is what the
        first of them takes.
        """
        at = 0
        while at < len(elements) or signal is None:
            axis, end = find_segment(elements, at, needs[at])
            segment = elements[at:end]

            def band(windows: Windows, segment: Sequence[Link] = segment, source: Signal | None = signal) -> Signal:
                local = self._needs(segment, windows)
                part = source.crop(local[0]) if source is not None else self.signal(task.scene, _grid_at(grid, local[0]), **task.schedule)
                return self._walk(task, part, segment, local)

            parts = imap_tiles(band, cut_bands(needs[end], axis), task.threads)
            signal = stitch(parts, _grid_at(grid, needs[end]), axis or 0)
            at = end
        return signal

    # ---- geometry -------------------------------------------------------------------------------------------------------------

    def true_positions(
        self, x_px: Any, y_px: Any, frame: Any = 0, seed: int = 0, time_s: Any = None, **schedule: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return where points of the scene's plane lie in a frame that the camera puts out.

        Every geometric effect of that frame counts: distortion, tilt, drift, the clock of the samples and its warm-up, offsets. What
        moves a measured centre by spreading light or signal (a low-pass, echoes, charge left behind), and what moves single rows
        (jitter), does not: that is the error.

        Parameters
        ----------
        x_px, y_px : array_like, shape (k,)
            In pixels of the ideal camera.
        frame : int, or array_like of int, shape (k,)
            Of the exposure: one for all points, or one for each.
        seed : int
        time_s : float, or array_like, shape (k,), optional
            When the exposure begins; by default the number of the frame times the frame period.
        **schedule
            As for `expose`; with a frame for each point, also arrays of shape (k,).

        Returns
        -------
        x_px, y_px : ndarray, shape (k,)
            NaN for points that are seen nowhere.
        """
        x, y, signal = self._points(x_px, y_px, frame, time_s, schedule)
        at: Any = np.asarray(frame)
        streams = self.streams(seed)
        for link in self.links:
            if Kind.LIGHT in link.source.consumes and link.source is not LOOK:
                signal, _ = run(link.source, link.params, signal, streams.of(link.name))
            elif link.source is LOOK:
                x, y = _by_window(signal.own_light.placed, x, y, signal)
            elif link.source is SAMPLE:
                x = link.params.line_at(signal).placed(x, warped=True)
            elif link.source.place is not None:
                x, y = link.source.place(link.params, x, y, link.shape, at)
        return x, y

    def ideal_positions(
        self, x_px: Any, y_px: Any, frame: Any = 0, seed: int = 0, time_s: Any = None, **schedule: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of the scene's plane that are seen at places of a frame: the inverse of `true_positions`, same parameters.

        Examples
        --------
        >>> from pixmetry.camera.camera import load_camera
        >>> camera = load_camera("pulnix_tm6cn_epix_512")
        >>> x, y = camera.true_positions([300.0], [200.0], frame=5)
        >>> [round(float(v[0]), 9) for v in camera.ideal_positions(x, y, frame=5)]
        [300.0, 200.0]
        """
        at = self.sensor_places(x_px, y_px, frame, time_s, **schedule)
        return self.scene_places(*at, frame, seed, time_s, **schedule)

    def scene_places(
        self, x_px: Any, y_px: Any, frame: Any = 0, seed: int = 0, time_s: Any = None, **schedule: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of the scene's plane that places on the sensor's pixel grid look at; parameters as in `true_positions`."""
        x, y, signal = self._points(x_px, y_px, frame, time_s, schedule)
        streams = self.streams(seed)
        for link in self.links:
            if Kind.LIGHT in link.source.consumes and link.source is not LOOK:
                signal, _ = run(link.source, link.params, signal, streams.of(link.name))
        return _by_window(signal.own_light.pulled, x, y, signal) if signal.light is not None else (x, y)

    def sensor_places(self, x_px: Any, y_px: Any, frame: Any = 0, time_s: Any = None, **schedule: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return where places of a frame lie on the pixel grid of the sensor; parameters as in `true_positions`."""
        x, y, signal = self._points(x_px, y_px, frame, time_s, schedule)
        at: Any = np.asarray(frame)
        for link in reversed(self.links):
            if link.source is SAMPLE:
                x = link.params.line_at(signal).pixels(x, warped=True)
            elif link.source.place is not None:  # an offset and a step along each axis
                ends = [link.source.place(link.params, np.full_like(x, v), np.full_like(y, v), link.shape, at) for v in (0.0, 1.0)]
                x, y = ((v - first) / (second - first) for v, first, second in zip((x, y), *ends, strict=True))
        return x, y

    def _points(self, x_px: Any, y_px: Any, frame: Any, time_s: Any, schedule: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, Signal]:
        """Points of shape (k,), and a signal at the times of their frames: one window for all of them, or one for each."""
        x, y = (np.atleast_1d(np.asarray(v, float)) for v in (x_px, y_px))
        one = np.ndim(frame) == 0 and np.ndim(time_s) == 0 and all(np.ndim(v) == 0 for v in schedule.values())
        numbers = np.atleast_1d(frame) if one else np.broadcast_to(frame, x.shape)
        zero = np.zeros(len(numbers), np.int64)
        signal = self.signal(NOWHERE, Grid(numbers, zero, zero, (1, 1)), **schedule)
        if time_s is not None:
            begins = np.broadcast_to(np.asarray(time_s, float), signal.time_s.shape)
            temperature = signal.temperature_c
            if schedule.get("temperature_c") is None:
                temperature = self.temperature_c - self.warm_up_k * np.exp(-begins / self.warm_up_s)
            signal = replace(signal, time_s=begins, temperature_c=temperature, light=replace(signal.own_light, time_s=begins))
        return x, y, signal

    def layout(self, x_px: Any, y_px: Any, frame: Any = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return where places on the pixel grid belong in the frames that are put out: clock of the samples, offsets, fields.

        ``frame`` is a number, or one for each place; see `true_positions`.
        """
        x, y = (np.atleast_1d(np.asarray(v, float)) for v in (x_px, y_px))
        for link in self.links:
            if link.source.place is not None:
                x, y = link.source.place(link.params, x, y, link.shape, frame)
        return x, y

    def truth(self, frame: int = 0, seed: int = 0, **schedule: Any) -> dict[str, dict[str, np.ndarray]]:
        """Return the true effects of the sources in one frame, by name of the source: maps, masks, shifts of rows (see `Source.truth`)."""
        told: dict[str, dict[str, np.ndarray]] = {}
        streams = self.streams(seed)
        for link in self.links:
            if link.source.truth is None:
                continue
            grid = Grid.whole([frame], link.shape)
            signal = self.signal(NOWHERE, grid, **schedule)
            told[link.name] = dict(link.source.truth(link.params, replace(signal, frame_shape=link.shape), streams.of(link.name)))
        return told

    # ---- files ----------------------------------------------------------------------------------------------------------------

    def to_record(self) -> dict[str, Any]:
        """Return the plain record that `load_camera` reads."""
        record: dict[str, Any] = {"schema": SCHEMA, "name": self.name, "rows": self.frame_shape[0], "cols": self.frame_shape[1]}
        if self.pitch_um is not None:
            record |= {"pitch_x_um": self.pitch_um[0], "pitch_y_um": self.pitch_um[1]}
        record |= {"exposure_s": self.exposure_s, "temperature_c": self.temperature_c, "unit_seed": self.unit_seed}
        optional = ("warm_up_k", "warm_up_s", "pixel_clock_hz", "line_period_s")
        record |= {n: getattr(self, n) for n in optional if getattr(self, n) != type(self).__dataclass_fields__[n].default}
        if self.measured is not None and any(e.maps for e in self.chain):
            rows, cols = self.measured.frame_shape
            record["measured"] = {"unit_seed": self.measured.unit_seed, "rows": rows, "cols": cols}
        record["facts"] = dict(self.facts)
        record["chain"] = [
            {"source": e.source.id, **({"name": e.name} if e.name != e.source.id else {}), **({} if e.on else {"enabled": False})}
            | {"parameters": e.params.model_dump(mode="json")}
            | provenance_record(e)
            | ({"maps": listing(e.maps)} if e.maps else {})
            for e in self.chain
        ]
        return record

    def save(self, path: str | Path) -> None:
        """Write the camera as a preset (YAML); what was measured in its unit goes into an archive beside it (``camera.maps.npz``)."""
        from pixmetry.core.config import dump_yaml

        record = self.to_record()
        if "measured" in record:
            archive = maps_file(path)
            record["measured"]["file"] = archive.name
            write_unit_maps(archive, self.chain)
        dump_yaml(record, path)


@dataclass(frozen=True)
class _Task:
    """What all parts of one run share."""

    scene: Scene
    streams: Streams
    schedule: Mapping[str, Any]
    threads: int | None = None
    frozen: Frozen | None = None
    rendered: dict[Any, tuple[bytes, np.ndarray]] | None = None  # photons of the windows of one frame, for scenes that stand still

    def look(self, signal: Signal) -> Signal:
        """Sample the light, or take what was sampled for an earlier frame that saw the same."""
        mark = None if self.rendered is None else signal.own_light.fingerprint()
        if self.rendered is None or mark is None:
            return look(signal)
        grid = signal.grid
        key = (grid.row0.tobytes(), grid.col0.tobytes(), grid.shape)
        kept = self.rendered.get(key)
        if kept is None or kept[0] != mark:
            kept = self.rendered[key] = (mark, look(signal).data)
            kept[1].setflags(write=False)
        return look(signal, kept[1])

    def take(self, index: np.ndarray) -> _Task:
        """The task of some windows of the batch: values that are given window by window are picked."""
        return replace(self, schedule={k: np.asarray(v)[index] if np.size(v) > 1 else v for k, v in self.schedule.items()})


def _by_window(
    moved: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], x: np.ndarray, y: np.ndarray, signal: Signal
) -> tuple[np.ndarray, np.ndarray]:
    """A map of the light at points of shape (k,): all in the one window, or each in its own."""
    shape = (-1, 1, 1) if len(signal.grid.frame) == len(x) else (1, -1, 1)
    u, v = moved(x.reshape(shape), y.reshape(shape))
    return np.broadcast_to(u, x.reshape(shape).shape).ravel(), np.broadcast_to(v, x.reshape(shape).shape).ravel()


class _NoScene:
    """Nothing to see: for questions of geometry and of times."""

    moving = False


NOWHERE: Any = _NoScene()


def _sub_grid(grid: Grid, index: np.ndarray) -> Grid:
    return Grid(grid.frame[index], grid.row0[index], grid.col0[index], grid.shape)


def _equal_sizes(needs: list[Windows]) -> list[np.ndarray]:
    """Positions of the batch whose windows have the same sizes all along the chain, group by group."""
    sizes = np.stack([v for w in needs for v in (w.rows, w.cols)])
    if not sizes.shape[1]:
        return []
    group = np.zeros(sizes.shape[1], np.int64)
    for differ in {v.tobytes(): v for v in sizes if (v != v[0]).any()}.values():  # most elements take the same windows as the one before
        group = np.unique(group * (differ.max() + 1) + differ, return_inverse=True)[1].ravel()
    return [np.flatnonzero(group == g) for g in range(group.max() + 1)]


def _grid_at(grid: Grid, windows: Windows) -> Grid:
    return Grid(grid.frame, windows.row0, windows.col0, (int(windows.rows[0]), int(windows.cols[0])))


def _check_size(name: str, rows: int, cols: int, frames: int = 1) -> None:
    """Refuse frames that do not fit into memory: input and output of a source exist at the same time, in single precision."""
    what = f"{f'{frames} frames' if frames > 1 else 'a frame'} of {cols} x {rows} pixels"
    check_memory(8.0 * frames * rows * cols, what, where=name, remedy="expose a window, or fewer frames at a time")


def _concatenate(parts: list[Signal]) -> Signal:
    if len(parts) == 1:
        return parts[0]

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(p if name in _ARRAYS else p.grid, name) for p in parts])

    grid = Grid(joined("frame"), joined("row0"), joined("col0"), parts[0].grid.shape)
    arrays: dict[str, Any] = {name: joined(name) for name in _ARRAYS}
    return replace(parts[0], grid=grid, **arrays)


_ARRAYS = ("data", "exposure_s", "time_s", "temperature_c")  # of a signal, one entry per window


# ---- camera files ------------------------------------------------------------------------------------------------------------------


def pitch_values(pitch_um: tuple[float, float] | None) -> dict[str, float]:
    """What sources that know the pixel pitch take from their camera, by the names of their parameters."""
    return {} if pitch_um is None else {"pitch_x_um": pitch_um[0], "pitch_y_um": pitch_um[1], "pitch_um": pitch_um[0]}


def clock_values(record: Any) -> dict[str, float]:
    """What sources that know the read-out's clock take from their camera, where its file states one."""
    told = record.model_fields_set
    values = {"line_time_us": 1e6 * record.line_period_s} if "line_period_s" in told else {}
    return values | ({"pixel_time_ns": 1e9 / record.pixel_clock_hz} if "pixel_clock_hz" in told else {})


def build_camera(record: Mapping[str, Any], where: str = "camera", folder: str | Path | None = None) -> Camera:
    """Build a camera from its plain record.

    Parameters
    ----------
    record : mapping
    where : str
        For messages.
    folder : path, optional
        Where the archive of what was measured in its unit stands, for a record that names one.

    Raises
    ------
    InputError, ChainError
        With the place in the record that cannot be used.
    """
    from pixmetry.camera.camera_schema import CameraRecord
    from pixmetry.camera.catalogue import get_source
    from pixmetry.core.config import validate

    checked = validate(CameraRecord, record, where)
    elements = []
    pitch = None if checked.pitch_x_um is None else (checked.pitch_x_um, checked.pitch_y_um or checked.pitch_x_um)
    known = pitch_values(pitch) | clock_values(checked)  # unless a source says otherwise
    for i, entry in enumerate(checked.chain):
        source = get_source(entry.source, f"{where}, chain[{i}]")
        own = {name: value for name, value in known.items() if name in source.parameters.model_fields}
        params = source.make(own | entry.parameters, where=f"{where}, chain[{i}] {entry.source}")
        estimates = estimates_of(entry, source, params, f"{where}, chain[{i}] {entry.source}")
        elements.append(
            Element(entry.name or entry.source, source, params, entry.enabled, known_from=entry.known_from, estimates=estimates)
        )
    wanted = {element.name: entry.maps for element, entry in zip(elements, checked.chain, strict=True) if entry.maps}
    measured = None
    if wanted:
        if checked.measured is None:
            raise InputError(
                "maps without a unit", where=where, remedy="write `measured:` with unit_seed, rows and cols, or delete `maps:`"
            )
        if folder is None or checked.measured.file is None:
            raise InputError("the measured maps of this camera are not given", where=where, remedy="load the camera from its file")
        measured = MeasuredUnit(checked.measured.unit_seed, (checked.measured.rows, checked.measured.cols))
        found = read_unit_maps(Path(folder) / checked.measured.file, wanted)
        elements = [replace(e, maps=found.get(e.name, {})) for e in elements]
    same = ("exposure_s", "temperature_c", "unit_seed", "facts", "warm_up_k", "warm_up_s", "pixel_clock_hz", "line_period_s")
    settings = {name: getattr(checked, name) for name in same}
    return Camera(checked.name, (checked.rows, checked.cols), tuple(elements), pitch, measured=measured, **settings)


@typed
def load_camera(path: str | Path) -> Camera:
    """Read a camera from its YAML file or a data-sheet file, or one of those that come with pixmetry by its name.

    Raises
    ------
    InputError, ChainError
        If there is no such file, preset or sheet, it cannot be used, or a result stands beside it that was written with another one.

    Examples
    --------
    >>> from pixmetry.camera.camera import load_camera
    >>> load_camera("imx264_like").frame_shape  # a preset
    (2048, 2448)
    >>> load_camera("imx250")["sensor.full_well"].known_from  # a data sheet
    'sheet'
    """
    from importlib.resources import files

    from pixmetry.core.config import load_yaml

    folders = [files("pixmetry.camera") / name for name in ("presets", "sheets")]
    known = {p.name.removesuffix(".yaml"): p for folder in folders for p in folder.iterdir() if p.name.endswith(".yaml")}
    if str(path) in known:
        path = Path(str(known[str(path)]))
    elif not Path(path).is_file():
        allowed = f"a YAML file, or one of {', '.join(sorted(known))}"
        raise InputError("no such camera file or preset", value=str(path), allowed=allowed)
    else:
        check_file(path)
    record = load_yaml(path)
    if record.get("schema", SCHEMA) not in (SCHEMA, SHEET_SCHEMA):
        where = f"{path}, line {record.lines[('schema',)]}"
        remedy = "name a camera file, a data-sheet file, or a preset"
        allowed = f"{SCHEMA}, {SHEET_SCHEMA}"
        raise InputError("a file of another kind", where=where, value=record["schema"], allowed=allowed, remedy=remedy)
    if record.get("schema") == SHEET_SCHEMA:
        from pixmetry.camera.data_sheet import camera_of_data_sheet

        camera = camera_of_data_sheet(record, str(path))
        return camera if record.get("name") else replace(camera, name=Path(path).stem)
    return build_camera(record, str(path), Path(path).parent)


__all__ = ["Camera", "Element", "Scene", "build_camera", "check_chain", "in_order", "load_camera"]
