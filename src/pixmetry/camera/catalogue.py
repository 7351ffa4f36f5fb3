"""The catalogue: every error source there is, found by walking the stages (and entry points of other packages)."""

from __future__ import annotations

import importlib
import importlib.machinery
import pkgutil
import sys
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from pixmetry.camera.source import Source
from pixmetry.core.errors import ChainError, InputError

STAGES = ("scene", "optics", "sensor", "electronics", "cable", "grabber", "processing", "storage")
ENTRY_POINTS = "pixmetry.sources"


@cache
def sources() -> dict[str, Source]:
    """All sources by id, in the order in which the light meets their stages.

    Examples
    --------
    >>> from pixmetry.camera.catalogue import sources
    >>> source = sources()["sensor.prnu"]
    >>> source.title, source.stage, source.units["pixel_std_rel"]
    ('Photo response non-uniformity', 'sensor', '1')
    """
    found: dict[str, Source] = {}
    for stage in STAGES:
        package = importlib.import_module(f"pixmetry.sources.{stage}")
        for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda m: m.name):
            if module.name.startswith("_"):
                continue
            source = getattr(importlib.import_module(f"pixmetry.sources.{stage}.{module.name}"), "SOURCE", None)
            if source is not None:
                _add(found, source, f"pixmetry.sources.{stage}.{module.name}", stage)
    for point in entry_points(group=ENTRY_POINTS):
        _add(found, point.load(), point.value, None)
    return found


def add_source_file(path: str | Path) -> Source:
    """Add the source of a Python file of one's own to the catalogue of this process; the file is run.

    Raises
    ------
    InputError
        If there is no such file, it cannot be run, or holds no ``SOURCE``.
    ChainError
        If its id is taken or names no stage.

    Examples
    --------
    A copy of a source under an id of its own; a real one is written as `docs/adding-a-source.md` says:

    >>> from pathlib import Path
    >>> from pixmetry import add_source_file, sources
    >>> text = "from dataclasses import replace\\nfrom pixmetry.sources.sensor import prnu\\n"
    >>> written = Path("mine.py").write_text(text + "SOURCE = replace(prnu.SOURCE, id='sensor.mine')\\n")
    >>> add_source_file("mine.py").id, "sensor.mine" in sources()
    ('sensor.mine', True)
    >>> del sources()["sensor.mine"]  # from this process again
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", where=str(path), remedy="name a Python file that holds a SOURCE")
    name = f"pixmetry_source_{path.stem}"
    loader = importlib.machinery.SourceFileLoader(name, str(path))
    module = ModuleType(name)
    sys.modules[name] = module  # models look up their module while they are made
    try:
        loader.exec_module(module)
    except Exception as problem:
        raise InputError(f"the file cannot be run: {type(problem).__name__}: {problem}", where=str(path)) from problem
    if not isinstance(getattr(module, "SOURCE", None), Source):
        raise InputError("the file holds no Source record named SOURCE", where=str(path), remedy="see docs/adding-a-source.md")
    source: Source = module.SOURCE
    known = sources().get(source.id)
    if known is not None and getattr(known.forward, "__module__", "") == name:
        del sources()[source.id]  # the same file once more
    _add(sources(), source, str(path), None)
    return source


def _add(found: dict[str, Source], source: Source, where: str, stage: str | None) -> None:
    if not isinstance(source, Source):
        raise ChainError("is not a Source record", where=where)
    if source.id in found:
        raise ChainError(f"the id {source.id} is already taken", where=where, remedy="choose another name")
    if source.stage not in STAGES or (stage is not None and source.stage != stage):
        raise ChainError(f"the id {source.id} does not name its stage", where=where, allowed=", ".join(STAGES))
    found[source.id] = source


def get_source(source_id: str, where: str = "") -> Source:
    """The source of that id; ``InputError`` names the nearest ones if there is none, and ``where`` it was asked for."""
    from difflib import get_close_matches

    known = sources()
    if source_id in known:
        return known[source_id]
    near = get_close_matches(source_id, known, n=3, cutoff=0.4) or [i for i in known if i.endswith("." + source_id)]
    raise InputError(
        f"no error source is called {source_id!r}",
        where=where,
        allowed=", ".join(near or known),
        remedy="`pixmetry sources` lists all; for a source of your own add `--source-file FILE` before the command",
    )


def to_record(source: Source) -> dict[str, object]:
    """The listing's record of a source, for people's programs."""
    return {
        "id": source.id,
        "title": source.title,
        "stage": source.stage,
        "number": source.number,
        "note": source.note,
        "stars": source.stars,
        "verbs": source.verbs,
        "reasons": dict(source.reasons),
        "gum_class": source.gum_class,
    }
