"""Parameters of each source in a budget, their origin, and the resulting uncertainty of its contribution."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera
from pixmetry.camera.contribution import Probe
from pixmetry.camera.source import Source
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates


def applies(source: Source, facts: Mapping[str, Any]) -> bool:
    """Whether a camera of this interface (digital, analogue) and sensor (ccd, cmos, cid) can have the source; unknown counts as yes."""
    for kinds, fact in ((("digital", "analogue"), "interface"), (("ccd", "cmos", "cid"), "sensor")):
        wanted = [k for k in source.applies_to if k in kinds]
        told = str(facts.get(fact, "")).lower()
        if wanted and told in kinds and told not in wanted:
            return False
    return True


def with_estimates(source: Source, base: Any, estimates: Estimates) -> Any:
    """Put measured values in place of the base's parameters.

    A quantity of which only an upper limit L is known may be anywhere from 0 to L: it enters with the root mean square of that rectangular
    distribution, L/√3.
    """
    values = {}
    for e in estimates:
        if e.name not in source.parameters.model_fields:
            raise InputError(f"{e.name} is no parameter of {source.id}", allowed=", ".join(source.parameters.model_fields))
        values[e.name] = e.representative
    return source.make({**base.model_dump(), **values}, where=source.id)


def covariance_of(estimates: Estimates) -> np.ndarray:
    """Covariance of the values that enter; of a limit L the variance L²/12 of the rectangular distribution, uncorrelated."""
    covariance = np.array(estimates.covariance, float)
    for i, e in enumerate(estimates):
        if e.kind == "upper_limit":
            covariance[i], covariance[:, i] = 0.0, 0.0
            covariance[i, i] = e.value**2 / 12
    return covariance


def u_of_total(source: Source, params: Any, estimates: Estimates, probe: Probe) -> float:
    """Standard uncertainty of a contribution's total in px that comes of the parameters' uncertainty.

    First-order propagation (JCGM 100:2008, 5.2.2) with derivatives by central differences over ± u, one-sided where the
    model allows no other side.
    """
    if source.propagate is None:
        return 0.0
    covariance = covariance_of(estimates)
    slopes = np.zeros(len(estimates))
    for i, name in enumerate(estimates.names):
        step = float(np.sqrt(covariance[i, i]))
        if step == 0:
            continue
        here = getattr(params, name)
        ends = [_moved(source, params, name, here + s * step) for s in (-1, 1)]
        totals = [source.propagate(p, probe).total_px for p in ends]
        span = getattr(ends[1], name) - getattr(ends[0], name)
        slopes[i] = (totals[1] - totals[0]) / span if span else 0.0
    return float(np.sqrt(max(slopes @ covariance @ slopes, 0.0)))


def _moved(source: Source, params: Any, name: str, value: float) -> Any:
    try:
        return source.make({**params.model_dump(), name: value})
    except InputError:
        return params


def base_of(source: Source, camera: Camera, name: str) -> Any:
    """Parameters before anything is measured: the camera's, else the neutral or the usual ones."""
    if name in camera:
        return camera[name].params
    return source.typical if source.neutral is None else source.neutral
