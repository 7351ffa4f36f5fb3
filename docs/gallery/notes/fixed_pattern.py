"""An even field without a lens: the pattern that grabber and sensor leave in every frame, and what taking it off does."""

import numpy as np

from pixmetry import load_camera
from pixmetry.report.drawing import BLUE, RED, canvas
from pixmetry.scene.uniform import Uniform

PRESET, LEVEL_DN, FRAMES, WINDOW = "pulnix_tm6cn_epix_pixelclock", 180.0, 24, (0, 250, 200, 200)


def run():
    camera = load_camera(PRESET).switched(off=["optics.point_spread"])
    light = Uniform(61000.0 * (LEVEL_DN - 5) / 123)  # from the preset's half range
    warm = {"window": WINDOW, "temperature_c": 40.0}
    frames = np.concatenate([camera.expose(light, range(k, k + 4), **warm).data for k in range(0, FRAMES, 4)]).astype(float)
    later = camera.expose(light, [1000], **warm).data[0].astype(float)
    without = camera.switched(off=["grabber.fixed_pattern"])
    mean, flat = frames.mean(axis=0), without.expose(light, 1, quiet=True, **warm).data[0]
    steps = [Uniform(light.level_photons * (1 + k / 8 / LEVEL_DN)) for k in range(8)]  # of an eighth of a grey value: no rounding is left
    fixed = np.mean([camera.expose(step, 1, quiet=True, **warm).data[0].astype(float) for step in steps], axis=0)  # the truth
    rows = mean.mean(axis=1)
    pattern = mean - mean.mean()
    values = {"rms": np.sqrt((frames**2).mean()), "rows": rows.max() - rows[-40:].mean(),
              "correlation": np.corrcoef(pattern.ravel(), fixed.ravel())[0, 1], "one": later.std(), "cleaned": (later - pattern).std(),
              "pattern": pattern.std(), "settles": np.argmax(rows < rows[-40:].mean() + 0.5), "range": np.ptp(mean),
              "sensor": flat.std(), "expected": (1 + (later.var() - fixed.var()) / FRAMES / fixed.var()) ** -0.5}  # fmt: skip
    with canvas(2.6, ncols=2, width_ratios=[3, 2]) as (figure, (shown, profile)):
        coarse = mean.reshape(100, 2, 100, 2).mean(axis=(1, 3))
        shown.imshow(coarse, cmap="gray", vmin=mean.mean() - 1.5, vmax=mean.mean() + 3.5, extent=(249.5, 449.5, 199.5, -0.5))
        shown.set(xlabel="x / px", ylabel="y / px")
        shown.grid(False)
        profile.plot(rows - rows[-40:].mean(), np.arange(200), color=RED)
        profile.axvline(0, color=BLUE, linewidth=0.7)
        profile.set(xlabel="row mean", ylim=(199.5, -0.5))
    return values, {"fixed-pattern": figure}
