"""Demosaicking, medians and blurs are told from the noise of flat fields; frames and filters by NumPy and SciPy alone.

The chance that a sound estimate fails is 1e-6 a test. Without the correction the gain behind a bilinear green would be 38 % too low.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from pixmetry.assess.job import measure_sources
from pixmetry.observe.mosaic import _scatter_dn4
from pixmetry.observe.observe import Group, observe

SHAPE, GAIN, NOISE_E, OFFSET, TOP = (120, 160), 0.5, 10.0, 80.0, 4095
SHARES = {"R": 0.7, "G": 1.0, "B": 0.5}
Z = 5.3
CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
MALVAR = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]) / 8


def sites(colour: str, pattern: str) -> np.ndarray:
    row, col = np.indices(SHAPE) % 2
    return np.array(list(pattern)).reshape(2, 2)[row, col] == colour


def interpolated(raw: np.ndarray, own: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Normalised convolution of the sites of one colour: the bilinear rule."""
    return ndimage.convolve(np.where(own, raw, 0.0), kernel, mode="mirror")


def green(raw: np.ndarray, pattern: str) -> np.ndarray:
    return interpolated(raw, sites("G", pattern), CROSS)


def red(raw: np.ndarray, pattern: str) -> np.ndarray:
    return interpolated(raw, sites("R", pattern), SQUARE)


def malvar_green(raw: np.ndarray, pattern: str) -> np.ndarray:
    return np.where(sites("G", pattern), raw, ndimage.convolve(raw, MALVAR, mode="mirror"))


def campaign(rng: np.random.Generator, stored, pattern: str | None):
    share = 1.0 if pattern is None else sum(SHARES[c] * sites(c, pattern) for c in "RGB")

    def frame(mean_e: float) -> np.ndarray:
        codes = np.rint(OFFSET + GAIN * (rng.poisson(mean_e * share, SHAPE) + rng.normal(0, NOISE_E, SHAPE)))
        return np.clip(np.floor(stored(np.clip(codes, 0, TOP)) + 0.5), 0, TOP).astype(np.uint16)

    return observe(
        [
            Group(kind, "level", 0.001 * k, None, [frame(light) for _ in range(2)])
            for k in range(1, 13)
            for kind, light in (("dark", 0.0), ("bright", 550.0 * k))
        ],
        12,
    )


@pytest.mark.parametrize(
    ("stored", "method", "output", "pattern"),
    [(green, "bilinear", "green", "RGGB"), (red, "bilinear", "red", "GRBG"), (malvar_green, "malvar", "green", "GRBG")],
)
def test_method_colour_pattern_and_gain(rng, stored, method, output, pattern):
    seen = campaign(rng, lambda codes: stored(codes, pattern), pattern)
    found = measure_sources(seen)[0]["processing.demosaic"]
    assert dict(found.settings) == {"method": method, "output": output, "pattern": pattern}
    gain, noise = seen.photon_transfer_fit["gain_dn_per_e"], seen.photon_transfer_fit["dark_noise_e"]
    # of a stored red the signal is that of the red pixels
    assert abs(gain.value - GAIN) < Z * gain.u
    assert abs(noise.value - NOISE_E) < Z * noise.u
    assert gain.u < 0.015 * GAIN


def test_scatter_of_the_covariances_of_interpolated_noise(rng):
    """Sum of squares of what is found over what is true: a quarter more than of white noise."""
    frames = np.array([red(rng.standard_normal(SHAPE), "GRBG") for _ in range(500)])[:, 4:-8, 4:-8]

    def products(j: int, i: int) -> np.ndarray:
        """Mean over a frame, by place."""
        rows, cols = SHAPE[0] - 20, SHAPE[1] - 20
        moved = frames[:, j : j + rows, 4 + i : 4 + i + cols] * frames[:, :rows, 4 : 4 + cols]
        return np.array([[moved[:, r::2, c::2].mean(axis=(1, 2)) for c in (0, 1)] for r in (0, 1)])

    found = np.array([[products(j, i) for i in range(-4, 5)] for j in range(5)]).transpose(2, 3, 0, 1, 4)
    pixels = (SHAPE[0] - 20) * (SHAPE[1] - 20)
    expected = found.var(axis=4, ddof=1).sum()
    assert _scatter_dn4(found.mean(axis=4), pixels) == pytest.approx(expected, rel=0.2)


def test_luminance_tells_no_gain(rng):
    def luma(codes: np.ndarray) -> np.ndarray:
        own = {c: interpolated(codes, sites(c, "RGGB"), CROSS if c == "G" else SQUARE) for c in "RGB"}
        return 0.299 * own["R"] + 0.587 * own["G"] + 0.114 * own["B"]

    seen = campaign(rng, luma, "RGGB")
    assert measure_sources(seen)[0]["processing.demosaic"].settings["output"] == "luma"
    assert "gain_dn_per_e" not in seen.photon_transfer_fit
    assert any("demosaicking" in note for note in seen.notes)


def test_raw_mosaic_is_no_demosaicking(rng):
    """The colours' different light gives the variance a period of two pixels too, as it gives it to the mean. Noise would have to
    differ by 8 u to be taken for a demosaicking.
    """
    seen = campaign(rng, lambda codes: codes, "RGGB")
    assert "not found" in measure_sources(seen)[1]["processing.demosaic"]
    gain = seen.photon_transfer_fit["gain_dn_per_e"]
    assert abs(gain.value - GAIN) < Z * gain.u


@pytest.mark.parametrize("radius", [1, 2])
def test_median_is_named_and_the_gain_refused(rng, radius):
    seen = campaign(rng, lambda codes: ndimage.median_filter(codes, 2 * radius + 1), None)
    found = measure_sources(seen)[0]["processing.noise_reduction"]
    assert (found.settings["method"], found["radius_px"].value) == ("median", radius)
    assert "gain_dn_per_e" not in seen.photon_transfer_fit
    assert any(f"median of radius {radius} px" in note for note in seen.notes)


def test_gaussian_is_measured(rng):
    seen = campaign(rng, lambda codes: ndimage.gaussian_filter(codes, 0.6, radius=1, mode="nearest"), None)
    found = measure_sources(seen)[0]["processing.noise_reduction"]
    assert (found.settings["method"], found["radius_px"].value) == ("gaussian", 1)
    assert abs(found["sigma_px"].value - 0.6) < Z * found["sigma_px"].u
    assert found["sigma_px"].u < 0.02
