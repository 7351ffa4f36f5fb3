"""Brighter-fatter effect: the charge of a pixel repels further charge into its neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.noise_covariance import CHARGE, WHITE, NoiseFilter, charge_response
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import MeasureError, ParameterError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.sensor._charge_kernels import move_borders

ITERATIONS = 5
RADIUS = 2  # px over which the field of a packet is felt
METHOD = "growth with the signal of the autocovariance of flat-field pairs, up to 4 px (P. Astier et al., A&A 629, A36, 2019)"
CONFOUNDERS = ("brighter-fatter effect: a smoothing filter in the camera whose noise is far above that of the dark frames",)
FARTHEST = 0.5  # px by which a border moves at most


class BrighterFatter(Parameters):
    """How much area a pixel loses by its charge."""

    area_loss_per_e: float = quantity(
        0.0, "1/e-", "relative loss of area per electron of excess over the surrounding pixels", ge=0, le=1e-5
    )
    field_px: float = quantity(0.0, "px", "reach s of the repulsion e^(−d²/2s²); 0: only the pixel's own charge acts", ge=0, le=1)


def weights(params: BrighterFatter) -> np.ndarray:
    """Repulsion at 0, 1, … `RADIUS` pixels along an axis, 1 at the pixel itself."""
    d = np.arange(RADIUS + 1.0)
    return np.exp(-0.5 * (d / params.field_px) ** 2) if params.field_px else (d == 0).astype(float)


def forward(params: BrighterFatter, signal: Signal, stream: Stream) -> Signal:
    """Move charge across the borders of pixels; all of it stays on the sensor."""
    if not params.area_loss_per_e:
        return signal
    data = np.ascontiguousarray(signal.data, np.float32)
    w = weights(params)
    return signal.with_data(move_borders(data, w, params.area_loss_per_e / (4 * (1 - w[1])), FARTHEST))


def context(params: BrighterFatter, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The pixels whose charge moves the borders of the window."""
    reach = RADIUS + 1 if params.area_loss_per_e else 0
    return windows.expand(reach, reach, reach, reach, frame_shape)


