"""The page kit: a page that anyone builds, as HTML and as a PDF of the same tree."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure as Drawing

from pixmetry.core.finding import Finding
from pixmetry.core.number import Number
from pixmetry.report import Answer, Column, Page, Reading, Row, Run, Table, Text, html_of, pdf_of, strong, write_html, write_pdf
from pixmetry.report.paper import LEFT, WIDTH_PT, lines_of, paper, run_width
from pixmetry.report.pdf import lay_out
from report import simulated
from report.test_page import Page as Parsed

BAD = '<script>alert("x & y")</script>'


def drawing(label: str = "time / min", width_in: float = 3.0) -> Drawing:
    figure = Drawing(figsize=(width_in, 2.0), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1, 2], [0, 1, 4], label="drift")
    axes.imshow(np.eye(3), extent=(0, 1, 0, 1))
    axes.set_xlabel(label)
    return figure


def own_page(words: str = "of the camera") -> Page:
    """One of everything, made through the open builder."""
    page = Page("Camera 7", "warm-up", "a user's page", [("Frames", "120")], "The end.")
    section = page.add_section("What was seen", Answer([Text("The drift:"), [Reading("x", "0.10 px", "in an hour")]]))
    section.add_text("A sentence ", strong(words), ".").add_finding(Finding("drift", f"It drifts, {words}.", "Wait an hour.", "warning"))
    rows = [["first", Number(1.2345, 0.012, unit="px")], ["second", Number(0.3, kind="upper_limit", unit="px")]]
    section.add_table(
        "Drift", ["Point", Column("Value", "number")], [*rows, Row(["sum", Number(2.0, 0.5, unit="px")], "a note", total=False)]
    )
    section.add_figure(drawing(), alt="Drift against time", caption=f"The drift {words}.", title="Drift", name="drift")
    section.add_section("Folded", Text("Hidden until asked."), fold=True)
    return page


def texts_of(page: Page) -> list[str]:
    """Every line of text on the sheets of a page, as it is laid out."""
    with paper() as sheets:
        lay_out(page, sheets)
        return [t.get_text() for sheet in sheets.figures for t in sheet.texts]


def test_html_and_pdf_say_the_same() -> None:
    html, sheets = Parsed(html_of(own_page())), " ".join(texts_of(own_page()))
    both = (
        "Camera 7",
        "What was seen",
        "0.10 px",
        "in an hour",
        "of the camera",
        "It drifts",
        "Wait an hour.",
        "1.234",
        "± 0.012",
        "a note",
    )
    for words in (*both, "Hidden until asked.", "The drift", "120", "The end."):
        assert words in html.text and words in " ".join(sheets.split()), words
    assert html.open == [] and "Warning:" in html.text and "Warning:" in sheets
    assert "<\u00a00.30" in sheets and "(95\u00a0%)" in sheets  # a limit is one in a table too


def test_what_comes_from_outside_is_only_text() -> None:
    page = own_page(BAD)
    page.name, page.facts = BAD, [(BAD, BAD)]
    page.sections[0].title = BAD
    page.sections[0].add_figure(drawing(BAD), alt=BAD, name='a"b')
    page.sections[0].add(Table(BAD, [Column(BAD, group=BAD), BAD], [Row([BAD, BAD], BAD), Row([BAD], heading=True)], BAD))
    html = html_of(page)
    assert "<script" not in html and "alert(" in html
    assert Parsed(html).open == []
    assert any(BAD in text for text in texts_of(page))


def test_figures_are_drawn_anew_for_each_and_left_as_they_were() -> None:
    page = own_page()
    figure = next(part for part in page.sections[0].parts if type(part).__name__ == "Figure")
    size, engine = figure.drawing.get_size_inches().copy(), figure.drawing.get_layout_engine()
    first, pdf = html_of(page), pdf_of(page)
    again = html_of(own_page())
    assert pdf_of(page) == pdf and again == first
    np.testing.assert_array_equal(figure.drawing.get_size_inches(), size)
    assert figure.drawing.get_layout_engine() is engine
    np.testing.assert_allclose(figure.drawing.bbox_inches.bounds, (0, 0, *size))


def test_a_table_spreads_numbers_and_groups_its_columns() -> None:
    table = Table(
        "x", ["a", Column("Value", "number", group="Camera"), Column("Length", "number", unit="px")], [["r", *[Number(2.0, 0.1)] * 2]]
    )
    columns, rows = table.flat()
    assert [c.heading for c in columns] == ["a", "Value", "± u", "Unit", "Length / px", "± u"]
    assert rows[0].cells == ["r", "2.00", "± 0.10", "", "2.00", "± 0.10"]
    page = Page("p").add_section("s").add(table)
    html = html_of(Page("p", sections=[page]))
    assert [(a["scope"], a["colspan"]) for a in Parsed(html).of("th") if "colspan" in a] == [("colgroup", "3")]


def test_lines_are_no_wider_than_asked_in_any_style() -> None:
    content = ["some words ", strong("in bold type "), Run("sigma"), Run("dark", "sub"), " and ", Run("code_" * 40, "code"), "\nnew line"]
    for width in (60.0, 150.0, 400.0):
        lines = lines_of(content, width, 7.5)
        assert all(sum(run_width(run, 7.5) for run in line) <= width + 0.1 for line in lines)
        said = "".join(run.text for line in lines for run in line)
        assert said.replace(" ", "") == "".join(c if isinstance(c, str) else c.text for c in content).replace(" ", "").replace("\n", "")


@pytest.mark.parametrize("columns", [3, 12, 30])
def test_a_table_of_any_width_stays_on_its_sheet(columns: int) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    rows = [[f"a name of a row {k}", *(f"{k * 1.2345:.4f}" for _ in range(columns - 1))] for k in range(4)]
    with paper() as sheets:
        sheets.table(Table("x", ["Row", *(Column(f"heading {k}", "right") for k in range(columns - 1))], rows))
        (sheet,) = sheets.figures
        sheet.set_dpi(72)
        renderer = FigureCanvasAgg(sheet).get_renderer()
        boxes = [t.get_window_extent(renderer) for t in sheet.texts]
        assert min(b.x0 for b in boxes) >= LEFT - 2 and max(b.x1 for b in boxes) <= WIDTH_PT - LEFT + 2


def test_files_of_a_page(tmp_path: Path) -> None:
    html, pdf = write_html(own_page(), tmp_path / "a.html"), write_pdf(own_page(), tmp_path / "a.pdf")
    assert html.read_text(encoding="utf-8") == html_of(own_page()) and pdf.read_bytes() == pdf_of(own_page())
    assert pdf.read_bytes().startswith(b"%PDF") and b"/Title (Camera 7: warm-up)" in pdf.read_bytes()


def test_every_job_has_its_page_on_paper(rng: np.random.Generator) -> None:
    """The assessment's sheets hold the verdict, the ranking and what does not count; the calibration's its parameters."""
    from pixmetry.assess.page.page import page_of
    from pixmetry.calibrate.page.page import page_of as calibration_page
    from report import calibrations

    said = " ".join(" ".join(texts_of(page_of(simulated.assessment()))).split())
    for words in ("0.050 px = 0.370 µm", "Temporal row and column noise", "only in a camera that is analogue", "one target in one frame"):
        assert words in said
    few = calibrations.bare(rng, images=4)
    assert "Principal distance" in " ".join(texts_of(calibration_page(few)))
    pages = re.findall(rb"/MediaBox", pdf_of(calibration_page(few)))
    assert 2 <= len(pages) <= 12


def test_the_ranking_is_the_budgets_and_what_does_not_count_is_folded() -> None:
    from pixmetry.assess.page.page import page_of

    made = simulated.assessment()
    rows = sorted(made.budget.rows, key=lambda r: not r.counts)  # else in the order that the budget gave them
    for given in (rows, [rows[1], rows[0], *rows[2:]]):
        html = html_of(page_of(replace(made, budget=replace(made.budget, rows=tuple(given)))))
        section = html[html.index('id="sources"') : html.index('id="sum"')]
        assert re.findall(r'<small class="mono">([^<]+)</small>', section) == [r.name for r in given]
        folded = section[section.index("<details>") :]
        assert re.findall(r'<small class="mono">([^<]+)</small>', folded) == [r.name for r in given if not r.counts] != []
