"""Run the handbook's experiments and write their pages, figures and gallery.json into docs/handbook.

python scripts/make_handbook.py [--twice] [PAGE ...]

With names of pages, the scripts of these are run; the others of the short scripts keep their stored numbers. With --twice everything is
made twice in a temporary folder, and both must be the same bit by bit; nothing is written.
"""

from __future__ import annotations

import filecmp
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))  # the gallery is no part of the package

from gallery import questions  # noqa: E402
from gallery.pages import ORDER, write  # noqa: E402

TARGET = Path(__file__).resolve().parents[1] / "docs" / "handbook"


def made_twice(run: Sequence[str]) -> list[str]:
    """Names of the files that two runs make differently."""
    with tempfile.TemporaryDirectory() as temporary:
        first, second = (Path(temporary) / name for name in "ab")
        write(first, run)
        write(second, run)
        names = {path.name for folder in (first, second) for path in folder.iterdir()}
        return filecmp.cmpfiles(first, second, sorted(names), shallow=False)[1]


def main() -> None:
    """Write the pages and say which files were written."""
    known = (*ORDER, questions.NAME)
    twice, names = "--twice" in sys.argv[1:], [name for name in sys.argv[1:] if name != "--twice"]
    if unknown := set(names) - set(known):
        sys.exit(f"no such page: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    run = names or known
    if twice:
        sys.exit(f"two runs differ: {', '.join(wrong)}" if (wrong := made_twice(run)) else 0)
    for path in write(TARGET, run):
        print(path)


if __name__ == "__main__":
    main()
