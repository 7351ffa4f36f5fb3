"""What a target's motion makes of the times at which a camera looks: the target is found where it was then.

The position of a frame belongs to the middle of its exposure, of the first rows that are exposed. A row that looks later by a time τ
shows the target farther along its path, by v τ + a τ²/2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.contribution import Contribution
from pixmetry.core.random import Grid

FRAMES = 256  # for what is drawn anew in every frame
LOOKS = ("sensor.exposure", "sensor.interlace", "sensor.light_pulses", "sensor.rolling_shutter", "sensor.trigger_jitter")
LAGS = {"sensor.image_lag": "lag_rel", "processing.temporal_noise_reduction": "alpha"}  # with the share of the frame before
OF_MOTION = (*LOOKS, *LAGS)
STILL = "nothing moves in this scenario"


class _Nowhere:
    """A scene of which only times are asked."""

    moving = False


NOWHERE: Any = _Nowhere()


def motion_contribution(element: Element, setting: Setting, camera: Camera) -> Contribution:
    """What a source that looks at other times, or remembers the frame before, does to a moving target.

    Notes
    -----
    Looks: the mean over the rows of a target, so over both fields, of v τ + a ⟨τ²⟩/2. It is constant for targets of one speed, and changes
    over the frame with a rolling shutter. A share q of the frame before, in every frame again, holds the target back by v T q/(1 − q), the
    first moment of the geometric series; T is the time from frame to frame.
    """
    v, a = setting.velocity_px_per_s, setting.acceleration_px_per_s2
    if element.source.id in LAGS:
        share = float(getattr(element.params, LAGS[element.source.id]))
        period = float(camera.facts.get("frame_period_s", max(camera.exposure_s, 0.04)))
        bias = -v * period * share / (1 - share)
        return _of(bias, np.zeros(2), np.zeros(2), "the first moment of what stays of earlier frames, at the target's speed")
    delay, spread2 = _delays(element, camera)
    shift = _in_pairs(delay * v[:, None, None] + 0.5 * (delay**2 + spread2) * a[:, None, None])
    mean = shift.mean(axis=(1, 2))
    time = shift.mean(axis=2).std(axis=1)
    smooth = shift.mean(axis=1).std(axis=1)
    return _of(mean, time, smooth, "times at which the rows look, and the target's speed")


def _of(bias: np.ndarray, time: np.ndarray, smooth: np.ndarray, method: str) -> Contribution:
    u = np.hypot(time, smooth)
    parts: dict[str, Any] = {"time_px": tuple(time.tolist()), "smooth_px": tuple(smooth.tolist())}
    text: dict[str, Any] = {"model_error": 0.05, "floor_px": 2e-3, "method": method}
    return Contribution(float(u[0]), float(u[1]), "O", float(bias[0]), float(bias[1]), **text, **parts)


def _delays(element: Element, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Times of rows after the middle of the exposure of those that look first, and the variance within the exposure, (frames, rows)."""
    rows, cols = camera.frame_shape
    frames = FRAMES if element.source.id == "sensor.trigger_jitter" else 1
    grid = Grid.whole(list(range(frames)), (rows, cols))
    signal = camera.signal(NOWHERE, grid, temperature_c=camera.temperature_c)
    assert element.source.truth is not None
    told = element.source.truth(element.params, signal, camera.streams(0).of(element.name))
    variance = np.zeros((frames, rows))
    if "pulse_time_s" in told:  # the pulses are the time of the frame
        delay = told["pulse_time_s"] - told["pulse_time_s"].mean(axis=1, keepdims=True)
    elif "mean_time_s" in told:
        delay = told["mean_time_s"] - (signal.time_s + 0.5 * signal.exposure_s)[:, None]
        variance = told["spread_s"] ** 2
    else:
        delay = told["delay_s"]
    return delay, variance


def _in_pairs(values: np.ndarray) -> np.ndarray:
    """Means over pairs of rows, the last axis: a target covers rows of both fields."""
    even = values.shape[-1] // 2 * 2
    return values[..., :even].reshape(*values.shape[:-1], -1, 2).mean(axis=-1) if even else values
