"""How the dark current doubles with temperature, from data sheets taken at several temperatures."""

from __future__ import annotations

import math

import numpy as np

from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates

MINIMUM_TEMPERATURES = 3
MINIMUM_RANGE_K = 10.0
DIFFERENT_K = 0.5  # temperatures that lie nearer are one
RESOLVED = 3.0  # u between the growth and zero
CONTRADICTION_Z = 3.09  # scatter beyond the stated u that is met by chance once in a thousand
WHERE = "dark current against temperature"
METHOD = "weighted least squares of µ_I(T) = µ_ref 2^((T − T_ref)/T_d) (EMVA 1288 R4.0 eq. 31)"


def fit_dark_temperature(
    temperature_c: np.ndarray,
    dark_current: np.ndarray,
    u: np.ndarray,
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
        Fewer than three temperatures, less than 10 K between them, or a current that does not grow with temperature.

    Notes
    -----
    The law is fitted to the currents, not to their logarithms: a current near zero is as likely negative as positive, and without the
    negative ones the others would be too large.
    """
    t, y, s = _checked(temperature_c, dark_current, u)
    log_current, growth = _solve(t - t.mean(), y, s)
    model, jacobian = _model(t - t.mean(), log_current, growth, s)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    nu, dof, reason = t.size - 2, math.inf, ""
    chi2 = float((((y - model) / s) ** 2).sum())
    if chi2 > nu * (1 - 2 / (9 * nu) + CONTRADICTION_Z * math.sqrt(2 / (9 * nu))) ** 3:  # Wilson & Hilferty 1931
        covariance, dof = covariance * chi2 / nu, float(nu)
        reason = f"the currents scatter about the law by {math.sqrt(chi2 / nu):.2g} times their u, so that u is widened by that"
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


def _checked(temperature_c: np.ndarray, dark_current: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The three arrays as floats, or the reason why they cannot be fitted."""
    t, y, s = (np.asarray(values, dtype=float) for values in (temperature_c, dark_current, u))
    if not (t.ndim == 1 and t.shape == y.shape == s.shape):
        raise InputError("temperatures, currents and u differ in shape", where=WHERE, value=(t.shape, y.shape, s.shape))
    if not (np.isfinite(t) & np.isfinite(y) & np.isfinite(s) & (s > 0)).all():
        raise InputError("not finite, or an uncertainty that is not above zero", where=WHERE, remedy="leave out what was not measured")
    check_temperatures(t)
    return t, y, s


def check_temperatures(temperature_c: np.ndarray) -> None:
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
            remedy="measure at one temperature more, with the sensor's temperature settled",
        )
    if np.ptp(temperature_c) < MINIMUM_RANGE_K:
        raise MeasureError(
            "the temperatures lie too near to each other",
            where=WHERE,
            value=f"{np.ptp(temperature_c):.3g} K",
            allowed=f"{MINIMUM_RANGE_K:g} K or more from the lowest to the highest",
            remedy="heat or cool the camera further",
        )


def _model(t: np.ndarray, log_current: float, growth: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Currents by the law and their derivatives over u, shape (n, 2)."""
    model = np.exp(np.clip(log_current + growth * t, -700, 700))
    return model, np.stack([model, model * t], axis=1) / s[:, None]


def _solve(t: np.ndarray, y: np.ndarray, s: np.ndarray) -> tuple[float, float]:
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


def law_at(fit: Estimates, temperature_c: np.ndarray, *, reference_c: float) -> np.ndarray:
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
    return at * 2.0 ** ((np.asarray(temperature_c, dtype=float) - reference_c) / step)
