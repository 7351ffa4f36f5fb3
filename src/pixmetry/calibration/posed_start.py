"""Start values of a network from poses that were given with it, and whether those poses were right."""

from __future__ import annotations

import numpy as np

from pixmetry.calibration.free_start import start_interiors
from pixmetry.calibration.network import Finding, Network, State
from pixmetry.calibration.reconstruction import Reconstruction
from pixmetry.calibration.resection import fitted, thickness

ANYHOW = 0.3  # rad: how far rays may miss each other under rough poses
POSES_FIT = 0.5  # of FINE, as an rms: what a start must reach; a quarter of the image points may be gross errors
TURNED = np.deg2rad(15.0)  # by which a pose is wrong, not rough,
AWAY = 0.2  # or by which it stands elsewhere, in units of the extent of images and points
SPREAD = 0.05  # least width of where images stand, in units of its length, that tells a rotation


def from_poses(network: Network, interior: np.ndarray) -> Reconstruction | None:
    """Start from the poses of the network: points where rays meet, a small adjustment, then all images that can be posed.

    Parameters
    ----------
    network : Network
        Nothing that is known of its object takes part: the frame is that of the poses.
    interior : ndarray, shape (cameras, 12)
        Start values; 0 in place of principal distances that are not known.

    Returns
    -------
    Reconstruction or None
        None with fewer than two poses, or where they do not fit the image coordinates.
    """
    if network.poses is None or network.poses.given.sum() < 2:
        return None
    images = np.flatnonzero(network.poses.given)
    best: Reconstruction | None = None
    for values in start_interiors(network, interior):
        work = Reconstruction(network, values, np.zeros(len(network.points), bool))
        work.rotation[images], work.position[images] = network.poses.rotation[images], network.poses.position[images]
        work.triangulate(ANYHOW)
        work.judge()
        work.adjust(rounds=4, iterations=15)
        work.triangulate()
        work.judge()
        if best is None or work.cost(images) < best.cost(images):
            best = work
        if best.fits(images, POSES_FIT):
            best.grow()
            return best
    return None


def pose_findings(network: Network, state: State) -> list[Finding]:
    """Which start poses are far from the adjusted ones, in whatever frame they were.

    Parameters
    ----------
    network : Network
        With the poses.
    state : State
        Adjusted.
    """
    if network.poses is None:
        return []
    both = np.flatnonzero(network.poses.given & np.isfinite(state.position[:, 0]))
    if len(both) < 2:
        return []
    extent = np.linalg.norm(np.nanstd(np.concatenate([state.position, state.xyz]), axis=0))
    off = _differ(network.poses.rotation[both], network.poses.position[both], state.rotation[both], state.position[both], float(extent))
    if not off.any():
        return []
    names = ", ".join(network.images[i] for i in both[off][:6]) + (", …" if off.sum() > 6 else "")
    text = f"The start poses of {off.sum()} of {len(both)} images are far from the adjusted ones: {names}."
    advice = "Check which way the camera looks and the rotations go, the unit of the angles, and whether X0, Y0, Z0 are projection centres."
    return [Finding("start_poses", text, advice, "warning")]


def _differ(
    rotation: np.ndarray, position: np.ndarray, found_rotation: np.ndarray, found_position: np.ndarray, extent: float
) -> np.ndarray:
    """Which poses differ by more than rough ones may, after one similarity of all."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(np.swapaxes(found_rotation, 1, 2) @ rotation)  # of one frame to the other: the same for all that agree
    angles = np.stack([(turns[k].inv() * turns).magnitude() for k in range(len(turns))])
    nearest = int(np.argmin(np.median(angles, axis=1)))
    if len(position) < 3:
        return angles[nearest] > TURNED
    _, turn, _, away = fitted(position, found_position)
    apart = (Rotation.from_matrix(turn).inv() * turns[nearest]).magnitude() > TURNED and thickness(found_position)[1] > SPREAD
    return (angles[nearest] > TURNED) | (away > AWAY * extent) | apart
