"""The target of a budget, the camera's numbers that it needs, and the noise-free probe through which each source acts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.catalogue import STAGES
from pixmetry.camera.contribution import Probe
from pixmetry.camera.conversions import SAMPLE, LineSources, Link
from pixmetry.camera.line import Held, Line
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.core.errors import ChainError, InputError
from pixmetry.core.random import Grid
from pixmetry.locate.estimator import Estimator, KnownTarget
from pixmetry.locate.noise import split_text
from pixmetry.scene.discs import Discs
from pixmetry.scene.uniform import Uniform

WINDOW_PX = 24  # side of the windows that are exposed; the estimator's own lies in their middle
PHASES = 8  # per axis
FEWER_PHASES = 5  # per axis, where the gradient is found by moving pixel after pixel
ESTIMATOR_ITSELF = "processing.threshold"
READ_OUT = "sensor.read_out"
AHEAD_OF_LINE = ("optics", "sensor", "electronics")  # stages whose sources work on pixels, where a camera has a video line


@dataclass(frozen=True)
class Target:
    """A disc on a background.

    Parameters
    ----------
    kind : {"disc"}
    diameter_px, blur_px : float
        Diameter of the sharp disc, standard deviation of the optical blur.
    peak_rel, background_rel : float
        Height of the disc above the background, and the background, as parts of the saturation above black.
    """

    kind: str = "disc"
    diameter_px: float = 7.0
    blur_px: float = 0.7
    peak_rel: float = 0.6
    background_rel: float = 0.02

    def __post_init__(self) -> None:
        if self.kind != "disc":
            raise InputError("no such target", value=self.kind, allowed="disc")
        if not (0.5 <= self.diameter_px <= 200 and 0.05 <= self.blur_px <= 20):
            raise InputError(
                "the target's size cannot be used",
                value=(self.diameter_px, self.blur_px),
                allowed="diameter 0.5 to 200 px, blur 0.05 to 20 px",
            )
        if not (self.peak_rel > 0 and self.background_rel >= 0 and self.peak_rel + self.background_rel <= 1):
            raise InputError(
                "the target does not fit between black and saturation",
                value={"peak": self.peak_rel, "background": self.background_rel},
                allowed="peak above 0, background from 0, together at most 1",
            )

    def describe(self) -> str:
        """Say it in words."""
        return (
            f"{self.kind} of {self.diameter_px:.3g} px, blur {self.blur_px:.3g} px, {100 * self.peak_rel:g} % of saturation "
            f"on a background of {100 * self.background_rel:g} %"
        )


def parse_target(text: str) -> Target:
    """Read a target from ``disc:key=value,…``, as in ``disc:diameter=7,blur=0.7,peak=0.6,background=0.02``.

    Raises
    ------
    InputError
        If name, key or value cannot be used.
    """
    keys = {"diameter": "diameter_px", "blur": "blur_px", "peak": "peak_rel", "background": "background_rel"}
    if text.partition(":")[0].strip() != "disc":
        raise InputError("no such target", value=text, allowed="disc, as in disc:diameter=7,blur=0.7,peak=0.6,background=0.02")
    kind, values = split_text(text, keys, "target")
    return Target(kind=kind, **values)


@dataclass(frozen=True)
class Facts:
    """The camera's numbers that a budget needs.

    Parameters
    ----------
    dn_per_photon, gain_dn_per_e : float
        Linear response to a photon and to an electron.
    saturation_dn : float
        Above black.
    noise_dn : float
        Standard deviation of a pixel on the target's background, temporal and fixed.
    bits : int
    exposure_s, temperature_c : float
    frame_shape : (int, int)
    pixel_clock_hz : float
    """

    dn_per_photon: float
    gain_dn_per_e: float
    saturation_dn: float
    noise_dn: float
    bits: int
    exposure_s: float
    temperature_c: float
    frame_shape: tuple[int, int]
    pixel_clock_hz: float = 14.1875e6


@dataclass(frozen=True)
class Raster:
    """The rows of a frame: all of the sensor's, or of single fields every other one, or sums of a row and the next.

    Parameters
    ----------
    step : int
        Rows of the sensor from row to row of the frame.
    summed : int
        Rows of the sensor that a row of the frame holds.
    """

    step: int = 1
    summed: int = 1

    def read(self, pixels_dn: np.ndarray) -> np.ndarray:
        """Rows of the frame of windows of pixels, shape (n, rows, cols) to (n, rows/step, cols)."""
        n, rows, cols = pixels_dn.shape
        seen: np.ndarray = pixels_dn[:, : rows // self.step * self.step].reshape(n, -1, self.step, cols)[:, :, : self.summed].sum(axis=2)
        return seen

    def spread(self, gradient: np.ndarray) -> np.ndarray:
        """Gradient with respect to the pixels, of one with respect to the rows of the frame."""
        n, rows, cols = gradient.shape
        pixels = np.zeros((n, rows, self.step, cols))
        pixels[:, :, : self.summed] = gradient[:, :, None]
        return pixels.reshape(n, rows * self.step, cols)

    def sensor_y(self, y: np.ndarray) -> np.ndarray:
        """Place on the sensor of places in the frame, rows; of the even field."""
        return np.asarray(self.step * np.asarray(y) + 0.5 * (self.summed - 1))

    def frame_y(self, y: np.ndarray) -> np.ndarray:
        """Place in the frame of places on the sensor, rows; the inverse of `sensor_y`."""
        return np.asarray((np.asarray(y) - 0.5 * (self.summed - 1)) / self.step)


ALL_ROWS = Raster()


def raster_of(camera: Camera) -> Raster:
    """The rows that a camera's frames show."""
    modes = (e.params for e in camera.active if e.source.id == READ_OUT)
    return next((Raster(2, 2 if p.lines == "summed" else 1) for p in modes if p.mode == "field"), ALL_ROWS)


