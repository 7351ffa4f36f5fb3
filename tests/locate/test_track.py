"""Targets followed from frame to frame: the positions of `locate`, numbers that last, and statistics that are true."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

from locate import rendered
from pixmetry import Tracker, locate
from pixmetry.cli import main
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.files.output import Output, streamed_file
from pixmetry.locate.centroids import moments
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.track.files import TABLE_MARK
from pixmetry.locate.track.statistics import Statistics

READ_DN = 1.0
NOISE = NoiseModel(READ_DN**2 + 1 / 12)
CENTROIDS = ("soft_threshold", "hard_threshold", "centroid", "squared_centroid", "windowed_centroid")
SHAPE = (96, 128)


def discs(x: object, y: object, radius: float = 4.0, height: float = 150.0, ground: float = 20.0) -> np.ndarray:
    """Mean image of discs; where two lie over each other, the light is that of one."""
    light = np.zeros(SHAPE)
    for a, b in zip(np.atleast_1d(x), np.atleast_1d(y), strict=True):
        rows, cols = at = rendered.window(a, b, radius + 6, SHAPE)
        if rows.size and cols.size:
            part = light[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
            np.maximum(part, rendered.edge_disc(a, b, radius, 0.8, at), out=part)
    return ground + height * light


def grid(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places of twelve discs, off from a grid by up to half a pixel."""
    x, y = np.meshgrid(np.arange(4) * 28 + 20.0, np.arange(3) * 28 + 20.0)
    return (v.ravel() + rng.uniform(-0.5, 0.5, 12) for v in (x, y))


