"""The files of a data sheet of EMVA 1288: JSON, the public XML format, a page (HTML) and PDF, written together; the first two are read."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from pixmetry.core.checksums import check_record
from pixmetry.emva.files.json_format import WHAT_TO_NAME, is_xml, read_bytes, sheet_json, sheet_of_record
from pixmetry.emva.records import DataSheet
from pixmetry.files.output import PDF_MARK, Output, check_files, write_together
from pixmetry.files.strict_json import parse_json

# How a file of each kind begins, so that nothing else is ever replaced.
MARKS = {
    "json": re.compile(rb'\s*\{\s*"schema":\s*"pixmetry/emva1288/'),
    "xml": re.compile(rb'(<\?xml[^>]*\?>)?\s*<results schema="pixmetry/emva1288/'),
    "report": re.compile(
        rb'\s*<!DOCTYPE html>\s*<html\b[^>]*>\s*<head>(?:(?!<style|</head>|<body).)*<meta name="generator" content="pixmetry '
        rb"(?:(?!<style|</head>|<body).)*EMVA 1288 data sheet</title>",
        re.DOTALL,
    ),
    "pdf": PDF_MARK,
}


def read_sheet(path: str | Path) -> DataSheet:
    """Read a data sheet, JSON or XML by its content.

    Of the XML of other programs the values and curves are taken; what they do not say is empty: the release, ``u`` and ``dof`` (NaN).

    Raises
    ------
    InputError
        If the file cannot be read, or is no data sheet.
    """
    raw = read_bytes(path)
    if is_xml(raw):
        from pixmetry.emva.files.xml_format import sheet_of_xml

        return sheet_of_xml(raw, str(path))
    record = parse_json(raw, str(path), WHAT_TO_NAME)
    check_record(record, str(path))
    return sheet_of_record(record, str(path))


def named(**wanted: str | Path | None) -> dict[str, Path]:
    """Paths by kind (``json``, ``xml``, ``report``, ``pdf``), without those that are not wanted."""
    return {kind: Path(path) for kind, path in wanted.items() if path is not None}


def check_names(files: Mapping[str, Path], inputs: Iterable[Path] = ()) -> None:
    """Refuse names under which a data sheet cannot be written; parameters and errors as of `write_files`."""
    check_files(_outputs(files), inputs)


def write_files(sheet: DataSheet, files: Mapping[str, Path], inputs: Iterable[Path] = ()) -> None:
    """Write a data sheet to files, all or none; earlier ones of the same kind are replaced.

    Parameters
    ----------
    sheet : DataSheet
    files : mapping
        Paths by kind: ``json``, ``xml``, ``report``, ``pdf``.
    inputs : iterable of Path
        Files that must not be touched.

    Raises
    ------
    InputError
        If one cannot be written, or something else would be lost.
    """
    check_names(files, inputs)  # before anything is drawn
    write_together(_outputs(files), [content_of(sheet, kind) for kind in files], inputs)


def content_of(sheet: DataSheet, kind: str) -> bytes:
    """Return the data sheet of a file of this kind."""
    if kind in ("pdf", "report"):
        from pixmetry.emva.page.page import page_of
        from pixmetry.report import html_of, pdf_of

        return pdf_of(page_of(sheet)) if kind == "pdf" else html_of(page_of(sheet)).encode()
    if kind == "xml":
        from pixmetry.emva.files.xml_format import xml_text

        return xml_text(sheet).encode()
    return sheet_json(sheet).encode()


def _outputs(files: Mapping[str, Path]) -> list[Output]:
    return [Output(path, MARKS[kind]) for kind, path in files.items()]
