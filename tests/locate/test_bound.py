"""Cramér–Rao bounds against closed forms, exact laws, published tables and simulated estimators."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2, norm, poisson

from chance import rng_of
from pixmetry.camera.camera import load_camera
from pixmetry.core.errors import InputError
from pixmetry.locate.bound import closed_bounds as closed
from pixmetry.locate.bound.bound import bound, cramer_rao_bound, frames_worth
from pixmetry.locate.bound.fisher import information_per_dn2, kept_rounding_dn2, pixel_noise
from pixmetry.locate.bound.predictions import _law, names_for, predict
from pixmetry.locate.noise import NoiseModel, camera_noise
from pixmetry.locate.template.template_images import draw_images

FALSE_FAILURES = 1e-6
K = 0.0097
TAPE = NoiseModel((88 * K) ** 2 + 1 / 12, K)  # 88 electrons of dark noise at 0.0097 DN per electron, 8 bits
DISC = {"radius_px": 3.5, "blur_px": 0.7, "amplitude_dn": 150.0, "background_dn": 5.0}


def top_hat_centroids(radius_px: float, window_px: float, amplitude_e: float, read_e: float) -> tuple[float, float]:
    """Centroid and squared centroid of a top-hat disc of A electrons per pixel, in a round window of radius ρ.

    Notes
    -----
    u_c² = (σ_r²(ρ/R)⁴ + A)/(4πA²) and u_sq² = (σ_r² + A)/(πA²), with the background subtracted: propagation of the noise of the pixels
    through the estimators, sums over the disc as integrals.
    """
    plain = (read_e**2 * (window_px / radius_px) ** 4 + amplitude_e) / (4 * np.pi * amplitude_e**2)
    squared = (read_e**2 + amplitude_e) / (np.pi * amplitude_e**2)
    return float(np.sqrt(plain)), float(np.sqrt(squared))


def disc(diameter: float, **more: float) -> dict[str, float]:
    return DISC | {"radius_px": diameter / 2} | more


# ---- published tables and closed forms ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("diameter", "crb", "edge", "rounding", "centroid", "squared"),
    [
        (3, 0.00673, 0.0064, 0.0017, 0.0126, 0.0071),
        (5, 0.00486, 0.0049, 0.0012, 0.0077, 0.0059),
        (7, 0.00405, 0.0042, 0.0010, 0.0057, 0.0056),
        (10, 0.00338, 0.0035, 0.0008, 0.0046, 0.0056),
        (15, 0.00276, 0.0028, 0.00065, 0.0039, 0.0056),
        (20, 0.00239, 0.0025, 0.00056, 0.0036, 0.0056),
    ],
)
def test_the_table_of_discs(diameter: float, crb: float, edge: float, rounding: float, centroid: float, squared: float) -> None:
    """Discs of 150 DN, blur .7, on 5 DN, 8-bit camera: bound to 0.5 %, the others to their printed digits, centroids within R + 2.5."""
    found = cramer_rao_bound("disc", disc(diameter), TAPE, "light")
    assert found.place_px[1] == pytest.approx(crb, rel=5e-3)
    formula = closed.disc_edge(diameter / 2, 0.7, 150.0, np.sqrt(TAPE.variance_dn2(80.0)))
    assert formula == pytest.approx(edge, rel=0.02)
    alone = cramer_rao_bound("disc", disc(diameter), NoiseModel(1 / 12), "light", rounded=False)
    assert alone.place_px[1] == pytest.approx(rounding, rel=0.04)
    images = draw_images("disc", disc(diameter))
    pixels = pixel_noise(images, TAPE)
    for name, value in (("centroid", centroid), ("squared_centroid", squared)):
        got = predict(name, images, pixels, images.subset("light"), diameter / 2 + 2.5)
        assert got.noise_px == pytest.approx(value, rel=0.08)  # the window of the table has no part pixels at its edge


def test_the_modern_camera_of_the_table() -> None:
    """2.3 e-, peak 7.3 ke- on 50 e-, blur .9, 12 bits: the same diameters."""
    gain = 0.394
    noise = NoiseModel((2.3 * gain) ** 2 + 1 / 12, gain)
    values = []
    for d in (3, 5, 7, 10, 15, 20):
        target = disc(d, blur_px=0.9, amplitude_dn=7300 * gain, background_dn=50 * gain)
        values.append(cramer_rao_bound("disc", target, noise, "light").place_px[1])
    assert values == pytest.approx([0.0057, 0.0042, 0.0036, 0.0030, 0.0025, 0.0022], abs=1.2e-4)


@pytest.mark.parametrize("blur", [0.6, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("electrons", [1e3, 1e5])
def test_spot_in_shot_noise(blur: float, electrons: float) -> None:
    """s_a/√N: exact for Poisson light where pixels are fine; 0.5 % here."""
    spot = {"blur_px": blur, "amplitude_dn": electrons / (2 * np.pi * blur**2), "background_dn": 0.0}
    tiny = NoiseModel(1e-3 * spot["amplitude_dn"] * 1e-3, 1.0)
    found = cramer_rao_bound("spot", spot, tiny, "position", rounded=False, window_px=2 * int(6 * blur) + 3).place_px[1]
    assert found == pytest.approx(closed.spot_shot(blur, electrons), rel=5e-3)


@pytest.mark.parametrize(("blur", "table"), [(0.8, 0.913), (1.0, 0.866), (1.5, 0.828), (2.0, 0.815), (3.0, 0.805)])
def test_spot_in_read_noise(blur: float, table: float) -> None:
    """√(2/π) σ/A (1 + 1/12s²): 1.3 % at s = .8, less above; and the table's sums to their digits."""
    spot = {"blur_px": blur, "amplitude_dn": 1000.0, "background_dn": 0.0}
    window = 2 * int(5 * blur) + 3
    middle = cramer_rao_bound("spot", spot, NoiseModel(1.0), "position", rounded=False, window_px=window, phases=1).place_px[1]
    assert 1000 * middle == pytest.approx(table, abs=6e-4)  # the table is for a spot on the middle of a pixel
    found = cramer_rao_bound("spot", spot, NoiseModel(1.0), "position", rounded=False, window_px=window).place_px[1]
    assert found == pytest.approx(closed.spot_read(blur, 1000.0, 1.0), rel=0.013)


