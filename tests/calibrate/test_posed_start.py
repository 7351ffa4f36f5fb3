"""Start poses: rough ones are enough, part of them is enough, wrong ones do no harm and are named. The truth is that of `networks.py`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.networks import SENSOR, Simulated, predicted, simulate
from pixmetry.calibrate.bundle import solve
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import Network, Poses
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.bundle.solve import calibrate_network
from pixmetry.calibrate.start.initial import start_values
from pixmetry.calibrate.start.posed_start import from_poses, to_their_frame
from pixmetry.calibrate.start.resection import fitted
from pixmetry.core.errors import MeasureError

ROUGH = 0.03  # of the object's size, and rad
WEAK_SEED = 1  # of a ring of twelve images that share 3 to 12 points with their neighbours: without poses it is refused
KINDS = {
    "volume": {"images": 12},
    "unknown long lens": {"images": 12, "c_known": False, "interior": {"c": 45.0, "k1": 0.0, "k2": 0.0, "k3": 0.0}},
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
    """All images are posed, and an adjustment comes down to the noise (sigma0 for one in a million)."""
    simulated = simulate(rng, **KINDS[kind])
    network = with_poses(rng, simulated)
    assert from_poses(network, np.stack([camera.values for camera in network.cameras])) is not None
    found, state = start_values(network)
    assert np.isfinite(state.position).all()
    result = adjust(stripped(found), state, used=~simulated.gross, covariance=False)
    assert 0.7 < result.sigma0 < 1.3


@pytest.mark.parametrize("bars", [0, 2])
@pytest.mark.parametrize("images", [2, 12])
def test_the_result_is_in_the_frame_of_the_poses(bars: int, images: int, rng: np.random.Generator) -> None:
    """With poses of two images or of all, exact ones: to what noise moves (0.04 px are 0.03 mm), and to the length of the bars."""
    simulated = simulate(rng, images=12, bars=bars)
    network = with_poses(rng, simulated, 0.0)
    network.poses.position[images:] = np.nan
    result = calibrate_network(network, Options(folds=0))
    off = result.adjustment.state.xyz - simulated.truth.xyz
    assert np.abs(off).max() < 2.0
    said = [f.text for f in result.findings if f.kind == "no_scale"]
    assert len(said) == (bars == 0) and all("start poses" in text for text in said)


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


WRONG = {
    "transposed": (lambda r, x: (np.swapaxes(r, 1, 2), x), "transposed"),
    "along -z": (lambda r, x: (np.diag([1, -1, -1]) @ r, x), "rows 2 and 3"),
    "shift": (lambda r, x: (r, -np.einsum("nij,nj->ni", r, x)), "R X + t"),
    "elsewhere": (lambda r, x: (r, -x), "other sign"),
    "exchanged": (lambda r, x: (r[::-1], x[::-1]), "projection centres"),
    "one place": (lambda r, x: (r, 0 * x), "projection centres"),
    "radians as degrees": (lambda r, x: (Rotation.from_rotvec(Rotation.from_matrix(r).as_rotvec() / 57.3).as_matrix(), x), "unit of"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_poses_do_no_harm_and_are_named(kind: str, rng: np.random.Generator) -> None:
    """What comes out is what comes out without them, and where another convention explains them, it is told.

    The cameras stand all round: looking down, half of them would have rotations that are nearly their own transposed.
    """
    simulated = simulate(rng, images=12, points=40, look="ring")
    network = with_poses(rng, simulated, 0.01)
    change, words = WRONG[kind]
    wrong = replace(network, poses=Poses(*change(network.poses.rotation, network.poses.position)))
    options = Options(folds=0)
    with_them, without = calibrate_network(wrong, options), calibrate_network(simulated.network, options)
    (finding,) = [f for f in with_them.findings if f.kind == "start_poses"]
    assert "coordinate system and scale were not used" in finding.text and words in finding.advice
    u = np.sqrt(np.diagonal(without.adjustment.interior_covariance()[1]))
    both = (one.adjustment.state.interior[0, :10] for one in (with_them, without))
    assert (np.abs(np.subtract(*both)) < 0.01 * u).all()


@pytest.mark.parametrize("what", ["rotation", "position"])
def test_one_wrong_pose_is_named(what: str, rng: np.random.Generator) -> None:
    """25° and a fifth of where the cameras stand; the others are as rough as in the other tests and are not named."""
    simulated = simulate(rng, images=12, points=40)
    network = with_poses(rng, simulated)
    if what == "rotation":
        network.poses.rotation[3] = Rotation.from_rotvec([0.0, 0.0, np.radians(25)]).as_matrix() @ network.poses.rotation[3]
    else:
        network.poses.position[3] += 0.6 * np.linalg.norm(np.std(simulated.truth.position, axis=0)) * np.array([0.0, 0.0, 1.0])
    result = calibrate_network(network, Options(folds=0))
    (finding,) = [f for f in result.findings if f.kind == "start_poses"]
    assert "1 of 12 images" in finding.text and "IMG_0004" in finding.text
    off = fitted(result.adjustment.state.position, simulated.truth.position)[3]
    assert off.max() < 5.0  # mm


def test_an_image_with_one_point_does_not_spoil_the_others(rng: np.random.Generator) -> None:
    simulated = simulate(rng, images=12)
    network = with_poses(rng, simulated)
    kept = (network.image != 5) | (network.point == 7)
    columns = {name: getattr(network, name)[kept] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    work = from_poses(replace(network, **columns), np.stack([camera.values for camera in network.cameras]))
    assert work is not None and np.delete(work.posed, 5).all()


def test_images_that_see_known_points_alone_are_posed(rng: np.random.Generator) -> None:
    """Two of twelve images show each a third of a known field of which no other image shows anything."""
    simulated = simulate(rng, images=12, points=90, known="fixed")
    network = with_poses(rng, simulated)
    third = network.point // 30
    kept = np.where(network.image == 0, third == 0, np.where(network.image == 1, third == 1, third == 2))
    columns = {name: getattr(network, name)[kept] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    assert np.isfinite(start_values(replace(network, **columns))[1].position).all()


def of_two_lenses(rng: np.random.Generator) -> tuple[Network, Poses]:
    """Ten images of a wide camera and ten of a long one of the same points, no principal distance known; poses of the wide one's."""
    wide, long = (simulate(rng, images=10, c_known=False, interior={"c": c, "k1": 0.0, "k2": 0.0, "k3": 0.0}) for c in (8.5, 45.0))
    parts = []
    for k, one in enumerate((wide, long)):
        x, y = predicted(one.network, replace(one.truth, xyz=wide.truth.xyz)).T
        good = (x > 0) & (x < SENSOR.cols) & (y > 0) & (y < SENSOR.rows)
        parts.append(np.stack([x, y, one.network.image + 10 * k, one.network.point])[:, good])
    x, y, image, point = np.concatenate(parts, axis=1)
    network = replace(
        wide.network, cameras=tuple(replace(one.network.cameras[0], name=name) for one, name in ((wide, "A"), (long, "B"))),
        images=tuple(map(str, range(20))), camera_of=np.repeat([0, 1], 10), image=image.astype(int), point=point.astype(int),
        x_px=x + 0.04 * rng.standard_normal(len(x)), y_px=y + 0.04 * rng.standard_normal(len(x)),
        covariance_px2=np.tile([0.0016, 0.0, 0.0016], (len(x), 1)),
    )  # fmt: skip
    known, nothing = with_poses(rng, wide).poses, np.full((10, 3, 3), np.nan)
    return network, Poses(np.concatenate([known.rotation, nothing]), np.concatenate([known.position, nothing[:, 0]]))


