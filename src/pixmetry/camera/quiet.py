"""Streams of which every temporal draw is at its mean: they make the expected frame of a unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.core.random import Grid, Streams


class _Quiet:
    """A stream whose temporal draws are at their mean; what is fixed in the unit is drawn as always."""

    quiet = True

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        if name.endswith(("_fixed", "_unit")):
            return getattr(self._stream, name)
        raise AttributeError(name)

    def normal(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros(grid.size, np.float32)

    def normal_rows(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros(grid.size[:2], np.float32)

    def normal_cols(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros((grid.size[0], grid.size[2]), np.float32)

    def normal_frames(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.zeros(grid.size[0], np.float32)

    def uniform(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.full(grid.size, 0.5, np.float32)

    def uniform_frames(self, grid: Grid, draw: int = 0) -> np.ndarray:
        return np.full(grid.size[0], 0.5, np.float32)

    def poisson(self, mean: np.ndarray, grid: Grid, draw: int = 0) -> np.ndarray:
        return _fresh(mean, grid)

    def binomial(self, count: np.ndarray, share: Any, grid: Grid, draw: int = 0) -> np.ndarray:
        return _fresh(np.asarray(count, np.float32) * np.asarray(share, np.float32), grid)

    def key(self, kind: str, draw: int = 0) -> np.uint64:
        """Of no draw: a kernel that is given it must ask for ``quiet``."""
        return np.uint64(0)

    def add_normal(self, data: np.ndarray, grid: Grid, scale: Any, draw: int = 0) -> np.ndarray:
        return _fresh(data, grid)


def _fresh(data: np.ndarray, grid: Grid) -> np.ndarray:
    """A copy, as every draw returns: the caller may go on in place."""
    return np.array(np.broadcast_to(data, grid.size), np.float32)


@dataclass(frozen=True)
class QuietStreams(Streams):
    """Streams of which every temporal draw is at its mean."""

    def of(self, instance_name: str) -> Any:
        return _Quiet(super().of(instance_name))
