"""Results on disk: whole or not at all, nobody's files lost, strict JSON, exact maps, provenance without folders."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import signal
import subprocess
import sys
import textwrap
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from files.failing import FAULTS, Failing
from pixmetry.core.errors import InputError
from pixmetry.files import InputHashes, check_output, output, provenance_record, read_maps, staged_output, write_json, write_maps
from pixmetry.files.output import MARKER, _host
from pixmetry.files.strict_json import json_text


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


def tree(folder: Path) -> dict[str, bytes]:
    """All files below a folder but the notes of what was written, and what an interrupted run leaves for the next one to clean."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != MARKER]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files if ".partial-" not in p.relative_to(folder).as_posix()}


def make_tree(folder: Path, text: str, names: tuple[str, ...]) -> None:
    with staged_output(folder, "assessment") as stage:
        for name in names:
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).write_text(text, encoding="utf-8")


FIRST, SECOND = ("a.json", "maps/0/0", "maps/1/0", "old/b"), ("a.json", "maps/0/0", "new/c")


@pytest.mark.parametrize("inside", [False, True], ids=["folder", "files"])
@pytest.mark.parametrize(("problem", "after"), FAULTS, ids=["fails", "interrupted before", "interrupted after"])
def test_a_swap_that_fails_anywhere_leaves_the_old_or_the_new_result(
    inside: bool, problem: BaseException, after: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every rename and every making and removing of a folder is made to fail once; whole folders and files one by one."""
    ends = set()
    for name in ("replace", "mkdir", "rmdir", "unlink"):
        for at in range(1, 60):
            target = tmp_path / f"{name}{at}" / "result"
            make_tree(target, "first", FIRST)
            old = tree(target)
            with monkeypatch.context() as patch:
                if inside:
                    patch.setattr("pixmetry.files.output._place", lambda folder: folder)
                failing = Failing(getattr(os, name), at, problem, after)
                with suppress(OSError, InputError, KeyboardInterrupt), staged_output(target, "assessment") as stage:
                    for part in SECOND:
                        (stage / part).parent.mkdir(parents=True, exist_ok=True)
                        (stage / part).write_text("second", encoding="utf-8")
                    patch.setattr(os, name, failing)
            found = tree(target)
            assert found in (old, {part: b"second" for part in SECOND}), (name, at)
            ends.add((name, found == old))
            make_tree(target, "third", SECOND)
            assert tree(target) == {part: b"third" for part in SECOND}, (name, at)
            assert [p.name for p in target.parent.iterdir()] == ["result"], (name, at)
            if failing.calls < at:
                break
        else:
            pytest.fail("more calls than were tried")
    assert ("replace", True) in ends and ("replace", False) in ends


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EXDEV])
def test_a_folder_that_cannot_be_renamed_gets_its_files_one_by_one(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, replace = tmp_path / "result", os.replace
    target.mkdir()

    def fixed(source: Path, goal: Path) -> None:
        if target in (Path(source), Path(goal)):
            raise OSError(number, "no")
        replace(source, goal)

    monkeypatch.setattr(os, "replace", fixed)
    for text, names in (("first", FIRST), ("second", SECOND)):
        make_tree(target, text, names)
        assert tree(target) == {name: text.encode() for name in names}
        assert [p.name for p in tmp_path.iterdir()] == ["result"]


def test_the_folder_in_which_one_stands_stays_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    number = tmp_path.stat().st_ino
    for text, names in (("first", FIRST), ("second", SECOND)):
        make_tree(Path(), text, names)
        assert tree(tmp_path) == {name: text.encode() for name in names}
    assert Path().stat().st_ino == number == tmp_path.stat().st_ino


def test_the_mount_point_of_a_disk_is_written_and_a_full_or_read_only_one_is_told_before_the_work(tmp_path: Path) -> None:
    script = textwrap.dedent(f"""
        mount -t tmpfs -o size=200k tmpfs {tmp_path} && mkdir {tmp_path}/below || exit 77
        {sys.executable} - <<'END'
        import os, errno
        from pathlib import Path
        from pixmetry.files.output import check_output, staged_output
        disk = Path({str(tmp_path)!r})
        (disk / "below").rmdir()
        for text in ("first", "second"):
            check_output(disk, "assessment")
            with staged_output(disk, "assessment") as stage:
                (stage / "maps").mkdir()
                (stage / "maps" / "a").write_text(text)
        assert (disk / "maps" / "a").read_text() == "second"
        try:
            with staged_output(disk, "assessment") as stage:
                (stage / "a").write_bytes(bytes(300_000))
        except OSError as problem:
            assert problem.errno == errno.ENOSPC
        assert (disk / "maps" / "a").read_text() == "second" and sorted(os.listdir(disk)) == [".pixmetry-output.json", "maps"]
        END
        [ $? = 0 ] && mount -o remount,ro {tmp_path} && {sys.executable} -c "
        from pixmetry.files.output import check_output
        for name in ('', '/below'):
            try: check_output({str(tmp_path)!r} + name, 'assessment')
            except ValueError as problem: assert 'cannot be written' in str(problem), problem
            else: raise SystemExit(1)
        "
    """)
    if not Path("/usr/bin/unshare").exists():
        pytest.skip("unshare is not there")
    done = subprocess.run(["unshare", "-rm", "sh", "-c", script], capture_output=True, text=True, check=False)
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip("no disk can be mounted here")
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL")
def test_what_a_killed_run_left_is_cleaned_by_the_next(tmp_path: Path) -> None:
    target = tmp_path / "result"
    make(target)
    script = f"""
        import os, signal
        from pixmetry.files.output import staged_output
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


def test_partial_folders_of_other_hosts_and_results_are_left_alone(tmp_path: Path) -> None:
    for name in ("result.partial-otherhost-999999999-0123abcd", "result.partial-notes", f"result2.partial-{_host()}-999999999-0123abcd"):
        (tmp_path / name).mkdir()
    make(tmp_path / "result")
    assert len(list(tmp_path.iterdir())) == 4


def test_two_runs_do_not_write_one_folder(tmp_path: Path) -> None:
    with staged_output(tmp_path / "result", "assessment") as stage:
        (stage / "results.json").write_text("first", encoding="utf-8")
        with pytest.raises(InputError, match=r"another run is writing this folder.*process \d+"):
            make(tmp_path / "result", "second")
        make(tmp_path / "other", "second")
    assert content(tmp_path / "result") == {"results.json": "first"}
    code = "from pixmetry.files import staged_output; from pathlib import Path\n"
    code += f"with staged_output({str(tmp_path / 'result')!r}, 'assessment') as s: print('in', flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "in\n"
        with pytest.raises(InputError, match="another run"):
            check_output(tmp_path / "result", "assessment")
        other.communicate("\n")
    make(tmp_path / "result", "third")


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


@pytest.mark.parametrize("place", ["notes.txt", "frames/notes.txt", "maps/0/notes.txt", "notes/a/b.txt", "notes"])
def test_what_a_user_put_into_a_result_is_kept_at_any_depth(place: str, tmp_path: Path) -> None:
    target = tmp_path / "result"
    names = ("frames/0.tif", "maps/0/0")
    make_tree(target, "first", names)
    if place == "notes":
        (target / place).symlink_to(tmp_path)
    else:
        (target / place).parent.mkdir(parents=True, exist_ok=True)
        (target / place).write_text("mine", encoding="utf-8")
    before = tree(target)
    with pytest.raises(InputError, match=f"not results of pixmetry \\({place}"):
        make_tree(target, "second", names)
    assert tree(target) == before


def test_a_result_that_was_edited_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "result"
    make_tree(target, "first", ("camera.yaml", "maps/0"))
    (target / "camera.yaml").write_text("tuned", encoding="utf-8")
    with pytest.raises(InputError, match=r"changed since they were written \(camera.yaml\).*move these files away"):
        make_tree(target, "second", ("camera.yaml",))
    assert tree(target)["camera.yaml"] == b"tuned"
    (target / "camera.yaml").unlink()
    make_tree(target, "second", ("camera.yaml",))


def test_a_result_of_something_else_is_kept(tmp_path: Path) -> None:
    """The same name in another folder is something else; both folders moved together are the same."""

    def write(base: Path, of: tuple[str | Path, ...]) -> None:
        with staged_output(base / "result", "simulation", of) as stage:
            (stage / "0.tif").write_text(str(of), encoding="utf-8")

    one = ("imx264_like", tmp_path / "a" / "scene.yaml")
    write(tmp_path / "a", one)
    write(tmp_path / "a", one)
    for of in (("pulnix_tm6cn", one[1]), ("imx264_like", tmp_path / "b" / "scene.yaml")):
        with pytest.raises(InputError, match=r"the simulation of something else \(imx264_like, scene.yaml\)"):
            write(tmp_path / "a", of)
    os.rename(tmp_path / "a", tmp_path / "c")
    write(tmp_path / "c", ("imx264_like", tmp_path / "c" / "scene.yaml"))
    with pytest.raises(InputError, match="holds a file that is read.*0.tif"):
        check_output(tmp_path / "c" / "result", "simulation", (), [tmp_path / "c" / "scene.yaml", tmp_path / "c" / "result" / "0.tif"])


def test_a_folder_keeps_its_permissions(tmp_path: Path) -> None:
    make(tmp_path / "result")
    (tmp_path / "result").chmod(0o700)
    make(tmp_path / "result", "second")
    assert (tmp_path / "result").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("name", ["with blanks", "ünï€☃", "two\nlines", "x" * 240, "-o", "a=b,c"])
def test_any_name_that_a_disk_holds(name: str, tmp_path: Path) -> None:
    make(tmp_path / name)
    make(tmp_path / name, "second")
    (tmp_path / "link").symlink_to(tmp_path / name)
    make(tmp_path / "link", "third")
    assert (tmp_path / "link").is_symlink() and content(tmp_path / name) == {"results.json": "third"}
    assert len(list(tmp_path.iterdir())) == 2


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
    with pytest.raises(TypeError, match=r"\$\.x\[0\] is a set"):
        write_json(path, {"x": [{1}]})
    assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_numbers_that_json_does_not_have(tmp_path: Path) -> None:
    """NaN is null and an infinite number a word, whatever holds it; no reader meets what RFC 8259 does not know."""
    path = tmp_path / "a.json"
    write_json(path, {"x": [np.nan, math.inf, np.float32("-inf")], "y": {"z": np.array([[0.5, np.nan]])}})
    record = json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda name: pytest.fail(name))
    assert record == {"x": [None, "inf", "-inf"], "y": {"z": [[0.5, None]]}}


