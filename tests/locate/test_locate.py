"""``pixmetry.locate`` and its command: what comes out for every kind of target and of bad input."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import pixmetry
from locate import rendered
from pixmetry.cli import main
from pixmetry.core.errors import InputError
from pixmetry.locate.centroids.operators import OPERATORS
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.estimators import AUTO, estimators, methods
from pixmetry.locate.frame import scale_ends
from pixmetry.locate.lines.lines import line_model
from pixmetry.locate.records import LOCATED_SCHEMA, ORIGIN, Located, joined

SHAPE = (120, 160)
Z_1E6 = 5.0  # |z| of the larger of a dozen coordinates, each beyond it with 6e-7


def frame_of(seed: int = 0, amplitude: float = 150.0, background: float = 20.0, bits: int = 8, read_dn: float = 1.5) -> tuple:
    """Six discs at random places, and where they are."""
    rng = np.random.default_rng(seed)
    x = np.array([20.0, 60, 110, 30, 75, 130]) + rng.uniform(-0.5, 0.5, 6)
    y = np.array([25.0, 30, 20, 85, 90, 80]) + rng.uniform(-0.5, 0.5, 6)
    radius = np.array([3.0, 5, 8, 4, 6, 7])
    images = []
    for place in zip(x, y, radius, strict=True):
        at = rendered.window(place[0], place[1], place[2] + 6, SHAPE)
        images.append((at, rendered.disc(*place, 0.7, at)))
    mean = rendered.planted(SHAPE, background, np.full(6, amplitude), images)
    return rendered.expose(mean, rng, read_dn=read_dn, bits=bits), x, y


def matched(table: pixmetry.locate.records.Located, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Errors over their standard deviations, shape (2, n); every target is found once."""
    assert len(table) == len(x)
    order = [int(np.argmin(np.hypot(table.x_px - a, table.y_px - b))) for a, b in zip(x, y, strict=True)]
    assert sorted(order) == list(range(len(x)))
    return np.array([(table.x_px[order] - x) / np.sqrt(table.var_x_px2[order]), (table.y_px[order] - y) / np.sqrt(table.var_y_px2[order])])


@pytest.mark.parametrize("estimator", [AUTO, *methods()])
@pytest.mark.parametrize("amplitude", [150.0, -150.0])
def test_every_estimator_finds_all_discs_within_its_own_uncertainty(estimator: str, amplitude: float) -> None:
    """Origin included: half a pixel would be 30 standard deviations or more."""
    frame, x, y = frame_of(amplitude=amplitude, background=20.0 if amplitude > 0 else 200.0)
    table = pixmetry.locate(frame, estimator=estimator)
    assert np.abs(matched(table, x, y)).max() < Z_1E6
    assert (np.sign(table.amplitude_dn) == np.sign(amplitude)).all()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32, np.float64, np.int32])
def test_every_type_of_grey_values(kind: type) -> None:
    frame, x, y = frame_of()
    assert np.abs(matched(pixmetry.locate(frame.astype(kind)), x, y)).max() < Z_1E6


def test_both_polarities_at_once_and_one_alone() -> None:
    bright, x, y = frame_of(background=100.0, amplitude=100.0)
    dark, _, _ = frame_of(background=100.0, amplitude=-80.0)
    frame = np.concatenate([bright, dark])
    assert pixmetry.locate(frame).images[0]["polarity"] == "both" and len(pixmetry.locate(frame)) == 12
    assert len(pixmetry.locate(frame, polarity="dark")) == 6 and (pixmetry.locate(frame, polarity="bright").y_px < 120).all()


def test_a_colder_image_has_the_same_positions() -> None:
    """Adding a constant and transposing change nothing but what they must."""
    frame, _, _ = frame_of()
    table, turned = pixmetry.locate(frame), pixmetry.locate(np.ascontiguousarray(frame.T))
    order = [int(np.argmin(np.hypot(turned.x_px - b, turned.y_px - a))) for a, b in zip(table.x_px, table.y_px, strict=True)]
    assert np.abs(turned.y_px[order] - table.x_px).max() < 1e-4 and np.abs(turned.x_px[order] - table.y_px).max() < 1e-4
    shifted = pixmetry.locate(frame + np.uint8(7))
    assert np.abs(shifted.x_px - table.x_px).max() < 1e-4


