"""What a later job needs of the results of an assessment: the camera that was measured, and its maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pixmetry.camera.camera import Camera, load_camera
from pixmetry.core.checksums import check_file, check_record
from pixmetry.core.door import check_depth, read_bytes
from pixmetry.core.errors import InputError
from pixmetry.files.results import read_maps


def load_assessment(path: str | Path) -> tuple[int, Camera, dict[str, np.ndarray]]:
    """Bits of a camera that was assessed, the camera, and its maps, each held against the digest that was taken when it was written.

    Parameters
    ----------
    path : path
        Of the folder of results, or of its ``results.json``.

    Raises
    ------
    InputError
        If these are no results of an assessment, or they are damaged.
    """
    results = Path(path)
    remedy = "name the results.json of an assessment"
    if results.is_dir():
        results = results / "results.json"
    text = read_bytes(results, remedy=remedy)
    try:
        record = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=str(results), remedy=f"{remedy}; if this is one, it is damaged: assess again") from None
    if not isinstance(record, dict) or record.get("schema") != "pixmetry/results/1":
        raise InputError("is not the result of an assessment", where=str(results), remedy=remedy)
    check_depth(record, str(results))
    digests = check_record(record, str(results))
    for name in ("camera.yaml", "maps.zarr.zip"):
        path = results.parent / name
        if not path.is_file():
            raise InputError(f"{name} is missing beside the results", where=str(results.parent), remedy="assess the camera again")
        if name not in digests:
            remedy = "assess the camera again"
            raise InputError(f"the results contain no digest of {name}", where=str(results), remedy=remedy)
        check_file(path, digests)
    try:
        bits = int(record["camera"]["bits"])
    except (KeyError, TypeError, ValueError):
        raise InputError("damaged results of an assessment", where=str(results), remedy="assess the camera again") from None
    maps, _ = read_maps(results.parent / "maps.zarr.zip")
    return bits, load_camera(results.parent / "camera.yaml"), maps
