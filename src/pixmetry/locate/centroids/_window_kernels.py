"""Kernels that lay out the windows of moments: sizes of a target in, its record out; and what is added to the result of its sums."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.jit import jit
from pixmetry.locate._noise_kernels import Noise, variance_of
from pixmetry.locate.centroids._moment_kernels import (
    AMPLITUDE,
    ANGLE,
    EXCESS,
    INNER,
    LEVEL,
    MAJOR,
    MARGIN,
    MINOR,
    OUTER,
    REACH,
    SIGN,
    SLOPE_X,
    SLOPE_Y,
    SPREAD,
    THRESHOLD,
    X,
    Y,
    limit_margins,
)  # fmt: skip

SIZES = 10  # of a target: x, y, half axes, angle (degrees), blur, height (with sign), level and slopes of the background
FEWEST_PX = 0.5  # of a half axis
SHARPEST_PX, USUAL = 0.3, 0.85  # least blur; share of the median blur that each target has at least, for the lens is common to all
HALF_WIDTH = 1.1774  # half width at half height of a Gaussian over its standard deviation
CUT = 1.5  # times the blur: a window that ends nearer to the edge is cut
FAINT = 0.1  # relative standard deviation of the weights' sum
BORDER, UNDER_SAMPLED, OVERLAPPING, NOT_CONVERGED, FAINT_FLAG = 1, 8, 16, 256, 512  # of `targets.Flag`


class Shapes(NamedTuple):
    """Of discs blurred by a Gaussian of 1 px, by radius: arrays of the same length."""

    ratio: Array  # the radius
    contour: Array  # radius of the contour at half height
    window: Array  # half-flux radius over √(2 ln 2)


@jit(inline="always")
def between(x: float, xs: Array, ys: Array) -> float:
    """Straight line through the table's neighbouring points; ``x`` lies within the table."""
    k = min(max(int(np.searchsorted(xs, x, side="right")) - 1, 0), len(xs) - 2)
    return float((ys[k + 1] - ys[k]) / (xs[k + 1] - xs[k]) * (x - xs[k]) + ys[k])


@jit
def disc_of(half_height: float, blur: float, shapes: Shapes) -> tuple[float, float, float]:
    """Radius and blur of the blurred disc with this contour at half its height, and the spread of its Gaussian window, px."""
    ratio, contour, window = shapes
    asked, last = half_height / blur, len(contour) - 1
    if asked < contour[0]:
        blur, asked = half_height / contour[0], contour[0]
    if asked > contour[last]:
        return asked * blur, blur, asked / math.sqrt(2.0) / math.sqrt(2.0 * math.log(2.0)) * blur
    return between(asked, contour, ratio) * blur, blur, between(asked, contour, window) * blur


@jit
def discs_of(half_height: Array, blur: Array, shapes: Shapes) -> Array:
    """`disc_of` for arrays; shape (3, n)."""
    out = np.empty((3, len(blur)))
    for i in range(len(blur)):
        out[0, i], out[1, i], out[2, i] = disc_of(half_height[i], blur[i], shapes)
    return out


