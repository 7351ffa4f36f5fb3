"""Photo response non-uniformity: pixels, rows and columns that answer the same light differently."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.dark_rows import without_variance
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, cut_map, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates
from pixmetry.core.random import Grid, Stream


class Prnu(Parameters):
    """Standard deviations of the relative response, fixed in the unit."""

    pixel_std_rel: float = quantity(0.0, "1", "from pixel to pixel", ge=0, le=0.3)
    row_std_rel: float = quantity(0.0, "1", "from row to row", ge=0, le=0.3)
    col_std_rel: float = quantity(0.0, "1", "from column to column", ge=0, le=0.3)


def response(params: Prnu, grid: Grid, stream: Stream) -> np.ndarray:
    """Relative response of every pixel, shape (n, rows, cols), float32: 1 + pixel + row + column part, cut off at 0.

    Of a measured unit it is 1 + its map ``response_dev_rel``.
    """
    known = stream.known_fixed("response_dev_rel", grid)
    if known is not None:
        return np.maximum(1 + known, 0)
    gain = stream.add_normal_fixed(np.ones(grid.size, np.float32), grid, params.pixel_std_rel)
    if params.row_std_rel:
        gain += np.float32(params.row_std_rel) * stream.normal_rows_fixed(grid)[:, :, None]
    if params.col_std_rel:
        gain += np.float32(params.col_std_rel) * stream.normal_cols_fixed(grid)[:, None, :]
    return np.maximum(gain, 0, out=gain)


def forward(params: Prnu, signal: Signal, stream: Stream) -> Signal:
    """Multiply the mean signal by each pixel's response."""
    return signal.with_data(signal.data * response(params, signal.grid, stream))


def truth(params: Prnu, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Relative response of every pixel of the unit."""
    return {"prnu_rel": response(params, signal.take(np.array([0])).grid, stream)[0]}


def measure(observations: Observations) -> Estimates:
    """Read the split of the flat-field stack: rows, columns and pixels, shading and temporal noise taken out.

    A part of which the split gives neither a value nor a limit is left out.
    """
    names = {"pixel_std_rel": "prnu_pixel_rel", "row_std_rel": "prnu_row_rel", "col_std_rel": "prnu_col_rel"}
    spatial = observations.spatial_fit
    there = {new: old for new, old in names.items() if spatial is None or old in spatial}
    why = "" if spatial is None else spatial.reasons.get("prnu_pixel_rel", "")
    if "pixel_std_rel" not in there and not why:
        remedy = "take 16 or more dark and as many bright frames of the same exposure"
        raise MeasureError("needs a stack of bright frames and one of dark frames", where="sensor.prnu", remedy=remedy)
    if "pixel_std_rel" not in there:
        raise MeasureError(
            "the PRNU of the pixels cannot be determined", where="sensor.prnu", value=why, remedy="check what the frames have in common"
        )
    found = observations.fitted(
        there,
        "PRNU needs a stack of bright frames and one of dark frames",
        where="sensor.prnu",
        remedy="take at least 16 of each",
    )
    return _before_transfer(found, observations)


def _before_transfer(found: Estimates, observations: Observations) -> Estimates:
    """The contrasts before smear added light without them, and before late charge took them from pixel to pixel.

    A share n ε of a packet that comes a pixel later leaves 1 − n ε of a contrast of independent pixels, n being half of the transfers from
    the farthest pixel. Smear s/t of the light adds 1 + s/t to the light of pixels and rows; that of columns is in it. The mean of the n
    pixels of a column, too, keeps its contrast, which was taken off by the smaller one of the pixels behind the smear.
    """
    stack = observations.bright_stack
    if stack is None:
        return found
    smear, serial, parallel = (observations.moved_charge(name) for name in ("smear_s", "serial_cti", "parallel_cti"))
    more, u_more = (v / stack.exposure_s if stack.exposure_s else 0.0 for v in smear)
    (late_x, u_x), (late_y, u_y) = ([0.5 * n * v for v in e] for n, e in zip(stack.shape[::-1], (serial, parallel), strict=True))
    parts = {
        "pixel_std_rel": ((1 + more) / (1 - late_x) / (1 - late_y), (u_more, u_x, u_y)),
        "row_std_rel": ((1 + more) / (1 - late_y), (u_more, u_y)),
        "col_std_rel": (1 / (1 - late_x), (u_x,)),
    }
    factor = np.array([parts[name][0] for name in found.names])
    u = np.array([float(np.linalg.norm(parts[name][1])) for name in found.names])
    covariance = found.covariance * np.outer(factor, factor) + np.diag((found.values * u) ** 2)
    found = replace(found, values=found.values * factor, covariance=covariance)
    if not more or "pixel_std_rel" in found.limits:
        return found
    pixel, diluted = found["pixel_std_rel"], 1 - (1 + more) ** -2.0
    square = pixel.value**2 / stack.shape[0] * diluted
    u_square = square * float(np.hypot(2 * pixel.u / pixel.value, 2 * u_more / (1 + more) ** 3 / diluted))
    return without_variance(found, "col_std_rel", square, u_square, "the pixels' own contrast, which smear leaves in the means of columns,")


def correct(params: Prnu, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Divide by the measured relative response ``prnu_rel`` of this unit (flat-field correction)."""
    return signal.with_data(signal.data / cut_map(maps, "prnu_rel", signal))


def propagate(params: Prnu, probe: Probe) -> Contribution:
    """Propagator P1 with an error proportional to the signal: white, common to rows, common to columns; independent parts."""
    parts = (
        probe.white(params.pixel_std_rel * probe.signal_dn),
        probe.rows(params.row_std_rel * probe.signal_dn),
        probe.columns(params.col_std_rel * probe.signal_dn),
    )
    ux, uy = (float(np.sqrt(sum(p[axis] ** 2 for p in parts))) for axis in (0, 1))
    return Contribution(u_x_px=ux, u_y_px=uy, gum_class="F", model_error=0.12, method="linear response of the estimator to relative errors")


SOURCE = Source(
    id="sensor.prnu",
    title="Photo response non-uniformity",
    description="Each pixel, row and column has its own sensitivity, a fixed factor. The error grows with the light.",
    number=13,
    stars=1,
    note="Note 20",
    parameters=Prnu,
    consumes=(Kind.PHOTONS, Kind.ELECTRONS),
    before=("sensor.dark_current", "sensor.shot_noise"),
    neutral=Prnu(),
    typical=Prnu(pixel_std_rel=0.01, row_std_rel=0.002, col_std_rel=0.002),
    bound=Prnu(pixel_std_rel=0.02, row_std_rel=0.004, col_std_rel=0.004),
    maps={"response_dev_rel": ("pixel_std_rel", "row_std_rel", "col_std_rel")},
    forward=forward,
    truth=truth,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="µ' = µ (1 + s_pixel n_rc + s_row n_r + s_col n_c)",
    typical_size="0.0023 px per 1 % of pixel PRNU on a disc of 7 px (centroid)",
    references=("EMVA 1288 R4.0 Linear, §8.2, eq. 33–42, 67", "JCGM 100:2008, 5.1.2"),
    leaves="the noise of the flat field, and response to light of another colour",
    advice="Divide the frames by a flat field of at least L = 10 (σ / (µ PRNU))² frames.",
)
