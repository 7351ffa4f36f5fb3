"""Who may import whom, read from the source files without running them.

The rooms stand on floors, and imports point downwards only (``FLOORS``; docs/architecture.md). Imports inside functions and under
``TYPE_CHECKING`` count too, and so does ``import_module`` with a literal name.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2] / "src" / "pixmetry"

# The rooms, from the ground up. A room imports from the floors below its own; rooms on one floor do not see each other.
FLOORS = (
    ("core",),
    ("camera",),
    ("sources", "scene", "observe", "files", "report"),
    ("locate",),
    ("simulate", "emva", "calibrate", "series"),
    ("budget",),
    ("assess", "capture"),
    ("bench",),
    ("cli",),
    ("__main__",),
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}

# The one import upwards in a circle: what loads a camera file hands a data sheet on to the module that makes a camera of it.
HANDED_ON = {"pixmetry.camera.camera": "from pixmetry.camera.data_sheet import camera_of_data_sheet"}

TYPES = {"typing", "collections.abc", "numpy.typing"}
KERNEL_FILE = re.compile(r"_(.+_)?kernels")
THREADS = {"concurrent", "multiprocessing", "_thread", "joblib"}
LOCKS = {"Lock", "RLock", "local", "current_thread", "main_thread", "get_ident"}  # of ``threading``: these start nothing


@dataclass(frozen=True)
class Import:
    """One imported name: ``module`` as an absolute dotted name, ``name`` from it or ``""`` for the module itself."""

    module: str
    name: str
    line: int

    @property
    def dotted(self) -> str:
        return f"{self.module}.{self.name}" if self.name else self.module


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """All nodes of a source text, which is parsed once for all that is asked of it."""
    return tuple(ast.walk(ast.parse(source)))


@cache
def imports(source: str, module: str, is_package: bool = False) -> list[Import]:
    """Every import in a source text; relative ones are resolved against ``module``."""
    found = []
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found += [Import(alias.name, "", node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                parts = parts[: len(parts) - node.level + is_package]
                base = ".".join([*parts, base] if base else parts)
            found += [Import(base, alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.Call) and _is_import_call(node):
            found.append(Import(node.args[0].value, "", node.lineno))
    return found


def _is_import_call(node: ast.Call) -> bool:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    literal = bool(node.args) and isinstance(node.args[0], ast.Constant) and isinstance(node.args[0].value, str)
    return name in {"import_module", "__import__"} and literal and not node.args[0].value.startswith(".")


def module_name(path: Path) -> str:
    parts = ("pixmetry", *path.relative_to(SRC).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def place_of(dotted: str) -> tuple[int, str]:
    """The floor and the room that a dotted name is in; each stage of the sources is a room. The package itself is above all floors."""
    parts = dotted.split(".")
    if len(parts) == 1:
        return len(FLOORS), ""
    room = parts[1]
    return FLOOR.get(room, len(FLOORS)), ".".join(parts[1:3]) if room == "sources" and len(parts) > 2 else room


def wrong_layers(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports that do not point to a floor below, or into the same room."""
    floor, room = place_of(module)
    wrong = []
    for found in imports(source, module, is_package):
        if found.dotted.split(".")[0] != "pixmetry" or found.dotted == "pixmetry.__version__":
            continue
        other, into = place_of(found.dotted)
        if into != room and other >= floor:
            wrong.append(f"{module}:{found.line} imports {found.dotted}")
    return wrong


def circle_of(sources: dict[str, str], packages: frozenset[str] = frozenset()) -> list[str]:
    """Modules that import each other in a circle, the first one again at the end; empty where there is none."""
    graph = {}
    for module, source in sources.items():
        found = [one for one in imports(source, module, module in packages) if one.dotted != "pixmetry.__version__"]
        graph[module] = {one.dotted if one.dotted in sources else one.module for one in found} & sources.keys() - {module}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        circle: list[str] = error.args[1]
        return circle
    return []


