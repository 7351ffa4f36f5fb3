"""Release ``reference`` on the public EMVA 1288 data set 001 against every number that the public implementation 1.0.2 stored for it.

Runs where the environment variable PIXMETRY_DATA names the folder that holds the set.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from pixmetry.emva.evaluate import bootstrap_u, evaluate
from pixmetry.emva.records import Measurement, Results
from pixmetry.emva.reduction import measure_frames
from pixmetry.emva.series import series_of
from pixmetry.emva.spatial.frame_products import frame_products
from pixmetry.files import load_campaign
from pixmetry.files.images import FrameReader
from pixmetry.observe.one_pass import Group

FOLDER = Path(os.environ.get("PIXMETRY_DATA", "")) / "emva1288-set-001"
STORED = FOLDER / "reference-implementation-1.0.2-results-full.tsv"
pytestmark = pytest.mark.skipif(
    not (os.environ.get("PIXMETRY_DATA") and STORED.is_file()), reason="PIXMETRY_DATA does not name a folder with emva1288-set-001"
)
RELATIVE = 1e-9


@cache
def stored() -> dict[str, np.ndarray]:
    """The stored numbers by key; NaN for nan and None."""
    rows = (line.split("\t") for line in STORED.read_text().splitlines() if line and not line.startswith("#"))
    return {row[0]: np.array([np.nan if v == "None" else float(v) for v in row[1].split()]) for row in rows}


@cache
def measured() -> Measurement:
    campaign = load_campaign(FOLDER / "EMVA1288_Data.txt")
    reader = FrameReader(campaign)
    groups = [Group(g.kind, g.role, g.exposure_s, g.photons, [partial(reader.fetch, p) for p in g.paths]) for g in campaign.groups]
    (m,) = measure_frames(groups, campaign.bits)
    stacks = {g.kind: frame_products([reader.fetch(p) for p in g.paths], campaign.bits) for g in campaign.groups if g.role == "stack"}
    return replace(m, dark_products=stacks["dark"], bright_products=stacks["bright"])


@cache
def results(release: str) -> Results:
    return evaluate(measured(), release)


def largest_summands() -> dict[str, float]:
    """Of the values whose formula is a difference of larger terms."""
    m, series = measured(), series_of(measured())
    t, gain = series.dark_exposure_s, float(stored()["K"][0])
    # slope = (n Σ t y − Σ t Σ y)/(n Σ t² − (Σ t)²)
    over = t.size * (t @ t) - t.sum() ** 2
    mean_slope = t.size * (t @ series.own_dark_mean_dn) / over
    var_slope = t.size * (t @ series.own_dark_var_dn2) / over
    out = {"u_I_mean": mean_slope / gain, "u_I_mean_DN": mean_slope, "u_I_var": var_slope / gain**2, "u_I_var_DN": var_slope / gain}
    # all spatial variances are differences from the variance of the mean image
    for tag, stack in (("", m.bright_stack), ("_dark", m.dark_stack)):
        whole = float(np.var(stack.mean_map_dn))
        out |= {f"s_2_y{part}{tag}": whole for part in ("", "_cav", "_rav", "_col", "_row", "_pixel")}
    return out | {"LE_min": 100.0, "LE_max": 100.0}


SCALARS = [
    key
    for key, value in (stored().items() if STORED.is_file() else ())
    if not key.startswith(("temporal.", "spatial.", "linearity.")) and np.isfinite(value[0])
]


@pytest.mark.parametrize("key", SCALARS)
def test_published_scalar(key: str) -> None:
    value, published = results("reference").values[key], float(stored()[key][0])
    assert not value.is_upper_limit
    assert value.value == pytest.approx(published, rel=0, abs=RELATIVE * max(abs(published), largest_summands().get(key, 0.0)))
    assert value.u >= 0


def test_what_is_printed_as_nan_is_a_limit_with_its_reason() -> None:
    missing = {k for k, v in stored().items() if v.size == 1 and np.isnan(v[0])}
    assert missing == {"DSNU1288_pixel", "u_p_min_area", "u_e_min_area", "u_p_sat_area", "u_e_sat_area"}
    limit = results("reference").values["DSNU1288_pixel"]
    assert limit.is_upper_limit
    assert 0.05 < limit.value < 0.5  # e⁻; less than the pixels' noise left in the mean image, 10.9/√50
    assert "row" in limit.reason
    assert all("area" in results("reference").values[key].reason for key in missing - {"DSNU1288_pixel"})


def test_published_linearity_curve() -> None:
    curve = results("reference").curves["linearity"]
    for key in ("fit_slope", "fit_offset", "linearity_error_min", "linearity_error_max"):
        largest = 100.0 if "error" in key else abs(float(stored()[f"linearity.{key}"][0]))
        assert curve[key][0] == pytest.approx(stored()[f"linearity.{key}"][0], rel=0, abs=RELATIVE * largest), key


@pytest.mark.parametrize(
    ("key", "name", "scale"),
    [
        ("texp", "exposure_s", 1e9),
        ("u_p", "photons", 1.0),
        ("u_y", "mean_dn", 1.0),
        ("s2_y", "var_dn2", 1.0),
        ("u_ydark", "dark_mean_dn", 1.0),
        ("s2_ydark", "dark_var_dn2", 1.0),
    ],
)
def test_published_temporal_series(key: str, name: str, scale: float) -> None:
    np.testing.assert_allclose(scale * getattr(series_of(measured()), name), stored()[f"temporal.{key}"], rtol=RELATIVE, atol=1e-9)


@pytest.mark.parametrize("tag", ["", "_dark"])
def test_published_spatial_statistics(tag: str) -> None:
    stack = measured().dark_stack if tag else measured().bright_stack
    assert stack.n_frames == stored()[f"spatial.L{tag}"][0]
    assert stack.mean_dn == pytest.approx(stored()[f"spatial.avg_mean{tag}"][0], rel=RELATIVE)
    assert float(np.var(stack.mean_map_dn, ddof=1)) == pytest.approx(stored()[f"spatial.avg_var{tag}"][0], rel=RELATIVE)
    assert stack.var_stack_dn2 == pytest.approx(stored()[f"spatial.var_mean{tag}"][0], rel=RELATIVE)


@pytest.mark.parametrize("release", ["4.0", "3.1", "reference"])
def test_bootstrap_and_analytic_u_agree_for_every_value(release: str) -> None:
    """Within 15 %. Choices of levels are no values; of those that are, one with u = 0 must be sure in the bootstrap too."""
    by_bootstrap = bootstrap_u(measured(), release, 4000)
    values = {key: value for key, value in results(release).values.items() if key in by_bootstrap and not key.startswith("index_")}
    assert len(values) > 45
    for key, value in values.items():
        assert by_bootstrap[key] == pytest.approx(value.u, rel=0.15), (key, by_bootstrap[key], value.u)


def test_without_products_of_frames_the_dark_levels_tell_of_the_wave_in_the_stack() -> None:
    """A wave runs through the dark frames: the spatial variances scatter three times as much as white noise would let them."""
    alone = evaluate(replace(measured(), dark_products=None, bright_products=None), "3.1")
    for key in ("s_2_y_measured_dark", "s_2_y_dark", "s_2_y_pixel_dark", "DSNU1288"):
        assert alone.values[key].u == pytest.approx(results("3.1").values[key].u, rel=0.15), key


def test_4_0_splits_the_dark_pattern_with_the_temporal_row_noise_taken_off() -> None:
    split = results("4.0").values
    assert not split["DSNU1288_pixel"].is_upper_limit
    assert abs(split["DSNU1288_pixel"].value - split["DSNU1288_pixel_nonlinear"].value) < 3 * split["DSNU1288_pixel"].u
    # the rows' pattern is the temporal noise that their means keep: 3.1 takes it for a pattern, 4.0 finds none
    assert results("3.1").values["s_2_y_row_dark"].value > 10 * results("3.1").values["s_2_y_row_dark"].u
    assert abs(split["s_2_y_row_dark"].value) < 3 * split["s_2_y_row_dark"].u
    assert any("Linear model does not hold" in note for note in results("4.0").notes)
