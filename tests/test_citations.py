"""Every citation of literature is in docs/references.yaml, with the place where it was checked, or as one from memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from site_pages.citations import SHORT, citation_of, citations

from pixmetry.camera.catalogue import sources

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *(DOCS / "handbook").glob("*.md")])
OF_SOURCES = sorted({text for source in sources().values() for text in source.references})


def test_every_reference_of_a_source_has_one_entry() -> None:
    assert len(OF_SOURCES) > 100
    for text in OF_SOURCES:
        assert citation_of(text).words


def test_every_citation_on_a_page_has_one_entry() -> None:
    cited = {found[0] for page in PAGES for found in SHORT.finditer(page.read_text(encoding="utf-8"))}
    assert len(cited) > 10 and "Shortis et al. 1994" in cited
    for text in cited:
        assert citation_of(text).words
    assert citation_of("Dorsch, Häusler and Herrmann (Applied Optics 33, 1994, 1306–1314)").checked


def test_every_entry_is_cited_and_says_where_it_was_checked() -> None:
    text = "\n".join([*OF_SOURCES, *(page.read_text(encoding="utf-8") for page in PAGES)])
    assert not [entry.cited_as for entry in citations() if entry.cited_as not in text]
    assert len({entry.cited_as for entry in citations()}) == len(citations())
    checked = [entry for entry in citations() if entry.checked]
    assert len(checked) >= 18 and all(entry.checked.startswith("http") or "handbook" in entry.checked for entry in checked)


def test_an_unknown_citation_is_refused() -> None:
    with pytest.raises(LookupError, match="0 entries"):
        citation_of("N. Obody, Nowhere 1 (1900) 1")
