"""A source in a file of the user's own: the complete example of the documentation."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pixmetry.camera.catalogue import add_source_file, sources
from pixmetry.core.errors import ChainError, InputError

PAGE = Path(__file__).resolve().parents[2] / "docs" / "adding-a-source.md"


@pytest.fixture
def example(tmp_path: Path) -> Path:
    """The complete module of the page."""
    text = re.search(r"```python\n(\"\"\"Dark fan noise.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    assert text is not None
    path = tmp_path / "fan_noise.py"
    path.write_text(text[1], encoding="utf-8")
    return path


def test_the_documented_source_works_from_a_file(example: Path) -> None:
    before = set(sources())
    try:
        source = add_source_file(example)
        assert add_source_file(example).id == source.id == "electronics.fan_noise"
        from catalogue.support import Flat, camera_with

        frames = camera_with(source, source.make({"offset_std_dn": 2.0})).expose(Flat(50.0), 200).data
        assert np.ptp(frames, axis=(1, 2)).max() < 1e-3
        assert abs(frames[:, 0, 0].std() - 2.0) < 6 * 2.0 / np.sqrt(400)
    finally:
        for name in set(sources()) - before:
            del sources()[name]


def test_the_command_takes_the_file(example: Path) -> None:
    command = [sys.executable, "-m", "pixmetry", "--source-file", str(example), "sources", "electronics.fan_noise"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "Fan noise" in done.stdout


@pytest.mark.parametrize(
    ("text", "match"),
    [("SOURCE = 1\n", "no Source record"), ("import no_such_module\n", "cannot be run: ModuleNotFoundError"), ("x = (\n", "SyntaxError")],
)
def test_files_that_hold_no_source_are_refused(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "bad.py").write_text(text)
    with pytest.raises(InputError, match=match):
        add_source_file(tmp_path / "bad.py")
    with pytest.raises(InputError, match="no such file"):
        add_source_file(tmp_path / "none.py")


def test_an_id_that_is_taken_is_refused(example: Path) -> None:
    example.write_text(example.read_text().replace("electronics.fan_noise", "electronics.gain"))
    with pytest.raises(ChainError, match="already taken"):
        add_source_file(example)
