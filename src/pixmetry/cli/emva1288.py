"""``pixmetry emva1288``: the data sheet of a camera by EMVA 1288, what belongs to such a test, and how it is printed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from pixmetry.cli._json import JsonResult, json_option
from pixmetry.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from pixmetry.emva.planning.known_camera import KnownCamera
    from pixmetry.emva.planning.preflight import Preflight
    from pixmetry.emva.records import DataSheet, Results

FILE = click.Path(path_type=Path)
# What each way of calling the command takes beside its arguments.
OPTIONS = {
    "test": {"release", "bayer", "json", "xml", "html", "report", "pdf", "bootstrap", "photons_u", "threads"},
    "compare": {"compare"},
    "plan": {"plan", "bayer", "u_gain", "u_dark_noise", "u_dsnu", "u_prnu", "sweep", "saturation_s", "frame_rate", "manifest", "threads"},
    "preflight": {"preflight", "bayer", "dark", "bright", "bits", "json", "threads"},
}
EXIT_DIFFERENT = 1
PREFLIGHT_SCHEMA = "pixmetry/preflight/1"
WIDTH = 116
WISHES = {"u_gain": ("K", "%"), "u_dark_noise": ("sigma_d", "%"), "u_dsnu": ("DSNU1288", ""), "u_prnu": ("PRNU1288", "%")}


@click.command()
@click.argument("campaigns", nargs=-1, type=FILE)
@click.option(
    "--release",
    type=click.Choice(["4.0", "3.1", "reference"]),
    default="4.0",
    show_default=True,
    help="Release of the standard; 'reference' computes as the public reference implementation does.",
)
@click.option(
    "--bayer",
    type=click.Choice(["RGGB", "BGGR", "GRBG", "GBRG"]),
    help="Colour filter array. Each of its four phases is tested as a camera of its own.",
)
@json_option("the results (or the checks of --preflight)", "json")
@click.option("--xml", type=FILE, metavar="FILE", help="Also write the results in the public EMVA 1288 format.")
@click.option("--html", type=FILE, metavar="FILE", help="Also write the data sheet as a page (HTML).")
@click.option("--report", type=FILE, hidden=True)  # as --html was called until 0.1
@click.option("--pdf", type=FILE, metavar="FILE", help="Also write the data sheet as PDF.")
@click.option(
    "--bootstrap",
    type=click.IntRange(0),
    default=0,
    metavar="DRAWS",
    help="Compute u by a bootstrap over frames and levels, with this number of draws. Default: 0, by propagation of distributions.",
)
@click.option(
    "--photons-u",
    type=click.FloatRange(0, 99),
    default=0.0,
    metavar="PERCENT",
    help="Relative standard uncertainty of the photon counts, in percent. Default: 0.",
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
@click.option(
    "--u-dsnu", type=click.FloatRange(0, min_open=True), metavar="ELECTRONS", help="With --plan: wanted u of the DSNU, in electrons."
)
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
    help="With --plan: what is varied from level to level, the exposure time or the light.",
)
@click.option(
    "--saturation-s", type=click.FloatRange(0, min_open=True), help="With --plan: exposure time that saturates the camera, in seconds."
)
@click.option("--frame-rate", type=click.FloatRange(0, min_open=True), help="With --plan: frames per second.")
@click.option("--manifest", type=FILE, metavar="FILE", help="With --plan: write the manifest of the planned campaign (YAML).")
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
def emva1288(ctx: click.Context, /, campaigns: tuple[Path, ...], **given: Any) -> None:
    """Test a camera by EMVA 1288 and write its data sheet, with uncertainties.

    CAMPAIGNS is an EMVA 1288 descriptor, a manifest (YAML), or a folder that holds one of them. Without CAMPAIGNS the packaged example is
    tested. Three campaigns or more of one camera at different temperatures also give the dark current against temperature; the data sheet
    is that of the first.

    With --plan, CAMPAIGNS is a data sheet (JSON or XML) or a campaign of the camera. With --preflight, the frames are those of a campaign
    or of --dark and --bright.
    """
    from pixmetry.core.threads import set_threads

    mode = _mode(ctx, given)
    if None not in (given["html"], before := given.pop("report")):
        raise InputError("is another name of --html, and both are given", where="--report", remedy="leave it away")
    given["html"] = given["html"] or before
    set_threads(given["threads"])
    if mode == "compare":
        refuse(campaigns, "--compare", "it names its two files itself")
        compare(*given["compare"])
    elif mode == "plan":
        plan(campaigns, given)
    elif mode == "preflight":
        preflight(campaigns, given)
    else:
        test(campaigns, given)


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
        raise InputError(f"has no meaning with {place}", where=name, allowed=f"with {' or '.join(homes)}", remedy="leave it out")
    return modes[0]


def refuse(campaigns: Sequence[Path], option: str, why: str) -> None:
    """Refuse arguments that an option has no use for.

    Raises
    ------
    InputError
        If there are any.
    """
    if campaigns:
        raise InputError(f"takes no campaign: {why}", where=option, value=str(campaigns[0]), remedy="leave it out")


def test(campaigns: Sequence[Path], given: dict[str, Any]) -> None:
    """Test a camera, print the data sheet, and write what was asked for."""
    from pixmetry.cli._progress import shown_progress
    from pixmetry.emva.dark_temperature import dark_current_law
    from pixmetry.emva.job import emva1288

    options = {name: given[name] for name in ("release", "bayer", "bootstrap")} | {"photons_u_rel": given["photons_u"] / 100}
    printed = str(given["json"]) == "-"
    files = {kind: given[kind] for kind in ("json", "xml", "html", "pdf") if not (printed and kind == "json")}
    written = {"report" if kind == "html" else kind: path for kind, path in files.items()}
    _refuse_sheets(campaigns)
    with shown_progress() as progress:
        if len(campaigns) < 2:
            sheet = emva1288(campaigns[0] if campaigns else None, **options, **written, progress=progress)
        else:
            sheet, _ = dark_current_law(campaigns, **options, **written, progress=progress)
    if printed:
        from pixmetry.core.plain_text import json_shown
        from pixmetry.emva.files.json_format import sheet_json

        click.echo(json_shown(sheet_json(sheet).rstrip()))
    console = _console(quiet=printed)
    print_sheet(sheet, console)
    for kind, path in files.items():
        if path is not None:
            console.print(f"{kind}: {path}", markup=False, soft_wrap=True)


def compare(a: Path, b: Path) -> None:
    """Say what differs between two data sheets."""
    from pixmetry.assess.judge.compare import compare as compare_two
    from pixmetry.cli.compare import print_comparison

    result = compare_two(a, b)
    print_comparison(result, _console())
    if not result.same:
        raise SystemExit(EXIT_DIFFERENT)


def plan(campaigns: Sequence[Path], given: dict[str, Any]) -> None:
    """Say which frames to take."""
    from pixmetry.emva.planning.known_camera import first_to_saturate
    from pixmetry.emva.planning.planning import parse_wanted, plan_for, plan_text, write_campaign

    if len(campaigns) > 1:
        raise InputError("plans for one camera", where="--plan", value=len(campaigns), remedy="name one data sheet or campaign")
    wishes = [f"{key}={given[name]}{percent}" for name, (key, percent) in WISHES.items() if given[name] is not None]
    if not wishes:
        remedy = "add --u-gain 0.2, --u-dark-noise 1, --u-dsnu 0.1 or --u-prnu 0.01"
        raise InputError("no uncertainty is wanted", where="--plan", allowed="one or more", remedy=remedy)
    if given["manifest"] is not None:
        _check_manifest(given["manifest"])
    more = {"exposure_sat_s": given["saturation_s"], "frame_rate_hz": given["frame_rate"]}
    more = {name: value for name, value in more.items() if value is not None}
    cameras, facts = _known_cameras(campaigns[0] if campaigns else None, given["bayer"], more)
    channel = first_to_saturate(cameras)
    camera = cameras[channel]
    wanted = parse_wanted(camera, wishes)
    found = plan_for(camera, wanted, sweep=given["sweep"])
    if given["manifest"] is not None:
        write_campaign(camera, found, given["manifest"], **facts)
    console = _console()
    if len(cameras) > 1:
        console.print(f"For the channel that saturates first, {channel}; the others take the same frames.\n", markup=False)
    console.print(plan_text(camera, found, wanted), markup=False, soft_wrap=True, end="")
    if given["manifest"] is not None:
        console.print(f"manifest: {given['manifest']}", markup=False, soft_wrap=True)
    if found.unreachable:
        raise SystemExit(EXIT_DIFFERENT)


def _check_manifest(path: Path) -> None:
    if path.exists():
        raise InputError("exists already", where=f"--manifest {path}", remedy="choose another name")
    if not path.parent.is_dir():
        raise InputError("the folder does not exist", where=f"--manifest {path}", remedy="make it, or choose another")


def _is_sheet(source: Path) -> bool:
    """Whether a file begins as JSON or XML does."""
    if not source.is_file():
        return False
    with source.open("rb") as stream:
        return stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"{", b"<"))


def _refuse_sheets(campaigns: Sequence[Path]) -> None:
    for path in filter(_is_sheet, campaigns):
        remedy = "use it with --plan, --compare or pixmetry compare, or name a campaign"
        raise InputError("is a data sheet, not a campaign", where=str(path), remedy=remedy)


def _known_cameras(source: Path | None, bayer: str | None, more: dict[str, Any]) -> tuple[dict[str, KnownCamera], dict[str, Any]]:
    """Known values of a camera by channel, from a data sheet or from a few frames of a campaign; and its name and colour filter."""
    from pixmetry.emva.planning.planning import camera_from_sheet
    from pixmetry.emva.planning.preflight import camera_from_preflight, preflight_campaign
    from pixmetry.files import load_campaign

    if source is not None and _is_sheet(source):
        from pixmetry.emva.files.sheets import read_sheet

        if bayer is not None:
            raise InputError("has no meaning with a data sheet, which states its channels", where="--bayer", remedy="leave it out")
        sheet = read_sheet(source)
        if not sheet.results:
            raise InputError("the data sheet holds no results", where=str(source), remedy="make it again")
        facts = {"name": str(sheet.camera.get("name", "camera")), "cfa": sheet.camera.get("cfa")}
        return {r.channel: camera_from_sheet(sheet, r.channel, **more) for r in sheet.results}, facts
    campaign = load_campaign(source)
    looks = preflight_campaign(campaign, bayer)
    facts = {"name": campaign.camera.name, "cfa": bayer or campaign.camera.cfa}
    return {channel: camera_from_preflight(found, **more) for channel, found in looks.items()}, facts


def preflight(campaigns: Sequence[Path], given: dict[str, Any]) -> None:
    """Check a few frames."""
    from pixmetry.emva.planning.preflight import preflight_record, preflight_text

    _refuse_sheets(campaigns)
    written = JsonResult(given["json"], PREFLIGHT_SCHEMA)
    found, written.inputs = _looked_at(campaigns, given)
    console = _console(quiet=written.printed)
    for channel, result in found.items():
        if len(found) > 1:
            console.print(f"Channel {channel}", markup=False)
        console.print(preflight_text(result), markup=False, soft_wrap=True, end="" if len(found) == 1 else "\n")
    written.put({"channels": {channel: preflight_record(result) for channel, result in found.items()}})
    if any(result.verdict == "fail" for result in found.values()):
        raise SystemExit(EXIT_DIFFERENT)


def _looked_at(campaigns: Sequence[Path], given: dict[str, Any]) -> tuple[dict[str, Preflight], Sequence[Path]]:
    """What the preflight finds, by channel, and the files that it may read."""
    from pixmetry.emva.planning.preflight import preflight_campaign
    from pixmetry.files import load_campaign

    if given["dark"] or given["bright"]:
        refuse(campaigns, "--dark and --bright", "they are the frames")
        for name in ("dark", "bright", "bits"):
            if not given[name]:
                raise InputError("is missing", where=f"--{name}", remedy="give --dark, --bright and --bits, or a campaign")
        return _look_at_files(given["dark"], given["bright"], given["bits"], given["bayer"]), (*given["dark"], *given["bright"])
    if given["bits"]:
        raise InputError("has no meaning with a campaign, which states its bits", where="--bits", remedy="leave it out")
    if len(campaigns) > 1:
        raise InputError("looks at one campaign", where="--preflight", value=len(campaigns), remedy="name one")
    campaign = load_campaign(campaigns[0] if campaigns else None)
    return preflight_campaign(campaign, given["bayer"]), campaign.files


def _look_at_files(dark: Sequence[Path], bright: Sequence[Path], bits: int, bayer: str | None) -> dict[str, Preflight]:
    from pixmetry.emva.planning.preflight import preflight_frames
    from pixmetry.files.images import iter_frames, picture_files

    def reading(paths: Sequence[Path]) -> Callable[[], Iterator[np.ndarray]]:
        files = picture_files(paths)
        return lambda: iter_frames(files, bits=bits)

    single = [path for path in bright if not path.is_dir()]
    levels = [[path] for path in bright if path.is_dir()] + ([single] if single else [])
    return preflight_frames(reading(dark), [reading(level) for level in levels], bits, bayer)


def print_sheet(sheet: DataSheet, console: Console) -> None:
    """Print all values of a data sheet, section by section."""
    from pixmetry.emva.page import content
    from pixmetry.report.numbers import NO_BREAK

    camera = sheet.camera
    size = f"{camera['cols']} x {camera['rows']} pixels, {camera['bits']} bits"
    release = content.release_title(sheet.results[0].release)
    console.print(f"\n{camera['name']}: {size}, EMVA 1288 {release}\n", markup=False, soft_wrap=True)
    for line in content.document_lines(sheet.results):
        console.print(line.replace(NO_BREAK, " ") + "\n", markup=False, soft_wrap=True)
    for results in sheet.results:
        if len(sheet.results) > 1:
            console.print(f"Channel {results.channel}\n", markup=False)
        _print_values(results, content.methods_of(sheet), console)
    for note in content.notes_of(sheet):
        console.print(f"Note: {note}", markup=False, soft_wrap=True)


def _print_values(results: Results, methods: list[str], console: Console) -> None:
    from rich.table import Table
    from rich.text import Text

    from pixmetry.emva.files.keys import NONLINEAR
    from pixmetry.emva.page import content

    reasons: dict[str, int] = {}
    for title, rows in content.all_rows(results, methods).items():
        table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
        beside = any(row.nonlinear for row in rows)
        for name in ("key", "", "value", "± u", "unit", *(["non-linearity in account"] if beside else [])):
            numeric = name in ("value", "± u")
            table.add_column(name, justify="right" if numeric else "left", no_wrap=True)
        for row in rows:
            value, curved = results.values[row.key], results.values.get(row.key + NONLINEAR)
            symbol = "_".join(part for part in row.symbol if part)
            u = "" if row.key.startswith("index_") else row.number.u.removeprefix("± ")
            other = row.nonlinear + (_mark(curved.reason, reasons) if curved else "")
            cells = (row.key, symbol, row.number.value + _mark(value.reason, reasons), u, row.number.unit, other)
            table.add_row(*map(Text, cells[: 5 + beside]))
        console.print(table)
        console.print()
    for reason, mark_number in reasons.items():
        console.print(f"[{mark_number}] {reason}", markup=False, soft_wrap=True)


def _mark(reason: str, reasons: dict[str, int]) -> str:
    """The mark of a footnote; a new reason gets the next number."""
    return f" [{reasons.setdefault(reason, len(reasons) + 1)}]" if reason else ""


def _console(quiet: bool = False) -> Console:
    from pixmetry.cli._console import console

    return console(width=WIDTH, quiet=quiet)
