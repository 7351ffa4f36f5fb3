"""The page docs/closed-loop.md: one part each from the studies, between marks, so that one study does not touch the other's part."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from statistical.closed_loop import Line, Score, failures, summarise

HEAD = """# Does the loop close?

A camera with known errors is simulated from the light to the stored number; its frames are measured blind; every estimate is compared with
the truth. What is printed here was written by `make study`.
"""


def write_section(page: Path, name: str, text: str) -> None:
    """Put a part into the page in place of the older one of the same name."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    old = page.read_text(encoding="utf-8") if page.exists() else HEAD
    part = f"{begin}\n{text.strip()}\n{end}"
    if begin in old:
        before, after = old.split(begin)[0], old.split(end)[1]
        old = before + part + after
    else:
        old = f"{old.rstrip()}\n\n{part}\n"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(old, encoding="utf-8")


def _number(value: float, form: str) -> str:
    return "–" if value != value else format(value, form)


def _row(line: Line, bad: set[str]) -> str:
    inside = "–" if line.inside_95 != line.inside_95 else f"{100 * line.inside_95:.1f} %"
    small = f"{line.missed} of {line.n_small}" if line.n_small else "–"
    verdict = "**fails**" if line.name in bad else "holds"
    return (
        f"| {line.name} | {line.n} | {_number(line.p_uniform, '.2g')} | {_number(line.mean_z, '+.2f')} | {_number(line.std_z, '.2f')} | {inside} "
        f"| {_number(line.u_ratio, '.3f')} | {line.lost or '–'} | {small} | {verdict} |"
    )


def cameras_section(results: list[list[Score] | str], seed: int, first: int, rate: float) -> str:
    """The table of the random cameras."""
    refused = Counter(r for r in results if isinstance(r, str))
    scores = [s for r in results if not isinstance(r, str) for s in r]
    lines = summarise(scores)
    wrong = failures(lines, rate)
    bad = {w.split(": ")[0] for w in wrong}
    rows = "\n".join(_row(line, bad) for line in lines)
    told = "\n".join(f"* {count} × {why}" for why, count in refused.items()) or "* none"
    failed = "\n".join(f"* {w}" for w in wrong) or "* none"
    return f"""## {len(results)} random cameras

Cameras {first} to {first + len(results) - 1} of seed {seed}.

| quantity | n | KS p | mean z | std z | in 95 % | u / u_ref | not resolved | small: missed | |
|---|---|---|---|---|---|---|---|---|---|
{rows}

Contradictions at a rate of {rate:g} for all quantities together:

{failed}

Cameras refused:

{told}
"""
