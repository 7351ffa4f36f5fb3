"""A folder that fills, as a camera: whole files only, in order, with what their names and tags tell."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from capture.live_cameras import SHAPE
from pixmetry.capture import folder as room
from pixmetry.capture.cameras import open_camera
from pixmetry.capture.folder import FolderCamera
from pixmetry.capture.job import capture
from pixmetry.capture.plan import Step
from pixmetry.core.errors import InputError
from pixmetry.files.images import read_frame, write_frame


class Recorder:
    """Another program that records: writes the next file when the next frame is asked for."""

    def __init__(self, camera: FolderCamera, files: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch) -> None:
        self.files, self.asked = files, list[str]()
        look = camera._look
        self.camera = camera

        def write_then_look() -> None:
            if self.files and not camera._ready:
                name, raw = self.files.pop(0)
                camera.folder.joinpath(name).write_bytes(raw)
            look()

        monkeypatch.setattr(camera, "_look", write_then_look)
        for name, seconds in (("LOOK_S", 0.001), ("SETTLED_S", 0.004), ("DAMAGED_S", 0.02)):
            monkeypatch.setattr(room, name, seconds)

    def ready(self, what: str) -> None:
        self.asked.append(what)

    def number(self, key: str, what: str) -> float:
        raise AssertionError


def stored(tmp_path: Path, frame: np.ndarray) -> bytes:
    write_frame(tmp_path / "one.tif", frame, 12)
    return (tmp_path / "one.tif").read_bytes()


def steps(frames: int) -> tuple[Step, ...]:
    return (Step(1, "pattern", "pattern", "A scene.", "pattern", frames, light=0.5),)


def test_every_fault_of_a_recorder_is_counted(rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [rng.integers(100, 3000, SHAPE).astype(np.uint16) for _ in range(12)]
    raw = [stored(tmp_path, frame) for frame in frames]
    files = [(f"img_{k:04d}.tif", one) for k, one in enumerate(raw)]
    del files[7]  # a number is left out
    files[4] = (files[4][0], raw[4][: len(raw[4]) // 2])  # was cut off
    files[2] = (files[2][0], raw[1])  # the frame before once more
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "img_0000_before.tif").write_bytes(raw[0])
    camera = FolderCamera(tmp_path / "in", 12)
    recorder = Recorder(camera, files, monkeypatch)
    found = capture(camera, steps(9), tmp_path / "shots", recorder, full_s=0.02)
    assert found.faults == {"missed": 1, "damaged": 1, "doubled": 1}
    kept = [read_frame(path) for path in sorted((tmp_path / "shots" / "frames").iterdir())]
    expected = [frame for k, frame in enumerate(frames) if k not in (2, 4, 7)]
    assert len(kept) == len(expected) and all(np.array_equal(a, b) for a, b in zip(kept, expected, strict=True))
    assert any("10 ms" in line for line in recorder.asked)


def test_frames_with_another_exposure_time_do_not_count(rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = [stored(tmp_path, rng.integers(100, 3000, SHAPE).astype(np.uint16)) for _ in range(5)]
    files = [(f"exp{t}ms_{k:03d}.tif", one) for k, (t, one) in enumerate(zip((10, 5, 10, 10.05, 10), raw, strict=True))]
    (tmp_path / "in").mkdir()
    camera = FolderCamera(tmp_path / "in", 12)
    found = capture(camera, steps(4), tmp_path / "shots", Recorder(camera, files, monkeypatch), full_s=0.02)
    assert found.frames == 4 and found.faults == {"damaged": 1}


def test_exposure_times_at_the_end_of_names_count_no_frames(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = [stored(tmp_path, rng.integers(100, 3000, SHAPE).astype(np.uint16)) for _ in range(4)]
    (tmp_path / "in").mkdir()
    camera = FolderCamera(tmp_path / "in", 12)
    files = [(f"img_{k:04d}_10ms.tif", raw[k]) for k in (0, 1, 3)]
    found = capture(camera, steps(3), tmp_path / "shots", Recorder(camera, files, monkeypatch), full_s=0.02)
    assert found.frames == 3 and found.faults == {"missed": 1}


def test_a_file_that_is_being_written_is_waited_for(rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = rng.integers(100, 3000, SHAPE).astype(np.uint16)
    raw = stored(tmp_path, frame)
    (tmp_path / "in").mkdir()
    camera = FolderCamera(tmp_path / "in", 12)
    cuts = np.sort(rng.choice(np.arange(1, len(raw)), 5, replace=False))
    Recorder(camera, [("a_1.tif", raw[:cut]) for cut in (*cuts, len(raw))], monkeypatch)
    camera.start()
    for path in (tmp_path / "in").iterdir():
        os.utime(path)
    got = camera.frame(5.0)
    assert got is not None and got.complete and got.number == 1 and np.array_equal(got.array, frame)
    assert camera.frame(0.01) is None


def test_what_is_not_known_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="bits of a stored value"):
        open_camera(f"folder:{tmp_path}")
    camera = open_camera(f"folder:{tmp_path}", 12)
    with pytest.raises(InputError, match="--full-s"):
        capture(camera, steps(1), tmp_path / "shots", Recorder(camera, [], monkeypatch))
    with pytest.raises(InputError, match="no such folder"):
        open_camera(f"folder:{tmp_path / 'x'}", 8)
