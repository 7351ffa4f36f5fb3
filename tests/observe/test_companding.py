"""Tables of codes are found by the codes that never occur, and taken back out of the photon transfer; frames made by NumPy alone."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.assess.job import measure_sources
from pixmetry.observe.companding import before_table
from pixmetry.observe.observe import Group, observe

SHAPE, GAIN, NOISE_E, OFFSET, TOP = (120, 160), 0.5, 14.0, 90.0, 4095
Z = 5.5  # of a normal distribution: 1e-6 for all values of this file


def rooted(codes: np.ndarray, bits: int) -> np.ndarray:
    way = 2**bits - 1
    return np.rint(TOP * (np.rint(way * np.sqrt(codes / TOP)) / way) ** 2)


def scaled(codes: np.ndarray, bits: int) -> np.ndarray:
    way = 2**bits - 1
    return np.rint(TOP * np.rint(way * codes / TOP) / way)


def cut(codes: np.ndarray, bits: int) -> np.ndarray:
    step = 2 ** (12 - bits)
    return codes // step * step


def seen_behind(rng: np.random.Generator, law, bits: int):
    offsets, response = rng.normal(OFFSET, 2.0, SHAPE), rng.normal(1, 0.01, SHAPE)

    def frame(mean_e: float) -> np.ndarray:
        electrons = rng.poisson(mean_e * response) + rng.normal(0, NOISE_E, SHAPE)
        codes = np.clip(np.rint(offsets + GAIN * electrons), 0, TOP)
        return law(codes, bits).astype(np.uint16)

    groups = [
        Group(kind, "level", 0.001 * k, None, [frame(light) for _ in range(2)])
        for k in range(1, 13)
        for kind, light in (("dark", 0.0), ("bright", 550.0 * k))
    ]
    return observe(groups, 12)


@pytest.mark.parametrize("law, name, bits", [(rooted, "root", 8), (rooted, "root", 10), (scaled, "linear", 9)])
def test_law_bits_gain_and_noise(rng, law, name, bits):
    """Without the correction the gain behind the root of 8 bits would be 4 % too high, and the noise 9 % behind 9 bits; u is 0.4 %."""
    seen = seen_behind(rng, law, bits)
    found = measure_sources(seen)[0]["processing.companding"]
    assert (found.settings["law"], found["transport_bits"].value) == (name, bits)
    fit = seen.photon_transfer_fit
    for value, true in ((fit["gain_dn_per_e"], GAIN), (fit["dark_noise_e"], NOISE_E)):
        assert abs(value.value - true) < Z * value.u
        assert value.u < 0.04 * true  # 0.4 %, or up to 2 % where a correlation of neighbours seems to be there by chance
    assert seen.code_errors is None  # the gaps of a table are no fault of the converter


def test_codes_cut_off_and_shifted_left_look_alike(rng):
    unmeasured = measure_sources(seen_behind(rng, cut, 9))[1]["processing.companding"]
    assert "shifted left" in unmeasured


def test_steps_that_hide_the_noise_are_refused(rng):
    seen = seen_behind(rng, scaled, 7)
    assert "gain_dn_per_e" not in seen.photon_transfer_fit
    assert any("steps hide the noise" in note for note in seen.notes)


def test_all_codes_occur_without_a_table(rng):
    """Each of many codes would have to be missing where 20 or more are due: less than e⁻²⁰ by chance."""
    seen = seen_behind(rng, lambda codes, bits: codes, 12)
    assert seen.code_table is None
    assert "not found" in measure_sources(seen)[1]["processing.companding"]


def test_moments_before_a_table_are_those_of_plain_draws(rng):
    """Mean and variance in time of 4000 pixels, 50 draws each, at half a step: known to 0.5 % of the variance."""
    table = scaled(np.arange(4096.0), 8)
    pixels = rng.normal(500, 3, 4000)
    draws = table[np.rint(pixels[:, None] + rng.normal(0, 8, (4000, 50))).astype(int)]
    spread = draws.mean(axis=1).var() - draws.var(axis=1, ddof=1).mean() / 50
    mean, var = before_table(float(draws.mean()), float(draws.var(axis=1, ddof=1).mean()), float(spread), table)
    assert abs(var - 64 - 1 / 12) < Z * 64 * np.sqrt(2 / 200_000) * 2
    assert abs(mean - pixels.mean()) < Z * 8 / np.sqrt(200_000) * 2
