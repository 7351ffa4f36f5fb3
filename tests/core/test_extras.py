"""What serves one job comes with an extra: all else works without it, and who lacks it is told what to do, before any work."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.core.extras import EXTRAS, import_extra
from pixmetry.files.images import write_frame

ROOT = Path(__file__).resolve().parents[2]


NOT_IN_ALL = ("basler",)  # a camera's own library, which who has no such camera does not want


def lacking(monkeypatch: pytest.MonkeyPatch, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)


def test_every_optional_package_is_in_its_extra_and_in_no_other_place() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for package, extra, _ in EXTRAS.values():
        assert package in [name.partition(">")[0] for name in extras[extra]]
        assert not any(name.startswith(package) for name in project["dependencies"])
        assert (extra in extras["all"][0]) == (extra not in NOT_IN_ALL)


def test_pages_install_extras_that_there_are_from_a_checkout() -> None:
    """pixmetry is on no package index: `pip install pixmetry` would bring somebody else's."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    told = set()
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for what, names in re.findall(r"pip install ['\"]?([\w.]+)\[([\w,]+)\]", page.read_text(encoding="utf-8")):
            assert what == ".", page
            told |= set(names.split(","))
    assert told <= set(extras) and {"all", *NOT_IN_ALL} <= told


@pytest.mark.parametrize("module", EXTRAS)
def test_who_lacks_a_package_is_told_what_to_do(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    package, extra, what = EXTRAS[module]
    lacking(monkeypatch, module)
    with pytest.raises(InputError) as caught:
        import_extra(module)
    for words in (f"the package {package} is not installed", what, f"pip install {package}", f"'.[{extra}]'"):
        assert words in str(caught.value)


def test_a_package_that_cannot_be_loaded_is_not_called_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cv2.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"cannot be loaded \(libGL\.so\.1"):
        import_extra("cv2")


def test_commands_say_so_before_they_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = np.zeros((80, 80), np.uint8)
    frame[30:40, 30:40] = 200
    write_frame(tmp_path / "a.png", frame, 8)
    for module in EXTRAS:
        lacking(monkeypatch, module)
    lacking(monkeypatch, "pyarrow")
    for arguments, extra in (
        (["locate", str(tmp_path / "a.png"), "-o", str(tmp_path / "t.parquet")], "parquet"),
        (["locate", str(tmp_path / "a.png"), "--kind", "chessboard", "--grid", "5x4"], "opencv"),
        (["locate", str(tmp_path / "a.png"), "--kind", "edge"], "opencv"),
        (["calibrate", str(tmp_path / "a.png"), "--grid", "5x4", "--pitch-mm", "10", "-o", str(tmp_path / "out")], "opencv"),
    ):
        done = CliRunner().invoke(main, arguments)
        assert done.exit_code == 2 and f"'.[{extra}]'" in done.stderr and done.stdout == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png"]


def test_discs_are_located_and_frames_assessed_without_any_extra(tmp_path: Path) -> None:
    code = f"""
import sys
for name in ("cv2", "pyarrow", "pyarrow.parquet", "av"):
    sys.modules[name] = None
import numpy as np, pixmetry
y, x = np.indices((64, 64))
frame = np.where(np.hypot(x - 30.3, y - 28.6) < 6, 200, 20).astype(np.uint8)
print(len(pixmetry.locate(frame)), round(pixmetry.assess(None, {str(tmp_path / "out")!r}, trials=100).budget.verdict.total_px, 3))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ), check=False)
    assert done.returncode == 0, done.stderr
    count, total_px = done.stdout.split()
    assert count == "1" and 0.002 < float(total_px) < 0.006
