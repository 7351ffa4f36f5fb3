"""Noise against grey value in 50 x 50 pixels, its histogram, and what a freezer can explain."""

import numpy as np

from pixmetry import Frames, campaign_of_arrays, emva1288, load_camera
from pixmetry.report.drawing import BLUE, INK, RED, canvas
from pixmetry.scene.uniform import Uniform

WINDOW, WARM_C, PER_DN = (266, 350, 50, 50), 40.0, 62000 / 125  # photons for a grey value: 125 at the preset's half range
LEVELS_DN = np.array([5.0, 20, 40, 60, 80, 100, 120, 140, 160, 180, 200, 225, 245])


def patch(level_dn, seed, frames=2, celsius=WARM_C):
    """Frames of the 50 x 50 pixels."""
    camera = load_camera("pulnix_tm6cn")
    return camera.expose(Uniform(level_dn * PER_DN), frames, seed=seed, window=WINDOW, temperature_c=celsius).data


def run():
    seen = [patch(level, k) for k, level in enumerate(LEVELS_DN)]
    dark = [patch(0.0, 100 + k) for k in range(len(LEVELS_DN))]
    groups = [Frames("bright", 1e-3 * level, data, photons=level * PER_DN) for level, data in zip(LEVELS_DN, seen, strict=True)]
    groups += [Frames("dark", 1e-3 * level, data) for level, data in zip(LEVELS_DN, dark, strict=True)]
    sheet = emva1288(campaign_of_arrays(groups, bits=8, interface="analogue", sensor="ccd")).results[0].values
    grey, single = (np.array([getattr(data[0], what)() for data in seen]) for what in ("mean", "std"))
    gain, pair = sheet["K"].value, [np.diff(data.astype(float), axis=0).std() / np.sqrt(2) for data in seen]

    many = patch(225.0, 50, 40).astype(int)
    spread = np.ptp(many.reshape(40, -1), axis=1)
    middle = patch(115.0, 60, 40).astype(float)
    left = np.rint(middle - middle.mean(axis=(1, 2), keepdims=True))
    deviation = middle.std(axis=(1, 2)).mean()
    counts = np.array([(left == k).sum() / 40 for k in range(-8, 9)])
    cold, warm = (patch(115.0, 70, 20, celsius).std(axis=(1, 2)) for celsius in (-3.0, 17.0))
    rise_e2 = (1.80**2 - 1.40**2) / gain**2
    values = {"dark": single[0], "u_dark": single[0] / np.sqrt(5000), "bright": single[-1], "u_bright": single[-1] / np.sqrt(5000),
              "gain": gain, "u_gain": sheet["K"].u, "dark_e": sheet["sigma_d"].value, "u_dark_e": sheet["sigma_d"].u,
              "spread": spread.mean(), "u_spread": spread.std(ddof=1) / np.sqrt(40), "share_13": (spread >= 13).mean(),
              "grey": many.mean(), "peak": counts.max(), "u_peak": (left == 0).sum(axis=(1, 2)).std() / np.sqrt(40),
              "deviation": deviation, "beyond": (np.abs(middle - middle.mean(axis=(1, 2), keepdims=True)) > 3 * deviation).sum() / 40,
              "ratio": warm.mean() / cold.mean(), "u_ratio": np.hypot(warm.std(), cold.std()) / cold.mean() / np.sqrt(20),
              "needed_e": rise_e2, "needed_dn": rise_e2 * gain, "pair": pair[-1], "quantisation": 1 / np.sqrt(12)}  # fmt: skip
    with canvas(2.4) as (curve, axes):
        fine = np.linspace(0, 250, 200)
        axes.plot(
            fine,
            np.sqrt(gain**2 * sheet["sigma_d"].value ** 2 + 1 / 12 + gain * fine),
            color=INK,
            label="read noise, rounding and shot noise",
        )
        axes.plot(grey, single, "o", color=RED, label="one frame")
        axes.plot(grey, pair, "s", color=BLUE, markerfacecolor="none", label="difference of two frames")
        axes.set(xlabel="grey value", ylabel="standard deviation", xlim=(0, 260), ylim=(0.8, 2.0))
        axes.legend()
    with canvas(2.2) as (histogram, axes):
        axes.bar(np.arange(-8, 9), counts, color=BLUE)
        fine = np.linspace(-8, 8, 200)
        axes.plot(fine, 2500 / deviation / np.sqrt(2 * np.pi) * np.exp(-((fine / deviation) ** 2) / 2), color=RED)
        axes.set(xlabel="grey value less mean", ylabel="pixels of 2500", xlim=(-8.5, 8.5))
    return values, {"amplifier-noise": curve, "amplifier-noise-histogram": histogram}
