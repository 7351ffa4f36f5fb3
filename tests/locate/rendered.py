"""Images of targets at known places, by quadrature of the formulas and with nothing of the package in them.

A pixel's value is the target's light, blurred by a Gaussian of standard deviation ``blur``, averaged over a square of side ``aperture``
(0: sampled at the pixel's centre). Place (0, 0) is the centre of the top-left pixel, x goes right, y down. `ellipse` integrates the
blurred chords of the figure over its rows, v = b sin t, by Gauss–Legendre in t: the integrand is analytic, and the error stays below 1e-9
of the amplitude (`test_rendered.py` compares with the noncentral χ² law of a blurred disc and with dense sub-sampling). `edge_disc` is
the simpler model Φ((R − ρ)/s) at the pixels' centres, which many published comparisons use.

All images are of unit amplitude on zero: ``background + amplitude * disc(...)``. `expose` makes grey values of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr

Window = tuple[np.ndarray, np.ndarray]  # row and column numbers, 1-D


def window(x: float, y: float, reach: float, shape: tuple[int, int] | None = None) -> Window:
    """Rows and columns within ``reach`` of a place, cut off at the frame of this shape."""
    rows = np.arange(int(np.floor(y - reach)), int(np.ceil(y + reach)) + 1)
    cols = np.arange(int(np.floor(x - reach)), int(np.ceil(x + reach)) + 1)
    if shape is not None:
        rows, cols = rows[(rows >= 0) & (rows < shape[0])], cols[(cols >= 0) & (cols < shape[1])]
    return rows, cols


@lru_cache
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes between -1 and 1, and their weights; NumPy finds them anew in every call, which takes longer than the integral."""
    return np.polynomial.legendre.leggauss(count)


