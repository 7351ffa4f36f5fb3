"""The high-pass filter against a two-dimensional convolution, and its gains against the filter's matrix written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import convolve2d

from pixmetry.core.errors import MeasureError
from pixmetry.emva.spatial.high_pass import high_pass, passed_power, pattern_gains


def kernel() -> np.ndarray:
    """The low-pass of the standard, from its three parts."""
    seven, eleven = np.full((7, 7), 1 / 49), np.full((11, 11), 1 / 121)
    binomial = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16
    return convolve2d(convolve2d(seven, eleven), binomial)


@pytest.mark.parametrize("shape", [(24, 24), (37, 61), (64, 30)])
def test_is_the_image_less_its_convolution(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(5).normal(2000.0, 30.0, shape)
    expected = image[9:-9, 9:-9] - convolve2d(image, kernel(), mode="valid")
    np.testing.assert_allclose(high_pass(image), expected, atol=1e-9)


def test_a_slope_of_the_light_is_gone_and_a_fine_pattern_stays() -> None:
    y, x = np.mgrid[:40, :50]
    np.testing.assert_allclose(high_pass(1000 + 0.3 * x - 0.2 * y), 0.0, atol=1e-9)
    checks = (-1.0) ** (x + y)
    # of a pattern that alternates, 7 x 7 keeps 1/49, 11 x 11 keeps 1/121, and the binomial filter nothing
    np.testing.assert_allclose(high_pass(checks), checks[9:-9, 9:-9], atol=1e-12)


def test_what_passes_of_white_noise_is_the_power_of_the_response_to_one_pixel() -> None:
    impulse = np.zeros((64, 75))
    impulse[32, 37] = 1.0
    response = high_pass(impulse)
    power = (np.abs(np.fft.fft(response, axis=1)) ** 2).sum(axis=0)
    np.testing.assert_allclose(passed_power(np.arange(57) / 57), power, atol=1e-12)


def test_the_image_is_left_as_it_was_and_integers_are_taken() -> None:
    image = np.random.default_rng(1).integers(0, 4096, (30, 30)).astype(np.uint16)
    before = image.copy()
    np.testing.assert_allclose(high_pass(image), high_pass(image.astype(float)))
    assert (image == before).all()


def test_frames_that_the_filter_would_use_up_are_refused() -> None:
    with pytest.raises(MeasureError, match="release 3.1"):
        high_pass(np.zeros((23, 100)))
    with pytest.raises(MeasureError, match="too small"):
        pattern_gains((100, 20), filtered=True)


def projections(m: int, n: int) -> list[np.ndarray]:
    """Matrices that take an image (as a vector) to its deviations: of all pixels, of column means, of row means."""

    def centring(k: int) -> np.ndarray:
        return np.eye(k) - 1 / k

    whole = centring(m * n)
    cols = np.kron(np.full((1, m), 1 / m), centring(n))  # shape (n, mn)
    rows = np.kron(centring(m), np.full((1, n), 1 / n))
    return [whole, cols, rows]


@pytest.mark.parametrize(("shape", "filtered"), [((26, 31), True), ((9, 6), False)])
def test_gains_are_those_of_the_operators_written_out(shape: tuple[int, int], filtered: bool) -> None:
    """Expectation of |P H x|² for white x from the traces of the matrices, no statistics: exact."""
    m, n = shape
    margin = 9 if filtered else 0
    units = np.eye(m * n).reshape(m * n, m, n)
    operator = np.stack([(high_pass(u) if filtered else u).ravel() for u in units], axis=1)
    patterns = [np.eye(m * n), np.kron(np.eye(m), np.ones((n, 1))), np.kron(np.ones((m, 1)), np.eye(n))]
    expected = np.zeros((3, 3))
    for i, projection in enumerate(projections(m - 2 * margin, n - 2 * margin)):
        for j, pattern in enumerate(patterns):
            expected[i, j] = ((projection @ operator @ pattern) ** 2).sum() / projection.shape[0]
    np.testing.assert_allclose(pattern_gains(shape, filtered).matrix, expected, atol=1e-12)


@pytest.mark.parametrize(("shape", "filtered", "within"), [((44, 52), True, 0.06), ((12, 9), False, 1e-12)])
def test_degrees_of_freedom(shape: tuple[int, int], filtered: bool, within: float) -> None:
    """Variance of a quadratic form of white noise is 2 tr(B²); the closed form neglects what correlation and mean do together."""
    m, n = shape
    margin = 9 if filtered else 0
    units = np.eye(m * n).reshape(m * n, m, n)
    operator = np.stack([(high_pass(u) if filtered else u).ravel() for u in units], axis=1)
    whole, cols, rows = projections(m - 2 * margin, n - 2 * margin)
    forms = [whole @ operator, cols @ operator, rows @ operator]
    squares = [f.T @ f / f.shape[0] for f in forms]
    strata = [squares[0] - squares[1] - squares[2], squares[2], squares[1]]
    # row and column patterns of variance 1 instead of white pixels have the same dof as long as their correlation is the filter's
    expected = [np.trace(b) ** 2 / (b * b).sum() for b in strata]
    np.testing.assert_allclose(pattern_gains(shape, filtered).dof, expected, rtol=within)


def test_large_frames_have_the_gains_of_an_endless_one() -> None:
    """1 − 2 h₀ + Σh² = 0.98850 with h₀ = 1/121 for pixels; for rows and columns 1 − 2/11 + Σg² = 0.88906."""
    h, g = kernel(), kernel().sum(axis=0)
    pixel, line = 1 - 2 * h[9, 9] + (h**2).sum(), 1 - 2 * g[9] + (g**2).sum()
    assert (pixel, line) == pytest.approx((0.98850, 0.88906), abs=1e-5)
    m, n = 4018, 5018
    matrix = pattern_gains((m, n), filtered=True).matrix
    np.testing.assert_allclose(matrix[:, 0], [pixel, line / 4000, line / 5000], rtol=2e-3)
    np.testing.assert_allclose(matrix[[0, 0, 1, 2], [1, 2, 2, 1]], line, rtol=1e-6)
    assert matrix[1, 1] == matrix[2, 2] == 0.0
