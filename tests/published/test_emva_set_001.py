"""The public EMVA 1288 data set 001 (Basler CCD, 12 bit) against what the public reference implementation 1.0.2 prints for it.

The packaged crop is always assessed; the whole set where the environment variable PIXMETRY_DATA names the folder that holds it.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import pytest

from pixmetry.assessment import observe_campaign
from pixmetry.campaign import load_campaign
from pixmetry.experiment.emva_linear import fit_emva_linear
from pixmetry.experiment.spatial_fit import emva_spatial

WHOLE = Path(os.environ.get("PIXMETRY_DATA", "")) / "emva1288-set-001" / "EMVA1288_Data.txt"
needs_whole = pytest.mark.skipif(
    not (os.environ.get("PIXMETRY_DATA") and WHOLE.is_file()), reason="PIXMETRY_DATA does not name a folder with emva1288-set-001"
)


@cache
def observed(path: Path | None):
    return observe_campaign(load_campaign(path), lambda *_: None)[1]


@needs_whole
@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("gain_dn_per_e", 0.2800626484911438),
        ("dark_noise_dn", 3.0731043140450693),
        ("dark_noise_e", 10.924397786720915),
        ("quantum_efficiency", 0.45249490963432144),
        ("saturation_e", 14007.884917549689),
        ("dynamic_range", 1220.952300617835),
        ("snr_max", 118.35491082988356),
    ],
)
def test_published_sensitivity_of_the_whole_set(name: str, published: float) -> None:
    assert fit_emva_linear(observed(WHOLE).photon_transfer)[name].value == pytest.approx(published, rel=1e-8)


@needs_whole
@pytest.mark.parametrize(
    ("name", "published", "absolute"),
    [
        ("s2_row_dark_dn2", 0.0052588319891171955, 1e-8),
        ("s2_col_dark_dn2", 0.022919124448569375, 1e-8),
        # the reference takes s²_y with N·M − 1 in the denominator: its pixel part differs by s²_y/(N·M)
        ("s2_pixel_dark_dn2", -0.00417548739031521, 1e-6),
        ("s2_row_bright_dn2", 40.41627780965267, 1e-6),
        ("s2_col_bright_dn2", 4.815702942323732, 1e-6),
        ("s2_pixel_bright_dn2", 27.19303265392536, 4e-4),
    ],
)
def test_published_spatial_split_of_the_whole_set(name: str, published: float, absolute: float) -> None:
    seen = observed(WHOLE)
    assert emva_spatial(seen.dark_stack, seen.bright_stack)[name].value == pytest.approx(published, abs=absolute)


def test_the_crop_agrees_with_the_published_values_of_the_whole() -> None:
    """The crop has 1/12 of the pixels; the linear rule's own u is 0.24 % for K, so 5 u catches an error of 1.2 % and more."""
    linear = fit_emva_linear(observed(None).photon_transfer)
    for name, published in (("gain_dn_per_e", 0.28006265), ("dark_noise_dn", 3.07310431)):
        assert abs(linear[name].value - published) < 5 * linear[name].u, name


def test_the_crop_has_a_temporal_row_noise_that_the_standard_takes_for_a_pattern() -> None:
    seen = observed(None)
    rows = seen.photon_transfer_fit["row_noise_e"]
    assert rows.kind == "value"
    assert rows.value > 20 * rows.u
    standard = emva_spatial(seen.dark_stack, seen.bright_stack)["s2_row_dark_dn2"].value
    ours = seen.spatial_fit["dsnu_row_dn"]
    temporal = (rows.value * seen.photon_transfer_fit["gain_dn_per_e"].value) ** 2 / seen.dark_stack.n_frames
    assert standard == pytest.approx(temporal, rel=0.6)  # of the size of the temporal noise that the mean of the frames keeps
    assert ours.kind == "upper_limit"
