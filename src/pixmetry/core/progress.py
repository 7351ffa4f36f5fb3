"""Progress reports of long work."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and of how much: ``("reading frames", 3, 40)``."""


def no_progress(what: str, done: int, of: int) -> None:
    """For those who do not ask."""
