"""Sinusoidal patterns, fixed or moving, that stand out of the noise of the dark frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.observations import DefectList, PatternList, Spectra, StackMoments
from pixmetry.observe.photon_transfer_levels import core_spread_dn2
from pixmetry.observe.photon_transfer_model import slope_error_var, white_before_rounding
from pixmetry.observe.spectra import periodogram
from pixmetry.observe.surface import fill

BLOCK = 32  # ordinates along each side of a block in which the noise floor is taken to be flat
LOW_BINS = 3  # ordinates next to zero frequency, in both directions, that slow shading may fill
MAX_LINES = 16


@dataclass(frozen=True)
class _Line:
    moving: bool
    frequency_x: float
    frequency_y: float
    u_frequency_x: float
    u_frequency_y: float
    amplitude_dn: float
    u_amplitude_dn: float


def find_phase_patterns(
    dark_stack: StackMoments,
    dark_spectra: Spectra | None = None,
    defects: DefectList | None = None,
    *,
    false_alarm_rate: float = 1e-6,
    dnl_lsb: float = 0.0,
) -> PatternList:
    """Search the whole frequency plane for lines.

    Parameters
    ----------
    dark_stack : StackMoments
        Its mean map shows patterns that stand still.
    dark_spectra : Spectra, optional
        Its temporal periodogram shows patterns that move between frames.
    defects : DefectList, optional
        Pixels to leave out: one hot pixel fills the whole plane.
    false_alarm_rate : float
        Chance that the whole search of white or smoothly coloured noise finds anything.
    dnl_lsb : float
        Standard deviation of the converter's code widths.

    Returns
    -------
    PatternList
        Amplitudes are those of A sin(2π(ν_x x + ν_y y) + φ); a moving pattern is taken to have an arbitrary phase in each frame.

    Notes
    -----
    A periodogram ordinate of noise is exponentially distributed about the noise floor (Schuster 1898), the mean of P of them as
    χ²_2P/2P. The floor is the median of 32 × 32 ordinates; for its own scatter the threshold is that of F(2P, 2P·n_eff), with n_eff
    = n ln²2, the information that a median of n exponentials holds about their mean. Rows and columns are taken out first, so the axes
    are not searched, nor are ``LOW_BINS`` around zero. u of a fixed frequency is the Cramér–Rao bound of a single tone. u of an amplitude
    holds that rounding of little noise, and codes of unequal width, stretch it.
    """
    image = fill(dark_stack.mean_map_dn, defects.mask()) if defects is not None else dark_stack.mean_map_dn
    image = image - image.mean(axis=1, keepdims=True) - image.mean(axis=0, keepdims=True) + image.mean()
    temporal = dark_spectra.temporal_power_dn2 if dark_spectra is not None else None
    searches = 1 if temporal is None else 2
    rate = false_alarm_rate / searches
    searched = _searched(image.shape)
    lines, fixed_limit = _fixed_lines(image, searched, rate)
    moving_limit = math.nan
    if dark_spectra is not None and temporal is not None:
        moving, moving_limit = _moving_lines(temporal.astype(float), dark_spectra.n_pairs, image.shape[1], searched, rate)
        lines = [line for line in lines if not _is_leftover(line, moving, dark_stack.n_frames, image.shape)] + moving
    lines.sort(key=lambda line: -line.amplitude_dn)
    spread = core_spread_dn2(dark_stack)
    stretch = slope_error_var(white_before_rounding(dark_stack.ms_pixel_dn2, spread), spread, dnl_lsb)

    def column(name: str, dtype: type = float) -> np.ndarray:
        return np.array([getattr(line, name) for line in lines], dtype=dtype)

    return PatternList(
        moving=column("moving", bool),
        frequency_x=column("frequency_x"),
        frequency_y=column("frequency_y"),
        u_frequency_x=column("u_frequency_x"),
        u_frequency_y=column("u_frequency_y"),
        amplitude_dn=column("amplitude_dn"),
        u_amplitude_dn=np.hypot(column("u_amplitude_dn"), math.sqrt(stretch) * column("amplitude_dn")),
        false_alarm_rate=false_alarm_rate,
        n_searched=searches * int(searched.sum()),
        fixed_limit_dn=fixed_limit,
        moving_limit_dn=moving_limit,
    )


def _searched(shape: tuple[int, int]) -> np.ndarray:
    """Ordinates that are independent and off the axes: half of the plane, without the mirrored part of its first and last column."""
    rows, cols = shape
    mask = np.ones((rows, cols // 2 + 1), dtype=bool)
    mask[0, :] = mask[:, 0] = False
    low = np.minimum(np.arange(rows), rows - np.arange(rows)) <= LOW_BINS
    mask[np.ix_(low, np.arange(cols // 2 + 1) <= LOW_BINS)] = False
    if cols % 2 == 0:
        mask[rows // 2 + 1 :, -1] = False
        if rows % 2 == 0:
            mask[rows // 2, -1] = False  # real, hence χ² with one degree of freedom only
    return mask


def _floor(power: np.ndarray, searched: np.ndarray, pairs: int) -> tuple[np.ndarray, int]:
    """Noise floor at each ordinate from the median of its block, and the smallest number of ordinates in a block."""
    from scipy.special import gammaincinv

    floor = np.empty_like(power, dtype=float)
    median = float(gammaincinv(pairs, 0.5)) / pairs
    smallest = power.size
    for rows in np.array_split(np.arange(power.shape[0]), max(power.shape[0] // BLOCK, 1)):
        for cols in np.array_split(np.arange(power.shape[1]), max(power.shape[1] // BLOCK, 1)):
            block = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
            values = power[block][searched[block]]
            floor[block] = np.median(values) / median if values.size else np.inf
            smallest = min(smallest, values.size) if values.size else smallest
    return np.maximum(floor, 1e-12), smallest  # a noise-free image still has rounding errors


def _threshold(n_searched: int, pairs: int, block: int, rate: float) -> float:
    """Ratio of an ordinate to its floor that white noise exceeds anywhere with the given rate."""
    from scipy.special import fdtri

    per_ordinate = -math.expm1(math.log1p(-rate) / n_searched)
    return float(fdtri(2 * pairs, 2 * pairs * block * math.log(2) ** 2, 1 - per_ordinate))


def _is_leftover(line: _Line, moving: list[_Line], n_frames: int, shape: tuple[int, int]) -> bool:
    """Whether a fixed line is what L frames of arbitrary phase leave of a moving one: Rayleigh, below A√(ln 10⁶/L) but for 1e-6."""
    share = math.sqrt(math.log(1e6) / n_frames)
    return any(
        abs(line.frequency_x - other.frequency_x) * shape[1] < 1.5
        and abs(line.frequency_y - other.frequency_y) * shape[0] < 1.5
        and line.amplitude_dn < share * (other.amplitude_dn + 2 * other.u_amplitude_dn)
        for other in moving
    )


def _signed(row: float, rows: int) -> float:
    return (row / rows + 0.5) % 1.0 - 0.5


def _fixed_lines(image: np.ndarray, searched: np.ndarray, rate: float) -> tuple[list[_Line], float]:
    """Find, fit and subtract one line after the other until nothing stands out."""
    rows, cols = image.shape
    lines: list[_Line] = []
    image = image.copy()
    while True:
        power = periodogram(image)
        floor, block = _floor(power, searched, 1)
        threshold = _threshold(int(searched.sum()), 1, block, rate)
        ratio = np.where(searched, power / floor, 0.0)
        peak = np.unravel_index(ratio.argmax(), ratio.shape)
        if ratio[peak] < threshold or len(lines) == MAX_LINES:
            return lines, 2 * math.sqrt(threshold * float(np.median(floor[searched])) / image.size)
        line, tone = _fit_tone(image, peak[1] / cols, _signed(float(peak[0]), rows), float(floor[peak]))
        image -= tone
        lines.append(line)


def _fit_tone(image: np.ndarray, start_x: float, start_y: float, floor: float) -> tuple[_Line, np.ndarray]:
    """Least squares of a single tone: the maximum of the continuous periodogram near a bin."""
    from scipy.optimize import minimize

    rows, cols = image.shape
    x, y = np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2

    def transform(bins: np.ndarray) -> complex:
        wave_x = np.exp(-2j * np.pi * (start_x + bins[0] / cols) * x)
        wave_y = np.exp(-2j * np.pi * (start_y + bins[1] / rows) * y)
        return complex(wave_y @ (image @ wave_x))

    scale = abs(transform(np.zeros(2))) ** 2
    found = minimize(
        lambda bins: -(abs(transform(bins)) ** 2) / scale,
        np.zeros(2),
        method="Nelder-Mead",
        bounds=[(-0.75, 0.75)] * 2,
        options={"xatol": 1e-4, "fatol": 1e-9},
    )
    frequency_x, frequency_y = start_x + found.x[0] / cols, start_y + found.x[1] / rows
    phase = 2 * np.pi * (frequency_y * y[:, None] + frequency_x * x[None, :])
    cosine, sine = np.cos(phase), np.sin(phase)
    normal = np.array([[np.vdot(cosine, cosine), np.vdot(cosine, sine)], [np.vdot(cosine, sine), np.vdot(sine, sine)]])
    a, b = np.linalg.lstsq(normal, np.array([np.vdot(cosine, image), np.vdot(sine, image)]), rcond=None)[0]
    amplitude = math.hypot(a, b)
    # Rife & Boorstyn 1974, extended to two dimensions
    bound = math.sqrt(6 * floor / (math.pi**2 * amplitude**2 * image.size))
    line = _Line(False, frequency_x, frequency_y, bound / cols, bound / rows, amplitude, math.sqrt(2 * floor / image.size))
    return line, a * cosine + b * sine


def _moving_lines(power: np.ndarray, pairs: int, cols: int, searched: np.ndarray, rate: float) -> tuple[list[_Line], float]:
    """Lines in the mean periodogram of the frame pairs; what a stronger line leaks along its row and column is passed over."""
    rows = power.shape[0]
    floor, block = _floor(power, searched, pairs)
    threshold = _threshold(int(searched.sum()), pairs, block, rate)
    excess = power - floor
    above = np.argwhere(searched & (power > threshold * floor)).tolist()
    candidates = sorted(above, key=lambda k: -power[k[0], k[1]])
    lines: list[_Line] = []
    kept: list[tuple[int, int]] = []
    for row, col in candidates:
        leaked = sum(power[k] * _leak(row - k[0], rows) * _leak(col - k[1], cols) for k in kept)
        if power[row, col] < max(4 * leaked, threshold * float(floor[row, col])):
            continue
        if len(kept) == MAX_LINES:
            break
        kept.append((row, col))
        lines.append(_moving_line(excess, row, col, float(floor[row, col]), pairs, (rows, cols)))
    # the power of a tone of amplitude A and arbitrary phases is A² MN / 4
    return lines, 2 * math.sqrt((threshold - 1) * float(np.median(floor[searched])) / (rows * cols))


def _leak(distance: int, period: int) -> float:
    """Upper bound of the relative power that a tone leaves ``distance`` ordinates away from its highest one."""
    distance = abs((distance + period // 2) % period - period // 2)
    return 1.0 if distance <= 1 else 1 / (distance - 0.5) ** 2


def _between_ordinates(below: float, peak: float, above: float) -> tuple[float, float]:
    """How far a tone lies from its highest ordinate, in ordinates, and the share of its power that three ordinates hold.

    Power sinc²(k − δ) at the distance k: the two highest give δ = r/(1 + r) with r² their ratio (Rife & Vincent 1970).
    """
    root = math.sqrt(max(above, below, 0.0) / peak) if peak > 0 else 0.0
    shift = min(root / (1 + root), 0.5)
    share = float((np.sinc(np.arange(-1, 2) - shift) ** 2).sum())
    return (shift if above >= below else -shift), share


def _moving_line(excess: np.ndarray, row: int, col: int, floor: float, pairs: int, shape: tuple[int, int]) -> _Line:
    rows, cols = shape
    near_rows = (row + np.arange(-1, 2)) % rows
    near_cols = np.arange(max(col - 1, 1), min(col + 2, excess.shape[1]))
    near = excess[np.ix_(near_rows, near_cols)]
    of_cols = {int(k): float(v) for k, v in zip(near_cols - col, near.sum(axis=0), strict=True)}
    shift_x, share_x = _between_ordinates(of_cols.get(-1, 0.0), of_cols[0], of_cols.get(1, 0.0))
    shift_y, share_y = _between_ordinates(*near.sum(axis=1).tolist())
    frequency_x, frequency_y = (col + shift_x) / cols, _signed(row + shift_y, rows)
    total = max(float(near.sum()) / (share_x * share_y), floor)
    size = rows * cols
    amplitude = 2 * math.sqrt(total / size)
    # arbitrary phases: the power of a pair's difference scatters by half its mean squared; noise adds 2·signal·floor + 9 floor²
    u_total = math.sqrt((total**2 / 2 + 2 * total * floor + 9 * floor**2) / pairs)
    width = 1 / math.sqrt(12)  # somewhere within one ordinate
    return _Line(True, frequency_x, frequency_y, width / cols, width / rows, amplitude, 2 / size * u_total / amplitude)