def facts_of(camera: Camera, target: Target, known: Mapping[str, Any] | None = None) -> Facts:
    """Read these numbers from a camera's chain; values in ``known`` have priority.

    Notes
    -----
    The linear response is that of the essential conversions alone, of a row of the frame: where two rows of the sensor are summed, of both.
    Saturation is the smaller of full well and converter's range. The noise is the scatter over 128 windows of the background through the
    whole chain, without what lies beyond four standard deviations.

    Conversions that are not linear (a logarithmic pixel) are counted in DN that would be linear up to the light that saturates: the
    response is that of black to saturation, and the noise is brought there by the local slope at the target's background. So a target of
    so many per cent of saturation is one of as much light in any camera. What the curve does to the target is in the probes.

    Raises
    ------
    InputError
        If a name in ``known`` is not one of them, or the camera does not tell its saturation.
    """
    known = dict(known or {})
    unknown = set(known) - {f.name for f in fields(Facts)}
    if unknown:
        raise InputError("not a fact that the budget uses", value=sorted(unknown), allowed=", ".join(f.name for f in fields(Facts)))
    bits = known.get("bits") or _parameter(camera, "bits") or camera.facts.get("bits") or 8
    slope, given = _response(camera), known.get("gain_dn_per_e")
    gain_in_faint_light = float(given or slope / _electrons_per_photon(camera))
    saturation = known.get("saturation_dn") or camera.facts.get("saturation_dn") or _saturation(camera, gain_in_faint_light, int(bits))
    curve = curve_of(camera, float(saturation))
    response = known.get("dn_per_photon") or (slope if curve is None else saturation / curve.saturating)
    gain = given or (gain_in_faint_light if curve is None else response / _electrons_per_photon(camera))
    background = target.background_rel * saturation / response
    noise = known.get("noise_dn")
    if noise is None:
        noise = _noise(camera, background / passed_light(camera))
        if curve is not None:
            noise *= response / float(curve.slope(np.array(background)))
    return Facts(
        dn_per_photon=float(response),
        gain_dn_per_e=float(gain),
        saturation_dn=float(saturation),
        noise_dn=float(noise),
        bits=int(bits),
        exposure_s=float(known.get("exposure_s") or camera.exposure_s),
        temperature_c=float(known.get("temperature_c", camera.temperature_c)),
        frame_shape=tuple(known.get("frame_shape") or camera.frame_shape),
        pixel_clock_hz=float(known.get("pixel_clock_hz") or camera.pixel_clock_hz),
    )


