"""Spatial variances, DSNU and PRNU, their scatter and the bootstrap, against formulas written out and simulated sensors.

Statistical tests: false-failure rate 1e-6 each (two-sided normal quantile 4.9).
"""

from __future__ import annotations

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.signal import convolve2d
from scipy.stats import ncx2

from pixmetry.camera.observations import StackMoments
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.emva.spatial import frame_products as products_module
from pixmetry.emva.spatial.frame_products import frame_products
from pixmetry.emva.spatial.spatial import SpatialInputs, snr_total_max, spatial_evaluation, spatial_variances
from pixmetry.emva.uncertainty import add_wave
from pixmetry.observe.stack import StackAccumulator

QUANTILE = 4.9
SHAPE = (40, 48)


class Sensor:
    """Frames of a sensor with its own pattern, and white, row, column and frame noise; all standard deviations in DN."""

    def __init__(self, rng, pattern=0.0, lines=None, white=8.0, row=2.0, col=1.0, frame=1.5, level=500.0, shape=SHAPE):
        self.rng, self.noise, self.level, self.shape = rng, (white, row, col, frame), level, shape
        m, n = shape
        lines = pattern / 2 if lines is None else lines
        self.pattern = pattern * rng.standard_normal((m, n))
        self.pattern += lines * rng.standard_normal((m, 1)) + lines * rng.standard_normal((1, n))

    def frames(self, count: int) -> np.ndarray:
        m, n = self.shape
        white, row, col, frame = self.noise
        normal = self.rng.standard_normal
        image = self.level + self.pattern + white * normal((count, m, n)) + row * normal((count, m, 1))
        return np.rint(image + col * normal((count, 1, n)) + frame * normal((count, 1, 1))).astype(np.uint16)

    def stack(self, count: int) -> StackMoments:
        return stack_of(self.frames(count))


def stack_of(frames: np.ndarray) -> StackMoments:
    accumulator = StackAccumulator(14)
    for frame in frames:
        accumulator.add(frame)
    return accumulator.result(1.0)


def by_hand(frames: np.ndarray, ddof: int) -> dict[str, float]:
    """EMVA 1288 R4.0 eq. 33 to 42 and 65, from the frames, as they are written."""
    count, m, n = frames.shape
    y = frames.astype(float)
    mean = y.mean(axis=0)
    stack = y.var(axis=0, ddof=1).mean()
    measured = ((mean - mean.mean()) ** 2).sum() / (m * n - ddof)
    s2 = measured - stack / count
    cav = sum((mean[:, k].mean() - mean.mean()) ** 2 for k in range(n)) / n - stack / count / m
    rav = sum((mean[k].mean() - mean.mean()) ** 2 for k in range(m)) / m - stack / count / n
    # eq. 37 and 41 solved for the three parts
    pixel, row, col = np.linalg.solve([[1, 1, 1], [1 / m, 0, 1], [1 / n, 1, 0]], [s2, cav, rav])
    return {
        "sigma_2_y_stack": stack,
        "s_2_y_measured": measured,
        "s_2_y": s2,
        "s_2_y_cav": cav,
        "s_2_y_rav": rav,
        "s_2_y_col": col,
        "s_2_y_row": row,
        "s_2_y_pixel": pixel,
    }


@pytest.mark.parametrize(("release", "ddof"), [("reference", 1), ("3.1", 0)])
def test_releases_without_filter_are_the_formulas_of_the_standard(release: str, ddof: int, rng: np.random.Generator) -> None:
    dark_frames = Sensor(rng, 1.0, level=50.0).frames(5)
    bright_frames = Sensor(rng, 5.0, level=900.0).frames(7)
    dark, bright = (SpatialInputs.of(stack_of(f), high_pass=False) for f in (dark_frames, bright_frames))
    got, _ = spatial_evaluation(dark, bright, dark.vector, bright.vector, release, 0.5)
    d, b = by_hand(dark_frames, ddof), by_hand(bright_frames, ddof)
    expected = {f"{k}_dark": v for k, v in d.items()} | b
    light = bright_frames.mean() - dark_frames.mean()
    for part in ("", "_row", "_col", "_pixel"):
        expected[f"DSNU1288{part}"] = np.sqrt(complex(d[f"s_2_y{part}"])) / 0.5
        expected[f"PRNU1288{part}"] = 100 * np.sqrt(complex(b[f"s_2_y{part}"] - d[f"s_2_y{part}"])) / light
    expected["DSNU1288_DN"] = np.sqrt(complex(d["s_2_y"]))
    assert got.keys() == expected.keys()
    for key, value in expected.items():
        if np.imag(value) == 0:
            # within 1e-9 of the largest summand
            scale = b["s_2_y_measured"] if key.startswith("s") else abs(value)
            np.testing.assert_allclose(got[key], np.real(value), atol=1e-9 * scale, rtol=0, err_msg=key)
        else:
            assert np.isnan(got[key])


