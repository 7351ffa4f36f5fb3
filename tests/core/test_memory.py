"""Memory is asked for before it is taken."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pixmetry import load_camera
from pixmetry.core.errors import InputError
from pixmetry.core.memory import available_bytes, check_memory
from pixmetry.files import read_frame
from pixmetry.files.images import read_picture
from pixmetry.scene.uniform import Uniform
from pixmetry.simulate.job import simulate


def test_what_is_free_is_what_the_system_says() -> None:
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < available_bytes() <= whole
    check_memory(1, "a byte", remedy="")
    with pytest.raises(InputError, match=r"it needs .* GiB of memory; allowed: up to .*, the free memory; to do: less"):
        check_memory(2.0 * whole, "it", remedy="less")


def test_a_limit_of_the_process_counts() -> None:
    limited = "import resource as r; r.setrlimit(r.RLIMIT_AS, (3 << 30, 3 << 30)); "
    code = limited + "from pixmetry.core.memory import available_bytes as a; print(a())"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 < int(ran.stdout) < 3 << 30


def test_a_file_with_a_hole_is_not_read_into_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        try:
            file.truncate(1 << 43)
        except OSError:
            pytest.skip("no file system for files of 8 TB")
    for read in (read_frame, read_picture):
        with pytest.raises(InputError, match="a.png: the file needs .* of memory"):
            read(path)


def test_frames_that_do_not_fit_are_refused_before_any_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, light = load_camera("imx264_like"), Uniform(100.0)
    with pytest.raises(InputError, match="imx264_like: 1000000000000 frames of 8 x 8 pixels need"):
        camera.expose(light, frames=10**12, window=(0, 0, 8, 8))
    scene = {"schema": "pixmetry/scene/1", "uniform": {"level_photons": 100}}
    with pytest.raises(InputError, match="record of 1000000000000 frames"):
        simulate(camera, scene, tmp_path / "out", frames=10**12, window=(0, 0, 8, 8))
    assert next(iter(camera.iter_frames(light, range(10**9), window=(0, 0, 8, 8)))).data.shape == (1, 8, 8)  # one by one they fit
    monkeypatch.setattr("pixmetry.core.memory.available_bytes", lambda: 20 << 30)
    with pytest.raises(InputError, match="a frame of 60000 x 60000 pixels needs 26.8 GiB of memory; allowed: up to 20 GiB"):
        simulate(camera, scene, tmp_path / "out", overrides={"rows": 60_000, "cols": 60_000})
    assert not list(tmp_path.iterdir())
