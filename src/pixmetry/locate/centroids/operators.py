"""Where targets are by their outline or by a fitted Gaussian: operators of the literature, with covariance and S-curve."""

from __future__ import annotations

from functools import partial

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.centroids import _operator_kernels as o
from pixmetry.locate.centroids._moment_kernels import ANGLE, COLUMNS, MAJOR, MARGIN, MINOR, REACH
from pixmetry.locate.centroids.moments import LARGEST_PX, Prepared, class_means, classes, positions, prepare, reach_px, run_slices
from pixmetry.locate.detect.targets import Positions, Targets
from pixmetry.locate.estimator import Method, Settings
from pixmetry.locate.noise import NoiseModel

OPERATORS = {"perimeter": o.PERIMETER, "forstner": o.FORSTNER, "ellipse_edges": o.ELLIPSE_EDGES, "gaussian": o.GAUSSIAN}
ASTRAY_PX = 1.0
NEGLIGIBLE, SMALL = 0.02, 0.1  # of the variance by noise: variances over the phase of which a few phases, and half of them, tell enough
MARGINS = {"perimeter": 3.0, "forstner": 3.0, "ellipse_edges": 3.0, "gaussian": 4.0}
RIM_PX = 2.0  # between window and border: 1.5 that gradients and rays read around the window, and a window's way from the rough centre


def operator_positions(frame: np.ndarray, targets: Targets, noise: NoiseModel, name: str, *, threads: int | None = None) -> Positions:
    """Locate targets by an operator.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    targets : Targets
    noise : NoiseModel
    name : str
        ``perimeter``: mean place of the pixels above half height that have one of their four neighbours below it.
        ``forstner``: the point nearest to all lines along the gradients (Scharr's), each weighted by the square of its gradient.
        ``ellipse_edges``: rays from the centre, on each the place of the edge by the light along it (a step of full height that holds as
        much), and an ellipse through these places. ``gaussian``: unweighted least squares of an elliptic Gaussian on a constant, in a
        window that is at rest at the estimate and cuts the pixels at its rim.
    threads : int, optional

    Returns
    -------
    Positions
        ``more`` as from `moment_positions`.

    Raises
    ------
    InputError
        If there is no such operator.

    Notes
    -----
    The covariance is that of the pixels' noise and the background's plane through the operator's slopes by pixel; of the perimeter, which
    has none, through the chance of each pixel to be taken over the threshold. The slopes of ``gaussian`` hold that its window follows
    the estimate (`gaussian_of` in the kernels has the formula): that is 12 % on a disc of radius 12 px and blur 2 px. The variance over
    the sub-pixel phase is added: that of the operator itself on noise-free images of targets of like size, blur and shape, the largest
    over half a pixel of sizes (roughly where it is less than 2 % of the former, to a third where it is less than 10 %), on pixels that
    are sensitive on their whole square.

    References
    ----------
    M. R. Shortis, T. A. Clarke, T. Short, Proc. SPIE 2350, 239 (1994), compare such operators. W. Förstner, E. Gülch, Proc. ISPRS
    Intercommission Conf. on Fast Processing of Photogrammetric Data, 281 (1987). A. Fitzgibbon, M. Pilu, R. B. Fisher, IEEE Trans. PAMI
    21(5), 476 (1999); R. Halíř, J. Flusser, Proc. WSCG 98, 125 (1998). H. Scharr, dissertation, Heidelberg (2000), for the gradient.
    """
    if name not in OPERATORS:
        raise InputError("no such operator", value=name, allowed=", ".join(OPERATORS))
    operator, n = OPERATORS[name], len(targets)
    work = prepare(frame, targets, noise, margin=MARGINS[name], rim_px=RIM_PX, threads=threads)
    result, at_rest = np.full((n, 6), np.nan), np.zeros(n, bool)
    work.over(lambda a, b: o.operators(frame, work.record, a, b, operator, work.noise, result, at_rest), threads)
    # a fit that has left its target found something else
    lost = ~(np.hypot(result[:, 0] - targets.x_px, result[:, 1] - targets.y_px) < ASTRAY_PX + 0.25 * targets.semi_minor_px)
    result[lost], at_rest[lost] = np.nan, False
    s_curve = np.sqrt(_phase_variance(work, operator, np.minimum(result[:, 2], result[:, 4]), threads))
    return positions(work, targets, noise, result, at_rest, s_curve)


def _phase_variance(work: Prepared, operator: int, noise_px2: np.ndarray, threads: int | None) -> np.ndarray:
    """Variance over the sub-pixel phase; only roughly where it is nothing beside the variance ``noise_px2`` by the pixels' noise."""
    record = work.record
    if not len(record):
        return np.zeros(0)
    aspect = record[:, MAJOR] / record[:, MINOR]
    # an ellipse that is nearly a circle has no direction
    turn = np.where(aspect > 1.1, np.floor(np.rad2deg(record[:, ANGLE]) / 15.0) + 20.0, 1.0)
    of, one = classes(work.radius, work.blur, 1.5 ** (turn + 40.0 * np.floor(np.log(aspect) / np.log(1.1))) * 1.0001)
    half_height = np.sqrt(record[:, MAJOR] * record[:, MINOR])
    optical = np.sqrt(np.maximum(work.blur**2 - 1 / 12, 0.0025))
    columns = (work.radius, optical, record[:, MAJOR], record[:, MINOR], record[:, ANGLE], 0.25 * record[:, REACH], record[:, MARGIN])
    shape = class_means(of, *columns, half_height)
    shape[:, 4] = record[one, ANGLE]
    large = np.maximum(shape[:, 2] - LARGEST_PX, 0.0)  # beyond this size the phase is averaged over more and more pixels
    for column in (0, 2, 3, 7):
        shape[:, column] = np.maximum(shape[:, column] - large, 0.5)
    steps = (np.arange(4) + 0.37) / 4 - 0.5
    row, col = np.divmod(np.arange(16), 4)  # first the diagonal, then the other fields of its colour on the chessboard
    phases = np.stack([steps[col], steps[row]], axis=1)[np.argsort((row != col) + 2 * ((row + col) % 2), kind="stable")]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    out, least = np.zeros(len(shape)), np.full(len(shape), np.inf)
    np.fmin.at(least, of, np.where(np.isfinite(noise_px2), noise_px2, 0.0))
    negligible, small = NEGLIGIBLE * least, SMALL * least

    def fill(a: int, b: int) -> None:
        o.phase_variances(shape, a, b, operator, phases, nodes, weights, COLUMNS, negligible, small, out)

    run_slices(fill, len(shape), threads)
    phase: np.ndarray = out[of]
    return phase


def _measure(name: str, frame: np.ndarray, targets: Targets, noise: NoiseModel, how: Settings) -> Positions:
    return operator_positions(frame, targets, noise, name, threads=how.threads)


METHODS = tuple(
    Method(name, text, partial(_measure, name), reach_px)
    for name, text in {
        "gaussian": "unweighted least-squares fit of a Gaussian",
        "ellipse_edges": "ellipse through edge points along rays",
        "forstner": "intersection of the gradients' lines (Förstner operator)",
        "perimeter": "average of the points of the perimeter",
    }.items()
)
