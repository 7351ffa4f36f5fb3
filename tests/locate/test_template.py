"""Template fits against images made another way, numerical derivatives, SciPy's least squares, and the distribution of their errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.stats import chi2, kstest, norm

from locate import honest_cases, rendered
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.job import locate
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template.template import KINDS, PARAMETERS, choose_planes, fit_template, model, noise_from_image
from pixmetry.locate.template.template_fit import Windows, efficiency

RATE = 1e-6  # of false failures of a statistical test
ROWS, COLS = 26, 30
AT = (np.arange(ROWS), np.arange(COLS))
SHAPE = {"disc": [5.3], "ellipse": [6.2, 4.7, 0.8], "ring": [6.8, 3.9], "spot": []}
PLACE = (14.3, 12.6)


def parameters(kind: str, blur: float = 0.63, planes: bool = True) -> np.ndarray:
    rest = [0.3, -0.2, 0.03, -0.05] if planes else []
    return np.array([*PLACE, *SHAPE[kind], blur * (2 if kind == "spot" else 1), 150.0, 20.0, *rest])


def other_image(kind: str, blur: float, aperture: float, light: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The same target by the renderer of the tests, amplitude 1."""
    if kind == "spot":
        return rendered.spot(*PLACE, 2 * blur, AT, aperture=aperture)
    if kind == "ring":
        return rendered.ring(*PLACE, *SHAPE[kind], blur, AT, aperture=aperture, light=light)
    if kind == "disc":
        return rendered.disc(*PLACE, *SHAPE[kind], blur, AT, aperture=aperture, light=light)
    xx, yy, xy = SHAPE[kind]
    axes, turn = np.linalg.eigh([[xx, xy], [xy, yy]])
    angle = np.rad2deg(np.arctan2(turn[1, 1], turn[0, 1]))
    return rendered.ellipse(*PLACE, axes[1], axes[0], angle, blur, AT, aperture=aperture, light=light)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("blur", "aperture"), [(0.15, 1.0), (0.4, 0.7), (0.63, 1.0), (0.63, 0.0), (2.9, 1.0)])
def test_images_are_those_of_an_independent_renderer(kind: str, blur: float, aperture: float) -> None:
    p = parameters(kind, blur, planes=False)
    p[-2:] = 1.0, 0.0
    assert np.abs(model(kind, p, ROWS, COLS, aperture_px=aperture)[0] - other_image(kind, blur, aperture)).max() < 6e-5


@pytest.mark.parametrize("kind", ["disc", "ellipse", "ring"])
def test_light_that_falls_off_over_the_surface(kind: str) -> None:
    p = np.concatenate([parameters(kind, planes=False), [0, 0, 0.03, -0.05]])
    p[-6:-4] = 1.0, 0.0
    assert np.abs(model(kind, p, ROWS, COLS)[0] - other_image(kind, 0.63, 1.0, (0.03, -0.05))).max() < 2e-5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("light_on", ["surface", "image"])
def test_derivatives_are_those_of_differences(kind: str, light_on: str) -> None:
    """Central differences of step 0.01: their own error is of second order, the template is rough by 1e-5 of the amplitude."""
    p = parameters(kind)
    _, jacobian = model(kind, p, ROWS, COLS, light_on=light_on)
    for j in range(len(p)):
        step = np.zeros(len(p))
        step[j] = 0.01
        up, down, up2, down2 = (model(kind, p + k * step, ROWS, COLS, light_on=light_on)[0] for k in (1, -1, 2, -2))
        numeric = (8 * (up - down) - (up2 - down2)) / 0.12
        assert np.abs(numeric - jacobian[j]).max() < 3e-3 * np.abs(jacobian[j]).max() + 1e-6


