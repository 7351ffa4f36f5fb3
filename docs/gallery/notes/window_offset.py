"""Where the middle of the sensor lies in a stored image, and how a grabber's steps of four rows move it."""

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.core.errors import InputError
from pixmetry.report.drawing import BLUE, INK, RED, canvas
from pixmetry.scene.discs import Discs

PRESET, WARM_C = "pulnix_tm6cn_epix_512", {"temperature_c": 40.0}


def camera_of(row_offset):
    camera = load_camera(PRESET).switched(off=["grabber.clock_warm_up"])
    return camera.with_parameters("grabber.window_offset", row_offset=row_offset)


def refused(row_offset):
    try:
        camera_of(row_offset)
    except InputError:
        return True
    return False


def run():
    x, y = (v.ravel() for v in np.meshgrid(np.arange(80.0, 700, 120), np.arange(120.0, 480, 80)))
    scene = Discs(x, y, diameter_px=12.0, blur_px=0.8, peak_photons=60000.0)
    found, u = {}, {}
    for offset in (28, 32, 36):
        seen = locate(camera_of(offset).expose(scene, 1, **WARM_C).data[0], polarity="bright").columns
        found[offset] = np.sort(seen["y_px"])
        u[f"u_offset_{offset}"] = np.sqrt(seen["var_y_px2"].mean() / len(y))  # as stated for each target
    truth = np.sort(y)
    offsets = [np.mean(truth - found[o]) for o in found]
    middle = camera_of(32).true_positions([375.5], [290.5], **WARM_C)  # of the sensor, in the stored image
    values = {**u, "offset_28": offsets[0], "offset_32": offsets[1], "offset_36": offsets[2],
              "refused": sum(refused(o) for o in range(28, 37)),
              "best": (582 - 512) / 2, "off_x": middle[0][0] - 255.5, "off_y": middle[1][0] - 255.5, "lost_rows": 582 - 512,
              "off_x_um": (middle[0][0] - 255.5) * 8.6 * 1.41875}  # fmt: skip
    with canvas(2.6) as (figure, axes):
        axes.plot([-0.5, 751.5, 751.5, -0.5, -0.5], [-0.5, -0.5, 581.5, 581.5, -0.5], color=INK, label="sensor")
        wide = 512 * 1.41875
        axes.plot([-0.5, wide, wide, -0.5, -0.5], [31.5, 31.5, 543.5, 543.5, 31.5], color=BLUE, label="stored")
        axes.plot([375.5], [290.5], "+", color=INK, markersize=9)
        axes.plot([wide / 2], [32 + 255.5], "x", color=RED, markersize=7, label="middle of the stored image")
        axes.set(xlabel="x / pixels of the sensor", ylabel="y / rows of the sensor", ylim=(620, -40), aspect="equal")
        figure.legend(loc="outside lower center", ncols=3)
    return values, {"window-offset": figure}
