"""Targets seen, or lit, from several sides: slope of the light over each, and the ellipse that it is seen as.

The template of an ellipse is fitted with a plane of light as a factor and a plane of ground below it. So the slope of the light does not
move the outline, and the offset of the centre of light from that of the outline shows whether the slope explains it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixmetry.camera.views import TargetViews
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.threads import imap_tiles
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate

LEAST_RADIUS_PX = 2.0  # of a target whose light has a slope that is told
LEAST_VIEWS = 2
USELESS = Flag.NOT_CONVERGED | Flag.BORDER | Flag.SATURATED | Flag.CLIPPED_AT_BLACK
SIGNIFICANT = 3.0
SURFACES = (("retro", 0.001), ("diffuse", 0.0045), ("glossy", np.inf))  # 1/px: between those that a budget assumes of each
DIM = 0.5  # light of a view over the brightest one's, below which a retro-reflector is seen from beyond its angle
METHOD = "planes of light fitted with the template of each target; tilt from the ellipses"
COAT = "a coat of the target that is not even looks like a slope of its light: it turns with the target, light does not"
SHADE = "light that falls off towards the corners of the frame (shading) is part of the slope"


@dataclass(frozen=True)
class View:
    """Targets of one frame; arrays of shape (n,), ``gradient`` and ``u`` (n, 2), ``shape`` (n, 2, 2) in px²."""

    name: str
    exposure_s: float
    place: Array
    u_place: Array
    gradient: Array
    u: Array
    shape: Array
    amplitude: Array
    offset: Array


def find_view(frame: np.ndarray, name: str, exposure_s: float, **options: Any) -> View:
    """Find the targets of one frame and the slope of the light over each.

    Raises
    ------
    InputError
        If the frame or an option cannot be used.
    """
    found = locate(frame, name=name, threads=1, kind="ellipse", planes=True, **options)
    c = {k: np.asarray(v, float) for k, v in found.columns.items() if np.asarray(v).dtype.kind in "fiu"}
    if not len(c["x_px"]):
        none = np.zeros((0, 2))
        return View(name, exposure_s, none, np.zeros(0), none, none, np.zeros((0, 2, 2)), np.zeros(0), none)
    gradient = np.column_stack([c["light_x_per_px"], c["light_y_per_px"]])
    u = np.column_stack([c["u_light_x_per_px"], c["u_light_y_per_px"]]) * np.sqrt(np.maximum(c["chi2_per_dof"], 1.0))[:, None]
    place = np.column_stack([c["x_px"], c["y_px"]])
    good = (c["flags"].astype(int) & int(USELESS) == 0) & np.isfinite(gradient + u + place).all(axis=1) & (u > 0).all(axis=1)
    good &= c["semi_minor_px"] > LEAST_RADIUS_PX
    turn = np.radians(c["angle_deg"])
    along = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    across = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    shape = c["semi_major_px"][:, None, None] ** 2 * along[:, :, None] * along[:, None, :]
    shape = shape + c["semi_minor_px"][:, None, None] ** 2 * across[:, :, None] * across[:, None, :]
    offset = np.array([_offset(frame, c, k) if good[k] else (np.nan, np.nan) for k in range(len(place))])
    u_place = np.sqrt(0.5 * (c["var_x_px2"] + c["var_y_px2"]))
    return View(name, exposure_s, place[good], u_place[good], gradient[good], u[good], shape[good], c["amplitude_dn"][good], offset[good])


def _offset(frame: np.ndarray, c: dict[str, Array], k: int) -> tuple[float, float]:
    """Centre of the light in a window about the outline, above the fitted ground, less the centre of the outline; NaN at the border."""
    x, y, reach = c["x_px"][k], c["y_px"][k], c["semi_major_px"][k] + 3.5 * c["blur_px"][k] + 1.0
    half = int(np.ceil(reach)) + 1
    col, row = int(round(x)), int(round(y))
    if min(col, row) < half or col + half >= frame.shape[1] or row + half >= frame.shape[0]:
        return np.nan, np.nan
    part = frame[row - half : row + half + 1, col - half : col + half + 1].astype(float)
    dx, dy = np.arange(-half, half + 1) + col - x, (np.arange(-half, half + 1) + row - y)[:, None]
    light = part - c["background_dn"][k] - c["background_x_dn_per_px"][k] * dx - c["background_y_dn_per_px"][k] * dy
    light = np.where(dx**2 + dy**2 <= reach**2, light, 0.0)
    total = float(light.sum())
    return float((light * dx).sum()) / total, float((light * dy).sum()) / total


def views_of(
    views: Sequence[View], principal_distance_px: float | None = None, pitch_ratio: float = 1.0, shading_per_px: float = 0.0
) -> TargetViews:
    """What views of targets tell.

    Parameters
    ----------
    views : sequence of View
    principal_distance_px : float or None
    pitch_ratio : float
        Pixel pitch along y over that along x, by which circles look oblong in a view from the front.
    shading_per_px : float
        Largest slope that the light has all over the frame, where it is known.

    Returns
    -------
    TargetViews

    Raises
    ------
    MeasureError
        With less than two views that show targets.

    Notes
    -----
    The mean square of the slopes is that of views (what all targets of a view have in common) and that of targets within them, each less
    the variance of the fits; its u counts both by their own degrees of freedom. The tilt of a view comes from the mean of the ellipses'
    elongation as a vector, of which noise has no direction: cos α = b/a.
    """
    shown = [v for v in views if len(v.place)]
    if len(shown) < LEAST_VIEWS:
        empty = f", {len(views) - len(shown)} of {len(views)} frames show none" if len(shown) < len(views) else ""
        what = f"{len(shown)} view{'s' * (len(shown) != 1)} of targets with a radius of {LEAST_RADIUS_PX:g} px or more{empty}"
        raise MeasureError(what, where="views", remedy="take round targets of 6 px or more from 8 sides, below saturation")
    number = np.concatenate([np.full(len(v.place), k) for k, v in enumerate(shown)])
    gradient, u, shape, offset, place = (
        np.concatenate([getattr(v, n) for v in shown]) for n in ("gradient", "u", "shape", "offset", "place")
    )
    light = np.concatenate([np.abs(v.amplitude) / (v.exposure_s or 1.0) for v in shown])
    angle, u_angle = _angles(shown, pitch_ratio)
    slopes, notes = _slopes(shown)
    values = np.linalg.eigvalsh(shape)
    major, minor = np.sqrt(values[:, 1]), np.sqrt(values[:, 0])
    fit = slopes.join(_oblique(angle, u_angle), _diameter(number, major))
    largest = fit["gradient_rel_per_px"].representative
    surface = next(name for name, most in SURFACES if largest < most)
    c = principal_distance_px
    eccentricity = None
    if c is not None:
        radius = np.array([major[number == k].mean() for k in range(len(shown))])
        tilt = np.radians(angle)
        eccentricity = radius**2 * np.sin(tilt) * np.cos(tilt) / (c * (1 - (radius / c * np.sin(tilt)) ** 2))
    predicted = 0.25 * np.einsum("nij,nj->ni", shape, gradient)
    slope, u_slope = _explained(offset, predicted, u, shape)
    if np.isfinite(slope) and abs(slope - 1) > SIGNIFICANT * u_slope and abs(slope - 1) > 0.1:
        notes.append(
            f"slopes of the light explain {slope:.2f} ± {u_slope:.2f} of the offsets of the centroids: something else moves them, too"
        )
    notes += _dim(number, light, angle, [v.exposure_s for v in shown])
    if len(shown) < len(views):
        notes.append(f"{len(views) - len(shown)} frames show no targets of {2 * LEAST_RADIUS_PX:g} px or more below saturation")
    if shading_per_px > 0.5 * largest:
        notes.append(f"the shading of the lens, up to {shading_per_px:.2g} per px, may make up much of the slopes")
    return TargetViews(
        view=number,
        x_px=place[:, 0],
        y_px=place[:, 1],
        gradient_x_per_px=gradient[:, 0],
        gradient_y_per_px=gradient[:, 1],
        u_gradient_x_per_px=u[:, 0],
        u_gradient_y_per_px=u[:, 1],
        semi_major_px=major,
        semi_minor_px=minor,
        centroid_x_px=offset[:, 0],
        centroid_y_px=offset[:, 1],
        predicted_x_px=predicted[:, 0],
        predicted_y_px=predicted[:, 1],
        amplitude_dn_per_s=light,
        angle_deg=angle,
        u_angle_deg=u_angle,
        principal_distance_px=c,
        eccentricity_px=eccentricity,
        surface=surface,
        slope=slope,
        u_slope=u_slope,
        fit=fit,
        notes=tuple(notes),
    )


def _slopes(views: Sequence[View]) -> tuple[Estimates, list[str]]:
    """Standard deviation of the slope of the light about 0, or its limit, and what is to be noted."""
    counts = np.array([len(v.place) for v in views], float)
    n = len(counts) / float((1 / counts).sum())  # harmonic mean of the targets in a view
    means = np.array([v.gradient.mean(axis=0) for v in views])
    noise = float(np.mean([np.square(v.u).mean() for v in views]))
    between, dof = float(np.square(means).mean()), 2.0 * len(views)
    squares, free = sum(float(np.square(v.gradient - v.gradient.mean(axis=0)).sum()) for v in views), 2.0 * float((counts - 1).sum())
    within = squares / free if free else 0.0
    variance = between + (1 - 1 / n) * within - noise
    u_variance = float(np.sqrt(2 * between**2 / dof + ((1 - 1 / n) ** 2 * 2 * within**2 / free if free else 0.0)))
    notes = []
    common = means.mean(axis=0)
    u_common = np.sqrt(np.maximum(means.var(axis=0, ddof=1), noise / n) / len(views))
    if np.hypot(*(common / u_common)) > 2 * SIGNIFICANT and np.hypot(*common) > 0.5 * np.sqrt(max(variance, 0.0)):
        notes.append(
            f"the light has much the same slope in all views, {common[0]:+.2g} and {common[1]:+.2g} per px along x and y: a lamp on the "
            "camera, or shading; what is the same in all images shifts all targets alike"
        )
    if len(views) < 6:
        notes.append(f"{len(views)} views tell the size of the slopes to {1 / np.sqrt(2 * dof):.0%} at best; 8 or more are better")
    of_noise = float(np.sqrt(2 * (noise / n) ** 2 / dof + ((1 - 1 / n) ** 2 * 2 * noise**2 / free if free else 0.0)))
    if variance < SIGNIFICANT * of_noise:
        limit = float(np.sqrt(max(variance, 0.0) + ONE_SIDED_95 * u_variance))
        row = ("gradient_rel_per_px", limit, u_variance / (2 * limit), dof, "1/px")
        why = {"gradient_rel_per_px": "no slope of the light is seen above the noise; 95 % upper limit"}
        fit = Estimates.from_rows([row], method=METHOD, limits=frozenset({"gradient_rel_per_px"}), reasons=why, confounders=(COAT, SHADE))
        return fit, notes
    value = float(np.sqrt(max(variance, 1e-16)))
    row = ("gradient_rel_per_px", value, u_variance / (2 * value), 2 * (variance / u_variance) ** 2, "1/px")
    return Estimates.from_rows([row], method=METHOD, confounders=(COAT, SHADE)), notes


def _angles(views: Sequence[View], pitch_ratio: float) -> tuple[Array, Array]:
    """Tilt of every view in degrees, and its u."""
    angles, us = [], []
    scale = np.diag([1.0, pitch_ratio])  # pixels of x along both axes
    for v in views:
        s = scale @ v.shape @ scale
        trace = s[:, 0, 0] + s[:, 1, 1]
        e = np.column_stack([(s[:, 0, 0] - s[:, 1, 1]) / trace, 2 * s[:, 0, 1] / trace])
        radius = np.sqrt(0.5 * trace)
        each = 2 * v.u_place / radius  # of b/a, of an outline whose place is known so well
        count = len(e)
        mean = e.mean(axis=0)
        u = float(np.sqrt((each**2).mean() / count))
        if count > 2:  # the fitted slopes of the light widen the u of the places, but not that of the outline's shape
            u = max(0.6 * u, float(np.sqrt(e.var(axis=0, ddof=1).mean() / count)))
        size = float(np.sqrt(max(mean @ mean - u**2, 0.0)))
        ratio = np.sqrt((1 - size) / (1 + size))
        angles.append(np.degrees(np.arccos(ratio)))
        size = min(max(size, u), 0.999)
        us.append(np.degrees(u / ((1 + size) * np.sqrt(2 * size * (1 - size)))))  # cos² α = (1 − e)/(1 + e)
    return np.array(angles), np.array(us)


def _oblique(angle: Array, u_angle: Array) -> Estimates:
    """The largest tilt, or its limit."""
    k = int(np.argmax(angle))
    value, u = float(angle[k]), float(u_angle[k])
    if value < SIGNIFICANT * u:
        limit = value + ONE_SIDED_95 * u
        why = {"view_angle_deg": "all views are from the front; 95 % upper limit"}
        return Estimates.from_rows(
            [("view_angle_deg", limit, u, np.inf, "deg")], method=METHOD, limits=frozenset({"view_angle_deg"}), reasons=why
        )
    return Estimates.from_rows([("view_angle_deg", value, u, np.inf, "deg")], method=METHOD)


def _diameter(number: np.ndarray, major: Array) -> Estimates:
    """Mean diameter in the images: the long axis, which no tilt shortens."""
    means = np.array([2 * major[number == k].mean() for k in np.unique(number)])
    u = float(means.std(ddof=1) / np.sqrt(len(means)))
    return Estimates.from_rows([("diameter_px", float(means.mean()), max(u, 1e-3), len(means) - 1.0, "px")], method=METHOD)


def _explained(offset: Array, predicted: Array, u: Array, shape: Array) -> tuple[float, float]:
    """Slope of the offsets of centroids over what the slopes of the light make of them, and its u; NaN where they are too small."""
    good = np.isfinite(offset).all(axis=1)
    noise = 0.25 * np.sqrt(np.linalg.eigvalsh(shape)[:, 1:] ** 2) * u  # of what is predicted
    x, y, s = predicted[good], offset[good], noise[good]
    size = float(np.square(x).sum() - np.square(s).sum())
    if good.sum() < 3 or size < 4 * float(np.sqrt(np.square(s * x).sum() + 1e-30)):
        return float("nan"), float("nan")
    # the noise of a pixel is in both alike, so that it pulls neither up nor down
    slope = float((x * y).sum() / np.square(x).sum())
    left = y - slope * x
    return slope, float(np.sqrt(np.square(left).sum() / (2 * len(x) - 1) / np.square(x).sum()))


def _dim(number: np.ndarray, light: Array, angle: Array, exposures: Sequence[float]) -> list[str]:
    """Views in which targets are dim."""
    if len(set(exposures)) > 1 and not all(exposures):
        return []
    means = np.array([light[number == k].mean() for k in range(len(angle))])
    dim = np.flatnonzero(means < DIM * means.max())
    if not dim.size:
        return []
    return [
        f"targets are dim (below {DIM:.0%} of the brightest view) in {dim.size} views, from {angle[dim].min():.0f}° on: retro-reflectors "
        "seen from beyond their angle, or a lamp that is not beside the lens"
    ]


def measure_views(
    frames: Sequence[tuple[str, float, Callable[[], np.ndarray]]],
    principal_distance_px: float | None = None,
    pitch_ratio: float = 1.0,
    shading_per_px: float = 0.0,
    *,
    on_frames: Callable[[int], object] | None = None,
    **options: Any,
) -> TargetViews:
    """Measure frames of targets that are seen or lit from several sides, given as names, exposures, and functions that return the frames.

    Raises
    ------
    InputError, MeasureError
        If a frame cannot be used, or too few of them show targets.
    """

    def work(item: tuple[str, float, Callable[[], np.ndarray]]) -> View:
        name, exposure_s, fetch = item
        return find_view(fetch(), name, exposure_s, **options)

    found = []
    for view in imap_tiles(work, list(frames)):
        found.append(view)
        if on_frames is not None:
            on_frames(1)
    return views_of(found, principal_distance_px, pitch_ratio, shading_per_px)
