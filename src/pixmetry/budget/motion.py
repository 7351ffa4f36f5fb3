"""What a target's motion makes of the times at which a camera looks: the target is found where it was then.

The position of a frame belongs to the middle of its exposure, of the first rows that are exposed; with pulsed light, to the middle of its
pulses. A row that looks later by a time τ shows the target farther along its path, by v τ + a τ²/2.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pixmetry.budget.monte_carlo import Trials, helpers_of
from pixmetry.budget.probe import Facts, Target, make_probe, perfect, put, scene_of, seen_at
from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import NOWHERE, Camera, Element
from pixmetry.camera.contribution import Contribution
from pixmetry.core.errors import InputError
from pixmetry.core.random import Grid
from pixmetry.locate.estimator import Estimator
from pixmetry.scene.discs import Discs

FRAMES = 256  # for what is drawn anew in every frame
PULSES = "sensor.light_pulses"
FIELDS = "sensor.interlace"
LOOKS = ("sensor.exposure", FIELDS, PULSES, "sensor.rolling_shutter", "sensor.trigger_jitter")
LAGS = {"sensor.image_lag": "lag_rel", "processing.temporal_noise_reduction": "alpha"}  # with the share of the frame before
OF_MOTION = (*LOOKS, *LAGS)
LAG_PHASES, LAG_PLACES = 3, 48  # places within the pixel along each axis; places all over the frame
GHOSTS, SMALLEST_GHOST = 60, 1e-5  # earlier frames at most, and their smallest share
FLOOR_PX, COMB_REL = 2e-3, 0.05  # of what is told; of the distance between what two rows show
SHORT_PX, LAG_ERROR, STREAK_ERROR = 0.5, 0.05, 0.6  # shift up to which ghosts overlap the target; relative errors up to it and beyond
STILL = "nothing moves in this scenario"


class _Moving:
    """A scene of which only the times count at which it is looked at."""

    moving = True


MOVES: Any = _Moving()


def motion_contribution(element: Element, setting: Setting, camera: Camera) -> Contribution:
    """What a source that looks at other times does to a moving target.

    Notes
    -----
    The mean over the rows of a target, so over both fields, of v τ + a ⟨τ²⟩/2. It is constant for targets of one speed, and changes over
    the frame with a rolling shutter.
    """
    v, a = setting.velocity_px_per_s, setting.acceleration_px_per_s2
    delay, spread2 = row_delays(element, camera)
    shift = in_pairs(delay * v[:, None, None] + 0.5 * (delay**2 + spread2) * a[:, None, None])
    mean = shift.mean(axis=(1, 2))
    time = shift.mean(axis=2).std(axis=1)
    smooth = shift.mean(axis=1).std(axis=1)
    # rows of two fields show a target twice, whatever this source does, and what is found of such a comb hangs on its place in the pixel
    fields = [row_delays(e, camera)[0] for e in camera.active if e.source.id == FIELDS and e.name != element.name]
    apart_s = max(float(np.abs(np.diff(d, axis=1)).max(initial=0.0)) for d in (delay, *fields))
    comb = COMB_REL * float(np.hypot(*v)) * apart_s
    return _of(mean, time, smooth, "times at which the rows look, and the target's speed", floor_px=max(FLOOR_PX, comb))


def lag_contribution(element: Element, setting: Setting, estimator: Estimator) -> Contribution:
    """What a source that keeps a share q of the frame before, in every frame again, does to a moving target.

    Notes
    -----
    The frame shows Σ (1 − q) qᵏ of the target k frames ago. The estimator is asked on that, at places all over the frame, as what shapes
    the picture (lens, pixels, mosaic, fields) shows it. Ghosts that overlap the target hold it back by v T q/(1 − q), the first moment of
    the series; those beyond its window do nothing.
    """
    share = float(getattr(element.params, LAGS[element.source.id]))
    count = GHOSTS if share >= 1 else int(np.clip(np.log(SMALLEST_GHOST) / np.log(share) if share else 0, 0, GHOSTS - 1)) + 1
    ago_s = setting.frame_period_s * np.arange(count)
    behind = np.outer(setting.velocity_px_per_s, ago_s) - 0.5 * np.outer(setting.acceleration_px_per_s2, ago_s**2)
    shown: Any = (1 - share) * share ** np.arange(count)
    shown[-1] = 1 - shown[:-1].sum()

    def ghosts(target: Target, facts: Facts, x_px: np.ndarray, y_px: np.ndarray) -> Discs:
        one = scene_of(target, facts, x_px, y_px)
        return replace(one, x_px=one.x_px - behind[0], y_px=one.y_px - behind[1], peak_photons=one.peak_photons * shown)

    camera = perfect(setting.camera, helpers_of(setting.camera, ()))
    trials = Trials(camera, setting.target, estimator, setting.facts, LAG_PLACES, units=1, frames=1)
    without, with_it = (np.array(t.errors(camera)).reshape(2, -1) for t in (trials, replace(trials, scene=ghosts, _found={})))
    shifts = (with_it - without)[:, np.isfinite(with_it - without).all(axis=0)]
    if not shifts.size:
        raise InputError("no target is found behind it", where=element.name)
    bias, zero = shifts.mean(axis=1), np.zeros(2)
    method = "the estimator on the target with what stays of earlier frames"
    # of a streak that is longer, what is found hangs on where the search begins
    return _of(bias, zero, zero, method, shifts.std(axis=1), LAG_ERROR if np.abs(bias).max() <= SHORT_PX else STREAK_ERROR)


def pulse_contribution(element: Element, setting: Setting, camera: Camera, estimator: Estimator) -> Contribution:
    """What pulsed light leaves of a target's motion: its two pulses, and the steady light at the times at which rows look without them.

    Notes
    -----
    The estimator is asked on the sum of the target at all these times, row by row, at phases of the pixel, and with either field in the
    middle row. What exposure and fields do to the steady light is in it.
    """
    probe = make_probe(setting.facts, setting.target, estimator, LAG_PHASES)
    v, a = setting.velocity_px_per_s, setting.acceleration_px_per_s2
    side = probe.signal_dn.shape[1]
    late, share = _pulsed_looks(element, camera)
    shifts = []
    for first in (0, 1):
        rows = (first + np.arange(side)) % len(late)
        signal = np.zeros_like(probe.signal_dn)
        for row in range(len(late)):
            mine = rows == row
            for t, part in zip(late[row], share[row], strict=True):
                ahead = v * t + 0.5 * a * t**2
                shown = seen_at(setting.facts, setting.target, probe.x_px + ahead[0], probe.y_px + ahead[1], (side, side))
                signal[:, mine] += part * shown[:, mine]
        shifts.append(np.array(probe.moved(signal)))
    both = np.concatenate(shifts, axis=1)
    bias, zero = both.mean(axis=1), np.zeros(2)
    comb = COMB_REL * float(np.hypot(*v)) * float(np.ptp((late * share).sum(axis=1)))
    method = "the estimator on the target by the light of the pulses and the steady light"
    return _of(bias, zero, zero, method, both.std(axis=1), floor_px=max(FLOOR_PX, comb))


def _pulsed_looks(element: Element, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """When the two rows in the middle of the frame look, from the middle of the pulses, and their shares of the light; (2, k) each."""
    rows = camera.frame_shape[0]
    middle = Grid(np.zeros(1, np.int64), np.full(1, rows // 4 * 2), np.zeros(1, np.int64), (2, 1))
    signal = camera.signal(MOVES, middle, temperature_c=camera.temperature_c)
    streams = camera.streams(0, quiet=True)
    for e in put(camera, element).active:
        if e.source.id in LOOKS:
            signal = e.source.forward(e.params, signal, streams.of(e.name))  # type: ignore[misc]
        if e.name == element.name:
            break
    assert element.source.truth is not None
    pulses = element.source.truth(element.params, signal, streams.of(element.name))["pulse_time_s"]
    times, shares = signal.own_light.moments
    return times[0] - pulses.mean(), shares[0]


def held_by_pulses(element: Element, camera: Camera) -> bool:
    """Whether pulses of light decide when rows look, of whom this source tells it for steady light: it stands ahead of them."""
    ids = [e.source.id for e in camera.active]
    return element.source.id in LOOKS and PULSES in ids and element.source.id in ids[: ids.index(PULSES)]


def _of(
    bias: np.ndarray,
    time: np.ndarray,
    smooth: np.ndarray,
    method: str,
    place: np.ndarray | float = 0.0,
    model_error: float = LAG_ERROR,
    floor_px: float = FLOOR_PX,
) -> Contribution:
    u = np.sqrt(time**2 + smooth**2 + np.square(place))
    parts: dict[str, Any] = {"time_px": tuple(time.tolist()), "smooth_px": tuple(smooth.tolist())}
    text: dict[str, Any] = {"model_error": model_error, "floor_px": floor_px, "method": method}
    return Contribution(float(u[0]), float(u[1]), "O", float(bias[0]), float(bias[1]), **text, **parts)


def row_delays(element: Element, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Times of rows after the middle of the exposure of those that look first, and the variance within the exposure, (frames, rows).

    Of a source that draws them anew in every frame, those of `FRAMES` frames; else of one.
    """
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


def in_pairs(values: np.ndarray) -> np.ndarray:
    """Means over pairs of rows, the last axis: a target covers rows of both fields."""
    even = values.shape[-1] // 2 * 2
    return values[..., :even].reshape(*values.shape[:-1], -1, 2).mean(axis=-1) if even else values
