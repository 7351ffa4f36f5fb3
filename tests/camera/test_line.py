"""The video line against SciPy's simulation of analogue filters, closed forms, and staircases evaluated point by point."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal as sps

from catalogue.support import NAME, Flat, Targets, Texture, camera_with, make_source
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import get_source
from pixmetry.camera.line import Line, correlated_rows, group_delay_s, reach_px
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Parameters
from pixmetry.core.errors import ParameterError
from pixmetry.core.random import Grid
from pixmetry.sources.cable.termination import Termination

F = 14.1875e6
RNG = np.random.default_rng(5)
FILTERS = {
    "rc": ([], [-2 * np.pi * 6e6]),
    "three equal": ([], [-2 * np.pi * 4e6] * 3),
    "butterworth 5": ([], 2 * np.pi * 5e6 * np.exp(1j * np.pi * (0.5 + (np.arange(5) + 0.5) / 5))),
    "ringing": ([], 2 * np.pi * 5e6 * np.array([-0.2 + 0.98j, -0.2 - 0.98j])),
    "lead": ([-2 * np.pi * 3e6], [-2 * np.pi * 8e6]),
    "all-pass": ([2 * np.pi * 7e6, 2e7 + 3e7j, 2e7 - 3e7j], [-2 * np.pi * 7e6, -2e7 + 3e7j, -2e7 - 3e7j]),
    "one zero of two poles": ([-4e7], [-3e7 + 5e7j, -3e7 - 5e7j]),
    "zeros on real poles": ([1e7 + 9e7j, 1e7 - 9e7j], [-2e7, -5e7, -9e7]),
    "slow and fast": ([], [-2 * np.pi * 0.05e6, -2 * np.pi * 200e6]),
}


def sampled(line: Line, row: np.ndarray, first: int = 0, cols: int | None = None, col0: int = 0) -> np.ndarray:
    cols = cols or (line.samples or len(row))
    grid = Grid(np.zeros(1), np.zeros(1), np.array([col0]), (1, cols))
    return line.read(np.asarray(row, np.float32)[None, None], np.array([first]), grid)[0, 0].astype(float)


def held(row: np.ndarray, t_px: np.ndarray) -> np.ndarray:
    """The staircase at some times, in pixel periods."""
    at = np.floor(t_px).astype(int)
    inside = (at >= 0) & (at < len(row))
    return np.where(inside, row[np.clip(at, 0, len(row) - 1)], 0.0)


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_agrees_with_a_fine_simulation(name: str) -> None:
    """`lsim` holds its input between fine steps, which is exact for a staircase; read at each of 8 parts of the pixel."""
    zeros, poles = (np.asarray(v, complex) for v in FILTERS[name])
    gain = (np.prod(-poles) / np.prod(-zeros)).real
    row = np.concatenate([RNG.uniform(0, 200, 40), np.zeros(8)]).astype(np.float32).astype(float)
    t = np.arange(48 * 8 + 1) / 8
    system = sps.ZerosPolesGain(zeros / F, poles / F, gain / F ** (len(poles) - len(zeros)))
    _, y, _ = sps.lsim(system, held(row, t + 1e-9), t, interp=False)
    line = Line(F, 8 * F).filtered(zeros, poles).clocked(8 * F, 0.0, 48 * 8)
    got = sampled(line.clocked(8 * F, -0.5 / (8 * F) + 1e-18, 48 * 8), row)
    smooth = len(zeros) < len(poles)  # with as many zeros as poles the output jumps with the input, exactly at these times
    keep = np.ones(len(got), bool) if smooth else np.arange(len(got)) % 8 != 0
    np.testing.assert_allclose(got[keep], y[:-1][keep], atol=3e-5, rtol=1e-6)


LETS_STEPS_THROUGH = {"none": ([], []), "lead": FILTERS["lead"], "all-pass": FILTERS["all-pass"]}


@pytest.mark.parametrize("name", LETS_STEPS_THROUGH)
def test_a_line_that_nothing_limits_goes_by_ramps(name: str) -> None:
    """Straight from one pixel's middle to the next, by NumPy and SciPy: two echoes and a late row, through filters that let steps pass."""
    zeros, poles = (np.asarray(v, complex) for v in LETS_STEPS_THROUGH[name])
    row, delay, amplitude, late = RNG.uniform(0, 200, 60), np.array([0.0, 0.31, 2.7]) / F, np.array([0.9, 0.2, -0.1]), 5e-9
    line = Line(F, F).echoed(delay, amplitude).delayed(np.full((1, 1), late))
    fine = 1000
    t = np.arange(61 * fine + 1) / fine - 1
    levels = np.interp(t, np.arange(-1, 61) + 0.5, np.concatenate([[0.0], row, [0.0]]))
    if len(poles):
        line = line.filtered(zeros, poles)
        gain = (np.prod(-poles) / np.prod(-zeros)).real
        _, levels, _ = sps.lsim(sps.ZerosPolesGain(zeros / F, poles / F, gain), levels, t + 1)
    at = (np.arange(60) + 0.5 - late * F)[:, None] - delay * F
    expected = (amplitude * np.interp(at, t, levels, left=0.0)).sum(axis=1)
    limited = line.limited()
    assert limited.ramps
    np.testing.assert_allclose(sampled(limited, row), expected, atol=2e-4)


