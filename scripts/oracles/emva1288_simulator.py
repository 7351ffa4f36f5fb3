"""Let the simulator of the public EMVA 1288 reference implementation take a series: image files, its own descriptor, and the truth.

Usage (in the environment of the oracles): python emva1288_simulator.py CASE.json FOLDER

The case holds seed, rows, cols, bits, K, blackoffset, dark_signal_0, sigma2_dark_0, u_esat, dark_current_ref, exposure_max_ns, steps, L,
dsnu_e and prnu_rel (pixel, row, column). Printed as JSON: the path of the descriptor, gain and efficiency as the camera has set them, and
the expected dark and bright images at the stacks' exposure as paths of NPY files.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from emva1288.camera.dataset_generator import DatasetGenerator
from emva1288.camera.routines import Qe


def pattern(rng: np.random.Generator, shape: tuple[int, int], parts: list[float]) -> np.ndarray:
    """Normal values of pixels, rows and columns."""
    rows, cols = shape
    drawn = rng.standard_normal((rows, cols)), rng.standard_normal((rows, 1)), rng.standard_normal((1, cols))
    return sum(part * values for part, values in zip(parts, drawn, strict=True))


def main(path: str, folder: str) -> None:
    case = json.loads(Path(path).read_text())
    rng = np.random.default_rng(case["seed"])
    shape = rows, cols = case["rows"], case["cols"]
    efficiency = Qe(wavelength=np.linspace(500.0, 560.0, 4), width=cols, height=rows)
    series = DatasetGenerator(
        steps=case["steps"],
        L=case["L"],
        outdir=folder,
        width=cols,
        height=rows,
        bit_depth=case["bits"],
        qe=efficiency,
        K=case["K"],
        blackoffset=case["blackoffset"],
        dark_signal_0=case["dark_signal_0"],
        sigma2_dark_0=case["sigma2_dark_0"],
        dark_current_ref=case["dark_current_ref"],
        temperature=30,
        u_esat=case["u_esat"],
        exposure_max=case["exposure_max_ns"],
        exposure_min=case["exposure_max_ns"] / case["steps"],
        dsnu=pattern(rng, shape, case["dsnu_e"]),
        prnu=1 + pattern(rng, shape, case["prnu_rel"]),
        seed=case["seed"],
    )
    camera = series.cam
    ((exposure, (light, _)),) = series.points["spatial"].items()
    camera.exposure = exposure
    dark_e = camera._u_therm() + case["dark_signal_0"] + camera.DSNU
    for name, electrons in (("dark", dark_e), ("bright", dark_e + camera._u_e(light))):
        np.save(Path(folder) / f"{name}.npy", camera.blackoffset + camera.K * electrons)
    photons = camera.get_photons(light)[0, 0]
    json.dump(
        {
            "descriptor": str(series.descriptor_path),
            "K": float(camera.K),
            "QE": float(photons @ efficiency.qe[0, 0] / photons.sum()),
            "dark": str(Path(folder) / "dark.npy"),
            "bright": str(Path(folder) / "bright.npy"),
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
