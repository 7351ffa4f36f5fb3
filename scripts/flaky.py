"""How often each test that draws fails: test files run many times, every time with another seed.

A statistical test fails with a chance of 1e-6 although nothing is wrong. A failure in a few hundred runs is therefore a fault, of the test
or of what it tests. Each file runs again and again in one process, so that imports and compiled kernels are paid for once.

    python scripts/flaky.py [--runs 200] [--jobs 2] [tests/emva/test_general.py ...]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import secrets
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
STATED = 1e-6  # chance of a failure although nothing is wrong
SHOWN = 5  # failed seeds told for each test


@dataclass
class Outcome:
    """Of some runs of one file: how often each test ran, and the seeds at which it failed."""

    file: str
    ran: Counter[str] = field(default_factory=Counter)
    failed: dict[str, list[int]] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)  # runs that did not get as far as a test

    def add(self, other: Outcome) -> None:
        self.ran += other.ran
        self.broken += other.broken
        for test, seeds in other.failed.items():
            self.failed.setdefault(test, []).extend(seeds)


class Recorder:
    """Pytest plugin: keeps the tests that can draw, and notes how they end."""

    def __init__(self, outcome: Outcome, seed: int) -> None:
        self.outcome, self.seed = outcome, seed

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = [item for item in items if {"rng", "request"} & set(item.fixturenames)]

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.when == "call" and not report.skipped:
            self.outcome.ran[report.nodeid] += 1
        if report.failed:
            self.outcome.ran[report.nodeid] += report.when == "setup"
            seeds = self.outcome.failed.setdefault(report.nodeid, [])
            seeds += [self.seed] if self.seed not in seeds else []


def run_file(file: str, runs: int) -> Outcome:
    """Run one file with this many fresh seeds, in this process."""
    import pytest

    os.chdir(ROOT)
    outcome = Outcome(file)
    for _ in range(runs):
        seed, said = secrets.randbits(32), io.StringIO()
        options = ["-q", "-n0", "-p", "no:cacheprovider", "-m", "not browser and not oracle", "--hypothesis-seed=0", "--seed", str(seed)]
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            status = pytest.main([file, *options], plugins=[Recorder(outcome, seed)])
        if status not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED):
            outcome.broken.append(said.getvalue().strip())
            break
        if not outcome.ran and not outcome.failed:
            break  # nothing in it draws
    return outcome


def drawing_files() -> list[str]:
    """Test files that draw."""
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    return [str(path.relative_to(ROOT)) for path in files if path.parent.name != "architecture" and "rng" in path.read_text()]


def report_text(outcomes: dict[str, Outcome]) -> tuple[str, bool]:
    """A line for every test that failed and a summary; and whether any failed."""
    lines, wrong = [], False
    for outcome in outcomes.values():
        for test, seeds in sorted(outcome.failed.items()):
            wrong, ran = True, outcome.ran[test]
            more = ", …" if len(seeds) > SHOWN else ""
            lines.append(f"{len(seeds)} of {ran} = {len(seeds) / ran:.2g}  {test}  --seed {', '.join(map(str, seeds[:SHOWN]))}{more}")
        for said in outcome.broken:
            wrong = True
            lines.append(f"{outcome.file} does not run:\n{said}")
    tests = sum(len(o.ran) for o in outcomes.values())
    ran = sum(sum(o.ran.values()) for o in outcomes.values())
    if wrong:
        lines.append(f"stated {STATED:g}: a failure among so few runs is a fault of the test or of what it tests")
    else:
        lines.append(f"{tests} tests, {ran} runs: none failed; at the stated {STATED:g} one would in {ran * STATED:.1g} of such rounds")
    return "\n".join(lines), wrong


def main(arguments: list[str] | None = None) -> int:
    told = "Run test files again and again, with a fresh seed each time, and tell how often each test fails."
    parser = argparse.ArgumentParser(description=told)
    parser.add_argument("files", nargs="*", help="test files (all that draw)")
    parser.add_argument("--runs", type=int, default=200, help="times that each file runs (200)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    given = parser.parse_args(arguments)
    if given.runs < 1 or given.jobs < 1:
        parser.error("--runs and --jobs are whole numbers from 1 on")
    missing = [file for file in given.files if not (ROOT / file).is_file()]
    if missing:
        parser.error(f"no such test file below {ROOT}: {', '.join(missing)}")
    files = given.files or drawing_files()
    shares = [given.runs // given.jobs + (k < given.runs % given.jobs) for k in range(given.jobs)]
    outcomes = {file: Outcome(file) for file in files}
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        left = Counter({file: sum(share > 0 for share in shares) for file in files})
        work = {pool.submit(run_file, file, share): file for file in files for share in shares if share}
        for done in as_completed(work):
            file = work[done]
            outcomes[file].add(done.result())
            left[file] -= 1
            if not left[file]:
                o = outcomes[file]
                failures = sum(map(len, o.failed.values()))
                which = "".join(f"\n  {test} --seed {seeds[0]}" for test, seeds in o.failed.items())
                print(f"{file}: {len(o.ran)} tests, {sum(o.ran.values())} runs, {failures} failures{which}", flush=True)
    text, wrong = report_text(outcomes)
    print(text)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
