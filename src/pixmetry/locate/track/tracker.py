"""Targets followed from frame to frame: found once by `locate`, then measured near where each is expected."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.core.arguments import choice, number
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.threads import checked_threads, thread_count
from pixmetry.locate.centroids import _moment_kernels as m
from pixmetry.locate.detect.limits import Limits
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.estimator import Settings
from pixmetry.locate.estimators import SPOTS, chosen_estimator, estimators, methods
from pixmetry.locate.frame import checked_frame, scale_ends
from pixmetry.locate.kinds import Task, find_spots
from pixmetry.locate.noise import NoiseModel, noise_model
from pixmetry.locate.noise_correlation import with_correlation
from pixmetry.locate.track.statistics import Statistics, TrackStatistics

NEAR = 0.4  # of the distance to the nearest neighbour, within which a target is the same
MOST_PX = 25.0  # beyond which it is another, however far its neighbours are
THREADS_FROM = 64  # targets from which threads are worth their start


@dataclass(frozen=True)
class Tracked:
    """Positions of tracked targets in one frame; arrays of shape (n,), in the order of the targets' numbers.

    Parameters
    ----------
    frame : int
        Number of the frame; the first is 0.
    time : float
        As it was given, or the number of the frame.
    x_px, y_px : ndarray
        NaN where the target was not found.
    var_x_px2, cov_xy_px2, var_y_px2 : ndarray
    s_curve_px : ndarray
        Standard deviation over the sub-pixel phase, whose square is in the variances.
    flags : ndarray of uint32
        Of `pixmetry.locate.detect.targets.Flag`; ``NOT_CONVERGED`` where the target was not found.
    more : dict of ndarray
        What the estimator tells besides, such as the template's ``blur_px``.
    """

    frame: int
    time: float
    x_px: np.ndarray
    y_px: np.ndarray
    var_x_px2: np.ndarray
    cov_xy_px2: np.ndarray
    var_y_px2: np.ndarray
    s_curve_px: np.ndarray
    flags: np.ndarray
    more: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def found(self) -> np.ndarray:
        """Mask of the targets that were found, shape (n,)."""
        return np.isfinite(self.x_px)


class Tracker:
    """Follow the targets of a first frame through all that come after it.

    Parameters
    ----------
    first : ndarray, shape (rows, cols)
        Grey values: integers of up to 16 bits, or floats. All frames have its size.
    rois : sequence of (row, col, rows, cols), optional
        Regions of the frame in which targets are looked for, first pixel and size; by default the whole frame. Later they may leave them.
    kind : {"disc", "ellipse", "ring", "spot"}
    estimator : str
        One of ``pixmetry.locate.estimators.estimators(kind)``. Those of moments (``soft_threshold``, ``centroid`` …) are compiled as a
        whole; others run as in `pixmetry.locate`.
    polarity, noise, bits
        As of `pixmetry.locate`. The noise is that of the first frame, if it is not given.
    search_px : float, optional
        How far from its expected place a target is looked for; by default 0.4 of the distance to the nearest neighbour, 25 px at most.
    time : float, optional
        Of the first frame, in the unit of those given to `update`; by default 0.
    threads : int, optional

    Attributes
    ----------
    latest : Tracked
        Positions in the latest frame.
    noise : NoiseModel

    Raises
    ------
    InputError
        If the frame or an option cannot be used.
    MeasureError
        If the first frame shows no target.

    Notes
    -----
    A target is expected straight on from its last positions. Around that place its region is measured as `pixmetry.locate` measures
    regions, above the background that it had in the frame before (shifted where the light has changed); nearer ones of its size
    and height first. Then the background is fitted anew and the position measured, by the code of `pixmetry.locate`. The noise is that of
    the first frame. Of the first frame the positions are those of `pixmetry.locate`; of another they differ from them by what a map
    of the whole frame's background says otherwise about the region's outline.

    A target that is not found keeps its number, and is looked for where its motion would have brought it. Of two that were found at one
    place, as when one covers the other, it is the one that was expected nearer. Where the region there is larger or smaller than that
    target was, it is flagged `overlapping`: its position tells nothing of the motion, and is not in the statistics.

    Examples
    --------
    >>> import numpy as np
    >>> from pixmetry import Tracker
    >>> y, x = np.indices((64, 64))
    >>> def frame(k):  # a disc that moves by 0.3 px from frame to frame
    ...     disc = 20 + 150 / (1 + np.exp(4 * (np.hypot(x - 24.3 - 0.3 * k, y - 30.6) - 5)))
    ...     return np.rint(disc + np.random.default_rng(k).normal(0, 1, x.shape)).astype(np.uint8)
    >>> tracker = Tracker(frame(0))
    >>> for found in tracker.follow(frame(k) for k in range(1, 40)):
    ...     pass
    >>> bool(abs(found.x_px[0] - 24.3 - 0.3 * 39) < 0.05), bool(abs(tracker.statistics().drift_x_px[0] - 0.3) < 0.002)
    (True, True)
    """

    def __init__(
        self,
        first: np.ndarray,
        *,
        rois: Sequence[tuple[int, int, int, int]] | None = None,
        kind: str = "disc",
        estimator: str = "soft_threshold",
        polarity: str = "auto",
        noise: NoiseModel | Camera | str | Path | None = None,
        bits: int | None = None,
        search_px: float | None = None,
        time: float | None = None,
        threads: int | None = None,
    ) -> None:
        from pixmetry.locate.detect.background import scale_of
        from pixmetry.locate.detect.detection import THRESHOLD_SIGMA

        choice(kind, SPOTS, "kind", "targets of this kind cannot be tracked")
        choice(estimator, estimators(kind), "estimator", f"no such estimator for kind {kind}")
        choice(polarity, ("auto", "bright", "dark"), "polarity", "no such polarity")
        if search_px is not None:
            search_px = number(search_px, "search_px", "nothing is found without a search", above=0, allowed="above 0 px")
        time, threads = _checked_time(time), checked_threads(threads)
        image = checked_frame(first, "first frame")
        given = noise_model(noise)
        low, high = scale_ends(image, bits, given)
        limits = Limits(rois=rois)
        task = Task(image, kind, "auto", polarity, None, given, low, high, 1.0, "surface", threads, limits=limits)
        spots = find_spots(task)
        self.shape, self.threads, self.noise = image.shape, threads, spots.noise
        self.estimator = chosen_estimator(spots.targets, spots.noise, spots.why)[0] if estimator == "auto" else estimator
        self._settings = Settings(spots.seen if estimator == "auto" else kind, "auto", "surface", 1.0, threads)
        *self._ends, self._grain = scale_of(image, low, high)
        self._sigma, self._numbers = THRESHOLD_SIGMA, spots.noise.numbers()
        found = methods()[self.estimator].positions(image, spots.targets, spots.noise, self._settings)
        good = np.isfinite(found.x_px) & ((found.flags & Flag.NOT_CONVERGED) == 0)
        if not good.any():
            raise MeasureError(
                "no target in the first frame", where="Tracker", remedy="check kind and polarity, or begin with another frame"
            )
        shape = self._settings.shape
        fitted = self.estimator == "template"
        wider = with_correlation(image, spots.regions, spots.targets, found, spots.noise, shape, 1.0, spots.coder, fitted=fitted)[0]
        self._start(image, spots.targets[good], shared_noise(found, wider)[good], search_px, 0.0 if time is None else time)

    def __len__(self) -> int:
        return len(self._met)

    def update(self, frame: np.ndarray, time: float | None = None) -> Tracked:
        """Measure all targets in the next frame.

        Parameters
        ----------
        frame : ndarray, shape (rows, cols)
        time : float, optional
            In any unit, counted from any instant, but the same for all frames; by default the number of the frame.

        Raises
        ------
        InputError
            If the frame is no grey image of the first one's size, or the time no number.
        """
        image, time = self._checked(frame), _checked_time(time)
        self._look(image)
        return self._measure(image, time)

    def follow(self, frames: Iterable[np.ndarray]) -> Iterator[Tracked]:
        """Yield the positions in each of the frames, one after the other; only one is in memory.

        Raises
        ------
        InputError
            As of `update`, when the frame's turn comes.
        """
        if not isinstance(frames, Iterable) or (isinstance(frames, np.ndarray) and not frames.ndim):
            raise InputError("no frames to follow", where="frames", value=frames, allowed="arrays, one after the other")
        for frame in frames:
            yield self.update(frame)

    def statistics(self) -> TrackStatistics:
        """How well the targets repeat over all frames so far, against their stated uncertainty; their drift; the Allan deviation."""
        return self._statistics.result()

    def _start(self, image: np.ndarray, targets: Targets, shared: np.ndarray, search_px: float | None, time: float) -> None:
        from pixmetry.locate.centroids.moments import LAWS, MARGINS, _shapes, row_shift_variance
        from pixmetry.locate.detect._region_kernels import FIELDS
        from pixmetry.locate.track import _track_kernels as k

        n = len(targets)
        t = targets
        region = np.zeros((n, FIELDS))
        region[:, :14] = np.stack(
            [t.x_px, t.y_px, t.semi_major_px, t.semi_minor_px, t.angle_deg, t.blur_px, np.abs(t.amplitude_dn), t.row_first, t.row_stop,
             t.col_first, t.col_stop, *(getattr(t, name) for name in ("area_px", "fill", "holes"))], axis=1
        )  # fmt: skip
        region[:, 14], region[:, 15] = t.flags, np.sign(t.amplitude_dn)
        at = np.stack([t.x_px, t.y_px], axis=1)
        gate = gates_px(at) if search_px is None else np.full(n, float(search_px))
        zero = np.zeros(n)
        self._kept = k.Kept(
            region, np.zeros((n, m.COLUMNS)), np.zeros((n, 3)), np.zeros((n, 3)), at.copy(), np.zeros((n, 2)), np.zeros(n, np.int64),
            np.zeros(n, np.int64), gate, zero.copy(), zero.copy(), zero.copy(), row_shift_variance(targets, self.noise), shared,
        )  # fmt: skip
        code = LAWS.get(self.estimator, -1)
        whole = image.dtype.kind in "ui" and code in (m.SOFT, m.HARD)
        self._law = k.Law(code, MARGINS.get(self.estimator, 3.5), whole, _shapes())
        self._planes = np.stack([t.background_dn, t.background_x_dn_per_px, t.background_y_dn_per_px], axis=1).astype(float)
        self._expected, self._found, self._met = at.copy(), region.copy(), np.full(n, k.SEEN)
        self._statistics, self._frame = Statistics(n), -1
        self._cut_at_first = (targets.flags & Flag.BORDER) != 0
        self._find_neighbours()
        self._measure(image, time)

    def _checked(self, frame: np.ndarray) -> np.ndarray:
        image = checked_frame(frame, f"frame {self._frame + 1}")
        if image.shape != self.shape:
            raise InputError(
                "a frame of another size", where=f"frame {self._frame + 1}", value=image.shape, allowed=f"{self.shape}, as the first"
            )
        return image

    def _over(self, function: Callable[[int, int], None]) -> None:
        from pixmetry.locate.centroids.moments import run_slices

        run_slices(function, len(self), self.threads)

    @property
    def _alone(self) -> bool:
        """Whether one thread does all."""
        return len(self) < THREADS_FROM or (self.threads or thread_count()) == 1

    def _look(self, image: np.ndarray) -> None:
        """Find the regions of all targets near where they are expected."""
        from pixmetry.locate.track import _track_kernels as k

        kept, expected, found, planes, met = self._kept, self._expected, self._found, self._planes, self._met
        ends = (float(self._ends[0]), float(self._ends[1]))
        if self._alone:
            near = (self._near_start, self._near_index)
            k.find_all(image, kept, self._grain, self._sigma, ends, self._numbers, *near, expected, found, planes, met)
        else:
            k.expect(kept, expected)
            met[:] = k.LOST

            def look(a: int, b: int) -> None:
                k.seek(image, kept, expected, a, b, self._grain, self._sigma, ends, self._numbers, found, planes, met)

            self._over(look)
            if k.shift_lost(expected, found, met):
                self._over(look)
            k.take_all(kept, expected, found, planes, self._near_start, self._near_index, met)
        if k.boxes_moved(kept.region, self._box):
            self._find_neighbours()

    def _find_neighbours(self) -> None:
        """The neighbours of each target, with so much room that small motions change nothing."""
        from pixmetry.locate.detect._detect_kernels import boxes_in_reach
        from pixmetry.locate.track._track_kernels import SLACK_PX

        region = self._kept.region
        self._box = np.ascontiguousarray(region[:, 7:11]).astype(np.int64)
        light = 4 * np.maximum(region[:, 5], np.median(region[:, 5]))
        outer = np.maximum(light, 1.0) + 5 + 0.5 * np.sqrt(region[:, 2] * region[:, 3])
        self._near_start, self._near_index = boxes_in_reach(self._box, 2 * outer + 8 * SLACK_PX, light + 4 * SLACK_PX)

    def _measure(self, image: np.ndarray, time: float | None) -> Tracked:
        """Measure the targets whose regions are known."""
        self._frame += 1
        when = float(self._frame if time is None else time)
        if self._law.code < 0:
            self.latest = self._measured_by_method(image, when)
        else:
            self.latest = self._measured_by_moments(image, when)
        return self.latest

    def _measured_by_moments(self, image: np.ndarray, when: float) -> Tracked:
        from pixmetry.locate.track import _track_kernels as k

        n, kept, noise = len(self), self._kept, self._numbers
        near = (self._near_start, self._near_index)
        flags, result, at_rest = np.zeros(n, np.uint32), np.full((n, 6), np.nan), np.zeros(n, bool)
        if k.arrange(image.shape, kept, self._planes, *near, self._law, flags):
            self._choose_thresholds(image)
        expected, met = self._expected, self._met
        if self._alone:
            k.measure_all(image, kept, *near, self._law, noise, expected, met, result, at_rest, flags)
        else:
            self._over(lambda a, b: k.measure(image, kept, *near, self._law, noise, a, b, result, at_rest))
            k.settle(kept, expected, met, result, at_rest, flags)
        s_curve = kept.s_curve.copy()
        self._statistics.add(when, result, s_curve, at_rest & self._alone_and_whole(flags))
        x, y, xx, xy, yy, _ = result.T.copy()
        return Tracked(self._frame, when, x, y, xx, xy, yy, s_curve, flags)

    def _alone_and_whole(self, flags: np.ndarray) -> np.ndarray:
        """Which positions are those of one target: of no region that is two, nor of one that leaves the frame."""
        from pixmetry.locate.track import _track_kernels as k

        cut = ((flags & Flag.BORDER) != 0) & ~self._cut_at_first
        alone: np.ndarray = (self._met != k.MERGED) & ~cut
        return alone

    def _choose_thresholds(self, image: np.ndarray) -> None:
        """Choose thresholds, and the variance over the phase, for targets of these sizes."""
        from pixmetry.locate.centroids.moments import Prepared, choose_thresholds

        kept, n = self._kept, len(self)
        record = kept.record.copy()
        m.fit_grounds(image, record, 0, n, self._near_start, self._near_index, self._numbers)
        work = Prepared(record, self._numbers, np.zeros(n, np.uint32), kept.disc)
        multiple, phase, excess = choose_thresholds(work, self._law.code, self.threads)
        kept.multiple[:], kept.s_curve[:], kept.excess[:] = multiple, np.sqrt(phase), excess
        kept.chosen[:] = kept.disc

    def _measured_by_method(self, image: np.ndarray, when: float) -> Tracked:
        from pixmetry.locate.track import _track_kernels as k

        n = len(self)
        there = np.flatnonzero(self._met != k.LOST)
        found = methods()[self.estimator].positions(image, self._targets()[there], self.noise, self._settings)
        result, at_rest, flags = np.full((n, 6), np.nan), np.zeros(n, bool), np.zeros(n, np.uint32)
        result[there, :5] = np.stack([found.x_px, found.y_px, found.var_x_px2, found.cov_xy_px2, found.var_y_px2], axis=1)
        at_rest[there] = np.isfinite(found.x_px) & ((found.flags & Flag.NOT_CONVERGED) == 0)
        flags[there] = found.flags
        kept = self._kept
        kept.disc[:, 2] = 1.0
        known = kept.record
        known[:, m.X], known[:, m.Y], known[:, m.MAJOR] = kept.region[:, 0], kept.region[:, 1], kept.region[:, 2]
        known[:, m.INNER] = np.maximum(4 * kept.region[:, 5], 1.0)
        known[:, m.LEVEL], known[:, m.SLOPE_X], known[:, m.SLOPE_Y] = self._planes.T
        s_curve = np.zeros(n)
        s_curve[there] = found.more.get("s_curve_px", 0.0)
        shared = kept.shared
        k.settle(
            kept._replace(s_curve=np.zeros(n), row_shift=np.zeros(n), shared=np.tile([1.0, 1.0, 0.0], (n, 1))),
            self._expected,
            self._met,
            result,
            at_rest,
            flags,
        )
        k.widen(kept._replace(s_curve=s_curve, shared=shared), result)
        self._statistics.add(when, result, s_curve, at_rest & self._alone_and_whole(flags))
        more = {}
        for name, values in found.more.items():
            more[name] = np.full(n, np.nan)
            more[name][there] = values
        x, y, xx, xy, yy, _ = result.T.copy()
        return Tracked(self._frame, when, x, y, xx, xy, yy, s_curve, flags, more)

    def _targets(self) -> Targets:
        """The regions of the latest frame as detection has them."""
        r, (level, slope_x, slope_y) = self._kept.region, self._planes.T.copy()
        x, y, major, minor, angle, blur, height = r[:, :7].T.copy()
        row_first, row_stop, col_first, col_stop = r[:, 7:11].T.astype(np.int64)
        return Targets(
            x_px=x, y_px=y, semi_major_px=major, semi_minor_px=minor, angle_deg=angle, blur_px=blur, amplitude_dn=height * r[:, 15],
            background_dn=level, background_x_dn_per_px=slope_x, background_y_dn_per_px=slope_y,
            sigma_dn=np.sqrt(self.noise.variance_dn2(level)), row_first=row_first, row_stop=row_stop, col_first=col_first,
            col_stop=col_stop, flags=r[:, 14].astype(np.uint32),
        )  # fmt: skip


def _checked_time(time: float | None) -> float | None:
    return None if time is None else number(time, "time", "no time", allowed="a finite number")


def shared_noise(plain: Positions, wider: Positions) -> np.ndarray:
    """Factors of the variances along x and y, and the correlation, that noise shared by neighbouring pixels brings; shape (n, 3)."""
    factors = np.tile([1.0, 1.0, 0.0], (len(plain), 1))
    if wider is plain:
        return factors
    phase = np.nan_to_num(plain.more.get("s_curve_px", np.zeros(len(plain)))) ** 2
    vx, vy = plain.var_x_px2 - phase, plain.var_y_px2 - phase
    fx, fy = (wider.var_x_px2 - phase) / vx, (wider.var_y_px2 - phase) / vy
    cross = (wider.cov_xy_px2 - plain.cov_xy_px2 * np.sqrt(fx * fy)) / np.sqrt(vx * vy)
    found = np.stack([fx, fy, cross], axis=1)
    return np.where(np.isfinite(found).all(axis=1)[:, None], found, factors)


def gates_px(places: np.ndarray) -> np.ndarray:
    """How far from where it was each of some targets may be: 0.4 of the distance to its nearest neighbour, 25 px at most."""
    from scipy.spatial import cKDTree

    if len(places) < 2:
        return np.full(len(places), MOST_PX)
    return np.minimum(MOST_PX, NEAR * cKDTree(places).query(places, 2)[0][:, 1])
