"""Manifests: good ones give the campaign they describe, bad ones one clear message."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from files.campaign_files import FRAMES, HEAD, put_campaign, put_frame
from pixmetry.core.errors import InputError
from pixmetry.files import EXAMPLE, FrameReader, load_campaign, photons_from_irradiance, write_manifest
from pixmetry.files.records import KINDS, TARGETS

KINDS_ALLOWED = ", ".join(f"'{kind}'" for kind in (*KINDS, *TARGETS[:-1])) + f" or '{TARGETS[-1]}'"
DARK = "frames:\n  - {kind: dark, exposure_s: 0.01, files: [d_0.png, d_1.png]}\n"
EDGE = "  - {kind: edge, files: [b_0.png]}\n"
BRIGHT = "  - {kind: bright, exposure_s: 0.01, files: [b_0.png, b_1.png]}\n"


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_campaign(path)
    message = str(caught.value)
    assert "Traceback" not in message
    assert "\n" not in message
    return message


def test_manifest_gives_what_it_says(tmp_path: Path) -> None:
    text = HEAD + "optics: {f_number: 8, focal_length_mm: 12.5}\nlicence: own\n" + FRAMES
    for campaign in (load_campaign(put_campaign(tmp_path, text)), load_campaign(tmp_path), load_campaign(str(tmp_path))):
        assert (campaign.bits, campaign.camera.pitch_x_um, campaign.camera.pitch_y_um, campaign.camera.sensor) == (12, 5.0, 5.0, "cmos")
        assert campaign.frame_shape == (6, 8)
        assert campaign.frame_dtype == "uint16"
        assert campaign.optics.focal_length_mm == 12.5
        assert campaign.licence == "own"
        dark, bright = campaign.groups
        assert (dark.kind, dark.exposure_s, dark.photons, dark.role) == ("dark", 0.01, 0.0, "level")
        assert (bright.kind, bright.exposure_s, bright.photons, bright.role) == ("bright", 0.01, 1000.0, "level")
        assert [p.name for p in (*dark.paths, *bright.paths)] == ["d_0.png", "d_1.png", "b_0.png", "b_1.png"]
        assert campaign.frame_count == 4


def test_edges_alone_or_beside_are_a_campaign(tmp_path: Path) -> None:
    """One frame is enough, and no exposure time is needed; written again it is the same."""
    for rest, kinds in (("", ["edge"]), (DARK.removeprefix("frames:\n"), ["dark", "edge"])):
        campaign = load_campaign(put_campaign(tmp_path, HEAD + "frames:\n" + EDGE + rest))
        assert [g.kind for g in campaign.groups] == kinds
        assert [g.kind for g in campaign.field_groups] == kinds[:-1]
        edge = campaign.groups[-1]
        assert (edge.exposure_s, edge.photons, edge.role, edge.label, len(edge.paths)) == (0.0, None, "target", "edge", 1)
        write_manifest(campaign, tmp_path / "again.yaml")
        assert load_campaign(tmp_path / "again.yaml").groups == campaign.groups


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["empty", "schema"]),
        ("# nothing but a comment\n", ["empty"]),
        (HEAD, ["no frames", "dark and bright"]),
        (HEAD + "frames:\n", ["no frames"]),
        (HEAD + DARK.replace("d_1", "d_9") + BRIGHT, ["d_9.png", "missing", "line 4", "did you mean"]),
        (HEAD + DARK.replace("d_1.png", "x/*.png") + BRIGHT, ["x/*.png", "matches no file", "line 4"]),
        (HEAD + DARK.replace("d_0.png, d_1.png", "d_0.png"), ["only 1 frame", "dark", "two frames"]),
        (HEAD + DARK.replace("d_1", "d_0") + BRIGHT, ["d_0.png", "listed 2 times"]),
        (HEAD + DARK + BRIGHT.replace("b_1", "d_1"), ["d_1.png", "listed 2 times"]),
        (HEAD + DARK + BRIGHT.replace("exposure_s", "exposure"), ["line 5", "lacks its unit", "exposure_s"]),
        (HEAD + DARK + BRIGHT.replace("exposure_s", "exposure_ms"), ["another unit", "exposure_s"]),
        (HEAD + DARK + BRIGHT.replace("0.01", ".nan"), ["exposure_s", "not a finite number"]),
        (HEAD + DARK + BRIGHT.replace("0.01", "-1"), ["exposure_s", "-1", "greater than or equal to 0"]),
        (
            HEAD + DARK + BRIGHT.replace("kind: bright", "kind: light"),
            ["kind", "'light'", KINDS_ALLOWED],
        ),
        (HEAD + DARK + EDGE.replace("}", ", role: stack}"), ["role belongs to dark and bright frames", "line 5"]),
        (HEAD + DARK + EDGE.replace("}", ", photons: 5}"), ["photons belongs to dark and bright frames"]),
        (HEAD + DARK + BRIGHT.replace("exposure_s: 0.01, ", ""), ["bright group without exposure time", "add exposure_s"]),
        (HEAD + DARK + BRIGHT.replace("kind:", "knd:"), ["unknown key", "did you mean `kind`"]),
        (HEAD + DARK + BRIGHT.replace("exposure_s: 0.01", "exposure_s: 0"), ["without exposure", "kind: dark"]),
        (HEAD + DARK.replace("0.01", "0.01, photons: 5") + BRIGHT, ["dark group has light"]),
        (HEAD + DARK + BRIGHT + BRIGHT.replace("b_0.png, b_1.png", "e_*.png"), ["same condition", "bright, exposure 0.01 s"]),
        (HEAD.replace("bits: 12", "bits: 12, bits: 10") + DARK + BRIGHT, ["line 2", "'bits' is given twice"]),
        (HEAD.replace("bits: 12", "bits: 24") + DARK + BRIGHT, ["bits", "24", "less than or equal to 16"]),
        (HEAD.replace("pitch_um: 5.0", "pitch: 5.0") + DARK + BRIGHT, ["pitch", "lacks its unit", "pitch_um"]),
        (HEAD.replace("pitch_um", "pitch_x_um") + DARK + BRIGHT, ["pitch", "one direction"]),
        (HEAD.replace("sensor: cmos", "sensor: film") + DARK + BRIGHT, ["sensor", "'ccd', 'cmos' or 'cid'"]),
        (HEAD.replace("campaign/1", "campaign/9") + DARK + BRIGHT, ["schema", "pixmetry/campaign/9", "pixmetry/campaign/1"]),
        (HEAD.replace("schema: pixmetry/campaign/1\n", "") + DARK + BRIGHT, ["'schema' is missing"]),
        (HEAD + DARK + BRIGHT + "emva_descriptor: set.txt\n", ["listed twice"]),
        ("schema: pixmetry/campaign/1\ncamera:\n" + DARK + BRIGHT, ["line 2", "'camera' holds no keys", "name, bits"]),
        (HEAD + DARK + BRIGHT.replace("b_1.png", "b_" + 300 * "x"), ["cannot be reached", "too long"]),
    ],
)
def test_each_bad_manifest_has_its_own_message(text: str, words: list[str], tmp_path: Path) -> None:
    put_frame(tmp_path / "e_0.png")
    put_frame(tmp_path / "e_1.png")
    message = refused(put_campaign(tmp_path, text))
    assert "campaign.yaml" in message
    for word in words:
        assert word in message


def test_levels_are_sorted_and_photons_that_do_not_follow_are_told(tmp_path: Path) -> None:
    second = "  - {kind: bright, exposure_s: 0.005, photons: PH, files: [c_0.png, c_1.png]}\n"
    for i in range(2):
        put_frame(tmp_path / f"c_{i}.png")
    text = HEAD + FRAMES + second
    campaign = load_campaign(put_campaign(tmp_path, text.replace("PH", "500")))
    assert [g.exposure_s for g in campaign.levels("bright")] == [0.005, 0.01]
    (note,) = load_campaign(put_campaign(tmp_path, text.replace("PH", "2000"))).findings
    assert "photons fall from 2000 to 1000 while the exposure rises from 0.005 s to 0.01 s" in note
    (note,) = load_campaign(put_campaign(tmp_path, text.replace("photons: PH,", ""))).findings
    assert "photons are known for some bright groups, not for (bright, exposure 0.005 s)" in note


@pytest.mark.parametrize(("kept", "missing"), [(DARK, "bright"), (BRIGHT, "dark")])
def test_frames_of_one_kind_alone_are_a_campaign(kept: str, missing: str, tmp_path: Path) -> None:
    campaign = load_campaign(put_campaign(tmp_path, HEAD + "frames:\n" + kept.removeprefix("frames:\n")))
    assert len(campaign.groups) == 1 and f"no {missing} frames" in campaign.findings[0]


def test_light_may_be_changed_at_one_exposure(tmp_path: Path) -> None:
    """EMVA 1288 lets one vary the irradiance and keep the exposure time."""
    for i in range(2):
        put_frame(tmp_path / f"c_{i}.png")
    text = HEAD + FRAMES + "  - {kind: bright, exposure_s: 0.01, photons: 200, files: c_?.png}\n"
    campaign = load_campaign(put_campaign(tmp_path, text))
    assert [g.photons for g in campaign.levels("bright")] == [200.0, 1000.0]


def test_repetition_may_be_written_as_a_yaml_merge(tmp_path: Path) -> None:
    text = HEAD + DARK.replace("- {", "- &d {") + "  - {<<: *d, kind: bright, files: [b_0.png, b_1.png]}\n"
    campaign = load_campaign(put_campaign(tmp_path, text))
    assert [(g.kind, g.exposure_s, g.paths[0].name) for g in campaign.groups] == [("dark", 0.01, "d_0.png"), ("bright", 0.01, "b_0.png")]
    assert "listed 2 times" in refused(put_campaign(tmp_path, text.replace(", files: [b_0.png, b_1.png]", "")))


def test_a_stack_may_share_its_exposure_with_a_level(tmp_path: Path) -> None:
    for i in range(11):
        put_frame(tmp_path / f"s_{i}.PNG")
    text = HEAD + FRAMES + "  - {kind: bright, exposure_s: 0.01, photons: 1000, files: 's_*.png'}\n"
    campaign = load_campaign(put_campaign(tmp_path, text))
    assert len(campaign.levels("bright")) == 1
    (stack,) = campaign.stacks("bright")
    assert [p.name for p in stack.paths] == [f"s_{i}.PNG" for i in range(11)]  # natural order, either case of the ending
    assert campaign.stacks("dark") == ()


def test_stacks_serve_as_levels_where_there_are_no_others(tmp_path: Path) -> None:
    for i in range(8):
        put_frame(tmp_path / f"s_{i}.png")
        put_frame(tmp_path / f"t_{i}.png")
    text = HEAD + DARK + "".join(f"  - {{kind: bright, exposure_s: {t}, files: {n}_*.png}}\n" for t, n in ((0.1, "s"), (0.2, "t")))
    campaign = load_campaign(put_campaign(tmp_path, text))
    assert len(campaign.levels("bright")) == len(campaign.stacks("bright")) == 2


def test_published_photons_from_irradiance() -> None:
    """EMVA 1288 gives the factor 50.34 for µm², ms, µm and µW/cm²; its four digits bound the error."""
    assert photons_from_irradiance(1.0, 1e-3, 1.0, 1000.0) == pytest.approx(50.34, abs=0.005)
    expected = 50.34 * (4.5 * 9.9) * 20.0 * 0.53 * 0.7
    assert photons_from_irradiance(0.7, 0.02, 4.5 * 9.9, 530.0) == pytest.approx(expected, rel=1e-4)


def test_irradiance_becomes_photons(tmp_path: Path) -> None:
    text = HEAD + "optics: {wavelength_nm: 500, irradiance_uw_per_cm2: 0.1}\n" + DARK + BRIGHT
    (bright,) = load_campaign(put_campaign(tmp_path, text)).levels("bright")
    assert bright.photons == pytest.approx(50.34 * 25 * 10 * 0.5 * 0.1, rel=1e-4)
    assert "add wavelength_nm" in refused(put_campaign(tmp_path, text.replace("wavelength_nm: 500, ", "")))
    assert "add pitch_um" in refused(put_campaign(tmp_path, text.replace("pitch_um: 5.0, ", "")))


def test_first_frame_must_fit_the_declared_bits(tmp_path: Path) -> None:
    manifest = put_campaign(tmp_path)
    put_frame(tmp_path / "d_0.png", 60, dtype="uint8")
    message = refused(manifest)
    assert "d_0.png: 8-bit file, but 12 bits are declared" in message
    assert "bits: 8" in message


def test_folder_must_hold_exactly_one_campaign(tmp_path: Path) -> None:
    assert "no campaign" in refused(tmp_path)
    assert "no such file or folder" in refused(tmp_path / "none")
    put_campaign(tmp_path)
    (tmp_path / "README.txt").write_text("This is no descriptor.\n", encoding="utf-8")
    (tmp_path / "lens.yaml").write_text("schema: other/1\n", encoding="utf-8")
    load_campaign(tmp_path)
    (tmp_path / "set.txt").write_text("v 3.0\nn 12 8 6\n", encoding="utf-8")
    message = refused(tmp_path)
    assert "several campaigns (campaign.yaml, set.txt)" in message


def test_inverse_write_then_load(tmp_path: Path) -> None:
    campaign = load_campaign(put_campaign(tmp_path, HEAD + "optics: {wavelength_nm: 530}\nnotes: by night\n" + FRAMES))
    write_manifest(campaign, tmp_path / "again.yaml")
    again = load_campaign(tmp_path / "again.yaml")
    assert dataclasses.replace(again, source_path=campaign.source_path) == campaign
    (tmp_path / "below").mkdir()
    with pytest.raises(InputError, match="outside the manifest's folder"):
        write_manifest(campaign, tmp_path / "below" / "campaign.yaml")


def test_example_is_the_whole_set() -> None:
    campaign = load_campaign()
    assert campaign.frame_shape == (60, 60)
    assert (campaign.bits, campaign.camera.sensor, campaign.frame_count) == (12, "ccd", 300)
    assert [len(campaign.levels(kind)) for kind in ("dark", "bright")] == [50, 50]
    assert {len(g.paths) for kind in ("dark", "bright") for g in campaign.levels(kind)} == {2}
    for kind in ("dark", "bright"):
        (stack,) = campaign.stacks(kind)
        assert (len(stack.paths), stack.exposure_s) == (50, 0.00516)
    first, last = campaign.levels("bright")[0], campaign.levels("bright")[-1]
    assert (first.exposure_s, first.photons, last.exposure_s, last.photons) == (40e-6, 120.0, 14.02e-3, 42137.0)
    assert "CC BY-SA 3.0" in campaign.licence
    assert "Marco Grimm" in campaign.licence
    licence = (EXAMPLE / "LICENSE").read_text(encoding="utf-8")
    assert "creativecommons.org/licenses/by-sa/3.0" in licence
    assert "Basler AG" in licence
    assert "cropped" in licence
    assert sum(p.stat().st_size for p in EXAMPLE.rglob("*") if p.is_file()) < 1e6


TOLD = """schema: pixmetry/campaign/1
camera:
  {name: cam, bits: 12, sensor: cmos, vendor: Maker, model: M 1, serial_number: '0815', sensor_cols: 100, sensor_rows: 80, first_col: 30,
   first_row: 20, lossless: true}