def test_a_negative_variance_keeps_its_sign_and_has_no_root(rng: np.random.Generator) -> None:
    """Strong row noise, no pattern: the standard's pixel part is −σ²_row,t/L within a tenth of it."""
    dark = SpatialInputs.of(Sensor(rng, white=2.0, row=20.0, col=0.0).stack(6), high_pass=False)
    bright = SpatialInputs.of(Sensor(rng, 10.0, level=3000.0).stack(6), high_pass=False)
    args = (dark, bright, dark.vector, bright.vector, "3.1", 2.0)
    values, squares = spatial_evaluation(*args)
    assert values["s_2_y_pixel_dark"] < 0
    assert np.isnan(values["DSNU1288_pixel"])
    assert squares["DSNU1288_pixel"] == pytest.approx(values["s_2_y_pixel_dark"] / 4)
    for key in ("DSNU1288", "DSNU1288_row", "DSNU1288_DN", "PRNU1288", "PRNU1288_col"):
        np.testing.assert_allclose(values[key], np.sqrt(squares[key]) if squares[key] >= 0 else np.nan)


def truth(pattern: np.ndarray) -> np.ndarray:
    """Pixel, row and column variance of release 4.0 for an image without noise, with the filter and its gains from elsewhere.

    The gains are means over many white patterns of a filter that is written as a convolution.
    """
    rng = np.random.default_rng(11)
    m, n = pattern.shape
    low = uniform_kernel()

    def variances(image: np.ndarray) -> np.ndarray:
        y = image[9:-9, 9:-9] - convolve2d(image, low, mode="valid")
        return np.array([y.var(), y.mean(axis=0).var(), y.mean(axis=1).var()])

    draws = 1500
    kinds = [(m, n), (m, 1), (1, n)]
    gains = np.array([np.mean([variances(rng.standard_normal(k) + np.zeros((m, n))) for _ in range(draws)], axis=0) for k in kinds]).T
    return np.linalg.solve(gains, variances(pattern))


def uniform_kernel() -> np.ndarray:
    impulse = np.zeros((19, 19))
    impulse[9, 9] = 1.0
    smooth = uniform_filter(uniform_filter(impulse, 7, mode="constant"), 11, mode="constant")
    return convolve2d(smooth, np.outer([1, 2, 1], [1, 2, 1]) / 16, mode="same")


def test_release_4_finds_the_pattern_under_row_noise_without_bias(rng: np.random.Generator) -> None:
    """A sensor with a slope of light, whose temporal row noise leaves 4 DN² in the row means of six frames.

    200 stacks; u of the mean is about 0.13, 0.11 and 0.05 DN² for pixels, rows and columns; the simulated gains add 1 % of the pattern.
    It would catch the row noise left in (4 DN²), white noise left in the rows, or a gain of 1 in place of 0.889 for them.
    """
    sensor = Sensor(rng, pattern=3.0, lines=2.0, white=6.0, row=5.0, col=1.0)
    sensor.pattern += 0.5 * np.arange(SHAPE[1]) + 0.3 * np.arange(SHAPE[0])[:, None]
    expected = truth(sensor.pattern)
    found = []
    for _ in range(200):
        inputs = SpatialInputs.of(sensor.stack(6), high_pass=True)
        v = spatial_variances(inputs, inputs.vector, "4.0")
        found.append([v["s_2_y_pixel"], v["s_2_y_row"], v["s_2_y_col"]])
    mean, u = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    # rounding to whole codes is white noise of 1/12 DN², in the pattern of no stack
    np.testing.assert_array_less(np.abs(mean - expected), QUANTILE * np.hypot(u, 0.01 * expected))
    np.testing.assert_array_less(u, 0.3)


