"""Boards in random views: how many are found with the right numbers, how many are refused, and that no number is wrong.

    python benchmarks/study_boards.py [VIEWS [SEED [FIRST]]]     random views of each board, from number FIRST on
    python benchmarks/study_boards.py difficult [VIEWS [SEED]]   so many of each difficulty: cut, blurred, tilted to 70°, and so on
    python benchmarks/study_boards.py parts [SETS [SEED [FIRST]]]   of five views of a plate larger than they are, with three hollow dots

Each board is drawn through a random pinhole view: tilted up to 60°, rolled at will, blurred, cut by the frame, in uneven light, with
bright and dark clutter over it. A number is wrong if its point lies farther than 0.3 of the pitch from where the board has it, in the
numbering that fits best among those after which the board looks the same. Prints a line a kind: views, refused, used, points, wrong
numbers, and the views that have them. Each view has a seed of its own, so that a long study can be run in parts.
"""

from __future__ import annotations

import secrets
import sys
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from pixmetry.calibrate.images.boards import PrintedBoard, board_of
from pixmetry.calibrate.images.images import observations_of
from pixmetry.core.errors import MeasureError

ROWS, COLS, FOCAL, SUB = 400, 480, 600.0, 2
BOARDS = {"chessboard": (9, 6), "dots": (9, 7), "asymmetric": (4, 11), "squares": (7, 5), "charuco": (7, 5), "aprilgrid": (5, 4)}
SECOND = {"chessboard": (6, 4), "dots": (6, 4), "asymmetric": (3, 7), "squares": (4, 3), "charuco": (5, 4), "aprilgrid": (3, 3)}
SIDES = {"squares": 0.5, "charuco": 0.75, "aprilgrid": round(10 / 13, 4)}
ALIKE = {"dots", "squares"}  # after half a turn; an asymmetric grid of an odd number of rows is not
LIKE_ITS_MIRROR_IMAGE = {"chessboard", "dots", "asymmetric", "squares"}
SAMPLES = {"charuco": 56, "aprilgrid": 52}  # of a drawing, a pitch: edges of markers lie between two
MOST_OFF = 0.3  # of the pitch


@dataclass(frozen=True)
class Case:
    """Ranges of what a view is drawn from: tilt and roll in degrees, distance in board widths, shift in them, blur in px, light's fall."""

    tilt: tuple[float, float] = (0.0, 60.0)
    roll: tuple[float, float] = (0.0, 360.0)
    distance: tuple[float, float] = (1.0, 1.7)
    shift: float = 0.12
    blur: tuple[float, float] = (0.5, 1.8)
    light: tuple[float, float] = (0.0, 0.5)
    clutter: int = 8
    second: bool = False
    mirrored: bool = False


RANDOM = Case()
PARTS = Case(tilt=(0.0, 50.0), distance=(0.55, 0.75), shift=0.06)
PLATE, HOLLOW = (16, 13), ((6, 5), (10, 5), (6, 8))  # of dots, larger than its views; x, y of its hollow ones
PLAIN = {"tilt": (0.0, 35.0), "shift": 0.04, "blur": (0.5, 1.0), "light": (0.0, 0.2), "clutter": 1, "distance": (1.3, 1.6)}
DIFFICULT = {
    "cut": Case(**(PLAIN | {"distance": (0.7, 0.95), "shift": 0.2})),  # type: ignore[arg-type]
    "blurred": Case(**(PLAIN | {"blur": (2.0, 4.0)})),  # type: ignore[arg-type]
    "tilted": Case(**(PLAIN | {"tilt": (60.0, 70.0)})),  # type: ignore[arg-type]
    "uneven light": Case(**(PLAIN | {"light": (1.0, 1.6)})),  # type: ignore[arg-type]
    "second board": Case(**(PLAIN | {"second": True, "distance": (1.7, 2.0)})),  # type: ignore[arg-type]
    "mirrored": Case(**(PLAIN | {"mirrored": True})),  # type: ignore[arg-type]
    "upside down": Case(**(PLAIN | {"roll": (160.0, 200.0)})),  # type: ignore[arg-type]
}


