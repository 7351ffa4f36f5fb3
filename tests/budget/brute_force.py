"""What one source does to positions, by brute force: the whole chain exposed with it and without, every target located.

Nothing of the budget's own simulation is used. Targets are spread over the frame, one a frame; everything else in the chain is on. The
other sources are drawn twice for each draw of the source: the mean product of the two shifts is the square of what the source does, and
what flips by chance (a code, an electron) when the source is switched is not in it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pixmetry.budget.fields import Places
from pixmetry.budget.monte_carlo import missed
from pixmetry.budget.motion import FRAMES, GHOSTS, LAGS, OF_MOTION, PULSES
from pixmetry.budget.probe import passed_light, put, resolve
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import MAP, Parts, SourceRow, Table
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.catalogue import sources
from pixmetry.camera.frozen import Frozen
from pixmetry.camera.light import Points
from pixmetry.camera.signal import Windows
from pixmetry.core.random import Grid
from pixmetry.locate.estimator import Estimator
from pixmetry.scene.discs import Discs
from pixmetry.scene.picture import Picture
from pixmetry.scene.speckle import Speckle
from pixmetry.scene.uniform import Uniform

REPEATS = 2
ROUND = ("grabber.adc", "processing.companding", "storage.jpeg", "storage.video_codec")  # what flips is what they do
BY_OTHERS = ("sensor.dark_current",)  # whose noise another source draws: all scatter with it, less that without
SLACK_PX = 6  # of a window around what the estimator reads
FRAMES_BEFORE = 6  # that a source with a memory sees of a target
MOST_PIXELS = 4e4  # that a window may need of its frame; where it needs more, what is far comes from the frame without a target
ROUNDING_PX = 5e-5  # of positions found in frames of single precision
OF_UNITS = 1.5  # quantile of Student's t for the scatter of 16 units over that of the normal distribution, far out
STEP = 7919  # between seeds


@dataclass(frozen=True)
class Redrawn(Camera):
    """A camera of which all but one source can be drawn again."""

    own: str = ""
    again: int = 0

    @classmethod
    def of(cls, camera: Camera, own: str, again: int) -> Redrawn:
        return cls(**{f.name: getattr(camera, f.name) for f in fields(Camera)}, own=own, again=again)

    def streams(self, seed: int, quiet: bool = False) -> Any:
        kept = super().streams(seed, quiet)
        others = type(kept)(kept.unit_seed + STEP * self.again, kept.exposure_seed + STEP * self.again, kept.known)
        own = self.own

        class Mixed(type(kept)):  # type: ignore[misc]
            def of(self, name: str) -> Any:
                return (kept if name == own else others).of(name)

        return Mixed(kept.unit_seed, kept.exposure_seed, kept.known)


@dataclass(frozen=True)
class Shift:
    """Mean and standard deviation of the shifts along an axis, with the standard errors of the mean and of the variance."""

    bias: float
    variance: float
    se_bias: float
    se_variance: float

    @property
    def u(self) -> float:
        return float(np.sqrt(max(self.variance, 0.0)))

    def u_within(self, sigmas: float, se_said: float = 0.0) -> tuple[float, float]:
        """The interval of the standard deviation."""
        low, high = (np.sqrt(max(self.variance + s * sigmas * max(self.se_variance, se_said), 0.0)) for s in (-1, 1))
        return float(low), float(high)


@dataclass(frozen=True)
class Seen:
    """What a source was seen to do in x and y."""

    x: Shift
    y: Shift
    targets: int
    lost: int


@dataclass(frozen=True)
class Verdict:
    """A row beside brute force: in x and y, what is said, what is seen, and by how much they differ beyond what is declared."""

    row: SourceRow
    said_u: tuple[float, float]
    said_bias: tuple[float, float]
    seen: Seen
    wrong: tuple[str, ...]

    @property
    def text(self) -> str:
        parts = []
        for name, u, bias, axis in zip("xy", self.said_u, self.said_bias, (self.seen.x, self.seen.y), strict=True):
            low, high = axis.u_within(1.0)
            parts.append(f"{name}: u {u:.5f} [{low:.5f} {high:.5f}], bias {bias:+.5f} [{axis.bias:+.5f} ± {axis.se_bias:.5f}]")
        return "; ".join(parts)


NOTHING = (0.0, 0.0)
NOT_SEEN = Seen(Shift(0.0, 0.0, 0.0, 0.0), Shift(0.0, 0.0, 0.0, 0.0), 0, 0)


# ---- scenes ----------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Resting(Discs):
    """Discs, one a frame, that rest while they are seen: sources that look at several times need to look once only."""

    moving = False  # type: ignore[assignment]


@dataclass(frozen=True)
class Moved:
    """A scene that is displaced by v τ + a τ²/2; τ counts from so long after the beginning of one frame (or of each)."""

    still: Any
    velocity: np.ndarray
    acceleration: np.ndarray
    period_s: float
    middle_s: float
    of_frame: int | None = None
    moving = True

    @property
    def smooth_px(self) -> float:
        return float(self.still.smooth_px)

    def _at(self, at: Points) -> Points:
        frame = at.frame if self.of_frame is None else self.of_frame
        late = at.time_s - (frame * self.period_s + self.middle_s)
        dx, dy = (v * late + 0.5 * a * late**2 for v, a in zip(self.velocity, self.acceleration, strict=True))
        return replace(at, x_px=at.x_px - dx, y_px=np.broadcast_to(at.y_px, at.x_px.shape) - dy)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        n = len(grid.frame)
        rows = (grid.row0[:, None] + np.arange(grid.shape[0]))[:, :, None] + np.zeros((1, 1, grid.shape[1]))
        cols = (grid.col0[:, None] + np.arange(grid.shape[1]))[:, None, :] + np.zeros((1, grid.shape[0], 1))
        middle, length = (np.broadcast_to(v[:, None, None], rows.shape) for v in (time_s + 0.5 * exposure_s, exposure_s))
        frame = np.broadcast_to(grid.frame[:n, None, None], rows.shape)
        return self.averaged(Points(cols, rows, middle, length, frame, 0.0, frame_shape), 1.0, 1.0).astype(np.float32)

    def radiance(self, at: Points) -> np.ndarray:
        return np.asarray(self.still.radiance(self._at(at)))

    def averaged(self, at: Points, width_px: Any, height_px: Any) -> np.ndarray:
        return np.asarray(self.still.averaged(self._at(at), width_px, height_px))


@dataclass(frozen=True)
class Lit:
    """Discs, one a frame, each brighter on one side: shares of its own light per pixel along x and along y."""

    still: Discs
    slopes: np.ndarray
    moving = False

    @property
    def smooth_px(self) -> float:
        return self.still.smooth_px

    def _factor(self, x: Any, y: Any, frame: np.ndarray) -> np.ndarray:
        return np.asarray(
            1 + self.slopes[0][frame] * (x - self.still.x_px[frame, 0]) + self.slopes[1][frame] * (y - self.still.y_px[frame, 0])
        )

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        ground = self.still.background.photons(grid, frame_shape, exposure_s, time_s)
        light = self.still.photons(grid, frame_shape, exposure_s, time_s) - ground
        rows, cols = (first[:, None] + np.arange(size) for first, size in zip((grid.row0, grid.col0), grid.shape, strict=True))
        return (ground + light * self._factor(cols[:, None, :], rows[:, :, None], grid.frame[:, None, None])).astype(np.float32)

    def radiance(self, at: Points) -> np.ndarray:
        return self.averaged(at, 0.0, 0.0)

    def averaged(self, at: Points, width_px: Any, height_px: Any) -> np.ndarray:
        ground = self.still.background.radiance(at)
        light = self.still.averaged(at, width_px, height_px) - ground
        return np.asarray(ground + light * self._factor(at.x_px, at.y_px, at.frame))


@dataclass(frozen=True)
class ByFrame:
    """Another scene in every frame."""

    scenes: tuple[Any, ...]
    moving = False

    @property
    def smooth_px(self) -> float:
        return float(self.scenes[0].smooth_px)

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        def one(k: int) -> np.ndarray:
            part = slice(k, k + 1)
            alone = Grid(grid.frame[part], grid.row0[part], grid.col0[part], grid.shape)
            return np.asarray(self.scenes[int(grid.frame[k])].photons(alone, frame_shape, exposure_s[part], time_s[part]))

        return np.concatenate([one(k) for k in range(len(grid.frame))])

    def radiance(self, at: Points) -> np.ndarray:
        return self.averaged(at, 0.0, 0.0)

    def averaged(self, at: Points, width_px: Any, height_px: Any) -> np.ndarray:
        frame = np.broadcast_to(at.frame, at.x_px.shape)
        width, height = (np.broadcast_to(v, at.x_px.shape) for v in (width_px, height_px))
        out = np.empty(at.x_px.shape)
        for k in np.unique(frame):
            which = frame == k
            out[which] = self.scenes[int(k)].averaged(at.take(which), width[which], height[which])
        return out


# ---- the experiment --------------------------------------------------------------------------------------------------------------------


@dataclass
class BruteForce:
    """Targets all over the frames of a camera in its setting.

    Parameters
    ----------
    setting : Setting
    law : Estimator
    units, places : int
        Cameras of this type, and targets in each.
    seed : int
    """

    setting: Setting
    law: Estimator
    units: int = 8
    places: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        self.facts, self.target = self.setting.facts, self.setting.target
        self.estimator = resolve(self.law, self.target, self.facts)
        self.reads = self.estimator.window + 2
        self.side = self.reads + 2 * SLACK_PX
        self._found: dict[Any, np.ndarray] = {}
        self._backgrounds: dict[str, Frozen] = {}
        rng = np.random.default_rng(self.seed)
        n = self.units * self.places
        step = np.arange(n)
        even = np.stack([step * 0.7548776662466927, step * 0.5698402909980532])  # spread evenly, as the phase in the pixel is
        share = (even + rng.uniform(size=(2, 1))) % 1
        share = share[:, rng.permutation(n)].reshape(2, self.units, self.places)
        cam = self.setting.camera
        ends = cam.layout([0.0, cam.frame_shape[1] - 1.0], [0.0, cam.frame_shape[0] - 1.0])
        self.at = np.empty((2, self.units, self.places))  # px of the sensor
        for axis, (first, last) in enumerate(ends):
            size = cam.output_shape[1 - axis]
            step_px = (last - first) / (cam.frame_shape[1 - axis] - 1)
            low, high = max(first, 0.0) + self.reads / 2 + 1, min(last, size - 1.0) - self.reads / 2 - 1
            self.at[axis] = (low + share[axis] * (high - low) - first) / step_px

    def places_of_fields(self) -> Places:
        """The same places for a table."""
        x, y = (np.broadcast_to(v.ravel(), (5, v.size)) for v in self.at)
        return Places(x, y, np.full((4, x.shape[1]), 0.25), self.setting.camera.frame_shape, even=x.shape[1])

    # ---- positions --------------------------------------------------------------------------------------------------------------------

    def errors(self, camera: Camera, own: str, source: Element, on: bool, keep: int) -> np.ndarray:
        """Places found less where the targets are, px of the sensor; shape (2, units, places, repeats)."""
        # without the source its own draws are in nothing
        key = (
            tuple((e.name, e.params) for e in camera.active),
            own if on else "",
            keep,
            _scene_of(source),
            on and source.source.stage == "scene",
        )
        if key not in self._found:
            light = self.facts.saturation_dn / (self.facts.dn_per_photon * passed_light(camera))
            estimator = self.estimator.as_seen(lambda dn: self._level(camera, dn, light))
            background = self._background(camera, light)
            parts = [
                [self._unit(camera, own, source, on, keep, light, estimator, background, unit, again) for again in range(REPEATS)]
                for unit in range(self.units)
            ]
            self._found[key] = np.array(parts).transpose(2, 0, 3, 1)
        return self._found[key]

    def _level(self, camera: Camera, dn: float, light: float, windows: int = 24) -> float:
        """Grey value of uniform light so far above the background, linear DN: what anybody reads off his frames."""
        level = (self.target.background_rel + dn / self.facts.saturation_dn) * light
        rows, cols = camera.output_shape
        at = np.stack([np.arange(windows) * s % 1 for s in (0.618, 0.7548)])
        x = camera.layout([0.0, camera.frame_shape[1] - 1.0], [0.0, camera.frame_shape[0] - 1.0])
        first = [np.maximum(np.ceil(v[0]), 0) for v in x]
        last = [np.minimum(np.floor(v[1]), n - 1) - 8 for v, n in zip(x, (cols, rows), strict=True)]
        col0, row0 = ((f + s * (e - f)).astype(np.int64) for f, e, s in zip(first, last, at, strict=True))
        grid = Grid(np.arange(windows), row0, col0, (8, 8))
        ground = self._background(camera, light) or Uniform(self.target.background_rel * light)
        data = camera.expose_windows(Uniform(level), grid, mode="frozen", background=ground, quiet=True, **self._conditions).astype(float)
        near = np.abs(data - np.median(data)) <= 4 * data.std()
        return float(data[near].mean())

    @property
    def _conditions(self) -> dict[str, float]:
        return {"exposure_s": self.facts.exposure_s, "temperature_c": self.setting.camera.temperature_c}

    def _background(self, camera: Camera, light: float) -> Frozen | None:
        """What is far of windows that need much of their frames; None where they can be exposed as they are.

        It is the same with a source that does not look far itself.
        """
        middle = [np.array([size // 2 - self.side // 2]) for size in camera.output_shape]
        needs = camera._needs(camera.links, Windows.of(Grid(np.zeros(1, np.int64), *middle, (self.side, self.side))))
        if max(float(w.rows[0] * w.cols[0]) for w in needs) <= MOST_PIXELS or any(link.remembers for link in camera.links):
            return None
        key = str([(link.name, link.params, link.shape) for link in camera.links if link.far])
        if key not in self._backgrounds:
            self._backgrounds[key] = camera.freeze(Uniform(self.target.background_rel * light), **self._conditions)
        return self._backgrounds[key]

    def _unit(
        self,
        camera: Camera,
        own: str,
        source: Element,
        on: bool,
        keep: int,
        light: float,
        estimator: Estimator,
        background: Frozen | None,
        unit: int,
        again: int,
    ) -> np.ndarray:
        x, y = self.at[:, unit, :keep]
        n = len(x)
        camera = Redrawn.of(replace(camera, unit_seed=camera.unit_seed + 17 * unit), own, again)
        seed = self.seed + 101 * unit
        memory = source.source.id in LAGS or any(link.remembers for link in camera.links) or source.source.start is not None
        last = self._frames_before(source) if memory else 0
        frame = np.full(n, last) if memory else np.arange(n)
        if source.source.id in OF_MOTION and not memory:
            frame = frame + n * (7 * np.arange(n) % (FRAMES // n))  # over as long a time as the budget takes it
        belongs = np.stack(camera.layout(x, y, frame))
        seen = np.stack(camera.true_positions(x, y, **self._conditions)) - np.stack(camera.layout(x, y))
        col0, row0 = (
            np.clip(np.rint(b + np.nan_to_num(m)).astype(np.int64) - self.side // 2, 0, size - self.side)
            for b, m, size in zip(belongs, seen, camera.output_shape[::-1], strict=True)
        )
        if memory:
            data = np.concatenate(
                [
                    camera.expose(
                        self._scene(source, on, light, x[k : k + 1], y[k : k + 1], unit, last),
                        [last],
                        seed=seed + 7 * k,
                        window=(int(row0[k]), int(col0[k]), self.side, self.side),
                        **self._conditions,
                        **({"frame_period_s": self.setting.frame_period_s} if source.source.id in OF_MOTION else {}),
                    ).data
                    for k in range(n)
                ]
            )
        else:
            scene = self._scene(source, on, light, x, y, unit, 0)
            way: dict[str, Any] = {"mode": "exact"} if background is None else {"mode": "frozen", "background": background}
            data = camera.expose_windows(scene, Grid(frame, row0, col0, (self.side, self.side)), seed=seed, **way, **self._conditions)
        if data.dtype.kind == "f":
            data = np.minimum(data, np.float32(self.facts.saturation_dn))
        dx, dy = _near_the_target(data.astype(float), self.target.diameter_px, SLACK_PX)
        half = self.side // 2 - self.reads // 2
        cut = np.stack(
            [d[half + j : half + j + self.reads, half + i : half + i + self.reads] for d, i, j in zip(data, dx, dy, strict=True)]
        )
        found = estimator.locate(cut)
        step = [float(v[1] - v[0]) for v in camera.layout([0.0, 1.0], [0.0, 1.0])]
        firsts = (col0 + half + dx, row0 + half + dy)
        return np.stack([(hat + first - at) / s for hat, first, at, s in zip(found, firsts, belongs, step, strict=True)])

    @staticmethod
    def _frames_before(source: Element) -> int:
        """Frames that the last one remembers."""
        share = float(getattr(source.params, LAGS.get(source.source.id, ""), 0.0))
        return max(FRAMES_BEFORE, min(GHOSTS, int(np.ceil(np.log(0.005) / np.log(share))) if share else 0))

    def _scene(self, source: Element, on: bool, light: float, x: np.ndarray, y: np.ndarray, unit: int, last: int) -> Any:
        t = self.target
        ground = Uniform(t.background_rel * light)
        params: Any = source.params
        if source.source.id == "scene.speckle":
            kw = {
                "radius_px": t.diameter_px / 2,
                "peak_photons": t.peak_rel * light,
                "lambda_n_px": params.lambda_n_px,
                "profile": "uniform",
            }
            contrast = params.contrast_rel if on else 0.0
            return ByFrame(
                tuple(
                    Picture((Speckle(float(a), float(b), contrast=contrast, seed=unit * STEP + k, **kw),), ground)
                    for k, (a, b) in enumerate(zip(x, y, strict=True))
                )
            )
        rng = np.random.default_rng([self.seed, unit])
        slopes, oblique = np.zeros((2, len(x))), np.zeros((2, len(x)))
        if on and source.source.id == "scene.view_point":
            slopes = params.gradient_rel_per_px * rng.normal(size=slopes.shape)
            tilt, way = np.radians(params.view_angle_deg) * rng.uniform(size=len(x)), rng.uniform(0, 2 * np.pi, len(x))
            radius, c = 0.5 * params.diameter_px, params.principal_distance_px
            off = radius**2 * np.sin(tilt) * np.cos(tilt) / (c * (1 - (radius / c * np.sin(tilt)) ** 2))
            oblique = off * np.stack([np.cos(way), np.sin(way)])
        discs = Resting(
            (x + oblique[0])[:, None], (y + oblique[1])[:, None], t.diameter_px, t.blur_px, t.peak_rel * light, ground, per_frame=not last
        )
        if source.source.id == "scene.view_point":
            return Lit(discs, slopes)
        if source.source.id not in OF_MOTION:
            return discs
        s = self.setting
        period = s.frame_period_s if last else float(s.camera.facts.get("frame_period_s", 0.04))
        if source.source.id == PULSES and not on:  # frames belong to the middle of the pulses, of whom one would see the target at rest
            return discs
        middle = (1.0 if source.source.id == PULSES else 0.5) * self.facts.exposure_s
        return Moved(discs, s.velocity_px_per_s, s.acceleration_px_per_s2, period, middle, last or None)

    # ---- shifts -----------------------------------------------------------------------------------------------------------------------

    def cameras(self, element: Element) -> tuple[Camera, Camera]:
        """The camera with a source and without it."""
        cam = self.setting.camera
        if element.source.forward is None:
            return cam, cam
        own = element.name in cam and cam[element.name].on
        if not own or element.params != cam[element.name].params:
            element = self.setting.aged(element, cam)
        whole = put(cam, element)
        return whole, missed(whole, [element.name]) if own else cam

    def shifts(self, element: Element) -> np.ndarray:
        """Shifts by the source, shape (2, units, places, repeats); of layouts that differ, with each taken for the middle of the sensor."""
        whole, without = self.cameras(element)
        keep = self.places
        if element.source.start is not None or element.source.id in LAGS or element.source.stage == "scene":
            keep = max(2, keep // 4)  # one by one
        a, b = self.errors(whole, element.name, element, True, keep), self.errors(without, element.name, element, False, keep)
        shift: np.ndarray = a - b
        if getattr(element.params, "integration", "") == "field":
            shift = shift + np.array([0.0, 0.5]).reshape(2, 1, 1, 1)  # pairs of rows are summed: the frame begins half a row later
        if element.source.gum_class in ("G", "D"):
            shift = shift + self._layouts_apart(whole, without)[:, :, :keep, None]
        return shift

    def _layouts_apart(self, whole: Camera, without: Camera) -> np.ndarray:
        """Where a place of the sensor is taken to be by those who know the size of the frame only; 0 where layouts are the same."""
        rows, cols = self.setting.camera.frame_shape
        at = self.at.reshape(2, -1)
        taken = []
        for camera in (whole, without):
            seen = camera.layout(*at)
            clocks = [e.params.clock_mhz * 1e6 for e in camera.active if e.source.id == "grabber.sampling_clock"]
            one_clock = all(abs(hz / camera.pixel_clock_hz - 1) < 0.005 for hz in clocks)
            parts = []
            for axis, (v, size) in enumerate(zip(seen, (cols, rows), strict=True)):
                shown = camera.output_shape[1 - axis]
                step = size / shown if axis == 0 and not one_clock else max(round(size / shown), 1)
                parts.append((v - (shown - 1) / 2) * step + (size - 1) / 2)
            taken.append(np.stack(parts))
        same = all(
            np.array_equal(v, w) for v, w in zip(whole.layout([0.0, 1.0], [0.0, 1.0]), without.layout([0.0, 1.0], [0.0, 1.0]), strict=True)
        )
        return np.zeros_like(self.at) if same else (taken[0] - taken[1]).reshape(self.at.shape)

    def _excess(self, element: Element) -> Seen:
        """Scatter of the positions with a source less that without it."""
        whole, without = self.cameras(element)
        keep = self.places
        found = []
        for a, b in zip(*(self.errors(c, element.name, element, on, keep) for c, on in ((whole, True), (without, False))), strict=True):
            good = np.isfinite(a) & np.isfinite(b)
            a, b = a[good], b[good]
            bias = a - b
            squares = (a - a.mean()) ** 2 - (b - b.mean()) ** 2
            n = np.sqrt(a.size)
            found.append(Shift(float(bias.mean()), float(squares.mean()), float(bias.std() / n), float(squares.std() / n)))
        return Seen(found[0], found[1], keep * self.units, 0)

    def of(self, element: Element, less: np.ndarray | float = 0.0) -> Seen:
        """What a source does beyond what is known of each target, shape (2, units, places)."""
        if element.source.id in BY_OTHERS:
            return self._excess(element)
        d = self.shifts(element)
        if element.source.id in ROUND:
            d = d[:, :, :, :1].repeat(2, axis=3)
        if not isinstance(less, float):
            d = d - less[:, :, : d.shape[2], None]
        lost = int(np.isnan(d).any(axis=(0, 3)).sum())
        x, y = (_shift(v) for v in d)
        return Seen(x, y, d.shape[1] * d.shape[2], lost)


def _scene_of(source: Element) -> Any:
    """What tells the frames that a source needs from those of the others."""
    if source.source.stage == "scene":
        return source.source.id, source.params
    return source.source.id in OF_MOTION, source.source.id == PULSES, source.source.id in LAGS or source.source.start is not None


def _near_the_target(data: np.ndarray, diameter_px: float, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Whole pixels by which the brightest disc lies beside the middle of its window."""
    from scipy.ndimage import uniform_filter

    size = max(int(round(0.8 * diameter_px)) | 1, 3)
    smooth = uniform_filter(data, (0, size, size), mode="nearest")
    middle = data.shape[1] // 2
    part = smooth[:, middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]
    ground = np.median(smooth, axis=(1, 2))[:, None, None]
    weight = np.maximum(part - ground, 0.0) ** 4  # the middle of the plateau, not a pixel of it
    weight = weight / np.maximum(weight.sum(axis=(1, 2), keepdims=True), 1e-30)
    steps = np.arange(-reach, reach + 1)
    return np.rint((weight * steps).sum(axis=(1, 2))).astype(int), np.rint((weight * steps[:, None]).sum(axis=(1, 2))).astype(int)


