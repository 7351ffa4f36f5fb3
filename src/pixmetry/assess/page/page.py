"""The report of an assessment: one HTML file that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pixmetry import __version__
from pixmetry.report.numbers import significant
from pixmetry.report.templates import filled

if TYPE_CHECKING:
    from pixmetry.assess.results import Assessment
    from pixmetry.camera.observations import Storage
    from pixmetry.core.number import Estimates
    from pixmetry.files.records import Campaign

TRANSFER = ("transfer", "linearity", "snr", "dark-codes")


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
    return filled("page.html.jinja", _content(assessment))


def _content(assessment: Assessment) -> dict[str, Any]:
    from pixmetry.assess.page.budget_view import budget_content
    from pixmetry.assess.page.figures import all_pictures
    from pixmetry.assess.page.measured import table
    from pixmetry.assess.page.twin_view import twin_content

    seen = assessment.observations
    pictures = all_pictures(seen, assessment.standard, assessment.maps())
    return budget_content(assessment.budget, assessment.unmeasured) | {
        "version": __version__,
        "name": assessment.campaign.camera.name,
        "facts": _facts(assessment),
        "transfer": [pictures[name] for name in TRANSFER if name in pictures],
        "noise": [p for name, p in pictures.items() if name not in TRANSFER],
        "values": table(seen, assessment.standard),
        **twin_content(assessment.self_test),
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
        pitch = f"{facts.pitch_x_um:g} × {facts.pitch_y_um or facts.pitch_x_um:g} µm"
    dark, bright = (sum(len(g.paths) for g in campaign.groups if g.kind == kind) for kind in ("dark", "bright"))
    temperature = "not given" if facts.temperature_c is None else f"{significant(facts.temperature_c)} °C"
    return [
        *_named(assessment),
        ("Frame", f"{cols} × {rows} pixels, {facts.bits} bits"),
        *_whole_sensor(campaign),
        ("Pixel pitch", pitch),
        ("Interface, sensor", f"{facts.interface}, {facts.sensor.upper() if facts.sensor else 'sensor not given'}"),
        ("Temperature", temperature),
        ("Frames read", f"{dark} dark, {bright} bright"),
        ("Stored", _stored(assessment.observations.storage)),
        ("Assessed (UTC)", assessment.provenance["time_utc"].replace("T", " ")[:16]),
    ]


def _named(assessment: Assessment) -> list[tuple[str, str]]:
    """What the manifest says of camera and measurement, as far as it does."""
    campaign, facts = assessment.campaign, assessment.campaign.camera
    known = {
        "Vendor, model": ", ".join(filter(None, (facts.vendor, facts.model))),
        "Serial number": facts.serial_number,
        "Light source": campaign.optics.light_source,
        "Operator": campaign.operator,
    }
    return [(label, text) for label, text in known.items() if text]


def _whole_sensor(campaign: Campaign) -> list[tuple[str, str]]:
    facts = campaign.camera
    if facts.sensor_shape is None:
        return []
    at = "" if facts.first_col is None else f", the frame from column {facts.first_col}, row {facts.first_row}"
    return [("Sensor", f"{facts.sensor_cols} × {facts.sensor_rows} pixels{at}")]


def _stored(storage: Storage) -> str:
    """Whether a lossy coder changed the frames, and how that is known."""
    what = {True: "without loss", False: "with loss", None: "not known whether without loss"}[storage.lossless]
    return {"proven": f"{what}, by the files", "stated": f"{what}, as stated"}.get(storage.known, what)


def _notes(assessment: Assessment) -> list[str]:
    own = [assessment.campaign.notes] if assessment.campaign.notes else []
    return [*own, *assessment.observations.notes]


def _shared(assessment: Assessment) -> list[Estimates]:
    """The estimates that many sources read."""
    seen = assessment.observations
    return [s for s in (seen.photon_transfer_fit, seen.spatial_fit) if s is not None]


def _confounders(assessment: Assessment) -> list[str]:
    """What the shared estimates could be mistaken for, then what each source adds to that."""
    from pixmetry.camera.catalogue import get_source

    shared = [c for s in _shared(assessment) for c in s.confounders]
    own = [f"{get_source(source_id).title}: {c}" for source_id, s in assessment.estimates.items() for c in s.confounders if c not in shared]
    return list(dict.fromkeys([*shared, *own]))


def _methods(assessment: Assessment) -> list[str]:
    """Each method once; that of a source only where it is not made of a shared one."""
    from pixmetry.camera.catalogue import get_source

    shared = [*(s.method for s in _shared(assessment)), assessment.standard.values["K"].method]
    own = [
        f"{get_source(source_id).title}: {s.method}"
        for source_id, s in assessment.estimates.items()
        if s.method and not any(m in s.method or s.method in m for m in shared)
    ]
    return list(dict.fromkeys([*shared, *own]))


def _provenance(record: dict[str, Any]) -> list[tuple[str, str]]:
    libraries = ", ".join(f"{name} {version}" for name, version in record["libraries"].items())
    return [
        ("pixmetry", record["pixmetry"]),
        ("Python", record["python"]),
        ("Libraries", libraries),
        ("Platform", record["platform"]),
        ("Seed of the Monte Carlo", "none" if record["seed"] is None else str(record["seed"])),
        ("Time (UTC)", record["time_utc"].replace("T", " ").removesuffix("+00:00")),
    ]
