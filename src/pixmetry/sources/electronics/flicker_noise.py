"""Flicker noise: the 1/f noise of the output amplifier, along the pixels in the order in which they are read."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.dark_rows import octave_covariance, octave_periods
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, quantity
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream
from pixmetry.sources.electronics._kernels import add_interpolated

VARIANCE = 2 / 3  # of straight lines between independent nodes of variance 1, on average over the places between them


class FlickerNoise(Parameters):
    """Noise whose power density goes as 1/f over a number of octaves below the corner; beyond, it falls off as 1/f⁴."""

    rms_e: float = quantity(0.0, "e-", "root mean square over all octaves", ge=0, le=1e5)
    corner_rel: float = quantity(
        0.1, "1", "frequency up to which the density is proportional to 1/f, divided by the pixel clock", gt=0, le=0.5
    )
    octaves: int = quantity(16, "1", "octaves of 1/f below the corner; below the lowest octave the density is constant", ge=1, le=32)
    line_px: float = quantity(908.0, "px", "pixel clocks from line to line; at least the row's pixels", ge=0, le=1e6)
    interlaced: bool = quantity(False, "1", "whether even rows are read first, then odd ones")
    field_lines: float = quantity(312.5, "1", "number of lines from the start of the first field to the start of the second", gt=0, le=1e6)

    def clocks(self, row: np.ndarray, cols: int) -> np.ndarray:
        """Pixel clocks at which rows of so many pixels begin."""
        line = row // 2 + self.field_lines * (row % 2) if self.interlaced else row
        return line * max(self.line_px, float(cols))


def octaves(params: FlickerNoise) -> list[tuple[float, float]]:
    """Distance of the nodes in pixel clocks, and share of the variance, of every octave: see `octave_periods`."""
    periods, shares = octave_periods(params.corner_rel, params.octaves)
    return list(zip(periods.tolist(), shares.tolist(), strict=True))


def forward(params: FlickerNoise, signal: Signal, stream: Stream) -> Signal:
    """Add the noise: in every octave, straight lines between keyed normal nodes whose raster starts anywhere in each frame.

    A pixel looks up the nodes by its own time, so a window is the crop of its frame.
    """
    if params.rms_e == 0 or stream.quiet:
        return signal
    data = np.array(signal.data, np.float32)
    n, rows, cols = data.shape
    first = (params.clocks(signal.rows, signal.frame_shape[1]) + signal.grid.col0[:, None]).ravel()  # time of each row's first pixel
    lines = data.reshape(n * rows, cols)
    frame = np.repeat(signal.grid.frame, rows)
    for k, (period, share) in enumerate(octaves(params)):
        start = np.repeat(stream.uniform_frames(signal.grid, k).astype(float), rows)
        node = np.floor(first / period + start)
        count = int(cols / period) + 3
        grid = Grid(frame, np.zeros_like(frame), node.astype(np.int64), (1, count))
        scale = params.rms_e * math.sqrt(share / VARIANCE)
        add_interpolated(stream.normal(grid, k)[:, 0], first / period + start - node, 1.0 / period, scale, lines)
    return signal.with_data(data)


def covariance(params: FlickerNoise, lag_px: np.ndarray) -> np.ndarray:
    """Covariance in e-² at lags in pixel clocks."""
    covariance_e2: Array = params.rms_e**2 * octave_covariance(params.corner_rel, params.octaves, lag_px)
    return covariance_e2


def measure(observations: Observations) -> Estimates:
    """Read the 1/f noise off the spectra of dark rows and of their means, down to one cycle a frame.

    The same noise is then no longer part of the white noise and of the noise of the rows (`electronics.amplifier_noise`,
    `electronics.row_noise`).
    """
    where, rows, fit = "electronics.flicker_noise", observations.dark_rows, observations.photon_transfer_fit
    if rows is None:
        remedy = "take 16 or more dark frames, of 48 rows or more"
        raise MeasureError("needs the spectrum of dark rows along the read-out", where=where, remedy=remedy)
    if "rms_dn" not in rows.flicker:
        raise MeasureError(rows.flicker.reasons["rms_dn"], where=where)
    if fit is None or "gain_dn_per_e" not in fit:
        what = f"1/f noise of {rows.flicker['rms_dn'].value:.2g} DN: in electrons it needs the gain"
        raise MeasureError(what, where=where, remedy="take bright frames at several exposures")
    gain, told = fit["gain_dn_per_e"], rows.flicker
    found = told.scaled({"rms_dn": (1 / gain.value, "e-")}).select({"rms_e": "rms_dn", **{n: n for n in told.names if n != "rms_dn"}})
    covariance = found.covariance.copy()
    covariance[0, 0] += (found.values[0] * gain.u / gain.value) ** 2
    if found["rms_e"].is_limit:
        return replace(found, covariance=covariance)
    assumed = "assumed, from one to two times the pixels of a row: state camera.line_time_us and pixel_clock_mhz"
    why = {"line_px": assumed} if rows.u_line_px else {}
    line = Estimates.from_rows([("line_px", rows.line_px, rows.u_line_px, np.inf, "px")], reasons=why)
    return replace(found, covariance=covariance).join(line)


def propagate(params: FlickerNoise, probe: Probe) -> Contribution:
    """Propagator P1 with the covariance of the window's pixels at their times of read-out: u² = gᵀ C g.

    The covariance of two pixels hangs on their rows and on how many columns they are apart. Of two fields, windows that begin on even and
    on odd rows weigh the same.
    """
    rows, cols = probe.gx.shape[1:]
    products = [_products_of_rows(g) for g in (probe.gx, probe.gy)]
    squares = np.zeros(2)
    starts = (0, 1) if params.interlaced else (0,)
    for start in starts:
        first = params.clocks(start + np.arange(rows), probe.frame_shape[1])
        table = covariance(params, (first[:, None] - first)[:, :, None] + np.arange(1 - cols, cols))  # two rows, and columns apart
        squares += [probe.gain_dn_per_e**2 * (p * table).sum() / len(starts) for p in products]
    u_x, u_y = np.sqrt(np.maximum(squares, 0.0)).tolist()
    return probe.contribution((u_x, u_y), "T", model_error=0.12, method="linear response of the estimator to noise along the read-out")


def _products_of_rows(g: np.ndarray) -> np.ndarray:
    """Sums of products of two rows of a gradient, columns 1 − cols to cols − 1 apart, mean over the phases; (rows, rows, 2 cols − 1)."""
    cols = g.shape[2]
    waves = np.fft.rfft(g, 2 * cols, axis=2)
    sums = np.fft.irfft(np.einsum("prf,psf->rsf", waves, waves.conj()) / len(g), 2 * cols, axis=2)
    around: Array = np.roll(sums, cols - 1, axis=2)[:, :, :-1]
    return around


SOURCE = Source(
    id="electronics.flicker_noise",
    title="Flicker noise",
    description="The 1/f noise of the output amplifier is correlated along the read-out: neighbours in a row share it, and the means of "
    "the rows differ.",
    parameters=FlickerNoise,
    consumes=(Kind.ELECTRONS,),
    after=("sensor",),
    neutral=FlickerNoise(),
    typical=FlickerNoise(rms_e=10.0),
    bound=FlickerNoise(rms_e=60.0, corner_rel=0.2),
    forward=forward,
    measure=measure,
    propagate=propagate,
    gum_class="T",
    equation="n' = n + ζ(t),  t = r t_line + c t_pixel (r: line of the field),  S_ζ(f) ∝ 1/f from f_c/2^octaves to f_c",
    typical_size="0.009 px in y and 0.002 px in x per DN rms on a disc of 7 px (white noise: 0.004 px): the pixels of a row share it",
    references=(
        "R. F. Voss, J. Clarke, J. Acoust. Soc. Am. 63(1), 1978 (1/f noise as a sum of slow and fast ones)",
        "J. R. Janesick, Photon Transfer, SPIE Press 2007, ch. 11 (1/f noise and correlated double sampling)",
    ),
    advice="Use correlated double sampling with a short interval; clamp every row on its optically black pixels.",
    reasons={
        "correct": "a frame with other noise and another scene has the same values. Optically black columns remove the part that is "
        "common to a row, as electronics.row_noise",
    },
)
