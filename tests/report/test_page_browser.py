"""The report in a real browser, on a phone, a desk and paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pixmetry.assess.page.page import write_report
from report import simulated

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module", params=[True, False], ids=["stacks", "no stacks"])
def address(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    return write_report(simulated.assessment(simulated.PITCH_UM, request.param), path).as_uri()


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


def test_headings_are_in_order(opened: Any) -> None:
    depth = opened.evaluate("[...document.querySelectorAll('h1,h2,h3,h4,h5,h6')].map(e => +e.tagName[1])")
    assert depth[0] == 1
    assert depth.count(1) == 1
    assert depth.count(2) in (8, 9)  # with stacks, also what rows share
    assert all(b <= a + 1 for a, b in zip(depth, depth[1:], strict=False))


def test_figures_and_their_pictures_are_there(opened: Any) -> None:
    boxes = opened.evaluate(
        "[...document.querySelectorAll('svg.figure')].map(e => e.getBoundingClientRect()).map(box => [box.width, box.height])"
    )
    assert len(boxes) in (6, 11)
    assert all(width > 250 and height > 120 for width, height in boxes)
    sizes = opened.evaluate(
        "Promise.all([...document.querySelectorAll('svg image')].map(e => new Promise(done => { const i = new Image(); "
        "i.onload = () => done(i.naturalWidth); i.onerror = () => done(0); i.src = e.href.baseVal })))"
    )
    assert all(size > 1 for size in sizes)
    assert len(sizes) >= (2 if len(boxes) == 11 else 0)


def test_text_stands_out_from_its_ground(opened: Any) -> None:
    """Contrast of ink and secondary text to the page, as WCAG 2.2 defines it, at least 4.5; of the lines of the figures at least 3."""
    ratios = opened.evaluate(
        """() => {
          const probe = document.createElement('i'); document.body.append(probe);
          const linear = v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
          const light = name => { probe.style.color = `var(--${name})`;
            const c = getComputedStyle(probe).color.match(/\\d+/g).slice(0, 3).map(v => linear(v / 255));
            return .2126 * c[0] + .7152 * c[1] + .0722 * c[2]; };
          const ratio = (a, b) => (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
          return Object.fromEntries(['ink', 'soft', 'blue', 'red', 'amber'].map(n => [n, ratio(light(n), light('page'))]));
        }"""
    )
    assert ratios["ink"] >= 4.5
    assert ratios["soft"] >= 4.5
    assert min(ratios.values()) >= 3


def test_paper_holds_the_whole_page(opened: Any, tmp_path: Path) -> None:
    pdf = opened.pdf(path=str(tmp_path / "report.pdf"), prefer_css_page_size=True)
    assert pdf.startswith(b"%PDF")
    assert 3 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") <= 14
