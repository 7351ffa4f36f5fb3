"""Upright lines and edges in several frames, reduced to the place of every row of every frame.

A row that is sampled late shows all lines of that row shifted alike. Lines are found in the mean image; what is measured is by how much a
row differs from its own mean over the frames. So the shape of the line, its straightness and the fixed pattern of the pixels have no
part in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pixmetry.camera.observations import LineRows, RefusedLine, RowPlaces
from pixmetry.core.arrays import Array
from pixmetry.observe.edges import StepChains, robust_slope, step_chains
from pixmetry.observe.experiment import PictureGroup

LEAST_FRAMES, LEAST_ROWS = 4, 40
MOST_SLOPE = 0.2  # columns per row
MOST_BYTES = 1 << 28  # of the frames of a group that are kept
NARROW_PX = 8.0  # two steps of opposite sign that are nearer to each other are one line
LEAST_HALF_PX, MOST_HALF_PX = 4, 12  # of the window on a step; a line's is wider by its width
FLANK_PX = 7  # pixels to each side of the window that tell its offset and the noise
LAGS, FAR_LAG = 5, 3  # the noise of pixels as far apart as the second, up to the first, is alike only as far as that of the whole row is
STANDS_OUT = 3.0  # of its own chance
FLAT_SIGMAS = 0.5  # of a pixel's noise, by which the mean of a flat part may vary
LEAST_SNR = 15.0  # height over noise
CLIPPED_SHARE = 0.01  # of the rows
MOST_ORDER = 3  # of the polynomial that a line's columns follow over the rows
NOISE_REL = 0.01  # of the variance that the noise gives to a place: what the noise at the line may differ from that beside it
UNKNOWN_REL = 0.5  # the same where the shot noise of a line's light is not known, or how far neighbours are correlated


@dataclass
class LineFrames:
    """The frames of a group, as far as memory is to hold them."""

    kept: dict[int, np.ndarray] = field(default_factory=dict)
    left_out: int = 0

    def add(self, frame: np.ndarray, index: int) -> None:
        """Keep a frame."""
        if (index + 1) * frame.nbytes <= MOST_BYTES or index < LEAST_FRAMES:
            self.kept[index] = frame
        else:
            self.left_out += 1

    def stack(self) -> np.ndarray:
        """The frames in their order, shape (frames, rows, cols)."""
        return np.stack([self.kept[i] for i in sorted(self.kept)])


@dataclass(frozen=True)
class _Feature:
    """A line or an edge in the mean image: its column in each row."""

    kind: str
    row: np.ndarray
    centre: Array
    width_px: float
    free_px: float


class _Refused(Exception):
    """Why a line cannot be measured."""


def places_of_rows(groups: Sequence[PictureGroup], gain_dn_per_e: float | None) -> LineRows:
    """The place of every row of every frame, along each upright line or edge of the pictures.

    Parameters
    ----------
    groups : sequence of PictureGroup
        With `LineFrames`.
    gain_dn_per_e : float or None
        From which the shot noise of a bright line follows; of an edge it is that of its two sides.

    Returns
    -------
    LineRows

    Notes
    -----
    Of an edge, with Δ the difference of a row from its mean over the frames, the shift is −Σ Δ/(height) over a window on the step; of a
    line it is Σ (x − x₀) Δ/(area). Both have the gain 1 for a delay behind any linear filter that leaves nothing at the pixel clock,
    whatever the shape, as the sum of a derivative is the difference of its ends; a fit of the shape has not. Pixels beside the window take
    out what the whole row has in common. The u of a place is that of this sum by the noise beside the line, with the correlation of
    neighbours.
    """
    found: list[RowPlaces] = []
    refused: list[RefusedLine] = []
    notes: list[str] = []
    for number, group in enumerate(groups):
        sums = group.sums
        assert isinstance(sums, LineFrames)
        if sums.left_out:
            notes.append(f"picture {number + 1} of lines: {sums.left_out} frames were left out, for want of memory")
        if len(sums.kept) < LEAST_FRAMES:
            more = LEAST_FRAMES - len(sums.kept)
            notes.append(f"picture {number + 1} of lines has {len(sums.kept)} frames: take {more} more (16 are better), the camera at rest")
            continue
        frames = sums.stack()
        mean = frames.mean(axis=0).astype(np.float32)
        for feature in _features(mean):
            try:
                found.append(_places(frames, mean, feature, number, 2.0**group.bits - 1, gain_dn_per_e))
            except _Refused as why:
                x, y = float(np.median(feature.centre)), float(np.median(feature.row))
                refused.append(RefusedLine(number, feature.kind, x, y, len(feature.row), str(why)))
    recorded = tuple(bool(group.facts.recorded) for group in groups)
    return LineRows(tuple(found), tuple(refused), recorded, notes=tuple(notes))


def _features(mean: np.ndarray) -> list[_Feature]:
    """Lines and edges of an image: chains of steps, two of opposite sign and near each other as one line."""
    chains = step_chains(mean)
    own = [_followed(chains, int(c)) for c in chains.long]
    kept = sorted((f for f in own if f is not None), key=lambda f: float(np.median(f[1])))
    features: list[_Feature] = []
    used: set[int] = set()
    for i, (row, col, rising) in enumerate(kept):
        if i in used:
            continue
        partner = next((j for j in range(i + 1, len(kept)) if kept[j][2] != rising and _apart(kept[i], kept[j]) < NARROW_PX), None)
        if partner is None:
            features.append(_Feature("edge", row, col, 0.0, np.inf))
            continue
        used.add(partner)
        both, at, at_other = np.intersect1d(row, kept[partner][0], return_indices=True)
        width = float(np.median(kept[partner][1][at_other] - col[at]))
        features.append(_Feature("line", both, 0.5 * (col[at] + kept[partner][1][at_other]), width, np.inf))
    return [_with_room(f, [o for o in features if o is not f], mean.shape[1]) for f in features]


def _followed(chains: StepChains, number: int) -> tuple[np.ndarray, Array, bool] | None:
    """Rows, smooth columns and sign of a chain that is long and upright enough; None of any other."""
    row, col = chains.steps(number)
    if len(row) < LEAST_ROWS or abs(robust_slope(row, col)) > MOST_SLOPE:
        return None
    rows = np.arange(row[0], row[-1] + 1)
    t = (row - row.mean()) / max(np.ptp(row) / 2, 1)
    good = np.ones(len(row), bool)
    line = np.zeros(1)
    for _ in range(3):
        line = np.polynomial.polynomial.polyfit(t[good], col[good], MOST_ORDER)
        off = np.abs(col - np.polynomial.polynomial.polyval(t, line))
        good = off <= max(4 * float(np.median(off)), 0.3)
    smooth = np.polynomial.polynomial.polyval((rows - row.mean()) / max(np.ptp(row) / 2, 1), line)
    return rows, smooth, bool(chains.size[chains.order[chains.start[number]]] > 0)


def _apart(one: tuple[np.ndarray, Array, bool], other: tuple[np.ndarray, Array, bool]) -> float:
    both, a, b = np.intersect1d(one[0], other[0], return_indices=True)
    return float(np.abs(one[1][a] - other[1][b]).mean()) if len(both) >= LEAST_ROWS else np.inf


def _with_room(feature: _Feature, others: Sequence[_Feature], cols: int) -> _Feature:
    """A feature with the distance to the nearest other, or to the border of the frame."""
    half = 0.5 * feature.width_px
    room = min(float(feature.centre.min()), cols - 1 - float(feature.centre.max())) - half
    for other in others:
        both, a, b = np.intersect1d(feature.row, other.row, return_indices=True)
        if len(both):
            room = min(room, float(np.abs(feature.centre[a] - other.centre[b]).min()) - half - 0.5 * other.width_px - 3)
    return _Feature(feature.kind, feature.row, feature.centre, feature.width_px, room)


def _places(frames: np.ndarray, mean: np.ndarray, f: _Feature, number: int, top: float, gain: float | None) -> RowPlaces:
    """Shift and u of every row of one feature, or why not."""
    half = _half_window(mean, f)
    need = half - int(0.5 * f.width_px) + FLANK_PX + 1
    if f.free_px < need:
        raise _Refused(f"another line or the border is {max(f.free_px, 0):.0f} px away (at least {need})")
    at = np.rint(f.centre).astype(int)
    reach = half + FLANK_PX
    cols = at[:, None] + np.arange(-reach, reach + 1)
    pixels = frames[:, f.row[:, None], cols].astype(np.float64)
    bad = ((pixels <= 0) | (pixels >= top)).any(axis=(0, 2))
    if bad.mean() > CLIPPED_SHARE:
        raise _Refused(f"{100 * bad.mean():.0f} % of its rows hold clipped values")
    row, at, pixels = f.row[~bad], at[~bad], pixels[:, ~bad]
    profile = pixels.mean(axis=0)
    x = np.arange(-reach, reach + 1)
    inside, left, right = np.abs(x) <= half, x < -half, x > half
    low, high = profile[:, left].mean(axis=1), profile[:, right].mean(axis=1)
    ends = (
        0.5 * (profile[:, x == half] + profile[:, x == half + 1])[:, 0],
        0.5 * (profile[:, x == -half] + profile[:, x == -half - 1])[:, 0],
    )
    line = f.kind == "line"
    level = 0.5 * (low + high)
    size = (profile[:, inside] - level[:, None]).sum(axis=1) if line else ends[0] - ends[1]
    weights = np.where(inside, x if line else -1.0, 0.0).astype(float)
    flank = left | right
    if line:  # neither an offset of the row nor a slope of it
        weights[flank] -= float(weights @ x) / float((x[flank] ** 2).sum()) * x[flank]
    else:
        weights[flank] -= weights.sum() / flank.sum()
    scale = np.median(size)
    if scale == 0 or (size * np.sign(scale) < 0.5 * abs(scale)).mean() > CLIPPED_SHARE:
        raise _Refused("its height changes too much along it")
    size = _smooth(row, size)
    change = pixels - profile
    more = len(frames) / (len(frames) - 1.0)
    beside = 0.5 * more * sum(_noise_of_sum(change[:, :, side], weights) for side in (left, right))
    u_rel = float(np.hypot(NOISE_REL, 2 / np.sqrt(FLANK_PX * pixels[:, :, 0].size)))
    if any(_is_correlated(change[:, :, side]) for side in (left, right)):
        factor, u_factor = _noise_factor(frames, row, at, weights)
        white = float((weights**2).sum()) * more * 0.5 * (change[:, :, left].var() + change[:, :, right].var())
        beside, u_rel = (white * factor, float(np.hypot(u_factor, NOISE_REL))) if factor > 0 else (beside, UNKNOWN_REL)
    noise = float(np.sqrt(more * 0.5 * (change[:, :, left].var() + change[:, :, right].var())))
    height = float(np.median(np.abs(profile[:, inside] - level[:, None]).max(axis=1))) if line else abs(float(np.median(high - low)))
    if height < LEAST_SNR * noise:
        raise _Refused(f"it is only {height / max(noise, 1e-9):.0f} times as high as the noise (at least {LEAST_SNR:g})")
    shot = 0.0
    if line and gain is not None:
        shot = gain * float((weights**2 * (profile - level[:, None]))[:, inside].sum(axis=1).mean())
    variance = max(beside + shot, 1e-12) / size**2
    u_rel = u_rel if not line or gain is not None else UNKNOWN_REL
    shift = (change @ weights) / size
    place = _place_in_mean(profile, x, at, low, high, line, half)
    return RowPlaces(number, f.kind, row, place, shift, np.sqrt(variance), u_rel, height, noise, half)


def _half_window(mean: np.ndarray, f: _Feature) -> int:
    """Half of the window that holds the step, or the line, with its tails: from the mean of all rows, placed on each other."""
    reach = MOST_HALF_PX + 2
    at = np.clip(np.rint(f.centre).astype(int), reach, mean.shape[1] - 1 - reach)
    curve = mean[f.row[:, None], at[:, None] + np.arange(-reach, reach + 1)].astype(float).mean(axis=0)
    slope = np.abs(np.diff(curve))
    x = np.arange(-reach, reach) + 0.5
    far = slope > 0.02 * slope.max()
    near = np.abs(x[far & (np.abs(x) < max(f.free_px + 0.5 * f.width_px, LEAST_HALF_PX))]).max(initial=0.0)
    return int(np.clip(np.ceil(near + 1), LEAST_HALF_PX + int(np.ceil(0.5 * f.width_px)), MOST_HALF_PX))


def _noise_of_sum(change: Array, weights: Array) -> float:
    """Variance of Σ w Δ from the autocovariance of flat pixels.

    What a row has in common, the mean of the farther lags, falls out, as Σ w = 0. Of the nearer lags those count that stand out of it.
    """
    cols = change.shape[2]
    lags = np.array([(change[:, :, : cols - k] * change[:, :, k:]).mean() for k in range(LAGS + 1)])
    chance = lags[0] / np.sqrt(change[:, :, 0].size * (cols - np.arange(LAGS + 1)))
    common = float(lags[FAR_LAG:].mean())
    total = 0.0
    for k in range(FAR_LAG):
        own = lags[k] - common
        if k == 0 or abs(own) > STANDS_OUT * chance[k]:
            total += (1 if k == 0 else 2) * own * float((weights[: len(weights) - k] * weights[k:]).sum())
    return float(total)


def _is_correlated(change: Array) -> bool:
    """Whether the noise of neighbouring pixels is alike, beyond what the whole row has in common."""
    cols = change.shape[2]
    lags = np.array([(change[:, :, : cols - k] * change[:, :, k:]).mean() for k in range(LAGS + 1)])
    chance = lags[0] / np.sqrt(change[:, :, 0].size * (cols - np.arange(LAGS + 1)))
    return bool((np.abs(lags[1:] - lags[1:].mean()) > 2 * STANDS_OUT * chance[1:]).any())


def _noise_factor(frames: np.ndarray, row: np.ndarray, at: np.ndarray, weights: Array) -> tuple[float, float]:
    """Variance of the sum over that of white noise, and its relative u: the same sum over flat parts of the same rows; 0 without one."""
    reach = len(weights) // 2
    factors = []
    for away in range(2 * reach + 1, frames.shape[2], 2 * reach + 1):
        for centre in (at - away, at + away):
            if centre.min() < reach or centre.max() + reach >= frames.shape[2]:
                continue
            pixels = frames[:, row[:, None], centre[:, None] + np.arange(-reach, reach + 1)].astype(np.float64)
            curve = pixels.mean(axis=(0, 1))
            change = pixels - pixels.mean(axis=0)
            if np.ptp(curve) < FLAT_SIGMAS * np.sqrt(change.var()):
                factors.append(float((change @ weights).var() / (change.var() * (weights**2).sum())))
    if not factors:
        return 0.0, 0.0
    return float(np.mean(factors)), float(np.sqrt(2 / (len(factors) * len(row) * (len(frames) - 1.0))))


def _smooth(row: np.ndarray, values: Array) -> Array:
    """A parabola over the rows: height or area of a line hardly change along it."""
    t = (row - row.mean()) / max(np.ptp(row) / 2, 1)
    return np.asarray(np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, values, 2)), float)


def _place_in_mean(profile: Array, x: np.ndarray, at: np.ndarray, low: Array, high: Array, line: bool, half: int) -> Array:
    """Column of every row in the mean image, by the same sums."""
    inside = np.abs(x) <= half
    values = profile[:, inside]
    if line:
        own = values - 0.5 * (low + high)[:, None]
        return np.asarray(at + (own * x[inside]).sum(axis=1) / own.sum(axis=1), float)
    return np.asarray(at + half + 0.5 - (values - low[:, None]).sum(axis=1) / (high - low), float)
