"""Targets followed on the stream of a live camera: drift, jitter, u by repetition, and when the image is stable."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.capture.camera import Grabbed, LiveCamera
from pixmetry.capture.faults import GOOD, MISSED, Watch
from pixmetry.capture.job import SILENT, TIMEOUT_S
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.files.output import check_output
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.track.statistics import TrackStatistics
from pixmetry.locate.track.tracker import Tracked, Tracker
from pixmetry.series.job import KIND, measure_series, write_results
from pixmetry.series.log import SeriesLog
from pixmetry.series.page import outlook_sentence
from pixmetry.series.records import Series
from pixmetry.series.track import FrameTargets

FOLLOWED_SCHEMA = "pixmetry/followed/1"
TELL_S = 10.0  # from one sentence on the outlook to the next
USELESS = Flag.NOT_CONVERGED | Flag.BORDER | Flag.OVERLAPPING


@dataclass(frozen=True)
class Followed:
    """Targets that were followed.

    Parameters
    ----------
    series : Series
        Motion of the image over all runs; when it is stable.
    statistics : TrackStatistics
        Repeatability, drift and Allan deviation of each target, over the frames of the last run.
    faults : dict of int
        How many frames of the last run were missed, damaged and doubled.
    report : Path
    """

    series: Series
    statistics: TrackStatistics
    faults: dict[str, int]
    report: Path
    notes: tuple[str, ...] = field(default=())

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        head = {"schema": FOLLOWED_SCHEMA, "faults": self.faults, "report": str(self.report)}
        return {**head, "series": self.series.to_record(), "statistics": self.statistics.to_record()}


def follow(
    camera: LiveCamera,
    output: str | Path,
    *,
    exposure_s: float | None = None,
    frames: int | None = None,
    seconds: float | None = None,
    interval_s: float = 0.0,
    on_for_s: float = 0.0,
    tolerance_px: float = 0.05,
    kind: str = "disc",
    tell: Callable[[str], None] | None = None,
    clock: Callable[[], float] = time.time,
) -> Followed:
    """Follow a fixed field of targets with a live camera.

    Parameters
    ----------
    camera : LiveCamera
    output : path
        Folder of the results, as of `pixmetry series`. Beside it, ``<output>.frames.jsonl`` keeps the targets of every frame: a run that
        was killed goes on from there. No frames are kept.
    exposure_s : float, optional
        By default as the camera is set.
    frames : int, optional
        How many to follow, those of earlier runs included.
    seconds : float, optional
        For how long since the first frame of all runs. Without both, until it is interrupted (Ctrl-C), which writes the results.
    interval_s : float
        Time from one frame that is measured to the next; 0 for every frame.
    on_for_s : float
        How long the camera had been on at the first frame.
    tolerance_px : float
        Displacement of the farthest corner within which the image is called stable.
    kind : {"disc", "ellipse", "ring", "spot"}
    tell : callable, optional
        Called every ten seconds with how far the image is from where it settles.
    clock : callable
        Seconds since 1970. Times over runs are this clock's; from frame to frame the camera's own, where it has one.

    Returns
    -------
    Followed

    Raises
    ------
    InputError
        If an option, or the log of an earlier run, cannot be used.
    MeasureError
        If the first frame shows no targets, fewer than three are seen, or the camera sends nothing.
    """
    output = Path(output)
    options = {"camera": f"{camera.name} {camera.serial_number}".strip(), "kind": kind, "on_for_s": f"{on_for_s:g}"}
    check_output(output, KIND, (options["camera"],))
    log = SeriesLog(Path(f"{str(output).rstrip('/')}.frames.jsonl"), options)
    run = _Follower(camera, log, on_for_s, tolerance_px, kind, tell, clock)
    try:
        if exposure_s is not None and camera.sets_exposure:
            camera.set_exposure(exposure_s)
        try:
            run.go(frames, seconds, interval_s, exposure_s or 0.0)
        except KeyboardInterrupt:
            if run.tracker is None:
                raise
        if run.tracker is None:
            raise InputError("nothing is left to follow", where=str(log.path), remedy="ask for more frames or a longer time")
        found = run.series()
    finally:
        log.close()
    report = write_results(found, output, (options["camera"],), ())
    return Followed(found, run.tracker.statistics(), dict(run.faults), report)


class _Follower:
    """A stream at work."""

    def __init__(
        self,
        camera: LiveCamera,
        log: SeriesLog,
        on_for_s: float,
        tolerance_px: float,
        kind: str,
        tell: Callable[[str], None] | None,
        clock: Callable[[], float],
    ) -> None:
        self.camera, self.log, self.on_for_s, self.tolerance_px, self.kind = camera, log, on_for_s, tolerance_px, kind
        self.tell, self.clock = tell, clock
        self.tracker: Tracker | None = None
        self.faults: Counter[str] = Counter()
        self.first_s = min((float(name) for name in log.done), default=math.nan)  # a frame's name is when it arrived
        self.told_s = -math.inf

    def go(self, frames: int | None, seconds: float | None, interval_s: float, exposure_s: float) -> None:
        """Take frames until there are enough."""
        watch, silent, due = Watch(self.camera.bits, self.log.shape), 0, -math.inf
        self.camera.start()
        try:
            while not self.enough(frames, seconds):
                grabbed = self.camera.frame(TIMEOUT_S + exposure_s + interval_s)
                if grabbed is None:
                    silent += 1
                    if silent == SILENT:
                        raise MeasureError("the camera sends no frames", where=self.camera.name, remedy="check that it is on and triggered")
                    continue
                arrived_s, silent = self.clock(), 0
                verdict = watch.judge(grabbed)
                if verdict.missed:
                    self.faults[MISSED] += verdict.missed
                if verdict.kind != GOOD:
                    self.faults[verdict.kind] += 1
                elif arrived_s >= due:
                    due = (arrived_s if due == -math.inf else due) + interval_s
                    self.take(grabbed, arrived_s)
        finally:
            self.camera.stop()

    def enough(self, frames: int | None, seconds: float | None) -> bool:
        done = self.log.done
        if frames is not None and len(done) >= frames:
            return True
        return seconds is not None and bool(done) and self.clock() - self.first_s >= seconds

    def take(self, grabbed: Grabbed, arrived_s: float) -> None:
        """Measure the targets of a frame, and note them."""
        assert grabbed.array is not None
        when = grabbed.time_s if grabbed.time_s is not None else arrived_s
        if self.tracker is None:
            self.tracker = Tracker(grabbed.array, kind=self.kind, bits=self.camera.bits, time=when)
            found = self.tracker.latest
            self.log.put_shape((grabbed.array.shape[0], grabbed.array.shape[1]), texture_of="")
        else:
            found = self.tracker.update(grabbed.array, when)
        if math.isnan(self.first_s):
            self.first_s = arrived_s
        self.log.put(targets_of(found, f"{arrived_s:.6f}", self.on_for_s + arrived_s - self.first_s))
        if self.tell is not None and arrived_s - self.told_s >= TELL_S:
            self.tell(self.outlook())
            self.told_s = max(arrived_s, self.clock())

    def outlook(self) -> str:
        """How far the image is from where it settles, in a sentence."""
        try:
            drift = self.series().drift
        except MeasureError as problem:
            return str(problem)
        return f"{len(self.log.done)} frames, {drift.time_s[-1] / 60:.1f} min: {outlook_sentence(drift)}"

    def series(self) -> Series:
        """The motion of the image over all frames in the log."""
        ordered = sorted(self.log.done.values(), key=lambda one: one.time_s)
        named = [(one.name, one.time_s, _never) for one in ordered]
        return measure_series(named, kind=self.kind, tolerance_px=self.tolerance_px, log=self.log)


def targets_of(found: Tracked, name: str, time_s: float) -> FrameTargets:
    """The targets of a frame that were found alone and whole, as a series has them."""
    good = found.found & ((found.flags & USELESS) == 0) & (found.var_x_px2 > 0) & (found.var_y_px2 > 0)
    covariance = np.stack([found.var_x_px2, found.cov_xy_px2, found.cov_xy_px2, found.var_y_px2], axis=1).reshape(-1, 2, 2)
    return FrameTargets(name, time_s, np.column_stack([found.x_px, found.y_px])[good], covariance[good])


def _never() -> np.ndarray:
    raise AssertionError("a frame of the log is not fetched")
