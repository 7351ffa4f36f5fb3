"""Microlenses: light that arrives aslant is lost in part, the more the farther from the angle that they are made for."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.geometry import corner_px, factor_verbs, frame_centre
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array


class Microlens(Parameters):
    """Acceptance about the chief ray. The tangents of both angles grow in proportion to the distance from the frame's centre."""

    chief_ray_deg: float = quantity(0.0, "deg", "angle of the chief ray in the frame's corners; 0: telecentric", ge=0, le=60)
    design_ray_deg: float = quantity(0.0, "deg", "chief-ray angle in the corners for which the microlenses are designed", ge=0, le=60)
    acceptance_deg: float = quantity(20.0, "deg", "standard deviation of the response against angle", ge=3, le=90)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)


def factor(params: Microlens, x_px: np.ndarray, y_px: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Relative response at some places, 1 where the ray comes as designed; float64."""
    x0, y0 = frame_centre(frame_shape)
    aspect = params.pitch_y_um / params.pitch_x_um
    r = np.hypot(x_px - x0, aspect * (y_px - y0)) / corner_px(frame_shape, aspect)
    chief, design = (np.arctan(np.tan(np.radians(a)) * r) for a in (params.chief_ray_deg, params.design_ray_deg))
    accepted: Array = np.exp(-0.5 * ((chief - design) / np.radians(params.acceptance_deg)) ** 2)
    return accepted


SOURCE = Source(
    id="sensor.microlens",
    title="Microlenses and the chief ray's angle",
    description="Microlenses focus light onto the sensitive area. They lose light if the chief ray comes at another angle than designed.",
    number=5,
    parameters=Microlens,
    consumes=(Kind.PHOTONS,),
    before=("sensor.dark_current", "sensor.shot_noise"),
    neutral=Microlens(),
    typical=Microlens(chief_ray_deg=12.0, design_ray_deg=5.0, acceptance_deg=15.0),
    bound=Microlens(chief_ray_deg=20.0, design_ray_deg=0.0, acceptance_deg=15.0),
    **factor_verbs(factor),
    option="shading that is described by optical data; measured shading is in optics.shading",
    gum_class="G",
    equation="µ' = µ exp(−(θ − θ_design)²/(2 θ₀²)),  tan θ = tan θ_corner · r/r_corner;  Δx = g ⟨x²⟩",
    typical_size="0.0036 px for a gradient of 0.1 % per px on a disc of 7 px (centroid)",
    references=("P. B. Catrysse, B. A. Wandell, Optical efficiency of image sensor pixels, JOSA A 19 (2002) 1610–1620", "EMVA 1288 R4.0"),
    leaves="the noise of the corners, raised with the signal",
    advice="Use a lens with an exit pupil that matches the sensor. Calibrate and take flat fields at the working aperture.",
    reasons={
        "measure": "a flat field shows the product of all fall-off, which optics.shading measures: more of this one and less of the "
        "lens's, both smooth functions of the radius, leaves all frames the same. The part that changes with the f-number is "
        "no proof either, as the lens's changes with it too",
    },
)
