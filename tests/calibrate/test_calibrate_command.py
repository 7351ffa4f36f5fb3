"""``pixmetry calibrate`` as a user types it: from a project to a folder of results, read back; and one clear error for bad input."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from scipy.stats import chi2

import pixmetry
from calibrate.networks import Simulated, simulate
from calibrate.test_calibration_images import COLS, FOCAL, ROWS, View, chessboard
from chance import rng_of
from pixmetry.calibrate.bundle.bundle import SMALL
from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.calibrated_camera import calibrated_geometry
from pixmetry.calibrate.files.record import calibration_json, packed, read_calibration, unpacked
from pixmetry.calibrate.files.write import TABLES, write_results
from pixmetry.calibrate.project import load_project
from pixmetry.calibrate.project.schema import ProjectModel
from pixmetry.calibrate.records import Calibration, EccentricityRecord, Tests
from pixmetry.cli import main
from pixmetry.core.config import load_yaml, validate
from pixmetry.core.errors import InputError
from report.calibrations import full

DOCS = Path(__file__).resolve().parents[2] / "docs" / "calibrating.md"
SOURCE = Path(pixmetry.__file__).parent
FALSE_FAILURE = 1e-6
FILES = {"report.html", "calibration.json", "points.csv", "poses.csv", "residuals.csv"}


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["calibrate", *(str(a) for a in arguments)])


def refused(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    lines = [line for line in result.output.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.output
    for word in words:
        assert word in lines[0], result.output


def table(path: Path, header: str, *columns: object) -> None:
    rows = zip(*columns, strict=True)
    path.write_text("\n".join([header, *(",".join(v if isinstance(v, str) else f"{v:.12g}" for v in row) for row in rows)]) + "\n")


def project(folder: Path, network: Network, more: str = "", mm: bool = False) -> Path:
    """A network as the project and tables that a user would write."""
    sensor = network.cameras[0].sensor
    assert sensor.pitch_x_um is not None and sensor.pitch_y_um is not None
    names = [network.images[i] for i in network.image], [network.points[p] for p in network.point]
    x, y, header = network.x_px, network.y_px, "image,point,x_px,y_px"
    if mm:  # from the middle of the frame, y up
        header = header.replace("px", "mm")
        x = (x - (sensor.cols - 1) / 2) * sensor.pitch_x_um / 1000
        y = ((sensor.rows - 1) / 2 - y) * sensor.pitch_y_um / 1000
    table(folder / "observations.csv", header, *names, x, y)
    bars = network.bars
    ends = [[network.points[p] for p in end] for end in (bars.start, bars.end)]
    table(folder / "bars.csv", "from,to,length,u", *ends, bars.length, bars.u)
    path = folder / "project.yaml"
    path.write_text(
        "schema: pixmetry/calibration/1\nname: a test\n"
        f"cameras: {{cols: {sensor.cols}, rows: {sensor.rows}, pitch_um: {sensor.pitch_x_um}, c_mm: 8}}\n"
        f"observations: {{table: observations.csv, u_px: {float(np.sqrt(network.covariance_px2[0, 0]))!r}}}\n"
        f"scale_bars_table: bars.csv\n{more}"
    )
    return path


@pytest.fixture(scope="module")
def simulated(request: pytest.FixtureRequest) -> Simulated:
    return simulate(rng_of(request), images=12, points=40, bars=2)


@pytest.fixture(scope="module")
def done(simulated: Simulated, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    folder = tmp_path_factory.mktemp("calibrate")
    path = project(folder, simulated.network)
    return folder, path, run(path, "-o", folder / "result")


def test_a_project_gives_a_folder_of_results(done: tuple[Path, Path, Result]) -> None:
    folder, _, result = done
    assert result.exit_code == 0, result.output
    assert {p.name for p in (folder / "result").iterdir() if not p.name.startswith(".")} == FILES
    assert f"report: {folder / 'result' / 'report.html'}" in result.output
    assert "<!DOCTYPE html>" in (folder / "result" / "report.html").read_text()[:200]


def test_the_camera_covers_its_truth(done: tuple[Path, Path, Result], simulated: Simulated) -> None:
    """Mahalanobis distance of ten parameters against chi²; a wrong sign, unit or order of them would be hundreds of sigma."""
    stored = read_calibration(done[0] / "result")
    names, covariance = stored.interior_covariance()
    at = [NAMES.index(name) for name in names]
    off = (stored.cameras[0].values - simulated.truth.interior[0])[at]
    # sigma0 of about 700 degrees of freedom is known to 3 %, so F and chi² hardly differ
    assert len(names) == 10 and off @ np.linalg.solve(covariance, off) < 1.5 * chi2.isf(FALSE_FAILURE, 10)
    assert 0.7 < stored.sigma0 < 1.35


def test_millimetres_with_y_up_give_the_same_camera(done: tuple[Path, Path, Result], simulated: Simulated, tmp_path: Path) -> None:
    calibration = pixmetry.calibrate(project(tmp_path, simulated.network, mm=True))
    stored = read_calibration(done[0] / "result")
    u = np.sqrt(np.diag(stored.interior_covariance()[1]))
    off = (calibration.adjustment.state.interior[0] - stored.cameras[0].values)[:10]
    assert np.abs(off / u).max() < 1e-3  # the last digits of the table


def test_a_network_in_python_gives_the_same(done: tuple[Path, Path, Result], simulated: Simulated) -> None:
    """From another start, but for what the rule to stop leaves: the last step is at most √SMALL standard deviations, of either."""
    calibration = pixmetry.calibrate(simulated.network)
    stored = read_calibration(done[0] / "result")
    u = np.sqrt(np.diag(stored.interior_covariance()[1]))
    assert np.abs((calibration.adjustment.state.interior[0] - stored.cameras[0].values)[:10] / u).max() < 2 * np.sqrt(SMALL)


def test_where_it_comes_from_is_told(done: tuple[Path, Path, Result]) -> None:
    folder, path, _ = done
    about = read_calibration(folder / "result").provenance
    digests = {record["name"]: record["sha256"] for record in about["inputs"]}
    assert digests == {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in (path, folder / "observations.csv", folder / "bars.csv")}
    assert about["pixmetry"] == pixmetry.__version__ and about["options"]["loss"] == "huber" and about["name"] == "a test"
    assert str(folder) not in (folder / "result" / "calibration.json").read_text()


def test_results_are_input_again(done: tuple[Path, Path, Result], simulated: Simulated, tmp_path: Path) -> None:
    """The tables of points, poses and residuals as points, images and observations of another project: held points, the same camera."""
    folder = done[0]
    text = done[1].read_text().replace("{table: observations.csv", f"{{table: {folder}/result/residuals.csv")
    tables = f"points: {{table: {folder}/result/points.csv, known: weighted}}\nimages: {folder}/result/poses.csv\n"
    text = re.sub(r"scale_bars_table: .*\n", tables, text)
    (tmp_path / "again.yaml").write_text(text)
    assert load_project(tmp_path / "again.yaml").network.poses.given.all()
    again = pixmetry.calibrate(tmp_path / "again.yaml")
    stored = read_calibration(folder / "result")
    u = np.sqrt(np.diag(stored.interior_covariance()[1]))
    assert np.abs((again.adjustment.state.interior[0] - stored.cameras[0].values)[:10] / u).max() < 1


@pytest.mark.usefixtures("undrawn")
def test_fewer_parameters_and_terms_of_images(simulated: Simulated, tmp_path: Path) -> None:
    path = project(tmp_path, simulated.network)
    result = run(path, "-o", tmp_path / "r", "--free", "c,xp,yp,k1,k2", "--per-image", "x_scale", "--folds", 0, "--json", "-")
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    (camera,) = told["cameras"]
    assert camera["covariance"]["names"] == ["c", "xp", "yp", "k1", "k2"] and told["report"].endswith("report.html")
    stored = read_calibration(tmp_path / "r")
    assert any(name.endswith(":x_scale") for name in stored.columns) and stored.tests.hold_out is None
    with (tmp_path / "r" / "poses.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert len(rows) == 12 and all(float(row["u_x_scale"]) > 0 for row in rows)


@pytest.mark.usefixtures("undrawn")
def test_an_earlier_result_is_replaced_and_nothing_else(done: tuple[Path, Path, Result], simulated: Simulated, tmp_path: Path) -> None:
    path = project(tmp_path, simulated.network)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("x")
    refused(run(path, "-o", tmp_path / "photos"), "a.jpg", "choose another folder")
    assert {p.name for p in (tmp_path / "photos").iterdir()} == {"a.jpg"}
    refused(run(path, "-o", done[0] / "result"), "calibration of something else (project.yaml)")  # another project of that name
    moved = shutil.copytree(done[0], tmp_path / "moved")
    again = run(moved / "project.yaml", "-o", moved / "result")
    assert again.exit_code == 0, again.output
    text = path.read_text().replace("{table: observations.csv", "{table: result/residuals.csv")
    (moved / "project.yaml").write_text(text)
    refused(run(moved / "project.yaml", "-o", moved / "result"), "holds a file that is read", "residuals.csv")


@pytest.mark.usefixtures("undrawn")
def test_pictures_of_a_board_alone(tmp_path: Path, rng: np.random.Generator) -> None:
    """Drawn without distortion by a pinhole of known focal length; u is that of the located corners with sigma0."""
    for k, (roll, tilt_x, tilt_y) in enumerate([(3, 0, 8), (85, 25, -10), (4, -28, 8), (178, 12, 30), (2, -10, -32), (-88, 20, 24)]):
        frame = View((3.0, 2.0), 11.5, roll, tilt_x, tilt_y).frame(chessboard(7, 5), rng)
        np.save(tmp_path / f"board_{k}.npy", frame)
    options = ("--kind", "chessboard", "--grid", "7x5", "--pitch-mm", 20, "--free", "c,xp,yp", "--direction", "object_to_image")
    result = run(*sorted(tmp_path.glob("*.npy")), *options, "-o", tmp_path / "r")
    assert result.exit_code == 0, result.output
    stored = read_calibration(tmp_path / "r")
    names, covariance = stored.interior_covariance()
    off = stored.cameras[0].values[:3] - [FOCAL, (COLS - 1) / 2, (ROWS - 1) / 2]
    # 4.9 for chance, 2.1 for a drawing of 16 samples a pixel; u is 0.05 px in c and 0.025 px in xp, yp
    assert names == ("c", "xp", "yp") and np.abs(off / np.sqrt(np.diag(covariance))).max() < 7
    assert np.sqrt(np.diag(covariance)).max() < 0.2
    assert stored.images == tuple(f"board_{k}.npy" for k in range(6)) and len(stored.points) == 35
    assert np.allclose(np.ptp(stored.xyz, axis=0)[:2], [120, 80], rtol=1e-3)


# --- files, from a calibration made by hand ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def by_hand(request: pytest.FixtureRequest) -> Calibration:
    found = full(rng_of(request))
    lower = np.tril(found.adjustment.covariance)  # symmetric to the last bit, as what is stored
    return replace(found, adjustment=replace(found.adjustment, covariance=lower + np.tril(lower, -1).T))


@pytest.mark.usefixtures("undrawn")
def test_inverse_read_after_write(by_hand: Calibration, tmp_path: Path) -> None:
    a = by_hand.adjustment
    write_results(by_hand, tmp_path / "r")
    for path in (tmp_path / "r", tmp_path / "r" / "calibration.json"):
        stored = read_calibration(path)
        assert stored.images == a.network.images and stored.points == a.network.points and stored.columns == a.free_columns
        for found, true in (
            (stored.cameras[0].values, a.state.interior[0]),
            (stored.rotation, a.state.rotation),
            (stored.position, a.state.position),
            (stored.xyz, a.state.xyz),
            (stored.covariance, a.covariance),
            (stored.point_covariance, a.point_covariance),
        ):
            assert np.allclose(found, true, rtol=1e-12, atol=0, equal_nan=True)
        names, covariance = stored.interior_covariance()
        assert names == a.interior_covariance()[0] and np.allclose(covariance, a.interior_covariance()[1], rtol=1e-12)
        assert [f.text for f in stored.findings] == [f.text for f in by_hand.findings]
        assert (stored.sigma0, stored.dof, stored.datum) == (a.sigma0, a.dof, a.datum)


def test_any_symmetric_matrix_comes_back_bit_for_bit(rng: np.random.Generator) -> None:
    half = rng.normal(size=(7, 7)) * 10.0 ** np.arange(-12, 9, 3)
    matrix = half + half.T
    assert np.array_equal(unpacked(json.loads(json.dumps(packed(matrix)))), matrix)


@pytest.mark.usefixtures("undrawn")
def test_an_image_a_point_and_a_camera_of_one_name(by_hand: Calibration, tmp_path: Path) -> None:
    """Photos are numbered, so are points and cameras: the camera's covariance holds its own parameters only."""
    a = by_hand.adjustment
    network = replace(
        a.network,
        cameras=(replace(a.network.cameras[0], name="1"),),
        images=("1", *a.network.images[1:]),
        points=("1", *a.network.points[1:]),
    )
    columns = tuple(re.sub("^camera:", "1:", name) for name in a.free_columns) + ("1:rx", "1:X")
    covariance = np.eye(len(columns))
    covariance[: len(a.covariance), : len(a.covariance)] = a.covariance
    renamed = replace(by_hand, adjustment=replace(a, network=network, free_columns=columns, covariance=covariance))
    write_results(renamed, tmp_path / "r")
    assert read_calibration(tmp_path / "r").interior_covariance()[0] == a.interior_covariance()[0]


