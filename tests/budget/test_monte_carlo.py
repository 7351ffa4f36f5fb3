"""The Monte Carlo and the probe against closed forms and simulations written another way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from budget.cameras import ETA, GAIN_DN_PER_E, camera, element
from pixmetry.budget.monte_carlo import MonteCarlo, Trials, _axis, helpers_of, monte_carlo
from pixmetry.budget.probe import Facts, Target, facts_of, make_probe, parse_target, passed_light, resolve
from pixmetry.core.errors import InputError
from pixmetry.locate.centroids.fixed import FixedCentroid

WHITE_E = 60.0
Z = 4.9  # of a normal variable: two-sided false-alarm rate 1e-6
TARGET = Target(peak_rel=0.75, background_rel=0.025)


def noisy() -> object:
    return camera(element("electronics.amplifier_noise", white_e=WHITE_E))


def facts(cam, noise_dn: float = 0.6) -> Facts:
    return facts_of(cam, TARGET, {"noise_dn": noise_dn})


def test_facts_are_those_of_the_chain() -> None:
    got = facts_of(noisy(), TARGET)
    assert got.dn_per_photon == pytest.approx(ETA * GAIN_DN_PER_E, rel=1e-6)
    assert (got.gain_dn_per_e, got.saturation_dn, got.bits) == (GAIN_DN_PER_E, 200.0, 8)
    # 128 windows of 256 pixels, a mean taken from each, cut at 4σ (takes 0.05 % off): u = 1/√(2·32768) = 0.4 %
    assert got.noise_dn == pytest.approx(WHITE_E * GAIN_DN_PER_E, rel=Z * 0.004 + 0.003)
    assert facts_of(camera(adc=True, facts={}), TARGET).saturation_dn == 255 - 8
    with pytest.raises(InputError, match="facts|fact"):
        facts_of(noisy(), TARGET, {"noise": 1.0})


def test_white_noise_has_the_closed_form(seed: int) -> None:
    """Plain centroid over w × w pixels: u = σ √(w²(w² − 1)/12)/S with S the disc's light, π R² A. Smallest error seen: 3.5 %."""
    cam, law = noisy(), FixedCentroid("centroid", window=15)
    total = math.pi * 3.5**2 * TARGET.peak_rel * 200.0
    u = WHITE_E * GAIN_DN_PER_E * math.sqrt(225 * 224 / 12) / total
    got = monte_carlo(cam, TARGET, law, only=["electronics.amplifier_noise"], trials=20_000, facts=facts(cam), seed=seed)
    for axis in (got.x, got.y):
        assert abs(axis.u / u - 1) < Z / math.sqrt(2 * got.trials) + 0.005  # 0.5 %: the light that ends outside of the square, and phase
        assert abs(axis.temporal / u - 1) < Z / math.sqrt(got.trials) + 0.005
        assert abs(axis.bias) < Z * u / math.sqrt(got.trials)
        assert axis.fixed < math.sqrt(Z * u**2 / math.sqrt(got.trials / 2))  # its variance is zero within Z standard errors
        assert axis.se_u == pytest.approx(u / math.sqrt(2 * got.trials), rel=0.3)
        assert axis.se_bias == pytest.approx(u / math.sqrt(got.trials), rel=1.5)


def test_what_is_fixed_shows_as_fixed_and_agrees_with_the_linear_response(seed: int) -> None:
    """PRNU of 1 %: no difference between frames; 8192 places. The propagator's own error is stated as 12 %, here 3 % are allowed."""
    cam = camera(element("sensor.prnu", pixel_std_rel=0.01))
    probe = make_probe(facts(cam), TARGET, FixedCentroid())
    got = monte_carlo(cam, TARGET, FixedCentroid(), only=["sensor.prnu"], trials=8192, facts=facts(cam), seed=seed)
    assert got.x.temporal == 0 and got.y.temporal == 0
    for axis, u in zip((got.x, got.y), probe.white(0.01 * probe.signal_dn), strict=True):
        assert abs(axis.fixed / u - 1) < 0.03 + Z / math.sqrt(2 * got.units * got.places)