def test_a_line_that_a_filter_limits_is_left_as_it_is() -> None:
    for name in ("rc", "ringing", "one zero of two poles", "slow and fast"):
        line = Line(F, F).filtered(*FILTERS[name])
        assert line.limited() is line


def test_equal_poles_have_their_closed_form() -> None:
    """Three equal RC filters: 1 − e^(−t/τ)(1 + t/τ + (t/τ)²/2)."""
    tau = 0.8 / F
    line = Line(F, F).filtered([], [-1 / tau] * 3)
    t = (np.arange(30) + 0.5) / 0.8
    np.testing.assert_allclose(sampled(line, np.full(30, 100.0)), 100 * (1 - np.exp(-t) * (1 + t + t**2 / 2)), atol=1e-5)


def test_filters_of_one_kind_each_are_as_one_filter() -> None:
    poles = 2 * np.pi * 4e6 * np.exp(1j * np.pi * (0.5 + (np.arange(4) + 0.5) / 4))
    row = RNG.uniform(0, 200, 60)
    pairs = (poles[[0, 3]], poles[[1, 2]])
    one = Line(F, F).filtered([], poles)
    two = Line(F, F).filtered([], pairs[0]).filtered([], pairs[1])
    np.testing.assert_allclose(sampled(one, row), sampled(two, row), atol=2e-5)


def test_after_the_last_pixel_it_is_black_and_the_filter_goes_on() -> None:
    line = Line(F, F).filtered([], [-0.5 * F]).clocked(F, 0.0, 400)
    got = sampled(line, np.full(20, 100.0))
    top = 100 * (1 - np.exp(-0.5 * 20))
    np.testing.assert_allclose(got[20:], top * np.exp(-0.5 * (np.arange(20, 400) + 0.5 - 20)), atol=1e-5)


def test_another_clock_echoes_and_late_rows_against_the_staircase_itself() -> None:
    """Without a filter every sample is a sum of held pixels at t_k − delay of the row − delay of the echo."""
    row, delay, amplitude = RNG.uniform(0, 200, 90), np.array([0.0, 0.31, 2.7]) / F, np.array([0.9, 0.2, -0.1])
    late = lambda grid: np.broadcast_to([0.0, 11e-9, -23e-9], (1, 3))  # noqa: E731
    line = Line(F, F).echoed(delay, amplitude).clocked(10e6, 40e-9, 60).delayed(late).delayed(np.array([[5e-9]]))
    grid = Grid(np.zeros(1), np.zeros(1), np.zeros(1), (3, 60))
    got = line.read(np.repeat(row[None, None], 3, axis=1).astype(np.float32), np.zeros(1), grid)[0]
    for r, d in enumerate((5e-9, 16e-9, -18e-9)):
        t = (40e-9 + (np.arange(60) + 0.5) / 10e6 - d)[:, None] - delay
        np.testing.assert_allclose(got[r], (amplitude * held(row, t * F)).sum(axis=1), rtol=1e-6, atol=1e-4)


def test_echoes_of_echoes_are_all_their_sums() -> None:
    row = RNG.uniform(0, 200, 50)
    line = Line(F, F).echoed([0, 1.2 / F], [1.0, 0.3]).echoed([0, 2.1 / F], [1.0, -0.2])
    t = np.arange(50) + 0.5
    expected = sum(a * held(row, t - d) for d, a in ((0, 1.0), (1.2, 0.3), (2.1, -0.2), (3.3, -0.06)))
    np.testing.assert_allclose(sampled(line, row), expected, atol=1e-4)


