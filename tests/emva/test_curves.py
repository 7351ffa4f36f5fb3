"""Spectrograms, profiles and histograms against closed forms, NumPy's histogram and sums written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from pixmetry.camera.observations import StackMoments
from pixmetry.core.errors import MeasureError
from pixmetry.emva.curves import spatial_curves
from pixmetry.emva.records import Measurement
from pixmetry.emva.spatial.high_pass import LOW_PASS
from pixmetry.emva.spatial.spatial import SpatialInputs, spatial_variances

FRAMES = 10
QUANTILE = 4.9  # false-failure rate 1e-6


def stack(image: np.ndarray, var: float = 4.0) -> StackMoments:
    """A stack whose mean image is known; sums over its frames are whole numbers."""
    image = np.rint(image * FRAMES) / FRAMES
    m, n = image.shape
    return StackMoments(
        n_frames=FRAMES,
        exposure_s=1.0,
        mean_map_dn=image,
        var_map_dn2=np.full((m, n), var, dtype=np.float32),
        mean_dn=float(image.mean()),
        frame_means_dn=np.full(FRAMES, image.mean()),
        var_stack_dn2=var,
        ms_pixel_dn2=var,
        ms_row_dn2=var / n,
        ms_col_dn2=var / m,
        ms_frame_dn2=var / (m * n),
        fraction_min=0.0,
        fraction_max=0.0,
    )


def curves(dark: np.ndarray, bright: np.ndarray | None, release: str) -> dict[str, dict[str, np.ndarray]]:
    m = Measurement(transfer=None, dark_stack=stack(dark), bright_stack=None if bright is None else stack(bright))
    return spatial_curves(m, release)


@pytest.fixture
def images(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return rng.normal(50.0, 3.0, (60, 75)), rng.normal(900.0, 12.0, (60, 75))


@pytest.mark.parametrize("release", ["4.0", "3.1", "reference"])
def test_all_curves_are_there_or_those_of_the_dark_alone(images, release: str) -> None:
    kinds = ["horizontal_spectrogram", "vertical_spectrogram", "horizontal_profile", "vertical_profile"]
    names = {f"{kind}_{p}" for kind in kinds for p in ("DSNU", "PRNU")}
    names |= {f"histogram_{p}{a}" for p in ("DSNU", "PRNU") for a in ("", "_accumulated")}
    assert curves(*images, release).keys() == names
    assert curves(images[0], None, release).keys() == {name for name in names if "DSNU" in name}
    assert spatial_curves(Measurement(transfer=None), release) == {}


@pytest.mark.parametrize("release", ["4.0", "3.1"])
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_a_wave_of_stripes_stands_at_its_frequency(release: str, direction: str) -> None:
    """A sin(2π f x) with a whole number k of periods in N pixels: power A² N/4 at k/N, nothing elsewhere. 2 DN, 12 in 96 or 78."""
    margin = 9 if release == "4.0" else 0
    n = 96 + 2 * margin
    x = np.arange(n) - margin
    # 12 periods in the 96 pixels that are seen
    dark = np.full((80, n), 100.0) + 2.0 * np.sin(2 * np.pi * 12 * x / 96)
    dark = dark if direction == "horizontal" else dark.T
    dark_stack = stack(dark)
    curve = spatial_curves(Measurement(transfer=None, dark_stack=dark_stack), release)[f"{direction}_spectrogram_DSNU"]
    assert curve["frequency"].tolist() == (np.arange(49) / 96).tolist()
    # the low-pass at 1/8 per pixel, from its definition; rounding to tenths leaves 0.03 DN
    low = np.sin(7 * np.pi / 8) / np.sin(np.pi / 8) / 7 * np.sin(11 * np.pi / 8) / np.sin(np.pi / 8) / 11 * np.cos(np.pi / 8) ** 2
    amplitude = 2.0 * (1 - low if release == "4.0" else 1.0)
    assert curve["amplitude"][12] == pytest.approx(amplitude * np.sqrt(96 / 4), rel=0.02)
    assert np.delete(curve["amplitude"], 12).max() < 0.3
    assert curve["total"][0] == pytest.approx(amplitude / np.sqrt(2), rel=0.02)
    assert curve["white_share"][0] < 0.01


@pytest.mark.parametrize("release", ["4.0", "3.1"])
def test_white_patterns_are_flat_and_told_to_be_white(release: str, rng: np.random.Generator) -> None:
    """Mean power is the variance of the image (Parseval); the white share is 1 within the scatter of a median.

    The median of n values of density p(m) at m has u = 1/(2 p √n); with R lines averaged p is that of chi-square with 2 R over 2 R.
    """
    curve = curves(rng.normal(300.0, 5.0, (318, 262)), None, release)["horizontal_spectrogram_DSNU"]
    lines, count = (300, 244) if release == "4.0" else (318, 262)
    dof = 2 * lines
    density = chi2.pdf(chi2.median(dof), dof) * dof
    u = 1 / (2 * density * np.sqrt(count / 2))
    # the mean has a scatter of its own, and lines that were filtered together are no longer independent: twice that
    assert curve["white_share"][0] > 1 - QUANTILE * 2 * u
    assert curve["total"][0] == pytest.approx(5.0, rel=0.03)
    assert np.median(curve["amplitude"]) == pytest.approx(5.0, rel=0.03)
    wave = rng.normal(300.0, 5.0, (318, 262)) + 5.0 * np.sqrt(2) * np.sin(2 * np.pi * 0.3 * np.arange(262))
    # half of the variance is in the wave, less what leaks into neighbouring frequencies
    assert curves(wave, None, release)["horizontal_spectrogram_DSNU"]["white_share"][0] == pytest.approx(0.5, abs=0.05)


def test_levels_beside_the_spectrograms(images) -> None:
    dark, bright = (stack(image) for image in images)
    signal = bright.mean_dn - dark.mean_dn
    m = Measurement(transfer=None, dark_stack=dark, bright_stack=bright)
    for release in ("4.0", "3.1"):
        found = spatial_curves(m, release)
        inputs = [SpatialInputs.of(s, release == "4.0") for s in (dark, bright)]
        s2 = [float(spatial_variances(i, i.vector, release)["s_2_y"]) for i in inputs]
        for direction in ("horizontal", "vertical"):
            dsnu, prnu = (found[f"{direction}_spectrogram_{p}"] for p in ("DSNU", "PRNU"))
            assert dsnu["temporal"][0] == pytest.approx(2.0)
            assert dsnu["white_floor"][0] == pytest.approx(2.0 / np.sqrt(FRAMES))
            assert dsnu["nonuniformity"][0] == pytest.approx(np.sqrt(s2[0]))
            assert prnu["temporal"][0] == pytest.approx(100 * 2.0 / signal)
            assert prnu["white_floor"][0] == pytest.approx(100 * np.sqrt(2 * 4.0 / FRAMES) / signal)
            assert prnu["nonuniformity"][0] == pytest.approx(100 * np.sqrt(s2[1] - s2[0]) / signal)
            shown = inputs[1].image_dn - inputs[0].image_dn
            # of white noise the filter keeps the sum of its squared weights: 1 - 2 g0^2 + (sum of g^2)^2
            kept = 1 - 2 * LOW_PASS[9] ** 2 + (LOW_PASS @ LOW_PASS) ** 2 if release == "4.0" else 1.0
            assert prnu["total"][0] == pytest.approx(100 * shown.std() / signal / np.sqrt(kept))


def test_inputs_made_before_give_the_same(images) -> None:
    m = Measurement(transfer=None, dark_stack=stack(images[0]), bright_stack=stack(images[1]))
    inputs = (SpatialInputs.of(m.dark_stack, True), SpatialInputs.of(m.bright_stack, True))
    one, other = spatial_curves(m, "4.0"), spatial_curves(m, "4.0", inputs)
    for name, curve in one.items():
        for key, values in curve.items():
            np.testing.assert_array_equal(values, other[name][key])


def test_spectrograms_of_the_reference_have_its_scales(images) -> None:
    dark, bright = (np.rint(image * FRAMES) / FRAMES for image in images)
    found = curves(*images, "reference")
    light = bright - dark
    for name, image in (("horizontal_spectrogram_PRNU", light), ("vertical_spectrogram_PRNU", light.T)):
        power = np.mean(np.abs(np.fft.fft(image - image.mean(), axis=1)) ** 2, axis=0)[: image.shape[1] // 2 + 1] / image.shape[1]
        np.testing.assert_allclose(found[name]["amplitude"], np.sqrt(power / light.mean()), rtol=1e-9)
        np.testing.assert_allclose(found[name]["frequency"], np.arange(power.size) / power.size / 2)
    power = np.mean(np.abs(np.fft.fft(dark - dark.mean(), axis=1)) ** 2, axis=0)[:38] / 75
    np.testing.assert_allclose(found["horizontal_spectrogram_DSNU"]["amplitude"], np.sqrt(power), rtol=1e-9)


def test_profiles(images) -> None:
    dark, bright = (np.rint(image * FRAMES) / FRAMES for image in images)
    found = curves(*images, "4.0")
    for name, image in (("DSNU", dark), ("PRNU", bright - dark)):
        for direction, lines in (("horizontal", image), ("vertical", image.T)):
            profile = found[f"{direction}_profile_{name}"]
            assert profile["position"].tolist() == list(range(lines.shape[1]))
            np.testing.assert_allclose(profile["mid"], lines[len(lines) // 2])
            np.testing.assert_allclose(profile["mean"], lines.sum(axis=0) / len(lines))
            np.testing.assert_allclose([profile["min"], profile["max"]], np.sort(lines, axis=0)[[0, -1]])


def box_high_pass(sums: np.ndarray) -> np.ndarray:
    windows = np.lib.stride_tricks.sliding_window_view(sums, (5, 5))
    return 25 * sums[2:-2, 2:-2] - windows.sum(axis=(2, 3))


def reference_histogram(y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower edges, counts and model as the reference implementation has them: 256 bins at most, whole widths."""
    span = y.max() - y.min()
    width, bins = 1, span + 1
    if bins > 256:
        width = span // 256 + 1
        bins = span // width + 1
    edges = y.min() + width * np.arange(bins + 1)
    model = span / bins * y.size * norm.pdf(edges[:-1], y.mean(), y.std())
    return edges[:-1], np.histogram(y, edges)[0], model


