"""The code on the pages of docs/: every block of Python runs on small data, and every command line is one that the program takes.

The pages docs/start-*.md run from top to bottom in test_getting_started, the README in test_readme, the scripts of the handbook in
tests/handbook (and all of them, twice, by `make handbook-check`), the examples of the API in test_examples.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest

import pixmetry
from pixmetry.camera.camera import Camera
from pixmetry.cli import main
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

ROOT = Path(__file__).resolve().parents[1]
PAGES = {p.stem: p for p in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]}
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)
ELSEWHERE = {"README", *(name for name in PAGES if name.startswith("start-"))}


def blocks(name: str, language: str) -> list[str]:
    return [body for found, body in BLOCK.findall(PAGES[name].read_text(encoding="utf-8")) if found == language]


@cache
def camera() -> Camera:
    from dataclasses import replace

    return replace(pixmetry.load_camera("imx264_like"), frame_shape=(96, 128))


def pictures(count: int = 1) -> np.ndarray:
    x, y = (v.ravel() for v in np.meshgrid(np.arange(20.3, 120, 30), np.arange(20.6, 90, 28)))
    return camera().expose(Discs(x, y, 10.0, 0.8, 9000.0, Uniform(300.0)), count, seed=1).data


def even(level_photons: float, count: int) -> np.ndarray:
    return camera().expose(Uniform(level_photons), count, seed=2).data


def on_locating(folder: Path) -> dict[str, Any]:
    from pixmetry.locate.circles.ellipses import Pinhole

    seen = Pinhole(principal_distance_px=2000, principal_x_px=63.5, principal_y_px=47.5)
    pose = np.array([[300.0, 0, 63.5], [0, 300.0, 47.5], [0, 0, 1.0]])
    return {"frame": pictures()[0], "first": pictures()[0], "frames": pictures(3), "camera": seen, "normal": (0.0, 0.1, 1.0),
            "positions": pixmetry.locate(pictures()[0], kind="ellipse"), "undistort": lambda x, y: (x, y), "homography": pose,
            "x": np.array([0.01]), "y": np.array([0.02]), "radius": np.array([0.01])}  # fmt: skip


def on_frames(folder: Path) -> dict[str, Any]:
    return {"dark_1ms": even(0.0, 4), "bright_1ms": even(5000.0, 4)}


def on_planning(folder: Path) -> dict[str, Any]:
    return {"dark_frames": list(even(0.0, 4)), "bright_frames": list(even(5000.0, 4))}


def on_simulate(folder: Path) -> dict[str, Any]:
    disc = {"kind": "disc", "x_px": 40.2, "y_px": 30.3, "diameter_px": 8, "peak_photons": 9000}
    scene = {"schema": "pixmetry/scene/1", "targets": [disc]}
    pixmetry.simulate(camera(), scene, folder / "frames", frames=4, seed=1, truth=True)
    return {}


def on_sheets(folder: Path) -> dict[str, Any]:
    pixmetry.emva1288(json=folder / "march.json")
    for name in ("june", *"12345"):
        shutil.copy(folder / "march.json", folder / f"{name}.json")
    (limits,) = (b for b in blocks("compare", "yaml") if "limits" in b)
    (folder / "limits.yaml").write_text(limits, encoding="utf-8")
    return {}


def on_calibrating(folder: Path) -> dict[str, Any]:
    """A field of 8 m × 3 m in ten pictures, written without the package, now and later; a rig; straight lines."""
    from calibrate.networks import distorted
    from calibrate.rigs import simulated_rig, written
    from pixmetry.calibrate.bundle.model import Sensor

    rng = np.random.default_rng(1)
    sensor, lens = Sensor(1024, 768, 24.0, 24.0), (28.5, 511.5, 383.5, 0, 0, 0, 0, -8e-5, 9e-8, 0, 0, 0)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, 8, 9), np.linspace(0, 3, 5)))
    field = {f"P{k}": (x[k], y[k], 4 + 0.3 * np.sin(k)) for k in range(len(x))} | {"C1": (0.02, 1.5, 4.0), "C2": (7.5, 2.25, 4.1)}
    xyz = np.array(list(field.values()))
    for name in ("project", "later"):
        rows = []
        for k in range(10):
            roll, place = k % 4 * np.pi / 2, np.array([4 + 3 * np.cos(0.9 * k), 1.5 + 2 * np.sin(1.7 * k), -7.0])
            z = (np.array([4, 1.5, 4]) - place) / np.linalg.norm(np.array([4, 1.5, 4]) - place)
            side = np.cross([0.0, 1, 0], z) / np.linalg.norm(np.cross([0.0, 1, 0], z))
            right, down = np.cos(roll) * side + np.sin(roll) * np.cross(z, side), -np.sin(roll) * side + np.cos(roll) * np.cross(z, side)
            local = (xyz - place) @ np.array([right, down, z]).T
            px, py = distorted(lens, sensor, "image_to_object", *(local[:, :2] / local[:, 2:]).T)
            bent = 0.4 * np.sin(px / 60)  # which no lens does: the grid of residuals has something to correct
            px, py = px + bent + 0.03 * rng.standard_normal(len(px)), py + 0.03 * rng.standard_normal(len(px))
            inside = (px > 0) & (px < 1023) & (py > 0) & (py < 767)
            rows += [f"DSC_{k + 1:04d},{n},{a:.4f},{b:.4f}" for n, a, b, i in zip(field, px, py, inside, strict=True) if i]
        (folder / f"{name}.csv").write_text("image,point,x_px,y_px\n" + "\n".join(rows))
        (folder / "points.csv").write_text("point,X,Y,Z\n" + "\n".join(f"{n},{a},{b},{c}" for n, (a, b, c) in field.items() if n[0] == "P"))
        (folder / f"{name}.yaml").write_text(
            "schema: pixmetry/calibration/1\ncameras: {cols: 1024, rows: 768, pitch_um: 24, free: 'c, xp, yp, k1, k2'}\n"
            f"observations: {{table: {name}.csv, u_px: 0.05}}\npoints: {{table: points.csv, known: fixed}}\n"
            "options: {residual_grid: true}\n"
        )
    pixmetry.calibrate(folder / "later.yaml", folder / "later")
    (folder / "pair").mkdir()
    pixmetry.calibrate(written(folder / "pair", simulated_rig(rng, instants=6), "rig: names\n"), folder / "rig")
    k, along = (v.ravel() for v in np.meshgrid(np.arange(10), np.arange(5.0, 570, 10)))
    lying, across = k % 2 == 1, 40 + 55 * k + 0.05 * along + 1e-5 * (along - 280) ** 2 + 0.02 * rng.standard_normal(k.size)
    x, y = np.where(lying, along, across), np.where(lying, across, along)
    image = np.where(lying, "lying", "upright")
    rows = [f"{a},{b},{c:.3f},{d:.3f}" for a, b, c, d in zip(image, k, x, y, strict=True)]
    (folder / "lines.csv").write_text("image,line,x_px,y_px\n" + "\n".join(rows))
    (text,) = (b for b in blocks("calibrating", "yaml") if "lines: lines.csv" in b)
    (folder / "lines.yaml").write_text(text)
    return {"x_px": x, "y_px": y, "line": k, "image": image, "cv2": pytest.importorskip("cv2"),
            "picture": np.zeros((1536, 2048), np.uint8), "left_px": np.full((3, 2), 700.0), "right_px": np.full((3, 2), 600.0)}  # fmt: skip


BEFORE: dict[str, Callable[[Path], dict[str, Any]]] = {
    "calibrating": on_calibrating,
    "locating": on_locating, "frames": on_frames, "planning": on_planning, "simulate": on_simulate, "compare": on_sheets,
}  # fmt: skip
INSTEAD = {
    "emva1288": {'"EMVA1288_Data.txt"': "None"},  # the packaged example
    "calibrating": {'camera_pair(read_calibration("result"), "left", "right")': 'camera_pair(read_calibration("rig"), "cam0", "cam1")'},
}


@pytest.mark.parametrize("name", [n for n in PAGES if blocks(n, "python") and n not in ELSEWHERE])
def test_the_python_of_a_page_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))  # which the tests do not install
    names = BEFORE.get(name, lambda folder: {})(tmp_path)
    for code in blocks(name, "python"):
        given = dict(names)
        with contextlib.redirect_stdout(io.StringIO()):
            for written, other in INSTEAD.get(name, {}).items():
                code = code.replace(written, other)
            exec(compile(code, f"docs/{name}.md", "exec"), names)
        names |= given  # a block does not change what the next one is given


def commands(name: str) -> list[list[str]]:
    """Words of each command line of a page: those of `sh` blocks, and those behind a ``$``."""
    text = PAGES[name].read_text(encoding="utf-8")
    lines = [line for block in blocks(name, "sh") for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"^\$ (pixmetry .+)$", text, re.M)
    return [words for line in lines if (words := shlex.split(line, comments=True)) and words[0] == "pixmetry"]


def refused(words: list[str]) -> str:
    """Why the program does not take a command line, before it looks at any file; empty if it does."""
    command: click.Command | None = main
    context = click.Context(main, info_name="pixmetry")
    rest = words[1:]
    while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
        command = command.get_command(context, rest[0])
        if command is None:
            return f"no command {rest[0]}"
        context, rest = click.Context(command, info_name=rest[0], parent=context), rest[1:]
    assert command is not None
    try:
        command.make_parser(context).parse_args([w for w in rest if w != "…"])
    except click.UsageError as problem:
        return problem.format_message()
    return ""


@pytest.mark.parametrize("name", [n for n in PAGES if commands(n)])
def test_the_program_takes_the_command_lines_of_a_page(name: str) -> None:
    wrong = {shlex.join(words): why for words in commands(name) if (why := refused(words))}
    assert not wrong


def test_a_command_line_that_is_none_is_seen() -> None:
    assert refused(shlex.split("pixmetry locate a.png --kind disc")) == ""
    assert "No such option" in refused(shlex.split("pixmetry locate a.png --kinds disc"))
    assert refused(shlex.split("pixmetry lokate a.png")) == "no command lokate"
    assert sum(len(commands(name)) for name in PAGES) > 100
