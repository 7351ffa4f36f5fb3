"""Coverage of the bundle adjustment: ``python benchmarks/study_bundle_coverage.py [networks] [independent|shared|all]``.

Networks of 50 images × 100 points and of 100 × 500 (200 of them by default), and a quarter as many of 300 × 3000 with 5 % seen; noise
0.04 px, all ten interior parameters free, two scale bars. Squared Mahalanobis distances from the truth are pooled and held against
chi-squared at a rate of false failures of 1e-6: of the interior parameters, and of all points jointly (after the rigid motion that the
datum means), in all of the smallest, some of the middle and none of the largest networks, for the dense covariance of all points is dear.
The mean of the squared distances of single points, which are correlated, stands below.

The second part (``shared``) is of pictures of a board of 9 × 6 targets, 640 × 480 px, eight interior parameters free, the board free, whose
errors are correlated: noise of 0.02 px and

- *images*: in each image another principal distance and point (0.1 px) and scale of x (1e-4), and a board that flexes (0.12 and 0.08 mm on
  225 mm); a law of the view (targets seen obliquely are located off their place, by 0.02 px);
- *view*: that law alone;
- *frame*: a field over the frame (six waves of 400 px, 0.03 px rms) that the camera model lacks;
- *rig*: two cameras at each instant with all of these.

Columns: share of the interior parameters within the stated 95 % interval (t with the stated degrees of freedom) and with uncertainties of
independent errors; stated u over that of independent errors (median); degrees of freedom (median); share of networks whose joint F-test of
all interior parameters does not fail at 5 %. Parameters of a network hang together: coverage is known to about ±1.5 % with 200 networks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.model import NAMES, CameraModel, Sensor
from pixmetry.calibrate.bundle.network import Network, ScaleBars, State
from pixmetry.calibrate.bundle.shared_errors import with_shared_errors

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from calibrate.distances import Pooled, each_point, interior_distance, jointly, points_distance  # noqa: E402
from calibrate.networks import disturbed, image_of, looking, simulate  # noqa: E402

RATE = 1e-6
KINDS = (
    ("50 images x 100 points", dict(images=50, points=100), 1.0, 1.0),
    ("100 images x 500 points", dict(images=100, points=500), 1.0, 0.04),
    ("300 images x 3000 points, 5 % seen", dict(images=300, points=3000, visibility=0.05), 0.25, 0.0),
)  # fmt: skip


def report(what: str, pooled: Pooled) -> None:
    """One line."""
    low, high = pooled.caught(RATE)
    verdict = "covered" if pooled.p > RATE else "NOT COVERED"
    print(
        f"  {what}: {pooled.squared:.1f} of {pooled.dof} degrees of freedom ({pooled.squared / pooled.dof:.4f}), p = {pooled.p:.3g}: "
        f"{verdict}; standard deviations {100 * (low - 1):+.1f} % or {100 * (high - 1):+.1f} % wrong would be seen"
    )


FREE = ("c", "xp", "yp", "b1", "p1", "p2", "k1", "k2")
BOARD = np.column_stack([*(25.0 * (part.ravel() - part.mean()) for part in np.meshgrid(np.arange(9.0), np.arange(6.0))), np.zeros(54)])
NOISE_PX = 0.02
SHARED = (  # kinds of errors, images of a camera, cameras, networks as a share of those asked for
    ("independent", 5, 1, 1.0), ("independent", 13, 1, 1.0), ("independent", 50, 1, 0.25), ("independent", 13, 2, 0.25),
    ("images", 5, 1, 1.0), ("images", 13, 1, 1.0), ("images", 50, 1, 0.25),
    ("view", 13, 1, 1.0), ("view", 50, 1, 0.25),
    ("frame", 5, 1, 1.0), ("frame", 13, 1, 1.0), ("frame", 50, 1, 0.25),
    ("images frame", 5, 1, 1.0), ("images frame", 13, 1, 1.0), ("images frame", 50, 1, 0.25), ("images frame rig", 13, 2, 0.5),
)  # fmt: skip


def pictures(rng: np.random.Generator, kind: str, images: int, cameras: int) -> tuple[Network, State]:
    """A measured board whose image points share errors, and the truth."""
    models = tuple(CameraModel.of(Sensor(640, 480), "object_to_image", name=f"camera {k + 1}", c=535.0) for k in range(cameras))
    models = tuple(replace(model, free=np.isin(NAMES, FREE)) for model in models)
    true = {"c": 535 * (1 + 0.02 * rng.standard_normal()), "k1": -0.29, "k2": 0.11, "p1": 4e-4, "p2": -3e-4, "b1": 1e-4}
    interior = np.stack([CameraModel.of(Sensor(640, 480), "object_to_image", **true).values] * cameras)
    interior[:, 1:3] += rng.uniform(-10, 10, (cameras, 2))
    across, down = BOARD[:, 0] / BOARD[:, 0].max(), BOARD[:, 1] / BOARD[:, 0].max()
    xyz = BOARD + np.outer(0.25 * (across**2 - 0.3), [0, 0, 1])
    waves = [(rng.uniform(0, 2 * np.pi, (2, 6)), 0.03 * np.sqrt(2 / 6) * rng.standard_normal((6, 2))) for _ in range(cameras)]
    rotation, position, seen = [], [], []
    for rotations, positions in stands(rng, models, interior, xyz, images):
        flex = np.zeros(len(xyz))
        if "images" in kind:
            flex = 0.12 * rng.standard_normal() * (across**2 - 0.3) + 0.08 * rng.standard_normal() * across * down
        for k, (turn, place) in enumerate(zip(rotations, positions, strict=True)):
            own, scale = interior[k].copy(), 0.0
            if "images" in kind:
                own[:3] += 0.1 * rng.standard_normal(3)
                scale = 1e-4 * rng.standard_normal()
            bent = xyz + np.outer(flex, [0, 0, 1])
            x, y, depth = image_of(models[k], own, turn, place, bent, x_scale=scale, origin_px=320.0)
            shift = np.zeros((len(xyz), 2))
            if "images" in kind or "view" in kind:  # as of circles of 10 mm: across the tilt, with the square of their image's size
                u, v, normal = (x - own[1]) / own[0], (y - own[2]) / own[0], turn[:, 2]
                size = 0.5 * own[0] * (10 / depth) ** 2 * (u * normal[0] + v * normal[1] + normal[2])
                shift += size[:, None] * np.stack([normal[0] - u * normal[2], normal[1] - v * normal[2]], axis=1)
            if "frame" in kind:
                (angle, phase), size = waves[k]
                along = 2 * np.pi / 400 * (np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle))) + phase
                shift += np.sin(along) @ size
            seen.append(np.stack([x, y], axis=1) + shift + NOISE_PX * rng.standard_normal((len(xyz), 2)))
            rotation.append(turn)
            position.append(place)
    count, n = len(seen), len(xyz)
    places = np.concatenate(seen)
    network = Network(
        cameras=models, images=tuple(f"I{i}" for i in range(count)), camera_of=np.arange(count) % cameras,
        points=tuple(f"T{j}" for j in range(n)), x_px=places[:, 0], y_px=places[:, 1], image=np.repeat(np.arange(count), n),
        point=np.tile(np.arange(n), count), covariance_px2=np.tile([NOISE_PX**2, 0.0, NOISE_PX**2], (count * n, 1)), xyz=BOARD,
        u_xyz=np.full((n, 3), np.inf), bars=ScaleBars.none(), instant=np.arange(count) // cameras if "rig" in kind else None,
    )  # fmt: skip
    return network, State(interior, np.array(rotation), np.array(position), np.zeros(count), np.zeros(count), xyz)


def stands(
    rng: np.random.Generator, models: tuple[CameraModel, ...], interior: np.ndarray, xyz: np.ndarray, images: int
) -> Iterator[tuple[list[np.ndarray], list[np.ndarray]]]:
    """Rotations and places of cameras side by side, 80 mm apart, from which all of them see the whole board."""
    found = 0
    while found < images:
        tilt, turn, distance = np.deg2rad(rng.uniform(5, 42)), rng.uniform(0, 2 * np.pi), rng.uniform(280, 520)
        stand = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        target = rng.uniform(-1, 1, 3) * [60, 45, 0]
        rotation = looking(target + distance * stand, target, rng.uniform(-0.4, 0.4))
        places = [target + distance * stand + rotation.T @ [80.0 * k, 0, 0] for k in range(len(models))]
        views = [image_of(model, row, rotation, place, xyz) for model, row, place in zip(models, interior, places, strict=True)]
        if all(((x > 5) & (x < 634) & (y > 5) & (y < 474)).all() for x, y, _ in views):
            found += 1
            yield [rotation] * len(models), places


def shared(networks: int, rng: np.random.Generator) -> None:
    """Coverage of interior parameters where image points share errors."""
    print("errors, images, cameras, networks: covered of 95 % (as independent); u / u independent; degrees of freedom; joint F-test held")
    for kind, images, cameras, share in SHARED:
        count, began = max(1, round(share * networks)), time.perf_counter()
        covered, before, wider, dofs, joint = [], [], [], [], []
        for _ in range(count):
            network, truth = pictures(rng, kind, images, cameras)
            found = with_shared_errors(adjust(network, truth))
            for k in range(cameras):
                error = (found.state.interior - truth.interior)[k, network.cameras[k].free]
                C, dof, independent = found.interior_covariance(k)[1], found.interior_dof(k), found.interior_u_independent(k)
                u = np.sqrt(np.diag(C))
                covered += list(np.abs(error) <= stats.t.ppf(0.975, dof) * u)
                before += list(np.abs(error) <= stats.t.ppf(0.975, found.dof) * independent)
                wider += list(u / independent)
                dofs += list(dof)
                f = error / u @ np.linalg.solve(C / np.outer(u, u), error / u) / len(error)
                joint.append(stats.f.sf(f, len(error), dof.mean()) > 0.05)
        took = time.perf_counter() - began
        print(
            f"  {kind}, {images}, {cameras}, {count}: {np.mean(covered):.3f} ({np.mean(before):.3f}); {np.median(wider):.2f} (mean "
            f"{np.mean(wider):.3f}); {np.median(dofs):.1f}; {np.mean(joint):.2f}; {took:.0f} s",
            flush=True,
        )


def main() -> None:
    networks = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = np.random.SeedSequence().entropy
    rng = np.random.default_rng(seed)
    print(f"seed {seed}, rate {RATE:g}")
    which = sys.argv[2] if len(sys.argv) > 2 else "all"
    if which != "shared":
        independent(networks, rng)
    if which != "independent":
        shared(networks, rng)


def independent(networks: int, rng: np.random.Generator) -> None:
    """Errors as the covariance says, where they are independent."""
    for name, options, share, joint_share in KINDS:
        count, began = max(1, round(share * networks)), time.perf_counter()
        interior = points = residuals = Pooled(0.0, 0)
        single = []
        for i in range(count):
            joint = i < round(joint_share * networks)
            simulated = simulate(rng, bars=2, **options)
            network = jointly(simulated.network) if joint else simulated.network
            found = adjust(network, disturbed(rng, simulated, 0.003), a_priori=True)
            interior += interior_distance(found, simulated)
            residuals += Pooled(found.cost[-1], found.dof - len(network.bars) + len(simulated.network.bars))
            points += points_distance(found, simulated) if joint else Pooled(0.0, 0)
            single.append(each_point(found, simulated).mean() / 3)
        print(f"{name}: {count} networks, {time.perf_counter() - began:.0f} s")
        report("interior parameters", interior)
        if points.dof:
            report("points", points)
        report("residuals", residuals)
        spread = f" ± {np.std(single, ddof=1) / np.sqrt(count):.4f}" if count > 1 else ""
        print(f"  squared distance of single points over 3, mean: {np.mean(single):.4f}{spread}")


if __name__ == "__main__":
    main()
