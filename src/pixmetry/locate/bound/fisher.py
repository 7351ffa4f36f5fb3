"""The Cramér–Rao bound: how well a target can be located at all.

No unbiased estimator of the parameters θ has a smaller covariance than the inverse of the Fisher matrix F_jk = Σ_i I_i ∂_jµ_i ∂_kµ_i over
the pixels, I_i being what a grey value tells of its mean µ_i (`information`).

References
----------
S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), 3.7, 3.9. K. A. Winick, J. Opt. Soc. Am. A 3, 1809
(1986), for targets on pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.bound.information import (
    ROUNDING_DN2,
    exact_codes_matter,
    information_per_dn2,
    kept_rounding_dn2,
    unrounded_variance_dn2,
)
from pixmetry.locate.bound.predictions import PixelNoise
from pixmetry.locate.noise import NoiseModel
from pixmetry.locate.template.template_images import Images, draw_images


@dataclass(frozen=True)
class Bound:
    """The bound for one set of unknowns, at p phases within the pixel.

    Parameters
    ----------
    unknowns : tuple of str
    phases_px : ndarray, shape (p, 2)
        Place of the target within the pixel.
    fisher, covariance : ndarray, shape (p, k, k)
        In the order of the unknowns; infinite where the image does not tell.
    exact_codes : bool
        Whether some pixels have so little noise that the information of the single codes was taken instead of 1/12 DN² for rounding.
    """

    unknowns: tuple[str, ...]
    phases_px: np.ndarray
    fisher: np.ndarray
    covariance: np.ndarray
    exact_codes: bool

    def u(self, name: str) -> tuple[float, float, float]:
        """Least, mean (root of the mean variance) and greatest standard deviation of a parameter over the phases.

        Raises
        ------
        InputError
            If it is not among the unknowns.
        """
        if name not in self.unknowns:
            raise InputError("not among the unknowns", value=name, allowed=", ".join(self.unknowns))
        variance = self.covariance[:, self.unknowns.index(name), self.unknowns.index(name)]
        return float(np.sqrt(variance.min())), float(np.sqrt(variance.mean())), float(np.sqrt(variance.max()))

    @property
    def place_px(self) -> tuple[float, float, float]:
        """The same of one coordinate: x and y together as the root of their mean variance, or the offset of a line."""
        k = [self.unknowns.index(n) for n in ("x_px", "y_px", "offset_px") if n in self.unknowns]
        variance = self.covariance[:, k, k].mean(axis=1)
        return float(np.sqrt(variance.min())), float(np.sqrt(variance.mean())), float(np.sqrt(variance.max()))


def bound(
    kind: str,
    parameters: Mapping[str, float],
    noise: NoiseModel,
    unknowns: str | tuple[str, ...] | list[str] = "shape",
    *,
    aperture_px: float = 1.0,
    light_on: str = "surface",
    window_px: int | None = None,
    phases: int = 5,
    rounded: bool = True,
    pattern_dn: float = 0.0,
    frames: int = 1,
) -> Bound:
    """Cramér–Rao bound of a target.

    Parameters
    ----------
    kind : {"disc", "ellipse", "ring", "spot", "line", "edge"}
    parameters : mapping of str to float
        As for `pixmetry.locate.template.template_images.draw_images`.
    noise : NoiseModel
        Rounding included if values are rounded.
    unknowns : str or sequence of str
        Names of parameters, or a set: ``position`` (x, y or the offset), ``light`` (amplitude and background too), ``shape`` (outline,
        angle and blur too), ``planes`` (the slopes of background and light too).
    aperture_px, light_on, window_px, phases
        As for `draw_images`.
    rounded : bool
        Whether grey values are whole numbers.
    pattern_dn : float
        Standard deviation of fixed offsets from pixel to pixel, which averaging does not remove; not in the noise model.
    frames : int
        Frames that are averaged.

    Raises
    ------
    InputError
        If a value cannot be used.
    """
    images = draw_images(kind, parameters, aperture_px=aperture_px, light_on=light_on, window_px=window_px, phases=phases)
    return bound_of(images, pixel_noise(images, noise, rounded, pattern_dn, frames), images.subset(unknowns), noise, rounded)


def pixel_noise(images: Images, noise: NoiseModel, rounded: bool = True, pattern_dn: float = 0.0, frames: int = 1) -> PixelNoise:
    """Split the noise of the images' pixels by cause.

    Raises
    ------
    InputError
        If a number cannot be used, or there is next to no noise.
    """
    if frames < 1 or frames != int(frames):
        raise InputError("the number of frames cannot be used", where="frames", value=frames, allowed="1 or more")
    if not (np.isfinite(pattern_dn) and pattern_dn >= 0):
        raise InputError("the fixed pattern cannot be used", where="pattern_dn", value=pattern_dn, allowed="0 or more")
    level = images.mean
    seen = np.clip(level, noise.low_dn, noise.high_dn)
    light = np.maximum(seen - noise.black_dn, 0.0)
    temporal = NoiseModel(noise.constant_dn2, noise.slope_dn, 0.0, noise.black_dn, noise.low_dn, noise.high_dn)
    unrounded = unrounded_variance_dn2(level, temporal, rounded)
    tells = information_per_dn2(level, temporal, rounded)
    with np.errstate(divide="ignore"):
        ideal = np.maximum(1 / tells - unrounded, 0.0)
    shot = noise.slope_dn * np.maximum(level - noise.black_dn, 0.0)
    kept = kept_rounding_dn2(np.sqrt(unrounded)) if rounded else np.zeros_like(level)
    anew = (ROUNDING_DN2 if rounded else 0.0) - kept
    pattern = (noise.pattern_rel * light) ** 2 + pattern_dn**2
    return PixelNoise(unrounded - shot, shot, anew, kept, pattern, seen, ideal, int(frames))


def bound_of(images: Images, pixels: PixelNoise, unknowns: tuple[str, ...], noise: NoiseModel, rounded: bool) -> Bound:
    """The bound from images that are drawn, and the noise of their pixels."""
    jacobian = images.columns(unknowns)
    fisher = (jacobian / pixels.for_the_best().total[:, None]) @ jacobian.swapaxes(1, 2)
    exact = exact_codes_matter(images.mean, NoiseModel(noise.constant_dn2, noise.slope_dn, 0.0, noise.black_dn), rounded)
    return Bound(unknowns, images.phases_px, fisher, _inverse(fisher), exact)


def _inverse(fisher: np.ndarray) -> np.ndarray:
    """Inverse of each matrix, scaled to a diagonal of 1 before; infinite if it is singular to rounding."""
    diagonal = np.sqrt(np.einsum("pkk->pk", fisher))
    out = np.full_like(fisher, np.inf)
    for i, (matrix, scale) in enumerate(zip(fisher, diagonal, strict=True)):
        if (scale > 0).all():
            scaled = matrix / np.outer(scale, scale)
            if np.linalg.eigvalsh(scaled)[0] > 1e-12:
                out[i] = np.linalg.inv(scaled) / np.outer(scale, scale)
    return out
