"""Charge on its way out of an interline sensor, drawn in motion with the times of the chapter's camera."""

from dataclasses import replace

import numpy as np

from pixmetry import load_camera
from pixmetry.report.moving import Box, Step, moving_svg
from pixmetry.scene.discs import Discs

N, CELL, COLUMN = 4, 26, 50  # rows and columns that are drawn, their height and width


def packets(camera, left, top):
    """Charge of 4 x 4 pixels that see a disc, as the area of dots, row by row."""
    charge = replace(camera, frame_shape=(N, N)).expose(Discs([1.4], [1.7], 3.0, 0.7, 8e4), quiet=True, temperature_c=40.0).data[0]
    radius = 0.45 * CELL * np.sqrt(charge / charge.max())
    return [[(left + COLUMN * col, top + CELL * (row + 0.5), radius[row, col]) for col in range(N)] for row in range(N)]


def interline(camera):
    """Light-sensitive parts and covered registers side by side, the output register below."""
    line_s, read_s = camera.line_period_s, camera.frame_shape[1] / camera.pixel_clock_hz
    blank_s, down, out = (
        line_s - read_s,
        f"{1e6 * (line_s - read_s):.0f} µs: all lines move down by one",
        f"{1e6 * read_s:.0f} µs: a line leaves",
    )
    steps = [Step(f"{1e3 * camera.exposure_s:.0f} ms: light is collected", camera.exposure_s, [(0, 0)] * N)]
    steps.append(Step(f"{1e6 * line_s:.0f} µs: all charge moves under the cover", line_s, [(25, 0)] * N))
    for last in range(N - 1, -1, -1):
        steps.append(Step(down, blank_s, [(0, CELL * (row <= last)) for row in range(N)]))
        steps.append(Step(out, read_s, [(-300 * (row == last), 0) for row in range(N)]))
    boxes = [Box(10 + COLUMN * col, CELL * row, 24, CELL - 3, "blue") for col in range(N) for row in range(N)]
    boxes += [Box(36 + COLUMN * col, 0, 22, CELL * N, "grid") for col in range(N)] + [Box(4, 1 + CELL * N, 206, CELL - 2, "soft")]
    return moving_svg(boxes, packets(camera, 22, 0), steps)


def run():
    camera = load_camera("pulnix_tm6cn")
    leak = camera["sensor.smear"].params
    values = {"transfer_us": 1e6 * camera.line_period_s, "ratio": 100 * camera.line_period_s / camera.exposure_s}
    values |= {"smear": 10 * leak.leak_rel * leak.transfer_s / camera.exposure_s}
    return values, {"interline": interline(camera)}
