"""The T-piece against circuit laws: at low frequency it is a resistor or a capacitor at the load, at any frequency an impedance."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.sources.cable.t_piece import SOURCE, TPiece, echoes
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, seen, video

SPEED = 0.66 * 299_792_458.0


@pytest.mark.parametrize(
    "params",
    [
        TPiece(branch="open", length_m=3.0),
        TPiece(branch="open", length_m=7.0, branch_ohm=50.0, load_ohm=1000.0),
        TPiece(branch="terminated", length_m=4.0, end_ohm=30.0, branch_ohm=93.0, line_ohm=50.0),
        TPiece(branch="terminated"),
    ],
)
def test_the_echoes_are_the_voltage_of_the_circuit(params: TPiece) -> None:
    """The input impedance of the branch, Z (Z_e + jZ tan βl)/(Z + jZ_e tan βl), in parallel with the load, driven through Z_0."""
    delay, amplitude = echoes(params)
    for f in (0.1e6, 1e6, 3.3e6, 8e6):
        z, beta = params.branch_ohm, 2 * np.pi * f / SPEED * params.length_m
        end = 1e12 if params.branch == "open" else params.end_ohm
        branch = z * (end + 1j * z * np.tan(beta)) / (z + 1j * end * np.tan(beta))
        both = 1 / (1 / branch + 1 / params.load_ohm)
        alone = params.load_ohm / (params.load_ohm + params.line_ohm)
        expected = both / (both + params.line_ohm) / alone
        assert (amplitude * np.exp(-2j * np.pi * f * delay)).sum() == pytest.approx(expected, abs=2e-6)


def test_published_level_of_a_double_termination(rng: np.random.Generator) -> None:
    """75 Ω twice in parallel on a line of 75 Ω: 2/3, without an echo."""
    params = TPiece(branch="terminated", length_m=3.0)
    assert params.level == pytest.approx(2 / 3)
    np.testing.assert_allclose(seen(rng, SOURCE, params, row_of(np.full(40, 90.0)))[0, 0], 60.0, rtol=1e-6)


def test_published_capacity_of_a_short_open_branch() -> None:
    """67 pF per metre of 75 Ω cable at 75 ∥ 75 Ω: the target moves by RC, a quarter of the way there and back."""
    params = TPiece(branch="open", length_m=1.0)
    capacity = 1 / (SPEED * 75.0)
    assert capacity == pytest.approx(67e-12, rel=0.01)
    before = video(row_of(bump()), smooth=True)
    shift = (centre(sampled(SOURCE.forward(params, before, None), 16)) - centre(sampled(before, 16)))[0, 0] / 16
    assert shift == pytest.approx(37.5 * capacity * PIXEL_HZ, rel=2e-3)
    assert shift == pytest.approx(0.036, abs=5e-4)
    assert params.level == pytest.approx(1.0)
