"""Line jitter from the places of the rows: what all lines of a row have in common, beyond the noise of the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.observations import LineRows, RowPlaces
from pixmetry.core.arrays import Array, Ints
from pixmetry.core.number import ONE_SIDED_95, Estimates

BLOCK_ROWS, LEAST_BLOCK = 256, 24  # lines of a field that are taken as one series
LENGTHS = np.geomspace(0.7, 60.0, 11)  # rows over which a loop's correlation falls to 1/e, that are tried
STATED_ROWS = (5.0, 20.0)  # for which a loop is bounded that was not found
FOUND = 16.0  # of −2 ln L, from which on the loop, or the settling, is there
SETTLING_ROWS = np.geomspace(1.5, 150.0, 60)
NOT_SIGNIFICANT, OUTLYING = 3.0, 8.0
FITTED = "variance of the rows' places over the frames, less that of the pixels' noise, by restricted maximum likelihood"
BEHIND = (
    "electronics.video_amplifier, grabber.low_pass: where the line keeps frequencies near the pixel clock, a row moves by more or less "
    "than its delay (by 26 % behind 8 MHz at a clock of 14.2 MHz); steps that are held until the next pixel hide a delay",
    "storage.tape: a recorder between camera and grabber shifts rows too; take the lines directly as well",
    "grabber.clock_warm_up and vibration within a field, as far as they are no steady drift of a field",
)


@dataclass(frozen=True)
class RowSeries:
    """What all lines of one picture say of its rows.

    Parameters
    ----------
    row : ndarray, shape (rows,)
    shift_px : ndarray, shape (frames, rows)
        Weighted mean of the lines.
    noise_px2 : float
        Mean variance of it by the pixels' noise, and ``u_rel`` of that.
    place_px : ndarray, shape (rows,)
        Mean over lines and frames of the column, less each line's own cubic.
    ripple : ndarray, shape (2, rows)
        Sine and cosine of the lines' place in the pixel, their mean: as what aliasing moves a line.
    """

    row: Ints
    shift_px: Array
    noise_px2: float
    u_rel: float
    place_px: Array
    ripple: Array


def with_jitter(found: LineRows) -> LineRows:
    """Fit the jitter of the pictures that came directly, and of those that were played from tape."""
    fits = {}
    for taped in (False, True):
        own = [i for i, recorded in enumerate(found.recorded) if recorded is taped]
        parts = [s for s in (series_of([line for line in found.lines if line.picture == i]) for i in own) if s is not None]
        fits[taped] = fit_jitter(parts) if own else Estimates.empty()
        if own and not parts:
            why = _why_none(found, own)
            fits[taped] = Estimates.from_rows([], reasons={"white_px": why})
    return replace(found, jitter=fits[False], taped=fits[True])


def _why_none(found: LineRows, own: Sequence[int]) -> str:
    """Why no line of these pictures was measured."""
    reasons = [r.reason for r in sorted(found.refused, key=lambda r: -r.rows) if r.picture in own]
    return next(
        iter([*reasons, *found.notes]), "no upright line or edge was found (40 rows or more, 15 times the noise, within 11 degrees)"
    )


def series_of(lines: Sequence[RowPlaces]) -> RowSeries | None:
    """The weighted mean of the lines of one picture over the rows that most of them have; None without lines.

    A picture that moves between frames shifts and turns its lines. Each line's mean over the rows is taken out, so that lines of
    different length do not make steps; what is left of a turn is linear in the rows, and is left out by the fit.
    """
    if not lines:
        return None
    longest = max(len(line.row) for line in lines)
    lines = [line for line in lines if len(line.row) >= 0.7 * longest]
    row = lines[0].row
    for line in lines[1:]:
        row = np.intersect1d(row, line.row)
    if len(row) < LEAST_BLOCK:
        lines, row = [max(lines, key=lambda line: len(line.row))], max(lines, key=lambda line: len(line.row)).row
    at = [np.searchsorted(line.row, row) for line in lines]
    weights = np.array([1 / float((line.u_px[k] ** 2).mean()) for line, k in zip(lines, at, strict=True)])
    weights /= weights.sum()
    shift = sum(
        w * (line.shift_px[:, k] - line.shift_px[:, k].mean(axis=1, keepdims=True)) for w, line, k in zip(weights, lines, at, strict=True)
    )
    variances = np.array([float((line.u_px[k] ** 2).mean()) for line, k in zip(lines, at, strict=True)])
    noise = float((weights**2 * variances).sum())
    u_rel = float(np.sqrt(((weights**2 * variances * [line.u_rel for line in lines]) ** 2).sum()) / noise)
    t = np.linspace(-1, 1, len(row))
    own = [line.place_px[k] - _polynomial(t, line.place_px[k], 3) for line, k in zip(lines, at, strict=True)]
    place = sum(w * p for w, p in zip(weights, own, strict=True))
    turns = [2 * np.pi * line.place_px[k] for line, k in zip(lines, at, strict=True)]
    ripple = np.array([sum(w * f(turn) for w, turn in zip(weights, turns, strict=True)) for f in (np.sin, np.cos)])
    shift = np.asarray(shift, float)
    good = (
        np.abs(shift - np.median(shift, axis=1, keepdims=True)).max(axis=0) < OUTLYING * max(1.4826 * np.median(np.abs(shift)), 1e-9) + 0.02
    )
    return RowSeries(row[good], shift[:, good], noise, u_rel, np.asarray(place, float)[good], ripple[:, good])


def _polynomial(t: Array, values: Array, order: int) -> Array:
    return np.asarray(np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, values, order)), float)


@dataclass(frozen=True)
class _Block:
    """Lines of one field that follow each other: independent series, each without a line through it."""

    line: Ints  # number within the field
    data: Array  # shape (series, rows)


def _blocks(series: RowSeries, stride: int) -> list[_Block]:
    """Series that are independent and alike: differences of the frames that hold no mean over them (Helmert), field by field."""
    frames = len(series.shift_px)
    helmert = np.zeros((frames - 1, frames))
    for k in range(1, frames):
        helmert[k - 1, :k] = 1
        helmert[k - 1, k] = -k
        helmert[k - 1] /= np.sqrt(k * (k + 1.0))
    contrasts = helmert @ series.shift_px
    blocks = []
    for first in range(stride):
        own = np.flatnonzero(series.row % stride == first)
        for part in np.array_split(own, max(1, int(np.ceil(len(own) / BLOCK_ROWS)))):
            if len(part) >= LEAST_BLOCK // stride:
                blocks.append(_Block(series.row[part] // stride, contrasts[:, part]))
    return blocks


@dataclass(frozen=True)
class _Turned:
    """A block in the directions in which white and correlated part are both independent."""

    squares: Array  # mean over the series of the squares
    alike: Array  # variance of a loop of 1 px there
    slope: Array  # and its change with ln(length), a matrix
    count: int


def _turned(blocks: Sequence[_Block], length: float, slope: bool = False) -> list[_Turned]:
    from scipy.linalg import null_space

    out = []
    for block in blocks:
        t = block.line - block.line.mean()
        free = null_space(np.stack([np.ones(len(t)), t / max(np.abs(t).max(), 1)]))
        apart = np.abs(block.line[:, None] - block.line)
        alike, vectors = np.linalg.eigh(free.T @ np.exp(-apart / length) @ free)
        directions = free @ vectors
        data = block.data @ directions
        change = directions.T @ (np.exp(-apart / length) * apart / length) @ directions if slope else np.zeros((0, 0))
        out.append(_Turned((data**2).mean(axis=0), alike, change, len(data)))
    return out


def _minus_2_log(parts: Sequence[_Turned], white: float, loop: float) -> float:
    total = 0.0
    for p in parts:
        variance = white + loop * p.alike
        total += p.count * float((np.log(variance) + p.squares / variance).sum())
    return total


def _variances(parts: Sequence[_Turned], with_loop: bool) -> tuple[float, float]:
    """White variance (with the pixels' noise) and that of the loop, by scoring."""
    white = float(np.concatenate([p.squares for p in parts]).mean())
    loop = 0.0
    for _ in range(60 if with_loop else 0):
        normal, right = np.zeros((2, 2)), np.zeros(2)
        for p in parts:
            weight = p.count / (white + loop * p.alike) ** 2
            design = np.stack([np.ones_like(p.alike), p.alike])
            normal += (design * weight) @ design.T
            right += (design * weight) @ p.squares
        new = np.linalg.solve(normal, right)
        lowest = 1e-3 * max(float(np.concatenate([p.squares for p in parts]).min()), 1e-12)
        new = np.array([max(new[0], lowest), max(new[1], -new[0] / (2 * max(float(p.alike.max()) for p in parts)))])
        step = float(np.abs(new - (white, loop)).max())
        white, loop = float(new[0]), float(new[1])
        if step < 1e-9 * (white + abs(loop)):
            break
    return white, loop


@dataclass(frozen=True)
class _Fit:
    white: float
    loop: float
    length: float
    gain: float  # −2 ln L, less than without a loop
    blocks: Sequence[_Block]


def _best(blocks: Sequence[_Block]) -> _Fit:
    """The loop's length by a search, its variances by scoring."""
    from scipy.optimize import minimize_scalar

    def at(log_length: float) -> tuple[float, float, float]:
        parts = _turned(blocks, float(np.exp(log_length)))
        white, loop = _variances(parts, True)
        return _minus_2_log(parts, white, loop), white, loop

    parts = _turned(blocks, 1.0)
    alone, _ = _variances(parts, False)
    none = _minus_2_log(parts, alone, 0.0)
    tried = [at(float(np.log(length)))[0] for length in LENGTHS]
    k = int(np.argmin(tried))
    low, high = np.log(LENGTHS[max(k - 1, 0)]), np.log(LENGTHS[min(k + 1, len(LENGTHS) - 1)])
    best = float(minimize_scalar(lambda v: at(v)[0], bounds=(low, high), method="bounded", options={"xatol": 0.01}).x)
    value, white, loop = at(best)
    return _Fit(white, loop, float(np.exp(best)), none - value, blocks)


def _covariance(blocks: Sequence[_Block], white: float, loop: float, length: float, with_length: bool) -> Array:
    """Covariance of white variance, loop variance and ln(length): the inverse of Fisher's information, ½ tr(Σ⁻¹A Σ⁻¹B)."""
    size = 3 if with_length else 2
    information = np.zeros((size, size))
    for p in _turned(blocks, length, slope=with_length):
        inverse = 1 / (white + loop * p.alike)
        parts = [np.eye(len(inverse)), np.diag(p.alike), *([loop * p.slope] if with_length else [])]
        scaled = [np.sqrt(inverse)[:, None] * m * np.sqrt(inverse) for m in parts]
        for i in range(size):
            for j in range(size):
                information[i, j] += 0.5 * p.count * float((scaled[i] * scaled[j]).sum())
    return np.asarray(np.linalg.inv(information), float)


def fit_jitter(series: Sequence[RowSeries]) -> Estimates:
    """White part and loop of the rows' shifts from frame to frame, and the settling that all frames share.

    Parameters
    ----------
    series : sequence of RowSeries

    Returns
    -------
    Estimates
        ``white_px``, ``loop_px``, ``loop_rows`` and ``interlaced`` where a loop was found, ``settling_px`` with ``settling_rows``; limits
        of what was not found.

    Notes
    -----
    Of F frames F − 1 differences are independent. In each, field by field, a line through the rows is left out: motion between the fields,
    and a slow turn. What remains has the covariance σ_w² + u² + σ_l² e^(−|Δ|/L) of the rows, with the known u of the pixels' noise; its
    likelihood without the left-out directions is that of restricted maximum likelihood (H. D. Patterson, R. Thompson, Biometrika 58, 1971,
    545), and u is from Fisher's information.
    """
    if not series:
        return Estimates.empty()
    noise = float(np.average([s.noise_px2 for s in series], weights=[s.shift_px.size for s in series]))
    u_noise = noise * max(s.u_rel for s in series)
    fits = {stride: _best([b for s in series for b in _blocks(s, stride)]) for stride in (2, 1)}
    scores = {stride: f.gain for stride, f in fits.items()}
    stride = 1 if scores[1] > max(scores[2] + 4, FOUND) else 2
    fit = fits[stride]
    rows: list[tuple[str, float, float, float, str]] = []
    limits: set[str] = set()
    reasons: dict[str, str] = {}
    if fit.gain > FOUND and fit.loop > 0:
        cov = _covariance(fit.blocks, fit.white, fit.loop, fit.length, True)
        white, loop = fit.white - noise, fit.loop
        u_white = float(np.hypot(np.sqrt(cov[0, 0]), u_noise))
        rows.append(_root("white_px", white, u_white, limits, reasons))
        rows.append(("loop_px", float(np.sqrt(loop)), float(np.sqrt(cov[1, 1]) / (2 * np.sqrt(loop))), np.inf, "px"))
        rows.append(("loop_rows", fit.length, float(fit.length * np.sqrt(cov[2, 2])), np.inf, "rows"))
        rows.append(("interlaced", float(stride == 2), 0.0, np.inf, "1"))
        jacobian = np.array([1 / (2 * max(rows[0][1], 1e-9)), 1 / (2 * rows[1][1]), fit.length])
        joint = jacobian[:, None] * cov * jacobian
        if "white_px" in limits:
            joint[0], joint[:, 0] = 0.0, 0.0
        else:
            joint[0, 0] = rows[0][2] ** 2
    else:
        blocks = fits[2].blocks
        parts = _turned(blocks, 1.0)
        alone, _ = _variances(parts, False)
        cov = _covariance(blocks, alone, 0.0, STATED_ROWS[0], False)
        n = sum(p.squares.size * p.count for p in parts)
        u_white = float(np.hypot(alone * np.sqrt(2 / n), u_noise))
        rows.append(_root("white_px", alone - noise, u_white, limits, reasons))
        most = 0.0
        for length in STATED_ROWS:
            turned = _turned(blocks, length)
            _, loop = _variances(turned, True)
            u_loop = float(np.sqrt(_covariance(blocks, alone, 0.0, length, False)[1, 1]))
            most = max(most, float(np.sqrt(max(loop, 0.0) + ONE_SIDED_95 * u_loop)))
        rows.append(("loop_px", most, most / np.sqrt(12), np.inf, "px"))
        limits.add("loop_px")
        reasons["loop_px"] = "the rows' shifts are not alike from line to line; 95 % upper limit, of a loop of 5 to 20 lines"
        joint = np.zeros((0, 0))
    jitter_px2 = max(fit.white + max(fit.loop, 0.0), 0.0)
    settled, settled_cov, told = _settling(series, stride, jitter_px2, fit)
    covariance = np.diag([r[2] ** 2 for r in (*rows, *settled)])
    covariance[: len(joint), : len(joint)] = joint
    k = len(rows)
    covariance[k:, k:] = settled_cov
    reasons |= told
    limits |= {r[0] for r in settled if r[0] in told and len(settled) == 1}
    every = (*rows, *settled)
    return Estimates(
        tuple(r[0] for r in every), np.array([r[1] for r in every]), covariance, np.array([r[3] for r in every]),
        tuple(r[4] for r in every),
        FITTED, BEHIND, frozenset(limits), reasons=reasons,
    )  # fmt: skip


def _root(name: str, square: float, u: float, limits: set[str], reasons: dict[str, str]) -> tuple[str, float, float, float, str]:
    """A standard deviation from its square; a limit where that is not significant."""
    if square > NOT_SIGNIFICANT * u:
        value = float(np.sqrt(square))
        return name, value, u / (2 * value), np.inf, "px"
    limit = float(np.sqrt(max(square, 0.0) + ONE_SIDED_95 * u))
    limits.add(name)
    reasons[name] = "the rows scatter no more than the noise of the pixels makes them; 95 % upper limit"
    return name, limit, u / (2 * max(limit, 1e-12)), np.inf, "px"


def _settling(
    series: Sequence[RowSeries], stride: int, jitter_px2: float, fit: _Fit
) -> tuple[list[tuple[str, float, float, float, str]], Array, dict[str, str]]:
    """A e^(−line/r) in the mean places of the rows, beside a cubic of the row, which a bent line or a distorting lens makes.

    Longest first: the picture of the most rows. It needs the first rows of the frame.
    """
    own = [s for s in series if s.row[0] < 12]
    if not own:
        return [], np.zeros((0, 0)), {"settling_px": "the lines do not reach the first rows of the frame"}
    s = max(own, key=lambda part: len(part.row))
    t = np.linspace(-1, 1, len(s.row))
    smooth = np.column_stack([np.polynomial.polynomial.polyvander(t, 3), s.ripple.T])
    line = s.row // stride
    apart = np.abs(line[:, None] - line).astype(float)
    alike = np.where((s.row[:, None] - s.row) % stride == 0, np.exp(-apart / fit.length), 0.0)
    fixed = _unlike(s.place_px, stride)
    covariance = max(fixed, 1e-10) * np.eye(len(line)) + max(fit.loop, 0.0) / len(s.shift_px) * alike * (fit.gain > FOUND)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    place, base = root @ s.place_px, root @ smooth
    without = _left(base, place)
    lengths = SETTLING_ROWS[0.3 * line[-1] > SETTLING_ROWS]
    if not len(lengths):
        return [], np.zeros((0, 0)), {"settling_px": "the lines are too short: settling is told from 40 rows or more"}
    fits = np.array([_last(np.column_stack([base, root @ np.exp(-line / r)]), place) for r in lengths])
    factor = max(1.0, fits[:, 0].min() / (len(line) - 8))
    if (without - fits[:, 0].min()) / factor > FOUND + 9:
        # amplitude and length bend the sum of squares too much for a curvature to tell u: mean and covariance over all lengths
        share = np.exp(-0.5 * (fits[:, 0] - fits[:, 0].min()) / factor)
        share /= share.sum()
        values = np.stack([fits[:, 1], lengths])
        best = values @ share
        cov = (share * (values - best[:, None])) @ (values - best[:, None]).T
        cov[0, 0] += factor * float(share @ fits[:, 2])
        cov[1, 1] += float((0.05 * best[1]) ** 2)  # of the lengths' steps
        u = np.sqrt(np.diag(cov))
        rows = [("settling_px", float(best[0]), float(u[0]), np.inf, "px"), ("settling_rows", float(best[1]), float(u[1]), np.inf, "rows")]
        why = {"settling_px": "the lines are taken to be straight: beside a cubic of the row, all that bends the first rows counts"}
        return rows, cov, why
    worst = 0.0
    for r in (5.0, 15.0):
        _, amplitude, variance = _last(np.column_stack([base, root @ np.exp(-line / r)]), place)
        worst = max(worst, abs(amplitude) + ONE_SIDED_95 * float(np.sqrt(factor * variance)))
    why_none = "the first rows are not shifted against the others; 95 % limit of its size, for 5 to 15 lines"
    return [("settling_px", worst, worst / np.sqrt(12), np.inf, "px")], np.array([[worst**2 / 12]]), {"settling_px": why_none}


def _left(design: Array, values: Array) -> float:
    """Sum of squares that a fit leaves."""
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    return float(((values - design @ solution) ** 2).sum())


def _last(design: Array, values: Array) -> tuple[float, float, float]:
    """What a fit leaves, and its last unknown with the variance for unit weight."""
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    cofactor = np.linalg.pinv(design.T @ design)[-1, -1]
    return float(((values - design @ solution) ** 2).sum()), float(solution[-1]), float(cofactor)


def _unlike(values: Array, stride: int) -> float:
    """Variance of a value that has nothing to do with its neighbours, from second differences."""
    second = values[2 * stride :] - 2 * values[stride:-stride] + values[: -2 * stride]
    return float((1.4826 * np.median(np.abs(second))) ** 2 / 6)
