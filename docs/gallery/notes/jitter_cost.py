"""What line jitter of a frame grabber costs a round target, and what it costs a single row."""

import numpy as np

from pixmetry import load_camera
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

JITTER_NS = 5.0
SIDE, ACROSS, DOWN, DIAMETER_PX = 21, 30, 20, 7.0
SIZES_PX = (4.0, 7.0, 12.0)


def places(jitter_ns, diameter_px):
    """Positions along x of 600 discs in a frame without noise, in the order of their rows; every row has a jitter of its own."""
    camera = load_camera("pulnix_tm6cn_epix_pixelclock").with_parameters("grabber.line_jitter", white_ns=jitter_ns)
    corner = np.array(np.divmod(np.arange(ACROSS * DOWN), ACROSS))[::-1] * SIDE
    phase = np.random.default_rng(26).uniform(-0.5, 0.5, corner.shape)
    on = ["grabber.line_jitter"] if jitter_ns else ["grabber.adc"]
    scene = Discs(*(corner + SIDE // 2 + phase), diameter_px, 0.7, 60000.0, Uniform(1000.0))
    frame = camera.switched(on=on).expose(scene, seed=4, quiet=False, temperature_c=40.0).data[0].astype(float)
    tiles = frame[: DOWN * SIDE, : ACROSS * SIDE].reshape(DOWN, SIDE, ACROSS, SIDE).swapaxes(1, 2).reshape(-1, SIDE, SIDE)
    return FixedCentroid("soft_threshold", SIDE, threshold_dn=5.0, background_dn=np.median(frame)).locate(tiles)[0]


def cost(jitter_ns, diameter_px):
    """RMS shift by the jitter; its standard error is that of 20 rows of discs, for those of one row share their jitter."""
    shift = places(jitter_ns, diameter_px) - places(0.0, diameter_px)
    return np.sqrt((shift**2).mean())


def run():
    ns_per_px = 1e9 / load_camera("pulnix_tm6cn").pixel_clock_hz
    found = {size: cost(JITTER_NS, size) for size in SIZES_PX}
    values = {"row": JITTER_NS / ns_per_px, "jitter": JITTER_NS} | {f"disc_{size:.0f}": v for size, v in found.items()}
    values |= {"share": found[DIAMETER_PX] / values["row"], "u_share": found[DIAMETER_PX] / values["row"] / np.sqrt(2 * DOWN)}
    with canvas(2.0) as (figure, axes):
        axes.plot(SIZES_PX, list(found.values()), "o-", color=BLUE, label="round target")
        axes.axhline(values["row"], color=RED, linestyle="--", label="single row")
        axes.set(xlabel="diameter / px", ylabel=f"RMS along x at {JITTER_NS:g} ns / px", ylim=(0, None))
        axes.legend()
    return values, {"jitter-cost": figure}
