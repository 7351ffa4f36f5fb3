"""The pass over the frames: each is fetched and summed in one of several threads, all sums exact, so their number does not show."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import LevelMoments, LevelRows, PhotonTransfer
from pixmetry.core.errors import MeasureError
from pixmetry.core.threads import imap_tiles
from pixmetry.observe.defects import tail_of_counts
from pixmetry.observe.experiments import EXPERIMENTS
from pixmetry.observe.moments import LevelAccumulator, LevelSummary, level_moments, summarize_pair
from pixmetry.observe.noise_covariance import FrameSuccession, LagProducts, lag_products, white_square
from pixmetry.observe.stack import GroupReduction, RowMeans, new_group

Frame = np.ndarray | Callable[[], np.ndarray]
SAMPLES = 8  # frames of a stack, of which every other one is kept
Part = Callable[[np.ndarray], np.ndarray]


def whole(frame: np.ndarray) -> np.ndarray:
    """All of a frame, as a part."""
    return frame


@dataclass(frozen=True)
class Group:
    """Frames of one condition; a frame may be given as a function that fetches it, which is then called in a thread."""

    kind: str  # "dark", "bright", or that of a target such as "edge"
    role: str  # "level", "stack" or "target"
    exposure_s: float
    photons: float | None
    frames: Iterable[Frame]
    facts: GroupFacts = GroupFacts()


class Level(NamedTuple):
    """One level of a series."""

    summary: LevelSummary
    exposure_s: float
    photons: float | None


class Reduced(NamedTuple):
    """What a part of the frames of one group was reduced to: the summary of a level, or all running sums of a stack."""

    sums: GroupReduction | LevelSummary
    shape: tuple[int, int]
    products: LagProducts
    succession: FrameSuccession


def reduce_groups(
    groups: Iterable[Group],
    bits: int,
    *,
    parts: Sequence[Part] = (whole,),
    spectra_pairs: int = 8,
    lags: bool = False,
    threads: int | None = None,
    on_frames: Callable[[int], object] | None = None,
) -> Iterator[tuple[Group, list[Reduced]]]:
    """Reduce the frames of group after group; in memory are the frames in work, two a thread, and the maps of the groups in work.

    Parameters
    ----------
    groups : iterable of Group
        Read as the work proceeds.
    bits : int
        Bits per stored code.
    parts : sequence of callable
        Each takes its part out of a frame, such as one phase of a colour filter; the parts are reduced apart.
    spectra_pairs : int
        Frame pairs of a stack that enter the temporal spectra.
    lags : bool
        Whether the products of the noise of neighbouring pixels are summed.
    threads : int, optional
    on_frames : callable, optional
        Called with the number of frames that were done since the last call.

    Yields
    ------
    tuple
        Each group with one ``Reduced`` for each part.

    Raises
    ------
    InputError
        If a frame cannot be fetched or does not fit.
    """
    done: list[Reduced] = []
    for task in imap_tiles(_Task.run, _tasks(groups, bits, parts, spectra_pairs, lags), threads):
        if on_frames is not None:
            on_frames(len(task.frames))
        done = task.results() if task.last else done
        if task.last:
            yield task.group, done


class _Sums:
    """Running sums of one part of the frames of one group, shared by the threads."""

    def __init__(self, part: Part, group: Group, bits: int, spectra_pairs: int, lags: bool) -> None:
        self.part, self.bits, self.lags, self.stack = part, bits, lags, group.role == "stack"
        self.products, self.succession = LagProducts(), FrameSuccession()
        self.reduction = new_group(bits, group.role, spectra_pairs)
        experiment = EXPERIMENTS.get(group.kind)
        if experiment is not None and experiment.sums is not None:
            self.reduction.of_pictures = experiment.sums()
        if group.kind == "dark" and self.stack:
            self.reduction.rows = RowMeans()
        self.summary: Reduced | None = None
        self._lock = threading.Lock()

    def add(self, first_index: int, frames: Sequence[np.ndarray], alone: bool) -> None:
        own = [np.ascontiguousarray(self.part(frame)) for frame in frames]
        if alone:
            shape = (own[0].shape[0], own[0].shape[1])
            self.summary = Reduced(summarize_pair(own[0], own[1], self.bits), shape, self.products, self.succession)
        else:
            due = []
            with self._lock:
                for offset, frame in enumerate(own):
                    self.reduction.add(frame, first_index + offset)
                    if self.lags and self.stack:
                        due += self.succession.due(first_index + offset, frame)
            for key, first, second in due:
                self.succession.put(key, white_square(first, second))
        if self.lags and len(own) == 2:  # frames that were summed have the right shape
            products, mean = lag_products(own[0], own[1])
            with self._lock:
                self.products.add(first_index // 2, products, mean, own[0].shape)
                if self.stack and first_index < SAMPLES:
                    self.products.samples[first_index] = own[0]

    def result(self) -> Reduced:
        if self.summary is not None:
            return self.summary
        moments = self.reduction.moments
        sums = moments.summary() if isinstance(moments, LevelAccumulator) else self.reduction
        return Reduced(sums, moments.shape, self.products, self.succession)


@dataclass
class _Task:
    """Up to two frames of a group; with ``alone`` they are all that a level has."""

    group: Group
    sums: list[_Sums]
    first_index: int
    frames: list[Frame]
    last: bool
    alone: bool

    def run(self) -> _Task:
        arrays = [frame() if callable(frame) else frame for frame in self.frames]
        for sums in self.sums:
            sums.add(self.first_index, arrays, self.alone)
        return self

    def results(self) -> list[Reduced]:
        return [sums.result() for sums in self.sums]


def _tasks(groups: Iterable[Group], bits: int, parts: Sequence[Part], spectra_pairs: int, lags: bool) -> Iterator[_Task]:
    for group in groups:
        sums = [_Sums(part, group, bits, spectra_pairs, lags) for part in parts]
        frames, index = iter(group.frames), 0
        pair = list(islice(frames, 2))
        while True:
            following = list(islice(frames, 2))
            alone = group.role == "level" and index == 0 and len(pair) == 2 and not following
            yield _Task(group, sums, index, pair, not following, alone)
            if not following:
                break
            index, pair = index + 2, following


def refuse_copies(group: Group, level: LevelSummary, bits: int) -> None:
    """Refuse a bright level whose frames are the same picture; frames of one code, or at either end of the codes, may be alike.

    Raises
    ------
    MeasureError
        If they are.
    """
    between = 0 < level.mean_dn < 2**bits - 1
    ends = (level.counts[0] + level.counts[-1]) / level.counts.sum()
    if group.kind == "bright" and between and ends < 0.5 and level.squares.total_dn2 == 0 and np.count_nonzero(level.counts) > 1:
        raise MeasureError(
            f"the frames of a level are identical (bright, exposure {group.exposure_s:g} s): there is no temporal noise to measure",
            where="photon transfer",
            remedy="list frames that were taken one after the other, not copies, averages or synthetic frames",
        )


def photon_transfer(dark: Sequence[Level], bright: Sequence[Level], shape: tuple[int, int] | None, bits: int) -> PhotonTransfer:
    """Put the levels of a camera together; of one kind there may be none.

    Raises
    ------
    MeasureError
        If there are none at all.
    """
    if shape is None or not (dark or bright):
        raise MeasureError("no frames", where="photon transfer", remedy="add groups of two frames or more")
    tails = [level.summary.tail or tail_of_counts(level.summary.counts) for level in dark]
    return PhotonTransfer(_moments(bright), _moments(dark), shape, bits, np.array(tails).reshape(-1, 3), _rows(bright), _rows(dark))


def without_levels(shape: tuple[int, int], bits: int) -> PhotonTransfer:
    """The series of a camera of which there are only pictures of targets: no dark and no bright level."""
    return PhotonTransfer(_moments([]), _moments([]), shape, bits, np.zeros((0, 3)))


def _rows(levels: Sequence[Level]) -> LevelRows | None:
    """Means of the rows of all levels; None without levels."""
    if not levels:
        return None
    sums = [level.summary for level in levels]
    return LevelRows(
        np.array([level.exposure_s for level in levels], float),
        np.array([s.row_mean_dn for s in sums]),
        np.sqrt([max(s.squares.row_dn2, 0.0) / s.n_frames for s in sums]),
        np.array([s.counts[-1] / s.counts.sum() for s in sums]),
    )


def _moments(levels: Sequence[Level]) -> LevelMoments:
    photons = [float(level.photons) for level in levels if level.photons is not None]
    return level_moments(
        [level.summary for level in levels], [level.exposure_s for level in levels], photons if len(photons) == len(levels) else None
    )
