"""The chapter's line-jitter experiment (Note 19, Table 3.2): stretched lines upright and lying, plumb-line calibration, x against y.

Eight white wires before black cloth are seen by every combination of three cameras, three lenses and three distances, and once more by
the camera rolled by 90°: 54 frames. On each line there are eighty positions, each the mean of a few rows (columns). Upright and lying
lines of a pair are calibrated together; what is left over is compared along x and y.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.calibration.line_residuals import AxisResiduals, compare_axes, pooled
from pixmetry.calibration.model import Sensor
from pixmetry.calibration.plumb_line import PlumbLineResult, calibrate_lines
from pixmetry.calibration.row_jitter import RowVariance, Sampling, jitter_from_axes
from pixmetry.camera_noise import camera_noise
from pixmetry.core.camera import Camera, Element
from pixmetry.core.camera_files import load_camera
from pixmetry.core.estimates import Estimates
from pixmetry.core.light import Points
from pixmetry.core.random import Grid, generator
from pixmetry.location.line_detection import find_lines
from pixmetry.location.line_rows import LineRows, line_rows
from pixmetry.location.noise import NoiseModel
from pixmetry.optics import distortion
from pixmetry.scene.outlines import line
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform

PRESET = "pulnix_tm6cn_epix_pixelclock"
LINES, POSITIONS, AVERAGED = 8, 80, 3
JITTERS_NS = (0.0, 1.0, 2.0, 3.0, 5.0)
SPACING_MM = (0.62, 0.52, 0.42)  # of the lines on the sensor, by distance
WIDTH_MM = 0.0425  # of a line over its spacing
PHOTONS = (95_000.0, 80_000.0, 65_000.0)
LENSES: tuple[dict[str, float], ...] = (
    {"k1_per_mm2": -1.2e-3, "k2_per_mm4": 1.5e-5, "p1_per_mm": 3e-5, "p2_per_mm": -2e-5, "centre_x_px": 5.0, "centre_y_px": -3.0},
    {"k1_per_mm2": -4e-4, "k2_per_mm4": 4e-6, "p1_per_mm": -2e-5, "p2_per_mm": 1e-5, "centre_x_px": -4.0, "centre_y_px": 6.0},
    {"k1_per_mm2": 1e-4, "k2_per_mm4": -2e-6, "p1_per_mm": 1e-5, "p2_per_mm": 3e-5, "centre_x_px": 2.0, "centre_y_px": 4.0},
)
CAMERAS = (6, 7, 8)  # unit seeds
VIEWS = tuple((d, c, k) for d in range(3) for c in range(3) for k in range(3))  # distance, camera, lens
REPEATED, FRAMES = (1, 0, 2), 8  # the view that is taken several times
EXAMPLE = 4  # the line of it that is drawn
SETTLED_C = 40.0
PIXEL_NS = 1e9 / 14.1875e6
STORED = Path(__file__).with_name("line_jitter.json")


@lru_cache(maxsize=1)
def preset() -> Camera:
    """The camera with the frame grabber that its own pixel clock drives."""
    return load_camera(PRESET)


def camera_of(view: tuple[int, int, int], jitter_ns: float) -> Camera:
    """Camera and frame grabber of a view, with its lens; the grabber's own jitter is replaced by ``jitter_ns``."""
    camera = preset().with_parameters("grabber.line_jitter", white_ns=jitter_ns)
    lens = Element("optics.distortion", distortion.SOURCE, distortion.SOURCE.make(LENSES[view[2]], where="optics.distortion"))
    return replace(camera, chain=(lens, *camera.chain), unit_seed=CAMERAS[view[1]])


@lru_cache(maxsize=1)
def noise() -> NoiseModel:
    """Temporal noise against grey value, read off the camera."""
    return camera_noise(preset()).model


