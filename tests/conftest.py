"""The seed of a run, and what a test draws from it (see `chance`); a browser; pages with blank figures, for tests of words alone."""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Generator, Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chance import rng_of

CHROMIUM = Path("/usr/bin/chromium")


def seed_from(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a seed: give the whole number, zero or more, that a failed test printed")
    return int(text)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seed", type=seed_from, metavar="N", help="draw what the run with this seed drew; a failed test prints it")


def pytest_configure(config: pytest.Config) -> None:
    if config.option.seed is None:
        config.option.seed = getattr(config, "workerinput", {}).get("seed", secrets.randbits(32))


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist: all workers of a run share its seed
def pytest_configure_node(node: Any) -> None:
    node.workerinput["seed"] = node.config.option.seed


def pytest_report_header(config: pytest.Config) -> str:
    return f"seed of the draws: {config.option.seed}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed:
        report.sections.append(("Draws", f"--seed {item.config.option.seed} repeats what this test drew"))
    return report


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """What this test draws: another stream in every run, the same with ``--seed``."""
    return rng_of(request)


@pytest.fixture
def seed(rng: np.random.Generator) -> int:
    """The seed of what this test simulates."""
    return int(rng.integers(2**31))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of a page keep their place, title, caption and description; what is in them is not drawn, which is most of a page's time."""
    blank = '<svg class="figure" role="img" aria-label="{}"></svg>'
    monkeypatch.setattr("pixmetry.report.drawing.svg_of", lambda drawing, name, alt: blank.format(escape(alt)))


@pytest.fixture(scope="module")  # a longer one would keep the event loop from the tests that run one of their own
def browser() -> Iterator[Any]:
    """Chromium, without a window."""
    playwright = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM.exists():
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield opened
        opened.close()
