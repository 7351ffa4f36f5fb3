"""DSNU: the parts' variances, their persistence, the blind measurement in electrons, and the shift of a centroid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.observe.spatial_fit import fit_spatial
from pixmetry.observe.stack import StackAccumulator
from pixmetry.sources.sensor.dsnu import SOURCE, Dsnu
from source_signals import ALPHA, K_DN_PER_E, centroid, fitted, flat, signal, spot_probe, spots, stream

SHAPE = (200, 300)


def test_parts_have_their_variances(rng: np.random.Generator):
    """Two-way analysis of variance: each mean square is χ² about its expectation, at 1e-6; catches 2 % in the pixel part, 30 % in lines."""
    pixel, row, col = 3.0, 2.0, 1.0
    out = SOURCE.forward(Dsnu(pixel_std_e=pixel, row_std_e=row, col_std_e=col), flat(0.0, SHAPE), stream(rng)).data[0].astype(float)
    rows, cols = SHAPE
    by_row, by_col = out.mean(axis=1), out.mean(axis=0)
    rest = out - by_row[:, None] - by_col[None, :] + out.mean()
    for squares, expected, dof in (
        ((rest**2).sum(), pixel**2, (rows - 1) * (cols - 1)),
        (by_row.var() * rows, row**2 + pixel**2 / cols, rows - 1),
        (by_col.var() * cols, col**2 + pixel**2 / rows, cols - 1),
    ):
        low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], dof)
        assert low < squares / expected < high


def test_same_unit_same_pattern(rng: np.random.Generator):
    one = stream(rng)
    other = type(one)(one.unit_seed, one.exposure_seed + 1, one.name)
    frames = SOURCE.forward(SOURCE.bound, flat(0.0, (20, 20), n=2), one).data
    assert np.array_equal(frames[0], frames[1])
    assert np.array_equal(frames, SOURCE.forward(SOURCE.bound, flat(0.0, (20, 20), n=2), other).data)
    assert not np.array_equal(frames, SOURCE.forward(SOURCE.bound, flat(0.0, (20, 20), n=2), stream(rng)).data)


def test_measured_blind_in_electrons(rng: np.random.Generator):
    """Within 6 u (t law of 60 degrees of freedom and more, 1e-6) of the truth, through stacks with temporal noise."""
    shape, gain = (96, 128), 0.5
    params = Dsnu(pixel_std_e=6.0, row_std_e=3.0, col_std_e=2.0)
    fixed = gain * SOURCE.forward(params, flat(0.0, shape), stream(rng)).data[0]
    stacks = []
    for level in (100, 1100):
        accumulator = StackAccumulator(12)
        for _ in range(16):
            accumulator.add(np.rint(level + fixed + rng.normal(0, 2, shape)).astype(np.uint16))
        stacks.append(accumulator.result(0.01))
    transfer = fitted(gain_dn_per_e=(gain, 0.001, "DN/e-"))
    got = SOURCE.measure(Observations(spatial_fit=fit_spatial(*stacks), photon_transfer_fit=transfer))
    for name, value in params.model_dump().items():
        assert abs(got[name].value - value) < 6 * got[name].u, name
        assert got[name].u < 0.15 * value


def test_uncertainty_of_the_gain_is_carried_with_its_covariance(rng: np.random.Generator):
    """Against a Monte Carlo over gain and split (JCGM 101): u to 5 %, correlation of two parts to 0.05 (20 000 draws: 1e-6 is 0.035)."""
    n = 20_000
    spatial = fitted(dsnu_pixel_dn=(2.0, 0.02, "DN"), dsnu_row_dn=(0.5, 0.03, "DN"), dsnu_col_dn=(0.3, 0.01, "DN"))
    got = SOURCE.measure(Observations(spatial_fit=spatial, photon_transfer_fit=fitted(gain_dn_per_e=(0.2, 0.01, "DN/e-"))))
    gain = rng.normal(0.2, 0.01, n)
    draws = np.stack([rng.normal(v, u, n) / gain for v, u in ((2.0, 0.02), (0.5, 0.03), (0.3, 0.01))])
    assert got.u == pytest.approx(draws.std(axis=1), rel=0.05)
    assert got.covariance[0, 2] / (got.u[0] * got.u[2]) == pytest.approx(np.corrcoef(draws)[0, 2], abs=0.05)


def test_missing_observations_are_named():
    with pytest.raises(MeasureError, match="stack of dark frames"):
        SOURCE.measure(Observations())
    spatial = fitted(dsnu_pixel_dn=(2.0, 0.02, "DN"), dsnu_row_dn=(0.5, 0.03, "DN"), dsnu_col_dn=(0.3, 0.01, "DN"))
    with pytest.raises(MeasureError, match="gain"):
        SOURCE.measure(Observations(spatial_fit=spatial))


def test_dark_frame_takes_the_pattern_off(rng: np.random.Generator):
    one, scene = stream(rng), signal(rng.uniform(0, 1e4, (2, 30, 40)))
    dark_dn = K_DN_PER_E * SOURCE.forward(SOURCE.bound, flat(0.0, (30, 40)), one).data[0]
    after = SOURCE.forward(SOURCE.bound, scene, one)
    fixed = SOURCE.correct(SOURCE.bound, after.with_data(after.data * np.float32(K_DN_PER_E), Kind.DN), {"dark_dn": dark_dn})
    assert np.abs(fixed.data - K_DN_PER_E * scene.data).max() < 1e-4


def test_shift_is_that_of_the_centroid_over_units():
    """Direct simulation over 1500 units; standard deviations of 1500 normal values lie within 9 % at 1e-6."""
    params = Dsnu(pixel_std_e=20.0, row_std_e=8.0, col_std_e=4.0)
    got = SOURCE.propagate(params, spot_probe(n=1))
    x = y = np.array([12.0])
    image = spots(x, y) / K_DN_PER_E
    shifts = np.array([np.ravel(centroid(SOURCE.forward(params, signal(image), stream(i + 7)).data.astype(float))) for i in range(1500)])
    assert shifts.std(axis=0) == pytest.approx([got.u_x_px, got.u_y_px], rel=0.1)
    assert got.u_y_px > got.u_x_px
    assert math.isclose(got.bias_x_px, 0)


def test_degrees_of_freedom_are_those_of_what_u_comes_from():
    """Of the split where the gain is known, of the gain where the split is; between, as JCGM 100 G.4.1 has it for a quotient."""

    def measured(u_dn, u_gain):
        rows = [(f"dsnu_{part}_dn", 2.0, u_dn, 60.0, "DN") for part in ("pixel", "row", "col")]
        gain = Estimates.from_rows([("gain_dn_per_e", 0.2, u_gain, 25.0, "DN/e-")])
        return SOURCE.measure(Observations(spatial_fit=Estimates.from_rows(rows), photon_transfer_fit=gain))

    assert measured(0.1, 1e-9).dof == pytest.approx(60.0, rel=1e-6)
    assert measured(1e-9, 0.01).dof == pytest.approx(25.0, rel=1e-6)
    # relative parts 0.05 and 0.05: (0.05² + 0.05²)² / (0.05⁴/60 + 0.05⁴/25)
    assert measured(0.1, 0.01).dof == pytest.approx(4 / (1 / 60 + 1 / 25), rel=1e-6)