def exposed(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rendered.expose(mean, rng, read_dn=READ_DN)


@pytest.mark.parametrize("estimator", [*CENTROIDS, "template", "forstner"])
def test_the_first_frame_is_that_of_locate(estimator: str, rng: np.random.Generator) -> None:
    x, y = grid(rng)
    frame = exposed(discs(x, y), rng)
    first, found = Tracker(frame, estimator=estimator).latest, locate(frame, estimator=estimator)
    for name in ("x_px", "y_px", "var_x_px2", "cov_xy_px2", "var_y_px2", "flags"):
        np.testing.assert_array_equal(getattr(first, name), found[name], err_msg=name)


@pytest.mark.parametrize("estimator", ["soft_threshold", "centroid", "windowed_centroid", "template"])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_later_frames_are_those_of_locate(estimator: str, dtype: type, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the noise model and the thresholds of the first frame; of moving discs, frame by frame.

    To rounding (1e-3 of u) in four targets of five. In the others a pixel of the outline is in by the map of the whole frame's background
    and out by the plane about the target, or the other way round; then a centroid's window reads another pixel of noise at its rim.
    """
    x, y = (np.array(v) for v in grid(rng))
    tracker = Tracker(exposed(discs(x, y), rng).astype(dtype), estimator=estimator, noise=NOISE)
    kept = tracker._kept

    def the_same(work: moments.Prepared, law: int, threads: int | None) -> tuple[np.ndarray, ...]:
        which = np.argmin(np.hypot(work.record[:, :1] - kept.at[:, 0], work.record[:, 1:2] - kept.at[:, 1]), axis=1)
        return kept.multiple[which], kept.s_curve[which] ** 2, kept.excess[which]

    monkeypatch.setattr(moments, "choose_thresholds", the_same)
    off = []
    for k in range(1, 9):
        frame = exposed(discs(x + 0.31 * k, y - 0.17 * k), rng).astype(dtype)
        frame.setflags(write=False)
        tracked, found = tracker.update(frame), locate(frame, estimator=estimator, noise=NOISE)
        # one more in a hundred frames is a false alarm
        at_x, at_y = x[:, None] + 0.31 * k, y[:, None] - 0.17 * k
        own, which = (np.argmin(np.hypot(at_x - seen.x_px, at_y - seen.y_px), axis=1) for seen in (tracked, found))
        assert len(set(own)) == len(set(which)) == 12 and max(len(tracked), len(found)) <= 13
        off.append((tracked.x_px[own] - found.x_px[which]) / np.sqrt(found.var_x_px2[which]))
    off = np.abs(np.concatenate(off))
    assert np.quantile(off, 0.8) < 1e-3
    assert off.max() < (0.01 if estimator == "template" else 0.8)


def test_threads_change_nothing(rng: np.random.Generator) -> None:
    mean = rendered.discs_frame(rng, shape=(400, 400), count=150)[0]
    frames = [rendered.expose(mean, rng, read_dn=READ_DN) for _ in range(4)]
    one, two = (Tracker(frames[0], threads=threads, noise=NOISE) for threads in (1, 2))
    for frame in frames[1:]:
        a, b = one.update(frame), two.update(frame)
        np.testing.assert_array_equal(a.x_px, b.x_px)
        np.testing.assert_array_equal(a.var_y_px2, b.var_y_px2)


@pytest.mark.parametrize("estimator", ["soft_threshold", "template"])
def test_numbers_last_through_gaps(estimator: str, rng: np.random.Generator) -> None:
    """A disc that is hidden for ten frames goes on where it would have come to; while it is hidden it has no position."""
    x, y = np.array([20.0, 30.0, 25.0]), np.array([20.0, 50.0, 78.0])
    tracker = Tracker(exposed(discs(x, y), rng), estimator=estimator, noise=NOISE)
    for k in range(1, 30):
        shown = [0, 1, 2] if not 8 <= k < 18 else [0, 2]
        found = tracker.update(exposed(discs((x + 2.5 * k)[shown], y[shown]), rng))
        assert found.found.tolist() == [i in shown for i in range(3)]
        assert (np.abs(found.x_px - x - 2.5 * k)[shown] < 0.1).all(), k
        assert bool(found.flags[1] & Flag.NOT_CONVERGED) == (1 not in shown)
    assert tracker.statistics().frames.tolist() == [30, 20, 30]


def test_numbers_last_through_crossings(rng: np.random.Generator) -> None:
    """Two discs cross, one behind the other: before and after it each has its number, and never do two numbers share a disc."""
    tracker = None
    for k in range(60):
        x, y = np.array([20.0 + 1.5 * k, 110.0 - 1.5 * k]), np.array([45.0, 48.0])
        frame = exposed(discs(x, y), rng)
        if tracker is None:
            tracker = Tracker(frame, noise=NOISE)
            first = np.argsort(tracker.latest.x_px)
            continue
        found = tracker.update(frame)
        apart = abs(x[0] - x[1])
        if apart > 14:
            np.testing.assert_allclose(found.x_px[first], x, atol=0.1)
            np.testing.assert_allclose(found.y_px[first], y, atol=0.1)
        elif found.found.all():
            assert np.hypot(*np.diff([found.x_px, found.y_px])[:, 0]) > 2


@pytest.mark.parametrize("opaque", [True, False])
@pytest.mark.parametrize(("speed", "beside"), [((2.0, 2.0), 2.2), ((1.0, 2.6), 4.5), ((2.5, 1.2), 6.0)])
def test_two_that_were_one_region_go_on(opaque: bool, speed: tuple[float, float], beside: float, rng: np.random.Generator) -> None:
    """Discs that touch, cover each other or add their light on the way teach no false motion; no wrong position is without a flag."""
    tracker = None
    for k in range(-20, 21):
        x, y = 64.0 + np.array([speed[0], -speed[1]]) * k, np.array([45.0, 45.0 + beside])
        one, other = (discs(x[i], y[i], 5.0, height=80.0) for i in (0, 1))
        frame = exposed(np.maximum(one, other) if opaque else one + other - 20.0, rng)
        if tracker is None:
            tracker = Tracker(frame, noise=NOISE)
            order = np.argsort(tracker.latest.x_px)
            continue
        found = tracker.update(frame)
        off = np.hypot(found.x_px[order] - x, found.y_px[order] - y)
        doubtful = (found.flags[order] & (Flag.OVERLAPPING | Flag.BORDER | Flag.NOT_CONVERGED)) != 0
        assert (doubtful | (off < 0.5)).all(), k
    assert (off < 0.1).all()
    s = tracker.statistics()
    np.testing.assert_allclose(s.drift_x_px[order], [speed[0], -speed[1]], atol=0.01)


def test_a_target_that_leaves_the_frame_does_not_bend_its_drift(rng: np.random.Generator) -> None:
    tracker = Tracker(exposed(discs(90.0, 45.0), rng), noise=NOISE)
    for k in range(1, 36):
        tracker.update(exposed(discs(90.0 + 1.3 * k, 45.0), rng))
    assert abs(tracker.statistics().drift_x_px[0] - 1.3) < 0.01


def test_times_count_from_any_instant(rng: np.random.Generator) -> None:
    at, sums = rng.normal(0, 0.01, (30, 2)), [Statistics(1), Statistics(1)]
    for k in range(30):
        for one, start in zip(sums, (0.0, 1.7e9), strict=True):  # seconds since 1970
            one.add(start + 0.25 * k, np.array([[*at[k] + k, 0.04, 0.0, 0.09]]), np.array([0.1]), np.ones(1, bool))
    first, second = (one.result() for one in sums)
    np.testing.assert_allclose(second.drift_x_px, first.drift_x_px, rtol=1e-9)
    np.testing.assert_allclose(second.u_drift_x_px, first.u_drift_x_px, rtol=1e-6)
    assert abs(first.drift_x_px[0] - 4) < 0.05


def test_a_common_jump_of_the_image_loses_no_target(rng: np.random.Generator) -> None:
    """All discs jump by 9 px, which is more than the search of those that are near another."""
    x, y = np.array([20.0, 36.0, 60.0, 60.0, 90.0]), np.array([20.0, 20.0, 50.0, 75.0, 30.0])
    tracker = Tracker(exposed(discs(x, y), rng), noise=NOISE)
    found = tracker.update(exposed(discs(x + 9, y + 1), rng))
    order = np.argsort(found.x_px + 1000 * found.y_px)
    assert found.found.all()
    np.testing.assert_allclose(np.sort(found.x_px[order]), np.sort(x + 9), atol=0.1)


def test_light_that_changes_from_frame_to_frame(rng: np.random.Generator) -> None:
    """Dark discs on a bright ground that flickers by a third."""
    x, y = grid(rng)
    tracker = Tracker(exposed(discs(x, y, height=-100.0, ground=180.0), rng))
    for part in (0.7, 1.2, 0.8, 1.0):
        found = tracker.update(exposed(part * discs(x, y, height=-100.0, ground=180.0), rng))
        assert found.found.all()
        order = np.argsort(np.rint(found.y_px / 28) * 1000 + found.x_px)
        np.testing.assert_allclose(found.x_px[order], x, atol=0.1)


def test_regions_of_interest(rng: np.random.Generator) -> None:
    x, y = grid(rng)
    frame = exposed(discs(x, y), rng)
    tracker = Tracker(frame, rois=[(5, 5, 30, 60), (60, 60, 36, 40)])
    there = locate(frame, estimator="soft_threshold")
    inside = [(5 < b < 35 and 5 < a < 65) or (60 < b < 96 and 60 < a < 100) for a, b in zip(there.x_px, there.y_px, strict=True)]
    assert len(tracker) == sum(inside) == 3
    np.testing.assert_allclose(np.sort(tracker.latest.x_px), np.sort(there.x_px[inside]), atol=0.02)


def noisy(rng: np.random.Generator, sigma: float, u: float, frames: int, n: int = 40, drift: float = 0.0) -> Statistics:
    """Statistics of positions that scatter by sigma and are said to scatter by u; the first target scatters by three times that."""
    sums = Statistics(n)
    scatter = np.full((n, 1), sigma)
    scatter[0] *= 3
    variance = np.full((n, 2), u**2)
    for k in range(frames):
        at = 100.0 + drift * k + scatter * rng.normal(size=(n, 2))
        result = np.stack([at[:, 0], at[:, 1], variance[:, 0], 0 * at[:, 0], variance[:, 1]], axis=1)
        sums.add(float(k), result, np.zeros(n), np.ones(n, bool))
    return sums


def test_statistics_are_those_of_the_noise(rng: np.random.Generator) -> None:
    """Repeatability to 4.9 √(1.944/2n)/√n', the drift by its z-score, and the Allan deviation of white noise σ/√τ; chance 1e-6 each."""
    frames, n, sigma = 512, 40, 0.01
    s = noisy(rng, sigma, sigma, frames, n, drift=1e-3).result()
    for axis in ("x", "y"):
        again = getattr(s, f"repeat_{axis}_px")[1:]
        worth = np.sqrt(1.944 / 2 / ((frames - 2) * (n - 1)))
        assert abs(np.sqrt(np.mean(again**2)) / sigma - 1) < 4.9 * worth + 0.01
        z = (getattr(s, f"drift_{axis}_px") - 1e-3) / getattr(s, f"u_drift_{axis}_px")
        assert np.abs(z).max() < 6.2
        assert abs(np.mean(z**2) - 1) < 4.9 * np.sqrt(2 / n) + 0.05
        told = getattr(s, f"told_{axis}")
        assert told[0] == 1
        assert not told[1:].any()
    assert s.tau_frames[:4].tolist() == [1, 2, 4, 8]
    still = noisy(rng, sigma, 2 * sigma, frames, n).result()
    pooled = sigma * np.sqrt((9 + n - 1) / n)
    for k, tau in enumerate(still.tau_frames[:5]):
        pairs = n * frames / tau
        worth = np.sqrt(1.5 / 2 / pairs * 3)  # one target of nine-fold variance
        assert abs(still.allan_x_px[k] / (pooled / np.sqrt(tau)) - 1) < 4.9 * worth
    assert (still.told_x[1:] == -1).all()


def test_statistics_by_numpy_with_gaps(rng: np.random.Generator) -> None:
    """Against the same formulas over stored positions of one target that is missing now and then."""
    frames = 60
    at, there = rng.normal(50, 1, (frames, 2)), rng.random(frames) > 0.2
    sums = Statistics(1)
    for k in range(frames):
        sums.add(0.5 * k, np.array([[*at[k], 0.04, 0.0, 0.09]]), np.array([0.1]), there[k : k + 1])
    s, t = sums.result(), 0.5 * np.arange(frames)[there]
    slope, _ = np.polyfit(t, at[there, 0], 1)
    second = [at[k] - 2 * at[k - 1] + at[k - 2] for k in range(2, frames) if there[k - 2 : k + 1].all()]
    first = [at[k] - at[k - 1] for k in range(1, frames) if there[k - 1 : k + 1].all()]
    np.testing.assert_allclose(s.mean_y_px[0], at[there, 1].mean())
    np.testing.assert_allclose(s.std_x_px[0], at[there, 0].std(ddof=1))
    np.testing.assert_allclose(s.drift_x_px[0], slope)
    np.testing.assert_allclose([s.repeat_x_px[0], s.repeat_y_px[0]], np.sqrt(np.mean(np.square(second), axis=0) / 6))
    np.testing.assert_allclose([s.allan_x_px[0], s.allan_y_px[0]], np.sqrt(np.mean(np.square(first), axis=0) / 2))
    np.testing.assert_allclose([s.stated_x_px[0], s.stated_y_px[0], s.s_curve_px[0]], [0.2, 0.3, 0.1])
    assert s.frames[0] == there.sum()


def test_vibration_of_all_targets_is_not_taken_for_their_noise(rng: np.random.Generator) -> None:
    x, y = grid(rng)
    tracker = Tracker(exposed(discs(x, y), rng), noise=NOISE)
    for step in rng.normal(0, 0.1, 60):
        tracker.update(exposed(discs(x + step, y), rng))
    s = tracker.statistics()
    assert not s.told_x.any()
    assert not s.told_y.any()
    assert 0.06 < s.common_x_px < 0.15  # 0.1 but for chance: 58 differences worth 30
    assert s.common_y_px < 0.01
    assert (s.repeat_x_px < 0.02).all()


def test_frames_stream(rng: np.random.Generator) -> None:
    """Frames are asked for one by one, and statistics take the memory of one frame."""
    x, y = grid(rng)
    frame, asked = exposed(discs(x, y), rng), []

    def live() -> Iterator[np.ndarray]:
        while True:
            asked.append(len(asked))
            yield frame

    tracker = Tracker(frame)
    before = sum(a.nbytes for a in tracker._statistics.sums)
    for found in tracker.follow(live()):
        assert len(asked) == found.frame
        if found.frame == 50:
            break
    assert sum(a.nbytes for a in tracker._statistics.sums) == before


def test_refuses_what_it_cannot_follow(rng: np.random.Generator) -> None:
    x, y = grid(rng)
    frame = exposed(discs(x, y), rng)
    for wrong in ({"kind": "line"}, {"estimator": "median"}, {"search_px": 0.0}, {"rois": [(0, 0, 200, 20)]}, {"rois": []}):
        with pytest.raises(InputError):
            Tracker(frame, **wrong)
    with pytest.raises(MeasureError, match="no target"):
        Tracker(np.full(SHAPE, 20, np.uint8))
    tracker = Tracker(frame)
    with pytest.raises(InputError, match="another size"):
        tracker.update(frame[:-1])
    assert tracker.update(frame).frame == 1  # nothing is lost by that


def test_command_follows_a_stack(rng: np.random.Generator, tmp_path: Path) -> None:
    x, y = grid(rng)
    frames = np.stack([exposed(discs(x + 0.2 * k, y), rng) for k in range(40)])
    tifffile.imwrite(tmp_path / "stack.tif", frames)
    table, numbers = tmp_path / "table.csv", tmp_path / "numbers.json"
    command = ["locate", "--track", str(tmp_path / "stack.tif"), "-o", str(table), "--statistics", str(numbers), "--interval", "0.1"]
    for _ in range(2):  # the second replaces the first
        result = CliRunner().invoke(main, command)
        assert result.exit_code == 0, result.output
    assert "12 targets in 40 frames, 0 of 480 positions not found" in result.output
    rows = list(csv.DictReader(line for line in table.open() if not line.startswith("#")))
    tracker = Tracker(frames[0])
    every = [tracker.latest, *tracker.follow(frames[1:])]
    assert len(rows) == 480
    np.testing.assert_allclose([float(row["x_px"]) for row in rows], np.concatenate([f.x_px for f in every]), atol=1e-6)
    assert {row["image"] for row in rows[:12]} == {"stack.tif/0"}
    record = json.loads(numbers.read_text())
    np.testing.assert_allclose(record["targets"]["drift_x_px"], 2.0, atol=0.02)
    assert record["frames"] == 40
    for wrong in (["--grid", "any"], ["--overlay", "o.png"]):
        assert CliRunner().invoke(main, [*command, *wrong]).exit_code == 2
    assert CliRunner().invoke(main, ["locate", str(tmp_path / "stack.tif"), "--search", "3"]).exit_code == 2


def test_a_sequence_that_breaks_off_leaves_the_earlier_table(rng: np.random.Generator, tmp_path: Path) -> None:
    x, y = grid(rng)
    for k in range(3):
        np.save(tmp_path / f"{k}.npy", exposed(discs(x, y), rng))
    np.save(tmp_path / "3.npy", np.zeros((5, 5), np.uint8))
    table = tmp_path / "table.csv"
    with streamed_file(Output(table, TABLE_MARK)) as file:
        file.write(b"# pixmetry pixmetry/tracked/1\n")
    files = [str(tmp_path / f"{k}.npy") for k in range(4)]
    result = CliRunner().invoke(main, ["locate", "--track", *files, "-o", str(table)])
    assert result.exit_code != 0
    assert "another size" in result.output
    assert "3.npy" in result.output
    assert table.read_bytes() == b"# pixmetry pixmetry/tracked/1\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.npy", "1.npy", "2.npy", "3.npy", "table.csv"]


def test_noise_that_neighbours_share_widens_the_uncertainty(rng: np.random.Generator) -> None:
    """As in `locate`: in the first frame alike, later by the same factor."""
    x, y = grid(rng)

    def frame() -> np.ndarray:
        noise = rng.normal(0, 6, (SHAPE[0] + 2, SHAPE[1] + 2))
        smooth = sum(noise[i : i + SHAPE[0], j : j + SHAPE[1]] for i in range(3) for j in range(3)) / 9
        return np.rint(discs(x, y) + smooth).astype(np.uint8)

    first = frame()
    found, tracker = locate(first, estimator="soft_threshold"), Tracker(first)
    assert "share noise" in found.images[0]["noise_model"]
    np.testing.assert_allclose(tracker.latest.var_x_px2, found.var_x_px2)
    np.testing.assert_allclose(tracker.latest.cov_xy_px2, found.cov_xy_px2, atol=1e-12)
    np.testing.assert_allclose(tracker.update(frame()).var_y_px2, found.var_y_px2, rtol=0.5)
