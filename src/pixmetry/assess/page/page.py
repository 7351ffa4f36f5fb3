"""The page of an assessment."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from pixmetry.files.records import KINDS
from pixmetry.report import Column, Page, Points, Row, Section, Table, html_of
from pixmetry.report.numbers import NONE, significant
from pixmetry.report.provenance import provenance_section

if TYPE_CHECKING:
    from pixmetry.assess.results import Assessment
    from pixmetry.camera.observations import Storage
    from pixmetry.core.number import Estimates
    from pixmetry.files.records import Campaign

TRANSFER = ("transfer", "linearity", "snr", "dark-codes")
FOOTER = "All lengths are standard uncertainties (k = 1) unless they say otherwise; x runs along rows, y along columns."
VALUES = (
    "Value ± standard uncertainty (k = 1, two significant digits) with its degrees of freedom; “<” is a one-sided 95 % limit. The last "
    "number is that of EMVA 1288 Release 3.1 from the same frames: its gain is the slope of a straight line up to 70 % of saturation, its "
    "dark noise holds row and column noise too, its PRNU the unevenness of the light."
)


def write_report(assessment: Assessment, path: str | Path) -> Path:
    """Write the page of an assessment as HTML.

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
    path.write_text(html_of(page_of(assessment)), encoding="utf-8")
    return path


def page_of(assessment: Assessment) -> Page:
    """The page of an assessment.

    Parameters
    ----------
    assessment : Assessment

    Returns
    -------
    Page
    """
    from pixmetry.assess.page import budget_view

    budget, name = assessment.budget, assessment.campaign.camera.name
    page = Page(name, "uncertainty of its image coordinates", "pixmetry camera assessment", _facts(assessment), FOOTER)
    page.sections += [
        budget_view.verdict_section(budget, assessment.crop),
        budget_view.largest_section(budget),
        _plots(assessment),
        _values(assessment),
        *_pictures(assessment),
        budget_view.sources_section(budget, assessment.unmeasured),
        budget_view.sum_section(budget),
        _words(assessment),
    ]
    if (origin := provenance_section(assessment.provenance, assessment.campaign.licence)) is not None:
        page.sections.append(origin)
    return page


def _plots(assessment: Assessment) -> Section:
    from pixmetry.assess.page.figures import all_pictures

    pictures = all_pictures(assessment.observations, assessment.standard, assessment.maps())
    section = Section("What the frames show", name="plots")
    section.add_section("Photon transfer and codes", *(pictures[name] for name in TRANSFER if name in pictures))
    if noise := [p for name, p in pictures.items() if name not in TRANSFER]:
        section.add_section("Noise and fixed pattern", *noise)
    return section


def _pictures(assessment: Assessment) -> list[Section]:
    """A section for each kind of pictures."""
    from pixmetry.assess.page.active_area import area_section
    from pixmetry.assess.page.bands import bands_section
    from pixmetry.assess.page.blocks import blocks_section
    from pixmetry.assess.page.covered import covered_section
    from pixmetry.assess.page.dark_temperature import dark_temperature_section
    from pixmetry.assess.page.edges import edges_section
    from pixmetry.assess.page.light_off import light_off_section
    from pixmetry.assess.page.lines import lines_section
    from pixmetry.assess.page.response import response_section
    from pixmetry.assess.page.sequence import dark_rows_section, sequence_section
    from pixmetry.assess.page.speckle import speckle_section
    from pixmetry.assess.page.spots import spots_section
    from pixmetry.assess.page.views import views_section
    from pixmetry.series.page import drift_section, motion_section, recordings_section

    seen = assessment.observations
    return [
        *([] if seen.edges is None else [edges_section(seen.edges)]),
        *([] if seen.response is None else [response_section(seen.response)]),
        *([] if seen.lines is None else [lines_section(seen.lines)]),
        *([] if seen.spots is None else [spots_section(seen.spots)]),
        *([] if seen.blocks is None else [blocks_section(seen.blocks, seen.storage)]),
        *([] if seen.dark_temperatures is None else [dark_temperature_section(seen.dark_temperatures)]),
        *([] if seen.area is None else [area_section(seen.area)]),
        *([] if seen.covered is None else [covered_section(seen.covered)]),
        *([] if seen.light_off is None else [light_off_section(seen.light_off)]),
        *([] if seen.dark_rows is None else [dark_rows_section(seen.dark_rows)]),
        *([] if seen.sequences is None else [sequence_section(seen.sequences)]),
        *([] if seen.drift is None else [drift_section(seen.drift)]),
        *([] if seen.motion is None else [motion_section(seen.motion)]),
        *([] if seen.recordings is None else [recordings_section(seen.recordings)]),
        *([] if seen.speckle is None else [speckle_section(seen.speckle)]),
        *([] if seen.views is None else [views_section(seen.views)]),
        *([] if seen.bands is None else [bands_section(seen.bands)]),
    ]