BOTH = [(1.0, 3000.0, 10.0), (1.3, 20000.0, 400.0), (1.5, 1e5, 3000.0), (1.0, 1e3, 25.0)]


@pytest.mark.parametrize(("blur", "electrons", "surround"), BOTH)
def test_spot_in_both(blur: float, electrons: float, surround: float) -> None:
    """Mortensen et al. (2010): 5e-4 with pixels of one width."""
    spot = {"blur_px": blur, "amplitude_dn": electrons / (2 * np.pi * blur**2), "background_dn": 0.0}
    found = cramer_rao_bound("spot", spot, NoiseModel(surround, 1.0), "position", rounded=False, window_px=2 * int(8 * blur) + 3).place_px[
        1
    ]
    assert found == pytest.approx(closed.spot_mixed(blur, electrons, surround), rel=1e-3)


def test_mortensens_integral_has_its_limits() -> None:
    assert closed.spot_mixed(1.0, 1e6, 1e-6) == pytest.approx(closed.spot_shot(1.0, 1e6), rel=1e-4)
    amplitude = 100.0 / (2 * np.pi)  # far below the noise of the surround: additive noise alone
    assert closed.spot_mixed(1.0, 100.0, 1e8) == pytest.approx(closed.spot_read(1.0, amplitude, 1e4), rel=1e-3)
    tau = 2 * np.pi * (1 + 1 / 12) * 50.0 / 2000.0  # Rieger and Stallinga's fit of the same, good to 2 % in u
    fitted = np.sqrt((1 + 1 / 12) / 2000 * (1 + 4 * tau + np.sqrt(2 * tau / (1 + 4 * tau))))
    assert closed.spot_mixed(1.0, 2000.0, 50.0) == pytest.approx(fitted, rel=0.02)


