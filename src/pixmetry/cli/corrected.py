"""``pixmetry corrected``: positions without what is known of their camera's geometry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._console import echo, echo_lines
from pixmetry.cli._json import JsonResult, json_option

if TYPE_CHECKING:
    from pixmetry.assess.corrected import CorrectedPositions


@click.command()
@click.argument("table", type=click.Path(path_type=Path))
@click.option("--with", "camera", required=True, metavar="CAMERA", help="A preset, a data sheet, or the camera.yaml of an assessment.")
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="File of the table. Default: standard output.")
@click.option("--scenario", type=click.Path(path_type=Path), metavar="FILE", help="State and motion of the measurement, as of a budget.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change an entry of the scenario or of the camera, such as state.grabber_on_min=20. May be repeated.",
)
@click.option(
    "--u",
    "uncertainties",
    multiple=True,
    metavar="KEY=U",
    help="Standard uncertainty of such a value, where nothing tells it. May be repeated.",
)
@click.option("--on-for-s", type=click.FloatRange(0), metavar="S", help="Time since camera and grabber were switched on.")
@click.option("--temperature-k", type=float, metavar="K", help="Change of the temperature since the calibration.")
@click.option(
    "--speed", metavar="PX/S[,DEG]", help="Speed of the targets in pixels of the sensor, and its direction (0: to the right, 90: down)."
)
@click.option("--cover-glass", metavar="MM[,INDEX]", help="Thickness of the plate in front of the sensor, and its refractive index.")
@click.option(
    "--clock-ratio", type=click.FloatRange(0, min_open=True), metavar="RATIO", help="Camera's pixel clock over the grabber's clock."
)
@click.option("--height-map", type=click.Path(path_type=Path), metavar="FILE", help="Height of the sensor in µm: NPY, TIFF, or CSV.")
@click.option("--reference", type=click.Path(path_type=Path), metavar="FILE", help="Table of where targets should be, by name.")
@click.option(
    "--per-image",
    type=click.Choice(["shift", "scale", "pose", "rows"]),
    default="scale",
    show_default=True,
    help="What of each image is fitted to the reference: a shift; also scales along the axes; or a shift and a rotation. "
    "rows: the reference is a straight line, x in each row y; jitter of the rows is taken off.",
)
@click.option("--match", metavar="COLUMN", help="Column that names targets in both tables. Default: point, name, label, id or target.")
@click.option("--only", multiple=True, metavar="ID", help="Correct only this source. May be repeated.")
@click.option("--skip", multiple=True, metavar="ID", help="Leave this source in the positions. May be repeated.")
@click.option("--list", "listed", is_flag=True, help="Only list what would be corrected, and what not.")
@click.option("--x", "x", metavar="COLUMN", help="Column with x. Default: x_px or x.")
@click.option("--y", "y", metavar="COLUMN", help="Column with y. Default: y_px or y.")
@click.option(
    "--origin",
    type=click.Choice(["first_pixel", "corner", "one"]),
    default="first_pixel",
    show_default=True,
    help="What the table calls the centre of its top-left pixel: (0, 0), (0.5, 0.5) or (1, 1).",
)
@json_option("what was corrected")
def corrected(
    table: Path,
    camera: str,
    output: Path | None,
    scenario: Path | None,
    settings: tuple[str, ...],
    uncertainties: tuple[str, ...],
    on_for_s: float | None,
    temperature_k: float | None,
    speed: str | None,
    cover_glass: str | None,
    clock_ratio: float | None,
    height_map: Path | None,
    reference: Path | None,
    per_image: str,
    match: str | None,
    only: tuple[str, ...],
    skip: tuple[str, ...],
    listed: bool,
    x: str | None,
    y: str | None,
    origin: str,
    json_file: Path | None,
) -> None:
    """Correct positions for what is known of their camera's geometry, with the covariance of the correction.

    TABLE is a CSV or JSON file of `pixmetry locate`, or any CSV with columns for x and y. Corrected are lens distortion, cover glass, tilt,
    unflatness, temperature, warm-up of camera and grabber, the grabber's clock and window, and the times at which rows look at a moving
    target: whatever moves points in the camera's description. The columns frame, time_s, temperature_c, vx_px_per_s and vy_px_per_s count
    where the table has them. The positions are those of the ideal camera, in pixels of the sensor.

    Example: pixmetry corrected table.csv --with camera.yaml --on-for-s 600 -o corrected.csv
    """
    from pixmetry.assess.corrected import CORRECTED_SCHEMA, checked_output
    from pixmetry.assess.corrected import corrected as run
    from pixmetry.assess.known_geometry import clock_settings, glass_settings, height_map_of, speed_settings
    from pixmetry.assess.position_tables import form_of
    from pixmetry.camera.camera import load_camera
    from pixmetry.camera.overrides import parse_overrides

    inputs = [path for path in (table, scenario, height_map, reference, Path(camera)) if path is not None and path.is_file()]
    written = JsonResult(json_file, CORRECTED_SCHEMA, inputs=inputs)
    if output is not None:
        checked_output(output, form_of(table), inputs)
    known = load_camera(camera)
    asked: dict[str, Any] = {}
    if on_for_s is not None:
        asked |= {"state.camera_on_min": on_for_s / 60, "state.grabber_on_min": on_for_s / 60}
    if temperature_k is not None:
        asked["state.temperature_change_k"] = temperature_k
    if speed is not None:
        asked |= speed_settings(speed)
    if cover_glass is not None:
        asked |= glass_settings(cover_glass)
    if clock_ratio is not None:
        asked |= clock_settings(clock_ratio, known)
    heights = None if height_map is None else height_map_of(height_map, known)
    if heights is not None:
        asked |= heights.settings
    asked |= parse_overrides(settings)
    found = run(
        table,
        known,
        scenario=scenario,
        settings=asked,
        u={**({} if heights is None else heights.u), **parse_overrides(uncertainties)},
        only=only,
        skip=skip,
        x=x,
        y=y,
        origin=origin,
        reference=reference,
        per_image=per_image,
        match=match,
    )
    if heights is not None:
        found = replace(found, notes=(*found.notes, *heights.notes))
    if output is not None and not listed:
        found.write(output)
    on_paper = output is None and not listed and not written.printed
    if on_paper:
        echo_lines(found.content().decode(), nl=False)
    if not written.printed:
        print_correction(found, err=on_paper)
        if output is not None and not listed:
            echo(f"table: {output}")
    written.put({name: value for name, value in found.to_record().items() if name != "schema"})


def print_correction(found: CorrectedPositions, err: bool = False) -> None:
    """What was corrected with its largest shift and uncertainty, and what not, with the reason."""
    from pixmetry.report.numbers import length_px

    for s in found.sources:
        if s.applied:
            sizes = [f"{axis} up to {length_px(v)} px (u {length_px(w)} px)" for axis, v, w in zip("xy", s.shift_px, s.u_px, strict=True)]
            echo(f"{s.name}: corrected {s.text}; {', '.join(sizes)}", err=err)
        else:
            echo(f"{s.name}: not corrected: {s.text}", err=err)
    if not any(s.applied for s in found.sources):
        echo("nothing was corrected: the description knows nothing that moves points", err=err)
    for name, u in found.state_u_px.items():
        echo(f"{name}: u of the correction up to {length_px(u[0])} px in x, {length_px(u[1])} px in y", err=err)
    x, y = found.common_u_px
    if x or y:
        echo(f"common to all positions: u {length_px(x)} px in x, {length_px(y)} px in y; no number of targets averages it", err=err)
    for note in found.notes:
        echo(f"note: {note}", err=err)
