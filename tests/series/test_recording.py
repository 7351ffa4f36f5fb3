"""A recorder by one scene seen directly and recorded: real coders, and a tape that plain NumPy makes."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.signal import bessel

from pixmetry import assess, campaign_of_arrays
from pixmetry.assess.job import observe_campaign
from pixmetry.budget.parameters import with_estimates
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.errors import MeasureError
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames
from pixmetry.series import job
from pixmetry.series.recording import _way, bessel_gain, group_of, recordings_of
from pixmetry.sources.storage.video_codec import Coder, VideoCodec

SHAPE, CLOCK_MHZ = (160, 224), 14.2
ROWS, COLS = np.indices(SHAPE)


def texture(rng: np.random.Generator) -> np.ndarray:
    """A scene with soft steps both ways."""
    wave = 40 * np.sin(COLS / 9 + np.sin(ROWS / 17 + rng.uniform(0, 6)))
    return 120 + wave + 25 * (((COLS // 32) + (ROWS // 24)) % 2)


def seen(scene: np.ndarray, count: int, rng: np.random.Generator, noise: float = 3.0) -> list[np.ndarray]:
    return [np.clip(np.rint(scene + rng.normal(0, noise, scene.shape)), 0, 255).astype(np.uint8) for _ in range(count)]


@pytest.mark.parametrize(("control", "quality", "group"), [("qp", 20, 5), ("qp", 25, 7), ("qp", 22, 1), ("crf", 22, 7)])
def test_the_quantiser_and_the_group_of_a_coder(control: str, quality: int, group: int, rng: np.random.Generator) -> None:
    """A quantiser of 25 for all leaves as much noise here as one of 22 that follows the content."""
    pytest.importorskip("av")
    scene = texture(rng)
    coder = Coder(VideoCodec(codec="h264", control=control, quality=quality, group=group))
    recorded = [coder.follow(f) for f in seen(scene, 31, rng)][9:]  # from the middle of a group on
    fit = recordings_of(seen(scene, 12, rng), recorded).fit
    found = fit["quality"]
    assert abs(found.value - quality) <= 2 * found.u < 4
    assert (fit.settings["codec"], fit.settings["control"]) == ("h264", control)
    if group > 1:
        assert fit["group"].value == group
        assert fit["frame_correlation"].value > 5 * fit["frame_correlation"].u
    else:
        assert "does not freeze" in fit.reasons["group"]


def test_a_lossless_coder_is_not_found(rng: np.random.Generator) -> None:
    pytest.importorskip("av")
    scene = texture(rng)
    coder = Coder(VideoCodec(codec="ffv1"))
    groups = [
        Frames("recording", None, np.array(seen(scene, 12, rng))),
        Frames("recording", None, np.array([coder.follow(f) for f in seen(scene, 16, rng)]), facts=GroupFacts(recorded=True)),
    ]
    found = observe_campaign(campaign_of_arrays(groups, bits=8, name="a camera"), no_progress)[1]
    ratio = found.recordings.fit["noise_ratio"]
    assert abs(ratio.value - 1) < 6 * ratio.u < 0.1  # Student's t of 15 degrees
    with pytest.raises(MeasureError, match="loses nothing"):
        get_source("storage.video_codec").measure(found)
    with pytest.raises(MeasureError, match="digital"):
        get_source("storage.tape").measure(found)


def test_differences_to_pictures_coded_by_themselves_tell_the_group(rng: np.random.Generator) -> None:
    squares = 0.5 + 0.05 * rng.random(40)
    assert group_of(squares) is None
    squares[3::6] += 4
    assert group_of(squares) == 6


@pytest.mark.parametrize("quality", [18, 22])
def test_the_group_of_a_fine_coder_is_right_or_not_told(quality: int, rng: np.random.Generator) -> None:
    """Pictures coded by themselves hardly stand out: those that do not must not make the group twice as long."""
    pytest.importorskip("av")
    coder = Coder(VideoCodec(codec="h264", control="qp", quality=quality, group=5))
    scene = texture(rng)
    frames = np.array([coder.follow(f) for f in seen(scene, 24, rng)][2:], np.float32)
    assert group_of(0.5 * np.square(np.diff(frames, axis=0)).mean(axis=(1, 2))) in (5, None)


def test_what_is_no_recording_of_the_scene_is_refused(rng: np.random.Generator) -> None:
    scene = texture(rng)
    with pytest.raises(MeasureError, match="8 of each"):
        recordings_of(seen(scene, 12, rng), seen(scene, 3, rng))
    with pytest.raises(MeasureError, match="another scene"):
        recordings_of(seen(scene, 8, rng), seen(scene[::-1, ::-1].T[: SHAPE[0]].repeat(2, axis=1)[:, : SHAPE[1]], 8, rng))


def test_of_large_frames_the_middle_is_kept_from_the_border_of_a_block(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job, "RECORDED_SIDE", 128)
    frames = rng.integers(0, 40, (8, 200, 300), dtype=np.uint8) + (np.indices((200, 300)).sum(axis=0) % 200).astype(np.uint8)
    found = []
    for part in (frames, np.pad(frames[:, 32:160, 80:208], ((0, 0), (32, 40), (80, 92)))):
        fetch = [partial(part.__getitem__, k) for k in range(8)]
        found.append(job.measure_recordings(fetch, fetch, analogue=False, bits=8))
    assert len(found[0].step_px) == 128
    np.testing.assert_array_equal(found[0].difference_dn2, found[1].difference_dn2)


def test_frames_without_noise(rng: np.random.Generator) -> None:
    """Copies of one picture tell nothing; a recorder that freezes the picture altogether loses its noise."""
    scene = texture(rng)
    copies = [scene.astype(np.uint8)] * 8
    with pytest.raises(MeasureError, match="copies of one picture"):
        recordings_of(copies, seen(scene, 8, rng))
    fit = recordings_of(seen(scene, 8, rng), copies, depth_bits=12).fit
    assert fit["noise_ratio"].value == 0 and "more than 10 bits" in fit.reasons["quality"]


def test_the_gain_of_the_filter_is_that_of_scipy() -> None:
    f = np.linspace(0.01, 0.5, 30)
    zeros, poles, gain = bessel(3, 1.0, analog=True, output="zpk", norm="mag")
    expected = np.abs(gain / np.prod([1j * f / 0.2 - p for p in poles], axis=0))
    assert bessel_gain(f, 0.2) == pytest.approx(expected, rel=1e-6)


def test_a_frequency_at_which_blocks_of_rows_differ_counts_less(rng: np.random.Generator) -> None:
    """Exact contrasts of a filter, but one frequency in twelve is far off in each block, by 1 either way: with even weights ln b scatters
    by 0.4, with weights by a tenth of that."""
    frequency = np.linspace(0.02, 0.5, 12)
    zeros, poles, gain = bessel(3, 1.0, analog=True, output="zpk", norm="mag")
    exact = np.abs(gain / np.prod([1j * frequency / 0.3 - p for p in poles], axis=0))
    parts = np.tile(exact, (8, 1))
    parts[:, 4] += np.tile([1.0, -1.0], 4) * rng.uniform(0.9, 1.1, 8)
    found = _way(frequency, parts, np.ones(12), held=False)
    assert found is not None and np.exp(found.logarithm) == pytest.approx(0.3, rel=0.01) and found.u < 0.02


def test_a_block_that_shows_what_no_other_shows_is_left_out() -> None:
    """Its frequencies have no weight: a scale by them is 0/0, which was stored as a bandwidth."""
    frequency = np.linspace(0.02, 0.5, 12)
    parts = np.full((8, 12), np.nan)
    parts[:7, :6] = bessel_gain(frequency[:6], 0.3)
    parts[7, 6:] = bessel_gain(frequency[6:], 0.1)
    with np.errstate(all="raise"):
        found = _way(frequency, parts, np.ones(12), held=False)
    assert found is not None and found.count == 7 and np.exp(found.logarithm) == pytest.approx(0.3, rel=1e-3)


def played(scene: np.ndarray, count: int, tape: dict[str, float], rng: np.random.Generator) -> list[np.ndarray]:
    """Frames from a tape: rows through a Bessel filter without its delay, moved by their delays, with noise."""
    zeros, poles, gain = bessel(3, 2 * np.pi * tape["bandwidth_mhz"], analog=True, output="zpk", norm="mag")
    f = np.fft.rfftfreq(2 * SHAPE[1], 1 / CLOCK_MHZ)
    s = 2j * np.pi * f
    h = gain / np.prod([s - p for p in poles], axis=0) * np.exp(s * float(np.real(-1 / poles).sum()))
    spectrum = np.fft.rfft(np.concatenate([scene, scene[:, ::-1]], axis=1), axis=1) * h
    frames = []
    for _ in range(count):
        late_us = 1e-3 * rng.normal(0, tape["white_ns"], SHAPE[0])
        late_us[-2 * 6 :] += 1e-3 * tape["head_switch_ns"]
        moved = np.fft.irfft(spectrum * np.exp(-s * late_us[:, None]), 2 * SHAPE[1], axis=1)[:, : SHAPE[1]]
        frames.append(np.clip(np.rint(moved + rng.normal(0, tape["noise_dn"], SHAPE)), 0, 255).astype(np.uint8))
    return frames


def smooth_bars(rng: np.random.Generator) -> np.ndarray:
    """A line that a filter has smoothed, so that pixels show no steps."""
    bars = 30 + 150.0 * (rng.random((SHAPE[0] // 8, SHAPE[1] // 4)) < 0.5).repeat(8, axis=0).repeat(4, axis=1)
    soft = np.exp(-0.5 * (np.arange(-4, 5) / 0.6) ** 2)
    return np.apply_along_axis(np.convolve, 1, np.pad(bars, ((0, 0), (4, 4)), mode="edge"), soft / soft.sum(), "valid")


def test_the_bandwidth_of_a_tape_behind_a_smooth_line(rng: np.random.Generator) -> None:
    scene = smooth_bars(rng)
    tape = {"bandwidth_mhz": 4.5, "white_ns": 0.0, "head_switch_ns": 0.0, "noise_dn": 1.0}
    fit = recordings_of(seen(scene, 10, rng, noise=0.7), played(scene, 16, tape, rng), analogue=True).fit
    found = fit["bandwidth_rel"]
    assert abs(found.value * CLOCK_MHZ / 4.5 - 1) < 6 * found.u / found.value < 0.15


def test_time_base_and_noise_of_a_tape(rng: np.random.Generator, tmp_path) -> None:
    """White noise in place of a tape's: its standard deviation is what is told.

    At this bandwidth the contrast of a staircase and of a smooth line are alike, and no bandwidth is told.
    """
    scene = smooth_bars(rng)
    tape = {"bandwidth_mhz": 3.0, "white_ns": 8.0, "head_switch_ns": 60.0, "noise_dn": 3.0}
    groups = [
        Frames("recording", None, np.array(seen(scene, 10, rng, noise=0.7))),
        Frames("recording", None, np.array(played(scene, 16, tape, rng)), facts=GroupFacts(recorded=True)),
    ]
    campaign = campaign_of_arrays(groups, bits=8, name="a camera", interface="analogue", pixel_clock_mhz=CLOCK_MHZ)
    found = assess(campaign, tmp_path / "out", trials=0)
    told = found.estimates["storage.tape"]
    assert "bandwidth_mhz" not in told
    assert "not clearly that of a staircase" in (tmp_path / "out" / "report.html").read_text()
    for name, truth in tape.items():
        if name == "bandwidth_mhz":
            continue
        u = float(np.hypot(told[name].u, 0.01 * truth))
        assert abs(told[name].value - truth) < 6 * u < 0.6 * truth, (name, told[name])
    assert told.settings["head_switch_rows"] == 6
    source = get_source("storage.tape")
    assert with_estimates(source, source.neutral, told).generations == 1
    assert "told from the tape" in found.unmeasured["storage.video_codec"]
    assert "The recorder" in (tmp_path / "out" / "report.html").read_text()
