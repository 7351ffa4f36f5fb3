"""The data sheet in a real browser, on a phone, a desk and paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pixmetry.emva.page.page import page_of
from pixmetry.report import html_of
from report import emva_sheets

pytestmark = pytest.mark.browser
SHEETS = {
    "mono": emva_sheets.sheet,
    "colour": emva_sheets.colour_sheet,
    "bare": lambda: emva_sheets.sheet(emva_sheets.results(photons_known=False, stacks=False)),
}


@pytest.fixture(scope="module", params=SHEETS)
def address(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("emva") / "sheet.html"
    path.write_text(html_of(page_of(SHEETS[request.param]())), encoding="utf-8")
    return path.as_uri()


def test_no_complaint_and_no_request_but_the_file_itself(opened: Any, address: str) -> None:
    assert opened.complaints == []
    assert [url for url in opened.asked if not url.startswith("data:")] == [address]


def test_nothing_sticks_out_to_the_side(opened: Any) -> None:
    inside, width = opened.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert inside == width
    out = opened.evaluate(
        "[...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll') && !e.closest('svg') "
        "&& e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"
    )
    assert out == []


def test_text_stays_inside_its_figure(opened: Any) -> None:
    out = opened.evaluate(
        """[...document.querySelectorAll('svg.figure')].flatMap(s => { const f = s.getBoundingClientRect();
        return [...s.querySelectorAll('text')].filter(t => { const b = t.getBoundingClientRect();
          return b.left < f.left - 2 || b.right > f.right + 2 || b.top < f.top - 2 || b.bottom > f.bottom + 2 })
          .map(t => s.getAttribute('aria-label').slice(0, 30) + ': ' + t.textContent) })"""
    )
    assert out == []


def test_shared_styles_reach_the_figures(opened: Any) -> None:
    """Lines have the colours of the page's theme, and no text is painted in the browser's own black of a shape without a style."""
    strokes = opened.evaluate("[...new Set([...document.querySelectorAll('svg.figure path')].map(e => getComputedStyle(e).stroke))]")
    blue = opened.evaluate(
        "(() => { const i = document.createElement('i'); i.style.color = 'var(--blue)'; document.body.append(i); "
        "return getComputedStyle(i).color })()"
    )
    assert blue in strokes
    fills = opened.evaluate("[...new Set([...document.querySelectorAll('svg.figure text')].map(e => getComputedStyle(e).fill))]")
    ink = opened.evaluate("getComputedStyle(document.body).color")
    assert fills == [ink]


def test_the_summary_fits_one_sheet_and_the_rest_follows(opened: Any, tmp_path: Path) -> None:
    pdf = opened.pdf(path=str(tmp_path / "sheet.pdf"), prefer_css_page_size=True)
    assert 4 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") <= 24
