"""Threads in one place: order, bounded memory, exceptions, nesting."""

from __future__ import annotations

import threading
import time

import pytest

from pixmetry.core import threads
from pixmetry.core.errors import InputError


@pytest.fixture(autouse=True)
def _unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PIXMETRY_THREADS", raising=False)
    monkeypatch.setattr(threads, "_chosen", None)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_results_come_in_order(count: int) -> None:
    def slow_if_even(item: int) -> int:
        time.sleep(0.002 * (item % 2 == 0))
        return item * item

    assert threads.map_tiles(slow_if_even, range(40), count) == [i * i for i in range(40)]
    assert threads.map_tiles(slow_if_even, [], count) == []


def test_more_than_one_thread_works() -> None:
    barrier = threading.Barrier(3, timeout=10)
    assert sorted(threads.map_tiles(lambda _: barrier.wait(), range(3), 3)) == [0, 1, 2]  # would break with fewer than three at a time


def test_results_in_flight_are_bounded() -> None:
    read = 0

    def items():
        nonlocal read
        for item in range(100):
            read += 1
            yield item

    for taken, _ in enumerate(threads.imap_tiles(lambda item: item, items(), 3)):
        assert read <= taken + 2 * 3


@pytest.mark.parametrize("count", [1, 3])
def test_exceptions_arrive(count: int) -> None:
    def fail(item: int) -> int:
        if item == 7:
            raise KeyError(item)
        return item

    with pytest.raises(KeyError, match="7"):
        threads.map_tiles(fail, range(1000), count)
    assert threads.map_tiles(str, range(3), count) == ["0", "1", "2"]


def test_nested_call_runs_in_its_worker() -> None:
    def outer(item: int) -> bool:
        here = threading.get_ident()
        return all(ident == here for ident in threads.map_tiles(lambda _: threading.get_ident(), range(8), 2))

    assert all(threads.map_tiles(outer, range(8), 2))


def test_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    assert threads.thread_count() >= 1
    monkeypatch.setenv("PIXMETRY_THREADS", "7")
    assert threads.thread_count() == 7
    threads.set_threads(3)
    assert threads.thread_count() == 3
    threads.set_threads(None)
    assert threads.thread_count() == 7


@pytest.mark.parametrize("wrong", ["0", "-2", "two", "2.5"])
def test_wrong_numbers_are_refused(monkeypatch: pytest.MonkeyPatch, wrong: str) -> None:
    monkeypatch.setenv("PIXMETRY_THREADS", wrong)
    with pytest.raises(InputError, match="PIXMETRY_THREADS"):
        threads.thread_count()


def test_blas_is_held_to_one_thread() -> None:
    import numpy as np
    from threadpoolctl import threadpool_info

    def numbers() -> list[int]:
        return [library["num_threads"] for library in threadpool_info()]

    @threads.single_threaded_blas()
    def inside() -> None:
        assert set(numbers()) == {1}

    before = []
    for _ in range(2):
        with threads.single_threaded_blas():
            np.ones((4, 4)) @ np.ones((4, 4))
            inside()  # and does not let go where it ends
            assert set(numbers()) == {1}
        before.append(numbers())
    assert before[0] == before[1]
    with pytest.raises(ZeroDivisionError), threads.single_threaded_blas():
        1 / 0  # noqa: B018
    assert numbers() == before[0]
