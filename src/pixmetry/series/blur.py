"""How long a moving target is exposed, from the blur along its path.

Over an exposure t a target of velocity v is spread evenly over a length b = v t, which adds b²/12 to its variance along the motion. Every
target has one outline and one blur at rest, which all its pictures share; what grows with the square of the velocity is the exposure's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.locate.template.template import model

MOST_CUT_PX = 28.0  # half side of a window, at most
SHORTEST_PX = 0.3  # of a path; below it the picture changes in proportion to the square of the path
MOST_TARGETS, MOST_PICTURES = 16, 48  # that are fitted: of each target by the velocity that they have
LEAST_PICTURES = 6  # of one target
STEPS, AT_REST, MOST_HALVINGS = 12, 1e-4, 6
LEAST_SPREAD = 0.3  # of the squares of the velocities, of the largest: below, all pictures are blurred alike
BEYOND = 3.0  # standard deviations of the blur, beyond the outline, that are fitted
FAR_OFF = 6.0  # robust standard deviations, from which on a target is not what it is taken for
SIGNIFICANT = 3.0
METHOD = (
    "ellipse, spread evenly along its path, fitted to the pixels of every target; outline and blur at rest are common to all its pictures"
)
PULSED = "sum of a target in the light of a pulse and, spread along its path, in the steady light, fitted to the pixels of both fields"
PULSE_STEPS = 3
PLACE_U_REL = 0.2  # of the exposure: where the pulses are in it, if it was not stated
LEAST_TARGETS = 4  # for the scatter between them
CONFOUNDERS = (
    "the course of the light within the exposure: only its variance is told, as that of an even exposure",
    "image lag and temporal noise reduction, which leave a trail",
)
ONE_BLUR = (
    "all frames are blurred alike, and the shape of the targets is not known: take a run at rest, or with motion in another direction too"
)


@dataclass(frozen=True)
class Cut:
    """Windows about the targets of one frame: ``first_px``, the first pixel of each, and ``places_px``, shape (n, 2), x and y."""

    first_px: np.ndarray
    places_px: Array
    windows: tuple[np.ndarray, ...]
    ceiling_dn: float = np.inf  # the largest value that can be stored

    def near(self, place_px: Array) -> int | None:
        """Which window is that of a target here; None where there is none, or the frame's border cuts it."""
        if not self.windows:
            return None
        apart = np.linalg.norm(self.places_px - place_px, axis=1)
        k = int(np.argmin(apart))
        largest = max(w.shape for w in self.windows)
        return k if apart[k] < 2.0 and self.windows[k].shape == largest and largest[0] == largest[1] else None

    def look(self, k: int, parity: int, place_px: Array, speed_px_s: Array) -> Look:
        """The picture of a target in even or odd rows of the frame, in window k; clipped values count as none."""
        values = self.windows[k].astype(float)
        values[(values <= 0) | (values >= self.ceiling_dn)] = np.nan
        return Look(values, (parity - int(self.first_px[k, 1])) % 2, place_px - self.first_px[k], speed_px_s)


@dataclass(frozen=True)
class Look:
    """One picture of a target: the pixels of even or of odd rows.

    Parameters
    ----------
    values : ndarray, shape (rows, cols), DN
        Of the whole window.
    parity : int
        Rows of the window that count begin at this one and are every other.
    place : ndarray, shape (2,)
        Of the target, px from the first pixel.
    speed_px_s : ndarray, shape (2,)
    steady_s : (float, float), optional
        In the light of a pulse: length of the exposure to steady light, and its middle after the pulse.
    """

    values: Array
    parity: int
    place: Array
    speed_px_s: Array
    steady_s: tuple[float, float] | None = None


def cut_out(frame: np.ndarray, places_px: Array, bits: int | None = None) -> Cut:
    """Windows about targets, as far as the half way to the nearest other one."""
    from scipy.spatial import cKDTree

    places = places_px[np.isfinite(places_px).all(axis=1)]
    ceiling = float(2**bits - 1) if bits else float(np.iinfo(frame.dtype).max) if frame.dtype.kind == "u" else np.inf
    if not len(places):
        return Cut(np.zeros((0, 2), int), places, (), ceiling)
    near = np.inf if len(places) < 2 else cKDTree(places).query(places, 2)[0][:, 1].min()
    half = int(min(MOST_CUT_PX, 0.5 * near))
    first, windows = [], []
    for x, y in np.rint(places).astype(int):
        left, top = max(x - half, 0), max(y - half, 0)
        first.append((left, top))
        windows.append(frame[top : y + half + 1, left : x + half + 1].copy())
    return Cut(np.array(first), places, tuple(windows), ceiling)


