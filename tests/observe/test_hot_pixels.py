"""What is taken for hot pixels, and what is not. The frames are made by NumPy alone."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.observe.defects import tail_of_counts, tail_of_map

SHAPE = (200, 300)
PIXELS = SHAPE[0] * SHAPE[1]


@pytest.fixture
def dark(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(40.0, 2.0, SHAPE)


def counts_of(frame: np.ndarray) -> np.ndarray:
    return np.bincount(np.rint(frame).astype(int).ravel(), minlength=4096)


def test_a_few_hot_pixels_are_seen_whole(dark: np.ndarray) -> None:
    """60 pixels 500 DN higher add 0.5 DN to the mean; what they stand above is uncertain by 2/√60 DN, which is 0.0003 DN of that."""
    dark.ravel()[:: PIXELS // 60] += 500.0
    hot = len(dark.ravel()[:: PIXELS // 60])
    for tail in (tail_of_counts(counts_of(dark)), tail_of_map(dark)[0]):
        assert tail.mean_dn + tail.below_dn == pytest.approx(500.0 * hot / PIXELS, abs=0.003)


def test_a_part_of_the_sensor_that_is_brighter_is_not_hot(dark: np.ndarray) -> None:
    """A tap with a seventh of the columns, 40 DN higher, is black level; 5 of its 6 DN were taken off."""
    dark[:, :45] += 40.0
    for tail in (tail_of_counts(counts_of(dark)), tail_of_map(dark)[0]):
        assert tail == (0.0, 0.0, 0.0)
