"""What estimators will reach, without drawing noise: the variance of each, and how its answer depends on the sub-pixel phase.

Every estimator here solves Σ ψ(I; x̂) = 0, so that to first order its variance is Var ψ / (∂ψ/∂x)²: propagation through the fixed point,
with the distances taken from the estimate itself.
H. C. van Assen, M. Egmont-Petersen, J. H. C. Reiber, IEEE Trans. Image Processing 11(12), 1379 (2002).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pixmetry.core.errors import InputError
from pixmetry.locate.template.template import model
from pixmetry.locate.template.template_images import Images

MOMENTS = ("centroid", "squared_centroid", "soft_threshold", "hard_threshold")
FITS = ("template", "template_unweighted", "gaussian")
STAYS = ("rounding that does not average out", "pixel sensitivities")
SIGMAS = 3.0  # thresholds lie by so many standard deviations above the background


@dataclass(frozen=True)
class PixelNoise:
    """Variances of the pixels of the images in one frame, arrays of shape (p, n) in DN².

    Parameters
    ----------
    read, shot, rounding : ndarray
        Dark temporal noise, shot noise, and what rounding adds to a value in every frame anew.
    kept, pattern : ndarray
        What averaging frames does not remove: the error of rounding that too little noise leaves, and the sensor's fixed pattern.
    seen : ndarray
        The images' grey values, cut off at the ends of the scale.
    ideal : ndarray
        What rounding and clipping add for an estimator that knows the law of the codes; infinite where a value tells nothing.
    frames : int
        Frames that are averaged.
    """

    read: np.ndarray
    shot: np.ndarray
    rounding: np.ndarray
    kept: np.ndarray
    pattern: np.ndarray
    seen: np.ndarray
    ideal: np.ndarray
    frames: int = 1

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """Of the mean of the frames, by cause."""
        n = self.frames
        temporal = {"shot noise": self.shot / n, "read noise": self.read / n, "rounding": self.rounding / n}
        return temporal | dict(zip(STAYS, (self.kept, self.pattern), strict=True))

    @property
    def total(self) -> np.ndarray:
        """Of the mean of the frames."""
        return sum(self.parts.values(), np.zeros_like(self.read))

    @property
    def tells(self) -> np.ndarray:
        """1 where a value depends on its mean, 0 where it is cut off at an end of the scale."""
        tells: np.ndarray = (self.ideal < 20 * (self.read + self.shot + self.rounding + self.kept)).astype(float)
        return tells

    def for_the_best(self) -> PixelNoise:
        """The same for an estimator that knows the law of the codes: no smaller variance is possible."""
        return replace(self, rounding=self.ideal, kept=np.zeros_like(self.kept))


@dataclass(frozen=True)
class Prediction:
    """What an estimator gives; variances are means over the phases and the coordinates of the place.

    Parameters
    ----------
    name : str
    parts_px2 : dict
        Variance from the noise of the pixels, by cause.
    s_curve_px : float
        Root mean square of the error without noise.
    detail : str
        Window and threshold.
    """

    name: str
    parts_px2: dict[str, float]
    s_curve_px: float = 0.0
    detail: str = ""

    @property
    def noise_px(self) -> float:
        """Standard deviation of one coordinate from the noise."""
        return float(np.sqrt(sum(self.parts_px2.values())))

    @property
    def u_px(self) -> float:
        """Standard uncertainty of one coordinate: noise and phase together."""
        return float(np.hypot(self.noise_px, self.s_curve_px))


def names_for(kind: str) -> tuple[str, ...]:
    """The estimators that can be predicted for a kind of target."""
    if kind == "edge":
        return FITS[:2]
    return (*FITS[:2], *(f"row_{n}" for n in MOMENTS[:3])) if kind == "line" else (*FITS, *MOMENTS)


def predict(name: str, images: Images, noise: PixelNoise, unknowns: tuple[str, ...], window_px: float | None = None) -> Prediction:
    """Predict one estimator.

    Parameters
    ----------
    name : str
        One of `names_for` this kind.
    images, noise : Images, PixelNoise
    unknowns : tuple of str
        Of the template.
    window_px : float, optional
        Radius of the moments' round window, or half the width of a line's; by default the one with the least error.

    Raises
    ------
    InputError
        If there is no such estimator.
    """
    names = names_for(images.kind)
    if name not in names:
        raise InputError(f"this estimator cannot be predicted for a {images.kind}", where="estimator", value=name, allowed=", ".join(names))
    if name in ("template", "template_unweighted"):
        return template(images, noise, unknowns, weighted=name == "template")
    if name == "gaussian":
        return gaussian(images, noise)
    if window_px is not None:
        return moment(name, images, noise, window_px)
    tried = [moment(name, images, noise, radius) for radius in np.arange(1.5, images.window_px / 2 - 0.9, 0.5)]
    if not tried:
        raise InputError("the window is too small for a centroid", where="window_px", value=images.window_px, allowed="5 or more")
    return min(tried, key=lambda p: p.u_px if np.isfinite(p.u_px) else np.inf)


def template(images: Images, noise: PixelNoise, unknowns: tuple[str, ...], weighted: bool = True) -> Prediction:
    """Least squares with the target's own template: (JᵀWJ)⁻¹JᵀW Σ WJ(JᵀWJ)⁻¹, the Cramér–Rao bound where W = Σ⁻¹."""
    jacobian = images.columns(unknowns)
    weight = noise.tells / noise.total if weighted else noise.tells
    scale = np.sqrt(np.maximum(((jacobian**2) * weight[:, None]).sum(axis=2).mean(axis=0), 1e-300))[:, None]  # parameters of like size
    columns = jacobian / scale
    inverse = np.linalg.pinv((columns * weight[:, None]) @ columns.swapaxes(1, 2), hermitian=True)
    gain = inverse @ (columns * weight[:, None]) / scale
    places = np.stack([gain[:, unknowns.index(n)] for n in images.place if n in unknowns], axis=1)
    name, detail = ("template", "weights from the noise") if weighted else ("template_unweighted", "all weights alike")
    return Prediction(name, _parts(places**2, noise), detail=detail)


