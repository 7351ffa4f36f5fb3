"""Names of arrays by what they hold, for annotations; shape and unit are told where an array is named.

A bare ``np.ndarray`` holds anything, and a checker of types does not know what is computed from it. It stands where an array may hold any
numbers, such as the stored values of a frame. What NumPy's functions return is often unknown too; an annotated name says what it is:
``root: Array = np.sqrt(x)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixmetry.core.errors import InputError

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


def given_array(value: Any, where: str, shape: tuple[int | str, ...], *, finite: bool = False) -> Array:
    """An argument as an array of real numbers of a shape.

    Parameters
    ----------
    value : array_like
    where : str
        Name of the argument.
    shape : tuple of int or str
        Lengths; a name stands for any length.
    finite : bool
        Whether NaN and infinity are refused.

    Raises
    ------
    InputError
        If it is something else.

    Examples
    --------
    >>> given_array([[1, 2]], "px", ("n", 2))
    array([[1., 2.]])
    >>> given_array([1, 2, 3], "px", ("n", 2))
    Traceback (most recent call last):
    ...
    pixmetry.core.errors.InputError: px: an array of another shape; found (3,); allowed: shape (n, 2)
    """
    allowed = f"shape ({', '.join(str(length) for length in shape)}{',' if len(shape) == 1 else ''})"
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise TypeError
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise InputError("not an array of real numbers", where=where, value=type(value).__name__, allowed=allowed) from None
    if array.ndim != len(shape) or any(isinstance(want, int) and want != length for want, length in zip(shape, array.shape, strict=False)):
        raise InputError("an array of another shape", where=where, value=array.shape, allowed=allowed)
    if finite and not np.isfinite(array).all():
        remedy = "leave out what is not known"
        raise InputError("holds values that are not finite", where=where, value=int((~np.isfinite(array)).sum()), remedy=remedy)
    return array


def given_count(value: Any, where: str, least: int, most: int) -> int:
    """An argument as a whole number within limits.

    Raises
    ------
    InputError
        If it is something else.
    """
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not least <= value <= most:
        raise InputError("not a whole number within its limits", where=where, value=value, allowed=f"{least} … {most}")
    return int(value)
