"""Figures of a calibration in the object's space: the network, the points with their uncertainty, the shape of the test field."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pixmetry.calibrate.page.figures import MOST_VECTORS, arrows, chain, colour_bar, enlargement, length_key, round_number
from pixmetry.core.arrays import Array
from pixmetry.report.drawing import AMBER, BLUE, INK, RED, SOFT, WIDTH_IN, canvas
from pixmetry.report.numbers import significant
from pixmetry.report.page import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from pixmetry.calibrate.bundle.network import Adjustment
    from pixmetry.calibrate.records import FieldPoints

COLOURS = (BLUE, RED, AMBER)
SIDES = ((-60.0, 25.0), (35.0, 10.0))  # azimuth and elevation from which a network is looked at, degrees
MOST_ELLIPSES = 250
CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 25)), np.sin(np.linspace(0, 2 * np.pi, 25))])


def seen_from(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Directions to the right and upwards of a picture taken from far away, shape (2, 3); Z is up."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([[-np.sin(a), np.cos(a), 0.0], [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]])


def pyramids(adjustment: Adjustment, images: np.ndarray, depth: float) -> np.ndarray:
    """Edges of the viewing pyramids of some images, in the object's space: the two ends of each, shape (edges, 2, 3)."""
    net, state = adjustment.network, adjustment.state
    edges = []
    for k in images:
        camera = adjustment.camera(int(net.camera_of[k]))
        half = np.array([camera.sensor.cols / camera.c_px[0], camera.sensor.rows / camera.c_px[1]]) / 2
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        local = np.column_stack([corners, np.ones(4)])
        base = state.position[k] + depth * local / np.linalg.norm(local[0]) @ state.rotation[k]
        apex = np.broadcast_to(state.position[k], base.shape)
        edges += [np.stack([apex, base], axis=1), np.stack([base, np.roll(base, -1, axis=0)], axis=1)]
    return np.concatenate(edges)


def network_views(adjustment: Adjustment) -> list[Figure]:
    """Cameras as pyramids, points and scale bars, from two sides."""
    state = adjustment.state
    points = state.xyz[state.located]
    everything = np.concatenate([points, state.position[state.posed]])
    if len(everything) < 2:
        return []
    extent = float(np.linalg.norm(np.ptp(everything, axis=0))) or 1.0
    return [_network_view(adjustment, points, extent, number) for number in range(len(SIDES))]


