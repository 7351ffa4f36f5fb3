"""Simulated frames on disk: the same bits whatever the format, changes by name, and a truth that agrees with what the frames show."""

from __future__ import annotations

import errno
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from click.testing import CliRunner, Result

from catalogue.support import make_source
from pixmetry.camera.camera import Camera, Element, build_camera, load_camera
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.signal import Kind, Windows
from pixmetry.camera.source import Parameters, quantity
from pixmetry.cli import main
from pixmetry.core.errors import InputError, ParameterError
from pixmetry.core.random import Grid
from pixmetry.files import load_campaign, read_frame
from pixmetry.scene.files import build_scene, read_scene
from pixmetry.simulate import job
from pixmetry.simulate.job import simulate

CHAIN = """\
chain:
- source: sensor.quantum_efficiency
  parameters: {quantum_efficiency: 0.5}
- source: sensor.prnu
  parameters: {pixel_std_rel: 0.02}
- source: sensor.shot_noise
- source: electronics.amplifier_noise
  name: read noise
  parameters: {white_e: 8}
- source: electronics.row_noise
  enabled: false
- source: electronics.gain
  parameters: {gain_dn_per_e: 0.2}
- source: grabber.adc
  parameters: {bits: 12, offset_dn: 40}
"""
CAMERA = f"schema: pixmetry/camera/1\nname: test camera\nrows: 48\ncols: 80\npitch_x_um: 5.0\n{CHAIN}"
SCENE: dict[str, Any] = {
    "schema": "pixmetry/scene/1",
    "uniform": {"level_photons": 900},
    "discs": {"lattice_px": 24, "peak_photons": 14000},
}
SCENE_FILE = "schema: pixmetry/scene/1\nuniform: {level_photons: 900}\ndiscs: {lattice_px: 24, peak_photons: 14000}\n"
SERIES = "schema: pixmetry/scene/1\nphoton_transfer: {levels: 4, brightest_photons: 30000, stack_frames: 8}\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("camera.yaml", CAMERA), ("scene.yaml", SCENE_FILE), ("series.yaml", SERIES)):
        (tmp_path / name).write_text(text)
    return tmp_path


def run(folder: Path, *options: object, scene: str = "scene.yaml", camera: str = "camera.yaml", output: str = "out") -> Result:
    arguments = ["simulate", folder / camera, folder / scene, "-o", folder / output, *options]
    return CliRunner().invoke(main, [str(a) for a in arguments])


def done(result: Result) -> None:
    assert result.exit_code == 0, result.output


def exposed(camera: Camera, frames: int, **kw: Any) -> np.ndarray:
    return camera.expose(build_scene(read_scene(SCENE), camera.frame_shape), frames, **kw).data


def written(folder: Path, name: str = "out") -> np.ndarray:
    return np.stack([read_frame(p) for p in sorted((folder / name).glob("frame_*"))])


def truth_of(folder: Path, name: str = "out") -> dict[str, Any]:
    return json.loads((folder / name / "truth.json").read_text())


# ---- frames --------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("image_format", ["tiff", "png", "zarr"])
def test_every_format_holds_the_very_frames(folder: Path, image_format: str) -> None:
    done(run(folder, "-n", 3, "--seed", 5, "--format", image_format))
    if image_format == "zarr":
        array = zarr.open_array(folder / "out" / "frames.zarr", path="frames", mode="r")
        assert array.chunks == (1, 48, 80) and array.dtype == np.uint16 and array.attrs["bits"] == 12
        got = array[...]
    else:
        got = written(folder)
    assert np.array_equal(got, exposed(load_camera(folder / "camera.yaml"), 3, seed=5))
    files = [f["file"] for f in truth_of(folder)["frames"]]
    assert np.array_equal([read_frame(folder / "out" / f) for f in files], got)


def test_eight_bits_are_stored_as_eight(folder: Path) -> None:
    done(run(folder, "--format", "zarr", "--set", "grabber.adc.bits=8", "--set", "electronics.gain.gain_dn_per_e=0.01"))
    assert zarr.open_array(folder / "out" / "frames.zarr", path="frames", mode="r").dtype == np.uint8


