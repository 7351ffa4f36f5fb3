"""Boards with markers: printed, seen by a pinhole, found with their numbers, and calibrated; part of a board suffices."""

from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from click.testing import CliRunner

from calibrate.test_calibration_images import View, differences
from pixmetry import locate
from pixmetry.calibrate.images.boards import PrintedBoard, board_of
from pixmetry.calibrate.images.images import observations_of
from pixmetry.cli import main
from pixmetry.core.errors import InputError, MeasureError

CELLS = {"charuco": 28, "aprilgrid": 130}  # samples a pitch in which all edges of a board lie between two samples
ROUND = 140  # of boards of discs and rings


def painted(board: PrintedBoard, step: float) -> np.ndarray:
    """What is printed, 0 and 1, on so many samples a unit of length."""
    x, y, width, height = board.box
    ink = np.ones((round(height * step), round(width * step)), np.float32)
    edges = np.rint((board.black - [x, y, 0, 0]) * step).astype(int)
    for left, top, wide, high in edges:
        ink[top : top + high, left : left + wide] = 0
    rings = np.concatenate([np.column_stack([board.discs, board.discs[:, 2], np.tile([0, 360], (len(board.discs), 1))]), board.sectors])
    for u, v, outer, wide, first, last in rings:
        low = np.floor((np.array([u - x, v - y]) - outer) * step).astype(int)
        j, i = np.mgrid[low[1] : low[1] + int(2 * outer * step) + 2, low[0] : low[0] + int(2 * outer * step) + 2]
        du, dv = (i + 0.5) / step + x - u, (j + 0.5) / step + y - v
        radius, angle = np.hypot(du, dv), np.degrees(np.arctan2(dv, du)) % 360
        inside = (radius < outer) & (radius >= outer - wide) & (angle >= first) & (angle <= last)
        ink[j[inside], i[inside]] = 0
    return ink


def seen(board: PrintedBoard, view: View, rng: np.random.Generator, pitch: float, sub: int = 2) -> np.ndarray:
    """The board in front of a grey wall; edges along the samples are off by half of their spacing at most."""
    step, (x0, y0) = CELLS.get(board.options.split()[1], ROUND) / pitch, board.box[:2]
    ink = painted(board, step)

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = np.floor((x - x0) * step).astype(int), np.floor((y - y0) * step).astype(int)
        on = (i >= 0) & (i < ink.shape[1]) & (j >= 0) & (j < ink.shape[0])
        return np.where(on, ink[np.clip(j, 0, ink.shape[0] - 1), np.clip(i, 0, ink.shape[1] - 1)], 0.6)

    return view.frame(paint, rng, sub=sub)


@pytest.mark.parametrize(
    ("kind", "grid", "side", "distance"),
    [("charuco", (6, 5), 20 / 28, 8.0), ("charuco", (5, 4), 20 / 28, 7.0), ("aprilgrid", (4, 3), 100 / 130, 7.0)],
)
def test_a_printed_board_is_found_with_its_numbers(
    kind: str, grid: tuple[int, int], side: float, distance: float, rng: np.random.Generator
) -> None:
    """Upright, rolled by 100° and 190°, and cut by the frame: each corner has its own number and is within 0.1 px (a wrong number is a
    corner, 15 px, away); all points of the whole board are there in the first."""
    board = board_of(kind, grid, 1.0, side_mm=side)
    middle = (grid[0] / 2 - (1 if kind == "charuco" else 0.1), grid[1] / 2 - (1 if kind == "charuco" else 0.1))
    cut = (middle[0] + 0.8, middle[1] + 0.6)
    views = [
        View(middle, distance, 0.0, 15, -8),
        View(middle, distance, 100.0, -12, 15),
        View(middle, distance, 190.0),
        View(cut, 0.8 * distance, 20.0, 10, 5),
    ]
    frames = [seen(board, view, rng, 1.0, sub=4) for view in views]
    found = observations_of(frames, kind, grid=grid, pitch=1.0, side=side)
    assert len(found.images) == 4 and not [f for f in found.findings if f.kind == "numbering"]
    for name, xyz in zip(found.points, found.xyz, strict=True):
        assert board.points[name] == pytest.approx(tuple(xyz[:2]), abs=1e-9)
    assert (found.image == 0).sum() == len(board.points)
    assert 8 <= (found.image == 3).sum() < len(board.points)
    assert np.abs(differences(found, views)).max() < 0.1  # u is 0.004 px; the samples of the drawing, a quarter of a pixel, add their part


