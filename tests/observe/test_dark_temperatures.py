"""Dark frames at several temperatures: the doubling of the dark current, against frames simulated here without the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import InputError
from pixmetry.core.progress import no_progress

GAIN, READ_E, ALPHA, SHAPE = 0.4, 6.0, 1e-6, (60, 80)
OWN_C, RATE = 20.0, 40.0


def dark(
    rng: np.random.Generator, temperature_c: float, exposure_s: float, *, doubling_k: float = 7.0, frame_noise_dn: float = 0.05, **more
):
    """Four dark frames, with a black level of the temperature's own and an unevenness of 30 %."""
    pixels = np.exp(0.3 * np.random.default_rng(1).standard_normal(SHAPE))
    mean = more.get("rate", RATE * 2 ** ((temperature_c - OWN_C) / doubling_k)) * exposure_s * pixels / pixels.mean()
    noise = frame_noise_dn * rng.standard_normal((4, 1, 1))
    dn = 100 + 0.1 * temperature_c + GAIN * (rng.poisson(mean, (4, *SHAPE)) + rng.normal(0, READ_E, (4, *SHAPE))) + noise
    return np.rint(np.clip(dn, 0, 4095)).astype(np.uint16)


def groups(rng: np.random.Generator, temperatures: tuple[float, ...], times: tuple[float, ...] = (0.1, 2.0), **more) -> list[Frames]:
    return [Frames("dark", s, dark(rng, t, s, **more), facts=GroupFacts(temperature_c=t)) for t in temperatures for s in times]


def series(rng: np.random.Generator) -> list[Frames]:
    """A photon transfer at the campaign's own temperature, of which the dark exposures tell the dark current too."""

    def bright(exposure_s: float) -> Frames:
        dn = 102 + GAIN * (rng.poisson(RATE * exposure_s + 4000 * exposure_s, (2, *SHAPE)) + rng.normal(0, READ_E, (2, *SHAPE)))
        return Frames("bright", exposure_s, np.rint(np.clip(dn, 0, 4095)).astype(np.uint16))

    times = [0.2 * k for k in range(1, 11)]
    return [*(Frames("dark", t, dark(rng, OWN_C, t)[:2]) for t in times), *(bright(t) for t in times)]


def seen_of(frames: list[Frames], **camera) -> Observations:
    return observe_campaign(campaign_of_arrays(frames, bits=12, **camera), no_progress)[1]


def test_the_doubling_temperature_is_found_within_its_u(rng: np.random.Generator):
    """30 cameras: χ² of z and its mean, 1e-6 each; finds u that is 1.7 times too small."""
    z = []
    for _ in range(30):
        doubling = float(rng.uniform(5.5, 9))
        fit = seen_of(groups(rng, (15.0, 22.0, 30.0, 38.0, 45.0), doubling_k=doubling)).dark_temperatures.fit
        found = fit["doubling_temperature_k"]
        z.append(stats.norm.ppf(stats.t.cdf((found.value - doubling) / found.u, found.dof)))
    assert stats.chi2.ppf(ALPHA / 2, 30) < np.sum(np.square(z)) < stats.chi2.isf(ALPHA / 2, 30)
    assert abs(np.mean(z)) < stats.norm.isf(ALPHA / 2) / np.sqrt(30)


def test_the_frames_of_the_campaign_count_and_do_not_change(rng: np.random.Generator):
    own = series(rng)
    alone = seen_of(own, temperature_c=OWN_C)
    both = seen_of([*groups(rng, (30.0, 36.0, 42.0)), *own], temperature_c=OWN_C)
    np.testing.assert_array_equal(alone.photon_transfer_fit.values, both.photon_transfer_fit.values)
    assert both.dark_temperatures.temperature_c.tolist() == [20.0, 30.0, 36.0, 42.0]
    found = measure_sources(both)[0]["sensor.dark_current"]
    assert found["doubling_c"].value == pytest.approx(7.0, rel=0.05)
    assert measure_sources(alone)[0]["sensor.dark_current"].names == ("rate_e_per_s",)


def test_the_law_of_the_band_gap_is_named_over_a_wide_range(rng: np.random.Generator):
    """E = 1.12 eV from −5 to 55 °C: the doubling temperature rises from 7.6 to 10.8 K, which the currents show at many u."""
    kelvin = 273.15 + np.array([-5.0, 10.0, 25.0, 40.0, 55.0])
    rates = 20 * (kelvin / 268.15) ** 1.5 * np.exp(1.12 / (2 * 8.617333e-5) * (1 / 268.15 - 1 / kelvin))
    frames = [f for t, rate in zip(kelvin - 273.15, rates, strict=True) for f in groups(rng, (float(t),), rate=float(rate))]
    fit = seen_of(frames).dark_temperatures.fit
    assert "band gap" in fit.reasons["doubling_temperature_k"]
    energy = float(fit.reasons["doubling_temperature_k"].split("with ")[1].split(" eV")[0])
    assert energy == pytest.approx(1.12, abs=0.03)


def test_bad_set_ups_have_their_reason(rng: np.random.Generator):
    def why(frames: list[Frames]) -> str:
        return seen_of(frames).dark_temperatures.fit.reasons["doubling_temperature_k"]

    assert "too few temperatures" in why(groups(rng, (20.0, 40.0)))
    assert "too close" in why(groups(rng, (20.0, 23.0, 26.0)))
    assert "does not grow" in why(groups(rng, (20.0, 30.0, 40.0), rate=40.0))
    single = seen_of(groups(rng, (20.0, 30.0, 40.0), times=(1.0,)))
    assert sum("one exposure time" in note for note in single.notes) == 3
    alone = groups(rng, (20.0, 30.0, 40.0))
    lonely = seen_of([Frames("dark", f.exposure_s, f.data[:1], facts=f.facts) for f in alone])
    assert sum("only 1 dark frame" in note for note in lonely.notes) == 6
    with pytest.raises(InputError, match="temperature_c"):
        campaign_of_arrays([Frames("dark_temperature", 0.1, dark(rng, 20, 0.1))], bits=12)


def test_the_page_shows_it(rng: np.random.Generator, tmp_path: Path):
    campaign = campaign_of_arrays([*groups(rng, (30.0, 36.0, 42.0)), *series(rng)], bits=12, name="warm", temperature_c=OWN_C)
    found = assess(campaign, tmp_path / "result", trials=0)
    assert "Dark current and temperature" in (tmp_path / "result" / "report.html").read_text()
    assert found.to_record()["dark_temperatures"]["temperature_c"] == [20.0, 30.0, 36.0, 42.0]
    assert found.camera["sensor.dark_current"].params.doubling_c == pytest.approx(7.0, rel=0.1)


def test_a_single_frame_is_left_out_and_costs_nothing_else(rng: np.random.Generator):
    def taken(temperature_c: float, exposure_s: float, count: int) -> Frames:
        return Frames("dark", exposure_s, dark(rng, temperature_c, exposure_s)[:count], facts=GroupFacts(temperature_c=temperature_c))

    groups = [taken(t, e, 4) for t in (10.0, 30.0, 45.0) for e in (0.01, 2.0)]
    _, seen = observe_campaign(campaign_of_arrays([*groups, taken(60.0, 0.01, 1)], bits=12), no_progress)
    assert any("only 1 dark frame at 60 °C, exposure 0.01 s" in note for note in seen.notes)
    assert seen.dark_temperatures is not None and "doubling_temperature_k" in seen.dark_temperatures.fit
