"""What a camera says of whence its parameters are known: it survives the file, goes with what changes, and is refused where wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixmetry.camera.camera import Camera, build_camera, load_camera
from pixmetry.camera.overrides import changed_camera
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates

PRNU = {
    "source": "sensor.prnu",
    "parameters": {"pixel_std_rel": 0.02, "row_std_rel": 0.0},
    "known_from": "measured",
    "uncertainties": {
        "pixel_std_rel": 1e-4,
        "row_std_rel": {"upper_limit": 0.0003, "u": 5e-5, "dof": 57.5, "reason": "not significant"},
        "col_std_rel": {"value": 0.001, "u": 2e-4},
    },
    "covariance": {"pixel_std_rel": {"col_std_rel": -1e-9}},
    "method": "analysis of variance",
    "confounders": ["the light"],
}
NOISE = {"source": "electronics.amplifier_noise", "parameters": {"white_e": 3.0}, "known_from": "typical"}
RECORD = {"schema": "pixmetry/camera/1", "name": "c", "rows": 8, "cols": 9, "chain": [PRNU, {"source": "sensor.quantum_efficiency"}, NOISE]}


def with_prnu(**changes: Any) -> Camera:
    return build_camera(RECORD | {"chain": [PRNU | changes]})


def test_what_an_element_says_of_its_parameters() -> None:
    camera = build_camera(RECORD)
    assert [e.known_from for e in camera.chain] == ["measured", "", "typical"]
    (name,) = camera.estimates
    found = camera.estimates[name]
    assert name == "sensor.prnu" and found.names == ("pixel_std_rel", "row_std_rel", "col_std_rel")
    assert found.values.tolist() == [0.02, 0.0003, 0.001]  # the parameter, the limit, the best estimate
    assert found.u.tolist() == [1e-4, 5e-5, 2e-4] and found.dof.tolist() == [np.inf, 57.5, np.inf]
    assert found["row_std_rel"].is_upper_limit and found["row_std_rel"].reason == "not significant"
    assert found.covariance[0, 2] == found.covariance[2, 0] == -1e-9 and found.covariance[0, 1] == 0
    assert found.units == ("1", "1", "1") and found.method == "analysis of variance" and found.confounders == ("the light",)
    assert camera["sensor.prnu"].params.col_std_rel == 0.0  # the camera is simulated with its parameters


def test_it_survives_the_file_to_the_last_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    """Also of values, covariances and numbers of freedom that are no short decimals."""
    root = rng.normal(size=(3, 3)) * [1e-4, 1e-5, 1e-3]
    estimates = Estimates(
        ("col_std_rel", "pixel_std_rel", "row_std_rel"),
        rng.uniform(0, 0.1, 3),
        root.T @ root,
        np.append(rng.uniform(1, 100, 2), np.inf),
        ("1", "1", "rel"),
        lower_limits=frozenset({"row_std_rel"}),
        reasons={"col_std_rel": "a reason: with a colon"},
    )
    camera = build_camera(RECORD)
    first = replace(camera, chain=(replace(camera.chain[0], estimates=estimates), *camera.chain[1:]))
    first.save(tmp_path / "c.yaml")
    second = load_camera(tmp_path / "c.yaml")
    assert second == first and second.to_record() == first.to_record()
    found = second.estimates["sensor.prnu"]
    assert found.names == estimates.names and found.units == estimates.units and found.lower_limits == estimates.lower_limits
    assert found.values.tolist() == estimates.values.tolist() and found.u.tolist() == estimates.u.tolist()
    assert found.dof.tolist() == estimates.dof.tolist() and found.reasons == estimates.reasons
    off = ~np.eye(3, dtype=bool)
    assert found.covariance[off].tolist() == estimates.covariance[off].tolist()


def test_a_preset_says_nothing_and_its_file_neither() -> None:
    camera = load_camera("imx264_like")
    assert camera.estimates == {} and {e.known_from for e in camera.chain} == {""}
    assert all(entry.keys() <= {"source", "name", "enabled", "parameters"} for entry in camera.to_record()["chain"])


def test_what_changes_loses_its_provenance_and_nothing_else_does() -> None:
    camera = build_camera(RECORD)
    for changed in (
        camera.with_parameters("sensor.prnu", pixel_std_rel=0.01),
        changed_camera(camera, {"sensor.prnu.pixel_std_rel": 0.01}),
    ):
        assert changed["sensor.prnu"].known_from == "" and changed.estimates["sensor.prnu"].names == ("row_std_rel", "col_std_rel")
        assert changed["electronics.amplifier_noise"].known_from == "typical"
    same = camera.with_parameters("sensor.prnu", pixel_std_rel=0.02)
    assert same["sensor.prnu"].known_from == "measured" and len(same.estimates["sensor.prnu"]) == 3
    off = camera.switched(off=["sensor.prnu"])
    assert off["sensor.prnu"].known_from == "measured" and "sensor.prnu" in off.estimates  # what is switched off is known as before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"known_from": "hearsay"}, "known_from"),
        ({"uncertainties": {"pixel_std": 1e-4}}, r"chain\[0\] sensor.prnu: an uncertainty of pixel_std, no number.*pixel_std_rel"),
        ({"uncertainties": {"pixel_std_rel": -1e-4}}, "pixel_std_rel"),
        ({"uncertainties": {"pixel_std_rel": "1 %"}}, "is not a number"),
        ({"uncertainties": {"pixel_std_rel": {"sigma": 1e-4}}}, "unknown key"),
        ({"uncertainties": {"pixel_std_rel": {"value": 0.02, "upper_limit": 0.03}}}, "two values.*one of value, upper_limit"),
        ({"uncertainties": {"pixel_std_rel": {"value": 7.0, "u": 0.1}}, "covariance": {}}, r"sensor.prnu, uncertainties.*pixel_std_rel"),
        ({"uncertainties": {"pixel_std_rel": {"u": 0.1, "dof": 0}}}, "dof"),
        ({"covariance": {"pixel_std_rel": {"pixel_std_rel": 1e-9}}}, "a covariance of pixel_std_rel and pixel_std_rel"),
        ({"covariance": {"pixel_std_rel": {"gain": 1e-9}}}, "a covariance of pixel_std_rel and gain"),
        ({"covariance": {"pixel_std_rel": {"row_std_rel": 1e-9}, "row_std_rel": {"pixel_std_rel": 1e-9}}}, "given twice"),
        ({"covariance": {"pixel_std_rel": {"row_std_rel": 1e-8}}}, "cannot have.*from -1 to 1"),
        ({"uncertainties": {}}, "a covariance of pixel_std_rel and col_std_rel"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_its_place(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=rf"(?s){message}"):
        with_prnu(**changes)


def test_a_covariance_that_only_three_together_cannot_have_is_refused() -> None:
    """Correlations of -0.9 between each two of three values: every pair can be, the three cannot."""
    names = ("pixel_std_rel", "row_std_rel", "col_std_rel")
    pairs = {names[0]: {names[1]: -0.9e-8, names[2]: -0.9e-8}, names[1]: {names[2]: -0.9e-8}}
    with pytest.raises(InputError, match="cannot have"):
        with_prnu(uncertainties=dict.fromkeys(names, 1e-4), covariance=pairs)


def test_an_uncertainty_of_what_is_no_number_is_refused() -> None:
    entry = {"source": "sensor.quantum_efficiency", "uncertainties": {"model": 0.1}}
    with pytest.raises(InputError, match="an uncertainty of model, no number"):
        build_camera(RECORD | {"chain": [entry]})


def test_an_element_made_in_python_is_checked_too() -> None:
    camera = build_camera(RECORD)
    wrong = Estimates.from_rows([("gain_dn_per_e", 0.2, 0.01, 10.0, "DN/e-")])
    with pytest.raises(InputError, match="c, sensor.prnu: an estimate of gain_dn_per_e, no parameter of sensor.prnu"):
        replace(camera, chain=(replace(camera.chain[0], estimates=wrong),))
    with pytest.raises(InputError, match="known from nowhere.*measured, sheet, typical"):
        replace(camera, chain=(replace(camera.chain[0], known_from="hearsay"),))
