"""Lens shading and uneven light: a smooth factor over the frame, which pulls every target towards its brighter side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import STATED_FRAME, Parameters, Source, quantity
from pixmetry.core.arrays import Singles
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

PLACES = 24  # along each side of the frame, for the spread over it
SMALLEST_FACTOR = 1e-3  # a frame cannot be darker than dark, and the correction divides by this


class Shading(Parameters):
    """A tilted paraboloid about the frame's centre, whose mean over the frame is 1."""

    gradient_x_per_px: float = quantity(0.0, "1/px", "gradient along x at the frame's centre, over the mean light", ge=-0.1, le=0.1)
    gradient_y_per_px: float = quantity(0.0, "1/px", "gradient along y at the frame's centre, over the mean light", ge=-0.1, le=0.1)
    corner_rel: float = quantity(
        0.0, "1", "loss from the centre to the corners (as r²), over the mean light; negative: brighter corners", ge=-0.95, le=0.95
    )


def curvature_per_px2(params: Shading, frame_shape: tuple[int, int]) -> float:
    """Loss per squared distance from the centre, so that a corner pixel loses ``corner_rel``."""
    radius2 = ((frame_shape[0] - 1) ** 2 + (frame_shape[1] - 1) ** 2) / 4
    return params.corner_rel / radius2 if radius2 else 0.0


def factor(params: Shading, signal: Signal) -> np.ndarray:
    """Relative light in every pixel, shape (n, rows, cols), float32; its mean over the frame is 1 unless it is cut off just above 0."""
    loss = curvature_per_px2(params, signal.frame_shape)
    rows, cols = signal.frame_shape
    y, x = signal.rows - (rows - 1) / 2, signal.cols - (cols - 1) / 2
    centre = 1 + loss * (rows**2 + cols**2 - 2) / 12  # the mean of x² over n pixels about their centre is (n² − 1)/12
    along_y = (centre + y * (params.gradient_y_per_px - loss * y)).astype(np.float32)
    along_x = (x * (params.gradient_x_per_px - loss * x)).astype(np.float32)
    shade: Singles = np.maximum(along_y[:, :, None] + along_x[:, None, :], np.float32(SMALLEST_FACTOR))
    return shade


def forward(params: Shading, signal: Signal, stream: Stream) -> Signal:
    """Multiply the light by the factor, or by the smooth map ``light_rel`` that was measured."""
    known = stream.known_fixed("light_rel", signal.grid)
    return signal.with_data(signal.data * (factor(params, signal) if known is None else known))


def measure(observations: Observations) -> Estimates:
    """Read gradient at the centre and loss to the corners from the smooth surface through the flat-field stack.

    Smear adds light that is the same in all rows of a column: what changes from row to row was larger before it by 1 + s/t, and half as
    much more of the loss to the corners, to which rows and columns belong alike.
    """
    found = observations.fitted(
        {"gradient_x_per_px": "shading_x_per_px", "gradient_y_per_px": "shading_y_per_px", "corner_rel": "shading_corner_rel"},
        "shading needs a stack of bright frames and one of dark frames of the same exposure",
        where="optics.shading",
        remedy="take at least 16 of each",
    )
    stack = observations.bright_stack
    if stack is None or not stack.exposure_s:
        return found
    more, u = (v / stack.exposure_s for v in observations.moved_charge("smear_s"))
    share = np.array([{"gradient_y_per_px": 1.0, "corner_rel": 0.5}.get(name, 0.0) for name in found.names])
    by_smear, factor = found.values * share * u, 1 + more * share
    covariance = found.covariance * np.outer(factor, factor) + np.outer(by_smear, by_smear)
    return replace(found, values=found.values * factor, covariance=covariance)


def correct(params: Shading, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide by the factor that the parameters give; it needs no map."""
    return signal.with_data(signal.data / factor(params, signal))


def relative_gradients(params: Shading, frame_shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient over the light itself, along x and y (1/px), at `PLACES` × `PLACES` places spread evenly over the frame."""
    rows, cols = frame_shape
    loss = curvature_per_px2(params, frame_shape)
    even = (np.arange(PLACES) + 0.5) / PLACES - 0.5
    y, x = np.meshgrid(even * rows, even * cols, indexing="ij")
    slope_x, slope_y = params.gradient_x_per_px - 2 * loss * x, params.gradient_y_per_px - 2 * loss * y
    light = 1 + params.gradient_x_per_px * x + params.gradient_y_per_px * y - loss * (x**2 + y**2 - (rows**2 + cols**2 - 2) / 12)
    light = np.maximum(light, SMALLEST_FACTOR)
    return (slope_x / light).ravel(), (slope_y / light).ravel()


def propagate(params: Shading, probe: Probe) -> Contribution:
    """Propagator P3: a relative ramp g moves a centroid by g⟨x²⟩; mean and spread over targets anywhere on the frame."""
    rows, cols = probe.signal_dn.shape[1:]
    ramp_x = (np.arange(cols) - probe.x_px[:, None])[:, None, :] * probe.signal_dn
    ramp_y = (np.arange(rows) - probe.y_px[:, None])[:, :, None] * probe.signal_dn
    (xx, yx), (xy, yy) = probe.field(ramp_x), probe.field(ramp_y)
    gx, gy = (g[:, None] for g in relative_gradients(params, probe.frame_shape))
    return probe.from_shifts(
        gx * xx + gy * xy,
        gx * yx + gy * yy,
        "G",
        model_error=0.15,
        method="linear response of the estimator to the relative gradient, at positions all over the frame",
    )


STEEPEST_PER_PX, ACROSS_REL = 1e-3, 0.5  # of a sound camera: anywhere, and from edge to edge


def bound_over(frame_shape: tuple[int, int]) -> Shading:
    """Light that changes by half of its mean from edge to edge, along either axis, and falls by 0.4 into the corners."""
    along_y, along_x = (min(STEEPEST_PER_PX, ACROSS_REL / side) for side in frame_shape)
    return Shading(gradient_x_per_px=along_x, gradient_y_per_px=along_y, corner_rel=0.4)


SOURCE = Source(
    id="optics.shading",
    title="Lens shading and uneven light",
    description="The light falls off smoothly over the frame. The gradient across a target shifts its centre to the brighter side.",
    parameters=Shading,
    consumes=(Kind.PHOTONS,),
    before=("sensor",),
    neutral=Shading(),
    typical=Shading(gradient_x_per_px=2e-4, gradient_y_per_px=1e-4, corner_rel=0.2),
    bound=bound_over(STATED_FRAME),
    bound_over=bound_over,
    maps={"light_rel": ("gradient_x_per_px", "gradient_y_per_px", "corner_rel")},
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="G",
    equation="µ' = µ (1 + g_x (x − x_c) + g_y (y − y_c) − k (r² − ⟨r²⟩)/r_corner²);  Δx = g ⟨x²⟩",
    typical_size="0.004 to 0.011 px for 0.1 to 0.3 % per px on a disc of 7 px (centroid)",
    references=("ISO 17957:2015 (shading)", "JCGM 100:2008, 5.1.2"),
    leaves="the noise of dim corners, raised with the signal; light from another lamp or lens is shaded in another way",
    advice="Light the object evenly, stop the lens down, and divide by a flat field.",
)
