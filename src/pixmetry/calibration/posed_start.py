"""Start values of a network from poses that were given with it, and whether those poses were right."""

from __future__ import annotations

import numpy as np

from pixmetry.calibration.free_start import start_distances, without_lens
from pixmetry.calibration.network import Finding, Network, Poses, State
from pixmetry.calibration.reconstruction import FINE, Reconstruction
from pixmetry.calibration.resection import fitted, intersect, rays

ANYHOW = 0.3  # rad: how far rays may miss each other under rough poses
FITS = 0.5  # of FINE, as an rms: what a start must reach; a quarter of the image points may be gross errors
TURNED = np.deg2rad(15.0)  # by which a pose is wrong, not rough,
AWAY = 0.2  # or by which it stands elsewhere, in units of the extent of all


def from_poses(network: Network, interior: np.ndarray) -> Reconstruction | None:
    """Points where the rays of images with given poses meet, then all images; None without poses, or where these do not fit.

    The frame is that of the poses; nothing that is known of the object takes part.
    """
    if network.poses is None or network.poses.given.sum() < 2:
        return None
    best, least = None, np.inf
    distances, plain = start_distances(network), without_lens(network, interior)
    starts = [np.column_stack([distances[0], lens[:, 1:]]) for lens in ([interior, plain] if (plain != interior).any() else [plain])]
    for values in starts + [np.column_stack([c, plain[:, 1:]]) for c in distances[1:]]:
        work = _intersected(network, network.poses, values)
        work.adjust(rounds=4, iterations=15)
        work.triangulate()
        work.judge()
        cost = work.cost(np.flatnonzero(network.poses.given))
        if cost < least:
            best, least = work, cost
        if _fits(least, work.width):
            break
    if best is None or not _fits(least, best.width):
        return None
    best.grow()
    return best


def _fits(cost: float, width: float) -> bool:
    return bool(np.sqrt(cost) < FITS * FINE * width)


def _intersected(network: Network, poses: Poses, interior: np.ndarray) -> Reconstruction:
    work = Reconstruction(network, interior, np.zeros(len(network.points), bool))
    work.rotation[poses.given], work.position[poses.given] = poses.rotation[poses.given], poses.position[poses.given]
    work.xyz, fits = intersect(
        work.position[network.image], rays(work.uv, work.rotation[network.image]), network.point, len(network.points), ANYHOW
    )
    posed = work.posed[network.image]
    work.good[posed] = fits[posed]
    work.judge()
    return work


def pose_findings(network: Network, state: State) -> list[Finding]:
    """What is to be said of the poses that were given, beside the adjusted ones; in whatever frame they were."""
    if network.poses is None:
        return []
    both = np.flatnonzero(network.poses.given & np.isfinite(state.position[:, 0]))
    if len(both) < 3:
        return []
    off = _differ(network.poses.rotation[both], network.poses.position[both], state.rotation[both], state.position[both])
    if not off.any():
        return []
    names = ", ".join(network.images[i] for i in both[off][:6]) + (", …" if off.sum() > 6 else "")
    text = f"The start poses of {off.sum()} of {len(both)} images are other than the adjusted ones: {names}. They were not relied on."
    advice = "Check which way the rotations go, the unit of the angles, and whether X0, Y0, Z0 are the projection centres."
    return [Finding("start_poses", text, advice, "warning")]


def _differ(rotation: np.ndarray, position: np.ndarray, found_rotation: np.ndarray, found_position: np.ndarray) -> np.ndarray:
    """Which poses differ by more than rough ones may, after one similarity of all."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(np.swapaxes(found_rotation, 1, 2) @ rotation)  # the same for all where they agree
    angles = np.stack([(turns[k].inv() * turns).magnitude() for k in range(len(turns))])
    nearest = int(np.argmin(np.median(angles, axis=1)))
    away = fitted(position, found_position)[3] / np.linalg.norm(np.std(found_position, axis=0))
    return (angles[nearest] > TURNED) | (away > AWAY)
