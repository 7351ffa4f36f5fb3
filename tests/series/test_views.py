"""Targets from several sides: tilted discs with a slope of light, drawn with plain NumPy at five points a pixel.

Statistical tests fail by chance at 1e-6 each: 4.9 of the stated u of what the views really had.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.assess.page.views import views_section
from pixmetry.assess.results import views_record
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.series.views import find_view, views_of

Z, FINE, RADIUS = 4.9, 5, 4.5
PLACES = [(26.0 + 40 * i, 28.0 + 42 * j) for i in range(3) for j in range(2)]


def view(rng: np.random.Generator, tilt_deg: float = 0.0, slope: tuple[float, float] = (0.0, 0.0), amplitude: float = 2400.0) -> np.ndarray:
    """Six discs of one plate that is tilted about any axis; light in proportion to 1 + slope · (x − centre), 12 bits."""
    shape = (98, 132)
    y, x = (np.indices((shape[0] * FINE, shape[1] * FINE)) + 0.5) / FINE - 0.5
    light, turn = np.zeros(y.shape), rng.uniform(0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    for cx, cy in PLACES:
        box = tuple(slice(int((v - 9) * FINE), int((v + 9) * FINE)) for v in (cy, cx))
        dx, dy = x[box] - cx - rng.uniform(-0.5, 0.5), y[box] - cy - rng.uniform(-0.5, 0.5)
        inside = ((dx * c + dy * s) / np.cos(np.radians(tilt_deg))) ** 2 + (dy * c - dx * s) ** 2 < RADIUS**2
        light[box] += inside * (1 + slope[0] * dx + slope[1] * dy)
    seen = gaussian_filter(light, 0.6 * FINE).reshape(shape[0], FINE, shape[1], FINE).mean(axis=(1, 3))
    dn = 200 + amplitude * seen
    return np.clip(np.rint(dn + rng.normal(0, 1, shape) * np.sqrt(400 + 0.2 * dn)), 0, 4095).astype(np.uint16)


def observed(frames: list[np.ndarray], **optics: float) -> Observations:
    campaign = campaign_of_arrays([Frames("views", 0.01, np.array(frames))], bits=12, name="camera", pitch_um=5.0, optics=optics)
    return observe_campaign(campaign, no_progress)[1]


def test_slopes_of_the_light_and_the_angle_of_view_are_told(rng: np.random.Generator) -> None:
    slopes, tilts = rng.normal(0, 0.01, (8, 2)), [48.0, *rng.uniform(5, 35, 7)]
    seen = observed([view(rng, t, tuple(g)) for t, g in zip(tilts, slopes, strict=True)], focal_length_mm=12.0)
    found, fit = seen.views, seen.views.fit
    really = float(np.sqrt(np.square(slopes).mean()))
    slope = fit["gradient_rel_per_px"]
    assert abs(slope.value - really) < 0.1 * really  # of these views; u holds those of others
    assert slope.u == pytest.approx(really / np.sqrt(2 * 16), rel=0.3)
    assert abs(fit["view_angle_deg"].value - 48) < Z * fit["view_angle_deg"].u + 0.3 and fit["view_angle_deg"].u < 1
    assert fit["diameter_px"].value == pytest.approx(2 * RADIUS, rel=0.02)
    assert abs(found.slope - 1) < Z * found.u_slope + 0.02
    z = np.concatenate([(found.gradient_x_per_px - slopes[found.view, 0]) / found.u_gradient_x_per_px,
                        (found.gradient_y_per_px - slopes[found.view, 1]) / found.u_gradient_y_per_px])  # fmt: skip
    assert 0.6 < z.std() < 1.5
    radius, tilt = found.semi_major_px[found.view == 0].mean(), np.radians(found.angle_deg[0])
    assert found.eccentricity_px[0] == pytest.approx(radius**2 * np.sin(tilt) * np.cos(tilt) / 2400, rel=0.01)
    measured = measure_sources(seen)[0]["scene.view_point"]
    assert measured["principal_distance_px"].value == 2400 and any("coat" in c for c in measured.confounders)
    assert len(views_record(found)["targets"]) == len(found.view) == 48
    assert "glossy" in str(views_section(found).parts)


def test_even_light_from_the_front_gives_limits(rng: np.random.Generator) -> None:
    seen = observed([view(rng) for _ in range(6)])
    slope = seen.views.fit["gradient_rel_per_px"]
    assert slope.value < 0.002 and seen.views.surface == "retro" and seen.views.eccentricity_px is None
    assert seen.views.fit["view_angle_deg"].value < 8
    assert "scene.view_point" in measure_sources(seen)[0]


def test_a_slope_that_all_views_share_is_named(rng: np.random.Generator) -> None:
    found = observed([view(rng, 10.0, (0.01, 0.0)) for _ in range(4)]).views
    assert any("all views" in note for note in found.notes) and any("4 views" in note for note in found.notes)


def test_dim_retro_reflectors_are_named(rng: np.random.Generator) -> None:
    views = [find_view(view(rng, t, amplitude=a), str(t), 0.01, bits=12) for t, a in ((0, 2400.0), (20, 2300.0), (45, 700.0))]
    assert any("dim" in note and "45" in note for note in views_of(views).notes)


def test_too_few_views_say_what_to_take(rng: np.random.Generator) -> None:
    blank = np.full((98, 132), 200, np.uint16) + rng.integers(0, 9, (98, 132)).astype(np.uint16)
    seen = observed([view(rng), blank])
    assert "1 view" in seen.failed["views"] and "1 view" in measure_sources(seen)[1]["scene.view_point"]
    with pytest.raises(MeasureError, match="8 sides"):
        views_of([])
