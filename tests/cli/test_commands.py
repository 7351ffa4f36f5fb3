"""The commands as a user types them: what works, and one clear error for each kind of bad input."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from click.testing import CliRunner, Result

from pixmetry.camera.camera import load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.cli import COMMANDS, main
from pixmetry.files import load_campaign, read_frame

CAMERA = """\
schema: pixmetry/camera/1
name: test camera
rows: 64
cols: 96
pitch_x_um: 5.0
pitch_y_um: 5.0
chain:
- source: sensor.quantum_efficiency
  parameters: {quantum_efficiency: 0.5}
- source: sensor.prnu
  parameters: {pixel_std_rel: 0.02}
- source: sensor.shot_noise
- source: sensor.full_well
  parameters: {full_well_e: 15000}
- source: sensor.dsnu
  parameters: {pixel_std_e: 12}
- source: electronics.amplifier_noise
  parameters: {white_e: 8}
- source: electronics.gain
  parameters: {gain_dn_per_e: 0.2}
- source: grabber.adc
  parameters: {bits: 12, offset_dn: 40}
"""
SERIES = """\
schema: pixmetry/scene/1
photon_transfer: {levels: 14, brightest_photons: 36000, longest_exposure_s: 0.02, stack_frames: 24}
"""
DISCS = """\
schema: pixmetry/scene/1
uniform: {level_photons: 300}
discs: {lattice_px: 24, peak_photons: 14000}
"""


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def refused(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    lines = [line for line in result.output.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.output
    for word in words:
        assert word in lines[0], result.output


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera, its scenes, a simulated campaign and its assessment."""
    folder = tmp_path_factory.mktemp("commands")
    for name, text in (("camera.yaml", CAMERA), ("series.yaml", SERIES), ("discs.yaml", DISCS)):
        (folder / name).write_text(text)
    done = run("simulate", folder / "camera.yaml", folder / "series.yaml", "-o", folder / "campaign", "--format", "png")
    assert done.exit_code == 0, done.output
    done = run("assess", folder / "campaign", "-o", folder / "result", "--trials", 400, "--pdf", folder / "page.pdf")
    assert done.exit_code == 0 and f"pdf: {folder / 'page.pdf'}" in done.output, done.output
    return folder


def test_an_assessment_writes_everything_and_recovers_the_camera(folder: Path) -> None:
    names = {p.name for p in (folder / "result").iterdir()}
    assert {"report.html", "results.json", "maps.zarr.zip", "camera.yaml", "camera.maps.npz"} <= names
    record = json.loads((folder / "result" / "results.json").read_text())
    assert len(record["twin"]["values"]) > 10
    assert "The digital twin was put through the same campaign" in (folder / "result" / "report.html").read_text()
    found = {e["name"]: e for e in record["photon_transfer"]["estimates"]}
    for name, truth in (("gain_dn_per_e", 0.2), ("dark_noise_e", 8.0), ("offset_dn", 40.0)):
        # 6 u, and for the black level this unit's own mean pattern of 12 e- / sqrt(64 * 96) on top: fails once in 1e8
        pattern = 12 * 0.2 / 6144**0.5 if name == "offset_dn" else 0.0
        assert abs(found[name]["value"] - truth) < 6 * np.hypot(found[name]["u"], pattern), name
    assert record["budget"]["rows"]
    assert record["emva1288"]["release"] == "3.1"
    standard = record["emva1288"]["results"]
    assert abs(standard["K"]["value"] - 0.2) < 6 * standard["K"]["u"]  # a straight camera; fails once in 1e8
    assert standard["DSNU1288"]["value"] > 0 and standard["PRNU1288"]["unit"] == "%"


def test_the_twin_makes_frames_like_the_real_ones(folder: Path) -> None:
    twin = load_camera(folder / "result" / "camera.yaml")
    assert twin["electronics.gain"].params.gain_dn_per_e == pytest.approx(0.2, rel=0.03)
    done = run("simulate", folder / "result" / "camera.yaml", folder / "series.yaml", "-o", folder / "again", "--seed", 9)
    assert done.exit_code == 0, done.output
    for kind in ("dark", "bright"):
        first, second = (load_campaign(folder / name).stacks(kind)[0] for name in ("campaign", "again"))
        one, two = (np.stack([read_frame(p) for p in g.paths]).astype(float) for g in (first, second))
        assert two.mean() == pytest.approx(one.mean(), rel=0.005)
        assert two.var(axis=0).mean() == pytest.approx(one.var(axis=0).mean(), rel=0.04)
        assert two.mean(axis=0).std() == pytest.approx(one.mean(axis=0).std(), rel=0.05)
        assert np.corrcoef(one.mean(axis=0).ravel(), two.mean(axis=0).ravel())[0, 1] > 0.8  # this unit, not another of its type


