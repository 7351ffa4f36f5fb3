"""Plain records of an adjustment that stands: what report, files and findings are made of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.checks.known_checks import fixed_record
from pixmetry.calibrate.checks.known_residuals import bar_residuals, control_residuals, group_record
from pixmetry.calibrate.checks.snooping import Rejected
from pixmetry.calibrate.geometry import systematic_rest

SWAPPED = 0.1  # of the distance of two points: as near to the other's place, their names are exchanged


def all_records(
    adjustment: Adjustment,
    alpha: float,
    gross_known: Mapping[str, list[dict[str, Any]]],
    rejected: Rejected | None = None,
    *,
    a_priori: bool = False,
) -> dict[str, Any]:
    """The records that follow from one adjustment alone (with redundancy numbers and covariance).

    Parameters
    ----------
    adjustment : Adjustment
    alpha : float
        Level at which image points were tested for gross errors.
    gross_known : mapping
        Bars and control points that were contradicted.
    rejected : Rejected, optional
        Why image points were rejected.
    a_priori : bool
        Whether the covariances of the adjustment are without sigma0².
    """
    from pixmetry.calibrate.bundle.bundle import adjust
    from pixmetry.calibrate.checks import curves, quality
    from pixmetry.calibrate.checks.patterns import patterns_without_bad_images
    from pixmetry.calibrate.checks.snooping import gross_error_records

    oriented = dict(zip(adjustment.network.images, np.isfinite(adjustment.state.position).all(axis=1), strict=True))
    gross = [record for record in gross_error_records(adjustment, alpha, rejected) if oriented[record["image"]]]
    return {
        "parameters": quality.parameter_records(adjustment),
        "parameter_groups": quality.group_records(adjustment),
        "vision": quality.vision_records(adjustment),
        "correlations": quality.correlation_records(adjustment),
        "correlations_with_poses": quality.pose_correlations(adjustment),
        "residuals": quality.residual_records(adjustment),
        "f_test": quality.f_test_records(adjustment),
        "gross_errors": gross,
        "patterns": patterns_without_bad_images(adjustment, adjust),
        "images": quality.image_records(adjustment, Counter(record["image"] for record in gross)),
        "curves": curves.distortion_curves(adjustment),
        "projection": curves.projection_maps(adjustment),
        "network": network_record(adjustment, _stated(gross_known, "scale_bars"), a_priori=a_priori),
        "known": {
            **known_record(adjustment, gross_known, a_priori=a_priori),
            "fixed_points": fixed_record(adjustment, adjust),
        },
    }


def add_noise(residuals: dict[str, dict[str, Any]], adjustment: Adjustment, given: Network) -> None:
    """Add ``noise_x_px``, ``noise_y_px``: rms of residuals by the covariance given alone, √(Σ r s² / n), None where it was a guess;
    and ``systematic_x_px``, ``systematic_y_px``: see `geometry.systematic_rest`."""
    for k, camera in enumerate(given.cameras):
        rows = adjustment.used & (given.camera_of[given.image] == k)
        noise: list[float | None] = [None, None]
        if given.covariance_known and rows.any():
            noise = np.sqrt(np.mean(adjustment.redundancy[rows] * given.covariance_px2[rows][:, [0, 2]], axis=0)).tolist()
        rest = systematic_rest(adjustment, k)
        residuals[camera.name] |= {"noise_x_px": noise[0], "noise_y_px": noise[1], "systematic_x_px": rest[0], "systematic_y_px": rest[1]}


def sizes(adjustment: Adjustment) -> dict[str, int]:
    """What took part, and what was given: ``images`` (oriented), ``points`` (determined, with image points used), ``observations`` (image
    points used); ``images_given``, ``points_given``, ``observations_given`` (all that was measured)."""
    network, state = adjustment.network, adjustment.state
    posed = np.isfinite(state.position).all(axis=1)
    seen = np.unique(network.point[adjustment.used])
    return {
        "images": int(posed[np.unique(network.image)].sum()),
        "points": int(np.isfinite(state.xyz[seen]).all(axis=1).sum()),
        "observations": int(adjustment.used.sum()),
        "images_given": len(np.unique(network.image)),
        "points_given": len(np.unique(network.point)),
        "observations_given": len(network),
    }


def network_record(adjustment: Adjustment, stated: Mapping[str, float] | None = None, *, a_priori: bool = False) -> dict[str, Any]:
    """The `sizes` of the network, ``redundancy``, ``rays_per_point`` (mean, with ``rays_least`` and ``rays_most``), ``datum``, ``unit``,
    ``sigma0``, ``scale_bars`` (with the uncertainty ``stated``, where it was raised)."""
    network, used = adjustment.network, adjustment.used
    rays = np.bincount(network.point[used], minlength=len(network.points))
    rays = rays[rays > 0]
    bars = bar_residuals(adjustment, a_priori=a_priori)
    return {
        **sizes(adjustment),
        "redundancy": adjustment.dof,
        "sigma0": adjustment.sigma0,
        "rays_per_point": float(rays.mean()),
        "rays_least": int(rays.min()),
        "rays_most": int(rays.max()),
        "datum": adjustment.datum,
        "unit": network.unit,
        "scale_bars": [
            {
                "name": bars.name[i],
                "length": float(bars.value[i]),
                "u": (stated or {}).get(bars.name[i], float(bars.u[i])),
                "residual": float(bars.residual[i]),
                "redundancy": float(bars.redundancy[i]),
            }
            for i in range(len(bars))
        ],
    }


def known_record(adjustment: Adjustment, gross: Mapping[str, list[dict[str, Any]]], *, a_priori: bool = False) -> dict[str, Any]:
    """Bars and weighted control points against the network: for each ``group`` (variance factor, None without redundancy), ``gross`` and
    ``raised`` (stated uncertainties, by name, of those that weigh less now); of control points also ``understated``: by how much their
    uncertainties were raised, or None. ``untested``: why nothing of this could be tested, or None."""
    groups = {"scale_bars": bar_residuals, "control_points": control_residuals}
    known = {name: residuals(adjustment, a_priori=a_priori) for name, residuals in groups.items()}
    record: dict[str, Any] = {
        name: {"group": group_record(adjustment, known[name]), "gross": _last(gross[name], adjustment), "raised": _stated(gross, name)}
        for name in groups
    }
    control = record["control_points"]
    control["gross"] = [_found(adjustment, one) for one in control["gross"]]
    control["understated"] = next((r["factor"] for r in gross.get("understated", ())), None)
    record["untested"] = next((r["why"] for r in gross.get("untested", ())), None)
    return record


def _stated(gross: Mapping[str, list[dict[str, Any]]], kind: str) -> dict[str, float]:
    """Uncertainties, as they were stated, of what weighs less now."""
    return {r["name"]: r["u"] for r in reversed(gross.get("raised", ())) if r["kind"] == kind}


def _last(records: list[dict[str, Any]], adjustment: Adjustment) -> list[dict[str, Any]]:
    """Records without those of what weighed less first and was left out later."""
    network, out = adjustment.network, []
    left = {f"{network.points[k]} {'XYZ'[axis]}" for k, axis in np.argwhere(np.isinf(network.u_xyz))}
    for i, record in enumerate(records):
        later = {one["name"] for one in records[i + 1 :] if one["left_out"]}
        if record["left_out"] or record["name"] not in left | later:
            out.append(record)
    return out


def _found(adjustment: Adjustment, record: dict[str, Any]) -> dict[str, Any]:
    """The record of a control point that was left out, with its error against where it was found without it, along the axis of those left
    out where it is largest, and ``swapped_with``."""
    record = dict(record)
    axes = record.pop("axes", None)
    network, xyz = adjustment.network, adjustment.state.xyz
    names = {name: k for k, name in enumerate(network.points)}
    name, _, axis = record["name"].rpartition(" ")
    k = names.get(record["name"], names.get(name))
    if k is None or not record["left_out"] or not np.isfinite(xyz[k]).all():
        return {**record, "swapped_with": None}
    swapped, off = _swapped_with(adjustment, k), (network.xyz - xyz)[k]
    if record["name"] in names:
        return {**record, "swapped_with": swapped}
    worst = max(axes or ["XYZ".index(axis)], key=lambda axis: abs(off[axis]))
    return {**record, "name": f"{name} {'XYZ'[worst]}", "error": float(off[worst]), "swapped_with": swapped}


def _swapped_with(adjustment: Adjustment, k: int) -> str | None:
    """The other control point with which one has exchanged its place: each was found where the other was said to be."""
    given, found = adjustment.network.xyz, adjustment.state.xyz
    near = SWAPPED * np.linalg.norm(given - given[k], axis=1)
    with np.errstate(invalid="ignore"):
        there = (np.linalg.norm(given - found[k], axis=1) < near) & (np.linalg.norm(found - given[k], axis=1) < near)
    return adjustment.network.points[int(np.argmax(there))] if there.any() else None
