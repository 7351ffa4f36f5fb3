"""Plumb lines against another simulator, a general optimiser, and closed forms.

The simulator draws straight lines, and finds where a lens images them by repeating Brown's polynomial. Statistical bounds: false-failure
rate 1e-6 a test.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, f, norm

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.lines.line_residuals import AxisResiduals, axis_residuals, compare_axes, correlation_inflation, pooled
from pixmetry.calibrate.lines.plumb_line import calibrate_lines
from pixmetry.calibrate.lines.row_jitter import RowVariance, Sampling, jitter_from_axes
from pixmetry.core.errors import InputError, MeasureError

RATE = 1e-6
COLS, ROWS, MM_X, MM_Y = 752, 582, 0.0086, 0.0083
SENSOR = Sensor(COLS, ROWS, 8.6, 8.3)
TRUE = {"k1": -1.2e-3, "k2": 1.5e-5, "p1": 3e-5, "p2": -2e-5}
NAMES = tuple(TRUE)


def ideal(x_mm: np.ndarray, y_mm: np.ndarray, q: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Brown's correction, written out."""
    r2 = x_mm**2 + y_mm**2
    radial = 1 + q.get("k1", 0) * r2 + q.get("k2", 0) * r2**2 + q.get("k3", 0) * r2**3
    p1, p2 = q.get("p1", 0), q.get("p2", 0)
    return x_mm * radial + p1 * (r2 + 2 * x_mm**2) + 2 * p2 * x_mm * y_mm, y_mm * radial + p2 * (r2 + 2 * y_mm**2) + 2 * p1 * x_mm * y_mm