def test_a_window_is_the_crop_and_its_truth_counts_from_its_corner(folder: Path) -> None:
    done(run(folder, "-n", 2, "--window", "9,20,30,41"))
    done(run(folder, "-n", 2, output="whole"))
    assert np.array_equal(written(folder), written(folder, "whole")[:, 9:39, 20:61])
    part, whole = truth_of(folder), truth_of(folder, "whole")
    assert part["image"] == {"row0": 9, "col0": 20, "rows": 30, "cols": 41}
    for p, w in zip(part["targets"], whole["targets"], strict=True):
        assert (p["x_px"], p["y_px"]) == pytest.approx((w["x_px"] - 20, w["y_px"] - 9))
        assert p["inside"] == (-0.5 <= p["x_px"] <= 40.5 and -0.5 <= p["y_px"] <= 29.5)
    assert {p["inside"] for p in part["targets"]} == {True, False}


def test_a_camera_with_a_memory_is_run_in_order(folder: Path) -> None:
    codec = "- source: storage.video_codec\n  parameters: {codec: hevc, depth_bits: 12, group: 4}\n"
    (folder / "camera.yaml").write_text(CAMERA + codec)
    done(run(folder, "-n", 3))
    done(run(folder, "-n", 6, output="longer"))
    assert np.array_equal(written(folder), written(folder, "longer")[:3])
    done(run(folder, "-n", 6, "--off", "storage.video_codec", output="raw"))
    assert not np.array_equal(written(folder, "raw"), written(folder, "longer"))


# ---- changes -------------------------------------------------------------------------------------------------------------------------


def test_a_setting_is_that_of_the_camera_file(folder: Path) -> None:
    changed = CAMERA.replace("white_e: 8", "white_e: 20").replace("cols: 80", "cols: 80\nunit_seed: 6\nexposure_s: 0.02")
    (folder / "other.yaml").write_text(changed)
    settings = ("--set", "read noise.white_e=20", "--set", "unit_seed=6", "--set", "exposure_s = 2e-2", "--set", "frame_period_s=0.5")
    done(run(folder, "-n", 2, *settings))
    done(run(folder, "-n", 2, camera="other.yaml", output="other"))
    assert np.array_equal(written(folder), written(folder, "other"))
    truth = truth_of(folder)
    assert truth["unit_seed"] == 6 and truth["overrides"]["read noise.white_e"] == 20
    assert [f["time_s"] for f in truth["frames"]] == [0, 0.5] and truth["frames"][0]["exposure_s"] == 0.02


def test_the_camera_that_is_saved_makes_the_same_frames(folder: Path) -> None:
    done(run(folder, "-n", 2, "--off", "sensor.prnu", "--set", "grabber.adc.offset_dn=70", "--set", "rows=40"))
    done(run(folder, "-n", 2, camera="out/camera.yaml", output="again"))
    assert np.array_equal(written(folder), written(folder, "again")) and written(folder).shape == (2, 40, 80)


