"""Thermal expansion of sensor, package and mount: the image's scale and place follow the temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class ThermalExpansion(Parameters):
    """Coefficients of linear expansion about a point that stays, and the temperature at which the camera was calibrated."""

    reference_c: float = quantity(20.0, "°C", "sensor temperature at which there is no displacement", ge=-100, le=150)
    sensor_per_k: float = quantity(0.0, "1/K", "expansion coefficient of the sensor: silicon 2.6e-6, ceramic package 7e-6", ge=0, le=1e-4)
    mount_per_k: float = quantity(0.0, "1/K", "expansion coefficient of the lens mount: aluminium 23e-6, steel 12e-6", ge=-1e-4, le=1e-3)
    fixed_x_px: float = quantity(0.0, "px", "fixed point minus the frame's centre, along x", ge=-10000, le=10000)
    fixed_y_px: float = quantity(0.0, "px", "fixed point minus the frame's centre, along y", ge=-10000, le=10000)
    shift_x_px_per_k: float = quantity(0.0, "px/K", "displacement of the whole image along x", ge=-1, le=1)
    shift_y_px_per_k: float = quantity(0.0, "px/K", "displacement of the whole image along y", ge=-1, le=1)


def pull_of(params: ThermalExpansion, temperature_c: Any, frame_shape: tuple[int, int]) -> Pull:
    """The map from places on the warm sensor to those at the reference temperature.

    The pixels move apart with the sensor, so that the image shrinks in pixels; the image grows with the principal distance.
    """
    dt = np.asarray(temperature_c, float) - params.reference_c
    scale = (1 + params.sensor_per_k * dt) / (1 + params.mount_per_k * dt)
    x0, y0 = (c + d for c, d in zip(frame_centre(frame_shape), (params.fixed_x_px, params.fixed_y_px), strict=True))
    sx, sy = params.shift_x_px_per_k * dt, params.shift_y_px_per_k * dt
    return lambda x, y: (x0 + (x - x0 - sx) * scale, y0 + (y - y0 - sy) * scale)


def _pull(params: ThermalExpansion, signal: Signal) -> Pull:
    return pull_of(params, signal.temperature_c[:, None, None], signal.frame_shape)


def measure(observations: Observations) -> Estimates:
    """From a series with the temperature of every frame: mount less sensor, which move the image alike, and shifts of the whole image."""
    names = {name: name for name in ("shift_x_px_per_k", "shift_y_px_per_k", "reference_c")}
    return of_pictures(
        None if observations.drift is None else observations.drift.thermal,
        {"mount_per_k": "scale_per_k", **names},
        where="sensor.thermal_expansion",
        pictures="a series of a fixed field with the temperature of every frame (temperatures_c)",
        kind="series",
        failed=observations.failed.get("series", ""),
    )


def forward(params: ThermalExpansion, signal: Signal, stream: Stream) -> Signal:
    """Look from the warm sensor."""
    if not (params.sensor_per_k or params.mount_per_k or params.shift_x_px_per_k or params.shift_y_px_per_k):
        return signal
    return signal.with_light(signal.own_light.moved(_pull(params, signal)))


def truth(params: ThermalExpansion, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, shape (n, rows, cols)."""
    return image_shift(_pull(params, signal), signal)


def propagate(params: ThermalExpansion, probe: Probe) -> Contribution:
    """Displacement of targets all over the frame at the camera's temperature."""
    return map_contribution(pull_of(params, probe.temperature_c, probe.frame_shape), probe, "D")


SOURCE = Source(
    id="sensor.thermal_expansion",
    title="Thermal expansion",
    description="As the camera warms up, its sensor expands and its lens moves away: all image points drift, mostly along the radius.",
    number=8,
    stars=1,
    note="Note 15",
    parameters=ThermalExpansion,
    consumes=(Kind.LIGHT,),
    neutral=ThermalExpansion(),
    typical=ThermalExpansion(reference_c=35.0, sensor_per_k=2.6e-6, mount_per_k=23e-6),
    bound=ThermalExpansion(reference_c=45.0, sensor_per_k=2.6e-6, mount_per_k=40e-6, shift_x_px_per_k=0.01, shift_y_px_per_k=0.01),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="D",
    equation="x' − x₀ = (x − x₀)(1 + α_mount ΔT)/(1 + α_sensor ΔT) + s ΔT",
    typical_size="20 K, at half of 752 columns: 0.02 px by the silicon, 0.17 px by an aluminium mount",
    references=(
        "M. J. Smith, E. Cope, The effects of temperature variation on single-lens-reflex digital camera calibration, IAPRS 38/5 (2010)",
        "K. G. Lyon et al., Linear thermal expansion measurements on silicon, J. Appl. Phys. 48 (1977) 865",
    ),
    advice="Let the camera warm up, keep its temperature constant, and calibrate at the temperature of the measurement.",
    measure=measure,
    reasons={
        "correct": f"{MOVES_POINTS}, from the temperature",
    },
)
