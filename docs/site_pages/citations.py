"""Where each citation of literature was checked, from ``docs/references.yaml``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

STORED = Path(__file__).resolve().parents[1] / "references.yaml"
SHORT = re.compile(  # "Author 1999", "Author, Other 1999", "Author et al. 1999" in a text; no months
    r"\b(?!January|February|March|April|May|June|July|August|September|October|November|December)(?:van )?[A-ZÅÄÖ][a-zåäöüéß]{3,}"
    r"(?:(?:, | and )[A-ZÅÄÖ][a-zåäöüéß]+| et al\.)*,? (?:19|20)\d\d\b"
)


@dataclass(frozen=True)
class Citation:
    """An entry of the list.

    Parameters
    ----------
    cited_as : str
        A piece of the citation's text.
    checked : str
        A second place where it was looked up; empty: it is from memory.
    what : str
        What was found there, if not all of it.
    """

    cited_as: str
    checked: str = ""
    what: str = ""

    @property
    def words(self) -> str:
        """In brackets behind the citation."""
        if not self.checked:
            return "from memory"
        place = f"<{self.checked}>" if self.checked.startswith("http") else self.checked
        return f"checked{f' ({self.what})' if self.what else ''}: {place}"


@lru_cache(maxsize=1)
def citations() -> tuple[Citation, ...]:
    """Read the list."""
    from ruamel.yaml import YAML

    return tuple(Citation(**entry) for entry in YAML(typ="safe").load(STORED.read_text(encoding="utf-8")))


def citation_of(text: str) -> Citation:
    """The entry of a citation.

    Raises
    ------
    LookupError
        If there is none, or more than one.
    """
    found = [entry for entry in citations() if entry.cited_as in text]
    if len(found) != 1:
        raise LookupError(f"{len(found)} entries in {STORED.name} for: {text}")
    return found[0]
