"""The chapter's two warm-ups, measured as its authors did: sixteen targets, 90 minutes after switching on."""

from __future__ import annotations

import numpy as np
from scipy import stats
from tests.series.fixed_field import CENTRE, CLOCK_MHZ, SHAPE, Warming

from pixmetry.camera.drift_series import DriftSeries
from pixmetry.series.modes import field_motion
from pixmetry.series.warm_up import drift_of

TIME_S = np.arange(91) * 60.0
U_PX = 0.02
FAR = stats.norm.isf(0.5e-6)  # u, exceeded once in 10⁶


def measured(camera: Warming, rng: np.random.Generator, *, analogue: bool) -> tuple[DriftSeries, np.ndarray]:
    """The series, and how far each target is from its place at the end, px, shape (frames, targets, 2)."""
    true = np.array([camera.moved(t) for t in TIME_S])
    seen = true + rng.normal(0, U_PX, true.shape)
    covariance = np.array(np.broadcast_to(np.eye(2) * U_PX**2, (*true.shape[:2], 2, 2)))
    motion = field_motion(seen, covariance, tuple(CENTRE), analogue=analogue)
    return drift_of(motion, TIME_S, SHAPE, clock_mhz=CLOCK_MHZ if analogue else None), seen - seen[-1]


def test_a_frame_grabber_that_moves_the_image_by_four_pixels(rng: np.random.Generator) -> None:
    """Note 1: 4 px RMS, mainly along x, stable after 60 minutes; a clock with an error of 0.71 % and a time constant of 13.7 minutes."""
    found, moved = measured(Warming(scale_error_rel=0.0071, scale_tau_s=822.0, lock_us=10.5), rng, analogue=True)
    rms = np.sqrt((moved[0] ** 2).mean(axis=0))
    assert 3.0 < rms[0] < 5.0 and rms[1] < 0.1
    for name, truth, share in (("scale_error_rel", 0.0071, 0.005), ("scale_tau_s", 822.0, 0.015)):
        assert abs(found.fit[name].value - truth) < FAR * found.fit[name].u
        assert found.fit[name].u < share * truth
    assert abs(found.stable.value / 60 - 64) < 6  # 0.05 px of 5 px: 4.6 to 4.8 time constants


def test_a_camera_that_moves_the_image_by_a_fifth_of_a_pixel(rng: np.random.Generator) -> None:
    """Note 15: up to 1/5 px in the first hour."""
    found, moved = measured(Warming(0.2, 0.0, slow_s=1200.0, fast_share=0.2, fast_s=120.0), rng, analogue=False)
    assert abs(moved[0, :, 0].mean() + 0.2) < 0.03
    shift = found.fit["shift_x_px"]
    assert abs(shift.value - 0.2) < FAR * shift.u < 0.1
    assert found.fit["shift_y_px"].value < 0.05
