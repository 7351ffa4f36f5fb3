"""The page docs/closed-loop.md: one part each from the studies, between marks, so that one study does not touch the other's part."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from statistical.closed_loop import Line, Score, failures, planted, summarise

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
    cautious = line.name in bad and line.std_z < 1 and line.p_scatter < min(line.p_uniform, line.p_mean)
    verdict = "holds" if line.name not in bad else "u too large" if cautious else "**fails**"
    return (
        f"| {line.name} | {line.n} | {_number(line.p_uniform, '.2g')} | {_number(line.mean_z, '+.2f')} | {_number(line.std_z, '.2f')} "
        f"| {inside} | {_number(line.u_ratio, '.3f')} | {line.lost or '–'} | {small} | {verdict} |"
    )


EXPLAINED = """\
Gain 0.02 to 4 DN/e-, 8 to 14 bit, dark noise 2 to 90 e-, temporal row and column noise, dark current to 500 e-/s, fixed patterns
of pixels, rows and columns, a non-linearity of a few per cent, a full well or a converter that clips first, efficiency 0.2 to 0.9
with the photons known, lamp noise to 0.2 % from level to level, shading; some with hot pixels, waves, or codes of unequal width.
64 × 96 to 240 × 320 pixels, 12 to 50 levels of two frames, two stacks of 16 to 40. Told to the observer: bits, exposure times,
photons.

Each estimate gives p, the probability of a value below it by Student's t with its stated u and degrees of freedom; p must be
uniform. z is the normal quantile of p: mean 0, standard deviation 1. *KS p* is the Kolmogorov-Smirnov probability. *u / u_ref*:
median over the cameras of the stated u over the least that the same data allow with all weights known: the Cramér-Rao bound of
means and mean squares (photon transfer), χ² sampling of pixels, rows and columns (fixed patterns). By the truth, quantities below
6 u_ref are counted apart (*small*): a limit must lie above the truth and a value within its 90 % interval; so are coefficients of
the non-linearity that the data tell less well than to 0.03 and leave to their prior. *not resolved*: large by the truth, and yet
given as a limit.

For fixed patterns the truth is the standard deviation of the population that the pixels are a sample of; offsets, efficiency and
responsivity are those of the unit. The black level is that of equal steps that store the same dark means.
A full well that the converter hides is compared with the signal at the top code."""


PRIOR = "short or noisy series lean on the priors (light at zero exposure 0 ± 5 %, coefficients 0 ± 0.1), wider than these cameras are"
REASONS = {  # why a stated u is known to be too large
    "electronics.gain.": "cause not found; it is so for well and badly known coefficients alike",
    "electronics.nonlinearity.": PRIOR,
    "responsivity": PRIOR,
    "sensor.dark_current.": "not examined; probably rounding errors of the slope enter by their largest amount",
    "grabber.phase_pattern.frequency": "the u of a moving wave's frequency is that of one ordinate of the periodogram",
}


def _told(what: str) -> str:
    reason = next((r for name, r in REASONS.items() if what.startswith(name)), "cause not known")
    return f"* {what}: {reason}"


def planted_table(scores: list[Score], rate: float) -> str:
    """In how many quantities faults that are put in afterwards are found."""
    names = [line.name for line in summarise(scores) if line.n >= 100]
    rows = []
    for what, fault in (
        ("bias of 5 u", {"bias_u": 5.0}),
        ("bias of 0.3 u", {"bias_u": 0.3}),
        ("u stated 30 % too small", {"u_factor": 0.7}),
        ("u stated 30 % too large", {"u_factor": 1.3}),
    ):
        caught = sum(any(f.startswith(f"{name}: ") for f in failures(summarise(planted(scores, name, **fault)), rate)) for name in names)
        rows.append(f"| {what} | {caught} of {len(names)} |")
    return "| planted in one quantity at a time | found |\n|---|---|\n" + "\n".join(rows)


def cameras_section(results: list[list[Score] | str], seed: int, first: int, rate: float) -> str:
    """The table of the random cameras."""
    refused = Counter(r.split("; found")[0] for r in results if isinstance(r, str))
    scores = [s for r in results if not isinstance(r, str) for s in r]
    lines = summarise(scores)
    wrong = failures(lines, rate)
    bad = {w.split(": ")[0] for w in wrong}
    rows = "\n".join(_row(line, bad) for line in lines)
    told = "\n".join(f"* {count} × {why}" for why, count in refused.items()) or "* none"
    failed = "\n".join(map(_told, wrong)) or "* none"
    return f"""## {len(results)} random cameras

{EXPLAINED}

Cameras {first} to {first + len(results) - 1} of seed {seed}.

| quantity | n | KS p | mean z | std z | in 95 % | u / u_ref | not resolved | small: missed | |
|---|---|---|---|---|---|---|---|---|---|
{rows}

Contradictions, at a chance of {rate:g} that any sound quantity is named (four tests a quantity, Bonferroni):

{failed}

Is the study sharp? Quantities with 100 values or more:

{planted_table(scores, rate)}

Cameras refused:

{told}
"""
