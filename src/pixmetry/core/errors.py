"""Errors, and which one to raise.

* ``InputError``: something the user gave (a file, a manifest, a parameter, a command-line value) cannot be used.
* ``ParameterError``: a physical parameter is outside the range in which its model holds. It is also a ``ValueError``.
* ``ChainError``: sources that do not fit together (kinds, order, a name used twice). Raised when a camera is built.
* ``MeasureError``: the observations do not carry the quantity that was asked for.

Every message says what is wrong, where, what is allowed and what to do. A programming mistake is not one of these: let it
surface as the exception that Python gives it.
"""

from __future__ import annotations

from typing import Any


class PixmetryError(Exception):
    """Base of all errors that pixmetry raises on purpose.

    Parameters
    ----------
    what : str
        What is wrong, in one clause.
    where : str, optional
        File, line, source or parameter that holds the mistake.
    value, allowed : optional
        The value that was found, and what would have been accepted.
    remedy : str, optional
        What the reader can do about it.

    Examples
    --------
    >>> raise PixmetryError("no such release", where="--release", value="5", allowed="4.0, 3.1")
    Traceback (most recent call last):
    ...
    pixmetry.core.errors.PixmetryError: --release: no such release; found '5'; allowed: 4.0, 3.1
    """

    def __init__(self, what: str, *, where: str = "", value: Any = None, allowed: str = "", remedy: str = "") -> None:
        self.what, self.where, self.value, self.allowed, self.remedy = what, where, value, allowed, remedy
        super().__init__(what)

    def __str__(self) -> str:
        parts = [f"{self.where}: {self.what}" if self.where else self.what]
        if self.value is not None:
            parts.append(f"found {self.value!r}")
        if self.allowed:
            parts.append(f"allowed: {self.allowed}")
        if self.remedy:
            parts.append(f"to do: {self.remedy}")
        return "; ".join(parts)


class InputError(PixmetryError, ValueError):
    """A file, manifest or command-line value cannot be used."""


class ParameterError(PixmetryError, ValueError):
    """A physical parameter is outside the range in which its model holds."""


class ChainError(PixmetryError, ValueError):
    """Sources that do not fit together in one camera."""


class MeasureError(PixmetryError, ValueError):
    """The observations do not carry the quantity that was asked for."""
