"""Follow a target's light from lens to stored number: simulate, measure, correct and budget every camera error source.

The names in ``__all__`` are the short way in. Each is imported from its module when it is first used, so that ``import pixmetry``
itself costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Camera": "pixmetry.core.camera",
    "Estimates": "pixmetry.core.estimates",
    "Frames": "pixmetry.campaign",
    "PixmetryError": "pixmetry.core.errors",
    "Signal": "pixmetry.core.signal",
    "add_source_file": "pixmetry.core.catalogue",
    "assess": "pixmetry.assessment",
    "calibrate": "pixmetry.calibrating",
    "campaign_of_arrays": "pixmetry.campaign",
    "catalogue": "pixmetry.core.catalogue",
    "check_limits": "pixmetry.comparing",
    "compare": "pixmetry.comparing",
    "compare_fleet": "pixmetry.comparing",
    "emva1288": "pixmetry.datasheets",
    "load_camera": "pixmetry.core.camera",
    "load_campaign": "pixmetry.campaign",
    "locate": "pixmetry.locating",
    "read_calibration": "pixmetry.calibration_record",
    "simulate": "pixmetry.simulation",
    "walk": "pixmetry.chain",
}

__all__ = [
    "Camera",
    "Estimates",
    "Frames",
    "PixmetryError",
    "Signal",
    "__version__",
    "add_source_file",
    "assess",
    "calibrate",
    "campaign_of_arrays",
    "catalogue",
    "check_limits",
    "compare",
    "compare_fleet",
    "emva1288",
    "load_camera",
    "load_campaign",
    "locate",
    "read_calibration",
    "simulate",
    "walk",
]

if TYPE_CHECKING:
    from pixmetry.assessment import assess
    from pixmetry.calibrating import calibrate
    from pixmetry.calibration_record import read_calibration
    from pixmetry.campaign import Frames, campaign_of_arrays, load_campaign
    from pixmetry.chain import walk
    from pixmetry.comparing import check_limits, compare, compare_fleet
    from pixmetry.core.camera import Camera, load_camera
    from pixmetry.core.catalogue import add_source_file, catalogue
    from pixmetry.core.errors import PixmetryError
    from pixmetry.core.estimates import Estimates
    from pixmetry.core.signal import Signal
    from pixmetry.datasheets import emva1288
    from pixmetry.locating import locate
    from pixmetry.simulation import simulate


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