def test_a_warp_is_a_delay_that_grows_along_the_line() -> None:
    """A sampling clock that is fast by a hundredth reads at t/1.01."""
    row = np.arange(300.0)
    line = Line(F, F).warped(lambda t: t * 0.01 / 1.01)
    np.testing.assert_array_equal(sampled(line, row), np.floor((np.arange(300) + 0.5) / 1.01))


@pytest.mark.parametrize("name", FILTERS)
def test_a_target_comes_later_by_the_group_delay(name: str) -> None:
    zeros, poles = FILTERS[name]
    fine = 64
    line = Line(F, F).filtered(zeros, poles).clocked(fine * F, 0.0, fine * 600)
    target = 100 * np.exp(-0.5 * ((np.arange(600) - 60) / 3.0) ** 2)
    seen, x = sampled(line, target), (np.arange(fine * 600) + 0.5) / fine - 0.5
    w, delay = 1e3, group_delay_s(zeros, poles)
    h = [np.prod([1 - s / z for z in zeros]) / np.prod([1 - s / p for p in poles]) for s in (1j * w, -1j * w)]
    assert delay == pytest.approx(-(np.angle(h[0]) - np.angle(h[1])) / (2 * w), rel=1e-5)
    assert (seen * x).sum() / seen.sum() - 60 == pytest.approx(delay * F, rel=2e-4, abs=2e-4)
    assert line.delay_s == delay


@pytest.mark.parametrize(
    ("poles_mhz", "centroid_px", "mid_hold_px"),
    [([-6], 0.376, 0.28), ([-4], 0.564, 0.50), (5, 0.903, 0.90), (3, 1.505, 1.50)],
    ids=["RC 6 MHz", "RC 4 MHz", "Butterworth-3 5 MHz", "Butterworth-3 3 MHz"],
)
def test_published_delays_of_low_pass_filters(poles_mhz: object, centroid_px: float, mid_hold_px: float) -> None:
    """At 14.1875 MHz: τ, 2/ω_c; a staircase sampled in the middle of its pixels shows 1/(2 sinh(1/(2τ))) for the RC filter."""
    poles = np.array(poles_mhz) if isinstance(poles_mhz, list) else poles_mhz * np.exp(2j * np.pi * np.array([1 / 3, 1 / 2, 2 / 3]))
    line = Line(F, F).filtered([], 2e6 * np.pi * poles)
    target, x = 100 * np.exp(-0.5 * ((np.arange(400) - 60) / 3.0) ** 2), np.arange(400)
    seen = sampled(line, target)
    shift = (seen * x).sum() / seen.sum() - 60
    assert line.delay_s * F == pytest.approx(centroid_px, abs=6e-4)
    assert shift == pytest.approx(mid_hold_px, abs=0.015)  # as published, to two digits; exactly: Σ (1 − s(n + ½)), s by SciPy
    scaled = 2e6 * np.pi * poles / F
    _, rise = sps.step(sps.ZerosPolesGain([], scaled, np.prod(-scaled).real), T=np.arange(0, 40, 0.5))
    assert shift == pytest.approx((1 - rise[1::2]).sum(), abs=2e-5)
    if len(poles) == 1:
        assert shift == pytest.approx(0.5 / np.sinh(0.5 / (line.delay_s * F)), rel=1e-5)


def test_a_part_of_the_row_is_read_as_in_the_whole_where_the_rest_is_black() -> None:
    row = np.zeros(200)
    row[100:130] = RNG.uniform(0, 200, 30)
    line = Line(F, F).filtered(*FILTERS["ringing"]).echoed([0, 1.7 / F], [0.9, 0.1]).clocked(10e6, 30e-9, 140)
    whole = sampled(line, row)
    assert np.array_equal(sampled(line, row[80:150], first=80, cols=40, col0=60), whole[60:100])


def test_what_is_left_beyond_the_reach_is_as_small_as_asked() -> None:
    for name in FILTERS:
        zeros, poles = FILTERS[name]
        reach = reach_px(zeros, poles, 1e-4)
        row = np.zeros(reach + 40)
        row[:10] = 1.0
        assert np.abs(sampled(Line(F, F).filtered(zeros, poles), row)[10 + reach :]).max() < 1e-4, name


