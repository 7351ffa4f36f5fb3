"""Warm-up of cameras and frame grabbers from positions over time, blind, against what made them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from tests.series.fixed_field import CENTRE, CLOCK_MHZ, PLACES, SHAPE, TIME_S, Warming, camera_of

from pixmetry.core.errors import MeasureError
from pixmetry.series.modes import field_motion, focus_motion
from pixmetry.series.warm_up import drift_of

CAMERAS = 24
RATE = 1e-6  # of a false failure of one test
LINEAR = ("shift_y_px", "scale_rel", "rotation_rad")


def drift(camera: Warming, rng: np.random.Generator, *, analogue: bool = False, time_s: np.ndarray = TIME_S, u_px: float = 0.01, **options):
    positions, covariance = camera.positions(rng, u_px, time_s)
    motion = field_motion(positions, covariance, tuple(CENTRE), analogue=analogue)
    return drift_of(motion, time_s, SHAPE, clock_mhz=CLOCK_MHZ if analogue else None, **options)


def check_scores(scores: list[float], of: int) -> None:
    """Mean square of standardised errors: χ², beyond its quantile once in 10⁶. An u that is 30 % too small fails."""
    square = float(np.square(scores).sum())
    low, high = stats.chi2.ppf([RATE / of / 2, 1 - RATE / of / 2], len(scores))
    assert low < square < high, (square / len(scores), np.round(scores, 2))


def test_digital_cameras_are_found_with_their_uncertainty(rng: np.random.Generator) -> None:
    scores: dict[str, list[float]] = {name: [] for name in LINEAR}
    for _ in range(CAMERAS):
        camera = camera_of(rng)
        found = drift(camera, rng).fit
        for name in LINEAR:
            if name in found and name not in found.limits:
                scores[name].append((found[name].value - getattr(camera, name)) / found[name].u)
    for some in scores.values():
        assert len(some) > 0.8 * CAMERAS
        check_scores(some, len(LINEAR))


def test_frame_grabbers_are_found_beside_their_camera(rng: np.random.Generator) -> None:
    names = ("scale_error_rel", "shift_y_px", "scale_rel")
    scores: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(CAMERAS):
        late = {"scale_error_rel": rng.uniform(0.001, 0.007), "scale_tau_s": rng.uniform(400, 1200), "lock_us": rng.normal(10.5, 0.7)}
        camera = replace(camera_of(rng), delay_ns=rng.choice([0.0, 20.0]), delay_tau_s=rng.uniform(200, 1000), **late)
        found = drift(camera, rng, analogue=True).fit
        for name in names:
            if name in found and name not in found.limits:
                scores[name].append((found[name].value - getattr(camera, name)) / found[name].u)
    for some in scores.values():
        assert len(some) > 0.6 * CAMERAS
        check_scores(some, len(names))


def test_the_time_until_it_is_stable(rng: np.random.Generator) -> None:
    camera = Warming(0.3, 0.1, 3e-4, 5e-5)
    found = drift(camera, rng).stable
    times = np.arange(0.0, 40000.0)
    corners = np.array([(x, y) for x in (0, SHAPE[1] - 1) for y in (0, SHAPE[0] - 1)], float)
    settled = camera.moved(1e12, corners)
    away = np.max([np.linalg.norm(camera.moved(t, corners) - settled, axis=1) for t in times], axis=1)
    truth = times[away > 0.05].max()
    assert abs(found.value - truth) < stats.norm.isf(RATE / 2) * found.u and found.u < 0.2 * truth


def test_a_series_that_ends_too_early_has_a_larger_u(rng: np.random.Generator) -> None:
    names = ("shift_x_px", "shift_y_px")
    scores, told = [], 0
    for _ in range(CAMERAS):
        camera = replace(camera_of(rng), shift_x_px=rng.uniform(0.3, 0.8))
        found = drift(camera, rng, time_s=np.arange(30) * rng.uniform(20.0, 60.0))
        for name in names:
            if name in found.fit and name not in found.fit.limits:
                scores.append((found.fit[name].value - getattr(camera, name)) / found.fit[name].u)
        told += names[0] in found.fit
    assert told
    assert float(np.square(scores).sum()) < stats.chi2.isf(RATE, len(scores) / 2) * 2, np.round(scores, 2)  # x and y share their curve


def test_a_camera_that_is_warm_has_limits_that_hold(rng: np.random.Generator) -> None:
    found = drift(Warming(), rng)
    assert set(found.fit.limits) >= {"shift_x_px", "shift_y_px", "scale_rel", "rotation_rad", "shift_std_px", "roll_std_rad"}
    assert 0 < found.fit["shift_x_px"].value < 0.05 and found.fit["scale_rel"].value < 2e-4
    assert found.stable.value == 0 and found.stable.u == 0


def test_the_scatter_of_a_stabilised_sensor(rng: np.random.Generator) -> None:
    found = drift(Warming(0.15, 0.1, shift_std_px=0.05), rng).fit["shift_std_px"]
    frames = TIME_S.size
    low, high = np.sqrt(stats.chi2.ppf([RATE / 2, 1 - RATE / 2], 2 * (frames - 6)) / (2 * (frames - 6)))
    assert 0.05 * low < found.value < 0.05 * high
    assert found.u == pytest.approx(0.05 / np.sqrt(4 * frames), rel=0.3)


def test_a_delay_that_decays_as_the_camera_does_is_not_told_apart(rng: np.random.Generator) -> None:
    camera = Warming(0.2, 0.1, 3e-4, 5e-5, 0.4, 250.0, 1500.0, delay_ns=20.0, delay_tau_s=250.0, scale_error_rel=0.003)
    found = drift(camera, rng, analogue=True).fit
    if "shift_x_px" in found:  # then u holds that it could be the delay
        assert abs(found["shift_x_px"].value - 0.2) < stats.norm.isf(RATE / 2) * found["shift_x_px"].u
    else:
        assert "frame grabber" in found.reasons["shift_x_px"]


def test_positions_whose_u_is_too_small_enlarge_it(rng: np.random.Generator) -> None:
    positions, covariance = Warming(0.15, 0.1).positions(rng, 0.02)
    motion = field_motion(positions, covariance / 4, tuple(CENTRE))
    assert motion.location_factor == pytest.approx(2, rel=0.1)
    right = field_motion(positions, covariance, tuple(CENTRE))
    honest, enlarged = (drift_of(m, TIME_S, SHAPE).fit["shift_y_px"].u for m in (right, motion))
    assert enlarged == pytest.approx(honest, rel=0.1)


def test_modes_are_exact_though_targets_are_hidden(rng: np.random.Generator) -> None:
    camera = Warming(0.4, -0.3, 5e-4, 2e-4)
    positions = np.array([camera.moved(t) for t in TIME_S])
    covariance = np.array(np.broadcast_to(np.eye(2) * 1e-4, (len(TIME_S), len(PLACES), 2, 2)))
    positions[rng.random(positions.shape[:2]) < 0.2] = np.nan
    motion = field_motion(positions, covariance, tuple(CENTRE))
    p = 1 - 0.3 * np.exp(-TIME_S / 120) - 0.7 * np.exp(-TIME_S / 1800)
    for mode, size in (("shift_x_px", 0.4), ("shift_y_px", -0.3), ("scale_rel", 5e-4), ("rotation_rad", 2e-4)):
        seen = motion.values[motion.used, motion.modes.index(mode)]
        expected = size * (p - p.mean())[motion.used]
        expected -= expected.mean()
        assert np.ptp(seen - expected) < 3e-3 * abs(size) + 1e-6


def test_too_little_is_refused_with_the_reason(rng: np.random.Generator) -> None:
    positions, covariance = Warming().positions(rng)
    with pytest.raises(MeasureError, match="2 targets"):
        field_motion(positions[:, :2], covariance[:, :2], tuple(CENTRE))
    motion = field_motion(positions[:5], covariance[:5], tuple(CENTRE))
    with pytest.raises(MeasureError, match="5 frames are too few"):
        drift_of(motion, TIME_S[:5], SHAPE)


def test_a_focus_that_drifts_is_found(rng: np.random.Generator) -> None:
    time_s, own = np.arange(40) * 60.0, rng.uniform(0.5, 1.0, 12)
    change = 0.08 * (1 - np.exp(-time_s / 600.0))
    blur = np.stack([own + change[:, None] + rng.normal(0, 0.02, (40, 12)), np.full((40, 12), 0.02)], axis=-1)
    blur[rng.random((40, 12)) < 0.2] = np.nan
    value, u = focus_motion(blur)
    scores = (value - change + change.mean()) / u
    low, high = stats.chi2.ppf([RATE / 2, 1 - RATE / 2], 39)
    assert low < float(scores @ scores) < high
    positions, covariance = Warming().positions(rng, 0.01, time_s)
    found = drift_of(field_motion(positions, covariance, tuple(CENTRE)), time_s, SHAPE, blur_px2=blur).focus
    truth = change[-8:].mean() - change[:8].mean()
    assert abs(found.value - truth) < stats.norm.isf(RATE / 2) * found.u < 0.03
    still = drift_of(field_motion(positions, covariance, tuple(CENTRE)), time_s, SHAPE).focus
    assert not still.is_available


def test_one_time_constant_is_told_as_one(rng: np.random.Generator) -> None:
    found = drift(Warming(0.5, -0.3, fast_share=0.0, slow_s=700.0), rng)
    if "slow_s" not in found.fit:
        assert "one time constant of" in found.fit.reasons["slow_s"]
    near = found.from_settled_px > 0.02
    assert (found.u_from_settled_px[near] < 0.03).all()  # the curve is told, whichever of its parts it is
    assert found.stable.u < 0.25 * found.stable.value
