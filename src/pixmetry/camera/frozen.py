"""The mode ``frozen``: windows in which all that lies far away comes from a noise-free frame that is run once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.camera._camera_kernels import cut_windows
from pixmetry.camera.conversions import Link
from pixmetry.camera.signal import Signal
from pixmetry.camera.source import run
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid, Streams


@dataclass(frozen=True)
class Frozen:
    """Noise-free background before and after each source with a far context, and the settled state of those with a memory.

    ``streams`` are those of the background: with every temporal draw at its mean.
    """

    elements: Mapping[str, tuple[Signal, Signal, Any]]
    streams: Streams

    def apply(self, element: Link, signal: Signal, stream: Any) -> Signal:
        """Run a source on the near context, and correct for the far one by the same run on the noise-free frame."""
        before, after, state = self.elements[element.name]
        if element.remembers and len(signal) > 1 and signal.data.shape[1:] == tuple(signal.frame_shape):  # else they would be a sequence
            parts = [self.apply(element, signal.take(np.array([i])), stream).data for i in range(len(signal))]
            return signal.with_data(np.concatenate(parts), element.source.produces)
        out, _ = run(element.source, element.params, signal, stream, state)
        if element.remembers:
            return out
        quiet, _ = run(element.source, element.params, _cut(before, signal), self.streams.of(element.name))
        return out.with_data(out.data + (_cut(after, out).data - quiet.data))


def _cut(frame: Signal, like: Signal) -> Signal:
    """Cut the windows of one signal out of a whole frame; number, times and temperature stay those of the frame."""
    grid = like.grid
    data = cut_windows(np.ascontiguousarray(frame.data[0], np.float32), grid.row0, grid.col0, *grid.shape)
    same = np.zeros(len(like), np.int64)
    return replace(
        frame,
        data=data,
        grid=Grid(frame.grid.frame[same], grid.row0, grid.col0, grid.shape),
        exposure_s=frame.exposure_s[same],
        time_s=frame.time_s[same],
        temperature_c=frame.temperature_c[same],
    )


def has_steady_state(source: Any, params: Any) -> bool:
    """Whether the memory of a source is a number, or an image, that can settle; that of a coder of sequences is not."""
    try:
        np.asarray(None if source.start is None else source.start(params), float)
    except TypeError:
        return False
    return True


def settled_state(element: Link, signal: Signal, stream: Any, most: int = 400) -> Any:
    """Run a source with a memory over the same frame until its state no longer changes."""
    source: Any = element.source
    if not has_steady_state(source, element.params):
        raise InputError(f"{element.name} has no steady state", remedy="switch it off: it needs whole sequences")
    state = source.start(element.params)
    for _ in range(most):
        _, following = source.forward(element.params, signal, stream, state)
        change = np.max(np.abs(np.asarray(following, float) - np.asarray(state, float)))
        state = following
        if change <= 1e-7 * np.max(np.abs(np.asarray(state, float))):
            return state
    raise InputError(f"{element.name} reaches no steady state on the background", remedy="check its parameters, or use mode='exact'")


def one_value(name: str, value: Any) -> Any:
    """The value of the schedule that all windows have."""
    if np.size(value) > 1 and len(np.unique(value)) > 1:
        raise InputError("the mode 'frozen' has one schedule for all windows", value=name, remedy="expose them group by group")
    return np.ravel(value)[:1] if np.size(value) > 1 else value