def test_release_4_holds_together(rng: np.random.Generator) -> None:
    inputs = SpatialInputs.of(Sensor(rng, 3.0).stack(4), high_pass=True)
    v = spatial_variances(inputs, inputs.vector, "4.0")
    m, n = SHAPE
    assert v["s_2_y"] == pytest.approx(v["s_2_y_pixel"] + v["s_2_y_row"] + v["s_2_y_col"])
    assert v["s_2_y_cav"] == pytest.approx(v["s_2_y_col"] + v["s_2_y_pixel"] / m)
    assert v["s_2_y_rav"] == pytest.approx(v["s_2_y_row"] + v["s_2_y_pixel"] / n)
    assert v["s_2_y_measured"] - inputs.vector[5:].sum() / 4 == pytest.approx(v["s_2_y"])


@pytest.mark.parametrize("high_pass", [False, True])
@pytest.mark.parametrize("strength", [0.0, 1.0, 10.0])
def test_draws_and_bootstrap_scatter_as_the_sensor_does(high_pass: bool, strength: float, rng: np.random.Generator) -> None:
    """Pattern none, as strong as the noise left in the mean image, and ten times that: u against 500 stacks of one sensor.

    u of the scatter is 1/√(2·500) = 3.2 %, with that of the u compared 4 %, times 4.9 is 19 %. Added to it: 12 % for the bootstrap where
    there is no pattern (its estimate of ζ₁ is cut at zero) and 12 % for what the closed forms neglect in frames of 40 x 48 pixels. A
    bootstrap that leaves the degenerate part uncentred is wrong by 73 % without a pattern.
    """
    frames = 30
    sensor = Sensor(rng, strength * 8.0 / np.sqrt(frames))
    vectors, drawn, resampled = [], [], []
    for k in range(500):
        y = sensor.frames(frames)
        inputs = SpatialInputs.of(stack_of(y), high_pass)
        vectors.append(inputs.vector)
        if k % 16 == 0:
            drawn.append(inputs.draws(300, rng).var(axis=0))
            resampled.append(inputs.bootstrap(frame_products(y, 14), 300, rng).var(axis=0))
    u = np.std(vectors, axis=0, ddof=1)
    for variances, neglected in ((drawn, 0.12), (resampled, 0.12 + 0.12 * (strength == 0))):
        ratio = np.sqrt(np.mean(variances, axis=0)) / u
        # u of 32 resampled u: each has 1/√(2·29)
        tolerance = QUANTILE * np.hypot(1 / np.sqrt(2 * 500), 1 / np.sqrt(2 * 29 * 32)) + neglected
        np.testing.assert_array_less(np.abs(ratio - 1), tolerance)


@pytest.mark.parametrize("part", [0, 1, 2])
@pytest.mark.parametrize("signal", [0.5, 3.0, 30.0])
def test_draws_of_one_stratum_have_the_variance_of_a_non_central_chi_square(part: int, signal: float, rng: np.random.Generator) -> None:
    """Pattern 0.5 to 30 times the noise left, no filter, even noise. 40 000 draws: u of the variance 0.7 %; it would catch 4 %."""
    m, n = SHAPE
    plain = SpatialInputs.of(Sensor(rng).stack(8), high_pass=False)
    white, row, col = 64.0, 4.0, 1.0
    dof = np.array([(m - 1) * (n - 1), m - 1, n - 1])[part]
    left = np.array([white * (m - 1) * (n - 1) / (m * n), (row + white / n) * (m - 1) / m, (col + white / m) * (n - 1) / n]) / 8
    strata = left * (1 + signal)
    vector = np.array([500.0, strata.sum(), strata[2], strata[1], white + row + col, white, row, col])
    inputs = replace(plain, vector=vector, uneven_first=1.0, uneven_second=1.0, dof=np.array([(m - 1) * (n - 1), m - 1.0, n - 1.0]))
    draws = inputs.draws(40_000, rng)
    got = [draws[:, 1] - draws[:, 2] - draws[:, 3], draws[:, 3], draws[:, 2]][part]
    expected = ncx2.std(dof, dof * signal) * left[part] / dof
    assert got.std() == pytest.approx(expected, rel=QUANTILE * 1.2 / np.sqrt(2 * 40_000))


