"""The command ``pixmetry``.

The group knows the name and the one-line help of each command; the command's own module is imported when it is used, so that
``pixmetry --help`` answers at once.
"""

from __future__ import annotations

import codecs
import errno
import io
import sys
import unicodedata
from importlib import import_module
from typing import Any

import click

from pixmetry import __version__
from pixmetry.cli._console import echo
from pixmetry.core.errors import PixmetryError

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as a shell reports it
COMPILING = (
    "compiling kernels for this processor, once after an installation or an upgrade: a minute or so for this command; "
    "`pixmetry warm-up` compiles those of all commands"
)
_OS_REMEDIES = {errno.ENOSPC: "make room, or choose another folder", errno.ENAMETOOLONG: "choose a shorter name"}

# Each command lives in the module of its name below this package (- is _ there), as a click command of that name.
COMMANDS = {
    "init": "Draft the manifest of a folder of frames, and ask what the files do not tell.",
    "capture": "Take the frames of a shooting list with a live camera, or from a folder that fills.",
    "assess": "Assess a camera from dark and bright frames: error sources, error budget, advice, report.",
    "emva1288": "Test a camera by EMVA 1288 and write its data sheet, with uncertainties.",
    "sources": "List the error sources, or explain one of them.",
    "simulate": "Simulate frames of a camera whose errors are known.",
    "chain": "Show on one page how each error source of a camera moves a target.",
    "locate": "Measure the positions of targets or lines, with their covariance.",
    "calibrate": "Calibrate a camera from images of a test field or from a table of image coordinates.",
    "board": "Draw a test field to print, with the coordinates of its points.",
    "series": "Follow a fixed field over time: warm-up of camera and frame grabber, when it is stable.",
    "bound": "Compute how well a target can be located (Cramér–Rao bound), and what limits it.",
    "budget": "Budget every error source of a camera for a measurement, before and after calibration.",
    "bench": "Open a page to move what a camera is, and to see what it does to a target.",
    "view": "Look at a result on a page: tables, maps, positions and residuals.",
    "shoot-list": "List the frames to take of a camera: set-ups, counts, charts to print, a manifest to fill in.",
    "correct": "Correct frames for what is known of their camera, measured or described.",
    "corrected": "Correct positions for what is known of their camera's geometry.",
    "compare": "Compare measurements with each other, with a fleet of cameras, or with limits.",
    "fleet": "Put many cameras on one page: distributions, cameras that stand out, limits, drift over time.",
    "warm-up": "Compile the kernels of all commands, so that no command waits for it later.",
}


_PLAIN = {"×": "x", "·": "*", "µ": "u", "μ": "u", "±": "+-", "–": "-", "—": "-", "−": "-", "…": "...", "≤": "<=", "≥": ">=", "√": "sqrt"}
_PLAIN |= {"σ": "sigma", "η": "eta", "δ": "delta", "°": " deg", "⁻": "-", "→": "->", "“": '"', "”": '"', "’": "'", "‘": "'", "\u202f": " "}


def _plain(problem: UnicodeError) -> tuple[str, int]:
    """Replace characters that the terminal's encoding does not have by characters that it has: an error handler of codecs."""
    if not isinstance(problem, UnicodeEncodeError):
        raise problem
    signs = problem.object[problem.start : problem.end]
    letters = (_PLAIN.get(c) or unicodedata.normalize("NFKD", c).encode("ascii", "ignore").decode() or "?" for c in signs)
    return "".join(letters), problem.end


codecs.register_error("pixmetry.plain", _plain)


class LazyGroup(click.Group):
    """A group that imports a command when it is used, and prints an error of pixmetry in one line."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper) and codecs.lookup(stream.encoding).name != "utf-8":
                stream.reconfigure(errors="pixmetry.plain")
        return super().main(*args, **kwargs)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        name = cmd_name.replace("-", "_")
        command: click.Command = getattr(import_module(f"{__name__}.{name}"), name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        try:
            return super().make_context(*args, **kwargs)
        except click.UsageError as problem:
            raise _printed(problem) from None

    def invoke(self, ctx: click.Context) -> Any:
        from pixmetry.core.compiling import tell_when_compiling

        tell_when_compiling(lambda: click.echo(COMPILING, err=True))
        try:
            return super().invoke(ctx)
        except click.UsageError as problem:
            raise _printed(problem) from None
        except PixmetryError as error:
            echo(f"error: {' '.join(str(error).split())}", err=True)
            ctx.exit(EXIT_ERROR)
        except OSError as problem:
            if problem.errno in (None, errno.EPIPE):  # click knows what to do about a closed pipe
                raise
            where = f"{problem.filename}: " if problem.filename else ""
            remedy = _OS_REMEDIES.get(problem.errno, "check the path and its permissions, or choose another")
            echo(f"error: {where}{problem.strerror}; to do: {remedy}", err=True)
            ctx.exit(EXIT_ERROR)
        except UnicodeEncodeError as problem:
            if "surrogates" not in problem.reason:
                raise
            click.echo("error: a path is not valid UTF-8; to do: rename the file or folder", err=True)
            ctx.exit(EXIT_ERROR)
        except MemoryError as problem:
            said = f" ({problem})" if str(problem) else ""
            click.echo(f"error: there is not enough memory{said}; to do: take smaller or fewer frames, or fewer threads", err=True)
            ctx.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            ctx.exit(EXIT_INTERRUPTED)


def _printed(problem: click.UsageError) -> Exception:
    """Print a wrong argument in one line, and return the exception to raise."""
    if isinstance(problem, click.exceptions.NoArgsIsHelpError):
        return problem
    name = problem.ctx.command_path if problem.ctx else "pixmetry"
    message = " ".join(problem.format_message().split()).rstrip(".")
    echo(f"error: {message}; to do: see `{name} --help`", err=True)
    return click.exceptions.Exit(EXIT_ERROR)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(__version__, "-V", "--version", prog_name="pixmetry", message="%(prog)s %(version)s")
@click.option(
    "--source-file",
    "source_files",
    multiple=True,
    type=click.Path(),
    metavar="FILE",
    help="A Python file that defines an error source of your own. The file is run. May be repeated.",
)
def main(source_files: tuple[str, ...]) -> None:
    """Find out how accurately your camera measures positions.

    pixmetry simulates, measures, corrects and budgets the error sources of a camera, from the lens to the stored number. Every result has
    its uncertainty.
    """
    if source_files:
        from pixmetry.camera.catalogue import add_source_file

        for path in source_files:
            add_source_file(path)
