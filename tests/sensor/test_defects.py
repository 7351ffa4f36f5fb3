"""Defect pixels: how many and how much, their persistence, the blind count, the repair and the shift."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from pixmetry.core.errors import MeasureError
from pixmetry.core.observations import DefectList, Observations
from pixmetry.experiment.defects import find_defects
from pixmetry.experiment.stack import StackAccumulator
from pixmetry.sensor.defects import SOURCE, Defects
from source_signals import ALPHA, K_DN_PER_E, centroid, fitted, flat, signal, spot_probe, spots, stream


def test_shares_and_excess_follow_their_laws():
    """Binomial counts and a Kolmogorov–Smirnov test of the log-normal excess, 1e-6 each; catches 8 % in a share, 5 % in the median."""
    params = Defects(hot_fraction=0.01, hot_median_e=300.0, hot_sigma_log=0.8, dead_fraction=0.005, dead_gain_rel=0.1)
    level, shape = 1000.0, (800, 1000)
    out = SOURCE.forward(params, flat(level, shape), stream()).data[0].astype(float)
    n = out.size
    for found, share in ((int((out > level).sum()), 0.01), (int((out == 100.0).sum()), 0.005)):
        low, high = stats.binom.ppf([ALPHA / 2, 1 - ALPHA / 2], n, share)
        assert low <= found <= high
    excess = out[out > level] - level
    assert stats.kstest(np.log(excess / 300) / 0.8, "norm").pvalue > ALPHA
    assert (out == level).sum() + (out > level).sum() + (out == 100.0).sum() == n


def test_the_same_pixels_in_every_frame_and_window():
    one, params = stream(), Defects(hot_fraction=0.05, dead_fraction=0.05)
    whole = SOURCE.forward(params, flat(500.0, (40, 50), n=3), one).data
    assert np.array_equal(whole[0], whole[2])
    window = SOURCE.forward(params, flat(500.0, (10, 12), n=3, row0=7, col0=9, frame_shape=(40, 50)), one).data
    assert np.array_equal(window, whole[:, 7:17, 9:21])


def test_counted_blind_through_stacks():
    """Shares within 5 u and excess within 6 u of the truth; the smallest excess lies far above the noise of the dark stack."""
    rng, shape, gain = np.random.default_rng(), (240, 320), 0.5
    params = Defects(hot_fraction=2e-3, hot_median_e=400.0, hot_sigma_log=0.5, dead_fraction=1e-3, dead_gain_rel=0.2)
    one, stacks = stream(), []
    for electrons in (0.0, 2000.0):
        mean = 50 + gain * SOURCE.forward(params, flat(electrons, shape), one).data[0]
        accumulator = StackAccumulator(12)
        for _ in range(16):
            accumulator.add(np.rint(mean + rng.normal(0, 2, shape)).astype(np.uint16))
        stacks.append(accumulator.result(0.01))
    transfer = fitted(gain_dn_per_e=(gain, 0.001, "DN/e-"))
    got = SOURCE.measure(Observations(defects=find_defects(*stacks), bright_stack=stacks[1], photon_transfer_fit=transfer))
    assert set(got.names) == set(params.model_dump())
    for name, value in params.model_dump().items():
        assert abs(got[name].value - value) < 6 * got[name].u, name


def test_none_found_gives_a_limit():
    none = np.zeros(0, int)
    empty = DefectList(none, none, (), none.astype(float), none.astype(float), 0.01, (480, 640))
    got = SOURCE.measure(Observations(defects=empty))["hot_fraction"]
    assert got.kind == "upper_limit"
    # posterior of a share whose prior is Beta(½, ½): integrate its density up to the limit
    p = np.linspace(0, 20 / (480 * 640), 400_001)[1:]
    density = p**-0.5 * (1 - p) ** (480 * 640 - 0.5)
    assert np.sum(density[p <= got.value]) / density.sum() == pytest.approx(0.95, abs=0.005)
    with pytest.raises(MeasureError, match="dark"):
        SOURCE.measure(Observations())


def test_repair_is_exact_on_a_plane():
    """The median of the eight neighbours of a plane is its value there; neighbours that are defect themselves do not count."""
    y, x = np.mgrid[:9, :11]
    plane = (100 + 3.0 * x + 2.0 * y).astype(np.float32)[None]
    defects = np.zeros((9, 11), bool)
    defects[4, 5] = defects[0, 0] = True
    broken = plane.copy()
    broken[0][defects] = 4000
    after = SOURCE.correct(SOURCE.typical, signal(broken), {"defects": defects}).data
    assert after[0, 4, 5] == plane[0, 4, 5]
    assert after[0, 0, 0] == np.median([plane[0, 0, 1], plane[0, 1, 0], plane[0, 1, 1]])
    assert np.array_equal(after[0][~defects], plane[0][~defects])
    defects[4, 4:7] = defects[3, 5] = True
    broken[0][defects] = 4000
    after = SOURCE.correct(SOURCE.typical, signal(broken), {"defects": defects}).data
    good = [plane[0, r, c] for r in (3, 4, 5) for c in (4, 5, 6) if not defects[r, c]]
    assert after[0, 4, 5] == np.median(good)


def test_a_patch_without_good_neighbours_stays():
    defects = np.ones((3, 3), bool)
    frame = flat(5.0, (3, 3))
    assert np.array_equal(SOURCE.correct(SOURCE.typical, frame, {"defects": defects}).data, frame.data)


def test_one_pixel_moves_a_centroid_by_v_d_over_s():
    """The handbook's single pixel: 50 DN at 3.5 px from the centre of a target of sum S moves it by 50 · 3.5/S; the probe says the same."""
    probe = spot_probe(n=1)
    error = np.zeros(probe.signal_dn.shape[1:])
    error[12, 15] = 50.0
    total = probe.signal_dn.sum()
    assert probe.field(error)[0][0] == pytest.approx(50 * (15 - probe.x_hat_px[0]) / total)


def test_mean_square_of_the_excess_is_that_of_a_log_normal():
    """The second moment from SciPy, for a spread at which the square of the mean would be 2.7 times too small."""
    probe = spot_probe(n=4)
    square = stats.lognorm.moment(2, s=1.0, scale=500.0)
    expected = probe.white(K_DN_PER_E * math.sqrt(1e-3 * square))
    got = SOURCE.propagate(Defects(hot_fraction=1e-3, hot_median_e=500.0, hot_sigma_log=1.0), probe)
    assert (got.u_x_px, got.u_y_px) == pytest.approx(expected, rel=1e-9)


def test_root_mean_square_shift_over_units():
    """Direct simulation over 2000 units, hot and dead pixels frequent enough to be met; tolerance of a standard deviation, 12 %."""
    params = Defects(hot_fraction=0.02, hot_median_e=150.0, hot_sigma_log=0.3, dead_fraction=0.01, dead_gain_rel=0.3)
    x = y = np.array([12.0])
    got = SOURCE.propagate(params, spot_probe(n=1))
    image = spots(x, y) / K_DN_PER_E
    shifts = np.array([np.ravel(centroid(SOURCE.forward(params, signal(image), stream(i)).data.astype(float))) for i in range(2000)])
    assert math.hypot(*shifts.std(axis=0)) == pytest.approx(math.hypot(got.u_x_px, got.u_y_px), rel=0.12)
