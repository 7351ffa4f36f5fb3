"""``pixmetry calibrate``: cameras from pictures of a test field, or from a table of image coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._console import echo, echo_lines
from pixmetry.cli._json import JsonResult, json_option
from pixmetry.cli._pdf import check_pdf, pdf_option, put_pdf

KINDS = ("chessboard", "dots", "asymmetric", "coded", "squares", "charuco", "aprilgrid", "lines")
if TYPE_CHECKING:
    from pixmetry.report import Page

EXIT_NOT_CALIBRATED = 1
OPTIONS = ("field", "loss", "folds", "residual_grid", "snoop", "a_priori")


@click.command()
@click.argument("sources", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="PROJECT.yaml|IMAGES…")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=Path("pixmetry-calibration"),
    show_default=True,
    metavar="FOLDER",
    help="Folder for the results.",
)
@click.option("--kind", type=click.Choice(KINDS), help="Kind of test field in the images. Default: chessboard.")
@click.option(
    "--grid",
    metavar="COLSxROWS",
    help="Size of the test field: inner corners of a chessboard, squares of a charuco, dots or tags, such as 9x6.",
)
@click.option("--pitch-mm", type=click.FloatRange(0, min_open=True), help="Spacing of the corners or dots, mm.")
@click.option("--side-mm", type=click.FloatRange(0, min_open=True), help="Side of separate squares, markers or tags, mm.")
@click.option("--dictionary", metavar="NAME", help="Of markers. Default: 5X5_1000 (charuco), APRILTAG_36h11 (aprilgrid), RING_12 (coded).")
@click.option(
    "--diameter-mm",
    type=click.FloatRange(0, min_open=True),
    help="Diameter of the dots, mm. With it the eccentricity of their images is corrected.",
)
@click.option(
    "--polarity",
    type=click.Choice(["auto", "bright", "dark"]),
    help="Whether targets are brighter or darker than their background. Default: auto.",
)
@click.option("--channel", type=click.Choice(["red", "green", "blue"]), help="Channel to use of colour images.")
@click.option("--raw", metavar="WxH:FORMAT", help="Layout of files without a header, e.g. 1920x1200:Mono12p (GenICam's names).")
@click.option(
    "--rig",
    is_flag=True,
    help="The images are of several cameras that stand still against each other: in left01, right01 the number is the instant, the rest "
    "the camera; so with folders cam0/01, cam1/01.",
)
@click.option(
    "--noise", metavar="CAMERA|KEY=NUMBER,…", help="Noise of the images, as in `pixmetry locate`. Default: estimated from each image."
)
@click.option(
    "--camera",
    metavar="PRESET|FILE",
    help="Camera that gives frame size and pixel pitch: the name of a preset, or a camera file. The results get its camera.yaml with the "
    "calibrated lens.",
)
@click.option(
    "--interface",
    type=click.Choice(["digital", "analogue"]),
    help="Whether a frame grabber samples the camera's lines (analogue): patterns in the residuals then have other causes. Default: as the "
    "preset says, else both are named.",
)
@click.option(
    "--pixel-um", type=click.FloatRange(0, min_open=True), help="Pixel pitch, µm. Without it, lengths in the camera are in pixels."
)
@click.option("--c-px", type=click.FloatRange(0, min_open=True), help="Start value of the principal distance, px.")
@click.option("--c-mm", type=click.FloatRange(0, min_open=True), help="Start value of the principal distance, mm.")
@click.option(
    "--direction",
    type=click.Choice(["image_to_object", "object_to_image"]),
    help="Direction of the distortion: corrections to the image (photogrammetry), or distortion of the ideal image (OpenCV). "
    "Default: image_to_object.",
)
@click.option(
    "--projection",
    type=click.Choice(["perspective", "equidistant", "equisolid", "stereographic", "orthographic"]),
    help="What the lens would draw without distortion; a fisheye is most often near equidistant. Default: perspective.",
)
@click.option("--free", metavar="NAMES", help="Parameters to estimate, such as c,xp,yp,k1,k2. Default: c,xp,yp,b1,b2,p1,p2,k1,k2,k3.")
@click.option(
    "--per-image",
    metavar="NAMES",
    help="Parameters to estimate for each image (clock of a frame grabber): x_scale, x_shift, or both. Default: none.",
)
@click.option(
    "--field",
    type=click.Choice(["auto", "fixed", "free"]),
    help="Coordinates of the test field: take them as exact (fixed), estimate them (free), or decide by a test (auto). "
    "Default for images: auto.",
)
@click.option(
    "--loss",
    type=click.Choice(["huber", "cauchy", "none"]),
    help="Robust loss of the first pass, before the search for gross errors. Default: huber.",
)
@click.option(
    "--folds",
    type=click.IntRange(0),
    help="Number of folds for cross-validation: parts of the images that are left out of the fit in turn. 0: none. Default: 5.",
)
@click.option(
    "--residual-grid", is_flag=True, default=None, help="Also estimate a correction grid for residuals that the parameters do not explain."
)
@click.option("--no-snoop", "snoop", is_flag=True, flag_value=False, default=None, help="Do not search for gross errors.")
@click.option(
    "--a-priori",
    is_flag=True,
    default=None,
    help="Take the given uncertainties of image coordinates as true; do not scale them by the residuals.",
)
@click.option("--opencv", type=click.Path(path_type=Path), metavar="FILE", help="Also write the camera for OpenCV: .yaml, .xml or .json.")
@click.option(
    "--export",
    "exports",
    multiple=True,
    metavar="FORMAT=FILE",
    help="Also write the cameras for another program: opencv, colmap, ros (camera_info), kalibr (camchain), mrcal, metashape, matlab, "
    "halcon, australis, photomodeler. May be repeated.",
)
@click.option("--colmap", type=click.Path(path_type=Path), metavar="FILE", help="Also write the cameras for COLMAP: cameras.txt.")
@click.option(
    "--may-lose-px",
    type=click.FloatRange(0),
    default=0.0,
    show_default=True,
    help="Largest error that an export may add anywhere in the frame, px.",
)
@pdf_option()
@json_option("the cameras, their rig and the findings")
@click.option("--threads", type=click.IntRange(1), help="Number of threads. Default: one for each processor.")
def calibrate(
    sources: tuple[Path, ...],
    output: Path,
    opencv: Path | None,
    colmap: Path | None,
    exports: tuple[str, ...],
    may_lose_px: float,
    pdf: Path | None,
    json_file: Path | None,
    threads: int | None,
    **given: Any,
) -> None:
    """Calibrate one camera or several, with the uncertainty of every estimate.

    The argument is a project file (YAML) that names tables of image coordinates or images with targets. Or it is the images themselves
    (files or folders), of a flat test field or of straight lines.

    The folder of results gets report.html, calibration.json, residuals.csv, points.csv and poses.csv (straight lines have no points and no
    poses). An export that a program cannot hold is refused with the reason. The results and the other exports are written even then.

    The exit status is 1 if the image coordinates fit no camera: the results then say why, and are no calibration.

    docs/calibrating.md explains every key of a project file and every message.
    """
    from pixmetry.calibrate.files.exports import check_exports, write_exports
    from pixmetry.calibrate.files.record import LINES_SCHEMA, RESULT_SCHEMA, cameras_text
    from pixmetry.calibrate.job import calibrate as run
    from pixmetry.cli._progress import shown_progress
    from pixmetry.core.threads import set_threads

    set_threads(threads)
    read = (*sources, *((Path(given["camera"]),) if given["camera"] is not None else ()))
    wanted = _wanted(exports, opencv, colmap)
    check_exports(wanted, output, read)
    check_pdf(pdf, read)
    written = JsonResult(json_file, RESULT_SCHEMA, LINES_SCHEMA, inputs=read)
    options = {name: given.pop(name) for name in OPTIONS}
    options = {name: value for name, value in options.items() if value is not None}
    with shown_progress() as progress:
        calibration = run(sources, output, options=options, progress=progress, **given)
    report = output / "report.html"
    written.put_text(cameras_text(calibration, str(report)))
    if not written.printed:
        echo_lines(_summary(calibration, report))
    put_pdf(pdf, lambda: _page_of(calibration))
    if wanted:
        rig = getattr(getattr(calibration, "tests", None), "rig", None)
        made = write_exports(_models(calibration), wanted, may_lose_px, read, rig, _known(calibration))
        for sentence in made.sentences:
            echo(sentence, err=written.printed)
        for path, problem in made.refused[1:]:
            echo(f"{path}: not written: {problem.what}", err=written.printed)
        if made.refused:
            raise made.refused[0][1]
    if any(finding.level == "error" for finding in calibration.findings):
        raise click.exceptions.Exit(EXIT_NOT_CALIBRATED)


def _wanted(exports: tuple[str, ...], opencv: Path | None, colmap: Path | None) -> dict[str, Path]:
    """Files by format."""
    from pixmetry.core.errors import InputError

    found = {name: path for name, path in (("opencv", opencv), ("colmap", colmap)) if path is not None}
    for text in exports:
        name, equals, file = text.partition("=")
        if not equals or not file or name in found:
            what = "a format twice" if name in found else "not an export"
            raise InputError(what, where="--export", value=text, allowed="FORMAT=FILE, such as ros=camera.yaml, each format once")
        found[name] = Path(file)
    return found


def _summary(calibration: Any, report: Path) -> str:
    """The text for the terminal."""
    from pixmetry.calibrate.lines.plumb_line import LineCalibration

    if isinstance(calibration, LineCalibration):
        from pixmetry.calibrate.page.lines_page import summary_text as lines_text

        text = lines_text(calibration)
    else:
        from pixmetry.calibrate.page.text import summary_text

        text = summary_text(calibration)
    return f"{text.rstrip()}\nreport: {report}"


def _page_of(calibration: Any) -> Page:
    from pixmetry.calibrate.lines.plumb_line import LineCalibration
    from pixmetry.calibrate.page import lines_page, page

    return lines_page.page_of(calibration) if isinstance(calibration, LineCalibration) else page.page_of(calibration)


def _known(calibration: Any) -> dict[str, Any]:
    """How well the cameras are known, by their names."""
    from pixmetry.calibrate.exchange import Known
    from pixmetry.calibrate.lines.plumb_line import LineCalibration

    if isinstance(calibration, LineCalibration):
        return {calibration.camera().name: Known(calibration.result.free, calibration.result.estimates.covariance)}
    adjusted = calibration.adjustment
    return {model.name: Known(*adjusted.interior_covariance(k)) for k, model in enumerate(_models(calibration))}


def _models(calibration: Any) -> list[Any]:
    from pixmetry.calibrate.lines.plumb_line import LineCalibration

    if isinstance(calibration, LineCalibration):
        return [calibration.camera()]
    adjusted = calibration.adjustment
    return [adjusted.camera(k) for k in range(len(adjusted.network.cameras))]
