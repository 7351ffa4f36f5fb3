"""Correction of positions: from where a frame shows targets to where the camera would show them without what is known of it.

There is no second set of formulas. The camera's own maps are followed backwards, from the frame to the scene's plane, and forwards again
through the camera without the sources that are corrected; with all of them corrected, the positions are those of the ideal camera, in
pixels of the sensor. What a source's parameters leave uncertain is the change of that whole map along the principal directions of their
covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.assess.per_image import MODELS, fit_per_image
from pixmetry.assess.per_row import PerRow, fit_per_row
from pixmetry.assess.position_tables import Positions, check_form, mark_of, read_positions
from pixmetry.budget.changes import changed
from pixmetry.budget.motion import LOOKS, in_pairs, row_delays
from pixmetry.budget.parameters import covariance_of, with_estimates
from pixmetry.budget.scenario import Scenario, read_scenario
from pixmetry.budget.setting import Setting, in_state
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.observations import AFFINITY, LENS, TAKEN_UP
from pixmetry.camera.overrides import with_source
from pixmetry.camera.provenance import MEASURED, TYPICAL
from pixmetry.core.arguments import typed
from pixmetry.core.errors import InputError
from pixmetry.files.output import Output, check_files, write_together

CORRECTED_SCHEMA = "pixmetry/corrected/1"
ROWS = "rows"  # the model of a reference that is measured row by row
NOTHING_PX = 1e-9  # a smaller displacement is none
NO_TIME_S = 1e-9  # after the time of the frame
STEP_PX = 0.25  # for derivatives by place
SPEED_COLUMNS = ("vx_px_per_s", "vy_px_per_s")
SPEED = "the speed of the targets: columns vx_px_per_s and vy_px_per_s, or motion.speed_px_per_s"
STATE = ("state.camera_on_min", "state.grabber_on_min", "state.temperature_change_k", "state.warm_up_k")


@dataclass(frozen=True)
class SourceCorrection:
    """What was done about one error source.

    Parameters
    ----------
    name, title : str
        In the chain of the camera, and in words.
    applied : bool
    text : str
        By what the correction is known, or why there is none.
    shift_px : (float, float)
        Largest displacement that was taken off, in x and y.
    u_px : (float, float)
        Largest standard uncertainty of the correction, in x and y.
    """

    name: str
    title: str
    applied: bool
    text: str
    shift_px: tuple[float, float] = (0.0, 0.0)
    u_px: tuple[float, float] = (0.0, 0.0)

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON."""
        return {
            "name": self.name,
            "title": self.title,
            "applied": self.applied,
            "text": self.text,
            "largest_shift_px": list(self.shift_px),
            "largest_u_px": list(self.u_px),
        }


