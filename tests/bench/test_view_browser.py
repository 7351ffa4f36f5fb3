"""Results in a real browser: tables, maps, residuals over their image, from a row of the budget to its evidence."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from pixmetry.cli import main
from pixmetry.files.images import write_frame
from pixmetry.files.results import write_json, write_maps

pytestmark = pytest.mark.browser

ROWS = [{"name": n, "source_id": n, "total_px": px} for n, px in (("sensor.prnu", 0.002), ("sensor.dsnu", 0.02), ("optics.shading", 0.1))]
RECORD = {
    "schema": "pixmetry/results/1",
    "camera": {"name": "seven", "bits": 12},
    "estimates": {f"sensor.{s}": [{"name": "pixel_std", "value": v, "u": 0.1 * v}] for s, v in (("prnu", 0.01), ("dsnu", 3.0))},
    "budget": {"rows": ROWS},
}
INK = """() => {
  const sheet = document.getElementById('sheet'), pen = new OffscreenCanvas(sheet.width, sheet.height).getContext('2d');
  pen.drawImage(sheet, 0, 0);
  const { data } = pen.getImageData(0, 0, sheet.width, sheet.height);
  let amber = 0, blue = 0, light = 0;
  for (let k = 0; k < data.length; k += 4) {
    const [r, g, b] = data.subarray(k, k + 3);
    amber += r > 230 && g > 150 && b < 90; blue += b > 230 && g > 150 && r < 90; light += r > 200 && r === g && g === b;
  }
  return { amber, blue, light };
}"""


@contextmanager
def viewed(browser: Any, *words: Any, width: int = 1280) -> Iterator[Any]:
    """The page of a result; it complains of nothing and asks for nothing from elsewhere."""
    pytest.importorskip("starlette")
    pytest.importorskip("uvicorn")
    command = [sys.executable, "-m", "pixmetry", "view", "--no-open", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        link = process.stdout.readline().strip()
        page = browser.new_page(viewport={"width": width, "height": 900})
        complaints: list[str] = []
        page.on("console", lambda m: complaints.append(m.text))
        page.on("pageerror", lambda e: complaints.append(str(e)))
        page.on("request", lambda r: None if r.url.startswith((link, "data:")) else complaints.append(r.url))
        page.goto(link)
        page.wait_for_selector("body[data-ready]")
        try:
            yield page
            assert complaints == []
            inside, whole = page.evaluate("() => [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
            assert inside <= whole
        finally:
            page.close()
            process.terminate()


def column(page: Any, number: int, table: int = 0) -> list[str]:
    return page.eval_on_selector_all(
        f"#tables details:nth-of-type({table + 1}) tbody tr td:nth-child({number})", "all => all.map((e) => e.textContent)"
    )


def test_a_table_sorts_and_filters_and_a_row_of_the_budget_leads_to_its_evidence(browser: Any, tmp_path: Path) -> None:
    write_json(tmp_path / "results.json", RECORD)
    write_maps(tmp_path / "maps.zarr.zip", {"dark_dn": np.eye(9), "prnu_rel": np.arange(81.0).reshape(9, 9)}, {})
    with viewed(browser, tmp_path) as page:
        assert page.inner_text("#tables summary").startswith("budget.rows")
        page.wait_for_selector("#tables tbody tr")
        page.click("#tables th button:text-is('total_px')")
        assert column(page, 3) == ["0.002", "0.02", "0.1"]
        page.click("#tables th button >> text=total_px")
        assert column(page, 3) == ["0.1", "0.02", "0.002"]
        assert page.get_attribute("#tables th:nth-child(3)", "aria-sort") == "descending"
        page.fill("#tables details:nth-of-type(1) input[type=search]", "sensor")
        assert column(page, 1) == ["sensor.dsnu", "sensor.prnu"]
        page.click("#tables td button:text-is('sensor.prnu') >> nth=0")
        page.wait_for_selector("#sheet[aria-label^='prnu_rel']")
        shown = page.inner_text("#tables")
        assert "0.01" in shown and "pixel_std" in shown and "sensor.dsnu" not in shown  # the estimate of this source alone
        page.click("#all")
        assert column(page, 1) == ["optics.shading", "sensor.dsnu", "sensor.prnu"]


def test_residuals_lie_over_the_image_that_they_belong_to(browser: Any, tmp_path: Path) -> None:
    lines = ["image,point,x_px,y_px,residual_x_px,residual_y_px"]
    for k, name in enumerate(("a.png", "b.png")):
        pixels = np.zeros((60, 100), np.uint8)
        pixels[28:33, 20 + 50 * k : 25 + 50 * k] = 255
        write_frame(tmp_path / name, pixels, 8)
        lines.append(f"{name},p{k},{22 + 50 * k},30,0.05,0.0")
    (tmp_path / "residuals.csv").write_text("\n".join(lines) + "\n")
    with viewed(browser, tmp_path / "residuals.csv", width=390) as page:
        assert page.eval_on_selector_all("#map option", "all => all.map((e) => e.textContent)") == ["a.png", "b.png"]
        assert page.input_value("#image") == "a.png" and page.get_attribute("#sheet", "aria-label") == "a.png; 1 positions"
        first = page.evaluate(INK)
        assert first["light"] > 0 and first["amber"] > 0 and first["blue"] > 0
        page.fill("#scale", "1")
        assert page.evaluate(INK)["amber"] < first["amber"]
        page.select_option("#image", "b.png")
        page.wait_for_selector("#sheet[aria-label='b.png; 1 positions']")
        page.click("#closer")
        assert page.evaluate("() => document.getElementById('map').value") == "1"
        page.wait_for_selector("#tables tbody tr")
        page.click("#tables tbody tr:nth-child(1) button[aria-label='show on the map']")
        page.wait_for_selector("#sheet[aria-label='a.png; 1 positions']")
        box = page.query_selector("#sheet").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        told = page.inner_text("#under")
        assert told.startswith("x 22.0, y 30.0 px; a.png 255; image a.png, point p0")
        page.focus("#sheet")
        page.keyboard.press("ArrowRight")
        page.mouse.move(box["x"] + box["width"] / 2 + 1, box["y"] + box["height"] / 2)
        assert not page.inner_text("#under").startswith("x 22.0")


def test_the_chain_of_a_target_is_viewed_step_by_step(browser: Any, tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text("schema: pixmetry/scene/1\ndiscs: {x_px: [100.3], y_px: [80.2], diameter_px: 8, peak_photons: 5000}\n")
    words = ["chain", "imx264_like", str(scene), "-o", str(tmp_path / "chain.html"), "--draws", "1", "--json", str(tmp_path / "chain.json")]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    with viewed(browser, tmp_path / "chain.json") as page:
        page.wait_for_selector("#tables tbody tr")
        assert page.inner_text("#tables summary").startswith("steps") and "sensor.prnu" in column(page, 2)
        assert "steps.sensor.prnu.image" in page.inner_text("#map")
