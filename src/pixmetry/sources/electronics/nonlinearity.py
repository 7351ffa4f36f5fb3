"""Non-linearity: a smooth response that is not quite a straight line."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import model_validator

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import ParameterError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

LOWEST, HIGHEST = -0.25, 1.25  # of w: where the polynomial holds; beyond, its factor stays as it is there
NEWTON_STEPS = 12


class Nonlinearity(Parameters):
    """Coefficients of the cubic factor; the response must rise everywhere."""

    a1: float = quantity(0.0, "1", "coefficient of w", ge=-1, le=1)
    a2: float = quantity(0.0, "1", "coefficient of w²", ge=-1, le=1)
    a3: float = quantity(0.0, "1", "coefficient of w³", ge=-1, le=1)
    reference_dn: float = quantity(4095.0, "DN", "signal above black at which w = 1, the largest code", gt=0, le=1e9)

    @model_validator(mode="after")
    def _rises(self) -> Nonlinearity:
        w = np.linspace(LOWEST, HIGHEST, 1501)
        if min(np.min(slope(self, w)), np.min(factor(self, w))) <= 0:
            raise ParameterError(
                "the response does not rise over its whole range", value=(self.a1, self.a2, self.a3), remedy="use smaller coefficients"
            )
        return self


def factor(params: Nonlinearity, w: np.ndarray) -> np.ndarray:
    """1 + a1 w + a2 w² + a3 w³."""
    return 1 + w * (params.a1 + w * (params.a2 + w * params.a3))


def slope(params: Nonlinearity, w: np.ndarray) -> np.ndarray:
    """Derivative of x·factor by x within the range of the polynomial."""
    return 1 + w * (2 * params.a1 + w * (3 * params.a2 + w * 4 * params.a3))


def response_dn(params: Nonlinearity, x_dn: np.ndarray) -> np.ndarray:
    """Signal after the non-linearity, in the shape and dtype given."""
    w = np.clip(x_dn * x_dn.dtype.type(1 / params.reference_dn), LOWEST, HIGHEST)
    response: np.ndarray = x_dn * factor(params, w)
    return response


def forward(params: Nonlinearity, signal: Signal, stream: Stream) -> Signal:
    """Bend the response."""
    return signal.with_data(response_dn(params, signal.data))


def measure(observations: Observations) -> Estimates:
    """Read the coefficients from the joint fit to means and variances, or from patches of known light; w is 1 at the largest code."""
    names = tuple(f"a{k}" for k in (1, 2, 3))
    if observations.response is not None and "nonlinearity_a1" in observations.response.fit:
        fit = observations.photon_transfer_fit
        if fit is None or "nonlinearity_a1" not in fit:
            return observations.curve({name: f"nonlinearity_{name}" for name in names}, where="electronics.nonlinearity")
    return observations.fitted(
        {name: f"nonlinearity_{name}" for name in names},
        "non-linearity needs a photon-transfer series of known light",
        where="electronics.nonlinearity",
        remedy="take ten light levels or more",
    )


def correct(params: Nonlinearity, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Undo the response exactly, by Newton's method from the corrected value of a straight line, in float64."""
    y = signal.data.astype(np.float64)
    x = y.copy()
    for _ in range(NEWTON_STEPS):
        w = x / params.reference_dn
        inside = np.clip(w, LOWEST, HIGHEST)
        rate = np.where(w == inside, slope(params, inside), factor(params, inside))
        step = (x * factor(params, inside) - y) / rate
        x -= step
        if np.max(np.abs(step), initial=0.0) < 1e-9 * params.reference_dn:
            break
    return signal.with_data(x.astype(np.float32))


def propagate(params: Nonlinearity, probe: Probe) -> Contribution:
    """Propagator P4: the bent signal seen by the estimator. A symmetric target has no bias, only an S-curve."""
    dx, dy = probe.moved(response_dn(params, probe.signal_dn))
    return probe.from_shifts(dx, dy, "F", model_error=0.3, method="the estimator on the non-linear signal")


SOURCE = Source(
    id="electronics.nonlinearity",
    title="Non-linearity",
    description="The response to light is not a straight line; it deviates by a few per mille to a few per cent.",
    number=20,
    parameters=Nonlinearity,
    consumes=(Kind.DN,),
    after=("sensor",),
    before=("cable", "grabber", "storage"),
    neutral=Nonlinearity(),
    typical=Nonlinearity(a1=-0.005, a2=0.0, a3=-0.01),
    bound=Nonlinearity(a1=-0.02, a2=0.0, a3=-0.03),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="y = x (1 + a1 w + a2 w² + a3 w³),  w = x/x_ref",
    typical_size="below 0.001 px for 2 % on a disc of 7 px",
    references=("EMVA 1288 R4.0 Linear, §6.7 (linearity error)", "F. Wang, A. Theuwissen, Electronic Imaging 2017 (CMOS non-linearity)"),
    leaves="the deviation of the real curve from the polynomial",
    advice="Stay below 80 % of saturation; correct with the measured curve.",
)
