"""Sixteen targets that do not move, seen for 90 minutes by a camera whose frame grabber has just been switched on."""

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, canvas
from pixmetry.scene.discs import Discs
from pixmetry.series.job import measure_series

EVERY_S, FRAMES, ENLARGED = 120.0, 46, 20
LENS_MM, DISTANCE_MM, BETWEEN, WIDTH_MM = 25.0, 665.0, 640.0, 752 * 0.0086  # BETWEEN lens and plate


def draw(frame, first, shift, minutes, rms):
    figures = {}
    with canvas(1.3) as (figures["grabber-warm-up-set-up"], axes):
        field = np.linspace(-0.5, 0.5, 2) * WIDTH_MM * BETWEEN / LENS_MM
        axes.plot([DISTANCE_MM] * 2, field, color=INK, linewidth=2)
        axes.plot([DISTANCE_MM] * 4, np.linspace(-60, 60, 4), "o", color=RED)
        axes.plot([[0, 0], [DISTANCE_MM] * 2], [[-WIDTH_MM / 2, WIDTH_MM / 2], field[::-1]], color=SOFT, linewidth=0.7)
        axes.plot([0, 0], [-9, 9], color=BLUE, linewidth=3)
        axes.plot([LENS_MM] * 2, [-15, 15], color=INK)
        axes.set(xlabel="distance from the sensor / mm", ylabel="mm", aspect="equal")
    with canvas(3.2) as (figures["grabber-warm-up-image"], axes):
        axes.imshow(frame[::2, ::2], cmap="gray", extent=(-0.5, 511.5, 511.5, -0.5), interpolation="none")
        axes.set(xlabel="x / samples", ylabel="y / px")
    with canvas(3.2) as (figures["grabber-warm-up-vectors"], axes):
        axes.quiver(*first, *(ENLARGED * shift), color=RED, angles="xy", scale_units="xy", scale=1, width=0.005)
        axes.set(xlim=(-20, 531), ylim=(531, -20), aspect="equal", xlabel="x / samples", ylabel="y / px")
    with canvas(2.2) as (figures["grabber-warm-up-time"], axes):
        for values, colour, name in zip(rms, (RED, BLUE), "xy", strict=True):
            axes.plot(minutes, values, color=colour, marker="o", markersize=2, label=name)
        axes.set(xlabel="time after switching on / min", ylabel="RMS shift / samples, px", xlim=(0, 90))
        axes.legend()
    return figures


def run():
    camera = load_camera("pulnix_tm6cn_epix_512")
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(60, 660, 4), np.linspace(80, 500, 4)))
    scene = Discs(x, y, diameter_px=12.0, blur_px=0.8, peak_photons=110000.0)
    warm = {"temperature_c": 40.0, "frame_period_s": EVERY_S}  # the camera has been on for hours
    frames = [camera.expose(scene, [k], **warm).data[0] for k in range(FRAMES)]
    minutes = EVERY_S / 60 * np.arange(FRAMES)
    named = [(f"{t:g} min", 60 * t, lambda k=k: frames[k]) for k, t in enumerate(minutes)]
    fit = measure_series(named, analogue=True, pixel_clock_mhz=10.0).drift.fit

    places = []
    for found in (locate(frame, polarity="bright").columns for frame in frames):
        order = np.lexsort([found["x_px"], np.rint(found["y_px"] / 100)])  # row by row of the plate
        places.append([found["x_px"][order], found["y_px"][order]])
    shift = np.array(places) - np.array(places[0])  # frames, axis, target
    rms, hour = np.sqrt((shift**2).mean(axis=2)).T, np.searchsorted(minutes, 60)
    tau, error = fit["scale_tau_s"], fit["scale_error_rel"]
    values = {"targets": shift.shape[2], "samples": rms[0][hour], "pixels": rms[0][hour] * 1.41875, "y_px": np.abs(shift[hour, 1]).max(),
              "smallest": np.abs(shift[hour, 0]).min(), "largest": np.abs(shift[hour, 0]).max(), "scale": BETWEEN / LENS_MM,
              "wide_mm": WIDTH_MM * BETWEEN / LENS_MM, "high_mm": 582 * 0.0083 * BETWEEN / LENS_MM,
              "rest": 4 * np.exp(-3600 / tau.value), "u_rest": 14400 * np.exp(-3600 / tau.value) * tau.u / tau.value**2,
              "error": 100 * error.value, "u_error": 100 * error.u, "tau_min": tau.value / 60, "u_tau_min": tau.u / 60}  # fmt: skip
    return values, draw(frames[0], np.array(places[0]), shift[hour], minutes, rms)
