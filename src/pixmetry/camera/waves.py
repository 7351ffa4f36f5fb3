"""Sinusoids over the frame, sin 2π(ν_x c + ν_y r + φ): drawn, fitted and taken out, and what they do to a target."""

from __future__ import annotations

import numpy as np

from pixmetry.camera.contribution import Probe
from pixmetry.camera.signal import Signal

CLIP = 4.0  # robust standard deviations beyond which a pixel is not background
BLOCK_PX = 32  # side of the blocks whose medians follow uneven light
MARGIN_PX = 3  # around the pixels of targets
CHANCE = 0.05  # of taking noise for a wave
AROUND = np.array([-7, -5, -3, 0, 3, 5, 7])  # bins of the window's spectrum, off the wave, where its noise is read
SURFACE = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of y and x
FEWEST_PIXELS = 32  # of background, for a fit


def wave(signal: Signal, frequency_x: float, frequency_y: float, phase: np.ndarray) -> np.ndarray:
    """Sinusoid of amplitude 1 on the windows of a signal, shape (n, rows, cols), float32.

    Frequencies in cycles per pixel; ``phase``, shape (n,), in turns at pixel (0, 0). Whole turns are taken off in float64 before the sine.
    """
    # sin(a + b) from the sines of rows and columns: two short vectors instead of a sine for every pixel
    row = 2 * np.pi * ((frequency_y * signal.rows) % 1.0 + np.asarray(phase, float)[:, None])
    col = 2 * np.pi * ((frequency_x * signal.cols) % 1.0)
    row_sin, row_cos, col_sin, col_cos = (v.astype(np.float32) for v in (np.sin(row), np.cos(row), np.sin(col), np.cos(col)))
    out = row_sin[:, :, None] * col_cos[:, None, :]
    out += row_cos[:, :, None] * col_sin[:, None, :]
    return out


def without_wave(signal: Signal, frequency_x: float, frequency_y: float, most_dn: float = np.inf) -> np.ndarray | None:
    """Fit amplitude and phase of a sinusoid to the background of every window, and return the data minus its significant part.

    Parameters
    ----------
    signal : Signal
    frequency_x, frequency_y : float
        Cycles per pixel.
    most_dn : float
        Largest amplitude that can be this sinusoid's; one beyond it is the scene's own, and stays.

    Returns
    -------
    ndarray, shape (n, rows, cols), float32, or None
        A window whose background does not carry the sinusoid beyond chance is as it was; None if none of them does.

    Notes
    -----
    Targets have a spectrum of their own, and a lattice of them has lines in it, by far higher than any wave: they are left out. A pixel is
    a target's where it differs by more than `CLIP` robust standard deviations from the median of its block, or lies within `MARGIN_PX` of
    such a one. The rest is fitted by least squares with a surface of degree 2, so that uneven light is not taken for the wave, nor the
    holes for a spectrum. The noise of the fitted (complex) amplitude a comes from the same frame: from what is left at the frequencies
    around, which a white noise has too, times the variance that the normal equations give; and from the change of a when the margin is
    twice as wide, which is what faint surroundings of the targets do. Where |a|² does not reach ln(1/`CHANCE`) of that mean square n²
    (that of noise is exponentially distributed), nothing is taken off; else a (1 − n²/|a|²), the linear predictor of least mean square
    error with |a|² − n² for the power of the wave.
    """
    row, col = np.exp(2j * np.pi * frequency_y * signal.rows), np.exp(2j * np.pi * frequency_x * signal.cols)
    out, changed = np.array(signal.data, np.float32), False
    for i, frame in enumerate(signal.data):
        amplitude = _background_wave(np.asarray(frame, float), row[i], col[i])
        if 0 < abs(amplitude) <= most_dn:
            changed = True
            out[i] = frame - np.outer(amplitude * row[i], col[i]).real
    return out if changed else None


def _background_wave(data: np.ndarray, row: np.ndarray, col: np.ndarray) -> complex:
    """Significant part of the complex amplitude a of Re(a z), z = row × col, in one window."""
    amplitude = 0j
    for _ in range(2):
        target, sigma = _targets(data - np.outer(amplitude * row, col).real if amplitude else data)
        found = _fit_wave(data, ~_spread(target, MARGIN_PX), row, col)
        if found is None:
            return 0j
        amplitude, noise2 = found
        if abs(amplitude) < sigma / 2:  # else the deviations are looked at again without the wave among them
            break
    if abs(amplitude) ** 2 <= noise2 * np.log(1 / CHANCE):
        return 0j
    if target.any():
        wider = _fit_wave(data, ~_spread(target, 2 * MARGIN_PX), row, col)
        noise2 += 0.0 if wider is None else abs(wider[0] - amplitude) ** 2
    power = abs(amplitude) ** 2
    return amplitude * (1 - noise2 / power) if power > noise2 * np.log(1 / CHANCE) else 0j


