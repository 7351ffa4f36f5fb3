"""What one unit's pixels, codes and waves are, taken from its frames: maps with the spread of the camera, not that of their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pixmetry.camera.observations import CodeErrors, DefectList, Observations, PatternList, StackMoments
from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError
from pixmetry.observe.histogram import neighbour_weights
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.spatial_fit import spatial_maps, temporal_strata
from pixmetry.observe.surface import Strata, cross_strata, residual_parts

SIGNIFICANT = 1.645  # u above the noise of the mean map from which on a part of it is the camera's: one-sided 95 %


@dataclass(frozen=True)
class UnitMaps:
    """A measured unit, in linear DN above black and in shares of the response.

    Parameters
    ----------
    light_rel : ndarray, shape (rows, cols), float32
        The smooth part of light and response; with all deviations and defects the mean response is 1.
    response_dev_rel, offset_dn : ndarray, shape (rows, cols), float64
        What pixels, rows and columns differ by from it, and from the mean of the dark; with the defects the mean of the latter is 0.
    pixels : ndarray, shape (n, 5), float64
        The defects: row, column, response over that of the others, dark excess (where it is positive) and temporal noise in DN.
    wave_turns : ndarray, shape (patterns,), float64
        Phase of every pattern at pixel (0, 0); that of a moving one is of no use.
    """

    light_rel: np.ndarray
    response_dev_rel: np.ndarray
    offset_dn: np.ndarray
    pixels: np.ndarray
    wave_turns: np.ndarray


def unit_maps(seen: Observations, bits: int) -> UnitMaps:
    """Take the maps of a unit out of its observations.

    Parameters
    ----------
    seen : Observations
        With a dark and a bright stack, and the photon-transfer fit.
    bits : int
        Of the codes.

    Raises
    ------
    MeasureError
        If there are no such stacks, or they show no evenly lit field.

    Notes
    -----
    A map M = S + N averaged over L frames holds the pattern S with its mean square s² and temporal noise N with t/L. Its parts by pixels,
    rows and columns are orthogonal, and each is multiplied by √(1 − (t/L)/m²), where m² = s² + t/L is the part's own mean square. The
    result has the mean square s² of the camera and the correlation √(s²/m²) with S; of all multiples of M with the right spread there is
    no other. (The predictor of least error, (s²/m²) M, has too little of it, s⁴/m²: a camera made of it would be better than the real one.
    Louis, J. Am. Stat. Assoc. 79, 1984, 393.) The mean square of row means holds that of the pixels over the number of columns, in S as in
    the result, so the parts need not be told apart further. A part that is not significantly above its noise is left out.

    What temporal noise leaves in the coefficients of the smooth light, (t/L)/(rows · cols) each, is neglected.
    """
    if seen.dark_stack is None or seen.bright_stack is None or seen.photon_transfer_fit is None:
        raise MeasureError("maps of a unit need a stack of dark frames and one of bright frames")
    linearity = Linearity.of(seen.photon_transfer_fit, bits)
    maps = spatial_maps(seen.dark_stack, seen.bright_stack, seen.defects, linearity=linearity, patterns=seen.patterns)
    surface, mask = maps.surface, maps.mask
    rows, cols = mask.shape
    noise_dark = temporal_strata(maps.dark_stack, mask)
    noise_bright = temporal_strata(maps.bright_stack, mask, 1 / surface.values)
    per_light2 = float((surface.values**-2.0).mean())  # the noise of the dark map is in the response too
    noise = Strata(*(b + per_light2 * d for b, d in zip(_three(noise_bright), _three(noise_dark), strict=True)))
    dof = np.array([(rows - 1.0) * (cols - 1.0) - mask.sum(), rows - 1.0, cols - 1.0])
    frames = np.array([maps.dark_stack.n_frames, maps.bright_stack.n_frames])
    offset = _with_true_spread(maps.dark_dn, noise_dark, dof, frames[:1])
    response = _with_true_spread(maps.response_dev_rel, noise, dof - [surface.n_mixed, surface.degree, surface.degree], frames)
    row, col = np.nonzero(mask)
    at = row, col
    dark_map, bright_map = maps.dark_stack.mean_map_dn, maps.bright_stack.mean_map_dn
    relative = np.clip((bright_map - dark_map)[at] / ((1 + response) * surface.values)[at], 0.0, None)
    excess = dark_map[at] - float(maps.dark_dn.mean()) - offset[at]
    offset[at] += np.minimum(excess, 0.0)  # below the others there is no charge that could be taken away
    pixels = np.column_stack([row, col, relative, np.maximum(excess, 0.0), _own_noise_dn(seen.dark_stack, seen.defects, at)]).astype(float)
    whole = (1 + response) * surface.values
    whole[at] *= relative
    return UnitMaps(
        # the frames' means, by which gain and black level are known, hold the defects
        light_rel=(surface.values / whole.mean()).astype(np.float32),
        response_dev_rel=response,
        offset_dn=offset - (offset.sum() + pixels[:, 3].sum()) / offset.size,
        pixels=pixels,
        wave_turns=np.zeros(0) if seen.patterns is None else _phases(maps.dark_stack.mean_map_dn, seen.patterns),
    )


def _three(strata: Strata) -> tuple[float, float, float]:
    return strata.pixel, strata.row, strata.col


def _with_true_spread(image: np.ndarray, noise: Strata, dof: np.ndarray, n_frames: np.ndarray) -> np.ndarray:
    """The map less its mean, its parts by pixels, rows and columns shrunk to the mean square that they have without noise."""
    pixel, row, col = residual_parts(image)
    found = np.array(_three(cross_strata(image, image))) / dof
    t = np.array(_three(noise))
    # a mean square on ν degrees of freedom scatters by √(2/ν) of itself
    u = t * np.sqrt(2 / dof + (2 / (dof[:, None] * (n_frames - 1))).max(axis=1))
    share = np.where(found > t + SIGNIFICANT * u, 1 - t / np.maximum(found, 1e-300), 0.0)
    of_pixel, of_row, of_col = np.sqrt(np.maximum(share, 0.0))
    spread: Array = of_pixel * pixel + of_row * row[:, None] + of_col * col[None, :]
    return spread


def _own_noise_dn(dark: StackMoments, defects: DefectList | None, at: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Temporal noise of the noisy ones among the pixels, beyond that of the others; 0 for all else."""
    variance = dark.var_map_dn2
    noisy = np.zeros(variance.shape, bool)
    if defects is not None:
        of_noise = np.array([kind == "noisy" for kind in defects.kind], bool)
        noisy[defects.row[of_noise], defects.col[of_noise]] = True
    more = np.maximum(variance[at].astype(float) - float(np.median(variance)), 0.0)
    return np.sqrt(np.where(noisy[at], more, 0.0))


