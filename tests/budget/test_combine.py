"""Combination of contributions against numbers worked out by hand."""

from __future__ import annotations

import pytest

from pixmetry.budget.combine import combine
from pixmetry.core.contribution import AVERAGES, Contribution
from pixmetry.core.errors import InputError

ROWS = [
    Contribution(3.0, 4.0, "T", bias_x_px=2.0),
    Contribution(6.0, 0.0, "Tr"),
    Contribution(2.0, 2.0, "F", bias_y_px=-1.0),
    Contribution(1.0, 0.0, "G"),
    Contribution(2.0, 1.0, "D", bias_x_px=-2.0),
    Contribution(0.0, 2.0, "O"),
]


def test_one_frame_is_the_root_sum_of_squares() -> None:
    got = combine(ROWS)
    # x: 9 + 36 + 4 + 1 + 4 + 0 = 54; y: 16 + 0 + 4 + 0 + 1 + 4 = 25
    assert got.u_x_px == pytest.approx(54**0.5) and got.u_y_px == pytest.approx(5.0)
    # biases do not cancel: 4 + 4 = 8
    assert got.bias_x_px == pytest.approx(8**0.5) and got.bias_y_px == pytest.approx(1.0)
    assert got.total_x_px == pytest.approx(62**0.5) and got.total_px == pytest.approx((0.5 * (62 + 26)) ** 0.5)


def test_frames_average_only_what_is_temporal() -> None:
    got = combine(ROWS, frames=9)
    # x: (9 + 36)/9 + 4 + 1 + 4 = 14; y: 16/9 + 4 + 1 + 4 = 10.777…
    assert got.u_x_px == pytest.approx(14**0.5) and got.u_y_px == pytest.approx((97 / 9) ** 0.5)
    assert got.bias_x_px == pytest.approx(8**0.5)


def test_targets_average_what_changes_from_place_to_place() -> None:
    got = combine(ROWS, frames=9, targets=4)
    # x: 45/36 + 4/4 + 1 + 4 = 7.25; y: 16/36 + 4/4 + 0 + 1 + 4
    assert got.u_x_px == pytest.approx(7.25**0.5) and got.u_y_px == pytest.approx((16 / 36 + 6) ** 0.5)


def test_every_class_has_a_rule_and_nothing_gives_nothing() -> None:
    assert {c.gum_class for c in ROWS} == set(AVERAGES)
    assert combine([]).total_px == 0
    with pytest.raises(InputError):
        combine(ROWS, frames=0)
