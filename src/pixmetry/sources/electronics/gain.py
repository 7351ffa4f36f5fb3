"""Conversion gain: electrons become steps of the converter."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.noise_covariance import UNKNOWN
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Gain(Parameters):
    """The system gain K of EMVA 1288."""

    gain_dn_per_e: float = quantity(0.01, "DN/e-", "steps of the converter per electron", gt=0, le=1e4)


def forward(params: Gain, signal: Signal, stream: Stream) -> Signal:
    """Multiply the electrons by the gain."""
    return signal.with_data(signal.data * np.float32(params.gain_dn_per_e), Kind.DN)


def measure(observations: Observations) -> Estimates:
    """Read the gain from the photon transfer: the slope of temporal variance against mean, before what filtered the noise."""
    found, fit = observations.noise_filter, observations.photon_transfer_fit
    if found is not None and found.kind == UNKNOWN and (fit is None or "gain_dn_per_e" not in fit):
        what = "the noise of neighbouring pixels is correlated, and not as behind a linear filter: its variance does not tell the gain"
        remedy = "take raw frames without noise reduction, demosaicking and compression"
        raise MeasureError(what, where="electronics.gain", remedy=remedy)
    return observations.fitted(
        {"gain_dn_per_e": "gain_dn_per_e"},
        "the gain needs a photon-transfer series",
        where="electronics.gain",
        remedy="take pairs at ten light levels or more",
    )


SOURCE = Source(
    id="electronics.gain",
    title="Conversion gain",
    description="Charge becomes a voltage and then a number. The gain is the number of converter steps per electron.",
    number=19,
    parameters=Gain,
    consumes=(Kind.ELECTRONS,),
    produces=Kind.DN,
    essential=True,
    after=("optics", "sensor"),
    typical=Gain(),
    bound=Gain(),
    forward=forward,
    measure=measure,
    gum_class="T",
    equation="y = K n",
    typical_size="none by itself; with a low gain the quantisation is larger than the noise",
    references=("EMVA 1288 R4.0 Linear, §2.2 and §6.5, eq. 16–18",),
    advice="Set the gain so that one step of the converter is about the dark noise.",
    reasons={
        "correct": "a factor common to all pixels is no error of the image. One that changes from frame to frame is electronics.agc",
        "propagate": "it scales all pixels alike and moves no target; noise and quantisation are sources of their own",
        "neutral": "it is a conversion: without it there is no digital signal",
    },
)
