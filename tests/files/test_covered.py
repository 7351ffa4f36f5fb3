"""Covered borders of stored frames: stated in the manifest, left out of all that speaks of light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pixmetry.camera.covered import Covered
from pixmetry.core.errors import InputError
from pixmetry.files import FrameReader
from pixmetry.files.images import write_frame
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.files.manifest import load_campaign, write_manifest

BORDERS = {"left": 2, "right": 5, "top": 1, "bottom": 3}


def test_the_frame_is_what_lies_between_the_covered_borders(tmp_path: Path):
    frames = np.arange(2 * 20 * 24, dtype=np.uint16).reshape(2, 20, 24)
    for name, frame in zip("ab", frames, strict=True):
        write_frame(tmp_path / f"{name}.png", frame, 12)
    (tmp_path / "campaign.yaml").write_text(
        f"schema: pixmetry/campaign/1\ncamera: {{name: one, bits: 12, covered: {BORDERS}}}\n".replace("'", "")
        + 'frames: [{kind: dark, exposure_s: 0.01, files: ["a.png", "b.png"]}]\n'
    )
    read = load_campaign(tmp_path)
    made = campaign_of_arrays([Frames("dark", 0.01, frames)], bits=12, covered=BORDERS)
    for campaign in (read, made):
        assert campaign.camera.covered == Covered(2, 5, 1, 3)
        assert campaign.frame_shape == (16, 17) and campaign.stored_shape == (20, 24)
        got = []
        reader = FrameReader(campaign)
        for path, frame in zip(campaign.groups[0].paths, frames, strict=True):
            np.testing.assert_array_equal(reader.fetch(path, got.append), frame[1:17, 2:19])
        np.testing.assert_array_equal(got, frames)
    write_manifest(read, tmp_path / "again.yaml")
    assert load_campaign(tmp_path / "again.yaml").camera == read.camera


def test_borders_that_leave_no_frame_are_refused():
    with pytest.raises(InputError, match="leave too little"):
        campaign_of_arrays([Frames("dark", 0.01, np.zeros((2, 20, 24), np.uint16))], bits=12, covered={"left": 18})