@dataclass(frozen=True)
class Curve:
    """Response of the essential conversions, without errors of their own, where it is no straight line: DN above black for light.

    ``of`` and ``slope`` are functions of photons; ``saturating`` is the light that reaches saturation.
    """

    of: Callable[[np.ndarray], np.ndarray]
    slope: Callable[[np.ndarray], np.ndarray]
    saturating: float


NODES, DARKEST = 160, 1e-12  # of the table of a curve, and the least light in it, over that which saturates
STRAIGHT = 1e-3  # relative change of the response up to which it is a straight line


def perfect(camera: Camera, on: Iterable[str] = ()) -> Camera:
    """The camera with some sources on an otherwise perfect chain: essential conversions have no errors of their own."""
    on = tuple(on)
    alone = camera.switched(on=on)
    return replace(alone, chain=tuple(e if e.name in on else ideal_element(e) for e in alone.chain))


def put(camera: Camera, element: Element) -> Camera:
    """The camera with this element on: in place of the element of the same name, otherwise at a place that its stage allows.

    Raises
    ------
    ChainError
        If the chain has no place for it.
    """
    if element.name in camera:
        return replace(camera, chain=tuple(replace(element, on=True) if e.name == element.name else e for e in camera.chain))
    stages = [STAGES.index(e.source.stage) for e in camera.chain]
    mine = STAGES.index(element.source.stage)

    def apart(at: int) -> tuple[int, int]:
        """Number of elements that would be on its wrong side; of equal places, the last."""
        return sum(s > mine for s in stages[:at]) + sum(s < mine for s in stages[at:]), -at

    for at in sorted(range(len(camera.chain) + 1), key=apart):
        try:
            return replace(camera, chain=(*camera.chain[:at], element, *camera.chain[at:]))
        except ChainError as problem:
            refused = problem
    raise refused


def _conversions(camera: Camera) -> Camera:
    """What makes numbers of light, without errors of its own: the essential conversions, and the rows that are summed."""
    return perfect(camera, [e.name for e in camera.active if e.source.id == READ_OUT])


def ideal_element(element: Element) -> Element:
    """An essential conversion without its errors; any other element unchanged."""
    return element if element.source.ideal is None else replace(element, params=element.source.ideal(element.params))


def curve_of(camera: Camera, saturation_dn: float) -> Curve | None:
    """The response where it is no straight line; None where it is one."""
    bare = _conversions(camera)

    def above_black(photons: float) -> float:
        return float(bare.expose(Uniform(photons), window=(0, 0, 1, 1), quiet=True).data[0, 0, 0]) - black

    black = 0.0
    black = above_black(0.0)
    light = 1.0
    while above_black(light) < saturation_dn:
        light *= 2.0
        if light > 1e30:
            raise InputError("no level of light saturates the camera", where=camera.name, value=saturation_dn, remedy="check its chain")
    if abs(above_black(1e-3 * light) / above_black(light) / 1e-3 - 1) < STRAIGHT:
        return None
    from scipy.interpolate import PchipInterpolator

    least = DARKEST * light
    at = np.arcsinh(np.concatenate([[0.0], np.geomspace(least, 4 * light, NODES)]) / least)
    table = PchipInterpolator(at, [above_black(float(p)) for p in least * np.sinh(at)])
    rise = table.derivative()

    def of(photons: np.ndarray) -> np.ndarray:
        return np.asarray(table(np.arcsinh(np.maximum(photons, 0.0) / least)))

    def slope(photons: np.ndarray) -> np.ndarray:
        p = np.maximum(np.asarray(photons, float), 0.0)
        return np.asarray(rise(np.arcsinh(p / least)) / np.hypot(p, least))

    levels = np.geomspace(1e-3 * light, 2 * light, 4000)
    return Curve(of, slope, float(np.interp(saturation_dn, of(levels), levels)))


class _AtRest(Discs):
    """Discs, one a frame, that rest while they are seen: what looks at several times needs to look once."""

    moving = False


def scene_of(target: Target, facts: Facts, x_px: np.ndarray, y_px: np.ndarray) -> Discs:
    """One target a frame: frame k has its centre at ``(x_px[k], y_px[k])``."""
    scale = facts.saturation_dn / facts.dn_per_photon
    return _AtRest(
        x_px=np.asarray(x_px, float)[:, None],
        y_px=np.asarray(y_px, float)[:, None],
        diameter_px=target.diameter_px,
        blur_px=target.blur_px,
        peak_photons=target.peak_rel * scale,
        background=background_of(target, facts),
        per_frame=True,
    )


