"""Charge that is left behind on the way to the output: how much arrives, and where."""

from dataclasses import replace

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import AMBER, BLUE, RED, canvas
from pixmetry.scene.discs import Discs

PIXELS, PHASES, LEFT = 2048, 4, 1e-5  # of the chapter's worst case: 0.99999 per transfer


def camera_of(per_transfer, phases):
    """The register of a frame-transfer camera, as wide as the chapter's, without noise."""
    on = ["sensor.charge_transfer"]
    camera = load_camera("ft_ccd_generic").switched(on=on).with_parameters(
        "sensor.charge_transfer", serial_cti=per_transfer, parallel_cti=0.0, phases=phases)  # fmt: skip
    return replace(camera, frame_shape=(40, PIXELS))


def run():
    x = np.linspace(24.3, PIXELS - 24.3, 40)
    scene = Discs(x, np.full_like(x, 19.6), diameter_px=7.0, blur_px=0.7, peak_photons=60000.0)
    shifts = {}
    for phases in (1, PHASES):
        frames = [camera_of(cti, phases).expose(scene, 1, quiet=True).data[0] for cti in (0.0, LEFT)]
        found = [locate(frame, polarity="bright", estimator="centroid").columns["x_px"] for frame in frames]
        shifts[phases] = np.sort(found[1]) - np.sort(found[0])
    slope = {p: np.polyfit(x, s, 1)[0] * PIXELS for p, s in shifts.items()}

    one = Discs([PIXELS - 20.0], [20.0], diameter_px=1.0, blur_px=0.05, peak_photons=60000.0)  # light on one pixel
    level = [camera_of(cti, PHASES).expose(one, 1, quiet=True).data[0].astype(float) for cti in (0.0, LEFT)]
    row, col = np.unravel_index(level[0].argmax(), level[0].shape)
    black = np.median(level[0])
    arrived = (level[1][row, col] - black) / (level[0][row, col] - black)
    steps = PHASES * (col + 1)
    values = {"all": (1 - LEFT) ** (PIXELS * PHASES), "per_pixel": (1 - LEFT) ** PIXELS, "low": 0.9995 ** (PIXELS * PHASES),
              "low_752": 0.9995**752, "arrived": arrived, "steps": steps, "told": (1 - LEFT) ** steps, "shift_4": slope[PHASES],
              "shift_1": slope[1], "shift_told": PIXELS * PHASES * LEFT}  # fmt: skip
    with canvas(2.3) as (figure, axes):
        n = np.arange(0, 8193)
        for efficiency, colour in ((0.9995, RED), (0.9999, AMBER), (0.99999, BLUE)):
            axes.plot(n, 100 * efficiency**n, color=colour, label=f"{efficiency:g}")
        axes.plot(steps, 100 * arrived, "o", color=BLUE, markerfacecolor="none")
        axes.set(xlabel="transfers", ylabel="charge still in its packet / %", xlim=(0, 8250), ylim=(0, 102))
        axes.legend(title="efficiency of a transfer")
    return values, {"charge-transfer": figure}
