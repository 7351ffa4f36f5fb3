"""Public functions refuse arguments of wrong types by their names, and take all that their annotations say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import pixmetry
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError, PixmetryError

WRONG: tuple[Any, ...] = (
    None,
    5,
    -1.5,
    float("nan"),
    "a\0b",
    b"x",
    [None],
    {1: 2},
    (),
    object(),
    np.zeros(0),
    np.array([np.nan]),
    1e300,
    len,
)
CALLS: dict[str, dict[str, Any]] = {
    "assess": {"campaign": None},
    "budget": {"camera": "imx250"},
    "chain": {"camera": "nothing.yaml", "scene": "nothing.yaml"},
    "check_limits": {"source": "nothing.json", "limits": "nothing.yaml"},
    "compare": {"a": "nothing.json", "b": "nothing.json"},
    "compare_budgets": {"sources": ["nothing.json"]},
    "compare_fleet": {"sources": ["nothing.json"]},
    "correct": {"frames": "nothing.tif", "with_": "imx250"},
    "corrected": {"table": "nothing.csv", "with_": "imx250"},
    "emva1288": {"campaign": "nothing.yaml"},
    "load_camera": {"path": "nothing.yaml"},
    "load_campaign": {"path": "nothing.yaml"},
    "read_calibration": {"path": "nothing.json"},
    "read_frame": {"path": "nothing.png"},
    "series": {"frames": "nothing"},
    "simulate": {"camera": "nothing.yaml", "scene": "nothing.yaml", "output": "nothing"},
}


@typed
def example(
    number: float,
    count: int = 1,
    *,
    text: str | None = None,
    place: str | Path = "",
    some: Sequence[str] = (),
    pair: tuple[int, str] = (1, ""),
    word: Literal["a", "b"] = "a",
    settings: Mapping[str, Any] | None = None,
    array: np.ndarray | None = None,
    flag: bool = False,
) -> float:
    """All that can be annotated."""
    return number * count


def test_what_the_annotations_say_is_taken() -> None:
    assert example(2, np.int64(3), text="x", place=Path("a"), some=["a"], pair=(2, "b"), word="b", settings={"a": object()}) == 6
    assert example(np.float32(0.5), 2.0, array=np.zeros(3), flag=np.bool_(True), some=("a", "b")) == 1.0  # type: ignore[arg-type]
    assert example(1, some=np.array(["a", "b"])) == 1.0
    assert example(float("inf")) == float("inf")
    assert example.__doc__ == "All that can be annotated."
    with pytest.raises(TypeError):  # a wrong call is a mistake in the program
        example()  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("number", float("nan")), ("number", True), ("number", "1"), ("number", None), ("count", 1.5), ("count", 1 << 70),
        ("count", np.zeros(1)),
        ("text", 1), ("text", "a\0b"), ("place", b"a"), ("place", 3), ("some", "ab"), ("some", [1]), ("some", 3), ("pair", (1,)),
        ("pair", ("a", "b")), ("word", "c"), ("word", ["a"]), ("settings", {1: 2}), ("settings", []), ("array", [1]), ("flag", 1),
    ],
)  # fmt: skip
def test_what_they_do_not_say_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"^{name}: "):
        example(**{"number": 1.0, name: value})


@pytest.mark.parametrize("name", CALLS)
def test_a_public_function_raises_no_error_but_ours(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each wrong value for each argument that a function must have, and none of them taken."""
    monkeypatch.chdir(tmp_path)
    function = getattr(pixmetry, name)
    for argument in CALLS[name]:
        for value in WRONG:
            if value is None and CALLS[name][argument] is None or name in ("load_campaign", "emva1288") and value is None:
                continue
            with pytest.raises(PixmetryError):
                function(**{**CALLS[name], argument: value})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "argument"),
    [
        ("budget", "trials"), ("budget", "seed"), ("emva1288", "photons_u_rel"), ("emva1288", "bootstrap"), ("series", "interval_s"),
        ("series", "tolerance_px"), ("simulate", "frames"), ("simulate", "seed"), ("compare", "level"), ("assess", "trials"),
    ],
)  # fmt: skip
def test_a_number_that_is_none_is_refused_before_the_work(name: str, argument: str) -> None:
    for value in (float("nan"), "3", [1], True, None if argument != "interval_s" else "x"):
        with pytest.raises(InputError, match=f"{argument}: |nothing"):
            getattr(pixmetry, name)(**{**CALLS[name], argument: value})
