"""Gamma: a camera set to the power curve that a television tube wants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.response import TOES, toe_shape
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

LOWEST, HIGHEST = 0.3, 1.0  # exponents that a camera can be set to
DARKEST, BRIGHTEST = 0.1, 0.8  # of the brightest level above black: the levels that are compared with a power curve
LEVELS = 6  # at least, for the three numbers of a curve
TOE = TOES["bt709"]
LIGHT_RATIO = 2.0  # at least, between the brightest and the darkest of them


class Gamma(Parameters):
    """The setting, and the signal that it does not change."""

    gamma: float = quantity(1.0, "1", "exponent of the curve: 1 is linear, 0.45 is the usual other setting", ge=LOWEST, le=HIGHEST)
    reference_dn: float = quantity(4095.0, "DN", "signal above black at which the curve meets the straight line", gt=0, le=1e9)
    toe: Literal["none", "bt709"] = quantity("none", "1", "bt709: straight below 0.018 of the reference, as in television cameras")


def curve_dn(x_dn: np.ndarray, gamma: float, reference_dn: float, toe: str = "none") -> np.ndarray:
    """Apply the curve, odd about black so that noise below black stays below; shape and dtype as given."""
    number = x_dn.dtype.type
    share = np.abs(x_dn) * number(1 / reference_dn)
    y = np.power(share, number(gamma))
    if toe != "none":
        alpha, slope = toe_shape(gamma, toe)
        y = np.where(share < TOE, number(slope) * share, number(alpha) * y - number(alpha - 1))
    curved: np.ndarray = np.copysign(number(reference_dn) * y, x_dn)
    return curved


def straight_dn(y_dn: np.ndarray, gamma: float, reference_dn: float, toe: str) -> np.ndarray:
    """Undo `curve_dn`, in float64."""
    alpha, slope = toe_shape(gamma, toe)
    share = np.abs(y_dn) / reference_dn
    x = np.power((share + (alpha - 1)) / alpha, 1 / gamma)
    if toe != "none":
        x = np.where(share < slope * TOE, share / slope, x)
    straight: Array = np.copysign(reference_dn * x, y_dn)
    return straight


def forward(params: Gamma, signal: Signal, stream: Stream) -> Signal:
    """Bend the response; a gamma of 1 leaves the very same bits."""
    return signal if params.gamma == 1 else signal.with_data(curve_dn(signal.data, params.gamma, params.reference_dn, params.toe))


def correct(params: Gamma, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Undo the curve by its inverse, in float64."""
    if params.gamma == 1:
        return signal
    linear = straight_dn(signal.data.astype(np.float64), params.gamma, params.reference_dn, params.toe)
    return signal.with_data(linear.astype(np.float32))


def measure(observations: Observations) -> Estimates:
    """Give the exponent that patches of known light tell; without them a gamma of 1, with how well the level means agree with it.

    A chart, or one scene at several exposures, tells any exponent, and of a curve with a toe its reference. Light and dark show one
    curve: what bend there is `electronics.nonlinearity` holds, and it must not be counted twice. The photon transfer refuses a curve that
    a gamma setting makes. The agreement is δ of mean = b + c light^(1 + δ), of first order in δ, once the measured non-linearity is taken
    out.
    """
    chart = observations.response
    if chart is not None and (chart.curve or not _has_levels(observations)):
        return observations.curve(("gamma", "reference_dn"), where="electronics.gamma")
    light, signal = _straight_levels(observations)
    design = np.stack([np.ones_like(light), light, light * np.log(light)], axis=1)
    found = np.linalg.lstsq(design, signal, rcond=None)[0]
    variance = float(((signal - design @ found) ** 2).sum()) / (light.size - 3)
    delta = float(found[2] / found[1])
    u_delta = float(np.sqrt(np.linalg.inv(design.T @ design)[2, 2] * variance) / abs(found[1]))
    return Estimates.from_rows(
        [("gamma", 1.0, float(np.hypot(delta, u_delta)), float(light.size - 3), "1")],
        method="least-squares fit of a power law with a free offset to the level means, linearised by the measured non-linearity",
        confounders=("light that is not proportional to the exposure time looks like a camera with gamma",),
        reasons={"gamma": f"electronics.nonlinearity contains the curvature of the response; beyond it the exponent is {1 + delta:.4g}"},
    )


def _has_levels(observations: Observations) -> bool:
    """Whether there is a photon transfer that tells a bend."""
    fit = observations.photon_transfer_fit
    return fit is not None and "nonlinearity_a1" in fit


