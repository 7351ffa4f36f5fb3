"""Speed of a whole calibration beside OpenCV: ``python benchmarks/bench_calibrate.py``.

The thirteen left pictures of OpenCV's chessboard (in the folder that PIXMETRY_DATA names, ``opencv-chessboards``), 54 corners each as
OpenCV finds them. Both get the same image points and the exact board, and estimate fx, fy, cx, cy, k1, k2, p1, p2, k3 from no start values:
``cv2.calibrateCamera`` (least squares alone; ``calibrateCameraExtended`` gives standard deviations too) and ours, in all of it start
values, weights of x and of y, covariance and the records of the report:

- *least squares*: without folds, search for gross errors and for patterns, shared errors;
- *with shared errors*: the same with uncertainties that hold what image points share;
- *with patterns*: and with what the residuals tell of error sources;
- *all*: as ``pixmetry calibrate`` does it.

Processor time, medians of repeats in which both run one after the other, one thread; the time to read pictures is not counted.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from goals import verdict

from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network
from pixmetry.calibrate.bundle.solve import Options, calibrate_network
from pixmetry.core.threads import single_threaded_blas

REPEATS, GOAL = 15, 5.0
SIZE, GRID, SIDE_MM = (640, 480), (9, 6), 25.0
FREE = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2", "k3")
BARE = Options(folds=0, snoop=False, field="fixed", patterns=False, shared_errors=False)
KINDS = {
    "least squares": BARE,
    "with shared errors": replace(BARE, shared_errors=True),
    "with patterns": replace(BARE, shared_errors=True, patterns=True),
    "all": Options(),
}


def corners() -> np.ndarray:
    """Corners of all pictures, shape (images, points, 2)."""
    folder = Path(os.environ.get("PIXMETRY_DATA", "")) / "opencv-chessboards"
    files = sorted(folder.glob("left*.jpg"))
    if not files:
        sys.exit(f"no pictures left*.jpg in {folder}: set PIXMETRY_DATA")
    found = []
    for file in files:
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        there, places = cv2.findChessboardCorners(grey, GRID)
        if there:
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
            found.append(cv2.cornerSubPix(grey, places, (5, 5), (-1, -1), stop).reshape(-1, 2))
    return np.array(found)


def network_of(places: np.ndarray, board: np.ndarray) -> Network:
    """The same for ours."""
    images, points = places.shape[:2]
    camera = replace(CameraModel.of(Sensor(*SIZE), "object_to_image"), free=np.isin(NAMES, FREE))
    x_px, y_px = places.astype(float).reshape(-1, 2).T
    return Network(
        cameras=(camera,), images=tuple(f"I{i}" for i in range(images)), camera_of=np.zeros(images, int),
        points=tuple(f"T{j}" for j in range(points)), x_px=x_px, y_px=y_px,
        image=np.repeat(np.arange(images), points), point=np.tile(np.arange(points), images),
        covariance_px2=np.tile([0.01, 0.0, 0.01], (images * points, 1)), xyz=board, u_xyz=np.zeros_like(board),
    )  # fmt: skip


def seconds(action: Callable[[], object]) -> float:
    """Processor time."""
    began = time.process_time()
    action()
    return time.process_time() - began


def main() -> None:
    """Print times and ratios."""
    cv2.setNumThreads(1)
    places = corners()
    board = np.zeros((GRID[0] * GRID[1], 3))
    board[:, :2] = SIDE_MM * np.mgrid[: GRID[0], : GRID[1]].T.reshape(-1, 2)
    network = network_of(places, board)
    objects, seen = [board.astype(np.float32)] * len(places), [one.astype(np.float32).reshape(-1, 1, 2) for one in places]
    theirs = {
        "cv2.calibrateCamera": lambda: cv2.calibrateCamera(objects, seen, SIZE, None, None),
        "cv2.calibrateCameraExtended": lambda: cv2.calibrateCameraExtended(objects, seen, SIZE, None, None),
    }
    ours = {name: (lambda options=options: calibrate_network(network, options)) for name, options in KINDS.items()}
    with single_threaded_blas():
        result, matrix = calibrate_network(network, BARE).adjustment, theirs["cv2.calibrateCamera"]()[1]
        print(f"fx: ours {result.camera()['c'] * (1 + result.camera()['b1']):.4f} px, OpenCV {matrix[0, 0]:.4f} px")
        for action in ours.values():
            action()  # loads or compiles
        times = {name: [] for name in (*theirs, *ours)}
        for _ in range(REPEATS):
            for name, action in {**theirs, **ours}.items():
                times[name].append(seconds(action))
    for name, values in times.items():
        print(f"  {name}: {1e3 * np.median(values):.1f} ms")
    base = np.array(times["cv2.calibrateCamera"])
    for name in ("least squares", "with shared errors"):
        verdict(f"{name}, processor time over cv2.calibrateCamera", float(np.median(np.array(times[name]) / base)), GOAL)


if __name__ == "__main__":
    main()
