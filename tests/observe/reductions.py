"""Frames reduced one after the other."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pixmetry.observe.stack import GroupReduction, new_group


def reduced(frames: Iterable[np.ndarray], bits: int = 12, kind: str = "stack", spectra_pairs: int = 8) -> GroupReduction:
    group = new_group(bits, kind, spectra_pairs)
    for frame in frames:
        group.add(frame)
    return group
