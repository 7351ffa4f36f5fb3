"""Full well: the largest number of electrons in a pixel; above it more light has no effect."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Singles
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream

UNLIMITED_E = 1e9


class FullWell(Parameters):
    """Capacity of a pixel and how softly it is reached."""

    full_well_e: float = quantity(20_000.0, "e-", "most electrons that a pixel holds", gt=1, le=UNLIMITED_E)
    knee_rel: float = quantity(
        0.0, "1", "share of the capacity, below the top, in which the response is curved; 0: hard clipping", ge=0, lt=1
    )
    spread_rel: float = quantity(0.0, "1", "relative standard deviation of the capacity from pixel to pixel", ge=0, le=0.2)


def capacity_e(params: FullWell, grid: Grid, stream: Stream) -> np.ndarray | float:
    """Capacity of every pixel, shape (n, rows, cols), or the one number that all have."""
    if params.spread_rel == 0:
        return params.full_well_e
    spread = np.float32(params.spread_rel) * stream.normal_fixed(grid)
    capacity: Singles = np.float32(params.full_well_e) * np.maximum(1 + spread, np.float32(1e-3))
    return capacity


def response_e(params: FullWell, electrons: np.ndarray, capacity: np.ndarray | float | None = None) -> np.ndarray:
    """Electrons held of those that arrived, in the dtype given: a straight line up to the knee, then an exponential approach."""
    top = params.full_well_e if capacity is None else capacity
    if params.knee_rel == 0:
        held: np.ndarray = np.minimum(electrons, np.asarray(top, electrons.dtype))
        return held
    room = params.knee_rel * top
    above = np.maximum(electrons - (top - room), 0)
    return (electrons - above - room * np.expm1(-above / room)).astype(electrons.dtype)


def forward(params: FullWell, signal: Signal, stream: Stream) -> Signal:
    """Hold what fits; the rest is lost here (``sensor.blooming`` is for charge that spills into the neighbours)."""
    return signal.with_data(response_e(params, signal.data, capacity_e(params, signal.grid, stream)))


def truth(params: FullWell, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Capacity of every pixel of the unit."""
    one = signal.take(np.array([0]))
    return {"full_well_e": np.broadcast_to(np.float32(capacity_e(params, one.grid, stream)), one.grid.size)[0].copy()}


def measure(observations: Observations) -> Estimates:
    """Read the saturation of the photon transfer in electrons; where the converter clips first it is a lower bound, and says so."""
    fit, transfer = observations.photon_transfer_fit, observations.photon_transfer
    if fit is not None and "full_well_e" in fit:
        return fit.select(["full_well_e"])
    spots = observations.spots
    if fit is not None and "gain_dn_per_e" in fit and spots is not None and "plateau_dn" in spots.fit:
        gain, plateau = fit["gain_dn_per_e"], spots.fit["plateau_dn"]
        u = float(np.hypot(plateau.u, plateau.value * gain.u / gain.value) / gain.value)
        return Estimates.from_rows(
            [("full_well_e", plateau.value / gain.value, u, gain.dof, "e-")],
            method="level at which overexposed spots stop to grow",
            lower_limits=frozenset({"full_well_e"}) if spots.clipped else frozenset(),
            reasons={"full_well_e": "lower bound: the converter ends first"} if spots.clipped else {},
        )
    if fit is None or transfer is None or not transfer.bright.mean_dn.size:
        raise MeasureError("full well needs a photon-transfer series", where="sensor.full_well", remedy="add levels up to saturation")
    gain, offset = fit["gain_dn_per_e"], fit["offset_dn"]
    brightest = float(transfer.bright.mean_dn.max() - offset.value) / gain.value
    u = float(np.hypot(brightest * gain.u, offset.u) / gain.value)
    return Estimates.from_rows(
        [("full_well_e", brightest, u, gain.dof, "e-")],
        method="brightest level of the photon transfer",
        lower_limits=frozenset({"full_well_e"}),
        reasons={"full_well_e": "lower bound: no level is saturated; add levels until the mean no longer rises"},
    )


def propagate(params: FullWell, probe: Probe) -> Contribution:
    """Propagator P4: the target clipped at the mean capacity, seen by the estimator; nothing below the knee."""
    gain = probe.gain_dn_per_e
    electrons = probe.signal_dn / gain
    if electrons.max() <= params.full_well_e * (1 - params.knee_rel):
        return probe.contribution((0.0, 0.0), "F", method="the target is below the full well")
    dx, dy = probe.moved(gain * response_e(params, electrons))
    return probe.from_shifts(dx, dy, "F", model_error=0.5, method="the estimator on the clipped target")


SOURCE = Source(
    id="sensor.full_well",
    title="Full well",
    description="Electrons beyond the capacity of a pixel are lost; the top of a bright target becomes flat.",
    parameters=FullWell,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise",),
    before=("sensor.charge_transfer",),
    neutral=FullWell(full_well_e=UNLIMITED_E),
    typical=FullWell(),
    bound=FullWell(knee_rel=0.2),
    forward=forward,
    truth=truth,
    measure=measure,
    propagate=propagate,
    gum_class="F",
    equation="n' = min(n, F);  with a knee k: n' = s + kF (1 − e^(−(n − s)/kF)) above s = (1 − k) F",
    typical_size="below 0.005 px for a target 1.5 × over the full well, without blooming",
    references=("EMVA 1288 R4.0 Linear, §6.6", "J. R. Janesick, Photon Transfer, SPIE Press 2007, ch. 5"),
    advice="Lower the exposure until the target peaks at 80 % of saturation.",
    reasons={
        "correct": "all signals above the full well give the same value. Flag saturated pixels, or fit them as 'at least the full well'"
    },
)
