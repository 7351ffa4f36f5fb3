"""Regions of interest, masks, given places and limits choose targets, and change nothing of those that they choose."""

from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from click.testing import CliRunner

from locate import rendered
from pixmetry import locate
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.locate.files import locate_files
from pixmetry.locate.records import Located

NOISE = "read=1.5"


@pytest.fixture
def frame(rng: np.random.Generator) -> np.ndarray:
    return rendered.expose(rendered.discs_frame(rng, shape=(240, 320), count=60)[0], rng, read_dn=1.5)


def assert_rows(part: Located, whole: Located, which: np.ndarray) -> None:
    for name in ("x_px", "y_px", "var_x_px2", "radius_px", "flags"):
        np.testing.assert_array_equal(part[name], whole[name][which])


def test_a_mask_and_limits_choose_rows(frame: np.ndarray) -> None:
    whole = locate(frame, estimator="template")
    mask = np.zeros(frame.shape, bool)
    mask[:120, 50:] = True
    there = mask[np.rint(whole.y_px).astype(int), np.rint(whole.x_px).astype(int)]
    part = locate(frame, estimator="template", mask=mask)
    assert_rows(part, whole, there)
    assert np.count_nonzero(part.left_out.reason == "outside the mask") == np.count_nonzero(~there)
    small = locate(frame, estimator="template", diameter_px=(0, 10), contrast_dn=(100, 300))
    assert 0 < len(small) < len(whole)
    assert small.radius_px.max() < 5.3
    assert len(locate(frame, contrast_dn=(200, 300))) == 0
    assert set(locate(frame, contrast_dn=(200, 300)).left_out.reason) == {"contrast lower or higher than asked for"}


def test_given_places_are_the_rows(frame: np.ndarray, rng: np.random.Generator) -> None:
    """In their order; a place without a target is left out, and of two places at one target the nearer one has it."""
    whole = locate(frame, estimator="template")
    which = rng.permutation(len(whole))[:20]
    places = np.column_stack([whole.x_px, whole.y_px])[which] + rng.uniform(-1, 1, (20, 2))
    assert_rows(locate(frame, estimator="template", places_px=places), whole, which)
    free = np.argwhere(
        np.hypot(*(np.indices(frame.shape)[::-1, :, :, None] - np.stack([whole.x_px, whole.y_px])[:, None, None])).min(-1) > 13
    )
    more = np.vstack([free[0][::-1], places, places[:1] + 2.5])
    found = locate(frame, estimator="template", places_px=more)
    assert_rows(found, whole, which)
    assert found.place.tolist() == list(range(1, 21))
    assert np.count_nonzero(found.left_out.reason == "no target at a given place") == 2


def test_regions_of_interest_are_crops(frame: np.ndarray) -> None:
    """What is found in a region is what is found in its crop; two that overlap find a target once."""
    whole = locate(frame, noise=NOISE, estimator="template")
    part = locate(frame, noise=NOISE, estimator="template", rois=[(20, 30, 100, 150), (20, 100, 100, 150)])
    inside = (whole.y_px > 32) & (whole.y_px < 108) & (whole.x_px > 42) & (whole.x_px < 238)
    assert np.count_nonzero(inside) <= len(part) <= len(whole)
    for x, y, u in zip(whole.x_px[inside], whole.y_px[inside], np.sqrt(whole.var_x_px2[inside]), strict=True):
        away = np.hypot(part.x_px - x, part.y_px - y)
        assert np.count_nonzero(away < 2) == 1
        assert away.min() < 2 * u
    cut = part.left_out.reason == "cut by the border of a region of interest"
    assert np.hypot(part.left_out.x_px[cut][:, None] - part.x_px, part.left_out.y_px[cut][:, None] - part.y_px).min() > 2  # no row
    assert (part.y_px > 22).all()
    assert (part.y_px < 118).all()
    assert not (part.flags & 1).any()


def test_a_higher_threshold_leaves_faint_targets(rng: np.random.Generator) -> None:
    mean = rendered.discs_frame(rng, shape=(200, 200), count=12, amplitude=12.0)[0]
    frame = rendered.expose(mean, rng, read_dn=1.5)
    assert len(locate(frame)) == 12
    assert len(locate(frame, threshold_sigma=12.0)) == 0


def test_bad_limits_are_refused(frame: np.ndarray) -> None:
    for wrong in (
        {"rois": [(0, 0, 241, 10)]}, {"rois": [(0, 0, 10)]}, {"rois": [(0.5, 0, 10, 10)]}, {"mask": np.ones((3, 3), bool)},
        {"places_px": [[1.0, np.nan]]}, {"places_px": [1.0, 2.0]}, {"diameter_px": (5, 3)}, {"contrast_dn": (-1, 3)},
        {"threshold_sigma": 0.0}, {"kind": "line", "diameter_px": (1, 2)}, {"diameter_px": 5}, {"threshold_sigma": "4"},
        {"rois": [(np.inf, 0, 3, 3)]}, {"rois": [(np.nan, 0, 3, 3)]}, {"rois": (0, 0, 10, 10)}, {"places_px": [("a", "b")]},
        {"places_px": [(1.0,), (2.0, 3.0)]}, {"mask": np.ones((240, 320))},
    ):  # fmt: skip
        with pytest.raises(InputError):
            locate(frame, **wrong)


def test_command_reads_them(frame: np.ndarray, tmp_path: Path) -> None:
    image, mask = tmp_path / "frame.png", tmp_path / "mask.png"
    image.write_bytes(imagecodecs.png_encode(frame))
    mask.write_bytes(imagecodecs.png_encode(np.pad(np.full((120, 320), 255, np.uint8), ((0, 120), (0, 0)))))
    whole = locate(frame)
    first = locate_files([image], tmp_path / "first.csv", mask=mask)
    assert 0 < len(first) < len(whole)
    again = tmp_path / "again.csv"
    command = [
        "locate",
        str(image),
        "-o",
        str(again),
        "--places",
        str(tmp_path / "first.csv"),
        "--diameter",
        "1,30",
        "--contrast",
        "50,255",
    ]
    result = CliRunner().invoke(main, [*command, "--roi", "0,0,240,320"])
    assert result.exit_code == 0, result.output
    assert f"{len(first)} found" in result.output
    assert CliRunner().invoke(main, [*command, "--roi", "1,2,3"]).exit_code == 2
    (tmp_path / "bad.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match="not a table of places"):
        locate_files([image], places_px=tmp_path / "bad.csv")