def wrong_kernel_imports(source: str, module: str) -> list[str]:
    """Imports of a kernel file beyond numpy, math, numba, ``core.jit``, other kernel files and what only annotations are made of."""

    def allowed(found: Import) -> bool:
        plain = {"__future__", "numpy", "math", "numba", "pixmetry.core.jit", "pixmetry.core.arrays"} | TYPES
        if found.module in plain or found.dotted == "pixmetry.core.jit":
            return True
        ours = found.module.startswith("pixmetry.")
        return ours and any(KERNEL_FILE.fullmatch(name) for name in (found.module.rpartition(".")[2], found.name))

    return [f"{module}:{found.line} imports {found.dotted}" for found in imports(source, module) if not allowed(found)]


def global_randomness(source: str, module: str) -> list[str]:
    """Uses of ``numpy.random`` or the standard ``random``: draws come from keyed streams only, and ``core.random`` is their home."""
    if module == "pixmetry.core.random":
        return []
    numpy = {a.asname or a.name for n in nodes_of(source) if isinstance(n, ast.Import) for a in n.names if a.name == "numpy"}
    lines = [f.line for f in imports(source, module) if (f.dotted + ".").startswith(("numpy.random.", "random."))]
    lines += [
        node.lineno
        for node in nodes_of(source)
        if isinstance(node, ast.Attribute) and node.attr == "random" and isinstance(node.value, ast.Name) and node.value.id in numpy
    ]
    return [f"{module}:{line} draws outside the keyed streams" for line in lines]


def own_parallelism(source: str, module: str) -> list[str]:
    """Anything that starts threads or processes; locks are no parallelism."""
    lines = [f.line for f in imports(source, module) if f.dotted.split(".")[0] in THREADS]
    lines += [f.line for f in imports(source, module) if f.module == "threading" and f.name and f.name not in LOCKS]
    for node in nodes_of(source):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "threading" and node.attr not in LOCKS:
            lines.append(node.lineno)
        if isinstance(node, ast.keyword) and node.arg == "parallel" and getattr(node.value, "value", None) is True:
            lines.append(node.value.lineno)
        if (node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")) in {"prange", "ThreadPoolExecutor"}:
            lines.append(node.lineno)
    return [f"{module}:{line} starts threads or processes of its own" for line in lines]


FILES = sorted(SRC.rglob("*.py"))
KERNELS = [path for path in FILES if KERNEL_FILE.fullmatch(path.stem)]


def test_there_is_something_to_check() -> None:
    assert {"pixmetry", "pixmetry.core.errors", "pixmetry.cli"} <= {module_name(path) for path in FILES}
    assert KERNELS


def test_every_room_has_a_floor() -> None:
    rooms = {module_name(path).split(".")[1] for path in FILES if path.parent != SRC or path.stem != "__init__"}
    assert rooms == set(FLOOR)


def test_rooms_import_downwards_only() -> None:
    wrong = [w for path in FILES if path.parent != SRC or path.stem != "__init__" for w in _checked_layers(path)]
    assert not wrong, "\n".join(wrong)


def _checked_layers(path: Path) -> list[str]:
    return wrong_layers(path.read_text(), module_name(path), path.stem == "__init__")


def test_no_modules_import_each_other() -> None:
    packages = frozenset(module_name(path) for path in FILES if path.stem == "__init__")
    sources = {module_name(path): path.read_text() for path in FILES}
    for module, line in HANDED_ON.items():
        assert sources[module].count(line) == 1
        sources[module] = sources[module].replace(line, "pass")
    circle = circle_of(sources, packages)
    assert not circle, " -> ".join(circle)


@pytest.mark.parametrize(
    "lines",
    [
        ("from pixmetry.locate import b", "from pixmetry.locate.a import A"),
        ("from pixmetry.locate.b import B", "def f():\n    from pixmetry.locate.a import A"),
        ("from pixmetry.locate.b import B", "if TYPE_CHECKING:\n    from .a import A"),
        ("from . import b", "from . import c", "from . import a"),
    ],
)
def test_a_planted_circle_is_caught(lines: tuple[str, ...]) -> None:
    circle = circle_of(dict(zip(("pixmetry.locate.a", "pixmetry.locate.b", "pixmetry.locate.c"), lines, strict=False)))
    assert circle[0] == circle[-1] and len(circle) == len(lines) + 1


@pytest.mark.parametrize("path", KERNELS, ids=module_name)
def test_kernel_files_import_only_numerics_and_kernels(path: Path) -> None:
    assert not wrong_kernel_imports(path.read_text(), module_name(path))


def test_all_randomness_is_keyed() -> None:
    assert not [w for path in FILES for w in global_randomness(path.read_text(), module_name(path))]


def test_threads_live_in_one_place() -> None:
    files = [path for path in FILES if module_name(path) != "pixmetry.core.threads"]
    assert not [w for path in files for w in own_parallelism(path.read_text(), module_name(path))]


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("pixmetry.camera.camera", "from pixmetry.sources.sensor import shot_noise"),
        ("pixmetry.camera.camera", "from pixmetry import sensor"),
        ("pixmetry.camera.camera", "def f():\n    import pixmetry.budget.montecarlo"),
        ("pixmetry.camera.camera", "importlib.import_module('pixmetry.sources.sensor.prnu')"),
        ("pixmetry.sources.sensor.prnu", "from ..optics.psf import blur"),
        ("pixmetry.sources.sensor.prnu", "from pixmetry import assess"),
        ("pixmetry.observe.moments", "from pixmetry.sources.sensor.prnu import SOURCE"),
        ("pixmetry.budget.propagate", "from pixmetry.assess import results"),
        ("pixmetry.emva.job", "from pixmetry.calibrate.job import calibrate"),
        ("pixmetry.sources.sensor.prnu", "from pixmetry.sources.optics import shading"),
        ("pixmetry.assess.page.page", "from pixmetry.cli import main"),
    ],
)
def test_a_planted_wrong_import_is_caught(module: str, line: str) -> None:
    assert wrong_layers(line, module)


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("pixmetry.sources.sensor.prnu", "import numpy as np\nfrom pixmetry.camera.signal import Signal\nfrom . import _kernels"),
        ("pixmetry.budget.propagate", "from pixmetry.scene import targets\nfrom pixmetry.locate import centroid"),
        ("pixmetry.core.provenance", "from pixmetry import __version__"),
    ],
)
def test_a_right_import_passes(module: str, line: str) -> None:
    assert not wrong_layers(line, module)


