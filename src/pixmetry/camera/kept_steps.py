"""One window of cameras that differ in few parameters, exposed again and again: what did not change is kept."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pixmetry.camera.bands import find_segment
from pixmetry.camera.camera import Camera, _grid_at, _Task
from pixmetry.camera.light import Scene
from pixmetry.camera.signal import Signal, Windows
from pixmetry.core.config import Model
from pixmetry.core.random import Grid

MOST_BYTES = 192 << 20


@dataclass(frozen=True)
class _Kept:
    """A signal, and the measured maps that its mark names by their address: while it is kept, no other map can be there."""

    signal: Signal
    maps: tuple[np.ndarray, ...]


@dataclass
class KeptSteps:
    """Exposes a window of frame 0, and keeps the signal ahead of each group of sources for the next camera.

    A camera that differs from one before it only behind some source begins there. The result is that of `Camera.expose`, bit for bit.

    Parameters
    ----------
    most_bytes : int
        Of the signals that are kept; the oldest go first.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.camera.camera import load_camera
    >>> from pixmetry.scene.uniform import Uniform
    >>> kept, camera, window = KeptSteps(), load_camera("imx264_like"), (100, 200, 32, 48)
    >>> first = kept.window(camera, Uniform(2000.0), "uniform 2000", window, seed=1)
    >>> changed = camera.with_parameters("sensor.prnu", pixel_std_rel=0.02)
    >>> second = kept.window(changed, Uniform(2000.0), "uniform 2000", window, seed=1)
    >>> np.array_equal(second.data, changed.expose(Uniform(2000.0), seed=1, window=window).data)
    True
    """

    most_bytes: int = MOST_BYTES
    _signals: OrderedDict[bytes, _Kept] = field(default_factory=OrderedDict)

    @property
    def held_bytes(self) -> int:
        """Of the signals that are kept."""
        return sum(kept.signal.data.nbytes for kept in self._signals.values())

    def window(
        self,
        camera: Camera,
        scene: Scene,
        scene_mark: str,
        window: tuple[int, int, int, int],
        seed: int = 0,
        quiet: bool = False,
        go_on: Callable[[], None] | None = None,
    ) -> Signal:
        """Expose one window ``(row0, col0, rows, cols)`` of frame 0.

        ``scene_mark`` is equal only for equal scenes. ``go_on`` is called ahead of each group of sources; it raises to end the work.
        """
        row0, col0, rows, cols = window
        grid = Grid(np.array([0]), np.array([row0]), np.array([col0]), (rows, cols))
        links, task = camera.links, _Task(scene, camera.streams(seed, quiet), {})
        needs = camera._needs(links, Windows.of(grid))
        marks = _marks(camera, needs, scene_mark, seed, quiet)
        ends = _ends_of_groups(camera, needs)
        begin = max((k for k in ends if marks[k] in self._signals), default=0)
        signal = self._signals[marks[begin]].signal if begin else None
        if signal is not None:
            self._signals.move_to_end(marks[begin])
        at = begin
        for end in (k for k in ends if k > begin):
            if go_on is not None:
                go_on()
            whole = _grid_at(grid, needs[end])
            signal = camera._run_bands(task, whole, links[at:end], needs[at : end + 1], signal)
            self._keep(marks[end], signal, camera)
            at = end
        if signal is None:
            signal = camera.signal(scene, grid)
        return signal.crop(needs[-1])

    def _keep(self, mark: bytes, signal: Signal, camera: Camera) -> None:
        """Keep a signal, whose data nobody may change."""
        data = signal.data
        if data.nbytes > self.most_bytes:
            return
        data.setflags(write=False)
        self._signals[mark] = _Kept(replace(signal, data=data), tuple(m for e in camera.chain for m in e.maps.values()))
        while self.held_bytes > self.most_bytes:
            self._signals.popitem(last=False)


def _ends_of_groups(camera: Camera, needs: list[Windows]) -> list[int]:
    """Positions in the running chain up to which sources are run in the same bands, and behind each that reads light or charge once."""
    links, ends, at = camera.links, [], 0
    while at < len(links):
        _, end = find_segment(links, at, needs[at])
        ends += [k for k in range(at + 1, end) if links[k - 1].source.produces is not None]
        ends.append(end)
        at = end
    return ends


def _marks(camera: Camera, needs: list[Windows], scene_mark: str, seed: int, quiet: bool) -> list[bytes]:
    """For every place in the running chain a mark that is equal where all ahead of it is equal, and the window there."""
    own = (camera.frame_shape, camera.exposure_s, camera.temperature_c, camera.warm_up_k, camera.warm_up_s, camera.unit_seed)
    clock = (camera.pixel_clock_hz, camera.line_period_s, camera.facts.get("frame_period_s"), camera.pitch_um)
    unit = None if camera.measured is None else [(e.name, sorted((n, id(v)) for n, v in e.maps.items())) for e in camera.chain]
    mark = _digest(b"", (own, clock, unit, scene_mark, seed, quiet))
    marks = [_digest(mark, _place(needs[0]))]
    for link, need in zip(camera.links, needs[1:], strict=True):
        params = link.params.model_dump_json() if isinstance(link.params, Model) else ""  # a conversion's are those of the sources ahead
        mark = _digest(mark, (link.name, link.source.id, link.shape, params))
        marks.append(_digest(mark, _place(need)))
    return marks


def _place(windows: Windows) -> tuple[int, ...]:
    return tuple(int(v[0]) for v in (windows.row0, windows.col0, windows.rows, windows.cols))


def _digest(before: bytes, what: Any) -> bytes:
    return hashlib.blake2b(before + repr(what).encode(), digest_size=16).digest()