@pytest.mark.parametrize("posed", [True, False])
def test_of_two_cameras_one_has_poses(posed: bool, rng: np.random.Generator) -> None:
    """The other one's principal distance is searched for on the points that stand."""
    network, poses = of_two_lenses(rng)
    found, state = start_values(replace(network, poses=poses if posed else None))
    assert np.isfinite(state.position).all()
    result = adjust(stripped(found), state, covariance=False)
    np.testing.assert_allclose(result.state.interior[:, 0], [8.5, 45.0], rtol=0.01)


def test_poses_tell_that_y_is_the_wrong_way_round(rng: np.random.Generator) -> None:
    simulated = simulate(rng, images=12, points=40)
    network = with_poses(rng, simulated, 0.01)
    result = calibrate_network(replace(network, y_px=SENSOR.rows - 1 - network.y_px), Options(folds=0))
    (finding,) = [f for f in result.findings if f.kind == "start_poses"]
    assert "image_coordinates.y" in finding.advice


def test_poses_that_lead_nowhere_are_left_aside(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """A false start that fits well enough to be taken: the adjustment from it fails, that from nothing does not."""
    simulated = simulate(rng, images=12, points=40)
    network = with_poses(rng, simulated)
    before = solve.settle

    def settle(measured, state, *more):
        if state.xyz[0, 0] == 1e3:
            raise MeasureError("no minimum was found", where=where, remedy="more images")
        return before(measured, state, *more)

    def started(network, *more):
        found, state = begun(network, *more)
        if network.poses is not None or never:
            state.xyz[0, 0] = 1e3
        return found, state

    begun, never, where = solve._started, False, "start values"
    monkeypatch.setattr(solve, "settle", settle)
    monkeypatch.setattr(solve, "_started", started)
    assert calibrate_network(network, Options(folds=0)).adjustment.sigma0 < 1.3
    never = True
    with pytest.raises(MeasureError, match="more images; the start poses do not fit"):
        calibrate_network(network, Options(folds=0))
    where = "bundle adjustment"  # that they were the reason cannot be said
    with pytest.raises(MeasureError, match="more images$"):
        calibrate_network(network, Options(folds=0))


def test_poses_most_of_which_are_at_one_place(rng: np.random.Generator) -> None:
    """Three poses, two of them from one tripod: a size all the same."""
    simulated = simulate(rng, images=12, bars=0)
    truth = simulated.truth
    network = with_poses(rng, simulated, 0.0)
    network.poses.position[3:] = np.nan
    state = replace(truth, position=truth.position.copy(), xyz=2 * truth.xyz)
    state.position[1] = network.poses.position[1] = truth.position[0]
    state.position[:] *= 2
    scale, turn, shift = to_their_frame(network, state)
    assert scale == pytest.approx(0.5) and np.abs(turn - np.eye(3)).max() < 1e-9
    np.testing.assert_allclose(scale * state.xyz @ turn.T + shift, truth.xyz, atol=1e-6)
