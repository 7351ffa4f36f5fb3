"""The files of a data sheet of EMVA 1288: JSON, the public XML format, a page (HTML) and PDF."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from pixmetry.emva.records import DataSheet
from pixmetry.files.staged_files import Output, check_files, write_together

# How a file of each kind begins (a PDF says at its end who made it), so that nothing else is ever replaced.
MARKS = {
    "json": re.compile(rb'\s*\{\s*"schema":\s*"pixmetry/emva1288/'),
    "xml": re.compile(rb'(<\?xml[^>]*\?>)?\s*<results schema="pixmetry/emva1288/'),
    "report": re.compile(
        rb'\s*<!DOCTYPE html>\s*<html\b[^>]*>\s*<head>(?:(?!<style|</head>|<body).)*<meta name="generator" content="pixmetry '
        rb"(?:(?!<style|</head>|<body).)*EMVA 1288 data sheet</title>",
        re.DOTALL,
    ),
    "pdf": re.compile(rb"%PDF-1\.\d.*\n\d+ 0 obj\s*<< /Creator \(pixmetry\)", re.DOTALL),
}


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
    write_together(_outputs(files), [content_of(sheet, kind) for kind in files], inputs)


def content_of(sheet: DataSheet, kind: str) -> bytes:
    """Return what a file of this kind holds of a data sheet."""
    if kind in ("pdf", "report"):
        from pixmetry.emva.page.page import page_of
        from pixmetry.report import html_of, pdf_of

        return pdf_of(page_of(sheet)) if kind == "pdf" else html_of(page_of(sheet)).encode()
    if kind == "xml":
        from pixmetry.emva.files.xml_format import xml_text

        return xml_text(sheet).encode()
    from pixmetry.emva.files.formats import sheet_json

    return sheet_json(sheet).encode()


def _outputs(files: Mapping[str, Path]) -> list[Output]:
    return [Output(path, MARKS[kind]) for kind, path in files.items()]
