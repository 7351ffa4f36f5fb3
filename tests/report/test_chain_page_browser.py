"""The page of one target through a camera, in a real browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pixmetry.camera.camera import load_camera
from pixmetry.simulate.chain import chain
from pixmetry.simulate.page import write_chain_page

pytestmark = pytest.mark.browser
SCENE = {
    "schema": "pixmetry/scene/1",
    "uniform": {"level_photons": 8000},
    "discs": {"x_px": [70.3], "y_px": [60.4], "diameter_px": 7, "blur_px": 0.7, "peak_photons": 60000},
}


@pytest.fixture(scope="module")
def steps() -> int:
    return 1 + len(load_camera("pulnix_tm6cn").active)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    camera = replace(load_camera("pulnix_tm6cn"), frame_shape=(120, 140))
    return write_chain_page(chain(camera, SCENE, seed=2), tmp_path_factory.mktemp("chain") / "chain.html").as_uri()


def test_no_complaint_and_no_request_but_the_file_itself(opened: Any, address: str) -> None:
    assert opened.complaints == []
    assert [url for url in opened.asked if not url.startswith("data:")] == [address]


def test_nothing_sticks_out_to_the_side(opened: Any) -> None:
    inside, width = opened.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert inside == width


def test_every_source_has_its_picture_and_its_numbers(opened: Any, steps: int) -> None:
    boxes = opened.evaluate("[...document.querySelectorAll('#steps ~ .grid svg.figure')].map(e => e.getBoundingClientRect().width)")
    assert len(boxes) == steps and min(boxes) > 250
    captions = opened.evaluate("[...document.querySelectorAll('#steps ~ .grid figcaption')].map(e => e.textContent)")
    assert all("So far: x" in c for c in captions) and sum("This source: x" in c for c in captions) == steps - 1


def test_labels_of_axes_keep_their_digits(opened: Any) -> None:
    labels = opened.evaluate("[...document.querySelectorAll('#result ~ figure svg text')].map(e => e.textContent)")
    numbers = [t for t in labels if t.replace("\u2212", "-").replace(".", "").lstrip("-").isdigit()]
    assert len(numbers) == len(set(numbers)) >= 3


def test_paper_holds_the_whole_page(opened: Any, tmp_path: Path) -> None:
    pdf = opened.pdf(path=str(tmp_path / "chain.pdf"), prefer_css_page_size=True)
    assert 2 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") <= 14
