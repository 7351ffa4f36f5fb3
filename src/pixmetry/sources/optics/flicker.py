"""Flicker: lamps on the mains and dimmed diodes change their light faster than a frame; rows that look at other times see another level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pixmetry.camera.light import Light
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, cut_rows, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Flicker(Parameters):
    """The lamp's light about its mean of 1."""

    depth_rel: float = quantity(0.0, "1", "half of peak to valley over the mean (sine), or the share that is switched", ge=0, le=1)
    frequency_hz: float = quantity(100.0, "Hz", "frequency of the light: twice that of the mains", gt=0, le=1e6)
    phase_rad: float = quantity(
        0.0, "rad", "phase at time 0; at phase 0 a sine has its maximum, and a switched lamp turns on", ge=-10, le=10
    )
    waveform: Literal["sine", "switched"] = quantity("sine", "1", "sine: smooth; or switched on and off")
    duty: float = quantity(0.5, "1", "share of the time in which a switched lamp is on", gt=0, le=1)


def mean_light(params: Flicker, begin_s: np.ndarray, end_s: np.ndarray) -> np.ndarray:
    """The lamp's light averaged from one time to another (at one instant where they are the same), over its mean."""
    middle, length = 0.5 * (begin_s + end_s), end_s - begin_s
    if params.waveform == "sine":
        wave = np.cos(2 * np.pi * params.frequency_hz * middle + params.phase_rad)
        mean: Array = 1 + params.depth_rel * np.sinc(params.frequency_hz * length) * wave
        return mean
    offset = params.phase_rad / (2 * np.pi)
    a, b = (params.frequency_hz * t + offset for t in (begin_s, end_s))
    now = (0.5 * (a + b)) % 1 < params.duty
    on = np.where(length > 0, (_on(b, params.duty) - _on(a, params.duty)) / np.where(length > 0, b - a, 1.0), now)
    return 1 + params.depth_rel * (on / params.duty - 1)


def _on(cycles: np.ndarray, duty: float) -> np.ndarray:
    """Cycles up to a time in which the lamp was on."""
    whole = np.floor(cycles)
    lit: Array = whole * duty + np.minimum(cycles - whole, duty)
    return lit


def shares(light: Light) -> tuple[np.ndarray, np.ndarray]:
    """Begin and end of the time that every look of the light stands for, shape (n, rows or 1, m).

    The looks of a shutter that is open or closed, whose weights sum to 1, share its time in the ratio of their weights: each lies in its
    own part (the separation theorem of Chebyshev, Markov and Stieltjes). Looks of other kinds, such as pulses, are taken as instants.
    """
    times, weights = light.moments
    weights = np.broadcast_to(weights, times.shape)
    end = np.cumsum(weights, axis=2)
    mine = end <= 1 + 1e-9
    shutter = np.where(mine, weights, 0.0)
    middle = (shutter * times).sum(axis=2, keepdims=True) / np.maximum(shutter.sum(axis=2, keepdims=True), 1e-300)
    length = light.exposure_s[:, None, None]
    edge = middle - 0.5 * length + length * end
    begin = edge - length * weights
    slack = 1e-9 * length
    fits = (begin - slack <= times) & (times <= edge + slack)
    whole = np.abs(shutter.sum(axis=2, keepdims=True) - 1) < 1e-9
    box = (fits | ~mine).all(axis=2, keepdims=True) & whole & mine
    return np.where(box, begin, times), np.where(box, edge, times)


@dataclass(frozen=True)
class LampLight(Light):
    """Light of lamps that flicker: each look, at whichever times, is weighted by the lamps' light over its share of time."""

    lamps: tuple[Flicker, ...] = ()

    @property
    def moving(self) -> bool:
        """It depends on time, whatever the scene does."""
        return True

    @property
    def plain(self) -> bool:
        """Pixels must ask the lamps."""
        return False

    def fingerprint(self) -> bytes | None:
        """Key that is equal for two exposures with the same light; it includes the lamp's light."""
        return self._lit().fingerprint()

    def photons(self) -> np.ndarray:
        """Mean photons of every pixel, float32, shape (n, rows, cols)."""
        return self._lit().photons()

    def _lit(self) -> Light:
        times, weights = self.moments
        begin, end = shares(self)
        for lamp in self.lamps:
            weights = weights * mean_light(lamp, begin, end)
        steady = Light(**{name: getattr(self, name) for name in Light.__dataclass_fields__})
        return steady.seen_at(times, weights)


def forward(params: Flicker, signal: Signal, stream: Stream) -> Signal:
    """Put the scene under the lamp."""
    if not params.depth_rel:
        return signal
    if isinstance(signal.own_light, LampLight):
        return signal.with_light(replace(signal.own_light, lamps=(*signal.own_light.lamps, params)))
    fields = {name: getattr(signal.own_light, name) for name in Light.__dataclass_fields__}
    return signal.with_light(LampLight(**fields, lamps=(params,)))


def measure(observations: Observations) -> Estimates:
    """Depth and frequency from frames in a row: the wave of their light, over what the exposure leaves of it.

    Phase 0 is that of no particular time, and is not measured.
    """
    found = observations.sequences
    fit = None if found is None else found.lamp
    names, where = {"depth_rel": "depth_rel", "frequency_hz": "frequency_hz"}, "optics.flicker"
    told = of_pictures(fit, names, where=where, pictures="frames in a row under the lamp", kind="sequence")
    if "depth_rel" not in told:
        raise MeasureError(fit.reasons["depth_rel"] if fit is not None else "no sequence", where=where)
    return told


def correct(params: Flicker, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide the rows of each frame by their light against the mean of all, as the parts of the scene that do not change tell it.

    ``maps["factor_rel"]`` has shape (n, rows of the frame). Of a lamp that makes bands the sine is taken out.
    """
    return signal.with_data(signal.data / cut_rows(maps, "factor_rel", signal)[:, :, None])


def truth(params: Flicker, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """The lamp's light over the exposure of a shutter that opens for all rows at once, shape (n, rows)."""
    level = mean_light(params, signal.time_s, signal.time_s + signal.exposure_s)
    return {"light_rel": level[:, None] * np.ones(signal.frame_shape[0])}


SOURCE = Source(
    id="optics.flicker",
    title="Flicker of the light",
    description="Light that flickers at 100 Hz or at the frequency of a dimmer makes frames unequal. With a rolling shutter it makes "
    "bands.",
    parameters=Flicker,
    consumes=(Kind.LIGHT,),
    before=("sensor",),
    neutral=Flicker(),
    typical=Flicker(depth_rel=0.3),
    bound=Flicker(depth_rel=1.0),
    forward=forward,
    truth=truth,
    measure=measure,
    correct=correct,
    gum_class="F",
    equation="E(t) = 1 + d cos(2π f t + φ);  over an exposure d sinc(f t_exp) cos(2π f t_mid + φ), t_mid of each row",
    typical_size="none at 10 ms and 100 Hz; at 1 ms nearly the full modulation of the lamp, in bands with a period of 1/(f t_row) rows",
    references=("IEEE 1789-2015 (modulation of the light of diodes)",),
    leaves="the noise of each frame's factor; of bands the harmonics of a lamp that is switched, and those of two fields in one frame",
    advice="Use direct current, or expose for a whole number of the light's periods.",
    reasons={
        "propagate": "needs the row times of the camera, which the probe does not contain; a common factor moves no centre",
    },
)
