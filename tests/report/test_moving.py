"""Drawings in motion."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import pytest

from pixmetry.core.errors import InputError
from pixmetry.report.moving import Box, Step, moving_svg

BOX = Box(0, 0, 100, 40, "blue")


def times(svg: str, name: str) -> list[tuple[float, float, float]]:
    """Time in percent and place of a group."""
    frames = re.search(rf"@keyframes {name}{{(.*?}})}}", svg)
    assert frames is not None
    return [tuple(map(float, f)) for f in re.findall(r"([\d.]+)%{transform:translate\((-?[\d.]+)px,(-?[\d.]+)px\)", frames[1])]


def test_dots_move_by_the_steps_and_time_is_that_of_the_logarithm() -> None:
    steps = [Step("wait", 1e-6, [(0, 0), (0, 0)]), Step("a < b", 1e-4, [(10, 0), (0, 5)]), Step("back", 1e-6, [(-4, 2), (0, 0)])]
    svg = moving_svg([BOX], [[(5, 5, 3)], [(5, 15, 3), (9, 15, 2)]], steps)
    root = ET.fromstring(svg)
    assert len(root.findall(".//circle")) == 3 and [t.text for t in root.findall("text")] == ["wait", "a < b", "back"]
    assert times(svg, "g0") == [(0, 0, 0), (25, 0, 0), (75, 10, 0), (100, 6, 2)]  # 2, 4 and 2 factors of ten above 10 ns
    assert times(svg, "g1")[-1] == (100, 0, 5)
    assert "prefers-reduced-motion" in svg


@pytest.mark.parametrize("step", [Step("too few", 1e-3, [(0, 0)]), Step("too short", 1e-8, [(0, 0), (0, 0)])])
def test_a_step_that_cannot_be_drawn_is_refused(step: Step) -> None:
    with pytest.raises(InputError, match=r"steps\[0\]"):
        moving_svg([BOX], [[(1, 1, 1)], [(2, 2, 1)]], [step])