def test_numbers_that_are_not_finite_stay_strict_json(by_hand: Calibration) -> None:
    a = by_hand.adjustment
    xyz = a.state.xyz.copy()
    xyz[3] = np.nan
    tests = Tests(eccentricity=EccentricityRecord(0, np.inf, 0.0))
    lost = replace(by_hand, adjustment=replace(a, state=replace(a.state, xyz=xyz)), tests=tests)
    record = json.loads(calibration_json(lost), parse_constant=lambda name: pytest.fail(name))
    assert record["points"]["xyz"][3] == [None] * 3 and record["tests"]["eccentricity"]["largest_px"] == "inf"
    assert TABLES["points.csv"](lost).splitlines()[5].startswith(f"{a.network.points[3]},,,,")


@pytest.mark.parametrize("text", ["", "{}", '{"schema": "pixmetry/results/1"}', '{"schema": "pixmetry/calibration-result/1"}', "[1]"])
def test_another_file_is_no_calibration(tmp_path: Path, text: str) -> None:
    (tmp_path / "calibration.json").write_text(text)
    with pytest.raises(InputError, match="calibration") as caught:
        read_calibration(tmp_path)
    assert "calibration.json" in str(caught.value) and "to do" in str(caught.value)
    with pytest.raises(InputError, match="cannot be read"):
        read_calibration(tmp_path / "none.json")


