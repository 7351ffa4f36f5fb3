"""The data sheet as a PDF: its pages as another program reads them, its layout, the same bytes in every process."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest

from pixmetry.core.number import Number
from pixmetry.emva.page.content import GENERAL, all_rows, dof_text, methods_of
from pixmetry.emva.page.page import all_plots, page_of
from pixmetry.report import Column, Row, Table, pdf_of
from pixmetry.report.paper import HEIGHT_PT, LEFT, POINTS, RIGHT, WIDTH_PT, paper, printable, text_width, wrapped
from pixmetry.report.pdf import lay_out
from report import emva_sheets

TESTS = Path(__file__).parents[1]
poppler = pytest.mark.skipif(shutil.which("pdftotext") is None, reason="pdftotext is not installed")


@lru_cache(maxsize=1)
def made() -> bytes:
    return pdf_of(page_of(emva_sheets.sheet()))


def text_of(raw: bytes, path: Path, *options: str) -> str:
    path.write_bytes(raw)
    done = subprocess.run(["pdftotext", *options, str(path), "-"], capture_output=True, text=True, check=True)
    return done.stdout


def test_pages_are_a4_and_few() -> None:
    boxes = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", made())
    assert len(boxes) == 6
    assert all(abs(float(w) - 595.28) < 0.5 and abs(float(h) - 841.89) < 0.5 for w, h in boxes)
    assert b"/Title (Simulated <camera> & co.: EMVA 1288 data sheet)" in made()
    assert b"CreationDate" not in made()
    assert len(made()) < 2_000_000
    assert b"/Subtype /Image" not in made()  # vectors only


def test_the_same_bytes_in_every_process() -> None:
    """One that has drawn other pages before and hashes its words in another order, and a new one."""
    made()
    bare = emva_sheets.sheet(emva_sheets.results(stacks=False, photons_known=False))
    here = hashlib.sha256(pdf_of(page_of(bare))).hexdigest()
    code = (
        f"import sys; sys.path.insert(0, {str(TESTS)!r}); from report import emva_sheets as s; "
        "from pixmetry.emva.page.page import page_of; from pixmetry.report import pdf_of; import hashlib; "
        "print(hashlib.sha256(pdf_of(page_of(s.sheet(s.results(stacks=False, photons_known=False))))).hexdigest())"
    )
    other = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
    environment = os.environ | {"PYTHONHASHSEED": other}
    there = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
    assert there.strip() == here


@poppler
def test_all_values_captions_and_sentences_can_be_read_and_searched(tmp_path: Path) -> None:
    text = " ".join(text_of(made(), tmp_path / "sheet.pdf").split())
    sheet = emva_sheets.sheet()
    for rows in all_rows(sheet.results[0], methods_of(sheet)).values():
        for row in rows:
            for part in (row.title, row.key, row.number.value, row.number.u, row.number.unit, *row.nonlinear.split(" "), row.reason):
                assert " ".join(part.split()) in text
    spaced = text.replace(" ", "")
    for p in all_plots(sheet.results[0]):
        assert "".join(p.caption.split()) in spaced
        assert p.title in text
    for words in ("CC0, made for a test", "pixmetry emva1288 campaign.yaml", "7, each with its SHA-256", "1/6", "6/6", "σ", "µ"):
        assert words.replace(" ", "") in spaced


@poppler
def test_the_summary_is_the_first_page_and_nothing_but_it(tmp_path: Path) -> None:
    first = text_of(made(), tmp_path / "sheet.pdf", "-l", "1")
    for words in ("1 Summary", "640 × 480", "30.5 °C", "Quantum efficiency", "45.00", "(95 %)", "Photon transfer", "A note of"):
        assert words in " ".join(first.split())
    assert "All values" not in first


@poppler
def test_fonts_are_embedded_with_their_letters(tmp_path: Path) -> None:
    (tmp_path / "sheet.pdf").write_bytes(made())
    fonts = subprocess.run(["pdffonts", str(tmp_path / "sheet.pdf")], capture_output=True, text=True, check=True).stdout.splitlines()[2:]
    assert fonts
    assert all(re.search(r"\byes +yes +yes\b", line) for line in fonts)  # embedded, subset, can be read back
    assert len({line.split()[0] for line in fonts}) == len(fonts)


@pytest.mark.parametrize("make", [emva_sheets.sheet, emva_sheets.colour_sheet], ids=["mono", "colour"])
def test_no_text_leaves_the_page_or_runs_into_another(make: object) -> None:
    """Extents by the Agg renderer, which knows nothing of the layout's own table of widths; a quarter of a point is its rounding."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with paper() as pages:
        lay_out(page_of(make()), pages)
        matplotlib.rcParams["text.hinting"] = "none"  # as in a PDF; paper() puts the style back
        for figure in pages.figures:
            figure.set_dpi(250)
            renderer = FigureCanvasAgg(figure).get_renderer()
            scale = POINTS / figure.dpi
            boxes = [t.get_window_extent(renderer) for t in figure.texts if t.get_text().strip()]
            lines: dict[int, list[tuple[float, float]]] = {}
            for text, box in zip([t for t in figure.texts if t.get_text().strip()], boxes, strict=True):
                x0, x1 = box.x0 * scale, box.x1 * scale
                assert x0 >= LEFT - 1.5
                assert x1 <= WIDTH_PT - RIGHT + 1.5, text.get_text()
                assert box.y0 * scale >= 15
                lines.setdefault(round(text.get_position()[1] * HEIGHT_PT * 4), []).append((x0, x1, text.get_text()))
            for spans in lines.values():
                spans.sort()
                for one, two in zip(spans, spans[1:], strict=False):
                    assert one[1] <= two[0] + 1.0, (one, two)


