"""Who may import whom, read from the source files without running them.

Light walks through the stages and everything rests on ``core``; imports point that way only. Imports inside functions and under
``TYPE_CHECKING`` count too, and so does ``import_module`` with a literal name.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2] / "src" / "pixmetry"
STAGES = ("scene", "optics", "sensor", "electronics", "cable", "grabber", "storage", "processing")
MEASURING = {"experiment", "location", "calibration"}

# What each part may import besides itself. A part that is not listed here fails the test: say where it belongs.
ALLOWED: dict[str, set[str]] = {
    "core": set(),
    **{stage: {"core"} for stage in STAGES},
    **{part: {"core"} for part in MEASURING},
    "campaign": {"core"},
    "budget": {"core", "scene", "location"},
}
ALLOWED["simulation"] = ALLOWED["correction"] = {"core", "scene", "campaign"}
ALLOWED["digital_twin"] = {"core", "scene", "campaign", "experiment", "budget", "emva"}
ALLOWED["results"] = {"core", "campaign", "experiment", "budget", "emva", "digital_twin"}
ALLOWED["chain"] = {"core", "scene"}
ALLOWED["emva"] = {"core", "experiment"}
ALLOWED["datasheet_files"] = {"core", "campaign", "emva", "report"}
ALLOWED["datasheets"] = {"core", "campaign", "emva", "datasheet_files"}
ALLOWED["dark_currents"] = {"core", "campaign", "emva", "datasheet_files", "datasheets"}
ALLOWED["preflights"] = {"campaign", "experiment", "emva"}
ALLOWED["comparing"] = {"core", "campaign", "emva"}
ALLOWED["calibration"] = {"core", "location"}
ALLOWED["calibration_numbering"] = {"calibration"}
ALLOWED["calibration_targets"] = {"core", "campaign", "location", "located", "locating", "calibration_numbering"}
ALLOWED["calibration_images"] = {"core", "campaign", "calibration", "location", "locating", "calibration_numbering", "calibration_targets"}
ALLOWED["line_calibration"] = {"calibration"}
ALLOWED["calibration_record"] = {"core", "calibration", "line_calibration"}
ALLOWED["calibration_project"] = {"core", "campaign", "calibration", "calibration_images", "calibration_record", "location", "locating"}
ALLOWED["calibration_files"] = {"core", "campaign", "calibration", "calibration_record", "line_calibration", "report"}
ALLOWED["calibration_exports"] = {"core", "campaign", "calibration"}
ALLOWED["calibrated"] = {"core", "calibration", "calibration_record"}
ALLOWED["calibrating"] = {"core", "campaign", "calibration", "calibration_project", "calibrated"}
ALLOWED["calibrating"] |= {"calibration_record", "calibration_files", "line_calibration"}
ALLOWED["camera_noise"] = {"core", "scene", "location"}
ALLOWED["located"] = {"core", "campaign", "location"}
ALLOWED["report"] = {"core", "campaign", "experiment", "budget", "results", "chain", "located", "emva", "calibration", "line_calibration"}
ALLOWED["report"] |= {"digital_twin"}
ALLOWED["locating"] = {"core", "campaign", "location", "located", "camera_noise", "report"}
ALLOWED["assessment"] = {"core", "campaign", "experiment", "location", "budget", "results", "report", "emva", "calibrated"}
ALLOWED["assessment"] |= {"calibration_record", "digital_twin"}
ALLOWED["handbook"] = {*ALLOWED}
ALLOWED["cli"] = {*ALLOWED}
ALLOWED["__main__"] = {"cli"}

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


def imports(source: str, module: str, is_package: bool = False) -> list[Import]:
    """Every import in a source text; relative ones are resolved against ``module``."""
    found = []
    for node in ast.walk(ast.parse(source)):
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


def part_of(dotted: str) -> str:
    """The part of the package that a dotted name is in; ``""`` for the package itself."""
    return (dotted.split(".") + [""])[1]


def wrong_layers(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports of a part of pixmetry that this part may not import."""
    part = part_of(module)
    wrong = []
    for found in imports(source, module, is_package):
        if found.dotted.split(".")[0] != "pixmetry" or found.dotted == "pixmetry.__version__":
            continue
        if part_of(found.dotted) not in {part, *ALLOWED[part]}:
            wrong.append(f"{module}:{found.line} imports {found.dotted}")
    return wrong


def wrong_kernel_imports(source: str, module: str) -> list[str]:
    """Imports of a kernel file beyond numpy, math, numba, ``core.jit`` and other kernel files."""

    def allowed(found: Import) -> bool:
        if found.module in {"__future__", "numpy", "math", "numba", "pixmetry.core.jit"} or found.dotted == "pixmetry.core.jit":
            return True
        ours = found.module.startswith("pixmetry.")
        return ours and any(KERNEL_FILE.fullmatch(name) for name in (found.module.rpartition(".")[2], found.name))

    return [f"{module}:{found.line} imports {found.dotted}" for found in imports(source, module) if not allowed(found)]