# --- bad input --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ("PROJECT.yaml|IMAGES", "calibrate --help")),
        (("none.yaml",), ("none.yaml", "cannot be read")),
        (("none.png", "--grid", "9x6", "--pitch-mm", "25"), ("none.png", "missing")),
        (("empty.yaml",), ("empty.yaml", "the project is empty", "schema: pixmetry/calibration/1")),
        (("campaign.yaml",), ("campaign.yaml, line 1", "a file of another kind", "pixmetry/calibration/1")),
        (("good.yaml", "a.png"), ("good.yaml", "one project, or pictures")),
        (("good.yaml", "--grid", "9x6"), ("grid", "has no meaning with a project file")),
        (("good.yaml", "--free", "c,f"), ("free", "'f'", "k5")),
        (("good.yaml", "--free", "xp,yp"), ("c of camera 'camera' is held fixed",)),
        (("good.yaml", "--per-image", "y_scale"), ("per_image", "x_shift")),
        (("good.yaml", "--field", "wrong"), ("--field", "auto")),
        (("good.yaml", "--folds", "1"), ("folds", "2 and more")),
        (("good.yaml", "-o", "good.yaml"), ("good.yaml", "is a file")),
    ],
)
def test_bad_input_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.yaml").write_text("")
    (tmp_path / "campaign.yaml").write_text("schema: pixmetry/campaign/1\n")
    (tmp_path / "good.yaml").write_text("schema: pixmetry/calibration/1\ncameras: {cols: 64, rows: 48}\nobservations: o.csv\n")
    (tmp_path / "o.csv").write_text("image,point,x_px,y_px\na,1,2,3\n")
    before = sorted(tmp_path.iterdir())
    refused(run(*arguments), *words)
    assert sorted(tmp_path.iterdir()) == before


