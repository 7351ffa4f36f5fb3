"""Quality of an adjustment: significance, correlations, residuals by axis and camera, and by image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.model import NAMES, CameraModel
from pixmetry.calibrate.bundle.network import PER_IMAGE_NAMES, Adjustment
from pixmetry.calibrate.records import (
    CameraResiduals,
    Correlations,
    FTest,
    GroupTest,
    ImageRecord,
    ParameterTest,
    PoseCorrelation,
    SharedByCamera,
    Strongest,
    Vision,
)
from pixmetry.core.arrays import Array

GROUPS = {
    "radial": ("k1", "k2", "k3", "k4", "k5", "d1", "d2", "d3"),
    "tangential": ("p1", "p2"),
    "affinity": ("b1", "b2"),
    "thin prism": ("s1", "s2", "s3", "s4"),
}
TESTED = tuple(name for names in GROUPS.values() for name in names)  # 0 means something for these, not for c, xp and yp
SIGNIFICANT = 0.05
POSE = ("rx", "ry", "rz", "X0", "Y0", "Z0", *PER_IMAGE_NAMES)


def parameter_records(adjustment: Adjustment) -> tuple[ParameterTest, ...]:
    """Every estimated interior parameter with its uncertainty."""
    from scipy import stats

    out = []
    for k, camera in enumerate(adjustment.network.cameras):
        names, covariance = adjustment.interior_covariance(k)
        matrix, dof = correlation_of(covariance), adjustment.interior_dof(k)
        for i, name in enumerate(names):
            place = NAMES.index(name)
            value, u = float(adjustment.state.interior[k, place]), float(np.sqrt(covariance[i, i]))
            p_zero = float(2 * stats.t.sf(abs(value) / u, dof[i])) if name in TESTED and u > 0 and dof[i] > 0 else None
            others = np.where(np.arange(len(names)) == i, 0.0, np.abs(matrix[i]))
            best = int(np.argmax(others))
            strongest = Strongest(names[best], float(matrix[i, best])) if len(names) > 1 else None
            out.append(ParameterTest(camera.name, name, value, u, camera.units[place], p_zero, strongest))
    return tuple(out)


def group_records(adjustment: Adjustment) -> tuple[GroupTest, ...]:
    """Joint F-tests against 0 of parameters that can replace each other, such as the radial ones."""
    from scipy import stats

    out = []
    for k, camera in enumerate(adjustment.network.cameras):
        names, covariance = adjustment.interior_covariance(k)
        for group, members in GROUPS.items():
            rows = [i for i, name in enumerate(names) if name in members]
            if not rows or adjustment.dof < 1:
                continue
            values = adjustment.state.interior[k, [NAMES.index(names[i]) for i in rows]]
            u = np.sqrt(np.diag(covariance)[rows])
            z = values / u
            f = float(z @ np.linalg.solve(covariance[np.ix_(rows, rows)] / np.outer(u, u), z)) / len(rows)
            dof = (len(rows), round(float(np.mean(adjustment.interior_dof(k)[rows]))))
            out.append(GroupTest(camera.name, group, tuple(names[i] for i in rows), f, dof, float(stats.f.sf(f, *dof))))
    return tuple(out)


def correlation_of(covariance: Array) -> Array:
    """Correlations of a covariance; 0 with what has no variance."""
    u = np.sqrt(np.diag(covariance))
    u = np.where(u > 0, u, np.inf)
    correlation: Array = np.clip(covariance / np.outer(u, u), -1.0, 1.0)
    return correlation


def correlation_records(adjustment: Adjustment) -> dict[str, Correlations]:
    """Correlations of the interior parameters, by camera."""
    out = {}
    for k, camera in enumerate(adjustment.network.cameras):
        names, covariance = adjustment.interior_covariance(k)
        out[camera.name] = Correlations(names, correlation_of(covariance))
    return out


def pose_correlations(adjustment: Adjustment, most: int = 20) -> tuple[PoseCorrelation, ...]:
    """Strongest correlations of interior parameters with poses, strongest first.

    Of each interior parameter and each kind of pose parameter (such as c with Z0) only the image where it is strongest.
    """
    cameras = {camera.name for camera in adjustment.network.cameras}
    images = set(adjustment.network.images)
    tails = [name.rpartition(":") for name in adjustment.free_columns]
    inner = [i for i, (camera, _, kind) in enumerate(tails) if camera in cameras and kind in NAMES]
    poses = [i for i, (image, _, kind) in enumerate(tails) if image in images and kind in POSE]
    u = np.sqrt(np.diag(adjustment.covariance))
    strongest: dict[tuple[int, str], tuple[float, int]] = {}
    if poses and inner:
        with np.errstate(invalid="ignore", divide="ignore"):
            block = np.nan_to_num(adjustment.covariance[np.ix_(inner, poses)] / np.outer(u[inner], u[poses]))
        kinds = np.array([tails[i][2] for i in poses])
        for row, i in enumerate(inner):
            for kind in np.unique(kinds):
                places = np.flatnonzero(kinds == kind)
                best = places[np.argmax(np.abs(block[row, places]))]
                strongest[i, str(kind)] = (float(np.clip(block[row, best], -1, 1)), poses[best])
    ranked = sorted(strongest.items(), key=lambda item: -abs(item[1][0]))[:most]
    return tuple(PoseCorrelation(adjustment.free_columns[i], adjustment.free_columns[j], r) for (i, _), (r, j) in ranked)


def shared_records(adjustment: Adjustment) -> dict[str, SharedByCamera] | None:
    """Errors that image points share, by camera; None where they were not looked for."""
    shared, network, out = adjustment.shared, adjustment.network, {}
    if shared is None:
        return None
    for k, camera in enumerate(network.cameras):
        alone = {kind for kind, of in shared.kinds if of == k}
        own = [i for i, (kind, of) in enumerate(shared.kinds) if of == k or (of == -1 and kind not in alone)]
        rows = adjustment.used & (network.camera_of[network.image] == k)
        if not own or not rows.any():
            continue
        names, covariance = adjustment.interior_covariance(k)
        independent = float(adjustment.sigma0 * np.sqrt(shared.white_variance * np.mean(network.covariance_px2[rows][:, [0, 2]])))
        out[camera.name] = SharedByCamera(
            tuple(shared.kinds[i][0] for i in own), shared.rms_px[own], shared.p[own], independent, shared.found, names,
            np.sqrt(np.diag(covariance)), adjustment.interior_u_independent(k), adjustment.interior_dof(k),
        )  # fmt: skip
    return out


def vision_records(adjustment: Adjustment) -> dict[str, Vision]:
    """Focal lengths fx, fy, skew and principal point cx, cy, px, with their uncertainties, by camera.

    x = fx X/Z + skew Y/Z + cx, y = fy Y/Z + cy: exactly the linear part of a distortion from object to image; of one from image to object
    it is the slope at the principal point, c/(1 + b1), c and −c b2/(1 + b1) in pixels.
    """
    out = {}
    for k in range(len(adjustment.network.cameras)):
        camera = adjustment.camera(k)
        values, covariance = propagated(adjustment, k, _vision)
        out[camera.name] = Vision(*values.tolist(), *np.sqrt(np.diag(covariance)).tolist())
    return out


def _vision(camera: CameraModel) -> np.ndarray:
    cx, cy = camera.c_px
    b1, b2 = camera["b1"], camera["b2"]
    fx, skew = (cx * (1 + b1), cx * b2) if camera.direction == "object_to_image" else (cx / (1 + b1), -cx * b2 / (1 + b1))
    return np.array([fx, cy, skew, camera["xp"], camera["yp"]])


def propagated(adjustment: Adjustment, index: int, function: Callable[[CameraModel], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Value and covariance of a function of a camera's parameters, by difference quotients over a tenth of their uncertainties."""
    camera = adjustment.camera(index)
    names, covariance = adjustment.interior_covariance(index)
    value = function(camera)
    slopes = np.zeros((len(value), len(names)))
    for i, name in enumerate(names):
        step = 0.1 * np.sqrt(covariance[i, i])
        if step > 0:
            above, below = (camera.with_values(**{name: camera[name] + sign * step}) for sign in (1, -1))
            slopes[:, i] = (function(above) - function(below)) / (2 * step)
    return value, slopes @ covariance @ slopes.T


