"""Sinusoids over the frame, sin 2π(ν_x c + ν_y r + φ): drawn, fitted and taken out, and what they do to a target."""

from __future__ import annotations

import numpy as np

from pixmetry.core.contribution import Probe
from pixmetry.core.signal import Signal


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


def without_wave(signal: Signal, frequency_x: float, frequency_y: float) -> np.ndarray:
    """Fit amplitude and phase to every window by least squares beside a constant, and return the data less the sinusoid, float32.

    With z = exp(2πi(ν_x c + ν_y r)) = z_r z_c all sums are products of a row's and a column's: the normal equations of (1, Re z, Im z)
    need only N, Σz, Σz² and Σyz. What the image itself holds at this frequency goes too: give whole frames, not windows on targets.
    """
    row, col = np.exp(2j * np.pi * frequency_y * signal.rows), np.exp(2j * np.pi * frequency_x * signal.cols)
    out = np.empty(signal.data.shape, np.float32)
    size = signal.data[0].size
    for i, frame in enumerate(signal.data):
        data = frame - float(frame.mean(dtype=float))
        first, second = row[i].sum() * col[i].sum(), (row[i] ** 2).sum() * (col[i] ** 2).sum()
        normal = [
            [size, first.real, first.imag],
            [first.real, (size + second.real) / 2, second.imag / 2],
            [first.imag, second.imag / 2, (size - second.real) / 2],
        ]
        product = row[i] @ (data @ col[i])
        _, in_phase, quadrature = np.linalg.lstsq(normal, [data.sum(dtype=float), product.real, product.imag], rcond=1e-9)[0]
        # Re and Im of z: a cos + b sin = Re((a − ib) z)
        out[i] = frame - np.outer((in_phase - 1j * quadrature) * row[i], col[i]).real
    return out


def shift_per_dn(probe: Probe, frequency_x: float, frequency_y: float) -> tuple[float, float]:
    """Propagator P2: rms shift in x and y (px) per DN of amplitude, averaged over the phase: |Σ g exp 2πi(ν_x c + ν_y r)| / √2."""
    rows, cols = probe.gx.shape[1:]
    angle = 2 * np.pi * (frequency_y * np.arange(rows)[:, None] + frequency_x * np.arange(cols)[None, :])
    cosine, sine = probe.field(np.cos(angle)), probe.field(np.sin(angle))
    u_x, u_y = (float(np.sqrt(np.mean(cosine[a] ** 2 + sine[a] ** 2) / 2)) for a in (0, 1))
    return u_x, u_y
