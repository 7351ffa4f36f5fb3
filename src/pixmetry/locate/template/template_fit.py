"""From targets to fitted templates: start values, windows, and the fits in pieces on several threads."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from pixmetry.core.threads import map_tiles
from pixmetry.locate.detect.targets import Targets
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template import _template_kernels as kernels
from pixmetry.locate.template._template_kernels import LEAST_ELECTRONS, MOST_ELECTRONS, PER_E

KINDS = ("disc", "ellipse", "ring", "spot")  # in the order of the kernels' codes
REACH = 3.5  # standard deviations of the edge, the pixel included, up to which pixels around a target are used
NEAR = 3.2  # the same within which a pixel is a neighbour's
POINT_PX = 1e-3  # radius of a spot's outline
SMALL_PX, SHARP_PX, FAR_TOO_LARGE = 2.5, 0.3, 2.0  # size, blur and χ² per degree of freedom of a second start
BROAD = 0.5  # of its size: rough blur from which a target counts as small
BLUR = -7  # place of the blur among the parameters
SUSPECT_SIGMA = 3.0  # by which χ² must exceed the usual for pixels to be looked at one by one
LONE_SIGMA = 5.0  # residual of a pixel that stands out, in standard deviations
MOST_LOST = 1.7  # times the variance that a target may have without them
CHUNK = 64  # targets in one piece of work, at most
GAUSSIAN_FROM_E = 3.0  # read noise in electrons from which a reading is taken as normal with the variance of its mean


@dataclass(frozen=True)
class Windows:
    """Targets with what their fits start from.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
    noise : NoiseModel
    code : int
        Of the kind.
    aperture_px : float
    surface : bool
    efficiency : ndarray
        Of the likelihood of few electrons; empty where it is not used.
    start : ndarray, shape (n, parameters)
        Start values, the planes included.
    about : kernels.About
        Where the windows are.
    """

    frame: np.ndarray
    noise: NoiseModel
    code: int
    aperture_px: float
    surface: bool
    efficiency: np.ndarray
    start: np.ndarray
    about: kernels.About

    @classmethod
    def of(
        cls, frame: np.ndarray, targets: Targets, noise: NoiseModel, kind: str, aperture_px: float, surface: bool, exact: bool
    ) -> Windows:
        """Windows and start values of targets; ``exact``: the likelihood of few electrons."""
        from pixmetry.locate.detect.detection import neighbours

        start, outer, edge = start_values(targets, kind, aperture_px)
        reach = np.stack([REACH * edge + 1.0, NEAR * edge + 0.5], axis=1)
        half = np.ceil(outer + reach[:, 0]).astype(np.int64)
        near = neighbours(targets, 2 * reach[:, 0] + 2, reach[:, 1] + 1)
        noise = scale_ends(noise, frame)
        efficiency = np.empty(0)
        if exact and noise.slope_dn > 0 and noise.pattern_rel == 0:
            from pixmetry.locate.template.template_fit import efficiency as of_sigma

            efficiency = of_sigma(math.sqrt(noise.constant_dn2) / noise.slope_dn)
        about = kernels.About(start, half, outer, _inverse(start, outer, kind), reach, *near)
        return cls(frame, noise, KINDS.index(kind), float(aperture_px), surface, efficiency, start, about)

    @property
    def model(self) -> kernels.Model:
        """Template and likelihood as the kernels want them."""
        return kernels.Model(self.code, self.aperture_px, self.surface, self.noise.numbers(), self.efficiency)


@dataclass(frozen=True)
class Fitted:
    """Results of fits, arrays of shape (n, …); NaN where there is none."""

    parameters: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    chi2_per_dof: np.ndarray
    dof: np.ndarray
    falls: np.ndarray
    steps: np.ndarray
    at_rest: np.ndarray
    cut: np.ndarray
    at_top: np.ndarray
    at_bottom: np.ndarray
    noise_var_px2: np.ndarray  # the larger one of x and y, without the shifts of rows

    def put(self, which: np.ndarray, part: Fitted) -> Fitted:
        """These, with some of them replaced by those of another fit."""
        changed = {}
        for f in fields(self):
            changed[f.name] = getattr(self, f.name).copy()
            changed[f.name][which] = getattr(part, f.name)[which]
        return replace(self, **changed)


def scale_ends(noise: NoiseModel, frame: np.ndarray) -> NoiseModel:
    """The noise model with the ends of the scale that an integer type has."""
    if frame.dtype.kind != "u":
        return noise
    return replace(noise, low_dn=max(noise.low_dn, 0.0), high_dn=min(noise.high_dn, float(np.iinfo(frame.dtype).max)))


def start_values(targets: Targets, kind: str, aperture_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start values (n, parameters), longest half axes, and standard deviations of the edges with the pixel in them."""
    edge = np.clip(np.nan_to_num(targets.blur_px, nan=0.7), 0.3, None)
    blur = np.sqrt(np.maximum(edge**2 - aperture_px**2 / 12, 0.2**2))
    major, minor = np.maximum(targets.semi_major_px, 0.5), np.maximum(targets.semi_minor_px, 0.5)
    amplitude, background = np.asarray(targets.amplitude_dn, float), np.asarray(targets.background_dn, float)
    shape: list[np.ndarray] = []
    outer = major
    if kind == "spot":  # it is at half height at 1.177 standard deviations
        edge = np.maximum(np.sqrt(major * minor) / math.sqrt(2 * math.log(2)), 0.4)
        blur = np.sqrt(np.maximum(edge**2 - aperture_px**2 / 12, 0.3**2))
        amplitude, outer = amplitude * (edge / blur) ** 2, np.zeros(len(targets))
    elif kind == "disc":
        outer = np.sqrt(major * minor)
        shape = [outer]
    elif kind == "ellipse":
        c, s = np.cos(np.deg2rad(targets.angle_deg)), np.sin(np.deg2rad(targets.angle_deg))
        shape = [major * c**2 + minor * s**2, major * s**2 + minor * c**2, (major - minor) * c * s]
    else:
        outer = np.maximum((targets.row_stop - targets.row_first + targets.col_stop - targets.col_first) / 4.0, 1.0)
        area = getattr(targets, "area_px", math.pi * major * minor)
        shape = [outer, np.sqrt(np.maximum(outer**2 - area / math.pi, (0.2 * outer) ** 2))]
    rest = np.zeros((4, len(targets)))
    return np.stack([targets.x_px, targets.y_px, *shape, blur, amplitude, background, *rest], axis=1), outer, edge