def redundancy_of(adjustment: Adjustment) -> np.ndarray:
    """Redundancy numbers of x and y, shape (n, 2); 0 for what took no part. Without them, the mean one of the adjustment."""
    if adjustment.redundancy is not None:
        return np.where(adjustment.used[:, None], np.nan_to_num(adjustment.redundancy), 0.0)
    return np.where(adjustment.used[:, None], adjustment.dof / (2 * adjustment.used.sum()), 0.0) * np.ones((1, 2))


def residual_records(adjustment: Adjustment) -> dict[str, CameraResiduals]:
    """Number, rms and degrees of freedom of the residuals, by camera."""
    network, out = adjustment.network, {}
    redundancy = redundancy_of(adjustment)
    for k, camera in enumerate(network.cameras):
        rows = adjustment.used & (network.camera_of[network.image] == k)
        rms = np.sqrt(np.mean(adjustment.residual_px[rows] ** 2, axis=0)) if rows.any() else np.full(2, np.nan)
        dof = redundancy[rows].sum(axis=0)
        um = (rms * 1000 * np.array(camera.sensor.per_px)).tolist() if camera.sensor.pitch_x_um is not None else (None, None)
        found = CameraResiduals(int(rows.sum()), float(rms[0]), float(rms[1]), um[0], um[1], float(dof[0]), float(dof[1]))
        if rows.any():
            variance = network.covariance_px2[rows][:, [0, 2]]
            typical = np.sqrt(np.mean(adjustment.residual_px[rows] ** 2 / variance, axis=0) * np.median(variance, axis=0)).tolist()
            found = replace(found, typical_x_px=typical[0], typical_y_px=typical[1])
        out[camera.name] = found
    return out


