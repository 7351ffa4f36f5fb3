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
    "Camera": "pixmetry.camera.camera",
    "Estimates": "pixmetry.core.number",
    "Frames": "pixmetry.files",
    "Number": "pixmetry.core.number",
    "PixmetryError": "pixmetry.core.errors",
    "Signal": "pixmetry.camera.signal",
    "Tracker": "pixmetry.locate.track.tracker",
    "add_source_file": "pixmetry.camera.catalogue",
    "assess": "pixmetry.assess.job",
    "bound": "pixmetry.locate.bound.bound",
    "budget": "pixmetry.budget.job",
    "calibrate": "pixmetry.calibrate.job",
    "campaign_of_arrays": "pixmetry.files",
    "chain": "pixmetry.simulate.chain",
    "check_limits": "pixmetry.assess.judge.compare",
    "compare": "pixmetry.assess.judge.compare",
    "compare_budgets": "pixmetry.budget.compare",
    "compare_fleet": "pixmetry.assess.judge.compare",
    "correct": "pixmetry.assess.correct",
    "corrected": "pixmetry.assess.corrected",
    "emva1288": "pixmetry.emva.job",
    "load_camera": "pixmetry.camera.camera",
    "load_campaign": "pixmetry.files",
    "locate": "pixmetry.locate.job",
    "read_calibration": "pixmetry.calibrate.files.record",
    "read_frame": "pixmetry.files",
    "series": "pixmetry.series.job",
    "simulate": "pixmetry.simulate.job",
    "sources": "pixmetry.camera.catalogue",
}

__all__ = [
    "Camera",
    "Estimates",
    "Frames",
    "Number",
    "PixmetryError",
    "Signal",
    "Tracker",
    "__version__",
    "add_source_file",
    "assess",
    "bound",
    "budget",
    "calibrate",
    "campaign_of_arrays",
    "chain",
    "check_limits",
    "compare",
    "compare_budgets",
    "compare_fleet",
    "correct",
    "corrected",
    "emva1288",
    "load_camera",
    "load_campaign",
    "locate",
    "read_calibration",
    "read_frame",
    "series",
    "simulate",
    "sources",
]

if TYPE_CHECKING:
    from pixmetry.assess.correct import correct
    from pixmetry.assess.corrected import corrected
    from pixmetry.assess.job import assess
    from pixmetry.assess.judge.compare import check_limits, compare, compare_fleet
    from pixmetry.budget.compare import compare_budgets
    from pixmetry.budget.job import budget
    from pixmetry.calibrate.files.record import read_calibration
    from pixmetry.calibrate.job import calibrate
    from pixmetry.camera.camera import Camera, load_camera
    from pixmetry.camera.catalogue import add_source_file, sources
    from pixmetry.camera.signal import Signal
    from pixmetry.core.errors import PixmetryError
    from pixmetry.core.number import Estimates, Number
    from pixmetry.emva.job import emva1288
    from pixmetry.files import Frames, campaign_of_arrays, load_campaign, read_frame
    from pixmetry.locate.bound.bound import bound
    from pixmetry.locate.job import locate
    from pixmetry.locate.track.tracker import Tracker
    from pixmetry.series.job import series
    from pixmetry.simulate.chain import chain
    from pixmetry.simulate.job import simulate


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


class _Package(ModuleType):
    """Keeps ``pixmetry.locate`` the function: Python would put the room of that name in its place as soon as the room is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