def correct(params: BrighterFatter, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Invert the forward model by fixed-point steps x ← x + (y − F(x)), on signals in electrons.

    Raises
    ------
    ParameterError
        If the signal is not in electrons.
    """
    if not params.area_loss_per_e:
        return signal
    if signal.kind != Kind.ELECTRONS:
        raise ParameterError("the shift of borders needs a signal in electrons", value=str(signal.kind), remedy="divide by the gain")
    y = signal.data.astype(np.float32)
    w = weights(params)
    x = y
    for _ in range(ITERATIONS):
        x = x + (y - move_borders(x, w, params.area_loss_per_e / (4 * (1 - w[1])), FARTHEST))
    return signal.with_data(x)


def measure(observations: Observations) -> Estimates:
    """Read how the correlation of neighbouring pixels grows with the light of flat fields; the gain turns the signal into electrons.

    The loss of variance b for each DN² of shot variance is a/K². A reach of the repulsion, or a loss, that does not stand out by three u is
    a 95 % limit; the limit of the loss is that of the reach for which it is largest.
    """
    found, fit = observations.noise_filter, observations.photon_transfer_fit
    where, remedy = "sensor.brighter_fatter", "take pairs of flat fields at ten levels or more, raw and without any filter in the camera"
    if found is not None and (found.kind not in (WHITE, CHARGE) or (found.kind == CHARGE and found.fit["loss"].value < 0)):
        what = f"what correlates neighbouring pixels ({found.name}) hides how their correlation grows with the signal"
        raise MeasureError(what, where=where, remedy=remedy)
    if found is None or fit is None or "gain_dn_per_e" not in fit:
        raise MeasureError("needs the shot noise of flat fields and the gain", where=where, remedy=remedy)
    gain, brightest = fit["gain_dn_per_e"], float(found.shot_dn2.max())
    reaches = np.linspace(0.0, 1.0, 21)
    losses, u_losses, misfits = np.array([_loss_at(found, float(reach), brightest) for reach in reaches]).T
    per_dn2 = gain.value**2 / brightest
    if found.kind == WHITE:
        limit, u = max(((max(a, 0.0) + ONE_SIDED_95 * u) * per_dn2, u * per_dn2) for a, u in zip(losses, u_losses, strict=True))
        why = {"area_loss_per_e": "the correlation of neighbours does not grow with the light; 95 % upper limit, for any reach up to 1 px"}
        row = ("area_loss_per_e", min(limit, 1e-5), u, np.inf, "1/e-")
        return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS, limits=frozenset({"area_loss_per_e"}), reasons=why)
    loss, reach = found.fit["loss"], found.fit["field_px"]
    u_area = per_dn2 * float(np.hypot(loss.u, 2 * loss.value * gain.u / gain.value))
    limits, reasons, field, u_field = frozenset[str](), {}, reach.value, reach.u
    if misfits[0] - misfits.min() < 9.0:
        within = reaches[misfits < misfits.min() + ONE_SIDED_95**2]
        field, limits = float(within.max()), frozenset({"field_px"})
        u_field = float(max(field - reach.value, 0.05) / ONE_SIDED_95)
        reasons = {"field_px": "neighbours that do not touch the pixel gain nothing; 95 % upper limit"}
    names, units, values = ("area_loss_per_e", "field_px"), ("1/e-", "px"), np.array([loss.value * per_dn2, field])
    covariance = np.diag([u_area**2, u_field**2])
    if not limits:
        covariance[0, 1] = covariance[1, 0] = found.fit.covariance[0, 1] * per_dn2
    return Estimates(names, values, covariance, np.full(2, np.inf), units, METHOD, CONFOUNDERS, limits, reasons=reasons)


def _loss_at(found: NoiseFilter, reach_px: float, brightest_dn2: float) -> tuple[float, float, float]:
    """Loss of variance at the brightest level if the repulsion has this reach, its u, and χ²: least squares on all lags."""
    weak = 1e-4
    pattern = charge_response(weak / brightest_dn2, reach_px, np.array([brightest_dn2]))[1][0] / (weak * brightest_dn2**2)
    weighed = np.linalg.solve(found.growth_covariance, pattern)
    power = float(pattern @ weighed)
    loss = float(weighed @ found.growth_per_dn2[1:]) / power
    left = found.growth_per_dn2[1:] - loss * pattern
    return loss, power**-0.5, float(left @ np.linalg.solve(found.growth_covariance, left))


def propagate(params: BrighterFatter, probe: Probe) -> Contribution:
    """Propagator P4: the estimator on the target with its borders moved; symmetric targets are widened and hardly moved."""
    if not params.area_loss_per_e:
        return probe.contribution((0.0, 0.0), "F")
    w = weights(params)
    electrons = np.ascontiguousarray(probe.signal_dn / probe.gain_dn_per_e, np.float32)
    moved = move_borders(electrons, w, params.area_loss_per_e / (4 * (1 - w[1])), FARTHEST).astype(float) - electrons
    dx, dy = probe.moved(probe.signal_dn + probe.gain_dn_per_e * moved)
    return probe.from_shifts(dx, dy, "F", model_error=0.2, method="the estimator on the widened target")


SOURCE = Source(
    id="sensor.brighter_fatter",
    title="Brighter-fatter effect",
    description="The charge in a pixel repels further charge across its borders: bright spots become wider, and neighbouring pixels "
    "correlated.",
    parameters=BrighterFatter,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise",),
    before=("sensor.full_well", "sensor.charge_transfer", "electronics"),
    neutral=BrighterFatter(),
    typical=BrighterFatter(area_loss_per_e=5e-7),
    bound=BrighterFatter(area_loss_per_e=3e-6, field_px=0.5),
    forward=forward,
    context=context,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="across a border: ½ · (q₁ + q₂)/2 · a (φ₁ − φ₂), φ = w ∗ q;  flat field: σ² = µ − A µ², A = 4a (1 − w₁)",
    typical_size="variance of a flat field 1 % too low at 20 000 electrons; the variance of a Gaussian spot of peak P becomes σ² + A P/16",
    references=(
        "P. Antilogus et al., JINST 9, C03048, 2014 (borders that move with the charge)",
        "P. Astier et al., A&A 629, A36, 2019 (its photon transfer)",
    ),
    leaves="what charge moves beyond the reach of the model; full pixels, whose charge is not known",
    advice="Calibrate and measure at the same brightness. Correct in electrons with the measured loss of area.",
)
