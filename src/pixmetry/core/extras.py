"""Packages that only some jobs need: each comes with an extra of the installation; the error for a missing one names the extra."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from pixmetry.core.errors import InputError

EXTRAS = {  # module: package, extra of the installation that brings it, what needs it
    "cv2": ("opencv-python-headless", "opencv", "calibrating, and locating chessboards, lines and edges"),
    "pyarrow.parquet": ("pyarrow", "parquet", "writing a table as Parquet"),
    "starlette": ("starlette", "bench", "the pages of `pixmetry bench` and `pixmetry view`"),
    "uvicorn": ("uvicorn", "bench", "the pages of `pixmetry bench` and `pixmetry view`"),
    "pypylon.pylon": ("pypylon", "basler", "cameras of kind basler"),
    "av": ("av", "video", "the error source storage.video_codec"),
}


def import_extra(module: str) -> Any:
    """Import a module of an optional package, a key of `EXTRAS`.

    Raises
    ------
    InputError
        If the package is not installed, or cannot be loaded.

    Examples
    --------
    >>> import_extra("cv2").__name__
    'cv2'
    """
    try:
        return import_module(module)
    except ImportError as problem:
        package, extra, what = EXTRAS[module]
        state = "is not installed" if isinstance(problem, ModuleNotFoundError) else f"cannot be loaded ({problem})"
        remedy = f"pip install {package}, or install pixmetry with its extra: pip install '.[{extra}]'"
        raise InputError(f"the package {package} {state}, and is needed for {what}", remedy=remedy) from None
