"""The sampling law of a series, the scatter that is read from it, and draws of both kinds, against simulated frames and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from emva.cameras import Camera
from emva.truths import levels, temporal
from pixmetry.camera.observations import PhotonTransfer
from pixmetry.core.errors import MeasureError
from pixmetry.emva.general.response import choose_degree, fit_scatter, fit_smooth
from pixmetry.emva.records import Measurement
from pixmetry.emva.scatter import GROUPS, sampling_u, scatter_of, spatial_scatter, unsaturated
from pixmetry.emva.series import series_of
from pixmetry.emva.temporal import temporal_values
from pixmetry.emva.uncertainty import about, add_wave, bootstrap_series, draw_blocks
from pixmetry.observe.moments import LevelAccumulator, level_moments, summarize_pair

ALPHA = 1e-6
Z = float(stats.norm.isf(ALPHA / 2))


def series_measured(camera: Camera) -> Measurement:
    """Pairs of frames of each level, without stacks."""
    streams = iter(range(10_000))

    def level(exposure_s: float, photons: float):
        return summarize_pair(*camera.frames(2, exposure_s, photons, next(streams)), camera.bits)

    exposure, photons = camera.settings
    bright = level_moments([level(t, p) for t, p in zip(exposure, photons, strict=True)], exposure, photons)
    dark = level_moments([level(t, 0.0) for t in camera.dark_exposures_s], camera.dark_exposures_s)
    return Measurement(PhotonTransfer(bright, dark, camera.shape, camera.bits), pixel_area_um2=camera.pixel_area_um2)


def test_sampling_u_is_the_scatter_of_variances_of_simulated_pairs(rng: np.random.Generator) -> None:
    """600 pairs with row noise and few electrons (kurtosis): the standard deviation is known to 3 %; an error of 25 % would be caught."""
    (rows, cols), pairs = (16, 24), 600
    summaries = []
    for _ in range(pairs):
        light = 3.0 * rng.poisson(2.0, (2, rows, cols)) + rng.standard_normal((2, rows, cols))
        frames = 100 + light + 6 * rng.standard_normal((2, rows, 1))
        summaries.append(summarize_pair(*np.rint(frames).astype(np.uint16), 12))
    found = level_moments(summaries, np.zeros(pairs))
    # the scatter of the estimate by each level's own mean squares stays below its mean
    predicted = float(np.sqrt(np.mean(sampling_u(found, (rows, cols)) ** 2)))
    kurtosis = stats.kurtosis(found.var_total_dn2)
    allowed = Z * np.sqrt((2 + max(kurtosis, 0)) / pairs) / 2
    assert float(found.var_total_dn2.std(ddof=1)) == pytest.approx(predicted, rel=allowed)


@pytest.mark.parametrize("frames", [2, 8])
def test_sampling_u_knows_the_tails_of_the_noise(frames: int, rng: np.random.Generator) -> None:
    """White noise of excess kurtosis 6, a product of two normal ones: catches 12 % of u; without its tails u were a third too small."""
    (rows, cols), levels, summaries = (32, 32), 1500, []
    for _ in range(levels):
        group = LevelAccumulator(12)
        for one, other in rng.standard_normal((frames, 2, rows, cols)):
            group.add(np.rint(2000 + 30 * one * other).astype(np.uint16))
        summaries.append(group.summary())
    found = level_moments(summaries, np.zeros(levels))
    predicted = float(np.sqrt(np.mean(sampling_u(found, (rows, cols)) ** 2)))
    allowed = Z * np.sqrt((2 + max(stats.kurtosis(found.var_total_dn2), 0)) / levels) / 2 + 0.02  # so much a kurtosis of 1024 pixels lacks
    assert float(found.var_total_dn2.std(ddof=1)) == pytest.approx(predicted, rel=allowed)


@pytest.mark.parametrize("frames", [2, 8])
def test_spatial_variance_of_a_level_scatters_with_its_temporal_one(frames: int, rng: np.random.Generator) -> None:
    """1200 levels with a pattern, white and row noise: standard deviation and covariance within ALPHA; errors of 15 % would be caught."""
    (rows, cols), levels = (16, 20), 1200
    pattern = 100 + 4 * rng.standard_normal((rows, cols))
    summaries = []
    for _ in range(levels):
        group = LevelAccumulator(12)
        for noise, line in zip(rng.standard_normal((frames, rows, cols)), rng.standard_normal((frames, rows, 1)), strict=True):
            group.add(np.rint(pattern + 8 * noise + 2 * line).astype(np.uint16))
        summaries.append(group.summary())
    found = level_moments(summaries, np.zeros(levels))
    u_var = sampling_u(found, (rows, cols))
    u, share = spatial_scatter(found, (rows, cols), u_var)
    spatial, temporal_var = found.spatial_cov_dn2, found.var_total_dn2
    stated = float(np.mean(u**2 + share**2 * u_var**2))
    assert float(spatial.var(ddof=1)) == pytest.approx(stated, rel=1.5 * Z * np.sqrt(2 / levels))
    products = (spatial - spatial.mean()) * (temporal_var - temporal_var.mean())
    assert float(products.mean()) == pytest.approx(-float(np.mean(share * u_var**2)), abs=1.2 * Z * float(products.std()) / np.sqrt(levels))


def test_a_wave_in_the_dark_frames_is_found_and_reaches_the_stack(simulated: Measurement) -> None:
    """Dark variances that scatter by 0.5 DN² beyond sampling: found to 40 levels' accuracy, and given to the stack as a pair's product."""
    rng = np.random.default_rng(4)
    dark = simulated.transfer.dark
    wave = 0.5 * rng.standard_normal(dark.mean_dn.size)
    m = replace(simulated, transfer=replace(simulated.transfer, dark=replace(dark, var_total_dn2=dark.var_total_dn2 + wave)))
    s = scatter_of(m, series_of(m))
    assert s.wave_dn2 == pytest.approx(0.5, rel=Z / np.sqrt(2 * 38))
    assert scatter_of(simulated, series_of(simulated)).wave_dn2 < 0.1
    # what the wave takes from the temporal variance it gives to the spatial one
    np.testing.assert_allclose(s.dark_spatial_share, 1.0, atol=0.2)
    frames = 16
    moved = add_wave(np.zeros((40_000, 8)), s, frames, rng)
    assert not moved[:, [0, *range(2, 8)]].any()
    # the mean of L(L − 1)/2 independent products, each counted twice over L²
    products = s.wave_dn2 * rng.standard_normal((20_000, frames * (frames - 1) // 2))
    assert moved[:, 1].std() == pytest.approx(products.mean(axis=1).std(), rel=0.05)


def test_scatter_beyond_the_known_noise_is_found(rng: np.random.Generator) -> None:
    """300 curves of 40 points, sigma 1 and an excess of 2: the mean of the estimates of its square within ALPHA; catches 10 %."""
    x = np.linspace(0, 1, 40)
    shape = 1 + x
    squares = []
    for _ in range(300):
        y = 5 + 3 * x - 8 * x**2 + rng.standard_normal(40) * np.hypot(1.0, 2.0 * shape)
        squares.append(fit_scatter(x, y, np.ones(40), shape, degree=3).excess ** 2)
    assert np.mean(squares) == pytest.approx(4.0, abs=Z * np.std(squares) / np.sqrt(300))
    assert fit_scatter(x, 5 + 3 * x, np.ones(40), shape, degree=3).excess == 0.0


def test_smooth_fit_is_numpys_weighted_polynomial() -> None:
    rng = np.random.default_rng(1)
    x, sigma = np.sort(rng.uniform(-5, 50, 20)), rng.uniform(0.1, 2, 20)
    y = rng.standard_normal(20)
    coefficients = np.polyfit(x, y, 3, w=1 / sigma)
    fit = fit_smooth(x, y, sigma, 3)
    np.testing.assert_allclose(fit.values, np.polyval(coefficients, x), atol=1e-9)
    np.testing.assert_allclose(fit.slopes, np.polyval(np.polyder(coefficients), x), atol=1e-9)
    assert fit.leverage.sum() == pytest.approx(4.0)


def test_a_strong_curve_is_followed_and_a_line_is_not_overdone() -> None:
    rng, x = np.random.default_rng(2), np.linspace(0.02, 1, 50)
    assert choose_degree(x, x**0.45 + 1e-4 * rng.standard_normal(50), np.full(50, 1e-4)) == 7
    assert choose_degree(x, x, np.full(50, 1e-3)) == 3
    assert choose_degree(x[:4], x[:4], np.ones(4)) == 1


@pytest.mark.parametrize("light_swept", [False, True])
def test_truth_lies_where_u_says(light_swept: bool, rng: np.random.Generator) -> None:
    """60 cameras whose light scatters from level to level: the sum of the squared z-scores is chi-square.

    False failures ALPHA a value; u that is 1.6 times too small or 2 times too large would be caught.
    """
    keys = ("R", "K", "QE", "sigma_d", "u_e_min", "u_e_sat") + (() if light_swept else ("u_I_mean",))
    z: dict[str, list[float]] = {key: [] for key in keys}
    for seed in rng.integers(2**31, size=60):
        more = {"setting_rel": 0.002, "row_noise_e": 1.0, "longest_s": 0.5, "levels": 24, "shape": (24, 32), "over": 1.05}
        camera = Camera(seed=int(seed), light_swept=light_swept, **more)
        m = series_measured(camera)
        series = series_of(m)
        truth = temporal(levels(camera), "4.0", camera.pixel_area_um2)
        scatter = scatter_of(m, series)
        value, centre = temporal_values(series, "4.0"), temporal_values(scatter.centre, "4.0")
        drawn = temporal_values(draw_blocks(scatter, [(400, GROUPS)], np.random.default_rng(1)), "4.0")
        for key in keys:
            u = float(np.sqrt(np.mean((drawn[key] - centre[key]) ** 2)))
            z[key].append((float(value[key]) - truth[key]) / u)
    for key, scores in z.items():
        # u rests on some 15 residuals: the variance of Student's t with so many degrees of freedom is 15/13
        squares = np.minimum(np.square(scores), 25.0).sum() * 13 / 15
        assert stats.chi2.isf(1 - ALPHA / 2, 60) < squares < stats.chi2.isf(ALPHA / 2, 60), (key, squares)


@pytest.fixture(scope="module")
def simulated() -> Measurement:
    return series_measured(Camera(seed=77, setting_rel=0.001, row_noise_e=1.5, shape=(48, 64), levels=40))


def test_draws_scatter_as_stated_and_hold_their_causes_apart(simulated: Measurement) -> None:
    series = series_of(simulated)
    s = scatter_of(simulated, series)
    used = unsaturated(series)
    rng = np.random.default_rng(3)
    alone = {g: draw_blocks(s, [(3000, [g])], rng) for g in GROUPS}
    light = alone["light"]
    np.testing.assert_allclose(light.mean_dn.std(axis=0), s.u_light, rtol=0.1, atol=1e-12)
    assert alone["variance"].mean_dn.shape == (1, 40)
    np.testing.assert_array_equal(alone["variance"].mean_dn[0], s.centre.mean_dn)
    np.testing.assert_allclose(alone["variance"].var_dn2.std(axis=0), s.u_variance, rtol=0.1, atol=1e-12)
    # the light moves mean and variance along the photon transfer
    slope = [np.polyfit(light.mean_dn[:, i], light.var_dn2[:, i], 1)[0] for i in np.flatnonzero(used)[5:]]
    assert np.median(slope) == pytest.approx(0.3, rel=0.1)
    # dark levels: their own line, and the same draw beside the bright level of that exposure
    dark = alone["dark_mean"]
    np.testing.assert_array_equal(dark.dark_mean_dn, dark.own_dark_mean_dn)
    np.testing.assert_array_equal(dark.mean_dn[0], s.centre.mean_dn)


def test_saturated_levels_stay_as_they_are(simulated: Measurement) -> None:
    series = series_of(simulated)
    drawn = draw_blocks(scatter_of(simulated, series), [(500, GROUPS)], np.random.default_rng(0))
    full = series.fraction_max == 1
    assert full.any()
    assert drawn.var_dn2[:, full].max() == 0
    np.testing.assert_allclose(drawn.mean_dn[:, full], np.broadcast_to(series.mean_dn[full], (500, full.sum())), atol=5 * 0.05)
    assert (drawn.var_dn2 >= 0).all()


def test_share_at_the_top_code_moves_with_the_light(simulated: Measurement) -> None:
    """A normal signal of the level's total variance: its share above the top code at each drawn mean."""
    series = series_of(simulated)
    s = scatter_of(simulated, series)
    at = int(np.flatnonzero((series.fraction_max > 0) & (series.fraction_max < 0.5))[0])
    drawn = draw_blocks(s, [(20_000, ["light", "counts"])], np.random.default_rng(0))
    width = np.sqrt(s.centre.var_dn2[at] + s.centre.spatial_var_dn2[at])
    share = stats.norm.sf(stats.norm.isf(series.fraction_max[at]) - (drawn.mean_dn[:, at] - s.centre.mean_dn[at]) / width)
    pixels = 2 * 48 * 64
    noise = drawn.fraction_max[:, at] - share
    assert abs(noise.mean()) < Z * np.sqrt(series.fraction_max[at] / pixels / 20_000) + 1e-6
    assert noise.std() == pytest.approx(np.sqrt(series.fraction_max[at] / pixels), rel=0.1)