def _straight_levels(observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Light and straightened mean above black of the levels that can be used, each as part of its largest; shape (levels,)."""
    bend = observations.fitted(
        {f"a{k}": f"nonlinearity_a{k}" for k in (1, 2, 3)},
        "gamma needs a photon-transfer series of known light",
        where="electronics.gamma",
        remedy="take ten light levels or more",
    )
    transfer = observations.photon_transfer
    if transfer is None:
        raise MeasureError(
            "gamma needs the levels of a photon-transfer series", where="electronics.gamma", remedy="take ten light levels or more"
        )
    bright = transfer.bright
    known = bright.photons is not None and bool(np.isfinite(bright.photons).all())
    light = np.asarray(bright.photons if known else bright.exposure_s, float)
    stored = bright.mean_dn - transfer.dark.mean_dn.mean()
    share = stored / max(float(stored.max(initial=0.0)), 1e-9)
    keep = (share > DARKEST) & (share < BRIGHTEST) & (light > 0)
    light, stored = light[keep], stored[keep]
    if len(light) < LEVELS or light.max() < LIGHT_RATIO * light.min():
        raise MeasureError(
            "too few light levels to distinguish a power curve from a straight line",
            where="electronics.gamma",
            value=len(light),
            allowed=f"{LEVELS} or more between {DARKEST:.0%} and {BRIGHTEST:.0%} of the brightest, light in a ratio of {LIGHT_RATIO:g}",
            remedy="take ten light levels or more in about equal steps",
        )
    a1, a2, a3 = bend.values
    w = np.linspace(0, 1.25, 5001)
    signal = np.interp(stored / (2**transfer.bits - 1), w * (1 + w * (a1 + w * (a2 + w * a3))), w)
    return light / light.max(), signal / signal.max()


def propagate(params: Gamma, probe: Probe) -> Contribution:
    """Propagator P4 for an estimator whose threshold and scale follow the light.

    The curve changes a target by far more than a first order bears, but most of that is a new scale and a new black: they move no centroid.
    With T the darkest signal that the estimator answers to, x − T becomes g(x) − g(T); brought back to the same sum over the pixels that it
    answers to, the difference is the error field. For a centroid above a soft threshold this is exact: Σ(g − g_T)(x_i − x̂)/Σ(g − g_T).
    Squared and hard laws are not told from it in a probe and can be off by as much as the contribution: hence the model error of 1.
    """
    x = np.asarray(probe.signal_dn, float)
    seen = (probe.gx != 0) | (probe.gy != 0)
    darkest = np.array(x[seen].min() if seen.any() else probe.background_dn)
    above = np.where(seen, x - darkest, 0.0)
    bent = curve_dn(x, params.gamma, params.reference_dn, params.toe) - curve_dn(darkest, params.gamma, params.reference_dn, params.toe)
    bent = np.where(seen, bent, 0.0)
    before, after = (v.sum(axis=(1, 2), keepdims=True) for v in (above, bent))
    scale = np.divide(before, after, out=np.zeros_like(before), where=after > 0)
    dx, dy = probe.field(bent * scale - above)
    method = "linear response of the estimator to the bent signal, scaled back; its threshold follows the light"
    return probe.from_shifts(dx, dy, "F", model_error=1.0, method=method)


SOURCE = Source(
    id="electronics.gamma",
    title="Gamma",
    description="The camera applies a power curve for display. Edges become wider; noise rises in the dark and falls in the light.",
    number=23,
    stars=3,
    note="Note 5",
    parameters=Gamma,
    consumes=(Kind.DN,),
    after=("sensor", "electronics.agc", "electronics.nonlinearity"),
    before=("cable", "grabber", "storage"),
    neutral=Gamma(),
    typical=Gamma(gamma=0.45),
    bound=Gamma(gamma=0.45),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="y = y_max (x/y_max)^γ,  γ = 0.45 or 1;  bt709: y/y_max = 1.099 (x/y_max)^γ − 0.099, below 0.018 4.5 x/y_max",
    typical_size="0.0017 px for 0.45 on a disc of 7 px, if the threshold follows the light",
    references=("ITU-R BT.709-6, item 1.2 (exponent 0.45, toe)", "EMVA 1288 R4.0 Linear, §6.7 (linearity error)"),
    leaves="rounding, which is coarser where the curve is flat",
    advice="Set the camera to gamma 1. If this is impossible, apply the inverse curve before any other step.",
)
