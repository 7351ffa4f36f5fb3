"""Covered pixels: rows and columns at the borders of a stored frame that no light reaches."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Covered:
    """How many columns and rows at each border of the stored frames are optically black, or overscan.

    What lies between them is the active area: the frames that everything else in pixmetry speaks of.

    Parameters
    ----------
    left, right : int
        Columns.
    top, bottom : int
        Rows.

    Examples
    --------
    >>> Covered(right=16).active_shape((480, 656))
    (480, 640)
    """

    left: int = 0
    right: int = 0
    top: int = 0
    bottom: int = 0

    def active_shape(self, stored: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of the active area of a stored frame; not positive where nothing is left."""
        return stored[0] - self.top - self.bottom, stored[1] - self.left - self.right

    def stored_shape(self, active: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of a stored frame with this active area."""
        return active[0] + self.top + self.bottom, active[1] + self.left + self.right

    def active(self, stored: tuple[int, int]) -> tuple[slice, slice]:
        """Where the active area is in a stored frame, for indexing."""
        return slice(self.top, stored[0] - self.bottom), slice(self.left, stored[1] - self.right)