def test_lines_and_edges() -> None:
    """Read noise, vertical and oblique: the formulas to 1 %."""
    for angle in (90.0, 63.0):
        line = {"blur_px": 1.2, "amplitude_dn": 100.0, "length_px": 400.0, "angle_deg": angle}
        got = cramer_rao_bound("line", line, NoiseModel(4.0), "position", rounded=False, phases=2).place_px[1]
        assert got == pytest.approx(closed.line_read(1.2, 100.0, 2.0, 400.0), rel=0.01)
        got = cramer_rao_bound("edge", line, NoiseModel(4.0), "position", rounded=False, phases=2).place_px[1]
        assert got == pytest.approx(closed.edge_read(1.2, 100.0, 2.0, 400.0), rel=0.01)
    wide = line | {"width_px": 15.0, "angle_deg": 90.0}
    got = cramer_rao_bound("line", wide, NoiseModel(4.0), "position", rounded=False, phases=2).place_px[1]
    assert got == pytest.approx(closed.edge_read(1.2, 100.0, 2.0, 800.0), rel=0.01)
    electrons = np.sqrt(2 * np.pi) * 1.2 * 5000.0
    thin = {"blur_px": 1.2, "amplitude_dn": 5000.0, "length_px": 100.0}
    got = cramer_rao_bound("line", thin, NoiseModel(1e-3, 1.0), "position", rounded=False, phases=3, window_px=17).place_px[1]
    assert got == pytest.approx(closed.line_shot(1.2, electrons, 100.0), rel=5e-3)


def test_large_outlines_follow_their_edges() -> None:
    """Ellipse and ring of like noise everywhere: the edge formulas to 1 %."""
    flat = NoiseModel(4.0)
    ellipse = {"semi_major_px": 30.0, "semi_minor_px": 18.0, "angle_deg": 25.0, "blur_px": 1.0, "amplitude_dn": 100.0}
    found = cramer_rao_bound("ellipse", ellipse, flat, "position", rounded=False, phases=1)
    formula = closed.ellipse_edge(30.0, 18.0, 25.0, 1.0, 100.0, 2.0)
    assert (found.u("x_px")[1], found.u("y_px")[1]) == pytest.approx(formula, rel=0.01)
    ring = {"radius_px": 25.0, "inner_radius_px": 14.0, "blur_px": 1.0, "amplitude_dn": -100.0, "background_dn": 150.0}
    got = cramer_rao_bound("ring", ring, flat, "position", rounded=False, phases=1).place_px[1]
    assert got == pytest.approx(closed.ring_edge(14.0, 25.0, 1.0, 100.0, 2.0), rel=0.01)


def test_centroids_of_a_top_hat_and_the_rule_between_them() -> None:
    """Sharp large disc: the two formulas to 2 %; squared wins only if σ_r²((ρ/R)⁴ − 4) > 3A."""
    for read, amplitude, window in ((5.0, 2000.0, 24.0), (200.0, 500.0, 40.0)):
        target = {"radius_px": 20.0, "blur_px": 0.3, "amplitude_dn": amplitude, "background_dn": 0.0}
        images = draw_images("disc", target, phases=1, window_px=91)
        pixels = pixel_noise(images, NoiseModel(read**2, 1.0), rounded=False)
        got = [predict(n, images, pixels, images.place, window) for n in ("centroid", "squared_centroid")]
        plain, squared = top_hat_centroids(20.0, window, amplitude, read)
        assert got[0].noise_px == pytest.approx(plain, rel=0.02)
        more = 1 + read**2 * (window / 20) ** 4 / (2 * amplitude**2) * read**2 / (read**2 + amplitude)  # the squares of the noise itself
        assert got[1].noise_px == pytest.approx(squared * np.sqrt(more), rel=0.03)
        assert (squared < plain) == (read**2 * ((window / 20) ** 4 - 4) > 3 * amplitude)


def test_shot_limited_centroids_of_a_spot() -> None:
    """Plain: s²/N, the bound; squared: 16/9 of it, as an unweighted Gaussian fit (Thompson and others)."""
    spot = {"blur_px": 1.5, "amplitude_dn": 1e5, "background_dn": 0.0}
    images = draw_images("spot", spot, window_px=25)
    pixels = pixel_noise(images, NoiseModel(0.01, 1.0), rounded=False)
    least = cramer_rao_bound("spot", spot, NoiseModel(0.01, 1.0), "position", rounded=False, window_px=25).place_px[1]
    u = {n: predict(n, images, pixels, images.subset("shape"), 11.0) for n in ("centroid", "squared_centroid")}
    assert u["centroid"].noise_px == pytest.approx(least, rel=0.01)
    assert (u["squared_centroid"].noise_px / least) ** 2 == pytest.approx(16 / 9, rel=0.03)
    for name in ("template_unweighted", "gaussian"):
        assert (predict(name, images, pixels, images.subset("shape")).noise_px / least) ** 2 == pytest.approx(16 / 9, rel=0.03)


