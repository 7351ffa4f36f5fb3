"""``pixmetry bound``: what it prints, what it tells programs, and how it refuses."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner, Result

from pixmetry.cli import main
from pixmetry.locate.bound.fisher import cramer_rao_bound
from pixmetry.locate.noise import NoiseModel

TARGET = ("--radius", "3.5", "--blur", "0.7", "--amplitude", "150", "--background", "10")


def run(*words: str) -> Result:
    return CliRunner().invoke(main, ["bound", *words])


def test_it_says_what_is_possible_what_estimators_give_and_what_limits() -> None:
    result = run("--kind", "disc", *TARGET, "--camera", "imx264_like")
    assert result.exit_code == 0, result.output
    for text in ("What is possible", "What estimators give", "What limits template", "shot noise", "nm", "frames gains little", "1/12"):
        assert text in result.output, text


def test_programs_get_the_numbers_of_the_library() -> None:
    record = json.loads(run(*TARGET, "--noise", "read=1.5,gain=0.01,bits=8", "--json", "-").output)
    model = NoiseModel(1.5**2 + 1 / 12, 0.01, low_dn=0, high_dn=255)
    disc = {"radius_px": 3.5, "blur_px": 0.7, "amplitude_dn": 150.0, "background_dn": 10.0}
    assert record["bounds"]["asked"]["u_px"]["mean"] == pytest.approx(cramer_rao_bound("disc", disc, model).place_px[1])
    assert record["schema"] == "pixmetry/bound/1" and record["frames"] == 1 and record["pitch_um"] is None
    assert sum(limit["share"] for limit in record["limits"]) == pytest.approx(1, abs=1e-5)
    four = json.loads(run(*TARGET, "--noise", "read=1.5,gain=0.01,bits=8", "--frames", "4", "--json", "-").output)
    assert four["bounds"]["asked"]["u_px"]["mean"] == pytest.approx(record["bounds"]["asked"]["u_px"]["mean"] / 2)


def test_black_of_a_camera_is_under_the_surround() -> None:
    record = json.loads(run(*TARGET, "--camera", "imx264_like", "--json", "-").output)
    assert record["parameters"]["background_dn"] == pytest.approx(42.0076, abs=0.05)
    assert record["pitch_um"] == [3.45, 3.45]


@pytest.mark.parametrize(
    "words",
    [
        ("--kind", "ellipse", "--semi-major", "6", "--semi-minor", "4", "--angle", "30"),
        ("--kind", "ring", "--radius", "8", "--inner-radius", "4", "--estimator", "centroid"),
        ("--kind", "spot", "--unknowns", "position", "--estimator", "squared_centroid"),
        ("--kind", "line", "--length", "30", "--estimator", "row_squared_centroid"),
        ("--kind", "line", "--width", "5", "--angle", "40"),
        ("--kind", "edge", "--unknowns", "offset_px,angle_deg"),
        ("--radius", "4", "--no-rounding", "--light-on", "image", "--unknowns", "planes", "--aperture", "0.6", "--window", "31"),
    ],
)
def test_every_kind_of_target(words: tuple[str, ...]) -> None:
    result = run(*words, "--blur", "0.8", "--amplitude", "100", "--phases", "3")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--kind", "disc", "--blur", "0.7", "--amplitude", "100"), "needs more parameters; to do: give radius_px"),
        (("--kind", "spot", "--radius", "3", "--blur", "0.7", "--amplitude", "100"), "has no such parameter"),
        ((*TARGET, "--noise", "reed=1"), "'reed=1' cannot be used"),
        ((*TARGET, "--noise", "read=-1"), "read noise cannot be used"),
        ((*TARGET, "--noise", "read=1,bits=8.5"), "bits cannot be used"),
        ((*TARGET, "--noise", "read=0"), "no bound without noise"),
        ((*TARGET, "--noise", "read=1", "--camera", "imx264_like"), "given twice"),
        ((*TARGET, "--camera", "nowhere"), "no such camera"),
        ((*TARGET, "--unknowns", "colour"), "no such parameter"),
        ((*TARGET, "--estimator", "best"), "allowed: template, template_unweighted"),
        (("--radius", "3.5", "--blur", "0.7", "--amplitude", "0"), "amplitude_dn cannot be used"),
        (("--radius", "3.5", "--blur", "nan", "--amplitude", "9"), "blur_px cannot be used"),
        ((*TARGET, "--window", "8"), "window cannot be used"),
        ((*TARGET, "--noise", "read=1,bits=1"), "does not determine the position"),
    ],
)
def test_mistakes_are_one_line_each(words: tuple[str, ...], text: str) -> None:
    result = run(*words)
    assert result.exit_code == 2
    assert text in result.output
    assert result.output.startswith("error: ") and result.output.count("\n") == 1