optics: {light_source: green LED}
operator: A. Tester
"""


def test_manifest_names_camera_sensor_light_and_operator(tmp_path: Path) -> None:
    campaign = load_campaign(put_campaign(tmp_path, TOLD + FRAMES))
    facts = campaign.camera
    assert (facts.vendor, facts.model, facts.serial_number, facts.lossless) == ("Maker", "M 1", "0815", True)
    assert (facts.sensor_shape, facts.first_col, facts.first_row) == ((80, 100), 30, 20)
    assert (campaign.optics.light_source, campaign.operator) == ("green LED", "A. Tester")
    write_manifest(campaign, tmp_path / "again.yaml")
    again = load_campaign(tmp_path / "again.yaml")
    assert (again.camera, again.optics, again.operator) == (facts, campaign.optics, campaign.operator)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sensor_rows: 80, ", "", ["sensor_cols and sensor_rows", "both or neither"]),
        ("first_row: 20, ", "", []),
        ("sensor_cols: 100, sensor_rows: 80, ", "", ["no size of the sensor"]),
        ("first_col: 30", "first_col: 95", ["do not lie on the sensor", "8 x 6 pixels from (95, 20)", "100 x 80"]),
        ("lossless: true", "lossless: rather", ["lossless"]),
        ("'0815'", "0815", ["camera.serial_number", "quotes"]),
    ],
)
def test_a_window_must_lie_on_its_sensor(old: str, new: str, words: list[str], tmp_path: Path) -> None:
    text = TOLD.replace(old, new).replace("\n   first_row: 20,", "\n   ") if "first_row" in old else TOLD.replace(old, new)
    with pytest.raises(InputError) as caught:
        load_campaign(put_campaign(tmp_path, text + FRAMES))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("stated", "expected"), [("", (True, "proven")), (", lossless: true", (True, "stated")), (", lossless: false", (False, "stated"))]
)
def test_storage_is_told_by_the_files_and_the_manifest_goes_beyond_them(stated: str, expected: tuple[bool, str], tmp_path: Path) -> None:
    campaign = load_campaign(put_campaign(tmp_path, HEAD.replace("sensor: cmos", f"sensor: cmos{stated}") + FRAMES))
    reader = FrameReader(campaign)
    assert reader.storage.known == ("stated" if stated else "unknown")
    for group in campaign.groups:
        list(reader.frames(group))
    assert (reader.storage.lossless, reader.storage.known) == expected
