"""``pixmetry emva1288`` as a user types it: what it finds of cameras that are known, and one clear error for each kind of bad input."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy import stats

from chance import rng_of
from pixmetry import emva1288
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.emva.files.sheets import content_of, read_sheet, write_files
from pixmetry.emva.job import measure_campaign
from pixmetry.emva.planning.planning import Plan, camera_from_sheet, predicted_u
from pixmetry.emva.planning.preflight import camera_from_preflight, preflight_campaign, preflight_text
from pixmetry.files import load_campaign
from pixmetry.files.output import Output, check_files

SHAPE, GAIN, FULL_E, OFFSET = (48, 64), 0.25, 14000.0, 60.0
QE = {"R": 0.3, "Gr": 0.5, "Gb": 0.48, "B": 0.2}
LEVELS, STACK, LONGEST_S, PHOTONS_PER_S = 12, 12, 1.0, 30000.0
DOUBLING_K, RATE_20_E_PER_S = 7.0, 1500.0


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["emva1288", *(str(a) for a in arguments)])


def refused(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    lines = [line for line in result.output.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.output
    for word in words:
        assert word in lines[0], result.output


def camera(
    rng: np.random.Generator, folder: Path, *, gain: float = GAIN, temperature_c: float | None = None, mosaic: bool = False, facts: str = ""
) -> Path:
    """Frames of a linear camera with shot noise, dark noise of 8 e-, 1 % PRNU and a dark current that doubles every 7 K; its manifest."""
    efficiency = np.full(SHAPE, 0.5)
    if mosaic:  # RGGB
        for k, channel in enumerate(("R", "Gr", "Gb", "B")):
            efficiency[k // 2 :: 2, k % 2 :: 2] = QE[channel]
    response = efficiency * rng.normal(1, 0.01, SHAPE)
    dark = 0.0 if temperature_c is None else RATE_20_E_PER_S * 2 ** ((temperature_c - 20) / DOUBLING_K)
    folder.mkdir()
    lines = ["schema: pixmetry/campaign/1", "camera:", "  name: known", "  bits: 12", "  pitch_um: 5.0", facts]
    lines += [] if temperature_c is None else [f"  temperature_c: {temperature_c}"]
    lines.append("frames:")
    for kind in ("dark", "bright"):
        for i in (*range(1, LEVELS + 1), 0):  # the last is the stack
            exposure_s = LONGEST_S * (i or LEVELS // 2) / LEVELS
            photons = PHOTONS_PER_S * exposure_s if kind == "bright" else 0.0
            names = []
            for k in range(2 if i else STACK):
                electrons = np.minimum(rng.poisson(photons * response + dark * exposure_s), FULL_E) + rng.normal(0, 8, SHAPE)
                names.append(f"{kind}{i}_{k}.npy")
                np.save(folder / names[-1], np.clip(np.rint(OFFSET + gain * electrons), 0, 4095).astype(np.uint16))
            light = f", photons: {photons}" if kind == "bright" else ""
            lines.append(f"- {{kind: {kind}, exposure_s: {exposure_s}{light}, files: [{', '.join(names)}]}}")
    (folder / "campaign.yaml").write_text("\n".join(line for line in lines if line) + "\n")
    return folder / "campaign.yaml"


@pytest.fixture(scope="module")
def known(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return camera(rng_of(request), tmp_path_factory.mktemp("known") / "mono")


def test_prints_values_with_uncertainties_and_writes_all_files(known: Path, tmp_path: Path) -> None:
    files = {kind: tmp_path / f"sheet.{kind}" for kind in ("json", "xml", "html", "pdf")}
    done = run(known, "--json", files["json"], "--xml", files["xml"], "--html", files["html"], "--pdf", files["pdf"], "--photons-u", 3)
    assert done.exit_code == 0, done.output
    assert any(f"Release 4.0 {verdict}" in done.output for verdict in ("Linear applies", "General applies", "Linear, and General")) or (
        "they do not decide whether Linear or General applies" in done.output
    )
    index = next(line for line in done.output.splitlines() if line.startswith("index_sensitivity_max"))
    assert re.fullmatch(r"\S+ +\d+( \[\d+\])? *", index)  # a place in the series, without u
    for word in ("Sensitivity and temporal noise", "Linearity", "Dark current", "Spatial non-uniformity", "General", "± u", "DN/e⁻"):
        assert word in done.output
    sheet, again = read_sheet(files["json"]), read_sheet(files["xml"])
    found, written = sheet.results[0].values, again.results[0].values
    # K from 8 levels of 3072 pixels: about 0.7 %; ten times that
    assert found["K"].value == pytest.approx(GAIN, rel=0.07) and written["K"] == found["K"]
    assert found["QE"].value == pytest.approx(50.0, rel=0.07) and found["QE"].u > 0.03 * found["QE"].value
    assert found["u_p_min_area"].value == pytest.approx(found["u_p_min"].value / 25.0)
    assert sheet.conditions["release"] == "4.0" and sheet.conditions["dark_stack_frames"] == STACK
    assert len(sheet.provenance["inputs"]) == 4 * LEVELS + 2 * STACK + 1
    assert files["pdf"].read_bytes().startswith(b"%PDF") and "<html" in files["html"].read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in files.values())
    again = run(known, "--json", files["json"], "--release", "3.1")  # its own file may be written again
    assert again.exit_code == 0 and read_sheet(files["json"]).results[0].release == "3.1"


def test_the_page_by_its_former_name(known: Path, tmp_path: Path) -> None:
    """``--report`` is still taken for ``--html``, but not shown, and not both at once."""
    page = tmp_path / "page.html"
    assert run(known, "--report", page).exit_code == 0 and "<html" in page.read_text()
    assert "--report" not in run("--help").output and "--html" in run("--help").output
    refused(run(known, "--report", page, "--html", tmp_path / "other.html"), "is another name of --html")


def test_the_packaged_example_needs_no_argument() -> None:
    done = run()
    assert done.exit_code == 0 and "EMVA 1288" in done.output and "<" in done.output and "Note: " in done.output, done.output


def test_a_mosaic_camera_is_tested_phase_by_phase(tmp_path: Path, rng: np.random.Generator) -> None:
    """Quantum efficiencies of the four phases; each from 768 pixels: u about 1.5 %, ten times that is caught."""
    path = camera(rng, tmp_path / "mosaic", mosaic=True, facts="  cfa: RGGB")
    done = run(path, "--json", tmp_path / "a.json")
    assert done.exit_code == 0 and "Channel Gb" in done.output, done.output
    found = {r.channel: r.values["QE"].value / 100 for r in read_sheet(tmp_path / "a.json").results}
    assert found == pytest.approx(QE, rel=0.15)
    turned = {m.channel: m for m in measure_campaign(load_campaign(path), bayer="BGGR")[0]}
    assert turned["B"].transfer.bright.mean_dn[3] > turned["R"].transfer.bright.mean_dn[3]  # R and B have changed places
    assert "not RGGB as stated" in turned["B"].notes[0]


def test_a_bootstrap_gives_uncertainties_of_its_own(known: Path) -> None:
    plain, drawn = (emva1288(known, bootstrap=n).results[0].values for n in (0, 400))
    assert drawn["K"].value == plain["K"].value and "bootstrap" in drawn["K"].method and "bootstrap" not in plain["K"].method
    for key, n in (("K", LEVELS - 1), ("PRNU1288", STACK - 1)):  # χ² of so few, 1e-6; what is drawn from n + 1 is a tenth too small
        low, high = np.sqrt(stats.chi2.ppf([5e-7, 1 - 5e-7], n) / n)
        assert 0.7 * low < drawn[key].u / plain[key].u < 1.3 * high, key
    # degrees of freedom of what was resampled, not those of the u that was replaced
    dof = {key: drawn[key].dof for key in ("K", "u_I_mean", "PRNU1288")}
    assert dof == {"K": LEVELS - 1, "u_I_mean": LEVELS - 1, "PRNU1288": STACK - 1}
    assert "dof: frames of a stack less one" in drawn["DSNU1288"].method and "Monte Carlo" not in drawn["K"].method


def test_dark_current_against_temperature(tmp_path: Path, rng: np.random.Generator) -> None:
    """The doubling step of 7 K within 6 u and 3 %."""
    paths = [camera(rng, tmp_path / f"t{t}", temperature_c=t) for t in (35, 20, 28)]
    done = run(*paths, "--json", tmp_path / "a.json", "--xml", tmp_path / "a.xml")
    assert done.exit_code == 0, done.output
    assert "\nT_d " in done.output and "\nu_I_ref " in done.output and "at 35 °C" in done.output
    sheet, again = read_sheet(tmp_path / "a.json"), read_sheet(tmp_path / "a.xml")
    found = sheet.results[0].values
    step, current = found["T_d"], found["u_I_ref"]
    assert abs(step.value - DOUBLING_K) < 6 * step.u and step.u < 0.03 * DOUBLING_K and step.dof > 0 and step.unit == "K"
    assert abs(current.value - RATE_20_E_PER_S * 2 ** (15 / DOUBLING_K)) < 6 * current.u and "T_ref = 35 °C" in current.method
    assert again.results[0].values["T_d"] == step and again.results[0].values["u_I_ref"] == current
    assert sheet.camera["temperature_c"] == 35 and sheet.results[0].curves["dark_temperature"]["temperature_c"].tolist() == [35, 20, 28]
    names = [record["name"] for record in sheet.provenance["inputs"]]
    assert len(names) == len(set(names)) == 3 * (4 * LEVELS + 2 * STACK + 1) and {n.split("/")[0] for n in names} == {"t35", "t20", "t28"}
    lit = changed(paths[1], tmp_path / "lit", f"exposure_s: {LONGEST_S * (LEVELS // 2) / LEVELS},", "kind: bright")
    refused(run(paths[0], paths[2], lit), "no dark current was measured", str(lit))


def test_temperatures_are_checked_before_the_work(known: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("frames were read")

    def at(name: str, temperature_c: float | None) -> Path:
        path = changed(known, tmp_path / name)
        facts = "" if temperature_c is None else f"  temperature_c: {temperature_c}\n"
        path.write_text(path.read_text().replace("frames:\n", facts + "frames:\n"))
        return path

    monkeypatch.setattr("pixmetry.emva.job.measure_campaign", never)
    paths = [at(f"t{t}", t) for t in (20, 24, 28)]
    refused(run(*paths[:2]), "too few temperatures")
    refused(run(*paths), "too close to each other")
    refused(run(paths[0], at("unknown", None), paths[1]), "the temperature is not known", "unknown")
    other = at("other", 40)
    other.write_text(other.read_text().replace("bits: 12", "bits: 11"))
    refused(run(*paths, other), "another camera", "bits", "other")
    mosaic = at("mosaic", 40)
    mosaic.write_text(mosaic.read_text().replace("bits: 12", "bits: 12\n  cfa: RGGB"))
    refused(run(*paths, mosaic), "another camera", "colour filter", "mosaic")


def test_a_mosaic_camera_is_looked_at_and_planned_for_phase_by_phase(tmp_path: Path, rng: np.random.Generator) -> None:
    """Phases are flat: no pattern of columns from the filter; the green that saturates first is planned for, with its own pixels."""
    path = camera(rng, tmp_path / "mosaic", mosaic=True)
    looks = preflight_campaign(load_campaign(path), "RGGB")
    assert list(looks) == ["R", "Gr", "Gb", "B"]
    for channel, look in looks.items():
        assert look.frames.dark.shape == (SHAPE[0] // 2, SHAPE[1] // 2) and look.verdict != "fail", preflight_text(look)
        planned = camera_from_preflight(look)
        # 1 % PRNU from 768 pixels and 12 frames: 3 %; QE to 10 %; taken together, the colours are columns of 25 % and more
        assert planned.prnu_col_rel < 0.005 and planned.prnu_pixel_rel == pytest.approx(0.01, rel=0.3)
        assert planned.quantum_efficiency == pytest.approx(QE[channel], rel=0.3)
    done = run("--preflight", path, "--bayer", "RGGB")
    assert done.exit_code == 0 and "Channel Gb" in done.output, done.output
    frames = {kind: [path.parent / f"{kind}0_{k}.npy" for k in range(6)] for kind in ("dark", "bright")}
    given = [part for kind, paths in frames.items() for name in paths for part in (f"--{kind}", name)]
    assert run("--preflight", *given, "--bits", 12, "--bayer", "RGGB").output.count("Preflight of 6 dark and 6 bright frames") == 4
    assert run(path, "--bayer", "RGGB", "--json", tmp_path / "a.json").exit_code == 0
    for source, more in ((path, ["--bayer", "RGGB"]), (tmp_path / "a.json", [])):
        done = run("--plan", source, "--u-gain", 0.5, *more, "--manifest", source.with_suffix(".plan.yaml"))
        assert done.exit_code == 0 and re.search("saturates first, G[rb]", done.output), done.output  # which green is chance
        assert "cfa: RGGB" in source.with_suffix(".plan.yaml").read_text()
    sheet = read_sheet(tmp_path / "a.json")
    assert (camera_from_sheet(sheet, "B").rows, camera_from_sheet(sheet, "B").cols) == (SHAPE[0] // 2, SHAPE[1] // 2)
    refused(run("--plan", tmp_path / "a.json", "--bayer", "RGGB", "--u-gain", 0.5), "--bayer", "no meaning with a data sheet")


def test_a_preflight_looks_at_the_stacks_that_a_test_takes(tmp_path: Path, rng: np.random.Generator) -> None:
    """Of two pairs of stacks the longer one with more frames saturates."""
    path = camera(rng, tmp_path / "two")
    folder, text = path.parent, path.read_text()
    for kind, level in (("dark", int(OFFSET)), ("bright", 4095)):
        names = [f"{kind}x_{k}.npy" for k in range(STACK + 4)]
        noise = rng.normal(0, 2, (len(names), *SHAPE))
        for name, frame in zip(names, np.clip(np.rint(level + noise), 0, 4095).astype(np.uint16), strict=True):
            np.save(folder / name, frame)
        light = f", photons: {1.1 * PHOTONS_PER_S}" if kind == "bright" else ""
        text += f"- {{kind: {kind}, exposure_s: {1.1 * LONGEST_S}{light}, files: [{', '.join(names)}]}}\n"
    path.write_text(text)
    frames = preflight_campaign(load_campaign(path))["mono"].frames
    ((m,), _) = measure_campaign(load_campaign(path))
    assert m.dark_stack is not None and m.bright_stack is not None
    np.testing.assert_array_equal(frames.dark.mean_map_dn, m.dark_stack.mean_map_dn)
    assert any(np.array_equal(g.mean_map_dn, m.bright_stack.mean_map_dn) for g in frames.bright)
    assert m.bright_stack.fraction_max < 0.01


def test_compare_says_what_differs(known: Path, tmp_path: Path, rng: np.random.Generator) -> None:
    other = camera(rng, tmp_path / "other", gain=1.2 * GAIN)
    for name, path in (("a.json", known), ("b.json", other)):
        assert run(path, "--json", tmp_path / name).exit_code == 0
    same = run("--compare", tmp_path / "a.json", tmp_path / "a.json")
    assert same.exit_code == 0 and "identical" in same.output
    changed = run("--compare", tmp_path / "a.json", tmp_path / "b.json")
    assert changed.exit_code == 1 and "changed" in changed.output
    refused(run("--compare", tmp_path / "a.json", tmp_path / "none.json"), "none.json")
    refused(run("--compare", tmp_path / "a.json", known), "campaign.yaml")


def test_plans_and_looks_ahead(known: Path, tmp_path: Path) -> None:
    assert run(known, "--json", tmp_path / "a.json").exit_code == 0
    manifest = tmp_path / "plan.yaml"
    done = run("--plan", tmp_path / "a.json", "--u-gain", 0.5, "--saturation-s", 0.02, "--manifest", manifest)
    assert done.exit_code == 0 and "frames in all" in done.output and "kind: bright" in manifest.read_text(), done.output
    assert run("--plan", known, "--u-dsnu", 0.5, "--sweep", "light").exit_code == 0
    refused(run("--plan", tmp_path / "a.json", "--u-gain", 0.5, "--saturation-s", 0.02, "--manifest", manifest), "exists already")
    refused(run("--plan", tmp_path / "a.json"), "no uncertainty is wanted")
    missed = run("--plan", tmp_path / "a.json", "--u-gain", 1e-4)
    assert missed.exit_code == 1 and "not reached" in missed.output and "Cannot be reached: u(K)" in missed.output, missed.output
    for more in ([], ["--preflight"]):
        refused(run(tmp_path / "a.json", *more), "a.json", "is a data sheet, not a campaign")
    checks = tmp_path / "checks.json"
    done = run("--preflight", known, "--json", checks)
    assert done.exit_code == 0 and "Preflight of" in done.output, done.output
    seen = json.loads(checks.read_text())["channels"]["mono"]
    assert seen["verdict"] in ("ok", "warn") and f": {seen['verdict']}\n" in done.output
    dark = next(check for check in seen["checks"] if check["name"] == "dark_noise")
    assert dark["value"] == pytest.approx((8 * GAIN) ** 2 + 1 / 12, rel=0.2) and dark["verdict"] == "ok" and dark["unit"] == "DN²"
    assert run("--preflight", known, "--json", checks).exit_code == 0  # its own file may be written again
    refused(run("--preflight", known, "--json", tmp_path / "a.json"), "a.json", "no result of this kind")
    frames = {kind: [known.parent / f"{kind}0_{k}.npy" for k in range(6)] for kind in ("dark", "bright")}
    given = [part for kind, paths in frames.items() for path in paths for part in (f"--{kind}", path)]
    assert "Preflight of 6 dark and 6 bright frames" in run("--preflight", *given, "--bits", 12).output
    refused(run("--preflight", *given), "--bits", "is missing")
    refused(run("--preflight", *given, "--bits", 12, known), "takes no campaign")


def test_a_plan_from_a_sheet_comes_to_its_own_frames(known: Path) -> None:
    """u that is foretold for the frames that a sheet rests on is the u that it found, within a quarter."""
    sheet = emva1288(known)
    own = Plan(LEVELS, 2, STACK, "exposure", LEVELS)
    foretold, found = predicted_u(camera_from_sheet(sheet), own), sheet.results[0].values
    assert {key: foretold[key] / found[key].u for key in ("K", "PRNU1288")} == pytest.approx({"K": 1, "PRNU1288": 1}, rel=0.25)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--bits", "many"], ["--bits", "to do: see `main emva1288 --help`"]),
        (["--relase", "4.0"], ["--relase", "--release"]),
        (["--compare", "a", "b", "--json", "c"], ["--json", "no meaning with --compare"]),
        (["--compare", "a", "b", "c"], ["takes no campaign"]),
        (["--plan", "--preflight"], ["do not go together"]),
        (["--u-gain", "1"], ["--u-gain", "no meaning with a test"]),
        (["--plan", "--xml", "a", "--u-gain", "1"], ["--xml", "no meaning with --plan"]),
        (["--preflight", "--release", "3.1"], ["--release", "no meaning with --preflight"]),
        (["nowhere"], ["nowhere", "no such file or folder"]),
        (["--bootstrap", "7"], ["not a number of draws"]),
    ],
)
def test_options_that_do_not_belong_together(arguments: list[str], words: list[str]) -> None:
    refused(run(*arguments), *words)


def test_output_names_are_checked_before_the_work(known: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("frames were read")

    monkeypatch.setattr("pixmetry.emva.job.measure_campaign", never)
    (tmp_path / "notes.txt").write_text("mine")
    refused(run(known, "--json", tmp_path / "none" / "a.json"), "the folder does not exist")
    refused(run(known, "--json", tmp_path / "a", "--xml", tmp_path / "." / "a"), "one file for two results")
    refused(run(known, "--pdf", tmp_path), "is a folder")
    refused(run(known, "--json", tmp_path / "notes.txt"), "no result of this kind")
    refused(run(known, "--html", known), "no result of this kind")
    refused(run(known, "--xml", known.parent / "dark1_0.npy"), "no result of this kind")
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "notes.txt")
    with pytest.raises(InputError, match="would overwrite an input"):  # whatever it holds, and by whatever name
        check_files([Output(link, re.compile(b"mine"))], [tmp_path / "notes.txt"])
    link.unlink()
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_only_own_files_are_replaced(known: Path, tmp_path: Path) -> None:
    """A result of another program, and notes that mention the names of the format, are not taken for ours; a sheet of ours is."""
    sheet = emva1288(known)
    sheet = replace(sheet, results=tuple(replace(r, curves={}) for r in sheet.results))  # drawing takes most of the time
    schema = '"schema": "pixmetry/emva1288/1"'
    foreign = {
        "json": f"My notes: {{{schema}}}",
        "xml": '<?xml version="1.0"?>\n<results><K><value>0.28</value><note schema="pixmetry/emva1288/1"/></K></results>',
        "report": '<!DOCTYPE html><html><head><title>mine</title></head><body>content="pixmetry 1"</body></html>',
        "pdf": "%PDF-1.4 made with (pixmetry) /Creator (pixmetry)",
    }
    contents = {kind: content_of(sheet, kind) for kind in foreign}
    for kind, text in foreign.items():
        path = tmp_path / kind
        path.write_text(text)
        with pytest.raises(InputError, match="no result of this kind"):
            write_files(sheet, {kind: path})
        assert path.read_text() == text
        for other in foreign:
            path.write_bytes(contents[other])
            if other == kind:
                write_files(sheet, {kind: path})
            else:
                with pytest.raises(InputError, match="no result of this kind"):
                    write_files(sheet, {kind: path})
    head = '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta name="generator" content="pixmetry 1">\n<title>a</title>'
    (tmp_path / "page.html").write_text(head)
    with pytest.raises(InputError, match="no result of this kind"):  # a page of pixmetry, but of something else
        write_files(sheet, {"report": tmp_path / "page.html"})


def test_all_files_or_none(known: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A writer that fails after others have written leaves everything as it was."""
    files = {"json": tmp_path / "a.json", "xml": tmp_path / "a.xml", "pdf": tmp_path / "a.pdf"}
    sheet = emva1288(known, json=files["json"])
    before = files["json"].read_bytes()

    def broken(*_: object) -> None:
        raise InputError("no room", where="disk")

    monkeypatch.setattr("pixmetry.report.pdf_of", broken)
    with pytest.raises(InputError, match="no room"):
        write_files(sheet, files)
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"] and files["json"].read_bytes() == before


