"""Where lines and edges are: a least-squares template over the whole line, or an estimate per row and a regression."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.targets import Flag, Positions
from pixmetry.locate.lines import _line_kernels as kernels
from pixmetry.locate.lines import _line_row_kernels as by_row
from pixmetry.locate.lines._profile_kernels import BAR, EDGE, GAUSSIAN
from pixmetry.locate.lines.line_candidates import LineCandidates, near_lines, stretches
from pixmetry.locate.noise import NoiseModel

SECTIONS = {"edge": EDGE, "gaussian": GAUSSIAN, "bar": BAR}
CHOICES = {False: kernels.OFF, True: kernels.ON, "auto": kernels.AUTO}
PARAMETERS = (
    "offset_px",
    "angle_deg",
    "background_dn",
    "amplitude_dn",
    "sigma_px",
    "width_px",
    "across_dn_per_px",
    "along_dn_per_px",
    "taper_per_px",
    "curvature_per_px",
)
ROW_ESTIMATORS = ("row_centroid", "row_squared_centroid", "row_soft_threshold", "row_template")
ESTIMATORS = ("template", *ROW_ESTIMATORS)
DEG = np.pi / 180.0
CHUNK = 32  # lines a task
PIXEL = 0.2887  # standard deviation of a pixel's aperture
LEAST_BLUR_PX = 0.3  # below it the grey values hardly tell where inside a pixel a line along the grid lies
BLUR_REACH = 3.0  # of the candidate's: a fitted blur beyond it is no measure of how far a line can be trusted
LAWS = {
    "row_centroid": by_row.CENTROID,
    "row_squared_centroid": by_row.SQUARED,
    "row_soft_threshold": by_row.SOFT,
    "row_template": by_row.TEMPLATE,
}


def line_model(
    section: str,
    parameters: Mapping[str, float],
    rows: ArrayLike,
    cols: ArrayLike,
    *,
    about: tuple[float, float] = (0.0, 0.0),
    aperture_px: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Grey values of a straight line or edge, and their derivatives.

    Parameters
    ----------
    section : {"gaussian", "bar", "edge"}
        Gaussian of standard deviation ``sigma_px`` and peak ``amplitude_dn`` before the pixel's average; bar of ``width_px`` blurred by
        ``sigma_px``; step, ``amplitude_dn`` higher on the side of (−sin, cos) of the direction, blurred.
    parameters : mapping
        By the names of `PARAMETERS`; those not given are 0 (``sigma_px`` and ``width_px``: 1). ``offset_px`` is the signed distance of the
        line from ``about``, positive towards (−sin, cos). ``angle_deg`` is the line's direction, from x towards y.
    rows, cols : array_like
        Coordinates of pixels, broadcast against each other, or rows and columns of a frame as two axes (1-D each).
    about : (x, y)
        Where offset and slopes are counted from, in pixels from the centre of the top-left pixel.
    aperture_px : float
        Side of the light-sensitive square in a pixel.

    Returns
    -------
    mean : ndarray, shape (rows, cols), DN
    jacobian : ndarray, shape (10, rows, cols)
        Derivatives in the order of `PARAMETERS`. The turn of the pixel's square against the line is left out of the one for the angle (a
        term of fourth order in pixel over blur).

    Raises
    ------
    InputError
        If a section or parameter is not known.
    """
    if section not in SECTIONS or set(parameters) - set(PARAMETERS):
        wrong = section if section not in SECTIONS else sorted(set(parameters) - set(PARAMETERS))
        raise InputError("no such line", value=wrong, allowed=f"{', '.join(SECTIONS)} with {', '.join(PARAMETERS)}")
    row, col = np.asarray(rows, float), np.asarray(cols, float)
    if row.ndim == col.ndim == 1:
        row = row[:, None]
    x, y = (np.ascontiguousarray(v).ravel() for v in np.broadcast_arrays(col - about[0], row - about[1]))
    shape = np.broadcast_shapes(row.shape, col.shape)
    p = np.array([float(parameters.get(name, 1.0 if name in ("sigma_px", "width_px") else 0.0)) for name in PARAMETERS])
    angle, p[1] = p[1] * DEG, 0.0
    mean, jacobian = np.empty(x.size), np.empty((x.size, kernels.UNKNOWNS + 1))
    kernels.render(SECTIONS[section], p, angle, float(aperture_px), x, y, mean, jacobian)
    jacobian[:, 1] *= DEG
    return mean.reshape(shape), np.ascontiguousarray(jacobian[:, :-1].T).reshape(-1, *shape)


