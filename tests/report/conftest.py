"""A page of the report in a browser, at the width of a phone and of a desk."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

WIDTHS = (390, 1280)


@pytest.fixture(params=WIDTHS)
def opened(browser: Any, address: str, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The page in a window of some width, with what it asked for and what it complained of."""
    page = browser.new_page(viewport={"width": request.param, "height": 800}, color_scheme="dark" if request.param == 390 else "light")
    page.asked, page.complaints = [], []
    page.on("request", lambda r: page.asked.append(r.url))
    page.on("console", lambda m: page.complaints.append(m.text))
    page.on("pageerror", lambda e: page.complaints.append(str(e)))
    page.goto(address, wait_until="load")
    yield page
    page.close()
