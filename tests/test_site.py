"""The documentation site: every page has its section, every source and public name its page, every link its page. `make docs` builds it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from gallery.note import Note, stored_numbers
from gallery.notebooks import notebook_of
from gallery.pages import NOTES, ORDER
from site_pages import source_pages

import pixmetry
from pixmetry.camera.catalogue import get_source, sources
from test_docs_links import broken

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_site", ROOT / "scripts" / "make_site.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_all_pages_are_there_and_linked(maker: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_pages, "_draw", lambda *_: "")
    pages = tmp_path / "pages"
    maker.stage(pages)
    assert {p.stem for p in (pages / "sources").glob("*.md")} == {"index", *sources()}
    shown = {p.stem.rpartition("-")[0] for p in (pages / "api").glob("*.rst")}
    assert shown == {name.lower() for name in pixmetry.__all__ if not name.startswith("_")}
    assert {p.stem for p in (pages / "handbook").glob("*.ipynb")} == set(ORDER)
    wrong = {p.name: links for p in pages.rglob("*.md") if (links := broken(p, p.read_text(encoding="utf-8")))}
    assert not wrong


def test_a_notebook_has_the_script_of_its_page_and_prints_what_it_holds(capsys: pytest.CaptureFixture[str]) -> None:
    numbers, names = stored_numbers(), {}
    for name in NOTES:
        note = Note.read(name)
        made = notebook_of(note, numbers[name], ["<svg/>"] * len(note.figures))
        code = {cell["id"]: "".join(cell["source"]) for cell in made["cells"] if cell["cell_type"] == "code"}
        assert code["numbers"] + "\n\n\n" + code["functions"] == note.script.partition('"""\n\n')[2].strip()
        assert len(made["cells"][-1]["outputs"]) == len(note.figures)
        assert len({cell["id"] for cell in made["cells"]}) == len(made["cells"])
        if name == "interline":  # a quick one
            for part in ("numbers", "functions", "run"):
                exec(compile(code[part], name, "exec"), names)
            assert capsys.readouterr().out == "".join(made["cells"][3]["outputs"][0]["text"])


def test_a_picture_that_a_page_names_must_be_in_the_site(maker: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "a b.svg").write_text("<svg/>")
    (tmp_path / "a.html").write_text('<img src="a%20b.svg"><a href="a.html#x">here</a><a href="https://example.org/b.html">there</a>')
    assert maker.missing_files(tmp_path) == []
    (tmp_path / "a.html").write_text('<img src="figure.svg">')
    assert maker.missing_files(tmp_path) == ["a.html: figure.svg"]


def test_a_page_without_a_section_stops_the_build(maker: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_pages, "_draw", lambda *_: "")
    monkeypatch.setitem(maker.SECTIONS, "Getting started", ["start-test-field"])
    with pytest.raises(SystemExit, match="start-simulation"):
        maker.stage(tmp_path / "pages")


def test_a_source_is_drawn_with_and_without(tmp_path: Path) -> None:
    """PRNU changes an even field; a window offset moves a target; what no frame at rest shows has no figure."""
    cameras = source_pages.small_cameras()
    for source_id in ("sensor.prnu", "grabber.window_offset"):
        assert source_pages._draw(get_source(source_id), cameras, tmp_path / "a.svg")
        assert (tmp_path / "a.svg").stat().st_size > 5000
    assert not source_pages._draw(get_source("scene.view_point"), cameras, tmp_path / "b.svg")
    assert not (tmp_path / "b.svg").exists()
