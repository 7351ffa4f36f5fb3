"""Rows of dark frames: hum of the supply, 1/f noise along the read-out, and what is left as noise of the rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.camera.dark_rows import DarkRows, octave_covariance
from pixmetry.camera.noise_covariance import CHARGE, WHITE, NoiseFilter
from pixmetry.camera.observations import PatternList, Spectra
from pixmetry.camera.stated import StatedFacts
from pixmetry.core.number import ONE_SIDED_95, Estimates
from pixmetry.observe.lamp_wave import strongest_wave
from pixmetry.observe.stack import RowMeans

LEAST_FRAMES, LEAST_ROWS = 8, 48
CHANCE = 1e-4  # of taking noise for a hum
BLOCK = 24  # ordinates whose median is the floor
LEAST_CYCLES = 4.0  # of a hum over the rows
FOUND_CHI2 = 25.0  # by which 1/f noise must improve the fit
BINS = 40  # of the spectrum along the rows, evenly in the logarithm
CORNERS = np.geomspace(0.004, 0.45, 14)
LEAST_TURNS = 2.5  # of the corner along a row, for 1/f noise that shows in its spectrum
TYPICAL_CORNER = 0.1  # for which a limit holds
LONGEST_LINE = 2.0  # pixel clocks from line to line over the pixels of a row, where the clocks are not stated: evenly from 1 to this
LEAST_WAVE = 12.0  # power of a wave over that of the noise of its column of the spectrum
LEAST_FIXED_WAVE = 40.0  # the same in the mean of the frames, of which there is one only
TWO_FIELDS = 1.25  # by which two fields must explain more than one frame
MOST_HZ = 5e6
FILTERED = "the frames are filtered"  # why 1/f noise is not told
SLOW_Z = 4.0  # of an excess at low frequencies of the means of the rows: white noise has it in 3e-5 of cameras
OF_SLOW, U_OF_SLOW = 1.75, 0.25  # all of 1/f noise in the means of the rows over that excess: evenly from 1.3 to 2.2
HUM_METHOD = "line in the periodogram of the means of the rows, from frame to frame"
FLICKER_METHOD = "periodograms along the rows and of their means, fitted by white noise, row noise and 1/f noise (Whittle)"


def reduce_dark_rows(
    rows: RowMeans,
    spectra: Spectra,
    shape: tuple[int, int],
    stated: StatedFacts,
    patterns: PatternList | None,
    noise_filter: NoiseFilter | None,
) -> DarkRows | None:
    """Find hum and 1/f noise in a stack of dark frames; None where it is too small.

    Parameters
    ----------
    rows : RowMeans
    spectra : Spectra
        Of the same stack.
    shape : tuple of int
        Rows and columns.
    stated : StatedFacts
        ``line_time_us`` and ``pixel_clock_mhz`` turn cycles into hertz.
    patterns : PatternList or None
        Waves off the axes, which are no hum.
    noise_filter : NoiseFilter or None
        Behind a filter the spectrum is not that of the camera's noise; charge that repels charge does nothing to dark frames.
    """
    means = np.array([rows.means[i] for i in sorted(rows.means)])
    if len(means) < LEAST_FRAMES or min(shape) < LEAST_ROWS:
        return None
    means = means - means.mean(axis=0)
    means = (means - means.mean(axis=(1, 2), keepdims=True)) * np.sqrt(len(means) / (len(means) - 1))
    whole = means.mean(axis=2)
    hum, line, scan = _hum_of(means, shape, stated, patterns)
    rest = whole if line is None else _without_line(whole, line[2], scan)
    power = np.abs(np.fft.rfft(rest, axis=1)) ** 2 / shape[0]
    frequency = np.arange(power.shape[1]) / shape[0]
    power = power.mean(axis=0)
    line_px, u_line_px = _line_px(stated, shape[1])
    taken: dict[str, tuple[float, float]] = {"hum": (0.0, 0.0), "row": (0.0, 0.0), "pixel": (0.0, 0.0)}
    if line is not None:
        taken["hum"] = (line[0] ** 2 / 2, line[0] * line[1])
    turn = (line[0], _turns_along(hum)) if line is not None and "per_col" in hum else (0.0, 0.0)
    lines = () if line is None else _ordinates_of(line[2], shape[0], scan)
    if noise_filter is not None and noise_filter.kind not in (WHITE, CHARGE):
        why = f"{FILTERED} ({noise_filter.name}), and their spectrum with them"
        flicker, fitted = replace(Estimates.empty(), reasons={"rms_dn": why}), np.full_like(power, np.nan)
        if noise_filter.along_row and line is None:  # which leaves the means of the rows as they are
            taken["row"] = _slow_rows(power, len(whole) - 1)
    else:
        size = (len(whole), *shape)
        flicker, fitted, parts = _flicker_of(spectra, power, lines, size, line_px, turn)
        if u_line_px and parts:
            flicker, parts = _of_any_line(flicker, parts, *_flicker_of(spectra, power, lines, size, line_px + u_line_px, turn)[::2])
        taken |= parts
    if line is not None and "per_col" in hum:
        within = _within_rows(hum, shape[1])
        taken["pixel"] = taken["pixel"][0] + within[0], float(np.hypot(taken["pixel"][1], within[1]))
    return DarkRows(len(whole), *shape, frequency, power, fitted, hum, flicker, line_px, u_line_px, taken)


def _slow_rows(power: np.ndarray, pairs: int) -> tuple[float, float]:
    """What 1/f noise gives to the means of the rows, from what their spectrum has more at low than at high frequencies; and its u.

    The noise of the rows themselves is white from row to row. A spectrum 1/f from one cycle a frame on has 1.4 times as much in all as its
    mean exceeds that of its upper half; one that is level below 0.09 cycles a row, 2.1 times.
    """
    slow, upper = power[1:], power[len(power) // 2 :]
    more = float(slow.mean() - upper.mean())
    u = float(slow.mean()) * np.sqrt(1 / (pairs * len(upper)) - 1 / (pairs * len(slow)))
    if more < SLOW_Z * u:
        return 0.0, 0.0
    return OF_SLOW * more, float(np.hypot(OF_SLOW * u, U_OF_SLOW * more))


def _line_px(stated: StatedFacts, cols: int) -> tuple[float, float]:
    """Pixel clocks from line to line, and their u: none where the clocks are stated."""
    if stated.line_time_us and stated.pixel_clock_mhz:
        return max(stated.line_time_us * stated.pixel_clock_mhz, float(cols)), 0.0
    return 0.5 * (1 + LONGEST_LINE) * cols, (LONGEST_LINE - 1) / float(np.sqrt(12)) * cols


def _of_any_line(
    flicker: Estimates, parts: dict[str, tuple[float, float]], other: Estimates, of_other: dict[str, tuple[float, float]]
) -> tuple[Estimates, dict[str, tuple[float, float]]]:
    """1/f noise and what it gives to rows and pixels, with the change by one u of the line's length in their u."""
    if not of_other:
        return flicker, parts
    change = other.values - flicker.values
    wider = {name: (value, float(np.hypot(u, of_other[name][0] - value))) for name, (value, u) in parts.items()}
    return replace(flicker, covariance=flicker.covariance + np.outer(change, change)), wider


