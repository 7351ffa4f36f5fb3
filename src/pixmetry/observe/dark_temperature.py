"""Dark current against temperature: its law, and the dark frames of one camera at several temperatures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.camera.observations import DarkTemperatures, Observations
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates
from pixmetry.observe.experiment import PictureGroup
from pixmetry.observe.photon_transfer_model import rounding_error_vars

BOLTZMANN_EV_PER_K = 8.617333262e-5  # CODATA 2018
ZERO_C_K = 273.15
MINIMUM_TEMPERATURES = 3
MINIMUM_RANGE_K = 10.0
DIFFERENT_K = 0.5  # temperatures that lie nearer are one
RESOLVED = 3.0  # u between the growth and zero
CONTRADICTION_Z = 3.09  # scatter beyond the stated u that is met by chance once in a thousand
WHERE = "dark current against temperature"
SINGULAR = 1e-10  # eigenvalue of the correlation, below which one current alone carries the fit
CLIPPED = 1e-3  # share of pixels at code 0
GAP_CHI2 = 16.0  # by which the law of the gap must fit better to be named
METHOD = "weighted least squares of µ_I(T) = µ_ref 2^((T − T_ref)/T_d) (EMVA 1288 R4.0 eq. 31)"


def fit_dark_temperature(
    temperature_c: Array,
    dark_current: Array,
    u: Array,
    *,
    reference_c: float,
    unit: str = "e⁻/s",
) -> Estimates:
    """Dark current at a reference temperature and the temperature step that doubles it.

    Parameters
    ----------
    temperature_c, dark_current, u : ndarray, shape (n,)
        Temperatures of the sensor, dark currents and their standard uncertainties. A current may have come out negative.
    reference_c : float
        Temperature for which the current is stated.
    unit : str
        Of the dark current.

    Returns
    -------
    Estimates
        ``dark_current_ref`` and ``doubling_temperature_k`` with their covariance. Where the currents scatter about the law by more than
        their u, that scatter is taken into u (Birge ratio) and ν = n − 2; else u comes from the stated ones and ν is infinite.

    Raises
    ------
    InputError
        Arrays of different shapes, values that are not finite, or an u that is not above zero.
    MeasureError
        Fewer than three temperatures, less than 10 K between them, a current that does not grow with temperature, or one that is
        seen at one temperature only.

    Notes
    -----
    The law is fitted to the currents, not to their logarithms: a current near zero is as likely negative as positive, and without the
    negative ones the others would be too large.
    """
    t, y, s = _checked(temperature_c, dark_current, u)
    log_current, growth = _solve(t - t.mean(), y, s)
    model, jacobian = _model(t - t.mean(), log_current, growth, s)
    normal = jacobian.T @ jacobian
    size = np.sqrt(np.diag(normal))
    if not (size > 0).all() or np.linalg.eigvalsh(normal / size / size[:, None])[0] < SINGULAR:
        what, remedy = "a dark current is seen at one temperature only", "take longer exposures at the others"
        raise MeasureError(what, where=WHERE, remedy=remedy)
    covariance = np.linalg.inv(normal)
    nu, dof, reason = t.size - 2, math.inf, ""
    chi2 = float((((y - model) / s) ** 2).sum())
    if chi2 > nu * (1 - 2 / (9 * nu) + CONTRADICTION_Z * math.sqrt(2 / (9 * nu))) ** 3:  # Wilson & Hilferty 1931
        covariance, dof = covariance * chi2 / nu, float(nu)
        reason = f"the currents scatter about the law by {math.sqrt(chi2 / nu):.2g} times their u; u was multiplied by this factor"
    if growth < RESOLVED * math.sqrt(covariance[1, 1]):
        raise MeasureError(
            "the dark current does not grow with temperature by more than its uncertainty",
            where=WHERE,
            remedy="take dark frames at higher temperatures or longer exposures",
        )
    shift = reference_c - t.mean()
    current = math.exp(log_current + growth * shift)
    gradient = np.array([[current, current * shift], [0.0, -math.log(2) / growth**2]])
    return Estimates(
        names=("dark_current_ref", "doubling_temperature_k"),
        values=np.array([current, math.log(2) / growth]),
        covariance=gradient @ covariance @ gradient.T,
        dof=np.full(2, dof),
        units=(unit, "K"),
        method=f"{METHOD}, T_ref = {reference_c:g} °C",
        confounders=("dark signal that does not come from the silicon: glow of the amplifier, a light leak",),
        reasons={name: reason for name in ("dark_current_ref", "doubling_temperature_k") if reason},
    )


def _checked(temperature_c: Array, dark_current: Array, u: Array) -> tuple[Array, Array, Array]:
    """The three arrays as floats, or the reason why they cannot be fitted."""
    t, y, s = (np.asarray(values, dtype=float) for values in (temperature_c, dark_current, u))
    if not (t.ndim == 1 and t.shape == y.shape == s.shape):
        raise InputError("temperatures, currents and u differ in shape", where=WHERE, value=(t.shape, y.shape, s.shape))
    if not (np.isfinite(t) & np.isfinite(y) & np.isfinite(s) & (s > 0)).all():
        raise InputError(
            "not finite, or an uncertainty that is not above zero", where=WHERE, remedy="leave out values that were not measured"
        )
    check_temperatures(t)
    return t, y, s


def check_temperatures(temperature_c: Array) -> None:
    """Refuse temperatures from which no law can follow.

    Raises
    ------
    MeasureError
        Fewer than three, or less than 10 K between the lowest and the highest.
    """
    different = 1 + int((np.diff(np.sort(temperature_c)) > DIFFERENT_K).sum()) if temperature_c.size else 0
    if different < MINIMUM_TEMPERATURES:
        raise MeasureError(
            "too few temperatures",
            where=WHERE,
            value=different,
            allowed=f"{MINIMUM_TEMPERATURES} or more",
            remedy="measure at another temperature, when the sensor's temperature is stable",
        )
    if np.ptp(temperature_c) < MINIMUM_RANGE_K:
        raise MeasureError(
            "the temperatures are too close to each other",
            where=WHERE,
            value=f"{np.ptp(temperature_c):.3g} K",
            allowed=f"{MINIMUM_RANGE_K:g} K or more from the lowest to the highest",
            remedy="heat or cool the camera further",
        )


def _model(t: Array, log_current: float, growth: float, s: Array) -> tuple[Array, Array]:
    """Currents by the law and their derivatives over u, shape (n, 2)."""
    model = np.exp(np.clip(log_current + growth * t, -700, 700))
    return model, np.stack([model, model * t], axis=1) / s[:, None]


def _solve(t: Array, y: Array, s: Array) -> tuple[float, float]:
    """Logarithm of the current at t = 0 and its growth: the growth by search, the current in closed form, then Gauss and Newton.

    For a given growth b the law is linear in its factor A: A = Σ w y e^(bt)/Σ w e^(2bt), and what is left is smallest where
    (Σ w y e^(bt))²/Σ w e^(2bt) is largest.
    """
    growths = math.log(2) / np.concatenate([np.geomspace(1.0, 100.0, 200), -np.geomspace(100.0, 1.0, 200)])
    shape = np.exp(growths[:, None] * t)
    weighted = shape / s**2
    across, along = weighted @ y, (weighted * shape).sum(axis=1)
    gain = np.where(across > 0, across**2 / along, -np.inf)
    best = int(np.argmax(gain))
    if not np.isfinite(gain[best]):
        raise MeasureError("no dark current above zero", where=WHERE, remedy="take dark frames at higher temperatures or longer exposures")
    log_current, growth = math.log(across[best] / along[best]), float(growths[best])
    for _ in range(20):
        model, jacobian = _model(t, log_current, growth, s)
        step = np.linalg.lstsq(jacobian, (y - model) / s, rcond=None)[0]
        step = step * min(1.0, 0.5 / max(abs(step[0]), 1e-12))
        log_current, growth = log_current + float(step[0]), growth + float(step[1])
    return log_current, growth


def law_at(fit: Estimates, temperature_c: Array, *, reference_c: float) -> Array:
    """Dark current by the law, shape as ``temperature_c``, in the unit of the fit.

    Parameters
    ----------
    fit : Estimates
        Of :func:`fit_dark_temperature`.
    temperature_c : ndarray
    reference_c : float
        That of the fit.
    """
    at, step = fit.select(["dark_current_ref", "doubling_temperature_k"]).values
    law: Array = at * 2.0 ** ((np.asarray(temperature_c, dtype=float) - reference_c) / step)
    return law


def reduce_dark_temperatures(groups: Sequence[PictureGroup], seen: Observations) -> Observations:
    """Dark current at every temperature, the campaign's own among them, and its law."""
    notes: list[str] = []
    currents = []
    by_temperature: dict[float, list[PictureGroup]] = {}
    usable: dict[float, list[PictureGroup]] = {}
    for group in groups:
        if group.facts.temperature_c is not None and group.moments.n_frames < 2:
            which = f"{group.facts.temperature_c:g} °C, exposure {group.exposure_s:g} s"
            notes.append(f"only 1 dark frame at {which}: it is left out, its noise is not told by one")
        elif group.facts.temperature_c is not None:
            near = next((t for t in by_temperature if abs(t - group.facts.temperature_c) <= DIFFERENT_K), group.facts.temperature_c)
            by_temperature.setdefault(near, []).append(group)
    for temperature, given in by_temperature.items():
        own = [g for g in given if g.moments.n_frames > 1]
        if len(own) < len(given):
            notes.append(f"dark frames at {temperature:g} °C: {len(given) - len(own)} groups of one frame are left out; take a second one")
        if not own:
            continue
        if any(g.moments.counts[0] > CLIPPED * g.moments.counts.sum() for g in own):
            notes.append(f"dark frames at {temperature:g} °C are left out: they are clipped at code 0; raise the black level")
            continue
        usable[temperature] = own
    wander2 = _wander2([g for own in usable.values() for g in own])
    dnl = 0.0 if seen.code_errors is None or "dnl_rms_lsb" not in seen.code_errors.fit else seen.code_errors.fit["dnl_rms_lsb"].value
    for temperature, own in usable.items():
        levels = np.array([g.moments.frame_means_dn().mean() for g in own])
        slope = _slope(np.array([g.exposure_s for g in own]), levels, np.array([_u_level(g, wander2, dnl) for g in own]))
        if slope is None:
            notes.append(f"dark frames at {temperature:g} °C are left out: one exposure time; take a second one, many times as long")
        else:
            rate, u = slope
            currents.append((temperature, rate, float(np.hypot(u, rate * _bend_rel(seen, float(np.ptp(levels)), own[0].bits)))))
    if seen.photon_transfer is not None and seen.temperature_c is not None and seen.photon_transfer.dark.mean_dn.size:
        dark = seen.photon_transfer.dark
        slope = _slope(dark.exposure_s, dark.mean_dn, np.sqrt(np.maximum(dark.ms_frame_dn2, 1e-12).mean() / dark.n_frames))
        if slope is not None and all(abs(seen.temperature_c - t) > DIFFERENT_K for t, _, _ in currents):
            currents.append((seen.temperature_c, *slope))
    table = np.array(sorted(currents)).reshape(-1, 3)
    reference = seen.temperature_c if seen.temperature_c is not None else float(table[:, 0].mean()) if len(table) else 20.0
    try:
        fit = fit_dark_temperature(*table.T, reference_c=reference, unit="DN/s")
        fit = replace(fit, reasons={**fit.reasons, **_of_the_gap(table, fit, reference)})
    except MeasureError as problem:
        why = problem.what + (f" (found {problem.value})" if problem.value is not None else "")
        fit = replace(Estimates.empty(), reasons={"doubling_temperature_k": "; to do: ".join(filter(None, (why, problem.remedy)))})
    found = DarkTemperatures(table[:, 0], table[:, 1], table[:, 2], reference, fit)
    return replace(seen, dark_temperatures=found, notes=(*seen.notes, *notes))


