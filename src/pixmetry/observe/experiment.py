"""What an experiment is: a kind of pictures, what is summed of their frames, and what the sums are reduced to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.observe.stack import FrameSums, StackAccumulator


@dataclass(frozen=True)
class PictureGroup:
    """The frames of one group of pictures, reduced.

    Parameters
    ----------
    kind : str
    exposure_s : float
        0 where it was not said.
    facts : GroupFacts
    moments : StackAccumulator
        Mean image and temporal variance.
    sums : FrameSums or None
        What the experiment itself summed.
    bits : int
        Bits of a stored value.
    """

    kind: str
    exposure_s: float
    facts: GroupFacts
    moments: StackAccumulator
    sums: FrameSums | None
    bits: int


@dataclass(frozen=True)
class Experiment:
    """One kind of pictures.

    Parameters
    ----------
    kind : str
        As in the manifest.
    reduce : callable
        From all groups of the kind, and what dark and bright frames have told, to the observations with what these pictures tell.
        What cannot be measured becomes a note or a reason; it raises nothing.
    sums : callable or None
        Makes the empty sums of a group; None where mean image and variance are enough.
    """

    kind: str
    reduce: Callable[[Sequence[PictureGroup], Observations], Observations]
    sums: Callable[[], FrameSums] | None = None