def test_draws_are_about_the_measured_vector_and_reproducible(rng: np.random.Generator) -> None:
    inputs = SpatialInputs.of(Sensor(rng, 5.0).stack(20), high_pass=True)
    draws = inputs.draws(4000, np.random.default_rng(3))
    assert (draws == inputs.draws(4000, np.random.default_rng(3))).all()
    off = draws.mean(axis=0) - inputs.vector
    np.testing.assert_array_less(np.abs(off), QUANTILE * draws.std(axis=0) / np.sqrt(4000))


def test_flicker_of_the_light_moves_the_bright_pattern_with_the_mean(rng: np.random.Generator) -> None:
    """s² grows with the square of the light: 2 s²/light times its u, on top of the noise. 2 % flicker, 16 frames: 1 % of s²."""
    y = Sensor(rng, 40.0, white=2.0, row=0.0, col=0.0, frame=0.0, level=1000.0).frames(16).astype(float)
    y = np.rint(y * (1 + 0.02 * rng.standard_normal((16, 1, 1)))).astype(np.uint16)
    inputs = SpatialInputs.of(stack_of(y), high_pass=True)
    draws = inputs.draws(4000, rng, dark_mean_dn=100.0)
    slope = np.cov(draws[:, 0], draws[:, 1])
    assert slope[0, 1] / slope[0, 0] == pytest.approx(2 * inputs.vector[1] / (inputs.vector[0] - 100.0), rel=0.02)
    assert abs(np.corrcoef(inputs.draws(4000, rng)[:, :2].T)[0, 1]) < QUANTILE / np.sqrt(4000)


def test_a_wave_that_runs_through_the_frames_is_seen_in_their_products(rng: np.random.Generator) -> None:
    """Amplitude 3 DN at a random phase in each frame; products of two frames then have the variance A⁴/8 beyond that of white noise.

    The s² of 400 mean images scatters more than four times as much as white noise would let it. Draws without the products of the frames
    are too small by more than 2. With those of one stack they are not; they may be too large, since the phases' mean in the 40 frames
    cannot be told from a pattern: its square is exponential, so that once in 10⁶ the variance comes out 27 times too large, u 5.2 times.
    """
    m, n = SHAPE
    y, x = np.mgrid[:m, :n]

    def frames(count: int) -> np.ndarray:
        phase = rng.uniform(0, 2 * np.pi, (count, 1, 1))
        wave = 3.0 * np.sin(2 * np.pi * (0.21 * x + 0.13 * y) + phase)
        return np.rint(500 + wave + 3.0 * rng.standard_normal((count, m, n))).astype(np.uint16)

    u = np.std([SpatialInputs.of(stack_of(frames(40)), high_pass=True).vector[1] for _ in range(400)])
    stack_frames = frames(40)
    plain = SpatialInputs.of(stack_of(stack_frames), high_pass=True)
    aware = SpatialInputs.of(stack_of(stack_frames), high_pass=True, products=frame_products(stack_frames, 10))
    some = SpatialInputs.of(stack_of(stack_frames), high_pass=True, products=frame_products(stack_frames[:16], 10))
    # the wave has the variance A²/2 and counts as noise
    expected = (3.0**4 / plain.dof[0] + 3.0**4 / 8) / ((3.0**2 + 3.0**2 / 2) ** 2 / plain.dof[0])
    assert aware.coherence[0] == pytest.approx(expected, rel=0.5)
    assert some.coherence[0] == pytest.approx(expected, rel=0.9)
    assert plain.draws(2000, rng)[:, 1].std() < 0.5 * u
    assert 1 / 1.6 < aware.draws(2000, rng)[:, 1].std() / u < 6


