"""Other programs that locate discs, each with settings that suit it, for bench_locate.py and bench_found.py.

Every function takes a uint8 frame with bright targets (or dark ones, with ``dark``) and returns x, y of what it found, in its own origin.
They all put (0, 0) at the centre of the top-left pixel on these frames; the benchmark measures and prints each one's mean offset.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np

Found = tuple[np.ndarray, np.ndarray]
HOW = "pip install 'pixmetry[peers]'"


def _bright(frame: np.ndarray, dark: bool) -> np.ndarray:
    return 255 - frame if dark else frame


def _mask(frame: np.ndarray, dark: bool) -> np.ndarray:
    import cv2

    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    return cv2.threshold(frame, 0, 255, kind | cv2.THRESH_OTSU)[1]


def _contours(frame: np.ndarray, dark: bool) -> list[np.ndarray]:
    import cv2

    found, _ = cv2.findContours(_mask(frame, dark), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [c for c in found if len(c) >= 6]


def blob_defaults(frame: np.ndarray, dark: bool) -> Found:
    """cv2.SimpleBlobDetector as it comes: it looks for dark blobs."""
    import cv2

    return _points(cv2.SimpleBlobDetector_create().detect(frame))


def blob_tuned(frame: np.ndarray, dark: bool) -> Found:
    """cv2.SimpleBlobDetector with colour, area, distance and thresholds set for these discs."""
    import cv2

    chosen = cv2.SimpleBlobDetector_Params()
    chosen.blobColor = 0 if dark else 255
    chosen.minArea, chosen.maxArea = 10, 400
    chosen.minDistBetweenBlobs = 4
    chosen.minThreshold, chosen.maxThreshold, chosen.thresholdStep = 40, 160, 20
    chosen.minConvexity = 0.6
    return _points(cv2.SimpleBlobDetector_create(chosen).detect(frame))


def _points(keys: tuple) -> Found:
    return np.array([k.pt[0] for k in keys]), np.array([k.pt[1] for k in keys])


def contour_moments(frame: np.ndarray, dark: bool) -> Found:
    """cv2.findContours at Otsu's threshold, centroids of the polygons."""
    import cv2

    found = [m for m in (cv2.moments(c) for c in _contours(frame, dark)) if m["m00"] > 0]
    return np.array([m["m10"] / m["m00"] for m in found]), np.array([m["m01"] / m["m00"] for m in found])


def contour_ellipse(frame: np.ndarray, dark: bool) -> Found:
    """cv2.fitEllipse of the contours."""
    import cv2

    return _middles([cv2.fitEllipse(c) for c in _contours(frame, dark)])


def contour_ellipse_direct(frame: np.ndarray, dark: bool) -> Found:
    """cv2.fitEllipseDirect of the contours."""
    import cv2

    return _middles([cv2.fitEllipseDirect(c) for c in _contours(frame, dark)])


def _middles(ellipses: list) -> Found:
    return np.array([e[0][0] for e in ellipses]), np.array([e[0][1] for e in ellipses])


def grey_centroid(frame: np.ndarray, dark: bool) -> Found:
    """cv2.connectedComponents above 10 DN over the background (the mode), soft-threshold centroids by three sums of NumPy."""
    import cv2

    image = _bright(frame, dark)
    level = int(np.argmax(cv2.calcHist([image], [0], None, [256], [0, 256]))) + 10
    above = cv2.subtract(image, level)
    count, labels = cv2.connectedComponents(cv2.threshold(above, 0, 255, cv2.THRESH_BINARY)[1], connectivity=8, ltype=cv2.CV_32S)
    where = np.flatnonzero(labels)
    label, weight = labels.ravel()[where], above.ravel()[where].astype(float)
    row, col = np.divmod(where, image.shape[1])
    total = np.bincount(label, weight, count)[1:]
    return np.bincount(label, weight * col, count)[1:] / total, np.bincount(label, weight * row, count)[1:] / total


def sep_windowed(frame: np.ndarray, dark: bool) -> Found:
    """sep: background, extract, then windowed positions with the window that its manual advises, from the half-flux radius."""
    import sep

    image = _bright(frame, dark).astype(np.float32)
    back = sep.Background(image, bw=64, bh=64)
    back.subfrom(image)
    found = sep.extract(image, 8.0, err=back.globalrms, minarea=9, deblend_cont=1.0)
    half, _ = sep.flux_radius(image, found["x"], found["y"], np.full(len(found), 12.0), 0.5, subpix=5)
    x, y, _ = sep.winpos(image, found["x"], found["y"], half * 2 / 2.35)
    return x, y


