"""Stacks of many frames at one setting, and the single pass that feeds all accumulators of a group."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.observations import StackMoments
from pixmetry.experiment.moments import FrameMoments, LevelAccumulator
from pixmetry.experiment.spectra import SpectraAccumulator


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


@dataclass
class GroupReduction:
    """All accumulators of one group of frames; each frame is read once.

    ``spectra`` is ``None`` for the short groups of an exposure series.
    """

    moments: LevelAccumulator | StackAccumulator
    spectra: SpectraAccumulator | None = field(default=None)

    def add(self, frame: np.ndarray, index: int | None = None) -> None:
        """Add one frame; see :meth:`FrameMoments.add`."""
        index = self.moments.n_frames if index is None else index
        self.moments.add(frame, index)
        if self.spectra is not None:
            self.spectra.add(frame, index)

    def merge(self, other: GroupReduction) -> None:
        """Add what another reduction of the same group has gathered."""
        self.moments.merge(other.moments)
        if self.spectra is not None and other.spectra is not None:
            self.spectra.merge(other.spectra)


def new_group(bits: int, kind: str, spectra_pairs: int = 8) -> GroupReduction:
    """Empty accumulators for a group: ``kind`` is ``"level"`` (few frames of an exposure series) or ``"stack"`` (many)."""
    if kind == "level":
        return GroupReduction(LevelAccumulator(bits))
    if kind == "stack":
        return GroupReduction(StackAccumulator(bits), SpectraAccumulator(spectra_pairs))
    raise InputError("no such kind of group", where="kind", value=kind, allowed="level, stack")


def reduce_group(
    frames: Iterable[np.ndarray | tuple[int, np.ndarray]], *, bits: int, kind: str = "stack", spectra_pairs: int = 8
) -> GroupReduction:
    """Reduce the frames of one group in one pass.

    Parameters
    ----------
    frames : iterable of ndarray, or of (index, ndarray)
        Shape (rows, cols), uint8 or uint16. With indices, several threads can each reduce a part and the parts be merged, with the same
        bits as one pass.
    bits : int
        Bits per stored code.
    kind : {"stack", "level"}
    spectra_pairs : int
        Frame pairs of a stack that enter the temporal spectra.

    Raises
    ------
    InputError
        If frames differ in shape, are not stored codes, or an index comes twice.
    """
    group = new_group(bits, kind, spectra_pairs)
    for item in frames:
        if isinstance(item, tuple):
            group.add(item[1], item[0])
        else:
            group.add(item)
    return group
