"""Start values: networks of many kinds come out posed, from nothing but their image coordinates.

What stands beside them is the truth of an independent simulator. The networks drawn anew in each run are strong ones; the weak ones have
a seed of their own, since some draw of them will fall apart. A residual three
times the noise, or a principal distance 2 % off, would be seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from calibrate.networks import SENSOR, Simulated, predicted, simulate
from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.options import Options
from pixmetry.calibrate.bundle.solve import calibrate_network
from pixmetry.calibrate.start.initial import homography, principal_distance, start_values
from pixmetry.calibrate.start.resection import fitted, intersect, pose
from pixmetry.core.errors import InputError, MeasureError

DIRTY = {"gross_share": 0.01, "gross_px": 8.0, "swapped_share": 0.01, "c_known": False}
WIDE = {"c": 4.5, "k1": 4e-3, "k2": -4e-5, "k3": 0.0}  # 100 px of distortion in the corners
STRONG = {
    "volume": {"images": 20},
    "panels": {"images": 20, "field": "panels"},
    "free plane": {"images": 16, "field": "plane"},
    "wide angle": {"images": 20, "interior": WIDE},
    "object to image": {"images": 20, "direction": "object_to_image"},
    "two cameras": {"images": 24, "cameras": 2},
    "known volume": {"images": 10, "known": "fixed"},
    "known plane": {"images": 12, "known": "fixed", "field": "plane"},
    "partly known": {"images": 16, "known": "partly"},
    "roughly known": {"images": 16, "known": "rough"},
    "given wrong c": {"images": 20, "c_known": True},
}
WEAK = {
    "ring": {"images": 30, "points": 200, "field": "around"},
    "strip": {"images": 40, "points": 250, "visibility": 0.12, "size": (6000.0, 600.0, 400.0)},
    "few points": {"images": 30, "points": 40, "visibility": 0.3},
    "six images": {"images": 6, "points": 60},
    "long lens": {"images": 14, "points": 60, "interior": {"c": 30.0, "k1": 1e-4, "k2": 0.0, "k3": 0.0}},
    "noisy": {"images": 25, "points": 80, "noise_px": 0.5},
    "dirty": {"images": 25, "points": 60, "gross_share": 0.05, "gross_px": 100.0, "swapped_share": 0.05},
}


def check(simulated: Simulated, noise_px: float) -> None:
    """All images posed; right image coordinates fit; an adjustment from there comes down to the noise."""
    network, state = start_values(simulated.network)
    assert np.isfinite(state.position).all() and np.isfinite(state.rotation).all()
    left = np.column_stack([network.x_px, network.y_px]) - predicted(network, state)
    assert np.nanmedian(np.abs(left[~simulated.gross])) < 3.0 * max(noise_px, 0.3)
    result = adjust(network, state, used=~simulated.gross, covariance=False)
    # sigma0 of 150 degrees of freedom and more lies within 0.7 … 1.3 but for one in a million
    assert 0.7 < result.sigma0 < 1.3
    np.testing.assert_allclose(result.state.interior[:, 0], simulated.truth.interior[:, 0], rtol=0.02)
    assert network.cameras[0].values[0] == state.interior[0, 0]


@pytest.mark.parametrize("name", STRONG)
def test_strong_network(name: str, rng: np.random.Generator):
    simulated = simulate(rng, **{"points": 80, **DIRTY, **STRONG[name]})
    if name == "given wrong c":
        network = simulated.network
        camera = network.cameras[0].with_values(c=1.6 * simulated.truth.interior[0, 0])
        simulated = replace(simulated, network=replace(network, cameras=(camera,)))
    check(simulated, 0.04)


@pytest.mark.parametrize("name", WEAK)
def test_weak_network(name: str):
    check(simulate(np.random.default_rng(1), **{**DIRTY, **WEAK[name]}), WEAK[name].get("noise_px", 0.04))


def test_scale_and_frame(rng: np.random.Generator):
    """Bars give the size of a free network, rough coordinates its frame, and else the mean base is the unit."""
    simulated = simulate(rng, images=16, points=60, bars=2)
    state = start_values(simulated.network)[1]
    bars = simulated.network.bars
    length = np.linalg.norm(state.xyz[bars.start] - state.xyz[bars.end], axis=1)
    np.testing.assert_allclose(length, bars.length, rtol=5e-3)

    rough = simulate(rng, images=16, points=60, bars=0, known="rough")
    state = start_values(rough.network)[1]
    turn = Rotation.align_vectors(rough.truth.xyz - rough.truth.xyz.mean(axis=0), state.xyz - state.xyz.mean(axis=0))[0]
    assert turn.magnitude() < 0.05  # coordinates to 1 % of the field: 0.01 / sqrt(60) rad, and what the lens adds
    assert np.linalg.norm(state.xyz.mean(axis=0) - rough.truth.xyz.mean(axis=0)) < 20.0

    bare = replace(simulated.network, bars=replace(bars, start=bars.start[:0], end=bars.end[:0], length=bars.length[:0], u=bars.u[:0]))
    state = start_values(bare)[1]
    apart = state.position[:, None] - state.position
    assert np.sqrt(np.mean(np.sum(apart**2, axis=2))) == pytest.approx(1.0, rel=1e-6)
    assert (state.position[:, 2] > np.max(state.xyz[:, 2])).mean() > 0.5  # z towards the images


@pytest.mark.parametrize("control", ["one", "one and bars", "two", "two, weighted", "in line"])
def test_control_that_leaves_the_frame_open_in_part(control: str, rng: np.random.Generator):
    """The start has the control points where they are, so that the adjustment has nothing left to turn."""
    simulated = simulate(rng, images=12, points=60, field="plane", bars=2 if "bars" in control else 0, c_known=False)
    network, truth = simulated.network, simulated.truth
    some = [7] if control.startswith("one") else [7, 8] if control.startswith("two") else [0, 1, 2]
    xyz, u = network.xyz.copy(), network.u_xyz.copy()
    xyz[some], u[some] = truth.xyz[some], 0.1 if "weighted" in control else 0.0
    network, state = start_values(replace(network, xyz=xyz, u_xyz=u))
    result = adjust(network, state)
    assert result.sigma0 < 1.3 and result.iterations <= 8
    np.testing.assert_allclose(result.state.xyz[some], truth.xyz[some], atol=0.5 if "weighted" in control else 1e-9)
    size = np.ptp(result.state.xyz, axis=0).max() / np.ptp(truth.xyz, axis=0).max()
    assert control == "one" or 0.5 < size < 2


free, fixed, weak = np.inf, 0.0, 0.05
IN_PART = {
    "X of one": {4: (fixed, free, free)},
    "X and Y of one": {4: (fixed, fixed, free)},
    "two heights": {4: (free, free, fixed), 9: (free, free, fixed)},
    "all heights": {j: (free, free, weak) for j in range(40)},
    "vague heights": {j: (free, free, 200.0) for j in range(12)},
    "a point and two coordinates of another": {0: (fixed, fixed, fixed), 5: (free, fixed, fixed)},
    "three and heights": {0: (weak,) * 3, 1: (weak,) * 3, 2: (weak,) * 3} | {j: (free, free, weak) for j in range(3, 8)},
    "places of some, heights of others": {j: (weak, weak, free) if j % 2 else (free, free, weak) for j in range(8)},
}


@pytest.mark.parametrize("unknown", [np.nan, 0.0])
@pytest.mark.parametrize("name", IN_PART)
def test_points_of_which_some_coordinates_are_known(name: str, unknown: float, rng: np.random.Generator):
    """Whatever is written for the others, every image point is used, and camera and known coordinates come out within their covariance,
    each but for one run in a million. An error of a parameter of 6 to 7 u would be seen."""
    away = np.array([2000.0, 5000.0, 300.0])
    simulated = simulate(rng, images=10, points=40, bars=0)
    network, truth = simulated.network, simulated.truth
    u = np.array([IN_PART[name].get(j, (free, free, free)) for j in range(40)])
    true = truth.xyz + away
    xyz = true + np.where(np.isfinite(u), u, 0.0) * rng.standard_normal(u.shape)
    xyz[np.isinf(u)] = np.nan
    in_part = np.isfinite(u).any(axis=1)[:, None] & np.isinf(u)
    partly = replace(network, xyz=np.where(in_part, unknown, xyz), u_xyz=u)
    result = calibrate_network(partly, Options(folds=0, false_alarms=1e-6))
    found = result.adjustment
    assert found.used.all() and ("no_scale" in {f.kind for f in result.findings}) == (np.isfinite(u).sum() < 6)
    names, covariance = found.interior_covariance(0)
    off = (found.state.interior[0] - truth.interior[0])[network.cameras[0].free]
    assert off @ np.linalg.solve(covariance, off) < len(names) * stats.f.isf(1e-6, len(names), found.dof)
    known = np.isfinite(u)
    left = (found.state.xyz - true)[known] / np.maximum(u[known], 1e-9)
    assert left @ left < stats.chi2.isf(1e-6, known.sum())


def test_same_answer_twice(rng: np.random.Generator):
    network = simulate(rng, images=12, points=60, **DIRTY).network
    one, other = start_values(network)[1], start_values(network)[1]
    np.testing.assert_array_equal(one.interior, other.interior)
    np.testing.assert_array_equal(one.position, other.position)


def test_point_and_image_seen_too_seldom_are_left_out(rng: np.random.Generator):
    simulated = simulate(rng, images=12, points=60)
    network = simulated.network
    keep = ~((network.point == 7) & (network.image > 0)) & ~((network.image == 5) & (network.point > 2))
    columns = {name: getattr(network, name)[keep] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    state = start_values(replace(network, **columns))[1]
    assert np.isnan(state.xyz[7]).all() and np.isfinite(np.delete(state.xyz, 7, axis=0)).all()
    assert np.isnan(state.position[5]).all() and np.isfinite(np.delete(state.position, 5, axis=0)).all()


@pytest.mark.parametrize("known", ["fixed", "partly", "rough"])
def test_mirrored_coordinates_are_named(known: str, rng: np.random.Generator):
    network = simulate(rng, images=10, points=80, known=known).network
    with pytest.raises(InputError, match="only if one of them is mirrored.*y counts upwards"):
        start_values(replace(network, y_px=SENSOR.rows - 1 - network.y_px))


def test_mirrored_coordinates_of_a_shallow_field_are_named(rng: np.random.Generator):
    """Rough coordinates may move, and those of a field that is 80 mm high and good to 2 mm move into its mirror image: then the
    images fit, and only the shape of the field tells. One that is right is not refused, nor a plane, which fits either way."""
    for field, height in (("volume", 80.0), ("plane", 400.0)):
        simulated = simulate(rng, images=10, points=80, known="rough", field=field, size=(1000.0, 800.0, height))
        network = replace(simulated.network, xyz=0.8 * simulated.truth.xyz + 0.2 * simulated.network.xyz)
        start_values(network)
        turned = replace(network, y_px=SENSOR.rows - 1 - network.y_px)
        if field == "plane":
            start_values(turned)
        else:
            with pytest.raises(InputError, match="only if one of them is mirrored.*y counts upwards"):
                start_values(turned)


def test_points_with_other_names_are_explained(rng: np.random.Generator):
    network = simulate(rng, images=10, points=80, known="fixed").network
    with pytest.raises(MeasureError, match="agree with each other, but not with the known coordinates.*names of the points"):
        start_values(replace(network, xyz=np.roll(network.xyz, 31, axis=0)))


def test_network_without_ties_is_explained(rng: np.random.Generator):
    network = simulate(rng, images=8, points=200, bars=0).network
    keep = network.point // 25 == network.image  # each image has points of its own
    columns = {name: getattr(network, name)[keep] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    with pytest.raises(MeasureError, match="8 of 8 images cannot be oriented.*IMG_0001 .at most 0 points in common"):
        start_values(replace(network, **columns))


def test_two_groups_with_two_points_in_common_are_explained(rng: np.random.Generator):
    network = simulate(rng, images=24, points=62, bars=0).network
    keep = np.where(network.image < 12, network.point < 32, network.point >= 30)
    columns = {name: getattr(network, name)[keep] for name in ("x_px", "y_px", "image", "point", "covariance_px2")}
    with pytest.raises(MeasureError, match=r"\d+ of 24 images cannot be oriented.*share 2 points with the others"):
        start_values(replace(network, **columns))


def test_principal_distance_of_homographies_is_exact(rng: np.random.Generator):
    """Zhang's closed form, for planes seen by a camera of c = 1234 in any pose."""
    plane = rng.uniform(-1, 1, (30, 2))
    found = []
    for _ in range(5):
        turn = Rotation.from_euler("xyz", [rng.uniform(0.3, 0.8), rng.uniform(-0.8, -0.3), rng.uniform(0, 6)]).as_matrix()
        away = np.column_stack([plane, np.zeros(30)]) @ turn.T + [0.1, -0.2, 5.0]
        image = 1234.0 * away[:, :2] / away[:, 2:]
        h = homography(plane, image)
        there = np.column_stack([plane, np.ones(30)]) @ h.T
        np.testing.assert_allclose(there[:, :2] / there[:, 2:], image, atol=1e-6)
        found.append(h)
    assert principal_distance(found) == pytest.approx(1234.0, rel=1e-8)
    level = [homography(plane, 1000.0 * plane @ Rotation.from_euler("z", a).as_matrix()[:2, :2].T) for a in (0.0, 1.0, 2.0)]
    c = principal_distance(level)  # planes parallel to the image hold none: nothing, or rounding errors
    assert np.isnan(c) or not 1.0 < c < 1e5