def _bend_rel(seen: Observations, signal_dn: float, bits: int) -> float:
    """What the response may add to a dark signal: as fitted to the light levels; else in proportion to the signal, as behind a bend."""
    known = seen.photon_transfer_fit is not None and "nonlinearity_a1" in seen.photon_transfer_fit
    return seen.bend_rel(signal_dn) * (1.0 if known else signal_dn / (2.0**bits - 1))


def _white2(group: PictureGroup) -> float:
    """Variance of the mean of a frame by the noise of its pixels, DN²."""
    moments = group.moments
    return float(moments.deviation_map_dn2().mean(dtype=float)) / (moments.n_frames - 1) / (moments.shape[0] * moments.shape[1])


def _wander2(groups: Sequence[PictureGroup]) -> float:
    """Variance of the means of frames beyond that of their pixels, over all groups, DN²."""
    if not groups:
        return 0.0
    dof = np.array([g.moments.n_frames - 1.0 for g in groups])
    beyond = [g.moments.frame_means_dn().var(ddof=1) - _white2(g) for g in groups]
    return max(float(np.average(beyond, weights=dof)), 0.0)


def _u_level(group: PictureGroup, wander2: float, dnl_lsb: float) -> float:
    """Standard uncertainty of the mean of a group: wander and pixels of its frames, and the converter's steps."""
    n, pixels = group.moments.n_frames, group.moments.shape[0] * group.moments.shape[1]
    white2 = _white2(group)
    spread = float(group.moments.mean_map_dn().var())
    steps = float(rounding_error_vars(np.array(white2 * pixels), spread, dnl_lsb)[0])
    return float(np.sqrt((wander2 + white2) / n + steps))


