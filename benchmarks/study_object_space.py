"""Points in space as the budget predicts them, against networks that `pixmetry.calibrate` adjusts.

``python benchmarks/study_object_space.py [calibrations [networks [seed]]]``. Twelve networks, drawn at random: cameras of several presets
with sources that move points (lens, tilt, bow of the sensor, affinity), 2 to 8 rays, several bases, focal lengths and distances, all models
of calibration. Each is measured several times: a calibration field is imaged through the camera's own maps with noise, and adjusted with
free interior parameters; then objects are, with these held. Printed are the standard deviations of the points in X, Y and Z, predicted over
found. The noise of an image point is the budget's.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import pixmetry  # noqa: E402
from budget.measured_networks import Measured, calibration_shots, measuring_shots  # noqa: E402
from pixmetry.budget.object_space import point_of  # noqa: E402
from pixmetry.budget.table import independent_px  # noqa: E402
from pixmetry.camera.camera import Camera, Element, load_camera  # noqa: E402
from pixmetry.camera.catalogue import get_source  # noqa: E402
from pixmetry.camera.chain_order import in_order  # noqa: E402

PRESETS = ("imx264_like", "pulnix_tm6cn_epix_pixelclock", "sony_xc8500_progressive")
OBJECTS = 4  # that are measured with one calibration
MODELS = ("lens", "lens", "residual_grid", "principal_point_and_scale", "none", "lens")


def with_maps(camera: Camera, f_mm: float, rng: np.random.Generator) -> Camera:
    """The camera with a lens, and a sensor that is not quite where it should be."""
    pitch = {"pitch_x_um": camera.pitch_um[0], "pitch_y_um": camera.pitch_um[1]}
    reach = 0.5e-3 * np.hypot(camera.frame_shape[1] * camera.pitch_um[0], camera.frame_shape[0] * camera.pitch_um[1])
    k1 = rng.uniform(0.3, 1) * 3e-3 * camera.pitch_um[0] / reach**3  # some pixels in a corner
    told = {
        "optics.distortion": {"k1_per_mm2": -k1, "k2_per_mm4": 0.1 * k1 / reach**2, "p1_per_mm": 0.05 * k1 * reach, **pitch},
        "sensor.tilt": {"tilt_x_deg": rng.uniform(-0.2, 0.2), "tilt_y_deg": rng.uniform(-0.2, 0.2), "principal_distance_mm": f_mm, **pitch},
        "sensor.affinity": {"b1": rng.uniform(-1e-4, 1e-4), "b2": rng.uniform(-1e-4, 1e-4)},
        "sensor.unflatness": {
            **{f"bow_{a}_um": rng.uniform(1, 8) for a in "xy"},
            "chief_ray_deg": float(np.degrees(np.arctan(reach / f_mm))),
            "f_number": 8.0,
            **pitch,
        },
    }
    chain = [e for e in camera.chain if e.source.id not in told]
    chain += [Element(n, get_source(n), get_source(n).make(p)) for n, p in told.items()]
    by_id = {e.source.id: e for e in chain}
    return replace(camera, chain=tuple(by_id[s.id] for s in in_order(e.source for e in chain)))


def study(rng: np.random.Generator, number: int, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """One network: predicted over found, in X, Y and Z, and the standard error of that by the scatter of the calibrations."""
    rays, base = int(rng.integers(2, 9)), float(rng.choice([0.2, 0.5, 0.8, 1.2, 1.8]))
    f_mm, distance = float(rng.choice([8.0, 12.0, 25.0, 50.0])), float(rng.choice([500.0, 1000.0, 3000.0]))
    model, images, targets, points = (
        MODELS[number % len(MODELS)],
        int(rng.choice([8, 16, 24])),
        int(rng.choice([40, 80])),
        int(rng.choice([20, 50])),
    )
    flat = bool(rng.integers(2))
    scenario = {
        "target": {"diameter_px": float(rng.uniform(5, 9)), "surface": str(rng.choice(["retro", "diffuse"]))},
        "object": {"distance_mm": distance, "f_mm": f_mm},
        "count": {"rays": rays, "base_to_height": base, "arrangement": str(rng.choice(["circle", "row"])), "points": points},
        "calibration": {"model": model, "images": images, "targets": targets, "field": "flat" if flat else "deep"},
    }
    camera = with_maps(load_camera(PRESETS[number % len(PRESETS)]), f_mm, rng)
    budget = pixmetry.budget(camera, scenario)
    rows = [r for r in budget.rows if r.in_camera or r.fields_px is None or r.name == "calibration"]
    measured = Measured(budget.setting, independent_px(rows))
    predicted = point_of(rows, budget.setting)
    half = 0.5 * np.array(camera.frame_shape[::-1]) * camera.pitch_um * 1e-3 / measured.c_mm * distance
    errors = []
    for _ in range(repeats):
        calibration = None
        if model != "none":
            shots = calibration_shots(rng, images, targets, distance, half, flat)
            calibration = measured.calibrated(model, shots, rng)
        for _ in range(OBJECTS):
            shots = measuring_shots(rng, rays, base, scenario["count"]["arrangement"], points, distance, 0.8 * half)
            errors.append(measured.points(shots, calibration, rng.standard_normal((2, rays, points))))
    squares = np.nanmean(np.square(errors).reshape(repeats, -1, 3), axis=1)  # of every calibration: its objects share its errors
    found = np.sqrt(squares.mean(axis=0))
    ratio = predicted.u_mm / found
    error = ratio * 0.5 * squares.std(axis=0, ddof=1) / squares.mean(axis=0) / np.sqrt(repeats)
    how, field = scenario["count"]["arrangement"], "flat" if flat else "deep"
    told = (f"{rays} rays {how} {base:g}", f"{points} points", model, f"{images} x {targets} {field}")
    shown = [np.round(1e3 * v, 2) for v in (found, predicted.u_mm, predicted.shared_mm)]
    print(f"{camera.name}, f {f_mm:g} mm, {distance:g} mm, {', '.join(told)}")
    print(f"  found {shown[0]} µm, predicted {shown[1]} (shared {shown[2]}), ratio {np.round(ratio, 3)} ± {np.round(error, 3)}", flush=True)
    return ratio, error


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 12
    networks = int(sys.argv[2]) if len(sys.argv) > 2 else 12
    seed = int(sys.argv[3]) if len(sys.argv) > 3 else np.random.SeedSequence().entropy
    print(f"seed {seed}")
    rng, began = np.random.default_rng(seed), time.perf_counter()
    ratios, errors = np.moveaxis([study(rng, k, repeats) for k in range(networks)], 1, 0)
    within, or_chance = (100 * np.mean(np.abs(ratios - 1) <= 0.1 + more) for more in (0.0, 2 * errors))
    print(f"all: median {np.round(np.median(ratios, axis=0), 3)}, from {ratios.min():.3f} to {ratios.max():.3f}")
    told = f"{within:.0f} % within 10 %, {or_chance:.0f} % within 10 % and two standard errors"
    print(f"{told}; {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
