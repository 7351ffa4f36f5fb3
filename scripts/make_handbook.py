"""Run the handbook's experiments and write their pages and figures into docs/handbook.

python scripts/make_handbook.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))  # the gallery is no part of the package

from gallery.pages import write  # noqa: E402

TARGET = Path(__file__).resolve().parents[1] / "docs" / "handbook"


def main() -> None:
    """Write the pages and say which files were written."""
    for path in write(Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET):
        print(path)


if __name__ == "__main__":
    main()
