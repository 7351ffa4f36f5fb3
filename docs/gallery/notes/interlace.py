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

SPEEDS_PX_PER_S, DIAMETER_PX, SHUTTER_S = (0.0, 100.0, 350.0, 600.0), 14.0, 1e-4
SHUTTERS_S, SONY = (1 / 25, 1 / 60, 1 / 1000, 1 / 10000), [f"sony_xc8500_{mode}" for mode in ("interlaced", "progressive", "field")]
X, Y = (v.ravel() for v in np.meshgrid(np.arange(60.0, 700, 90) + 0.37, np.arange(60.0, 540, 60) + 0.21))


def frame_of(preset, speed, side=None, shape=None):
    """The first frame of a camera whose scene moves along x."""
    shapes = Shapes.of([disc(x, y, DIAMETER_PX, 6e4) for x, y in zip(X, Y, strict=True)], 0.7, Motion((speed, 0.0)))
    window = None if side is None else (50, 40, side, 2 * side)
    camera = load_camera(preset) if shape is None else replace(load_camera(preset), frame_shape=shape)
    return camera.expose(Picture((shapes,), Uniform(800.0)), 1, window=window, exposure_s=SHUTTER_S, temperature_c=40.0).data[0]


def field_shift(frame):
    """Shift of the targets along x from the even rows to the odd ones, and its standard uncertainty."""
    even, odd = (locate(frame[k::2], kind="ellipse", polarity="bright").columns for k in (0, 1))
    near = np.hypot(odd["x_px"][:, None] - even["x_px"], odd["y_px"][:, None] - even["y_px"])
    moved = odd["x_px"] - even["x_px"][near.argmin(axis=1)]
    return moved[near.min(axis=1) < 30].mean(), moved.std(ddof=1) / np.sqrt(len(moved))


def comb(name, preset, shape=None):
    """How much a row differs from its neighbours over how much a column does, at 350 px/s over at rest: mean of 7 columns of targets, u."""
    ratio = 1.0
    for speed, power in ((350.0, 1), (0.0, -1)):
        f = frame_of(preset, speed, shape=shape).astype(float)
        pairs = [(g, g.T) for g in (f[:, left : left + 90] for left in range(15, 645, 90))]
        ratio *= np.array([np.divide(*(np.abs(g[1:-1] - (g[:-2] + g[2:]) / 2).mean() for g in both)) for both in pairs]) ** power
    return {name: ratio.mean(), f"u_{name}": ratio.std(ddof=1) / np.sqrt(7)}


def run():
    values = {f"blur_{1 / t:.0f}": 350 * t for t in SHUTTERS_S}
    for speed in SPEEDS_PX_PER_S[1:]:
        shift, u = field_shift(frame_of("pulnix_tm6cn", speed))
        values |= {f"interval_{speed:.0f}": 1e3 * shift / speed, f"u_interval_{speed:.0f}": 1e3 * u / speed, f"shift_{speed:.0f}": shift}
    values |= {"apart": 1e3 * DIAMETER_PX / values["interval_350"], **comb("comb", "pulnix_tm6cn"), **comb("comb_sony", SONY[0]),
               **comb("comb_progressive", SONY[1]), **comb("comb_large", SONY[1], (1024, 1280)),
               "field_rows": len(frame_of(SONY[2], 350.0))}  # fmt: skip
    values["sony_shift"], values["u_sony_shift"] = field_shift(frame_of(SONY[0], 350.0))
    with canvas(1.2, ncols=4) as (figure, panels):
        for axes, speed in zip(panels, SPEEDS_PX_PER_S, strict=True):
            axes.imshow(frame_of("pulnix_tm6cn", speed, 24), cmap="gray", interpolation="none")
            axes.set(title=f"{speed:g} px/s", xticks=[], yticks=[])
            axes.grid(False)
    return values, {"interlace": figure}
