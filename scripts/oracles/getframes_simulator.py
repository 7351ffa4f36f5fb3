"""Let getframes take a series for EMVA 1288: image files, a descriptor, and the truth.

Usage (in the environment of the oracles): python getframes_simulator.py CASE.json FOLDER

The case holds seed, levels, L, longest_s, brightest_photons and config, the fields of getframes.CameraConfig. Printed as JSON: the path
of the descriptor, and the expected dark and bright images at the stacks' exposure as paths of NPY files.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import getframes
import numpy as np
from getframes.noise import fixed_pattern_maps
from PIL import Image


def main(path: str, folder: str) -> None:
    case = json.loads(Path(path).read_text())
    folder = Path(folder)
    config = getframes.CameraConfig(name="flat", sensor_type="CMOS", pixel_size_um=5.0, **case["config"])
    temperature = config.dark_current_ref_temp_c
    rows, cols = config.resolution
    rate = case["brightest_photons"] / case["longest_s"]
    lines = ["v 4.0", f"n {config.bit_depth} {cols} {rows}"]
    seeds = iter(range(case["seed"], case["seed"] + 1_000_000))
    camera = getframes.Camera(config)

    def take(number: int, exposure: float, light: float) -> None:
        lines.append(f"b {exposure * 1e9!r} {light * exposure!r}" if light else f"d {exposure * 1e9!r}")
        for _ in range(number):
            seed = next(seeds)
            frame = camera.expose(light, exposure, temperature, seed=seed, include_truth=False)
            Image.fromarray(frame.data.astype(np.uint16)).save(folder / f"{seed}.png")
            lines.append(f"i {seed}.png")

    exposures = [case["longest_s"] * (i + 1) / case["levels"] for i in range(case["levels"])]
    for exposure in exposures:
        take(2, exposure, rate)
        take(2, exposure, 0.0)
    middle = exposures[case["levels"] // 2 - 1]
    take(case["L"], middle, rate)
    take(case["L"], middle, 0.0)
    descriptor = folder / "EMVA1288_Data.txt"
    descriptor.write_text("\n".join(lines) + "\n")
    maps = fixed_pattern_maps(config)
    dark_e = config.dark_current_e_per_s * middle * np.broadcast_to(maps.dark_multiplier, (rows, cols))
    light_e = rate * middle * config.quantum_efficiency * np.broadcast_to(maps.prnu_multiplier, (rows, cols))
    for name, electrons in (("dark", dark_e), ("bright", dark_e + light_e)):
        np.save(folder / f"{name}.npy", electrons / config.gain_e_per_adu + config.bias_offset_adu + maps.bias_structure)
    json.dump({"descriptor": str(descriptor)} | {name: str(folder / f"{name}.npy") for name in ("dark", "bright")}, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
