"""Lines row by row: positions with variances for S-curves, jitter and plumb lines, and lines by regression over their rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.targets import Flag, Positions
from pixmetry.locate.lines import _line_kernels as whole
from pixmetry.locate.lines import _line_row_kernels as kernels
from pixmetry.locate.lines.line_candidates import LineCandidates
from pixmetry.locate.lines.lines import CHUNK, ROW_ESTIMATORS, Fit, fit_template, oriented, placed
from pixmetry.locate.noise import NoiseModel

LAWS = {
    "row_centroid": kernels.CENTROID,
    "row_squared_centroid": kernels.SQUARED,
    "row_soft_threshold": kernels.SOFT,
    "row_template": kernels.TEMPLATE,
}


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
    how, p, section_of = kernels.Rows(LAWS[estimator], fit.aperture_px, noise.numbers(frame.dtype)), fit.fits.values, fit.fits.told[:, 4]

    def one(i: int) -> np.ndarray:
        rows = np.empty((max(frame.shape), kernels.FACTS))
        n = kernels.rows_of(frame, how, int(section_of[i]), p[i], i, fit.lines, rows) if np.isfinite(p[i, 0]) else 0
        return rows[:n].copy()

    parts = map_tiles(one, range(len(candidates)), threads)
    table = np.concatenate(parts) if parts else np.empty((0, kernels.FACTS))
    line = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    angle = fit.lines.places[:, 2] + p[:, whole.ANGLE]
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
    how, section = kernels.Rows(LAWS[estimator], fit.aperture_px, noise.numbers(frame.dtype)), np.nan_to_num(fits.told[:, 4])

    def part(first: int) -> None:
        span = first, min(first + CHUNK, n)
        kernels.regress_lines(frame, span, how, section, fits, fit.lines, kernels.Regressions(results, told))

    map_tiles(part, range(0, n, CHUNK), threads)
    p = fits.values.copy()
    for column, k in enumerate((whole.OFFSET, whole.ANGLE, whole.CURVE)):
        p[:, k] += results[:, column]
    cov = np.full_like(fits.covariances, np.nan)
    order = [whole.OFFSET, whole.ANGLE, whole.CURVE]
    cov[np.ix_(range(n), order, order)] = results[:, 3:].reshape(n, 3, 3)
    angle = places[:, 2] + p[:, whole.ANGLE]
    lost = ~np.isfinite(results[:, 0])
    dof = np.maximum(told[:, 1], 1.0)
    changed = {"s_curve_px": told[:, 2], "chi2_per_dof": told[:, 0] / dof, "dof": dof}
    more = template.more | oriented(places, p, angle, cov, fit.section == 0) | changed
    flags = template.flags & ~np.uint32(Flag.POOR_FIT)
    excess = changed["chi2_per_dof"] - 1.0 - 5.0 * np.sqrt(2.0 / dof)
    with np.errstate(invalid="ignore"):
        flags = flags | np.where(excess > 0.1, np.uint32(Flag.POOR_FIT), np.uint32(0))
    flags = np.where(lost, flags | np.uint32(Flag.NOT_CONVERGED), flags)
    moved = placed(places, p[:, whole.OFFSET], angle, cov[:, whole.OFFSET, whole.OFFSET], more, flags)
    return replace(moved, more=more)