def _inverse(start: np.ndarray, outer: np.ndarray, kind: str) -> np.ndarray:
    """Inverse of the matrices of the outlines, xx, yy and xy: of ellipses that of their shape, of all others a circle's."""
    if kind != "ellipse":
        across = 1.0 / np.maximum(outer, POINT_PX)
        return np.stack([across, across, np.zeros(len(start))], axis=1)
    xx, yy, xy = start[:, 2:5].T
    det = xx * yy - xy * xy
    return np.stack([yy / det, xx / det, -xy / det], axis=1)


def run_fit(
    w: Windows, which: np.ndarray, start: np.ndarray, background_plane: bool, light_plane: bool, test: bool, threads: int | None
) -> Fitted:
    """Fit some of the targets, in pieces; the others' results are undefined.

    Parameters
    ----------
    w : Windows
    background_plane, light_plane : bool
        Whether they are among the unknowns.
    test : bool
        Whether to find out what the planes, which are then not among the unknowns, would bring.
    threads : int, optional
    """
    n, count = start.shape
    free = np.ones(count, bool)
    free[-4:-2], free[-2:] = background_plane, light_plane
    parameters, variance, covariance = np.full((n, count), np.nan), np.full((n, count), np.nan), np.full((n, 3), np.nan)
    quality = np.full((n, 10), np.nan)
    fits, model, about = kernels.Fits(parameters, variance, covariance, quality), w.model, w.about
    chunk = min(CHUNK, max(8, len(which) // 8))

    def piece(first: int) -> None:
        part = which[first : first + chunk]
        side = 2 * about.half[part] + 1
        place = np.concatenate([[0], np.cumsum(side * ((side + 7) // 8 * 8))])
        packed = kernels.Packed(place, np.empty(place[-1], np.float32), np.empty(place[-1], np.float32))
        kernels.cut_out(w.frame, about, model.noise, part, packed, quality)
        kernels.fit(model, start, start is w.start, free, test, about, part, packed, fits)

    map_tiles(piece, range(0, len(which), chunk), threads)
    dof = quality[:, 1] - free.sum()
    reduced, steps = quality[:, 0] / np.maximum(dof, 1), quality[:, 5]
    cut, (top, bottom, alone) = quality[:, 6] > 0, quality[:, 7:].T
    return Fitted(parameters, variance, covariance, reduced, dof, quality[:, 2:5], np.abs(steps), steps > 0, cut, top, bottom, alone)


def with_second_start(
    windows: Windows, targets: Targets, which: np.ndarray, result: Fitted, options: tuple[bool, bool, bool], threads: int | None
) -> Fitted:
    """Fit small targets whose residuals are far too large once more, from a sharp edge, and keep the better fit.

    A disc of a pixel's size, or one that was taken to be as broad as its blur, can pass for a far smaller and higher one with more blur;
    between the two lies a ridge of χ².
    """
    if KINDS[windows.code] not in ("disc", "ellipse"):
        return result
    small = np.sqrt(targets.semi_major_px * targets.semi_minor_px) < np.maximum(SMALL_PX, np.nan_to_num(targets.blur_px) / BROAD)
    again = which[(small & ~(result.at_rest & (result.chi2_per_dof < FAR_TOO_LARGE)))[which]]
    if not len(again):
        return result
    start = windows.start.copy()
    start[again, BLUR] = SHARP_PX
    other = run_fit(windows, again, start, *options, threads)
    better = again[other.at_rest[again] & ~(result.at_rest[again] & (result.chi2_per_dof[again] <= other.chi2_per_dof[again]))]
    return result.put(better, other) if len(better) else result


def without_outliers(
    w: Windows, result: Fitted, on_ground: np.ndarray, on_light: np.ndarray, threads: int | None
) -> tuple[Fitted, np.ndarray]:
    """Fit targets again without pixels that stand out alone: hot and dead ones, hits of particles; and say which targets, shape (n,).

    Only targets whose χ² chance brings once in a thousand are looked at. A fit is believed if χ² is then as usual, and the pixels were
    not those that the place is known from.
    """
    usual = result.chi2_per_dof[result.at_rest]
    scale = max(1.0, float(np.median(usual))) if len(usual) else 1.0
    spread = np.sqrt(2 / np.maximum(result.dof, 1))
    high = np.flatnonzero(result.at_rest & (result.chi2_per_dof > scale * (1 + SUSPECT_SIGMA * spread)))
    none = np.zeros(len(on_ground), bool)
    if not len(high):
        return result, none

    def piece(part: np.ndarray) -> np.ndarray:
        return kernels.lone_outliers(w.frame, w.model, result.parameters, part, w.about, LONE_SIGMA * math.sqrt(scale))

    pieces = np.array_split(high, max(1, len(high) // CHUNK))
    lone = np.concatenate(map_tiles(piece, pieces, threads))
    if not len(lone):
        return result, none
    frame = w.frame.astype(np.float32)
    frame[lone[:, 1], lone[:, 2]] = np.nan
    without, hit = replace(w, frame=frame), np.unique(lone[:, 0])
    for ground in (False, True):
        for light in (False, True):
            again = hit[(on_ground[hit] == ground) & (on_light[hit] == light)]
            if not len(again):
                continue
            other = run_fit(without, again, result.parameters, ground, light, False, threads)
            better = (
                other.at_rest[again]
                & (other.chi2_per_dof[again] < scale * (1 + 2 * SUSPECT_SIGMA * spread[again]))
                & (other.noise_var_px2[again] < MOST_LOST * result.noise_var_px2[again])
            )
            result = result.put(again[better], other)
            none[again[better]] = True
    return result, none


@lru_cache(maxsize=8)
def efficiency(sigma_e: float) -> np.ndarray:
    """Return Fisher's information of a reading about its mean, times its variance.

    A reading is d = n + e with n Poisson of mean µ and e normal of standard deviation ``sigma_e``, in electrons. Its information is
    I(µ) = E[(E[n | d]/µ − 1)²], and I · (µ + σ²) → 1 for many electrons or much noise, where the likelihood of a Poisson number shifted by
    σ² does as well.

    Parameters
    ----------
    sigma_e : float
        Above 0.

    Returns
    -------
    ndarray, float64
        At µ = `LEAST_ELECTRONS` exp(k / `PER_E`), k = 0, 1, …, up to `MOST_ELECTRONS`; empty where the read noise is so large that nothing
        is gained.

    References
    ----------
    D. L. Snyder, C. W. Helstrom, A. D. Lanterman, M. Faisal, R. L. White, J. Opt. Soc. Am. A 12(2), 272 (1995), for the likelihood of
    Poisson numbers with normal read noise. F. Huang et al., Nature Methods 10, 653 (2013), for the shifted Poisson number.
    """
    if sigma_e > GAUSSIAN_FROM_E:
        return np.empty(0)
    sigma = max(sigma_e, 0.05)
    mean = LEAST_ELECTRONS * np.exp(np.arange(int(np.log(MOST_ELECTRONS / LEAST_ELECTRONS) * PER_E) + 2) / PER_E)
    n = np.arange(int(MOST_ELECTRONS + 10 * np.sqrt(MOST_ELECTRONS)))
    factorials = np.concatenate([[0.0], np.cumsum(np.log(n[1:]))])
    poisson = np.exp(n * np.log(mean)[:, None] - mean[:, None] - factorials)
    step = sigma / 5
    d = np.arange(-7 * sigma, n[-1] + 7 * sigma, step)
    read = np.exp(-0.5 * ((d - n[:, None]) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
    density = poisson @ read
    along = (poisson * n) @ read
    information = (np.where(density > 1e-290, along**2 / np.maximum(density, 1e-290), 0.0).sum(axis=1) * step) / mean**2 - 1
    efficiency: np.ndarray = information * (mean + sigma**2)
    return efficiency
