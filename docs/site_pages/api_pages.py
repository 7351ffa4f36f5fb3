"""One page for each public name, from its docstring."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

TITLE = "# Python API\n\nEverything is imported from `pixmetry`: `from pixmetry import locate`. Each function has an example that runs.\n\n"


def write_api_pages(folder: Path, package: ModuleType) -> None:
    """Write a page for each name of the package's ``__all__`` but its version, and their list."""
    folder.mkdir(parents=True, exist_ok=True)
    names = sorted(name for name in package.__all__ if not name.startswith("_"))
    lines = []
    for name in names:
        thing = getattr(package, name)
        is_class = isinstance(thing, type)
        kind, members = ("autoclass", ":members:") if is_class else ("autofunction", "")
        head = f"pixmetry.{name}\n{'=' * (len(name) + 9)}"
        page = f"{head}\n\n.. {kind}:: {thing.__module__}.{thing.__qualname__}\n" + (f"   {members}\n" if members else "")
        (folder / f"{name.lower()}-{'class' if is_class else 'function'}.rst").write_text(page, encoding="utf-8")
        summary = (thing.__doc__ or "").strip().split("\n")[0]
        lines.append((name, f"{name.lower()}-{'class' if is_class else 'function'}", summary))
    table = "\n".join(["| name | what it does |", "|---|---|", *(f"| [`{n}`]({page}.rst) | {text} |" for n, page, text in lines)])
    tree = "\n".join(["```{toctree}", ":hidden:", "", *(page for _, page, _ in lines), "```", ""])
    (folder / "index.md").write_text(f"{TITLE}{table}\n\n{tree}", encoding="utf-8")
