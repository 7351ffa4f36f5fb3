"""A smooth polynomial surface and the split of an image into surface, rows, columns and pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.arrays import Array
from pixmetry.core.errors import MeasureError


def orthonormal_polynomials(n: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Polynomials that are orthonormal over n equidistant pixels, and their slopes at the centre.

    Returns
    -------
    basis : ndarray, shape (n, degree + 1), float64
    slopes : ndarray, shape (degree + 1,), float64, per pixel
    """
    half = max((n - 1) / 2, 0.5)
    powers = np.vander((np.arange(n) - (n - 1) / 2) / half, degree + 1, increasing=True)
    basis, r = np.linalg.qr(powers)
    slope_of_powers = np.zeros(degree + 1)
    slope_of_powers[1:2] = 1.0 / half
    return basis, np.linalg.solve(r.T, slope_of_powers)


def median(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """The median as ``np.median`` gives it, of values without NaN, in a tenth of its time.

    One selection instead of three: the lower of two middle values is the largest of those before the upper one.
    """
    if axis is None:
        values, axis = values.ravel(), 0
    rows = np.ascontiguousarray(np.moveaxis(values, axis, -1))
    middle = rows.shape[-1] // 2
    part = np.partition(rows, middle, axis=-1)
    upper = part[..., middle]
    return upper if rows.shape[-1] % 2 else 0.5 * (part[..., :middle].max(axis=-1) + upper)


@dataclass(frozen=True)
class Surface:
    """A polynomial of total degree ``degree`` over an image, from least squares.

    On the full pixel grid the terms in x alone lie in the column means, those in y alone in the row means and the mixed ones in the
    interaction, so each takes whole degrees of freedom from one stratum of the analysis of variance.
    """

    values: np.ndarray  # shape (rows, cols)
    coefficients: np.ndarray  # shape (degree + 1, degree + 1), [y power, x power], of orthonormal polynomials
    basis_y: np.ndarray
    basis_x: np.ndarray
    slopes_y: np.ndarray
    slopes_x: np.ndarray
    degree: int

    @property
    def n_mixed(self) -> int:
        """Number of terms that depend on both x and y."""
        return self.degree * (self.degree - 1) // 2

    def coefficient_variances(self, pixel: float, row: float, col: float) -> np.ndarray:
        """Variances of the coefficients from the per-pixel mean squares of the three strata; the constant term is given none."""
        variances: Array = np.full(self.coefficients.shape, pixel) * _total_degree(self.degree)
        variances[:, 0], variances[0, :] = row, col
        variances[0, 0] = 0.0
        return variances


def _total_degree(degree: int) -> np.ndarray:
    power = np.arange(degree + 1)
    return (power[:, None] + power[None, :] <= degree).astype(float)


def fit_surface(image: np.ndarray, degree: int) -> Surface:
    """Fit a polynomial surface of a total degree to an image, shape (rows, cols).

    Raises
    ------
    MeasureError
        If there are no more rows or columns than the degree.
    """
    (rows, cols) = image.shape
    if min(rows, cols) <= degree:
        raise MeasureError(
            f"frames are too small for a surface of degree {degree}",
            where="illumination",
            value=image.shape,
            allowed=f"{degree + 1} or more rows and columns",
            remedy="take larger frames",
        )
    basis_y, slopes_y = orthonormal_polynomials(rows, degree)
    basis_x, slopes_x = orthonormal_polynomials(cols, degree)
    coefficients = (basis_y.T @ image @ basis_x) * _total_degree(degree)
    return Surface(basis_y @ coefficients @ basis_x.T, coefficients, basis_y, basis_x, slopes_y, slopes_x, degree)


def fill(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace masked pixels by row mean + column mean − mean of the image.

    Iterated least squares for missing cells (Yates 1933): the filled pixels have no residual, so each takes one degree of freedom. The
    mean squares of rows and columns come out too large by a share of the order of the masked pixels: negligible below 1 %.
    """
    if not mask.any():
        return image
    filled = np.where(mask, median(image[~mask]), image)
    row, col = np.nonzero(mask)
    at_row, at_col = np.unique(row), np.unique(col)
    in_row, in_col = np.searchsorted(at_row, row), np.searchsorted(at_col, col)
    for _ in range(5):
        # only the lines that hold a hole change
        filled[row, col] = filled[at_row].mean(axis=1)[in_row] + filled[:, at_col].mean(axis=0)[in_col] - filled.mean()
    return filled


@dataclass(frozen=True)
class Strata:
    """Sums of squares of one image, or of products of two, over rows, columns and the rest, all per pixel."""

    pixel: float
    row: float
    col: float


def residual_parts(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split an image into pixel residuals, row deviations and column deviations."""
    mean = image.mean()
    row, col = image.mean(axis=1) - mean, image.mean(axis=0) - mean
    return image - mean - row[:, None] - col[None, :], row, col


def cross_strata(one: np.ndarray, other: np.ndarray) -> Strata:
    """Sums of products of two images over the strata (of squares, if they are the same)."""
    rows, cols = one.shape
    (p1, r1, c1), (p2, r2, c2) = residual_parts(one), residual_parts(other)
    return Strata(float(np.vdot(p1, p2)), cols * float(r1 @ r2), rows * float(c1 @ c2))