def test_switching_off_is_that_of_the_camera(folder: Path) -> None:
    done(run(folder, "--off", "sensor.prnu", "--off", "read noise"))
    quieter = load_camera(folder / "camera.yaml").switched(off=["sensor.prnu", "read noise"])
    assert np.array_equal(written(folder), exposed(quieter, 1))
    assert truth_of(folder)["off"] == ["sensor.prnu", "read noise"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "read noise.white_e=-1"), ("white_e", "-1", "0")),
        (("--set", "read noise.white_e=.nan"), ("white_e", "finite")),
        (("--set", "read noise.white=3"), ("white", "white_e")),
        (("--set", "grabber.adc.bits=[8, 9]"), ("bits", "number")),
        (("--set", "electronics.amplifier_noise.white_e=3"), ("read noise",)),
        (("--set", "grabber.adcc.bits=8"), ("grabber.adcc", "sensor.prnu", "did you mean grabber.adc")),
        (("--set", "cable.termination.vswr=2"), ("not in the chain", "add", "- source: cable.termination")),
        (("--set", "electronics.row_noise.row_e=2"), ("switched off", "enabled: true")),
        (("--set", "exposure=2"), ("exposure_s", "temperature_c")),
        (("--set", "exposure_s=-2"), ("exposure_s", "-2")),
        (("--set", "unit_seed=1.5"), ("unit_seed",)),
        (("--set", "frame_period_s=0"), ("frame_period_s", "above 0")),
        (("--set", "exposure_s"), ("NAME.PARAMETER=VALUE",)),
        (("--set", "exposure_s=1: 2: 3"), ("NAME.PARAMETER=VALUE",)),
        (("--set", "unit_seed=1", "--set", "unit_seed=2"), ("twice",)),
        (("--off", "sensor.prun"), ("sensor.prun", "did you mean sensor.prnu")),
        (("--off", "grabber.adc"), ("no codes",)),
        (("--window", "1,2,3"), ("ROW,COL,ROWS,COLS",)),
        (("--window", "40,0,9,9"), ("48 rows and 80 columns",)),
    ],
    ids=lambda v: " ".join(v) if v and v[0].startswith("--") else None,
)
def test_what_cannot_be_changed_is_one_line_and_nothing_is_written(folder: Path, options: tuple[str, ...], words: tuple[str, ...]) -> None:
    before = sorted(p.name for p in folder.iterdir())
    result = run(folder, *options)
    assert result.exit_code == 2, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), result.output
    assert all(word in lines[0] for word in words), result.output
    assert sorted(p.name for p in folder.iterdir()) == before


@pytest.mark.parametrize("options", [("-n", "2"), ("--set", "exposure_s=0.02")])
def test_a_series_has_its_own_frames_and_exposures(folder: Path, options: tuple[str, ...]) -> None:
    result = run(folder, *options, scene="series.yaml")
    assert result.exit_code == 2 and "a photon-transfer series" in result.output
    assert not (folder / "out").exists()


def test_a_frame_that_fails_leaves_nothing(folder: Path) -> None:
    (folder / "camera.yaml").write_text(CAMERA + "- source: storage.jpeg\n")  # 12 bits do not fit
    with pytest.raises(ParameterError, match="8 bits"):
        simulate(folder / "camera.yaml", SCENE, folder / "out", image_format="zarr", truth=True)
    assert sorted(p.name for p in folder.iterdir()) == ["camera.yaml", "scene.yaml", "series.yaml"]


# ---- truth ---------------------------------------------------------------------------------------------------------------------------


class Shift(Parameters):
    """Of a test source: the image wanders."""

    dx_px_per_s: float = quantity(0.0, "px/s", "speed to the right", ge=-1e3, le=1e3)


def _drift(params: Shift, signal: Any, stream: Any) -> Any:
    dx = (params.dx_px_per_s * signal.time_s)[:, None, None]
    return signal.with_light(signal.light.moved(lambda x, y: (x - dx, y + 0.4)))