def test_any_number_of_threads_gives_the_same_bits() -> None:
    frame, _, _ = frame_of()
    one, two = (pixmetry.locate(frame, threads=n) for n in (1, 2))
    assert all(np.array_equal(one[name], two[name], equal_nan=one[name].dtype.kind == "f") for name in one.columns)


def test_a_saturated_top_is_flagged_and_unbiased() -> None:
    frame, x, y = frame_of(amplitude=400.0)
    table = pixmetry.locate(frame)
    assert all(int(f) & Flag.SATURATED for f in table.flags)
    assert np.abs(matched(table, x, y)).max() < Z_1E6 and np.sqrt(table.var_x_px2).max() < 0.02


def test_an_image_without_noise_is_not_taken_for_saturated() -> None:
    frame, x, y = frame_of(read_dn=1e-9)
    table = pixmetry.locate(frame)
    assert not (table.flags & Flag.SATURATED).any()
    assert np.hypot(table.x_px - table.x_px, 0).max() == 0 and np.abs(matched(table, x, y)).max() < Z_1E6


def test_the_top_of_twelve_bits_in_sixteen_is_seen() -> None:
    values = np.random.default_rng(1).normal(1000, 30, (200, 200)).round().clip(0, None).astype(np.uint16)
    values[50:80, 50:80] = 3000
    values[100:130, 20:60] = np.random.default_rng(2).normal(2990, 30, (30, 40)).round().clip(None, 3000)
    assert scale_ends(values, None, None) == (0.0, 3000.0)
    values[values == 3000] = np.random.default_rng(3).normal(3000, 30, int((values == 3000).sum())).round()
    assert scale_ends(values, None, None) == (0.0, np.inf) and scale_ends(values, 12, None) == (0.0, 4095.0)


def test_a_disc_that_the_border_cuts_is_told() -> None:
    frame, _, _ = frame_of()
    table = pixmetry.locate(frame[:, : int(frame.shape[1] - 29)])  # through the last disc
    cut = table.x_px > 125
    assert cut.sum() == 1 and all(int(f) & Flag.BORDER for f in table.flags[cut])


@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 45.0])
@pytest.mark.parametrize("size", [(20.0, 3.5), (24.0, 5.0), (60.0, 3.0)])
def test_short_and_thick_crosses_are_found_or_not_but_never_an_error(angle_deg: float, size: tuple[float, float]) -> None:
    at = rendered.window(50.3, 49.8, 48)
    arms = [rendered.bar(50.3, 49.8, angle_deg + turn, *size, 0.7, at) for turn in (0.0, 90.0)]
    mean = np.full((100, 100), 20.0)
    mean[at[0][0] : at[0][-1] + 1, at[1][0] : at[1][-1] + 1] += 150 * np.maximum(*arms)
    table = pixmetry.locate(rendered.expose(mean, np.random.default_rng(1), read_dn=1.5), kind="cross")
    good = [i for i in range(len(table)) if np.isfinite(table.var_x_px2[i])]
    assert all(np.hypot(table.x_px[i] - 50.3, table.y_px[i] - 49.8) < 0.1 for i in good)
    assert good or size[0] < 60


def test_coded_targets_are_told_apart_and_placed_as_well_as_others() -> None:
    """Sixteen of them, tilted by 45°; rings are no targets. (Rings near the discs pass for noise there: u is up to 2.5 times too large.)"""
    from locate.test_coded import drawn, view
    from pixmetry.locate.detect.coded import codes

    rng = np.random.default_rng(4)
    picture, x, y, numbers = np.zeros((320, 320)), [], [], rng.choice(codes(), 16, replace=False)
    for i, number in enumerate(numbers):
        row, col = divmod(i, 4)
        to_image, middle = np.eye(3), 40 + rng.uniform(-0.5, 0.5, 2)
        to_image[:2, 2] = middle
        part = slice(80 * row, 80 * row + 80), slice(80 * col, 80 * col + 80)
        picture[part] = drawn(int(number), to_image @ view(rng, 6.0, 45.0, near=1e-5)[0], (80, 80))
        x.append(80 * col + middle[0])
        y.append(80 * row + middle[1])
    frame = np.rint(20 + 170 * picture + rng.normal(0, 1.5, picture.shape)).clip(0, 255).astype(np.uint8)
    table = pixmetry.locate(frame, kind="coded")
    z = matched(table, np.array(x), np.array(y))
    assert np.abs(z).max() < Z_1E6
    assert sorted(table.code.tolist()) == sorted(numbers.tolist()) and table.code_margin.min() > 0.5


