"""Targets that were recorded on tape once, twice and three times before they were digitised."""

import numpy as np

from pixmetry import locate
from pixmetry.camera.camera import build_camera
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

SIDE, FRAMES, COPIES = 300, 12, (0, 1, 2, 3)
BETTER = {"bandwidth_mhz": 5.0, "noise_dn": 2.0, "white_ns": 4.0}  # S-VHS behind a time-base corrector
WORSE = {"bandwidth_mhz": 3.0, "noise_dn": 4.0, "white_ns": 14.0}  # VHS


def camera_of(copies, tape):
    """The chapter's noise and clock; the picture goes over tape so many times."""
    chain = [("optics.point_spread", {"model": "gaussian", "sigma_px": 0.4}), ("sensor.quantum_efficiency", {"quantum_efficiency": 0.35}),
             ("sensor.shot_noise", {}), ("electronics.amplifier_noise", {"white_e": 85.0}), ("electronics.gain", {"gain_dn_per_e": 0.0097}),
             ("storage.tape", {"generations": copies, **tape}), ("grabber.line_jitter", {"white_ns": 1.0}),
             ("grabber.adc", {"bits": 8, "offset_dn": 10.0})]  # fmt: skip
    return build_camera({"schema": "pixmetry/camera/1", "name": "taped", "rows": SIDE, "cols": SIDE, "exposure_s": 0.04,
                         "pixel_clock_hz": 14.1875e6, "line_period_s": 64e-6,
                         "chain": [{"source": name, "parameters": given} for name, given in chain]})  # fmt: skip


def scatter(copies, tape=BETTER):
    """Standard deviation of x and of y from frame to frame, of 64 discs of 7 px."""
    grid = np.linspace(25.3, SIDE - 25.6, 8)
    x, y = (v.ravel() for v in np.meshgrid(grid, grid))
    scene = Discs(x, y, 7.0, 0.7, 45000.0, Uniform(1000.0))
    places = []
    for frame in camera_of(copies, tape).expose(scene, FRAMES, seed=4).data:
        found = locate(frame, polarity="bright").columns
        near = np.hypot(found["x_px"][:, None] - x, found["y_px"][:, None] - y).argmin(axis=0)
        places.append([found["x_px"][near], found["y_px"][near]])
    return np.sqrt(np.var(places, axis=0, ddof=1).mean(axis=1))


def run():
    found = np.array([scatter(copies) for copies in COPIES])
    ratio = found[:, 0] / found[0, 0]
    u = 1 / np.sqrt(2 * 64 * (FRAMES - 1))  # of a standard deviation, relative
    values = {f"x_{c}": 1000 * v for c, v in zip(COPIES, found[:, 0], strict=True)} | {"y_0": 1000 * found[0, 1], "y_1": 1000 * found[1, 1]}
    values |= {"ratio": ratio[1], "u_ratio": ratio[1] * u * np.sqrt(2), "second": ratio[2] / ratio[1],
               "u_second": ratio[2] / ratio[1] * u * 1.4, "third": ratio[3] / ratio[2]}  # fmt: skip
    added = [np.sqrt(s**2 - found[0, 0] ** 2) for s in (found[1, 0], scatter(1, WORSE)[0])]
    values |= {"better": np.hypot(0.04, added[0]) / 0.04, "worse": np.hypot(0.04, added[1]) / 0.04, "added": 1000 * added[0],
               "added_worse": 1000 * added[1]}  # fmt: skip
    with canvas(2.2) as (figure, axes):
        for k, colour in ((0, RED), (1, BLUE)):
            axes.plot(COPIES, 1000 * found[:, k], "o", color=colour, label="xy"[k])
            steps = np.linspace(0, 3, 50)
            axes.plot(steps, 1000 * np.sqrt(found[0, k] ** 2 + steps * (found[1, k] ** 2 - found[0, k] ** 2)), color=colour)
        axes.set(xlabel="times on tape", ylabel="scatter / 0.001 px", xticks=COPIES, ylim=(0, None))
        axes.legend()
    return values, {"video-tape": figure}
