"""``pixmetry compare``: changes in units of their uncertainty, cameras that stand out, limits that hold, and the better of budgets."""

from __future__ import annotations

from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixmetry.cli._console import console as plain_console
from pixmetry.cli._console import echo
from pixmetry.cli._json import JsonResult, json_option
from pixmetry.cli._pdf import check_pdf, pdf_option, put_pdf

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rich.console import Console

    from pixmetry.assess.judge.compare import Comparison, Fleet
    from pixmetry.assess.judge.conformity import Checked
    from pixmetry.budget.compare import BudgetComparison
    from pixmetry.core.number import Number

EXIT_DIFFERENT = 1
SCHEMA = "pixmetry/compared/1"
QUIET = ("same", "equal", "setting")
LARGEST_SOURCES = 8  # of a comparison of budgets, without --all
LARGEST = 3  # number of differences that are shown although they are not significant


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--limits", type=click.Path(path_type=Path), metavar="FILE", help="File of limits (YAML) for the values of each file.")
@click.option(
    "--level",
    type=float,
    default=0.95,
    show_default=True,
    help="Confidence level for all values together: the chance that no value is called changed by chance alone.",
)
@click.option(
    "--same-light",
    is_flag=True,
    help="Both measurements used the same calibration of the light: leave its uncertainty out of the differences.",
)
@click.option("--all", "everything", is_flag=True, help="Also show the values that did not change; of budgets, all sources.")
@click.option("--html", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Write the page of a comparison of budgets.")
@pdf_option()
@json_option("the comparison")
def compare(
    files: tuple[Path, ...],
    limits: Path | None,
    level: float,
    same_light: bool,
    everything: bool,
    html: Path | None,
    pdf: Path | None,
    json_file: Path | None,
) -> None:
    """Compare measurements with each other, with a fleet of cameras, or with limits.

    FILES are EMVA 1288 data sheets (JSON or XML), assessments (results.json or its folder) or calibrations (calibration.json or its
    folder). Two files are compared with each other. Of three files or more, each is compared with the median of all. With --limits one file
    is enough.

    Of error budgets (`pixmetry budget --json`), two or more, the best one is named, how sure that is, and what makes the difference.

    Exit status: 0 if nothing changed and all limits hold, and of budgets always; 1 if a value changed, stands out, fails or is undecided; 2
    after an error.
    """
    from pixmetry.assess.judge.compare import check_limits, compare_fleet
    from pixmetry.assess.judge.compare import compare as compare_two
    from pixmetry.budget.compare import compare_budgets, is_budget_file
    from pixmetry.core.errors import InputError

    if len(files) == 1 and limits is None:
        raise InputError("one file cannot be compared", where=str(files[0]), remedy="name a second one, or --limits")
    if any(is_budget_file(path) for path in files):
        refuse_beside_budgets({"--limits": limits is not None, "--same-light": same_light})
        put_budgets(lambda: compare_budgets(files), files, html, pdf, json_file, everything)
        return
    for option, file in (("--html", html), ("--pdf", pdf)):
        if file is not None:
            raise InputError("is for error budgets", where=option, remedy="leave it out, or name files of `pixmetry budget --json`")
    if same_light and len(files) != 2:
        raise InputError("is for two files", where="--same-light", remedy="leave it out")
    written = JsonResult(json_file, SCHEMA, inputs=files)
    console = plain_console(width=116, quiet=written.printed)
    record: dict[str, Any] = {}
    good = True
    if len(files) > 1:
        result = compare_two(*files, level=level, same_light=same_light) if len(files) == 2 else compare_fleet(files, level=level)
        print_comparison(result, console, everything)
        record["comparison"] = result.to_record()
        good = result.same
    if limits is not None:
        from pixmetry.assess.judge.conformity import load_limits

        given = load_limits(limits)
        checked = {str(path): check_limits(path, given) for path in files}
        for name, rows in checked.items():
            print_limits(name, rows, console)
        record["limits"] = [_limit_record(name, row) for name, rows in checked.items() for row in rows]
        good = good and all(row.judgement.verdict == "pass" for rows in checked.values() for row in rows)
    written.put(record)
    if not good:
        click.get_current_context().exit(EXIT_DIFFERENT)


def refuse_beside_budgets(given: Mapping[str, bool]) -> None:
    """Refuse options that a comparison of budgets does not have."""
    from pixmetry.core.errors import InputError

    for option, is_given in given.items():
        if is_given:
            raise InputError("is not for a comparison of error budgets", where=option, remedy="leave it out")


def put_budgets(
    compared: Callable[[], BudgetComparison],
    inputs: Sequence[Path],
    html: Path | None,
    pdf: Path | None,
    json_file: Path | None,
    everything: bool = False,
) -> None:
    """Compare budgets, print the comparison, and write what was asked for."""
    from pixmetry.budget.compare_page import TITLE, page_of
    from pixmetry.files.output import Output, check_files, page_mark, write_page
    from pixmetry.report import html_of

    written = JsonResult(json_file, SCHEMA, inputs=inputs)
    if html is not None:
        check_files([Output(html, page_mark(TITLE))], inputs)
    check_pdf(pdf, inputs)
    found = compared()
    print_budgets(found, plain_console(width=116, quiet=written.printed), everything)
    written.put({"comparison": found.to_record()})
    if html is not None:
        echo(f"page: {write_page(html, html_of(page_of(found)))}", err=written.printed)
    put_pdf(pdf, lambda: page_of(found))


def print_budgets(found: BudgetComparison, console: Console, everything: bool = False) -> None:
    """Print budgets side by side, the verdict, the sources that differ most, and what was not the same."""
    from rich.markup import escape
    from rich.table import Table

    from pixmetry.budget.compare_page import length_of, sentences, settings_of
    from pixmetry.report.numbers import percent, significant

    unit, order = found.unit, [rank.side for rank in found.ranks]
    table = Table(box=None, pad_edge=False)
    table.add_column("budget", no_wrap=True)
    in_px = [] if unit == "px" else ["after /px"]
    for heading in (f"before /{unit}", f"after /{unit}", f"at least /{unit}", f"at most /{unit}", *in_px, "times the best"):
        table.add_column(heading, justify="right")
    for rank in found.ranks:
        side = found.sides[rank.side]
        answer = side.answer
        pairs = (answer.before_px, answer.after_px, answer.least_px, answer.most_px)
        cells = [length_of(side, pair, unit) for pair in pairs] + [length_of(side, answer.after_px, "px") for _ in in_px]
        table.add_row(escape(side.name), *cells, significant(rank.ratio, 3))
    console.print(table)
    for words in sentences(found):
        console.print(words, markup=False, soft_wrap=True)
    scale, small = (1e3, "mpx") if unit == "px" else (1e3, "µm")
    table = Table(box=None, pad_edge=False)
    table.add_column("source")
    for k in order:
        table.add_column(f"{escape(found.sides[k].name)} /{small}", justify="right")
    for k in order[1:]:
        table.add_column("share" if len(order) == 2 else f"share {escape(found.sides[k].name)}", justify="right")
    for row in found.rows if everything else found.rows[:LARGEST_SOURCES]:
        shares = ["" if isnan(row.shares[k]) else f"{percent(row.shares[k])} %" for k in order[1:]]
        table.add_row(escape(row.title), *(significant(scale * row.sizes[k], 2) for k in order), *shares)
    console.print(table)
    if any(not isnan(row.shares[k]) for row in found.rows for k in order[1:]):
        words = "share: of the difference of the squares from the best one; negative where the best one has more of it"
        console.print(words, markup=False, soft_wrap=True)
    for key, values in settings_of(found):
        console.print(f"not the same: {key}: {', '.join(values[k] for k in order)}", markup=False, soft_wrap=True)


def print_comparison(result: Comparison | Fleet, console: Console, everything: bool = False) -> None:
    """Print a comparison of two, or of a fleet.

    Parameters
    ----------
    result : Comparison or Fleet
    console : rich.console.Console
    everything : bool
        Show also what is the same.
    """
    from pixmetry.assess.judge.compare import Comparison

    if isinstance(result, Comparison):
        _print_pair(result, console, everything)
    else:
        _print_fleet(result, console, everything)
    for note in result.notes:
        console.print(f"Note: {note}", markup=False, soft_wrap=True)


def _print_pair(result: Comparison, console: Console, everything: bool) -> None:
    from rich.markup import escape
    from rich.table import Table

    from pixmetry.report.numbers import pretty_unit, signed, significant

    for letter, name in zip("AB", result.names, strict=True):
        console.print(f"{letter}: {name}", markup=False, soft_wrap=True)
    judged = sorted((row for row in result.of("same") if row.p < 1), key=lambda row: -abs(row.in_u))
    near = [row.key for row in judged if abs(row.in_u) >= 0.05][:LARGEST]
    rows = [row for row in result.rows if everything or row.verdict not in QUIET or (row.verdict == "same" and row.key in near)]
    table = Table(box=None, pad_edge=False)
    for name in ("key", "unit", "A", "B", "B − A", "in u", "verdict"):
        numeric = name in ("A", "B", "B − A", "in u")
        table.add_column(name, justify="right" if numeric else "left", no_wrap=numeric or name == "key", overflow="fold")
    for row in rows:
        counts = not row.p >= 1  # not a value below an upper limit
        change = signed(row.difference, lambda x: significant(x, 2)) if row.difference and counts else ""
        in_u = signed(row.in_u, lambda x: f"{x:.1f}") if counts and not isnan(row.in_u) else ""
        verdict = f"{row.verdict}: {row.reason}" if row.reason else row.verdict
        texts = (_named(row.key, row.channel), pretty_unit(row.unit), _shown(row.a), _shown(row.b), change, in_u, verdict)
        table.add_row(*map(escape, texts))
    if rows:
        console.print(table)
    words = {word: word for word in ("changed", "differs", "undecided", "only A", "only B")}
    words |= {"same": "the same within u", "equal": "equal as numbers", "setting": "numbers of levels in the series, not judged"}
    numbers = {verdict: len(result.of(verdict)) for verdict in words}
    console.print("; ".join(f"{n} {words[verdict]}" for verdict, n in numbers.items() if n) + ".", soft_wrap=True)
    if result.decisions:
        chance = f"{100 * (1 - result.level):.3g} %"
        console.print(
            f"{result.decisions} decisions, judged together: the chance that any “changed” is false is at most {chance}.", soft_wrap=True
        )


def _print_fleet(result: Fleet, console: Console, everything: bool) -> None:
    from rich.markup import escape
    from rich.table import Table

    from pixmetry.core.plain_text import ends_of_paths
    from pixmetry.report.numbers import pretty_unit, signed, significant

    table = Table(box=None, pad_edge=False)
    for name in ("key", "unit", "median", "spread", "u", "farthest", "in spreads", "stands out"):
        numeric = name in ("median", "spread", "u", "in spreads")
        table.add_column(name, justify="right" if numeric else "left", no_wrap=numeric, overflow="fold")
    names = ends_of_paths(result.names)
    for row in result.rows:
        out = [name for name, far in zip(names, row.stands_out, strict=True) if far]
        if not out and not everything:
            continue
        far = max(range(len(row.scores)), key=lambda i: -1 if isnan(row.scores[i]) else abs(row.scores[i]))  # noqa: B023
        numbers = [significant(row.median, 4), significant(row.spread, 2), significant(row.u, 2)]
        score = signed(row.scores[far], lambda x: f"{x:.1f}")
        texts = (_named(row.key, row.channel), pretty_unit(row.unit), *numbers, names[far], score, ", ".join(out) or "no")
        table.add_row(*map(escape, texts))
    if table.row_count:
        console.print(table)
    odd = sum(any(row.stands_out) for row in result.rows)
    chance = f"{100 * (1 - result.level):.3g} %"
    console.print(
        f"{len(result.names)} cameras, {len(result.rows)} values; in {odd} of them a camera stands out "
        f"(if all cameras are alike, the chance that any stands out is at most {chance}).",
        soft_wrap=True,
    )


def print_limits(name: str, rows: Sequence[Checked], console: Console) -> None:
    """Print which values of a file keep their limits."""
    from rich.markup import escape
    from rich.table import Table

    from pixmetry.report.numbers import pretty_unit, significant

    table = Table(title=escape(f"Limits: {name}"), title_justify="left", box=None, pad_edge=False)
    for column in ("key", "unit", "value", "limits", "accepted", "conforms with", "verdict"):
        table.add_column(column, no_wrap=column in ("value", "limits", "accepted"), overflow="fold")
    for row in rows:
        judgement = row.judgement
        conforms = "–" if isnan(judgement.probability) else f"{100 * judgement.probability:.2f} %"
        verdict = f"{judgement.verdict}: {judgement.reason}" if judgement.reason else judgement.verdict
        limits, accepted = (_interval(*pair, significant) for pair in ((row.lower, row.upper), judgement.acceptance))
        texts = (_named(row.key, row.channel), pretty_unit(row.value.unit), _shown(row.value), limits, accepted, conforms, verdict)
        table.add_row(*map(escape, texts))
    console.print(table)
    for advice in dict.fromkeys(row.finding.advice for row in rows if row.finding.advice):
        console.print(f"To do: {advice}", markup=False, soft_wrap=True)


def _interval(lower: float, upper: float, number: Any) -> str:
    if isnan(lower):
        return "none"
    if lower == float("-inf"):
        return f"≤ {number(upper, 4)}"
    return f"≥ {number(lower, 4)}" if upper == float("inf") else f"{number(lower, 4)} … {number(upper, 4)}"


def _named(key: str, channel: str) -> str:
    from pixmetry.emva.records import MONO

    return key if channel == MONO else f"{key} [{channel}]"


def _shown(value: Number | None) -> str:
    """A value with its uncertainty, rounded to two digits of the uncertainty."""
    from pixmetry.report.numbers import decimals_of, fixed, significant

    if value is None or isnan(value.value):
        return "–"
    if value.is_upper_limit:
        return f"< {significant(value.value, 2)}"
    if value.is_lower_limit:
        return f"> {significant(value.value, 3)}"
    if not value.u > 0:
        return significant(value.value, 7)
    if not 1e-4 <= abs(value.value) < 1e6:
        return f"{significant(value.value, 3)} ± {significant(value.u, 2)}"
    places = decimals_of(value.u)
    return f"{fixed(value.value, places)} ± {fixed(value.u, places)}"


def _limit_record(name: str, row: Checked) -> dict[str, Any]:
    from pixmetry.emva.files.json_format import value_record
    from pixmetry.files.strict_json import plain

    judgement, words = row.judgement, row.finding.to_record()
    return value_record(row.value) | {
        "file": name,
        "channel": row.channel,
        "key": row.key,
        "verdict": judgement.verdict,
        "reason": judgement.reason or row.value.reason,
        "rule": judgement.rule,
        "min": None if row.lower == float("-inf") else row.lower,
        "max": None if row.upper == float("inf") else row.upper,
        "probability": plain(judgement.probability),
        "guard_band": plain(judgement.guard_band),
        "acceptance": plain(judgement.acceptance),
        **{name: words[name] for name in ("text", "advice", "level")},
    }