def background_of(target: Target, facts: Facts) -> Uniform:
    """The target's background alone."""
    return Uniform(target.background_rel * facts.saturation_dn / facts.dn_per_photon)


def window_side(estimator: Estimator) -> int:
    """Side of the windows that contain the pixels of the estimator and the neighbours that these need."""
    return max(WINDOW_PX, estimator.window + 11)


def resolve(estimator: Estimator, target: Target, facts: Facts) -> Estimator:
    """The estimator for this target, its background and the noise."""
    known = KnownTarget(
        diameter_px=target.diameter_px,
        blur_px=target.blur_px,
        amplitude_dn=target.peak_rel * facts.saturation_dn,
        gain_dn_per_e=facts.gain_dn_per_e,
        saturation_dn=facts.saturation_dn,
        bits=facts.bits,
    )
    resolved: Estimator = estimator.resolved(target.background_rel * facts.saturation_dn, facts.noise_dn, known)
    return resolved


def phases_for(estimator: Estimator) -> int:
    """Places of the target within the pixel, per axis."""
    return FEWER_PHASES if estimator.by_differences else PHASES


def _checked(facts: Facts, target: Target, estimator: Estimator) -> Estimator:
    """The estimator for this target, which it must be able to see."""
    needed = target.diameter_px + 4 * target.blur_px
    estimator = resolve(estimator, target, facts)
    if estimator.window < needed:
        raise InputError(
            "the target does not fit into the estimator's window",
            value=f"{target.describe()} in {estimator.window} px",
            allowed=f"a window of {int(np.ceil(needed)) // 2 * 2 + 1} px or more",
            remedy=f"give a larger window, as in --estimator {estimator.name}:window=25",
        )
    if estimator.threshold_dn is not None and estimator.threshold_dn >= target.peak_rel * facts.saturation_dn:
        raise InputError(
            "the target does not stand above the threshold",
            value=f"{target.peak_rel * facts.saturation_dn:.3g} DN against {estimator.threshold_dn:.3g} DN",
            remedy="take a brighter target or a lower threshold",
        )
    return estimator


def _lattice(phases: int) -> tuple[np.ndarray, np.ndarray]:
    """Places within the pixel, each of shape (phases²,)."""
    places = (np.arange(phases) + 0.5) / phases - 0.5
    dx, dy = (v.ravel() for v in np.meshgrid(places, places))
    return dx, dy