def test_nested_analysis_of_variance_separates_what_was_put_in(rng: np.random.Generator) -> None:
    """Shifts made by NumPy with known parts; false alarm 1e-6 per comparison, by the standard errors that it states itself (and 10 %)."""
    shape = (12, 2000, 3)
    shift = 0.5 + rng.normal(0, 0.3, shape[:2])[:, :, None] + rng.normal(0, 0.2, shape)
    got = _axis(shift)
    for value, error, truth in (
        (got.bias, got.se_bias, 0.5),
        (got.u, got.se_u, math.hypot(0.3, 0.2)),
        (got.temporal, got.se_temporal, 0.2),
        (got.fixed, got.se_fixed, 0.3),
    ):
        assert error < 0.02 * truth and abs(value - truth) < 1.1 * Z * error
    assert got.se_temporal == pytest.approx(0.2 / math.sqrt(2 * 2 * 24_000), rel=0.05)


def test_a_source_alone_is_seen_through_the_camera_s_own_line(seed: int) -> None:
    """Jitter of 5 ns behind an amplifier: not on a bare staircase, and as the same jitter in the whole chain."""
    jitter, amplifier = element("grabber.line_jitter", white_ns=5.0), element("electronics.video_amplifier", natural_mhz=8.0, damping=0.7)
    cam = camera(jitter, element("cable.termination", length_m=2.0, line_ohm=50.0))
    cam = replace(cam, chain=(*cam.chain[:2], amplifier, *cam.chain[2:]))
    design = Trials(cam, TARGET, FixedCentroid(), facts(cam), trials=2048, units=4, seed=seed)
    alone, missed = design.of(only=["grabber.line_jitter"]), design.of(off=["grabber.line_jitter"])
    assert alone.x.u == pytest.approx(missed.x.u, rel=1e-6) and 0.015 < alone.x.u < 0.04  # 5 ns are 0.071 px, over seven rows
    assert {"electronics.video_amplifier", "cable.termination"} == set(helpers_of(cam, ["grabber.line_jitter"]))
    assert helpers_of(cam, ["electronics.video_amplifier"]) == ("cable.termination",)  # a jitter shapes no line


def test_a_target_has_its_light_whatever_the_aperture_takes_away(seed: int) -> None:
    """Six tenths of every pixel gather light. The target is of so many per cent of saturation all the same: the noise weighs as it did."""
    noise, aperture = element("electronics.amplifier_noise", white_e=WHITE_E), element("sensor.pixel_aperture", collected_rel=0.6)
    cam = camera(noise)
    cam = replace(cam, chain=(aperture, *cam.chain))
    assert passed_light(cam) == pytest.approx(0.6, rel=1e-5) and passed_light(noisy()) == 1.0
    law = FixedCentroid(threshold_dn=10.0)
    design = Trials(cam, TARGET, law, facts(cam), trials=1024, units=4, seed=seed)
    alone, whole = design.of(only=["electronics.amplifier_noise"]), design.of(off=["electronics.amplifier_noise"])
    # the same draws on the same targets: they differ by the target's slopes alone, not by 1/0.6
    assert whole.x.u == pytest.approx(alone.x.u, rel=0.03) and whole.y.u == pytest.approx(alone.y.u, rel=0.03)


def test_windows_follow_a_clock_that_is_cold(seed: int) -> None:
    """Samples 4 px off at the end of the row: no target is lost, and the shift is that of the clock."""
    cam = camera(element("grabber.clock_warm_up", scale_error_rel=0.02, lock_us=10.0), shape=(96, 200))
    got = monte_carlo(cam, TARGET, FixedCentroid(), only=["grabber.clock_warm_up"], trials=256, units=2, facts=facts(cam), seed=seed)
    assert got.lost == 0
    assert got.x.bias == pytest.approx((141.9 + 99.5) * 0.02 / 1.02, rel=0.06)  # 10 µs are 141.9 px


