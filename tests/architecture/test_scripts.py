"""What benchmarks, scripts and the gallery take from the package is there, also where a program stands in a text."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path for folder in ("benchmarks", "scripts", "docs/gallery") for path in (ROOT / folder).glob("*.py"))
IMPORT = re.compile(r"^\s*from (pixmetry[\w.]*) import (\([^)]*\)|[^\n#(]+)", re.MULTILINE)


def missing(text: str) -> list[str]:
    """Names that a text imports from the package, and that are not there."""
    wrong = []
    for module, names in IMPORT.findall(text):
        for name in (part.split(" as ")[0].strip() for part in names.strip("()").split(",") if part.strip()):
            try:
                if not hasattr(import_module(module), name):
                    import_module(f"{module}.{name}")
            except ImportError:
                wrong.append(f"{module}.{name}")
    return wrong


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_imports_of_the_package_are_there(path: Path) -> None:
    assert not missing(path.read_text(encoding="utf-8"))


def test_a_planted_import_of_nothing_is_found() -> None:
    program = 'RUN = """\nfrom pixmetry.core.camera import load_camera\n"""\n'
    text = program + "from pixmetry.core.errors import (\n    InputError,\n    Nothing,\n)\n"
    assert missing(text) == ["pixmetry.core.camera.load_camera", "pixmetry.core.errors.Nothing"]
