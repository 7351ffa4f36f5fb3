"""The one place with threads: work over frames, tiles or trials, in order, with bounded memory."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from pixmetry.core.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_state = threading.local()  # .inside is True in a worker thread, .held where BLAS has one thread
_lock = threading.Lock()
_pools: dict[int, ThreadPoolExecutor] = {}
_chosen: int | None = None


def set_threads(count: int | None) -> None:
    """Choose the number of threads of this process; None returns to the environment or the processor.

    Raises
    ------
    InputError
        If the count is not a whole number of at least 1.
    """
    global _chosen
    _chosen = None if count is None else _checked(count, "set_threads")


def thread_count() -> int:
    """Return the number of threads: from `set_threads`, else PIXMETRY_THREADS, else the processors this process may use.

    Raises
    ------
    InputError
        If PIXMETRY_THREADS is not a whole number of at least 1.
    """
    if _chosen is not None:
        return _chosen
    asked = os.environ.get("PIXMETRY_THREADS")
    if asked:
        return _checked(asked, "PIXMETRY_THREADS")
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def map_tiles(function: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None) -> list[Result]:
    """Apply a function to every item and return the results in the order of the items.

    Parameters
    ----------
    function : callable
        Takes one item. Threads help as far as it releases the GIL (kernels and NumPy do).
    items : iterable
        Read as the work proceeds, from the calling thread.
    threads : int, optional
        Default `thread_count()`. With 1, or when called from inside a worker, the items run one after the other right here.

    Returns
    -------
    list
        One result per item.

    Raises
    ------
    InputError
        If `threads` is not a whole number of at least 1.
    Exception
        The first one (in the order of the items) that the function raised; items not yet started are dropped.
    """
    return list(imap_tiles(function, items, threads))


def imap_tiles(function: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None) -> Iterator[Result]:
    """Like `map_tiles`, but yield the results one by one; at most ``2 * threads`` of them exist at a time."""
    count = thread_count() if threads is None else _checked(threads, "threads")
    if count == 1 or getattr(_state, "inside", False):
        return map(function, items)
    return _in_flight(function, iter(items), count)


def _in_flight(function: Callable[[Item], Result], items: Iterator[Item], threads: int) -> Iterator[Result]:
    waiting: deque[Future[Result]] = deque()
    pool = _pool(threads)
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) == 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


def _pool(threads: int) -> ThreadPoolExecutor:
    with _lock:
        if threads not in _pools:
            _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="pixmetry", initializer=_enter_worker)
        return _pools[threads]


def _enter_worker() -> None:
    _state.inside = True


def _forget_pools() -> None:
    """A forked child has the pools of its parent, but not their threads."""
    global _lock
    _lock = threading.Lock()
    _pools.clear()
    _state.inside = _state.held = False


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)


def checked_threads(count: int | None) -> int | None:
    """The number of threads that an argument asks for, None for that of `thread_count`.

    Raises
    ------
    InputError
        If it is not a whole number of at least 1.
    """
    return None if count is None else _checked(count, "threads")


def _checked(count: int | str, where: str) -> int:
    try:
        number = int(count)
    except (TypeError, ValueError, OverflowError):
        number = 0
    if number < 1 or str(number) != str(count).strip():
        raise InputError("not a number of threads", where=where, value=count, allowed="a whole number of at least 1")
    return number


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Hold the BLAS and OpenMP libraries of this process to one thread, inside a ``with`` block or a function that it decorates.

    Where `map_tiles` already occupies every processor, their own threads only get in the way; and the order in which a threaded
    library sums, hence the last bit of its result, may depend on the number of its threads. A block inside another costs nothing.
    """
    if getattr(_state, "held", False):
        yield
        return
    import scipy.linalg  # noqa: F401  what is loaded inside the block would not be held
    import threadpoolctl

    _state.held = True
    try:
        with threadpoolctl.threadpool_limits(limits=1):
            yield
    finally:
        _state.held = False
