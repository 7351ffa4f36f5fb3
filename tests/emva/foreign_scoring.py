"""What an assessment and a data sheet say of a foreign camera, beside what is true of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from emva import truths as rules
from emva.foreign_cameras import ForeignCamera
from pixmetry.assess.job import measure_sources
from pixmetry.core.errors import PixmetryError
from pixmetry.emva.evaluate import evaluate
from pixmetry.emva.records import Measurement
from pixmetry.observe.observe import Group, observe

SKIPPED = ("index_", "shading_pp", "hot_", "cold_", "dead_", "gain_fraction", "noisy_", "frequency_", "moving", "hot_median")


@dataclass(frozen=True)
class Outcome:
    """Of one value: a value, an upper or a lower limit; its error over u, and whether interval or limit holds the truth."""

    name: str
    kind: str
    value: float
    u: float
    truth: float
    z: float
    holds: bool


def outcome(name: str, kind: str, value: float, u: float, dof: float, truth: float) -> Outcome:
    """Judge one value; a limit at the truth itself is true."""
    error, small = value - truth, 1e-9 * max(abs(truth), abs(value), 1e-300)
    z = 0.0 if abs(error) <= small else error / max(u, small)
    if kind == "value":
        return Outcome(name, kind, value, u, truth, z, bool(abs(z) <= stats.t.ppf(0.975, min(max(dof, 1.0), 1e9))))
    return Outcome(name, kind, value, u, truth, z, bool(error >= -small if kind == "upper_limit" else error <= small))


def groups(camera: ForeignCamera) -> Iterator[Group]:
    """The frames of a campaign."""
    streams = iter(range(1_000_000))
    exposure, photons = camera.settings
    for t, p in zip(exposure, photons, strict=True):
        yield Group("bright", "level", t, p, list(camera.frames(2, t, p, next(streams))))
    for t in camera.dark_exposures_s:
        yield Group("dark", "level", t, 0.0, list(camera.frames(2, t, 0.0, next(streams))))
    t, p = exposure[camera.stack_level], photons[camera.stack_level]
    for kind, light in (("dark", 0.0), ("bright", p)):
        yield Group(kind, "stack", t, light, list(camera.frames(camera.stack_frames, t, light, next(streams))))


def outcomes(camera: ForeignCamera, draws: int) -> tuple[list[Outcome], list[str]]:
    """All that is said of a camera, and what is missing with its reason."""
    seen = observe(groups(camera), camera.bits)
    estimates, _ = measure_sources(seen)
    sets = {"fit": seen.photon_transfer_fit, "spatial": seen.spatial_fit, **estimates}
    true, found, missing = physical_truths(camera), [], []
    for origin, some in sets.items():
        if some is None:
            missing.append(f"{origin}: nothing")
            continue
        for e in some:
            truth = true.get(e.name, np.nan)
            if e.kind == "lower_limit":  # the converter clips first
                truth = camera.full_well_e
            if not e.name.startswith(SKIPPED) and not np.isnan(truth):
                found.append(outcome(f"{origin} {e.name}", e.kind, e.value, e.u, e.dof, truth))
    bright, at = seen.bright_stack, camera.stack_level
    m = Measurement(seen.photon_transfer, seen.dark_stack, bright, camera.settings[1][at], pixel_area_um2=camera.pixel_area_um2)
    try:
        sheet = evaluate(m, "4.0", draws=draws)
    except PixmetryError as problem:
        return found, [*missing, f"no data sheet: {problem.what}"]
    by_rule = sheet_truths(camera)
    if "K_nonlinear" not in sheet.values:
        missing.append(f"no values with the non-linearity: {[n for n in sheet.notes if 'non-linearity taken' in n]}"[:160])
    for key, value in sheet.values.items():
        truth = by_rule.get(key, np.nan)
        if key.startswith(SKIPPED) or not np.isfinite(truth):
            continue
        if not np.isfinite(value.value):
            missing.append(f"{key}: {value.reason}"[:110])
            continue
        kind = value.kind if value.is_limit else "value"
        found.append(outcome(f"emva {key}", kind, value.value, value.u, value.dof, truth))
    return found, missing


def physical_truths(camera: ForeignCamera) -> dict[str, float]:
    """What the sources and the joint fits should find, by their names."""
    k, p, span = camera.gain_dn_per_e, camera.patterns, camera.top - camera.offset_dn
    one_time, dark_e = camera.light_swept, camera.dark_e_per_s * camera.longest_s
    eta = camera.quantum_efficiency * p["response"].mean()
    noise = float(np.sqrt(camera.read_e**2 + one_time * dark_e))
    offset = float(p["offset"].mean()) + one_time * k * dark_e
    rate = camera.settings[1][-1] / camera.longest_s
    out = {
        "gain_dn_per_e": k,
        "dark_noise_e": noise,
        "white_e": noise,
        "row_noise_e": camera.row_noise_e,
        "row_e": camera.row_noise_e,
        "column_noise_e": camera.col_noise_e,
        "column_e": camera.col_noise_e,
        "offset_dn": offset,
        "dark_current_e_per_s": camera.dark_e_per_s,
        "rate_e_per_s": camera.dark_e_per_s,
        "responsivity_dn_per_s": k * eta * rate,
        "quantum_efficiency": eta,
        "illumination_noise_rel": float(np.sqrt(camera.setting_rel**2 + camera.flicker_rel**2 / 2)),
        "full_well_e": min(camera.full_well_e, camera.clip_e) if not one_time else np.nan,
        "settling_dn": 0.0,
        "column_step_dn": 0.0,
        "dnl_std_lsb": 0.0,
        "dnl_rms_lsb": 0.0,
        "amplitude_dn": k * camera.wave_e,
    }
    terms = {"": (0.0, 0.0), "quadratic": (1.0, 0.0), "cubic": (0.0, 1.0)}
    if camera.bend in terms:
        for n, term in enumerate((*terms[camera.bend], 0.0), start=1):
            out[f"nonlinearity_a{n}"] = out[f"a{n}"] = -camera.bend_rel * term * (camera.top / span) ** n
    if not camera.bend:
        out["gamma"] = 1.0
    for name, parts, unit, scale in (("dsnu", camera.dsnu_e, "dn", k), ("prnu", camera.prnu_rel, "rel", 1.0)):
        for part, value in zip(("pixel", "row", "col", "total"), (*parts, np.linalg.norm(parts)), strict=True):
            out[f"{name}_{part}_{unit}"] = scale * value
    along_x, along_y, corner = paraboloid(p["light"])
    out |= {"shading_corner_rel": corner, "corner_rel": corner, "shading_x_per_px": along_x, "gradient_x_per_px": along_x}
    out |= {"shading_y_per_px": along_y, "gradient_y_per_px": along_y}
    return {name: float(value) for name, value in out.items()}


def sheet_truths(camera: ForeignCamera) -> dict[str, float]:
    """What Release 4.0's rules say of the noise-free images, and what the values with the non-linearity should be."""
    series = rules.levels(camera)
    k, p, physical = camera.gain_dn_per_e, camera.patterns, physical_truths(camera)
    out = rules.temporal(series, "4.0", camera.pixel_area_um2) | rules.spatial_4(camera)
    for part in ("", "_row", "_col", "_pixel"):
        out[f"DSNU1288{part}"] = out[f"DSNU1288{part}_DN"] / out["K"]
        if part:
            del out[f"DSNU1288{part}_DN"]
    if not camera.bend:
        out["PTC_linearity"] = 0.0 if series.dark_var[0] > 0.3 else np.nan
    if not camera.hot_share:  # the dark level of General is that of few levels, in which hot pixels differ
        out |= rules.general(series)
    noise = float(np.linalg.norm([physical["dark_noise_e"], camera.row_noise_e, camera.col_noise_e]))
    e_min = np.sqrt(noise**2 + 1 / 12 / k**2 + 0.25) + 0.5
    late = {"K": k, "inverse_K": 1 / k, "sigma_d": noise, "QE": 100 * physical["quantum_efficiency"], "u_e_min": e_min}
    late |= {"u_p_min": e_min / physical["quantum_efficiency"], "u_I_mean": camera.dark_e_per_s, "u_e_sat": physical["full_well_e"]}
    with np.errstate(invalid="ignore"):
        late |= {f"DSNU1288{part}": np.sqrt(value) / k for part, value in rules.strengths(p["offset"], 0).items()}
        late |= {f"PRNU1288{part}": 100 * np.sqrt(value) for part, value in rules.strengths(p["prnu"], 0).items()}
    return out | {f"{key}_nonlinear": value for key, value in late.items()}


def paraboloid(light: np.ndarray) -> tuple[float, float, float]:
    """Slopes at the centre of the polynomial of degree 4 through the light, and the loss to the corners of the paraboloid through it."""
    (rows, cols), level = light.shape, light.mean()
    y, x = np.mgrid[0:rows, 0:cols] - np.array([(rows - 1) / 2, (cols - 1) / 2])[:, None, None]
    smooth = rules.surface(light) / level
    right, left = smooth[:, cols // 2], smooth[:, cols // 2 - 1]
    low, high = smooth[rows // 2], smooth[rows // 2 - 1]
    r2 = (x**2 + y**2) / (x[0, 0] ** 2 + y[0, 0] ** 2)
    slope = np.polyfit(r2.ravel(), (light / level).ravel(), 1)[0]
    middle_x, middle_y = 0.5 * (right - left)[rows // 2 - 1 : rows // 2 + 1].sum(), 0.5 * (low - high)[cols // 2 - 1 : cols // 2 + 1].sum()
    return float(middle_x), float(middle_y), float(-slope)