def seen_at(facts: Facts, target: Target, x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Linear DN of windows of this shape, with the target at (x, y) in window coordinates; (p, rows, cols)."""
    n = len(x)
    zero = np.zeros(n, np.int64)
    grid = Grid(np.arange(n), zero, zero, shape)
    photons = scene_of(target, facts, x, y).photons(grid, shape, np.full(n, facts.exposure_s), np.zeros(n))
    return photons.astype(float) * facts.dn_per_photon


def make_probe(facts: Facts, target: Target, estimator: Estimator, phases: int | None = None, raster: Raster = ALL_ROWS) -> Probe:
    """Render the target noise-free at a lattice of ``phases`` × ``phases`` places within the pixel and see it through the estimator.

    By default there are `phases_for` the estimator. The windows are those of a frame with the rows of ``raster``.

    Raises
    ------
    InputError
        If the target does not stand above the threshold.
    """
    estimator = _checked(facts, target, estimator)
    side = window_side(estimator)
    dx, dy = _lattice(phases or phases_for(estimator))
    x, y = side // 2 + dx, side // 2 + dy
    signal = raster.read(seen_at(facts, target, x, raster.sensor_y(y), (raster.step * side, side))) / raster.summed
    x_hat, y_hat = estimator.locate(signal)
    gx, gy = estimator.gradient(signal)
    return Probe(
        signal_dn=signal,
        background_dn=target.background_rel * facts.saturation_dn,
        x_px=x,
        y_px=y,
        x_hat_px=x_hat,
        y_hat_px=raster.sensor_y(y_hat),
        gx=gx,
        gy=gy * raster.step,
        gain_dn_per_e=facts.gain_dn_per_e,
        exposure_s=facts.exposure_s,
        temperature_c=facts.temperature_c,
        bits=facts.bits,
        frame_shape=(facts.frame_shape[0] // raster.step, facts.frame_shape[1]),
        locate=_on_sensor(estimator, raster),
        saturation_dn=facts.saturation_dn,
        pixel_clock_hz=facts.pixel_clock_hz,
    )


def _on_sensor(estimator: Estimator, raster: Raster) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """The estimator on windows of a frame, with places on the sensor."""

    def locate(signal_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x_hat, y_hat = estimator.locate(signal_dn)
        return x_hat, raster.sensor_y(y_hat)

    return estimator.locate if raster == ALL_ROWS else locate


MARGIN_S = 1.7e-6  # of the line ahead of a window: what was on it then has died away at the target
MARGIN_PX = 6  # behind a window


class Probes:
    """The probes of one camera: for every source, the target as it meets it, with the rest of the camera's line behind it.

    Parameters
    ----------
    camera : Camera
    facts : Facts
    target : Target
    estimator : Estimator
    phases : int, optional
        Along each axis of the pixel; by default `phases_for` the estimator.

    Raises
    ------
    InputError
        If the target does not fit into the estimator's window, or does not stand above the threshold.
    """

    def __init__(self, camera: Camera, facts: Facts, target: Target, estimator: Estimator, phases: int | None = None) -> None:
        self.camera, self.facts, self.target, self.phases = camera, facts, target, phases or phases_for(estimator)
        self.raster = raster_of(camera)
        self.bare = make_probe(facts, target, estimator, self.phases, self.raster)
        self.estimator = resolve(estimator, target, facts)
        self.side = window_side(self.estimator)
        self.curve = curve_of(camera, facts.saturation_dn)
        if self.curve is not None:
            self.bare = self._bent(self.bare)
        links = (e.params.links for e in camera.links if e.source is SAMPLE and not e.params.line.plain)
        self.links: tuple[Link, ...] = next(links, ())
        self._ahead = lru_cache(self._make_ahead)

    def of(self, name: str, source: Source) -> Probe:
        """The probe for a source of this name; for the estimator itself, the probe on the light of the pixels.

        That is of all rows, as the row of the read-out has what single fields change.
        """
        if source.forward is None and self.raster != ALL_ROWS:
            return make_probe(self.facts, self.target, self.estimator, self.phases)
        probe = self._of(name, source)
        light = source.ideal is None and not {Kind.DN, Kind.VIDEO, Kind.CODES} & set(source.consumes)
        if self.curve is not None and light:
            probe = self._ahead_of_curve(probe)
        return self._ahead_of_read_out(probe) if self._sees_all_rows(name, source) else probe

    def _sees_all_rows(self, name: str, source: Source) -> bool:
        """Whether a source acts on the rows of the sensor, of which the frame shows others."""
        if self.raster == ALL_ROWS:
            return False
        try:
            ids = [e.source.id for e in put(self.camera, Element(name, source, source.typical)).active]
        except ChainError:
            return False
        return source.id in ids and ids.index(source.id) < ids.index(READ_OUT)

    def _ahead_of_read_out(self, probe: Probe) -> Probe:
        """The probe on all rows of the sensor, which the read-out makes rows of the frame: it belongs to the estimator then."""
        raster, locate = self.raster, probe.locate
        assert locate is not None
        n, rows, cols = probe.signal_dn.shape
        y = raster.sensor_y(probe.y_px)
        return replace(
            probe,
            signal_dn=seen_at(self.facts, self.target, probe.x_px, y, (raster.step * rows, cols)) / raster.summed,
            background_dn=probe.background_dn / raster.summed,
            y_px=y,
            gx=raster.spread(probe.gx),
            gy=raster.spread(probe.gy),
            frame_shape=self.facts.frame_shape,
            locate=lambda signal_dn, *phase: locate(raster.read(signal_dn), *phase),
        )

    def _of(self, name: str, source: Source) -> Probe:
        if not self.links or source.id == ESTIMATOR_ITSELF:
            return self.bare
        if Kind.VIDEO in source.consumes:
            return self._ahead(name if any(e.name == name for e in self.links) else "")
        whole = self._ahead("")
        if source.stage in AHEAD_OF_LINE:
            return whole
        shape = next((e.shape for e in self.camera.links if e.name == name), self.camera.output_shape)
        sets_black = source.stage == "grabber" and "offset_dn" in source.parameters.model_fields
        pedestal = self._pedestal_without(name) if sets_black else np.inf
        return replace(self._behind(whole), frame_shape=shape, pedestal_dn=pedestal)

    def _pedestal_without(self, name: str) -> float:
        """By how much black lies above code 0 without one source: mean of dark windows ahead of the converter, and its offset."""
        active = self.camera.active
        last = next((i for i, e in enumerate(active) if e.source.produces is Kind.CODES), len(active))
        ahead = replace(self.camera, chain=tuple(e for e in active[:last] if e.name != name))
        offset = sum(getattr(e.params, "offset_dn", 0.0) for e in active[last : last + 1] if e.name != name)
        dark = Uniform(0.0)
        grid = spread_windows(ahead.output_shape, min(8, *ahead.output_shape), 8)
        return float(ahead.expose_windows(dark, grid, mode="frozen", background=dark, quiet=True).mean(dtype=float)) + offset

    def _make_ahead(self, without: str) -> Probe:
        """Windows of pixels on the line, without one of its sources."""
        facts, raster = self.facts, self.raster
        row = self.camera.frame_shape[0] // raster.step // 2 - self.side // 2
        line, ahead = self._line(without, row + self.side // 2)
        dx, dy = _lattice(self.phases)
        n = len(dx)
        middle = (self.camera.frame_shape[1] - 1) // 2
        if line.sample_clock_hz != line.pixel_clock_hz:  # every phase to the pixels at another one to the samples
            dx = dx + np.rint(np.arange(n) * 0.7548776662 % 1 * self.side)
        x, y = middle + dx, row + self.side // 2 + dy
        first_sample = np.rint(line.placed(x)).astype(np.int64) - self.side // 2
        margin = int(np.ceil(MARGIN_S * line.pixel_clock_hz))
        first = np.floor(line.pixels(first_sample.astype(float))).astype(np.int64) - margin
        last = np.ceil(line.pixels(first_sample + self.side - 1.0)).astype(np.int64) + MARGIN_PX
        width, rows = int((last - first).max()) + 1, np.full(n, row)
        pixels = Grid(np.arange(n), rows, first, (self.side, width))
        samples = Grid(np.arange(n), rows, first_sample, (self.side, self.side))
        step = line.sample_clock_hz / line.pixel_clock_hz
        nothing = np.zeros((n, self.side, self.side))

        def located(samples_dn: np.ndarray, level: float, which: Any = slice(None)) -> tuple[np.ndarray, np.ndarray]:
            x_hat, y_hat = self._at_level(level).locate(samples_dn)
            return line.pixels(x_hat + first_sample[which]) - first[which], raster.sensor_y(y_hat)

        held = Held(line, pixels, samples, nothing, nothing, located, ahead, self._rowsseen_at())
        background = self.bare.background_dn
        pixels_dn = seen_at(facts, self.target, x - first, raster.sensor_y(y - row), (raster.step * self.side, width)) / raster.summed
        signal = self._curved(raster.read(pixels_dn))
        seen = held.read(line, signal, background)
        gx, gy = self._at_level(line.level).gradient(seen)
        held = replace(held, gx=gx / step, gy=gy * raster.step)
        impulses = np.broadcast_to(np.eye(width, dtype=np.float32), (n, width, width))
        answer = line.limited().read(impulses, first, Grid(np.arange(n), rows, first_sample, (width, self.side))).astype(float)

        def locate(signal_dn: np.ndarray, phase: int | None = None) -> tuple[np.ndarray, np.ndarray]:
            which = slice(None) if phase is None else np.full(len(signal_dn), phase)
            samples_dn = (signal_dn - background) @ (answer if phase is None else answer[phase]) + background * line.level
            return located(samples_dn, line.level, which)

        x_hat, y_hat = located(seen, line.level)
        return replace(
            self.bare,
            signal_dn=signal,
            x_px=x - first,
            y_px=y - row,
            x_hat_px=x_hat,
            y_hat_px=y_hat,
            gx=np.einsum("prs,pcs->prc", held.gx, answer),
            gy=np.einsum("prs,pcs->prc", held.gy, answer),
            locate=locate,
            held=held,
        )

    def _behind(self, ahead: Probe) -> Probe:
        """Windows of the line's samples."""
        held = ahead.held
        assert held is not None
        line = held.line
        seen = held.read(line, ahead.signal_dn, ahead.background_dn)
        estimator = self._at_level(line.level)
        step = line.sample_clock_hz / line.pixel_clock_hz
        x, y = estimator.locate(seen)
        on_sensor = _on_sensor(estimator, self.raster)

        def locate(signal_dn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            x_hat, y_hat = on_sensor(signal_dn)
            return x_hat / step, y_hat

        return replace(
            self.bare,
            signal_dn=seen,
            background_dn=ahead.background_dn * line.level,
            x_px=x,
            y_px=y,
            x_hat_px=x / step,
            y_hat_px=self.raster.sensor_y(y),
            gx=held.gx,
            gy=held.gy,
            locate=locate,
        )

    def _at_level(self, level: float) -> Estimator:
        """The estimator for light that is brighter by a factor: background, threshold and height follow."""
        ground = self.estimator.background_dn
        seen: Estimator = self.estimator.as_seen(lambda light_dn: (ground + light_dn) * level)
        return seen

    def _curved(self, linear_dn: np.ndarray) -> np.ndarray:
        return linear_dn if self.curve is None else self.curve.of(np.asarray(linear_dn) / self.facts.dn_per_photon)

    def _bent(self, linear: Probe) -> Probe:
        """The probe behind a curved response; the estimator's levels follow."""
        ground = self.estimator.background_dn
        self.estimator = self.estimator.as_seen(lambda light_dn: float(self._curved(np.array(ground + light_dn))))
        level = self.estimator.background_dn
        signal = self._curved(linear.signal_dn)
        x_hat, y_hat = self.estimator.locate(signal)
        gx, gy = self.estimator.gradient(signal)
        return replace(
            linear,
            signal_dn=signal,
            background_dn=level,
            x_hat_px=x_hat,
            y_hat_px=self.raster.sensor_y(y_hat),
            gx=gx,
            gy=gy * self.raster.step,
            locate=_on_sensor(self.estimator, self.raster),
        )

    def _ahead_of_curve(self, probe: Probe) -> Probe:
        """The probe in DN that are linear in the light, ahead of a curved response, which belongs to the estimator then."""
        assert self.curve is not None and probe.locate is not None
        scale, locate = self.facts.dn_per_photon, probe.locate
        light = np.interp(probe.signal_dn, *self._inverse)
        slope = self.curve.slope(light) / scale
        return replace(
            probe,
            signal_dn=light * scale,
            background_dn=float(np.interp(probe.background_dn, *self._inverse)) * scale,
            gx=probe.gx * slope,
            gy=probe.gy * slope,
            locate=lambda signal_dn, *phase: locate(self._curved(signal_dn), *phase),
        )

    @cached_property
    def _inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """DN of the curve and the light that gives them."""
        assert self.curve is not None
        light = np.concatenate([[0.0], self.curve.saturating * np.geomspace(1e-9, 4.0, 40_000)])
        return self.curve.of(light), light

    def _rowsseen_at(self) -> tuple[int, int]:
        """Rows of the line that are put out: those of which a row of the sensor lies in the frame of the output."""
        rows = self.camera.frame_shape[0]
        _, at = self.camera.layout(np.zeros(rows), np.arange(rows))
        seen = np.flatnonzero((at > -0.5) & (at < self.camera.output_shape[0] - 0.5)) // self.raster.step
        return (int(seen[0]), int(seen[-1]) + 1) if len(seen) else (0, rows // self.raster.step)

    def _line(self, without: str, row: int) -> tuple[Line, int]:
        """The line of all other sources, and how many of its filters stand ahead of the one left out.

        Nothing in it is random. A warp along the row only displaces targets, whom the window follows: it is left out; the delay of the rows
        is that of one row.
        """
        others = tuple(e for e in self.links if e.name != without)
        names = [e.name for e in self.links]
        clock, cols = self.camera.pixel_clock_hz, self.camera.frame_shape[1]
        line = LineSources(others, clock, cols).line
        grid = Grid(np.zeros(1, np.int64), np.full(1, row), np.zeros(1, np.int64), (1, 1))
        late = float(sum(delay(grid)[0, 0] for delay in line.delays))
        earlier = tuple(e for e in others if without not in names or names.index(e.name) < names.index(without))
        ahead = len(LineSources(earlier, clock, cols).line.filters)
        return replace(line, warps=(), noise=(), delays=()).delayed(np.full((1, 1), late)), ahead


def _parameter(camera: Camera, name: str) -> Any:
    return next((getattr(e.params, name) for e in camera.chain if hasattr(e.params, name)), None)


AHEAD_OF_CHARGE = {Kind.LIGHT, Kind.PHOTONS}


def passed_light(camera: Camera) -> float:
    """Share of the light that the sources ahead of the electrons let through, as a mean over the frame.

    A target of so many per cent of saturation is given as much more light: what a small aperture or a filter takes away, it lets be made up
    for, as everyone does who takes the pictures.
    """
    ahead = tuple(e for e in camera.active if set(e.source.consumes) <= AHEAD_OF_CHARGE and e.source.produces is None)
    if not ahead:
        return 1.0
    side = min(8, *camera.frame_shape)
    grid = spread_windows(camera.frame_shape, side, 256)
    level = 1000.0
    return float(replace(camera, chain=ahead).expose_windows(Uniform(level), grid, quiet=True).mean(dtype=float)) / level


def _electrons_per_photon(camera: Camera) -> float:
    """Signal per photon after the essential conversions in front of the one that makes DN."""
    bare = _conversions(camera)
    until = next((i for i, e in enumerate(bare.active) if e.source.produces is Kind.DN), len(bare.active))
    head = replace(bare, chain=bare.active[:until])
    return float(head.expose(Uniform(1000.0), window=(0, 0, 1, 1), quiet=True).data[0, 0, 0]) / 1000.0


def _response(camera: Camera) -> float:
    """DN per photon of the essential conversions, in faint light."""
    bare = _conversions(camera)
    level = 1000.0
    out = [float(bare.expose(Uniform(v), window=(0, 0, 1, 1), quiet=True).data[0, 0, 0]) for v in (0.0, level)]
    if not out[1] > out[0]:
        raise InputError("the camera does not respond to light", where=camera.name, remedy="check its chain")
    return (out[1] - out[0]) / level


def _saturation(camera: Camera, gain_dn_per_e: float, bits: int) -> float:
    well = _parameter(camera, "full_well_e")
    converters = [e for e in camera.chain if e.source.produces is Kind.CODES]
    limits = [] if well is None else [well * gain_dn_per_e * raster_of(camera).summed]
    if converters or "bits" in camera.facts:
        limits.append(2**bits - 1 - max(0.0, sum(getattr(e.params, "offset_dn", 0.0) for e in converters)))
    if not limits:
        raise InputError("the saturation of the camera is not known", where=camera.name, remedy="give saturation_dn among the facts")
    return float(min(limits))


def spread_windows(frame_shape: tuple[int, int], side: int, count: int) -> Grid:
    """Square windows of frames 0, 1, 2 … spread evenly over the frame (additive recurrence with irrational steps)."""
    step = np.arange(count)
    row0 = (step * 0.6180339887 % 1 * (frame_shape[0] - side + 1)).astype(np.int64)
    col0 = (step * 0.7548776662 % 1 * (frame_shape[1] - side + 1)).astype(np.int64)
    return Grid(step, row0, col0, (side, side))


def _noise(camera: Camera, background_photons: float, windows: int = 128) -> float:
    side = min(16, *camera.output_shape)
    scene = Uniform(background_photons)
    grid = spread_windows(camera.output_shape, side, windows)
    data = camera.expose_windows(scene, grid, mode="frozen", background=scene).astype(float)
    residual = (data - data.mean(axis=(1, 2), keepdims=True)).ravel()
    for _ in range(4):
        residual = residual[np.abs(residual) <= 4 * residual.std() + 1e-12]
    return float(residual.std())
