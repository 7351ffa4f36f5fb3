"""Light that flickers: a wave in the rows and frames of a sequence, and the lamp's frequency and depth behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.camera.frame_sequence import FrameSequence, LampWave
from pixmetry.camera.observations import Observations
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.gain_loop import inverse_of

CHANCE = 1e-4  # of taking noise for a wave over rows and frames
LEAST_ROWS = 32
EXTRA = 6.0  # in power over the floor, which is a median of few ordinates
LEAST_CYCLES = 0.2
ROUNDING = 1e-9  # of the light: what frames that are copies of each other differ by
BESIDE_HUM = 3.0  # cycles over the rows that a lamp must be off a hum
PAD = 3  # ordinates of the periodogram for each independent one
ALIKE = 0.2  # largest scatter of a lamp's wave along the rows, over the wave
LEAST_WAVE = 6.0  # amplitude over its u
MAINS_HZ = (100.0, 120.0)  # light of lamps on mains of 50 and 60 Hz
HIGHEST_HZ = 1000.0  # up to which the frequency of a lamp is sought
LEAST_SINC = 0.02  # share of the depth that the exposure leaves, below which nothing is told
METHOD = "sinusoid in the light of frames and rows; depth over what the exposure averages out"
WOVEN = "the light of odd rows swings against that of even ones, as in two fields: list each field as a frame of its own, in order of time"
UNFOLD = "take a second sequence at another frame rate (1 % off is enough), or, of a rolling shutter, state camera.line_time_us"


def row_wave(
    rows: np.ndarray,
    mean: np.ndarray,
    gain: np.ndarray,
    offset: np.ndarray,
    black: float,
    static: np.ndarray,
    place: np.ndarray,
    start: LampWave | None = None,
    hum_per_row: float = 0.0,
) -> LampWave | None:
    """The strongest sinusoid over rows and frames in the light of the static parts; None where none stands out.

    Parameters
    ----------
    rows : ndarray, shape (frames, rows, segments)
        Means of parts of rows, DN.
    mean : ndarray, shape (rows, segments)
        What each frame is held against.
    gain, offset : ndarray, shape (frames,)
        Each frame against the mean of all.
    black : float
        In that mean.
    static : ndarray of bool, shape (blocks down, blocks across)
    place : ndarray, shape (frames,)
        When frames were taken, in frame times.
    start : LampWave, optional
        A wave that was found before, to be fitted anew.
    hum_per_row : float
        Cycles per row of a hum that dark frames show, which is no light; 0 without.

    Notes
    -----
    The mean over the rows of each frame is left out: it has the frame's factor in it. So a wave needs `LEAST_CYCLES` over the rows to be
    seen here. Searched is the two-dimensional periodogram; an ordinate of noise is exponentially distributed about the median over ln 2
    (Schuster 1898). u is the Cramér-Rao bound of a tone by the scatter of what is
    left.
    """
    light = light_of_rows(rows, mean, gain, offset, black, static)
    if light is None:
        return None
    value, row = light
    frames, count = value.shape
    if count < LEAST_ROWS or np.abs(value).max(initial=0.0) < ROUNDING:
        return None
    if start is not None:
        return _refined(value, place, row, start.per_frame, start.per_row)
    fields, found = wave_of_fields(value, row), strongest_wave(value, place, row, hum_per_row)
    if fields is not None and (found is None or 2 * fields.amplitude_rel > found.amplitude_rel):
        return fields
    if found is None:
        return None
    parts = [light_of_rows(rows, mean, gain, offset, black, static & part) for part in _across(static, rows)]
    return found if _is_alike(found, parts, place) else None


def wave_of_fields(value: np.ndarray, row: np.ndarray) -> LampWave | None:
    """Light that goes up and down from row to row, as in two fields that saw the lamp at two times; None where none stands out.

    The mean over the rows with alternating signs has, of noise, a χ² of one degree of freedom in each frame.
    """
    from scipy.special import chdtrc

    mean = value @ (1.0 - 2.0 * (row % 2)) / len(row)
    noise = float(np.median(value**2)) / 0.4549 / len(row)
    if chdtrc(len(value), float((mean**2).sum()) / max(noise, ROUNDING**2)) > CHANCE:
        return None
    return LampWave(float(np.sqrt(2 * np.mean(mean**2))), float(np.sqrt(2 * noise / len(value))), 0.0, 0.5, 0.5)


def strongest_wave(value: np.ndarray, place: np.ndarray, row: np.ndarray, hum_per_row: float = 0.0) -> LampWave | None:
    """The strongest sinusoid over frames and rows of values without the means of frames and of rows; None where none stands out.

    The floor of each frequency over the rows is the median over those from frame to frame: noise that rows share is no wave.
    """
    if np.abs(value).max(initial=0.0) < ROUNDING:  # of frames that are all the same
        return None
    k = np.rint(place).astype(int)
    grid = np.zeros((PAD * (int(k[-1]) + 1), PAD * int(row[-1] + 1)))
    grid[k[:, None], row] = value
    power = np.abs(np.fft.rfft2(grid)) ** 2
    per_row, span = np.arange(power.shape[1]) / grid.shape[1], int(row[-1] - row[0] + 1)
    allowed = per_row * span >= LEAST_CYCLES
    if hum_per_row:
        allowed &= np.abs(per_row - hum_per_row) * span > BESIDE_HUM
    power = power[:, allowed]
    floor = np.median(power, axis=0) / np.log(2)
    ratio = power / np.maximum(floor, max(1e-3 * float(np.median(floor)), 1e-12 * float(power.max())))
    peak = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    if ratio[peak] < np.log(ratio.size / PAD**2 / CHANCE) + EXTRA:
        return None
    per_frame = (peak[0] / grid.shape[0] + 0.5) % 1.0 - 0.5
    found = _refined(value, place, row, per_frame, float(per_row[allowed][peak[1]]))
    if found is None:
        return None
    wave = found.light(place, row) - 1
    wave = wave - wave.mean(axis=1, keepdims=True)
    left = value - (wave - wave.mean(axis=0))
    grid[k[:, None], row] = left
    floor = np.median(np.abs(np.fft.rfft2(grid)) ** 2, axis=0)[allowed]
    coloured = float(np.sqrt(max(floor[peak[1]] / np.mean(floor), 1.0)))
    u = {name: coloured * getattr(found, name) for name in ("u_amplitude_rel", "u_per_frame", "u_per_row")}
    return replace(found, **u) if found.amplitude_rel > LEAST_WAVE * u["u_amplitude_rel"] else None


def _across(static: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Masks of the blocks under each part of a row."""
    count = static.shape[1]
    return [np.isin(np.arange(count), part) for part in np.array_split(np.arange(count), rows.shape[2])]