def _turns_along(hum: Estimates) -> float:
    """Cycles per column of a hum."""
    return abs(hum["per_col"].value)


def _within_rows(hum: Estimates, cols: int) -> tuple[float, float]:
    """Variance that a hum gives to the pixels about the means of their rows, and its u."""
    amplitude, per_col = hum["amplitude_dn"], hum["per_col"]

    def of(size: float, turns: float) -> float:
        return float(size**2 / 2 * (1 - np.sinc(turns * cols) ** 2))

    at = abs(per_col.value)
    square = of(amplitude.value, at)
    return square, float(np.hypot(of(amplitude.value + amplitude.u, at) - square, of(amplitude.value, at + per_col.u) - square))


def without_hum(patterns: PatternList | None, rows: DarkRows | None, spectra: Spectra | None) -> PatternList | None:
    """The waves without what a hum leaves of itself in the first columns of their spectrum, and without 1/f noise that rises there."""
    if patterns is None or rows is None or spectra is None:
        return patterns
    untold = any(reason.startswith(FILTERED) for reason in rows.flicker.reasons.values())
    if untold or (len(rows.flicker) and not rows.flicker.limits):
        place, last = patterns.frequency_x * rows.cols, len(spectra.frequency_h) - 1
        beside = [np.clip(to(place).astype(int), np.rint(place) >= 1, last) for to in (np.floor, np.ceil)]  # in column 0 rows differ, too
        noise = np.maximum(*(spectra.temporal_h_dn2[column] for column in beside))
        power = patterns.amplitude_dn**2 * rows.rows * rows.cols / 4
        least = np.where(patterns.moving, LEAST_WAVE, LEAST_FIXED_WAVE / rows.frames)
        patterns = _kept(patterns, power > least * noise)
    if "per_row" not in rows.hum:
        return patterns
    near_y = np.abs(np.abs(patterns.frequency_y) - rows.hum["per_row"].value) < 2 / rows.rows
    keep = ~(near_y & (patterns.frequency_x < 2.5 / rows.cols) & patterns.moving)
    return _kept(patterns, keep)


