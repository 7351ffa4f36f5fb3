"""Natural and mechanical vignetting: light falls off from the optical axis as cos⁴ of the field angle and as the pupil is cut."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.geometry import corner_px, factor_verbs, frame_centre
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array


class Vignetting(Parameters):
    """The fall-off about the optical axis, where the factor is 1."""

    cos_power: float = quantity(
        0.0, "1", "power of the cosine of the field angle; 4 for a simple lens, less for a retrofocus lens", ge=0, le=8
    )
    principal_distance_mm: float = quantity(25.0, "mm", "distance of the exit pupil; it gives the field angle", gt=0, le=10000)
    pupil_shift_rel: float = quantity(
        0.0, "1", "shift of the lens's two limiting openings against each other in the frame's corners, over their diameter", ge=0, le=0.9
    )
    centre_x_px: float = quantity(0.0, "px", "optical axis minus the frame's centre, along x", ge=-1000, le=1000)
    centre_y_px: float = quantity(0.0, "px", "optical axis minus the frame's centre, along y", ge=-1000, le=1000)
    pitch_x_um: float = quantity(8.6, "µm", "pixel pitch along x", gt=0, le=100)
    pitch_y_um: float = quantity(8.3, "µm", "pixel pitch along y", gt=0, le=100)


def overlap(shift: np.ndarray) -> np.ndarray:
    """Common area of two circles whose centres are so many diameters apart, over the area of one."""
    s = np.minimum(shift, 1.0)
    shared: Array = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    return shared


def factor(params: Vignetting, x_px: np.ndarray, y_px: np.ndarray, frame_shape: tuple[int, int]) -> np.ndarray:
    """Relative light at some places, 1 on the optical axis; float64."""
    x0, y0 = frame_centre(frame_shape)
    x = (x_px - x0 - params.centre_x_px) * params.pitch_x_um / 1000
    y = (y_px - y0 - params.centre_y_px) * params.pitch_y_um / 1000
    r2 = x * x + y * y
    out = (1 + r2 / params.principal_distance_mm**2) ** (-0.5 * params.cos_power)
    if params.pupil_shift_rel:
        corner_mm = corner_px(frame_shape, params.pitch_y_um / params.pitch_x_um) * params.pitch_x_um / 1000
        out = out * overlap(params.pupil_shift_rel * np.sqrt(r2) / corner_mm)
    return out


SOURCE = Source(
    id="optics.vignetting",
    title="Vignetting",
    description="Away from the optical axis the lens transmits less light. The gradient across a target shifts its centre inwards.",
    parameters=Vignetting,
    consumes=(Kind.PHOTONS,),
    before=("sensor",),
    neutral=Vignetting(),
    typical=Vignetting(cos_power=4.0, principal_distance_mm=25.0, pupil_shift_rel=0.1),
    bound=Vignetting(cos_power=4.0, principal_distance_mm=8.0, pupil_shift_rel=0.2),
    **factor_verbs(factor),
    option="shading that is described by optical data; measured shading is in optics.shading",
    gum_class="G",
    equation="µ' = µ cos⁴θ · (2/π)(acos s − s √(1 − s²)),  tan θ = r/c,  s = s_corner r/r_corner;  Δx = g ⟨x²⟩",
    typical_size="0.004 to 0.011 px for 0.1 to 0.3 % per px on a disc of 7 px (centroid)",
    references=("ISO 17957:2015 (shading)", "M. Reiss, The cos⁴ law of illumination, JOSA 35 (1945) 283–288"),
    leaves="the noise of the corners, raised with the signal",
    advice="Stop the lens down, take a lens with a longer focal length, or divide by a flat field.",
    reasons={
        "measure": "a flat field shows the product of all fall-off, which optics.shading measures: less of the lens and more of the "
        "microlenses, both smooth functions of the radius, leaves all frames the same. Nothing that frames need is lost by "
        "that, for shading corrects the product",
    },
)
