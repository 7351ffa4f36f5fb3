"""Parasitic light: the stores of a global shutter still see a little light while their rows wait for the read-out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.light import GAUSS
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.core.random import Stream

LEAST_LEVELS, LEAST_RANGE = 5, 5.0  # exposure times, and their ratio
MOST_CLIPPED, LEAST_OVER_NOISE = 1e-4, 20.0  # of levels that count
MOST_SENSITIVE, MOST_GROWN, SIGNIFICANT = 0.1, 0.5, 3.5  # sensitivity, and logarithm of the light over the frame
UNKNOWN_WAIT_S = 5e-5  # of the first row
METHOD = "slope of the light over the rows against one over the exposure, flat fields in steady light"


class ParasiticLight(Parameters):
    """Sensitivity of the closed store, and how long each row waits."""

    sensitivity_rel: float = quantity(
        0.0, "1", "sensitivity of the storage node over that of the photodiode (reciprocal of the shutter efficiency)", ge=0, le=0.1
    )
    wait_s: float = quantity(50e-6, "s", "time from the end of the exposure to the read-out of the first row", ge=0, le=1)
    row_time_s: float = quantity(10e-6, "s", "time from the read-out of one row to the next", ge=0, le=0.01)
    first_row: Literal["top", "bottom"] = quantity("top", "1", "the row that is read first")


def stored_s(params: ParasiticLight, signal: Signal) -> np.ndarray:
    """How long each row waits in its store, shape (n, rows)."""
    rows = signal.rows.astype(float)
    order = rows if params.first_row == "top" else signal.frame_shape[0] - 1 - rows
    return params.wait_s + params.row_time_s * order


def gain(params: ParasiticLight, signal: Signal) -> np.ndarray:
    """Light gathered over that of the exposure alone, for a scene that stands still, shape (n, rows)."""
    brighter: Array = 1 + params.sensitivity_rel * stored_s(params, signal) / signal.exposure_s[:, None]
    return brighter


def forward(params: ParasiticLight, signal: Signal, stream: Stream) -> Signal:
    """Add three looks over the waiting time: a scene that stands still grows brighter from row to row, a moving one leaves a ghost."""
    if not params.sensitivity_rel:
        return signal
    nodes, shares = GAUSS[3]
    stored = stored_s(params, signal)[:, :, None]
    late = (signal.time_s + signal.exposure_s)[:, None, None] + stored * (0.5 + nodes)
    added = (gain(params, signal) - 1)[:, :, None] * shares
    times, weights = (np.broadcast_to(v, (*late.shape[:2], v.shape[2])) for v in signal.own_light.moments)
    return signal.with_light(signal.own_light.seen_at(np.concatenate([times, late], axis=2), np.concatenate([weights, added], axis=2)))


def measure(observations: Observations) -> Estimates:
    """How the light of the rows grows towards those that wait longest, the more the shorter the exposure.

    A row waits w + r τ, so at an exposure t its light is E_r (t + s (w + r τ)). The slope of its logarithm over the rows, with the middle
    row r̄ as reference, is a + s τ/(t + s r̄ τ) + c·level: a holds uneven light, c a response that is not straight. τ is the stated time of
    a line; w is not told, for it adds the same to all rows. Weighted least squares over the levels.
    """
    where, series = "sensor.parasitic_light", observations.series
    take = "take flat fields at five exposure times or more over 1 : 5 in steady light, with dark frames"
    light, dark = series.bright_rows, series.dark_rows
    if observations.sensor == "ccd":
        raise MeasureError("the stores of a CCD are its register: see sensor.smear", where=where)
    if light is None or dark is None:
        raise MeasureError("needs dark and bright frames", where=where, remedy=take)
    order = np.argsort(dark.exposure_s)
    black = np.array([np.interp(light.exposure_s, dark.exposure_s[order], row[order]) for row in dark.mean_dn.T]).T
    signal, time_s = light.mean_dn - black, light.exposure_s
    mean = signal.mean(axis=1)
    noise = np.hypot(light.u_dn, float(np.median(dark.u_dn)))
    good = (light.fraction_max < MOST_CLIPPED) & (signal.min(axis=1) > LEAST_OVER_NOISE * noise)
    if good.sum() < LEAST_LEVELS or np.ptp(np.log(time_s[good])) < np.log(LEAST_RANGE):
        raise MeasureError("the exposure times do not tell it", where=where, value=f"{int(good.sum())} levels that count", remedy=take)
    row = np.arange(signal.shape[1]) - 0.5 * (signal.shape[1] - 1)
    slope = np.log(signal[good]) @ row / (row @ row)
    u_slope = noise[good] / mean[good] / np.sqrt(row @ row)
    shortest, longest = (int(pick(time_s[good])) for pick in (np.argmin, np.argmax))
    grown = float(slope[shortest] - slope[longest]) * signal.shape[1]
    if abs(grown) > MOST_GROWN:
        what = f"the light of the rows grows by the factor {np.exp(abs(grown)):.2g} over the frame as the exposure gets shorter"
        raise MeasureError(f"{what}: a shutter whose rows begin together", where=where, remedy="see sensor.rolling_shutter")
    product = spread = factor = 0.0
    for _ in range(5):  # s τ is on both sides
        late = time_s[good] + abs(product) * 0.5 * signal.shape[1]
        design = np.stack([np.ones(late.size), 1 / late, mean[good] / mean[good].max()], axis=1)
        covariance = np.linalg.inv(design.T @ (design / u_slope[:, None] ** 2))
        values = covariance @ (design.T @ (slope / u_slope**2))
        chi2 = float((((slope - design @ values) / u_slope) ** 2).sum())
        factor = max(chi2 / (late.size - 3), 1.0)
        product, spread = float(values[1]), float(np.sqrt(factor * covariance[1, 1]))
    found = f"sensitivity times the time from row to row is {1e9 * product:.2g} ± {1e9 * spread:.1g} ns"
    line_us = observations.stated.line_time_us
    if not line_us:
        raise MeasureError(found, where=where, remedy="state camera.line_time_us: the rest follows")
    sensitivity = product / (1e-6 * line_us)
    u = float(np.hypot(spread / (1e-6 * line_us), sensitivity**2 * UNKNOWN_WAIT_S / time_s[good].min()))
    if abs(sensitivity) > MOST_SENSITIVE:
        raise MeasureError(f"{found}: more than parasitic light is", where=where, remedy="check camera.line_time_us")
    dof, known = float(good.sum() - 3) if factor > 1 else np.inf, ("row_time_s", 1e-6 * line_us, 0.0, np.inf, "s")
    if abs(sensitivity) < SIGNIFICANT * u:
        limit = min(abs(sensitivity) + ONE_SIDED_95 * u, MOST_SENSITIVE)
        why = {"sensitivity_rel": "the light of the rows does not depend on the exposure; 95 % upper limit"}
        return Estimates.from_rows(
            [("sensitivity_rel", limit, u, dof, "1"), known], method=METHOD, limits=frozenset({"sensitivity_rel"}), reasons=why
        )
    settings = {"first_row": "top" if product > 0 else "bottom"}
    rows = [("sensitivity_rel", abs(sensitivity), u, dof, "1"), known]
    return replace(Estimates.from_rows(rows, method=METHOD), settings=settings)


def correct(params: ParasiticLight, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide every row by its gain; exact for a scene that stands still."""
    return signal.with_data((signal.data / gain(params, signal)[:, :, None]).astype(np.float32))


