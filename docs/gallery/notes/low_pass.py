"""Discs behind the low-pass filters of a frame grabber: how far they move, and how much noise they lose."""

import numpy as np

from pixmetry.camera.camera import build_camera
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, canvas
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

CLOCK_HZ, SIDE, TILE = 14.1875e6, 328, 41
FILTERS = {"none": ("off", 1, 5.0), "RC, 6 MHz": ("rc", 1, 6.0), "RC, 4 MHz": ("rc", 1, 4.0), "Butterworth, 5 MHz": ("butterworth", 3, 5.0),
           "Butterworth, 3 MHz": ("butterworth", 3, 3.0)}  # fmt: skip
X, Y = (v.ravel() + 20.2 for v in np.meshgrid(TILE * np.arange(8), TILE * np.arange(8)))


def frames_of(kind, order, cutoff_mhz, count=1, quiet=True):
    """Frames of 64 discs of 7 px; the chapter's noise before the filter, 10 bits."""
    low_pass = {"kind": kind, "order": order, "cutoff_mhz": cutoff_mhz}
    chain = [("optics.point_spread", {"model": "gaussian", "sigma_px": 0.4}), ("sensor.quantum_efficiency", {"quantum_efficiency": 0.35}),
             ("sensor.shot_noise", {}), ("electronics.amplifier_noise", {"white_e": 85.0}), ("electronics.gain", {"gain_dn_per_e": 0.0388}),
             ("grabber.low_pass", low_pass), ("grabber.adc", {"bits": 10, "offset_dn": 20.0})]  # fmt: skip
    camera = build_camera({"schema": "pixmetry/camera/1", "name": "filtered", "rows": SIDE, "cols": SIDE, "exposure_s": 0.04,
                           "pixel_clock_hz": CLOCK_HZ, "line_period_s": 64e-6,
                           "chain": [{"source": name, "parameters": given} for name, given in chain]})  # fmt: skip
    scene = Discs(X, Y, 7.0, 0.7, 45000.0, Uniform(0.0))
    return camera.expose(scene, count, seed=6, quiet=quiet).data.astype(float)


def moments(frame):
    """Mean first moment along x of all discs over their own 41 x 41 pixels."""
    tiles = (frame - 20.0).reshape(8, TILE, 8, TILE).sum(axis=(0, 1, 2))
    return (tiles * np.arange(TILE)).sum() / tiles.sum()


def run():
    quiet = {name: frames_of(*given)[0] for name, given in FILTERS.items()}
    shift = [moments(frame) - moments(quiet["none"]) for frame in quiet.values()]
    noise = [np.std(frames_of(*given, quiet=False)[0][:, :10]) / 4 for given in FILTERS.values()]  # in steps of 8 bits
    values = {"rc_6": shift[1], "rc_4": shift[2], "b_5": shift[3], "b_3": shift[4], "noise": noise[0], "noise_5": noise[3],
              "noise_3": noise[4], "peak_3": 100 * quiet["Butterworth, 3 MHz"].max() / quiet["none"].max()}  # fmt: skip
    values |= {f"told_{k}": CLOCK_HZ * n / (2e6 * np.pi * f) for k, n, f in (("rc_6", 1, 6), ("rc_4", 1, 4), ("b_5", 2, 5), ("b_3", 2, 3))}
    values["stairs"] = 1 / (2 * np.sinh(0.5 / values["told_rc_6"]))  # of steps that are sampled in the middle of each pixel
    with canvas(2.5) as (figure, axes):
        for (name, frame), colour in zip(quiet.items(), (INK, AMBER, AMBER, BLUE, RED), strict=True):
            axes.plot(np.arange(TILE), frame[20, :TILE] / 4, color=colour, linestyle="--" if "4" in name else "-", label=name)
        axes.set(xlabel="x / px", ylabel="grey value (8 bits)", xlim=(10, 32))
        figure.legend(loc="outside lower center", ncols=3)
    return values, {"low-pass": figure}
