"""``--pdf FILE`` in the commands that write a page: a PDF of ours, and no file of another kind is lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from pixmetry.cli import COMMANDS, main

SCENE = """\
schema: pixmetry/scene/1
uniform: {level_photons: 500}
discs: {x_px: [60.3], y_px: [40.4], diameter_px: 7, blur_px: 0.7, peak_photons: 9000}
"""

def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture
def commands(tmp_path: Path) -> dict[str, list[str]]:
    scene = tmp_path / "scene.yaml"
    scene.write_text(SCENE)
    return {
        "assess": ["assess", "-o", tmp_path / "assessed", "--trials", 200],
        "chain": ["chain", "imx264_like", scene, "-o", tmp_path / "chain.html"],
    }


@pytest.mark.parametrize("name", ["assess", "chain"])
def test_the_page_is_written_as_pdf_too(commands: dict[str, list[str]], name: str, tmp_path: Path) -> None:
    file = tmp_path / "page.pdf"
    done = run(*commands[name], "--pdf", file)
    assert done.exit_code == 0, done.output
    assert file.read_bytes().startswith(b"%PDF-1") and f"pdf: {file}" in done.output
    file.write_bytes(b"%PDF-1.4 of somebody else")
    refused = run(*commands[name], "--pdf", file)
    assert refused.exit_code == 2 and "no result of this kind" in refused.output
    assert file.read_bytes() == b"%PDF-1.4 of somebody else"


def test_every_command_with_a_page_has_it() -> None:
    having = {name for name in COMMANDS if any("--pdf" in option.opts for option in main.get_command(None, name).params)}
    assert having == {"assess", "calibrate", "chain", "emva1288"}
