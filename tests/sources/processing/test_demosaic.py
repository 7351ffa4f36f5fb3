"""Demosaicing: ramps and colours without error, the published weights by what defines them, and the shift of discs by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import convolve

from pixmetry.sources.processing.demosaic import Demosaic, forward, weights
from source_signals import stream
from sources.processing.code_frames import codes, disc, soft_centroid

PATTERNS = ("RGGB", "GRBG", "GBRG", "BGGR")
OUTPUTS = ("luma", "red", "green", "blue")


def filled(rng: np.random.Generator, image: np.ndarray, row0: int = 0, col0: int = 0, **kw) -> np.ndarray:
    frame_shape = (row0 + image.shape[0], col0 + image.shape[1])
    return forward(Demosaic(**kw), codes(image, row0=row0, col0=col0, frame_shape=frame_shape), stream(rng)).data[0].astype(float)


def masks(pattern: str, shape: tuple[int, int]) -> dict[str, np.ndarray]:
    row, col = np.indices(shape) % 2
    letter = np.array(list(pattern)).reshape(2, 2)[row, col]
    return {c: letter == c for c in "RGB"}


@pytest.mark.parametrize("method", ["bilinear", "malvar"])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_ramps_of_grey_light_come_back_exactly(method, pattern, rng: np.random.Generator):
    row, col = np.indices((20, 24))
    ramp = 20 + 3 * row + 5 * col
    for output in OUTPUTS:
        assert np.array_equal(filled(rng, ramp, method=method, pattern=pattern, output=output)[2:-2, 2:-2], ramp[2:-2, 2:-2])


@pytest.mark.parametrize("method", ["bilinear", "malvar"])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_even_colours_come_back_exactly_up_to_the_corners_on_any_phase(method, pattern, rng: np.random.Generator):
    """Where every channel has one level, all its neighbours do, and all Laplacians vanish."""
    level = {"R": 40, "G": 80, "B": 120}
    whole = masks(pattern, (13, 12))
    image = sum(level[c] * whole[c] for c in "RGB")
    for r0, c0 in ((0, 0), (1, 0), (0, 1), (3, 5)):
        part = image[r0:, c0:]
        got = {o: filled(rng, part, r0, c0, method=method, pattern=pattern, output=o) for o in OUTPUTS}
        assert (got["red"] == 40).all() and (got["green"] == 80).all() and (got["blue"] == 120).all()
        assert (got["luma"] == np.floor(0.299 * 40 + 0.587 * 80 + 0.114 * 120 + 0.5)).all()


def bilinear_planes(image: np.ndarray, pattern: str) -> dict[str, np.ndarray]:
    """Normalised convolution of the pixels of each colour, mirrored at the border."""
    mask = masks(pattern, image.shape)
    kernel = {"R": np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4, "G": np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4}
    kernel["B"] = kernel["R"]
    return {c: convolve(np.where(mask[c], image, 0.0), kernel[c], mode="mirror") for c in "RGB"}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_bilinear_against_normalised_convolution(pattern, rng: np.random.Generator):
    image = rng.integers(0, 60_000, (21, 18))
    want = bilinear_planes(image.astype(float), pattern)
    for colour, name in (("R", "red"), ("G", "green"), ("B", "blue")):
        got = filled(rng, image, method="bilinear", pattern=pattern, output=name, bits=16)
        assert np.abs(got - want[colour]).max() <= 0.5


@pytest.mark.parametrize("pattern", PATTERNS)
def test_malvar_he_cutler_is_bilinear_plus_a_share_of_the_laplacian_of_the_colour_at_hand(pattern, rng: np.random.Generator):
    """Their eqs. 2 to 4: α = 1/2 for green, β = 5/8 for red or blue at green, γ = 3/4 at the other one; Laplacians over 5, 9 and 5 pixels.

    The green Laplacian of β weighs the four diagonal pixels 1/5, the two on the line of the wanted colour 1/5, the two across −1/10.
    """
    image = rng.integers(20_000, 40_000, (22, 22)).astype(float)
    mask = masks(pattern, image.shape)
    plain = bilinear_planes(image, pattern)
    cross = np.zeros((5, 5))
    cross[2, 2], cross[[0, 4, 2, 2], [2, 2, 0, 4]] = 1, -0.25
    own = convolve(image, cross, mode="mirror")
    nine = np.zeros((5, 5))
    nine[2, 2], nine[[1, 1, 3, 3, 2, 2], [1, 3, 1, 3, 0, 4]], nine[[0, 4], [2, 2]] = 1, -0.2, 0.1
    along, across = convolve(image, nine, mode="mirror"), convolve(image, nine.T, mode="mirror")
    for colour, name in (("R", "red"), ("G", "green"), ("B", "blue")):
        want = plain[colour].copy()
        if colour == "G":
            want += np.where(mask["G"], 0, 0.5 * own)
        else:
            other = "B" if colour == "R" else "R"
            rows_of_it = mask[colour].any(axis=1)[:, None]
            want += np.where(mask[other], 0.75 * own, 0) + np.where(mask["G"], 0.625 * np.where(rows_of_it, along, across), 0)
        got = filled(rng, image, method="malvar", pattern=pattern, output=name, bits=16)
        assert np.abs(got - want).max() <= 0.5 + 1e-6


def test_white_balance_acts_on_the_mosaic(rng: np.random.Generator):
    """Colours of 1, 1/2 and 1/4 with gains of 1, 2 and 4 give the frame of grey light."""
    image = 4 * rng.integers(0, 250, (16, 16))
    mask = masks("GBRG", image.shape)
    seen = np.where(mask["R"], image, np.where(mask["G"], image // 2, image // 4))
    kw = {"method": "malvar", "pattern": "GBRG", "bits": 12}
    assert np.array_equal(filled(rng, seen, green_gain=2.0, blue_gain=4.0, **kw), filled(rng, image, **kw))


def test_overshoot_is_held_at_the_ends_of_the_range(rng: np.random.Generator):
    """Beside an edge from 0 to 255, weights of −1/8 and −3/16 would go below 0 and above 255."""
    image = np.where(np.arange(20) < 9, 0, 255) * np.ones((20, 1), int)
    for output in OUTPUTS:
        got = filled(rng, image, method="malvar", output=output)
        assert got.min() == 0 and got.max() == 255
        assert np.all(got[:, :6] == 0) and np.all(got[:, 13:] == 255)


def shifts(rng: np.random.Generator, diameter: float, method: str, output: str, n: int = 17) -> float:
    """Deviation of the error in x over a raster of n × n places in the pattern of two by two."""
    place = 2 * (np.arange(n) + 0.5) / n - 1
    out = []
    for x, y in ((x, y) for x in place for y in place):
        image = np.rint(16 * disc(x, y, diameter))  # 12 bits: rounding does not count
        got = filled(rng, image, method=method, output=output, bits=12) / 16
        out.append(soft_centroid(got, 8.0)[0] - x)
    return float(np.std(out))


@pytest.mark.parametrize(("diameter", "low", "high"), [(3, 0.008, 0.015), (5, 0.005, 0.008), (7, 0.002, 0.005), (10, 0.002, 0.005)])
def test_shift_of_discs_after_bilinear_filling(diameter, low, high, rng: np.random.Generator):
    """Grey discs of 150 DN on black under a blur of 0.7 px, centroid of what stands above 8 DN in a window of radius 9 px, luminance.

    The numbers on record are for this case, at 200 random places: they are known to 5 % or so, and 15 % are granted on both sides.
    """
    assert 0.85 * low < shifts(rng, diameter, "bilinear", "luma") < 1.15 * high


def test_one_colour_alone_is_worse_than_the_luminance(rng: np.random.Generator):
    """On record: up to 0.022 px in the red plane, for discs of 10 px."""
    assert shifts(rng, 10, "bilinear", "red") == pytest.approx(0.022, rel=0.1)


def test_weights_have_the_sum_1_at_every_place():
    for method in ("bilinear", "malvar"):
        for output in OUTPUTS:
            total = weights(Demosaic(method=method, output=output)).sum(axis=(2, 3))
            assert total == pytest.approx(np.ones((2, 2)), abs=1e-12)