def test_another_board_and_a_mirrored_one_are_refused(rng: np.random.Generator) -> None:
    board = board_of("charuco", (6, 5), 1.0, side_mm=20 / 28)
    frame = seen(board, View((2.0, 1.5), 8.0), rng, 1.0)
    for wrong, what in ((frame[:, ::-1].copy(), "the picture is mirrored"), (np.full_like(frame, 90), "was found")):
        with pytest.raises(MeasureError, match=rf"no chessboard of 6 × 5 squares with markers .*{what}"):
            observations_of([wrong], "charuco", grid=(6, 5), pitch=1.0, side=20 / 28, least_images=1)
    tags = board_of("aprilgrid", (4, 3), 1.0, side_mm=100 / 130)
    mirrored = seen(tags, View((1.4, 0.9), 7.0), rng, 1.0)[:, ::-1].copy()
    with pytest.raises(MeasureError, match="no grid of 4 × 3 tags .*the picture is mirrored"):
        observations_of([mirrored], "aprilgrid", grid=(4, 3), pitch=1.0, side=100 / 130, least_images=1)
    with pytest.raises(MeasureError, match="no grid of 4 × 3 tags"):
        observations_of([frame], "aprilgrid", grid=(4, 3), pitch=1.0, side=0.7, least_images=1)


@pytest.mark.parametrize(("rings", "grid"), [("RING_8", (5, 3)), ("RING_14", (5, 4)), ("RING_20", (4, 3))])
def test_printed_rings_are_read_with_their_numbers(rings: str, grid: tuple[int, int], rng: np.random.Generator) -> None:
    """Tilted and rolled: each target that is read has the number that the print's table gives for its place, and all or all but one are
    read; as rings of 12 segments they are refused, with the name of those that are there.

    Half of the pixels of discs were once taken for those of the wall's corners, which are long: up to 4 of 12 were lost, others 0.7 px off.
    """
    board = board_of("coded", grid, 1.0, dictionary=rings)
    view = View(((grid[0] - 1) / 2, (grid[1] - 1) / 2), 1.8 * grid[0], float(rng.uniform(0, 360)), 20, -15)
    frame = seen(board, view, rng, 1.0)
    found = observations_of([frame], "coded", dictionary=rings, least_images=1)
    assert set(found.points) <= set(board.points) and len(found.points) >= 0.8 * len(board.points)
    expected = view.image(np.array([board.points[name] for name in found.points]))
    seen_at = np.column_stack([found.x_px, found.y_px])[np.argsort(found.point)]
    assert np.abs(seen_at - expected).max() < 0.3  # with the eccentricity of an ellipse; the next target is 40 px away
    told = locate(frame, kind="coded").images[0]["rings"]
    assert f"targets have codes of {rings}" in told and f"ask for dictionary {rings}" in told
    with pytest.raises(MeasureError, match=f"targets have codes of {rings}"):
        observations_of([frame], "coded", least_images=1)


def test_a_printed_asymmetric_plate_is_found(rng: np.random.Generator) -> None:
    """And it is OpenCV's: an odd number of rows tells its turn, so each point lies where its name says."""
    board = board_of("asymmetric", (4, 7), 1.0)
    view = View((1.75, 1.5), 7.5, 190.0, 15, 10)
    found = observations_of([seen(board, view, rng, 1.0)], "asymmetric", grid=(4, 7), pitch=1.0, least_images=1)
    assert set(found.points) == set(board.points)
    for name, xyz in zip(found.points, found.xyz, strict=True):
        assert board.points[name] == pytest.approx(tuple(xyz[:2]), abs=1e-9)
    assert np.abs(differences(found, [view])).max() < 0.3