def _phases(image: np.ndarray, patterns: PatternList) -> np.ndarray:
    """Phase in turns at pixel (0, 0) of A sin 2π(ν_x x + ν_y y + φ), by least squares at the frequencies found."""
    rows, cols = image.shape
    flat = image - image.mean()
    out = np.zeros(len(patterns))
    for k, (nu_x, nu_y) in enumerate(zip(patterns.frequency_x, patterns.frequency_y, strict=True)):
        column, line = np.exp(-2j * np.pi * nu_y * np.arange(rows)), np.exp(-2j * np.pi * nu_x * np.arange(cols))
        # Σ A sin(2π(u + φ)) e^(−2πiu) = −i A N e^(2πiφ)/2, but for terms at twice the frequency
        out[k] = (float(np.angle(1j * (column @ flat @ line))) / (2 * math.pi)) % 1.0
    return out


def threshold_errors(codes: CodeErrors, bits: int) -> np.ndarray:
    """How far each threshold of the converter lies off its place, LSB, shape (2^bits − 1,); 0 where no code near it was tested.

    Widths w_k = 1 + d_(k+1) − d_k of the codes come from thresholds that are displaced independently with the variance of the DNL's own
    mean square over 2. What the code density test says is a linear function of the d, with counting noise: y = H d + n. The best
    predictor is D Hᵀ (H D Hᵀ + R)⁻¹ y; it is then multiplied up to the spread that the widths of the tested codes have, as the maps
    are (`unit_maps`).
    """
    from scipy.sparse import csc_array, csr_array, diags_array
    from scipy.sparse.linalg import splu

    top = 2**bits - 1
    out = np.zeros(top)
    if "dnl_rms_lsb" not in codes.fit or codes.fit.limits:
        return out
    prior = codes.fit["dnl_rms_lsb"].value ** 2 / 2
    h = -neighbour_weights()
    half = len(h) // 2
    h[half] += 1.0
    # y_k = Σ_j h_j w_(k + j); code k lies between the thresholds of numbers k − 1 and k, counted from 0
    tested = codes.codes
    rows = np.repeat(np.arange(tested.size), h.size)
    at = (tested[:, None] + np.arange(-half, half + 1)).ravel()
    inside = (at >= 1) & (at < top)
    of_widths = csr_array((np.tile(h, tested.size)[inside], (rows[inside], at[inside])), shape=(tested.size, top + 1))
    wide = np.arange(1, top)
    difference = csr_array(
        (np.r_[np.ones(wide.size), -np.ones(wide.size)], (np.r_[wide, wide], np.r_[wide, wide - 1])), shape=(top + 1, top)
    )
    design = of_widths @ difference
    noise = diags_array(codes.u_dnl_lsb**2)
    system = splu(csc_array(prior * (design @ design.T) + noise))
    best = prior * (design.T @ system.solve(codes.dnl_lsb))
    found = float(np.mean(np.diff(best)[tested - 1] ** 2))
    if found > 0:
        out[:] = best * math.sqrt(2 * prior / found)
    return out
