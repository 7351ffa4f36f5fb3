"""Parameters of each source in a budget, their origin, and the resulting uncertainty of its contribution."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.contribution import Probe
from pixmetry.camera.source import Source
from pixmetry.core.errors import InputError
from pixmetry.core.number import Estimates

# Relative standard uncertainty of a number that states none, as the typical values of data sheets: what cameras of one type differ by.
# Public sheets hardly say it. One does: read noise of 22 cameras, mean deviation 4 % of the typical value, largest 20 % above it (Lacerta
# M-GEN, user manual, 1.3.2). Two makers' full wells of one sensor (IMX183) are 3 % apart.
UNSTATED_U_REL = 0.1
UNSTATED = "the description states no uncertainty: 10 % from camera to camera, assumed"


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
    values: dict[str, float | str | int] = {e.name: e.representative for e in estimates} | dict(estimates.settings)
    for name in values:
        if name not in source.parameters.model_fields:
            raise InputError(f"{name} is no parameter of {source.id}", allowed=", ".join(source.parameters.model_fields))
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
    """Standard uncertainty of a contribution's total in px that comes of the parameters' uncertainty: see `u_from_parameters`."""
    propagate = source.propagate
    if propagate is None:
        return 0.0
    return float(u_from_parameters(lambda p: np.array([propagate(p, probe).total_px]), source, params, estimates)[0])


def u_from_parameters(values_of: Callable[[Any], np.ndarray], source: Source, params: Any, estimates: Estimates) -> np.ndarray:
    """Standard uncertainties of values that come of the uncertainty of a source's parameters.

    Parameters
    ----------
    values_of : callable
        Gives the values, an array of shape (n,), for a set of parameters.
    source : Source
    params : BaseModel
        The best estimates.
    estimates : Estimates
        With their covariance C.

    Returns
    -------
    ndarray, shape (n,), float64
        In the units of the values.

    Notes
    -----
    The parameters are moved by plus and minus each column of a root of C (C = L Lᵀ; one-sided where the model allows no other side). The
    root mean square of the two changes counts (JCGM 100:2008, 5.1.3, note 2, and 5.2.2). For a slope that is the central difference. An
    amount has none: an aberration of 0 ± u moves points by as much on either side.
    """
    here = values_of(params)
    squares = np.zeros_like(here)
    for step in _root_of(covariance_of(estimates)).T:
        ends = (_moved(source, params, estimates.names, sign * step) for sign in (1.0, -1.0) if step.any())
        changes = [values_of(p) - here for p in ends if p is not None]
        squares += np.mean(np.square(changes), axis=0) if changes else 0.0
    u: np.ndarray = np.sqrt(squares)
    return u


def _root_of(covariance: np.ndarray) -> np.ndarray:
    """A matrix L with L Lᵀ the covariance; of uncorrelated values the diagonal matrix of their uncertainties."""
    u = np.sqrt(np.diag(covariance))
    if not np.any(covariance - np.diag(u**2)):
        return np.diag(u)
    scale = np.where(u > 0, u, 1.0)
    lengths, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    root: np.ndarray = scale[:, None] * directions * np.sqrt(np.maximum(lengths, 0.0))
    return root


def _moved(source: Source, params: Any, names: Sequence[str], steps: np.ndarray) -> Any | None:
    """The parameters so far away; None where the model does not allow it."""
    own = params.model_dump()
    try:
        return source.make({**own, **{name: own[name] + step for name, step in zip(names, steps.tolist(), strict=True) if step}})
    except InputError:
        return None


def base_of(source: Source, camera: Camera, name: str) -> Any:
    """Parameters before anything is measured: the camera's, else the neutral or the usual ones."""
    if name in camera:
        return camera[name].params
    return source.typical if source.neutral is None else source.neutral


def told_values(element: Element) -> dict[str, float]:
    """The numbers of an element that its description tells: those that are neither the source's default nor what would do nothing."""
    fields, neutral = type(element.params).model_fields, element.source.neutral
    own = {name: getattr(element.params, name) for name in fields}
    return {
        name: float(value)
        for name, value in own.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
        if value != fields[name].default and getattr(neutral, name, None) != value
    }


def assumed_estimates(element: Element) -> Estimates:
    """Estimates of the numbers of a description that states no uncertainty: `UNSTATED_U_REL` of each."""
    units = element.source.units
    rows = [(name, value, UNSTATED_U_REL * abs(value), math.inf, units[name]) for name, value in told_values(element).items()]
    return Estimates.from_rows(rows, method=UNSTATED)
