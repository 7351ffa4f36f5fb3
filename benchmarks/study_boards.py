"""Boards in random difficult views: how many points are found with their right number, and that none has a wrong one.

    python benchmarks/study_boards.py [SECONDS [SEED]]

Each board is drawn through a random pinhole view: tilted up to 60°, rolled at will, blurred, cut by the frame, in uneven light, with
bright and dark clutter over it. A number is wrong if its point lies farther than 0.3 of the pitch from where the board has it, in the
numbering that fits best among those after which the board looks the same. Prints a line a kind: views, refused, used, points, wrong
numbers.
"""

from __future__ import annotations

import secrets
import sys
import time

import numpy as np
from scipy.ndimage import gaussian_filter

from pixmetry.calibrate.images.boards import PrintedBoard, board_of
from pixmetry.calibrate.images.images import observations_of
from pixmetry.core.errors import MeasureError

ROWS, COLS, FOCAL, SUB = 400, 480, 600.0, 2
BOARDS = {"chessboard": (9, 6), "dots": (9, 7), "charuco": (7, 5), "aprilgrid": (5, 4)}
MOST_OFF = 0.3  # of the pitch


def view_of(board: PrintedBoard, rng: np.random.Generator) -> np.ndarray:
    """Homography from the board, pitch 1, to the frame."""
    roll, tilt, towards = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 60)), rng.uniform(0, 2 * np.pi)

    def about_z(a: float) -> np.ndarray:
        return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])

    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    turn = about_z(-towards) @ lean @ about_z(towards) @ about_z(roll)
    x, y, width, height = board.box
    middle = np.array([x + width / 2, y + height / 2]) + rng.normal(0, 0.12, 2) * (width, height)
    shift = np.array([0, 0, rng.uniform(1.0, 1.7) * max(width, height)]) - turn[:, :2] @ middle
    camera = np.array([[FOCAL, 0, (COLS - 1) / 2], [0, FOCAL, (ROWS - 1) / 2], [0, 0, 1]])
    return camera @ np.column_stack([turn[:, :2], shift])


def frame_of(board: PrintedBoard, homography: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The board as a camera shows it, uint8."""
    x0, y0, width, height = board.box
    step = 40
    ink = np.ones((round(height * step), round(width * step)), np.float32)
    for left, top, wide, high in np.rint((board.black - [x0, y0, 0, 0]) * step).astype(int):
        ink[top : top + high, left : left + wide] = 0
    v, u = np.mgrid[: ink.shape[0], : ink.shape[1]]
    for cx, cy, r in (board.discs - [x0, y0, 0]) * step:
        ink[np.hypot(u - cx + 0.5, v - cy + 0.5) < r] = 0
    at = (np.arange(SUB) + 0.5) / SUB - 0.5
    x, y = np.meshgrid((np.arange(COLS)[:, None] + at).ravel(), (np.arange(ROWS)[:, None] + at).ravel())
    ray = np.linalg.inv(homography) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    i, j = (np.floor((p / ray[2] - o) * step).astype(int) for p, o in ((ray[0], x0), (ray[1], y0)))
    on = (i >= 0) & (i < ink.shape[1]) & (j >= 0) & (j < ink.shape[0]) & (ray[2] > 0)
    light = np.where(on, ink[np.clip(j, 0, ink.shape[0] - 1), np.clip(i, 0, ink.shape[1] - 1)], 0.55).reshape(ROWS * SUB, COLS * SUB)
    for _ in range(rng.integers(0, 8)):
        cx, cy, r = rng.uniform(0, COLS), rng.uniform(0, ROWS), rng.uniform(2, 14)
        light[np.hypot(x - cx, y - cy) < r] = rng.uniform(0, 1)
    light = gaussian_filter(light, rng.uniform(0.5, 1.8) * SUB).reshape(ROWS, SUB, COLS, SUB).mean(axis=(1, 3))
    gradient = (
        1 + rng.uniform(-0.5, 0.5) * (np.arange(COLS) / COLS - 0.5) + rng.uniform(-0.5, 0.5) * (np.arange(ROWS)[:, None] / ROWS - 0.5)
    )
    return np.clip(np.rint((25 + 160 * light) * gradient + rng.normal(0, 2, light.shape)), 0, 255).astype(np.uint8)


def wrong_numbers(kind: str, places: np.ndarray, named: np.ndarray, grid: tuple[int, int]) -> int:
    """Points whose place on the board is another one than that of their number; a plate of dots may be counted from either end."""
    last = np.array([grid[0] - 1, grid[1] - 1])
    ways = [named, last - named] if kind == "dots" else [named]
    return min(int((np.abs(places - way).max(axis=1) > MOST_OFF).sum()) for way in ways)


def main(seconds: float, seed: int) -> None:
    print(f"{seconds:g} {seed} repeats these draws, as far as the time reaches")
    rng = np.random.default_rng(seed)
    for kind, grid in BOARDS.items():
        board = board_of(kind, grid, 1.0)
        side = {"charuco": 0.75, "aprilgrid": round(10 / 13, 4)}.get(kind)
        views = refused = points = wrong = bad = 0
        until = time.monotonic() + seconds / len(BOARDS)
        while time.monotonic() < until:
            views += 1
            homography = view_of(board, rng)
            try:
                seen = observations_of([frame_of(board, homography, rng)], kind, grid=grid, pitch=1.0, side=side, least_images=1)
            except MeasureError:
                refused += 1
                continue
            ray = np.linalg.inv(homography) @ np.stack([seen.x_px, seen.y_px, np.ones(len(seen))])
            here = wrong_numbers(kind, (ray[:2] / ray[2]).T, seen.xyz[seen.point, :2], grid)
            points, wrong, bad = points + len(seen), wrong + here, bad + (here > 0)
        print(
            f"{kind:12} {views} views, {refused} refused, {views - refused} used with {points} points; wrong numbers {wrong} in {bad} views"
        )


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0, int(sys.argv[2]) if len(sys.argv) > 2 else secrets.randbits(32))
