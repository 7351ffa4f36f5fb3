"""Start poses: rough ones are enough, part of them is enough, wrong ones do no harm and are named. The truth is that of `networks.py`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.networks import Simulated, simulate
from pixmetry.calibration.bundle import adjust
from pixmetry.calibration.initial import start_values
from pixmetry.calibration.network import Network, Poses
from pixmetry.calibration.options import Options
from pixmetry.calibration.posed_start import from_poses
from pixmetry.calibration.resection import fitted
from pixmetry.calibration.solve import calibrate_network

ROUGH = 0.03  # of the object's size, and rad
WEAK_SEED = 1  # of a ring of twelve images that share 3 to 12 points with their neighbours: without poses it is refused
KINDS = {
    "volume": {"images": 12},
    "no principal distance": {"images": 12, "c_known": False},
    "plane": {"images": 12, "field": "plane", "c_known": False},
    "ring": {"images": 20, "points": 200, "field": "around"},
    "two cameras": {"images": 16, "cameras": 2},
    "dirty": {"images": 20, "points": 60, "gross_share": 0.05, "gross_px": 100.0, "swapped_share": 0.05},
}


def with_poses(rng: np.random.Generator, simulated: Simulated, share: float = ROUGH) -> Network:
    """The network with the true poses, wrong by a share."""
    truth, n = simulated.truth, len(simulated.network.images)
    size = np.ptp(truth.xyz, axis=0).max()
    rotation = Rotation.from_rotvec(share * rng.standard_normal((n, 3))).as_matrix() @ truth.rotation
    return replace(simulated.network, poses=Poses(rotation, truth.position + share * size * rng.standard_normal((n, 3))))


def stripped(network: Network) -> Network:
    return replace(network, poses=None)


@pytest.mark.parametrize("kind", KINDS)
def test_rough_poses_are_enough(kind: str, rng: np.random.Generator) -> None:
    """All images are posed, in the frame of the poses, and an adjustment comes down to the noise (sigma0 for one in a million)."""
    simulated = simulate(rng, **KINDS[kind])
    network = with_poses(rng, simulated)
    assert from_poses(network, np.stack([camera.values for camera in network.cameras])) is not None
    found, state = start_values(network)
    assert np.isfinite(state.position).all()
    result = adjust(stripped(found), state, used=~simulated.gross, covariance=False)
    assert 0.7 < result.sigma0 < 1.3
    there = np.isfinite(result.state.xyz[:, 0])
    off = np.linalg.norm(result.state.xyz - simulated.truth.xyz, axis=1)[there]
    assert np.median(off) < 3 * ROUGH * np.ptp(simulated.truth.xyz, axis=0).max()


def test_a_ring_that_does_not_hold_together_by_itself() -> None:
    rng = np.random.default_rng(WEAK_SEED)
    simulated = simulate(rng, images=12, points=150, field="around", visibility=0.8)
    result = calibrate_network(with_poses(rng, simulated), Options(folds=0))
    assert 0.6 < result.adjustment.sigma0 < 1.5 and not any(f.kind == "start_poses" for f in result.findings)
    np.testing.assert_allclose(result.adjustment.state.interior[0, 0], simulated.truth.interior[0, 0], rtol=0.01)


def test_poses_of_some_images_and_control_in_another_frame(rng: np.random.Generator) -> None:
    """Poses of a third of the images, in metres and turned; control points hold the frame of the result."""
    simulated = simulate(rng, images=12, known="partly", bars=0)
    network = with_poses(rng, simulated)
    turn = Rotation.random(random_state=rng).as_matrix()
    poses = Poses(network.poses.rotation @ turn.T, 0.001 * network.poses.position @ turn.T + [5.0, 6.0, 7.0])
    poses.position[4:] = np.nan
    found, state = start_values(replace(network, poses=poses))
    assert np.isfinite(state.position).all() and found.poses is poses
    result = adjust(stripped(found), state, covariance=False)
    assert 0.7 < result.sigma0 < 1.3
    np.testing.assert_allclose(result.state.xyz, simulated.truth.xyz, atol=0.5)


def test_wrong_poses_do_no_harm_and_are_named(rng: np.random.Generator) -> None:
    """Rotations that go the other way: what comes out is what comes out without them."""
    simulated = simulate(rng, images=12, points=40)
    network = with_poses(rng, simulated, 0.0)
    wrong = replace(network, poses=Poses(np.swapaxes(network.poses.rotation, 1, 2), network.poses.position))
    options = Options(folds=0)
    with_them, without = calibrate_network(wrong, options), calibrate_network(simulated.network, options)
    (finding,) = [f for f in with_them.findings if f.kind == "start_poses"]
    assert int(finding.text.split("images")[0].split()[4]) > 2 and "rotations" in finding.advice  # some are their own inverse, nearly
    u = np.sqrt(np.diagonal(without.adjustment.interior_covariance()[1]))
    both = (one.adjustment.state.interior[0, :10] for one in (with_them, without))
    assert (np.abs(np.subtract(*both)) < 0.01 * u).all()


def test_one_wrong_pose_is_named(rng: np.random.Generator) -> None:
    simulated = simulate(rng, images=12, points=40)
    network = with_poses(rng, simulated)
    network.poses.rotation[3] = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix() @ network.poses.rotation[3]
    result = calibrate_network(network, Options(folds=0))
    (finding,) = [f for f in result.findings if f.kind == "start_poses"]
    assert "1 of 12 images" in finding.text and "IMG_0004" in finding.text
    off = fitted(result.adjustment.state.position, simulated.truth.position)[3]
    assert off.max() < 5.0  # mm
