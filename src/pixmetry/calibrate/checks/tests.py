"""All tests of an accepted adjustment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from pixmetry.calibrate.bundle.network import Adjustment, Network
from pixmetry.calibrate.checks import curves, quality
from pixmetry.calibrate.checks.known_checks import Kind, KnownFaults, fixed_record
from pixmetry.calibrate.checks.known_residuals import bar_residuals, control_residuals, group_record
from pixmetry.calibrate.checks.patterns import searched_without_bad_images
from pixmetry.calibrate.checks.residual_grid import systematic_rest
from pixmetry.calibrate.checks.rig_check import rig_record
from pixmetry.calibrate.checks.snooping import Rejected, gross_error_records
from pixmetry.calibrate.records import (
    BarRecord,
    CameraResiduals,
    Contradicted,
    ContradictedControl,
    KnownBars,
    KnownControl,
    KnownRecord,
    NetworkRecord,
    Sizes,
    Tests,
)

SWAPPED = 0.1  # of the distance of two points: as near to the other's place, their names are exchanged


def tests_of(
    adjustment: Adjustment,
    given: Network,
    alpha: float,
    faults: KnownFaults,
    rejected: Rejected | None = None,
    *,
    stated: Adjustment | None = None,
    a_priori: bool = False,
    patterns: bool = True,
) -> Tests:
    """The tests that follow from one adjustment alone (with redundancy numbers and covariance).

    Parameters
    ----------
    adjustment : Adjustment
    given : Network
        As it was before it was weighted.
    alpha : float
        Level at which image points were tested for gross errors.
    faults : KnownFaults
        Bars and control points that were contradicted.
    rejected : Rejected, optional
        Why image points were rejected.
    stated : Adjustment, optional
        The same with the uncertainties that are stated, where these hold more than independent errors.
    a_priori : bool
        Whether the covariances of the adjustment are without sigma0².
    patterns : bool
        Search the residuals for patterns.
    """
    from pixmetry.calibrate.bundle.bundle import adjust

    stated = stated or adjustment
    oriented = dict(zip(adjustment.network.images, adjustment.state.posed, strict=True))
    gross = tuple(error for error in gross_error_records(adjustment, alpha, rejected) if oriented[error.image])
    searched = searched_without_bad_images(adjustment, adjust) if patterns else None
    return Tests(
        parameters=quality.parameter_records(stated),
        parameter_groups=quality.group_records(stated),
        vision=quality.vision_records(stated),
        correlations=quality.correlation_records(stated),
        correlations_with_poses=quality.pose_correlations(stated),
        residuals=_with_noise(quality.residual_records(adjustment), adjustment, given),
        f_test=quality.f_test_records(adjustment),
        gross_errors=gross,
        patterns=None if searched is None else searched.patterns,
        field_sources=None if searched is None else searched.sources or None,
        images=quality.image_records(stated, Counter(error.image for error in gross)),
        curves=curves.distortion_curves(stated),
        projection=curves.projection_maps(stated),
        shared_errors=quality.shared_records(stated),
        network=network_record(adjustment, _stated(faults, "scale_bars"), a_priori=a_priori),
        rig=rig_record(stated),
        known=replace(known_record(adjustment, faults, a_priori=a_priori), fixed_points=fixed_record(adjustment, adjust)),
    )


def _with_noise(residuals: Mapping[str, CameraResiduals], adjustment: Adjustment, given: Network) -> dict[str, CameraResiduals]:
    """The records with what the covariance given alone would leave, and with what is left over besides."""
    out = {}
    for k, camera in enumerate(given.cameras):
        rows = adjustment.used & (given.camera_of[given.image] == k)
        noise: list[float | None] = [None, None]
        if given.covariance_known and rows.any():
            noise = np.sqrt(np.mean(adjustment.redundancy_numbers[rows] * given.covariance_px2[rows][:, [0, 2]], axis=0)).tolist()
        rest = systematic_rest(adjustment, k)
        out[camera.name] = replace(
            residuals[camera.name], noise_x_px=noise[0], noise_y_px=noise[1], systematic_x_px=rest[0], systematic_y_px=rest[1]
        )
    return out


def sizes(adjustment: Adjustment) -> Sizes:
    """What took part, and what was given."""
    network, state = adjustment.network, adjustment.state
    posed = state.posed
    seen = np.unique(network.point[adjustment.used])
    return Sizes(
        images=int(posed[np.unique(network.image)].sum()),
        points=int(state.located[seen].sum()),
        observations=int(adjustment.used.sum()),
        images_given=len(np.unique(network.image)),
        points_given=len(np.unique(network.point)),
        observations_given=len(network),
    )


def network_record(adjustment: Adjustment, stated: Mapping[str, float] | None = None, *, a_priori: bool = False) -> NetworkRecord:
    """Size and redundancy of the network, and its scale bars; ``stated``: their uncertainties, by name, if these were raised."""
    network, used = adjustment.network, adjustment.used
    rays = np.bincount(network.point[used], minlength=len(network.points))
    rays = rays[rays > 0]
    bars = bar_residuals(adjustment, a_priori=a_priori)
    u = [(stated or {}).get(name, float(u)) for name, u in zip(bars.name, bars.u, strict=True)]
    columns = (bars.name, bars.value.tolist(), u, bars.residual.tolist(), bars.redundancy.tolist())
    return NetworkRecord(
        sizes(adjustment),
        adjustment.dof,
        adjustment.sigma0,
        float(rays.mean()),
        int(rays.min()),
        int(rays.max()),
        adjustment.datum,
        network.unit,
        tuple(BarRecord(*row) for row in zip(*columns, strict=True)),
    )


def known_record(adjustment: Adjustment, faults: KnownFaults, *, a_priori: bool = False) -> KnownRecord:
    """Bars and weighted control points against the network."""
    bars, control = bar_residuals(adjustment, a_priori=a_priori), control_residuals(adjustment, a_priori=a_priori)
    gross = tuple(_found(adjustment, one) for one in _last(faults.control_points, adjustment))
    group, raised = group_record(adjustment, control), _stated(faults, "control_points")
    return KnownRecord(
        KnownBars(group_record(adjustment, bars), tuple(_last(faults.scale_bars, adjustment)), _stated(faults, "scale_bars")),
        KnownControl(group, gross, raised, faults.understated),
        faults.untested,
    )


def _stated(faults: KnownFaults, kind: Kind) -> dict[str, float]:
    """Uncertainties, as they were stated, of what weighs less now."""
    return {one.name: one.u for one in reversed(faults.raised) if one.kind == kind}


def _last(found: Iterable[Contradicted], adjustment: Adjustment) -> list[Contradicted]:
    """Those contradicted without those of what weighed less first and was left out later."""
    network, out, every = adjustment.network, [], tuple(found)
    left = {f"{network.points[k]} {'XYZ'[axis]}" for k, axis in np.argwhere(np.isinf(network.u_xyz))}
    for i, one in enumerate(every):
        later = {other.name for other in every[i + 1 :] if other.left_out}
        if one.left_out or one.name not in left | later:
            out.append(one)
    return out


def _found(adjustment: Adjustment, one: Contradicted) -> ContradictedControl:
    """A control point that was left out, with its error against where it was found without it, along the axis of those left out where it
    is largest, and with the one that it was swapped with."""
    network, xyz = adjustment.network, adjustment.state.xyz
    found = ContradictedControl(one.name, one.residual, one.error, one.statistic, one.critical, one.left_out, one.rivals)
    names = {name: k for k, name in enumerate(network.points)}
    name, _, axis = one.name.rpartition(" ")
    k = names.get(one.name, names.get(name))
    if k is None or not one.left_out or not np.isfinite(xyz[k]).all():
        return found
    swapped, off = _swapped_with(adjustment, k), (network.xyz - xyz)[k]
    if one.name in names:
        return replace(found, swapped_with=swapped)
    worst = max(one.axes or ("XYZ".index(axis),), key=lambda axis: abs(off[axis]))
    return replace(found, name=f"{name} {'XYZ'[worst]}", error=float(off[worst]), swapped_with=swapped)


def _swapped_with(adjustment: Adjustment, k: int) -> str | None:
    """The other control point with which one has exchanged its place: each was found where the other was said to be."""
    given, found = adjustment.network.xyz, adjustment.state.xyz
    near = SWAPPED * np.linalg.norm(given - given[k], axis=1)
    with np.errstate(invalid="ignore"):
        there = (np.linalg.norm(given - found[k], axis=1) < near) & (np.linalg.norm(found - given[k], axis=1) < near)
    return adjustment.network.points[int(np.argmax(there))] if there.any() else None