def test_histograms_of_the_reference(images) -> None:
    dark, bright = (np.rint(image * FRAMES).astype(int) for image in images)
    light = box_high_pass(bright - dark)
    found = curves(*images, "reference")
    for name, y, scale, centre in (("DSNU", dark, FRAMES, dark.mean()), ("PRNU", light, 25 * FRAMES, 0.0)):
        edges, counts, model = reference_histogram(y)
        got = found[f"histogram_{name}"]
        np.testing.assert_allclose(got["bins"], (edges - centre) / scale, atol=1e-9)
        np.testing.assert_array_equal(got["values"], counts)
        np.testing.assert_allclose(got["model"], model, rtol=1e-9)
        edges, counts, _ = reference_histogram(np.abs(y - int(y.mean())))
        got = found[f"histogram_{name}_accumulated"]
        np.testing.assert_allclose(got["bins"], edges / scale, atol=1e-9)
        np.testing.assert_allclose(got["values"], [100 * counts[k:].sum() / y.size for k in range(counts.size)])


@pytest.mark.parametrize("release", ["4.0", "3.1"])
def test_histograms_count_every_pixel_once_and_the_model_is_normal(images, release: str) -> None:
    """The model sums to the number of pixels: its bins are as wide as those counted."""
    found = curves(*images, release)
    for name, margins in (("DSNU", 18 if release == "4.0" else 0), ("PRNU", 18 if release == "4.0" else 4)):
        size = (60 - margins) * (75 - margins)
        histogram = found[f"histogram_{name}"]
        assert histogram["values"].sum() == size
        assert histogram["values"].size <= 256
        assert histogram["model"].sum() == pytest.approx(size, rel=0.01)
        mean = (histogram["bins"] * histogram["values"]).sum() / size
        width = histogram["bins"][1] - histogram["bins"][0]
        assert abs(mean) < width / 2
        accumulated = found[f"histogram_{name}_accumulated"]
        assert accumulated["values"][0] == 100.0
        assert (np.diff(accumulated["values"]) <= 0).all()


