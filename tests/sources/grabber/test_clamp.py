"""The clamp: droop against SciPy's high-pass, published swings of clipped spots, and noise of the rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal as sps

from pixmetry.camera.signal import Kind, Windows
from pixmetry.sources.grabber.clamp import SOURCE, Clamp
from source_signals import Z, flat, signal, stream


def clamped(rng: np.random.Generator, params: Clamp, data: np.ndarray, **kw: object) -> np.ndarray:
    return SOURCE.forward(params, signal(data, Kind.DN, **kw), stream(rng)).data.astype(float)


def test_the_droop_is_an_analogue_high_pass(rng: np.random.Generator) -> None:
    """s/(s + 1/τ) by `lsim` on the held pixels, read in their middle; τ from what is left at the end of the line."""
    row = np.random.default_rng(2).uniform(0, 200, 100).astype(np.float32)
    tau = -100 / np.log(1 - 0.3)
    t = np.arange(801) / 8
    _, y, _ = sps.lsim(([1.0, 0.0], [1.0, 1 / tau]), np.append(np.repeat(row, 8), row[-1]).astype(float), t, interp=False)
    got = clamped(rng, Clamp(droop_rel=0.3), row[None, None])[0, 0]
    np.testing.assert_allclose(got, y[4::8][:100], rtol=2e-5, atol=2e-4)


def test_a_constant_level_has_lost_the_stated_share_at_the_end_of_the_line(rng: np.random.Generator) -> None:
    got = clamped(rng, Clamp(droop_rel=0.2), np.full((1, 2, 1000), 100.0))[0, 0]
    assert got[-1] == pytest.approx(80.0, rel=1e-3) and got[0] == pytest.approx(100.0, rel=2e-4)


def test_a_bright_bar_leaves_a_dark_streak_to_its_right_only(rng: np.random.Generator) -> None:
    row = np.zeros(400)
    row[100:200] = 200.0
    got = clamped(rng, Clamp(droop_rel=0.05), row[None, None])[0, 0]
    assert (got[:100] == 0).all()
    assert got[200] == pytest.approx(-200 * (1 - 0.95 ** (100 / 400)), rel=2e-3)
    assert (np.diff(got[200:]) > 0).all()


def test_the_correction_undoes_droop_offset_and_drift(rng: np.random.Generator) -> None:
    row = np.random.default_rng(3).uniform(0, 200, (2, 3, 80))
    params = Clamp(offset_dn=-4.0, drift_dn_per_k=0.3, droop_rel=0.2)
    out = SOURCE.forward(params, signal(row, Kind.DN, temperature_c=[15.0, 31.0]), stream(rng))
    np.testing.assert_allclose(SOURCE.correct(params, out, {}).data, row, atol=1e-3)


def test_black_follows_the_temperature(rng: np.random.Generator) -> None:
    got = clamped(
        rng, Clamp(offset_dn=2.0, drift_dn_per_k=-0.5, reference_temperature_c=25.0), np.zeros((2, 1, 4)), temperature_c=[25.0, 31.0]
    )
    np.testing.assert_allclose(got[:, 0, 0], [2.0, -1.0])


def test_noise_is_common_to_a_row_and_new_in_every_frame(rng: np.random.Generator) -> None:
    out = SOURCE.forward(Clamp(noise_dn=0.5), flat(10.0, (300, 6), n=20, kind=Kind.DN), stream(rng)).data.astype(float) - 10
    assert (np.ptp(out, axis=2) < 1e-5).all()
    rows = out[:, :, 0]
    assert rows.var() == pytest.approx(0.25, rel=Z * np.sqrt(2 / rows.size) * 1.05)  # a factor of 1.1 would be seen
    assert abs(np.corrcoef(rows[0], rows[1])[0, 1]) < Z / np.sqrt(300)


def test_published_swing_of_a_spot_whose_foot_is_cut_off(rng: np.random.Generator) -> None:
    """Gaussian spot, σ = 1.5 px, 150 DN, black 6 DN below code 0, 41 samples a row: amplitude 0.0075 px over the pixel, 0.0004 at 4 DN."""
    phase = np.linspace(-1.5, 1.5, 500)
    x = np.arange(41) - 20.0
    spots = 150 * np.exp(-0.5 * ((x - phase[:, None]) / 1.5) ** 2)
    for offset, amplitude in ((-6.0, 0.0075), (-4.0, 0.0004), (-10.0, 0.002)):
        cut = np.maximum(clamped(rng, Clamp(offset_dn=offset), spots[None])[0], 0.0)
        error = (cut * x).sum(axis=1) / cut.sum(axis=1) - phase
        found = 2 * np.abs((error * np.exp(2j * np.pi * phase)).mean())
        assert found == pytest.approx(amplitude, abs=3e-4), offset


@pytest.mark.parametrize("interlaced", [False, True])
def test_a_slow_clamp_hands_its_error_on_to_the_next_line(interlaced: bool, rng: np.random.Generator) -> None:
    """Lines one after the other in time as one high-pass whose state loses 70 % between them, by matrix exponentials of `lsim`'s system."""
    frame = np.random.default_rng(4).uniform(0, 200, (8, 60)).astype(np.float32)
    params = Clamp(droop_rel=0.4, restored_rel=0.7, interlaced=interlaced)
    tau = -60 / np.log(1 - 0.4)
    want = np.empty(frame.shape)
    for rows in (range(0, 8, 2), range(1, 8, 2)) if interlaced else (range(8),):
        state = 0.0
        for r in rows:
            t = np.arange(481) / 8
            held = np.append(np.repeat(frame[r], 8), frame[r, -1]).astype(float)
            system = tuple(np.array([[v]]) for v in (-1 / tau, 1 / tau, -1.0, 1.0))
            _, y, x = sps.lsim(system, held, t, state, interp=False)
            want[r] = y[4::8][:60]
            state = 0.3 * float(np.ravel(x)[-1])
    out = SOURCE.forward(params, signal(frame[None], Kind.DN), stream(rng))
    np.testing.assert_allclose(out.data[0], want, rtol=3e-5, atol=3e-4)
    np.testing.assert_allclose(SOURCE.correct(params, out, {}).data[0], frame, atol=1e-3)
    assert np.abs(clamped(rng, Clamp(droop_rel=0.4), frame[None])[0] - want)[2:].max() > 3


