"""Where the numbers of a page come from: the last section of every page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pixmetry.report.page import Column, Facts, Run, Section, Table, strong


def provenance_section(record: Mapping[str, Any], licence: str = "", more: Sequence[tuple[str, str]] = ()) -> Section | None:
    """Versions, command, options and input files of a provenance record as a section; None where nothing is known.

    Parameters
    ----------
    record : mapping
        As of `pixmetry.files.provenance_record`; every part may be missing.
    licence : str
        Of the data.
    more : sequence of (str, str)
        Further facts.
    """
    section = Section("Versions and inputs", name="provenance")
    if facts := provenance_facts(record, more):
        section.add(Facts(facts))
    command = record.get("command") or ""
    if text := command if isinstance(command, str) else " ".join(str(part) for part in command):
        section.add_text("Command: ", Run(text, "code"), style="small")
    if options := ", ".join(f"{key} = {value}" for key, value in (record.get("options") or {}).items()):
        section.add_text("Options: ", Run(options, "code"), style="small")
    if licence:
        section.add_text(strong("Data:"), f" {licence}", style="small licence")
    if inputs := record.get("inputs") or ():
        rows = [[Run(i["name"], "mono"), str(i["size_bytes"]), Run(i["sha256"], "mono")] for i in inputs]
        table = Table("Input files", ["File", Column("Bytes", "right"), "SHA-256"], rows)
        section.add_section(f"{len(inputs)} input file{'s' if len(inputs) > 1 else ''} with SHA-256", table, fold=True)
    return section if section.parts else None


def provenance_facts(record: Mapping[str, Any], more: Sequence[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """Versions, platform, seed and time of a provenance record, as far as they are known; ``more`` follows the first."""
    libraries = ", ".join(f"{name} {version}" for name, version in (record.get("libraries") or {}).items())
    rows = [
        ("pixmetry", record.get("pixmetry", "")),
        *more,
        ("Python", record.get("python", "")),
        ("Libraries", libraries),
        ("Platform", record.get("platform", "")),
        ("Seed", "" if record.get("seed") is None else record["seed"]),
        ("Time (UTC)", str(record.get("time_utc", "")).replace("T", " ").removesuffix("+00:00")),
    ]
    return [(label, str(text)) for label, text in rows if str(text)]
