"""Dark current against temperature: its law, and campaigns of one camera at several temperatures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import Estimates, Number
from pixmetry.core.progress import Progress
from pixmetry.emva.files.keys import OVER_TEMPERATURES
from pixmetry.emva.files.sheets import check_names, named
from pixmetry.emva.job import Options, tested, write_sheet
from pixmetry.emva.records import DataSheet
from pixmetry.files import Campaign, load_campaign

MINIMUM_TEMPERATURES = 3
MINIMUM_RANGE_K = 10.0
DIFFERENT_K = 0.5  # temperatures that lie nearer are one
RESOLVED = 3.0  # u between the growth and zero
CONTRADICTION_Z = 3.09  # scatter beyond the stated u that is met by chance once in a thousand
WHERE = "dark current against temperature"
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


def dark_current_law(
    campaigns: Sequence[str | Path | Campaign],
    *,
    release: str = "4.0",
    bayer: str | None = None,
    photons_u_rel: float = 0.0,
    bootstrap: int = 0,
    progress: Progress | None = None,
    json: str | Path | None = None,
    xml: str | Path | None = None,
    report: str | Path | None = None,
    pdf: str | Path | None = None,
) -> tuple[DataSheet, Estimates]:
    """Test a camera at several temperatures; parameters as of `pixmetry.emva1288`.

    Returns
    -------
    tuple
        The data sheet of the first campaign, with the values ``u_I_ref`` and ``T_d``, the curve ``dark_temperature`` and the files of all
        campaigns among its inputs, and the law of the dark current (of the first channel) as
        `pixmetry.emva.dark_temperature.fit_dark_temperature` gives it, for the temperature of the first campaign.

    Raises
    ------
    InputError, MeasureError
        As from `pixmetry.emva1288`; before any frame is read, if a temperature is not known, there are fewer than three, or they are too
        near to each other; and if a campaign gives no dark current.
    """
    options = Options(release, bayer, photons_u_rel, bootstrap)
    files = named(json=json, xml=xml, report=report, pdf=pdf)
    check_names(files)
    loaded = [c if isinstance(c, Campaign) else load_campaign(c) for c in campaigns]
    _check_same_camera(loaded, bayer)
    temperature_c = np.array([_temperature_c(c) for c in loaded])
    check_temperatures(temperature_c)
    inputs = [path for c in loaded for path in c.files]
    check_names(files, inputs)
    sheets, currents = [], []
    for campaign in loaded:
        sheets.append(tested(campaign, options, progress))
        currents.append(_current(sheets[-1], campaign))
    sheet, law = _with_law(sheets[0], temperature_c, currents)
    names = list(dict.fromkeys(c.camera.name for c in loaded))
    if len(names) > 1:
        note = f"the data sets at different temperatures name different cameras: {', '.join(names)}"
        sheet = replace(sheet, results=tuple(replace(r, notes=(*r.notes, note)) for r in sheet.results))
    sheet = replace(sheet, provenance={**sheet.provenance, "inputs": _inputs(loaded, sheets)})
    write_sheet(sheet, files, inputs, progress)
    return sheet, law


def _check_same_camera(campaigns: Sequence[Campaign], bayer: str | None) -> None:
    """Refuse campaigns that cannot be of one camera."""
    for campaign in campaigns[1:]:
        for what, (found, first) in {
            "size of the frames": (campaign.frame_shape[::-1], campaigns[0].frame_shape[::-1]),
            "bits": (campaign.bits, campaigns[0].bits),
            "colour filter": (bayer or campaign.camera.cfa, bayer or campaigns[0].camera.cfa),
        }.items():
            if found != first:
                raise InputError(
                    f"another camera: the {what} differs from that of {campaigns[0].source_path}",
                    where=str(campaign.source_path),
                    value=found,
                    allowed=str(first),
                    remedy="name campaigns of one camera",
                )


def _temperature_c(campaign: Campaign) -> float:
    found = campaign.camera.temperature_c
    if found is None:
        remedy = "write camera: temperature_c into its manifest"
        raise InputError("the temperature is not known", where=str(campaign.source_path), remedy=remedy)
    return found


def _current(sheet: DataSheet, campaign: Campaign) -> Number:
    found = sheet.results[0].values["u_I_mean"]
    if not (math.isfinite(found.value) and found.u > 0):
        remedy = "take dark levels at three exposure times or more, or leave this campaign out"
        raise MeasureError("no dark current was measured", where=str(campaign.source_path), value=found.reason or None, remedy=remedy)
    return found


def _with_law(sheet: DataSheet, temperature_c: Array, currents: Sequence[Number]) -> tuple[DataSheet, Estimates]:
    """Fit the dark currents against temperature, and add values, curve and a note to the sheet of the first temperature."""
    current, u = np.array([v.value for v in currents]), np.array([v.u for v in currents])
    reference_c = float(temperature_c[0])
    law = fit_dark_temperature(temperature_c, current, u, reference_c=reference_c)
    found = dict(zip(OVER_TEMPERATURES, (law["dark_current_ref"], law["doubling_temperature_k"]), strict=True))
    values = {key: replace(e, name="") for key, e in found.items()}
    curve = {
        "temperature_c": temperature_c,
        "current_e_per_s": current,
        "u_e_per_s": u,
        "fit_e_per_s": law_at(law, temperature_c, reference_c=reference_c),
        "doubling_k": np.array([values["T_d"].value]),
    }
    first, *others = sheet.results
    temperatures = ", ".join(f"{t:g}" for t in temperature_c)
    note = f"u_I_ref, the dark current at {reference_c:g} °C, and T_d follow from {len(currents)} data sets, at {temperatures} °C"
    curves, notes = {**first.curves, "dark_temperature": curve}, (*first.notes, note)
    first = replace(first, values={**first.values, **values}, curves=curves, notes=notes)
    return replace(sheet, results=(first, *others)), law


def _inputs(campaigns: Sequence[Campaign], sheets: Sequence[DataSheet]) -> list[dict[str, object]]:
    """Records of the files of all campaigns, named by the last name of their folder, numbered where two are the same."""
    bases = list(dict.fromkeys(c.base for c in campaigns))
    names = [base.resolve().name for base in bases]
    labels = {base: name if names.count(name) == 1 else f"{name}-{k}" for k, (base, name) in enumerate(zip(bases, names, strict=True), 1)}
    found = {}
    for campaign, sheet in zip(campaigns, sheets, strict=True):
        for record in sheet.provenance["inputs"]:
            name = f"{labels[campaign.base]}/{record['name']}"
            found[name] = {**record, "name": name}
    return list(found.values())