def test_one_image_is_not_a_network(tmp_path: Path, simulated: Simulated) -> None:
    network = simulated.network
    one = network.image == 0
    alone = replace(network, x_px=network.x_px[one], y_px=network.y_px[one], image=network.image[one], point=network.point[one])
    path = project(tmp_path, alone)
    result = run(path, "-o", tmp_path / "r")
    refused(result, "image")
    assert not (tmp_path / "r").exists()


# --- the page of documentation ----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn")
def test_one_blunder_outside_of_the_frame_is_a_gross_error(simulated: Simulated, tmp_path: Path) -> None:
    net = simulated.network
    x = net.x_px.copy()
    x[7] = net.cameras[0].sensor.cols + 60
    result = run(project(tmp_path, replace(net, x_px=x)), "-o", tmp_path / "r")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "r" / "calibration.json").read_text())
    gross = {(r["image"], r["point"]) for r in record["tests"]["gross_errors"]}
    assert (net.images[net.image[7]], net.points[net.point[7]]) in gross
    assert "outside_frame" in {f["kind"] for f in record["findings"]}


def words_of(report: Path) -> str:
    text = re.sub(r"<(style|svg)\b.*?</\1>", " ", report.read_text(), flags=re.S)
    return " ".join(re.sub(r"<[^>]*>", " ", text).split())