@jit
def lay_out(sizes: Array, margin: float, shapes: Shapes, record: Array, disc: Array) -> None:
    """Write the records of targets, with windows of ``margin`` times their blur, and their radius, blur and usability.

    ``disc`` (n, 3): radius and blur of the equivalent disc, and 1 if all sizes are finite. Other targets have sizes of a pixel.
    """
    n = len(sizes)
    known = sizes[:, 5][np.isfinite(sizes[:, 5])]
    common = USUAL * np.median(known) if len(known) else SHARPEST_PX
    for i in range(n):
        x, y, major, minor, angle = sizes[i, 0], sizes[i, 1], sizes[i, 2], sizes[i, 3], sizes[i, 4]
        blur, height, level, slope_x, slope_y = sizes[i, 5], sizes[i, 6], sizes[i, 7], sizes[i, 8], sizes[i, 9]
        usable = math.isfinite(x + y + major + minor + angle + blur + height + level)
        major, minor = max(major, FEWEST_PX), max(minor, FEWEST_PX)
        blur = min(max(max(blur, common), SHARPEST_PX), max(minor / HALF_WIDTH, SHARPEST_PX))
        if not usable:
            x, y, major, minor, angle, blur, height, level, slope_x, slope_y = 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0
        record[i, X], record[i, Y], record[i, MAJOR], record[i, MINOR], record[i, ANGLE] = x, y, major, minor, math.radians(angle)
        record[i, REACH], record[i, MARGIN] = 4.0 * blur, margin * blur
        record[i, INNER] = max(4.0 * blur, 1.0)
        record[i, OUTER] = record[i, INNER] + 5.0 + 0.5 * math.sqrt(major * minor)
        record[i, AMPLITUDE], record[i, SIGN] = abs(height), np.sign(height)
        record[i, LEVEL], record[i, SLOPE_X], record[i, SLOPE_Y] = level, slope_x, slope_y
        disc[i, 0], disc[i, 1], spread = disc_of(math.sqrt(major * minor), blur, shapes)
        disc[i, 2] = 1.0 if usable else 0.0
        record[i, SPREAD] = max(spread, FEWEST_PX)


@jit
def limit_windows(record: Array, start: Ints, index: Ints, rows: int, cols: int, rim: float, flags: NDArray[np.uint32]) -> None:
    """Let windows end before the neighbours' and ``rim`` px inside the frame, and flag those that are cut."""
    free = limit_margins(record, start, index)
    for i in range(len(record)):
        x, y, turn, blur = record[i, X], record[i, Y], record[i, ANGLE], 0.25 * record[i, REACH]
        c, s = math.cos(turn), math.sin(turn)
        wide, high = math.hypot(record[i, MAJOR] * c, record[i, MINOR] * s), math.hypot(record[i, MAJOR] * s, record[i, MINOR] * c)
        edge = 0.5 + min(min(x, cols - 1 - x) - wide, min(y, rows - 1 - y) - high)
        if edge < CUT * blur:
            flags[i] |= np.uint32(BORDER)
        if free[i] < CUT * blur:
            flags[i] |= np.uint32(OVERLAPPING)
        record[i, MARGIN] = min(record[i, MARGIN], max(min(edge - rim, free[i]), blur))


@jit
def set_thresholds(record: Array, first: int, stop: int, multiple: Array, excess: Array, whole: bool, noise: Noise) -> None:
    """Write thresholds, given in standard deviations of the background's noise, and their excess noise into records.

    Of whole numbers they lie between two grey values, so that rounding moves no pixel over the threshold.
    """
    for i in range(first, stop):
        level = record[i, LEVEL]
        deviation = math.sqrt(max(variance_of(level - noise.black_dn, noise), 1e-12))
        threshold = min(multiple[i] * deviation, 0.5 * record[i, AMPLITUDE])
        if whole:
            threshold = abs(math.floor(level + record[i, SIGN] * threshold) + 0.5 - level)
        record[i, THRESHOLD], record[i, EXCESS] = threshold, excess[i]


@jit
def conclude(result: Array, at_rest: Flags, usable: Array, s_curve: Array, row_shift: Array, flags: NDArray[np.uint32]) -> None:
    """Add the variances over the sub-pixel phase and of shifted rows to results, and flag what is to be known of them.

    ``result``: x, y, var x, cov, var y, relative standard deviation of the weights' sum; NaN where nothing came to rest.
    """
    for i in range(len(result)):
        if not at_rest[i] or usable[i] == 0.0:
            result[i] = np.nan
            flags[i] |= np.uint32(NOT_CONVERGED)
            continue
        if s_curve[i] > math.sqrt(0.5 * (result[i, 2] + result[i, 4])):
            flags[i] |= np.uint32(UNDER_SAMPLED)
        if result[i, 5] > FAINT:
            flags[i] |= np.uint32(FAINT_FLAG)
        phase = s_curve[i] * s_curve[i]
        result[i, 2] += phase + row_shift[i]
        result[i, 4] += phase