def test_what_a_calibration_leaves_is_what_is_not_smooth(rng: np.random.Generator) -> None:
    """Shifts of known parts: constant 0.5, a cubic of each unit over the frame, 0.3 from place to place, 0.2 in time."""
    row, col = rng.uniform(0, 1, (2, 12, 150))
    smooth = 0.5 + rng.normal(0, 1, (12, 1)) * (row - 0.5) + 3 * (row - 0.5) * (col - 0.5) ** 2
    shift = (smooth + rng.normal(0, 0.3, smooth.shape))[:, :, None] + rng.normal(0, 0.2, (*smooth.shape, 3))
    got, truth = _axis(shift, row, col), math.hypot(0.3, 0.2)
    assert got.se_left < 0.02 * truth and abs(got.left - truth) < 1.1 * Z * got.se_left
    assert _axis(np.full((2, 3, 2), 0.5), *np.zeros((2, 2, 3))).left == 0  # few places: the constant alone


def test_a_bias_that_belongs_to_the_unit_widens_the_error_of_the_mean(rng: np.random.Generator) -> None:
    """Eight units, each with an offset of its own: the standard error is that of eight values, not of 16 000."""
    offset = np.linspace(-1, 1, 8)
    got = _axis(offset[:, None, None] + rng.normal(0, 0.01, (8, 1000, 2)))
    assert got.se_bias == pytest.approx(offset.std(ddof=1) / math.sqrt(8), rel=0.01)
    assert got.fixed == pytest.approx(offset.std(), rel=0.01)


def test_the_total_scatters_by_its_standard_error(rng: np.random.Generator) -> None:
    """400 small experiments made by NumPy: their scatter is known to 3.5 %; an error of 20 % would be caught."""
    found = []
    for _ in range(400):
        x, y = (_axis(rng.normal(bias, 0.3, (2, 60, 1)) + rng.normal(0, 0.2, (2, 60, 2))) for bias in (0.2, 0.0))
        found.append(MonteCarlo(x, y, (), 2, 60, 2, 0, "exact", 0.0))
    totals, errors = np.array([(one.total_px, one.se_total_px) for one in found]).T
    assert totals.std(ddof=1) == pytest.approx(math.sqrt(float(np.mean(errors**2))), rel=Z / math.sqrt(2 * 400) + 0.03)


def test_lost_targets_are_counted_and_left_out() -> None:
    shift = np.zeros((2, 5, 2))
    shift[0, 1, 1] = np.nan
    assert _axis(shift).u == 0 and _axis(shift).bias == 0
    assert math.isnan(_axis(np.full((2, 3, 2), np.nan)).u)


def test_the_estimator_itself_against_the_truth(seed: int) -> None:
    """Without any source, the whole camera's error is the S-curve that the probe shows on a lattice of 24 × 24 phases; u within 8 %."""
    cam = camera()
    law, target = FixedCentroid(sigma=40.0), Target(diameter_px=4.0, blur_px=0.5, peak_rel=0.7)
    known = facts_of(cam, target, {"noise_dn": 1.0})
    got = monte_carlo(cam, target, law, trials=4096, facts=known, seed=seed)
    probe = make_probe(known, target, law, phases=24)
    u = np.std(probe.x_hat_px - probe.x_px)
    assert u > 5e-4 and got.x.temporal == 0
    assert abs(got.x.u / u - 1) < 0.08


def test_a_source_of_codes_is_compared_on_a_converter(seed: int) -> None:
    cam = camera(adc=True)
    got = monte_carlo(cam, TARGET, FixedCentroid(), only=["grabber.adc"], trials=4096, facts=facts(cam, 1.0), seed=seed)
    probe = make_probe(facts(cam, 1.0), TARGET, FixedCentroid())
    assert abs(got.x.u / probe.white(math.sqrt(1 / 12))[0] - 1) < 0.15  # rounding is not quite white: pixels of the flat top agree


