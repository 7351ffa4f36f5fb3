"""``pixmetry bound``: what is possible for a target, what estimators give, and what limits them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._json import JsonResult, json_option

KINDS = ("disc", "ellipse", "ring", "spot", "line", "edge")
SIZES = {
    "radius": "radius_px",
    "inner_radius": "inner_radius_px",
    "semi_major": "semi_major_px",
    "semi_minor": "semi_minor_px",
    "angle": "angle_deg",
    "width": "width_px",
    "length": "length_px",
}


@click.command()
@click.option("--kind", type=click.Choice(KINDS), default="disc", show_default=True, help="Kind of target.")
@click.option("--radius", type=float, help="Radius of a disc, or outer radius of a ring, px.")
@click.option("--inner-radius", type=float, help="Inner radius of a ring, px.")
@click.option("--semi-major", type=float, help="Semi-major axis of an ellipse, px.")
@click.option("--semi-minor", type=float, help="Semi-minor axis of an ellipse, px.")
@click.option("--angle", type=float, help="Direction of an ellipse's major axis, of a line or of an edge, degrees from x towards y.")
@click.option("--width", type=float, help="Width of a line, px. Default: a thin line, as wide as its blur.")
@click.option("--length", type=float, help="Length of a line or edge, px.")
@click.option(
    "--blur", type=float, required=True, help="Blur of the edge or spot, without the pixel: standard deviation of a Gaussian, px."
)
@click.option("--amplitude", type=float, required=True, help="Height of the target above the background, DN. Negative for a dark target.")
@click.option("--background", type=float, default=0.0, show_default=True, help="Background above the camera's black level, DN.")
@click.option(
    "--noise",
    metavar="KEY=NUMBER,…",
    help="Noise in DN, such as read=1.5,gain=0.01,bits=8. Keys: read, gain, prnu, dsnu, black, bits. Default: read=1.5.",
)
@click.option(
    "--camera", metavar="PRESET|FILE", help="Camera that gives noise, bits, pitch and aperture: the name of a preset, or a camera file."
)
@click.option("--no-rounding", is_flag=True, help="Compute for grey values that are not rounded to whole numbers.")
@click.option(
    "--unknowns",
    default="shape",
    show_default=True,
    metavar="SET|NAMES",
    help="What is unknown: position (nothing else), light (also amplitude and background), shape (also outline and blur), planes (also "
    "slopes of background and light), or names of parameters.",
)
@click.option(
    "--estimator",
    default="template",
    show_default=True,
    metavar="NAME",
    help="Estimator whose causes of error are listed. An unknown name lists all.",
)
@click.option("--frames", type=click.IntRange(1), default=1, show_default=True, help="Number of frames that are averaged.")
@click.option("--aperture", type=float, help="Side of the pixel's light-sensitive square, px. Default: the camera's, or 1.")
@click.option(
    "--window", type=int, help="Side of the window around the target, px, an odd number. Default: large enough for the whole target."
)
@click.option("--phases", type=int, default=5, show_default=True, help="Number of sub-pixel positions in x and in y that are averaged.")
@click.option(
    "--light-on",
    type=click.Choice(["surface", "image"]),
    default="surface",
    show_default=True,
    help="Where light that falls off across a target acts: on the surface before the blur, or on the image after it.",
)
@json_option("the results")
def bound(
    kind: str,
    blur: float,
    amplitude: float,
    background: float,
    noise: str | None,
    camera: str | None,
    no_rounding: bool,
    unknowns: str,
    estimator: str,
    frames: int,
    aperture: float | None,
    window: int | None,
    phases: int,
    light_on: str,
    json_file: Path | None,
    **sizes: float | None,
) -> None:
    """Compute how well a target can be located (Cramér–Rao bound), and what limits it.

    Uncertainties are standard deviations of one coordinate in pixels, averaged over sub-pixel positions. They are also in µm if the camera
    states its pixel pitch.

    Example: pixmetry bound --radius 3.5 --blur 0.7 --amplitude 150 --background 10 --camera imx264_like
    """
    from pixmetry.core.errors import InputError
    from pixmetry.locate.bound.bound import bound as bound_of_target

    written = JsonResult(json_file, "pixmetry/bound/1", inputs=[Path(camera)] if camera else [])
    if noise and camera:
        raise InputError("the noise is given twice", where="--noise, --camera", remedy="give one of them")
    model, settings, about = _of_camera(camera, no_rounding) if camera else _of_text(noise or "read=1.5", no_rounding)
    given = {SIZES[name]: value for name, value in sizes.items() if value is not None}
    parameters = given | {"blur_px": blur, "amplitude_dn": amplitude, "background_dn": model.black_dn + background}
    settings["aperture_px"] = settings["aperture_px"] if aperture is None else aperture
    result = bound_of_target(
        kind,
        parameters,
        model,
        unknowns,
        estimator=estimator,
        frames=frames,
        window_px=window,
        phases=phases,
        light_on=light_on,
        rounded=not no_rounding,
        aperture_px=settings["aperture_px"],
        pattern_dn=settings["pattern_dn"],
    )
    written.put(result.to_record() | {"aperture_px": settings["aperture_px"]} | about)
    if not written.printed:
        _show(result, about)


def _of_text(text: str, no_rounding: bool) -> tuple[Any, dict[str, float], dict[str, Any]]:
    """Noise model, settings and facts from ``key=number,…``."""
    from pixmetry.locate.noise import parse_noise

    model, pattern = parse_noise(text, not no_rounding)
    return model, {"aperture_px": 1.0, "pattern_dn": pattern}, {"camera": None, "pitch_um": None}


def _of_camera(name: str, no_rounding: bool) -> tuple[Any, dict[str, float], dict[str, Any]]:
    """The same from a camera file or preset."""
    from dataclasses import replace

    from pixmetry.camera.camera import load_camera
    from pixmetry.locate.noise import ROUNDING_DN2, camera_noise

    camera = load_camera(name)
    read = camera_noise(camera)
    model = replace(read.model, constant_dn2=max(read.model.constant_dn2 - ROUNDING_DN2, 0.0)) if no_rounding else read.model
    return model, {"aperture_px": read.aperture_px, "pattern_dn": read.pattern_dn}, {"camera": camera.name, "pitch_um": read.pitch_um}


def _show(result: Any, about: dict[str, Any]) -> None:
    from rich.table import Table

    console = plain_console()
    size = ", ".join(f"{n.removesuffix('_px')} {v:g}" for n, v in result.parameters.items() if v and n.endswith("_px") and "per" not in n)
    console.print(
        f"{result.kind} of {size} px, {result.parameters['amplitude_dn']:g} grey values over {result.parameters['background_dn']:.4g}; "
        f"{result.frames} frame{'s' if result.frames > 1 else ''}, window {result.window_px} px",
        soft_wrap=True,
    )
    console.print(f"noise: {result.noise}\n", markup=False, soft_wrap=True)
    micro = _micrometres(about["pitch_um"])

    table = Table(title="What is possible (Cramér–Rao bound of one coordinate)", title_justify="left", box=None, pad_edge=False)
    for column in ("unknown", "px", "px by phase", *(["µm"] if micro else [])):
        table.add_column(column, no_wrap=column != "unknown")
    for name, b in result.bounds.items():
        label = {"asked": f"asked: {', '.join(b.unknowns)}", "position": "position alone"}.get(name, f"… {name} too")
        least, mean, greatest = b.place_px
        table.add_row(label, f"{mean:.3g}", f"{least:.3g} … {greatest:.3g}", *([micro(mean)] if micro else []))
    for name, value in result.closed_forms_px.items():
        table.add_row(f"closed form: {name}", f"{value:.3g}", "", *([micro(value)] if micro else []))
    console.print(table, "")

    table = Table(title="What estimators give", title_justify="left", box=None, pad_edge=False)
    for column in ("estimator", "px", "noise", "S-curve", "× bound", *(["µm"] if micro else []), "with"):
        table.add_column(column, no_wrap=column != "with")
    for p in result.predictions:
        row = [p.name, f"{p.u_px:.3g}", f"{p.noise_px:.3g}", f"{p.s_curve_px:.1g}", f"{p.u_px / result.u_px:.2f}"]
        table.add_row(*row, *([micro(p.u_px)] if micro else []), p.detail)
    console.print(table, "")

    console.print(f"What limits {result.chosen.name} (shares of its variance)")
    for limit in result.limits:
        if limit.share < 5e-4:
            continue
        console.print(f"  {limit.share:6.1%}  {limit.cause}")
    console.print("")
    for text in (*result.advice, *result.statements):
        console.print(f"· {text}", soft_wrap=True)


def _micrometres(pitch_um: tuple[float, float] | None) -> Any:
    """How to write pixels in µm, or in nm where that is less; None without a pitch."""
    if pitch_um is None:
        return None
    pitch = (0.5 * (pitch_um[0] ** 2 + pitch_um[1] ** 2)) ** 0.5
    return lambda px: f"{px * pitch:.3g} µm" if px * pitch >= 0.1 else f"{1000 * px * pitch:.3g} nm"