def global_randomness(source: str, module: str) -> list[str]:
    """Uses of ``numpy.random`` or the standard ``random``: draws come from keyed streams only, and ``core.random`` is their home."""
    if module == "pixmetry.core.random":
        return []
    tree = ast.parse(source)
    numpy = {a.asname or a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names if a.name == "numpy"}
    lines = [f.line for f in imports(source, module) if (f.dotted + ".").startswith(("numpy.random.", "random."))]
    lines += [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr == "random" and isinstance(node.value, ast.Name) and node.value.id in numpy
    ]
    return [f"{module}:{line} draws outside the keyed streams" for line in lines]


def own_parallelism(source: str, module: str) -> list[str]:
    """Anything that starts threads or processes; locks are no parallelism."""
    tree = ast.parse(source)
    lines = [f.line for f in imports(source, module) if f.dotted.split(".")[0] in THREADS]
    lines += [f.line for f in imports(source, module) if f.module == "threading" and f.name and f.name not in LOCKS]
    for node in ast.walk(tree):
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


def test_every_part_has_its_place() -> None:
    assert {part_of(module_name(path)) for path in FILES} - {""} <= set(ALLOWED)


def test_allowed_imports_make_no_circle() -> None:
    """Take away what imports nothing that is left, until all are gone."""
    left = {part: targets - {part} for part, targets in ALLOWED.items()}
    while left:
        done = {part for part, targets in left.items() if not targets & set(left)}
        assert done, f"a circle among {sorted(left)}"
        left = {part: targets for part, targets in left.items() if part not in done}


def test_parts_import_downwards_only() -> None:
    wrong = [w for path in FILES if path.parent != SRC or path.stem != "__init__" for w in _checked_layers(path)]
    assert not wrong, "\n".join(wrong)


def _checked_layers(path: Path) -> list[str]:
    return wrong_layers(path.read_text(), module_name(path), path.stem == "__init__")


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
        ("pixmetry.core.camera", "from pixmetry.sensor import shot_noise"),
        ("pixmetry.core.camera", "from pixmetry import sensor"),
        ("pixmetry.core.camera", "def f():\n    import pixmetry.budget.montecarlo"),
        ("pixmetry.core.camera", "importlib.import_module('pixmetry.sensor.prnu')"),
        ("pixmetry.sensor.prnu", "from ..optics.psf import blur"),
        ("pixmetry.sensor.prnu", "from pixmetry import assess"),
        ("pixmetry.experiment.moments", "from pixmetry.sensor.prnu import SOURCE"),
        ("pixmetry.budget.propagate", "from pixmetry.experiment import moments"),
        ("pixmetry.report.page", "from pixmetry.cli import main"),
    ],
)
def test_a_planted_wrong_import_is_caught(module: str, line: str) -> None:
    assert wrong_layers(line, module)


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("pixmetry.sensor.prnu", "import numpy as np\nfrom pixmetry.core.signal import Signal\nfrom . import _kernels"),
        ("pixmetry.budget.propagate", "from pixmetry.scene import targets\nfrom pixmetry.location import centroid"),
        ("pixmetry.core.provenance", "from pixmetry import __version__"),
    ],
)
def test_a_right_import_passes(module: str, line: str) -> None:
    assert not wrong_layers(line, module)


@pytest.mark.parametrize("line", ["import scipy", "from pixmetry.core.signal import Signal", "import os", "from .prnu import SOURCE"])
def test_a_planted_kernel_import_is_caught(line: str) -> None:
    assert wrong_kernel_imports(line, "pixmetry.sensor._kernels")


@pytest.mark.parametrize(
    "line", ["from pixmetry.core._random_kernels import normal", "from . import _smear_kernels", "from pixmetry.core.jit import jit"]
)
def test_a_right_kernel_import_passes(line: str) -> None:
    assert not wrong_kernel_imports(line, "pixmetry.sensor._kernels")


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
    assert global_randomness(source, "pixmetry.sensor.prnu")


def test_own_streams_are_not_global_randomness() -> None:
    assert not global_randomness("from pixmetry.core.random import Stream\nfrom pixmetry.core import random", "pixmetry.sensor.prnu")


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
    assert own_parallelism(source, "pixmetry.sensor.prnu")


def test_a_lock_is_not_parallelism() -> None:
    assert not own_parallelism("import threading\nlock = threading.RLock()", "pixmetry.core.jit")
