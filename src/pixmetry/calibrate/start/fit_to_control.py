"""The frame in which most known coordinates of control points are right, and those that lie far from where it puts them.

A network without gross errors in its images is rigid: only the seven parameters of a similarity bring it to its control, and points that
were taken for others would turn it over. Each pair of whole points, with the turn about their line, is a frame to begin with; least squares
with weights anew by the residuals (as in `resection.fitted`) take it to all coordinates, whole points or not.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from pixmetry.calibrate.start.resection import fitted, motions, similarity
from pixmetry.core.arrays import Array, Flags

MOST_PAIRS = 28  # of eight points; of more, three right ones are found without heights and positions
TURNS = 16  # about the line of a pair
STEPS = 40
SETTLED = 1e-9  # of the extent: a step that moves no point by more was the last
LEAST_LEFT = 10  # coordinates that agree: three more than a similarity has parameters
MOST_WRONG = 1 / 3  # of the points


def far_from_control(found: np.ndarray, given: np.ndarray, u: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Points in the frame in which most known coordinates fit, and by how much each coordinate misses it.

    Parameters
    ----------
    found, given, u : ndarray, shape (points, 3)
        Coordinates in any frame, and known ones with their uncertainties; not finite: not known.
    limit : float
        Misses from which on they do not count.

    Returns
    -------
    (moved, miss) : ndarray, shape (points, 3)
        ``miss`` is 0 where nothing is known. None where it cannot be said.
    """
    known = np.isfinite(u) & np.isfinite(given) & np.isfinite(found).all(axis=1)[:, None]
    whole = np.flatnonzero(known.all(axis=1))
    if len(whole) < 2 or known.sum() < LEAST_LEFT:
        return None
    rows = np.flatnonzero(known.any(axis=1))
    some, target, mask = found[rows], np.where(known, given, 0.0)[rows], known[rows]

    def cost(points: np.ndarray) -> float:
        return float(np.minimum(np.abs(points - target), limit)[mask].sum())

    best = some
    for start in _starts(some, target, np.searchsorted(rows, whole)):
        fit = _fitted(start, target, mask)
        best = fit if best is some or cost(fit) < cost(best) else best
        if (np.abs(best - target)[mask] < limit).all():  # whole points by themselves, for the most part
            break
    miss = np.zeros_like(found)
    miss[rows] = np.where(mask, target - best, 0.0)
    far = np.abs(miss) > limit
    if known.sum() - far.sum() < LEAST_LEFT or far.any(axis=1).sum() > MOST_WRONG * len(rows):
        return None
    scale, rotation, shift = similarity(some, best)
    return scale * found @ rotation.T + shift, miss


def _starts(found: np.ndarray, given: np.ndarray, whole: np.ndarray) -> Iterator[np.ndarray]:
    """All points, moved by what takes whole ones to where they should be."""
    if len(whole) > 2:
        scale, rotation, shift, _ = fitted(found[whole], given[whole])
        yield scale * found @ rotation.T + shift
    pairs = list(combinations(whole, 2))
    for pair in map(list, pairs if len(pairs) <= MOST_PAIRS else ()):
        scale, rotation, shift = similarity(found[pair], given[pair])
        moved = scale * found @ rotation.T + shift
        axis = moved[pair[1]] - moved[pair[0]]
        for turn in np.arange(TURNS) * 2 * np.pi / TURNS:
            yield _turned(moved - moved[pair[0]], turn * axis / max(float(np.linalg.norm(axis)), 1e-300)) + moved[pair[0]]


def _turned(points: np.ndarray, by: np.ndarray) -> Array:
    from scipy.spatial.transform import Rotation

    turned: Array = Rotation.from_rotvec(by).apply(points)
    return turned


def brought_to(found: Array, given: Array, known: Flags, *, scaled: bool = True) -> Array:
    """Points moved by the similarity that takes them to what is known of them, in least squares; shape (points, 3) as all of these.

    Of points known in part it is the nearest one: they lie about where they should be already.
    """
    if not known.all():
        return _fitted(found, np.where(known, given, 0.0), known, scaled=scaled, robust=False)
    scale, rotation, shift = similarity(found, given, scaled=scaled)
    return scale * found @ rotation.T + shift


def _fitted(points: np.ndarray, given: np.ndarray, known: np.ndarray, *, scaled: bool = True, robust: bool = True) -> np.ndarray:
    """Points moved by the similarity that leaves the known coordinates, or most of them, where they should be."""
    extent = max(float(np.linalg.norm(np.std(points, axis=0))), 1e-300)
    for _ in range(STEPS):
        middle = points.mean(axis=0)
        slope = motions((points - middle) / extent)
        if not scaled:
            slope[:, :, 6] = 0.0
        off = (given - points)[known]
        spread = max(1.5 * float(np.median(np.abs(off))), 1e-12 * extent)
        root = 1 / np.sqrt(1 + (off / spread) ** 2) if robust else np.ones(len(off))
        step = np.linalg.lstsq(root[:, None] * slope[known], root * off, rcond=None)[0]
        turn = step[3:6] / extent
        turn *= min(1.0, 0.5 / max(float(np.linalg.norm(turn)), 1e-300))
        stretch = float(np.exp(np.clip(step[6] / extent, -0.5, 0.5)))
        before, points = points, stretch * _turned(points - middle, turn) + middle + step[:3]
        if np.abs(points - before).max() < SETTLED * extent:
            break
    return points
