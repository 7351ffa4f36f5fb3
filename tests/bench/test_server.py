"""Who may ask what of the server, and what it answers: the numbers of the command line."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from pixmetry.bench.server import MOST_BYTES, SECURITY
from pixmetry.bench.state import BenchState, Shelf, read_state
from pixmetry.bench.take_away import yaml_text
from pixmetry.budget.scenario import read_scenario
from pixmetry.camera.camera import load_camera
from pixmetry.cli import main
from pixmetry.core.errors import InputError

STATE: dict[str, Any] = {
    "camera": "imx264_like",
    "set": {"sensor.prnu.pixel_std_rel": 0.02, "electronics.gain.gain_dn_per_e": 0.3},
    "off": ["sensor.dsnu"],
    "scenario": {"target": {"diameter_px": 9.0}, "motion": {"speed_px_per_s": 30.0}},
    "side_px": 64,
    "seed": 5,
    "chosen": "sensor.prnu",
}


def post(server: Any, path: str, state: Any, **headers: str) -> Any:
    return server.post(path, content=json.dumps(state), headers={"Content-Type": "application/json", "X-Page": "test", **headers})


def codes_of(picture: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(picture["data"]), "<u2").reshape(picture["rows"], picture["cols"])


# ---- who may ask -------------------------------------------------------------------------------------------------------------------


def test_only_who_has_the_link_is_let_in(server: Any) -> None:
    assert server.get("").status_code == 200
    for address in (
        "http://127.0.0.1:8350/",
        "http://127.0.0.1:8350/wrong/",
        "http://127.0.0.1:8350/wrong/opening",
        "http://127.0.0.1:8350/%00/",
    ):
        reply = server.get(address)
        assert reply.status_code == 403 and len(reply.content) < 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example:8350"},
        {"Host": "127.0.0.1:8351"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
def test_foreign_pages_and_names_are_refused(server: Any, headers: dict[str, str]) -> None:
    assert post(server, "/picture", STATE, **headers).status_code == 403
    assert server.get("/opening", headers=headers).status_code == 403


def test_its_own_page_is_let_in(server: Any) -> None:
    own = {"Origin": "http://127.0.0.1:8350", "Sec-Fetch-Site": "same-origin"}
    assert post(server, "/camera", STATE, **own).status_code == 200


def test_every_answer_has_the_headers_that_keep_the_page_apart(server: Any) -> None:
    for reply in (server.get(""), server.get("/bench.js"), server.get("/no-such-file"), server.get("http://127.0.0.1:8350/wrong/")):
        assert {name: reply.headers[name] for name in SECURITY} == SECURITY
    policy = SECURITY["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy


def test_no_file_but_those_of_the_page(server: Any) -> None:
    for name in ("../job.py", "..%2fjob.py", "server.py", "%2e%2e/worker.py", "index.html/../job.py", "state.yaml"):
        assert server.get(f"/{name}").status_code in (403, 404)


def test_the_page_holds_no_inline_code_and_names_no_other_address() -> None:
    from pixmetry.bench.server import page_files

    pages = page_files()
    assert {"index.html", "bench.css", "bench.js"} <= set(pages)
    for name, (body, _) in pages.items():
        text = body.decode().replace("http://www.w3.org/2000/svg", "").replace("http://www.w3.org/1999/xlink", "")
        assert "http://" not in text and "https://" not in text, name
        assert "style=" not in text and "onclick=" not in text and "innerHTML" not in text and "eval(" not in text, name


# ---- what is refused -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": "/etc/passwd"},
        {"camera": "../presets/imx264_like.yaml"},
        {"camera": "imx264_like", "set": {"sensor.prnu.pixel_std_rel": 9.0}},
        {"camera": "imx264_like", "set": {"sensor.prnu.pixel_std_rel": "large"}},
        {"camera": "imx264_like", "set": {"rows": 10_000_000}},
        {"camera": "imx264_like", "set": {f"a{k}.b": 1 for k in range(1000)}},
        {"camera": "imx264_like", "off": ["sensor.no_such"]},
        {"camera": "imx264_like", "off": ["electronics.gain"]},
        {"camera": "imx264_like", "add": ["sensor.no_such"]},
        {"camera": "imx264_like", "estimator": "no such"},
        {"camera": "imx264_like", "side_px": 100_000},
        {"camera": "imx264_like", "x_px": 1e300},
        {"camera": "imx264_like", "x_px": 99_999.0},
        {"camera": "imx264_like", "seed": -1},
        {"camera": "imx264_like", "scenario": {"target": {"diameter_px": 1e9}}},
        {"camera": "imx264_like", "scenario": {"no_such": {"a": 1}}},
        {"record": {"schema": "pixmetry/camera/1", "name": "x", "rows": 10, "cols": 10, "chain": [{"source": "no.such"}]}},
        {"record": {"schema": "pixmetry/camera/1", "name": "x", "rows": 10, "cols": 10, "chain": [], "measured": {"file": "/etc/passwd"}}},
        {"unknown": 1},
        [1, 2],
        "text",
    ],
)
def test_values_that_cannot_be_used_are_refused_and_the_server_goes_on(server: Any, wrong: Any) -> None:
    reply = post(server, "/picture", wrong)
    if wrong == {"camera": "imx264_like", "estimator": "no such"}:
        assert post(server, "/found", wrong).json()["found"]["reason"].startswith("estimator: no such estimator")
    else:
        assert reply.status_code == 200 and set(reply.json()) == {"error"} and len(reply.json()["error"]) < 4000
    assert set(post(server, "/camera", STATE).json()) > {"chain", "scenario"}


def test_more_than_a_page_sends_is_not_read(server: Any) -> None:
    assert post(server, "/picture", {"camera": "x" * (MOST_BYTES + 1)}).status_code == 413
    assert server.post("/picture", content="{}", headers={"Content-Type": "text/plain"}).status_code == 415
    assert server.post("/picture", content=iter([b"{}"]), headers={"Content-Type": "application/json"}).status_code == 411
    assert server.post("/picture", content=b"[" * 200_000, headers={"Content-Type": "application/json"}).json()["error"].startswith("state")


# ---- what it computes ------------------------------------------------------------------------------------------------------------------


def written(folder: Path) -> None:
    """The files of a state, as the page lets them be taken away."""
    from pixmetry.core.config import dump_yaml

    layout = Shelf().laid_out(read_state(STATE))
    layout.camera.save(folder / "pictured.yaml")
    layout.setting.described.save(folder / "camera.yaml")
    dump_yaml(layout.scene, folder / "scene.yaml")
    dump_yaml(layout.scenario.model_dump(by_alias=True, exclude_unset=True) | {"schema": "pixmetry/scenario/1"}, folder / "scenario.yaml")


def test_picture_and_error_are_those_of_the_command_line(server: Any, tmp_path: Path) -> None:
    written(tmp_path)
    picture = post(server, "/picture", STATE).json()["picture"]
    window = ",".join(str(picture[k]) for k in ("row0", "col0", "rows", "cols"))
    names = [str(tmp_path / n) for n in ("pictured.yaml", "scene.yaml", "frames")]
    done = CliRunner().invoke(main, ["simulate", *names[:2], "-o", names[2], "--seed", "5", "--window", window])
    assert done.exit_code == 0, done.output
    from pixmetry import read_frame

    frame = read_frame(tmp_path / "frames" / "frame_00000.tif")
    assert np.array_equal(frame, codes_of(picture))

    table = tmp_path / "found.json"
    image = str(tmp_path / "frames" / "frame_00000.tif")
    done = CliRunner().invoke(main, ["locate", image, "--bits", str(picture["bits"]), "-o", str(table)])
    assert done.exit_code == 0, done.output
    (located,) = json.loads(table.read_text())["targets"]
    (truth,) = json.loads((tmp_path / "frames" / "truth.json").read_text())["targets"]
    found = post(server, "/found", STATE).json()["found"]
    first = picture["col0"], picture["row0"]
    for k, axis in enumerate(("x_px", "y_px")):
        assert found["true_px"][k] == pytest.approx(truth[axis] + first[k], abs=1e-9)
        assert found["error_px"][k] == pytest.approx(located[axis] - truth[axis], abs=1e-9)
    assert found["covariance_px2"] == [located[n] for n in ("var_x_px2", "cov_xy_px2", "var_y_px2")]


def test_the_budget_is_that_of_the_command_line(server: Any, tmp_path: Path) -> None:
    state = STATE | {"camera": "dcs420_like", "set": {"sensor.prnu.pixel_std_rel": 0.02}, "off": []}
    with server.stream("POST", "/budget", content=json.dumps(state), headers={"Content-Type": "application/json"}) as reply:
        lines = [json.loads(line) for line in reply.iter_lines()]
    kinds = [line["kind"] for line in lines]
    assert kinds[0] == "begin" and kinds.count("row") == lines[0]["rows"] and kinds[-3:] == ["together"] * 3 and lines[-1]["last"]
    assert lines[1]["row"]["name"] == "sensor.prnu"  # what was changed comes first
    (tmp_path / "scenario.yaml").write_text("schema: pixmetry/scenario/1\ntarget: {diameter_px: 9.0}\nmotion: {speed_px_per_s: 30.0}\n")
    arguments = ["budget", "dcs420_like", "--scenario", str(tmp_path / "scenario.yaml"), "--set", "sensor.prnu.pixel_std_rel=0.02"]
    done = CliRunner().invoke(main, [*arguments, "--json", str(tmp_path / "b.json")])
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "b.json").read_text())
    shown = next(line["budget"] for line in lines if line["kind"] == "budget")
    assert shown["one_target_one_frame"] == told["one_target_one_frame"]
    assert [(r["name"], r["before_px"], r["after_px"], r["share"]) for r in shown["rows"]] == [
        (r["name"], r["before_px"], r["after_px"], r["share"]) for r in told["rows"]
    ]


def test_the_source_that_is_chosen_is_left_out_beside(server: Any) -> None:
    answer = post(server, "/found", STATE).json()
    picture = post(server, "/picture", STATE).json()["picture"]
    same = STATE | {"off": ["sensor.dsnu", "sensor.prnu"]}
    without = post(server, "/picture", same).json()["picture"]
    assert answer["beside"]["data"] == without["data"] != picture["data"]
    assert "beside" not in post(server, "/found", STATE | {"chosen": "sensor.smear"}).json()
    assert set(post(server, "/found", {"camera": "pulnix_tm6cn", "chosen": "grabber.adc"}).json()) == {"found"}  # no codes without it


def test_controls_hold_every_parameter_of_every_source(server: Any) -> None:
    from pixmetry.camera.catalogue import sources

    told = server.get("/opening").json()["catalogue"]
    assert set(told["sources"]) == set(sources())
    for source in sources().values():
        shown = {c["name"]: c for c in told["sources"][source.id]["controls"]}
        assert list(shown) == list(source.parameters.model_fields)
        for name, c in shown.items():
            assert c["kind"] in ("float", "int", "bool", "choice", "fixed") and c["unit"] == source.units[name]
            if c["kind"] in ("float", "int"):
                assert c["low"] < c["high"]


def test_a_state_reads_back_as_it_was_written() -> None:
    state = read_state(STATE)
    assert read_state(json.loads(state.text)) == state
    with pytest.raises(InputError, match="unknown key"):
        read_state({"cammera": "imx264_like"})
    assert BenchState().camera in Shelf().names


# ---- the other views, and starting points ------------------------------------------------------------------------------------------


def test_even_fields_are_those_of_the_camera(server: Any) -> None:
    fields = post(server, "/fields", STATE).json()
    flat, dark = fields["flat"], fields["dark"]
    assert flat["mean_dn"] > 10 * dark["mean_dn"] > 0 and flat["std_dn"] > dark["std_dn"] > 0
    assert flat["mean_dn"] == pytest.approx(codes_of(flat["picture"]).mean())


def test_the_line_of_video_is_late_by_its_low_pass(server: Any) -> None:
    state = {"camera": "pulnix_tm6cn_epix_512"}
    middle = []
    for changes in ({"off": ["grabber.low_pass"]}, {}):
        line = post(server, "/line", state | changes).json()
        at, video = (np.array(line[n]) for n in ("video_us", "video_dn"))
        light = video - np.median(video)
        light[light < 0.2 * light.max()] = 0
        middle.append(float(at @ light / light.sum()))
    order, cutoff_mhz = 3, 5.0  # group delay at frequency 0 of a Butterworth filter: the sum of its poles' inverses
    poles = np.exp(1j * np.pi * (2 * np.arange(1, order + 1) + order - 1) / (2 * order))
    late_us = float((-1 / poles).sum().real) / (2 * np.pi * cutoff_mhz)
    assert middle[1] - middle[0] == pytest.approx(late_us, rel=0.1)
    assert "no analogue video line" in post(server, "/line", {"camera": "imx264_like"}).json()["error"]


def test_the_hour_is_the_warm_up_of_the_grabbers_clock(server: Any) -> None:
    state = {"camera": "pulnix_tm6cn_epix_512", "off": ["sensor.thermal_expansion"]}
    moved = post(server, "/hour", state).json()
    clock = Shelf().camera(read_state(state))["grabber.clock_warm_up"].params
    decay = np.exp(-60 * np.array(moved["minutes"]) / clock.scale_tau_s)
    shape = np.array(moved["x_px"]) / moved["x_px"][0]
    assert shape == pytest.approx((decay - decay[-1]) / (decay[0] - decay[-1]), abs=0.02)
    assert np.abs(moved["y_px"]).max() < 0.01


def test_over_a_pixel_and_rows(server: Any) -> None:
    state = {"camera": "imx264_like", "estimator": "hard_threshold", "scenario": {"target": {"diameter_px": 4.0}}}
    errors = post(server, "/pixel", state).json()["errors_px"]
    assert set(errors) == {"hard_threshold", "template"} and np.ptp(errors["hard_threshold"]) > 2 * np.ptp(errors["template"])
    rows = post(server, "/rows", {"camera": "pulnix_tm6cn", "set": {"exposure_s": 0.001}}).json()
    begin = np.array(rows["begin_ms"])
    assert np.ptp(begin[::2]) == 0 and abs(begin[1] - begin[0]) == pytest.approx(20.0)


def test_what_is_taken_away_makes_the_same_again(server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shlex

    files = post(server, "/away", STATE | {"scenario": {"target": {"diameter_px": 9.0}, "state": {"camera_on_min": 5.0}}}).json()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    for line in files["commands.sh"].splitlines():
        words = shlex.split(line, comments=True)
        if words[:2] in (["pixmetry", "simulate"], ["pixmetry", "locate"]):
            done = CliRunner().invoke(main, words[1:])
            assert done.exit_code == 0, done.output
    from pixmetry import read_frame

    state = STATE | {"scenario": {"target": {"diameter_px": 9.0}, "state": {"camera_on_min": 5.0}}}
    picture = post(server, "/picture", state).json()["picture"]
    assert np.array_equal(read_frame("frames/frame_00000.tif"), codes_of(picture))
    camera = load_camera("camera.yaml")
    assert camera.to_record() == Shelf().camera(read_state(state)).to_record()
    compile(files["again.py"], "again.py", "exec")
    read_scenario("scenario.yaml")


def test_a_camera_file_of_ones_own_is_read_and_a_foreign_one_refused(server: Any) -> None:
    text = yaml_text(load_camera("imx264_like").to_record() | {"name": "mine"})
    record = post(server, "/read", {"text": text}).json()["record"]
    assert post(server, "/camera", {"record": record}).json()["name"] == "mine"
    for wrong in ("", "a: [", "schema: pixmetry/scene/1\n", "schema: pixmetry/camera/1\nname: x\n", 5):
        assert set(post(server, "/read", {"text": wrong}).json()) == {"error"}


# ---- a scene file ----------------------------------------------------------------------------------------------------------------------

SCENES: dict[str, dict[str, Any]] = {
    "lattice": {"uniform": {"level_photons": 200.0}, "discs": {"lattice_px": 40.0, "diameter_px": 9.0, "peak_photons": 9000.0}},
    "moving": {
        "targets": [{"kind": "disc", "x_px": 300.0, "y_px": 200.2, "diameter_px": 8.0, "peak_photons": 9000.0}],
        "motion": {"velocity_px_per_s": [100.0, 0.0]},
    },
    "field": {"uniform": {"level_photons": 5000.0}},
}
DIAMETERS = {"lattice": 9.0, "moving": 8.0}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_file_is_seen_as_simulate_sees_it(server: Any, tmp_path: Path, name: str) -> None:
    from pixmetry import read_frame
    from pixmetry.core.config import dump_yaml

    scene = {"schema": "pixmetry/scene/1"} | SCENES[name]
    state = {"camera": "imx264_like", "scene": scene, "side_px": 64, "seed": 2, "x_px": 310.0, "y_px": 190.0}
    answer = post(server, "/picture", state).json()
    picture = answer["picture"]
    dump_yaml(scene, tmp_path / "scene.yaml")
    window = ",".join(str(picture[k]) for k in ("row0", "col0", "rows", "cols"))
    pictured = tmp_path / "pictured.yaml"
    pictured.write_text(post(server, "/away", state).json()["pictured.yaml"])
    words = ["simulate", str(pictured), str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "f"), "--seed", "2", "--window", window]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    assert np.array_equal(read_frame(tmp_path / "f" / "frame_00000.tif"), codes_of(picture))
    targets = json.loads((tmp_path / "f" / "truth.json").read_text())["targets"]
    found = post(server, "/found", state).json()["found"]
    if name == "field":
        assert answer["true_px"] is None and not targets and found["reason"] == "the scene has no target"
    else:
        x, y = (answer["true_px"][k] - picture[n] for k, n in enumerate(("col0", "row0")))
        (nearest,) = [t for t in targets if np.hypot(t["x_px"] - x, t["y_px"] - y) < 1e-6]
        assert found["error_px"] is not None and np.hypot(*found["error_px"]) < 0.2 and nearest["diameter_px"] == DIAMETERS[name]
    assert "stay where they are" in post(server, "/pixel", state).json()["error"]


def test_scene_and_cameras_of_the_command_line_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pixmetry.bench import job

    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml_text({"schema": "pixmetry/scene/1"} | SCENES["lattice"]))
    begun: list[Any] = []
    monkeypatch.setattr(job, "_serve", lambda app_with, port, tell: begun.append(app_with("t", 1)))
    monkeypatch.setattr("pixmetry.bench.server.app_of", lambda shelf, token, own, given, first: (given, first))
    for words, cameras in (([str(scene)], ()), (["imx264_like", str(scene)], ("imx264_like",)), (["imx264_like"], ("imx264_like",))):
        done = CliRunner().invoke(main, ["bench", "--no-open", *words])
        assert done.exit_code == 0, done.output
        given, first = begun.pop()
        assert given == cameras and ("scene" in first) == (len(words) > len(cameras))
        if "scene" in first:
            assert first["scenario"]["target"]["diameter_px"] == 9.0
    scene.write_text(yaml_text({"schema": "pixmetry/scene/1", "photon_transfer": {"brightest_photons": 1000.0}}))
    refused = CliRunner().invoke(main, ["bench", "--no-open", str(scene)])
    assert refused.exit_code != 0 and "not one picture" in refused.output


def test_a_scene_that_is_too_much_is_refused(server: Any) -> None:
    pose = {"principal_distance_px": 1000.0, "z_mm": 1000.0}
    plate = {"kind": "dots", "rows": 1000, "columns": 1000, "diameter_mm": 0.5, "pose": pose}
    for scene in ({"plate": plate}, {"discs": {"lattice_px": 4.0}}, {}, {"photon_transfer": {"brightest_photons": 1000.0}}):
        reply = post(server, "/picture", {"camera": "imx264_like", "scene": {"schema": "pixmetry/scene/1"} | scene}).json()
        assert set(reply) == {"error"}