# ---- what a grey value tells ------------------------------------------------------------------------------------------------------------


def exact_information(mu: float, sigma: float, top: int) -> float:
    """Σ p'²/p over the codes 0 … top, by differences."""
    edges = np.concatenate([[-np.inf], np.arange(top) + 0.5, [np.inf]])
    h = 1e-5

    def law(m: float) -> np.ndarray:
        return np.diff(norm.cdf(edges, m, sigma))

    p, slope = law(mu), (law(mu + h) - law(mu - h)) / (2 * h)
    return float((slope[p > 1e-12] ** 2 / p[p > 1e-12]).sum())


@pytest.mark.parametrize("sigma", [0.1, 0.2, 0.39])
@pytest.mark.parametrize("mu", [20.0, 20.25, 20.5, 0.3, 40.6, -0.4])
def test_little_noise_is_counted_by_codes(sigma: float, mu: float) -> None:
    model = NoiseModel(sigma**2 + 1 / 12, low_dn=0, high_dn=40)
    got = information_per_dn2(np.array([mu]), model)[0]
    assert got == pytest.approx(exact_information(mu, sigma, 40), rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(("sigma", "off"), [(0.41, 0.04), (0.5, 0.008), (1.0, 1e-4), (2.0, 1e-5)])
def test_dithered_rounding_is_a_twelfth(sigma: float, off: float) -> None:
    for mu in (20.0, 20.25, 20.5):
        got = information_per_dn2(np.array([mu]), NoiseModel(sigma**2 + 1 / 12))[0]
        assert got == pytest.approx(exact_information(mu, sigma, 40), rel=off)


@pytest.mark.parametrize("mu", [-1.0, 0.4, 2.0, 38.0, 39.5, 41.5])
@pytest.mark.parametrize("sigma", [1.5, 3.0])
def test_what_the_ends_of_the_scale_cut_off(mu: float, sigma: float) -> None:
    got = information_per_dn2(np.array([mu]), NoiseModel(sigma**2 + 1 / 12, low_dn=0, high_dn=40))[0]
    assert got == pytest.approx(exact_information(mu, sigma, 40), rel=5e-3)


def test_rounding_that_averaging_leaves() -> None:
    """Against the mean of a rounded normal variable, summed over codes."""
    codes = np.arange(-30, 31)
    for sigma in (0.1, 0.25, 0.4):
        mu = (np.arange(400) + 0.5) / 400
        share = norm.cdf(codes + 0.5, mu[:, None], sigma) - norm.cdf(codes - 0.5, mu[:, None], sigma)
        left = ((share * codes).sum(axis=1) - mu) ** 2
        assert kept_rounding_dn2(np.array([sigma]))[0] == pytest.approx(left.mean(), rel=1e-6)
    assert kept_rounding_dn2(np.array([1e-4]))[0] == pytest.approx(1 / 12, rel=0.01)


def test_gaussian_information_stands_for_poisson_light() -> None:
    """Exact information of Poisson counts with read noise, by the law of their sum: 1/V to 1 % from 20 electrons on."""
    for mean, read in ((20.0, 2.0), (100.0, 3.0)):
        n, y = np.arange(0, 400), np.arange(-60, 500, 0.05)
        weight = norm.pdf(y[:, None], n, read)
        law = weight @ poisson.pmf(n, mean)
        slope = weight @ (poisson.pmf(n - 1, mean) - poisson.pmf(n, mean))
        exact = (slope[law > 1e-14] ** 2 / law[law > 1e-14]).sum() * 0.05
        assert information_per_dn2(np.array([mean]), NoiseModel(read**2, 1.0), rounded=False)[0] == pytest.approx(exact, rel=0.01)


DARK_ELLIPSE = {"semi_major_px": 6.0, "semi_minor_px": 4.0, "angle_deg": 30.0, "blur_px": 0.8, "amplitude_dn": -150.0}
DARK_ELLIPSE["background_dn"] = 200.0

# ---- structure ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("disc", DISC),
        ("ring", DISC | {"radius_px": 6.0, "inner_radius_px": 3.0}),
        ("spot", {"blur_px": 1.2, "amplitude_dn": 150.0, "background_dn": 5.0}),
        ("ellipse", DARK_ELLIPSE),
        ("line", {"blur_px": 1.0, "amplitude_dn": 150.0, "length_px": 30.0, "angle_deg": 70.0}),
        ("edge", {"blur_px": 1.0, "amplitude_dn": 150.0, "length_px": 30.0, "angle_deg": 70.0}),
    ],
)
def test_more_unknowns_cost_and_no_estimator_beats_the_bound(kind: str, parameters: dict[str, float]) -> None:
    noise = NoiseModel(1.0, 0.05, 0.005)
    result = bound(kind, parameters, noise, "shape")
    ladder = [result.bounds[n].place_px[1] for n in ("position", "light", "shape", "planes")]
    assert all(b >= a * (1 - 1e-9) for a, b in zip(ladder, ladder[1:], strict=False))
    assert [p.name for p in result.predictions] == list(names_for(kind))
    for p in result.predictions:
        assert p.noise_px >= ladder[0] * (1 - 2e-3)  # to what part pixels at the edge of a window do to a first-order formula
    assert result.chosen.noise_px == pytest.approx(result.u_px, rel=1e-9)
    assert sum(x.share for x in result.limits) == pytest.approx(1.0, abs=1e-5)
    assert result.closed_forms_px and all(np.isfinite(v) for v in result.closed_forms_px.values())


