"""Folders as cameras and people leave them: what is drafted of each, and what is asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from pixmetry import assess
from pixmetry.assess.draft import draft_campaign, prospects, write_draft
from pixmetry.core.errors import InputError
from pixmetry.files import load_campaign
from pixmetry.files.told import told_by_file, told_by_name

SHAPE = (96, 128)
BLACK, GAIN, PER_S = 64.0, 0.1, 1.5e6  # DN, DN/e, e/s


def field(rng: np.random.Generator, exposure_s: float, light: float = 1.0, shape: tuple[int, int] = SHAPE, bits: int = 12) -> np.ndarray:
    """A frame of an even field with shading, shot noise and read noise, or with no light a dark one."""
    y, x = np.indices(shape)
    shading = 1 - 0.1 * ((x / shape[1] - 0.5) ** 2 + (y / shape[0] - 0.5) ** 2)
    electrons = rng.poisson(light * PER_S * exposure_s * shading) + rng.normal(0, 12, shape)
    return np.clip(np.rint(BLACK + GAIN * electrons), 0, 2**bits - 1).astype(np.uint16)


def scene(rng: np.random.Generator, light: np.ndarray) -> np.ndarray:
    """A frame of a scene, light from 0 to 1, at 70 % of saturation."""
    return np.clip(np.rint(BLACK + GAIN * (rng.poisson(28000 * light) + rng.normal(0, 12, light.shape))), 0, 4095).astype(np.uint16)


def edge(shape: tuple[int, int] = (160, 200)) -> np.ndarray:
    y, x = np.indices(shape)
    return 0.1 + 0.8 / (1 + np.exp(-((x - 95) + 0.09 * (y - 80)) / 0.6))


def dots(shift: float = 0.0, shape: tuple[int, int] = (160, 200)) -> np.ndarray:
    y, x = np.indices(shape)
    light = np.full(shape, 0.05)
    for row in range(25, 150, 35):
        for col in range(25, 190, 35):
            light += 0.8 / (1 + np.exp((np.hypot(x - col - shift, y - row) - 5) / 0.5))
    return light


def chessboard(turn: float, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    y, x = np.indices(shape)
    u, v = (x - 160) * np.cos(turn) + (y - 120) * np.sin(turn), (y - 120) * np.cos(turn) - (x - 160) * np.sin(turn)
    inside = (np.abs(u) < 100) & (np.abs(v) < 75)
    return np.where(inside & ((np.floor(u / 25) + np.floor(v / 25)) % 2 == 0), 0.1, 0.9)


def by_kind(found: object) -> dict[str, list[float | None]]:
    kinds: dict[str, list[float | None]] = {}
    for group in found.groups:  # type: ignore[attr-defined]
        kinds.setdefault(group.kind, []).append(group.exposure_s)
    return {kind: sorted(values, key=lambda v: v or 0.0) for kind, values in kinds.items()}


def test_names_with_kinds_and_exposures(rng: np.random.Generator, tmp_path: Path) -> None:
    """The usual photon-transfer folder: two frames a level, everything in the names, and files beside it that are no frames."""
    times = (1, 2.5, 5, 10)
    for ms in times:
        for k in range(2):
            tifffile.imwrite(tmp_path / f"dark_{ms}ms_{k}.tif", field(rng, ms / 1e3, 0.0))
            tifffile.imwrite(tmp_path / f"bright_{ms}ms_{k}.tif", field(rng, ms / 1e3))
    (tmp_path / "notes.txt").write_text("lens cap")
    (tmp_path / "._dark_1ms_0.tif").write_bytes(b"not an image")
    found = draft_campaign(tmp_path)
    assert found.questions == () and found.left_out == ()
    wanted = [pytest.approx(ms / 1e3) for ms in times]
    assert by_kind(found) == {"dark": wanted, "bright": wanted}
    assert found.camera.bits == 12 and any("12" in text for text in found.assumed)
    campaign = load_campaign(write_draft(found))
    assert [(g.kind, g.exposure_s, len(g.paths)) for g in campaign.groups] == [(k, ms / 1e3, 2) for k in ("dark", "bright") for ms in times]
    assert load_campaign(tmp_path).groups == campaign.groups
    with pytest.raises(InputError, match="exists"):
        write_draft(found)


def test_a_vendors_names_without_kinds(rng: np.random.Generator, tmp_path: Path) -> None:
    """Only serial number, exposure and counter in the name: the pixels tell dark from bright."""
    for folder, light in (("run1", 0.0), ("run2", 1.0)):
        (tmp_path / folder).mkdir()
        for us in (2500, 10000):
            for k in range(3):
                Image.fromarray(field(rng, us * 1e-6, light)).save(tmp_path / folder / f"acA2440-75um_23456789_exp{us}us_{k:04d}.png")
    found = draft_campaign(tmp_path)
    assert by_kind(found) == {"dark": [0.0025, 0.01], "bright": [0.0025, 0.01]} and not found.questions


def test_stacks_without_exposures_ask_for_them(rng: np.random.Generator, tmp_path: Path) -> None:
    """One file of many pages for a condition: kinds by their names; the exposures are asked, and nothing else."""
    for name, light in (("dark", 0.0), ("flat", 1.0)):
        tifffile.imwrite(tmp_path / f"{name}.tif", np.stack([field(rng, 0.01, light) for _ in range(9)]))
    found = draft_campaign(tmp_path)
    assert [q.key for q in found.questions] == ["g1.exposure_s", "g2.exposure_s"]
    with pytest.raises(InputError, match=r"g1\.exposure_s"):
        found.campaign()
    campaign = draft_campaign(tmp_path, {"g1.exposure_s": "0.01", "g2.exposure_s": "0.01", "name": "line 3"}).campaign()
    assert [(g.kind, g.role, len(g.paths)) for g in campaign.groups] == [("dark", "stack", 9), ("bright", "stack", 9)]
    assert campaign.camera.name == "line 3"


def test_everything_in_one_folder_by_number(rng: np.random.Generator, tmp_path: Path) -> None:
    """Frames by counter alone, dark and three levels of light in pairs: split where the light jumps."""
    for k, light in enumerate((0, 0, 0.1, 0.1, 0.4, 0.4, 0.9, 0.9)):
        tifffile.imwrite(tmp_path / f"img{k + 8}.tif", field(rng, 0.02, light))
    found = draft_campaign(tmp_path)
    assert [(g.kind, [int(p.stem[3:]) for p in g.paths]) for g in found.groups] == [
        ("dark", [8, 9]),
        ("bright", [10, 11]),
        ("bright", [12, 13]),
        ("bright", [14, 15]),
    ]
    assert {q.key for q in found.questions} == {f"g{k}.exposure_s" for k in range(1, 5)}


def test_bare_numbers_ask_for_their_unit(rng: np.random.Generator, tmp_path: Path) -> None:
    for us in (2000, 8000):
        for kind, light in (("dark", 0.0), ("light", 1.0)):
            for k in range(2):
                tifffile.imwrite(tmp_path / f"{kind}_exposure_{us}_{k}.tif", field(rng, us * 1e-6, light))
    assert [q.key for q in draft_campaign(tmp_path).questions] == ["exposure_unit"]
    assert by_kind(draft_campaign(tmp_path, {"exposure_unit": "us"})) == {"dark": [0.002, 0.008], "bright": [0.002, 0.008]}


def test_a_calibration_board_is_no_campaign(rng: np.random.Generator, tmp_path: Path) -> None:
    for k in range(3):
        Image.fromarray((scene(rng, chessboard(0.1 * k)) >> 4).astype(np.uint8)).save(tmp_path / f"IMG_{k:04d}.jpg", quality=95)
    found = draft_campaign(tmp_path)
    assert [g.kind for g in found.groups] == ["board"] and not found.questions
    with pytest.raises(InputError, match="pixmetry calibrate"):
        found.campaign()


def test_light_that_was_changed_at_one_exposure(rng: np.random.Generator, tmp_path: Path) -> None:
    """Two levels of light at one exposure, no dark frames: nothing tells the light, and the campaign says what is missing."""
    for k, light in enumerate((0.3, 0.3, 0.9, 0.9)):
        tifffile.imwrite(tmp_path / f"flat_{'low' if k < 2 else 'high'}_20ms_{k}.tif", field(rng, 0.02, light))
    found = draft_campaign(tmp_path)
    assert [q.key for q in found.questions] == ["g1.photons", "g2.photons"]
    campaign = draft_campaign(tmp_path, {"g1.photons": "52000", "g2.photons": "17000"}).campaign()
    assert {g.kind for g in campaign.groups} == {"bright"} and any("no dark frames" in note for note in campaign.findings)
    assert [g.photons for g in campaign.groups] == [17000, 52000]
    assert len(draft_campaign(tmp_path, {"g1.kind": "none"}).campaign().groups) == 1


def test_fits_headers(rng: np.random.Generator, tmp_path: Path) -> None:
    """What a FITS header tells: type, exposure, temperature, pitch, camera."""

    def write(name: str, data: np.ndarray, kind: str, seconds: float) -> None:
        cards = {"SIMPLE": "T", "BITPIX": "16", "NAXIS": "2", "NAXIS1": str(data.shape[1]), "NAXIS2": str(data.shape[0])}
        cards |= {"BZERO": "32768", "EXPTIME": str(seconds), "CCD-TEMP": "-10.5", "XPIXSZ": "4.63"}
        cards |= {"IMAGETYP": f"'{kind}'", "INSTRUME": "'ASI 294'", "DATE-OBS": "'2026-03-01T21:00:00.25'"}
        header = "".join(f"{key:<8}= {value:>20}".ljust(80) for key, value in cards.items()) + "END".ljust(80)
        raw = (data.astype(np.int32) - 32768).astype(">i2").tobytes()
        size = -(-len(raw) // 2880) * 2880
        (tmp_path / name).write_bytes(header.ljust(-(-len(header) // 2880) * 2880).encode() + raw.ljust(size, b"\0"))

    for k in range(2):
        write(f"a{k}.fits", field(rng, 0.0, 0.0), "Dark Frame", 2.0)
        write(f"b{k}.fits", field(rng, 0.01), "Flat Field", 2.0)
    found = draft_campaign(tmp_path)
    assert by_kind(found) == {"dark": [2.0], "bright": [2.0]}
    assert (found.camera.name, found.camera.temperature_c, found.camera.pitch_x_um) == ("ASI 294", -10.5, 4.63)
    assert found.groups[0].looks[0].told.taken_s == pytest.approx(told_by_file(tmp_path / "b0.fits").taken_s)


def test_edges_are_seen(rng: np.random.Generator, tmp_path: Path) -> None:
    """A picture with an edge among flats; its time comes from the tag."""
    tags = [(33434, "2I", 1, (1, 250), True)]
    for k in range(2):
        tifffile.imwrite(tmp_path / f"p{k}.tif", scene(rng, edge()), extratags=tags)
    found = draft_campaign(tmp_path)
    assert by_kind(found) == {"edge": [0.004]} and not found.questions
    now, later = prospects({"edge"})
    assert [p.set_up.kind for p in now] == ["edge"] and later[0].set_up.kind == "flat"


def test_a_field_at_rest_is_a_series_and_a_moving_one_is_asked(rng: np.random.Generator, tmp_path: Path) -> None:
    for name, step in (("still", 0.0), ("other", 7.0)):
        (tmp_path / name).mkdir()
        for k in range(10):
            tifffile.imwrite(tmp_path / name / f"f{k:02d}.tif", scene(rng, dots(step * k)))
    found = draft_campaign(tmp_path)
    assert {g.paths[0].parent.name: g.kind for g in found.groups} == {"still": "series", "other": ""}
    (question,) = found.questions
    answered = draft_campaign(tmp_path, {question.key: "motion"})
    assert {g.kind for g in answered.campaign().groups} == {"series", "motion"}


def test_what_cannot_be_listed_is_told(rng: np.random.Generator, tmp_path: Path) -> None:
    """Colour pictures, another size, JPEG flats, values with fractions and a damaged file."""
    for k in range(2):
        for name, light in (("dark", 0.0), ("flat", 1.0)):
            tifffile.imwrite(tmp_path / f"{name}_5ms_{k}.tif", field(rng, 0.005, light))
    tifffile.imwrite(tmp_path / "dark_9ms_0.tif", field(rng, 0.009, 0.0, (64, 64)))
    tifffile.imwrite(tmp_path / "mean.tif", np.ones(SHAPE, np.float32))
    Image.fromarray(np.zeros((*SHAPE, 3), np.uint8)).save(tmp_path / "view.png")
    (tmp_path / "cut.tif").write_bytes((tmp_path / "flat_5ms_0.tif").read_bytes()[:4000])
    found = draft_campaign(tmp_path)
    assert by_kind(found) == {"dark": [0.005], "bright": [0.005]} and not found.questions
    told = " ".join(found.left_out)
    assert all(text in told for text in ("cut.tif", "colour", "fractions", "64 x 64")), told


@pytest.mark.parametrize("answers", [{"g1.kind": "flat"}, {"bits": "many"}, {"g9.kind": "dark"}, {"sensor": "film"}])
def test_answers_that_do_not_fit(rng: np.random.Generator, tmp_path: Path, answers: dict[str, str]) -> None:
    tifffile.imwrite(tmp_path / "dark_1ms.tif", field(rng, 0.001, 0.0))
    with pytest.raises(InputError):
        draft_campaign(tmp_path, answers)


def test_values_shifted_to_the_left_and_a_name_that_is_wrong(rng: np.random.Generator, tmp_path: Path) -> None:
    for k in range(2):
        tifffile.imwrite(tmp_path / f"dark_5ms_{k}.tif", field(rng, 0.005) << 4)
        tifffile.imwrite(tmp_path / f"a_5ms_{k}.tif", field(rng, 0.002) << 4)
        tifffile.imwrite(tmp_path / f"b_5ms_{k}.tif", np.maximum(field(rng, 0.0, 0.0), 1) << 4)
    tifffile.imwrite(tmp_path / "b_5ms_2.tif", np.full(SHAPE, 4095, np.uint16) << 4)
    found = draft_campaign(tmp_path)
    assert found.camera.bits == 16 and any("shifted" in text for text in found.assumed)
    assert any("named dark" in text for text in found.assumed)


@pytest.mark.parametrize(
    ("name", "exposure_s", "unitless"),
    [
        ("dark_0.5ms_1.tif", 0.0005, None),
        ("exp_12,5 ms/flat1.png", 0.0125, None),
        ("t=0.02s_003.tif", 0.02, None),
        ("cam2_500us.tif", 0.0005, None),
        ("IMG_20260301_101500.tif", None, None),
        ("flat_exptime100_2.tif", None, 100.0),
        ("5msc.tif", None, None),
        ("class3_s2.tif", None, None),
    ],
)
def test_exposures_in_names(name: str, exposure_s: float | None, unitless: float | None) -> None:
    told = told_by_name(name)
    assert (told.exposure_s, told.unitless) == (exposure_s, unitless)


def test_assess_drafts_where_there_is_no_manifest(rng: np.random.Generator, tmp_path: Path) -> None:
    """A folder of nothing but frames is assessed; the results tell what was assumed. Where something is missing it is asked."""
    shots = tmp_path / "shots"
    shots.mkdir()
    for ms in (1, 3, 6, 10, 14, 18):
        for name, light in (("dark", 0.0), ("bright", 1.0)):
            for k in range(2):
                tifffile.imwrite(shots / f"{name}_{ms}ms_{k}.tif", field(rng, ms / 1e3, light))
    found = assess(shots, tmp_path / "out", trials=0)
    assert found.estimates["electronics.gain"]["gain_dn_per_e"].value == pytest.approx(GAIN, rel=0.05)
    assert any("drafted" in note for note in found.observations.notes)
    assert not (shots / "campaign.yaml").exists()
    tifffile.imwrite(shots / "odd.tif", field(rng, 0.01))
    with pytest.raises(InputError, match="pixmetry init"):
        assess(shots, tmp_path / "out", trials=0)
