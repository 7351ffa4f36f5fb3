"""What commands print of names that were made to do something."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rich.table import Table

from calibrate.networks import simulate
from pixmetry.calibrate.files.write import points_csv, residuals_csv
from pixmetry.calibrate.job import calibrate
from pixmetry.calibrate.project.tables import read_table
from pixmetry.cli import main
from pixmetry.cli._console import console
from pixmetry.files import write_frame
from pixmetry.locate.records import Located

ORDERS = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]")
EVIL = ["=1+2", "+cmd|' /C calc'!A0", "-x", "@SUM(A1)", "\tx", "\x1b[2Jx", "a,=1", "'=1", "#1", " x ", "two\nlines", "-5", 'a "x"', "\\x1b"]


def test_a_console_draws_its_own_colours_and_no_others() -> None:
    out = io.StringIO()
    table = Table("name")
    table.add_row("a\x1b[2Jb")
    terminal = console(file=out, force_terminal=True, width=60, color_system="standard")
    terminal.print("[bold]x[/bold] \x1b[31my", table)
    assert "\x1b[1mx\x1b[0m" in out.getvalue() and "\x1b[31m" not in out.getvalue() and "\x1b[2J" not in out.getvalue()
    assert r"\x1b[2Jb" in out.getvalue()


def test_a_spreadsheet_computes_nothing_and_names_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    """Names of points and images of a calibration, and of images of a table of positions."""
    from dataclasses import replace

    network = simulate(rng, images=4, points=len(EVIL)).network
    images = tuple(EVIL[: len(network.images)])
    calibration = calibrate(replace(network, points=tuple(EVIL), images=images))
    for name, text, column, wanted in (
        ("points.csv", points_csv(calibration), "point", EVIL),
        ("residuals.csv", residuals_csv(calibration), "point", [EVIL[k] for k in network.point]),
        ("residuals.csv", residuals_csv(calibration), "image", [images[k] for k in network.image]),
    ):
        check_csv(text)
        (tmp_path / name).write_text(text)
        assert read_table(tmp_path / name).texts(column) == wanted
    plain = calibrate(network)
    assert points_csv(plain).splitlines()[3] == points_csv(plain).splitlines()[3].replace("'", "")  # numbers below zero are numbers


def check_csv(text: str) -> None:
    """No cell of any line, comments too, is a formula or holds control characters; numbers may be negative."""
    assert not ORDERS.search(text)
    for row in csv.reader(io.StringIO(text)):
        for value in row:
            if value.strip()[:1] in ("=", "+", "-", "@"):
                float(value)


@pytest.mark.parametrize("name", ["=1+2", "a,=1+2", "\x1b[2J", "\tx", "two\nlines", "-x"])
def test_a_table_of_positions_keeps_the_names_of_images(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.png"
    frame = np.full((40, 40), 20, np.uint8)
    frame[15:22, 15:22] = 200
    write_frame(path, frame, 8)
    done = CliRunner().invoke(main, ["locate", str(path)])
    assert done.exit_code == 0 and not ORDERS.search(done.output)
    check_csv(done.stdout)
    (tmp_path / "t.csv").write_text(done.stdout)
    assert set(read_table(tmp_path / "t.csv").texts("image")) == {path.name}


def test_a_table_in_python_too() -> None:
    columns = {"image": np.array(["=x"]), "x_px": np.array([-1.5]), "y_px": np.array([2.0]), "flags": np.array([0])}
    text = Located(columns, "disc", ({"name": "a,=x", "reason": "b; @x, -1.5, -1 +x"},)).to_csv()
    check_csv(text)
    assert "'=x,-1.5,2" in text and "a,'=x" in text and "; '@x, -1.5, '-1 +x" in text
