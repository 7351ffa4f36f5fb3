"""Blur, order of rows and pulses of light of moving targets, in frames that plain NumPy made."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from pixmetry import campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.budget.parameters import with_estimates
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames
from pixmetry.series.blur import Look, exposure_of

SHAPE, PERIOD_S, REACH = (114, 180), 0.04, 26
PLATE = np.stack(np.meshgrid([38.2, 88.6, 139.9], [34.3, 78.1]), axis=-1).reshape(-1, 2)
RATE = 1e-6


def disc(x: np.ndarray, y: np.ndarray, radius: float = 4.0, soft: float = 0.9) -> np.ndarray:
    """A disc with a soft edge, by the distance to its outline; the pixel's average is part of the softness."""
    return ndtr((radius - np.hypot(x, y)) / soft)


def frame_of(places: np.ndarray, velocity: np.ndarray, times: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A frame of discs that are at ``places`` at time 0, with rows that look at their own times: shape (rows, n) of times and weights."""
    grey = np.full(SHAPE, 25.0)
    for place in places:
        col, row = (max(int(v) - REACH, 0) for v in place)
        there = slice(row, row + 2 * REACH + 1), slice(col, col + 2 * REACH + 1)
        y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]][(slice(None), *there)]
        for t, w in zip(times[there[0]].T[..., None], weights[there[0]].T[..., None], strict=True):
            grey[there] += 150 * w * disc(x - place[0] - velocity[0] * t, y - place[1] - velocity[1] * t)
    return np.clip(np.rint(grey + rng.normal(0, 1.2, SHAPE)), 0, 255).astype(np.uint8)


def looks_of(
    begun_s: float, exposure_s: float, field_s: float = 0.0, row_s: float = 0.0, points: int = 12
) -> tuple[np.ndarray, np.ndarray]:
    """Times at which the rows look, and weights."""
    rows = np.arange(SHAPE[0])
    start = begun_s + field_s * (rows % 2) + row_s * rows
    longer = exposure_s / np.sqrt(1 - points**-2)  # so many points have the variance of a shorter exposure
    middle = start[:, None] + 0.5 * exposure_s
    return middle + longer * ((np.arange(points) + 0.5) / points - 0.5), np.full((SHAPE[0], points), 1 / points)


def runs_of(
    rng: np.random.Generator, exposure_s: float, velocities, frames: int = 6, stated_s: float | None = None, **when: float
) -> list[Frames]:
    groups = []
    for velocity in velocities:
        v, shift = np.array(velocity), rng.uniform(-3, 3, 2)
        begun = (np.arange(frames) - (frames - 1) / 2) * PERIOD_S
        data = np.array([frame_of(PLATE + shift, v, *looks_of(t, exposure_s, **when), rng) for t in begun])
        groups.append(Frames("motion", exposure_s if stated_s is None else stated_s, data, facts=GroupFacts(interval_s=PERIOD_S)))
    return groups


def measured(groups: list[Frames]):
    return observe_campaign(campaign_of_arrays(groups, bits=8, name="a camera"), no_progress)[1]


AT_REST, RIGHT, LEFT, DOWN = (0.0, 0.0), (120.0, 5.0), (-120.0, 0.0), (0.0, 120.0)


@pytest.mark.parametrize("when", [{}, {"field_s": 0.02}, {"row_s": 60e-6}], ids=["global", "interlaced", "rolling"])
def test_the_length_of_the_exposure(when: dict[str, float], rng: np.random.Generator) -> None:
    exposure_s = 0.02  # 2.4 px
    seen = measured(runs_of(rng, exposure_s, (AT_REST, RIGHT, DOWN) + (LEFT,) * ("row_s" in when), 4, stated_s=0.025, **when))
    found = seen.motion.fit["exposure_s"]
    assert abs(found.value - exposure_s) < 6 * found.u < 0.03 * exposure_s
    length = get_source("sensor.exposure").measure(seen)
    assert length["length_rel"].value == pytest.approx(found.value / 0.025)
    assert with_estimates(get_source("sensor.exposure"), get_source("sensor.exposure").neutral, length).nodes > 1


def test_without_a_stated_exposure_the_length_is_told_but_enters_no_camera(rng: np.random.Generator) -> None:
    seen = measured(runs_of(rng, 0.02, (AT_REST, RIGHT), 4, stated_s=0.0))
    assert not seen.motion.fit["exposure_s"].is_limit
    assert "state exposure_s" in measure_sources(seen)[1]["sensor.exposure"]


def test_a_run_at_rest_needs_no_stated_exposure_but_all_that_move_do(rng: np.random.Generator) -> None:
    moving = runs_of(rng, 0.02, (RIGHT,), 4)
    rest, down = (runs_of(rng, 0.02, (v,), 4, stated_s=0.0) for v in (AT_REST, DOWN))
    seen = measured([*rest, *moving])
    length = get_source("sensor.exposure").measure(seen)["length_rel"]
    assert abs(length.value - 1) < 6 * length.u
    assert "state it for all" in measured([*rest, *moving, *down]).motion.fit.reasons["exposure_s"]


def test_what_frames_do_not_tell_of_the_exposure(rng: np.random.Generator) -> None:
    one_blur = measured(runs_of(rng, 0.01, (RIGHT, LEFT), frames=4)).motion.fit
    assert "blurred alike" in one_blur.reasons["exposure_s"] and "exposure_s" not in one_blur
    short = measured(runs_of(rng, 2e-4, (AT_REST, RIGHT), frames=4)).motion.fit["exposure_s"]
    assert short.is_limit and 2e-4 < short.value < 6e-3 and "too slow" in short.reason


def test_squares_of_the_path_scatter_about_the_truth_as_their_u_says(rng: np.random.Generator) -> None:
    """Fourteen cameras, of which every other one exposes for an instant: limits hold, values have chi squared."""
    square = 0.0
    for k in range(14):
        path = (2.0, 0.0)[k % 2]
        targets = []
        for _ in range(4):
            looks = []
            for speed in (0.0, 100.0):
                for _ in range(5):
                    place = 15 + rng.uniform(-0.5, 0.5, 2)
                    y, x = np.indices((31, 31))
                    grey = 25 + 150 * np.mean(
                        [disc(x - place[0] - s * speed / 100, y - place[1]) for s in path * (np.arange(12) - 5.5) / 12], axis=0
                    )
                    values = np.rint(grey + rng.normal(0, 1.2, grey.shape))
                    looks += [Look(values, parity, place + rng.normal(0, 0.02, 2), np.array([speed, 0.0])) for parity in (0, 1)]
            targets.append(looks)
        found = exposure_of(targets)["exposure_s"]
        truth = path / 100
        if path:
            assert not found.is_limit
            square += ((found.value - truth * np.sqrt(1 - 12**-2)) / found.u) ** 2
        else:
            assert found.is_limit or found.value < 7 * found.u
    low, high = stats.chi2.ppf([RATE / 2, 1 - RATE / 2], 7)
    assert low < square < high


def test_rows_that_a_grabber_swaps_are_told_by_targets_at_rest(rng: np.random.Generator) -> None:
    groups = runs_of(rng, 1e-3, (AT_REST, RIGHT), frames=4, field_s=0.02)
    swapped = [Frames("motion", g.exposure_s, g.data[:, np.arange(SHAPE[0]) ^ 1], facts=g.facts) for g in groups]
    for own, told in ((groups, False), (swapped, True)):
        seen = measured(own)
        settings = get_source("sensor.read_out").measure(seen).settings
        assert bool(settings["swapped"]) is told
        period = seen.motion.fit["field_period_s"]
        assert abs(period.value - 0.02) < 6 * period.u < 0.002


def test_single_fields_in_turn_are_told_by_targets_at_rest(rng: np.random.Generator) -> None:
    y, x = np.indices(SHAPE)
    frames = []
    for k in range(8):  # the same targets seen in rows that lie half a row higher every other time
        grey = 25 + 150 * sum(disc(x - px, y - py + 0.5 * (k % 2)) for px, py in PLATE)
        frames.append(np.rint(grey + rng.normal(0, 1.2, SHAPE)).astype(np.uint8))
    seen = measured([Frames("motion", 1e-3, np.array(frames), facts=GroupFacts(interval_s=PERIOD_S))])
    assert get_source("sensor.read_out").measure(seen).settings == {"mode": "field", "field": "alternating"}


@pytest.mark.parametrize("swapped", [False, True])
def test_two_pulses_of_light_and_the_steady_light_beside_them(swapped: bool, rng: np.random.Generator) -> None:
    exposure_s, apart_s, share = 0.02, 2e-3, 0.2
    steady = runs_of(rng, exposure_s, (AT_REST, RIGHT, DOWN), 4, field_s=0.02)
    pulsed = []
    for velocity in (RIGHT, DOWN):
        shift, frames = rng.uniform(-3, 3, 2), []
        for begun in (np.arange(5) - 2) * PERIOD_S:
            times, weights = looks_of(begun, exposure_s, field_s=0.02)
            flash = begun + exposure_s + apart_s * (np.arange(SHAPE[0]) % 2 - 0.5)
            times, weights = np.column_stack([times, flash]), np.column_stack([share * weights, np.full(SHAPE[0], 1 - share)])
            frames.append(frame_of(PLATE + shift, np.array(velocity), times, weights, rng))
        pulsed.append(Frames("motion", exposure_s, np.array(frames), facts=GroupFacts(interval_s=PERIOD_S, pulsed=True)))
    rows = np.arange(SHAPE[0]) ^ swapped
    steady, pulsed = ([Frames("motion", g.exposure_s, g.data[:, rows], facts=g.facts) for g in groups] for groups in (steady, pulsed))
    fit = measured([*steady, *pulsed]).motion.fit
    for name, truth in (("separation_s", apart_s), ("ambient_share", share)):
        assert abs(fit[name].value - truth) < 7 * fit[name].u < truth, name  # Student's t of 8 degrees
    alone = measured(pulsed).motion.fit
    assert "not separable" in alone.reasons["separation_s"] and "without" in alone.reasons["field_period_s"]


def test_the_two_fields_of_one_frame_tell_the_speed(rng: np.random.Generator) -> None:
    """The chapter's note 4: a target moves by v T between the fields, so their distance over the known period is the speed."""
    period_s, velocity = 0.02, np.array([130.0, 40.0])
    seen = measured(runs_of(rng, 5e-3, (tuple(velocity),), frames=4, field_s=period_s))
    speed, u = seen.motion.lag_px / period_s, seen.motion.u_lag_px / period_s
    assert np.abs((speed - velocity) / np.hypot(u, 0.02 / period_s)).max() < 6  # a place differs by up to 0.02 px from field to field
    assert np.abs(speed.mean(axis=0) - velocity).max() < 2.0
