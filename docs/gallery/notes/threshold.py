"""Error of a centroid against a threshold below which grey values are left out: hard, squared and soft, on a blurred disc."""

import numpy as np

from pixmetry.core.random import Grid
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.report.drawing import AMBER, BLUE, RED, canvas
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

TARGETS, SIDE, SEED = 800, 21, 38  # each in the middle of its own square of pixels
RADIUS_PX, BLUR_PX, PEAK, BACKGROUND, NOISE = 3.0, 0.7, 150.0, 5.0, 5.0  # grey values
THRESHOLDS = np.arange(0.0, 101.0, 5.0)


def frames():
    """Squares with a target at a random place in its pixel, as 8 bits store them; and these places."""
    random = np.random.default_rng(SEED)
    places = random.uniform(-0.5, 0.5, (2, TARGETS))
    x, y = (SIDE // 2 + v[:, None] for v in places)
    scene = Discs(x, y, 2 * RADIUS_PX, BLUR_PX, PEAK, Uniform(BACKGROUND), per_frame=True)
    light = scene.photons(Grid.whole(range(TARGETS), (SIDE, SIDE)), (SIDE, SIDE), np.ones(TARGETS), np.zeros(TARGETS))
    return np.clip(np.rint(light + NOISE * random.standard_normal(light.shape)), 0, 255), places


def error(seen, places, threshold, name):
    """Root mean square of measured minus true, x and y together."""
    if name == "squared":
        seen, law = np.where(seen > threshold, seen, 0.0), FixedCentroid("squared_centroid", SIDE)
    else:
        law = FixedCentroid(f"{name}_threshold", SIDE, threshold_dn=threshold)
    return np.sqrt(np.mean((np.stack(law.locate(seen)) - SIDE // 2 - places) ** 2))


def run():
    seen, places = frames()
    curves = {name: np.array([error(seen, places, t, name) for t in THRESHOLDS]) for name in ("hard", "squared", "soft")}
    values = {f"{name}_{t}": curve[int(t / 5)] for name, curve in curves.items() for t in (0, 25, 100)}
    values["best"] = THRESHOLDS[curves["hard"].argmin()]
    with canvas(2.6) as (figure, axes):
        for (name, curve), colour in zip(curves.items(), (RED, BLUE, AMBER), strict=True):
            axes.plot(THRESHOLDS, curve, color=colour, marker="o", markersize=2, label=name)
        axes.set(xlabel="threshold / grey value", ylabel="error, rms / px", ylim=(0, 0.14))
        axes.legend()
    return values, {"threshold-script": figure}
