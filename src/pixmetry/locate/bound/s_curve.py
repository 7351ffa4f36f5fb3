"""S-curve of an estimator: its error against the place of the target within a pixel, for a given target, camera and threshold."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.detect.targets import Targets
from pixmetry.locate.estimator import Estimator, Settings
from pixmetry.locate.estimators import methods
from pixmetry.locate.noise import NoiseModel

Profile = Callable[[np.ndarray, np.ndarray], np.ndarray]
Locator = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
POINTS = 8  # of the quadrature over a pixel's aperture, along each axis


@dataclass(frozen=True)
class SCurve:
    """Error of an estimator over a lattice of sub-pixel phases.

    Parameters
    ----------
    phase_x_px, phase_y_px : ndarray, shape (p,) and (q,)
        Place of the target from the centre of a pixel.
    error_x_px, error_y_px : ndarray, shape (q, p)
        Estimate minus truth.
    """

    phase_x_px: np.ndarray
    phase_y_px: np.ndarray
    error_x_px: np.ndarray
    error_y_px: np.ndarray

    @property
    def rms_px(self) -> tuple[float, float]:
        """Root mean square of the errors along x and y."""
        return float(np.sqrt(np.mean(self.error_x_px**2))), float(np.sqrt(np.mean(self.error_y_px**2)))

    @property
    def half_range_px(self) -> tuple[float, float]:
        """Half of the greatest minus the least error, along x and y."""
        return float(np.ptp(self.error_x_px)) / 2, float(np.ptp(self.error_y_px)) / 2

    def sine_px(self, order: int) -> float:
        """Coefficient of sin(2π·order·x) in the error along x, mean over the phases along y; the phases must fill one pixel evenly."""
        wave = np.sin(2 * np.pi * order * self.phase_x_px)
        return float(2 * np.mean(self.error_x_px.mean(axis=0) * wave))


def even_phases(count: int) -> np.ndarray:
    """Evenly spaced phases over one pixel, −½ … ½, symmetric about 0; shape (count,), px."""
    return (np.arange(count) + 0.5) / count - 0.5


def s_curve(
    estimator: str | Estimator | Locator,
    kind: str | Profile = "disc",
    parameters: Mapping[str, float] | None = None,
    *,
    phases_x: np.ndarray | int = 32,
    phases_y: np.ndarray | int = 8,
    aperture_px: float = 1.0,
    window_px: int = 25,
    offset_dn: float = 0.0,
    noise_dn: float = 0.0,
    rounded: bool = False,
    low_dn: float = -np.inf,
    high_dn: float = np.inf,
) -> SCurve:
    """Compute the error of an estimator at every phase, on noise-free images of one target.

    Parameters
    ----------
    estimator : str, Estimator or callable
        A name of `estimators.methods`; an `Estimator` that is resolved; or a function that takes
        windows of shape (n, rows, cols) and returns x and y, shape (n,), from the centre of a window's first pixel.
    kind : str or callable
        ``disc``, ``ellipse``, ``ring`` or ``spot`` as `template.model` draws them; or a function of dx, dy (px, from the target's centre)
        that returns the light in DN before the pixel averages it. One that does not depend on dy is a line.
    parameters : mapping, optional
        Of the kind, without the place: radius_px, blur_px, amplitude_dn, background_dn, …
    phases_x, phases_y : ndarray or int
        Phases in px, or how many, evenly over a pixel.
    aperture_px : float
        Side of a pixel's square aperture; 0 samples at its centre.
    window_px : int
        Side of the image, odd.
    offset_dn : float
        Added to the image before it is cut off at the ends of the scale: a black level below zero clips the target's foot.
    noise_dn : float
        Standard deviation of the camera's noise: what a named estimator chooses its threshold by. The images have none.
    rounded : bool
        Whether grey values are whole numbers.
    low_dn, high_dn : float
        Ends of the scale.

    Returns
    -------
    SCurve

    Raises
    ------
    InputError
        If the window has no central pixel, or kind or parameters cannot be used.
    """
    if window_px != int(window_px) or window_px < 3 or window_px % 2 == 0:
        raise InputError("the window has no central pixel", value=window_px, allowed="an odd number of pixels from 3 on")
    px, py = (even_phases(p) if isinstance(p, int) else np.asarray(p, float) for p in (phases_x, phases_y))
    middle = window_px // 2
    x, y = middle + np.tile(px, len(py)), middle + np.repeat(py, len(px))
    images = np.stack([_draw(kind, parameters, a, b, window_px, aperture_px) for a, b in zip(x, y, strict=True)]) + offset_dn
    if rounded:
        images = np.rint(images)
    images = np.clip(images, low_dn, high_dn)
    if isinstance(estimator, str):
        found = _by_name(estimator, images, x, y, max(noise_dn, 1e-3), rounded, low_dn, high_dn)
    else:
        found = estimator(images) if callable(estimator) else estimator.locate(images)
    shape = (len(py), len(px))
    return SCurve(px, py, (np.asarray(found[0]) - x).reshape(shape), (np.asarray(found[1]) - y).reshape(shape))


def _draw(kind: str | Profile, parameters: Mapping[str, float] | None, x: float, y: float, side: int, aperture: float) -> np.ndarray:
    if callable(kind):
        nodes, weights = np.polynomial.legendre.leggauss(POINTS) if aperture else (np.zeros(1), np.full(1, 2.0))
        at = (np.arange(side)[:, None] + 0.5 * aperture * nodes).ravel()
        fine = np.broadcast_to(kind(at[None, :] - x, at[:, None] - y), (len(at), len(at)))
        cells = fine.reshape(side, len(nodes), side, len(nodes))
        light: np.ndarray = np.einsum("risj,i,j->rs", cells, weights / 2, weights / 2)
        return light
    from pixmetry.locate.template.template import PARAMETERS, model

    given = dict(parameters or {}) | {"x_px": x, "y_px": y}
    names = PARAMETERS.get(kind, ())
    if names and set(given) != set(names):
        raise InputError(f"parameters that are not those of a {kind}", value=sorted(given), allowed=", ".join(names))
    return model(kind, np.array([given[n] for n in names]), side, side, aperture_px=aperture)[0]


def _by_name(
    name: str, images: np.ndarray, x: np.ndarray, y: np.ndarray, noise_dn: float, rounded: bool, low_dn: float, high_dn: float
) -> tuple[np.ndarray, np.ndarray]:
    """Locate by a named estimator: size, blur and background are taken from the images, as a detection would, and the place is known."""
    if name not in methods():
        raise InputError("no such estimator", value=name, allowed=", ".join(methods()))
    shape = _shape_of(images[len(images) // 2])
    noise = NoiseModel(noise_dn**2 + rounded / 12, low_dn=low_dn, high_dn=high_dn)
    found_x, found_y = np.empty(len(x)), np.empty(len(x))
    for i, image in enumerate(images):
        one = replace(shape, x_px=x[i : i + 1], y_px=y[i : i + 1], sigma_dn=np.full(1, noise_dn))
        rim = 16  # so that neither window nor background is cut off
        wide = np.pad(image, rim, mode="edge").astype(np.float32)
        box = {n: getattr(one, n) + rim for n in ("x_px", "y_px", "row_first", "row_stop", "col_first", "col_stop")}
        at = methods()[name].positions(wide, replace(one, **box), noise, Settings(planes=False, threads=1))
        found_x[i], found_y[i] = at.x_px[0] - rim, at.y_px[0] - rim
    return found_x, found_y


def _shape_of(image: np.ndarray) -> Targets:
    """Size, blur and contrast of the one target in an image."""
    rim = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    background = float(np.median(rim))
    value = image - background
    sign = 1.0 if value.max() >= -value.min() else -1.0
    value = sign * value
    peak = float(value.max())
    above = np.clip(value / peak, 0.0, 1.0)
    inside = above > 0.5
    rows, cols = np.nonzero(inside)
    cover = np.clip((above - 0.5) * 2 + 0.5, 0.0, 1.0) * (above > 0.25)  # pixels of the edge count in part
    yy, xx = np.indices(image.shape)
    area = cover.sum()
    mx, my = (cover * xx).sum() / area, (cover * yy).sum() / area
    cov = np.array([[(cover * (xx - mx) ** 2).sum(), (cover * (xx - mx) * (yy - my)).sum()], [0.0, (cover * (yy - my) ** 2).sum()]]) / area
    values, vectors = np.linalg.eigh(cov, UPLO="U")
    ratio = np.sqrt(np.sqrt(values[1] / values[0]))
    radius = np.sqrt(area / np.pi)
    gy, gx = np.gradient(value)
    steepest = float(np.hypot(gx, gy).max())
    blur = peak / (np.sqrt(2 * np.pi) * steepest)
    one = np.ones(1)
    return Targets(
        x_px=one * mx, y_px=one * my, semi_major_px=one * radius * ratio, semi_minor_px=one * radius / ratio,
        angle_deg=one * np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])), blur_px=one * blur, amplitude_dn=one * peak * sign,
        background_dn=one * background, background_x_dn_per_px=0 * one, background_y_dn_per_px=0 * one, sigma_dn=one,
        row_first=np.array([rows.min()]), row_stop=np.array([rows.max() + 1]), col_first=np.array([cols.min()]),
        col_stop=np.array([cols.max() + 1]), flags=np.zeros(1, np.uint32),
    )  # fmt: skip
