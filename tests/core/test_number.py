"""One number: what its kind says, its record, its coverage interval."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from pixmetry.core.number import LOWER_LIMIT, NOT_AVAILABLE, UPPER_LIMIT, VALUE, Estimates, Number, effective_dof


def test_nan_is_never_a_value_or_a_limit() -> None:
    for kind in (VALUE, UPPER_LIMIT, LOWER_LIMIT):
        assert Number(math.nan, kind=kind).kind == NOT_AVAILABLE
    gone = replace(Number(3.0, 0.1, kind=UPPER_LIMIT), value=math.nan)
    assert not (gone.is_available or gone.is_limit)
    with pytest.raises(ValueError, match="not available"):
        Number(1.0, kind=NOT_AVAILABLE)
    with pytest.raises(ValueError, match="kind"):
        Number(1.0, kind="bound")


@pytest.mark.parametrize(("dof", "t"), [(4.0, 2.776), (9.0, 2.262), (math.inf, 1.960)])
def test_published_quantiles_of_students_distribution(dof: float, t: float) -> None:
    """JCGM 100:2008, Table G.2, 95 %."""
    low, high = Number(10.0, 0.5, dof).interval()
    assert high - 10 == pytest.approx(0.5 * t, abs=3e-4) and 10 - low == pytest.approx(high - 10)


def test_the_interval_of_a_limit_is_a_half_line() -> None:
    assert Number(2.0, 0.1, kind=UPPER_LIMIT).interval() == (-math.inf, 2.0)
    assert Number(2.0, 0.1, kind=LOWER_LIMIT).interval(0.5) == (2.0, math.inf)


@pytest.mark.parametrize(
    "number",
    [
        Number(1.5, 0.25, 12.0, "DN", "a fit", "bent", VALUE, "gain"),
        Number(1.5, math.nan, math.inf, "px", kind=LOWER_LIMIT),
        Number.not_available("e⁻", "no dark frames"),
    ],
)
def test_inverse_of_the_record(number: Number) -> None:
    record = json.loads(json.dumps(number.to_record(), allow_nan=False))
    assert repr(Number.from_record(record)) == repr(replace(number, dof=math.inf if math.isnan(number.dof) else number.dof))


def test_a_set_gives_its_numbers() -> None:
    found = Estimates.from_rows([("a", 3.0, 0.3, 9.0, "DN"), ("b", 1.0, 0.1, 5.0, "e-")], method="m", limits=frozenset({"a"}))
    assert found["a"] == Number(3.0, found["a"].u, 9.0, "DN", "m", "", UPPER_LIMIT, "a") and found["a"].u == pytest.approx(0.3)
    assert found["a"].representative == pytest.approx(math.sqrt(3)) and found["b"].representative == 1.0
    assert [Number.from_record(record) for record in found.to_records()] == list(found)


def test_effective_degrees_of_freedom() -> None:
    """JCGM 100:2008, H.1: an end gauge's u of 32 nm with 16.7 (there truncated to 16) degrees of freedom."""
    u = [25.0, 9.7, 2.9, 16.6]
    dof = [18.0, 25.6, 50.0, 2.0]
    assert float(effective_dof(np.square(u), dof)) == pytest.approx(16.7, abs=0.1)
    both = effective_dof(np.square([u, u]), np.array([dof, [math.inf] * 4]))
    assert both.shape == (2,) and math.isinf(both[1])
    assert float(effective_dof([1e-200, 1e-200], [4.0, 4.0])) == pytest.approx(8.0)
