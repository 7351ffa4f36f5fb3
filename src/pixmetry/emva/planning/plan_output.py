"""A plan for people to read, and the manifest that waits for its frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pixmetry.core.errors import InputError
from pixmetry.emva.files.keys import KEYS
from pixmetry.emva.files.rules import FIT_RANGE
from pixmetry.emva.planning.known_camera import KnownCamera
from pixmetry.emva.planning.planning import STACK_LEVEL, TOP, Plan, predicted_u

CAMPAIGN_SCHEMA = "pixmetry/campaign/1"
_NAMES = {
    "levels": "bright levels",
    "dark_levels": "dark levels",
    "frames_per_level": "frames per level",
    "stack_frames": "frames per stack",
}


def parse_wanted(camera: KnownCamera, texts: Sequence[str]) -> dict[str, float]:
    """Read wishes such as ``K=0.2%`` (of the expected value), ``sigma_d=0.05`` or ``PRNU1288=0.01%`` (its own unit is %).

    Returns
    -------
    dict
        Wanted u by key, in the key's unit.

    Raises
    ------
    InputError
        If one cannot be read, or is relative to a value that is not known.
    """
    wanted = {}
    for text in texts:
        key, _, number = (part.strip() for part in text.partition("="))
        try:
            value = float(number.removesuffix("%"))
        except ValueError:
            raise InputError("a wanted u cannot be read", value=text, allowed="KEY=NUMBER or KEY=NUMBER%", remedy="e.g. K=0.2%") from None
        if number.endswith("%") and key in KEYS and KEYS[key].unit != "%":
            expected = camera.values.get(key, 0.0)
            if not expected > 0:
                remedy = f"give it in {KEYS[key].unit}"
                raise InputError("a relative u of a value that is not known, or zero", where="wanted u", value=text, remedy=remedy)
            value *= expected / 100
        wanted[key] = value
    return wanted


def plan_text(camera: KnownCamera, plan: Plan, wanted: Mapping[str, float] | None = None) -> str:
    """What to take, why as much, and the uncertainties to expect."""
    wanted = wanted or {}
    what = "exposure swept at constant light" if plan.sweep == "exposure" else "light swept at constant exposure"
    lines = [f"Test by EMVA 1288, {what}", ""]
    for name, title in _NAMES.items():
        if name != "dark_levels" or plan.sweep == "light":
            lines.append(f"  {title:<18}{getattr(plan, name):>6}   {plan.drivers.get(name, 'as given')}")
    duration = plan.duration_s(camera)
    pace = "at this frame rate, without changes of the set-up" if camera.frame_rate_hz else "of exposure"
    time = "" if duration is None else f", {_time(duration)} {pace}"
    lines += ["", f"  {plan.n_frames} frames in all{time}", "", *_where(camera, plan), ""]
    lines += [*_table(camera, plan, wanted), *_taken_as(camera)]
    if plan.stack_frames < 100:
        lines += ["", "Stacks of 100 to 400 frames are customary; no wish that can be met asks for as many."]
    for key, why in plan.unreachable.items():
        lines += ["", f"Cannot be reached: u({key}) = {wanted.get(key, math.nan):.3g} {KEYS[key].unit}: {why}."]
    return "\n".join(lines) + "\n"


def _where(camera: KnownCamera, plan: Plan) -> list[str]:
    """Exposures in words; as shares of saturation where the time is not known."""
    scale, unit = (camera.exposure_sat_s, " s") if camera.exposure_sat_s else (1.0, " of the saturation exposure")
    dark, stack = plan.dark_fractions * scale, plan.stack_exposure * scale
    bright = f"at signals from {100 * plan.fractions[0]:.2g} % to {100 * TOP:g} % of saturation, evenly spaced"
    fitted = int((plan.fractions <= FIT_RANGE).sum())
    return [
        f"  bright levels {bright} ({fitted} of them up to {100 * FIT_RANGE:g} %, for K)",
        f"  dark levels   at {dark.size} exposures from {dark[0]:.4g} to {dark[-1]:.4g}{unit}",
        f"  stacks        bright at half of saturation, dark, both at {stack:.4g}{unit}",
    ]


def _table(camera: KnownCamera, plan: Plan, wanted: Mapping[str, float]) -> list[str]:
    values = camera.values
    rows = [f"  {'value':<16}{'expected':>10}{'u':>10}{'wanted u':>10}  unit"]
    for key, u in predicted_u(camera, plan).items():
        wish = f"{wanted[key]:.3g}" if key in wanted else ""
        found = "bound only" if math.isinf(u) else f"{u:.2g}"
        missed = "   not reached" if u > wanted.get(key, math.inf) else ""
        rows.append(f"  {key:<16}{values[key]:>10.4g}{found:>10}{wish:>10}  {KEYS[key].unit:<10}{missed}".rstrip())
    return rows


def _taken_as(camera: KnownCamera) -> list[str]:
    """What beyond noise the prediction counts with."""
    taken = []
    if camera.var_excess_rel > 0:
        taken.append(f"variances that scatter by {100 * camera.var_excess_rel:.2g} % beyond sampling")
    if camera.light_scatter_rel > 0:
        taken.append(f"light that scatters by {100 * camera.light_scatter_rel:.2g} %")
    if camera.coherence > 1:
        taken.append(f"noise in mean images that scatters {math.sqrt(camera.coherence):.2g} times as much as white noise")
    return ["", "u counts with " + ", ".join(taken) + "."] if taken else []


def _time(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 100 else f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"


def write_campaign(
    camera: KnownCamera, plan: Plan, path: str | Path, *, name: str = "camera", cfa: str | None = None, suffix: str = ".tif"
) -> None:
    """Write the manifest of the campaign to be taken: it loads as soon as the frames lie beside it under the names it gives.

    Parameters
    ----------
    camera : KnownCamera
        Of a mosaic, the channel that was planned for.
    plan : Plan
    path : path
    name, cfa : str
        Name and colour filter of the camera.
    suffix : str
        Ending of the frames' names.

    Raises
    ------
    InputError
        If the exposure at saturation is not known, or, in a sweep of the light, the quantum efficiency.
    """
    from pixmetry.core.config import dump_yaml

    dump_yaml(manifest(camera, plan, name=name, cfa=cfa, suffix=suffix), path)


def manifest(camera: KnownCamera, plan: Plan, *, name: str = "camera", cfa: str | None = None, suffix: str = ".tif") -> dict[str, Any]:
    """The manifest as plain data; raises as ``write_campaign`` does."""
    if camera.exposure_sat_s is None:
        raise InputError("exposures are not known", where="plan", remedy="give the exposure time at which the light saturates the camera")
    light_swept = plan.sweep == "light"
    if light_swept and camera.quantum_efficiency is None:
        raise InputError("levels of a light sweep are told apart by their photons", where="plan", remedy="give the quantum efficiency")
    photons_sat = camera.saturation_e / camera.quantum_efficiency if light_swept and camera.quantum_efficiency else math.nan
    stack_s = plan.stack_exposure * camera.exposure_sat_s
    groups = [_group("dark", "level", i, float(t) * camera.exposure_sat_s, math.nan, suffix) for i, t in enumerate(plan.dark_fractions, 1)]
    groups.append(_group("dark", "stack", None, stack_s, math.nan, suffix))
    groups += [
        _group("bright", "level", i, float(t) * camera.exposure_sat_s, float(p), suffix)
        for i, (t, p) in enumerate(zip(plan.bright_exposures, photons_sat * plan.fractions, strict=True), 1)
    ]
    groups.append(_group("bright", "stack", None, stack_s, STACK_LEVEL * photons_sat, suffix))
    notes = (
        f"Planned: {plan.frames_per_level} frames in each level, {plan.stack_frames} in each stack; * in a name stands for their numbers. "
        "Write the exposures that the camera really took, and the photons per pixel (or irradiance_uw_per_cm2) that were measured"
        + (": those given here are expectations." if light_swept else ".")
    )
    facts = {"name": name, "bits": camera.bits} | ({} if cfa is None else {"cfa": cfa})
    return {"schema": CAMPAIGN_SCHEMA, "camera": facts, "frames": groups, "notes": notes}


def _group(kind: str, role: str, index: int | None, exposure_s: float, photons: float, suffix: str) -> dict[str, Any]:
    stem = f"{kind}_{role}" if index is None else f"{kind}_{role}_{index:03d}"
    group: dict[str, Any] = {"kind": kind, "role": role, "exposure_s": float(f"{exposure_s:.9g}"), "files": f"frames/{stem}_*{suffix}"}
    if math.isfinite(photons):
        group["photons"] = float(f"{photons:.6g}")
    return group
