"""``--pdf FILE``, which means the same in every command: the page of the result as PDF."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._console import echo

if TYPE_CHECKING:
    from pixmetry.report import Page


def pdf_option() -> Callable[[Any], Any]:
    """The option of a command, as its parameter ``pdf``."""
    return click.option("--pdf", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Also write the page as PDF.")


def check_pdf(file: Path | None, inputs: Sequence[Path] = ()) -> None:
    """Refuse a file that cannot be written or is none of ours, before the work."""
    from pixmetry.files.output import PDF_MARK, Output, check_files

    if file is not None:
        check_files([Output(file, PDF_MARK)], inputs)


def put_pdf(file: Path | None, page_of: Callable[[], Page]) -> None:
    """Write the page and say so, if it was asked for."""
    from pixmetry.files.output import write_page
    from pixmetry.report import pdf_of

    if file is not None:
        echo(f"pdf: {write_page(file, pdf_of(page_of()))}")