def line_positions(
    frame: np.ndarray,
    candidates: LineCandidates,
    noise: NoiseModel,
    kind: str = "line",
    estimator: str = "auto",
    *,
    section: str = "auto",
    plane: bool | str = "auto",
    taper: bool | str = "auto",
    curvature: bool | str = "auto",
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> Positions:
    """Measure lines or edges.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    candidates : LineCandidates
    noise : NoiseModel
        It weights the pixels and gives the covariance.
    kind : {"line", "edge"}
    estimator : {"auto", "template", "row_squared_centroid", "row_centroid", "row_soft_threshold", "row_template"}
        "auto" is the template: it attains the Cramér–Rao bound for every blur and noise. The estimators per row take background, width and
        the places of their windows from the template.
    section : {"auto", "gaussian", "bar"}
        Cross-section of a line: "auto" takes a bar where a score test says that the line is flatter than a Gaussian.
    plane, taper, curvature : bool or "auto"
        Slopes of the background, change of the height along the line, and curvature; "auto" takes each in where a score test finds it
        at 3 standard deviations.
    aperture_px : float
        Side of the light-sensitive square in a pixel.
    threads : int, optional

    Returns
    -------
    Positions
        ``x_px, y_px`` is the point of the fitted line nearest to the middle of the measured stretch. Nothing is known about a place along
        a line: the covariance holds the variance across it only, and is singular. ``more``: angle_deg (−90 … 90, from x towards y),
        offset_px (signed distance of the line from the frame's (0, 0), positive towards (−sin, cos) of the angle), length_px, sigma_px (of
        the Gaussian, or the blur of bar or edge), width_px (0 unless a bar), amplitude_dn (of an edge: grey value on the side of
        (−sin, cos) minus the other side's), background_dn (of an edge: on the other side), var_across_px2, var_offset_px2,
        cov_offset_angle_px_deg, var_angle_deg2, var_sigma_px2, var_amplitude_dn2, curvature_per_px, var_curvature_per_px2, taper_per_px,
        background_x_dn_per_px, background_y_dn_per_px, s_curve_px, chi2_per_dof (of an estimator per row: of the regression), dof.

    Raises
    ------
    InputError
        If an argument cannot be used.

    Notes
    -----
    With P the profile averaged over the pixel's square, the template is b + A·P(d), d the distance across. Its covariance is (JᵀWJ)⁻¹ of
    the unknowns that were fitted. Across an edge, variance of offset and background go together, so a wider stretch beside it is used.
    """
    if kind not in ("line", "edge") or (estimator != "auto" and estimator not in ESTIMATORS) or section not in ("auto", "gaussian", "bar"):
        raise InputError(
            "cannot measure lines in this way",
            value=(kind, estimator, section),
            allowed=f"line, edge; auto, {', '.join(ESTIMATORS)}; auto, gaussian, bar",
        )
    fit = fit_template(frame, candidates, noise, kind, section, (plane, taper, curvature), aperture_px, threads)
    if estimator in ROW_ESTIMATORS:
        return replace_by_rows(_positions(fit, candidates, frame.shape), fit, frame, noise, estimator, threads)
    return _positions(fit, candidates, frame.shape)


@dataclass(frozen=True)
class Fit:
    """What the whole-line template found, and where it looked."""

    section: int
    lines: kernels.Lines
    reach: np.ndarray
    aperture_px: float
    fits: kernels.Fits


def fit_template(
    frame: np.ndarray,
    candidates: LineCandidates,
    noise: NoiseModel,
    kind: str,
    section: str,
    options: tuple[bool | str, bool | str, bool | str],
    aperture_px: float,
    threads: int | None,
) -> Fit:
    """Fit the template of whole lines; ``options`` are those of the background's plane, the taper and the curvature."""
    if any(option not in CHOICES for option in options):
        raise InputError("an option of the fit cannot be used", value=options, allowed="True, False, auto")
    blur = np.hypot(candidates.blur_px, PIXEL)
    spread = blur if kind == "line" else 1.6 * blur
    reach = 0.5 * candidates.width_px + 5.0 * spread + (1.0 if kind == "line" else 2.0)
    places = stretches(candidates, frame.shape, 2.5 * blur + 0.5)
    cores, n = np.ascontiguousarray(candidates.core_px), len(candidates)
    lines = kernels.Lines(places, cores, *near_lines(places, reach, cores))
    code = EDGE if kind == "edge" else GAUSSIAN if section == "auto" else SECTIONS[section]
    width = np.where(candidates.width_px > 0, candidates.width_px, candidates.blur_px if section == "bar" else 0.1)
    start = np.stack([candidates.background_dn, candidates.amplitude_dn, np.maximum(candidates.blur_px, 0.2), width], axis=1)
    choices = np.array([CHOICES[option] for option in options])
    how = kernels.How(code, kind == "line" and section == "auto", choices, float(aperture_px), noise.numbers(frame.dtype))
    unknowns = kernels.UNKNOWNS
    fits = kernels.Fits(np.full((n, unknowns), np.nan), np.full((n, unknowns, unknowns), np.nan), np.full((n, 5), np.nan))

    def part(first: int) -> None:
        kernels.fit_lines(frame, first, min(first + CHUNK, n), how, kernels.Candidates(lines, reach, start), fits)

    map_tiles(part, range(0, n, CHUNK), threads)
    return Fit(code, lines, reach, float(aperture_px), fits)


def _positions(fit: Fit, candidates: LineCandidates, frame_shape: tuple[int, int]) -> Positions:
    p, cov, places = fit.fits.values, fit.fits.covariances, fit.lines.places
    known = np.isfinite(p[:, 0])
    chi2, pixels, unknowns, _, section = fit.fits.told.T
    dof = np.maximum(np.where(known, pixels - unknowns, np.nan), 1.0)
    angle = places[:, 2] + p[:, kernels.ANGLE]
    filled = np.nan_to_num(cov)
    held = {
        "sigma_px": p[:, kernels.SIGMA],
        "width_px": np.where(section == BAR, p[:, kernels.WIDTH], np.where(known, 0.0, np.nan)),
        "taper_per_px": p[:, kernels.TAPER],
        "background_x_dn_per_px": _slope_x(p, places[:, 2]),
        "background_y_dn_per_px": _slope_y(p, places[:, 2]),
        "var_sigma_px2": np.where(known, filled[:, kernels.SIGMA, kernels.SIGMA], np.nan),
        "var_amplitude_dn2": np.where(known, filled[:, kernels.AMPLITUDE, kernels.AMPLITUDE], np.nan),
        "length_px": candidates.length_px,
        "s_curve_px": np.where(known, 0.0, np.nan),
        "chi2_per_dof": chi2 / dof,
        "dof": dof,
    }
    more = oriented(places, p, angle, cov, fit.section == EDGE) | held
    return placed(places, p[:, kernels.OFFSET], angle, cov[:, kernels.OFFSET, kernels.OFFSET], more, _flags(fit, candidates, more))


def placed(
    places: np.ndarray, offset: np.ndarray, angle: np.ndarray, variance: np.ndarray, more: dict[str, Any], flags: np.ndarray
) -> Positions:
    """Positions of lines from their offsets against the places where they were looked for."""
    s, c = np.sin(angle), np.cos(angle)
    x, y = places[:, 0] - s * offset, places[:, 1] + c * offset
    return Positions(x, y, variance * s * s, -variance * s * c, variance * c * c, flags, more)


def oriented(places: np.ndarray, p: np.ndarray, angle: np.ndarray, cov: np.ndarray, edge: bool) -> dict[str, np.ndarray]:
    """Columns that depend on which way round a line is taken: its angle is brought to −90 … 90, and everything else with it."""
    turns = np.round(angle / np.pi)
    turns = np.where(angle - turns * np.pi <= -0.5 * np.pi, turns - 1, turns)
    sign = np.where(turns % 2 == 0, 1.0, -1.0)
    c, s = np.cos(angle), np.sin(angle)
    lever = c * places[:, 0] + s * places[:, 1]  # how far the middle lies from the foot of the perpendicular from (0, 0)
    v, w, k = cov[:, 0, 0], cov[:, 1, 1], cov[:, 0, 1]
    amplitude, background = p[:, kernels.AMPLITUDE], p[:, kernels.BACKGROUND]
    curve = p[:, kernels.CURVE]
    return {
        "angle_deg": (angle - turns * np.pi) / DEG,
        "offset_px": sign * (c * places[:, 1] - s * places[:, 0] + p[:, kernels.OFFSET]),
        "amplitude_dn": amplitude * sign if edge else amplitude,
        "background_dn": np.where(sign < 0, background + amplitude, background) if edge else background,
        "curvature_per_px": curve * sign,
        "var_curvature_per_px2": np.where(np.isfinite(p[:, 0]), np.nan_to_num(cov[:, kernels.CURVE, kernels.CURVE]), np.nan),
        "var_across_px2": v,
        "var_offset_px2": v + lever**2 * w - 2 * lever * k,
        "cov_offset_angle_px_deg": sign * (k - lever * w) / DEG,
        "var_angle_deg2": w / DEG**2,
    }


def _slope_x(p: np.ndarray, angle: np.ndarray) -> np.ndarray:
    slope: np.ndarray = p[:, kernels.ALONG] * np.cos(angle) - p[:, kernels.ACROSS] * np.sin(angle)
    return slope


def _slope_y(p: np.ndarray, angle: np.ndarray) -> np.ndarray:
    slope: np.ndarray = p[:, kernels.ALONG] * np.sin(angle) + p[:, kernels.ACROSS] * np.cos(angle)
    return slope


def _flags(fit: Fit, candidates: LineCandidates, more: dict[str, np.ndarray]) -> np.ndarray:
    p, met = fit.fits.values, np.nan_to_num(fit.fits.told[:, 3]).astype(np.int64)
    excess = more["chi2_per_dof"] - 1.0 - 5.0 * np.sqrt(2.0 / more["dof"])
    # noise alone is often fitted best by a blur as wide as the window
    blur = np.minimum(p[:, kernels.SIGMA], BLUR_REACH * candidates.blur_px)
    with np.errstate(invalid="ignore"):
        said = {
            Flag.BORDER: met & kernels.BORDERS,
            Flag.SATURATED: met & kernels.HIGH,
            Flag.CLIPPED_AT_BLACK: met & kernels.LOW,
            Flag.OVERLAPPING: met & kernels.SHARED,
            Flag.NOT_CONVERGED: met & (kernels.RESTLESS | kernels.SINGULAR),
            Flag.UNDER_SAMPLED: p[:, kernels.SIGMA] < LEAST_BLUR_PX,
            Flag.GRADIENT: p[:, kernels.TAPER] != 0,
            Flag.UNEVEN_BACKGROUND: (p[:, kernels.ACROSS] != 0) | (p[:, kernels.ALONG] != 0),
            Flag.POOR_FIT: excess > 0.1,
            Flag.FAINT: more["var_across_px2"] > (0.15 * np.hypot(blur, PIXEL)) ** 2,
        }
    known = np.isfinite(p[:, 0])
    flags = candidates.flags.astype(np.uint32)
    for flag, mask in said.items():
        here = np.asarray(mask, bool) & (known | (flag in (Flag.BORDER, Flag.NOT_CONVERGED)))
        flags |= np.where(here, np.uint32(flag), np.uint32(0))
    return flags


@dataclass(frozen=True)
class LineRows:
    """Where rows cross lines; arrays of shape (m,).

    Parameters
    ----------
    line : ndarray of int
        Index of the line.
    by_column : ndarray of bool
        Whether ``index`` counts columns: so for lines that are nearer to the x axis than to the y axis.
    index : ndarray of int
        The row, or column.
    position_px : ndarray
        x on that row (y on that column), in pixels from the centre of the first one.
    var_px2 : ndarray
        Its variance by the pixels' noise.
    across_px, along_px : ndarray
        Distance across from the line that was fitted as a whole, towards (−sin, cos) of its angle, and place along it from its middle.
    """

    line: np.ndarray
    by_column: np.ndarray
    index: np.ndarray
    position_px: np.ndarray
    var_px2: np.ndarray
    across_px: np.ndarray
    along_px: np.ndarray


def line_rows(
    frame: np.ndarray,
    candidates: LineCandidates,
    noise: NoiseModel,
    kind: str = "line",
    estimator: str = "row_template",
    *,
    section: str = "auto",
    curvature: bool | str = "auto",
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> LineRows:
    """Measure where each row crosses each line or edge (each column, where the line is nearer to the x axis).

    Width, blur and the places of the windows come from the template that is fitted to the whole line; "row_template" fits place, height
    and background of every row. Rows whose window leaves the frame or meets another line are left out.

    Parameters
    ----------
    frame, candidates, noise, kind, section, curvature, aperture_px, threads
        As for `line_positions`.
    estimator : {"row_template", "row_squared_centroid", "row_centroid", "row_soft_threshold"}

    Raises
    ------
    InputError
        If an argument cannot be used.
    """
    if estimator not in ROW_ESTIMATORS:
        raise InputError("no such estimator of rows", value=estimator, allowed=", ".join(ROW_ESTIMATORS))
    fit = fit_template(frame, candidates, noise, kind, section, ("auto", "auto", curvature), aperture_px, threads)
    how, p, section_of = by_row.Rows(LAWS[estimator], fit.aperture_px, noise.numbers(frame.dtype)), fit.fits.values, fit.fits.told[:, 4]

    def one(i: int) -> np.ndarray:
        rows = np.empty((max(frame.shape), by_row.FACTS))
        n = by_row.rows_of(frame, how, int(section_of[i]), p[i], i, fit.lines, rows) if np.isfinite(p[i, 0]) else 0
        return rows[:n].copy()

    parts = map_tiles(one, range(len(candidates)), threads)
    table = np.concatenate(parts) if parts else np.empty((0, by_row.FACTS))
    line = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    angle = fit.lines.places[:, 2] + p[:, kernels.ANGLE]
    flat = np.abs(np.sin(angle)) < np.abs(np.cos(angle))
    return LineRows(line, flat[line], table[:, 0].astype(np.int64), table[:, 1], table[:, 2], table[:, 3], table[:, 4])


def replace_by_rows(
    template: Positions, fit: Fit, frame: np.ndarray, noise: NoiseModel, estimator: str, threads: int | None = None
) -> Positions:
    """Return the positions with place, angle and curvature from an estimator per row and a weighted regression.

    The variances of the rows follow from the template's profile (propagator P1), so that their weights do not answer to the noise.
    """
    fits, places, n = fit.fits, fit.lines.places, len(fit.lines.places)
    results, told = np.full((n, 12), np.nan), np.full((n, 3), np.nan)
    how, section = by_row.Rows(LAWS[estimator], fit.aperture_px, noise.numbers(frame.dtype)), np.nan_to_num(fits.told[:, 4])

    def part(first: int) -> None:
        span = first, min(first + CHUNK, n)
        by_row.regress_lines(frame, span, how, section, fits, fit.lines, by_row.Regressions(results, told))

    map_tiles(part, range(0, n, CHUNK), threads)
    p = fits.values.copy()
    for column, k in enumerate((kernels.OFFSET, kernels.ANGLE, kernels.CURVE)):
        p[:, k] += results[:, column]
    cov = np.full_like(fits.covariances, np.nan)
    order = [kernels.OFFSET, kernels.ANGLE, kernels.CURVE]
    cov[np.ix_(range(n), order, order)] = results[:, 3:].reshape(n, 3, 3)
    angle = places[:, 2] + p[:, kernels.ANGLE]
    lost = ~np.isfinite(results[:, 0])
    dof = np.maximum(told[:, 1], 1.0)
    changed = {"s_curve_px": told[:, 2], "chi2_per_dof": told[:, 0] / dof, "dof": dof}
    more = template.more | oriented(places, p, angle, cov, fit.section == 0) | changed
    flags = template.flags & ~np.uint32(Flag.POOR_FIT)
    excess = changed["chi2_per_dof"] - 1.0 - 5.0 * np.sqrt(2.0 / dof)
    with np.errstate(invalid="ignore"):
        flags = flags | np.where(excess > 0.1, np.uint32(Flag.POOR_FIT), np.uint32(0))
    flags = np.where(lost, flags | np.uint32(Flag.NOT_CONVERGED), flags)
    moved = placed(places, p[:, kernels.OFFSET], angle, cov[:, kernels.OFFSET, kernels.OFFSET], more, flags)
    return replace(moved, more=more)
