"""Expansion, drift and stabilisation: the handbook's numbers, settling, and the scatter from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from light_scenes import camera, mapped, signal_of
from pixmetry.sources.sensor.mount_drift import SOURCE as DRIFT
from pixmetry.sources.sensor.mount_drift import MountDrift
from pixmetry.sources.sensor.stabilisation import SOURCE as STABLE
from pixmetry.sources.sensor.stabilisation import Stabilisation
from pixmetry.sources.sensor.thermal_expansion import SOURCE as WARM
from pixmetry.sources.sensor.thermal_expansion import ThermalExpansion
from source_signals import ALPHA, stream

SHAPE = (582, 752)
EDGE, CORNER = (375.5 + 376, 290.5), (375.5 + 376, 290.5 + 291 * 8.3 / 8.6)


@pytest.mark.parametrize(
    ("coefficients", "place", "expected"),
    [
        ({"sensor_per_k": 2.6e-6}, EDGE, -0.020),
        ({"sensor_per_k": 7e-6}, EDGE, -0.053),
        ({"mount_per_k": 23e-6}, EDGE, 0.17),
        ({"mount_per_k": 23e-6}, CORNER, 0.22),
    ],
)
def test_twenty_kelvin_move_the_edge_of_the_image(coefficients, place, expected):
    """The pixels of a warm sensor lie farther apart (the image shrinks in pixels); a longer mount makes the image larger."""
    params = ThermalExpansion(**coefficients, reference_c=20)
    (x,), (y,) = mapped(WARM, params, [place[0]], [place[1]], SHAPE, temperature_c=40.0)
    moved = np.hypot(x - 375.5, y - 290.5) - np.hypot(place[0] - 375.5, place[1] - 290.5)
    assert moved == pytest.approx(expected, abs=0.005)


def test_the_fixed_point_stays_and_the_rest_follows_each_frame_of_a_warm_up(rng: np.random.Generator):
    params = ThermalExpansion(mount_per_k=1e-4, fixed_x_px=-10, fixed_y_px=5, shift_x_px_per_k=0.01, reference_c=20)
    signal = signal_of(WARM, params, (41, 61), 3, temperature_c=40.0, warm_up_k=20.0, warm_up_s=0.04)
    told = WARM.truth(params, signal, stream(rng))
    dt = 20 * (1 - np.exp(-np.arange(3)))
    assert told["shift_x_px"][:, 25, 20] == pytest.approx(0.01 * dt / (1 + 1e-4 * dt), abs=1e-12)
    assert told["shift_y_px"][:, 25, 20] == pytest.approx(0, abs=1e-12)
    x = 60 - told["shift_x_px"][:, 25, 60]  # the place before
    assert 20 + (x - 20) * (1 + 1e-4 * dt) + 0.01 * dt == pytest.approx(60)


def test_the_drift_settles_with_two_time_constants():
    params = MountDrift(shift_x_px=2.0, fast_share=0.4, fast_s=60, slow_s=1000)
    for frame in (0, 1000, 50000):
        t = frame * 0.04 + 0.005
        expected = 2.0 * (0.4 * (1 - np.exp(-t / 60)) + 0.6 * (1 - np.exp(-t / 1000)))
        (x,), (y,) = mapped(DRIFT, params, [10.0], [20.0], (41, 61), frame=frame)
        assert (x - 10, y - 20) == pytest.approx((expected, 0), abs=1e-9)


def test_the_settled_map_is_affine_with_the_six_parameters():
    params = MountDrift(
        shift_x_px=1.5, shift_y_px=-0.7, scale_rel=2e-3, rotation_rad=3e-3, affinity_rel=1e-3, shear_rel=-5e-4, fast_s=1e-3, slow_s=1e-3
    )
    x, y = np.array([0.0, 60.0, 13.0]), np.array([0.0, 40.0, 33.0])
    u, v = mapped(DRIFT, params, x, y, (41, 61), frame=100)
    turn = 1.002 * np.array([[np.cos(3e-3), -np.sin(3e-3)], [np.sin(3e-3), np.cos(3e-3)]])
    a = turn @ np.array([[1.001, -5e-4], [0, 1]])
    expected = a @ np.array([x - 30, y - 20]) + np.array([[31.5], [19.3]])
    assert np.array([u, v]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("roll", "expected"), [(0, (0, 0)), (90, (0.2, -0.2)), (180, (0, -0.4))])
def test_the_sag_turns_with_the_camera(roll, expected):
    (x,), (y,) = mapped(DRIFT, MountDrift(sag_px=0.2, roll_deg=roll), [30.0], [20.0], (41, 61))
    assert (x - 30, y - 20) == pytest.approx(expected, abs=1e-12)


def test_every_frame_of_a_stabilised_sensor_has_a_pose_of_its_own(rng: np.random.Generator):
    """2000 frames: a deviation of 9 % of a standard deviation would be seen, at 1e-6 of false alarms."""
    n, params = 2000, Stabilisation(shift_std_px=0.3, roll_std_rad=2e-3)
    signal = signal_of(STABLE, params, (3, 101), n)
    told = STABLE.truth(params, signal, stream(rng))
    middle_x, middle_y = told["shift_x_px"][:, 1, 50], told["shift_y_px"][:, 1, 50]
    roll = (told["shift_y_px"][:, 1, 100] - told["shift_y_px"][:, 1, 0]) / 100
    for value, std in ((middle_x, 0.3), (middle_y, 0.3), (roll, 2e-3)):
        low, high = stats.chi2.ppf([ALPHA / 6, 1 - ALPHA / 6], n) / n
        assert low < np.mean(value**2) / std**2 < high
    assert abs(np.corrcoef(middle_x, middle_y)[0, 1]) < stats.norm.isf(ALPHA / 2) / np.sqrt(n)


def test_a_quiet_stabiliser_rests():
    still = camera((5, 7), (STABLE, STABLE.typical)).streams(0, quiet=True).of("any")
    told = STABLE.truth(STABLE.typical, signal_of(STABLE, STABLE.typical, (5, 7)), still)
    assert all(np.abs(v).max() == 0 for v in told.values())