def changed(known: Path, folder: Path, *keep: str, **frames: np.ndarray) -> Path:
    """The known campaign with only the groups whose line holds one of some texts, and with some frames (or all that begin so) replaced."""
    folder.mkdir()
    for path in known.parent.glob("*.npy"):
        new = next((array for name, array in frames.items() if path.name.startswith(name)), None)
        if new is None:
            (folder / path.name).symlink_to(path)
        else:
            np.save(folder / path.name, new)
    lines = [line for line in known.read_text().splitlines() if not (keep and line.startswith("- ")) or any(text in line for text in keep)]
    (folder / "campaign.yaml").write_text("\n".join(lines) + "\n")
    return folder / "campaign.yaml"


def exchanged(known: Path, folder: Path) -> Path:
    """The known campaign, the frames of each dark group with those of the bright one."""
    path = changed(known, folder)
    names = path.read_text().replace("kind: dark", "kind: ?").replace("kind: bright", "kind: dark").replace("kind: ?", "kind: bright")
    lines = [line.split(", photons:")[0] + line[line.index(", files") :] if "photons" in line else line for line in names.splitlines()]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_exchanged_frames_fail_the_preflight(known: Path, tmp_path: Path) -> None:
    done = run("--preflight", exchanged(known, tmp_path / "x"))
    assert done.exit_code == 1 and "Check whether bright and dark frames are exchanged" in done.output, done.output


