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
@click.option("--release", type=click.Choice(["4.0", "3.1", "reference"]), default="4.0", show_default=True, help="Of the standard.")
@click.option("--bayer", type=click.Choice(["RGGB", "BGGR", "GRBG", "GBRG"]), help="Colour filter; each phase is tested by itself.")
@click.option("--json", type=FILE, help="Write the results (or the checks of --preflight) for programs.")
@click.option("--xml", type=FILE, help="Write the results in the public EMVA 1288 format.")
@click.option("--report", type=FILE, help="Write the data sheet as a page (HTML).")
@click.option("--pdf", type=FILE, help="Write the data sheet as PDF.")
@click.option("--bootstrap", type=click.IntRange(0), default=0, metavar="DRAWS", help="Take u from a bootstrap over frames and levels.")
@click.option("--photons-u", type=click.FloatRange(0, 99), default=0.0, metavar="PERCENT", help="Standard u of the photon counts.")
@click.option("--compare", nargs=2, type=FILE, metavar="A B", help="Say what differs between two data sheets (XML or JSON), in u.")
@click.option("--plan", is_flag=True, help="Say which frames to take for the wanted u.")
@click.option("--u-gain", type=click.FloatRange(0, min_open=True), metavar="PERCENT", help="Wanted u of the gain, in percent of it.")
@click.option("--u-dark-noise", type=click.FloatRange(0, min_open=True), metavar="PERCENT", help="Wanted u of the dark noise, of it.")
@click.option("--u-dsnu", type=click.FloatRange(0, min_open=True), metavar="E", help="Wanted u of the DSNU, in electrons.")
@click.option("--u-prnu", type=click.FloatRange(0, min_open=True), metavar="PERCENT", help="Wanted u of the PRNU, in % of the signal.")
@click.option("--sweep", type=click.Choice(["exposure", "light"]), default="exposure", show_default=True, help="What the plan varies.")
@click.option("--saturation-s", type=click.FloatRange(0, min_open=True), help="Exposure time that saturates the camera, for the plan.")
@click.option("--frame-rate", type=click.FloatRange(0, min_open=True), help="Frames per second, for the plan.")
@click.option("--manifest", type=FILE, help="Write the manifest of the planned campaign (YAML).")
@click.option("--preflight", is_flag=True, help="Check a few frames before a long series.")
@click.option("--dark", multiple=True, type=FILE, help="Frames for the preflight: a file or folder; may be given several times.")
@click.option("--bright", multiple=True, type=FILE, help="The same, lit; each folder is a level, all single files together are one.")
@click.option("--bits", type=click.IntRange(1, 16), help="Bits of a stored value of these frames.")
@click.option("--threads", type=click.IntRange(1), help="Default: all processors.")
@click.pass_context
def emva1288(ctx: click.Context, campaigns: tuple[Path, ...], **given: Any) -> None:
    """Test a camera by EMVA 1288 and give every value with its uncertainty.

    CAMPAIGNS is an EMVA 1288 descriptor, a manifest (YAML), or a folder that holds one of them; without it, the packaged example is
    tested. Of several campaigns of one camera, at three temperatures or more, the first gives the data sheet, and all of them the law
    of the dark current against temperature. For --plan, a data sheet (JSON or XML) or a campaign tells what is known of the camera; a
    campaign, or --dark and --bright, gives the frames for --preflight.
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
