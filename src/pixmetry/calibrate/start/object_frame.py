"""The frame of a reconstruction: that of what is known of the object, or one of its own."""

from __future__ import annotations

import numpy as np

from pixmetry.calibrate.start.reconstruction import Reconstruction
from pixmetry.calibrate.start.resection import FLAT, fitted, thickness
from pixmetry.core.arrays import Array, Flags
from pixmetry.core.errors import InputError, MeasureError

KEEP = 1e-6  # pull of what is not known towards the frame that is there, beside 1 for what is
AGREES = 1e-3  # of the extent: within it, what is known is met
TURNED = 0.5  # of the distance from rough coordinates: what a mirrored frame must leave at most to be the right one
FEWEST_TURNED = 8  # rough coordinates that can tell this: of few points, errors may look mirrored
REACH = 0.1  # rms distance from control, in units of its extent, at which coordinates do not belong to the images


def to_object(work: Reconstruction) -> None:
    """Bring a free reconstruction to control, nominal coordinates, bars, or a frame of its own."""
    network = work.network
    known = np.isfinite(work.xyz[:, 0])
    control, given = network.control & known, network.given & known
    use = control if control.sum() >= 3 else given
    use_all = use.sum() >= 3 and thickness(network.xyz[use])[1] > 1e-3
    if use_all:
        scale, rotation, shift, away = fitted(work.xyz[use], network.xyz[use])
        extent = np.linalg.norm(np.std(network.xyz[use], axis=0))
        if control.sum() >= 3 and np.median(away) > REACH * extent:
            raise _does_not_fit(work, use)
        if use is given and use.sum() >= FEWEST_TURNED and np.median(_turned_away(work, use)) < TURNED * np.median(away):
            raise _mirrored()
        moved(work, scale, rotation, shift)
    else:
        _own_frame(work, known)
    if control.sum() < 2:
        _scaled(work)
    if not use_all or use is given:
        _to_known(work, scaled=control.sum() >= 2 or not len(network.bars))
    if control.any():
        _grow_on(work)


def _grow_on(work: Reconstruction) -> None:
    """Pose images that are left, by known points that none of the others sees (those that others see stay where their rays meet)."""
    network = work.network
    work.control = np.isnan(work.xyz[:, 0]) & network.control
    if work.control.any():
        work.xyz[work.control] = network.xyz[work.control]
        work.grow()


def _does_not_fit(work: Reconstruction, use: np.ndarray) -> Exception:
    network = work.network
    away = _turned_away(work, use)
    extent = np.linalg.norm(np.std(network.xyz[use], axis=0))
    if thickness(network.xyz[use])[0] > FLAT and np.median(away) < 0.3 * REACH * extent:
        return _mirrored()
    return _disagrees(float(np.median(away)), int(use.sum()), network.unit)


def _turned_away(work: Reconstruction, use: Flags) -> Array:
    """Distances from known points that remain when the reconstruction is mirrored."""
    return fitted(work.xyz[use] * [1.0, 1.0, -1.0], work.network.xyz[use])[3]


def _mirrored() -> InputError:
    return InputError(
        "image and object coordinates agree only if one of them is mirrored", where="object points",
        allowed="x to the right and y down in the image, a right-handed frame in the object",
        remedy="state that y counts upwards in the table of image coordinates, or reverse one axis of the object",
    )  # fmt: skip


def _disagrees(apart: float, points: int, unit: str) -> MeasureError:
    return MeasureError(
        "the images agree with each other, but not with the known coordinates", where="object points",
        value=f"{apart:.3g} {unit} apart at {points} points",
        remedy="compare the names of the points in both tables, the order of the coordinates' columns, and their unit",
    )  # fmt: skip


def _own_frame(work: Reconstruction, known: np.ndarray) -> None:
    """Origin in the middle of the points, z along their least extent towards the images, size from the mean base."""
    posed = work.posed
    middle = np.median(work.xyz[known], axis=0)
    axes = np.linalg.svd(work.xyz[known] - middle, full_matrices=False)[2]
    z = axes[2] * (np.sign(axes[2] @ (work.position[posed].mean(axis=0) - middle)) or 1.0)
    rotation = np.stack([axes[0], np.cross(z, axes[0]), z])
    base = np.sqrt(2 * np.sum(np.var(work.position[posed], axis=0)))
    scale = 1.0 / float(base) if base > 0 else 1.0
    moved(work, scale, rotation, -scale * rotation @ middle)