def _tell(params: Shift, signal: Any, stream: Any) -> dict[str, np.ndarray]:
    rows = signal.grid.shape[0]
    alternating = np.full((rows, 3), 5 + signal.grid.frame[0] // 2)
    return {
        "dx_px": params.dx_px_per_s * signal.time_s,
        "of_rows_px": signal.grid.frame[:, None] + np.arange(rows) / 100,
        "of_unit": stream.normal_fixed(signal.grid)[0],
        "changes_later": alternating,
    }


def _border(params: Parameters, signal: Any, stream: Any) -> Any:
    """Seven black columns to the left and two rows above: a frame of another size."""
    rows, cols = signal.frame_shape
    data = np.pad(signal.data, ((0, 0), (2, 0), (7, 0)))
    shape = (rows + 2, cols + 7)
    zero = np.zeros(len(signal.data), np.int64)
    return replace(signal, data=data, grid=Grid(signal.grid.frame, zero, zero, shape), frame_shape=shape)


def wandering(speed: float) -> Camera:
    """A camera without noise, whose image wanders and whose frames have a border."""
    drift = make_source("optics.drift", _drift, (Kind.LIGHT,), parameters=Shift, truth=_tell)
    border = make_source(
        "grabber.border",
        _border,
        (Kind.DN,),
        reshape=lambda params, shape: (shape[0] + 2, shape[1] + 7),
        place=lambda params, x, y, shape, frame: (x + 7, y + 2),
        context=lambda params, windows, shape: Windows.of(Grid.whole(np.zeros(len(windows.row0), np.int64), shape)),
    )
    settings = {"sensor.quantum_efficiency": {"quantum_efficiency": 1.0}, "electronics.gain": {"gain_dn_per_e": 0.2}}
    quiet = [Element(i, get_source(i), get_source(i).make(v)) for i, v in settings.items()]
    adc = get_source("grabber.adc")
    last = [Element("frame border", border, border.typical), Element(adc.id, adc, adc.make({"bits": 12}))]
    return Camera("wandering", (64, 72), (Element("drift", drift, Shift(dx_px_per_s=speed)), *quiet, *last), facts={"frame_period_s": 0.5})


def centroids(frame: np.ndarray, x: np.ndarray, y: np.ndarray, half: int = 8) -> np.ndarray:
    out = []
    for cx, cy in zip(np.rint(x).astype(int), np.rint(y).astype(int), strict=True):
        part = frame[cy - half : cy + half + 1, cx - half : cx + half + 1].astype(float)
        rows, cols = np.mgrid[cy - half : cy + half + 1, cx - half : cx + half + 1]
        out.append([(part * cols).sum() / part.sum(), (part * rows).sum() / part.sum()])
    return np.array(out)


@pytest.mark.parametrize("speed", [0.0, 0.7])
def test_the_targets_are_where_the_truth_says(tmp_path: Path, speed: float) -> None:
    """Without background, centroids know the place to 0.003 px (grey values are rounded to 1 of 3000); one frame is 0.35 px."""
    scene = {"schema": "pixmetry/scene/1", "discs": {"x_px": [20.3, 50.0], "y_px": [20.0, 40.6], "peak_photons": 15000}}
    simulate(wandering(speed), scene, tmp_path / "out", frames=3, truth=True)
    truth, frames = truth_of(tmp_path), written(tmp_path)
    assert frames.shape == (3, 66, 79) and truth["output"] == {"rows": 66, "cols": 79} and truth["sensor"] == {"rows": 64, "cols": 72}
    assert [t["scene_x_px"] for t in truth["targets"]] == [20.3, 50.0]
    assert all(isinstance(t["x_px"], list) == (speed > 0) and not isinstance(t["y_px"], list) for t in truth["targets"])
    stored = zarr.open_group(tmp_path / "out" / "truth.zarr", mode="r")
    for i, frame in enumerate(frames):
        x, y = (np.array([np.broadcast_to(t[key], 3)[i] for t in truth["targets"]]) for key in ("x_px", "y_px"))
        assert np.abs(centroids(frame, x, y) - np.stack([x, y], 1)).max() < 0.003
        assert np.array_equal(stored["targets/x_px"][i], x) and np.array_equal(stored["targets/y_px"][i], y)


def test_what_sources_tell_is_stored_once_or_frame_by_frame(tmp_path: Path) -> None:
    camera = wandering(0.7)
    simulate(camera, {"schema": "pixmetry/scene/1", "uniform": {"level_photons": 9}}, tmp_path / "out", frames=5, truth=True, seed=3)
    group = zarr.open_group(tmp_path / "out" / "truth.zarr", mode="r")
    told = group["sources/drift"]
    assert dict(group.attrs)["schema"] == "pixmetry/truth/1"
    assert np.allclose(told["dx_px"][:], 0.35 * np.arange(5)) and told["dx_px"].attrs["one_per"] == "frame"
    assert np.allclose(told["of_rows_px"][:], np.arange(5)[:, None] + np.arange(64) / 100) and told["of_rows_px"].chunks == (1, 64)
    want = camera.streams(3).of("drift").normal_fixed(Grid.whole([0], (64, 72)))[0]
    assert np.array_equal(told["of_unit"][:], want) and told["of_unit"].attrs["one_per"] == "unit"
    assert np.array_equal(told["changes_later"][:, 0, 0], [5, 5, 6, 6, 7]) and told["changes_later"].shape == (5, 64, 3)
    assert np.array_equal(group["frames/frame"][:], range(5)) and np.allclose(group["frames/time_s"][:], 0.5 * np.arange(5))
    assert truth_of(tmp_path)["targets"] == []


def test_warm_up_is_told(folder: Path) -> None:
    done(run(folder, "-n", 3, "--set", "warm_up_k=10", "--set", "warm_up_s=0.1", "--set", "temperature_c=30", "--truth"))
    want = 30 - 10 * np.exp(-np.arange(3) * 0.04 / 0.1)
    assert [f["temperature_c"] for f in truth_of(folder)["frames"]] == pytest.approx(list(want))
    assert zarr.open_group(folder / "out" / "truth.zarr", mode="r")["frames/temperature_c"][:] == pytest.approx(want)


# ---- series in a store ---------------------------------------------------------------------------------------------------------------


def test_a_series_in_a_store_is_read_like_one_in_files(folder: Path) -> None:
    done(run(folder, "--format", "zarr", scene="series.yaml", output="store"))
    done(run(folder, scene="series.yaml", output="files"))
    one, two = (load_campaign(folder / name) for name in ("store", "files"))
    assert one.frame_shape == two.frame_shape == (48, 80) and one.frame_count == two.frame_count == 4 * 4 + 16
    for a, b in zip(one.groups, two.groups, strict=True):
        assert (a.kind, a.role, a.exposure_s, a.photons) == (b.kind, b.role, b.exposure_s, b.photons)
        assert all(np.array_equal(read_frame(p), read_frame(q)) for p, q in zip(a.paths, b.paths, strict=True))


def test_a_black_frame_is_stored_and_a_lost_one_is_found(folder: Path) -> None:
    done(run(folder, "-n", 2, "--format", "zarr", "--off", "read noise", "--set", "grabber.adc.offset_dn=0", "--off", "sensor.shot_noise"))
    store = folder / "out" / "frames.zarr"
    assert read_frame(store / "1").any()
    with pytest.raises(InputError, match="no such frame.*0 to 1"):
        read_frame(store / "2")
    (store / "frames" / "c" / "1" / "0" / "0").unlink()
    (store / "frames" / "zarr.json").touch()
    with pytest.raises(InputError, match="frames are missing"):
        read_frame(store / "0")
    (folder / "dark.yaml").write_text("schema: pixmetry/scene/1\nuniform: {level_photons: 0}\n")
    quiet = ("--off", "read noise", "--set", "grabber.adc.offset_dn=0", "--format", "zarr")
    done(run(folder, *quiet, scene="dark.yaml", output="dark"))
    assert not read_frame(folder / "dark" / "frames.zarr" / "0").any()


def test_the_python_call_refuses_like_the_command(tmp_path: Path) -> None:
    from ruamel.yaml import YAML

    camera = build_camera(YAML(typ="safe").load(CAMERA))
    for wrong in ({"frames": 0}, {"image_format": "gif"}, {"overrides": {"x": 1}}, {"off": ["nothing"]}, {"window": (0, 0, 0, 5)}):
        with pytest.raises(InputError):
            simulate(camera, SCENE, tmp_path / "out", **wrong)
    assert list(tmp_path.iterdir()) == []


# ---- what a user may get wrong ------------------------------------------------------------------------------------------------


def test_the_truth_lists_targets_in_the_order_of_the_file(tmp_path: Path) -> None:
    kinds = [(10.0, False), (30.0, True), (50.0, False), (70.0, True)]
    targets = [{"kind": "disc", "x_px": x, "y_px": 20.0, "diameter_px": 5, "still": still} for x, still in kinds]
    scene = {"schema": "pixmetry/scene/1", "targets": targets, "motion": {"velocity_px_per_s": [100, 0]}}
    device = replace(load_camera("imx264_like"), frame_shape=(40, 80))
    simulate(device, scene, tmp_path / "out", frames=2)
    told = json.loads((tmp_path / "out" / "truth.json").read_text())["targets"]
    first = [t["scene_x_px"][0] if isinstance(t["scene_x_px"], list) else t["scene_x_px"] for t in told]
    assert np.allclose(first, [10.5, 30.0, 50.5, 70.0])  # 100 px/s and the middle of 10 ms


def test_a_series_tells_the_temperature_at_which_it_was_taken(folder: Path) -> None:
    done(run(folder, "--set", "warm_up_k=20", "--set", "warm_up_s=1000", "--set", "temperature_c=40", scene="series.yaml"))
    frames = json.loads((folder / "out" / "truth.json").read_text())["frames"]
    campaign = load_campaign(folder / "out")
    assert campaign.camera.temperature_c == pytest.approx(np.mean([f["temperature_c"] for f in frames]), abs=1e-3)
    assert campaign.camera.temperature_c < 21  # the whole series is taken in seconds


def test_a_wrong_target_names_its_scene_file(folder: Path) -> None:
    (folder / "ring.yaml").write_text("schema: pixmetry/scene/1\ntargets: [{kind: ring, x_px: 5, y_px: 9, diameter_px: 7, inner_px: 9}]\n")
    for command in ("simulate", "chain"):
        result = CliRunner().invoke(main, [command, str(folder / "camera.yaml"), str(folder / "ring.yaml"), "-o", str(folder / "out")])
        assert result.exit_code == 2 and "ring.yaml: ring.inner_px" in result.output


def test_swapped_files_are_told_by_their_schema(folder: Path) -> None:
    for camera, scene, remedy in (
        ("scene", "camera", "name a camera file, a data-sheet file"),
        ("camera", "camera", "name a file of that schema"),
    ):
        result = CliRunner().invoke(main, ["simulate", *(str(folder / f"{n}.yaml") for n in (camera, scene)), "-o", str(folder / "out")])
        assert result.exit_code == 2 and "a file of another kind" in result.output and f"to do: {remedy}" in result.output


def test_a_scene_pair_that_is_one_number_is_explained(folder: Path) -> None:
    (folder / "scene.yaml").write_text(SCENE_FILE + "motion: {velocity_px_per_s: 5}\n")
    result = run(folder)
    assert result.exit_code == 2 and "brackets" in result.output and "line 4" in result.output


def test_an_unknown_source_names_its_place_in_the_camera_file(folder: Path) -> None:
    (folder / "camera.yaml").write_text(CAMERA.replace("sensor.prnu", "sensor.pnru"))
    result = run(folder)
    assert result.exit_code == 2 and "camera.yaml, chain[1]" in result.output and "--source-file" in result.output


def test_a_setting_without_a_parameter_is_explained(folder: Path) -> None:
    result = run(folder, "--set", "sensor.prnu=3")
    assert result.exit_code == 2 and "sensor.prnu.PARAMETER=VALUE" in result.output


def test_a_folder_of_a_scene_is_no_campaign(folder: Path) -> None:
    done(run(folder))
    with pytest.raises(InputError, match="no campaign") as caught:
        load_campaign(folder / "out")
    assert "photon_transfer" in caught.value.remedy


def test_a_full_disk_is_one_line_and_leaves_the_old_frames(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done(run(folder))
    before = sorted(p.name for p in folder.rglob("*"))

    def full(*_: object, **__: object) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(job.FrameWriter, "write", full)
    result = run(folder, "-n", 3)
    assert result.exit_code == 2 and result.output == "error: No space left on device; to do: make room, or choose another folder\n"
    assert sorted(p.name for p in folder.rglob("*")) == before


@pytest.mark.parametrize(("name", "words"), [("x" * 300, "shorter name"), ("c\udcff", "not valid UTF-8")])
def test_names_that_a_disk_or_a_record_cannot_hold_are_one_line(folder: Path, name: str, words: str) -> None:
    result = run(folder, output=name)
    assert result.exit_code == 2 and result.output.count("\n") == 1 and words in result.output
    assert not [p for p in folder.iterdir() if "partial" in p.name]


# ---- what is kept --------------------------------------------------------------------------------------------------------------------


def test_frames_stand_in_the_folder_that_was_named(folder: Path) -> None:
    done(run(folder, "-n", 2, output="frames"))
    assert {p.name for p in (folder / "frames").glob("*.tif")} == {"frame_00000.tif", "frame_00001.tif"}
    assert not [p for p in (folder / "frames").iterdir() if p.is_dir()]
    found = CliRunner().invoke(main, ["locate", str(folder / "frames"), "-o", str(folder / "t.csv")])
    assert "frame_00001.tif" in found.output and "skipped" not in found.output
    (folder / "frames" / "notes.txt").write_text("mine")
    found = CliRunner().invoke(main, ["locate", str(folder / "frames"), "-o", str(folder / "t.csv")])
    assert "skipped" in found.output and "notes.txt" in found.output and "truth.json" not in found.output


def test_frames_of_another_camera_or_scene_and_notes_among_them_are_kept(folder: Path) -> None:
    done(run(folder, "-n", 3, output="frames"))
    (folder / "other.yaml").write_text((folder / "camera.yaml").read_text())
    (folder / "twin.yaml").write_text((folder / "scene.yaml").read_text())
    before = {p: p.read_bytes() for p in (folder / "frames").iterdir()}
    for other in ({"camera": "other.yaml"}, {"scene": "twin.yaml"}):
        result = run(folder, output="frames", **other)
        assert result.exit_code == 2 and "simulation of something else (camera.yaml, scene.yaml)" in result.output
    (folder / "frames" / "notes.txt").write_text("mine")
    result = run(folder, output="frames")
    assert result.exit_code == 2 and "notes.txt" in result.output
    (folder / "frames" / "notes.txt").unlink()
    assert {p: p.read_bytes() for p in (folder / "frames").iterdir()} == before
    done(run(folder, "-n", 1, output="frames"))
    assert len(list((folder / "frames").glob("*.tif"))) == 1


def test_a_name_gives_no_orders_to_a_terminal(folder: Path) -> None:
    """Escape sequences in the name of a folder, a file, a camera; what is on the disk keeps its name."""
    evil = "a\x1b[2J\x9b\u202eb\n[/bold]"
    result = run(folder, output=evil)
    done(result)
    assert result.output == f"frames: {folder}/a\\x1b[2J\\x9b\\u202eb\\x0a[/bold]\n" and (folder / evil / "truth.json").is_file()
    for arguments in (("locate", f"{evil}.png"), ("compare", evil, evil), ("correct", evil, "--with", evil, "-o", evil)):
        result = CliRunner().invoke(main, list(arguments))
        assert result.exit_code == 2 and result.output.count("\n") == 1
        assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]", result.output)


@pytest.mark.parametrize("coder", ["", "- source: storage.jpeg\n"])
def test_the_manifest_of_a_series_says_what_its_files_do_not_show(folder: Path, coder: str) -> None:
    """Which part of the frame they are, and whether a coder in the camera's chain changed what was then stored without loss."""
    (folder / "coded.yaml").write_text(CAMERA.replace("bits: 12, offset_dn: 40", "bits: 8, offset_dn: 4") + coder)
    done(run(folder, "--window", "8,16,24,32", scene="series.yaml", camera="coded.yaml"))
    campaign = load_campaign(folder / "out")
    facts, camera = campaign.camera, load_camera(folder / "coded.yaml")
    assert facts.lossless is not bool(coder)
    assert (facts.sensor_shape, facts.first_row, facts.first_col, campaign.frame_shape) == (camera.output_shape, 8, 16, (24, 32))
