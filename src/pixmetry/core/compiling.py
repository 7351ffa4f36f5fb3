"""A message to the user while kernels are compiled: once, and only if it takes more than a second."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 1.5

_told: Callable[[], None] | None = None
_first_s: float | None = None


def tell_when_compiling(told: Callable[[], None] | None) -> None:
    """Register a function that is called once, as soon as kernels have been compiled for more than a second and a half; None: none.

    It is called from the thread that compiles. Kernels that come from the cache on disk are not compiled.
    """
    global _told, _first_s
    _told, _first_s = told, None


def note_compiling() -> None:
    """Take note that a kernel begins or ends to be compiled; `core.jit` calls it."""
    global _told, _first_s
    now = time.monotonic()
    if _first_s is None:
        _first_s = now
    if _told is not None and now - _first_s > PATIENCE_S:
        told, _told = _told, None
        told()
