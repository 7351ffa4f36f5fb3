"""View-point: a target looks brighter on one side, and perspective shows its centre beside that of its outline."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.number import Estimates


class ViewPoint(Parameters):
    """Gradient of brightness over a target, and how obliquely it is seen."""

    gradient_rel_per_px: float = quantity(
        0.0, "1/px", "standard deviation of the relative gradient, along x and along y, over targets and views", ge=0, le=0.2
    )
    view_angle_deg: float = quantity(0.0, "deg", "largest angle between the line of sight and the target's normal", ge=0, lt=85)
    diameter_px: float = quantity(7.0, "px", "diameter of the target in the image", gt=0, le=2000)
    principal_distance_px: float = quantity(1e4, "px", "distance of the lens from the sensor, in pixels", gt=0, le=1e7)

    @property
    def eccentricity_px(self) -> float:
        """Largest distance of the ellipse's centre from the image of the circle's centre.

        A circle of radius r at the distance Z, tilted by α, is seen in the direction of the tilt between r cos α/(Z ± r sin α): the
        middle of both ends lies c r² sin α cos α/(Z² − r² sin² α) off the image of the centre; with R = c r/Z that is R² sin α cos α/c.
        """
        radius, tilt = 0.5 * self.diameter_px, np.radians(self.view_angle_deg)
        c = self.principal_distance_px
        return float(radius**2 * np.sin(tilt) * np.cos(tilt) / (c * (1 - (radius / c * np.sin(tilt)) ** 2)))


def measure(observations: Observations) -> Estimates:
    """Slope of the light, largest angle of view and diameter of the targets, from views of them."""
    views = observations.views
    names = {n: n for n in ("gradient_rel_per_px", "view_angle_deg", "diameter_px")}
    failed = observations.failed.get("views", "")
    fit = of_pictures(
        None if views is None else views.fit,
        names,
        where="scene.view_point",
        pictures="targets from several sides",
        kind="views",
        failed=failed,
    )
    if views is None or views.principal_distance_px is None:
        return fit
    return fit.join(Estimates.from_rows([("principal_distance_px", views.principal_distance_px, 0.0, np.inf, "px")]))


def propagate(params: ViewPoint, probe: Probe) -> Contribution:
    """Propagator P3 for the gradient; of the eccentricity e, tilted in any direction by up to the largest angle, e/√3 in all."""
    rows, cols = probe.signal_dn.shape[1:]
    above = probe.signal_dn - probe.background_dn
    ramp_x = (np.arange(cols) - probe.x_px[:, None])[:, None, :] * above
    ramp_y = (np.arange(rows) - probe.y_px[:, None])[:, :, None] * above
    of_x, of_y = (np.square(np.stack(probe.field(ramp))) for ramp in (ramp_x, ramp_y))
    light = params.gradient_rel_per_px**2 * (of_x + of_y).mean(axis=1)  # gradients along x and y are independent
    oblique = 0.5 * (params.eccentricity_px**2 / 3)  # half of it in x, half in y
    u_x, u_y = (float(np.sqrt(v + oblique)) for v in light)
    method = "linear response of the estimator to a relative gradient, and the eccentricity of an oblique circle"
    return probe.contribution((u_x, u_y), "O", model_error=0.15, method=method)


SOURCE = Source(
    id="scene.view_point",
    title="View-point dependent location",
    description="Light and reflection change over a target with the direction of view, and so does the place that is found for it.",
    number=38,
    stars=3,
    note="Note 9",
    parameters=ViewPoint,
    consumes=(Kind.LIGHT,),
    neutral=ViewPoint(),
    typical=ViewPoint(gradient_rel_per_px=0.002),
    bound=ViewPoint(gradient_rel_per_px=0.02, view_angle_deg=45.0),
    measure=measure,
    propagate=propagate,
    gum_class="O",
    equation="Δ = p g ⟨x²⟩_f for a gradient g of brightness;  e = R² sin α cos α/c for a circle tilted by α",
    typical_size="0.04 px for 1 % per px on a disc of 7 px (centroid)",
    references=(
        "T. A. Clarke, An analysis of the properties of targets used in digital close range photogrammetric measurement, SPIE 2350 (1994)",
        "S. J. Ahn, H. J. Warnecke, R. Kotowski, Systematic geometric image measurement errors of circular object targets, "
        "Photogrammetric Record 16(93), 485 (1999)",
    ),
    advice="Light targets from the camera or diffusely, take retro-reflective targets, and fit their edges, not their brightness.",
    reasons={
        "forward": "it belongs to the scene: `lighting` in a scene file makes a gradient, a `plate` is seen in perspective",
        "correct": "a tilted circle and an ellipse seen square on give the same frame. The eccentricity is corrected where positions are "
        "adjusted, and the template fits the slope of the light with the target (planes=True of pixmetry.locate)",
    },
)
