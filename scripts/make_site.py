"""Build the documentation site with Sphinx: the pages of the repository, a page for each error source, and the Python API.

python scripts/make_site.py [FOLDER]        # default: site; open its index.html
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import matplotlib as mpl

import pixmetry

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs"))  # the site's pages are no part of the package

from gallery import questions, shorts  # noqa: E402
from gallery.note import Note, stored_numbers  # noqa: E402
from gallery.notebooks import notebook_of  # noqa: E402
from gallery.pages import NOTES, ORDER  # noqa: E402
from site_pages.api_pages import write_api_pages  # noqa: E402
from site_pages.source_pages import write_source_pages  # noqa: E402

LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
HIDDEN = re.compile(r"^```.*?^```", re.M | re.S)
SECTIONS = {  # of the site, and the pages of each; a page that stands in none stops the build
    "Getting started": ["start-folder-of-tiffs", "start-test-field", "start-data-sheet", "start-simulation"],
    "Measure a camera": ["frames", "planning", "capture", "emva1288", "compare", "series", "closed-loop"],
    "Measure with a camera": ["locating", "calibrating", "correct", "bound"],
    "Budget and simulate": ["budget", "bench", "data-sheets", "cameras", "scenes", "simulate"],
    "Handbook": ["handbook/index"],
    "Reference": ["sources/index", "api/index", "glossary", "conventions", "files"],
    "Develop": ["architecture", "adding-a-source", "decisions", "contributing", "releases", "changes"],
}
CONF: dict[str, Any] = {
    "project": "pixmetry",
    "copyright": "the pixmetry authors",
    "release": pixmetry.__version__,
    "extensions": ["myst_parser", "sphinx.ext.autodoc", "numpydoc"],
    "html_theme": "pydata_sphinx_theme",
    "html_title": "pixmetry",
    "html_theme_options": {
        "header_links_before_dropdown": 8,
        "show_nav_level": 1,
        "navigation_with_keys": False,
        "secondary_sidebar_items": ["page-toc"],
    },
    "html_static_path": ["_static"],
    "html_css_files": ["site.css"],
    "html_show_sourcelink": False,
    "html_show_search_summary": False,  # a page opened from a folder may not read the others
    "html_copy_source": False,
    "html_context": {"default_mode": "auto"},
    "myst_heading_anchors": 4,
    "myst_enable_extensions": ["html_image"],  # the pages of the handbook have <img> with a width
    "add_module_names": False,
    "autodoc_typehints": "none",
    "numpydoc_show_class_members": False,
    "toc_object_entries": False,
}
STYLE = """.bd-main .bd-content .bd-article-container { max-width: 72em; }
.bd-article table.table { font-size: 0.9em; }
.bd-article table.table :is(td, th) { padding: 0.3rem 0.45rem; }
@media (max-width: 600px) {
  .bd-article table.table { font-size: 0.8em; }
  .bd-article h1 { font-size: 1.8em; }
}
"""


def stage(folder: Path) -> None:
    """Copy the pages, and make those that are made."""
    shutil.copytree(
        ROOT / "docs", folder, ignore=shutil.ignore_patterns("*.py", "__pycache__", "gallery", "site_pages", "0000-template.md", "*.json")
    )
    for name, page in (("CONTRIBUTING.md", "contributing.md"), ("CHANGELOG.md", "changes.md")):
        shutil.copy(ROOT / name, folder / page)
    for page in folder.rglob("*.md"):
        page.write_text(_linked(page, folder), encoding="utf-8")
    decisions = sorted(p.stem for p in (folder / "adr").glob("*.md"))
    (folder / "decisions.md").write_text("# Decisions\n\n" + _toctree(f"adr/{name}" for name in decisions), encoding="utf-8")
    handbook = folder / "handbook" / "index.md"
    pages = [*ORDER, questions.NAME]
    handbook.write_text(handbook.read_text(encoding="utf-8") + "\n" + _toctree(pages, ":hidden:"), encoding="utf-8")
    write_notebooks(folder / "handbook")
    for name in write_source_pages(folder / "sources"):
        print("source", name)
    write_api_pages(folder / "api", pixmetry)
    listed = {name for names in SECTIONS.values() for name in names}
    missing = {p.stem for p in folder.glob("*.md")} - listed
    if missing:
        raise SystemExit(f"pages in no section of the site (SECTIONS in {Path(__file__).name}): {', '.join(sorted(missing))}")
    for title, pages in SECTIONS.items():
        if len(pages) > 1:
            (folder / f"{_name(title)}.md").write_text(f"# {title}\n\n{_toctree(pages, ':maxdepth: 1')}", encoding="utf-8")
    (folder / "index.md").write_text(_front(), encoding="utf-8")
    (folder / "_static").mkdir()
    (folder / "_static" / "site.css").write_text(STYLE, encoding="utf-8")


def write_notebooks(folder: Path) -> None:
    """Write a notebook beside each page of the handbook that has a script, and name it on the page."""
    numbers = stored_numbers()
    for name in ORDER:
        note = Note.read(name) if name in NOTES else shorts.note_of(name)
        pictures = [(folder / f"{figure}.svg").read_text(encoding="utf-8") for figure in note.figures]
        (folder / f"{name}.ipynb").write_text(json.dumps(notebook_of(note, numbers[name], pictures), indent=1, ensure_ascii=False) + "\n")
        page = folder / f"{name}.md"
        words = f"## The script\n\nDownload it with its results: {{download}}`{name}.ipynb`\n"
        page.write_text(page.read_text(encoding="utf-8").replace("## The script\n", words, 1), encoding="utf-8")


def _linked(page: Path, folder: Path) -> str:
    """The text of a page with links into the repository that the site does not have as plain words."""
    moved = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md", "README.md": "index.md", "docs/adr": "decisions.md"}
    home = ROOT / "docs" / page.relative_to(folder) if page.name not in ("contributing.md", "changes.md") else ROOT / page.name
    up = "../" * (len(page.relative_to(folder).parts) - 1)

    def link(found: re.Match[str]) -> str:
        sign, text, target = found.groups()
        name, hash_, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target) or not name:
            return found[0]
        path = (home.parent / name).resolve()
        inside = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
        if inside in moved:
            return f"{sign}[{text}]({up}{moved[inside]}{hash_}{anchor})"
        if inside.startswith("docs/") and (folder / inside.removeprefix("docs/")).is_file():
            return f"{sign}[{text}]({up}{inside.removeprefix('docs/')}{hash_}{anchor})"
        return text

    text, out, at = page.read_text(encoding="utf-8"), [], 0
    for fence in HIDDEN.finditer(text):
        out += [LINK.sub(link, text[at : fence.start()]), fence[0]]
        at = fence.end()
    return "".join([*out, LINK.sub(link, text[at:])])


def _toctree(pages: Any, *options: str) -> str:
    return "\n".join(["```{toctree}", *options, "", *pages, "```", ""])


def _front() -> str:
    """The first page: what the README says before its installation, and the sections."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    intro = text[: text.index("## Install")].replace("docs/images/", "images/")
    begin = text[text.index("## Install") : text.index("## Assess your own camera")]
    begin = re.sub(r"\]\(docs/", "](", begin)
    return "\n".join([intro, begin, _toctree((f"{title} <{_name(title)}>" for title in SECTIONS), ":hidden:")])


