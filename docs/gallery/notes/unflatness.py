"""A bowed sensor behind a lens of wide angle: where its edges see a target."""

from dataclasses import replace

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import AMBER, BLUE, RED, canvas
from pixmetry.scene.discs import Discs

PITCH_UM, HEIGHTS_UM = 8.6, (10.0, 30.0, 100.0)


def camera_of(bow_um, angle_deg):
    """A camera whose left and right edges lie ``bow_um`` behind its plane where rays come in at this angle."""
    base = load_camera("pulnix_tm6cn").with_parameters("sensor.thermal_expansion", mount_per_k=0.0, sensor_per_k=0.0)
    bowed = base.with_parameters("sensor.unflatness", bow_x_um=bow_um, bow_y_um=0.0, chief_ray_deg=angle_deg, f_number=8.0)
    return replace(bowed, frame_shape=(64, 752))  # a strip through the middle, so that its corners are its edges


def shift_px(bow_um, angle_deg, x, y):
    """Displacement of points by the camera's own map."""
    return camera_of(bow_um, angle_deg).true_positions(x, y)[0] - x


def run():
    x, y = np.linspace(20.5, 730.5, 12), np.full(12, 31.5)
    scene = Discs(x, y, diameter_px=12.0, blur_px=0.8, peak_photons=100000.0)
    flat, bowed = (locate(camera_of(bow, 30.0).expose(scene, 1).data[0], polarity="bright").columns for bow in (0.0, 100.0))
    order = [np.argsort(found["x_px"]) for found in (flat, bowed)]
    seen = bowed["x_px"][order[1]] - flat["x_px"][order[0]]
    told = shift_px(100.0, 30.0, x, y)
    edge = {angle: 100.0 * np.tan(np.radians(angle)) for angle in (8.2, 20.0, 30.0)}
    end = np.array([751.5 - edge[30.0] / PITCH_UM]), np.array([31.5])  # what is seen at the edge
    values = {"edge_30_um": edge[30.0], "edge_30_px": edge[30.0] / PITCH_UM, "edge_20_um": edge[20.0],
              "edge_8_px": 0.1 * edge[8.2] / PITCH_UM, "map_px": shift_px(100.0, 30.0, *end)[0], "worst_px": np.abs(seen - told).max(),
              "targets": len(seen), "largest_px": seen[-1], "blur_px": 100 / 8.0 / PITCH_UM}  # fmt: skip
    with canvas(2.4) as (figure, axes):
        fine = np.linspace(0, 751, 300)
        for bow, colour in zip(HEIGHTS_UM, (BLUE, AMBER, RED), strict=True):
            axes.plot(fine, shift_px(bow, 30.0, fine, np.full(300, 31.5)), color=colour, label=f"{bow:g} µm")
        axes.plot(x, seen, "o", color=RED, markerfacecolor="none")
        axes.set(xlabel="x / px", ylabel="displacement / px", xlim=(0, 751))
        axes.legend(title="height of the edges")
    return values, {"unflatness": figure}
