"""Speed of the bundle adjustment: ``python benchmarks/bench_bundle.py``.

Three simulated networks, noise 0.04 px, from start values 1 % wrong in the principal distance, 3 mm in points, 5 mm and 0.3° in images; one
thread. Ours estimates ten interior parameters and gives their covariance, that of all images and a 3 × 3 covariance for each point. Beside
it pycolmap (``pip install pixmetry[peers]``), model OPENCV with eight interior parameters: adjustment, and its covariance of poses, points
and interior. Networks are made without what it lacks (shear, K3), so that both reach the same residuals. Reading the network into either is
not counted. Both run one after the other in every repeat; a ratio is the median of those of the repeats, of wall and of processor time.

``python benchmarks/bench_bundle.py large`` times one of 1000 images × 20 000 points once, ours alone, and prints the memory it took.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
from goals import verdict

from pixmetry.calibrate.bundle.bundle import adjust
from pixmetry.calibrate.bundle.network import Adjustment, Network, State
from pixmetry.core.threads import single_threaded_blas

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from calibrate.networks import Simulated, simulate  # noqa: E402

NETWORKS = {
    "50 images x 100 points": (dict(images=50, points=100), 1.2, 9),
    "100 images x 500 points": (dict(images=100, points=500), 0.6, 5),
    "300 images x 3000 points, 5 % seen": (dict(images=300, points=3000, visibility=0.05), 0.4, 5),
}  # fmt: skip


def start_of(rng: np.random.Generator, simulated: Simulated) -> State:
    """The truth, wrong by what initial values are wrong by; no distortion."""
    from scipy.spatial.transform import Rotation

    truth = simulated.truth
    interior, n = truth.interior.copy(), len(truth.position)
    interior[:, 0] *= 1.01
    interior[:, 3:] = 0.0
    return replace(
        truth,
        interior=interior,
        rotation=Rotation.from_rotvec(np.deg2rad(0.3) * rng.standard_normal((n, 3))).as_matrix() @ truth.rotation,
        position=truth.position + 5.0 * rng.standard_normal((n, 3)),
        xyz=truth.xyz + 3.0 * rng.standard_normal(truth.xyz.shape),
    )


def reconstruction(pycolmap: ModuleType, network: Network, start: State):
    """The network and its start values as pycolmap has them; its pixel (0.5, 0.5) is the centre of the first one."""
    camera, row = network.cameras[0], start.interior[0]
    mx, my = camera.sensor.per_px
    fx, fy, cx, cy = float(row[0] / mx), float(row[0] / my), float(row[1] + 0.5), float(row[2] + 0.5)
    out = pycolmap.Reconstruction()
    lens = [fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0]
    size = {"width": camera.sensor.cols, "height": camera.sensor.rows}
    out.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model="OPENCV", params=lens, **size))
    xy = np.stack([network.x_px, network.y_px], axis=1) + 0.5
    place = np.zeros(len(network), int)
    for i in range(len(network.images)):
        rows = np.flatnonzero(network.image == i)
        place[rows] = np.arange(len(rows))
        points = pycolmap.Point2DList([pycolmap.Point2D(one) for one in xy[rows]])
        image = pycolmap.Image(name=network.images[i], image_id=i + 1, camera_id=1, points2D=points)
        R = start.rotation[i]
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ start.position[i]))
    for j in range(len(network.points)):
        rows = np.flatnonzero(network.point == j)
        if len(rows) >= 2:
            elements = [pycolmap.TrackElement(int(network.image[r]) + 1, int(place[r])) for r in rows]
            out.add_point3D(start.xyz[j], pycolmap.Track(elements))
    return out


def theirs(pycolmap: ModuleType, network: Network, start: State) -> tuple[Callable[[], object], Callable[[], float]]:
    """What to time, and the sum of squared residuals in px² after it."""
    scene = reconstruction(pycolmap, network, start)
    config = pycolmap.BundleAdjustmentConfig()
    for image in scene.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = True
    options.ceres.solver_options.num_threads = 1
    wanted = pycolmap.BACovarianceOptions()
    wanted.params = pycolmap.BACovarianceOptionsParams.ALL
    found = []

    def run() -> None:
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
        found.append(adjuster.solve())
        if pycolmap.estimate_ba_covariance(wanted, scene, adjuster) is None:
            raise RuntimeError("pycolmap gave no covariance")

    return run, lambda: 2 * found[-1].ceres_summary.final_cost


def timed(action: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor seconds."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - wall, time.process_time() - processor


def compare(name: str, pycolmap: ModuleType | None, rng: np.random.Generator) -> None:
    """Time one network."""
    options, goal, repeats = NETWORKS[name]
    simulated = simulate(rng, bars=0, direction="object_to_image", interior={"b2": 0.0, "k3": 0.0}, **options)
    network, start = simulated.network, start_of(rng, simulated)
    results: list[Adjustment] = [adjust(network, start)]  # compiles what is not in the cache
    times, squares = [], 0.0
    for _ in range(repeats):
        own = timed(lambda: results.append(adjust(network, start)))
        other = (np.nan, np.nan)
        if pycolmap is not None:
            run, cost = theirs(pycolmap, network, start)
            other, squares = timed(run), cost()
        times.append((*own, *other))
    wall, processor, their_wall, their_processor = np.median(times, axis=0)
    last = results[-1]
    rms = np.sqrt((last.residual_px[last.used] ** 2).sum() / (2 * last.used.sum()))
    print(f"{name}: {last.used.sum()} image points, {len(last.free_columns)} reduced unknowns, {last.iterations} iterations")
    print(f"  pixmetry {wall:.3f} s wall, {processor:.3f} s processor; residuals {rms:.6f} px rms")
    if pycolmap is None:
        return
    print(f"  pycolmap {their_wall:.3f} s wall, {their_processor:.3f} s processor; {np.sqrt(squares / (2 * last.used.sum())):.6f} px rms")
    ratios = np.array(times)[:, :2] / np.array(times)[:, 2:]
    verdict(f"{name}, wall time over pycolmap", float(np.median(ratios[:, 0])), goal)
    verdict(f"{name}, processor time over pycolmap", float(np.median(ratios[:, 1])), goal)


def large(rng: np.random.Generator) -> None:
    """Time and memory of 1000 images × 20 000 points, each point in 32 images."""
    simulated = simulate(
        rng, images=1000, points=20_000, visibility=0.025, bars=0, direction="object_to_image", interior={"b2": 0.0, "k3": 0.0}
    )
    results: list[Adjustment] = []
    wall, processor = timed(lambda: results.append(adjust(simulated.network, start_of(rng, simulated))))
    found = results[-1]
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{found.used.sum()} image points, {len(found.free_columns)} reduced unknowns, {found.iterations} iterations")
    print(f"  {wall:.1f} s wall, {processor:.1f} s processor, {memory_gb:.2f} GB; sigma0 {found.sigma0:.4f}")


def main() -> None:
    """Print times and ratios, network by network."""
    if sys.argv[1:] == ["large"]:
        with single_threaded_blas():
            large(np.random.default_rng(np.random.SeedSequence()))
        return
    try:
        import pycolmap
    except ImportError:
        pycolmap = None
        print("pycolmap is not installed: no ratios (pip install pixmetry[peers])")
    rng = np.random.default_rng(np.random.SeedSequence())
    with single_threaded_blas():
        for name in NETWORKS:
            compare(name, pycolmap, rng)


if __name__ == "__main__":
    main()
