"""Moving targets: fields, rolling shutter and trigger, from places and from frames, against what made them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pixmetry import assess, campaign_of_arrays
from pixmetry.budget.parameters import with_estimates
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.files.in_memory import Frames
from pixmetry.series.motion import Run, motion_of
from pixmetry.series.track import FrameTargets

PLACES = np.stack(np.meshgrid(np.linspace(100, 500, 5), np.linspace(60, 420, 4)), axis=-1).reshape(-1, 2)
VELOCITIES = ((0.0, 0.0), (300.0, 20.0), (-300.0, 0.0), (0.0, 250.0))
PERIOD_S, FRAMES, U_PX = 0.04, 12, 0.01
CAMERAS = 16
RATE = 1e-6


def seen_at(places: np.ndarray, velocity: tuple[float, float], time_s: float, row_s: float) -> np.ndarray:
    """Places at which targets are seen that were at ``places`` at time 0, by rows that are exposed one after the other."""
    y = (places[:, 1] + velocity[1] * time_s) / (1 - velocity[1] * row_s)
    return np.column_stack([places[:, 0] + velocity[0] * (time_s + row_s * y), y])


def runs_of(rng: np.random.Generator, field_s: float, row_s: float, jitter_s: float = 0.0, velocities=VELOCITIES) -> list[Run]:
    runs = []
    for velocity in velocities:
        fields: tuple[list, list] = ([], [])
        start = PLACES + rng.uniform(-30, 30, 2) - np.array(velocity) * PERIOD_S * FRAMES / 2
        for k in range(FRAMES):
            begun = k * PERIOD_S + rng.normal(0, jitter_s) if jitter_s else k * PERIOD_S
            for parity in (0, 1):
                found = seen_at(start, velocity, begun + parity * field_s, row_s) + rng.normal(0, U_PX, PLACES.shape)
                covariance = np.broadcast_to(np.eye(2) * U_PX**2, (len(PLACES), 2, 2))
                fields[parity].append(FrameTargets(str(k), k * PERIOD_S, found, covariance))
        runs.append(Run(tuple(fields[0]), tuple(fields[1])))
    return runs


@pytest.mark.parametrize(("name", "sizes"), [("field_period_s", (0.02, -0.02)), ("row_time_s", (15e-6, -15e-6))])
def test_times_are_found_with_their_uncertainty(name: str, sizes: tuple[float, float], rng: np.random.Generator) -> None:
    scores = []
    for k in range(CAMERAS):
        truth = {"field_period_s": 0.0, "row_time_s": rng.choice([0.0, 10e-6])} | {name: sizes[k % 2]}
        if name == "row_time_s":
            truth["field_period_s"] = rng.choice([0.0, 0.02])
        jitter_s = 3e-4 if name == "field_period_s" else 0.0  # which makes the velocities uncertain
        found = motion_of(runs_of(rng, truth["field_period_s"], truth["row_time_s"], jitter_s), (480, 640)).fit[name]
        assert not found.is_limit
        assert ("even" in found.reason or "top" in found.reason) == (truth[name] > 0)
        scores.append((found.value - abs(truth[name])) / found.u)
    low, high = stats.chi2.ppf([RATE / 2, 1 - RATE / 2], CAMERAS)
    assert low < np.square(scores).sum() < high, np.round(scores, 2)


def test_a_camera_without_them_has_limits_that_hold(rng: np.random.Generator) -> None:
    found = motion_of(runs_of(rng, 0.0, 0.0), (480, 640)).fit
    for name, most in (("field_period_s", 5e-5), ("row_time_s", 3e-7), ("jitter_s", 1e-4)):
        number = found[name]  # a value in 3 of 1000 cameras without it
        assert number.value < most and (number.is_limit or number.value < 6 * number.u)


def test_the_jitter_of_a_trigger(rng: np.random.Generator) -> None:
    jitter_s = 4e-4
    found = motion_of(runs_of(rng, 0.0, 0.0, jitter_s), (480, 640)).fit["jitter_s"]
    dof = 3 * (FRAMES - 3)
    low, high = np.sqrt(stats.chi2.ppf([RATE / 2, 1 - RATE / 2], dof) / dof)
    assert 0.95 * low * jitter_s < found.value < 1.05 * high * jitter_s and not found.is_limit


def test_one_velocity_does_not_tell_the_row_time(rng: np.random.Generator) -> None:
    found = motion_of(runs_of(rng, 0.02, 15e-6, velocities=((300.0, 0.0),)), (480, 640)).fit
    assert "one velocity" in found.reasons["row_time_s"] and "row_time_s" not in found
    assert found["field_period_s"].value == pytest.approx(0.02, rel=1e-2)


def test_targets_at_rest_tell_nothing(rng: np.random.Generator) -> None:
    found = motion_of(runs_of(rng, 0.02, 15e-6, velocities=((0.0, 0.0), (0.0, 0.0))), (480, 640)).fit
    assert found.names == ("rows_swapped_px",)
    assert all("move" in why for name, why in found.reasons.items() if name not in found)
    with pytest.raises(MeasureError, match="no run"):
        motion_of([Run((), ())], (480, 640))


def frame_at(start: np.ndarray, velocity: tuple[float, float], begun_s: float, field_s: float, row_s: float, rng: np.random.Generator):
    """A frame of soft discs whose rows are exposed at their own times, averaged over each pixel."""
    shape = (140, 190)
    rows = np.arange(shape[0])
    time_s = begun_s + field_s * (rows % 2) + row_s * rows
    fine = (np.arange(3) - 1) / 3
    grey = np.full(shape, 20.0)
    for x, y in start:
        px, py = x + velocity[0] * time_s, y + velocity[1] * time_s
        across = np.arange(shape[1])[None, :, None, None] + fine[None, None, None] - px[:, None, None, None]
        along = rows[:, None, None, None] + fine[None, None, :, None] - py[:, None, None, None]
        grey += (150 / (1 + np.exp(2.5 * (np.hypot(across, along) - 6)))).mean(axis=(2, 3))
    return np.clip(np.rint(grey + rng.normal(0, 1.2, shape)), 0, 255).astype(np.uint8)


def test_frames_of_a_campaign_tell_fields_and_rows(rng: np.random.Generator, tmp_path) -> None:
    start = np.stack(np.meshgrid([45.2, 94.6, 143.9], [28.3, 70.1, 111.6]), axis=-1).reshape(-1, 2)
    start = start + np.column_stack([np.arange(9) * 0.3 % 1, np.arange(9) * 0.7 % 1])
    groups = []
    for velocity in ((0.0, 0.0), (80.0, 0.0), (-80.0, 0.0)):
        begun = (np.arange(5) - 2) * PERIOD_S
        frames = np.array([frame_at(start, velocity, t, 0.02, 100e-6, rng) for t in begun])
        groups.append(Frames("motion", None, frames, facts=GroupFacts(interval_s=PERIOD_S)))
    found = assess(campaign_of_arrays(groups, bits=8, name="a camera", pitch_um=5.0), tmp_path / "out", trials=0)
    assert found.estimates["sensor.interlace"]["field_period_s"].value == pytest.approx(0.02, rel=0.03)
    row = found.estimates["sensor.rolling_shutter"]["row_time_s"]
    assert abs(row.value - 100e-6) < 6 * row.u < 60e-6
    assert "sensor.trigger_jitter" in {**found.estimates, **found.unmeasured}
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Moving targets" in page and "the even rows are exposed first" in page


def test_the_order_of_the_rows_enters_the_camera(rng: np.random.Generator) -> None:
    seen = Observations(motion=motion_of(runs_of(rng, -0.02, -15e-6), (480, 640)))
    for name, key, value in (("interlace", "first_field", "odd"), ("rolling_shutter", "first_row", "bottom")):
        source = get_source(f"sensor.{name}")
        assert getattr(with_estimates(source, source.neutral, source.measure(seen)), key) == value


def test_a_frame_that_shows_nothing_costs_no_other(rng: np.random.Generator) -> None:
    empty = FrameTargets("3", 3 * PERIOD_S, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    runs = [Run((*r.even[:3], empty, *r.even[4:]), (*r.odd[:3], empty, *r.odd[4:])) for r in runs_of(rng, 0.02, 0.0)]
    found = motion_of(runs, (480, 640))
    assert found.frames == len(VELOCITIES) * (FRAMES - 1)
    assert "jitter_s" in found.fit and not found.fit["field_period_s"].is_limit
    still = [
        Run(*(tuple(FrameTargets(f.name, 0.0, f.positions_px, f.covariance_px2) for f in side) for side in (r.even, r.odd))) for r in runs
    ]
    with pytest.raises(MeasureError, match="same time"):
        motion_of(still, (480, 640))
