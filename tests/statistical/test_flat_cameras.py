"""Small random cameras with a filter, repelled charge or temporal noise reduction: the gain and the filter come out of the frames alone.

Each value must lie within the quantile of Student's t for its degrees of freedom that leaves 1e-6 for all values of a test. Repelled charge
is drawn 7 u large or more: a weaker one that happens to stay unseen shifts the gain by more than its u says in a camera known to have it.
The filters change the gain by 30 u and more. The study in ``benchmarks/study_flats.py`` has the finer scores.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from statistical.flat_cameras import GAIN, flat_case, measured

CAMERAS = 3
SHAPES = {"charge": (240, 320)}
OWN = {
    "sharpening": ("processing.sharpening.amount", "processing.sharpening.sigma_px"),
    "blur": (),
    "temporal": ("processing.temporal_noise_reduction.alpha",),
    "charge": ("sensor.brighter_fatter.area_loss_per_e",),
    "taps": ("electronics.tap_gain.step_rel", "electronics.tap_gain.odd_even_rel"),
    "none": (
        "electronics.tap_gain.step_rel",
        "processing.sharpening.amount",
        "processing.temporal_noise_reduction.alpha",
        "sensor.brighter_fatter.area_loss_per_e",
    ),
}


def holds(e, true: float, values: int) -> bool:
    """Whether a value lies within its interval, or a limit above the truth, with a chance of 1e-6 over all values that none does."""
    if e.is_limit:  # the estimate behind it is at least 1.64 u lower
        return abs(true) <= e.value + (stats.norm.isf(1e-6 / values) - 1.64) * e.u
    quantile = stats.t.isf(0.5e-6 / values, e.dof) if np.isfinite(e.dof) else stats.norm.isf(0.5e-6 / values)
    return abs(e.value - true) < quantile * e.u


@pytest.mark.parametrize("kind", OWN)
def test_blind_estimates_hold(rng, kind):
    held = []
    for _ in range(CAMERAS):
        case = flat_case(rng, kind, shape=SHAPES.get(kind, (120, 160)))
        found = measured(case, int(rng.integers(2**31)))
        if kind == "taps" and "electronics.tap_gain.taps" in found:
            assert found["electronics.tap_gain.taps"].value == case.truth["electronics.tap_gain.taps"]
        if kind == "temporal":
            assert GAIN not in found or case.truth[OWN[kind][0]] < 0.05  # too weak to be told from none: then u holds it
        for name in (GAIN, *OWN[kind]):
            if name not in found:
                continue
            e, true = found[name], case.truth.get(name, 0.0)
            assert holds(e, true, CAMERAS * (len(OWN[kind]) + 1)), (name, e, true)
            held += [name] * (e.kind == "value")
    wanted = [GAIN] * (kind != "temporal") + list(OWN[kind]) * (kind in ("sharpening", "temporal", "taps"))
    assert set(wanted) <= set(held), held


def test_repelled_charge_is_found_in_larger_frames(rng):
    """A loss of 8 % in the light, of which these frames tell a fourteenth; without the correction the gain is 4 % too low, 10 u."""
    case = flat_case(rng, "charge", shape=(240, 320), levels=16)
    found = measured(case, int(rng.integers(2**31)))
    area = found["sensor.brighter_fatter.area_loss_per_e"]
    assert area.kind == "value"
    assert holds(area, case.truth["sensor.brighter_fatter.area_loss_per_e"], 2)
    assert area.u < 0.4 * area.value
    assert holds(found[GAIN], case.truth[GAIN], 2)
