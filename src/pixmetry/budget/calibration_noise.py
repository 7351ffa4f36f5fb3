"""What the noise of a calibration adds to every position that is corrected by it: a row of its own in a budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixmetry.budget.fields import Places
from pixmetry.budget.measured_calibration import MeasuredCalibration
from pixmetry.budget.motion import OF_MOTION
from pixmetry.budget.networks import DEPTH, FOUR, TEN, calibrating, interior_basis, solve
from pixmetry.budget.setting import Setting
from pixmetry.budget.table import ABSENT, DESCRIBED, FORMULA, MEASURED, NOTHING, TYPICAL, Pair, Parts, SourceRow, independent_px

CALIBRATION = "calibration"  # name of the row
TITLE = "Noise of the calibration"
ADVICE = (
    "Calibrate with more images or more targets, out to the corners of the frame: it falls with the root of the number of image points. "
    "Or free fewer parameters."
)
FEW = 240  # image points of a small calibration: the largest to expect where nothing is told
MOST_NODES_PER_POINT = 1 / 12  # of a residual grid: with fewer image points `pixmetry calibrate` takes fewer nodes


def calibration_row(rows: Sequence[SourceRow], setting: Setting) -> SourceRow:
    """The row of the calibration's own noise.

    Parameters
    ----------
    rows : sequence of SourceRow
        Those of the sources: where the scenario does not say how well the calibration's targets were measured, they were as these are.
    setting : Setting

    Notes
    -----
    Interior parameters of a bundle adjustment of `networks.calibrating`, all orientations and points estimated with them; their covariance
    is propagated to places all over the frame, without what a rotation of the camera takes up. Nodes of a residual grid come on top: on
    average, the variance of an image point times nodes over image points.
    """
    told = setting.scenario.calibration
    row = SourceRow(CALIBRATION, CALIBRATION, TITLE, 0, 0, "", "G", Parts(), Parts(), advice=ADVICE)
    if told.model == "none":
        return replace(row, status=ABSENT, reason="nothing was calibrated")
    if setting.made is not None:
        return _of_made(row, setting, setting.made)
    still = [r for r in rows if r.source_id not in OF_MOTION]
    sigma = independent_px(still) if told.noise_px is None else (told.noise_px, told.noise_px)
    known = bool(told.model_fields_set & {"images", "targets", "noise_px"})
    modes, places = modes_of(setting, sigma)
    after = parts_of_modes(modes[..., :places], _of_grid(setting, sigma))
    row = replace(
        row,
        status=DESCRIBED if known else TYPICAL,
        how=FORMULA,
        method="covariance of the interior parameters",
        reason=f"{told.images} images of {told.targets} targets, each measured to {sigma[0]:.2g} px in x, {sigma[1]:.2g} px in y",
        after=after,
        fields_px=modes[..., places:],
    )
    more = np.sqrt(told.images * told.targets / FEW)
    return row if known or more <= 1 else replace(row, largest=Parts.of([more * v for v in after.values_px]))


def _of_made(row: SourceRow, setting: Setting, made: MeasuredCalibration) -> SourceRow:
    """The row of a calibration that was made; what its residuals have in common by place may be in no other row, and is the upper end."""
    places, x, y = _places(setting)
    modes = made.displacements(places.x_px[0], places.y_px[0]) * np.array([1.0, setting.aspect])[:, None]
    modes = unrotated(modes, x / made.camera.c_px[0], y / made.camera.c_px[0], places.even) / np.array([1.0, setting.aspect])[:, None]
    after = parts_of_modes(modes[..., : places.even])
    (x_px, y_px), (left_x, left_y) = after.smooth_px, made.left_px
    largest = replace(after, smooth_px=(float(np.hypot(x_px, left_x)), float(np.hypot(y_px, left_y))))
    common = f"; its residuals have {made.left_px[0]:.2g} px in x and {made.left_px[1]:.2g} px in y in common by place"
    reason = f"calibration of {made.camera.name}, {made.images} images{common if any(made.left_px) else ''}"
    if made.finding is not None:
        reason += f"; {made.finding.text}"
    found = replace(row, status=MEASURED, how=FORMULA, method="covariance of the interior parameters", reason=reason, after=after)
    return replace(found, largest=largest, fields_px=modes[..., places.even :])


def _places(setting: Setting) -> tuple[Places, np.ndarray, np.ndarray]:
    """Places over the frame and in the network, and where they are from the middle of the frame, in pixels along x."""
    network = setting.network
    also = None if network is None else network.places_px
    places = Places.over(setting.described.frame_shape, setting.scenario.calibration.grid_px, also)
    return places, *setting.from_middle(places.x_px[0], places.y_px[0])


def modes_of(setting: Setting, sigma_px: Pair) -> tuple[np.ndarray, int]:
    """Independent displacements by the parameters' noise, shape (k, 2, n), px: at so many places over the frame, then in the network."""
    told, frame, aspect = setting.scenario.calibration, setting.described.frame_shape, setting.aspect
    sigma = (max(sigma_px[0], 1e-9), max(aspect * sigma_px[1], 1e-9))
    network, factor = calibrating(setting.c_px, frame, aspect, told.images, told.targets, DEPTH if told.field == "deep" else 0.0)
    which = FOUR if told.model == "principal_point_and_scale" else TEN
    covariance = factor * solve(network, sigma, which).interior_covariance
    places, x, y = _places(setting)
    half = max(frame) / 2
    basis = interior_basis(x / half, y / half)[which]
    modes = np.tensordot(np.linalg.cholesky(covariance).T, basis, axes=1)
    return unrotated(modes, x / setting.c_px, y / setting.c_px, places.even) / np.array([1.0, aspect])[:, None], places.even


def unrotated(modes: np.ndarray, u: np.ndarray, v: np.ndarray, even: int) -> np.ndarray:
    """Displacements without what a rotation of the camera takes up; ``u`` and ``v`` are the places over the principal distance."""
    turned = np.array([[u * v, 1 + v * v], [1 + u * u, u * v], [-v, u]])
    columns = turned[..., :even].reshape(3, -1).T
    found = np.linalg.lstsq(columns, modes[..., :even].reshape(len(modes), -1).T, rcond=None)[0]
    return np.asarray(modes - np.tensordot(found.T, turned, axes=1))


def parts_of_modes(modes: np.ndarray, place_px: Pair = NOTHING) -> Parts:
    """Root mean square over the frame, as what changes slowly over it."""
    x, y = (float(v) for v in np.sqrt(np.mean(np.sum(modes**2, axis=0), axis=-1)))
    return Parts(smooth_px=(x, y), place_px=place_px)


def _of_grid(setting: Setting, sigma_px: Pair) -> Pair:
    told, (rows, cols) = setting.scenario.calibration, setting.described.frame_shape
    if told.model != "residual_grid":
        return (0.0, 0.0)
    nodes = np.prod([np.ceil((n - 1) / told.grid_px) + 1 for n in (rows, cols)])
    share = float(np.sqrt(min(nodes / (told.images * told.targets), MOST_NODES_PER_POINT)))
    return (share * sigma_px[0], share * sigma_px[1])
