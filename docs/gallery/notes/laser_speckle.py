"""A laser spot on a background that moves between the frames: where its centroid goes."""

import numpy as np

from pixmetry import load_camera
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.picture import Picture
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

WAVELENGTH_UM, PITCH_UM, SIDE, RADIUS_PX = 0.67, 8.6, 41, 6.0
FRAMES = {11.0: 50, 16.0: 100, 22.0: 50}  # by f-number
ROW, COL = 291, 376  # of the pixel under the spot


def track(f_number, frames, frames_each=1):
    """Centroids of the spot in some frames, shape (2, frames), with the spot's true middle at 0."""
    lambda_n = WAVELENGTH_UM * f_number / PITCH_UM
    spot = Speckle(COL, ROW, RADIUS_PX, 60000.0, lambda_n, frames_each=frames_each)
    camera = load_camera("pulnix_tm6cn").switched(off=["sensor.unflatness", "sensor.interlace"])
    window = (ROW - SIDE // 2, COL - SIDE // 2, SIDE, SIDE)
    frames = camera.expose(Picture((spot,), Uniform(0.0)), frames, window=window, temperature_c=40.0).data
    places = FixedCentroid("soft_threshold", SIDE, threshold_dn=5.0, background_dn=5.0).locate(frames.astype(float))
    return np.array(places) - SIDE // 2


def run():
    values, tracks = {}, {n: track(n, frames) for n, frames in FRAMES.items()}
    still = track(16.0, 20, frames_each=0)
    for n, found in tracks.items():
        size = np.sqrt((found**2).mean())
        law = WAVELENGTH_UM * n / (np.pi * PITCH_UM)  # a uniform spot in a round pupil, of many speckles
        values |= {
            f"std_{n:.0f}": size,
            f"u_std_{n:.0f}": size / np.sqrt(2 * found.size),
            f"law_{n:.0f}": law,
            f"ratio_{n:.0f}": size / law,
        }
    extent = np.ptp(tracks[16.0], axis=1)
    values |= {"extent": np.sqrt(extent.prod()), "aspect": extent.max() / extent.min(), "still": still.std(axis=1).max(),
               "x_px": extent[0], "y_px": extent[1], "lambda_n": WAVELENGTH_UM * 16 / PITCH_UM}  # fmt: skip
    with canvas(2.9) as (figure, axes):
        axes.plot(*tracks[16.0], color=BLUE, linewidth=0.5, marker="o", markersize=2, label="background moved between frames")
        axes.plot(*still, "o", color=RED, markersize=3, label="nothing moved")
        axes.set(xlabel="x / px", ylabel="y / px", aspect="equal")
        figure.legend(loc="outside lower center", ncols=2)
    return values, {"laser-speckle": figure}
