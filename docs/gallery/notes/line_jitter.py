"""Line jitter in the scatter of straight lines: an upright line wanders from row to row, one that lies does not."""

import numpy as np

from pixmetry import load_camera
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.outlines import line
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

PRESET, JITTERS_NS, WIDTH_PX, HALF_PX, FRAMES = "pulnix_tm6cn_epix_pixelclock", (0.0, 1.3, 3.0, 5.0), 4.5, 6, 4
RESPONSE = 1.34  # px by which a delay of one pixel moves the line: the amplifier's steps still rise when they are sampled
PLACES = (120.3, 240.6, 360.1, 480.8)  # of four upright and four lying lines, px


def frames_of(jitter_ns, upright):
    camera = load_camera(PRESET).with_parameters("grabber.line_jitter", white_ns=jitter_ns)
    ends = [(p, 290.0, 90.0) if upright else (370.0, p, 0.0) for p in PLACES]
    scene = Picture((Shapes.of([line(x, y, 900.0, WIDTH_PX, angle, 60000.0) for x, y, angle in ends], 0.7),), Uniform(1000.0))
    return camera.expose(scene, FRAMES, seed=5, temperature_c=40.0).data.astype(float)


def scatter(frames):
    """Standard deviation of a row's centroid about the mean of its row over the frames, for upright lines."""
    found = []
    for place in PLACES:
        first = round(place) - HALF_PX
        window = frames[:, 60:520, first : first + 2 * HALF_PX + 1]
        light = window - window[:, :, [0, 1, -2, -1]].mean()  # black beside the line
        found.append((light * np.arange(2 * HALF_PX + 1)).sum(axis=2) / light.sum(axis=2))
    return np.sqrt(np.mean(np.var(found, axis=1, ddof=1)))


def run():
    ns_per_px = 1e9 / load_camera(PRESET).pixel_clock_hz
    x = np.array([scatter(frames_of(jitter, True)) for jitter in JITTERS_NS])
    y = np.array([scatter(frames_of(jitter, False).swapaxes(1, 2)) for jitter in JITTERS_NS])
    told = ns_per_px / RESPONSE * np.sqrt(np.maximum(x**2 - x[0] ** 2, 0.0))
    names = [f"{jitter:g}".replace(".", "") for jitter in JITTERS_NS]
    values = {f"x_{n}": v for n, v in zip(names, x, strict=True)} | {f"y_{n}": v for n, v in zip(names, y, strict=True)}
    values |= {f"told_ns_{n}": v for n, v in zip(names, told, strict=True)}
    with canvas(2.2) as (figure, axes):
        for found, colour, name in ((x, RED, "upright lines, along x"), (y, BLUE, "lying lines, along y")):
            axes.plot(JITTERS_NS, found, "o-", color=colour, label=name)
        axes.set(xlabel="jitter / ns", ylabel="scatter of a row / px", ylim=(0, None))
        axes.legend()
    return values, {"line-jitter-script": figure}
