"""The pages in docs/handbook are what the experiments give now, and they can be read."""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from gallery import questions, shorts
from gallery.chapter import ENTRIES, entry_of
from gallery.chapter import NOTES as CHAPTER_NOTES
from gallery.item import KINDS, REASONS, Item
from gallery.note import MOST_LINES, STORED, Note
from gallery.page import Page, table
from gallery.pages import NOTES, ORDER, Gallery, make_gallery

from pixmetry.core.errors import InputError

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "handbook"
NUMBER = re.compile(r"[−-]?\d+(?:\.\d+)?")


def differences(written: str, now: str) -> list[str]:
    """Words that differ, and numbers that differ by more than three units of their last digit or 1 %."""
    if NUMBER.split(written) != NUMBER.split(now):
        return ["the words differ"]
    wrong = []
    for old, new in zip(NUMBER.findall(written), NUMBER.findall(now), strict=True):
        a, b = (float(v.replace("−", "-")) for v in (old, new))
        digits = max(len(v.partition(".")[2]) for v in (old, new))
        if abs(a - b) > max(3.1 * 10.0**-digits, 0.01 * abs(b)) or (digits == 0 and a != b):
            wrong.append(f"{old} is written, {new} is found")
    return wrong


QUICK = [name for name in NOTES if not Note.read(name).slow]  # the others show the numbers that they stored


@pytest.fixture(scope="module")
def gallery() -> Gallery:
    return make_gallery(QUICK)


@pytest.fixture(scope="module")
def pages(gallery: Gallery) -> dict[str, Page]:
    return gallery.pages


@pytest.mark.parametrize("name", ["index", questions.NAME, *ORDER])
def test_the_page_is_what_the_script_writes(name: str, pages: dict[str, Page]) -> None:
    wrong = differences((FOLDER / f"{name}.md").read_text(encoding="utf-8"), pages[name].text)
    assert not wrong, f"run make handbook: {wrong[:5]}"
    for shown, alt in re.findall(r'<img src="([^"]+)" width="\d+" alt="([^"]*)">', pages[name].text):
        label = re.search(r'aria-label="([^"]*)"', (FOLDER / shown).read_text(encoding="utf-8"))
        assert label is not None and not differences(label[1], alt)


def test_the_record_of_all_items_is_what_the_scripts_write(gallery: Gallery) -> None:
    wrong = differences(STORED.read_text(encoding="utf-8"), gallery.record)
    assert not wrong, f"run make handbook: {wrong[:5]}"
    record = json.loads(gallery.record)
    assert len({item["id"] for item in record["items"]}) == len(record["items"]) == len(gallery.items)


def test_every_figure_table_number_and_note_of_the_chapter_is_there(gallery: Gallery) -> None:
    """24 figures, 3 tables, 26 numbers and 22 notes: each has an item or a page, and no item is of nothing that the chapter has."""
    figures, tables = [f"Fig 3.{k}" for k in range(1, 25)], ["T3.1", "T3.1 errors", "T3.2"]
    assert list(ENTRIES) == [*figures, *tables, *(f"N{k}" for k in range(1, 27))]
    found = {entry_of(item.id) for item in gallery.items}
    assert set(ENTRIES) <= found
    assert found - set(ENTRIES) <= {f"Note {k}" for k in range(1, 23)}
    assert len(CHAPTER_NOTES) == 22 and set(CHAPTER_NOTES) <= set(ORDER)
    text = gallery.pages["index"].text.partition("Each is on a page")[2].partition("## ")[0]
    listed = re.findall(r"^\| ((?:Fig|T|N)[\w. ]+) \|", text, re.M)
    assert listed == list(ENTRIES)


def test_every_verdict_is_one_of_three_and_says_why(gallery: Gallery) -> None:
    for item in gallery.items:
        assert item.kind in KINDS
        inside = abs(item.ours - item.expected) <= item.tolerance
        assert (item.verdict == "agree") == inside, item.id
        if not inside:
            assert item.why and (item.verdict == "chapter inconsistent" or item.verdict.startswith(REASONS[1])), item.id
            assert len(re.findall(r"\d", item.why)) or item.kind in "SVD", (
                f"{item.id}: the reason of an arithmetic item has its computation"
            )


@pytest.mark.parametrize("name", ORDER)
def test_a_script_is_short_and_takes_only_what_a_user_has(name: str) -> None:
    script = (Note.read(name) if name in NOTES else shorts.note_of(name)).script
    assert len(script.splitlines()) <= MOST_LINES
    imported = set(re.findall(r"^\s*(?:from|import) (\w+)", script, flags=re.M))
    assert imported <= {"numpy", "pixmetry", "matplotlib", *sys.stdlib_module_names} and not re.search(r"pixmetry[\w.]*\._", script)