@pytest.mark.filterwarnings("error::UserWarning")
def test_a_camera_of_which_nothing_is_estimated(simulated: Simulated, tmp_path: Path) -> None:
    keys = dict(zip(NAMES[3:10], simulated.truth.interior[0][3:10], strict=True))
    c, xp, yp = simulated.truth.interior[0][:3]
    held = f"c_mm: {c}, xp_px: {xp}, yp_px: {yp}, free: none, " + ", ".join(f"{name}: {value!r}" for name, value in keys.items())
    path = project(tmp_path, simulated.network)
    path.write_text(path.read_text().replace("c_mm: 8", held.replace("np.float64(", "").replace(")", "")))
    result = run(path, "-o", tmp_path / "r")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "r" / "calibration.json").read_text())
    (camera,) = record["cameras"]
    assert all(p["u"] == 0 and not p["free"] for p in camera["parameters"]) and camera["covariance"]["names"] == []
    told = {p["name"]: p["value"] for p in camera["parameters"]}
    assert np.allclose([told.get(name, 0.0) for name in NAMES], simulated.truth.interior[0], rtol=1e-9)
    page = words_of(tmp_path / "r" / "report.html")
    assert page.count("held fixed") == len(keys) + 3 and "in the corners" not in page and "Correlations" not in page