def _shift(d: np.ndarray) -> Shift:
    """Of shifts (units, places, repeats): the product of two repeats has the square of what is common to both as its mean."""
    good = np.isfinite(d).all(axis=2)
    if good.sum() < 4:
        return Shift(*(float("nan"),) * 4)
    both = d[good]
    mean = both.mean(axis=1)
    bias, n = float(mean.mean()), len(mean)
    product = np.prod(both - bias, axis=1)
    of_unit = [(v[k].mean(axis=1).mean(), np.prod(v[k] - bias, axis=1).mean()) for v, k in zip(d, good, strict=True) if k.any()]
    spread = OF_UNITS * np.std(np.array(of_unit), axis=0, ddof=1) / np.sqrt(len(of_unit))
    se_bias = max(float(mean.std(ddof=1) / np.sqrt(n)), float(spread[0]))
    variance = float(product.mean()) + se_bias**2
    return Shift(bias, variance, se_bias, max(float(product.std(ddof=1) / np.sqrt(n)), float(spread[1])))


# ---- rows ------------------------------------------------------------------------------------------------------------------------------


def table_at(brute: BruteForce) -> Table:
    """The budget's table, its fields taken at the same places."""
    table = Table(brute.setting, brute.law, seed=brute.seed)
    table.__dict__["calibration"] = replace(table.calibration, places=brute.places_of_fields(), images=None)
    return table