@pytest.mark.parametrize(
    ("zeros", "poles"), [([], [1e6]), ([], []), ([0.0], [-1e6]), ([-1e6, -2e6], [-1e6]), ([], [-1e6 + 1e6j]), ([1j * 1e6], [-1e6, -2e6])]
)
def test_filters_that_make_no_sense_are_refused(zeros: list, poles: list) -> None:
    with pytest.raises(ParameterError):
        Line(F, F).filtered(zeros, poles)


def test_rows_that_are_alike_are_a_moving_sum() -> None:
    white, weights = RNG.normal(size=(3, 40)), np.array([0.5, 0.3, 0.2])
    expected = [np.convolve(w, weights, mode="valid") for w in white]
    np.testing.assert_allclose(correlated_rows(white, weights), expected, atol=1e-12)
    np.testing.assert_allclose(correlated_rows(white, weights, 2)[:, ::2], [np.convolve(w[::2], weights, mode="valid") for w in white])


# ---- in a camera -----------------------------------------------------------------------------------------------------------------


class Nothing(Parameters):
    """No parameter."""


def on_line(id: str, change, **kw) -> Element:
    source = make_source(id, lambda p, s, stream: s.with_line(change(s, stream)), (Kind.VIDEO,), **kw)
    return Element(id, source, Nothing())


def jittered(s, stream):
    return s.line.delayed(lambda grid: 30e-9 * stream.normal_rows(grid))


def noisy(s, stream):
    return s.line.with_noise(lambda grid, line: stream.normal(grid))


REACH = {"near": lambda p, hz, px: (0, 0, 60, 0), "tail": lambda p, hz, px: 1e-4}
RINGING = on_line("electronics.ringing", lambda s, _: s.line.filtered(*FILTERS["ringing"]), **REACH)
CLOCK = on_line("grabber.clock", lambda s, _: s.line.clocked(10e6, 100e-9, 50))
CLOCK_320 = on_line("grabber.clock", lambda s, _: s.line.clocked(10e6, 100e-9, 230))
JITTER = on_line("grabber.jitter", jittered, near=lambda p, hz, px: (0, 0, 3, 3), tail=lambda p, hz, px: 0.0)
NOISE = on_line("storage.noise", noisy)
SHAPE = (48, 64)


def video_camera(*elements: Element, shape: tuple[int, int] = SHAPE) -> Camera:
    first = elements[0]
    return camera_with(first.source, first.params, shape=shape, after=elements[1:])


def test_a_window_of_the_samples_equals_the_crop() -> None:
    camera = video_camera(RINGING, CLOCK, JITTER, NOISE)
    whole = camera.expose(Texture(), 2, seed=3).data
    assert whole.shape == (2, 48, 50) and camera.output_shape == (48, 50)
    for r, c, h, w in ((0, 0, 9, 7), (20, 13, 11, 30), (47, 49, 1, 1), (3, 40, 20, 10)):
        assert np.array_equal(camera.expose(Texture(), 2, seed=3, window=(r, c, h, w)).data, whole[:, r : r + h, c : c + w])


@pytest.mark.parametrize("delay_ns", [0.5, 5.0, 40.0])
def test_every_delay_is_seen_without_any_filter(delay_ns: float) -> None:
    """What is late by δ is seen δ later, however small δ is: to 1e-4 of it, and 2e-6 px that float32 leaves. (A bare staircase shows 0.)"""
    late = on_line("grabber.late", lambda s, _: s.line.delayed(np.full((1, 1), delay_ns * 1e-9)))
    camera, x = video_camera(late), np.arange(64)
    spot = Targets(np.array([30.3]), np.array([24.0]), background_dn=0.0)
    frames = [c.expose(spot, 1, quiet=True).data[0].astype(float) for c in (camera, camera.switched(off=[NAME]))]
    centres = [(f * x).sum() / f.sum() for f in frames]
    assert centres[0] - centres[1] == pytest.approx(delay_ns * 1e-9 * F, rel=1e-4, abs=2e-6)


def test_echoes_of_a_short_cable_are_seen_without_any_filter() -> None:
    """2 m of 50 Ω cable: Δx = ρτ/(1 − ρ) = 0.0119 px; and without a source on the line the pixels are as they were."""
    camera = camera_with(get_source("cable.termination"), Termination(length_m=2.0, line_ohm=50.0))
    spot = Targets(np.array([30.3]), np.array([24.0]), background_dn=0.0)
    frames = [c.expose(spot, 1, quiet=True).data[0].astype(float) for c in (camera, camera.switched(off=[NAME]))]
    centres = [(f * np.arange(64)).sum() / f.sum() for f in frames]
    assert centres[0] - centres[1] == pytest.approx(0.04 / 0.96 * 2.0 * 2 / (0.66 * 299_792_458.0) * F, rel=1e-4, abs=2e-6)
    neutral = camera_with(get_source("cable.termination"), Termination())
    assert np.array_equal(neutral.expose(spot, 1, quiet=True).data, neutral.switched(off=[NAME]).expose(spot, 1, quiet=True).data)


