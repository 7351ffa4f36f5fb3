"""Patches of known light in the pictures of a chart; or parts of one scene at several exposures, each of which is a patch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.response import Patch
from pixmetry.core.arrays import Array
from pixmetry.observe.experiment import PictureGroup

LEAST_SIDE_PX = 6
INNER = 0.7  # of a patch's width and height: what lies near its edge is blurred, or in its shadow
BOX_PX = 5  # pictures are averaged over it before patches are searched
STEP = 5.0  # in standard deviations of a box's mean: a larger change is an edge of a patch
BINS = 24  # of levels, in which the noise is estimated
FULL = 0.8  # of its bounding box, of a patch
ALIKE = 1.6  # factor of the area between patches of one chart
CLIPPED_SHARE = 0.001
BLOCK_PX = 16  # of a scene
MOST_BLOCKS = 48
EVEN = 3.0  # factor of the variance in a block over that of its noise, up to which it counts as even
LEAST_LEVELS = 6


@dataclass(frozen=True)
class Found:
    """Patches, the light of white sheets at their places (NaN without), and what was not used."""

    patches: tuple[Patch, ...]
    refused: tuple[str, ...]
    scene: bool  # the light of a place is not known, only its ratio from picture to picture
    u_light_rel: float | None
    white_dn: dict[tuple[int, int], tuple[float, float]]  # by x, y of a patch: value of the white sheet, and its u


def find_patches(groups: Sequence[PictureGroup]) -> Found:
    """Find and measure the patches of all pictures.

    Pictures with densities or luminances are of a chart; those without are of one scene at their exposures. Of both, the chart counts.
    """
    charts = [(k, g) for k, g in enumerate(groups) if _light_of(g) is not None]
    whites = [g for g in groups if g.facts.white]
    scenes = [(k, g) for k, g in enumerate(groups) if _light_of(g) is None and not g.facts.white]
    stated = [g.facts.u_light_rel for g in groups if g.facts.u_light_rel is not None]
    u = max(stated, default=None)
    if not charts:
        patches, refused = _parts_of_scene(scenes)
        return Found(tuple(patches), tuple(refused), True, u, {})
    patches, refused, white = [], [], {}
    if scenes:
        refused.append("pictures without densities beside those of a chart are not used")
    first: dict[tuple[float, ...], int] = {}  # number of the first patch of each chart
    for k, group in charts:
        light = [] if (known := _light_of(group)) is None else known.tolist()
        own, why = _patches_of_chart(k, group)
        number = first.setdefault(tuple(light), sum(len(chart) for chart in first))
        patches += [replace(p, place=p.place + number) for p in own]
        refused += why
    for p in patches:
        for group in whites[:1]:
            seen = _measured(p.picture, p.place, group, (p.x, p.y, p.cols, p.rows), 1.0)
            if isinstance(seen, Patch):
                white[p.x, p.y] = seen.mean_dn, seen.u_mean_dn
    return Found(tuple(patches), tuple(refused), False, u, white)


def _light_of(group: PictureGroup) -> Array | None:
    """Relative light of the patches, in the order in which they are listed; 10^−D of a density D (ISO 5-1)."""
    facts = group.facts
    if facts.densities is not None:
        return 10.0 ** -np.array(facts.densities)
    return None if facts.luminances is None else np.array(facts.luminances)


def _patches_of_chart(picture: int, group: PictureGroup) -> tuple[list[Patch], list[str]]:
    light = _light_of(group)
    assert light is not None
    exposure = group.exposure_s or 1.0
    where = f"picture {picture + 1}"
    rows, cols = group.moments.shape
    if group.facts.regions is not None:
        areas = [inner_region(r) for r in group.facts.regions]
        numbers = np.arange(len(light))
    else:
        boxes, why = search_patches(group.moments.mean_map_dn(), len(light))
        if why:
            return [], [f"{where}: {why}"]
        data = group.moments.mean_map_dn()
        areas = [inner_region(b) for b in boxes]
        means = [float(data[y : y + h, x : x + w].mean()) for x, y, w, h in areas]
        numbers = np.empty(len(light), int)
        numbers[np.argsort(means)] = np.argsort(light)  # the response rises: the brightest patch has the largest value
    found, refused = [], []
    for number, area in zip(numbers, areas, strict=True):
        x, y, w, h = area
        if x + w > cols or y + h > rows:
            refused.append(f"{where}: a region at ({x}, {y}) lies outside of the frame of {cols} × {rows} pixels")
            continue
        seen = _measured(picture, int(number), group, area, exposure * float(light[number]))
        if isinstance(seen, Patch):
            found.append(seen)
        else:
            refused.append(f"{where}: the patch at ({x}, {y}) {seen}")
    return found, refused


def inner_region(box: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """The middle of a patch, away from its edges."""
    x, y, w, h = box
    dx, dy = round(0.5 * (1 - INNER) * w), round(0.5 * (1 - INNER) * h)
    return x + dx, y + dy, w - 2 * dx, h - 2 * dy


def search_patches(data: np.ndarray, count: int) -> tuple[list[tuple[int, int, int, int]], str]:
    """Find even rectangles of about one size: places (x, y, width, height), or why they are not what was listed.

    The picture is averaged over boxes; where boxes to the left and right, or above and below, differ by more than the noise, there is an
    edge. What lies between edges, and fills its bounding box, is a patch; the largest set of about one area is the chart.
    """
    from scipy import ndimage

    data = np.asarray(data, float)
    smooth = ndimage.uniform_filter(data, BOX_PX)
    edge = np.zeros(data.shape, bool)
    limit = np.maximum(STEP * np.sqrt(2) * _noise_at(smooth, data) / BOX_PX, 0.5)
    for axis in (0, 1):
        step = np.abs(np.roll(smooth, -3, axis) - np.roll(smooth, 3, axis))
        edge |= step > limit
    edge[:3] = edge[-3:] = True
    edge[:, :3] = edge[:, -3:] = True
    label, _ = ndimage.label(~edge)
    boxes, areas = [], []
    for number, (sy, sx) in enumerate(ndimage.find_objects(label), start=1):
        h, w = sy.stop - sy.start, sx.stop - sx.start
        if min(h, w) < LEAST_SIDE_PX:
            continue
        filled = int((label[sy, sx] == number).sum())
        if filled >= FULL * h * w:
            boxes.append((sx.start, sy.start, w, h))
            areas.append(h * w)
    if not boxes:
        return [], "no even patches were found; give their regions"
    area = np.array(areas, float)
    alike = np.abs(np.log(area[:, None] / area[None, :])) < np.log(ALIKE)
    best = alike[int(np.argmax(alike.sum(axis=1)))]
    chosen = [box for box, take in zip(boxes, best, strict=True) if take]
    if len(chosen) != count:
        return [], f"even patches of about one size: {len(chosen)} were found, and {count} are listed; give their regions"
    return chosen, ""


def _noise_at(smooth: np.ndarray, data: np.ndarray) -> Array:
    """Noise of the pixels at each level, from the differences of neighbours of like level."""
    difference = np.abs(data[:, 2:] - data[:, :-2])
    level = 0.5 * (smooth[:, 2:] + smooth[:, :-2])
    ends = np.unique(np.quantile(level, np.linspace(0, 1, BINS + 1)))
    if len(ends) < 2:
        return np.full(data.shape, float(np.median(difference)) / 0.6745 / np.sqrt(2))
    number = np.clip(np.searchsorted(ends, level, side="right") - 1, 0, len(ends) - 2)
    noise = np.array([np.median(difference[number == k]) if (number == k).any() else 0.0 for k in range(len(ends) - 1)])
    out: Array = np.interp(smooth, 0.5 * (ends[1:] + ends[:-1]), noise / 0.6745 / np.sqrt(2))
    return out


def _measured(picture: int, place: int, group: PictureGroup, area: tuple[int, int, int, int], light: float) -> Patch | str:
    """Mean and variances of one patch; or why it cannot be used."""
    x, y, w, h = area
    if min(w, h) < 2:
        return "is smaller than 2 × 2 px within its edges"
    moments, frames = group.moments, group.moments.n_frames
    mean_map = moments.mean_map_dn()[y : y + h, x : x + w]
    top = 2.0**group.bits - 1
    clipped = float(((mean_map <= 0.5 / frames) | (mean_map >= top - 0.5 / frames)).mean())
    if clipped > CLIPPED_SHARE:
        return f"is clipped: {100 * clipped:.0f} % of its pixels are at an end of the scale"
    temporal = float("nan")
    if frames > 1:
        temporal = float(moments.deviation_map_dn2()[y : y + h, x : x + w].mean() / (frames - 1))
    even = _without_slope(mean_map)
    n = w * h
    squares = float((even**2).sum()) / max(n - 3, 1)
    spread = squares + (0.0 if frames == 1 else temporal * (1 - 1 / frames))
    of_rows = w * float((even.mean(axis=1) ** 2).sum()) / max(h - 2, 1)  # mean squares of rows and columns, after the plane
    of_cols = h * float((even.mean(axis=0) ** 2).sum()) / max(w - 2, 1)
    u2 = max(of_rows + of_cols - squares, squares) / n
    u2 += min(np.exp(-4 * np.pi**2 * spread) / (2 * np.pi**2), 1 / 12)  # rounding, where noise does not pass it over
    mean = float(mean_map.mean())
    if not 3 * np.sqrt(spread) < mean < top - 3 * np.sqrt(spread):
        return "is clipped by its noise at an end of the scale"
    return Patch(picture, place, x, y, w, h, light, mean, float(np.sqrt(u2)), spread, temporal, frames)


def _of_same_pixels(patch: Patch) -> Patch:
    """Of the same pixels at several exposures the fixed pattern is no error: only the share of the temporal noise counts."""
    if patch.frames < 2:
        return patch
    fixed = patch.spread_dn2 - patch.var_dn2
    temporal = patch.var_dn2 / patch.frames
    share = temporal / max(temporal + fixed, temporal, 1e-12)
    rounding = min(np.exp(-4 * np.pi**2 * patch.spread_dn2) / (2 * np.pi**2), 1 / 12)
    return replace(patch, u_mean_dn=float(np.sqrt((patch.u_mean_dn**2 - rounding) * share + rounding)))


def _without_slope(values: np.ndarray) -> Array:
    """Values less their plane."""
    rows, cols = values.shape
    y, x = np.arange(rows) - 0.5 * (rows - 1), np.arange(cols) - 0.5 * (cols - 1)
    out: Array = values - values.mean()
    out = out - np.outer(y, np.ones(cols)) * (out * y[:, None]).sum() / max((y**2).sum() * cols, 1e-12)
    return out - np.outer(np.ones(rows), x) * (out * x[None, :]).sum() / max((x**2).sum() * rows, 1e-12)


def _parts_of_scene(scenes: Sequence[tuple[int, PictureGroup]]) -> tuple[list[Patch], list[str]]:
    """Even blocks of a scene, spread over its levels, at every exposure at which they are not clipped."""
    times = {g.exposure_s for _, g in scenes}
    if len(times) < 2 or 0.0 in times:
        return [], ["one scene needs two exposures or more, each with its exposure_s; or the densities of a chart"]
    shape = scenes[0][1].moments.shape
    rows, cols = shape[0] // BLOCK_PX, shape[1] // BLOCK_PX
    if not rows or not cols:
        return [], [f"frames of {shape[1]} × {shape[0]} pixels are smaller than a block of {BLOCK_PX} pixels"]
    level, even = np.zeros((rows, cols)), np.ones((rows, cols), bool)
    for _, group in scenes:
        data = group.moments.mean_map_dn()[: rows * BLOCK_PX, : cols * BLOCK_PX]
        tiles = data.reshape(rows, BLOCK_PX, cols, BLOCK_PX).swapaxes(1, 2)
        flat = tiles - tiles.mean(axis=(2, 3), keepdims=True)
        local = (np.diff(tiles, axis=3) ** 2).mean(axis=(2, 3)) / 2
        even &= (flat**2).mean(axis=(2, 3)) <= EVEN * local + 1.0
        level += tiles.mean(axis=(2, 3)) / len(scenes)
    if not even.any():
        return [], ["the scene has no even parts: it is too fine, or it moved; defocus it"]
    where = np.argwhere(even)
    order = where[np.argsort(level[even], kind="stable")]
    taken = order[np.unique(np.linspace(0, len(order) - 1, min(MOST_BLOCKS, len(order))).round().astype(int))]
    patches, clipped = [], 0
    for k, group in scenes:
        for place, (r, c) in enumerate(taken):
            seen = _measured(k, place, group, (int(c) * BLOCK_PX, int(r) * BLOCK_PX, BLOCK_PX, BLOCK_PX), group.exposure_s)
            if isinstance(seen, Patch):
                patches.append(_of_same_pixels(seen))
            else:
                clipped += 1
    refused = [f"{clipped} of {len(taken) * len(scenes)} parts of the scene are clipped"] if clipped else []
    return patches, refused
