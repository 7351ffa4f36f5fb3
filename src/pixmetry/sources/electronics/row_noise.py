"""Temporal row and column noise: offsets common to a row or a column, new in every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.dark_rows import without_variance
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, cut_rows, quantity
from pixmetry.core.number import Estimates
from pixmetry.core.random import Stream

CLAMP = "grabber.clamp: what its level of black varies by from line to line counts here; a second gain in front of it tells them apart"


class RowNoise(Parameters):
    """Standard deviations of the offsets, referred to electrons."""

    row_e: float = quantity(0.0, "e-", "common to a row", ge=0, le=1e5)
    column_e: float = quantity(0.0, "e-", "common to a column", ge=0, le=1e5)


def forward(params: RowNoise, signal: Signal, stream: Stream) -> Signal:
    """Add one normal number a row and one a column."""
    if params.row_e == 0 and params.column_e == 0:
        return signal
    rows = np.float32(params.row_e) * stream.normal_rows(signal.grid)
    columns = np.float32(params.column_e) * stream.normal_cols(signal.grid)
    return signal.with_data(signal.data + rows[:, :, None] + columns[:, None, :])


def measure(observations: Observations) -> Estimates:
    """Read the temporal row and column variance of dark pairs, less what white noise gives to a mean of a line.

    Hum and 1/f noise along the read-out, where dark rows show them, are taken off: they count under their own names.
    """
    noise = observations.fitted(
        {"row_e": "row_noise_e", "column_e": "column_noise_e"},
        "row noise needs a photon-transfer series with dark frames",
        where="electronics.row_noise",
        remedy="take dark pairs",
    )
    if observations.stated.interface == "analogue":
        noise = replace(noise, confounders=(*noise.confounders, CLAMP))
    rows, fit = observations.dark_rows, observations.photon_transfer_fit
    if rows is None or fit is None or "gain_dn_per_e" not in fit:
        return noise
    hum, flicker, series = rows.taken["hum"], rows.taken["row"], observations.series.dark
    # two frames of phases φ differ by A²/2·(1 − cos Δφ) in their variance: over N levels it scatters by A²/2·√(N/2)/Σ(F − 1)
    scatter = hum[0] * np.sqrt(len(series.n_frames) / 2) / max(float((series.n_frames - 1).sum()), 1.0)
    gain2 = fit["gain_dn_per_e"].value ** 2
    square, u = (hum[0] + flicker[0]) / gain2, float(np.linalg.norm([hum[1], flicker[1], scatter])) / gain2
    told = "rms_dn" in rows.flicker
    what = "hum or 1/f noise, which is measured by itself," if told or hum[0] else "what changes slowly from row to row, as 1/f noise does,"
    return without_variance(noise, "row_e", square, u, what)


def correct(params: RowNoise, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Subtract the offset of each row that the covered columns beside it tell, as far as it is not their own noise.

    ``maps["row_offset_dn"]`` has shape (n, rows of the frame): the offsets of these frames.
    """
    return signal.with_data(signal.data - cut_rows(maps, "row_offset_dn", signal)[:, :, None])


def propagate(params: RowNoise, probe: Probe) -> Contribution:
    """Propagator P1 with the errors of each row, and of each column, in common."""
    rows, columns = probe.rows(probe.gain_dn_per_e * params.row_e), probe.columns(probe.gain_dn_per_e * params.column_e)
    u = float(np.hypot(rows[0], columns[0])), float(np.hypot(rows[1], columns[1]))
    return probe.contribution(u, "Tr", model_error=0.12, method="linear response of the estimator to offsets common to rows and columns")


SOURCE = Source(
    id="electronics.row_noise",
    title="Temporal row and column noise",
    description="The reference of each row or column amplifier changes from frame to frame: whole rows or columns get brighter or darker.",
    parameters=RowNoise,
    consumes=(Kind.ELECTRONS,),
    after=("sensor",),
    neutral=RowNoise(),
    typical=RowNoise(row_e=1.0, column_e=0.3),
    bound=RowNoise(row_e=5.0, column_e=2.0),
    forward=forward,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="Tr",
    equation="n' = n + σ_row z_r + σ_col z_c",
    typical_size="0.0155 px per DN in y on a disc of 7 px in a window of radius 6 px",
    references=("EMVA 1288 R4.0 Linear, §8.2 (row and column split)",),
    advice="Subtract each row's offset, measured in optically black columns, or average frames.",
    leaves="the noise of the covered pixels' mean, as far as the weight of the offsets lets it through, and the noise of the columns",
)