def _targets(data: np.ndarray) -> tuple[np.ndarray, float]:
    """Pixels that are not background, bool: far from the median of their block; and the robust standard deviation of all."""
    off = np.empty_like(data)
    for rows in np.array_split(np.arange(data.shape[0]), max(data.shape[0] // BLOCK_PX, 1)):
        for cols in np.array_split(np.arange(data.shape[1]), max(data.shape[1] // BLOCK_PX, 1)):
            block = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
            off[block] = np.abs(data[block] - np.median(data[block]))
    sigma = 1.4826 * float(np.median(off))
    return off > CLIP * sigma, sigma


def _spread(mask: np.ndarray, reach: int) -> np.ndarray:
    """The mask and all within ``reach`` pixels of it along rows and columns."""
    for axis in (0, 1):
        lines = np.moveaxis(mask, axis, 0)
        wide = lines.copy()
        for step in range(1, min(reach, len(lines) - 1) + 1):
            wide[step:] |= lines[:-step]
            wide[:-step] |= lines[step:]
        mask = np.moveaxis(wide, 0, axis)
    return mask


def _fit_wave(data: np.ndarray, keep: np.ndarray, row: np.ndarray, col: np.ndarray) -> tuple[complex, float] | None:
    """Least squares of surface and sinusoid over the kept pixels: complex amplitude, and mean square of its noise; None if too few.

    All terms are products of a row's and a column's, so the normal equations are products of matrices with the mask between them.
    """
    pixels, (rows, cols) = int(keep.sum()), data.shape
    if pixels < FEWEST_PIXELS:
        return None
    y, x = np.linspace(-1, 1, rows), np.linspace(-1, 1, cols)
    of_rows = np.array([y**p for p, _ in SURFACE] + [row, row.conj()])
    of_cols = np.array([x**q for _, q in SURFACE] + [col, col.conj()])
    one, other = np.triu_indices(len(of_rows))
    weight = keep.astype(float)
    level = float(data[keep].mean())
    part = np.where(keep, data - level, 0.0)
    normal = np.zeros((len(of_rows),) * 2, complex)
    pairs = (of_cols[one].conj() * of_cols[other]).T
    summed = weight @ np.ascontiguousarray(pairs.real) + 1j * (weight @ np.ascontiguousarray(pairs.imag))
    normal[one, other] = (summed * (of_rows[one].conj() * of_rows[other]).T).sum(axis=0)
    normal += np.triu(normal, 1).conj().T
    moments = ((part @ of_cols.conj().T) * of_rows.conj().T).sum(axis=0)
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    fitted = inverse @ moments
    left = np.where(keep, part - ((of_rows.T * fitted) @ of_cols).real, 0.0)
    rows_off = row * np.exp(2j * np.pi * AROUND[:, None] * np.arange(rows) / rows)
    cols_off = col * np.exp(2j * np.pi * AROUND[:, None] * np.arange(cols) / cols)
    around = np.abs(rows_off.conj() @ left @ cols_off.conj().T) ** 2 / pixels  # of white noise: its variance on average
    density = float(np.median(np.delete(around.ravel(), around.size // 2))) / np.log(2)  # of an exponential distribution
    return 2 * complex(fitted[-2]), 4 * density * float(inverse[-2, -2].real)


def shift_per_dn(probe: Probe, frequency_x: float, frequency_y: float) -> tuple[float, float]:
    """Propagator P2: rms shift in x and y (px) per DN of amplitude, averaged over the phase: |Σ g exp 2πi(ν_x c + ν_y r)| / √2."""
    rows, cols = probe.gx.shape[1:]
    angle = 2 * np.pi * (frequency_y * np.arange(rows)[:, None] + frequency_x * np.arange(cols)[None, :])
    cosine, sine = probe.field(np.cos(angle)), probe.field(np.sin(angle))
    u_x, u_y = (float(np.sqrt(np.mean(cosine[a] ** 2 + sine[a] ** 2) / 2)) for a in (0, 1))
    return u_x, u_y
