"""Boards with markers: printed, seen by a pinhole, found with their numbers, and calibrated; part of a board suffices."""

from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from click.testing import CliRunner

from calibrate.test_calibration_images import View, differences
from pixmetry.calibrate.images.boards import PrintedBoard, board_of
from pixmetry.calibrate.images.images import observations_of
from pixmetry.cli import main
from pixmetry.core.errors import InputError, MeasureError

CELLS = {"charuco": 28, "aprilgrid": 130}  # samples a pitch in which all edges of a board lie between two samples


def painted(board: PrintedBoard, pitch: float) -> np.ndarray:
    """What is printed, 0 and 1, on samples of which the board's pitch is a whole number."""
    x, y, width, height = board.box
    step = CELLS[board.options.split()[1]] / pitch
    ink = np.ones((round(height * step), round(width * step)), np.float32)
    edges = np.rint((board.black - [x, y, 0, 0]) * step).astype(int)
    for left, top, wide, high in edges:
        ink[top : top + high, left : left + wide] = 0
    return ink


def seen(board: PrintedBoard, view: View, rng: np.random.Generator, pitch: float) -> np.ndarray:
    """The board in front of a grey wall."""
    ink, step, (x0, y0) = painted(board, pitch), CELLS[board.options.split()[1]] / pitch, board.box[:2]

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        i, j = np.floor((x - x0) * step).astype(int), np.floor((y - y0) * step).astype(int)
        on = (i >= 0) & (i < ink.shape[1]) & (j >= 0) & (j < ink.shape[0])
        return np.where(on, ink[np.clip(j, 0, ink.shape[0] - 1), np.clip(i, 0, ink.shape[1] - 1)], 0.6)

    return view.frame(paint, rng)


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
    frames = [seen(board, view, rng, 1.0) for view in views]
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
    for wrong in (frame[:, ::-1].copy(), np.full_like(frame, 90)):
        with pytest.raises(MeasureError, match=r"no chessboard of 6 × 5 squares with markers"):
            observations_of([wrong], "charuco", grid=(6, 5), pitch=1.0, side=20 / 28, least_images=1)
    with pytest.raises(MeasureError, match="no grid of 4 × 3 tags"):
        observations_of([frame], "aprilgrid", grid=(4, 3), pitch=1.0, side=0.7, least_images=1)


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
