"""Charge transfer: binomial closed forms, a packet-by-packet simulation, the mean shift, and the inversion."""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.signal import Kind, Windows
from pixmetry.core.errors import ParameterError
from pixmetry.sources.sensor.charge_transfer import SOURCE, ChargeTransfer, near, tail
from source_signals import K_DN_PER_E, centroid, flat, quiet, signal, spot_probe, spots


def impulse(row: int, after: int, params: ChargeTransfer, electrons: float = 10_000.0) -> np.ndarray:
    """What becomes of one packet in an empty column: the pixel itself and those that follow, float64."""
    data = np.zeros((1, after + 1, 1))
    data[0, 0, 0] = electrons
    frame = signal(data, row0=row, frame_shape=(row + after + 1, 1))
    return SOURCE.forward(params, frame, quiet()).data[0, :, 0].astype(float)


def test_share_that_is_left_after_2048_pixels_of_four_phases():
    out = impulse(2047, 60, ChargeTransfer(parallel_cti=1e-5, phases=4))
    assert out[0] / 10_000 == pytest.approx(0.92135, abs=5e-6)


@pytest.mark.parametrize("trail", [1.0, 2.0, 6.0])
@pytest.mark.parametrize("row", [99, 2047])
def test_mean_shift_is_transfers_times_loss_times_trail(trail, row):
    out = impulse(row, 400, ChargeTransfer(parallel_cti=1e-5, phases=4, trail_px=trail))
    assert out.sum() == pytest.approx(10_000, rel=1e-6)
    # the trail's stretch changes from row to row: over ⟨k⟩ pixels by ⟨k⟩/(2 row) of the second-order part
    assert (out * np.arange(401)).sum() / out.sum() == pytest.approx((row + 1) * 4 * 1e-5 * trail, rel=2e-3)


