"""Frames whose noise is not the white noise of single pixels, or whose targets are not quite the template: what real pictures have.

Each case is one mean image of discs or spots at known places, and a function that makes an exposure of it. Nothing of the package is in
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.special import j1

from locate import rendered
from pixmetry.locate.detect.targets import Flag
from pixmetry.locate.job import locate

Exposure = Callable[[np.ndarray, np.random.Generator], np.ndarray]
SIGMA = 1.5  # noise of a pixel, DN
WARNING = int(Flag.POOR_FIT | Flag.FAINT | Flag.NOT_CONVERGED | Flag.UNDER_SAMPLED | Flag.CLIPPED_AT_BLACK)  # u may be too small


@dataclass(frozen=True)
class Picture:
    """Mean image and the true places of its targets; how one exposure of it is made, and how it is to be located."""

    mean: np.ndarray
    x: np.ndarray
    y: np.ndarray
    exposure: Exposure
    options: dict[str, Any] = field(default_factory=dict)
    bits: int | None = 8

    def exposed(self, rng: np.random.Generator) -> np.ndarray:
        """One exposure."""
        values = self.exposure(self.mean, rng)
        if self.bits is None:
            return values.astype(np.float32)
        return np.clip(np.rint(values), 0, 2**self.bits - 1).astype(np.uint8 if self.bits <= 8 else np.uint16)


def discs(
    rng: np.random.Generator,
    side: int,
    radius: float = 4.0,
    blur: float = 0.7,
    aspect: float = 1.0,
    light: float = 0.0,
    height: float = 150.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """side × side bright discs on a ground of 40 DN, each at a random place within its pixel."""
    pitch = int(2 * (radius + 5.5 * blur)) + 10
    cells = (np.arange(side) + 0.5) * pitch
    x, y = (c.ravel() + rng.uniform(-1, 1, side * side) for c in np.meshgrid(cells, cells))
    shape = (side * pitch, side * pitch)
    images = []
    for px, py in zip(x, y, strict=True):
        at = rendered.window(px, py, radius + 5.5 * blur + 1, shape)
        images.append((at, rendered.ellipse(px, py, radius, radius * aspect, 30.0, blur, at, light=(light, 0.5 * light))))
    return rendered.planted(shape, 40.0, height, images), x, y


def airy(rng: np.random.Generator, side: int, first_zero_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points seen through a lens that diffracts, averaged over the pixel by 9 × 9 samples."""
    pitch = 24
    cells = (np.arange(side) + 0.5) * pitch
    x, y = (c.ravel() + rng.uniform(-1, 1, side * side) for c in np.meshgrid(cells, cells))
    fine = (np.arange(9) + 0.5) / 9 - 0.5
    images = []
    for px, py in zip(x, y, strict=True):
        at = rendered.window(px, py, 11, (side * pitch, side * pitch))
        v = (at[0][:, None] + fine - py)[:, :, None, None]
        u = (at[1][:, None] + fine - px)[None, None]
        rho = np.maximum(np.hypot(u, v) * 3.8317 / first_zero_px, 1e-9)
        images.append((at, ((2 * j1(rho) / rho) ** 2).mean(axis=(1, 3))))
    return rendered.planted((side * pitch, side * pitch), 40.0, 180.0, images), x, y