@poppler
def test_the_summary_with_general_values_and_long_notes_stays_on_one_page(tmp_path: Path) -> None:
    one = emva_sheets.results()
    general = {key: Number(20.0, 0.1, 30.0, "photon") for key in GENERAL}
    notes = tuple(f"Note {k}, {'which takes more than one line of the page, as some do ' * 3}and ends" for k in range(7))
    bent = replace(one, values={**one.values, **general, "PTC_linearity": Number(5.0, 0.4, 40.0, "%")}, notes=notes)
    first = text_of(pdf_of(page_of(emva_sheets.sheet(bent))), tmp_path / "sheet.pdf", "-l", "1")
    assert first.count("Note ") == first.count("and ends") == 7
    assert "General applies" in first
    assert "2 All values" not in first


def test_a_number_is_not_broken_however_narrow_its_table() -> None:
    """Beside a column of long sentences every degree of freedom stands on one line, and every word of the heading too."""
    dofs = [dof_text(Number(1.0, 0.1, dof, "DN")) for dof in (1.04, 99.6, 999.6, 1250.0, 1e9, float("inf"))]
    table = Table("x", ["Quantity", Column("dof", "right")], [["a long sentence of many words " * 9, dof] for dof in dofs])
    with paper() as pages:
        pages.table(table)
        texts = [t.get_text() for t in pages.figures[0].texts]
        assert set(dofs) | {"dof"} <= set(texts)


def test_widths_of_text_are_those_of_the_renderer() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with paper():
        figure = Figure(figsize=(10, 1), dpi=720)
        for words in ("Absolute sensitivity threshold", "0.12600 ± 0.00063 DN/e⁻", "µσηδ ₁₂₈₈ √photons"):
            text = figure.text(0, 0.5, words, fontsize=7.0)
            got = text.get_window_extent(FigureCanvasAgg(figure).get_renderer()).width / 10
            assert text_width(words, 7.0) == pytest.approx(got, rel=0.02)


def test_lines_are_wrapped_to_the_width_and_lose_nothing() -> None:
    words = "one two three fourfourfourfourfourfourfourfourfour five"
    lines = wrapped(words, 40.0, 7.0)
    assert all(text_width(line, 7.0) <= 40.0 for line in lines)
    assert "".join(lines).replace(" ", "") == words.replace(" ", "")
    assert wrapped("", 40.0, 7.0) == [""]


def test_what_the_font_has_not_is_marked_and_breaks_stay() -> None:
    assert printable("a\tb 相机 µ") == "a b \ufffd\ufffd µ"
    with paper() as pages:
        pages.paragraph("first\nsecond")
        assert [t.get_text() for t in pages.figures[0].texts] == ["first", "second"]


def test_a_long_table_repeats_its_head_and_keeps_a_heading_with_its_rows() -> None:
    rows = [Row((f"row {k}", f"{k}")) for k in range(60)]
    with paper() as pages:
        pages.table(Table("x", ["Quantity", Column("Value", "right")], [*rows, Row(("Section",), heading=True), *rows]), 7.0)
        heads = [[t.get_text() for t in figure.texts].count("Quantity") for figure in pages.figures]
        assert heads == [1] * len(pages.figures)
        assert len(pages.figures) == 2
        last = [figure for figure in pages.figures if "Section" in [t.get_text() for t in figure.texts]][0]
        names = [t.get_text() for t in last.texts]
        assert "row 0" in names[names.index("Section") :]