def imaged(x_mm: np.ndarray, y_mm: np.ndarray, q: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Where ideal places are imaged, by repetition."""
    a, b = x_mm.copy(), y_mm.copy()
    for _ in range(200):
        u, v = ideal(a, b, q)
        a, b = a + x_mm - u, b + y_mm - v
    return a, b


def lines(rng, noise_px=(0.04, 0.04), *, n=80, count=8, directions=("x", "y"), tilt=0.02, q=TRUE) -> dict[str, np.ndarray]:
    """A table of positions: lines along y in image "upright" (they tell about x), along x in image "lying"."""
    parts = []
    for name in directions:
        side, other, mm, mm_other = (COLS, ROWS, MM_X, MM_Y) if name == "x" else (ROWS, COLS, MM_Y, MM_X)
        for i in range(count):
            t = np.linspace(-0.49, 0.49, n) * other * mm_other
            across = ((i + 0.5) / count - 0.5) * side * mm + rng.uniform(-tilt, tilt) * t
            a, b = imaged(*((across, t) if name == "x" else (t, across)), q)
            x, y = a / MM_X + (COLS - 1) / 2, b / MM_Y + (ROWS - 1) / 2
            x, y = x + noise_px[0] * rng.standard_normal(n), y + noise_px[1] * rng.standard_normal(n)
            parts.append((x, y, np.full(n, i), np.full(n, {"x": "upright", "y": "lying"}[name])))
    x, y, line, image = (np.concatenate(v) for v in zip(*parts, strict=True))
    return {"x_px": x, "y_px": y, "line": line, "image": image}


def test_recovers_the_lens_exactly_without_noise(rng) -> None:
    found = calibrate_lines(**lines(rng, (0, 0)), sensor=SENSOR, loss="none")
    for name, true in TRUE.items():
        assert found.camera[name] == pytest.approx(true, abs=1e-11), name
    assert np.abs(found.residual_px).max() < 1e-7
    assert found.estimates.names == ("k1_per_mm2", "k2_per_mm4", "p1_per_mm", "p2_per_mm")
    assert found.estimates.units == ("1/mm²", "1/mm⁴", "1/mm", "1/mm")


def test_recovers_the_centre_and_k3_of_a_strong_lens(rng) -> None:
    """The centre hangs on P1, P2 = 0; a principal point 12 px off."""
    q = {"k1": -2e-3, "k2": 3e-5, "k3": -4e-7}
    table = lines(rng, (0, 0), q=q)
    table["x_px"], table["y_px"] = table["x_px"] + 12.0, table["y_px"] - 7.0
    found = calibrate_lines(**table, sensor=SENSOR, free=("k1", "k2", "k3", "xp", "yp"), loss="none")
    assert found.camera["xp"] == pytest.approx((COLS - 1) / 2 + 12, abs=1e-5)
    assert found.camera["yp"] == pytest.approx((ROWS - 1) / 2 - 7, abs=1e-5)
    for name, true in q.items():
        assert found.camera[name] == pytest.approx(true, rel=1e-5), name


def test_is_the_maximum_likelihood(rng) -> None:
    """A general optimiser moves every position along its line, too: 1e-3 of the standard uncertainties, and 1 % of those themselves."""
    n = 12
    table = lines(rng, (0.08, 0.08), n=n, count=3)
    found = calibrate_lines(**table, sensor=SENSOR, loss="none", reject=False)
    key = np.repeat(np.arange(6), n)
    upright = table["image"] == "upright"
    scale = np.array([1e-3, 1e-5, 1e-5, 1e-5])
    x, y = (table["x_px"] - (COLS - 1) / 2) * MM_X, (table["y_px"] - (ROWS - 1) / 2) * MM_Y
    weight = 1 / np.array([MM_X, MM_Y]) / found.sigma_px

    def distances(p: np.ndarray) -> np.ndarray:
        q = dict(zip(NAMES, p[:4] * scale, strict=True))
        along = p[16:]
        across = p[4:10][key] * along + p[10:16][key]
        a, b = imaged(np.where(upright, across, along), np.where(upright, along, across), q)
        return np.concatenate([(x - a) * weight[0], (y - b) * weight[1]])

    start = np.concatenate([np.zeros(10), [np.where(upright, x, y)[key == k].mean() for k in range(6)], np.where(upright, y, x)])
    other = least_squares(distances, start, x_scale="jac", xtol=1e-12, ftol=1e-13, gtol=1e-13)
    assert (np.abs(other.x[:4] * scale - found.estimates.values) < 2e-3 * found.estimates.u).all()
    covariance = np.linalg.inv(other.jac.T @ other.jac)[:4, :4] * np.outer(scale, scale)
    u = found.estimates.u
    np.testing.assert_allclose(found.estimates.covariance / found.inflation / np.outer(u, u), covariance / np.outer(u, u), atol=0.01)


@pytest.mark.parametrize("noise", [(0.04, 0.04), (0.09, 0.03)])
def test_covariance_covers_the_truth(noise, rng) -> None:
    """Summed squared Mahalanobis distances of 60 tables against χ²(240); catches standard uncertainties wrong by 25 %."""
    true, total, tables = np.array(list(TRUE.values())), 0.0, 60
    for _ in range(tables):
        found = calibrate_lines(**lines(rng, noise, n=30, count=6), sensor=SENSOR)
        error = found.estimates.values - true
        total += error @ np.linalg.solve(found.estimates.covariance, error)
    low, high = chi2.isf([1 - RATE / 2, RATE / 2], 4 * tables)
    assert low < total < 1.03 * high  # 332 degrees of freedom of the variances, and a rare false rejection


def test_variances_of_both_axes_have_their_degrees_of_freedom(rng) -> None:
    """Sums of squares over the true variances against χ²; dof are n − 2 a line, less four for the lens over both."""
    sums, dof = np.zeros(2), np.zeros(2)
    for _ in range(30):
        found = calibrate_lines(**lines(rng, (0.08, 0.03)), sensor=SENSOR, loss="none", reject=False)
        assert found.axes["x"].dof + found.axes["y"].dof == pytest.approx(2 * 8 * 78 - 4, abs=1e-6)
        for k, (name, sigma) in enumerate((("x", 0.08), ("y", 0.03))):
            sums[k] += found.axes[name].dof * (found.axes[name].rms_px / sigma) ** 2
            dof[k] += found.axes[name].dof
        assert found.axes["x"].rms_um == pytest.approx(8.6 * found.axes["x"].rms_px, rel=0.08)
    slanted = 1.001  # lines lean by up to 0.02: some of the other axis' noise comes in
    for k in range(2):
        low, high = chi2.isf([1 - RATE / 4, RATE / 4], dof[k])
        assert low / slanted < sums[k] < high * slanted


def test_gross_errors_are_found(rng) -> None:
    """5 px in 1 % of the positions: all are left out, hardly another one, and the lens stays what it is."""
    table = lines(rng)
    wrong = rng.choice(len(table["x_px"]), 13, replace=False)
    for name in ("x_px", "y_px"):
        table[name][wrong] += 5.0 * rng.choice([-1, 1], 13)
    found = calibrate_lines(**table, sensor=SENSOR)
    left = np.flatnonzero(~found.used)
    assert set(wrong) <= set(left) and len(left) <= 13 + 3  # 1e-3 false alarms a table
    error = found.estimates.values - np.array(list(TRUE.values()))
    assert error @ np.linalg.solve(found.estimates.covariance, error) < 1.1 * chi2.isf(RATE, 4)
    assert "gross_error" in [finding.kind for finding in found.findings]


def test_order_and_unit_do_not_matter(rng) -> None:
    table = lines(rng)
    one = calibrate_lines(**table, sensor=SENSOR)
    mixed = rng.permutation(len(table["x_px"]))
    two = calibrate_lines(**{k: v[mixed] for k, v in table.items()}, sensor=SENSOR)
    np.testing.assert_allclose(two.estimates.values, one.estimates.values, rtol=1e-5)
    np.testing.assert_allclose(two.residual_px, one.residual_px[mixed], atol=1e-6)
    square = Sensor(COLS, ROWS, 8.6, 8.6)
    mm, px = calibrate_lines(**table, sensor=square), calibrate_lines(**table, sensor=Sensor(COLS, ROWS))
    assert px.residual_um is None and px.estimates.names[0] == "k1_per_px2"
    np.testing.assert_allclose(px.residual_px, mm.residual_px, atol=1e-5)
    assert px.camera["k1"] == pytest.approx(mm.camera["k1"] * 0.0086**2, rel=1e-5)


def test_stated_uncertainties_weigh(rng) -> None:
    """Half of the positions ten times worse and said to be so: the lens is as good as from the other half; catches 15 %."""
    table = lines(rng, (0.04, 0.04))
    worse = rng.random(len(table["x_px"])) < 0.5
    u = np.where(worse, 0.4, 0.04)
    for name in ("x_px", "y_px"):
        table[name] = table[name] + np.sqrt(u**2 - 0.04**2) * rng.standard_normal(len(u))
    found = calibrate_lines(**table, sensor=SENSOR, u_px=u)
    half = calibrate_lines(**{k: v[~worse] for k, v in table.items()}, sensor=SENSOR, u_px=0.04)
    np.testing.assert_allclose(found.estimates.u, half.estimates.u, rtol=0.2)
    assert (np.abs(found.estimates.values - half.estimates.values) < 1.0 * half.estimates.u).all()
    cov = np.stack([u**2, 0 * u, u**2], axis=1)
    np.testing.assert_allclose(calibrate_lines(**table, sensor=SENSOR, u_px=cov).estimates.values, found.estimates.values, rtol=1e-9)


@pytest.mark.parametrize(("free", "named"), [(("k1", "b1"), "b1"), (("k1", "b2"), "b2")])
def test_an_affinity_of_an_undistorted_image_is_refused(free, named, rng) -> None:
    with pytest.raises(MeasureError, match=named):
        calibrate_lines(**lines(rng, q={}), sensor=SENSOR, free=free)


@pytest.mark.parametrize(("direction", "lost", "told"), [("x", "p2", "p1"), ("y", "p1", "p2")])
def test_lines_of_one_direction_do_not_tell_all(direction, lost, told, rng) -> None:
    """Upright lines: P2 shears them, which keeps them straight; P1 bends them. Lying ones: the other way round."""
    table = lines(rng, directions=(direction,))
    with pytest.raises(MeasureError, match=lost):
        calibrate_lines(**table, sensor=SENSOR)
    found = calibrate_lines(**table, sensor=SENSOR, free=("k1", "k2", told), start=CameraModel.of(SENSOR, **{lost: TRUE[lost]}))
    error = found.estimates.values - [TRUE[name] for name in ("k1", "k2", told)]
    assert error @ np.linalg.solve(found.estimates.covariance, error) < 1.1 * chi2.isf(RATE, 3)
    assert found.f_test is None and "direction" in [finding.kind for finding in found.findings]


def test_lines_have_no_scale(rng) -> None:
    with pytest.raises(InputError, match="no scale"):
        calibrate_lines(**lines(rng), sensor=SENSOR, free=("c", "k1"))


def test_centre_and_tangential_terms_together_are_told_as_correlated(rng) -> None:
    """A shifted radial term of third order is a tangential one: only higher orders keep them apart."""
    found = calibrate_lines(**lines(rng, (0.02, 0.02)), sensor=SENSOR, free=("k1", "k2", "p1", "p2", "yp"))
    assert any(said.kind == "correlation" and "p2" in said.text and "yp" in said.text for said in found.findings)


def test_wrong_input_is_refused(rng) -> None:
    table = lines(rng)
    model = CameraModel.of(SENSOR, "object_to_image")
    wrong = [
        ({"x_px": table["x_px"][:-1]}, "length"),
        ({"x_px": np.where(np.arange(len(table["x_px"])) == 3, np.nan, table["x_px"])}, "finite"),
        ({"line": np.arange(len(table["x_px"]))}, "fewer than three"),
        ({"free": ("k9",)}, "cannot be estimated"),
        ({"free": ()}, "cannot be estimated"),
        ({"u_px": 0.0}, "standard uncertainties"),
        ({"u_px": np.ones(5)}, "another shape"),
        ({"loss": "tukey"}, "no such loss"),
        ({"start": model}, "image_to_object"),
    ]
    for change, match in wrong:
        with pytest.raises(InputError, match=match):
            calibrate_lines(**{**table, **change}, sensor=SENSOR)


def axis(px: float, um: float, lines: int = 216, dof: float = 16_848.0) -> AxisResiduals:
    return AxisResiduals(px, um, 17_280, lines, dof, dof, np.zeros(1), np.ones(1))


def test_published_residuals_of_54_images() -> None:
    """Known: F.95(216, 216) = 1.25, 1.279 has p = .036 in px², 1.373 has p = .010 in µm²; 1.3 ns (1.46 from µm), at most 1.9 to 2.0 ns."""
    x, y = axis(0.341 / 8.6, 0.341), axis(0.291 / 8.3, 0.291)
    test = compare_axes(x, y)
    assert test.critical_95["lines"] == pytest.approx(1.25, abs=0.005)
    assert (round(test.ratio_px2, 3), round(test.ratio_um2, 3)) == (1.279, 1.373)
    assert (round(test.p_px["lines"], 3), round(test.p_um["lines"], 3)) == (0.036, 0.010)
    assert test.p_px["positions"] < 1e-20
    found = jitter_from_axes(x, y, Sampling(70.485), kind="lines")["jitter_ns"]
    assert (found.kind, round(found.value, 2)) == ("value", 1.31)
    assert "1.92 ns" in found.reason
    same_um = jitter_from_axes(x, axis(0.291 / 8.6, 0.291), Sampling(70.485), kind="lines")["jitter_ns"]
    assert round(same_um.value, 2) == 1.46 and "2.02 ns" in same_um.reason
    few = jitter_from_axes(x, y, Sampling(70.485, rows=4.0), kind="lines")["jitter_ns"]
    assert few.value == pytest.approx(2 * found.value)
    none = jitter_from_axes(y, x, Sampling(70.485), kind="lines")["jitter_ns"]
    assert none.kind == "upper_limit"  # no better than if x and y were alike: √(F.95 − 1) of y's standard deviation
    assert none.value == pytest.approx(np.sqrt(f.isf(0.05, 216, 216) - 1) * 0.341 / 8.6 * 70.485)


def left_by_a_line(rho: float, n: int, lags: int) -> np.ndarray:
    """What remains of correlations ρ^k once a straight line is fitted to n values, corrected for what it leaves of white noise."""
    at = np.arange(n)
    line = np.column_stack([np.ones(n), at - at.mean()])
    rest = np.eye(n) - line @ np.linalg.pinv(line)
    covariance = rest @ rho ** np.abs(at[:, None] - at) @ rest
    variance = np.trace(covariance) / (n - 2)
    return np.array([(np.trace(covariance, k) / variance - np.trace(rest, k)) / (n - k) for k in range(1, lags + 1)])


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_effective_degrees_of_freedom_of_neighbours_that_err_alike(rho, rng) -> None:
    """AR(1): correlations ρ^k less what goes with the line, dof 1/(1 + 2 Σ ρ_k²), variances of slow functions (1 + ρ)/(1 − ρ) times.

    The dof scatter by 1.6 %, the last by 1.3 % about 0.8 of what they are without the line: 20 % and 40 % would be caught.
    """
    lines_n, n = 400, 80
    v = rng.standard_normal((lines_n, n))
    for i in range(1, n):
        v[:, i] = rho * v[:, i - 1] + np.sqrt(1 - rho**2) * v[:, i]
    t = np.arange(n) - (n - 1) / 2
    v -= v.mean(axis=1, keepdims=True) + np.outer(v @ t / (t @ t), t)
    line_of = np.repeat(np.arange(lines_n), n)
    found = axis_residuals(v.ravel(), None, np.full(v.size, (n - 2) / n), line_of, np.tile(t, lines_n))
    assert found.dof == pytest.approx(lines_n * 78) and found.dof_of["lines"] == lines_n
    sigma = norm.isf(RATE / 40) * np.sqrt((1 + rho**2) / (1 - rho**2) / found.pairs)
    expected = left_by_a_line(rho, n, 20)
    wanted = 1 / (1 + 2 * np.sum(expected**2))
    slow = (1 + rho) / (1 - rho)
    assert (np.abs(found.correlation - expected) < sigma).all()
    assert found.dof_effective / found.dof == pytest.approx(wanted, rel=0.12)
    assert correlation_inflation(found) == pytest.approx(slow, rel=0.3) if rho else correlation_inflation(found) < 1.2
    both = pooled([found, found])
    assert both.rms_px == pytest.approx(found.rms_px) and both.dof == 2 * found.dof and both.lines == 2 * lines_n
    np.testing.assert_allclose(both.correlation, found.correlation)


def test_jitter_from_rows_covers_the_truth(rng) -> None:
    """Jitter of 0.02 px common to eight lines with noise of 0.03 px: z-scores of 2000 sets of 160 rows; catches 17 % of u."""
    sampling, sets = Sampling(70.0, rows=3.0, gain=1.4), 2000
    true = 0.02 * np.sqrt(3.0) * 70.0 / 1.4
    z = []
    for _ in range(sets):
        v = 0.02 * rng.standard_normal((2, 1, 80)) + 0.03 * rng.standard_normal((2, 8, 80))
        e = RowVariance.of(v).jitter(sampling)["jitter_ns"]
        z.append((e.value - true) / e.u)
    z = np.array(z)
    assert abs(z.mean()) < norm.isf(RATE / 2) / np.sqrt(sets) + 0.15  # a square root is biased by u/σ/2
    assert np.sqrt(chi2.isf(1 - RATE, sets) / sets) * 0.97 < z.std() < np.sqrt(chi2.isf(RATE, sets) / sets) * 1.06


def test_the_limit_of_no_jitter_is_passed_in_one_of_twenty(rng) -> None:
    """A jitter at a fortieth of the noise: limits lie above it nearly always, values are claimed in 5 % of 400 sets, at 1e-6."""
    from scipy.stats import binom

    claimed = 0
    for _ in range(400):
        e = RowVariance.of(rng.standard_normal((1, 8, 80))).jitter(Sampling(70.0))["jitter_ns"]
        claimed += e.kind == "value"
    assert binom.isf(1 - RATE / 2, 400, 0.05) <= claimed <= binom.isf(RATE / 2, 400, 0.05)


def test_repeated_frames_do_not_see_what_is_fixed(rng) -> None:
    fixed = 0.5 * rng.standard_normal((1, 1, 80))
    v = fixed + 0.02 * rng.standard_normal((10, 1, 80)) + 0.01 * rng.standard_normal((10, 8, 80))
    found = RowVariance.of(v, repeated=True)
    low, high = chi2.isf([1 - RATE / 2, RATE / 2], 9 * 80) / (9 * 80)
    expected = 0.01**2 + 8 * 0.02**2
    assert found.dof == (720.0, 5040.0) and low < found.between_px2 / expected < high
    one, two = RowVariance.of(v[:5], repeated=True), RowVariance.of(v[5:], repeated=True)
    both = RowVariance.pooled([one, two])
    assert both.dof == (640.0, 4480.0) and min(one.between_px2, two.between_px2) < both.between_px2 < max(one.between_px2, two.between_px2)


@pytest.mark.parametrize("far_px", [2000.0, 5000.0, -3000.0, 1e6])
def test_positions_outside_of_the_frame_change_nothing(rng, far_px) -> None:
    """The lens is that of the table without them, wherever they lie; of 45 in 300 such tables the fit once ran away."""
    for _ in range(10):
        table = lines(rng, n=30, count=6)
        inside = np.ones(len(table["x_px"]), bool)
        inside[[7, 200]] = False
        alone = calibrate_lines(**{name: values[inside] for name, values in table.items()}, sensor=SENSOR)
        table["x_px"][7], table["y_px"][200] = far_px, -far_px
        found = calibrate_lines(**table, sensor=SENSOR)
        assert not found.used[[7, 200]].any()
        assert (np.abs(found.estimates.values - alone.estimates.values) < 1e-3 * alone.estimates.u).all()


def test_a_line_of_which_hardly_a_position_is_in_the_frame_is_told(rng) -> None:
    table = lines(rng, n=30, count=6)
    table["x_px"][:28] = 5000.0
    with pytest.raises(MeasureError, match="almost no position lies on the line"):
        calibrate_lines(**table, sensor=SENSOR)
