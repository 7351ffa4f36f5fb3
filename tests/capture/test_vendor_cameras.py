"""Cameras behind the libraries of their makers: Basler's emulator and the fake camera of Aravis, where they are installed."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from pixmetry.capture.aravis import AravisCamera, aravis
from pixmetry.capture.basler import BaslerCamera
from pixmetry.capture.job import capture
from pixmetry.capture.plan import Step
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.files.images import read_frame, write_frame


class Nobody:
    def ready(self, what: str) -> None:
        pass

    def number(self, key: str, what: str) -> float:
        raise AssertionError


def steps(frames: int) -> tuple[Step, ...]:
    return (Step(1, "pattern", "pattern", "A scene.", "pattern", frames, light=0.5),)


def has_aravis() -> bool:
    try:
        return aravis() is not None
    except InputError:
        return False


class Failing:
    """A camera of the emulator whose next buffers fail at certain frames."""

    def __init__(self, camera: BaslerCamera, failing: dict[int, int]) -> None:
        self.camera, self.failing, self.asked = camera, failing, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.camera, name)

    def frame(self, timeout_s: float) -> Any:
        self.asked += 1
        if self.asked in self.failing:
            self.camera._camera.ForceFailedBufferCount.Value = self.failing[self.asked]
            self.camera._camera.ForceFailedBuffer.Execute()
        return self.camera.frame(timeout_s)


@pytest.mark.skipif(find_spec("pypylon") is None, reason="pypylon is not installed")
def test_frames_of_the_emulator_are_right_to_the_bit_and_failed_buffers_counted(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    (tmp_path / "in").mkdir()
    sent = [rng.integers(0, 4096, (48, 64)).astype(np.uint16) for _ in range(7)]
    for k, frame in enumerate(sent):
        write_frame(tmp_path / "in" / f"a_{k}.png", frame << 4, 16)  # the emulator takes 16 bits as the whole scale
    camera = BaslerCamera(bits=12)
    node = camera._camera
    node.Width.Value, node.Height.Value = 64, 48
    node.ImageFilename.Value, node.ImageFileMode.Value, node.TestImageSelector.Value = str(tmp_path / "in"), "On", "Off"
    failing = {10: 5, 40: 1, 70: 3}
    try:
        found = capture(Failing(camera, failing), steps(100), tmp_path / "shots", Nobody(), full_s=0.02)  # type: ignore[arg-type]
    finally:
        camera.close()
    assert found.faults == {"damaged": 9} and found.frames == 100
    known = {frame.tobytes() for frame in sent}
    assert all(read_frame(path).tobytes() in known for path in (tmp_path / "shots" / "frames").iterdir())


@pytest.mark.skipif(not has_aravis(), reason="Aravis is not installed")
def test_the_fake_camera_of_aravis_is_taken_by_trial_of_the_exposure(tmp_path: Path) -> None:
    camera = AravisCamera("Fake_1", bits=8)
    try:
        found = capture(camera, steps(20), tmp_path / "shots", Nobody(), full_s=0.02)
    finally:
        camera.close()
    assert found.frames == 20 and found.faults == {}
    assert read_frame(tmp_path / "shots" / "frames" / "pattern_01_0001.tif").shape == (512, 512)


@pytest.mark.skipif(find_spec("pypylon") is not None, reason="pypylon is installed")
def test_without_pypylon_one_error_tells_what_to_install(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["capture", "basler", "-o", str(tmp_path / "x"), "--yes"])
    assert done.exit_code == 2 and "'.[basler]'" in done.stderr and not (tmp_path / "x").exists()


def test_without_aravis_one_error_tells_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gi", None)
    done = CliRunner().invoke(main, ["capture", "aravis", "-o", str(tmp_path / "x"), "--yes"])
    assert done.exit_code == 2 and "apt install gir1.2-aravis" in done.stderr and not (tmp_path / "x").exists()
