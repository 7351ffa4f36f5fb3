"""Sixteen frames shifted by quarters of a pixel, put together: what comes back beyond the limit of one frame."""

import numpy as np

from pixmetry import correct
from pixmetry.camera.camera import build_camera
from pixmetry.report.drawing import AMBER, BLUE, RED, canvas
from pixmetry.scene.motion import Motion
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Sine
from pixmetry.scene.uniform import Uniform

SIDE, STEPS, FILLS, FREQUENCIES = 48, 4, (0.25, 0.5, 1.0), (0.25, 0.5, 1.0, 1.5, 1.75)  # pixels, widths, cycles per pixel
SHIFTS = np.array([[i / STEPS, j / STEPS] for j in range(STEPS) for i in range(STEPS)])  # of the image, px along x and y


def camera_of(fill):
    """Pixels whose light-sensitive part has this width and height, with photon noise."""
    chain = [("sensor.pixel_aperture", {"width_x_px": fill, "width_y_px": fill}),
             ("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}),
             ("sensor.shot_noise", {}), ("electronics.gain", {"gain_dn_per_e": 0.1}), ("grabber.adc", {"bits": 12})]  # fmt: skip
    return build_camera({"schema": "pixmetry/camera/1", "name": "microscan", "rows": SIDE, "cols": SIDE, "exposure_s": 0.01,
                         "chain": [{"source": name, "parameters": given} for name, given in chain]})  # fmt: skip


def contrast(fine, x_px, frequency):
    """Contrast of a grating along x, over the 0.9 of the scene."""
    wave = np.exp(2j * np.pi * frequency * x_px)
    terms = np.stack([wave.real, wave.imag, np.ones(len(x_px))], axis=1)
    cosine, sine, mean = np.linalg.lstsq(terms, fine.mean(axis=0), rcond=None)[0]
    return np.hypot(cosine, sine) / mean / 0.9


def recorded_and_restored(fill, frequency):
    """Contrast in the frames put side by side, and in the finer image of `pixmetry correct --shifts`; the noise of the latter."""
    scene = Picture((Sine(1 / frequency, 0.0, 30.0, 20000.0, 0.9, motion=Motion(table_px=SHIFTS)),), Uniform(0.0))
    camera = camera_of(fill)
    data = camera.expose(scene, len(SHIFTS), seed=1).data
    side_by_side = np.concatenate(list(data[:STEPS].astype(float)), axis=1)  # the frames shifted along x
    x = np.concatenate([np.arange(SIDE) - s for s in SHIFTS[:STEPS, 0]])
    fine = correct(data, camera, shifts=SHIFTS, finer=STEPS)
    at = fine.finer.origin_px[0] + np.arange(fine.frames.shape[2]) / STEPS
    return contrast(side_by_side, x, frequency), contrast(fine.frames[0].astype(float), at, frequency), fine.finer.noise_rel


def run():
    found = {(fill, f): recorded_and_restored(fill, f) for fill in FILLS for f in FREQUENCIES}
    values = {f"{name}_{f:g}_{fill:g}".replace(".", ""): v for (fill, f), both in found.items()
              for name, v in zip(("mtf", "restored"), both, strict=False)}  # fmt: skip
    values |= {f"noise_{fill:g}".replace(".", ""): found[fill, 1.5][2] for fill in FILLS}
    with canvas(2.5) as (figure, axes):
        for fill, colour in zip(FILLS, (BLUE, AMBER, RED), strict=True):
            axes.plot(f := np.linspace(0, 2, 400), np.abs(np.sinc(fill * f)), color=colour, label=f"width {fill:g} px")
            for marker, k in (("o", 0), ("x", 1)):
                axes.plot(FREQUENCIES, [found[fill, g][k] for g in FREQUENCIES], marker, color=colour)
        axes.axvline(0.5, color="#5b626b", linestyle="--", linewidth=0.7)
        axes.set(xlabel="frequency / cycles per pixel", ylabel="contrast", xlim=(0, 2), ylim=(0, 1.02))
        axes.legend()
    return values, {"super-resolution": figure}
