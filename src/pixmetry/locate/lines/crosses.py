"""Where lines cross: both lines fitted together, and the intersection with its full covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.targets import Flag, Positions
from pixmetry.locate.lines import _cross_kernels as kernels
from pixmetry.locate.lines import _line_kernels as whole
from pixmetry.locate.lines._profile_kernels import BAR, GAUSSIAN
from pixmetry.locate.lines.line_candidates import LineCandidates
from pixmetry.locate.lines.line_detection import find_lines
from pixmetry.locate.lines.lines import DEG, LEAST_BLUR_PX, PIXEL, Fit, fit_template
from pixmetry.locate.noise import NoiseModel

LEAST_ANGLE_DEG = 15.0
CHUNK = 8  # crosses a task


@dataclass(frozen=True)
class CrossCandidates:
    """Roughly known crosses: which of the lines meet, and where.

    Parameters
    ----------
    lines : LineCandidates
    first, second : ndarray of int, shape (n,)
        Indices of the two lines.
    x_px, y_px : ndarray, shape (n,)
    """

    lines: LineCandidates
    first: np.ndarray
    second: np.ndarray
    x_px: np.ndarray
    y_px: np.ndarray

    def __len__(self) -> int:
        return len(self.x_px)


def find_crosses(
    frame: np.ndarray,
    *,
    polarity: str = "auto",
    noise: NoiseModel | None = None,
    least_length_px: float = 12.0,
    threads: int | None = None,
) -> CrossCandidates:
    """Find places where two lines cross; arguments as for `find_lines`."""
    lines = find_lines(frame, polarity=polarity, noise=noise, least_length_px=least_length_px, threads=threads)
    return crossings(lines, frame.shape)


def crossings(lines: LineCandidates, frame_shape: tuple[int, int]) -> CrossCandidates:
    """Pairs of lines that run across each other at 15° or more, inside the frame, each reaching beyond the other on both sides."""
    n = len(lines)
    first, second = np.triu_indices(n, 1)
    angle, half = lines.angle_rad, 0.5 * lines.length_px
    c, s = np.cos(angle), np.sin(angle)
    x, y = 0.5 * (lines.x1_px + lines.x2_px), 0.5 * (lines.y1_px + lines.y2_px)
    turn = np.sin(angle[second] - angle[first])
    dx, dy = x[second] - x[first], y[second] - y[first]
    with np.errstate(divide="ignore", invalid="ignore"):
        t1 = (dx * s[second] - dy * c[second]) / turn
        t2 = (dx * s[first] - dy * c[first]) / turn
        size = np.abs(turn)
        short_1, short_2 = lines.core_px[second] / size + 1.0, lines.core_px[first] / size + 1.0
        at_x, at_y = x[first] + c[first] * t1, y[first] + s[first] * t1
        good = (size > np.sin(LEAST_ANGLE_DEG * DEG)) & (np.abs(t1) < half[first] - short_1) & (np.abs(t2) < half[second] - short_2)
        good &= (at_x >= 0) & (at_y >= 0) & (at_x <= frame_shape[1] - 1) & (at_y <= frame_shape[0] - 1)
    return CrossCandidates(lines, first[good], second[good], at_x[good], at_y[good])


def cross_positions(
    frame: np.ndarray,
    candidates: CrossCandidates,
    noise: NoiseModel,
    *,
    section: str = "auto",
    plane: bool = False,
    arm_px: float = 30.0,
    aperture_px: float = 1.0,
    threads: int | None = None,
) -> Positions:
    """Measure crosses by a template of both lines.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols), uint8, uint16 or float32
    candidates : CrossCandidates
    noise : NoiseModel
    section : {"auto", "gaussian", "bar"}
        Of both lines; "auto" takes bars where one of the lines, fitted alone, is one.
    plane : bool
        Whether the background may slope.
    arm_px : float
        How much of each line is used to either side of the crossing.
    aperture_px : float
        Side of the light-sensitive square in a pixel.
    threads : int, optional

    Returns
    -------
    Positions
        Of the intersections. ``more``: angle1_deg, angle2_deg, sigma1_px, sigma2_px, width1_px, width2_px, amplitude1_dn, amplitude2_dn,
        amplitude_dn (of the first), background_dn, overlap_dn (what the overlap adds to the sum of both: 0 if their light adds, minus the
        lesser height for a union; fitted), var_angle1_deg2, var_angle2_deg2, chi2_per_dof, dof.

    Raises
    ------
    InputError
        If an argument cannot be used.

    Notes
    -----
    Whatever the overlap looks like, it is symmetric about the intersection, as its model is: it cannot pull the position.
    """
    if section not in ("auto", "gaussian", "bar") or not arm_px > 3:
        raise InputError("cannot measure crosses in this way", value=(section, arm_px), allowed="auto, gaussian, bar; above 3 px")
    n = len(candidates)
    fit = fit_template(frame, candidates.lines, noise, "line", section, (False, False, "auto"), aperture_px, threads)
    pairs = np.stack([candidates.first, candidates.second], axis=1).astype(np.int64).reshape(-1, 2)
    crossing, angles = _start_places(fit, pairs)
    sections = np.where((fit.fits.told[pairs, 4] == BAR).any(axis=1), BAR, GAUSSIAN)
    start = _start_values(fit, pairs, sections)
    blur = np.hypot(start[:, kernels.SIGMA_1 : kernels.SIGMA_2 + 1], PIXEL)
    half_width = 0.5 * start[:, kernels.WIDTH_1 : kernels.WIDTH_2 + 1] * (sections == BAR)[:, None]
    reach, cores = half_width + 5.0 * blur + 1.0, half_width + 3.5 * blur + 0.3
    arms = _arms(fit, pairs, crossing, angles, arm_px)
    begin, near = _near(fit, crossing, arm_px + reach.max(initial=0.0))
    lines = whole.Lines(fit.lines.places, fit.lines.cores, begin, near)
    usable = np.isfinite(start).all(axis=1)
    start[~usable] = np.where(np.isfinite(start[~usable]), start[~usable], 1.0)
    crosses = kernels.Crosses(crossing, angles, arms, reach, cores, pairs, lines, sections, start)
    found, covariances, told = np.empty((n, 14)), np.empty((n, 14, 14)), np.empty((n, 4))
    fits, numbers = kernels.Fits(found, covariances, told), noise.numbers(frame.dtype)

    def part(first: int) -> None:
        kernels.fit_crosses(frame, (first, min(first + CHUNK, n)), bool(plane), float(aperture_px), numbers, crosses, fits)

    map_tiles(part, range(0, n, CHUNK), threads)
    found[~usable] = np.nan
    return _cross_record(candidates, crossing, angles, found, covariances, told, sections)


def _start_places(fit: Fit, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intersections of the fitted lines, curved ones by two steps, and their directions there."""
    p, places = np.nan_to_num(fit.fits.values), fit.lines.places
    angle = places[:, 2] + p[:, whole.ANGLE]
    x, y = places[:, 0] - np.sin(angle) * p[:, whole.OFFSET], places[:, 1] + np.cos(angle) * p[:, whole.OFFSET]
    a, b = pairs.T
    t1, t2 = np.zeros(len(pairs)), np.zeros(len(pairs))
    for _ in range(3):
        ends = []
        for line, t in ((a, t1), (b, t2)):
            bend, here = p[line, whole.CURVE], angle[line]
            c, s, sag = np.cos(here), np.sin(here), 0.5 * bend * t * t
            ends.append((x[line] + c * t - s * sag, y[line] + s * t + c * sag, here + bend * t))
        (x1, y1, d1), (x2, y2, d2) = ends
        turn = np.sin(d2 - d1)
        t1 = t1 + ((x2 - x1) * np.sin(d2) - (y2 - y1) * np.cos(d2)) / turn
        t2 = t2 + ((x2 - x1) * np.sin(d1) - (y2 - y1) * np.cos(d1)) / turn
    return np.stack([x1, y1], axis=1), np.stack([d1, d2], axis=1)


