"""``--json FILE`` in every command that has it: in a file or printed, and no file of another kind is lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from pixmetry.cli import COMMANDS, main

QUICK = {
    "sources": (["sources"], "pixmetry/sources/1"),
    "one source": (["sources", "sensor.prnu"], "pixmetry/source/1"),
    "bound": (["bound", "--radius", "3", "--blur", "0.7", "--amplitude", "150"], "pixmetry/bound/1"),
}


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[list[str], str]]:
    """All commands that have the option and need no pictures of a test field (calibrate: tests/calibrate/test_calibrate_command.py)."""
    sheet = tmp_path_factory.mktemp("sheet") / "sheet.json"
    assert run("emva1288", "--json", sheet).exit_code == 0
    return QUICK | {
        "data sheet": (["emva1288"], "pixmetry/emva1288/"),
        "preflight": (["emva1288", "--preflight"], "pixmetry/preflight/"),
        "comparison": (["compare", sheet, sheet], "pixmetry/compared/"),
    }


@pytest.mark.parametrize("name", [*QUICK, "data sheet", "preflight", "comparison"])
def test_the_file_holds_what_is_printed_with_a_dash(commands: dict[str, tuple[list[str], str]], name: str, tmp_path: Path) -> None:
    command, schema = commands[name]
    file = tmp_path / "out.json"
    written = run(*command, "--json", file)
    assert written.exit_code == 0, written.output
    printed = run(*command, "--json", "-")
    told, stored = json.loads(printed.stdout), json.loads(file.read_text(encoding="utf-8"))
    first, value = next(iter(told.items()))
    assert first == "schema" and value.startswith(schema)
    if name == "data sheet":  # it tells when it was made
        told, stored = ({key: record[key] for key in ("camera", "conditions", "results")} for record in (told, stored))
    assert told == stored and not Path("-").exists()
    assert run(*command, "--json", file).exit_code == 0  # its own earlier result is replaced
    file.write_text('{"schema": "pixmetry/results/1"}')
    refused = run(*command, "--json", file)
    assert refused.exit_code == 2 and "no result of this kind" in refused.output
    assert file.read_text() == '{"schema": "pixmetry/results/1"}'


def test_the_option_is_the_same_in_all_commands() -> None:
    for name in COMMANDS:
        for option in main.get_command(None, name).params:
            if "--json" in option.opts:
                assert not option.is_flag, name
                assert "JSON" in option.help, name
