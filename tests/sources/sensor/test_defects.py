"""Defect pixels: how many and how much, their persistence, the blind count, the repair and the shift."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import DefectList, Observations, StackMoments
from pixmetry.core.errors import MeasureError
from pixmetry.observe.defects import find_defects
from pixmetry.observe.stack import StackAccumulator
from pixmetry.sources.sensor.defects import SOURCE, Defects
from source_signals import ALPHA, K_DN_PER_E, centroid, centroid_probe, fitted, flat, signal, spot_probe, spots, stream


def test_shares_and_excess_follow_their_laws(rng: np.random.Generator):
    """Binomial counts and a Kolmogorov–Smirnov test of the log-normal excess, 1e-6 each; catches 8 % in a share, 5 % in the median."""
    params = Defects(hot_fraction=0.01, hot_median_e=300.0, hot_sigma_log=0.8, dead_fraction=0.005, dead_gain_rel=0.1)
    level, shape = 1000.0, (800, 1000)
    out = SOURCE.forward(params, flat(level, shape), stream(rng)).data[0].astype(float)
    n = out.size
    for found, share in ((int((out > level).sum()), 0.01), (int((out == 100.0).sum()), 0.005)):
        low, high = stats.binom.ppf([ALPHA / 2, 1 - ALPHA / 2], n, share)
        assert low <= found <= high
    excess = out[out > level] - level
    assert stats.kstest(np.log(excess / 300) / 0.8, "norm").pvalue > ALPHA
    assert (out == level).sum() + (out > level).sum() + (out == 100.0).sum() == n


def test_the_same_pixels_in_every_frame_and_window(rng: np.random.Generator):
    one, params = stream(rng), Defects(hot_fraction=0.05, dead_fraction=0.05)
    whole = SOURCE.forward(params, flat(500.0, (40, 50), n=3), one).data
    assert np.array_equal(whole[0], whole[2])
    window = SOURCE.forward(params, flat(500.0, (10, 12), n=3, row0=7, col0=9, frame_shape=(40, 50)), one).data
    assert np.array_equal(window, whole[:, 7:17, 9:21])


def stack_of(frames_e: np.ndarray, gain: float, rng: np.random.Generator, noise_dn: float = 2.0) -> StackMoments:
    """Moments of these frames on an offset of 50 DN, with Gaussian noise and rounded."""
    accumulator = StackAccumulator(12)
    for frame in frames_e:
        accumulator.add(np.rint(50 + gain * frame + rng.normal(0, noise_dn, frame.shape)).clip(0).astype(np.uint16))
    return accumulator.result(0.01)


@pytest.mark.parametrize(
    ("dark_e", "params"),
    [
        (
            0.0,
            Defects(
                hot_fraction=2e-3, hot_median_e=400.0, hot_sigma_log=0.5, dead_fraction=1e-3, dead_gain_rel=0.2,
                gain_fraction=2e-3, gain_std_rel=0.1,
            ),
        ),
        (1500.0, Defects(cold_fraction=1e-3, cold_e=300.0, noisy_fraction=2e-3, noisy_std_e=150.0)),
    ],
    ids=["charge and response", "cold and noisy"],
)  # fmt: skip
def test_counted_blind_through_stacks(dark_e: float, params: Defects, rng: np.random.Generator):
    """Shares are those of the unit: exact but for what is too small to be found; sizes within 6 u and what 100 pixels leave to chance."""
    shape, gain, frames = (240, 320), 0.5, 16
    one = stream(rng)
    still, lit = (SOURCE.forward(params, flat(level, shape, n=frames), one).data.astype(float) for level in (dark_e, dark_e + 2000))
    dark, bright = stack_of(still, gain, rng), stack_of(lit, gain, rng)
    transfer = fitted(gain_dn_per_e=(gain, 0.001, "DN/e-"))
    seen = Observations(defects=find_defects(dark, bright), dark_stack=dark, bright_stack=bright, photon_transfer_fit=transfer)
    got = SOURCE.measure(seen)
    response, extra = (lit - still)[0] / 2000, still.mean(axis=0) - dark_e
    noisy = still.std(axis=0) > 1e-3
    truth = {
        "hot": (extra > 1e-3) & ~noisy,
        "dead": np.isclose(response, params.dead_gain_rel) & (params.dead_fraction > 0),
        "cold": (extra < -1e-3) & ~noisy & (dark_e > 0),
    }
    truth["gain"] = ~np.isclose(response, 1, atol=1e-5) & ~truth["dead"] & ~noisy
    truth["noisy"] = noisy
    for name, where in truth.items():
        # five in a frame by chance: a false alarm comes once in 100 frames, and rarely a noisy pixel is taken for another kind
        hidden = int((where & np.isclose(response, 1, atol=0.008)).sum()) if name == "gain" else 0  # the limit is near 0.4 %
        count = got[f"{name}_fraction"].value * where.size
        assert where.sum() - hidden - 4 <= count <= where.sum() + 4, name
    for name, value in params.model_dump().items():
        if name.endswith("_fraction") or getattr(params, name.split("_")[0] + "_fraction", 0) == 0:
            continue
        chance = value / np.sqrt(2 * truth["gain"].sum()) if name == "gain_std_rel" else 0.0
        assert abs(got[name].value - value) < 6 * math.hypot(got[name].u, chance), name


def test_pixels_of_low_response_reach_the_budget(rng: np.random.Generator):
    """50 of 16384 pixels at 70 %: all of them are counted, and move a centroid as white errors of 0.3 √(50/16384) of the signal do."""
    shape = (128, 128)
    light = np.full(16384, 2000.0)
    light[rng.choice(16384, 50, replace=False)] *= 0.7
    dark, bright = (stack_of(np.tile(level.reshape(1, *shape), (16, 1, 1)), 0.5, rng) for level in (0 * light, light))
    got = SOURCE.measure(Observations(defects=find_defects(dark, bright), dark_stack=dark, bright_stack=bright))
    assert got["gain_fraction"].value == pytest.approx(50 / 16384, abs=2 / 16384)
    assert got["gain_std_rel"].value == pytest.approx(0.3, abs=0.006)
    probe = spot_probe()
    # a sound pixel is taken for a hot or a noisy one once in a hundred frames: those are not asked about here
    contribution = SOURCE.propagate(Defects(**{e.name: e.value for e in got if e.name.startswith("gain")}), probe)
    expected = probe.white(0.3 * math.sqrt(50 / 16384) * probe.signal_dn)
    assert (contribution.u_x_px, contribution.u_y_px) == pytest.approx(expected, rel=0.06)


def test_none_found_is_none_and_the_limit_says_how_small_they_may_be(rng: np.random.Generator):
    """95 of 100 pixels with the stated excess are found: binomial, 1e-6; catches a limit that is off by a fifth of its distance."""
    shape, gain = (160, 160), 0.5
    transfer = fitted(gain_dn_per_e=(gain, 0.001, "DN/e-"))
    scatter = rng.normal(0, 3.0, shape)

    def seen(extra_e: np.ndarray) -> Observations:
        dark = stack_of(np.tile(200 + scatter + extra_e, (16, 1, 1)), gain, rng)
        return Observations(defects=find_defects(dark), dark_stack=dark, photon_transfer_fit=transfer)

    none = seen(np.zeros(shape))
    got = SOURCE.measure(none)
    for name in ("hot", "cold", "noisy"):
        count = none.defects.kind.count(name)  # a false alarm comes once in a hundred frames
        assert got[f"{name}_fraction"].value == count / scatter.size and got[f"{name}_fraction"].kind == "value"
        assert (got[f"{name}_fraction"].u == 0) == (count == 0)
    assert "dead_fraction" not in got and "gain_fraction" not in got  # without light
    if none.defects.kind.count("hot"):
        return
    assert got["hot_median_e"].kind == "upper_limit"
    places = np.zeros(scatter.size, bool)
    places[rng.choice(places.size, 300, replace=False)] = True
    found = seen(np.where(places.reshape(shape), got["hot_median_e"].value, 0.0)).defects.mask().ravel()[places].sum()
    assert stats.binom.ppf(ALPHA / 2, 300, 0.92) <= found <= stats.binom.isf(ALPHA / 2, 300, 0.97)
    with pytest.raises(MeasureError, match="dark"):
        SOURCE.measure(Observations())


def test_a_single_hot_pixel_is_taken_as_it_is():
    one = np.array([3])
    single = DefectList(one, one, ("hot",), np.array([40.0]), np.array([1.0]), 0.01, (100, 100), 10.0, 2.0, 0.01)
    got = SOURCE.measure(Observations(defects=single, photon_transfer_fit=fitted(gain_dn_per_e=(0.5, 0.001, "DN/e-"))))
    assert got["hot_fraction"].value == 1e-4 and got["hot_fraction"].u == pytest.approx(0.1 * 1e-4)
    assert got["hot_median_e"].value == pytest.approx(80.0) and got["hot_sigma_log"].value == 0
    assert got["hot_median_e"].u == pytest.approx(math.hypot(2 / 0.5, 80 * 0.002))


def test_too_many_to_be_defects():
    everywhere = np.arange(20)
    many = DefectList(everywhere, everywhere, ("cold",) * 20, 0.0 * everywhere, 0.0 * everywhere, 0.01, (10, 10))
    with pytest.raises(MeasureError, match="cold"):
        SOURCE.measure(Observations(defects=many))


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


def test_behind_a_threshold_the_estimator_itself_is_asked():
    """Σ max(I − T, 0) x with one pixel raised by e: x̂ moves by w (d)/(S + w), w = max(I + e − T, 0) − max(I − T, 0), in closed form.

    The mean over a log-normal e by 500 quantiles of equal weight, over all places of the probe. The gradient, which knows nothing of
    the background below the threshold, gives little more than half of it.
    """
    x, y = (12 + g.ravel() for g in np.meshgrid(*[(np.arange(5) + 0.5) / 5 - 0.5] * 2))
    image, threshold = 10 + spots(x, y), 20.0
    over = np.maximum(image - threshold, 0)
    total = over.sum(axis=(1, 2))

    def locate(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return centroid(np.maximum(windows - threshold, 0))

    probe = replace(centroid_probe(over, x, y), signal_dn=image, locate=locate)
    params = Defects(hot_fraction=1e-3, hot_median_e=1500.0, hot_sigma_log=0.6, dead_fraction=2e-4)
    square = np.zeros(2)
    excess = K_DN_PER_E * stats.lognorm(s=0.6, scale=1500.0).ppf((np.arange(500) + 0.5) / 500)
    cases = [(1e-3, image[:, :, :, None] + excess), (2e-4, 0 * image[:, :, :, None])]
    for share, changed in cases:
        w = np.maximum(changed - threshold, 0) - over[:, :, :, None]
        for axis, centre in ((0, probe.x_hat_px), (1, probe.y_hat_px)):
            at = np.arange(25)
            d = (at[None, None, :] if axis == 0 else at[None, :, None]) - centre[:, None, None]
            shift = w * d[:, :, :, None] / (total[:, None, None, None] + w)
            square[axis] += share * (shift**2).mean(axis=3).sum(axis=(1, 2)).mean()
    got = SOURCE.propagate(params, probe)
    assert (got.u_x_px, got.u_y_px) == pytest.approx(tuple(np.sqrt(square)), rel=0.03)


def test_blinking_is_a_stationary_telegraph_signal(rng: np.random.Generator):
    """Share on, correlation e^-k of the chain after k frames, and the same for frames far on; 1e-6, catches 10 % of the memory.

    After one frame a pixel keeps its level with probability 1 − 1/n, else it is drawn anew: correlation (1 − 1/n)^k.
    """
    params, pixels = Defects(blinking_fraction=0.1, blinking_e=300.0, blinking_on=0.3, blinking_frames=5.0), (300, 400)
    one, frames = stream(rng), 24
    out = SOURCE.forward(params, flat(50.0, pixels, n=frames), one).data.reshape(frames, -1)
    blinking = SOURCE.truth(params, flat(0.0, pixels), one)["blinking"].ravel()
    assert (out[:, ~blinking] == 50).all()
    on = (out[:, blinking] > 50).astype(float)
    assert set(np.unique(out)) == {np.float32(50), np.float32(350)}
    n = on.shape[1]
    assert abs(on[-1].mean() - 0.3) < 4.8917 * math.sqrt(0.21 / n)
    for k in (1, 4):
        found = ((on[-1] - 0.3) * (on[-1 - k] - 0.3)).mean() / 0.21
        assert abs(found - 0.8**k) < 4.8917 * 1.6 / math.sqrt(n)
    alone = SOURCE.forward(params, flat(50.0, pixels, n=frames).take(np.array([17])), one).data.ravel()
    assert np.array_equal(alone, out[17])


def test_columns_clusters_stuck_and_listed_pixels(rng: np.random.Generator):
    params = Defects(
        column_fraction=0.05, column_gain_rel=0.5, column_e=10.0, cluster_fraction=0.002, cluster_radius_px=2.0, stuck_fraction=0.002,
        stuck_e=77.0, listed=((3, 4, 0.0, 0.0), (199, 299, 1.0, 5000.0), (500, 2, 0.0, 0.0)),
    )  # fmt: skip
    one, frames = stream(rng), flat(1000.0, (200, 300), n=2)
    out, told = SOURCE.forward(params, frames, one).data, SOURCE.truth(params, frames, one)
    assert np.array_equal(out[0], out[1])
    assert out[0, 3, 4] == 0 and out[0, 199, 299] >= 5000 and told["listed"].sum() == 2
    assert (out[0][told["cluster"] & ~told["listed"]] == 0).all()
    here = told["column"] & ~told["cluster"] & ~told["listed"]
    assert set(np.unique(out[0][here])) <= {np.float32(510), np.float32(48.5)}  # good and stuck ones in a defect column
    rest = ~(told["column"] | told["cluster"] | told["listed"])
    assert (out[0][rest & told["stuck"]] == 77).all() and (out[0][rest & ~told["stuck"]] == 1000).all()
    columns = told["column"].all(axis=0)
    assert np.array_equal(columns, told["column"].any(axis=0)) and stats.binom.cdf(columns.sum(), 300, 0.05) > ALPHA / 2
    seeds = 1 - (1 - 0.002) ** 13  # pixels within two of the centre
    assert abs(told["cluster"].mean() - seeds) < 4.8917 * math.sqrt(seeds * 13 / told["cluster"].size)


def test_list_of_known_defects_is_checked():
    from pixmetry.core.errors import InputError

    assert SOURCE.make({"listed": [[1, 2, 0.0, 10.0]]}).listed == ((1, 2, 0.0, 10.0),)
    for wrong in ([[-1, 2, 0.0, 0.0]], [[1, 2, -0.5, 0.0]], [[1, 2, 0.0]]):
        with pytest.raises(InputError, match="listed"):
            SOURCE.make({"listed": wrong})


def test_shift_by_a_dead_column_and_by_clusters():
    """Root mean square over columns (clusters) of the shift when one of them is dark, from the images themselves."""
    probe = spot_probe(n=4)
    centres = [(r, c) for r in range(-1, 26) for c in range(-1, 26)]
    groups = {"column": [(slice(None), slice(c, c + 1)) for c in range(25)]}
    groups["cluster"] = [(slice(max(r - 1, 0), r + 2), slice(max(c - 1, 0), c + 2)) for r, c in centres]
    for name, params in (
        ("column", Defects(column_fraction=1e-3)),
        ("cluster", Defects(cluster_fraction=1e-4, cluster_radius_px=1.5, cluster_gain_rel=0.0)),
    ):
        got, square = SOURCE.propagate(params, probe), 0.0
        for p in range(4):
            for group in groups[name]:
                error = np.zeros((25, 25))
                error[group] = -probe.signal_dn[p][group]
                square += 1e-3 * (probe.gx[p] * error).sum() ** 2 / 4 if name == "column" else 1e-4 * (probe.gx[p] * error).sum() ** 2 / 4
        assert got.u_x_px == pytest.approx(math.sqrt(square), rel=1e-6)