def _network_view(adjustment: Adjustment, points: np.ndarray, extent: float, number: int) -> Figure:
    """The network from one of its two sides."""
    net, state = adjustment.network, adjustment.state
    view = seen_from(*SIDES[number])
    oriented = state.posed
    groups = [np.flatnonzero((net.camera_of == k) & oriented) for k in range(len(net.cameras))]
    edges = [pyramids(adjustment, images, 0.09 * extent) @ view.T if len(images) else np.zeros((0, 2, 2)) for images in groups]
    seen = points @ view.T
    everything = np.concatenate([seen, *(e.reshape(-1, 2) for e in edges)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    low, high = low - 0.03 * (high - low).max(), high + 0.03 * (high - low).max()
    across, up = high - low
    with canvas(0.15 + WIDTH_IN * float(np.clip(up / across, 0.35, 1.1))) as (figure, axes):
        axes.set_axis_off()
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        size, many = (2.0, False) if len(points) <= 500 else (1.0, len(points) > MOST_VECTORS)
        axes.plot(seen[:, 0], seen[:, 1], ".", color=INK, markersize=size, markeredgewidth=0, rasterized=many)
        for k, (images, e) in enumerate(zip(groups, edges, strict=True)):
            style: Any = {"color": COLOURS[k % 3], "linewidth": 0.7 if len(images) < 60 else 0.4, "label": net.cameras[k].name}
            axes.plot(*(chain(e[:, 0, i], e[:, 1, i]) for i in (0, 1)), **style)
        ends = np.stack([state.xyz[net.bars.start], state.xyz[net.bars.end]], axis=1) @ view.T
        axes.plot(*(chain(ends[:, 0, i], ends[:, 1, i]) for i in (0, 1)), color=INK, linewidth=1.8)
        along = ends[:, :1] + np.linspace(0, 1, 9)[:, None] * (ends[:, 1:] - ends[:, :1])
        length = _triad(axes, view, np.concatenate([everything, along.reshape(-1, 2)]), low, high, extent)
        if 1 < len(net.cameras) <= len(COLOURS):
            figure.legend(loc="outside upper center", ncols=3)
        azimuth, elevation = SIDES[number]
        caption = (
            f"The network from azimuth {azimuth:.0f}°, elevation {elevation:.0f}°, without perspective. The axes are "
            f"{significant(length, 1)} {net.unit} long" + ("; thick lines are scale bars." if len(net.bars) else ".")
        ).replace("-", "\u2212")
        alt = f"{int(oriented.sum())} images as pyramids, {len(points)} points and {len(net.bars)} scale bars, side {number + 1} of 2"
        return Figure(figure, f"network-{number + 1}", alt, caption)


def _triad(axes: Axes, view: np.ndarray, seen: np.ndarray, low: np.ndarray, high: np.ndarray, extent: float) -> float:
    """The axes of the object in the emptiest place at the lower or upper edge; returns their length."""
    length = round_number(0.12 * extent)
    tips = length * view.T
    under, over = 1.3 * np.minimum(tips.min(axis=0), 0.0) - 0.15 * length, 1.3 * np.maximum(tips.max(axis=0), 0.0) + 0.15 * length
    columns, rows = np.linspace(low[0] - under[0], high[0] - over[0], 7), (low[1] - under[1], high[1] - over[1])
    places = [np.array([x, y]) for y in rows for x in columns]
    origin = min(places, key=lambda at: int(((seen > at + under) & (seen < at + over)).all(axis=1).sum()))
    x, y = np.repeat(origin[0], 3), np.repeat(origin[1], 3)
    axes.plot(*arrows(x, y, tips[:, 0], tips[:, 1], 1.0), color=SOFT, linewidth=0.9)
    for name, tip in zip("XYZ", tips, strict=True):
        x_text, y_text = origin + 1.25 * tip
        axes.text(x_text, y_text, name, ha="center", va="center", fontsize=7)
    return length


def ellipse(covariance: Array) -> Array:
    """Outline of the standard ellipse of a 2 × 2 covariance about the origin, shape (2, 25)."""
    values, vectors = np.linalg.eigh(covariance)
    outline: Array = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * CIRCLE)
    return outline


def largest_axis(covariance: np.ndarray) -> np.ndarray:
    """Largest semi-axis of each standard ellipsoid; NaN where the point is not determined."""
    out = np.full(len(covariance), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    out[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[known])[:, -1], 0.0))
    return out