def test_draws_of_the_variance_take_their_share_off_the_spatial_one(simulated: Measurement) -> None:
    """Of two frames nearly half, where the variances scatter as sampling has it; bright and dark levels alike, and in the bootstrap."""
    s = scatter_of(simulated, series_of(simulated))
    rng, at = np.random.default_rng(5), int(np.flatnonzero(unsaturated(series_of(simulated)))[10])
    for drawn in (
        draw_blocks(s, [(2000, ["variance", "dark_variance"])], rng),
        bootstrap_series(replace(s, u_light=0 * s.u_light), 2000, rng),
    ):
        assert np.polyfit(drawn.var_dn2[:, at], drawn.spatial_var_dn2[:, at], 1)[0] == pytest.approx(-s.spatial_share[at], abs=0.15)
        slope = np.polyfit(drawn.dark_var_dn2[:, at], drawn.dark_spatial_var_dn2[:, at], 1)[0]
        assert slope == pytest.approx(-s.dark_spatial_share[at], abs=0.15)
    assert 0.2 < s.spatial_share[at] < 0.6 and 0.3 < s.dark_spatial_share[at] < 0.8


def test_the_count_of_saturated_pixels_is_a_cause_of_its_own(simulated: Measurement) -> None:
    """Alone, causes that move no light leave the shares at the top code, and with them the level of saturation, where they are."""
    series = series_of(simulated)
    s = scatter_of(simulated, series)
    for group in ("variance", "dark_mean", "dark_variance", "spatial"):
        shares = draw_blocks(s, [(200, [group])], np.random.default_rng(0)).fraction_max
        np.testing.assert_allclose(shares, np.broadcast_to(series.fraction_max, shares.shape), rtol=1e-9)
    at = int(np.flatnonzero((series.fraction_max > 0) & (series.fraction_max < 0.5))[0])
    drawn = draw_blocks(s, [(4000, ["counts"])], np.random.default_rng(0))
    assert drawn.fraction_max[:, at].std() == pytest.approx(np.sqrt(series.fraction_max[at] / (2 * 48 * 64)), rel=0.1)


