"""Covered columns and rows: what they show of charge left behind, smear, droop of the line, and noise of whole rows and columns.

Behind the last lit column nothing but late charge comes: of a wide lit area the first covered pixel shows 1 − (1 − ε)^n of a packet
after n transfers, whatever the trail's length (extended pixel edge response, J. R. Janesick, Scientific Charge-Coupled Devices, SPIE
Press 2001, ch. 5). Covered rows show smear, in proportion to the light of the whole column. The line of an AC-coupled camera ends lower,
the more light it held.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pixmetry.camera.covered import Covered
from pixmetry.camera.observations import CoveredPixels, Trail
from pixmetry.core.arrays import Array, Singles
from pixmetry.core.number import ONE_SIDED_95, Estimates

LEAST_DEPTH = 6  # covered columns, or rows, behind each other: the farther half is the reference of the nearer one
LIT = 4  # columns, or rows, whose mean is the light beside the border
LEAST_FRAMES = 2
LEAST_NOISE_DN = 0.4  # of covered rows, below which rounding does not average out
NOT_SIGNIFICANT = 3.0
CLIPPED_SHARE = 0.01
LEAST_CONTRAST = 0.05  # of the light, between columns, from which on smear is told from stray light
EPER = "extended pixel edge response: first covered pixel over the light beside it, −ln(1 − x₁/S)/n"
RISE_SIGMAS = 5.0  # of the scatter of the columns, or rows, beside the border
AXES = ("columns", "rows")
MOST_FULL = 0.9  # of the level at which pixels are full, up to which bright frames tell late charge
LEAST_BEFORE = 2  # covered pixels before the light, from which on what leaks under the cover is told from late charge
UNLIKE = 0.1  # by how much the leak may differ from border to border
SAME_BLUR = 0.25  # share of the trail that may also be missing at the near border, where no charge is late


@dataclass(frozen=True)
class _Frame:
    """Means of one stored frame: of every column over the lit rows, of every row over the lit columns; and its covered blocks."""

    columns: Array  # shape (stored columns,)
    rows: Array  # shape (stored rows,)
    left: Singles  # shape (lit rows, left)
    right: Singles
    top: Singles  # shape (top, lit columns)
    bottom: Singles
    clipped: float  # share of the covered pixels at code 0

    @classmethod
    def of(cls, stored: np.ndarray, covered: Covered) -> _Frame:
        rows, cols = covered.active(stored.shape)
        blocks = [stored[rows, : covered.left], stored[rows, cols.stop :], stored[: covered.top, cols], stored[rows.stop :, cols]]
        count = sum(block.size for block in blocks)
        at_end = sum(int((block == 0).sum()) for block in blocks)
        means = stored[rows].mean(axis=0), stored[:, cols].mean(axis=1)
        left, right, top, bottom = (block.astype(np.float32) for block in blocks)
        return cls(means[0], means[1], left, right, top, bottom, at_end / max(count, 1))


@dataclass
class BorderFrames:
    """The covered pixels of one group, and the means over rows and columns of its frames."""

    kind: str
    exposure_s: float
    covered: Covered
    frames: dict[int, _Frame] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, index: int, stored: np.ndarray) -> None:
        """Take the borders of a stored frame."""
        found = _Frame.of(stored, self.covered)
        with self._lock:
            self.frames[index] = found

    def in_order(self) -> list[_Frame]:
        """The frames by their index."""
        return [self.frames[i] for i in sorted(self.frames)]


def covered_pixels(
    groups: Sequence[BorderFrames], analogue: bool, gain_dn_per_e: float | None, saturation_dn: float = np.inf
) -> CoveredPixels | None:
    """What the covered pixels of all groups tell; None without any.

    Parameters
    ----------
    groups : sequence of BorderFrames
    analogue : bool
        Whether a video line is behind the sensor, whose filters have trails of their own along the rows.
    gain_dn_per_e : float or None
        From which the shot noise of late charge follows.
    saturation_dn : float
        Level above black at which pixels are full. Full pixels spill charge under the cover.

    Returns
    -------
    CoveredPixels or None
    """
    groups = [g for g in groups if g.frames]
    if not groups:
        return None
    covered = groups[0].covered
    notes = []
    if max(frame.clipped for g in groups for frame in g.frames.values()) > CLIPPED_SHARE:
        notes.append("covered pixels are clipped at code 0: raise the black level; nothing is measured from them")
        clipped = {name: notes[0] for name in (*SERIAL, *PARALLEL, "droop_rel", "smear_s")}
        return CoveredPixels(covered, Estimates.from_rows([], reasons=clipped), (), (), tuple(notes))
    dark = [g for g in groups if g.kind == "dark"]
    lit = [g for g in groups if g.kind != "dark" and len(g.frames) >= LEAST_FRAMES]
    if not dark:
        need = "needs dark frames: covered pixels have offsets of their own"
        no_dark = dict.fromkeys((*SERIAL, *PARALLEL, "droop_rel", "smear_s"), need)
        return CoveredPixels(covered, Estimates.from_rows([], reasons=no_dark), (), (), ())
    zero = _mean(dark)
    flat = [g for g in lit if g.kind == "bright"]
    found: list[tuple[str, float, float, float, str]] = []
    limits: set[str] = set()
    reasons: dict[str, str] = {}
    trails = []
    below = _not_full(flat, zero, covered, saturation_dn)
    for names, (axis, (depth, before)) in zip((SERIAL, PARALLEL), _depths(covered).items(), strict=True):
        trail = _trail(below, zero, depth, before, axis, gain_dn_per_e)
        if isinstance(trail, str):
            reasons |= dict.fromkeys(names, trail)
            continue
        trails.append(trail)
        doubt = _doubt(trail, below, zero, covered, analogue)
        if doubt:
            reasons |= dict.fromkeys(names, doubt)
            continue
        _told(trail, names, found, limits, reasons)
    lengths = [row for row in found if row[0] in (SERIAL[1], PARALLEL[1])]
    if lengths:
        found.append(("trail_px", *min(lengths, key=lambda row: row[2] / row[1])[1:]))
    for name, unit, value in (
        ("droop_rel", "1", _droop(flat, zero, covered, analogue)),
        ("smear_s", "s", _smear(lit, zero, covered, next((t for t in trails if t.axis == "rows"), None))),
    ):
        if isinstance(value, str):
            reasons[name] = value
        else:
            amount, u, why = value
            if amount > NOT_SIGNIFICANT * u:
                found.append((name, amount, u, np.inf, unit))
            else:
                limit = max(amount, 0.0) + ONE_SIDED_95 * u
                found.append((name, limit, limit / 12**0.5, np.inf, unit))
                limits.add(name)
                why = f"not significant; 95 % upper limit. {why}".strip()
            if why:
                reasons[name] = why
    lines = [_line_noise(g) for g in groups]
    fit = Estimates.from_rows(found, method=EPER, limits=frozenset(limits), reasons=reasons, confounders=CONFOUNDERS)
    return CoveredPixels(covered, fit, tuple(trails), tuple(line for line in lines if line is not None), tuple(notes))


SERIAL = ("serial_cti", "serial_trail_px")
PARALLEL = ("parallel_cti", "parallel_trail_px")
CONFOUNDERS = (
    "sensor.infrared_diffusion and light under the cover beside the lit area: they do not grow with the distance from the output",
    "grabber.low_pass, electronics.video_amplifier, cable.termination, processing.noise_reduction: they have trails along the rows",
)


def _mean(groups: Sequence[BorderFrames]) -> _Zero:
    """Mean columns and rows of all frames of some groups."""
    frames = [frame for g in groups for frame in g.in_order()]
    means = {name: np.mean([getattr(frame, name) for frame in frames], axis=0) for name in ("columns", "rows")}
    return _Zero(means["columns"], means["rows"], len(frames))


@dataclass(frozen=True)
class _Zero:
    """What the dark frames show: means of the columns and of the rows of some frames."""

    columns: Array
    rows: Array
    frames: int

    def along(self, axis: str) -> Array:
        """Those of one axis."""
        return self.columns if axis == "columns" else self.rows


def _depths(covered: Covered) -> dict[str, tuple[int, int]]:
    """Covered pixels behind the light and before it, by axis."""
    return dict(zip(AXES, ((covered.right, covered.left), (covered.bottom, covered.top)), strict=True))


def _light(group: BorderFrames, zero: _Zero, axis: str, covered: Covered) -> Array:
    """Mean columns or rows of the lit part, above black."""
    after, before = _depths(covered)[axis]
    profile = np.mean([getattr(frame, axis) for frame in group.in_order()], axis=0) - zero.along(axis)
    return np.asarray(profile[before : len(profile) - after], float)


def _not_full(flat: Sequence[BorderFrames], zero: _Zero, covered: Covered, saturation_dn: float) -> list[BorderFrames]:
    """The bright frames below saturation: full pixels spill charge under the cover.

    Where the light grows by the exposure, a level from which it grows less than before, by a tenth, is full, and so are all above it.
    """
    kept = [g for g in flat if max(float(_light(g, zero, axis, covered).max()) for axis in AXES) < MOST_FULL * saturation_dn]
    kept.sort(key=lambda g: g.exposure_s)
    time = np.array([g.exposure_s for g in kept])
    if len(kept) < 4 or not (np.diff(time) > 0).all():
        return kept
    growth = np.diff([float(_light(g, zero, "rows", covered).mean()) for g in kept]) / np.diff(time)
    slower = np.flatnonzero(growth < MOST_FULL * np.median(growth))
    return kept if not len(slower) else kept[: int(slower[0]) + 1]


def _leak(profiles: Array, before: int) -> Array:
    """Light of the covered pixel before the lit ones, over the mean of the lit ones beside it; by frame, shape (frames,).

    No charge is late there: it is blur, light under the cover, or charge that the full pixel beside it repels. As much of that is in the
    first covered pixel behind the light.
    """
    own = profiles[:, before - 1] - profiles[:, : before - 1].mean(axis=1)
    return np.asarray(own / np.maximum(profiles[:, before : before + LIT].mean(), 1e-9), float)


def _trail(flat: Sequence[BorderFrames], zero: _Zero, depth: int, before: int, axis: str, gain: float | None) -> Trail | str:
    side = {"columns": "right: 16", "rows": "bottom: 16"}[axis]
    if depth < LEAST_DEPTH:
        return f"needs {LEAST_DEPTH} covered {axis} or more farthest from the output (covered: {{{side}}}); {depth} are stated"
    if not flat:
        return "needs bright frames, two or more of a level, whose pixels are not full"
    first = len(zero.along(axis)) - depth
    near = depth // 2
    levels = []
    leaks = []
    for g in flat:
        profiles = np.array([getattr(frame, axis) for frame in g.in_order()]) - zero.along(axis)
        reference = profiles[:, first + near :].mean(axis=1)
        beside = profiles[:, first - LIT : first].mean(axis=1) - reference
        trail = profiles[:, first : first + near] - reference[:, None]
        if before >= LEAST_BEFORE:
            leaked = _leak(profiles, before) * beside.mean()
            trail[:, 0] -= leaked
            leaks.append(float(leaked.mean()))
        scatter = trail.std(axis=0, ddof=1) / np.sqrt(len(trail)) if len(trail) > 1 else np.full(near, np.nan)
        levels.append((float(beside.mean()), trail.mean(axis=0), scatter, len(trail)))
    signal = np.array([level[0] for level in levels])
    trails = np.array([level[1] for level in levels])
    dof = sum(level[3] - 1 for level in levels)
    pooled = np.sqrt(sum((level[2] ** 2 * level[3]) * (level[3] - 1) for level in levels) / dof)  # of one frame
    lines = len(zero.along("rows" if axis == "columns" else "columns"))
    if gain is None:
        each = np.array([pooled / np.sqrt(level[3]) for level in levels])
    else:  # the noise of the dark, from all of them, and the shot noise of the late charge
        shot = gain * np.maximum(trails, 0.0) / lines
        base = max(float((pooled**2 - shot.mean(axis=0)).mean()), 0.2 * float((pooled**2).mean()))
        pooled = np.full(near, np.sqrt(base))
        each = np.sqrt((base + shot) / np.array([level[3] for level in levels])[:, None])
    of_dark = 1.0
    if leaks:  # the noise of two more means in the first pixel
        each[:, 0] = np.sqrt(each[:, 0] ** 2 + each[:, -1] ** 2 * (1 + 1 / (before - 1)))
        of_dark = np.sqrt(1 + (1 + 1 / (before - 1)))
    if not (signal > 10 * each[:, 0]).any():
        return "the bright frames have too little light beside the covered border"
    weight = signal / each.T**2
    shape = (weight * trails.T).sum(axis=1) / (weight * signal).sum(axis=1)
    u_shape = 1 / np.sqrt((signal**2 / each.T**2).sum(axis=1))
    # the dark reference is the same for all levels
    u_dark = float(pooled[0] / np.sqrt(zero.frames)) * float((weight[0]).sum() / (weight[0] * signal).sum())
    left = (trails[:, 0] - shape[0] * signal) / each[:, 0]
    strong = signal > np.median(signal)
    bent = float((left[strong].sum() - left[~strong].sum()) / np.sqrt(len(left))) if len(left) > 3 else 0.0
    u_shape = np.hypot(u_shape, u_dark * np.append(of_dark, np.ones(near - 1)))
    if leaks:  # the two borders of the cover need not be alike
        weights = weight[0] * signal
        u_shape[0] = float(np.hypot(u_shape[0], UNLIKE * float(np.average(np.array(leaks) / signal, weights=weights))))
    length, u_length, whole = _length_of(shape, u_shape, depth)
    share, u_share = float(shape[0]) / whole, float(u_shape[0]) / whole
    return Trail(axis, signal, trails[:, 0], each[:, 0], share, u_share, shape, u_shape, length, u_length, first, bent)


def _length_of(shape: Array, u_shape: Array, depth: int) -> tuple[float, float, float]:
    """Mean length t of a trail that falls by 1 − 1/t from pixel to pixel, its u, and the part of the first pixel that is seen.

    The farther pixels, which are the reference, hold the end of the trail themselves.
    """
    from scipy.optimize import brentq

    near = len(shape)

    def rest(t: float) -> float:
        return float(((1 - 1 / t) ** np.arange(near, depth)).mean())

    def total(t: float) -> float:
        k = (1 - 1 / t) ** np.arange(near)
        return float((k - rest(t)).sum() / (1 - rest(t)))

    if shape[0] <= 0:
        return 1.0, np.inf, 1.0
    seen = float(shape.sum() / shape[0])
    u_seen = float(np.sqrt((u_shape[1:] ** 2).sum() + ((seen - 1) * u_shape[0]) ** 2) / shape[0])
    longest = 0.5 * depth
    if seen >= total(longest):
        return longest, np.inf, 1 - rest(longest)
    t = 1.0 if seen <= 1 else float(brentq(lambda v: total(v) - seen, 1.0, longest))
    slope = (total(t + 0.02) - total(t)) / 0.02
    return t, u_seen / slope, 1 - rest(t)


def _doubt(trail: Trail, flat: Sequence[BorderFrames], zero: _Zero, covered: Covered, analogue: bool) -> str:
    """Why a trail is no charge left behind; empty if nothing speaks against it."""
    if trail.share < NOT_SIGNIFICANT * trail.u_share:
        return ""
    before = _depths(covered)[trail.axis][1]
    if before < 1:
        if analogue and trail.axis == "columns":
            return "the filters of a video line have trails too: needs covered columns on the left as well, where no charge is late"
        return ""
    missing, weight, scatter = [], [], []
    for g in flat:
        profiles = np.array([getattr(frame, trail.axis) for frame in g.in_order()]) - zero.along(trail.axis)
        leaked = float(_leak(profiles, before).mean()) if before >= LEAST_BEFORE else 0.0
        profile = profiles.mean(axis=0)
        own = profile[before : before + 9]
        beyond = np.arange(3, 9)
        line = np.polyfit(beyond, own[3:9], 1)
        expected = float(line[1])
        scatter.append(float(np.std(own[3:9] - np.polyval(line, beyond), ddof=2)) / max(expected, 1e-9))
        missing.append((expected - own[0]) / max(expected, 1e-9) - max(leaked, 0.0))
        weight.append(max(expected, 0.0) ** 2)
    share = float(np.average(missing, weights=weight))
    if share > SAME_BLUR * trail.share + RISE_SIGMAS * float(np.median(scatter)):
        return (
            f"the light rises as slowly at the border next to the output ({100 * share:.2g} % are missing) as it falls at the other: the "
            "trail is that of a filter, of the video line or of light under the cover, and charge left behind is not told from it"
        )
    return ""


def _told(
    trail: Trail, names: tuple[str, str], found: list[tuple[str, float, float, float, str]], limits: set[str], reasons: dict[str, str]
) -> None:
    """Inefficiency and length of a trail: value or limit."""
    cti, length = names
    per = (1 - trail.share) * trail.transfers
    if trail.share > NOT_SIGNIFICANT * trail.u_share:
        found.append((cti, float(-np.log1p(-trail.share) / trail.transfers), trail.u_share / per, np.inf, "1"))
        if trail.u_length_px < 0.3 * trail.length_px:
            found.append((length, trail.length_px, trail.u_length_px, np.inf, "px"))
        else:
            reasons[length] = "the trail is too faint for its length: take more frames"
        if abs(trail.bent) > NOT_SIGNIFICANT + 1:
            reasons[cti] = (
                "the share is not the same for all levels: traps that fill, or a loss that depends on the packet; the value is their mean"
            )
        return
    limit = max(trail.share, 0.0) + ONE_SIDED_95 * trail.u_share
    value = float(-np.log1p(-limit) / trail.transfers)
    found.append((cti, value, value / 12**0.5, np.inf, "1"))
    limits.add(cti)
    reasons[cti] = "no charge behind the lit area; 95 % upper limit"


def _droop(flat: Sequence[BorderFrames], zero: _Zero, covered: Covered, analogue: bool) -> tuple[float, float, str] | str:
    """Share of a constant level that is lost until the end of the line: the end of the line against its start, over levels of light."""
    if not analogue:
        return "only an AC-coupled line droops: the camera is not analogue"
    if covered.right < LEAST_DEPTH or covered.left < 1:
        return f"needs covered columns at both ends of the line: left: 1 or more, right: {LEAST_DEPTH} or more"
    if not flat:
        return "needs bright frames, two or more of a level"
    cols = len(zero.columns)
    far = covered.right // 2
    x, y, u = [], [], []
    for g in flat:
        profiles = np.array([frame.columns for frame in g.in_order()]) - zero.columns
        fall = profiles[:, : covered.left].mean(axis=1) - profiles[:, -far:].mean(axis=1)
        x.append(float(profiles[:, covered.left : cols - covered.right].mean() - profiles[:, : covered.left].mean()))
        y.append(float(fall.mean()))
        u.append(float(fall.std(ddof=1) / np.sqrt(len(fall))))
    light, fallen = np.array(x), np.array(y)
    counts = float(np.mean([len(g.frames) for g in flat]))
    each = np.full(len(light), np.sqrt(np.mean(np.square(u))))
    slope = float((light * fallen).sum() / (light**2).sum())
    error = float(np.sqrt(((light * each) ** 2).sum()) / (light**2).sum()) * float(np.sqrt(1 + len(light) * counts / zero.frames))
    lit, after = cols - covered.left - covered.right, covered.right - 0.5 * far
    droop = slope  # what is lost over the lit part, and given back a little over the covered one
    for _ in range(20):
        left = np.log1p(-min(max(droop, -0.5), 0.9)) / cols
        lost = -np.expm1(left * lit)
        seen = lost * np.exp(left * after) / (lost / (-left * lit) if left else 1.0)  # over the mean of the lit part, which sinks too
        droop += (slope - seen) * cols / lit
    return float(droop), error * cols / lit, "the first lines of a field, if the clamp restores black slowly, are counted with the others"


def _smear(lit: Sequence[BorderFrames], zero: _Zero, covered: Covered, late: Trail | None) -> tuple[float, float, str] | str:
    """Light that a covered row takes up, over the sum of its column: slope over the columns, so that stray light has no part."""
    sides = {"top": covered.top, "bottom": covered.bottom}
    if max(sides.values()) < 1:
        return "needs covered rows (covered: {bottom: 8})"
    best: tuple[float, float, str] | str = "needs pictures with light and dark columns (kind: covered), to tell smear from stray light"
    for g in lit:
        frames = g.in_order()
        columns = np.mean([frame.columns for frame in frames], axis=0) - zero.columns
        light = columns[covered.left : len(columns) - covered.right]
        rows = len(zero.rows) - covered.top - covered.bottom
        if light.mean() <= 0 or light.std() < LEAST_CONTRAST * light.mean():
            continue
        x = light - light.mean()
        slopes: dict[str, tuple[float, float]] = {}
        for side, depth in sides.items():
            if depth:
                far = slice(depth // 2 if depth > 3 else 0, None) if side == "bottom" else slice(None, max(depth // 2, 1))
                block = np.mean([getattr(frame, side)[far] for frame in frames], axis=0)  # light leaks under the cover beside the light
                level = block.mean(axis=0)
                y = level - level.mean()
                slope = float(x @ y / (x @ x)) / rows
                left = y - slope * rows * x
                u = float(np.sqrt((left @ left) / (len(x) - 2) / (x @ x))) / rows
                if max(float(np.std(getattr(frame, side))) for frame in frames) < LEAST_NOISE_DN:
                    # rounding hides as much in all columns
                    u = float(np.hypot(u, np.sqrt(len(x) / 12 / (x @ x)) / rows))
                if side == "bottom" and late is not None:  # the end of the trail of late charge is in these rows, too
                    end = float(((1 - 1 / late.length_px) ** np.arange(depth // 2 if depth > 3 else 0, depth)).mean()) / rows
                    slope, u = slope - max(late.share, 0.0) * end, float(np.hypot(u, late.u_share * end))
                slopes[side] = slope, u
        seen = {side: s for side, (s, u) in slopes.items() if s > NOT_SIGNIFICANT * u}
        side = max(slopes, key=lambda name: slopes[name][0] / slopes[name][1])
        slope, u = slopes[side]
        every = len(seen) == len(slopes)
        grown = 1 - slope * rows if every else 1 - 0.5 * slope * rows
        share = slope / grown * rows * g.exposure_s
        where = (
            ""
            if every or not seen
            else f"only the rows at the {side} take it up: charge passes the light on its way to one side (rows: passed)"
        )
        value = (share, u / grown**2 * rows * g.exposure_s, where)
        if g.exposure_s and (isinstance(best, str) or value[1] < best[1]):
            best = value
        elif not g.exposure_s:
            best = best if not isinstance(best, str) else "needs the exposure time of the pictures with light and dark columns"
    return best


def _line_noise(group: BorderFrames) -> tuple[float, float, float] | None:
    """Signal-free noise common to the rows of covered columns: exposure, its standard deviation in DN, and u; None without any.

    Two-way analysis of variance of each frame's difference from the mean: σ_r² = (MS_row − MS_within)/n.
    """
    frames = group.in_order()
    blocks = np.array([np.concatenate([frame.left, frame.right], axis=1) for frame in frames])
    if blocks.shape[2] < 2 or len(frames) < LEAST_FRAMES:
        return None
    change = blocks - blocks.mean(axis=0)
    change = change - change.mean(axis=(1, 2), keepdims=True)
    if not change.any():
        return None
    more, n = len(frames) / (len(frames) - 1.0), change.shape[2]
    rows = change.mean(axis=2)
    of_rows = more * n * float((rows**2).mean()) * rows.shape[1] / (rows.shape[1] - 1)
    within = more * float(((change - rows[:, :, None]) ** 2).mean()) * n / (n - 1)
    square = (of_rows - within) / n
    u = of_rows / n * np.sqrt(2 / ((len(frames) - 1) * (rows.shape[1] - 1)))
    return group.exposure_s, float(np.sqrt(max(square, 0.0))), float(u / (2 * np.sqrt(max(square, u))))


def row_and_column_offsets(stored: np.ndarray, covered: Covered, left_alone: bool = False) -> dict[str, Array]:
    """Offset of each lit row, and of each lit column, by the covered pixels of the same frame, in DN.

    Each is the mean of the covered pixels of its row less that of all, times w = σ²/(σ² + σ_w²/n): the share that is not the noise of these
    pixels themselves. An offset that is none is so not made worse.

    Parameters
    ----------
    stored : ndarray, shape (stored rows, stored cols)
    covered : Covered
    left_alone : bool
        Whether the line sinks behind light, so that only columns before it tell the row's offset.

    Returns
    -------
    dict of ndarray
        ``row_offset_dn``, shape (rows,), and ``column_offset_dn``, shape (cols,), as far as there are two covered pixels for each.
    """
    rows, cols = covered.active(stored.shape)
    data = stored.astype(np.float64)
    right = data[rows, cols.stop :]
    before = data[rows, : covered.left]
    side = before if left_alone else np.concatenate([before, right[:, _after_trail(covered.right) :]], axis=1)
    bottom = data[rows.stop :, cols]
    ends = np.concatenate([data[: covered.top, cols], bottom[_after_trail(covered.bottom) :]], axis=0)
    found = {}
    for name, block in (("row_offset_dn", side), ("column_offset_dn", ends.T)):
        if block.shape[1] >= 2:
            found[name] = _shrunk(block)
    return found


def _after_trail(depth: int) -> int:
    """Covered pixels next to the light that may hold late charge; they are left out where there are enough others."""
    return depth // 2 if depth >= LEAST_DEPTH else 0


def _shrunk(block: Array) -> Array:
    """Means of the rows of a block about their mean, shrunk by the noise of its pixels."""
    n = block.shape[1]
    own = block - block.mean(axis=0)
    means = own.mean(axis=1)
    within = float(((own - means[:, None]) ** 2).sum() / ((len(own) - 1) * (n - 1)))
    between = float((means**2).sum() / (len(own) - 1))
    share = max(1 - within / n / between, 0.0) if between > 0 else 0.0
    return np.asarray(share * means, np.float64)
