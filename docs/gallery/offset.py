"""The chapter's offset experiment (Note 13, Figs 3.13 and 3.14): a line whose feet a black level below the converter's zero cuts off.

A line with a Gaussian profile shifts by 3 px over 500 rows. Of every row an offset is subtracted, what falls below zero is stored as zero,
and the row's centroid over 41 px is compared with the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gallery.profiles import TOP_DN, gaussian, stored
from pixmetry.core.random import Grid, Stream
from pixmetry.locate.centroids.fixed import FixedCentroid
from pixmetry.locate.lines.line_candidates import LineCandidates
from pixmetry.locate.lines.lines import line_positions
from pixmetry.locate.noise import NoiseModel

ROWS, SAMPLES = 500, 41
SIGMA_PX, PEAK_DN, SKEW_PX, OFFSET_DN = 1.5, 150.0, 3.0, 6.0
MIDDLE = SAMPLES // 2
HARMONICS = 10
STREAM = Stream(313, 313, "handbook.offset")


def centres() -> np.ndarray:
    """True place of the line in each row less the middle column: −1.5 … 1.5 px, three whole pixels, shape (500,)."""
    return SKEW_PX * (np.arange(ROWS) / ROWS - 0.5)


def levels(
    offset_dn: float, sigma_px: float = SIGMA_PX, integrated: bool = False, centre_px: np.ndarray | None = None, peak_dn: float = PEAK_DN
) -> np.ndarray:
    """Grey values of the rows before they are stored, less the offset; shape (rows, 41)."""
    centre = centres() if centre_px is None else centre_px
    return peak_dn * gaussian(np.arange(SAMPLES) - MIDDLE - centre[:, None], sigma_px, integrated) - offset_dn


def row_positions(rows_dn: np.ndarray, estimator: FixedCentroid) -> np.ndarray:
    """Centroid of each row less the middle column, shape (rows,).

    The estimator takes squares of pixels: each row fills one, as a line would that stays where it is.
    """
    windows = np.broadcast_to(rows_dn[:, None, :], (len(rows_dn), SAMPLES, SAMPLES))
    return estimator.locate(np.ascontiguousarray(windows))[0] - MIDDLE


CENTROID, SQUARED = FixedCentroid("centroid", SAMPLES), FixedCentroid("squared_centroid", SAMPLES)


@dataclass(frozen=True)
class Swing:
    """How a row's error goes with the line's place between the pixels.

    Parameters
    ----------
    error_px : ndarray, shape (500,)
        Found less true.
    first_px : float
        Signed amplitude of sin(2πc) in it, c being the true place: least squares with the cosine and a constant.
    half_range_px, rms_px : float
        Half of the distance from the least error to the greatest, and the root mean square.
    """

    error_px: np.ndarray
    first_px: float
    half_range_px: float
    rms_px: float

    @classmethod
    def of(cls, error_px: np.ndarray, centre_px: np.ndarray | None = None) -> Swing:
        """Read it from the errors."""
        centre = centres() if centre_px is None else centre_px
        waves = np.stack([np.sin(2 * np.pi * centre), np.cos(2 * np.pi * centre), np.ones_like(centre)], axis=1)
        first = np.linalg.lstsq(waves, error_px, rcond=None)[0][0]
        return cls(error_px, float(first), float(np.ptp(error_px) / 2), float(np.sqrt(np.mean(error_px**2))))


@lru_cache(maxsize=256)
def swing(
    offset_dn: float,
    conversion: str = "unquantised",
    power: int = 1,
    integrated: bool = False,
    sigma_px: float = SIGMA_PX,
    peak_dn: float = PEAK_DN,
) -> Swing:
    """Run the experiment without noise: centroid (``power`` 1) or squared centroid (2) of every row."""
    rows = stored(levels(offset_dn, sigma_px, integrated, peak_dn=peak_dn), conversion)
    return Swing.of(row_positions(rows, CENTROID if power == 1 else SQUARED) - centres())


def predicted(
    offset_dn: float, power: int = 1, integrated: bool = False, sigma_px: float = SIGMA_PX, peak_dn: float = PEAK_DN
) -> np.ndarray:
    """Signed amplitudes of sin(2πkc), k = 1 … 10, in the error of an ideal row, shape (10,), px.

    Notes
    -----
    With h the profile that is left after subtraction and cut-off, raised to the power, Poisson's summation formula gives the error
    −2 Σ_k S_k sin(2πkc)/∫h with S_k = ∫ x h(x) sin(2πkx) dx, to first order (Σh over the pixels is taken for ∫h; cf. B. F. Alexander and
    K. C. Ng, Optical Engineering 30(9), 1991). The integrals run between the places where the profile is cut off: Gauss–Legendre, 800
    nodes.
    """
    from scipy.optimize import brentq

    reach = min(MIDDLE - 0.5, 9.0 * sigma_px)
    if offset_dn > 0:
        reach = brentq(lambda x: peak_dn * float(gaussian(x, sigma_px, integrated)) - offset_dn, 0.0, reach, xtol=1e-13)
    node, weight = _nodes()
    x = reach * node
    h = np.maximum(peak_dn * gaussian(x, sigma_px, integrated) - offset_dn, 0.0) ** power
    k = np.arange(1, HARMONICS + 1)
    return -2 * (np.sin(2 * np.pi * k[:, None] * x) @ (weight * x * h)) / (weight @ h)


@lru_cache(maxsize=1)
def _nodes() -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(800)


def predicted_rms(amplitudes_px: np.ndarray) -> float:
    """Root mean square over all places of a sum of sines with these amplitudes."""
    return float(np.sqrt(np.sum(np.square(amplitudes_px)) / 2))


def against_offset(offsets_dn: np.ndarray, power: int) -> tuple[np.ndarray, np.ndarray]:
    """Signed first amplitude for each offset: found without noise and rounding, and predicted; shapes as ``offsets_dn``, px."""
    found = np.array([swing(float(o), power=power).first_px for o in offsets_dn])
    return found, np.array([predicted(float(o), power)[0] for o in offsets_dn])


def outlier_shift(value_dn: float = 1.0, distance_px: float = 10.0) -> tuple[float, float]:
    """What a single stray grey value far from the line does to a row's centroid: found, and as value × distance over the line's sum.

    The line stands in the middle of the middle pixel, without offset, noise and rounding.
    """
    rows = stored(levels(0.0, centre_px=np.zeros(1)), "unquantised")
    total = float(rows.sum())
    rows[0, MIDDLE + int(distance_px)] += value_dn
    return float(row_positions(rows, CENTROID)[0]), value_dn * distance_px / total


@dataclass(frozen=True)
class Exposures:
    """Mean error in x of a target that stands still, for each exposure (Fig 3.17).

    Parameters
    ----------
    peak_dn : tuple of float
        Height of the target at each exposure.
    error_px : dict of ndarray
        By the offset that was cut off: mean over the frames.
    u_px : dict of ndarray
        Its standard error.
    """

    peak_dn: tuple[float, ...]
    error_px: dict[float, np.ndarray]
    u_px: dict[float, np.ndarray]


@lru_cache(maxsize=2)
def exposures(
    peak_dn: tuple[float, ...] = (220.0, 150.0, 100.0, 60.0), phase_px: float = 0.35, sigma_px: float = 1.0, frames: int = 800
) -> Exposures:
    """Centroid over 21 × 21 px of a round Gaussian spot that is averaged over each pixel, with noise, rounded, then cut off.

    The noise has the variance 0.81 + 0.0097 I at a grey value I.
    """
    x = np.arange(21) - 10.0
    shape = gaussian(x, sigma_px)[:, None] * gaussian(x - phase_px, sigma_px)
    error, u = {}, {}
    for j, offset in enumerate((40.0, 6.0)):
        found = []
        for k, peak in enumerate(peak_dn):
            noise = STREAM.normal(Grid.whole(range(frames), shape.shape), draw=1 + j * len(peak_dn) + k)
            windows = stored(peak * shape - offset + noise * np.sqrt(0.81 + 0.0097 * peak * shape))
            found.append(FixedCentroid("centroid", 21).locate(windows)[0] - 10 - phase_px)
        error[offset], u[offset] = np.mean(found, axis=1), np.std(found, axis=1, ddof=1) / np.sqrt(frames)
    return Exposures(peak_dn, error, u)


BLACK_DN = np.arange(-12.0, 13.0, 3.0)
NOISE_DN = 1.5
PIECE_ROWS = 20
WAYS = ("centroid", "squared centroid", "soft threshold", "fit")


@dataclass(frozen=True)
class Cure:
    """Errors of one way to locate pieces of the line, one value per black level.

    Parameters
    ----------
    total_px : ndarray
        Root mean square.
    random_px : ndarray
        Standard deviation from frame to frame.
    lasting_px : ndarray
        Root mean square of what the mean of endless frames would still be off.
    stated_px : ndarray
        Standard deviation that the fit itself states; NaN for the others.
    """

    total_px: np.ndarray
    random_px: np.ndarray
    lasting_px: np.ndarray
    stated_px: np.ndarray


@lru_cache(maxsize=2)
def cures(frames: int = 20) -> dict[str, Cure]:
    """Ways to locate pieces of 20 rows against the black level, with noise of 1.5 grey values, averaged over each pixel and rounded.

    Of a centroid, the mean over the rows of the piece is taken. "centroid" and "squared centroid" take the grey values as they are;
    "soft threshold" takes off the black level, where it is above 0, and a threshold of three standard deviations of the noise; "fit" is
    the template of a straight line, told the noise and that the scale ends at 0.
    """
    noise = STREAM.normal(Grid.whole(range(frames), (ROWS, SAMPLES)))
    error = {way: np.empty((len(BLACK_DN), frames, ROWS // PIECE_ROWS)) for way in WAYS}
    stated = np.full(len(BLACK_DN), np.nan)
    for j, black in enumerate(BLACK_DN):
        soft = FixedCentroid("soft_threshold", SAMPLES, sigma=3.0).resolved(max(black, 0.0), NOISE_DN)
        rows = stored(levels(-black, integrated=True) + NOISE_DN * noise)
        for k in range(frames):
            for way, law in zip(WAYS, (CENTROID, SQUARED, soft), strict=False):
                error[way][j, k] = (row_positions(rows[k], law) - centres()).reshape(-1, PIECE_ROWS).mean(axis=1)
        error["fit"][j], variance = fitted_pieces(rows, error["soft threshold"][j] + centres().reshape(-1, PIECE_ROWS).mean(axis=1), black)
        stated[j] = np.sqrt(variance.mean())
    none = np.full(len(BLACK_DN), np.nan)
    return {way: _cure(error[way], stated if way == "fit" else none) for way in WAYS}


def fitted_pieces(rows_dn: np.ndarray, rough_px: np.ndarray, black_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Fit a straight line to every 20 rows of every frame.

    Parameters
    ----------
    rows_dn : ndarray, shape (frames, 500, 41)
        Stored grey values.
    rough_px : ndarray, shape (frames, 25)
        Where each piece roughly is, less the middle column.
    black_dn : float
        Stored level of black, a start value where it is above 0.

    Returns
    -------
    error_px : ndarray, shape (frames, 25)
        Found less true at the middle of the piece.
    variance_px2 : ndarray, shape (frames, 25)
        As the fit states it.
    """
    frames, pieces = rough_px.shape
    beside = np.concatenate(list(rows_dn), axis=1).astype(np.uint8)  # the frames side by side
    middle = MIDDLE + SAMPLES * np.arange(frames)
    noise = NoiseModel(NOISE_DN**2 + 1 / 12, low_dn=0.0, high_dn=TOP_DN)
    error, variance = np.empty((frames, pieces)), np.empty((frames, pieces))
    for piece in range(pieces):  # one at a time, since lines that touch share their pixels
        part = np.ascontiguousarray(beside[piece * PIECE_ROWS : (piece + 1) * PIECE_ROWS])
        x = middle + rough_px[:, piece]
        known = {"blur_px": SIGMA_PX, "amplitude_dn": PEAK_DN, "background_dn": max(black_dn, 0.0), "sigma_dn": NOISE_DN}
        lines = LineCandidates.of(x1_px=x, y1_px=0.0 * x, x2_px=x, y2_px=0.0 * x + PIECE_ROWS - 1, **known)
        found = line_positions(part, lines, noise, section="gaussian", plane=False, taper=False, curvature=False)
        true = SKEW_PX * ((piece * PIECE_ROWS + found.y_px) / ROWS - 0.5)
        error[:, piece], variance[:, piece] = found.x_px - middle - true, found.var_x_px2
    return error, variance


def _cure(error_px: np.ndarray, stated_px: np.ndarray) -> Cure:
    random = error_px.var(axis=1, ddof=1).mean(axis=1)
    lasting = (error_px.mean(axis=1) ** 2).mean(axis=1) - random / error_px.shape[1]  # the mean of these frames still holds noise
    return Cure(np.sqrt((error_px**2).mean(axis=(1, 2))), np.sqrt(random), np.sqrt(np.maximum(lasting, 0.0)), stated_px)
