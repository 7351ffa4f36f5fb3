"""Poses that were given with a network: a start from them, their frame for its result, and whether they were right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.network import Network, Poses, State
from pixmetry.calibrate.start.free_start import start_interiors
from pixmetry.calibrate.start.reconstruction import Reconstruction
from pixmetry.calibrate.start.resection import fitted, thickness
from pixmetry.core.arrays import Flags, Ints
from pixmetry.core.finding import Finding

ANYHOW = 0.3  # rad: how far rays may miss each other under rough poses
POSES_FIT = 0.5  # of FINE, as an rms: what a start must reach; a quarter of the image points may be gross errors
TURNED = np.deg2rad(15.0)  # by which a pose is wrong, not rough,
AWAY = 0.2  # or by which it stands elsewhere, in units of the extent of images and points
SPREAD = 0.05  # least width of where images stand, in units of its length, that tells a rotation
MOST = 0.5  # of the poses must be right for their frame to mean something
NAMED = 6
AXES = np.diag([1.0, -1.0, -1.0])  # from a camera that looks along -z, y up, to one that looks along +z, y down
ADVICE = (
    "Check the viewing direction of the camera, the sense of the rotations, the unit of the angles, and whether X0, Y0, Z0 are "
    "projection centres."
)


def from_poses(network: Network, interior: np.ndarray) -> Reconstruction | None:
    """Start from the poses of the network: points where rays meet, a small adjustment, then all images that can be posed.

    Parameters
    ----------
    network : Network
        Nothing that is known of its object takes part.
    interior : ndarray, shape (cameras, interior parameters)
        Start values; 0 in place of principal distances that are not known.

    Returns
    -------
    Reconstruction or None
        In a frame near that of the poses; None with fewer than two of them, or where they do not fit the image coordinates.
    """
    if network.poses is None:
        return None
    images = np.flatnonzero(network.poses.given)
    if len(images) < 2 or not np.ptp(network.poses.position[images], axis=0).any():
        return None
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


def in_their_frame(network: Network, state: State) -> State:
    """The state in the frame of the network's poses, if nothing that is known of the object has one and most of the poses are right.

    Bars keep what they say of the size.
    """
    found = to_their_frame(network, state)
    if found is None:
        return state
    scale, turn, shift = found
    return replace(
        state,
        rotation=state.rotation @ turn.T,
        position=scale * state.position @ turn.T + shift,
        xyz=scale * state.xyz @ turn.T + shift,
    )


def to_their_frame(network: Network, state: State) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Scale, rotation and shift to the frame of the network's poses; None if it means nothing for the state."""
    if network.poses is None or np.isfinite(network.xyz).any():
        return None
    both = _both(network.poses, state)
    if len(both) < 2 or np.mean(_differ(network.poses, state, both)) > MOST:
        return None
    position, target = state.position[both], network.poses.position[both]
    if len(both) > 2 and thickness(target)[1] > SPREAD:
        scale, turn, shift, _ = fitted(position, target, scaled=not len(network.bars))
    else:
        turn = _turn(network.poses.rotation[both], state.rotation[both])[0].T
        turned = position @ turn.T
        scale = 1.0 if len(network.bars) else _size(target) / _size(turned)
        shift = np.median(target - scale * turned, axis=0)
    return (scale, turn, shift) if np.isfinite(scale) and scale > 0 else None


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
    both = _both(network.poses, state)
    off = _differ(network.poses, state, both) if len(both) > 1 else np.zeros(0, bool)
    if not off.any():
        return []
    names = ", ".join(network.images[i] for i in both[off][:NAMED]) + (", …" if off.sum() > NAMED else "")
    text = f"The start poses of {off.sum()} of {len(both)} images are far from the adjusted ones: {names}."
    if off.mean() > MOST:
        text += " Their coordinate system and scale were not used."
    return [Finding("start_poses", text, _meant(network.poses, state, both) if off.mean() > MOST else ADVICE, "warning")]


def _meant(poses: Poses, state: State, both: np.ndarray) -> str:
    """What to do about poses most of which are wrong: in which other convention they would be right, if in one."""
    transposed = np.swapaxes(poses.rotation, 1, 2)
    centre = -np.einsum("nji,nj->ni", poses.rotation, poses.position)
    others = {
        "the rotations had the opposite sense (transposed)": Poses(transposed, poses.position),
        "the camera looked along -z, y up (rows 2 and 3 with the other sign)": Poses(AXES @ poses.rotation, poses.position),
        "the rotations had the opposite sense, and the camera looked along -z, y up": Poses(AXES @ transposed, poses.position),
        "X0, Y0, Z0 were the shift t of R X + t (then X0 = -Rᵀ t)": Poses(poses.rotation, centre),
        "X0, Y0, Z0 had the other sign": Poses(poses.rotation, -poses.position),
    }
    for words, other in others.items():
        if not _differ(other, state, both).any():
            return f"They would fit if {words}."
    mirrored = replace(state, rotation=np.diag([1, -1, 1]) @ state.rotation @ np.diag([1, 1, -1]), position=state.position * [1, 1, -1])
    if not _differ(poses, mirrored, both).any():
        return (
            "They would fit if y of the image coordinates had the opposite direction: see image_coordinates.y; the object may be mirrored."
        )
    return ADVICE


def _both(poses: Poses, state: State) -> np.ndarray:
    """Images with a given and an adjusted pose."""
    return np.flatnonzero(poses.given & state.posed)


def _differ(poses: Poses, state: State, both: Ints) -> Flags:
    """Which of these poses differ by more than rough ones may, after one similarity of all."""
    from scipy.spatial.transform import Rotation

    position, found = poses.position[both], state.position[both]
    turn, angle = _turn(poses.rotation[both], state.rotation[both])
    wrong: Flags = angle > TURNED
    if len(both) < 3:
        return wrong
    if not np.ptp(position, axis=0).any():
        return np.ones(len(both), bool)
    extent = np.linalg.norm(np.nanstd(np.concatenate([state.position, state.xyz]), axis=0))
    _, by_position, _, away = fitted(position, found)
    apart = thickness(position)[1] > SPREAD and Rotation.from_matrix(by_position.T @ turn).magnitude() > TURNED
    return wrong | (away > AWAY * float(extent)) | bool(apart)


def _turn(rotation: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation from the frame of poses to that of the found ones on which most of them agree, and by how much (rad) each differs."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(np.swapaxes(found, 1, 2) @ rotation)
    angles = np.stack([(turns[k].inv() * turns).magnitude() for k in range(len(turns))])
    nearest = int(np.argmin(np.median(angles, axis=1)))
    return turns[angles[nearest] <= TURNED].mean().as_matrix(), angles[nearest]


def _size(position: np.ndarray) -> float:
    return float(np.linalg.norm(np.std(position, axis=0)))
