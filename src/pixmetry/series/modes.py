"""From positions of targets in every frame to the motion of the whole field: shift, scale, rotation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.camera.drift_series import CAMERA_MODES, GRABBER_MODES
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError

LEAST_TARGETS = 3  # in a frame, for shift, scale and rotation with a check
LEAST_SHARE = 0.5  # of the frames in which a target must be seen
LEAST_SPREAD = 1e-3  # singular value of the modes for a target, with places over the farthest one
PASSES = 4  # places and modes in turn; targets that are missing in some frames couple them weakly


@dataclass(frozen=True)
class FieldMotion:
    """Modes of every frame, about the mean places of the targets.

    Parameters
    ----------
    modes : tuple of str
    values : ndarray, shape (frames, modes)
    covariance : ndarray, shape (frames, modes, modes)
        From the covariances of the positions.
    places_px : ndarray, shape (targets, 2)
        Mean places, from the frame's centre.
    used : ndarray, shape (frames,), bool
        Frames with enough targets.
    targets : ndarray of int
        Which of the given targets took part.
    location_factor : float
        Root of χ² over its degrees of freedom of the targets about the modes.
    dof : int
    """

    modes: tuple[str, ...]
    values: Array
    covariance: Array
    places_px: Array
    used: np.ndarray
    targets: np.ndarray
    location_factor: float
    dof: int


def design_of(places_px: Array, modes: tuple[str, ...]) -> Array:
    """Displacement of places for a unit of each mode, shape (targets, 2, modes)."""
    x, y = places_px.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    columns = {
        "shift_x_px": (one, zero),
        "shift_y_px": (zero, one),
        "scale_rel": (x, y),
        "rotation_rad": (-y, x),
        "affinity_rel": (x, zero),
        "shear_rel": (y, zero),
    }
    return np.stack([np.stack(columns[mode], axis=-1) for mode in modes], axis=-1)


def field_motion(positions_px: Array, covariance_px2: Array, centre_px: tuple[float, float], *, analogue: bool = False) -> FieldMotion:
    """Fit the motion of the field in every frame.

    Parameters
    ----------
    positions_px : ndarray, shape (frames, targets, 2)
        NaN where a target was not found.
    covariance_px2 : ndarray, shape (frames, targets, 2, 2)
    centre_px : (float, float)
        Of the frame, about which it is scaled and turned.
    analogue : bool
        Whether the rows were sampled by a frame grabber, so that x has a scale and a shear of its own.

    Returns
    -------
    FieldMotion

    Raises
    ------
    MeasureError
        With fewer than three targets that stay, or fewer than three frames that show them; or where the targets lie on a line, so that
        the modes are not told from each other.

    Notes
    -----
    Generalised least squares: each target weighs by the inverse of its covariance. A target's own place is its mean over the frames, less
    the motion; an error of it is the same in all frames, so it is taken up by the constant of each mode, which no parameter needs.
    """
    modes = (*CAMERA_MODES, *(GRABBER_MODES if analogue else ()))
    seen = np.asarray(np.isfinite(positions_px).all(axis=2) & np.isfinite(covariance_px2).all(axis=(2, 3)))
    kept = np.flatnonzero(seen.mean(axis=0) >= LEAST_SHARE)
    if kept.size < LEAST_TARGETS:
        raise MeasureError(
            f"{kept.size} targets are seen in at least half of the frames",
            where="series",
            allowed=f"{LEAST_TARGETS} or more, spread over the frame; 9 are good",
            remedy="show a field of targets that stays in view",
        )
    positions, covariance, seen = positions_px[:, kept] - np.asarray(centre_px), covariance_px2[:, kept], seen[:, kept]
    used = seen.sum(axis=1) >= LEAST_TARGETS
    if used.sum() < 3:
        raise MeasureError(f"only {used.sum()} frames show the targets", where="series", remedy="take more frames")
    middle = np.nanmean(np.where(seen[..., None], positions, np.nan), axis=0)
    spread = np.linalg.svd(design_of(middle / np.abs(middle).max(), modes).reshape(-1, len(modes)), compute_uv=False)[-1]
    if spread < LEAST_SPREAD * np.sqrt(kept.size):
        raise MeasureError("all targets lie on a line", where="series", allowed="targets all over the frame", remedy="add others beside it")
    weight = np.zeros_like(covariance)
    weight[seen] = np.linalg.inv(covariance[seen])
    filled = np.where(seen[..., None], positions, 0.0)
    places = np.einsum("kiab,kib->ia", weight, filled)
    total = weight[used].sum(axis=0)
    values = np.zeros((len(positions), len(modes)))
    moved = np.zeros_like(filled)
    for _ in range(PASSES):
        places = np.linalg.solve(total, np.einsum("kiab,kib->ia", weight[used], (filled - moved)[used])[..., None])[..., 0]
        design = design_of(places, modes)
        weighted = np.einsum("kiab,ibm->kiam", weight, design)
        normal = np.einsum("iam,kian->kmn", design, weighted)
        normal[~used] = np.eye(len(modes))
        right = np.einsum("kiam,kia->km", weighted, filled - places)
        right[~used] = 0
        values = np.linalg.solve(normal, right[..., None])[..., 0]
        values[used] -= values[used].mean(axis=0)  # their zero
        moved = np.einsum("iam,km->kia", design, values)
    left = np.where(seen[..., None], filled - places - moved, 0.0)[used]
    chi2 = float(np.einsum("kia,kiab,kib->", left, weight[used], left))
    dof = int(2 * seen[used].sum() - 2 * kept.size - len(modes) * (used.sum() - 1))
    factor = float(np.sqrt(chi2 / dof)) if dof > 0 else 1.0
    cofactor = np.linalg.inv(normal)
    return FieldMotion(modes, values, cofactor, places, used, kept, factor, dof)


def focus_motion(blur_px2: Array) -> tuple[Array, Array]:
    """Change of the blur's variance in each frame, about the mean of the series, and its u, px², shape (frames,).

    Parameters
    ----------
    blur_px2 : ndarray, shape (frames, targets, 2)
        Variance of each target's blur, and its u; NaN where it was not measured.

    Notes
    -----
    Each target's own blur is its weighted mean over the frames; the frame's change is the weighted mean over its targets. u grows where
    single targets scatter more than their u.
    """
    value, u = np.moveaxis(blur_px2, 2, 0)
    good = np.isfinite(value) & (u > 0)
    good &= good.mean(axis=0) >= LEAST_SHARE
    if not good.any():
        return np.full(len(value), np.nan), np.full(len(value), np.nan)
    weight = np.where(good, 1 / np.where(good, u, 1.0) ** 2, 0.0)
    filled = np.where(good, value, 0.0)
    seen = weight.sum(axis=1) > 0
    change = np.zeros(len(value))
    for _ in range(PASSES):
        own = (weight * (filled - change[:, None])).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
        change[seen] = (weight * (filled - own)).sum(axis=1)[seen] / weight.sum(axis=1)[seen]
        change[seen] -= change[seen].mean()
    left = np.where(good, filled - own - change[:, None], 0.0)
    dof = int(good.sum() - good.any(axis=0).sum() - seen.sum() + 1)
    factor = max(1.0, float(np.sqrt((weight * left**2).sum() / dof))) if dof > 0 else 1.0
    change[~seen] = np.nan
    return change, np.where(seen, factor / np.sqrt(np.maximum(weight.sum(axis=1), 1e-300)), np.nan)
