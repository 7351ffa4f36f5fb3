"""Scale bars and control points before they may pull at a network: image coordinates are tested without them, then they by the network.

A wrong bar with a small stated uncertainty is stronger than the image coordinates of its ends, and data snooping would throw these out.
So gross errors in the images are looked for with bars and control points that hardly weigh; then the known observations get their
weights, and the worst is left out and the network adjusted again as long as one is contradicted (Baarda's w-test).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pixmetry.calibration.known_residuals import Known, bar_residuals, contradicted, control_residuals
from pixmetry.calibration.network import Adjustment, Network, ScaleBars
from pixmetry.calibration.snooping import Adjust
from pixmetry.calibration.variance_components import image_sigma0, scaled

LOOSE = 0.05  # uncertainty, as a part of a bar's length or of the field's extent, with which nothing pulls at the image coordinates
INSEPARABLE = 0.99  # correlation of two residuals from which on it cannot be said which of the two is wrong
LEAST_CONTROL = 4  # points that must stay for one to be left out
MOST = 20


@dataclass(frozen=True)
class CheckedKnown:
    """A network whose bars and control points it does not contradict.

    Parameters
    ----------
    network : Network
    gross : dict
        By ``scale_bars`` and ``control_points``: records as of `contradicted`, with ``left_out``; where it is False, the uncertainties of
        all bars were raised to the size of the contradiction.
    """

    network: Network
    gross: dict[str, list[dict[str, Any]]] = field(default_factory=lambda: {"scale_bars": [], "control_points": []})


def has_known(network: Network) -> bool:
    """Whether there are bars or control points with an uncertainty."""
    return len(network.bars) > 0 or bool((np.isfinite(network.u_xyz) & (network.u_xyz > 0)).any())


def loosened(network: Network) -> Network:
    """The network with bars and uncertain control points that hardly weigh."""
    bars, weighted = network.bars, np.isfinite(network.u_xyz) & (network.u_xyz > 0)
    known = network.xyz[np.isfinite(network.xyz).all(axis=1)]
    extent = float(np.ptp(known, axis=0).max()) if len(known) else 0.0
    return replace(
        network,
        bars=replace(bars, u=np.maximum(bars.u, LOOSE * bars.length)),
        u_xyz=np.where(weighted, np.maximum(network.u_xyz, LOOSE * extent), network.u_xyz),
    )


def check_known(network: Network, clean: Adjustment, adjust: Adjust) -> CheckedKnown:
    """Leave out bars and control points that the network contradicts.

    Parameters
    ----------
    network : Network
    clean : Adjustment
        Of the `loosened` network, without gross errors in the images.
    adjust : callable
        `bundle.adjust`, or the same with some options chosen; with a posteriori covariances.
    """
    sigma0, dof = image_sigma0(clean)
    weights = scaled(network, np.full((len(network.cameras), 2), sigma0**2))  # from now on sigma0 of the image coordinates is 1
    checked = CheckedKnown(weights)
    state = clean.state
    for _ in range(MOST):
        adjustment = adjust(checked.network, state, used=clean.used, redundancy=True)
        bars, control = bar_residuals(adjustment), control_residuals(adjustment)
        worst = [(k, found[0]) for k in (bars, control) if (found := contradicted(k, 1.0, dof))]
        if not worst:
            break
        known, record = max(worst, key=lambda item: item[1]["statistic"])
        checked = _without(checked, known, record, is_bar=known is bars)
        if not checked.gross["scale_bars" if known is bars else "control_points"][-1]["left_out"]:
            break
    return replace(checked, network=replace(checked.network, covariance_px2=network.covariance_px2))


def _without(checked: CheckedKnown, known: Known, record: dict[str, Any], *, is_bar: bool) -> CheckedKnown:
    network, row = checked.network, known.name.index(record["name"])
    index = int(known.index[row])
    if is_bar:
        alone = _separable(known, row)
        bars = network.bars
        kept = np.arange(len(bars)) != index
        if alone:
            bars = ScaleBars(bars.start[kept], bars.end[kept], bars.length[kept], bars.u[kept])
        else:
            bars = replace(bars, u=np.maximum(bars.u, abs(record["error"])))
        network = replace(network, bars=bars)
    else:
        weighted = np.isfinite(network.u_xyz).all(axis=1)
        alone = bool(weighted.sum() > LEAST_CONTROL)
        u = network.u_xyz.copy()
        point = index // 3
        u[point] = np.inf if alone else np.maximum(u[point], abs(record["error"]))
        network = replace(network, u_xyz=u)
    kind = "scale_bars" if is_bar else "control_points"
    gross = {**checked.gross, kind: [*checked.gross[kind], {**record, "left_out": alone}]}
    return CheckedKnown(network, gross)


def _separable(known: Known, row: int) -> bool:
    u = np.sqrt(np.maximum(np.diag(known.cofactor), 1e-300))
    others = np.delete(known.cofactor[row] / u / u[row], row)
    return bool(np.abs(others).max(initial=0.0) < INSEPARABLE)
