"""The values of a data sheet with the camera's non-linearity taken into account, for comparison with the standard's values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import PixmetryError
from pixmetry.core.number import UPPER_LIMIT, VALUE, Estimates, Number
from pixmetry.core.threads import single_threaded_blas
from pixmetry.emva.files.keys import NONLINEAR, key_of
from pixmetry.emva.records import Measurement
from pixmetry.observe.defects import find_defects
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.photon_transfer_fit import fit_photon_transfer
from pixmetry.observe.photon_transfer_model import QUANTISATION_DN2
from pixmetry.observe.spatial_fit import fit_spatial
from pixmetry.observe.stack import same_exposure

NOISE_PARTS = ("dark_noise_e", "row_noise_e", "column_noise_e")
SPATIAL_KEYS = {
    **{f"DSNU1288{tag}": f"dsnu_{part}_dn" for tag, part in (("", "total"), ("_row", "row"), ("_col", "col"), ("_pixel", "pixel"))},
    **{f"PRNU1288{tag}": f"prnu_{part}_rel" for tag, part in (("", "total"), ("_row", "row"), ("_col", "col"), ("_pixel", "pixel"))},
}
TEMPORAL_METHOD = (
    "joint fit of all means and variances with a cubic non-linearity behind the gain (generalised least squares, REML); "
    "covariance propagated to first order"
)
SPATIAL_METHOD = (
    "analysis of variance of the straightened mean maps without defect pixels, less temporal noise and, bright, a surface of degree 4; "
    "not high-passed as in Release 4.0, so it holds coarse patterns too; "
    "u is that of this sensor measured again, and holds that what the surface takes of the pattern is not seen"
)


def nonlinear_values(m: Measurement, dnl_lsb: float = 0.0) -> tuple[dict[str, Number], tuple[str, ...]]:
    """Gain, noise, efficiency, dark current, capacity and non-uniformity of a camera whose response may be bent.

    Parameters
    ----------
    m : Measurement
    dnl_lsb : float
        Standard deviation of the converter's code widths, where it is known.

    Returns
    -------
    values : dict
        By key with the suffix ``_nonlinear``: ``K``, ``inverse_K``, ``sigma_d``, ``u_e_min``; where the series carries them ``QE``,
        ``u_p_min``, ``u_I_mean``, ``u_e_sat``; with two stacks of one exposure ``DSNU1288`` and ``PRNU1288``, each with row, column and
        pixel part.
    notes : tuple of str
        Why values are missing, and how the non-uniformities were taken.

    Notes
    -----
    ``sigma_d`` is the root of the sum of white, row and column noise, as in the standard, which takes the variance of all. A part that is
    not significant counts as zero with its u. µ_e.min = √(σ_d² + σ_q²/K² + ¼) + ½ (EMVA 1288 R4.0 eq. 26). The non-uniformities are
    those of this sensor: u leaves out how sensors of one type differ. Electrons are the straightened values over K.
    """
    with single_threaded_blas():
        try:
            fit = fit_photon_transfer(m.transfer, m.dark_stack, m.bright_stack, dnl_lsb)
        except PixmetryError as problem:
            return {}, (f"no values with the non-linearity taken into account: {problem}",)
        values = _temporal(fit, m.photons_u_rel)
        spatial, notes = _spatial(m, fit, dnl_lsb)
    return values | spatial, notes


@dataclass
class _Propagation:
    """Values with their gradients over the estimates of a joint set, propagated to first order.

    Degrees of freedom: 1/ν is the mean of those of the estimates, weighted by their shares of u². Estimates of one fit share their
    residuals, so that ν does not grow with the number of terms as it does for independent ones (Welch and Satterthwaite).
    """

    source: Estimates
    covariance: Array
    method: str
    values: dict[str, Number] = field(default_factory=dict)

    def add(self, key: str, value: float, gradient: dict[str, float], *, kind: str = VALUE, reason: str = "") -> None:
        g = np.zeros(len(self.source))
        for name, slope in gradient.items():
            g[self.source.index(name)] = slope
        shares = g * (self.covariance @ g)
        inverse = float((np.abs(shares) / self._dof()).sum() / max(np.abs(shares).sum(), 1e-300))
        name = key + NONLINEAR
        u, dof = math.sqrt(max(shares.sum(), 0.0)), 1 / inverse if inverse > 0 else math.inf
        self.values[name] = Number(float(value), u, dof, key_of(name).unit, self.method, reason.replace(" e-", " e⁻"), kind)

    def _dof(self) -> Array:
        """Degrees of freedom of each estimate, more where something known was added to its variance."""
        own = np.diag(self.source.covariance)
        grown: Array = np.divide(np.diag(self.covariance), own, out=np.ones_like(own), where=own > 0)
        dof: Array = self.source.dof * grown**2
        return dof


def _temporal(fit: Estimates, photons_u_rel: float) -> dict[str, Number]:
    """Everything that the exposure series gives."""
    covariance = fit.covariance.copy()
    photons_known = "quantum_efficiency" in fit
    if photons_known:
        at = fit.index("quantum_efficiency")
        covariance[at, at] += (fit.values[at] * photons_u_rel) ** 2
    out = _Propagation(fit, covariance, TEMPORAL_METHOD)
    gain = fit["gain_dn_per_e"]
    out.add("K", gain.value, {"gain_dn_per_e": 1.0}, reason=gain.reason)
    out.add("inverse_K", 1 / gain.value, {"gain_dn_per_e": -1 / gain.value**2}, reason=gain.reason)
    if photons_known:
        known = "" if photons_u_rel > 0 else "u does not include the calibration of the photon count"
        out.add("QE", 100 * fit["quantum_efficiency"].value, {"quantum_efficiency": 100.0}, reason=known)
    _add_noise(out, fit)
    for key, name in (("u_I_mean", "dark_current_e_per_s"), ("u_e_sat", "full_well_e")):
        if name in fit:
            e = fit[name]
            out.add(key, e.value, {name: 1.0}, kind=UPPER_LIMIT if e.is_upper_limit else VALUE, reason=e.reason)
    return out.values


def _add_noise(out: _Propagation, fit: Estimates) -> None:
    """Temporal dark noise with its row and column parts, and the signal at which it equals the noise."""
    parts = {name: fit[name] for name in NOISE_PARTS}
    white = parts["dark_noise_e"]
    if white.is_upper_limit:
        noise, slopes = white.value, {"dark_noise_e": 1.0}
    else:
        noise = math.hypot(*(p.value for p in parts.values() if p.kind == "value"))
        slopes = {name: p.value / noise for name, p in parts.items()}
    reason = white.reason
    out.add("sigma_d", noise, slopes, kind=white.kind, reason=reason)
    gain = fit["gain_dn_per_e"].value
    root = math.sqrt(noise**2 + QUANTISATION_DN2 / gain**2 + 0.25)
    slopes = {name: slope * noise / root for name, slope in slopes.items()}
    slopes["gain_dn_per_e"] = -QUANTISATION_DN2 / gain**3 / root
    least = root + 0.5
    out.add("u_e_min", least, slopes, kind=white.kind, reason=reason)
    if "quantum_efficiency" in fit:
        eta = fit["quantum_efficiency"].value
        slopes = {name: slope / eta for name, slope in slopes.items()} | {"quantum_efficiency": -least / eta**2}
        out.add("u_p_min", least / eta, slopes, kind=white.kind, reason=reason)


def _spatial(m: Measurement, fit: Estimates, dnl_lsb: float) -> tuple[dict[str, Number], tuple[str, ...]]:
    """The non-uniformities from the two stacks, or the reason why there are none."""
    dark, bright = m.dark_stack, m.bright_stack
    missing = "DSNU and PRNU are not measured with the non-linearity taken into account: "
    if dark is None or bright is None:
        return {}, (f"{missing}they need a stack of dark frames and one of bright frames",)
    if not same_exposure(dark, bright):
        return {}, (f"{missing}the stacks differ in exposure, dark {dark.exposure_s:g} s, bright {bright.exposure_s:g} s",)
    try:
        defects = find_defects(dark, bright)
        linearity = Linearity.of(fit, m.transfer.bits)
        found = fit_spatial(dark, bright, defects, linearity=linearity, dnl_lsb=dnl_lsb, this_sensor=True)
    except PixmetryError as problem:
        return {}, (f"{missing}{problem}",)
    gain = fit["gain_dn_per_e"]
    joint = fit.select(["gain_dn_per_e"]).join(found)
    out = _Propagation(joint, joint.covariance, SPATIAL_METHOD)
    for key, name in SPATIAL_KEYS.items():
        if name not in found:
            unit = key_of(key + NONLINEAR).unit
            out.values[key + NONLINEAR] = Number.not_available(unit, found.reasons.get(name, ""), SPATIAL_METHOD)
            continue
        e = found[name]
        if key.startswith("DSNU"):
            value, gradient = e.value / gain.value, {name: 1 / gain.value, "gain_dn_per_e": -e.value / gain.value**2}
        else:
            value, gradient = 100 * e.value, {name: 100.0}
        out.add(key, value, gradient, kind=UPPER_LIMIT if e.is_upper_limit else VALUE, reason=e.reason)
    notes = (f"DSNU1288{NONLINEAR} and PRNU1288{NONLINEAR}, with their parts, exclude {len(defects)} defect pixels",)
    return out.values, notes if len(defects) else ()