def test_frames_average_what_is_temporal() -> None:
    one = bound("disc", DISC, NoiseModel(1.0, 0.02))
    nine = bound("disc", DISC, NoiseModel(1.0, 0.02), frames=9)
    assert nine.u_px == pytest.approx(one.u_px / 3, rel=1e-9) and one.frames_worth is None
    fixed = [bound("disc", DISC, NoiseModel(1.0, 0.02, 0.01), frames=n) for n in (1, 10**9)]
    floor = fixed[1].u_px
    worth = fixed[0].frames_worth
    assert worth is not None
    for n in (worth - 1, worth):
        u = bound("disc", DISC, NoiseModel(1.0, 0.02, 0.01), frames=n).chosen.u_px
        assert (u <= 1.05 * floor * (1 + 1e-9)) == (n == worth)


def test_the_rule_of_frames() -> None:
    """0.006 px that averages and 0.01 px that does not: four frames."""
    assert frames_worth(lambda n: np.hypot(0.006 / np.sqrt(n), 0.01)) == 4
    assert frames_worth(lambda n: 0.006 / np.sqrt(n)) is None
    assert frames_worth(lambda n: np.hypot(1e-4 / np.sqrt(n), 0.01)) == 1


def test_the_bound_scales_with_contrast_and_noise() -> None:
    base = cramer_rao_bound("disc", DISC, NoiseModel(1.0), rounded=False).place_px[1]
    dark = disc(7, amplitude_dn=-300.0, background_dn=400)
    assert cramer_rao_bound("disc", dark, NoiseModel(1.0), rounded=False).place_px[1] == pytest.approx(base / 2)
    assert cramer_rao_bound("disc", DISC, NoiseModel(9.0), rounded=False).place_px[1] == pytest.approx(3 * base)


# ---- estimators, simulated -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated(request: pytest.FixtureRequest) -> tuple:
    noise = NoiseModel(2.0**2 + 1 / 12, 0.3, low_dn=0, high_dn=255)
    images = draw_images("disc", disc(6, background_dn=30.0), phases=2)
    mean = np.repeat(images.mean, 500, axis=0)
    frames = np.round(mean + rng_of(request).normal(size=mean.shape) * np.sqrt(4.0 + 0.3 * mean))
    return images, pixel_noise(images, noise), np.repeat(images.lever, 500, axis=0), frames


@pytest.mark.parametrize("level", [-3.0, 0.0, 4.0, 7.0, 11.0, 40.0])
def test_noise_through_the_laws_of_the_centroids(level: float) -> None:
    """Mean, variance and slope of f(level + n), σ = 2, threshold 6, by summing over the normal law."""
    n = np.linspace(-16, 16, 64001)
    weight = norm.pdf(n, 0, 2) * (n[1] - n[0])

    def moments(f: Callable[[np.ndarray], np.ndarray], at: float) -> tuple[float, float]:
        mean = (weight * f(at + n)).sum()
        return mean, (weight * f(at + n) ** 2).sum() - mean**2

    laws = {
        "centroid": lambda v: v,
        "squared_centroid": lambda v: v**2,
        "soft_threshold": lambda v: np.maximum(v - 6, 0),
        "hard_threshold": lambda v: np.where(v > 6, v, 0.0),
    }
    for name, f in laws.items():
        mean, variance, slope = (float(v[0]) for v in _law(name, np.array([level]), np.array([4.0]), 6.0))
        assert (mean, variance) == pytest.approx(moments(f, level), rel=1e-3, abs=1e-3)
        assert slope == pytest.approx((moments(f, level + 0.5)[0] - moments(f, level - 0.5)[0]), rel=0.06, abs=0.02)


