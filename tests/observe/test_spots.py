"""Bright spots on black, against frames simulated here without the package: charge spills step by step until no pixel is over-full."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from pixmetry import Frames, assess, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.observations import Observations
from pixmetry.core.progress import no_progress

GAIN, READ_E, BLACK, WELL_E = 0.2, 8.0, 100.0, 15_000.0
ALPHA = 1e-6
PLACES = ((60.3, 100.2), (110.7, 94.6))


def spilled(electrons: np.ndarray, well_e: float, up: float, drained: float = 0.0, ratio: float = 1.0) -> np.ndarray:
    """What every pixel of a column holds over its capacity goes to its neighbours, again and again."""
    out = electrons.astype(float)
    capacity = well_e * ratio
    hot = np.flatnonzero((out > capacity).any(axis=0))
    part = out[:, hot]
    while True:
        excess = np.maximum(part - capacity, 0)
        if excess.max(initial=0) < 1e-4 * capacity:
            break
        part -= excess
        excess *= 1 - drained
        part[:-1] += up * excess[1:]
        part[1:] += (1 - up) * excess[:-1]
    out[:, hot] = part
    return np.minimum(out, well_e)


def pictures(
    rng: np.random.Generator,
    times: tuple[float, ...],
    *,
    shape: tuple[int, int] = (200, 160),
    places: tuple[tuple[float, float], ...] = PLACES,
    frames: int = 3,
    smear_s: float = 0.0,
    passed: str = "all",
    bloom: dict[str, float] | None = None,
    well_e: float = WELL_E,
    rows_talk: float = 0.0,
    cols_talk: float = 0.0,
    halo: float = 0.0,
    pattern_dn: float = 0.0,
) -> list[Frames]:
    """Groups of spots that reach half of 15 000 electrons in one unit of time."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    distance2 = [(x - cx) ** 2 + (y - cy) ** 2 for cx, cy in places]
    light = 0.5 * WELL_E * sum(np.exp(-d / 8) + halo / (1 + d / 400) for d in distance2)
    gathered = light * smear_s / shape[0]
    below = gathered.sum(axis=0) - np.cumsum(gathered, axis=0)
    smear = {"all": gathered.sum(axis=0), "below": below, "above": np.cumsum(gathered, axis=0) - gathered}[passed]
    columns = pattern_dn * rng.standard_normal(shape[1])
    groups = []
    for time in times:
        stack = []
        for _ in range(frames):
            charge = rng.poisson(light * time + smear + 20).astype(float)
            charge = np.minimum(charge, well_e) if bloom is None else spilled(charge, well_e, **bloom)
            charge = charge + rows_talk * charge.mean(axis=1, keepdims=True)
            charge = charge + cols_talk * charge.mean(axis=0)
            stack.append(BLACK + columns + GAIN * (charge + rng.normal(0, READ_E, shape)))
        groups.append(Frames("spots", time, np.rint(np.clip(stack, 0, 4095)).astype(np.uint16)))
    return groups


def flat_frames(rng: np.random.Generator, shape: tuple[int, int] = (200, 160)) -> list[Frames]:
    """A photon transfer that tells the gain."""

    def taken(kind: str, exposure_s: float, electrons: float) -> Frames:
        dn = BLACK + GAIN * (rng.poisson(electrons, (2, *shape)) + rng.normal(0, READ_E, (2, *shape)))
        return Frames(kind, exposure_s, np.rint(np.clip(dn, 0, 4095)).astype(np.uint16))

    levels = [0.001 * k for k in range(1, 9)]
    return [*(taken("dark", t, 0) for t in levels), *(taken("bright", t, 1.5e6 * t) for t in levels)]


def seen_of(groups: list[Frames], **camera) -> Observations:
    return observe_campaign(campaign_of_arrays(groups, bits=12, **camera), no_progress)[1]


def z_of(number, truth: float) -> float:
    """A deviation over its u, as a normal number."""
    return float(stats.norm.ppf(stats.t.cdf((number.value - truth) / number.u, number.dof)))


