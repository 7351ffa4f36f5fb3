"""Dark signal non-uniformity: offsets of pixels, rows and columns that are there without light and the same in every frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pixmetry.camera.contribution import Contribution, Probe
from pixmetry.camera.observations import Observations
from pixmetry.camera.signal import Kind, Signal
from pixmetry.camera.source import Parameters, Source, cut_map, quantity
from pixmetry.core.errors import MeasureError
from pixmetry.core.number import Estimates, effective_dof
from pixmetry.core.random import Stream

FITTED = {"pixel_std_e": "dsnu_pixel_dn", "row_std_e": "dsnu_row_dn", "col_std_e": "dsnu_col_dn"}


class Dsnu(Parameters):
    """Standard deviations of the offsets, fixed in the unit."""

    pixel_std_e: float = quantity(0.0, "e-", "from pixel to pixel", ge=0, le=1e5)
    row_std_e: float = quantity(0.0, "e-", "from row to row", ge=0, le=1e5)
    col_std_e: float = quantity(0.0, "e-", "from column to column", ge=0, le=1e5)


def forward(params: Dsnu, signal: Signal, stream: Stream) -> Signal:
    """Add each pixel's offset, and that of its row and column; of a measured unit its map ``offset_e``."""
    known = stream.known_fixed("offset_e", signal.grid)
    if known is not None:
        return signal.with_data(signal.data + known)
    data = stream.add_normal_fixed(signal.data, signal.grid, params.pixel_std_e)
    if params.row_std_e:
        data += np.float32(params.row_std_e) * stream.normal_rows_fixed(signal.grid)[:, :, None]
    if params.col_std_e:
        data += np.float32(params.col_std_e) * stream.normal_cols_fixed(signal.grid)[:, None, :]
    return signal.with_data(data)


def truth(params: Dsnu, signal: Signal, stream: Stream) -> Mapping[str, np.ndarray]:
    """Offset of every pixel of the unit, in electrons."""
    one = signal.take(np.array([0]))
    return {"dsnu_e": forward(params, one.with_data(np.zeros(one.grid.size, np.float32)), stream).data[0]}


def measure(observations: Observations) -> Estimates:
    """Read the split of the dark stack and divide by the gain; u by JCGM 102 (6.2.1.3), gain and split taken as independent."""
    spatial, transfer = observations.spatial_fit, observations.photon_transfer_fit
    if spatial is not None and "dsnu_pixel_dn" in spatial.reasons and "dsnu_pixel_dn" not in spatial:
        raise MeasureError(spatial.reasons["dsnu_pixel_dn"], where="sensor.dsnu", remedy="switch off every filter in the camera")
    if spatial is None or "dsnu_pixel_dn" not in spatial:
        raise MeasureError(
            "DSNU needs a stack of dark frames and one of bright frames", where="sensor.dsnu", remedy="take at least 16 of each"
        )
    if transfer is None or "gain_dn_per_e" not in transfer:
        raise MeasureError("DSNU in electrons needs the gain", where="sensor.dsnu", remedy="take a photon-transfer series")
    there = {new: old for new, old in FITTED.items() if old in spatial}  # without what the split could not tell
    in_dn, gain = spatial.select(there), transfer["gain_dn_per_e"]
    values = in_dn.values / gain.value
    own, common = in_dn.covariance / gain.value**2, np.outer(values, values) * (gain.u / gain.value) ** 2
    covariance = own + common
    parts, dofs = (np.stack(pair, axis=-1) for pair in ((np.diag(own), np.diag(common)), (in_dn.dof, np.full(len(in_dn), gain.dof))))
    dof = effective_dof(parts, dofs)
    return Estimates(
        names=in_dn.names,
        values=values,
        covariance=covariance,
        dof=np.where(dof < 1e9, np.maximum(dof, 1.0), np.inf),
        units=("e-",) * len(in_dn),
        method=f"{in_dn.method}; divided by the gain",
        confounders=in_dn.confounders,
        limits=in_dn.limits,
        reasons=in_dn.reasons,
    )


def correct(params: Dsnu, signal: Signal, maps: Mapping[str, np.ndarray]) -> Signal:
    """Subtract the measured dark frame ``dark_dn`` of this unit, in DN above black, from a signal in DN."""
    return signal.with_data(signal.data - cut_map(maps, "dark_dn", signal).astype(np.float32))


def propagate(params: Dsnu, probe: Probe) -> Contribution:
    """Propagator P1 with constant errors: white, common to rows, common to columns; independent parts."""
    gain = probe.gain_dn_per_e
    parts = (probe.white(gain * params.pixel_std_e), probe.rows(gain * params.row_std_e), probe.columns(gain * params.col_std_e))
    ux, uy = (float(np.sqrt(sum(p[axis] ** 2 for p in parts))) for axis in (0, 1))
    return Contribution(u_x_px=ux, u_y_px=uy, gum_class="F", model_error=0.12, method="linear response of the estimator to fixed offsets")


SOURCE = Source(
    id="sensor.dsnu",
    title="Dark signal non-uniformity",
    description="Each pixel, row and column has a fixed offset that does not depend on the light.",
    number=15,
    parameters=Dsnu,
    consumes=(Kind.ELECTRONS,),
    after=("sensor.shot_noise", "sensor.full_well", "sensor.charge_transfer"),
    neutral=Dsnu(),
    typical=Dsnu(pixel_std_e=3.0, row_std_e=0.5, col_std_e=0.5),
    bound=Dsnu(pixel_std_e=15.0, row_std_e=3.0, col_std_e=3.0),
    maps={"offset_e": ("pixel_std_e", "row_std_e", "col_std_e")},
    forward=forward,
    truth=truth,
    measure=measure,
    correct=correct,
    propagate=propagate,
    gum_class="F",
    equation="n' = n + s_pixel n_rc + s_row n_r + s_col n_c",
    typical_size="0.0055 px per DN of pixel DSNU on a disc of 7 px in a window of radius 6 px (centroid)",
    references=("EMVA 1288 R4.0 Linear, §8.2, eq. 33–42, 66", "JCGM 102:2011, 6.2.1.3"),
    leaves="the noise of the dark frame, and dark current of another exposure time or temperature",
    advice="Subtract the mean of L dark frames; noise/√L remains.",
)
