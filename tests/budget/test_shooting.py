"""Shoot lists: a set-up for every kind of frames, a manifest to fill in, and charts in which experiments find what they need."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image, ImageDraw

from pixmetry.budget.answer import how_to_measure
from pixmetry.budget.printed_charts import CHARTS, WEDGE_DENSITIES
from pixmetry.budget.set_ups import FLAT, SET_UPS, kind_of, set_up_of
from pixmetry.budget.shooting import Shot, manifest_text, scaled_set_up
from pixmetry.camera.catalogue import sources
from pixmetry.cli import main
from pixmetry.core.config import load_yaml, validate
from pixmetry.files.records import TARGETS
from pixmetry.files.schema import ManifestModel
from pixmetry.observe.edges import Picture, search_edges
from pixmetry.observe.patches import search_patches

PX_PER_MM = 3.0
SVG = "{http://www.w3.org/2000/svg}"


def drawn(name: str, fine: int = 4) -> np.ndarray:
    """The chart as a picture, by Pillow, from rectangles and their rotation alone."""
    root = ElementTree.fromstring(CHARTS[name]())
    scale = PX_PER_MM * fine
    size = [round(float(v) * scale) for v in root.attrib["viewBox"].split()[2:]]
    image = Image.new("L", size, 255)
    pen = ImageDraw.Draw(image)
    for rect in root.iter(f"{SVG}rect"):
        x, y, w, h = (float(rect.attrib.get(k, 0)) for k in ("x", "y", "width", "height"))
        turn = re.search(r"rotate\((\S+) (\S+) (\S+)\)", rect.attrib.get("transform", ""))
        angle, cx, cy = (float(v) for v in turn.groups()) if turn else (0.0, x, y)
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        corners = [(x, y), (x + w, y), (x + w, y + h), (x, y + h)]
        pen.polygon(
            [(scale * (cx + c * (a - cx) - s * (b - cy)), scale * (cy + s * (a - cx) + c * (b - cy))) for a, b in corners],
            _grey(rect.attrib["fill"]),
        )
    return np.asarray(image.reduce(fine), float)


def _grey(fill: str) -> int:
    digits = fill.removeprefix("#")
    return int(digits[0] * 2 if len(digits) == 3 else digits[:2], 16)


def test_every_kind_of_frames_has_its_set_up() -> None:
    assert set(SET_UPS) <= {FLAT, *TARGETS}
    for name in (FLAT, *TARGETS):
        s = set_up_of(name)
        assert s.kind == name and s.entries and (not s.chart or s.chart in CHARTS)


def test_every_source_that_is_measured_names_a_kind_that_has_a_set_up() -> None:
    kinds = {source_id: kind_of(source_id) for source_id, source in sources().items() if source.measure is not None}
    assert set(kinds.values()) <= {"", FLAT, *TARGETS}
    assert kinds["optics.olpf"] == "edge" and kinds["sensor.prnu"] == FLAT and kinds["storage.jpeg"] == "pattern"
    assert "frames of kind edge" in how_to_measure("optics.olpf")


def test_half_the_uncertainty_takes_four_times_the_frames() -> None:
    usual, better = SET_UPS["line"], scaled_set_up(SET_UPS["line"], 0.5)
    assert [e["frames"] for e in better.entries] == [4 * e["frames"] for e in usual.entries]
    assert min(e["frames"] for e in scaled_set_up(usual, 10).entries) == 2


def test_the_manifest_is_lawful_when_it_is_filled_in(tmp_path: Path) -> None:
    shots = [Shot(s, 1, (), 1.0, 1.0) for s in SET_UPS.values()]
    text = manifest_text('a "camera"', {"bits": 12, "interface": "analogue"}, shots)
    filled = re.sub(r'"<[^>]*>"', "0.01", text)
    (tmp_path / "campaign.yaml").write_text(filled)
    model = validate(ManifestModel, load_yaml(tmp_path / "campaign.yaml"), "here")
    assert {g.kind for g in model.frames} == set(SET_UPS) - {FLAT} | {"dark", "bright"}
    assert len({g.files for g in model.frames}) == len(model.frames)


def test_edges_of_the_printed_chart_are_found_in_both_directions_and_polarities() -> None:
    picture = np.clip(drawn("edges") * 12 + 200, 0, 4095)
    noisy = (picture + 8 * np.sin(np.arange(picture.size) * 12.9898).reshape(picture.shape)).astype(np.float32)
    found = search_edges([Picture("edge", noisy, 1, 4095.0)])
    kinds = {(region.across, spread.height > 0) for region, spread in found.measured}
    assert len(found.measured) >= 40 and kinds == {("x", True), ("x", False), ("y", True), ("y", False)}


def test_patches_of_the_printed_wedge_are_found() -> None:
    boxes, why = search_patches(drawn("wedge") * 12, len(WEDGE_DENSITIES))
    assert not why and len(boxes) == len(WEDGE_DENSITIES)


@pytest.mark.parametrize("name", list(CHARTS))
def test_charts_are_svg_of_one_sheet(name: str) -> None:
    root = ElementTree.fromstring(CHARTS[name]())
    assert root.tag == f"{SVG}svg" and root.attrib["width"] == "297mm" and len(root) > 5


def test_the_command_lists_and_writes(tmp_path: Path) -> None:
    told = CliRunner().invoke(main, ["shoot-list", "imx264_like", "-o", str(tmp_path / "shoot"), "--json", str(tmp_path / "list.json")])
    assert told.exit_code == 0, told.output
    shots = json.loads((tmp_path / "list.json").read_text())["shots"]
    assert shots and all(s["then_px"] <= s["now_px"] for s in shots)
    assert [s["then_px"] for s in shots] == sorted(s["then_px"] for s in shots)
    written = {p.name for p in (tmp_path / "shoot").iterdir()}
    assert {"campaign.yaml", *(f"{s['set_up']['chart']}.svg" for s in shots if s["set_up"]["chart"])} <= written
