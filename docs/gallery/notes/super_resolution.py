"""Four frames shifted by quarters of a pixel, put together: what comes back beyond the limit of one frame."""

import numpy as np

from pixmetry.camera.camera import build_camera
from pixmetry.report.drawing import AMBER, BLUE, RED, canvas
from pixmetry.scene.motion import Motion
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Sine
from pixmetry.scene.uniform import Uniform

SIDE, STEPS, FILLS, FREQUENCIES = 48, 4, (0.25, 0.5, 1.0), (0.25, 0.5, 1.0, 1.5, 1.75)  # pixels, widths, cycles per pixel


def camera_of(fill):
    """Pixels whose light-sensitive part has this width and height, with photon noise."""
    chain = [("sensor.pixel_aperture", {"width_x_px": fill, "width_y_px": fill}),
             ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}),
             ("sensor.shot_noise", {}), ("electronics.gain", {"gain_dn_per_e": 0.1}), ("grabber.adc", {"bits": 12})]  # fmt: skip
    return build_camera({"schema": "pixmetry/camera/1", "name": "microscan", "rows": SIDE, "cols": SIDE, "exposure_s": 0.01,
                         "chain": [{"source": name, "parameters": given} for name, given in chain]})  # fmt: skip


def contrast(fill, frequency):
    """Contrast of a grating along x in four frames, shifted by quarters of a pixel along x and interleaved."""
    table = np.array([[-k / STEPS, 0.0] for k in range(STEPS)])
    scene = Picture((Sine(1 / frequency, 0.0, 30.0, 20000.0, 0.9, motion=Motion(table_px=table)),), Uniform(0.0))
    data = camera_of(fill).expose(scene, STEPS, seed=1).data.astype(float)
    fine = data.transpose(1, 2, 0).reshape(SIDE, SIDE * STEPS)  # column 4 c + k is pixel c of the frame shifted by k/4
    x = np.arange(SIDE * STEPS) / STEPS
    wave = 2 * (fine.mean(axis=0) * np.exp(-2j * np.pi * frequency * x)).mean()
    return abs(wave) / fine.mean() / 0.9


def run():
    found = {fill: [contrast(fill, f) for f in FREQUENCIES] for fill in FILLS}
    values = {f"mtf_{f:g}_{fill:g}".replace(".", ""): v for fill in FILLS for f, v in zip(FREQUENCIES, found[fill], strict=True)}
    with canvas(2.5) as (figure, axes):
        fine = np.linspace(0, 2, 400)
        for fill, colour in zip(FILLS, (BLUE, AMBER, RED), strict=True):
            axes.plot(fine, np.abs(np.sinc(fill * fine)), color=colour, label=f"width {fill:g} px")
            axes.plot(FREQUENCIES, found[fill], "o", color=colour)
        axes.axvline(0.5, color="#5b626b", linestyle="--", linewidth=0.7)
        axes.set(xlabel="frequency / cycles per pixel", ylabel="contrast", xlim=(0, 2), ylim=(0, 1.02))
        axes.legend()
    return values, {"super-resolution": figure}
