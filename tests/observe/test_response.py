"""Response curves from charts and from one scene at several exposures, against frames made without the package.

Each comparison allows five u: by chance once in two million comparisons (a normal error), so below 1e-6 for each number.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from observe.chart_pictures import TOP, bt709, expose, field_of, knee, power, srgb, wedge
from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.camera.observations import Observations
from pixmetry.core.errors import InputError
from pixmetry.core.progress import no_progress
from pixmetry.observe.patches import inner_region, search_patches

DENSITIES = np.array([0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.1, 1.25, 1.4, 1.55, 1.7, 1.85, 2.0])
WHITE_E = 9000.0
Curve = Callable[[np.ndarray], np.ndarray]


def observed(*groups: Frames, bits: int = 12) -> Observations:
    return observe_campaign(campaign_of_arrays(groups, bits=bits), no_progress)[1]


def chart(rng: np.random.Generator, curve: Curve, *, u_rel=0.02, uneven=(0.0, 0.0, 0.0), white=False, regions=False, **kw) -> list[Frames]:
    """A chart whose densities are off by ``u_rel`` of the light, in uneven light; dark frames; and a white sheet."""
    true = DENSITIES + rng.normal(0, u_rel / np.log(10), len(DENSITIES))
    light, places = wedge(true, WHITE_E)
    light = light * field_of(light.shape, *uneven)
    facts = GroupFacts(densities=tuple(DENSITIES), u_light_rel=u_rel, regions=tuple(places) if regions else None)
    frames = [Frames("chart", None, expose(rng, light, curve, **kw), facts=facts)]
    if white:
        sheet = np.full(light.shape, 0.8 * WHITE_E) * field_of(light.shape, *uneven)
        frames.append(Frames("chart", None, expose(rng, sheet, curve, **kw), facts=GroupFacts(white=True)))
    return [*frames, Frames("dark", 0.01, expose(rng, np.zeros(light.shape), curve, **kw))]


def scene(rng: np.random.Generator, curve: Curve, *, steps=8, u_rel=0.002, **kw) -> list[Frames]:
    """Blocks of many levels at exposures that double, each off by ``u_rel``."""
    level = 4000 * 10 ** rng.uniform(-0.8, 1.6, (8, 10))
    light = np.repeat(np.repeat(level, 16, 0), 16, 1)
    out = []
    for k in range(steps):
        e = light * 2.0 ** (k - steps + 1) * np.exp(rng.normal(0, u_rel))
        out.append(Frames("chart", 0.001 * 2.0**k, expose(rng, e, curve, **kw), facts=GroupFacts(u_light_rel=u_rel)))
    return out


def within(found, name: str, truth: float, times: float = 5.0) -> None:
    number = found[name]
    assert abs(number.value - truth) < times * number.u, f"{name}: {number.value} ± {number.u}, true {truth}"


@pytest.mark.parametrize("gamma", [0.45, 0.7])
def test_recovers_the_exponent_and_the_gain_of_a_power_curve_from_a_scene(gamma: float, rng: np.random.Generator):
    """u of the exponent is below 2e-3 where exposures are known to 2e-3."""
    seen = observed(*scene(rng, power(gamma)), Frames("dark", 0.01, expose(rng, np.zeros((128, 160)), power(gamma))))
    assert seen.response is not None and seen.response.curve == "power"
    fit = seen.response.fit
    within(fit, "gamma", gamma)
    within(fit, "gain_dn_per_e", 0.4)
    assert fit["gamma"].u < 2e-3 and fit["gain_dn_per_e"].u < 0.02
    assert "reference_dn" not in fit and "not separable" in fit.reasons["reference_dn"]
    estimates, _ = measure_sources(seen)
    assert estimates["electronics.gamma"]["gamma"].value == fit["gamma"].value
    assert estimates["electronics.gain"]["gain_dn_per_e"].value == fit["gain_dn_per_e"].value


def test_light_as_weak_as_its_noise_does_not_pull_the_exponent(rng: np.random.Generator):
    """Patches of 15 electrons with 9 of noise, whose mean behind a steep curve no second order tells. Mean z of four scenes, 1e-6."""
    z = []
    for _ in range(4):
        response = observed(*scene(rng, power(0.45), frames=24, black=300.0, u_rel=2e-4)).response
        assert response is not None and response.curve == "power" and response.fit["gamma"].u < 5e-4
        z.append((response.fit["gamma"].value - 0.45) / response.fit["gamma"].u)
    assert abs(np.mean(z)) < 4.9 / np.sqrt(4)


def test_published_curve_of_bt709_is_found_with_its_reference(rng: np.random.Generator):
    """ITU-R BT.709-6 prints 1.099 and 4.5 for 1.09914 and 4.507: its reference and exponent are met to 1 %."""
    response = observed(*scene(rng, bt709())).response
    assert response is not None and response.curve == "bt709"
    assert response.fit["gamma"].value == pytest.approx(0.45, abs=0.005)
    assert response.fit["reference_dn"].value == pytest.approx(TOP, rel=0.01)


def test_published_curve_of_srgb_is_inverted(rng: np.random.Generator):
    """IEC 61966-2-1: another toe is the same family; the light that levels stand for is met to 0.5 % over two decades."""
    response = observed(*scene(rng, srgb())).response
    assert response is not None and response.curve == "bt709"
    assert response.fit["gamma"].value == pytest.approx(1 / 2.4, abs=0.005)
    share = np.interp(response.level_dn, srgb()(np.linspace(0, TOP, 200001)) + 100, np.linspace(0, TOP, 200001))
    use = response.light_rel > 0.01
    assert response.light_rel[use] == pytest.approx((share / share[-1])[use], rel=0.005)


def test_knee_is_found_with_its_place_and_slope(rng: np.random.Generator):
    seen = observed(*scene(rng, knee(1500, 0.4)))
    assert seen.response is not None and seen.response.curve == "knee"
    within(seen.response.fit, "switch_dn", 1500)
    within(seen.response.fit, "mismatch_rel", -0.6)
    estimates, unmeasured = measure_sources(seen)
    assert set(estimates["electronics.hdr_gain"].names) == {"switch_dn", "mismatch_rel"}
    assert "knee" in unmeasured["electronics.gamma"]


def test_places_of_a_knee_between_two_patches_are_in_u(rng: np.random.Generator):
    """One patch of 1931 DN is above the knee: it may lie anywhere from the next patch, 1704 DN, up to that: 227 DN/√12 = 65 DN and more.

    The densities are right, and noise is a tenth of what they may be off by; so u hardly scatters.
    """
    light, _ = wedge(DENSITIES, WHITE_E)
    curve, facts = knee(1773, 0.25), GroupFacts(densities=tuple(DENSITIES), u_light_rel=0.02)
    frames = Frames("chart", None, expose(rng, light, curve, gain=0.3), facts=facts)
    dark = Frames("dark", 0.01, expose(rng, np.zeros(light.shape), curve, gain=0.3))
    response = observed(frames, dark).response
    assert response is not None and response.curve == "knee"
    within(response.fit, "switch_dn", 1773)
    within(response.fit, "mismatch_rel", -0.75)
    assert response.fit["switch_dn"].u > 50


def test_logarithm_is_found_with_slope_and_foot(rng: np.random.Generator):
    """300 DN per factor e is 300/(kT/q) DN/V at 20 °C: kT/q = 25.26 mV (CODATA 2018)."""
    seen = observed(*scene(rng, lambda x: 300 * np.log1p(np.maximum(x, 0) / 100), dark_noise_e=0, noise_dn=1.0))
    assert seen.response is not None and seen.response.curve == "log"
    within(seen.response.fit, "gain_dn_per_v", 300 / 0.0252617, times=6)
    within(seen.response.fit, "foot_e", 250, times=6)
    estimates, _ = measure_sources(seen)
    assert "sensor.log_response" in estimates and "electronics.gain" not in estimates


def test_a_straight_camera_stays_straight_with_its_cubic_bend(rng: np.random.Generator):
    bend = lambda x: x * (1 - 0.03 * (x / TOP) ** 2)  # noqa: E731
    response = observed(*scene(rng, bend)).response
    assert response is not None and response.curve == "cubic"
    a = response.fit.select([f"nonlinearity_a{k}" for k in (1, 2, 3)])
    top = np.ones(3)  # the bend at the largest code; its parts are not separable by this
    assert abs(top @ a.values + 0.03) < 5 * np.sqrt(top @ a.covariance @ top)
    response = observed(*chart(rng, lambda x: x)).response
    assert response is not None and response.curve == "linear"
    assert response.fit["gamma"].value == 1.0 and response.fit["gamma"].u < 0.2


def test_uneven_light_of_a_chart_is_in_u_or_taken_out_by_a_white_sheet(rng: np.random.Generator):
    """With the sheet u of the exponent falls, and light that is 15 % uneven does not show."""
    uneven = tuple(rng.normal(0, 0.05, 3))
    plain = observed(*chart(rng, power(0.6), uneven=uneven, regions=True)).response
    white = observed(*chart(rng, power(0.6), uneven=(0.15, -0.1, -0.05), white=True, regions=True)).response
    assert plain is not None and white is not None
    for found in (plain, white):
        assert len(found.patches) == len(DENSITIES)
        within(found.fit, "gamma", 0.6)
    assert white.fit["gamma"].u < plain.fit["gamma"].u


def test_patches_are_found_where_they_are(rng: np.random.Generator):
    light, places = wedge(DENSITIES, WHITE_E)
    boxes, why = search_patches(expose(rng, light, lambda x: x, 1)[0], len(DENSITIES))
    assert not why
    for x, y, w, h in places:
        inside = [b for b in boxes if x <= b[0] and y <= b[1] and b[0] + b[2] <= x + w and b[1] + b[3] <= y + h]
        assert len(inside) == 1
        ix, iy, iw, ih = inner_region(inside[0])
        assert x + 4 <= ix and ix + iw <= x + w - 4 and y + 4 <= iy and iy + ih <= y + h - 4


@pytest.mark.parametrize(
    "facts, what",
    [
        ({"densities": (0.1, 0.3, 0.5, 0.7, 0.9, 1.1, 1.3)}, "even patches of about one size: 14 were found, and 7 are listed"),
        ({"densities": (0.1, 0.5), "regions": ((12, 12, 48, 48), (72, 12, 48, 48))}, "2 levels that differ, and 6 or more"),
    ],
)
def test_bad_charts_are_refused_with_the_reason(facts: dict, what: str, rng: np.random.Generator):
    light, _ = wedge(DENSITIES, WHITE_E)
    seen = observed(Frames("chart", None, expose(rng, light, power(0.5)), facts=GroupFacts(**facts)))
    assert seen.response is not None and not seen.response.curve
    _, unmeasured = measure_sources(seen)
    assert what in unmeasured["electronics.gamma"]


def test_clipped_patches_and_unlike_densities_are_told(rng: np.random.Generator):
    over = observed(*chart(rng, lambda x: 1.6 * x, regions=True)).response
    assert over is not None and any("clipped" in why for why in over.refused)
    light, places = wedge(DENSITIES, WHITE_E)
    wrong = tuple(rng.permutation(DENSITIES))
    facts = GroupFacts(densities=wrong, regions=tuple(places), u_light_rel=0.01)
    mixed = observed(Frames("chart", None, expose(rng, light, power(0.5)), facts=facts)).response
    assert mixed is not None and not mixed.curve and "no known curve" in mixed.fit.reasons["gamma"]


def test_one_exposure_of_a_scene_tells_nothing(rng: np.random.Generator):
    seen = observed(Frames("chart", 0.01, expose(rng, np.full((64, 64), 3000.0), power(0.5))))
    _, unmeasured = measure_sources(seen)
    assert "two exposures or more" in unmeasured["electronics.gamma"]


@pytest.mark.parametrize(
    "facts, exposure_s",
    [
        ({}, None),
        ({"densities": (0.1, 0.2), "luminances": (1.0, 2.0)}, None),
        ({"white": True, "densities": (0.1,)}, None),
        ({"regions": ((0, 0, 8, 8),), "densities": (0.1, 0.2)}, None),
    ],
)
def test_contradicting_facts_of_a_chart_are_refused(facts: dict, exposure_s: float | None):
    with pytest.raises(InputError):
        campaign_of_arrays([Frames("chart", exposure_s, np.zeros((2, 16, 16), np.uint16), facts=GroupFacts(**facts))], bits=12)


def test_the_whole_assessment_takes_the_curve_into_twin_budget_page_and_record(rng: np.random.Generator, tmp_path):
    """A camera with gamma: the twin has its curve and its gain, where the photon transfer alone refuses."""
    curve, shape = power(0.5), (128, 160)
    groups = scene(rng, curve)
    for k in range(1, 9):
        groups.append(Frames("bright", 0.001 * k, expose(rng, np.full(shape, 1000.0 * k), curve)))
        groups.append(Frames("dark", 0.001 * k, expose(rng, np.zeros(shape), curve)))
    found = assess(campaign_of_arrays(groups, bits=12, name="with gamma", sensor="cmos"), tmp_path / "result", trials=0)
    within(found.estimates["electronics.gain"], "gain_dn_per_e", 0.4)
    within(found.estimates["electronics.amplifier_noise"], "white_e", 8.0)
    gamma = found.camera["electronics.gamma"].params
    assert gamma.gamma == pytest.approx(0.5, abs=0.01) and gamma.toe == "none"
    assert any(row.source_id == "electronics.gamma" and row.status == "measured" for row in found.budget.rows)
    assert "follow a power curve" in (tmp_path / "result" / "report.html").read_text()
    record = found.to_record()["response"]
    assert record["curve"] == "power" and len(record["oecf"]["level_dn"]) == len(record["oecf"]["u_light_rel"]) > 50