def test_a_wave_that_the_dark_levels_show_widens_the_draws_of_the_stack(rng: np.random.Generator) -> None:
    """2000 stacks of 8 frames with a wave of 3 DN at random phases: u of s² as the variances of single pairs foretell it.

    The mean of many phases' products is exponential, u of its scatter √(2/2000) = 3.2 %, times 4.9 with that of the pairs 16 %. It would
    catch the products being counted as L in place of L(L − 1)/2: a factor 1.9.
    """
    frames, (m, n) = 8, (12, 20)
    y, x = np.mgrid[:m, :n]
    images = np.sin(2 * np.pi * (2 * y / m + 3 * x / n) + rng.uniform(0, 2 * np.pi, (2000, frames, 1, 1)))
    images = 3.0 * images + 0.3 * rng.standard_normal(images.shape)
    s2 = images.mean(axis=1).var(axis=(1, 2)) - images.var(axis=1, ddof=1).mean(axis=(1, 2)) / frames
    pairs = (np.diff(images[:, :2], axis=1) ** 2 / 2).mean(axis=(1, 2, 3))
    drawn = add_wave(np.zeros((40_000, 8)), SimpleNamespace(wave_dn2=pairs.std()), frames, rng)
    assert drawn[:, 1].std() == pytest.approx(s2.std(), rel=0.17)
    assert not drawn[:, [0, *range(2, 8)]].any()


