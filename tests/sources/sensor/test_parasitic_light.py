"""Light that the stores of a global shutter gather while they wait."""

from __future__ import annotations

import numpy as np
import pytest

from catalogue.support import Flat
from pixmetry.sources.sensor.parasitic_light import SOURCE, ParasiticLight, correct
from sources.sensor.moving_scenes import STEADY, Spot, chain, row_centres


def test_even_light_rises_along_the_rows_by_28_percent() -> None:
    """1/700, 20 ms of read-out, 0.1 ms of exposure: 28.6 % from the first to the last row."""
    rows = 200
    params = ParasiticLight(sensitivity_rel=1 / 700, wait_s=0.0, row_time_s=0.02 / rows)
    image = chain((SOURCE, params), shape=(rows, 8), exposure_s=1e-4).expose(Flat(50.0)).data[0].astype(float)
    expected = STEADY * (1 + 0.02 / 1e-4 / 700 * np.arange(rows) / rows)
    assert image == pytest.approx(np.broadcast_to(expected[:, None], image.shape), rel=1e-6)
    assert image[-1, 0] / image[0, 0] - 1 == pytest.approx(0.28, abs=0.01)


def test_a_moving_target_leaves_a_ghost_at_the_mean_of_its_places_while_it_waits() -> None:
    p, wait, exposure, v = 0.01, 5e-3, 1e-3, 200.0
    params = ParasiticLight(sensitivity_rel=p, wait_s=wait, row_time_s=0.0, first_row="bottom")
    centres = row_centres(chain((SOURCE, params), exposure_s=exposure).expose(Spot(20.0, None, v)).data[0])
    share = p * wait / exposure
    expected = 20.0 + v * (0.5 * exposure + share * (exposure + 0.5 * wait)) / (1 + share)
    assert centres == pytest.approx(np.full(32, expected), abs=1e-4)


def test_inverse_even_light_is_even_again() -> None:
    params = ParasiticLight(sensitivity_rel=1 / 700, row_time_s=1e-4, first_row="bottom")
    out = chain((SOURCE, params), exposure_s=1e-3).expose(Flat(50.0), 2)
    assert np.ptp(out.data) > 0.004 * STEADY
    assert correct(params, out, {}).data == pytest.approx(np.full(out.data.shape, STEADY), rel=1e-6)
