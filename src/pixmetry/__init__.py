"""Follow a target's light from lens to stored number: simulate, measure, correct and budget every camera error source.

The names in ``__all__`` are the short way in. Each is imported from its module when it is first used, so that ``import pixmetry``
itself costs next to nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Camera": "pixmetry.core.camera",
    "Estimates": "pixmetry.core.estimates",
    "PixmetryError": "pixmetry.core.errors",
    "Signal": "pixmetry.core.signal",
    "assess": "pixmetry.assess",
    "catalogue": "pixmetry.core.catalogue",
    "load_camera": "pixmetry.core.camera",
    "load_campaign": "pixmetry.campaign",
}

__all__ = ["Camera", "Estimates", "PixmetryError", "Signal", "__version__", "assess", "catalogue", "load_camera", "load_campaign"]

if TYPE_CHECKING:
    from pixmetry.assess import assess
    from pixmetry.campaign import load_campaign
    from pixmetry.core.camera import Camera, load_camera
    from pixmetry.core.catalogue import catalogue
    from pixmetry.core.errors import PixmetryError
    from pixmetry.core.estimates import Estimates
    from pixmetry.core.signal import Signal


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """Keeps ``pixmetry.assess`` the function after the module of the same name has been imported.

    The import system binds a sub-module as an attribute of its package, which would hide a public name that is spelled alike.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
