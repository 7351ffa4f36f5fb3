"""Values of other programs as the documentation takes them over: their formulas, written down here, against our camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pixmetry.calibrate.bundle.model import CameraModel, Sensor
from pixmetry.calibrate.project import load_project
from pixmetry.core.errors import InputError

SENSOR = Sensor(4000, 3000, 5.0, 5.0)


@pytest.mark.parametrize("sign", [1, -1], ids=["added", "subtracted"])
def test_balanced_radial_terms(rng, sign):
    """Corrections A1 (r² − R0²) + A2 (r⁴ − R0⁴) + A3 (r⁶ − R0⁶), decentring and affinity, added to x̄ or subtracted."""
    a = rng.normal(size=3) * [2e-4, 1e-6, 3e-9]
    (p1, p2), (b1, b2), c, r0 = rng.normal(size=2) * 1e-5, rng.normal(size=2) * 1e-4, 24.0, 8.0
    x_px, y_px = rng.uniform(0, 3999, 50), rng.uniform(0, 2999, 50)
    x, y = (x_px - 1999.5) * 0.005, (y_px - 1499.5) * 0.005
    r2 = x**2 + y**2
    radial = sum(a[n] * (r2 ** (n + 1) - r0 ** (2 * n + 2)) for n in range(3))
    dx = x * radial + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y + b1 * x + b2 * y
    dy = y * radial + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
    s = 1 - sign * sum(a[n] * r0 ** (2 * n + 2) for n in range(3))
    k = {f"k{n + 1}": sign * a[n] / s for n in range(3)}
    lens = {"p1": sign * p1 / s, "p2": sign * p2 / s, "b1": sign * b1 / s, "b2": sign * b2 / s}
    u, v = CameraModel.of(SENSOR, c=c / s, **k, **lens).direction_of(x_px, y_px)
    np.testing.assert_allclose(u, (x + sign * dx) / c, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(v, (y + sign * dy) / c, rtol=1e-12, atol=1e-15)


def test_a_certificate_in_a_project(rng, tmp_path: Path):
    """A1 A2 A3 R0, B1 B2, C1 C2: corrections of measured coordinates in mm, y up, that are subtracted; c negative."""
    a, r0, c = rng.normal(size=3) * [2e-4, 1e-6, 3e-9], 8.0, -24.0
    (b1, b2), (c1, c2), (x0, y0) = rng.normal(size=2) * 1e-5, rng.normal(size=2) * 1e-4, rng.normal(size=2) * 0.1
    x_mm, y_mm = rng.uniform(-9.9, 9.9, 50), rng.uniform(-7.4, 7.4, 50)
    x, y = x_mm - x0, y_mm - y0
    r2 = x**2 + y**2
    radial = sum(a[n] * (r2 ** (n + 1) - r0 ** (2 * n + 2)) for n in range(3))
    dx = x * radial + b1 * (r2 + 2 * x**2) + 2 * b2 * x * y + c1 * x + c2 * y
    dy = y * radial + b2 * (r2 + 2 * y**2) + 2 * b1 * x * y
    s = 1 + sum(a[n] * r0 ** (2 * n + 2) for n in range(3))
    values = {"c_mm": abs(c) / s, "xp_px": 1999.5 + x0 / 0.005, "yp_px": 1499.5 - y0 / 0.005, "p1": -b1 / s, "p2": -b2 / s}
    values |= {"b1": -c1 / s, "b2": -c2 / s, **{f"k{n + 1}": -a[n] / s for n in range(3)}}
    (tmp_path / "o.csv").write_text("image,point,x_mm,y_mm\na,1,0,0\n")
    keys = ", ".join(f"{name}: {float(value)!r}" for name, value in values.items())
    text = f"schema: pixmetry/calibration/1\ncameras: {{cols: 4000, rows: 3000, pitch_um: 5, free: none, {keys}}}\nobservations: o.csv\n"
    (tmp_path / "p.yaml").write_text(text)
    (model,) = load_project(tmp_path / "p.yaml").network.cameras
    u, v = model.direction_of(1999.5 + x_mm / 0.005, 1499.5 - y_mm / 0.005)
    np.testing.assert_allclose(u, (x - dx) / -c, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(-v, (y - dy) / -c, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize(
    ("key", "meant"),
    [("a1", "k1"), ("R0", "k1"), ("c1", "b1"), ("C2", "b2"), ("x0_mm", "xp_px"), ("x0_px", "xp_px"), ("xh", "xp_px"), ("B1", "p1")],
)
def test_names_of_other_programs_are_led_to_ours(tmp_path: Path, key: str, meant: str):
    text = f"schema: pixmetry/calibration/1\ncameras: {{cols: 64, rows: 48, {key}: 0.1}}\nobservations: o.csv\n"
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        load_project(tmp_path / "p.yaml")
    for words in ("p.yaml, line 2", f"unknown key '{key}'", f"`{meant}`", "Values of another program"):
        assert words in str(caught.value), str(caught.value)


def test_metashape(rng):
    """Its pixel (0, 0) is the outer corner of the frame; f, cx, cy, b1, b2 are in pixels."""
    f, cx, cy, b1, b2 = 5200.0, 13.0, -7.0, 2.5, -1.5
    k, p1, p2 = rng.normal(size=4) * [0.1, 0.1, 0.1, 0.1], *rng.normal(size=2) * 1e-3
    u, v = rng.uniform(-0.37, 0.37, 50), rng.uniform(-0.28, 0.28, 50)
    r2 = u**2 + v**2
    radial = 1 + sum(k[n] * r2 ** (n + 1) for n in range(4))
    a, b = u * radial + p1 * (r2 + 2 * u**2) + 2 * p2 * u * v, v * radial + p2 * (r2 + 2 * v**2) + 2 * p1 * u * v
    corner = 4000 * 0.5 + cx + a * f + a * b1 + b * b2, 3000 * 0.5 + cy + b * f
    lens = {f"k{n + 1}": k[n] for n in range(4)} | {"p1": p1, "p2": p2, "b1": b1 / f, "b2": b2 / f}
    model = CameraModel.of(SENSOR, "object_to_image", c=f * 0.005, xp=1999.5 + cx, yp=1499.5 + cy, **lens)
    np.testing.assert_allclose(model.project(u, v), np.array(corner) - 0.5, rtol=1e-12)


def test_coefficients_of_normalised_coordinates(rng):
    """u = x̄/c (1 + K1 c² (x̄/c)² + …): the same corrections, of r divided by c."""
    c, k, p1, p2 = 24.0, rng.normal(size=3) * [2e-4, 1e-6, 3e-9], 1e-5, -2e-5
    x_px, y_px = rng.uniform(0, 3999, 50), rng.uniform(0, 2999, 50)
    m, n = (x_px - 1999.5) * 0.005 / c, (y_px - 1499.5) * 0.005 / c
    r2 = m**2 + n**2
    radial = 1 + k[0] * c**2 * r2 + k[1] * c**4 * r2**2 + k[2] * c**6 * r2**3
    u, v = CameraModel.of(SENSOR, c=c, k1=k[0], k2=k[1], k3=k[2], p1=p1, p2=p2).direction_of(x_px, y_px)
    np.testing.assert_allclose(u, m * radial + p1 * c * (r2 + 2 * m**2) + 2 * p2 * c * m * n, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(v, n * radial + p2 * c * (r2 + 2 * n**2) + 2 * p1 * c * m * n, rtol=1e-12, atol=1e-15)