def test_one_number_changed_in_a_script_gives_the_answer_that_the_page_tells() -> None:
    told = json.loads(STORED.read_text(encoding="utf-8"))["numbers"]
    assert len(questions.QUESTIONS) >= 5
    for k, question in enumerate(questions.QUESTIONS):
        for name, value in question.run().items():
            assert value == pytest.approx(told[questions.NAME][f"{k}_{name}"], rel=0.01), question.ask
        assert any(told[questions.NAME][f"{k}_{name}"] != told[question.page][name] for name in question.shown), question.ask


def test_the_short_scripts_give_the_numbers_of_their_pages() -> None:
    """Threshold: 800 other targets with standard errors of 2.5 %, so 15 % is four of the difference; the offset's are exact."""
    from gallery import error_table_page, offset, threshold

    told = json.loads(STORED.read_text(encoding="utf-8"))["numbers"]
    noisy, at = threshold.sweep(threshold.DISC).noisy, threshold.THRESHOLDS_DN.tolist().index(25.0)
    for name, curve in (("hard_25", "centroid"), ("squared_25", "squared centroid"), ("soft_25", "soft centroid")):
        assert told["threshold"][name] == pytest.approx(noisy[curve].rms_px[at], rel=0.15)
    for conversion, name in (("unquantised", "unrounded"), ("rounded", "rounded"), ("truncated", "truncated")):
        found = offset.swing(offset.OFFSET_DN, conversion)
        assert told["offset"][f"rms_{name}"] == pytest.approx(found.rms_px, rel=1e-4)
        assert told["offset"][f"first_{name}"] == pytest.approx(abs(found.first_px), rel=1e-4)
    assert told["error-table"]["chapter_x"] == pytest.approx(error_table_page.chapter_budget().one.after_px[0], rel=1e-3)
    assert told["line-jitter"]["told_ns_5"] == pytest.approx(5.0, rel=0.1)  # 2 % by 1380 rows, 3 % by the response


def test_there_are_no_other_files(pages: dict[str, Page]) -> None:
    figures = {f"{figure}.svg" for name in NOTES for figure in Note.read(name).figures}
    figures |= {f"{name}-script.svg" for name in shorts.SHORTS}
    wanted = {name for page in pages.values() for name in page.files()} | figures | {STORED.name}
    assert {path.name for path in FOLDER.iterdir()} == wanted


def test_figures_stand_alone_and_hold_no_date(pages: dict[str, Page]) -> None:
    made = [content for page in pages.values() for name, content in page.files().items() if name.endswith(".svg")]
    for group in (made, [path.read_text(encoding="utf-8") for path in FOLDER.glob("*.svg")]):
        for content in group:
            root = ET.fromstring(content)
            assert root.tag == "{http://www.w3.org/2000/svg}svg" and int(root.get("width", 0)) > 300
            used = set(re.findall(r"var\(--(\w+)\)", content))
            assert used <= set(re.findall(r"--(\w+):", content))
            assert "dc:date" not in content and len(content) < 120_000


def test_links_lead_somewhere(pages: dict[str, Page]) -> None:
    for page in pages.values():
        for target in re.findall(r"\]\(([^)#]+)\)", page.text):
            assert (FOLDER / target).exists(), target


def test_a_table_is_as_wide_as_its_head() -> None:
    text = table(["a", "b"], [[1, 2], ["x", "y"]])
    assert text == "| a | b |\n| --- | ---: |\n| 1 | 2 |\n| x | y |\n"


def test_planted_changes_are_seen() -> None:
    assert not differences("it is 0.0302 px at −6", "it is 0.0303 px at −6")
    assert differences("it is 0.0302 px", "it is 0.0312 px")
    assert differences("it is 0.030 px", "it was 0.030 px")
    assert differences("800 targets", "801 targets")
    assert differences("−0.03 px", "0.03 px")


@pytest.mark.parametrize(
    ("ours", "otherwise", "verdict"),
    [
        (1.05, "", "agree"),
        (1.2, "differs because it is another camera", "differs because it is another camera"),
        (0.8, "chapter inconsistent: 2 - 1.2 = 0.8", "chapter inconsistent"),
    ],
)
def test_a_verdict_follows_from_the_numbers(ours: float, otherwise: str, verdict: str) -> None:
    assert Item.judged("N1", "ratio", "E", 1.0, ours, 0.1, otherwise=otherwise).verdict == verdict


@pytest.mark.parametrize(
    ("ours", "otherwise"), [(1.2, ""), (1.05, "differs because it is another camera"), (1.2, "because: so"), (float("nan"), "")]
)
def test_a_verdict_against_the_numbers_is_refused(ours: float, otherwise: str) -> None:
    with pytest.raises(InputError):
        Item.judged("N1", "ratio", "E", 1.0, ours, 0.1, otherwise=otherwise)
