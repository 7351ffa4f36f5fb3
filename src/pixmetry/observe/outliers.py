"""Pixels above or below all of their neighbours: normal noise has so many of every size, unless a correction takes them out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pixmetry.camera.observations import SingleOutliers

LEAST_NOISE_DN = 2.0
EXPECTED = 30.0  # outliers beyond a threshold that would be there without a correction
CUT, FOUND, ALIKE = 0.3, 25.0, 0.25  # share that is left beyond; of the logarithm of the likelihood; counts below, relative


def single_outliers(frames: Sequence[np.ndarray], step: int = 1) -> SingleOutliers | None:
    """By how much pixels exceed the highest, or fall below the lowest, of eight neighbours, against normal noise.

    Parameters
    ----------
    frames : sequence of ndarray, shape (rows, cols), DN
        Flat fields.
    step : int
        Distance of the neighbours: 2 in a colour mosaic.

    Returns
    -------
    SingleOutliers or None
        None where the noise is too small.

    Notes
    -----
    Of n independent normal pixels, n ∫ φ(x) Φ(x − t/σ)⁸ dx exceed all their neighbours by more than t. σ is that of the difference from
    four neighbours, by its median, which single pixels do not change.
    """
    from scipy.special import ndtr

    counts, spreads, pixels = np.zeros(0), [], 0
    for frame in frames:
        x = frame.astype(np.int32)
        middle = x[step:-step, step:-step]
        shifts = [(a, b) for a in (-step, 0, step) for b in (-step, 0, step) if a or b]
        around = [x[step + a : x.shape[0] - step + a, step + b : x.shape[1] - step + b] for a, b in shifts]
        cross = sum(part for part, (a, b) in zip(around, shifts, strict=True) if not (a and b))
        apart = middle - 0.25 * np.asarray(cross)
        spreads.append(1.4826 * float(np.median(np.abs(apart - np.median(apart)))) / np.sqrt(1.25))
        highest, lowest = np.maximum.reduce(around), np.minimum.reduce(around)
        excess = np.concatenate([(middle - highest).ravel(), (lowest - middle).ravel()])
        own = np.bincount(excess[excess > 0]).astype(float)
        size = max(own.size, counts.size)
        counts = np.pad(counts, (0, size - counts.size)) + np.pad(own, (0, size - own.size))
        pixels += middle.size
    sigma = float(np.mean(spreads)) if spreads else 0.0
    if sigma < LEAST_NOISE_DN:
        return None
    x_grid = np.linspace(-6, 6, 481)
    density = np.exp(-0.5 * x_grid**2)
    density /= density.sum()
    last = max(counts.size, int(6 * sigma))
    edges = np.arange(last + 1) - 0.5
    beyond = 2 * pixels * (density @ ndtr(x_grid[:, None] - edges / sigma) ** 8)
    return SingleOutliers(np.pad(counts, (0, last - counts.size)), -np.diff(beyond), sigma, step)


def cut_of(outliers: SingleOutliers) -> tuple[float, float] | None:
    """The size above which outliers are missing, DN, with its u; None where none are.

    Poisson likelihood of a cut above T codes beyond which a share of at most `CUT` is left, against that of none.
    """
    found, expected = outliers.counts[1:], np.maximum(outliers.expected[1:], 1e-12)
    below = np.cumsum(found) / np.cumsum(expected)
    o, e = (np.append(np.cumsum(v[::-1])[::-1], 0.0)[1:] for v in (found, expected))  # beyond T = 1, 2, …
    share = np.minimum(np.maximum(o, 0.5) / np.maximum(e, 1e-9), CUT)
    gain = np.where(e >= EXPECTED, o * np.log(share) - (share - 1) * e, -np.inf)
    gain[np.abs(below - 1) > ALIKE] = -np.inf
    at = int(np.argmax(gain))
    if gain[at] < FOUND or o[at] > CUT * e[at]:
        return None
    return float(at + 1), float(np.hypot(np.sqrt(1 / 12), 1 / expected[at]))