@dataclass(frozen=True)
class CorrectedPositions:
    """Corrected positions, a row for each of the table.

    Parameters
    ----------
    x_px, y_px : ndarray, shape (n,)
        In pixels, from the centre of the top-left pixel; NaN where the table has no position, or the camera cannot show one there.
    measured : Positions
        The table.
    covariance_px2 : ndarray, shape (n, 3), or None
        var x, cov xy, var y of each position, that of the correction included; None where the table tells none.
    correction_px2 : ndarray, shape (n, 3)
        The same of the correction alone.
    effects_px : ndarray, shape (k, n, 2)
        What each independent cause of the correction's uncertainty does to all positions at once, as large as its standard uncertainty.
    causes : tuple of str
        Names of these: of sources, or of the state and the motion of the measurement.
    sources : tuple of SourceCorrection
    notes : tuple of str
    camera : str
    image_effects_px : ndarray, shape (p, n, 2), optional
        The same as ``effects_px`` of what was fitted in each image; the causes of two images are independent of each other.
    image_of : ndarray of int, shape (n,), optional
    """

    x_px: np.ndarray
    y_px: np.ndarray
    measured: Positions
    covariance_px2: np.ndarray | None
    correction_px2: np.ndarray
    effects_px: np.ndarray
    causes: tuple[str, ...]
    sources: tuple[SourceCorrection, ...]
    notes: tuple[str, ...] = ()
    camera: str = ""
    image_effects_px: np.ndarray | None = None
    image_of: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.x_px)

    def __repr__(self) -> str:
        done = [s.name for s in self.sources if s.applied]
        return f"<CorrectedPositions: {len(self)} by {', '.join(done) or 'nothing'}>"

    @property
    def shift_px(self) -> np.ndarray:
        """Corrected less measured, shape (n, 2)."""
        return np.stack([self.x_px - self.measured.x_px, self.y_px - self.measured.y_px], axis=1)

    @property
    def correction_covariance_px2(self) -> np.ndarray:
        """Covariance of the correction of all positions, x and y of one after the other, shape (2 n, 2 n)."""
        flat = np.nan_to_num(self.effects_px.reshape(len(self.effects_px), 2 * len(self)))
        total = np.asarray(flat.T @ flat)
        if self.image_effects_px is not None and self.image_of is not None:
            own = np.nan_to_num(self.image_effects_px.reshape(len(self.image_effects_px), 2 * len(self)))
            image = np.repeat(self.image_of, 2)
            total = total + (own.T @ own) * (image[:, None] == image)
        return total

    @property
    def common_u_px(self) -> tuple[float, float]:
        """Standard uncertainty of the correction of the mean of all positions: what no number of targets averages."""
        seen = np.isfinite(self.x_px)
        mean = self.effects_px[:, seen].mean(axis=1) if seen.any() else np.zeros((len(self.effects_px), 2))
        square = (mean**2).sum(axis=0)
        if self.image_effects_px is not None and self.image_of is not None:
            for image in np.unique(self.image_of[seen]):
                part = self.image_effects_px[:, seen & (self.image_of == image)].sum(axis=1) / seen.sum()
                square = square + (part**2).sum(axis=0)
        x, y = np.sqrt(square)
        return float(x), float(y)

    @property
    def state_u_px(self) -> dict[str, tuple[float, float]]:
        """Largest standard uncertainty of the correction by causes that are no sources: state and motion of the measurement."""
        own = {s.name for s in self.sources}
        found = {}
        for name in dict.fromkeys(cause for cause in self.causes if cause not in own):
            of_it = np.array([effect for cause, effect in zip(self.causes, self.effects_px, strict=True) if cause == name])
            u = np.sqrt((np.nan_to_num(of_it) ** 2).sum(axis=0)).max(axis=0, initial=0.0)
            found[name] = (float(u[0]), float(u[1]))
        return found

    @property
    def columns(self) -> dict[str, Any]:
        """The columns of the table, with the corrected positions in place of the measured ones."""
        correction = self.correction_px2 if self.correction_px2.any() else None
        return self.measured.replaced(self.x_px, self.y_px, self.covariance_px2, correction)

    def content(self) -> bytes:
        """The table as a file, in the form in which it came."""
        done, silent = ([s.name for s in self.sources if s.applied and yes(s)] for yes in (lambda s: True, lambda s: not any(s.u_px)))
        told = f"{', '.join(done) or 'nothing'} corrected; x and y are those that {self.camera} would show without"
        if silent:
            told += f"; the covariance lacks the uncertainty of {', '.join(silent)}, which is not stated"
        return self.measured.content(self.columns, told)

    def write(self, path: str | Path) -> Path:
        """Write the table in the form in which it came; it appears whole or not at all.

        Raises
        ------
        InputError
            If there is another file of that name, or it cannot be written.
        """
        inputs = [Path(self.measured.source)] if self.measured.form else []
        write_together([checked_output(path, self.measured.form, inputs)], [self.content()], inputs)
        return Path(path)

    def to_record(self) -> dict[str, Any]:
        """Plain record for JSON: what was corrected, without the table."""
        return {
            "schema": CORRECTED_SCHEMA,
            "camera": self.camera,
            "positions": len(self),
            "lost": int(np.sum(~np.isfinite(self.x_px))),
            "common_u_px": list(self.common_u_px),
            "sources": [s.to_record() for s in self.sources],
            "largest_u_px_by_state": {name: list(u) for name, u in self.state_u_px.items()},
            "notes": list(self.notes),
        }


def checked_output(path: str | Path, form: str, inputs: Iterable[Path] = ()) -> Output:
    """Refuse a name under which a table of a form cannot be written, before any work is done.

    Raises
    ------
    InputError
    """
    check_form(Path(path), form)
    output = Output(Path(path), mark_of(form), True)
    check_files([output], inputs)
    return output


