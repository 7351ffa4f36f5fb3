"""Parts of the images against each other: halves that are calibrated apart, and each part left out in turn.

Both hold the stated uncertainties against the images themselves. What the halves share (errors at a place of the frame, of a direction of
view) cancels in their difference, and is not in its uncertainty; what is common to one half only, as of images that were taken one after
the other, no uncertainty holds: there the test of halves is the one that sees it.

References
----------
B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982), chapter 3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES
from pixmetry.calibrate.bundle.network import Adjustment
from pixmetry.calibrate.bundle.shared_errors import interior_parts
from pixmetry.calibrate.checks.hold_out import LeftOut, subset
from pixmetry.calibrate.checks.quality import plain
from pixmetry.calibrate.records import Halves, Jackknife, SharedByCamera
from pixmetry.core.arrays import Array, Flags, Ints
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.finding import Finding

SHARED = {
    "image": "in one image",
    "frame": "at one place of the frame in all images",
    "view": "in images from similar directions",
    "oblique": "of targets seen obliquely",
}
LEAST_IMAGES = 6  # of a camera, to be halved
RARE = 0.01
EVERY_OTHER, IN_ORDER = "every other image", "the first and the second half"
ADVICE = {
    EVERY_OTHER: "Look for what differs between these images: focus, light, names of points. Take all directions of view in turn.",
    IN_ORDER: "Images that follow one another share an error that the uncertainties do not hold. Look for what changed meanwhile: "
    "temperature, focus, the board, the directions of view. Mix these.",
}


def halves_of(adjustment: Adjustment) -> dict[str, tuple[Halves, ...]]:
    """Every other image against the rest, and the first half against the second, by camera; empty where images are too few.

    Parameters
    ----------
    adjustment : Adjustment
        With the errors that image points share.
    """
    network = adjustment.network
    posed = adjustment.state.posed & (np.bincount(network.image[adjustment.used], minlength=len(network.images)) > 0)
    rank, count = _ranks(network.camera_of, network.time_s, posed)
    if count[posed].min(initial=LEAST_IMAGES) < LEAST_IMAGES:
        return {}
    splits = ((EVERY_OTHER, rank % 2 == 0), (IN_ORDER, rank < count / 2))
    found: dict[str, tuple[Halves, ...]] = {}
    for by, first in splits:
        try:
            for camera, one in _compared(adjustment, by, posed & first, posed & ~first).items():
                found[camera] = (*found.get(camera, ()), one)
        except (InputError, MeasureError):
            continue  # half of the images do not determine the cameras
    return found


def _ranks(camera_of: Ints, time_s: Array | None, posed: Flags) -> tuple[Ints, Ints]:
    """Places of the images among those of their camera, by time where it is known, and how many these are."""
    rank, count = np.zeros(len(posed), int), np.zeros(len(posed), int)
    for k in np.unique(camera_of):
        mine = np.flatnonzero(posed & (camera_of == k))
        timed = time_s is not None and np.isfinite(time_s[mine]).all()
        order = mine[np.argsort(time_s[mine], kind="stable")] if timed and time_s is not None else mine
        rank[order], count[camera_of == k] = np.arange(len(order)), len(order)
    return rank, count


def _compared(adjustment: Adjustment, by: str, first: Flags, second: Flags) -> dict[str, Halves]:
    from scipy import stats

    from pixmetry.calibrate.bundle.bundle import adjust

    values: list[Array] = []
    own: list[Array] = []
    common: list[Array] = []
    for images in (first, second):
        network, start, kept = subset(adjustment.network, adjustment.state, images)
        part = adjust(network, start, used=adjustment.used[kept])
        mine, shared = interior_parts(part, adjustment)
        values.append(part.state.interior)
        own.append(mine)
        common.append(shared)
    away = common[0] - common[1]
    covariance = own[0] + own[1] + away @ away.T
    at, out = 0, {}
    for k, camera in enumerate(adjustment.network.cameras):
        names, _ = part.interior_covariance(k)
        rows, free = slice(at, at + len(names)), [NAMES.index(name) for name in names]
        at += len(names)
        if not names:
            continue
        difference, C = (values[0] - values[1])[k, free], covariance[rows, rows]
        u = np.sqrt(np.diag(C))
        z = difference / u
        f = float(z @ np.linalg.solve(C / np.outer(u, u), z)) / len(free)
        dof = float(np.mean(adjustment.interior_dof(k)))
        counts = tuple(int((images & (adjustment.network.camera_of == k)).sum()) for images in (first, second))
        out[camera.name] = Halves(by, counts, names, difference, u, f, dof, float(stats.f.sf(f, len(free), dof)))
    return out


def jackknife_of(adjustment: Adjustment, left: LeftOut) -> dict[str, Jackknife]:
    """Uncertainties by the parameters that were found without each fold of images, by camera."""
    out = {}
    for k, camera in enumerate(adjustment.network.cameras):
        names, covariance = adjustment.interior_covariance(k)
        if names and left.interior is not None:
            values = left.interior[:, k, [NAMES.index(name) for name in names]]
            u = np.sqrt((len(values) - 1) * np.var(values, axis=0))
            out[camera.name] = Jackknife(len(values), names, u, np.sqrt(np.diag(covariance)))
    return out


def halves_findings(found: Mapping[str, tuple[Halves, ...]]) -> list[Finding]:
    """Halves that differ by more than their uncertainties."""
    out = []
    for camera, halves in found.items():
        for one in halves:
            if one.p < RARE:
                name, ratio = one.largest
                k = one.names.index(name)
                text = (
                    f"{camera}: two halves of the images ({one.by}) differ by more than the stated uncertainties allow: {name} by "
                    f"{plain(one.difference[k], 2)} = {plain(ratio, 2)} u (p = {one.p:.2g} for all parameters)."
                )
                out.append(Finding("halves", text, ADVICE[one.by], "warning"))
    return out


def shared_words(one: SharedByCamera) -> tuple[str, list[str]]:
    """Whether image points have such errors, or may have them (the shift of oblique targets counts from a lower level on); their sizes."""
    sure = any(size > 0 and (kind != "oblique" or p < RARE) for kind, size, p in zip(one.kinds, one.rms_px, one.p, strict=True))
    parts = [f"{size:.3f} px {SHARED[kind]}" for kind, size in zip(one.kinds, one.rms_px, strict=True) if size >= 5e-4]
    return "have" if sure else "may have", parts or ["less than 0.001 px"]


def shared_findings(found: Mapping[str, SharedByCamera]) -> list[Finding]:
    """Errors that image points share, and what they did to the uncertainties."""
    from scipy import stats

    out = []
    for camera, one in found.items():
        if not one.found:
            continue
        have, parts = shared_words(one)
        text = (
            f"{camera}: image points {have} errors in common ({', '.join(parts)}; independent: {one.independent_px:.3f} px). The stated "
            "uncertainties hold them"
        )
        if one.names:
            low, high = plain(float(one.widened.min()), 2), plain(float(one.widened.max()), 2)
            dof = max(1.0, float(np.median(one.dof)))
            text += f": they are {low} to {high} times those of independent errors, with about {dof:.0f} degrees of freedom "
            text += f"(95 %: ± {stats.t.ppf(0.975, dof):.2g} u)"
        text += "."
        advice = "More points per image do not help. Remove the causes that the residuals show, or take more images from other directions."
        out.append(Finding("shared_errors", text, advice, "note"))
    return out
