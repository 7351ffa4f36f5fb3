"""A camera whose pixels are read out by one clock and sampled by another one."""

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.discs import Discs

GRABBER = "pulnix_tm6cn_epix_512"  # a sampling clock of 10 MHz, 512 samples a row
SETTLED_C = 40.0


def draw_samples(pixel_hz, sample_hz):
    """The end of the sampled part of a row: which pixels the samples see."""
    with canvas(1.5) as (figure, axes):
        for hz, level, colour in ((pixel_hz, 1.0, BLUE), (sample_hz, 0.0, RED)):
            width = pixel_hz / hz  # in pixels
            edges = np.arange(705 // width, 752.5 if hz == pixel_hz else 512.5) * width
            axes.vlines(edges, level, level + 0.7, color=colour, linewidth=0.7)
            axes.hlines([level, level + 0.7], edges[0], edges[-1], color=colour, linewidth=0.7)
        axes.set_xlim(705, 757)
        axes.set_yticks([0.35, 1.35], ["512 samples", "752 pixels"])
        axes.set_xlabel("place in the row / pixels of the sensor")
        axes.grid(False)
        return figure


def slope(terms, values, which):
    """One coefficient of a linear fit, and its standard uncertainty from the residuals."""
    fit, squares, *_ = np.linalg.lstsq(terms, values, rcond=None)
    variance = squares[0] / (len(values) - terms.shape[1]) * np.linalg.inv(terms.T @ terms)[which, which]
    return fit[which], np.sqrt(variance)


def run():
    camera = load_camera(GRABBER).switched(off=["grabber.clock_warm_up", "sensor.unflatness"])  # the clock is warm, the sensor flat
    pixel_hz, sample_hz = camera.pixel_clock_hz, 1e6 * camera["grabber.sampling_clock"].params.clock_mhz
    ratio = pixel_hz / sample_hz

    # Blind: a plate with a square lattice, located in a stored frame; scale of y over scale of x.
    x, y = (v.ravel() for v in np.meshgrid(np.arange(30.0, 710, 40), np.arange(50.0, 530, 40)))
    scene = Discs(x, y, diameter_px=10.0, blur_px=0.7, peak_photons=60000.0)
    found = locate(camera.expose(scene, 1, temperature_c=SETTLED_C).data[0], polarity="bright").columns
    places = camera.true_positions(x, y, temperature_c=SETTLED_C)  # only to tell which target is which
    near = np.hypot(places[0][:, None] - found["x_px"], places[1][:, None] - found["y_px"])
    good, seen = near.min(axis=1) < 1, near.argmin(axis=1)
    terms = np.column_stack([x, y, np.ones_like(x)])[good]
    (across, u_across), (down, u_down) = (slope(terms, found[f"{axis}_px"][seen[good]], k) for k, axis in enumerate("xy"))
    values = {"ratio": ratio, "seen_px": 512 * ratio, "lost_px": 752 - 512 * ratio, "pitch_um": 8.6 * ratio,
              "handbook_pitch_um": 8.6 * 752 / 512, "found": down / across, "u_found": ratio * np.hypot(u_across / across, u_down / down),
              "targets": good.sum(), "off_px": 256 * (752 / 512 / ratio - 1), "full_mhz": 1e-6 * pixel_hz * 512 / 752,}  # fmt: skip
    return values, {"sampling-clock": draw_samples(pixel_hz, sample_hz)}
