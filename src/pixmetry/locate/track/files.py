"""Frames of a sequence in, a table of positions out: read, measured and written one after the other."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.core.errors import InputError
from pixmetry.core.plain_text import cell, comment
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles
from pixmetry.files.formats import PICTURE_ENDINGS, frame_name
from pixmetry.files.images import load_picture, picture_files
from pixmetry.files.output import Output, check_files, streamed_file
from pixmetry.files.raw_values import RawLayout, layout_of
from pixmetry.files.strict_json import json_text
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.files import frames_inside
from pixmetry.locate.frame import looks_like_mosaic
from pixmetry.locate.job import MOSAIC
from pixmetry.locate.noise import NoiseModel, noise_model
from pixmetry.locate.records import ORIGIN
from pixmetry.locate.track.statistics import TrackStatistics, disagreements
from pixmetry.locate.track.tracker import Tracked, Tracker

TABLE_SCHEMA, STATISTICS_SCHEMA = "pixmetry/tracked/1", "pixmetry/track-statistics/1"
TABLE_MARK = re.compile(rb"# pixmetry pixmetry/tracked/")
STATISTICS_MARK = re.compile(rb'\s*\{\s*"schema": "pixmetry/track-statistics/')
COLUMNS = ("image", "time", "target", "x_px", "y_px", "var_x_px2", "cov_xy_px2", "var_y_px2", "flags")


@dataclass(frozen=True)
class TrackedFiles:
    """What was found in the frames of a sequence.

    Parameters
    ----------
    frames : int
        How many there were.
    targets : int
    lost : int
        Positions that were not found, of frames times targets.
    estimator, noise : str
        Estimator, and noise model in words.
    statistics : TrackStatistics
    told : tuple of str
        In sentences: what is wrong with the frames, and targets whose scatter and stated uncertainty disagree.
    """

    frames: int
    targets: int
    lost: int
    estimator: str
    noise: str
    statistics: TrackStatistics
    told: tuple[str, ...]

    def summary(self) -> list[str]:
        """The result in a few lines."""
        s = self.statistics
        lines = [f"{self.targets} targets in {self.frames} frames, {self.lost} of {self.targets * self.frames} positions not found"]
        lines.append(f"estimator {self.estimator}; noise: {self.noise}")
        if np.isfinite(s.repeat_x_px).any():
            repeat, stated = (_typical(getattr(s, f"{n}_x_px"), getattr(s, f"{n}_y_px")) for n in ("repeat", "stated"))
            lines.append(f"repeatability: median {repeat:.2g} px; stated uncertainty: median {stated:.2g} px")
            if np.isfinite(s.common_x_px):
                lines.append(f"common to all targets from frame to frame: {s.common_x_px:.2g} px in x, {s.common_y_px:.2g} px in y")
        return [*lines, *self.told]

    def to_record(self) -> dict[str, Any]:
        """Plain record of the JSON file."""
        head = {name: getattr(self, name) for name in ("frames", "targets", "lost", "estimator", "noise")}
        return {"schema": STATISTICS_SCHEMA, **head, "told": list(self.told), **self.statistics.to_record()}


def track_files(
    images: Sequence[str | Path],
    output: str | Path | None = None,
    *,
    statistics: str | Path | None = None,
    interval_s: float | None = None,
    channel: str | None = None,
    raw: str | RawLayout | None = None,
    progress: Progress | None = None,
    noise: NoiseModel | Camera | str | Path | None = None,
    threads: int | None = None,
    **options: Any,
) -> TrackedFiles:
    """Follow the targets of the first frame of a sequence through all others.

    Parameters
    ----------
    images : sequence of path
        Image files and folders of them, in the order of their names; a file with several frames is as many images.
    output : path, optional
        CSV file, written frame by frame: a row for each target that was found.
    statistics : path, optional
        JSON file: what `Tracker.statistics` says, by target.
    interval_s : float, optional
        Time from frame to frame; without it the time is the number of the frame.
    channel, raw
        As of `locate_files`.
    progress : callable (what, done, of), optional
    noise, threads, **options
        As of `Tracker`.

    Raises
    ------
    InputError, MeasureError
        If a file or an option cannot be used, or the first frame shows no target; nothing is written then.
    """
    if interval_s is not None and not 0 < interval_s < np.inf:
        raise InputError("not an interval", where="interval_s", value=interval_s, allowed="above 0 s")
    layout, report = layout_of(raw), progress or no_progress
    files = picture_files([frames_inside(path) for path in images], PICTURE_ENDINGS, layout)
    table = None if output is None else Output(_with_ending(output, ".csv"), TABLE_MARK, True)
    record = None if statistics is None else Output(_with_ending(statistics, ".json"), STATISTICS_MARK, True)
    written = [one for one in (table, record) if one is not None]
    check_files(written, files)
    frames: Iterator[np.ndarray] = imap_tiles(lambda path: load_picture(path, channel, layout).array, files, threads)
    every = 1.0 if interval_s is None else interval_s
    with ExitStack() as stack:
        out, note = (None if one is None else stack.enter_context(streamed_file(one, files)) for one in (table, record))
        lost = 0
        for k, frame in enumerate(frames):
            try:
                if k == 0:
                    tracker = Tracker(frame, noise=noise_model(noise), time=0.0, threads=threads, **options)
                    found = tracker.latest
                    caution = (MOSAIC,) if looks_like_mosaic(frame) else ()
                    if out is not None:
                        out.write(_head(tracker, "second" if interval_s else "frame").encode())
                else:
                    found = tracker.update(frame, k * every)
            except InputError as problem:
                raise InputError(
                    problem.what, where=str(files[k]), value=problem.value, allowed=problem.allowed, remedy=problem.remedy
                ) from None
            lost += int(np.count_nonzero(~found.found))
            if out is not None:
                out.write(_rows(frame_name(files[k]), found))
            report("tracking", k + 1, len(files))
        result = tracker.statistics()
        told = (*caution, *disagreements(result, tracker.noise.origin))
        whole = TrackedFiles(len(files), len(tracker), lost, tracker.estimator, tracker.noise.describe(), result, told)
        if note is not None:
            note.write(json_text(whole.to_record()).encode())
    return whole


def _typical(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.nanmedian(np.sqrt(0.5 * (x**2 + y**2))))


def _with_ending(path: str | Path, ending: str) -> Path:
    if Path(path).suffix.lower() != ending:
        raise InputError("unknown ending", where=str(path), value=Path(path).suffix, allowed=ending)
    return Path(path)


def _head(tracker: Tracker, unit: str) -> str:
    lines = (
        f"pixmetry {TABLE_SCHEMA}; origin: {ORIGIN}",
        f"targets: {len(tracker)}; estimator: {tracker.estimator}; noise_model: {tracker.noise.describe()}; unit of time: {unit}",
    )
    return "".join(f"# {comment(line)}\n" for line in lines) + ",".join(COLUMNS) + "\n"


def _rows(name: str, found: Tracked) -> bytes:
    """The rows of the targets that were found, ten digits a number."""
    there = np.flatnonzero(found.found)
    words = {flag: Flag(flag).words() for flag in np.unique(found.flags[there]).tolist()}
    columns = [getattr(found, column)[there].tolist() for column in COLUMNS[3:8]]
    flags = [words[flag] for flag in found.flags[there].tolist()]
    row = f"{_quoted(cell(name))},{found.time:.10g}".replace("%", "%%") + ",%d,%.10g,%.10g,%.6g,%.6g,%.6g,%s\n"
    cells = [value for line in zip(there.tolist(), *columns, flags, strict=True) for value in line]
    return (row * len(there) % tuple(cells)).encode()


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text
