"""A plate with 16 targets in the first hour of three cameras: what the sensor, its package and the lens mount do."""

import numpy as np

from pixmetry import load_camera, locate
from pixmetry.report.drawing import BLUE, RED, SOFT, canvas
from pixmetry.scene.discs import Discs
from pixmetry.series.job import measure_series

EVERY_S, FRAMES, ROOM_C, HEAT_K, TAU_S, ENLARGED = 180.0, 21, 20.0, 20.0, 1200.0, 600
PARTS = {"silicon alone": (2.6e-6, 0.0), "ceramic package": (7e-6, 0.0), "silicon, aluminium mount": (2.6e-6, 23e-6)}  # per kelvin
SHIFTS_PX_PER_K = ((0.0, 0.0), (0.003, -0.002), (-0.002, 0.003))  # of three cameras: the sensor creeps in its mount
X, Y = (v.ravel() for v in np.meshgrid(np.linspace(30, 722, 4), np.linspace(30, 552, 4)))


def camera_of(sensor_per_k, mount_per_k, shift=(0.0, 0.0)):
    moves = {"reference_c": ROOM_C, "sensor_per_k": sensor_per_k, "mount_per_k": mount_per_k}
    moves |= {"shift_x_px_per_k": shift[0], "shift_y_px_per_k": shift[1]}
    return load_camera("pulnix_tm6cn").with_parameters("sensor.thermal_expansion", **moves)


def edge_px(part):
    """Displacement at the right edge, by the camera's own map."""
    cold, hot = (camera_of(*PARTS[part]).true_positions([751.5], [290.5], temperature_c=ROOM_C + k)[0][0] for k in (0.0, HEAT_K))
    return abs(hot - cold)


def run():
    scene = Discs(X, Y, diameter_px=12.0, blur_px=0.8, peak_photons=110000.0)
    schedule = {"temperature_c": lambda t: ROOM_C + HEAT_K * (1 - np.exp(-t / TAU_S)), "frame_period_s": EVERY_S}
    values, vectors = {}, []
    for k, shift in enumerate(SHIFTS_PX_PER_K, 1):
        camera = camera_of(*PARTS["silicon, aluminium mount"], shift)
        frames = [camera.expose(scene, [n], **schedule).data[0] for n in range(FRAMES)]
        named = [(f"{n}", n * EVERY_S, lambda frame=frames[n]: frame) for n in range(FRAMES)]
        fit = measure_series(named).drift.fit
        values |= {f"scale_{k}": 1e4 * fit["scale_rel"].value, f"u_scale_{k}": 1e4 * fit["scale_rel"].u}
        places = [[c[:, np.lexsort([c[0], np.rint(c[1] / 100)])] for c in [np.array([t["x_px"], t["y_px"]])]][0]
                  for t in (locate(frames[n], polarity="bright").columns for n in (0, -1))]  # fmt: skip
        vectors.append((places[0], places[1] - places[0]))
        terms = np.column_stack([np.ones(16), places[0].T])
        left = vectors[-1][1].T - terms @ np.linalg.lstsq(terms, vectors[-1][1].T, rcond=None)[0]
        values |= {f"largest_{k}": np.hypot(*vectors[-1][1]).max(), f"linear_{k}": 1 - (left**2).sum() / (vectors[-1][1] ** 2).sum()}
    edges = {name: edge_px(name) for name in PARTS}
    values |= {"silicon": edges["silicon alone"], "ceramic": edges["ceramic package"], "mount": edges["silicon, aluminium mount"]}
    values |= {"needed_k": HEAT_K * 0.2 / edges["silicon alone"], "linear": min(values[f"linear_{k}"] for k in (1, 2, 3))}

    with canvas(1.7, ncols=3, sharey=True) as (figure, panels):
        for k, (axes, (first, shift)) in enumerate(zip(panels, vectors, strict=True), 1):
            axes.quiver(*first, *(ENLARGED * shift), color=RED, angles="xy", scale_units="xy", scale=1, width=0.015)
            axes.set(xlim=(-140, 892), ylim=(720, -140), aspect="equal", title=f"camera {k}", xticks=[0, 400], yticks=[0, 400])
    with canvas(1.5) as (bars, axes):
        axes.barh(list(edges), list(edges.values()), color=BLUE, height=0.6)
        axes.axvline(0.2, color=SOFT, linestyle="--")
        axes.set(xlabel=f"shift at the edge for {HEAT_K:g} K / px", xlim=(0, 0.22))
    return values, {"camera-warm-up-vectors": figure, "camera-warm-up-parts": bars}
