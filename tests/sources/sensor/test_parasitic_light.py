"""Light that the stores of a global shutter gather while they wait."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from catalogue.support import Flat
from pixmetry import Frames, campaign_of_arrays
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.core.progress import no_progress
from pixmetry.sources.sensor.parasitic_light import SOURCE, ParasiticLight, correct
from sources.sensor.moving_scenes import STEADY, Spot, chain, row_centres


def test_even_light_rises_along_the_rows_by_28_percent() -> None:
    """1/700, 20 ms of read-out, 0.1 ms of exposure: 28.6 % from the first to the last row."""
    rows = 200
    params = ParasiticLight(sensitivity_rel=1 / 700, wait_s=0.0, row_time_s=0.02 / rows)
    image = chain((SOURCE, params), shape=(rows, 8), exposure_s=1e-4).expose(Flat(50.0)).data[0].astype(float)
    expected = STEADY * (1 + 0.02 / 1e-4 / 700 * np.arange(rows) / rows)
    assert image == pytest.approx(np.broadcast_to(expected[:, None], image.shape), rel=1e-6)
    assert image[-1, 0] / image[0, 0] - 1 == pytest.approx(0.28, abs=0.01)


def test_a_moving_target_leaves_a_ghost_at_the_mean_of_its_places_while_it_waits() -> None:
    p, wait, exposure, v = 0.01, 5e-3, 1e-3, 200.0
    params = ParasiticLight(sensitivity_rel=p, wait_s=wait, row_time_s=0.0, first_row="bottom")
    centres = row_centres(chain((SOURCE, params), exposure_s=exposure).expose(Spot(20.0, None, v)).data[0])
    share = p * wait / exposure
    expected = 20.0 + v * (0.5 * exposure + share * (exposure + 0.5 * wait)) / (1 + share)
    assert centres == pytest.approx(np.full(32, expected), abs=1e-4)


def test_inverse_even_light_is_even_again() -> None:
    params = ParasiticLight(sensitivity_rel=1 / 700, row_time_s=1e-4, first_row="bottom")
    out = chain((SOURCE, params), exposure_s=1e-3).expose(Flat(50.0), 2)
    assert np.ptp(out.data) > 0.004 * STEADY
    assert correct(params, out, {}).data == pytest.approx(np.full(out.data.shape, STEADY), rel=1e-6)


def flats(rng: np.random.Generator, sensitivity: float, *, first_row: str = "top", bend: float = 0.0, flux: float = 1.5e7) -> list[Frames]:
    """Pairs of dark and bright frames of a camera with uneven light, dark current and a bend, made without the package."""
    shape, line_s, gain = (240, 160), 1e-5, 0.3
    order = np.arange(shape[0]) if first_row == "top" else np.arange(shape[0])[::-1]
    x, y = np.linspace(-1, 1, shape[1]), np.linspace(-1, 1, shape[0])[:, None]
    light = flux * (1 + 0.04 * x + 0.05 * y - 0.06 * (x**2 + y**2)) * (1 + 0.004 * rng.standard_normal(shape))
    groups = []
    for t in np.geomspace(4e-5, 6e-4, 12):
        for kind, flux in (("dark", 0.0), ("bright", light * (1 + 0.003 * rng.standard_normal()))):
            mean = flux * (t + sensitivity * (4e-5 + line_s * order))[:, None] + 200 * t + np.zeros(shape)
            noise = 6 * rng.standard_normal((2, *shape)) + 2 * rng.standard_normal((2, shape[0], 1))
            linear = gain * (rng.poisson(mean, (2, *shape)) + noise)
            stored = linear * (1 - bend * linear / 4000) + 80
            groups.append(Frames(kind, float(t), np.clip(np.rint(stored), 0, 4095).astype(np.uint16)))
    return groups


def told_by(groups: list[Frames], **facts: object) -> tuple[dict, dict]:
    campaign = campaign_of_arrays(groups, bits=12, **{"sensor": "cmos", "line_time_us": 10.0, **facts})
    return measure_sources(observe_campaign(campaign, no_progress)[1])


def test_its_sensitivity_is_found_within_u_behind_uneven_light_and_a_bend(rng: np.random.Generator) -> None:
    """12 cameras: χ² of normal values of Student's t, and their mean, 1e-6 each."""
    z = []
    for k in range(12):
        true, first_row = float(10 ** rng.uniform(-3.5, -2.3)), ("top", "bottom")[k % 2]
        told, why = told_by(flats(rng, true, first_row=first_row, bend=float(rng.uniform(0, 0.02))))
        found = told["sensor.parasitic_light"]
        assert found.settings["first_row"] == first_row and found["row_time_s"].value == pytest.approx(1e-5), why
        number = found["sensitivity_rel"]
        assert number.u < 0.2 * true
        z.append(stats.norm.ppf(stats.t.cdf((number.value - true) / number.u, number.dof)))
    assert stats.chi2.ppf(5e-7, 12) < np.sum(np.square(z)) < stats.chi2.isf(5e-7, 12)
    assert abs(np.mean(z)) < stats.norm.isf(5e-7) / np.sqrt(12)


def test_none_is_a_limit_and_what_is_missing_is_said(rng: np.random.Generator) -> None:
    """By chance one camera without it in 500 shows some; three of three never do."""
    limits = [told_by(flats(rng, 0.0))[0]["sensor.parasitic_light"] for _ in range(3)]
    assert any(found.limits == {"sensitivity_rel"} and found["sensitivity_rel"].value < 3e-4 for found in limits)
    groups = flats(rng, 2e-3)
    assert "line_time_us" in told_by(groups, line_time_us=None)[1]["sensor.parasitic_light"]
    assert "smear" in told_by(groups, sensor="ccd")[1]["sensor.parasitic_light"]
    assert "five exposure times" in told_by(groups[:6])[1]["sensor.parasitic_light"]
    assert "begin together" in told_by(flats(rng, 1.0, flux=4e6))[1]["sensor.parasitic_light"]
