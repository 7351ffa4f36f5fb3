"""Brighter-fatter effect: the charge of a pixel repels further charge into its neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Stream
from pixmetry.sources.sensor._charge_kernels import move_borders

ITERATIONS = 5
RADIUS = 2  # px over which the field of a packet is felt
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
    if signal.kind != Kind.ELECTRONS:
        raise ParameterError("the shift of borders needs a signal in electrons", value=str(signal.kind), remedy="divide by the gain")
    y = signal.data.astype(np.float32)
    if not params.area_loss_per_e:
        return signal.with_data(y)
    w = weights(params)
    x = y
    for _ in range(ITERATIONS):
        x = x + (y - move_borders(x, w, params.area_loss_per_e / (4 * (1 - w[1])), FARTHEST))
    return signal.with_data(x)


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
    reasons={"measure": "needs the covariances of neighbouring pixels in pairs of flat fields at several levels"},
)