def _is_alike(found: LampWave, parts: Sequence[tuple[np.ndarray, np.ndarray] | None], place: np.ndarray) -> bool:
    """Whether all parts of the rows show the wave alike; what moves in the scene does not."""
    sizes = []
    for value, row in (p for p in parts if p is not None):
        wave = found.light(place, row) - 1
        wave = wave - wave.mean(axis=1, keepdims=True)
        wave -= wave.mean(axis=0)
        sizes.append(float((value * wave).sum() / (wave * wave).sum()))
    allowed = np.hypot(ALIKE, 3 * np.sqrt(len(parts)) * found.u_amplitude_rel / found.amplitude_rel)
    return len(sizes) < 2 or float(np.std(sizes)) < allowed


def light_of_rows(
    rows: np.ndarray, mean: np.ndarray, gain: np.ndarray, offset: np.ndarray, black: float, static: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Light of each row of each frame over the frame's and over the row's mean, less 1, and the numbers of these rows."""
    frames, count, segments = rows.shape
    down = np.minimum(np.arange(count) * static.shape[0] // count, static.shape[0] - 1)
    across = [part for part in np.array_split(np.arange(static.shape[1]), segments)]
    keep = np.stack([static[:, part].all(axis=1) if len(part) else np.zeros(len(static), bool) for part in across], axis=1)[down]
    used = keep.any(axis=1)
    if used.sum() < LEAST_ROWS:
        return None
    light = np.where(keep, mean - black, 0.0)[used].sum(axis=1)
    left = np.where(keep, rows - gain[:, None, None] * mean - offset[:, None, None], 0.0)[:, used].sum(axis=2)
    lit = light > 0.02 * light.max()
    value = left[:, lit] / (gain[:, None] * light[lit])
    value = value - value.mean(axis=1, keepdims=True)
    return value - value.mean(axis=0), np.flatnonzero(used)[lit]


def _refined(value: np.ndarray, place: np.ndarray, row: np.ndarray, per_frame: float, per_row: float) -> LampWave | None:
    """Least squares of one tone."""
    from scipy.optimize import least_squares

    k, r = place[:, None], row[None, :].astype(float)

    def wave(p: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * (p[2] * k + p[3] * r)
        out = p[0] * np.cos(angle) + p[1] * np.sin(angle)
        out = out - out.mean(axis=1, keepdims=True)
        return np.asarray(out - out.mean(axis=0))

    def amplitude(u: float, v: float) -> np.ndarray:
        basis = np.stack([wave(np.array([1.0, 0.0, u, v])).ravel(), wave(np.array([0.0, 1.0, u, v])).ravel()], axis=1)
        return np.asarray(np.linalg.lstsq(basis, value.ravel(), rcond=None)[0])

    span = max(float(np.ptp(row)), 1.0)
    starts = [per_row] if per_row * span > 2 else [per_row, 0.25 / span, 0.5 / span, 1.0 / span]  # the means hide how little it turns
    tried = []
    for start in starts:
        first = np.array([*amplitude(per_frame, start), per_frame, start])
        size = max(float(np.hypot(*first[:2])), 1e-12)
        scale = [size, size, 0.1 / max(np.ptp(place), 1.0), 0.1 / span]
        tried.append(least_squares(lambda p: (wave(p) - value).ravel(), first, x_scale=scale, max_nfev=60))
    found = min(tried, key=lambda f: f.cost)
    dof = max(value.size - len(value) - value.shape[1] - 4, 1)
    covariance = inverse_of(found.jac) * 2 * found.cost / dof
    a, b = found.x[:2]
    size = float(np.hypot(a, b))
    slope = np.array([a, b]) / size
    u = [float(np.sqrt(max(slope @ covariance[:2, :2] @ slope, 0.0))), *np.sqrt(np.maximum(np.diag(covariance)[2:], 0.0)).tolist()]
    if found.x[3] <= 0 or size < LEAST_WAVE * u[0]:
        return None
    phase, along, down = -float(np.arctan2(b, a)) / (2 * np.pi), float(found.x[2]), float(found.x[3])
    if down > 0.5:  # the same in whole rows
        phase, along, down = -phase, -along, 1 - down
    return LampWave(size, u[0], (along + 0.5) % 1.0 - 0.5, u[1], down, u[2], phase)


def lamp_estimates(found: Sequence[FrameSequence], refused: Sequence[str], seen: Observations) -> Estimates:
    """``depth_rel`` and ``frequency_hz`` of a lamp, from all sequences; or the reasons."""
    from scipy.special import stdtrit

    if not found:
        return replace(Estimates.empty(), reasons={"depth_rel": refused[0] if refused else "no sequence"})
    lit = [s for s in found if s.wave is not None and not s.wave.of_fields]
    if not lit:
        woven = any(s.wave is not None for s in found)
        return replace(Estimates.empty(), reasons={"depth_rel": WOVEN}) if woven else _limit_of(found)
    best = min(lit, key=lambda s: s.wave.u_amplitude_rel / s.wave.amplitude_rel if s.wave is not None else np.inf)
    wave = best.wave
    assert wave is not None
    seen_rel = f"the light of the frames swings by {100 * wave.amplitude_rel:.2g} %"
    frequency = _frequency(lit, seen)
    if isinstance(frequency, str):
        return replace(Estimates.empty(), reasons={"depth_rel": f"{seen_rel}; {frequency}", "frequency_hz": frequency})
    hertz, u_hertz, why = frequency
    rows = [("frequency_hz", hertz, u_hertz, np.inf, "Hz")]
    if best.exposure_s <= 0:
        reason = f"{seen_rel}; the depth behind it needs the exposure time (exposure_s of the sequence)"
        return replace(Estimates.from_rows(rows, method=METHOD), reasons={"depth_rel": reason, "frequency_hz": why})
    turns = hertz * best.exposure_s
    left, slope = float(np.sinc(turns)), float(np.cos(np.pi * turns) - np.sinc(turns)) / turns * best.exposure_s
    if abs(left) < max(LEAST_SINC, 4 * abs(slope) * u_hertz):
        reason = f"{seen_rel}; the exposure holds {turns:.2f} periods of {hertz:.4g} Hz and averages them out: take a shorter one"
        return replace(Estimates.from_rows(rows, method=METHOD), reasons={"depth_rel": reason, "frequency_hz": why})
    depth = wave.amplitude_rel / abs(left)
    by_frequency = -depth * slope / left * u_hertz
    fit = seen.photon_transfer_fit
    black = fit["offset_dn"].value if fit is not None and "offset_dn" in fit else 0.0
    bend = seen.bend_rel(max(float(best.level_dn.mean()) - black, 0.0))
    u = float(np.linalg.norm([wave.u_amplitude_rel / left, by_frequency, bend * depth]))
    cross = by_frequency * u_hertz
    confounders = [] if seen.dark_stack is not None else ["hum (electronics.supply_pickup): a dark stack tells it from a lamp"]
    reasons = {"frequency_hz": why}
    if depth - float(stdtrit(30.0, 0.999)) * u > 1.0:
        reason = f"{seen_rel}; of {hertz:.4g} Hz that would be more than the whole light"
        return replace(Estimates.empty(), reasons={"depth_rel": reason, "frequency_hz": why})
    values = np.array([min(depth, 1.0), hertz])
    covariance = np.array([[u * u, cross], [cross, u_hertz**2]])
    dof = np.array([max(2.0 * len(best.gain_rel), 1.0), np.inf])
    return Estimates(("depth_rel", "frequency_hz"), values, covariance, dof, ("1", "Hz"), METHOD, tuple(confounders), reasons=reasons)


def _limit_of(found: Sequence[FrameSequence]) -> Estimates:
    """Limit of the depth of a lamp on the mains that shows nothing in the frames, of the sequence that tells it best."""
    limits = []
    for s in found:
        if s.exposure_s <= 0:
            continue
        left = min(abs(float(np.sinc(f * s.exposure_s))) for f in MAINS_HZ)
        beat = any(abs((f * s.interval_s + 0.5) % 1.0 - 0.5) * len(s.gain_rel) < 1 for f in MAINS_HZ)  # so without an interval, too
        if left < 10 * LEAST_SINC or beat:
            continue
        swing = float(np.std(np.log(s.gain_rel) - np.log(s.fitted_rel)))
        limits.append((2 * np.sqrt(np.log(len(s.gain_rel) / 2 / 1e-3) / len(s.gain_rel)) * swing * (1 + ONE_SIDED_95 / 5) / left, swing))
    if not limits:
        timed = [s for s in found if s.exposure_s > 0]
        if not timed:
            hidden = "their exposure time is not said (exposure_s)"
        elif all(s.interval_s <= 0 for s in timed):
            hidden = "the time from frame to frame is not said (interval_s), and may hold whole periods of a lamp"
        else:
            hidden = "the exposure holds whole periods of the mains, or frames beat with it slowly"
        reason = f"no wave is seen in the light of the frames, but {hidden}: flicker is not told"
        return replace(Estimates.empty(), reasons={"depth_rel": reason})
    limit, swing = min(limits)
    why = {"depth_rel": "no wave is seen in the light of the frames; 95 % upper limit for a lamp of 100 or 120 Hz"}
    row = ("depth_rel", min(limit, 1.0), swing, np.inf, "1")
    return Estimates.from_rows([row], method=METHOD, limits=frozenset({"depth_rel"}), reasons=why)


def _frequency(lit: Sequence[FrameSequence], seen: Observations) -> tuple[float, float, str] | str:
    """The lamp's frequency with its u, and what it rests on; or why it is not told."""
    rolled = [s.wave for s in lit if s.wave is not None and s.wave.per_row > 0]
    line_s = 1e-6 * (seen.stated.line_time_us or 0.0)
    if rolled and line_s > 0:
        wave = min(rolled, key=lambda w: w.u_per_row)
        rough, u_rough = wave.per_row / line_s, wave.u_per_row / line_s
        of = next(s for s in lit if s.wave is wave)
        if of.interval_s > 0 and u_rough * of.interval_s < 1 / 8:
            turns = rough * of.interval_s
            best = np.rint(turns - wave.per_frame) + wave.per_frame
            if abs(best - turns) < 4 * u_rough * of.interval_s + 0.02:
                return float(best / of.interval_s), float(wave.u_per_frame / of.interval_s), _bands(line_s)
        return rough, u_rough, _bands(line_s)
    timed = [s for s in lit if s.interval_s > 0]
    if not timed:
        return "its frequency needs the time from frame to frame (interval_s or times_s)"
    candidates = [_candidates(s) for s in timed]
    common = candidates[0]
    for other in candidates[1:]:
        common = [
            ((f / u**2 + g / v**2) / (1 / u**2 + 1 / v**2), (1 / u**2 + 1 / v**2) ** -0.5)
            for f, u in common
            for g, v in other
            if abs(f - g) < 4 * np.hypot(u, v)
        ]
    if len(common) == 1:
        return (*common[0], f"the only one below {HIGHEST_HZ:g} Hz that {len(timed)} frame rates leave")
    if not common:
        return "the sequences show waves of different lamps"
    near = min(common, key=lambda c: min(abs(c[0] - m) for m in MAINS_HZ))
    some = f"{len(common)} frequencies below {HIGHEST_HZ:g} Hz look the same at this frame rate, {near[0]:.4g} Hz among them"
    return f"{some}: {UNFOLD}"


def _bands(line_s: float) -> str:
    return f"from bands over the rows; frequencies {1e-3 / line_s:.3g} kHz apart look the same"


def _candidates(s: FrameSequence) -> list[tuple[float, float]]:
    """Frequencies below `HIGHEST_HZ`, with u, that show the wave of a sequence."""
    assert s.wave is not None
    rate, fold = 1 / s.interval_s, abs(s.wave.per_frame)
    u = s.wave.u_per_frame * rate
    turns = sorted({n + sign * fold for n in range(int(HIGHEST_HZ / rate) + 2) for sign in (1, -1)})
    return [(t * rate, u) for t in turns if 1.0 <= t * rate <= HIGHEST_HZ]
