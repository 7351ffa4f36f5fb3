"""A recorder by one scene at rest, seen directly and after it was recorded: a video coder, or a video tape.

What a lossless recorder stores is the frames themselves: noise, contrast and places of the rows are as before. A lossy video coder stores
no change that is below its rounding step: noise freezes until the next picture that is coded by itself. A tape limits the bandwidth, adds
noise, and its lines come early or late.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.fft import dctn

from pixmetry.camera.recordings import Recordings
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.line_jitter import RowSeries, fit_jitter
from pixmetry.sources.storage.tape import BESSEL_3
from pixmetry.sources.storage.video_codec import DEPTHS, Coder, VideoCodec

LEAST_FRAMES = 8  # of each: for noise, and to see a group of pictures
MOST_SIDE, MOST_TRIED = 256, 12  # px of the part in the middle of the frames, and number of frames, on which a coder is tried
SIGNIFICANT = 3.0
BY_CHANCE = 1e-6  # probability that some group of pictures stands out as much where there is none
TILTED = 5.0  # standard deviations by which a change of the coarse over the fine part stands out
NEARLY = 1.5  # ratio of sums of squares, below which another period describes them as well
FREEZES = 0.02  # of the noise variance: what a lossy coder takes away at least
BLOCK, MACROBLOCK = 4, 16  # px, the smallest that is transformed; the one whose rounding follows its content
LUMPY, TILT = 0.15, 0.03  # by which the kurtosis of the noise rises, and the logarithm of its coarse over its fine part
QUALITIES, COARSEST_FIRST, COARSE = (1, 51), 2, 3  # quantisers, and the first and the step of those that are tried first
MISFIT, ALIKE = 0.05, 0.003  # sum of squares of the logarithms of the traces: of another coder; of quantisers that are not told apart
ALIKE_REL = 4.0  # of the best misfit, up to which another is as good
CLEARLY = 0.25  # of the misfit three quantisers off, above which the best one is not the right one
U_QUALITY = 1.0  # one coder decides not quite as another
LEAST_CONTRAST = 30.0  # of the scene's power over that of the noise, at a frequency that is compared
BANDS = 48  # frequencies along a row
CLEAR_MISFIT = 16.0  # ratio of sums of squares, from which on it is clear that a line is a staircase, or smooth
ABOVE_SWITCH = 0.8  # share of the rows that lie above where heads switch
BLOCKS = 8  # parts of the rows whose scatter is the u of the bandwidth
LEAST_ROWS = 0.25  # share of the rows that show where they are, for their jitter
EDGE_PX = 4  # of a row to either side, that are left out
ROW_U_PX = 0.25  # of the place of one row, above which it shows nothing
DIGITAL_ONLY, ANALOGUE_ONLY = "a tape records an analogue signal: the camera is digital", "a coder behind a tape is not told from the tape"
METHOD = "one scene at rest, directly and recorded: noise from frame to frame, contrast along the rows, places of the rows"
CODER = "quantiser with which a coder (libx264, libx265) leaves such noise of the direct frames"
FILTER_AHEAD = (
    "the contrast is not clearly that of a staircase of pixels, or of a smooth line: a filter ahead of the recorder shapes the direct "
    "frames, or noise hides it"
)
LOSSLESS = "noise is as before, and does not freeze: the recorder loses nothing that these frames show"


def recordings_of(
    direct: Sequence[np.ndarray], recorded: Sequence[np.ndarray], *, analogue: bool = False, depth_bits: int = 8
) -> Recordings:
    """What a recorder changes.

    Parameters
    ----------
    direct, recorded : sequence of ndarray, shape (rows, cols), DN
        Frames of one scene at rest, each in the order in which they were taken.
    analogue : bool
        Whether the recorder is a tape, in front of the frame grabber.
    depth_bits : int
        Bits of a stored value.

    Returns
    -------
    Recordings

    Raises
    ------
    MeasureError
        With fewer than eight frames of each, of two scenes, or where the direct frames are all the same.
    """
    if min(len(direct), len(recorded)) < LEAST_FRAMES:
        what = f"{len(direct)} frames came directly and {len(recorded)} were recorded, {LEAST_FRAMES} of each are needed"
        raise MeasureError(what, where="recording", remedy="take more frames of the same scene, which does not move")
    before, after = (np.array(frames, np.float32) for frames in (direct, recorded))
    squares = [0.5 * np.square(np.diff(f, axis=0)).mean(axis=(1, 2), dtype=float) for f in (before, after)]
    if not squares[0].any():
        remedy = "store the frames as they come from the camera, each taken by itself"
        raise MeasureError("the direct frames are copies of one picture, without noise", where="recording", remedy=remedy)
    noise, correlation = _noise(before, after)
    means = (before.mean(axis=0, dtype=float), after.mean(axis=0, dtype=float))
    _same_scene(*means)
    frequency, transfer, u_transfer, parts = _transfer(
        *means, [float(v.mean()) / len(f) for v, f in zip(squares, (before, after), strict=True)]
    )
    fit = noise.join(correlation)
    played = straight = Estimates.empty()
    step = np.full(len(means[0]), np.nan)
    if analogue:
        played, straight = row_jitter_of(after), row_jitter_of(before)
        jitter = [
            sum(n.value**2 for n in e if n.unit == "px" and n.name in ("white_px", "loop_px") and not n.is_limit)
            for e in (played, straight)
        ]
        own_px = next((n.value for n in straight if n.name == "white_px" and not n.is_limit), 0.0)
        band, ways = _bandwidth(frequency, parts, max(jitter[0] - jitter[1], 0.0), own_px)
        expected, lowest = means[0], 1.0
        if ways:
            best = min(ways, key=lambda way: way.misfit)
            lowest = max(float(bessel_gain(np.ones(1), float(np.exp(way.logarithm)))[0]) for way in ways)
            expected = _waved(
                expected,
                np.zeros(len(expected)),
                gain=lambda f: bessel_gain(f, float(np.exp(best.logarithm)), held=best.held) * np.exp(-2 * (np.pi * f) ** 2 * jitter[0]),
            )
        played = _beside_delays(played, lowest)
        step = row_shifts(means[1][None], expected, passes=3)[0]
        fit = fit.join(band, _added_noise(before, after), _head_switch(step, lowest), _untold(("quality", "group"), ANALOGUE_ONLY))
    else:
        fit = fit.join(_coder(before, after, squares[1], noise, correlation, depth_bits))
        fit = fit.join(_untold(("bandwidth_rel", "noise_dn", "head_switch_px"), DIGITAL_ONLY))
    return Recordings(
        len(direct), len(recorded), frequency, transfer, u_transfer, squares[1], float(squares[0].mean()), step, fit, played, straight
    )


def _untold(names: Sequence[str], why: str) -> Estimates:
    return Estimates.from_rows([], reasons=dict.fromkeys(names, why))


def _same_scene(direct: Array, recorded: Array) -> None:
    """Refuse frames of two scenes."""
    one, other = direct - direct.mean(), recorded - recorded.mean()
    alike = float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum() + 1e-12))
    if alike < 0.5:
        remedy = "show the same scene in both, with texture or edges, and let nothing move"
        raise MeasureError("the recorded frames show another scene, or one without contrast", where="recording", remedy=remedy)


def _noise(before: np.ndarray, after: np.ndarray) -> tuple[Estimates, Estimates]:
    """Ratio of the temporal variances, and correlation of the noise from frame to frame beyond that of the direct frames; u by blocks."""

    def of_blocks(values: np.ndarray) -> Array:
        rows, cols = (n // 4 for n in values.shape)
        return np.array(
            [values[i * rows : (i + 1) * rows, j * cols : (j + 1) * cols].mean(dtype=float) for i in range(4) for j in range(4)]
        )

    variances, correlations = [], []
    for f in (before, after):
        own = of_blocks(f.var(axis=0, ddof=1))
        near = of_blocks((0.5 * np.square(np.diff(f, axis=0))).mean(axis=0))
        variances.append(own)
        correlations.append(1 - near / np.maximum(own, 1e-12))
    ratio = variances[1] / np.maximum(variances[0], 1e-12)
    share = correlations[1] - correlations[0]
    rows = [("noise_ratio", float(np.average(ratio, weights=variances[0])), float(ratio.std(ddof=1)) / 4, 15.0, "1")]
    other = [("frame_correlation", float(share.mean()), float(share.std(ddof=1)) / 4, 15.0, "1")]
    return Estimates.from_rows(rows, method=METHOD), Estimates.from_rows(other, method=METHOD)


def _transfer(direct: Array, recorded: Array, noise_dn2: Sequence[float]) -> tuple[Array, Array, Array, Array]:
    """Contrast along the rows after over before, by frequency; of all rows, its u, and of blocks of rows (blocks, n).

    The cross spectrum over the power of the direct mean image, less that of its noise; sizes of complex means over the rows, so that what
    moves single rows lowers it.
    """
    cols = direct.shape[1]
    window = np.hanning(cols)
    spectra = [np.fft.rfft((m - m.mean(axis=1, keepdims=True)) * window, axis=1) for m in (direct, recorded)]
    power, cross = np.abs(spectra[0]) ** 2, np.conj(spectra[0]) * spectra[1]
    own = noise_dn2[0] * float((window**2).sum())
    edges = np.linspace(1, cols // 2 + 1, BANDS + 1).astype(int)
    frequency = np.array([(a + b - 1) / 2 / cols for a, b in zip(edges[:-1], edges[1:], strict=True)])
    parts = np.full((BLOCKS, BANDS), np.nan)
    # of all rows a delay that is common to them turns the phase by as much per frequency
    blocks = np.array_split(np.arange(int(ABOVE_SWITCH * len(direct))), BLOCKS)
    for b, rows in enumerate(blocks):
        for k, (first, end) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            p = power[rows, first:end].sum(axis=0)
            if p.sum() > LEAST_CONTRAST * own * len(rows) * (end - first):
                parts[b, k] = float(np.abs(cross[rows, first:end].sum(axis=0)).sum() / (p.sum() - own * len(rows) * (end - first)))
    seen = np.isfinite(parts).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(seen > 1, np.nansum(parts, axis=0) / np.maximum(seen, 1), np.nan)
        spread = np.sqrt(np.nansum((parts - mean) ** 2, axis=0) / np.maximum(seen - 1, 1) / np.maximum(seen, 1))
    return frequency, mean, np.where(seen > 1, spread, np.nan), parts


def bessel_gain(frequency: Array, bandwidth: float, *, held: bool = False) -> Array:
    """Gain of a Bessel filter of third order, −3 dB at the bandwidth, at frequencies in cycles per pixel.

    ``held``: of a staircase of pixels that is sampled in their middles behind the filter: Σ H(f + m) sinc(f + m), by which the steps of
    the staircase are folded back (the filter's delay is common to picture and line pulses).
    """
    late = float(np.real(-1 / BESSEL_3).sum())  # of low frequencies, rad per f/bandwidth
    total = np.zeros(np.shape(frequency), complex)
    for m in (-2, -1, 0, 1, 2) if held else (0,):
        f = (frequency + m) / bandwidth
        one = np.prod([-p / (1j * f - p) for p in BESSEL_3], axis=0) * np.exp(1j * f * late)
        total += one * (np.sinc(frequency + m) if held else 1.0)
    gain: Array = np.abs(total)
    return gain


@dataclass(frozen=True)
class _Way:
    """Bandwidth by one description of the line: mean logarithm of the blocks of rows, its u, their number, and what is left."""

    held: bool
    logarithm: float
    u: float
    count: int
    misfit: float


def _bandwidth(frequency: Array, parts: Array, jitter_px2: float, direct_px: float) -> tuple[Estimates, list[_Way]]:
    """Bandwidth in cycles per pixel, by the contrast of blocks of rows; and that of a smooth line and of a staircase of pixels.

    Of one recording: of copies of copies each has a wider one. Rows that jitter blur the mean image by as much more. Without a filter ahead
    of the recorder the line is a staircase of pixels, whose steps the recorder's filter averages and samples taken directly do not: a sinc.
    A filter ahead takes some of the steps, and what it leaves of them at the pixel clock is in the direct frames by the phase of their
    sampling. Neither is known, and the bandwidth is then wrong by up to a half: it is told where one of the two ends describes the contrast
    clearly better. u holds what is not known of the jitter; and of the difference of the two as much as the sum of squares leaves of the
    other one.
    """
    ways, doubts = [], [0.0, 0.0]
    for held in (False, True):
        known = np.exp(-2 * (np.pi * frequency) ** 2 * jitter_px2)
        # direct samples lie where a straight line from pixel to pixel has its bend: jitter loses in proportion to its mean size
        loss = 1 - float(np.sqrt(2 / np.pi)) * direct_px * (1 - np.cos(2 * np.pi * frequency))
        way = _way(frequency, parts, known / loss if held else known, held)
        if way is None:
            return _untold(("bandwidth_rel",), "the scene has too little contrast at high frequencies: show sharp edges or texture"), []
        ways.append(way)
        if held and direct_px:
            other = _way(frequency, parts, known, held)
            doubts[held] += 0.0 if other is None else (way.logarithm - other.logarithm) ** 2 / 12
        if jitter_px2:  # which is known as well as the delays that move the rows
            at_clock = min(float(bessel_gain(np.ones(1), float(np.exp(way.logarithm)))[0]), 0.5)
            other = _way(frequency, parts, (known / loss if held else known) * known ** (2 * np.sqrt(2) * at_clock), held)
            doubts[held] += 0.0 if other is None else (way.logarithm - other.logarithm) ** 2
    best, other = sorted(ways, key=lambda way: way.misfit)
    ratio = other.misfit / max(best.misfit, 1e-12)
    if ratio < CLEAR_MISFIT:
        return _untold(("bandwidth_rel",), FILTER_AHEAD), ways
    shape = (other.logarithm - best.logarithm) / float(np.sqrt(3 * ratio))
    value, u = float(np.exp(best.logarithm)), float(np.sqrt(best.u**2 + shape**2 + doubts[best.held]))
    dof = best.count - 1.0
    if value * (1 - SIGNIFICANT * u) > 0.5 * 3:
        what = "the contrast hardly falls up to the highest frequency of the pixels; 95 % lower limit"
        row = ("bandwidth_rel", value * float(np.exp(-ONE_SIDED_95 * u)), value * u, dof, "cycles/px")
        found_limit = Estimates.from_rows([row], method=METHOD, lower_limits=frozenset(["bandwidth_rel"]), reasons={"bandwidth_rel": what})
        return found_limit, ways
    return Estimates.from_rows([("bandwidth_rel", value, value * u, dof, "cycles/px")], method=METHOD), ways


def _way(frequency: Array, parts: Array, known: Array, held: bool) -> _Way | None:
    """The bandwidth of every block of rows, where known factors lower the contrast too; None where fewer than three show it.

    A frequency at which the scene has little contrast counts as much less as the blocks scatter more there than at others, and not at all
    where half of them do not show it.
    """
    from scipy.optimize import minimize_scalar

    found, left = [], []
    scatter = np.full(len(frequency), np.inf)
    told = np.isfinite(parts).sum(axis=0) > max(len(parts) // 2, 1)
    if not told.any():
        return None
    scatter[told] = np.nanvar(parts[:, told], axis=0, ddof=1)
    usual = max(float(np.median(scatter[told])), 1e-12)
    root = np.sqrt(usual / (scatter + usual))  # of the weight
    for part in parts:
        seen = np.isfinite(part) & told  # what does not count does not scale, either
        if seen.sum() < 4:
            continue

        def off(logarithm: float, part: Array = part, seen: np.ndarray = seen) -> Array:
            model, value = root * known * bessel_gain(frequency, float(np.exp(logarithm)), held=held), root * part
            scale = float(model[seen] @ value[seen] / (model[seen] @ model[seen]))
            return np.asarray(value - scale * model)

        best = minimize_scalar(
            lambda logarithm, off=off: float(np.nansum(off(logarithm) ** 2)), bounds=(np.log(0.02), np.log(5.0)), method="bounded"
        )
        found.append(float(best.x))
        left.append(off(best.x))
    if len(found) < 3:
        return None
    seen = np.isfinite(left).any(axis=0)
    misfit = float((np.nanmean(np.array(left)[:, seen], axis=0) ** 2).sum())  # what blocks have in common, not their noise
    return _Way(held, float(np.mean(found)), float(np.std(found, ddof=1) / np.sqrt(len(found))), len(found), misfit)


def _beside_delays(played: Estimates, at_clock: float) -> Estimates:
    """Jitter of the rows with what a delay moves a row by in doubt.

    What passes the recorder at the pixel clock, ``at_clock`` = |H| there, folds back: a row moves by 1 − 2 |H| cos φ times its delay,
    with the phase φ of the sampling; its standard deviation over all phases is √2 |H|.
    """
    moved = np.array([n.value if n.unit == "px" and not n.is_limit else 0.0 for n in played])
    return replace(played, covariance=played.covariance + 2 * at_clock**2 * np.outer(moved, moved)) if len(moved) else played


def _added_noise(before: np.ndarray, after: np.ndarray) -> Estimates:
    """Standard deviation of the noise that a tape adds where the scene is even: variance after less before, at no slope along the row.

    Rows that come early or late make noise in proportion to the square of the slope: the intercept is without it. u is the scatter of 16
    parts of the frame. The noise of the camera itself passes the tape, too, and loses what lies beyond its bandwidth: the variance of the
    direct frames is that after a filter of the same gain, which the caller's frames do not tell; so it bounds what was added from below
    and above, and u holds that.
    """
    slope = np.square(np.gradient(after.mean(axis=0, dtype=float), axis=1))
    variances = [f.var(axis=0, ddof=1).astype(float) for f in (after, before)]
    found = []
    for rows in np.array_split(np.arange(slope.shape[0]), 4):
        for cols in np.array_split(np.arange(slope.shape[1]), 4):
            part = np.ix_(rows, cols)
            design = np.column_stack([np.ones(slope[part].size), slope[part].ravel()])
            weight = 1 / (1 + design[:, 1] / max(float(np.median(design[:, 1])), 1e-9))
            own = [float(np.linalg.lstsq(design * weight[:, None], v[part].ravel() * weight, rcond=None)[0][0]) for v in variances]
            found.append(own)
    after_dn2, before_dn2 = np.array(found).T
    most, least = after_dn2, after_dn2 - before_dn2  # if the tape lets nothing of the camera's noise pass, or all of it
    square = float(0.5 * (most + least).mean())
    half = float(0.5 * before_dn2.mean())
    u = float(np.hypot((most + least).std(ddof=1) / 8, half / np.sqrt(3)))
    if square < SIGNIFICANT * u:
        limit = float(np.sqrt(max(square, 0.0) + ONE_SIDED_95 * u))
        why = {"noise_dn": "no more noise than the camera itself may have; 95 % upper limit"}
        return Estimates.from_rows(
            [("noise_dn", limit, u / (2 * limit), 15.0, "DN")], method=METHOD, limits=frozenset(["noise_dn"]), reasons=why
        )
    value = float(np.sqrt(square))
    return Estimates.from_rows([("noise_dn", value, u / (2 * value), 15.0, "DN")], method=METHOD)


def row_shifts(frames: np.ndarray, mean: Array, cols: slice = slice(None), passes: int = 1) -> Array:
    """By how much each row of each frame lies to the right of the same row of a mean image, shape (frames, rows), px.

    Least squares of the difference on the slope of the mean image and a constant, about the shift that was found before; NaN where the
    slope tells less than a quarter of a pixel. Slopes are those of the wave through the pixels: a difference of neighbours is too small.
    """
    m = mean[:, cols]
    inner = slice(EDGE_PX, m.shape[1] - EDGE_PX)
    shift = np.zeros(frames.shape[:2])
    for k in range(passes):
        moved = np.array([_waved(m, s) for s in shift]) if k else m[None]
        slope = (
            np.array([_waved(m, s, slope=True) for s in shift])[:, :, inner]
            if k
            else _waved(m, np.zeros(len(m)), slope=True)[None, :, inner]
        )
        slope = slope - slope.mean(axis=2, keepdims=True)
        energy = (slope**2).sum(axis=2)
        off = frames[:, :, cols][:, :, inner] - moved[:, :, inner]
        off = off - off.mean(axis=2, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            step = -(off * slope).sum(axis=2) / energy
            u = np.sqrt(np.square(off + step[..., None] * slope).mean(axis=2).mean(axis=0) / energy.mean(axis=0))
        shift = np.where(u < ROW_U_PX, shift + step, 0.0)
    return np.where(u < ROW_U_PX, shift, np.nan)


def _waved(image: Array, shift: Array, *, slope: bool = False, gain: Callable[[Any], Any] | None = None) -> Array:
    """Rows shifted to the right, or their slopes, or filtered: by the waves through them and their mirror images."""
    both = np.concatenate([image, image[:, ::-1]], axis=1)
    f = np.fft.rfftfreq(both.shape[1])
    factor = np.exp(-2j * np.pi * f * shift[:, None]) * (2j * np.pi * f if slope else 1.0) * (gain(f) if gain is not None else 1.0)
    here: Array = np.fft.irfft(np.fft.rfft(both, axis=1) * factor, both.shape[1], axis=1)[:, : image.shape[1]]
    return here


def row_jitter_of(frames: np.ndarray) -> Estimates:
    """Jitter of the rows from frame to frame; what the two halves of a row have in common is the row's."""
    mean = frames.mean(axis=0, dtype=float)
    middle = frames.shape[2] // 2
    halves = [row_shifts(frames, mean, part) for part in (slice(0, middle), slice(middle, None))]
    seen = np.isfinite(halves[0]).all(axis=0) & np.isfinite(halves[1]).all(axis=0)
    if seen.mean() < LEAST_ROWS:
        return _untold(("white_px",), "most rows show nothing upright in both halves of the frame: show texture or upright edges all over")
    one, other = (h[:, seen] - h[:, seen].mean(axis=1, keepdims=True) for h in halves)
    few = len(frames) / (len(frames) - 1)
    noise = float(np.square(one - other).mean()) / 4 * few
    row = np.flatnonzero(seen)
    u_rel = float(np.sqrt(2 / max(one.size - one.shape[1], 1)))
    return fit_jitter([RowSeries(row, 0.5 * (one + other), noise, u_rel, np.zeros(row.size), np.zeros((2, row.size)))])


def _head_switch(step_px: Array, at_clock: float) -> Estimates:
    """Step of the rows at the end of both fields, against the rows above; and from which row on it begins.

    Rows of a field that move alike count as fewer. What passes the recorder at the pixel clock, ``at_clock``, folds back: places are off by
    |H|/π sin 2πφ with the phase φ of the sampling, and a step δ by √2 |H|/π |sin πδ| over all phases.
    """
    seen = np.flatnonzero(np.isfinite(step_px))
    rows = len(step_px)
    if seen.size < LEAST_ROWS * rows or (seen > rows - 24).sum() < 8:
        return _untold(("head_switch_px",), "the last rows show nothing upright")
    values = step_px[seen]
    above = values[seen < ABOVE_SWITCH * rows]
    scatter = 1.4826 * float(np.median(np.abs(above - np.median(above))))
    near = np.isfinite(step_px[:-2]) & np.isfinite(step_px[2:]) & (np.arange(2, rows) < ABOVE_SWITCH * rows)
    off = np.clip(step_px - np.median(above), -3 * scatter, 3 * scatter)
    alike = float((off[:-2] * off[2:])[near].mean() / max(float(np.square(off[:-2][near]).mean()), 1e-12)) if near.any() else 0.0
    fewer = max(1.0, (1 + alike) / max(1 - alike, 0.05))
    best, gain = None, 0.0
    for count in range(2, 61):
        tail = values[seen >= rows - 2 * count]
        if tail.size < 4:
            continue
        size = float(np.median(tail) - np.median(above))
        won = tail.size / fewer * (np.mean(tail) - np.median(above)) ** 2 / max(scatter, 1e-6) ** 2
        if won > gain:
            best, gain = (count, float(np.mean(tail) - np.median(above)), tail.size, size), won
    if best is None or gain < 25.0 + 2 * np.log(60):
        limit = ONE_SIDED_95 * scatter
        why = {"head_switch_px": "no step at the end of the fields"}
        row = ("head_switch_px", limit, scatter, float(above.size), "px")
        return Estimates.from_rows([row], method=METHOD, limits=frozenset(["head_switch_px"]), reasons=why)
    count, size, number, _ = best
    folded = float(np.sqrt(2)) * at_clock / np.pi * abs(float(np.sin(np.pi * size)))
    u = float(np.hypot(scatter * np.sqrt(fewer * (1 / number + 1 / above.size)), folded))
    row = ("head_switch_px", size, u, float(number - 1), "px")
    return Estimates.from_rows([row], method=METHOD, settings={"head_switch_rows": count})


def group_of(squares: Array) -> int | None:
    """Number of frames from one picture coded by itself to the next, by the differences to the frame before; None where none stands out.

    The picture coded by itself does not repeat what the others froze: the difference to it is larger, once a group.
    """
    above = squares[1:-1] - 0.5 * (squares[:-2] + squares[2:])  # without what freezes more and more within a group
    told = {_period(values) for values in (above, squares)} - {None}
    return told.pop() if len(told) == 1 else None


def _period(values: Array) -> int | None:
    """The period of which one value each time stands out; None where none does, or another one describes them nearly as well."""
    from scipy.stats import t as student

    left = []
    for period in range(2, len(values) // 2 + 1):
        for phase in range(period):
            high = np.arange(len(values)) % period == phase
            step = float(values[high].mean() - values[~high].mean())
            if high.sum() > 1 and step > 0:
                squares = float(sum(np.square(part - part.mean()).sum() for part in (values[high], values[~high])))
                u = float(np.sqrt(squares / max(len(values) - 2, 1) * (1 / high.sum() + 1 / (~high).sum())))
                left.append((squares, period, step / max(u, 1e-9)))
    left.sort()
    if not left or (len(left) > 1 and left[1][0] < NEARLY * left[0][0]):
        return None
    if len(left) * float(student.sf(left[0][2], len(values) - 2)) > BY_CHANCE:
        return None
    return left[0][1]


def traces_of(frames: np.ndarray) -> Array:
    """Mean square of the difference to the frame before, its coarse and its fine part in DN², its kurtosis, and that of busy over calm.

    Medians over the frames. Fine parts are rounded to 0 first, and rounding adds to the coarse ones. It leaves few coefficients that are
    large: noise that was normal then has a kurtosis above 3. Coarse and fine are block coefficients of low and of high order. A coder that
    adapts to the content rounds blocks with much contrast more coarsely than calm ones: the mean square of one half of the blocks over that
    of the other, by their contrast in the mean of the frames.
    """
    differences = np.diff(frames, axis=0)
    powers = np.square(dctn(_tiles(differences, BLOCK), axes=(2, 4), norm="ortho"))
    second, fourth = powers.mean(axis=(1, 3)), np.square(powers).mean(axis=(1, 3))
    kurtosis = np.median(fourth / np.maximum(second, 1e-12) ** 2, axis=(1, 2))
    coarse, fine = second[:, [0, 0, 1], [0, 1, 0]].mean(axis=1), second[:, 2:, 2:].mean(axis=(1, 2))
    contrast = _tiles(frames.mean(axis=0)[None], MACROBLOCK).var(axis=(2, 4))[0]
    busy = contrast > np.median(contrast)
    sizes = np.square(_tiles(differences, MACROBLOCK)).mean(axis=(2, 4))
    share = sizes[:, busy].mean(axis=1) / np.maximum(sizes[:, ~busy].mean(axis=1), 1e-6) if busy.any() else np.ones(len(differences))
    traces = np.array([np.square(differences).mean(axis=(1, 2), dtype=float), coarse, fine, kurtosis, share])
    return np.asarray(np.median(traces, axis=1), float)


def _tiles(frames: np.ndarray, side: int) -> np.ndarray:
    """Whole tiles of the frames, shape (n, rows of tiles, side, columns of tiles, side)."""
    rows, cols = (n // side for n in frames.shape[1:])
    return frames[:, : rows * side, : cols * side].reshape(len(frames), rows, side, cols, side)


def _coder(before: np.ndarray, after: np.ndarray, squares: Array, noise: Estimates, correlation: Estimates, depth_bits: int) -> Estimates:
    """Group and quantiser of a lossy coder, or that the recorder loses nothing."""
    ratio, alike = noise["noise_ratio"], correlation["frame_correlation"]
    group = group_of(squares)
    was, told_of = traces_of(before), traces_of(after)
    values = 3 * (len(after) - 1) / 2 * after[0].size / BLOCK**2  # of the coarse coefficients
    coarse, fine = np.maximum(np.array([told_of[1:3], was[1:3]]), 1e-6).T
    tilted = abs(float(np.log(coarse[0] / coarse[1] * fine[1] / fine[0]))) > max(TILT, TILTED * float(np.sqrt(8 / values)))
    lumpy = told_of[3] - was[3] > LUMPY or tilted
    frozen = alike.value > max(SIGNIFICANT * alike.u, FREEZES)
    less = ratio.value < 1 - max(FREEZES, SIGNIFICANT * ratio.u)
    if not (lumpy or frozen or less) and group is None:
        return Estimates.from_rows([], reasons=dict.fromkeys(("quality", "group"), LOSSLESS))
    if depth_bits not in (8, 10):
        return _untold(("quality", "group"), "frames of more than 10 bits: H.264 does not store them; the stream states its setting")
    if group is None and not frozen:
        group, told = 1, _untold(("group",), "noise does not freeze: each picture is coded by itself, or finely")
    elif group is None:
        what = f"fewer than two pictures coded by themselves stand out among the {len(after)} recorded frames: take more of them"
        told = _untold(("group",), what)
    else:
        told = Estimates.from_rows([("group", float(group), 0.1, np.inf, "1")], method=METHOD)
    try:
        return told.join(_quality(before, after, group, depth_bits))
    except InputError as problem:
        return told.join(_untold(("quality",), str(problem)))


def _quality(before: np.ndarray, after: np.ndarray, group: int | None, depth_bits: int) -> Estimates:
    """Quantiser with which a coder leaves the same traces in the direct frames, by trying."""
    side = [slice(max(0, (n - MOST_SIDE) // 2 // 16 * 16), max(0, (n - MOST_SIDE) // 2 // 16 * 16) + MOST_SIDE) for n in before.shape[1:]]
    direct = before[:, side[0], side[1]].astype(np.uint8 if depth_bits == 8 else np.uint16)
    # differences fall from one picture coded by itself to the next: a trial begins where the recorded frames do, behind a whole group
    count, ahead = len(after), 0
    if group is None or group > MOST_TRIED:
        count = min(count, MOST_TRIED)
    elif group > 1:
        count = min(count, max(MOST_TRIED, 3 * group))
        ahead = 2 * group - 1 - _first_of_group(after[:count], group)
    aim = traces_of(after[:count, side[0], side[1]])
    setting = {"group": min(group or len(before), 1000), "depth_bits": depth_bits}
    frames = direct[np.arange(ahead + count) % len(direct)]
    ways: list[_Trial] = []
    for codec in DEPTHS:
        if codec == "ffv1" or depth_bits not in DEPTHS[codec]:
            continue
        one = _trial(frames, ahead, aim, setting | {"codec": codec, "control": "qp"}, range(COARSEST_FIRST, QUALITIES[1] + 1, COARSE))
        by_content = range(max(QUALITIES[0], one.quality - 4 * COARSE), min(QUALITIES[1], one.quality + 2 * COARSE) + 1, COARSE)
        ways += [one, _trial(frames, ahead, aim, setting | {"codec": codec, "control": "crf"}, by_content)]
        if min(way.misfit for way in ways) < MISFIT:
            break
    limit = max(ALIKE_REL * min(way.misfit for way in ways), ALIKE)
    best, *rivals = [way for way in ways if way.misfit < limit]
    farther = min(d for q, d in best.tried.items() if abs(q - best.quality) >= COARSE)
    if best.misfit > max(MISFIT, CLEARLY * farther):
        return _untold(("quality",), "no quantiser of H.264 or HEVC leaves such noise: another coder, or noise reduction")
    confounders = tuple(f"quantiser {best.quality} of {best.name}: {way.quality} of {way.name} leaves such noise too" for way in rivals)
    alike = [q for q, d in best.tried.items() if d < limit]
    u = float(np.hypot(U_QUALITY, (max(alike) - min(alike)) / np.sqrt(12)))
    settings: dict[str, str | int] = {"codec": best.codec, "control": best.control, "depth_bits": depth_bits}
    if best.quality - ONE_SIDED_95 * u < QUALITIES[0]:
        why = {"quality": "so fine that the noise hides it; 95 % upper limit"}
        row = ("quality", min(best.quality + ONE_SIDED_95 * u, float(QUALITIES[1])), u, np.inf, "1")
        return Estimates.from_rows([row], method=CODER, limits=frozenset(["quality"]), reasons=why, settings=settings)
    row = ("quality", float(best.quality), u, np.inf, "1")
    return Estimates.from_rows([row], method=CODER, settings=settings, confounders=confounders)


def _first_of_group(after: np.ndarray, group: int) -> int:
    """The first of the recorded frames that is coded by itself, less one: the phase of the largest differences."""
    squares = np.square(np.diff(after, axis=0)).mean(axis=(1, 2), dtype=float)
    return max(range(group), key=lambda phase: float(squares[phase::group].mean()) if len(squares) > phase else 0.0)


@dataclass(frozen=True)
class _Trial:
    """What a coder makes of the direct frames: misfit of the traces by quantiser, and the best of them."""

    codec: str
    control: str
    tried: dict[int, float]

    @property
    def name(self) -> str:
        """What a user sets."""
        how = "one quantiser for all (qp)" if self.control == "qp" else "a quantiser by the content (crf)"
        return f"{self.codec} with {how}"

    @property
    def quality(self) -> int:
        return min(self.tried, key=lambda q: self.tried[q])

    @property
    def misfit(self) -> float:
        return self.tried[self.quality]


def _trial(frames: np.ndarray, ahead: int, aim: Array, setting: dict[str, Any], coarse: range) -> _Trial:
    """Quantisers of a coarse range on few frames, then those near the best on all; the first ``ahead`` frames leave no traces."""

    def apart(quality: int, played: np.ndarray, left_out: int) -> float:
        coder = Coder(VideoCodec(quality=quality, **setting))
        found = traces_of(np.array([coder.follow(f) for f in played], np.float32)[left_out:])
        return float(np.square(np.log(np.maximum(found, 1e-6) / np.maximum(aim, 1e-6))).sum())

    tried = {q: apart(q, frames[:MOST_TRIED], 0) for q in coarse}
    best = min(tried, key=lambda q: tried[q])
    near = range(max(QUALITIES[0], best - COARSE + 1), min(QUALITIES[1], best + COARSE - 1) + 1)
    return _Trial(setting["codec"], setting["control"], tried | {q: apart(q, frames, ahead) for q in near})
