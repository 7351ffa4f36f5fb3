"""Delays of the rows that were measured in pixels, in ns, and what one time base adds to another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates

NOT_SIGNIFICANT = 3.0
# What a delay moves a row by, over the delay: 1 behind a low-pass that leaves nothing at the pixel clock, else 1 ± 2 |H(pixel clock)| by
# the phase of the sampling. 0.91 to 1.09 behind a Butterworth filter of third order at 5 MHz (pixel clock 14.2 MHz), 1.26 behind an
# amplifier of 8 MHz alone. Slanted edges tell it with the rest of the line.
GAIN_REL = 0.03  # behind a filter that was made for the pixel clock
UNKNOWN_GAIN_REL = 0.1  # of a line that nobody told


def delays_ns(
    found: Estimates, names: Mapping[str, str], clock_mhz: float | None, *, where: str, gain: tuple[float, float] = (1.0, GAIN_REL)
) -> Estimates:
    """Shifts of rows as delays.

    Parameters
    ----------
    found : Estimates
        ``<name>_px`` in px; others as they are.
    names : mapping
        From ``<name>`` to the name in ns, or from another name to its new one.
    clock_mhz : float or None
        Of the samples that are stored.
    where : str
        Id of the source.
    gain : (float, float)
        By how much a row moves over its delay, and its u: a line that is not free of the pixel clock moves by more or less.

    Returns
    -------
    Estimates
        With the u of the gain in common to all delays.

    Raises
    ------
    MeasureError
        Without a clock.
    """
    if clock_mhz is None:
        remedy = "add pixel_clock_mhz under camera; of a grabber with a clock of its own sampling_clock_mhz too"
        raise MeasureError("shifts of rows were measured in px; a delay needs the clock", where=where, remedy=remedy)
    old = [f"{name}_px" if f"{name}_px" in found else name for name in names]
    new = dict(zip(old, names.values(), strict=True))
    scale = np.array([1e3 / clock_mhz / gain[0] if unit == "px" else 1.0 for unit in found.units])
    covariance = found.covariance * np.outer(scale, scale)
    delays = np.array(
        [
            value if unit == "px" and name not in found.limits else 0.0
            for name, value, unit in zip(found.names, found.values * scale, found.units, strict=True)
        ]
    )
    renamed = tuple(new.get(name, name) for name in found.names)
    return replace(
        found,
        names=renamed,
        values=found.values * scale,
        covariance=covariance + (gain[1] / gain[0]) ** 2 * np.outer(delays, delays),
        units=tuple("ns" if unit == "px" else unit for unit in found.units),
        limits=frozenset(new.get(name, name) for name in found.limits),
        reasons={new.get(name, name): why for name, why in found.reasons.items()},
    )


def added_delays(played: Estimates, direct: Estimates, *, where: str) -> Estimates:
    """White part and loop by which one time base exceeds another: roots of differences of squares.

    A limit of the direct pictures counts as 0, with the u of the limit's square.

    Raises
    ------
    MeasureError
        If the two cannot be compared.
    """
    rows, limits, reasons = [], set(), {}
    for name in ("white_px", "loop_px"):
        if name not in played or name not in direct:
            continue
        one, other = played[name], direct[name]
        if one.is_limit:
            rows.append((name, one.value, one.u, np.inf, "px"))
            limits.add(name)
            reasons[name] = one.reason
            continue
        square = one.value**2 - (0.0 if other.is_limit else other.value**2)
        u_other = other.value**2 / 12**0.5 if other.is_limit else 2 * other.value * other.u
        u = float(np.hypot(2 * one.value * one.u, u_other))
        if square > NOT_SIGNIFICANT * u:
            rows.append((name, float(np.sqrt(square)), u / (2 * float(np.sqrt(square))), np.inf, "px"))
        else:
            limit = float(np.sqrt(max(square, 0.0) + ONE_SIDED_95 * u))
            rows.append((name, limit, u / (2 * limit), np.inf, "px"))
            limits.add(name)
            reasons[name] = "the rows move hardly more than without the recorder; 95 % upper limit"
    if not rows:
        raise MeasureError("the lines played from tape tell no time base", where=where, remedy="take 16 frames of straight upright lines")
    if "loop_px" not in limits and "loop_rows" in played:
        length = played["loop_rows"]
        rows.append(("loop_rows", length.value, length.u, np.inf, "rows"))
    return Estimates.from_rows(rows, method=played.method, limits=frozenset(limits), reasons=reasons)
