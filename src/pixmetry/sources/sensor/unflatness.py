"""Sensor unflatness: where the surface lies off its plane, slanting rays meet it aside, and the image is out of focus."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.polynomial.legendre import legval

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.geometry import corner_px, frame_centre, image_shift, map_contribution
from pixmetry.camera.light import Pull
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import MOVES_POINTS, Parameters, Source, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream


class Unflatness(Parameters):
    """Height of the surface by Legendre polynomials over the frame, from -1 to 1 along x and y; positive is farther from the lens."""

    bow_x_um: float = quantity(
        0.0,
        "µm",
        "P₂ along x: bow of the surface; the edges on the left and right are at this height, the middle at −0.5 times",
        ge=-1000,
        le=1000,
    )
    bow_y_um: float = quantity(0.0, "µm", "P₂ along y", ge=-1000, le=1000)
    twist_um: float = quantity(0.0, "µm", "P₁ along x times P₁ along y: height of two opposite corners", ge=-1000, le=1000)
    skew_x_um: float = quantity(0.0, "µm", "P₃ along x", ge=-1000, le=1000)
    skew_y_um: float = quantity(0.0, "µm", "P₃ along y", ge=-1000, le=1000)
    more_um: tuple[tuple[float, ...], ...] = quantity(
        (), "µm", "further coefficients of P_j(y) P_i(x), row j and column i from 0, added to those above"
    )
    chief_ray_deg: float = quantity(10.0, "deg", "angle of the image-side chief ray in the frame's corners; 0: telecentric", ge=0, le=60)
    f_number: float = quantity(8.0, "1", "working f-number, for the defocus", ge=0.7, le=64)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)


def coefficients_um(params: Unflatness) -> np.ndarray:
    """All coefficients, row j of P_j(y) and column i of P_i(x)."""
    width = max([4, *(len(row) for row in params.more_um)])
    c = np.zeros((max(4, len(params.more_um)), width))
    c[0, 2], c[2, 0], c[1, 1] = params.bow_x_um, params.bow_y_um, params.twist_um
    c[0, 3], c[3, 0] = params.skew_x_um, params.skew_y_um
    for j, row in enumerate(params.more_um):
        c[j, : len(row)] += row
    return c


def height_um(params: Unflatness, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Height at some places; the edges of the frame are those of its outer pixels."""
    x0, y0 = frame_centre(frame_shape)
    u, v = (x - x0) / (x0 + 0.5), (y - y0) / (y0 + 0.5)
    total = 0.0
    for j, row in enumerate(coefficients_um(params)):
        if row.any():
            total = total + legval(u, row) * legval(v, np.eye(j + 1)[j])
    return np.broadcast_to(total, np.broadcast_shapes(np.shape(x), np.shape(y)))


def pull_of(params: Unflatness, frame_shape: tuple[int, int]) -> Pull:
    """The map from the surface to its plane: a point at r in the plane is met at r + Δz tan θ(r), where tan θ grows as r."""
    x0, y0 = frame_centre(frame_shape)
    radius_um = corner_px(frame_shape, params.pitch_y_um / params.pitch_x_um) * params.pitch_x_um
    slope = np.tan(np.radians(params.chief_ray_deg)) / radius_um

    def pull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale = 1 + slope * height_um(params, x, y, frame_shape)
        return x0 + (x - x0) / scale, y0 + (y - y0) / scale

    return pull


def defocus_px2(params: Unflatness, x: np.ndarray, y: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Variance along each axis of the blur disc of diameter |Δz|/N: (Δz/4N)², over the area of a pixel."""
    area = params.pitch_x_um * params.pitch_y_um
    return (height_um(params, x, y, frame_shape) / (4 * params.f_number)) ** 2 / area


def measure(observations: Observations) -> Estimates:
    """Bow, twist and skew by the residuals of a calibration, without what its lens and poses take up; without one, bow and twist by the
    focus over the frame, without what is curved as the square of the radius."""
    focus = None if observations.focus is None else observations.focus.fit
    if observations.geometry is None and focus is not None:
        names = ("bow_x_um", "bow_y_um", "twist_um", *(("f_number",) if "bow_x_um" in focus else ()))
        return of_pictures(focus, {n: n for n in names}, where="sensor.unflatness", pictures="edges at several focus settings", kind="edge")
    return observations.by_residuals(where="sensor.unflatness")


def forward(params: Unflatness, signal: Signal, stream: Stream) -> Signal:
    """Move and defocus the light by the height of the surface."""
    if not coefficients_um(params).any():
        return signal
    shape, light = signal.frame_shape, signal.own_light
    if params.chief_ray_deg:
        light = light.moved(pull_of(params, shape))
    return signal.with_light(light.blurred_by_place(lambda x, y: defocus_px2(params, x, y, shape)))


def truth(params: Unflatness, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Height and displacement of the image at every pixel, shape (rows, cols)."""
    x, y = signal.cols[:1, None, :].astype(float), signal.rows[:1, :, None].astype(float)
    moved = {name: shift[0] for name, shift in image_shift(pull_of(params, signal.frame_shape), signal).items()}
    return {**moved, "height_um": height_um(params, x, y, signal.frame_shape)[0]}


def propagate(params: Unflatness, probe: Probe) -> Contribution:
    """Displacement Δz tan θ of targets all over the frame."""
    return map_contribution(pull_of(params, probe.frame_shape), probe)


SOURCE = Source(
    id="sensor.unflatness",
    title="Sensor unflatness",
    description="Oblique rays hit a bowed or twisted sensor at shifted positions, and parts of it are out of focus. This matters with "
    "wide-angle lenses.",
    number=6,
    stars=2,
    note="Note 10",
    parameters=Unflatness,
    consumes=(Kind.LIGHT,),
    neutral=Unflatness(),
    typical=Unflatness(bow_x_um=5.0, bow_y_um=3.0, twist_um=2.0),
    bound=Unflatness(bow_x_um=15.0, bow_y_um=10.0, twist_um=5.0, skew_x_um=2.0, chief_ray_deg=15.0),
    forward=forward,
    truth=truth,
    propagate=propagate,
    gum_class="G",
    equation="Δr = Δz tan θ',  σ = |Δz|/(4N)",
    typical_size="10 µm: 0.42 px at 20°, 0.17 px at 8.2° (8.6 µm pixels)",
    references=("C. S. Fraser, Digital camera self-calibration, ISPRS J. 52 (1997) 149–159", "VDI/VDE 2634-1"),
    advice="Measure the surface separately, use a lens that is telecentric on the image side, or roll the camera in the calibration.",
    measure=measure,
    reasons={
        "correct": f"{MOVES_POINTS}, from the height map",
    },
)