def test_delays_belong_to_their_rows_however_the_frame_is_cut() -> None:
    """After a source that looks down the column the line is made by columns and read by rows."""
    down = make_source(
        "electronics.down",
        lambda p, s, _: s.with_data(np.cumsum(s.data, axis=1, dtype=np.float32) / 40),
        (Kind.DN,),
        context=lambda p, w, shape: w.full_columns(shape),
    )
    camera = video_camera(Element("down", down, Nothing()), JITTER, CLOCK, shape=(300, 400))
    whole = camera.expose(Texture(), 1, seed=3).data
    assert np.array_equal(camera.expose(Texture(), 1, seed=3, window=(100, 20, 50, 30)).data, whole[:, 100:150, 20:50])
    assert np.array_equal(camera.expose(Texture(), 1, seed=3, threads=1).data, whole)


def test_places_are_followed_through_the_clock() -> None:
    """A spot at pixel x is seen at sample ((x + ½)/f_pixel − start) f_sample − ½."""
    camera = video_camera(CLOCK)
    x, y = camera.true_positions(np.array([10.0, 50.0]), np.array([5.0, 6.0]))
    np.testing.assert_allclose(x, ((np.array([10.5, 50.5]) / F) - 100e-9) * 10e6 - 0.5)
    np.testing.assert_array_equal(y, [5.0, 6.0])


def test_geometry_of_the_sampling_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    counted = on_line("grabber.counted", lambda s, _: (calls.append(1), s.line.filtered(*FILTERS["rc"]))[1])
    camera = video_camera(counted, shape=(400, 752))
    camera.expose(Texture(), 1, threads=1)
    per_band = len(calls)
    grid = Grid(np.zeros(50), np.arange(50), np.arange(50), (11, 11))
    camera.expose_windows(Texture(), grid)
    assert len(calls) - per_band <= 2  # one batch of windows, and no geometry again


def test_the_near_context_suffices_and_noise_is_not_taken_out_again() -> None:
    """The mode `frozen` on a ringing line: noise and jitter stay, and what is left out is below the stated share of the signal."""
    camera = video_camera(RINGING, JITTER, CLOCK_320, NOISE, shape=(96, 320))
    rows, cols = np.repeat([0, 30, 85], 4), np.tile([0, 70, 150, 219], 3)
    grid = Grid(np.arange(12), rows, cols, (11, 11))
    exact = camera.expose_windows(Texture(), grid, seed=4)
    frozen = camera.expose_windows(Texture(), grid, seed=4, mode="frozen", background=Flat(110.0))
    assert np.abs(frozen - exact).max() < 200 * camera.frozen_tail()
    quiet = video_camera(RINGING, JITTER, CLOCK_320, shape=(96, 320)).expose_windows(Texture(), grid, seed=4)
    assert 0.8 < np.std(exact - quiet) < 1.2


def test_true_positions_follow_the_clock_as_it_warms_up() -> None:
    """Samples that look at the place, by the exact staircase: the column whose reading time is that of the pixel's middle."""
    from pixmetry.camera.camera import load_camera

    camera = load_camera("pulnix_tm6cn_epix_512")
    clock = camera["grabber.clock_warm_up"].params
    x = np.array([50.0, 376.0, 700.0])
    for frame, period in ((0, 60.0), (10, 60.0), (90, 60.0)):
        seen, _ = camera.true_positions(x, np.full(3, 300.0), frame=frame, frame_period_s=period)
        bent, _ = camera.switched(off=["grabber.clock_warm_up"]).true_positions(x, np.full(3, 300.0), frame=frame, frame_period_s=period)
        scale = clock.scale_error_rel * np.exp(-frame * period / clock.scale_tau_s)
        lock = clock.lock_us * 1e-6 * 10e6  # samples between the lock and the first pixel
        assert np.allclose(seen - bent, (bent + 0.5 + lock) * scale, atol=1e-6)
