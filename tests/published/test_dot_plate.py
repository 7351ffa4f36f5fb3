"""The dot plate of the Discorpy project: every dot located, and the lens fitted to half of them known from the other half.

Runs where the environment variable PIXMETRY_DATA names the folder that holds discorpy-dots.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pixmetry.locate.detect.detection import detect
from pixmetry.locate.template.image_noise import noise_from_image
from pixmetry.locate.template.template import fit_template
from published import dot_plate

FOLDER = Path(os.environ.get("PIXMETRY_DATA", "")) / "discorpy-dots"
pytestmark = pytest.mark.skipif(
    not (os.environ.get("PIXMETRY_DATA") and (FOLDER / dot_plate.PICTURE).is_file()),
    reason="PIXMETRY_DATA does not name a folder with discorpy-dots",
)


@cache
def located():
    frame = dot_plate.read_picture(FOLDER)
    targets = detect(frame).targets
    grid = dot_plate.order(targets)
    whole = dot_plate.whole_dots(targets, grid)
    found = fit_template(frame, targets, noise_from_image(frame, targets[whole]), "disc", background_plane=False, light_plane=False)
    return found, grid, whole


def test_published_number_of_dots_is_found_and_ordered() -> None:
    """4415 whole dots are published; one more lies at the dark corner, and cut ones at the borders are on the grid too."""
    found, grid, whole = located()
    assert whole.sum() in (4415, 4416) and (grid.rows, grid.cols) == (54, 85)
    assert np.isfinite(found.x_px[whole]).sum() >= 4415
    cells = np.stack([grid.row, grid.col], axis=1)[grid.placed]
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_a_lens_fitted_to_half_of_the_dots_fits_the_other_half(rng: np.random.Generator) -> None:
    """0.025 px a coordinate, of which a smooth field of plate and lens makes 0.023: any random half stays below 0.028."""
    found, grid, whole = located()
    use = whole & np.isfinite(found.x_px)
    for _ in range(3):
        residuals, others = dot_plate.held_out(found, grid, use, rng)
        assert np.sqrt(np.mean(residuals[others] ** 2)) < 0.028


def test_published_coefficients_fit_worse() -> None:
    found, grid, whole = located()
    use = whole & np.isfinite(found.x_px)
    assert np.sqrt(np.mean(dot_plate.published_residuals(FOLDER, found, grid, use) ** 2)) == pytest.approx(0.052, abs=0.006)


def test_places_do_not_depend_on_the_sub_pixel_phase(rng: np.random.Generator) -> None:
    """Ten bins of about 440 dots, standard error 0.0004 px each: the largest mean is below 0.004 px (0.0016 px where it was measured)."""
    found, grid, whole = located()
    use = whole & np.isfinite(found.x_px)
    residuals, _ = dot_plate.held_out(found, grid, use, rng)
    means, errors, scatter = dot_plate.phase_means(np.stack([found.x_px, found.y_px], axis=1)[use], residuals)
    assert np.abs(means).max() < 0.004 and errors.max() < 0.0006 and scatter < 0.012