def shown_points(size: np.ndarray) -> np.ndarray:
    """Points whose ellipses are drawn: all, or of many the largest and then evenly spread ones."""
    able = np.flatnonzero(size > 0)
    if len(able) <= MOST_ELLIPSES:
        return able
    order = able[np.argsort(-size[able], kind="stable")]
    few = MOST_ELLIPSES // 10
    return np.concatenate([order[:few], order[few :: -(-(len(order) - few) // (MOST_ELLIPSES - few))]])


def plan_views(adjustment: Adjustment) -> list[Figure]:
    """Covariance ellipsoids of the points in two plan views, enlarged; nothing where all points are fixed."""
    net, xyz, covariance = adjustment.network, adjustment.state.xyz, adjustment.point_covariance
    if covariance is None:  # an adjustment may be asked to leave it out
        return []
    size = largest_axis(covariance)
    shown = shown_points(size)
    if not len(shown):
        return []
    known = np.isfinite(xyz).all(axis=1)
    extent = float(np.ptp(xyz[known], axis=0).max()) or 1.0
    factor = round_number(0.035 * extent / float(np.median(size[shown])))
    made = []
    for i, j in ((0, 1), (0, 2)):
        spread = np.ptp(xyz[known], axis=0)[[i, j]]
        height = 0.6 + (WIDTH_IN - 0.75) * float(np.clip(spread[1] / max(spread[0], 1e-12), 0.18, 1.2))
        with canvas(height) as (figure, axes):
            many = int(known.sum()) > MOST_VECTORS
            axes.plot(xyz[known, i], xyz[known, j], ".", color=SOFT, markersize=1.2, markeredgewidth=0, rasterized=many)
            outlines = np.array([ellipse(covariance[np.ix_([k], [i, j], [i, j])][0]) for k in shown])
            lines = [chain(*(xyz[shown, axis] + factor * outlines[:, part].T)) for part, axis in ((0, i), (1, j))]
            axes.plot(*lines, color=BLUE, linewidth=0.7)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_xlabel(f"{'XYZ'[i]} / {net.unit}")
            axes.set_ylabel(f"{'XYZ'[j]} / {net.unit}")
            part = "" if len(shown) == np.sum(size > 0) else f" The {MOST_ELLIPSES // 10} largest and a selection of the others are drawn."
            caption = f"Standard ellipsoids of the points in the {'XYZ'[i]}{'XYZ'[j]} plane, {significant(factor, 1)} times enlarged.{part}"
            made.append(Figure(figure, f"plan-{'xyz'[i]}{'xyz'[j]}", f"Standard ellipses of {len(shown)} points", caption))
    return made


def field_map(adjustment: Adjustment, points: FieldPoints) -> Figure | None:
    """Deviation of the test field's points from their nominal positions: height as colour, deviations in the plane as arrows."""
    net = adjustment.network
    nominal, axes_of = points.xyz, points.axes
    dx, dy, dz = points.dx, points.dy, points.dz
    good = np.isfinite(nominal).all(axis=1) & np.isfinite(dx + dy + dz)
    if not good.any():
        return None
    names = [next(("XYZ"[k] for k in range(3) if abs(row[k]) > 0.999), f"board {i + 1}") for i, row in enumerate(axes_of[:2])]
    (x, y), dx, dy, dz = (nominal[good] @ axes_of[:2].T).T, dx[good], dy[good], dz[good]
    ratio = float(np.clip(np.ptp(y) / max(float(np.ptp(x)), 1e-12), 0.3, 1.3))
    span = float(np.abs(dz).max()) or 1.0
    with canvas(0.7 + 2.75 * ratio) as (figure, axes):
        extent = max(float(np.ptp(x)), float(np.ptp(y)))
        factor, key = enlargement(dx, dy, extent)
        marker = float(np.clip(2400 / len(x), 3, 46))
        many = len(x) > MOST_VECTORS
        style: Any = {"cmap": "RdBu_r", "vmin": -span, "vmax": span, "edgecolors": SOFT, "linewidths": 0.3, "rasterized": many}
        dots = axes.scatter(x, y, c=dz, s=marker, **style)
        axes.plot(*arrows(x, y, dx, dy, factor), color=INK, linewidth=0.7, rasterized=many)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"{names[0]} / {net.unit}")
        axes.set_ylabel(f"{names[1]} / {net.unit}")
        axes.set_axisbelow(True)
        length_key(axes, factor, key, net.unit)
        colour_bar(figure, axes, dots, f"height / {net.unit}")
        low, high = significant(float(dz.min()), 2), significant(float(dz.max()), 2)
        caption = (
            f"Deviation of the points from their nominal positions: heights as colour ({low} to {high} {net.unit}), deviations in "
            "the plane as arrows."
        )
        alt = f"Deviation of {len(x)} points of the test field, heights from {low} to {high} {net.unit}"
        return Figure(figure, "field-map", alt, caption)