def element_of(table: Table, source_id: str, size: str = "usual") -> Element:
    """A source as the table has it: described, at its usual size, or at its bound."""
    cam = table.setting.camera
    source = sources()[source_id]
    named = next((e for e in cam.active if e.source.id == source_id), None)
    if named is not None and size == "usual":
        return named
    params = table._own(source, table._usual(source) if size == "usual" else source.bound_of(cam.frame_shape))
    return Element(source_id if named is None else named.name, source, params)


def verdict_of(table: Table, brute: BruteForce, element: Element, sigmas: float) -> Verdict:
    """A row beside brute force; an empty ``wrong`` where both agree within what the row declares and chance allows."""
    in_camera = element.name in brute.setting.camera and brute.setting.camera[element.name].on
    source = element.source
    blank = SourceRow(element.name, source.id, source.title, source.number, source.stars, "", source.gum_class)
    row = table._computed(blank, element, in_camera)
    before = row.before or Parts()
    said_u = Parts(NOTHING, before.smooth_px, before.place_px, before.time_px).axes_px()
    bias: tuple[float, float] = before.constant_px
    less: Any = 0.0
    if row.method == MAP:
        state = table.setting.calibrated if source.gum_class == "G" else table.setting.camera
        less = table._difference(table._with_and_without(state, element, in_camera))[:, 0].reshape(brute.at.shape)
    if row.before is None:  # it says why
        told = row.reason and not row.reason.startswith(("not computed", "Monte Carlo"))
        return Verdict(row, NOTHING, NOTHING, NOT_SEEN, () if told else ("reason",))
    seen = brute.of(element, less)
    wrong = []
    for name, u, b, axis in zip("xy", said_u, bias, (seen.x, seen.y), strict=True):
        if row.method == MAP:  # target by target: nothing but what the row declares may be left
            room = max(row.model_error * float(np.hypot(u, b)), row.floor_px)
            k = "xy".index(name)
            other = b - float(less[k].mean())  # by the samples, which are not where a map takes the target
            wrong += [f"bias_{name}"] * (not abs(axis.bias - other) <= room + sigmas * axis.se_bias)
            wrong += [f"u_{name}"] * (not axis.u_within(sigmas)[0] <= room + before.place_px[k])
            continue
        # few targets may show less scatter than there is, and then they show less of its error too
        low, high = axis.u_within(sigmas, u**2 * np.sqrt((row.kurtosis - 1) / seen.targets))
        room = max(row.model_error * u, row.floor_px, ROUNDING_PX)
        if not low - room <= u <= high + room:
            wrong.append(f"u_{name}")
        se_bias = max(axis.se_bias, u / np.sqrt(seen.targets))  # an event of few targets may not be among those seen
        room = max(row.model_error * max(abs(b), u), row.floor_px, ROUNDING_PX) + sigmas * se_bias
        if not abs(axis.bias - b) <= room:
            wrong.append(f"bias_{name}")
    return Verdict(row, said_u, bias, seen, tuple(wrong))