def test_the_same_seed_gives_the_same_and_another_one_does_not() -> None:
    cam = noisy()
    runs = [monte_carlo(cam, TARGET, FixedCentroid(), trials=64, facts=facts(cam), seed=s).x for s in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_off_equals_only_when_there_is_one_source() -> None:
    cam = noisy()
    design = Trials(cam, TARGET, FixedCentroid(), facts(cam), trials=64)
    assert design.of(off=["electronics.amplifier_noise"]).x == design.of(only=["electronics.amplifier_noise"]).x
    with pytest.raises(InputError):
        design.of(only=[], off=[])
    with pytest.raises(InputError, match="no source named"):
        design.of(only=["nothing"])


def test_places_cover_sensor_and_pixel(seed: int) -> None:
    """Kolmogorov–Smirnov of 4096 uniform numbers each, at 1e-6: shifts of 0.04 of the range are seen."""
    from scipy.stats import kstest

    cam = noisy()
    design = Trials(cam, TARGET, FixedCentroid(), facts(cam), trials=8192, units=8, seed=seed)
    assert design.dx.shape == (8, 512) and design.row0.min() >= 0 and design.row0.max() <= 96 - 24 and design.col0.max() <= 128 - 24
    for values in (design.dx + 0.5, design.dy + 0.5):
        assert kstest(values.ravel(), "uniform").pvalue > 1e-6
    assert {0, 96 - 24} <= set(design.row0.ravel().tolist())


@pytest.mark.parametrize(
    "more",
    [
        [element("sensor.read_out", mode="field")],
        [
            element("grabber.sampling_clock", clock_mhz=12.0, samples=100),
            element("grabber.window_offset", row_offset=8, col_offset=5, rows=70, cols=90),
        ],
    ],
)
def test_targets_are_sought_where_the_frame_shows_them(more: list, seed: int) -> None:
    """Frames of another size and scale than the sensor's. Without noise, what aliasing does is left: rows or pixels are taken as they come,
    so that at most ±0.5 px, evenly spread (0.29 px), could be wrong, less over a target of several rows and columns.
    """
    cam = camera(*more, adc=True)
    assert cam.output_shape != cam.frame_shape
    got = monte_carlo(cam, TARGET, FixedCentroid(), trials=256, seed=seed)
    assert got.lost == 0
    for axis in (got.x, got.y):
        assert abs(axis.bias) < 0.15 and axis.u < 0.29


def test_probe_is_the_target_through_the_estimator() -> None:
    cam = noisy()
    probe = make_probe(facts(cam), TARGET, FixedCentroid())
    assert probe.signal_dn.shape == (64, 24, 24) and probe.background_dn == pytest.approx(5.0)
    total = (probe.signal_dn - probe.background_dn).sum(axis=(1, 2))
    assert np.allclose(total, math.pi * 3.5**2 * 150.0, rtol=2e-4)
    x = ((probe.signal_dn - probe.background_dn) * np.arange(24)).sum(axis=(1, 2)) / total
    assert np.allclose(x, probe.x_px, atol=2e-4)
    law = resolve(FixedCentroid(), TARGET, facts(cam))
    assert law.threshold_dn == pytest.approx(1.8) and law.background_dn == pytest.approx(5.0)
    assert np.array_equal(law.locate(probe.signal_dn)[0], probe.x_hat_px)
    with pytest.raises(InputError, match="threshold"):
        make_probe(facts(cam), TARGET, FixedCentroid(sigma=None, threshold_dn=1000.0))


REFUSED = ["square", "disc:diameter=0", "disc:peak=2", "disc:peak=x", "disc:size=3", "disc:background=-0.1", "disc:peak"]


@pytest.mark.parametrize("text", REFUSED)
def test_parse_target_refuses(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_target(text)
    assert refused.value.allowed or refused.value.remedy


def test_parse_target() -> None:
    assert parse_target("disc:diameter=5,blur=0.5,peak=0.4,background=0.1") == Target("disc", 5.0, 0.5, 0.4, 0.1)
    assert parse_target("disc") == Target()


def test_a_crop_shows_the_target_where_it_is(seed: int) -> None:
    """The centroid of what stands above half of the disc's height, taken here: with 100 pixels of noise 0.6 of 150 DN it is far nearer."""
    trials = Trials(noisy(), TARGET, FixedCentroid(), facts(noisy()), trials=8, units=2, seed=seed)
    crop = trials.crop()
    rows, cols = np.nonzero(crop.data_dn > 0.5 * (crop.data_dn.min() + crop.data_dn.max()))
    assert abs(cols.mean() - crop.x_px) < 0.3 and abs(rows.mean() - crop.y_px) < 0.3
    dx, dy = trials.errors(noisy())
    assert (crop.x_hat_px - crop.x_px, crop.y_hat_px - crop.y_px) == pytest.approx((dx[0, 0, 0], dy[0, 0, 0]), abs=1e-9)