class Kept:
    """A scene that keeps the light it gave: asked for the same places again, whatever the grabber does behind them, it gives the same."""

    moving = False

    def __init__(self, scene: Picture) -> None:
        self.scene = scene
        self.smooth_px = scene.smooth_px
        self.given: dict[bytes, np.ndarray] = {}

    def photons(self, grid: Grid, frame_shape: tuple[int, int], exposure_s: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        """Photons of full square pixels."""
        return self.scene.photons(grid, frame_shape, exposure_s, time_s)

    def radiance(self, at: Points) -> np.ndarray:
        """Light at points."""
        return self._once("radiance", at)

    def averaged(self, at: Points, width_px: ArrayLike, height_px: ArrayLike) -> np.ndarray:
        """Light averaged over boxes."""
        return self._once("averaged", at, width_px, height_px)

    def detailed(self, at: Points, reach_px: ArrayLike) -> np.ndarray:
        """Whether there is an outline near."""
        return self._once("detailed", at, reach_px)

    def _once(self, method: str, at: Points, *more: ArrayLike) -> np.ndarray:
        asked = blake2b(method.encode(), digest_size=16)
        for part in (at.x_px, at.y_px, at.blur_px, *more):
            asked.update(np.ascontiguousarray(part).tobytes())
        name = asked.digest()
        if name not in self.given:
            self.given[name] = getattr(self.scene, method)(at, *more)
        return self.given[name]


@lru_cache(maxsize=2)
def scene_of(view: tuple[int, int, int], lying: bool) -> Kept:
    """Eight wires, nearly parallel to y or, with the camera rolled, to x; they reach beyond the frame."""
    camera = preset()
    rows, cols = camera.frame_shape
    pitch_mm = camera.pitch_um[1 if lying else 0] / 1000
    rng = generator(19, f"wires {view[0]}")  # the same wires for all cameras and lenses
    tilt_deg = 0.5 + 0.25 * rng.standard_normal(LINES)
    off = (np.arange(LINES) - (LINES - 1) / 2) * SPACING_MM[view[0]] / pitch_mm + 2.0 * rng.standard_normal(LINES)
    width = SPACING_MM[view[0]] * WIDTH_MM / pitch_mm
    x, y = (cols - 1) / 2, (rows - 1) / 2
    wires = [
        line(x, y + o, 1400.0, width, t, PHOTONS[view[0]]) if lying else line(x + o, y, 1400.0, width, 90.0 + t, PHOTONS[view[0]])
        for o, t in zip(off, tilt_deg, strict=True)
    ]
    return Kept(Picture((Shapes.of(wires, 0.6),), Uniform(1000.0)))


@dataclass(frozen=True)
class Located:
    """Positions on the lines of one frame.

    Parameters
    ----------
    x_px, y_px : ndarray, shape (8, 80)
        NaN where there is none. The place along the line is the middle of the rows (columns).
    u2_px2 : ndarray, shape (8, 80)
        Variance across, as the estimator states it.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    u2_px2: np.ndarray


def locate(frame: np.ndarray, lying: bool) -> Located:
    """Find the lines of a frame, measure them row by row (column by column), and average a few rows at eighty places."""
    found = find_lines(frame, polarity="bright", noise=noise(), least_length_px=0.5 * min(frame.shape), threads=1)
    middle = found.y1_px + found.y2_px if lying else found.x1_px + found.x2_px
    found = found[np.argsort(middle)]
    if len(found) != LINES:
        raise RuntimeError(f"{len(found)} lines were found, not {LINES}")
    rows = line_rows(frame, found, noise(), "line", "row_template", threads=1)
    length = frame.shape[1] if lying else frame.shape[0]
    return _averaged(rows, length, lying)


def _averaged(rows: LineRows, length: int, lying: bool) -> Located:
    step = length // (POSITIONS + 1)
    first = (length - POSITIONS * step) // 2 + (step - AVERAGED) // 2
    begin = first + step * np.arange(POSITIONS)
    place, variance = np.full((LINES, length), np.nan), np.full((LINES, length), np.nan)
    place[rows.line, rows.index], variance[rows.line, rows.index] = rows.position_px, rows.var_px2
    take = begin[:, None] + np.arange(AVERAGED)
    across, u2 = place[:, take].mean(axis=2), variance[:, take].mean(axis=2) / AVERAGED
    along = np.broadcast_to(begin + (AVERAGED - 1) / 2, across.shape)
    return Located(along if lying else across, across if lying else along, u2)


def exposed(view: tuple[int, int, int], lying: bool, jitter_ns: float, frames: int = 1) -> tuple[Located, ...]:
    """Expose and locate."""
    seed = 2 * VIEWS.index(view) + lying + 1000 * round(10 * jitter_ns)
    data = camera_of(view, jitter_ns).expose(scene_of(view, lying), frames, seed, threads=1, temperature_c=SETTLED_C).data
    return tuple(locate(frame, lying) for frame in data)


def sensor() -> Sensor:
    """Pixel grid of the camera."""
    camera = preset()
    return Sensor(camera.frame_shape[1], camera.frame_shape[0], *camera.pitch_um)


@dataclass(frozen=True)
class View:
    """What one pair of frames left over.

    Parameters
    ----------
    axes : dict of AxisResiduals
        Residuals of the upright lines ("x") and of the lying ones ("y").
    rows, columns : RowVariance
        What the upright lines have in common in a row, and, as a check, the lying ones in a column, where jitter has no part.
    stated_px2 : (float, float)
        Mean variance of a position by its estimator's own statement, upright and lying.
    k1_per_mm2 : (float, float)
        Found, with its standard uncertainty.
    rejected : int
        Positions left out as gross errors.
    """

    axes: dict[str, AxisResiduals]
    rows: RowVariance
    columns: RowVariance
    stated_px2: tuple[float, float]
    k1_per_mm2: tuple[float, float]
    rejected: int


def residuals(view: tuple[int, int, int], jitter_ns: float) -> tuple[PlumbLineResult, np.ndarray, np.ndarray]:
    """One pair: expose, locate, calibrate.

    Returns
    -------
    result : PlumbLineResult
    left_px : ndarray, shape (2, 8, 80)
        Residuals across the upright and the lying lines; NaN for what was not located or is a gross error.
    u2_px2 : ndarray, same shape
        Stated variances.
    """
    pair = tuple(exposed(view, lying, jitter_ns)[0] for lying in (False, True))
    x, y, u2 = (np.stack([getattr(p, name) for p in pair]) for name in ("x_px", "y_px", "u2_px2"))
    image, wire = (np.broadcast_to(v, x.shape) for v in (np.arange(2)[:, None, None], np.arange(LINES)[:, None]))
    good = np.isfinite(x) & np.isfinite(y)
    result = calibrate_lines(x[good], y[good], wire[good], image[good], sensor(), u_px=np.sqrt(u2[good]))
    left = np.full(x.shape, np.nan)
    left[good] = np.where(result.used, result.residual_px, np.nan)
    return result, left, u2


def run_view(view: tuple[int, int, int], jitter_ns: float) -> View:
    """What one pair leaves over."""
    result, left, u2 = residuals(view, jitter_ns)
    rows, columns = (
        RowVariance.of(left[k : k + 1], free_share=axis.dof / axis.n) for k, axis in enumerate((result.axes["x"], result.axes["y"]))
    )
    k1 = result.estimates["k1_per_mm2"]
    stated = float(np.nanmean(u2[0])), float(np.nanmean(u2[1]))
    return View(result.axes, rows, columns, stated, (k1.value, k1.u), int((~result.used).sum()))


def run_repeated(jitter_ns: float, frames: int = FRAMES) -> RowVariance:
    """The upright lines of one view in several frames: what changes from frame to frame in all lines of a row."""
    found = exposed(REPEATED, False, jitter_ns, frames)
    return RowVariance.of(np.stack([f.x_px for f in found]), repeated=True)


@lru_cache(maxsize=3)
def delay_gain(distance: int, shear_ns: float = 20.0) -> float:
    """By how many pixels a delay of one pixel moves a position on an upright line.

    The rows of a frame without noise are delayed the more, the lower they are, and once more the other way round; the difference of the
    positions is held against that of the delays.
    """
    view = (distance, 0, 2)
    places = []
    for sign in (1, -1):
        camera = camera_of(view, 0.0).with_parameters("grabber.line_jitter", shear_ns=sign * shear_ns)
        data = camera.expose(scene_of(view, False), 1, threads=1, quiet=True, temperature_c=SETTLED_C).data
        places.append(locate(data[0], False))
    rows = camera.frame_shape[0]
    delay_px = 2 * shear_ns / PIXEL_NS * (places[0].y_px / (rows - 1) - 0.5)
    moved = places[0].x_px - places[1].x_px
    good = np.isfinite(moved)
    return float(moved[good] @ delay_px[good] / (delay_px[good] @ delay_px[good]))


@dataclass(frozen=True)
class Level:
    """All views with one jitter.

    Parameters
    ----------
    jitter_ns : float
        True.
    x, y : AxisResiduals
        Pooled.
    views : int
    rows, columns, repeated : RowVariance
    stated_px2 : (float, float)
    rejected : int
    """

    jitter_ns: float
    x: AxisResiduals
    y: AxisResiduals
    views: int
    rows: RowVariance
    columns: RowVariance
    repeated: RowVariance
    stated_px2: tuple[float, float]
    rejected: int

    @classmethod
    def of(cls, jitter_ns: float, views: Sequence[View], repeated: RowVariance) -> Level:
        """Pool views."""
        stated = np.mean([v.stated_px2 for v in views], axis=0)
        return cls(
            jitter_ns, pooled([v.axes["x"] for v in views]), pooled([v.axes["y"] for v in views]), len(views),
            RowVariance.pooled([v.rows for v in views]), RowVariance.pooled([v.columns for v in views]), repeated,
            (float(stated[0]), float(stated[1])), sum(v.rejected for v in views),
        )  # fmt: skip

    @property
    def f_test(self) -> dict[str, Any]:
        """x against y."""
        return compare_axes(self.x, self.y)

    def jitters(self, gain: float) -> dict[str, Estimates]:
        """The jitter by each way: from x against y, from what lines share in a row of one frame, from repeated frames; and the check."""
        along_x, along_y = (Sampling(PIXEL_NS, AVERAGED, g) for g in (gain, 1.0))
        axes = jitter_from_axes(
            self.x, self.y, along_x, kind="lines", noise_ratio=self.stated_px2[0] / self.stated_px2[1], jitter_dof=self.rows.dof[0]
        )
        return {
            "axes": axes,
            "rows": self.rows.jitter(along_x),
            "repeated": self.repeated.jitter(along_x),
            "columns": self.columns.jitter(along_y),
        }


@dataclass(frozen=True)
class Experiment:
    """Everything.

    Parameters
    ----------
    levels : tuple of Level
        By jitter.
    views : dict of View
        By `key`.
    gains : tuple of float
        Of a delay, by distance.
    example_px : ndarray, shape (jitters, 2, 80)
        Residuals of one upright and one lying line, for each jitter.
    """

    levels: tuple[Level, ...]
    views: dict[str, View]
    gains: tuple[float, ...]
    example_px: np.ndarray

    @property
    def gain(self) -> float:
        """Root mean square over the distances."""
        return float(np.sqrt(np.mean(np.square(self.gains))))


def key(view: tuple[int, int, int], jitter_ns: float) -> str:
    """Name of a view: distance, camera, lens, jitter."""
    return f"{view[0]}{view[1]}{view[2]} {jitter_ns:g}"


def run(
    views: Sequence[tuple[int, int, int]] = VIEWS,
    jitters_ns: Sequence[float] = JITTERS_NS,
    progress: Callable[[str], None] = lambda _: None,
) -> Experiment:
    """Run the experiment, or some views of it; each view's numbers are its own, whichever others are run."""
    done: dict[str, View] = {}
    for view in views:  # all jitters of a view share its light
        progress(f"view {view}")
        done |= {key(view, jitter): run_view(view, jitter) for jitter in jitters_ns}
    progress("repeated frames")
    levels = [Level.of(jitter, [done[key(view, jitter)] for view in views], run_repeated(jitter)) for jitter in jitters_ns]
    example = np.stack([residuals(REPEATED, jitter)[1][:, EXAMPLE] for jitter in jitters_ns])
    return Experiment(tuple(levels), done, tuple(delay_gain(d) for d in sorted({v[0] for v in views})), example)


def write(experiment: Experiment, path: Path = STORED) -> None:
    """Store the numbers of an experiment, which the page shows."""
    record = {
        "gains": experiment.gains,
        "example_px": experiment.example_px.tolist(),
        "repeated": {f"{level.jitter_ns:g}": asdict(level.repeated) for level in experiment.levels},
        "views": {name: asdict(view) for name, view in experiment.views.items()},
    }
    plain = json.dumps(_rounded(record), indent=None, separators=(",", ":"), ensure_ascii=False)
    path.write_text(plain.replace('},"', '},\n"') + "\n", encoding="utf-8")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_rounded(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value


@lru_cache(maxsize=1)
def stored() -> Experiment:
    """The whole experiment as it was run and stored."""
    record = json.loads(STORED.read_text(encoding="utf-8"))
    views: dict[str, View] = {}
    for name, v in record["views"].items():
        axes = {k: AxisResiduals(**{**a, **{f: np.array(a[f]) for f in ("correlation", "pairs")}}) for k, a in v.pop("axes").items()}
        rows, columns = (_row_variance(v.pop(k)) for k in ("rows", "columns"))
        views[name] = View(axes, rows, columns, tuple(v["stated_px2"]), tuple(v["k1_per_mm2"]), v["rejected"])
    levels = [
        Level.of(float(ns), [v for name, v in views.items() if name.split()[1] == ns], _row_variance(r))
        for ns, r in record["repeated"].items()
    ]
    return Experiment(tuple(levels), views, tuple(record["gains"]), np.array(record["example_px"], float))


def _row_variance(record: dict[str, Any]) -> RowVariance:
    return RowVariance(**{**record, "dof": tuple(record["dof"])})
