"""Pixel geometry: pixels that do not lie on their grid, each by a little, or whole fields of the lithography by a step."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import image_shift
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream


class PixelGeometry(Parameters):
    """Standard deviations along each axis, fixed in the unit."""

    pixel_std_px: float = quantity(0.0, "px", "standard deviation of each pixel's position", ge=0, le=0.2)
    field_std_px: float = quantity(
        0.0, "px", "standard deviation of the position of each field that is exposed in one step on the wafer", ge=0, le=1
    )
    fields_x: int = quantity(1, "1", "number of fields side by side", ge=1, le=32)
    fields_y: int = quantity(1, "1", "number of fields one above the other", ge=1, le=32)


def displacements(params: PixelGeometry, grid: Grid, stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Place of every pixel less that on the grid, within its field; float64, shape (n, rows, cols) each."""
    dx, dy = (params.pixel_std_px * stream.normal_fixed(grid, draw).astype(float) for draw in (0, 1))
    return dx, dy


def pull_of(params: PixelGeometry, frame_shape: tuple[int, int], stream: Stream) -> Pull:
    """The map that moves each field as a whole; seams lie between pixels."""
    rows, cols = frame_shape
    fields = params.fields_y, params.fields_x
    step_x, step_y = params.field_std_px * stream.normal_unit(2 * fields[0] * fields[1]).astype(float).reshape(2, *fields)

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        i = np.clip(np.floor((y + 0.5) * fields[0] / rows), 0, fields[0] - 1).astype(int)
        j = np.clip(np.floor((x + 0.5) * fields[1] / cols), 0, fields[1] - 1).astype(int)
        return x + step_x[i, j], y + step_y[i, j]

    return pull


def measure(observations: Observations) -> Estimates:
    """Steps between equal fields of the frame, by the residuals of a calibration; targets average over the places of single pixels."""
    return observations.by_residuals(where="sensor.pixel_geometry")


def forward(params: PixelGeometry, signal: Signal, stream: Stream) -> Signal:
    """Look from where the pixels really lie."""
    light = signal.own_light
    if params.field_std_px:
        light = light.moved(pull_of(params, signal.frame_shape, stream))
    if params.pixel_std_px:
        light = light.jittered(*displacements(params, signal.grid, stream))
    return signal.with_light(light)


def truth(params: PixelGeometry, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Displacement of the image at every pixel, which is that of the pixel with the other sign; shape (rows, cols)."""
    dx, dy = displacements(params, signal.grid, stream)
    fields = image_shift(pull_of(params, signal.frame_shape, stream), signal)
    return {"shift_x_px": fields["shift_x_px"][0] - dx[0], "shift_y_px": fields["shift_y_px"][0] - dy[0]}


def propagate(params: PixelGeometry, probe: Probe) -> Contribution:
    """Propagator P1 with the error δ·∇I of every pixel (the gradient by Fourier), and the step of a whole field."""
    slopes = []
    for axis in (1, 2):
        f = 2j * np.pi * np.fft.fftfreq(probe.signal_dn.shape[axis])
        spectrum = np.fft.fft(probe.signal_dn, axis=axis) * (f[:, None] if axis == 1 else f)
        slopes.append(np.fft.ifft(spectrum, axis=axis).real)
    ux, uy = probe.white(params.pixel_std_px * np.hypot(*slopes))
    ux, uy = (float(np.hypot(u, params.field_std_px)) for u in (ux, uy))
    method = "linear response of the estimator to displaced pixels, and the step of a field"
    return Contribution(ux, uy, "F", model_error=0.15, method=method)


SOURCE = Source(
    id="sensor.pixel_geometry",
    title="Pixel geometry",
    description="The positions of the pixels scatter about their grid. A sensor that is stitched from several exposures has steps "
    "between its fields.",
    stars=1,
    note="Note 22",
    parameters=PixelGeometry,
    consumes=(Kind.LIGHT,),
    neutral=PixelGeometry(),
    typical=PixelGeometry(pixel_std_px=0.005),
    bound=PixelGeometry(pixel_std_px=0.02, field_std_px=0.02, fields_x=2, fields_y=2),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="F",
    equation="x_n = n + δ_n + δ_field;  u = δ √(Σ (x − x_c)² |∇I|²)/S",
    typical_size="0.16 of the pixels' standard deviation on a disc of 7 px: 0.0016 px for 0.01 px",
    references=(
        "S. B. Shaklan, M. C. Sharman, S. H. Pravdo, High-precision pixel positions for CCDs, Applied Optics 34 (1995) 6672–6681",
        "JCGM 100:2008, 5.1.2",
    ),
    advice="Usually nothing: it is far smaller than other errors. Keep targets away from the seams of a stitched sensor.",
    measure=measure,
    reasons={
        "correct": f"{MOVES_POINTS}, by a map of the residuals of a calibration",
    },
)