def test_pose_with_a_quarter_of_the_points_wrong(rng: np.random.Generator):
    for flat in (0.0, 1.0):
        xyz = rng.uniform(-1, 1, (40, 3)) * [1, 1, flat] + [1e5, 2e5, 50.0]
        turn = Rotation.from_euler("xyz", [2.6, 0.4, 1.0]).as_matrix()
        position = xyz.mean(axis=0) - turn.T @ [0.2, -0.1, 6.0]
        away = (xyz - position) @ turn.T
        uv = away[:, :2] / away[:, 2:]
        uv[:10] += rng.choice([-1, 1], (10, 2)) * rng.uniform(0.05, 0.1, (10, 2))
        found = pose(uv, xyz, 0.005)
        assert found is not None and not found.fits[:10].any() and found.fits[10:].all()
        np.testing.assert_allclose(found.position, position, atol=1e-6)
        np.testing.assert_allclose(found.rotation, turn, atol=1e-7)


def test_rays_meet_in_their_point(rng: np.random.Generator):
    """Exact rays meet exactly, one wrong one among five is thrown out, and parallel ones meet nowhere."""
    xyz = rng.uniform(-1, 1, (3, 3))
    angle = np.linspace(0.0, 2.0, 5)
    centre = np.column_stack([6 * np.cos(angle), 6 * np.sin(angle), 5 + 0 * angle])
    point, image = np.repeat([0, 1], 5), np.tile(np.arange(5), 2)
    ray = xyz[point] - centre[image]
    ray[3] += [0.3, -0.3, 0.2]
    point = np.concatenate([point, [2, 2]])
    origin = np.concatenate([centre[image], [[0.0, 0.0, 900.0], [1.0, 0.0, 900.0]]])
    ray = np.concatenate([ray, xyz[2] - origin[-2:]])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    found, fits = intersect(origin, ray, point, 3, 1e-3)
    np.testing.assert_allclose(found[1], xyz[1], atol=1e-9)
    np.testing.assert_allclose(found[0], xyz[0], atol=1e-3)
    assert np.isnan(found[2]).all()
    np.testing.assert_array_equal(fits, np.concatenate([np.arange(10) != 3, [False, False]]))


@pytest.mark.parametrize("count", [2, 3])
def test_similarity_of_few_points_leaves_none_out(count: int, rng: np.random.Generator):
    """Errors of 0.3 of 1000: no distance of least squares is larger than all of them together, here 4 with 1e-6."""
    source = 1000 * rng.standard_normal((count, 3))
    turn = Rotation.random(rng=rng)
    left = fitted(source, turn.apply(source) + 0.3 * rng.standard_normal((count, 3)))[3]
    assert left.max() < 4.0


def test_similarity_with_wrong_points(rng: np.random.Generator):
    source = rng.standard_normal((40, 3))
    turn = Rotation.from_rotvec([0.3, -0.4, 2.0]).as_matrix()
    target = 2.5 * source @ turn.T + [10.0, -3.0, 7.0]
    target[:8] += rng.uniform(1, 3, (8, 3))
    scale, rotation, shift, left = fitted(source, target)
    assert scale == pytest.approx(2.5, rel=1e-6)
    np.testing.assert_allclose(rotation, turn, atol=1e-6)
    np.testing.assert_allclose(shift, [10.0, -3.0, 7.0], atol=1e-5)
    assert (left[:8] > 1.0).all() and (left[8:] < 1e-4).all()
