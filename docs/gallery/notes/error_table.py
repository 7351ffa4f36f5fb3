"""The error table of the chapter for its own camera and for a modern one: what each source adds to a round target after a calibration."""

import numpy as np

from pixmetry import budget
from pixmetry.report.drawing import BLUE, RED, canvas

CAMERAS = {"chapter": "pulnix_tm6cn_epix_pixelclock", "modern": "imx264_like"}
SCENARIO = {  # the chapter's test of residuals, as far as it tells its conditions
    "schema": "pixmetry/scenario/1",
    "target": {"diameter_px": 4.5, "peak_rel": 0.58, "background_rel": 0.02, "surface": "diffuse"},
    "object": {"distance_mm": 665, "f_mm": 25},
    "state": {"camera_on_min": 60, "grabber_on_min": 90},
    "calibration": {"model": "lens", "noise_px": 0, "camera_on_min": 60, "grabber_on_min": 90},
}
SHOWN = 8


def run():
    found = {name: budget(camera, SCENARIO, estimator="centroid") for name, camera in CAMERAS.items()}
    values = {f"{name}_{axis}": one.one.after_px[k] for name, one in found.items() for k, axis in enumerate("xy")}
    after = {name: {row.title: row.after_px for row in one.rows if row.counts} for name, one in found.items()}
    titles = list(after["chapter"])[:SHOWN]
    values["rows"] = sum(bool(row.number) for row in found["chapter"].rows)
    with canvas(2.6) as (figure, axes):
        for step, (name, colour) in enumerate(zip(CAMERAS, (RED, BLUE), strict=True)):
            axes.barh(np.arange(SHOWN) + 0.4 * step, [after[name].get(t, 0.0) for t in titles], height=0.38, color=colour, label=name)
        axes.set(yticks=np.arange(SHOWN) + 0.2, yticklabels=titles, xlabel="after a calibration / px")
        axes.invert_yaxis()
        axes.legend()
    return values, {"error-table-script": figure}