def moment(name: str, images: Images, noise: PixelNoise, radius_px: float) -> Prediction:
    """A centroid Σ f(I)(x − x̂) = 0 over a round window about x̂, or over the rows of a line; the background is known.

    Notes
    -----
    Mean and variance of f are those for Gaussian noise, so that a threshold near the background and the squares of the noise are in them.
    A row of a line is as good as all rows together times the root of their number: they are regressed with equal weights.
    """
    law = name.removeprefix("row_")
    sign = np.sign(images.parameters["amplitude_dn"])
    level = sign * (noise.seen - images.parameters["background_dn"])
    variance = noise.total * noise.tells
    threshold = SIGMAS * float(np.sqrt(np.median(variance))) if law in ("soft_threshold", "hard_threshold") else 0.0
    mean, spread, slope = _law(law, level, variance, threshold)
    inside = np.clip(radius_px + 0.5 - images.distance, 0.0, 1.0)  # edge pixels count by the part that lies inside
    lever = inside[:, None] * images.lever
    motion = sign * images.columns(images.place) * noise.tells[:, None]
    answer = (lever * slope[:, None] * motion).sum(axis=2)  # ∂ψ/∂x of a target that moves in a window that stays
    answer = np.where(answer > 0, answer, np.nan)
    share = np.divide(spread, variance, out=np.zeros_like(spread), where=variance > 0)
    bias = (lever * mean[:, None]).sum(axis=2) / answer
    where = "within" if images.kind == "line" else "window of radius"
    detail = f"{where} {radius_px:g} px" + (f", threshold {threshold:.3g} DN above the background" if threshold else "")
    parts = _parts(share[:, None] * lever**2 / answer[:, :, None] ** 2, noise)
    return Prediction(name, parts, float(np.sqrt(np.mean(bias**2))), detail)