def test_the_command_prints_and_calibrate_takes_pictures_of_it(tmp_path: Path, rng: np.random.Generator) -> None:
    """From the print to the camera: c within 5 u of the pinhole's 600 px, with the options that the command states."""
    file = tmp_path / "board.pdf"
    made = CliRunner().invoke(main, ["board", "charuco", "--grid", "6x5", "--pitch-mm", "28", "--side-mm", "20", "-o", str(file)])
    assert made.exit_code == 0, made.output
    assert file.read_bytes().startswith(b"%PDF") and (tmp_path / "board.csv").read_text().splitlines()[2] == "0/0,0,0,0"
    assert (
        CliRunner().invoke(main, ["board", "charuco", "--grid", "6x5", "--pitch-mm", "28", "--side-mm", "20", "-o", str(file)]).exit_code
        == 0
    )
    options = next(line for line in made.output.splitlines() if line.startswith("pictures of it")).split("PICTURES ")[1].split()
    board = board_of("charuco", (6, 5), 28.0, side_mm=20.0)
    assert options == board.options.split()
    (tmp_path / "pictures").mkdir()
    for k, (roll, *tilt) in enumerate([(0, 25, 0), (90, -25, 5), (10, 0, 25), (100, 5, -25), (45, 20, 20)]):
        frame = seen(board, View((2 * 28.0, 1.5 * 28.0), 8 * 28.0, roll, *tilt), rng, 28.0)
        (tmp_path / "pictures" / f"{k}.png").write_bytes(imagecodecs.png_encode(frame))
    arguments = ["calibrate", str(tmp_path / "pictures"), *options, "--free", "c,xp,yp,k1", "-o", str(tmp_path / "out")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    rows = [line.split(",") for line in (tmp_path / "out" / "residuals.csv").read_text().splitlines() if not line.startswith("#")]
    assert 1 + 5 * 18 <= len(rows) <= 1 + 5 * 20
    from pixmetry import read_calibration

    (camera,) = read_calibration(tmp_path / "out").cameras
    assert camera["c"] == pytest.approx(600, abs=3)


@pytest.mark.parametrize(
    ("kind", "options", "what"),
    [
        ("rings", {}, "no such kind"),
        ("dots", {"side_mm": 3.0}, "no meaning"),
        ("charuco", {"side_mm": 30.0}, "do not fit"),
        ("charuco", {"dictionary": "4X4_7"}, "no such dictionary"),
        ("coded", {"dictionary": "RING_9"}, "no such rings"),
        ("coded", {"dictionary": "RING_8"}, "not so many codes"),
        ("coded", {"diameter_mm": 6.0}, "do not fit"),
        ("asymmetric", {"diameter_mm": 15.0}, "do not fit"),
        ("aprilgrid", {"dictionary": "APRILTAG_16h5"}, "too few markers"),
    ],
)
def test_boards_that_cannot_be_are_refused(kind: str, options: dict, what: str) -> None:
    with pytest.raises(InputError, match=what):
        board_of(kind, (9, 6), 20.0, **options)
    with pytest.raises(InputError, match="size of a board"):
        board_of("dots", (2, 6), 20.0)


def test_a_fine_pitch_is_written_to_the_digit() -> None:
    """The far corner of a wide board, whose pitch has seven digits, and the options that tell it."""
    board = board_of("chessboard", (80, 6), 12.34567)
    _, x, y, _ = next(row for row in board.coordinates_csv().splitlines() if row.startswith("5/79,")).split(",")
    assert (float(x), float(y)) == pytest.approx((79 * 12.34567, 5 * 12.34567), abs=1e-5)
    assert board.options.endswith("--pitch-mm 12.34567")
