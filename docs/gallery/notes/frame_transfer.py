"""Charge on its way out of a frame-transfer sensor, drawn in motion with the times of a camera, and its smear."""

from dataclasses import replace

import numpy as np

from pixmetry import load_camera
from pixmetry.report.drawing import canvas
from pixmetry.report.moving import Box, Step, moving_svg
from pixmetry.scene.discs import Discs
from pixmetry.scene.outlines import polygon
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

N, CELL, COLUMN, BAR = 4, 26, 50, (400, 600, 480, 500)  # drawn; rows and columns of a bright bar, first and behind the last


def packets(camera, left, top):
    """Charge of 4 x 4 pixels that see a disc, as the area of dots, row by row."""
    charge = replace(camera, frame_shape=(N, N)).expose(Discs([1.4], [1.7], 3.0, 0.7, 8e4), quiet=True, temperature_c=40.0).data[0]
    radius = 0.45 * CELL * np.sqrt(charge / charge.max())
    return [[(left + COLUMN * col, top + CELL * (row + 0.5), radius[row, col]) for col in range(N)] for row in range(N)]


def frame_transfer(camera, moved_s):
    """Output register, store and image section, which the whole image leaves at once, through the light."""
    line_s = (camera.facts["frame_period_s"] - moved_s) / camera.frame_shape[0]
    steps = [Step(f"{1e3 * camera.exposure_s:.0f} ms: light is collected", camera.exposure_s, [(0, 0)] * N)]
    steps.append(Step(f"{1e3 * moved_s:g} ms: all charge moves to the store", moved_s, [(0, -CELL * N)] * N))
    for k in range(N + 1):
        moves = [(-300 * (row == k - 1), -CELL * (row >= k)) for row in range(N)]
        steps.append(Step(f"{1e6 * line_s:.0f} µs: the next line; the one before leaves", line_s, moves))
    boxes = [Box(4, 0, 206, CELL - 2, "soft"), Box(4, CELL, 206, CELL * N - 2, "grid"), Box(4, CELL * (N + 1), 206, CELL * N, "blue")]
    return moving_svg(boxes, packets(camera, 33, CELL * (N + 1)), steps)


def run():
    camera, (top, end, left, right) = load_camera("ft_ccd_generic"), BAR
    smear = camera["sensor.smear"].params
    bar = polygon([left - 0.5, right - 0.5, right - 0.5, left - 0.5], [top - 0.5, top - 0.5, end - 0.5, end - 0.5], 20000.0)
    scene = Picture((Shapes.of([bar]),), Uniform(0.0))
    frame = camera.switched(on=["sensor.smear"]).expose(scene, quiet=True).data[0].astype(float)
    percent = 100 * frame / frame[450:550, 485:495].mean()
    told = 100 * smear.transfer_s / camera.exposure_s * (end - top) / len(frame)
    with canvas(2.6) as (figure, axes):
        shown = axes.imshow(np.minimum(percent[::4, ::4], 1.0), cmap="gray", extent=(-0.5, 1023.5, 1023.5, -0.5), interpolation="none")
        figure.colorbar(shown, ax=axes, label="% of the bar, cut at 1 %")
        axes.grid(False)
    drawn = {"frame-transfer": frame_transfer(camera, smear.transfer_s), "frame-transfer-smear": figure}
    return {"smear": percent[650:950, 485:495].mean(), "smear_told": told}, drawn