def _kept(patterns: PatternList, keep: np.ndarray) -> PatternList:
    per_wave = ("moving", "frequency_x", "frequency_y", "u_frequency_x", "u_frequency_y", "amplitude_dn", "u_amplitude_dn")
    return replace(patterns, **{name: getattr(patterns, name)[keep] for name in per_wave})


def _ordinates_of(per_row: float, rows: int, scan: str) -> tuple[int, ...]:
    """Ordinates of the periodogram that a hum fills."""
    places = [per_row] if scan == "progressive" else [per_row / 2, 0.5 - per_row / 2]
    return tuple(int(k) for p in places for k in np.arange(np.floor(p * rows) - 2, np.ceil(p * rows) + 3) if 0 <= k <= rows // 2)


def _hum_of(
    means: np.ndarray, shape: tuple[int, int], stated: StatedFacts, patterns: PatternList | None
) -> tuple[Estimates, tuple[float, float, float] | None, str]:
    """Estimates of the hum; its amplitude, u and cycles per line, None without; and how the rows are read."""
    found = _coherent_line(means, shape[1]) or _line_of(means, shape[1])
    scan = "progressive"
    if stated.interface == "analogue":
        fields = _line_of(np.concatenate([means[:, ::2][:, : shape[0] // 2], means[:, 1::2][:, : shape[0] // 2]]), shape[1])
        if fields is not None and (found is None or fields.amplitude**2 > TWO_FIELDS * found.amplitude**2):
            found, scan = fields, "interlaced"
    if found is None:
        limit = _line_limit(means)
        seen = "no line of the spectrum of the rows is significant; 95 % upper limit for four cycles or more a frame"
        why = f"{seen}, or a hum that goes on from frame to frame; one that stands still is fixed pattern"
        row = ("amplitude_dn", limit, limit / 4, np.inf, "DN")
        return Estimates.from_rows([row], method=HUM_METHOD, limits=frozenset({"amplitude_dn"}), reasons={"amplitude_dn": why}), None, scan
    if patterns is not None and abs(found.per_col) * shape[1] > 1:
        near = np.abs(np.abs(patterns.frequency_y) - found.per_row) < 2 / shape[0]
        if (near & patterns.moving).any():
            why = "the wave of the rows turns along them: it counts as grabber.phase_pattern"
            return replace(Estimates.empty(), reasons={"amplitude_dn": why}), None, scan
    hertz_of = (0.0, "") if stated.line_time_us is None else _hertz(found, stated.line_time_us, stated.pixel_clock_mhz)
    if found.slow:
        still = "the hum stands nearly still from frame to frame: its amplitude counts in part as fixed pattern"
        none = replace(Estimates.empty(), reasons={"amplitude_dn": f"{still}; take the frames at another rate"})
        # half of what is seen of it, with that for its u, is taken off the noise of the rows
        return none, (found.amplitude / 2**0.5, found.amplitude / 8**0.5, found.per_row), scan
    clocked = stated.line_time_us is not None and stated.pixel_clock_mhz is not None
    if stated.line_time_us is not None and stated.pixel_clock_mhz is not None:
        per_col, u_per_col = hertz_of[0] * 1e-6 / stated.pixel_clock_mhz, 0.0
    else:
        per_col, u_per_col = abs(found.per_col) if abs(found.per_col) > 4 * found.u_per_col else 0.0, found.u_per_col
    left = abs(float(np.sinc(per_col * shape[1])))
    if left < 0.1:
        why = "the wave of the rows turns along them: it counts as grabber.phase_pattern"
        return replace(Estimates.empty(), reasons={"amplitude_dn": why}), None, scan
    by_turn = found.amplitude * np.pi**2 / 3 * max(per_col, u_per_col) * u_per_col * shape[1] ** 2
    found = replace(found, amplitude=found.amplitude / left, u_amplitude=float(np.hypot(found.u_amplitude, by_turn)) / left)
    found = replace(found, per_col=per_col, u_per_col=0.0) if clocked else found
    rows = [
        ("amplitude_dn", found.amplitude, found.u_amplitude, 2.0 * len(means), "DN"),
        ("per_row", found.per_row, found.u_per_row, np.inf, "1/px"),
        ("per_col", found.per_col, found.u_per_col, np.inf, "1/px"),
    ]
    reasons = {}
    if stated.line_time_us is None:
        seen = f"a wave of {found.amplitude:.2g} DN and {found.per_row:.4g} cycles a row"
        reasons["frequency_hz"] = f"{seen}: its hertz need camera.line_time_us"
    else:
        hertz, reasons["frequency_hz"] = hertz_of
        rows.append(("frequency_hz", hertz, found.u_per_row / stated.line_time_us * 1e6, np.inf, "Hz"))
    told = Estimates.from_rows(rows, method=HUM_METHOD, reasons=reasons, settings={"scan": scan})
    return told, (found.amplitude, found.u_amplitude, found.per_row), scan


@dataclass(frozen=True)
class _Line:
    amplitude: float
    u_amplitude: float
    per_row: float
    u_per_row: float
    per_col: float
    u_per_col: float
    slow: bool = False  # stands nearly still from frame to frame


def _line_of(means: np.ndarray, cols: int) -> _Line | None:
    """The strongest line in the rows of frames, shape (frames, rows, parts), each with a phase of its own; None if none stands out."""
    from scipy.optimize import minimize_scalar
    from scipy.special import fdtri, gammaincinv

    frames, rows, parts = means.shape
    whole = means.mean(axis=2)
    power = (np.abs(np.fft.rfft(whole, axis=1)) ** 2 / rows).mean(axis=0)
    median = float(gammaincinv(frames, 0.5)) / frames
    floor = np.array([_floor(power, k) for k in range(len(power))]) / median
    ratio = power / np.maximum(floor, 1e-12)
    lowest = int(np.ceil(LEAST_CYCLES))
    ratio[:lowest] = 0.0
    ratio[-1] = 0.0
    k = int(np.argmax(ratio))
    chance = CHANCE / (len(power) - lowest)
    if ratio[k] < fdtri(2 * frames, 2 * frames * BLOCK * np.log(2) ** 2, 1 - chance):
        return None
    y = np.arange(rows) - (rows - 1) / 2

    def transform(f: float) -> np.ndarray:
        return np.asarray(np.einsum("frp,r->fp", means, np.exp(-2j * np.pi * f * y)))

    best = minimize_scalar(
        lambda f: -float((np.abs(transform(f).mean(axis=1)) ** 2).sum()),
        bounds=((k - 1) / rows, (k + 1) / rows),
        method="bounded",
        options={"xatol": 1e-7},
    )
    per_row, noise = float(best.x), float(floor[k])
    z = transform(per_row)
    turn = (z[:, 1:] * z[:, :-1].conj()).sum()
    per_col = float(np.angle(turn)) / (2 * np.pi) * parts / cols
    angle = 2 * np.pi * per_row * y
    basis = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inverse = np.linalg.inv(basis.T @ basis)
    of_noise = noise * float(np.trace(inverse))
    square = float(((whole @ basis @ inverse) ** 2).sum(axis=1).mean()) - of_noise
    if square <= 0:
        return None
    seen = np.sqrt(square)
    u_square = np.sqrt((2 * square * of_noise + of_noise**2) / frames)
    u_seen = float(u_square / (2 * seen))
    u_per_row = float(np.sqrt(6 * noise / (np.pi**2 * square * rows**3 * frames)))
    u_phase = float(np.sqrt(2 * noise * parts / (square * rows * frames)))  # of a part, in radians
    u_per_col = u_phase * np.sqrt(2 / (parts - 1)) / (2 * np.pi) * parts / cols / np.sqrt(parts - 1)
    own = z.mean(axis=1)
    step = (own[1:] * own[:-1].conj()).sum() / max(float((np.abs(own) ** 2).sum()), 1e-12)
    slow = bool(abs(step) > 0.6 and abs(np.angle(step)) < 2 * np.pi / frames)
    return _Line(float(seen), u_seen, per_row, u_per_row, per_col, float(max(u_per_col, 1e-9)), slow)


def _coherent_line(means: np.ndarray, cols: int) -> _Line | None:
    """A line that goes on from frame to frame, as of a camera that runs freely; it may have less than a cycle over the rows."""
    frames, rows, parts = means.shape
    whole = means.mean(axis=2)
    found = strongest_wave(whole - whole.mean(axis=1, keepdims=True), np.arange(frames, dtype=float), np.arange(rows))
    if found is None:
        return None
    angle = 2 * np.pi * found.per_row * np.arange(rows)
    basis = np.stack([np.cos(angle), np.sin(angle), np.ones(rows)], axis=1)
    fitted = np.einsum("frp,rk->fpk", means, basis @ np.linalg.inv(basis.T @ basis))
    z = fitted[..., 0] - 1j * fitted[..., 1]
    per_col = float(np.angle((z[:, 1:] * z[:, :-1].conj()).sum())) / (2 * np.pi) * parts / cols
    u_phase = found.u_amplitude_rel / found.amplitude_rel * np.sqrt(2 * parts)
    u_per_col = u_phase * np.sqrt(2) / (parts - 1) / (2 * np.pi) * parts / cols
    whole_again = np.sqrt((frames - 1) / frames)  # the mean over the frames takes nothing of a wave that goes on
    amplitude, u_amplitude = found.amplitude_rel * whole_again, found.u_amplitude_rel * whole_again
    slow = abs(found.per_frame) * frames < 0.75
    return _Line(amplitude, u_amplitude, found.per_row, found.u_per_row, per_col, float(max(u_per_col, 1e-9)), slow)


def _floor(power: np.ndarray, k: int) -> float:
    """Median of the ordinates on either side of one, the higher of the two: noise may rise towards low frequencies."""
    left, right = power[max(1, k - BLOCK // 2) : max(k - 1, 1)], power[k + 2 : k + 2 + BLOCK // 2]
    if len(left) < 3:
        return float(max(left.max(initial=0.0), np.median(right)))
    return float(max(np.median(left), np.median(right) if len(right) > 2 else 0.0))


def _without_line(whole: np.ndarray, per_line: float, scan: str) -> np.ndarray:
    """Means of rows, shape (frames, rows), without a hum whose phase is free in each frame (each field)."""
    out = whole.copy()
    for first, stride in ((0, 1),) if scan == "progressive" else ((0, 2), (1, 2)):
        part = whole[:, first::stride]
        angle = 2 * np.pi * per_line * np.arange(part.shape[1])
        basis = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        out[:, first::stride] = part - (basis @ np.linalg.lstsq(basis, part.T, rcond=None)[0]).T
    return out


def _line_limit(means: np.ndarray) -> float:
    """Amplitude that would be found in nearly all cases, DN."""
    frames, rows = means.shape[:2]
    power = (np.abs(np.fft.rfft(means.mean(axis=2), axis=1)) ** 2 / rows).mean(axis=0)
    floor = float(np.median(power[1:]))
    excess = 6 * np.sqrt(2 / frames) + 12 / frames  # over the floor, of a mean of so many exponentials
    return float(2 * np.sqrt(floor * excess / rows) * (1 + ONE_SIDED_95 / 4))


def _hertz(line: _Line, line_time_us: float, pixel_clock_mhz: float | None) -> tuple[float, str]:
    """Frequency of a hum, and what it rests on."""
    rate = 1e6 / line_time_us
    lowest = line.per_row * rate
    if pixel_clock_mhz is None or abs(line.per_col) < 4 * line.u_per_col:
        return lowest, f"the lowest that shows this wave; {rate:.5g} Hz more, or its mirror image, look the same"
    turns = abs(line.per_col) * pixel_clock_mhz * 1e6
    candidates = np.array([n * rate + sign * lowest for n in range(int(MOST_HZ / rate) + 2) for sign in (1, -1)])
    candidates = candidates[candidates > 0]
    sign = np.where(np.isclose((candidates / rate) % 1.0, line.per_row % 1.0, atol=1e-6), 1, -1)
    fits = candidates[(np.abs(candidates - turns) < 4 * line.u_per_col * pixel_clock_mhz * 1e6) & (sign == np.sign(line.per_col))]
    if len(fits) != 1:
        return lowest, f"the lowest that shows this wave; {rate:.5g} Hz more, or its mirror image, look the same"
    return float(fits[0]), "the only one that turns so far along a row"


def _flicker_of(
    spectra: Spectra, power: np.ndarray, lines: tuple[int, ...], size: tuple[int, int, int], line_px: float, hum: tuple[float, float]
) -> tuple[Estimates, np.ndarray, dict[str, tuple[float, float]]]:
    """1/f noise by both spectra; the fitted spectrum of the rows' means; and the variances that it gives to rows and pixels."""
    from scipy.optimize import minimize_scalar

    frames, rows, cols = size
    along, data_h, weight_h, of_hum = _binned(spectra, rows, hum)
    ordinates = np.array([k for k in range(1, len(power) - 1) if k not in lines])
    data_v, weight_v = power[ordinates], np.full(len(ordinates), float(frames - 1))
    data, weight = np.concatenate([data_h, data_v]), np.concatenate([weight_h, weight_v])
    if not data.any():
        same = "the frames are all the same: rounding hides the noise; raise the black level, or the gain"
        return replace(Estimates.empty(), reasons={"rms_dn": same}), np.full_like(power, np.nan), {}
    shapes = {c: _shapes(float(c), along, ordinates, size, line_px) for c in (*CORNERS, TYPICAL_CORNER)}

    def design(shape: np.ndarray) -> np.ndarray:
        white = np.concatenate([np.ones(len(data_h)), np.full(len(data_v), 1 / cols)])
        own = np.concatenate([np.zeros(len(data_h)), np.ones(len(data_v))])
        parts = [shape, white, own, np.concatenate([of_hum, np.zeros(len(data_v))])]
        return np.stack(parts if of_hum.any() else parts[:3], axis=1)

    def solved(shape: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        return _whittle(design(shape), data, weight)

    none = _whittle(design(np.zeros(len(data))), data, weight)
    costs = [solved(shapes[c])[0] for c in CORNERS]
    best = int(np.argmin(costs))
    if none[0] - costs[best] < FOUND_CHI2 * max(costs[best] / len(data), 1.0):
        _, values, covariance = solved(shapes[TYPICAL_CORNER])
        limit = float(np.sqrt(max(values[0], 0.0) + ONE_SIDED_95 * np.sqrt(covariance[0, 0])))
        u = float(np.sqrt(covariance[0, 0]) / (2 * max(limit, 1e-9)))
        why = {"rms_dn": f"the spectra need none; 95 % upper limit for a corner at {TYPICAL_CORNER:g} of the pixel clock"}
        row = ("rms_dn", limit, u, np.inf, "DN")
        fitted = _rows_of(design(np.zeros(len(data))) @ none[1], ordinates, len(data_h), power)
        return Estimates.from_rows([row], method=FLICKER_METHOD, limits=frozenset({"rms_dn"}), reasons=why), fitted, {}
    edges = np.log(CORNERS[[max(best - 1, 0), min(best + 1, len(CORNERS) - 1)]])
    corner = float(
        np.exp(
            minimize_scalar(
                lambda c: solved(_shapes(float(np.exp(c)), along, ordinates, size, line_px))[0],
                bounds=edges.tolist(),
                method="bounded",
                options={"xatol": 2e-3},
            ).x
        )
    )
    if corner < LEAST_TURNS / cols:
        slow = "the means of the rows change slowly from row to row, but the noise along the rows is white"
        slow_shape = _shapes(corner, along, ordinates, size, line_px)
        fitted = _rows_of(design(slow_shape) @ solved(slow_shape)[1], ordinates, len(data_h), power)
        return replace(Estimates.empty(), reasons={"rms_dn": f"{slow}: no 1/f noise of the read-out"}), fitted, {}
    shape = _shapes(corner, along, ordinates, size, line_px)
    cost, values, _ = solved(shape)
    step = 1.05
    slope = values[0] * (_shapes(corner * step, along, ordinates, size, line_px) - shape) / np.log(step)
    model = design(shape) @ values
    full = np.column_stack([design(shape), slope]) / model[:, None]
    scatter = max(cost / max(len(data) - 4, 1), 1.0)
    covariance = np.linalg.pinv(full.T @ (weight[:, None] * full), hermitian=True) * scatter
    rms = float(np.sqrt(values[0]))
    octaves = _octaves(corner, size, line_px)
    at = [0, len(covariance) - 1]
    jacobian = np.diag([1 / (2 * rms), corner])
    joint = jacobian @ covariance[np.ix_(at, at)] @ jacobian
    units = ("DN", "1")
    why = {"rms_dn": f"down to {octaves} octaves below the corner, one cycle a frame; slower noise is not seen"}
    found = Estimates(
        ("rms_dn", "corner_rel"),
        np.array([rms, corner]),
        joint,
        np.full(2, np.inf),
        units,
        FLICKER_METHOD,
        reasons=why,
        settings={"octaves": octaves},
    )
    u_square = float(np.sqrt(covariance[0, 0]) / values[0])
    inside = float(_in_rows(corner, octaves, cols)) * values[0]
    between = values[0] * _about_frame(_of_means(corner, octaves, size, line_px))
    parts = {"row": (between, between * u_square), "pixel": (inside, inside * u_square)}
    return found, _rows_of(model, ordinates, len(data_h), power), parts


def _rows_of(model: np.ndarray, ordinates: np.ndarray, first: int, power: np.ndarray) -> np.ndarray:
    fitted = np.full(len(power), np.nan)
    fitted[ordinates] = model[first:]
    return fitted


def _binned(spectra: Spectra, rows: int, hum: tuple[float, float]) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Ordinates of the spectrum along the rows in bins; its mean in each; half the degrees of freedom; and what a hum gives to them.

    A hum of an amplitude and so many cycles per pixel gives A²/4 N sinc² of the distance, times what the phases of the pairs of frames make
    of it: a factor that is fitted.
    """
    count, cols = len(spectra.frequency_h), round(1 / spectra.frequency_h[1])
    along = np.arange(count)
    turned = hum[0] ** 2 / 4 * cols * (np.sinc(along - hum[1] * cols) ** 2 + np.sinc(along + hum[1] * cols) ** 2)
    edges = np.unique(np.rint(np.geomspace(1, count - 1, BINS)).astype(int))
    bins = [np.arange(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    data, of_hum = (np.array([values[b].mean() for b in bins]) for values in (spectra.temporal_h_dn2, turned))
    return bins, data, np.array([len(b) for b in bins], float) * spectra.n_pairs * (rows - 1), of_hum


def _octaves(corner: float, size: tuple[int, int, int], line_px: float) -> int:
    """Octaves from the corner down to one cycle a frame."""
    return int(np.clip(np.ceil(np.log2(corner * line_px * size[1])), 1, 32))


def _shapes(corner: float, bins: list[np.ndarray], ordinates: np.ndarray, size: tuple[int, int, int], line_px: float) -> np.ndarray:
    """Expected spectra, along the rows and of their means, of 1/f noise of variance 1: means over the lags of its covariance."""
    _, rows, cols = size
    octaves = _octaves(corner, size, line_px)
    lag = np.arange(cols)
    triangle = (1 - lag / cols) * octave_covariance(corner, octaves, lag)
    along = 2 * np.fft.rfft(triangle, cols).real - triangle[0]
    between = _of_means(corner, octaves, size, line_px)
    wedge = (1 - np.arange(rows) / rows) * between
    of_means = 2 * np.fft.rfft(wedge, rows).real - wedge[0]
    return np.concatenate([[along[b].mean() for b in bins], of_means[ordinates]])


def _of_means(corner: float, octaves: int, size: tuple[int, int, int], line_px: float) -> np.ndarray:
    """Covariance of the means of rows 0, 1, … apart, for a variance of 1."""
    _, rows, cols = size
    lags = np.arange(1 - cols, cols)
    weight = (cols - np.abs(lags)) / cols**2
    near = min(rows, 100)  # lines apart; beyond, the covariance changes slowly
    apart = np.unique(np.concatenate([np.arange(near), np.linspace(near - 1, rows - 1, 40).astype(int)]))
    each = [float(weight @ octave_covariance(corner, octaves, a * line_px + lags)) for a in apart]
    return np.asarray(np.interp(np.arange(rows), apart, each))


def _about_frame(between: np.ndarray) -> float:
    """Variance of the means of rows about that of their frame."""
    apart = np.arange(1, len(between))
    return float(between[0] - (between[0] + 2 * ((1 - apart / len(between)) @ between[1:])) / len(between))


def _in_rows(corner: float, octaves: int, cols: int) -> float:
    """Share of the variance that is within rows, not in their means."""
    lags = np.arange(1 - cols, cols)
    return 1 - float(((cols - np.abs(lags)) / cols**2) @ octave_covariance(corner, octaves, lags))


def _whittle(design: np.ndarray, data: np.ndarray, weight: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Non-negative parts of a spectrum by Whittle's likelihood: deviance, values, covariance.

    Deviance 2 Σ w (D/P − 1 − ln D/P), with w half the degrees of freedom of each mean D of a periodogram.
    """
    from scipy.optimize import nnls

    data = np.maximum(data, 1e-12)  # an ordinate of nothing is one of nearly nothing: its logarithm is finite
    model = data
    for _ in range(8):
        scale = np.sqrt(weight) / model
        values = nnls(design * scale[:, None], data * scale)[0]
        model = np.maximum(design @ values, 1e-12)
    used = design.any(axis=0)
    scaled = design[:, used] / model[:, None]
    covariance = np.zeros((design.shape[1],) * 2)
    covariance[np.ix_(used, used)] = np.linalg.pinv(scaled.T @ (weight[:, None] * scaled), hermitian=True)
    ratio = data / model
    return float(2 * (weight * (ratio - 1 - np.log(ratio))).sum()), values, covariance
