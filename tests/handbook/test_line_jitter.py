"""The line-jitter experiment: some of its views run again, and what the stored whole says of the jitter that was put in.

Statistical bounds: false-failure rate 1e-6 a test.
"""

from __future__ import annotations

import numpy as np
import pytest
from gallery import line_jitter as experiment
from gallery import line_jitter_frames as frames
from gallery.line_jitter import JITTERS_NS, PIXEL_NS, key, stored
from gallery.line_jitter_frames import AVERAGED, LENSES, VIEWS
from scipy.stats import chi2, norm

from pixmetry.calibrate.lines.plumb_line import calibrate_lines
from pixmetry.calibrate.lines.row_jitter import RowVariance, Sampling

RATE = 1e-6
QUICK = (1, 0, 2)


@pytest.fixture(scope="module")
def run() -> experiment.Experiment:
    return stored()


@pytest.fixture(scope="module")
def again() -> dict[float, experiment.View]:
    return {ns: experiment.run_view(QUICK, ns) for ns in (0.0, 3.0)}


def test_a_view_run_again_gives_the_stored_numbers(run, again) -> None:
    """To 1 %, which other processors' last digits do not change."""
    for ns, view in again.items():
        kept = run.views[key(QUICK, ns)]
        for name in "xy":
            one, other = view.axes[name], kept.axes[name]
            assert (one.n, one.lines) == (other.n, other.lines) == (640, 8)
            assert one.rms_px == pytest.approx(other.rms_px, rel=0.01) and one.rms_um == pytest.approx(other.rms_um, rel=0.01)
            assert one.dof_effective == pytest.approx(other.dof_effective, rel=0.02)
        assert view.rows.between_px2 == pytest.approx(kept.rows.between_px2, rel=0.02)
        assert view.k1_per_mm2[0] == pytest.approx(kept.k1_per_mm2[0], abs=0.1 * kept.k1_per_mm2[1])
        assert view.rejected == kept.rejected


def test_one_pair_of_frames_tells_the_jitter(run, again) -> None:
    """3 ns from 78 rows of one frame within 4.9 u; catches 40 %. The lying lines of the same grabber have nothing in common."""
    along_x = Sampling(PIXEL_NS, AVERAGED, run.gain)
    found = again[3.0].rows.jitter(along_x)["jitter_ns"]
    assert found.kind == "value" and abs(found.value - 3.0) < norm.isf(RATE / 2) * found.u < 1.3
    assert again[3.0].columns.jitter(Sampling(PIXEL_NS, AVERAGED))["jitter_ns"].value < 1.0
    assert again[0.0].rows.jitter(along_x)["jitter_ns"].value < 0.6


def test_the_grabber_shifts_rows_by_what_was_drawn() -> None:
    """Two frames that differ only in the jitter, against the truth of the chain: gain within 3 %, hardly anything else in between."""
    camera, scene, seed = frames.camera_of(QUICK, 5.0), frames.scene_of(QUICK, False), 77
    both = (camera, frames.camera_of(QUICK, 0.0))
    shaken, still = (frames.locate(c.expose(scene, 1, seed, threads=1, temperature_c=40.0).data[0], False) for c in both)
    told = camera.truth(0, seed)["grabber.line_jitter"]["row_shift_px"][0]
    rows = shaken.y_px[0].astype(int)
    drawn = -np.mean([told[rows + k] for k in (-1, 0, 1)], axis=0)
    moved = shaken.x_px - still.x_px
    slope = float(np.sum(moved * drawn) / np.sum(np.broadcast_to(drawn, moved.shape) ** 2))
    assert abs(slope) == pytest.approx(experiment.delay_gain(QUICK[0]), rel=0.03)
    assert np.std(moved - slope * drawn) < 0.35 * np.std(moved)


def test_the_gain_is_that_of_the_amplifier() -> None:
    """T Σ h((m + ½) T) of a low-pass of second order, 8 MHz, damping 0.7: the slope of a line as it is sampled, over that of the line."""
    w, d, t = 2 * np.pi * 8e6, 0.7, (np.arange(12) + 0.5) * PIXEL_NS * 1e-9
    ringing = w * np.sqrt(1 - d**2)
    gain = PIXEL_NS * 1e-9 * np.sum(w**2 / ringing * np.exp(-d * w * t) * np.sin(ringing * t))
    assert experiment.delay_gain(2) == pytest.approx(gain, rel=0.08)  # of a broad line; these are a few pixels wide
    assert gain == pytest.approx(1.297, abs=0.002)


def test_stored_is_the_whole_experiment(run) -> None:
    assert tuple(level.jitter_ns for level in run.levels) == JITTERS_NS
    assert set(run.views) == {key(view, ns) for view in VIEWS for ns in JITTERS_NS}
    for level in run.levels:
        assert (level.views, level.x.lines, level.y.lines) == (27, 216, 216)
        assert level.x.n + level.y.n + level.rejected == 2 * 27 * 640
        assert level.x.dof + level.y.dof == pytest.approx(level.x.n + level.y.n - 27 * (2 * 16 + 4), abs=0.5)


