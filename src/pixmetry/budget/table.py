"""The table of error sources: a row for each, for one camera in one scenario, before and after a calibration.

Each row is computed by the fastest way that is exact enough: the displacement of points over the frame for what moves whole parts of the
image; times and speed for what looks at another time; a closed form (`Source.propagate`) in the camera's own chain and clock; else a Monte
Carlo of that chain with the source and without it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from pixmetry.budget.fields import Calibration, Places, field_of, spread_of
from pixmetry.budget.monte_carlo import Trials, hangs_on_picture, missed
from pixmetry.budget.motion import LAGS, OF_MOTION, PULSES, STILL, held_by_pulses, lag_contribution, motion_contribution, pulse_contribution
from pixmetry.budget.parameters import UNSTATED, applies, assumed_estimates, u_from_parameters, with_estimates
from pixmetry.budget.probe import Probes, put
from pixmetry.budget.setting import Setting
from pixmetry.camera.camera import Camera, Element, pitch_values
from pixmetry.camera.catalogue import get_source, sources
from pixmetry.camera.contribution import UNSTEADY, Contribution
from pixmetry.camera.frozen import has_steady_state
from pixmetry.camera.observations import TAKEN_UP
from pixmetry.camera.source import Source
from pixmetry.core.errors import InputError, PixmetryError
from pixmetry.core.number import Estimates
from pixmetry.locate.estimator import Estimator

MEASURED, SHEET, DESCRIBED, TYPICAL = "measured", "from the sheet", "described", "typical"
AT_BOUND, ABSENT, ELSEWHERE = "at its bound", "not in this camera", "in another row"
COUNTED = (MEASURED, SHEET, DESCRIBED, TYPICAL)  # what the answer rests on; what is at its bound only widens the interval
KNOWN_FROM = {"measured": MEASURED, "sheet": SHEET, "typical": TYPICAL, "": DESCRIBED}
FIELD, TIMES, FORMULA, SIMULATED = "displacement of points over the frame", "times and speed", "closed form", "simulated with and without"
WINDOWS, UNITS = 256, 4  # of a source that has to be simulated
STARS_PX = (0.005, 0.03, 0.1, 0.3, 1.0)  # from so much on, one star more
SETTINGS = (  # what a user switches on, or a grabber with a clock of its own has; a camera that is described without it has it not
    "electronics.agc",
    "electronics.gamma",
    "grabber.clock_warm_up",
    "grabber.low_pass",
    "grabber.sampling_clock",
    "grabber.window_offset",
    "optics.flicker",
    "optics.olpf",
    "sensor.read_out",
    "sensor.rolling_shutter",
    "storage.jpeg",
)
VIEW_POINT = "scene.view_point"
SHOT_NOISE = "sensor.shot_noise"
HALF_CAPACITY = 0.5  # of the usual saturation capacity: the least of a sound camera that does not tell its own (assumed)
AVERAGED = ("scene.speckle", VIEW_POINT)  # of the object's errors those that another target has otherwise
STATED_HALF_DIAGONAL_MM = 4.0  # the half-inch format, for which the catalogue gives usual values
OF_THE_FORMAT = {  # powers of the format: a lens of the same design; a sensor as flat for its size
    "k1_per_mm2": -2,
    "k2_per_mm4": -4,
    "k3_per_mm6": -6,
    "k4_per_mm8": -8,
    "k5_per_mm10": -10,
    "p1_per_mm": -1,
    "p2_per_mm": -1,
    "principal_distance_mm": 1,
    **dict.fromkeys(("bow_x_um", "bow_y_um", "twist_um", "skew_x_um", "skew_y_um"), 1),
}
COVERAGE = 2.0  # standard uncertainties of what was measured, at the upper end of the interval
FIELD_ERROR, FIELD_FLOOR_PX = 0.02, 1e-3  # of the displacement of points: a target is not a point, its light is stretched too
MAP, DRAWN_ANEW = "exact map of the camera", "displacement drawn anew in every frame"
DRAWN = 16  # frames of such a displacement
NOTHING_PX = 1e-9  # below it a shift is rounding
Pair = tuple[float, float]
NOTHING: Pair = (0.0, 0.0)


def stars_of(total_px: float) -> int:
    """How much an effect matters, in the handbook's stars: none below 1/200 px, five from 1 px on.

    Examples
    --------
    >>> [stars_of(px) for px in (0.001, 0.01, 0.05, 0.2, 0.5, 4.0)]
    [0, 1, 2, 3, 4, 5]
    """
    return sum(total_px >= limit for limit in STARS_PX)


@dataclass(frozen=True)
class Parts:
    """What a source does to a position, in px, by what averages it away; each in x and y, k = 1.

    Parameters
    ----------
    constant_px : (float, float)
        The same for all targets, places and frames, with its sign.
    smooth_px : (float, float)
        Changes slowly over the frame: standard deviation over it.
    place_px : (float, float)
        Changes from target to target: with the phase in the pixel, with the pixels that it falls on.
    time_px : (float, float)
        Changes from frame to frame.
    """

    constant_px: Pair = NOTHING
    smooth_px: Pair = NOTHING
    place_px: Pair = NOTHING
    time_px: Pair = NOTHING

    @classmethod
    def of(cls, values_px: Sequence[float]) -> Parts:
        """From all values one after the other: see `values_px`."""
        c, s, p, t = ((float(values_px[i]), float(values_px[i + 1])) for i in range(0, 8, 2))
        return cls(c, s, p, t)

    @property
    def values_px(self) -> tuple[float, ...]:
        """All values one after the other: constant in x and y, smooth, place, time."""
        return (*self.constant_px, *self.smooth_px, *self.place_px, *self.time_px)

    def or_more(self, other: Parts) -> Parts:
        """The larger of the two, part by part; a constant keeps its sign."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("constant_px", "smooth_px", "place_px", "time_px"))
        c, s, p, t = ((max(a[0], b[0], key=abs), max(a[1], b[1], key=abs)) for a, b in pairs)
        return Parts(c, s, p, t)

    def axes_px(self, frames: int = 1, targets: int = 1) -> Pair:
        """Everything together in x and y, as squares, for means over so many frames and targets."""
        x, y = (
            float(np.sqrt(c**2 + s**2 + p**2 / targets + t**2 / (frames * targets)))
            for c, s, p, t in zip(self.constant_px, self.smooth_px, self.place_px, self.time_px, strict=True)
        )
        return x, y

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of one target in one frame."""
        x, y = self.axes_px()
        total = float(np.sqrt(0.5 * (x**2 + y**2)))
        return total if total > NOTHING_PX else 0.0


@dataclass(frozen=True)
class SourceRow:
    """One error source in the table.

    Parameters
    ----------
    name, source_id, title : str
    number, stars : int
        Of the handbook's error table; 0 for a source that is not in it.
    status : str
        Whence its parameters are known; ``at its bound`` where only the largest to expect of a sound camera says something; ``not in this
        camera``.
    gum_class : str
    before, after : Parts, optional
        Without any calibration, and with that of the scenario.
    largest : Parts, optional
        What is left after the calibration at most, for a source that is not measured: at its bound.
    u_of_total_px : float
        Standard uncertainty of the total before the calibration that comes of the parameters' uncertainties.
    how, method, reason, advice : str
    model_error, floor_px : float
        How far the parts before the calibration may be off: relative, or so many px where that is more.
    kurtosis : float
        Of the shift, see `Contribution`.
    in_camera : bool
        Whether it stands in the camera's chain.
    fields_px : ndarray, shape (k, 2, m), optional
        What is left after the calibration at the image points of the scenario's network, where that is the same in every image.
    share : float
        Part of the square of the whole, after the calibration.
    """

    name: str
    source_id: str
    title: str
    number: int
    stars: int
    status: str
    gum_class: str
    before: Parts | None = None
    after: Parts | None = None
    largest: Parts | None = None
    u_of_total_px: float = 0.0
    how: str = ""
    method: str = ""
    reason: str = ""
    advice: str = ""
    model_error: float = 0.0
    floor_px: float = 0.0
    kurtosis: float = 3.0
    in_camera: bool = False
    share: float = 0.0
    fields_px: np.ndarray | None = field(default=None, repr=False, compare=False)

    @property
    def before_px(self) -> float:
        """Total without a calibration, one target in one frame."""
        return 0.0 if self.before is None else self.before.total_px

    @property
    def after_px(self) -> float:
        """Total with the calibration, one target in one frame."""
        return 0.0 if self.after is None else self.after.total_px

    @property
    def largest_px(self) -> float:
        """The same at most, where the source is not measured; else `after_px`."""
        return self.after_px if self.largest is None else self.largest.total_px

    @property
    def own_stars(self) -> int:
        """How much it matters here, before a calibration."""
        return stars_of(self.before_px)

    @property
    def counts(self) -> bool:
        """Whether the answer holds it."""
        return self.status in COUNTED and self.after_px > 0

    @property
    def taken_up(self) -> bool:
        """Whether the calibration leaves nothing of it to speak of."""
        return self.before_px > 0 and self.after_px <= 1e-3 * self.before_px


def independent_px(rows: Sequence[SourceRow], frames: int = 1, targets: int = 1) -> Pair:
    """Standard deviation in x and y of what is another at every image point, after the calibration."""
    variance = np.zeros(2)
    for row in rows:
        if row.status in COUNTED and row.after is not None:
            variance += np.square(row.after.place_px) / targets + np.square(row.after.time_px) / (frames * targets)
            variance += 0.0 if row.fields_px is not None else np.square(row.after.smooth_px)
    x, y = (float(v) for v in np.sqrt(variance))
    return x, y


@dataclass
class Table:
    """Makes the rows of a camera in a scenario.

    Parameters
    ----------
    setting : Setting
    estimator : Estimator
    seed : int
    say : callable, optional
        Called with the name of what is being done.
    """

    setting: Setting
    estimator: Estimator
    seed: int = 0
    say: Callable[[str], None] = lambda text: None

    def rows(self, only: Collection[str] | None = None) -> list[SourceRow]:
        """Rows of the chain, then of what the catalogue has beyond it: all, or ``only`` those of these ids."""
        return told_apart([self.row(*element) for element in self.elements(only)])

    def elements(self, only: Collection[str] | None = None) -> list[tuple[Element, bool]]:
        """What the rows are of, in their order, and whether it is in the camera."""
        camera = self.setting.camera
        found = [(e, True) for e in camera.active if only is None or e.source.id in only]
        there = {e.source.id for e in camera.active}
        off = {e.source.id: e for e in camera.chain if not e.on}  # measured and not significant, or switched off
        for source in sources().values():
            if source.id not in there and (only is None or source.id in only):
                usual = Element(source.id, source, self._own(source, self._usual(source)))
                found.append((usual if source.id in self.setting.brought_in else off.get(source.id, usual), False))
        return found

    # ---- one row --------------------------------------------------------------------------------------------------------------

    def row(self, element: Element, in_camera: bool) -> SourceRow:
        """The row of one source."""
        source = element.source
        self.say(element.name)
        row = SourceRow(
            element.name,
            source.id,
            source.title,
            source.number,
            source.stars,
            "",
            source.gum_class,
            advice=source.advice,
            in_camera=in_camera,
        )
        estimates = element.estimates if len(element.estimates) else None
        absent = "" if in_camera or estimates is not None else self._absent(source)
        if not element.on and estimates is None:
            absent = "switched off in the description of this camera"
        if absent:
            return replace(row, status=ABSENT, reason=absent)
        if estimates is not None:
            element = replace(element, params=with_estimates(source, element.params, estimates), on=True)
        told = in_camera or estimates is not None or source.id in self.setting.told_by_scenario
        known_from = element.known_from if told else "typical"
        row = replace(row, status=KNOWN_FROM[known_from], reason="" if estimates is None else estimates.method)
        if source.id in OF_MOTION and not self.setting.moves:
            return replace(row, before=Parts(), after=Parts(), how=TIMES, reason=STILL)
        if held_by_pulses(element, self.setting.camera):
            reason = f"pulses of light decide when the rows look: it counts in the row of {get_source(PULSES).title}"
            return replace(row, status=ELSEWHERE, before=Parts(), after=Parts(), how=TIMES, reason=reason)
        row = self._computed(row, element, in_camera)
        if source.part_of:
            return replace(row, status=ELSEWHERE, reason=f"it counts in the row of {get_source(source.part_of).title}")
        if row.before is None or row.after is None:
            return row
        if source.id == SHOT_NOISE:
            return self._with_capacity(row)
        if row.status != TYPICAL:
            if estimates is None and row.status in (SHEET, MEASURED):
                estimates = assumed_estimates(element)
                return self._with_uncertainty(replace(row, reason=UNSTATED), element, in_camera, estimates) if len(estimates) else row
            return row if estimates is None else self._with_uncertainty(row, element, in_camera, estimates)
        bound = self._own(source, source.bound_of(self.setting.camera.frame_shape))
        largest = self._computed(row, replace(element, params=bound), in_camera)
        if largest.after is None:
            return row
        status = AT_BOUND if row.before_px == 0 and largest.before_px > 0 else row.status
        return replace(row, status=status, largest=row.after.or_more(largest.after))

    def _with_capacity(self, row: SourceRow) -> SourceRow:
        """The row of shot noise with what is not known of the electrons of a full pixel, of whose root it is the inverse.

        They are those of the full well or, where the converter is full before, of its range over the gain.
        """
        on = {e.source.id: e for e in self.setting.camera.active}
        first = on.get("sensor.full_well") or on.get("electronics.gain")
        if first is None or row.after is None or not first.known_from:
            return row
        if first.known_from == "typical":
            words = "the saturation capacity is not stated, and taken as usual; at most as with half of it"
            return replace(row, status=TYPICAL, largest=Parts.of([v * HALF_CAPACITY**-0.5 for v in row.after.values_px]), reason=words)
        u_rel = max((_relative_u(first, name) for name in ("full_well_e", "gain_dn_per_e")), default=0.0)
        return replace(row, largest=Parts.of([v * (1 + 0.5 * COVERAGE * u_rel) for v in row.after.values_px])) if u_rel else row

    def _usual(self, source: Source) -> Any:
        """Usual parameters, of object and light those of the scenario."""
        s = self.setting
        if source.id in s.brought_in:
            return source.make({**source.typical.model_dump(), **s.brought_in[source.id]})
        if source.id == VIEW_POINT:
            return source.make({"gradient_rel_per_px": s.gradient_rel_per_px, "view_angle_deg": s.scenario.target.view_angle_deg})
        return source.typical

    def _own(self, source: Source, params: Any) -> Any:
        """Parameters of a source that the description does not hold, with what the camera and the scenario tell of them."""
        s = self.setting
        params = self._for_this_format(source, params)
        clock = {"line_time_us": 1e6 * s.camera.line_period_s, "pixel_time_ns": 1e9 / s.camera.pixel_clock_hz}
        known: dict[str, Any] = pitch_values(s.camera.pitch_um) | clock | {"bits": s.facts.bits, "reference_dn": s.facts.saturation_dn}
        known |= {"f_number": s.f_number, "wavelength_nm": s.scenario.light.wavelength_nm, "full_well_e": s.full_well_e}
        if s.f_mm is not None:
            known["principal_distance_mm"] = s.f_mm
            if s.camera.pitch_um is not None:
                known["principal_distance_px"] = 1e3 * s.f_mm / s.camera.pitch_um[0]
        if source.id == VIEW_POINT:
            known["diameter_px"] = s.target.diameter_px
        if s.chief_ray_deg is not None:
            known["chief_ray_deg"] = s.chief_ray_deg
        for name, value in known.items():
            if name in type(params).model_fields:
                try:
                    params = source.make({**params.model_dump(), name: value})
                except InputError:  # out of the source's own range: it keeps its usual value
                    continue
        return params

    def _for_this_format(self, source: Source, params: Any) -> Any:
        """Usual parameters of a lens and a sensor of this format: in the corner the same angle, as many percent of distortion."""
        pitch, (rows, cols) = self.setting.camera.pitch_um, self.setting.camera.frame_shape
        own = params.model_dump()
        if pitch is None or not OF_THE_FORMAT.keys() & own.keys():
            return params
        scale = 0.5e-3 * float(np.hypot(cols * pitch[0], rows * pitch[1])) / STATED_HALF_DIAGONAL_MM
        for name in OF_THE_FORMAT.keys() & own.keys():
            try:
                params = source.make({**params.model_dump(), name: own[name] * scale ** OF_THE_FORMAT[name]})
            except InputError:  # a format beyond the source's own range: it keeps its usual value
                continue
        return params

    def _absent(self, source: Source) -> str:
        """Why a camera of which nothing says that it has this source has it not; empty where it may."""
        facts = self.setting.camera.facts
        if not applies(source, facts):
            return f"only in a camera that is {' or '.join(source.applies_to)}"
        if source.id in self.setting.brought_in:
            return ""
        if self.setting.made is not None and self.setting.made.finding is None and source.id in TAKEN_UP:
            return "it is part of the lens that was calibrated"
        if source.option:
            return f"only in a camera with {source.option}"
        if source.id in SETTINGS:
            return "the camera is described without it"
        if source.stage == "storage" and facts.get("lossless"):
            return "only in frames that were stored with loss; these are not"
        measured = {e.source.id for e in self.setting.camera.chain if e.known_from == "measured"}
        if source.held_by and measured.issuperset(source.held_by):
            where = ", ".join(get_source(h).title for h in source.held_by)
            return f"what of it is in the frames was measured, and counts, as: {where}"
        return ""

    def _computed(self, row: SourceRow, element: Element, in_camera: bool) -> SourceRow:
        """The row with what the source does with these parameters."""
        source = element.source
        if source.id in OF_MOTION:
            return self._of_motion(row, element)
        moved = self._moved(element, in_camera) if source.gum_class in ("G", "D") else None
        if moved is not None:
            before, after, seen = moved
            row = replace(row, before=before, after=after, how=FIELD, method=DRAWN_ANEW if seen is None else MAP, fields_px=seen)
            row = replace(row, model_error=FIELD_ERROR, floor_px=FIELD_FLOOR_PX)
            return self._sampled_anew(row, element) if self._has_other_samples(element, in_camera) else row
        if source.propagate is None and (source.forward is None or source.essential and source.ideal is None):
            return replace(row, before=Parts(), after=Parts(), reason=source.reasons["propagate"])
        if source.propagate is None and not has_steady_state(source, element.params):
            return replace(row, reason=source.reasons["propagate"])
        try:
            if source.propagate is not None and not hangs_on_picture(source, self.setting.camera):
                how = FORMULA
                found: Contribution | None = source.propagate(element.params, self.probes.of(element.name, source))
            else:
                how, found = SIMULATED, self._simulated(element)
        except PixmetryError as problem:
            return replace(row, reason=f"not computed: {problem}")
        return self._with(replace(row, how=how), found, "no target is found behind it")

    def _has_other_samples(self, element: Element, in_camera: bool) -> bool:
        """Whether the samples of a row lie at other distances by this source."""
        steps = [np.diff(c.layout([0.0, 1.0], [0.0, 1.0]), axis=1) for c in self._with_and_without(self.setting.camera, element, in_camera)]
        return not np.allclose(steps[0], steps[1])

    def _sampled_anew(self, row: SourceRow, element: Element) -> SourceRow:
        """The row of a map with what other samples make of the target itself: an error that hangs on its place among them."""
        assert row.before is not None and row.after is not None
        try:
            found = self._simulated(element)
        except PixmetryError:
            return row
        if found is None:
            return row
        u = found.u_px
        x, y = (a + b for a, b in zip(row.before.constant_px, found.bias_px, strict=True))
        return replace(row, before=replace(row.before, constant_px=(x, y), place_px=u), after=replace(row.after, place_px=u))

    def _with_uncertainty(self, row: SourceRow, element: Element, in_camera: bool, estimates: Estimates) -> SourceRow:
        """The row with what the uncertainty of its measured parameters does to it."""

        values = _values_of(row)

        def values_of(params: Any) -> np.ndarray:
            moved = self._computed(row, replace(element, params=params), in_camera)
            return values if moved.after is None else _values_of(moved)  # so far away that no target is found: as here

        u = u_from_parameters(values_of, element.source, element.params, estimates)
        largest = np.sign(values) * (np.abs(values) + COVERAGE * u)
        return replace(row, u_of_total_px=float(u[0]), largest=Parts.of(np.where(values == 0, COVERAGE * u, largest)[1:].tolist()))

    def _with(self, row: SourceRow, found: Contribution | None, else_reason: str) -> SourceRow:
        if found is None or not np.isfinite(found.total_px):
            return replace(row, reason=else_reason)
        before = parts_of(found, row.source_id)
        told = {name: getattr(found, name) for name in ("method", "model_error", "floor_px", "kurtosis")}
        return replace(row, before=before, after=self._left(before, found.gum_class), **told)

    def _left(self, before: Parts, gum_class: str) -> Parts:
        """What the scenario's calibration leaves of a contribution that is no map of points."""
        model = self.setting.scenario.calibration.model
        if model == "none" or gum_class in UNSTEADY:
            return before
        return replace(before, constant_px=NOTHING, smooth_px=before.smooth_px if model == "principal_point_and_scale" else NOTHING)

    def _of_motion(self, row: SourceRow, element: Element) -> SourceRow:
        s = self.setting
        try:
            if element.source.id in LAGS:
                found = lag_contribution(element, s, self.estimator)
            elif element.source.id == PULSES:
                found = pulse_contribution(element, s, s.camera, self.estimator)
            else:
                found = motion_contribution(element, s, s.camera)
        except PixmetryError as problem:
            return replace(row, reason=f"not computed: {problem}")
        return self._with(replace(row, how=TIMES), found, "no target is found behind it")

    # ---- maps -----------------------------------------------------------------------------------------------------------------

    @cached_property
    def calibration(self) -> Calibration:
        """What positions are corrected for."""
        told = self.setting.scenario.calibration
        measuring, images = self.setting.network, self.setting.calibrating
        also = None if measuring is None else np.concatenate([n.places_px for n in (measuring, images) if n is not None], axis=1)
        places = Places.over(self.setting.camera.frame_shape, told.grid_px, also)
        made = self.setting.made
        return Calibration(told.model, told.every_image, places, self.setting.aspect, 3 if made is None else made.radial, images)

    def _difference(self, pair: tuple[Camera, Camera]) -> np.ndarray:
        """Displacement by what one camera has beyond another, shape (2, 5, n)."""
        known = all(np.array_equal(a, b) for a, b in zip(*(c.layout([0.0, 1.0], [0.0, 1.0]) for c in pair), strict=True))
        first, second = (self._field(c, known) for c in pair)
        return first - second

    def _field(self, camera: Camera, known_layout: bool) -> np.ndarray:
        key = (camera is self.setting.camera, camera is self.setting.calibrated, known_layout)
        if not any(key[:2]):
            return field_of(camera, self.calibration.places, known_layout)
        if key not in self._fields:
            self._fields[key] = field_of(camera, self.calibration.places, known_layout)
        return self._fields[key]

    @cached_property
    def _fields(self) -> dict[tuple[bool, bool, bool], np.ndarray]:
        return {}

    def _with_and_without(self, camera: Camera, element: Element, in_camera: bool) -> tuple[Camera, Camera]:
        """A camera in one of the two states with the source, as old as the camera is then, and without it."""
        if in_camera and element.params == self.setting.camera[element.name].params:
            return camera, missed(camera, [element.name])
        aged = self.setting.aged(element, camera)
        return put(camera, aged), missed(camera, [element.name]) if in_camera else camera

    def _moved(self, element: Element, in_camera: bool) -> tuple[Parts, Parts, np.ndarray | None] | None:
        """What a map of points is before and after the calibration, and left of it in the network's images; None where it moves none."""
        cameras = (self.setting.camera, self.setting.calibrated)
        try:
            pairs = [self._with_and_without(c, element, in_camera) for c in cameras]
            now, then = (self._difference(pair) for pair in pairs)
        except PixmetryError:
            return None
        if not max(np.nanmax(np.abs(now), initial=0.0), np.nanmax(np.abs(then), initial=0.0)) > 1e-9:
            return None
        anew = self._drawn_anew(element, pairs[0])
        if anew is not None:
            return anew
        if element.source.gum_class == "G":  # it stays as it was: what drifts beside it has a row of its own
            now = then
        left, n = self.calibration.left(now, then), self.calibration.places.even
        own = left.shape[1] - (0 if self.calibration.images is None else self.calibration.images.image[0].size)
        return _of_field(now[:, 0, :n]), _of_field(left[:, :n]), np.nan_to_num(left[None, :, n:own])

    def _drawn_anew(self, element: Element, pair: tuple[Camera, Camera]) -> tuple[Parts, Parts, None] | None:
        """The same of a displacement that is another one in every frame, by its formula; None where all frames have the same.

        A calibration in every image leaves the share of it that it leaves of some draws.
        """
        source, places = element.source, self.calibration.places
        if source.gum_class != "D" or source.propagate is None:
            return None
        if np.array_equal(field_of(pair[0], places), field_of(pair[0], places, seed=1), equal_nan=True):
            return None
        without = field_of(pair[1], places)
        draws = [field_of(pair[0], places, seed=seed) - without for seed in range(DRAWN)]
        left = [self.calibration.left(d, np.zeros_like(d)) for d in draws]
        share = np.sqrt(np.nanmean(np.square(left)) / np.nanmean(np.square([d[:, 0] for d in draws])))
        before = parts_of(source.propagate(element.params, self.probes.of(element.name, source)))
        return before, Parts.of((share * np.array(before.values_px)).tolist()), None

    # ---- simulation -----------------------------------------------------------------------------------------------------------

    @cached_property
    def probes(self) -> Probes:
        """The target as each source meets it."""
        return Probes(self.setting.camera, self.setting.facts, self.setting.target, self.estimator)

    @cached_property
    def _trials(self) -> Trials:
        s = self.setting
        return Trials(s.camera, s.target, self.estimator, s.facts, WINDOWS, UNITS, seed=self.seed)

    def _simulated(self, element: Element) -> Contribution | None:
        return self._trials.alone(element).contribution(element.source.gum_class)


