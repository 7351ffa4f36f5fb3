"""Border of the image and beat of two clocks, against frames made without the package."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.progress import no_progress
from pixmetry.observe.active_area import active_area

PIXEL_MHZ = 14.1875


def sampled(
    rng: np.random.Generator,
    ratio: float,
    *,
    cols=300,
    rows=120,
    left=14.3,
    top=6,
    shape=(140, 480),
    beat=0.5,
    black=20.0,
    noise=1.0,
    frames=8,
) -> np.ndarray:
    """Frames of a staircase of pixels, smoothed as by a line, with feed-through of the pixel clock, sampled at ``ratio`` × its clock."""
    fine = 16
    time = np.arange(-60 * fine, (cols + 400) * fine) / fine  # in pixels
    image = np.where((time >= 0) & (time < cols), 120 + 6 * np.sin(2 * np.pi * time / cols), 0.0)
    image = np.convolve(image, np.ones(fine) / fine, mode="same") + (image > 0) * beat * np.sin(2 * np.pi * time)
    at = (np.arange(shape[1]) + 0.5 - left) / ratio
    line = np.interp(at, time, image)
    out = np.full((frames, *shape), 20.0)
    out[:, top : top + rows] += line
    return np.clip(np.rint(out + noise * rng.standard_normal(out.shape)), 0, 255).astype(np.uint8)


def facts(**kw) -> StatedFacts:
    return StatedFacts(**{"interface": "analogue", "pixel_clock_mhz": PIXEL_MHZ, "sensor_cols": 300, "sensor_rows": 120} | kw)


@pytest.mark.parametrize("clock_mhz", [10.0, 12.5, 17.734475])
def test_recovers_the_sampling_clock_from_the_beat(clock_mhz: float, rng: np.random.Generator):
    """Five u: less than 1e-6 by chance. u is below 3e-5, a hundredth of that of the width."""
    ratio = clock_mhz / PIXEL_MHZ
    found = active_area(sampled(rng, ratio).mean(axis=0), 8, facts())
    clock = found.fit["clock_mhz"]
    assert abs(clock.value - clock_mhz) < 5 * clock.u and clock.u / clock_mhz < 3e-5
    start = found.fit["start_ns"]
    assert abs(start.value + 1e3 * 14.3 / clock_mhz) < 2 * start.u
    assert found.fit["row_offset"].value == -6 and "col_offset" not in found.fit


def test_without_a_beat_the_width_tells_the_ratio(rng: np.random.Generator):
    """u of the width covers the ends of the line: half a sample each. The error is half of it, the same in every draw to 1 % of that."""
    found = active_area(sampled(rng, 10 / PIXEL_MHZ, beat=0.0).mean(axis=0), 8, facts())
    ratio = found.fit["clock_ratio"]
    assert "no line" in ratio.reason and abs(ratio.value - 10 / PIXEL_MHZ) < ratio.u


def test_line_of_another_oscillator_is_not_taken_for_the_beat(rng: np.random.Generator):
    frames = sampled(rng, 10 / PIXEL_MHZ, beat=0.0).mean(axis=0)
    frames[:, 15:] += 0.6 * np.sin(2 * np.pi * 0.3111 * np.arange(frames.shape[1] - 15))
    ratio = active_area(frames, 8, facts()).fit["clock_ratio"]
    assert "does not fit" in ratio.reason and abs(ratio.value - 10 / PIXEL_MHZ) < ratio.u


def digital(rng: np.random.Generator, shape, top, left, rows, cols, noise=1.0) -> np.ndarray:
    frame = np.full(shape, 16.0)
    v, u = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    frame[top : top + rows, left : left + cols] += 120 * (1 - 0.15 * (u**2 + v**2))
    return np.clip(np.rint(frame + noise * rng.standard_normal((2, *shape))), 0, 255).astype(np.uint8)


def test_offsets_are_whole_pixels_and_reach_the_sources(rng: np.random.Generator, tmp_path):
    frames = digital(rng, (150, 220), 9, 13, 120, 190)
    camera = {"bits": 8, "interface": "analogue", "pixel_clock_mhz": PIXEL_MHZ, "sensor_cols": 190, "sensor_rows": 120}
    _, seen = observe_campaign(campaign_of_arrays([Frames("border", None, frames[:, :120, :190])], name="cut", **camera), no_progress)
    assert seen.area is not None
    campaign = campaign_of_arrays([Frames("border", None, frames)], name="whole", bits=8, interface="analogue")
    found = assess(campaign, tmp_path / "result", trials=0)
    window = found.estimates["grabber.window_offset"]
    assert (window["row_offset"].value, window["col_offset"].value) == (-9, -13)
    assert "sensor_cols" in found.unmeasured["grabber.sampling_clock"]
    assert "Black borders end at" in (tmp_path / "result" / "report.html").read_text()
    assert found.to_record()["active_area"]["top"] == pytest.approx(9, abs=0.3)


def test_sides_without_border_and_missing_rows_are_told(rng: np.random.Generator):
    inside = active_area(digital(rng, (150, 220), 0, 0, 120, 190).mean(axis=0), 2, facts(sensor_cols=190))
    assert "begins inside the image" in inside.fit.reasons["row_offset"] and "row_offset" not in inside.fit
    short = active_area(digital(rng, (150, 220), 9, 13, 110, 190).mean(axis=0), 2, facts(sensor_cols=190))
    assert "110 rows" in short.fit.reasons["row_offset"] and "row_offset" not in short.fit


def test_frame_without_border_is_refused_with_the_reason(rng: np.random.Generator):
    flat = np.clip(np.rint(120 + rng.standard_normal((2, 80, 90))), 0, 255).astype(np.uint8)
    _, seen = observe_campaign(campaign_of_arrays([Frames("border", None, flat)], bits=8, interface="analogue"), no_progress)
    _, unmeasured = measure_sources(seen)
    assert "no side of the frame is black" in unmeasured["grabber.window_offset"]
    assert "no side of the frame is black" in unmeasured["grabber.sampling_clock"]


@pytest.mark.parametrize("level", [0.0, 200.0])
def test_even_and_tiny_frames_have_the_reason_and_no_warning(level: float, recwarn: pytest.WarningsRecorder):
    assert "no side of the frame is black" in active_area(np.full((20, 30), level), 2, StatedFacts()).fit.reasons["clock_mhz"]
    bright = np.zeros((20, 30))
    bright[3:-3, 4:-4] = 200.0
    assert active_area(bright, 2, StatedFacts(sensor_cols=22)).fit["clock_ratio"].value == pytest.approx(1.0)
    assert not recwarn.list
