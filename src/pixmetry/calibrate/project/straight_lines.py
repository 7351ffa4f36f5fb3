"""Positions on straight lines, from a table or from pictures, for a calibration by plumb lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pixmetry.calibrate.bundle.model import CameraModel
from pixmetry.calibrate.project.coordinates import ImageCoordinates, measured
from pixmetry.calibrate.project.schema import PicturesModel
from pixmetry.calibrate.project.tables import Table
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding
from pixmetry.core.progress import Progress, no_progress

LEAST_LENGTH = 0.25  # of the frame's shorter side: what is shorter hardly tells how a line is bent
FAINTEST = 0.05  # height over that of the frame's strongest line: what a coder or a halo draws beside it is none


@dataclass(frozen=True)
class LinePositions:
    """Positions on lines; arrays of shape (n,).

    Parameters
    ----------
    image, line : ndarray of str
        A line is a pair of both.
    x_px, y_px : ndarray
        From the centre of the top-left pixel, y down.
    covariance_px2 : ndarray, shape (n, 3), or None
        var x, cov xy, var y; only their ratios count.
    """

    image: np.ndarray
    line: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray
    covariance_px2: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.x_px)


def lines_of_table(table: Table, camera: CameraModel, given: ImageCoordinates, u_px: float | None) -> LinePositions:
    """Positions from a table with ``image, line, x_px, y_px`` (or ``_mm``, ``_um``).

    Raises
    ------
    InputError
        If a column is missing, or a value cannot be used.
    """
    table = table.spelled("image", "line")
    table.need("image", "line")
    line, image = table.texts("line"), table.texts("image")
    numbered = {**table.columns, "point": [str(row) for row in range(len(table))]}  # every row is a point of its own
    seen = measured(Table(table.source, numbered, table.lines), None, [camera], given, u_px)
    return LinePositions(np.array(image), np.array(line), seen.x_px, seen.y_px, seen.covariance_px2 if seen.covariance_known else None)


def lines_of_pictures(
    wanted: PicturesModel, files: Sequence[Path], progress: Progress | None
) -> tuple[LinePositions, tuple[int, int], tuple[Finding, ...]]:
    """Find straight or slightly bent lines in pictures, and measure where each row (column, of flat lines) crosses them.

    Returns
    -------
    tuple
        Positions, (columns, rows) of the pictures, and what was found on the way. Lines are numbered from 1, flat ones from the top
        before steep ones from the left.

    Raises
    ------
    InputError, MeasureError
        If a picture cannot be read, their sizes differ, or none shows a line.
    """
    from pixmetry.files.formats import frame_name
    from pixmetry.files.images import read_picture
    from pixmetry.files.raw_values import layout_of
    from pixmetry.locate.frame import checked_frame
    from pixmetry.locate.noise import noise_model

    told = progress or no_progress
    noise, layout = noise_model(wanted.noise), layout_of(wanted.raw)
    parts: list[LinePositions] = []
    findings, size = [], None
    for k, file in enumerate(files):
        name = frame_name(file)
        frame = checked_frame(read_picture(file, wanted.channel, layout), name)
        if size is not None and frame.shape != size:
            found, allowed = f"{frame.shape[1]} x {frame.shape[0]} pixels", f"{size[1]} x {size[0]} pixels"
            raise InputError("the pictures differ in size", where=name, value=found, allowed=allowed, remedy="leave it out")
        size = frame.shape
        part = _lines(frame, name, wanted.polarity, noise)
        if len(part):
            parts.append(part)
        else:
            findings.append(Finding("image_left_out", f"{name} was left out: no line is found in it.", level="warning"))
        told("locating lines", k + 1, len(files))
    if not parts or size is None:
        what, remedy = "no line is found in the pictures", "take lines with more contrast, at least a quarter of the frame long"
        raise MeasureError(what, where="pictures", value=len(files), remedy=remedy)
    names = ("image", "line", "x_px", "y_px", "covariance_px2")
    positions = LinePositions(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    return positions, (size[1], size[0]), tuple(findings)


def _lines(frame: np.ndarray, name: str, polarity: str, noise: object) -> LinePositions:
    from pixmetry.locate.lines.line_detection import find_lines
    from pixmetry.locate.lines.lines import line_rows
    from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel

    known = noise if isinstance(noise, NoiseModel) else None
    found = find_lines(frame, polarity=polarity, noise=known, least_length_px=LEAST_LENGTH * min(frame.shape))
    height = np.abs(found.amplitude_dn)
    found = found[height >= FAINTEST * height.max(initial=0.0)]
    flat = np.abs(np.sin(found.angle_rad)) < np.abs(np.cos(found.angle_rad))
    middle = np.where(flat, found.y1_px + found.y2_px, found.x1_px + found.x2_px)
    found = found[np.lexsort((middle, ~flat))]
    if not len(found):
        none, names = np.zeros(0), np.zeros(0, str)
        return LinePositions(names, names, none, none, np.zeros((0, 3)))
    rows = line_rows(frame, found, known or NoiseModel(max(float(np.median(found.sigma_dn)) ** 2, ROUNDING_DN2), origin="image"))
    at = rows.index.astype(float)
    x, y = np.where(rows.by_column, at, rows.position_px), np.where(rows.by_column, rows.position_px, at)
    kept = np.isfinite(x + y) & (rows.var_px2 > 0) & (np.bincount(rows.line, minlength=len(found))[rows.line] >= 3)
    variance = rows.var_px2[kept]
    label = np.array([str(i + 1) for i in range(len(found))])[rows.line[kept]]
    covariance = np.stack([variance, np.zeros(len(variance)), variance], axis=1)
    return LinePositions(np.full(len(label), name), label, x[kept], y[kept], covariance)
