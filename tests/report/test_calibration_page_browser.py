"""The page of a calibration in a real browser, on a phone, a desk and paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from chance import rng_of
from pixmetry.calibrate.page.page import write_page
from report import calibrations

pytestmark = pytest.mark.browser
KINDS = {
    "full": lambda rng: calibrations.full(rng),
    "two cameras": lambda rng: calibrations.full(rng, cameras=2, images=40, plane=True, pitch_um=None),
    "bare": lambda rng: calibrations.bare(rng, covariance=False),
    "many": lambda rng: calibrations.full(rng, images=120, points=800, visibility=0.2),
}


@pytest.fixture(scope="module", params=KINDS)
def address(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("calibration") / "report.html"
    return write_page(KINDS[request.param](rng_of(request)), path).as_uri()


@pytest.fixture
def unfolded(opened: Any) -> Any:
    opened.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true })")
    return opened


def test_no_complaint_and_no_request_but_the_file_itself(opened: Any, address: str) -> None:
    assert opened.complaints == []
    assert [url for url in opened.asked if not url.startswith("data:")] == [address]


def test_nothing_sticks_out_to_the_side(unfolded: Any) -> None:
    inside, width = unfolded.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert inside == width
    out = unfolded.evaluate(
        "[...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll') && !e.closest('svg') "
        "&& e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"
    )
    assert out == []


def test_text_stays_inside_its_figure(unfolded: Any) -> None:
    out = unfolded.evaluate(
        """[...document.querySelectorAll('svg.figure')].flatMap(s => { const f = s.getBoundingClientRect();
        return [...s.querySelectorAll('text')].filter(t => { const b = t.getBoundingClientRect();
          return b.left < f.left - 2 || b.right > f.right + 2 || b.top < f.top - 2 || b.bottom > f.bottom + 2 })
          .map(t => s.getAttribute('aria-label').slice(0, 30) + ': ' + t.textContent) })"""
    )
    assert out == []


def test_figures_take_the_colours_of_the_theme(unfolded: Any) -> None:
    """Text has the page's ink; only numbers on the coloured cells of the correlation matrix keep their own dark and light."""
    fills = unfolded.evaluate(
        "[...new Set([...document.querySelectorAll('svg.figure:not([aria-label^=\"Correlation matrix\"]) text')]"
        ".map(e => getComputedStyle(e).fill))]"
    )
    assert fills == [unfolded.evaluate("getComputedStyle(document.body).color")]
    strokes = unfolded.evaluate("[...new Set([...document.querySelectorAll('svg.figure path')].map(e => getComputedStyle(e).stroke))]")
    blue = unfolded.evaluate(
        "(() => { const i = document.createElement('i'); i.style.color = 'var(--blue)'; document.body.append(i); "
        "return getComputedStyle(i).color })()"
    )
    assert blue in strokes


def test_figures_are_large_enough_to_read(unfolded: Any) -> None:
    boxes = unfolded.evaluate(
        "[...document.querySelectorAll('svg.figure')].map(e => e.getBoundingClientRect()).map(b => [b.width, b.height])"
    )
    assert len(boxes) >= 6
    assert all(width > 250 and height > 70 for width, height in boxes)
    heights = unfolded.evaluate("[...document.querySelectorAll('svg.figure text')].map(e => e.getBoundingClientRect().height)")
    assert min(heights) > 5


def test_paper_holds_the_whole_page(opened: Any, tmp_path: Path) -> None:
    pdf = opened.pdf(path=str(tmp_path / "report.pdf"), prefer_css_page_size=True)
    assert pdf.startswith(b"%PDF")
    assert 3 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") <= 24
