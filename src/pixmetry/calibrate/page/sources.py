"""What the residuals tell of error sources: height of the sensor, steps between parts of the frame, x-scales of the images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.checks.causes import STRONG
from pixmetry.calibrate.checks.quality import p_words
from pixmetry.calibrate.page.figures import colour_bar, frame, frame_height
from pixmetry.report import Column, Figure, Row, Section, Table
from pixmetry.report.drawing import canvas
from pixmetry.report.numbers import significant

if TYPE_CHECKING:
    from pixmetry.calibrate.bundle.model import Sensor
    from pixmetry.calibrate.records import FieldSources, HeightMap, ImageScales, Seams

WORDS = (
    "Of every source only that part is told which lens, affinity and poses do not take up: of a height, not its mean, its slope, and what "
    "depends on the radius alone. A height stands for displacements along the radius, as rays from the principal distance make them. "
    "u holds what residuals have in common in an image or in a part of the frame."
)


def add_sources(section: Section, found: FieldSources, model: CameraModel) -> None:
    """What the residuals of one camera tell of its error sources: a table, and the map of a height that was found."""
    rows = [row for row in (_height_row(found.height, model), _seams_row(found.seams), _scales_row(found.scales, model.interface)) if row]
    if not rows:
        return
    columns: list[Column | str] = ["Error source", Column("Value", "right"), Column("u", "right"), Column("Unit", "left")]
    part = section.add_section("What the residuals tell of error sources", Table(f"Error sources of {model.name}", columns, rows))
    part.add_text(WORDS, style="small soft")
    if found.height is not None and found.height.found:
        part.add(height_picture(found.height, model.sensor, model.name))
    if found.seams is not None and found.seams.found:
        part.add(_steps_table(found.seams, model.name))


def _unit(sensor: Sensor) -> tuple[float, str]:
    return (1.0, "px") if sensor.pitch_x_um is None else (sensor.pitch_x_um, "µm")


def _height_row(height: HeightMap | None, model: CameraModel) -> Row | None:
    if height is None:
        return None
    factor, unit = _unit(model.sensor)
    rms, u = (factor * float(np.sqrt(np.mean(part**2))) for part in (height.height_px, height.u_px))
    if height.found:
        text = f"{height.rank} shapes are told; displacements of these shapes across the radius: {p_words(height.p_turned)}."
        return Row(["Sensor unflatness, rms height", significant(rms, 2), significant(u, 2), unit], text)
    limit = float(np.sqrt(rms**2 + (1.645 * u) ** 2))
    text = "No height was found."
    if height.rivals:
        text = "Other patterns explain its residuals as well."
    elif height.gain > STRONG:
        text = "A height would explain residuals, but other displacements come with it, or the images are fewer than 8."
    return Row(["Sensor unflatness, rms height", f"at most {significant(limit, 2)}", "", unit], text)


def _seams_row(seams: Seams | None) -> Row | None:
    if seams is None:
        return None
    what = "Steps between parts of the frame"
    if seams.found:
        text = f"{seams.fields_x} × {seams.fields_y} fields; standard deviation of the place of one."
        return Row([what, significant(seams.std_px, 2), significant(seams.u_std_px, 2), "px"], text)
    text = "Other patterns explain them as well." if seams.gain > STRONG else "No step was found, with up to eight fields."
    return Row([what, f"at most {significant(seams.limit_px, 2)}", "", "px"], text)


def _scales_row(scales: ImageScales | None, interface: str | None) -> Row | None:
    if scales is None or (scales.p_differ > 1e-3 and scales.gain <= STRONG):
        return None
    digital = " The camera is digital: no frame grabber makes this." if interface == "digital" else ""
    if scales.covariance is not None and scales.gain > STRONG:
        u, u_tau = np.sqrt(np.diag(scales.covariance)).tolist()
        text = f"It decays with a time constant of {significant(scales.tau_s, 2)} ± {significant(u_tau, 2)} s."
        return Row(["x-scale of the first image", significant(1e6 * scales.start, 2), significant(1e6 * u, 2), "ppm"], text + digital)
    spread, u = 1e6 * float(scales.values.std()), 1e6 * float(np.median(scales.u))
    text = f"The x-scales differ from image to image, {p_words(scales.p_differ)}, and do not decay; u is that of one image."
    return Row(["x-scales of the images, standard deviation", significant(spread, 2), significant(u, 2), "ppm"], text + digital)


def _steps_table(seams: Seams, name: str) -> Table:
    rows: list[Sequence[str]] = []
    for k, (step, u) in enumerate(zip(seams.steps_px, seams.u_steps_px, strict=True)):
        row, col = divmod(k, seams.fields_x)
        cells = [f"{significant(s, 2)} ± {significant(e, 2)}" for s, e in zip(step, u, strict=True)]
        rows.append([f"column {col + 1} of {seams.fields_x}, row {row + 1} of {seams.fields_y}", *cells])
    columns: list[Column | str] = ["Field", Column("Displacement in x / px", "right"), Column("in y / px", "right")]
    return Table(f"Steps between the fields of {name}", columns, [Row(list(cells)) for cells in rows])


def height_picture(height: HeightMap, sensor: Sensor, name: str) -> Figure:
    """The height over the frame, by colour."""
    factor, unit = _unit(sensor)
    values = factor * height.height_px
    most = float(np.abs(values).max()) or 1.0
    with canvas(frame_height(sensor)) as (figure, axes):
        frame(axes, sensor)
        extent = (-0.5, sensor.cols - 0.5, sensor.rows - 0.5, -0.5)
        image = axes.imshow(values, extent=extent, cmap="RdBu_r", vmin=-most, vmax=most, interpolation="bilinear", zorder=0)
        colour_bar(figure, axes, image, f"height / {unit}")
        u = factor * float(np.sqrt(np.mean(height.u_px**2)))
        low, high = (significant(v, 2) for v in (values.min(), values.max()))
        caption = (
            f"Height of the sensor over its plane, from {low} to {high} {unit}, without what lens and poses take up; positive is farther "
            f"from the lens. Its u is {significant(u, 2)} {unit} (rms over the frame)."
        )
        return Figure(figure, f"{name}-height", f"Map of the height of the sensor, {low} to {high} {unit}", caption)