@pytest.mark.parametrize("name", ["centroid", "squared_centroid", "soft_threshold", "hard_threshold"])
def test_predicted_centroids_are_those_of_simulated_images(simulated: tuple, name: str, rng: np.random.Generator) -> None:
    """2000 images, window about the true place, one step towards the fixed point: catches 8 % of the standard deviation at 1e-6."""
    images, pixels, lever, frames = simulated
    told = predict(name, images, pixels, images.place, 5.0)
    level = frames - 30.0
    threshold = 3 * np.sqrt(np.median(pixels.total))
    f = {
        "centroid": lambda v: v,
        "squared_centroid": lambda v: v**2,
        "soft_threshold": lambda v: np.maximum(v - threshold, 0),
        "hard_threshold": lambda v: np.where(v > threshold, v, 0),
    }[name](level)
    inside = np.clip(5.5 - np.hypot(lever[:, 0], lever[:, 1]), 0, 1)
    psi = (f[:, None] * inside[:, None] * lever).sum(axis=2)
    step = 1e-3  # the answer to a move of the target, from noise-free images moved by the template
    change = images.columns(images.place)
    sigma = np.sqrt(pixels.total)
    draw = rng.normal(size=(400, *images.mean.shape)) * sigma
    law = {
        "centroid": lambda v: v,
        "squared_centroid": lambda v: v**2,
        "soft_threshold": lambda v: np.maximum(v - threshold, 0),
        "hard_threshold": lambda v: np.where(v > threshold, v, 0),
    }[name]
    answer = 0.0
    for axis in (0, 1):
        moved = [law(images.mean - 30.0 + draw + s * step * 100 * change[:, axis]).mean(axis=0) for s in (-1, 1)]
        weight = np.clip(5.5 - images.distance, 0, 1) * images.lever[:, axis]
        answer += 0.5 * (((moved[1] - moved[0]) * weight).sum(axis=1) / (2 * step * 100)).mean()
    place = psi.reshape(4, 500, 2) / answer
    variance = place.var(axis=1, ddof=1).mean()
    dof = 2 * 4 * 499
    low, high = chi2.ppf([FALSE_FAILURES / 2, 1 - FALSE_FAILURES / 2], dof) / dof
    slack = 1.08 if name == "hard_threshold" else 1.03  # of the answer, which is drawn too
    assert low / slack < variance / told.noise_px**2 < high * slack
    bias = place.mean(axis=1)
    spread = np.sqrt((bias**2).mean())
    assert abs(spread - told.s_curve_px) < 6 * told.noise_px / np.sqrt(500)


def test_template_fits_reach_what_is_predicted(simulated: tuple) -> None:
    """Linear least squares about the truth, both weightings, 2000 images: catches 8 % of the standard deviation at 1e-6."""
    images, pixels, _, frames = simulated
    unknowns = images.subset("shape")
    for name in ("template", "template_unweighted"):
        told = predict(name, images, pixels, unknowns)
        squares = 0.0
        for i in range(4):
            columns = images.columns(unknowns)[i].T
            weight = 1 / np.sqrt(pixels.total[i]) if name == "template" else np.ones(len(columns))
            miss = frames.reshape(4, 500, -1)[i] - images.mean[i]
            steps = np.linalg.lstsq(columns * weight[:, None], (miss * weight).T, rcond=None)[0]
            squares += (steps[:2] ** 2).sum()
        low, high = chi2.ppf([FALSE_FAILURES / 2, 1 - FALSE_FAILURES / 2], 4000)
        assert low < squares / told.noise_px**2 < high


# ---- cameras, and bad input ----------------------------------------------------------------------------------------------------------