def test_a_series_without_stacks_says_why_values_are_missing(known: Path, tmp_path: Path) -> None:
    path = tmp_path / "levels" / "campaign.yaml"
    changed(known, tmp_path / "levels")
    path.write_text("\n".join(line for line in path.read_text().splitlines() if "dark0_" not in line and "bright0_" not in line) + "\n")
    values = emva1288(path).results[0].values
    assert np.isnan(values["DSNU1288"].value) and values["DSNU1288"].reason and values["K"].u > 0


def test_campaigns_that_cannot_be_tested(known: Path, tmp_path: Path) -> None:
    top = np.full(SHAPE, 4095, np.uint16)
    cases = {
        "another size": (changed(known, tmp_path / "e", bright5_1=top[:-1]), ("64 x 47 pixels", "bright5_1.npy")),
        "8 bits": (changed(known, tmp_path / "f", bright5_1=np.zeros(SHAPE, np.uint8)), ("8-bit file", "bright5_1.npy")),
        "all saturated": (changed(known, tmp_path / "g", bright=top), ("all bright levels are saturated",)),
        "exchanged": (exchanged(known, tmp_path / "x"), ("campaign.yaml", "bright levels are darker than the dark ones")),
        "too high": (changed(known, tmp_path / "h", dark7_0=np.full(SHAPE, 4096, np.uint16)), ("above the range of 12 bits",)),
    }
    missing = changed(known, tmp_path / "i")
    (missing.parent / "bright3_0.npy").unlink()
    for path, words in (*cases.values(), (missing, ("bright3_0.npy", "missing"))):
        refused(run(path, "--json", tmp_path / "out.json", "--pdf", tmp_path / "out.pdf"), *words)
        assert not list(tmp_path.glob("*out*"))


