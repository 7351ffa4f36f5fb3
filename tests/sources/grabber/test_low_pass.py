"""The grabber's low-pass filter: magnitude by SciPy's designs, published delays, and what the asymmetry does under a threshold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal as sps

from pixmetry.camera.line import Line
from pixmetry.sources.grabber.low_pass import SOURCE, LowPass, delay_s, near
from video_signals import PIXEL_HZ, bump, centre, row_of, sampled, seen, video

F = np.array([0.3e6, 2e6, 5e6, 9e6])


def gain(params: LowPass) -> np.ndarray:
    return Line(1.0, 1.0).filtered(params.zeros, params.poles).gain(F)


@pytest.mark.parametrize("order", [1, 2, 3, 6])
def test_the_magnitude_is_that_of_the_textbook_filter(order: int) -> None:
    w, corner = 2 * np.pi * F, 2 * np.pi * 5e6
    for kind, design in (
        ("butterworth", sps.butter(order, corner, analog=True)),
        ("bessel", sps.bessel(order, corner, analog=True, norm="mag")),
        ("rc", ([1.0], np.poly(-np.ones(order) * corner) / corner**order)),
    ):
        params = LowPass(kind=kind, order=order, cutoff_mhz=5.0)
        np.testing.assert_allclose(gain(params), np.abs(sps.freqs(*design, w)[1]), rtol=1e-6)
    assert gain(LowPass(kind="butterworth", order=order))[2] == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize(
    ("params", "shift_px"),
    [
        (LowPass(kind="rc", order=1, cutoff_mhz=6.0), 0.376),
        (LowPass(kind="rc", order=1, cutoff_mhz=4.0), 0.564),
        (LowPass(kind="butterworth", cutoff_mhz=5.0), 0.903),
        (LowPass(kind="butterworth", cutoff_mhz=3.0), 1.505),
    ],
)
def test_published_shifts(params: LowPass, shift_px: float) -> None:
    assert delay_s(params) * PIXEL_HZ == pytest.approx(shift_px, abs=6e-4)
    before = video(row_of(bump()))
    shift = (centre(sampled(SOURCE.forward(params, before, None), 64)) - centre(sampled(before, 64)))[0, 0] / 64
    assert shift == pytest.approx(shift_px, rel=2e-3)


def test_an_all_pass_delays_without_changing_the_magnitude() -> None:
    plain, phased = (LowPass(kind="bessel", cutoff_mhz=5.0, all_pass_mhz=a) for a in (0.0, 8.0))
    np.testing.assert_allclose(gain(phased), gain(plain), rtol=1e-9)
    assert delay_s(phased) - delay_s(plain) == pytest.approx(2 / (2e6 * np.pi * 8.0))
    before = video(row_of(bump(sigma=6.0)))
    late = [centre(sampled(SOURCE.forward(p, before, None)))[0, 0] for p in (plain, phased)]
    assert late[1] - late[0] == pytest.approx(2 / (2e6 * np.pi * 8.0) * PIXEL_HZ, rel=0.03)


def test_a_bessel_filter_keeps_edges_straighter_than_a_butterworth_filter() -> None:
    """Overshoot of the step: 0.4 % against 15 % at order 5 (closed form of neither; SciPy's step response)."""
    for kind, design in (("bessel", sps.bessel), ("butterworth", sps.butter)):
        args = {"norm": "mag"} if kind == "bessel" else {}
        corner = 2 * np.pi * 3e6 / PIXEL_HZ
        t, y = sps.step(design(5, corner, analog=True, output="ba", **args), T=np.arange(0, 40, 0.125))
        got = sampled(SOURCE.forward(LowPass(kind=kind, order=5, cutoff_mhz=3.0), video(row_of(np.ones(40))), None), 4)[0, 0]
        assert got.max() == pytest.approx(y[1::2].max(), abs=2e-4)


def test_under_a_threshold_bright_and_faint_targets_come_apart(rng: np.random.Generator) -> None:
    """Only with a filter: what remains of the tail above a fixed level depends on the height."""

    def shift(params: LowPass) -> float:
        places = []
        for height in (1.0, 0.3):
            row = np.maximum(seen(rng, SOURCE, params, row_of(height * bump()))[0, 0] - 20.0, 0.0)
            places.append(centre(row))
        return places[0] - places[1]

    assert abs(shift(LowPass())) < 1e-3
    assert 0.01 < abs(shift(LowPass(kind="butterworth", cutoff_mhz=3.0))) < 0.2


def test_the_margin_holds_all_but_the_stated_share(rng: np.random.Generator) -> None:
    for params in (SOURCE.typical, SOURCE.bound, LowPass(kind="rc", order=3), LowPass(kind="bessel", order=8, cutoff_mhz=1.0)):
        for pixel_hz in (10e6, PIXEL_HZ, 28.4e6):
            left = near(params, pixel_hz, 0)[2]
            row = np.zeros(left + 60)
            row[:20] = 1.0
            beyond = np.abs(seen(rng, SOURCE, params, row_of(row), pixel_hz=pixel_hz)[0, 0, left + 20 :]).max()
            assert beyond < SOURCE.tail(params, pixel_hz, 0)
