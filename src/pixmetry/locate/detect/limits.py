"""Where targets are looked for, and which are wanted: regions of a frame, a mask, given places, limits of size and contrast."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.detection import FALSE_ALARMS, THRESHOLD_SIGMA, Regions, seen_at
from pixmetry.locate.detect.targets import LeftOut, Targets

SAME_PX = 1.0  # two regions of interest that overlap show one target at places that differ by less
CUT = "cut by the border of a region of interest"
NEAR_PX = 3.0  # beyond a target's outline, at which a given place is still its


@dataclass(frozen=True)
class Limits:
    """Which targets of a frame are wanted; by default all.

    Parameters
    ----------
    rois : sequence of (row, col, rows, cols), optional
        Regions in which targets are looked for, first pixel and size. What their borders cut is left out.
    mask : ndarray of bool, shape of the frame, optional
        True where the centres of targets may be.
    places_px : ndarray, shape (n, 2), optional
        x and y of the wanted targets, roughly: within their outlines, or 3 px from them.
    diameter_px : (float, float), optional
        Least and greatest diameter at half height; of ellipses the geometric mean of the axes.
    contrast_dn : (float, float), optional
        Least and greatest height over the background, without sign.
    threshold_sigma : float
        Threshold of detection in standard deviations of the background's noise.
    false_alarms : float
        Greatest expected number of false faint targets in a frame of noise.

    Raises
    ------
    InputError
        If one of them cannot be used.
    """

    rois: Sequence[tuple[int, int, int, int]] | None = None
    mask: np.ndarray | None = None
    places_px: np.ndarray | None = None
    diameter_px: tuple[float, float] | None = None
    contrast_dn: tuple[float, float] | None = None
    threshold_sigma: float = THRESHOLD_SIGMA
    false_alarms: float = FALSE_ALARMS

    def __post_init__(self) -> None:
        for name in ("diameter_px", "contrast_dn"):
            pair = getattr(self, name)
            if pair is not None and not _is_range(pair):
                raise InputError("not a range", where=name, value=pair, allowed="least and greatest, 0 or more, such as (3, 40)")
        if self.rois is not None and not (isinstance(self.rois, Sequence | np.ndarray) and np.ndim(self.rois) != 0):
            allowed = "a list of (row, col, rows, cols)"
            raise InputError("not a list of regions", where="rois", value=self.rois, allowed=allowed)
        if self.rois is not None and not len(self.rois):
            raise InputError("no region to look in", where="rois", remedy="name one, or leave them out")
        if not (_is_number(self.threshold_sigma) and 0 < self.threshold_sigma < math.inf):
            raise InputError("a threshold that cannot be used", where="threshold_sigma", value=self.threshold_sigma, allowed="above 0")
        if not (_is_number(self.false_alarms) and 0 < self.false_alarms < math.inf):
            raise InputError("no rate of false alarms", where="false_alarms", value=self.false_alarms, allowed="above 0, such as 0.01")
        if self.places_px is not None:
            try:
                places = np.asarray(self.places_px, float)
            except (TypeError, ValueError):
                places = np.empty(0)
            if places.ndim != 2 or places.shape[1] != 2 or not len(places) or not np.isfinite(places).all():
                raise InputError("not places", where="places_px", value=places.shape, allowed="shape (n, 2): x and y of one target or more")

    @property
    def given(self) -> tuple[str, ...]:
        """Names of those that are not as by default."""
        named = ("rois", "mask", "places_px", "diameter_px", "contrast_dn")
        given = tuple(name for name in named if getattr(self, name) is not None)
        given += ("threshold_sigma",) if self.threshold_sigma != THRESHOLD_SIGMA else ()
        return given + (("false_alarms",) if self.false_alarms != FALSE_ALARMS else ())

    def boxes(self, shape: tuple[int, int]) -> list[tuple[int, int, int, int]]:
        """The regions of interest as first row, stop row, first column, stop column; the whole frame if there are none.

        Raises
        ------
        InputError
            If one is not within a frame of this shape.
        """
        if self.rois is None:
            return [(0, shape[0], 0, shape[1])]
        boxes = []
        for roi in self.rois:
            try:
                row, col, rows, cols = (int(v) for v in roi)
                row = row if all(int(v) == v for v in roi) else -1
            except (TypeError, ValueError, OverflowError):
                row = col = rows = cols = -1
            if min(row, col) < 0 or min(rows, cols) < 1 or row + rows > shape[0] or col + cols > shape[1]:
                allowed = f"row, col, rows, cols within {shape[0]} × {shape[1]} pixels (rows × columns)"
                raise InputError("a region that is not in the frame", where="rois", value=roi, allowed=allowed)
            boxes.append((row, row + rows, col, col + cols))
        return boxes

    def wanted(self, targets: Targets, shape: tuple[int, int]) -> Wanted:
        """Choose the targets that are wanted, and tell why the others are not.

        Raises
        ------
        InputError
            If the mask has another shape than the frame.
        """
        left = np.arange(len(targets))
        left_out = []

        def keep(good: np.ndarray, reason: str) -> None:
            nonlocal left
            left_out.append(seen_at(targets[left[~good[left]]], reason))
            left = left[good[left]]

        if self.mask is not None:
            mask = np.asarray(self.mask)
            if mask.shape != shape:
                raise InputError("a mask of another size", where="mask", value=mask.shape, allowed=f"{shape}, True where targets may be")
            if mask.dtype.kind not in "bui":
                raise InputError("not a mask", where="mask", value=str(mask.dtype), allowed="True or False, or whole numbers")
            row, col = (np.clip(np.rint(v).astype(int), 0, side - 1) for v, side in zip((targets.y_px, targets.x_px), shape, strict=True))
            keep(mask[row, col] != 0, "outside the mask")
        if self.diameter_px is not None:
            diameter = 2 * np.sqrt(targets.semi_major_px * targets.semi_minor_px)
            keep((diameter >= self.diameter_px[0]) & (diameter <= self.diameter_px[1]), "smaller or larger than asked for")
        if self.contrast_dn is not None:
            height = np.abs(targets.amplitude_dn)
            keep((height >= self.contrast_dn[0]) & (height <= self.contrast_dn[1]), "contrast lower or higher than asked for")
        if self.places_px is None:
            return Wanted(left, LeftOut.joined(left_out), None)
        places = np.asarray(self.places_px, float)
        of = _at_places(targets[left], places)
        there = np.flatnonzero(of >= 0)
        at, missed = left[of[there]], places[of < 0]
        left_out.append(seen_at(targets[np.setdiff1d(left, at)], "not at a given place"))
        left_out.append(LeftOut.of(missed[:, 0], missed[:, 1], "no target at a given place"))
        return Wanted(at, LeftOut.joined(left_out), there)


class Wanted(NamedTuple):
    """Which targets are wanted."""

    rows: np.ndarray  # indices, shape (m,), in the order of the given places where there are such
    left_out: LeftOut
    place: np.ndarray | None  # shape (m,): number of the given place of each


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _is_range(pair: Any) -> bool:
    return isinstance(pair, Sequence | np.ndarray) and np.shape(pair) == (2,) and all(map(_is_number, pair)) and 0 <= pair[0] < pair[1]


def _at_places(targets: Targets, places: np.ndarray) -> np.ndarray:
    """The target at each given place, −1 for none; one that several places mean belongs to the nearest of them."""
    from scipy.spatial import cKDTree

    of = np.full(len(places), -1)
    if len(targets):
        away, which = cKDTree(np.column_stack([targets.x_px, targets.y_px])).query(places)
        taken = np.zeros(len(targets), bool)
        for i in np.argsort(away, kind="stable"):
            if np.isfinite(away[i]) and away[i] < targets.semi_major_px[which[i]] + NEAR_PX and not taken[which[i]]:
                of[i], taken[which[i]] = which[i], True
    return of


class Within(NamedTuple):
    """What was detected in the regions of interest."""

    targets: Regions  # what the border of a region cuts is not among them, nor is one twice
    seen: Regions  # all, cut ones too: what is no ground
    left_out: LeftOut
    polarities: set[str]
    grounds: set[str]  # "dark" and "bright", the parts that were taken as the ground where targets cover a region
    blanked: bool  # whether targets cover so much of one that no faint ones were looked for


def detect_within(frame: np.ndarray, limits: Limits, look: Callable[[np.ndarray, int, int], Any]) -> Within:
    """Detect in each region of interest; places are those of the whole frame.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    limits : Limits
    look : callable
        From a part of the frame, and the row and column where it begins, to a `Detection`.

    Returns
    -------
    Within
    """
    parts, seen, left_out, polarities, grounds, blanked = [], [], [], set(), set(), False
    for top, bottom, left, right in limits.boxes((frame.shape[0], frame.shape[1])):
        whole = (bottom - top, right - left) == frame.shape
        found = look(frame if whole else np.ascontiguousarray(frame[top:bottom, left:right]), top, left)
        t = found.targets
        polarities.add(found.polarity)
        grounds |= {found.reading} - {""}
        blanked |= found.blanked
        lost = replace(found.left_out, x_px=found.left_out.x_px + left, y_px=found.left_out.y_px + top)
        t = replace(
            t, x_px=t.x_px + left, y_px=t.y_px + top, row_first=t.row_first + top, row_stop=t.row_stop + top, col_first=t.col_first + left,
            col_stop=t.col_stop + left,
        )  # fmt: skip
        seen.append(t)
        if not whole:
            near = (t.row_first - 2 < top) & (top > 0) | (t.row_stop + 2 > bottom) & (bottom < frame.shape[0])
            near |= (t.col_first - 2 < left) & (left > 0) | (t.col_stop + 2 > right) & (right < frame.shape[1])
            lost = LeftOut.joined([lost, seen_at(t[near], CUT)])
            t = t[~near]
        parts.append(t)
        left_out.append(lost)

    def in_one(tables: list[Regions]) -> Regions:
        return Regions(**{f.name: np.concatenate([getattr(t, f.name) for t in tables]) for f in fields(Regions)})

    targets, all_seen = in_one(parts), in_one(seen)
    if len(parts) > 1 and len(targets) > 1:
        from scipy.spatial import cKDTree

        pairs = cKDTree(np.column_stack([targets.x_px, targets.y_px])).query_pairs(SAME_PX, output_type="ndarray")
        targets = targets[np.setdiff1d(np.arange(len(targets)), pairs[:, 1])]
    return Within(targets, all_seen, _nowhere_whole(LeftOut.joined(left_out), targets), polarities, grounds, blanked)


def _nowhere_whole(lost: LeftOut, targets: Regions) -> LeftOut:
    """Without what one region of interest cuts and another one shows whole."""
    x, y = lost.x_px[:, None], lost.y_px[:, None]
    within = (x >= targets.col_first) & (x < targets.col_stop) & (y >= targets.row_first) & (y < targets.row_stop)
    keep = (lost.reason != CUT) | ~within.any(axis=1)
    return LeftOut(**{f.name: getattr(lost, f.name)[keep] for f in fields(LeftOut)})
