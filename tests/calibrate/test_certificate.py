"""Certificates with A1, A2, A3, R0: both readings against drawings by their formulas, and the test that tells them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.networks import looking
from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.certificate import compare_readings, models_of_certificate
from pixmetry.core.errors import InputError, MeasureError

SENSOR = Sensor(4288, 2848, 8.45, 8.45)
NUMBERS = {
    "c": -28.5, "x0": 0.11, "y0": -0.08, "A1": -8e-5, "A2": 9e-8, "A3": 1e-11, "R0": 12.0,
    "B1": 6e-6, "B2": -9e-6, "C1": 1.2e-4, "C2": -8e-5,
}  # fmt: skip


def _delta(x, y, n):
    """Δx, Δy of the certificate, y up."""
    r2, r0 = x**2 + y**2, n["R0"] ** 2
    radial = n["A1"] * (r2 - r0) + n["A2"] * (r2**2 - r0**2) + n["A3"] * (r2**3 - r0**3)
    return (
        x * radial + n["B1"] * (r2 + 2 * x**2) + 2 * n["B2"] * x * y + n["C1"] * x + n["C2"] * y,
        y * radial + n["B2"] * (r2 + 2 * y**2) + 2 * n["B1"] * x * y,
    )


def _drawn(u, v, where, n=NUMBERS):
    """Pixels of directions (v down): by the formula at the ideal coordinates, or solved for the measured ones."""
    ideal = np.array([-n["c"] * u, n["c"] * v])  # y up
    x, y = ideal
    for _ in range(60 if where == "measured" else 1):
        x, y = ideal + _delta(x, y, n)
    return 2143.5 + (x + n["x0"]) / 8.45e-3, 1423.5 - (y + n["y0"]) / 8.45e-3


@pytest.mark.parametrize(("where", "within"), [("measured", 1e-8), ("ideal", 0.02)])
def test_either_reading_draws_as_its_formula(where, within, rng):
    """Exact at the measured coordinates; at the ideal ones but for the product of C1, C2 and the distortion, here 0.02 px."""
    u, v = rng.uniform(-0.6, 0.6, 400), rng.uniform(-0.4, 0.4, 400)
    model = models_of_certificate(NUMBERS, SENSOR)[where]
    np.testing.assert_allclose(model.project(u, v), _drawn(u, v, where), atol=within)
    other = models_of_certificate(NUMBERS, SENSOR)["ideal" if where == "measured" else "measured"]
    assert np.abs(np.subtract(other.project(u, v), _drawn(u, v, where))).max() > 0.1


def test_without_affinity_both_are_exact(rng):
    u, v = rng.uniform(-0.6, 0.6, 200), rng.uniform(-0.4, 0.4, 200)
    numbers = {**NUMBERS, "C1": 0.0, "C2": 0.0}
    for where, model in models_of_certificate(numbers, SENSOR).items():
        np.testing.assert_allclose(model.project(u, v), _drawn(u, v, where, numbers), atol=1e-8)


def test_y_down_changes_the_signs_across():
    up, down = (models_of_certificate(NUMBERS | {"y0": y, "B2": b, "C2": c}, SENSOR, y_up=y_up)["measured"]
                for y, b, c, y_up in ((-0.08, -9e-6, -8e-5, True), (0.08, 9e-6, 8e-5, False)))  # fmt: skip
    np.testing.assert_allclose(up.values, down.values)


def _network(rng, where, numbers=NUMBERS, noise_px=0.05) -> Network:
    """Known points of a volume, eight images."""
    xyz = rng.uniform(-1, 1, (80, 3)) * [900, 600, 200]
    parts = []
    for i in range(8):
        stand = np.array([np.sin(0.4) * np.cos(i), np.sin(0.4) * np.sin(i), np.cos(0.4)])
        inside = (xyz - 1900 * stand) @ looking(stand, np.zeros(3), i * np.pi / 2).T
        x, y = _drawn(inside[:, 0] / inside[:, 2], inside[:, 1] / inside[:, 2], where, numbers)
        seen = np.flatnonzero((x > 2) & (x < 4285) & (y > 2) & (y < 2845))
        parts.append((np.full(len(seen), i), seen, x[seen], y[seen]))
    image, point, x, y = (np.concatenate(part) for part in zip(*parts, strict=True))
    x, y = x + noise_px * rng.standard_normal(len(x)), y + noise_px * rng.standard_normal(len(y))
    model = CameraModel.of(SENSOR, c=28.0)
    return Network(
        (model,), tuple(f"i{k}" for k in range(8)), np.zeros(8, int), tuple(f"p{k}" for k in range(80)), x, y, image, point,
        np.tile([noise_px**2, 0, noise_px**2], (len(x), 1)), xyz, np.zeros((80, 3)), covariance_known=True,
    )  # fmt: skip


@pytest.mark.parametrize("where", ["measured", "ideal"])
def test_residuals_tell_the_reading(where, rng):
    strong = NUMBERS | {"A1": -2.5e-4, "A2": 3e-7, "C1": 0.0, "C2": 0.0}
    network = _network(rng, where, strong)
    best, other = compare_readings(network, strong)
    assert best.evaluated_at == where and other.rms_px > 2 * best.rms_px
    assert best.rms_px == pytest.approx(0.05, rel=6 / np.sqrt(4 * len(network)))


def test_a_lens_without_distortion_tells_nothing(rng):
    plain = {"c": -28.5, "R0": 12.0}
    with pytest.raises(MeasureError, match="both readings"):
        compare_readings(_network(rng, "ideal", {**dict.fromkeys(NUMBERS, 0.0), **plain}), plain)


def test_what_is_no_certificate_is_refused():
    with pytest.raises(InputError, match="not a number of such a certificate"):
        models_of_certificate({"c": 20, "K1": 1e-4}, SENSOR)
    with pytest.raises(InputError, match="principal distance is missing"):
        models_of_certificate({"A1": 1e-4}, SENSOR)
    with pytest.raises(InputError, match="no pitch"):
        models_of_certificate({"c": 20}, replace(SENSOR, pitch_x_um=None, pitch_y_um=None))