@typed
def corrected(
    table: Any,
    with_: Camera | str | Path,
    output: str | Path | None = None,
    *,
    scenario: Scenario | Mapping[str, Any] | str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    u: Mapping[str, float] | None = None,
    only: Iterable[str] = (),
    skip: Iterable[str] = (),
    x: str | None = None,
    y: str | None = None,
    origin: str = "first_pixel",
    reference: Any = None,
    per_image: str = "scale",
    match: str | None = None,
) -> CorrectedPositions:
    """Correct positions for all that the description of their camera knows of its geometry.

    Parameters
    ----------
    table : path, Located, mapping of columns, or array_like of shape (n, 2)
        CSV or JSON of `pixmetry locate`, or any CSV with columns for x and y. Columns that count where they are there: ``frame`` (number of
        the frame; without it images are numbered in their order), ``time_s`` (since the first frame), ``temperature_c`` (of the sensor),
        ``vx_px_per_s`` and ``vy_px_per_s`` (speed of the target in pixels of the frames, as x and y are), and the uncertainties of x and
        y.
    with_ : Camera or str or path
        A camera, the name of a preset, a data sheet, or the ``camera.yaml`` of an assessment.
    output : path, optional
        Where the table goes, in the form in which it came.
    scenario : Scenario, mapping or path, optional
        State and motion of the measurement, as of `pixmetry.budget`; its speed is in pixels of the sensor. Without one the
        camera is in the state that its description has.
    settings : mapping, optional
        Changes by name: entries of the scenario such as ``state.grabber_on_min``, parameters such as ``optics.cover_glass.thickness_um``,
        values of the camera such as ``temperature_c``. A source that is not in the camera is put into it.
    u : mapping, optional
        Standard uncertainties by the same names, for what the description does not tell.
    only, skip : iterable of str
        Names of sources. What is only typical of such a camera, or was drawn at random, is corrected only if it is named.
    x, y : str, optional
        Names of the columns.
    origin : {"first_pixel", "corner", "one"}
        What the table calls the centre of the top-left pixel: (0, 0), (0.5, 0.5) or (1, 1).
    reference : path, mapping of columns, or array_like, optional
        Where targets should be, by name; or places of a straight line.
    per_image : {"shift", "scale", "pose", "rows"}
        What is fitted to the reference in each image; ``rows``: see `pixmetry.assess.per_row.fit_per_row`.
    match : str, optional
        The column that names targets in both tables.

    Returns
    -------
    CorrectedPositions

    Raises
    ------
    InputError
        If the table or the description cannot be used, or no source has such a name.

    Notes
    -----
    With the map M of the camera from the scene's plane to the frame and M₀ that without the corrected sources, a position p becomes
    p' = M₀(M⁻¹(p)). Its covariance is J C Jᵀ + Σ dₖ dₖᵀ (JCGM 102, 6.2), with J = ∂p'/∂p by differences, and dₖ the change of p' along the
    k-th principal direction of the parameters' covariance. A target that moves by v is seen at the time of its row: v τ(row) is taken off.

    Examples
    --------
    >>> import pixmetry
    >>> camera = pixmetry.load_camera("pulnix_tm6cn_epix_512")
    >>> seen = camera.true_positions([300.0, 420.0], [200.0, 250.0])     # the grabber was just switched on
    >>> found = pixmetry.corrected({"x_px": seen[0], "y_px": seen[1]}, camera, u={"grabber.clock_warm_up.scale_error_rel": 1e-4})
    >>> found.x_px.round(6), found.y_px.round(6)
    (array([300., 420.]), array([200., 250.]))
    >>> print(f"{found.common_u_px[0]:.3f} px")
    0.051 px
    """
    asked = read_scenario(scenario)
    positions = read_positions(table, x=x, y=y, origin=origin)
    rows = None
    if reference is not None and per_image == ROWS:  # they are rows of the frame: first of all
        rows = fit_per_row(positions, read_positions(reference, origin=origin))
    seen = positions if rows is None else replace(positions, x_px=positions.x_px - rows.shift_px)
    case = _Case.of(seen, with_, asked, dict(settings or {}), scenario is not None, dict(u or {}))
    found = _corrected(case, _known_names(case.camera, only), _known_names(case.camera, skip))
    if rows is not None:
        found = _without_jitter(replace(found, measured=positions), rows, case.camera)
    elif reference is not None:
        found = _fitted(found, read_positions(reference, origin=origin), per_image, case.camera.frame_shape, match)
    if output is not None:
        found.write(output)
    return found