def test_a_corrected_frame_is_flatter(folder: Path) -> None:
    result = folder / "result" / "results.json"
    flat = load_campaign(folder / "campaign").stacks("bright")[0].paths[:12]
    done = run("correct", *flat, "--with", result, "-o", folder / "flat")
    assert done.exit_code == 0, done.output
    before = np.mean([read_frame(p) for p in flat], axis=0)
    after = np.mean([tifffile.imread(p) for p in (folder / "flat").glob("*.tif")], axis=0)
    assert after.dtype == np.float32
    assert after.std() < 0.5 * before.std()
    assert after.mean() == pytest.approx(before.mean() - 40.0, rel=0.02)
    said = json.loads((folder / "flat" / "correction.json").read_text())["sources"]
    assert said["sensor.prnu"] == "corrected"
    assert "not corrected" in said["sensor.shot_noise"]


def test_frames_of_a_store_are_corrected_like_files(folder: Path) -> None:
    done = run("simulate", folder / "camera.yaml", folder / "discs.yaml", "-n", 2, "-o", folder / "in_store", "--format", "zarr")
    assert done.exit_code == 0, done.output
    done = run("simulate", folder / "camera.yaml", folder / "discs.yaml", "-n", 2, "-o", folder / "in_files")
    assert done.exit_code == 0, done.output
    for name, frames in (("from_store", "in_store/frames.zarr"), ("from_files", "in_files"), ("one", "in_store/frames.zarr/1")):
        done = run("correct", folder / frames, "--with", folder / "result" / "results.json", "-o", folder / name)
        assert done.exit_code == 0, done.output
    for i in range(2):
        one, two = (tifffile.imread(folder / name) for name in (f"from_store/{i}.tif", f"from_files/frame_{i:05d}.tif"))
        assert np.array_equal(one, two)
    assert np.array_equal(tifffile.imread(folder / "one" / "1.tif"), one)
    inputs = json.loads((folder / "from_store" / "correction.json").read_text())["provenance"]["inputs"]
    assert [i["name"] for i in inputs] == ["0", "1"]


def test_discs_come_with_their_truth(folder: Path) -> None:
    done = run("simulate", folder / "camera.yaml", folder / "discs.yaml", "-n", 2, "-o", folder / "discs")
    assert done.exit_code == 0, done.output
    truth = json.loads((folder / "discs" / "truth.json").read_text())
    assert len(truth["targets"]) == 2 * 4
    first = truth["targets"][0]  # on the lattice, half a pitch from the corner; no optics move it
    assert (first["x_px"], first["y_px"], first["inside"]) == (11.5, 11.5, True)
    assert [f["file"] for f in truth["frames"]] == [f"frame_{i:05d}.tif" for i in range(2)]
    assert {p.name for p in (folder / "discs").glob("*.tif")} == {"frame_00000.tif", "frame_00001.tif"}


def test_the_catalogue_as_json() -> None:
    records = json.loads(run("sources", "--json", "-").output)["sources"]
    by_id = {r["id"]: r for r in records}
    assert len(by_id) == len(records) >= 19
    noise = by_id["sensor.shot_noise"]
    assert noise["verbs"] == {"forward": True, "measure": False, "correct": False, "propagate": True}
    for record in records:
        assert {"id", "title", "stage", "note", "stars", "verbs", "reasons"} <= set(record)
        assert all(record["reasons"][v] for v, has in record["verbs"].items() if not has)
    for source_id in by_id:
        shown = run("sources", source_id)
        assert shown.exit_code == 0
        assert "equation" in shown.output


def test_parameters_can_be_read_on_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """No name is cut, for it is typed again in --set; and choices are named."""
    monkeypatch.setenv("COLUMNS", "80")
    for source_id, source in sources().items():
        shown = run("sources", source_id).output
        assert [name for name in source.parameters.model_fields if name not in shown] == [], source_id
    assert re.search(r"first_field +1 +even, odd", run("sources", "sensor.interlace").output)
    assert re.search(r"interlaced +1 +true, false", run("sources", "grabber.line_jitter").output)
    assert "…" not in run("sources").output