def p_words(p: float) -> str:
    """A probability for a sentence: below a millionth only a bound, for no test is exact so far out."""
    return "p < 1e-6" if p < 1e-6 else f"p = {p:.2g}"


def plain(value: float, digits: int) -> str:
    """A number rounded to some digits for a sentence, without a power of ten below a million: 2300 px, not 2.3e+03 px."""
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:.0f}" if 10.0**digits <= abs(rounded) < 1e6 else f"{value:.{digits}g}"


def p_fall(before: np.ndarray, after: np.ndarray, image: np.ndarray) -> float:
    """How often chance alone lets residuals fall so much: one-sided t-test on the logarithms of the images' mean squares, paired.

    Parameters
    ----------
    before, after : ndarray, shape (n, 2)
    image : ndarray of int, shape (n,)
    """
    from scipy import stats

    sums = [np.bincount(image, np.sum(part**2, axis=1)) for part in (before, after)]
    present = sums[0] > 0
    return float(stats.ttest_1samp(np.log(sums[1][present] / sums[0][present]), 0.0, alternative="less").pvalue)


def f_test(variance_x: float, variance_y: float, dof_x: float, dof_y: float) -> tuple[float, float, float]:
    """One-sided F-test whether x is noisier than y.

    Returns
    -------
    ratio, critical, p : float
        Of the variances; the ratio that chance exceeds in 5 %; how often chance exceeds the one found.
    """
    from scipy import stats

    ratio = variance_x / variance_y
    return float(ratio), float(stats.f.isf(0.05, dof_x, dof_y)), float(stats.f.sf(ratio, dof_x, dof_y))