def truth(params: ParasiticLight, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Gain of every row, and how long it waits, shape (n, rows) each."""
    return {"gain": gain(params, signal), "stored_s": stored_s(params, signal)}


SOURCE = Source(
    id="sensor.parasitic_light",
    title="Parasitic light sensitivity",
    description="The storage nodes of a global shutter collect stray light until they are read. This gives a gradient over the rows, "
    "and ghosts.",
    parameters=ParasiticLight,
    consumes=(Kind.LIGHT,),
    after=("sensor.exposure",),
    before=("sensor.trigger_jitter",),
    neutral=ParasiticLight(),
    typical=ParasiticLight(sensitivity_rel=1 / 2000, wait_s=1e-3),
    bound=ParasiticLight(sensitivity_rel=1 / 700, wait_s=1e-3, row_time_s=30e-6),
    forward=forward,
    measure=measure,
    correct=correct,
    truth=truth,
    applies_to=("cmos",),
    gum_class="F",
    equation="I(r) = E t_exp + PLS E (t_wait + r t_row)",
    typical_size="28 % from the first to the last row at 1/700, 20 ms of read-out and 0.1 ms of exposure: 0.0005 px on a disc of 7 px",
    references=("S. Lauxtermann et al., Int. Image Sensor Workshop 2007 (comparison of global shutter pixels)",),
    leaves="ghosts of targets that moved while rows waited",
    advice="Use a strobe as the only light, or expose longer.",
    reasons={
        "propagate": "needs the share of light that falls in the waiting time; under steady light it is a gradient: shift g⟨y²⟩",
    },
)