# ---- what is known of the camera in its state ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Case:
    """Positions, their camera in its state, and how fast the targets move."""

    table: Positions
    described: Camera
    scenario: Scenario
    settings: Mapping[str, Any]
    in_state: bool
    u: Mapping[str, float]
    added: frozenset[str]

    @classmethod
    def of(
        cls, table: Positions, with_: Camera | str | Path, scenario: Scenario, settings: dict[str, Any], told: bool, u: dict[str, float]
    ) -> _Case:
        camera = with_ if isinstance(with_, Camera) else load_camera(with_)
        before = {e.name for e in camera.chain}
        camera = with_missing(_with_limits(camera), [*settings, *u], scenario.object.f_mm)
        added = frozenset(e.name for e in camera.chain if e.name not in before)
        case = cls(table, camera, scenario, settings, told or any(key in STATE for key in (*settings, *u)), u, added)
        for key, value in u.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < np.inf:
                raise InputError("no standard uncertainty", where=key, value=value, allowed="a number of 0 or more")
            case.nominal(key)
        return case

    @cached_property
    def camera(self) -> Camera:
        """In the state of the measurement."""
        return self._built({})[0]

    def _built(self, moved: Mapping[str, Any]) -> tuple[Camera, Scenario]:
        camera, scenario = changed(self.described, self.scenario, {**self.settings, **moved})
        if self.in_state:
            s = scenario.state
            camera = in_state(camera, s.camera_on_min, s.grabber_on_min, s.temperature_change_k, s.warm_up_k)
        return camera, scenario

    def nominal(self, key: str) -> float:
        """The value behind a name of the settings."""
        camera, scenario = changed(self.described, self.scenario, self.settings)
        told, (name, _, parameter) = scenario.told, key.rpartition(".")
        if key in told:
            value = told[key][0]
        elif name and name in camera and parameter in type(camera[name].params).model_fields:
            value = getattr(camera[name].params, parameter)
        elif not name and isinstance(getattr(camera, key, None), int | float):
            value = getattr(camera, key)
        else:
            allowed = "an entry of the scenario (state.…, motion.…), NAME.PARAMETER of a source, or temperature_c"
            raise InputError("no number has this name", where="u", value=key, allowed=allowed)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError("an uncertainty of what has no value", where="u", value=key, remedy="give its value too")
        return float(value)

    def at(self, moved: Mapping[str, Any]) -> _Moment:
        """The camera with some of the settings changed, at the times of the table."""
        camera, scenario = (self.camera, changed(self.described, self.scenario, self.settings)[1]) if not moved else self._built(moved)
        schedule = self.schedule
        if "temperature_c" in moved and "temperature_c" in schedule:  # an error of the thermometer
            schedule = {**schedule, "temperature_c": schedule["temperature_c"] + moved["temperature_c"] - self.nominal("temperature_c")}
        return _Moment(camera, *self._speed(camera, scenario), schedule, self.speed_columns)

    @property
    def speed_columns(self) -> bool:
        """Whether the table tells the speed of its targets."""
        return any(name in self.table.columns for name in SPEED_COLUMNS)

    def hidden_by(self, key: str) -> str:
        """Which columns tell what a setting would, in words; empty if none does."""
        if "temperature_c" in self.table.columns and key in ("temperature_c", "state.temperature_change_k", "state.warm_up_k"):
            return ": the column temperature_c tells the temperature"
        if self.speed_columns and key.startswith("motion."):
            return ": the columns vx_px_per_s and vy_px_per_s tell the speed"
        return ""

    def _speed(self, camera: Camera, scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
        """Of the targets and its rate, shape (n, 2) each; NaN where nothing tells it."""
        own = [self.table.numbers(name) for name in SPEED_COLUMNS]
        n = len(self.table)
        if self.speed_columns:
            v = np.stack([np.zeros(n) if one is None else one for one in own], axis=1)
            return v, np.zeros((n, 2))
        m = scenario.motion
        if m.speed_px_per_s is None and m.speed_mm_per_s is None:
            return np.full((n, 2), np.nan), np.zeros((n, 2))
        setting = Setting(camera, scenario)
        return np.tile(setting.velocity_px_per_s, (n, 1)), np.tile(setting.acceleration_px_per_s2, (n, 1))

    @cached_property
    def schedule(self) -> dict[str, Any]:
        """Frame, time and temperature of every position, as `Camera.true_positions` takes them."""
        table = self.table
        frame, time, temperature = (table.numbers(name) for name in ("frame", "time_s", "temperature_c"))
        whole: Any = 0
        if frame is not None:
            if (np.nan_to_num(frame) != np.rint(np.nan_to_num(frame))).any() or (np.nan_to_num(frame) < 0).any():
                raise InputError("'frame' is no number of a frame", where=table.source, allowed="0, 1, 2 …", remedy="rename the column")
            whole = np.nan_to_num(frame).astype(np.int64)
        elif "image" in table.columns:
            order = {name: k for k, name in enumerate(dict.fromkeys(table.columns["image"]))}
            whole = np.array([order[name] for name in table.columns["image"]], np.int64)
        found: dict[str, Any] = {"frame": whole}
        if time is not None:
            found["time_s"] = np.nan_to_num(time)
        if temperature is not None:
            found["temperature_c"] = np.nan_to_num(temperature)
        return found

    def said(self) -> list[str]:
        """What was taken for granted of the times."""
        notes = []
        if self.in_state:
            told = {name for name, (_, given) in changed(self.described, self.scenario, self.settings)[1].told.items() if given}
            assumed = [f"{key} {self.nominal(key):g}" for key in STATE[:3] if key not in told]
            if assumed:
                notes.append(f"not told, so assumed: {', '.join(assumed)}")
        if "time_s" not in self.schedule and np.max(self.schedule["frame"], initial=0) > 0:
            period = self.camera.facts.get("frame_period_s", 0.04)
            how = "by the column frame" if "frame" in self.table.columns else "in the order of the images"
            notes.append(f"frames are numbered {how}, {period:g} s apart; a column time_s tells other times")
        for element in self.described.active:
            for e in element.estimates:
                if e.kind == "upper_limit" and f"{element.name}.{e.name}" not in (*self.settings, *self.u):
                    taken = f"{e.representative:.4g} ± {e.value / 12**0.5:.2g}, as of all values up to it"
                    notes.append(f"{element.name}: {e.name} is only known to be at most {e.value:.4g}; taken is {taken}")
            if element.name in self.added:
                told = {key.rpartition(".")[2] for key in self.settings if key.rpartition(".")[0] == element.name}
                own = {n: v for n, v in element.params.model_dump().items() if n not in told and isinstance(v, float) and v}
                if own:
                    values = ", ".join(f"{n} {v:g}" for n, v in own.items())
                    notes.append(f"{element.name}: not told, so taken from camera, lens or catalogue: {values}")
        drifts = [e.name for e in self.camera.active if e.source.gum_class == "D" and hasattr(e.params, "on_for_s")]
        if drifts and not self.in_state and all(self.camera[name].params.on_for_s == 0 for name in drifts):
            notes.append(
                f"{', '.join(drifts)}: switched on when frame 0 was taken, as the description says; state.camera_on_min and "
                "state.grabber_on_min tell other times"
            )
        if self.camera.warm_up_k and "temperature_c" not in self.schedule:
            notes.append(
                f"the sensor warms up by {self.camera.warm_up_k:g} K from frame 0 on, as the description says; a column temperature_c or "
                "state.camera_on_min tell otherwise"
            )
        return notes


@dataclass(frozen=True)
class _Moment:
    """A camera, the speed of each target and its rate, and the times of the positions.

    The speed is in px of the frames if ``in_frame``, as positions of a table are; else it is in px of the sensor.
    """

    camera: Camera
    velocity: np.ndarray
    acceleration: np.ndarray
    schedule: Mapping[str, Any]
    in_frame: bool = False

    def with_camera(self, camera: Camera) -> _Moment:
        """The same with another camera."""
        return replace(self, camera=camera)

    def ideal(self, x: np.ndarray, y: np.ndarray, looks: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Points of the scene at which places of the frames look, with the motion taken off for the sources named ``looks``."""
        times = {name: value for name, value in self.schedule.items() if name != "temperature_c"}
        u, v = self.camera.sensor_places(x, y, **times)
        velocity = self.velocity
        if self.in_frame and looks:
            along = []
            for dx, dy in ((STEP_PX, 0.0), (0.0, STEP_PX)):
                ahead, behind = (np.stack(self.camera.sensor_places(x + k * dx, y + k * dy, **times)) for k in (1, -1))
                along.append((ahead - behind) / (2 * STEP_PX))
            velocity = (along[0] * velocity[:, 0] + along[1] * velocity[:, 1]).T
        shift = self.delayed(v, looks, velocity)
        return self.camera.scene_places(u - shift[:, 0], v - shift[:, 1], **self.schedule)

    def delayed(self, row: np.ndarray, looks: Sequence[str], velocity: np.ndarray) -> np.ndarray:
        """How far targets have moved on the sensor when their rows look, shape (n, 2)."""
        if not looks:
            return np.zeros((len(row), 2))
        delay, variance = np.zeros(len(row)), np.zeros(len(row))
        for name in looks:
            for total, of_rows in zip((delay, variance), row_delays(self.camera[name], self.camera), strict=True):
                total += np.interp(np.nan_to_num(row), *in_pairs_at(of_rows[0]))
        return velocity * delay[:, None] + 0.5 * self.acceleration * (delay**2 + variance)[:, None]


def in_pairs_at(of_rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and values of the rows of a frame for a target that covers several: means over neighbours, half a row below the first."""
    if len(of_rows) < 2:
        return np.zeros(1), of_rows[:1]
    return np.arange(len(of_rows) - 1) + 0.5, 0.5 * (of_rows[1:] + of_rows[:-1])


def _with_limits(camera: Camera) -> Camera:
    """The camera with the representative value of what is only known to be at most a limit."""
    chain = []
    for e in camera.chain:
        limits = [one.name for one in e.estimates if one.kind == "upper_limit"]
        chain.append(replace(e, params=with_estimates(e.source, e.params, e.estimates.select(limits))) if limits else e)
    return replace(camera, chain=tuple(chain))


def with_missing(camera: Camera, keys: Iterable[str], f_mm: float | None = None) -> Camera:
    """The camera with the sources that settings name and it does not hold; a source that is off is switched on.

    The exit pupil of a lens of known focal length is taken to be that far from the sensor.
    """
    known = camera.facts.get("principal_distance_mm") if f_mm is None else f_mm
    lens = Setting(camera, Scenario.model_validate({"object": {"f_mm": known}}))
    for key in keys:
        name = key.rpartition(".")[0]
        if name in camera:
            camera = replace(camera, chain=tuple(replace(e, on=e.on or e.name == name) for e in camera.chain))
        elif name in sources() and not any(e.source.id == name for e in camera.chain):
            camera = with_source(camera, name)
            by_lens = {"principal_distance_mm": lens.f_mm, "chief_ray_deg": lens.chief_ray_deg}
            own = {n: v for n, v in by_lens.items() if v is not None and n in sources()[name].parameters.model_fields}
            camera = camera.with_parameters(name, **own)
    return camera


def _known_names(camera: Camera, names: Iterable[str]) -> tuple[str, ...]:
    """Names of the chain; ids stand for all elements of their source."""
    found: list[str] = []
    for name in names:
        there = [e.name for e in camera.active if name in (e.name, e.source.id)]
        if not there:
            allowed = ", ".join(e.name for e in camera.active)
            raise InputError(f"{camera.name} has no source named {name!r} that is on", allowed=allowed, remedy="take one of its own")
        found += there
    return tuple(found)


# ---- the correction ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Selection:
    """Sources to take off, those of them whose times count, those that are left out of the camera; reasons; what is said beside."""

    applied: tuple[str, ...]
    looks: tuple[str, ...]
    unknown: tuple[str, ...]
    reasons: Mapping[str, str]
    half: Mapping[str, str]


def _corrected(case: _Case, only: tuple[str, ...], skip: tuple[str, ...]) -> CorrectedPositions:
    now, table = case.at({}), case.table
    asked = list(_asked_causes(case))
    chosen = _selected(now, only, skip, [one for _, _, *both in asked for one in both if one is not None])
    _refuse_twice(table, chosen.applied)
    notes = case.said()

    def mapped(moment: _Moment, without: tuple[str, ...] = ()) -> np.ndarray:
        return _mapped(moment, chosen, table.x_px, table.y_px, without)

    at = mapped(now)
    effects: list[tuple[str, np.ndarray]] = []
    idle: list[tuple[str, str]] = []  # what has no effect, and why if columns of the table tell it
    for key, name, plus, minus in (*asked, *_stated_causes(now, chosen, case.u)):
        sides = 2 - (plus is None) - (minus is None)  # at the end of its range a value can only go one way
        if sides:
            effects.append((name, ((at if plus is None else mapped(plus)) - (at if minus is None else mapped(minus))) / sides))
            if key and not (np.abs(effects[-1][1]) > NOTHING_PX).any():
                idle.append((f"the uncertainty of {key}", "" if key == "temperature_c" else case.hidden_by(key)))
        else:
            notes.append(f"{name}: the covariance lacks a stated uncertainty, with which the values leave their range")
    idle += [(key, case.hidden_by(key)) for key in case.settings if _is_idle(case, key, lambda moment: mapped(moment) - at)]
    if len(table):
        notes += [f"{what} has no effect on these positions{why}" for what, why in idle]
    shifts = {name: mapped(now, (name,)) - at for name in chosen.applied}
    all_effects = np.array([effect for _, effect in effects]).reshape(len(effects), len(table), 2)
    correction = _summed(all_effects)
    told = tuple(_told(e, chosen, shifts, effects) for e in now.camera.active if e.name in chosen.applied or e.name in chosen.reasons)
    rows, cols = now.camera.output_shape
    beyond = (np.abs(table.x_px - (cols - 1) / 2) > cols / 2) | (np.abs(table.y_px - (rows - 1) / 2) > rows / 2)
    if beyond.any():
        notes.append(f"{beyond.sum()} positions lie outside of the frame of {cols} × {rows} pixels, where the description need not hold")
    lost = int(np.sum(np.isnan(at[:, 0]) & np.isfinite(table.x_px)))
    if lost:
        notes.append(f"{lost} positions lie where the camera shows nothing: they are empty")
    covariance = _carried(table, correction, lambda x, y: _mapped(now, chosen, x, y))
    causes = tuple(name for name, _ in effects)
    return CorrectedPositions(at[:, 0], at[:, 1], table, covariance, correction, all_effects, causes, told, tuple(notes), now.camera.name)


def _refuse_twice(table: Positions, names: Sequence[str]) -> None:
    """Refuse a table from which a source was taken off before."""
    again = [name for name in names if name in table.corrected_before]
    if again:
        remedy = f"take the table as it was measured, or leave them: {' '.join(f'--skip {name}' for name in again)}"
        raise InputError("positions that were corrected for it before", where=table.source, value=", ".join(again), remedy=remedy)


def _summed(effects_px: np.ndarray) -> np.ndarray:
    """var x, cov xy and var y of each position by independent causes, shape (n, 3)."""
    dx, dy = effects_px[:, :, 0], effects_px[:, :, 1]
    return np.stack([(dx**2).sum(axis=0), (dx * dy).sum(axis=0), (dy**2).sum(axis=0)], axis=1)


def _fitted(
    found: CorrectedPositions, reference: Positions, model: str, frame_shape: tuple[int, int], match: str | None
) -> CorrectedPositions:
    """The same without what positions of an image have in common against a reference."""
    at = np.stack([found.x_px, found.y_px], axis=1)
    own = None if found.covariance_px2 is None else found.covariance_px2 - found.correction_px2
    fit = fit_per_image(at, own, found.effects_px, found.measured, reference, model, frame_shape, match)
    name = f"per image: {model}"
    by_fit = _summed(fit.own_effects_px)
    shared = np.concatenate([fit.effects_px, fit.reference_effects_px])
    by_fit = by_fit + _summed(fit.reference_effects_px)
    correction = _summed(fit.effects_px) + by_fit
    shift, u = (
        np.abs(np.nan_to_num(fit.shift_px)).max(axis=0, initial=0.0),
        np.sqrt(np.nan_to_num(by_fit[:, [0, 2]])).max(axis=0, initial=0.0),
    )
    text = f"by {fit.targets} reference positions in {fit.images} images"
    sizes = (float(shift[0]), float(shift[1])), (float(u[0]), float(u[1]))
    step = SourceCorrection(name, f"What {MODELS[model]} of each image tell", fit.images > 0, text, *sizes)
    return replace(
        found,
        x_px=found.x_px - fit.shift_px[:, 0],
        y_px=found.y_px - fit.shift_px[:, 1],
        covariance_px2=None if own is None else own + correction,
        correction_px2=correction,
        effects_px=shared,
        causes=(*found.causes, *[name] * len(fit.reference_effects_px)),
        image_effects_px=fit.own_effects_px,
        image_of=fit.image_of,
        sources=(*found.sources, step),
        notes=(*found.notes, *fit.notes),
    )


def _without_jitter(found: CorrectedPositions, rows: PerRow, camera: Camera) -> CorrectedPositions:
    """What is said of positions whose rows were put back before all else; their effects are brought to pixels of the sensor."""
    start, end = (float(camera.layout(at, 0.0)[0][0]) for at in (0.0, 1.0))
    laid_out = 1.0 if not any(s.applied for s in found.sources) else 1.0 / (end - start)
    own, shared = (np.stack([laid_out * e, np.zeros_like(e)], axis=-1) for e in (rows.own_effects_px, rows.shared_effects_px))
    added = _summed(own) + _summed(shared)
    name = "per row"
    shift, u = float(np.abs(rows.shift_px).max(initial=0.0)), float(np.sqrt(added[:, 0].max(initial=0.0)))
    text = f"{rows.corrected} targets by a line in {rows.rows} rows"
    step = SourceCorrection(name, "Rows displaced along themselves", rows.corrected > 0, text, (shift, 0.0), (u, 0.0))
    return replace(
        found,
        covariance_px2=None if found.covariance_px2 is None else found.covariance_px2 + added,
        correction_px2=found.correction_px2 + added,
        effects_px=np.concatenate([found.effects_px, shared]),
        causes=(*found.causes, *[name] * len(shared)),
        image_effects_px=own,
        image_of=rows.image_of,
        sources=(*found.sources, step),
        notes=(*found.notes, *rows.notes),
    )


def _mapped(moment: _Moment, chosen: _Selection, x: np.ndarray, y: np.ndarray, without: tuple[str, ...] = ()) -> np.ndarray:
    """Corrected positions, shape (n, 2); all sources but those of ``without`` are taken off."""
    whole = moment.camera.switched(off=chosen.unknown)
    looks = tuple(name for name in chosen.looks if name not in without)
    ideal = moment.with_camera(whole).ideal(x, y, looks)
    rest = whole.switched(off=[name for name in chosen.applied if name not in without])
    return np.stack(rest.true_positions(*ideal, **moment.schedule), axis=1)


def _is_idle(case: _Case, key: str, change: Callable[[_Moment], np.ndarray]) -> bool:
    """Whether positions are where they were without a setting that is not the value which holds without it."""
    without = replace(case, settings={name: value for name, value in case.settings.items() if name != key})
    try:
        if without.nominal(key) == case.nominal(key):
            return False
    except InputError:  # no number stands there
        pass
    moment = _or_none(without.at, {})
    return moment is not None and not (np.abs(np.nan_to_num(change(moment), nan=1.0)) > NOTHING_PX).any()


def _selected(now: _Moment, only: tuple[str, ...], skip: tuple[str, ...], uncertain: Sequence[_Moment] = ()) -> _Selection:
    """Which sources are taken off, and why others are not; ``uncertain`` is what else may be, by the uncertainties that were given."""
    applied: list[str] = []
    looks: list[str] = []
    unknown: list[str] = []
    reasons: dict[str, str] = {}
    half: dict[str, str] = {}
    lens = any(e.source.id == LENS and e.known_from == MEASURED for e in now.camera.active)
    for element in now.camera.active:
        moves, drawn, times = _moves(element, now, uncertain)
        if not moves and not times:
            if element.name in only:
                reasons[element.name] = "moves no position here"
            continue
        named = element.name in only
        if element.name in skip or (only and not named):
            reasons[element.name] = "left out, as asked"
        elif drawn and not named:
            reasons[element.name] = "drawn at random: what it does in these frames is not known"
            unknown.append(element.name)
        elif lens and element.source.id in set(TAKEN_UP) - {LENS, AFFINITY} and element.known_from != MEASURED and not named:
            reasons[element.name] = "the lens was measured with it, and holds what it does; name it under `only` if the lens does not"
            unknown.append(element.name)
        elif element.known_from == TYPICAL and not named:
            reasons[element.name] = "its parameters are only typical of such a camera; name it under `only` to take it off all the same"
            unknown.append(element.name)
        elif times and drawn:
            reasons[element.name] = "drawn anew in every frame, which does not tell its delay"
        elif times and not moves and not np.isfinite(now.velocity).all():
            reasons[element.name] = f"needs {SPEED}"
        else:
            applied.append(element.name)
            if times and np.isfinite(now.velocity).all():
                looks.append(element.name)
            elif times:
                half[element.name] = f"; what it does to targets that move needs {SPEED}"
    return _Selection(tuple(applied), tuple(looks), tuple(unknown), reasons, half)


def _moves(element: Element, now: _Moment, uncertain: Sequence[_Moment]) -> tuple[bool, bool, bool]:
    """Whether a source moves places of the frame, or may; whether it draws how; whether it looks at other times."""
    alone = now.camera.switched(on=[element.name])
    x, y, schedule = _lattice(now)
    bare = np.stack(now.camera.switched(on=[]).true_positions(x, y, **schedule))

    def differ(one: np.ndarray, other: np.ndarray) -> bool:
        return bool((np.abs(np.nan_to_num(one - other, nan=1.0)) > NOTHING_PX).any())

    seen = np.stack(alone.true_positions(x, y, **schedule))
    others = [
        replace(alone, unit_seed=alone.unit_seed + 1).true_positions(x, y, **schedule),
        alone.true_positions(x, y, seed=1, **schedule),
    ]
    drawn = any(differ(np.stack(other), seen) for other in others)
    known_u = zip(element.estimates.names, np.sqrt(np.diag(covariance_of(element.estimates))), strict=True)
    steps = [_or_none(_stepped, now, element.name, [name], np.array([u])) for name, u in known_u if u > 0]
    others_of = [one for one in steps if one is not None] + list(uncertain)

    def moves_in(one: _Moment) -> bool:
        x, y, schedule = _lattice(one)
        return differ(*(np.stack(one.camera.switched(on=on).true_positions(x, y, **schedule)) for on in ([element.name], [])))

    moves = differ(seen, bare) or any(moves_in(one) for one in others_of)
    times = False
    if element.source.id in LOOKS:
        for one in (now, *others_of):
            delay, variance = row_delays(one.camera[element.name], one.camera)
            accelerated = np.any(np.nan_to_num(one.acceleration)) and variance.any()
            times, drawn = times or bool((np.abs(in_pairs(delay)) > NO_TIME_S).any() or accelerated), drawn or len(delay) > 1
    return moves, drawn, times


def _lattice(now: _Moment) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Places all over the sensor at the times of the first position, of the last, and of one between."""
    rows, cols = now.camera.frame_shape
    side = (np.arange(5) + 0.5) / 5
    y, x = (np.tile(v.ravel(), 3) for v in np.meshgrid(side * (rows - 1), side * (cols - 1), indexing="ij"))
    pick = np.repeat([0.0, 0.5, 1.0], len(side) ** 2)
    schedule = {}
    for name, value in now.schedule.items():
        values = np.sort(np.atleast_1d(value))
        schedule[name] = values[np.rint(pick * (len(values) - 1)).astype(int)] if len(values) else np.zeros(len(pick), np.int64)
    return x, y, schedule


def _asked_causes(case: _Case) -> Iterator[tuple[str, str, _Moment | None, _Moment | None]]:
    """Of each uncertainty that was given: its key, the name of its cause, and what is known with the value larger and smaller by it.

    None where the value would leave its range.

    Raises
    ------
    InputError
        If it leaves it on both sides.
    """
    for key, u in case.u.items():
        if u:
            value, name = case.nominal(key), key.rpartition(".")[0]
            plus, minus = (_or_none(case.at, {key: value + sign * u}) for sign in (1, -1))
            if plus is None and minus is None:
                try:
                    case.at({key: value + u})
                except InputError as problem:
                    what = f"an uncertainty with which {value:g} leaves its range on both sides ({problem})"
                    raise InputError(what, where=key, value=u, remedy="give one that the value can have") from None
            yield key, name if name in case.camera else key, plus, minus


def _stated_causes(now: _Moment, chosen: _Selection, told: Iterable[str]) -> Iterator[tuple[str, str, _Moment | None, _Moment | None]]:
    """The same of the uncertainties that the description states, along the principal directions of each source's covariance; no key."""
    for name in chosen.applied:
        element = now.camera[name]
        known = [n for n in element.estimates.names if f"{name}.{n}" not in told]
        if not known:
            continue
        estimates = element.estimates.select(known)
        covariance = covariance_of(estimates)
        u = np.sqrt(np.diag(covariance))
        scale = np.where(u > 0, u, 1.0)
        power, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
        for p, direction in zip(power, directions.T, strict=True):
            step = np.sqrt(max(p, 0.0)) * direction * u
            if np.any(step):
                yield "", name, _or_none(_stepped, now, name, known, step), _or_none(_stepped, now, name, known, -step)


def _or_none(made: Callable[..., _Moment], *arguments: Any) -> _Moment | None:
    """What is made of the arguments; None where a value leaves its range."""
    try:
        return made(*arguments)
    except InputError:
        return None


def _stepped(now: _Moment, name: str, names: Sequence[str], step: np.ndarray) -> _Moment:
    """What is known with some parameters of a source changed together."""
    element = now.camera[name]
    own = element.params.model_dump()
    params = element.source.make({**own, **{n: own[n] + float(s) for n, s in zip(names, step, strict=True)}}, where=name)
    chain = tuple(replace(e, params=params) if e.name == name else e for e in now.camera.chain)
    return now.with_camera(replace(now.camera, chain=chain))


def _carried(table: Positions, correction: np.ndarray, mapped: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray | None:
    """Covariance of each corrected position: that of the measured one through the map, and that of the correction."""
    if table.covariance_px2 is None:
        return None
    x, y = table.x_px, table.y_px
    along_x = (mapped(x + STEP_PX, y) - mapped(x - STEP_PX, y)) / (2 * STEP_PX)
    along_y = (mapped(x, y + STEP_PX) - mapped(x, y - STEP_PX)) / (2 * STEP_PX)
    j = np.stack([along_x, along_y], axis=2)  # (n, out, in)
    var_x, cov, var_y = table.covariance_px2.T
    c = np.stack([np.stack([var_x, cov], 1), np.stack([cov, var_y], 1)], axis=1)
    out = j @ c @ np.swapaxes(j, 1, 2)
    return np.asarray(np.stack([out[:, 0, 0], out[:, 0, 1], out[:, 1, 1]], axis=1) + correction)


def _told(
    element: Element, chosen: _Selection, shifts: Mapping[str, np.ndarray], effects: Sequence[tuple[str, np.ndarray]]
) -> SourceCorrection:
    """What was done about a source, in numbers and words."""
    if element.name in chosen.reasons:
        return SourceCorrection(element.name, element.source.title, False, chosen.reasons[element.name])
    own = [effect for name, effect in effects if name == element.name]
    u = np.sqrt(np.nan_to_num(np.array(own) ** 2).sum(axis=0)) if own else np.zeros((1, 2))
    known = f"by {element.known_from or 'described'} parameters"
    text = known if own else f"{known}, whose uncertainty is not stated: that of the correction lacks it"
    text += chosen.half.get(element.name, "")
    shift, largest = np.abs(np.nan_to_num(shifts[element.name])).max(axis=0, initial=0.0), u.max(axis=0, initial=0.0)
    return SourceCorrection(
        element.name, element.source.title, True, text, (float(shift[0]), float(shift[1])), (float(largest[0]), float(largest[1]))
    )
