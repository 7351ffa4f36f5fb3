"""Fixed-pattern noise of a sensor from a dark and a bright stack: row, column and pixel parts, free of temporal noise and shading."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixmetry.camera.observations import DefectList, PatternList, StackMoments
from pixmetry.core.arrays import Array
from pixmetry.core.errors import InputError, MeasureError
from pixmetry.core.number import ONE_SIDED_95, Estimates, effective_dof
from pixmetry.observe.linearity import Linearity
from pixmetry.observe.photon_transfer_levels import core_spread_dn2
from pixmetry.observe.photon_transfer_model import rounding_error_vars, slope_error_var, white_before_rounding
from pixmetry.observe.surface import Strata, Surface, cross_strata, fill, fit_surface, residual_parts

PARTS = ("pixel", "row", "col")
BROKEN, CHANCE = 5.0, 3e-7  # u below zero from which a variance is no chance any more, and the chance that remains
HIDDEN = 0.25  # relative error of the local slope beyond which a pattern seen through quantisation is only bounded
SIGNIFICANT = 3.0  # a variance below this many u is given as a limit
NOT_BY_CHANCE = 0.00135  # beyond so many u of a normal distribution
NOT_ROUND = 3.0  # curvatures along x and y that differ by more than this many u belong to a light that is not round
METHOD = "analysis of variance of the mean maps, less temporal mean squares / L; Scheffé 1959, limits after Graybill & Wang 1980"


@dataclass(frozen=True)
class _MeanSquares:
    """Independent mean squares: values, degrees of freedom, excess kurtosis of what was squared.

    ``waves`` is the part of each that moving waves give on average; it has an exponential law.
    """

    values: np.ndarray
    dof: np.ndarray
    kurtosis: np.ndarray
    waves: np.ndarray

    def relative_variances(self) -> np.ndarray:
        # Var(MS) = MS² (2/ν + γ₂/n), γ₂ the excess kurtosis of what was squared
        relative: Array = 2.0 / self.dof + self.kurtosis / self.dof
        return relative


def fit_spatial(
    dark_stack: StackMoments,
    bright_stack: StackMoments,
    defects: DefectList | None = None,
    *,
    surface_degree: int = 4,
    linearity: Linearity | None = None,
    patterns: PatternList | None = None,
    dnl_lsb: float = 0.0,
    this_sensor: bool = False,
) -> Estimates:
    """Dark-signal and photo-response non-uniformity with their row, column and pixel parts.

    Parameters
    ----------
    dark_stack, bright_stack : StackMoments
        Of the same exposure, the bright one evenly lit.
    defects : DefectList, optional
        Pixels to leave out; by default those of ``find_defects``.
    surface_degree : int
        Total degree of the polynomial that takes up the illumination, 2 or more.
    linearity : Linearity, optional
        Of this camera: the maps are straightened with it before they are compared. A bent response shows a contrast of the light
        x f'(x)/f(x) times as large; at half of the range that is 1 % for a₁ = 0.02.
    patterns : PatternList, optional
        Fixed waves to take out of the dark map: they are no property of single pixels.
    dnl_lsb : float
        Standard deviation of the converter's code widths.
    this_sensor : bool
        What the non-uniformities are to stand for. False: the population from which this sensor's pixels, rows and columns are a sample;
        u then holds the scatter from sensor to sensor. True: the pattern that this sensor has; u tells how the value would scatter if
        the same sensor were measured again. The values are the same.

    Returns
    -------
    Estimates
        ``dsnu_{pixel,row,col,total}_dn``, ``prnu_{pixel,row,col,total}_rel`` (0.01 is 1 %), standard deviations;
        ``shading_x_per_px``, ``shading_y_per_px`` (relative gradient at the
        centre), ``shading_corner_rel`` (loss from the centre to the corners as r², over the mean light; negative where the corners are
        brighter) and ``shading_pp_rel``. A non-uniformity that is not significantly above zero is a 95 % upper limit. One whose variance
        lies more than 5 u below zero is left out, with why in ``reasons``: the split takes the pixels for independent of each other, and
        under a wave across the frame they are not.

    Raises
    ------
    InputError
        If the stacks differ in shape.
    MeasureError
        If the frames are too small for the surface, or the bright stack is not brighter.

    Notes
    -----
    Dark map, and (bright − dark) divided by its fitted surface, are each split by a two-way analysis of variance with the degrees of
    freedom M−1, N−1, (M−1)(N−1) less those of surface and defects. With L frames and temporal mean squares t,

        σ²_pixel = MS_pixel − t_pixel/L,     σ²_row = MS_row/N − MS_pixel/N − (t_row − t_pixel/N)/L

    (t_row per row mean), columns likewise. EMVA 1288 R4.0 eq. 36 takes the whole temporal variance off the pixels instead, so that
    temporal row noise goes into s²_row and drives s²_pixel below zero. A polynomial is preferred to the high-pass filter of that release
    since what it takes from each part is a known number of degrees of freedom; illumination with finer structure stays in the PRNU.
    The dark map keeps its slow part: it belongs to the sensor.

    Rounding: where the temporal noise σ is small, the mean code follows an offset with the slope 1 + 2e^(−2π²σ²) cos 2πx at the unknown
    phase x within a code (first harmonic; Widrow and Kollár, Quantization Noise, ch. 5), and codes of unequal width bend it likewise; u
    of the DSNU holds that.
    """
    stored_dn, dither_dn2 = bright_stack.mean_dn, white_before_rounding(dark_stack.ms_pixel_dn2, core_spread_dn2(dark_stack))
    maps = spatial_maps(dark_stack, bright_stack, defects, surface_degree=surface_degree, linearity=linearity, patterns=patterns)
    dark_stack, bright_stack, dark, response = maps.dark_stack, maps.bright_stack, maps.dark_dn, maps.response_dev_rel
    surface, mask = maps.surface, maps.mask
    waves_dn2 = 0.0 if patterns is None else float((0.5 * patterns.amplitude_dn[patterns.moving] ** 2).sum())
    squares, covariance = _mean_squares(dark_stack, bright_stack, dark, response, mask, surface, this_sensor, waves_dn2)
    per_light2 = float((surface.values**-2.0).mean())
    components = _components(squares, covariance, dark_stack.shape, per_light2, dither_dn2)
    result = _with_rounding(components, dither_dn2, dnl_lsb, per_light2).join(_shading(surface, squares))
    return result if linearity is None else _with_common_scale(result, linearity.contrast_u_rel(stored_dn))


@dataclass(frozen=True)
class SpatialMaps:
    """What the non-uniformities of a sensor are taken from: straightened stacks, and their maps with defects filled in."""

    dark_stack: StackMoments
    bright_stack: StackMoments
    dark_dn: np.ndarray  # without fixed waves
    response_dev_rel: np.ndarray  # (bright − dark) over its surface, less a surface of its own
    surface: Surface  # of the light
    mask: np.ndarray  # defects


def spatial_maps(
    dark_stack: StackMoments,
    bright_stack: StackMoments,
    defects: DefectList | None = None,
    *,
    surface_degree: int = 4,
    linearity: Linearity | None = None,
    patterns: PatternList | None = None,
) -> SpatialMaps:
    """Straighten two stacks and make the maps of which `fit_spatial` takes the spread; parameters and errors are those of it."""
    from pixmetry.observe.defects import find_defects

    if dark_stack.shape != bright_stack.shape:
        raise InputError("dark and bright stack differ in shape", value=bright_stack.shape, allowed=str(dark_stack.shape))
    rows, cols = dark_stack.shape
    if min(rows, cols) < 2 * surface_degree + 4:
        raise MeasureError(
            "frames are too small for the surface", value=(rows, cols), allowed=f"{2 * surface_degree + 4} rows and columns or more"
        )
    mask = (find_defects(dark_stack, bright_stack, surface_degree=surface_degree) if defects is None else defects).mask()
    if linearity is not None:
        dark_stack, bright_stack = linearity.straight_stack(dark_stack), linearity.straight_stack(bright_stack)
    light = fill(bright_stack.mean_map_dn - dark_stack.mean_map_dn, mask)
    if light.mean() <= 0:
        raise MeasureError("the bright stack is not brighter than the dark one", value=float(light.mean()))
    # the mask is filled in the flattened image: a hole in strong shading would be filled with a wrong level
    surface = fit_surface(light, surface_degree)
    surface = fit_surface(np.where(mask, surface.values, light), surface_degree)
    if surface.values.min() <= 0:
        raise MeasureError(
            "the light falls to zero within the frame", where="bright stack", remedy="illuminate the frame evenly, or crop it"
        )
    dark = fill(dark_stack.mean_map_dn, mask)
    if patterns is not None:
        dark = without_fixed_waves(dark, patterns)
    response = fill((bright_stack.mean_map_dn - dark_stack.mean_map_dn) / surface.values, mask)
    return SpatialMaps(dark_stack, bright_stack, dark, response - fit_surface(response, surface_degree).values, surface, mask)


def without_columns(stack: StackMoments, first: int) -> StackMoments:
    """A stack less its first columns, where an analogue line rises from black, and where its jitter is noise."""
    if not first:
        return stack
    var_map = stack.var_map_dn2[:, first:]
    var = float(var_map.mean(dtype=float))
    white = max(stack.ms_pixel_dn2 + var - stack.var_stack_dn2, 0.0)
    return replace(stack, mean_map_dn=stack.mean_map_dn[:, first:], var_map_dn2=var_map, var_stack_dn2=var, ms_pixel_dn2=white)


def without_defects(defects: DefectList, first: int) -> DefectList:
    """The defects of the columns that are left."""
    at = defects.col >= first
    kinds = tuple(kind for kind, own in zip(defects.kind, at, strict=True) if own)
    rows, cols = defects.shape
    excess, gain = defects.dark_excess_dn[at], defects.gain_rel[at]
    kept = replace(defects, row=defects.row[at], col=defects.col[at] - first, kind=kinds, dark_excess_dn=excess, gain_rel=gain)
    return replace(kept, shape=(rows, cols - first))


def with_shading_of(found: Estimates, shape: tuple[int, int], first: int) -> Estimates:
    """Gradient and loss to the corners about the centre of the whole frame, from those about that of all but its first columns."""
    names = ("shading_x_per_px", "shading_corner_rel")
    if not first or not set(names) <= set(found.names):
        return found
    rows, cols = shape
    whole, own = ((rows - 1) ** 2 + (n - 1) ** 2 for n in (cols, cols - first))
    change = np.eye(len(found))
    x, corner = (found.index(name) for name in names)
    change[x, corner] = 4 * first / own  # 2 c d, with d = first/2 and c = corner/(own/4)
    change[corner, corner] = whole / own
    return replace(found, values=change @ found.values, covariance=change @ found.covariance @ change.T)


def fit_dark_pattern(
    dark_stack: StackMoments, defects: DefectList | None = None, *, patterns: PatternList | None = None, dnl_lsb: float = 0.0
) -> Estimates:
    """Dark-signal non-uniformity alone, where there is no bright stack; parameters and values as of `fit_spatial`.

    Raises
    ------
    MeasureError
        If the frames are too small.
    """
    # an even light without noise leaves the dark part as it is
    still: dict[str, Any] = {name: 0.0 for name in ("ms_pixel_dn2", "ms_row_dn2", "ms_col_dn2", "ms_frame_dn2", "var_stack_dn2")}
    light = float(np.abs(dark_stack.mean_map_dn).max()) + 1.0
    even = replace(dark_stack, mean_map_dn=dark_stack.mean_map_dn + light, var_map_dn2=np.zeros_like(dark_stack.var_map_dn2), **still)
    found = fit_spatial(dark_stack, even, defects, patterns=patterns, dnl_lsb=dnl_lsb)
    return found.select([name for name in found.names if name.startswith("dsnu")])


def _with_common_scale(e: Estimates, u_rel: float) -> Estimates:
    """Add the relative uncertainty that all contrasts of the light have in common."""
    contrast = np.array([0.0 if name.startswith("dsnu") else 1.0 for name in e.names]) * e.values * u_rel
    covariance = e.covariance + np.outer(contrast, contrast)
    # Welch–Satterthwaite with a scale whose own u is known
    dof = e.dof * np.divide(np.diag(covariance), np.diag(e.covariance), out=np.ones(len(e)), where=np.diag(e.covariance) > 0) ** 2
    return replace(e, covariance=covariance, dof=dof)


def _with_rounding(e: Estimates, white_dn2: float, dnl_lsb: float, per_light2: float) -> Estimates:
    """Add what rounding at an unknown phase does to the DSNU: to all variances by their slope, to the pixels by the wave itself.

    Where noise and pattern together do not carry the pattern over the steps, it may be hidden altogether, and what was seen is an upper
    limit with what may be hidden; the response, from which the dark map was taken, then holds as much of it over the square of the light.
    """
    seen2 = max((e[name].value ** 2 for name in ("dsnu_total_dn", "dsnu_pixel_dn") if name in e), default=0.0)
    slope2 = slope_error_var(white_dn2, seen2, dnl_lsb)  # common to all pixels
    hidden = _is_hidden(white_dn2, seen2)
    own2 = min(float(rounding_error_vars(np.array(white_dn2), 0.0, dnl_lsb)[0]), slope_error_var(white_dn2, 0.0, dnl_lsb) * seen2)
    lost2 = float(rounding_error_vars(np.array(white_dn2), seen2, dnl_lsb)[0]) if hidden else 0.0
    values, u_squares, limits, reasons = e.values.copy(), 2 * e.values * e.u, set(e.limits), dict(e.reasons)
    for i, name in enumerate(e.names):
        dark = name.startswith("dsnu")
        if dark:
            wave2 = own2 if name in ("dsnu_pixel_dn", "dsnu_total_dn") else 0.0
            u_squares[i] = float(np.linalg.norm([u_squares[i], 2 * math.sqrt(slope2) * values[i] ** 2, wave2, lost2]))
        else:
            u_squares[i] = math.hypot(u_squares[i], lost2 * per_light2)
        if hidden and (dark or name not in limits and values[i] ** 2 < SIGNIFICANT * u_squares[i]):
            added = math.hypot(2 * math.sqrt(slope2) * values[i] ** 2, lost2) if name in limits else u_squares[i]
            values[i] = math.sqrt(values[i] ** 2 + ONE_SIDED_95 * added)
            limits.add(name)
            reasons[name] = "the dark noise is too small to dither the quantisation; 95 % upper limit"
    slopes = np.divide(0.5, values, out=np.zeros(len(e)), where=values > 0)
    covariance = e.covariance.copy()
    covariance[np.diag_indices(len(e))] = np.maximum((u_squares * slopes) ** 2, 0.0)
    return replace(e, values=values, covariance=covariance, limits=frozenset(limits), reasons=reasons)


def _is_hidden(white_dn2: float, seen_dn2: float) -> bool:
    """Whether noise and pattern together are too small to carry a pattern over the steps of quantisation."""
    return slope_error_var(white_dn2, max(seen_dn2, 0.0)) > HIDDEN**2


def without_fixed_waves(image: np.ndarray, patterns: PatternList) -> np.ndarray:
    """The image less its fixed waves: least squares of sine and cosine at the frequencies found, beside a constant."""
    rows, cols = image.shape
    y, x = np.arange(rows) - (rows - 1) / 2, np.arange(cols) - (cols - 1) / 2
    for k in np.flatnonzero(~patterns.moving):
        phase = 2 * np.pi * (patterns.frequency_y[k] * y[:, None] + patterns.frequency_x[k] * x[None, :])
        design = np.stack([np.ones(image.size), np.cos(phase).ravel(), np.sin(phase).ravel()])
        c = np.linalg.solve(design @ design.T, design @ image.ravel())
        image = image - (c[1:] @ design[1:]).reshape(image.shape)
    return image


def temporal_strata(stack: StackMoments, mask: np.ndarray, weight: np.ndarray | None = None) -> Strata:
    """Temporal mean squares per pixel over L, of the good pixels, with weights as of a mean map that is multiplied by them."""
    good = stack.var_map_dn2[~mask].astype(float)
    # only the white part of noisy pixels goes out with them
    white = max(stack.ms_pixel_dn2 - (stack.var_stack_dn2 - good.mean()), 0.0)
    rows, cols = stack.shape
    scale_white = scale = 1.0
    if weight is not None:
        scale = float((weight**2).mean())
        scale_white = float((good * weight[~mask] ** 2).mean() / good.mean()) if good.mean() > 0 else scale
    n = stack.n_frames
    line_row = cols * stack.ms_row_dn2 - stack.ms_pixel_dn2
    line_col = rows * stack.ms_col_dn2 - stack.ms_pixel_dn2
    row, col = (max(scale_white * white + scale * line, 0.0) for line in (line_row, line_col))
    return Strata(scale_white * white / n, row / n, col / n)


def _mean_squares(
    dark_stack: StackMoments,
    bright_stack: StackMoments,
    dark: np.ndarray,
    response: np.ndarray,
    mask: np.ndarray,
    surface: Surface,
    this_sensor: bool,
    waves_dn2: float = 0.0,
) -> tuple[_MeanSquares, np.ndarray]:
    """The twelve mean squares (dark map, response map, dark and bright temporal; pixel, row, column each) and their covariance.

    Of a given pattern with mean square S, noise of mean square t gives Var(MS) = (4 S t + 2 t²)/ν = 2 (MS² − S²)/ν with MS = S + t; the
    mean product of two maps goes alike. Drawn anew, pattern and noise give 2 MS²/ν and the pattern's kurtosis. Of waves that move, of
    power P in every frame, the mean of L frames holds P/L on average, with an exponential law: their phases add up as a random walk does.
    """
    rows, cols = dark.shape
    n_defects = int(mask.sum())
    dof_map = np.array([(rows - 1) * (cols - 1) - n_defects, rows - 1, cols - 1], dtype=float)
    dof_response = dof_map - [surface.n_mixed, surface.degree, surface.degree]
    per_frame = np.array([(rows - 1) * (cols - 1), rows - 1, cols - 1], dtype=float)
    own, other = cross_strata(dark, dark), cross_strata(response, response)
    temporal_dark, temporal_bright = temporal_strata(dark_stack, mask), temporal_strata(bright_stack, mask, 1 / surface.values)
    values = np.concatenate(
        [_array(own) / dof_map, _array(other) / dof_response, _array(temporal_dark), _array(temporal_bright)],
    )
    dof = np.concatenate([dof_map, dof_response, per_frame * (dark_stack.n_frames - 1), per_frame * (bright_stack.n_frames - 1)])
    kurtosis = np.zeros(12)
    kurtosis[0], kurtosis[3] = _kurtosis(residual_parts(dark)[0], mask), _kurtosis(residual_parts(response)[0], mask)
    waves = np.zeros(12)
    waves[0] = waves_dn2 / dark_stack.n_frames
    squares = _MeanSquares(values, dof, kurtosis, waves)
    variances = values**2 * squares.relative_variances()
    # the dark map enters the response too: Cov(MS_x, MS_y) = 2 c²/ν with c the covariance of x and y
    shared = _array(cross_strata(dark, response)) / dof_response
    common = 2 * shared**2 / dof_map
    if this_sensor:
        per_light, noise_dark = 1 / surface.values, values[6:9]
        noise = np.concatenate([noise_dark, values[9:] + noise_dark * float((per_light**2).mean())])
        fixed = np.maximum(values[:6] - noise, 0.0)
        variances[:6] = 2 * (values[:6] ** 2 - fixed**2) / dof[:6]
        # what of this sensor's own pattern went out with the surface is not seen: ν of n degrees of freedom stand for all of them
        lost = dof_map - dof_response
        variances[3:6] += (lost / dof_map * fixed[3:]) ** 2 * (2 / np.maximum(lost, 1) + 2 / dof_response)
        common = 2 * (shared**2 - (shared + noise_dark * float(per_light.mean())) ** 2) / dof_map
    covariance = np.diag(variances + waves**2)
    for i in range(3):
        covariance[i, 3 + i] = covariance[3 + i, i] = common[i]
    return squares, covariance


def _array(strata: Strata) -> np.ndarray:
    return np.array([strata.pixel, strata.row, strata.col])


def _kurtosis(residual: np.ndarray, mask: np.ndarray) -> float:
    good = residual[~mask]
    squares = good * good
    variance = float(squares.mean())
    return max(float((squares * squares).mean()) / variance**2 - 3.0, -1.5) if variance > 0 else 0.0


def _components(squares: _MeanSquares, covariance: np.ndarray, shape: tuple[int, int], per_light2: float, white_dn2: float) -> Estimates:
    rows, cols = shape
    # rows of the matrix: pixel, row, column, total variance; columns: mean squares of pixels, rows, columns
    split = np.array([[1.0, 0, 0], [-1 / cols, 1 / cols, 0], [-1 / rows, 0, 1 / rows]])
    split = np.vstack([split, split.sum(axis=0)])
    zero = np.zeros_like(split)
    # the temporal noise of the dark map enters the response over the squared light
    matrix = np.block([[split, zero, -split, zero], [zero, split, -split * per_light2, -split]])
    variances, covariance_out = matrix @ squares.values, matrix @ covariance @ matrix.T
    names = [f"dsnu_{part}_dn" for part in (*PARTS, "total")] + [f"prnu_{part}_rel" for part in (*PARTS, "total")]
    lower, upper = _bounds(matrix, squares)
    significant = lower > 0
    values = np.sqrt(np.where(significant, np.maximum(variances, 0.0), upper))
    slope = np.divide(0.5, values, out=np.zeros(8), where=values > 0)
    own = np.diag(covariance_out)
    terms = matrix**2 * np.diag(covariance)
    dof = effective_dof(terms, 2 / squares.relative_variances(), own)
    limits = frozenset(n for n, s in zip(names, significant, strict=True) if not s)
    in_u = np.divide(variances, np.sqrt(own), out=np.zeros(8), where=own > 0)
    of_lines = np.array([part in ("row", "col") for part in (*PARTS, "total")] * 2)
    far = np.where(of_lines, (in_u < 0) & _calmer_lines(squares), in_u < -BROKEN)
    if _is_hidden(white_dn2, float(variances[:4].max())):  # then quantisation is the reason
        far[:4] = False
    broken = {name: _broken(name, float(in_u[i])) for i, name in enumerate(names) if far[i]}
    found = Estimates(
        names=tuple(names),
        values=values,
        covariance=covariance_out * np.outer(slope, slope),
        dof=np.maximum(dof, 1.0),
        units=("DN",) * 4 + ("1",) * 4,
        method=METHOD,
        confounders=("illumination with structure finer than the fitted surface (PRNU)", "slow drift of the illumination between frames"),
        limits=limits,
        reasons={name: "not significantly above the temporal noise left in the mean map" for name in limits},
    )
    kept = found.select([name for name in names if name not in broken])
    return replace(kept, reasons={**kept.reasons, **broken})


def _calmer_lines(squares: _MeanSquares) -> np.ndarray:
    """Of the eight components, those of rows and columns whose means differ less than independent pixels by chance would let them."""
    from scipy.special import chdtr

    found = np.zeros(8, bool)
    for first, component in ((0, 0), (3, 4)):  # dark map and response
        for k in (1, 2):
            dof, pixel = squares.dof[first + k], squares.values[first]
            found[component + k] = pixel > 0 and chdtr(dof, dof * squares.values[first + k] / pixel) < CHANCE
    return found


def _broken(name: str, in_u: float) -> str:
    """Why a variance lies far below zero, where none can be."""
    behind = f"the variance behind it lies {-in_u:.2g} u below zero"
    if "_row_" in name or "_col_" in name:
        line = "rows" if "_row_" in name else "columns"
        return (
            f"{behind}: the means of {line} differ less than those of independent pixels would, as under a wave that runs across the "
            "frame; the split assumes independent pixels, and gives neither a value nor a limit"
        )
    return (
        f"{behind}: less noise remains in the mean of the frames than the noise of single frames predicts, as if that noise were not "
        "independent from frame to frame; neither a value nor a limit"
    )


def _bounds(matrix: np.ndarray, squares: _MeanSquares) -> tuple[np.ndarray, np.ndarray]:
    """One-sided bounds of linear combinations of mean squares, below 99.87 %, above 95 %: large-sample method of Graybill & Wang (1980).

    The part of waves lies between ln(20/19) and −ln 0.00135 times its mean.
    """
    from scipy.special import chdtri, gammaincinv

    dof = 2 / squares.relative_variances()
    above = (dof / (2 * gammaincinv(dof / 2, 0.05)) - 1) * squares.values  # how far the expectation may lie above the mean square
    below = (1 - dof / chdtri(dof, NOT_BY_CHANCE)) * squares.values
    above = np.hypot(above, (1 - math.log(20 / 19)) * squares.waves)
    below = np.hypot(below, (-math.log(NOT_BY_CHANCE) - 1) * squares.waves)
    positive, negative = np.maximum(matrix, 0.0), np.minimum(matrix, 0.0)
    best = matrix @ squares.values
    # a best estimate below zero is taken as zero, so that a lucky draw does not give a limit below what the data can tell
    upper = np.maximum(best, 0.0) + np.sqrt((positive**2) @ above**2 + (negative**2) @ below**2)
    lower = best - np.sqrt((positive**2) @ below**2 + (negative**2) @ above**2)
    return lower, upper


def _shading(surface: Surface, squares: _MeanSquares) -> Estimates:
    """Gradient at the centre, peak-to-peak and loss towards the corners of the fitted illumination, relative to its mean."""
    level = float(surface.values.mean())
    coefficients = surface.coefficients / level
    variances = surface.coefficient_variances(*squares.values[3:6])
    rows, cols = surface.values.shape
    middle_y, middle_x = _centre(surface.basis_y), _centre(surface.basis_x)
    along_x, along_y = _paraboloid(surface)
    low, high = np.unravel_index(surface.values.argmin(), (rows, cols)), np.unravel_index(surface.values.argmax(), (rows, cols))
    weights = {
        "shading_x_per_px": np.outer(middle_y, surface.slopes_x),
        "shading_y_per_px": np.outer(surface.slopes_y, middle_x),
        "shading_pp_rel": np.outer(surface.basis_y[high[0]], surface.basis_x[high[1]])
        - np.outer(surface.basis_y[low[0]], surface.basis_x[low[1]]),
        "shading_corner_rel": along_x + along_y,
    }
    w = np.array([v.ravel() for v in weights.values()])
    covariance = (w * variances.ravel()) @ w.T
    not_round = _not_round_var(along_x, along_y, coefficients, variances)
    covariance[-1, -1] += not_round
    reasons = {"shading_pp_rel": "cannot be negative: without any shading its value is a few u"}
    if not_round:
        reasons["shading_corner_rel"] = "the light falls off differently along x and y: u includes the difference"
    return Estimates(
        names=tuple(weights),
        values=w @ coefficients.ravel(),
        covariance=covariance,
        dof=np.array([squares.dof[5], squares.dof[4], min(squares.dof[4:6]), min(squares.dof[4:6])]),
        units=("1/px", "1/px", "1", "1"),
        method=f"least-squares polynomial of total degree {surface.degree} in bright − dark",
        confounders=("slow non-uniformity of the sensor's response",),
        reasons=reasons,
    )


def _paraboloid(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the coefficients whose sum is the loss to the corners: the shares of the terms x² and y², each of shape (degree + 1,) * 2.

    The surface is projected on q = −(r² − ⟨r²⟩)/r²_corner over the frame's pixels. q has only these two terms, and is orthogonal to all
    others of the surface, so this is the least-squares fit of the paraboloid to the light itself.
    """
    rows, cols = surface.values.shape
    y, x = np.arange(rows) - (rows - 1) / 2, np.arange(cols) - (cols - 1) / 2
    corner2 = x[0] ** 2 + y[0] ** 2
    along_x, along_y = np.zeros(surface.coefficients.shape), np.zeros(surface.coefficients.shape)
    along_x[0, 2] = -math.sqrt(rows) * np.sign(surface.basis_y[0, 0]) * (surface.basis_x[:, 2] @ x**2) / corner2
    along_y[2, 0] = -math.sqrt(cols) * np.sign(surface.basis_x[0, 0]) * (surface.basis_y[:, 2] @ y**2) / corner2
    whole = along_x[0, 2] ** 2 + along_y[2, 0] ** 2
    return along_x / whole, along_y / whole


def _not_round_var(along_x: np.ndarray, along_y: np.ndarray, coefficients: np.ndarray, variances: np.ndarray) -> float:
    """Weighted variance of the curvatures along x and y about their mean, where they differ by more than chance.

    One number for both is then too small for one axis and too large for the other.
    """
    share = float(along_x[0, 2] ** 2 / (along_x[0, 2] ** 2 + along_y[2, 0] ** 2))  # weight of the x axis; the other has the rest
    apart = along_x / share - along_y / (1 - share)
    difference2 = float((apart * coefficients).sum()) ** 2
    return share * (1 - share) * difference2 if difference2 > NOT_ROUND**2 * float((apart**2 * variances).sum()) else 0.0


def _centre(basis: np.ndarray) -> np.ndarray:
    """Values of the basis at the centre of the grid: the mean of its two middle pixels (one pixel, if the number is odd)."""
    n = basis.shape[0]
    centre: Array = 0.5 * (basis[(n - 1) // 2] + basis[n // 2])
    return centre
