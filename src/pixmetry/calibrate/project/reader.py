"""The tables and pictures that a project names, found beside it, with the project's line where one cannot be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pixmetry.calibrate.project.schema import ProjectModel, TableModel
from pixmetry.calibrate.project.tables import Table, inline_table, read_table
from pixmetry.files.files import find_file, find_files
from pixmetry.files.formats import PICTURE_ENDINGS, is_frame
from pixmetry.files.images import picture_files
from pixmetry.files.raw_values import layout_of


class Reader:
    """Finds and reads the files that a project names, and takes note of them.

    Parameters
    ----------
    source : Path or None
        The project; None: there is no file.
    lines : mapping
        Line of each of its keys.
    """

    def __init__(self, source: Path | None, lines: Mapping[tuple[str | int, ...], int]) -> None:
        self.source, self.lines = source, lines
        self.folder = Path() if source is None else source.parent
        self.files: list[Path] = [] if source is None else [source]

    def where(self, *loc: str | int) -> str:
        """The project with the line of a key."""
        line = next((self.lines[loc[:n]] for n in range(len(loc), 0, -1) if loc[:n] in self.lines), None)
        return "pictures" if self.source is None else f"{self.source}, line {line}" if line else str(self.source)

    def table(self, key: str, wanted: TableModel | None) -> Table | None:
        """The table that stands under a key of the project."""
        if wanted is None:
            return None
        path = find_file(self.folder, wanted.table, self.where(key, "table"))
        self.files.append(path)
        return read_table(path, wanted.columns)

    def pictures(self, names: Sequence[str], raw: str | None = None) -> list[Path]:
        """Pictures by names, patterns and folders of files; ``raw`` is the layout of files without a header."""
        layout = layout_of(raw)
        found: list[Path] = []
        for k, name in enumerate(names):
            where = self.where("pictures", "files", k)
            path = self.folder / name
            base = Path(path.anchor) if Path(name).is_absolute() else self.folder  # patterns count from a folder
            if path.is_dir():
                found += picture_files([path], PICTURE_ENDINGS, layout)
            else:
                found += find_files(base, [str(path.relative_to(base))], where, layout)
        self.files += dict.fromkeys(path.parent if is_frame(path) else path for path in found)
        return found

    def bars(self, model: ProjectModel) -> list[Table]:
        """Scale bars of the project itself and of its table."""
        found = []
        if model.scale_bars:
            rows = [{"from": bar.from_, "to": bar.to, "length": bar.length, "u": bar.u} for bar in model.scale_bars]
            fallback = self.lines.get(("scale_bars",), 1)
            lines = [self.lines.get(("scale_bars", k), fallback) for k in range(len(rows))]
            found.append(inline_table(str(self.source), rows, lines))
        table = self.table("scale_bars_table", model.scale_bars_table)
        return [*found, table] if table is not None else found
