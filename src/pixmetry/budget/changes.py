"""Changes to a budget's camera and scenario by name: ``motion.speed_px_per_s=50``, ``electronics.gain.gain_dn_per_e=0.4``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pixmetry.budget.scenario import Scenario
from pixmetry.camera.camera import Camera
from pixmetry.camera.overrides import changed_camera
from pixmetry.core.config import validate


def changed(camera: Camera, scenario: Scenario, settings: Mapping[str, Any]) -> tuple[Camera, Scenario]:
    """Camera and scenario with some values changed.

    A key names an entry of the scenario, as ``target.diameter_px``; else it is one of the camera's, see `changed_camera`.

    Raises
    ------
    InputError
        If there is no such entry, or its value is out of range.
    """
    record: dict[str, Any] = {}
    for part in set(Scenario.model_fields) - {"schema_"}:
        model = getattr(scenario, part)
        record[part] = {name: getattr(model, name) for name in model.model_fields_set}
    own: dict[str, Any] = {}
    for key, value in settings.items():
        part, _, entry = key.partition(".")
        if part in record and entry and "." not in entry:  # storage.jpeg.quality is the camera's
            record[part][entry] = value
        else:
            own[key] = value
    return changed_camera(camera, own), validate(Scenario, record, "scenario")
