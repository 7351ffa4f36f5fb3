"""The report of an assessment: one HTML file that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pixmetry import __version__
from pixmetry.report.numbers import significant

if TYPE_CHECKING:
    from pixmetry.results import Assessment

TRANSFER = ("transfer", "linearity", "snr")


def write_report(assessment: Assessment, path: str | Path) -> Path:
    """Write the page of an assessment.

    Parameters
    ----------
    assessment : Assessment
    path : path
        Of the HTML file; an existing one is replaced.

    Returns
    -------
    Path
    """
    path = Path(path)
    path.write_text(render(assessment), encoding="utf-8")
    return path


def render(assessment: Assessment) -> str:
    """Return the page of an assessment as text."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pixmetry.report", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html.jinja").render(**_content(assessment))


def _content(assessment: Assessment) -> dict[str, Any]:
    from pixmetry.report.budget_view import budget_content
    from pixmetry.report.figures import all_pictures
    from pixmetry.report.measured import table

    seen = assessment.observations
    pictures = all_pictures(seen, assessment.standard, assessment.maps())
    return budget_content(assessment.budget, assessment.unmeasured) | {
        "version": __version__,
        "name": assessment.campaign.camera.name,
        "facts": _facts(assessment),
        "transfer": [pictures[name] for name in TRANSFER],
        "noise": [p for name, p in pictures.items() if name not in TRANSFER],
        "values": table(seen, assessment.standard),
        "notes": _notes(assessment),
        "confounders": _confounders(assessment),
        "methods": _methods(assessment),
        "provenance": _provenance(assessment.provenance),
        "command": " ".join(assessment.provenance["command"]),
        "licence": assessment.campaign.licence,
        "inputs": assessment.provenance["inputs"],
    }


def _facts(assessment: Assessment) -> list[tuple[str, str]]:
    campaign, facts = assessment.campaign, assessment.campaign.camera
    rows, cols = campaign.frame_shape
    pitch = "not given"
    if facts.pitch_x_um is not None:
        pitch = f"{significant(facts.pitch_x_um)} × {significant(facts.pitch_y_um or facts.pitch_x_um)} µm"
    dark, bright = (sum(len(g.paths) for g in campaign.groups if g.kind == kind) for kind in ("dark", "bright"))
    temperature = "not given" if facts.temperature_c is None else f"{significant(facts.temperature_c)} °C"
    return [
        ("Frame", f"{cols} × {rows} pixels, {facts.bits} bits"),
        ("Pixel pitch", pitch),
        ("Interface, sensor", f"{facts.interface}, {(facts.sensor or 'not given').upper() if facts.sensor else 'sensor not given'}"),
        ("Temperature", temperature),
        ("Frames read", f"{dark} dark, {bright} bright"),
        ("Assessed (UTC)", assessment.provenance["time_utc"].replace("T", " ")[:16]),
    ]


def _notes(assessment: Assessment) -> list[str]:
    own = [assessment.campaign.notes] if assessment.campaign.notes else []
    return [*own, *assessment.observations.notes]


def _sets(assessment: Assessment) -> list[Any]:
    seen = assessment.observations
    sets = [seen.photon_transfer_fit, seen.spatial_fit, *assessment.estimates.values(), assessment.standard]
    return [s for s in sets if s is not None]


def _confounders(assessment: Assessment) -> list[str]:
    return list(dict.fromkeys(c for s in _sets(assessment) for c in s.confounders))


def _methods(assessment: Assessment) -> list[str]:
    return list(dict.fromkeys(part for s in _sets(assessment) for part in s.method.split("; ", 1) if part))


def _provenance(record: dict[str, Any]) -> list[tuple[str, str]]:
    libraries = ", ".join(f"{name} {version}" for name, version in record["libraries"].items())
    return [
        ("pixmetry", record["pixmetry"]),
        ("Python", record["python"]),
        ("Libraries", libraries),
        ("Platform", record["platform"]),
        ("Seed of the Monte Carlo", "none" if record["seed"] is None else str(record["seed"])),
        ("Time (UTC)", record["time_utc"]),
    ]
