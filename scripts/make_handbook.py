"""Run the handbook's experiments and write their pages, figures and gallery.json into docs/handbook.

python scripts/make_handbook.py [PAGE ...]

With names of pages, the scripts of these are run; the others of the short scripts keep their stored numbers.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))  # the gallery is no part of the package

from gallery.pages import NOTES, ORDER, write  # noqa: E402

TARGET = Path(__file__).resolve().parents[1] / "docs" / "handbook"


def main() -> None:
    """Write the pages and say which files were written."""
    if unknown := set(sys.argv[1:]) - set(ORDER):
        sys.exit(f"no such page: {', '.join(sorted(unknown))}; there are {', '.join(ORDER)}")
    for path in write(TARGET, sys.argv[1:] or NOTES):
        print(path)


if __name__ == "__main__":
    main()