@pytest.mark.parametrize("line", ["import scipy", "from pixmetry.camera.signal import Signal", "import os", "from .prnu import SOURCE"])
def test_a_planted_kernel_import_is_caught(line: str) -> None:
    assert wrong_kernel_imports(line, "pixmetry.sources.sensor._kernels")


@pytest.mark.parametrize(
    "line",
    [
        "from pixmetry.core._random_kernels import normal",
        "from . import _smear_kernels",
        "from pixmetry.core.jit import jit",
        "from pixmetry.core.arrays import Array",
    ],
)
def test_a_right_kernel_import_passes(line: str) -> None:
    assert not wrong_kernel_imports(line, "pixmetry.sources.sensor._kernels")


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np\nnp.random.normal()",
        "import numpy\nnumpy.random.default_rng(1)",
        "from numpy import random",
        "from numpy.random import default_rng",
        "import numpy.random as r",
        "import random",
    ],
)
def test_planted_global_randomness_is_caught(source: str) -> None:
    assert global_randomness(source, "pixmetry.sources.sensor.prnu")


def test_own_streams_are_not_global_randomness() -> None:
    source = "from pixmetry.core.random import Stream\nfrom pixmetry.core import random"
    assert not global_randomness(source, "pixmetry.sources.sensor.prnu")


@pytest.mark.parametrize(
    "source",
    [
        "from concurrent.futures import ThreadPoolExecutor",
        "import concurrent.futures",
        "import threading\nthreading.Thread()",
        "from threading import Thread",
        "import multiprocessing",
        "for i in numba.prange(3): pass",
        "@jit(parallel=True)\ndef f(): pass",
    ],
)
def test_planted_parallelism_is_caught(source: str) -> None:
    assert own_parallelism(source, "pixmetry.sources.sensor.prnu")


def test_a_lock_is_not_parallelism() -> None:
    assert not own_parallelism("import threading\nlock = threading.RLock()", "pixmetry.core.jit")
