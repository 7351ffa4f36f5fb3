"""Tilt and bending of a sensor from edges at several settings of the focus; pictures in closed form, made without the package.

Statistical tests fail once in a million runs.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from observe.edge_pictures import spread, stored
from pixmetry import campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import FocusOverFrame, Observations
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.errors import MeasureError
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames
from pixmetry.observe.edges import Picture, responses_of, search_edges
from pixmetry.observe.focus import focus_of
from pixmetry.sources.sensor.tilt import SOURCE as TILT
from pixmetry.sources.sensor.tilt import Tilt, defocus_px2
from pixmetry.sources.sensor.unflatness import Unflatness, height_um

SHAPE = (480, 640)
PITCH = 4.0
SETTINGS = (-60.0, -20.0, 20.0, 60.0)
STATED = StatedFacts(pitch_x_um=PITCH, pitch_y_um=PITCH)
RATE = 1e-6


def z_of(x: np.ndarray, y: np.ndarray, tilt: tuple[float, float], surface: Unflatness) -> np.ndarray:
    """Height of the sensor, µm: the plane by its angles, the shapes by the source's own polynomials."""
    plane = PITCH * (np.tan(np.radians(tilt[0])) * (x - 319.5) + np.tan(np.radians(tilt[1])) * (y - 239.5))
    return plane + height_um(surface, x, y, SHAPE)


FLAT = Unflatness()


def picture(rng, focus_um: float, tilt=(0.0, 0.0), surface=FLAT, f_number=4.0, sigma=0.45, at_best=5.0, noise=5.0) -> np.ndarray:
    """Bright squares, turned by 5 degrees, each as sharp as its place; the lens has an aberration that grows with the radius."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    c, s = np.cos(np.radians(5)), np.sin(np.radians(5))
    out = np.full(SHAPE, 200.0)
    for cy in range(80, SHAPE[0], 160):
        for cx in range(80, SHAPE[1], 160):
            near = (np.abs(x - cx) < 80) & (np.abs(y - cy) < 80)
            ex, ey = x[near] - cx, y[near] - cy
            along, across = ex * c + ey * s, ey * c - ex * s
            z = z_of(x[near], y[near], tilt, surface) + focus_um - at_best
            var = sigma**2 + ((cx - 320) ** 2 + (cy - 240) ** 2) * 5e-7 + (z / (4 * f_number * PITCH)) ** 2
            blur = np.sqrt(var)
            one = spread(along + 48, blur) - spread(along - 48, blur)
            out[near] += 1000 * one * (spread(across + 48, blur) - spread(across - 48, blur))
    return out + noise * rng.standard_normal(SHAPE)


def measured(rng, settings=SETTINGS, stated=STATED, **camera) -> FocusOverFrame:
    frames = [stored(picture(rng, f, **camera)) for f in settings]
    found = responses_of(search_edges([Picture("edge", frame.astype(np.float32), 1, 4095.0) for frame in frames]))
    return focus_of(found.edges, found.frequency, settings, SHAPE, stated)


def told(surface: Unflatness) -> np.ndarray:
    """Bow and twist without what is curved as the square of the radius."""
    n = np.array([SHAPE[1], SHAPE[0]], float) ** 2
    bow = np.array([surface.bow_x_um, surface.bow_y_um])
    return np.array([*(bow - n * (bow @ n) / (n @ n)), surface.twist_um])


def test_stat_tilt_and_shapes_of_random_cameras(rng) -> None:
    """3 cameras: errors over u of the tilts, the shapes and the f-number; u from half as large to a quarter larger passes."""
    ratios = []
    for _ in range(3):
        tilt = tuple(rng.normal(0, 0.7, 2))
        surface = Unflatness(bow_x_um=float(rng.normal(0, 8)), bow_y_um=float(rng.normal(0, 8)), twist_um=float(rng.normal(0, 5)))
        f_number = float(rng.uniform(3.5, 5))
        fit = measured(rng, tilt=tilt, surface=surface, f_number=f_number).fit
        names = ("tilt_x_deg", "tilt_y_deg", "bow_x_um", "twist_um", "f_number")
        truth = np.array([*tilt, *told(surface)[[0, 2]], f_number])
        ratios.append([(fit[name].value - value) / fit[name].u for name, value in zip(names, truth, strict=True)])
    z = np.concatenate(ratios)
    assert (z**2).sum() < stats.chi2.isf(RATE, z.size) * 1.25**2 and (z**2).sum() > stats.chi2.ppf(RATE, z.size) * 0.5**2
    assert fit["tilt_x_deg"].u < 0.05 and fit["f_number"].u < 0.1


def test_a_flat_square_sensor_has_no_tilt(rng) -> None:
    fit = measured(rng).fit
    for name in ("tilt_x_deg", "tilt_y_deg", "bow_x_um", "twist_um"):
        assert abs(fit[name].value) < 7 * fit[name].u


def test_the_sign_of_a_tilt_is_that_of_the_source() -> None:
    """The side that lies farther from the lens is out of focus where the sensor was moved away."""
    x, y = np.array([600.0, 40.0]), np.array([239.5, 239.5])
    params = Tilt(tilt_x_deg=1.0, pitch_x_um=PITCH, pitch_y_um=PITCH, f_number=4.0)
    own = np.sqrt(defocus_px2(params, x, y, SHAPE)) * 16 * PITCH
    np.testing.assert_allclose(own * [1, -1], z_of(x, y, (1.0, 0.0), Unflatness()), rtol=1e-3)


@pytest.mark.parametrize(
    ("settings", "stated", "said"),
    [
        ((-20.0, 20.0), STATED, "2 settings of the focus"),
        (SETTINGS[:3], StatedFacts(), "pixel pitch is not stated"),
        ((0.0, 0.1, 0.2), STATED, "does not grow on both sides"),
    ],
)
def test_what_the_settings_do_not_tell_has_a_reason(rng, settings, stated, said) -> None:
    assert said in measured(rng, settings, stated).fit.reasons["tilt_x_deg"]


def test_pictures_of_a_campaign_tell_the_tilt_and_the_sharpest_the_lens(rng) -> None:
    groups = [
        Frames("edge", 0.01, stored(picture(rng, f, tilt=(1.0, -0.5)))[None], facts=GroupFacts(focus_um=f)) for f in (-60.0, 0.0, 60.0)
    ]
    campaign = campaign_of_arrays(groups, bits=12, pitch_um=PITCH)
    _, seen = observe_campaign(campaign, no_progress)
    assert any("the sharpest, 0 µm" in note for note in seen.notes)
    found = measure_sources(seen)[0]
    tilt = found["sensor.tilt"]
    assert abs(tilt["tilt_x_deg"].value - 1.0) < 6 * tilt["tilt_x_deg"].u < 1.0
    assert abs(tilt["tilt_y_deg"].value + 0.5) < 6 * tilt["tilt_y_deg"].u
    assert "twist_um" in found["sensor.unflatness"]
    assert found["optics.point_spread"]["sigma_px"].value < 0.8


def test_without_settings_the_tilt_says_what_is_missing() -> None:
    with pytest.raises(MeasureError, match="three settings of the focus"):
        TILT.measure(Observations())