def test_a_preset_tells_its_noise() -> None:
    """Its parameters, to what 12 frames a level tell: variance 2 %, gain 2 %, patterns 10 %."""
    read = camera_noise(load_camera("imx264_like"))
    model, dark = read.model, 2.3**2 + 0.2**2 + 2.0 * 0.01  # amplifier, row noise, dark electrons
    assert read.pitch_um == (3.45, 3.45) and read.aperture_px == 1.0 and model.origin == "camera"
    assert model.constant_dn2 == pytest.approx(0.38**2 * dark + 1 / 12, rel=0.03)
    assert model.slope_dn == pytest.approx(0.38, rel=0.03) and model.black_dn == pytest.approx(32, abs=0.1)
    assert model.high_dn == pytest.approx(32 + 0.38 * 10400, rel=0.01)  # the full well, which ends the scale before the converter does
    assert read.pattern_dn == pytest.approx(0.38 * 1.2, rel=0.15) and model.pattern_rel == pytest.approx(0.005, rel=0.2)


def test_a_camera_without_patterns_shows_none() -> None:
    """What 12 frames leave of the temporal noise in their mean is 0.27 DN in the dark and 0.3 % in the light.

    Over 4096 pixels it is known to 2.2 % of its square, so that 4.9 standard errors of the difference are a third of it.
    """
    read = camera_noise(load_camera("imx264_like").switched(off=["sensor.dsnu", "sensor.prnu"]))
    assert read.pattern_dn < 0.1 and read.model.pattern_rel < 0.0012


def test_a_camera_with_a_logarithmic_response_has_a_noise_too() -> None:
    """It has no gain in DN per electron, and its variance does not rise with the light."""
    assert camera_noise(load_camera("cmos_log_fuga15")).model.slope_dn < 0.01


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"kind": "square"}, "no such kind of target"),
        ({"parameters": {"radius_px": 3.0}}, "needs more parameters"),
        ({"parameters": DISC | {"radius_px": -1.0}}, "radius_px cannot be used"),
        ({"parameters": DISC | {"amplitude_dn": 0.0}}, "amplitude_dn cannot be used"),
        ({"parameters": DISC | {"blur_px": np.nan}}, "blur_px cannot be used"),
        ({"parameters": DISC | {"weight": 1.0}}, "no such parameter"),
        ({"unknowns": "shapes"}, "no such parameter"),
        ({"unknowns": "amplitude_dn"}, "the position is not among"),
        ({"window_px": 10}, "window cannot be used"),
        ({"parameters": DISC | {"radius_px": 900.0}}, "the target is too large"),
        ({"noise": NoiseModel(0.01)}, "smaller than that of rounding"),
        ({"noise": NoiseModel(1 / 12)}, "no bound without noise"),
        ({"frames": 0}, "number of frames"),
        ({"phases": 0}, "number of phases"),
        ({"aperture_px": 1.5}, "aperture"),
        ({"estimator": "magic"}, "estimator cannot be predicted"),
        ({"noise": NoiseModel(1.0, low_dn=0, high_dn=3)}, "does not determine the position"),
    ],
)
def test_bad_input_is_told_in_one_line(change: dict, text: str) -> None:
    good = {"kind": "disc", "parameters": DISC, "noise": NoiseModel(1.0)}
    with pytest.raises(InputError, match=text) as caught:
        bound(**(good | change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("phases", [1, 2])
def test_too_few_phases_are_refused_since_an_s_curve_would_be_lost_or_doubled(phases: int) -> None:
    """At the pixel's centre alone an S-curve is 0; the bound of a single phase is still to be had."""
    sharp = disc(2, blur_px=0.3)
    images = draw_images("disc", sharp, phases=phases, window_px=15)
    noise = NoiseModel(1.0)
    centroid = predict("hard_threshold", images, pixel_noise(images, noise), ("x_px", "y_px"), 4.0)
    fine = draw_images("disc", sharp, phases=12, window_px=15)
    whole = predict("hard_threshold", fine, pixel_noise(fine, noise), ("x_px", "y_px"), 4.0)
    assert not 0.9 < centroid.s_curve_px / whole.s_curve_px < 1.1
    with pytest.raises(InputError, match="so few phases"):
        bound("disc", sharp, noise, phases=phases)
    assert cramer_rao_bound("disc", sharp, noise, phases=phases).place_px[1] > 0
