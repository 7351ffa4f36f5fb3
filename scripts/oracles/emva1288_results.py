"""Evaluate a descriptor file with the public EMVA 1288 reference implementation and print its numbers as JSON.

Usage (in the environment of the oracles): python emva1288_results.py DESCRIPTOR
"""

from __future__ import annotations

import json
import logging
import sys

import numpy as np
from emva1288.process import routines
from emva1288.process.data import Data1288
from emva1288.process.loader import LoadImageData
from emva1288.process.parser import ParseEmvaDescriptorFile
from emva1288.process.results import Results1288

NAMES = (
    "K",
    "QE",
    "sigma_d",
    "u_I_mean",
    "DSNU1288",
    "DSNU1288_pixel",
    "DSNU1288_row",
    "DSNU1288_col",
    "PRNU1288",
    "PRNU1288_pixel",
    "PRNU1288_row",
    "PRNU1288_col",
    "index_u_ysat",
    "index_sensitivity_max",
)


def main(descriptor: str) -> None:
    quiet = {"loglevel": logging.ERROR}
    images = ParseEmvaDescriptorFile(descriptor, **quiet).images
    reduced = Data1288(LoadImageData(images, **quiet).data, **quiet).data
    results = Results1288(reduced, **quiet)
    values = {name: getattr(results, name) for name in NAMES}
    values = {name: float(value() if callable(value) else value) for name, value in values.items()}
    scalars = {}
    for name in routines.cls_1288_info(Results1288):
        value = getattr(results, name)
        value = value() if callable(value) else value
        if value is not None and np.ndim(value) == 0 and not isinstance(value, dict):
            scalars[name] = float(value)
    temporal = {name: [float(v) for v in reduced["temporal"][name]] for name in ("u_y", "s2_y", "u_ydark", "s2_ydark", "texp")}
    json.dump(values | {"temporal": temporal, "scalars": scalars}, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
