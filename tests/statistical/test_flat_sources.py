"""Colours of a mosaic, gain of the columns, blinking pixels and tables of codes, out of the flat and dark frames of small random cameras.

As in `test_flat_cameras`, every value lies within the quantile of Student's t that leaves 1e-6 for all values of a test. Without the source
its value is a limit, or not found.
"""

from __future__ import annotations

import pytest

from statistical.flat_cameras import GAIN, flat_case, measured
from statistical.test_flat_cameras import holds

COLOURS = tuple(f"sensor.bayer_mosaic.{name}" for name in ("red", "green", "blue", "green_split_rel"))
CUT = "processing.defect_correction.threshold_dn"
COLUMNS, SHARE, STEP = "electronics.column_noise.gain_rel", "electronics.telegraph_noise.share", "electronics.telegraph_noise.amplitude_e"


@pytest.mark.parametrize(
    ("kind", "cameras", "names"),
    [("mosaic", 3, (GAIN, *COLOURS)), ("columns", 3, (GAIN, COLUMNS)), ("telegraph", 1, (SHARE, STEP)), ("outliers", 2, (CUT,))],
)
def test_blind_estimates_hold(rng, kind, cameras, names):
    for _ in range(cameras):
        case = flat_case(rng, kind)
        found = measured(case, int(rng.integers(2**31)))
        for name in names:
            e, true = found[name], case.truth[name]
            assert (e.u == 0 and e.value == true) or holds(e, true, cameras * len(names)), (name, e, true)


def test_cameras_without_them_have_limits(rng):
    found = measured(flat_case(rng, "none", stack=64), int(rng.integers(2**31)))
    assert not set(COLOURS) & set(found)
    assert found[COLUMNS].is_limit or found[COLUMNS].value < 6 * found[COLUMNS].u
    assert found[SHARE].is_limit and found[SHARE].value < 0.01
    assert STEP not in found
    assert CUT not in found
