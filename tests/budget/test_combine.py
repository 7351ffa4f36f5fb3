"""Combination of contributions against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.budget.combine import combine
from pixmetry.budget.headline import dof_of
from pixmetry.budget.records import MONTE_CARLO, SUM, BudgetRow, Headline
from pixmetry.camera.contribution import CLASSES, Contribution, smooth_part
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


def test_a_calibration_takes_up_what_is_constant_or_smooth_but_nothing_that_drifts() -> None:
    got = combine(ROWS)
    # x: T 9, Tr 36, F 4, D with its bias 4 + 4, O 0; G and the bias of T are gone
    assert got.left_x_px == pytest.approx(57**0.5)
    # y: T 16, Tr 0, F 4, D 1, O 4; the bias of F is gone
    assert got.left_y_px == pytest.approx(5.0) and got.calibrated_px == pytest.approx((0.5 * (57 + 25)) ** 0.5)
    # over 9 frames of 4 targets: (9 + 36)/36 + 4/4 + 8
    assert combine(ROWS, frames=9, targets=4).left_x_px == pytest.approx((1.25 + 1 + 8) ** 0.5)


def test_known_biases_add_with_their_signs() -> None:
    """x: 2 of T and −2 of D cancel, but not once a calibration has taken up that of T; y: −1 of F."""
    got = combine(ROWS, signed=True)
    assert (got.bias_x_px, got.bias_y_px) == (0.0, 1.0) and got.left_x_px == pytest.approx(57**0.5)
    delays = [Contribution(0.0, 0.0, "G", bias_x_px=b) for b in (0.9, 0.3)]
    assert combine(delays, signed=True).total_x_px == pytest.approx(1.2) and combine(delays).total_x_px == pytest.approx(0.9**0.5)
    assert combine(delays, signed=True).calibrated_px == 0.0


def test_parts_that_are_told_go_before_the_class() -> None:
    """A shift of rows: 3 in time, 4 smoothly over the rows, 12 from place to place: 13 in all."""
    c = Contribution(13.0, 0.0, "Tr", bias_x_px=1.0, time_px=(3.0, 0.0), smooth_px=(4.0, 0.0))
    assert c.place_px == pytest.approx((12.0, 0.0)) and c.calibrated_px == pytest.approx((0.5 * 153) ** 0.5)
    got = combine([c], frames=9, targets=4)
    assert got.u_x_px == pytest.approx((9 / 36 + 144 / 4 + 16) ** 0.5) and got.left_x_px == pytest.approx((9 / 36 + 144 / 4) ** 0.5)
    assert Contribution(5.0, 0.0, "G", smooth_px=(0.0, 0.0)).place_px == (5.0, 0.0)
    assert Contribution(5.0, 0.0, "T", smooth_px=(3.0, 0.0)).time_px == pytest.approx((4.0, 0.0))


def test_smooth_part_follows_a_cubic_and_nothing_between_the_pixels() -> None:
    y, x = np.mgrid[0:20, 0:30]
    cubic = 2.0 - 0.1 * x + 0.02 * x * y - 1e-3 * y**3
    assert np.allclose(smooth_part(cubic, y, x), cubic)
    assert np.abs(smooth_part((-1.0) ** (x + y), y, x)).max() < 0.02
    assert np.allclose(smooth_part(np.array([1.0, 3.0]), np.array([0, 7])), [1.0, 3.0])  # two places tell a line


def test_every_class_has_a_rule_and_nothing_gives_nothing() -> None:
    assert {c.gum_class for c in ROWS} == set(CLASSES)
    assert combine([]).total_px == 0
    with pytest.raises(InputError):
        combine(ROWS, frames=0)


def test_degrees_of_freedom_are_those_of_what_the_parts_are_uncertain_by() -> None:
    """A part known to 10 % has ½/0.1² = 50 (JCGM 100:2008, G.4.2), two such parts of equal size 4/(1/50 + 1/50) = 100 (G.4.1)."""
    parts = [Contribution(0.03, 0.04, kind, model_error=0.0, floor_px=0.0) for kind in "TF"]
    rows = [BudgetRow("a", "a", "a", "measured", part, u_of_total_px=0.1 * part.total_px) for part in parts]
    found = Headline(SUM, 0.0, float("nan"), float("nan"), 0.0, "")
    assert dof_of(rows[:1], combine(parts[:1]), found) == pytest.approx((50.0, 50.0))
    assert dof_of(rows, combine(parts), found) == pytest.approx((100.0, 100.0))
    exact = BudgetRow("c", "c", "c", "modelled", Contribution(0.04, 0.03, "T", model_error=0.0, floor_px=0.0))
    both = combine([parts[0], exact.part])  # squares in x 9 + 16, in y 16 + 9
    assert dof_of([rows[0], exact], both, found) == pytest.approx((50 * (25 / 9) ** 2, 50 * (25 / 16) ** 2))
    simulated = Headline(MONTE_CARLO, 0.0, 0.05, 0.001, 0.0, "")
    assert dof_of(rows, combine(parts), simulated) == pytest.approx((0.5 * 50**2,) * 2)
