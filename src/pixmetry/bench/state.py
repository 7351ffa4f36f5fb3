"""What is on the bench: a camera and its changes, what it looks at, how it is measured. A link holds it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from pixmetry.budget.cameras import camera_of
from pixmetry.budget.probe import Target, facts_of, passed_light
from pixmetry.budget.scenario import Scenario, read_scenario
from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import SHEET_SCHEMA, Camera, build_camera, load_camera
from pixmetry.camera.overrides import changed_camera, with_source
from pixmetry.core.config import Model, validate
from pixmetry.core.errors import InputError
from pixmetry.scene.files import build_scene, read_scene

SCHEMA = "pixmetry/bench/1"
FIRST = "pulnix_tm6cn_epix_512"
GIVEN = "given"  # the camera of the command line
Name = Annotated[str, Field(max_length=120)]
Value = bool | int | float | Annotated[str, Field(max_length=120)]
Names = Annotated[tuple[Name, ...], Field(max_length=100)]
MOST_PHOTONS = 1e9  # of a scene
MOST_TARGETS = 20_000  # of a scene's lattice or plate
MOST_KEPT = 64  # cameras of which something is kept
OFF_CENTRE_PX = (0.3, -0.4)  # of the target, from the middle of the frame: no place that is special for the pixels


class BenchState(Model):
    """All that is on the page.

    Examples
    --------
    >>> from pixmetry.bench.state import Shelf, read_state
    >>> state = read_state({"camera": "imx264_like", "set": {"sensor.prnu.pixel_std_rel": 0.02}})
    >>> Shelf().camera(state)["sensor.prnu"].params.pixel_std_rel
    0.02
    """

    schema_: Literal["pixmetry/bench/1"] = Field(default="pixmetry/bench/1", alias="schema")
    camera: Name = Field(default=FIRST, description="a preset, a data sheet, or the camera of the command line (given)")
    record: dict[str, Any] | None = Field(default=None, description="a camera file or a data sheet, in place of the name")
    add: Names = Field(default=(), description="sources of the catalogue that the camera has beside its own")
    set: dict[Name, Value] = Field(default_factory=dict, max_length=500, description="changed values by NAME.PARAMETER, or of the camera")
    on: Names = Field(default=(), description="sources to switch on that are off in the camera")
    off: Names = Field(default=(), description="sources to switch off")
    scene: dict[str, Any] | None = Field(default=None, description="what is looked at, as a scene file; not given: one disc")
    scenario: dict[Name, dict[Name, Value | None]] = Field(default_factory=dict, max_length=20)
    x_px: float | None = Field(default=None, ge=0, le=1e5, description="place of the target; not given: near the middle")
    y_px: float | None = Field(default=None, ge=0, le=1e5)
    side_px: Literal[64, 128, 256] = 128
    estimator: Name = "auto"
    seed: int = Field(default=0, ge=0, le=2**31)
    chosen: Name = Field(default="", description="the source that is looked at")

    @property
    def text(self) -> str:
        """The same for every equal state."""
        return json.dumps(self.model_dump(mode="json", by_alias=True), sort_keys=True)


def read_state(values: Mapping[str, Any]) -> BenchState:
    """A checked state of plain values.

    Raises
    ------
    InputError
        With the key and what is allowed there.
    """
    return validate(BenchState, values, "state")


@lru_cache
def preset_names() -> tuple[str, ...]:
    """Names of the cameras that come with pixmetry."""
    return _names_in("presets")


@lru_cache
def sheet_names() -> tuple[str, ...]:
    """Names of the data sheets that come with pixmetry."""
    return _names_in("sheets")


def _names_in(folder: str) -> tuple[str, ...]:
    found = (p.name for p in (files("pixmetry.camera") / folder).iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in found if name.endswith(".yaml")))


@dataclass
class Shelf:
    """The cameras that a state may name: those that come with pixmetry, and the one of the command line. No name is taken as a path.

    Parameters
    ----------
    given : Camera, optional
        Of the command line.
    """

    given: Camera | None = None
    _kept: dict[str, Camera] = field(default_factory=dict)
    _full: dict[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return ((GIVEN,) if self.given is not None else ()) + preset_names() + sheet_names()

    def start(self, state: BenchState) -> Camera:
        """The camera before all changes.

        Raises
        ------
        InputError, ChainError
            If there is none of that name, or its record cannot be used.
        """
        if state.record is not None:
            return _camera_of_record(json.dumps(state.record, sort_keys=True))
        if state.camera == GIVEN and self.given is not None:
            return self.given
        if state.camera not in self.names:
            raise InputError("no such camera", where="camera", value=state.camera, allowed=", ".join(self.names))
        if state.camera not in self._kept:
            self._kept[state.camera] = load_camera(state.camera)
        return self._kept[state.camera]

    def camera(self, state: BenchState) -> Camera:
        """The camera with all changes, as a camera file holds it."""
        camera = self.start(state)
        for source_id in state.add:
            camera = with_source(camera, source_id)
        for name in state.on:
            camera[name]
        camera = replace(camera, chain=tuple(replace(e, on=e.on or e.name in state.on) for e in camera.chain))
        for name in state.off:
            if camera[name].source.essential:
                remedy = "set its parameters instead"
                raise InputError(f"{name} is a conversion without which no frame is made", where="off", remedy=remedy)
        return changed_camera(camera, state.set, state.off)

    def laid_out(self, state: BenchState) -> Layout:
        """Camera and scene of a state."""
        setting = Setting(self.camera(state), read_scenario(state.scenario))
        return Layout(state, self._saturating(state), setting, setting.camera)

    def _saturating(self, state: BenchState) -> float:
        """Photons on a pixel that bring the camera before all changes to saturation, ahead of everything that takes light away."""
        key = state.camera if state.record is None else json.dumps(state.record, sort_keys=True)
        if key not in self._full:
            if len(self._full) >= MOST_KEPT:
                self._full.clear()
            camera = self.start(state)
            facts = facts_of(camera, Target(), {"noise_dn": 1.0})
            self._full[key] = min(facts.saturation_dn / facts.dn_per_photon / passed_light(camera), MOST_PHOTONS)
        return self._full[key]


@lru_cache(maxsize=16)
def _camera_of_record(text: str) -> Camera:
    record = json.loads(text)
    if record.get("schema") == SHEET_SCHEMA:
        from pixmetry.camera.data_sheet import camera_of_data_sheet

        return camera_of_data_sheet(record, "camera")
    return build_camera(record, "camera")


def given_camera(cameras: Sequence[str | Path]) -> Camera | None:
    """The camera of the command line, of one description or several."""
    return camera_of(list(cameras))[0] if cameras else None


@dataclass(frozen=True)
class Layout:
    """A state laid out: the camera in the state of the measurement, and the scene that it looks at.

    Parameters
    ----------
    state : BenchState
    full_photons : float
        That bring the camera before all changes to saturation: the target's light stays while parameters move.
    setting : Setting
    camera : Camera
        That makes the picture: in the state of the measurement, as warm as the scenario says.
    """

    state: BenchState
    full_photons: float
    setting: Setting
    camera: Camera

    @property
    def scenario(self) -> Scenario:
        """What is measured and how."""
        return self.setting.scenario

    @property
    def place(self) -> tuple[float, float]:
        """Of the target in the scene's plane."""
        return self._looked_at if self.state.scene is None else self.target_at(0.0) or self._looked_at

    @property
    def _looked_at(self) -> tuple[float, float]:
        rows, cols = self.camera.frame_shape
        x, y = self.state.x_px, self.state.y_px
        return (cols // 2 + OFF_CENTRE_PX[0] if x is None else x, rows // 2 + OFF_CENTRE_PX[1] if y is None else y)

    @cached_property
    def _nearest(self) -> int | None:
        """Which target of a scene file is looked at: the one nearest to the place that the state names."""
        (x, y), targets = self._looked_at, self.seen.targets(0.5 * self.camera.exposure_s, 0) if hasattr(self.seen, "targets") else []
        far = {k: (t["x_px"] - x) ** 2 + (t["y_px"] - y) ** 2 for k, t in enumerate(targets) if "x_px" in t}
        return min(far, key=far.__getitem__) if far else None

    def target_at(self, time_s: float) -> tuple[float, float] | None:
        """Where in the scene's plane the target is that is looked at; None if the scene has none."""
        if self._nearest is None:
            return None
        target = self.seen.targets(time_s, 0)[self._nearest]
        return target["x_px"], target["y_px"]

    @cached_property
    def scene(self) -> dict[str, Any]:
        """The scene as its file holds it."""
        if self.state.scene is not None:
            return self.state.scene
        target, (x, y) = self.setting.target, self._looked_at
        full = self.full_photons
        scene: dict[str, Any] = {
            "schema": "pixmetry/scene/1",
            "uniform": {"level_photons": target.background_rel * full},
            "discs": {
                "x_px": [x],
                "y_px": [y],
                "diameter_px": target.diameter_px,
                "blur_px": target.blur_px,
                "peak_photons": target.peak_rel * full,
            },
        }
        if self.setting.moves:
            velocity, acceleration = self.setting.velocity_px_per_s, self.setting.acceleration_px_per_s2
            scene["motion"] = {"velocity_px_per_s": velocity.tolist(), "acceleration_px_per_s2": acceleration.tolist()}
        return scene

    @cached_property
    def seen(self) -> Any:
        """The scene.

        Raises
        ------
        InputError
            If it is a series, or has more targets than a page can show at once.
        """
        model, (rows, cols) = read_scene(self.scene), self.camera.frame_shape
        if model.photon_transfer is not None:
            raise InputError("a photon-transfer series is not one picture", where="scene", remedy="give its uniform field alone")
        lattice = 0 if model.discs is None or model.discs.lattice_px is None else rows * cols / model.discs.lattice_px**2
        plate = 0 if model.plate is None else model.plate.rows * model.plate.columns
        if max(lattice, plate) > MOST_TARGETS:
            raise InputError("the scene has too many targets for the bench", where="scene", allowed=f"up to {MOST_TARGETS}")
        return build_scene(model, self.camera.frame_shape, "scene")

    @cached_property
    def true_px(self) -> tuple[float, float] | None:
        """Where the target's centre lies in the frame; of one that moves, in the middle of the exposure; None without a target."""
        target = self.target_at(0.5 * self.camera.exposure_s)
        return None if target is None else self._in_frame(target)

    def _in_frame(self, place: tuple[float, float]) -> tuple[float, float]:
        x, y = self.camera.true_positions(*place, 0, self.state.seed)
        return float(x[0]), float(y[0])

    @cached_property
    def middle_px(self) -> tuple[float, float]:
        """Where the page looks: at the target, else at the place that the state names."""
        return self._in_frame(self._looked_at) if self.true_px is None else self.true_px

    @cached_property
    def window(self) -> tuple[int, int, int, int]:
        """First row and column, rows and columns of the part of the frame that is shown."""
        rows, cols = self.camera.output_shape
        x, y = self.middle_px
        if not (-0.5 <= x <= cols - 0.5 and -0.5 <= y <= rows - 0.5):
            where, remedy = f"x {x:.5g}, y {y:.5g} px", "move it, or the frame"
            raise InputError("the target lies outside of the frame", value=where, allowed=f"{cols} × {rows} px", remedy=remedy)
        height, width = min(self.state.side_px, rows), min(self.state.side_px, cols)
        row0 = min(max(round(y) - height // 2, 0), rows - height)
        col0 = min(max(round(x) - width // 2, 0), cols - width)
        return row0, col0, height, width


def budget_target(layout: Layout) -> dict[str, float]:
    """What a scenario says of a target that is like the one that is looked at: of a disc of one size and blur, else nothing."""
    model = read_scene(layout.scene)
    if model.discs is not None and layout.state.scene is not None:
        diameter, blur, peak = model.discs.diameter_px, model.discs.blur_px, model.discs.peak_photons
    else:
        discs = [t for t in model.targets if t.kind == "disc"]
        if not discs or model.plate is not None:
            return {}
        diameter, blur, peak = discs[0].diameter_px, model.blur_px, discs[0].peak_photons
    dark = 0.0 if model.uniform is None else model.uniform.level_photons
    told = {"diameter_px": diameter, "blur_px": blur, "peak_rel": peak / layout.full_photons, "background_rel": dark / layout.full_photons}
    fields = Scenario().target
    found = {}
    for name, value in told.items():
        try:
            type(fields).model_validate({name: value})
        except ValueError:
            continue  # beyond what a budget knows of: its own value stays
        found[name] = float(value)
    return found