def view_of(board: PrintedBoard, case: Case, rng: np.random.Generator, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Homography from the board, pitch 1, to the frame; ``at``: its middle from that of the frame, in distances."""
    roll, tilt, towards = np.radians(rng.uniform(*case.roll)), np.radians(rng.uniform(*case.tilt)), rng.uniform(0, 2 * np.pi)

    def about_z(a: float) -> np.ndarray:
        return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])

    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    turn = about_z(-towards) @ lean @ about_z(towards) @ about_z(roll)
    x, y, width, height = board.box
    middle = np.array([x + width / 2, y + height / 2]) + rng.normal(0, case.shift, 2) * (width, height)
    distance = rng.uniform(*case.distance) * max(width, height)
    shift = np.array([at[0] * distance, at[1] * distance, distance]) - turn[:, :2] @ middle
    camera = np.array([[FOCAL, 0, (COLS - 1) / 2], [0, FOCAL, (ROWS - 1) / 2], [0, 0, 1]])
    return camera @ np.column_stack([turn[:, :2], shift])


def drawn(board: PrintedBoard) -> tuple[np.ndarray, int]:
    """The print, 0 and 1, and samples a pitch."""
    x0, y0, width, height = board.box
    step = SAMPLES.get(board.options.split()[1], 40)
    ink = np.ones((round(height * step), round(width * step)), np.float32)
    corners = np.column_stack([board.black[:, :2], board.black[:, :2] + board.black[:, 2:]]) - [x0, y0, x0, y0]
    for left, top, right, bottom in np.rint(corners * step).astype(int):
        ink[top:bottom, left:right] = 0
    for cx, cy, radius in (board.discs - [x0, y0, 0]) * step:  # a negative radius: the white middle of a hollow dot
        r, tone = abs(radius), 0 if radius > 0 else 1
        a, b = int(cx - r) - 1, int(cy - r) - 1
        v, u = np.mgrid[b : b + int(2 * r) + 4, a : a + int(2 * r) + 4]
        ink[v, u] = np.where(np.hypot(u - cx + 0.5, v - cy + 0.5) < r, tone, ink[v, u])
    return ink, step


def frame_of(boards: list[tuple[PrintedBoard, np.ndarray]], case: Case, rng: np.random.Generator) -> np.ndarray:
    """Boards through their homographies as a camera shows them, uint8."""
    at = (np.arange(SUB) + 0.5) / SUB - 0.5
    x, y = np.meshgrid((np.arange(COLS)[:, None] + at).ravel(), (np.arange(ROWS)[:, None] + at).ravel())
    light = np.full(x.shape, 0.55, np.float32)
    for board, homography in boards:
        (ink, step), (x0, y0) = drawn(board), board.box[:2]
        h = np.linalg.inv(homography)
        w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        i = np.floor(((h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w - x0) * step).astype(int)
        j = np.floor(((h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w - y0) * step).astype(int)
        on = (i >= 0) & (i < ink.shape[1]) & (j >= 0) & (j < ink.shape[0]) & (w > 0)
        light[on] = ink[j[on], i[on]]
    for _ in range(rng.integers(0, case.clutter)):
        cx, cy, r = rng.uniform(0, COLS), rng.uniform(0, ROWS), rng.uniform(2, 14)
        light[np.hypot(x - cx, y - cy) < r] = rng.uniform(0, 1)
    light = gaussian_filter(light, rng.uniform(*case.blur) * SUB).reshape(ROWS, SUB, COLS, SUB).mean(axis=(1, 3))
    across, down = rng.choice([-1, 1], 2) * rng.uniform(*case.light, 2)
    fall = 1 + across * (np.arange(COLS) / COLS - 0.5) + down * (np.arange(ROWS)[:, None] / ROWS - 0.5)
    grey = (25 + 160 * light) * np.maximum(fall, 0.05) + rng.normal(0, 2, light.shape)
    frame = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return frame[:, ::-1].copy() if case.mirrored else frame


def wrong_numbers(kind: str, places: np.ndarray, named: np.ndarray, board: PrintedBoard, mirrored: bool = False) -> int:
    """Points whose place on the board is another one than that of their number, in the best of the ways in which it may be counted."""
    points = np.array(list(board.points.values()))
    last = points.min(axis=0) + points.max(axis=0)
    ways = [named, last - named] if kind in ALIKE else [named]
    if mirrored:
        ways = [np.column_stack([last[0] - named[:, 0], named[:, 1]]), np.column_stack([named[:, 0], last[1] - named[:, 1]])]
    return min(int((np.abs(places - way).max(axis=1) > MOST_OFF).sum()) for way in ways)


def looked_at(kind: str, case: Case, rng: np.random.Generator) -> tuple[int, int, str]:
    """One view: points that were used, wrong numbers among them, and why it was refused."""
    grid, side = BOARDS[kind], SIDES.get(kind)
    board = board_of(kind, grid, 1.0)
    homography = view_of(board, case, rng, (-0.12, 0.0) if case.second else (0.0, 0.0))
    boards = [(board, homography)]
    if case.second:
        other = board_of(kind, SECOND[kind], 1.0)
        boards.append((other, view_of(other, case, rng, (0.2, 0.0))))
    frame = frame_of(boards[::-1], case, rng)
    try:
        seen = observations_of([frame], kind, grid=grid, pitch=1.0, side=side, least_images=1)
    except MeasureError as problem:
        return 0, 0, str(problem).partition("(image 1: ")[2].partition(")")[0] or str(problem)
    x = COLS - 1 - seen.x_px if case.mirrored else seen.x_px
    ray = np.linalg.inv(homography) @ np.stack([x, seen.y_px, np.ones(len(seen))])
    mirrored = case.mirrored and kind in LIKE_ITS_MIRROR_IMAGE
    return len(seen), wrong_numbers(kind, (ray[:2] / ray[2]).T, seen.xyz[seen.point, :2], board, mirrored), ""


def random_views(views: int, seed: int, first: int) -> None:
    for number, kind in enumerate(BOARDS):
        found = [looked_at(kind, RANDOM, np.random.default_rng([seed, number, view])) for view in range(first, first + views)]
        points, wrong = sum(one[0] for one in found), sum(one[1] for one in found)
        bad = [first + k for k, one in enumerate(found) if one[1]]
        refused = sum(bool(one[2]) for one in found)
        used = f"{views - refused} used with {points} points"
        print(f"{kind:12} {views} views, {refused} refused, {used}; wrong numbers {wrong} in views {bad}", flush=True)


def set_of_parts(board: PrintedBoard, rng: np.random.Generator) -> tuple[int, int, int]:
    """Five views of parts of a plate: those that are used, their points, and the wrong numbers among them."""
    homographies = [view_of(board, PARTS, rng) for _ in range(5)]
    frames = [frame_of([(board, homography)], PARTS, rng) for homography in homographies]
    try:
        seen = observations_of(frames, "dots", grid=PLATE, pitch=1.0, least_images=2)
    except MeasureError:
        return 0, 0, 0
    back = np.linalg.inv(homographies)[[int(name.split()[1]) - 1 for name in seen.images]][seen.image]
    ray = np.einsum("nij,nj->ni", back, np.column_stack([seen.x_px, seen.y_px, np.ones(len(seen))]))
    places, named = ray[:, :2] / ray[:, 2:], seen.xyz[seen.point, :2]
    wrong = []
    for _ in range(4):  # the plate may be counted from any corner, and from the first row and column that are seen
        named = np.column_stack([-named[:, 1], named[:, 0]])
        wrong.append(int((np.abs(places - named - np.median(np.rint(places - named), axis=0)).max(axis=1) > MOST_OFF).sum()))
    return len(seen.images), len(seen), min(wrong)


def parts(sets: int, seed: int, first: int) -> None:
    plain = board_of("dots", PLATE, 1.0)
    board = replace(plain, discs=np.vstack([plain.discs, [(x, y, -0.125) for x, y in HOLLOW]]))
    found = np.array([set_of_parts(board, np.random.default_rng([seed, 2000, one])) for one in range(first, first + sets)])
    used, points, wrong = found.sum(axis=0)
    bad = (first + np.flatnonzero(found[:, 2])).tolist()
    print(f"{sets} sets of 5 views: {used} views used with {points} points; wrong numbers {wrong} in sets {bad}")


def difficult_views(views: int, seed: int) -> None:
    print("| board | " + " | ".join(DIFFICULT) + " |\n|" + "---|" * (len(DIFFICULT) + 1))
    reasons: Counter[str] = Counter()
    for number, kind in enumerate(BOARDS):
        cells = []
        for k, case in enumerate(DIFFICULT.values()):
            found = [looked_at(kind, case, np.random.default_rng([seed, 1000 + number, k, view])) for view in range(views)]
            refused, wrong = sum(bool(one[2]) for one in found), sum(one[1] > 0 for one in found)
            cells.append(f"{views - refused - wrong} / {refused} / {wrong}")
            reasons.update(f"{kind}, {list(DIFFICULT)[k]}: {one[2]}" for one in found if one[2])
        print(f"| {kind} | " + " | ".join(cells) + " |", flush=True)
    for reason, count in reasons.most_common():
        print(f"{count:4} {reason}")


if __name__ == "__main__":
    mode = sys.argv[1] if sys.argv[1:2] in (["difficult"], ["parts"]) else "random"
    numbers = [int(float(text)) for text in sys.argv[1 + (mode != "random") :]]
    seed = numbers[1] if len(numbers) > 1 else secrets.randbits(32)
    first = numbers[2] if len(numbers) > 2 else 0
    views = numbers[0] if numbers else 20 if mode == "difficult" else 30
    print(f"{'' if mode == 'random' else mode + ' '}{views} {seed} {'' if mode == 'difficult' else first} repeats these draws")
    if mode == "difficult":
        difficult_views(views, seed)
    elif mode == "parts":
        parts(views, seed, first)
    else:
        random_views(views, seed, first)