def test_a_window_sees_the_same_wherever_it_is_cut() -> None:
    whole, derivatives = model("disc", [14.3, 12.6, 5.3, 0.63, 150, 20], ROWS, COLS)
    part, some = model("disc", [14.3 - 11, 12.6 - 9, 5.3, 0.63, 150, 20], 11, 13)
    assert np.allclose(part, whole[9:20, 11:24], atol=1e-4)
    assert np.allclose(some, derivatives[:, 9:20, 11:24], atol=2e-4)


@pytest.mark.parametrize(
    ("kind", "given"),
    [("square", [1, 2, 3, 4, 5, 6]), ("disc", [1, 2, 3]), ("disc", [1, 2, -3, 1, 1, 1]), ("ring", [1, 2, 3, 4, 1, 1, 1]),
     ("spot", [1, 2, 0, 1, 1]), ("ellipse", [1, 2, 3, 3, 4, 1, 1, 1]), ("disc", [np.nan, 2, 3, 1, 1, 1])],
)  # fmt: skip
def test_parameters_that_are_no_target(kind: str, given: list[float]) -> None:
    with pytest.raises(InputError):
        model(kind, given, 9, 9)


def field(
    rng: np.random.Generator, kind: str, count: int, p: list[float], planes: tuple[float, ...] = (0, 0, 0, 0), sampled: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Targets]:
    """A frame of ``count``² equal targets at random phases, without noise, and rough start values.

    ``p``: shape, blur, amplitude, background. The images are the renderer's; with ``sampled`` Φ((R − ρ)/s) at the pixels' centres.
    """
    shape, (blur, amplitude, background) = p[:-3], p[-3:]
    size = max(shape) if shape else 0.0
    side = int(2 * (size + 4.5 * np.hypot(blur, 0.3) + 4))
    n = count * count
    x0, y0 = (np.arange(n) % count) * side, (np.arange(n) // count) * side
    x, y = x0 + side / 2 + rng.uniform(-0.5, 0.5, n), y0 + side / 2 + rng.uniform(-0.5, 0.5, n)
    frame = np.empty((count * side, count * side))
    for k in range(n):
        at = (y0[k] + np.arange(side), x0[k] + np.arange(side))
        if kind == "spot":
            image = rendered.spot(x[k], y[k], blur, at)
        elif sampled:
            image = rendered.edge_disc(x[k], y[k], shape[0], blur, at)
        elif kind == "ring":
            image = rendered.ring(x[k], y[k], *shape, blur, at, light=planes[2:])
        else:
            image = rendered.disc(x[k], y[k], shape[0], blur, at, light=planes[2:])
        ground = planes[0] * (at[1] - x[k]) + planes[1] * (at[0][:, None] - y[k])
        frame[np.ix_(*at)] = background + ground + amplitude * image
    edge = np.hypot(blur, 0.0 if sampled else 0.29)
    seen = size if size > edge else np.hypot(size, 1.18 * edge)  # radius at half height
    one = np.ones(n)
    reach = int(np.ceil(seen))
    row, col = np.rint(y).astype(int), np.rint(x).astype(int)
    targets = Targets(
        x + rng.normal(0, 0.1, n), y + rng.normal(0, 0.1, n), seen * rng.uniform(0.95, 1.05, n), seen * one, 0 * one,
        edge * rng.uniform(0.85, 1.15, n), amplitude * one, background * one, 0 * one, 0 * one, one, row - reach, row + reach + 1,
        col - reach, col + reach + 1, np.zeros(n, np.uint32),
    )  # fmt: skip
    return frame, x, y, targets


def errors(found: Positions, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Position errors in standard uncertainties, x and y."""
    return np.concatenate([(found.x_px - x) / np.sqrt(found.var_x_px2), (found.y_px - y) / np.sqrt(found.var_y_px2)])


def assert_normal(z: np.ndarray) -> None:
    """N(0, 1) by Kolmogorov's test, mean and variance; of 400 errors it catches uncertainties wrong by 20 % or a shift by u/4."""
    assert np.isfinite(z).all()
    assert kstest(z, "norm").pvalue > RATE / 3
    assert abs(z.mean()) * np.sqrt(len(z)) < -norm.ppf(RATE / 6)
    low, high = chi2.ppf([RATE / 6, 1 - RATE / 6], len(z))
    assert low < (z**2).sum() < high


@pytest.mark.parametrize(
    ("kind", "p", "sigma"),
    [("disc", [1.0, 0.4, 150, 20], 0.5), ("disc", [1.0, 1.2, 150, 20], 2.0), ("disc", [3.0, 0.3, 150, 20], 1.5),
     ("disc", [5.0, 0.7, -90, 150], 8.0), ("disc", [5.0, 2.0, 150, 20], 2.0), ("disc", [12.0, 0.7, 150, 20], 1.5),
     ("ellipse", [5.0, 0.7, 150, 20], 1.5), ("ring", [6.0, 3.0, 0.7, 150, 20], 1.5), ("spot", [1.3, 150, 20], 1.5)],
)  # fmt: skip
def test_errors_follow_their_own_covariance(kind: str, p: list[float], sigma: float, rng: np.random.Generator) -> None:
    frame, x, y, targets = field(rng, kind, 14, p)
    image = np.clip(np.rint(frame + rng.normal(0, sigma, frame.shape)), 0, 255).astype(np.uint8)
    found = fit_template(image, targets, NoiseModel(sigma**2 + 1 / 12), kind)
    assert not (found.flags & Flag.NOT_CONVERGED).any()
    assert_normal(errors(found, x, y))
    assert np.median(found.more["chi2_per_dof"]) == pytest.approx(1, abs=0.15)  # rounding of little noise is not 1/12 at every level


@pytest.mark.parametrize("likelihood", ["least_squares", "poisson_gaussian"])
@pytest.mark.parametrize(("amplitude", "background", "read"), [(25.0, 1.0, 0.4), (60.0, 4.0, 1.5), (5000.0, 20.0, 2.0)])
def test_photons(likelihood: str, amplitude: float, background: float, read: float, rng: np.random.Generator) -> None:
    """From a few electrons to many: no bias, and the stated uncertainty."""
    frame, x, y, targets = field(rng, "disc", 14, [4.0, 0.8, amplitude, background])
    gain = 0.5
    image = (gain * (rng.poisson(frame) + rng.normal(0, read, frame.shape)) + 3.0).astype(np.float32)
    targets = replace(targets, amplitude_dn=gain * targets.amplitude_dn, background_dn=3 + gain * targets.background_dn)
    found = fit_template(image, targets, NoiseModel((gain * read) ** 2, gain, black_dn=3.0), "disc", likelihood=likelihood)
    assert_normal(errors(found, x, y))


def test_little_read_noise_is_used_by_the_exact_likelihood(rng: np.random.Generator) -> None:
    """With 0.5 electrons of read noise and most pixels dark, the shifted Poisson number throws information away: 3 % of the variance."""
    frame, x, y, targets = field(rng, "spot", 20, [1.4, 10.0, 0.05])
    image = (rng.poisson(frame) + rng.normal(0, 0.5, frame.shape)).astype(np.float32)
    noise = NoiseModel(0.5**2, 1.0)
    exact = fit_template(image, targets, noise, "spot", likelihood="poisson_gaussian")
    plain = fit_template(image, targets, noise, "spot")
    assert np.median(exact.var_x_px2) < 0.985 * np.median(plain.var_x_px2)
    assert_normal(errors(exact, x, y))


def test_information_of_few_electrons() -> None:
    """Without read noise a Poisson number has all of 1/µ; with much of it a normal one has 1/σ²."""
    assert efficiency(0.05)[::10] == pytest.approx(1 + 0.05**2 / (1e-3 * np.exp(np.arange(0, len(efficiency(0.05)), 10) / 8)), rel=2e-3)
    assert efficiency(2.9)[-1] == pytest.approx(1, abs=2e-3)
    assert efficiency(5.0).size == 0


@pytest.mark.parametrize("likelihood", ["least_squares", "poisson_gaussian"])
def test_a_rough_blur_as_broad_as_the_disc_loses_none(likelihood: str, rng: np.random.Generator) -> None:
    """Of 2.7 px, where it is 0.7, and a pixel is black, so that the sums of the grey values tell no better one: some went on to a narrow,
    high and blurred disc, and did not come to rest."""
    frame, x, y, targets = field(rng, "disc", 15, [3.0, 0.7, 170.0, 10.0])
    image = np.clip(np.rint(0.5 * rng.poisson(frame / 0.5) + rng.normal(0, 0.5, frame.shape)), 0, 255).astype(np.uint8)
    image[np.rint(y).astype(int) + 5, np.rint(x).astype(int)] = 0
    rough = replace(targets, blur_px=np.full(len(x), 2.7))
    found = fit_template(image, rough, NoiseModel(0.25, 0.5), "disc", likelihood=likelihood)
    assert not (found.flags & Flag.NOT_CONVERGED).any()
    assert np.hypot(found.x_px - x, found.y_px - y).max() < 0.2


@pytest.mark.parametrize("kind", ["disc", "ring", "spot"])
def test_scipy_finds_the_same(kind: str, rng: np.random.Generator) -> None:
    """`curve_fit` of the renderer's images to the same pixels, one target."""
    p = {"disc": [4.2, 0.7], "ring": [6.0, 3.0, 0.7], "spot": [1.4]}[kind]
    frame, x, y, targets = field(rng, kind, 1, [*p, 120.0, 30.0])
    image = (frame + rng.normal(0, 1, frame.shape)).astype(np.float32)
    found = fit_template(image, targets, NoiseModel(1.0), kind, background_plane=False, light_plane=False)
    w = Windows.of(image, targets, NoiseModel(1.0), kind, 1.0, True, False)
    away = np.hypot(*(np.indices(image.shape) - np.array([targets.y_px[0], targets.x_px[0]])[:, None, None]))
    rows, cols = np.nonzero(away <= w.about.outer[0] + w.about.reach[0, 0])

    def mean(_: np.ndarray, *q: float) -> np.ndarray:
        at = (np.arange(image.shape[0]), np.arange(image.shape[1]))
        draw = getattr(rendered, kind)
        return (q[-1] + q[-2] * draw(*q[:-2], at))[rows, cols]

    best, covariance = curve_fit(mean, None, image[rows, cols], [x[0], y[0], *p, 120, 30], sigma=np.ones(len(rows)), absolute_sigma=True)
    got = np.array([found.x_px[0], found.y_px[0], *(found.more[name][0] for name in PARAMETERS[kind][2:])])
    assert (np.abs(got - best) < 0.1 * np.sqrt(np.diag(covariance))).all()  # a fit stops where 0.06 are left
    assert found.var_x_px2[0] == pytest.approx(covariance[0, 0], rel=0.02)
    assert found.var_y_px2[0] == pytest.approx(covariance[1, 1], rel=0.02)


@pytest.mark.parametrize("radius", [2.0, 3.0, 5.5, 8.0])
@pytest.mark.parametrize("blur", [0.5, 0.7])
def test_s_curve_is_flat(radius: float, blur: float, rng: np.random.Generator) -> None:
    """Without noise: below 0.001 px at every phase, also for discs sampled as Φ((R − ρ)/s), whose pixels have no area."""
    for sampled in (False, True):
        if sampled and radius < 3:
            continue
        edge = np.hypot(blur, 0.29) if sampled else blur
        frame, x, y, targets = field(rng, "disc", 10, [radius, edge, 180.0, 10.0], sampled=sampled)
        found = fit_template(frame.astype(np.float32), targets, NoiseModel(1.5**2), "disc")
        assert max(np.abs(found.x_px - x).max(), np.abs(found.y_px - y).max()) < (0.001 if sampled else 1e-4)


def test_light_falling_ten_per_cent_across_a_disc(rng: np.random.Generator) -> None:
    """A plane of the light leaves no bias, where its neglect shifts the disc by many uncertainties; small noise, mean of 100."""
    frame, x, y, targets = field(rng, "disc", 10, [5.0, 0.7, 150.0, 20.0], (0, 0, 0.01, 0.0))
    image = (frame + rng.normal(0, 1.0, frame.shape)).astype(np.float32)
    found = fit_template(image, targets, NoiseModel(1.0), "disc")
    assert (found.flags & Flag.GRADIENT).all()
    assert abs((found.x_px - x).mean()) < 0.001 + 5 * np.sqrt(found.var_x_px2.mean() / 100)
    assert_normal(errors(found, x, y))
    without = fit_template(image, targets, NoiseModel(1.0), "disc", background_plane=False, light_plane=False)
    assert (without.x_px - x).mean() > 0.01
    still = fit_template(frame.astype(np.float32), targets, NoiseModel(0.01), "disc", background_plane=False, light_plane=True)
    assert np.abs(still.x_px - x).max() < 1e-4


def test_sloping_background(rng: np.random.Generator) -> None:
    frame, x, y, targets = field(rng, "disc", 12, [5.0, 0.7, 150.0, 40.0], (0.25, -0.1, 0, 0))
    image = np.rint(frame + rng.normal(0, 1.5, frame.shape)).astype(np.uint8)
    targets = replace(targets, background_x_dn_per_px=np.full(len(targets), 0.25), background_y_dn_per_px=np.full(len(targets), -0.1))
    found = fit_template(image, targets, NoiseModel(1.5**2 + 1 / 12), "disc")
    assert (found.flags & Flag.UNEVEN_BACKGROUND).all()
    assert_normal(errors(found, x, y))
    assert found.more["background_x_dn_per_px"].mean() == pytest.approx(0.25, abs=0.02)


def test_planes_that_are_not_there_are_seldom_seen(rng: np.random.Generator) -> None:
    """Chance takes a plane in once in 1000 targets; of 900 more than 9 are unlikely at 1e-6."""
    frame, x, y, targets = field(rng, "disc", 30, [3.0, 0.6, 150.0, 20.0])
    image = (frame + rng.normal(0, 2.0, frame.shape)).astype(np.float32)
    found = fit_template(image, targets, NoiseModel(4.0), "disc")
    assert np.count_nonzero(found.flags & (Flag.GRADIENT | Flag.UNEVEN_BACKGROUND)) <= 9
    assert_normal(errors(found, x, y))


def test_planes_of_all_targets_together(rng: np.random.Generator) -> None:
    """Falls that no single target shows are seen in the median of many; a frame of targets without a plane stays without."""
    falls = np.stack([rng.noncentral_chisquare(2, 2.0, 1000), rng.chisquare(2, 1000), rng.noncentral_chisquare(4, 2.0, 1000)], axis=1)
    falls[:, 2] = np.maximum(falls[:, 2], falls[:, :2].max(axis=1))
    ground, light = choose_planes(falls, np.ones(1000), "auto", "auto")
    assert ground.all()
    assert not light.all() or (falls[:, 2] - falls[:, 0]).min() >= 0
    assert not choose_planes(np.full((1000, 3), 0.5), np.ones(1000), "auto", "auto")[0].any()
    assert choose_planes(falls, np.ones(1000), True, False)[0].all()


@pytest.mark.parametrize(
    ("amplitude", "background", "sigma"),
    [(300.0, 20.0, 2.0), (150.0, 0.0, 1.5), (-120.0, 120.0, 6.0), (400.0, 0.0, 4.0), (800.0, 0.0, 2.0)],
)
def test_where_the_scale_ends(amplitude: float, background: float, sigma: float, rng: np.random.Generator) -> None:
    """Saturated tops and half the background's noise cut off: no bias, radius and amplitude included, and flags."""
    frame, x, y, targets = field(rng, "disc", 14, [5.0, 0.7, amplitude, background])
    image = np.clip(np.rint(frame + rng.normal(0, sigma, frame.shape)), 0, 255).astype(np.uint8)
    targets = replace(targets, amplitude_dn=np.clip(targets.amplitude_dn, -255 + background, 255 - background))
    found = fit_template(image, targets, NoiseModel(sigma**2 + 1 / 12), "disc")
    good = (found.flags & Flag.NOT_CONVERGED) == 0
    assert good.mean() > 0.98
    assert_normal(errors(found, x, y)[np.tile(good, 2)])
    assert np.median(found.more["radius_px"]) == pytest.approx(5.0, abs=0.03)
    assert (found.flags & (Flag.SATURATED if amplitude + background > 255 else Flag.CLIPPED_AT_BLACK) > 0).all()


def test_a_target_cut_by_the_border_or_near_another(rng: np.random.Generator) -> None:
    errs = []
    for _ in range(60):
        at = (np.arange(30), np.arange(40))
        x, y = np.array([2.2, 14.0]) + rng.uniform(-0.5, 0.5, 2), np.array([14.0, 14.5]) + rng.uniform(-0.5, 0.5, 2)
        image = 20 + 150 * sum(rendered.disc(a, b, 4.5, 0.7, at) for a, b in zip(x, y, strict=True)) + rng.normal(0, 1.5, (30, 40))
        one = np.ones(2)
        row, col = np.rint(y).astype(int), np.rint(x).astype(int)
        targets = Targets(x + 0.1, y - 0.1, 4.6 * one, 4.4 * one, 0 * one, 0.8 * one, 140 * one, 21 * one, 0 * one, 0 * one, 1.5 * one,
                          row - 5, row + 6, np.maximum(col - 5, 0), col + 6, np.zeros(2, np.uint32))  # fmt: skip
        found = fit_template(image.astype(np.float32), targets, NoiseModel(1.5**2), "disc")
        assert found.flags[0] & Flag.BORDER
        assert not found.flags[1] & Flag.BORDER
        errs.append(errors(found, x, y))
    assert_normal(np.concatenate(errs))


def test_noise_from_the_image(rng: np.random.Generator) -> None:
    """Constant and slope of the variance to 6 % and 10 %; no slope where there is none, though the template does not fit the edges."""
    frame, _, _, targets = field(rng, "disc", 15, [5.0, 0.7, 150.0, 20.0])
    plain = noise_from_image(np.rint(frame + rng.normal(0, 2.0, frame.shape)).astype(np.uint8), targets)
    assert plain.origin == "image"
    assert plain.constant_dn2 == pytest.approx(4 + 1 / 12, rel=0.06)
    assert plain.slope_dn == 0
    shot = frame + 0.1 * (rng.poisson((frame - 20) / 0.1) - (frame - 20) / 0.1) + rng.normal(0, 2.0, frame.shape)
    photons = noise_from_image(shot.astype(np.float32), targets)
    assert photons.slope_dn == pytest.approx(0.1, rel=0.1)
    assert photons.variance_dn2(20.0) == pytest.approx(4, rel=0.08)
    sharp, _, _, others = field(rng, "disc", 15, [5.0, 0.45, 150.0, 20.0], sampled=True)
    misfit = noise_from_image((sharp + rng.normal(0, 0.5, sharp.shape)).astype(np.float32), others)
    assert misfit.constant_dn2 == pytest.approx(0.25, rel=0.15)


def test_frames_without_noise_and_without_targets(rng: np.random.Generator) -> None:
    frame, x, y, targets = field(rng, "disc", 5, [5.0, 0.7, 150.0, 20.0])
    noise = noise_from_image(np.rint(frame).astype(np.uint8), targets)
    assert noise.constant_dn2 >= 1 / 12
    found = fit_template(frame.astype(np.float32), targets, noise_from_image(frame.astype(np.float32), targets))
    assert np.abs(found.x_px - x).max() < 1e-3
    with pytest.raises(MeasureError):
        noise_from_image(frame.astype(np.float32), targets[:0])
    assert len(fit_template(frame.astype(np.float32), targets[:0], noise)) == 0


def test_a_square_is_a_poor_fit(rng: np.random.Generator) -> None:
    """A shape that is none of the template's has residuals above the noise."""
    frame, _, _, targets = field(rng, "disc", 2, [5.0, 0.7, 150.0, 20.0])
    for x, y in zip(np.rint(targets.x_px).astype(int), np.rint(targets.y_px).astype(int), strict=True):
        frame[y - 6 : y + 7, x - 6 : x + 7] = 20
        frame[y - 4 : y + 5, x - 4 : x + 5] = 170
    assert (fit_template(frame.astype(np.float32), targets, NoiseModel(1.0)).flags & Flag.POOR_FIT > 0).all()


def test_options_that_are_none(rng: np.random.Generator) -> None:
    frame, _, _, targets = field(rng, "disc", 1, [5.0, 0.7, 150.0, 20.0])
    image = frame.astype(np.float32)
    for wrong in ({"kind": "line"}, {"likelihood": "maximum"}, {"light_on": "wall"}, {"aperture_px": -1.0}, {"background_plane": "maybe"},
                  {"kind": "spot", "light_plane": True}):  # fmt: skip
        with pytest.raises(InputError):
            fit_template(image, targets, NoiseModel(1.0), **wrong)


def test_slopes_under_many_targets_that_their_ground_does_not_have_are_not_believed(rng: np.random.Generator) -> None:
    """A one-sided halo (an odd tail of the blur) at every dark target: the background's map is even, so no plane is fitted."""
    frame, x, y, targets = field(rng, "disc", 10, [5.0, 0.7, -100.0, 150.0], (0.6, 0, 0.02, 0))
    image = (frame + rng.normal(0, 1.0, frame.shape)).astype(np.float32)
    flags = fit_template(image, targets, NoiseModel(1.0), "disc").flags
    assert not (flags & (Flag.GRADIENT | Flag.UNEVEN_BACKGROUND)).any()
    seen = replace(targets, background_x_dn_per_px=np.full(len(targets), 0.6))
    assert (fit_template(image, seen, NoiseModel(1.0), "disc").flags & Flag.UNEVEN_BACKGROUND).all()


def test_planes_are_fitted_only_where_they_predict_pixels_that_were_held_back(rng: np.random.Generator) -> None:
    """Noise that is spread over neighbours had planes on every target (the error grew by a half); light that falls off keeps its plane.

    Of 81 discs at most 1 % have a plane without cause: more than 9 of them are unlikely at 1e-6. With a fall of 1.2 % a pixel the shift
    that halves of the pixels agree on is five times the noise that the planes add: all have one.
    """
    for exposure in (honest_cases.smeared, honest_cases.jpeg):
        plain = honest_cases.Picture(*honest_cases.discs(rng, 9), exposure)
        sloped = honest_cases.Picture(*honest_cases.discs(rng, 9, light=0.012), exposure)
        without, with_light = locate(plain.exposed(rng)), locate(sloped.exposed(rng))
        assert (without.light_x_per_px != 0).sum() <= 9 and (without.background_x_dn_per_px != 0).sum() <= 9
        assert (with_light.light_x_per_px != 0).sum() >= 80 and (with_light.flags & Flag.GRADIENT != 0).sum() >= 80


def test_planes_never_and_always(rng: np.random.Generator) -> None:
    """The switch does what it says, and knows no other word."""
    frame = honest_cases.Picture(*honest_cases.discs(rng, 3, light=0.03), honest_cases.white).exposed(rng)
    assert (locate(frame, planes="never").light_x_per_px == 0).all() and (locate(frame, planes="always").light_x_per_px != 0).all()
    with pytest.raises(InputError, match="auto, never, always"):
        locate(frame, planes="sometimes")
