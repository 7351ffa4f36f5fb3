"""Frames of the line-jitter experiment: wires upright and lying, through camera and frame grabber, and located row by row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import blake2b

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.calibrate.bundle.model import Sensor
from pixmetry.camera.camera import Camera, Element, load_camera
from pixmetry.camera.light import Points
from pixmetry.core.random import Grid, generator
from pixmetry.locate.lines.line_detection import find_lines
from pixmetry.locate.lines.lines import LineRows, line_rows
from pixmetry.locate.noise import NoiseModel, camera_noise
from pixmetry.scene.outlines import line
from pixmetry.scene.picture import Picture
from pixmetry.scene.shapes import Shapes
from pixmetry.scene.uniform import Uniform
from pixmetry.sources.optics import distortion

PRESET = "pulnix_tm6cn_epix_pixelclock"
LINES, POSITIONS, AVERAGED = 8, 80, 3
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
SETTLED_C = 40.0


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
