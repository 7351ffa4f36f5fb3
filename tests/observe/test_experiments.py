"""Kinds of pictures: what the manifest lists, what is reduced, and what may be said of them agree."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import get_args

import numpy as np
import pytest

from pixmetry.assess.job import observe_campaign
from pixmetry.camera.group_facts import GroupFacts
from pixmetry.core.errors import InputError
from pixmetry.core.progress import no_progress
from pixmetry.files.images import FrameReader, write_frame
from pixmetry.files.in_memory import Frames, campaign_of_arrays
from pixmetry.files.manifest import load_campaign, write_manifest
from pixmetry.files.records import FACTS, KINDS, LOCATED, TARGETS
from pixmetry.files.schema import GroupModel
from pixmetry.observe.experiments import EXPERIMENTS

STATED = {  # a lawful value of each fact
    "wavelength_nm": 850.0,
    "focus_um": -50.0,
    "temperature_c": 40.0,
    "densities": (0.1, 0.5),
    "luminances": (80.0, 30.5),
    "u_light_rel": 0.01,
    "regions": ((0, 0, 3, 3), (4, 4, 3, 3)),
    "white": True,
    "times_s": (0.0, 60.0),
    "temperatures_c": (20.0, 25.0),
    "interval_s": 60.0,
    "on_for_s": 30.0,
    "recorded": True,
    "band": "LED red",
    "filtered": True,
    "refocused": True,
    "channel": "green",
    "pulsed": True,
}
WITH = {
    "regions": {"densities": (0.1, 0.5)},
    "on_for_s": {"interval_s": 60.0},
    "temperatures_c": {"interval_s": 60.0},
    "pulsed": {"interval_s": 60.0},
}  # facts that another one needs
NEEDED = {"bands": {"wavelength_nm": 850.0}}  # by a kind


def test_each_kind_of_the_manifest_has_its_experiment() -> None:
    assert {*EXPERIMENTS, *LOCATED} == set(TARGETS)
    assert get_args(GroupModel.model_fields["kind"].annotation) == (*KINDS, *TARGETS)


def test_each_fact_is_a_key_of_the_manifest_and_belongs_to_some_kind() -> None:
    names = {f.name for f in fields(GroupFacts)}
    assert names == set(STATED) == {name for allowed in FACTS.values() for name in allowed}
    assert names <= set(GroupModel.model_fields)


@pytest.mark.parametrize("kind, name", [(kind, name) for kind, names in FACTS.items() for name in names])
def test_a_fact_reaches_the_group_from_arrays_and_through_a_file(kind: str, name: str, tmp_path) -> None:
    stated = {**NEEDED.get(kind, {}), name: STATED[name], **WITH.get(name, {})}
    facts = GroupFacts(**stated)
    frames = np.arange(2 * 8 * 8, dtype=np.uint16).reshape(2, 8, 8)
    campaign = campaign_of_arrays([Frames(kind, 0.01, frames, facts=facts)], bits=8, name="a camera")
    assert campaign.groups[0].facts == facts
    listed = {"kind": kind, "exposure_s": 0.01, **stated, "files": ["a.png", "b.png"]}
    for file, frame in zip(listed["files"], frames, strict=True):
        write_frame(tmp_path / file, frame, 8)
    (tmp_path / "campaign.yaml").write_text(
        f"schema: pixmetry/campaign/1\ncamera: {{name: one, bits: 8}}\nframes: [{json.dumps(listed)}]\n"
    )
    read = load_campaign(tmp_path)
    assert read.groups[0].facts == facts
    write_manifest(read, tmp_path / "again.yaml")
    assert load_campaign(tmp_path / "again.yaml").groups[0].facts == facts


def test_a_fact_of_another_kind_is_refused() -> None:
    frames = np.zeros((2, 8, 8), np.uint16)
    for name in (f.name for f in fields(GroupFacts)):
        for kind in (k for k in (*KINDS, *TARGETS) if name not in FACTS.get(k, ())):
            with pytest.raises(InputError, match=name):
                campaign_of_arrays([Frames(kind, 0.01, frames, facts=GroupFacts(**{name: STATED[name]}))], bits=8)


def test_a_channel_of_colour_frames_is_measured(tmp_path, rng: np.random.Generator) -> None:
    import imagecodecs

    colour = rng.integers(0, 255, (2, 20, 24, 3)).astype(np.uint8)
    for k, frame in enumerate(colour):
        (tmp_path / f"{k}.png").write_bytes(imagecodecs.png_encode(frame))
    listed = '[{kind: views, exposure_s: 0.01, channel: green, files: "*.png"}]'
    (tmp_path / "campaign.yaml").write_text(f"schema: pixmetry/campaign/1\ncamera: {{name: one, bits: 8}}\nframes: {listed}\n")
    campaign = load_campaign(tmp_path)
    found = np.array([FrameReader(campaign).fetch(path) for path in campaign.groups[0].paths])
    assert np.array_equal(found, colour[..., 1])


def test_the_wavelength_of_edges_is_that_of_their_lens(rng: np.random.Generator) -> None:
    def seen_with(*wavelengths: float | None):
        frames = [rng.integers(90, 110, (2, 40, 40)).astype(np.uint16) for _ in wavelengths]
        groups = [Frames("edge", None, f, facts=GroupFacts(wavelength_nm=nm)) for f, nm in zip(frames, wavelengths, strict=True)]
        return observe_campaign(campaign_of_arrays(groups, bits=8, optics={"wavelength_nm": 550.0}), no_progress)[1]

    assert seen_with(850.0, 850.0).stated.wavelength_nm == 850.0
    both = seen_with(850.0, None)
    assert both.stated.wavelength_nm == 550.0 and any("several wavelengths (550 nm, 850 nm)" in note for note in both.notes)
