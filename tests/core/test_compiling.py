"""Who waits for kernels to be compiled is told so, once; and warming up goes through every command."""

from __future__ import annotations

from pathlib import Path

import pytest

from pixmetry.cli import COMMANDS
from pixmetry.cli.warm_up import all_kernels, jobs_in
from pixmetry.core import compiling
from pixmetry.core.jit import jit
from pixmetry.locate.estimators import estimators

WITHOUT_KERNELS = {  # of their own
    "sources",
    "compare",
    "fleet",
    "shoot-list",
    "series",
    "init",
    "capture",
    "board",
    "bench",
    "view",
    "warm-up",
}


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch):
    calls: list[str] = []
    compiling.tell_when_compiling(lambda: calls.append("compiling"))
    yield calls
    compiling.tell_when_compiling(None)


def compile_one(number: int) -> None:
    @jit(cache=False)
    def kernel(a):
        return a + number

    assert kernel(1) == 1 + number


def test_nothing_is_said_of_what_takes_no_time(told: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "PATIENCE_S", 600.0)
    compile_one(1)
    assert told == []


def test_who_waits_is_told_once(told: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "PATIENCE_S", 1e-6)
    for number in (1, 2, 3):
        compile_one(number)
    assert told == ["compiling"]


def test_warming_up_runs_every_command_and_every_estimator(tmp_path: Path) -> None:
    jobs = list(jobs_in(tmp_path))
    assert {name for name, _ in jobs} == set(COMMANDS) - WITHOUT_KERNELS
    asked = {(job.keywords.get("kind", "disc"), job.keywords["estimator"]) for name, job in jobs if name == "locate"}
    kinds = ("disc", "ellipse", "ring", "spot", "coded", "line", "edge", "cross", "chessboard", "blob")
    assert asked >= {(kind, estimator) for kind in kinds for estimator in estimators(kind)}
    assert len(all_kernels()) > 200
