"""Row and column noise: variances, what is common and what is new, and the shift of a disc in a round window."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.sources.electronics.row_noise import SOURCE, RowNoise
from source_signals import ALPHA, centroid_probe, fitted, flat, stream

SHAPE = (300, 400)


def test_lines_have_their_variance_and_nothing_else_varies(rng: np.random.Generator):
    """χ² of the row and column means over 20 frames at 1e-6; catches an error of 7 % in the standard deviation."""
    out = SOURCE.forward(RowNoise(row_e=4.0, column_e=1.5), flat(0.0, SHAPE, n=20), stream(rng)).data.astype(float)
    by_row, by_col, by_frame = out.mean(axis=2), out.mean(axis=1), out.mean(axis=(1, 2))
    rest = out - by_row[:, :, None] - by_col[:, None, :] + by_frame[:, None, None]
    assert np.abs(rest).max() < 1e-4
    for means, sigma in ((by_row, 4.0), (by_col, 1.5)):
        dof = means.size - len(means)
        squares = ((means - means.mean(axis=1, keepdims=True)) ** 2).sum() / sigma**2
        low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], dof)
        assert low < squares < high


def test_new_in_every_frame(rng: np.random.Generator):
    out = SOURCE.forward(RowNoise(row_e=1.0), flat(0.0, SHAPE, n=2), stream(rng)).data[:, :, 0].astype(float)
    assert abs(np.corrcoef(out)[0, 1]) < 4.9 / math.sqrt(SHAPE[0])


def test_shift_of_a_target_in_a_round_window():
    """u_y = σ √(Σ y² n_r²)/S with the chords n_r of the window, summed here by hand; u_x comes from the columns alike."""
    axis = np.arange(17) - 8.0
    inside = (axis[:, None] ** 2 + axis[None, :] ** 2) <= 6.0**2
    image = (100.0 * np.exp(-(axis[:, None] ** 2 + axis[None, :] ** 2) / 8) * inside)[None]
    probe = centroid_probe(image, np.array([8.0]), np.array([8.0]))
    probe = type(probe)(**{**probe.__dict__, "gx": probe.gx * inside, "gy": probe.gy * inside})
    got = SOURCE.propagate(RowNoise(row_e=30.0, column_e=0.0), probe)
    chords = inside.sum(axis=1)
    assert got.u_y_px == pytest.approx(0.3 * math.sqrt((axis**2 * chords**2).sum()) / image.sum(), rel=1e-9)
    assert got.u_x_px == pytest.approx(0, abs=1e-12)  # a row's offset pulls to both sides alike
    turned = SOURCE.propagate(RowNoise(row_e=0.0, column_e=30.0), probe)
    assert turned.u_x_px == pytest.approx(got.u_y_px, rel=1e-9)


def test_measured_with_both_parts():
    got = SOURCE.measure(Observations(photon_transfer_fit=fitted(row_noise_e=(1.0, 0.1, "e-"), column_noise_e=(0.4, 0.1, "e-"))))
    assert (got["row_e"].value, got["column_e"].value) == (1.0, 0.4)
    with pytest.raises(MeasureError, match="dark"):
        SOURCE.measure(Observations())