@pytest.mark.parametrize("pixels", [1e6, 23 * 29, 7 * 29, 40, 1])
def test_frame_products_are_those_of_the_frames(pixels: float, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """In one block, in bands of rows, in blocks narrower than a row, and pixel by pixel."""
    y = Sensor(rng, 4.0, shape=(33, 29)).frames(6)
    monkeypatch.setattr(products_module, "BLOCK_BYTES", pixels * 6 * 8)
    got = frame_products(iter(y), 14)
    filtered = y[:, 9:-9, 9:-9] - np.stack([convolve2d(f.astype(float), uniform_kernel(), mode="valid") for f in y])
    for part, images in ((got, y.astype(float)), (got.high_passed, filtered)):
        np.testing.assert_allclose(part.means_dn, images.mean(axis=(1, 2)), atol=1e-9)
        views = {"pixel_dn2": images.reshape(6, -1), "row_dn2": images.mean(axis=2), "col_dn2": images.mean(axis=1)}
        for name, lines in views.items():
            np.testing.assert_allclose(getattr(part, name), np.cov(lines, ddof=0), atol=1e-8, err_msg=name)
    assert frame_products(y[:, :20], 14).high_passed is None
    with pytest.raises(MeasureError, match="bootstrap"):
        frame_products(y[:3], 14)
    with pytest.raises(InputError, match="another shape"):
        frame_products([y[0], y[1, :-1]], 14)


def test_frame_products_of_wide_frames_stay_within_two_blocks(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """One row of all frames takes 9.6 MB here, their column sums as much; two blocks of 1 MB and one frame of 0.9 MB are 2.9 MB."""
    frame_products(rng.integers(0, 9, (4, 24, 24)).astype(np.uint16), 14)  # compiles
    monkeypatch.setattr(products_module, "BLOCK_BYTES", 1e6)
    tracemalloc.start()
    try:
        frame_products((rng.integers(900, 1000, (24, 20_000), dtype=np.uint16) for _ in range(60)), 14)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 4.5e6


def test_the_mean_of_the_products_is_the_variance_free_of_noise(rng: np.random.Generator) -> None:
    """⟨Q_kl⟩ over k ≠ l is s²_measured − (σ²_stack − variance of the frame means)/L."""
    y = Sensor(rng, 4.0).frames(7)
    stack, q = stack_of(y), frame_products(y, 14).pixel_dn2
    pairs = (q.sum() - np.trace(q)) / (7 * 6)
    assert pairs == pytest.approx(stack.mean_map_dn.var() - (stack.var_stack_dn2 - stack.ms_frame_dn2) / 7, rel=1e-9)


def test_values_of_draws_are_values_of_each(rng: np.random.Generator) -> None:
    dark, bright = (SpatialInputs.of(Sensor(rng, 3.0, level=v).stack(5), high_pass=True) for v in (60.0, 900.0))
    d, b, gain = dark.draws(3, rng), bright.draws(3, rng), np.array([0.3, 0.4, 0.5])
    together, squares = spatial_evaluation(dark, bright, d, b, "4.0", gain)
    for k in range(3):
        for drawn, alone in zip((together, squares), spatial_evaluation(dark, bright, d[k], b[k], "4.0", gain[k]), strict=True):
            assert drawn.keys() == alone.keys()
            for key, value in alone.items():
                np.testing.assert_allclose(drawn[key][k], value, rtol=1e-12, err_msg=key)


def test_what_does_not_fit_is_refused(rng: np.random.Generator) -> None:
    stack, other = Sensor(rng).stack(5), Sensor(rng, level=900.0, shape=(30, 30)).stack(5)
    raw, filtered = SpatialInputs.of(stack, high_pass=False), SpatialInputs.of(stack, high_pass=True)
    brighter = SpatialInputs.of(replace(stack, mean_dn=900.0), high_pass=False)
    with pytest.raises(InputError, match="no such release"):
        spatial_evaluation(raw, brighter, raw.vector, brighter.vector, "5.0", 1.0)
    with pytest.raises(InputError, match="high-passed"):
        spatial_evaluation(raw, brighter, raw.vector, brighter.vector, "4.0", 1.0)
    with pytest.raises(InputError, match="high-passed"):
        spatial_evaluation(filtered, filtered, filtered.vector, filtered.vector, "3.1", 1.0)
    with pytest.raises(MeasureError, match="not brighter"):
        spatial_evaluation(raw, raw, raw.vector, raw.vector, "3.1", 1.0)
    small = SpatialInputs.of(other, high_pass=False)
    with pytest.raises(InputError, match="differ in shape"):
        spatial_evaluation(raw, small, raw.vector, small.vector, "3.1", 1.0)
    with pytest.raises(MeasureError, match="release 3.1"):
        SpatialInputs.of(Sensor(rng, shape=(20, 60)).stack(3), high_pass=True)
    y = Sensor(rng, shape=(20, 20)).frames(5)
    with pytest.raises(InputError, match="another stack"):
        raw.bootstrap(frame_products(Sensor(rng).frames(6), 14), 10, rng)
    with pytest.raises(InputError, match="no high-passed"):
        filtered.bootstrap(frame_products(y, 14), 10, rng)


def test_total_snr_goes_to_one_over_prnu() -> None:
    assert snr_total_max(1e12, 100.0, 4.0, 0.25) == pytest.approx(200.0, rel=1e-6)
    assert snr_total_max(1e4, 0.0, -1.0, -1.0) == pytest.approx(100.0)
    assert snr_total_max(np.array([400.0]), 100.0, 44.0, 0.0)[0] == pytest.approx(400 / np.sqrt(544))


WHOLE = Path(os.environ.get("PIXMETRY_DATA", "")) / "emva1288-set-001"


@pytest.mark.skipif(
    not (os.environ.get("PIXMETRY_DATA") and WHOLE.is_dir()), reason="PIXMETRY_DATA does not name a folder with emva1288-set-001"
)
def test_published_values_of_set_001() -> None:
    """Every spatial scalar that the reference implementation 1.0.2 prints, within 1e-9 of its largest summand."""
    from pixmetry.files.images import read_frame

    stacks = [stack_of([read_frame(p) for p in sorted((WHOLE / "images").glob(f"{kind}_s_*"))]) for kind in "db"]
    dark, bright = (SpatialInputs.of(stack, high_pass=False) for stack in stacks)
    rows = (line.split("\t") for line in (WHOLE / "reference-implementation-1.0.2-results-full.tsv").read_text().splitlines())
    published = {row[0]: row[1] for row in rows if len(row) > 1}
    got, _ = spatial_evaluation(dark, bright, dark.vector, bright.vector, "reference", float(published["K"]))
    for key, value in got.items():
        summand = 83.5 if key.startswith("s") and not key.endswith("_dark") else 0.22 if key.startswith("s_2") else abs(value)
        np.testing.assert_allclose(value, float(published[key]), atol=1e-9 * summand, rtol=1e-9, err_msg=key)
    dark, bright = (SpatialInputs.of(stack, high_pass=True) for stack in stacks)
    ours, _ = spatial_evaluation(dark, bright, dark.vector, bright.vector, "4.0", float(published["K"]))
    # the row noise of one frame, 0.255 DN², is what the standard's split took for rows and took off the pixels
    assert got["s_2_y_pixel_dark"] + 0.255 / 50 == pytest.approx(ours["s_2_y_pixel_dark"], abs=3e-4)
    assert ours["DSNU1288_pixel"] > 0
