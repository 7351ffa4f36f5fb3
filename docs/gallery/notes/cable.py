"""A white line through the video cable: terminated, left open, and behind an amplifier that rings."""

import numpy as np

from pixmetry import load_camera
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, canvas
from pixmetry.scene.outlines import line
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

PRESET, WINDOW, PLACE = "pulnix_tm6cn_epix_pixelclock", (280, 360, 16, 40), 376.3
CASES = {  # length / m, load / ohm, natural frequency / MHz and damping of the camera's amplifier
    "5 m of 50 Ω": (5.0, 75.0, 8.0, 0.7), "2 m of 50 Ω": (2.0, 75.0, 8.0, 0.7), "5 m of 50 Ω, input open": (5.0, 1e4, 8.0, 0.7),
    "20 m of 50 Ω, input open": (20.0, 1e4, 8.0, 0.7), "5 m of 50 Ω, amplifier rings": (5.0, 75.0, 3.5, 0.2),
}  # fmt: skip


def profile(length_m, load_ohm, natural_mhz, damping, line_ohm=50.0):
    """Mean of 16 rows of a frame without noise, black taken off."""
    camera = load_camera(PRESET).switched(off=["sensor.prnu", "grabber.fixed_pattern"])
    camera = camera.with_parameters("electronics.video_amplifier", natural_mhz=natural_mhz, damping=damping)
    camera = camera.with_parameters("cable.termination", length_m=length_m, load_ohm=load_ohm, line_ohm=line_ohm)
    wire = Shapes.of([line(PLACE, 290.0, 600.0, 2.5, 90.0, 8.5e4)], 0.7)
    data = camera.expose(Picture((wire,), Uniform(20000.0)), 1, window=WINDOW, quiet=True, temperature_c=40.0).data[0]
    mean = data.astype(float).mean(axis=0)
    return mean - mean[:8].mean()


def centre(values):
    """First moment within 9 px of the line."""
    x = np.arange(values.size)
    near = np.abs(x - (PLACE - WINDOW[1])) < 9
    return (values * x)[near].sum() / values[near].sum()


def run():
    found = {name: profile(*case) for name, case in CASES.items()}
    right = profile(5.0, 75.0, 8.0, 0.7, line_ohm=75.0)
    shift = [centre(p) - centre(right) for p in found.values()]
    ringing = [-100 * p.min() / p.max() for p in found.values()]
    tail = [100 * p[22:].max() / p.max() for p in found.values()]  # from 4 px behind the middle of the line
    gamma = (75 - 50) / (75 + 50)
    values = {"shift_5": shift[0], "shift_2": shift[1], "shift_open": shift[2], "shift_20": shift[3], "shift_rings": shift[4],
              "under_5": ringing[0], "under_2": ringing[1], "under_rings": ringing[4], "tail_5": tail[0], "tail_20": tail[3],
              "tail_rings": tail[4], "echo": 100 * gamma**2, "late_px": 14.1875e6 * 2 * 5 / (0.66 * 299792458)}  # fmt: skip
    with canvas(3.4, nrows=2, sharex=True, sharey=True) as (figure, panels):
        x = np.arange(WINDOW[3]) - 8
        for axes, names, ends in zip(panels, (list(CASES)[:2], list(CASES)[2:]), ("75 Ω at both ends", "ends as told"), strict=True):
            axes.plot(x, right, color=INK, linewidth=0.7, label="75 Ω throughout")
            for name, colour in zip(names, (BLUE, AMBER, RED), strict=False):
                axes.plot(x, found[name], color=colour, marker="o", markersize=2, label=f"{name}")
            axes.set(ylabel="grey value", xlim=(0, 24), title=ends)
            axes.legend(fontsize=6)
        panels[1].set_xlabel("x / px")
    return values, {"cable": figure}
