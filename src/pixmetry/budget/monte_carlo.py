"""Monte Carlo: what sources of a camera do to a target's position, from many exposures of windows; one function for every source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import comb
from typing import Any

import numpy as np

from pixmetry.budget.probe import (
    Facts,
    Target,
    background_of,
    facts_of,
    ideal_element,
    passed_light,
    perfect,
    put,
    resolve,
    scene_of,
    spread_windows,
    window_side,
)
from pixmetry.camera.camera import Camera, Element
from pixmetry.camera.contribution import SMOOTH_ORDER, Contribution, smooth_part
from pixmetry.camera.conversions import LineSources, Link
from pixmetry.camera.frozen import Frozen
from pixmetry.camera.light import Scene
from pixmetry.camera.signal import Kind
from pixmetry.camera.source import Source
from pixmetry.core.errors import ChainError, InputError
from pixmetry.core.random import Grid, Streams
from pixmetry.locate.estimator import Estimator

Pair = tuple[np.ndarray, np.ndarray]  # x and y
UNIT_STRIDE = 1_000_003  # between the unit seeds of cameras of one type
MOSAIC = "sensor.bayer_mosaic"
FILLS = ("sensor.blooming", "sensor.full_well")  # do nothing until a pixel is full
SHARPENS = "processing.sharpening"  # the picture as it is: its undershoot, and what is left of a mosaic
SHAPES_PICTURE = (  # without noise of their own; a target that they have changed answers otherwise to whatever else acts on it
    "optics.olpf",
    "optics.point_spread",
    MOSAIC,
    "sensor.infrared_diffusion",
    "sensor.pixel_aperture",
    "sensor.read_out",
    "processing.demosaic",
    "processing.sharpening",
)


@dataclass(frozen=True)
class Axis:
    """Shift along one axis in px, with standard errors of the Monte Carlo.

    ``u`` is the standard deviation of all shifts of all units about their mean; its two independent parts are ``temporal``, from frame to
    frame of one target at one place, and ``fixed``, from place to place and unit to unit. ``left`` is what stays of bias and ``u`` once
    each unit has been calibrated: a polynomial of third order in the place taken off (lower where the places are few).
    """

    bias: float
    u: float
    temporal: float
    fixed: float
    se_bias: float
    se_u: float
    se_temporal: float
    se_fixed: float
    left: float = float("nan")
    se_left: float = float("nan")


@dataclass(frozen=True)
class MonteCarlo:
    """Result of a Monte Carlo over units, places (with phases) and frames."""

    x: Axis
    y: Axis
    names: tuple[str, ...]
    units: int
    places: int
    frames: int
    lost: int  # trials in which no target was found, left out together with their place
    mode: str
    frozen_tail: float  # largest share of a pixel's signal that the mode `frozen` takes from the noise-free frame

    def contribution(self, gum_class: str) -> Contribution | None:
        """The same as a contribution, with twice the standard error as its error; None where no target was found."""
        if not np.isfinite(self.total_px):
            return None
        smooth = tuple(float(np.sqrt(max(a.u**2 - a.left**2, 0.0))) for a in (self.x, self.y))
        return Contribution(
            self.x.u,
            self.y.u,
            gum_class,
            self.x.bias,
            self.y.bias,
            floor_px=2 * self.se_total_px,
            method="Monte Carlo: the camera's chain with the source and without, a target at rest",
            # of frames that differ by turns (fields), the scatter within a pair is twice that of all
            time_px=(min(self.x.temporal, self.x.u), min(self.y.temporal, self.y.u)),
            smooth_px=(smooth[0], smooth[1]),
        )

    @property
    def trials(self) -> int:
        """Number of exposed windows."""
        return self.units * self.places * self.frames

    @property
    def total_px(self) -> float:
        """Root mean square over x and y of random part and bias together."""
        return float(np.sqrt(0.5 * sum(a.u**2 + a.bias**2 for a in (self.x, self.y))))

    @property
    def calibrated_px(self) -> float:
        """Root mean square over x and y of the error that remains after a calibration, without the constant and the smooth part."""
        return float(np.sqrt(0.5 * (self.x.left**2 + self.y.left**2)))

    @property
    def se_calibrated_px(self) -> float:
        """Standard error of `calibrated_px`."""
        if self.calibrated_px == 0:
            return 0.0
        return float(np.sqrt(sum((a.left * a.se_left) ** 2 for a in (self.x, self.y))) / (2 * self.calibrated_px))

    @property
    def se_total_px(self) -> float:
        """Standard error of `total_px`."""
        if self.total_px == 0:
            return 0.0
        return float(np.sqrt(sum((a.u * a.se_u) ** 2 + (a.bias * a.se_bias) ** 2 for a in (self.x, self.y))) / (2 * self.total_px))


@dataclass(frozen=True, eq=False)
class Crop:
    """One target as a camera shows it.

    Parameters
    ----------
    data_dn : ndarray, shape (rows, cols)
        A window of a frame.
    x_px, y_px : float
        Where the target belongs in it, in px of the window.
    x_hat_px, y_hat_px : float
        Where the estimator puts it; NaN where it finds none.
    """

    data_dn: np.ndarray
    x_px: float
    y_px: float
    x_hat_px: float
    y_hat_px: float


@dataclass(frozen=True)
class _Variant:
    """What all units of a variant of a camera share: the light, what is far from windows, the estimator as it sees its frames."""

    facts: Facts
    frozen: Frozen
    estimator: Estimator


@dataclass
class Trials:
    """The design of a Monte Carlo: which target, at which places, in how many units and frames; the same for every set of sources.

    Positions that were found are kept, so that the chain that all are compared with is run once.

    Parameters
    ----------
    camera : Camera
    target : Target
    estimator : Estimator
    facts : Facts
    trials : int
        Windows to expose, at least; rounded up to whole units, places and frames.
    units : int
        Cameras of this type.
    frames : int
        Frames of each target at each place, at least 2 to tell temporal from fixed.
    mode : {"frozen", "exact"}
    seed : int
    scene : callable
        ``(target, facts, x_px, y_px) -> Scene``: what frame k shows of a target at place k.
    """

    camera: Camera
    target: Target
    estimator: Estimator
    facts: Facts
    trials: int = 2048
    units: int = 8
    frames: int = 2
    mode: str = "frozen"
    seed: int = 0
    scene: Callable[[Target, Facts, np.ndarray, np.ndarray], Scene] = scene_of
    _found: dict[Any, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if self.units < 1 or self.frames < 1 or self.trials < 1:
            raise InputError("a Monte Carlo needs trials", value=(self.trials, self.units, self.frames), allowed="1 or more of each")
        self.located = resolve(self.estimator, self.target, self.facts)
        self.side = window_side(self.located)
        shape = self.camera.output_shape
        if min(shape) < self.side:
            raise InputError("the frame is smaller than the window", value=shape, allowed=f"{self.side} × {self.side} px")
        self.places = max(2, -(-self.trials // (self.units * self.frames)))
        draws = Streams(self.seed, self.seed).of("budget.places").uniform_unit(4 * self.units * self.places).astype(float)
        row, col, self.dx, self.dy = draws.reshape(4, self.units, self.places)
        self.dx, self.dy = self.dx - 0.5, self.dy - 0.5
        self.col0, self.row0 = (
            start + np.floor(part * (end - start - self.side + 1)).astype(np.int64)
            for part, (start, end) in zip((col, row), shown_part(self.camera, self.side), strict=True)
        )

    def errors(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Positions found in the frames of a variant of the camera less the true ones: px of the sensor, (units, places, frames)."""
        key = tuple((e.name, e.params) for e in camera.active)
        if key not in self._found:
            variant = self._variant(camera)
            parts, frames = [], self.frames
            for k in range(self.units):
                found, steady = self._unit(replace(camera, unit_seed=camera.unit_seed + UNIT_STRIDE * k), k, variant, frames)
                parts.append(found)
                frames = 1 if steady else frames  # what is the same in all frames of a place is not exposed again in the next unit
            x, y = (np.stack([np.broadcast_to(found[axis], (self.places, self.frames)) for found in parts]) for axis in (0, 1))
            self._found[key] = x, y
        return self._found[key]

    def crop(self) -> Crop:
        """The first target of the first unit, as the camera shows it with all its sources."""
        windows, (col0, row0), (x, y), (x_hat, y_hat) = self._located(self.camera, 0, self._variant(self.camera), self.frames)
        at = (float(v[0]) for v in (x - col0, y - row0, x_hat, y_hat))
        return Crop(windows[0].astype(float), *at)

    def _variant(self, camera: Camera) -> _Variant:
        """What all units of a variant of the camera share.

        Who locates targets takes background, threshold and height from the frames, so they follow what the camera does to the light: black
        level, gain, a curve. Each is the mean of windows of that light, without what lies beyond four standard deviations.
        """
        facts = replace(self.facts, dn_per_photon=self.facts.dn_per_photon * passed_light(camera))
        frozen = camera.freeze(background_of(self.target, facts), **_conditions(facts))
        seen = self.located.as_seen(lambda light_dn: _level(camera, facts, self.target, self.side, light_dn, frozen))
        return _Variant(facts, frozen, seen)

    def _unit(self, camera: Camera, unit: int, variant: _Variant, frames: int) -> tuple[Pair, bool]:
        """Positions found less the true ones, px of the sensor, (places, frames) each; whether the frames of a place are the same."""
        windows, firsts, belongs, found = self._located(camera, unit, variant, frames)
        parts = zip(found, firsts, belongs, _layout(camera), strict=True)
        dx, dy = (((hat + first - at) / step).reshape(self.places, frames) for hat, first, at, (_, step) in parts)
        alike = windows.reshape(self.places, frames, -1)
        return (dx, dy), bool((alike == alike[:, :1]).all())

    def _located(self, camera: Camera, unit: int, variant: _Variant, frames: int) -> tuple[np.ndarray, Pair, Pair, Pair]:
        """Windows of one unit, the first column and row of each, where their targets belong in the frame and are found in the window."""
        n, middle = self.places * frames, self.side // 2
        shown = [np.repeat(first[unit] + middle + part[unit], frames) for first, part in ((self.col0, self.dx), (self.row0, self.dy))]
        x, y = ((at - start) / step for at, (start, step) in zip(shown, _layout(self.camera), strict=True))
        belongs = camera.layout(x, y, np.arange(n))
        last = [size - self.side for size in camera.output_shape[::-1]]
        moved = self._moved(camera, x, y)
        col0, row0 = (
            np.clip(np.rint(at + by).astype(np.int64) - middle, 0, most) for at, by, most in zip(belongs, moved, last, strict=True)
        )
        windows = camera.expose_windows(
            self.scene(self.target, variant.facts, x, y),
            Grid(np.arange(n), row0, col0, (self.side, self.side)),
            seed=self.seed + UNIT_STRIDE * unit,
            mode=self.mode,
            background=variant.frozen,
            **_conditions(variant.facts),
        )
        if windows.dtype.kind == "f":  # without a converter in the chain the scale has an end all the same
            windows = np.minimum(windows, np.float32(self.facts.saturation_dn))
        return windows, (col0, row0), belongs, variant.estimator.locate(windows)

    def _moved(self, camera: Camera, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By how much targets are seen elsewhere than they belong (a lens, a drift, a cold clock): windows follow, errors do not."""
        seen = camera.true_positions(x, y, exposure_s=self.facts.exposure_s, temperature_c=self.facts.temperature_c)
        belongs = camera.layout(x, y)
        dx, dy = (np.nan_to_num(np.broadcast_to(a, np.shape(b)) - b) for a, b in zip(seen, belongs, strict=True))
        return dx, dy

    def compare(self, names: Iterable[str], with_it: Camera, without: Camera | None) -> MonteCarlo:
        """Shift of the positions in one variant of the camera against those in another, or (None) against the truth."""
        shift = self.errors(with_it)
        if without is not None:
            shift = tuple(a - b for a, b in zip(shift, self.errors(without), strict=True))
        lost = int(np.isnan(shift[0]).sum())
        x, y = (_axis(s, self.row0, self.col0) for s in shift)
        tail = with_it.frozen_tail() if self.mode == "frozen" else 0.0
        return MonteCarlo(x, y, tuple(names), self.units, self.places, self.frames, lost, self.mode, tail)

    def of(self, only: Iterable[str] | None = None, off: Iterable[str] | None = None) -> MonteCarlo:
        """What some sources do: on an otherwise perfect chain (``only``), or as they are missed in the whole chain (``off``).

        A perfect chain keeps what shapes the picture and the camera's video line: see `helpers_of`.

        With neither, what the whole camera and the estimator do against the truth.
        """
        if only is not None and off is not None:
            raise InputError("either only or off", remedy="leave one of them out")
        if only is not None:
            return self._alone(self.camera, tuple(only))
        if off is not None:
            off = tuple(off)
            return self.compare(off, self.camera, missed(self.camera, off))
        return self.compare([e.name for e in self.camera.active], self.camera, None)

    def alone(self, element: Element) -> MonteCarlo:
        """Effect of one source with these parameters in this camera, whether it is in the chain or not; see `of` and `put`.

        Raises
        ------
        ChainError
            If the chain has no place for it.
        """
        camera = put(self.camera, element)
        same = camera.output_shape == self.camera.output_shape and _layout(camera) == _layout(self.camera)
        design = self if same else replace(self, camera=camera, _found={})  # targets lie where this camera shows them
        return design._alone(camera, (element.name,))

    def _alone(self, camera: Camera, only: tuple[str, ...]) -> MonteCarlo:
        """What some sources of a camera with this design's layout do."""
        helpers = helpers_of(camera, only)
        return self.compare(only, perfect(camera, (*only, *helpers)), perfect(camera, helpers))


def missed(camera: Camera, off: Iterable[str]) -> Camera:
    """The camera without some sources; an essential conversion stays, without its own errors, and a converter before what takes codes."""
    off = tuple(off)
    coded = any(e.source.consumes == (Kind.CODES,) for e in camera.active if e.name not in off)
    stays = {e.name for e in camera.active if e.source.essential or (coded and e.source.produces is Kind.CODES)}
    gone = camera.switched(off=[name for name in off if name not in stays])
    return replace(gone, chain=tuple(ideal_element(e) if e.name in off else e for e in gone.chain))


def helpers_of(camera: Camera, names: Iterable[str]) -> tuple[str, ...]:
    """What else must be on for some sources to do what they do in this camera.

    What shapes its video line: filters, echoes and the sampling clock, without which delays and noise would be seen by another line. What
    shapes the picture, `SHAPES_PICTURE`: the estimator answers otherwise on a target that is more blurred than it expects, or seen through
    a mosaic. And conversions, although not essential, without which the sources cannot be run: a source of stored codes needs a converter.
    """
    names = tuple(names)
    helpers = [e.name for e in camera.active if e.name not in names and (e.source.id in SHAPES_PICTURE or shapes_line(e, camera))]
    try:
        camera.switched(on=(*names, *helpers))
    except ChainError:
        helpers += [e.name for e in camera.chain if e.source.produces is not None and not e.source.essential]
    return tuple(h for h in dict.fromkeys(helpers) if h not in names)


def hangs_on_picture(source: Source, camera: Camera) -> bool:
    """Whether a closed form, which sees a grey and sharp target, misses what a source does in this camera.

    Under a mosaic pixels of one colour are full first. What is sharpened is the target as lens, line and mosaic leave it.
    """
    shaping = [e for e in camera.active if e.name in helpers_of(camera, ()) and e.source.id != source.id]
    return source.id in FILLS and any(e.source.id == MOSAIC for e in shaping) or source.id == SHARPENS and bool(shaping)


def shapes_line(element: Element, camera: Camera) -> bool:
    """Whether a source filters, echoes or samples the video line; one that only delays it, or adds noise, does not."""
    if Kind.VIDEO not in element.source.consumes:
        return False
    link = Link(element.name, element.source, element.params, camera.frame_shape)
    line = LineSources((link,), camera.pixel_clock_hz).line
    return not replace(line, delays=(), warps=(), noise=()).plain


def monte_carlo(
    camera: Camera,
    target: Target,
    estimator: Estimator,
    *,
    only: Iterable[str] | None = None,
    off: Iterable[str] | None = None,
    trials: int = 2048,
    units: int = 8,
    frames: int = 2,
    mode: str = "frozen",
    seed: int = 0,
    facts: Facts | None = None,
) -> MonteCarlo:
    """Shift of a target by some sources of a camera, or by all of it.

    Targets fall evenly on the pixel and on the sensor; several units of the camera see each its own places, and each place is exposed
    more than once. With and without the sources the same random numbers are drawn, so that only what the sources do is seen.

    Parameters
    ----------
    camera : Camera
    target : Target
    estimator : Estimator
    only, off : iterable of str, optional
        Names in the chain: these alone against the bare conversions, or the camera against itself without these. With neither, the whole
        camera against the truth; the estimator's own error is then part of it.
    trials, units, frames : int
        Windows in all, cameras of this type, frames of each place.
    mode : {"frozen", "exact"}
        See `Camera.expose_windows`.
    seed : int
    facts : Facts, optional
        By default those that the camera tells.

    Returns
    -------
    MonteCarlo

    References
    ----------
    JCGM 101:2008 (propagation of distributions by a Monte Carlo method).
    """
    facts = facts_of(camera, target) if facts is None else facts
    return Trials(camera, target, estimator, facts, trials, units, frames, mode, seed).of(only, off)


def _conditions(facts: Facts) -> dict[str, Any]:
    return {"exposure_s": facts.exposure_s, "temperature_c": facts.temperature_c}


def _layout(camera: Camera) -> list[tuple[float, float]]:
    """Position of the sensor's pixel (0, 0) in the output frame 0, and output pixels for one sensor pixel; for x and y."""
    return [(float(start), float(end - start)) for start, end in camera.layout([0.0, 1.0], [0.0, 1.0])]


def shown_part(camera: Camera, side: int) -> list[tuple[int, int]]:
    """Columns and rows (the first, the one after the last) in which a frame shows the sensor: a row of samples may be longer than the line.

    All of the frame where windows of this side do not fit into that part.
    """
    ends = camera.layout([0.0, camera.frame_shape[1] - 1.0], [0.0, camera.frame_shape[0] - 1.0])
    parts = []
    for (first, last), size in zip(ends, camera.output_shape[::-1], strict=True):
        start, end = (int(np.clip(at, 0, size)) for at in (np.ceil(first - 0.5), np.floor(last + 0.5) + 1))
        parts.append((start, end) if end - start >= side else (0, size))
    return parts


def _level(camera: Camera, facts: Facts, target: Target, side: int, above_dn: float, frozen: Frozen, windows: int = 32) -> float:
    """Grey value of uniform light that lies ``above_dn`` (linear) above the target's background."""
    background = background_of(target, facts)
    light = replace(background, level_photons=background.level_photons + above_dn / facts.dn_per_photon)
    (left, right), (top, bottom) = shown_part(camera, side)
    grid = spread_windows((bottom - top, right - left), side, windows)
    grid = Grid(grid.frame, grid.row0 + top, grid.col0 + left, grid.shape)
    data = camera.expose_windows(
        light,
        grid,
        mode="frozen",
        background=frozen,
        **_conditions(facts),
    ).astype(float)
    middle = float(np.median(data))
    near = np.abs(data - middle) <= 4 * data.std()
    return float(data[near].mean())


def _axis(shift: np.ndarray, *where: np.ndarray) -> Axis:
    """Bias and random parts of shifts (units, places, frames), and their standard errors; ``where`` are coordinates (units, places).

    Nested analysis of variance, each place of each unit a group: temporal variance is the mean of the groups' sample variances; fixed
    variance that of the groups' means less temporal/frames. Standard errors are those of means over groups, which asks nothing of the
    distribution; that of the bias is from the scatter of the units' means where that is the larger.
    """
    units, places, frames = shift.shape
    keep = np.isfinite(shift).all(axis=2)
    if keep.sum() < 2:
        return Axis(*(float("nan"),) * 10)
    groups = shift[keep]
    n = len(groups)
    means = groups.mean(axis=1)
    bias = float(means.mean())
    temporal = groups.var(axis=1, ddof=1) if frames > 1 else np.zeros(n)
    between = (means - bias) ** 2 * n / (n - 1)
    fixed = between - temporal / frames
    se_bias = np.sqrt(between.mean() / n)
    of_units = [row[good].mean() for row, good in zip(shift.mean(axis=2), keep, strict=True) if good.any()]
    if len(of_units) > 1:
        se_bias = max(se_bias, np.std(of_units, ddof=1) / np.sqrt(len(of_units)))
    rest = _rest(shift.mean(axis=2), keep, where) - temporal / frames
    (u, se_u), (temporal_u, se_temporal), (fixed_u, se_fixed), (left, se_left) = (
        _root(v) for v in (fixed + temporal, temporal, fixed, rest + temporal)
    )
    return Axis(bias, u, temporal_u, fixed_u, float(se_bias), se_u, se_temporal, se_fixed, left, se_left)


def _rest(means: np.ndarray, keep: np.ndarray, where: Sequence[np.ndarray]) -> np.ndarray:
    """Squared residuals of the means of places about a smooth surface of each unit, unbiased for what is independent from place to place.

    A polynomial of k terms through n places leaves (n − k)/n of such a variance. Its order is as high as two places a term allow.
    """
    found = np.zeros(means.shape)
    for unit, good in enumerate(keep):
        n = int(good.sum())
        order = max(o for o in range(SMOOTH_ORDER + 1) if o == 0 or where and 2 * _terms(o, len(where)) <= n)
        at = [p[unit, good] for p in where] or [np.zeros(n)]
        if n:
            residual = means[unit, good] - smooth_part(means[unit, good], *at, order=order)
            found[unit, good] = residual**2 * n / max(n - _terms(order, len(at)), 1)
    rest: np.ndarray = found[keep]
    return rest


def _terms(order: int, axes: int) -> int:
    return comb(order + axes, axes)


def _root(variances: np.ndarray) -> tuple[float, float]:
    """Standard deviation from unbiased estimates of a variance, one a group, and its standard error; 0 where they are negative."""
    mean, error = float(variances.mean()), float(variances.std(ddof=1) / np.sqrt(len(variances)))
    u = np.sqrt(max(mean, 0.0))
    return float(u), float(error / (2 * u)) if u > np.sqrt(error) else float(np.sqrt(error))
