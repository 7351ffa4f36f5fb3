"""The packaged crop of the public EMVA 1288 data set 001 (Basler CCD, 12 bit) against what is published for the whole of it."""

from __future__ import annotations

import pytest

from pixmetry.assess.job import by_the_standard, observe_campaign
from pixmetry.camera.observations import Observations
from pixmetry.emva.records import Results
from pixmetry.files import load_campaign


@pytest.fixture(scope="module")
def seen() -> Observations:
    return observe_campaign(load_campaign(None), lambda *_: None)[1]


@pytest.fixture(scope="module")
def standard(seen: Observations) -> Results:
    return by_the_standard(load_campaign(None), seen)


def test_the_crop_agrees_with_the_published_values_of_the_whole(standard: Results) -> None:
    """The crop has 1/85 of the pixels; the standard's own u is 0.65 % for K, so 5 u catches an error of 3.2 % and more."""
    for key, published in (("K", 0.28006265), ("sigma_y_dark", 3.07310431), ("sigma_d", 10.9243978), ("QE", 45.249491)):
        assert abs(standard.values[key].value - published) < 5 * standard.values[key].u, key


def test_the_crop_has_a_temporal_row_noise_that_the_standard_takes_for_a_pattern(seen: Observations, standard: Results) -> None:
    rows = seen.photon_transfer_fit["row_noise_e"]
    assert rows.kind == "value"
    assert rows.value > 20 * rows.u
    temporal = (rows.value * seen.photon_transfer_fit["gain_dn_per_e"].value) ** 2 / seen.dark_stack.n_frames
    # of the size of the temporal noise that the mean of the frames keeps
    assert standard.values["s_2_y_row_dark"].value == pytest.approx(temporal, rel=0.6)
    assert standard.values["DSNU1288_pixel"].is_upper_limit
    assert seen.spatial_fit["dsnu_row_dn"].kind == "upper_limit"
