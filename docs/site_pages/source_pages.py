"""One page for each error source, made from the catalogue: what it is, what it does to a frame, and what can be done with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pixmetry.budget.monte_carlo import helpers_of
from pixmetry.budget.probe import Target, facts_of, perfect, put, scene_of
from pixmetry.budget.set_ups import FLAT, SET_UPS, kind_of
from pixmetry.camera.camera import Camera, load_camera
from pixmetry.camera.catalogue import STAGES, sources, to_record
from pixmetry.camera.chain_order import Element
from pixmetry.camera.source import STATED_FRAME, Source, bounds_text
from pixmetry.core.errors import PixmetryError
from pixmetry.scene.uniform import Uniform
from site_pages.citations import citation_of

DIGITAL, ANALOGUE = "imx264_like", "pulnix_tm6cn_epix_512"
SHAPE = (72, 96)  # of the frames in the figures
SHOWN = 24  # rows and columns about the target
FRAMES = 3  # the last is shown: a source with a memory has seen the ones before
SEED = 1


def write_source_pages(folder: Path) -> Iterator[str]:
    """Write the pages and their figures into a folder; yields the names of the pages, in the order of the light."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = small_cameras()
    listed = []
    for source in sources().values():
        figure = folder / f"{source.id}.svg"
        drawn = _draw(source, cameras, figure)
        (folder / f"{source.id}.md").write_text(_page(source, drawn), encoding="utf-8")
        listed.append(source)
        yield source.id
    (folder / "index.md").write_text(_index(listed), encoding="utf-8")


def small_cameras() -> dict[str, Camera]:
    """The cameras of the figures, with frames of a few pixels."""
    return {name: replace(load_camera(name), frame_shape=SHAPE) for name in (DIGITAL, ANALOGUE)}


def _page(source: Source, figure: str) -> str:
    record = to_record(source)
    row = f"Row {source.number} of the handbook's error table, {'★' * source.stars or 'no star'}" if source.number else ""
    lines = [f"# {source.title}", "", f"`{source.id}`" + (f". {row}{f', {source.note}' if source.note else ''}." if row else ""), ""]
    lines += [source.description, "", "| | |", "|---|---|", f"| equation | `{_cell(source.equation)}` |"]
    lines += [
        f"| usual size | {_cell(source.typical_size)} |",
        f"| class | {source.gum_class} |",
        f"| what to do | {_cell(source.advice)} |",
        "",
    ]
    if figure:
        lines += [f"![{source.title}: a target and an even field with it and without it]({source.id}.svg)", "", figure, ""]
    lines += ["## Parameters", ""]
    if source.parameters.model_fields:
        lines += ["| parameter | unit | range | usual | bound | meaning |", "|---|---|---|---|---|---|"]
        for name, field in source.parameters.model_fields.items():
            numbers = " | ".join(_cell(str(getattr(p, name))) for p in (source.typical, source.bound))
            about = _cell(field.description or "")
            lines.append(f"| `{name}` | {_cell(source.units[name])} | {_cell(bounds_text(field))} | {numbers} | {about} |")
        if source.bound_over is not None:
            lines += ["", "The bound holds for the whole frame; this one is of {} × {} px.".format(*STATED_FRAME[::-1])]
    else:
        lines.append("None.")
    lines += ["", "## What can be done with it", "", "| | |", "|---|---|"]
    words = {"forward": "simulated", "measure": "measured", "correct": "corrected", "propagate": "in a budget"}
    for verb, has in record["verbs"].items():
        told = "yes" if has else f"no: {record['reasons'][verb]}"
        if verb == "measure" and has:
            kind = kind_of(source.id)
            told = f"yes: {SET_UPS[kind].title.lower()}" if kind in SET_UPS else "yes: the residuals of a calibration"
            told += "" if kind in (FLAT, "") else f" (`kind: {kind}`)"
        if verb == "correct" and has and source.leaves:
            told += f"; left: {source.leaves}"
        lines.append(f"| {words.get(verb, verb)} | {_cell(told)} |")
    lines += ["", f"```sh\npixmetry sources {source.id}\n```", "", "## References", ""]
    return "\n".join([*lines, *(f"- {text} ({citation_of(text).words})" for text in source.references), ""])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _index(listed: list[Source]) -> str:
    lines = [
        "# Error sources",
        "",
        "Each page has the equation, the parameters with their ranges, a figure, and what can be done with the source.",
        "",
    ]
    for stage in STAGES:
        own = [s for s in listed if s.stage == stage]
        if own:
            lines += [f"## {stage.capitalize()}", "", "| source | stars | measured | corrected |", "|---|---|---|---|"]
            for s in own:
                has = ("yes" if verb is not None else "–" for verb in (s.measure, s.correct))
                lines.append(f"| [{s.title}]({s.id}.md) | {'★' * s.stars} | {' | '.join(has)} |")
            lines.append("")
    lines += ["```{toctree}", ":hidden:", "", *(s.id for s in listed), "```", ""]
    return "\n".join(lines)