# ---- cameras ---------------------------------------------------------------------------------------------------------------------------

CLOCKS_MHZ = (14.1875, 10.0, 14.75, 28.4)
SHAPES = {0.3: (480, 640), 1.3: (1024, 1280), 5.0: (2048, 2448), 20.0: (3840, 5120)}


def camera_at(preset: str, clock_mhz: float | None, shape: tuple[int, int]) -> Camera:
    """A preset with frames of another size and, unless it is None, another pixel clock; its grabber follows as one would set it up."""
    camera = load_camera(preset)
    hz = camera.pixel_clock_hz if clock_mhz is None else 1e6 * clock_mhz
    line_s = max(camera.line_period_s, 1.2 * shape[1] / hz)
    chain = []
    for e in camera.chain:
        values = e.params.model_dump()
        timed = {"pixel_time_ns": 1e9 / hz, "line_time_us": 1e6 * line_s}
        values |= {k: v for k, v in timed.items() if k in values and clock_mhz is not None}
        if e.source.id == "grabber.sampling_clock":
            values["clock_mhz"] *= hz / camera.pixel_clock_hz
            values["samples"] = int(shape[1] * values["clock_mhz"] * 1e6 / hz)
        if e.source.id == "grabber.window_offset" and values.get("rows"):
            values["rows"] = shape[0] - values["row_offset"] - 4
        chain.append(e if values == e.params.model_dump() else replace(e, params=e.source.make(values)))
    return replace(camera, chain=tuple(chain), frame_shape=shape, pixel_clock_hz=hz, line_period_s=line_s)