def _to_known(work: Reconstruction, *, scaled: bool) -> None:
    """To coordinates that are known where these are fewer than three whole points: what they leave open stays as it is."""
    network, there = work.network, np.isfinite(work.xyz[:, 0])
    known = there[:, None] & np.isfinite(network.xyz) & np.isfinite(network.u_xyz)
    if not known.any():
        return
    middle = np.median(work.xyz[there], axis=0)
    size = float(np.sqrt(np.mean((work.xyz[there] - middle) ** 2)))
    some = np.flatnonzero(known.any(axis=1))
    source, target, u = (work.xyz[some] - middle) / size, network.xyz[some], np.where(known, network.u_xyz, np.inf)[some]
    scale, rotation, shift, gap = _nearest(source, target, u, size, scaled)
    if np.median(gap) > REACH and known.sum() > 7:
        if np.median(_nearest(source * [1.0, 1.0, -1.0], target, u, size, scaled)[3]) < 0.3 * REACH:
            raise _mirrored()
        raise _disagrees(float(np.median(gap)) * scale, len(some), network.unit)
    moved(work, scale / size, rotation, shift - scale / size * rotation @ middle)


def _nearest(source: Array, target: Array, u: Array, size: float, scaled: bool) -> tuple[float, Array, Array, Array]:
    """Scale, rotation, shift that bring points of extent 1 to coordinates that are known with u (n, 3; ``inf``: not known), and how far
    these remain apart beyond their u, in units of the extent; where they leave something open, the nearest to ``size`` without a turn.

    The shift is the mean of an axis. A turn may be far: the search begins at each of the 24 of a cube.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    known = np.isfinite(u)
    count = np.maximum(known.sum(axis=0), 1)

    def centred(values: Array) -> tuple[Array, Array]:
        values = np.where(known, values, 0.0)
        mean = values.sum(axis=0) / count
        return (values - mean)[known], mean

    wanted = centred(target)[0]
    expected = u[known] / (float(np.sqrt(np.mean(wanted**2))) or size)
    weight = 1 / np.hypot(1.0, expected / AGREES)

    def gap(p: Array) -> Array:
        gaps: Array = centred(source @ Rotation.from_rotvec(p[:3]).as_matrix().T)[0] - wanted / (size * np.exp(p[3]))
        return gaps

    def misses(p: np.ndarray, start: float) -> np.ndarray:
        return np.concatenate([weight * gap(p), KEEP * p[:3], [(KEEP if scaled else 1.0 / KEEP) * (p[3] - start)]])

    best, least = np.zeros(4), np.inf
    for turn in Rotation.create_group("O"):
        length = np.linalg.norm(centred(source @ turn.as_matrix().T)[0])
        ratio = np.linalg.norm(wanted) / (size * length) if scaled and length > 0 else 1.0
        start = np.log(ratio) if ratio > 0 else 0.0
        found = least_squares(misses, [*turn.as_rotvec(), start], args=(start,), loss="soft_l1", f_scale=10 * AGREES)
        if found.cost < least:
            best, least = found.x, found.cost
        if np.abs(gap(best)).max() < AGREES:
            break
    scale, rotation = size * np.exp(best[3]), Rotation.from_rotvec(best[:3]).as_matrix()
    shift = np.where(known.any(axis=0), centred(target)[1] - scale * centred(source @ rotation.T)[1], 0.0)
    return scale, rotation, shift, np.abs(gap(best)) / np.hypot(1.0, expected / REACH)


def _scaled(work: Reconstruction) -> None:
    """The size that bars ask for, about the middle of the points."""
    bars = work.network.bars
    if not len(bars):
        return
    there = np.linalg.norm(work.xyz[bars.start] - work.xyz[bars.end], axis=1)
    good = np.isfinite(there) & (there > 0)
    if good.any():
        middle = np.nanmean(work.xyz, axis=0)
        scale = float(np.median(bars.length[good] / there[good]))
        moved(work, scale, np.eye(3), (1 - scale) * middle)


def moved(work: Reconstruction, scale: float, rotation: np.ndarray, shift: np.ndarray) -> None:
    """Bring poses and points to another frame."""
    work.position = scale * work.position @ rotation.T + shift
    work.xyz = scale * work.xyz @ rotation.T + shift
    work.rotation = work.rotation @ rotation.T
