"""Differences of values under one light: what the calibration of the light has in common is taken off exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emva.cameras import Camera
from emva.scoring import measured
from pixmetry.assess.judge.differences import Subject, difference_of
from pixmetry.core.number import Number
from pixmetry.emva.evaluate import standard_values
from pixmetry.emva.files.keys import KEYS, goes_with_photons
from pixmetry.emva.records import Measurement
from pixmetry.emva.series import series_of
from pixmetry.emva.temporal import temporal_values

U_REL = 0.03


@pytest.fixture(scope="module")
def camera() -> Measurement:
    return measured(Camera(seed=21, shape=(48, 64), levels=24, stack_frames=16, setting_rel=0.001))


def subject(m: Measurement, name: str) -> Subject:
    values = standard_values(m, "4.0", draws=500).values
    return Subject(name, "data sheet", "4.0", {}, {("mono", key): value for key, value in values.items()}, {}, m.photons_u_rel)


def test_the_common_scale_of_the_light_comes_off_exactly(camera: Measurement) -> None:
    """Frames of one light, whose photon count is known to 3 %: u of each difference is that without any error of the scale."""
    with_scale, without = subject(replace(camera, photons_u_rel=U_REL), "A"), subject(camera, "B")
    for key in filter(goes_with_photons, KEYS):
        place = ("mono", key)
        own, whole = without.values[place], with_scale.values[place]
        assert whole.u == pytest.approx(np.hypot(own.u, U_REL * whole.value), rel=1e-12), key
        same, other = (difference_of(place, with_scale, replace(with_scale, name="C"), same) for same in (True, False))
        if own.u > 1e-4 * whole.u:
            assert same.u == pytest.approx(np.sqrt(2) * own.u, rel=1e-6), key
        assert other.u == pytest.approx(np.sqrt(2) * whole.u, rel=1e-12), key


def test_values_that_go_with_the_photons_are_those_that_do(camera: Measurement) -> None:
    """All values with the photons of each level raised by a tenth: proportional to them or to their inverse, or not moved."""
    series = series_of(camera)
    one = temporal_values(series, "4.0", 25.0)
    other = temporal_values(replace(series, photons=1.1 * series.photons), "4.0", 25.0)
    for key, value in one.items():
        ratio = float(other[key] / value) if value != 0 else 1.0
        assert abs(np.log(ratio)) == pytest.approx(np.log(1.1) if goes_with_photons(key) else 0.0, abs=1e-6), key


def test_a_value_that_is_nothing_but_the_light_has_no_u_of_its_own() -> None:
    """A level of the series under one light: what is left of u is none, not the whole by rounding."""
    for value in (123.4, 98765.4321, 7e-3):
        sheet = Subject("A", "data sheet", "4.0", {}, {("mono", "u_p_sat"): Number(value, abs(value) * U_REL, np.inf, "photon")}, {}, U_REL)
        assert difference_of(("mono", "u_p_sat"), sheet, sheet, True).verdict == "equal"