def told_apart(rows: list[SourceRow]) -> list[SourceRow]:
    """The rows, with the name in the chain behind the title of a source that stands in it twice."""
    titles = [r.title for r in rows]
    return [replace(r, title=f"{r.title} ({r.name})") if titles.count(r.title) > 1 and r.name != r.source_id else r for r in rows]


def _relative_u(element: Element, name: str) -> float:
    """Relative standard uncertainty of a parameter: as stated, or as assumed of one that states none."""
    estimates = element.estimates if len(element.estimates) else assumed_estimates(element)
    if name not in estimates.names or estimates[name].is_limit or not estimates[name].value:
        return 0.0
    return float(estimates[name].u / abs(estimates[name].value))


def _values_of(row: SourceRow) -> np.ndarray:
    """Total before the calibration, and all that is left after it."""
    return np.array([row.before_px, *(row.after or Parts()).values_px])


def _of_field(field_px: np.ndarray) -> Parts:
    mean, spread = spread_of(field_px)
    return Parts(constant_px=(float(mean[0]), float(mean[1])), smooth_px=(float(spread[0]), float(spread[1])))


def parts_of(found: Contribution, source_id: str = "") -> Parts:
    """The parts of a contribution."""
    time, place = found.time_px, found.place_px
    if source_id in OF_MOTION:
        return Parts(found.bias_px, found.smooth_px, place, time)
    if source_id in AVERAGED:  # another for every target
        return Parts(found.bias_px, place_px=found.u_px)
    if found.gum_class in UNSTEADY:  # the next frames and targets share it
        u = found.u_px
        return Parts(found.bias_px, (float(u[0]), float(u[1])))
    return Parts(found.bias_px, found.smooth_px, place, time)


__all__ = ["Parts", "SourceRow", "Table", "independent_px", "stars_of", "told_apart"]