def test_an_estimator_that_is_asked_for_is_taken_and_auto_says_why() -> None:
    frame, _, _ = frame_of()
    assert set(pixmetry.locate(frame, estimator="centroid").estimator) == {"centroid"}
    assert "Cramér–Rao" in pixmetry.locate(frame).images[0]["reason"]


@pytest.mark.parametrize("kind", ["disc", "ellipse", "ring", "spot", "line", "edge", "cross", "coded"])
@pytest.mark.parametrize(
    "frame",
    [
        np.full((90, 100), 7, np.uint8),
        np.full((90, 100), 255, np.uint8),
        np.zeros((90, 100), np.uint16),
        np.full((90, 100), 0.25),
        np.array([[3]], np.uint8),
        np.array([[3, 200]], np.uint8),
        np.random.default_rng(5).normal(100, 3, (300, 300)).round().astype(np.uint8),
    ],
    ids=["constant", "saturated", "black", "constant float", "one pixel", "two pixels", "noise"],
)
def test_where_there_is_nothing_nothing_is_found(frame: np.ndarray, kind: str) -> None:
    table = pixmetry.locate(frame, kind=kind)
    assert len(table) == 0 and "no " in table.images[0]["reason"] and {"x_px", "var_x_px2", "flags"} <= set(table.columns)


@pytest.mark.parametrize("kind", ["line", "edge", "cross"])
def test_the_unit_of_the_grey_values_does_not_matter(kind: str) -> None:
    """A float frame of 0 … 1 is measured as one of 0 … 255: places to 1 % of the uncertainty, and the same uncertainty."""
    rows, cols = np.arange(120), np.arange(140)
    section = "edge" if kind == "edge" else "gaussian"
    shape = {"angle_deg": 15.0, "amplitude_dn": 120.0, "sigma_px": 1.1}
    frame = line_model(section, shape | {"background_dn": 30.0}, rows, cols, about=(70.2, 60.3))[0]
    if kind == "cross":
        frame = frame + line_model(section, shape | {"angle_deg": 100.0}, rows, cols, about=(70.2, 60.3))[0]
    frame = np.rint(frame + np.random.default_rng(3).normal(0, 1.5, frame.shape)).astype(np.float32)
    one, other = pixmetry.locate(frame, kind=kind), pixmetry.locate(frame / np.float32(255), kind=kind)
    assert len(one) == len(other) == 1
    u = np.sqrt(one.var_x_px2 + one.var_y_px2)
    assert np.hypot(one.x_px - other.x_px, one.y_px - other.y_px) < 1e-2 * u
    np.testing.assert_allclose(other.var_x_px2 + other.var_y_px2, u**2, rtol=1e-3)


def test_the_noise_of_a_chessboard_is_not_taken_from_its_edges() -> None:
    """Variances as with the known noise, to 15 % (the median χ²/dof of 56 corners scatters by 2 %); with the edges they are twice that."""

    def steps(n: int, first: float, square: float, count: int) -> np.ndarray:
        from scipy.special import erf

        places = first + square * np.arange(count)
        return (erf((np.arange(n)[:, None] - places) / (np.sqrt(2) * 0.8)) * (-1.0) ** np.arange(count)).sum(axis=1) - (count + 1) % 2

    frame = 120 + 60 * steps(180, 20.3, 23.0, 7)[:, None] * steps(220, 25.6, 24.0, 8)
    frame = np.clip(np.rint(frame + np.random.default_rng(8).normal(0, 2.0, frame.shape)), 0, 255).astype(np.uint8)
    known, seen = (pixmetry.locate(frame, kind="chessboard", grid=(8, 7), noise=noise) for noise in ("read=2", None))
    assert len(known) == len(seen) == 56
    assert 0.85 < np.median(seen.var_x_px2 / known.var_x_px2) < 1.15


