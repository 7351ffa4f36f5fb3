"""The record of lines and edges before they are measured, and which of them are near to each other."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class LineCandidates:
    """Roughly known lines or edges, arrays of shape (n,). Places are in pixels from the centre of the top-left pixel.

    Parameters
    ----------
    x1_px, y1_px, x2_px, y2_px : ndarray
        The two ends (to about a pixel along the line, .3 px across).
    curvature_per_px : ndarray
        How much the direction turns per pixel of length (rad/px); a line with ends on its chord lies at c·(t² − L²/4)/2 from it, towards
        (−sin, cos) of the direction.
    blur_px : ndarray
        Rough standard deviation of the blur, without the pixel.
    width_px : ndarray
        Width at half height of the bar before the blur; 0 for a line that is all blur, and for an edge.
    amplitude_dn : ndarray
        Height over the background, negative for dark lines. For an edge: what lies towards (−sin, cos) of the direction from end 1 to
        end 2, minus what lies on the other side.
    background_dn : ndarray
        Grey value beside the line; for an edge that on the other side.
    sigma_dn : ndarray
        Standard deviation of the noise there.
    flags : ndarray of uint32
        Of `Flag`.
    """

    x1_px: np.ndarray
    y1_px: np.ndarray
    x2_px: np.ndarray
    y2_px: np.ndarray
    curvature_per_px: np.ndarray
    blur_px: np.ndarray
    width_px: np.ndarray
    amplitude_dn: np.ndarray
    background_dn: np.ndarray
    sigma_dn: np.ndarray
    flags: np.ndarray

    def __len__(self) -> int:
        return len(self.x1_px)

    def __getitem__(self, which: np.ndarray | slice) -> LineCandidates:
        """A part of them, by mask, index array or slice."""
        return LineCandidates(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    @property
    def angle_rad(self) -> np.ndarray:
        """Direction from end 1 to end 2, from x towards y."""
        angle: np.ndarray = np.arctan2(self.y2_px - self.y1_px, self.x2_px - self.x1_px)
        return angle

    @property
    def length_px(self) -> np.ndarray:
        """Distance of the ends."""
        length: np.ndarray = np.hypot(self.x2_px - self.x1_px, self.y2_px - self.y1_px)
        return length

    @property
    def core_px(self) -> np.ndarray:
        """How far to either side the line changes grey values: half its width and 3.5 standard deviations of blur and pixel."""
        core: np.ndarray = 0.5 * self.width_px + 3.5 * np.hypot(self.blur_px, 0.2887) + 0.3
        return core

    @classmethod
    def of(cls, **columns: object) -> LineCandidates:
        """Candidates from columns or numbers; missing values are 0 (the blur: 1 px)."""
        given = {"blur_px": 1.0} | columns
        n = np.size(np.asarray(given["x1_px"]))
        filled = {f.name: np.broadcast_to(np.asarray(given.get(f.name, 0.0), float).ravel(), n).copy() for f in fields(cls)}
        return cls(**filled | {"flags": filled["flags"].astype(np.uint32)})


def stretches(candidates: LineCandidates, frame_shape: tuple[int, int], kept_px: np.ndarray) -> np.ndarray:
    """Return x, y, angle, least and greatest distance along, and curvature of the stretches that are measured, shape (n, 6).

    Parameters
    ----------
    candidates : LineCandidates
    frame_shape : (rows, cols)
    kept_px : ndarray, shape (n,)
        How far to stay away from the ends; an end that leaves the frame, or comes as near as this to its border, is let run out of it.

    Notes
    -----
    x, y is the middle of the stretch inside the frame; a curved line lies off its chord by its sagitta there.
    """
    angle, length = candidates.angle_rad, candidates.length_px
    c, s = np.cos(angle), np.sin(angle)
    least, most = _inside(candidates.x1_px, candidates.y1_px, c, s, length, frame_shape)
    short = np.minimum(kept_px, 0.25 * length)
    run_first, run_last = (inside < 1.5 * kept_px for inside in _border_distance(candidates, frame_shape))
    least = np.where(run_first, least, np.maximum(least, short))
    most = np.where(run_last, most, np.minimum(most, length - short))
    middle = 0.5 * (least + most)
    sag = 0.5 * candidates.curvature_per_px * ((middle - 0.5 * length) ** 2 - 0.25 * length**2)
    turned = candidates.curvature_per_px * (middle - 0.5 * length)
    x = candidates.x1_px + c * middle - s * sag
    y = candidates.y1_px + s * middle + c * sag
    beyond = 2.0 * kept_px + 20.0
    first = least - middle - np.where(run_first, beyond, 0.0)
    last = most - middle + np.where(run_last, beyond, 0.0)
    return np.ascontiguousarray(np.stack([x, y, angle + turned, first, last, candidates.curvature_per_px], axis=1))


def _inside(
    x: np.ndarray, y: np.ndarray, c: np.ndarray, s: np.ndarray, length: np.ndarray, frame_shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """First and last distance from end 1 at which the chord is inside the frame, borders half a pixel outside the outer centres."""
    least, most = np.zeros_like(length), length.copy()
    for start, slope, side in ((x, c, frame_shape[1]), (y, s, frame_shape[0])):
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-0.5 - start) / slope, (side - 0.5 - start) / slope
        low, high = np.minimum(a, b), np.maximum(a, b)
        moving = np.abs(slope) > 1e-12
        least, most = np.where(moving, np.maximum(least, low), least), np.where(moving, np.minimum(most, high), most)
    return least, most


def _border_distance(candidates: LineCandidates, frame_shape: tuple[int, int]) -> list[np.ndarray]:
    """How far inside the frame the two ends lie."""
    rows, cols = frame_shape
    ends = ((candidates.x1_px, candidates.y1_px), (candidates.x2_px, candidates.y2_px))
    return [np.min([x + 0.5, cols - 0.5 - x, y + 0.5, rows - 0.5 - y], axis=0) for x, y in ends]


def near_lines(places: np.ndarray, reach_px: np.ndarray, cores_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which lines may cover pixels of each one, by their boxes: begin, shape (n + 1,), and indices."""
    n = len(places)
    c, s = np.cos(places[:, 2]), np.sin(places[:, 2])
    x, y = places[:, :1] + c[:, None] * places[:, 3:5], places[:, 1:2] + s[:, None] * places[:, 3:5]
    sag = 0.5 * np.abs(places[:, 5]) * np.abs(places[:, 3:5]).max(axis=1) ** 2 if n else np.zeros(0)
    outer = np.maximum(reach_px, cores_px) + sag
    low = np.stack([x.min(axis=1), y.min(axis=1)], axis=1) - outer[:, None]
    high = np.stack([x.max(axis=1), y.max(axis=1)], axis=1) + outer[:, None]
    begin, found = np.zeros(n + 1, np.int64), []
    for i in range(n):
        near = np.flatnonzero(((low <= high[i]) & (high >= low[i])).all(axis=1))
        near = near[near != i]
        found.append(near)
        begin[i + 1] = begin[i] + len(near)
    return begin, np.concatenate(found).astype(np.int64) if found else np.zeros(0, np.int64)
