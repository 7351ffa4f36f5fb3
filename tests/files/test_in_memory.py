"""Frames in memory, in stacks, and without a header give what the same frames give in files of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from pixmetry import Frames, assess, campaign_of_arrays, emva1288
from pixmetry.assess.job import observe_campaign
from pixmetry.core.errors import InputError
from pixmetry.emva.planning.preflight import preflight_campaign
from pixmetry.files import EXAMPLE, Campaign, load_campaign, read_frame, write_manifest


def example() -> list[Frames]:
    groups = load_campaign(EXAMPLE).groups
    return [Frames(g.kind, g.exposure_s, np.stack([read_frame(p) for p in g.paths]), g.photons or None, g.role) for g in groups]


def numbers(campaign: Campaign) -> tuple[dict[str, str], str]:
    """What the photon transfer says, and how the frames were stored."""
    _, seen = observe_campaign(campaign, lambda what, done, of: None)
    fit = {e.name: repr((e.value, e.u)) for e in seen.photon_transfer_fit}
    return fit | {"map": repr(float(seen.dark_stack.mean_map_dn[3, 5]))}, seen.storage.known


def test_arrays_stacks_and_raw_values_give_what_single_files_give(tmp_path: Path) -> None:
    expected, _ = numbers(load_campaign(EXAMPLE))
    arrays = campaign_of_arrays(example(), bits=12, sensor="ccd", vendor="Basler")
    assert numbers(arrays) == (expected, "unknown") and arrays.files == ()
    lines = []
    for k, group in enumerate(example()):
        head = f"  - {{kind: {group.kind}, exposure_s: {group.exposure_s!r}, role: {group.role}"
        lines.append(f"{head}, photons: {group.photons!r}, files: s{k}.*}}" if group.photons else f"{head}, files: s{k}.*}}")
        tifffile.imwrite(tmp_path / f"s{k}.tif", group.data, photometric="minisblack")
        pairs = group.data.astype(np.uint16).reshape(-1, 2)
        three = np.stack([pairs[:, 0] & 255, pairs[:, 0] >> 8 | (pairs[:, 1] & 15) << 4, pairs[:, 1] >> 4], 1)
        (tmp_path / "raw").mkdir(exist_ok=True)
        (tmp_path / "raw" / f"s{k}.raw").write_bytes(three.astype(np.uint8).tobytes())
    text = "schema: pixmetry/campaign/1\ncamera: {name: x, bits: 12, sensor: ccd}\nframes:\n" + "\n".join(lines) + "\n"
    (tmp_path / "campaign.yaml").write_text(text)
    (tmp_path / "raw" / "campaign.yaml").write_text(text + "raw: {width: 60, height: 60, pixel_format: Mono12p}\n")
    for folder in (tmp_path, tmp_path / "raw"):
        campaign = load_campaign(folder)
        assert numbers(campaign) == (expected, "proven")
        assert len(campaign.files) == 1 + len(campaign.groups)  # a result must not be written over one of them
    write_manifest(campaign, tmp_path / "raw" / "again.yaml")
    assert load_campaign(tmp_path / "raw" / "again.yaml").groups == campaign.groups
    looked = [preflight_campaign(c)["mono"] for c in (arrays, load_campaign(tmp_path))]
    assert looked[0].verdict == looked[1].verdict


def test_arrays_are_assessed_and_tested() -> None:
    campaign = campaign_of_arrays(example(), bits=12, sensor="ccd", lossless=True)
    expected = assess(load_campaign(EXAMPLE), trials=0)
    found = assess(campaign, trials=0)
    assert found.budget.verdict.total_px == expected.budget.verdict.total_px
    assert found.observations.storage.lossless is True and found.to_record()["conditions"]["lossless_known"] == "stated"
    values = {key: repr(value.value) for key, value in emva1288(campaign).results[0].values.items()}
    assert values == {key: repr(value.value) for key, value in emva1288(EXAMPLE).results[0].values.items()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda g: g[0].data, ["not frames of one condition", "Frames(kind, exposure_s, data)"]),
        (lambda g: Frames("dark", 0.1, g[0].data[0]), ["not a stack", "(60, 60)"]),
        (lambda g: Frames("dark", 0.1, g[0].data.astype(float)), ["float64"]),
        (lambda g: Frames("dark", 0.1, g[0].data[:, :10]), ["several sizes"]),
        (lambda g: Frames("dim", 0.1, g[0].data), ["kind"]),
        (lambda g: Frames("dark", -0.1, g[0].data), ["exposure_s"]),
        (lambda g: Frames("dark", 0.1, g[0].data, photons=5), ["dark group has light"]),
        (lambda g: Frames("dark", 0.1, g[0].data[:, :0]), ["without pixels"]),
        (lambda g: Frames("dark", 0.1, g[0].data[:0]), ["no frames"]),
    ],
)
def test_what_is_no_campaign_is_refused(change: object, words: list[str]) -> None:
    groups = example()
    with pytest.raises(InputError) as caught:
        campaign_of_arrays([change(groups), *groups], bits=12)
    for word in words:
        assert word in str(caught.value)


def test_values_must_be_those_of_frames() -> None:
    groups = example()
    for wrong, word in ((-1, "-1 to"), (70000, "to 70000"), (4096, "12 bits")):
        data = groups[0].data.astype(np.int64)
        data[1, 3, 3] = wrong
        campaign = campaign_of_arrays([Frames(groups[0].kind, groups[0].exposure_s, list(data), role=groups[0].role), *groups[1:]], bits=12)
        with pytest.raises(InputError, match=word):
            assess(campaign, trials=0)
    with pytest.raises(InputError, match="unknown key 'bitz'"):
        campaign_of_arrays(groups, bitz=12)


def test_irradiance_becomes_photons() -> None:
    data = np.zeros((2, 4, 5), np.uint8)
    groups = [Frames("dark", 0.01, data), Frames("bright", 0.01, data), Frames("bright", 0.02, data, photons=7.0)]
    light = {"irradiance_uw_per_cm2": 1.0, "wavelength_nm": 500}
    campaign = campaign_of_arrays(groups, optics=light, bits=8, pitch_um=10)
    # 50.34 A[µm²] t[ms] λ[µm] E[µW/cm²] (EMVA 1288 R4.0)
    assert [g.photons for g in campaign.groups] == [0.0, pytest.approx(50.34 * 100 * 10 * 0.5, rel=1e-4), 7.0]
    with pytest.raises(InputError, match="pitch_um"):
        campaign_of_arrays(groups, optics=light, bits=8)


@pytest.mark.parametrize("job", [assess, emva1288])
def test_arrays_alone_are_told_how_they_become_a_campaign(job: object) -> None:
    for given in ([np.zeros((4, 5), np.uint8)], np.zeros((2, 4, 5)), 3):
        with pytest.raises(InputError, match="campaign_of_arrays"):
            job(given)
