"""Stacks of many frames at one setting, and the single pass that feeds all accumulators of a group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pixmetry.camera.observations import StackMoments
from pixmetry.core.errors import InputError
from pixmetry.observe.moments import FrameMoments, LevelAccumulator
from pixmetry.observe.spectra import SpectraAccumulator

PARTS = 4  # of a row, along which the phase of a hum is followed
EQUAL_EXPOSURE = 0.01  # relative; clocks round
SATURATED_FRACTION = 0.002  # EMVA 1288 R4.0 §6.6


class StackAccumulator(FrameMoments):
    """Moments of many frames taken at one setting (EMVA 1288 R4.0 §8)."""

    def result(self, exposure_s: float, *, code_min: int = 0, code_max: int | None = None) -> StackMoments:
        """Moments of the frames so far.

        Parameters
        ----------
        exposure_s : float
        code_min, code_max : int
            Lowest and highest code that the camera can store; by default 0 and ``2**bits - 1``.

        Raises
        ------
        MeasureError
            With fewer than two frames.
        """
        squares = self.mean_squares()
        deviation = self.deviation_map_dn2() / (self.n_frames - 1)
        means = self.frame_means_dn()
        share = self.counts / self.counts.sum()
        return StackMoments(
            n_frames=self.n_frames,
            exposure_s=exposure_s,
            mean_map_dn=self.mean_map_dn(),
            var_map_dn2=deviation.astype(np.float32),
            mean_dn=float(means.mean()),
            frame_means_dn=means,
            var_stack_dn2=float(deviation.mean()),
            ms_pixel_dn2=squares.pixel_dn2,
            ms_row_dn2=squares.row_dn2,
            ms_col_dn2=squares.col_dn2,
            ms_frame_dn2=squares.frame_dn2,
            fraction_min=float(share[code_min]),
            fraction_max=float(share[-1 if code_max is None else code_max]),
        )


class FrameSums(Protocol):
    """What one kind of pictures needs of each frame beside the moments; ``add`` is called for one frame at a time, in any order."""

    def add(self, frame: np.ndarray, index: int) -> None:
        """Add the frame of this index."""


@dataclass
class RowMeans:
    """Means of parts of the rows of each frame, by its index."""

    means: dict[int, np.ndarray] = field(default_factory=dict)  # shape (rows, parts), float64

    def add(self, frame: np.ndarray, index: int) -> None:
        """Add the frame of this index."""
        self.means[index] = np.stack([part.mean(axis=1, dtype=float) for part in np.array_split(frame, PARTS, axis=1)], axis=1)


@dataclass
class GroupReduction:
    """All accumulators of one group of frames; each frame is read once.

    ``spectra`` is ``None`` for the short groups of an exposure series, and for pictures of targets; ``of_pictures`` is what the experiment
    of a kind of pictures sums; ``rows`` belongs to stacks of dark frames.
    """

    moments: LevelAccumulator | StackAccumulator
    spectra: SpectraAccumulator | None = None
    of_pictures: FrameSums | None = None
    rows: RowMeans | None = None

    def add(self, frame: np.ndarray, index: int | None = None) -> None:
        """Add one frame; see :meth:`FrameMoments.add`."""
        index = self.moments.n_frames if index is None else index
        self.moments.add(frame, index)
        if self.spectra is not None:
            self.spectra.add(frame, index)
        if self.of_pictures is not None:
            self.of_pictures.add(frame, index)
        if self.rows is not None:
            self.rows.add(frame, index)


def new_group(bits: int, kind: str, spectra_pairs: int = 8) -> GroupReduction:
    """Empty accumulators for a group: a ``"level"`` (few frames of an exposure series), a ``"stack"`` (many), or a ``"target"`` (any)."""
    if kind == "level":
        return GroupReduction(LevelAccumulator(bits))
    if kind == "stack":
        return GroupReduction(StackAccumulator(bits), SpectraAccumulator(spectra_pairs))
    if kind == "target":
        return GroupReduction(StackAccumulator(bits))
    raise InputError("no such kind of group", where="kind", value=kind, allowed="level, stack, target")


class Candidate(Protocol):
    """What a stack is chosen by."""

    @property
    def exposure_s(self) -> float:
        """Exposure time."""

    @property
    def n_frames(self) -> int:
        """Number of frames."""

    @property
    def mean_dn(self) -> float:
        """Mean of all pixels."""

    @property
    def fraction_max(self) -> float:
        """Share of the pixels at the highest code."""


def same_exposure(one: Candidate, other: Candidate) -> bool:
    """Tell whether two stacks have the same exposure time."""
    return abs(one.exposure_s - other.exposure_s) <= EQUAL_EXPOSURE * max(one.exposure_s, other.exposure_s)


def choose_stacks(dark: Sequence[Candidate], bright: Sequence[Candidate]) -> tuple[int | None, int | None]:
    """Choose the dark and the bright stack that belong together: of equal or nearest exposure.

    Of several such pairs one that is not saturated, then the longest exposure, the most frames, the most light. With stacks of one kind
    only, the one of the most frames.

    Returns
    -------
    tuple
        Their places in the sequences; None where there is none.
    """
    if not dark or not bright:
        most = [max(range(len(part)), key=lambda i: (part[i].n_frames, part[i].exposure_s), default=None) for part in (dark, bright)]
        return most[0], most[1]

    def rank(pair: tuple[int, int]) -> tuple[float, bool, float, int, float]:
        d, b = dark[pair[0]], bright[pair[1]]
        saturated = b.fraction_max - d.fraction_max > SATURATED_FRACTION
        gap = 0.0 if same_exposure(d, b) else abs(float(np.log(max(d.exposure_s, 1e-9) / max(b.exposure_s, 1e-9))))
        return gap, saturated, -b.exposure_s, -min(d.n_frames, b.n_frames), -b.mean_dn

    return min(((d, b) for d in range(len(dark)) for b in range(len(bright))), key=rank)
