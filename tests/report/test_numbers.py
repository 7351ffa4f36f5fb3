"""Numbers as text, against decimal arithmetic and worked cases."""

from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixmetry.report.numbers import THIN, length_mpx, length_px, limit, percent, signed, significant, uncertain

MINUS = "\u2212"


def plain(text: str) -> Decimal:
    return Decimal(text.replace(MINUS, "-"))


def power(unit: str) -> int:
    """The power of ten that stands before a unit, 0 without one."""
    digits = {c: str(i) for i, c in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")} | {"⁻": "-"}
    head = unit.split("\u00a0")[0]
    return int("".join(digits[c] for c in head[2:])) if head.startswith("10") and head[2:] else 0


@given(st.floats(-1e7, 1e7), st.floats(1e-9, 1e6))
def test_value_and_uncertainty_end_at_the_same_place_and_are_rounded_there(ratio: float, u: float) -> None:
    value = ratio * u  # so far apart as a double can hold both
    got = uncertain(value, u, "1")
    shift = Decimal(10) ** power(got.unit)
    exact = Decimal(u)
    place = Decimal(10) ** (exact.adjusted() - 1)
    if exact > Decimal("99.49999") * place:  # 0.0996 becomes 0.10
        place *= 10
    assert abs(plain(got.u) * shift - exact) <= place * Decimal("0.500001")
    assert abs(plain(got.value) * shift - Decimal(value)) <= place * Decimal("0.500001")
    assert got.value.partition(".")[2].__len__() == got.u.partition(".")[2].__len__()


@pytest.mark.parametrize(
    ("value", "u", "unit", "expected"),
    [
        (0.28962645, 0.00060075, "DN/e-", ("0.28963", "0.00060", "DN/e⁻")),
        (14311.7453, 27.03, "e-", ("14312", "27", "e⁻")),
        (382808.27, 1208.9, "DN/s", ("382800", "1200", "DN/s")),
        (1.0, 0.0996, "1", ("1.00", "0.10", "")),
        (-0.0013063, 0.0036847, "1", (MINUS + "0.0013", "0.0037", "")),
        (6.99767e-6, 1.208e-6, "1/px", ("7.0", "1.2", "10⁻⁶\u00a01/px")),
        (-0.0001, 0.02, "DN", ("0.000", "0.020", "DN")),
        (4007.128, 0.0, "DN", ("4007", "–", "DN")),
    ],
)
def test_worked_cases(value: float, u: float, unit: str, expected: tuple[str, str, str]) -> None:
    got = uncertain(value, u, unit)
    assert (got.value, got.u, got.unit) == expected


def test_a_limit_says_less_than() -> None:
    assert limit(0.1366, "e-").value == "<\u00a00.14"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.012345, "0.012"),
        (0.12345, "0.123"),
        (12.345, "12.3"),
        (0.000123, "0.00012"),
        (0.0000123, "0.00001"),
        (1e-8, f"<{THIN}0.00001"),
        (float("nan"), "–"),
    ],
)
def test_lengths(value: float, text: str) -> None:
    assert length_px(value) == text


def test_small_and_signed_numbers() -> None:
    assert significant(3.2e-7, 2) == f"3.2{THIN}×{THIN}10⁻⁷"
    assert signed(-0.02, length_px) == MINUS + "0.020"
    assert signed(0.0, length_px) == signed(-1e-7, length_px) == "0"
    assert (length_mpx(0.00363), length_mpx(0.0000363), length_mpx(1e-6)) == ("3.6", "0.04", f"<{THIN}0.01")
    assert (percent(0.4567), percent(0.0456), percent(0.0001), percent(0.0)) == ("46", "4.6", f"<{THIN}0.1", "0.0")
