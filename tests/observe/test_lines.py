"""Upright lines row by row: against frames simulated without the package, with jitter, loop, motion, row noise and settling."""

from __future__ import annotations

import numpy as np
import pytest

from observe.row_pictures import bars, jitter
from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import LineRows
from pixmetry.camera.row_delays import added_delays, delays_ns
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.progress import no_progress
from pixmetry.observe.experiment import PictureGroup
from pixmetry.observe.line_jitter import with_jitter
from pixmetry.observe.lines import LineFrames, places_of_rows
from pixmetry.observe.stack import StackAccumulator

GAIN = 0.3
LIMIT = 5.5  # u; beyond it once in 3e7
THIN, BAR = [(40.0, 43.0), (80.0, 83.0)], [(50.0, 110.0)]


def followed(*frames: np.ndarray, recorded: bool | None = None, gain: float | None = GAIN) -> LineRows:
    groups = [
        PictureGroup("line", 0.0, GroupFacts(recorded=recorded), StackAccumulator(12), LineFrames(dict(enumerate(f))), 12) for f in frames
    ]
    return with_jitter(places_of_rows(groups, gain))


@pytest.mark.parametrize("at", [THIN, BAR], ids=["thin lines", "edges"])
def test_white_jitter_is_found_beyond_the_noise_of_the_pixels(rng: np.random.Generator, at):
    """0.06 px, with motion of 0.1 px between frames, row noise and PRNU; without the noise taken off it would be 0.07, 5 u more."""
    found = followed(bars(rng, jitter(rng, 12, 300, 0.06), at, row_noise=3.0))
    assert [line.kind for line in found.lines] == (["line", "line"] if at is THIN else ["edge", "edge"])
    white = found.jitter["white_px"]
    assert abs(white.value - 0.06) < LIMIT * white.u and white.u < 0.004
    assert found.jitter["loop_px"].kind == "upper_limit"


def test_each_shift_is_that_of_its_row_with_its_u(rng: np.random.Generator):
    """Against the drawn shifts; the mean square of z within 5.5 of its own scatter √(2/n)."""
    shift = jitter(rng, 8, 250, 0.1)
    (one, _) = followed(bars(rng, shift, BAR, motion=0.0)).lines
    true = shift[:, one.row] - shift[:, one.row].mean(axis=0)
    seen = one.shift_px - one.shift_px.mean(axis=1, keepdims=True)
    off = seen - (true - true.mean(axis=1, keepdims=True))
    slope = off @ (one.row - one.row.mean())  # the simulated turn of each frame
    off -= np.outer(slope, one.row - one.row.mean()) / ((one.row - one.row.mean()) ** 2).sum()
    z2 = (off / one.u_px).var() * 8 / 7 * len(one.row) / (len(one.row) - 2)
    assert abs(z2 - 1) < LIMIT * np.hypot(np.sqrt(2 / (7 * len(one.row))), one.u_rel)


@pytest.mark.parametrize("stride", [2, 1], ids=["interlaced", "progressive"])
def test_a_loop_is_told_from_white_jitter_and_fields_from_frames(rng: np.random.Generator, stride: int):
    found = followed(bars(rng, jitter(rng, 16, 320, 0.05, 0.12, 5.0, stride), THIN)).jitter
    for name, true in (("white_px", 0.05), ("loop_px", 0.12)):
        assert abs(found[name].value - true) < LIMIT * found[name].u
    assert abs(np.log(found["loop_rows"].value / 5.0)) < LIMIT * found["loop_rows"].u / 5.0
    assert found["interlaced"].value == float(stride == 2)


def test_without_jitter_there_are_limits(rng: np.random.Generator):
    """A wrong finding comes once in 1e4 draws (4 u): two pictures may not both have one."""
    parts = [followed(bars(rng, np.zeros((10, 200)), at)).jitter for at in (THIN, BAR)]
    assert any(part["white_px"].kind == "upper_limit" and part["white_px"].value < 0.04 for part in parts)
    assert all(part["settling_px"].kind == "upper_limit" for part in parts)