def test_a_bright_target_leaves_a_shadow_on_the_lines_below_it(rng: np.random.Generator) -> None:
    frame = np.zeros((20, 100))
    frame[4:6, 40:60] = 200.0
    got = clamped(rng, Clamp(droop_rel=0.1, restored_rel=0.5), frame[None])[0]
    assert (got[:4] == 0).all()
    ends = got[:, -1]
    assert (ends[6:] < 0).all()
    assert ends[8] / ends[6] == pytest.approx(0.5 * 0.9, rel=0.02)  # half is restored, a tenth of the rest decays along the line


def test_noise_of_a_slow_clamp_is_alike_from_line_to_line_of_a_field(rng: np.random.Generator) -> None:
    """b_l = (1 − k) b_(l−1) + k n_l: correlation 1 − k between lines of a field, none between fields.

    400 frames of 300 rows; a correlation that is 0.03 off would be seen.
    """
    params = Clamp(noise_dn=0.5, restored_rel=0.4)
    b = SOURCE.forward(params, flat(0.0, (300, 1), n=400, kind=Kind.DN), stream(rng)).data[:, :, 0].astype(float) / 0.5
    u = np.sqrt((1 + 0.36) / (1 - 0.36) * 2 / b.size)  # of a mean product, Bartlett's formula
    assert (b**2).mean() == pytest.approx(1, abs=Z * u)
    for lag, want in ((1, 0.0), (2, 0.6), (4, 0.36), (5, 0.0)):
        assert (b[:, lag:] * b[:, :-lag]).mean() == pytest.approx(want, abs=Z * u), lag


@pytest.mark.parametrize("interlaced", [False, True])
def test_a_window_of_what_carries_over_is_the_crop(interlaced: bool, rng: np.random.Generator) -> None:
    params, one = Clamp(droop_rel=0.2, restored_rel=0.5, noise_dn=1.0, interlaced=interlaced), stream(rng)
    frame = np.random.default_rng(5).uniform(0, 200, (1, 30, 40)).astype(np.float32)
    whole = SOURCE.forward(params, signal(frame, Kind.DN), one).data
    need = SOURCE.window_needed(params, Windows.one(9, 12, 4, 7), (30, 40))
    assert need.equals(Windows.one(0, 0, 13, 40))
    part = SOURCE.forward(params, signal(frame[:, :13], Kind.DN, frame_shape=(30, 40)), one).data
    assert np.array_equal(part[:, 9:13, 12:19], whole[:, 9:13, 12:19])
