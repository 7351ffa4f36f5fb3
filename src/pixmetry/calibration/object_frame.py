"""The frame of a reconstruction: that of what is known of the object, or one of its own."""

from __future__ import annotations

import numpy as np

from pixmetry.calibration.reconstruction import Reconstruction
from pixmetry.calibration.resection import FLAT, fitted, similarity, thickness
from pixmetry.core.errors import InputError, MeasureError

REACH = 0.1  # rms distance from control, in units of its extent, at which coordinates do not belong to the images


def to_object(work: Reconstruction) -> None:
    """Bring a free reconstruction to control, nominal coordinates, bars, or a frame of its own."""
    network = work.network
    known = np.isfinite(work.xyz[:, 0])
    given = known & np.isfinite(network.xyz).all(axis=1)
    control = given & np.isfinite(network.u_xyz).all(axis=1)
    use = control if control.sum() >= 3 else given
    use_all = use.sum() >= 3 and thickness(network.xyz[use])[1] > 1e-3
    if use_all:
        scale, rotation, shift, away = fitted(work.xyz[use], network.xyz[use])
        extent = np.linalg.norm(np.std(network.xyz[use], axis=0))
        if control.sum() >= 3 and np.median(away) > REACH * extent:
            raise _does_not_fit(work, use)
        moved(work, scale, rotation, shift)
    else:
        _own_frame(work, known)
    if control.sum() < 2:
        _scaled(work)
    if control.any() and not use_all:
        _to_few(work, control)
    if control.any():
        _grow_on(work)


def _grow_on(work: Reconstruction) -> None:
    """Pose images that are left, by known points that none of the others sees (those that others see stay where their rays meet)."""
    network = work.network
    work.control = np.isnan(work.xyz[:, 0]) & np.isfinite(network.xyz).all(axis=1) & np.isfinite(network.u_xyz).all(axis=1)
    if work.control.any():
        work.xyz[work.control] = network.xyz[work.control]
        work.grow()


def _does_not_fit(work: Reconstruction, use: np.ndarray) -> Exception:
    network = work.network
    mirror = np.array([1.0, 1.0, -1.0])
    away = fitted(work.xyz[use] * mirror, network.xyz[use])[3]
    extent = np.linalg.norm(np.std(network.xyz[use], axis=0))
    if thickness(network.xyz[use])[0] > FLAT and np.median(away) < 0.3 * REACH * extent:
        return InputError(
            "image and object coordinates fit only mirrored", where="object points",
            allowed="x to the right and y down in the image, a right-handed frame in the object",
            remedy="say that y counts upwards in the table of image coordinates, or turn one axis of the object over",
        )  # fmt: skip
    return MeasureError(
        "the images agree with each other, but not with the known coordinates", where="object points",
        value=f"{np.median(away):.3g} {network.unit} apart at {use.sum()} points",
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


def _to_few(work: Reconstruction, control: np.ndarray) -> None:
    """To control that is one point, or lies in line: what it leaves open stays as it is."""
    source, target = work.xyz[control], work.network.xyz[control]
    if len(source) == 1:
        moved(work, 1.0, np.eye(3), (target - source)[0])
    else:
        moved(work, *similarity(source, target, np.ones(len(source))))


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
