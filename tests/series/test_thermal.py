"""The temperature of every frame tells how scale and place of the image follow it; displacements are those of the source itself.

Statistical tests fail once in a million runs.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from tests.series.fixed_field import rendered

from pixmetry import campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import MeasureError
from pixmetry.core.progress import no_progress
from pixmetry.files.in_memory import Frames
from pixmetry.series.modes import field_motion
from pixmetry.series.thermal import thermal_of
from pixmetry.sources.sensor.thermal_expansion import SOURCE, ThermalExpansion, pull_of

RATE = 1e-6
SHAPE = (480, 640)
CENTRE = (319.5, 239.5)
U_PX = 0.01
CYCLE = 6.0  # K, amplitude of the temperature


def seen_at(places: np.ndarray, params: ThermalExpansion, temperature_c: float) -> np.ndarray:
    """Where places of the reference temperature are seen, by fixed-point iteration of the source's own map."""
    pull, seen = pull_of(params, temperature_c, SHAPE), places.copy()
    for _ in range(8):
        seen = seen + places - np.stack(pull(*seen.T), axis=1)
    return seen


def temperatures(time_s: np.ndarray) -> np.ndarray:
    return 30 + CYCLE * np.sin(2 * np.pi * time_s / 4000) + 2 * (1 - np.exp(-time_s / 700))


def a_series(rng, params: ThermalExpansion, *, warm_up_px: float = 0.0, shake_px: float = 0.0, read=temperatures, frames: int = 50):
    time_s = np.arange(frames) * 120.0
    temperature_c = read(time_s)
    places = np.stack([v.ravel() for v in np.meshgrid(np.linspace(60, 580, 5), np.linspace(60, 420, 4))], axis=1)
    grown = warm_up_px / 300 * (1 - np.exp(-time_s / 900))
    positions = np.stack([seen_at(places, params, t) for t in temperature_c])
    positions = positions + grown[:, None, None] * (places - CENTRE) + (warm_up_px * (1 - np.exp(-time_s / 1500)))[:, None, None]
    positions += shake_px * rng.standard_normal((frames, 1, 2)) + U_PX * rng.standard_normal(positions.shape)
    covariance = np.broadcast_to(U_PX**2 * np.eye(2), (*positions.shape, 2))
    return field_motion(positions, covariance, CENTRE), time_s, temperature_c


def a_camera(rng) -> ThermalExpansion:
    shift = rng.normal(0, 0.01, 2)
    return ThermalExpansion(
        sensor_per_k=2.6e-6, mount_per_k=float(rng.uniform(5e-6, 40e-6)), shift_x_px_per_k=shift[0], shift_y_px_per_k=shift[1]
    )


def test_stat_coefficients_lie_where_their_u_says(rng) -> None:
    """60 cameras that warm up besides and shake a little: 180 ratios against chi square, u from 15 % too small to as much too large."""
    ratios = []
    for _ in range(60):
        params = a_camera(rng)
        found, left = thermal_of(*a_series(rng, params, warm_up_px=float(rng.uniform(0, 0.3)), shake_px=float(rng.uniform(0, 0.02))))
        truth = np.array([params.mount_per_k - params.sensor_per_k, params.shift_x_px_per_k, params.shift_y_px_per_k])
        # the image's shift is at the reference temperature's scale, the fit's at that of the mean: alike to 1e-5
        ratios.append((found.values[:3] - truth) / found.u[:3])
        assert np.abs(left.values[:, left.modes.index("scale_rel")]).max() < 2e-3
    z = np.concatenate(ratios)
    assert abs(z.mean()) < 1.15 * stats.norm.isf(RATE / 2) / np.sqrt(len(z))
    low, high = stats.chi2.ppf(RATE, len(z)), stats.chi2.isf(RATE, len(z))
    assert low * 0.85**2 < (z**2).sum() < high * 1.15**2 * 44 / 42  # Student's variance with 44 degrees of freedom


def test_u_is_that_of_the_positions_where_nothing_else_moves(rng) -> None:
    """Against the bound by hand: u of a scale from 20 places, over what a drift leaves of the temperature."""
    motion, time_s, temperature_c = a_series(rng, a_camera(rng))
    found, _ = thermal_of(motion, time_s, temperature_c)
    t = time_s / time_s[-1]
    rest = np.column_stack([np.ones_like(t), t, *(np.exp(-t / tau) for tau in (0.02, 0.05, 0.1, 0.17, 0.3))])
    own = temperature_c - rest @ np.linalg.lstsq(rest, temperature_c, rcond=None)[0]
    radius2 = (motion.places_px**2).sum()
    bound = U_PX / np.sqrt(radius2) / np.sqrt((own**2).sum())
    assert 0.6 < found["scale_per_k"].u / bound < 1.8  # the scatter is estimated from 45 frames, its correlation too


def test_a_camera_that_does_not_expand_has_nothing(rng) -> None:
    found, _ = thermal_of(*a_series(rng, ThermalExpansion(), warm_up_px=0.2))
    assert (np.abs(found.values[:3]) < 6.5 * found.u[:3]).all()


@pytest.mark.parametrize(
    ("read", "frames", "said"),
    [
        (lambda t: 20 + 15 * (1 - np.exp(-t / 1500)), 50, "only follows the time"),
        (lambda t: 25 + 0 * t, 50, "changes by 0 K only"),
        (temperatures, 12, "12 frames with a temperature"),
    ],
)
def test_what_a_series_does_not_tell_has_a_reason(rng, read, frames, said) -> None:
    motion, time_s, temperature_c = a_series(rng, a_camera(rng), read=read, frames=frames)
    found, left = thermal_of(motion, time_s, temperature_c)
    assert not len(found) and said in found.reasons["scale_per_k"] and left is motion


def test_frames_of_a_campaign_measure_the_expansion(rng) -> None:
    params = ThermalExpansion(mount_per_k=1.5e-4, shift_x_px_per_k=0.02)
    time_s = np.arange(24) * 200.0
    temperature_c = temperatures(time_s)
    places = np.stack([v.ravel() for v in np.meshgrid(np.linspace(40, 280, 4), np.linspace(40, 200, 3))], axis=1)
    shape = (240, 320)
    moved = []
    for t in temperature_c:
        pull, seen = pull_of(params, t, shape), places.copy()
        for _ in range(8):
            seen = seen + places - np.stack(pull(*seen.T), axis=1)
        moved.append(rendered(seen, shape, rng))
    facts = GroupFacts(interval_s=200.0, temperatures_c=tuple(temperature_c.tolist()))
    campaign = campaign_of_arrays([Frames("series", 0.01, np.stack(moved), facts=facts)], bits=8)
    _, seen = observe_campaign(campaign, no_progress)
    found = measure_sources(seen)[0]["sensor.thermal_expansion"]
    assert abs(found["mount_per_k"].value - 1.5e-4) < 6 * found["mount_per_k"].u < 1.5e-4
    assert abs(found["shift_x_px_per_k"].value - 0.02) < 6 * found["shift_x_px_per_k"].u
    assert found["reference_c"].value == pytest.approx(temperature_c.mean())


def test_without_temperatures_the_source_says_what_is_missing() -> None:
    with pytest.raises(MeasureError, match="temperature of every frame"):
        SOURCE.measure(Observations())