def _nodes(aperture: float, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets within a pixel and their weights: Gauss–Legendre, in pieces that are not wider than three standard deviations."""
    if aperture == 0:
        return np.zeros(1), np.ones(1)
    pieces = max(1, int(np.ceil(aperture / (3 * blur))))
    at, weight = gauss_legendre(7)
    middles = (np.arange(pieces) + 0.5) / pieces - 0.5
    offsets = (middles[:, None] + at / (2 * pieces)).ravel() * aperture
    return offsets, np.tile(weight / (2 * pieces), pieces)


def over_pixels(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray], at: Window, aperture: float, blur: float, near: np.ndarray | None = None
) -> np.ndarray:
    """Mean over the pixels' squares of a function of (x, y) that varies over ``blur`` or more; shape (rows, cols).

    Elsewhere than ``near`` (rows, cols) it is 0.
    """
    offset, weight = _nodes(aperture, blur)
    out = np.zeros((len(at[0]), len(at[1])))
    row, col = np.nonzero(np.ones(out.shape, bool) if near is None else near)
    fine = function(at[1][col][:, None, None] + offset, at[0][row][:, None, None] + offset[:, None])
    out[row, col] = np.einsum("pij,i,j->p", fine, weight, weight)
    return out


def _density(t: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)


def ellipse(
    x: float,
    y: float,
    semi_major: float,
    semi_minor: float,
    angle_deg: float,
    blur: float,
    at: Window,
    *,
    aperture: float = 1.0,
    light: tuple[float, float] = (0.0, 0.0),
    light_on: str = "surface",
) -> np.ndarray:
    """A blurred ellipse, shape (rows, cols); the major axis is turned by the angle from x towards y.

    ``light`` = (gx, gy) per pixel: light (1 + gx (x − x0) + gy (y − y0)) on the surface, before the blur, or on the image: there it is the
    sensitivity of each pixel as a whole.
    """
    turn = np.deg2rad(angle_deg)
    c, s = np.cos(turn), np.sin(turn)
    # of the quadratic form p u² + 2 q u v + r v² = 1 with u = x − x0, v = y − y0: middle and half of the chord at height v
    p = (c / semi_major) ** 2 + (s / semi_minor) ** 2
    q = c * s * (semi_major**-2 - semi_minor**-2)
    high = np.sqrt((semi_major * s) ** 2 + (semi_minor * c) ** 2)
    count = int(24 + 6 * high / blur)
    t, w = gauss_legendre(count)
    t, w = 0.5 * np.pi * t, 0.5 * np.pi * w
    v = high * np.sin(t)
    half = np.cos(t) / np.sqrt(p)
    middle = -q / p * v
    w = w * high * np.cos(t)

    offset, weight = _nodes(aperture, blur)
    ys, xs = (at[0] - y)[:, None] + offset, (at[1] - x)[:, None] + offset  # [pixel, node in the pixel]
    down = _density((ys[:, :, None] - v) / blur) / blur  # [.., chord]
    first, last = (xs[:, :, None] - (middle - half)) / blur, (xs[:, :, None] - (middle + half)) / blur
    flat = ndtr(first) - ndtr(last)
    gx, gy = light

    def summed(cols: np.ndarray) -> np.ndarray:
        return (np.einsum("rik,i->rk", down, weight) * w) @ np.einsum("cjk,j->ck", cols, weight).T

    if light_on == "image":
        return (1 + gx * (at[1] - x) + gy * (at[0] - y)[:, None]) * summed(flat)
    if light_on != "surface":
        raise ValueError(light_on)
    # ∫ u φ_s(x − u) du over the chord = x (Φ − Φ) + s (φ(first) − φ(last))
    tilted = xs[:, :, None] * flat + blur * (_density(first) - _density(last)) if gx else 0.0
    return summed((1 + gy * v) * flat + gx * tilted)


def disc(x: float, y: float, radius: float, blur: float, at: Window, **settings) -> np.ndarray:
    """A blurred disc; settings as for `ellipse`."""
    return ellipse(x, y, radius, radius, 0.0, blur, at, **settings)


def ring(x: float, y: float, outer: float, inner: float, blur: float, at: Window, **settings) -> np.ndarray:
    """A blurred disc without the smaller disc in its middle; settings as for `ellipse`."""
    return disc(x, y, outer, blur, at, **settings) - disc(x, y, inner, blur, at, **settings)


def spot(x: float, y: float, sigma: float, at: Window, *, aperture: float = 1.0) -> np.ndarray:
    """A Gaussian spot, its peak 1 before the average over the pixel."""

    def one(here: np.ndarray, centre: float) -> np.ndarray:
        t = (here - centre) / sigma
        if aperture == 0:
            return np.exp(-0.5 * t * t)
        e = 0.5 * aperture / sigma
        return np.sqrt(2 * np.pi) * sigma / aperture * (ndtr(t + e) - ndtr(t - e))

    return one(at[0], y)[:, None] * one(at[1], x)


def edge_disc(x: float, y: float, radius: float, s: float, at: Window) -> np.ndarray:
    """Φ((R − ρ)/s) at the pixels' centres; s is the whole blur of the edge, the pixel included."""
    return ndtr((radius - np.hypot(at[1][None, :] - x, at[0][:, None] - y)) / s)


def _along_and_off(x: np.ndarray, y: np.ndarray, x0: float, y0: float, angle_deg: float) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return (x - x0) * c + (y - y0) * s, (y - y0) * c - (x - x0) * s


def _near_line(at: Window, x: float, y: float, angle_deg: float, reach: float) -> np.ndarray:
    """Which pixels have a part within reach of a line."""
    return np.abs(_along_and_off(at[1], at[0][:, None], x, y, angle_deg)[1]) < reach + 0.75


def bar(x: float, y: float, angle_deg: float, length: float, width: float, blur: float, at: Window, *, aperture: float = 1.0) -> np.ndarray:
    """A blurred rectangle about (x, y), its long side turned by the angle from x towards y; the length may be infinite."""

    def value(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        along, off = _along_and_off(px, py, x, y, angle_deg)
        ends = ndtr((along + length / 2) / blur) - ndtr((along - length / 2) / blur)
        return ends * (ndtr((off + width / 2) / blur) - ndtr((off - width / 2) / blur))

    near = _near_line(at, x, y, angle_deg, width / 2 + 9 * blur)  # beyond it there is less than 1e-18
    return over_pixels(value, at, aperture, blur, near)


def gaussian_line(
    x: float, y: float, angle_deg: float, sigma: float, at: Window, *, length: float = np.inf, aperture: float = 1.0
) -> np.ndarray:
    """An infinitely thin line seen through the blur, its ridge 1 before the average over the pixel."""

    def value(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        along, off = _along_and_off(px, py, x, y, angle_deg)
        return np.exp(-0.5 * (off / sigma) ** 2) * (ndtr((along + length / 2) / sigma) - ndtr((along - length / 2) / sigma))

    near = _near_line(at, x, y, angle_deg, 9 * sigma)  # beyond it there is less than 1e-17
    return over_pixels(value, at, aperture, sigma, near)


def edge(x: float, y: float, angle_deg: float, blur: float, at: Window, *, aperture: float = 1.0) -> np.ndarray:
    """A step along a straight line through (x, y): 1 on the side of growing y where the angle is 0."""
    return over_pixels(lambda px, py: ndtr(_along_and_off(px, py, x, y, angle_deg)[1] / blur), at, aperture, blur)


def cross(
    x: float, y: float, angle_deg: float, length: float, width: float, blur: float, at: Window, *, aperture: float = 1.0
) -> np.ndarray:
    """Two equal bars at right angles through (x, y); where both are, the light is not doubled."""
    arms = sum(bar(x, y, angle_deg + turn, length, width, blur, at, aperture=aperture) for turn in (0.0, 90.0))
    return arms - bar(x, y, angle_deg, width, width, blur, at, aperture=aperture)


def scatter(
    rng: np.random.Generator, shape: tuple[int, int], radii: np.ndarray, gap: float = 4.0, margin: float = 4.0
) -> tuple[np.ndarray, np.ndarray]:
    """Random places x, y of discs whose edges stay ``gap`` apart and ``margin`` from the frame's border; the largest are placed first.

    Raises
    ------
    ValueError
        If they do not fit.
    """
    order = np.argsort(-radii)
    x, y = np.full(len(radii), np.nan), np.full(len(radii), np.nan)
    left = order
    for _ in range(200):
        edge = radii[left] + margin - 0.5
        px, py = (rng.uniform(edge, side - 1 - edge) for side in shape[::-1])
        done = order[np.isfinite(x[order])]
        who = np.concatenate([done, left])
        points = np.stack([np.concatenate([x[done], px]), np.concatenate([y[done], py])], axis=1)
        pairs = cKDTree(points).query_pairs(2 * radii.max() + gap, output_type="ndarray")
        near = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T) < radii[who[pairs[:, 0]]] + radii[who[pairs[:, 1]]] + gap
        clash = np.zeros(len(who), bool)
        clash[pairs[near].max(axis=1)] = True  # the later one of two goes
        good = ~clash[len(done) :]
        x[left[good]], y[left[good]] = px[good], py[good]
        left = left[~good]
        if not len(left):
            return x, y
    raise ValueError(f"{len(left)} of {len(radii)} targets found no place")


def expose(
    mean_dn: np.ndarray,
    rng: np.random.Generator | None,
    *,
    read_dn: float = 0.0,
    gain_dn_per_e: float = 0.0,
    black_dn: float = 0.0,
    bits: int | None = 8,
) -> np.ndarray:
    """Grey values of a mean image: Poisson electrons above black, Gaussian read noise, then rounded and cut off to so many bits.

    Without ``rng`` there is no noise; ``bits=None`` leaves them as float32, neither rounded nor cut off.
    """
    values = np.asarray(mean_dn, float)
    if rng is not None:
        if gain_dn_per_e:
            values = black_dn + gain_dn_per_e * rng.poisson(np.maximum(values - black_dn, 0) / gain_dn_per_e)
        values = values + rng.normal(0.0, read_dn, values.shape)
    if bits is None:
        return values.astype(np.float32)
    return np.clip(np.rint(values), 0, 2**bits - 1).astype(np.uint8 if bits <= 8 else np.uint16)


def planted(
    shape: tuple[int, int], background: float | np.ndarray, amplitude: np.ndarray, images: Sequence[tuple[Window, np.ndarray]]
) -> np.ndarray:
    """Mean image of a frame: the targets' images, each on its window, times their amplitudes, on the background."""
    mean = np.zeros(shape) + background
    for height, ((rows, cols), image) in zip(np.broadcast_to(amplitude, len(images)), images, strict=True):
        mean[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] += height * image
    return mean


def discs_frame(
    rng: np.random.Generator,
    *,
    shape: tuple[int, int] = (2048, 2048),
    count: int = 2000,
    radii: tuple[float, float] = (3.0, 8.0),
    amplitude: float = 170.0,
    background: float = 10.0,
    edge_s: float | None = 0.757,
    blur: float | None = None,
    gap: float = 4.0,
    margin: float = 4.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean image (rows, cols) of random discs that do not touch, and their x, y and radii; a negative amplitude makes them dark.

    With ``blur`` they are blurred discs averaged over the pixel, else Φ((R − ρ)/edge_s) at the pixels' centres.
    """
    radius = rng.uniform(*radii, count)
    x, y = scatter(rng, shape, radius, gap, margin)
    images = []
    for i in range(count):
        at = window(x[i], y[i], radius[i] + 5.5 * (blur or edge_s) + 1, shape)
        images.append((at, edge_disc(x[i], y[i], radius[i], edge_s, at) if blur is None else disc(x[i], y[i], radius[i], blur, at)))
    return planted(shape, background, amplitude, images), x, y, radius


def bound(
    mean: Callable[[np.ndarray], np.ndarray], at: Sequence[float], variance_dn2: float | Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Cramér–Rao bound (k, k) of the parameters of a mean image, by central differences; the variance may be a function of the mean."""
    start = np.asarray(at, float)
    slopes = []
    for k in range(len(start)):
        step = np.zeros(len(start))
        step[k] = 1e-4 * max(1.0, abs(start[k]))
        slopes.append(((mean(start + step) - mean(start - step)) / (2 * step[k])).ravel())
    level = mean(start).ravel()
    weight = 1 / (variance_dn2(level) if callable(variance_dn2) else np.full(level.shape, variance_dn2))
    jacobian = np.stack(slopes)
    scale = np.sqrt((jacobian**2 * weight).sum(axis=1))
    return np.linalg.inv((jacobian * weight) @ jacobian.T / np.outer(scale, scale)) / np.outer(scale, scale)
