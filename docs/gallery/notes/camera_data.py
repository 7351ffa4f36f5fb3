"""The data of the chapter's camera, held against each other, and a card of the camera, drawn from them."""

import numpy as np
from matplotlib.patches import Rectangle

from pixmetry import load_camera
from pixmetry.report.drawing import BLUE, INK, SOFT, canvas

BODY_MM, CHIP_MM, CLOCK_HZ, LINES = (45.0, 39.0, 75.0), (7.95, 6.45), 28.375e6, 625  # as the chapter's table has them


def draw_card(camera, values):
    """The front of the camera with its chip and the light-sensitive area, to scale, and the numbers that follow from its data."""
    wide, high = values["wide_mm"], values["high_mm"]
    with canvas(2.4, ncols=2, width_ratios=(1, 1.1)) as (figure, (front, words)):
        for (w, h), colour, filled in ((BODY_MM[:2], SOFT, False), (CHIP_MM, INK, True), ((wide, high), BLUE, True)):
            front.add_patch(Rectangle((-w / 2, -h / 2), w, h, edgecolor=colour, facecolor=colour if filled else "none"))
        front.set(xlim=(-26, 26), ylim=(-23, 23), aspect="equal", xlabel="mm", ylabel="mm")
        told = [f"{camera.frame_shape[1]} × {camera.frame_shape[0]} pixels, {camera.pitch_um[0]:g} × {camera.pitch_um[1]:g} µm",
                f"light-sensitive {wide:.3f} × {high:.3f} mm", f"diagonal {values['diagonal_mm']:.2f} mm (half inch)",
                f"pixel clock {values['pixel_mhz']:.4f} MHz", f"line {values['line_khz']:.3f} kHz, field {values['field_hz']:.1f} Hz",
                f"exposure {1e3 * camera.exposure_s:.0f} ms, 2 fields", f"noise {values['snr_db']:.0f} dB below white"]  # fmt: skip
        for k, line in enumerate(told):
            words.text(0.0, 0.95 - 0.13 * k, line, fontsize=7, va="top")
        words.set_axis_off()
        return figure


def run():
    camera = load_camera("pulnix_tm6cn")
    line_hz, well_e = 1 / camera.line_period_s, camera["sensor.full_well"].params.full_well_e
    rows, cols = camera.frame_shape
    wide, high = (n * pitch / 1000 for n, pitch in zip((cols, rows), camera.pitch_um, strict=True))
    values = {"wide_mm": wide, "high_mm": high, "wide_px": 6410 / camera.pitch_um[0], "high_px": 4890 / camera.pitch_um[1],
              "line_khz": line_hz / 1000, "per_line": CLOCK_HZ / line_hz, "per_printed_line": CLOCK_HZ / 15725,
              "printed_us": 1e3 / 15.725, "pixel_mhz": CLOCK_HZ / 2e6, "samples": camera.pixel_clock_hz / line_hz,
              "ntsc_mhz": 910 * 15734.26e-6, "snr_db": 20 * np.log10(255 / 0.9), "noise_dn": 255 / 10**2.5,
              "field_hz": 2 * line_hz / LINES, "printed_hz": 2 * 15725 / LINES, "diagonal_mm": np.hypot(wide, high),
              "range_db": 20 * np.log10(well_e * 0.0097 / 0.9), "range_ratio": 10 ** (67 / 20), "white_e": well_e}  # fmt: skip
    return values, {"camera-data-card": draw_card(camera, values)}