def test_smear_and_its_rows_are_found_within_u(rng: np.random.Generator):
    """18 cameras, three ways of clearing, with and without a column pattern: χ² and mean of z, 1e-6 each; finds u 2 times too small."""
    z = []
    for k in range(18):
        passed = ("all", "below", "above")[k % 3]
        smear = float(rng.uniform(0.02, 0.1))
        spots = seen_of(pictures(rng, (0.5, 1.0, 1.6), smear_s=smear, passed=passed, pattern_dn=0.3 * (k % 2))).spots
        assert spots is not None and spots.smear_rows == ("all" if passed == "all" else "passed")
        assert passed == "all" or spots.smear_store == passed
        z.append(z_of(spots.fit["smear_s"], smear))
    assert stats.chi2.ppf(ALPHA / 2, 18) < np.sum(np.square(z)) < stats.chi2.isf(ALPHA / 2, 18)
    assert abs(np.mean(z)) < stats.norm.isf(ALPHA / 2) / np.sqrt(18)


def test_cross_talk_is_told_from_smear_by_the_exposures(rng: np.random.Generator):
    z = []
    for _ in range(8):
        rows, cols, smear = rng.uniform(0.005, 0.015, 3)
        seen = seen_of(pictures(rng, (0.3, 0.8, 1.6), smear_s=10 * smear, rows_talk=rows, cols_talk=cols), sensor="cid")
        found = measure_sources(seen)[0]["sensor.cid_readout"]
        told = (("row_crosstalk", rows), ("col_crosstalk", cols))
        z += [z_of(found[name], true) for name, true in told if name in found] + [z_of(seen.spots.fit["smear_s"], 10 * smear)]
    assert len(z) >= 18  # that of the columns lies on the smear, and one in fifteen does not stand out of it
    assert np.sum(np.square(z)) < stats.chi2.isf(ALPHA, len(z))


def test_one_exposure_says_that_it_tells_a_sum(rng: np.random.Generator):
    seen = seen_of(pictures(rng, (1.0,), smear_s=0.1))
    found = measure_sources(seen)[0]["sensor.smear"]
    assert found["transfer_s"].value == pytest.approx(0.1, abs=0.01)
    assert any("cross-talk" in c for c in found.confounders)
    assert "one exposure" in seen.spots.fit.reasons["col_crosstalk"]


def test_nothing_is_found_where_nothing_is(rng: np.random.Generator):
    """Six cameras, three values each, found by chance one in 2000: two of 18 by 4e-5, three by 1e-7."""
    found = 0
    for k in range(6):
        fit = seen_of(pictures(rng, (0.5, 1.0, 1.6), pattern_dn=0.3 * (k % 2))).spots.fit
        found += sum(not fit[name].is_limit for name in ("smear_s", "row_crosstalk", "col_crosstalk"))
    assert found < 3


def test_stray_light_is_no_cross_talk(rng: np.random.Generator):
    """A halo of 0.2 % that falls to a half over 20 px."""
    fit = seen_of(pictures(rng, (0.5, 1.0, 1.6), halo=0.002, places=((60.3, 100.2),)), sensor="cid").spots.fit
    assert all(name not in fit or fit[name].is_limit or fit[name].value < 0.2 for name in ("row_crosstalk", "col_crosstalk"))
    assert any("stray light" in fit.reasons.get(name, "") for name in ("row_crosstalk", "col_crosstalk"))


