"""Targets on surfaces that shine differently in each direction: where they are found, and where they are."""

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, canvas
from pixmetry.scene.lighting import Lighting
from pixmetry.scene.outlines import disc
from pixmetry.scene.picture import Picture
from pixmetry.scene.plates import Pose, dot_plate
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

GRADIENT, DIAMETER_PX, BLUR_PX, LIGHT = 0.01, 7.0, 0.7, 4e4
TILTS_DEG, FAR_PX, LAMP_PX, DOT_MM, PITCH_MM = (0.0, 15.0, 30.0, 45.0, 60.0), 2907.0, (900.0, 0.0, 900.0), 6.0, 12.0  # lens of 25 mm
SURFACES = {"matt": "lambert", "glossy": "glossy", "retro-reflective": "retro"}


def found_at(scene, x, y, estimator, planes="never"):
    """Found less true along x of the targets at these places, no noise."""
    frame = load_camera("pulnix_tm6cn").expose(scene, quiet=True, temperature_c=40.0).data[0]
    columns = locate(frame, polarity="bright", estimator=estimator, planes=planes).columns
    return columns["x_px"][np.hypot(columns["x_px"] - x[:, None], columns["y_px"] - y[:, None]).argmin(axis=1)] - x


def gradient_error(estimator, planes="never"):
    """Mean shift of four discs in light that changes by the gradient from pixel to pixel, less that in even light."""
    x, y, total = np.array([340.0, 360.3, 340.6, 360.9]), np.array([280.0, 280.7, 300.3, 300.1]), 0.0
    for g, sign, at in ((g, s, at) for g, s in ((GRADIENT, 1), (0.0, -1)) for at in zip(x, y, strict=True)):
        light = Lighting(x_px=at[0], y_px=at[1], gradient_x_per_px=g)
        scene = Picture((Shapes.of([disc(*at, DIAMETER_PX, LIGHT)], BLUR_PX),), Uniform(0.0), light)
        total += sign * found_at(scene, *np.array(at)[:, None], estimator, planes)[0]
    return total / len(x)


def plate_errors(tilt):
    """RMS along x over 25 dots of a plate that is turned about y: found less true in even light, and what each surface adds to that."""
    shapes = dot_plate(Pose(FAR_PX, 375.5, 290.5, phi_deg=tilt, z_mm=400.0), 5, 5, PITCH_MM, DOT_MM, LIGHT, BLUR_PX)
    x, y, ellipse = (np.array([dot[k] for dot in shapes.told]) for k in ("x_px", "y_px", "ellipse_x_px"))
    even = found_at(Picture((shapes,), Uniform(0.0)), x, y, "soft_threshold")
    errors = {"even": even, "eccentric": ellipse - x}
    for name, surface in SURFACES.items():
        lamp_px = (0.0, 0.0, FAR_PX) if surface == "retro" else LAMP_PX
        light = Lighting(surface, 375.5, 290.5, lamp_px=lamp_px, camera_distance_px=FAR_PX, tilt_x_deg=tilt)
        errors[name] = found_at(Picture((shapes,), Uniform(0.0), light), x, y, "soft_threshold") - even
    return {name: np.sqrt((error**2).mean()) for name, error in errors.items()}


def run():
    sweep = {tilt: plate_errors(tilt) for tilt in TILTS_DEG}
    values = {name.split("-")[0]: max(found[name] for found in sweep.values()) for name in SURFACES}
    values |= {name: sweep[45.0][name] for name in ("eccentric", "even")} | {"told": GRADIENT * DIAMETER_PX**2 / 16}
    values |= {"gradient": gradient_error("centroid"), "plane": gradient_error("template", "always")}
    with canvas(2.4) as (figure, axes):
        for name, colour, mark in zip(SURFACES, (BLUE, RED, AMBER), "os^", strict=True):
            axes.plot(TILTS_DEG, [found[name] for found in sweep.values()], color=colour, marker=mark, label=f"light, {name}")
        axes.plot(TILTS_DEG, [found["eccentric"] for found in sweep.values()], "--", color=INK, label="perspective")
        axes.set(xlabel="tilt of the plate / degrees", ylabel="RMS shift along x / px")
        axes.legend()
    return values, {"view-point": figure}
