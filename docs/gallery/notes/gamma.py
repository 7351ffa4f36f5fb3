"""The response of a camera at a gamma of 0.45 and of 1, and what both do to the position of a target."""

import numpy as np

from pixmetry.camera.camera import build_camera
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

GAMMAS, SIDE, GAIN, ACROSS = {"045": 0.45, "1": 1.0}, 21, 0.0097, 20


def camera_of(gamma):
    """Shot noise, 85 electrons of read noise, gain, gamma, 8 bits; black at 5 grey values, white at 255."""
    chain = [("sensor.quantum_efficiency", {"quantum_efficiency": 1.0}), ("sensor.shot_noise", {}),
             ("electronics.amplifier_noise", {"white_e": 85.0}),
             ("electronics.gain", {"gain_dn_per_e": GAIN}), ("electronics.gamma", {"gamma": gamma, "reference_dn": 250.0}),
             ("grabber.adc", {"bits": 8, "offset_dn": 5.0})]  # fmt: skip
    record = {"schema": "pixmetry/camera/1", "name": "gamma", "rows": SIDE * ACROSS, "cols": SIDE * ACROSS, "exposure_s": 0.02,
              "chain": [{"source": name, "parameters": given} for name, given in chain]}  # fmt: skip
    return build_camera(record)


def errors(gamma, quiet=False):
    """RMS errors along x of 400 discs of 7 px in the same light, peak at 60 % of the straight scale, by estimator; noise of the ground."""
    phase = np.random.default_rng(5).uniform(-0.5, 0.5, (2, ACROSS**2))
    corner = np.array(np.divmod(np.arange(ACROSS**2), ACROSS))[::-1] * SIDE
    x, y = corner + SIDE // 2 + phase
    scene = Discs(x, y, 7.0, 0.7, 0.6 * 250 / GAIN, Uniform(500.0))
    frames = [camera_of(gamma).expose(scene, 1, seed=3, quiet=q).data[0].astype(float) for q in (False, quiet)]
    tiles = frames[1].reshape(ACROSS, SIDE, ACROSS, SIDE).swapaxes(1, 2).reshape(-1, SIDE, SIDE)
    ground, noise = np.median(frames[0][:, :3]), frames[0][:, :3].std()
    ways = {"soft": FixedCentroid("soft_threshold", SIDE, threshold_dn=3 * noise, background_dn=ground),
            "hard": FixedCentroid("hard_threshold", SIDE, threshold_dn=60.0, background_dn=ground)}  # fmt: skip
    return {name: np.sqrt(((way.locate(tiles)[0] + corner[0] - x) ** 2).mean()) for name, way in ways.items()} | {"noise": noise}


def run():
    values, levels = {}, np.geomspace(0.03, 0.95, 12) * 250 / GAIN
    with canvas(2.5) as (figure, axes):
        for (name, gamma), colour in zip(GAMMAS.items(), (RED, BLUE), strict=True):
            grey = np.array([camera_of(gamma).expose(Uniform(v), 1).data.mean() - 5.0 for v in levels])
            (slope, at), cov = np.polyfit(np.log10(levels), np.log10(grey), 1, cov=True)
            values |= {f"slope_{name}": slope, f"u_slope_{name}": np.sqrt(cov[0, 0])}
            values |= {f"{way}_{name}": v for way, v in errors(gamma).items()}
            values |= {f"{way}_quiet_{name}": v for way, v in errors(gamma, quiet=True).items()}
            axes.loglog(levels * GAIN / 250, grey, "o", color=colour, label=f"gamma {gamma:g}")
            axes.loglog(levels * GAIN / 250, 10**at * levels**slope, color=colour)
        axes.set(xlabel="relative exposure", ylabel="grey value above black")
        axes.legend()
    values["tenth"] = (camera_of(0.45).expose(Uniform(0.1 * 250 / GAIN), 1).data.mean() - 5.0) / 250
    values |= {"ratio": values["soft_045"] / values["soft_1"], "u_ratio": values["soft_045"] / values["soft_1"] / 20}
    values |= {"u_soft_045": values["soft_045"] / np.sqrt(800), "u_soft_1": values["soft_1"] / np.sqrt(800)}
    return values, {"gamma": figure}