def white(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Independent pixels."""
    return mean + rng.normal(0, SIGMA, mean.shape)


def hot(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One pixel in a thousand is hot, by 60 DN on average."""
    return white(mean, rng) + np.where(rng.random(mean.shape) < 1e-3, rng.exponential(60.0, mean.shape), 0.0)


def rows(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each row has an offset of its own."""
    return white(mean, rng) + rng.normal(0, 1.0, (mean.shape[0], 1))


def stripes(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each column has an offset of its own, as large as the noise."""
    return white(mean, rng) + rng.normal(0, SIGMA, (1, mean.shape[1]))


def texture(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Texture with a power spectrum of 1/f², about as strong as the noise over a target."""
    fx, fy = np.fft.fftfreq(mean.shape[1]), np.fft.fftfreq(mean.shape[0])[:, None]
    f = np.maximum(np.hypot(fx, fy), 1 / 64)
    grain = np.fft.ifft2(np.fft.fft2(rng.normal(size=mean.shape)) / f).real
    return white(mean, rng) + SIGMA * grain / grain.std()


def smeared(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noise that a denoiser or a demosaicing spread over neighbours."""
    grain = gaussian_filter(rng.normal(size=mean.shape), 0.8)
    return mean + SIGMA * grain / grain.std()


def sharpened(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An unsharp mask over everything: the noise of neighbours is opposite, the edge has a halo."""
    values = white(mean, rng)
    return values + 0.6 * (values - gaussian_filter(values, 1.0))


def echoed(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A cable that is not terminated: 5 % of the signal comes again two pixels later, behind a low pass along the rows.

    All targets are shifted alike by it.
    """
    signal = gaussian_filter(mean, (0.0, 0.6))
    return white(signal + 0.05 * (np.roll(signal, 2, axis=1) - signal), rng)


def clipped_float(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A float picture whose top was cut off at 170 DN of 190."""
    return np.minimum(white(mean, rng), 170.0)


def black_float(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A float picture without an offset: values below 0 were cut off."""
    return np.maximum(white(mean - 39.0, rng), 0.0)


def jpeg(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Stored as a JPEG of quality 85."""
    import imagecodecs

    return imagecodecs.jpeg_decode(imagecodecs.jpeg_encode(np.clip(white(mean, rng).round(), 0, 255).astype(np.uint8), level=85))


def loud(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """White noise of 12 DN."""
    return mean + rng.normal(0, 12.0, mean.shape)


def pictures(side: int, seed: int = 0) -> dict[str, Picture]:
    """The cases by name, side × side targets each."""
    rng = np.random.default_rng(seed)
    plain = discs(rng, side)
    cases = {f.__name__: Picture(*plain, f) for f in (white, hot, rows, stripes, texture, smeared, sharpened, jpeg)}
    cases["clipped_float"] = Picture(*plain, clipped_float, bits=None)
    cases["black_float"] = Picture(*plain, black_float, bits=None)
    cases["sloped"] = Picture(*discs(rng, side, light=0.012), white)
    cases["sloped, smeared"] = Picture(*discs(rng, side, light=0.012), smeared)
    cases["airy 0.9"] = Picture(*airy(rng, side, 0.9), white, {"kind": "spot"})
    cases["airy 1.2"] = Picture(*airy(rng, side, 1.2), white, {"kind": "spot"})
    cases["airy 2.5"] = Picture(*airy(rng, side, 2.5), white, {"kind": "spot"})
    for aspect in (0.8, 0.5):
        tilted = discs(rng, side, radius=6.0, aspect=aspect)
        for name in ("centroid", "soft_threshold", "ellipse_edges", "forstner"):
            cases[f"{name}, axes 1 : {aspect}"] = Picture(*tilted, white, {"estimator": name})
    large = discs(rng, max(side // 2, 2), radius=14.0, blur=1.5)
    cases["gaussian, large and noisy"] = Picture(*large, loud, {"estimator": "gaussian"})
    return cases


def spoiled(rng: np.random.Generator, side: int) -> Picture:
    """Discs of which 6 % have dirt over their edge, 4 % a glint at it, and 4 % lie partly in a shade."""
    mean, x, y = discs(rng, side)
    v, u = np.indices(mean.shape)
    mean = mean.copy()
    for k in range(len(x)):
        what, turn = rng.random(), rng.uniform(0, 2 * np.pi)
        along = (u - x[k]) * np.cos(turn) + (v - y[k]) * np.sin(turn)
        beside = (v - y[k]) * np.cos(turn) - (u - x[k]) * np.sin(turn)
        if what < 0.06:
            mean -= rng.uniform(20, 140) * np.exp(-((along - 3.5) ** 2 + beside**2) / (2 * rng.uniform(1, 2.5) ** 2))
        elif what < 0.10:
            mean += rng.uniform(20, 60) * np.exp(-((along - 4) ** 2 + beside**2) / (2 * 0.8**2))
        elif what < 0.14:
            shade = rng.uniform(0.3, 1) / (1 + np.exp(np.clip(-2 * (along - rng.uniform(1, 3)), -50, 50)))
            near = np.maximum(np.abs(u - x[k]), np.abs(v - y[k])) < 9
            mean = np.where(near, mean - (mean - 40) * shade, mean)
    return Picture(np.maximum(mean, 0.0), x, y, white)


def plate(rng: np.random.Generator, side: int, off_px: float) -> np.ndarray:
    """A plate of side × side dots at a pitch of 24 px, seen at an angle, each printed off by so much; one exposure in 8 bits."""
    col, row = (c.ravel() for c in np.meshgrid(np.arange(side) - side / 2, np.arange(side) - side / 2))
    depth = 1 + 0.003 * col - 0.002 * row
    x, y = (12.0 * side + 24 * c / depth + rng.normal(0, off_px, side * side) for c in (col + 0.03 * row, row - 0.02 * col))
    shape = (24 * side + 24, 24 * side + 24)
    images = []
    for px, py in zip(x, y, strict=True):
        at = rendered.window(px, py, 9, shape)
        images.append((at, rendered.disc(px, py, 4.0, 0.7, at)))
    mean = rendered.planted(shape, 40.0, 150.0, images)
    return np.clip(np.rint(white(mean, rng)), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Score:
    """Errors over stated uncertainties, of coordinates; which of them stand in a row with a flag; the errors, and the targets wanted."""

    z: np.ndarray
    flagged: np.ndarray
    error_px: np.ndarray
    u_px: np.ndarray
    quality: np.ndarray
    wanted: int


def score(picture: Picture, rng: np.random.Generator, draws: int, warning: int = WARNING, **options: Any) -> Score:
    """Locate some exposures and match them with the truth; ``warning``: the flags that say that u may be too small."""
    tree, parts = cKDTree(np.stack([picture.x, picture.y], axis=1)), []
    for _ in range(draws):
        table = locate(picture.exposed(rng), **(picture.options | options))
        good = np.flatnonzero(np.isfinite(table.x_px))
        distance, of = tree.query(np.stack([table.x_px[good], table.y_px[good]], axis=1))
        good, of = good[distance < 3.0], of[distance < 3.0]
        error = np.stack([table.x_px[good] - picture.x[of], table.y_px[good] - picture.y[of]])
        u = np.sqrt(np.stack([table.var_x_px2[good], table.var_y_px2[good]]))
        said = np.broadcast_to((np.asarray(table.flags)[good] & warning) != 0, error.shape)
        quality = np.broadcast_to(table.columns.get("quality", np.full(len(table), np.nan))[good], error.shape)
        parts.append(np.stack([error, u, said, quality]).reshape(4, -1))
    error, u, said, quality = np.concatenate(parts, axis=1)
    return Score(error / u, said > 0, error, u, quality, draws * len(picture.x))