def _slope(times: np.ndarray, levels: np.ndarray, u: np.ndarray) -> tuple[float, float] | None:
    """Dark signal a second and its u, from levels at two exposure times or more; a scatter beyond u widens it."""
    if np.ptp(times) <= 0:
        return None
    weight = np.maximum(u, 1e-9) ** -2.0
    middle = weight @ times / weight.sum()
    slope = weight @ ((times - middle) * levels) / (weight @ (times - middle) ** 2)
    u_slope = float((weight @ (times - middle) ** 2) ** -0.5)
    off = levels - weight @ levels / weight.sum() - slope * (times - middle)
    freedom = np.unique(times).size - 2
    birge = float(np.sqrt(max(weight @ off**2 / freedom, 1.0))) if freedom > 0 else 1.0
    return float(slope), u_slope * birge


def _of_the_gap(table: np.ndarray, fit: Estimates, reference_c: float) -> dict[str, str]:
    """A remark if the law of the band gap, T^1.5 e^(−E/2kT), fits clearly better than a fixed doubling temperature."""
    from scipy.optimize import least_squares

    t, y, u = table.T
    kelvin = t + ZERO_C_K
    at, double = fit.select(["dark_current_ref", "doubling_temperature_k"]).values
    middle = float(kelvin.mean())
    gap = 2 * BOLTZMANN_EV_PER_K * middle**2 * (math.log(2) / double - 1.5 / middle)

    def residuals(values: np.ndarray) -> np.ndarray:
        log_rate, energy = values
        law = 1.5 * np.log(kelvin / middle) - energy / (2 * BOLTZMANN_EV_PER_K) * (1 / kelvin - 1 / middle)
        off: np.ndarray = (np.exp(np.clip(log_rate + law, -700, 700)) - y) / u
        return off

    start = math.log(max(at * 2 ** ((middle - ZERO_C_K - reference_c) / double), 1e-12))
    found = least_squares(residuals, [start, gap])
    doubled = float((((law_at(fit, t, reference_c=reference_c)) - y) ** 2 / u**2).sum())
    if doubled - 2 * found.cost < GAP_CHI2:
        return {}
    name = "doubling_temperature_k"
    over = f"over {t.min():g} to {t.max():g} °C"
    why = f"the law of the band gap fits better, with {found.x[1]:.3g} eV: the doubling temperature is a mean {over}"
    return {name: "; ".join(filter(None, (fit.reasons.get(name, ""), why)))}