def _start_values(fit: Fit, pairs: np.ndarray, sections: np.ndarray) -> np.ndarray:
    p = fit.fits.values[pairs]  # (n, 2, …)
    start = np.zeros((len(pairs), kernels.UNKNOWNS))
    start[:, kernels.BACKGROUND] = p[:, :, whole.BACKGROUND].mean(axis=1)
    start[:, [kernels.HEIGHT_1, kernels.HEIGHT_2]] = p[:, :, whole.AMPLITUDE]
    start[:, [kernels.SIGMA_1, kernels.SIGMA_2]] = p[:, :, whole.SIGMA]
    thin = (fit.fits.told[pairs, 4] != BAR) & (sections == BAR)[:, None]
    width = np.where(thin, 1.5 * p[:, :, whole.SIGMA], p[:, :, whole.WIDTH])
    start[:, [kernels.WIDTH_1, kernels.WIDTH_2]] = width
    start[:, [kernels.HEIGHT_1, kernels.HEIGHT_2]] *= np.where(thin, 1.9, 1.0)
    start[:, [kernels.SIGMA_1, kernels.SIGMA_2]] *= np.where(thin, 0.9, 1.0)
    lesser = np.abs(start[:, [kernels.HEIGHT_1, kernels.HEIGHT_2]]).min(axis=1)
    start[:, kernels.OVERLAP] = -0.5 * lesser * np.sign(start[:, kernels.HEIGHT_1])
    return start