def _draw(source: Source, cameras: dict[str, Camera], path: Path) -> str:
    """Draw a target and an even field with the source at its bound and without it; the legend, or empty where no frame at rest shows it."""
    if source.forward is None:
        return ""
    for name in (DIGITAL, ANALOGUE):
        try:
            target, flat = _exposed(source, cameras[name])
        except PixmetryError:
            continue
        if not all(np.isfinite(v).all() for v in (*target, *flat)) or all(np.array_equal(*pair) for pair in (target, flat)):
            continue
        _figure(target, flat, path)
        return f"*At the bound of its parameters, alone in an otherwise perfect `{name}`; differences are stretched.*"
    return ""


def _exposed(source: Source, camera: Camera) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Frames of a target and of an even field, each with the source and without."""
    whole = put(camera, Element(source.id, source, source.bound))
    helpers = helpers_of(whole, (source.id,))
    facts = facts_of(whole, Target())
    middle = np.full(FRAMES, SHAPE[1] / 2 + 0.3), np.full(FRAMES, SHAPE[0] / 2 - 0.2)
    light = 0.5 * facts.saturation_dn / facts.dn_per_photon
    frames = []
    for scene in (scene_of(Target(), facts, *middle), Uniform(light)):
        pair = [perfect(whole, on).expose(scene, FRAMES, SEED).data[-1].astype(float) for on in ((source.id, *helpers), helpers)]
        frames.append((pair[0], pair[1]))
    return frames[0], frames[1]


def _near(data: np.ndarray) -> np.ndarray:
    """The middle of a frame, where the target is."""
    row, col = ((size - SHOWN) // 2 for size in data.shape)
    return data[row : row + SHOWN, col : col + SHOWN]


def _figure(target: tuple[np.ndarray, np.ndarray], flat: tuple[np.ndarray, np.ndarray], path: Path) -> None:
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, 4, figsize=(9, 2.4), layout="constrained")
    for axis, title, data in ((axes[0], "target, without", target[1]), (axes[1], "target, with", target[0])):
        axis.imshow(_near(data), cmap="gray", vmin=target[1].min(), vmax=target[1].max())
        axis.set_title(title, fontsize=9)
    for axis, title, pair, cut in ((axes[2], "target", target, _near), (axes[3], "even field", flat, np.asarray)):
        same = pair[0].shape == pair[1].shape
        data = cut(pair[0] - pair[1] if same else pair[0])
        most = float(np.abs(data).max()) or 1.0
        image = axis.imshow(data, cmap="RdBu_r" if same else "gray", vmin=-most if same else 0, vmax=most)
        axis.set_title(f"{title}, {'difference' if same else 'with'}, DN", fontsize=9)
        fig.colorbar(image, ax=axis, shrink=0.8).ax.tick_params(labelsize=7)
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    fig.savefig(path, metadata={"Date": None})
    plt.close(fig)
