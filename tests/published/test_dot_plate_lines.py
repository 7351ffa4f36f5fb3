"""The dot plate of the Discorpy project by plumb lines: its rows and columns are straight in the corrected image.

Runs where the environment variable PIXMETRY_DATA names the folder that holds discorpy-dots.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import Sensor
from pixmetry.calibrate.lines.plumb_line import PlumbLineResult, calibrate_lines
from pixmetry.locate.detect.detection import detect
from published import dot_plate

FOLDER = Path(os.environ.get("PIXMETRY_DATA", "")) / "discorpy-dots"
pytestmark = pytest.mark.skipif(
    not (os.environ.get("PIXMETRY_DATA") and (FOLDER / dot_plate.PICTURE).is_file()),
    reason="PIXMETRY_DATA does not name a folder with discorpy-dots",
)


@cache
def calibrated() -> PlumbLineResult:
    targets = detect(dot_plate.read_picture(FOLDER)).targets
    grid = dot_plate.order(targets)
    use = dot_plate.whole_dots(targets, grid) & np.isfinite(targets.x_px)
    x, y = (np.tile(v[use], 2) for v in (targets.x_px, targets.y_px))
    line, way = np.concatenate([grid.row[use], grid.col[use]]), np.repeat(["row", "column"], use.sum())
    _, index, count = np.unique(np.stack([way, line.astype(str)]), axis=1, return_inverse=True, return_counts=True)
    long = count[index.ravel()] >= 8
    return calibrate_lines(x[long], y[long], line[long], way[long], Sensor(1280, 800), free=("k1", "k2", "k3", "xp", "yp"))


def test_rows_and_columns_become_straight() -> None:
    """Lines bent by up to 6 px are straight to 0.022 px, as near as a fit of the whole plate comes to the dots (0.025 px a coordinate)."""
    found = calibrated()
    for axis in found.axes.values():
        assert axis.rms_px < 0.022
    assert (~found.used).mean() < 0.01
    assert 580 < found.camera["xp"] < 620 and 420 < found.camera["yp"] < 480


def test_published_curve_is_found() -> None:
    """The published one goes from ideal to image in powers of the radius, with a scale of its own: inverted and scaled, 0.15 px of 6 px.

    The published coefficients leave 0.05 px rms on the dots.
    """
    numbers = [float(line.split(":")[1]) for line in (FOLDER / dot_plate.COEFFICIENTS).read_text().splitlines() if ":" in line]
    radius = np.linspace(1.0, 700.0, 300)
    ideal = radius.copy()
    for _ in range(100):
        ideal = radius / np.polyval(numbers[:1:-1], ideal)
    found = calibrated().camera
    own = radius * (1 + found["k1"] * radius**2 + found["k2"] * radius**4 + found["k3"] * radius**6)
    difference = own - ideal * (own @ ideal) / (ideal @ ideal)
    assert np.abs(own - radius).max() > 5.5
    assert np.abs(difference).max() < 0.15
