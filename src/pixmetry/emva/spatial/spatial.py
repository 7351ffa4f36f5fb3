"""Spatial variances of the dark and the bright stack, DSNU and PRNU, as each release of EMVA 1288 has them.

What temporal noise does to them. The mean image of L frames holds the pattern and 1/L of the temporal noise. Noise that is common to a
row of one frame leaves σ²_row,t/L in the row means; the standard (eq. 36, 41, 42) takes the whole of σ²_y.stack/L off as if it were white.
So too little is taken off the rows, where it stays as a pattern, and too much off the pixels: s²_row comes out too large by σ²_row,t/L
and s²_pixel too small by as much, below zero where the pixels' pattern is weaker than that. Release 4.0 here takes each part of the
temporal noise off its own part of the pattern; releases 3.1 and reference do what the standard says.
"""

from __future__ import annotations

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.emva.records import RELEASES
from pixmetry.emva.spatial.spatial_inputs import SpatialInputs

PARTS = ("", "_row", "_col", "_pixel")


def spatial_variances(inputs: SpatialInputs, vectors: Array, release: str, tag: str = "") -> dict[str, Array]:
    """All spatial variances of one stack, DN²; ``tag`` is appended to the keys.

    Parameters
    ----------
    inputs : SpatialInputs
        High-passed for release 4.0.
    vectors : ndarray, shape (..., 8)
        ``inputs.vector`` or draws of it.
    release : {"4.0", "3.1", "reference"}

    Returns
    -------
    dict
        ``s_2_y_measured``, ``s_2_y``, ``s_2_y_cav``, ``s_2_y_rav``, ``s_2_y_col``, ``s_2_y_row``, ``s_2_y_pixel`` and
        ``sigma_2_y_stack``, each of shape (...).

    Notes
    -----
    Releases 3.1 and reference: eq. 35, 36, 41, 42, on the image as it is; the reference divides s²_y.measured by MN − 1.

    Release 4.0: the variances of the high-passed image (all pixels, column means, row means) are, in expectation over the temporal noise,

        V = G (p + t/L)

    with the pattern's variances p = (pixel, row, column), the temporal ones t, and the matrix G of ``high_pass.pattern_gains``. So
    p = G⁻¹ V − t/L is free of bias whatever the frame's size: the filter's gains and the correlation that it leaves are in G, and each part
    of t comes off its own part of p. Then s²_y = s²_pixel + s²_row + s²_col (eq. 37), s²_cav = s²_col + s²_pixel/M, s²_rav = s²_row +
    s²_pixel/N (eq. 41), and s²_y.measured is what the sum was before t/L was taken off. All are of the pattern before the filter, as far
    as it is not slow. Temporal noise that is correlated between neighbouring pixels passes the filter with another gain than white noise,
    and what is left of it counts as pattern.
    """
    rows, cols = inputs.shape
    frames, stack = inputs.n_frames, vectors[..., 4]
    if release == "4.0":
        whole = vectors[..., 1:4] @ np.linalg.inv(inputs.gains).T
        pixel, row, col = np.moveaxis(whole - vectors[..., 5:] / frames, -1, 0)
        measured, total = whole.sum(axis=-1), pixel + row + col
        cav, rav = col + pixel / rows, row + pixel / cols
    else:
        size = rows * cols
        measured = vectors[..., 1] * (size / (size - 1) if release == "reference" else 1.0)
        total = measured - stack / frames
        cav, rav = vectors[..., 2] - stack / (frames * rows), vectors[..., 3] - stack / (frames * cols)
        d = size - rows - cols
        row = ((size - cols) * rav - rows * (total - cav)) / d
        col = ((size - rows) * cav - cols * (total - rav)) / d
        pixel = size * (total - cav - rav) / d
    values = {"_measured": measured, "": total, "_cav": cav, "_rav": rav, "_col": col, "_row": row, "_pixel": pixel}
    return {f"sigma_2_y_stack{tag}": stack} | {f"s_2_y{name}{tag}": value for name, value in values.items()}


def spatial_evaluation(
    dark: SpatialInputs,
    bright: SpatialInputs,
    dark_vectors: Array,
    bright_vectors: Array,
    release: str,
    gain_dn_per_e: Array | float,
) -> tuple[dict[str, Array], dict[str, Array]]:
    """All spatial values of a release, for one vector of each stack or for many draws, and the variances behind the roots.

    Parameters
    ----------
    dark, bright : SpatialInputs
    dark_vectors, bright_vectors : ndarray, shape (..., 8)
    release : {"4.0", "3.1", "reference"}
    gain_dn_per_e : float or ndarray, shape (...)
        K.

    Returns
    -------
    values : dict
        By key of the public result format. A root of a negative variance is NaN.
    squares : dict
        Of each value that is a root, its square with its sign (e⁻², DN² or %²).

    Raises
    ------
    InputError
        If the release is not known, or the inputs were not filtered as it needs.
    MeasureError
        If the bright stack is not brighter than the dark one.
    """
    _check(dark, bright, release)
    variances = spatial_variances(dark, dark_vectors, release, "_dark") | spatial_variances(bright, bright_vectors, release)
    squares = _squares(variances, bright_vectors[..., 0] - dark_vectors[..., 0], gain_dn_per_e)
    with np.errstate(invalid="ignore"):
        return variances | {key: np.sqrt(square) for key, square in squares.items()}, squares


def _squares(values: dict[str, Array], light_dn: Array, gain: Array | float) -> dict[str, Array]:
    """EMVA 1288 R4.0 eq. 66 and 67 before the root is taken."""
    squares = {f"DSNU1288{part}": values[f"s_2_y{part}_dark"] / np.square(gain) for part in PARTS}
    squares["DSNU1288_DN"] = values["s_2_y_dark"]
    for part in PARTS:
        squares[f"PRNU1288{part}"] = (values[f"s_2_y{part}"] - values[f"s_2_y{part}_dark"]) * np.square(100.0 / light_dn)
    return squares


def _check(dark: SpatialInputs, bright: SpatialInputs, release: str) -> None:
    if release not in RELEASES:
        raise InputError("no such release of EMVA 1288", where="release", value=release, allowed=", ".join(RELEASES))
    if {dark.high_passed, bright.high_passed} != {release == "4.0"}:
        raise InputError("release 4.0 needs high-passed inputs, the others unfiltered ones", value=(dark.high_passed, bright.high_passed))
    if dark.shape != bright.shape:
        raise InputError("dark and bright stack differ in shape", value=bright.shape, allowed=str(dark.shape))
    if bright.vector[0] <= dark.vector[0]:
        raise MeasureError("the bright stack is not brighter than the dark one", value=bright.vector[0], allowed=f"above {dark.vector[0]}")


def snr_total_max(u_e_sat: Array, dark_noise_e2: Array, dsnu2_e2: Array | float, prnu2_percent2: Array | float) -> Array:
    """Largest signal-to-noise ratio with non-uniformity: EMVA 1288 R4.0 eq. 69 at saturation, where it is largest.

    Parameters
    ----------
    u_e_sat : ndarray
        Saturation capacity, e⁻.
    dark_noise_e2 : ndarray
        σ²_y.dark/K², e⁻²: with the quantisation in it.
    dsnu2_e2, prnu2_percent2 : ndarray
        Squares of DSNU1288 and PRNU1288 from :func:`spatial_evaluation`; a negative one stands for none.
    """
    pattern = np.maximum(dsnu2_e2, 0.0) + np.maximum(prnu2_percent2, 0.0) * 1e-4 * np.square(u_e_sat)
    return u_e_sat / np.sqrt(dark_noise_e2 + u_e_sat + pattern)
