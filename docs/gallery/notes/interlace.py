"""A disc that moves while the two fields of an interlaced camera are exposed one after the other."""

from dataclasses import replace

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import canvas
from pixmetry.scene.motion import Motion
from pixmetry.scene.outlines import disc
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

SPEEDS_PX_PER_S, DIAMETER_PX, SHUTTER_S = (0.0, 100.0, 350.0, 600.0), 14.0, 0.001
SHUTTERS_S = (1 / 25, 1 / 60, 1 / 1000, 1 / 10000)  # the chapter's range, and between
X, Y = (v.ravel() for v in np.meshgrid(np.arange(60.0, 700, 90) + 0.37, np.arange(60.0, 540, 60) + 0.21))


def frame_of(preset, speed, side=None, shape=None):
    """The first frame of a camera whose scene moves along x."""
    shapes = Shapes.of([disc(x, y, DIAMETER_PX, 6e4) for x, y in zip(X, Y, strict=True)], 0.7, Motion((speed, 0.0)))
    window = None if side is None else (50, 40, side, 2 * side)
    camera = replace(load_camera(preset), frame_shape=shape or load_camera(preset).frame_shape)
    return camera.expose(Picture((shapes,), Uniform(800.0)), 1, window=window, exposure_s=SHUTTER_S, temperature_c=40.0).data[0]


def field_shift(frame):
    """Shift of the targets along x from the even rows to the odd ones, and its standard uncertainty."""
    even, odd = (locate(frame[k::2], kind="ellipse", polarity="bright").columns for k in (0, 1))
    near = np.hypot(odd["x_px"][:, None] - even["x_px"], odd["y_px"][:, None] - even["y_px"])
    moved = odd["x_px"] - even["x_px"][near.argmin(axis=1)]
    return moved[near.min(axis=1) < 30].mean(), moved.std(ddof=1) / np.sqrt(len(moved))


def comb(frame):
    """How much a row differs from the mean of its neighbours, over how much a column does."""
    f = frame.astype(float)
    rows, cols = (np.abs(g[1:-1] - (g[:-2] + g[2:]) / 2).mean() for g in (f, f.T))
    return rows / cols


def run():
    values = {}
    for speed in SPEEDS_PX_PER_S[1:]:
        shift, u = field_shift(frame_of("pulnix_tm6cn", speed))
        values |= {f"interval_{speed:.0f}": 1e3 * shift / speed, f"u_interval_{speed:.0f}": 1e3 * u / speed, f"shift_{speed:.0f}": shift}
    values |= {"apart": 1e3 * DIAMETER_PX / values["interval_350"], "comb": comb(frame_of("pulnix_tm6cn", 350.0))}
    sony = {mode: frame_of(f"sony_xc8500_{mode}", 350.0) for mode in ("interlaced", "field", "progressive")}
    values |= {"comb_sony": comb(sony["interlaced"]), "comb_progressive": comb(sony["progressive"]), "field_rows": len(sony["field"]),
               "sony_shift": field_shift(sony["interlaced"])[0]}  # fmt: skip
    values["comb_large"] = comb(frame_of("sony_xc8500_progressive", 350.0, shape=(1024, 1280)))
    values |= {f"blur_{1 / t:.0f}": 350 * t for t in SHUTTERS_S}
    with canvas(1.2, ncols=4) as (figure, panels):
        for axes, speed in zip(panels, SPEEDS_PX_PER_S, strict=True):
            axes.imshow(frame_of("pulnix_tm6cn", speed, 24), cmap="gray", interpolation="none")
            axes.set(title=f"{speed:g} px/s", xticks=[], yticks=[])
            axes.grid(False)
    return values, {"interlace": figure}
