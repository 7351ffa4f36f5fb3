"""The bench in a real browser: every control of every source to both ends and back, every preset, data sheet and note, and no complaint."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.browser

SLOW_MS = 120_000
HOMES = ("imx264_like", "pulnix_tm6cn_epix_512", "cmos_log_fuga15")  # cameras that a source is put into: the first that takes it
ON_THE_LINE = ("grabber.", "cable.", "electronics.video")


@pytest.fixture(scope="module")
def link() -> Iterator[str]:
    pytest.importorskip("starlette")
    pytest.importorskip("uvicorn")
    command = [sys.executable, "-m", "pixmetry", "bench", "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.terminate()


@pytest.fixture(params=[(1440, "light"), (820, "light"), (390, "dark")], ids=["desk", "tablet", "phone"])
def width(request: pytest.FixtureRequest) -> Any:
    return request.param


def opened(browser: Any, link: str, width: int = 1440, scheme: str = "light", state: dict[str, Any] | None = None) -> Any:
    """The page, with what it asked for and what it complained of."""
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page.set_default_timeout(SLOW_MS)
    page.asked, page.complaints = [], []
    page.on("request", lambda r: page.asked.append(r.url))
    page.on("console", lambda m: page.complaints.append(m.text))
    page.on("pageerror", lambda e: page.complaints.append(str(e)))
    page.goto(link if state is None else f"{link}#{packed(state)}")
    page.wait_for_selector("body[data-drawn]")
    return page


def packed(state: dict[str, Any]) -> str:
    import base64

    return base64.urlsafe_b64encode(json.dumps(state).encode()).decode().rstrip("=")


def at_peace(page: Any, link: str) -> None:
    assert page.complaints == []
    assert all(url.startswith((link, "data:", "blob:")) for url in page.asked)


MOVE = """async () => {
  const refused = [], moved = [];
  const settled = () => new Promise((done) => {
    const from = bench.answers();
    const look = () => (bench.answers() > from && !bench.busy() ? done() : setTimeout(look, 5));
    setTimeout(look, 5);
  });
  const note = (name, value) => {
    moved.push(name);
    const text = document.getElementById('said').textContent;
    if (text) refused.push([name, value, text]);
  };
  for (const box of document.querySelectorAll('#source-body .control')) {
    const name = box.dataset.name, input = box.querySelector('input[type=range], input[type=checkbox], select');
    if (!input) continue;
    const kind = input.type === 'range' ? 'input' : 'change';
    const read = () => (input.type === 'checkbox' ? input.checked : input.tagName === 'SELECT' ? input.selectedIndex : input.value);
    const write = (v) => {
      if (input.type === 'checkbox') input.checked = v; else if (input.tagName === 'SELECT') input.selectedIndex = v; else input.value = v;
      input.dispatchEvent(new Event(kind, { bubbles: true }));
    };
    const back = read();
    const ends = input.type === 'checkbox' ? [!back] : input.tagName === 'SELECT' ? [...input.options].map((_, k) => k) : [0, 1000];
    for (const end of [...ends, back]) { const wait = settled(); write(end); await wait; note(name, end); }
    const wait = settled(); bench.forget(name); await wait;
  }
  return { refused, moved };
}"""
ALLOWED = ("to do:", "allowed:", "found", "rise over its whole range", "outside of the frame")


SHOWN = """() => ({
  budget: bench.budget.one_target_one_frame.after_px,
  error: bench.found.error_px,
  big: document.querySelector('#headline .big').textContent,
})"""
AWAY = """async () => {
  const headers = { 'Content-Type': 'application/json' };
  return (await fetch('away', { method: 'POST', headers, body: JSON.stringify(bench.state) })).json();
}"""
MORE_DRAWN = "async (drawn) => { while (bench.answers() <= drawn || bench.busy()) await new Promise((r) => setTimeout(r, 10)); }"


def home_of(source_id: str, told: dict[str, Any], camera_chains: dict[str, list[str]]) -> dict[str, Any]:
    order = HOMES[1:] + HOMES[:1] if source_id.startswith(ON_THE_LINE) else HOMES
    for name in order:
        if source_id in camera_chains[name]:
            return {"camera": name, "side_px": 64, "chosen": source_id}
    typical = {
        f"{source_id}.{c['name']}": c["typical"]
        for c in told["sources"][source_id]["controls"]
        if c["kind"] != "fixed" and c["name"] != "bits"
    }
    return {"camera": order[0], "side_px": 64, "chosen": source_id, "add": [source_id], "set": typical}


def test_every_control_of_every_source_goes_to_both_ends_and_back(browser: Any, link: str) -> None:
    page = opened(browser, link, state={"camera": HOMES[0], "side_px": 64})
    told = page.evaluate("() => bench.catalogue")
    chains = {}
    for name in HOMES:
        page.evaluate("async (camera) => { await bench.open({ camera, side_px: 64 }); }", name)
        chains[name] = page.evaluate("() => bench.camera.chain.map((e) => e.source)")
    moved = set()
    for source_id, source in told["sources"].items():
        if not source["in_frames"] or source_id == "storage.video_codec":
            continue
        page.evaluate("async (state) => { await bench.open(state); }", home_of(source_id, told, chains))
        found = page.evaluate(MOVE)
        moved |= set(found["moved"])
        for name, value, text in found["refused"]:
            assert any(words in text for words in ALLOWED), (source_id, name, value, text)
        assert page.complaints == [], source_id
    wanted = {
        f"{s}.{c['name']}"
        for s, source in told["sources"].items()
        for c in source["controls"]
        if source["in_frames"] and c["kind"] != "fixed" and s != "storage.video_codec"
    }
    assert moved >= wanted
    at_peace(page, link)
    page.close()


def test_every_camera_and_every_note_opens(browser: Any, link: str) -> None:
    page = opened(browser, link)
    for selector in ("#camera", "#note"):
        values = page.eval_on_selector_all(f"{selector} option:not([disabled])", "all => all.map((e) => e.value)")
        assert len(values) >= 16
        for value in values:
            if not value:
                continue
            drawn = page.evaluate("() => bench.answers()")
            page.select_option(selector, value)
            page.evaluate(MORE_DRAWN, drawn)
            assert page.inner_text("#said") == "", value
            if selector == "#note":
                assert page.inner_text("#lesson").startswith(f"Note {value}:")
    at_peace(page, link)
    page.close()


def test_the_error_shown_is_that_of_the_command_line(browser: Any, link: str, tmp_path: Path) -> None:
    from click.testing import CliRunner

    from pixmetry.cli import main

    state = {"camera": "imx264_like", "set": {"sensor.prnu.pixel_std_rel": 0.02}, "scenario": {"target": {"diameter_px": 9.0}}, "seed": 3}
    page = opened(browser, link, state=state)
    page.wait_for_selector("body[data-budget]")
    page.wait_for_selector("body[data-found]")
    shown = page.evaluate(SHOWN)
    for name, text in page.evaluate(AWAY).items():
        (tmp_path / name).write_text(text)
    names = [str(tmp_path / n) for n in ("camera.yaml", "scenario.yaml", "b.json")]
    done = CliRunner().invoke(main, ["budget", names[0], "--scenario", names[1], "--json", names[2]])
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "b.json").read_text())["one_target_one_frame"]["after_px"]
    assert shown["budget"] == told
    assert f"{float(f'{told[0]:.2g}'):g} px" in shown["big"]
    lines = (tmp_path / "commands.sh").read_text().splitlines()
    for line in lines[1:3]:
        words = [str(tmp_path / w) if w.endswith((".yaml", ".csv", ".tif")) or w == "frames" else w for w in line.split()[1:]]
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 0, done.output
    header, row = (tmp_path / "found.csv").read_text().splitlines()[-2:]
    located = dict(zip(header.split(","), row.split(","), strict=False))
    (truth,) = json.loads((tmp_path / "frames" / "truth.json").read_text())["targets"]
    error = [float(located[axis]) - truth[axis] for axis in ("x_px", "y_px")]
    assert np.allclose(shown["error"], error, atol=1e-6)
    at_peace(page, link)
    page.close()


def test_two_cameras_beside_each_other(browser: Any, link: str) -> None:
    page = opened(browser, link, state={"camera": "imx264_like", "side_px": 64})
    page.wait_for_selector("body[data-budget]")
    page.click("#compare")
    page.wait_for_selector("#better >> text=Both are alike.")
    page.select_option("#other-camera", "dcs420_like")
    page.focus("#other-camera")
    page.wait_for_selector("#better >> text=is better here")
    assert page.evaluate("() => document.activeElement.id") == "other-camera"  # it stays while the rows come in
    mine, theirs = page.evaluate("() => [bench.budget, bench.other.budget].map((b) => b.rms_px.after)")
    better = "imx264_like" if mine < theirs else "dcs420_like"
    assert page.inner_text("#better").startswith(f"{better} is better here")
    assert "make the difference" in page.inner_text("#other table")
    page.click("#swap")
    page.wait_for_selector("#other-title >> text=imx264_like")
    assert page.evaluate("() => [bench.state.camera, bench.other.budget.rms_px.after]") == ["dcs420_like", mine]
    page.click("#compare")
    assert page.is_hidden("#other")
    at_peace(page, link)
    page.close()


def test_a_scene_file_is_opened_and_left(browser: Any, link: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text("schema: pixmetry/scene/1\ndiscs: {lattice_px: 30, diameter_px: 9, peak_photons: 5000}\n")
    page = opened(browser, link, state={"camera": "imx264_like", "side_px": 64})
    page.set_input_files("#file", scene)
    page.wait_for_selector("#of-a-file")
    assert page.evaluate("() => bench.state.scenario.target.diameter_px") == 9
    page.click("#of-a-file button")
    page.wait_for_selector("#of-a-file", state="detached")
    at_peace(page, link)
    page.close()


def test_nothing_sticks_out_and_everything_has_a_name(browser: Any, link: str, width: Any) -> None:
    page = opened(browser, link, *width, state={"camera": "imx264_like", "chosen": "sensor.prnu"})
    page.wait_for_selector("body[data-found]")
    inside, whole = page.evaluate("() => [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert inside <= whole
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll('button, input:not([hidden]), select, canvas, svg[role=img], textarea')]
          .filter((e) => e.offsetParent !== null || e.tagName === 'svg')
          .filter((e) => !(e.textContent.trim() && e.tagName === 'BUTTON'))
          .filter((e) => !e.getAttribute('aria-label') && !(e.labels && e.labels.length))
          .map((e) => e.outerHTML.slice(0, 120))"""
    )
    assert unnamed == []
    at_peace(page, link)
    page.close()


def test_the_keyboard_alone_moves_a_source(browser: Any, link: str) -> None:
    page = opened(browser, link, state={"camera": "imx264_like", "chosen": "sensor.prnu"})
    page.wait_for_selector("#source-body input[type=range]")
    page.focus("#chain [data-source='sensor.dsnu']")
    page.keyboard.press("Enter")
    page.wait_for_selector("#chain [data-source='sensor.dsnu'][aria-pressed='true']")
    page.focus("#source-body input[type=range]")
    before = page.evaluate("() => bench.answers()")
    page.keyboard.press("ArrowRight")
    page.evaluate("async (n) => { while (bench.answers() <= n) await new Promise((r) => setTimeout(r, 10)); }", before)
    assert "sensor.dsnu.pixel_std_e" in page.evaluate("() => bench.state.set")
    at_peace(page, link)
    page.close()