def exposure_of(targets: Sequence[Sequence[Look]], row_time_s: float = 0.0, u_speed_rel: float = 0.0) -> Estimates:
    """Length of the even exposure that blurs moving targets as much.

    Parameters
    ----------
    targets : sequence of sequence of Look
        The pictures of each target.
    row_time_s : float
        From row to row, by which a moving target is sheared.
    u_speed_rel : float
        Relative standard uncertainty of all velocities.

    Returns
    -------
    Estimates
        ``exposure_s``, or its limit, or the reason why it is not told.

    Notes
    -----
    Gauss and Newton, with place, height and background of every picture, and outline, blur and square of the exposure of every target. The
    result is the weighted mean over the targets. Its u is that of the scores of single pictures (White's sandwich, clustered by picture),
    so that it does not rest on a model of the noise; it is enlarged where targets differ by more.

    The square of the exposure is the unknown, and may come out below zero: then the mean over many cameras without blur is right.
    """
    usable = [looks for looks in (_chosen(t) for t in targets) if len(looks) >= LEAST_PICTURES]
    if not usable:
        return untold(f"no target is seen in {LEAST_PICTURES} windows or more that no other target reaches into")
    usable = usable[:: max(1, -(-len(usable) // MOST_TARGETS))]
    if _spread(usable) < LEAST_SPREAD:
        return untold(ONE_BLUR)
    fits = [f for f in (_fitted(looks, row_time_s) for looks in usable) if f is not None]
    if not fits:
        return untold("no ellipse with a soft edge describes the targets")
    square, u_square, dof = _joined(fits)
    u_square = float(np.hypot(u_square, 2 * square * u_speed_rel))
    if square > SIGNIFICANT * u_square:
        value = float(np.sqrt(square))
        row = ("exposure_s", value, u_square / (2 * value), dof, "s")
        return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS)
    limit = float(np.sqrt(max(square, 0.0) + ONE_SIDED_95 * u_square))
    fastest = max(float(np.linalg.norm(look.speed_px_s)) for looks in usable for look in looks)
    why = f"too slow: targets are no longer along their path than {limit * fastest:.2g} px; 95 % upper limit"
    row = ("exposure_s", limit, float(np.sqrt(u_square)) / 2, dof, "s")
    limits = frozenset(["exposure_s"])
    return Estimates.from_rows([row], method=METHOD, confounders=CONFOUNDERS, limits=limits, reasons={"exposure_s": why})


def pulses_of(
    targets: Sequence[Sequence[tuple[Look, Look]]], exposure_s: float, field_s: float, stated_s: float = 0.0, below_px: float = 0.0
) -> Estimates:
    """Time between two pulses of light, and the share of steady light, from pictures in the first and in the second field.

    Parameters
    ----------
    targets : sequence of sequence of (Look, Look)
        Pictures of each target in the first and in the second field of a frame.
    exposure_s, field_s : float
        Length of the exposure of a field, and time between the fields, as found without pulses.
    stated_s : float
        The exposure that is set, at whose end the first pulse is; 0 where it was not stated.
    below_px : float
        By how much pictures in the second field lie below those in the first, of which the places are free: where rows are swapped.

    Returns
    -------
    Estimates
        ``separation_s`` and ``ambient_share`` with their covariance, or the reason why they are not told.

    Notes
    -----
    Each picture is that of the pulse and, with the share of the steady light, that of the target while it moves through the exposure: it
    lies before the first pulse, which ends the first exposure, and behind the second one. The covariance is that of the means over the
    targets; where the exposure is not as long as stated, or none was stated, u holds that the pulses may be elsewhere within it.
    """
    found, whole = [], stated_s or exposure_s
    for pairs in targets:
        moving = sorted(pairs, key=lambda pair: float(pair[0].speed_px_s @ pair[0].speed_px_s))
        moving = moving[:: max(1, -(-2 * len(moving) // MOST_PICTURES))]
        if 2 * len(moving) < LEAST_PICTURES:
            continue
        late, share = _separation(moving, 0.0), np.nan
        for _ in range(PULSE_STEPS):  # the middle of the steady light is known from the pulses
            middles = (0.5 * (late - whole), field_s - 0.5 * (whole + late))
            looks = [replace(look, steady_s=(exposure_s, m)) for pair in moving for look, m in zip(pair, middles, strict=True)]
            fit = _fitted(looks, 0.0)
            share = np.nan if fit is None else fit.square
            if fit is None:
                break
            shifts = (fit.places - np.array([look.place for look in looks])).reshape(-1, 2, 2)
            late = _separation(moving, shifts[:, 1] - shifts[:, 0] - [0.0, below_px])
        if np.isfinite(share):
            found.append((late, share))
        if len(found) == MOST_TARGETS:
            break
    names = ("separation_s", "ambient_share")
    if len(found) < LEAST_TARGETS:
        return Estimates.from_rows([], reasons=dict.fromkeys(names, f"fewer than {LEAST_TARGETS} targets that a pulse shows can be fitted"))
    values = np.array(found)
    mean, covariance, dof = values.mean(axis=0), np.cov(values.T) / len(values), float(len(values) - 1)
    doubt = abs(exposure_s / stated_s - 1) if stated_s else PLACE_U_REL
    covariance = covariance + np.diag([mean[1] * doubt * exposure_s, mean[1] * doubt]) ** 2
    u = np.sqrt(np.diag(covariance))
    reasons, limits = {}, set()
    for k, name in enumerate(names):
        if mean[k] < SIGNIFICANT * u[k]:
            mean[k] = max(mean[k], 0.0) + ONE_SIDED_95 * u[k]
            limits.add(name)
            reasons[name] = "not significantly above zero; 95 % upper limit"
    return Estimates(names, mean, covariance, np.full(2, dof), ("s", "1"), PULSED, limits=frozenset(limits), reasons=reasons)


def _separation(pairs: Sequence[tuple[Look, Look]], more: Array | float) -> float:
    """Time from the picture in the first to that in the second field, by the places and what is added to them."""
    speed = np.array([first.speed_px_s for first, _ in pairs])
    apart = np.array([second.place - first.place for first, second in pairs]) + more
    return float((speed * apart).sum() / max(float((speed**2).sum()), 1e-300))


def untold(why: str) -> Estimates:
    """No exposure, and why."""
    return Estimates((), np.zeros(0), np.zeros((0, 0)), np.zeros(0), (), METHOD, reasons={"exposure_s": why})


def _chosen(looks: Sequence[Look]) -> list[Look]:
    """Pictures of a target, evenly over all velocities where there are too many."""
    ordered = sorted(looks, key=lambda look: float(look.speed_px_s @ look.speed_px_s))
    return ordered[:: max(1, -(-len(ordered) // MOST_PICTURES))]


def _spread(targets: Sequence[Sequence[Look]]) -> float:
    """By how much the blur differs from picture to picture: range of the squares of the velocities along x, along y, and mixed."""
    v = np.array([look.speed_px_s for looks in targets for look in looks])
    squares = np.column_stack([v[:, 0] ** 2, v[:, 1] ** 2, v[:, 0] * v[:, 1]])
    largest = float((v**2).sum(axis=1).max())
    return float(np.ptp(squares, axis=0).max() / largest) if largest > 0 else 0.0


@dataclass(frozen=True)
class _Fit:
    """Square of the exposure in s² of one target (or its share of steady light), its variance by the pixels, and what single pictures add.

    ``places``, shape (looks, 2), are those of the pictures.
    """

    square: float
    variance: float
    influence: Array
    places: Array


def _joined(fits: Sequence[_Fit]) -> tuple[float, float, float]:
    """Weighted mean of the targets, its u, and degrees of freedom; targets far off are left out."""
    squares = np.array([f.square for f in fits])
    weight = 1 / np.array([f.variance for f in fits])
    off = np.abs(squares - np.median(squares)) * np.sqrt(weight)
    if len(fits) > 4:
        kept = off <= FAR_OFF * max(1.0, 1.4826 * float(np.median(off)))
        fits, squares, weight = [f for f, k in zip(fits, kept, strict=True) if k], squares[kept], weight[kept]
    mean = float(weight @ squares / weight.sum())
    variance = sum(float(w**2 * (f.influence**2).sum()) for w, f in zip(weight, fits, strict=True)) / float(weight.sum()) ** 2
    own = np.array([max(f.variance, float((f.influence**2).sum())) for f in fits])
    chi2, free = float(((squares - mean) ** 2 / own).sum()), len(fits) - 1
    ratio = chi2 / free if free > 0 and chi2 > free + SIGNIFICANT * np.sqrt(2 * free) else 1.0
    return mean, float(np.sqrt(variance * ratio)), float(sum(len(f.influence) for f in fits))


def _fitted(looks: Sequence[Look], row_time_s: float) -> _Fit | None:
    """Fit all pictures of one target; None where no ellipse does."""
    fastest = max(float(np.linalg.norm(look.speed_px_s)) for look in looks)
    start = _start(looks)
    if start is None:
        return None
    shape, local = start
    pulsed = looks[0].steady_s is not None
    shape = np.append(shape, 0.0 if pulsed else SHORTEST_PX**2)  # and the square of the longest path, px², or the share of steady light
    masks = _masks(looks, shape)
    state = _normal(looks, masks, shape, local, fastest, row_time_s)
    for _ in range(STEPS):
        if state is None:
            return None
        try:
            step = np.linalg.solve(state.normal, state.score.sum(axis=0))
        except np.linalg.LinAlgError:
            return None
        share, better = 1.0, None
        for _ in range(MOST_HALVINGS):
            new = shape + share * step
            moved = [p + share * (a - b @ step) for p, a, b in zip(local, state.own, state.coupling, strict=True)]
            if new[3] > 0.1 and min(new[0], new[1]) > 0.3 and new[0] * new[1] > new[2] ** 2:
                better = _normal(looks, masks, new, moved, fastest, row_time_s)
                if better is not None and better.cost <= state.cost * (1 + 1e-9):
                    break
            share, better = share / 2, None
        if better is None:
            break
        shape, local, state = new, moved, better
        if share == 1.0 and np.abs(step[:4]).max() < AT_REST and abs(step[4]) < 10 * AT_REST:
            break
        if not pulsed and share == 1.0 and abs(step[4]) > 0.5:
            masks = _masks(looks, shape)
            state = _normal(looks, masks, shape, local, fastest, row_time_s)
    if state is None or state.free < 1:
        return None
    inverse = np.linalg.inv(state.normal)
    noise = state.cost / state.free
    few = len(looks) / max(len(looks) - shape.size, 1)
    unit = 1.0 if pulsed else fastest**2
    places = np.array([p[:2] for p in local])
    return _Fit(shape[4] / unit, float(inverse[4, 4]) * noise / unit**2, np.sqrt(few) * (state.score @ inverse[4]) / unit, places)


def _start(looks: Sequence[Look]) -> tuple[Array, list[Array]] | None:
    """Outline and blur, and place, height and background of every picture, from the slowest of them."""
    local = []
    for look in looks:
        rows = look.values[look.parity :: 2]
        edge = np.concatenate([rows[0], rows[-1], rows[:, 0], rows[:, -1]])
        if not np.isfinite(edge).any():
            return None
        background = float(np.nanmedian(edge))
        low, high = np.nanpercentile(rows - background, [2, 98])
        height = float(high if abs(high) > abs(low) else low)
        local.append(np.array([*look.place, height, background]))
    slowest = looks[0]
    if local[0][2] == 0:
        return None
    off = (slowest.values[slowest.parity :: 2] - local[0][3]) / local[0][2]
    radius = float(np.sqrt(2 * ((off > 0.5) | np.isnan(off)).sum() / np.pi))
    fits = 0.5 < radius < 0.5 * min(slowest.values.shape) - 2
    return (np.array([radius, radius, 0.0, 1.0]), local) if fits else None


def _masks(looks: Sequence[Look], shape: Array) -> list[np.ndarray]:
    """Pixels of every picture that are fitted: those near the path of the outline."""
    fastest = max(float(np.linalg.norm(look.speed_px_s)) for look in looks)
    reach = max(shape[0], shape[1]) + BEYOND * shape[3] + 1.5
    masks = []
    for look in looks:
        half = 0.5 * look.speed_px_s / max(fastest, 1e-300) * np.sqrt(max(shape[4], 0.0))
        if look.steady_s is not None:
            half = look.speed_px_s * (0.5 * look.steady_s[0] + abs(look.steady_s[1]))
        y, x = np.indices(look.values.shape)
        dx, dy = x - look.place[0], y - look.place[1]
        along = np.clip((dx * half[0] + dy * half[1]) / max(half @ half, 1e-12), -1, 1) if half.any() else np.zeros_like(dx)
        near = np.hypot(dx - along * half[0], dy - along * half[1]) < reach
        near[1 - look.parity :: 2] = False
        near &= np.isfinite(look.values)
        masks.append(near)
    return masks


@dataclass(frozen=True)
class _State:
    """Normal equations for what the pictures of a target share, with what each picture adds to the right hand side."""

    cost: float
    free: int
    normal: Array
    score: Array
    own: list[Array]
    coupling: list[Array]


def _normal(
    looks: Sequence[Look], masks: Sequence[np.ndarray], shape: Array, local: Sequence[Array], fastest: float, row_time_s: float
) -> _State | None:
    cost, pixels, scores, own, coupling = 0.0, 0, [], [], []
    normal = np.zeros((5, 5))
    for look, mask, p in zip(looks, masks, local, strict=True):
        if not np.isfinite(p).all() or not (-3 < p[0] < look.values.shape[1] + 3 and -3 < p[1] < look.values.shape[0] + 3):
            return None
        mean, jacobian = blurred(look, shape, p, fastest, row_time_s)
        left = (look.values - mean)[mask]
        columns = jacobian[:, mask].T
        mine, shared = columns[:, [0, 1, 6, 7]], columns[:, [2, 3, 4, 5, 8]]
        square = mine.T @ mine
        try:
            alone = np.linalg.solve(square, np.column_stack([mine.T @ left, mine.T @ shared]))
        except np.linalg.LinAlgError:
            return None
        own.append(alone[:, 0])
        coupling.append(alone[:, 1:])
        free = shared - mine @ alone[:, 1:]
        normal += free.T @ free
        scores.append(free.T @ left)
        cost += float(left @ left)
        pixels += left.size
    return _State(cost, pixels - 4 * len(looks) - 5, normal, np.array(scores), own, coupling)


def blurred(look: Look, shape: Array, local: Array, fastest: float, row_time_s: float) -> tuple[Array, Array]:
    """Picture of an ellipse that moves while it is exposed, and its derivatives by x, y, outline (3), blur, height, background, square.

    Parameters
    ----------
    look : Look
    shape : ndarray, shape (5,)
        Outline (the symmetric matrix S of c + S (cos t, sin t): xx, yy, xy), blur in px, and the square of the path of the fastest picture.
    local : ndarray, shape (4,)
        Place, height, background.
    fastest : float
        Speed that the square belongs to, px/s.
    row_time_s : float
    """
    size = look.values.shape
    share = look.speed_px_s / fastest if fastest > 0 else np.zeros(2)
    outline = _sheared(shape[:3], look.speed_px_s * row_time_s)
    speed = float(np.linalg.norm(share))
    path = max(float(np.sqrt(max(shape[4], 0.0))) * speed, SHORTEST_PX if speed > 0 else 0.0)
    if look.steady_s is not None or path == 0.0:
        mean, jacobian = model("ellipse", np.array([*local[:2], *outline, shape[3], *local[2:]]), *size)
        if look.steady_s is None or speed == 0.0:
            return mean, np.concatenate([jacobian, np.zeros((1, *size))])
        length, after = look.steady_s
        steady = replace(look, steady_s=None)
        # by the path of its own, which is known
        known = np.append(shape[:4], (length * float(np.linalg.norm(look.speed_px_s)) / speed) ** 2)
        there = np.concatenate([local[:2] + after * look.speed_px_s, local[2:]])
        other, by_other = blurred(steady, known, there, fastest, row_time_s)
        share_of = float(shape[4])
        mixed = (1 - share_of) * jacobian + share_of * by_other[:8]
        return (1 - share_of) * mean + share_of * other, np.concatenate([mixed, (other - mean)[None]])
    nodes, weights = np.polynomial.legendre.leggauss(2 + int(np.ceil(path / shape[3])))
    direction = share / speed
    mean, jacobian, by_path = np.zeros(size), np.zeros((8, *size)), np.zeros(size)
    for node, weight in zip(0.5 * nodes, 0.5 * weights, strict=True):
        one, by = model("ellipse", np.array([*(local[:2] + node * path * direction), *outline, shape[3], *local[2:]]), *size)
        mean += weight * one
        jacobian += weight * by
        by_path += weight * node * (direction[0] * by[0] + direction[1] * by[1])
    by_square = by_path / (2 * path)  # of path², of this picture
    mean += (shape[4] * speed**2 - path**2) * by_square  # 0 but for the shortest paths
    return mean, np.concatenate([jacobian, by_square[None] * speed**2])


def _sheared(outline: Array, per_row: Array) -> Array:
    """The outline of an ellipse whose rows are shifted by ``per_row`` px each."""
    if not per_row.any():
        return outline
    s = np.array([[outline[0], outline[2]], [outline[2], outline[1]]])
    m = np.array([[1.0, per_row[0]], [0.0, 1.0 + per_row[1]]])
    values, vectors = np.linalg.eigh(m @ s @ s @ m.T)
    root = (vectors * np.sqrt(np.maximum(values, 1e-12))) @ vectors.T
    return np.array([root[0, 0], root[1, 1], root[0, 1]])
