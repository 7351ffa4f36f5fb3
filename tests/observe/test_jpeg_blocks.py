"""Quality of JPEG from files that Pillow wrote, and blind from frames that were decoded; frames of no coder tell none."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pixmetry import Frames, assess, campaign_of_arrays, load_campaign
from pixmetry.assess.job import measure_sources, observe_campaign
from pixmetry.camera.jpeg_tables import equivalent_quality, steps
from pixmetry.core.errors import InputError
from pixmetry.core.progress import no_progress
from pixmetry.files.jpeg import luminance_table
from pixmetry.observe.jpeg_blocks import stored_blocks


def texture(rng: np.random.Generator, shape=(128, 160), noise=3.0) -> np.ndarray:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    values = 120 + 40 * np.sin(x / 7.3) * np.cos(y / 11.1) + 30 * ((x // 37 + y // 29) % 2)
    return np.clip(np.rint(values + noise * rng.standard_normal(shape)), 0, 255).astype(np.uint8)


def coded(image: np.ndarray, quality: int, **kw) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, "JPEG", quality=quality, **kw)
    return out.getvalue()


def decoded(raw: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(raw)))


@pytest.mark.parametrize("quality", [10, 25, 40, 50, 63, 75, 85, 90, 93, 95, 96, 97, 98, 99, 100])
def test_foreign_quality_is_found_blind_from_decoded_frames(quality: int, rng: np.random.Generator):
    """Pillow (libjpeg-turbo). The largest log-likelihood ratio by chance is about ln of the number of tables, 5; at least 20 is asked."""
    found = stored_blocks([[decoded(coded(texture(rng), quality))]])
    assert found.fit["quality"].value == quality and found.fit["quality"].kind == "value"
    assert np.array_equal(found.table, steps(quality))


def test_part_of_a_coded_picture_tells_where_its_blocks_are(rng: np.random.Generator):
    found = stored_blocks([[decoded(coded(texture(rng, (150, 180)), 90))[3:, 6:]]])
    assert found.fit["quality"].value == 90 and found.offset == (5, 2)


@pytest.mark.parametrize("noise", [0.7, 3.0, 12.0])
def test_frames_of_no_coder_tell_no_quality(noise: float, rng: np.random.Generator):
    for shape in ((128, 160), (131, 157)):
        assert "quality" not in stored_blocks([[texture(rng, shape, noise)]]).fit


@pytest.mark.parametrize("quality", range(1, 101))
def test_foreign_table_is_read_from_the_file_at_all_qualities(quality: int):
    """Pillow's own reader of the tables is the oracle; the standard's rule of scaling is met at each."""
    raw = coded(np.full((8, 8), 100, np.uint8), quality)
    table = np.array(luminance_table(raw)).reshape(8, 8)
    assert table.ravel().tolist() == list(Image.open(io.BytesIO(raw)).quantization[0])
    assert np.array_equal(table, steps(quality))


def test_foreign_table_of_another_maker_is_named_and_given_as_the_quality_that_is_alike(rng: np.random.Generator):
    table = np.clip(np.rint(2 + np.add.outer(np.arange(8), np.arange(8)) * 1.9), 1, 255).astype(int)
    raw = coded(texture(rng, (256, 256)), 75, qtables=[table.ravel().tolist()] * 2, subsampling=0)
    found = stored_blocks([[decoded(raw)]])
    quality = found.fit["quality"]
    assert "none of the Independent JPEG Group's" in quality.reason and quality.u >= 1
    table = np.array(Image.open(io.BytesIO(raw)).quantization[0]).reshape(8, 8)  # as Pillow scaled it
    told = found.table > 0
    assert told.sum() > 20 and np.mean(found.table[told] == table[told]) > 0.9
    assert abs(quality.value - equivalent_quality(table)[0]) <= 4 * quality.u


def test_flat_frames_and_frames_of_more_bits_are_refused_with_the_reason():
    flat = stored_blocks([[np.full((64, 64), 100, np.uint8)]])
    assert "not zero" in flat.fit.reasons["quality"]
    deep = stored_blocks([[np.full((64, 64), 1000, np.uint16)]], bits=12)
    assert "8 bits" in deep.fit.reasons["quality"]


def test_blocks_that_repeat_from_frame_to_frame_are_told(rng: np.random.Generator):
    first = texture(rng, noise=2.0)
    second = texture(rng, noise=2.0)
    plain = stored_blocks([[first, second]])
    assert plain.repeated_share == 0 and not plain.notes
    second[:64] = first[:64]
    skipped = stored_blocks([[first, second]])
    assert skipped.repeated_share == pytest.approx(0.5) and any("repeats them" in note for note in skipped.notes)


def test_jpeg_files_of_kind_pattern_are_read_and_measured(rng: np.random.Generator, tmp_path: Path):
    """Colour and grey; JPEG is still refused for frames from which noise is measured."""
    (tmp_path / "grey.jpg").write_bytes(coded(texture(rng), 85))
    colour = np.stack([texture(rng)] * 3, axis=2)
    (tmp_path / "colour.jpg").write_bytes(coded(colour, 85))
    head = "schema: pixmetry/campaign/1\ncamera: {name: one, bits: 8}\n"
    manifest = tmp_path / "campaign.yaml"
    manifest.write_text(head + "frames: [{kind: pattern, files: [grey.jpg, colour.jpg]}]\n")
    _, seen = observe_campaign(load_campaign(manifest), no_progress)
    estimates, _ = measure_sources(seen)
    quality = estimates["storage.jpeg"]["quality"]
    assert (quality.value, quality.u) == (85, 0) and "table" in quality.method
    assert seen.blocks is not None and seen.blocks.fit["quality"].value == 85
    manifest.write_text(head + "frames: [{kind: edge, files: [grey.jpg]}]\n")
    with pytest.raises(InputError, match="JPEG"):
        load_campaign(manifest)


def test_decoded_frames_reach_the_twin_the_page_and_the_record(rng: np.random.Generator, tmp_path: Path):
    frames = np.array([decoded(coded(texture(rng), 80)) for _ in range(2)])
    campaign = campaign_of_arrays([Frames("pattern", None, frames)], bits=8, name="sends JPEG")
    found = assess(campaign, tmp_path / "result", trials=0)
    assert found.estimates["storage.jpeg"]["quality"].value == 80
    assert found.camera["storage.jpeg"].params.quality == 80
    assert "comb of JPEG of quality 80" in (tmp_path / "result" / "report.html").read_text()
    assert found.to_record()["blocks"]["values"][0]["value"] == 80
