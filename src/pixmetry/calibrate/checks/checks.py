"""Requirements of a network before an adjustment, and values that an adjusted network determines badly.

`check_network` stops what cannot be adjusted (wrong units, one image of a plane, points on a line, groups of images without a tie) and
names what will be left out. `check_determined` looks at an adjustment: a principal distance that only goes with the distances to the
object, a principal point that only goes with the places of the images, rays too parallel, images that got no pose.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.calibrate.checks.quality import plain
from pixmetry.calibrate.start.free_start import common_points
from pixmetry.calibrate.start.resection import FEWEST, FLAT, thickness
from pixmetry.core.arrays import Ints
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding

NEAR_ORIGIN = 0.1  # of the frame: image coordinates that all lie nearer to the origin are not pixels
ONE_PLACE = 0.02  # of the frame: image coordinates that all lie in such a part of it have the wrong unit
ENOUGH = 12  # image points of a camera that would hardly lie in one place by chance
OUTSIDE = 0.2  # share of the image coordinates outside of the frame that is not put down to gross errors
LINE = 0.005  # width by length below which points count as a line
TIE = 3  # common points below which two images do not hold each other
BAR_RATIO = 0.2  # by which a bar may differ from the coordinates of its ends before one of the units must be wrong
UNITS = {1000.0: "m against mm", 100.0: "m against cm", 10.0: "cm against mm", 25.4: "inches against mm"}
SAME = 0.995  # correlation of a parameter with the poses above which it is not determined by itself
POOR_C, POOR_POINT = 0.002, 0.002  # u(c)/c, and u(xp), u(yp) by the frame's width, above which that matters
PARALLEL = np.deg2rad(5.0)  # greatest angle between the rays to a point below which its depth is poor
MORE_IMAGES = "take three images or more, from different directions and rolled by 90°"
NAMED = 5  # names listed in one sentence


def check_network(network: Network) -> tuple[Finding, ...]:
    """Examine a network before it is adjusted.

    Returns
    -------
    tuple of Finding
        Images and points that cannot take part, image coordinates outside of the frame, bars that hold nothing.

    Raises
    ------
    InputError
        If image coordinates are not pixels of the frame, or bars and coordinates are not in one unit.
    MeasureError
        If there is nothing to adjust: no image with enough points, one image of a plane, points on a line, groups without a tie.
    """
    if len(network) == 0 or len(network.images) == 0:
        raise InputError("there are no image coordinates", where="network", remedy="give a table of image, point, x, y")
    findings = [*_check_frames(network), *_check_bars(network)]
    _check_field(network)
    usable, seldom = _usable(network, findings)
    _check_one_image(network, usable)
    _check_ties(network, usable, findings)
    if len(seldom):
        text = f"{many(len(seldom), 'point')} seen in one image only and not used: {_named(network.points, seldom)}"
        findings.append(Finding("single_points", text, "measure them in a second image, or give their coordinates"))
    return tuple(findings)


def many(count: int, word: str) -> str:
    """``1 image``, ``5 images``."""
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def _named(names: tuple[str, ...], which: np.ndarray) -> str:
    head = ", ".join(names[int(i)] for i in which[:NAMED])
    return head if len(which) <= NAMED else f"{head} and {len(which) - NAMED} more"


def _check_frames(network: Network) -> list[Finding]:
    camera_of = network.camera_of[network.image]
    findings = []
    for k, camera in enumerate(network.cameras):
        rows = np.flatnonzero(camera_of == k)
        if len(rows) == 0:
            continue
        x, y, cols, lines = network.x_px[rows], network.y_px[rows], camera.sensor.cols, camera.sensor.rows
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise InputError("image coordinates that are not numbers", where=f"camera {camera.name}", remedy="leave those lines out")
        off = np.maximum(np.abs(x - np.median(x)) / cols, np.abs(y - np.median(y)) / lines)
        extent = f"x {x.min():.4g} … {x.max():.4g}, y {y.min():.4g} … {y.max():.4g}"
        frame = f"pixels of a frame of {cols} × {lines}"
        reach = np.quantile(np.maximum(np.abs(x) / cols, np.abs(y) / lines), 0.98)
        where = f"image coordinates of {camera.name}"
        if reach < NEAR_ORIGIN:
            remedy = "state their unit (mm or px) and origin in the project, or the size of the frame"
            what = "all of them are close to the origin, as if they were not in pixels"
            raise InputError(what, where=where, value=extent, allowed=frame, remedy=remedy)
        if len(rows) >= ENOUGH and np.quantile(off, 0.98) < ONE_PLACE / 2:
            what = f"all of them lie within {ONE_PLACE:.0%} of the frame about one place"
            remedy = "check their unit (mm taken for um?), the pitch of the pixels and the size of the frame"
            raise InputError(what, where=where, value=extent, allowed=f"spread over {frame}", remedy=remedy)
        out = (x < -1) | (x > cols) | (y < -1) | (y > lines)
        if out.mean() > OUTSIDE and min(np.mean(x < -1), np.mean(y < -1)) > OUTSIDE and reach < 0.6:
            remedy = "state that their origin is the middle of the frame"
            raise InputError("they are counted from the middle of the frame", where=where, value=extent, allowed=frame, remedy=remedy)
        if out.mean() > OUTSIDE:
            remedy = "check the size of the frame, the unit and the origin of the image coordinates"
            raise InputError(f"{out.mean():.0%} of them lie outside of the frame", where=where, value=extent, allowed=frame, remedy=remedy)
        if out.any():
            text = f"{many(int(out.sum()), 'image point')} of {camera.name} outside of the frame: {extent} in {cols} × {lines} px"
            findings.append(Finding("outside_frame", text, "check the size of the frame and these points", "warning"))
    return findings


def _check_bars(network: Network) -> list[Finding]:
    bars = network.bars
    if not len(bars):
        return []
    if not (np.isfinite(bars.length).all() and (bars.length > 0).all()):
        remedy = "correct or drop these bars"
        raise InputError("lengths must be above 0", where="scale bars", value=float(np.min(bars.length)), remedy=remedy)
    if (bars.start == bars.end).any():
        name = network.points[int(bars.start[bars.start == bars.end][0])]
        raise InputError("a bar needs two different points", where="scale bars", value=name)
    findings = []
    rays = np.bincount(network.point, minlength=len(network.points))
    loose = np.flatnonzero((rays[bars.start] < 2) | (rays[bars.end] < 2))
    if len(loose):
        ends = ", ".join(f"{network.points[bars.start[b]]} to {network.points[bars.end[b]]}" for b in loose[:NAMED])
        text = f"{len(loose)} scale bars end at points seen in fewer than two images: {ends}"
        findings.append(Finding("loose_bars", text, "measure their ends in two images or more", "warning"))
    there = np.linalg.norm(network.xyz[bars.start] - network.xyz[bars.end], axis=1)
    given = np.isfinite(there) & (there > 0)
    if not given.any():
        return findings
    ratio = float(np.median(bars.length[given] / there[given]))
    if abs(np.log(ratio)) <= BAR_RATIO:
        return findings
    units = [name for factor, name in UNITS.items() if abs(abs(np.log(ratio)) - np.log(factor)) < BAR_RATIO]
    if units or np.isfinite(network.u_xyz).all(axis=1).sum() >= 2:
        what = "bars contradict the known coordinates"
        if units:
            what = f"bars and coordinates of the points are not in one unit ({units[0]}?)"
        value = f"bar length by distance between the points {ratio:.4g}"
        raise InputError(what, where="scale bars", value=value, allowed="about 1", remedy="use one unit, and check the bars' points")
    text = f"scale bars are {ratio:.3g} times as long as the approximate coordinates say"
    return [*findings, Finding("bar_ratio", text, "the scale bars are used; check their points and lengths", "warning")]


def _usable(network: Network, findings: list[Finding]) -> tuple[np.ndarray, np.ndarray]:
    """Images that can take part, and free points that only one of them sees."""
    usable, seldom, few, lines = _taking_part(network)
    for which, reason in ((few, f"fewer than {FEWEST} usable points"), (lines, "all its points on one line")):
        if which:
            text = f"{many(len(which), 'image')} left out, each with {reason}: {_named(network.images, np.array(which))}"
            advice = f"an image needs {FEWEST} points, better 12, spread over its frame"
            findings.append(Finding("images_left_out", text, advice, "warning"))
    if not usable.any():
        reason = f"no image shares {FEWEST} points with others or with known ones"
        reason = "points on a line in each image" if len(lines) > len(few) else reason
        remedy = "check that the names of the points agree between the images, and distribute the points over the frame"
        raise MeasureError("no image can be used", where="network", value=reason, allowed=f"{FEWEST} points or more", remedy=remedy)
    return usable, seldom


def _taking_part(network: Network) -> tuple[np.ndarray, np.ndarray, list[int], list[int]]:
    """Images that can take part, free points that only one of them sees, images with too few points and with points on one line."""
    known = network.control
    usable = np.ones(len(network.images), bool)
    few: list[int] = []
    lines: list[int] = []
    while True:
        rows = np.flatnonzero(usable[network.image])
        rays = np.bincount(network.point[rows], minlength=len(network.points))
        rows = rows[(known | (rays >= 2))[network.point[rows]]]
        count = np.bincount(network.image[rows], minlength=len(usable))
        new = np.flatnonzero(usable & (count < FEWEST))
        straight = [int(i) for i in np.flatnonzero(usable & (count >= FEWEST)) if _on_line(network, rows[network.image[rows] == i])]
        if not len(new) and not straight:
            break
        few += [int(i) for i in new]
        lines += straight
        usable[few + lines] = False
    return usable, np.flatnonzero(~known & (rays == 1)), few, lines


def _on_line(network: Network, rows: np.ndarray) -> bool:
    x, y = network.x_px[rows], network.y_px[rows]
    if len(rows):
        sensor = network.cameras[network.camera_of[network.image[rows[0]]]].sensor
        inside = (np.abs(2 * x - sensor.cols) < 2 * sensor.cols) & (np.abs(2 * y - sensor.rows) < 2 * sensor.rows)
        x, y = x[inside], y[inside]  # one that lies a million pixels off draws all others on a line
    return len(x) > 2 and thickness(np.column_stack([x, y, np.zeros(len(x))]))[1] < LINE


def _check_field(network: Network) -> None:
    seen = np.bincount(network.point, minlength=len(network.points)) > 0
    images = np.unique(network.image)
    line = network.given[seen].all() and seen.sum() > 2 and thickness(network.xyz[seen])[1] < LINE
    if line or all(_on_line(network, np.flatnonzero(network.image == i)) for i in images):
        remedy = "use points spread over a plane, better a volume"
        raise MeasureError("all points lie on one line", where="object points", value=f"{seen.sum()} points", remedy=remedy)
    fixed = network.control & seen
    if len(images) == 1 and fixed.sum() < FEWEST:
        what, value = "one image does not determine points that are not known", f"{fixed.sum()} known points"
        raise MeasureError(what, where=network.images[int(images[0])], value=value, remedy=MORE_IMAGES)


def _check_one_image(network: Network, usable: np.ndarray) -> None:
    if usable.sum() > 1:
        return
    only = int(np.flatnonzero(usable)[0])
    known = network.control
    seen = network.point[network.image == only]
    if network.cameras[network.camera_of[only]].free.any() and thickness(network.xyz[seen[known[seen]]])[0] < FLAT:
        what = "one image of a plane does not determine a camera: principal distance and principal point cannot be separated from the pose"
        raise MeasureError(what, where=network.images[only], allowed="several images, or one of a field with depth", remedy=MORE_IMAGES)


def _check_ties(network: Network, usable: np.ndarray, findings: list[Finding]) -> None:
    """Groups of images that share too few points to be connected."""
    fixed = network.control
    images = np.flatnonzero(usable)
    control = np.bincount(network.image[fixed[network.point]], minlength=len(usable))[images] >= FEWEST
    first, second = np.nonzero(np.triu(common_points(network)[np.ix_(images, images)] >= TIE, 1))
    by_control = np.flatnonzero(control)  # images with enough known points hold each other
    first, second = np.concatenate([first, by_control[:-1]]), np.concatenate([second, by_control[1:]])
    graph = coo_matrix((np.ones(len(first)), (first, second)), (len(images), len(images)))
    label = _joined(network, images, connected_components(graph, directed=False)[1])
    size = np.bincount(label)
    if len(size) == 1:
        return
    order = np.argsort(-size, kind="stable")
    groups = [images[label == g] for g in order]
    if size[order[1]] >= 2:
        text = "; ".join(f"{len(group)} images ({_named(network.images, group)})" for group in groups[:4] if len(group) > 1)
        allowed = f"{TIE} common points between one group and the other, better 10"
        remedy = "take images that show both, check the names of the points, or calibrate the groups separately"
        raise MeasureError("the network consists of separate parts", where="network", value=text, allowed=allowed, remedy=remedy)
    alone = np.concatenate(groups[1:])
    text = f"{many(len(alone), 'image')} with fewer than {TIE} points in common with any other: {_named(network.images, alone)}"
    findings.append(Finding("images_left_out", text, "take images that overlap, or check the names of the points", "warning"))


def _joined(network: Network, images: Ints, label: Ints) -> Ints:
    """Join groups that share `TIE` points as a whole, though no two of their images do."""
    group: Ints = np.full(len(network.images), -1)
    group[images] = label
    while True:
        rows = np.flatnonzero(group[network.image] >= 0)
        seen = np.zeros((group.max() + 1, len(network.points)))
        seen[group[network.image[rows]], network.point[rows]] = 1.0
        first, second = np.nonzero(np.triu(seen @ seen.T >= TIE, 1))
        if not len(first):
            return group[images]
        graph = coo_matrix((np.ones(len(first)), (first, second)), (len(seen), len(seen)))
        group[images] = connected_components(graph, directed=False)[1][group[images]]


def check_determined(adjustment: Adjustment) -> tuple[Finding, ...]:
    """Find values that an adjustment determines badly, and data that it left out.

    Returns
    -------
    tuple of Finding

    Raises
    ------
    MeasureError
        If a principal distance is not determined: its correlation with the distances to the object is stated.
    """
    network, state = adjustment.network, adjustment.state
    findings = [*left_out(network, state), *_both_sides(network, state)]
    if adjustment.covariance.size:
        for k in range(len(network.cameras)):
            findings += _check_camera(adjustment, k)
    return (*findings, *_parallel_rays(network, state, adjustment.used))


def left_out(network: Network, state: State) -> list[Finding]:
    """Images without a pose, though `check_network` let them pass, and the points that go with them."""
    posed = state.posed
    missing = np.flatnonzero(~posed & _taking_part(network)[0])
    if not len(missing):
        return []
    size = len(network.images)
    measured = np.bincount(network.image, minlength=size)
    count = np.bincount(network.image[np.isfinite(state.xyz[network.point, 0])], minlength=size)
    names = ", ".join(f"{network.images[i]} ({count[i]} of its {measured[i]} points are determined without it)" for i in missing[:NAMED])
    more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
    verb = "is" if len(missing) == 1 else "are"
    text = f"{len(missing)} of {np.count_nonzero(measured)} images {verb} not oriented and not used: {names}{more}"
    rays = [np.bincount(network.point[rows], minlength=len(network.points)) for rows in (slice(None), posed[network.image])]
    gone = int(((rays[0] >= 2) & (rays[1] < 2) & ~np.isfinite(state.xyz[:, 0])).sum())
    if gone:
        text += f"; with them {'goes' if gone == 1 else 'go'} {many(gone, 'point')} that too few other images show"
    advice = "give them rough poses or more points that other images show; check the names of their points and their camera"
    if (count[missing] >= 2 * FEWEST).all():  # there is nothing that they lack: what is said of them is wrong
        advice = "check the names of their points, their camera, and whether x and y are swapped: enough of their points are determined"
    return [Finding("images_left_out", text, advice, "warning")]


def _both_sides(network: Network, state: State) -> list[Finding]:
    points = state.xyz[np.isfinite(state.xyz[:, 0])]
    posed = np.flatnonzero(state.posed)
    if len(points) < FEWEST or thickness(points)[0] > FLAT:
        return []
    middle = points.mean(axis=0)
    side = (state.position[posed] - middle) @ np.linalg.svd(points - middle, full_matrices=False)[2][2] > 0
    fewer = posed[side == (side.mean() < 0.5)]
    if not len(fewer) or len(fewer) == len(posed):
        return []
    text = f"the plane of the points seems to be seen from behind in {many(len(fewer), 'image')}: {_named(network.images, fewer)}"
    return [
        Finding(
            "both_sides", text, "unless the field is transparent, these images are mirrored or their points have wrong names", "warning"
        )
    ]


def _check_camera(adjustment: Adjustment, k: int) -> list[Finding]:
    network, camera = adjustment.network, adjustment.network.cameras[k]
    u = {name: _u(adjustment, f"{camera.name}:{name}") for name in ("c", "xp", "yp")}
    c, width, findings = adjustment.state.interior[k, 0], camera.sensor.cols, []
    images = [int(i) for i in np.flatnonzero((network.camera_of == k) & adjustment.state.posed)]
    if u["c"] is not None:
        r = _median([_correlation(adjustment, f"{camera.name}:c", i, 2) for i in images])
        if abs(r) > SAME and u["c"] > POOR_C * c:
            value = f"u(c)/c = {u['c'] / c:.2g}, correlation of c with the distances {r:+.6f}"
            remedy = "add images tilted by 30° to 60° against the plane, or points that differ in depth"
            if u["c"] > 25 * POOR_C * c:
                raise MeasureError("the principal distance c is not determined", where=camera.name, value=value, remedy=remedy)
            text = f"the principal distance of {camera.name} is badly determined: {value}"
            findings.append(Finding("correlation", text, remedy, "warning"))
    for name, axis in (("xp", 0), ("yp", 1)):
        u_name = u[name]
        if u_name is not None and u_name > POOR_POINT * width:
            r = _median([_correlation(adjustment, f"{camera.name}:{name}", i, axis) for i in images])
            size = f"u = {plain(u_name, 2)} px"
            text = f"{name} of {camera.name} is badly determined: {size}, correlation with the positions of the images {r:+.4f}"
            rolled = _rolled(adjustment.state.rotation[images])
            advice = "add images from other directions" if rolled else "roll the camera by 90° in some of the images"
            findings.append(Finding("correlation", text, advice, "warning"))
    return findings


def _u(adjustment: Adjustment, name: str) -> float | None:
    if name not in adjustment.free_columns:
        return None
    i = adjustment.free_columns.index(name)
    return float(np.sqrt(adjustment.covariance[i, i]))


def _correlation(adjustment: Adjustment, name: str, image: int, axis: int) -> float:
    """Correlation of a parameter with the place of an image along one axis of its camera."""
    columns = adjustment.free_columns
    head = f"{adjustment.network.images[image]}:"
    if f"{head}X0" not in columns or name not in columns:
        return np.nan
    i, first = columns.index(name), columns.index(f"{head}X0")
    along = adjustment.state.rotation[image, axis]
    own = adjustment.covariance[first : first + 3, first : first + 3]
    with np.errstate(all="ignore"):
        spread = np.sqrt(adjustment.covariance[i, i] * (along @ own @ along))
        return float(along @ adjustment.covariance[first : first + 3, i] / spread)


def _median(values: list[float]) -> float:
    values = [value for value in values if np.isfinite(value)]
    return float(np.median(values)) if values else float("nan")


def _rolled(rotation: np.ndarray) -> bool:
    """Whether the rows of the images have different directions in the object, some at least 45° from others."""
    x = rotation[:, 0]
    return bool(len(x) and np.min(np.abs(x @ x.T)) < np.cos(np.deg2rad(45)))


def _parallel_rays(network: Network, state: State, used: np.ndarray) -> list[Finding]:
    free = ~(network.u_xyz == 0).all(axis=1)
    known = np.isfinite(state.position[network.image, 0]) & np.isfinite(state.xyz[network.point, 0])
    rows = np.flatnonzero(used & free[network.point] & known)
    if not len(rows):
        return []
    ray = state.xyz[network.point[rows]] - state.position[network.image[rows]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    point, count = network.point[rows], np.bincount(network.point[rows], minlength=len(network.points))
    outer = np.stack([np.bincount(point, (ray[:, a] * ray[:, b]), len(count)) for a in range(3) for b in range(3)], axis=1)
    values = np.linalg.eigvalsh(outer.reshape(-1, 3, 3) / np.maximum(count, 1)[:, None, None])
    angle = 2 * np.arcsin(np.sqrt(np.clip(values[:, 1] + values[:, 0], 0, 1)))  # of two rays: between them; of many: twice their rms spread
    poor = np.flatnonzero((count >= 2) & (angle < PARALLEL))
    if not len(poor):
        return []
    share = f"{len(poor)} of {np.count_nonzero(count >= 2)} points"
    text = f"the rays to {share} meet at less than {np.rad2deg(PARALLEL):.0f}°: {_named(network.points, poor)}"
    return [Finding("parallel_rays", text, "their depth is uncertain; take images from positions that are farther apart", "warning")]
