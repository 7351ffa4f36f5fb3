"""The way in: the package's public names, and the command line's behaviour before any command runs."""

from __future__ import annotations

import ast
import functools
import os
import re
import signal
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import pixmetry
from pixmetry import cli
from pixmetry.core.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"numba", "pydantic", "matplotlib", "scipy", "rich", "zarr", "imagecodecs", "tifffile"}


def python(code: str, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=os.environ | env)


def modules_after(code: str) -> set[str]:
    done = python(f"import atexit, sys\natexit.register(lambda: print('\\nMODULES', *sys.modules))\n{code}")
    assert done.returncode == 0, done.stderr
    return {name.partition(".")[0] for name in done.stdout.rpartition("MODULES")[2].split()}


@pytest.mark.parametrize(
    "code",
    [
        "import pixmetry",
        "import sys; sys.argv = ['pixmetry', '--help']; from pixmetry.cli import main; main()",
        "import sys; sys.argv = ['pixmetry', '--version']; from pixmetry.cli import main; main()",
    ],
)
def test_the_door_imports_nothing_heavy(code: str) -> None:
    loaded = modules_after(code)
    assert "pixmetry" in loaded
    assert not loaded & HEAVY


def test_modules_after_sees_what_is_imported() -> None:
    assert "tifffile" in modules_after("import tifffile")


def test_help_names_every_command_and_its_text() -> None:
    result = CliRunner().invoke(cli.main, ["--help"])
    assert result.exit_code == 0
    words = " ".join(result.output.split())
    for name, text in cli.COMMANDS.items():
        assert f"{name} {text}" in words


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_answers_help(name: str) -> None:
    result = CliRunner().invoke(cli.main, [name, "--help"])
    assert result.exit_code == 0, result.output
    assert result.output.startswith(f"Usage: main {name}")


def test_unknown_command_is_a_usage_error() -> None:
    result = CliRunner().invoke(cli.main, ["asess"])
    assert result.exit_code == 2
    assert result.stderr == "error: No such command 'asess'; to do: see `main --help`\n"
    result = CliRunner().invoke(cli.main, ["--nope"])
    assert result.exit_code == 2 and result.stderr == "error: No such option '--nope'; to do: see `main --help`\n"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch):
    """Put a command in the place of ``sources`` that raises what it is given."""

    def plant(error: BaseException) -> None:
        @click.command()
        def sources() -> None:
            raise error

        module = type(sys)("pixmetry.cli.sources")
        module.sources = sources
        monkeypatch.setitem(sys.modules, "pixmetry.cli.sources", module)

    return plant


def test_deliberate_errors_are_one_line_and_exit_2(command) -> None:
    command(InputError("unknown key\n'gian'", where="camera.yaml:3", allowed="gain", remedy="correct it"))
    result = CliRunner().invoke(cli.main, ["sources"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == "error: camera.yaml:3: unknown key 'gian'; allowed: gain; to do: correct it\n"


def test_interrupt_is_one_line_and_exit_130(command) -> None:
    command(KeyboardInterrupt())
    result = CliRunner().invoke(cli.main, ["sources"])
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "interrupted\n")


def test_unexpected_errors_keep_their_traceback(command) -> None:
    mistake = ZeroDivisionError("a mistake in the program")
    command(mistake)
    result = CliRunner().invoke(cli.main, ["sources"])
    assert result.exception is mistake


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_a_real_interrupt_exits_130() -> None:
    code = (
        "import click, sys, time\n"
        "from pixmetry import cli\n"
        "@click.command()\n"
        "def sources():\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(60)\n"
        "module = type(sys)('pixmetry.cli.sources')\n"
        "module.sources = sources\n"
        "sys.modules[module.__name__] = module\n"
        "cli.main(['sources'])\n"
    )
    heeds = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # what runs in the background of a shell ignores it
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code], preexec_fn=heeds, **pipes) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=30)
    assert (process.returncode, stderr) == (130, "interrupted\n")


def test_python_dash_m_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "pixmetry", "--version"], capture_output=True, text=True, timeout=60)
    assert done.stdout == f"pixmetry {pixmetry.__version__}\n"


@pytest.mark.parametrize("name", [n for n in pixmetry.__all__ if n != "__version__"])
def test_public_names_are_what_their_modules_define(name: str) -> None:
    home = pixmetry._HOMES[name]
    assert find_spec(home) is not None
    assert getattr(pixmetry, name) is getattr(sys.modules[home], name)
    assert name in dir(pixmetry)


def test_type_checkers_and_readers_see_the_same_public_names() -> None:
    tree = ast.parse(Path(pixmetry.__file__).read_text())
    typed = {
        (alias.name, node.module)
        for block in ast.walk(tree)
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == set(pixmetry._HOMES.items())
    assert set(pixmetry.__all__) == {*pixmetry._HOMES, "__version__"}


def test_unknown_public_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'pixmetry' has no attribute 'asess'"):
        pixmetry.asess  # noqa: B018


def test_version_and_licence_are_stated_once_and_alike() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == pixmetry.__version__
    assert re.search(r"^license: (.*)$", citation, re.M)[1] == project["license"]
    assert f"## {pixmetry.__version__}" in (ROOT / "CHANGELOG.md").read_text()