def test_the_layout_holds_the_same_as_any_other(rng: np.random.Generator) -> None:
    record = {"schema": "a/1", "rows": rng.normal(size=(3, 4)).tolist(), "few": {"a": 1, "b": None}, "none": [], "deep": [[{"c": "ä\n"}]]}
    text = json_text(record)
    assert json.loads(text) == record and text.startswith('{\n "schema": "a/1",\n') and text.endswith("\n}\n")
    assert len(text.splitlines()) < 20 and json_text({"a": 1}) == '{\n "a": 1\n}\n'


@pytest.mark.parametrize("name", ["maps.zarr.zip", "maps.zarr"])
@pytest.mark.filterwarnings("error")
def test_inverse_write_then_read_maps(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
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


def test_what_a_killed_run_left_beside_files_is_cleaned_by_the_next(tmp_path: Path) -> None:
    """Killed before each of its renames and removals; what a run that still works has written stays."""
    target = tmp_path / "a.json"
    mark = re.compile(rb"\{")
    program = (
        "import os, re, sys; from pathlib import Path; from pixmetry.files import output; call = getattr(os, sys.argv[2])\n"
        "setattr(os, sys.argv[2], lambda *a, **k: os._exit(77))\n"
        "output.write_together([output.Output(Path(sys.argv[1]), re.compile(rb'\\{'))], [b'{2}'])"
    )
    for call in ("fsync", "link", "replace", "unlink"):
        output.write_together([output.Output(target, mark)], [b"{1}"])
        killed = subprocess.run([sys.executable, "-c", program, str(target), call], check=False)
        assert killed.returncode == 77 and len(list(tmp_path.iterdir())) > 1
        assert target.read_bytes() == (b"{2}" if call == "unlink" else b"{1}")
        working = tmp_path / f".a.json.partial-{output._host()}-{os.getpid()}-01234567"
        working.write_bytes(b"")
        output.write_together([output.Output(target, mark)], [b"{3}"])
        assert sorted(p.name for p in tmp_path.iterdir()) == sorted([working.name, "a.json"])
        assert target.read_bytes() == b"{3}"
        working.unlink()