def write_campaign(folder: Path, frames: dict[str, list[np.ndarray]], bits: int = 12) -> Path:
    """A campaign of 16-bit PNG files; keys are ``kind exposure_s``."""
    lines = ["schema: pixmetry/campaign/1", f"camera: {{name: bad, bits: {bits}}}", "frames:"]
    for group, images in frames.items():
        kind, exposure = group.split()
        names = []
        for i, image in enumerate(images):
            names.append(f"{kind}_{exposure}_{i}.png")
            (folder / names[-1]).write_bytes(imagecodecs.png_encode(image.astype(np.uint16)))
        lines.append(f"- {{kind: {kind}, exposure_s: {exposure}, files: [{', '.join(names)}]}}")
    path = folder / "campaign.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path


def levels(bright) -> dict[str, list[np.ndarray]]:
    """Six levels with two frames each, dark ones with noise, bright ones from ``bright(k)``."""
    noise = np.random.default_rng(4)
    dark = {f"dark {k / 100}": [np.rint(noise.normal(40, 3, (32, 48))) for _ in range(2)] for k in range(1, 7)}
    return dark | {f"bright {k / 100}": [bright(k) for _ in range(2)] for k in range(1, 7)}


@pytest.mark.parametrize(
    ("bright", "words"),
    [
        (lambda k: np.full((32, 48), 4095), ("saturated",)),
        (lambda k: np.zeros((32, 48)), ("black",)),
        (lambda k: np.full((32, 48), 300 * k), ("identical", "noise")),
    ],
    ids=["all saturated", "all black", "no noise"],
)
def test_frames_that_carry_no_photon_transfer_are_refused(tmp_path: Path, bright, words) -> None:
    refused(run("assess", write_campaign(tmp_path, levels(bright)), "-o", tmp_path / "out"), *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("assess", "nowhere.yaml"), ("nowhere.yaml",)),
        (("assess", "--target", "square:side=3"), ("square", "disc")),
        (("assess", "--target", "disc:diameter=-1"), ("diameter",)),
        (("assess", "--target", "disc:diameter=nan"), ("diameter",)),
        (("assess", "--estimator", "guess"), ("guess", "soft_threshold")),
        (("sources", "sensor.prun"), ("sensor.prun", "sensor.prnu")),
        (("simulate", "nocamera.yaml", "scene.yaml", "-o", "x"), ("nocamera.yaml",)),
        (("correct", "a.png", "--with", "nothing.json", "-o", "x"), ("nothing.json",)),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, tuple) else None,
)
def test_bad_arguments_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments, words) -> None:
    monkeypatch.chdir(tmp_path)
    refused(run(*arguments), *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("white_e: 8", "white_e: -8"), ("white_e", "0")),
        (("white_e: 8", "white_dn: 8"), ("white_dn", "white_e")),
        (("white_e: 8", "white_e: .nan"), ("white_e",)),
        (("sensor.dsnu", "sensor.dnsu"), ("sensor.dnsu", "sensor.dsnu")),
        (("rows: 64", "rows: 64\nrows: 65"), ("rows",)),
        (("- source: sensor.shot_noise\n", ""), ()),
    ],
    ids=str,
)
def test_a_bad_camera_is_refused(tmp_path: Path, change, words) -> None:
    assert change[0] in CAMERA
    (tmp_path / "camera.yaml").write_text(CAMERA.replace(*change))
    (tmp_path / "scene.yaml").write_text(DISCS)
    done = run("simulate", tmp_path / "camera.yaml", tmp_path / "scene.yaml", "-o", tmp_path / "out")
    if words:
        refused(done, *words)
        assert not (tmp_path / "out").exists()
    else:  # a camera without shot noise is a camera
        assert done.exit_code == 0, done.output


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "scene.yaml").write_text(DISCS)
    refused(run("simulate", tmp_path / "camera.yaml", tmp_path / "scene.yaml", "-o", tmp_path), "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_frames_of_a_campaign_are_never_replaced_by_its_results(folder: Path, tmp_path: Path) -> None:
    before = sorted(p.name for p in (folder / "campaign").rglob("*"))
    refused(run("assess", folder / "campaign", "-o", folder / "campaign"), "simulation", "another folder")
    refused(run("simulate", folder / "camera.yaml", folder / "discs.yaml", "-o", folder / "result"), "assessment")
    assert sorted(p.name for p in (folder / "campaign").rglob("*")) == before
    assert (folder / "result" / "results.json").is_file()


def test_the_page_is_written_as_pdf_too(folder: Path, tmp_path: Path) -> None:
    """And no PDF of another hand is lost; that of `pixmetry chain`: tests/simulate/test_chain.py."""
    made = (folder / "page.pdf").read_bytes()
    assert made.startswith(b"%PDF-1")
    other = tmp_path / "page.pdf"
    other.write_bytes(b"%PDF-1.4 of somebody else")
    refused(run("assess", folder / "campaign", "-o", tmp_path / "out", "--pdf", other), "no result of this kind")
    assert other.read_bytes() == b"%PDF-1.4 of somebody else" and not (tmp_path / "out").exists()


def test_a_copied_frame_is_found(folder: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(folder / "campaign", tmp_path / "campaign")
    first, second = load_campaign(tmp_path / "campaign").levels("bright")[3].paths[:2]
    shutil.copy(first, second)
    refused(run("assess", tmp_path / "campaign", "-o", tmp_path / "out"), "identical", "bright")
    assert not (tmp_path / "out").exists()


def test_every_command_with_a_page_writes_it_as_pdf() -> None:
    having = {name for name in COMMANDS if any("--pdf" in option.opts for option in main.get_command(None, name).params)}
    assert having == {"assess", "budget", "calibrate", "chain", "compare", "emva1288"}


def test_values_that_do_not_fill_their_bits_are_noted(folder: Path, tmp_path: Path) -> None:
    """And an earlier assessment is replaced by a new one."""
    import shutil

    shutil.copytree(folder / "campaign", tmp_path / "campaign")
    shutil.copytree(folder / "result", tmp_path / "out")
    manifest = tmp_path / "campaign" / "campaign.yaml"
    manifest.write_text(manifest.read_text().replace("bits: 12", "bits: 16"))
    done = run("assess", manifest, "-o", tmp_path / "out", "--trials", 400)
    assert done.exit_code == 0, done.output
    assert "bits: 12" in " ".join(done.output.split())
    before, after = ((path / "results.json").read_text() for path in (folder / "result", tmp_path / "out"))
    assert "bits: 12" in after and "bits: 12" not in before


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_every_terminal_is_written_to(encoding: str) -> None:
    """A report that is complete must not end in a traceback because a terminal has no sign for ±."""
    command = [sys.executable, "-m", "pixmetry", "sources", "sensor.prnu"]
    ran = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": encoding}, check=False)
    assert ran.returncode == 0 and ran.stderr == b""
    text = ran.stdout.decode(encoding)
    assert "Photo response non-uniformity" in text and ("★" in text) == (encoding == "utf-8")


def test_too_little_memory_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise MemoryError("Unable to allocate 9 EiB")

    monkeypatch.setattr("pixmetry.camera.catalogue.sources", full)
    ran = CliRunner().invoke(main, ["sources"])
    assert ran.exit_code == 2 and "not enough memory (Unable to allocate 9 EiB)" in ran.output and ran.output.count("\n") == 1


def test_stacks_and_raw_values_are_located_and_corrected(folder: Path, tmp_path: Path) -> None:
    results = folder / "result" / "results.json"
    frames = np.stack([read_frame(p) for g in load_campaign(folder / "campaign").groups for p in g.paths][-3:])
    tifffile.imwrite(tmp_path / "s.tif", frames, photometric="minisblack")
    (tmp_path / "s.raw").write_bytes(frames.astype("<u2").tobytes())
    size = f"{frames.shape[2]}x{frames.shape[1]}:Mono12"
    for name, more in (("s.tif", []), ("s.raw", ["--raw", size])):
        out = tmp_path / f"out-{name}"
        ran = CliRunner().invoke(main, ["correct", str(tmp_path / name), "--with", str(results), "-o", str(out), *more])
        assert ran.exit_code == 0, ran.output
        assert sorted(p.name for p in out.glob("*.tif")) == ["s_0.tif", "s_1.tif", "s_2.tif"]
        ran = CliRunner().invoke(main, ["locate", str(tmp_path / name), "-o", str(tmp_path / "t.csv"), *more])
        assert ran.exit_code == 1 and f"{name}/2: " in ran.output  # they were read; nothing is on them
    one, other = (tifffile.imread(tmp_path / f"out-{name}" / "s_1.tif") for name in ("s.tif", "s.raw"))
    np.testing.assert_array_equal(one, other)
