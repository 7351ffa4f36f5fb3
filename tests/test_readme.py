"""What the README shows must run."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

import pytest

from pixmetry.core.config import load_yaml, validate
from pixmetry.files.schema import ManifestModel
from pixmetry.scene.files import read_scene

README = Path(__file__).resolve().parents[1] / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README.read_text(), re.M | re.S)


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = blocks("python")
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace('"campaign.yaml"', "None"), "README", "exec"), {})
    said = capsys.readouterr().out
    assert "(4, 64, 96)" in said
    assert (tmp_path / "result" / "report.html").is_file()


def test_the_yaml_examples_are_valid(tmp_path: Path) -> None:
    assert len(blocks("yaml")) == 3
    for i, text in enumerate(blocks("yaml")):
        path = tmp_path / f"{i}.yaml"
        path.write_text(text)
        if "pixmetry/scene/1" in text:
            read_scene(path)
        else:
            validate(ManifestModel, load_yaml(path), "README")


def test_the_printed_example_is_what_the_program_says(tmp_path: Path) -> None:
    """Word for word; numbers to 5 % or one unit of the last digit, for other processors and library versions round otherwise."""
    from click.testing import CliRunner

    from pixmetry.cli import main

    said = CliRunner().invoke(main, ["assess", "-o", str(tmp_path / "pixmetry-report")]).output
    # what is accepted changes with every new source
    said, shown = (text.partition("Accepted")[0].split() for text in (said, blocks("text")[0]))
    assert len(shown) == len(said)
    for one, other in zip(shown, said, strict=True):
        if re.fullmatch(r"\d+\.\d+", one):
            assert float(other) == pytest.approx(float(one), rel=0.05, abs=1.01 * 10.0 ** -len(one.partition(".")[2]))
        elif not one.isdigit():
            assert one == other


def test_the_picture_shows_the_numbers_of_the_printed_example() -> None:
    """Both are made from the packaged example: the same sources with the same shares, and the same total."""
    picture = (README.parent / "docs" / "images" / "chain.svg").read_text(encoding="utf-8")
    assert len(picture) < 60_000
    label = re.search(r'aria-label="(.*?)"', picture)
    assert label
    drawn = dict(re.findall(r"(?:^|; )(.+?) \d\.\d+ px, (?:< )?(\d+) %", unescape(label[1])))
    shown = re.findall(r"^(.+?)  +(?:measured|modelled).* (\d+) %  ", blocks("text")[0], re.M)
    assert len(drawn) > 4 and len(shown) == 8
    for title, share in shown:
        if title in drawn:
            assert drawn[title] == (share if share != "0" else "1"), title
    assert set(drawn) <= {title for title, _ in shown}
    total = re.search(r"a target is (\S+) px", " ".join(blocks("text")[0].split()))
    assert total and f"u = {total[1]} px" in picture
