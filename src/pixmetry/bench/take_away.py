"""What is on the page as files and lines that make it again, to the bit."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from pixmetry.bench.state import Layout
from pixmetry.core.config import plain_values
from pixmetry.simulate.job import stored_bits


def taken_away(layout: Layout) -> dict[str, str]:
    """Texts by the names of their files: camera, camera as it is pictured, scene, scenario, command lines, and Python."""
    state = layout.state
    row0, col0, rows, cols = layout.window
    window, bits = f"{row0},{col0},{rows},{cols}", stored_bits(layout.camera)
    estimator = "" if state.estimator == "auto" else f" --estimator {state.estimator}"
    true = "true: {!r}, {!r}".format(*layout.true_px) if layout.true_px else "the scene has no target"
    scenario = {"schema": "pixmetry/scenario/1"} | {k: dict(v) for k, v in state.scenario.items() if v}
    commands = f"""\
# the picture, and the centre found in it (add {col0} to its x and {row0} to its y)
pixmetry simulate pictured.yaml scene.yaml --seed {state.seed} --window {window} -o frames
pixmetry locate frames/frame_00000.tif --bits {bits}{estimator} -o found.csv
# the budget
pixmetry budget camera.yaml --scenario scenario.yaml{estimator}
"""
    python = f"""\
import pixmetry

frames = pixmetry.simulate("pictured.yaml", "scene.yaml", "frames", seed={state.seed}, window=({row0}, {col0}, {rows}, {cols}))
frame = pixmetry.read_frame(frames / "frame_00000.tif")
found = pixmetry.locate(frame, estimator={state.estimator!r}, bits={bits})
print(found.x_px + {col0}, found.y_px + {row0})  # {true}
budget = pixmetry.budget("camera.yaml", "scenario.yaml", estimator={state.estimator!r})
print(budget.one.after_px)
"""
    return {
        "camera.yaml": yaml_text(layout.setting.described.to_record()),
        "pictured.yaml": yaml_text(layout.camera.to_record()),
        "scene.yaml": yaml_text(layout.scene),
        "scenario.yaml": yaml_text(scenario),
        "commands.sh": commands,
        "again.py": python,
    }


def yaml_text(record: Mapping[str, Any]) -> str:
    """A record as YAML."""
    from ruamel.yaml import YAML

    yaml, stream = YAML(pure=True), io.StringIO()
    yaml.width = 140
    yaml.dump(plain_values(record), stream)
    return stream.getvalue()