def test_the_first_rows_that_settle_are_seen_in_the_mean(rng: np.random.Generator):
    bend = 1.5 * np.exp(-(np.arange(320) // 2) / 8.0)
    found = followed(bars(rng, jitter(rng, 10, 320, 0.05), BAR, bend=bend)).jitter
    assert abs(found["settling_px"].value - 1.5) < LIMIT * found["settling_px"].u
    assert abs(found["settling_rows"].value - 8.0) < LIMIT * found["settling_rows"].u
    assert found["settling_px"].u < 0.25


def test_delays_are_in_the_time_of_the_samples(rng: np.random.Generator):
    """0.06 px of a grabber's own 10 MHz are 6 ns, not 4.2; its beat with the pixels looks as rows that settle."""
    bend = 1.5 * np.exp(-(np.arange(320) // 2) / 8.0)
    frames = [Frames("line", None, bars(rng, jitter(rng, 12, 320, 0.06), BAR, bend=bend))]
    facts = {"bits": 12, "name": "lines", "interface": "analogue", "pixel_clock_mhz": 14.1875}
    own, same = (
        measure_sources(observe_campaign(campaign_of_arrays(frames, **facts, **more), no_progress)[1])[0]["grabber.line_jitter"]
        for more in ({"sampling_clock_mhz": 10.0}, {})
    )
    assert abs(own["white_ns"].value - 6.0) < LIMIT * own["white_ns"].u
    assert same["white_ns"].value == pytest.approx(own["white_ns"].value / 1.41875)
    assert "settling_ns" not in own and "beat" in own.reasons["settling_ns"]
    assert "settling_ns" in same and any("sampling_clock_mhz" in c for c in same.confounders)


def test_bad_pictures_say_why(rng: np.random.Generator):
    few = followed(bars(rng, np.zeros((2, 80)), BAR))
    assert "take 2 more" in few.notes[0] and "take 2 more" in few.jitter.reasons["white_px"]
    bright = bars(rng, np.zeros((4, 80)), BAR)
    full = followed(np.where(bright > 500, 4095, bright))
    assert not full.lines and "clipped" in full.jitter.reasons["white_px"]
    close = followed(bars(rng, np.zeros((4, 80)), [(40.0, 43.0), (52.0, 55.0)]))
    assert not close.lines and "px away" in close.refused[0].reason
    empty = followed(np.full((4, 60, 60), 100, np.uint16) + rng.integers(0, 9, (4, 60, 60)).astype(np.uint16))
    assert not empty.lines and "no upright line" in empty.jitter.reasons["white_px"]


def test_the_shot_noise_of_a_line_is_doubtful_where_the_gain_is_not_known(rng: np.random.Generator):
    frames = bars(rng, jitter(rng, 8, 150, 0.02), THIN)
    known, unknown = followed(frames), followed(frames, gain=None)
    assert unknown.lines[0].u_rel > 10 * known.lines[0].u_rel
    assert unknown.jitter["white_px"].kind == "upper_limit"


def test_what_the_recorder_adds_is_the_difference_of_variances():
    direct = Estimates.from_rows(
        [("white_px", 0.03, 0.001, np.inf, "px"), ("loop_px", 0.02, 0.006, np.inf, "px")], limits=frozenset({"loop_px"})
    )
    played = Estimates.from_rows(
        [("white_px", 0.05, 0.001, np.inf, "px"), ("loop_px", 0.1, 0.002, np.inf, "px"), ("loop_rows", 9.0, 1.0, np.inf, "rows")]
    )
    added = added_delays(played, direct, where="storage.tape")
    assert added["white_px"].value == pytest.approx(0.04) and added["loop_px"].value == pytest.approx(0.1)
    assert added["white_px"].u == pytest.approx(np.hypot(0.05, 0.03) * 0.001 / 0.04)
    ns = delays_ns(added, {"white": "white_ns", "loop": "wow_ns", "loop_rows": "wow_rows"}, 20.0, where="storage.tape")
    assert ns.names == ("white_ns", "wow_ns", "wow_rows") and ns["white_ns"].value == pytest.approx(2.0) and ns.units[2] == "rows"
    with pytest.raises(MeasureError, match="needs the clock"):
        delays_ns(added, {"white": "white_ns"}, None, where="storage.tape")