def clock_out(column: np.ndarray, loss: float, phases: int) -> np.ndarray:
    """Shift register simulated step by step: in each transfer every packet leaves a share that joins the packet behind it."""
    packets, out = column.astype(float).copy(), np.zeros(len(column))
    for step in range(1, len(column) * phases + 1):
        left = loss * packets
        packets = packets - left
        packets[1:] += left[:-1]
        if step % phases == 0:
            out[step // phases - 1] = packets[step // phases - 1]
            packets[step // phases - 1] = 0.0
    return out


def test_agrees_with_packets_clocked_one_by_one(rng: np.random.Generator):
    """Deferred charge within 2 % of itself, in a column of random packets that loses up to 12 % of each."""
    column = rng.uniform(0, 1000, 60) * (np.arange(60) % 7 == 0)
    out = SOURCE.forward(ChargeTransfer(parallel_cti=1e-3, phases=2), signal(column[None, :, None]), quiet()).data[0, :, 0]
    expected = clock_out(column, 1e-3, 2)
    moved = np.abs(expected - column).max()
    assert moved > 30 * (column.max() > 500)
    assert np.abs(out - expected).max() < 0.02 * moved


def test_parallel_trails_point_away_from_row_0_and_serial_ones_from_column_0():
    data = np.zeros((1, 50, 50))
    data[0, 20, 30] = 1e4
    down = SOURCE.forward(ChargeTransfer(parallel_cti=1e-3), signal(data), quiet()).data[0]
    along = SOURCE.forward(ChargeTransfer(serial_cti=1e-3), signal(data), quiet()).data[0]
    assert down[21, 30] > 100 and down[:20].max() == 0 and down[:, 31].max() == 0
    assert along[20, 31] > 100 and along[:, :30].max() == 0 and along[21].max() == 0
    assert down[20, 30] == pytest.approx(1e4 * (1 - 1e-3) ** 21, rel=1e-6)
    assert along[20, 30] == pytest.approx(1e4 * (1 - 1e-3) ** 31, rel=1e-6)


def test_small_packets_lose_more():
    """Lost charge goes with the packet to the power beta."""
    params = ChargeTransfer(parallel_cti=1e-6, beta=0.5, reference_e=10_000)
    lost = [(packet - impulse(99, 5, params, packet)[0]) for packet in (100.0, 10_000.0)]
    assert lost[1] == pytest.approx(10_000 * 100 * 1e-6, rel=2e-3)
    assert lost[0] == pytest.approx(lost[1] * 0.1, rel=2e-3)


def test_packets_below_zero_do_not_trouble_their_neighbours():
    data = np.full((1, 6, 2), 1000.0)
    clean = SOURCE.forward(ChargeTransfer(parallel_cti=1e-4, beta=0.5), signal(data), quiet()).data
    data[0, :, 0] = -5.0
    mixed = SOURCE.forward(ChargeTransfer(parallel_cti=1e-4, beta=0.5), signal(data), quiet()).data
    assert np.array_equal(mixed[0, :, 1], clean[0, :, 1])
    assert np.array_equal(mixed[0, :, 0], np.full(6, -5, np.float32))


@pytest.mark.parametrize("beta", [1.0, 0.7])
def test_inversion_brings_the_charge_back(beta, rng: np.random.Generator):
    params = ChargeTransfer(parallel_cti=1e-4, serial_cti=5e-5, trail_px=2.0, beta=beta, reference_e=5000)
    scene = signal(rng.uniform(500, 5000, (1, 300, 200)))
    moved = SOURCE.forward(params, scene, quiet())
    back = SOURCE.correct(params, moved, {})
    assert np.abs(moved.data - scene.data).max() > 50
    assert np.abs(back.data - scene.data).max() < 0.05


def test_loss_by_packet_cannot_be_corrected_in_dn():
    with pytest.raises(ParameterError, match="electrons"):
        SOURCE.correct(ChargeTransfer(parallel_cti=1e-5, beta=0.5), flat(1.0, (4, 4), kind=Kind.DN), {})


def test_context_is_a_column_or_the_frame():
    windows = Windows.one(10, 20, 5, 6)
    assert SOURCE.window_needed(SOURCE.neutral, windows, (100, 200)).equals(windows)
    column = SOURCE.window_needed(ChargeTransfer(parallel_cti=1e-5), windows, (100, 200))
    assert column.equals(Windows.one(0, 20, 100, 6))
    assert SOURCE.window_needed(SOURCE.typical, windows, (100, 200)).equals(Windows.one(0, 0, 100, 200))


def test_stated_tail_bounds_what_comes_from_beyond_the_near_context():
    for trail in (1.0, 3.0):
        params = ChargeTransfer(parallel_cti=1e-5, trail_px=trail)
        reach = near(params)[0]
        beyond = impulse(4095, 400, params)[reach + 1 :].sum() / 10_000
        assert beyond < tail(params) < 4 * beyond


def test_shift_of_a_spot_at_the_centre_and_over_the_frame():
    """P5 by direct simulation at three rows: the shift at the centre is the bias, and 1/√3 of it the spread of evenly placed targets."""
    params, probe = ChargeTransfer(parallel_cti=2e-5, trail_px=2.0), spot_probe()
    got = SOURCE.propagate(params, probe)
    assert got.bias_y_px == pytest.approx(240 * 2e-5 * 2, rel=0.02)
    assert got.bias_x_px == pytest.approx(0, abs=1e-5)
    x = y = np.array([30.0])
    image = spots(x, y, size=61) / K_DN_PER_E
    rows = np.arange(0, 480 - 60, 20)
    shifts = []
    for row0 in rows:
        frame = signal(image, row0=int(row0), frame_shape=(480, 640))
        shifts.append(centroid(SOURCE.forward(params, frame, quiet()).data.astype(float))[1][0] - 30)
    expected = (rows + 31) * 2e-5 * 2
    assert np.allclose(shifts, expected, rtol=0.02)
    assert got.u_y_px == pytest.approx(got.bias_y_px / np.sqrt(3), rel=0.02)


def test_handbook_numbers():
    """Shift after 752 and 8192 transfers at 1e-5 for trails of one pixel: 0.0075 and 0.082 px."""
    for steps, phases, shift in ((752, 1, 0.0075), (2048, 4, 0.0819)):
        out = impulse(steps - 1, 100, ChargeTransfer(parallel_cti=1e-5, phases=phases))
        assert (out * np.arange(101)).sum() / out.sum() == pytest.approx(shift, abs=1e-4)


@pytest.mark.parametrize("trail", [1.0, 2.5])
def test_delays_follow_their_law_exactly(trail):
    """Shares that arrive 0, 1, 2, … pixels late: n geometric sums, by convolution of their laws one after the other."""
    n, loss, length = 40, 0.005, 60
    waits = np.zeros(length)
    waits[1:] = (1 / trail) * (1 - 1 / trail) ** np.arange(length - 1)
    one = np.zeros(length)  # one transfer: falls behind again and again, each time for a geometric time
    power = np.eye(1, length)[0]
    for k in range(12):
        one += (1 - loss) * loss**k * power
        power = np.convolve(power, waits)[:length]
    law = np.eye(1, length)[0]
    for _ in range(n):
        law = np.convolve(law, one)[:length]
    out = impulse(n - 1, length - 1, ChargeTransfer(parallel_cti=loss, trail_px=trail))
    assert out / 10_000 == pytest.approx(law, abs=2e-7)
    if trail == 1:
        assert out[:3] / 10_000 == pytest.approx((1 - loss) ** n * np.array([1, n * loss, n * (n + 1) / 2 * loss**2]), rel=1e-5)


def test_register_and_columns_do_the_same_and_columns_come_first(rng: np.random.Generator):
    data = rng.uniform(0, 5000, (2, 40, 40))
    for extra in ({}, {"beta": 0.6}):
        down = SOURCE.forward(ChargeTransfer(parallel_cti=2e-3, **extra), signal(data), quiet()).data
        along = SOURCE.forward(ChargeTransfer(serial_cti=2e-3, **extra), signal(data.swapaxes(1, 2)), quiet()).data
        assert along.swapaxes(1, 2) == pytest.approx(down, rel=1e-6)
        both = SOURCE.forward(ChargeTransfer(parallel_cti=2e-3, serial_cti=1e-3, **extra), signal(data), quiet()).data
        after = SOURCE.forward(ChargeTransfer(serial_cti=1e-3, **extra), signal(down), quiet()).data
        assert np.array_equal(both, after)


def test_least_of_the_stated_range_keeps_next_to_nothing():
    """0.9995^(2048·4) = 1.7 %, 0.99999^(2048) = 97.97 %."""
    assert impulse(2047, 40, ChargeTransfer(parallel_cti=5e-4, phases=4))[0] / 10_000 == pytest.approx(0.0166, abs=1e-4)
    assert impulse(2047, 40, ChargeTransfer(parallel_cti=1e-5))[0] / 10_000 == pytest.approx(0.9797, abs=1e-4)


def over_traps(column: np.ndarray, density: list[float], release: list[float], beta: float, well: float) -> np.ndarray:
    """Every packet over every pixel's traps one after the other; the traps of a pixel in 4000 heights, each full or less."""
    packets, height = column.astype(float).copy(), (np.arange(4000) + 0.5) / 4000
    for pixel in range(len(column)):
        full = np.zeros((len(density), len(height)))
        for r in range(pixel, len(column)):
            for s, (rho, tau) in enumerate(zip(density, release, strict=True)):
                freed = full[s] * -np.expm1(-1 / tau)
                full[s] -= freed
                packets[r] += rho * freed.mean()
            inside = height < (max(packets[r], 0) / well) ** beta
            for s, rho in enumerate(density):
                packets[r] -= rho * (1 - full[s][inside]).sum() / len(height)
                full[s][inside] = 1.0
    return packets


@pytest.mark.parametrize(("density", "release"), [([0.5], [4.0]), ([0.6, 0.3], [1.0, 8.0])], ids=["one species", "fast and slow"])
def test_traps_agree_with_every_packet_over_every_pixel(density, release, rng: np.random.Generator):
    """Within 2 % of what is moved, in columns with single packets, steps and random ones."""
    columns = np.zeros((70, 4))
    columns[10, 0], columns[40, 0] = 20_000, 5000
    columns[30:50, 1] = 8000
    columns[:, 2] = rng.uniform(500, 20_000, 70)
    columns[:, 3], columns[35, 3] = 300, 30_000
    params = ChargeTransfer(
        fast_traps_per_px=density[0] if len(density) > 1 else 0, fast_release_px=release[0], slow_traps_per_px=density[-1],
        slow_release_px=release[-1], fill_beta=0.6, trap_well_e=50_000,
    )  # fmt: skip
    out = SOURCE.forward(params, signal(columns[None]), quiet()).data[0].astype(float)
    for c in range(4):
        expected = over_traps(columns[:, c], density, release, 0.6, 50_000)
        moved = np.abs(expected - columns[:, c]).max()
        assert moved > 1
        assert np.abs(out[:, c] - expected).max() < 0.02 * moved + 2e-3, c


def test_traps_keep_the_charge_and_trail_exponentially():
    data = np.zeros((1, 400, 1))
    data[0, 50] = 10_000
    params = ChargeTransfer(slow_traps_per_px=1.0, slow_release_px=10.0)
    out = SOURCE.forward(params, signal(data), quiet()).data[0, :, 0].astype(float)
    caught = 51 * (10_000 / 100_000) ** 0.5
    assert out.sum() == pytest.approx(10_000, rel=1e-6)
    assert 10_000 - out[50] == pytest.approx(caught, rel=1e-3)
    k = np.arange(1, 15)  # farther on the trail's own small packets have been caught again
    assert out[51:65] == pytest.approx(caught * (1 - np.exp(-0.1)) * np.exp(-0.1 * (k - 1)), rel=0.03)


def test_a_background_fills_the_traps():
    """Behind packets that keep the traps full a target loses less: the fat zero."""
    data = np.zeros((1, 300, 2))
    data[0, :, 1] = 500
    data[0, 200, :] += 3000
    out = SOURCE.forward(ChargeTransfer(slow_traps_per_px=2.0), signal(data), quiet()).data[0].astype(float)
    lost = data[0, 200] - out[200]
    assert lost[1] < 0.75 * lost[0]


def test_traps_never_take_more_than_there_is(rng: np.random.Generator):
    data = np.abs(rng.normal(0, 20, (1, 500, 20)))
    out = SOURCE.forward(ChargeTransfer(slow_traps_per_px=50.0, traps_along="both"), signal(data), quiet()).data
    assert out.min() >= -1e-4 and out.sum() < data.sum() * (1 + 1e-6)


def test_traps_are_undone_by_the_inversion_and_reach_as_far_as_stated(rng: np.random.Generator):
    params = ChargeTransfer(slow_traps_per_px=1.0, fast_traps_per_px=1.0, traps_along="both")
    scene = signal(rng.uniform(500, 5000, (1, 200, 150)))
    moved = SOURCE.forward(params, scene, quiet())
    assert np.abs(moved.data - scene.data).max() > 10
    assert np.abs(SOURCE.correct(params, moved, {}).data - scene.data).max() < 0.2
    assert near(params)[0] == near(params)[2] == 70  # 10 px · ln 1000
    windows = Windows.one(10, 20, 5, 6)
    assert SOURCE.window_needed(ChargeTransfer(slow_traps_per_px=1.0), windows, (100, 200)).equals(Windows.one(0, 20, 100, 6))