@pytest.mark.parametrize("way", ["axes", "rows", "repeated"])
def test_the_jitter_is_found_within_its_uncertainty(way, run) -> None:
    """Each level within 4.9 u and 2 % for the mean gain of three distances; together by χ²."""
    z = []
    for level in run.levels[1:]:
        e = level.jitters(run.gain)[way]["jitter_ns"]
        assert e.kind == "value" and e.u < 0.07 * level.jitter_ns
        z.append((e.value - level.jitter_ns) / np.hypot(e.u, 0.02 * level.jitter_ns))
    assert np.abs(z).max() < norm.isf(RATE / 2) and np.sum(np.square(z)) < chi2.isf(RATE, 4)
    none = run.levels[0].jitters(run.gain)[way]["jitter_ns"]
    assert none.value < 0.4
    assert none.kind == "upper_limit" or none.value < norm.isf(RATE) * none.u  # one run in twenty shows something where nothing is


def test_lying_lines_have_no_jitter(run) -> None:
    for level in run.levels:
        check = level.jitters(run.gain)["columns"]["jitter_ns"]
        assert check.kind == "upper_limit" and check.value < 0.15
        assert level.y.rms_px == pytest.approx(run.levels[0].y.rms_px, rel=0.05)


def test_residuals_grow_as_the_averaged_rows_shake(run) -> None:
    """s_x² = noise + (gain σ/T)²/3, whose row part has 27 · 78 degrees of freedom; 3 % for what the gain varies over the distances."""
    own = run.levels[0].x.rms_px
    for level in run.levels[1:]:
        wanted = np.hypot(own, run.gain * level.jitter_ns / PIXEL_NS / np.sqrt(AVERAGED))
        assert level.x.rms_px == pytest.approx(wanted, rel=norm.isf(RATE / 2) / np.sqrt(2 * 27 * 78) + 0.03)


def test_f_test_is_one_sided_and_states_what_it_takes_for_independent(run) -> None:
    none, one = run.levels[0].f_test, run.levels[1].f_test
    assert none.side == "x above y" and none.critical_95["lines"] == pytest.approx(1.2515, abs=0.001)
    assert none.p_px["lines"] > 0.05 and one.p_px["lines"] < 1e-6 and one.p_um["lines"] < 1e-6
    assert none.ratio_um2 / none.ratio_px2 == pytest.approx((8.6 / 8.3) ** 2, rel=0.01)
    for level in run.levels:
        d = level.f_test.dof
        assert d["lines"] == (216.0, 216.0)
        assert all(216 < effective <= every < 17_280 for effective, every in zip(d["effective"], d["positions"], strict=True))


def test_the_bow_of_the_sensor_is_taken_for_a_lens() -> None:
    """With a flat sensor K1 is the lens' own, within 5 u; the chain's bow shifts it by several."""
    found = {}
    for flat in (False, True):
        camera = frames.camera_of(QUICK, 0.0)
        camera = camera.switched(off=["sensor.unflatness"]) if flat else camera
        shown = [camera.expose(frames.scene_of(QUICK, k == 1), 1, 5 + k, threads=1, temperature_c=40.0).data[0] for k in (0, 1)]
        pair = [frames.locate(frame, k == 1) for k, frame in enumerate(shown)]
        x, y = (np.concatenate([getattr(p, name).ravel() for p in pair]) for name in ("x_px", "y_px"))
        wire, image = np.tile(np.repeat(np.arange(8), 80), 2), np.repeat([0, 1], 640)
        found[flat] = calibrate_lines(x, y, wire, image, frames.sensor()).estimates["k1_per_mm2"]
    true = LENSES[QUICK[2]]["k1_per_mm2"]
    assert abs(found[True].value - true) < norm.isf(RATE / 2) * found[True].u
    assert true - found[False].value > 5 * found[False].u


def test_record_is_read_back_as_it_was_written(run, tmp_path) -> None:
    path = tmp_path / "numbers.json"
    experiment.write(run, path)
    assert path.read_text(encoding="utf-8") == experiment.STORED.read_text(encoding="utf-8")


def test_a_planted_factor_is_seen(run) -> None:
    """A gain of 1 in place of the chain's, or rows taken as not averaged, misses the jitter by more than its uncertainty."""
    level = run.levels[3]
    for wrong in (Sampling(PIXEL_NS, AVERAGED, 1.0), Sampling(PIXEL_NS, 1, run.gain)):
        e = level.rows.jitter(wrong)["jitter_ns"]
        assert abs(e.value - level.jitter_ns) > norm.isf(RATE / 2) * e.u
    assert isinstance(level.rows, RowVariance)