def test_targets_without_a_place_are_left_out_and_told() -> None:
    """Small, faint discs on a noisy ground, which operators lose: no error, no number, no row, but a line with the reason."""
    rng = np.random.default_rng(1)
    frame = 20 + rng.normal(0, 1.5, (200, 200))
    y, x = np.indices(frame.shape)
    for _ in range(40):
        a, b = rng.uniform(5, 195, 2)
        frame[np.hypot(x - a, y - b) < rng.uniform(0.7, 9)] = rng.uniform(40, 250)
    frame = np.clip(frame, 0, 255).astype(np.uint8)
    tables = [pixmetry.locate(frame, kind="coded", estimator=name) for name in OPERATORS]
    assert all((table.code == -1).all() and np.isfinite(table.x_px + table.var_x_px2).all() for table in tables)
    lost = [table for table in tables if "the fit did not converge" in table.left_out.counted()]
    assert lost and all("× the fit did not converge" in table.images[0]["left_out"] for table in lost)


def test_what_has_another_shape_is_counted_and_in_every_file(tmp_path: Path) -> None:
    """A bar and a disc: the bar is no row, and JSON, CSV and Parquet say where it is and why it was left out."""
    import pyarrow.parquet

    frame = frame_of()[0]
    frame[3:7, 20:60] = 200
    table = pixmetry.locate(frame, name="one")
    lost = table.left_out
    assert len(lost) == 1 and (lost.x_px[0], lost.y_px[0]) == pytest.approx((39.5, 4.5), abs=0.5)
    assert lost.reason[0] == "not the shape of a disc" and lost.image[0] == "one" and lost.semi_major_px[0] > 15
    for ending in ("csv", "json", "parquet"):
        table.write(tmp_path / f"table.{ending}")
    assert "left_out: 1 × not the shape of a disc" in (tmp_path / "table.csv").read_text()
    (row,) = json.loads((tmp_path / "table.json").read_text())["left_out"]
    assert row["reason"] == "not the shape of a disc" and row["x_px"] == pytest.approx(lost.x_px[0])
    notes = pyarrow.parquet.read_metadata(tmp_path / "table.parquet").metadata
    assert json.loads(notes[b"left_out"]) == [row]
    both = joined([table, table])
    assert len(both.left_out) == 2 and len(both) == 2 * len(table)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (np.zeros((9, 9, 3), np.uint8), "colour"),
        (np.zeros((4, 9, 9), np.uint8), "not a grey image"),
        (np.zeros((0, 9)), "not a grey image"),
        (np.full((9, 9), np.nan), "81 pixels are not finite, the first in row 0, column 0"),
        (np.full((9, 9), 1e39), "too large"),
        (np.zeros((9, 9), complex), "real numbers"),
        (np.array([["a"]]), "real numbers"),
    ],
    ids=["rgb", "stack", "empty", "nan", "huge", "complex", "text"],
)
def test_frames_that_cannot_be_used(frame: np.ndarray, text: str) -> None:
    with pytest.raises(InputError, match=text):
        pixmetry.locate(frame)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"kind": "blot"}, "no such kind"),
        ({"estimator": "best"}, "no such estimator"),
        ({"kind": "edge", "estimator": "centroid"}, "no such estimator for kind edge"),
        ({"polarity": "grey"}, "polarity"),
        ({"kind": "chessboard"}, "size of the chessboard"),
        ({"kind": "chessboard", "grid": "9by6"}, "COLSxROWS"),
        ({"kind": "chessboard", "grid": "any"}, "COLSxROWS"),
        ({"kind": "line", "grid": "9x6"}, "no grid"),
        ({"kind": "line", "grid": "any"}, "no grid"),
        ({"bits": 0}, "bits"),
        ({"bits": 6}, "more bits"),
        ({"aperture_px": 2.0}, "aperture"),
        ({"light_on": "moon"}, "light"),
        ({"estimator": "centroid", "aperture_px": 0.5}, "without gaps"),
        ({"noise": "read=-1"}, "noise"),
        ({"noise": "loudness=1"}, "loudness"),
        ({"noise": "no_such_camera"}, "no such camera"),
    ],
)
def test_options_that_cannot_be_used(options: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        pixmetry.locate(frame_of()[0], **options)


# ---- the command ----------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from pixmetry.files import write_frame

    path = tmp_path_factory.mktemp("images") / "discs.png"
    write_frame(path, frame_of()[0], 8)
    return path


def run(*arguments: object) -> str:
    result = CliRunner().invoke(main, ["locate", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(*arguments: object) -> str:
    result = CliRunner().invoke(main, ["locate", *map(str, arguments)])
    assert result.exit_code == 2 and result.output.count("\n") == 1, result.output
    return result.output


def test_one_table_in_three_formats(image: Path, tmp_path: Path) -> None:
    import pyarrow.parquet

    for ending in ("csv", "json", "parquet"):
        run(image, "-o", tmp_path / f"table.{ending}")
    lines = (tmp_path / "table.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    record = json.loads((tmp_path / "table.json").read_text())
    table = pyarrow.parquet.read_table(tmp_path / "table.parquet")
    assert ORIGIN in lines[0] and record["origin"] == ORIGIN and table.schema.metadata[b"origin"].decode() == ORIGIN
    assert record["schema"] == LOCATED_SCHEMA and len(rows) == len(record["targets"]) == table.num_rows == 6
    for i in range(6):
        assert float(rows[i]["x_px"]) == pytest.approx(record["targets"][i]["x_px"], abs=1e-6) == table["x_px"][i].as_py()
    assert rows[0]["image"] == "discs.png" and rows[0]["noise_model"] == "image" and record["images"][0]["targets"] == 6


def test_the_table_goes_to_standard_output(image: Path) -> None:
    assert run(image).splitlines()[0].startswith("# pixmetry")


def test_several_images_and_their_pictures(image: Path, tmp_path: Path) -> None:
    from pixmetry.files import write_frame

    write_frame(tmp_path / "in" / "a.png" if (tmp_path / "in").mkdir() is None else "", frame_of(1)[0], 8)
    write_frame(tmp_path / "in" / "b.tif", frame_of(2)[0], 8)
    run(tmp_path / "in", image, "-o", tmp_path / "all.json", "--overlay", tmp_path / "found")
    record = json.loads((tmp_path / "all.json").read_text())
    assert [i["name"] for i in record["images"]] == ["a.png", "b.tif", "discs.png"] and len(record["targets"]) == 18
    pictures = sorted(p.name for p in (tmp_path / "found").iterdir())
    assert pictures == ["a-located.png", "b-located.png", "discs-located.png"]


def test_a_picture_shows_what_was_found(image: Path, tmp_path: Path) -> None:
    import imagecodecs

    run(image, "-o", tmp_path / "t.csv", "--overlay", tmp_path / "found.png")
    drawn = imagecodecs.png_decode((tmp_path / "found.png").read_bytes())[:, :, :3].astype(int)
    assert drawn.shape[0] > 120 and (np.abs(drawn - drawn.mean(axis=2, keepdims=True)).max(axis=2) > 60).sum() > 200  # coloured marks


def test_colour_and_jpeg_are_read(tmp_path: Path) -> None:
    import imagecodecs

    frame, x, y = frame_of()
    (tmp_path / "grey.jpg").write_bytes(imagecodecs.jpeg_encode(frame, level=95))
    (tmp_path / "colour.png").write_bytes(imagecodecs.png_encode(np.dstack([frame // 2, frame, 255 - frame])))
    run(tmp_path / "grey.jpg", "-o", tmp_path / "grey.json")
    assert "--channel" in refused(tmp_path / "colour.png", "-o", tmp_path / "t.json")
    run(tmp_path / "colour.png", "-o", tmp_path / "t.json", "--channel", "green")
    found = json.loads((tmp_path / "t.json").read_text())["targets"]
    assert len(found) == len(x) and min(abs(t["x_px"] - x[0]) for t in found) < 0.05


def test_what_cannot_be_written_is_refused_before_any_work(image: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("a,b\n1,2\n")
    assert "no result of this kind" in refused(image, "-o", tmp_path / "mine.csv")
    assert (tmp_path / "mine.csv").read_text() == "a,b\n1,2\n"
    assert "unknown ending" in refused(image, "-o", tmp_path / "table.xls")
    assert "one picture for several" in refused(image, image, "--overlay", tmp_path / "one.png")


def test_a_file_that_cannot_be_used_is_named_and_nothing_is_written(image: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "broken.png" in refused(image, tmp_path / "broken.png", "-o", tmp_path / "t.csv")
    assert "missing" in refused(tmp_path / "none.png", "-o", tmp_path / "t.csv") and not (tmp_path / "t.csv").exists()


def test_nothing_found_is_told_by_the_exit_status_and_the_table_is_written(image: Path, tmp_path: Path) -> None:
    from pixmetry.files import write_frame

    empty = np.clip(np.rint(np.random.default_rng(0).normal(20, 1.5, SHAPE)), 0, 255).astype(np.uint8)
    write_frame(tmp_path / "empty.png", empty, 8)
    for arguments in (["--kind", "disc"], ["--kind", "chessboard", "--grid", "9x6"]):
        done = CliRunner().invoke(main, ["locate", str(tmp_path / "empty.png"), "-o", str(tmp_path / "t.csv"), *arguments])
        assert done.exit_code == 1 and done.stderr.count("\n") == 1 and f"nothing found: no {arguments[1]} in empty.png" in done.stderr
        assert "x_px" in (tmp_path / "t.csv").read_text()
    run(image, tmp_path / "empty.png", "-o", tmp_path / "t.csv")  # one of two has targets: exit status 0


def test_a_folder_is_taken_in_order_and_what_is_skipped_is_named(tmp_path: Path) -> None:
    from pixmetry.files import write_frame

    (tmp_path / "made" / "frames").mkdir(parents=True)
    for i in (2, 0, 1):
        write_frame(tmp_path / "made" / "frames" / f"frame_0000{i}.png", frame_of(i)[0], 8)
    (tmp_path / "made" / "truth.json").write_text("{}")
    (tmp_path / "made" / "frames" / "notes.txt").write_text("none")
    for folder in (tmp_path / "made", tmp_path / "made" / "frames"):  # what `simulate` wrote, and the images themselves
        done = CliRunner().invoke(main, ["locate", str(folder), "-o", str(tmp_path / "t.json")])
        assert done.exit_code == 0 and "skipped" in done.stderr and "notes.txt" in done.stderr and "truth.json" not in done.stderr
        assert [i["name"] for i in json.loads((tmp_path / "t.json").read_text())["images"]] == [f"frame_0000{i}.png" for i in range(3)]


def test_the_estimators_are_listed(image: Path) -> None:
    assert all(name in run(image, "--estimator", "list", "--kind", "line") for name in estimators("line"))


def test_no_picture_of_the_users_is_replaced(image: Path, tmp_path: Path) -> None:
    copy = tmp_path / "photo.png"
    copy.write_bytes(image.read_bytes())
    raw = copy.read_bytes()
    assert "would overwrite an input" in refused(copy, "-o", tmp_path / "t.csv", "--overlay", copy)
    assert "no result of this kind" in refused(image, "-o", tmp_path / "t.csv", "--overlay", copy)
    assert copy.read_bytes() == raw and not (tmp_path / "t.csv").exists()
    for _ in range(2):
        run(image, "-o", tmp_path / "new" / "t.csv", "--overlay", tmp_path / "new" / "found.png")
    assert {p.name for p in (tmp_path / "new").iterdir()} == {"t.csv", "found.png"}


def test_a_table_shows_itself_in_a_notebook_and_on_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = {"x_px": np.arange(30.0), "y_px": np.arange(30.0), "radius_px": np.full(30, 2.0), "flags": np.zeros(30, np.uint32)}
    table = Located(columns | {"code<b>": np.full(30, "<i>")}, "disc")
    html = table._repr_html_()
    assert html.count("<tr>") == 21 and "10 more rows" in html and "<i>" not in html and "code&lt;b&gt;" in html
    axes = table.plot(np.zeros((40, 40)))
    assert axes.yaxis_inverted() and len(axes.collections) == 2
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="pandas"):
        table.to_dataframe()
