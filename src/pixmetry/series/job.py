"""A series of frames of a fixed field, from image files to the warm-up of the camera that took them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.camera.motion_series import MotionSeries
from pixmetry.camera.recordings import Recordings
from pixmetry.core.arguments import typed
from pixmetry.core.arrays import Array
from pixmetry.core.config import read_text
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.progress import Progress, no_progress
from pixmetry.core.threads import imap_tiles, single_threaded_blas
from pixmetry.files.formats import PICTURE_ENDINGS, frame_name
from pixmetry.files.images import load_picture, picture_files
from pixmetry.files.output import check_output, staged_output
from pixmetry.files.provenance import provenance_record
from pixmetry.files.raw_values import RawLayout, layout_of
from pixmetry.files.results import write_record
from pixmetry.locate.files import frames_inside
from pixmetry.locate.noise import noise_model
from pixmetry.series.blur import Cut
from pixmetry.series.log import SeriesLog
from pixmetry.series.modes import LEAST_TARGETS, field_motion
from pixmetry.series.motion import Run, find_in_fields, motion_of
from pixmetry.series.recording import recordings_of
from pixmetry.series.records import Series
from pixmetry.series.texture import texture_of
from pixmetry.series.thermal import thermal_of
from pixmetry.series.track import FrameTargets, blur_of, find_targets, follow_targets, near_pairs
from pixmetry.series.warm_up import drift_of

KIND = "series"
MOST_RECORDED = 40  # frames in memory
RECORDED_SIDE, BLOCK_PX = 1024, 16  # of the part of larger frames that tells of a coder; of its blocks, which must not be cut
TEXTURE = "texture"
Fetch = Callable[[], np.ndarray]


@typed
def series(
    frames: str | Path | Sequence[str | Path],
    output: str | Path | None = None,
    *,
    interval_s: float | None = None,
    times: str | Path | None = None,
    on_for_s: float = 0.0,
    interface: str = "digital",
    pixel_clock_mhz: float | None = None,
    tolerance_px: float = 0.05,
    channel: str | None = None,
    raw: str | RawLayout | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Series:
    """Measure how the image moves over a series of frames of a fixed field of targets, or of any texture, as while a camera warms up.

    Parameters
    ----------
    frames : path, or sequence of path
        Image files and folders of them, in the order of their names.
    output : path, optional
        Folder of the results: ``report.html`` and ``series.json``. Beside it, ``<output>.frames.jsonl`` keeps the targets of every frame;
        a run that was interrupted goes on from there.
    interval_s : float, optional
        Time from frame to frame.
    times : path, optional
        CSV file with columns ``file`` and ``time_s``. Without one of both, times are those at which the files were written.
    on_for_s : float
        How long camera and frame grabber had been on when the first frame was taken (frame of time 0).
    interface : {"digital", "analogue"}
        Of an analogue camera the warm-up of the frame grabber is fitted too.
    pixel_clock_mhz : float, optional
        Of the frame grabber; a delay of the lines in ns needs it.
    tolerance_px : float
        Displacement of the farthest corner within which the camera is called stable.
    channel : {"red", "green", "blue"}, optional
        Of colour images.
    raw, **options
        As of `pixmetry.locate`: ``kind``, ``polarity``, ``noise``, ``bits``, ``estimator``. ``kind`` may be "texture": places of the first
        frame with gradients along both axes are found again in the others. Without a kind the targets are discs; where the frames show
        none, the texture is followed.
    progress : callable (what, done, of), optional

    Returns
    -------
    Series

    Raises
    ------
    InputError, MeasureError
        If a file or an option cannot be used, or the frames show neither three targets nor three places with a texture.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry.series.job import measure_series
    >>> y, x = np.indices((120, 160))
    >>> def frame(t):  # nine discs that move by up to 0.2 px
    ...     moved = 0.2 * (1 - np.exp(-t / 600))
    ...     dots = [np.hypot(x - 30 - 50.3 * i - moved, y - 20 - 40.3 * j) for i in range(3) for j in range(3)]
    ...     grey = 20 + 150 / (1 + np.exp(2.5 * (np.min(dots, axis=0) - 5)))
    ...     return np.rint(grey + np.random.default_rng(int(t)).normal(0, 1, grey.shape)).astype(np.uint8)
    >>> found = measure_series([(str(t), t, lambda t=t: frame(t)) for t in range(0, 3600, 60)])
    >>> shift = found.drift.fit["shift_x_px"]
    >>> bool(abs(shift.value - 0.2) < 0.02), bool(shift.u < 0.01)
    (True, True)
    """
    if interface not in ("digital", "analogue"):
        raise InputError("no such interface", where="interface", value=interface, allowed="digital, analogue")
    layout = layout_of(raw)
    given = [frames] if isinstance(frames, str | Path) else list(frames)
    files = picture_files([frames_inside(path) for path in given], PICTURE_ENDINGS, layout)
    model = noise_model(options.pop("noise", None))
    seconds, notes = times_of(files, interval_s, times)
    named = [
        (name, on_for_s + time, lambda path=path: load_picture(path, channel, layout).array)
        for path, name, time in sorted(zip(files, names_of(files), seconds, strict=True), key=lambda one: one[2])
    ]
    log = SeriesLog()
    if output is not None:
        check_output(output, KIND, tuple(map(str, given)), files)
        whole = {**options, "noise": model, "raw": layout, "channel": channel}
        told = {name: str(value) for name, value in whole.items() if value is not None}
        log = SeriesLog(Path(f"{str(output).rstrip('/')}.frames.jsonl"), told)
        for path, name in zip(files, names_of(files), strict=True):
            if _holder(path).stat().st_mtime > log.written_s:  # another frame of the same name
                log.forget(name)
    try:
        found = measure_series(
            named,
            analogue=interface == "analogue",
            pixel_clock_mhz=pixel_clock_mhz,
            tolerance_px=tolerance_px,
            log=log,
            notes=notes,
            progress=progress,
            noise=model,
            **options,
        )
    finally:
        log.close()
    if output is not None:
        write_results(found, output, tuple(map(str, given)), files)
    return found


def names_of(files: Sequence[Path]) -> list[str]:
    """A name for each frame that no other has: with its folder, or whole, where the names of files do not tell them apart."""
    names = [frame_name(path) for path in files]
    for longer in ([f"{_holder(path).parent.name}/{name}" for path, name in zip(files, names, strict=True)], [str(path) for path in files]):
        if len(set(names)) == len(names):
            break
        names = longer
    return names


def times_of(files: Sequence[Path], interval_s: float | None, times: str | Path | None) -> tuple[list[float], tuple[str, ...]]:
    """Seconds of every file after the first one, and a note on where they come from.

    Raises
    ------
    InputError
        If a file has no time in the table, or all files were written at once.
    """
    if interval_s is not None and times is not None:
        raise InputError("times are given twice", allowed="an interval or a table of times", remedy="leave one out")
    if interval_s is not None:
        if not interval_s > 0:
            raise InputError("not an interval", where="interval_s", value=interval_s, allowed="above 0 s")
        return [interval_s * k for k in range(len(files))], ()
    if times is not None:
        return _from_table(files, Path(times)), ()
    written = np.array([_holder(path).stat().st_mtime for path in files])
    if np.ptp(written) < 1.0 or len(set(map(_holder, files))) < len(files):
        remedy = "give the interval from frame to frame, or a table of times"
        raise InputError("the frames carry no times: their files were written at once", where=str(files[0].parent), remedy=remedy)
    return list(written - written.min()), ("Times are those at which the files were written; copies may have lost them.",)


def _holder(path: Path) -> Path:
    """The file that holds a frame."""
    return path if path.exists() else path.parent


def _from_table(files: Sequence[Path], table: Path) -> list[float]:
    try:
        rows = list(csv.DictReader(line for line in read_text(table).splitlines() if not line.startswith("#")))
        known = {name: float(row["time_s"]) for row in rows for name in (row["file"], Path(row["file"]).name)}
    except InputError:
        raise
    except (KeyError, ValueError, TypeError, AttributeError, csv.Error):
        raise InputError("not a table of times", where=str(table), allowed="CSV with columns file, time_s", remedy="correct it") from None
    names = names_of(files)
    missing = next((name for name in names if not np.isfinite(known.get(name, np.nan))), None)
    if missing is not None:
        raise InputError("no time for a frame", where=str(table), value=missing, remedy="add its row")
    first = min(known[name] for name in names)
    return [known[name] - first for name in names]


def measure_series(
    frames: Iterable[tuple[str, float, Fetch]],
    *,
    kind: str | None = None,
    analogue: bool = False,
    pixel_clock_mhz: float | None = None,
    tolerance_px: float = 0.05,
    temperatures_c: Sequence[float] | None = None,
    log: SeriesLog | None = None,
    notes: tuple[str, ...] = (),
    progress: Progress | None = None,
    **options: Any,
) -> Series:
    """Measure a series whose frames are fetched one by one: names, seconds since switching on, and functions that return the frames.

    In memory are the frames in work, one a thread. Frames that a log holds are not fetched again. ``temperatures_c`` are those of the
    sensor, one for each frame.

    Raises
    ------
    InputError, MeasureError
        As of `series`.
    """
    told, named = progress or no_progress, list(frames)
    if not named:
        raise MeasureError("no frames", where="series", remedy="name frames of a fixed field of targets, or of a texture")
    log = SeriesLog() if log is None else log
    shape = log.shape
    if log.texture_of and log.texture_of != named[0][0]:  # other places of another first frame
        log.done.clear()
    seen = {k: log.done[name] for k, (name, _, _) in enumerate(named) if name in log.done}
    textured = kind == TEXTURE or bool(log.texture_of)
    if not textured and kind is None and not seen:
        textured = not _shows_targets(named, options)
    texture = texture_of(named[0][2](), named[0][0]) if textured and len(seen) < len(named) else None

    def work(k: int) -> tuple[int, FrameTargets, tuple[int, int]]:
        name, time_s, fetch = named[k]
        array = fetch()
        if shape is not None and array.shape != shape:
            raise InputError("a frame of another size", where=name, value=array.shape, allowed=str(shape), remedy="leave it out")
        if texture is not None:
            found = texture.find(array, name, time_s)
        else:
            found = find_targets(array, name, time_s, kind=kind or "disc", **options)
        return k, found, (array.shape[0], array.shape[1])

    waiting = [k for k in range(len(named)) if k not in seen]
    for k, found, size in imap_tiles(work, waiting):
        shape = shape or size
        log.put_shape(shape, texture_of=named[0][0] if textured else "")
        log.put(found)
        seen[k] = found
        told("locating", len(seen), len(named))
    assert shape is not None  # every frame has one
    ordered = [seen[k] for k in range(len(named))]
    seconds: Array = np.array([time for _, time, _ in named], float)
    with single_threaded_blas():
        positions, covariance = follow_targets(ordered)
        blur = blur_of(ordered, positions)
        motion = field_motion(positions, covariance, (0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1)), analogue=analogue)
        thermal = None
        if temperatures_c is not None:
            thermal, motion = thermal_of(motion, seconds, np.asarray(temperatures_c, float))
        drift = drift_of(motion, seconds, shape, clock_mhz=pixel_clock_mhz, tolerance_px=tolerance_px, blur_px2=blur)
    drift = replace(drift, thermal=thermal)
    lost = int((~motion.used).sum())
    what = "places" if textured else "targets"
    more = [f"{lost} of {len(named)} frames show too few of the {what} and are left out."] if lost else []
    if textured and kind is None:
        more.append("No discs are found: places of the texture are followed in their stead.")
    names = tuple(name for name, _, _ in named)
    return Series(drift, names, shape, (*notes, *more), provenance_record(libraries=("numpy", "scipy", "numba")))


def _shows_targets(named: Sequence[tuple[str, float, Fetch]], options: dict[str, Any]) -> bool:
    """Whether the first and the last frame show the same discs, three or more."""
    ends = (find_targets(fetch(), name, time_s, kind="disc", **options) for name, time_s, fetch in (named[0], named[-1]))
    first, last = (end.positions_px for end in ends)
    return min(len(first), len(last)) >= LEAST_TARGETS and near_pairs(first, last)[0].size >= LEAST_TARGETS


def measure_motion(
    runs: Iterable[Sequence[tuple[str, float, Fetch]]],
    frame_shape: tuple[int, int],
    *,
    exposures_s: Sequence[float] = (),
    pulsed: Sequence[bool] = (),
    on_frames: Callable[[int], object] | None = None,
    **options: Any,
) -> MotionSeries:
    """Measure frames of moving targets, given as runs of names, seconds, and functions that return the frames.

    ``exposures_s`` are the stated ones of the runs, 0 where none was; ``pulsed`` says which runs are in the light of two pulses.

    Raises
    ------
    InputError, MeasureError
        If a frame cannot be used, or no run shows targets that can be followed.
    """

    def work(item: tuple[str, float, Fetch]) -> tuple[FrameTargets, FrameTargets, Cut]:
        name, time_s, fetch = item
        return find_in_fields(fetch(), name, time_s, **options)

    found = []
    for number, run in enumerate(runs):
        fields = []
        for both in imap_tiles(work, sorted(run, key=lambda item: item[1])):
            fields.append(both)
            if on_frames is not None:
                on_frames(1)
        length, flashed = (exposures_s[number] if exposures_s else 0.0), bool(pulsed and pulsed[number])
        even, odd, cuts = (f[0] for f in fields), (f[1] for f in fields), (f[2] for f in fields)
        found.append(Run(tuple(even), tuple(odd), tuple(cuts), length, flashed))
    with single_threaded_blas():
        return motion_of(found, frame_shape)


def measure_recordings(
    direct: Sequence[Fetch], recorded: Sequence[Fetch], *, analogue: bool, bits: int, on_frames: Callable[[int], object] | None = None
) -> Recordings:
    """Measure a recorder by frames of one scene, directly and recorded, given as functions that return them; the first 40 of each are used.

    Of larger frames from a digital camera the middle part of 1024 × 1024 pixels is kept in memory.

    Raises
    ------
    MeasureError
        As of `pixmetry.series.recording.recordings_of`.
    """

    def work(fetch: Fetch) -> np.ndarray:
        frame = fetch()
        if on_frames is not None:
            on_frames(1)
        return frame if analogue else frame[tuple(_middle(n) for n in frame.shape)].copy()

    frames = [[work(fetch) for fetch in part] for part in (direct[:MOST_RECORDED], recorded[:MOST_RECORDED])]
    with single_threaded_blas():
        return recordings_of(*frames, analogue=analogue, depth_bits=bits)


def _middle(pixels: int) -> slice:
    """The part of an axis that is kept, from the border of a block on."""
    first = max(pixels - RECORDED_SIDE, 0) // 2 // BLOCK_PX * BLOCK_PX
    return slice(first, first + RECORDED_SIDE)


def write_results(found: Series, output: str | Path, of: Sequence[str], inputs: Iterable[Path]) -> Path:
    """Write page and record into a folder, whole or not at all; return the path of the page."""
    from pixmetry.report import html_of
    from pixmetry.series.page import page_of

    with staged_output(output, KIND, of, inputs) as folder:
        (folder / "report.html").write_text(html_of(page_of(found)), encoding="utf-8")
        write_record(folder / "series.json", found.to_record())
    return Path(output) / "report.html"
