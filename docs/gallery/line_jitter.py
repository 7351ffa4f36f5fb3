"""The chapter's line-jitter experiment (Note 19, Table 3.2): stretched lines upright and lying, plumb-line calibration, x against y.

Eight white wires before black cloth are seen by every combination of three cameras, three lenses and three distances, and once more by
the camera rolled by 90°: 54 frames. On each line there are eighty positions, each the mean of a few rows (columns). Upright and lying
lines of a pair are calibrated together; what is left over is compared along x and y.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from gallery.line_jitter_frames import AVERAGED, LINES, SETTLED_C, VIEWS, camera_of, exposed, locate, scene_of, sensor
from pixmetry.calibrate.lines.line_residuals import AxisResiduals, compare_axes, pooled
from pixmetry.calibrate.lines.plumb_line import PlumbLineResult, calibrate_lines
from pixmetry.calibrate.lines.row_jitter import RowVariance, Sampling, jitter_from_axes
from pixmetry.calibrate.records import LinesFTest
from pixmetry.core.number import Estimates

JITTERS_NS = (0.0, 1.0, 2.0, 3.0, 5.0)
REPEATED, FRAMES = (1, 0, 2), 8  # the view that is taken several times
EXAMPLE = 4  # the line of it that is drawn
PIXEL_NS = 1e9 / 14.1875e6
STORED = Path(__file__).with_name("line_jitter.json")


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
    def f_test(self) -> LinesFTest:
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