@pytest.mark.parametrize(
    "bloom",
    [{"up": 0.44}, {"up": 0.5}, {"up": 0.56, "ratio": 1.7}, {"up": 0.45, "drained": 0.05}],
    ids=["up", "even", "overflow", "lateral"],
)
def test_blooming_is_found_within_u(bloom: dict[str, float], rng: np.random.Generator):
    """Share up and drains of one camera within 7 u (t of 15 or more degrees of freedom: 4e-6 of all), and no drain where there is none."""
    seen = seen_of(pictures(rng, (0.5, 1.0, 2.0, 4.0, 8.0), bloom=bloom, smear_s=0.05))
    found = measure_sources(seen)[0]["sensor.blooming"]
    names = {"up": "up_share", "drained": "drained_share", "ratio": "drain_ratio"}
    for key, truth in bloom.items():
        if key != "up" and names[key] not in found:  # a drain that does not stand out has no value
            continue
        assert abs(found[names[key]].value - truth) < 7 * found[names[key]].u
    assert found["up_share"].u < 3e-3
    # the response is not measured here: 0.5 % of bend are as much of the light at which a drain begins
    assert "drain_ratio" not in found or found["drain_ratio"].u > 0.004 * found["drain_ratio"].value
    assert all(n in [names[key] for key in bloom] or n == "full_well_e" for n in found.names)


def test_full_well_from_the_streaks_where_the_converter_ends_first(rng: np.random.Generator):
    """A well of 25 000 electrons behind 12 bits that end at 20 000: 3 % without a drain."""
    seen = seen_of([*pictures(rng, (0.5, 1.0, 2.0, 4.0, 8.0), bloom={"up": 0.45}, well_e=25_000.0), *flat_frames(rng)])
    estimates, _ = measure_sources(seen)
    assert seen.spots.clipped
    assert estimates["sensor.blooming"]["full_well_e"].value == pytest.approx(25_000, rel=0.03)
    assert estimates["sensor.full_well"]["full_well_e"].kind == "lower_limit"


def test_a_sensor_without_streaks_has_a_drain_beyond_the_exposure(rng: np.random.Generator):
    found = measure_sources(seen_of(pictures(rng, (0.5, 1.0, 8.0, 20.0))))[0]["sensor.blooming"]
    assert found["drain_ratio"].is_lower_limit and found["drain_ratio"].value == pytest.approx(10, rel=0.05)


def test_bad_set_ups_have_their_reason(rng: np.random.Generator):
    def why(groups: list[Frames], source: str = "sensor.smear") -> str:
        return measure_sources(seen_of(groups))[1][source]

    assert "saturated in the shortest" in why(pictures(rng, (4.0, 8.0)))
    assert "frame's end" in why(pictures(rng, (1.0,), places=((60, 3.0),)))
    assert "no spot" in why(pictures(rng, (0.001,)))
    assert "no spot is saturated" in why(pictures(rng, (0.5, 1.0)), "sensor.blooming")
    assert "streak" in why(pictures(rng, (1.0, 40.0), shape=(100, 160), places=((60, 50.0),), bloom={"up": 0.5}), "sensor.blooming")
    assert "same exposure" in why(pictures(rng, (1.0, 1.0)))


def test_exposures_that_all_saturate_have_their_reason(rng: np.random.Generator):
    groups = pictures(rng, (1.75, 4.0, 8.0), bloom={"up": 0.5})  # 0.87 of the well in the shortest
    _, seen = observe_campaign(campaign_of_arrays(groups, bits=12), no_progress)
    assert seen.spots is not None and "saturated in the shortest exposure" in seen.spots.fit.reasons["smear_s"]


def test_the_page_the_twin_and_the_results_hold_it(rng: np.random.Generator, tmp_path: Path):
    groups = [*pictures(rng, (0.5, 1.0, 2.0, 4.0), smear_s=0.1, passed="above", bloom={"up": 0.45}), *flat_frames(rng)]
    found = assess(campaign_of_arrays(groups, bits=12, name="spotted", sensor="ccd"), tmp_path / "result", trials=0)
    assert "Bright spots" in (tmp_path / "result" / "report.html").read_text()
    smear = found.camera["sensor.smear"].params
    assert (smear.rows, smear.store) == ("passed", "above") and smear.transfer_s == pytest.approx(0.1, rel=0.1)
    record = found.to_record()["spots"]
    assert len(record["spots"]) == 2 and record["smear_store"] == "above"
    assert found.camera["sensor.blooming"].params.full_well_e == pytest.approx(WELL_E, rel=0.02)
