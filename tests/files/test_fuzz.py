"""A short run of `scripts/fuzz.py` (always the same cases), and planted faults that it must find."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
CASES = 5  # of each door; `make fuzz` runs on


def _script() -> Any:
    spec = spec_from_file_location("fuzz", ROOT / "scripts" / "fuzz.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules["fuzz"] = module
    spec.loader.exec_module(module)
    return module


fuzz = _script()


def test_no_door_has_a_traceback_or_a_silent_wrong_answer(tmp_path: Path) -> None:
    if sys.platform == "win32":
        pytest.skip("no alarm")
    cases = [(name, k, fuzz.one_case(name, k, 7, tmp_path)) for name in fuzz.doors() for k in range(CASES)]
    assert len(cases) == CASES * len(fuzz.doors())
    assert [case for case in cases if case[2]] == []


def test_a_case_is_the_same_in_every_run() -> None:
    raw = b"a: 1\nb: [2, 3]\n"
    first = [fuzz.mutated(raw, np.random.default_rng([1, k])) for k in range(50)]
    assert first == [fuzz.mutated(raw, np.random.default_rng([1, k])) for k in range(50)]
    assert len(set(first)) > 40


def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A reader with an exception of its own, one that ignores a digest, and one that reads other values than another program."""

    def split(path: Path) -> list[str]:
        return path.read_bytes().decode("utf-8").split("=")[1:2] or [][0]

    raw = b"a=1\n"
    planted = {
        "raises": fuzz.Door({"a": raw}, split),
        "unsealed": fuzz.Door({"a": raw}, lambda path: path.read_bytes(), sealed=True),
        "differs": fuzz.Door({"a": raw}, lambda path: len(path.read_bytes()), reference=lambda raw: len(raw) + 1),
    }
    monkeypatch.setattr(fuzz, "doors", lambda: planted)
    found = {name: {fuzz.one_case(name, k, 1, tmp_path).partition(":")[0] for k in range(40)} for name in planted}
    assert found["raises"] & {"IndexError", "UnicodeDecodeError"}
    assert found["unsealed"] - {""} == found["differs"] - {""} == {"silent"}