@pytest.mark.parametrize(
    ("kept", "reason", "given"),
    [
        (f"exposure_s: {LONGEST_S / LEVELS},", "too few bright levels", {"sigma_y_dark"}),
        ("kind: bright", "no dark level", {"s_2_y"}),
        ("kind: dark", "too few bright levels", {"sigma_y_dark", "u_I_mean_DN", "DSNU1288_DN"}),
        (f"_{STACK - 1}.npy", "too few bright levels", {"sigma_y_dark", "DSNU1288_DN", "PRNU1288"}),
    ],
)
def test_what_a_campaign_with_gaps_carries_is_given(known: Path, tmp_path: Path, kept: str, reason: str, given: set[str]) -> None:
    """One level, frames of one kind, stacks alone: values that need no series, and for the others why there are none."""
    path = changed(known, tmp_path / "a", kept)
    done = run(path, *(f"--{kind}={tmp_path / f'out.{kind}'}" for kind in ("json", "xml", "html", "pdf")))
    assert done.exit_code == 0, done.output
    values = read_sheet(tmp_path / "out.json").results[0].values
    assert given <= {key for key, value in values.items() if np.isfinite(value.value)}
    assert np.isnan(values["K"].value) and reason in values["K"].reason


def test_the_result_does_not_depend_on_the_number_of_threads(known: Path, tmp_path: Path) -> None:
    for threads in (1, 2, 5):
        assert run(known, "--json", tmp_path / f"{threads}.json", "--threads", threads).exit_code == 0
    records = [json.loads((tmp_path / f"{threads}.json").read_text()) for threads in (1, 2, 5)]
    for record in records:
        assert record.pop("provenance") and record.pop("checksums")  # tell when and with how many threads
    assert records[0] == records[1] == records[2]
