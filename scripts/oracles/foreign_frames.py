"""Frames that other people's programs make: a point spread of GalSim, charge trails of arCTIc, response curves of colour and scikit-image.

Usage (in the environment of the oracles): python foreign_frames.py edges|trails|curves IN.npz OUT.npz

Exits with status 3 where the program is not there.
"""

from __future__ import annotations

import sys

import numpy as np


def edges(given: dict) -> dict:
    """A bright square that is turned, seen through a lens and by whole pixels; and the lens's own transfer function."""
    import galsim

    if str(given["lens"]) == "gaussian":
        lens = galsim.Gaussian(sigma=float(given["size_px"]))
    else:
        lens = galsim.Airy(lam_over_diam=float(given["size_px"]))
    side, n = float(given["side_px"]), int(given["pixels"])
    params = galsim.GSParams(maximum_fft_size=16384, folding_threshold=1e-4)
    square = galsim.Box(side, side).rotate(float(given["angle_deg"]) * galsim.degrees) * side**2
    drawn = galsim.Convolve(square, lens, gsparams=params).drawImage(nx=n, ny=n, scale=1.0)  # convolves with the pixel
    return {"image": drawn.array, "mtf": np.array([abs(lens.kValue(2 * np.pi * f, 0.0)) for f in given["frequency"]])}


def trails(given: dict) -> dict:
    """Images read out through traps, towards row 0, or column 0."""
    from arcticpy import CCD, ROE, TrapInstantCapture, add_cti

    traps = [TrapInstantCapture(density=float(given["density"]), release_timescale=float(given["release_px"]))]
    ccd = CCD(full_well_depth=float(given["full_well_e"]), well_fill_power=1.0)
    along = str(given["along"])
    how = {f"{along}_traps": traps, f"{along}_ccd": ccd, f"{along}_roe": ROE(), f"{along}_express": 0}
    return {"images": np.array([add_cti(image=image.astype(float), verbosity=0, **how) for image in given["images"]])}


def curves(given: dict) -> dict:
    """Values over full scale behind a curve."""
    name, linear = str(given["curve"]), given["linear"]
    if name == "adjust_gamma":
        from skimage.exposure import adjust_gamma

        return {"stored": adjust_gamma(np.clip(linear, 0, None), float(given["gamma"]))}
    from colour.models import cctf_encoding

    return {"stored": np.sign(linear) * cctf_encoding(np.abs(linear), function=name)}


def main(what: str, given: str, out: str) -> None:
    with np.load(given) as found:
        values = {name: found[name] for name in found.files}
    try:
        made = {"edges": edges, "trails": trails, "curves": curves}[what](values)
    except ImportError as problem:
        print(problem, file=sys.stderr)
        sys.exit(3)
    np.savez(out, **made)


if __name__ == "__main__":
    main(*sys.argv[1:])
