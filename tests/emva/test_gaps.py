"""Campaigns without some of their parts, and with hardly any signal: what can be had is given, and everything else has a reason."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from pixmetry import Frames, campaign_of_arrays, emva1288
from pixmetry.emva.records import RELEASES, DataSheet
from pixmetry.files import Campaign

TIMES = tuple(0.004 * k for k in range(1, 13))


def frames(
    rng: np.random.Generator, kind: str, exposure_s: float, n: int = 2, light: float = 1.0, shape: tuple[int, int] = (24, 32)
) -> Frames:
    """A linear camera of 0.25 DN/e⁻ and 6 e⁻ that sees 0.5 electrons a photon."""
    photons = light * 8e5 * exposure_s if kind == "bright" else 0.0
    electrons = rng.poisson(0.5 * photons + 2000 * exposure_s, (n, *shape)) + rng.normal(0, 6, (n, *shape))
    codes = np.clip(np.rint(50 + 0.25 * electrons), 0, 4095).astype(np.uint16)
    return Frames(kind, exposure_s, codes, photons if kind == "bright" else None)


def campaign(*groups: Frames, **camera: object) -> Campaign:
    return campaign_of_arrays(groups, bits=12, name="gaps", **camera)


def assert_everything_is_said(sheet: DataSheet) -> None:
    for results in sheet.results:
        for key, value in results.values.items():
            if math.isnan(value.value):
                assert value.reason, (results.channel, key)
            else:
                assert value.u >= 0, (results.channel, key, value)


def test_a_bootstrap_works_with_one_dark_level(rng: np.random.Generator) -> None:
    """The light is swept at one exposure: the dark series is two frames. u of K is that of the sampling laws within a factor 3."""
    lights = [frames(rng, "bright", 0.02, light=k / 8) for k in range(1, 17)]
    taken = campaign(frames(rng, "dark", 0.02), *lights)
    drawn, plain = (emva1288(taken, bootstrap=n).results[0].values["K"] for n in (300, 0))
    assert "bootstrap" in drawn.method and drawn.value == plain.value
    assert 1 / 3 < drawn.u / plain.u < 3


def test_a_bootstrap_of_a_campaign_with_gaps_leaves_what_there_is(rng: np.random.Generator) -> None:
    """Dark frames alone have no series to draw from: the values are those without a bootstrap, and a note says so."""
    taken = campaign(*(frames(rng, "dark", t) for t in TIMES))
    drawn, plain = (emva1288(taken, bootstrap=n).results[0] for n in (100, 0))
    assert math.isfinite(drawn.values["sigma_y_dark"].value) and drawn.values["sigma_y_dark"] == plain.values["sigma_y_dark"]
    assert any("no u by a bootstrap" in note for note in drawn.notes)


@pytest.mark.parametrize("shape", [(4, 160), (160, 4), (2, 2)])
def test_frames_too_small_for_a_surface_are_tested_without_it(shape: tuple[int, int], rng: np.random.Generator) -> None:
    series = [frames(rng, kind, t, shape=shape) for kind in ("dark", "bright") for t in TIMES]
    sheet = emva1288(campaign(*series, frames(rng, "dark", 0.022, 12, shape=shape), frames(rng, "bright", 0.022, 12, shape=shape)))
    assert_everything_is_said(sheet)
    # of four pixels even the fit before that may fail
    assert min(shape) == 2 or any("too small for a surface" in note for note in sheet.results[0].notes)


@pytest.mark.parametrize("release", RELEASES)
def test_frames_without_light_have_no_gain(release: str, rng: np.random.Generator) -> None:
    """The lens cap was on: K is chance, and where it is below zero nothing in electrons follows. Nothing is printed past the errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(4):
            dark = [frames(rng, "dark", t) for t in TIMES]
            capped = [Frames("bright", t, frames(rng, "dark", t).data, 8e5 * t) for t in TIMES]
            sheet = emva1288(campaign(*dark, *capped), release=release)
            assert_everything_is_said(sheet)
            gain = sheet.results[0].values["K"]
            assert math.isnan(gain.value) or gain.value > 0


def test_three_levels_give_values_with_u_or_reasons(rng: np.random.Generator) -> None:
    """Of small phases of a mosaic noise decides where three levels saturate: a value that some draws lack has no u."""
    for _ in range(4):
        series = [frames(rng, kind, t) for kind in ("dark", "bright") for t in TIMES[:3]]
        assert_everything_is_said(emva1288(campaign(*series, cfa="RGGB")))
