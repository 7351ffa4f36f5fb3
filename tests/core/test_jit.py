"""The kernel proxy: lazy, indifferent to flags and strides, and never stale."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

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


def test_edited_constant_of_a_kernel_file_without_kernels_is_noticed(tmp_path: Path) -> None:
    """No code refers to that file: only the import statement shows that the compiled number came from there."""
    write_package(tmp_path, 1.0)
    constants = tmp_path / "thrown" / "_factor_kernels.py"
    inner = "from ._factor_kernels import FACTOR\n" + CALLEE.format(factor="FACTOR")
    (tmp_path / "thrown" / "_inner_kernels.py").write_text(inner)
    for factor, expected in ((3.0, "36.0"), (7.5, "90.0")):
        constants.write_text(f"FACTOR = {factor}\n")
        assert run(tmp_path)[1:] == [expected, "0", "1"]
    assert run(tmp_path)[1:] == ["90.0", "1", "0"]


def test_edit_of_a_kernel_file_that_is_not_imported_compiles_nothing(tmp_path: Path) -> None:
    write_package(tmp_path, 1.0)
    other = tmp_path / "thrown" / "_other_kernels.py"
    other.write_text(CALLEE.format(factor=2.0))
    assert run(tmp_path)[2:] == ["0", "1"]
    other.write_text(CALLEE.format(factor=3.0))
    assert run(tmp_path)[2:] == ["1", "0"]


def test_two_checkouts_share_what_is_alike(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
        write_package(folder, 1.0)
    shared = {"PIXMETRY_CACHE_DIR": str(tmp_path / "cache")}
    assert run(first, **shared) == ["False", "12.0", "0", "1"]
    shutil.rmtree(first)
    assert run(second, **shared) == ["False", "12.0", "1", "0"]
    write_package(second, 2.0)
    assert run(second, **shared) == ["False", "24.0", "0", "1"]


def test_same_text_in_a_module_of_another_name_is_another_kernel(tmp_path: Path) -> None:
    """Compiled code names its module, which need not be there any more."""
    write_package(tmp_path, 1.0)
    assert run(tmp_path)[1] == "12.0"
    (tmp_path / "thrown").rename(tmp_path / "moved")
    (tmp_path / "moved" / "_outer_kernels.py").write_text(CALLER.format(package="moved"))
    assert run(tmp_path, "moved") == ["False", "12.0", "0", "1"]


def test_processes_that_compile_at_once_keep_all_that_they_compiled(tmp_path: Path) -> None:
    """Each for another type of number: with an index of its own on disk Numba loses entries here."""
    write_package(tmp_path, 1.0)
    types = ("int8", "int16", "int32", "int64", "float32", "float64")
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([SOURCE, str(tmp_path)]), "PIXMETRY_CACHE_DIR": str(tmp_path / "cache")}

    def start(kind: str) -> subprocess.Popen:
        script = SCRIPT.format(package="thrown").replace("np.arange(4.0)", f"np.arange(4).astype('{kind}')")
        return subprocess.Popen([sys.executable, "-c", script], env=variables, stdout=subprocess.PIPE, text=True)

    for started in [start(kind) for kind in types]:
        assert started.communicate()[0].split() == ["False", "12.0", "0", "1"]
        assert started.returncode == 0
    every = SCRIPT.format(package="thrown").replace("outer(np.arange(4.0))", f"*[outer(np.arange(4).astype(kind)) for kind in {types}]")
    after = subprocess.run([sys.executable, "-c", every], env=variables, capture_output=True, text=True, check=True)
    assert after.stdout.split() == ["False", *["12.0"] * len(types), str(len(types)), "0"]


def test_kernel_that_is_compiled_takes_one_that_came_from_the_disk(tmp_path: Path) -> None:
    """What was loaded has not loaded what compiling needs."""
    write_package(tmp_path, 1.0)
    script = (
        "import sys\nimport numpy as np\nfrom thrown._inner_kernels import inner\nprint(inner(3.0), 'numba.np.arraymath' in sys.modules)\n"
    )
    outer = "from thrown._outer_kernels import outer\nprint(outer(np.arange(4.0)), *inner.dispatcher.stats.cache_hits.values())"
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([SOURCE, str(tmp_path)]), "PIXMETRY_CACHE_DIR": str(tmp_path / "cache")}
    said = [
        subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=True).stdout.split()
        for code in (script, script + outer)
    ]
    assert said == [["3.0", "True"], ["3.0", "False", "12.0", "1"]]


def test_spoilt_file_is_compiled_again(tmp_path: Path) -> None:
    write_package(tmp_path, 1.0)
    run(tmp_path)
    for kept in (tmp_path / "cache").rglob("outer-*.nbc"):
        kept.write_bytes(kept.read_bytes()[:100])
    assert run(tmp_path) == ["False", "12.0", "0", "1"]
    assert run(tmp_path) == ["False", "12.0", "1", "0"]


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is read-only to root")
def test_read_only_cache_gives_way_to_the_next(tmp_path: Path) -> None:
    write_package(tmp_path, 1.0)
    (tmp_path / "cache").mkdir(mode=0o500)
    assert run(tmp_path, XDG_CACHE_HOME=str(tmp_path / "user"))[1:] == ["12.0", "0", "1"]
    assert list((tmp_path / "user").rglob("*.nbc"))


def test_disk_that_takes_nothing_costs_nothing_but_time(tmp_path: Path) -> None:
    write_package(tmp_path, 1.0)
    script = (
        "import numpy as np, pathlib\nfrom thrown._outer_kernels import outer\ndef full(*_): raise OSError(28, 'No space left on device')\n"
        "pathlib.Path.write_bytes = full\nprint(outer(np.arange(4.0)))"
    )
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([SOURCE, str(tmp_path)]), "PIXMETRY_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", script], env=variables, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "12.0"
    assert not list((tmp_path / "cache").rglob("*.nbc*"))


def test_order_of_the_fields_of_a_named_tuple_is_noticed(tmp_path: Path) -> None:
    """Compiled code takes fields by place; their order may be declared in a file that no kernel imports."""
    package = tmp_path / "thrown"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "_kernels.py").write_text("from pixmetry.core.jit import jit\n\n@jit\ndef gain_of(noise):\n    return noise[0].gain\n")
    script = (
        "from thrown.records import Noise\nfrom thrown._kernels import gain_of\n"
        "print(gain_of((Noise(read=2.0, gain=5.0), 1.0)), *gain_of.dispatcher.stats.cache_hits.values())"
    )
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([SOURCE, str(tmp_path)]), "PIXMETRY_CACHE_DIR": str(tmp_path / "cache")}
    variables |= {"PYTHONDONTWRITEBYTECODE": "1"}
    for fields, expected in (("read gain", "5.0"), ("gain read", "5.0"), ("gain read", "5.0 1")):
        (package / "records.py").write_text(f"from collections import namedtuple\nNoise = namedtuple('Noise', {fields!r})\n")
        done = subprocess.run([sys.executable, "-c", script], env=variables, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected


def test_kernels_of_the_package_depend_on_the_kernel_files_that_they_import() -> None:
    from pixmetry.core import _binomial_kernels, _random_kernels

    def modules(kernel) -> set[str]:
        return {name for name, _ in module._sources_of(kernel.py_func)}

    assert modules(_random_kernels._round) == {module.__name__, _random_kernels.__name__}
    assert modules(_binomial_kernels.binomial) == {module.__name__, _random_kernels.__name__, _binomial_kernels.__name__}


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
    assert not list((tmp_path / "cache").rglob("*.nbc"))


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


class Pair(NamedTuple):
    values: np.ndarray
    factor: float


class Nest(NamedTuple):
    pair: Pair
    out: np.ndarray


@jit
def scale_into(nest):
    for i in range(nest.pair.values.size):
        nest.out[i] = nest.pair.factor * nest.pair.values[i]


def test_arrays_in_tuples_are_treated_like_others() -> None:
    """One type for read-only and strided arrays however deep they are; an output is written in place."""
    values, out = np.arange(4.0), np.zeros(4)
    frozen = values.copy()
    frozen.setflags(write=False)
    for given in (values, frozen, np.repeat(values, 2)[::2]):
        out[:] = 0.0
        scale_into(Nest(Pair(given, 3.0), out))
        assert (out == 3.0 * values).all()
    assert len(scale_into.dispatcher.signatures) == 1
    assert not frozen.flags.writeable


def test_arrays_given_by_name_are_treated_like_others() -> None:
    values = np.arange(12.0).reshape(3, 4)
    values.flags.writeable = False
    assert total(values=values.T) == total(values) == 66.0
    assert len(total.dispatcher.signatures) == 1


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


def test_a_user_without_a_home_gets_a_temporary_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PIXMETRY_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # what it does where there is none
    monkeypatch.setattr(module.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert module._cache_root().parent == tmp_path and not (tmp_path / "~").exists()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files")
def test_compiled_code_that_others_may_have_written_is_not_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, others = tmp_path / "own", tmp_path / "others"
    for folder in (own, others):
        (folder / "kernels" / "0123").mkdir(parents=True)
        (folder / "kernels" / "0123" / "a.nbc").write_bytes(b"")
        (folder / "kernels").chmod(0o777)
    monkeypatch.setenv("PIXMETRY_CACHE_DIR", str(own))
    assert module._cache_root() == own / "kernels"
    assert not list((own / "kernels").iterdir()) and (own / "kernels").stat().st_mode & 0o077 == 0
    monkeypatch.setenv("PIXMETRY_CACHE_DIR", str(others))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    uid = os.getuid()
    place = (others / "kernels").stat().st_ino
    stat = Path.stat

    def of_others(path: Path, **options: bool) -> os.stat_result:
        found = stat(path, **options)
        return os.stat_result((*found[:4], uid + 1, *found[5:])) if found.st_ino == place else found

    monkeypatch.setattr(Path, "stat", of_others)
    assert module._cache_root() == tmp_path / "user" / "pixmetry" / "kernels"
    assert (others / "kernels" / "0123" / "a.nbc").exists()
