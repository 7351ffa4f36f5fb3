"""The kernel proxy: lazy, indifferent to flags and strides, and never stale."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pixmetry.core import jit as module
from pixmetry.core.jit import jit

SOURCE = str(Path(module.__file__).resolve().parents[2])

CALLEE = """
from pixmetry.core.jit import jit

@jit
def inner(x):
    return {factor} * x
"""
CALLER = """
from pixmetry.core.jit import jit
from {package}._inner_kernels import inner
from {package} import _inner_kernels as others

@jit
def outer(values):
    total = 0.0
    for i in range(values.size):
        total += inner(values[i]) + others.inner(values[i])
    return total
"""
SCRIPT = """
import sys
import numpy as np
from {package}._outer_kernels import outer
print("numba" in sys.modules, outer(np.arange(4.0)), end=" ")
stats = getattr(outer.dispatcher, "stats", None)
print(stats and sum(stats.cache_hits.values()), stats and sum(stats.cache_misses.values()))
"""


@jit
def add_one(values, out):
    for i in range(values.size):
        out[i] = values[i] + 1.0


@jit
def total(values):
    result = 0.0
    for row in range(values.shape[0]):
        for col in range(values.shape[1]):
            result += values[row, col]
    return result


def write_package(folder: Path, factor: float, package: str = "thrown") -> None:
    home = folder / package
    home.mkdir(exist_ok=True)
    (home / "__init__.py").write_text("")
    (home / "_inner_kernels.py").write_text(CALLEE.format(factor=factor))
    (home / "_outer_kernels.py").write_text(CALLER.format(package=package))


def run(folder: Path, package: str = "thrown", **environment: str) -> list[str]:
    """Return: was numba imported before the first call, the result, cache hits, cache misses."""
    paths = os.pathsep.join([SOURCE, str(folder)])
    variables = os.environ | {"PYTHONPATH": paths, "PIXMETRY_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    variables |= environment
    done = subprocess.run([sys.executable, "-c", SCRIPT.format(package=package)], env=variables, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_edited_callee_in_another_file_is_noticed(tmp_path: Path) -> None:
    """Numba alone would answer with the old result: it compares the caller's file only."""
    write_package(tmp_path, 1.0)
    assert run(tmp_path) == ["False", "12.0", "0", "1"]
    assert run(tmp_path) == ["False", "12.0", "1", "0"]  # the second start compiles nothing
    write_package(tmp_path, 5.0)
    assert run(tmp_path) == ["False", "60.0", "0", "1"]
    write_package(tmp_path, 1.0)
    assert run(tmp_path)[1] == "12.0"


def test_edited_callee_in_another_package_is_noticed(tmp_path: Path) -> None:
    write_package(tmp_path, 2.0, "first")
    write_package(tmp_path, 2.0, "second")
    caller = tmp_path / "first" / "_outer_kernels.py"
    caller.write_text(CALLER.format(package="second"))
    assert run(tmp_path, "first")[1] == "24.0"
    write_package(tmp_path, 3.0, "second")
    assert run(tmp_path, "first")[1:] == ["36.0", "0", "1"]


def test_works_without_compiling(tmp_path: Path) -> None:
    write_package(tmp_path, 5.0)
    assert run(tmp_path, NUMBA_DISABLE_JIT="1") == ["False", "60.0", "None", "None"]
    assert not list((tmp_path / "cache").rglob("*.nbi"))


def test_file_edited_after_its_import_is_not_cached(tmp_path: Path) -> None:
    write_package(tmp_path, 1.0)
    edited = tmp_path / "thrown" / "_inner_kernels.py"
    script = (
        "import numpy as np, pathlib\nfrom thrown._outer_kernels import outer\n"
        f"pathlib.Path({str(edited)!r}).write_text({CALLEE.format(factor=50.0)!r})\nprint(outer(np.arange(4.0)))"
    )
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([SOURCE, str(tmp_path)]), "PIXMETRY_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", script], env=variables, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "12.0"  # what was imported
    assert run(tmp_path)[1] == "600.0"  # what the file says now, not what the other process compiled


def test_one_type_for_read_only_and_strided_arrays() -> None:
    values = np.arange(12.0).reshape(3, 4)
    locked = values.copy()
    locked.flags.writeable = False
    assert total(values) == total(locked) == total(values.T) == total(np.asfortranarray(values)) == 66.0
    assert total(values[::2, 1::2]) == values[::2, 1::2].sum()
    assert total(np.broadcast_to(np.float64(2.0), (5, 5))) == 50.0
    assert not locked.flags.writeable
    assert len(getattr(total.dispatcher, "signatures", [0])) == 1


def test_output_is_written_in_place() -> None:
    out = np.zeros(5)
    add_one(np.arange(5.0), out)
    np.testing.assert_array_equal(out, np.arange(5.0) + 1)


def test_kernel_of_the_package_lives_in_a_kernel_file() -> None:
    code = compile("def stray(x):\n    return x\n", str(module.PACKAGE_ROOT / "core" / "stray.py"), "exec")
    names: dict = {}
    exec(code, names)
    with pytest.raises(ValueError, match="must live in a file named"):
        jit(names["stray"])


def test_old_folders_are_removed(tmp_path: Path) -> None:
    old, new, other = tmp_path / ("a" * 20), tmp_path / ("b" * 20), tmp_path / "notes"
    for folder in (old, new, other):
        folder.mkdir()
        (folder / "file").write_text("x")
    for folder in (old, other):
        os.utime(folder, (time.time() - 40 * 86400,) * 2)
    module._remove_old(tmp_path)
    assert [folder.exists() for folder in (old, new, other)] == [False, True, True]


def test_cache_folder_falls_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("PIXMETRY_CACHE_DIR", str(blocked))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert module._cache_root() == tmp_path / "user" / "pixmetry" / "kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr(module.tempfile, "gettempdir", lambda: str(tmp_path))
    root = module._cache_root()
    assert root.parent == tmp_path and root.stat().st_mode & 0o022 == 0
