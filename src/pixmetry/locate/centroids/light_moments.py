"""Moments of all light of a target: centroids of targets of any shape, and widths, azimuth and ellipticity of beams (ISO 11146)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pixmetry.core.arrays import Array, Flags
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.targets import Flag, Positions, Targets
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel

REACH = 4.0  # of a blob's light beyond half its height, in standard deviations of its edge
RIM_PX = 4.0  # width of the ground about it that its background is taken from, at least
LEAST_GROUND = 24  # pixels
APERTURE = 3.0  # side of the aperture over the beam's width, ISO 11146-1:2021
GROUND_FROM, GROUND_WIDTH = 1.2, 0.6  # where the ground of a beam begins, and its width, in half sides of the aperture
PASSES, REST = 60, 1e-4  # of the widths and, relative to these, of the centroid
DAMPED_FROM = 15
TO_AND_FRO = 0.5  # of its u, by which a moment may still move as pixels of the ground come in and go out
ROUND = 0.87  # ratio of the widths from which a beam is round and has no azimuth, ISO 11146-1:2021: its aperture is upright
SMEAR_SIGNIFICANT = 6.0  # standard deviations of χ² of the columns' offsets over its expectation
GRAIN, OUTLIER_SIGMA = 0.6, 4.0  # least spread of rounded values, DN; from where on a value of the ground is not its noise
SECTORS = 8  # of the ground, whose means tell how far it is from a plane
LEAST_SIDE_PX = 3.0
CUT_SHARE = 1e-3  # of a beam's power beyond the frame's border, from which that is said
GAUSSIAN_HALF = math.sqrt(2 * math.log(2))  # half width at half height over the standard deviation
SAME = 0.5  # of a width, within which two regions (the lobes of a mode) have led to the same beam


class Ground(NamedTuple):
    """The plane of the background about a target: a + b·dx + c·dy from the middle of its window."""

    plane: Array  # shape (3,)
    covariance: Array  # shape (3, 3), DN²


def blob_positions(frame: np.ndarray, targets: Targets, noise: NoiseModel, *, threads: int | None = None) -> Positions:
    """Locate targets of any shape by the centroid of their light above the background.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
        As they were detected.
    noise : NoiseModel
    threads : int, optional

    Returns
    -------
    Positions
        In ``more``: amplitude_dn, background_dn, semi_major_px, semi_minor_px, angle_deg (of the region above half height), blur_px.

    Notes
    -----
    A threshold says which pixels belong to a target: those above half its height, and those nearer to them than to another target's, up
    to 4 standard deviations of the edge away. Their grey values above the background, a plane fitted to the ground around them, are summed
    without a threshold, so that neither blur nor the pixels move the centroid of an asymmetric shape. With x̂ = Σ g x / Σ g the variance is
    Σ σ² (x − x̂)² / (Σ g)², and that of the plane; the latter is that of means of eight sectors of the ground, where these scatter by more
    than their noise. Light that a neighbour throws over the border between both is not told apart: such targets are flagged.
    """
    n = len(targets)
    table = np.full((n, 6), np.nan)
    flags = targets.flags.astype(np.uint32)

    def measure(i: int) -> None:
        table[i], touched = _blob(frame, targets, i, noise)
        flags[i] |= np.uint32(Flag.OVERLAPPING if touched else 0)

    map_tiles(measure, range(n), threads)
    flags |= np.where(np.isfinite(table[:, 0]), np.uint32(0), np.uint32(Flag.NOT_CONVERGED))
    more = {
        "amplitude_dn": targets.amplitude_dn, "background_dn": table[:, 5], "semi_major_px": targets.semi_major_px,
        "semi_minor_px": targets.semi_minor_px, "angle_deg": targets.angle_deg, "blur_px": targets.blur_px,
    }  # fmt: skip
    x, y, var_x, cov, var_y = table[:, :5].T.copy()
    return Positions(x, y, var_x, cov, var_y, flags, more)


def _blob(frame: np.ndarray, targets: Targets, i: int, noise: NoiseModel) -> tuple[Array, bool]:
    """x, y, var x, cov, var y, background of one target; whether another one touches it."""
    from scipy.ndimage import distance_transform_edt, label

    nothing = np.full(6, np.nan)
    sign, height, blur = np.sign(targets.amplitude_dn[i]), abs(targets.amplitude_dn[i]), max(float(targets.blur_px[i]), 0.3)
    box = [int(v[i]) for v in (targets.row_first, targets.row_stop, targets.col_first, targets.col_stop)]
    reach = REACH * blur
    wide = math.ceil(reach + max(RIM_PX, 0.3 * math.sqrt((box[1] - box[0]) * (box[3] - box[2])))) + 1
    r0, r1 = max(box[0] - wide, 0), min(box[1] + wide, frame.shape[0])
    c0, c1 = max(box[2] - wide, 0), min(box[3] + wide, frame.shape[1])
    grey = frame[r0:r1, c0:c1].astype(float)
    y, x = np.mgrid[r0:r1, c0:c1].astype(float)
    x0, y0 = float(targets.x_px[i]), float(targets.y_px[i])
    slope = targets.background_x_dn_per_px[i] * (x - x0) + targets.background_y_dn_per_px[i] * (y - y0)
    light = sign * (grey - targets.background_dn[i] - slope)
    regions, count = label(light > 0.5 * height, np.ones((3, 3)))
    inside = regions[box[0] - r0 : box[1] - r0, box[2] - c0 : box[3] - c0]
    sizes = np.bincount(inside.ravel(), minlength=count + 1)
    sizes[0] = 0
    own = int(np.argmax(sizes))
    if not sizes[own]:
        return nothing, False
    # others of any height: what is a quarter of this one's, or 5 σ
    others = label(np.abs(grey - targets.background_dn[i] - slope) > max(0.25 * height, 5 * targets.sigma_dn[i]), np.ones((3, 3)))[0]
    joined = np.unique(others[regions == own])
    foreign = (others > 0) & ~np.isin(others, joined) | (regions > 0) & (regions != own)
    seeds = np.where(regions == own, 1, np.where(foreign, 2, 0))
    distance, nearest = distance_transform_edt(seeds == 0, return_indices=True)
    nearest_seed = seeds[tuple(nearest)]
    mine = (nearest_seed == 1) & (distance <= reach)
    ring = (distance > reach) & (nearest_seed > 0)
    touched = bool((foreign & (distance_transform_edt(seeds != 1) <= 2 * reach)).any())
    if ring.sum() < LEAST_GROUND:
        return nothing, touched
    ground = _ground(grey, x - x0, y - y0, ring)
    design = np.stack([np.ones(int(mine.sum())), x[mine] - x0, y[mine] - y0])
    light = sign * (grey[mine] - ground.plane @ design)
    total = light.sum()
    if not total > 0:
        return nothing, touched
    dx, dy = (x[mine] - x0), (y[mine] - y0)
    mx, my = (light @ dx) / total, (light @ dy) / total
    weights = np.stack([dx - mx, dy - my]) * sign / total
    covariance = (weights * _variances(grey[mine], noise)) @ weights.T
    by_plane = weights @ design.T
    covariance += by_plane @ ground.covariance @ by_plane.T
    return np.array([x0 + mx, y0 + my, covariance[0, 0], covariance[0, 1], covariance[1, 1], ground.plane[0]]), touched


def _variances(grey: Array, noise: NoiseModel) -> Array:
    variances: Array = np.maximum(noise.variance_dn2(grey), 0.0)
    return variances


def _ground(grey: Array, dx: Array, dy: Array, ring: Flags, grain_dn: float = 0.0) -> Ground:
    """A plane through the ground, without what lies 4 σ off, and its covariance from the scatter of pixels or, if larger, of sectors.

    ``grain_dn``: least spread of rounded values, most of which may be alike.
    """
    design, values = np.stack([np.ones(int(ring.sum())), dx[ring], dy[ring]], axis=1), grey[ring]
    use = np.ones(len(values), bool)
    for _ in range(4):
        plane = np.linalg.lstsq(design[use], values[use], rcond=None)[0]
        off = values - design @ plane
        sigma = 1.4826 * float(np.median(np.abs(off[use] - np.median(off[use]))))
        sigma = max(sigma, grain_dn) if sigma > 0 else float(off[use].std())
        before, use = use, np.abs(off) <= 4 * max(sigma, 1e-12)
        if (use == before).all() or use.sum() < LEAST_GROUND:
            break
    use = use if use.sum() >= LEAST_GROUND else before
    variance = float((off[use] ** 2).sum()) / max(int(use.sum()) - 3, 1)
    sector = ((np.arctan2(dy[ring], dx[ring]) / (2 * np.pi) % 1.0) * SECTORS).astype(int) % SECTORS
    count = np.bincount(sector[use], minlength=SECTORS)
    mean = np.bincount(sector[use], off[use], minlength=SECTORS) / np.maximum(count, 1)
    seen = count > 0
    scatter = float((count[seen] * mean[seen] ** 2).sum()) / max(int(seen.sum()) - 3, 1)
    normal = design[use].T @ design[use]
    return Ground(np.asarray(plane, float), max(variance, scatter) * np.linalg.pinv(normal))


def beam_positions(
    frame: np.ndarray, targets: Targets, noise: NoiseModel | None = None, *, aperture_px: float = 1.0, threads: int | None = None
) -> Positions:
    """Centroid, both principal widths D4σ, azimuth and ellipticity of beams, from first and second moments by ISO 11146-1.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
        As they were detected; lobes of one beam are merged.
    noise : NoiseModel, optional
        By default it is measured in the image, by what a filter of second differences along rows and columns leaves of a smooth beam.
    aperture_px : float
        Side of the pixel's light-sensitive square: its share of the second moments is taken away (1/12 of its square; Sheppard).
    threads : int, optional

    Returns
    -------
    Positions
        One a target; NaN with the flag NOT_CONVERGED where there is no beam, or another target has led to the same one. In ``more``:
        d4sigma_major_px and d4sigma_minor_px (widths along the principal axes), angle_deg (of the major axis, from x towards y, −90 … 90),
        ellipticity (minor over major), their ``u_``, semi_major_px and semi_minor_px (half the widths), amplitude_dn, background_dn.

    Notes
    -----
    The moments are taken over a rectangle along the principal axes whose sides are three times the widths, about the centroid, iterated
    until both rest (ISO 11146-1:2021). The background (ISO 11146-3:2004) is a plane through the ground about the rectangle, and, where the
    columns of the ground differ by more than their noise (smear of a CCD), an offset of each column, the median of its ground above and
    below. Where the frame's border cuts the rectangle, the pixels beyond are those opposite the centroid, half of whose share is in u.

    The covariance is that of linear propagation: each pixel's noise, the plane (or what eight sectors of the ground scatter, if that is
    more) and the columns' offsets. It holds no light beyond the rectangle: a halo that ends there is part of the beam, one that does not is
    part of the ground. Where the two widths are nearly the same there is no azimuth: u_angle_deg is then that of any, 52°.
    """
    n = len(targets)
    noise = beam_noise(frame, targets) if noise is None else noise
    names = ("x", "y", "var_x", "cov", "var_y", "major", "minor", "angle", "ellipticity", "u_major", "u_minor", "u_angle", "u_ellipticity")
    table, more_flags, ground = np.full((n, len(names)), np.nan), np.zeros(n, np.uint32), np.full(n, np.nan)

    def measure(i: int) -> None:
        found = _beam(frame, targets, i, noise, aperture_px)
        if found is not None:
            table[i], ground[i], more_flags[i] = found

    map_tiles(measure, range(n), threads)
    for i in np.argsort(-np.abs(targets.amplitude_dn), kind="stable"):
        near = np.hypot(table[:, 0] - table[i, 0], table[:, 1] - table[i, 1]) < SAME * np.fmin(table[:, 6], table[i, 6])
        table[near & (np.arange(n) != i)] = np.nan
    column = dict(zip(names, table.T.copy(), strict=True))
    for i in np.flatnonzero(np.isfinite(table[:, 0])):
        apart = np.hypot(table[:, 0] - table[i, 0], table[:, 1] - table[i, 1])
        if ((apart > 0) & (apart < APERTURE / 2 * (table[i, 5] + table[:, 5]))).any():
            more_flags[i] |= np.uint32(Flag.OVERLAPPING)
    lost = ~np.isfinite(table).all(axis=1)
    flags = targets.flags.astype(np.uint32) & ~np.uint32(Flag.BORDER | Flag.OVERLAPPING) | more_flags
    more = {
        "amplitude_dn": targets.amplitude_dn, "background_dn": ground,
        "d4sigma_major_px": column["major"], "d4sigma_minor_px": column["minor"], "angle_deg": column["angle"],
        "ellipticity": column["ellipticity"], "u_d4sigma_major_px": column["u_major"], "u_d4sigma_minor_px": column["u_minor"],
        "u_angle_deg": column["u_angle"], "u_ellipticity": column["u_ellipticity"],
        "semi_major_px": 0.5 * column["major"], "semi_minor_px": 0.5 * column["minor"],
    }  # fmt: skip
    flags |= np.where(lost, np.uint32(Flag.NOT_CONVERGED), np.uint32(0))
    return Positions(column["x"], column["y"], column["var_x"], column["cov"], column["var_y"], flags, more)


class Moments(NamedTuple):
    """Moments in one aperture, and what they hang on."""

    centre: Array  # shape (2,)
    spread: Array  # shape (2, 2)
    total: float
    weights: Array  # shape (5, rows, cols): derivatives of x, y, xx, xy, yy by each grey value, where the background is known
    filled: Array  # shape (5,): shares of pixels beyond the border
    cut: float  # of the power


def _beam(frame: np.ndarray, targets: Targets, i: int, noise: NoiseModel, aperture_px: float) -> tuple[Array, float, int] | None:
    sign = float(np.sign(targets.amplitude_dn[i]))
    centre = np.array([targets.x_px[i], targets.y_px[i]])
    axes = _axes(targets.angle_deg[i])
    half = np.array([targets.semi_major_px[i], targets.semi_minor_px[i]]) / GAUSSIAN_HALF
    spread = axes.T @ np.diag(np.maximum(half, 0.5) ** 2) @ axes
    if not np.isfinite(spread).all():
        return None
    smeared, settled = False, False
    for k in range(PASSES):
        window = _Window.about(frame, centre, spread)
        if window is None:
            return None
        ground, offsets, u_offsets = window.background(smeared)
        smeared |= bool(u_offsets.any())  # what one aperture shows is there in the next one too
        found = window.moments(sign, ground.plane, offsets)
        if found is None:
            return None
        step = np.append(found.centre - centre, (found.spread - spread)[np.triu_indices(2)])
        size = math.sqrt(np.trace(spread))
        settled = bool(np.abs(step[:2]).max() + np.abs(step[2:]).max() / size < REST * size)
        share = 1.0 if k < DAMPED_FROM else 0.5
        centre, spread = centre + share * (found.centre - centre), spread + share * (found.spread - spread)
        if settled:
            break
    assert window is not None and found is not None
    if window.fills_frame():
        return None
    covariance = np.einsum("arc,brc,rc->ab", found.weights, found.weights, _variances(window.grey, noise))
    by_plane = np.einsum("arc,krc->ak", found.weights, window.design)
    covariance += by_plane @ ground.covariance @ by_plane.T
    by_column = found.weights.sum(axis=1)
    covariance += (by_column * u_offsets**2) @ by_column.T + np.diag((0.5 * found.filled) ** 2)
    if not settled and (np.abs(step) > TO_AND_FRO * np.sqrt(np.diag(covariance))).any():
        return None
    spread = found.spread - np.eye(2) * aperture_px**2 / 12
    beam = _principal(spread, covariance)
    if beam is None:
        return None
    level = float(ground.plane @ np.array([1.0, *(found.centre - window.middle)]))
    flags = int(Flag.BORDER) if found.cut > CUT_SHARE else 0
    flags |= int(Flag.UNEVEN_BACKGROUND) if u_offsets.any() else 0
    return np.array([*found.centre, covariance[0, 0], covariance[0, 1], covariance[1, 1], *beam]), level, flags


def _axes(angle_deg: float) -> Array:
    """Rows: unit vectors along the major and the minor axis."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, s], [-s, c]])


