"""Exposure: a moving target is seen over a time, so it is spread along its path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

MEASURED_NODES = 5  # of a camera whose exposure was measured: paths of four blur radii
PARTS, POINTS = 50, 40  # of the exposure, and of each part, on which a profile's moments are taken


class Exposure(Parameters):
    """How light is gathered between the start and the end of the exposure, and by how many looks it is stood for."""

    profile: Literal["box", "trapezoid", "exponential", "gaussian"] = quantity(
        "box", "1", "box: open or closed; trapezoid: opens and closes slowly; exponential: a strobe that decays; gaussian: a pulse"
    )
    nodes: int = quantity(
        1,
        "1",
        "number of times at which a moving scene is evaluated; for 0.1 % of the peak: 1, and one more per blur radius of path",
        ge=1,
        le=64,
    )
    length_rel: float = quantity(
        1.0, "1", "length of the profile about the middle of the exposure, divided by the stated exposure time", gt=0, le=4
    )
    ramp_rel: float = quantity(0.1, "1", "share of the exposure in which a trapezoid rises, and again in which it falls", gt=0, le=0.5)
    decay_rel: float = quantity(0.2, "1", "time constant of the decay, divided by the exposure", gt=0.01, le=100)
    width_rel: float = quantity(0.1, "1", "standard deviation of the pulse, divided by the exposure", gt=0.01, le=100)


def rule(params: Exposure) -> tuple[np.ndarray, np.ndarray]:
    """Times (0 to 1, or as much shorter or longer about 0.5) and weights (sum 1), shape (nodes,): the Gauss rule of the profile itself.

    It gives the moments of the profile up to the power 2 nodes − 1 exactly: the mean time with one node, a constant acceleration
    with two, and the length of the blur.
    """
    t, w = _rule(params.model_copy(update={"length_rel": 1.0}))
    return (t, w) if params.length_rel == 1 else (0.5 + params.length_rel * (t - 0.5), w)


@lru_cache(maxsize=64)
def _rule(params: Exposure) -> tuple[np.ndarray, np.ndarray]:
    if params.profile == "box":
        t, w = np.polynomial.legendre.leggauss(params.nodes)
        return 0.5 + 0.5 * t, 0.5 * w
    t, w = _profile(params)
    # the Lanczos (Stieltjes) recurrence of the polynomials orthogonal under the profile, and the eigenvalues of its matrix
    before, basis, beta = np.zeros_like(t), np.sqrt(w), 0.0
    alphas, betas = [], []
    for _ in range(params.nodes):
        alphas.append(float(basis @ (t * basis)))
        rest = (t - alphas[-1]) * basis - beta * before
        beta = float(np.sqrt(rest @ rest))
        betas.append(beta)
        before, basis = basis, rest / beta
    times, vectors = np.linalg.eigh(np.diag(alphas) + np.diag(betas[:-1], 1) + np.diag(betas[:-1], -1))
    return times, vectors[0] ** 2


def _profile(params: Exposure) -> tuple[np.ndarray, np.ndarray]:
    """The profile in fine weighted points, by Gauss and Legendre between its corners."""
    corners = np.unique([*np.linspace(0, 1, PARTS + 1), params.ramp_rel, 1 - params.ramp_rel])
    u, v = np.polynomial.legendre.leggauss(POINTS)
    ends = zip(corners[:-1], corners[1:], strict=True)
    t, w = (np.concatenate(part) for part in zip(*((a + (b - a) * (0.5 + 0.5 * u), (b - a) * v) for a, b in ends), strict=True))
    if params.profile == "trapezoid":
        w = w * np.minimum(1.0, np.minimum(t, 1 - t) / params.ramp_rel)
    elif params.profile == "exponential":
        w = w * np.exp(-t / params.decay_rel)
    else:
        w = w * np.exp(-0.5 * ((t - 0.5) / params.width_rel) ** 2)
    keep = w > 1e-300
    return t[keep], w[keep] / w[keep].sum()


def forward(params: Exposure, signal: Signal, stream: Stream) -> Signal:
    """Look at a moving scene at the nodes of the profile; a scene that stands still is the same at all of them."""
    if not signal.own_light.moving or (params.profile == "box" and params.nodes == 1):
        return signal
    times, weights = rule(params)
    at = (signal.time_s[:, None] + signal.exposure_s[:, None] * times)[:, None, :]
    return signal.with_light(signal.own_light.seen_at(at, np.broadcast_to(weights, at.shape)))


def truth(params: Exposure, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """The time that a target's centre belongs to, and the standard deviation in time of the light about it, shape (n, rows) each."""
    times, weights = rule(params.model_copy(update={"nodes": max(params.nodes, 2)}))
    mean = float(weights @ times)
    spread = float(np.sqrt(weights @ (times - mean) ** 2))
    rows = np.ones(signal.frame_shape[0])
    start, length = signal.time_s[:, None] * rows, signal.exposure_s[:, None] * rows
    return {"mean_time_s": start + mean * length, "spread_s": spread * length}


def measure(observations: Observations) -> Estimates:
    """Length of an even exposure by the blur of moving targets, over the stated one."""
    where = "sensor.exposure"
    found = observations.moving({"length_rel": "exposure_s"}, where=where)
    stated = 0.0 if observations.motion is None else observations.motion.stated_exposure_s
    length = found["length_rel"]
    if length.is_limit:
        raise MeasureError(f"the exposure is below {length.value:.2g} s (95 %): {length.reason}", where=where, remedy="move faster")
    if not stated:
        told = f"the exposure is {length.value:.4g} s ± {length.u:.2g} s; that of the camera's setting is not stated"
        raise MeasureError(told, where=where, remedy="state exposure_s of the frames of kind motion in the manifest")
    return replace(found.scaled({"length_rel": (1 / stated, "1")}), settings={"nodes": MEASURED_NODES})


SOURCE = Source(
    id="sensor.exposure",
    title="Motion blur",
    description="A target that moves during the exposure is blurred along its path. Its centre belongs to the mean time of the light.",
    note="Note 4",
    parameters=Exposure,
    consumes=(Kind.LIGHT,),
    before=(
        "sensor.interlace",
        "sensor.light_pulses",
        "sensor.rolling_shutter",
        "sensor.parasitic_light",
        "sensor.trigger_jitter",
    ),
    neutral=Exposure(),
    typical=Exposure(nodes=5),
    bound=Exposure(profile="exponential", nodes=9),
    forward=forward,
    measure=measure,
    truth=truth,
    gum_class="O",
    equation="I(x) = ∫ w(t) L(x − x(t)) dt;  box: length b = v t_exp, variance b²/12 along the motion;  shift ½ a t_exp²/12",
    typical_size="1 px long at 50 px/s and 20 ms; no shift at constant speed if the position is assigned to the middle of the exposure",
    references=(
        "G. H. Golub, J. H. Welsch, Math. Comp. 23, 221, 1969 (Gauss rules of a weight function)",
        "W. Gautschi, Orthogonal Polynomials, Oxford 2004, §2.2 (discretised Stieltjes procedure)",
    ),
    advice="Use a shorter exposure or a strobe, and assign the position to the mean time of the light.",
    reasons={
        "correct": "a target at rest and one that moves give the same frame if its shape is free: the blur needs the target's path. A "
        "centre needs no correction: report the mean time of the light",
        "propagate": "needs the target's speed and acceleration, which the probe does not contain",
    },
)
