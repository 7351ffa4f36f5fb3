"""Draw flat fields with GalSim's detector noise and print the histogram of the stored numbers of each level as JSON.

Usage (in the environment of the oracles): python galsim_flats.py CASE.json

The case holds rows, cols, seed, levels_e, prnu_rel, dark_e, dsnu_e, read_e, full_well_e, gain_dn_per_e, offset_dn, top.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import galsim
import numpy as np


def flat(case: dict, level_e: float, rng: galsim.BaseDeviate) -> np.ndarray:
    """One frame: Poisson counts of light and dark, full well, fixed offsets and read noise, gain, rounding."""
    image = galsim.ImageD(case["cols"], case["rows"], init_value=1.0)
    image.addNoise(galsim.GaussianNoise(rng, sigma=case["prnu_rel"]))
    image *= level_e
    image += case["dark_e"]
    image.addNoise(galsim.PoissonNoise(rng))
    image.array[:] = np.minimum(image.array, case["full_well_e"])
    image.addNoise(galsim.GaussianNoise(rng, sigma=case["dsnu_e"]))
    image /= 1.0 / case["gain_dn_per_e"]
    # CCDNoise without Poisson part: read noise of electrons in units of the image
    image.addNoise(galsim.CCDNoise(rng, gain=0.0, read_noise=case["read_e"] * case["gain_dn_per_e"]))
    image += case["offset_dn"]
    image.quantize()
    return np.clip(image.array, 0, case["top"]).astype(np.int64)


def main(path: str) -> None:
    case = json.loads(Path(path).read_text())
    rng = galsim.BaseDeviate(case["seed"])
    counts = [np.bincount(flat(case, level, rng).ravel(), minlength=case["top"] + 1).tolist() for level in case["levels_e"]]
    json.dump(counts, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
