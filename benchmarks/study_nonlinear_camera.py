"""A camera that bends by 2 % at full scale: are gain and dark noise found without bias, blind?

    python benchmarks/study_nonlinear_camera.py --seeds 200 --jobs 2

y (1 − 0.02 (y/y_max)³), 0.1 DN/e-, 30 e- dark noise, 12 bit, 50 bright and 50 dark levels of two frames each, through the camera's whole
chain with PRNU, DSNU and rounding; 640 × 480 pixels. Every seed is another unit with other noise.

The result goes to docs/closed-loop.md.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("PIXMETRY_THREADS", "1")  # the processes share out the seeds
import numpy as np  # noqa: E402
from scipy import stats  # noqa: E402

from pixmetry.camera.camera import build_camera  # noqa: E402
from pixmetry.camera.observations import PhotonTransfer  # noqa: E402
from pixmetry.emva.evaluate import standard_values  # noqa: E402
from pixmetry.emva.records import Measurement  # noqa: E402
from pixmetry.observe.moments import LevelAccumulator, level_moments  # noqa: E402
from pixmetry.observe.photon_transfer_fit import fit_photon_transfer  # noqa: E402
from pixmetry.scene.files import SeriesModel  # noqa: E402
from pixmetry.simulate.job import expose_group, plan_series  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from statistical import closed_loop_page  # noqa: E402

BITS, GAIN, NOISE_E, OFFSET_DN, BEND = 12, 0.1, 30.0, 40.0, -0.02
NAMES = ("gain_dn_per_e", "dark_noise_e", "nonlinearity_a1", "nonlinearity_a2", "nonlinearity_a3")
TRUTH = dict(zip(NAMES, (GAIN, NOISE_E, 0.0, 0.0, BEND), strict=True))


def camera_record(rows: int, cols: int, unit_seed: int) -> dict:
    chain = [
        ("sensor.quantum_efficiency", {"quantum_efficiency": 0.5}),
        ("sensor.prnu", {"pixel_std_rel": 0.01}),
        ("sensor.shot_noise", {}),
        ("sensor.dsnu", {"pixel_std_e": 5.0}),
        ("electronics.amplifier_noise", {"white_e": NOISE_E}),
        ("electronics.gain", {"gain_dn_per_e": GAIN}),
        ("electronics.nonlinearity", {"a3": BEND, "reference_dn": 2.0**BITS - 1}),
        ("grabber.adc", {"bits": BITS, "offset_dn": OFFSET_DN}),
    ]
    return {
        "schema": "pixmetry/camera/1",
        "name": "bent camera",
        "rows": rows,
        "cols": cols,
        "unit_seed": unit_seed,
        "chain": [{"source": source, "parameters": parameters} for source, parameters in chain],
    }


def measure_one(job: tuple[int, int, int]) -> np.ndarray:
    """Value, u and dof of each quantity, and the gain by the standard's line, shape (len(NAMES) + 1, 3)."""
    rows, cols, seed = job
    camera = build_camera(camera_record(rows, cols, seed))
    top_e = (2**BITS - 1 - OFFSET_DN) / GAIN
    series = SeriesModel(levels=50, brightest_photons=1.1 * top_e / 0.5, longest_exposure_s=0.02, stack_frames=8)
    groups = {"dark": [], "bright": []}
    for g in plan_series(series):
        if g.role == "level":
            level = LevelAccumulator(BITS)
            for frame in expose_group(camera, g, seed):
                level.add(frame)
            groups[g.kind].append((level.summary(), g.exposure_s))
    moments = {kind: level_moments([s for s, _ in part], [t for _, t in part]) for kind, part in groups.items()}
    record = PhotonTransfer(moments["bright"], moments["dark"], (rows, cols), BITS)
    fit, line = fit_photon_transfer(record), standard_values(Measurement(record), "3.1").values["K"]
    return np.array([(fit[n].value, fit[n].u, fit[n].dof) for n in NAMES] + [(line.value, line.u, line.dof)])


def table(rows: int, cols: int, first: int, seeds: int, pool: ProcessPoolExecutor) -> str:
    start = time.perf_counter()
    found = np.array(list(pool.map(measure_one, [(rows, cols, first + i) for i in range(seeds)])))
    minutes = (time.perf_counter() - start) / 60
    lines = []
    for i, name in enumerate(NAMES):
        value, u, dof = found[:, i].T
        true = TRUTH[name]
        p = stats.t.cdf((value - true) / u, np.minimum(dof, 1e9))
        z = stats.norm.ppf(np.clip(p, 1e-16, 1 - 1e-16))
        if true and name in ("gain_dn_per_e", "dark_noise_e"):
            off = f"{100 * (value.mean() / true - 1):+.4f} % ± {100 * value.std(ddof=1) / true / np.sqrt(seeds):.4f} %"
            each = f"{100 * u.mean() / true:.3f} %"
        else:
            off, each = f"{value.mean() - true:+.5f} ± {value.std(ddof=1) / np.sqrt(seeds):.5f}", f"{u.mean():.5f}"
        ks = stats.kstest(p, "uniform").pvalue
        lines.append(f"| {name} | {true:g} | {off} | {each} | {z.mean():+.2f} | {z.std(ddof=1):.2f} | {ks:.2g} |")
    line = 100 * (found[:, -1, 0].mean() / GAIN - 1)
    return f"""{seeds} seeds, {cols} × {rows} pixels, {minutes:.1f} min ({len(found) * 200} frames):

| quantity | truth | mean − truth ± standard error | u of one camera | mean z | std z | KS p |
|---|---|---|---|---|---|---|
{chr(10).join(lines)}

The straight line of EMVA 1288 finds the gain {line:+.2f} % off in the mean.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--shape", type=int, nargs=2, default=(480, 640), metavar=("ROWS", "COLS"))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "closed-loop.md")
    args = parser.parse_args()
    with ProcessPoolExecutor(args.jobs) as pool:
        found = table(*args.shape, args.first, args.seeds, pool)
    text = "## A camera that bends\n\n" + __doc__.split("\n\n")[2].strip() + "\n\n" + found
    closed_loop_page.write_section(args.page, "bent camera", text)
    print(text)


if __name__ == "__main__":
    main()