def sep_barycentre(frame: np.ndarray, dark: bool) -> Found:
    """sep: background and extract alone: centroids of what is above the threshold."""
    import sep

    image = _bright(frame, dark).astype(np.float32)
    back = sep.Background(image, bw=64, bh=64)
    back.subfrom(image)
    found = sep.extract(image, 8.0, err=back.globalrms, minarea=9, deblend_cont=1.0)
    return found["x"], found["y"]


def trackpy_locate(frame: np.ndarray, dark: bool) -> Found:
    """trackpy.locate with the odd diameter that holds the largest disc, and a mass that only discs have."""
    import trackpy

    trackpy.quiet()
    table = trackpy.locate(frame, 17, minmass=2000, invert=dark, separation=8, engine="numba", characterize=False)
    return table["x"].to_numpy(), table["y"].to_numpy()


def photutils_dao(frame: np.ndarray, dark: bool) -> Found:
    """photutils.DAOStarFinder with a kernel that is as wide as the largest disc; narrower ones find discs twice."""
    from photutils.detection import DAOStarFinder

    image = _bright(frame, dark).astype(float)
    ground = np.median(image[::8, ::8])
    finder = DAOStarFinder(threshold=25.0, fwhm=14.0, sharpness_range=None, roundness_range=None, min_separation=8)
    table = finder(image - ground)
    return np.array(table["x_centroid"]), np.array(table["y_centroid"])


def photutils_gaussian(frame: np.ndarray, dark: bool, x: np.ndarray, y: np.ndarray) -> Found:
    """photutils.centroid_2dg about given places: it fits a Gaussian to each."""
    from photutils.centroids import centroid_2dg

    return _photutils(frame, dark, x, y, centroid_2dg)


def photutils_centroid(frame: np.ndarray, dark: bool, x: np.ndarray, y: np.ndarray) -> Found:
    """photutils.centroid_com about given places, the median of the frame being subtracted."""
    from photutils.centroids import centroid_com

    return _photutils(frame, dark, x, y, centroid_com)


def _photutils(frame: np.ndarray, dark: bool, x: np.ndarray, y: np.ndarray, function: Callable) -> Found:
    from photutils.centroids import centroid_sources

    image = _bright(frame, dark).astype(float)
    image -= np.median(image[::8, ::8])
    return centroid_sources(image, np.rint(x), np.rint(y), box_size=21, centroid_func=function)


def invert_dark(frame: np.ndarray, dark: bool) -> np.ndarray:
    """The frame with bright targets."""
    return _bright(frame, dark)


def sep_found(frame: np.ndarray, sigmas: float) -> Found:
    """sep: background and extract at a threshold, for bench_found.py."""
    import sep

    image = frame.astype(np.float32)
    back = sep.Background(image, bw=64, bh=64)
    back.subfrom(image)
    found = sep.extract(image, sigmas, err=back.globalrms)
    return found["x"], found["y"]


def trackpy_found(frame: np.ndarray, diameter_px: float, count: int) -> Found:
    """trackpy: the places of greatest mass, as many as there are targets, for bench_found.py."""
    import trackpy

    trackpy.quiet()
    table = trackpy.locate(frame, 2 * int(diameter_px / 2) + 3, topn=count, characterize=False)
    return table["x"].to_numpy(), table["y"].to_numpy()


WHOLE: dict[str, tuple[str, Callable[[np.ndarray, bool], Found]]] = {
    "OpenCV blobs, defaults": ("cv2", blob_defaults),
    "OpenCV blobs, tuned": ("cv2", blob_tuned),
    "OpenCV contour moments": ("cv2", contour_moments),
    "OpenCV fitEllipse": ("cv2", contour_ellipse),
    "OpenCV fitEllipseDirect": ("cv2", contour_ellipse_direct),
    "OpenCV regions + sums": ("cv2", grey_centroid),
    "sep extract": ("sep", sep_barycentre),
    "sep extract + winpos": ("sep", sep_windowed),
    "trackpy locate": ("trackpy", trackpy_locate),
    "photutils DAOStarFinder": ("photutils", photutils_dao),
}
AT_PLACES: dict[str, tuple[str, Callable[..., Found]]] = {
    "photutils centroid_com": ("photutils", photutils_centroid),
    "photutils Gaussian fit": ("photutils", photutils_gaussian),
}


def available(module: str) -> bool:
    """Whether it is installed; if not, a line says how to install it."""
    there = importlib.util.find_spec(module) is not None
    if not there:
        print(f"{module} is not installed and left out: {HOW}")
    return there
