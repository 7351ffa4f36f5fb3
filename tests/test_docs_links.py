"""Links of the documentation lead somewhere: files, headings, and the terms of the glossary."""

from __future__ import annotations

import pkgutil
import re
from pathlib import Path

import pytest

import pixmetry

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SOURCES = DOCS / "gallery"  # of pages of the handbook, whose links are those of the pages
PAGES = sorted(p for p in [*ROOT.glob("*.md"), *DOCS.rglob("*.md")] if p.name != "0000-template.md" and SOURCES not in p.parents)
GLOSSARY = DOCS / "glossary.md"
FENCED = re.compile(r"^```.*?^```", re.M | re.S)
LINK = re.compile(r"\]\(([^)\s]+)\)|<img src=\"([^\"]+)\"")


def anchors(text: str) -> list[str]:
    """Names of the headings as GitHub makes them: small letters, blanks to hyphens, no other signs."""
    heads = re.findall(r"^#+ +(.+?) *$", FENCED.sub("", text), re.M)
    return [re.sub(r"[^\w\- ]", "", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", head).lower()).replace(" ", "-") for head in heads]


def broken(page: Path, text: str) -> list[str]:
    """Links of a page that lead nowhere."""
    wrong = []
    for found in LINK.finditer(FENCED.sub("", text)):
        link = found[1] or found[2]
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists() or (anchor and anchor not in anchors(target.read_text(encoding="utf-8"))):
            wrong.append(link)
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """The text of a note is read in the handbook, from where its links count."""
    there = DOCS / "handbook" / page.name if page.parent == DOCS / "gallery" / "notes" else page
    assert not broken(there, page.read_text(encoding="utf-8"))


def test_planted_links_are_seen() -> None:
    page = DOCS / "glossary.md"
    assert broken(page, "[a](nowhere.md) [b](glossary.md#nothing) [c](#datum) [d](https://example.org)") == [
        "nowhere.md",
        "glossary.md#nothing",
    ]
    assert anchors("# Cramér–Rao bound\n```\n# no\n```\n## `a_b` (c)") == ["cramérrao-bound", "a_b-c"]


def test_imports_that_the_pages_show_work() -> None:
    shown = {
        line
        for page in PAGES
        if page.name != "CHANGELOG.md"
        for line in re.findall(r"^from pixmetry[\w.]* import .+$", page.read_text(encoding="utf-8"), re.M)
    }
    assert len(shown) > 15
    for line in sorted(shown):
        exec(compile(line, "page", "exec"), {})


def test_names_that_the_pages_mention_exist() -> None:
    pages = [page for page in PAGES if page.name != "CHANGELOG.md" and page.parent.name != "adr"]
    named = {name for page in pages for name in re.findall(r"`(pixmetry(?:\.\w+)+)", page.read_text(encoding="utf-8"))}
    assert len(named) > 10
    for name in sorted(named):
        pkgutil.resolve_name(name)


def test_pages_named_in_messages_and_help_exist() -> None:
    named = {
        name
        for path in Path(pixmetry.__file__).parent.rglob("*.py")
        for name in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert "docs/calibrating.md" in named
    assert not [name for name in named if not (ROOT / name).exists()]


def test_the_readme_lists_every_page() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert not [p.name for p in DOCS.glob("*.md") if f"](docs/{p.name})" not in text.partition("## All pages")[2]]


def test_the_glossary_is_in_order_and_every_term_is_explained() -> None:
    _, *parts = re.split(r"^## (.+)$", GLOSSARY.read_text(encoding="utf-8"), flags=re.M)
    terms = dict(zip(parts[::2], parts[1::2], strict=True))
    assert list(terms) == sorted(terms, key=str.casefold) and len(terms) > 50
    for term, text in terms.items():
        explained = re.match(r"\n\n[A-Z1-9].{20,}?\.", text, re.S)
        assert explained and (re.search(r"^\*.+\*$", text, re.M) or "See [" in text), term


@pytest.mark.parametrize(
    "term", ["prnu", "dsnu", "k", "line-jitter", "smear", "contribution", "probe", "upper-limit", "coverage", "degrees-of-freedom", "datum"]
)
def test_the_glossary_has_the_terms_of_the_outputs(term: str) -> None:
    assert term in anchors(GLOSSARY.read_text(encoding="utf-8"))
