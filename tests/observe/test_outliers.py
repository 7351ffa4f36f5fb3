"""A correction of defects in the camera is told by the outliers that are missing; frames and correction by NumPy and SciPy alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from pixmetry.observe.outliers import cut_of, single_outliers

SHAPE, NOISE_DN = (160, 200), 30.0
RING = np.ones((3, 3), bool)
RING[1, 1] = False


def corrected(frame: np.ndarray, threshold: int | None, step: int = 1) -> np.ndarray:
    if threshold is None:
        return frame
    ring = np.zeros((2 * step + 1, 2 * step + 1), bool)
    ring[::step, ::step] = RING
    high, low = (f(frame, footprint=ring, mode="mirror") for f in (ndimage.maximum_filter, ndimage.minimum_filter))
    middle = ndimage.median_filter(frame, footprint=ring, mode="mirror")
    return np.where((frame > high + threshold) | (frame < low - threshold), middle, frame)


def frames(rng: np.random.Generator, threshold: int | None, step: int = 1, cells: tuple[float, ...] = (1.0,) * 4) -> list[np.ndarray]:
    """Four flat fields with a fixed pattern, shading, and some hot pixels."""
    row, col = np.indices(SHAPE)
    mean = 1500 * np.array(cells)[2 * (row % 2) + col % 2] + 0.2 * col + rng.normal(0, 5, SHAPE) + 400 * (rng.random(SHAPE) < 2e-4)
    return [corrected(np.rint(mean + rng.normal(0, NOISE_DN, SHAPE)).astype(np.int64), threshold, step).astype(np.uint16) for _ in range(4)]


@pytest.mark.parametrize("threshold", [18, 24, 32, 45])
def test_threshold_is_the_size_above_which_outliers_are_missing(rng, threshold):
    found = cut_of(single_outliers(frames(rng, threshold)))
    assert found is not None
    # the number at each size is so large that the next size is excluded, but for the last, where few are due
    assert abs(found[0] - threshold) <= (0 if threshold < 40 else 3)
    assert found[1] < 1.0


def test_threshold_in_a_mosaic(rng):
    found = single_outliers(frames(rng, 25, step=2, cells=(0.8, 1.0, 1.0, 0.6)), step=2)
    assert cut_of(found)[0] == 25
    assert abs(found.sigma_dn - NOISE_DN) < 0.2 * NOISE_DN  # many are replaced


def test_normal_noise_has_the_number_that_is_expected(rng):
    """Without a correction: as many as predicted, to 5 of its own scatter of some thousand; and nothing is found missing."""
    found = single_outliers(frames(rng, None))
    few = slice(1, 40)
    there, due = found.counts[few].sum(), found.expected[few].sum()
    assert abs(there - due) < 0.02 * due + 6 * np.sqrt(due)
    assert cut_of(found) is None


def test_blurred_noise_is_not_taken_for_a_cut(rng):
    """Its outliers are fewer and smaller, yet not cut off."""
    smooth = [np.rint(ndimage.gaussian_filter(f.astype(float), 0.6)).astype(np.uint16) for f in frames(rng, None)]
    assert cut_of(single_outliers(smooth)) is None
