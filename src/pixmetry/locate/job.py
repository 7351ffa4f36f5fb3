"""Locating: from an image to a table of positions with covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.camera.camera import Camera
from pixmetry.core.arguments import choice, number
from pixmetry.core.errors import InputError
from pixmetry.core.threads import checked_threads
from pixmetry.locate.detect.blocks import checked_steps
from pixmetry.locate.detect.coded import RINGS_OF_12, segments_of
from pixmetry.locate.detect.detection import FALSE_ALARMS, THRESHOLD_SIGMA
from pixmetry.locate.detect.limits import Limits
from pixmetry.locate.estimators import estimators, methods
from pixmetry.locate.frame import checked_frame, looks_like_mosaic, scale_ends, unit_of
from pixmetry.locate.kinds import Measured, Task, beside, in_units, locate_blobs, locate_chessboard, locate_lines, locate_spots, wanted_grid
from pixmetry.locate.known_camera import KnownCamera, known_camera, mended
from pixmetry.locate.noise import NoiseModel, noise_model
from pixmetry.locate.quality import quality_of
from pixmetry.locate.records import Located

WORK = {
    "line": locate_lines,
    "edge": locate_lines,
    "cross": locate_lines,
    "chessboard": locate_chessboard,
    "blob": locate_blobs,
}  # of other kinds: spots
PLANES: dict[str | bool, str | bool] = {"auto": "auto", "never": False, "always": True, False: False, True: True}

MOSAIC = (
    "this is the raw frame of a colour camera: neighbouring pixels see different colours, which shifts positions and hides small targets; "
    "to do: convert it to colour and choose --channel green, or locate in the pixels of one colour, frame[0::2, 0::2] or frame[0::2, 1::2]"
)


def locate(
    frame: np.ndarray,
    *,
    kind: str = "disc",
    estimator: str = "auto",
    polarity: str = "auto",
    grid: str | tuple[int, int] | None = None,
    dictionary: str = RINGS_OF_12,
    noise: NoiseModel | Camera | str | Path | None = None,
    with_: KnownCamera | Camera | str | Path | None = None,
    bits: int | None = None,
    aperture_px: float = 1.0,
    light_on: str = "surface",
    planes: str | bool = "auto",
    rois: Sequence[tuple[int, int, int, int]] | None = None,
    mask: np.ndarray | None = None,
    places_px: np.ndarray | None = None,
    diameter_px: tuple[float, float] | None = None,
    contrast_dn: tuple[float, float] | None = None,
    threshold_sigma: float = THRESHOLD_SIGMA,
    false_alarms: float = FALSE_ALARMS,
    jpeg_steps: ArrayLike | None = None,
    threads: int | None = None,
    name: str = "frame",
) -> Located:
    """Find the targets in one frame and measure where they are.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
        Grey values: integers of up to 16 bits, or floats.
    kind : {"disc", "ellipse", "ring", "spot", "blob", "line", "edge", "cross", "chessboard", "coded"}
    estimator : str
        ``"auto"`` or one of `estimators(kind)`.
    polarity : {"auto", "bright", "dark"}
        Of the targets on their ground; ``"auto"`` finds both.
    grid : "COLSxROWS", (cols, rows), "any", "hexagonal" or "asymmetric", optional
        Inner corners of a chessboard; or number the dots of a plate (columns ``grid_col``, ``grid_row``). Of one whose every other row is
        shifted by half a step, also "COLSxROWS:hexagonal" and the like: dot (col, row) lies at (2 col + row % 2) half steps.
    dictionary : str
        Of the codes of coded targets, by the segments of their rings: ``RING_8``, ``RING_12``, ``RING_14``, ``RING_16`` or ``RING_20``.
    noise : NoiseModel, Camera, path, or str, optional
        What weights the fits and fills the covariances: a model, a camera (preset, ``camera.yaml``), or ``"read=…,gain=…,black=…"``
        (see `parse_noise`). By default it is measured in the image.
    with_ : path, Camera or KnownCamera, optional
        In place of ``noise``: results of an assessment of the camera (the folder, or its results.json). Its noise, what its pixels share
        (rows, columns, neighbours) and its offsets are in the covariances, and its defect pixels are left out. A camera has no map of them.
    bits : int, optional
        Bits of a stored value; its greatest value is where the scale saturates. By default told from the image.
    aperture_px : float
        Side of the pixel's light-sensitive square, 0 for point samples.
    light_on : {"surface", "image"}
        Whether light that falls off across a target acts before the lens's blur or after it.
    planes : {"auto", "never", "always"} or bool
        Whether slopes of the light on a target and of the ground about it are unknowns of its template; "auto" takes them where they also
        predict pixels that were held back. True is "always", False "never".
    rois : sequence of (row, col, rows, cols), optional
        Regions in which targets are looked for, first pixel and size; what their borders cut is left out. Nothing outside them is known.
    mask : ndarray of bool, shape (rows, cols), optional
        True where the centres of targets may be.
    places_px : ndarray, shape (n, 2), optional
        x and y of the wanted targets, roughly: within their outlines or 3 px from them. The rows are in their order, and the column
        ``place`` has their numbers.
    diameter_px, contrast_dn : (float, float), optional
        Least and greatest diameter at half height, and height over the background without sign. Like mask and places they choose rows: the
        rows are what they are without.
    threshold_sigma : float
        Threshold of detection in standard deviations of the background's noise.
    false_alarms : float
        Greatest expected number of false faint targets in a frame of noise.
    jpeg_steps : array_like, shape (8, 8), optional
        Steps of the quantiser of the JPEG that the frame was decoded from, blocks from the first pixel on. By default what the pixels tell.
    threads : int, optional
    name : str
        Of the image, for the table.

    Returns
    -------
    Located
        A row a target; empty if there is none. What was seen and has no position is in its ``left_out``, with the reason.

    Raises
    ------
    InputError
        If the frame or an option cannot be used.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry import locate
    >>> y, x = np.indices((40, 50))
    >>> disc = 20 + 150 / (1 + np.exp(4 * (np.hypot(x - 24.3, y - 18.6) - 4)))
    >>> found = locate(np.rint(disc).astype(np.uint8), noise="read=1.5,gain=0.4")
    >>> bool(abs(found.columns["x_px"][0] - 24.3) < 0.02), bool(0 < found.columns["var_x_px2"][0] < 0.02**2)
    (True, True)
    """
    choice(estimator, estimators(kind), "estimator", f"no such estimator for kind {kind}")
    choice(polarity, ("auto", "bright", "dark"), "polarity", "no such polarity")
    choice(light_on, ("surface", "image"), "light_on", "light cannot act there")
    aperture_px = number(aperture_px, "aperture_px", "the pixel's aperture cannot be used", least=0, most=1, allowed="0 to 1 pixel")
    if aperture_px < 1 and estimator in methods() and not methods()[estimator].knows_aperture:
        what = f"the uncertainty of {estimator} is known only for pixels without gaps"
        remedy = "use the template, whose model includes the aperture"
        raise InputError(what, where="aperture_px", value=aperture_px, allowed="1", remedy=remedy)
    if not (isinstance(planes, str | bool) and planes in PLANES):
        raise InputError("no such choice of planes", where="planes", value=planes, allowed="auto, never, always")
    threads = checked_threads(threads)
    if not isinstance(name, str):
        raise InputError("not a name", where="name", value=name, allowed="a text")
    segments = segments_of(dictionary)
    limits = Limits(rois, mask, places_px, diameter_px, contrast_dn, threshold_sigma, false_alarms)
    if limits.given and kind in WORK and kind != "blob":
        allowed = "disc, ellipse, ring, spot, blob, coded"
        raise InputError(f"{limits.given[0]} is not for targets of this kind", where="kind", value=kind, allowed=allowed)
    array = np.asarray(frame)
    unit = unit_of(array)
    image = checked_frame(array if unit == 1 else array / unit, name)
    if with_ is not None and noise is not None:
        raise InputError("both a camera and a noise", where="with_", remedy="leave the noise out")
    if with_ is not None and unit != 1:
        raise InputError("grey values that no camera stores", where=name, remedy="give the frames as they were stored")
    seen_before = None if with_ is None else known_camera(with_)
    if seen_before is not None:
        seen_before.check_bits(image, bits, name)
    defects = None if seen_before is None else seen_before.defects_of(image.shape, name)
    image = image if defects is None else mended(image, defects)
    model = noise_model(noise) if seen_before is None else seen_before.noise
    model = None if model is None else model.times(1 / unit)
    contrast_dn = None if contrast_dn is None else (contrast_dn[0] / unit, contrast_dn[1] / unit)
    limits = replace(limits, contrast_dn=contrast_dn)
    low, high = scale_ends(image, bits, model)
    size = wanted_grid(grid, kind)
    steps = None if jpeg_steps is None else checked_steps(jpeg_steps)
    task = Task(
        image, kind, estimator, polarity, size, model, low, high, aperture_px, light_on, threads, PLANES[planes], limits, unit, seen_before,
        defects, steps, segments,
    )  # fmt: skip
    measured = in_units(Measured(*WORK.get(kind, locate_spots)(task)), unit)
    columns = beside(measured.columns, quality=quality_of(measured.columns))
    about = {"name": name, "rows": image.shape[0], "cols": image.shape[1], "targets": len(measured.columns["x_px"]), **measured.notes}
    if looks_like_mosaic(image):
        about["caution"] = MOSAIC
    if len(measured.left_out):
        about["left_out"] = measured.left_out.sentence()
    return Located(columns, kind, (about,), replace(measured.left_out, image=np.full(len(measured.left_out), name)))
