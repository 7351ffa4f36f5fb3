"""Results on disk: whole or not at all, nobody's files lost, strict JSON, exact maps, provenance without folders."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from pixmetry.campaign import InputHashes, provenance_record, read_maps, staged_output, write_json, write_maps
from pixmetry.campaign.output import _host
from pixmetry.core.errors import InputError


def content(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text(encoding="utf-8") for p in folder.iterdir() if not p.name.startswith(".")}


def make(folder: Path, text: str = "first") -> None:
    with staged_output(folder, "assessment") as stage:
        (stage / "results.json").write_text(text, encoding="utf-8")


def test_result_appears_whole_and_replaces_the_old_one(tmp_path: Path) -> None:
    target = tmp_path / "below" / "result"
    with staged_output(target, "assessment") as stage:
        (stage / "results.json").write_text("first", encoding="utf-8")
        (stage / "old-only.txt").write_text("x", encoding="utf-8")
        assert not target.exists()
    assert content(target) == {"results.json": "first", "old-only.txt": "x"}
    make(target, "second")
    assert content(target) == {"results.json": "second"}
    assert [p.name for p in target.parent.iterdir()] == ["result"]


@pytest.mark.parametrize("problem", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_interruption_leaves_the_old_result_or_nothing(problem: type[BaseException], tmp_path: Path) -> None:
    target = tmp_path / "result"
    for before in ({}, {"results.json": "first"}):
        if before:
            make(target)
        with pytest.raises(problem), staged_output(target, "assessment") as stage:
            (stage / "results.json").write_text("half", encoding="utf-8")
            raise problem
        assert [p.name for p in tmp_path.iterdir()] == (["result"] if before else [])
        assert not before or content(target) == before


def test_a_failed_swap_puts_the_old_result_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "result"
    make(target)
    replace = os.replace

    def failing(source: Path, goal: Path) -> None:
        if Path(goal) == target and "old" not in Path(source).suffix:
            raise OSError("no space left")
        replace(source, goal)

    with pytest.raises(OSError, match="no space"), staged_output(target, "assessment") as stage:
        (stage / "results.json").write_text("second", encoding="utf-8")
        monkeypatch.setattr(os, "replace", lambda a, b: replace(a, b) if str(b).endswith(".json") else failing(a, b))
    assert content(target) == {"results.json": "first"}
    assert [p.name for p in tmp_path.iterdir()] == ["result"]


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL")
def test_what_a_killed_run_left_is_cleaned_by_the_next(tmp_path: Path) -> None:
    target = tmp_path / "result"
    make(target)
    script = f"""
        import os, signal
        from pixmetry.campaign.output import staged_output
        with staged_output({str(target)!r}, "assessment") as stage:
            (stage / "results.json").write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    """
    assert subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False).returncode == -signal.SIGKILL
    assert content(target) == {"results.json": "first"}
    assert len(list(tmp_path.iterdir())) == 2
    make(target, "second")
    assert content(target) == {"results.json": "second"}
    assert [p.name for p in tmp_path.iterdir()] == ["result"]


@pytest.mark.skipif(os.name == "nt", reason="asks after a process by signal 0")
def test_a_result_set_aside_by_a_killed_run_comes_back(tmp_path: Path) -> None:
    target = tmp_path / "result"
    make(target)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    os.replace(target, tmp_path / f"result.partial-{_host()}-{gone.pid}-0123abcd.old")
    with pytest.raises(RuntimeError), staged_output(target, "assessment"):
        raise RuntimeError
    assert content(target) == {"results.json": "first"}


def test_partial_folders_of_live_runs_and_other_results_are_left_alone(tmp_path: Path) -> None:
    kept = [f"result.partial-{_host()}-{os.getpid()}-0123abcd", "result.partial-otherhost-999999999-0123abcd", "result.partial-notes"]
    for name in [*kept, f"result2.partial-{_host()}-999999999-0123abcd"]:
        (tmp_path / name).mkdir()
    make(tmp_path / "result")
    assert len(list(tmp_path.iterdir())) == 5


def test_folders_with_other_files_are_refused_and_kept(tmp_path: Path) -> None:
    target = tmp_path / "thesis"
    target.mkdir()
    make(target)  # an empty folder may be used
    (target / "chapter.tex").write_text("years of work", encoding="utf-8")
    (target / ".DS_Store").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match=r"not results of pixmetry \(chapter.tex\).*to do: choose another folder"):
        make(target, "second")
    assert content(target) == {"results.json": "first", "chapter.tex": "years of work"}
    (target / "chapter.tex").unlink()
    with pytest.raises(InputError, match="late.txt"), staged_output(target, "assessment"):
        (target / "late.txt").write_text("came meanwhile", encoding="utf-8")
    assert content(target) == {"results.json": "first", "late.txt": "came meanwhile"}
    (target / "late.txt").unlink()
    make(target, "second")
    assert content(target) == {"results.json": "second"}


def test_a_foreign_marker_or_a_file_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "result"
    target.mkdir()
    (target / ".pixmetry-output.json").write_text('{"schema": "other/1", "files": ["a"]}', encoding="utf-8")
    (target / "a").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="not results of pixmetry"):
        make(target)
    with pytest.raises(InputError, match="is a file, not a folder"):
        make(target / "a")
    with pytest.raises(InputError, match="folder cannot be written"):
        make(target / "a" / "b")


def test_json_is_strict_and_takes_numpy_values(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"b": np.float32(0.5), "a": np.arange(3), "c": (np.bool_(True), None, "µ"), "d": {"n": np.int64(2**60)}})
    text = path.read_text(encoding="utf-8")
    assert json.loads(text) == {"b": 0.5, "a": [0, 1, 2], "c": [True, None, "µ"], "d": {"n": 2**60}}
    assert text.index('"b"') < text.index('"a"')
    for bad in (np.nan, float("inf"), np.array([0.0, -np.inf])):
        with pytest.raises(ValueError, match=r"\$\.x\.y.* is .*finite"):
            write_json(path, {"x": {"y": bad}})
    with pytest.raises(TypeError, match=r"\$\.x\[0\] is a set"):
        write_json(path, {"x": [{1}]})
    assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize("name", ["maps.zarr.zip", "maps.zarr"])
@pytest.mark.filterwarnings("error")
def test_inverse_write_then_read_maps(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng()
    maps = {
        "prnu_map_percent": rng.normal(size=(33, 47)),
        "var_map_dn2": np.array([[np.nan, 1e-30]], np.float32),
        "mask": rng.random((5, 7)) > 0.5,
        "spectrum_dn2": np.arange(9, dtype=np.int64),
    }
    write_maps(tmp_path / name, {"old": np.zeros(3)}, {})
    write_maps(tmp_path / name, maps, {"schema": "x/1", "bits": np.int64(12), "range": [0.0, 1.5]})
    again, attrs = read_maps(tmp_path / name)
    assert set(again) == set(maps)
    for key, array in maps.items():
        assert again[key].dtype == array.dtype
        np.testing.assert_array_equal(again[key], array)
    assert attrs == {"schema": "x/1", "bits": 12, "range": [0.0, 1.5]}


def test_missing_or_damaged_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such store"):
        read_maps(tmp_path / "maps.zarr.zip")
    (tmp_path / "maps.zarr.zip").write_bytes(b"PK but not really")
    with pytest.raises(InputError, match="damaged"):
        read_maps(tmp_path / "maps.zarr.zip")
    (tmp_path / "maps.zarr").mkdir()
    with pytest.raises(InputError, match="damaged"):
        read_maps(tmp_path / "maps.zarr")


def test_provenance_names_inputs_but_no_folders(tmp_path: Path) -> None:
    base = tmp_path / "secret" / "campaign"
    hashes = InputHashes(base)
    hashes.add(base / "images" / "b.png", "b" * 64, 7)
    hashes.add(tmp_path / "elsewhere" / "a.png", "a" * 64, 9)
    hashes.add(tmp_path / "elsewhere" / "2" / "a.png", "c" * 64, 9)
    command = ["/home/me/venv/bin/pixmetry", "assess", str(base), f"--out={tmp_path}/out/", "--threads", "2", "C:\\data\\set.txt"]
    record = provenance_record(hashes, command=command, seed=5)
    assert [r["name"] for r in record["inputs"]] == ["a.png", "a.png", "images/b.png"]
    assert record["command"] == ["pixmetry", "assess", "campaign", "--out=out", "--threads", "2", "set.txt"]
    assert record["seed"] == 5
    assert record["libraries"] == {"numpy": np.__version__}
    assert record["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert record["time_utc"].endswith("+00:00")
    path = tmp_path / "provenance.json"
    write_json(path, record)
    assert str(tmp_path) not in path.read_text(encoding="utf-8")
