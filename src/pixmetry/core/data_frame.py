"""Columns as a data frame, for those who have pandas."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from pixmetry.core.errors import InputError


def data_frame(columns: Mapping[str, Any]) -> Any:
    """Columns as a `pandas.DataFrame`.

    Raises
    ------
    InputError
        If pandas is not installed.
    """
    try:
        pandas = import_module("pandas")
    except ImportError:
        what = "the package pandas is not installed, and is needed for data frames"
        raise InputError(what, remedy="install it: pip install pandas") from None
    return pandas.DataFrame({name: list(values) for name, values in columns.items()})
