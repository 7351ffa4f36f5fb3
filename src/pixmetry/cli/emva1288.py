"""``pixmetry emva1288``: the data sheet of a camera by EMVA 1288, and what belongs to such a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

FILE = click.Path(path_type=Path)
# What each way of calling the command takes beside its arguments.
OPTIONS = {
    "test": {"release", "bayer", "json", "xml", "report", "pdf", "bootstrap", "photons_u", "threads"},
    "compare": {"compare"},
    "plan": {"plan", "bayer", "u_gain", "u_dark_noise", "u_dsnu", "u_prnu", "sweep", "saturation_s", "frame_rate", "manifest", "threads"},
    "preflight": {"preflight", "bayer", "dark", "bright", "bits", "json", "threads"},
}


@click.command()
@click.argument("campaigns", nargs=-1, type=FILE)
@click.option(
    "--release",
    type=click.Choice(["4.0", "3.1", "reference"]),
    default="4.0",
    show_default=True,
    help="Release of the standard; 'reference' computes as the public implementation does.",
)
@click.option(
    "--bayer",
    type=click.Choice(["RGGB", "BGGR", "GRBG", "GBRG"]),
    help="Colour filter array. Each of its four phases is tested as a camera of its own.",
)
@click.option("--json", type=FILE, help="Write the results (or the checks of --preflight) as JSON.")
@click.option("--xml", type=FILE, help="Write the results in the public EMVA 1288 format.")
@click.option("--report", type=FILE, help="Write the data sheet as a page (HTML).")
@click.option("--pdf", type=FILE, help="Write the data sheet as PDF.")
@click.option(
    "--bootstrap",
    type=click.IntRange(0),
    default=0,
    metavar="DRAWS",
    help="Compute u by a bootstrap over frames and levels, with so many draws.",
)
@click.option(
    "--photons-u", type=click.FloatRange(0, 99), default=0.0, metavar="PERCENT", help="Relative standard uncertainty of the photon counts."
)
@click.option("--compare", nargs=2, type=FILE, metavar="A B", help="Compare two data sheets (XML or JSON); differences are in units of u.")
@click.option("--plan", is_flag=True, help="Plan a test: which frames to take for the wanted uncertainties.")
@click.option(
    "--u-gain",
    type=click.FloatRange(0, min_open=True),
    metavar="PERCENT",
    help="With --plan: wanted u of the gain, in percent of the gain.",
)
@click.option(
    "--u-dark-noise",
    type=click.FloatRange(0, min_open=True),
    metavar="PERCENT",
    help="With --plan: wanted u of the dark noise, in percent of the dark noise.",
)
@click.option("--u-dsnu", type=click.FloatRange(0, min_open=True), metavar="E", help="With --plan: wanted u of the DSNU, in electrons.")
@click.option(
    "--u-prnu",
    type=click.FloatRange(0, min_open=True),
    metavar="PERCENT",
    help="With --plan: wanted u of the PRNU, in percent of the signal.",
)
@click.option(
    "--sweep",
    type=click.Choice(["exposure", "light"]),
    default="exposure",
    show_default=True,
    help="With --plan: vary the exposure time or the light.",
)
@click.option(
    "--saturation-s", type=click.FloatRange(0, min_open=True), help="With --plan: exposure time that saturates the camera, in seconds."
)
@click.option("--frame-rate", type=click.FloatRange(0, min_open=True), help="With --plan: frames per second.")
@click.option("--manifest", type=FILE, help="With --plan: write the manifest of the planned campaign (YAML).")
@click.option("--preflight", is_flag=True, help="Check a few frames before you take a long series.")
@click.option("--dark", multiple=True, type=FILE, help="With --preflight: dark frames, a file or a folder. May be repeated.")
@click.option(
    "--bright",
    multiple=True,
    type=FILE,
    help="With --preflight: bright frames. Each folder is one light level; all single files together are one. May be repeated.",
)
@click.option("--bits", type=click.IntRange(1, 16), help="With --dark and --bright: bits of a stored value.")
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
@click.pass_context
def emva1288(ctx: click.Context, campaigns: tuple[Path, ...], **given: Any) -> None:
    """Test a camera by EMVA 1288 and write its data sheet, with uncertainties.

    CAMPAIGNS is an EMVA 1288 descriptor, a manifest (YAML), or a folder that holds one of them. Without CAMPAIGNS the packaged example is
    tested. Three campaigns or more of one camera at different temperatures also give the dark current against temperature; the data sheet
    is that of the first.

    With --plan, CAMPAIGNS is a data sheet (JSON or XML) or a campaign of the camera. With --preflight, the frames are those of a campaign
    or of --dark and --bright.
    """
    from pixmetry.cli import _emva
    from pixmetry.core.threads import set_threads

    mode = _mode(ctx, given)
    set_threads(given["threads"])
    if mode == "compare":
        _emva.refuse(campaigns, "--compare", "it names its two files itself")
        _emva.compare(*given["compare"])
    elif mode == "plan":
        _emva.plan(campaigns, given)
    elif mode == "preflight":
        _emva.preflight(campaigns, given)
    else:
        _emva.test(campaigns, given)


def _mode(ctx: click.Context, given: dict[str, Any]) -> str:
    """The way of calling; options that do not belong together are refused."""
    from pixmetry.core.errors import InputError

    set_here = {name for name in given if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT}
    modes: list[str] = [mode for mode in ("compare", "plan", "preflight") if mode in set_here] or ["test"]
    if len(modes) > 1:
        raise InputError("options that do not go together", value=" ".join(f"--{mode}" for mode in modes), remedy="give one of them")
    foreign = sorted(set_here - OPTIONS[modes[0]])
    if foreign:
        name = "--" + foreign[0].replace("_", "-")
        homes = [f"--{mode}" if mode != "test" else "a test" for mode, own in OPTIONS.items() if foreign[0] in own]
        place = "a test" if modes[0] == "test" else f"--{modes[0]}"
        raise InputError(f"has no meaning with {place}", where=name, allowed=f"with {' or '.join(homes)}", remedy="leave it away")
    return modes[0]
