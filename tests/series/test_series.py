"""A series from image files to its page: times, a run that was killed, and the same frames in a campaign."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from tests.series.fixed_field import rendered

from pixmetry import assess, campaign_of_arrays, series
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.cli import main
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.files.images import write_frame
from pixmetry.files.in_memory import Frames
from pixmetry.series.job import measure_series
from pixmetry.series.modes import field_motion

SHAPE = (120, 170)
PLACES = np.stack(np.meshgrid(np.linspace(25.2, 143.9, 4), np.linspace(22.4, 97.3, 3)), axis=-1).reshape(-1, 2)
PLACES = PLACES + np.column_stack([np.arange(12) * 0.3 % 1, np.arange(12) * 0.7 % 1])  # at all phases of the pixels
TIME_S = np.arange(30) * 120.0
SHIFT = np.array([0.4, -0.25])
ALL_NAN = "file,time_s\n" + "".join(f"frame_{k:03d}.png,nan\n" for k in range(len(TIME_S)))


def frame(k: int, rng: np.random.Generator) -> np.ndarray:
    """Frame of a field that settles with 900 s."""
    return rendered(PLACES + SHIFT * (1 - np.exp(-TIME_S[k] / 900.0)), SHAPE, rng)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made, rng = tmp_path_factory.mktemp("frames"), np.random.default_rng(7)
    for k in range(len(TIME_S)):
        write_frame(made / f"frame_{k:03d}.png", frame(k, rng), 8)
    return made


def test_the_shift_of_frames_is_found(rng: np.random.Generator) -> None:
    frames = [frame(k, rng) for k in range(len(TIME_S))]
    found = measure_series([(str(k), TIME_S[k], lambda k=k: frames[k]) for k in range(len(frames))]).drift
    assert found.targets == len(PLACES)
    for name, truth in zip(("shift_x_px", "shift_y_px"), SHIFT, strict=True):
        assert abs(found.fit[name].value - truth) < 5.5 * found.fit[name].u < 0.2, name


def test_a_run_that_was_killed_goes_on(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = series(folder, tmp_path / "a", interval_s=120.0)
    log = tmp_path / "a.frames.jsonl"
    raw = log.read_bytes()
    lines = raw.splitlines(keepends=True)
    assert len(lines) == 2 + len(TIME_S)
    again = tmp_path / "b.frames.jsonl"
    again.write_bytes(b"".join(lines[:14]) + lines[14][:40])  # killed while it wrote a line
    from pixmetry.series import job

    fetched = []
    load = job.load_picture
    monkeypatch.setattr(job, "load_picture", lambda path, *rest: (fetched.append(path), load(path, *rest))[1])
    resumed = series(folder, tmp_path / "b", interval_s=120.0)
    assert len(fetched) == len(TIME_S) - 12
    np.testing.assert_array_equal(resumed.drift.values, whole.drift.values)
    assert sorted(again.read_bytes().splitlines()) == sorted(raw.splitlines())


@pytest.mark.parametrize("content", [b"a note of mine\n", b'{"schema": "pixmetry/series-log/1", "options": {"kind": "ring"}}\n', b"x"])
def test_a_log_of_something_else_is_not_touched(content: bytes, folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "c.frames.jsonl"
    log.write_bytes(content)
    with pytest.raises(InputError, match="log|line"):
        series(folder, tmp_path / "c", interval_s=120.0)
    assert log.read_bytes() == content and not (tmp_path / "c").exists()


def test_the_command_writes_page_and_record(folder: Path, tmp_path: Path) -> None:
    table = tmp_path / "times.csv"
    table.write_text("file,time_s\n" + "".join(f"frame_{k:03d}.png,{5 + TIME_S[k]}\n" for k in range(len(TIME_S))))
    done = CliRunner().invoke(main, ["series", str(folder), "-o", str(tmp_path / "d"), "--times", str(table)])
    assert done.exit_code == 0, done.output
    assert "30 frames over 58.0 min, 12 targets" in done.output and "Shift along x" in done.output
    record = json.loads((tmp_path / "d" / "series.json").read_text())
    assert record["schema"] == "pixmetry/series/1" and record["stable"]["unit"] == "s" and len(record["motion"]) == 30
    page = (tmp_path / "d" / "report.html").read_text()
    assert "Motion of the image while the camera warms up" in page and "Slow time constant" in page


def test_frames_without_times_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="carry no times"):
        series(folder)
    table = tmp_path / "times.csv"
    missing = ("file,time_s\nother.png,1\n", "no time for a frame")
    for text, told in (missing, ("name;t\na;1\n", "not a table"), ("file,time_s\na,x\n", "not a"), (ALL_NAN, "no time")):
        table.write_text(text)
        with pytest.raises(InputError, match=told):
            series(folder, times=table)
    with pytest.raises(InputError, match="twice"):
        series(folder, times=table, interval_s=1.0)


def test_frames_that_show_nothing_are_refused(rng: np.random.Generator) -> None:
    flat = [(str(k), float(k), lambda: rng.normal(100, 2, SHAPE).astype(np.uint8)) for k in range(20)]
    with pytest.raises(MeasureError, match="no targets|targets are seen"):
        measure_series(flat)


def test_a_series_in_a_campaign_is_measured(rng: np.random.Generator, tmp_path: Path) -> None:
    frames = np.array([frame(k, rng) for k in range(len(TIME_S))])
    told = GroupFacts(interval_s=120.0)
    campaign = campaign_of_arrays([Frames("series", None, frames, facts=told)], bits=8, name="a camera", pitch_um=5.0)
    found = assess(campaign, tmp_path / "out", trials=0)
    drift = found.estimates["sensor.mount_drift"]
    if "shift_x_px" in drift:  # else two curves fit alike
        assert abs(drift["shift_x_px"].value - SHIFT[0]) < 5.5 * drift["shift_x_px"].u
    assert "not found" in found.unmeasured["sensor.stabilisation"]  # no scatter from frame to frame
    assert "kind: series" not in found.unmeasured["grabber.clock_warm_up"]
    assert json.loads((tmp_path / "out" / "results.json").read_text())["series"]["targets"] == 12
    assert "Motion of the image" in (tmp_path / "out" / "report.html").read_text()
    with pytest.raises(InputError, match="2 times for 30 frames"):
        campaign_of_arrays([Frames("series", None, frames, facts=GroupFacts(times_s=(0.0, 1.0)))], bits=8)
    with pytest.raises(InputError, match="kind series without times"):
        campaign_of_arrays([Frames("series", None, frames)], bits=8)


def test_frames_of_one_name_in_two_folders_are_all_measured(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pixmetry.series import job

    for k in range(20):
        (tmp_path / "ab"[k % 2]).mkdir(exist_ok=True)
        (tmp_path / "ab"[k % 2] / f"{k // 2:02d}.png").write_bytes((folder / f"frame_{k:03d}.png").read_bytes())
    table = tmp_path / "times.csv"
    table.write_text("file,time_s\n" + "".join(f"{'ab'[k % 2]}/{k // 2:02d}.png,{TIME_S[k]}\n" for k in range(20)))
    found = series([tmp_path / "a", tmp_path / "b"], tmp_path / "out", times=table)
    assert found.frames == tuple(f"{'ab'[k % 2]}/{k // 2:02d}.png" for k in range(20))
    assert len((tmp_path / "out.frames.jsonl").read_bytes().splitlines()) == 2 + 20
    fetched: list[Path] = []
    load = job.load_picture
    monkeypatch.setattr(job, "load_picture", lambda path, *rest: (fetched.append(path), load(path, *rest))[1])
    later = (tmp_path / "out.frames.jsonl").stat().st_mtime + 5
    os.utime(tmp_path / "a" / "03.png", (later, later))  # taken anew
    series([tmp_path / "a", tmp_path / "b"], tmp_path / "out", times=table)
    assert fetched == [tmp_path / "a" / "03.png"]
    shift = found.drift.values[:, 0]
    assert abs(shift[-1] - shift[0] - SHIFT[0] * (1 - np.exp(-TIME_S[19] / 900.0))) < 0.1


def test_frames_of_one_time_are_refused(rng: np.random.Generator) -> None:
    frames = [frame(k, rng) for k in range(4)]
    with pytest.raises(MeasureError, match="at the same time"):
        measure_series([(str(k), 5.0, lambda k=k: frames[k]) for k in range(4)])
    with pytest.raises(MeasureError, match="4 frames are too few for a curve; allowed: 9 or more"):
        measure_series([(str(k), TIME_S[k], lambda k=k: frames[k]) for k in range(4)])


@pytest.mark.parametrize("line", [(80.0, np.arange(3) * 30.0 + 20), (np.arange(3) * 50.0 + 30, 60.0)])
def test_targets_on_a_line_do_not_tell_the_motion_behind_a_frame_grabber(line: tuple, rng: np.random.Generator) -> None:
    places = np.column_stack(np.broadcast_arrays(*line)) + rng.normal(0, 0.01, (10, 3, 2))
    covariance = np.broadcast_to(np.eye(2) * 1e-4, (10, 3, 2, 2))
    with pytest.raises(MeasureError, match="on a line"):
        field_motion(places, covariance, (84.5, 59.5), analogue=True)
    assert field_motion(places, covariance, (84.5, 59.5)).used.all()


def test_a_frame_that_is_being_written_does_not_end_the_watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pixmetry.cli.series import _follow
    from pixmetry.series import job

    cut, other = InputError("end of the image is missing", where="a.tif"), InputError("no such kind")
    answers: list[Exception] = [cut, MeasureError("too few"), cut, other, other]

    def run(*_: object, **__: object) -> None:
        raise answers.pop(0)

    monkeypatch.setattr(job, "series", run)
    monkeypatch.setattr("time.sleep", lambda _: None)
    with pytest.raises(InputError, match="no such kind"):
        _follow((tmp_path,), tmp_path / "out", {})
    assert not answers


def test_a_series_that_fails_says_why_at_its_sources(rng: np.random.Generator) -> None:
    flat = [rng.normal(100, 2, (20, *SHAPE)).astype(np.uint8) for _ in range(2)]
    told = GroupFacts(interval_s=60.0)
    found = assess(
        campaign_of_arrays([Frames(kind, None, f, facts=told) for kind, f in zip(("series", "motion"), flat, strict=True)], bits=8),
        trials=0,
    )
    for source in ("sensor.mount_drift", "sensor.rolling_shutter"):
        assert "not told by" in found.unmeasured[source] and "take frames" not in found.unmeasured[source]


def test_frames_of_a_film_may_be_jpeg(rng: np.random.Generator, tmp_path: Path) -> None:
    for k in range(12):
        Image.fromarray(frame(k, rng)).save(tmp_path / f"{k:02d}.jpg", quality=92)
    (tmp_path / "campaign.yaml").write_text(
        "schema: pixmetry/campaign/1\ncamera: {name: a film, bits: 8}\nframes:\n- {kind: series, interval_s: 120, files: '*.jpg'}\n"
    )
    found = assess(tmp_path / "campaign.yaml", trials=0)
    assert any("kind series are JPEG" in note for note in found.observations.notes)
    assert "storage.jpeg" not in found.estimates  # how a film was stored is not how the camera stores
    assert "sensor.mount_drift" in found.estimates or "series" in found.unmeasured["sensor.mount_drift"]


def test_the_live_view_tells_how_far_and_how_long(rng: np.random.Generator) -> None:
    """A camera that settles with 900 s, seen for half an hour: its corners stay within 0.05 px from 900 ln(0.472/0.05) s on."""
    from pixmetry.series.page import outlook_sentence

    times = np.arange(60) * 31.0
    frames = [rendered(PLACES + SHIFT * (1 - np.exp(-t / 900.0)), SHAPE, rng) for t in times]
    told = outlook_sentence(measure_series([(str(k), t, lambda k=k: frames[k]) for k, t in enumerate(times)]).drift)
    found = re.fullmatch(r"([\d.]+) ± ([\d.]+) px to go; stable \(within 0.05 px\) in ([\d.]+) ± ([\d.]+) min", told)
    assert found is not None, told
    far, u_far, minutes, u_minutes = (float(v) for v in found.groups())
    assert abs(far - np.hypot(*SHIFT) * np.exp(-times[-1] / 900)) < 6 * u_far
    assert abs(minutes - (900 * np.log(np.hypot(*SHIFT) / 0.05) - times[-1]) / 60) < 6 * u_minutes
