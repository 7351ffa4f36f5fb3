"""Pictures of edges in an assessment: beside dark and bright frames, and alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from observe.edge_pictures import one_edge, squares, stored
from pixmetry import Frames, assess, campaign_of_arrays, emva1288
from pixmetry.assess.job import observe_campaign
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.progress import no_progress

LEVELS = tuple(0.001 * k for k in range(1, 11))


def flat(rng: np.random.Generator, shape: tuple[int, int]) -> list[Frames]:
    """A short photon transfer without structure."""

    def taken(kind: str, exposure_s: float, electrons: float) -> Frames:
        dn = 200 + 0.5 * rng.poisson(electrons, (2, *shape)) + rng.normal(0, 2, (2, *shape))
        return Frames(kind, exposure_s, stored(dn))

    return [taken("dark", t, 0) for t in LEVELS] + [taken("bright", t, 6e5 * t) for t in LEVELS]


def test_edges_alone_are_assessed(rng: np.random.Generator, tmp_path: Path):
    """What dark and bright frames tell is missing with its reason; the edges and a report are there."""
    campaign = campaign_of_arrays([Frames("edge", None, stored(squares(rng))[None])], bits=12, name="edges only")
    found = assess(campaign, tmp_path / "result", trials=0)
    assert found.observations.edges is not None and len(found.observations.edges.edges) == 16
    assert {"no dark frames", "no bright frames"} <= {note.split(":")[0] for note in found.observations.notes}
    assert "electronics.gain" in found.unmeasured and "sensor.prnu" in found.unmeasured
    assert np.isfinite(found.budget.verdict.total_px)
    assert "Slanted edges" in (tmp_path / "result" / "report.html").read_text()
    assert found.to_record()["edges"]["measured"] == 16
    with pytest.raises((InputError, MeasureError)):
        emva1288(campaign)


def test_edges_beside_dark_and_bright_frames_change_none_of_their_values(rng: np.random.Generator):
    frames = flat(rng, (240, 240))
    edges = Frames("edge", 0.002, stored(squares(rng, shape=(240, 240)))[None])
    alone = campaign_of_arrays(frames, bits=12)
    both = campaign_of_arrays([edges, *frames], bits=12)
    _, one = observe_campaign(alone, no_progress)
    _, other = observe_campaign(both, no_progress)
    assert one.photon_transfer_fit is not None and other.photon_transfer_fit is not None
    np.testing.assert_array_equal(one.photon_transfer_fit.values, other.photon_transfer_fit.values)
    assert one.edges is None and other.edges is not None and len(other.edges.edges) == 4
    values = [sheet.results[0].values["K"].value for sheet in (emva1288(alone), emva1288(both))]
    assert values[0] == values[1]


def test_frames_of_a_group_are_averaged(rng: np.random.Generator):
    """Four frames of one picture have half of the noise of one."""
    clean = squares(rng, shape=(240, 240), noise=0)
    frames = np.array([stored(clean + 12 * rng.standard_normal(clean.shape)) for _ in range(4)])
    _, seen = observe_campaign(campaign_of_arrays([Frames("edge", None, frames)], bits=12), no_progress)
    assert seen.edges is not None
    assert np.mean([e.noise_dn for e in seen.edges.edges]) == pytest.approx(6.0, rel=0.1)
    assert not any("moved" in note for note in seen.notes)


def test_a_chart_that_moved_between_the_frames_is_told(rng: np.random.Generator):
    """Two frames 0.4 px apart, which is an rms of 0.28 px."""
    frames = np.array([stored(one_edge(rng, sigma=0.7, at_px=at)) for at in (49.1, 49.5)])
    _, seen = observe_campaign(campaign_of_arrays([Frames("edge", None, frames)], bits=12), no_progress)
    (note,) = [note for note in seen.notes if "moved" in note]
    assert "picture 1" in note
    assert float(note.split("about ")[1].split(" px")[0]) == pytest.approx(0.4 / np.sqrt(2), abs=0.05)


def test_edges_through_a_mosaic_are_left_out_with_a_note(rng: np.random.Generator):
    frames = [*flat(rng, (60, 60)), Frames("edge", None, stored(squares(rng, shape=(60, 60), cell=60))[None])]
    _, seen = observe_campaign(campaign_of_arrays(frames, bits=12, cfa="RGGB"), no_progress)
    assert seen.edges is None and any("colour mosaic" in note for note in seen.notes)
