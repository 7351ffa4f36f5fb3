"""Smear: charge gathers light while it is moved down the column, so a bright target leaves a streak.

The sum over a column runs from its first row to its last in float64, so a column's value depends on nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from pixmetry.camera.observations import Observations, of_pictures
from pixmetry.camera.signal import Kind, Signal, Windows
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream
from pixmetry.sources.sensor._readout_kernels import add_column_sums, add_rows_passed

NEAR_ROWS = 64  # of a column that the frozen mode follows
EXPOSURE_S = 0.01  # that the stated tail allows for


class Smear(Parameters):
    """How long charge moves through the column, how much light it sees there, and which rows it passes."""

    transfer_s: float = quantity(
        0.0, "s", "frame transfer: time to move the whole frame into its storage area; interline: time to read the whole frame", ge=0, le=1
    )
    leak_rel: float = quantity(
        1.0, "1", "sensitivity during the transfer over that of a photosite: 1 unshielded, 1e-5 to 1e-4 in an interline sensor", ge=0, le=1
    )
    rows: Literal["all", "passed"] = quantity(
        "all",
        "1",
        "all: continuous operation, charge has passed all rows of its column; passed: after a flush, only the rows up to the storage area",
    )
    store: Literal["below", "above"] = quantity(
        "below", "1", "side of the storage area: below, the last row is nearest to it; above, row 0, as in sensor.charge_transfer"
    )


def share(params: Smear, signal: Signal) -> np.ndarray:
    """Part of one row's light that every packet takes up on passing it, shape (n,)."""
    leaked: Array = params.leak_rel * params.transfer_s / (signal.frame_shape[0] * np.maximum(signal.exposure_s, 1e-12))
    return leaked


def forward(params: Smear, signal: Signal, stream: Stream) -> Signal:
    """Add what each packet takes up on its way, from the light as it is before any pixel is full."""
    if not params.transfer_s or not params.leak_rel:
        return signal
    return signal.with_data(_smeared(params, signal.data, share(params, signal)))


def _smeared(params: Smear, data: np.ndarray, factor: np.ndarray) -> np.ndarray:
    data = np.ascontiguousarray(data, np.float32)
    if params.rows == "all":
        return add_column_sums(data, factor)
    return add_rows_passed(data, factor, params.store == "below", False)


def correct(params: Smear, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Solve for the light on whole frames: row by row from the store on, or from the column sum, which smear raises by 1 + rows × share."""
    data, factor = np.ascontiguousarray(signal.data, np.float32), share(params, signal)
    if params.rows == "all":
        return signal.with_data(add_column_sums(data, -factor / (1 + signal.frame_shape[0] * factor)))
    return signal.with_data(add_rows_passed(data, -factor, params.store == "below", True))


def context(params: Smear, windows: Windows, frame_shape: tuple[int, int]) -> Windows:
    """The whole column."""
    return windows.full_columns(frame_shape)


def near(params: Smear) -> tuple[int, int, int, int]:
    """Rows from which the streaks of targets are followed."""
    return NEAR_ROWS, NEAR_ROWS, 0, 0


def tail(params: Smear) -> float:
    """Share of a pixel's light that goes to all rows together, at an exposure of 10 ms."""
    return params.leak_rel * params.transfer_s / EXPOSURE_S


def truth(params: Smear, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """How many rows each row's charge passes, shape (rows,), and what it takes up in an even field, over the field, shape (n, rows)."""
    n_rows = signal.frame_shape[0]
    order = np.arange(n_rows)
    passed = np.full(n_rows, n_rows) if params.rows == "all" else n_rows - 1 - order if params.store == "below" else order
    return {"rows_passed": passed, "streak_rel": share(params, signal)[:, None] * passed}


def measure(observations: Observations) -> Estimates:
    """Product of transfer time and leak, as a time at leak 1: from covered rows or streaks of bright spots, whichever tells it better.

    Raises
    ------
    MeasureError
        If neither does.
    """
    spots = None if observations.spots is None else observations.spots.fit
    found, reasons = [], []
    for ask in (
        lambda: observations.by_covered(
            {"transfer_s": "smear_s"}, where="sensor.smear", method="covered rows over the sums of their columns"
        ),
        lambda: of_pictures(spots, {"transfer_s": "smear_s"}, where="sensor.smear", pictures="bright spots on black", kind="spots"),
    ):
        try:
            found.append(ask())
        except MeasureError as problem:
            reasons.append(problem)
    if not found:
        raise reasons[1] if observations.covered is None or spots is not None else reasons[0]
    best, seen = min(found, key=lambda fit: fit["transfer_s"].u), observations.spots
    if not best.limits and observations.photon_transfer is not None:  # faint charge over much light: a bent response changes their ratio
        bend = best.values * observations.bend_rel(0.5 * 2.0**observations.photon_transfer.bits)
        best = replace(best, covariance=best.covariance + np.outer(bend, bend))
    if seen is None or "smear_s" not in seen.fit or seen.fit["smear_s"].is_limit:
        return best
    return replace(best, settings={"rows": seen.smear_rows, "store": seen.smear_store})  # whatever told the amount


SOURCE = Source(
    id="sensor.smear",
    title="Smear",
    description="Charge collects more light while it moves down the column. A bright target leaves a streak above and below it, or on "
    "one side.",
    number=9,
    stars=2,
    parameters=Smear,
    consumes=(Kind.PHOTONS, Kind.ELECTRONS),
    before=("sensor.dark_current", "sensor.shot_noise"),
    neutral=Smear(),
    typical=Smear(transfer_s=4e-4, rows="passed"),
    bound=Smear(transfer_s=2e-3, rows="passed"),
    forward=forward,
    measure=measure,
    correct=correct,
    truth=truth,
    context=context,
    near=near,
    tail=tail,
    applies_to=("ccd",),
    gum_class="F",
    equation="I' = I + ε Σ I over the rows passed,  ε = leak · t_transfer/(N t_exp);  Δy = ε (h² − ⟨y²⟩)/2 in a window of half height h",
    typical_size="0.003 px at a streak of 5 % of the column's light over 582 rows; interline below 1e-4 of the column's light",
    references=(
        "F. A. Iglesias, A. Feller, K. Nagaraju, Appl. Opt. 54, 5970, 2015 (smear of shutterless sensors and its removal)",
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001",
    ),
    leaves="the noise of the smear's charge, and light that has changed since",
    advice="Use a strobe, a shutter or an interline sensor. Or subtract the streak that covered rows show.",
    reasons={
        "propagate": "needs the light of the whole column: the streaks of other objects in it count as much as the target's own",
    },
)