@pytest.mark.parametrize("release", ["4.0", "3.1"])
def test_accumulated_histogram_is_the_share_of_pixels_beyond(images, release: str) -> None:
    dark = np.rint(images[0] * FRAMES) / FRAMES
    image = SpatialInputs.of(stack(dark), True).image_dn if release == "4.0" else dark
    away = np.abs(image - image.mean())
    accumulated = curves(*images, release)["histogram_DSNU_accumulated"]
    # bins begin at whole steps above the smallest deviation; a value at an edge may be rounded to either side
    shares = [100 * np.mean(away >= x - 1e-9) for x in accumulated["bins"]]
    np.testing.assert_allclose(accumulated["values"], shares, atol=100.5 / away.size)


def test_a_hot_pixel_stands_alone(images) -> None:
    dark = images[0].copy()
    dark[30, 40] += 400.0
    for release in ("4.0", "3.1", "reference"):
        histogram = curves(dark, images[1], release)["histogram_DSNU"]
        assert histogram["bins"][-1] == pytest.approx(400.0, abs=20)
        assert histogram["values"][-1] == 1


def test_small_frames_are_refused_by_4_alone(images) -> None:
    small = images[0][:20], images[1][:20]
    with pytest.raises(MeasureError, match="release 3.1"):
        curves(*small, "4.0")
    assert curves(*small, "3.1")["horizontal_profile_DSNU"]["mid"].size == 75


@pytest.mark.parametrize("release", ["3.1", "reference"])
@pytest.mark.parametrize("shape", [(4, 60), (60, 4), (3, 3), (5, 5)])
def test_frames_lower_than_the_box_have_no_histogram_of_the_light(images, release: str, shape: tuple[int, int]) -> None:
    small = [image[: shape[0], : shape[1]] for image in images]
    found = curves(*small, release)
    assert {name for name in curves(*images, release) if name not in found} == (
        {"histogram_PRNU", "histogram_PRNU_accumulated"} if min(shape) < 5 else set()
    )
    assert found["histogram_DSNU"]["values"].sum() == shape[0] * shape[1]
    if shape == (5, 5):
        assert found["histogram_PRNU"]["values"].sum() == 1
