"""Pixels that are not where they should be, and what is left of that in the position of a target."""

import numpy as np

from pixmetry import locate
from pixmetry.camera.camera import build_camera
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SIDE, SIZES_PX, DIAMETERS_PX = 420, (0.0, 0.02, 0.06, 0.1), (4.0, 7.0, 12.0)


def located(pixel_std_px, diameter_px):
    """Positions of 100 discs in a frame without noise, x and y; the same pixels are displaced every time."""
    chain = [("optics.point_spread", {"model": "gaussian", "sigma_px": 0.5}), ("sensor.pixel_geometry", {"pixel_std_px": pixel_std_px}),
             ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}), ("electronics.gain", {"gain_dn_per_e": 0.1}),
             ("grabber.adc", {"bits": 12, "offset_dn": 20.0})]  # fmt: skip
    camera = build_camera({"schema": "pixmetry/camera/1", "name": "places", "rows": SIDE, "cols": SIDE, "exposure_s": 0.01, "unit_seed": 3,
                           "chain": [{"source": name, "parameters": given} for name, given in chain]})  # fmt: skip
    grid = np.linspace(20.2, SIDE - 20.7, 10)
    x, y = (v.ravel() for v in np.meshgrid(grid, grid))
    frame = camera.expose(Discs(x, y, diameter_px, 0.5, 30000.0, Uniform(500.0)), 1, quiet=True).data[0]
    found = locate(frame, polarity="bright").columns
    near = np.hypot(found["x_px"][:, None] - x, found["y_px"][:, None] - y).argmin(axis=0)
    return np.array([found["x_px"][near], found["y_px"][near]])


def run():
    errors = {}
    for diameter in DIAMETERS_PX:
        ideal = located(0.0, diameter)
        errors[diameter] = np.array([(located(size, diameter) - ideal).std() for size in SIZES_PX])
    share = {d: e[1:] @ np.array(SIZES_PX[1:]) / (np.array(SIZES_PX) ** 2).sum() for d, e in errors.items()}
    values = {f"share_{d:.0f}": v for d, v in share.items()} | {f"u_share_{d:.0f}": v / 20 for d, v in share.items()}
    values |= {
        "needed": 0.01 / share[7.0],
        "u_needed": 0.01 / share[7.0] / 20,
        "needed_um": 0.01 / share[7.0] * 8.6,
        "at_6": errors[7.0][2],
    }
    with canvas(2.2) as (figure, axes):
        for diameter, colour, mark in zip(DIAMETERS_PX, (RED, BLUE, "#1a1d21"), "os^", strict=True):
            axes.plot(SIZES_PX, errors[diameter], mark, color=colour, label=f"disc of {diameter:g} px")
            axes.plot([0, 0.1], [0, 0.1 * share[diameter]], color=colour)
        axes.axhline(0.01, color="#5b626b", linestyle="--", linewidth=0.7)
        axes.set(xlabel="standard deviation of the pixels' places / px", ylabel="error / px", xlim=(0, 0.105), ylim=(0, None))
        axes.legend()
    return values, {"pixel-places": figure}
