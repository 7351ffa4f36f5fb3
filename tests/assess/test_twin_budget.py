"""A budget made of an assessment's camera file alone says what the assessment's own says."""

from __future__ import annotations

from pathlib import Path

import pytest

from pixmetry import assess
from pixmetry.assess.results import Assessment
from pixmetry.budget import Budget, compute_budget
from pixmetry.camera.camera import Camera, load_camera

ALIKE = 0.01  # the twin's maps of this unit change the target's light a little


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Assessment, Camera, Budget]:
    """The assessment of the packaged example, its camera file, and the budget of that file."""
    assessment = assess(trials=0)
    path = tmp_path_factory.mktemp("twin") / "camera.yaml"
    assessment.camera.save(path)
    camera = load_camera(path)
    accepted = [e.name for e in camera.active if e.known_from == "typical"]
    sensor = camera.facts["sensor_rows"], camera.facts["sensor_cols"]
    return assessment, camera, compute_budget(camera, camera.estimates, accepted=accepted, sensor_shape=sensor, trials=0)


def test_rows_are_those_of_the_assessment(pair: tuple[Assessment, Camera, Budget]) -> None:
    assessment, _, budget = pair
    ours, theirs = ({r.name: r for r in b.rows} for b in (budget, assessment.budget))
    assert ours.keys() == theirs.keys()
    assert {n: r.status for n, r in ours.items()} == {n: r.status for n, r in theirs.items()}
    measured = [name for name, row in theirs.items() if row.status == "measured"]
    assert len(measured) >= 12
    for name in measured:
        assert ours[name].reason == theirs[name].reason
        if theirs[name].contribution is not None:
            assert ours[name].total_px == pytest.approx(theirs[name].total_px, rel=ALIKE), name
            assert ours[name].u_of_total_px == pytest.approx(theirs[name].u_of_total_px, rel=2 * ALIKE), name
    assert budget.verdict.total_px == pytest.approx(assessment.budget.verdict.total_px, rel=ALIKE)


def test_limits_are_kept_and_not_simulated(pair: tuple[Assessment, Camera, Budget]) -> None:
    assessment, camera, _ = pair
    limits = {(source, name) for source, e in assessment.estimates.items() for name in e.limits if source in camera}
    assert {"sensor.dsnu", "sensor.dark_current"} <= {source for source, _ in limits}
    for source, name in limits:
        kept, found = camera.estimates[source][name], assessment.estimates[source][name]
        assert kept.is_upper_limit and (kept.value, kept.u, kept.reason) == (found.value, found.u, found.reason)
        assert getattr(camera[source].params, name) == 0.0
    well = camera["sensor.full_well"]  # the converter clips first: it is off, and its bound stays
    assert not well.on and well.estimates["full_well_e"].is_lower_limit


def test_every_element_says_whence_it_is_known(pair: tuple[Assessment, Camera, Budget]) -> None:
    assessment, camera, _ = pair
    measured = {e.name for e in camera.chain if e.known_from == "measured"}
    assert measured == set(assessment.estimates) & {e.name for e in camera.chain}
    assert {e.name for e in camera.chain if e.known_from != "measured"} == {"sensor.shot_noise"}


def test_the_file_says_it_in_words_that_can_be_read(pair: tuple[Assessment, Camera, Budget], tmp_path: Path) -> None:
    pair[1].save(tmp_path / "camera.yaml")
    text = (tmp_path / "camera.yaml").read_text()
    assert "known_from: measured" in text and "upper_limit:" in text and "row_e: 0.0" in text
    assert "confounders" not in text  # results.json holds them
