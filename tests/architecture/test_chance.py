"""Chance in the tests: every draw comes from the seed of the run, which a failed test tells and ``--seed`` repeats."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest_plugins = ["pytester"]

TESTS = Path(__file__).resolve().parents[1]
HOME = {"conftest.py", "chance.py"}  # the seed of a run is made here
FRESH = {
    "default_rng",
    "SeedSequence",
    "Philox",
    "PCG64",
    "MT19937",
    "RandomState",
}  # without a seed each of them is another one every time
OLD = re.compile(r"(np|numpy)\.random\.[a-z]\w+")  # np.random.normal, np.random.seed, …
DRAWS = """
import numpy as np
import pytest
from chance import rng_of

@pytest.fixture(scope="module", params=["a", "b"])
def shared(request):
    return rng_of(request).integers(2**62)

def test_one(rng):
    print("drew", rng.integers(2**62))
    assert False

@pytest.mark.parametrize("k", [0, 1])
def test_two(rng, seed, k):
    print("drew", k, rng.integers(2**62), seed)
    assert False

def test_three(shared):
    print("drew", shared)
    assert False
"""


def bare_draws(source: str) -> list[int]:
    """Lines that draw from anything but the seed of the run or a seed that is written there."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            lines += [node.lineno for alias in node.names if alias.name in {"random", "secrets", "uuid"}]
        elif isinstance(node, ast.ImportFrom):
            lines += [node.lineno] if node.module in {"random", "secrets", "uuid"} else []
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            given = [a for a in (*node.args, *(k.value for k in node.keywords)) if not (isinstance(a, ast.Constant) and a.value is None)]
            last = name.rpartition(".")[2]
            fresh = last in FRESH and not given
            lines += [node.lineno] if fresh or name == "os.urandom" or (OLD.fullmatch(name) and last != "default_rng") else []
    return lines


def test_every_test_draws_from_the_seed_of_the_run() -> None:
    files = {path: bare_draws(path.read_text()) for path in sorted(TESTS.rglob("*.py")) if path.name not in HOME}
    bare = [f"{path.relative_to(TESTS)}:{line}" for path, lines in files.items() for line in lines]
    assert len(files) > 100 and not bare, "take the fixture rng, or rng_of(request) in a wider fixture:\n" + "\n".join(bare)


@pytest.mark.parametrize(
    "source",
    [
        "rng = np.random.default_rng()",
        "rng = default_rng(None)",
        "rng = np.random.Generator(np.random.Philox())",
        "entropy = np.random.SeedSequence().entropy",
        "x = np.random.normal(0, 1)",
        "numpy.random.seed(3)",
        "import random",
        "from secrets import randbits",
        "seed = os.urandom(8)",
    ],
)
def test_a_planted_draw_is_caught(source: str) -> None:
    assert bare_draws(source) == [1]


@pytest.mark.parametrize(
    "source",
    ["rng = np.random.default_rng(5)", "rng = np.random.default_rng([seed, 1])", "def draw(rng: np.random.Generator): return rng.normal()"],
)
def test_a_seeded_draw_passes(source: str) -> None:
    assert not bare_draws(source)


@pytest.fixture
def drawn(pytester: pytest.Pytester):
    """Runs the tests above and returns what each of them drew."""
    pytester.makeconftest((TESTS / "conftest.py").read_text())
    pytester.makepyfile(chance=(TESTS / "chance.py").read_text(), test_draws=DRAWS)
    pytester.makeini("[pytest]\npythonpath = .\naddopts = -p no:cacheprovider -p no:hypothesispytest")

    def run(*options: str) -> tuple[dict[str, str], str]:
        text = pytester.runpytest_inprocess(*options).stdout.str()
        parts = re.split(r"(?m)^_+ (test_\w+\S*) _+$", text)[1:]
        return {name: re.search("(?m)^drew .*", body)[0] for name, body in zip(parts[::2], parts[1::2], strict=True)}, text

    return run


def test_a_failure_tells_the_seed_that_repeats_it(drawn) -> None:
    """Two runs draw otherwise; the seed of one repeats it, whole or one test alone, in one process or in two."""
    first, text = drawn("-n2")
    assert set(first) == {"test_one", "test_two[0]", "test_two[1]", "test_three[a]", "test_three[b]"}
    assert len(set(first.values())) == 5
    (seed,) = set(re.findall(r"--seed (\d+) repeats what this test drew", text))
    assert all(drawn("-n0")[0][name] != value for name, value in first.items())
    assert drawn("-n0", "--seed", seed)[0] == first
    alone = ("test_two[1]", "test_three[b]")
    assert drawn("-n0", "--seed", seed, *(f"test_draws.py::{test}" for test in alone))[0] == {test: first[test] for test in alone}


@pytest.mark.parametrize("wrong", ["-3", "abc", "1.5"])
def test_a_seed_that_is_none_is_refused(pytester: pytest.Pytester, wrong: str) -> None:
    pytester.makeconftest((TESTS / "conftest.py").read_text())
    pytester.makepyfile(chance=(TESTS / "chance.py").read_text())
    pytester.makeini("[pytest]\npythonpath = .\naddopts = -p no:hypothesispytest")
    result = pytester.runpytest_inprocess(f"--seed={wrong}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*is not a seed*"])


@pytest.fixture(scope="module")
def flaky() -> ModuleType:
    """The script that runs tests again and again."""
    path = TESTS.parent / "scripts" / "flaky.py"
    spec = importlib.util.spec_from_file_location("flaky", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["flaky"] = module
    spec.loader.exec_module(module)
    return module


def test_repeated_runs_keep_the_seeds_at_which_a_test_failed(flaky: ModuleType, pytester: pytest.Pytester) -> None:
    """A test that fails below half, one that never fails, and one that draws nothing and is left out."""
    pytester.makeconftest((TESTS / "conftest.py").read_text())
    pytester.makepyfile(
        chance=(TESTS / "chance.py").read_text(),
        test_draws="def test_half(rng): assert rng.random() < 0.5\ndef test_sound(rng): pass\ndef test_still(): pass",
    )
    pytester.makeini("[pytest]\npythonpath = .\naddopts = -p no:cacheprovider -p no:hypothesispytest")
    outcome = flaky.Outcome("test_draws.py")
    for seed in range(5):
        pytester.inline_run("-q", "-n0", "--seed", str(seed), plugins=[flaky.Recorder(outcome, seed)])
    assert outcome.ran == {"test_draws.py::test_half": 5, "test_draws.py::test_sound": 5}
    (failed,) = outcome.failed.values()  # the same in every run: the seeds are fixed
    assert 0 < len(failed) < 5 and failed == sorted(set(failed))
    text, wrong = flaky.report_text({"test_draws.py": outcome})
    assert wrong and f"{len(failed)} of 5 = {len(failed) / 5:.2g}  test_draws.py::test_half  --seed {failed[0]}" in text
    sound = flaky.Outcome("test_draws.py", outcome.ran)
    text, wrong = flaky.report_text({"test_draws.py": sound})
    assert not wrong and "2 tests, 10 runs: none failed" in text


def test_files_that_are_not_there_are_refused(flaky: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        flaky.main(["tests/test_nothing.py"])
    assert "no such test file" in capsys.readouterr().err