def _values(assessment: Assessment) -> Section:
    from pixmetry.assess.page.measured import table, twin_section

    rows: list[Row] = []
    for heading, found in table(assessment.observations, assessment.standard).items():
        rows.append(Row([heading], heading=True))
        for r in found:
            u = "" if r.number.u == NONE else f"± {r.number.u}"
            rows.append(Row([r.title, r.number.value, u, r.number.unit, r.dof, r.standard], r.reason))
    columns: list[Column | str] = ["Quantity", Column("Value", "right"), Column("± u", "u"), Column("Unit", "unit"), Column("dof", "right")]
    section = Section("Measured camera values", name="values").add_text(VALUES, style="small soft")
    section.add(Table("Measured camera values", [*columns, Column("EMVA 1288, R3.1", "unit")], rows))
    return section.add(twin_section(assessment.self_test))


def _words(assessment: Assessment) -> Section:
    """Notes, confounders, methods."""
    section = Section("Notes, and what the numbers could be mistaken for", name="notes")
    if notes := _notes(assessment):
        section.add(Points(notes, style=""))
    for title, items in (("Could be mistaken for", _confounders(assessment)), ("Methods", _methods(assessment))):
        if items:
            section.add_section(title, Points(items))
    return section


def _facts(assessment: Assessment) -> list[tuple[str, str]]:
    campaign, facts = assessment.campaign, assessment.campaign.camera
    rows, cols = campaign.frame_shape
    pitch = "not given"
    if facts.pitch_x_um is not None:
        pitch = f"{facts.pitch_x_um:g} × {facts.pitch_y_um or facts.pitch_x_um:g} µm"
    counts = Counter({kind: 0 for kind in KINDS})
    for group in campaign.groups:
        counts[group.kind] += len(group.paths)
    temperature = "not given" if facts.temperature_c is None else f"{significant(facts.temperature_c)} °C"
    return [
        *_named(assessment),
        ("Frame", f"{cols} × {rows} pixels, {facts.bits} bits"),
        *_whole_sensor(campaign),
        ("Pixel pitch", pitch),
        ("Interface, sensor", f"{facts.interface}, {facts.sensor.upper() if facts.sensor else 'sensor not given'}"),
        ("Temperature", temperature),
        ("Frames read", ", ".join(f"{n} {kind}" if kind in KINDS else f"{n} of kind {kind}" for kind, n in counts.items())),
        ("Stored", _stored(assessment.observations.storage)),
        ("Assessed (UTC)", assessment.provenance["time_utc"].replace("T", " ")[:16]),
    ]


def _named(assessment: Assessment) -> list[tuple[str, str]]:
    """Camera and measurement as stated in the manifest."""
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
    optics = None if seen.edges is None or not len(seen.edges.optics) else seen.edges.optics
    response = None if seen.response is None or not seen.response.curve else seen.response.fit
    return [s for s in (seen.photon_transfer_fit, seen.spatial_fit, optics, response) if s is not None]


def _confounders(assessment: Assessment) -> list[str]:
    """Confounders of the shared estimates, then those of each source."""
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