@pytest.mark.filterwarnings("error::UserWarning")
def test_a_camera_that_no_image_names(simulated: Simulated, tmp_path: Path) -> None:
    path = project(tmp_path, simulated.network)
    two = re.sub(r"cameras: \{(.*)\}", r"cameras: [{name: A, \1}, {name: B, \1}]\nimages: images.csv", path.read_text())
    path.write_text(two)
    table(tmp_path / "images.csv", "image,camera", simulated.network.images, ["A"] * len(simulated.network.images))
    result = run(path, "-o", tmp_path / "r")
    assert result.exit_code == 0 and "Camera 'B' has no image" in result.output
    record = json.loads((tmp_path / "r" / "calibration.json").read_text())
    assert record["cameras"][1]["covariance"]["names"] == []
    page = words_of(tmp_path / "r" / "report.html")
    assert "No image coordinate of this camera was used" in page
    with pytest.raises(InputError, match="took part"):
        calibrated_geometry(tmp_path / "r", "B")
    assert calibrated_geometry(tmp_path / "r", "A").u_x_px > 0


@pytest.mark.usefixtures("undrawn")
def test_control_points_are_listed_given_less_adjusted(simulated: Simulated, tmp_path: Path) -> None:
    rng = np.random.default_rng(8)  # what is tested does not depend on the draw
    truth, names = simulated.truth.xyz, simulated.network.points
    given = truth[:12] + rng.normal(0, 0.02, (12, 3))  # better than is stated: no other one is left out
    given[3, 0] += 5.0
    table(tmp_path / "control.csv", "point,X,Y,Z,u_X,u_Y,u_Z", names[:12], *given.T, *np.full((3, 12), 0.05))
    path = project(tmp_path, simulated.network, "points: control.csv\n")
    result = run(path, "-o", tmp_path / "r")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "r" / "calibration.json").read_text())
    found = {name: xyz for name, xyz in zip(record["points"]["name"], record["points"]["xyz"], strict=True)}
    control = record["control_points"]
    assert names[3] not in control["point"] and len(control["point"]) == 33 and set(control["u"]) == {0.05}
    for k, (name, axis) in enumerate(zip(control["point"], control["axis"], strict=True)):
        expected = given[names.index(name), "XYZ".index(axis)] - found[name]["XYZ".index(axis)]
        assert control["residual"][k] == pytest.approx(expected, abs=1e-9)
        assert control["ratio"][k] == pytest.approx(expected / 0.05, abs=1e-7)
    page = words_of(tmp_path / "r" / "report.html")
    assert "Control points" in page and f"{names[0]} X" in page and re.search(rf"{names[3]}( X)? \(left out\)", page)


@pytest.mark.usefixtures("undrawn")
def test_check_points_of_a_project(simulated: Simulated, tmp_path: Path, rng: np.random.Generator) -> None:
    """They change nothing; the record, the page and the terminal say by how much they differ; the one that is wrong by 1 mm is named."""
    truth, names = simulated.truth.xyz, simulated.network.points
    table(tmp_path / "control.csv", "point,X,Y,Z,u_X,u_Y,u_Z", names[:8], *truth[:8].T, *np.full((3, 8), 0.05))
    given = truth[20:32] + rng.normal(0, 0.02, (12, 3))
    given[4, 2] += 1.0
    cells = [[names[20 + k], *(f"{v:.12g}" for v in row), "0.02", "0.02", "0.02"] for k, row in enumerate(given)]
    cells[7][2] = cells[7][5] = ""  # Y is not known
    (tmp_path / "check.csv").write_text("point,X,Y,Z,u_X,u_Y,u_Z\n" + "".join(",".join(row) + "\n" for row in cells) + "unseen,1,2,3,,,\n")
    records = []
    for more in ("", "check_points: check.csv\n"):
        path = project(tmp_path, simulated.network, f"points: control.csv\n{more}options: {{folds: 0}}\n")
        result = run(path, "-o", tmp_path / "r")
        assert result.exit_code == 0, result.output
        records.append(json.loads((tmp_path / "r" / "calibration.json").read_text()))
    assert records[0]["points"] == records[1]["points"] and records[0]["cameras"] == records[1]["cameras"]
    found = dict(zip(records[1]["points"]["name"], records[1]["points"]["xyz"], strict=True))
    record = records[1]["tests"]["check_points"]
    assert record["n"] == 35 and record["datum_parameters"] == 0 and len(record["points"]) == 13
    for k, point in enumerate(record["points"][:12]):
        for axis in range(3):
            if (k, axis) == (7, 1):
                assert point["given"][axis] is point["u_given"][axis] is point["difference"][axis] is point["ratio"][axis] is None
                continue
            off = given[k, axis] - found[point["name"]][axis]
            assert point["difference"][axis] == pytest.approx(off, abs=1e-9)
            assert point["u_difference"][axis] == pytest.approx(np.hypot(0.02, point["u_found"][axis]), rel=1e-3)
    assert (record["worst"]["name"], record["worst"]["axis"]) == (names[24], "Z") and record["points"][12]["found"] == [None] * 3
    warnings = [f["text"] for f in records[1]["findings"] if f["kind"] == "check_points" and f["level"] == "warning"]
    assert len(warnings) == 1 and f"{names[24]} Z" in warnings[0]
    page = words_of(tmp_path / "r" / "report.html")
    assert "Check points" in page and f"{names[20]} X" in page and "unseen" in page
    assert "12 check points with 35 coordinates" in page and "12 check points with 35 coordinates" in " ".join(result.output.split())