def f_test_records(adjustment: Adjustment, dof: dict[str, tuple[float, float]] | None = None) -> dict[str, FTest]:
    """F-test of the noise of x against that of y, by camera; none of a camera without redundancy.

    Jitter of lines can only enlarge x, so the test is one-sided. It depends on the unit if pixels are not square: both are given. The
    variances are Σ v² / Σ r; where a priori variances s differ from point to point, their degrees of freedom are (Σ r s)² / Σ r s²
    (Welch, Satterthwaite).

    Parameters
    ----------
    adjustment : Adjustment
    dof : mapping, optional
        Degrees of freedom of x and y by camera name, where errors are common to many points, as to those of one line.
    """
    network, out = adjustment.network, {}
    redundancy = redundancy_of(adjustment)
    for k, camera in enumerate(network.cameras):
        rows = adjustment.used & (network.camera_of[network.image] == k)
        r, a_priori = redundancy[rows], network.covariance_px2[rows][:, [0, 2]]
        if not (r.sum(axis=0) > 1).all():
            continue
        variance = np.sum(adjustment.residual_px[rows] ** 2, axis=0) / r.sum(axis=0)
        from_points = (r * a_priori).sum(axis=0) ** 2 / (r * a_priori**2).sum(axis=0)
        dof_x, dof_y = (dof or {}).get(camera.name, from_points)
        ratio, critical, p = f_test(variance[0], variance[1], dof_x, dof_y)
        ratio_um2 = p_um = None
        if camera.sensor.pitch_x_um is not None:
            um2 = variance * (1000 * np.array(camera.sensor.per_px)) ** 2
            ratio_um2, _, p_um = f_test(um2[0], um2[1], dof_x, dof_y)
        found = FTest(ratio, p, ratio_um2, p_um, float(dof_x), float(dof_y), critical, "x noisier than y", "")
        out[camera.name] = replace(found, text=_f_text(found))
    return out


def _f_text(found: FTest) -> str:
    text = f"variance of x over that of y: {found.ratio_px2:.3f} in px² ({p_words(found.p_px)})"
    if found.ratio_um2 is not None and found.p_um is not None:
        text += f", {found.ratio_um2:.3f} in µm² ({p_words(found.p_um)})"
    dof = f"{found.dof_x:.0f} and {found.dof_y:.0f} degrees of freedom"
    verdict = "x is noisier than y" if found.p_px < SIGNIFICANT else "x is not significantly noisier than y"
    if found.p_px > 1 - SIGNIFICANT:
        verdict = "y is noisier than x"
    return f"{text}; one-sided, {dof}, critical at 95 %: {found.critical_95:.3f}; in px, {verdict}"


def image_records(adjustment: Adjustment, rejected: Mapping[str, int] | None = None) -> tuple[ImageRecord, ...]:
    """One record an image.

    Parameters
    ----------
    adjustment : Adjustment
    rejected : mapping, optional
        How many image points of an image were rejected, by its name; by default all that were not used.
    """
    network, state = adjustment.network, adjustment.state
    places = {name: i for i, name in enumerate(adjustment.free_columns)}
    out = []
    for i, name in enumerate(network.images):
        mine = network.image == i
        used, oriented = mine & adjustment.used, bool(np.isfinite(state.position[i]).all())
        out_of_it = int((mine & ~used).sum()) if rejected is None else rejected.get(name, 0)
        rms = np.sqrt(np.mean(adjustment.residual_px[used] ** 2, axis=0)).tolist() if used.any() else (None, None)
        own: list[float | None] = []
        for kind, value in (("x_scale", state.x_scale[i]), ("x_shift", state.x_shift_px[i])):
            place = places.get(f"{name}:{kind}")
            own += (None, None) if place is None else (float(value), float(np.sqrt(max(adjustment.covariance[place, place], 0.0))))
        time_s, camera = None if network.time_s is None else float(network.time_s[i]), network.cameras[network.camera_of[i]].name
        out_of_it = out_of_it if oriented else 0
        out.append(ImageRecord(name, camera, oriented, int(used.sum()), out_of_it, int(mine.sum()), rms[0], rms[1], time_s, *own))
    return tuple(out)
