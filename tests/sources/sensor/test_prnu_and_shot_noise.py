"""PRNU and photon shot noise: moments against the laws that they follow.

Tolerances are 5 standard errors (two-sided failure 6e-7 for Gaussian means); the smallest error that they would catch is twice that.
"""

from __future__ import annotations

import numpy as np
import pytest

from pixmetry.camera.covered import Covered
from pixmetry.camera.observations import CoveredPixels, Observations
from pixmetry.camera.signal import Kind
from pixmetry.core.number import Estimates
from pixmetry.observe.spatial_fit import fit_spatial
from pixmetry.observe.stack import StackAccumulator
from pixmetry.sources.sensor import prnu, shot_noise
from source_signals import flat, stream

SHAPE = (200, 300)
Z = 5.0


def parts(image: np.ndarray) -> tuple[float, float, float]:
    """Standard deviations of pixels, rows and columns by an analysis of variance."""
    m, n = image.shape
    rows, cols = image.mean(axis=1, keepdims=True), image.mean(axis=0, keepdims=True)
    rest = image - rows - cols + image.mean()
    pixel = (rest**2).sum() / ((m - 1) * (n - 1))
    return pixel**0.5, max(rows.var(ddof=1) - pixel / n, 0) ** 0.5, max(cols.var(ddof=1) - pixel / m, 0) ** 0.5


def test_prnu_has_the_stated_parts_and_is_the_same_in_every_frame(rng: np.random.Generator) -> None:
    params = prnu.Prnu(pixel_std_rel=0.02, row_std_rel=0.01, col_std_rel=0.005)
    out = prnu.forward(params, flat(5000.0, SHAPE, n=2), stream(rng))
    np.testing.assert_array_equal(out.data[0], out.data[1])
    found = parts(out.data[0].astype(float) / 5000.0)
    for value, true, n in zip(found, (0.02, 0.01, 0.005), (SHAPE[0] * SHAPE[1], *SHAPE), strict=True):
        # χ² sampling; the pixel part's scatter adds a little to that of rows and columns
        assert value == pytest.approx(true, abs=Z * true * (1 / (2 * n)) ** 0.5 * 1.2)
    assert out.data.mean() == pytest.approx(5000.0, rel=Z * (0.01**2 / 200 + 0.005**2 / 300) ** 0.5 * 1.1)


def test_prnu_scales_with_the_light_and_differs_between_units() -> None:
    params = prnu.Prnu(pixel_std_rel=0.02)
    one, two = (prnu.forward(params, flat(level, SHAPE), stream(1)).data[0] for level in (100.0, 1000.0))
    np.testing.assert_allclose(two, 10 * one, rtol=1e-6)
    other = prnu.forward(params, flat(100.0, SHAPE), stream(2)).data[0]
    # standard error of a correlation of n independent pairs
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < Z / one.size**0.5


def test_dividing_by_the_true_response_flattens(rng: np.random.Generator) -> None:
    params = prnu.Prnu(pixel_std_rel=0.02, col_std_rel=0.01)
    spoilt = prnu.forward(params, flat(1000.0, SHAPE, kind=Kind.ELECTRONS), stream(rng))
    flattened = prnu.correct(params, spoilt, {"prnu_rel": spoilt.data[0] / 1000.0}).data[0]
    np.testing.assert_allclose(flattened, 1000.0, rtol=1e-5)


@pytest.mark.parametrize("mean_e", [0.3, 20.0, 9000.0])
def test_shot_noise_has_the_variance_of_its_mean_and_no_memory_of_the_last_frame(mean_e: float, rng: np.random.Generator) -> None:
    n = SHAPE[0] * SHAPE[1]
    out = shot_noise.forward(shot_noise.ShotNoise(), flat(mean_e, SHAPE, n=2), stream(rng)).data.astype(float)
    assert out.mean() == pytest.approx(mean_e, abs=Z * (mean_e / (2 * n)) ** 0.5)
    # Var(s²) = µ₄/n − σ⁴ (n − 3)/(n (n − 1)), and µ₄ = 3µ² + µ
    assert out[0].var() == pytest.approx(mean_e, abs=Z * ((2 * mean_e**2 + mean_e) / n) ** 0.5)
    assert abs(np.corrcoef(out[0].ravel(), out[1].ravel())[0, 1]) < Z / n**0.5
    np.testing.assert_array_equal(out, np.floor(out))


def test_prnu_is_that_before_smear_and_late_charge(rng: np.random.Generator):
    """20 % of smear, and 0.4 % of each packet a pixel late in the mean: contrasts made here, pixel by pixel. Five u: 6e-7."""
    shape, light, late = (120, 160), 2000.0, 0.004
    true = 0.01 * rng.standard_normal(shape)
    lit = light * (1 + true)
    seen_dn = lit + 0.2 * light
    seen_dn = (1 - late) * seen_dn + late * np.roll(seen_dn, 1, axis=1)
    stacks = []
    for mean in (np.zeros(shape), seen_dn):
        sums = StackAccumulator(12)
        for _ in range(8):
            sums.add(np.rint(100 + mean + 3 * rng.standard_normal(shape)).astype(np.uint16))
        stacks.append(sums.result(0.01))
    cti = late / (0.5 * shape[1])
    rows = [("smear_s", 0.2 * 0.01, 1e-6, np.inf, "s"), ("serial_cti", cti, 0.01 * cti, np.inf, "1")]
    covered = CoveredPixels(Covered(right=8, bottom=8), Estimates.from_rows(rows), (), (), ())
    spatial = fit_spatial(*stacks)
    found = prnu.measure(Observations(spatial_fit=spatial, bright_stack=stacks[1], covered=covered))["pixel_std_rel"]
    assert abs(found.value - 0.01) < 5 * found.u and found.u < 1e-4
    assert spatial["prnu_pixel_rel"].value < 0.0086


def test_the_contrast_of_columns_is_without_what_smear_leaves_of_that_of_pixels(rng: np.random.Generator):
    """40 % of smear, the mean of each column: pixels of 1 % beside columns of 0.1 %. Five u: 6e-7; without it off by twelve u."""
    rows, cols, light = 60, 1600, 2000.0
    own = rng.standard_normal((1, cols))
    true = 0.01 * rng.standard_normal((rows, cols)) + 0.001 * (own - own.mean()) / own.std()
    lit = light * (1 + true)
    stacks = []
    for mean in (np.zeros((rows, cols)), lit + 0.4 * lit.mean(axis=0)):
        sums = StackAccumulator(12)
        for _ in range(8):
            sums.add(np.rint(100 + mean + 3 * rng.standard_normal((rows, cols))).astype(np.uint16))
        stacks.append(sums.result(0.01))
    smear = Estimates.from_rows([("smear_s", 0.4 * 0.01, 1e-6, np.inf, "s")])
    covered = CoveredPixels(Covered(right=8, bottom=8), smear, (), (), ())
    spatial = fit_spatial(*stacks)
    found = prnu.measure(Observations(spatial_fit=spatial, bright_stack=stacks[1], covered=covered))
    assert abs(found["col_std_rel"].value - 0.001) < 5 * found["col_std_rel"].u and found["col_std_rel"].u < 6e-5
    assert spatial["prnu_col_rel"].value > 0.00125