@pytest.mark.usefixtures("undrawn")
def test_single_coordinates_may_be_known(simulated: Simulated, tmp_path: Path, rng: np.random.Generator) -> None:
    """Four whole points, heights and places of others, all with other cells empty; the truth of the other points as exact check points."""
    truth, names = simulated.truth.xyz, simulated.network.points
    given = np.where(np.arange(12)[:, None] < 4, np.ones(3, bool), [False, False, True])
    given[8:] = [True, True, False]
    values = truth[:12] + rng.normal(0, 0.05, (12, 3))
    rows = [[names[k], *(f"{v:.12g}" if there else "" for v, there in zip(values[k], given[k], strict=True)),
             *("0.05" if there else "" for there in given[k])] for k in range(12)]  # fmt: skip
    (tmp_path / "control.csv").write_text(
        "point,X,Y,Z,u_X,u_Y,u_Z\n" + "".join(",".join(row) + "\n" for row in rows) + f"{names[12]},,,,,,\n"
    )
    table(tmp_path / "check.csv", "point,X,Y,Z", names[12:], *truth[12:].T)
    path = project(tmp_path, simulated.network, "points: control.csv\ncheck_points: check.csv\n")
    assert np.isnan(load_project(path).network.xyz[12]).all()
    result = run(path, "-o", tmp_path / "r")
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "r" / "calibration.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    gross = record["tests"]["known"]["control_points"]["gross"]
    assert len(record["control_points"]["point"]) == 4 * 3 + 4 + 4 * 2 or gross
    check = record["tests"]["check_points"]
    # all together, with their covariances: 1.5 times their u would be seen in any case
    assert check["n"] == check["dof"] == 84 and check["p"] > FALSE_FAILURE and check["chi2"] > chi2.ppf(FALSE_FAILURE, 84) / 1.5


def test_colour_images_of_a_project_are_told_which_key_is_meant(tmp_path: Path, rng: np.random.Generator) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), rng.integers(0, 255, (60, 80, 3), np.uint8))
    path = tmp_path / "p.yaml"
    path.write_text("schema: pixmetry/calibration/1\ncameras: {}\npictures: {files: a.png, grid: 5x4, pitch: 1}\n")
    refused(run(path, "-o", tmp_path / "r"), "`channel: green` under `pictures`")


def test_the_projects_of_the_page_are_valid(tmp_path: Path) -> None:
    blocks = re.findall(r"^```yaml\n(.*?)^```", DOCS.read_text(), re.M | re.S)
    assert len(blocks) == 5
    for text in blocks:
        (tmp_path / "p.yaml").write_text(text)
        data = load_yaml(tmp_path / "p.yaml")
        if isinstance(data["cameras"], dict):
            data["cameras"] = [data["cameras"]]
        validate(ProjectModel, data, "docs")