def _principal(spread: Array, covariance: Array) -> tuple[float, ...] | None:
    """Widths, azimuth and ellipticity with their uncertainties, from the second moments and the covariance of x, y, xx, xy, yy."""
    values, vectors = np.linalg.eigh(spread)
    if not values[0] > 0:
        return None
    (minor, major), (second, first) = values, vectors.T
    outer = [
        np.array([a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1]]) for a, b in ((first, first), (second, second), (first, second))
    ]
    own = covariance[2:, 2:]
    width = 4 * math.sqrt(major), 4 * math.sqrt(minor)
    by_width = np.stack([8 / width[0] * outer[0], 8 / width[1] * outer[1]])
    both = by_width @ own @ by_width.T
    ratio = width[1] / width[0]
    by_ratio = np.array([-ratio / width[0], 1 / width[0]])
    any_angle = 180 / math.sqrt(12)
    turn = math.sqrt(max(float(outer[2] @ own @ outer[2]), 0.0))
    u_angle = min(any_angle, math.degrees(0.5 * math.atan2(2 * turn, major - minor))) if major > minor else any_angle
    angle = (math.degrees(math.atan2(first[1], first[0])) + 90) % 180 - 90
    u_ratio = math.sqrt(max(float(by_ratio @ both @ by_ratio), 0.0))
    return (*width, angle, ratio, math.sqrt(both[0, 0]), math.sqrt(both[1, 1]), u_angle, u_ratio)


