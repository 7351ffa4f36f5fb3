"""Find lines and edges of any direction in a frame."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.extras import import_extra
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.background import scale_of
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.lines import _line_detect_kernels as kernels
from pixmetry.locate.lines.line_candidates import LineCandidates
from pixmetry.locate.noise import NoiseModel

POLARITIES = {"auto": 0, "bright": 1, "dark": -1}
LINE_SCALES = (1.0, 2.0, 4.0)  # px; lines up to about 16 px wide
EDGE_SCALES = (1.2, 2.4)
LEAST_SIGMA, SEED_SIGMA = 3.5, 5.0  # of the smoothed derivative's noise: to be in a chain, to begin one
SIGNIFICANT = 9.0  # amplitude over its standard deviation, of a matched filter
MOST_TURN = 0.35  # rad: what turns more over its length is no line
TOLERANCE_PX = 1.0
STRONGER = 3.0  # times as high: such lines leave traces beside them
BLOCK = 32  # px, for the map of the noise


def find_lines(
    frame: np.ndarray,
    *,
    polarity: str = "auto",
    noise: NoiseModel | None = None,
    least_length_px: float = 12.0,
    threads: int | None = None,
) -> LineCandidates:
    """Find straight or slightly curved lines.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
        Finite.
    polarity : {"auto", "bright", "dark"}
        Whether lines are brighter or darker than what lies beside them; "auto" takes both.
    noise : NoiseModel, optional
        By default the noise is taken from the frame, by blocks.
    least_length_px : float
        What is shorter, or shorter than three times its width, is no line.
    threads : int, optional

    Returns
    -------
    LineCandidates
        Longest first. Ends lie where the height falls to one half, or at the frame's border.

    Raises
    ------
    InputError
        If an argument cannot be used.

    Notes
    -----
    Points on ridges of the frame, smoothed at several scales (Steger 1998), are linked to chains, cut where a parabola no longer fits,
    and followed both ways across gaps and crossings. What remains must stand out by 9 standard deviations of a matched filter: with about
    1e12 places, directions, lengths and widths in a frame of 4 million pixels, and 1e-19 for each, white noise of the known standard
    deviation gives less than one false line in 1e6 frames. Left out: what lies mostly close beside lines three times as high, and the gap
    between parallel lines if it is nearer to the usual grey value than they are.
    """
    if polarity not in POLARITIES:
        raise InputError("no such polarity", value=polarity, allowed=", ".join(POLARITIES))
    return _find(frame, kernels.LINE, POLARITIES[polarity], noise, least_length_px, threads)


def find_edges(
    frame: np.ndarray, *, noise: NoiseModel | None = None, least_length_px: float = 12.0, threads: int | None = None
) -> LineCandidates:
    """Find straight or slightly curved edges between a darker and a brighter side; a line has two.

    Parameters
    ----------
    frame, noise, least_length_px, threads
        As for `find_lines`.

    Notes
    -----
    As `find_lines`, from points at which the gradient is greatest along its own direction (J. Canny, IEEE Trans. PAMI 8(6), 679 (1986)),
    with two thresholds: 5 standard deviations of its noise to begin a chain, 3.5 to belong to one.
    """
    return _find(frame, kernels.STEP, 0, noise, least_length_px, threads)


def _find(
    frame: np.ndarray, kind: int, polarity: int, noise: NoiseModel | None, least_length_px: float, threads: int | None
) -> LineCandidates:
    if not (np.isfinite(least_length_px) and least_length_px >= 6):
        raise InputError("a length that lines must have cannot be used", value=least_length_px, allowed="6 px or more")
    if min(frame.shape) < 8:
        return LineCandidates.of(x1_px=np.zeros(0))
    light = np.ascontiguousarray(frame, np.float32)
    grain = scale_of(frame, -math.inf, math.inf)[2]
    sigma = _noise_map(light, noise, max(grain, 1e-30) / math.sqrt(12))
    points, scale = _points(light, sigma, kind, polarity, threads)
    ratio = points[:, :, 0].ravel()
    seeds = np.flatnonzero(ratio > SEED_SIGMA)
    seeds = seeds[np.argsort(-ratio[seeds], kind="stable")]
    least = max(int(0.5 * least_length_px), 5)
    x, y, start, origin = kernels.chains(points, seeds, kind, least)
    found = np.empty((4 * len(x) // least + 16, 7))
    found = found[: kernels.pieces(x, y, start, least, TOLERANCE_PX, MOST_TURN, found)]
    chain = found[:, 6].astype(np.int64)
    states = np.zeros((len(found), kernels.STATE))
    states[:, :6] = found[:, :6]
    states[:, 10] = sigma.ravel()[origin[chain]] if len(found) else 0.0
    strengths = _strengths(light, kind, states, scale.ravel()[origin[chain]] if len(found) else np.zeros(0), threads)
    states = states[(strengths > SIGNIFICANT) & _long_enough(states, kind, least_length_px)]
    return _candidates(_once(states, kind, light), kind, frame)


def _noise_map(light: np.ndarray, noise: NoiseModel | None, least_dn: float) -> np.ndarray:
    """Standard deviation of the noise at every pixel: of the model at the smoothed grey value, or by blocks of the frame and not
    below ``least_dn``, that of rounding.

    J. Immerkær, Computer Vision and Image Understanding 64(2), 300 (1996): a mask that planes and edges along the grid do not pass; here
    its median by blocks instead of the mean, which lines and edges raise.
    """
    cv2 = import_extra("cv2")

    if noise is not None:
        known: np.ndarray = np.sqrt(noise.variance_dn2(cv2.GaussianBlur(light, (0, 0), 2.0))).astype(np.float32)
        return known
    mask = np.array([1.0, -2.0, 1.0], np.float32)
    rough = np.abs(cv2.sepFilter2D(light, cv2.CV_32F, mask, mask)) / 6.0
    rows, cols = max(light.shape[0] // BLOCK, 1), max(light.shape[1] // BLOCK, 1)
    tall, wide = min(BLOCK, light.shape[0]), min(BLOCK, light.shape[1])
    blocks = rough[: rows * tall, : cols * wide].reshape(rows, tall, cols, wide)
    block = 1.4826 * np.median(blocks, axis=(1, 3)).astype(np.float32)
    block = np.maximum(block, max(0.7 * float(np.median(block)), least_dn)).astype(np.float32)
    if min(block.shape) > 2:
        block = cv2.medianBlur(block, 3)
    sigma: np.ndarray = cv2.resize(block, light.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return sigma


def _points(light: np.ndarray, sigma: np.ndarray, kind: int, polarity: int, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Points on ridges or steps, shape (rows, cols, 5), and the scale at which each was found."""
    cv2 = import_extra("cv2")

    rows = light.shape[0]
    points, scale = np.zeros((*light.shape, kernels.FIELDS), np.float32), np.zeros(light.shape, np.float32)
    bands = [(first, min(first + 128, rows)) for first in range(0, rows, 128)]
    for s in LINE_SCALES if kind == kernels.LINE else EDGE_SCALES:
        g, g1, g2 = _gaussians(s)

        def smoothed(along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
            smooth: np.ndarray = cv2.sepFilter2D(light, cv2.CV_32F, along_x[::-1], along_y[::-1], borderType=cv2.BORDER_REPLICATE)
            return smooth

        gx, gy = smoothed(g1, g), smoothed(g, g1)
        before = points[:, :, 4].copy()
        if kind == kernels.LINE:
            arrays = (gx, gy, smoothed(g2, g), smoothed(g1, g1), smoothed(g, g2), sigma)
            unit = math.sqrt(float((g2**2).sum() * (g**2).sum()))
            map_tiles(lambda b: kernels.ridge_points(*arrays, unit, s, polarity, LEAST_SIGMA, *b, points), bands, threads)  # noqa: B023
        else:
            unit = math.sqrt(float((g1**2).sum() * (g**2).sum()))
            map_tiles(lambda b: kernels.step_points(gx, gy, sigma, unit, s, LEAST_SIGMA, *b, points), bands, threads)  # noqa: B023
        scale[points[:, :, 4] > before] = s
    return points, scale


def _gaussians(s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A Gaussian and its first two derivatives, float32, as kernels of a convolution that give 1, x and x²/2 their due."""
    x = np.arange(-math.ceil(4 * s), math.ceil(4 * s) + 1.0)
    g = np.exp(-0.5 * (x / s) ** 2)
    g /= g.sum()
    g1 = -x * g / (x**2 * g).sum()
    g2 = (x**2 - (x**2 * g).sum()) * g
    g2 *= 2.0 / (x**2 * g2).sum()
    return g.astype(np.float32), g1.astype(np.float32), g2.astype(np.float32)


def _strengths(light: np.ndarray, kind: int, states: np.ndarray, scales: np.ndarray, threads: int | None) -> np.ndarray:
    """Describe and follow lines, in place; return their strengths, 0 if it is not a line."""
    out = np.zeros(len(states))
    scales = np.ascontiguousarray(scales, float)
    parts = [(first, min(first + 16, len(states))) for first in range(0, len(states), 16)]
    map_tiles(lambda b: kernels.refine(light, kind, states, scales, *b, MOST_TURN, out), parts, threads)
    return out


def _long_enough(states: np.ndarray, kind: int, least_length_px: float) -> np.ndarray:
    """Whether lines have the length that was asked for, and are three times as long as wide."""
    length, blur = states[:, 5] - states[:, 4], np.hypot(states[:, 8], 0.2887)
    wide = np.maximum(states[:, 9], 2.355 * blur) if kind == kernels.LINE else 1.5 * blur
    long: np.ndarray = (length >= least_length_px) & (length >= 3.0 * wide)
    return long


def _once(states: np.ndarray, kind: int, light: np.ndarray) -> np.ndarray:
    """Keep one of those that are the same line, the longest; and of a gap between parallel lines and the lines, the lines."""
    length = states[:, 5] - states[:, 4]
    order = np.argsort(-length, kind="stable")
    states = states[order]
    kept: list[int] = []
    usual = _usual_levels(light) if kind == kernels.LINE and len(states) else None
    standing = np.zeros(len(states))
    if usual is not None:
        column = np.clip(states[:, 0] / light.shape[1] * usual.shape[1], 0, usual.shape[1] - 1).astype(int)
        row = np.clip(states[:, 1] / light.shape[0] * usual.shape[0], 0, usual.shape[0] - 1).astype(int)
        level = usual[row, column]
        standing = np.abs(states[:, 6] + states[:, 7] - level) - np.abs(states[:, 6] - level)
    for i, state in enumerate(states):
        if not any(_same(states[j], state, kind, standing[j], standing[i]) for j in kept):
            kept = [j for j in kept if not _hidden(states[j], state, kind, standing[j], standing[i])]
            kept.append(i)
    states = states[kept]
    return states[[not _beside_stronger(state, states) for state in states]]


def _usual_levels(light: np.ndarray) -> np.ndarray:
    """Median grey value of the neighbourhood, by blocks."""
    rows, cols = (max(side // 128, 1) for side in light.shape)
    tall, wide = light.shape[0] // rows, light.shape[1] // cols
    usual: np.ndarray = np.median(light[: rows * tall, : cols * wide].reshape(rows, tall, cols, wide), axis=(1, 3))
    return usual


def _aside(long: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Greatest distance of the middle part of one line from another, and the share of it that lies beside that."""
    c, s = math.cos(other[2]), math.sin(other[2])
    places = np.linspace(0.9 * other[4], 0.9 * other[5], 5)
    sag = 0.5 * other[3] * places**2
    x, y = other[0] + c * places - s * sag - long[0], other[1] + s * places + c * sag - long[1]
    c, s = math.cos(long[2]), math.sin(long[2])
    t = c * x + s * y
    d = c * y - s * x - 0.5 * long[3] * t * t
    inside = (t > long[4] - 3.0) & (t < long[5] + 3.0)
    return float(np.abs(d[inside]).max()) if inside.any() else math.inf, float(inside.mean())


def _beside_stronger(weak: np.ndarray, states: np.ndarray) -> bool:
    """Whether a line that is much lower than others lies mostly in their corners, where residuals look like a line."""
    strong = states[np.abs(states[:, 7]) > STRONGER * abs(weak[7])]
    if not len(strong):
        return False
    c, s = math.cos(weak[2]), math.sin(weak[2])
    places = np.linspace(weak[4], weak[5], 9)[:, None]
    x, y = weak[0] + c * places - strong[:, 0], weak[1] + s * places - strong[:, 1]
    c, s = np.cos(strong[:, 2]), np.sin(strong[:, 2])
    t, d = c * x + s * y, c * y - s * x
    reach = strong[:, 9] + 10.0 * np.hypot(strong[:, 8], 0.3) + 6.0 * math.hypot(weak[8], 0.3) + weak[9]
    near = (np.abs(d - 0.5 * strong[:, 3] * t * t) < reach) & (t > strong[:, 4] - reach) & (t < strong[:, 5] + reach)
    return float(near.any(axis=1).mean()) > 0.6


def _same(long: np.ndarray, other: np.ndarray, kind: int, standing: float, other_standing: float) -> bool:
    distance, share = _aside(long, other)
    if share < 0.5:
        return False
    alike = math.cos(long[2] - other[2]) * long[7] * other[7] > 0 if kind == kernels.STEP else long[7] * other[7] > 0
    if alike:
        return bool(distance < 1.5 + 0.5 * max(long[9], other[9]) + (math.hypot(long[8], 0.3) if kind == kernels.LINE else 0.0))
    return _hidden(other, long, kind, other_standing, standing)


def _hidden(gap: np.ndarray, line: np.ndarray, kind: int, standing: float, line_standing: float) -> bool:
    """Whether one is the gap beside a line of the other polarity: less of it differs from the median grey value."""
    if kind != kernels.LINE or gap[7] * line[7] > 0 or standing >= line_standing:
        return False
    distance, share = _aside(line, gap)
    spread = sum(max(v[9], 2.355 * math.hypot(v[8], 0.3)) for v in (gap, line))
    return share >= 0.5 and distance < spread


def _candidates(states: np.ndarray, kind: int, frame: np.ndarray) -> LineCandidates:
    x, y, angle, curve, least, most, base, height, blur, width, sigma = states.T
    c, s = np.cos(angle), np.sin(angle)
    ends = [(x + c * t - s * 0.5 * curve * t * t, y + s * t + c * 0.5 * curve * t * t) for t in (least, most)]
    out = LineCandidates.of(
        x1_px=ends[0][0],
        y1_px=ends[0][1],
        x2_px=ends[1][0],
        y2_px=ends[1][1],
        curvature_per_px=curve,
        blur_px=blur,
        width_px=width if kind == kernels.LINE else np.zeros_like(width),
        amplitude_dn=height,
        background_dn=base,
        sigma_dn=sigma,
    )
    rows, cols = frame.shape
    near = np.zeros(len(out), bool)
    for ex, ey in ends:
        near |= np.min([ex, cols - 1 - ex, ey, rows - 1 - ey], axis=0) < out.core_px if len(out) else near
    out.flags[near] |= np.uint32(Flag.BORDER)
    return out
