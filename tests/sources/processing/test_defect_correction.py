"""Defect correction: what it repairs, what it takes for a defect, in one colour and in a mosaic."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.processing.defect_correction import DefectCorrection, forward, replaced
from source_signals import stream
from sources.processing.code_frames import codes, disc, soft_centroid


def corrected(rng: np.random.Generator, image: np.ndarray, **kw) -> np.ndarray:
    return forward(DefectCorrection(**kw), codes(image), stream(rng)).data[0].astype(float)


@pytest.mark.parametrize(("mosaic", "step"), [("none", 1), ("bayer", 2)])
def test_against_a_search_pixel_by_pixel(mosaic, step, rng: np.random.Generator):
    image = rng.integers(0, 200, (17, 15))
    padded = np.pad(image, step, mode="reflect")
    want = image.astype(float).copy()
    for r in range(17):
        for c in range(15):
            block = padded[r : r + 2 * step + 1 : step, c : c + 2 * step + 1 : step].ravel()
            around = np.delete(block, 4)
            if image[r, c] > around.max() + 10 or image[r, c] < around.min() - 10:
                want[r, c] = np.floor(np.median(around) + 0.5)
    got = corrected(rng, image, threshold_dn=10, mosaic=mosaic)
    assert np.array_equal(got, want) and not np.array_equal(want, image)
    assert np.array_equal(replaced(DefectCorrection(threshold_dn=10, mosaic=mosaic), codes(image).data)[0], want != image)


def test_hot_and_dead_pixels_on_a_ramp_are_repaired_even_at_the_border(rng: np.random.Generator):
    row, col = np.indices((20, 20))
    ramp = 500 + 4 * row + 7 * col
    spoilt = ramp.copy()
    spoilt[5, 6], spoilt[12, 3], spoilt[0, 10], spoilt[19, 19] = 4000, 0, 4000, 0
    got = corrected(rng, spoilt, threshold_dn=50)
    assert np.abs(got - ramp).max() <= 11
    assert got[5, 6] == ramp[5, 6]


def test_a_target_of_one_pixel_is_taken_for_a_defect_one_of_seven_is_not(rng: np.random.Generator):
    star = np.full((15, 15), 10)
    star[7, 7] = 200
    assert (corrected(rng, star, threshold_dn=20) == 10).all()
    image = np.rint(disc(0.2, -0.3, 7.0))
    assert np.array_equal(corrected(rng, image, threshold_dn=20), image)


def test_a_small_target_loses_its_peak_and_its_place(rng: np.random.Generator):
    """A spot of 0.5 px between two pixels of different height: the higher one goes, and the centre with it, by more than 0.1 px."""
    errors = []
    for x in np.linspace(-0.3, 0.3, 13):
        image = np.rint(disc(x, 0.0, 1.0, blur=0.4, peak=250.0))
        errors.append(soft_centroid(corrected(rng, image, threshold_dn=10), 2.0)[0] - x)
    assert np.max(np.abs(errors)) > 0.1


def test_a_mosaic_is_left_alone_if_neighbours_of_the_same_colour_are_asked(rng: np.random.Generator):
    row, col = np.indices((16, 16)) % 2
    mosaic = np.array([[50, 100], [100, 30]])[row, col]
    hot = mosaic.copy()
    hot[6, 6] = 240
    hot[9, 9] = 240
    assert np.array_equal(corrected(rng, hot, threshold_dn=20, mosaic="bayer"), mosaic)
    assert not np.array_equal(corrected(rng, hot, threshold_dn=20), mosaic)