class _Window:
    """The part of a frame with a beam's aperture and the ground about it."""

    def __init__(self, frame: np.ndarray, centre: Array, spread: Array, box: tuple[int, int, int, int]) -> None:
        values, vectors = np.linalg.eigh(spread)
        if values[0] > ROUND**2 * values[1]:
            values, vectors = np.diag(spread), np.eye(2)
        self.half = np.maximum(0.5 * APERTURE * 4 * np.sqrt(np.maximum(values, 0.0)), LEAST_SIDE_PX)
        self.axes, self.middle, self.frame = vectors.T, centre, frame
        r0, r1, c0, c1 = self.box = box
        self.grey = frame[r0:r1, c0:c1].astype(float)
        y, x = np.mgrid[r0:r1, c0:c1].astype(float)
        self.dx, self.dy = x - centre[0], y - centre[1]
        self.design = np.stack([np.ones_like(x), self.dx, self.dy])
        far = [np.abs(e[0] * self.dx + e[1] * self.dy) for e in self.axes]
        self.inside = np.clip(self.half[0] + 0.5 - far[0], 0, 1) * np.clip(self.half[1] + 0.5 - far[1], 0, 1)
        off = np.maximum(far[0] - GROUND_FROM * self.half[0], far[1] - GROUND_FROM * self.half[1])
        self.out = off > 0
        self.ring = self.out & (off <= max(8.0, GROUND_WIDTH * self.half.max()))

    @classmethod
    def about(cls, frame: np.ndarray, centre: Array, spread: Array) -> _Window | None:
        """None where the beam has left the frame, or is larger than it."""
        rows, cols = frame.shape
        if not (np.isfinite(spread).all() and -0.5 <= centre[0] <= cols - 0.5 and -0.5 <= centre[1] <= rows - 0.5):
            return None
        sigma = math.sqrt(max(np.trace(spread), 0.0))
        if sigma > 0.5 * max(rows, cols):
            return None
        half = 0.5 * APERTURE * 4 * math.sqrt(max(float(np.linalg.eigvalsh(spread)[1]), 0.0))
        reach = 1.5 * (GROUND_FROM * half + max(8.0, GROUND_WIDTH * half))
        r0, r1 = max(math.floor(centre[1] - reach), 0), min(math.ceil(centre[1] + reach) + 1, rows)
        c0, c1 = max(math.floor(centre[0] - reach), 0), min(math.ceil(centre[0] + reach) + 1, cols)
        return cls(frame, centre, spread, (r0, r1, c0, c1))

    def fills_frame(self) -> bool:
        """Whether the aperture reaches beyond opposite borders: there is no ground then."""
        extent = np.abs(self.axes.T) @ self.half
        last = np.array(self.frame.shape[::-1]) - 0.5
        return bool(((self.middle - extent < -0.5) & (self.middle + extent > last)).any())

    def background(self, smeared: bool) -> tuple[Ground, Array, Array]:
        """The plane, and the offsets of the columns with their uncertainties: 0 where they are not significant, nor ``smeared``."""
        ring = self.ring if self.ring.sum() >= LEAST_GROUND else self.inside < 1
        if ring.sum() < LEAST_GROUND:
            ring = np.ones(self.grey.shape, bool)
        none = np.zeros(self.grey.shape[1])
        grain = GRAIN * (self.frame.dtype.kind == "u")
        ground = _ground(self.grey, self.dx, self.dy, ring, grain)
        off = np.where(self.out, self.grey - np.einsum("k,krc->rc", ground.plane, self.design), np.nan)
        count = np.isfinite(off).sum(axis=0)
        if (count >= 6).sum() < 3:
            return ground, none, none
        with np.errstate(invalid="ignore"):
            middle = np.nanmedian(np.where(count >= 6, off, 0.0), axis=0)
            usual = max(1.4826 * float(np.nanmedian(np.abs(off - middle))), grain)
            good = np.abs(off - middle) < OUTLIER_SIGMA * usual  # their mean: a median of rounded values is one of them
        off = np.where(good, off, np.nan)
        count = good.sum(axis=0)
        column = np.where(good, off, 0.0).sum(axis=0) / np.maximum(count, 1)
        spread = math.sqrt(float(np.nansum((off - column) ** 2)) / max(float(count.sum() - (count > 0).sum()), 1.0))
        u = spread / np.sqrt(np.maximum(count, 1))
        known = count >= 6
        if not spread > 0:
            return ground, none, none
        chi2, many = float(((column[known] - column[known].mean()) ** 2 / u[known] ** 2).sum()), int(known.sum())
        if not smeared and chi2 < many + SMEAR_SIGNIFICANT * math.sqrt(2 * many):
            return ground, none, none
        offsets = np.where(known, column, 0.0)
        again = _ground(self.grey - offsets, self.dx, self.dy, ring, grain)
        return again, offsets, np.where(known, u, 0.0)

    def moments(self, sign: float, plane: Array, offsets: Array) -> Moments | None:
        """First and second moments in the aperture; pixels beyond the border from the other side of the centroid."""
        light = sign * (self.grey - np.einsum("k,krc->rc", plane, self.design) - offsets)
        mirrored = self._mirrored()
        both = self.inside + mirrored
        total = float((both * light).sum())
        if not total > 0:
            return None
        # a pixel's mirror image has the opposite place
        odd, even = self.inside - mirrored, both
        mx, my = float((odd * light * self.dx).sum()) / total, float((odd * light * self.dy).sum()) / total
        place = [self.dx, self.dy]
        first = [(odd * d - even * m) / total for d, m in zip(place, (mx, my), strict=True)]
        second, weights = [], []
        for a, b in ((0, 0), (0, 1), (1, 1)):
            m = (mx, my)
            product = self.inside * (place[a] - m[a]) * (place[b] - m[b]) + mirrored * (place[a] + m[a]) * (place[b] + m[b])
            value = float((product * light).sum()) / total
            second.append(value)
            weights.append((product - even * value) / total)
        spread = np.array([[second[0], second[1]], [second[1], second[2]]])
        if not (np.linalg.eigvalsh(spread) > 0).all():
            return None
        stacked = sign * np.stack([*first, *weights])
        filled = np.array([float((mirrored * light * part).sum()) / total for part in (-self.dx, -self.dy)])
        filled = np.append(filled, [float((mirrored * light * p).sum()) / total for p in (self.dx**2, self.dx * self.dy, self.dy**2)])
        cut = float((mirrored * light).sum()) / total
        return Moments(self.middle + (mx, my), spread, total, stacked, filled, cut)

    def _mirrored(self) -> Array:
        """How often each pixel stands for one beyond the border: that opposite the middle."""
        rows, cols = self.frame.shape
        x, y = self.middle[0] - self.dx, self.middle[1] - self.dy
        beyond = np.clip(np.maximum(-0.5 - x, x - (cols - 0.5)) + 0.5, 0, 1), np.clip(np.maximum(-0.5 - y, y - (rows - 0.5)) + 0.5, 0, 1)
        mirrored: Array = self.inside * np.maximum(*beyond)
        return mirrored


