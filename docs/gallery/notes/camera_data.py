"""The data of the chapter's camera, held against each other, and its two kinds of sensor, drawn and simulated."""

import numpy as np
from matplotlib.patches import Rectangle

from pixmetry import load_camera
from pixmetry.report.drawing import BLUE, INK, RED, SOFT, canvas
from pixmetry.scene.outlines import polygon
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

BAR = (400, 600, 480, 500)  # rows and columns of a bright bar, first and behind the last


def draw_interline(camera):
    """Four columns of pixels: the light-sensitive part and the covered register beside it, to scale."""
    width = camera["sensor.pixel_aperture"].params.width_x_px
    with canvas(2.0) as (figure, axes):
        for col in range(4):
            for row in range(4):
                axes.add_patch(Rectangle((col + 0.04, row + 0.06), width - 0.08, 0.88, color=BLUE))
                tip, tail = (col + width + 0.1, row + 0.5), (col + width - 0.15, row + 0.5)
                axes.annotate("", tip, tail, arrowprops={"arrowstyle": "->", "color": RED})
            axes.add_patch(Rectangle((col + width, 0), 1 - width - 0.04, 4.3, color=SOFT))
        axes.add_patch(Rectangle((0, 4.4), 4.0, 0.4, color=INK))
        axes.set(xlim=(-0.1, 4.1), ylim=(5, -0.2), xlabel="columns", ylabel="rows", xticks=range(5), yticks=range(5))
        axes.grid(False)
        return figure


def run():
    camera, line_hz = load_camera("pulnix_tm6cn"), 1 / load_camera("pulnix_tm6cn").line_period_s
    rows, cols = camera.frame_shape
    wide, high = (n * pitch / 1000 for n, pitch in zip((cols, rows), camera.pitch_um, strict=True))
    values = {"wide_mm": wide, "high_mm": high, "wide_px": 6410 / camera.pitch_um[0], "high_px": 4890 / camera.pitch_um[1],
              "line_khz": line_hz / 1000, "per_line": 28.375e6 / line_hz, "per_printed_line": 28.375e3 / 15.725,
              "printed_us": 1e3 / 15.725, "pixel_mhz": 28.375 / 2, "samples": camera.pixel_clock_hz / line_hz,
              "ntsc_mhz": 910 * 15734.26e-6, "transfer_us": 1e6 / line_hz, "snr_db": 20 * np.log10(255 / 0.9), "noise_dn": 255 / 10**2.5,
              "ratio": 100 / line_hz / camera.exposure_s}  # fmt: skip

    transfer = load_camera("ft_ccd_generic").switched(on=["sensor.smear"])
    top, end, left, right = BAR
    bar = polygon([left - 0.5, right - 0.5, right - 0.5, left - 0.5], [top - 0.5, top - 0.5, end - 0.5, end - 0.5], 20000.0)
    frame = transfer.expose(Picture((Shapes.of([bar]),), Uniform(0.0)), 1, quiet=True).data[0].astype(float)
    smear = transfer["sensor.smear"].params
    inside, outside = frame[450:550, 485:495].mean(), frame[650:950, 485:495].mean()
    values |= {"smear": 100 * outside / inside, "smear_told": 100 * smear.transfer_s / transfer.exposure_s * (end - top) / frame.shape[0]}
    leak = camera["sensor.smear"].params
    values["interline"] = leak.leak_rel * leak.transfer_s / camera.exposure_s * 100 * 0.1
    with canvas(2.6) as (figure, axes):
        percent = np.minimum(100 * frame[::4, ::4] / inside, 1.0)
        shown = axes.imshow(percent, cmap="gray", extent=(-0.5, 1023.5, 1023.5, -0.5), interpolation="none")
        figure.colorbar(shown, ax=axes, label="% of the bar, cut at 1 %")
        axes.set(xlabel="x / px", ylabel="y / px")
        axes.grid(False)
    return values, {"camera-data-interline": draw_interline(camera), "camera-data-smear": figure}
