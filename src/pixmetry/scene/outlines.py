"""Outlines of targets: closed chains of straight lines and elliptic arcs, in pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.errors import ParameterError
from pixmetry.scene._contour_kernels import SEGMENT

FAR_PX = 1e6  # how far an edge that has no end goes


@dataclass(frozen=True)
class Outline:
    """The outline of one shape, which may have holes; the shape lies to the left of the way round as seen with y upwards.

    Parameters
    ----------
    segments : ndarray, shape (m, 13), float64
        As the kernels want them.
    height_photons : float
        Of the shape above what lies under it, in photons per pixel and exposure; negative for a dark one.
    oval : ndarray, shape (6,), optional
        Centre and conjugate half axes (cx, cy, ux, uy, vx, vy), if the shape is an ellipse.
    target : dict
        What `targets` tells of it (kind, x_px, y_px, …); empty for parts of something.
    """

    segments: np.ndarray
    height_photons: float
    oval: np.ndarray | None = None
    target: dict[str, Any] = field(default_factory=dict)

    def box(self) -> tuple[float, float, float, float]:
        """The least x and y, and the greatest."""
        x, y = self.segments[:, [9, 11]], self.segments[:, [10, 12]]
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())


def polygon(x_px: ArrayLike, y_px: ArrayLike, height_photons: float, /, **target: object) -> Outline:
    """A shape with straight sides, from its corners in order (either way round)."""
    x, y = np.asarray(x_px, float), np.asarray(y_px, float)
    if x.shape != y.shape or x.ndim != 1 or len(x) < 3 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ParameterError("a polygon cannot be used", where="scene", allowed="three or more corners, finite x and y, equally many")
    xn, yn = np.roll(x, -1), np.roll(y, -1)
    if (x * yn - xn * y).sum() < 0:
        x, y = x[::-1], y[::-1]
        xn, yn = np.roll(x, -1), np.roll(y, -1)
    return Outline(_lines(x, y, xn, yn), float(height_photons), target=dict(target))


def _lines(x1: np.ndarray, y1: np.ndarray, x2: np.ndarray, y2: np.ndarray) -> np.ndarray:
    out = np.zeros((len(x1), SEGMENT))
    out[:, 1], out[:, 2], out[:, 3], out[:, 4] = x1, y1, x2 - x1, y2 - y1
    out[:, 8] = 1.0
    out[:, 9], out[:, 10], out[:, 11], out[:, 12] = x1, y1, x2, y2
    return out


def arcs(oval: np.ndarray, start_rad: float, end_rad: float) -> np.ndarray:
    """Segments of an elliptic arc c + u cos t + v sin t, cut where it turns in x or in y."""
    ux, uy, vx, vy = oval[2:]
    low, high = min(start_rad, end_rad), max(start_rad, end_rad)
    cuts = np.unique(np.array([np.arctan2(vx, ux), np.arctan2(vy, uy)])[:, None] + np.pi * np.arange(-8, 9))
    t = np.concatenate([[low], cuts[(cuts > low + 1e-12) & (cuts < high - 1e-12)], [high]])
    t = t[::-1] if end_rad < start_rad else t
    return _arcs(np.broadcast_to(oval, (len(t) - 1, 6)), t[:-1], t[1:])


def whole_ovals(ovals: np.ndarray) -> np.ndarray:
    """Segments of many ellipses, four of each; shape (k, 4, 13)."""
    ux, uy, vx, vy = ovals[:, 2:].T
    t = np.stack([np.arctan2(vx, ux), np.arctan2(vy, uy)], axis=1) % np.pi
    t = np.sort(np.concatenate([t, t + np.pi], axis=1), axis=1)
    t = np.concatenate([t, t[:, :1] + 2 * np.pi], axis=1)
    return _arcs(np.repeat(ovals, 4, axis=0), t[:, :-1].ravel(), t[:, 1:].ravel()).reshape(-1, 4, SEGMENT)


def _arcs(ovals: np.ndarray, t1: np.ndarray, t2: np.ndarray) -> np.ndarray:
    out = np.zeros((len(t1), SEGMENT))
    out[:, 0] = 1.0
    out[:, 1:7] = ovals
    out[:, 7], out[:, 8] = t1, t2
    for column, t in ((9, t1), (11, t2)):
        out[:, column : column + 2] = ovals[:, :2] + ovals[:, 2:4] * np.cos(t)[:, None] + ovals[:, 4:] * np.sin(t)[:, None]
    return out


def oval_of(x_px: float, y_px: float, width_px: float, height_px: float, angle_deg: float = 0.0) -> np.ndarray:
    """Centre and half axes of an ellipse whose first axis is turned by ``angle_deg`` from x towards y."""
    if not (np.isfinite([x_px, y_px, angle_deg]).all() and 0 < width_px <= 1e5 and 0 < height_px <= 1e5):
        raise ParameterError(
            "an ellipse cannot be used", where="scene", value=(x_px, y_px, width_px, height_px), allowed="finite place, axes 0 to 1e5 px"
        )
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    a, b = 0.5 * width_px, 0.5 * height_px
    return np.array([x_px, y_px, a * c, a * s, -b * s, b * c], float)


def from_oval(oval: np.ndarray, height_photons: float, **target: object) -> Outline:
    """The shape within an ellipse given by its conjugate half axes."""
    oval = np.array(oval, float)
    if oval[2] * oval[5] - oval[3] * oval[4] < 0:
        oval[4:] = -oval[4:]
    told = {"kind": "ellipse", "x_px": float(oval[0]), "y_px": float(oval[1])} | dict(target)
    return Outline(whole_ovals(oval[None])[0], float(height_photons), oval, told)


def ellipse(x_px: float, y_px: float, width_px: float, height_px: float, angle_deg: float = 0.0, height_photons: float = 1000.0) -> Outline:
    """An ellipse of two full axes; the first is turned by ``angle_deg`` from x towards y (downwards)."""
    return from_oval(
        oval_of(x_px, y_px, width_px, height_px, angle_deg), height_photons, width_px=width_px, height_px=height_px, angle_deg=angle_deg
    )


def disc(x_px: float, y_px: float, diameter_px: float, height_photons: float = 1000.0) -> Outline:
    """A disc."""
    return from_oval(oval_of(x_px, y_px, diameter_px, diameter_px), height_photons, kind="disc", diameter_px=diameter_px)


def ring(x_px: float, y_px: float, diameter_px: float, inner_px: float, height_photons: float = 1000.0) -> Outline:
    """A ring between two diameters."""
    if not 0 < inner_px < diameter_px:
        raise ParameterError("a ring cannot be used", where="ring.inner_px", value=inner_px, allowed="above 0, below diameter_px")
    outer, inner = oval_of(x_px, y_px, diameter_px, diameter_px), oval_of(x_px, y_px, inner_px, inner_px)
    segments = np.concatenate([arcs(outer, 0.0, 2 * np.pi), arcs(inner, 2 * np.pi, 0.0)])
    told = {"kind": "ring", "x_px": float(x_px), "y_px": float(y_px), "diameter_px": diameter_px, "inner_px": inner_px}
    return Outline(segments, float(height_photons), target=told)


def _turned(x_px: float, y_px: float, angle_deg: float, u: ArrayLike, v: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    u, v = np.asarray(u, float), np.asarray(v, float)
    return x_px + c * u - s * v, y_px + s * u + c * v


def line(
    x_px: float, y_px: float, length_px: float, width_px: float, angle_deg: float = 0.0, height_photons: float = 1000.0, kind: str = "line"
) -> Outline:
    """A straight line of some length and width about its middle, ``angle_deg`` from x towards y; a wire is a thin one, bright or dark."""
    if not (0 < length_px <= 2 * FAR_PX and 0 < width_px <= 2 * FAR_PX):
        raise ParameterError(
            "a line cannot be used", where="line", value=(length_px, width_px), allowed=f"length and width 0 to {2 * FAR_PX:g} px"
        )
    a, b = 0.5 * length_px, 0.5 * width_px
    x, y = _turned(x_px, y_px, angle_deg, [-a, a, a, -a], [-b, -b, b, b])
    told = {"kind": kind, "x_px": float(x_px), "y_px": float(y_px), "angle_deg": float(angle_deg), "width_px": float(width_px)}
    return polygon(x, y, height_photons, **told)


def cross(x_px: float, y_px: float, size_px: float, width_px: float, angle_deg: float = 0.0, height_photons: float = 1000.0) -> Outline:
    """A cross of two equal bars."""
    if not 0 < width_px < size_px:
        raise ParameterError("a cross cannot be used", where="cross.width_px", value=width_px, allowed="above 0, below size_px")
    a, b = 0.5 * size_px, 0.5 * width_px
    u = [-a, -b, -b, b, b, a, a, b, b, -b, -b, -a]
    v = [-b, -b, -a, -a, -b, -b, b, b, a, a, b, b]
    x, y = _turned(x_px, y_px, angle_deg, u, v)
    return polygon(x, y, height_photons, kind="cross", x_px=float(x_px), y_px=float(y_px), angle_deg=float(angle_deg))


def edge(x_px: float, y_px: float, angle_deg: float = 5.0, height_photons: float = 1000.0) -> Outline:
    """A straight edge through a point: bright to the right of it; ``angle_deg`` turns it from the y axis (towards −x below)."""
    x, y = _turned(x_px, y_px, angle_deg, [0, FAR_PX, FAR_PX, 0], [-FAR_PX, -FAR_PX, FAR_PX, FAR_PX])
    return polygon(x, y, height_photons, kind="edge", x_px=float(x_px), y_px=float(y_px), angle_deg=float(angle_deg))


def star(
    x_px: float,
    y_px: float,
    diameter_px: float,
    sectors: int,
    inner_px: float = 0.0,
    angle_deg: float = 0.0,
    height_photons: float = 1000.0,
) -> list[Outline]:
    """A Siemens star: as many bright sectors as dark gaps, from the inner to the outer diameter; the first begins at ``angle_deg``."""
    if not (2 <= sectors <= 720 and 0 <= inner_px < diameter_px <= 1e5):
        raise ParameterError(
            "a star cannot be used",
            where="star",
            value=(sectors, inner_px, diameter_px),
            allowed="2 to 720 sectors, inner below outer diameter",
        )
    parts = []
    outer = oval_of(x_px, y_px, diameter_px, diameter_px)
    for k in range(sectors):
        t1 = np.deg2rad(angle_deg) + 2 * np.pi * k / sectors
        t2 = t1 + np.pi / sectors
        rays = np.array([[np.cos(t1), np.sin(t1)], [np.cos(t2), np.sin(t2)]])
        far, near = 0.5 * diameter_px * rays + [x_px, y_px], 0.5 * inner_px * rays + [x_px, y_px]
        pieces = [arcs(outer, t1, t2), _lines(*(np.array([v]) for v in (*far[1], *near[1])))]
        if inner_px > 0:
            pieces.append(arcs(oval_of(x_px, y_px, inner_px, inner_px), t2, t1))
        pieces.append(_lines(*(np.array([v]) for v in (*near[0], *far[0]))))
        told = {"kind": "star", "x_px": float(x_px), "y_px": float(y_px), "diameter_px": diameter_px, "sectors": sectors} if k == 0 else {}
        parts.append(Outline(np.concatenate(pieces), float(height_photons), target=told))
    return parts


def bars(
    x_px: float,
    y_px: float,
    period_px: float,
    count: int,
    length_px: float,
    angle_deg: float = 0.0,
    duty: float = 0.5,
    height_photons: float = 1000.0,
) -> list[Outline]:
    """A grating of bright bars about its middle; its lines are turned by ``angle_deg`` from the y axis."""
    if not (0 < period_px <= 1e5 and 1 <= count <= 10000 and 0 < duty < 1):
        raise ParameterError(
            "a grating cannot be used", where="bars", value=(period_px, count, duty), allowed="period above 0, 1 to 10000 bars, duty 0 to 1"
        )
    parts = []
    for k in range(count):
        x, y = _turned(x_px, y_px, angle_deg, (k - 0.5 * (count - 1)) * period_px, 0.0)
        bar = line(float(x), float(y), length_px, duty * period_px, angle_deg + 90.0, height_photons, kind="bar")
        parts.append(bar)
    return parts


def step_chart(
    x_px: float, y_px: float, patch_px: float, levels_photons: ArrayLike, columns: int, gap_px: float = 0.0, angle_deg: float = 0.0
) -> list[Outline]:
    """A chart of square patches of given heights, row by row about its middle."""
    levels = np.atleast_1d(np.asarray(levels_photons, float))
    if not (patch_px > 0 and gap_px >= 0 and columns >= 1 and np.isfinite(levels).all()):
        raise ParameterError("a step chart cannot be used", where="steps", allowed="patch above 0 px, gap 0 px or more, finite levels")
    pitch, rows = patch_px + gap_px, -(-len(levels) // columns)
    parts = []
    for k, level in enumerate(levels):
        u, v = (k % columns - 0.5 * (columns - 1)) * pitch, (k // columns - 0.5 * (rows - 1)) * pitch
        x, y = _turned(x_px, y_px, angle_deg, u, v)
        parts.append(line(float(x), float(y), patch_px, patch_px, angle_deg, float(level), kind="patch"))
    return parts