def _name(section: str) -> str:
    """Name of a section's page; a section of one page is that page."""
    pages = SECTIONS[section]
    return pages[0] if len(pages) == 1 else section.lower().replace(" ", "-")


def missing_files(site: Path) -> list[str]:
    """Pictures, links, styles and scripts that a page of a built site names and that are not there."""
    named = re.compile(r'\b(?:src|href)="([^"#?]+)')
    wrong = []
    for page in sorted(p for p in site.rglob("*.html") if "_static" not in p.parts):
        for target in set(named.findall(page.read_text(encoding="utf-8"))):
            if not re.match(r"[a-z]+:|//", target) and not (page.parent / unquote(target)).exists():
                wrong.append(f"{page.relative_to(site)}: {target}")
    return wrong


def main() -> None:
    """Stage the pages in a temporary folder and build them; a warning is an error."""
    import nbformat
    from sphinx.application import Sphinx

    out = Path(sys.argv[1] if len(sys.argv) > 1 else "site").resolve()
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "pixmetry"
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary) / "pages"
        stage(source)
        for notebook in source.rglob("*.ipynb"):
            nbformat.validate(nbformat.read(notebook, as_version=4))
        app = Sphinx(source, None, out, Path(temporary) / "trees", "html", confoverrides=CONF, warningiserror="--draft" not in sys.argv)
        app.build()
        if app.statuscode:
            raise SystemExit(app.statuscode)
    if wrong := missing_files(out):
        raise SystemExit("not in the site: " + "; ".join(wrong))
    print(f"site: {out / 'index.html'}")


if __name__ == "__main__":
    main()