def gaussian(images: Images, noise: PixelNoise) -> Prediction:
    """An unweighted fit of a round Gaussian with free height, background and width, whatever the target is.

    Notes
    -----
    At the fit the derivative of its answer by the pixels is H⁻¹Jᵀ with H = JᵀJ − Σ r ∂J: the residuals r of a target that is no Gaussian
    count.
    """
    gains, biases = [], []
    for mean, place in zip(noise.seen, images.phases_px, strict=True):
        centre = images.window_px // 2 + place
        p, jacobian, residual = _fit_gaussian(mean, centre, images)
        change = _second_derivatives(p, residual, images)
        gains.append(np.linalg.solve(jacobian @ jacobian.T - change, jacobian)[:2])
        biases.append(p[:2] - centre)
    bias = float(np.sqrt(np.mean(np.square(biases))))
    return Prediction("gaussian", _parts(np.stack(gains) ** 2, noise), bias, "round, equal weights")


def _law(name: str, level: np.ndarray, variance: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean and variance of f(level + n), and how its mean changes with the level."""
    from scipy.special import ndtr

    if name == "centroid":
        return level, variance, np.ones_like(level)
    if name == "squared_centroid":
        return level**2 + variance, 4 * level**2 * variance + 2 * variance**2, 2 * level
    sigma = np.sqrt(np.maximum(variance, 1e-12))
    z = (level - threshold) / sigma
    share, density = ndtr(z), np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    if name == "soft_threshold":
        mean = sigma * (z * share + density)
        return mean, variance * ((z**2 + 1) * share + z * density) - mean**2, share
    mean = level * share + sigma * density
    square = (level**2 + variance) * share + sigma * density * (level + threshold)
    return mean, square - mean**2, share + threshold / sigma * density


def _parts(share: np.ndarray, noise: PixelNoise) -> dict[str, float]:
    """Σ share · variance over the pixels, by cause; share of shape (p, place, n). Pixels that count for nothing may be infinitely noisy."""
    out = {}
    for cause, variance in noise.parts.items():
        finite = np.where(np.isfinite(variance), variance, 0.0)
        out[cause] = float((share * finite[:, None]).sum(axis=2).mean())
    return out


def _spot(p: np.ndarray, images: Images) -> tuple[np.ndarray, np.ndarray]:
    mean, jacobian = model("spot", p, images.window_px, images.window_px, aperture_px=images.aperture_px)
    return mean.ravel(), jacobian.reshape(len(p), -1)


def _fit_gaussian(mean: np.ndarray, centre: np.ndarray, images: Images) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from scipy.optimize import least_squares

    excess = np.abs(mean - images.parameters["background_dn"])
    pixel = np.arange(images.window_px)
    r2 = ((pixel[None, :] - centre[0]) ** 2 + (pixel[:, None] - centre[1]) ** 2).ravel()
    width = np.sqrt((excess * r2).sum() / excess.sum() / 2)
    start = np.array([*centre, width, images.parameters["amplitude_dn"], images.parameters["background_dn"]])
    scale = np.array([1.0, 1.0, width, abs(start[3]), abs(start[3])])
    tight = {"xtol": 1e-12, "ftol": 1e-14, "gtol": 1e-14, "bounds": ([-np.inf, -np.inf, 0.1 * width, -np.inf, -np.inf], np.inf)}
    found = least_squares(lambda p: _spot(p, images)[0] - mean, start, lambda p: _spot(p, images)[1].T, x_scale=scale, **tight)
    fitted, jacobian = _spot(found.x, images)
    return found.x, jacobian, mean - fitted


def _second_derivatives(p: np.ndarray, residual: np.ndarray, images: Images) -> np.ndarray:
    """Σ r ∂²m/∂p∂p by differences of the derivatives."""
    out = np.empty((len(p), len(p)))
    for k, step in enumerate((1e-4, 1e-4, 1e-4 * p[2], 1e-4 * abs(p[3]), 1e-4 * abs(p[3]))):
        move = np.zeros(len(p))
        move[k] = step
        out[k] = (_spot(p + move, images)[1] - _spot(p - move, images)[1]) @ residual / (2 * step)
    return 0.5 * (out + out.T)
