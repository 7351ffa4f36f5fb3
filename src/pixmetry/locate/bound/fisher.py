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

from pixmetry.core.arguments import number, whole_number
from pixmetry.core.errors import InputError
from pixmetry.locate.bound.predictions import PixelNoise
from pixmetry.locate.noise import ROUNDING_DN2, NoiseModel
from pixmetry.locate.template.template_images import Images, draw_images

DITHERED_DN = 0.4  # noise from which on rounding acts as further noise of 1/12 DN² (to 5 % of the variance at this noise, 1e-3 at 0.5 DN)
CODES_AT_ENDS_DN = 2.0  # noise up to which the codes near the ends of the scale are taken one by one; above, 0.4 % of the information
LEAST_NOISE_DN = 0.01  # below, grey values tell of a mean only where it crosses a threshold: there is a region of places, no variance
NEAR = 8.0  # standard deviations within which codes, or the ends of the scale, are looked at


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


def cramer_rao_bound(
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
    frames = whole_number(frames, "frames", "the number of frames cannot be used", least=1, allowed="1 or more")
    pattern_dn = number(pattern_dn, "pattern_dn", "the fixed pattern cannot be used", least=0, most=1e12, allowed="0 to 1e12 DN")
    if not isinstance(noise, NoiseModel):
        raise InputError("not a noise", where="noise", value=noise, allowed="a NoiseModel, or read=…,gain=…,bits=…")
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


def unrounded_variance_dn2(mean: np.ndarray, noise: NoiseModel, rounded: bool) -> np.ndarray:
    """Variance before rounding; same shape, DN².

    Raises
    ------
    InputError
        If rounding alone is more than the model's variance, or there is next to no noise.
    """
    variance = noise.variance_dn2(mean) - (ROUNDING_DN2 if rounded else 0.0)
    if (variance < -1e-9).any():
        raise InputError(
            "the noise is smaller than that of rounding",
            where="noise",
            value=noise.constant_dn2,
            allowed="a variance of 1/12 DN² or more where values are whole numbers",
            remedy="give the noise with rounding included, or state that values are not rounded",
        )
    if (variance < (LEAST_NOISE_DN**2 if rounded else 1e-300)).any():
        raise InputError(
            "there is no bound without noise" + (f": it is below {LEAST_NOISE_DN} DN before rounding" if rounded else ""),
            where="noise",
            remedy="give the temporal noise of the camera",
        )
    return variance


def information_per_dn2(mean: np.ndarray, noise: NoiseModel, rounded: bool = True) -> np.ndarray:
    """Fisher information of one grey value about its mean, in 1/DN².

    Parameters
    ----------
    mean : ndarray
        Before the ends of the scale cut it off.
    noise : NoiseModel
    rounded : bool
        Whether grey values are whole numbers; the model's variance then holds 1/12 DN² for it.

    Raises
    ------
    InputError
        As `unrounded_variance_dn2`.

    Notes
    -----
    Gaussian noise of known variance V: 1/V. That the variance too depends on the mean, and tells of it (½ V'²/V²), is left out: for Poisson
    light with read noise 1/V is the better approximation of the exact information. Rounding adds 1/12 to V while the noise before it is
    0.4 DN or more; below, the information is the exact one of the codes k, p(k) = Φ((k + ½ − µ)/σ) − Φ((k − ½ − µ)/σ). Values beyond the
    scale's ends all become the end: censored, they tell only that.
    """
    mean = np.asarray(mean, float)
    variance = unrounded_variance_dn2(mean, noise, rounded)
    if not rounded:
        return _censored(mean, np.sqrt(variance), noise.low_dn, noise.high_dn)
    sigma = np.sqrt(variance)
    end = np.minimum(np.abs(mean - noise.low_dn), np.abs(mean - noise.high_dn)) < NEAR * sigma
    by_code = (variance < DITHERED_DN**2) | (end & (sigma < CODES_AT_ENDS_DN))
    out = _censored(mean, np.sqrt(variance + ROUNDING_DN2), noise.low_dn + 0.5, noise.high_dn - 0.5)
    if by_code.any():
        out[by_code] = _of_codes(mean[by_code], sigma[by_code], noise.low_dn, noise.high_dn)
    return out


def exact_codes_matter(mean: np.ndarray, noise: NoiseModel, rounded: bool) -> bool:
    """Whether any pixel has so little noise that the codes are taken one by one."""
    return rounded and bool((unrounded_variance_dn2(mean, noise, rounded) < DITHERED_DN**2).any())


def kept_rounding_dn2(sigma: np.ndarray) -> np.ndarray:
    """Mean square of the error of rounding that stays when values with noise σ are averaged: Σ exp(−4π²k²σ²)/(2π²k²), 1/12 without noise.

    Notes
    -----
    The mean of a rounded value is off by Σ (−1)^k exp(−2π²k²σ²) sin(2πkµ)/(πk); means over µ of its square. B. Widrow, I. Kollár,
    Quantization Noise (2008), ch. 4.
    """
    k = np.arange(1, 200)
    out = np.zeros_like(sigma)
    near = sigma < 1.5 * DITHERED_DN  # beyond, less than 1e-7 DN²
    if near.any():
        out[near] = (np.exp(-((2 * np.pi * k * sigma[near][:, None]) ** 2)) / (2 * np.pi**2 * k**2)).sum(axis=1)
    return out


def _censored(mean: np.ndarray, sigma: np.ndarray, low: float, high: float) -> np.ndarray:
    """1/σ² of the values in between, and the information of the two ends: φ²/P each."""
    from scipy.special import log_ndtr, ndtr

    out = 1 / sigma**2
    for z in ((mean - high) / sigma, (low - mean) / sigma):  # positive: beyond that end
        near = z > -NEAR
        if near.any():
            t = z[near]
            density = np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi)
            piled = np.exp(-(t**2) - np.log(2 * np.pi) - log_ndtr(t))
            # of the values beyond, ∫ t² φ = P(z) − z φ(z) is lost and φ²/P is gained
            out[near] += (piled - (ndtr(t) - t * density)) / sigma[near] ** 2
    return np.maximum(out, 0.0)


def _of_codes(mean: np.ndarray, sigma: np.ndarray, low: float, high: float) -> np.ndarray:
    """Σ (dp/dµ)²/p over the codes."""
    from scipy.special import ndtr

    reach = int(np.ceil(NEAR * sigma.max())) + 1
    edges = np.floor(mean)[..., None] + np.arange(-reach, reach + 2) - 0.5
    edges = np.where(edges < low, -np.inf, np.where(edges > high, np.inf, edges))
    z = (edges - mean[..., None]) / sigma[..., None]
    lower, upper = z[..., :-1], z[..., 1:]
    right = lower > 0  # differences of small numbers on either side
    share = np.where(right, ndtr(-lower) - ndtr(-upper), ndtr(upper) - ndtr(lower))
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi) / sigma[..., None]
    change = density[..., :-1] - density[..., 1:]
    information: np.ndarray = np.divide(change**2, share, out=np.zeros_like(share), where=share > 1e-300).sum(axis=-1)
    return information
