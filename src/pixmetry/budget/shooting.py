"""Which frames to take of a camera so that its sources become measured: set-ups, counts, charts to print, and a manifest to fill in."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pixmetry.budget.answer import answer_of
from pixmetry.budget.camera_budget import CameraBudget
from pixmetry.budget.printed_charts import CHARTS
from pixmetry.budget.set_ups import SetUp, kind_of, set_up_of
from pixmetry.budget.table import AT_BOUND, DESCRIBED, SHEET, TYPICAL, SourceRow
from pixmetry.files.output import staged_output

SHOOT_LIST, SCHEMA = "shoot_list", "pixmetry/shoot_list/1"
MOST_FRAMES = 1000  # of one group


@dataclass(frozen=True)
class Shot:
    """One set-up of a shoot list: its frames, the sources that it measures, and what that brings.

    Parameters
    ----------
    set_up : SetUp
        With the counts for the wanted u.
    frames : int
    titles : tuple of str
        Rows of the budget that become measured.
    now_px, then_px : float
        Upper end of the interval of the answer before and after, rms of x and y; the sources found to be as usual.
    """

    set_up: SetUp
    frames: int
    titles: tuple[str, ...]
    now_px: float
    then_px: float


def shots_of(found: CameraBudget, factor: float = 1.0) -> tuple[Shot, ...]:
    """The set-ups that turn rows of a budget to measured, the one that narrows the answer most first.

    Parameters
    ----------
    found : CameraBudget
    factor : float
        Wanted u over the usual one: the numbers of frames are divided by its square.

    Returns
    -------
    tuple of Shot
        Those that narrow nothing come last; those that measure no row of this camera are left out.
    """
    count = found.scenario.count
    now = answer_of(found.rows, count.frames, count.targets).most_rms_px
    shots: list[tuple[float, float, Shot]] = []
    open_rows = [r for r in found.rows if r.status in (SHEET, DESCRIBED, TYPICAL, AT_BOUND)]
    for kind in dict.fromkeys(kind_of(r.source_id) for r in open_rows):
        if not kind:
            continue
        set_up, own = set_up_of(kind), [r for r in open_rows if kind_of(r.source_id) == kind]
        then = answer_of(
            [replace(r, largest=None) if r in own and r.status in (TYPICAL, AT_BOUND) else r for r in found.rows],
            count.frames,
            count.targets,
        ).most_rms_px
        scaled = scaled_set_up(set_up, factor)
        titles = tuple(dict.fromkeys(r.title for r in sorted(own, key=_size, reverse=True)))
        shots.append(
            (min(then, now), -max(map(_size, own)), Shot(scaled, sum(e["frames"] for e in scaled.entries), titles, now, min(then, now)))
        )
    return tuple(shot for _, _, shot in sorted(shots, key=lambda s: s[:2]))


def _size(row: SourceRow) -> float:
    """What it contributes, or may contribute as far as is known."""
    return max(row.after_px, row.largest_px if row.largest is not None else 0.0)


def scaled_set_up(set_up: SetUp, factor: float) -> SetUp:
    """The set-up with so many frames that noise leaves ``factor`` times the usual u; what frames do not lower stays."""
    entries = tuple({**e, "frames": min(max(2, math.ceil(e["frames"] / factor**2)), MOST_FRAMES)} for e in set_up.entries)
    return replace(set_up, entries=entries)


def manifest_text(camera: str, facts: dict[str, Any], shots: Sequence[Shot]) -> str:
    """A manifest to fill in: what stands in angle brackets is to be replaced."""
    lines = ["# Replace what stands in <angle brackets>, and delete what you did not take.", "schema: pixmetry/campaign/1"]
    lines += ["camera:", f"  name: {_quoted(camera)}"]
    lines += [f"  {key}: {value}" for key, value in facts.items()]
    lines.append("frames:")
    numbers: Counter[str] = Counter()  # of the groups of each kind
    for shot in shots:
        s = shot.set_up
        lines.append(f"  # {s.title}: {s.exposure}")
        for entry in s.entries:
            keys = {name: value for name, value in entry.items() if name != "frames"}
            said = ", ".join(f"{name}: {_yaml(value)}" for name, value in keys.items())
            numbers[entry["kind"]] += 1
            lines.append(f'  - {{{said}, files: "{entry["kind"]}_{numbers[entry["kind"]]:02d}_*.tif"}}  # {entry["frames"]} frames')
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return _quoted(value) if isinstance(value, str) and not re.fullmatch(r"\w+", value) else str(value)


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def write_shoot_list(folder: str | Path, camera: str, facts: dict[str, Any], shots: Sequence[Shot]) -> Path:
    """Write the charts that the set-ups need and the manifest to fill in, whole or not at all.

    Raises
    ------
    InputError
        If the folder cannot be written, or holds anything else than an earlier list for this camera.
    """
    with staged_output(folder, SHOOT_LIST, (camera,)) as made:
        for name in dict.fromkeys(s.set_up.chart for s in shots if s.set_up.chart):
            (made / f"{name}.svg").write_text(CHARTS[name](), encoding="utf-8")
        (made / "campaign.yaml").write_text(manifest_text(camera, facts, shots), encoding="utf-8")
    return Path(folder)