def beam_noise(frame: np.ndarray, targets: Targets) -> NoiseModel:
    """Noise of a frame of smooth beams: what second differences along rows and columns leave, by grey value.

    The filter [1 −2 1]ᵀ[1 −2 1]/6 passes white noise with its own variance (J. Immerkær, Computer Vision and Image Understanding 64, 300
    (1996)). Its median squares in twelve classes of the grey value give the variance without light and per DN.
    """
    from scipy.ndimage import uniform_filter

    grey = frame.astype(float)
    least = ROUNDING_DN2 if frame.dtype.kind == "u" else 1e-12
    if min(frame.shape) < 5 or not len(targets):
        return NoiseModel(max(float(np.median(targets.sigma_dn)) ** 2 if len(targets) else 0.0, least), origin="image")
    rough = np.diff(np.diff(grey, 2, axis=0), 2, axis=1).ravel() / 6
    level = uniform_filter(grey, 3)[1:-1, 1:-1].ravel()
    black = float(np.median(targets.background_dn))
    edges = np.unique(np.concatenate([[level.min()], np.linspace(black, level.max(), 12)[1:-1], [level.max()]]))
    which = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, len(edges) - 2)
    classes = [np.flatnonzero(which == k) for k in range(len(edges) - 1)]
    classes = [c for c in classes if len(c) >= 30]
    light = np.array([max(float(level[c].mean()) - black, 0.0) for c in classes])
    variance = np.array([max(float(np.median(rough[c] ** 2)) / 0.4549, least) for c in classes])
    if not len(classes):
        return NoiseModel(max(float(np.median(targets.sigma_dn)) ** 2, least), origin="image")
    constant = float(variance[int(np.argmin(light))])
    rise = light > 0.05 * (level.max() - black)
    count = np.array([len(c) for c in classes])
    weight = count / variance**2 * rise
    slope = max(float((weight * light * (variance - constant)).sum() / max((weight * light**2).sum(), 1e-300)), 0.0) if rise.any() else 0.0
    return NoiseModel(max(constant, least), slope_dn=slope, black_dn=black, origin="image")
