"""EMVA 1288 descriptors as they come from other people's computers."""

from __future__ import annotations

import codecs
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from files.campaign_files import put_descriptor, put_frame
from pixmetry.core.errors import InputError
from pixmetry.files import load_campaign
from pixmetry.files.emva_descriptor import parse_descriptor

GOOD = """# Copyright somebody
# Licence: free
v 3.0
n 12 8 6
b 40000.0 120.0
i images\\b_0.png
i images\\b_1.png
d 40000.0
i images\\d_0.png
i images\\d_1.png
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("b_0", "b_1", "d_0", "d_1"):
        put_frame(tmp_path / "images" / f"{name}.png")
    return tmp_path


def names(path: Path) -> list[str]:
    return [p.name for group in load_campaign(path).groups for p in group.paths]


@pytest.mark.parametrize(
    "variant",
    [
        GOOD,
        GOOD.replace("\n", "\r\n"),
        "\ufeff" + GOOD.replace("\n", "\r\n"),
        GOOD.replace("images\\", "IMAGES\\").replace(".png", ".PNG"),
        GOOD.replace("images\\", "./images/"),
        GOOD.replace("i images", "  i   images").replace("b 4", "B\t4").replace("\nd", "\n\n# dark\nd"),
        GOOD.rstrip("\n"),
        GOOD.replace("b 40000.0 120.0", "b 00040000 0120,0").replace("n 12 8 6", "n 12 0008 6"),
        GOOD.replace("b 40000.0 120.0", "b 4e4 120.0  # level 1").replace("d 40000", "dc 40000"),
        GOOD.replace("d 40000", "t 23.5\nd 40000"),
    ],
)
def test_writing_habits_do_not_matter(variant: str, folder: Path) -> None:
    campaign = load_campaign(put_descriptor(folder, variant))
    dark, bright = campaign.groups
    assert (campaign.bits, campaign.frame_shape) == (12, (6, 8))
    assert (bright.exposure_s, bright.photons, dark.exposure_s, dark.photons) == (40e-6, 120.0, 40e-6, 0.0)
    assert [p.name for p in (*dark.paths, *bright.paths)] == ["d_0.png", "d_1.png", "b_0.png", "b_1.png"]
    assert campaign.licence == "Copyright somebody\nLicence: free"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encodings_and_spaces_in_names(encoding: str, folder: Path) -> None:
    put_frame(folder / "Bilder für Test" / "b 0 groß.png")
    text = GOOD.replace("images\\b_0.png", "bilder FÜR test\\b 0 groß.png")
    path = put_descriptor(folder, text, name="Daten.TXT", encoding=encoding)
    assert names(path)[2] == "b 0 groß.png"
    assert load_campaign(folder).source_path == path


def test_exact_name_wins_over_one_that_differs_in_case(folder: Path) -> None:
    put_frame(folder / "images" / "B_0.png")
    if len(list((folder / "images").iterdir())) == 4:
        pytest.skip("this file system does not tell upper from lower case")
    assert names(put_descriptor(folder, GOOD))[2] == "b_0.png"
    with pytest.raises(InputError, match="several files.*upper and lower case"):
        load_campaign(put_descriptor(folder, GOOD.replace("b_0.png", "b_0.PNG")))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("b_0.png", "b_00.png", ["line 6", "b_00.png", "missing", "did you mean 'b_0.png'"]),
        ("images\\b_0.png", "C:\\data\\b_0.png", ["line 6", "missing", "relative", "drive"]),
        ("i images\\b_0.png", "i images", ["line 6", "folder"]),
        ("i images\\b_0.png", "i", ["line 6", "without a name"]),
        ("n 12 8 6", "n 12 8", ["line 4", "2 numbers", "n bits width height"]),
        ("n 12 8 6", "n 12,5 8 6", ["line 4", "whole numbers"]),
        ("b 40000.0 120.0", "b 40,000 120.0", ["line 5", "a comma that may separate thousands or decimals", "point"]),
        ("n 12 8 6", "n 20 8 6", ["line 4", "1 to 16 bits"]),
        ("n 12 8 6\n", "", ["no record of bits"]),
        ("n 12 8 6", "n 12 8 6\nn 12 8 6", ["line 5", "second record"]),
        ("n 12 8 6", "n 12 6 8", ["8 x 6 pixels", "6 x 8"]),
        ("b 40000.0 120.0", "b nan 120.0", ["line 5", "finite"]),
        ("b 40000.0 120.0", "b 40000.0 -1", ["line 5", "0 or more"]),
        ("b 40000.0 120.0", "b 40000.0 120 80 60", ["line 5", "4 numbers", "b exposure photons"]),
        ("b 40000.0 120.0\n", "", ["line 5", "before the first b or d"]),
        ("d 40000.0", "d -1", ["line 8", "0 or more"]),
        ("i images\\d_0.png\ni images\\d_1.png\n", "", ["line 8", "no image follows"]),
        ("d_1.png", "d_0.png", ["d_0.png", "listed 2 times"]),
    ],
)
def test_each_mistake_has_its_own_message(old: str, new: str, words: list[str], folder: Path) -> None:
    assert old in GOOD
    with pytest.raises(InputError) as caught:
        load_campaign(put_descriptor(folder, GOOD.replace(old, new)))
    message = str(caught.value)
    for word in words:
        assert word in message
    assert "Traceback" not in message
    assert "\n" not in message


def test_manifest_may_add_facts_to_a_descriptor(folder: Path) -> None:
    put_descriptor(folder, GOOD)
    manifest = folder / "campaign.yaml"
    text = "schema: pixmetry/campaign/1\ncamera: {name: mine, bits: 12, pitch_um: 7.4}\nemva_descriptor: SET.txt\n"
    manifest.write_bytes(codecs.BOM_UTF8 + text.encode())
    campaign = load_campaign(manifest)
    assert (campaign.camera.name, campaign.camera.pitch_y_um, campaign.licence) == ("mine", 7.4, "Copyright somebody\nLicence: free")
    assert campaign.descriptor_path == folder / "set.txt"
    manifest.write_text(text.replace("SET.txt", "set.txt"), encoding="utf-8")
    assert load_campaign(folder).source_path == manifest
    manifest.write_text(text.replace("bits: 12", "bits: 10"), encoding="utf-8")
    with pytest.raises(InputError, match="declares 10 bits, the descriptor 12"):
        load_campaign(manifest)
    manifest.write_text(text.replace("SET", "other"), encoding="utf-8")
    with pytest.raises(InputError, match="line 3: file 'other.txt' is missing"):
        load_campaign(manifest)


def test_what_no_value_needs_is_a_note(folder: Path) -> None:
    """Levels at exposure 0, records of another kind, single frames, photons of a stack: each as in descriptors of laboratories."""
    for i in range(8):
        put_frame(folder / "images" / f"s_{i}.png")
    zero = GOOD.replace("40000.0", "0")
    bright = load_campaign(put_descriptor(folder, zero)).groups[1]
    assert (bright.exposure_s, bright.photons) == (0.0, 120.0)
    stack = GOOD + "b 80000 60\n" + "".join(f"i images\\s_{i}.png\n" for i in range(8))
    campaign = load_campaign(put_descriptor(folder, stack))
    assert [g.role for g in campaign.groups] == ["level", "level", "stack"] and not campaign.findings
    other = GOOD + "x 7\ni images\\s_0.png\ni images\\s_1.png\nd 500\ni images\\s_2.png\n"
    campaign = load_campaign(put_descriptor(folder, other))
    assert campaign.frame_count == 4
    told = " ".join(campaign.findings)
    assert "record 'x' of line 11" in told and "only 1 frame in group (dark, exposure 5e-07 s): it is left out" in told


def test_of_two_groups_of_one_condition_the_larger_is_the_stack(folder: Path) -> None:
    for i in range(4):
        put_frame(folder / "images" / f"s_{i}.png")
    more = "".join(f"i images\\s_{i}.png\n" for i in range(3))
    for text in (GOOD + "b 40000.0 120.0\n" + more, GOOD.replace("b 40000.0", f"b 40000.0 120.0\n{more}b 40000.0")):
        campaign = load_campaign(put_descriptor(folder, text))
        assert [(g.role, len(g.paths)) for g in campaign.groups if g.kind == "bright"] == [("level", 2), ("stack", 3)]
        assert "taken as a stack" in campaign.findings[0]
    again = GOOD + "dc 40000\ni images\\s_0.png\ni images\\s_1.png\n"
    campaign = load_campaign(put_descriptor(folder, again))
    assert [len(g.paths) for g in campaign.groups] == [4, 2] and "taken as one of 4 frames" in campaign.findings[0]


def test_photons_that_contradict_the_exposure_are_a_note(folder: Path) -> None:
    for i in range(2):
        put_frame(folder / "images" / f"s_{i}.png")
    text = GOOD + "b 80000 60\ni images\\s_0.png\ni images\\s_1.png\n"
    (note,) = load_campaign(put_descriptor(folder, text)).findings
    assert "photons fall from 120 to 60" in note


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60), st.integers(0, len(GOOD)))
def test_no_text_brings_forth_any_other_exception(junk: bytes, at: int) -> None:
    raw = GOOD.encode()[:at] + junk + GOOD.encode()[at:]
    try:
        descriptor = parse_descriptor(Path("set.txt"), raw)
    except InputError:
        return
    assert descriptor.bits >= 1
    assert all(group.files and group.exposure_s >= 0 for group in descriptor.groups)