def _arms(fit: Fit, pairs: np.ndarray, crossing: np.ndarray, angles: np.ndarray, arm_px: float) -> np.ndarray:
    """Least and greatest place along the first and along the second line, from the crossing, shape (n, 4)."""
    out = []
    for side in range(2):
        place = fit.lines.places[pairs[:, side]]
        c, s = np.cos(place[:, 2]), np.sin(place[:, 2])
        at = c * (crossing[:, 0] - place[:, 0]) + s * (crossing[:, 1] - place[:, 1])
        out += [np.maximum(place[:, 3] - at, -arm_px), np.minimum(place[:, 4] - at, arm_px)]
    return np.stack(out, axis=1)


def _near(fit: Fit, crossing: np.ndarray, reach_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Which lines come within reach of each crossing."""
    place = fit.lines.places
    c, s = np.cos(place[:, 2]), np.sin(place[:, 2])
    begin, found = np.zeros(len(crossing) + 1, np.int64), []
    for i, (x, y) in enumerate(crossing):
        u, v = x - place[:, 0], y - place[:, 1]
        t = np.clip(c * u + s * v, place[:, 3], place[:, 4])
        sag = 0.5 * np.abs(place[:, 5]) * t * t
        near = np.flatnonzero(np.hypot(u - c * t, v - s * t) < 1.5 * reach_px + fit.lines.cores + sag)
        found.append(near)
        begin[i + 1] = begin[i] + len(near)
    return begin, np.concatenate(found).astype(np.int64) if found else np.zeros(0, np.int64)


def _cross_record(
    candidates: CrossCandidates,
    crossing: np.ndarray,
    angles: np.ndarray,
    p: np.ndarray,
    cov: np.ndarray,
    told: np.ndarray,
    sections: np.ndarray,
) -> Positions:
    known = np.isfinite(p[:, 0])
    chi2, pixels, unknowns, met = told.T
    dof = np.maximum(np.where(known, pixels - unknowns, np.nan), 1.0)
    more: dict[str, np.ndarray] = {}
    for side in range(2):
        degrees = (angles[:, side] + p[:, kernels.ANGLE_1 + side]) / DEG
        more[f"angle{side + 1}_deg"] = 90.0 - (90.0 - degrees) % 180.0
        more[f"var_angle{side + 1}_deg2"] = cov[:, kernels.ANGLE_1 + side, kernels.ANGLE_1 + side] / DEG**2
        more[f"sigma{side + 1}_px"] = p[:, kernels.SIGMA_1 + side]
        more[f"width{side + 1}_px"] = np.where(sections == BAR, p[:, kernels.WIDTH_1 + side], 0.0 * p[:, 0])
        more[f"amplitude{side + 1}_dn"] = p[:, kernels.HEIGHT_1 + side]
    more |= {"amplitude_dn": p[:, kernels.HEIGHT_1], "background_dn": p[:, kernels.BACKGROUND], "overlap_dn": p[:, kernels.OVERLAP]}
    more |= {"chi2_per_dof": chi2 / dof, "dof": dof}
    met = np.nan_to_num(met).astype(np.int64)
    blur = p[:, [kernels.SIGMA_1, kernels.SIGMA_2]].min(axis=1)
    with np.errstate(invalid="ignore"):
        said = {
            Flag.BORDER: met & whole.BORDERS,
            Flag.SATURATED: met & whole.HIGH,
            Flag.CLIPPED_AT_BLACK: met & whole.LOW,
            Flag.OVERLAPPING: met & whole.SHARED,
            Flag.NOT_CONVERGED: (met & (whole.RESTLESS | whole.SINGULAR)) | ~known,
            Flag.UNDER_SAMPLED: blur < LEAST_BLUR_PX,
            Flag.POOR_FIT: more["chi2_per_dof"] - 1.0 - 5.0 * np.sqrt(2.0 / dof) > 0.1,
            Flag.FAINT: np.maximum(cov[:, 0, 0], cov[:, 1, 1]) > (0.15 * np.hypot(blur, PIXEL)) ** 2,
        }
    flags = np.zeros(len(candidates), np.uint32)
    for flag, mask in said.items():
        flags |= np.where(np.asarray(mask, bool), np.uint32(flag), np.uint32(0))
    x, y = crossing[:, 0] + p[:, kernels.X], crossing[:, 1] + p[:, kernels.Y]
    return Positions(x, y, cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1], flags, more)
