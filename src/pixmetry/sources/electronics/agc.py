"""Automatic gain control: the gain of each frame follows the brightness of the one before."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import model_validator

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, cut_rows, quantity
from pixmetry.core.errors import MeasureError, ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

DARKEST_DN = 1e-6  # a frame without light asks for all the gain there is


class Agc(Parameters):
    """A loop that is linear in decibels."""

    target_dn: float = quantity(100.0, "DN", "target value of the frame's mean above black", gt=0, le=1e9)
    kappa: float = quantity(0.0, "1", "part of the deviation in decibels that one frame removes; 0 locks the gain", ge=0, le=1)
    lowest_db: float = quantity(0.0, "dB", "lowest gain", ge=-40, le=0)
    highest_db: float = quantity(32.0, "dB", "highest gain", ge=0, le=80)

    @model_validator(mode="after")
    def _settles(self) -> Agc:
        if 0 < self.kappa < 0.02:
            raise ParameterError("the loop would take hundreds of frames to settle", value=self.kappa, allowed="0, or 0.02 to 1")
        return self


def start(params: Agc) -> float | None:
    """Gain before frame 0; none where it is locked."""
    return 1.0 if params.kappa else None


def following(params: Agc, gain: float, mean_dn: float) -> float:
    """Gain of the next frame, from the gain of this one and the mean that it gave."""
    wanted = gain * (params.target_dn / max(mean_dn, DARKEST_DN)) ** params.kappa
    return float(np.clip(wanted, 10 ** (params.lowest_db / 20), 10 ** (params.highest_db / 20)))


def forward(params: Agc, signal: Signal, stream: Stream, state: float | None) -> tuple[Signal, float | None]:
    """Multiply frame by frame by the gain and move it on; over windows, which do not know the frame's mean, it stays as it is."""
    if params.kappa == 0 or state is None:
        return signal, state
    if signal.data.shape[1:] != tuple(signal.frame_shape):
        return signal.with_data(signal.data * np.float32(state)), state
    data = np.empty_like(signal.data, np.float32)
    for i, frame in enumerate(signal.data):
        np.multiply(frame, np.float32(state), out=data[i])
        state = following(params, state, float(data[i].mean(dtype=np.float64)))
    return signal.with_data(data), state


def context(params: Agc, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole frame: its mean sets the gain."""
    return windows.full_frame(frame_shape) if params.kappa else windows


def measure(observations: Observations) -> Estimates:
    """Loop gain, target and limits from frames in a row in which a part of the scene changes: see `pixmetry.observe.gain_loop`.

    A gain that is locked has a ``kappa`` of 0.
    """
    found = observations.sequences
    names = ("kappa", "target_dn", "lowest_db", "highest_db")
    fit = None if found is None else found.loop
    told = of_pictures(fit, {n: n for n in names}, where="electronics.agc", pictures="a scene that changes, in a row", kind="sequence")
    if "kappa" not in told:
        raise MeasureError(found.loop.reasons["kappa"] if found is not None else "no sequence", where="electronics.agc")
    return told


def correct(params: Agc, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide each frame by its factor against the mean of all, as the parts of the scene that do not change tell it.

    ``maps["factor_rel"]`` has shape (n, rows of the frame): gain, exposure and lamp as one.
    """
    return signal.with_data(signal.data / cut_rows(maps, "factor_rel", signal)[:, :, None])


def propagate(params: Agc, probe: Probe) -> Contribution:
    """A common factor moves no centroid whose background and threshold follow it, unless it lifts the target beyond the scale's end.

    The gain is that of a frame which is background but for a target. What the scale's end cuts off is cut off behind the line.
    """
    if params.kappa == 0:
        return probe.contribution((0.0, 0.0), "F", method="the gain is locked")
    lowest, highest = (10 ** (db / 20) for db in (params.lowest_db, params.highest_db))
    gain = float(np.clip(params.target_dn / max(probe.background_dn, DARKEST_DN), lowest, highest))
    end = probe.saturation_dn / gain
    if probe.held is None:
        dx, dy = probe.moved(np.minimum(probe.signal_dn, end))
    else:
        held = probe.held
        seen = held.read(held.line, probe.signal_dn, probe.background_dn)
        x, y = held.locate(np.minimum(seen, end * held.line.level), held.line.level)
        dx, dy = x - probe.x_hat_px, y - probe.y_hat_px
    return probe.from_shifts(dx, dy, "F", model_error=0.3, method="a common factor; what it lifts beyond the scale's end is cut off")


SOURCE = Source(
    id="electronics.agc",
    title="Automatic gain control",
    description="The gain follows the scene from frame to frame. Grey values and noise change with it, and so does the part of a target "
    "above a fixed threshold.",
    number=22,
    stars=3,
    parameters=Agc,
    consumes=(Kind.DN,),
    after=("sensor",),
    before=("cable", "grabber", "storage"),
    neutral=Agc(),
    typical=Agc(kappa=0.3, highest_db=16.0),
    bound=Agc(kappa=0.3, highest_db=32.0),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    context=context,
    start=start,
    gum_class="F",
    equation="g(t+1) = g(t) (y_target/⟨y(t)⟩)^κ,  within the limits",
    typical_size="no shift if the threshold follows the frame; 0.03 to 0.09 px with a hard threshold at a fixed DN",
    references=("K. J. Åström, R. M. Murray, Feedback Systems, Princeton 2008 (first-order discrete loop)",),
    advice="Switch it off.",
    leaves="the mean factor of all frames, the noise of each factor, and the noise that the gain amplified",
)