def test_the_page_names_every_key_and_no_other() -> None:
    def keys(model: type, head: str = "") -> set[str]:
        found: set[str] = set()
        for name, field in model.model_fields.items():
            key = f"{head}{field.alias or name}"
            inner = [part for part in re.findall(r"schema\.(\w+)", repr(field.annotation))]
            found |= {key} | (keys(getattr(sys.modules[model.__module__], inner[0]), f"{key}.") if inner else set())
        return found

    section = DOCS.read_text().partition("## Every key")[2].partition("## Columns")[0]
    told = {key for row in re.findall(r"^\| (`.*?) \|", section, re.M) for key in re.findall(r"`([a-z0-9_.]+)`", row)}
    told |= set(re.findall(r"or `([a-z0-9_.]+)` with", section)) | set(re.findall(r"with `([a-z0-9_.]+)`", section))
    allowed = keys(ProjectModel)
    assert told == allowed, told ^ allowed


@pytest.mark.usefixtures("undrawn")
def test_the_example_of_other_programs_runs(by_hand: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_results(by_hand, "result")
    (code,) = [block for block in re.findall(r"^```python\n(.*?)^```", DOCS.read_text(), re.M | re.S) if "exchange" in block]
    names: dict[str, object] = {}
    exec(compile(code, "docs", "exec"), names)
    assert (tmp_path / "camera.yaml").is_file() and names["other"].largest_px < 0.5  # type: ignore[attr-defined]


def test_the_messages_of_the_page_are_those_of_the_program() -> None:
    section = DOCS.read_text().partition("## What the messages mean")[2]
    messages = re.findall(r"^\| `(.*?)` \|", section, re.M)
    files = [SOURCE / "core" / "config.py", *(path for room in ("calibrate", "files") for path in (SOURCE / room).rglob("*.py"))]
    text = " ".join(path.read_text() for path in files)
    assert len(messages) > 15
    for message in messages:
        pattern = ".{1,60}".join(re.escape(part) for part in re.split("…", message))
        assert re.search(pattern, text), message


def test_the_door_stays_open(tmp_path: Path) -> None:
    """`pixmetry calibrate --help` loads none of the heavy libraries."""
    code = (
        "import atexit, sys\nsys.argv = ['pixmetry', 'calibrate', '--help']\n"
        "atexit.register(lambda: print('MODULES', *sys.modules))\n"
        "from pixmetry.cli import main; main()"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=os.environ.copy()).stdout
    assert not {"numpy", "numba", "pydantic", "scipy"} & set(said.partition("MODULES")[2].split())


def test_a_field_that_fits_no_camera_is_not_calibrated(tmp_path: Path, rng: np.random.Generator) -> None:
    """A board that bends in its plane from picture to picture, by up to 0.08 squares: no numbers of its corners fit. Exit status 1."""
    import imagecodecs

    whole = chessboard(7, 6)
    for k, (roll, *tilt) in enumerate([(0, 25, 0), (90, -25, 5), (10, 0, 25), (100, 5, -25), (45, 20, 20), (0, -20, 15)]):
        view = View((3.0, 2.5), 14.0, roll, *tilt)

        def bent(x: np.ndarray, y: np.ndarray, phase: float = 2.4 * k) -> np.ndarray:
            return whole(x + 0.08 * np.sin(1.9 * y + phase), y + 0.08 * np.sin(1.7 * x - phase))

        (tmp_path / f"{k}.png").write_bytes(imagecodecs.png_encode(view.frame(bent, rng)))
    result = run(tmp_path, "--grid", "7x6", "--pitch-mm", 10, "--c-px", 600, "--free", "c,xp,yp,k1", "-o", tmp_path / "out")
    assert result.exit_code == 1, result.output
    assert "Not calibrated" in result.output and "Error: This is no calibration" in " ".join(result.output.split())
    (finding,) = [f for f in json.loads((tmp_path / "out" / "calibration.json").read_text())["findings"] if f["level"] == "error"]
    assert finding["kind"] == "misfit" and finding["numbers"]["rms_px"] > 1
    assert "Not calibrated" in (tmp_path / "out" / "report.html").read_text()
