"""Dark frames without any noise: the assessment says so, and refuses what only noise could tell."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.assess.job import NEED_DITHER, NEED_NOISE, assess
from pixmetry.files.in_memory import Frames, campaign_of_arrays

SHAPE = (48, 64)


def assessed(level_dn: int, one_pixel_dn: int = 0):
    stack = np.full((20, *SHAPE), level_dn, np.uint16)
    stack[3, 5, 7] += one_pixel_dn
    groups = [Frames("dark", k * 1e-3, np.full((2, *SHAPE), level_dn, np.uint16)) for k in range(1, 8)]
    return assess(campaign_of_arrays([*groups, Frames("dark", 6e-3, stack, role="stack")], bits=8), trials=0)


@pytest.mark.parametrize(("level_dn", "refused"), [(16, NEED_DITHER), (0, NEED_NOISE)])
def test_what_needs_noise_is_refused_and_a_note_says_why(level_dn: int, refused: tuple[str, ...]) -> None:
    """Above black the rounding bounds the noise; where black is cut off, nothing does. The black level is known either way."""
    found = assessed(level_dn)
    assert any("hold no noise" in note for note in found.observations.notes)
    assert not set(refused) & set(found.estimates) and all("no noise" in found.unmeasured[source] for source in refused)
    assert set(NEED_NOISE) - set(refused) <= set(found.estimates)
    assert found.estimates["grabber.adc"]["offset_dn"].value == level_dn
    counted = {r.source_id for r in found.budget.largest}
    assert not counted & set(refused)


def test_one_pixel_that_differs_once_is_noise() -> None:
    assert not any("hold no noise" in note for note in assessed(16, one_pixel_dn=1).observations.notes)
