"""Settling, alternating columns and grain, against closed forms; the estimates against records drawn with known values."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixmetry.camera.signal import Kind
from pixmetry.core.errors import MeasureError
from pixmetry.sources.grabber.fixed_pattern import FixedPattern, forward, measure
from source_signals import Z, flat, stream

PARAMS = FixedPattern(settling_dn=4.0, settling_rows=12.0, column_step_dn=0.3)


def observed(rng: np.random.Generator, params: FixedPattern, noise_dn: float, shape: tuple[int, int] = (150, 200)) -> Any:
    """What a dark stack would show: black 7 DN, a slope over the columns, white noise left in the mean image."""
    r, c = np.mgrid[: shape[0], : shape[1]]
    image = 7 + 0.01 * c + params.settling_dn * 0.5 ** (r / (params.settling_rows * np.log(2))) + params.column_step_dn * (0.5 - c % 2)
    image += rng.normal(0, noise_dn, shape)
    return SimpleNamespace(dark_stack=SimpleNamespace(mean_map_dn=image, shape=shape))


def test_rows_settle_and_columns_alternate_about_zero(rng: np.random.Generator) -> None:
    out = forward(PARAMS, flat(10.0, (60, 40), kind=Kind.DN), stream(rng)).data[0]
    assert out[0].mean() == pytest.approx(14.0, abs=1e-5)
    assert (out[12] - 10).mean() / (out[0] - 10).mean() == pytest.approx(np.exp(-1), rel=1e-4)
    assert (out[:, 0::2] - out[:, 1::2]).mean() == pytest.approx(0.3, abs=1e-5)
    wide = forward(FixedPattern(column_step_dn=2.0, column_period=4), flat(10.0, (4, 40), kind=Kind.DN), stream(rng)).data[0, 0]
    assert wide[:4].tolist() == [11.5, 9.5, 9.5, 9.5] and wide.mean() == pytest.approx(10.0)


def test_in_fields_it_settles_line_by_line(rng: np.random.Generator) -> None:
    """Row 2 l + f is line l of its field: a line takes 64 µs, so in a frame of two fields the level falls half as fast from row to row."""
    fields = FixedPattern(settling_dn=4.0, settling_rows=12.0, interlaced=True)
    out = forward(fields, flat(10.0, (60, 8), kind=Kind.DN), stream(rng)).data[0, :, 0] - 10
    each = 4 * np.exp(-np.arange(30) * 64e-6 / (6 * 64e-6))  # 12 rows are 6 lines of a field
    np.testing.assert_allclose(out[0::2], each, atol=2e-5)
    np.testing.assert_array_equal(out[1::2], out[0::2])
    part = forward(fields, flat(10.0, (7, 8), kind=Kind.DN, row0=11, frame_shape=(60, 8)), stream(rng)).data[0, :, 0] - 10
    np.testing.assert_array_equal(part, out[11:18])


def test_grain_is_fixed_and_of_the_size_given(rng: np.random.Generator) -> None:
    """40 000 pixels know their standard deviation to 0.35 %."""
    out = forward(FixedPattern(random_std_dn=0.8), flat(10.0, (200, 200), n=2, kind=Kind.DN), stream(rng)).data
    assert np.array_equal(out[0], out[1])
    assert out[0].std() == pytest.approx(0.8, rel=Z / np.sqrt(2 * 40_000))


def test_estimates_are_unbiased_and_their_uncertainties_hold(rng: np.random.Generator) -> None:
    """300 stacks: the mean of z is 0 ± 0.28 and its standard deviation 1 ± 0.20 (1e-6), widened as the fit is not quite linear."""
    z: dict[str, list[float]] = {"settling_dn": [], "settling_rows": [], "column_step_dn": []}
    for _ in range(300):
        found = measure(observed(rng, PARAMS, 0.5))
        for name in z:
            z[name].append((found[name].value - getattr(PARAMS, name)) / found[name].u)
    for name, values in z.items():
        assert abs(np.mean(values)) < Z / np.sqrt(300) + 0.05, name
        assert abs(np.std(values) - 1) < Z / np.sqrt(600) + 0.1, name


def test_without_settling_there_is_a_limit_that_holds(rng: np.random.Generator) -> None:
    """One-sided 95 % of |row 0|: 400 stacks, of which at most 5 % lie above; the noise of a row is known, 0.5/√200."""
    none = FixedPattern(column_step_dn=0.3)
    found = [measure(observed(rng, none, 0.5)) for _ in range(60)]
    limits = np.array([f["settling_dn"].value for f in found if "settling_dn" in f.limits])
    assert len(limits) >= 58
    assert 1.5 * 0.5 / np.sqrt(200) < limits.mean() < 4 * 0.5 / np.sqrt(200)
    assert all("settling_rows" not in f for f in found if "settling_dn" in f.limits)


def test_a_stack_is_needed() -> None:
    with pytest.raises(MeasureError, match="dark frames"):
        measure(SimpleNamespace(dark_stack=None))