def test_bootstrap_and_normal_draws_give_the_same_u(simulated: Measurement) -> None:
    series = series_of(simulated)
    s = scatter_of(simulated, series)
    centre = temporal_values(s.centre, "4.0")
    normal = temporal_values(draw_blocks(s, [(3000, GROUPS)], np.random.default_rng(1)), "4.0")
    resampled = temporal_values(bootstrap_series(s, 3000, np.random.default_rng(2)), "4.0")
    for key in ("R", "K", "sigma_y_dark", "u_I_mean", "LE", "DR", "PTC_linearity"):
        one, other = (float(np.sqrt(np.mean((d[key] - centre[key]) ** 2))) for d in (normal, resampled))
        assert other == pytest.approx(one, rel=0.25), key


def test_draws_about_the_measured_series_have_its_mean(simulated: Measurement) -> None:
    series = series_of(simulated)
    s = scatter_of(simulated, series)
    drawn = about(draw_blocks(s, [(4000, GROUPS)], np.random.default_rng(1)), s.centre, series)
    np.testing.assert_allclose(drawn.mean_dn.mean(axis=0), series.mean_dn, atol=Z * s.u_light.max() / np.sqrt(4000))


def test_refuses_a_series_that_is_all_saturated(simulated: Measurement) -> None:
    bright = replace(simulated.transfer.bright, fraction_max=np.ones(40))
    m = replace(simulated, transfer=replace(simulated.transfer, bright=bright))
    with pytest.raises(MeasureError, match="below saturation"):
        scatter_of(m, series_of(m))
