"""The noise of a frame from the frame itself: what is left of it where fitted templates are flat."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pixmetry.core.errors import MeasureError
from pixmetry.core.threads import map_tiles
from pixmetry.location.background import scale_of
from pixmetry.location.noise import ROUNDING_DN2, NoiseModel
from pixmetry.location.targets import Targets
from pixmetry.location.template_fit import KINDS, Windows, run_fit, with_second_start

PIECES = 4  # of the work
LEAST_SLOPED_PX = 2.0
MOST_TARGETS = 64
EDGE_PX = 0.05  # misplacement of an edge that a template may have: where it would matter, a pixel says nothing about noise
LEVELS = 16
LEAST_PIXELS = 30  # for the variance of a level
CLEAR_SIGMA = 4.0  # by which the variance must rise with the level for the slope to count (3e-5 by chance)
OUTLIER_SIGMA = 4.0
KEPT = 0.998872  # variance that a normal distribution keeps when values beyond 4 standard deviations are left out


def noise_from_image(
    frame: np.ndarray,
    targets: Targets,
    kind: str = "disc",
    *,
    low_dn: float = -math.inf,
    high_dn: float = math.inf,
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> NoiseModel:
    """Measure variance against grey level from the residuals of a first fit.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
        All there are, for what belongs to a neighbour is left out; at most 64 of them, spread over
        the list, are fitted.
    kind : {"disc", "ellipse", "ring", "spot"}
    low_dn, high_dn : float
        Ends of the scale, where they are known.
    aperture_px : float
    threads : int, optional

    Returns
    -------
    NoiseModel
        Of origin "image". The slope is 0 unless it stands 4 standard deviations clear. Rounding is part of the measured variance, which
        is not below 1/12 DN² for integer frames. The scale ends where it was said to, at the latest where an integer type does.

    Raises
    ------
    MeasureError
        If there is no target to measure at.

    Notes
    -----
    Only pixels where the template is so flat that an edge misplaced by 0.05 px shifts them by less than half the noise are used, so that a
    blur or shape that the template does not have is not taken for noise. A squared residual is divided by 1 minus its leverage
    J (JᵀWJ)⁻¹Jᵀ W; values beyond 4 standard deviations are left out.
    """
    if not len(targets):
        raise MeasureError("no target to measure the noise at", where="noise_from_image", remedy="give a noise model")
    which = np.unique(np.linspace(0, len(targets) - 1, min(len(targets), MOST_TARGETS)).round().astype(int))
    part = targets[which]
    whole = frame.dtype.kind == "u"
    least = ROUNDING_DN2 if whole else (1e-6 * float(np.median(np.abs(part.amplitude_dn)))) ** 2 + 1e-12
    first = max(float(np.median(part.sigma_dn)) ** 2, least)
    low, high, _ = scale_of(frame, low_dn, high_dn)
    guess = NoiseModel(first, low_dn=low, high_dn=high, origin="image")
    start, windows = None, Windows.of(frame, targets, guess, kind, KINDS.index(kind), aperture_px, True, False)
    for _ in range(2):  # each time with better weights, and a better idea of which pixels are flat
        level, residual, start = _flat_residuals(windows, targets, which, guess, kind, threads, start)
        guess = _fitted(level, residual, guess, least)
    return guess


def _flat_residuals(
    windows: Windows,
    targets: Targets,
    which: np.ndarray,
    noise: NoiseModel,
    kind: str,
    threads: int | None,
    start: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels and residuals, divided by √(1 − leverage), of pixels where the template is flat; and the parameters of the fit."""
    from pixmetry.location._template_kernels import residuals

    windows = replace(windows, noise=noise)
    first = windows.start if start is None else start
    # planes, so that light or a ground that slopes is not taken for noise; small targets cannot tell them from the rest
    ground = bool(np.median(targets.semi_minor_px[which]) > LEAST_SLOPED_PX)
    light = ground and kind != "spot"
    fitted = run_fit(windows, which, first, ground, light, False, threads)
    fitted = with_second_start(windows, targets, which, fitted, (ground, light, False), threads)
    slopes = 2 * ground + 2 * light
    about = windows.start, windows.half, windows.outer, windows.reach, windows.near_start, windows.near_index, windows.numbers

    def piece(good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return residuals(windows.frame, windows.code, fitted.parameters, slopes, good, *about, windows.aperture_px, EDGE_PX, 0.5)

    pieces = map_tiles(piece, np.array_split(np.flatnonzero(fitted.at_rest), PIECES), threads)
    level, residual = (np.concatenate(values) for values in zip(*pieces, strict=True))
    return level, residual, np.where(fitted.at_rest[:, None], fitted.parameters, windows.start)


def _fitted(level: np.ndarray, residual: np.ndarray, guess: NoiseModel, least: float) -> NoiseModel:
    """Constant, and slope if it is clear, of the variance of residuals against level."""
    sigma = np.sqrt(guess.variance_dn2(level))
    inside = (level > guess.low_dn + 2.5 * sigma) & (level < guess.high_dn - 2.5 * sigma)  # else the scale cuts the noise
    level, residual = level[inside], residual[inside]
    if len(level) < LEAST_PIXELS:
        return guess
    # levels of equal width hold the top and the background apart, however few pixels either has
    edges = np.linspace(level.min(), level.max() + 1e-9, LEVELS + 1)
    bins = np.digitize(level, edges) - 1
    rows = [
        (level[bins == k].mean(), *_variance(residual[bins == k])) for k in range(LEVELS) if np.count_nonzero(bins == k) >= LEAST_PIXELS
    ]
    if not rows:
        return replace(guess, constant_dn2=max(_variance(residual)[0], least))
    s, v, n = np.array(rows).T
    black, flat = float(s.min()), max(float(np.average(v, weights=n)), least)
    if len(s) < 2:
        return replace(guess, constant_dn2=flat, slope_dn=0.0, black_dn=0.0)
    design, expected = np.stack([np.ones_like(s), s - black]), np.maximum(v, least)
    for _ in range(4):
        w = n / (2 * expected**2)
        covariance = np.linalg.pinv((design * w) @ design.T)
        a, b = covariance @ (design * w) @ v
        expected = np.maximum(a + b * (s - black), least)
    # the spread of the levels about the line counts too
    excess = max(1.0, float((w * (v - a - b * (s - black)) ** 2).sum()) / max(len(s) - 2, 1))
    if b > CLEAR_SIGMA * math.sqrt(covariance[1, 1] * excess) and a > 0.0:
        return replace(guess, constant_dn2=max(float(a), least), slope_dn=float(b), black_dn=black)
    return replace(guess, constant_dn2=flat, slope_dn=0.0, black_dn=0.0)


def _variance(values: np.ndarray) -> tuple[float, int]:
    """Mean square without outliers, and how many values it is of."""
    kept = values
    for _ in range(4):
        sigma = math.sqrt(float(np.mean(kept**2)) / (KEPT if len(kept) < len(values) else 1.0))
        kept = values[np.abs(values) <= max(OUTLIER_SIGMA * sigma, 1e-300)]
        if not len(kept):
            return 0.0, 1
    return float(np.mean(kept**2)) / KEPT, len(kept)
